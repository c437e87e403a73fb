//! Hovering at a target.

use super::{Observation, RewardTerms, observe_state};
use crate::math::{Real, V3};
use crate::state::FlightState;

/// Vertical and horizontal distance from the target within which a drone is at the target, m.
pub const AT_TARGET: f64 = 0.05;

/// Returns true at the target.
#[inline(always)]
pub fn at_target<R: Real>(position: V3<R>, target: V3<R>) -> R::Mask {
    let (apart, limit) = (position - target, position.x.all(AT_TARGET));
    apart.z.abs().less(limit) & apart.level_norm().less(limit)
}

/// Returns the reward: −|z − z\*| − 0.1·‖(x, y) − (x\*, y\*)‖ − 0.05·‖v‖ − 0.05·(|φ| + |θ|), + 0.5 at the target.
#[inline(always)]
pub fn reward<R: Real>(state: &FlightState<R>, rpy: V3<R>, target: V3<R>) -> R {
    terms(state, rpy, target)
}

/// Returns the terms of the [`reward`], in the order of its formula: `height_error`, `horizontal_error`, `speed`,
/// `tilt`, `at_target`.
#[inline(always)]
pub fn terms<R: Real, T: RewardTerms<R>>(state: &FlightState<R>, rpy: V3<R>, target: V3<R>) -> T {
    let apart = state.position - target;
    let zero = apart.z.all(0.0);
    T::first("height_error", -apart.z.abs())
        .minus("horizontal_error", apart.level_norm() * 0.1)
        .minus("speed", state.velocity.norm() * 0.05)
        .minus("tilt", (rpy.x.abs() + rpy.y.abs()) * 0.05)
        .plus("at_target", R::choose(at_target(state.position, target), zero.all(0.5), zero))
}

/// Returns true above a height (m), where the episode ends.
#[inline(always)]
pub fn is_too_high<R: Real>(position: V3<R>, max_height: R) -> R::Mask {
    max_height.less(position.z)
}

/// Writes the observation, the state vector.
#[inline(always)]
pub fn observe<R: Real, O: Observation<R> + ?Sized>(state: &FlightState<R>, rpy: V3<R>, out: &mut O) {
    observe_state(state, rpy, out);
}
