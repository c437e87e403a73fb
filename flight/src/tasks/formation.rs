//! Formation around a centre that moves along a closed path.

use super::{Observation, RewardTerms, STATE_SIZE, observe_state};
use crate::math::{Real, V3};
use crate::state::FlightState;

/// Side of the path of the centre.
#[derive(Debug, Clone, Copy)]
pub struct Side<R> {
    /// Length of a lap, m.
    pub lap: R,
    /// Distance along the lap at which the side starts, m.
    pub start: R,
    /// Lower end of the range of the distance travelled on the side in which the side is certainly the present one, m.
    pub low: R,
    /// Upper end of that range, m.
    pub high: R,
    /// Start of the side, world frame, m.
    pub from: V3<R>,
    /// Direction, as a unit vector.
    pub direction: V3<R>,
}

impl Side<f64> {
    /// Side on which the centre stays.
    pub const STAND: Self = {
        let zero = V3 { x: 0.0, y: 0.0, z: 0.0 };
        Self { lap: f64::MAX, start: 0.0, low: f64::NEG_INFINITY, high: f64::INFINITY, from: zero, direction: zero }
    };
}

impl<R: Real> Side<R> {
    /// Returns the distance travelled on the side, m, from the distance travelled in all laps.
    #[inline(always)]
    pub fn travelled(&self, distance: R) -> R {
        let laps = distance / self.lap;
        let nearest = laps.rounded();
        let whole = R::choose(laps.less(nearest), nearest - 1.0, nearest);
        distance - whole * self.lap - self.start
    }

    /// Returns the position of the centre, world frame, m, from the distance travelled in all laps.
    #[inline(always)]
    pub fn point(&self, distance: R) -> V3<R> {
        self.from + self.direction * self.travelled(distance)
    }
}

/// Returns the reward from the distance to the slot and the sum of the errors of the distances to the other drones, m.
#[inline(always)]
pub fn reward<R: Real>(error: R, deviations: R) -> R {
    terms(error, deviations)
}

/// Returns the terms of the [`reward`], in the order of its formula: `slot_error`, `distance_errors`.
#[inline(always)]
pub fn terms<R: Real, T: RewardTerms<R>>(error: R, deviations: R) -> T {
    // each pair occurs in the rewards of both its drones
    T::first("slot_error", -error).minus("distance_errors", deviations * 0.25)
}

/// Returns the error of the distance between two drones, from their difference of positions and of slots, m.
#[inline(always)]
pub fn deviation<R: Real>(apart: V3<R>, desired: V3<R>) -> R {
    (apart.norm() - desired.norm()).abs()
}

/// Writes the observation: the state vector, the slot (m, world frame) and the slot relative to the drone (m, world
/// frame).
#[inline(always)]
pub fn observe<R: Real, O: Observation<R> + ?Sized>(state: &FlightState<R>, rpy: V3<R>, slot: V3<R>, out: &mut O) {
    observe_state(state, rpy, out);
    out.put3(STATE_SIZE, slot);
    out.put3(STATE_SIZE + 3, slot - state.position);
}
