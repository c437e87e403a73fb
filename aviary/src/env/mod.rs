//! Environments: Gymnasium's interface ([`Env`]), its extension for drones ([`DroneEnv`]), and the environment of a
//! task ([`Aviary`]).

mod aviary;
mod builder;
mod checker;
mod conditions;
mod episode;
mod error;
mod interventions;
mod lane_task;
mod moving;
pub(crate) mod randomization;
mod reset;
mod snapshot;
mod space;
mod stored;
mod task;
mod task_options;
mod workspace;

pub use aviary::Aviary;
pub(crate) use aviary::EnvParts;
pub use builder::{AviaryBuilder, EnvConfig};
pub use checker::{CheckFailure, CheckReport, check_env, check_independence};
pub use conditions::{ConditionChoice, Conditions};
pub(crate) use episode::{Episode, Phase};
pub use error::EnvError;
#[doc(hidden)]
pub use lane_task::LaneFunctions;
pub(crate) use lane_task::{LaneMask, LaneRows, LaneScene, LaneStep, LaneTask, Sensing, TaskRows};
pub(crate) use randomization::SensorLanes;
pub use randomization::{
    ActuatorRanges, AerodynamicRanges, AirframeRanges, BatteryRanges, BodyRanges, EnvironmentRanges, InitialRanges,
    Randomization, Range, SampledDroneParams, SampledParams, SensorRanges,
};
pub use snapshot::{EnvSnapshot, Saved};
pub use space::{BoxSpace, Dtype, ObservationSpace, Part};
pub(crate) use task::path_points;
pub use task::{Task, TaskDefaults};
pub use task_options::TaskOptions;

use std::collections::BTreeMap;

use nalgebra::Vector3;

use crate::action::ActionType;
use crate::control::Reference;
use crate::control::trajectory::Trajectory;
use crate::names::named_enum;
use crate::observation::Observation;
use crate::physics::wind::WindConfig;
use crate::simulation::Simulation;
use crate::vision::{ImageSize, View};
use crate::world::Obstacle;

pub use crate::random::Rng;
pub use flight::tasks::RewardTerms;

/// Result of a step. [`Env::info`] returns further information on demand.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Step<'a> {
    /// Observation after the step.
    pub observation: &'a Observation,
    /// Reward of this step.
    pub reward: f64,
    /// True if the task ended the episode: no more reward can follow.
    pub terminated: bool,
    /// True if the time limit ended the episode: more reward could have followed.
    pub truncated: bool,
}

named_enum! {
    "reason of an end"
    /// Reason why an episode ended.
    ///
    /// ```
    /// use aviary::env::{EndReason, Env};
    /// use aviary::tasks::Hover;
    ///
    /// // from 1 m, with the motors off
    /// let mut env = Hover::builder().initial_positions([[0.0, 0.0, 1.0]]).build()?;
    /// env.reset(Some(1))?;
    /// while env.info().end.is_none() {
    ///     env.step(&[-1.0; 4])?;
    /// }
    /// assert_eq!(env.info().end, Some(EndReason::FloorContact));
    /// assert!(env.info().crashed());
    /// # Ok::<(), aviary::env::EnvError>(())
    /// ```
    #[non_exhaustive]
    pub enum EndReason {
        /// The time limit of the episode was reached.
        TimeLimit = "time_limit",
        /// A drone fell below the floor's height.
        BelowFloor = "below_floor",
        /// A drone touched the floor after having been clear of it.
        FloorContact = "floor_contact",
        /// A drone touched an obstacle.
        ObstacleContact = "obstacle_contact",
        /// Two drones touched.
        DroneContact = "drone_contact",
        /// The tilt of a drone exceeded the task's limit.
        Tilt = "tilt",
        /// A drone left the bounds of the task.
        OutOfBounds = "out_of_bounds",
        /// All drones completed the task.
        Completed = "completed",
        /// The environment failed; its batch continues without it.
        Fault = "fault",
    }
}

impl EndReason {
    /// Returns true if the drone crashed: for every reason except the time limit, leaving the bounds, completion
    /// and a fault.
    pub fn is_crash(self) -> bool {
        !matches!(self, Self::TimeLimit | Self::OutOfBounds | Self::Completed | Self::Fault)
    }
}

