use std::f64::consts::FRAC_PI_2;

use flight::tasks::{RewardTerms, hover};
use nalgebra::Vector3;
use pulp::Simd;

use super::conditions::{CrashConditions, CrashWatch, with_crash};
use super::{STATE_BOUNDS, observed};
use crate::control::{ControllerKind, Reference};
use crate::drone::DroneParams;
use crate::env::{
    AviaryBuilder, BoxSpace, EndReason, EnvError, LaneFunctions, LaneRows, LaneScene, LaneTask, Rng, Task,
    TaskDefaults, TaskOptions, TaskRows,
};
use crate::math::{Pack, Real, ToFlight as _, V3};
use crate::simulation::SimView;

/// Task: a drone takes off and hovers (paper, §4.1 `HoverAviary`).
///
/// | | |
/// | --- | --- |
/// | Start | (0, 0, 0.1) m, level, at rest |
/// | Action | 4 normalized motor speeds in [−1, 1]; 0 hovers |
/// | Reward | −\|z − z\*\| − 0.1·‖(x, y)‖ − 0.05·‖v‖ − 0.05·(\|φ\| + \|θ\|), + 0.5 at the target, − 100 for a crash |
/// | Reward terms | `height_error`, `horizontal_error`, `speed`, `tilt`, `at_target`, `crash` |
/// | At the target | \|z − z\*\| < 0.05 m and ‖(x, y)‖ < 0.05 m |
/// | Terminated | crash (tilt > 90°, floor contact after take-off, obstacle contact, z < 0) or z > 3 m |
/// | Truncated | after 10 s |
///
/// | Observation | | Unit, frame |
/// | --- | --- | --- |
/// | 0–2 | position | m, world |
/// | 3–5 | roll, pitch, yaw | rad |
/// | 6–8 | velocity | m/s, world |
/// | 9–11 | angular velocity | rad/s, body |
///
/// ```
/// use aviary::env::Env;
/// use aviary::tasks::Hover;
///
/// let mut env = Hover::builder().task(|hover| hover.target_height = 0.8).build()?;
/// env.reset(Some(1))?;
/// let step = env.step(&[0.0; 4])?;
/// assert!((step.reward + 0.7).abs() < 1e-3, "at rest, 0.7 m below the target");
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Clone, serde::Serialize, serde::Deserialize)]
pub struct Hover {
    /// Target height z\*, m; default 1.
    pub target_height: f64,
    /// Height above which the episode ends, m; default 3.
    pub max_height: f64,
    /// Conditions under which the drone crashes.
    pub crash: CrashConditions,
    watch: CrashWatch,
}

impl Default for Hover {
    fn default() -> Self {
        Self {
            target_height: 1.0,
            max_height: 3.0,
            crash: CrashConditions::with_max_tilt(FRAC_PI_2),
            watch: CrashWatch::default(),
        }
    }
}

impl Hover {
    /// Creates a builder for the environment of this task.
    pub fn builder() -> AviaryBuilder<Self> {
        AviaryBuilder::new(Self::default())
    }

    fn target(&self) -> Vector3<f64> {
        Vector3::new(0.0, 0.0, self.target_height)
    }

    /// Returns the terms of a drone's reward, or their sum.
    fn terms<T: RewardTerms<f64>>(&self, simulation: SimView<'_>, drone: usize, end: Option<EndReason>) -> T {
        hover_terms(simulation, drone, &self.target(), end)
    }
}

