//! Motors of an airframe: speed from duty and voltage, time constants, latency, rotor inertia.

use serde::{Deserialize, Serialize};

use super::DroneError;
use crate::physics::actuators::ActuatorParams;

/// Motors of an airframe: the table `[motors]` of its file. Every number is zero by default, which means ideal motors.
///
/// The motors of an environment start with the time constants and the latency of the airframe that the environment was
/// built with. The other numbers follow the present airframe.
///
/// ```
/// use aviary::drone::{DroneModel, DroneParams, MotorParams};
/// use aviary::simulation::Simulation;
///
/// // motors that brake more slowly than they speed up
/// let motors = MotorParams { rise_time: 0.03, fall_time: 0.06, ..MotorParams::default() };
/// let params = DroneParams { motors, ..DroneModel::Cf2x.params() };
/// let (hover, max) = (params.hover_rpm(), params.max_rpm());
/// let mut simulation = Simulation::builder(params).ctrl_freq(20).build()?;
/// simulation.step(&[[max, max, 0.0, 0.0]])?;
/// // after 50 ms
/// let [up, _, down, _] = *simulation.rotor_speeds(0);
/// assert!((max - up - (max - hover) * (-0.05_f64 / 0.03).exp()).abs() < 1e-6);
/// assert!((down - hover * (-0.05_f64 / 0.06).exp()).abs() < 1e-6);
/// # Ok::<(), aviary::simulation::SimulationError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MotorParams {
    /// Rotor speed that a line through the measured speeds has at zero duty, rpm; from a motor test stand. The speed
    /// at a duty from 0 to 1 is speed_at_zero + speed_per_volt · duty · voltage, at least 0.
    #[serde(skip_serializing_if = "is_zero")]
    pub speed_at_zero: f64,
    /// Rotor speed per volt at the motor, rpm/V; from a motor test stand. 0 for an airframe whose commands are speeds.
    #[serde(skip_serializing_if = "is_zero")]
    pub speed_per_volt: f64,
    /// Voltage of the supply, V; the constant voltage of an airframe without a battery.
    #[serde(skip_serializing_if = "is_zero")]
    pub voltage: f64,
    /// Time constant of the first-order lag while the speed rises, s; from a step response or a flight. The
    /// environment's [`lag`](ActuatorParams::lag) replaces both time constants if it is positive.
    #[serde(skip_serializing_if = "is_zero")]
    pub rise_time: f64,
    /// Time constant of the first-order lag while the speed falls, s.
    #[serde(skip_serializing_if = "is_zero")]
    pub fall_time: f64,
    /// Delay of a command, s; added to the environment's [`latency`](ActuatorParams::latency), and rounded with it to
    /// whole physics steps.
    #[serde(skip_serializing_if = "is_zero")]
    pub latency: f64,
    /// Moment of inertia of one propeller with the rotor of its motor about the axis of rotation, kg·m²; from CAD, or
    /// from the yaw torque of spinning up. Turning the airframe exerts a gyroscopic torque, and a change of the
    /// speed exerts a reaction torque.
    #[serde(skip_serializing_if = "is_zero")]
    pub rotor_inertia: f64,
}

/// Returns true for a number that a file may leave out.
#[allow(clippy::trivially_copy_pass_by_ref)] // serde passes a reference
pub(super) fn is_zero(number: &f64) -> bool {
    *number == 0.0
}

impl MotorParams {
    /// Returns true for ideal motors.
    pub fn is_default(&self) -> bool {
        *self == Self::default()
    }

    pub(super) fn validate(&self) -> Result<(), DroneError> {
        let ranges = [
            ("motors.speed_at_zero", self.speed_at_zero, -1e6, 1e6, "-1e6 to 1e6 rpm"),
            ("motors.speed_per_volt", self.speed_per_volt, 0.0, 1e6, "0 to 1e6 rpm/V"),
            ("motors.voltage", self.voltage, 0.0, 1e4, "0 to 1e4 V"),
            ("motors.rise_time", self.rise_time, 0.0, 1e3, "0 to 1000 s"),
            ("motors.fall_time", self.fall_time, 0.0, 1e3, "0 to 1000 s"),
            ("motors.latency", self.latency, 0.0, ActuatorParams::MAX_LATENCY, "0 to 1 s"),
            ("motors.rotor_inertia", self.rotor_inertia, 0.0, 1e6, "0 to 1e6 kg·m²"),
        ];
        super::check_ranges(&ranges)
    }
}
