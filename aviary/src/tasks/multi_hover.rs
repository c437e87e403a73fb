use std::f64::consts::FRAC_PI_2;

use flight::tasks::{RewardTerms, hover, multi_hover};
use nalgebra::Vector3;
use pulp::Simd;

use super::conditions::{CrashConditions, CrashWatch};
use super::hover::hover_terms;
use super::{STATE_BOUNDS, UNBOUNDED, observed};
use crate::control::{ControllerKind, Reference};
use crate::drone::DroneParams;
use crate::env::{
    AviaryBuilder, BoxSpace, EndReason, EnvError, LaneFunctions, LaneRows, LaneScene, LaneTask, Rng, Task,
    TaskDefaults, TaskOptions, TaskRows,
};
use crate::math::{Pack, Real, ToFlight as _};
use crate::simulation::SimView;
use crate::world::placement::max_collision_radius;

/// Task: drones on a line take off, each to its own height (paper, §4.1 `MultiHoverAviary`).
///
/// | | |
/// | --- | --- |
/// | Start | two or more drones on a line along x, 1 m apart (more for larger airframes), z = 0.1 m |
/// | Target | above the start, heights evenly spaced from 0.7 m to 1.2 m |
/// | Action | 4 normalized motor speeds in [−1, 1] per drone |
/// | Reward | sum of the drones' [`Hover`](super::Hover) rewards, with horizontal distances from the start |
/// | Reward terms | `height_error`, `horizontal_error`, `speed`, `tilt`, `at_target`, `crash` |
/// | Terminated | a drone crashes or rises above 3 m |
/// | Truncated | after 10 s |
/// | Success | every drone within 5 cm of its target height and horizontally within 5 cm of its start |
///
/// | Observation, per drone | | Unit, frame |
/// | --- | --- | --- |
/// | 0–11 | position, roll-pitch-yaw, velocity, angular velocity | as in [`Hover`](super::Hover) |
/// | 12 | target height | m, world |
///
/// ```
/// use aviary::env::Env;
/// use aviary::tasks::MultiHover;
///
/// let mut env = MultiHover::builder().num_drones(3).build()?;
/// let seen = &env.reset(Some(1))?.vector;
/// assert_eq!([seen[12], seen[25], seen[38]], [0.7, 0.95, 1.2]);
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Clone, serde::Serialize, serde::Deserialize)]
pub struct MultiHover {
    /// Target height of each drone, m; default evenly spaced from 0.7 to 1.2.
    pub target_heights: Option<Vec<f64>>,
    /// Height above which the episode ends, m; default 3.
    pub max_height: f64,
    /// Conditions under which a drone crashes.
    pub crash: CrashConditions,
    /// True for the paper's `MultiAgentAviary`.
    multi_agent: bool,
    num_drones: usize,
    watch: CrashWatch,
}

impl Default for MultiHover {
    fn default() -> Self {
        Self {
            target_heights: None,
            max_height: 3.0,
            crash: CrashConditions::with_max_tilt(FRAC_PI_2),
            multi_agent: false,
            num_drones: 2,
            watch: CrashWatch::default(),
        }
    }
}

impl MultiHover {
    /// Creates a builder for the environment of this task.
    pub fn builder() -> AviaryBuilder<Self> {
        AviaryBuilder::new(Self::default())
    }

    /// Creates the paper's `MultiAgentAviary`: the same task with three drones, for a
    /// [`ParallelAviary`](crate::multi_agent::ParallelAviary) with one agent per drone.
    pub fn multi_agent() -> Self {
        Self { multi_agent: true, num_drones: 3, ..Self::default() }
    }

    fn target(&self, simulation: SimView<'_>, drone: usize) -> Vector3<f64> {
        let start = simulation.initial_states()[drone].position;
        Vector3::new(start.x, start.y, self.height(drone, simulation.num_drones()))
    }

    /// Returns the target height of one of `count` drones, m.
    ///
    /// # Panics
    /// If [`target_heights`](Self::target_heights) has fewer heights.
    pub fn height(&self, drone: usize, count: usize) -> f64 {
        match &self.target_heights {
            Some(heights) => heights[drone],
            // numpy.linspace(0.7, 1.2, N)
            None => 0.7 + 0.5 * drone as f64 / count.saturating_sub(1).max(1) as f64,
        }
    }

    /// Returns the terms of a drone's reward, or their sum.
    fn terms<T: RewardTerms<f64>>(&self, simulation: SimView<'_>, drone: usize, end: Option<EndReason>) -> T {
        hover_terms(simulation, drone, &self.target(simulation, drone), end)
    }
}

