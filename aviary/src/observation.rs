//! Observations: vectors computed from the state of a drone, camera images and rangefinder distances.

use std::fmt;
use std::str::FromStr;

use mujoco_rs::Error;

use crate::state::DroneState;
use crate::vision::{ImageSize, SceneRenderer};

/// Indices of the state of a drone in the observation vectors of all built-in tasks, which begin with it.
///
/// ```
/// use aviary::env::Env;
/// use aviary::observation::obs;
/// use aviary::tasks::Hover;
///
/// let mut env = Hover::builder().build()?;
/// let vector = &env.reset(Some(1))?.vector;
/// assert_eq!((vector[obs::Z], &vector[obs::VELOCITY]), (0.1, &[0.0; 3][..]));
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
pub mod obs {
    use std::ops::Range;

    /// Position, world frame, m.
    pub const POSITION: Range<usize> = 0..3;
    /// Height, m.
    pub const Z: usize = 2;
    /// Roll, pitch and yaw, rad: intrinsic z-y'-x''.
    pub const RPY: Range<usize> = 3..6;
    /// Velocity, world frame, m/s.
    pub const VELOCITY: Range<usize> = 6..9;
    /// Vertical velocity, m/s.
    pub const VZ: usize = 8;
    /// Angular velocity, body frame, rad/s.
    pub const ANGULAR_VELOCITY: Range<usize> = 9..12;
}

/// Parts of an observation: `KIN`, `RGB` and `KIN_RGB` of *MuJoCo-Drones-Gym* (Tayal), and any combination with the
/// other parts.
///
/// ```
/// use aviary::env::Env;
/// use aviary::observation::ObservationType;
/// use aviary::tasks::Hover;
///
/// let kind: ObservationType = "kin_obstacle_ranges".parse()?;
/// assert_eq!(kind, ObservationType::KIN_RANGES);
/// let mut env = Hover::builder().observation_type(kind).build()?;
/// let observation = env.reset(Some(1))?;
/// assert_eq!((observation.vector.len(), observation.obstacle.len(), observation.ranges.len()), (12, 1, 10));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct ObservationType {
    /// Observation vector of the task.
    pub kinematic: bool,
    /// Colour image of every onboard camera.
    pub rgb: bool,
    /// Depth image of every onboard camera.
    pub depth: bool,
    /// Segmentation image of every onboard camera.
    pub segmentation: bool,
    /// Adjacency matrix of the drones within the neighbourhood radius of each other.
    pub adjacency: bool,
    /// Distance of each drone to the nearest obstacle.
    pub obstacle: bool,
    /// Distance of each drone along its rays.
    pub ranges: bool,
}

impl ObservationType {
    const NONE: Self = Self {
        kinematic: false,
        rgb: false,
        depth: false,
        segmentation: false,
        adjacency: false,
        obstacle: false,
        ranges: false,
    };
    /// Vector of the task.
    pub const KIN: Self = Self { kinematic: true, ..Self::NONE };
    /// Colour images.
    pub const RGB: Self = Self { rgb: true, ..Self::NONE };
    /// Vector and colour images.
    pub const KIN_RGB: Self = Self { kinematic: true, rgb: true, ..Self::NONE };
    /// Depth images.
    pub const DEPTH: Self = Self { depth: true, ..Self::NONE };
    /// Segmentation images.
    pub const SEGMENTATION: Self = Self { segmentation: true, ..Self::NONE };
    /// Vector and adjacency matrix.
    pub const KIN_ADJACENCY: Self = Self { kinematic: true, adjacency: true, ..Self::NONE };

    /// Vector, distance to the nearest obstacle and rangefinder distances.
    pub const KIN_RANGES: Self = Self { kinematic: true, obstacle: true, ranges: true, ..Self::NONE };

    /// Returns true if the observation has no parts.
    pub fn is_empty(self) -> bool {
        self == Self::NONE
    }

