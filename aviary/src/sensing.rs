//! Rangefinders: distances from drones along rays.

use mujoco_rs::{BodyId, Data, Error, GeomId, JointId, Model};
use nalgebra::Vector3;

use crate::engine::{BuildError, place_geom};
use crate::state::{DroneState, wxyz};
use crate::world::{Obstacle, SceneError, World};

/// Rays of a rangefinder.
///
/// ```
/// use aviary::env::Env;
/// use aviary::observation::ObservationType;
/// use aviary::sensing::RangeConfig;
/// use aviary::tasks::Hover;
///
/// // to the four sides, with a range of 2 m
/// let directions = vec![[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]];
/// let rays = RangeConfig { directions, max_range: 2.0 };
/// let mut env = Hover::builder().observation_type(ObservationType::KIN_RANGES).rays(rays).build()?;
/// assert_eq!(env.reset(Some(1))?.ranges, [2.0; 4], "no obstacle in range");
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct RangeConfig {
    /// Directions, body frame; the lengths are arbitrary.
    pub directions: Vec<[f64; 3]>,
    /// Largest measured distance, m.
    pub max_range: f64,
}

/// Eight horizontal rays, one up and one down, with a range of 5 m.
impl Default for RangeConfig {
    fn default() -> Self {
        let around = (0..8).map(|i| {
            let (sin, cos) = (std::f64::consts::FRAC_PI_4 * f64::from(i)).sin_cos();
            [cos, sin, 0.0]
        });
        Self { directions: around.chain([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]).collect(), max_range: 5.0 }
    }
}

/// Rangefinders of all drones of a world.
///
/// The rangefinders call `mj_ray` in a scene with every obstacle, the floor and the drones. They also detect
/// transparent obstacles.
///
/// ```
/// use aviary::drone::DroneModel;
/// use aviary::sensing::{RangeConfig, Rangefinder};
/// use aviary::simulation::Simulation;
///
/// let simulation = Simulation::builder(DroneModel::Cf2x).initial_positions([[0.0, 0.0, 1.5]]).build()?;
/// let down = RangeConfig { directions: vec![[0.0, 0.0, -1.0]], ..RangeConfig::default() };
/// let mut finder = Rangefinder::new(simulation.world(), &down)?;
/// let mut distance = [0.0];
/// finder.measure(simulation.states(), &mut distance)?;
/// assert!((distance[0] - 1.5).abs() < 1e-9);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct Rangefinder {
    data: Data,
    joints: Vec<usize>,
    bodies: Vec<BodyId>,
    directions: Vec<Vector3<f64>>,
    max_range: f64,
}

impl Rangefinder {
    /// Creates the rangefinders of the drones of a world.
    ///
    /// # Errors
    /// [`BuildError`] for directions of length zero or a range that is not positive, and if the scene is invalid.
    pub fn new(world: &World, config: &RangeConfig) -> Result<Self, BuildError> {
        let wrong = |what: &str, got: f64, expected| {
            Err(BuildError::Scene(SceneError::Value { what: what.into(), got, expected }))
        };
        if !(config.max_range > 0.0 && config.max_range <= 1e6) {
            return wrong("the range of the rays", config.max_range, "a positive number up to 1e6 m");
        }
        let mut directions = Vec::new();
        for &direction in &config.directions {
            let direction = Vector3::from(direction);
            let length = direction.norm();
            if !(length > 1e-9 && length < 1e9) {
                return wrong("the length of a ray's direction", length, "a positive number");
            }
            directions.push(direction / length);
        }
        let mut model = Model::from_xml(&world.to_whole_mjcf()?)?;
        // MuJoCo's rays pass through transparent geoms; drones do not
        model.patch().geom_rgba_mut().chunks_exact_mut(4).for_each(|rgba| rgba[3] = 1.0);
        let (mut joints, mut bodies) = (Vec::new(), Vec::new());
        for index in 0..world.drones.len() {
            let joint: JointId = model.find(&World::drone_name(index))?;
            let address = model.jnt_qposadr()[joint.index()];
            joints.push(usize::try_from(address).expect("the address of a joint is not negative"));
            bodies.push(model.find(&World::drone_name(index))?);
        }
        let mut finder = Self { data: Data::new(model)?, joints, bodies, directions, max_range: config.max_range };
        finder.set_obstacles(&world.obstacles)?;
        Ok(finder)
    }

    /// Returns the number of rays per drone.
    pub fn rays(&self) -> usize {
        self.directions.len()
    }

    /// Returns the largest measured distance, m.
    pub fn max_range(&self) -> f64 {
        self.max_range
    }

    /// Replaces the obstacles by others of the same shapes in the same order.
    ///
    /// # Errors
    /// [`Error::UnknownName`] if there are more obstacles than in the scene, and MuJoCo's other errors.
    pub fn set_obstacles(&mut self, obstacles: &[Obstacle]) -> Result<(), Error> {
        for (index, obstacle) in obstacles.iter().enumerate() {
            let geom: GeomId = self.data.model().find(&World::obstacle_name(index))?;
            place_geom(&mut self.data.patch_model()?, geom, obstacle)?;
        }
        Ok(())
    }

    /// Writes the distances along the rays from the centre of each drone, drone by drone, m. The distance of a ray
    /// that meets nothing is the range. The rays of a drone pass through the drone itself.
    ///
    /// # Errors
    /// MuJoCo's errors.
    ///
    /// # Panics
    /// If the length of `out` is not the number of drones times the number of rays.
    pub fn measure(&mut self, states: &[DroneState], out: &mut [f64]) -> Result<(), Error> {
        assert_eq!(out.len(), self.bodies.len() * self.directions.len(), "`out` has one number per ray");
        for (&address, state) in self.joints.iter().zip(states) {
            let position = &mut self.data.qpos_mut()[address..][..7];
            position[..3].copy_from_slice(state.position.as_slice());
            position[3..].copy_from_slice(&wxyz(&state.attitude));
        }
        self.data.kinematics()?;
        let rays = self.directions.len().max(1);
        for ((state, &body), out) in states.iter().zip(&self.bodies).zip(out.chunks_exact_mut(rays)) {
            for (direction, out) in self.directions.iter().zip(out) {
                let along = state.attitude * direction;
                let hit = self.data.ray(state.position.into(), along.into(), [true; 6], Some(body))?;
                *out = hit.map_or(self.max_range, |(_, distance)| distance.min(self.max_range));
            }
        }
        Ok(())
    }
}
