use std::f64::consts::{FRAC_PI_2, TAU};

use flight::tasks::RewardTerms;
use flight::tasks::formation::{self, Side};
use nalgebra::Vector3;
use pulp::Simd;

use super::conditions::{CrashConditions, CrashWatch, with_crash};
use super::{STATE_BOUNDS, UNBOUNDED, observed};
use crate::control::{ControllerKind, Reference};
use crate::drone::DroneParams;
use crate::env::{
    AviaryBuilder, BoxSpace, EndReason, EnvError, LaneFunctions, LaneMask, LaneRows, LaneScene, LaneTask, Rng, Task,
    TaskDefaults, TaskRows, path_points,
};
use crate::math::{Pack, Real, ToFlight as _, ToNalgebra as _, V3};
use crate::simulation::SimView;

/// Task: drones keep a formation whose centre moves along a closed path (paper, §4.1 `FormationAviary`).
///
/// | | |
/// | --- | --- |
/// | Formation | three drones, evenly spaced on a circle of radius 0.3 m |
/// | Start | in formation around the first corner of the path |
/// | Path of the centre | (0, 0, 1), (1, 0, 1), (1, 1, 1.2), (0, 1, 1) m and back, at 0.048 m/s |
/// | Action | 4 normalized motor speeds in [−1, 1] per drone |
/// | Reward | − Σ_i ‖p_i − slot_i‖ − 0.5·Σ_{i<j} \|d_ij − desired d_ij\|, − 100 for each crash |
/// | Reward terms | `slot_error`, `distance_errors`, `crash` |
/// | Terminated | a drone crashes |
/// | Truncated | after 30 s |
/// | Success | mean distance of the drones from their slots over the episode below 5 cm |
///
/// | Observation, per drone | | Unit, frame |
/// | --- | --- | --- |
/// | 0–11 | position, roll-pitch-yaw, velocity, angular velocity | as in [`Hover`](super::Hover) |
/// | 12–14 | the drone's slot | m, world |
/// | 15–17 | slot minus position | m, world |
///
/// ```
/// use aviary::env::Env;
/// use aviary::tasks::Formation;
///
/// let mut env = Formation::builder().build()?;
/// let seen = &env.reset(Some(1))?.vector;
/// assert!((0..3).all(|drone| seen[18 * drone + 15..][..3].iter().all(|x| x.abs() < 1e-12)), "all in their slots");
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Clone, serde::Serialize, serde::Deserialize)]
pub struct Formation {
    /// Radius of the circle, m; default 0.3.
    pub radius: f64,
    /// Slots relative to the centre, world frame, m, one per drone; default the circle.
    pub offsets: Option<Vec<[f64; 3]>>,
    /// Corners of the closed path of the centre, world frame, m.
    pub path: Vec<[f64; 3]>,
    /// Speed of the centre, m/s; default 0.048.
    pub speed: f64,
    /// Conditions under which a drone crashes.
    pub crash: CrashConditions,
    watch: CrashWatch,
    /// Sum of the distances from the slots over drones and control steps, m, and the number of summands.
    errors: (f64, f64),
}

impl Default for Formation {
    fn default() -> Self {
        Self {
            radius: 0.3,
            offsets: None,
            path: vec![[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [1.0, 1.0, 1.2], [0.0, 1.0, 1.0]],
            speed: 0.048,
            crash: CrashConditions::with_max_tilt(FRAC_PI_2),
            watch: CrashWatch::default(),
            errors: (0.0, 0.0),
        }
    }
}

impl Formation {
    /// Mean distance from the slots below which the task succeeds, m.
    pub const KEPT: f64 = 0.05;

    /// Length of the path below which the centre stands still, m.
    pub const MIN_LAP: f64 = 1e-6;

    /// Distance from the start of a side within which the lanes leave the step to the scalar task, m.
    const MARGIN: f64 = 1e-6;

    /// Creates a builder for the environment of this task.
    pub fn builder() -> AviaryBuilder<Self> {
        AviaryBuilder::new(Self::default())
    }

