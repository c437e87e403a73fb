use std::sync::Arc;

use rand::SeedableRng as _;

use super::aviary::Aviary;
use super::episode::Episode;
use super::moving::MovingMarkers;
use super::randomization::Randomizer;
use super::workspace::{EnvModel, EnvWorkspace, Synced};
use super::{BoxSpace, EnvError, ObservationSpace, Randomization, Rng, Task};
use crate::action::{ActionDecoder, ActionLimits, ActionType};
use crate::control::ControllerKind;
use crate::drone::{DroneModel, DroneParams};
use crate::engine::EngineKind;
use crate::observation::{Observation, ObservationType};
use crate::physics::actuators::ActuatorParams;
use crate::physics::wind::WindConfig;
use crate::physics::{Effects, Physics};
use crate::sensing::{RangeConfig, Rangefinder};
use crate::simulation::{Simulation, SimulationBuilder, SimulationError};
use crate::vision::{CAMERA_SIZE, ImageSize, SceneRenderer};
use crate::world::placement::CollisionCylinder;
use crate::world::{Forcing, Integrator, Marker, Medium, Obstacle, ObstacleConfig};

/// The options of an [`Aviary`]; what is not said is the task's or the paper's default.
///
/// ```
/// use aviary::drone::DroneModel;
/// use aviary::env::{DroneEnv, Env};
/// use aviary::physics::Physics;
/// use aviary::tasks::Race;
///
/// let env = Race::builder()
///     .drone(DroneModel::Race)
///     .task(|race| race.laps = 3)
///     .physics(Physics::MjcDrag)
///     .episode_seconds(60.0)
///     .build()?;
/// assert_eq!((env.task().laps, env.episode_steps()), (3, 60 * 48));
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Clone)]
pub struct AviaryBuilder<T> {
    task: T,
    simulation: SimulationBuilder,
    num_drones: Option<usize>,
    episode_seconds: Option<f64>,
    neighbourhood_radius: f64,
    action_type: ActionType,
    action_limits: ActionLimits,
    controller: ControllerKind,
    observation_type: ObservationType,
    camera_size: ImageSize,
    randomization: Option<Randomization>,
    obstacle_generator: Option<ObstacleConfig>,
    rays: RangeConfig,
    stream: u64,
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

/// Options without a task, for [`make`](crate::tasks::make).
///
/// ```
/// use aviary::env::EnvConfig;
/// use aviary::tasks::make;
///
/// let config = EnvConfig::default().ctrl_freq(30).episode_seconds(2.0);
/// for name in ["hover", "track"] {
///     let env = make(name, config.clone())?;
///     assert_eq!((env.name(), env.episode_steps()), (name, 60));
/// }
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
pub type EnvConfig = AviaryBuilder<()>;

impl Default for EnvConfig {
    fn default() -> Self {
        Self::new(())
    }
}

impl<T> AviaryBuilder<T> {
    /// Options for a task.
    pub fn new(task: T) -> Self {
        Self {
            task,
            simulation: Simulation::builder(DroneModel::Cf2x),
            num_drones: None,
            episode_seconds: None,
            neighbourhood_radius: f64::INFINITY,
            action_type: ActionType::default(),
            action_limits: ActionLimits::default(),
            controller: ControllerKind::default(),
            observation_type: ObservationType::default(),
            camera_size: CAMERA_SIZE,
            randomization: None,
            obstacle_generator: None,
            rays: RangeConfig::default(),
            stream: 0,
        }
    }

