use std::f64::consts::FRAC_PI_2;

use flight::tasks::{RewardTerms, velocity};
use nalgebra::Vector3;
use pulp::Simd;
use rand::RngExt as _;

use super::conditions::{CrashConditions, CrashWatch, with_crash};
use super::{STATE_BOUNDS, observed};
use crate::control::{ControllerKind, Reference};
use crate::drone::DroneParams;
use crate::env::{
    AviaryBuilder, BoxSpace, EndReason, EnvError, LaneFunctions, LaneRows, LaneScene, LaneTask, Rng, Task,
    TaskDefaults, TaskRows,
};
use crate::math::{Pack, ToFlight as _};
use crate::simulation::SimView;
use crate::state::wrap_angle;

/// Task: a drone tracks a velocity and a yaw rate that are sampled for every episode (paper, §4.1
/// `VelocityAviary`).
///
/// | | |
/// | --- | --- |
/// | Start | (0, 0, 6) m, level, at rest; several drones 12 m apart along x |
/// | Target | velocity v\* uniform in ±0.5 m/s along each axis, yaw rate ω\* in ±0.25 rad/s |
/// | Action | 4 normalized motor speeds in [−1, 1] per drone |
/// | Reward | −‖v − v\*‖ − 0.1·\|ω_z − ω\*\| − 0.05·(\|φ\| + \|θ\|), + 0.5 while tracked, − 100 for a crash |
/// | Reward terms | `velocity_error`, `yaw_rate_error`, `tilt`, `tracked`, `crash` |
/// | Tracked, success | ‖v − v\*‖ < 0.05 m/s |
/// | Terminated | crash (tilt > 90°, contact, z < 0) |
/// | Truncated | after 10 s |
/// | Reference | moves from the start with v\* and turns with ω\* |
///
/// The start is high enough that no target leads into the floor before the time limit.
///
/// | Observation, per drone | | Unit, frame |
/// | --- | --- | --- |
/// | 0–11 | position, roll-pitch-yaw, velocity, angular velocity | as in [`Hover`](super::Hover) |
/// | 12–14 | target velocity v\* | m/s, world |
/// | 15 | target yaw rate ω\* | rad/s, body |
///
/// ```
/// use aviary::env::Env;
/// use aviary::tasks::Velocity;
///
/// let mut env = Velocity::builder().build()?;
/// let seen = env.reset(Some(1))?.vector.clone();
/// let (velocity, yaw_rate) = env.task().target(0);
/// assert_eq!((&seen[12..15], seen[15]), (velocity.as_slice(), yaw_rate));
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Clone, serde::Serialize, serde::Deserialize)]
pub struct Velocity {
    /// Maximum of each component of the target velocity, m/s; default 0.5.
    pub max_speed: f64,
    /// Maximum target yaw rate, rad/s; default 0.25.
    pub max_yaw_rate: f64,
    /// Conditions under which a drone crashes.
    pub crash: CrashConditions,
    watch: CrashWatch,
    /// Target velocity (world frame, m/s) and yaw rate (rad/s) of each drone.
    #[serde(with = "crate::serial::vectors_and_numbers")]
    targets: Vec<(Vector3<f64>, f64)>,
}

impl Default for Velocity {
    fn default() -> Self {
        Self {
            max_speed: 0.5,
            max_yaw_rate: 0.25,
            crash: CrashConditions::with_max_tilt(FRAC_PI_2),
            watch: CrashWatch::default(),
            targets: Vec::new(),
        }
    }
}

impl Velocity {
    /// Creates a builder for the environment of this task.
    pub fn builder() -> AviaryBuilder<Self> {
        AviaryBuilder::new(Self::default())
    }

    /// Returns the target of a drone in this episode: velocity (world frame, m/s) and yaw rate (rad/s).
    ///
    /// # Panics
    /// Before the first reset, and if `drone` is out of range.
    pub fn target(&self, drone: usize) -> (Vector3<f64>, f64) {
        self.targets[drone]
    }

    fn error(&self, simulation: SimView<'_>, drone: usize) -> f64 {
        (simulation.states()[drone].velocity - self.targets[drone].0).norm()
    }

    /// Returns the terms of a drone's reward, or their sum.
    fn terms<T: RewardTerms<f64>>(&self, simulation: SimView<'_>, drone: usize, end: Option<EndReason>) -> T {
        let (state, rpy) = observed(simulation, drone);
        let (velocity, yaw_rate) = &self.targets[drone];
        with_crash(velocity::terms(&state, rpy, velocity.to_flight(), *yaw_rate), end)
    }
}

