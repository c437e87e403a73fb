use std::str::FromStr;

use nalgebra::Vector3;

use super::plot::colour_of;
use crate::control::Reference;
use crate::control::trajectory::Trajectory;
use crate::env::{DroneEnv, EnvError};
use crate::physics::wind::WindModel;
use crate::simulation::Simulation;
use crate::vision::{Decor, ImageSize, SceneRenderer, View, ring};
use crate::world::{Marker, Obstacle};

/// Overlays that a frame shows in addition to the scene. Each drone has the colour that it has in plots.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Overlays {
    /// Flown path of every drone.
    pub trails: bool,
    /// White dots along the planned path of a drone or, without a plan, at its reference position.
    pub references: bool,
    /// Cyan arrow along the steady part of the wind, if it has one. Its length is the distance that the wind
    /// travels in 0.25 s.
    pub wind: bool,
    /// Horizontal ring of this radius (m) around every drone.
    pub rings: Option<f64>,
}

impl Overlays {
    /// Names of the overlays, for [`FromStr`].
    pub const NAMES: [&'static str; 4] = ["trails", "references", "wind", "rings"];

    /// Default radius of rings, m. Two rings touch if the drones are 0.3 m apart, the paper's safety radius.
    pub const RING: f64 = 0.15;

    /// All overlays.
    pub const ALL: Self = Self { trails: true, references: true, wind: true, rings: Some(Self::RING) };
}

/// Parses names of overlays separated by commas.
impl FromStr for Overlays {
    type Err = String;

    fn from_str(names: &str) -> Result<Self, String> {
        let mut overlays = Self::default();
        for name in names.split(',').map(str::trim) {
            match name {
                "trails" => overlays.trails = true,
                "references" => overlays.references = true,
                "wind" => overlays.wind = true,
                "rings" => overlays.rings = Some(Self::RING),
                _ => {
                    let near = crate::error::did_you_mean(name, &Self::NAMES);
                    return Err(format!("no overlay `{name}`, expected some of: {}{near}", Self::NAMES.join(", ")));
                }
            }
        }
        Ok(overlays)
    }
}

/// Recorder of the frames of a running flight at a constant rate.
///
/// ```
/// use aviary::env::Env;
/// use aviary::record::animation::{Animation, GifAnimation};
/// use aviary::record::{FrameRecorder, Overlays};
/// use aviary::tasks::Hover;
/// use aviary::vision::{ImageSize, View};
/// # if mujoco_rs::gl_info().is_err() {
/// #     return Ok(());
/// # }
///
/// let size = ImageSize { width: 64, height: 48 };
/// let mut env = Hover::builder().build()?;
/// env.reset(Some(1))?;
/// let mut recorder = FrameRecorder::new(&env, View::Track, size, Overlays { trails: true, ..Overlays::default() })?;
/// let mut gif = GifAnimation::new(Vec::new(), size, recorder.seconds_per_frame())?;
/// for _ in 0..12 {
///     env.step(&[0.1; 4])?;
///     if let Some(rgb) = recorder.look(&env)? {
///         gif.frame(rgb)?;
///     }
/// }
/// assert!(gif.finish()?.starts_with(b"GIF89a"));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct FrameRecorder {
    renderer: SceneRenderer,
    view: View,
    size: ImageSize,
    overlays: Overlays,
    /// Number of control steps between frames.
    every: u64,
    next: u64,
    /// Control step of the last call.
    last_step: u64,
    seconds: f64,
    /// Flown path of every drone.
    trails: Vec<Trail>,
    /// Points of the planned path of every drone.
    paths: Vec<Vec<Vector3<f64>>>,
    obstacles: Vec<Obstacle>,
    markers: Vec<Marker>,
    rgb: Vec<u8>,
}

/// Target frame rate, Hz. The actual rate is a divisor of the control rate.
const RATE: f64 = 24.0;

