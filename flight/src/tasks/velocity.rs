//! Tracking of a velocity and a yaw rate.

use super::{Observation, RewardTerms, STATE_SIZE, observe_state};
use crate::math::{Real, V3};
use crate::state::FlightState;

/// Velocity error below which the target is tracked, m/s.
pub const TRACKED: f64 = 0.05;

/// Returns the reward for a target velocity (m/s, world frame) and yaw rate (rad/s):
/// −‖v − v\*‖ − 0.1·|ω_z − ω\*| − 0.05·(|φ| + |θ|), + 0.5 while tracked.
#[inline(always)]
pub fn reward<R: Real>(state: &FlightState<R>, rpy: V3<R>, velocity: V3<R>, yaw_rate: R) -> R {
    terms(state, rpy, velocity, yaw_rate)
}

/// Returns the terms of the [`reward`], in the order of its formula: `velocity_error`, `yaw_rate_error`, `tilt`,
/// `tracked`.
#[inline(always)]
pub fn terms<R: Real, T: RewardTerms<R>>(state: &FlightState<R>, rpy: V3<R>, velocity: V3<R>, yaw_rate: R) -> T {
    let (error, zero) = ((state.velocity - velocity).norm(), yaw_rate.all(0.0));
    T::first("velocity_error", -error)
        .minus("yaw_rate_error", (state.rate.z - yaw_rate).abs() * 0.1)
        .minus("tilt", (rpy.x.abs() + rpy.y.abs()) * 0.05)
        .plus("tracked", R::choose(error.less(zero.all(TRACKED)), zero.all(0.5), zero))
}

/// Writes the observation: the state vector, the target velocity (m/s, world frame) and the target yaw rate (rad/s).
#[inline(always)]
pub fn observe<R: Real, O: Observation<R> + ?Sized>(
    state: &FlightState<R>,
    rpy: V3<R>,
    velocity: V3<R>,
    yaw_rate: R,
    out: &mut O,
) {
    observe_state(state, rpy, out);
    out.put3(STATE_SIZE, velocity);
    out.put(STATE_SIZE + 3, yaw_rate);
}
