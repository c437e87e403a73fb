//! State of a drone.

use crate::math::{Real, Turn, V3, finite_zero};

/// State of one drone or of a register of drones.
#[derive(Debug, Clone, Copy)]
pub struct FlightState<R> {
    /// Position of the centre of mass, world frame, m.
    pub position: V3<R>,
    /// Rotation from the body to the world frame.
    pub attitude: Turn<R>,
    /// Velocity of the centre of mass, world frame, m/s.
    pub velocity: V3<R>,
    /// Body rate, body frame, rad/s.
    pub rate: V3<R>,
}

impl<R: Real> FlightState<R> {
    /// Returns a zero where every number of the state is finite, and NaN elsewhere.
    #[inline(always)]
    pub fn finite_zero(&self) -> R {
        let Self { position: p, attitude: q, velocity: v, rate } = self;
        finite_zero([p.x, p.y, p.z, q.w, q.v.x, q.v.y, q.v.z, v.x, v.y, v.z, rate.x, rate.y, rate.z])
    }
}
