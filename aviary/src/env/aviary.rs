use rand::SeedableRng as _;

use super::{BoxSpace, EndReason, Env, EnvError, Info, ObservationSpace, Rng, Step, Task};
use crate::action::{ActionDecoder, ActionLimits, ActionType};
use crate::control::{ControllerKind, Reference};
use crate::drone::{DroneModel, DroneParams};
use crate::observation::{Observation, ObservationType};
use crate::physics::actuators::ActuatorParams;
use crate::physics::{Effects, Physics};
use crate::simulation::{Simulation, SimulationBuilder};
use crate::vision::{CAMERA_SIZE, ImageSize, Painter, View};
use crate::world::{Forcing, Integrator, Medium, Obstacle};

/// A task made into an environment.
#[derive(Debug)]
pub struct Aviary<T> {
    task: T,
    simulation: Simulation,
    action_type: ActionType,
    decoders: Vec<ActionDecoder>,
    observation_space: ObservationSpace,
    action_space: BoxSpace,
    episode_steps: u64,
    rng: Rng,
    phase: Phase,
    end: Option<EndReason>,
    observation: Observation,
    /// Draws the onboard cameras, where they are observed.
    cameras: Option<Painter>,
    /// Draws for people, once they ask.
    painter: Option<Painter>,
    /// The action within its bounds.
    clipped: Vec<f64>,
    commands: Vec<[f64; 4]>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Phase {
    New,
    Running,
    Over,
}

/// The options of an [`Aviary`]; what is not said is the task's or the paper's default.
#[derive(Debug, Clone)]
pub struct AviaryBuilder<T> {
    task: T,
    simulation: SimulationBuilder,
    num_drones: usize,
    episode_seconds: f64,
    action_type: ActionType,
    action_limits: ActionLimits,
    controller: ControllerKind,
    observation_type: ObservationType,
    camera_size: ImageSize,
}

/// Options that are the simulation's.
macro_rules! forward {
    ($($(#[$doc:meta])* $name:ident($argument:ident: $kind:ty);)*) => {$(
        $(#[$doc])*
        #[must_use]
        pub fn $name(mut self, $argument: $kind) -> Self {
            self.simulation = self.simulation.$name($argument);
            self
        }
    )*};
}

impl<T: Task> AviaryBuilder<T> {
    /// Options for a task.
    pub fn new(task: T) -> Self {
        let defaults = task.defaults();
        Self {
            task,
            simulation: Simulation::builder(DroneModel::Cf2x),
            num_drones: defaults.num_drones,
            episode_seconds: defaults.episode_seconds,
            action_type: ActionType::default(),
            action_limits: ActionLimits::default(),
            controller: ControllerKind::default(),
            observation_type: ObservationType::default(),
            camera_size: CAMERA_SIZE,
        }
    }

    /// Changes the task's own options.
    #[must_use]
    pub fn task(mut self, change: impl FnOnce(&mut T)) -> Self {
        change(&mut self.task);
        self
    }

    /// Airframe of every drone; the Crazyflie (X) by default.
    #[must_use]
    pub fn drone(mut self, drone: impl Into<DroneParams>) -> Self {
        self.simulation = self.simulation.drones([drone.into()]);
        self
    }

    /// Number of drones.
    #[must_use]
    pub fn num_drones(mut self, count: usize) -> Self {
        self.num_drones = count;
        self
    }

    /// Length of an episode, s.
    #[must_use]
    pub fn episode_seconds(mut self, seconds: f64) -> Self {
        self.episode_seconds = seconds;
        self
    }

    forward! {
        /// The physics mode; MuJoCo without aerodynamic effects by default.
        physics(physics: Physics);
        /// Any subset of the aerodynamic effects, in place of the physics mode's own.
        effects(effects: Effects);
        /// Physics rate, Hz; 240 by default.
        sim_freq(hertz: u32);
        /// Control rate, Hz, a divisor of the physics rate; 48 by default.
        ctrl_freq(hertz: u32);
        /// Initial positions, world frame, m; the task's by default.
        initial_positions(positions: impl IntoIterator<Item = [f64; 3]>);
        /// Initial roll, pitch, yaw, rad; level and facing x by default.
        initial_rpys(rpys: impl IntoIterator<Item = [f64; 3]>);
        /// Initial velocities, world frame, m/s; at rest by default.
        initial_velocities(velocities: impl IntoIterator<Item = [f64; 3]>);
        /// Initial body rates, body frame, rad/s; none by default.
        initial_angular_velocities(rates: impl IntoIterator<Item = [f64; 3]>);
        /// How the rotors' wrench acts during a physics step; frozen by default.
        forcing(forcing: Forcing);
        /// How the motors answer to commands; at once and exactly by default.
        actuators(actuators: ActuatorParams);
        /// Things that stand in the way; none by default.
        obstacles(obstacles: impl IntoIterator<Item = Obstacle>);
        /// MuJoCo's integrator; RK4 by default.
        integrator(integrator: Integrator);
        /// MuJoCo's fluid forces; off by default.
        medium(medium: impl Into<Option<Medium>>);
    }

    /// How the agent commands the drones; normalized motor speeds by default.
    #[must_use]
    pub fn action_type(mut self, action_type: ActionType) -> Self {
        self.action_type = action_type;
        self
    }

    /// How far actions reach that are not motor speeds.
    #[must_use]
    pub fn action_limits(mut self, limits: ActionLimits) -> Self {
        self.action_limits = limits;
        self
    }

    /// The controller beneath actions that are velocities or waypoints; the paper's PID by default.
    #[must_use]
    pub fn controller(mut self, controller: ControllerKind) -> Self {
        self.controller = controller;
        self
    }

    /// What the agent sees; the task's vector by default.
    #[must_use]
    pub fn observation_type(mut self, observation_type: ObservationType) -> Self {
        self.observation_type = observation_type;
        self
    }

    /// Size of the onboard cameras' pictures; 64 × 48 by default.
    #[must_use]
    pub fn camera_size(mut self, size: ImageSize) -> Self {
        self.camera_size = size;
        self
    }

    /// Compiles the world. The environment must be [reset](Env::reset) before its first step.
    ///
    /// # Errors
    /// [`EnvError`] naming the option that is impossible.
    pub fn build(self) -> Result<Aviary<T>, EnvError> {
        let count = self.num_drones;
        self.task.check(count)?;
        let seconds = self.episode_seconds;
        // the shortest episode is one control step; a year of them still counts exactly
        if !(seconds.is_finite() && seconds > 0.0 && seconds < 4e7) {
            return Err(EnvError::Option {
                option: "the length of an episode",
                got: format!("{seconds} s"),
                expected: "a positive number of seconds below 4e7",
            });
        }
        let positions = self.task.initial_positions(count);
        let simulation = self.simulation.num_drones(count).initial_positions_or(positions).build()?;
        let vector = self.task.observation_space(count);
        let (kind, camera_size) = (self.observation_type, self.camera_size);
        if !kind.kinematic && !kind.has_images() {
            return Err(EnvError::Option {
                option: "the observation type",
                got: "empty".into(),
                expected: "at least one part",
            });
        }
        let sides = 1..=ImageSize::MAX_SIDE;
        if !(sides.contains(&camera_size.width) && sides.contains(&camera_size.height)) {
            return Err(EnvError::Option {
                option: "the camera's size",
                got: camera_size.to_string(),
                expected: "sides of 1 to 8192 pixels",
            });
        }
        let limits = &self.action_limits;
        let decoders = (0..count)
            .map(|drone| ActionDecoder::new(self.action_type, self.controller, simulation.params(drone), limits))
            .collect::<Result<Vec<_>, _>>()?;
        let bounds = (0..count).flat_map(|drone| self.action_type.bounds(simulation.params(drone), limits));
        let action_space = BoxSpace::new(bounds);
        let cameras = kind.has_images().then(|| Painter::for_observations(simulation.world())).transpose()?;
        Ok(Aviary {
            observation: Observation::with_sizes(kind, vector.size(), count, camera_size),
            observation_space: ObservationSpace {
                vector: if kind.kinematic { vector } else { BoxSpace::new([]) },
                kind,
                cameras: count,
                camera_size,
            },
            cameras,
            painter: None,
            action_space,
            action_type: self.action_type,
            decoders,
            clipped: vec![0.0; self.action_type.size() * count],
            episode_steps: ((seconds * f64::from(simulation.ctrl_freq())).round() as u64).max(1),
            rng: Rng::seed_from_u64(0),
            phase: Phase::New,
            end: None,
            commands: vec![[0.0; 4]; count],
            task: self.task,
            simulation,
        })
    }
}

impl<T: Task> Aviary<T> {
    /// The task.
    pub fn task(&self) -> &T {
        &self.task
    }

    fn observe(&mut self) -> Result<(), EnvError> {
        if self.observation_space.kind.kinematic {
            self.task.observe(&self.simulation, &mut self.observation.vector);
        }
        if let Some(painter) = &mut self.cameras {
            painter.update(self.simulation.states())?;
            self.observation.take_pictures(painter, self.observation_space.camera_size)?;
        }
        Ok(())
    }

    fn commands(&mut self, action: &[f64]) -> Result<(), EnvError> {
        let expected = self.action_space.size();
        if action.len() != expected {
            return Err(EnvError::ActionLength { got: action.len(), expected });
        }
        if let Some((index, &got)) = action.iter().enumerate().find(|(_, x)| !x.is_finite()) {
            return Err(EnvError::Action { index, got, time: self.simulation.time() });
        }
        let bounds = self.action_space.low().iter().zip(self.action_space.high());
        for ((clipped, &x), (&low, &high)) in self.clipped.iter_mut().zip(action).zip(bounds) {
            *clipped = x.clamp(low, high);
        }
        let dt = self.simulation.control_period();
        let drones = self.decoders.iter_mut().zip(self.simulation.states());
        let parts = self.clipped.chunks_exact(self.action_type.size());
        for ((command, (decoder, state)), part) in self.commands.iter_mut().zip(drones).zip(parts) {
            *command = decoder.motor_speeds(dt, state, part);
        }
        Ok(())
    }
}

impl<T: Task> Env for Aviary<T> {
    fn name(&self) -> &'static str {
        self.task.name()
    }

    fn observation_space(&self) -> &ObservationSpace {
        &self.observation_space
    }

    fn action_space(&self) -> &BoxSpace {
        &self.action_space
    }

    fn reset(&mut self, seed: Option<u64>) -> Result<&Observation, EnvError> {
        if let Some(seed) = seed {
            self.rng = Rng::seed_from_u64(seed);
        }
        self.simulation.reset()?;
        self.task.reset(&self.simulation, &mut self.rng);
        for decoder in &mut self.decoders {
            decoder.reset();
        }
        self.end = None;
        self.phase = Phase::Running;
        self.observe()?;
        Ok(&self.observation)
    }

    fn step(&mut self, action: &[f64]) -> Result<Step<'_>, EnvError> {
        match self.phase {
            Phase::Running => {}
            Phase::New => return Err(EnvError::NeedsReset { when: "on a new environment" }),
            Phase::Over => return Err(EnvError::NeedsReset { when: "after the end of the episode" }),
        }
        self.commands(action)?;
        if let Err(error) = self.simulation.step(&self.commands) {
            self.phase = Phase::Over;
            return Err(error.into());
        }
        self.task.update(&self.simulation);

        let end = self.task.end(&self.simulation);
        let terminated = end.is_some();
        let truncated = self.simulation.control_steps() >= self.episode_steps;
        let reward = self.task.reward(&self.simulation, end);
        self.end = end.or(truncated.then_some(EndReason::TimeLimit));
        if self.end.is_some() {
            self.phase = Phase::Over;
        }
        self.observe()?;
        Ok(Step { observation: &self.observation, reward, terminated, truncated })
    }

    fn info(&self) -> Info {
        let position_error = (0..self.simulation.num_drones())
            .map(|drone| self.simulation.distance(drone, &self.reference(drone).position))
            .fold(0.0, f64::max);
        Info {
            time: self.simulation.time(),
            success: self.phase != Phase::New && self.task.success(&self.simulation),
            end: self.end,
            position_error,
            contacts: self.simulation.contacts().len(),
        }
    }

    fn episode_steps(&self) -> u64 {
        self.episode_steps
    }

    fn reference(&self, drone: usize) -> Reference {
        self.task.reference(&self.simulation, drone)
    }

    fn action_of_motor_speeds(&self, speeds: &[[f64; 4]], action: &mut [f64]) -> Result<(), EnvError> {
        if !matches!(self.action_type, ActionType::Rpm | ActionType::RawRpm) {
            return Err(EnvError::Option {
                option: "the action type",
                got: self.action_type.to_string(),
                expected: "rpm or raw_rpm, which command single motors",
            });
        }
        let expected = self.action_space.size();
        if action.len() != expected || speeds.len() * 4 != expected {
            return Err(EnvError::ActionLength { got: action.len().min(4 * speeds.len()), expected });
        }
        let raw = self.action_type == ActionType::RawRpm;
        for ((part, speeds), decoder) in action.chunks_exact_mut(4).zip(speeds).zip(&self.decoders) {
            for (command, &rpm) in part.iter_mut().zip(speeds) {
                *command = if raw { rpm } else { decoder.scale().command(rpm) };
            }
        }
        Ok(())
    }

    fn render(&mut self, view: View, size: ImageSize, rgb: &mut [u8]) -> Result<(), EnvError> {
        let painter = match &mut self.painter {
            Some(painter) => painter,
            none => none.insert(Painter::for_people(self.simulation.world())?),
        };
        painter.update(self.simulation.states())?;
        Ok(painter.rgb(view, size, rgb)?)
    }

    fn simulation(&self) -> &Simulation {
        &self.simulation
    }
}
