use std::f64::consts::FRAC_PI_2;

use flight::tasks::{RewardTerms, fly_through};
use nalgebra::Vector3;
use pulp::Simd;

use super::conditions::{CrashConditions, CrashWatch, with_crash};
use super::waypoint_progress::{self, WaypointProgress};
use super::{STATE_BOUNDS, UNBOUNDED, observed, row_along_y};
use crate::control::trajectory::Trajectory;
use crate::control::{ControllerKind, Reference};
use crate::drone::DroneParams;
use crate::env::{
    AviaryBuilder, BoxSpace, EndReason, EnvError, LaneFunctions, LaneMask, LaneRows, LaneScene, LaneTask, Rng, Task,
    TaskDefaults, TaskOptions, TaskRows,
};
use crate::math::{Pack, Real, ToFlight as _};
use crate::simulation::SimView;
use crate::world::{Marker, Obstacle, Shape};

/// Task: a drone visits waypoints in order (paper, §4.1 `FlyThroughAviary`).
///
/// | | |
/// | --- | --- |
/// | Start | (0, 0, 0.1) m; several drones in a row along −y, each visiting all waypoints |
/// | Waypoints | (0, 0, 1), (1, 0, 1), (1, 1, 1.5), (0, 1, 1), (0, 0, 0.5) m, captured within 0.1 m |
/// | Action | 4 normalized motor speeds in [−1, 1] per drone |
/// | Reward | + 10 for a capture, − 0.1·(distance to the next waypoint), − 0.01·‖ω‖, − 100 for a crash |
/// | Reward after the last capture | − 100 for a crash |
/// | Reward terms | `capture`, `distance`, `angular_velocity`, `crash` |
/// | Terminated | crash (tilt > 90°, contact, z < 0), or every drone has captured all waypoints |
/// | Truncated | after 20 s |
/// | Success, progress | all waypoints captured; captured share |
///
/// | Observation, per drone | | Unit, frame |
/// | --- | --- | --- |
/// | 0–11 | position, roll-pitch-yaw, velocity, angular velocity | as in [`Hover`](super::Hover) |
/// | 12–14 | next waypoint (the last one after the end of the list) | m, world |
/// | 15–17 | next waypoint relative to the drone | m, body |
///
/// ```
/// use aviary::env::{DroneEnv, Env};
/// use aviary::tasks::FlyThrough;
///
/// let mut env = FlyThrough::builder().build()?;
/// let seen = &env.reset(Some(1))?.vector;
/// assert_eq!(seen[12..15], [0.0, 0.0, 1.0], "the first waypoint");
/// assert!(env.plan(0).is_some(), "the path through all waypoints, for a controller");
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Clone, serde::Serialize, serde::Deserialize)]
pub struct FlyThrough {
    /// Waypoints, world frame, m.
    pub waypoints: Vec<[f64; 3]>,
    /// Distance within which a waypoint is captured, m; default 0.1.
    pub radius: f64,
    /// Reward for a capture; default 10.
    pub capture_reward: f64,
    /// Penalty per control step and m of distance from the waypoint; default 0.1.
    pub distance_penalty: f64,
    /// Conditions under which a drone crashes.
    pub crash: CrashConditions,
    progress: WaypointProgress,
    watch: CrashWatch,
}

impl Default for FlyThrough {
    fn default() -> Self {
        Self {
            waypoints: vec![[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [1.0, 1.0, 1.5], [0.0, 1.0, 1.0], [0.0, 0.0, 0.5]],
            radius: 0.1,
            capture_reward: 10.0,
            distance_penalty: 0.1,
            crash: CrashConditions::with_max_tilt(FRAC_PI_2),
            progress: WaypointProgress::default(),
            watch: CrashWatch::default(),
        }
    }
}

impl FlyThrough {
    /// Creates a builder for the environment of this task.
    pub fn builder() -> AviaryBuilder<Self> {
        AviaryBuilder::new(Self::default())
    }

    /// Returns the number of waypoints that a drone has captured in this episode; 0 before the first reset.
    pub fn captured(&self, drone: usize) -> usize {
        self.progress.passed(drone)
    }