    /// Returns the slot of one of `count` drones relative to the centre, world frame, m.
    ///
    /// # Panics
    /// If [`offsets`](Self::offsets) has fewer slots.
    pub fn offset(&self, drone: usize, count: usize) -> Vector3<f64> {
        match &self.offsets {
            Some(offsets) => offsets[drone].into(),
            None => {
                let (sin, cos) = (TAU * drone as f64 / count as f64).sin_cos();
                Vector3::new(cos, sin, 0.0) * self.radius
            }
        }
    }

    /// Returns the side of the path on which the centre is after a distance, m.
    fn side(&self, distance: f64) -> Side<f64> {
        let sides = self.path.iter().zip(self.path.iter().cycle().skip(1));
        let sides = sides.map(|(from, to)| (Vector3::from(*from), Vector3::from(*to)));
        let lap: f64 = sides.clone().map(|(from, to)| (to - from).norm()).sum();
        let stand = Side { from: Vector3::from(self.path[0]).to_flight(), ..Side::STAND };
        if lap < Self::MIN_LAP {
            return stand;
        }
        let mut side = Side { lap, low: f64::NEG_INFINITY, high: 0.0, ..stand };
        for (from, to) in sides {
            let length = (to - from).norm();
            if side.travelled(distance) < length {
                return Side {
                    high: length,
                    from: from.to_flight(),
                    direction: ((to - from) / length).to_flight(),
                    ..side
                };
            }
            (side.start, side.low) = (side.start + length, Self::MARGIN);
        }
        // rounding at the end of a lap
        Side { start: 0.0, high: 0.0, ..side }
    }

    /// Returns the position and the velocity of the centre at a time.
    fn centre(&self, time: f64) -> (Vector3<f64>, Vector3<f64>) {
        let distance = self.speed * time;
        let side = self.side(distance);
        (side.point(distance).to_nalgebra(), side.direction.to_nalgebra() * self.speed)
    }

    fn slot(&self, simulation: SimView<'_>, drone: usize) -> Vector3<f64> {
        self.centre(simulation.time()).0 + self.offset(drone, simulation.num_drones())
    }

    /// Returns the mean distance of the drones from their slots over the episode so far, m.
    pub fn mean_error(&self) -> f64 {
        self.errors.0 / self.errors.1.max(1.0)
    }

    /// Returns the terms of a drone's reward, or their sum.
    fn terms<T: RewardTerms<f64>>(&self, simulation: SimView<'_>, drone: usize, end: Option<EndReason>) -> T {
        let (states, count) = (simulation.states(), simulation.num_drones());
        let (here, own) = (states[drone].position, self.offset(drone, count));
        let deviations = (0..count).filter(|&other| other != drone).fold(0.0, |sum, other| {
            let (apart, desired) = (states[other].position - here, self.offset(other, count) - own);
            sum + formation::deviation(apart.to_flight(), desired.to_flight())
        });
        let error = simulation.distance(drone, &self.slot(simulation, drone));
        with_crash(formation::terms(error, deviations), end)
    }
}

impl Task for Formation {
    fn name(&self) -> &'static str {
        "formation"
    }

    fn defaults(&self) -> TaskDefaults {
        TaskDefaults { num_drones: 3, episode_seconds: 30.0, controller: ControllerKind::Dsl }
    }

    fn initial_positions(&self, drones: &[DroneParams]) -> Vec<[f64; 3]> {
        let (centre, _) = self.centre(0.0);
        (0..drones.len()).map(|drone| (centre + self.offset(drone, drones.len())).into()).collect()
    }

    fn observation_space(&self) -> BoxSpace {
        BoxSpace::new(STATE_BOUNDS.into_iter().chain([UNBOUNDED; 6]))
    }

