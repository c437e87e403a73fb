//! Simulation of N drones in one world.
//!
//! [`SimModel`] holds the constants, [`SimData`] the state, and [`Workspace`] the scratch memory of one thread.
//! [`step`] advances data by one control step. [`Simulation`] owns one of each.

mod batteries;
mod builder;
mod data;
mod error;
mod interventions;
mod lanes;
mod model;
mod parameters;
mod step;
mod stored;
mod view;

use std::sync::Arc;

pub use builder::SimulationBuilder;
pub(crate) use builder::default_positions;
pub use data::SimData;
pub use error::SimulationError;
pub use model::SimModel;
pub use step::{Workspace, step};
pub use view::SimView;

use nalgebra::Vector3;

use crate::drone::DroneParams;
use crate::engine::{Contact, Engine, Load, Substeps};
use crate::physics::actuators::ActuatorParams;
use crate::physics::battery::BatteryState;
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

/// Returns the name of a quantity of a state that is NaN or beyond MuJoCo's limit, if there is one.
fn out_of_range(state: &DroneState) -> Option<&'static str> {
    // MuJoCo resets states beyond mjMAXVAL
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
    /// Maximum number of drones in one world. The memory of MuJoCo's contact solver grows with its square.
    pub const MAX_DRONES: usize = 256;

    /// Maximum physics rate, Hz.
    pub const MAX_SIM_FREQ: u32 = 1_000_000;

    /// Creates a builder for drones of one airframe.
    pub fn builder(drone: impl Into<DroneParams>) -> SimulationBuilder {
        SimulationBuilder::new(drone.into())
    }

    /// Advances the simulation by one control step with four motor speeds (rpm) per drone, clipped to 0 to `MAX_RPM`.
    ///
    /// # Errors
    /// [`SimulationError::Command`] and [`Length`](SimulationError::Length): the simulation has not advanced.
    /// [`Diverged`](SimulationError::Diverged) and [`Engine`](SimulationError::Engine): every further step returns
    /// the same error until the simulation is reset.
    pub fn step(&mut self, commands: &[[f64; 4]]) -> Result<(), SimulationError> {
        step(&self.model, &mut self.workspace, &mut self.data, commands)
    }

    /// Returns the model, which holds the constants.
    pub fn model(&self) -> &Arc<SimModel> {
        &self.model
    }

    /// Returns the data, which holds the state. A clone of it is a [`snapshot`](Self::snapshot).
    pub fn data(&self) -> &SimData {
        &self.data
    }

    /// Returns a read-only view, the type that tasks get.
    pub fn view(&self) -> SimView<'_> {
        SimView::new(&self.model, &self.data)
    }

    /// Returns a copy of the data: states, motors, wind, sensor delays, parameters, obstacles, time.
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

    /// Restores a snapshot of this simulation, or of one with an equal model: the same scene, airframes, physics,
    /// engine, rates and initial states. The trajectory from there on is bit-identical to the trajectory after the
    /// snapshot.
    ///
    /// # Errors
    /// [`SimulationError::Length`] if the number of drones or obstacles differs, or if the snapshot has more
    /// markers. [`SimulationError::Obstacle`] if the shape of an obstacle differs. [`SimulationError::Model`] for
    /// any other difference between the models. The simulation is unchanged after an error.
    pub fn restore(&mut self, snapshot: &SimData) -> Result<(), SimulationError> {
        snapshot.validate(&self.model)?;
        self.data.copy_from(snapshot);
        // deserialized data lacks the quantities that are derived from parameters
        self.data.refresh(&self.model);
        Ok(())
    }

    /// Resets to the initial states, time 0 and no command. Motors with lag, latency or rotor inertia turn at hover
    /// speed.
    ///
    /// # Errors
    /// [`SimulationError::Engine`] if MuJoCo cannot recover from an earlier error.
    pub fn reset(&mut self) -> Result<(), SimulationError> {
        self.data.reset_unchecked(&self.model);
        self.workspace.load(&self.model, &self.data)
    }

    /// Resets to the given states; otherwise like [`reset`](Self::reset).
    ///
    /// # Errors
    /// [`SimulationError::Length`] and [`SimulationError::State`]: the simulation is unchanged.
    /// [`SimulationError::Engine`] as for [`reset`](Self::reset).
    pub fn reset_to(&mut self, states: &[DroneState]) -> Result<(), SimulationError> {
        self.data.reset_to(states)?;
        self.workspace.load(&self.model, &self.data)
    }

    /// Replaces the airframe of a drone, from the next step on: mass, inertia, rotors and aerodynamic coefficients.
    /// The maximum motor speed, the time constants and the latency of the motors, and the collision cylinder stay those
    /// of the airframe that the drone was built with. A battery keeps its charge; one that the drone did not have
    /// before starts at its initial charge. Action decoders keep the law from duty to speed of the airframe that the
    /// environment was built with.
    ///
    /// # Errors
    /// [`SimulationError::Drone`] for invalid parameters, [`SimulationError::NoDrone`] for an index out of range; the
    /// simulation is unchanged.
    pub fn set_airframe(&mut self, drone: usize, params: DroneParams) -> Result<(), SimulationError> {
        self.data.set_params(drone, params)
    }

    /// Replaces the motor parameters of a drone and resets its motors.
    ///
    /// # Errors
    /// [`SimulationError::Option`] naming an invalid setting, [`SimulationError::NoDrone`] for an index out of range.
    pub fn set_actuators(&mut self, drone: usize, actuators: &ActuatorParams) -> Result<(), SimulationError> {
        self.data.set_actuators(&self.model, drone, actuators)
    }

    /// Replaces the obstacles by others of the same shapes in the same order, from the next step on. Positions,
    /// orientations and sizes may differ.
    ///
    /// # Errors
    /// [`SimulationError::Length`] if their number differs, [`SimulationError::Obstacle`] if a shape differs,
    /// [`SimulationError::Build`] for a number out of range; the simulation is unchanged. If MuJoCo cannot copy the
    /// scene, the next step returns [`SimulationError::Engine`].
    pub fn set_obstacles(&mut self, obstacles: &[Obstacle]) -> Result<(), SimulationError> {
        self.data.set_obstacles(&self.model, obstacles)
    }

    /// Moves obstacles between two control steps, to poses that they keep during the next one. Shapes may not change;
    /// [`set_obstacles`](Self::set_obstacles) describes the rest.
    ///
    /// The hybrid engine assumes that they move on at up to twice this speed, so that MuJoCo's solver starts with the
    /// solution of an earlier step when a drone touches one.
    ///
    /// # Errors
    /// As for [`set_obstacles`](Self::set_obstacles).
    pub fn move_obstacles(&mut self, obstacles: &[Obstacle]) -> Result<(), SimulationError> {
        self.data.move_obstacles(&self.model, obstacles)
    }

    /// Sets gravity (m/s², downwards), from the next step on.
    ///
    /// # Errors
    /// [`SimulationError::Gravity`] for NaN or a value out of range.
    pub fn set_gravity(&mut self, gravity: f64) -> Result<(), SimulationError> {
        self.data.set_gravity(gravity)
    }

    /// Maximum delay of the [`remembered`](Self::remembered) states, s.
    pub const MAX_MEMORY: f64 = 1.0;

    /// Sets the delay of the [`remembered`](Self::remembered) states, s, rounded to whole physics steps and clipped
    /// to [`MAX_MEMORY`](Self::MAX_MEMORY).
    pub fn remember(&mut self, seconds: f64) {
        self.data.remember(&self.model, seconds);
    }

    /// Returns the states as they were one [delay](Self::remember) ago. Until that much time has passed, returns
    /// the states of the last reset or of the last call of [`remember`](Self::remember).
    pub fn remembered(&self) -> &[DroneState] {
        self.data.remembered()
    }

    /// Sets the wind from now on and restarts it from a seed. `None` and [calm](WindConfig::is_calm) settings are
    /// still air.
    ///
    /// # Errors
    /// [`SimulationError::Option`] naming an invalid setting; the simulation is unchanged.
    pub fn set_wind(&mut self, wind: impl Into<Option<WindConfig>>, seed: u64) -> Result<(), SimulationError> {
        self.data.set_wind(wind.into(), seed)
    }

    /// Restarts the wind from a seed. [`reset`](Self::reset) does not restart it.
    pub fn reset_wind(&mut self, seed: u64) {
        self.data.reset_wind(seed);
    }

    /// Returns the distance from a drone's centre to the nearest obstacle's surface, m: negative inside, infinite
    /// without obstacles.
    ///
    /// # Panics
    /// If `drone` is out of range.
    pub fn obstacle_distance(&self, drone: usize) -> f64 {
        self.view().obstacle_distance(drone)
    }

    /// Returns the motor parameters of a drone.
    ///
    /// # Panics
    /// If `drone` is out of range.
    pub fn actuator_params(&self, drone: usize) -> &ActuatorParams {
        self.view().actuator_params(drone)
    }

    /// Returns the wind; `None` in still air.
    pub fn wind(&self) -> Option<&WindConfig> {
        self.view().wind()
    }

    /// Returns gravity, downwards, m/s².
    pub fn gravity(&self) -> f64 {
        self.view().gravity()
    }

    /// Returns the seed of the last start of the wind.
    pub fn wind_seed(&self) -> u64 {
        self.view().wind_seed()
    }

    /// Returns the number of drones.
    pub fn num_drones(&self) -> usize {
        self.view().num_drones()
    }

    /// Returns the parameters of a drone's airframe.
    ///
    /// # Panics
    /// If `drone` is out of range.
    pub fn params(&self, drone: usize) -> &DroneParams {
        self.view().params(drone)
    }

    /// Returns the states of all drones, in order.
    pub fn states(&self) -> &[DroneState] {
        self.view().states()
    }

    /// Returns roll, pitch and yaw of a drone, rad: intrinsic z-y'-x''.
    ///
    /// # Panics
    /// If `drone` is out of range.
    #[inline]
    pub fn rpy(&self, drone: usize) -> &Vector3<f64> {
        self.view().rpy(drone)
    }

    /// Returns a drone's state as tasks observe it: `[position 3, rpy 3, velocity 3, angular velocity 3]`, units
    /// and frames as in [`DroneState`].
    ///
    /// # Panics
    /// If `drone` is out of range.
    #[inline]
    pub fn state_vector(&self, drone: usize) -> [f64; 12] {
        self.view().state_vector(drone)
    }

    /// Returns the states that [`reset`](Self::reset) restores.
    pub fn initial_states(&self) -> &[DroneState] {
        self.view().initial_states()
    }

    /// Returns the rotor speeds of a drone, rpm: the commanded ones, unless the motors have lag, latency, gains or
    /// saturation.
    ///
    /// # Panics
    /// If `drone` is out of range.
    pub fn rotor_speeds(&self, drone: usize) -> &[f64; 4] {
        self.view().rotor_speeds(drone)
    }

    /// Returns charge, voltage and current of a drone's battery after the last control step; `None` without a battery.
    ///
    /// # Panics
    /// If `drone` is out of range.
    pub fn battery(&self, drone: usize) -> Option<BatteryState> {
        self.view().battery(drone)
    }

    /// Returns the voltage at a drone's motors, V: that of its battery, otherwise the constant voltage of the airframe.
    ///
    /// # Panics
    /// If `drone` is out of range.
    pub fn voltage(&self, drone: usize) -> f64 {
        self.view().voltage(drone)
    }

    /// Returns the motor speeds commanded to all drones during the last control step, rpm.
    pub fn motor_speeds(&self) -> &[[f64; 4]] {
        self.view().motor_speeds()
    }

    /// Returns the contacts of the last control step. Each pair of a drone and a touched object occurs once.
    pub fn contacts(&self) -> &[Contact] {
        self.view().contacts()
    }

    /// Returns the simulated time, s.
    pub fn time(&self) -> f64 {
        self.view().time()
    }

    /// Returns the number of control steps since the last reset.
    pub fn control_steps(&self) -> u64 {
        self.view().control_steps()
    }

    /// Returns the physics rate, Hz.
    pub fn sim_freq(&self) -> u32 {
        self.view().sim_freq()
    }

    /// Returns the control rate, Hz.
    pub fn ctrl_freq(&self) -> u32 {
        self.view().ctrl_freq()
    }

    /// Returns the length of a control step, s.
    pub fn control_period(&self) -> f64 {
        self.view().control_period()
    }

    /// Returns the number of physics steps in a control step.
    pub fn substeps(&self) -> u32 {
        self.view().substeps()
    }

    /// Returns the scene as it was built. [`obstacles`](Self::obstacles) and [`markers`](Self::markers) return
    /// present poses.
    pub fn world(&self) -> &World {
        self.model.world()
    }

    /// Returns the obstacles at their present poses.
    pub fn obstacles(&self) -> &[Obstacle] {
        self.view().obstacles()
    }

    /// Returns the obstacles that move between control steps, at their present poses. They are the last ones of
    /// [`obstacles`](Self::obstacles).
    pub fn moving_obstacles(&self) -> &[Obstacle] {
        let obstacles = self.obstacles();
        &obstacles[obstacles.len() - self.world().moving_obstacles..]
    }

    /// Returns the markers at their present poses.
    pub fn markers(&self) -> Vec<Marker> {
        self.view().markers()
    }

    /// Returns the scene with obstacles and markers at their present poses.
    pub fn scene(&self) -> World {
        self.view().scene()
    }

    /// Returns the paper's physics mode with this engine and these effects, if there is one.
    pub fn physics(&self) -> Option<Physics> {
        self.view().physics()
    }

    /// Returns the aerodynamic effects that are on.
    pub fn effects(&self) -> Effects {
        self.view().effects()
    }

    /// Returns the forces and torques on every drone during the last physics step.
    pub fn loads(&self) -> &[Load] {
        self.view().loads()
    }

    /// Returns the states that the last reset started from, after changes by the task and by randomization.
    pub(crate) fn started_from(&self) -> &[DroneState] {
        self.view().started_from()
    }

    /// Returns the number of physics steps that each engine has made in this world.
    pub fn engine_substeps(&self) -> Substeps {
        self.workspace.engine().substeps()
    }

    /// Returns the engine, for diagnostics.
    pub fn engine(&self) -> &Engine {
        self.workspace.engine()
    }

    /// Returns MuJoCo's data, with the present states in `qpos` and `qvel`. Quantities that `mj_step` derives from
    /// them (`xpos`, contacts) are those of its last stage. If MuJoCo did not make the last step (in the `dyn`
    /// mode, and in free flight of the hybrid engine), this function writes the states and calls `mj_forward`.
    ///
    /// # Errors
    /// MuJoCo's error if it cannot copy a shared model or compute forward.
    pub fn mujoco(&mut self) -> Result<&mujoco_rs::Data, mujoco_rs::Error> {
        self.workspace.mujoco(&self.model, &mut self.data)
    }

    /// Writes the N × N adjacency matrix: row i, column j is true if drones i and j are at most `radius` metres
    /// apart. The diagonal is false.
    ///
    /// # Panics
    /// If `out` does not have N² entries.
    pub fn adjacency(&self, radius: f64, out: &mut [bool]) {
        self.view().adjacency(radius, out);
    }

    /// Returns the distance of a drone from a point (world frame), m.
    ///
    /// # Panics
    /// If `drone` is out of range.
    pub fn distance(&self, drone: usize, point: &Vector3<f64>) -> f64 {
        self.view().distance(drone, point)
    }
}

impl<'a> From<&'a Simulation> for SimView<'a> {
    fn from(simulation: &'a Simulation) -> Self {
        simulation.view()
    }
}
