//! The tasks, one file each.

mod conditions;
mod hover;

pub use conditions::CrashConditions;
pub use hover::Hover;

use crate::env::Task;

/// What a list of tasks says of one.
#[derive(Debug, Clone, PartialEq)]
pub struct TaskSummary {
    /// Name, in lower snake case.
    pub name: &'static str,
    /// Number of drones by default.
    pub drones: usize,
    /// Length of an episode by default, s.
    pub episode_seconds: f64,
    /// Numbers in an observation.
    pub observation_size: usize,
    /// Numbers in an action.
    pub action_size: usize,
}

impl TaskSummary {
    fn of(task: &impl Task) -> Self {
        let defaults = task.defaults();
        Self {
            name: task.name(),
            drones: defaults.num_drones,
            episode_seconds: defaults.episode_seconds,
            observation_size: task.observation_space(defaults.num_drones).size(),
            action_size: 4 * defaults.num_drones,
        }
    }
}

/// All tasks, with their defaults.
pub fn all() -> Vec<TaskSummary> {
    vec![TaskSummary::of(&Hover::default())]
}
