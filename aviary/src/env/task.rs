use nalgebra::Vector3;

use super::{BoxSpace, EndReason, EnvError, LaneFunctions, Rng, Saved, TaskOptions};
use crate::action::ActionType;
use crate::control::trajectory::Trajectory;
use crate::control::{ControllerKind, Reference};
use crate::drone::DroneParams;
use crate::observation::STATE_SIZE;
use crate::simulation::SimView;
use crate::state::DroneState;
use crate::world::{Marker, MarkerPose, MovingMarker};

/// Default options of a task's environment.
#[derive(Debug, Clone, PartialEq)]
pub struct TaskDefaults {
    /// Number of drones.
    pub num_drones: usize,
    /// Length of an episode, s.
    pub episode_seconds: f64,
    /// Built-in controller that flies the task.
    pub controller: ControllerKind,
}

/// Task of an environment: observation, reward and end of each drone.
///
/// [`Aviary`](super::Aviary) makes an environment from a task: one agent commands all drones, its observation is
/// the concatenation of theirs, and its reward is the sum of theirs.
/// [`ParallelAviary`](crate::multi_agent::ParallelAviary) makes an environment with one agent per drone.
///
/// The order of calls is `start`, `reset`, `observe` at the start of an episode, and `update`, `end`, `reward`,
/// `observe` after every control step. A change in `update`, such as a reached waypoint, is visible in all later
/// calls.
///
/// Batches evaluate the tasks of this crate for eight environments at a time, in SIMD registers. They evaluate other
/// tasks one environment at a time, which adds about 100 ns to the step of an environment.
///
/// A task is `Clone`: batches and snapshots copy it with its state. Snapshots in files also need
/// [`save`](Self::save) and [`load`](Self::load).
///
/// `examples/custom_task.rs` is a worked example.
///
/// ```
/// use aviary::control::{ControllerKind, Reference};
/// use aviary::drone::DroneParams;
/// use aviary::env::{AviaryBuilder, BoxSpace, EndReason, Env, Rng, Task, TaskDefaults};
/// use aviary::simulation::SimView;
/// use nalgebra::Vector3;
///
/// /// Climb to 2 m as fast as possible.
/// #[derive(Debug, Clone)]
/// struct Climb;
///
/// impl Task for Climb {
///     fn name(&self) -> &'static str { "climb" }
///     fn defaults(&self) -> TaskDefaults {
///         TaskDefaults { num_drones: 1, episode_seconds: 5.0, controller: ControllerKind::Pid }
///     }
///     fn initial_positions(&self, drones: &[DroneParams]) -> Vec<[f64; 3]> {
///         (0..drones.len()).map(|drone| [drone as f64, 0.0, 0.1]).collect()
///     }
///     fn observation_space(&self) -> BoxSpace { BoxSpace::new([[f64::NEG_INFINITY, f64::INFINITY]; 2]) }
///     fn reset(&mut self, _: SimView<'_>, _: &mut Rng) {}
///     fn update(&mut self, _: SimView<'_>) {}
///     fn end(&self, simulation: SimView<'_>, drone: usize) -> Option<EndReason> {
///         self.success(simulation, drone).then_some(EndReason::Completed)
///     }
///     fn reward(&self, simulation: SimView<'_>, drone: usize, _: Option<EndReason>) -> f64 {
///         simulation.states()[drone].position.z - 2.0
///     }
///     fn observe(&self, simulation: SimView<'_>, drone: usize, out: &mut [f64]) {
///         let state = &simulation.states()[drone];
///         out.copy_from_slice(&[state.position.z, state.velocity.z]);
///     }
///     fn success(&self, simulation: SimView<'_>, drone: usize) -> bool {
///         simulation.states()[drone].position.z > 2.0
///     }
///     fn reference(&self, _: SimView<'_>, drone: usize) -> Reference {
///         Reference::hover(Vector3::new(drone as f64, 0.0, 2.1), 0.0)
///     }
/// }
///
/// let mut env = AviaryBuilder::new(Climb).build()?;
/// env.reset(Some(1))?;
/// while env.info().end.is_none() {
///     env.step(&[0.5; 4])?;
/// }
/// assert_eq!(env.info().end, Some(EndReason::Completed));
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
pub trait Task: std::fmt::Debug + 'static {
    /// Returns the name, in lower snake case.
    fn name(&self) -> &'static str;

    /// Returns the default options of the environment.
    fn defaults(&self) -> TaskDefaults;

    /// Returns initial positions for these drones, world frame, m.
    fn initial_positions(&self, drones: &[DroneParams]) -> Vec<[f64; 3]>;

    /// Returns the default action type of the environment.
    fn action_type(&self) -> ActionType {
        ActionType::default()
    }

    /// Sets [options by name](TaskOptions). Options that are `None` stay the same. The environment validates the task
    /// afterwards.
    ///
    /// # Errors
    /// [`EnvError::TaskOption`] for an option that the task does not have; the task is unchanged.
    fn set_options(&mut self, options: &TaskOptions) -> Result<(), EnvError> {
        options.check(self.name(), &[])
    }

    /// Returns the options that [`set_options`](Self::set_options) sets, with their present values.
    fn options(&self) -> TaskOptions {
        TaskOptions::default()
    }

    /// Returns the space of one drone's observation. In every task of [`NAMES`](crate::tasks::NAMES), entries 0 to 11
    /// are those of [`state_vector`](crate::observation::state_vector).
    fn observation_space(&self) -> BoxSpace;

    /// Validates the options of the task for these drones.
    ///
    /// # Errors
    /// [`EnvError::Option`] naming an invalid option.
    fn validate(&self, drones: &[DroneParams]) -> Result<(), EnvError> {
        let _ = drones;
        Ok(())
    }

    /// Returns the visible markers, such as gates and waypoints. They do not collide.
    fn markers(&self) -> Vec<Marker> {
        Vec::new()
    }

    /// Returns the moving markers, with their poses at the start of an episode. The builder calls this function
    /// once. See [`move_markers`](Self::move_markers).
    fn moving_markers(&self) -> Vec<MovingMarker> {
        Vec::new()
    }

    /// Sets the present poses of the [moving markers](Self::moving_markers), in their order. `poses` contains the
    /// poses at the start of an episode. The environment calls this function after [`reset`](Self::reset) and after
    /// every [`update`](Self::update); markers that [stand still](MovingMarker::stands_still) keep the pose of the
    /// first call. The poses must depend only on the task and the simulation. During a control step all markers stand
    /// still, including those that drones collide with.
    fn move_markers(&self, simulation: SimView<'_>, poses: &mut [MarkerPose]) {
        let _ = (simulation, poses);
    }

    /// Changes the initial states of an episode and returns true, or returns false to keep them. The environment
    /// calls this function before [`reset`](Self::reset). All random numbers must come from `rng`.
    fn start(&mut self, simulation: SimView<'_>, rng: &mut Rng, states: &mut [DroneState]) -> bool {
        let _ = (simulation, rng, states);
        false
    }

    /// Starts an episode. All random numbers must come from `rng`.
    fn reset(&mut self, simulation: SimView<'_>, rng: &mut Rng);

    /// Updates the state of the task after a control step.
    fn update(&mut self, simulation: SimView<'_>);

    /// Returns the reason of the end for a drone, if the episode is over for it. The environment handles the time
    /// limit. An episode ends when any drone ends with another reason than `Completed`, or when all drones report
    /// `Completed` in the same step; a drone that has completed its part must keep reporting it.
    fn end(&self, simulation: SimView<'_>, drone: usize) -> Option<EndReason>;

    /// Returns a drone's reward for the last control step. `end` is the result of [`end`](Self::end) for the same
    /// step.
    fn reward(&self, simulation: SimView<'_>, drone: usize, end: Option<EndReason>) -> f64;

    /// Returns the terms of a drone's [`reward`](Self::reward) for the last control step, by name: bonuses are
    /// positive, penalties negative, and their sum in this order is the reward. Names are in lower snake case, unique,
    /// and the same in every step. The unit is that of the reward. By default, the list is empty. Windows and
    /// recordings show the terms one by one; no step calls this function.
    ///
    /// A formula that is generic over its result ([`RewardTerms`](super::RewardTerms)) is written once for both
    /// functions:
    ///
    /// ```
    /// use aviary::env::RewardTerms;
    ///
    /// fn formula<T: RewardTerms<f64>>(height: f64, speed: f64) -> T {
    ///     T::first("height", height).minus("speed", 0.1 * speed)
    /// }
    ///
    /// let reward: f64 = formula(2.0, 5.0);
    /// let reward_terms: Vec<(&'static str, f64)> = formula(2.0, 5.0);
    /// assert_eq!((reward, reward_terms), (1.5, vec![("height", 2.0), ("speed", -0.5)]));
    /// ```
    fn reward_terms(&self, simulation: SimView<'_>, drone: usize, end: Option<EndReason>) -> Vec<(&'static str, f64)> {
        let _ = (simulation, drone, end);
        Vec::new()
    }

    /// Returns the present poses of the gates: the centre (world frame, m) and the direction of the normal, rad from x.
    /// By default, a task has no gates.
    fn gates(&self) -> Vec<[f64; 4]> {
        Vec::new()
    }

    /// Writes a drone's observation.
    fn observe(&self, simulation: SimView<'_>, drone: usize, out: &mut [f64]);

    /// Returns true if a drone fulfils its part of the task at this moment.
    fn success(&self, simulation: SimView<'_>, drone: usize) -> bool;

    /// Returns the completed share of a drone's part, from 0 to 1.
    fn progress(&self, simulation: SimView<'_>, drone: usize) -> f64 {
        f64::from(u8::from(self.success(simulation, drone)))
    }

    /// Returns the reference that a drone should follow now. Callers may use it before the first
    /// [`reset`](Self::reset).
    fn reference(&self, simulation: SimView<'_>, drone: usize) -> Reference;

    /// Returns a trajectory from the drone's present state (at time 0) that fulfils the task, for controllers;
    /// `None` if following [`reference`](Self::reference) fulfils the task.
    fn plan(&self, simulation: SimView<'_>, drone: usize) -> Option<Box<dyn Trajectory>> {
        let _ = (simulation, drone);
        None
    }

    /// Returns the [`plan`](Self::plan) of every drone. Tasks whose plans depend on each other override this
    /// function.
    fn plans(&self, simulation: SimView<'_>) -> Vec<Option<Box<dyn Trajectory>>> {
        (0..simulation.num_drones()).map(|drone| self.plan(simulation, drone)).collect()
    }

    /// Returns points (world frame, m) that a drone passes in an episode of `seconds`, for fixed cameras: by
    /// default the present [`reference`](Self::reference) and points along the [`plan`](Self::plan). Tasks with a
    /// moving reference return points along its path.
    fn extent(&self, simulation: SimView<'_>, drone: usize, seconds: f64) -> Vec<Vector3<f64>> {
        let _ = seconds;
        let plan = self.plan(simulation, drone);
        let planned = plan.iter().flat_map(|plan| path_points(plan.duration(), |time| plan.reference(time).position));
        std::iter::once(self.reference(simulation, drone).position).chain(planned).collect()
    }

    /// Reports scalar metrics by name: gates passed, formation error.
    fn metrics(&self, simulation: SimView<'_>, report: &mut dyn FnMut(&'static str, f64)) {
        let _ = (simulation, report);
    }

    /// Serializes the options and the state of the task, for snapshots in files; `None`, the default, if the task
    /// does not support it. A task that implements serde's traits returns `Saved::new(self)`.
    fn save(&self) -> Option<Saved> {
        None
    }

    /// Restores the result of [`save`](Self::save). A task that implements serde's traits does
    /// `*self = saved.read()?`.
    ///
    /// # Errors
    /// [`EnvError::SavedSnapshot`] for a value of another type; the task is unchanged.
    fn load(&mut self, saved: &Saved) -> Result<(), EnvError> {
        let _ = saved;
        Err(EnvError::SavedSnapshot { message: format!("the task `{}` cannot be loaded", self.name()) })
    }

    /// Returns the SIMD form of the task, which batches evaluate eight environments at a time with. Only the tasks of
    /// this crate have one. A batch evaluates other tasks one environment at a time.
    #[doc(hidden)]
    fn lane_functions() -> Option<LaneFunctions<Self>>
    where
        Self: Sized,
    {
        None
    }

    /// Returns true if an entry of a drone's observation may stay constant during an episode, as a target does.
    /// [`check_env`](super::check_env) fails for any other entry that stays constant.
    fn may_be_constant(&self, entry: usize) -> bool {
        entry >= STATE_SIZE
    }
}

/// Returns points on a path of `seconds`, dense enough for images.
pub(crate) fn path_points(seconds: f64, at: impl Fn(f64) -> Vector3<f64>) -> impl Iterator<Item = Vector3<f64>> {
    const POINTS: u32 = 120;
    (0..=POINTS).map(move |i| at(seconds * f64::from(i) / f64::from(POINTS)))
}
