//! Flights as recordings of Rerun (<https://rerun.io>), which a browser or Rerun's viewer shows.
//!
//! A recording has the scene (`world/…`): poses, meshes, cameras, trails and references of the drones, obstacles and
//! markers, wind; and series over time (`plots/…`): position, velocity, attitude, body rates, rotor speeds, reward
//! with its terms, and metrics. Its timelines are `time` (simulated time) and `step` (control step).

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use aviary::record::images::png_rgba;
use aviary::record::plot::colour_of;
use aviary::state::{DroneState, attitude_from_rpy};
use aviary::vision::{ImageSize, SceneRenderer, intrinsics};
use aviary::world::{Marker, Obstacle, Shape, VisualMesh, World};
use nalgebra::{UnitQuaternion, Vector3};
use rerun::archetypes::{
    Arrows3D, Asset3D, Boxes3D, Capsules3D, Cylinders3D, Ellipsoids3D, EncodedImage, LineStrips3D, Pinhole, Points3D,
    Scalars, SeriesLines, TextLog, Transform3D, ViewCoordinates,
};
use rerun::components::{FillMode, MediaType};
use rerun::{AsComponents, Color, Quaternion, RecordingStream, RecordingStreamBuilder};

use crate::frame::{EpisodeView, Frame, Source};

/// Destination of a recording.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum RerunTarget {
    /// File, whose name usually ends in `.rrd`. An existing file is replaced.
    File(PathBuf),
    /// Running viewer, such as `rerun+http://127.0.0.1:9876/proxy`, the address of a viewer on this machine.
    Viewer(String),
}

impl From<&str> for RerunTarget {
    /// Reads an address, which has a scheme (`…://`), or else a path.
    fn from(text: &str) -> Self {
        if text.contains("://") { Self::Viewer(text.into()) } else { Self::File(text.into()) }
    }
}

impl std::fmt::Display for RerunTarget {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::File(path) => write!(f, "{}", path.display()),
            Self::Viewer(address) => f.write_str(address),
        }
    }
}

/// Error of a recording.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum RerunError {
    /// The file cannot be written.
    #[error("{}: the Rerun file cannot be written: {reason}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// Message of the system.
        reason: String,
    },
    /// No viewer of Rerun answers.
    #[error("{address}: no viewer of Rerun answers; start one with `rerun`")]
    Viewer {
        /// Address of the viewer.
        address: String,
    },
    /// The address is none of a viewer.
    #[error("{address}: this is no address of a viewer of Rerun, expected for example {DEFAULT}")]
    Address {
        /// The address.
        address: String,
    },
    /// The scene cannot be drawn or described.
    #[error("the scene cannot be recorded: {reason}")]
    Scene {
        /// Message of the simulator or of MuJoCo.
        reason: String,
    },
}

/// Address of a viewer on this machine.
const DEFAULT: &str = "rerun+http://127.0.0.1:9876/proxy";

/// Longest time that a viewer may take to receive what it was sent.
const PATIENCE: Duration = Duration::from_secs(5);

/// Time between two points of a trail, s.
const TRAIL_PERIOD: f64 = 0.05;

/// Largest number of points of a trail: the last 10 s.
const TRAIL_POINTS: usize = 200;

/// Time between two images of the onboard cameras, s.
const IMAGE_PERIOD: f64 = 0.1;

/// Size of the images of the onboard cameras.
const IMAGE_SIZE: ImageSize = ImageSize { width: 160, height: 120 };

/// Obstacles and markers that cameras see.
type SeenBodies = (Arc<[Obstacle]>, Arc<[Marker]>);

