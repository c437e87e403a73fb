//! Every environment of a batch is bit-identical to a single environment, for any number of threads.

#[path = "../common/mod.rs"]
mod common;

mod alone;
mod episodes;
mod faults;
mod tasks;

use mujoco_drones_gym::env::AviaryBuilder;
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::{Rng, RngExt, SeedableRng};

/// Random actions that change slowly, one row per environment: drones fly, tumble and crash.
struct Wander {
    rng: Rng,
    held: Vec<f32>,
    size: usize,
}

impl Wander {
    fn new(seed: u64, count: usize, size: usize) -> Self {
        Self { rng: Rng::seed_from_u64(seed), held: vec![0.0; count * size], size }
    }

    fn next(&mut self) -> &[f32] {
        for row in self.held.chunks_exact_mut(self.size) {
            // most of the change is common to all motors, so that drones stay in the air for some time
            let common = 0.3 * (self.rng.random::<f32>() - 0.45);
            for x in row {
                *x = (0.8 * *x + common + 0.01 * (self.rng.random::<f32>() - 0.5)).clamp(-1.2, 1.2);
            }
        }
        &self.held
    }
}

/// Returns the bits of a row.
fn bits(row: &[f32]) -> Vec<u32> {
    row.iter().map(|x| x.to_bits()).collect()
}

/// Returns a row in double precision.
fn widen(row: &[f32]) -> Vec<f64> {
    row.iter().map(|&x| f64::from(x)).collect()
}

/// Returns a row in single precision, rounded to nearest.
fn narrow(row: &[f64]) -> Vec<f32> {
    row.iter().map(|&x| x as f32).collect()
}

/// Compares a batch with single environments, all with the hybrid engine.
fn compare<T: Task + Clone + Send + Sync>(builder: &AviaryBuilder<T>, config: VecConfig, steps: usize) -> usize {
    compare_as_built(&builder.clone().engine(EngineKind::Hybrid), config, steps)
}

/// Flies a batch and single environments with the same actions, compares every number, and returns the number of
/// episodes that ended.
fn compare_as_built<T: Task + Clone + Send + Sync>(
    builder: &AviaryBuilder<T>,
    config: VecConfig,
    steps: usize,
) -> usize {
    let mut batch = VecAviary::new(builder.clone(), config).unwrap();
    let count = batch.num_envs();
    let (a, o) = (batch.action_size(), batch.observation_size());
    let mut buffers = VecBuffers::new(&batch);
    let mut alone: Vec<_> = (0..count).map(|i| builder.clone().stream(i as u64).build().unwrap()).collect();
    let mut over = vec![false; count];
    let (space, mut row) = (batch.observation_space().vector.clone(), vec![0.0_f32; o]);
    batch.reset(Some(11), &mut buffers.observations).unwrap();
    for (i, env) in alone.iter_mut().enumerate() {
        space.write_f32(&env.reset(Some(11)).unwrap().vector, &mut row);
        assert_eq!(bits(&row), bits(&buffers.observations[i * o..][..o]), "reset of {i}");
    }
    let mut wander = Wander::new(5, count, a);
    let mut ended = 0;
    for step in 0..steps {
        let actions = wander.next().to_vec();
        batch.step(&actions, buffers.step()).unwrap();
        for (i, env) in alone.iter_mut().enumerate() {
            let in_batch = &buffers.observations[i * o..][..o];
            let got = (buffers.rewards[i], buffers.terminated[i], buffers.truncated[i]);
            if over[i] {
                space.write_f32(&env.reset(None).unwrap().vector, &mut row);
                assert_eq!(bits(&row), bits(in_batch), "next reset of {i}");
                assert_eq!(got, (0.0, false, false));
                over[i] = false;
                continue;
            }
            let Step { observation, reward, terminated, truncated } = env.step(&widen(&actions[i * a..][..a])).unwrap();
            space.write_f32(&observation.vector, &mut row);
            assert_eq!(got, (reward as f32, terminated, truncated), "step {step} of {i}");
            let ends = terminated || truncated;
            if ends {
                ended += 1;
                let report = batch.episode_summary(i).copied().unwrap();
                assert_eq!(report.end, env.info().end);
                assert_eq!((report.success, report.steps), (env.info().success, env.simulation().control_steps()));
            } else {
                assert!(batch.episode_summary(i).is_none());
            }
            if ends && config.autoreset == Autoreset::SameStep {
                assert_eq!(bits(&row), bits(&batch.final_observations()[i * o..][..o]));
                space.write_f32(&env.reset(None).unwrap().vector, &mut row);
            } else {
                over[i] = ends;
            }
            assert_eq!(bits(&row), bits(in_batch), "step {step} of {i}");
        }
    }
    ended
}
