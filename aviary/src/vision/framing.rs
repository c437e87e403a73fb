//! Poses of the cameras that people look through: what they keep in the frame, and from where.

use mujoco_rs::{Camera, ImageSize};
use nalgebra::Vector3;

use super::View;
use crate::world::Obstacle;

/// Pose of a camera that people look through, with square pixels and a vertical field of view of
/// [`FOVY`](Self::FOVY) degrees.
///
/// ```
/// use aviary::vision::{CameraPose, ImageSize, View};
/// use nalgebra::Vector3;
///
/// let size = ImageSize { width: 320, height: 240 };
/// let path = [Vector3::new(0.0, 0.0, 1.0), Vector3::new(12.0, 0.0, 1.0)];
/// let pose = CameraPose::framing(View::Top, &path, 0.1, &[], size).expect("no onboard camera");
/// // x to the right, and as large as the frame allows
/// let [start, end] = path.map(|point| pose.project(&point, size).expect("in front of the camera"));
/// assert!(start[0] < -0.7 && end[0] > 0.7 && end[0] < 1.0);
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraPose {
    /// Where the camera stands, world frame, m.
    pub eye: Vector3<f64>,
    /// Direction of sight about world z, degrees: 0 looks along +x, 90 along +y.
    pub azimuth: f64,
    /// Direction of sight above the horizon, degrees: negative looks down.
    pub elevation: f64,
    /// Distance of the point that it looks at, m.
    pub distance: f64,
}

/// Part of half the frame that holds everything to be seen.
const MARGIN: f64 = 0.9;

/// Distance within which an obstacle counts as near a path, m.
const NEAR: f64 = 0.5;

/// Smallest distance of a camera from an obstacle, m.
const CLEARANCE: f64 = 0.1;

impl CameraPose {
    /// Vertical field of view, degrees.
    pub const FOVY: f64 = 45.0;

