use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};

use super::Mixer;
use crate::drone::{DroneModel, DroneParams};
use crate::state::{DroneState, wrap_angle};

/// Gains of the attitude loop: torques per rad, per rad·s and per rad/s, about the body axes.
///
/// ```
/// use aviary::control::AttitudeGains;
/// use aviary::drone::DroneModel;
///
/// let [crazyflie, racer] = [DroneModel::Cf2x, DroneModel::Race].map(DroneModel::params);
/// let ratio = racer.inertia[0] / crazyflie.inertia[0];
/// let (soft, strong) = (AttitudeGains::paper(&crazyflie), AttitudeGains::paper(&racer));
/// assert!((strong.proportional.x / soft.proportional.x - ratio).abs() < 1e-9);
/// ```
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct AttitudeGains {
    /// Proportional, N·m/rad.
    #[serde(with = "crate::serial::vector")]
    pub proportional: Vector3<f64>,
    /// Integral, N·m/(rad·s).
    #[serde(with = "crate::serial::vector")]
    pub integral: Vector3<f64>,
    /// Derivative, N·m/(rad/s).
    #[serde(with = "crate::serial::vector")]
    pub derivative: Vector3<f64>,
    /// Limit of each component of the integrated error, rad·s.
    pub integral_clamp: f64,
}

impl AttitudeGains {
    /// The paper's gains (its PID table) for an airframe.
    ///
    /// They belong to the Crazyflie; another airframe's are scaled by the ratio of the inertias, axis by axis, so that
    /// its attitude answers with the same time constants.
    pub fn paper(params: &DroneParams) -> Self {
        Self::of_crazyflie(params, [2e-3, 2e-3, 1e-3], [0.0, 0.0, 1e-4], [5e-4, 5e-4, 2e-4], 0.5)
    }

    /// From torque gains that suit the Crazyflie.
    pub(super) fn of_crazyflie(
        params: &DroneParams,
        proportional: [f64; 3],
        integral: [f64; 3],
        derivative: [f64; 3],
        integral_clamp: f64,
    ) -> Self {
        let crazyflie = DroneModel::Cf2x.params().inertia_vector();
        let ratio = params.inertia_vector().component_div(&crazyflie);
        let torque = |gain: [f64; 3]| Vector3::from(gain).component_mul(&ratio);
        Self {
            proportional: torque(proportional),
            integral: torque(integral),
            derivative: torque(derivative),
            integral_clamp,
        }
    }
}

/// The attitude stage of the cascade: holds an attitude under a collective thrust.
///
/// Torques come from the rotation that is left, as a rotation vector (the same as the small-angle roll, pitch and yaw
/// errors near hover, and right at any attitude), from its integral and from the error of the body rates.
///
/// ```
/// use aviary::control::AttitudeControl;
/// use aviary::drone::DroneModel;
/// use aviary::state::{DroneState, attitude_from_rpy};
/// use nalgebra::Vector3;
///
/// let params = DroneModel::Cf2x.params();
/// let mut attitude = AttitudeControl::new(&params);
/// let leaning = attitude_from_rpy(Vector3::new(0.1, 0.0, 0.0));
/// let rpm = attitude.control(1.0 / 48.0, &DroneState::default(), params.weight(), &leaning, &Vector3::zeros());
/// assert!(rpm[0] > rpm[3], "the left motors push to the right");
/// ```
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct AttitudeControl {
    gains: AttitudeGains,
    mixer: Mixer,
    #[serde(with = "crate::serial::vector")]
    integral: Vector3<f64>,
}

impl AttitudeControl {
    /// With the paper's gains.
    pub fn new(params: &DroneParams) -> Self {
        Self::with_gains(params, AttitudeGains::paper(params))
    }

    /// With gains of one's own.
    pub fn with_gains(params: &DroneParams, gains: AttitudeGains) -> Self {
        Self { gains, mixer: Mixer::new(params), integral: Vector3::zeros() }
    }

    /// The gains.
    pub fn gains(&self) -> &AttitudeGains {
        &self.gains
    }

    /// Forgets the integral.
    pub fn reset(&mut self) {
        self.integral = Vector3::zeros();
    }

    /// Motor speeds (rpm) for the coming control step of `dt` seconds: a collective thrust (N) along body z, and torques
    /// that turn the body to `attitude` (body to world) and to `body_rate` (body frame, rad/s).
    ///
    /// What is not a number gives speeds that are not numbers, and leaves the controller as it was.
    pub fn control(
        &mut self,
        dt: f64,
        state: &DroneState,
        thrust: f64,
        attitude: &UnitQuaternion<f64>,
        body_rate: &Vector3<f64>,
    ) -> [f64; 4] {
        let error = (state.attitude.inverse() * attitude).scaled_axis();
        let rate_error = body_rate - state.angular_velocity;
        let integral = clamped(self.integral + error * dt, self.gains.integral_clamp);
        let torque = self.gains.proportional.component_mul(&error)
            + self.gains.integral.component_mul(&integral)
            + self.gains.derivative.component_mul(&rate_error);
        let rpm = self.mixer.rpm(thrust, torque);
        if rpm[0].is_finite() {
            self.integral = integral;
        }
        rpm
    }
}