impl FrameRecorder {
    /// Creates a recorder for an environment, which must have been reset. [`Overlays::references`] shows the
    /// trajectories that drones [plan](DroneEnv::plan) now.
    ///
    /// # Errors
    /// [`EnvError::Option`] for a side of zero or of more than [`ImageSize::MAX_SIDE`], and [`EnvError::Vision`] if
    /// OpenGL is not available.
    pub fn new(env: &dyn DroneEnv, view: View, size: ImageSize, overlays: Overlays) -> Result<Self, EnvError> {
        let mut recorder = Self::of(env.simulation(), view, size, overlays)?;
        recorder.renderer.keep_in_frame(&env.extent());
        recorder.plan(env);
        Ok(recorder)
    }

    /// Updates the planned paths if the overlays show them.
    fn plan(&mut self, env: &dyn DroneEnv) {
        if !self.overlays.references {
            return;
        }
        for (drone, plan) in env.plans().into_iter().enumerate() {
            self.paths[drone].clear();
            if let Some(plan) = plan {
                self.set_path(drone, &*plan);
            }
        }
    }

    /// Creates a recorder for a simulation without an environment, whose drones have no plans.
    ///
    /// # Errors
    /// Returns the errors of [`new`](Self::new).
    pub fn of(simulation: &Simulation, view: View, size: ImageSize, overlays: Overlays) -> Result<Self, EnvError> {
        let sides = 1..=ImageSize::MAX_SIDE;
        if !(sides.contains(&size.width) && sides.contains(&size.height)) {
            let (got, expected) = (size.to_string(), "sides of 1 to 8192 pixels");
            return Err(EnvError::Option { option: "size", got, expected });
        }
        let every = (f64::from(simulation.ctrl_freq()) / RATE).round().max(1.0) as u32;
        let drones = simulation.num_drones();
        Ok(Self {
            renderer: SceneRenderer::for_people(simulation.world())?,
            view,
            size,
            overlays,
            every: every.into(),
            next: simulation.control_steps(),
            last_step: simulation.control_steps(),
            seconds: f64::from(every) * simulation.control_period(),
            trails: vec![Trail::default(); drones],
            paths: vec![Vec::new(); drones],
            obstacles: simulation.world().obstacles.clone(),
            markers: simulation.world().markers.clone(),
            rgb: vec![0; 3 * size.pixels()],
        })
    }

    /// Sets the planned path of a drone for [`Overlays::references`].
    ///
    /// # Panics
    /// If no drone has the index.
    pub fn set_path(&mut self, drone: usize, path: &dyn Trajectory) {
        const POINTS: u32 = 479;
        let at = |i: u32| path.reference(path.duration() * f64::from(i) / f64::from(POINTS)).position;
        self.paths[drone] = (0..=POINTS).map(at).collect();
    }

    /// Returns the renderer, for example to set the points that the static views [keep in the
    /// frame](SceneRenderer::keep_in_frame).
    pub fn renderer(&mut self) -> &mut SceneRenderer {
        &mut self.renderer
    }

    /// Returns the time between frames, s.
    pub fn seconds_per_frame(&self) -> f64 {
        self.seconds
    }

    /// Returns the size of the frames.
    pub fn size(&self) -> ImageSize {
        self.size
    }

    /// Updates the recorder; call it after every reset and every step. Returns a frame (RGB, top row first) if one
    /// is due. An earlier time than in the last call starts a new episode, which clears the trails and updates the
    /// plans.
    ///
    /// # Errors
    /// [`EnvError::Vision`] if the frame cannot be rendered.
    pub fn look(&mut self, env: &dyn DroneEnv) -> Result<Option<&[u8]>, EnvError> {
        if env.simulation().control_steps() < self.last_step {
            self.renderer.keep_in_frame(&env.extent());
            self.plan(env);
        }
        self.look_at(env.simulation(), |drone| Some(env.reference(drone)))
    }

