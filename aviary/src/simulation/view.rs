use nalgebra::Vector3;

use super::{SimData, SimModel};
use crate::drone::DroneParams;
use crate::engine::{Contact, Load};
use crate::physics::actuators::ActuatorParams;
use crate::physics::wind::{WindConfig, WindField};
use crate::physics::{Effects, Physics};
use crate::state::DroneState;
use crate::world::{Marker, Obstacle, World};

/// Read access to a simulation: what tasks, observations and renderers look at.
///
/// States are the drones' own, or what sensors measure of them: a task that computes an observation gets the measured ones.
///
/// ```
/// use aviary::drone::DroneModel;
/// use aviary::simulation::{SimView, Simulation};
///
/// fn height(simulation: SimView<'_>) -> f64 {
///     simulation.states()[0].position.z
/// }
///
/// let simulation = Simulation::builder(DroneModel::Cf2x).build()?;
/// assert_eq!(height(simulation.view()), 0.1);
/// # Ok::<(), aviary::simulation::SimulationError>(())
/// ```
#[derive(Debug, Clone, Copy)]
pub struct SimView<'a> {
    model: &'a SimModel,
    data: &'a SimData,
    states: &'a [DroneState],
    rpys: &'a [Vector3<f64>],
}

impl<'a> SimView<'a> {
    /// Returns the view of a simulation's true states.
    pub fn new(model: &'a SimModel, data: &'a SimData) -> Self {
        Self { model, data, states: &data.states, rpys: &data.rpys }
    }

    /// Returns the same view with measured states, and their roll, pitch and yaw, in place of the true ones.
    #[must_use]
    pub(crate) fn measured(self, states: &'a [DroneState], rpys: &'a [Vector3<f64>]) -> Self {
        Self { states, rpys, ..self }
    }

