//! Helpers that several integration tests share.

#![allow(dead_code, reason = "each test uses some of the helpers")]

pub mod conditions;

use mujoco_drones_gym::drone::{BatteryParams, MotorParams};
use mujoco_drones_gym::env::{check_env, check_independence};
use mujoco_drones_gym::mujoco::{Error, gl_info};
use mujoco_drones_gym::prelude::*;

/// Returns a Crazyflie that flies with every action type: with a law from duty to speed and a constant voltage.
pub fn airframe_with_duty() -> DroneParams {
    let motors = MotorParams { speed_at_zero: 1500.0, speed_per_volt: 5800.0, voltage: 3.7, ..MotorParams::default() };
    DroneParams { motors, ..DroneModel::Cf2x.params() }
}

/// Returns an airframe with a law from duty to speed, and with a battery for some seconds of hover or a constant voltage.
/// The sag in hover is 6 % of 3.7 V.
pub fn supplied(params: DroneParams, hover_seconds: Option<f64>) -> DroneParams {
    let (hover, max) = (params.hover_rpm(), params.max_rpm());
    let (speed_at_zero, speed_per_volt) = (0.1 * max, max / 3.8);
    let motors = MotorParams { speed_at_zero, speed_per_volt, voltage: 3.7, ..params.motors };
    let efficiency = 0.5;
    let power = 4.0 * params.torque_coefficient * hover.powi(3) * std::f64::consts::TAU / 60.0 / efficiency;
    let current = power / 3.7;
    let battery = |seconds: f64| BatteryParams {
        capacity: current * seconds / 3600.0,
        resistance: 0.06 * 3.7 / current,
        efficiency,
        idle_current: 0.01 * current,
        ..BatteryParams::default()
    };
    DroneParams { motors, battery: hover_seconds.map(battery), ..params }
}

/// Returns a Crazyflie with a battery of one cell. Its capacity is small, so that a flight of seconds empties it by a
/// noticeable part. The reaction torque is that of measured propellers, a quarter of the paper's.
pub fn airframe_with_battery(capacity: f64) -> DroneParams {
    let battery =
        BatteryParams { capacity, resistance: 0.12, efficiency: 0.4, idle_current: 0.1, ..BatteryParams::default() };
    let motors = MotorParams { voltage: 0.0, ..airframe_with_duty().motors };
    DroneParams { battery: Some(battery), torque_coefficient: 1.9e-12, motors, ..airframe_with_duty() }
}

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
