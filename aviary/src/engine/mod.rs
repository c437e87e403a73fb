//! Who integrates. An engine takes wrenches and gives states; it never computes a force.

mod mujoco;

pub use mujoco::{BuildError, MujocoEngine};

/// What a drone touched.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Touched {
    /// The floor.
    Floor,
    /// Another drone, by its index.
    Drone(usize),
    /// Anything else in the scene.
    Obstacle,
}

/// A drone in touch with something.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Contact {
    /// Index of the drone.
    pub drone: usize,
    /// What it touched.
    pub with: Touched,
}