    /// Returns true if the observation has images.
    pub fn has_images(self) -> bool {
        self.rgb || self.depth || self.segmentation
    }

    fn parts(self) -> [(&'static str, bool); 7] {
        [
            ("kin", self.kinematic),
            ("rgb", self.rgb),
            ("depth", self.depth),
            ("segmentation", self.segmentation),
            ("adjacency", self.adjacency),
            ("obstacle", self.obstacle),
            ("ranges", self.ranges),
        ]
    }
}

impl Default for ObservationType {
    fn default() -> Self {
        Self::KIN
    }
}

impl fmt::Display for ObservationType {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let parts: Vec<_> = self.parts().into_iter().filter(|(_, on)| *on).map(|(name, _)| name).collect();
        f.write_str(&parts.join("_"))
    }
}

/// Error of an unknown observation type.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "no observation type `{0}`, expected parts joined by `_`: \
     kin, rgb, depth, segmentation, adjacency, obstacle, ranges"
)]
pub struct UnknownObservationType(pub String);

impl FromStr for ObservationType {
    type Err = UnknownObservationType;

    fn from_str(name: &str) -> Result<Self, UnknownObservationType> {
        let unknown = || UnknownObservationType(name.to_string());
        let mut kind = Self::NONE;
        for part in name.split('_') {
            let flag = match part {
                "kin" => &mut kind.kinematic,
                "rgb" => &mut kind.rgb,
                "depth" => &mut kind.depth,
                "segmentation" => &mut kind.segmentation,
                "adjacency" => &mut kind.adjacency,
                "obstacle" => &mut kind.obstacle,
                "ranges" => &mut kind.ranges,
                _ => return Err(unknown()),
            };
            if std::mem::replace(flag, true) {
                return Err(unknown());
            }
        }
        Ok(kind)
    }
}

/// Observation of an agent. Parts outside the observation type are empty.
///
/// Images are stored drone by drone, row by row from the top, pixel by pixel from the left. N is the number of
/// drones.
///
/// ```
/// use aviary::env::Env;
/// use aviary::tasks::MultiHover;
///
/// let mut env = MultiHover::builder().build()?;
/// let space = env.observation_space().vector.clone();
/// let observation = env.reset(Some(1))?;
/// let mut row = [0.0_f32; 26];
/// space.write_f32(&observation.vector, &mut row);
/// // two blocks of 13 numbers; the second drone starts 1 m along x
/// assert_eq!(row[13], 1.0);
/// assert_eq!(observation.of_drone(1, 2).vector[0], 1.0);
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Clone, PartialEq, Default, serde::Serialize, serde::Deserialize)]
pub struct Observation {
    /// Observation vector of the task.
    pub vector: Vec<f64>,
    /// Colour images, N × height × width × 4: red, green, blue and an alpha of 255.
    pub rgb: Vec<u8>,
    /// Depth images, N × height × width, m along the camera's axis; the distance of the far plane (100 m) for the
    /// background.
    pub depth: Vec<f32>,
    /// Segmentation images, N × height × width, `[type, index]`; `[−1, −1]` for the background.
    pub segmentation: Vec<[i32; 2]>,
    /// Adjacency matrix, N × N: true if drones i and j are within the neighbourhood radius of each other; false on
    /// the diagonal.
    pub adjacency: Vec<bool>,
    /// Distance of each drone's centre to the surface of the nearest obstacle, N, m; negative inside, at most
    /// [`FAR`](Self::FAR).
    pub obstacle: Vec<f64>,
    /// Distance along each ray, N × rays, m.
    pub ranges: Vec<f64>,
}

impl Observation {
    /// Returns true if every part has the length of the part in another observation.
    pub(crate) fn has_sizes_of(&self, other: &Self) -> bool {
        let sizes = |of: &Self| {
            let numbers = [of.vector.len(), of.obstacle.len(), of.ranges.len(), of.adjacency.len()];
            (numbers, [of.rgb.len(), of.depth.len(), of.segmentation.len()])
        };
        sizes(self) == sizes(other)
    }

