//! Tracking of a point on a circle.

use std::f64::consts::TAU;

use super::{Observation, RewardTerms, STATE_SIZE, observe_state};
use crate::math::{Real, V3, sin_cos_of_turns};
use crate::state::FlightState;

/// Distance below which the reference is tracked, m.
pub const TRACKED: f64 = 0.05;

/// Circle of the reference.
#[derive(Debug, Clone, Copy)]
pub struct Circle<R> {
    /// y of the centre, m; x is 0.
    pub y: R,
    /// Height, m.
    pub height: R,
    /// Radius, m.
    pub radius: R,
    /// Angular speed after the acceleration, rad/s.
    pub rate: R,
    /// Initial angle, rad.
    pub phase: R,
    /// 1 counterclockwise, −1 clockwise.
    pub direction: R,
}

impl<R: Real> Circle<R> {
    /// Duration of the acceleration at the start, s.
    const RAMP: f64 = 1.0;

    /// Returns position, velocity and acceleration of the reference at a time (s) of the episode.
    #[inline(always)]
    pub fn motion(&self, time: R) -> [V3<R>; 3] {
        let Self { y, height, radius, rate: full, phase, direction } = *self;
        let zero = time.all(0.0);
        // constant angular acceleration
        let starting = time.less(zero.all(Self::RAMP));
        let gain = full * (1.0 / Self::RAMP);
        let angle = R::choose(starting, gain * 0.5 * time * time, full * (time - 0.5 * Self::RAMP));
        let (rate, gain) = (R::choose(starting, gain * time, full), R::choose(starting, gain, zero));
        let (sin, cos) = sin_cos_of_turns((phase + direction * angle) * (1.0 / TAU));
        let (outwards, along) = (V3::new(cos, sin, zero), V3::new(direction * -sin, direction * cos, zero));
        [
            V3::new(zero, y, height) + outwards * radius,
            along * (radius * rate),
            along * (radius * gain) - outwards * (radius * rate * rate),
        ]
    }
}

/// Returns the reward for a reference position (m) and velocity (m/s):
/// −‖p − p\*‖ − 0.1·‖v − v\*‖ − 0.05·(|φ| + |θ|), + 0.5 while tracked.
#[inline(always)]
pub fn reward<R: Real>(state: &FlightState<R>, rpy: V3<R>, position: V3<R>, velocity: V3<R>) -> R {
    terms(state, rpy, position, velocity)
}

/// Returns the terms of the [`reward`], in the order of its formula: `position_error`, `velocity_error`, `tilt`,
/// `tracked`.
#[inline(always)]
pub fn terms<R: Real, T: RewardTerms<R>>(state: &FlightState<R>, rpy: V3<R>, position: V3<R>, velocity: V3<R>) -> T {
    let (error, zero) = ((state.position - position).norm(), rpy.x.all(0.0));
    T::first("position_error", -error)
        .minus("velocity_error", (state.velocity - velocity).norm() * 0.1)
        .minus("tilt", (rpy.x.abs() + rpy.y.abs()) * 0.05)
        .plus("tracked", R::choose(error.less(zero.all(TRACKED)), zero.all(0.5), zero))
}

/// Returns true if a drone is farther than a distance (m) from the reference, where the episode ends.
#[inline(always)]
pub fn is_too_far<R: Real>(state: &FlightState<R>, position: V3<R>, max_distance: R) -> R::Mask {
    max_distance.less((state.position - position).norm())
}

/// Writes the observation: the state vector, the reference position relative to the drone (m, world frame) and the
/// reference velocity (m/s, world frame).
#[inline(always)]
pub fn observe<R: Real, O: Observation<R> + ?Sized>(
    state: &FlightState<R>,
    rpy: V3<R>,
    position: V3<R>,
    velocity: V3<R>,
    out: &mut O,
) {
    observe_state(state, rpy, out);
    out.put3(STATE_SIZE, position - state.position);
    out.put3(STATE_SIZE + 3, velocity);
}
