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

use nalgebra::Vector3;

use super::rotor::RotorWrench;
use crate::drone::DroneParams;
use crate::math::{Real, Turn, V3};
use crate::state::DroneState;

/// Coefficients of the forces and torques of an airframe in [`AirParams`](crate::drone::AirParams) and of its rotors'
/// inertia, scalar or SIMD.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct AirframeEffects<R = f64> {
    /// Linear drag along the body axes, N/(m/s).
    pub(crate) linear_drag: [R; 3],
    /// Translational lift, N/(m/s)².
    pub(crate) translational_lift: R,
    /// Torque about roll and pitch by a velocity, N·m/(m/s).
    pub(crate) velocity_moment: R,
    /// Damping of a body rate, N·m/(rad/s).
    pub(crate) rotational_damping: [R; 3],
    /// Constant torque, body frame, N·m.
    pub(crate) trim_torque: [R; 3],
    /// Angular momentum of rotor 0 per speed, about body z, N·m·s/rpm. That of rotors 1 and 3 has the other sign.
    pub(crate) momentum_per_rpm: R,
}

/// Number of coefficients of [`AirframeEffects`].
pub(crate) const EFFECTS: usize = 12;

/// Motion of a drone in [`AirframeEffects::add`] at the start of a physics step, scalar or SIMD.
#[derive(Debug, Clone, Copy)]
pub(crate) struct AirframeMotion<'a, R> {
    /// Attitude.
    pub attitude: &'a Turn<R>,
    /// Velocity relative to the air, world frame, m/s.
    pub relative: V3<R>,
    /// Body rate, rad/s.
    pub rate: V3<R>,
    /// Angular momentum of the rotors in the physics step before and in this one, about body z, N·m·s.
    pub momentum: [R; 2],
}

impl AirframeEffects {
    /// Creates the coefficients of an airframe.
    #[must_use]
    pub fn new(params: &DroneParams) -> Self {
        let air = &params.air;
        Self {
            linear_drag: air.linear_drag,
            translational_lift: air.translational_lift,
            velocity_moment: air.velocity_moment,
            rotational_damping: air.rotational_damping,
            trim_torque: air.trim_torque,
            momentum_per_rpm: params.yaw_convention.sign()
                * params.motors.rotor_inertia
                * (std::f64::consts::TAU / 60.0),
        }
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
            attitude: &Turn::from(&state.attitude),
            relative: V3::from(&state.velocity) - V3::from(air),
            rate: V3::from(&state.angular_velocity),
            momentum: rpm.map(|rpm| self.momentum(rpm)),
        };
        let mut torque = V3::from(&rotors.torque_body);
        let drag = self.add(dt, &motion, &mut rotors.thrust, &mut torque);
        rotors.torque_body = torque.into();
        drag.into()
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

#[allow(private_bounds)] // scalar or SIMD
impl<R: Real> AirframeEffects<R> {
    /// Returns all coefficients, in the order of [`of`](Self::of).
    pub(crate) fn numbers(&self) -> [R; EFFECTS] {
        let Self { linear_drag: [a, b, c], rotational_damping: [d, e, f], trim_torque: [g, h, i], .. } = *self;
        [a, b, c, d, e, f, g, h, i, self.translational_lift, self.velocity_moment, self.momentum_per_rpm]
    }

    /// Creates the effects of [`numbers`](Self::numbers).
    #[inline(always)]
    pub(crate) fn of([a, b, c, d, e, f, g, h, i, lift, moment, momentum]: [R; EFFECTS]) -> Self {
        Self {
            linear_drag: [a, b, c],
            rotational_damping: [d, e, f],
            trim_torque: [g, h, i],
            translational_lift: lift,
            velocity_moment: moment,
            momentum_per_rpm: momentum,
        }
    }

    /// Returns the angular momentum of the rotors at these speeds (rpm) about body z, N·m·s.
    #[inline(always)]
    pub(crate) fn momentum(&self, rpm: &[R; 4]) -> R {
        self.momentum_per_rpm * (rpm[0] - rpm[1] + rpm[2] - rpm[3])
    }

    /// Adds the effects of a physics step of `dt` seconds to the rotors' thrust (N) and torque (body frame, N·m), and
    /// returns the drag, world frame, N.
    #[inline(always)]
    pub(crate) fn add(&self, dt: f64, motion: &AirframeMotion<'_, R>, thrust: &mut R, torque: &mut V3<R>) -> V3<R> {
        let (v, rate, [before, now]) = (motion.attitude.back(motion.relative), motion.rate, motion.momentum);
        let [damping, trim] = [self.rotational_damping, self.trim_torque];
        *thrust = *thrust + self.translational_lift * (v.x * v.x + v.y * v.y);
        torque.x = torque.x + (self.velocity_moment * v.y - damping[0] * rate.x + trim[0] - now * rate.y);
        torque.y = torque.y + (trim[1] - self.velocity_moment * v.x - damping[1] * rate.y + now * rate.x);
        torque.z = torque.z + (trim[2] - damping[2] * rate.z - (now - before) * (1.0 / dt));
        let [x, y, z] = self.linear_drag;
        motion.attitude.forth(-V3::new(x * v.x, y * v.y, z * v.z))
    }
}
