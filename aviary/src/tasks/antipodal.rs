use std::f64::consts::{FRAC_PI_2, TAU};

use flight::tasks::{RewardTerms, antipodal};
use nalgebra::Vector3;
use pulp::Simd;

use super::conditions::{CrashConditions, CrashWatch, with_crash};
use super::{STATE_BOUNDS, UNBOUNDED, observed};
use crate::control::{ControllerKind, Reference};
use crate::drone::DroneParams;
use crate::env::{
    AviaryBuilder, BoxSpace, EndReason, EnvError, LaneFunctions, LaneRows, LaneScene, LaneTask, Rng, Task,
    TaskDefaults, TaskRows,
};
use crate::math::{Pack, Real, ToFlight as _};
use crate::simulation::SimView;

/// Task: drones on a circle swap places with the opposite drones at a safe distance from each other (the benchmark
/// of the paper's multi-agent figure).
///
/// | | |
/// | --- | --- |
/// | Start | twelve drones, evenly spaced on a circle of radius 2 m, heights alternating between 1 and 1.02 m |
/// | Goal | opposite point of the circle, at the drone's own height |
/// | Action | 4 normalized motor speeds in [−1, 1] per drone |
/// | Reward, per drone | − 0.1·(distance to the goal), + 0.5 within 10 cm of it |
/// | Penalty, per drone | − 1 for each drone closer than the safety radius, − 100 for a crash |
/// | Reward terms | `distance`, `at_goal`, `too_close`, `crash` |
/// | Terminated | a drone crashes |
/// | Truncated | after 20 s |
/// | Success | every drone within 10 cm of its goal, and no two drones ever closer than the safety radius |
///
/// The heights alternate because the published downwash is singular at equal heights. The task is intended for velocity
/// actions with a [`SafetyWrapper`](crate::wrappers::SafetyWrapper).
///
/// | Observation, per drone | | Unit, frame |
/// | --- | --- | --- |
/// | 0–11 | position, roll-pitch-yaw, velocity, angular velocity | as in [`Hover`](super::Hover) |
/// | 12–14 | goal | m, world |
/// | 15–17 | goal minus position | m, world |
///
/// ```
/// use aviary::env::Env;
/// use aviary::tasks::Antipodal;
///
/// let mut env = Antipodal::builder().num_drones(4).build()?;
/// let seen = &env.reset(Some(1))?.vector;
/// assert_eq!(seen[12..15], [-2.0, 0.0, 1.0], "the goal of the drone that starts at (2, 0, 1)");
/// env.step(&[0.0; 16])?;
/// assert!((env.task().minimum_distance() - 8_f64.sqrt()).abs() < 1e-2);
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Clone, serde::Serialize, serde::Deserialize)]
pub struct Antipodal {
    /// Radius of the circle, m; default 2.
    pub radius: f64,
    /// Height of the circle, m; default 1.
    pub height: f64,
    /// Additional height of every other drone, m; default 0.02.
    pub stagger: f64,
    /// Minimum distance between the centres of two drones, m; default 0.3.
    pub safety_radius: f64,
    /// Conditions under which a drone crashes.
    pub crash: CrashConditions,
    watch: CrashWatch,
    /// Smallest distance between two drones so far, m.
    #[serde(with = "crate::serial::extended")]
    nearest: f64,
}

impl Default for Antipodal {
    fn default() -> Self {
        Self {
            radius: 2.0,
            height: 1.0,
            stagger: 0.02,
            safety_radius: 0.3,
            crash: CrashConditions::with_max_tilt(FRAC_PI_2),
            watch: CrashWatch::default(),
            nearest: f64::INFINITY,
        }
    }
}

impl Antipodal {
    /// Distance within which a drone is at its goal, m.
    pub const AT_GOAL: f64 = antipodal::AT_GOAL;

    /// Creates a builder for the environment of this task.
    pub fn builder() -> AviaryBuilder<Self> {
        AviaryBuilder::new(Self::default())
    }

    fn place(&self, drone: usize, count: usize) -> Vector3<f64> {
        let (sin, cos) = (TAU * drone as f64 / count as f64).sin_cos();
        let height = self.height + self.stagger * (drone % 2) as f64;
        Vector3::new(self.radius * cos, self.radius * sin, height)
    }