/// Recording of one episode.
///
/// ```no_run
/// use aviary::env::Env;
/// use aviary::tasks::Hover;
/// use viewer::rerun::RerunLog;
/// use viewer::Source;
///
/// let mut env = Hover::builder().build()?;
/// env.reset(Some(3))?;
/// let mut log = RerunLog::begin(&"hover.rrd".into(), Source::Env(&env), false)?;
/// while env.step(&[vec![0.0; 4]])?.end.is_none() {
///     log.note(Source::Env(&env))?;
/// }
/// log.finish()?;
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct RerunLog {
    stream: RecordingStream,
    target: RerunTarget,
    /// Last frame, whose obstacles and markers have been recorded.
    last: Option<Frame>,
    trails: Vec<Vec<Vector3<f64>>>,
    next_trail: f64,
    cameras: Option<SceneRenderer>,
    /// Obstacles and markers that the cameras see.
    seen: Option<SeenBodies>,
    next_image: f64,
}

impl std::fmt::Debug for RerunLog {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("RerunLog").field("target", &self.target).finish_non_exhaustive()
    }
}

impl RerunLog {
    /// Begins a recording of an episode that has just started, and records its first state. `with_images` adds images
    /// of the onboard cameras, ten per second of simulated time.
    ///
    /// # Errors
    /// [`RerunError::File`] if the file cannot be created, [`RerunError::Address`] if the address is none of a viewer,
    /// [`RerunError::Viewer`] if no viewer answers within 5 s, [`RerunError::Scene`] if meshes cannot be read or images
    /// cannot be drawn.
    pub fn begin(target: &RerunTarget, source: Source<'_>, with_images: bool) -> Result<Self, RerunError> {
        Self::begin_with(target, source, |drone| source.reference(drone), with_images)
    }

    /// Begins a recording like [`begin`](Self::begin). `reference` returns the position that a drone follows (world
    /// frame, m).
    ///
    /// # Errors
    /// As for [`begin`](Self::begin).
    pub fn begin_with(
        target: &RerunTarget,
        source: Source<'_>,
        reference: impl Fn(usize) -> Option<Vector3<f64>>,
        with_images: bool,
    ) -> Result<Self, RerunError> {
        // the environment variable `RERUN` does not overrule a recording that was asked for
        let builder = RecordingStreamBuilder::new("aviary").recording_name(source.name()).default_enabled(true);
        let stream = match target {
            RerunTarget::File(path) => builder.save(path).map_err(|error| target.error(&error)),
            RerunTarget::Viewer(address) => {
                let connected = builder.connect_grpc_opts(address.as_str());
                connected.map_err(|_| RerunError::Address { address: address.clone() })
            }
        };
        let stream = stream?;
        Self::on(stream, target.clone(), source, reference, with_images)
    }

    fn on(
        stream: RecordingStream,
        target: RerunTarget,
        source: Source<'_>,
        reference: impl Fn(usize) -> Option<Vector3<f64>>,
        with_images: bool,
    ) -> Result<Self, RerunError> {
        let episode = EpisodeView::new(source, 1);
        let cameras = with_images.then(|| SceneRenderer::for_observations(&episode.world)).transpose();
        let mut log = Self {
            stream,
            target,
            last: None,
            trails: vec![Vec::new(); episode.world.drones.len()],
            next_trail: 0.0,
            cameras: cameras.map_err(|error| RerunError::Scene { reason: error.to_string() })?,
            seen: None,
            next_image: 0.0,
        };
        log.scene(&episode)?;
        log.series(&Frame::new(source, None, &reference))?;
        log.note_with(source, reference)?;
        // an address where nobody answers is found out before the flight
        log.flush()?;
        Ok(log)
    }

    /// Records the present state.
    ///
    /// # Errors
    /// [`RerunError`] if the recording cannot be continued.
    pub fn note(&mut self, source: Source<'_>) -> Result<(), RerunError> {
        self.note_with(source, |drone| source.reference(drone))
    }

