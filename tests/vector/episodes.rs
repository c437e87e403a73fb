//! Resets, ends and changes of single environments in a batch.

use mujoco_drones_gym::env::Randomization;
use mujoco_drones_gym::physics::wind::{WindConfig, WindModel};
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::{Rng, RngExt, SeedableRng};

use super::Wander;

#[test]
fn a_mask_resets_those_that_it_names_and_leaves_the_others_alone() {
    let config = VecConfig::new(20);
    let make = || VecAviary::new(Velocity::builder(), config).unwrap();
    let (mut one, mut other) = (make(), make());
    let (mut a, mut b) = (VecBuffers::new(&one), VecBuffers::new(&other));
    one.reset(Some(2), &mut a.observations).unwrap();
    other.reset(Some(2), &mut b.observations).unwrap();
    let mut wander = Wander::new(1, 20, 4);
    for _ in 0..10 {
        let actions = wander.next();
        one.step(actions, a.step()).unwrap();
        other.step(actions, b.step()).unwrap();
    }
    let mask: Vec<bool> = (0..20).map(|i| i % 3 == 1).collect();
    let before = a.observations.clone();
    one.reset_where(&mask, None, &mut a.observations).unwrap();
    for i in 0..20 {
        let same = a.observations[16 * i..][..16] == before[16 * i..][..16];
        assert_eq!(same, !mask[i], "{i}");
        let steps = one.with(i, |env| env.simulation().control_steps()).unwrap();
        assert_eq!(steps, if mask[i] { 0 } else { 10 });
    }
    let actions = wander.next();
    one.step(actions, a.step()).unwrap();
    other.step(actions, b.step()).unwrap();
    for i in (0..20).filter(|&i| !mask[i]) {
        assert_eq!(a.observations[16 * i..][..16], b.observations[16 * i..][..16], "{i}");
    }
    // a seed starts the streams of those that it names anew
    one.reset_where(&mask, Some(2), &mut a.observations).unwrap();
    let first = one.with(1, |env| env.task().target(0)).unwrap();
    other.reset(Some(2), &mut b.observations).unwrap();
    assert_eq!(first, other.with(1, |env| env.task().target(0)).unwrap());
    assert_ne!(first, other.with(2, |env| env.task().target(0)).unwrap(), "every environment has a stream of its own");
}

#[test]
fn an_environment_can_be_changed_as_if_it_were_alone() {
    let mut batch = VecAviary::new(Hover::builder().initial_positions([[0.0, 0.0, 2.0]]), VecConfig::new(10)).unwrap();
    let mut buffers = VecBuffers::new(&batch);
    batch.reset(Some(1), &mut buffers.observations).unwrap();
    let wind = WindConfig { velocity: [3.0, 0.0, 0.0], ..WindConfig::new(WindModel::Constant) };
    batch.with(4, |env| env.set_wind(Some(wind))).unwrap().unwrap();
    let mut seen = 0;
    batch.with_env(7, &mut |env| seen = env.episode_steps()).unwrap();
    let error = batch.with(10, |_| ()).unwrap_err().to_string();
    assert_eq!(error, "environment 10 does not exist, expected an index from 0 to 9");
    assert_eq!(seen, 480);
    for _ in 0..48 {
        batch.step(&[0.0; 40], buffers.step()).unwrap();
    }
    for i in 0..10 {
        let x = buffers.observations[12 * i];
        assert_eq!(x > 0.005, i == 4, "{i}: {x}");
    }
}

#[test]
fn randomizing_one_environment_leaves_the_bodies_of_the_others_alone() {
    let config = VecConfig { threads: 1, ..VecConfig::new(10) };
    let mut batch = VecAviary::new(Hover::builder(), config).unwrap();
    let mut buffers = VecBuffers::new(&batch);
    batch.reset(Some(1), &mut buffers.observations).unwrap();
    let bodies = Randomization { body: Some(Default::default()), ..Randomization::NONE };
    batch.with(4, |env| env.set_randomization(Some(bodies))).unwrap().unwrap();
    batch.reset(Some(1), &mut buffers.observations).unwrap();
    batch.step(&[0.0; 40], buffers.step()).unwrap();
    let nominal = DroneModel::Cf2x.params().mass;
    for i in 0..10 {
        let mass = batch.with(i, |env| env.simulation().params(0).mass).unwrap();
        assert_eq!(mass != nominal, i == 4, "{i}: {mass}");
    }
    // and it can be taken back
    batch.with(4, |env| env.set_randomization(None)).unwrap().unwrap();
    batch.reset(Some(1), &mut buffers.observations).unwrap();
    assert_eq!(batch.with(4, |env| env.simulation().params(0).mass).unwrap(), nominal);
}

/// A hundred thousand environment steps here, a million with `--ignored`.
fn long_run(steps: usize) {
    let randomized = Randomization { sensors: None, environment: None, ..Randomization::default() };
    for builder in [Hover::builder(), Hover::builder().physics(Physics::MjcGndDragDw).randomization(randomized)] {
        let count = 500;
        let config = VecConfig { autoreset: Autoreset::SameStep, ..VecConfig::new(count) };
        let mut env = VecAviary::new(builder, config).unwrap();
        let mut buffers = VecBuffers::new(&env);
        env.reset(Some(1), &mut buffers.observations).unwrap();
        let mut rng = Rng::seed_from_u64(2);
        let (mut ended, mut lengths) = (vec![0_u64; count], 0);
        let mut actions = vec![0.0_f32; 4 * count];
        for _ in 0..steps / count / 2 {
            actions.fill_with(|| 2.0 * rng.random::<f32>() - 1.0);
            env.step(&actions, buffers.step()).unwrap();
            assert!(buffers.observations.iter().chain(&buffers.rewards).all(|x| x.is_finite()));
            for (i, ended) in ended.iter_mut().enumerate() {
                if let Some(report) = env.episode_summary(i) {
                    *ended += 1;
                    lengths += report.steps;
                }
            }
        }
        // none is lost: every step of every environment belongs to an episode that has ended or is still running
        let running: u64 = (0..count).map(|i| env.with(i, |env| env.simulation().control_steps()).unwrap()).sum();
        assert_eq!((lengths + running) as usize, steps / 2);
        let all = ended.iter().sum::<u64>() as usize;
        assert!(all > steps / 100, "{all} ended");
    }
}

