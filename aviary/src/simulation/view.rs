use nalgebra::Vector3;

use super::{SimData, SimModel};
use crate::drone::DroneParams;
use crate::engine::{Contact, Load};
use crate::physics::actuators::ActuatorParams;
use crate::physics::battery::BatteryState;
use crate::physics::wind::{WindConfig, WindField};
use crate::physics::{Effects, Physics};
use crate::state::DroneState;
use crate::world::{Marker, Obstacle, World};

/// Read access to a simulation for tasks, observations and renderers.
///
/// The states are the true ones, except in [`Task::observe`](crate::env::Task::observe), which gets the states that
/// the sensors measure.
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
    /// Creates a view of a simulation's true states.
    pub fn new(model: &'a SimModel, data: &'a SimData) -> Self {
        Self { model, data, states: &data.states, rpys: &data.rpys }
    }

    /// Replaces the true states, and their roll, pitch and yaw, by measured ones.
    #[must_use]
    pub(crate) fn measured(self, states: &'a [DroneState], rpys: &'a [Vector3<f64>]) -> Self {
        Self { states, rpys, ..self }
    }

    /// Returns the model, which holds the constants.
    pub fn model(self) -> &'a SimModel {
        self.model
    }

    /// Returns the data, which holds the state.
    pub fn data(self) -> &'a SimData {
        self.data
    }

    /// Returns the number of drones.
    #[inline]
    pub fn num_drones(self) -> usize {
        self.states.len()
    }

    /// Returns the parameters of a drone's airframe, after randomization.
    ///
    /// # Panics
    /// If `drone` is out of range.
    pub fn params(self, drone: usize) -> &'a DroneParams {
        &self.data.drones[drone].params
    }

    /// Returns the motor parameters of a drone.
    ///
    /// # Panics
    /// If `drone` is out of range.
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
    /// If `drone` is out of range.
    #[inline]
    pub fn rpy(self, drone: usize) -> &'a Vector3<f64> {
        &self.rpys[drone]
    }

    /// Returns a drone's state as tasks observe it: `[position 3, rpy 3, velocity 3, angular velocity 3]`, units
    /// and frames as in [`DroneState`].
    ///
    /// # Panics
    /// If `drone` is out of range.
    #[inline]
    pub fn state_vector(self, drone: usize) -> [f64; 12] {
        let (state, rpy) = (&self.states[drone], &self.rpys[drone]);
        let (p, v, w) = (&state.position, &state.velocity, &state.angular_velocity);
        [p.x, p.y, p.z, rpy.x, rpy.y, rpy.z, v.x, v.y, v.z, w.x, w.y, w.z]
    }

    /// Returns the states that a reset restores.
    pub fn initial_states(self) -> &'a [DroneState] {
        &self.model.initial
    }

    /// Returns the states that the last reset started from, after changes by the task and by randomization. Most
    /// environments of a batch do not keep them, see [`VecAviary::with`](crate::vector::VecAviary::with).
    pub fn started_from(self) -> &'a [DroneState] {
        &self.data.started
    }

    /// Returns the rotor speeds of a drone, rpm: the commanded ones, unless the motors have lag, latency, gains or
    /// saturation.
    ///
    /// # Panics
    /// If `drone` is out of range.
    pub fn rotor_speeds(self, drone: usize) -> &'a [f64; 4] {
        self.data.actuators[drone].rpm()
    }

    /// Returns charge, voltage and current of a drone's battery after the last control step; `None` without a battery.
    ///
    /// # Panics
    /// If `drone` is out of range.
    pub fn battery(self, drone: usize) -> Option<BatteryState> {
        self.data.battery(drone).map(|(_, state)| *state)
    }

    /// Returns the voltage at a drone's motors, V: that of its battery, otherwise the constant voltage of the airframe.
    ///
    /// # Panics
    /// If `drone` is out of range.
    pub fn voltage(self, drone: usize) -> f64 {
        self.data.voltage(drone)
    }

    /// Returns the motor speeds commanded to all drones during the last control step, rpm.
    #[inline]
    pub fn motor_speeds(self) -> &'a [[f64; 4]] {
        &self.data.motor_speeds
    }

    /// Returns the contacts of the last control step. Each pair of a drone and a touched object occurs once.
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

    /// Returns the scene as it was built. [`obstacles`](Self::obstacles) and [`markers`](Self::markers) return
    /// present poses.
    pub fn world(self) -> &'a World {
        &self.model.world
    }

    /// Returns the obstacles at their present poses.
    pub fn obstacles(self) -> &'a [Obstacle] {
        self.data.obstacles(self.model)
    }

    /// Returns the markers at their present poses.
    pub fn markers(self) -> Vec<Marker> {
        self.data.markers(self.model)
    }

    /// Returns the scene with obstacles and markers at their present poses.
    pub fn scene(self) -> World {
        World { obstacles: self.obstacles().to_vec(), markers: self.markers(), ..self.model.world.clone() }
    }

    /// Returns the paper's physics mode with this engine and these effects, if there is one.
    pub fn physics(self) -> Option<Physics> {
        self.model.physics()
    }

    /// Returns the aerodynamic effects that are on.
    pub fn effects(self) -> Effects {
        self.model.effects
    }

    /// Returns the forces and torques on every drone during the last physics step.
    pub fn loads(self) -> &'a [Load] {
        &self.data.loads
    }

    /// Returns the wind; `None` in still air.
    pub fn wind(self) -> Option<&'a WindConfig> {
        self.data.wind.as_ref().map(WindField::config)
    }

    /// Returns the seed of the last start of the wind.
    pub fn wind_seed(self) -> u64 {
        self.data.wind_seed
    }

    /// Returns gravity, downwards, m/s².
    pub fn gravity(self) -> f64 {
        self.data.bodies.gravity
    }

    /// Returns the distance from a drone's centre to the nearest obstacle's surface, m: negative inside, infinite
    /// without obstacles.
    ///
    /// # Panics
    /// If `drone` is out of range.
    pub fn obstacle_distance(self, drone: usize) -> f64 {
        crate::world::placement::obstacle_distance(self.obstacles(), &self.states[drone].position)
    }

    /// Writes the N × N adjacency matrix: row i, column j is true if drones i and j are at most `radius` metres
    /// apart. The diagonal is false.
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

    /// Returns the distance of a drone from a point (world frame), m.
    ///
    /// # Panics
    /// If `drone` is out of range.
    #[inline]
    pub fn distance(self, drone: usize, point: &Vector3<f64>) -> f64 {
        (self.states[drone].position - point).norm()
    }
}
