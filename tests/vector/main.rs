//! Every environment of a batch is bit-identical to a single environment, for any number of threads.

#[path = "../common/mod.rs"]
mod common;

mod alone;
mod conditions;
mod controllers;
mod episodes;
mod faults;
mod kept;
mod pair;
mod precision;
mod tasks;

use mujoco_drones_gym::env::AviaryBuilder;
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::{Rng, RngExt, SeedableRng};

use pair::Pair;

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
    let mut pair = Pair::new(builder, config, 11);
    let mut wander = Wander::new(5, pair.batch.num_envs(), pair.batch.action_size());
    (0..steps).for_each(|_| pair.step(wander.next()));
    pair.ended
}
