//! N drones in one world, and the step that moves them.
//!
//! [`SimModel`] holds what does not change, [`SimData`] what does, [`Workspace`] a thread's scratch memory, and [`step`] advances data by one
//! control step. [`Simulation`] owns one of each.

mod builder;
mod data;
mod error;
mod lanes;
mod model;
mod parameters;
mod step;
mod stored;
mod view;

use std::sync::Arc;

pub use builder::SimulationBuilder;
pub use data::SimData;
pub use error::SimulationError;
pub use model::SimModel;
pub use step::{Workspace, step};
pub use view::SimView;

use nalgebra::Vector3;

use crate::drone::DroneParams;
use crate::engine::{Contact, Engine, Load, Substeps};
use crate::physics::actuators::ActuatorParams;
use crate::physics::wind::WindConfig;
use crate::physics::{Effects, Physics};
use crate::state::DroneState;
use crate::world::{Marker, Obstacle, World};

/// N drones in one world.
///
/// ```
/// use aviary::drone::DroneModel;
/// use aviary::simulation::Simulation;
///
/// let mut simulation = Simulation::builder(DroneModel::Cf2x).initial_positions([[0.0, 0.0, 1.0]]).build()?;
/// let hover = DroneModel::Cf2x.params().hover_rpm();
/// for _ in 0..48 {
///     simulation.step(&[[hover; 4]])?;
/// }
/// assert!((simulation.states()[0].position.z - 1.0).abs() < 1e-3);
/// # Ok::<(), aviary::simulation::SimulationError>(())
/// ```
#[derive(Debug)]
pub struct Simulation {
    pub(crate) model: Arc<SimModel>,
    pub(crate) data: SimData,
    pub(crate) workspace: Workspace,
}

/// What of a state is not a number or larger than MuJoCo works with.
fn out_of_range(state: &DroneState) -> Option<&'static str> {
    // MuJoCo's limit
    let bad = |x: &f64| x.is_nan() || x.abs() >= 1e10;
    if state.position.iter().chain(state.attitude.coords.iter()).any(bad) {
        Some("position")
    } else if state.velocity.iter().chain(&state.angular_velocity).any(bad) {
        Some("velocity")
    } else {
        None
    }
}

impl Simulation {
    /// Most drones in one world: MuJoCo's contact solver takes memory with the square of their number.
    pub const MAX_DRONES: usize = 256;

    /// Highest physics rate, Hz.
    pub const MAX_SIM_FREQ: u32 = 1_000_000;

    /// Options for drones of one airframe.
    pub fn builder(drone: impl Into<DroneParams>) -> SimulationBuilder {
        SimulationBuilder::new(drone.into())
    }

    /// Advances by one control step under motor speeds (rpm), four per drone, clipped to [0, `MAX_RPM`].
    ///
    /// # Errors
    /// [`SimulationError::Command`] and [`Length`](SimulationError::Length) before anything has moved;
    /// [`Diverged`](SimulationError::Diverged) and [`Engine`](SimulationError::Engine), which every further step
    /// returns again until the simulation is reset.
    pub fn step(&mut self, commands: &[[f64; 4]]) -> Result<(), SimulationError> {
        step(&self.model, &mut self.workspace, &mut self.data, commands)
    }

    /// Returns what the simulation is made of that does not change.
    pub fn model(&self) -> &Arc<SimModel> {
        &self.model
    }

    /// Returns everything that changes. A clone of it is a [`snapshot`](Self::snapshot).
    pub fn data(&self) -> &SimData {
        &self.data
    }

