//! Coming to rest from a random motion.

use super::{Observation, RewardTerms, observe_state};
use crate::math::{Real, V3};
use crate::state::FlightState;

/// Speed below which a drone is at rest, m/s.
pub const STILL: f64 = 0.05;

/// Norm of the angular velocity below which a drone is at rest, rad/s.
pub const STEADY: f64 = 0.1;

/// Returns true at rest.
#[inline(always)]
pub fn at_rest<R: Real>(state: &FlightState<R>) -> R::Mask {
    let (speed, rate) = (state.velocity.norm(), state.rate.norm());
    speed.less(speed.all(STILL)) & rate.less(rate.all(STEADY))
}

/// Returns the reward: −‖v‖ − 0.1·‖ω‖ − 0.05·(|φ| + |θ|), + 0.5 at rest.
#[inline(always)]
pub fn reward<R: Real>(state: &FlightState<R>, rpy: V3<R>) -> R {
    terms(state, rpy)
}

/// Returns the terms of the [`reward`], in the order of its formula: `speed`, `angular_velocity`, `tilt`, `at_rest`.
#[inline(always)]
pub fn terms<R: Real, T: RewardTerms<R>>(state: &FlightState<R>, rpy: V3<R>) -> T {
    let zero = rpy.x.all(0.0);
    T::first("speed", -state.velocity.norm())
        .minus("angular_velocity", state.rate.norm() * 0.1)
        .minus("tilt", (rpy.x.abs() + rpy.y.abs()) * 0.05)
        .plus("at_rest", R::choose(at_rest(state), zero.all(0.5), zero))
}

/// Writes the observation, the state vector.
#[inline(always)]
pub fn observe<R: Real, O: Observation<R> + ?Sized>(state: &FlightState<R>, rpy: V3<R>, out: &mut O) {
    observe_state(state, rpy, out);
}
