use clap::Args;
use serde_json::json;

use crate::failure::Failure;
use crate::output;

/// List the tasks with their observation and action sizes
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  aviary tasks
  aviary tasks --json")]
pub struct Tasks {
    /// JSON output instead of a table
    #[arg(long)]
    json: bool,
}

impl Tasks {
    pub fn run(&self) -> Result<(), Failure> {
        let tasks = aviary::tasks::all();
        if self.json {
            let list: Vec<_> = tasks
                .iter()
                .map(|task| {
                    json!({
                        "name": task.name,
                        "description": task.description,
                        "drones": task.defaults.num_drones,
                        "episode_seconds": task.defaults.episode_seconds,
                        "observation_size": task.observation_size(),
                        "action_size": task.action_size(),
                        "per_agent": task.multi_agent,
                        "controller": task.defaults.controller.name(),
                    })
                })
                .collect();
            return output::print_json(&json!(list));
        }
        let mut text = format!(
            "{:<13}{:>7}{:>13}{:>15}{:>15}  {:<11}{}\n",
            "task", "drones", "episode (s)", "action", "observation", "controller", "goal"
        );
        for task in tasks {
            let drones = task.defaults.num_drones;
            let size = |total: usize| match task.multi_agent {
                true => format!("{total} per agent"),
                false if drones == 1 => total.to_string(),
                false => format!("{total} = {}N", total / drones),
            };
            text += &format!(
                "{:<13}{:>7}{:>13}{:>15}{:>15}  {:<11}{}\n",
                task.name,
                drones,
                task.defaults.episode_seconds,
                size(task.action_size()),
                size(task.observation_size()),
                task.defaults.controller,
                task.description
            );
        }
        output::print(&text)
    }
}