    /// Returns read access, as tasks have it.
    pub fn view(&self) -> SimView<'_> {
        SimView::new(&self.model, &self.data)
    }

    /// Returns a copy of everything that changes: states, motors, wind, memory of sensors, parameters, obstacles, time.
    ///
    /// ```
    /// use aviary::drone::DroneModel;
    /// use aviary::simulation::Simulation;
    ///
    /// let mut simulation = Simulation::builder(DroneModel::Cf2x).build()?;
    /// simulation.step(&[[15_000.0; 4]])?;
    /// let snapshot = simulation.snapshot();
    /// simulation.step(&[[16_000.0; 4]])?;
    /// let after = simulation.states().to_vec();
    /// simulation.restore(&snapshot)?;
    /// simulation.step(&[[16_000.0; 4]])?;
    /// assert_eq!(simulation.states(), after);
    /// # Ok::<(), aviary::simulation::SimulationError>(())
    /// ```
    pub fn snapshot(&self) -> SimData {
        self.data.clone()
    }

    /// Goes back to a snapshot of this simulation, or of another one of an equal model: the same scene, airframes, physics, engine,
    /// rates and starts. The flight from there on is bit-identical to that from the snapshot.
    ///
    /// # Errors
    /// [`SimulationError::Length`] for a snapshot of another number of drones or obstacles or of more markers,
    /// [`SimulationError::Obstacle`] for one with another shape, [`SimulationError::Model`] for one of another model otherwise; and
    /// then nothing has changed.
    pub fn restore(&mut self, snapshot: &SimData) -> Result<(), SimulationError> {
        let (got, expected) = (snapshot.states.len(), self.data.states.len());
        if got != expected {
            return Err(SimulationError::Length { what: "the snapshot", got, expected, of: "drone" });
        }
        let (got, expected) = (snapshot.obstacles(&self.model).len(), self.obstacles().len());
        if got != expected {
            return Err(SimulationError::Length {
                what: "the list of obstacles of the snapshot",
                got,
                expected,
                of: "obstacle",
            });
        }
        let mut shapes = snapshot.obstacles(&self.model).iter().zip(self.obstacles());
        if let Some(index) = shapes.position(|(new, own)| new.shape.kind() != own.shape.kind()) {
            return Err(SimulationError::Obstacle { index });
        }
        let (got, expected) = (snapshot.markers_needed(), self.model.world.markers.len());
        if got > expected {
            return Err(SimulationError::Length {
                what: "the list of markers of the snapshot",
                got,
                expected,
                of: "marker",
            });
        }
        if snapshot.model != self.model.fingerprint {
            return Err(SimulationError::Model);
        }
        self.data.copy_from(snapshot);
        // what was read from a file has nothing that follows from parameters
        self.data.refresh(&self.model);
        Ok(())
    }

    /// Back to the initial states, time 0, no command given; slow motors turn at hover speed.
    ///
    /// # Errors
    /// [`SimulationError::Engine`] where MuJoCo cannot recover from an earlier error.
    pub fn reset(&mut self) -> Result<(), SimulationError> {
        self.data.reset(&self.model);
        self.workspace.load(&self.model, &self.data)
    }

    /// Starts anew from these states.
    ///
    /// # Errors
    /// [`SimulationError::Length`] and [`SimulationError::State`], and then nothing has changed; what
    /// [`reset`](Self::reset) has.
    pub fn reset_to(&mut self, states: &[DroneState]) -> Result<(), SimulationError> {
        self.data.reset_to(states)?;
        self.workspace.load(&self.model, &self.data)
    }

    /// Changes the airframe of a drone, from the next step on: the simulated body, its rotors and what the air does to it.
    /// Motors stay as fast as those of the airframe it was built with, and the size that it collides with stays, too.
    ///
    /// # Errors
    /// [`SimulationError::Drone`] for parameters that no body has, and then nothing has changed.
    ///
    /// # Panics
    /// If there is no drone of that index.
    pub fn set_airframe(&mut self, drone: usize, params: DroneParams) -> Result<(), SimulationError> {
        self.data.set_params(drone, params)
    }

    /// Changes how the motors of a drone answer; they start anew.
    ///
    /// # Errors
    /// [`SimulationError::Actuators`] naming a setting that is impossible.
    ///
    /// # Panics
    /// If there is no drone of that index.
    pub fn set_actuators(&mut self, drone: usize, actuators: &ActuatorParams) -> Result<(), SimulationError> {
        self.data.set_actuators(&self.model, drone, actuators)
    }

    /// Other obstacles in place of those there are, of the same shapes in the same order (in other places, of other sizes),
    /// from the next step on.
    ///
    /// # Errors
    /// [`SimulationError::Length`] for another number of them, [`SimulationError::Obstacle`] for another shape,
    /// [`SimulationError::Build`] for a number out of its range; and then nothing has changed. [`SimulationError::Engine`] where
    /// MuJoCo cannot copy the scene.
    pub fn set_obstacles(&mut self, obstacles: &[Obstacle]) -> Result<(), SimulationError> {
        self.data.set_obstacles(&self.model, obstacles)
    }

    /// Changes gravity (m/s², downwards), from the next step on.
    ///
    /// # Errors
    /// [`SimulationError::Gravity`] for what is not a number.
    pub fn set_gravity(&mut self, gravity: f64) -> Result<(), SimulationError> {
        self.data.set_gravity(gravity)
    }

    /// Longest time that states are remembered, s.
    pub const MAX_MEMORY: f64 = 1.0;

    /// Remembers the states of so many seconds, in whole physics steps and up to [`MAX_MEMORY`](Self::MAX_MEMORY), for [`remembered`](Self::remembered).
    pub fn remember(&mut self, seconds: f64) {
        self.data.remember(&self.model, seconds);
    }

    /// The states as they were the [remembered](Self::remember) time ago; those of the start while there was none.
    pub fn remembered(&self) -> &[DroneState] {
        self.data.remembered()
    }

    /// Changes the wind, from now on; `None` for still air, which [calm](WindConfig::is_calm) settings are as well. The wind
    /// starts again from this seed.
    ///
    /// # Errors
    /// [`SimulationError::Wind`], and then nothing has changed.
    pub fn set_wind(&mut self, wind: impl Into<Option<WindConfig>>, seed: u64) -> Result<(), SimulationError> {
        self.data.set_wind(wind.into(), seed)
    }

    /// Restarts the wind from a seed, which a reset by itself does not.
    pub fn reset_wind(&mut self, seed: u64) {
        self.data.reset_wind(seed);
    }

    /// Distance of a drone's middle from the nearest obstacle's surface, m; negative inside, infinite where there is none.
    ///
    /// # Panics
    /// If there is no drone of that index.
    pub fn obstacle_distance(&self, drone: usize) -> f64 {
        self.view().obstacle_distance(drone)
    }

    /// How the motors of a drone answer.
    ///
    /// # Panics
    /// If there is no drone of that index.
    pub fn actuator_params(&self, drone: usize) -> &ActuatorParams {
        self.view().actuator_params(drone)
    }

    /// The wind; `None` in still air.
    pub fn wind(&self) -> Option<&WindConfig> {
        self.view().wind()
    }

    /// Gravity, downwards, m/s².
    pub fn gravity(&self) -> f64 {
        self.view().gravity()
    }

    /// The seed that the wind started from last.
    pub fn wind_seed(&self) -> u64 {
        self.view().wind_seed()
    }

    /// How many drones there are.
    pub fn num_drones(&self) -> usize {
        self.view().num_drones()
    }

    /// The airframe of a drone.
    ///
    /// # Panics
    /// If there is no drone of that index.
    pub fn params(&self, drone: usize) -> &DroneParams {
        self.view().params(drone)
    }

    /// States of all drones, in order.
    pub fn states(&self) -> &[DroneState] {
        self.view().states()
    }

    /// Roll, pitch and yaw of a drone, rad: intrinsic z-y'-x''.
    ///
    /// # Panics
    /// If there is no drone of that index.
    #[inline]
    pub fn rpy(&self, drone: usize) -> &Vector3<f64> {
        self.view().rpy(drone)
    }

    /// A drone's state as tasks show it: `[position 3, rpy 3, velocity 3, angular velocity 3]`, units and frames as in
    /// [`DroneState`].
    ///
    /// # Panics
    /// If there is no drone of that index.
    #[inline]
    pub fn state_vector(&self, drone: usize) -> [f64; 12] {
        self.view().state_vector(drone)
    }

    /// States that a reset goes back to.
    pub fn initial_states(&self) -> &[DroneState] {
        self.view().initial_states()
    }

    /// Speeds at which the rotors of a drone turn, rpm: the commanded ones, unless the motors are slow or inexact.
    ///
    /// # Panics
    /// If there is no drone of that index.
    pub fn rotor_speeds(&self, drone: usize) -> &[f64; 4] {
        self.view().rotor_speeds(drone)
    }

    /// Motor speeds commanded to all drones during the last control step, rpm.
    pub fn motor_speeds(&self) -> &[[f64; 4]] {
        self.view().motor_speeds()
    }

    /// What was touched during the last control step: each pair of drone and thing once.
    pub fn contacts(&self) -> &[Contact] {
        self.view().contacts()
    }

    /// Simulated time, s.
    pub fn time(&self) -> f64 {
        self.view().time()
    }

    /// Control steps since the last reset.
    pub fn control_steps(&self) -> u64 {
        self.view().control_steps()
    }

    /// Physics rate, Hz.
    pub fn sim_freq(&self) -> u32 {
        self.view().sim_freq()
    }

    /// Control rate, Hz.
    pub fn ctrl_freq(&self) -> u32 {
        self.view().ctrl_freq()
    }

    /// Length of a control step, s.
    pub fn control_period(&self) -> f64 {
        self.view().control_period()
    }

    /// Physics steps in a control step.
    pub fn substeps(&self) -> u32 {
        self.view().substeps()
    }

    /// Returns the scene as it was built; [`obstacles`](Self::obstacles) and [`markers`](Self::markers) are where they are now.
    pub fn world(&self) -> &World {
        self.model.world()
    }

    /// Returns the obstacles as they are now.
    pub fn obstacles(&self) -> &[Obstacle] {
        self.view().obstacles()
    }

    /// Returns the markers as they are now.
    pub fn markers(&self) -> Vec<Marker> {
        self.view().markers()
    }

    /// Returns the scene as it is now.
    pub fn scene(&self) -> World {
        self.view().scene()
    }

    /// Returns the physics mode of the engine and the effects, if the paper names one.
    pub fn physics(&self) -> Option<Physics> {
        self.view().physics()
    }

    /// The aerodynamic effects that act.
    pub fn effects(&self) -> Effects {
        self.view().effects()
    }

    /// What acted on every drone during the last physics step.
    pub fn loads(&self) -> &[Load] {
        self.view().loads()
    }

    /// Returns what the last reset started from, which a task or a randomization may have changed.
    pub(crate) fn started_from(&self) -> &[DroneState] {
        self.view().started_from()
    }

    /// How many physics steps of this world each engine did.
    pub fn engine_substeps(&self) -> Substeps {
        self.workspace.engine().substeps()
    }

    /// The engine, for experts.
    pub fn engine(&self) -> &Engine {
        self.workspace.engine()
    }

    /// MuJoCo's data, with `qpos` and `qvel` as the drones are now. What `mj_step` derives from them (`xpos`, contacts) is
    /// that of its last stage; where it was not MuJoCo that moved the drones (the `dyn` mode, the hybrid engine in flight), they are
    /// written there first and everything is computed forward.
    ///
    /// # Errors
    /// MuJoCo's own, where it cannot copy a shared model or compute forward.
    pub fn mujoco(&mut self) -> Result<&mujoco_rs::Data, mujoco_rs::Error> {
        self.workspace.mujoco(&self.model, &mut self.data)
    }

    /// Which drones are within a neighbourhood: row i, column j of an N × N matrix is whether drones i and j are at
    /// most `radius` metres apart. No drone is its own neighbour.
    ///
    /// # Panics
    /// If `out` does not have N² entries.
    pub fn adjacency(&self, radius: f64, out: &mut [bool]) {
        self.view().adjacency(radius, out);
    }

    /// Distance of a drone from a point (world frame, m).
    ///
    /// # Panics
    /// If there is no drone of that index.
    pub fn distance(&self, drone: usize, point: &Vector3<f64>) -> f64 {
        self.view().distance(drone, point)
    }
}

impl<'a> From<&'a Simulation> for SimView<'a> {
    fn from(simulation: &'a Simulation) -> Self {
        simulation.view()
    }
}