    fn target(&self, drone: usize) -> Vector3<f64> {
        let last = self.waypoints.len() - 1;
        self.waypoints[self.progress.passed(drone).min(last)].into()
    }

    /// Returns the terms of a drone's reward, or their sum.
    fn terms<T: RewardTerms<f64>>(&self, simulation: SimView<'_>, drone: usize, end: Option<EndReason>) -> T {
        if !self.progress.was_flying(drone) {
            return with_crash(fly_through::no_terms(), end);
        }
        let capture = if self.progress.just_passed(drone) { self.capture_reward } else { 0.0 };
        let rate = simulation.states()[drone].angular_velocity.to_flight();
        with_crash(fly_through::terms(capture, self.distance_penalty, self.progress.distance(drone), rate), end)
    }
}

impl Task for FlyThrough {
    fn name(&self) -> &'static str {
        "fly_through"
    }

    fn defaults(&self) -> TaskDefaults {
        TaskDefaults { num_drones: 1, episode_seconds: 20.0, controller: ControllerKind::Geometric }
    }

    fn set_options(&mut self, options: &TaskOptions) -> Result<(), EnvError> {
        options.check(self.name(), &["waypoints"])?;
        if let Some(waypoints) = &options.waypoints {
            self.waypoints.clone_from(waypoints);
        }
        Ok(())
    }

    fn options(&self) -> TaskOptions {
        TaskOptions { waypoints: Some(self.waypoints.clone()), ..TaskOptions::default() }
    }

    fn initial_positions(&self, drones: &[DroneParams]) -> Vec<[f64; 3]> {
        row_along_y(drones)
    }

    fn observation_space(&self) -> BoxSpace {
        BoxSpace::new(STATE_BOUNDS.into_iter().chain([UNBOUNDED; 6]))
    }

    fn validate(&self, _drones: &[DroneParams]) -> Result<(), EnvError> {
        self.crash.validate()?;
        waypoint_progress::validate("waypoints", &self.waypoints, 1, self.radius)?;
        waypoint_progress::validate_rewards([
            ("capture_reward", self.capture_reward),
            ("distance_penalty", self.distance_penalty),
        ])
    }

    fn markers(&self) -> Vec<Marker> {
        let marker = |(index, point): (usize, &[f64; 3])| Marker {
            name: format!("waypoint{index}"),
            body: Obstacle {
                rgba: [1.0, 0.55, 0.1, 1.0],
                ..Obstacle::new(Shape::Sphere { radius: 0.03 }, (*point).into())
            },
        };
        self.waypoints.iter().enumerate().map(marker).collect()
    }

    fn reset(&mut self, simulation: SimView<'_>, _rng: &mut Rng) {
        self.watch.reset(simulation);
        self.progress.reset(simulation);
    }

    fn update(&mut self, simulation: SimView<'_>) {
        self.watch.update(&self.crash, simulation);
        self.progress.update(simulation, &self.waypoints, 1, self.radius);
    }

    fn end(&self, simulation: SimView<'_>, drone: usize) -> Option<EndReason> {
        self.watch.end(drone).or(self.success(simulation, drone).then_some(EndReason::Completed))
    }

    fn reward(&self, simulation: SimView<'_>, drone: usize, end: Option<EndReason>) -> f64 {
        self.terms(simulation, drone, end)
    }

    fn reward_terms(&self, simulation: SimView<'_>, drone: usize, end: Option<EndReason>) -> Vec<(&'static str, f64)> {
        self.terms(simulation, drone, end)
    }

    fn observe(&self, simulation: SimView<'_>, drone: usize, out: &mut [f64]) {
        let (state, rpy) = observed(simulation, drone);
        fly_through::observe(&state, rpy, self.target(drone).to_flight(), out);
    }

    fn success(&self, _simulation: SimView<'_>, drone: usize) -> bool {
        self.watch.end(drone).is_none() && self.progress.passed(drone) == self.waypoints.len()
    }