impl Task for Hover {
    fn name(&self) -> &'static str {
        "hover"
    }

    fn defaults(&self) -> TaskDefaults {
        TaskDefaults { num_drones: 1, episode_seconds: 10.0, controller: ControllerKind::Pid }
    }

    fn set_options(&mut self, options: &TaskOptions) -> Result<(), EnvError> {
        options.check(self.name(), &["target_height"])?;
        self.target_height = options.target_height.unwrap_or(self.target_height);
        Ok(())
    }

    fn options(&self) -> TaskOptions {
        TaskOptions { target_height: Some(self.target_height), ..TaskOptions::default() }
    }

    fn initial_positions(&self, _drones: &[DroneParams]) -> Vec<[f64; 3]> {
        vec![[0.0, 0.0, 0.1]]
    }

    fn observation_space(&self) -> BoxSpace {
        BoxSpace::new(STATE_BOUNDS)
    }

    fn validate(&self, drones: &[DroneParams]) -> Result<(), EnvError> {
        self.crash.validate()?;
        if drones.len() != 1 {
            return Err(EnvError::Option {
                option: "num_drones",
                got: drones.len().to_string(),
                expected: "1 in hover",
            });
        }
        let (target, max) = (self.target_height, self.max_height);
        if !(target.is_finite() && target > 0.0 && target < max) {
            return Err(EnvError::Option {
                option: "target_height",
                got: format!("{} m", crate::number(target)),
                expected: "a height above the floor and below max_height",
            });
        }
        Ok(())
    }

    fn reset(&mut self, simulation: SimView<'_>, _rng: &mut Rng) {
        self.watch.reset(simulation);
    }

    fn update(&mut self, simulation: SimView<'_>) {
        self.watch.update(&self.crash, simulation);
    }

    fn end(&self, simulation: SimView<'_>, drone: usize) -> Option<EndReason> {
        let too_high = hover::is_too_high(simulation.states()[drone].position.to_flight(), self.max_height);
        self.watch.end(drone).or(too_high.then_some(EndReason::OutOfBounds))
    }

    fn reward(&self, simulation: SimView<'_>, drone: usize, end: Option<EndReason>) -> f64 {
        self.terms(simulation, drone, end)
    }

    fn reward_terms(&self, simulation: SimView<'_>, drone: usize, end: Option<EndReason>) -> Vec<(&'static str, f64)> {
        self.terms(simulation, drone, end)
    }

    fn observe(&self, simulation: SimView<'_>, drone: usize, out: &mut [f64]) {
        let (state, rpy) = observed(simulation, drone);
        hover::observe(&state, rpy, out);
    }

    fn success(&self, simulation: SimView<'_>, drone: usize) -> bool {
        self.watch.end(drone).is_none()
            && hover::at_target(simulation.states()[drone].position.to_flight(), self.target().to_flight())
    }

    fn reference(&self, _simulation: SimView<'_>, _drone: usize) -> Reference {
        Reference::hover(self.target(), 0.0)
    }

    fn lane_functions() -> Option<LaneFunctions<Self>> {
        Some(LaneFunctions::of())
    }

    super::saved_by_serde!();
}

/// The rows of a drone are those of [`CrashWatch`], the target height and the maximum height.
impl LaneTask for Hover {
    const ROWS: usize = CrashWatch::ROWS + 2;
    const OBSERVES_ATTITUDE: bool = false;

    fn write_rows(&self, simulation: SimView<'_>, drone: usize, rows: &mut [f64]) {
        let (watch, own) = rows.split_at_mut(CrashWatch::ROWS);
        self.watch.write_rows(&self.crash, simulation, drone, watch);
        own.copy_from_slice(&[self.target_height, self.max_height]);
    }

    fn read_rows(&mut self, drone: usize, rows: &[f64]) {
        self.watch.read_rows(drone, rows);
    }

    #[inline(always)]
    fn evaluate<S: Simd>(scene: &LaneScene<'_, S>, drone: usize, rows: &mut TaskRows<'_, S>) -> (Pack<S>, Pack<S>) {
        let (state, mut own) = (scene.state(drone), rows.drone(drone));
        let crashed = CrashWatch::update_rows(&state, &mut own);
        let [height, max_height] = [0, 1].map(|index| own.get(CrashWatch::ROWS + index));
        let too_high = Real::choose(hover::is_too_high(state.position, max_height), height.all(1.0), height.all(0.0));
        let target = V3::new(height.all(0.0), height.all(0.0), height);
        (hover::reward(&state, scene.rpy(drone), target), crashed.greater(too_high))
    }

    #[inline(always)]
    fn observe_lanes<S: Simd>(
        scene: &LaneScene<'_, S>,
        drone: usize,
        _: &mut TaskRows<'_, S>,
        out: &mut LaneRows<'_, S>,
    ) {
        hover::observe(&scene.state(drone), scene.rpy(drone), out);
    }
}

/// Returns the paper's reward for hovering at a target (world frame, m) in the last control step: the formula of
/// [`Hover`]. `end` is the reason of the end for this drone.
///
/// # Panics
/// If `drone` is out of range.
pub fn hover_reward(simulation: SimView<'_>, drone: usize, target: &Vector3<f64>, end: Option<EndReason>) -> f64 {
    hover_terms(simulation, drone, target, end)
}

/// Returns the terms of [`hover_reward`], or their sum.
pub(super) fn hover_terms<T: RewardTerms<f64>>(
    simulation: SimView<'_>,
    drone: usize,
    target: &Vector3<f64>,
    end: Option<EndReason>,
) -> T {
    let (state, rpy) = observed(simulation, drone);
    with_crash(hover::terms(&state, rpy, target.to_flight()), end)
}