impl Task for MultiHover {
    fn name(&self) -> &'static str {
        if self.multi_agent { "multi_agent" } else { "multi_hover" }
    }

    fn defaults(&self) -> TaskDefaults {
        TaskDefaults { num_drones: self.num_drones, episode_seconds: 10.0, controller: ControllerKind::Dsl }
    }

    fn set_options(&mut self, options: &TaskOptions) -> Result<(), EnvError> {
        options.check(self.name(), &["target_heights"])?;
        if options.target_heights.is_some() {
            self.target_heights.clone_from(&options.target_heights);
        }
        Ok(())
    }

    fn options(&self) -> TaskOptions {
        TaskOptions { target_heights: self.target_heights.clone(), ..TaskOptions::default() }
    }

    fn initial_positions(&self, drones: &[DroneParams]) -> Vec<[f64; 3]> {
        let widest = max_collision_radius(drones);
        // closer drones at the same height are in the strongest part of each other's wakes
        let spacing = (4.0 * widest).max(1.0);
        (0..drones.len()).map(|drone| [spacing * drone as f64, 0.0, 0.1]).collect()
    }

    fn observation_space(&self) -> BoxSpace {
        BoxSpace::new(STATE_BOUNDS.into_iter().chain([UNBOUNDED]))
    }

    fn validate(&self, drones: &[DroneParams]) -> Result<(), EnvError> {
        self.crash.validate()?;
        if let Some(heights) = &self.target_heights
            && heights.len() != drones.len()
        {
            return Err(EnvError::Option {
                option: "target_heights",
                got: crate::count(heights.len(), "height"),
                expected: "one per drone",
            });
        }
        let heights = (0..drones.len()).map(|drone| self.height(drone, drones.len()));
        match heights.into_iter().find(|&height| !(height > 0.0 && height < self.max_height)) {
            Some(height) => Err(EnvError::Option {
                option: "target_heights",
                got: format!("{} m with a max_height of {} m", crate::number(height), crate::number(self.max_height)),
                expected: "heights above the floor and below max_height",
            }),
            None => Ok(()),
        }
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
        multi_hover::observe(&state, rpy, self.target(simulation, drone).z, out);
    }

    fn success(&self, simulation: SimView<'_>, drone: usize) -> bool {
        let target = self.target(simulation, drone);
        self.watch.end(drone).is_none()
            && hover::at_target(simulation.states()[drone].position.to_flight(), target.to_flight())
    }

    fn reference(&self, simulation: SimView<'_>, drone: usize) -> Reference {
        Reference::hover(self.target(simulation, drone), simulation.initial_states()[drone].yaw())
    }

    fn lane_functions() -> Option<LaneFunctions<Self>> {
        Some(LaneFunctions::of())
    }

    super::saved_by_serde!();
}

/// The rows of a drone are those of [`CrashWatch`], the target and the maximum height.
impl LaneTask for MultiHover {
    const ROWS: usize = CrashWatch::ROWS + 4;
    const OBSERVES_ATTITUDE: bool = false;

    fn write_rows(&self, simulation: SimView<'_>, drone: usize, rows: &mut [f64]) {
        let (watch, own) = rows.split_at_mut(CrashWatch::ROWS);
        self.watch.write_rows(&self.crash, simulation, drone, watch);
        let target = self.target(simulation, drone);
        own.copy_from_slice(&[target.x, target.y, target.z, self.max_height]);
    }

    fn read_rows(&mut self, drone: usize, rows: &[f64]) {
        self.watch.read_rows(drone, &rows[..CrashWatch::ROWS]);
    }

    #[inline(always)]
    fn evaluate<S: Simd>(scene: &LaneScene<'_, S>, drone: usize, rows: &mut TaskRows<'_, S>) -> (Pack<S>, Pack<S>) {
        let (state, mut own) = (scene.state(drone), rows.drone(drone));
        let crashed = CrashWatch::update_rows(&state, &mut own);
        let (target, max_height) = (own.get3(CrashWatch::ROWS), own.get(CrashWatch::ROWS + 3));
        let too_high = Real::choose(hover::is_too_high(state.position, max_height), crashed.all(1.0), crashed.all(0.0));
        (hover::reward(&state, scene.rpy(drone), target), crashed.greater(too_high))
    }

    #[inline(always)]
    fn observe_lanes<S: Simd>(
        scene: &LaneScene<'_, S>,
        drone: usize,
        rows: &mut TaskRows<'_, S>,
        out: &mut LaneRows<'_, S>,
    ) {
        let height = rows.drone(drone).get(CrashWatch::ROWS + 2);
        multi_hover::observe(&scene.state(drone), scene.rpy(drone), height, out);
    }
}
