use nalgebra::{UnitQuaternion, Vector3};

use super::Mixer;
use super::memory::{is_finite, is_set};
use crate::drone::{DroneModel, DroneParams};
use crate::math::{Real, ToFlight as _, ToNalgebra as _, Turn, V3, Weighted as _, clamped, sin_cos, wrap_angle};
use crate::state::{DroneState, FlightState};

/// Gains of the attitude loop about the body axes: torques per rad, per rad·s and per rad/s.
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
    /// Proportional gain, N·m/rad.
    #[serde(with = "crate::serial::vector")]
    pub proportional: Vector3<f64>,
    /// Integral gain, N·m/(rad·s).
    #[serde(with = "crate::serial::vector")]
    pub integral: Vector3<f64>,
    /// Derivative gain, N·m/(rad/s).
    #[serde(with = "crate::serial::vector")]
    pub derivative: Vector3<f64>,
    /// Limit of each component of the integrated error, rad·s.
    pub integral_clamp: f64,
}

impl AttitudeGains {
    /// Returns the gains of the paper's PID table for an airframe.
    ///
    /// The table belongs to the Crazyflie. For another airframe each gain is scaled by the ratio of the moments of
    /// inertia about its axis, so that the time constants of the attitude stay the same.
    pub fn paper(params: &DroneParams) -> Self {
        Self::of_crazyflie(params, [2e-3, 2e-3, 1e-3], [0.0, 0.0, 1e-4], [5e-4, 5e-4, 2e-4], 0.5)
    }

    /// Scales gains of the Crazyflie to the inertia of an airframe.
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

/// Attitude loop of the cascade: tracks an attitude at a given collective thrust.
///
/// The torque is a PID law on the rotation vector from the actual to the target attitude and on the body-rate error.
/// Near hover the rotation vector equals the roll, pitch and yaw errors, and it is valid at any attitude.
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
/// assert!(rpm[0] > rpm[3], "the left motors turn faster");
/// ```
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct AttitudeControl {
    gains: AttitudeGains,
    mixer: Mixer,
    #[serde(with = "crate::serial::vector")]
    integral: Vector3<f64>,
}

impl AttitudeControl {
    /// Creates a controller with [the paper's gains](AttitudeGains::paper).
    pub fn new(params: &DroneParams) -> Self {
        Self::with_gains(params, AttitudeGains::paper(params))
    }

    /// Creates a controller with the given gains.
    pub fn with_gains(params: &DroneParams, gains: AttitudeGains) -> Self {
        Self { gains, mixer: Mixer::new(params), integral: Vector3::zeros() }
    }

    /// Returns the gains.
    pub fn gains(&self) -> &AttitudeGains {
        &self.gains
    }

    /// Replaces the gains. The integral stays the same.
    pub fn set_gains(&mut self, gains: AttitudeGains) {
        self.gains = gains;
    }

    /// Sets the integral to zero.
    pub fn reset(&mut self) {
        self.integral = Vector3::zeros();
    }

    /// Returns the motor speeds (rpm) for the next control step of `dt` seconds.
    ///
    /// They produce the collective thrust (N) along body z and the torque that tracks `attitude` (body to world) and
    /// `body_rate` (body frame, rad/s). Any non-finite input returns NaN speeds and leaves the integral unchanged.
    pub fn control(
        &mut self,
        dt: f64,
        state: &DroneState,
        thrust: f64,
        attitude: &UnitQuaternion<f64>,
        body_rate: &Vector3<f64>,
    ) -> [f64; 4] {
        let mut integral = self.integral.to_flight();
        let (attitude, body_rate) = (attitude.to_flight(), body_rate.to_flight());
        let rpm = self.track(dt, &mut integral, &FlightState::from(state), thrust, &attitude, body_rate);
        self.integral = integral.to_nalgebra();
        rpm
    }

    /// Returns the motor speeds of [`control`](Self::control), and updates the integral of the attitude errors.
    #[inline(always)]
    pub(crate) fn track<R: Real>(
        &self,
        dt: f64,
        integral: &mut V3<R>,
        state: &FlightState<R>,
        thrust: R,
        attitude: &Turn<R>,
        body_rate: V3<R>,
    ) -> [R; 4] {
        let gains = &self.gains;
        let error = state.attitude.turn_to(attitude).rotation_vector();
        let next = (*integral + error * dt).clamped(gains.integral_clamp);
        let torque = error.weighted(&gains.proportional)
            + next.weighted(&gains.integral)
            + (body_rate - state.rate).weighted(&gains.derivative);
        let rpm = self.mixer.speeds(thrust, torque);
        *integral = V3::choose(is_finite(rpm[0]), next, *integral);
        rpm
    }

