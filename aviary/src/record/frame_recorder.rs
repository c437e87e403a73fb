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

/// What is drawn into pictures of a flight beside what is there. Drones have the colours that they have in plots.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Overlays {
    /// The way that every drone has come.
    pub trails: bool,
    /// White dots along the way that a drone is to fly, or, where it has none, at the point that it is asked to be at.
    pub references: bool,
    /// A cyan arrow along the steady part of the wind, where it has one, as long as the way that it goes in a quarter of a
    /// second.
    pub wind: bool,
    /// A level ring of this radius (m) around every drone.
    pub rings: Option<f64>,
}

impl Overlays {
    /// Names of the overlays, for [`FromStr`].
    pub const NAMES: [&'static str; 4] = ["trails", "references", "wind", "rings"];

    /// Radius of rings that nobody says one for, m: they touch where drones are 0.3 m apart, the paper's safety radius.
    pub const RING: f64 = 0.15;

    /// All of them.
    pub const ALL: Self = Self { trails: true, references: true, wind: true, rings: Some(Self::RING) };
}

/// Names of overlays with commas between them.
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

/// Pictures of a flight, taken while it is flown, at a steady rate.
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
/// let mut film = FrameRecorder::new(&env, View::Track, size, Overlays { trails: true, ..Overlays::default() })?;
/// let mut gif = GifAnimation::new(Vec::new(), size, film.seconds_per_frame())?;
/// for _ in 0..12 {
///     env.step(&[0.1; 4])?;
///     if let Some(rgb) = film.look(&env)? {
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
    /// Control steps from frame to frame.
    every: u64,
    next: u64,
    /// The control step that was looked at last.
    seen: u64,
    seconds: f64,
    /// Where the drones have been.
    trails: Vec<Trail>,
    /// Points of the way that each drone is to fly.
    ways: Vec<Vec<Vector3<f64>>>,
    obstacles: Vec<Obstacle>,
    markers: Vec<Marker>,
    rgb: Vec<u8>,
}

/// Frames per second, as near as control steps come to it.
const RATE: f64 = 24.0;

impl FrameRecorder {
    /// Of an environment as it is now: reset it before. What drones [plan](DroneEnv::plan) to fly is looked up here, for
    /// [`Overlays::references`].
    ///
    /// # Errors
    /// [`EnvError::Vision`] where there is nothing to draw with.
    pub fn new(env: &dyn DroneEnv, view: View, size: ImageSize, overlays: Overlays) -> Result<Self, EnvError> {
        let mut film = Self::of(env.simulation(), view, size, overlays)?;
        film.renderer.keep_in_frame(&env.extent());
        film.plan(env);
        Ok(film)
    }

    /// Looks up what drones plan to fly, where that is to be seen.
    fn plan(&mut self, env: &dyn DroneEnv) {
        if !self.overlays.references {
            return;
        }
        for (drone, way) in env.plans().into_iter().enumerate() {
            self.ways[drone].clear();
            if let Some(way) = way {
                self.set_way(drone, &*way);
            }
        }
    }

    /// Of a simulation without an environment, whose drones plan nothing.
    ///
    /// # Errors
    /// As for [`new`](Self::new).
    pub fn of(simulation: &Simulation, view: View, size: ImageSize, overlays: Overlays) -> Result<Self, EnvError> {
        let every = (f64::from(simulation.ctrl_freq()) / RATE).round().max(1.0) as u32;
        let drones = simulation.num_drones();
        Ok(Self {
            renderer: SceneRenderer::for_people(simulation.world())?,
            view,
            size,
            overlays,
            every: every.into(),
            next: simulation.control_steps(),
            seen: simulation.control_steps(),
            seconds: f64::from(every) * simulation.control_period(),
            trails: vec![Trail::default(); drones],
            ways: vec![Vec::new(); drones],
            obstacles: simulation.world().obstacles.clone(),
            markers: simulation.world().markers.clone(),
            rgb: vec![0; 3 * size.pixels()],
        })
    }

    /// What a drone is to fly, for [`Overlays::references`].
    ///
    /// # Panics
    /// If there is no drone of that index.
    pub fn set_way(&mut self, drone: usize, way: &dyn Trajectory) {
        const POINTS: u32 = 479;
        let at = |i: u32| way.reference(way.duration() * f64::from(i) / f64::from(POINTS)).position;
        self.ways[drone] = (0..=POINTS).map(at).collect();
    }

    /// What draws it: to set the [stage](SceneRenderer::set_stage), for example.
    pub fn renderer(&mut self) -> &mut SceneRenderer {
        &mut self.renderer
    }

    /// Time from frame to frame, s.
    pub fn seconds_per_frame(&self) -> f64 {
        self.seconds
    }

    /// Size of the frames.
    pub fn size(&self) -> ImageSize {
        self.size
    }