impl Task for Velocity {
    fn name(&self) -> &'static str {
        "velocity"
    }

    fn defaults(&self) -> TaskDefaults {
        TaskDefaults { num_drones: 1, episode_seconds: 10.0, controller: ControllerKind::Dsl }
    }

    fn initial_positions(&self, drones: &[DroneParams]) -> Vec<[f64; 3]> {
        // drones cannot meet during an episode
        (0..drones.len()).map(|drone| [12.0 * drone as f64, 0.0, 6.0]).collect()
    }

    fn observation_space(&self) -> BoxSpace {
        let (speed, rate) = ([-self.max_speed, self.max_speed], [-self.max_yaw_rate, self.max_yaw_rate]);
        BoxSpace::new(STATE_BOUNDS.into_iter().chain([speed, speed, speed, rate]))
    }

    fn validate(&self, _drones: &[DroneParams]) -> Result<(), EnvError> {
        self.crash.validate()?;
        for (option, got) in [("max_speed", self.max_speed), ("max_yaw_rate", self.max_yaw_rate)] {
            if !(0.0..=1e3).contains(&got) {
                let expected = "zero or a positive number up to 1000";
                return Err(EnvError::Option { option, got: crate::number(got), expected });
            }
        }
        Ok(())
    }

    fn reset(&mut self, simulation: SimView<'_>, rng: &mut Rng) {
        self.watch.reset(simulation);
        self.targets.clear();
        for _ in 0..simulation.num_drones() {
            let mut within = |max: f64| max * (2.0 * rng.random::<f64>() - 1.0);
            let velocity = Vector3::new(within(self.max_speed), within(self.max_speed), within(self.max_speed));
            self.targets.push((velocity, within(self.max_yaw_rate)));
        }
    }

    fn update(&mut self, simulation: SimView<'_>) {
        self.watch.update(&self.crash, simulation);
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
        let (velocity, yaw_rate) = &self.targets[drone];
        velocity::observe(&state, rpy, velocity.to_flight(), *yaw_rate, out);
    }

    fn success(&self, simulation: SimView<'_>, drone: usize) -> bool {
        self.watch.end(drone).is_none() && self.error(simulation, drone) < velocity::TRACKED
    }

    fn reference(&self, simulation: SimView<'_>, drone: usize) -> Reference {
        let start = &simulation.initial_states()[drone];
        // no targets exist before the first reset
        let (velocity, yaw_rate) = self.targets.get(drone).copied().unwrap_or_default();
        let time = simulation.time();
        Reference {
            velocity,
            yaw_rate,
            ..Reference::hover(start.position + velocity * time, wrap_angle(start.yaw() + yaw_rate * time))
        }
    }

    fn extent(&self, simulation: SimView<'_>, drone: usize, seconds: f64) -> Vec<Vector3<f64>> {
        let start = simulation.initial_states()[drone].position;
        let velocity = self.targets.get(drone).map_or_else(Vector3::zeros, |target| target.0);
        vec![start, start + velocity * seconds]
    }

    fn metrics(&self, simulation: SimView<'_>, report: &mut dyn FnMut(&'static str, f64)) {
        let errors = (0..simulation.num_drones()).map(|drone| self.error(simulation, drone));
        report("velocity_error", errors.fold(0.0, f64::max));
    }

    fn lane_functions() -> Option<LaneFunctions<Self>> {
        Some(LaneFunctions::of())
    }

    super::saved_by_serde!();
}

/// The rows of a drone are those of [`CrashWatch`], the target velocity and the target yaw rate.
impl LaneTask for Velocity {
    const ROWS: usize = CrashWatch::ROWS + 4;
    const OBSERVES_ATTITUDE: bool = false;

    fn write_rows(&self, simulation: SimView<'_>, drone: usize, rows: &mut [f64]) {
        let (watch, own) = rows.split_at_mut(CrashWatch::ROWS);
        self.watch.write_rows(&self.crash, simulation, drone, watch);
        let (velocity, yaw_rate) = self.targets[drone];
        own.copy_from_slice(&[velocity.x, velocity.y, velocity.z, yaw_rate]);
    }

    fn read_rows(&mut self, drone: usize, rows: &[f64]) {
        self.watch.read_rows(drone, &rows[..CrashWatch::ROWS]);
    }

    #[inline(always)]
    fn evaluate<S: Simd>(scene: &LaneScene<'_, S>, drone: usize, rows: &mut TaskRows<'_, S>) -> (Pack<S>, Pack<S>) {
        let (state, mut own) = (scene.state(drone), rows.drone(drone));
        let crashed = CrashWatch::update_rows(&state, &mut own);
        let (velocity, yaw_rate) = (own.get3(CrashWatch::ROWS), own.get(CrashWatch::ROWS + 3));
        (velocity::reward(&state, scene.rpy(drone), velocity, yaw_rate), crashed)
    }

    #[inline(always)]
    fn observe_lanes<S: Simd>(
        scene: &LaneScene<'_, S>,
        drone: usize,
        rows: &mut TaskRows<'_, S>,
        out: &mut LaneRows<'_, S>,
    ) {
        let own = rows.drone(drone);
        let (velocity, yaw_rate) = (own.get3(CrashWatch::ROWS), own.get(CrashWatch::ROWS + 3));
        velocity::observe(&scene.state(drone), scene.rpy(drone), velocity, yaw_rate, out);
    }
}
