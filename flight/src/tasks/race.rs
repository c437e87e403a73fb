//! Laps through gates.

use super::waypoints::in_body_frame;
use super::{Observation, RewardTerms, STATE_SIZE, observe_state};
use crate::math::{Real, V3};
use crate::state::FlightState;

/// Returns the reward of a drone before its last gate, from the reward for a gate in this step, the reward for the
/// speed and the penalty for the distance, the velocity (m/s), and the distance to the gate (m).
#[inline(always)]
pub fn reward<R: Real>(gate: R, weights: [R; 2], velocity: V3<R>, distance: R) -> R {
    terms(gate, weights, velocity, distance)
}

/// Returns the terms of the [`reward`], in the order of its formula: `gate`, `speed`, `distance`.
#[inline(always)]
pub fn terms<R: Real, T: RewardTerms<R>>(
    gate: R,
    [speed_reward, distance_penalty]: [R; 2],
    velocity: V3<R>,
    distance: R,
) -> T {
    T::first("gate", gate).plus("speed", speed_reward * velocity.norm()).minus("distance", distance_penalty * distance)
}

/// Returns the terms of a drone after its last gate, which are all zero.
#[inline(always)]
pub fn no_terms<T: RewardTerms<f64>>() -> T {
    // the sum is −0, as in lanes
    terms(-0.0, [-0.0, 0.0], V3::new(0.0, 0.0, 0.0), 0.0)
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

/// Writes the additional entries of races whose gates have frames: the normals of the next two gates (body frame).
#[inline(always)]
pub fn observe_normals<R: Real, O: Observation<R> + ?Sized>(
    state: &FlightState<R>,
    [next, second]: [V3<R>; 2],
    out: &mut O,
) {
    out.put3(STATE_SIZE + 9, in_body_frame(&state.attitude, next));
    out.put3(STATE_SIZE + 12, in_body_frame(&state.attitude, second));
}
