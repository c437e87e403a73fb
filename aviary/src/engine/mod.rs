//! Who integrates. An engine takes loads and gives states; it never computes a force.

mod explicit;
mod mujoco;

pub use explicit::ExplicitEngine;
pub(crate) use mujoco::place_geom;
pub use mujoco::{BuildError, MujocoEngine};

use mujoco_rs::{Data, Error};
use nalgebra::Vector3;

use crate::physics::Wrench;
use crate::physics::rotor::RotorWrench;
use crate::state::DroneState;
use crate::world::Obstacle;

/// What acts on a drone during one physics step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Load {
    /// The rotors, in the body frame.
    pub rotors: RotorWrench,
    /// Everything else, in the world frame.
    pub external: Wrench,
}

/// What a drone touched.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Touched {
    /// The floor.
    Floor,
    /// Another drone, by its index.
    Drone(usize),
    /// An obstacle, by its index.
    Obstacle(usize),
}

/// A drone in touch with something.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Contact {
    /// Index of the drone.
    pub drone: usize,
    /// What it touched.
    pub with: Touched,
}

/// One of the engines.
#[derive(Debug)]
pub enum Engine {
    /// MuJoCo's `mj_step`.
    Mujoco(MujocoEngine),
    /// Explicit Euler steps of the free body.
    Explicit(ExplicitEngine),
}

impl Engine {
    /// Puts every drone into a state and forgets everything else.
    ///
    /// # Errors
    /// Where MuJoCo cannot recover from an earlier error.
    pub fn reset(&mut self, states: &[DroneState]) -> Result<(), Error> {
        match self {
            Self::Mujoco(engine) => engine.reset(states),
            Self::Explicit(engine) => engine.reset(states),
        }
    }

    /// Changes the mass (kg) and the moments of inertia (body frame, kg·m²) of a drone, from the next step on.
    ///
    /// # Errors
    /// MuJoCo's, where it cannot copy a shared model.
    pub fn set_body(&mut self, drone: usize, mass: f64, inertia: &Vector3<f64>) -> Result<(), Error> {
        match self {
            Self::Mujoco(engine) => engine.set_body(drone, mass, inertia),
            Self::Explicit(engine) => engine.set_body(drone, mass, inertia),
        }
    }

    /// Other obstacles of the same shapes in the same order, from the next step on.
    ///
    /// # Errors
    /// As for [`set_body`](Self::set_body).
    pub fn set_obstacles(&mut self, obstacles: &[Obstacle]) -> Result<(), Error> {
        match self {
            Self::Mujoco(engine) => engine.set_obstacles(obstacles),
            Self::Explicit(engine) => engine.set_obstacles(obstacles),
        }
    }

    /// Changes gravity (m/s² downwards), from the next step on.
    ///
    /// # Errors
    /// As for [`set_body`](Self::set_body), and for what is not a number.
    pub fn set_gravity(&mut self, gravity: f64) -> Result<(), Error> {
        match self {
            Self::Mujoco(engine) => engine.set_gravity(gravity),
            Self::Explicit(engine) => engine.set_gravity(gravity),
        }
    }

    /// Reads every drone's state.
    pub fn states(&self, states: &mut [DroneState]) {
        match self {
            Self::Mujoco(engine) => engine.states(states),
            Self::Explicit(engine) => states.copy_from_slice(engine.states()),
        }
    }

    /// One physics step from these states, which are those that [`states`](Self::states) gave last.
    ///
    /// # Errors
    /// MuJoCo's; the drones must then be [reset](Self::reset).
    pub fn advance(&mut self, loads: &[Load], states: &[DroneState]) -> Result<(), Error> {
        match self {
            Self::Mujoco(engine) => engine.advance(loads, states),
            Self::Explicit(engine) => {
                engine.advance(loads);
                Ok(())
            }
        }
    }

    /// Calls `found` for every drone in touch with something in the last step, once per point of contact and drone.
    /// The explicit engine knows no contacts.
    pub fn contacts(&self, found: impl FnMut(Contact)) {
        if let Self::Mujoco(engine) = self {
            engine.contacts(found);
        }
    }

    /// MuJoCo's data with the drones where they are now. For the explicit engine they are written there and computed
    /// forward first.
    ///
    /// # Errors
    /// MuJoCo's.
    pub fn mujoco(&mut self) -> Result<&Data, Error> {
        match self {
            Self::Mujoco(engine) => Ok(engine.data()),
            Self::Explicit(engine) => engine.synchronised(),
        }
    }

    /// The MuJoCo simulation beneath.
    pub(crate) fn mujoco_engine(&self) -> &MujocoEngine {
        match self {
            Self::Mujoco(engine) => engine,
            Self::Explicit(engine) => engine.mirror(),
        }
    }
}
