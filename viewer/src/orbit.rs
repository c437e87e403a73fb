//! Camera that the mouse moves around a point.

use aviary::vision::{CameraPose, ImageSize};
use nalgebra::Vector3;

/// Camera that looks at a point from a distance.
///
/// ```
/// use nalgebra::Vector3;
/// use viewer::OrbitCamera;
///
/// let mut camera = OrbitCamera { lookat: Vector3::z(), distance: 2.0, azimuth: 0.0, elevation: 0.0 };
/// camera.orbit(90.0, -30.0);
/// assert_eq!((camera.azimuth, camera.elevation), (90.0, -30.0));
/// let eye = camera.pose().eye;
/// assert!((eye - Vector3::new(0.0, -3_f64.sqrt(), 2.0)).norm() < 1e-12);
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OrbitCamera {
    /// Point that the camera looks at, world frame, m.
    pub lookat: Vector3<f64>,
    /// Distance from the point, m.
    pub distance: f64,
    /// Azimuth of the viewing direction about world z, degrees: 0 looks along +x, 90 along +y.
    pub azimuth: f64,
    /// Elevation of the viewing direction, degrees: negative looks down.
    pub elevation: f64,
}

impl OrbitCamera {
    /// Smallest and largest distance, m.
    pub const DISTANCES: [f64; 2] = [0.05, 1e4];

    /// Returns the camera that has a pose.
    pub fn of_pose(pose: &CameraPose) -> Self {
        Self { lookat: pose.lookat(), distance: pose.distance, azimuth: pose.azimuth, elevation: pose.elevation }
    }

    /// Turns the camera around the point, by angles in degrees. The elevation stays within ±90°.
    pub fn orbit(&mut self, azimuth: f64, elevation: f64) {
        self.azimuth = (self.azimuth + azimuth).rem_euclid(360.0);
        self.elevation = (self.elevation + elevation).clamp(-90.0, 90.0);
    }

    /// Moves the point and the camera parallel to the image, by fractions of the image's height to the right and up.
    pub fn pan(&mut self, right: f64, up: f64) {
        let [to_the_right, upwards, _] = self.axes();
        self.lookat += self.height() * (right * to_the_right + up * upwards);
    }

    /// Divides the distance by a factor.
    pub fn zoom(&mut self, factor: f64) {
        self.distance = (self.distance / factor).clamp(Self::DISTANCES[0], Self::DISTANCES[1]);
    }

    /// Returns the height of the image at the distance of the point, m.
    pub fn height(&self) -> f64 {
        2.0 * self.distance * (0.5 * CameraPose::FOVY).to_radians().tan()
    }

    /// Returns the pose.
    pub fn pose(&self) -> CameraPose {
        let Self { lookat, distance, azimuth, elevation } = *self;
        let [_, _, forward] = self.axes();
        CameraPose { eye: lookat - distance * forward, azimuth, elevation, distance }
    }

    /// Returns the right, up and forward axes of the image, world frame.
    pub fn axes(&self) -> [Vector3<f64>; 3] {
        let (sin, cos) = self.azimuth.to_radians().sin_cos();
        let (up, level) = self.elevation.to_radians().sin_cos();
        let forward = Vector3::new(level * cos, level * sin, up);
        let right = Vector3::new(sin, -cos, 0.0);
        [right, right.cross(&forward), forward]
    }

    /// Returns the displacement (world frame, m) of a point at `depth` (m along the camera's axis) that moves in the
    /// image by fractions of the image's height to the right and up.
    pub fn displacement(&self, depth: f64, right: f64, up: f64) -> Vector3<f64> {
        let [to_the_right, upwards, _] = self.axes();
        self.height() * depth / self.distance * (right * to_the_right + up * upwards)
    }

    /// Returns the distance of a point (world frame, m) along the camera's axis, m.
    pub fn depth(&self, point: &Vector3<f64>) -> f64 {
        (point - self.pose().eye).dot(&self.axes()[2])
    }

