use std::sync::Arc;

use super::aviary::Aviary;
use super::episode::Episode;
use super::moving::MovingMarkers;
use super::randomization::Randomizer;
use super::workspace::{EnvModel, EnvWorkspace, Measured, Synced};
use super::{BoxSpace, EnvError, ObservationSpace, Randomization, Task, TaskOptions};
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

/// Options of an [`Aviary`]. The defaults are those of the task and of the paper.
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
    action_type: Option<ActionType>,
    action_limits: ActionLimits,
    controller: ControllerKind,
    observation_type: ObservationType,
    camera_size: ImageSize,
    randomization: Option<Randomization>,
    obstacle_generator: Option<ObstacleConfig>,
    rays: RangeConfig,
    stream: u64,
}

/// Options that set the same option of the simulation.
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

/// Options for a task that is selected by name, for [`make`](crate::tasks::make),
/// [`make_vec`](crate::vector::make_vec) and [`make_parallel`](crate::multi_agent::make_parallel).
///
/// [`task`](AviaryBuilder::task) sets [options of the task](TaskOptions) by name.
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
pub type EnvConfig = AviaryBuilder<TaskOptions>;

impl Default for EnvConfig {
    fn default() -> Self {
        Self::new(TaskOptions::default())
    }
}

impl<T> AviaryBuilder<T> {
    /// Creates the default options for a task.
    pub fn new(task: T) -> Self {
        Self {
            task,
            simulation: Simulation::builder(DroneModel::Cf2x),
            num_drones: None,
            episode_seconds: None,
            neighbourhood_radius: f64::INFINITY,
            action_type: None,
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

    /// Returns the options of the task.
    pub(super) fn task_options(&self) -> &T {
        &self.task
    }

    /// Returns the same options for another task. The options of the present task are dropped; see
    /// [`for_task`](EnvConfig::for_task).
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

    /// Changes the options of the task.
    #[must_use]
    pub fn task(mut self, change: impl FnOnce(&mut T)) -> Self {
        change(&mut self.task);
        self
    }

    /// Sets the airframe of every drone; default the Crazyflie (X).
    #[must_use]
    pub fn drone(mut self, drone: impl Into<DroneParams>) -> Self {
        self.simulation = self.simulation.drones([drone.into()]);
        self
    }

    /// Sets the number of drones; default the task's.
    #[must_use]
    pub fn num_drones(mut self, count: usize) -> Self {
        self.num_drones = Some(count);
        self
    }

    /// Sets the length of an episode, s; default the task's.
    #[must_use]
    pub fn episode_seconds(mut self, seconds: f64) -> Self {
        self.episode_seconds = Some(seconds);
        self
    }

    /// Sets the distance within which drones are neighbours in [`Observation::adjacency`], m; default infinite.
    #[must_use]
    pub fn neighbourhood_radius(mut self, metres: f64) -> Self {
        self.neighbourhood_radius = metres;
        self
    }

    forward! {
        /// Sets the physics mode; default MuJoCo without aerodynamic effects.
        physics(physics: Physics);
        /// Sets the aerodynamic effects; default those of the physics mode. [`build`](Self::build) returns an error
        /// if they differ from those of a physics mode that is also set.
        effects(effects: Effects);
        /// Sets the physics rate, Hz; default 240.
        sim_freq(hertz: u32);
        /// Sets the control rate, Hz, a divisor of the physics rate; default 48.
        ctrl_freq(hertz: u32);
        /// Sets the initial positions, world frame, m; default the task's.
        initial_positions(positions: impl IntoIterator<Item = [f64; 3]>);
        /// Sets the initial roll, pitch and yaw, rad; default zero (level, facing x).
        initial_rpys(rpys: impl IntoIterator<Item = [f64; 3]>);
        /// Sets the initial velocities, world frame, m/s; default zero.
        initial_velocities(velocities: impl IntoIterator<Item = [f64; 3]>);
        /// Sets the initial angular velocities, body frame, rad/s; default zero.
        initial_angular_velocities(rates: impl IntoIterator<Item = [f64; 3]>);
        /// Sets the engine; default the explicit engine for the physics mode `dyn`, otherwise MuJoCo (in batches
        /// the hybrid engine). The hybrid engine computes the same trajectories as MuJoCo, many times faster.
        /// [`build`](Self::build) returns an error if the engine contradicts the physics mode.
        engine(engine: EngineKind);
        /// Sets how the rotors' wrench acts during a physics step; default frozen.
        forcing(forcing: Forcing);
        /// Sets the motor parameters; default immediate and exact.
        actuators(actuators: ActuatorParams);
        /// Adds markers to those of the task. Markers are visible and do not collide.
        markers(markers: impl IntoIterator<Item = Marker>);
        /// Sets the obstacles; default none.
        obstacles(obstacles: impl IntoIterator<Item = Obstacle>);
        /// Sets MuJoCo's integrator; default RK4.
        integrator(integrator: Integrator);
        /// Sets the wind; default still air. Every episode restarts it with a seed from the environment's random
        /// stream.
        wind(wind: impl Into<Option<WindConfig>>);
        /// Sets the medium of MuJoCo's fluid forces; default none.
        medium(medium: impl Into<Option<Medium>>);
    }

    /// Sets the action type; default the task's: normalized motor speeds in all tasks but [`Base`](crate::tasks::Base).
    #[must_use]
    pub fn action_type(mut self, action_type: ActionType) -> Self {
        self.action_type = Some(action_type);
        self
    }

    /// Sets the bounds of actions other than motor speeds.
    #[must_use]
    pub fn action_limits(mut self, limits: ActionLimits) -> Self {
        self.action_limits = limits;
        self
    }

    /// Sets the controller that turns velocities and waypoints into motor speeds; default the paper's PID.
    #[must_use]
    pub fn controller(mut self, controller: ControllerKind) -> Self {
        self.controller = controller;
        self
    }

    /// Sets the parameters that are sampled for every episode; default none.
    #[must_use]
    pub fn randomization(mut self, randomization: impl Into<Option<Randomization>>) -> Self {
        self.randomization = randomization.into();
        self
    }

    /// Sets the generator of random obstacles; default none. It excludes a list of [`obstacles`](Self::obstacles).
    #[must_use]
    pub fn obstacle_generator(mut self, generator: impl Into<Option<ObstacleConfig>>) -> Self {
        self.obstacle_generator = generator.into();
        self
    }

    /// Sets the rays of the rangefinders; default eight in the body's x-y plane, one up and one down.
    #[must_use]
    pub fn rays(mut self, rays: RangeConfig) -> Self {
        self.rays = rays;
        self
    }

    /// Sets the default of [`engine`](Self::engine).
    #[must_use]
    pub(crate) fn engine_or(mut self, engine: EngineKind) -> Self {
        self.simulation = self.simulation.engine_or(engine);
        self
    }

    /// Sets the index of the seed's random stream; default 0. Environment i of a batch uses stream i.
    #[must_use]
    pub fn stream(mut self, stream: u64) -> Self {
        self.stream = stream;
        self
    }

    /// Sets the observation type; default the task's vector.
    #[must_use]
    pub fn observation_type(mut self, observation_type: ObservationType) -> Self {
        self.observation_type = observation_type;
        self
    }

    /// Sets the image size of the onboard cameras; default 64 × 48.
    #[must_use]
    pub fn camera_size(mut self, size: ImageSize) -> Self {
        self.camera_size = size;
        self
    }
}

impl<T: Task> AviaryBuilder<T> {
    /// Maximum number of pixels of all onboard cameras together: about 1.5 GB of images.
    const MAX_CAMERA_PIXELS: usize = 1 << 27;

    /// Compiles the scene and creates the environment. It must be [reset](super::Env::reset) before its first step.
    ///
    /// # Errors
    /// [`EnvError`] naming the invalid option.
    pub fn build(self) -> Result<Aviary<T>, EnvError> {
        let defaults = self.task.defaults();
        let count = self.num_drones.unwrap_or(defaults.num_drones);
        if !(1..=Simulation::MAX_DRONES).contains(&count) {
            return Err(SimulationError::NumDrones { got: count }.into());
        }
        let simulation = self.simulation.num_drones(count);
        self.task.validate(simulation.airframes())?;
        let action_type = self.action_type.unwrap_or_else(|| self.task.action_type());
        let seconds = self.episode_seconds.unwrap_or(defaults.episode_seconds);
        // the step count of an episode below 4e7 s is exact
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
                got: "a list next to an obstacle_generator".into(),
                expected: "only one of the two",
            });
        }
        let positions = self.task.initial_positions(simulation.airframes());
        let moving = self.task.moving_markers();
        let visible = moving.iter().filter(|marker| !marker.solid).map(|marker| marker.marker.clone());
        let markers: Vec<_> = self.task.markers().into_iter().chain(visible).collect();
        let mut simulation = simulation.initial_positions_or(positions).markers(markers);
        if let Some(generator) = &self.obstacle_generator {
            let obstacles = generator.first_layout(simulation.starts())?;
            simulation = simulation.obstacles(obstacles);
        }
        let solid: Vec<_> = moving.iter().filter(|marker| marker.solid).collect();
        // those that move in an episode are the last ones of the list
        let standing = solid.iter().take_while(|marker| marker.stands_still).count();
        let bodies = |markers: &[&crate::world::MovingMarker]| {
            markers.iter().map(|marker| marker.marker.body).collect::<Vec<_>>()
        };
        let (standing, others) = (bodies(&solid[..standing]), bodies(&solid[standing..]));
        let simulation = simulation.more_obstacles(standing).moving_obstacles(others).build()?;
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
            .map(|drone| ActionDecoder::new(action_type, self.controller, simulation.params(drone), limits))
            .collect::<Result<Vec<_>, _>>()?;
        let bounds = (0..count).flat_map(|drone| action_type.bounds(simulation.params(drone), limits));
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
            action_type,
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
            clipped: vec![0.0; action_type.size() * count],
            commands: vec![[0.0; 4]; count],
            starts: simulation.initial_states().to_vec(),
            measured: Measured::default(),
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

/// Returns an error if a drone starts inside the floor or another drone, which would end every episode at once.
fn check_starts(simulation: &Simulation) -> Result<(), EnvError> {
    let wrong = |got, expected| Err(EnvError::Option { option: "initial_positions", got, expected });
    for (drone, state) in simulation.initial_states().iter().enumerate() {
        let cylinder = CollisionCylinder::from(simulation.params(drone));
        let lowest = cylinder.floor_clearance(state);
        if lowest < -1e-3 {
            let z = state.position.z;
            let got = format!("z = {z:.3} m for drone {drone} (lowest point {lowest:.3} m)");
            return wrong(got, "a start above the floor");
        }
        for (other, place) in simulation.initial_states()[..drone].iter().enumerate() {
            let apart = state.position - place.position;
            if cylinder.overlaps_upright(&CollisionCylinder::from(simulation.params(other)), &apart) {
                let got = format!("{:.3} m apart for drones {other} and {drone}", apart.norm());
                return wrong(got, "starts that do not overlap");
            }
        }
    }
    Ok(())
}
