//! The scene as typed values, and as MJCF text.

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
pub use visual_model::{CF2_ASSETS, check_obj};

/// The air, as MuJoCo's own fluid model sees it.
///
/// Off by default: the physics modes say which aerodynamic effects there are, and MuJoCo's drag on top of them would
/// count it twice. In wind the medium moves with the air: the simulation adds the difference to MuJoCo's force of a still
/// medium, from the state at the start of the physics step.
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
    /// Air at sea level, as MuJoCo Menagerie's Crazyflie has it.
    pub const AIR: Self = Self { density: 1.225, viscosity: 1.8e-5 };
}

/// How the rotors' wrench acts during a physics step.
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
    /// Constant in the world frame, computed from the attitude at the start of the step: the paper's. While the body
    /// turns, position is first order in the time step whatever the integrator.
    #[default]
    Frozen,
    /// Fixed to the body, which turns with it inside every stage of the integrator: RK4 keeps its fourth order.
    BodyFixed,
}

/// One drone in the scene.
#[derive(Debug, Clone, PartialEq)]
pub struct DroneBody {
    /// Airframe.
    pub params: DroneParams,
    /// Position in the compiled scene, world frame, m.
    pub position: Vector3<f64>,
    /// Roll, pitch, yaw in the compiled scene, rad: intrinsic z-y'-x''.
    pub rpy: Vector3<f64>,
}

/// A scene: a floor, things standing around, and drones.
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
    /// MuJoCo's integrator; the paper's is RK4.
    pub integrator: Integrator,
    /// Acceleration of gravity, downwards, m/s².
    pub gravity: f64,
    /// The air; `None` for MuJoCo's vacuum.
    pub medium: Option<Medium>,
    /// How the rotors' wrench acts during a physics step.
    pub forcing: Forcing,
    /// Things that do not move, in order: obstacle i is the geom `obstacle{i}`.
    pub obstacles: Vec<Obstacle>,
    /// Things that are seen and not touched.
    pub markers: Vec<Marker>,
    /// The drones, in order: drone i is the body `drone{i}`.
    pub drones: Vec<DroneBody>,
}

impl World {
    /// A floor and these drones, at 240 Hz, RK4, without a medium.
    pub fn new(drones: Vec<DroneBody>) -> Self {
        Self {
            timestep: 1.0 / 240.0,
            integrator: Integrator::Rk4,
            gravity: GRAVITY,
            medium: None,
            forcing: Forcing::Frozen,
            obstacles: Vec::new(),
            markers: Vec::new(),
            drones,
        }
    }

    /// Which obstacles the physical scene has a geom for: all of them, or of very many as many of each shape as drones can
    /// touch at once. The engine puts those that are near into these geoms: MuJoCo would place and test every one of
    /// them four times a step.
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

    /// Name of a drone's body in the scene, and of its collision geom.
    pub fn drone_name(index: usize) -> String {
        format!("drone{index}")
    }

    /// Name of an obstacle's geom in the scene.
    pub fn obstacle_name(index: usize) -> String {
        format!("obstacle{index}")
    }

    /// Names of the four actuators through which a drone's rotors act where forcing is body-fixed: thrust along body z
    /// (N), and torques about body x, y and z (N·m).
    pub fn actuator_names(index: usize) -> [String; 4] {
        ["thrust", "roll", "pitch", "yaw"].map(|what| format!("drone{index}_{what}"))
    }

    /// Name of a drone's onboard camera in the visible scene.
    pub fn camera_name(index: usize) -> String {
        format!("drone{index}_camera")
    }

    /// Smallest size of an obstacle or marker, m.
    pub const MIN_SIZE: f64 = 1e-4;

    /// Largest size of an obstacle or marker, m.
    pub const MAX_SIZE: f64 = 1e4;

    /// Largest coordinate of an obstacle, a marker or an initial position, m, in both directions.
    pub const MAX_COORDINATE: f64 = 1e5;

    /// Largest roll, pitch or yaw of an obstacle, a marker or an initial attitude, rad, in both directions.
    pub const MAX_ANGLE: f64 = 1e3;

    /// Largest acceleration of gravity, m/s², in both directions.
    pub const MAX_GRAVITY: f64 = 1e4;

    /// Vertical field of view of every onboard camera, degrees.
    pub const CAMERA_FOVY: f64 = 60.0;

    /// Where the onboard camera sits, body frame, m. It looks along body x, with body z up.
    pub const CAMERA_POSITION: [f64; 3] = [0.02, 0.0, 0.0];

    /// Nearest and farthest distance that cameras see, m.
    pub const CLIP_PLANES: [f64; 2] = [0.01, 100.0];

    /// Geom group of what is only to be looked at; collision geoms of drones are in
    /// [`COLLISION_GROUP`](Self::COLLISION_GROUP).
    pub const VISUAL_GROUP: usize = 2;

    /// Geom group of the drones' collision geoms in the visible scene, which is not drawn.
    pub const COLLISION_GROUP: usize = 3;
}
