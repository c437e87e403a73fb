//! Waypoints in order.

use super::waypoints::in_body_frame;
use super::{Observation, STATE_SIZE, observe_state};
use crate::math::{Real, V3};
use crate::state::FlightState;

/// Returns the reward of a drone before its last capture, from the reward for a capture in this step, the penalty for
/// the distance, the distance to the waypoint (m) and the angular velocity (rad/s):
/// capture − penalty·distance − 0.01·‖ω‖.
#[inline(always)]
pub fn reward<R: Real>(capture: R, penalty: R, distance: R, rate: V3<R>) -> R {
    capture - penalty * distance - rate.norm() * 0.01
}

/// Writes the observation: the state vector, the waypoint (m, world frame) and the waypoint relative to the drone (m,
/// body frame).
#[inline(always)]
pub fn observe<R: Real, O: Observation<R> + ?Sized>(state: &FlightState<R>, rpy: V3<R>, target: V3<R>, out: &mut O) {
    observe_state(state, rpy, out);
    out.put3(STATE_SIZE, target);
    out.put3(STATE_SIZE + 3, in_body_frame(&state.attitude, target - state.position));
}
