//! N drones in one world, and the step that moves them.

use nalgebra::Vector3;

use crate::drone::{DroneError, DroneModel, DroneParams};
use crate::engine::{BuildError, Contact, MujocoEngine};
use crate::physics::Wrench;
use crate::physics::rotor::RotorModel;
use crate::state::DroneState;
use crate::world::{DroneBody, Integrator, Medium, World};

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
    engine: MujocoEngine,
    drones: Vec<Drone>,
    sim_freq: u32,
    ctrl_freq: u32,
    control_steps: u64,
    initial: Vec<DroneState>,
    states: Vec<DroneState>,
    wrenches: Vec<Wrench>,
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
        let rpys = self.rpys.unwrap_or_else(|| vec![[0.0; 3]; count]);
        for (what, got) in
            [("the list of initial positions", positions.len()), ("the list of initial attitudes", rpys.len())]
        {
            if got != count {
                return Err(SimulationError::Length { what, got, expected: count });
            }
        }

        let bodies: Vec<_> = (self.drones.iter().zip(&positions).zip(&rpys))
            .map(|((params, &position), &rpy)| DroneBody {
                params: params.clone(),
                position: position.into(),
                rpy: rpy.into(),
            })
            .collect();
        let initial: Vec<_> = bodies.iter().map(|body| DroneState::at_rest(body.position, body.rpy)).collect();
        let world = World {
            timestep: 1.0 / f64::from(sim_freq),
            integrator: self.integrator,
            medium: self.medium,
            ..World::new(bodies)
        };
        let engine = MujocoEngine::new(&world)?;
        let contacts = Vec::with_capacity(engine.max_contacts());
        let drones = (self.drones.into_iter())
            .map(|params| Drone { rotors: RotorModel::new(&params), max_rpm: params.max_rpm(), params })
            .collect();
        let mut simulation = Simulation {
            world,
            engine,
            drones,
            sim_freq,
            ctrl_freq,
            control_steps: 0,
            states: initial.clone(),
            initial,
            previous: vec![DroneState::default(); count],
            wrenches: vec![Wrench::ZERO; count],
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
            for ((drone, state), (rpm, wrench)) in
                self.drones.iter().zip(&self.states).zip(self.motor_speeds.iter().zip(&mut self.wrenches))
            {
                *wrench = drone.rotors.wrench(rpm).in_world(&state.attitude);
            }
            if let Err(error) = self.engine.advance(&self.wrenches) {
                return Err(self.failure(substep, error));
            }
            self.take_states(substep)?;
            self.note_contacts();
        }
        self.control_steps += 1;
        Ok(())
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
                self.engine.diverged_drone(divergence).map(|drone| (drone, divergence))
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

    /// Motor speeds of all drones during the last control step, rpm.
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

    /// The engine, for experts.
    pub fn engine(&self) -> &MujocoEngine {
        &self.engine
    }

    /// Distance of a drone from a point (world frame, m).
    ///
    /// # Panics
    /// If there is no drone of that index.
    pub fn distance(&self, drone: usize, point: &Vector3<f64>) -> f64 {
        (self.states[drone].position - point).norm()
    }
}
