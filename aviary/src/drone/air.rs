//! Forces and torques of the air on an airframe.

use serde::{Deserialize, Serialize};

use super::DroneError;
use super::motors::is_zero;

/// Forces and torques of the air on an airframe: the table `[air]` of its file. Every number is zero by default.
///
/// They act in every physics mode and engine, in addition to the [effects](crate::physics::Effects) of the mode. The
/// velocity v is that of the airframe relative to the air, in the body frame, and ω is the body rate. All numbers come
/// from recorded flights.
///
/// ```
/// use aviary::drone::{AirParams, DroneModel, DroneParams};
/// use aviary::simulation::Simulation;
///
/// // a fall with linear drag approaches the speed m·g/d
/// let air = AirParams { linear_drag: [0.0, 0.0, 0.1], ..AirParams::default() };
/// let params = DroneParams { air, ..DroneModel::Cf2x.params() };
/// let speed = params.weight() / 0.1;
/// let mut simulation = Simulation::builder(params).initial_positions([[0.0, 0.0, 100.0]]).build()?;
/// for _ in 0..240 {
///     simulation.step(&[[0.0; 4]])?;
/// }
/// assert!((simulation.states()[0].velocity.z + speed).abs() < 1e-3);
/// # Ok::<(), aviary::simulation::SimulationError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct AirParams {
    /// Coefficients d of the linear drag along the body axes, N/(m/s): F = −diag(d)·v.
    #[serde(deserialize_with = "crate::error::triple", skip_serializing_if = "are_zero")]
    pub linear_drag: [f64; 3],
    /// Coefficient c of the translational lift, N/(m/s)²: the thrust grows by c·(v_x² + v_y²).
    #[serde(skip_serializing_if = "is_zero")]
    pub translational_lift: f64,
    /// Coefficient c of the torque about roll and pitch that a velocity causes, N·m/(m/s): τ = c·(v_y, −v_x, 0). A
    /// positive coefficient raises the leading side.
    #[serde(skip_serializing_if = "is_zero")]
    pub velocity_moment: f64,
    /// Coefficients d of the damping of a body rate, N·m/(rad/s): τ = −diag(d)·ω.
    #[serde(deserialize_with = "crate::error::triple", skip_serializing_if = "are_zero")]
    pub rotational_damping: [f64; 3],
    /// Constant torque in the body frame, N·m, for example of bent propellers and unequal motors.
    #[serde(deserialize_with = "crate::error::triple", skip_serializing_if = "are_zero")]
    pub trim_torque: [f64; 3],
}

fn are_zero(numbers: &[f64; 3]) -> bool {
    *numbers == [0.0; 3]
}

impl AirParams {
    /// Returns true if the air has no effect.
    pub fn is_default(&self) -> bool {
        *self == Self::default()
    }

    pub(super) fn validate(&self) -> Result<(), DroneError> {
        let ([dx, dy, dz], [rx, ry, rz], [tx, ty, tz]) = (self.linear_drag, self.rotational_damping, self.trim_torque);
        let (drag, damping, torque) = ("0 to 1e6 N/(m/s)", "0 to 1e6 N·m/(rad/s)", "-1e6 to 1e6 N·m");
        super::check_ranges(&[
            ("air.linear_drag[0]", dx, 0.0, 1e6, drag),
            ("air.linear_drag[1]", dy, 0.0, 1e6, drag),
            ("air.linear_drag[2]", dz, 0.0, 1e6, drag),
            ("air.translational_lift", self.translational_lift, -1e6, 1e6, "-1e6 to 1e6 N/(m/s)²"),
            ("air.velocity_moment", self.velocity_moment, -1e6, 1e6, "-1e6 to 1e6 N·m/(m/s)"),
            ("air.rotational_damping[0]", rx, 0.0, 1e6, damping),
            ("air.rotational_damping[1]", ry, 0.0, 1e6, damping),
            ("air.rotational_damping[2]", rz, 0.0, 1e6, damping),
            ("air.trim_torque[0]", tx, -1e6, 1e6, torque),
            ("air.trim_torque[1]", ty, -1e6, 1e6, torque),
            ("air.trim_torque[2]", tz, -1e6, 1e6, torque),
        ])
    }
}
