//! Poses of the view cameras that keep a set of points in the frame.

use mujoco_rs::{Camera, ImageSize};
use nalgebra::Vector3;

use super::View;
use crate::world::Obstacle;

/// Pose of a view camera with square pixels and a vertical field of view of [`FOVY`](Self::FOVY) degrees.
///
/// ```
/// use aviary::vision::{CameraPose, ImageSize, View};
/// use nalgebra::Vector3;
///
/// let size = ImageSize { width: 320, height: 240 };
/// let path = [Vector3::new(0.0, 0.0, 1.0), Vector3::new(12.0, 0.0, 1.0)];
/// let pose = CameraPose::framing(View::Top, &path, 0.1, &[], size).expect("no onboard camera");
/// // x points right, and the path fills the frame
/// let [start, end] = path.map(|point| pose.project(&point, size).expect("in front of the camera"));
/// assert!(start[0] < -0.7 && end[0] > 0.7 && end[0] < 1.0);
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraPose {
    /// Position of the camera, world frame, m.
    pub eye: Vector3<f64>,
    /// Azimuth of the viewing direction about world z, degrees: 0 looks along +x, 90 along +y.
    pub azimuth: f64,
    /// Elevation of the viewing direction, degrees: negative looks down.
    pub elevation: f64,
    /// Distance from the camera to the point that it looks at, m.
    pub distance: f64,
}

/// Fraction of the half frame that contains all framed points.
const MARGIN: f64 = 0.9;

/// Distance below which an obstacle counts as near a path, m.
const NEAR: f64 = 0.5;

/// Minimum distance of a camera from an obstacle, m.
const CLEARANCE: f64 = 0.1;

impl CameraPose {
    /// Vertical field of view, degrees.
    pub const FOVY: f64 = 45.0;

    /// Returns the pose of a view that keeps points (world frame, m) in the frame, as large as possible, together
    /// with the obstacles near them. `radius` is the radius around each point that stays in the frame, m.
    ///
    /// The camera stands outside all obstacles, where they hide the fewest points. The `fixed` and `track` views
    /// may turn and rise for this, and the `front` view may turn a little and rise. The `top` view always looks
    /// straight down. Returns `None` for `fpv`, which is an onboard camera, and for an empty list of points.
    pub fn framing(
        view: View,
        points: &[Vector3<f64>],
        radius: f64,
        obstacles: &[Obstacle],
        size: ImageSize,
    ) -> Option<Self> {
        if points.is_empty() {
            return None;
        }
        // a subset of the points is enough, because obstacles hide neighbouring points together
        const POINTS: usize = 240;
        let step = points.len().div_ceil(POINTS);
        let mut targets: Vec<_> = points.iter().copied().step_by(step).collect();
        let sampled = targets.len();
        for obstacle in obstacles {
            let near = targets[..sampled].iter().map(|point| (obstacle.distance(point), point));
            let near = near.min_by(|a, b| a.0.total_cmp(&b.0));
            if let Some((distance, point)) = near.filter(|(distance, _)| *distance < NEAR) {
                targets.push(point - distance * outwards(obstacle, point));
            }
        }
        // the frame must contain every point, not only the sampled ones
        targets.extend_from_slice(points);
        let mut best: Option<(f64, Self)> = None;
        for [azimuth, elevation] in directions(view)? {
            let pose = Self::fitting(&targets, radius, azimuth, elevation, size);
            let share = pose.visible_share(&targets[..sampled], obstacles);
            let all = share > 0.97;
            if all || best.is_none_or(|(max, _)| share > max + 0.02) {
                best = Some((share, pose));
            }
            if all {
                break;
            }
        }
        best.map(|(_, pose)| pose)
    }

