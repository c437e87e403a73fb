use std::f64::consts::{FRAC_PI_2, PI};

use flight::tasks::{RewardTerms, stabilize};
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
use crate::math::Pack;
use crate::simulation::SimView;
use crate::state::{DroneState, FlightState, attitude_from_rpy};

/// Task: a drone comes to rest from a random motion (the `stabilize` task of the paper's vectorized back end,
/// §3.6).
///
/// | | |
/// | --- | --- |
/// | Start | (0, 0, 5) m, several drones 6 m apart along x |
/// | Initial velocity | uniform in ±1 m/s along each axis |
/// | Initial attitude | roll and pitch uniform in ±0.5 rad, any yaw |
/// | Initial angular velocity | uniform in ±2 rad/s about each axis |
/// | Action | 4 normalized motor speeds in [−1, 1] per drone |
/// | Reward | −‖v‖ − 0.1·‖ω‖ − 0.05·(\|φ\| + \|θ\|), + 0.5 at rest, − 100 for a crash |
/// | Reward terms | `speed`, `angular_velocity`, `tilt`, `at_rest`, `crash` |
/// | At rest, success | ‖v‖ < 0.05 m/s and ‖ω‖ < 0.1 rad/s |
/// | Terminated | crash (tilt > 90°, contact, z < 0) |
/// | Truncated | after 10 s |
/// | Reference | the drone's present position, at rest |
///
/// | Observation, per drone | | Unit, frame |
/// | --- | --- | --- |
/// | 0–11 | position, roll-pitch-yaw, velocity, angular velocity | as in [`Hover`](super::Hover) |
///
/// ```
/// use aviary::env::{DroneEnv, Env};
/// use aviary::tasks::Stabilize;
///
/// let mut env = Stabilize::builder().task(|stabilize| stabilize.max_speed = 3.0).build()?;
/// env.reset(Some(1))?;
/// let velocity = env.simulation().states()[0].velocity;
/// assert!(velocity.norm() > 0.0 && velocity.amax() <= 3.0);
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Clone, serde::Serialize, serde::Deserialize)]
pub struct Stabilize {
    /// Maximum of each component of the initial velocity, m/s; default 1.
    pub max_speed: f64,
    /// Maximum initial roll and pitch, rad; default 0.5.
    pub max_lean: f64,
    /// Maximum of each component of the initial angular velocity, rad/s; default 2.
    pub max_rate: f64,
    /// Conditions under which a drone crashes.
    pub crash: CrashConditions,
    watch: CrashWatch,
}

impl Default for Stabilize {
    fn default() -> Self {
        Self {
            max_speed: 1.0,
            max_lean: 0.5,
            max_rate: 2.0,
            crash: CrashConditions::with_max_tilt(FRAC_PI_2),
            watch: CrashWatch::default(),
        }
    }
}

impl Stabilize {
    /// Creates a builder for the environment of this task.
    pub fn builder() -> AviaryBuilder<Self> {
        AviaryBuilder::new(Self::default())
    }

    /// Returns the terms of a drone's reward, or their sum.
    fn terms<T: RewardTerms<f64>>(&self, simulation: SimView<'_>, drone: usize, end: Option<EndReason>) -> T {
        let (state, rpy) = observed(simulation, drone);
        with_crash(stabilize::terms(&state, rpy), end)
    }
}

impl Task for Stabilize {
    fn name(&self) -> &'static str {
        "stabilize"
    }

    fn defaults(&self) -> TaskDefaults {
        TaskDefaults { num_drones: 1, episode_seconds: 10.0, controller: ControllerKind::Dsl }
    }

    fn initial_positions(&self, drones: &[DroneParams]) -> Vec<[f64; 3]> {
        (0..drones.len()).map(|drone| [6.0 * drone as f64, 0.0, 5.0]).collect()
    }

    fn observation_space(&self) -> BoxSpace {
        BoxSpace::new(STATE_BOUNDS)
    }

    fn validate(&self, _drones: &[DroneParams]) -> Result<(), EnvError> {
        self.crash.validate()?;
        for (option, got, max) in [
            ("max_speed", self.max_speed, 1e3),
            ("max_lean", self.max_lean, FRAC_PI_2),
            ("max_rate", self.max_rate, 1e3),
        ] {
            if !(0.0..=max).contains(&got) {
                let expected = "0 to 1000, for max_lean 0 to π/2";
                return Err(EnvError::Option { option, got: crate::number(got), expected });
            }
        }
        Ok(())
    }

    fn start(&mut self, _simulation: SimView<'_>, rng: &mut Rng, states: &mut [DroneState]) -> bool {
        for state in states {
            let mut within = |max: f64| max * (2.0 * rng.random::<f64>() - 1.0);
            let mut triple = |max: [f64; 3]| Vector3::from(max.map(&mut within));
            state.velocity += triple([self.max_speed; 3]);
            state.attitude *= attitude_from_rpy(triple([self.max_lean, self.max_lean, PI]));
            state.angular_velocity += triple([self.max_rate; 3]);
        }
        true
    }

    fn reset(&mut self, simulation: SimView<'_>, _rng: &mut Rng) {
        self.watch.reset(simulation);
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
        stabilize::observe(&state, rpy, out);
    }

    fn success(&self, simulation: SimView<'_>, drone: usize) -> bool {
        self.watch.end(drone).is_none() && stabilize::at_rest(&FlightState::from(&simulation.states()[drone]))
    }

    fn extent(&self, simulation: SimView<'_>, drone: usize, _seconds: f64) -> Vec<Vector3<f64>> {
        let start = &simulation.started_from()[drone];
        // approximate stopping distance
        vec![start.position, start.position + start.velocity]
    }

    fn reference(&self, simulation: SimView<'_>, drone: usize) -> Reference {
        let state = &simulation.states()[drone];
        Reference::hover(state.position, state.yaw())
    }

    fn metrics(&self, simulation: SimView<'_>, report: &mut dyn FnMut(&'static str, f64)) {
        let speeds = simulation.states().iter().map(|state| state.velocity.norm());
        report("speed", speeds.fold(0.0, f64::max));
        let rates = simulation.states().iter().map(|state| state.angular_velocity.norm());
        report("body_rate", rates.fold(0.0, f64::max));
    }

    fn lane_functions() -> Option<LaneFunctions<Self>> {
        Some(LaneFunctions::of())
    }

    super::saved_by_serde!();
}

/// The rows of a drone are those of [`CrashWatch`].
impl LaneTask for Stabilize {
    const ROWS: usize = CrashWatch::ROWS;
    const OBSERVES_ATTITUDE: bool = false;

    fn write_rows(&self, simulation: SimView<'_>, drone: usize, rows: &mut [f64]) {
        self.watch.write_rows(&self.crash, simulation, drone, rows);
    }

    fn read_rows(&mut self, drone: usize, rows: &[f64]) {
        self.watch.read_rows(drone, rows);
    }

    #[inline(always)]
    fn evaluate<S: Simd>(scene: &LaneScene<'_, S>, drone: usize, rows: &mut TaskRows<'_, S>) -> (Pack<S>, Pack<S>) {
        let state = scene.state(drone);
        let crashed = CrashWatch::update_rows(&state, &mut rows.drone(drone));
        (stabilize::reward(&state, scene.rpy(drone)), crashed)
    }

    #[inline(always)]
    fn observe_lanes<S: Simd>(
        scene: &LaneScene<'_, S>,
        drone: usize,
        _: &mut TaskRows<'_, S>,
        out: &mut LaneRows<'_, S>,
    ) {
        stabilize::observe(&scene.state(drone), scene.rpy(drone), out);
    }
}
