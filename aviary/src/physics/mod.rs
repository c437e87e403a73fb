//! Forces on a drone: pure functions of parameters, state and rotor speeds. Nothing here knows MuJoCo or tasks.

pub mod rotor;

use nalgebra::Vector3;

/// Force and torque on one drone's centre of mass.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Wrench {
    /// Force, world frame, N.
    pub force_world: Vector3<f64>,
    /// Torque, world frame, N·m.
    pub torque_world: Vector3<f64>,
}

impl Wrench {
    /// No force, no torque.
    pub const ZERO: Self = Self { force_world: Vector3::new(0.0, 0.0, 0.0), torque_world: Vector3::new(0.0, 0.0, 0.0) };
}

impl std::ops::AddAssign for Wrench {
    fn add_assign(&mut self, other: Self) {
        self.force_world += other.force_world;
        self.torque_world += other.torque_world;
    }
}
