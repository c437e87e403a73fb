//! Resets, ends and changes of individual environments of a batch.

use mujoco_drones_gym::env::Randomization;
use mujoco_drones_gym::physics::wind::{WindConfig, WindModel};
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::{Rng, RngExt, SeedableRng};

use super::Wander;
use super::common::reset_batch;
use super::pair::Pair;

#[test]
fn a_masked_reset_changes_the_environments_in_the_mask_alone() {
    let config = VecConfig::new(20);
    let [(mut one, mut a), (mut other, mut b)] = [(); 2].map(|()| reset_batch(Velocity::builder(), config, 2));
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
    // a seed restarts the random streams of the environments in the mask
    one.reset_where(&mask, Some(2), &mut a.observations).unwrap();
    let first = one.with(1, |env| env.task().target(0)).unwrap();
    other.reset(Some(2), &mut b.observations).unwrap();
    assert_eq!(first, other.with(1, |env| env.task().target(0)).unwrap());
    assert_ne!(first, other.with(2, |env| env.task().target(0)).unwrap(), "each environment has its own random stream");
}

#[test]
fn with_changes_one_environment_of_a_batch() {
    let builder = Hover::builder().initial_positions([[0.0, 0.0, 2.0]]);
    let (mut batch, mut buffers) = reset_batch(builder, VecConfig::new(10), 1);
    let wind = WindConfig { velocity: [3.0, 0.0, 0.0], ..WindConfig::new(WindModel::Constant) };
    batch.with(4, |env| env.set_wind(Some(wind))).unwrap().unwrap();
    let mut episode_steps = 0;
    batch.with_env(7, &mut |env| episode_steps = env.episode_steps()).unwrap();
    let error = batch.with(10, |_| ()).unwrap_err().to_string();
    assert_eq!(error, "environment 10 does not exist, expected an index from 0 to 9");
    assert_eq!(episode_steps, 480);
    for _ in 0..48 {
        batch.step(&[0.0; 40], buffers.step()).unwrap();
    }
    for i in 0..10 {
        let x = buffers.observations[12 * i];
        assert_eq!(x > 0.005, i == 4, "{i}: {x}");
    }
}

#[test]
fn randomizing_one_environment_does_not_change_the_others() {
    let config = VecConfig { threads: 1, ..VecConfig::new(10) };
    let (mut batch, mut buffers) = reset_batch(Hover::builder(), config, 1);
    let bodies = Randomization { body: Some(Default::default()), ..Randomization::NONE };
    batch.with(4, |env| env.set_randomization(Some(bodies))).unwrap().unwrap();
    batch.reset(Some(1), &mut buffers.observations).unwrap();
    batch.step(&[0.0; 40], buffers.step()).unwrap();
    let nominal = DroneModel::Cf2x.params().mass;
    for i in 0..10 {
        let mass = batch.with(i, |env| env.simulation().params(0).mass).unwrap();
        assert_eq!(mass != nominal, i == 4, "{i}: {mass}");
    }
    // removing the randomization restores the nominal mass
    batch.with(4, |env| env.set_randomization(None)).unwrap().unwrap();
    batch.reset(Some(1), &mut buffers.observations).unwrap();
    assert_eq!(batch.with(4, |env| env.simulation().params(0).mass).unwrap(), nominal);
}

/// Flies environment steps with random actions and asserts that all numbers are finite and every step belongs to an
/// episode.
fn fly_random_actions(steps: usize) {
    let randomized = Randomization { sensors: None, environment: None, ..Randomization::default() };
    for builder in [Hover::builder(), Hover::builder().physics(Physics::MjcGndDragDw).randomization(randomized)] {
        let count = 500;
        let config = VecConfig { autoreset: Autoreset::SameStep, ..VecConfig::new(count) };
        let (mut env, mut buffers) = reset_batch(builder, config, 1);
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
        // every step belongs to an episode that has ended or is still running
        let running: u64 = (0..count).map(|i| env.with(i, |env| env.simulation().control_steps()).unwrap()).sum();
        assert_eq!((lengths + running) as usize, steps / 2);
        let all = ended.iter().sum::<u64>() as usize;
        assert!(all > steps / 100, "{all} ended");
    }
}