    /// Returns the goal of one of `count` drones, world frame, m.
    pub fn goal_of(&self, drone: usize, count: usize) -> Vector3<f64> {
        let place = self.place(drone, count);
        Vector3::new(-place.x, -place.y, place.z)
    }

    fn goal(&self, simulation: SimView<'_>, drone: usize) -> Vector3<f64> {
        self.goal_of(drone, simulation.num_drones())
    }

    /// Returns the smallest distance between the centres of two drones in this episode so far, m; infinite for a
    /// single drone.
    pub fn minimum_distance(&self) -> f64 {
        self.nearest
    }

    fn at_goal(&self, simulation: SimView<'_>, drone: usize) -> bool {
        simulation.distance(drone, &self.goal(simulation, drone)) < Self::AT_GOAL
    }

    /// Returns the terms of a drone's reward, or their sum.
    fn terms<T: RewardTerms<f64>>(&self, simulation: SimView<'_>, drone: usize, end: Option<EndReason>) -> T {
        let here = simulation.states()[drone].position;
        let close = |other: &usize| *other != drone && simulation.distance(*other, &here) < self.safety_radius;
        let close = (0..simulation.num_drones()).filter(close).count() as f64;
        let distance = simulation.distance(drone, &self.goal(simulation, drone));
        with_crash(antipodal::terms(distance, close), end)
    }
}

impl Task for Antipodal {
    fn name(&self) -> &'static str {
        "antipodal"
    }

    fn defaults(&self) -> TaskDefaults {
        TaskDefaults { num_drones: 12, episode_seconds: 20.0, controller: ControllerKind::Geometric }
    }

    fn initial_positions(&self, drones: &[DroneParams]) -> Vec<[f64; 3]> {
        (0..drones.len()).map(|drone| self.place(drone, drones.len()).into()).collect()
    }

    fn observation_space(&self) -> BoxSpace {
        BoxSpace::new(STATE_BOUNDS.into_iter().chain([UNBOUNDED; 6]))
    }

    fn validate(&self, drones: &[DroneParams]) -> Result<(), EnvError> {
        self.crash.validate()?;
        for (option, got) in [("radius", self.radius), ("height", self.height), ("safety_radius", self.safety_radius)] {
            if !(got > 0.0 && got <= 1e3) {
                let expected = "a positive number of metres up to 1000";
                return Err(EnvError::Option { option, got: format!("{} m", crate::number(got)), expected });
            }
        }
        if !(0.0..=1e3).contains(&self.stagger) {
            let expected = "zero or a positive number of metres";
            let got = format!("{} m", crate::number(self.stagger));
            return Err(EnvError::Option { option: "stagger", got, expected });
        }
        let apart = 2.0 * self.radius * (TAU / (2.0 * drones.len() as f64)).sin();
        if drones.len() > 1 && apart <= self.safety_radius {
            return Err(EnvError::Option {
                option: "radius",
                got: format!(
                    "{} m, with {} {apart:.3} m apart",
                    crate::number(self.radius),
                    crate::count(drones.len(), "drone")
                ),
                expected: "a distance above safety_radius",
            });
        }
        Ok(())
    }

    fn reset(&mut self, simulation: SimView<'_>, _rng: &mut Rng) {
        self.watch.reset(simulation);
        self.nearest = f64::INFINITY;
    }

    fn update(&mut self, simulation: SimView<'_>) {
        self.watch.update(&self.crash, simulation);
        let states = simulation.states();
        for (i, a) in states.iter().enumerate() {
            for b in &states[..i] {
                self.nearest = self.nearest.min((a.position - b.position).norm());
            }
        }
    }

    fn end(&self, _simulation: SimView<'_>, drone: usize) -> Option<EndReason> {
        self.watch.end(drone)
    }

    fn reward(&self, simulation: SimView<'_>, drone: usize, end: Option<EndReason>) -> f64 {
        self.terms(simulation, drone, end)
    }

    fn reward_terms(&self, simulation: SimView<'_>, drone: usize, end: Option<EndReason>) -> Vec<(&'static str, f64)> {
        self.terms(simulation, drone, end)
    }

    fn observe(&self, simulation: SimView<'_>, drone: usize, out: &mut [f64]) {
        let (state, rpy) = observed(simulation, drone);
        antipodal::observe(&state, rpy, self.goal(simulation, drone).to_flight(), out);
    }

    fn success(&self, simulation: SimView<'_>, drone: usize) -> bool {
        self.watch.end(drone).is_none() && self.nearest >= self.safety_radius && self.at_goal(simulation, drone)
    }

    fn reference(&self, simulation: SimView<'_>, drone: usize) -> Reference {
        Reference::hover(self.goal(simulation, drone), simulation.initial_states()[drone].yaw())
    }

    fn metrics(&self, _simulation: SimView<'_>, report: &mut dyn FnMut(&'static str, f64)) {
        if self.nearest.is_finite() {
            report("minimum_distance", self.nearest);
        }
    }

    fn may_be_constant(&self, entry: usize) -> bool {
        (12..15).contains(&entry)
    }

    fn lane_functions() -> Option<LaneFunctions<Self>> {
        Some(LaneFunctions::of())
    }

    super::saved_by_serde!();
}