/// State of an episode.
///
/// ```
/// use aviary::env::Env;
/// use aviary::tasks::Hover;
///
/// let mut env = Hover::builder().build()?;
/// env.reset(Some(1))?;
/// let info = env.info();
/// assert_eq!((info.time, info.end, info.contacts), (0.0, None, 0));
/// // from 0.1 m to 1 m
/// assert!((info.position_error - 0.9).abs() < 1e-12);
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct Info {
    /// Simulated time of the episode, s.
    pub time: f64,
    /// True if every drone fulfils the task at this moment.
    pub success: bool,
    /// Completed share of the task, from 0 to 1, averaged over the drones.
    pub progress: f64,
    /// Reason of the end; `None` while the episode runs.
    pub end: Option<EndReason>,
    /// Largest distance of a drone from its [reference](DroneEnv::reference) position, m.
    pub position_error: f64,
    /// Number of contacts during the last step: pairs of a drone and a touched object.
    pub contacts: usize,
}

impl Info {
    /// Returns true if a drone crashed.
    pub fn crashed(&self) -> bool {
        self.end.is_some_and(EndReason::is_crash)
    }

    /// Returns the fields by name, truth values as 0 and 1.
    pub fn values(&self) -> impl Iterator<Item = (&'static str, f64)> {
        [
            ("time", self.time),
            ("success", f64::from(u8::from(self.success))),
            ("progress", self.progress),
            ("crashed", f64::from(u8::from(self.crashed()))),
            ("position_error", self.position_error),
            ("contacts", self.contacts as f64),
        ]
        .into_iter()
    }
}

/// Outcome of an episode.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EpisodeSummary {
    /// Sum of the rewards.
    pub reward: f64,
    /// Length in control steps.
    pub steps: u64,
    /// Reason of the end; `None` while the episode runs.
    pub end: Option<EndReason>,
    /// True if every drone fulfils the task at the end.
    pub success: bool,
}

/// Gymnasium's interface: an agent resets an environment and steps it through an episode.
///
/// The environments of this crate are [`DroneEnv`]s.
///
/// ```
/// use aviary::env::Env;
/// use aviary::tasks::Hover;
///
/// let mut env = Hover::builder().build()?;
/// let mut observation = env.reset(Some(7))?.vector.clone();
/// loop {
///     let step = env.step(&[0.01; 4])?;
///     observation.copy_from_slice(&step.observation.vector);
///     if step.terminated || step.truncated {
///         break;
///     }
/// }
/// assert!(env.info().end.is_some());
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
pub trait Env {
    /// Returns the name of the task, in lower snake case.
    fn name(&self) -> &'static str;

    /// Returns the space of observations.
    fn observation_space(&self) -> &ObservationSpace;

    /// Returns the space of actions. A step clips actions to its bounds.
    fn action_space(&self) -> &BoxSpace;

    /// Starts an episode. A seed restarts every random stream; without one, the random streams continue.
    ///
    /// # Errors
    /// [`EnvError::Simulation`] if the engine cannot recover from an earlier error, [`EnvError::Option`] if the
    /// options of the task were changed to invalid ones, [`EnvError::Vision`] if the observed images cannot be
    /// rendered.
    fn reset(&mut self, seed: Option<u64>) -> Result<&Observation, EnvError>;

    /// Advances the environment by one control step.
    ///
    /// # Errors
    /// [`EnvError::ActionLength`] and [`EnvError::Action`]: the environment has not advanced.
    /// [`EnvError::NeedsReset`] outside an episode. [`EnvError::Simulation`] if the state diverged.
    /// [`EnvError::Vision`] if the observed images cannot be rendered.
    fn step(&mut self, action: &[f64]) -> Result<Step<'_>, EnvError>;

    /// Returns a copy of the state for [`restore`](Self::restore), to plan ahead or to branch.
    fn snapshot(&self) -> EnvSnapshot;

    /// Restores a snapshot of this environment, or of one with the same options. Later steps and resets are
    /// bit-identical to those after the snapshot.
    ///
    /// # Errors
    /// [`EnvError::Snapshot`] for another kind of environment, [`EnvError::SavedSnapshot`] for a file with content
    /// of another kind, and [`EnvError::Simulation`] for another [model](Simulation::restore), such as another
    /// number of drones, mass or rate. The environment is unchanged after an error.
    fn restore(&mut self, snapshot: &EnvSnapshot) -> Result<(), EnvError>;

