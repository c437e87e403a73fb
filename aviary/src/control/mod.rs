//! Controllers: a state and a reference in, motor speeds out. They know an airframe, never an environment.

mod mixer;
mod pid;

pub use mixer::Mixer;
pub use pid::{AttitudeGains, PidControl, PidGains, PositionGains};

use nalgebra::Vector3;

use crate::state::DroneState;

/// What a controller is to follow.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reference {
    /// Position, world frame, m.
    pub position: Vector3<f64>,
    /// Velocity, world frame, m/s.
    pub velocity: Vector3<f64>,
    /// Acceleration, world frame, m/s²: feed-forward, for controllers that use it.
    pub acceleration: Vector3<f64>,
    /// Yaw, rad.
    pub yaw: f64,
    /// Yaw rate, rad/s.
    pub yaw_rate: f64,
}

impl Reference {
    /// Standing still at a position (world, m) with a yaw (rad).
    pub fn hover(position: Vector3<f64>, yaw: f64) -> Self {
        Self { position, velocity: Vector3::zeros(), acceleration: Vector3::zeros(), yaw, yaw_rate: 0.0 }
    }

    /// Whether every number is finite.
    pub fn is_finite(&self) -> bool {
        (self.position.iter().chain(&self.velocity).chain(&self.acceleration)).all(|x| x.is_finite())
            && self.yaw.is_finite()
            && self.yaw_rate.is_finite()
    }
}

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

/// A controller of one drone. It has memory: keep one per drone for an episode, and reset it between episodes.
pub trait Controller {
    /// Forgets integrals and everything else that an earlier episode left.
    fn reset(&mut self);

    /// Motor speeds for the coming control step of `dt` seconds. A state or reference that is not finite gives speeds
    /// that are not numbers, which a simulation refuses, and leaves the controller as it was.
    fn control(&mut self, dt: f64, state: &DroneState, reference: &Reference) -> ControlOutput;
}
