use nalgebra::Vector3;

use super::attitude::attitude_along;
use super::{
    AttitudeControl, AttitudeGains, ControlMemory, ControlOutput, Controller, Goal, LaneController, Reference, Target,
    run,
};
use crate::drone::{DroneParams, GRAVITY};
use crate::math::{Real, ToFlight as _, ToNalgebra as _, V3, Weighted as _};
use crate::state::{DroneState, FlightState};

/// Gains of the position loop along the world axes: accelerations per m, per m·s and per m/s.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct PositionGains {
    /// Proportional gain, 1/s².
    #[serde(with = "crate::serial::vector")]
    pub proportional: Vector3<f64>,
    /// Integral gain, 1/s³.
    #[serde(with = "crate::serial::vector")]
    pub integral: Vector3<f64>,
    /// Derivative gain, 1/s.
    #[serde(with = "crate::serial::vector")]
    pub derivative: Vector3<f64>,
    /// Limit of each component of the integrated error, m·s.
    pub integral_clamp: f64,
}

/// Gains of the position and attitude loops of a [`PidControl`].
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
    /// Gains of the position loop (outer loop, world frame).
    pub position: PositionGains,
    /// Gains of the attitude loop (inner loop, body frame).
    pub attitude: AttitudeGains,
}

impl PidGains {
    /// Returns the gains of the paper's PID table for an airframe.
    ///
    /// The torque gains belong to the Crazyflie and are scaled to other airframes as in [`AttitudeGains::paper`].
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

/// Cascaded PID of the paper's §4.2: position loop, attitude loop, mixer.
///
/// The position loop computes the target acceleration a\* = Kp·e + Ki·∫e + Kd·ė + g·ẑ and limits its direction to
/// [`MAX_TILT`](Self::MAX_TILT) from the vertical. The collective thrust is m‖a\*‖. The attitude loop
/// ([`AttitudeControl`]) turns body z to the direction of a\* and body x to the reference yaw.
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
    /// Largest angle between the target thrust and the vertical, rad, for position errors of any size.
    pub const MAX_TILT: f64 = std::f64::consts::FRAC_PI_3;

    /// Smallest vertical component of the target acceleration, as a fraction of g. A negative one would flip the
    /// direction of the thrust.
    const MIN_LIFT: f64 = 0.2;

    /// Creates a controller with [the paper's gains](PidGains::paper).
    pub fn new(params: &DroneParams) -> Self {
        Self::with_gains(params, PidGains::paper(params))
    }

    /// Creates a controller with the given gains.
    pub fn with_gains(params: &DroneParams, gains: PidGains) -> Self {
        Self {
            gains: gains.position,
            mass: params.mass,
            attitude: AttitudeControl::with_gains(params, gains.attitude),
            position_integral: Vector3::zeros(),
        }
    }

    /// Returns the gains.
    pub fn gains(&self) -> PidGains {
        PidGains { position: self.gains, attitude: *self.attitude.gains() }
    }

    /// Replaces the gains. The integrals stay the same.
    pub fn set_gains(&mut self, gains: PidGains) {
        self.gains = gains.position;
        self.attitude.set_gains(gains.attitude);
    }

    /// Tracks a target with a feed-forward acceleration (world frame, m/s²). Position errors above `integrated` metres
    /// do not enter the integral.
    #[inline(always)]
    pub(super) fn follow<R: Real>(
        &self,
        dt: f64,
        memory: &mut ControlMemory<R>,
        state: &FlightState<R>,
        target: &Target<R>,
        feed_forward: V3<R>,
        integrated: f64,
    ) -> [R; 4] {
        let (position_error, velocity_error) = (target.position - state.position, target.velocity - state.velocity);
        let is_large = target.yaw.all(integrated).less(position_error.norm());
        let integral = (memory.position_integral + position_error * dt).clamped(self.gains.integral_clamp);
        memory.position_integral = V3::choose(is_large, memory.position_integral, integral);
        let acceleration = self.position_loop(memory.position_integral, position_error, velocity_error, feed_forward);
        let wanted = attitude_along(acceleration, target.yaw);
        // the yaw rate is a rotation about world z
        let body_rate = wanted.back(V3::vertical(target.yaw_rate));
        let thrust = acceleration.norm() * self.mass;
        self.attitude.track(dt, &mut memory.attitude_integral, state, thrust, &wanted, body_rate)
    }