    /// Returns the observation of the last reset or step; zeros before the first reset.
    fn observation(&self) -> &Observation;

    /// Returns the state of the episode.
    fn info(&self) -> Info;

    /// Reports the scalar metrics of the task by name: gates passed, formation error. If drones have batteries, reports
    /// their lowest charge (0 to 1) and voltage (V), and their highest current (A).
    fn metrics(&self, report: &mut dyn FnMut(&'static str, f64)) {
        let _ = report;
    }

    /// Returns the values of [`info`](Self::info) and [`metrics`](Self::metrics) by name, truth values as 0 and 1.
    /// Wrappers compute the map from these two functions: override them instead of this one.
    fn info_map(&self) -> BTreeMap<&'static str, f64> {
        let mut map: BTreeMap<_, _> = self.info().values().collect();
        self.metrics(&mut |name, value| {
            map.insert(name, value);
        });
        map
    }

    /// Renders an image for people: RGB, three bytes per pixel, top row first. The first call loads the renderer
    /// and is slow.
    ///
    /// # Errors
    /// [`EnvError::Vision`] if OpenGL is not available or the buffer has the wrong length.
    fn render(&mut self, view: View, size: ImageSize, rgb: &mut [u8]) -> Result<(), EnvError>;
}

/// An [`Env`] in which one agent commands all drones of a task.
///
/// ```
/// use aviary::env::{DroneEnv, Env};
/// use aviary::physics::wind::{WindConfig, WindModel};
/// use aviary::tasks::Hover;
///
/// let mut env = Hover::builder().build()?;
/// env.set_wind(Some(WindConfig::new(WindModel::Gust)))?;
/// env.reset(Some(1))?;
/// assert_eq!(env.reference(0).position.z, 1.0);
/// assert_eq!(env.simulation().states()[0].position.z, 0.1);
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
pub trait DroneEnv: Env {
    /// Returns the simulation.
    fn simulation(&self) -> &Simulation;

    /// Returns the meaning of the entries of an action.
    fn action_type(&self) -> ActionType;

    /// Writes the action that commands these motor speeds (rpm), for controllers, which compute motor speeds. The
    /// action is normalized or raw, according to the [action type](Self::action_type).
    ///
    /// # Errors
    /// [`EnvError::Option`] if the action type does not command single motors, [`EnvError::ActionLength`] for a
    /// wrong length.
    fn action_of_motor_speeds(&self, speeds: &[[f64; 4]], action: &mut [f64]) -> Result<(), EnvError>;

    /// Returns the number of control steps after which an episode is truncated.
    fn episode_steps(&self) -> u64;

    /// Returns the reason why the last step ended the episode for a drone, if it did.
    ///
    /// # Panics
    /// If `drone` is out of range; likewise below.
    fn drone_end(&self, drone: usize) -> Option<EndReason>;

    /// Returns the reward of a drone in the last step; 0 before the first step of an episode.
    fn drone_reward(&self, drone: usize) -> f64;

    /// Returns the terms of the reward of a drone in the last step, by name and in the unit of the reward: bonuses are
    /// positive, penalties negative. Their sum in this order is [`drone_reward`](Self::drone_reward). The documentation
    /// of every task in [`tasks`](crate::tasks) lists its terms. The list is empty before the first step of an episode,
    /// and for a task that has no [terms](Task::reward_terms). After [`restore`](Env::restore), the terms are those of
    /// the last step before the snapshot.
    ///
    /// ```
    /// use aviary::env::{DroneEnv, Env};
    /// use aviary::tasks::Formation;
    ///
    /// let mut env = Formation::builder().build()?;
    /// env.reset(Some(1))?;
    /// assert_eq!(env.reward_terms(0), []);
    /// env.step(&[0.0; 12])?;
    /// let terms = env.reward_terms(0);
    /// let names: Vec<_> = terms.iter().map(|(name, _)| *name).collect();
    /// assert_eq!(names, ["slot_error", "distance_errors", "crash"]);
    /// assert_eq!(terms.iter().map(|(_, value)| value).sum::<f64>(), env.drone_reward(0));
    /// # Ok::<(), aviary::env::EnvError>(())
    /// ```
    fn reward_terms(&self, drone: usize) -> Vec<(&'static str, f64)> {
        let _ = drone;
        Vec::new()
    }

