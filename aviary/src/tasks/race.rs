use flight::tasks::{RewardTerms, race};
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

/// Task: a drone races two laps through six gates (paper, §4.1 `RaceAviary`).
///
/// | | |
/// | --- | --- |
/// | Start | (0, 0, 0.1) m; several drones in a row along −y |
/// | Gates | (1, 0, 1), (2, 1, 1.2), (1, 2, 1.5), (0, 2, 1.3), (−1, 1, 1), (0, 0, 0.8) m |
/// | Gate passed | within 0.2 m of its centre |
/// | Action | 4 normalized motor speeds in [−1, 1] per drone |
/// | Reward | + 20 for a gate, + 2·‖v‖, − 0.05·(distance to the next gate), − 100 for a crash |
/// | Reward after the last gate | − 100 for a crash |
/// | Reward terms | `gate`, `speed`, `distance`, `crash` |
/// | Terminated | crash (tilt > 2 rad, contact, z < 0), or every drone has completed two laps |
/// | Truncated | after 30 s |
/// | Success, progress | two laps; share of gates passed |
///
/// The frames of the gates are visible and do not collide.
///
/// | Observation, per drone | | Unit, frame |
/// | --- | --- | --- |
/// | 0–11 | position, roll-pitch-yaw, velocity, angular velocity | as in [`Hover`](super::Hover) |
/// | 12–14 | next gate (the first one after the last) | m, world |
/// | 15–17 | next gate relative to the drone | m, body |
/// | 18–20 | the gate after the next, relative to the drone | m, body |
///
/// ```
/// use aviary::drone::DroneModel;
/// use aviary::env::Env;
/// use aviary::tasks::Race;
///
/// let mut env = Race::builder().drone(DroneModel::Race).task(|race| race.laps = 1).build()?;
/// let seen = &env.reset(Some(1))?.vector;
/// assert_eq!(seen[12..15], [1.0, 0.0, 1.0], "the first gate");
/// assert!((seen[17] - 0.9).abs() < 1e-12, "which is higher than the drone");
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Clone, serde::Serialize, serde::Deserialize)]
pub struct Race {
    /// Centres of the gates, world frame, m.
    pub gates: Vec<[f64; 3]>,
    /// Distance from the centre within which a gate is passed, m; default 0.2.
    pub radius: f64,
    /// Number of laps; default 2.
    pub laps: usize,
    /// Reward for a gate; default 20.
    pub gate_reward: f64,
    /// Reward per control step and m/s; default 2.
    pub speed_reward: f64,
    /// Penalty per control step and m of distance from the gate; default 0.05.
    pub distance_penalty: f64,
    /// Conditions under which a drone crashes.
    pub crash: CrashConditions,
    progress: WaypointProgress,
    watch: CrashWatch,
}

impl Default for Race {
    fn default() -> Self {
        Self {
            gates: vec![
                [1.0, 0.0, 1.0],
                [2.0, 1.0, 1.2],
                [1.0, 2.0, 1.5],
                [0.0, 2.0, 1.3],
                [-1.0, 1.0, 1.0],
                [0.0, 0.0, 0.8],
            ],
            radius: 0.2,
            laps: 2,
            gate_reward: 20.0,
            speed_reward: 2.0,
            distance_penalty: 0.05,
            crash: CrashConditions::with_max_tilt(2.0),
            progress: WaypointProgress::default(),
            watch: CrashWatch::default(),
        }
    }
}

impl Race {
    /// Creates a builder for the environment of this task.
    pub fn builder() -> AviaryBuilder<Self> {
        AviaryBuilder::new(Self::default())
    }

    /// Returns the number of gates that a drone has passed in this episode, over all laps; 0 before the first
    /// reset.
    pub fn gates_passed(&self, drone: usize) -> usize {
        self.progress.passed(drone)
    }

    /// Returns the gate `ahead` places after the next one.
    fn gate(&self, drone: usize, ahead: usize) -> Vector3<f64> {
        self.gates[(self.progress.passed(drone) + ahead) % self.gates.len()].into()
    }

    /// Returns the terms of a drone's reward, or their sum.
    fn terms<T: RewardTerms<f64>>(&self, simulation: SimView<'_>, drone: usize, end: Option<EndReason>) -> T {
        if !self.progress.was_flying(drone) {
            return with_crash(race::no_terms(), end);
        }
        let gate = if self.progress.just_passed(drone) { self.gate_reward } else { 0.0 };
        let (velocity, distance) = (&simulation.states()[drone].velocity, self.progress.distance(drone));
        with_crash(race::terms(gate, [self.speed_reward, self.distance_penalty], velocity.to_flight(), distance), end)
    }
}

