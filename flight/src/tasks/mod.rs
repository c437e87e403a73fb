//! Observation, reward and end of the built-in tasks.
//!
//! Every function is the formula of one task for one drone. A task that keeps the state of its episode, its options
//! and its random numbers is the simulator's. Rewards exclude the penalty for a crash, [`CRASH_PENALTY`].
//!
//! A reward is a sum of named terms. The function `terms` of a task has the formula, generic over the result
//! ([`RewardTerms`]): the sum alone, or a list of the terms. The function `reward` returns the sum.

pub mod antipodal;
pub mod crash;
pub mod fly_through;
pub mod formation;
pub mod gates;
pub mod hover;
pub mod multi_hover;
pub mod race;
pub mod stabilize;
pub mod track;
pub mod velocity;
pub mod waypoints;

use crate::math::{Real, V3};
use crate::state::FlightState;

/// Number of entries of the state vector: position 3, roll-pitch-yaw 3, velocity 3, angular velocity 3.
pub const STATE_SIZE: usize = 12;

/// Penalty that every task subtracts from the reward for a crash.
pub const CRASH_PENALTY: f64 = 100.0;

/// Name of the term that contains the penalty for a crash.
pub const CRASH: &str = "crash";

/// Result of a formula that adds the terms of a reward, in their order. Names are in lower snake case.
///
/// A number is the sum and ignores the names: the formula costs the same as one without names. A [`Vec`] is the list
/// of the terms, each with its sign in the sum.
///
/// ```
/// use flight::tasks::{RewardTerms, formation};
///
/// let sum: f64 = formation::terms(0.5, 0.4);
/// let terms: Vec<(&str, f64)> = formation::terms(0.5, 0.4);
/// assert_eq!(terms, [("slot_error", -0.5), ("distance_errors", -0.1)]);
/// assert_eq!(sum, -0.6);
/// assert_eq!(terms.plus("bonus", 2.0)[2], ("bonus", 2.0));
/// ```
pub trait RewardTerms<R>: Sized {
    /// Starts the sum with a term.
    fn first(name: &'static str, value: R) -> Self;

    /// Adds a term.
    fn plus(self, name: &'static str, value: R) -> Self;

    /// Subtracts a term.
    fn minus(self, name: &'static str, value: R) -> Self;
}

impl<R: Real> RewardTerms<R> for R {
    #[inline(always)]
    fn first(_: &'static str, value: R) -> Self {
        value
    }

    #[inline(always)]
    fn plus(self, _: &'static str, value: R) -> Self {
        self + value
    }

    #[inline(always)]
    fn minus(self, _: &'static str, value: R) -> Self {
        self - value
    }
}

impl RewardTerms<f64> for Vec<(&'static str, f64)> {
    fn first(name: &'static str, value: f64) -> Self {
        Self::new().plus(name, value)
    }

    fn plus(mut self, name: &'static str, value: f64) -> Self {
        // no negative zeros
        self.push((name, value + 0.0));
        self
    }

    fn minus(self, name: &'static str, value: f64) -> Self {
        self.plus(name, -value)
    }
}

/// Receiver of the entries of an observation.
pub trait Observation<R: Copy> {
    /// Writes an entry.
    fn put(&mut self, entry: usize, value: R);

    /// Writes three entries.
    #[inline(always)]
    fn put3(&mut self, entry: usize, value: V3<R>) {
        self.put(entry, value.x);
        self.put(entry + 1, value.y);
        self.put(entry + 2, value.z);
    }
}

impl<R: Copy> Observation<R> for [R] {
    #[inline(always)]
    fn put(&mut self, entry: usize, value: R) {
        self[entry] = value;
    }
}

/// Writes the state vector: position (m, world frame), roll, pitch and yaw (rad), velocity (m/s, world frame) and
/// angular velocity (rad/s, body frame).
#[inline(always)]
pub fn observe_state<R: Real, O: Observation<R> + ?Sized>(state: &FlightState<R>, rpy: V3<R>, out: &mut O) {
    out.put3(0, state.position);
    out.put3(3, rpy);
    out.put3(6, state.velocity);
    out.put3(9, state.rate);
}

#[cfg(test)]
mod tests;
