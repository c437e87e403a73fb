use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use super::{SceneError, World};
use crate::error::triple;
use crate::state::attitude_from_rpy;

/// Shape and size of an obstacle, in its local frame.
///
/// ```
/// use aviary::world::Shape;
///
/// assert_eq!(Shape::Capsule { radius: 0.1, half_height: 0.4 }.reach(), 0.5);
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Shape {
    /// Box.
    Box {
        /// Half of the lengths along x, y and z, m.
        half_size: [f64; 3],
    },
    /// Sphere.
    Sphere {
        /// Radius, m.
        radius: f64,
    },
    /// Cylinder along z.
    Cylinder {
        /// Radius, m.
        radius: f64,
        /// Half of the height, m.
        half_height: f64,
    },
    /// Cylinder along z with hemispherical ends.
    Capsule {
        /// Radius, m.
        radius: f64,
        /// Half of the height without the ends, m.
        half_height: f64,
    },
}

impl Shape {
    /// Returns the radius of the bounding sphere, m.
    pub fn reach(&self) -> f64 {
        match *self {
            Self::Box { half_size: [x, y, z] } => Vector3::new(x, y, z).norm(),
            Self::Sphere { radius } => radius,
            Self::Cylinder { radius, half_height } => radius.hypot(half_height),
            Self::Capsule { radius, half_height } => radius + half_height,
        }
    }

    /// Returns the distance of a point in the local frame from the surface, m; negative inside.
    fn distance(&self, point: &Vector3<f64>) -> f64 {
        // distance from a box in N dimensions
        fn boxed<const N: usize>(beyond: [f64; N]) -> f64 {
            let outside = beyond.map(|x| x.max(0.0)).iter().map(|x| x * x).sum::<f64>().sqrt();
            outside + beyond.iter().copied().fold(f64::MIN, f64::max).min(0.0)
        }
        let sideways = point.x.hypot(point.y);
        match *self {
            Self::Box { half_size: [x, y, z] } => boxed([point.x.abs() - x, point.y.abs() - y, point.z.abs() - z]),
            Self::Sphere { radius } => point.norm() - radius,
            Self::Cylinder { radius, half_height } => boxed([sideways - radius, point.z.abs() - half_height]),
            // also of sizes that no scene has
            Self::Capsule { radius, half_height } => sideways.hypot((point.z.abs() - half_height).max(0.0)) - radius,
        }
    }

    /// Returns the index of the shape among the four shapes.
    pub(crate) fn kind(&self) -> usize {
        match self {
            Self::Box { .. } => 0,
            Self::Sphere { .. } => 1,
            Self::Cylinder { .. } => 2,
            Self::Capsule { .. } => 3,
        }
    }

    /// Returns MuJoCo's three `geom_size` numbers.
    pub(crate) fn sizes(&self) -> [f64; 3] {
        match *self {
            Self::Box { half_size } => half_size,
            Self::Sphere { radius } => [radius, 0.0, 0.0],
            Self::Cylinder { radius, half_height } | Self::Capsule { radius, half_height } => {
                [radius, half_height, 0.0]
            }
        }
    }

    /// Returns MuJoCo's name of the geom type, and its size parameters.
    pub(crate) fn geom(&self) -> (&'static str, Vec<f64>) {
        match *self {
            Self::Box { half_size } => ("box", half_size.to_vec()),
            Self::Sphere { radius } => ("sphere", vec![radius]),
            Self::Cylinder { radius, half_height } => ("cylinder", vec![radius, half_height]),
            Self::Capsule { radius, half_height } => ("capsule", vec![radius, half_height]),
        }
    }
}

/// Static object with which drones collide.
///
/// ```
/// use aviary::world::{Obstacle, Shape};
/// use nalgebra::Vector3;
///
/// let trunk = Obstacle::new(Shape::Cylinder { radius: 0.1, half_height: 1.0 }, Vector3::new(2.0, 0.0, 1.0));
/// assert!((trunk.distance(&Vector3::new(0.0, 0.0, 1.0)) - 1.9).abs() < 1e-12);
/// assert!(trunk.distance(&trunk.position) < 0.0, "inside");
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Stored", into = "Stored")]
pub struct Obstacle {
    /// Shape and size.
    pub shape: Shape,
    /// Centre, world frame, m.
    pub position: Vector3<f64>,
    /// Roll, pitch, yaw from the local to the world frame, rad: intrinsic z-y'-x''.
    pub rpy: Vector3<f64>,
    /// Red, green, blue and alpha, each from 0 to 1.
    pub rgba: [f64; 4],
}

/// Serialized form of an obstacle.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Stored {
    shape: StoredShape,
    size: Vec<f64>,
    #[serde(deserialize_with = "triple")]
    position: [f64; 3],
    #[serde(default, deserialize_with = "triple")]
    euler: [f64; 3],
    rgba: Option<[f64; 4]>,
}

#[derive(Serialize, Deserialize, Clone, Copy)]
#[serde(rename_all = "snake_case")]
enum StoredShape {
    Box,
    Sphere,
    Cylinder,
    Capsule,
}

impl From<Obstacle> for Stored {
    fn from(obstacle: Obstacle) -> Self {
        Self {
            shape: match obstacle.shape {
                Shape::Box { .. } => StoredShape::Box,
                Shape::Sphere { .. } => StoredShape::Sphere,
                Shape::Cylinder { .. } => StoredShape::Cylinder,
                Shape::Capsule { .. } => StoredShape::Capsule,
            },
            size: obstacle.shape.geom().1,
            position: obstacle.position.into(),
            euler: obstacle.rpy.into(),
            rgba: Some(obstacle.rgba),
        }
    }
}