    /// Records the present state. `reference` returns the position that a drone follows (world frame, m).
    ///
    /// # Errors
    /// [`RerunError`] if the recording cannot be continued.
    pub fn note_with(
        &mut self,
        source: Source<'_>,
        reference: impl Fn(usize) -> Option<Vector3<f64>>,
    ) -> Result<(), RerunError> {
        let frame = Frame::new(source, self.last.as_ref(), reference);
        self.stream.set_duration_secs("time", frame.time);
        self.stream.set_time_sequence("step", i64::try_from(frame.step).unwrap_or(i64::MAX));
        let is_new = |same: bool| self.last.is_none() || !same;
        let before = self.last.as_ref();
        if is_new(before.is_some_and(|before| Arc::ptr_eq(&before.obstacles, &frame.obstacles))) {
            self.bodies("world/obstacles", frame.obstacles.iter(), &[])?;
        }
        if is_new(before.is_some_and(|before| Arc::ptr_eq(&before.markers, &frame.markers))) {
            let names: Vec<_> = frame.markers.iter().map(|marker| marker.name.clone()).collect();
            self.bodies("world/markers", frame.markers.iter().map(|Marker { body, .. }| body), &names)?;
        }
        for drone in 0..frame.drones.len() {
            self.drone(&frame, drone)?;
        }
        self.trails(&frame)?;
        self.images(&frame)?;
        self.log("plots/wind", &Scalars::new(frame.wind.iter().copied()))?;
        for (name, value) in &frame.metrics {
            self.log(&format!("plots/metrics/{name}"), &Scalars::new([*value]))?;
        }
        if let Some(end) = frame.end
            && self.last.as_ref().is_none_or(|last| last.end.is_none())
        {
            self.log("events", &TextLog::new(format!("the episode ended: {}", end.name())))?;
        }
        self.last = Some(frame);
        Ok(())
    }

    /// Writes everything that is still in memory.
    ///
    /// # Errors
    /// [`RerunError`] if it cannot be written.
    pub fn finish(self) -> Result<(), RerunError> {
        self.flush()
    }

    fn flush(&self) -> Result<(), RerunError> {
        self.stream.flush_with_timeout(PATIENCE).map_err(|error| self.target.error(&error))
    }

    fn log(&self, path: &str, what: &dyn AsComponents) -> Result<(), RerunError> {
        self.stream.log(path, what).map_err(|error| self.target.error(&error))
    }

    fn log_static(&self, path: &str, what: &dyn AsComponents) -> Result<(), RerunError> {
        self.stream.log_static(path, what).map_err(|error| self.target.error(&error))
    }

