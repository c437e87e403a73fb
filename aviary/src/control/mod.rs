//! Controllers: a state and a reference in, motor speeds out. They know an airframe, never an environment.
//!
//! | controller | for |
//! | --- | --- |
//! | [`PidControl`] | the paper's cascade and gains: soft, hover-grade |
//! | [`DslPidControl`] | the cascade, stiffer, with rate limits and feed-forward: waypoints |
//! | [`GeometricControl`] | SE(3) with full feed-forward: trajectories of any attitude, flips |
//! | [`AttitudeControl`], [`RateControl`] | the inner loops alone: attitude or body rates under a thrust |
//!
//! [`CollisionCone`] keeps drones apart; [`trajectory`] has what they follow: positions with exact derivatives.

mod attitude;
mod dsl;
mod geometric;
mod kind;
mod mixer;
mod pid;
mod rate;
mod reference;
mod safety;
pub mod trajectory;

pub use attitude::{AttitudeControl, AttitudeGains, HeadingHold};
pub use dsl::DslPidControl;
pub use geometric::{Bandwidths, GeometricControl};
pub use kind::{AnyController, ControllerKind};
pub use mixer::Mixer;
pub use pid::{PidControl, PidGains, PositionGains};
pub use rate::RateControl;
pub use reference::Reference;
pub use safety::{CollisionCone, SafetyError};

use nalgebra::Vector3;

use crate::state::{DroneState, wrap_angle};

/// What a controller answers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ControlOutput {
    /// Motor speeds, rpm, within [0, `MAX_RPM`].
    pub rpm: [f64; 4],
    /// Reference minus actual position, world frame, m.
    pub position_error: Vector3<f64>,
    /// Reference minus actual yaw, rad, in (−π, π].
    pub yaw_error: f64,
}

impl ControlOutput {
    /// The errors, with motor speeds that are not numbers.
    fn of_errors(state: &DroneState, reference: &Reference) -> Self {
        Self {
            rpm: [f64::NAN; 4],
            position_error: reference.position - state.position,
            yaw_error: wrap_angle(reference.yaw - state.yaw()),
        }
    }
}

/// A controller of one drone. It has memory: keep one per drone for an episode, and reset it between episodes.
///
/// ```
/// use aviary::control::{Controller, GeometricControl, Reference};
/// use aviary::drone::DroneModel;
/// use aviary::simulation::Simulation;
/// use nalgebra::Vector3;
///
/// let mut simulation = Simulation::builder(DroneModel::Cf2x).build()?;
/// let mut controller = GeometricControl::new(simulation.params(0));
/// let target = Reference::hover(Vector3::new(0.0, 0.0, 1.0), 0.0);
/// while simulation.time() < 4.0 {
///     let output = controller.control(simulation.control_period(), &simulation.states()[0], &target);
///     simulation.step(&[output.rpm])?;
/// }
/// assert!(simulation.distance(0, &target.position) < 0.01);
/// # Ok::<(), aviary::simulation::SimulationError>(())
/// ```
pub trait Controller: std::fmt::Debug + Send {
    /// Forgets integrals and everything else that an earlier episode left.
    fn reset(&mut self);

    /// Motor speeds for the coming control step of `dt` seconds. A state or reference that is not finite gives speeds
    /// that are not numbers, which a simulation refuses, and leaves the controller as it was.
    fn control(&mut self, dt: f64, state: &DroneState, reference: &Reference) -> ControlOutput;

    /// The same for a velocity wherever the drone may be: the reference's position is left out.
    fn control_velocity(&mut self, dt: f64, state: &DroneState, reference: &Reference) -> ControlOutput {
        self.control(dt, state, &Reference { position: state.position, ..*reference })
    }
}