    /// Returns what does not change.
    pub fn model(self) -> &'a SimModel {
        self.model
    }

    /// Returns what changes.
    pub fn data(self) -> &'a SimData {
        self.data
    }

    /// Returns the number of drones.
    #[inline]
    pub fn num_drones(self) -> usize {
        self.states.len()
    }

    /// Returns the parameters of a drone's airframe, randomized ones where they are.
    ///
    /// # Panics
    /// If there is no drone of that index.
    pub fn params(self, drone: usize) -> &'a DroneParams {
        &self.data.drones[drone].params
    }

    /// Returns how the motors of a drone answer.
    ///
    /// # Panics
    /// If there is no drone of that index.
    pub fn actuator_params(self, drone: usize) -> &'a ActuatorParams {
        &self.data.drones[drone].actuators
    }

    /// Returns the states of all drones, in order.
    #[inline]
    pub fn states(self) -> &'a [DroneState] {
        self.states
    }

    /// Returns roll, pitch and yaw of a drone, rad: intrinsic z-y'-x''.
    ///
    /// # Panics
    /// If there is no drone of that index.
    #[inline]
    pub fn rpy(self, drone: usize) -> &'a Vector3<f64> {
        &self.rpys[drone]
    }

    /// Returns a drone's state as tasks observe it: `[position 3, rpy 3, velocity 3, angular velocity 3]`, units and frames as in
    /// [`DroneState`].
    ///
    /// # Panics
    /// If there is no drone of that index.
    #[inline]
    pub fn state_vector(self, drone: usize) -> [f64; 12] {
        let (state, rpy) = (&self.states[drone], &self.rpys[drone]);
        let (p, v, w) = (&state.position, &state.velocity, &state.angular_velocity);
        [p.x, p.y, p.z, rpy.x, rpy.y, rpy.z, v.x, v.y, v.z, w.x, w.y, w.z]
    }

    /// Returns the states that a reset goes back to.
    pub fn initial_states(self) -> &'a [DroneState] {
        &self.model.initial
    }

    /// Returns the states that the last reset started from, which a task or a randomization may have changed.
    pub fn started_from(self) -> &'a [DroneState] {
        &self.data.started
    }

    /// Returns the speeds at which the rotors of a drone turn, rpm: the commanded ones, unless the motors are slow or inexact.
    ///
    /// # Panics
    /// If there is no drone of that index.
    pub fn rotor_speeds(self, drone: usize) -> &'a [f64; 4] {
        self.data.actuators[drone].rpm()
    }

    /// Returns the motor speeds commanded to all drones during the last control step, rpm.
    #[inline]
    pub fn motor_speeds(self) -> &'a [[f64; 4]] {
        &self.data.motor_speeds
    }

    /// Returns what was touched during the last control step: each pair of drone and thing once.
    #[inline]
    pub fn contacts(self) -> &'a [Contact] {
        &self.data.contacts
    }

    /// Returns the simulated time, s.
    #[inline]
    pub fn time(self) -> f64 {
        self.data.control_steps as f64 / f64::from(self.model.ctrl_freq)
    }

    /// Returns the number of control steps since the last reset.
    #[inline]
    pub fn control_steps(self) -> u64 {
        self.data.control_steps
    }

    /// Returns the physics rate, Hz.
    pub fn sim_freq(self) -> u32 {
        self.model.sim_freq
    }

    /// Returns the control rate, Hz.
    pub fn ctrl_freq(self) -> u32 {
        self.model.ctrl_freq
    }

    /// Returns the length of a control step, s.
    #[inline]
    pub fn control_period(self) -> f64 {
        self.model.control_period()
    }

    /// Returns the number of physics steps in a control step.
    pub fn substeps(self) -> u32 {
        self.model.substeps()
    }

    /// Returns the scene as it was built; [`obstacles`](Self::obstacles) and [`markers`](Self::markers) are where they are now.
    pub fn world(self) -> &'a World {
        &self.model.world
    }

    /// Returns the obstacles as they are now.
    pub fn obstacles(self) -> &'a [Obstacle] {
        self.data.obstacles(self.model)
    }

    /// Returns the markers as they are now.
    pub fn markers(self) -> Vec<Marker> {
        self.data.markers(self.model)
    }

    /// Returns the scene as it is now.
    pub fn scene(self) -> World {
        World { obstacles: self.obstacles().to_vec(), markers: self.markers(), ..self.model.world.clone() }
    }

    /// Returns the physics mode of the engine and the effects, if the paper names one.
    pub fn physics(self) -> Option<Physics> {
        self.model.physics()
    }

    /// Returns the aerodynamic effects that act.
    pub fn effects(self) -> Effects {
        self.model.effects
    }

    /// Returns what acted on every drone during the last physics step.
    pub fn loads(self) -> &'a [Load] {
        &self.data.loads
    }

    /// Returns the wind; `None` in still air.
    pub fn wind(self) -> Option<&'a WindConfig> {
        self.data.wind.as_ref().map(WindField::config)
    }

    /// Returns the seed that the wind started from last.
    pub fn wind_seed(self) -> u64 {
        self.data.wind_seed
    }

    /// Returns gravity, downwards, m/s².
    pub fn gravity(self) -> f64 {
        self.data.bodies.gravity
    }

    /// Returns the distance of a drone's centre from the surface of the nearest obstacle, m; negative inside, infinite where there is
    /// none.
    ///
    /// # Panics
    /// If there is no drone of that index.
    pub fn obstacle_distance(self, drone: usize) -> f64 {
        crate::world::placement::obstacle_distance(self.obstacles(), &self.states[drone].position)
    }

    /// Writes which drones are within a neighbourhood: row i, column j of an N × N matrix is whether drones i and j are at most
    /// `radius` metres apart. No drone is its own neighbour.
    ///
    /// # Panics
    /// If `out` does not have N² entries.
    pub fn adjacency(self, radius: f64, out: &mut [bool]) {
        let count = self.states.len();
        assert_eq!(out.len(), count * count, "an adjacency matrix of {count} drones");
        for i in 0..count {
            for j in 0..count {
                let apart = (self.states[i].position - self.states[j].position).norm();
                out[i * count + j] = i != j && apart <= radius;
            }
        }
    }

    /// Returns the distance of a drone from a point (world frame, m).
    ///
    /// # Panics
    /// If there is no drone of that index.
    #[inline]
    pub fn distance(self, drone: usize, point: &Vector3<f64>) -> f64 {
        (self.states[drone].position - point).norm()
    }
}
