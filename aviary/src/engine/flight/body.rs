use nalgebra::{UnitQuaternion, Vector3};

use ::flight::body::{self, Push};

use crate::math::{ToFlight as _, ToNalgebra as _};
use crate::physics::rotor::RotorWrench;
use crate::state::{DroneState, FlightState};
use crate::world::Medium;

/// Free rigid body with the coefficients of its equations of motion.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct FreeBody(pub(crate) body::FreeBody);

impl FreeBody {
    /// Largest rotation angle of a body in one step for which [`step`](Self::step) is exact, rad.
    pub const MAX_TURN: f64 = body::FreeBody::MAX_TURN;

    /// Creates a body of a mass (kg) and moments of inertia (kg·m²), with gravity (m/s², downwards) and an optional
    /// medium.
    pub fn new(mass: f64, inertia: &Vector3<f64>, gravity: f64, medium: Option<Medium>) -> Self {
        let medium = medium.map(|Medium { density, viscosity }| body::Medium { density, viscosity });
        Self(body::FreeBody::new(mass, (*inertia).into(), gravity, medium))
    }

    /// Returns the force of a medium that moves with the air, minus the force of a still medium, world frame, N.
    /// [`step`](Self::step) and MuJoCo compute the force of the still medium.
    ///
    /// `velocity` of the body and `air`, the velocity of the medium, are in the world frame, m/s.
    pub fn moving_medium(
        &self,
        attitude: &UnitQuaternion<f64>,
        velocity: &Vector3<f64>,
        air: &Vector3<f64>,
    ) -> Vector3<f64> {
        self.0.medium_change(&attitude.to_flight(), velocity.to_flight(), air.to_flight()).to_nalgebra()
    }

    /// Computes one step of MuJoCo's RK4 over `dt` seconds under the rotors' wrench and a force that is constant in
    /// the world frame, N.
    ///
    /// With `BODY_FIXED` the rotors' wrench rotates with the body in the stages; otherwise it is constant in the
    /// world frame. `MEDIUM` may be false for a body without a medium, which is faster.
    ///
    /// The step is exact while the body rotates by less than [`MAX_TURN`](Self::MAX_TURN).
    #[inline]
    pub fn step<const BODY_FIXED: bool, const MEDIUM: bool>(
        &self,
        dt: f64,
        rotors: &RotorWrench,
        force_world: &Vector3<f64>,
        state: &DroneState,
    ) -> DroneState {
        let torque = rotors.torque_body.to_flight();
        let push = Push { thrust: rotors.thrust, torque, force: force_world.to_flight() };
        self.0.rk4::<BODY_FIXED, MEDIUM>(dt, &push, &FlightState::from(state)).into()
    }
}