    /// The same options for another task.
    pub fn with_task<U>(self, task: U) -> AviaryBuilder<U> {
        AviaryBuilder {
            task,
            simulation: self.simulation,
            num_drones: self.num_drones,
            episode_seconds: self.episode_seconds,
            neighbourhood_radius: self.neighbourhood_radius,
            action_type: self.action_type,
            action_limits: self.action_limits,
            controller: self.controller,
            observation_type: self.observation_type,
            camera_size: self.camera_size,
            randomization: self.randomization,
            obstacle_generator: self.obstacle_generator,
            rays: self.rays,
            stream: self.stream,
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

    /// Number of drones; the task's by default.
    #[must_use]
    pub fn num_drones(mut self, count: usize) -> Self {
        self.num_drones = Some(count);
        self
    }

    /// Length of an episode, s; the task's by default.
    #[must_use]
    pub fn episode_seconds(mut self, seconds: f64) -> Self {
        self.episode_seconds = Some(seconds);
        self
    }

    /// Distance within which drones are neighbours in [`Observation::adjacency`], m; any by default.
    #[must_use]
    pub fn neighbourhood_radius(mut self, metres: f64) -> Self {
        self.neighbourhood_radius = metres;
        self
    }

    forward! {
        /// The physics mode; MuJoCo without aerodynamic effects by default.
        physics(physics: Physics);
        /// Any subset of the aerodynamic effects; those of the physics mode by default. Next to a physics mode with other effects they
        /// are an error.
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
        /// The engine; by default the explicit engine in the physics mode `dyn`, and otherwise MuJoCo (in batches the hybrid engine).
        /// The hybrid engine gives the same flights as MuJoCo, many times faster. An engine that the physics mode does not stand for
        /// is an error.
        engine(engine: EngineKind);
        /// How the rotors' wrench acts during a physics step; frozen by default.
        forcing(forcing: Forcing);
        /// How the motors answer to commands; at once and exactly by default.
        actuators(actuators: ActuatorParams);
        /// Things that are seen and not touched, beside the task's own.
        markers(markers: impl IntoIterator<Item = Marker>);
        /// Things that stand in the way; none by default.
        obstacles(obstacles: impl IntoIterator<Item = Obstacle>);
        /// MuJoCo's integrator; RK4 by default.
        integrator(integrator: Integrator);
        /// The wind; still air by default. Every episode has its own, drawn from the environment's seed.
        wind(wind: impl Into<Option<WindConfig>>);
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

    /// What is drawn anew for every episode; nothing by default.
    #[must_use]
    pub fn randomization(mut self, randomization: impl Into<Option<Randomization>>) -> Self {
        self.randomization = randomization.into();
        self
    }

    /// Obstacles that are placed at random; none by default. They exclude a list of [`obstacles`](Self::obstacles).
    #[must_use]
    pub fn obstacle_generator(mut self, generator: impl Into<Option<ObstacleConfig>>) -> Self {
        self.obstacle_generator = generator.into();
        self
    }

    /// The rays of the drones' rangefinders, where they are observed; eight around, one up, one down by default.
    #[must_use]
    pub fn rays(mut self, rays: RangeConfig) -> Self {
        self.rays = rays;
        self
    }

    /// The engine, for callers that have their own idea of a default.
    #[must_use]
    pub(crate) fn engine_or(mut self, engine: EngineKind) -> Self {
        self.simulation = self.simulation.engine_or(engine);
        self
    }

    /// Which of a seed's random streams it draws from; 0 by default. Environment i of a batch has stream i.
    #[must_use]
    pub fn stream(mut self, stream: u64) -> Self {
        self.stream = stream;
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
}

impl<T: Task> AviaryBuilder<T> {
    /// Most pixels of all onboard cameras together: about 1.5 GB of images.
    const MAX_CAMERA_PIXELS: usize = 1 << 27;

    /// Compiles the world. The environment must be [reset](super::Env::reset) before its first step.
    ///
    /// # Errors
    /// [`EnvError`] naming the option that is impossible.
    pub fn build(self) -> Result<Aviary<T>, EnvError> {
        let defaults = self.task.defaults();
        let count = self.num_drones.unwrap_or(defaults.num_drones);
        if !(1..=Simulation::MAX_DRONES).contains(&count) {
            return Err(SimulationError::NumDrones { got: count }.into());
        }
        let simulation = self.simulation.num_drones(count);
        self.task.validate(simulation.airframes())?;
        let seconds = self.episode_seconds.unwrap_or(defaults.episode_seconds);
        // the shortest episode is one control step; a year of them still counts exactly
        if !(seconds.is_finite() && seconds > 0.0 && seconds < 4e7) {
            return Err(EnvError::Option {
                option: "episode_seconds",
                got: format!("{} s", crate::number(seconds)),
                expected: "a positive number of seconds below 4e7",
            });
        }
        if self.neighbourhood_radius.is_nan() || self.neighbourhood_radius < 0.0 {
            return Err(EnvError::Option {
                option: "neighbourhood_radius",
                got: format!("{} m", crate::number(self.neighbourhood_radius)),
                expected: "zero or a positive number of metres",
            });
        }
        let wind = simulation.wind_config().copied();
        if let (Some(randomization), Some(wind)) = (&self.randomization, &wind) {
            randomization.validate_wind(wind)?;
        }
        if self.obstacle_generator.is_some() && simulation.has_obstacles() {
            return Err(EnvError::Option {
                option: "obstacles",
                got: "a list, with an obstacle_generator as well".into(),
                expected: "one of the two",
            });
        }
        let positions = self.task.initial_positions(simulation.airframes());
        let moving = self.task.moving_markers();
        let visible = moving.iter().filter(|marker| !marker.solid).map(|marker| marker.marker.clone());
        let markers: Vec<_> = self.task.markers().into_iter().chain(visible).collect();
        let mut simulation = simulation.initial_positions_or(positions).markers(markers);
        if let Some(generator) = &self.obstacle_generator {
            let mut rng = Rng::seed_from_u64(generator.seed.unwrap_or(0));
            let obstacles = generator.generate(simulation.starts(), &mut rng)?;
            simulation = simulation.obstacles(obstacles);
        }
        let solid = moving.iter().filter(|marker| marker.solid).map(|marker| marker.marker.body);
        let simulation = simulation.more_obstacles(solid).build()?;
        let moving = MovingMarkers::new(moving, simulation.world());
        check_starts(&simulation)?;
        let block = self.task.observation_space();
        let vector = block.repeated(count);
        let (kind, camera_size) = (self.observation_type, self.camera_size);
        if kind.is_empty() {
            return Err(EnvError::Option {
                option: "observation_type",
                got: "empty".into(),
                expected: "at least one part",
            });
        }
        let sides = 1..=ImageSize::MAX_SIDE;
        if !(sides.contains(&camera_size.width) && sides.contains(&camera_size.height)) {
            return Err(EnvError::Option {
                option: "camera_size",
                got: camera_size.to_string(),
                expected: "sides of 1 to 8192 pixels",
            });
        }
        if kind.has_images() && camera_size.pixels().saturating_mul(count) > Self::MAX_CAMERA_PIXELS {
            return Err(EnvError::Option {
                option: "camera_size",
                got: format!("{camera_size} for {count} drones"),
                expected: "at most 2^27 pixels of all onboard cameras together",
            });
        }
        let limits = &self.action_limits;
        let decoders = (0..count)
            .map(|drone| ActionDecoder::new(self.action_type, self.controller, simulation.params(drone), limits))
            .collect::<Result<Vec<_>, _>>()?;
        let bounds = (0..count).flat_map(|drone| self.action_type.bounds(simulation.params(drone), limits));
        let action_space = BoxSpace::new(bounds);
        let cameras = kind.has_images().then(|| SceneRenderer::for_observations(simulation.world())).transpose()?;
        let observation = Observation::with_sizes(kind, vector.size(), count, camera_size, self.rays.directions.len());
        let observation_space = ObservationSpace {
            vector: if kind.kinematic { vector } else { BoxSpace::new([]) },
            kind,
            cameras: count,
            neighbours: count,
            rays: (self.rays.directions.len(), self.rays.max_range),
            camera_size,
        };
        let rangefinder = kind.ranges.then(|| Rangefinder::new(simulation.world(), &self.rays)).transpose()?;
        let randomizer =
            self.randomization.map(|config| Randomizer::new(config, simulation.view(), wind)).transpose()?;
        let model = EnvModel {
            action_type: self.action_type,
            action_space,
            row_space: observation_space.row(),
            observation_space,
            episode_steps: ((seconds * f64::from(simulation.ctrl_freq())).round() as u64).max(1),
            obstacle_generator: self.obstacle_generator,
            first_layout: simulation.obstacles()[..moving.first_obstacle()].to_vec(),
            block: block.size(),
            neighbourhood_radius: self.neighbourhood_radius,
        };
        let workspace = EnvWorkspace {
            moving,
            rangefinder: rangefinder.map(Synced::new),
            cameras: cameras.map(Synced::new),
            observation,
            clipped: vec![0.0; self.action_type.size() * count],
            commands: vec![[0.0; 4]; count],
            starts: simulation.initial_states().to_vec(),
        };
        Ok(Aviary {
            model: Arc::new(model),
            simulation,
            episode: Episode::new(self.task, self.stream, randomizer, count),
            decoders,
            workspace,
            renderer: None,
        })
    }
}

/// An episode that begins inside the floor or another drone is over before it began.
fn check_starts(simulation: &Simulation) -> Result<(), EnvError> {
    let wrong = |got, expected| Err(EnvError::Option { option: "initial_positions", got, expected });
    for (drone, state) in simulation.initial_states().iter().enumerate() {
        let cylinder = CollisionCylinder::from(simulation.params(drone));
        let lowest = cylinder.floor_clearance(state);
        if lowest < -1e-3 {
            let got =
                format!("{:.3} m high for drone {drone}, whose lowest point is {lowest:.3} m high", state.position.z);
            return wrong(got, "one above the floor");
        }
        for (other, place) in simulation.initial_states()[..drone].iter().enumerate() {
            let apart = state.position - place.position;
            if cylinder.overlaps_upright(&CollisionCylinder::from(simulation.params(other)), &apart) {
                let got = format!("{:.3} m apart for drones {other} and {drone}", apart.norm());
                return wrong(got, "room for both");
            }
        }
    }
    Ok(())
}