    /// Returns the size on the heap in bytes.
    pub(crate) fn bytes(&self) -> usize {
        let numbers = self.vector.len() + self.obstacle.len() + self.ranges.len();
        let pixels = size_of_val(&self.rgb[..]) + size_of_val(&self.depth[..]) + size_of_val(&self.segmentation[..]);
        8 * numbers + pixels + self.adjacency.len()
    }

    /// Largest obstacle distance, m; the value without obstacles.
    pub const FAR: f64 = 100.0;

    /// Creates buffers for a vector of length `vector`, and for the images and `rays` rays of `cameras` drones.
    pub fn with_sizes(kind: ObservationType, vector: usize, cameras: usize, size: ImageSize, rays: usize) -> Self {
        let pixels = |on: bool| if on { cameras * size.pixels() } else { 0 };
        Self {
            vector: vec![0.0; if kind.kinematic { vector } else { 0 }],
            rgb: vec![0; 4 * pixels(kind.rgb)],
            depth: vec![0.0; pixels(kind.depth)],
            segmentation: vec![[-1; 2]; pixels(kind.segmentation)],
            adjacency: vec![false; if kind.adjacency { cameras * cameras } else { 0 }],
            obstacle: vec![Self::FAR; if kind.obstacle { cameras } else { 0 }],
            ranges: vec![0.0; if kind.ranges { cameras * rays } else { 0 }],
        }
    }

    /// Returns the part of one drone, if the vector consists of equal blocks: its block, its images, and its row of
    /// the adjacency matrix.
    ///
    /// # Panics
    /// If `drone` is not less than `drones`.
    pub fn of_drone(&self, drone: usize, drones: usize) -> Self {
        fn part<T: Clone>(all: &[T], drone: usize, drones: usize) -> Vec<T> {
            let size = all.len() / drones;
            all[drone * size..(drone + 1) * size].to_vec()
        }
        Self {
            vector: part(&self.vector, drone, drones),
            rgb: part(&self.rgb, drone, drones),
            depth: part(&self.depth, drone, drones),
            segmentation: part(&self.segmentation, drone, drones),
            adjacency: part(&self.adjacency, drone, drones),
            obstacle: part(&self.obstacle, drone, drones),
            ranges: part(&self.ranges, drone, drones),
        }
    }

    /// Reads the images from an updated renderer.
    ///
    /// # Errors
    /// The errors of the renderer.
    ///
    /// # Panics
    /// If the buffers have images of more drones than the renderer.
    pub fn take_images(&mut self, renderer: &mut SceneRenderer, size: ImageSize) -> Result<(), Error> {
        // a size of zero has no images
        let pixels = size.pixels().max(1);
        for (drone, rgb) in self.rgb.chunks_exact_mut(4 * pixels).enumerate() {
            renderer.onboard_rgba(drone, size, rgb)?;
        }
        for (drone, depth) in self.depth.chunks_exact_mut(pixels).enumerate() {
            renderer.onboard_depth(drone, size, depth)?;
        }
        for (drone, objects) in self.segmentation.chunks_exact_mut(pixels).enumerate() {
            renderer.onboard_segmentation(drone, size, objects)?;
        }
        Ok(())
    }
}

/// Length of [`kinematic`] per drone.
pub const KIN_SIZE: usize = 20;

/// Length of [`state_vector`] per drone.
pub const STATE_SIZE: usize = 12;