    /// Updates the recorder like [`look`](Self::look), with references of the caller instead of those of an
    /// environment.
    ///
    /// # Errors
    /// Returns the errors of [`look`](Self::look).
    pub fn look_at(
        &mut self,
        simulation: &Simulation,
        reference: impl Fn(usize) -> Option<Reference>,
    ) -> Result<Option<&[u8]>, EnvError> {
        let now = simulation.control_steps();
        if now < self.last_step {
            self.next = now;
            self.trails.fill(Trail::default());
        }
        self.last_step = now;
        let max = (Trail::MAX_TOTAL / self.trails.len().max(1)).clamp(40, Trail::MAX_POINTS);
        for (trail, state) in self.trails.iter_mut().zip(simulation.states()) {
            trail.push(now, state.position, max);
        }
        if now < self.next {
            return Ok(None);
        }
        self.next = now + self.every;
        self.frame(simulation, reference).map(Some)
    }

    /// Continues the recording from an earlier control step of the episode: removes the later points of the trails. The
    /// next frame is the first one after this step that the recorder would also have returned without the change.
    /// Frames of later steps that the recorder has returned are the caller's to remove.
    pub fn rewind(&mut self, step: u64) {
        for trail in &mut self.trails {
            trail.rewind(step);
        }
        self.next -= self.next.saturating_sub(step + 1) / self.every * self.every;
        self.last_step = self.last_step.min(step);
    }

    /// Renders a frame of the current state, independent of the frame rate.
    ///
    /// # Errors
    /// Returns the errors of [`look`](Self::look).
    pub fn frame(
        &mut self,
        simulation: &Simulation,
        reference: impl Fn(usize) -> Option<Reference>,
    ) -> Result<&[u8], EnvError> {
        let obstacles = simulation.obstacles();
        if self.obstacles != *obstacles {
            self.renderer.set_obstacles(obstacles)?;
            self.obstacles.clear();
            self.obstacles.extend_from_slice(obstacles);
        }
        let markers = &simulation.markers();
        if self.markers != *markers {
            self.renderer.set_markers(markers)?;
            self.markers.clone_from(markers);
        }
        self.renderer.update(simulation.states())?;
        self.draw_overlays(simulation, reference);
        self.renderer.rgb(self.view, self.size, &mut self.rgb)?;
        Ok(&self.rgb)
    }

    fn draw_overlays(&mut self, simulation: &Simulation, reference: impl Fn(usize) -> Option<Reference>) {
        let Self { renderer, overlays, trails, paths, .. } = self;
        let count = trails.len();
        // lines have the same width relative to the image at any size
        let thread = (f64::from(self.size.height) / 140.0).max(1.5);
        let size = simulation.world().drones.iter().map(|drone| drone.params.arm_length).fold(0.02, f64::max);
        if overlays.references {
            const WHITE: [f32; 4] = [1.0, 1.0, 1.0, 1.0];
            for (drone, path) in paths.iter().enumerate() {
                if path.is_empty() {
                    let point = reference(drone).map(|reference| reference.position);
                    renderer.add_dots(point.as_slice(), 0.25 * size, WHITE);
                } else {
                    // short lines with gaps look like dots and are much faster than spheres
                    for piece in path.chunks(4) {
                        renderer.add_thread(&piece[..piece.len().min(2)], thread, WHITE);
                    }
                }
            }
        }
        for (drone, state) in simulation.states().iter().enumerate() {
            let rgba = colour_of(drone, count);
            if overlays.trails {
                renderer.add_thread(&trails[drone].points, thread, rgba);
            }
            if let Some(radius) = overlays.rings {
                renderer.add_thread(&ring(state.position, Vector3::z(), radius), thread, rgba);
            }
        }
        if overlays.wind
            && let Some(wind) = simulation.wind()
            // the other wind models have no steady part
            && matches!(wind.model, WindModel::Constant | WindModel::Combined)
        {
            // above the first drone, so that the arrow stays in view
            let from = simulation.states()[0].position + Vector3::z() * 4.0 * size;
            let along = Vector3::from(wind.velocity) * 0.25;
            if along.norm() > 1e-3 {
                let arrow = Decor::Arrow { from: from.into(), to: (from + along).into(), radius: 0.2 * size };
                renderer.add(arrow, [0.0, 0.85, 0.95, 1.0]);
            }
        }
    }
}