    fn validate(&self, drones: &[DroneParams]) -> Result<(), EnvError> {
        self.crash.validate()?;
        let wrong = |option, got: String, expected| Err(EnvError::Option { option, got, expected });
        if self.path.is_empty() || self.path.iter().flatten().any(|x| !(-1e4..=1e4).contains(x)) {
            return wrong(
                "path",
                format!("{:?}", self.path),
                "at least one corner, and finite coordinates up to 10 km",
            );
        }
        if !(0.0..=1e3).contains(&self.speed) {
            return wrong("speed", format!("{} m/s", crate::number(self.speed)), "zero or a positive number");
        }
        if let Some(offsets) = &self.offsets {
            if offsets.len() != drones.len() {
                return wrong("offsets", crate::count(offsets.len(), "slot"), "one per drone");
            }
        } else if !(self.radius >= 0.0 && self.radius <= 1e3) {
            return wrong("radius", format!("{} m", crate::number(self.radius)), "zero or a positive number of metres");
        }
        if let Some(x) = self.offsets.iter().flatten().flatten().find(|x| !(-1e4..=1e4).contains(*x)) {
            return wrong(
                "offsets",
                format!("{} m along an axis", crate::number(*x)),
                "finite coordinates up to 10 km",
            );
        }
        let slots: Vec<_> = (0..drones.len()).map(|drone| self.offset(drone, drones.len())).collect();
        for (i, (a, first)) in slots.iter().zip(drones).enumerate() {
            for (b, second) in slots[..i].iter().zip(drones) {
                let apart = (a - b).norm();
                let min = first.collision_radius + second.collision_radius;
                if apart.is_nan() || apart <= min {
                    let (option, value) = match &self.offsets {
                        Some(offsets) => ("offsets", format!("{offsets:?}")),
                        None => ("radius", format!("{} m", crate::number(self.radius))),
                    };
                    let got = format!("{value}, with slots {apart:.3} m apart for drones of {min:.3} m");
                    return wrong(option, got, "slots that do not overlap");
                }
            }
        }
        Ok(())
    }

    fn reset(&mut self, simulation: SimView<'_>, _rng: &mut Rng) {
        self.watch.reset(simulation);
        self.errors = (0.0, 0.0);
    }

    fn update(&mut self, simulation: SimView<'_>) {
        self.watch.update(&self.crash, simulation);
        for drone in 0..simulation.num_drones() {
            self.errors.0 += simulation.distance(drone, &self.slot(simulation, drone));
            self.errors.1 += 1.0;
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
        formation::observe(&state, rpy, self.slot(simulation, drone).to_flight(), out);
    }

    fn success(&self, simulation: SimView<'_>, drone: usize) -> bool {
        self.watch.end(drone).is_none() && simulation.control_steps() > 0 && self.mean_error() < Self::KEPT
    }

    fn reference(&self, simulation: SimView<'_>, drone: usize) -> Reference {
        let (centre, velocity) = self.centre(simulation.time());
        let slot = centre + self.offset(drone, simulation.num_drones());
        Reference { velocity, ..Reference::hover(slot, simulation.initial_states()[drone].yaw()) }
    }

    fn extent(&self, simulation: SimView<'_>, drone: usize, seconds: f64) -> Vec<Vector3<f64>> {
        let offset = self.offset(drone, simulation.num_drones());
        path_points(seconds, |time| self.centre(time).0 + offset).collect()
    }

    fn metrics(&self, _simulation: SimView<'_>, report: &mut dyn FnMut(&'static str, f64)) {
        report("mean_formation_error", self.mean_error());
    }

    fn may_be_constant(&self, entry: usize) -> bool {
        // the slot is constant for a path of one point, and its height for a level path
        (12..15).contains(&entry)
    }

    fn lane_functions() -> Option<LaneFunctions<Self>> {
        Some(LaneFunctions::of())
    }

    super::saved_by_serde!();
}

/// Returns the numbers of a side in the rows of a drone.
fn numbers(side: &Side<f64>) -> [f64; 10] {
    let Side { lap, start, low, high, from, direction } = *side;
    [lap, start, low, high, from.x, from.y, from.z, direction.x, direction.y, direction.z]
}

impl Formation {
    /// Row of the slot relative to the centre.
    const OFFSET: usize = CrashWatch::ROWS;

    /// Row of the sum of the distances from the slots, and of the number of summands. Only the first drone uses them.
    const ERRORS: usize = Self::OFFSET + 3;

    /// Row of the speed of the centre, and of its side of the path.
    const CENTRE: usize = Self::ERRORS + 2;

    /// Returns the distance that the centre has travelled, m, and its side of the path.
    #[inline(always)]
    fn side_in_lanes<S: Simd>(scene: &LaneScene<'_, S>, rows: &mut TaskRows<'_, S>) -> (Pack<S>, Side<Pack<S>>) {
        let first = rows.drone(0);
        let row = |index| first.get(Self::CENTRE + index);
        let (from, direction) = (first.get3(Self::CENTRE + 5), first.get3(Self::CENTRE + 8));
        let side = Side { lap: row(1), start: row(2), low: row(3), high: row(4), from, direction };
        (row(0) * scene.time(), side)
    }

