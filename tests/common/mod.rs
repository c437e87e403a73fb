//! Helpers that several integration tests share.

#![allow(dead_code, reason = "each test uses some of the helpers")]

pub mod conditions;

use mujoco_drones_gym::env::{check_env, check_independence};
use mujoco_drones_gym::mujoco::{Error, gl_info};
use mujoco_drones_gym::prelude::*;

/// Returns true if no OpenGL library is found. A test that renders then passes without rendering.
pub fn no_gl() -> bool {
    matches!(gl_info(), Err(Error::NoGl { .. }))
}

/// Steps an environment `count` times with one action.
pub fn step_env(env: &mut dyn DroneEnv, action: &[f64], count: usize) {
    for _ in 0..count {
        env.step(action).unwrap();
    }
}

/// Steps an environment with one action until its episode ends.
pub fn step_to_end(env: &mut dyn DroneEnv, action: &[f64]) {
    while env.info().end.is_none() {
        env.step(action).unwrap();
    }
}

/// Steps a simulation `count` times with one set of motor speeds, rpm.
pub fn step_simulation(simulation: &mut Simulation, rpm: &[[f64; 4]], count: usize) {
    for _ in 0..count {
        simulation.step(rpm).unwrap();
    }
}

/// Builds a batch and its buffers, and resets all environments with a seed.
pub fn reset_batch<T: Task + Clone + Send + Sync>(
    builder: AviaryBuilder<T>,
    config: VecConfig,
    seed: u64,
) -> (VecAviary<T>, VecBuffers) {
    let mut batch = VecAviary::new(builder, config).unwrap();
    let mut buffers = VecBuffers::new(&batch);
    batch.reset(Some(seed), &mut buffers.observations).unwrap();
    (batch, buffers)
}

/// Asserts that environments from `build` keep the contract of an environment and do not influence each other.
pub fn assert_contract<E: DroneEnv>(build: impl Fn() -> E) {
    check_env(&mut build()).unwrap_or_else(|error| panic!("{error}"));
    check_independence(&mut build(), &mut build()).unwrap();
}
