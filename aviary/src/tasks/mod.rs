//! The tasks, one file each. `make` has them by name.

mod antipodal;
mod conditions;
mod fly_through;
mod formation;
mod hover;
mod multi_hover;
mod race;
mod stabilize;
mod track;
mod velocity;
mod waypoint_progress;

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

use crate::UnknownName;
use crate::drone::DroneParams;
use crate::env::{DroneEnv, EnvConfig, EnvError, Task, TaskDefaults};
use crate::observation::STATE_SIZE;
use crate::world::placement::max_collision_radius;

/// [`Task::save`] and [`Task::load`] of a task that implements serde's traits.
macro_rules! saved_by_serde {
    () => {
        fn save(&self) -> Option<$crate::env::Saved> {
            $crate::env::Saved::new(self)
        }

        fn load(&mut self, saved: &$crate::env::Saved) -> Result<(), $crate::env::EnvError> {
            *self = saved.read()?;
            Ok(())
        }
    };
}
use saved_by_serde;

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
    let widest = max_collision_radius(drones);
    let spacing = (4.0 * widest).max(1.0);
    (0..drones.len()).map(|drone| [0.0, -spacing * drone as f64, 0.1]).collect()
}

/// What a list of tasks says of one.
#[derive(Debug, Clone, PartialEq)]
pub struct TaskSummary {
    /// Name, in lower snake case.
    pub name: &'static str,
    /// What a pilot is asked to do.
    pub description: &'static str,
    /// What it starts from.
    pub defaults: TaskDefaults,
    /// Numbers in the observation of one drone.
    pub observation_per_drone: usize,
    /// Whether every drone is an agent of its own, with its own action and observation.
    pub multi_agent: bool,
    /// Whether episodes may start from states sampled about the task's own start.
    pub varied_starts: bool,
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

/// The list of tasks, the paper's seven first, given to a macro: name, constructor, whether every drone is an agent of its own,
/// whether starts may be sampled about the task's own, and what a pilot is asked to do. Whatever goes through all tasks follows
/// from this list.
macro_rules! with_tasks {
    ($then:ident!($($argument:tt)*)) => {
        $then! {
            ($($argument)*)
            "hover" => $crate::tasks::Hover::default(), false, true, "take off and stay at 1 m";
            "velocity" => $crate::tasks::Velocity::default(), false, true, "fly at a velocity and yaw rate drawn for the episode";
            "multi_hover" => $crate::tasks::MultiHover::default(), false, true, "take off, each to its own height";
            "fly_through" => $crate::tasks::FlyThrough::default(), false, true, "visit five waypoints";
            "formation" => $crate::tasks::Formation::default(), false, true, "keep a circle whose middle moves";
            "race" => $crate::tasks::Race::default(), false, true, "two laps through six gates";
            "multi_agent" => $crate::tasks::MultiHover::multi_agent(), true, true, "multi_hover, every drone an agent";
            // its drones start close to their safety radius
            "antipodal" => $crate::tasks::Antipodal::default(), false, false, "swap places across a circle without coming near each other";
            "stabilize" => $crate::tasks::Stabilize::default(), false, true, "come to rest from a random motion";
            "track" => $crate::tasks::Track::default(), false, true, "follow a point that goes round in a circle";
        }
    };
}

pub(crate) use with_tasks;

/// The names of the list.
macro_rules! names {
    (() $($name:literal => $new:expr, $multi_agent:literal, $varied:literal, $description:literal;)+) => { [$($name),+] };
}

/// Evaluates an expression for the task of a name, with the type that the task has.
macro_rules! for_task {
    (
        (@ $name:expr, $task:ident, $body:expr)
        $($known:literal => $new:expr, $multi_agent:literal, $varied:literal, $description:literal;)+
    ) => {
        match $name {
            $($known => Ok({
                let $task = $new;
                $body
            }),)+
            other => Err($crate::tasks::unknown(other)),
        }
    };
    ($name:expr, |$task:ident| $body:expr) => {
        $crate::tasks::with_tasks!(for_task!(@ $name, $task, $body))
    };
}

pub(crate) use for_task;

/// Names of all tasks, the paper's seven first.
pub const NAMES: [&str; with_tasks!(names!()).len()] = with_tasks!(names!());

/// Summaries of all tasks.
pub fn all() -> Vec<TaskSummary> {
    NAMES.iter().filter_map(|name| summary(name).ok()).collect()
}

/// Summary of the task of a name.
///
/// ```
/// use aviary::tasks::summary;
///
/// let formation = summary("formation")?;
/// assert_eq!((formation.observation_size(), formation.action_size()), (3 * 18, 3 * 4));
/// assert!(summary("formtion").unwrap_err().to_string().ends_with("; did you mean `formation`?"));
/// # Ok::<(), aviary::UnknownName>(())
/// ```
///
/// # Errors
/// A name that no task has.
pub fn summary(name: &str) -> Result<TaskSummary, UnknownName> {
    macro_rules! summaries {
        (() $($name:literal => $new:expr, $multi_agent:literal, $varied:literal, $description:literal;)+) => {
            match name {
                $($name => {
                    let task = $new;
                    Ok(TaskSummary {
                        name: $name,
                        description: $description,
                        defaults: task.defaults(),
                        observation_per_drone: task.observation_space().size(),
                        multi_agent: $multi_agent,
                        varied_starts: $varied,
                    })
                })+
                _ => Err(unknown(name)),
            }
        };
    }
    with_tasks!(summaries!())
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
/// [`EnvError::UnknownName`], and what building it finds.
pub fn make(name: &str, config: EnvConfig) -> Result<Box<dyn DroneEnv + Send>, EnvError> {
    for_task!(name, |task| Box::new(config.with_task(task).build()?) as Box<dyn DroneEnv + Send>)
        .map_err(EnvError::from)
}

pub(crate) fn unknown(name: &str) -> UnknownName {
    UnknownName { noun: "task", name: name.into(), names: &NAMES }
}
