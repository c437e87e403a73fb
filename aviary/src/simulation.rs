//! N drones in one world, and the step that moves them.

use nalgebra::Vector3;

use crate::drone::{DroneError, DroneModel, DroneParams};
use crate::engine::{BuildError, Contact, Engine, ExplicitEngine, Load, MujocoEngine};
use crate::physics::actuators::{ActuatorError, ActuatorParams, Actuators};
use crate::physics::downwash::{self, Wake};
use crate::physics::ground_effect::GroundEffect;
use crate::physics::rotor::RotorModel;
use crate::physics::{Effects, Physics, Wrench, drag};
use crate::state::DroneState;
use crate::world::{DroneBody, Forcing, Integrator, Medium, Obstacle, World};

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
    wakes: Vec<Wake>,
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

/// What can go wrong with a simulation.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum SimulationError {
    /// An airframe that cannot fly.
    #[error("drone {drone}: {error}")]
    Drone {
        /// Index of the drone.
        drone: usize,
        /// What is wrong with it.
        error: DroneError,
    },
    /// Rates that do not fit together.
    #[error(
        "sim_freq is {sim_freq} Hz and ctrl_freq {ctrl_freq} Hz, expected positive frequencies up to {} Hz of which the first is a multiple of the second",
        Simulation::MAX_SIM_FREQ
    )]
    Rates {
        /// Physics rate, Hz.
        sim_freq: u32,
        /// Control rate, Hz.
        ctrl_freq: u32,
    },
    /// A list that does not have one entry per drone.
    #[error("{what} has {got} entries, expected one for each of {expected} drones")]
    Length {
        /// Which list.
        what: &'static str,
        /// Its length.
        got: usize,
        /// Number of drones.
        expected: usize,
    },
    /// No drones at all, or too many.
    #[error("the number of drones is {got}, expected 1 to {}", Simulation::MAX_DRONES)]
    NumDrones {
        /// How many.
        got: usize,
    },
    /// Motors that cannot be.
    #[error(transparent)]
    Actuators(#[from] ActuatorError),
    /// A state with a number that is not one.
    #[error("the state of drone {drone} is not finite")]
    State {
        /// Index of the drone.
        drone: usize,
    },
    /// The scene does not compile.
    #[error(transparent)]
    Build(#[from] BuildError),
    /// A motor command that is not a number.
    #[error("the command for motor {motor} of drone {drone} is {got} at t = {time} s, expected a finite speed in rpm")]
    Command {
        /// Index of the drone.
        drone: usize,
        /// Index of the motor.
        motor: usize,
        /// What was commanded.
        got: f64,
        /// Simulated time, s.
        time: f64,
    },
    /// The state left the range of numbers MuJoCo works with. [`Simulation::states`] still gives the last good one;
    /// the simulation must be reset.
    #[error("drone {drone} diverged at t = {time} s: its {quantity} is not finite or too large")]
    Diverged {
        /// Index of the drone.
        drone: usize,
        /// Simulated time at the start of the physics step, s.
        time: f64,
        /// What diverged: position, velocity or acceleration.
        quantity: &'static str,
    },
    /// MuJoCo raised an error; the simulation must be reset.
    #[error("at t = {time} s: {error}")]
    Engine {
        /// Simulated time, s.
        time: f64,
        /// MuJoCo's error.
        error: mujoco_rs::Error,
    },
}

/// The options of a [`Simulation`]; what is not said is the paper's default.
#[derive(Debug, Clone)]
pub struct SimulationBuilder {
    drones: Vec<DroneParams>,
    positions: Option<Vec<[f64; 3]>>,
    rpys: Option<Vec<[f64; 3]>>,
    sim_freq: u32,
    ctrl_freq: u32,
    velocities: Option<Vec<[f64; 3]>>,
    angular_velocities: Option<Vec<[f64; 3]>>,
    physics: Physics,
    effects: Option<Effects>,
    forcing: Forcing,
    actuators: ActuatorParams,
    obstacles: Vec<Obstacle>,
    integrator: Integrator,
    medium: Option<Medium>,
}

impl From<DroneModel> for DroneParams {
    fn from(model: DroneModel) -> Self {
        model.params()
    }
}

impl SimulationBuilder {
    /// How many drones of the same airframe; 1 by default.
    #[must_use]
    pub fn num_drones(mut self, count: usize) -> Self {
        let first = self.drones.first().cloned();
        // one more than there can be is enough for `build` to say so
        self.drones = first.into_iter().cycle().take(count.min(Simulation::MAX_DRONES + 1)).collect();
        self
    }

    /// Airframes of all drones, where they differ.
    #[must_use]
    pub fn drones(mut self, drones: impl IntoIterator<Item = DroneParams>) -> Self {
        self.drones = drones.into_iter().collect();
        self
    }

    /// Initial positions, world frame, m; by default in a row along x at z = 0.1 m, four times the largest arm or
    /// collision radius apart.
    #[must_use]
    pub fn initial_positions(mut self, positions: impl IntoIterator<Item = [f64; 3]>) -> Self {
        self.positions = Some(positions.into_iter().collect());
        self
    }

    /// Initial roll, pitch, yaw, rad; level and facing x by default.
    #[must_use]
    pub fn initial_rpys(mut self, rpys: impl IntoIterator<Item = [f64; 3]>) -> Self {
        self.rpys = Some(rpys.into_iter().collect());
        self
    }

    /// Initial velocities, world frame, m/s; at rest by default.
    #[must_use]
    pub fn initial_velocities(mut self, velocities: impl IntoIterator<Item = [f64; 3]>) -> Self {
        self.velocities = Some(velocities.into_iter().collect());
        self
    }

    /// Initial body rates, body frame, rad/s; none by default.
    #[must_use]
    pub fn initial_angular_velocities(mut self, rates: impl IntoIterator<Item = [f64; 3]>) -> Self {
        self.angular_velocities = Some(rates.into_iter().collect());
        self
    }

    /// The physics mode; MuJoCo without aerodynamic effects by default.
    #[must_use]
    pub fn physics(mut self, physics: Physics) -> Self {
        self.physics = physics;
        self
    }

    /// Any subset of the aerodynamic effects, in place of the physics mode's own.
    #[must_use]
    pub fn effects(mut self, effects: Effects) -> Self {
        self.effects = Some(effects);
        self
    }

    /// How the rotors' wrench acts during a physics step; frozen by default.
    #[must_use]
    pub fn forcing(mut self, forcing: Forcing) -> Self {
        self.forcing = forcing;
        self
    }

    /// How the motors answer to commands; at once and exactly by default.
    #[must_use]
    pub fn actuators(mut self, actuators: ActuatorParams) -> Self {
        self.actuators = actuators;
        self
    }

    /// Things that stand in the way; none by default.
    #[must_use]
    pub fn obstacles(mut self, obstacles: impl IntoIterator<Item = Obstacle>) -> Self {
        self.obstacles = obstacles.into_iter().collect();
        self
    }

    /// Physics rate, Hz; 240 by default.
    #[must_use]
    pub fn sim_freq(mut self, hertz: u32) -> Self {
        self.sim_freq = hertz;
        self
    }

    /// Control rate, Hz, a divisor of the physics rate; 48 by default.
    #[must_use]
    pub fn ctrl_freq(mut self, hertz: u32) -> Self {
        self.ctrl_freq = hertz;
        self
    }

    /// MuJoCo's integrator; RK4 by default.
    #[must_use]
    pub fn integrator(mut self, integrator: Integrator) -> Self {
        self.integrator = integrator;
        self
    }

    /// MuJoCo's fluid forces; off by default.
    #[must_use]
    pub fn medium(mut self, medium: impl Into<Option<Medium>>) -> Self {
        self.medium = medium.into();
        self
    }

    /// Compiles the world.
    ///
    /// # Errors
    /// [`SimulationError`] naming the option that is impossible.
    pub fn build(self) -> Result<Simulation, SimulationError> {
        let (sim_freq, ctrl_freq) = (self.sim_freq, self.ctrl_freq);
        if sim_freq == 0 || sim_freq > Simulation::MAX_SIM_FREQ || ctrl_freq == 0 || !sim_freq.is_multiple_of(ctrl_freq)
        {
            return Err(SimulationError::Rates { sim_freq, ctrl_freq });
        }
        let count = self.drones.len();
        if !(1..=Simulation::MAX_DRONES).contains(&count) {
            return Err(SimulationError::NumDrones { got: count });
        }
        for (drone, params) in self.drones.iter().enumerate() {
            params.validate().map_err(|error| SimulationError::Drone { drone, error })?;
        }
        let positions = self.positions.unwrap_or_else(|| row(&self.drones));
        let zeros = || vec![[0.0; 3]; count];
        let rpys = self.rpys.unwrap_or_else(zeros);
        let velocities = self.velocities.unwrap_or_else(zeros);
        let rates = self.angular_velocities.unwrap_or_else(zeros);
        for (what, got) in [
            ("the list of initial positions", positions.len()),
            ("the list of initial attitudes", rpys.len()),
            ("the list of initial velocities", velocities.len()),
            ("the list of initial angular velocities", rates.len()),
        ] {
            if got != count {
                return Err(SimulationError::Length { what, got, expected: count });
            }
        }
        self.actuators.validate()?;

        let bodies: Vec<_> = (self.drones.iter().zip(&positions).zip(&rpys))
            .map(|((params, &position), &rpy)| DroneBody {
                params: params.clone(),
                position: position.into(),
                rpy: rpy.into(),
            })
            .collect();
        let initial: Vec<_> = (bodies.iter().zip(velocities).zip(rates))
            .map(|((body, velocity), rate)| DroneState {
                velocity: velocity.into(),
                angular_velocity: rate.into(),
                ..DroneState::at_rest(body.position, body.rpy)
            })
            .collect();
        let world = World {
            timestep: 1.0 / f64::from(sim_freq),
            integrator: self.integrator,
            medium: self.medium,
            forcing: self.forcing,
            obstacles: self.obstacles,
            ..World::new(bodies)
        };
        let engine = match self.physics {
            Physics::Dyn => Engine::Explicit(ExplicitEngine::new(&world)?),
            _ => Engine::Mujoco(MujocoEngine::new(&world)?),
        };
        if let Some(drone) = initial.iter().position(|state| !state.is_finite()) {
            return Err(SimulationError::State { drone });
        }
        let contacts = Vec::with_capacity(engine.mujoco_engine().max_contacts());
        let actuators =
            (self.drones.iter()).map(|params| Actuators::new(params, &self.actuators, world.timestep)).collect();
        let wakes = self.drones.iter().map(Wake::new).collect();
        let no_load = Load { rotors: RotorModel::new(&self.drones[0]).wrench(&[0.0; 4]), external: Wrench::ZERO };
        let drones = (self.drones.into_iter())
            .map(|params| Drone {
                rotors: RotorModel::new(&params),
                ground: GroundEffect::new(&params),
                max_rpm: params.max_rpm(),
                params,
            })
            .collect();
        let mut simulation = Simulation {
            world,
            physics: self.physics,
            effects: self.effects.unwrap_or_else(|| self.physics.effects()),
            engine,
            drones,
            actuators,
            wakes,
            sim_freq,
            ctrl_freq,
            control_steps: 0,
            states: initial.clone(),
            initial,
            previous: vec![DroneState::default(); count],
            loads: vec![no_load; count],
            downwash: vec![0.0; count],
            motor_speeds: vec![[0.0; 4]; count],
            contacts,
            failed: None,
        };
        simulation.reset()?;
        Ok(simulation)
    }
}

/// Drones side by side on a line along x, far enough apart that their wakes and bodies do not meet.
fn row(drones: &[DroneParams]) -> Vec<[f64; 3]> {
    let spacing = drones.iter().map(|params| 4.0 * params.arm_length.max(params.collision_radius)).fold(0.0, f64::max);
    (0..drones.len()).map(|index| [index as f64 * spacing, 0.0, 0.1]).collect()
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
        SimulationBuilder {
            drones: vec![drone.into()],
            positions: None,
            rpys: None,
            sim_freq: 240,
            ctrl_freq: 48,
            velocities: None,
            angular_velocities: None,
            physics: Physics::default(),
            effects: None,
            forcing: Forcing::default(),
            actuators: ActuatorParams::default(),
            obstacles: Vec::new(),
            integrator: Integrator::Rk4,
            medium: None,
        }
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
        let effects = self.effects;
        if effects.downwash {
            self.downwash.fill(0.0);
            downwash::add_forces(&self.wakes, &self.states, &mut self.downwash);
        }
        for (index, (drone, state)) in self.drones.iter().zip(&self.states).enumerate() {
            let rpm = self.actuators[index].advance(&self.motor_speeds[index]);
            let rotors = drone.rotors.wrench(rpm);
            let mut force = Vector3::zeros();
            if effects.ground {
                force.z += drone.ground.force(state, rotors.thrust);
            }
            if effects.drag {
                force += drag::force(&drone.params, state, rpm, &Vector3::zeros());
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

    /// Back to the initial states, time 0, motors standing still.
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
        for actuators in &mut self.actuators {
            actuators.reset();
        }
        self.contacts.clear();
        self.control_steps = 0;
        self.failed = None;
        Ok(())
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

    /// MuJoCo's data with the drones where they are now (in the `dyn` mode they are written there first).
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
