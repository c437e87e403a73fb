use nalgebra::Vector3;

/// Shape and size of an obstacle, in its own frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Shape {
    /// A box.
    Box {
        /// Half of its length along x, y and z, m.
        half_size: [f64; 3],
    },
    /// A ball.
    Sphere {
        /// Radius, m.
        radius: f64,
    },
    /// A cylinder along z.
    Cylinder {
        /// Radius, m.
        radius: f64,
        /// Half of its height, m.
        half_height: f64,
    },
    /// A cylinder along z with round ends.
    Capsule {
        /// Radius, m.
        radius: f64,
        /// Half of its height without the ends, m.
        half_height: f64,
    },
}

impl Shape {
    /// MuJoCo's name of the geom type and its size parameters.
    pub(super) fn geom(&self) -> (&'static str, Vec<f64>) {
        match *self {
            Self::Box { half_size } => ("box", half_size.to_vec()),
            Self::Sphere { radius } => ("sphere", vec![radius]),
            Self::Cylinder { radius, half_height } => ("cylinder", vec![radius, half_height]),
            Self::Capsule { radius, half_height } => ("capsule", vec![radius, half_height]),
        }
    }
}

/// Something that stands in the way and does not move.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Obstacle {
    /// Shape and size.
    pub shape: Shape,
    /// Centre, world frame, m.
    pub position: Vector3<f64>,
    /// Roll, pitch, yaw, rad.
    pub rpy: Vector3<f64>,
    /// Colour.
    pub rgba: [f64; 4],
}

impl Obstacle {
    /// An upright one in the colour of wood.
    pub fn new(shape: Shape, position: Vector3<f64>) -> Self {
        Self { shape, position, rpy: Vector3::zeros(), rgba: [0.62, 0.48, 0.34, 1.0] }
    }
}

/// Something that is seen and not touched: a gate, a waypoint.
#[derive(Debug, Clone, PartialEq)]
pub struct Marker {
    /// Its name in the visible scene; letters, digits and `_`, unlike any other's.
    pub name: String,
    /// What it looks like and where it is.
    pub body: Obstacle,
}