    /// Records the floor, the meshes and the cameras of the drones, and planned paths.
    fn scene(&self, episode: &EpisodeView) -> Result<(), RerunError> {
        let count = episode.world.drones.len();
        self.log_static("world", &ViewCoordinates::RIGHT_HAND_Z_UP())?;
        for (index, drone) in episode.world.drones.iter().enumerate() {
            let meshes =
                VisualMesh::of(&drone.params).map_err(|error| RerunError::Scene { reason: error.to_string() })?;
            for mesh in meshes {
                let path = format!("world/drone{index}/model/{}", mesh.name);
                let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), mesh.yaw);
                let pose = Transform3D::new().with_quaternion(quaternion(&turn)).with_scale(mesh.scale as f32);
                self.log_static(&path, &pose)?;
                let asset = Asset3D::from_file_contents(mesh.obj, Some(MediaType::obj()));
                self.log_static(&path, &asset.with_albedo_factor(*rgba(mesh.rgba.map(|x| x as f32))))?;
            }
            let camera = format!("world/drone{index}/camera");
            let position = World::CAMERA_POSITION.map(|x| x as f32);
            self.log_static(&camera, &Transform3D::from_translation(position))?;
            let [fx, fy, ..] = intrinsics(IMAGE_SIZE).map(|x| x as f32);
            let size = [IMAGE_SIZE.width as f32, IMAGE_SIZE.height as f32];
            let pinhole = Pinhole::from_focal_length_and_resolution([fx, fy], size)
                .with_camera_xyz(rerun::components::ViewCoordinates::FLU)
                .with_image_plane_distance(3.0 * drone.params.arm_length as f32);
            self.log_static(&camera, &pinhole)?;
            if let Some(path) = episode.paths.get(index).filter(|path| !path.is_empty()) {
                let line = LineStrips3D::new([points(path)]).with_colors([rgba(faint(index, count))]);
                self.log_static(&format!("world/paths/drone{index}"), &line)?;
            }
        }
        Ok(())
    }

    /// Records the names of the series.
    fn series(&self, frame: &Frame) -> Result<(), RerunError> {
        let axes = |unit: &str| ["x", "y", "z"].map(|axis| format!("{axis} ({unit})"));
        let count = frame.drones.len();
        let names = |path: &str, names: &[String]| {
            let names = names.iter().map(String::as_str);
            self.log_static(path, &SeriesLines::new().with_names(names))
        };
        for index in 0..count {
            let plots = format!("plots/drone{index}");
            names(&format!("{plots}/position"), &axes("m"))?;
            names(&format!("{plots}/reference"), &axes("m"))?;
            names(&format!("{plots}/velocity"), &axes("m/s"))?;
            names(&format!("{plots}/attitude"), &["roll (°)", "pitch (°)", "yaw (°)"].map(String::from))?;
            names(&format!("{plots}/body_rates"), &axes("rad/s"))?;
            names(&format!("{plots}/rotor_speeds"), &[0, 1, 2, 3].map(|motor| format!("motor {motor} (rpm)")))?;
            names(&format!("{plots}/reward"), &["reward".into()])?;
        }
        names("plots/wind", &axes("m/s"))?;
        for (name, _) in &frame.metrics {
            names(&format!("plots/metrics/{name}"), &[(*name).into()])?;
        }
        Ok(())
    }

    /// Records pose, reference and series of a drone.
    fn drone(&self, frame: &Frame, index: usize) -> Result<(), RerunError> {
        let of_drone = &frame.drones[index];
        let state = &of_drone.state;
        let pose = Transform3D::from_translation_rotation(point(&state.position), quaternion(&state.attitude));
        self.log(&format!("world/drone{index}"), &pose)?;
        let plots = format!("plots/drone{index}");
        let series =
            |name: &str, values: &[f64]| self.log(&format!("{plots}/{name}"), &Scalars::new(values.iter().copied()));
        if let Some(reference) = &of_drone.reference {
            let dot = Points3D::new([point(reference)]).with_radii([0.01]);
            self.log(&format!("world/references/drone{index}"), &dot.with_colors([Color::WHITE]))?;
            series("reference", reference.as_slice())?;
        }
        series("position", state.position.as_slice())?;
        series("velocity", state.velocity.as_slice())?;
        series("attitude", of_drone.rpy.map(f64::to_degrees).as_slice())?;
        series("body_rates", state.angular_velocity.as_slice())?;
        series("rotor_speeds", &of_drone.rotor_speeds)?;
        series("reward", &[of_drone.reward])?;
        let last = self.last.as_ref().and_then(|last| last.drones.get(index));
        let had_terms = last.is_some_and(|last| !last.reward_terms.is_empty());
        for (name, value) in &of_drone.reward_terms {
            let path = format!("reward/{name}");
            if !had_terms {
                // the first state of an episode has no terms
                self.log_static(&format!("{plots}/{path}"), &SeriesLines::new().with_names([*name]))?;
            }
            series(&path, &[*value])?;
        }
        Ok(())
    }

    /// Records the paths of the last seconds and the wind.
    fn trails(&mut self, frame: &Frame) -> Result<(), RerunError> {
        // half a microsecond for the rounding of sums of periods
        if frame.time + 5e-7 < self.next_trail && frame.end.is_none() {
            return Ok(());
        }
        self.next_trail = frame.time + TRAIL_PERIOD;
        let count = frame.drones.len();
        for (index, (trail, drone)) in self.trails.iter_mut().zip(&frame.drones).enumerate() {
            if trail.len() == TRAIL_POINTS {
                trail.remove(0);
            }
            trail.push(drone.state.position);
            let line = LineStrips3D::new([points(trail)]).with_colors([rgba(colour_of(index, count))]);
            let logged = self.stream.log(format!("world/trails/drone{index}"), &line);
            logged.map_err(|error| self.target.error(&error))?;
        }
        let arrows = frame.drones.iter().filter(|_| frame.wind.norm() > 1e-3);
        let origins: Vec<_> = arrows.map(|drone| point(&(drone.state.position + 0.2 * Vector3::z()))).collect();
        let wind = Arrows3D::from_vectors(origins.iter().map(|_| point(&(0.25 * frame.wind))));
        self.log("world/wind", &wind.with_origins(origins).with_colors([Color::from_rgb(0, 217, 242)]))
    }

    /// Records the images of the onboard cameras.
    fn images(&mut self, frame: &Frame) -> Result<(), RerunError> {
        if frame.time + 5e-7 < self.next_image {
            return Ok(());
        }
        let Some(renderer) = &mut self.cameras else { return Ok(()) };
        self.next_image = frame.time + IMAGE_PERIOD;
        let failed = |error: &dyn std::fmt::Display| RerunError::Scene { reason: error.to_string() };
        let states: Vec<DroneState> = frame.states();
        let is_same = |(obstacles, markers): &SeenBodies| {
            Arc::ptr_eq(obstacles, &frame.obstacles) && Arc::ptr_eq(markers, &frame.markers)
        };
        if !self.seen.as_ref().is_some_and(is_same) {
            renderer.set_obstacles(&frame.obstacles).map_err(|error| failed(&error))?;
            renderer.set_markers(&frame.markers).map_err(|error| failed(&error))?;
            self.seen = Some((frame.obstacles.clone(), frame.markers.clone()));
        }
        renderer.update(&states).map_err(|error| failed(&error))?;
        let mut rgba = vec![0; 4 * IMAGE_SIZE.pixels()];
        let mut images = Vec::new();
        for drone in 0..states.len() {
            renderer.onboard_rgba(drone, IMAGE_SIZE, &mut rgba).map_err(|error| failed(&error))?;
            images.push(png_rgba(IMAGE_SIZE, &rgba).map_err(|error| failed(&error))?);
        }
        for (drone, png) in images.into_iter().enumerate() {
            let image = EncodedImage::from_file_contents(png).with_media_type(MediaType::png());
            self.log(&format!("world/drone{drone}/camera"), &image)?;
        }
        Ok(())
    }

    /// Records obstacles or markers, by shape.
    fn bodies<'a>(
        &self,
        path: &str,
        bodies: impl Iterator<Item = &'a Obstacle>,
        names: &[String],
    ) -> Result<(), RerunError> {
        let mut of_shape: [Bodies; 4] = Default::default();
        for (index, body) in bodies.enumerate() {
            let (kind, size) = match body.shape {
                Shape::Box { half_size } => (0, half_size),
                Shape::Sphere { radius } => (1, [radius; 3]),
                Shape::Cylinder { radius, half_height } => (2, [radius, radius, 2.0 * half_height]),
                Shape::Capsule { radius, half_height } => (3, [radius, radius, 2.0 * half_height]),
            };
            of_shape[kind].add(body, size, names.get(index));
        }
        let [boxes, spheres, cylinders, capsules] = of_shape;
        // a shape of which none is left is recorded as an empty list
        let shape = |name: &str, what: &dyn AsComponents| self.log(&format!("{path}/{name}"), what);
        shape(
            "boxes",
            &Boxes3D::from_centers_and_half_sizes(boxes.centres, boxes.sizes)
                .with_quaternions(boxes.attitudes)
                .with_colors(boxes.colours)
                .with_labels(boxes.names)
                .with_show_labels(false)
                .with_fill_mode(FillMode::Solid),
        )?;
        shape(
            "spheres",
            &Ellipsoids3D::from_centers_and_half_sizes(spheres.centres, spheres.sizes)
                .with_colors(spheres.colours)
                .with_labels(spheres.names)
                .with_show_labels(false)
                .with_fill_mode(FillMode::Solid),
        )?;
        let (lengths, radii) = (cylinders.sizes.iter().map(|size| size[2]), cylinders.sizes.iter().map(|size| size[0]));
        shape(
            "cylinders",
            &Cylinders3D::from_lengths_and_radii(lengths, radii)
                .with_centers(cylinders.centres)
                .with_quaternions(cylinders.attitudes)
                .with_colors(cylinders.colours)
                .with_labels(cylinders.names)
                .with_show_labels(false)
                .with_fill_mode(FillMode::Solid),
        )?;
        // capsules of Rerun begin at their origin and are as long as their inner part
        let lengths = capsules.sizes.iter().map(|size| size[2]);
        let starts = capsules.ends();
        shape(
            "capsules",
            &Capsules3D::from_lengths_and_radii(lengths, capsules.sizes.iter().map(|size| size[0]))
                .with_translations(starts)
                .with_quaternions(capsules.attitudes)
                .with_colors(capsules.colours)
                .with_labels(capsules.names)
                .with_show_labels(false)
                .with_fill_mode(FillMode::Solid),
        )
    }
}