impl TryFrom<Stored> for Obstacle {
    type Error = String;

    fn try_from(stored: Stored) -> Result<Self, String> {
        let shape = match (stored.shape, &stored.size[..]) {
            (StoredShape::Box, &[x, y, z]) => Shape::Box { half_size: [x, y, z] },
            (StoredShape::Sphere, &[radius]) => Shape::Sphere { radius },
            (StoredShape::Cylinder, &[radius, half_height]) => Shape::Cylinder { radius, half_height },
            (StoredShape::Capsule, &[radius, half_height]) => Shape::Capsule { radius, half_height },
            (_, sizes) => {
                let count = crate::count(sizes.len(), "number");
                return Err(format!("size has {count}, expected 3 for a box, 1 for a sphere, otherwise 2"));
            }
        };
        let plain = Self::new(shape, stored.position.into());
        Ok(Self { rpy: stored.euler.into(), rgba: stored.rgba.unwrap_or(plain.rgba), ..plain })
    }
}

impl Obstacle {
    /// Returns the distance of a point (world frame, m) from the surface, m; negative inside.
    pub fn distance(&self, point: &Vector3<f64>) -> f64 {
        let own = attitude_from_rpy(self.rpy).inverse_transform_vector(&(point - self.position));
        self.shape.distance(&own)
    }

    /// Checks sizes, pose and colour against the ranges of [`World`]. MuJoCo's collision code does not terminate for
    /// a body of 10¹⁵ m.
    pub(crate) fn validate(&self, name: &str) -> Result<(), SceneError> {
        let value = |what: &str, got: f64, range: std::ops::RangeInclusive<f64>, expected| {
            // false for NaN
            if range.contains(&got) {
                return Ok(());
            }
            Err(SceneError::Value { what: format!("the {what} of {name}"), got, expected })
        };
        for got in self.shape.geom().1 {
            value("size", got, World::MIN_SIZE..=World::MAX_SIZE, "0.0001 to 10,000 m")?;
        }
        for &got in &self.position {
            value("position", got, -World::MAX_COORDINATE..=World::MAX_COORDINATE, "coordinates within ±100,000 m")?;
        }
        for &got in &self.rpy {
            value("attitude", got, -World::MAX_ANGLE..=World::MAX_ANGLE, "angles within ±1000 rad")?;
        }
        for got in self.rgba {
            value("colour", got, 0.0..=1.0, "four numbers from 0 to 1")?;
        }
        Ok(())
    }

    /// Creates an upright, wood-coloured obstacle.
    pub fn new(shape: Shape, position: Vector3<f64>) -> Self {
        Self { shape, position, rpy: Vector3::zeros(), rgba: [0.62, 0.48, 0.34, 1.0] }
    }
}

/// Marker that a task moves, such as a platform, a ball or another vehicle.
///
/// A solid marker is an obstacle of the scene, listed after all other obstacles: drones collide with it, rangefinders
/// and cameras detect it, and obstacle distances include it. See
/// [`Task::moving_markers`](crate::env::Task::moving_markers).
///
/// ```
/// use aviary::world::{MovingMarker, Obstacle, Shape};
/// use nalgebra::Vector3;
///
/// let ball = Obstacle::new(Shape::Sphere { radius: 0.1 }, Vector3::new(1.0, 0.0, 1.0));
/// let (solid, seen) = (MovingMarker::solid("ball", ball), MovingMarker::visible("ghost", ball));
/// assert!(solid.solid && !seen.solid);
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct MovingMarker {
    /// Name, shape, size, colour, and the pose at the start of every episode.
    pub marker: Marker,
    /// True if drones collide with it.
    pub solid: bool,
    /// True if it keeps the pose that it has after the reset, and only has another one in the next episode. Steps then
    /// take less time, and records of flights need no poses of it.
    pub stands_still: bool,
}

impl MovingMarker {
    /// Creates a marker with which drones collide.
    pub fn solid(name: impl Into<String>, body: Obstacle) -> Self {
        Self { marker: Marker { name: name.into(), body }, solid: true, stands_still: false }
    }

    /// Creates a marker without contacts.
    pub fn visible(name: impl Into<String>, body: Obstacle) -> Self {
        Self { marker: Marker { name: name.into(), body }, solid: false, stands_still: false }
    }
}

/// Pose of a moving marker.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct MarkerPose {
    /// Centre, world frame, m.
    #[serde(with = "crate::serial::vector")]
    pub position: Vector3<f64>,
    /// Roll, pitch, yaw from the local to the world frame, rad: intrinsic z-y'-x''.
    #[serde(with = "crate::serial::vector")]
    pub rpy: Vector3<f64>,
}

/// Visible object without contacts, such as a gate or a waypoint.
///
/// ```
/// use aviary::env::{DroneEnv, Env};
/// use aviary::tasks::Hover;
/// use aviary::world::{Marker, Obstacle, Shape};
/// use nalgebra::Vector3;
///
/// let disc = Shape::Cylinder { radius: 0.2, half_height: 0.005 };
/// let pad = Marker { name: "pad".into(), body: Obstacle::new(disc, Vector3::new(1.0, 0.0, 0.005)) };
/// let env = Hover::builder().markers([pad]).build()?;
/// assert_eq!(env.simulation().markers()[0].name, "pad");
/// assert!(env.simulation().obstacles().is_empty());
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct Marker {
    /// Name in the visible scene, unique; letters, digits and `_`.
    pub name: String,
    /// Shape, pose and colour.
    pub body: Obstacle,
}
