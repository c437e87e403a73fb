//! Tasks, one file each. [`make`] creates the environment of a task by name.

mod antipodal;
mod base;
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
mod waypoint_progress;

use std::f64::consts::{FRAC_PI_2, PI};

pub use antipodal::Antipodal;
pub use base::Base;
pub use conditions::{CrashConditions, CrashWatch};
pub use course::Course;
pub use fly_through::FlyThrough;
pub use formation::Formation;
pub use hover::{Hover, hover_reward};
pub use multi_hover::MultiHover;
pub use race::{Gate, GateMotion, GateRanges, Race, RaceTrack};
pub use stabilize::Stabilize;
pub use track::Track;
pub use velocity::Velocity;

use flight::math::V3;

use crate::UnknownName;
use crate::drone::DroneParams;
use crate::env::{DroneEnv, EnvConfig, EnvError, Task, TaskDefaults};
use crate::math::ToFlight as _;
use crate::observation::STATE_SIZE;
use crate::simulation::SimView;
use crate::state::FlightState;
use crate::world::placement::max_collision_radius;

/// Implements [`Task::save`] and [`Task::load`] for a task that implements serde's traits.
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

/// Bounds of an unbounded entry.
const UNBOUNDED: [f64; 2] = [f64::NEG_INFINITY, f64::INFINITY];

/// Bounds of [`state_vector`](crate::observation::state_vector): only the angles are bounded.
const STATE_BOUNDS: [[f64; 2]; STATE_SIZE] = {
    let mut bounds = [UNBOUNDED; STATE_SIZE];
    bounds[3] = [-PI, PI];
    bounds[4] = [-FRAC_PI_2, FRAC_PI_2];
    bounds[5] = [-PI, PI];
    bounds
};

/// Returns the state of a drone, and its roll, pitch and yaw, rad.
fn observed(simulation: SimView<'_>, drone: usize) -> (FlightState<f64>, V3<f64>) {
    (FlightState::from(&simulation.states()[drone]), simulation.rpy(drone).to_flight())
}

/// Returns initial positions in a row along −y from (0, 0, 0.1) m, with room between the drones.
fn row_along_y(drones: &[DroneParams]) -> Vec<[f64; 3]> {
    let widest = max_collision_radius(drones);
    let spacing = (4.0 * widest).max(1.0);
    (0..drones.len()).map(|drone| [0.0, -spacing * drone as f64, 0.1]).collect()
}

/// Summary of a task for lists.
#[derive(Debug, Clone, PartialEq)]
pub struct TaskSummary {
    /// Name, in lower snake case.
    pub name: &'static str,
    /// Goal of the task, in a few words.
    pub description: &'static str,
    /// Default options of the environment.
    pub defaults: TaskDefaults,
    /// Number of entries in the observation of one drone.
    pub observation_per_drone: usize,
    /// True if every drone is an agent with its own action and observation.
    pub multi_agent: bool,
    /// True if an episode may start from states sampled around the task's initial states.
    pub varied_starts: bool,
}

impl TaskSummary {
    /// Returns the number of entries in the observation: of one agent if the task is multi-agent.
    pub fn observation_size(&self) -> usize {
        self.observation_per_drone * self.blocks()
    }

    /// Returns the number of motor speeds in an action: of one agent if the task is multi-agent.
    pub fn action_size(&self) -> usize {
        4 * self.blocks()
    }

    fn blocks(&self) -> usize {
        if self.multi_agent { 1 } else { self.defaults.num_drones }
    }
}

/// Passes the list of tasks, the paper's seven first, to a macro: name, constructor, whether every drone is an
/// agent, whether initial states may be sampled, and description. All other lists of tasks follow from this one.
macro_rules! with_tasks {
    ($then:ident!($($argument:tt)*)) => {
        $then! {
            ($($argument)*)
            "hover" => $crate::tasks::Hover::default(), false, true,
                "take off and hover at 1 m";
            "velocity" => $crate::tasks::Velocity::default(), false, true,
                "track a random velocity and yaw rate";
            "multi_hover" => $crate::tasks::MultiHover::default(), false, true,
                "take off, each drone to its own height";
            "fly_through" => $crate::tasks::FlyThrough::default(), false, true,
                "visit five waypoints";
            "formation" => $crate::tasks::Formation::default(), false, true,
                "keep a circular formation with a moving centre";
            "race" => $crate::tasks::Race::default(), false, true,
                "fly two laps through six gates";
            "multi_agent" => $crate::tasks::MultiHover::multi_agent(), true, true,
                "multi_hover with one agent per drone";
            // no sampled starts: its drones start close to the safety radius
            "antipodal" => $crate::tasks::Antipodal::default(), false, false,
                "swap places across a circle at a safe distance";
            "stabilize" => $crate::tasks::Stabilize::default(), false, true,
                "come to rest from a random motion";
            "track" => $crate::tasks::Track::default(), false, true,
                "follow a point on a circle";
        }
    };
}

pub(crate) use with_tasks;

/// Lists the names of the tasks.
macro_rules! names {
    (() $($name:literal => $new:expr, $multi_agent:literal, $varied:literal, $description:literal;)+) => {
        [$($name),+]
    };
}

/// Evaluates an expression with the task of the given name, in its concrete type.
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
            $crate::tasks::BASE => Ok({
                let $task = $crate::tasks::Base::default();
                $body
            }),
            other => Err($crate::tasks::unknown(other)),
        }
    };
    ($name:expr, |$task:ident| $body:expr) => {
        $crate::tasks::with_tasks!(for_task!(@ $name, $task, $body))
    };
}

pub(crate) use for_task;

/// Name of the environment without a task, [`Base`], for [`make`] and its siblings for batches and agents.
pub const BASE: &str = "base";

/// Names of all tasks, the paper's seven first.
pub const NAMES: [&str; with_tasks!(names!()).len()] = with_tasks!(names!());

/// Returns the summaries of all tasks.
pub fn all() -> Vec<TaskSummary> {
    NAMES.iter().filter_map(|name| summary(name).ok()).collect()
}

/// Returns the summary of a task by name.
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
/// [`UnknownName`] for an unknown name.
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

/// Creates the environment of a task by name, or with the name [`BASE`] the environment without a task. The
/// [options of the task](crate::env::TaskOptions) are part of the configuration. `multi_agent` has a single agent for
/// all drones here; a [`ParallelAviary`](crate::multi_agent::ParallelAviary) has one agent per drone.
///
/// ```
/// use aviary::env::EnvConfig;
/// use aviary::tasks::make;
///
/// let mut env = make("race", EnvConfig::default().ctrl_freq(60))?;
/// assert_eq!(env.reset(Some(1))?.vector.len(), 21);
/// let env = make("race", EnvConfig::default().task(|options| options.laps = Some(1)))?;
/// assert_eq!(env.task_options().laps, Some(1));
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
///
/// # Errors
/// [`EnvError::UnknownName`] for an unknown name, [`EnvError::TaskOption`] for an option of another task, and the
/// errors of [`AviaryBuilder::build`](crate::env::AviaryBuilder::build).
pub fn make(name: &str, config: EnvConfig) -> Result<Box<dyn DroneEnv + Send>, EnvError> {
    for_task!(name, |task| Box::new(config.for_task(task)?.build()?) as Box<dyn DroneEnv + Send>)
        .map_err(EnvError::from)
}

#[cfg(test)]
mod tests;

pub(crate) fn unknown(name: &str) -> UnknownName {
    UnknownName { noun: "task", name: name.into(), names: &NAMES }
}
