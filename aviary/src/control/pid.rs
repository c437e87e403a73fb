use nalgebra::Vector3;

use super::attitude::{attitude_along, clamped};
use super::{AttitudeControl, AttitudeGains, ControlOutput, Controller, Reference};
use crate::drone::{DroneParams, GRAVITY};
use crate::state::DroneState;

/// Gains of the position loop: accelerations per m, per m·s and per m/s.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct PositionGains {
    /// Proportional, 1/s².
    #[serde(with = "crate::serial::vector")]
    pub proportional: Vector3<f64>,
    /// Integral, 1/s³.
    #[serde(with = "crate::serial::vector")]
    pub integral: Vector3<f64>,
    /// Derivative, 1/s.
    #[serde(with = "crate::serial::vector")]
    pub derivative: Vector3<f64>,
    /// Limit of each component of the integrated error, m·s.
    pub integral_clamp: f64,
}

/// Gains of the cascade.
///
/// ```
/// use aviary::control::{PidControl, PidGains};
/// use aviary::drone::DroneModel;
///
/// let params = DroneModel::Cf2x.params();
/// let mut gains = PidGains::paper(&params);
/// gains.position.integral.z = 0.1;
/// let pid = PidControl::with_gains(&params, gains);
/// assert_eq!(pid.gains().position.integral.z, 0.1);
/// ```
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct PidGains {
    /// Outer loop, world frame.
    pub position: PositionGains,
    /// Inner loop, body frame.
    pub attitude: AttitudeGains,
}

impl PidGains {
    /// The paper's gains (its PID table) for an airframe.
    ///
    /// The torque gains belong to the Crazyflie; another airframe's are scaled by the ratio of the inertias, axis by
    /// axis, so that its attitude answers with the same time constants.
    pub fn paper(params: &DroneParams) -> Self {
        Self {
            position: PositionGains {
                proportional: Vector3::new(0.4, 0.4, 1.0),
                integral: Vector3::new(0.01, 0.01, 0.01),
                derivative: Vector3::new(0.9, 0.9, 2.0),
                integral_clamp: 2.0,
            },
            attitude: AttitudeGains::paper(params),
        }
    }
}

/// The cascaded PID of the paper's §4.2: position loop, attitude loop, mixer.
///
/// The position loop asks for the acceleration a* = Kp·e + Ki·∫e + Kd·ė + g·ẑ. Thrust is m‖a*‖ along the direction of
/// a*, which is held within [`MAX_TILT`](Self::MAX_TILT) of the vertical; the attitude loop turns the body there by
/// torques from the rotation that is left (as a rotation vector, the same as the small-angle roll, pitch and yaw
/// errors near hover and right at any attitude) and from the measured body rates.
///
/// ```
/// use aviary::control::{Controller, PidControl, Reference};
/// use aviary::drone::DroneModel;
/// use aviary::state::DroneState;
/// use nalgebra::Vector3;
///
/// let params = DroneModel::Cf2x.params();
/// let mut pid = PidControl::new(&params);
/// let here = DroneState::default();
/// let output = pid.control(1.0 / 48.0, &here, &Reference::hover(Vector3::zeros(), 0.0));
/// assert!((output.rpm[0] - params.hover_rpm()).abs() < 1e-6);
/// ```
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct PidControl {
    gains: PositionGains,
    mass: f64,
    attitude: AttitudeControl,
    #[serde(with = "crate::serial::vector")]
    position_integral: Vector3<f64>,
}

impl PidControl {
    /// The thrust never points further from the vertical than this, rad: an error of any size leans the drone, it
    /// does not lay it on its side.
    pub const MAX_TILT: f64 = std::f64::consts::FRAC_PI_3;

    /// Least vertical acceleration the position loop asks for, as a share of g: it never pushes downwards, where the
    /// direction of the thrust would turn over.
    const MIN_LIFT: f64 = 0.2;

    /// With the paper's gains.
    pub fn new(params: &DroneParams) -> Self {
        Self::with_gains(params, PidGains::paper(params))
    }

    /// With gains of one's own.
    pub fn with_gains(params: &DroneParams, gains: PidGains) -> Self {
        Self {
            gains: gains.position,
            mass: params.mass,
            attitude: AttitudeControl::with_gains(params, gains.attitude),
            position_integral: Vector3::zeros(),
        }
    }

    /// The gains.
    pub fn gains(&self) -> PidGains {
        PidGains { position: self.gains, attitude: *self.attitude.gains() }
    }

    /// Follows a reference, with an acceleration (world, m/s²) added to what the position loop asks for; the position's
    /// integral grows by the errors within `integrated` metres only.
    pub(super) fn follow(
        &mut self,
        dt: f64,
        state: &DroneState,
        reference: &Reference,
        feed_forward: &Vector3<f64>,
        integrated: f64,
    ) -> ControlOutput {
        let output = ControlOutput::of_errors(state, reference);
        if !(state.is_finite() && reference.is_finite() && dt > 0.0 && dt.is_finite()) {
            // what is not a number must not enter the integrals, from which only a reset would remove it
            return output;
        }
        let velocity_error = reference.velocity - state.velocity;
        let position_error = output.position_error;
        if position_error.norm() <= integrated {
            let clamp = self.gains.integral_clamp;
            self.position_integral = clamped(self.position_integral + position_error * dt, clamp);
        }
        let acceleration = self.position_loop(&position_error, &velocity_error, feed_forward);
        let wanted = attitude_along(&acceleration, reference.yaw);
        // yaw turns about world z, whatever the roll and pitch
        let body_rate = wanted.inverse_transform_vector(&Vector3::new(0.0, 0.0, reference.yaw_rate));
        let rpm = self.attitude.control(dt, state, self.mass * acceleration.norm(), &wanted, &body_rate);
        ControlOutput { rpm, ..output }
    }