    /// Returns the present reference. A controller that follows it fulfils the task.
    fn reference(&self, drone: usize) -> Reference;

    /// Returns the present poses of the gates of a race, in their order: the centre (world frame, m) and the direction
    /// of the normal, rad from x. The list is empty for a task without gates.
    ///
    /// ```
    /// use aviary::env::{DroneEnv, Env};
    /// use aviary::tasks::Race;
    ///
    /// let mut env = Race::builder().task(|race| race.randomization.position = 0.1).build()?;
    /// env.reset(Some(1))?;
    /// let [x, y, z, _] = env.gates()[0];
    /// assert!([x - 1.0, y, z - 1.0].into_iter().all(|offset| offset != 0.0 && offset.abs() <= 0.1));
    /// # Ok::<(), aviary::env::EnvError>(())
    /// ```
    fn gates(&self) -> Vec<[f64; 4]> {
        Vec::new()
    }

    /// Returns a trajectory that fulfils the task from the present state of a drone, for controllers; `None` if
    /// following [`reference`](Self::reference) fulfils the task.
    fn plan(&self, drone: usize) -> Option<Box<dyn Trajectory>> {
        let _ = drone;
        None
    }

    /// Returns the [`plan`](Self::plan) of every drone.
    fn plans(&self) -> Vec<Option<Box<dyn Trajectory>>> {
        (0..self.simulation().num_drones()).map(|drone| self.plan(drone)).collect()
    }

    /// Returns points (world frame, m) that drones pass in an episode, for fixed cameras: starts, references,
    /// plans.
    fn extent(&self) -> Vec<Vector3<f64>> {
        let states = self.simulation().initial_states();
        states.iter().enumerate().flat_map(|(drone, state)| [state.position, self.reference(drone).position]).collect()
    }

    /// Sets the wind from now on, also for later episodes; `None` for still air.
    ///
    /// # Errors
    /// [`EnvError::Simulation`] naming an invalid setting, [`EnvError::Option`] if the randomization samples the
    /// wind.
    fn set_wind(&mut self, wind: Option<WindConfig>) -> Result<(), EnvError>;

    /// Sets the external force on a drone (world frame, N) from the next control step on, for example a push by a
    /// person. The force acts at the centre of mass and stays constant until it is set again. The next reset removes
    /// it. [`Simulation::external_force`] returns it.
    ///
    /// ```
    /// use aviary::env::{DroneEnv, Env};
    /// use aviary::tasks::Hover;
    /// use nalgebra::Vector3;
    ///
    /// let mut env = Hover::builder().initial_positions([[0.0, 0.0, 1.0]]).build()?;
    /// env.reset(Some(1))?;
    /// env.set_external_force(0, Vector3::new(0.0, 0.02, 0.0))?;
    /// env.step(&[0.0; 4])?;
    /// assert!(env.simulation().states()[0].velocity.y > 0.01);
    /// # Ok::<(), aviary::env::EnvError>(())
    /// ```
    ///
    /// # Errors
    /// [`EnvError::Simulation`] for an index out of range or a number that is not finite. An environment of a batch
    /// has no external forces: [`VecAviary::with`](crate::vector::VecAviary::with) returns an error.
    fn set_external_force(&mut self, drone: usize, force: Vector3<f64>) -> Result<(), EnvError>;

    /// Sets the gain of a motor, a factor on its commanded speed from the next control step on. A motor that has
    /// failed has the gain 0. Rotor speeds and delayed commands stay as they are. The next reset restores the sampled
    /// or nominal gain. [`Simulation::motor_gains`] returns the gains.
    ///
    /// ```
    /// use aviary::env::{DroneEnv, EndReason, Env};
    /// use aviary::tasks::Hover;
    ///
    /// let mut env = Hover::builder().initial_positions([[0.0, 0.0, 1.0]]).build()?;
    /// env.reset(Some(1))?;
    /// env.set_motor_gain(0, 3, 0.0)?;
    /// while env.info().end.is_none() {
    ///     env.step(&[0.0; 4])?;
    /// }
    /// assert_ne!(env.info().end, Some(EndReason::TimeLimit), "three motors do not hold the attitude");
    /// # Ok::<(), aviary::env::EnvError>(())
    /// ```
    ///
    /// # Errors
    /// [`EnvError::Simulation`] for an index or a gain out of range, see [`Simulation::set_motor_gain`].
    fn set_motor_gain(&mut self, drone: usize, motor: usize, gain: f64) -> Result<(), EnvError>;

