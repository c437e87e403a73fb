//! Forces and torques that a file of an airframe adds: linear drag, translational lift, the torque of a velocity,
//! rotational damping, trim, and the angular momentum of the rotors.
//!
//! With the velocity v relative to the air and the body rate ω, both in the body frame, and the angular momentum H of
//! the rotors about body z:
//!
//! ```text
//! F    = −diag(d)·v                                 drag, body frame
//! T   += c·(v_x² + v_y²)                            translational lift
//! τ   += c_m·(v_y, −v_x, 0) − diag(d_r)·ω + τ_trim   air and trim, body frame
//! τ   += −ω × H·ẑ − dH/dt·ẑ                         gyroscopic torque, reaction torque of spinning up
//! H    = J_r·Σ sᵢ·2π/60·nᵢ                          sᵢ: direction of rotation, opposite to the reaction torque
//! ```
//!
//! Like blade drag, they follow from the state at the start of a physics step and stay constant during the step.

use flight::airframe::{self, AirframeMotion};
use nalgebra::Vector3;

use super::rotor::RotorWrench;
use crate::drone::DroneParams;
use crate::math::{ToFlight as _, ToNalgebra as _};
use crate::state::DroneState;

/// Coefficients of the forces and torques of an airframe in [`AirParams`](crate::drone::AirParams) and of its rotors'
/// inertia.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct AirframeEffects(pub(crate) airframe::AirframeEffects);

impl AirframeEffects {
    /// Creates the coefficients of an airframe.
    #[must_use]
    pub fn new(params: &DroneParams) -> Self {
        let air = &params.air;
        Self(airframe::AirframeEffects {
            linear_drag: air.linear_drag,
            translational_lift: air.translational_lift,
            velocity_moment: air.velocity_moment,
            rotational_damping: air.rotational_damping,
            trim_torque: air.trim_torque,
            momentum_per_rpm: params.yaw_convention.sign()
                * params.motors.rotor_inertia
                * (std::f64::consts::TAU / 60.0),
        })
    }

    /// Adds the effects of a physics step of `dt` seconds to the wrench of the rotors, and returns the drag, world
    /// frame, N.
    ///
    /// `state` is that at the start of the step, `air` the velocity of the air (world frame, m/s), `rpm` the rotor
    /// speeds in the physics step before and in this one.
    ///
    /// ```
    /// use aviary::drone::{AirParams, DroneModel, DroneParams};
    /// use aviary::physics::airframe::AirframeEffects;
    /// use aviary::physics::rotor::RotorModel;
    /// use aviary::state::DroneState;
    /// use nalgebra::Vector3;
    ///
    /// let air = AirParams { linear_drag: [0.02, 0.03, 0.0], ..AirParams::default() };
    /// let params = DroneParams { air, ..DroneModel::Cf2x.params() };
    /// let state = DroneState { velocity: Vector3::new(1.0, -1.0, 5.0), ..DroneState::default() };
    /// let rpm = [params.hover_rpm(); 4];
    /// let mut wrench = RotorModel::new(&params).wrench(&rpm);
    /// let drag = AirframeEffects::new(&params).change(1.0 / 240.0, &state, &Vector3::zeros(), [&rpm; 2], &mut wrench);
    /// assert!((drag - Vector3::new(-0.02, 0.03, 0.0)).norm() < 1e-15);
    /// ```
    #[inline]
    pub fn change(
        &self,
        dt: f64,
        state: &DroneState,
        air: &Vector3<f64>,
        rpm: [&[f64; 4]; 2],
        rotors: &mut RotorWrench,
    ) -> Vector3<f64> {
        let motion = AirframeMotion {
            attitude: &state.attitude.to_flight(),
            relative: state.velocity.to_flight() - air.to_flight(),
            rate: state.angular_velocity.to_flight(),
            momentum: rpm.map(|rpm| self.0.momentum(rpm)),
        };
        let mut torque = rotors.torque_body.to_flight();
        let drag = self.0.add(dt, &motion, &mut rotors.thrust, &mut torque);
        rotors.torque_body = torque.to_nalgebra();
        drag.to_nalgebra()
    }

    /// Creates the coefficients of an airframe; `None` if none of them has an effect.
    pub(crate) fn of_params(params: &DroneParams) -> Option<Self> {
        Some(Self::new(params)).filter(|effects| !effects.are_absent())
    }

    /// Returns true if no coefficient has an effect.
    pub fn are_absent(&self) -> bool {
        *self == Self::default()
    }
}
