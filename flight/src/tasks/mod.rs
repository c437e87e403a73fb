//! Observation, reward and end of the built-in tasks.
//!
//! Every function is the formula of one task for one drone. A task that keeps the state of its episode, its options
//! and its random numbers is the simulator's. Rewards exclude the penalty for a crash, [`CRASH_PENALTY`].

pub mod antipodal;
pub mod crash;
pub mod fly_through;
pub mod formation;
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