    /// Returns the nearest pose with the given viewing direction that keeps all points in the frame.
    pub(super) fn fitting(points: &[Vector3<f64>], radius: f64, azimuth: f64, elevation: f64, size: ImageSize) -> Self {
        let [right, up, forward] = axes(azimuth, elevation);
        let tangent = MARGIN * (0.5 * Self::FOVY).to_radians().tan();
        let aspect = f64::from(size.width) / f64::from(size.height.max(1));
        // a point p is left of the right edge if p·right − slope·p·forward is at most that of the eye, and likewise
        // for the other edges
        let fit = |axis: &Vector3<f64>, slope: f64| {
            let room = radius * slope.hypot(1.0);
            let max = |side: f64| {
                let beyond = points.iter().map(|point| side * point.dot(axis) - slope * point.dot(&forward) + room);
                beyond.fold(f64::NEG_INFINITY, f64::max)
            };
            let (plus, minus) = (max(1.0), max(-1.0));
            (0.5 * (plus - minus), -0.5 * (plus + minus) / slope)
        };
        let ((x, depth_x), (y, depth_y)) = (fit(&right, tangent * aspect), fit(&up, tangent));
        let depth = depth_x.min(depth_y);
        let (near, far) = points
            .iter()
            .map(|point| point.dot(&forward))
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(near, far), along| (near.min(along), far.max(along)));
        Self {
            eye: x * right + y * up + depth * forward,
            azimuth,
            elevation,
            distance: (0.5 * (near + far) - depth).max(radius),
        }
    }

    /// Returns the radius around a single point that fills the frame at a distance, both in m.
    pub(super) fn radius_that_fills(distance: f64) -> f64 {
        let tangent = MARGIN * (0.5 * Self::FOVY).to_radians().tan();
        distance * tangent / tangent.hypot(1.0)
    }

    /// Returns the image coordinates of a point (world frame, m), each from −1 to 1, from left to right and from
    /// bottom to top. Returns `None` for a point behind the camera.
    pub fn project(&self, point: &Vector3<f64>, size: ImageSize) -> Option<[f64; 2]> {
        let [right, up, forward] = axes(self.azimuth, self.elevation);
        let offset = point - self.eye;
        let depth = offset.dot(&forward);
        let tangent = (0.5 * Self::FOVY).to_radians().tan();
        let aspect = f64::from(size.width) / f64::from(size.height.max(1));
        (depth > 0.0).then(|| [offset.dot(&right) / (depth * tangent * aspect), offset.dot(&up) / (depth * tangent)])
    }

    /// Returns the point that the camera looks at, world frame, m.
    pub fn lookat(&self) -> Vector3<f64> {
        let [_, _, forward] = axes(self.azimuth, self.elevation);
        self.eye + self.distance * forward
    }

    /// Returns the fraction of points that no obstacle hides; 0 for a camera inside an obstacle or below the floor.
    pub(super) fn visible_share(&self, points: &[Vector3<f64>], obstacles: &[Obstacle]) -> f64 {
        if self.eye.z < 0.02 || obstacles.iter().any(|obstacle| obstacle.distance(&self.eye) < CLEARANCE) {
            return 0.0;
        }
        const POINTS: usize = 48;
        let sample = || points.iter().step_by(points.len().div_ceil(POINTS).max(1));
        let hidden = sample().filter(|point| obstacles.iter().any(|obstacle| hides(obstacle, &self.eye, point)));
        1.0 - hidden.count() as f64 / sample().count().max(1) as f64
    }

    pub(super) fn camera(&self) -> Camera {
        let Self { azimuth, elevation, distance, .. } = *self;
        Camera::Free { lookat: self.lookat().into(), distance, azimuth, elevation }
    }
}

/// Returns the possible viewing directions of a view, azimuth and elevation in degrees, best first.
fn directions(view: View) -> Option<Vec<[f64; 2]>> {
    let around = |first: f64, elevations: &[f64]| {
        let turns = [0.0, -30.0, 30.0, -60.0, 60.0, 90.0, -90.0, 135.0, -135.0, 180.0];
        let all = elevations.iter().flat_map(|&elevation| turns.map(|turn| [first + turn, elevation]));
        all.collect::<Vec<_>>()
    };
    match view {
        View::Fpv => None,
        View::Track => Some(around(35.0, &[-22.0, -40.0, -58.0, -75.0])),
        View::Fixed => Some(around(50.0, &[-20.0, -38.0, -56.0, -75.0])),
        View::Front => {
            let turns = [0.0, -20.0, 20.0, -40.0, 40.0];
            let elevations = [-4.0, -15.0, -30.0, -50.0, -70.0];
            Some(elevations.iter().flat_map(|&elevation| turns.map(|turn| [180.0 + turn, elevation])).collect())
        }
        View::Top => Some(vec![[90.0, -90.0]]),
    }
}