    /// Returns the slot of a drone, world frame, m.
    #[inline(always)]
    fn slot_in_lanes<S: Simd>(scene: &LaneScene<'_, S>, drone: usize, rows: &mut TaskRows<'_, S>) -> V3<Pack<S>> {
        let (distance, side) = Self::side_in_lanes(scene, rows);
        side.point(distance) + rows.drone(drone).get3(Self::OFFSET)
    }
}

/// The rows of a drone are those of [`CrashWatch`], its slot relative to the centre, the sum and the number of errors,
/// the speed of the centre, and its side of the path.
impl LaneTask for Formation {
    const ROWS: usize = Self::CENTRE + 11;
    const OBSERVES_ATTITUDE: bool = false;

    fn write_rows(&self, simulation: SimView<'_>, drone: usize, rows: &mut [f64]) {
        self.watch.write_rows(&self.crash, simulation, drone, &mut rows[..CrashWatch::ROWS]);
        rows[Self::OFFSET..Self::ERRORS].copy_from_slice(self.offset(drone, simulation.num_drones()).as_slice());
        rows[Self::ERRORS..Self::CENTRE].copy_from_slice(&[self.errors.0, self.errors.1]);
        rows[Self::CENTRE] = self.speed;
        rows[Self::CENTRE + 1..].copy_from_slice(&numbers(&self.side(self.speed * simulation.time())));
    }

    fn read_rows(&mut self, drone: usize, rows: &[f64]) {
        self.watch.read_rows(drone, &rows[..CrashWatch::ROWS]);
        if drone == 0 {
            self.errors = (rows[Self::ERRORS], rows[Self::ERRORS + 1]);
        }
    }

    #[inline(always)]
    fn evaluate<S: Simd>(scene: &LaneScene<'_, S>, drone: usize, rows: &mut TaskRows<'_, S>) -> (Pack<S>, Pack<S>) {
        let state = scene.state(drone);
        let mut event = CrashWatch::update_rows(&state, &mut rows.drone(drone));
        let (zero, one) = (event.all(0.0), event.all(1.0));
        if drone == 0 {
            // the scalar task finds the next side
            let (distance, side) = Self::side_in_lanes(scene, rows);
            let travelled = side.travelled(distance);
            let inside = side.low.less(travelled) & travelled.less(side.high);
            event = Real::choose(inside, event, one);
        }
        let own = rows.drone(drone).get3(Self::OFFSET);
        let mut deviations = zero;
        for other in 0..scene.num_drones() {
            if other == drone {
                continue;
            }
            let desired = rows.drone(other).get3(Self::OFFSET) - own;
            deviations = deviations + formation::deviation(scene.position(other) - state.position, desired);
        }
        let error = (state.position - Self::slot_in_lanes(scene, drone, rows)).norm();
        (formation::reward(error, deviations), event)
    }

    #[inline(always)]
    fn complete<S: Simd>(scene: &LaneScene<'_, S>, rows: &mut TaskRows<'_, S>, completed: LaneMask<S>) {
        let before = [0, 1].map(|index| rows.drone(0).get(Self::ERRORS + index));
        let [mut sum, mut count] = before;
        for drone in 0..scene.num_drones() {
            sum = sum + (scene.position(drone) - Self::slot_in_lanes(scene, drone, rows)).norm();
            count = count + 1.0;
        }
        let mut first = rows.drone(0);
        first.put(Self::ERRORS, Real::choose(completed, sum, before[0]));
        first.put(Self::ERRORS + 1, Real::choose(completed, count, before[1]));
    }

    #[inline(always)]
    fn observe_lanes<S: Simd>(
        scene: &LaneScene<'_, S>,
        drone: usize,
        rows: &mut TaskRows<'_, S>,
        out: &mut LaneRows<'_, S>,
    ) {
        let slot = Self::slot_in_lanes(scene, drone, rows);
        formation::observe(&scene.state(drone), scene.rpy(drone), slot, out);
    }
}