    /// Replaces the obstacles by others of the same shapes in the same order, from the next control step on. Positions
    /// (world frame, m), orientations and sizes may differ. The drones keep their states. The list does not contain
    /// the solid moving markers of the task, which are the last of [`Simulation::obstacles`]. Goals of the task, such
    /// as gates, stay where they are. The next reset restores the obstacles of the environment, or generates a new
    /// layout if every episode has one.
    ///
    /// # Errors
    /// [`EnvError::Simulation`] for another number of obstacles, another shape or a number out of range.
    /// [`EnvError::Option`] if a new obstacle overlaps the bounding sphere of a drone. The environment is unchanged
    /// after an error.
    fn set_obstacles(&mut self, obstacles: &[Obstacle]) -> Result<(), EnvError>;

    /// Replaces the generated obstacles by the layout of a seed around the present positions of the drones, as
    /// [`set_obstacles`](Self::set_obstacles) does. The layout keeps the [safe
    /// zone](crate::world::ObstacleConfig::safe_zone) around every drone free. The random stream of the environment
    /// does not change.
    ///
    /// ```
    /// use aviary::env::{DroneEnv, Env};
    /// use aviary::tasks::Hover;
    /// use aviary::world::{ObstacleConfig, ObstacleKind};
    ///
    /// let mut env = Hover::builder().obstacle_generator(ObstacleConfig::new(ObstacleKind::Forest)).build()?;
    /// env.reset(Some(1))?;
    /// let before = env.simulation().obstacles().to_vec();
    /// env.new_obstacles(7)?;
    /// assert_ne!(env.simulation().obstacles(), before);
    /// env.reset(None)?;
    /// assert_eq!(env.simulation().obstacles(), before);
    /// # Ok::<(), aviary::env::EnvError>(())
    /// ```
    ///
    /// # Errors
    /// [`EnvError::Option`] for an environment without an obstacle generator or with a custom list of obstacles.
    /// [`EnvError::Field`] if the obstacles do not fit around the drones. The environment is unchanged after an error.
    fn new_obstacles(&mut self, seed: u64) -> Result<(), EnvError>;

    /// Sets the parameters that are sampled for every episode from the next reset on; `None` for nominal values.
    ///
    /// # Errors
    /// [`EnvError::Option`] naming an invalid range, or for a wind that the samples would replace.
    fn set_randomization(&mut self, randomization: Option<Randomization>) -> Result<(), EnvError>;

    /// Changes target heights, from the next step on, also for later episodes. Options that are `None` stay the same.
    ///
    /// ```
    /// use aviary::env::{DroneEnv, Env, EnvConfig, TaskOptions};
    /// use aviary::tasks::make;
    ///
    /// let mut env = make("hover", EnvConfig::default())?;
    /// env.reset(Some(1))?;
    /// env.set_task_options(&TaskOptions { target_height: Some(0.1), ..TaskOptions::default() })?;
    /// assert!(env.step(&[0.0; 4])?.reward > 0.4, "at the new target");
    /// # Ok::<(), aviary::env::EnvError>(())
    /// ```
    ///
    /// # Errors
    /// [`EnvError::TaskOption`] for an option that the task does not have, [`EnvError::Option`] for an invalid value or
    /// for an option that is not a target height. The environment is unchanged after an error.
    fn set_task_options(&mut self, options: &TaskOptions) -> Result<(), EnvError> {
        options.check(self.name(), &[])
    }

    /// Returns the options of the task that can be set by name, with their present values.
    fn task_options(&self) -> TaskOptions {
        TaskOptions::default()
    }

    /// Returns the sampled parameters of this episode; `None` without randomization.
    fn sampled_params(&self) -> Option<&SampledParams>;

    /// Returns true if an entry of the observation vector may be constant during an episode, like a target.
    fn may_be_constant(&self, entry: usize) -> bool {
        let _ = entry;
        false
    }
}