    /// Returns the target acceleration of the thrust, world frame, m/s².
    #[inline(always)]
    fn position_loop<R: Real>(
        &self,
        integral: V3<R>,
        error: V3<R>,
        velocity_error: V3<R>,
        feed_forward: V3<R>,
    ) -> V3<R> {
        let gains = &self.gains;
        let mut wanted = error.weighted(&gains.proportional)
            + integral.weighted(&gains.integral)
            + velocity_error.weighted(&gains.derivative)
            + feed_forward;
        wanted.z = wanted.z + GRAVITY;
        let min_lift = wanted.z.all(Self::MIN_LIFT * GRAVITY);
        wanted.z = R::choose(wanted.z.less(min_lift), min_lift, wanted.z);
        let (sideways, max) = (wanted.level_norm(), wanted.z * Self::MAX_TILT.tan());
        let (is_tilted, share) = (max.less(sideways), max / sideways);
        wanted.x = R::choose(is_tilted, wanted.x * share, wanted.x);
        wanted.y = R::choose(is_tilted, wanted.y * share, wanted.y);
        wanted
    }
}

impl LaneController for PidControl {
    fn memory(&self) -> ControlMemory<f64> {
        ControlMemory {
            position_integral: self.position_integral.to_flight(),
            attitude_integral: self.attitude.integral(),
            ..ControlMemory::default()
        }
    }

    fn set_memory(&mut self, memory: &ControlMemory<f64>) {
        self.position_integral = memory.position_integral.to_nalgebra();
        self.attitude.set_integral(memory.attitude_integral);
    }

    #[inline(always)]
    fn track<R: Real>(
        &self,
        dt: f64,
        memory: &mut ControlMemory<R>,
        state: &FlightState<R>,
        target: &Target<R>,
        _: Goal,
    ) -> [R; 4] {
        self.follow(dt, memory, state, target, V3::zero(target.yaw), f64::INFINITY)
    }
}

impl Controller for PidControl {
    fn reset(&mut self) {
        self.position_integral = Vector3::zeros();
        self.attitude.reset();
    }

    fn control(&mut self, dt: f64, state: &DroneState, reference: &Reference) -> ControlOutput {
        run(self, dt, state, reference, Goal::Position)
    }

    /// Returns the integrals of the position errors and of the attitude errors.
    fn internal_state(&self) -> Vec<f64> {
        self.memory().integrals().into()
    }

    fn set_internal_state(&mut self, state: &[f64]) -> bool {
        let Ok(integrals) = state.try_into() else { return false };
        self.set_memory(&ControlMemory::of_integrals(integrals));
        true
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
        fn thrust_direction_stays_within_the_maximum_tilt(
            x in -1e3..1e3, y in -1e3..1e3, z in -1e3..1e3, vx in -50.0..50.0, vz in -50.0..50.0,
        ) {
            let pid = PidControl::new(&DroneModel::Cf2x.params());
            let none = V3::zero(0.0);
            let wanted = pid.position_loop(none, V3::new(x, y, z), V3::new(vx, 0.0, vz), none);
            let tilt = (wanted.z / wanted.norm()).acos();
            prop_assert!(tilt <= PidControl::MAX_TILT + 1e-9, "{tilt}");
        }

        #[test]
        fn torques_reduce_the_attitude_error(roll in -1.0..1.0, pitch in -1.0..1.0, yaw in -3.0..3.0) {
            let params = DroneModel::Race.params();
            let mut pid = PidControl::new(&params);
            let attitude = attitude_from_rpy(Vector3::new(roll, pitch, yaw));
            let state = DroneState { attitude, ..DroneState::default() };
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
    fn integral_is_clamped_and_cleared_by_reset() {
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
    fn nan_in_the_reference_returns_nan_speeds() {
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
    fn torque_gains_scale_with_the_inertia() {
        let race = DroneModel::Race.params();
        let gains = PidGains::paper(&race);
        assert!((gains.attitude.proportional.x - 2e-3 * 4.86e-4 / 1.4e-5).abs() < 1e-12);
        assert!((gains.attitude.derivative.z - 2e-4 * 8.80e-4 / 2.17e-5).abs() < 1e-12);
        assert_eq!(gains.position, PidGains::paper(&DroneModel::Cf2x.params()).position);
    }
}
