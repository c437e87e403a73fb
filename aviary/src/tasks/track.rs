use std::f64::consts::{FRAC_PI_2, TAU};

use flight::tasks::RewardTerms;
use flight::tasks::track::{self, Circle};
use nalgebra::Vector3;
use pulp::Simd;
use rand::RngExt as _;

use super::conditions::{CrashConditions, CrashWatch, with_crash};
use super::{STATE_BOUNDS, UNBOUNDED, observed};
use crate::control::{ControllerKind, Reference};
use crate::drone::DroneParams;
use crate::env::{
    AviaryBuilder, BoxSpace, EndReason, EnvError, LaneFunctions, LaneRows, LaneScene, LaneTask, Rng, Task,
    TaskDefaults, TaskRows, path_points,
};
use crate::math::{Pack, Real, ToNalgebra as _};
use crate::observation::STATE_SIZE;
use crate::simulation::SimView;
use crate::state::DroneState;
use crate::world::placement::max_collision_radius;

/// Task: a drone follows a point on a circle (the `track` task of the paper's vectorized back end, §3.6).
///
/// | | |
/// | --- | --- |
/// | Start | random point of the circle, level, at rest; custom initial positions are shifted in the same manner |
/// | Reference | circle of radius 0.5 m around (0, 0, 1) m at 0.5 m/s, in a random direction, accelerating for 1 s |
/// | Action | 4 normalized motor speeds in [−1, 1] per drone |
/// | Reward | −‖p − p\*‖ − 0.1·‖v − v\*‖ − 0.05·(\|φ\| + \|θ\|), + 0.5 while tracked, − 100 for a crash |
/// | Reward terms | `position_error`, `velocity_error`, `tilt`, `tracked`, `crash` |
/// | Tracked, success | ‖p − p\*‖ < 0.05 m |
/// | Terminated | crash (tilt > 90°, contact, z < 0), or farther than 2 m from the reference |
/// | Truncated | after 10 s |
///
/// | Observation, per drone | | Unit, frame |
/// | --- | --- | --- |
/// | 0–11 | position, roll-pitch-yaw, velocity, angular velocity | as in [`Hover`](super::Hover) |
/// | 12–14 | p\* − p, the reference relative to the drone | m, world |
/// | 15–17 | v\*, the velocity of the reference | m/s, world |
///
/// ```
/// use aviary::env::{DroneEnv, Env};
/// use aviary::tasks::Track;
///
/// let mut env = Track::builder().build()?;
/// env.reset(Some(1))?;
/// let (drone, point) = (env.simulation().states()[0].position, env.reference(0).position);
/// assert!((drone - point).norm() < 1e-9, "it starts where the point does");
/// assert!((point.xy().norm() - 0.5).abs() < 1e-9);
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Clone, serde::Serialize, serde::Deserialize)]
pub struct Track {
    /// Radius of the circle, m; default 0.5.
    pub radius: f64,
    /// Height of the circle, m; default 1.
    pub height: f64,
    /// Speed of the reference, m/s; default 0.5.
    pub speed: f64,
    /// Distance from the reference above which the episode ends, m; default 2.
    pub max_distance: f64,
    /// Conditions under which a drone crashes.
    pub crash: CrashConditions,
    watch: CrashWatch,
    /// Initial angle of the reference, rad.
    phase: f64,
    /// Direction of the reference: 1 counterclockwise, −1 clockwise, seen from above.
    direction: f64,
}

impl Default for Track {
    fn default() -> Self {
        Self {
            radius: 0.5,
            height: 1.0,
            speed: 0.5,
            max_distance: 2.0,
            crash: CrashConditions::with_max_tilt(FRAC_PI_2),
            watch: CrashWatch::default(),
            phase: 0.0,
            direction: 1.0,
        }
    }
}

impl Track {
    /// Creates a builder for the environment of this task.
    pub fn builder() -> AviaryBuilder<Self> {
        AviaryBuilder::new(Self::default())
    }