    /// Acceleration to be produced by the thrust, world frame, m/s².
    fn position_loop(
        &self,
        error: &Vector3<f64>,
        velocity_error: &Vector3<f64>,
        feed_forward: &Vector3<f64>,
    ) -> Vector3<f64> {
        let gains = &self.gains;
        let mut wanted = gains.proportional.component_mul(error)
            + gains.integral.component_mul(&self.position_integral)
            + gains.derivative.component_mul(velocity_error)
            + feed_forward
            + Vector3::new(0.0, 0.0, GRAVITY);
        if wanted.z < Self::MIN_LIFT * GRAVITY {
            wanted.z = Self::MIN_LIFT * GRAVITY;
        }
        let sideways = wanted.xy().norm();
        let max = wanted.z * Self::MAX_TILT.tan();
        if sideways > max {
            wanted.x *= max / sideways;
            wanted.y *= max / sideways;
        }
        wanted
    }
}

impl Controller for PidControl {
    fn reset(&mut self) {
        self.position_integral = Vector3::zeros();
        self.attitude.reset();
    }

    fn control(&mut self, dt: f64, state: &DroneState, reference: &Reference) -> ControlOutput {
        self.follow(dt, state, reference, &Vector3::zeros(), f64::INFINITY)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::drone::DroneModel;
    use crate::physics::rotor::RotorModel;
    use crate::state::attitude_from_rpy;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn thrust_direction_stays_above_the_horizon_for_any_error(
            x in -1e3..1e3, y in -1e3..1e3, z in -1e3..1e3, vx in -50.0..50.0, vz in -50.0..50.0,
        ) {
            let pid = PidControl::new(&DroneModel::Cf2x.params());
            let wanted = pid.position_loop(&Vector3::new(x, y, z), &Vector3::new(vx, 0.0, vz), &Vector3::zeros());
            let tilt = (wanted.z / wanted.norm()).acos();
            prop_assert!(tilt <= PidControl::MAX_TILT + 1e-9, "{tilt}");
        }

        /// From any attitude the torque turns the drone upright the shorter way.
        #[test]
        fn torques_turn_the_body_towards_the_error(roll in -1.0..1.0, pitch in -1.0..1.0, yaw in -3.0..3.0) {
            let params = DroneModel::Race.params();
            let mut pid = PidControl::new(&params);
            let state = DroneState { attitude: attitude_from_rpy(Vector3::new(roll, pitch, yaw)), ..DroneState::default() };
            let output = pid.control(0.02, &state, &Reference::hover(Vector3::zeros(), yaw));
            let torque = RotorModel::new(&params).wrench(&output.rpm).torque_body;
            let error = state.attitude.inverse() * attitude_from_rpy(Vector3::new(0.0, 0.0, yaw));
            if error.angle() > 1e-3 {
                let axis = error.scaled_axis();
                prop_assert!(torque.x * axis.x >= 0.0 && torque.y * axis.y >= 0.0, "{torque} {axis}");
            }
        }
    }

    #[test]
    fn the_integral_is_clamped_and_a_reset_clears_it() {
        let params = DroneModel::Cf2x.params();
        let mut pid = PidControl::new(&params);
        let reference = Reference::hover(Vector3::new(0.0, 0.0, 10.0), 0.0);
        let first = pid.control(0.02, &DroneState::default(), &reference);
        for _ in 0..1000 {
            pid.control(0.02, &DroneState::default(), &reference);
        }
        assert_eq!(pid.position_integral.z, 2.0);
        pid.reset();
        assert_eq!(pid.control(0.02, &DroneState::default(), &reference), first);
    }

    #[test]
    fn a_reference_or_state_that_is_not_a_number_gives_no_speed() {
        let mut pid = PidControl::new(&DroneModel::Cf2x.params());
        for axis in 0..3 {
            let mut target = Vector3::z();
            target[axis] = f64::NAN;
            pid.reset();
            let output = pid.control(0.02, &DroneState::default(), &Reference::hover(target, 0.0));
            assert!(output.rpm.iter().all(|n| n.is_nan()), "axis {axis}: {:?}", output.rpm);
        }
        pid.reset();
        let output = pid.control(0.02, &DroneState::default(), &Reference::hover(Vector3::z(), f64::NAN));
        assert!(output.rpm.iter().all(|n| n.is_nan()));
    }

    #[test]
    fn torque_gains_follow_the_inertia() {
        let race = DroneModel::Race.params();
        let gains = PidGains::paper(&race);
        assert!((gains.attitude.proportional.x - 2e-3 * 4.86e-4 / 1.4e-5).abs() < 1e-12);
        assert!((gains.attitude.derivative.z - 2e-4 * 8.80e-4 / 2.17e-5).abs() < 1e-12);
        assert_eq!(gains.position, PidGains::paper(&DroneModel::Cf2x.params()).position);
    }
}