/// The rows of a drone are those of [`CrashWatch`], the goal, the safety radius, the number of drones that are too
/// close, and the smallest distance between two drones so far, which only the first drone uses.
impl LaneTask for Antipodal {
    const ROWS: usize = CrashWatch::ROWS + 6;
    const OBSERVES_ATTITUDE: bool = false;

    fn write_rows(&self, simulation: SimView<'_>, drone: usize, rows: &mut [f64]) {
        let (watch, own) = rows.split_at_mut(CrashWatch::ROWS);
        self.watch.write_rows(&self.crash, simulation, drone, watch);
        let goal = self.goal(simulation, drone);
        own.copy_from_slice(&[goal.x, goal.y, goal.z, self.safety_radius, 0.0, self.nearest]);
    }

    fn read_rows(&mut self, drone: usize, rows: &[f64]) {
        self.watch.read_rows(drone, &rows[..CrashWatch::ROWS]);
        if drone == 0 {
            self.nearest = rows[Self::NEAREST];
        }
    }

    #[inline(always)]
    fn evaluate<S: Simd>(scene: &LaneScene<'_, S>, drone: usize, rows: &mut TaskRows<'_, S>) -> (Pack<S>, Pack<S>) {
        if drone == 0 {
            Self::compare_pairs(scene, rows);
        }
        let (state, mut own) = (scene.state(drone), rows.drone(drone));
        let crashed = CrashWatch::update_rows(&state, &mut own);
        let distance = (state.position - own.get3(CrashWatch::ROWS)).norm();
        (antipodal::reward(distance, own.get(Self::CLOSE)), crashed)
    }

    #[inline(always)]
    fn observe_lanes<S: Simd>(
        scene: &LaneScene<'_, S>,
        drone: usize,
        rows: &mut TaskRows<'_, S>,
        out: &mut LaneRows<'_, S>,
    ) {
        let goal = rows.drone(drone).get3(CrashWatch::ROWS);
        antipodal::observe(&scene.state(drone), scene.rpy(drone), goal, out);
    }
}

impl Antipodal {
    /// Row of the number of drones that are too close.
    const CLOSE: usize = CrashWatch::ROWS + 4;

    /// Row of the smallest distance between two drones.
    const NEAREST: usize = CrashWatch::ROWS + 5;

    /// Counts the drones that are too close to every drone, and updates the smallest distance between two drones. A
    /// second evaluation of the same step has the same result.
    #[inline(always)]
    fn compare_pairs<S: Simd>(scene: &LaneScene<'_, S>, rows: &mut TaskRows<'_, S>) {
        let (mut nearest, safety_radius) = (rows.drone(0).get(Self::NEAREST), rows.drone(0).get(CrashWatch::ROWS + 3));
        let (zero, one) = (nearest.all(0.0), nearest.all(1.0));
        for i in 0..scene.num_drones() {
            let here = scene.position(i);
            let mut count = zero;
            for j in 0..i {
                let distance = (here - scene.position(j)).norm();
                let close = Real::choose(distance.less(safety_radius), one, zero);
                count = count + close;
                let mut other = rows.drone(j);
                let sum = other.get(Self::CLOSE) + close;
                other.put(Self::CLOSE, sum);
                nearest = distance.lesser(nearest);
            }
            rows.drone(i).put(Self::CLOSE, count);
        }
        rows.drone(0).put(Self::NEAREST, nearest);
    }
}