#[test]
fn random_actions_for_long_lose_no_environment_and_make_no_nan() {
    long_run(100_000);
}

#[test]
#[ignore = "a million steps"]
fn a_million_random_steps_lose_no_environment_and_make_no_nan() {
    long_run(1_000_000);
}

#[test]
fn a_curriculum_of_a_batch_follows_the_episodes_of_all_environments() {
    use mujoco_drones_gym::vector::VecCurriculum;
    use mujoco_drones_gym::wrappers::{CurriculumConfig, CurriculumMetric};
    let config = CurriculumConfig {
        levels: 3,
        metric: CurriculumMetric::EpisodeLength,
        window: 10,
        advance: 9.5,
        retreat: None,
    };
    // an episode of ten steps in the air; higher on every level
    let builder = || Hover::builder().initial_positions([[0.0, 0.0, 1.0]]).episode_seconds(10.0 / 48.0);
    let raise = |env: &mut Aviary<Hover>, level: usize| {
        env.task_mut().target_height = 1.0 + 0.5 * level as f64;
        Ok(())
    };
    let batch = VecAviary::new(builder(), VecConfig::new(16)).unwrap();
    let mut env = VecCurriculum::new(batch, config, raise).unwrap();
    let mut buffers = VecBuffers::new(&env);
    env.reset(Some(1), &mut buffers.observations).unwrap();
    let actions = vec![0.0; 64];
    let mut levels = Vec::new();
    for _ in 0..40 {
        env.step(&actions, buffers.step()).unwrap();
        // episodes that have ended do not count again when the next step is refused
        assert!(env.step(&[f32::NAN; 64], buffers.step()).is_err());
        levels.push(env.curriculum().level());
    }
    // sixteen episodes end together: one level and six episodes of the next, which are too few
    assert_eq!((levels[8], levels[9], levels[20], levels[39]), (0, 1, 2, 2));
    assert_eq!(env.curriculum().state().episodes, 48);
    for i in 0..16 {
        assert_eq!(env.inner().with(i, |env| env.task().target_height).unwrap(), 2.0);
    }
    let same = VecAviary::new(builder(), VecConfig { autoreset: Autoreset::SameStep, ..VecConfig::new(2) }).unwrap();
    assert!(VecCurriculum::new(same, config, raise).is_err());
}

/// Hover with something else in its `update`, and the thrust of the last physics step as reward.

#[test]
fn looking_at_an_environment_shows_its_own_commands_and_end_and_changes_nothing() {
    let make = || VecAviary::new(Hover::builder(), VecConfig { threads: 1, ..VecConfig::new(10) }).unwrap();
    let (mut looked, mut other) = (make(), make());
    let mut buffers = [VecBuffers::new(&looked), VecBuffers::new(&other)];
    looked.reset(Some(1), &mut buffers[0].observations).unwrap();
    other.reset(Some(1), &mut buffers[1].observations).unwrap();
    let actions: Vec<f32> = (0..40).map(|i| if i / 4 == 7 { -1.0 } else { 0.002 * (i / 4) as f32 }).collect();
    for step in 0..30 {
        looked.step(&actions, buffers[0].step()).unwrap();
        other.step(&actions, buffers[1].step()).unwrap();
        assert_eq!(buffers[0], buffers[1], "{step}");
        let crashed = buffers[0].terminated[7];
        for i in [2, 5, 7] {
            let (speeds, rpm, end) = looked
                .with(i, |env| {
                    let simulation = env.simulation();
                    (simulation.motor_speeds()[0], *simulation.rotor_speeds(0), env.drone_end(0))
                })
                .unwrap();
            let ended = end.is_some();
            assert!(ended == (crashed && i == 7), "{i}: {end:?}");
            if i != 7 {
                let wanted = 14_475.8 + f64::from(0.002 * i as f32) * (21_713.7 - 14_475.8);
                assert!((speeds[0] - wanted).abs() < 2.0 && rpm == speeds, "{i}: {speeds:?} {rpm:?}");
            }
        }
    }
    // an end that is known already is not another one
    let config = VecConfig { autoreset: Autoreset::Disabled, on_fault: OnFault::Truncate, ..VecConfig::new(1) };
    let mut batch = VecAviary::new(Hover::builder(), config).unwrap();
    let mut buffers = VecBuffers::new(&batch);
    batch.reset(None, &mut buffers.observations).unwrap();
    let mut ends = Vec::new();
    for _ in 0..20 {
        batch.step(&[-1.0; 4], buffers.step()).unwrap();
        ends.extend(batch.episode_summary(0).and_then(|summary| summary.end));
    }
    assert_eq!(ends, [EndReason::FloorContact]);
    assert!(!buffers.truncated[0] && !buffers.terminated[0]);
    assert!(batch.faults()[0].1.to_string().contains("after the end"));
}