    /// Returns the integral of the attitude errors, rad·s.
    pub(crate) fn integral(&self) -> V3<f64> {
        self.integral.to_flight()
    }

    /// Sets the integral of the attitude errors, rad·s.
    pub(crate) fn set_integral(&mut self, integral: V3<f64>) {
        self.integral = integral.to_nalgebra();
    }
}

/// Yaw setpoint that integrates a commanded yaw rate.
///
/// ```
/// use aviary::control::HeadingHold;
/// use aviary::state::DroneState;
///
/// let (mut hold, facing_x) = (HeadingHold::default(), DroneState::default());
/// assert!((hold.advance(0.1, &facing_x, 0.5) - 0.05).abs() < 1e-12);
/// // the setpoint waits for a drone that does not turn
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
    /// Largest difference between the yaw setpoint and the drone's yaw, rad. The limit prevents windup when the
    /// motors cannot reach the commanded rate.
    pub const MAX_LEAD: f64 = std::f64::consts::FRAC_PI_4;

    /// Clears the setpoint; the next call of [`advance`](Self::advance) starts from the drone's yaw.
    pub fn reset(&mut self) {
        self.yaw = None;
    }

    /// Turns the setpoint at `rate` rad/s for a control step of `dt` seconds and returns it, rad.
    pub fn advance(&mut self, dt: f64, state: &DroneState, rate: f64) -> f64 {
        let mut setpoint = self.setpoint();
        let yaw = Self::turn(&mut setpoint, dt, state.yaw(), rate);
        self.set_setpoint(setpoint);
        yaw
    }

    /// Turns a setpoint, which is NaN before the first call, as [`advance`](Self::advance) does. `actual` is the
    /// drone's yaw, rad.
    #[inline(always)]
    pub(crate) fn turn<R: Real>(setpoint: &mut R, dt: f64, actual: R, rate: R) -> R {
        let last = R::choose(is_set(*setpoint), *setpoint, actual);
        let max = actual.all(Self::MAX_LEAD);
        let lead = clamped(wrap_angle(last + rate * dt - actual), -max, max);
        let yaw = wrap_angle(actual + lead);
        *setpoint = R::choose(is_finite(yaw), yaw, *setpoint);
        yaw
    }

    /// Returns the setpoint, rad; NaN before the first call of [`advance`](Self::advance).
    pub(crate) fn setpoint(&self) -> f64 {
        self.yaw.unwrap_or(f64::NAN)
    }

    /// Sets the setpoint, rad; NaN for none.
    pub(crate) fn set_setpoint(&mut self, setpoint: f64) {
        self.yaw = Some(setpoint).filter(|yaw| !yaw.is_nan());
    }
}

/// Returns the attitude whose z axis points along `up`, a vector above the horizon, and whose yaw is `yaw`.
#[inline(always)]
pub(super) fn attitude_along<R: Real>(up: V3<R>, yaw: R) -> Turn<R> {
    let z = up.over(up.norm());
    // roll-pitch-yaw has this yaw only if body x is perpendicular to the left of the heading
    let (sin, cos) = sin_cos(yaw);
    let left = V3::new(-sin, cos, yaw.all(0.0));
    let x = left.cross(z);
    let x = x.over(x.norm());
    Turn::from_axes(x, z.cross(x), z)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn target_attitude_has_the_given_z_axis_and_yaw(x in -5.0..5.0, y in -5.0..5.0, yaw in -3.0..3.0) {
            let up = Vector3::new(x, y, 9.81);
            let attitude = attitude_along(up.to_flight(), yaw).to_nalgebra();
            prop_assert!((attitude * Vector3::z() - up.normalize()).norm() < 1e-9);
            let forward = attitude * Vector3::x();
            prop_assert!(wrap_angle(forward.y.atan2(forward.x) - yaw).abs() < 1e-9);
        }

    }

    #[test]
    fn heading_setpoint_turns_at_the_commanded_rate_within_its_lead() {
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
    fn non_finite_inputs_return_nan_and_keep_the_state() {
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
