//! What a batch needs to put one environment after the other into a simulation.

use nalgebra::Vector3;

use super::{Equipment, Simulation, SimulationError};
use crate::engine::Load;
use crate::physics::Wrench;
use crate::physics::rotor::RotorWrench;
use crate::state::DroneState;

impl Simulation {
    /// What it has besides states, for a batch that keeps one for every environment.
    pub(crate) fn equipment(&self) -> &Equipment {
        &self.equipment
    }

    /// The same, to be changed.
    pub(crate) fn equipment_mut(&mut self) -> &mut Equipment {
        &mut self.equipment
    }

    /// Puts another environment's in its place.
    pub(crate) fn swap_equipment(&mut self, other: &mut Box<Equipment>) {
        std::mem::swap(&mut self.equipment, other);
    }

    /// Brings what the engine moves up to date.
    pub(crate) fn refresh(&mut self) {
        self.equipment.refresh(&self.world, self.effects);
    }

    /// How many control steps an environment is in its episode, with no contact: what a batch knows without looking.
    pub(crate) fn set_progress(&mut self, control_steps: u64) {
        self.control_steps = control_steps;
        self.contacts.clear();
        self.failed = None;
    }

    /// Puts a drone into a state, with its roll, pitch and yaw.
    #[inline]
    pub(crate) fn place(&mut self, drone: usize, state: DroneState, rpy: Vector3<f64>) {
        self.states[drone] = state;
        self.rpys[drone] = rpy;
    }

    /// Says what was commanded to a drone, and how fast its rotors turn.
    #[inline]
    pub(crate) fn set_speeds(&mut self, drone: usize, command: &[f64; 4], rpm: &[f64; 4]) {
        self.equipment.motor_speeds[drone] = *command;
        self.equipment.actuators[drone].set_rpm(rpm);
    }

    /// Says what acted on a drone during the last physics step.
    #[inline]
    pub(crate) fn set_load(&mut self, drone: usize, rotors: RotorWrench, force_world: Vector3<f64>) {
        self.loads[drone] = Load { rotors, external: Wrench { force_world, ..Wrench::ZERO } };
    }

    /// Goes on with the environment that was [placed](Self::place) here, from where the engine [left](Self::leave) it.
    pub(crate) fn resume(&mut self, left: Option<&[f64]>) -> Result<(), SimulationError> {
        if !self.equipment.obstacles.is_empty() {
            let obstacles = std::mem::take(&mut self.equipment.obstacles);
            let done = self.engine.set_obstacles(&obstacles);
            self.world.obstacles.copy_from_slice(&obstacles);
            self.equipment.obstacles = obstacles;
            done.map_err(|error| SimulationError::Engine { time: self.time(), error })?;
        }
        let resumed = self.engine.resume(&self.states, left);
        resumed.map_err(|error| SimulationError::Engine { time: self.time(), error })
    }

    /// What must be kept of it until then, besides what was placed; whether there is anything.
    pub(crate) fn leave(&mut self, warm_start: &mut [f64]) -> bool {
        if !self.equipment.obstacles.is_empty() {
            self.equipment.obstacles.copy_from_slice(&self.world.obstacles);
        }
        self.engine.leave(warm_start)
    }
}