    /// Looks at the flight, after every reset and every step: a frame (RGB, top row first) where it is time for one. Where time
    /// has gone backwards another episode has begun, with trails and plans of its own.
    ///
    /// # Errors
    /// [`EnvError::Vision`].
    pub fn look(&mut self, env: &dyn DroneEnv) -> Result<Option<&[u8]>, EnvError> {
        if env.simulation().control_steps() < self.seen {
            self.renderer.keep_in_frame(&env.extent());
            self.plan(env);
        }
        self.look_at(env.simulation(), |drone| Some(env.reference(drone)))
    }

    /// The same with other references, or without an environment.
    ///
    /// # Errors
    /// As for [`look`](Self::look).
    pub fn look_at(
        &mut self,
        simulation: &Simulation,
        reference: impl Fn(usize) -> Option<Reference>,
    ) -> Result<Option<&[u8]>, EnvError> {
        let now = simulation.control_steps();
        if now < self.seen {
            // another episode
            self.next = now;
            self.trails.fill(Trail::default());
        }
        self.seen = now;
        let max = (Trail::ALL / self.trails.len().max(1)).clamp(40, Trail::MOST);
        for (trail, state) in self.trails.iter_mut().zip(simulation.states()) {
            trail.note(state.position, max);
        }
        if now < self.next {
            return Ok(None);
        }
        self.next = now + self.every;
        self.frame(simulation, reference).map(Some)
    }

    /// A frame of this moment, whatever the time.
    ///
    /// # Errors
    /// As for [`look`](Self::look).
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
        let Self { renderer, overlays, trails, ways, .. } = self;
        let count = trails.len();
        // as wide in a small picture as in a large one
        let thread = (f64::from(self.size.height) / 140.0).max(1.5);
        let size = simulation.world().drones.iter().map(|drone| drone.params.arm_length).fold(0.02, f64::max);
        if overlays.references {
            const WHITE: [f32; 4] = [1.0, 1.0, 1.0, 1.0];
            for (drone, way) in ways.iter().enumerate() {
                if way.is_empty() {
                    let point = reference(drone).map(|reference| reference.position);
                    renderer.add_dots(point.as_slice(), 0.25 * size, WHITE);
                } else {
                    // short pieces with gaps between: dots that cost little
                    for piece in way.chunks(4) {
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
            // the other kinds have no steady part
            && matches!(wind.model, WindModel::Constant | WindModel::Combined)
        {
            // beside the first drone, so that it is seen wherever that goes
            let from = simulation.states()[0].position + Vector3::z() * 4.0 * size;
            let along = Vector3::from(wind.velocity) * 0.25;
            if along.norm() > 1e-3 {
                let arrow = Decor::Arrow { from: from.into(), to: (from + along).into(), radius: 0.2 * size };
                renderer.add(arrow, [0.0, 0.85, 0.95, 1.0]);
            }
        }
    }
}

/// The way that a drone has come, in points that are so far apart that there are never many.
#[derive(Debug, Clone, PartialEq)]
struct Trail {
    points: Vec<Vector3<f64>>,
    /// Least distance from point to point, m.
    spacing: f64,
}

impl Default for Trail {
    fn default() -> Self {
        Self { points: Vec::new(), spacing: 0.01 }
    }
}

impl Trail {
    const MOST: usize = 600;
    /// Most points of all trails together: a scene has room for so many lines and some more.
    const ALL: usize = 12_000;

    fn note(&mut self, position: Vector3<f64>, max: usize) {
        // the last point follows the drone until it is far enough from the one before
        if let [.., before, last] = &mut self.points[..]
            && (*last - *before).norm() < self.spacing
        {
            *last = position;
            return;
        }
        self.points.push(position);
        if self.points.len() > max {
            let last = self.points.len() - 1;
            let mut index = 0;
            self.points.retain(|_| {
                index += 1;
                index % 2 == 1 || index > last
            });
            self.spacing *= 2.0;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_trail_keeps_its_ends_and_stays_short() {
        let mut trail = Trail::default();
        for i in 0..100_000 {
            let turn = f64::from(i) * 1e-3;
            trail.note(Vector3::new(turn.cos(), turn.sin(), turn * 0.1), Trail::MOST);
        }
        assert!(trail.points.len() <= Trail::MOST + 1, "{}", trail.points.len());
        assert_eq!(trail.points[0], Vector3::x());
        assert!(
            (trail.points.last().unwrap() - Vector3::new(99.999_f64.cos(), 99.999_f64.sin(), 9.9999)).norm() < 1e-9
        );
        // a drone that stands still adds nothing
        let points = trail.points.len();
        let here = *trail.points.last().unwrap();
        (0..1000).for_each(|_| trail.note(here, Trail::MOST));
        assert!(trail.points.len() <= points + 1);
    }

    #[test]
    fn overlays_are_named_and_unknown_ones_suggest_the_nearest() {
        let some: Overlays = "trails, rings".parse().unwrap();
        assert_eq!(some, Overlays { trails: true, rings: Some(0.15), ..Overlays::default() });
        let wrong = "trail".parse::<Overlays>().unwrap_err();
        assert!(wrong.contains("did you mean `trails`"), "{wrong}");
    }
}