/// Flown path of a drone. The spacing of the points grows so that their number stays limited.
#[derive(Debug, Clone, PartialEq)]
struct Trail {
    points: Vec<Vector3<f64>>,
    /// Control steps of the points.
    steps: Vec<u64>,
    /// Minimum distance between points, m.
    spacing: f64,
}

impl Default for Trail {
    fn default() -> Self {
        Self { points: Vec::new(), steps: Vec::new(), spacing: 0.01 }
    }
}

impl Trail {
    /// Maximum number of points of one trail.
    const MAX_POINTS: usize = 600;
    /// Maximum number of points of all trails, which leaves room in the scene for other shapes.
    const MAX_TOTAL: usize = 12_000;

    fn push(&mut self, step: u64, position: Vector3<f64>, max: usize) {
        // the last point follows the drone until it is far enough from the point before it
        if let [.., before, last] = &self.points[..]
            && (*last - *before).norm() < self.spacing
        {
            self.points.pop();
            self.steps.pop();
        }
        self.points.push(position);
        self.steps.push(step);
        if self.points.len() > max {
            thin_out(&mut self.points);
            thin_out(&mut self.steps);
            self.spacing *= 2.0;
        }
    }

    /// Removes the points after a control step.
    fn rewind(&mut self, step: u64) {
        self.steps.truncate(self.steps.partition_point(|&of_point| of_point <= step));
        self.points.truncate(self.steps.len());
    }
}

/// Removes every second element, but not the last one.
fn thin_out<T>(elements: &mut Vec<T>) {
    let last = elements.len() - 1;
    let mut index = 0;
    elements.retain(|_| {
        index += 1;
        index % 2 == 1 || index > last
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A trail after a rewind continues as a trail that never had the later points.
    #[test]
    fn a_rewound_trail_is_that_of_a_flight_without_the_later_states() {
        let point = |step: u64, wave: f64| Vector3::new(0.004 * step as f64, (wave * step as f64).sin() * 0.01, 1.0);
        for rewound in [0, 1, 57, 100] {
            let (mut trail, mut plain) = (Trail::default(), Trail::default());
            (0..=100).for_each(|step| trail.push(step, point(step, 0.3), Trail::MAX_POINTS));
            trail.rewind(rewound);
            assert!(trail.steps.iter().all(|&step| step <= rewound) && trail.steps.len() == trail.points.len());
            // the first state after a rewind is the one that the flight continues from
            for step in rewound..=200 {
                trail.push(step, point(step, 0.3), Trail::MAX_POINTS);
            }
            (0..=200).for_each(|step| plain.push(step, point(step, 0.3), Trail::MAX_POINTS));
            assert_eq!(trail, plain, "{rewound}");
        }
    }

    #[test]
    fn a_trail_keeps_its_ends_and_stays_short() {
        let mut trail = Trail::default();
        for i in 0..100_000_u32 {
            let turn = f64::from(i) * 1e-3;
            trail.push(i.into(), Vector3::new(turn.cos(), turn.sin(), turn * 0.1), Trail::MAX_POINTS);
        }
        assert!(trail.points.len() <= Trail::MAX_POINTS + 1, "{}", trail.points.len());
        assert_eq!(trail.points[0], Vector3::x());
        assert!(
            (trail.points.last().unwrap() - Vector3::new(99.999_f64.cos(), 99.999_f64.sin(), 9.9999)).norm() < 1e-9
        );
        // a hovering drone adds no points
        let points = trail.points.len();
        let here = *trail.points.last().unwrap();
        (100_000..101_000).for_each(|step| trail.push(step, here, Trail::MAX_POINTS));
        assert!(trail.points.len() <= points + 1);
    }

    #[test]
    fn overlays_are_parsed_by_name_and_unknown_names_suggest_the_nearest() {
        let some: Overlays = "trails, rings".parse().unwrap();
        assert_eq!(some, Overlays { trails: true, rings: Some(0.15), ..Overlays::default() });
        let wrong = "trail".parse::<Overlays>().unwrap_err();
        assert!(wrong.contains("did you mean `trails`"), "{wrong}");
    }
}