impl RerunTarget {
    fn error(&self, error: &dyn std::fmt::Display) -> RerunError {
        match self {
            Self::File(path) => RerunError::File { path: path.clone(), reason: error.to_string() },
            Self::Viewer(address) => RerunError::Viewer { address: address.clone() },
        }
    }
}

/// Bodies of one shape.
#[derive(Default)]
struct Bodies {
    centres: Vec<[f32; 3]>,
    sizes: Vec<[f32; 3]>,
    attitudes: Vec<Quaternion>,
    rotations: Vec<UnitQuaternion<f64>>,
    colours: Vec<Color>,
    names: Vec<String>,
}

impl Bodies {
    fn add(&mut self, body: &Obstacle, size: [f64; 3], name: Option<&String>) {
        let rotation = attitude_from_rpy(body.rpy);
        self.centres.push(point(&body.position));
        self.sizes.push(size.map(|x| x as f32));
        self.attitudes.push(quaternion(&rotation));
        self.rotations.push(rotation);
        self.colours.push(rgba(body.rgba.map(|x| x as f32)));
        self.names.extend(name.cloned());
    }

    /// Returns the points that are half a length below the centres, along the axes of the bodies.
    fn ends(&self) -> Vec<[f32; 3]> {
        let end = |((centre, size), rotation): ((&[f32; 3], &[f32; 3]), &UnitQuaternion<f64>)| {
            let axis = rotation * Vector3::z() * f64::from(size[2]) / 2.0;
            [0, 1, 2].map(|i| centre[i] - axis[i] as f32)
        };
        self.centres.iter().zip(&self.sizes).zip(&self.rotations).map(end).collect()
    }
}

fn point(point: &Vector3<f64>) -> [f32; 3] {
    [point.x as f32, point.y as f32, point.z as f32]
}

fn points(points: &[Vector3<f64>]) -> Vec<[f32; 3]> {
    points.iter().map(point).collect()
}

fn quaternion(rotation: &UnitQuaternion<f64>) -> Quaternion {
    let q = rotation.quaternion();
    Quaternion::from_xyzw([q.i as f32, q.j as f32, q.k as f32, q.w as f32])
}

fn rgba(colour: [f32; 4]) -> Color {
    let [r, g, b, a] = colour.map(|x| (255.0 * x).round() as u8);
    Color::from_unmultiplied_rgba(r, g, b, a)
}

/// Returns the colour of a drone, half transparent.
fn faint(index: usize, count: usize) -> [f32; 4] {
    let [r, g, b, _] = colour_of(index, count);
    [r, g, b, 0.5]
}

#[cfg(test)]
mod tests;