impl Task for Race {
    fn name(&self) -> &'static str {
        "race"
    }

    fn defaults(&self) -> TaskDefaults {
        TaskDefaults { num_drones: 1, episode_seconds: 30.0, controller: ControllerKind::Geometric }
    }

    fn set_options(&mut self, options: &TaskOptions) -> Result<(), EnvError> {
        options.check(self.name(), &["gates", "laps"])?;
        if let Some(gates) = &options.gates {
            self.gates.clone_from(gates);
        }
        self.laps = options.laps.unwrap_or(self.laps);
        Ok(())
    }

    fn options(&self) -> TaskOptions {
        TaskOptions { gates: Some(self.gates.clone()), laps: Some(self.laps), ..TaskOptions::default() }
    }

    fn initial_positions(&self, drones: &[DroneParams]) -> Vec<[f64; 3]> {
        row_along_y(drones)
    }

    fn observation_space(&self) -> BoxSpace {
        BoxSpace::new(STATE_BOUNDS.into_iter().chain([UNBOUNDED; 9]))
    }

    fn validate(&self, _drones: &[DroneParams]) -> Result<(), EnvError> {
        self.crash.validate()?;
        waypoint_progress::validate("gates", &self.gates, self.laps, self.radius)?;
        waypoint_progress::validate_rewards([
            ("gate_reward", self.gate_reward),
            ("speed_reward", self.speed_reward),
            ("distance_penalty", self.distance_penalty),
        ])
    }

    /// Returns square frames, perpendicular to the line from the previous gate to the next one.
    fn markers(&self) -> Vec<Marker> {
        const INSIDE: f64 = 0.25;
        const BAR: f64 = 0.015;
        let count = self.gates.len();
        let mut bars = Vec::new();
        for (index, &centre) in self.gates.iter().enumerate() {
            let (before, after) = (self.gates[(index + count - 1) % count], self.gates[(index + 1) % count]);
            let yaw = (after[1] - before[1]).atan2(after[0] - before[0]);
            let left = Vector3::new(-yaw.sin(), yaw.cos(), 0.0);
            let reach = INSIDE + BAR;
            for (side, offset, half_size) in [
                ("left", left * reach, [BAR, BAR, reach + BAR]),
                ("right", left * -reach, [BAR, BAR, reach + BAR]),
                ("top", Vector3::z() * reach, [BAR, reach - BAR, BAR]),
                ("bottom", Vector3::z() * -reach, [BAR, reach - BAR, BAR]),
            ] {
                let position = Vector3::from(centre) + offset;
                bars.push(Marker {
                    name: format!("gate{index}_{side}"),
                    body: Obstacle {
                        shape: Shape::Box { half_size },
                        position,
                        rpy: Vector3::new(0.0, 0.0, yaw),
                        rgba: if index == 0 { [0.1, 0.65, 0.35, 1.0] } else { [0.9, 0.35, 0.1, 1.0] },
                    },
                });
            }
        }
        bars
    }

    fn reset(&mut self, simulation: SimView<'_>, _rng: &mut Rng) {
        self.watch.reset(simulation);
        self.progress.reset(simulation);
    }

    fn update(&mut self, simulation: SimView<'_>) {
        self.watch.update(&self.crash, simulation);
        self.progress.update(simulation, &self.gates, self.laps, self.radius);
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
        race::observe(&state, rpy, [0, 1].map(|ahead| self.gate(drone, ahead).to_flight()), out);
    }

    fn success(&self, _simulation: SimView<'_>, drone: usize) -> bool {
        self.watch.end(drone).is_none() && self.progress.passed(drone) == self.gates.len() * self.laps
    }

    fn progress(&self, _simulation: SimView<'_>, drone: usize) -> f64 {
        self.progress.passed(drone) as f64 / (self.gates.len() * self.laps) as f64
    }

    fn reference(&self, simulation: SimView<'_>, drone: usize) -> Reference {
        // after the last gate, the drone may stay there
        let point = waypoint_progress::next(&self.gates, self.progress.passed(drone), self.laps);
        let last = self.gates[self.gates.len() - 1].into();
        Reference::hover(point.unwrap_or(last), simulation.initial_states()[drone].yaw())
    }

    fn plan(&self, simulation: SimView<'_>, drone: usize) -> Option<Box<dyn Trajectory>> {
        self.plans(simulation).swap_remove(drone)
    }

    fn plans(&self, simulation: SimView<'_>) -> Vec<Option<Box<dyn Trajectory>>> {
        self.progress.plans(simulation, &self.gates, self.laps)
    }

    fn extent(&self, simulation: SimView<'_>, drone: usize, _seconds: f64) -> Vec<Vector3<f64>> {
        self.progress.extent(simulation, drone, &self.gates, self.laps)
    }

    fn metrics(&self, simulation: SimView<'_>, report: &mut dyn FnMut(&'static str, f64)) {
        let passed: usize = (0..simulation.num_drones()).map(|drone| self.gates_passed(drone)).sum();
        report("gates_passed", passed as f64);
    }

    fn may_be_constant(&self, entry: usize) -> bool {
        (12..15).contains(&entry)
    }

    fn lane_functions() -> Option<LaneFunctions<Self>> {
        Some(LaneFunctions::of())
    }

    super::saved_by_serde!();
}

impl Race {
    /// First row of the gate after the next and of the options.
    const OPTIONS: usize = CrashWatch::ROWS + WaypointProgress::ROWS;
}

/// The rows of a drone are those of [`CrashWatch`] and of [`WaypointProgress`], the gate after the next, the reward for
/// the speed and the penalty for the distance.
impl LaneTask for Race {
    const ROWS: usize = Self::OPTIONS + 5;
    const OBSERVES_ATTITUDE: bool = true;

    fn write_rows(&self, simulation: SimView<'_>, drone: usize, rows: &mut [f64]) {
        let (watch, own) = rows.split_at_mut(CrashWatch::ROWS);
        self.watch.write_rows(&self.crash, simulation, drone, watch);
        let (progress, options) = own.split_at_mut(WaypointProgress::ROWS);
        self.progress.write_rows(drone, &self.gates, self.laps, self.radius, &self.gate(drone, 0), progress);
        let second = self.gate(drone, 1);
        options.copy_from_slice(&[second.x, second.y, second.z, self.speed_reward, self.distance_penalty]);
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
        let (zero, weights) = (distance.all(0.0), [3, 4].map(|index| own.get(Self::OPTIONS + index)));
        let reward = race::reward(zero, weights, state.velocity, distance);
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
        let (next, second) = (WaypointProgress::point_in_lanes(&own, CrashWatch::ROWS), own.get3(Self::OPTIONS));
        race::observe(&state, scene.rpy(drone), [next, second], out);
    }
}