/// A yaw that is held, and turned at a commanded rate.
///
/// ```
/// use aviary::control::HeadingHold;
/// use aviary::state::DroneState;
///
/// let (mut hold, facing_x) = (HeadingHold::default(), DroneState::default());
/// assert!((hold.advance(0.1, &facing_x, 0.5) - 0.05).abs() < 1e-12);
/// // a drone that does not turn is waited for
/// for _ in 0..100 {
///     hold.advance(0.1, &facing_x, 0.5);
/// }
/// assert!((hold.advance(0.1, &facing_x, 0.5) - HeadingHold::MAX_LEAD).abs() < 1e-12);
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Default, serde::Serialize, serde::Deserialize)]
pub struct HeadingHold {
    yaw: Option<f64>,
}

impl HeadingHold {
    /// The held yaw never runs further ahead of the drone's than this, rad: a yaw that the motors cannot follow must not
    /// wind up.
    pub const MAX_LEAD: f64 = std::f64::consts::FRAC_PI_4;

    /// Forgets the yaw: the next one to be held is the drone's.
    pub fn reset(&mut self) {
        self.yaw = None;
    }

    /// The yaw to hold (rad) at the end of a control step of `dt` seconds in which it turns at `rate` rad/s.
    pub fn advance(&mut self, dt: f64, state: &DroneState, rate: f64) -> f64 {
        let actual = state.yaw();
        let lead = wrap_angle(self.yaw.unwrap_or(actual) + rate * dt - actual);
        let yaw = wrap_angle(actual + lead.clamp(-Self::MAX_LEAD, Self::MAX_LEAD));
        if yaw.is_finite() {
            self.yaw = Some(yaw);
        }
        yaw
    }
}

/// Every component within ±`limit`; what is not a number stays that.
pub(super) fn clamped(vector: Vector3<f64>, limit: f64) -> Vector3<f64> {
    vector.map(|x| {
        if x > limit {
            limit
        } else if x < -limit {
            -limit
        } else {
            x
        }
    })
}

/// The attitude whose z axis points along `up`, which lies above the horizon, and whose yaw is `yaw`.
pub(super) fn attitude_along(up: &Vector3<f64>, yaw: f64) -> UnitQuaternion<f64> {
    let z = up.normalize();
    // body x has no part along the heading's left: only so is the yaw of roll-pitch-yaw the one asked for
    let left = Vector3::new(-yaw.sin(), yaw.cos(), 0.0);
    let x = left.cross(&z).normalize();
    let y = z.cross(&x);
    UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[x, y, z])))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn wanted_attitude_has_its_z_along_the_acceleration_and_its_yaw(x in -5.0..5.0, y in -5.0..5.0, yaw in -3.0..3.0) {
            let up = Vector3::new(x, y, 9.81);
            let attitude = attitude_along(&up, yaw);
            prop_assert!((attitude * Vector3::z() - up.normalize()).norm() < 1e-9);
            let forward = attitude * Vector3::x();
            prop_assert!(wrap_angle(forward.y.atan2(forward.x) - yaw).abs() < 1e-9);
        }

    }

    #[test]
    fn a_held_heading_turns_at_its_rate_and_never_far_ahead() {
        let mut hold = HeadingHold::default();
        let state = DroneState::at_rest(Vector3::zeros(), Vector3::new(0.1, 0.0, 3.1));
        assert!((hold.advance(0.1, &state, 0.5) - wrap_angle(3.15)).abs() < 1e-12, "across ±π");
        for _ in 0..100 {
            hold.advance(0.1, &state, 0.5);
        }
        let lead = wrap_angle(hold.advance(0.1, &state, 0.5) - 3.1);
        assert!((lead - HeadingHold::MAX_LEAD).abs() < 1e-12, "{lead}");
        hold.reset();
        assert!((hold.advance(0.1, &state, 0.0) - 3.1).abs() < 1e-12);
    }

    #[test]
    fn numbers_that_are_none_never_enter_the_memory() {
        let params = DroneModel::Cf2x.params();
        let mut control = AttitudeControl::new(&params);
        let before = control.clone();
        let level = UnitQuaternion::identity();
        let state = DroneState::default();
        for (dt, thrust, rate) in [(f64::NAN, 0.3, 0.0), (0.02, f64::NAN, 0.0), (0.02, 0.3, f64::INFINITY)] {
            let rpm = control.control(dt, &state, thrust, &level, &Vector3::repeat(rate));
            assert!(rpm.iter().all(|n| n.is_nan()));
            assert_eq!(control, before);
        }
        let mut hold = HeadingHold::default();
        assert!(hold.advance(0.02, &state, f64::NAN).is_nan());
        assert_eq!(hold, HeadingHold::default());
    }
}
