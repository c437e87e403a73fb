//! Exchange of places on a circle.

use super::{Observation, RewardTerms, STATE_SIZE, observe_state};
use crate::math::{Real, V3};
use crate::state::FlightState;

/// Distance from the goal within which a drone is at its goal, m.
pub const AT_GOAL: f64 = 0.1;

/// Returns the reward from the distance to the goal (m) and the number of drones that are too close.
#[inline(always)]
pub fn reward<R: Real>(distance: R, close: R) -> R {
    terms(distance, close)
}

/// Returns the terms of the [`reward`], in the order of its formula: `distance`, `at_goal`, `too_close`.
#[inline(always)]
pub fn terms<R: Real, T: RewardTerms<R>>(distance: R, close: R) -> T {
    let zero = distance.all(0.0);
    T::first("distance", distance * -0.1)
        .plus("at_goal", R::choose(distance.less(zero.all(AT_GOAL)), zero.all(0.5), zero))
        .minus("too_close", close)
}

/// Writes the observation: the state vector, the goal (m, world frame) and the goal relative to the drone (m, world
/// frame).
#[inline(always)]
pub fn observe<R: Real, O: Observation<R> + ?Sized>(state: &FlightState<R>, rpy: V3<R>, goal: V3<R>, out: &mut O) {
    observe_state(state, rpy, out);
    out.put3(STATE_SIZE, goal);
    out.put3(STATE_SIZE + 3, goal - state.position);
}
