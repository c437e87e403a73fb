use nalgebra::Vector3;

use super::Mixer;
use crate::drone::DroneParams;
use crate::math::{Real, ToFlight as _, V3, Weighted as _};
use crate::state::DroneState;

/// Body-rate controller at a given collective thrust: the inner loop of racing drones, and of policies that are
/// transferred to hardware.
///
/// The torque is τ = k·J·(ω\* − ω) + ω × Jω, a first-order response with the same time constant on every airframe.
///
/// ```
/// use aviary::control::RateControl;
/// use aviary::drone::DroneModel;
/// use aviary::state::DroneState;
/// use nalgebra::Vector3;
///
/// let params = DroneModel::Cf2x.params();
/// let turn_left = Vector3::new(0.0, 0.0, 1.0);
/// let rpm = RateControl::new(&params).control(1.0 / 240.0, &DroneState::default(), params.weight(), &turn_left);
/// // the reaction torque of motors 1 and 3 of a Crazyflie is positive
/// assert!(rpm[1] > params.hover_rpm() && rpm[0] < params.hover_rpm());
/// ```
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct RateControl {
    /// Inverse of the time constant about each body axis, 1/s.
    #[serde(with = "crate::serial::vector")]
    pub bandwidth: Vector3<f64>,
    #[serde(with = "crate::serial::vector")]
    inertia: Vector3<f64>,
    mixer: Mixer,
}

impl RateControl {
    /// Smallest time constant in control steps. The loop measures the rates once per step, which limits its gain.
    const FASTEST: f64 = 1.5;

    /// Creates a controller with time constants of 1/30 s for roll and pitch, and of 1/15 s for yaw, where the motors
    /// have less torque.
    pub fn new(params: &DroneParams) -> Self {
        Self { bandwidth: Vector3::new(30.0, 30.0, 15.0), inertia: params.inertia_vector(), mixer: Mixer::new(params) }
    }

    /// Returns the motor speeds (rpm) for the next control step of `dt` seconds.
    ///
    /// They produce the collective thrust (N) along body z and the torque that tracks `body_rate` (body frame,
    /// rad/s). Any non-finite input returns NaN speeds.
    pub fn control(&self, dt: f64, state: &DroneState, thrust: f64, body_rate: &Vector3<f64>) -> [f64; 4] {
        if !(dt > 0.0 && dt.is_finite()) {
            return [f64::NAN; 4];
        }
        self.track(dt, state.angular_velocity.to_flight(), thrust, body_rate.to_flight())
    }

    /// Returns the motor speeds of [`control`](Self::control) for an angular velocity.
    #[inline(always)]
    pub(crate) fn track<R: Real>(&self, dt: f64, omega: V3<R>, thrust: R, body_rate: V3<R>) -> [R; 4] {
        let fastest = 1.0 / (Self::FASTEST * dt);
        let [x, y, z] = [self.bandwidth.x.min(fastest), self.bandwidth.y.min(fastest), self.bandwidth.z.min(fastest)];
        let gain = self.inertia.component_mul(&Vector3::new(x, y, z));
        let torque = (body_rate - omega).weighted(&gain) + omega.cross(omega.weighted(&self.inertia));
        self.mixer.speeds(thrust, torque)
    }
}
