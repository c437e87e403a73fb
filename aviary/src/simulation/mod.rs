//! N drones in one world, and the step that moves them.

mod batch;
mod builder;
mod equipment;
mod error;

pub use builder::SimulationBuilder;
pub(crate) use equipment::Equipment;
pub use error::SimulationError;

use nalgebra::Vector3;

use crate::drone::DroneParams;
use crate::engine::{BuildError, Contact, Engine, Load, Substeps, clearance};
use crate::physics::actuators::ActuatorParams;
use crate::physics::downwash;
use crate::physics::wind::{WindConfig, WindField};
use crate::physics::{Effects, Physics, Wrench, drag};
use crate::state::DroneState;
use crate::world::{MarkerPose, Obstacle, World};

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
    world: World,
    physics: Physics,
    effects: Effects,
    engine: Engine,
    sim_freq: u32,
    ctrl_freq: u32,
    initial: Vec<DroneState>,
    /// What the episode started from.
    started: Vec<DroneState>,
    /// Airframes, motors, wind: in a batch, those of one environment after the other.
    equipment: Box<Equipment>,
    states: Vec<DroneState>,
    /// Roll, pitch and yaw of the same, rad.
    rpys: Vec<Vector3<f64>>,
    control_steps: u64,
    contacts: Vec<Contact>,
    failed: Option<SimulationError>,
    loads: Vec<Load>,
    /// Force of the wakes on every drone, along world z, N.
    downwash: Vec<f64>,
    /// States before the last physics step.
    previous: Vec<DroneState>,
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
        if let Some(error) = &self.failed {
            return Err(error.clone());
        }
        let time = self.time();
        self.equipment.accept(commands, time)?;
        self.contacts.clear();
        self.prepare()?;
        for substep in 0..self.substeps() {
            self.equipment.memory.note(&self.states);
            self.compute_loads();
            self.advance(substep)?;
            self.note_contacts();
        }
        self.control_steps += 1;
        self.update_rpys();
        Ok(())
    }

    /// Tells the engine what it moves, at the start of a control step.
    fn prepare(&mut self) -> Result<(), SimulationError> {
        self.equipment.refresh(&self.world, self.effects);
        let steps = self.substeps();
        let begun = self.engine.begin(&self.equipment.bodies, &self.states, steps);
        begun.map_err(|error| {
            let error = self.failure(0, error);
            self.failed = Some(error.clone());
            error
        })
    }

    /// One physics step under the loads.
    fn advance(&mut self, substep: u32) -> Result<(), SimulationError> {
        self.previous.copy_from_slice(&self.states);
        let outcome = self.engine.advance(&self.equipment.bodies, &self.loads, &mut self.states);
        // MuJoCo itself would say only at the next step that a state has left the range of numbers
        let lost = self.states.iter().enumerate().find_map(|(drone, state)| Some((drone, out_of_range(state)?)));
        let error = match (outcome, lost) {
            (Err(error), _) => self.failure(substep, error),
            (Ok(()), Some((drone, quantity))) => {
                SimulationError::Diverged { drone, time: self.substep_time(substep), quantity }
            }
            (Ok(()), None) => return Ok(()),
        };
        self.states.copy_from_slice(&self.previous);
        self.update_rpys();
        self.failed = Some(error.clone());
        Err(error)
    }

    /// Turns the rotors on by one physics step and computes what acts on every drone, from the states at its start.
    fn compute_loads(&mut self) {
        let (effects, dt) = (self.effects, self.world.timestep);
        // the engine's medium is still
        let medium = self.world.medium.is_some() && self.physics != Physics::Dyn;
        let Equipment { drones, actuators, wakes, bodies, wind, motor_speeds, .. } = &mut *self.equipment;
        if effects.downwash {
            self.downwash.fill(0.0);
            downwash::add_forces(wakes, &self.states, &mut self.downwash);
        }
        for (index, (drone, state)) in drones.iter().zip(&self.states).enumerate() {
            let rpm = actuators[index].advance(&motor_speeds[index]);
            let rotors = drone.rotors.wrench(rpm);
            let (mut force, mut air) = (Vector3::zeros(), Vector3::zeros());
            if let Some(wind) = wind {
                (force, air) = wind.advance(dt, index, state);
                if medium {
                    force += bodies.drones[index].free.moving_medium(&state.attitude, &state.velocity, &air);
                }
            }
            if effects.ground {
                force.z += drone.ground.force(state, rotors.thrust);
            }
            if effects.drag {
                force += drag::force(&drone.params, state, rpm, &air);
            }
            if effects.downwash {
                force.z += self.downwash[index];
            }
            self.loads[index] = Load { rotors, external: Wrench { force_world: force, ..Wrench::ZERO } };
        }
    }

    fn note_contacts(&mut self) {
        let contacts = &mut self.contacts;
        self.engine.contacts(|contact| {
            if !contacts.contains(&contact) {
                contacts.push(contact);
            }
        });
    }

    fn substep_time(&self, substep: u32) -> f64 {
        self.time() + f64::from(substep) / f64::from(self.sim_freq)
    }

    #[cold]
    fn failure(&self, substep: u32, error: mujoco_rs::Error) -> SimulationError {
        let time = self.substep_time(substep);
        let diverged = match &error {
            mujoco_rs::Error::Diverged(divergence) => {
                self.engine.mujoco_engine().diverged_drone(divergence).map(|drone| (drone, divergence))
            }
            _ => None,
        };
        match diverged {
            Some((drone, divergence)) => {
                let quantity = match divergence.quantity {
                    mujoco_rs::DivergedQuantity::Position => "position",
                    mujoco_rs::DivergedQuantity::Velocity => "velocity",
                    mujoco_rs::DivergedQuantity::Acceleration => "acceleration",
                };
                SimulationError::Diverged { drone, time, quantity }
            }
            None => SimulationError::Engine { time, error },
        }
    }

    /// Back to the initial states, time 0, no command given; slow motors turn at hover speed.
    ///
    /// # Errors
    /// [`SimulationError::Engine`] where MuJoCo cannot recover from an earlier error.
    pub fn reset(&mut self) -> Result<(), SimulationError> {
        self.states.copy_from_slice(&self.initial);
        self.restart()
    }

    /// Starts anew from these states.
    ///
    /// # Errors
    /// [`SimulationError::Length`] and [`SimulationError::State`], and then nothing has changed; what
    /// [`reset`](Self::reset) has.
    pub fn reset_to(&mut self, states: &[DroneState]) -> Result<(), SimulationError> {
        let expected = self.states.len();
        if states.len() != expected {
            return Err(SimulationError::Length { what: "the list of states", got: states.len(), expected });
        }
        let sound = |state: &DroneState| out_of_range(state).is_none() && state.attitude.norm_squared() > 1e-6;
        if let Some(drone) = states.iter().position(|state| !sound(state)) {
            return Err(SimulationError::State { drone });
        }
        self.states.copy_from_slice(states);
        for state in &mut self.states {
            // of single precision, say; what is a rotation already keeps its bits
            if (state.attitude.norm_squared() - 1.0).abs() > 1e-12 {
                state.attitude.renormalize();
            }
        }
        self.restart()
    }

    fn restart(&mut self) -> Result<(), SimulationError> {
        self.engine.reset(&self.states).map_err(|error| SimulationError::Engine { time: 0.0, error })?;
        let Equipment { drones, actuators, motor_speeds, memory, .. } = &mut *self.equipment;
        motor_speeds.fill([0.0; 4]);
        for (actuators, (drone, load)) in actuators.iter_mut().zip(drones.iter().zip(&mut self.loads)) {
            actuators.reset();
            *load = Load { rotors: drone.rotors.wrench(&[0.0; 4]), external: Wrench::ZERO };
        }
        memory.forget(&self.states);
        self.started.copy_from_slice(&self.states);
        self.contacts.clear();
        self.control_steps = 0;
        self.failed = None;
        self.update_rpys();
        Ok(())
    }

    fn update_rpys(&mut self) {
        for (rpy, state) in self.rpys.iter_mut().zip(&self.states) {
            *rpy = state.rpy();
        }
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
        let before = self.equipment.drones[drone].params.clone();
        let changed = self.equipment.change(drone, |own| *own = params);
        if let Err(error) = changed {
            // it was sound before
            let _ = self.equipment.change(drone, |own| *own = before);
            return Err(SimulationError::Drone { drone, error });
        }
        Ok(())
    }

    /// Changes numbers of a drone's airframe, as [`set_airframe`](Self::set_airframe) does.
    ///
    /// # Errors
    /// [`SimulationError::Drone`] for parameters that no body has; they are there then.
    pub(crate) fn change_airframe(
        &mut self,
        drone: usize,
        change: impl FnOnce(&mut DroneParams),
    ) -> Result<(), SimulationError> {
        self.equipment.change(drone, change).map_err(|error| SimulationError::Drone { drone, error })
    }

    /// Sees to it that motors of this latency (s) and sensors of that one need no more memory than there is.
    pub(crate) fn reserve(&mut self, motors: f64, sensors: f64) {
        let (steps, count) = (|seconds: f64| (seconds / self.world.timestep).round() as usize, self.states.len());
        let (motors, sensors) = (steps(motors), count * steps(sensors));
        self.equipment.reserve(motors, sensors);
    }

    /// Changes how the motors of a drone answer; they start anew.
    ///
    /// # Errors
    /// [`SimulationError::Actuators`] naming a setting that is impossible.
    ///
    /// # Panics
    /// If there is no drone of that index.
    pub fn set_actuators(&mut self, drone: usize, actuators: &ActuatorParams) -> Result<(), SimulationError> {
        actuators.validate()?;
        self.equipment.drones[drone].actuators = *actuators;
        // motors are those of the airframe it was built with
        let nominal = &self.world.drones[drone].params;
        self.equipment.actuators[drone].set(nominal, actuators, self.world.timestep);
        self.equipment.changed = true;
        Ok(())
    }

    /// Other obstacles in place of those there are, of the same shapes in the same order (in other places, of other sizes),
    /// from the next step on.
    ///
    /// # Errors
    /// [`SimulationError::Length`] for another number of them, [`SimulationError::Obstacle`] for another shape,
    /// [`SimulationError::Build`] for a number out of its range; and then nothing has changed. [`SimulationError::Engine`] where
    /// MuJoCo cannot copy the scene.
    pub fn set_obstacles(&mut self, obstacles: &[Obstacle]) -> Result<(), SimulationError> {
        let old = &self.world.obstacles;
        if obstacles.len() != old.len() {
            let (got, expected) = (obstacles.len(), old.len());
            return Err(SimulationError::Length { what: "the list of obstacles", got, expected });
        }
        for (index, (new, old)) in obstacles.iter().zip(old).enumerate() {
            if new.shape.kind() != old.shape.kind() {
                return Err(SimulationError::Obstacle { index });
            }
            new.validate(&format!("obstacle {index}")).map_err(BuildError::from)?;
        }
        self.engine.set_obstacles(obstacles).map_err(|error| SimulationError::Engine { time: 0.0, error })?;
        self.world.obstacles.copy_from_slice(obstacles);
        Ok(())
    }

    /// Says how far an obstacle may move until the next control step, m.
    pub(crate) fn set_obstacle_drift(&mut self, metres: f64) {
        self.equipment.bodies.obstacle_drift = metres;
    }

    /// Puts a marker elsewhere: what is drawn from now on.
    pub(crate) fn set_marker_pose(&mut self, index: usize, pose: &MarkerPose) {
        let body = &mut self.world.markers[index].body;
        (body.position, body.rpy) = (pose.position, pose.rpy);
    }

    /// Distance of a drone's middle from the nearest obstacle's surface, m; negative inside, infinite where there is none.
    ///
    /// # Panics
    /// If there is no drone of that index.
    pub fn obstacle_distance(&self, drone: usize) -> f64 {
        let here = &self.states[drone].position;
        self.world.obstacles.iter().map(|obstacle| obstacle.distance(here)).fold(f64::INFINITY, f64::min)
    }

    /// How the motors of a drone answer.
    ///
    /// # Panics
    /// If there is no drone of that index.
    pub fn actuator_params(&self, drone: usize) -> &ActuatorParams {
        &self.equipment.drones[drone].actuators
    }

    /// Changes gravity (m/s², downwards), from the next step on.
    ///
    /// # Errors
    /// [`SimulationError::Gravity`] for what is not a number.
    pub fn set_gravity(&mut self, gravity: f64) -> Result<(), SimulationError> {
        if !(-World::MAX_GRAVITY..=World::MAX_GRAVITY).contains(&gravity) {
            return Err(SimulationError::Gravity { got: gravity });
        }
        self.equipment.bodies.gravity = gravity;
        self.equipment.changed = true;
        Ok(())
    }

    /// Longest time that states are remembered, s.
    pub const MAX_MEMORY: f64 = 1.0;

    /// Remembers the states of so many seconds, in whole physics steps and up to [`MAX_MEMORY`](Self::MAX_MEMORY), for [`remembered`](Self::remembered).
    pub fn remember(&mut self, seconds: f64) {
        let steps = (seconds.clamp(0.0, Self::MAX_MEMORY) / self.world.timestep).round() as usize;
        let memory = &mut self.equipment.memory;
        memory.states.resize(steps * self.states.len(), DroneState::default());
        memory.forget(&self.states);
    }

    /// The states as they were the [remembered](Self::remember) time ago; those of the start while there was none.
    pub fn remembered(&self) -> &[DroneState] {
        let (count, memory) = (self.states.len(), &self.equipment.memory);
        memory.states.get(memory.oldest * count..(memory.oldest + 1) * count).unwrap_or(&self.states)
    }

    /// Puts other states in place of the drones' own and gives those back: for looking at what sensors see.
    pub(crate) fn swap_states(&mut self, states: &mut Vec<DroneState>) {
        std::mem::swap(&mut self.states, states);
        self.update_rpys();
    }

    /// Changes the wind, from now on; `None` for still air, which [calm](WindConfig::is_calm) settings are as well. The wind
    /// starts again from this seed.
    ///
    /// # Errors
    /// [`SimulationError::Wind`], and then nothing has changed.
    pub fn set_wind(&mut self, wind: impl Into<Option<WindConfig>>, seed: u64) -> Result<(), SimulationError> {
        let Equipment { drones, wind: field, .. } = &mut *self.equipment;
        let areas = drones.iter().map(|drone| drone.params.drag_area());
        let wind = wind.into();
        if let Some(wind) = &wind {
            wind.validate()?;
        }
        match (wind.filter(|wind| !wind.is_calm()), field) {
            (Some(config), Some(field)) => field.set(config, areas)?,
            (Some(config), field) => *field = Some(WindField::of_areas(config, areas)?),
            (None, field) => *field = None,
        }
        self.equipment.changed = true;
        self.reset_wind(seed);
        Ok(())
    }

    /// The wind; `None` in still air.
    pub fn wind(&self) -> Option<&WindConfig> {
        self.equipment.wind.as_ref().map(WindField::config)
    }

    /// Gravity, downwards, m/s².
    pub fn gravity(&self) -> f64 {
        self.equipment.bodies.gravity
    }

    /// The seed that the wind started from last.
    pub fn wind_seed(&self) -> u64 {
        self.equipment.wind_seed
    }

    /// Starts the wind anew from a seed, which a reset by itself does not.
    pub fn reset_wind(&mut self, seed: u64) {
        self.equipment.wind_seed = seed;
        if let Some(wind) = &mut self.equipment.wind {
            wind.reset(seed, &self.states);
        }
    }

    /// Whether drones in these states are neither in the floor nor in each other nor, where that is asked, in an obstacle.
    pub(crate) fn has_room(&self, states: &[DroneState], obstacles: bool) -> bool {
        let size = |drone: usize| {
            let params = &self.world.drones[drone].params;
            (params.collision_radius, params.collision_height)
        };
        let reach = |drone: usize| {
            let (radius, height) = size(drone);
            radius.hypot(0.5 * height)
        };
        states.iter().enumerate().all(|(drone, state)| {
            let (radius, height) = size(drone);
            let apart = |other: usize| (state.position - states[other].position).norm() > reach(drone) + reach(other);
            let off = |obstacle: &Obstacle| obstacle.distance(&state.position) > reach(drone);
            clearance(radius, height, state) >= 0.0
                && (0..drone).all(apart)
                && (!obstacles || self.world.obstacles.iter().all(off))
        })
    }

    /// How many drones there are.
    pub fn num_drones(&self) -> usize {
        self.states.len()
    }

    /// The airframe of a drone.
    ///
    /// # Panics
    /// If there is no drone of that index.
    pub fn params(&self, drone: usize) -> &DroneParams {
        &self.equipment.drones[drone].params
    }

    /// States of all drones, in order.
    pub fn states(&self) -> &[DroneState] {
        &self.states
    }

    /// Roll, pitch and yaw of a drone, rad: intrinsic z-y'-x''.
    ///
    /// # Panics
    /// If there is no drone of that index.
    #[inline]
    pub fn rpy(&self, drone: usize) -> &Vector3<f64> {
        &self.rpys[drone]
    }

    /// A drone's state as tasks show it: `[position 3, rpy 3, velocity 3, angular velocity 3]`, units and frames as in
    /// [`DroneState`].
    ///
    /// # Panics
    /// If there is no drone of that index.
    #[inline]
    pub fn state_vector(&self, drone: usize) -> [f64; 12] {
        let (state, rpy) = (&self.states[drone], &self.rpys[drone]);
        let (p, v, w) = (&state.position, &state.velocity, &state.angular_velocity);
        [p.x, p.y, p.z, rpy.x, rpy.y, rpy.z, v.x, v.y, v.z, w.x, w.y, w.z]
    }

    /// States that a reset goes back to.
    pub fn initial_states(&self) -> &[DroneState] {
        &self.initial
    }

    /// Speeds at which the rotors of a drone turn, rpm: the commanded ones, unless the motors are slow or inexact.
    ///
    /// # Panics
    /// If there is no drone of that index.
    pub fn rotor_speeds(&self, drone: usize) -> &[f64; 4] {
        self.equipment.actuators[drone].rpm()
    }

    /// Motor speeds commanded to all drones during the last control step, rpm.
    pub fn motor_speeds(&self) -> &[[f64; 4]] {
        &self.equipment.motor_speeds
    }

    /// What was touched during the last control step: each pair of drone and thing once.
    pub fn contacts(&self) -> &[Contact] {
        &self.contacts
    }

    /// Simulated time, s.
    pub fn time(&self) -> f64 {
        self.control_steps as f64 / f64::from(self.ctrl_freq)
    }

    /// Control steps since the last reset.
    pub fn control_steps(&self) -> u64 {
        self.control_steps
    }

    /// Physics rate, Hz.
    pub fn sim_freq(&self) -> u32 {
        self.sim_freq
    }

    /// Control rate, Hz.
    pub fn ctrl_freq(&self) -> u32 {
        self.ctrl_freq
    }

    /// Length of a control step, s.
    pub fn control_period(&self) -> f64 {
        1.0 / f64::from(self.ctrl_freq)
    }

    /// Physics steps in a control step.
    pub fn substeps(&self) -> u32 {
        self.sim_freq / self.ctrl_freq
    }

    /// The scene.
    pub fn world(&self) -> &World {
        &self.world
    }

    /// The physics mode.
    pub fn physics(&self) -> Physics {
        self.physics
    }

    /// The aerodynamic effects that act.
    pub fn effects(&self) -> Effects {
        self.effects
    }

    /// What acted on every drone during the last physics step.
    pub fn loads(&self) -> &[Load] {
        &self.loads
    }

    /// What the last reset started from, which a task or a randomization may have changed.
    pub(crate) fn started_from(&self) -> &[DroneState] {
        &self.started
    }

    /// How many physics steps of this world each engine did.
    pub fn engine_substeps(&self) -> Substeps {
        self.engine.substeps()
    }

    /// The engine, for experts.
    pub fn engine(&self) -> &Engine {
        &self.engine
    }

    /// MuJoCo's data, with `qpos` and `qvel` as the drones are now. What `mj_step` derives from them (`xpos`, contacts) is
    /// that of its last stage; where it was not MuJoCo that moved the drones (the `dyn` mode, the hybrid engine in flight), they are
    /// written there first and everything is computed forward.
    ///
    /// # Errors
    /// MuJoCo's own, where it cannot copy a shared model or compute forward.
    pub fn mujoco(&mut self) -> Result<&mujoco_rs::Data, mujoco_rs::Error> {
        self.equipment.refresh(&self.world, self.effects);
        self.engine.mujoco(&self.equipment.bodies, &self.states)
    }

    /// Which drones are within a neighbourhood: row i, column j of an N × N matrix is whether drones i and j are at
    /// most `radius` metres apart. No drone is its own neighbour.
    ///
    /// # Panics
    /// If `out` does not have N² entries.
    pub fn adjacency(&self, radius: f64, out: &mut [bool]) {
        let count = self.states.len();
        assert_eq!(out.len(), count * count, "an adjacency matrix of {count} drones");
        for i in 0..count {
            for j in 0..count {
                let apart = (self.states[i].position - self.states[j].position).norm();
                out[i * count + j] = i != j && apart <= radius;
            }
        }
    }

    /// Distance of a drone from a point (world frame, m).
    ///
    /// # Panics
    /// If there is no drone of that index.
    pub fn distance(&self, drone: usize, point: &Vector3<f64>) -> f64 {
        (self.states[drone].position - point).norm()
    }
}