    /// Returns the reference of a drone at a time (s) of the episode.
    fn target(&self, drone: usize, time: f64) -> Reference {
        let circle = self.circle(drone);
        let [position, velocity, acceleration] = circle.motion(time);
        Reference {
            velocity: velocity.to_nalgebra(),
            acceleration: acceleration.to_nalgebra(),
            ..Reference::hover(position.to_nalgebra(), 0.0)
        }
    }

    fn circle(&self, drone: usize) -> Circle<f64> {
        let Self { radius, height, phase, direction, .. } = *self;
        let y = -(4.0 * radius + 1.0) * drone as f64;
        Circle { y, height, radius, rate: self.speed / radius, phase, direction }
    }

    fn now(&self, simulation: SimView<'_>, drone: usize) -> Reference {
        self.target(drone, simulation.time())
    }

    /// Returns the terms of a drone's reward, or their sum.
    fn terms<T: RewardTerms<f64>>(&self, simulation: SimView<'_>, drone: usize, end: Option<EndReason>) -> T {
        let (state, rpy) = observed(simulation, drone);
        let [position, velocity, _] = self.circle(drone).motion(simulation.time());
        with_crash(track::terms(&state, rpy, position, velocity), end)
    }
}

impl Task for Track {
    fn name(&self) -> &'static str {
        "track"
    }

    fn defaults(&self) -> TaskDefaults {
        TaskDefaults { num_drones: 1, episode_seconds: 10.0, controller: ControllerKind::Geometric }
    }

    fn initial_positions(&self, drones: &[DroneParams]) -> Vec<[f64; 3]> {
        let first = Self { phase: 0.0, ..self.clone() };
        (0..drones.len()).map(|drone| first.target(drone, 0.0).position.into()).collect()
    }

    fn observation_space(&self) -> BoxSpace {
        BoxSpace::new(STATE_BOUNDS.into_iter().chain([UNBOUNDED; 6]))
    }

    fn validate(&self, drones: &[DroneParams]) -> Result<(), EnvError> {
        self.crash.validate()?;
        let widest = max_collision_radius(drones);
        for (option, got, min, expected) in [
            ("radius", self.radius, 1e-3, "1 mm to 1000 m"),
            ("height", self.height, widest, "more than a drone's radius, up to 1000 m"),
            ("speed", self.speed, 0.0, "0 to 1000 m/s"),
            ("max_distance", self.max_distance, 1e-3, "1 mm to 1000 m"),
        ] {
            if !(min..=1e3).contains(&got) {
                return Err(EnvError::Option { option, got: crate::number(got), expected });
            }
        }
        Ok(())
    }

    fn start(&mut self, _simulation: SimView<'_>, rng: &mut Rng, states: &mut [DroneState]) -> bool {
        let direction = if rng.random::<bool>() { 1.0 } else { -1.0 };
        let first = Vector3::x() * self.radius;
        (self.phase, self.direction) = (TAU * rng.random::<f64>(), direction);
        let (sin, cos) = self.phase.sin_cos();
        for state in states {
            // keeps changes by the randomization
            state.position += Vector3::new(cos, sin, 0.0) * self.radius - first;
        }
        true
    }

    fn reset(&mut self, simulation: SimView<'_>, _rng: &mut Rng) {
        self.watch.reset(simulation);
    }

    fn update(&mut self, simulation: SimView<'_>) {
        self.watch.update(&self.crash, simulation);
    }

    fn end(&self, simulation: SimView<'_>, drone: usize) -> Option<EndReason> {
        let (state, _) = observed(simulation, drone);
        let [position, ..] = self.circle(drone).motion(simulation.time());
        let too_far = track::is_too_far(&state, position, self.max_distance);
        self.watch.end(drone).or(too_far.then_some(EndReason::OutOfBounds))
    }

    fn reward(&self, simulation: SimView<'_>, drone: usize, end: Option<EndReason>) -> f64 {
        self.terms(simulation, drone, end)
    }

    fn reward_terms(&self, simulation: SimView<'_>, drone: usize, end: Option<EndReason>) -> Vec<(&'static str, f64)> {
        self.terms(simulation, drone, end)
    }

    fn observe(&self, simulation: SimView<'_>, drone: usize, out: &mut [f64]) {
        let (state, rpy) = observed(simulation, drone);
        let [position, velocity, _] = self.circle(drone).motion(simulation.time());
        track::observe(&state, rpy, position, velocity, out);
    }

    fn success(&self, simulation: SimView<'_>, drone: usize) -> bool {
        let error = simulation.distance(drone, &self.now(simulation, drone).position);
        self.watch.end(drone).is_none() && simulation.control_steps() > 0 && error < track::TRACKED
    }

    fn reference(&self, simulation: SimView<'_>, drone: usize) -> Reference {
        self.now(simulation, drone)
    }

    fn extent(&self, _simulation: SimView<'_>, drone: usize, seconds: f64) -> Vec<Vector3<f64>> {
        path_points(seconds, |time| self.target(drone, time).position).collect()
    }

    fn metrics(&self, simulation: SimView<'_>, report: &mut dyn FnMut(&'static str, f64)) {
        let errors =
            (0..simulation.num_drones()).map(|drone| simulation.distance(drone, &self.now(simulation, drone).position));
        report("tracking_error", errors.fold(0.0, f64::max));
    }

    fn may_be_constant(&self, entry: usize) -> bool {
        // the reference may stand still, or move in a horizontal plane
        entry >= STATE_SIZE
    }

    fn lane_functions() -> Option<LaneFunctions<Self>> {
        Some(LaneFunctions::of())
    }

    super::saved_by_serde!();
}

