use nalgebra::Vector3;

use super::Mixer;
use crate::drone::DroneParams;
use crate::state::DroneState;

/// Holds body rates under a collective thrust: the inner loop of racing drones and of policies that go to hardware.
///
/// τ = k·J·(ω\* − ω) + ω × Jω, a first-order answer with the same time constant on every airframe.
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
/// // a Crazyflie's motors 1 and 3 push the nose to the left
/// assert!(rpm[1] > params.hover_rpm() && rpm[0] < params.hover_rpm());
/// ```
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct RateControl {
    /// Inverse of the time constant of each axis, 1/s.
    #[serde(with = "crate::serial::vector")]
    pub bandwidth: Vector3<f64>,
    #[serde(with = "crate::serial::vector")]
    inertia: Vector3<f64>,
    mixer: Mixer,
}

impl RateControl {
    /// No axis answers faster than in this many control steps, whatever its bandwidth: a rate that is measured once a
    /// step cannot be held any harder.
    const FASTEST: f64 = 1.5;

    /// For an airframe: 1/30 s about roll and pitch, 1/15 s about yaw, where motors have less to push with.
    pub fn new(params: &DroneParams) -> Self {
        Self { bandwidth: Vector3::new(30.0, 30.0, 15.0), inertia: params.inertia_vector(), mixer: Mixer::new(params) }
    }

    /// Motor speeds (rpm) for the coming control step of `dt` seconds: a collective thrust (N) along body z, and torques
    /// that bring the body to `body_rate` (body frame, rad/s). What is not a number gives speeds that are not numbers.
    pub fn control(&self, dt: f64, state: &DroneState, thrust: f64, body_rate: &Vector3<f64>) -> [f64; 4] {
        if !(dt > 0.0 && dt.is_finite()) {
            return [f64::NAN; 4];
        }
        let bandwidth = self.bandwidth.map(|k| k.min(1.0 / (Self::FASTEST * dt)));
        let momentum = self.inertia.component_mul(&state.angular_velocity);
        let torque = self.inertia.component_mul(&bandwidth).component_mul(&(body_rate - state.angular_velocity))
            + state.angular_velocity.cross(&momentum);
        self.mixer.rpm(thrust, torque)
    }
}