/// Returns the right, up and forward axes of a camera, world frame.
fn axes(azimuth: f64, elevation: f64) -> [Vector3<f64>; 3] {
    let ((sin, cos), (up, level)) = (azimuth.to_radians().sin_cos(), elevation.to_radians().sin_cos());
    let forward = Vector3::new(level * cos, level * sin, up);
    let right = Vector3::new(sin, -cos, 0.0);
    [right, right.cross(&forward), forward]
}

/// Returns the direction in which the distance from an obstacle increases.
fn outwards(obstacle: &Obstacle, point: &Vector3<f64>) -> Vector3<f64> {
    const STEP: f64 = 1e-4;
    let slope = Vector3::from_fn(|axis, _| {
        let aside = Vector3::from_fn(|row, _| if row == axis { STEP } else { 0.0 });
        obstacle.distance(&(point + aside)) - obstacle.distance(&(point - aside))
    });
    slope.try_normalize(1e-12).unwrap_or_else(Vector3::z)
}

/// Returns true if an obstacle hides a point from the eye.
fn hides(obstacle: &Obstacle, eye: &Vector3<f64>, point: &Vector3<f64>) -> bool {
    let offset = point - eye;
    let length = offset.norm();
    // the bounding sphere rules out most obstacles
    let along = ((obstacle.position - eye).dot(&offset) / (length * length)).clamp(0.0, 1.0);
    if (eye + along * offset - obstacle.position).norm() > obstacle.shape.reach() || length < 1e-9 {
        return false;
    }
    // sphere tracing: each step advances by the distance from the obstacle
    let mut at = 0.0;
    while at < length {
        let distance = obstacle.distance(&(eye + offset * (at / length)));
        if distance < 1e-3 {
            return true;
        }
        at += distance.max(5e-3);
    }
    false
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::env::{AviaryBuilder, DroneEnv, Env, EnvConfig, Rng};
    use crate::tasks;
    use crate::world::{ObstacleConfig, ObstacleKind, Shape};
    use proptest::prelude::*;
    use rand::SeedableRng as _;

    const STATIC: [View; 3] = [View::Fixed, View::Front, View::Top];

    fn point() -> impl Strategy<Value = Vector3<f64>> {
        (-8.0..8.0, -8.0..8.0, 0.05..4.0).prop_map(|(x, y, z)| Vector3::new(x, y, z))
    }

    proptest! {
        /// All points are in the frame with a margin, and the outermost ones touch the margin, so that no nearer
        /// pose exists.
        #[test]
        fn framing_fits_all_points_as_tightly_as_the_margin_allows(
            points in prop::collection::vec(point(), 1..30), wide in 0.5..2.0, radius in 0.01..0.5,
        ) {
            let size = ImageSize { width: (240.0 * wide) as u32, height: 240 };
            for view in [View::Track, View::Fixed, View::Front, View::Top] {
                let pose = CameraPose::framing(view, &points, radius, &[], size).unwrap();
                let places = points.iter().map(|point| pose.project(point, size).unwrap());
                let max = places.flatten().fold(0.0, |max: f64, x| max.max(x.abs()));
                prop_assert!(max < MARGIN, "{view}: {max}");
                // without a radius around the points, the outermost points touch the margin
                let tight = CameraPose::framing(view, &points, 1e-6, &[], size).unwrap();
                let places = points.iter().map(|point| tight.project(point, size).unwrap());
                let max = places.flatten().fold(0.0, |max: f64, x| max.max(x.abs()));
                // except if one point is so close to the camera that the camera is at that point
                let before_one = points.iter().any(|point| (point - tight.eye).norm() < 1e-3);
                prop_assert!(before_one || max > MARGIN - 1e-3, "{view}: {max}");
            }
        }

        #[test]
        fn cameras_avoid_obstacles_and_see_the_path(
            seed in 0u64..500, at in (-0.8..0.8, -0.8..0.8),
        ) {
            let size = ImageSize { width: 320, height: 240 };
            let start = Vector3::new(at.0, at.1, 0.1);
            for kind in [ObstacleKind::Forest, ObstacleKind::Urban, ObstacleKind::Random] {
                let config = ObstacleConfig { count: 8, ..ObstacleConfig::new(kind) };
                let Ok(obstacles) = config.generate(&[start.into()], &mut Rng::seed_from_u64(seed)) else { continue };
                let path: Vec<_> = (0..20).map(|i| start + Vector3::z() * 0.05 * f64::from(i)).collect();
                for view in STATIC {
                    let pose = CameraPose::framing(view, &path, 0.13, &obstacles, size).unwrap();
                    // the top view has only one direction
                    if view == View::Top {
                        continue;
                    }
                    let room = obstacles.iter().map(|o| o.distance(&pose.eye)).fold(f64::INFINITY, f64::min);
                    prop_assert!(room >= CLEARANCE, "{view} in a {kind:?}: {room}");
                    let share = pose.visible_share(&path, &obstacles);
                    prop_assert!(share > 0.5, "{view} in a {kind:?}: {share}");
                }
            }
        }
    }

    /// A trunk between the camera and the path: the camera moves around or above it.
    #[test]
    fn cameras_move_to_see_past_an_obstacle() {
        let size = ImageSize { width: 320, height: 240 };
        let path: Vec<_> = (0..10).map(|i| Vector3::z() * (0.1 + 0.1 * f64::from(i))).collect();
        for view in [View::Fixed, View::Front, View::Track] {
            let free = CameraPose::framing(view, &path, 0.13, &[], size).unwrap();
            for share in [0.3, 0.7, 1.0] {
                let middle = free.eye + share * (free.lookat() - free.eye) * 0.8;
                let trunk = Obstacle::new(
                    Shape::Cylinder { radius: 0.12, half_height: 0.6 },
                    Vector3::new(middle.x, middle.y, 0.6),
                );
                let hidden = 1.0 - free.visible_share(&path, &[trunk]);
                let moved = CameraPose::framing(view, &path, 0.13, &[trunk], size).unwrap();
                assert!(hidden > 0.1 && moved.visible_share(&path, &[trunk]) > 0.97, "{view} {share}: {hidden}");
            }
        }
    }

    /// The extent of a task covers every start, every reference of an episode and every plan, for one drone and
    /// several.
    #[test]
    fn static_views_frame_the_extent_of_every_task() {
        let size = ImageSize { width: 320, height: 240 };
        for name in tasks::NAMES {
            for count in [None, Some(4)] {
                let mut config = EnvConfig::default();
                if let (Some(count), true) = (count, name != "hover") {
                    config = config.num_drones(count);
                }
                let mut env = tasks::make(name, config).unwrap();
                env.reset(Some(3)).unwrap();
                let points = env.extent();
                let drones = env.simulation().num_drones();
                assert!(points.len() >= 2 * drones, "{name}");
                for view in STATIC {
                    let pose = CameraPose::framing(view, &points, 0.1, &[], size).unwrap();
                    let holds = |point: &Vector3<f64>| {
                        pose.project(point, size).is_some_and(|place| place.iter().all(|x| x.abs() < 0.95))
                    };
                    for (drone, plan) in env.plans().into_iter().enumerate() {
                        assert!(holds(&env.simulation().states()[drone].position), "{name} {view}");
                        assert!(holds(&env.reference(drone).position), "{name} {view}");
                        if let Some(plan) = plan {
                            let times = (0..200).map(|i| plan.duration() * f64::from(i) / 199.0);
                            assert!(times.into_iter().all(|t| holds(&plan.reference(t).position)), "{name} {view}");
                        }
                    }
                    // stabilize uses the drone's own position as its reference, which can leave the frame
                    if name == "stabilize" {
                        continue;
                    }
                    // moving references stay in the frame until the end of the episode
                    let mut env = tasks::make(name, EnvConfig::default()).unwrap();
                    let hover = vec![0.0; env.action_space().size()];
                    env.reset(Some(3)).unwrap();
                    let pose = CameraPose::framing(view, &env.extent(), 0.1, &[], size).unwrap();
                    for _ in 0..200 {
                        let place = pose.project(&env.reference(0).position, size).unwrap();
                        assert!(place.iter().all(|x| x.abs() < 0.95), "{name} {view}: {place:?}");
                        if env.info().end.is_some() || env.step(&hover).is_err() {
                            break;
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn boxed_environments_forward_the_extent() {
        let mut env = AviaryBuilder::new(tasks::Velocity::default()).build().unwrap();
        env.reset(Some(1)).unwrap();
        let wanted = env.extent();
        let boxed: Box<dyn DroneEnv> = Box::new(env);
        assert_eq!(boxed.extent(), wanted);
        assert!(wanted.len() > 2, "the extent covers the references as well as the start: {wanted:?}");
    }
}