impl Track {
    /// Returns the circle from the rows of a drone.
    #[inline(always)]
    fn circle_in_lanes<S: Simd>(own: &LaneRows<'_, S>) -> Circle<Pack<S>> {
        let row = |index| own.get(CrashWatch::ROWS + index);
        Circle { y: row(0), height: row(1), radius: row(2), rate: row(3), phase: row(4), direction: row(5) }
    }
}

/// The rows of a drone are those of [`CrashWatch`], the circle and the maximum distance.
impl LaneTask for Track {
    const ROWS: usize = CrashWatch::ROWS + 7;
    const OBSERVES_ATTITUDE: bool = false;

    fn write_rows(&self, simulation: SimView<'_>, drone: usize, rows: &mut [f64]) {
        let (watch, own) = rows.split_at_mut(CrashWatch::ROWS);
        self.watch.write_rows(&self.crash, simulation, drone, watch);
        let Circle { y, height, radius, rate, phase, direction } = self.circle(drone);
        own.copy_from_slice(&[y, height, radius, rate, phase, direction, self.max_distance]);
    }

    fn read_rows(&mut self, drone: usize, rows: &[f64]) {
        self.watch.read_rows(drone, &rows[..CrashWatch::ROWS]);
    }

    #[inline(always)]
    fn evaluate<S: Simd>(scene: &LaneScene<'_, S>, drone: usize, rows: &mut TaskRows<'_, S>) -> (Pack<S>, Pack<S>) {
        let (state, mut own) = (scene.state(drone), rows.drone(drone));
        let crashed = CrashWatch::update_rows(&state, &mut own);
        let [position, velocity, _] = Self::circle_in_lanes(&own).motion(scene.time());
        let max_distance = own.get(CrashWatch::ROWS + 6);
        let far = track::is_too_far(&state, position, max_distance);
        let event = Real::choose(far, crashed.all(1.0), crashed);
        (track::reward(&state, scene.rpy(drone), position, velocity), event)
    }

    #[inline(always)]
    fn observe_lanes<S: Simd>(
        scene: &LaneScene<'_, S>,
        drone: usize,
        rows: &mut TaskRows<'_, S>,
        out: &mut LaneRows<'_, S>,
    ) {
        let [position, velocity, _] = Self::circle_in_lanes(&rows.drone(drone)).motion(scene.time());
        track::observe(&scene.state(drone), scene.rpy(drone), position, velocity, out);
    }
}
