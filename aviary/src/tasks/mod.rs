//! The tasks, one file each. `make` has them by name.

mod antipodal;
mod conditions;
mod course;
mod fly_through;
mod formation;
mod hover;
mod multi_hover;
mod race;
mod stabilize;
mod track;
mod velocity;

use std::f64::consts::{FRAC_PI_2, PI};

pub use antipodal::Antipodal;
pub use conditions::{CrashConditions, CrashWatch};
pub use fly_through::FlyThrough;
pub use formation::Formation;
pub use hover::{Hover, hover_reward};
pub use multi_hover::MultiHover;
pub use race::Race;
pub use stabilize::Stabilize;
pub use track::Track;
pub use velocity::Velocity;

use crate::drone::DroneParams;
use crate::env::{Env, EnvConfig, EnvError, Task, TaskDefaults};
use crate::observation::STATE_SIZE;

/// No bound.
const UNBOUNDED: [f64; 2] = [f64::NEG_INFINITY, f64::INFINITY];

/// Bounds of [`state_vector`](crate::observation::state_vector): angles have some, the rest has none.
const STATE_BOUNDS: [[f64; 2]; STATE_SIZE] = {
    let mut bounds = [UNBOUNDED; STATE_SIZE];
    bounds[3] = [-PI, PI];
    bounds[4] = [-FRAC_PI_2, FRAC_PI_2];
    bounds[5] = [-PI, PI];
    bounds
};

/// Starts on a line along −y from (0, 0, 0.1) m, with room between the drones.
fn side_by_side(drones: &[DroneParams]) -> Vec<[f64; 3]> {
    let widest = drones.iter().map(|params| params.collision_radius).fold(0.0, f64::max);
    let spacing = (4.0 * widest).max(1.0);
    (0..drones.len()).map(|drone| [0.0, -spacing * drone as f64, 0.1]).collect()
}

/// What a list of tasks says of one.
#[derive(Debug, Clone, PartialEq)]
pub struct TaskSummary {
    /// Name, in lower snake case.
    pub name: &'static str,
    /// What it starts from.
    pub defaults: TaskDefaults,
    /// Numbers in the observation of one drone.
    pub observation_per_drone: usize,
    /// Whether every drone is an agent of its own, with its own action and observation.
    pub multi_agent: bool,
}

impl TaskSummary {
    /// Numbers in an observation, of one agent where there are several.
    pub fn observation_size(&self) -> usize {
        self.observation_per_drone * self.blocks()
    }

    /// Numbers in an action by motor speeds, of one agent where there are several.
    pub fn action_size(&self) -> usize {
        4 * self.blocks()
    }

    fn blocks(&self) -> usize {
        if self.multi_agent { 1 } else { self.defaults.num_drones }
    }
}

/// Something done for the task of a name, with the type that it has.
macro_rules! for_task {
    ($name:expr, |$task:ident| $body:expr) => {
        match $name {
            "hover" => Some({
                let $task = $crate::tasks::Hover::default();
                $body
            }),
            "velocity" => Some({
                let $task = $crate::tasks::Velocity::default();
                $body
            }),
            "multi_hover" => Some({
                let $task = $crate::tasks::MultiHover::default();
                $body
            }),
            "fly_through" => Some({
                let $task = $crate::tasks::FlyThrough::default();
                $body
            }),
            "formation" => Some({
                let $task = $crate::tasks::Formation::default();
                $body
            }),
            "race" => Some({
                let $task = $crate::tasks::Race::default();
                $body
            }),
            "multi_agent" => Some({
                let $task = $crate::tasks::MultiHover::multi_agent();
                $body
            }),
            "antipodal" => Some({
                let $task = $crate::tasks::Antipodal::default();
                $body
            }),
            "stabilize" => Some({
                let $task = $crate::tasks::Stabilize::default();
                $body
            }),
            "track" => Some({
                let $task = $crate::tasks::Track::default();
                $body
            }),
            _ => None,
        }
    };
}

pub(crate) use for_task;

/// Names of all tasks, the paper's seven first.
pub const NAMES: [&str; 10] = [
    "hover",
    "velocity",
    "multi_hover",
    "fly_through",
    "formation",
    "race",
    "multi_agent",
    "antipodal",
    "stabilize",
    "track",
];

/// All tasks, with their defaults.
pub fn all() -> Vec<TaskSummary> {
    NAMES.iter().filter_map(|name| summary(name)).collect()
}

/// The task of a name, with its defaults.
///
/// ```
/// use aviary::tasks::summary;
///
/// let sizes = summary("formation").map(|task| (task.observation_size(), task.action_size()));
/// assert_eq!(sizes, Some((3 * 18, 3 * 4)));
/// assert!(summary("loop").is_none());
/// ```
pub fn summary(name: &str) -> Option<TaskSummary> {
    for_task!(name, |task| TaskSummary {
        name: task.name(),
        defaults: task.defaults(),
        observation_per_drone: task.observation_space().size(),
        multi_agent: task.name() == "multi_agent",
    })
}

/// Makes the environment of a task by name. (`multi_agent` is one agent's view of it; the agents' own is a
/// [`ParallelAviary`](crate::multi_agent::ParallelAviary).)
///
/// ```
/// use aviary::env::EnvConfig;
/// use aviary::tasks::make;
///
/// let mut env = make("race", EnvConfig::default().ctrl_freq(60))?;
/// assert_eq!(env.reset(Some(1))?.vector.len(), 21);
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
///
/// # Errors
/// [`EnvError::Option`] for a name that no task has, and what building it finds.
pub fn make(name: &str, config: EnvConfig) -> Result<Box<dyn Env + Send>, EnvError> {
    for_task!(name, |task| Ok(Box::new(config.with_task(task).build()?) as Box<dyn Env + Send>))
        .unwrap_or_else(|| Err(unknown(name)))
}

pub(crate) fn unknown(name: &str) -> EnvError {
    let expected = NAMES.join(", ") + &crate::did_you_mean(name, &NAMES);
    EnvError::UnknownTask { name: name.to_string(), expected }
}
