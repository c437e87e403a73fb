//! Scene of a simulation as typed values and as MJCF text.

mod mjcf;
mod obstacle;
mod obstacle_generator;
pub(crate) mod placement;
mod visual_model;

use nalgebra::Vector3;

use crate::drone::{DroneParams, GRAVITY};

pub use mjcf::SceneError;
pub use mujoco_rs::Integrator;
pub use obstacle::{Marker, MarkerPose, MovingMarker, Obstacle, Shape};
pub use obstacle_generator::{ObstacleConfig, ObstacleGeneratorError, ObstacleKind};
pub use visual_model::{CF2_ASSETS, VisualMesh, check_obj};

/// Air of MuJoCo's fluid model.
///
/// The medium is off by default, because the physics modes select the aerodynamic effects and MuJoCo's drag would
/// count them twice. In wind the medium moves with the air: the simulation adds the difference between the force of
/// the moving and the still medium, from the state at the start of the physics step.
///
/// ```
/// use aviary::drone::DroneModel;
/// use aviary::simulation::Simulation;
/// use aviary::world::Medium;
///
/// let simulation = Simulation::builder(DroneModel::Cf2x).medium(Medium::AIR).build()?;
/// assert_eq!(simulation.world().medium, Some(Medium::AIR));
/// # Ok::<(), aviary::simulation::SimulationError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Medium {
    /// Density, kg/m³.
    pub density: f64,
    /// Dynamic viscosity, Pa·s.
    pub viscosity: f64,
}

impl Medium {
    /// Air at sea level, with the values of MuJoCo Menagerie's Crazyflie.
    pub const AIR: Self = Self { density: 1.225, viscosity: 1.8e-5 };
}

/// Frame in which the rotors' wrench is constant during a physics step.
///
/// ```
/// use aviary::drone::DroneModel;
/// use aviary::simulation::Simulation;
/// use aviary::world::Forcing;
///
/// let mut simulation = Simulation::builder(DroneModel::Cf2x).forcing(Forcing::BodyFixed).build()?;
/// simulation.step(&[[14_000.0; 4]])?;
/// assert_eq!(simulation.world().forcing, Forcing::BodyFixed);
/// # Ok::<(), aviary::simulation::SimulationError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Forcing {
    /// Constant in the world frame, computed from the attitude at the start of the step, as in the paper
    /// (*MuJoCo-Drones-Gym*, Tayal). While the drone rotates, the position is first order in the time step with any
    /// integrator.
    #[default]
    Frozen,
    /// Constant in the body frame, which rotates inside the stages of the integrator: RK4 keeps its fourth order.
    BodyFixed,
}

/// Drone of a scene.
#[derive(Debug, Clone, PartialEq)]
pub struct DroneBody {
    /// Parameters of the drone.
    pub params: DroneParams,
    /// Position in the compiled scene, world frame, m.
    pub position: Vector3<f64>,
    /// Roll, pitch, yaw in the compiled scene, rad: intrinsic z-y'-x''.
    pub rpy: Vector3<f64>,
}

/// Scene with a floor, obstacles, markers and drones.
///
/// ```
/// use aviary::drone::DroneModel;
/// use aviary::world::{DroneBody, Obstacle, Shape, World};
/// use mujoco_rs::{GeomId, Model};
/// use nalgebra::Vector3;
///
/// let position = Vector3::new(0.0, 0.0, 1.0);
/// let drone = DroneBody { params: DroneModel::Cf2x.params(), position, rpy: Vector3::zeros() };
/// let mut world = World::new(vec![drone]);
/// world.obstacles.push(Obstacle::new(Shape::Sphere { radius: 0.2 }, Vector3::new(1.0, 0.0, 0.5)));
/// let model = Model::from_xml(&world.to_mjcf()?)?;
/// assert_eq!(model.nbody(), 2, "the drone, and MuJoCo's world");
/// assert!(model.find::<GeomId>(&World::obstacle_name(0)).is_ok());
/// # Ok::<(), aviary::engine::BuildError>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct World {
    /// Length of a physics step, s.
    pub timestep: f64,
    /// MuJoCo's integrator; RK4 in the paper.
    pub integrator: Integrator,
    /// Acceleration of gravity, downwards, m/s².
    pub gravity: f64,
    /// Medium of MuJoCo's fluid model; `None` for a vacuum.
    pub medium: Option<Medium>,
    /// Frame in which the rotors' wrench is constant during a physics step.
    pub forcing: Forcing,
    /// Obstacles, in order: obstacle i is the geom `obstacle{i}`.
    pub obstacles: Vec<Obstacle>,
    /// Number of obstacles that move between control steps, the last ones of the list.
    pub moving_obstacles: usize,
    /// Markers, which are visible and have no contacts.
    pub markers: Vec<Marker>,
    /// Drones, in order: drone i is the body `drone{i}`.
    pub drones: Vec<DroneBody>,
}

