//! Waypoints in order.

use super::waypoints::in_body_frame;
use super::{Observation, RewardTerms, STATE_SIZE, observe_state};
use crate::math::{Real, V3};
use crate::state::FlightState;

/// Returns the reward of a drone before its last capture, from the reward for a capture in this step, the penalty for
/// the distance, the distance to the waypoint (m) and the angular velocity (rad/s):
/// capture − penalty·distance − 0.01·‖ω‖.
#[inline(always)]
pub fn reward<R: Real>(capture: R, penalty: R, distance: R, rate: V3<R>) -> R {
    terms(capture, penalty, distance, rate)
}

/// Returns the terms of the [`reward`], in the order of its formula: `capture`, `distance`, `angular_velocity`.
#[inline(always)]
pub fn terms<R: Real, T: RewardTerms<R>>(capture: R, penalty: R, distance: R, rate: V3<R>) -> T {
    T::first("capture", capture).minus("distance", penalty * distance).minus("angular_velocity", rate.norm() * 0.01)
}

/// Returns the terms of a drone after its last capture, which are all zero.
#[inline(always)]
pub fn no_terms<T: RewardTerms<f64>>() -> T {
    // the sum is −0, as in lanes
    terms(-0.0, 0.0, 0.0, V3::new(0.0, 0.0, 0.0))
}

/// Writes the observation: the state vector, the waypoint (m, world frame) and the waypoint relative to the drone (m,
/// body frame).
#[inline(always)]
pub fn observe<R: Real, O: Observation<R> + ?Sized>(state: &FlightState<R>, rpy: V3<R>, target: V3<R>, out: &mut O) {
    observe_state(state, rpy, out);
    out.put3(STATE_SIZE, target);
    out.put3(STATE_SIZE + 3, in_body_frame(&state.attitude, target - state.position));
}
