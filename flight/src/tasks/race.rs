//! Laps through gates.

use super::waypoints::in_body_frame;
use super::{Observation, STATE_SIZE, observe_state};
use crate::math::{Real, V3};
use crate::state::FlightState;

/// Returns the reward of a drone before its last gate, from the reward for a gate in this step, the reward for the
/// speed and the penalty for the distance, the velocity (m/s), and the distance to the gate (m).
#[inline(always)]
pub fn reward<R: Real>(gate: R, [speed_reward, distance_penalty]: [R; 2], velocity: V3<R>, distance: R) -> R {
    gate + speed_reward * velocity.norm() - distance_penalty * distance
}

/// Writes the observation: the state vector, the next gate (m, world frame), and the next two gates relative to the
/// drone (m, body frame).
#[inline(always)]
pub fn observe<R: Real, O: Observation<R> + ?Sized>(
    state: &FlightState<R>,
    rpy: V3<R>,
    [next, second]: [V3<R>; 2],
    out: &mut O,
) {
    observe_state(state, rpy, out);
    out.put3(STATE_SIZE, next);
    out.put3(STATE_SIZE + 3, in_body_frame(&state.attitude, next - state.position));
    out.put3(STATE_SIZE + 6, in_body_frame(&state.attitude, second - state.position));
}
