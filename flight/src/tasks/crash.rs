//! Conditions under which a drone crashes.

use crate::clearance::CollisionCylinder;
use crate::math::Real;
use crate::state::FlightState;

/// Distance from the floor above which a drone is airborne, m.
pub const CLEAR_OF_FLOOR: f64 = 0.01;

/// Limits of a drone that need no contacts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CrashLimits<R = f64> {
    /// Collision cylinder.
    pub cylinder: CollisionCylinder<R>,
    /// Height below which the drone has crashed, m; −∞ for no limit.
    pub lowest: R,
    /// World z component of body z below which the drone has crashed; −∞ for no limit.
    pub upright: R,
}

impl<R: Real> CrashLimits<R> {
    /// Returns true if a drone is clear of the floor. A drone that was so since the start of the episode is airborne:
    /// the next contact with the floor is a crash.
    #[inline(always)]
    pub fn is_clear(&self, state: &FlightState<R>) -> R::Mask {
        let clearance = self.cylinder.floor_clearance(state.position.z, state.attitude.up().z);
        clearance.all(CLEAR_OF_FLOOR).less(clearance)
    }

    /// Returns true if a drone is below its lowest height or tilted beyond its limit.
    #[inline(always)]
    pub fn are_exceeded(&self, state: &FlightState<R>) -> R::Mask {
        let (up, height) = (state.attitude.up().z, state.position.z);
        up.less(self.upright) | height.less(self.lowest)
    }
}
