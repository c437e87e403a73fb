use super::*;

fn one() -> NonZeroUsize {
    NonZeroUsize::MIN
}

fn two() -> NonZeroUsize {
    NonZeroUsize::new(2).unwrap()
}

fn policy(name: &str) -> Pilot {
    let path = format!("{}/../assets/policies/{name}.safetensors", env!("CARGO_MANIFEST_DIR"));
    Pilot::policy(&format!("{name}.safetensors"), &std::fs::read(path).unwrap()).unwrap()
}

#[test]
fn suites_have_unique_conditions_and_buildable_environments() {
    let craft = Craft::of(&Pilot::Controller(ControllerKind::Pid)).unwrap();
    for suite in Suite::ALL {
        assert_eq!(suite.name().parse::<Suite>(), Ok(suite));
        let conditions = suite.conditions();
        let mut names: Vec<_> = conditions.iter().map(|condition| condition.name.clone()).collect();
        names.sort();
        names.dedup();
        assert_eq!(names.len(), conditions.len(), "{suite}");
        for condition in &conditions {
            let env = condition.environment(&craft).unwrap();
            assert_eq!(env.name(), condition.task_name());
        }
        for ladder in suite.ladders() {
            assert!(ladder.levels.windows(2).all(|pair| pair[0] < pair[1]));
            assert!(ladder.levels.iter().all(|&level| names.contains(&ladder.condition_name(level))));
        }
    }
    assert_eq!(Suite::Tracks.conditions().len(), 3);
    assert!("hovr".parse::<Suite>().unwrap_err().to_string().ends_with("did you mean `hover`?"));
}

#[test]
fn reports_are_bit_identical_for_any_number_of_threads() {
    for (pilot, suite) in [(Pilot::Controller(ControllerKind::Geometric), Suite::Race), (policy("hover"), Suite::Hover)]
    {
        let report = |threads| {
            let mut calls = Vec::new();
            let report = run(&pilot, &[suite], 5, threads, false, &mut |done| calls.push(done)).unwrap();
            assert_eq!(calls, [5, 10, 15, 20]);
            serde_json::to_string(&report).unwrap()
        };
        assert_eq!(report(one()), report(two()), "{suite}");
    }
}

#[test]
fn a_report_names_the_policy_by_its_hash() {
    let report = run(&policy("hover"), &[Suite::Hover], 2, one(), false, &mut |_| {}).unwrap();
    let PilotReport::Policy { file, sha256, task, .. } = &report.pilot else { panic!("{:?}", report.pilot) };
    assert_eq!((file.as_str(), task.as_str(), sha256.len()), ("hover.safetensors", "hover", 64));
    let nominal = &report.suites[0].conditions[0];
    assert_eq!((nominal.condition.as_str(), nominal.succeeded, nominal.success_rate), ("nominal", 2, 1.0));
    assert!(nominal.mean.unwrap() < 0.1 && nominal.interval.is_some());
    let Pilot::Policy(PolicyPilot { sha256: empty, .. }) = policy("race") else { panic!() };
    assert_ne!(&empty, sha256);
}

/// A policy whose actions are not numbers.
struct Broken;

impl Policy for Broken {
    fn reset(&mut self, _: &dyn aviary::env::DroneEnv) -> Result<(), aviary::rollout::RolloutError> {
        Ok(())
    }

    fn act(&mut self, _: &dyn aviary::env::DroneEnv, action: &mut [f64]) -> Result<(), aviary::rollout::RolloutError> {
        action.fill(f64::NAN);
        Ok(())
    }
}

#[test]
fn faults_are_counted_and_options_are_in_the_report() {
    let options = BTreeMap::from([("action_range", "unit".to_string())]);
    let info = PolicyInfo::of_task("hover");
    let pilot = Pilot::other("broken.onnx", b"broken", info, None, options, || Box::new(Broken));
    let report = run(&pilot, &[Suite::Hover], 3, one(), false, &mut |_| {}).unwrap();
    for condition in &report.suites[0].conditions {
        assert_eq!((condition.faults, condition.succeeded), (3, 0), "{}", condition.condition);
    }
    let json = serde_json::to_value(&report).unwrap();
    assert_eq!(json["pilot"]["policy"]["options"]["action_range"], "unit");
    let sound = run(&policy("hover"), &[Suite::Hover], 1, one(), false, &mut |_| {}).unwrap();
    assert_eq!(sound.suites[0].conditions[0].faults, 0);
    assert!(serde_json::to_value(&sound).unwrap()["pilot"]["policy"].get("options").is_none());
}

#[test]
fn a_policy_that_does_not_fit_is_an_error_or_skipped() {
    let (race, all) = (policy("race"), Suite::ALL);
    let error = run(&race, &[Suite::Hover], 1, one(), false, &mut |_| {}).unwrap_err().to_string();
    assert!(error.contains("21 observations") && error.contains("12 observations"), "{error}");
    let error = run(&race, &[Suite::Hover, Suite::Robust], 1, one(), true, &mut |_| {}).unwrap_err();
    assert!(matches!(error, TrainError::Policy(_)), "{error}");
    let report = run(&race, &all, 1, two(), true, &mut |_| {}).unwrap();
    assert_eq!(report.suites.iter().map(|suite| suite.suite).collect::<Vec<_>>(), ["race", "tracks"]);
    assert_eq!(report.skipped.iter().map(|skipped| skipped.suite).collect::<Vec<_>>(), ["hover", "robust"]);
    let error = run(&race, &all, 0, one(), true, &mut |_| {}).unwrap_err().to_string();
    assert_eq!(error, "episodes is 0, expected 1 to 100,000");
    assert!(Pilot::policy("a", b"nothing").is_err());
}

#[test]
fn margins_end_at_the_first_level_that_is_not_passed() {
    let condition = &Suite::Robust.conditions()[0];
    let report = |level: f64, success_rate: f64| ConditionReport {
        condition: format!("motor_loss {level}"),
        success_rate,
        ..ConditionReport::new(condition, &[])
    };
    let ladder = &Suite::Robust.ladders()[0];
    let margin = |rates: [f64; 4]| {
        let reports: Vec<_> = ladder.levels.iter().zip(rates).map(|(&level, rate)| report(level, rate)).collect();
        ladder.margin(&reports).passed
    };
    assert_eq!(margin([1.0, 0.95, 0.94, 1.0]), Some(0.2));
    assert_eq!(margin([0.5, 1.0, 1.0, 1.0]), None);
    assert_eq!(margin([1.0; 4]), Some(0.4));
}