    /// Returns the pose of a view that keeps these points (world frame, m) in the frame, each with a radius (m) around it, as
    /// large as the frame allows, with the obstacles that are near them. The camera stands in no obstacle and where obstacles hide
    /// least, as far as the view leaves a choice: `fixed` and `track` may be turned and raised, `front` turned a little and raised, `top` is
    /// always straight above. `None` for `fpv`, which is an onboard camera, and without points.
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
        // an obstacle hides the same parts of two paths that are nearly one
        const POINTS: usize = 240;
        let step = points.len().div_ceil(POINTS);
        let mut targets: Vec<_> = points.iter().copied().step_by(step).collect();
        let seen = targets.len();
        for obstacle in obstacles {
            let near = targets[..seen].iter().map(|point| (obstacle.distance(point), point));
            let near = near.min_by(|a, b| a.0.total_cmp(&b.0));
            if let Some((distance, point)) = near.filter(|(distance, _)| *distance < NEAR) {
                targets.push(point - distance * outwards(obstacle, point));
            }
        }
        // every point counts for the frame
        targets.extend_from_slice(points);
        let mut best: Option<(f64, Self)> = None;
        for [azimuth, elevation] in directions(view)? {
            let pose = Self::fitting(&targets, radius, azimuth, elevation, size);
            let share = pose.visible_share(&targets[..seen], obstacles);
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

    /// The nearest pose with a direction of sight from which all points are in the frame.
    pub(super) fn fitting(points: &[Vector3<f64>], radius: f64, azimuth: f64, elevation: f64, size: ImageSize) -> Self {
        let [right, up, forward] = axes(azimuth, elevation);
        let tangent = MARGIN * (0.5 * Self::FOVY).to_radians().tan();
        let aspect = f64::from(size.width) / f64::from(size.height.max(1));
        // a point p is left of the right edge where p·right − a·p·forward is at most that of the eye, and likewise for the others
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

    /// Returns the radius around a single point that fills the frame from a distance, both in m.
    pub(super) fn radius_that_fills(distance: f64) -> f64 {
        let tangent = MARGIN * (0.5 * Self::FOVY).to_radians().tan();
        distance * tangent / tangent.hypot(1.0)
    }

    /// Returns where a point (world frame, m) is in a picture: from −1 to 1 from left to right and from bottom to top; `None`
    /// behind the camera.
    pub fn project(&self, point: &Vector3<f64>, size: ImageSize) -> Option<[f64; 2]> {
        let [right, up, forward] = axes(self.azimuth, self.elevation);
        let way = point - self.eye;
        let depth = way.dot(&forward);
        let tangent = (0.5 * Self::FOVY).to_radians().tan();
        let aspect = f64::from(size.width) / f64::from(size.height.max(1));
        (depth > 0.0).then(|| [way.dot(&right) / (depth * tangent * aspect), way.dot(&up) / (depth * tangent)])
    }

    /// Returns the point that it looks at, world frame, m.
    pub fn lookat(&self) -> Vector3<f64> {
        let [_, _, forward] = axes(self.azimuth, self.elevation);
        self.eye + self.distance * forward
    }

    /// Share of points that no obstacle hides; 0 for a camera that stands in one or below the floor.
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

/// Directions of sight (azimuth and elevation, degrees) that a view may have, the best first.
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

/// Right, up and forward of a camera.
fn axes(azimuth: f64, elevation: f64) -> [Vector3<f64>; 3] {
    let ((sin, cos), (up, level)) = (azimuth.to_radians().sin_cos(), elevation.to_radians().sin_cos());
    let forward = Vector3::new(level * cos, level * sin, up);
    let right = Vector3::new(sin, -cos, 0.0);
    [right, right.cross(&forward), forward]
}

/// Direction in which the distance from an obstacle grows.
fn outwards(obstacle: &Obstacle, point: &Vector3<f64>) -> Vector3<f64> {
    const STEP: f64 = 1e-4;
    let slope = Vector3::from_fn(|axis, _| {
        let aside = Vector3::from_fn(|row, _| if row == axis { STEP } else { 0.0 });
        obstacle.distance(&(point + aside)) - obstacle.distance(&(point - aside))
    });
    slope.try_normalize(1e-12).unwrap_or_else(Vector3::z)
}

/// Returns whether an obstacle stands between an eye and a point.
fn hides(obstacle: &Obstacle, eye: &Vector3<f64>, point: &Vector3<f64>) -> bool {
    let way = point - eye;
    let length = way.norm();
    // the ball around it first
    let along = ((obstacle.position - eye).dot(&way) / (length * length)).clamp(0.0, 1.0);
    if (eye + along * way - obstacle.position).norm() > obstacle.shape.reach() || length < 1e-9 {
        return false;
    }
    // as far at a time as there is room
    let mut at = 0.0;
    while at < length {
        let distance = obstacle.distance(&(eye + way * (at / length)));
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

    const STANDING: [View; 3] = [View::Fixed, View::Front, View::Top];

    fn point() -> impl Strategy<Value = Vector3<f64>> {
        (-8.0..8.0, -8.0..8.0, 0.05..4.0).prop_map(|(x, y, z)| Vector3::new(x, y, z))
    }

    proptest! {
        /// Whatever is to be seen is in the frame with a margin, and touches that margin: nothing nearer would do.
        #[test]
        fn everything_is_in_the_frame_and_as_large_as_it_allows(
            points in prop::collection::vec(point(), 1..30), wide in 0.5..2.0, radius in 0.01..0.5,
        ) {
            let size = ImageSize { width: (240.0 * wide) as u32, height: 240 };
            for view in [View::Track, View::Fixed, View::Front, View::Top] {
                let pose = CameraPose::framing(view, &points, radius, &[], size).unwrap();
                let places = points.iter().map(|point| pose.project(point, size).unwrap());
                let max = places.flatten().fold(0.0, |max: f64, x| max.max(x.abs()));
                prop_assert!(max < MARGIN, "{view}: {max}");
                // without a ball about each point the outermost ones touch the margin
                let tight = CameraPose::framing(view, &points, 1e-6, &[], size).unwrap();
                let places = points.iter().map(|point| tight.project(point, size).unwrap());
                let max = places.flatten().fold(0.0, |max: f64, x| max.max(x.abs()));
                // unless one is so far in front of the others that the camera stands before it
                let before_one = points.iter().any(|point| (point - tight.eye).norm() < 1e-3);
                prop_assert!(before_one || max > MARGIN - 1e-3, "{view}: {max}");
            }
        }

        #[test]
        fn cameras_stand_in_no_obstacle_and_see_the_path(
            seed in 0u64..500, at in (-0.8..0.8, -0.8..0.8),
        ) {
            let size = ImageSize { width: 320, height: 240 };
            let start = Vector3::new(at.0, at.1, 0.1);
            for kind in [ObstacleKind::Forest, ObstacleKind::Urban, ObstacleKind::Random] {
                let config = ObstacleConfig { count: 8, ..ObstacleConfig::new(kind) };
                let Ok(obstacles) = config.generate(&[start.into()], &mut Rng::seed_from_u64(seed)) else { continue };
                let path: Vec<_> = (0..20).map(|i| start + Vector3::z() * 0.05 * f64::from(i)).collect();
                for view in STANDING {
                    let pose = CameraPose::framing(view, &path, 0.13, &obstacles, size).unwrap();
                    // straight above there is no choice
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

    /// A trunk before the standing camera: it goes round or above.
    #[test]
    fn a_camera_goes_out_of_the_way_of_an_obstacle() {
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

    /// Every start, every reference of an episode and every plan of every task, for one drone and several.
    #[test]
    fn standing_views_hold_the_extent_of_every_task() {
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
                for view in STANDING {
                    let pose = CameraPose::framing(view, &points, 0.1, &[], size).unwrap();
                    let holds = |point: &Vector3<f64>| {
                        pose.project(point, size).is_some_and(|place| place.iter().all(|x| x.abs() < 0.95))
                    };
                    for (drone, way) in env.plans().into_iter().enumerate() {
                        assert!(holds(&env.simulation().states()[drone].position), "{name} {view}");
                        assert!(holds(&env.reference(drone).position), "{name} {view}");
                        if let Some(way) = way {
                            let times = (0..200).map(|i| way.duration() * f64::from(i) / 199.0);
                            assert!(times.into_iter().all(|t| holds(&way.reference(t).position)), "{name} {view}");
                        }
                    }
                    // where the reference is the drone itself, it goes where that goes
                    if name == "stabilize" {
                        continue;
                    }
                    // references that move are held until the end of the episode
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
    fn wrappers_and_boxes_pass_the_extent_on() {
        let mut env = AviaryBuilder::new(tasks::Velocity::default()).build().unwrap();
        env.reset(Some(1)).unwrap();
        let wanted = env.extent();
        let boxed: Box<dyn DroneEnv> = Box::new(env);
        assert_eq!(boxed.extent(), wanted);
        assert!(wanted.len() > 2, "where it goes, not only where it is: {wanted:?}");
    }
}