    fn progress(&self, _simulation: SimView<'_>, drone: usize) -> f64 {
        self.progress.passed(drone) as f64 / self.waypoints.len() as f64
    }

    fn reference(&self, simulation: SimView<'_>, drone: usize) -> Reference {
        Reference::hover(self.target(drone), simulation.initial_states()[drone].yaw())
    }

    fn plan(&self, simulation: SimView<'_>, drone: usize) -> Option<Box<dyn Trajectory>> {
        self.plans(simulation).swap_remove(drone)
    }

    fn plans(&self, simulation: SimView<'_>) -> Vec<Option<Box<dyn Trajectory>>> {
        self.progress.plans(simulation, &self.waypoints, 1)
    }

    fn extent(&self, simulation: SimView<'_>, drone: usize, _seconds: f64) -> Vec<Vector3<f64>> {
        self.progress.extent(simulation, drone, &self.waypoints, 1)
    }

    fn metrics(&self, simulation: SimView<'_>, report: &mut dyn FnMut(&'static str, f64)) {
        let captured = (0..simulation.num_drones()).map(|drone| self.captured(drone));
        report("waypoints_captured", captured.sum::<usize>() as f64);
    }

    fn may_be_constant(&self, entry: usize) -> bool {
        // the next waypoint in the world frame stays constant until it is captured
        (12..15).contains(&entry)
    }

    fn lane_functions() -> Option<LaneFunctions<Self>> {
        Some(LaneFunctions::of())
    }

    super::saved_by_serde!();
}

impl FlyThrough {
    /// First row of the options.
    const OPTIONS: usize = CrashWatch::ROWS + WaypointProgress::ROWS;
}

/// The rows of a drone are those of [`CrashWatch`] and of [`WaypointProgress`], and the penalty for the distance.
impl LaneTask for FlyThrough {
    const ROWS: usize = Self::OPTIONS + 1;
    const OBSERVES_ATTITUDE: bool = true;

    fn write_rows(&self, simulation: SimView<'_>, drone: usize, rows: &mut [f64]) {
        let (watch, own) = rows.split_at_mut(CrashWatch::ROWS);
        self.watch.write_rows(&self.crash, simulation, drone, watch);
        let (progress, options) = own.split_at_mut(WaypointProgress::ROWS);
        self.progress.write_rows(drone, &self.waypoints, 1, self.radius, &self.target(drone), progress);
        options[0] = self.distance_penalty;
    }

    fn read_rows(&mut self, drone: usize, rows: &[f64]) {
        self.watch.read_rows(drone, &rows[..CrashWatch::ROWS]);
        self.progress.read_rows(drone, &rows[CrashWatch::ROWS..Self::OPTIONS]);
    }

    #[inline(always)]
    fn evaluate<S: Simd>(scene: &LaneScene<'_, S>, drone: usize, rows: &mut TaskRows<'_, S>) -> (Pack<S>, Pack<S>) {
        let (state, mut own) = (scene.state(drone), rows.drone(drone));
        let crashed = CrashWatch::update_rows(&state, &mut own);
        let (distance, flying, event) = WaypointProgress::evaluate_rows(state.position, &own, CrashWatch::ROWS);
        let zero = distance.all(0.0);
        let reward = fly_through::reward(zero, own.get(Self::OPTIONS), distance, state.rate);
        (Real::choose(flying, reward, -zero), crashed.greater(event))
    }

    #[inline(always)]
    fn complete<S: Simd>(scene: &LaneScene<'_, S>, rows: &mut TaskRows<'_, S>, completed: LaneMask<S>) {
        WaypointProgress::complete_rows(scene, rows, CrashWatch::ROWS, completed);
    }

    #[inline(always)]
    fn observe_lanes<S: Simd>(
        scene: &LaneScene<'_, S>,
        drone: usize,
        rows: &mut TaskRows<'_, S>,
        out: &mut LaneRows<'_, S>,
    ) {
        let (state, own) = (scene.state(drone), rows.drone(drone));
        let target = WaypointProgress::point_in_lanes(&own, CrashWatch::ROWS);
        fly_through::observe(&state, scene.rpy(drone), target, out);
    }
}
