//! N drones in one world, and the step that moves them.

mod builder;
mod error;

pub use builder::SimulationBuilder;
pub use error::SimulationError;

use nalgebra::Vector3;

use crate::drone::DroneParams;
use crate::engine::{Contact, Engine, Load};
use crate::physics::actuators::{ActuatorParams, Actuators};
use crate::physics::downwash::{self, Wake};
use crate::physics::ground_effect::GroundEffect;
use crate::physics::rotor::RotorModel;
use crate::physics::wind::{WindConfig, WindField, WindModel};
use crate::physics::{Effects, Physics, Wrench, drag};
use crate::state::DroneState;
use crate::world::{Obstacle, World};

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
    drones: Vec<Drone>,
    actuators: Vec<Actuators>,
    actuator_params: Vec<ActuatorParams>,
    wakes: Vec<Wake>,
    wind: Option<WindField>,
    sim_freq: u32,
    ctrl_freq: u32,
    control_steps: u64,
    initial: Vec<DroneState>,
    states: Vec<DroneState>,
    loads: Vec<Load>,
    /// Force of the wakes on every drone, along world z, N.
    downwash: Vec<f64>,
    /// States before the last physics step.
    previous: Vec<DroneState>,
    /// States of earlier physics steps, a ring of one list after the other.
    memory: Vec<DroneState>,
    /// The oldest of them, by number of list.
    oldest: usize,
    motor_speeds: Vec<[f64; 4]>,
    contacts: Vec<Contact>,
    failed: Option<SimulationError>,
}

