//! What a drone measures besides its own state: distances along rays.

use mujoco_rs::{BodyId, Data, Error, GeomId, JointId, Model};
use nalgebra::Vector3;

use crate::engine::{BuildError, place_geom};
use crate::state::{DroneState, wxyz};
use crate::world::{Obstacle, SceneError, World};

/// Which rays a drone measures along.
///
/// ```
/// use aviary::env::Env;
/// use aviary::observation::ObservationType;
/// use aviary::sensing::RangeConfig;
/// use aviary::tasks::Hover;
///
/// // to the four sides, as far as 2 m
/// let directions = vec![[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]];
/// let rays = RangeConfig { directions, max_range: 2.0 };
/// let mut env = Hover::builder().observation_type(ObservationType::KIN_RANGES).rays(rays).build()?;
/// assert_eq!(env.reset(Some(1))?.ranges, [2.0; 4], "nothing stands there");
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct RangeConfig {
    /// Directions in the body frame, of any length.
    pub directions: Vec<[f64; 3]>,
    /// Distance beyond which nothing is seen, m.
    pub max_range: f64,
}

/// Eight rays around, one up and one down, 5 m far.
impl Default for RangeConfig {
    fn default() -> Self {
        let around = (0..8).map(|i| {
            let (sin, cos) = (std::f64::consts::FRAC_PI_4 * f64::from(i)).sin_cos();
            [cos, sin, 0.0]
        });
        Self { directions: around.chain([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]).collect(), max_range: 5.0 }
    }
}

/// Rangefinders of all drones of a world: `mj_ray` in a scene that has every obstacle, the floor and the drones. Transparent
/// obstacles are as solid for rays as they are for drones.
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
    /// For the drones of a world.
    ///
    /// # Errors
    /// [`BuildError`] for directions without length or a range that is not positive.
    pub fn new(world: &World, config: &RangeConfig) -> Result<Self, BuildError> {
        let wrong = |what: &str, got: f64, expected| {
            Err(BuildError::Scene(SceneError::Value { what: what.into(), got, expected }))
        };
        if !(config.max_range > 0.0 && config.max_range <= 1e6) {
            return wrong("the range of the rays", config.max_range, "a positive number of metres");
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
        // MuJoCo's rays pass through what cannot be seen; drones do not
        model.patch().geom_rgba_mut().chunks_exact_mut(4).for_each(|rgba| rgba[3] = 1.0);
        let (mut joints, mut bodies) = (Vec::new(), Vec::new());
        for index in 0..world.drones.len() {
            let joint: JointId = model.find(&World::drone_name(index))?;
            let address = model.jnt_qposadr()[joint.index()];
            joints.push(usize::try_from(address).expect("an address of a joint that exists"));
            bodies.push(model.find(&World::drone_name(index))?);
        }
        let mut finder = Self { data: Data::new(model)?, joints, bodies, directions, max_range: config.max_range };
        finder.set_obstacles(&world.obstacles)?;
        Ok(finder)
    }

    /// Rays per drone.
    pub fn rays(&self) -> usize {
        self.directions.len()
    }

    /// Distance beyond which nothing is seen, m.
    pub fn max_range(&self) -> f64 {
        self.max_range
    }

    /// Other obstacles of the same shapes in the same order.
    ///
    /// # Errors
    /// MuJoCo's; [`Error::UnknownName`] for more obstacles than there are.
    pub fn set_obstacles(&mut self, obstacles: &[Obstacle]) -> Result<(), Error> {
        for (index, obstacle) in obstacles.iter().enumerate() {
            let geom: GeomId = self.data.model().find(&World::obstacle_name(index))?;
            place_geom(&mut self.data.patch_model()?, geom, obstacle)?;
        }
        Ok(())
    }

    /// Writes the distance to whatever each ray meets first, from the drones' middles, drone after drone, m; the range where
    /// it meets nothing. A drone does not see itself.
    ///
    /// # Errors
    /// MuJoCo's.
    ///
    /// # Panics
    /// If `out` has another length than drones times rays.
    pub fn measure(&mut self, states: &[DroneState], out: &mut [f64]) -> Result<(), Error> {
        assert_eq!(out.len(), self.bodies.len() * self.directions.len(), "a buffer for all rays");
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