/// Returns the paper's `KIN` vector:
/// `[position 3, quaternion wxyz 4, rpy 3, velocity 3, angular velocity 3, motor speeds 4]`.
///
/// Position (m) and velocity (m/s) are in the world frame, the angular velocity (rad/s) is in the body frame. The
/// quaternion rotates from the body to the world frame. Roll, pitch and yaw are in rad, motor speeds in rpm.
///
/// ```
/// use aviary::observation::kinematic;
/// use aviary::state::DroneState;
/// use nalgebra::Vector3;
///
/// let state = DroneState::at_rest(Vector3::new(1.0, 2.0, 3.0), Vector3::zeros());
/// let kin = kinematic(&state, &[14_000.0; 4]);
/// assert_eq!((kin[2], kin[3], kin[19]), (3.0, 1.0, 14_000.0), "z, w of the quaternion, motor 3");
/// ```
pub fn kinematic(state: &DroneState, motor_speeds: &[f64; 4]) -> [f64; KIN_SIZE] {
    let mut out = [0.0; KIN_SIZE];
    out[0..3].copy_from_slice(state.position.as_slice());
    out[3..7].copy_from_slice(&crate::state::wxyz(&state.attitude));
    out[7..10].copy_from_slice(state.rpy().as_slice());
    out[10..13].copy_from_slice(state.velocity.as_slice());
    out[13..16].copy_from_slice(state.angular_velocity.as_slice());
    out[16..20].copy_from_slice(motor_speeds);
    out
}

/// Returns the state vector of the tasks: `[position 3, rpy 3, velocity 3, angular velocity 3]`, with the units and
/// frames of [`kinematic`].
///
/// ```
/// use aviary::observation::state_vector;
/// use aviary::state::DroneState;
/// use nalgebra::Vector3;
///
/// let state = DroneState { velocity: Vector3::new(0.5, 0.0, 0.0), ..DroneState::default() };
/// assert_eq!(state_vector(&state)[6], 0.5);
/// ```
pub fn state_vector(state: &DroneState) -> [f64; STATE_SIZE] {
    let mut out = [0.0; STATE_SIZE];
    out[0..3].copy_from_slice(state.position.as_slice());
    out[3..6].copy_from_slice(state.rpy().as_slice());
    out[6..9].copy_from_slice(state.velocity.as_slice());
    out[9..12].copy_from_slice(state.angular_velocity.as_slice());
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    #[test]
    fn names_are_unique_parts_joined_in_any_order() {
        for kind in [ObservationType::KIN, ObservationType::RGB, ObservationType::KIN_RGB, ObservationType::DEPTH] {
            assert_eq!(kind.to_string().parse::<ObservationType>().unwrap(), kind);
        }
        assert_eq!("rgb_kin".parse::<ObservationType>().unwrap(), ObservationType::KIN_RGB);
        for bad in ["", "kin_kin", "kin_", "KIN", "lidar"] {
            assert!(bad.parse::<ObservationType>().is_err(), "{bad}");
        }
    }

    #[test]
    fn both_vectors_have_the_parts_in_the_papers_order() {
        let state = DroneState {
            velocity: Vector3::new(7.0, 8.0, 9.0),
            angular_velocity: Vector3::new(10.0, 11.0, 12.0),
            ..DroneState::at_rest(Vector3::new(1.0, 2.0, 3.0), Vector3::new(0.4, 0.5, 0.6))
        };
        let q = crate::state::wxyz(&state.attitude);
        let kin = kinematic(&state, &[13.0, 14.0, 15.0, 16.0]);
        assert_eq!(kin[..3], [1.0, 2.0, 3.0]);
        assert_eq!(kin[3..7], q);
        assert!(q[0] > 0.8, "the scalar comes first");
        assert_eq!(kin[10..], [7.0, 8.0, 9.0, 10.0, 11.0, 12.0, 13.0, 14.0, 15.0, 16.0]);
        let short = state_vector(&state);
        assert_eq!(short[..3], kin[..3]);
        assert_eq!(short[3..6], kin[7..10]);
        assert_eq!(short[6..], kin[10..16]);
        for (got, wanted) in short[3..6].iter().zip([0.4, 0.5, 0.6]) {
            assert!((got - wanted).abs() < 1e-12);
        }
    }
}