#[test]
fn a_hundred_thousand_random_steps_stay_finite_and_belong_to_episodes() {
    fly_random_actions(100_000);
}

#[test]
#[ignore = "a million steps"]
fn a_million_random_steps_stay_finite_and_belong_to_episodes() {
    fly_random_actions(1_000_000);
}

#[test]
fn a_curriculum_of_a_batch_counts_the_episodes_of_all_environments() {
    use mujoco_drones_gym::vector::VecCurriculum;
    use mujoco_drones_gym::wrappers::{CurriculumConfig, CurriculumMetric};
    let config = CurriculumConfig {
        levels: 3,
        metric: CurriculumMetric::EpisodeLength,
        window: 10,
        advance: 9.5,
        retreat: None,
        ..CurriculumConfig::default()
    };
    // episodes of ten steps; the target height rises with the level
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
        // a refused step does not count ended episodes a second time
        assert!(env.step(&[0.0; 63], buffers.step()).is_err());
        levels.push(env.curriculum().level());
    }
    // 16 episodes end together: ten complete a level, and six are too few for the next one
    assert_eq!((levels[8], levels[9], levels[20], levels[39]), (0, 1, 2, 2));
    assert_eq!(env.curriculum().state().episodes, 48);
    for i in 0..16 {
        assert_eq!(env.inner().with(i, |env| env.task().target_height).unwrap(), 2.0);
    }
    let same = VecAviary::new(builder(), VecConfig { autoreset: Autoreset::SameStep, ..VecConfig::new(2) }).unwrap();
    assert!(VecCurriculum::new(same, config, raise).is_err());
}

#[test]
fn reading_an_environment_returns_its_commands_and_end_and_changes_nothing() {
    let config = VecConfig { threads: 1, ..VecConfig::new(10) };
    let [(mut looked, first), (mut other, second)] = [(); 2].map(|()| reset_batch(Hover::builder(), config, 1));
    let mut buffers = [first, second];
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
                let expected = 14_475.8 + f64::from(0.002 * i as f32) * (21_713.7 - 14_475.8);
                assert!((speeds[0] - expected).abs() < 2.0 && rpm == speeds, "{i}: {speeds:?} {rpm:?}");
            }
        }
    }
    // a fault after the end of an episode is not reported as another end
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

/// An environment that has not started has the nominal airframe, whatever the others have sampled.
#[test]
fn an_environment_without_an_episode_has_nominal_parameters() {
    let builder = Hover::builder().engine(EngineKind::Hybrid).randomization(Randomization::default());
    let nominal = builder.clone().build().unwrap().simulation().params(0).mass;
    let mut batch = VecAviary::new(builder, VecConfig { threads: 1, ..VecConfig::new(3) }).unwrap();
    let mut buffers = VecBuffers::new(&batch);
    batch.reset_where(&[true, false, true], Some(4), &mut buffers.observations).unwrap();
    let masses: Vec<f64> = (0..3).map(|i| batch.with(i, |env| env.simulation().params(0).mass).unwrap()).collect();
    assert!(masses[0] != nominal && masses[1] == nominal && masses[2] != nominal, "{masses:?}");
}

#[test]
fn a_seed_per_environment_is_that_of_a_single_environment() {
    for threads in [1, 3] {
        let config = VecConfig { threads, autoreset: Autoreset::Disabled, ..VecConfig::new(43) };
        let mut pair = Pair::new(&Stabilize::builder().engine(EngineKind::Hybrid), config, 1);
        pair.step(&[0.1; 43 * 4]);
        let seeds: Vec<_> = (0..43).map(|i| (i % 5 != 2).then_some(1000 - 7 * i)).collect();
        let mask: Vec<_> = (0..43).map(|i| i % 3 != 1).collect();
        pair.reset_with_seeds(&mask, &seeds);
        pair.step(&[0.2; 43 * 4]);
        pair.compare_all_exactly();
        let Pair { batch, buffers, .. } = &mut pair;
        let error = batch.reset_with_seeds(&mask, &seeds[1..], &mut buffers.observations).unwrap_err().to_string();
        assert!(error.contains("seeds has 42 entries, expected 43"), "{error}");
    }
}