impl World {
    /// Creates a world with a floor and these drones, at 240 Hz, with RK4 and without a medium.
    pub fn new(drones: Vec<DroneBody>) -> Self {
        Self {
            timestep: 1.0 / 240.0,
            integrator: Integrator::Rk4,
            gravity: GRAVITY,
            medium: None,
            forcing: Forcing::Frozen,
            obstacles: Vec::new(),
            moving_obstacles: 0,
            markers: Vec::new(),
            drones,
        }
    }

    /// Returns the obstacles that have a geom in the physical scene: all obstacles, or, of a large number, as many of
    /// each shape as the drones can touch at once. The engine assigns these geoms to the nearest obstacles, because
    /// MuJoCo would place and test every geom four times per step.
    pub(crate) fn slots(&self) -> Vec<usize> {
        const ALL_UP_TO: usize = 12;
        let each = 6 * self.drones.len();
        let mut used = [0; 4];
        let take = |index: &usize| {
            let used = &mut used[self.obstacles[*index].shape.kind()];
            *used += 1;
            self.obstacles.len() <= ALL_UP_TO || *used <= each
        };
        (0..self.obstacles.len()).filter(take).collect()
    }

    /// Returns the name of a drone's body and of its collision geom in the scene.
    pub fn drone_name(index: usize) -> String {
        format!("drone{index}")
    }

    /// Returns the name of an obstacle's geom in the scene.
    pub fn obstacle_name(index: usize) -> String {
        format!("obstacle{index}")
    }

    /// Returns the names of the four actuators of a drone's rotors with body-fixed forcing: thrust along body z (N),
    /// and torques about body x, y and z (N·m).
    pub fn actuator_names(index: usize) -> [String; 4] {
        ["thrust", "roll", "pitch", "yaw"].map(|what| format!("drone{index}_{what}"))
    }

    /// Returns the name of a drone's onboard camera in the visible scene.
    pub fn camera_name(index: usize) -> String {
        format!("drone{index}_camera")
    }

    /// Smallest size of an obstacle or marker, m.
    pub const MIN_SIZE: f64 = 1e-4;

    /// Largest size of an obstacle or marker, m.
    pub const MAX_SIZE: f64 = 1e4;

    /// Largest magnitude of a coordinate of an obstacle, a marker or an initial position, m.
    pub const MAX_COORDINATE: f64 = 1e5;

    /// Largest magnitude of roll, pitch or yaw of an obstacle, a marker or an initial attitude, rad.
    pub const MAX_ANGLE: f64 = 1e3;

    /// Largest magnitude of the acceleration of gravity, m/s².
    pub const MAX_GRAVITY: f64 = 1e4;

    /// Vertical field of view of every onboard camera, degrees.
    pub const CAMERA_FOVY: f64 = 60.0;

    /// Position of the onboard camera, body frame, m. The camera looks along body x, with body z up.
    pub const CAMERA_POSITION: [f64; 3] = [0.02, 0.0, 0.0];

    /// Distances of the near and the far clip plane of cameras, m.
    pub const CLIP_PLANES: [f64; 2] = [0.01, 100.0];

    /// Geom group of the visual geoms; the collision geoms of drones are in
    /// [`COLLISION_GROUP`](Self::COLLISION_GROUP).
    pub const VISUAL_GROUP: usize = 2;

    /// Geom group of the drones' collision geoms in the visible scene; renderers do not draw it.
    pub const COLLISION_GROUP: usize = 3;
}