/// One drone's constants in the form the step wants them.
#[derive(Debug)]
struct Drone {
    params: DroneParams,
    rotors: RotorModel,
    ground: GroundEffect,
    max_rpm: f64,
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
        self.accept(commands)?;
        self.contacts.clear();
        for substep in 0..self.substeps() {
            if !self.memory.is_empty() {
                let count = self.states.len();
                self.memory[self.oldest * count..][..count].copy_from_slice(&self.states);
                self.oldest = (self.oldest + 1) % (self.memory.len() / count);
            }
            self.compute_loads();
            if let Err(error) = self.engine.advance(&self.loads, &self.states) {
                return Err(self.failure(substep, error));
            }
            self.take_states(substep)?;
            self.note_contacts();
        }
        self.control_steps += 1;
        Ok(())
    }

    /// Turns the rotors on by one physics step and computes what acts on every drone, from the states at its start.
    fn compute_loads(&mut self) {
        let (effects, dt) = (self.effects, self.world.timestep);
        if effects.downwash {
            self.downwash.fill(0.0);
            downwash::add_forces(&self.wakes, &self.states, &mut self.downwash);
        }
        for (index, (drone, state)) in self.drones.iter().zip(&self.states).enumerate() {
            let rpm = self.actuators[index].advance(&self.motor_speeds[index]);
            let rotors = drone.rotors.wrench(rpm);
            let (mut force, mut air) = (Vector3::zeros(), Vector3::zeros());
            if let Some(wind) = &mut self.wind {
                (force, air) = wind.advance(dt, index, state);
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

    /// Takes motor commands over, clipped, if all of them are numbers.
    fn accept(&mut self, commands: &[[f64; 4]]) -> Result<(), SimulationError> {
        let expected = self.drones.len();
        if commands.len() != expected {
            return Err(SimulationError::Length { what: "the list of motor commands", got: commands.len(), expected });
        }
        for (drone, speeds) in commands.iter().enumerate() {
            if let Some((motor, &got)) = speeds.iter().enumerate().find(|(_, rpm)| !rpm.is_finite()) {
                return Err(SimulationError::Command { drone, motor, got, time: self.time() });
            }
        }
        for ((drone, speeds), command) in self.drones.iter().zip(&mut self.motor_speeds).zip(commands) {
            *speeds = command.map(|rpm| rpm.clamp(0.0, drone.max_rpm));
        }
        Ok(())
    }

    fn note_contacts(&mut self) {
        let contacts = &mut self.contacts;
        self.engine.contacts(|contact| {
            if !contacts.contains(&contact) {
                contacts.push(contact);
            }
        });
    }

    /// Reads the states after a physics step, unless one of them has left the range of numbers: MuJoCo itself would
    /// say so only at the next step.
    fn take_states(&mut self, substep: u32) -> Result<(), SimulationError> {
        std::mem::swap(&mut self.states, &mut self.previous);
        self.engine.states(&mut self.states);
        let lost = self.states.iter().enumerate().find_map(|(drone, state)| Some((drone, out_of_range(state)?)));
        if let Some((drone, quantity)) = lost {
            std::mem::swap(&mut self.states, &mut self.previous);
            let error = SimulationError::Diverged { drone, time: self.substep_time(substep), quantity };
            self.failed = Some(error.clone());
            return Err(error);
        }
        Ok(())
    }

    fn substep_time(&self, substep: u32) -> f64 {
        self.time() + f64::from(substep) / f64::from(self.sim_freq)
    }

    #[cold]
    fn failure(&mut self, substep: u32, error: mujoco_rs::Error) -> SimulationError {
        let time = self.substep_time(substep);
        let diverged = match &error {
            mujoco_rs::Error::Diverged(divergence) => {
                self.engine.mujoco_engine().diverged_drone(divergence).map(|drone| (drone, divergence))
            }
            _ => None,
        };
        let error = match diverged {
            Some((drone, divergence)) => {
                let quantity = match divergence.quantity {
                    mujoco_rs::DivergedQuantity::Position => "position",
                    mujoco_rs::DivergedQuantity::Velocity => "velocity",
                    mujoco_rs::DivergedQuantity::Acceleration => "acceleration",
                };
                SimulationError::Diverged { drone, time, quantity }
            }
            None => SimulationError::Engine { time, error },
        };
        self.failed = Some(error.clone());
        error
    }

    /// Back to the initial states, time 0, no command given; slow motors turn at hover speed.
    ///
    /// # Errors
    /// Where MuJoCo cannot recover from an earlier error.
    pub fn reset(&mut self) -> Result<(), SimulationError> {
        self.states.copy_from_slice(&self.initial);
        self.restart()
    }

    /// Starts anew from these states.
    ///
    /// # Errors
    /// [`SimulationError::Length`] and [`SimulationError::State`], and then nothing has changed.
    pub fn reset_to(&mut self, states: &[DroneState]) -> Result<(), SimulationError> {
        let expected = self.drones.len();
        if states.len() != expected {
            return Err(SimulationError::Length { what: "the list of states", got: states.len(), expected });
        }
        if let Some(drone) = states.iter().position(|state| !state.is_finite()) {
            return Err(SimulationError::State { drone });
        }
        self.states.copy_from_slice(states);
        self.restart()
    }

    fn restart(&mut self) -> Result<(), SimulationError> {
        self.engine.reset(&self.states).map_err(|error| SimulationError::Engine { time: 0.0, error })?;
        self.motor_speeds.fill([0.0; 4]);
        for (actuators, (drone, load)) in self.actuators.iter_mut().zip(self.drones.iter().zip(&mut self.loads)) {
            actuators.reset();
            *load = Load { rotors: drone.rotors.wrench(&[0.0; 4]), external: Wrench::ZERO };
        }
        self.forget();
        self.contacts.clear();
        self.control_steps = 0;
        self.failed = None;
        Ok(())
    }

    /// Changes the airframe of a drone, from the next step on: the simulated body, its rotors and what the air does to it.
    /// Motors stay as fast as those of the airframe it was built with, and the size that it collides with stays, too.
    ///
    /// # Errors
    /// [`SimulationError::Drone`] for parameters that no body has, [`SimulationError::Engine`] where MuJoCo cannot.
    ///
    /// # Panics
    /// If there is no drone of that index.
    pub fn set_airframe(&mut self, drone: usize, params: DroneParams) -> Result<(), SimulationError> {
        // one that can no longer hover is still a body
        let able = DroneParams { thrust_to_weight: params.thrust_to_weight.max(1.0), ..params.clone() };
        able.validate().map_err(|error| SimulationError::Drone { drone, error })?;
        let engine = |error| SimulationError::Engine { time: 0.0, error };
        self.engine.set_body(drone, params.mass, &params.inertia_vector()).map_err(engine)?;
        self.wakes[drone] = Wake::new(&params);
        let max_rpm = self.drones[drone].max_rpm;
        self.drones[drone] =
            Drone { rotors: RotorModel::new(&params), ground: GroundEffect::new(&params), max_rpm, params };
        Ok(())
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
        self.actuator_params[drone] = *actuators;
        // motors are those of the airframe it was built with
        let nominal = &self.world.drones[drone].params;
        self.actuators[drone] = Actuators::new(nominal, actuators, self.world.timestep);
        Ok(())
    }

    /// Other obstacles in place of those there are, of the same shapes in the same order (in other places, of other sizes),
    /// from the next step on.
    ///
    /// # Errors
    /// [`SimulationError::Length`] for another number of them, [`SimulationError::Obstacle`] for another shape or numbers
    /// that no obstacle has; and then nothing has changed.
    pub fn set_obstacles(&mut self, obstacles: &[Obstacle]) -> Result<(), SimulationError> {
        let old = &self.world.obstacles;
        if obstacles.len() != old.len() {
            let (got, expected) = (obstacles.len(), old.len());
            return Err(SimulationError::Length { what: "the list of obstacles", got, expected });
        }
        for (index, (new, old)) in obstacles.iter().zip(old).enumerate() {
            let sound = new.shape.geom().1.iter().all(|&size| size > 0.0 && size < 1e6)
                && new.position.iter().chain(&new.rpy).all(|x| x.is_finite())
                && new.rgba.iter().all(|x| (0.0..=1.0).contains(x));
            if new.shape.kind() != old.shape.kind() || !sound {
                return Err(SimulationError::Obstacle { index });
            }
        }
        self.engine.set_obstacles(obstacles).map_err(|error| SimulationError::Engine { time: 0.0, error })?;
        self.world.obstacles.copy_from_slice(obstacles);
        Ok(())
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
        &self.actuator_params[drone]
    }

    /// Changes gravity (m/s², downwards), from the next step on.
    ///
    /// # Errors
    /// [`SimulationError::Engine`] for what is not a number.
    pub fn set_gravity(&mut self, gravity: f64) -> Result<(), SimulationError> {
        self.engine.set_gravity(gravity).map_err(|error| SimulationError::Engine { time: 0.0, error })
    }

    /// Longest time that states are remembered, s.
    pub const MAX_MEMORY: f64 = 1.0;

    /// Remembers the states of so many seconds, in whole physics steps and up to [`MAX_MEMORY`](Self::MAX_MEMORY), for [`remembered`](Self::remembered).
    pub fn remember(&mut self, seconds: f64) {
        let steps = (seconds.clamp(0.0, Self::MAX_MEMORY) / self.world.timestep).round() as usize;
        self.memory.resize(steps * self.states.len(), DroneState::default());
        self.forget();
    }

    /// The states as they were the [remembered](Self::remember) time ago; those of the start while there was none.
    pub fn remembered(&self) -> &[DroneState] {
        let count = self.states.len();
        self.memory.get(self.oldest * count..(self.oldest + 1) * count).unwrap_or(&self.states)
    }

    /// As if the drones had always been where they are.
    fn forget(&mut self) {
        self.oldest = 0;
        for states in self.memory.chunks_exact_mut(self.states.len()) {
            states.copy_from_slice(&self.states);
        }
    }

    /// Puts other states in place of the drones' own and gives those back: for looking at what sensors see.
    pub(crate) fn swap_states(&mut self, states: &mut Vec<DroneState>) {
        std::mem::swap(&mut self.states, states);
    }

    /// Changes the wind, from now on; `None` for still air. It starts anew, from this seed.
    ///
    /// # Errors
    /// [`SimulationError::Wind`], and then nothing has changed.
    pub fn set_wind(&mut self, wind: impl Into<Option<WindConfig>>, seed: u64) -> Result<(), SimulationError> {
        let drones = self.drones.iter().map(|drone| drone.params.clone()).collect::<Vec<_>>();
        self.wind = match wind.into().filter(|wind| wind.model != WindModel::None) {
            Some(config) => Some(WindField::new(config, &drones)?),
            None => None,
        };
        self.reset_wind(seed);
        Ok(())
    }

    /// The wind that blows.
    pub fn wind(&self) -> Option<&WindConfig> {
        self.wind.as_ref().map(WindField::config)
    }

    /// Starts the wind anew from a seed, which a reset by itself does not.
    pub fn reset_wind(&mut self, seed: u64) {
        if let Some(wind) = &mut self.wind {
            wind.reset(seed, &self.states);
        }
    }

    /// How many drones there are.
    pub fn num_drones(&self) -> usize {
        self.drones.len()
    }

    /// The airframe of a drone.
    ///
    /// # Panics
    /// If there is no drone of that index.
    pub fn params(&self, drone: usize) -> &DroneParams {
        &self.drones[drone].params
    }

    /// States of all drones, in order.
    pub fn states(&self) -> &[DroneState] {
        &self.states
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
        self.actuators[drone].rpm()
    }

    /// Motor speeds commanded to all drones during the last control step, rpm.
    pub fn motor_speeds(&self) -> &[[f64; 4]] {
        &self.motor_speeds
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

    /// The engine, for experts.
    pub fn engine(&self) -> &Engine {
        &self.engine
    }

    /// MuJoCo's data, with `qpos` and `qvel` as the drones are now. What `mj_step` derives from them (`xpos`, contacts) is
    /// that of its last stage; in the `dyn` mode the drones are written there first and everything is computed forward.
    ///
    /// # Errors
    /// MuJoCo's own.
    pub fn mujoco(&mut self) -> Result<&mujoco_rs::Data, mujoco_rs::Error> {
        self.engine.mujoco()
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
