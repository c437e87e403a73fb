//! Hovering of several drones. Reward and end of a drone are those of [`hover`](super::hover).

use super::{Observation, STATE_SIZE, observe_state};
use crate::math::{Real, V3};
use crate::state::FlightState;

/// Writes the observation: the state vector and the height of the target, m.
#[inline(always)]
pub fn observe<R: Real, O: Observation<R> + ?Sized>(state: &FlightState<R>, rpy: V3<R>, height: R, out: &mut O) {
    observe_state(state, rpy, out);
    out.put(STATE_SIZE, height);
}