    /// Returns the index of the point (world frame, m) at an image position (from −1 to 1, to the right and up): the
    /// nearest to the camera among those whose `radius` (m) or whose surroundings of `slack` (in units of the image's
    /// half height) contain the position.
    pub fn pick(
        &self,
        points: &[Vector3<f64>],
        radius: f64,
        slack: f64,
        position: [f64; 2],
        size: ImageSize,
    ) -> Option<usize> {
        let pose = self.pose();
        let aspect = f64::from(size.width) / f64::from(size.height.max(1));
        let near = |(index, point): (usize, &Vector3<f64>)| {
            let [x, y] = pose.project(point, size)?;
            let depth = self.depth(point);
            let reach = (2.0 * radius * self.distance / (self.height() * depth)).max(slack);
            (aspect * (x - position[0])).hypot(y - position[1]).le(&reach).then_some((index, depth))
        };
        let found = points.iter().enumerate().filter_map(near).min_by(|a, b| a.1.total_cmp(&b.1));
        found.map(|(index, _)| index)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn camera() -> impl Strategy<Value = OrbitCamera> {
        (-5.0..5.0, -5.0..5.0, 0.0..5.0, 0.3..20.0, 0.0..360.0, -89.0..89.0).prop_map(
            |(x, y, z, distance, azimuth, elevation)| OrbitCamera {
                lookat: Vector3::new(x, y, z),
                distance,
                azimuth,
                elevation,
            },
        )
    }

    const SIZE: ImageSize = ImageSize { width: 640, height: 480 };

    proptest! {
        #[test]
        fn the_pose_of_a_camera_has_its_point_in_the_middle(camera in camera()) {
            let pose = camera.pose();
            prop_assert!((pose.lookat() - camera.lookat).norm() < 1e-9);
            let [x, y] = pose.project(&camera.lookat, SIZE).unwrap();
            prop_assert!(x.abs() < 1e-9 && y.abs() < 1e-9);
            let same = OrbitCamera::of_pose(&pose);
            prop_assert!((same.lookat - camera.lookat).norm() < 1e-9);
        }

        /// A pan moves the scene by the same fraction of the image in the opposite direction.
        #[test]
        fn panning_moves_the_scene_with_the_mouse(camera in camera(), right in -0.4..0.4, up in -0.4..0.4) {
            let mut moved = camera;
            moved.pan(right, up);
            let [x, y] = moved.pose().project(&camera.lookat, SIZE).unwrap();
            let aspect = 640.0 / 480.0;
            prop_assert!((x * aspect / 2.0 + right).abs() < 1e-9, "{x}");
            prop_assert!((y / 2.0 + up).abs() < 1e-9, "{y}");
        }

        /// A displaced point lies under the mouse, at its depth.
        #[test]
        fn displaced_points_follow_the_mouse(
            camera in camera(), point in (-1.0..1.0, -1.0..1.0, -1.0..1.0), right in -0.4..0.4, up in -0.4..0.4,
        ) {
            let point = camera.lookat + 0.2 * camera.distance * Vector3::new(point.0, point.1, point.2);
            let depth = camera.depth(&point);
            let moved = point + camera.displacement(depth, right, up);
            prop_assert!((camera.depth(&moved) - depth).abs() < 1e-9);
            let [before, after] = [point, moved].map(|point| camera.pose().project(&point, SIZE).unwrap());
            prop_assert!(((after[0] - before[0]) * (640.0 / 480.0) / 2.0 - right).abs() < 1e-9);
            prop_assert!(((after[1] - before[1]) / 2.0 - up).abs() < 1e-9);
        }

        #[test]
        fn the_nearest_drone_under_the_mouse_is_picked(camera in camera()) {
            let [_, _, forward] = camera.axes();
            let line = [0.6, 0.3, 0.9].map(|share| camera.pose().eye + share * camera.distance * forward);
            prop_assert_eq!(camera.pick(&line, 0.1, 0.02, [0.0, 0.0], SIZE), Some(1));
            prop_assert_eq!(camera.pick(&line, 1e-3, 0.02, [0.5, 0.5], SIZE), None);
            let behind = [camera.pose().eye - forward];
            prop_assert_eq!(camera.pick(&behind, 0.1, 0.02, [0.0, 0.0], SIZE), None);
        }
    }

    #[test]
    fn zoom_and_elevation_have_limits() {
        let mut camera = OrbitCamera { lookat: Vector3::zeros(), distance: 1.0, azimuth: 350.0, elevation: 0.0 };
        camera.zoom(1e9);
        assert_eq!(camera.distance, OrbitCamera::DISTANCES[0]);
        camera.orbit(20.0, 1e3);
        assert_eq!((camera.azimuth, camera.elevation), (10.0, 90.0));
        assert!(camera.pose().eye.iter().all(|x| x.is_finite()));
    }
}
