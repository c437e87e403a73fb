use clap::Args;
use serde_json::json;

use crate::failure::Failure;
use crate::output;

/// The tasks, with observation and action sizes, episode length and number of drones
#[derive(Debug, Args)]
pub struct Tasks {
    /// Print JSON instead of a table
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
                        "drones": task.drones,
                        "episode_seconds": task.episode_seconds,
                        "observation_size": task.observation_size,
                        "action_size": task.action_size,
                    })
                })
                .collect();
            return output::print_json(&json!(list));
        }
        let mut text =
            format!("{:<14}{:>7}{:>13}{:>13}{:>8}\n", "task", "drones", "episode (s)", "observation", "action");
        for task in tasks {
            text += &format!(
                "{:<14}{:>7}{:>13}{:>13}{:>8}\n",
                task.name, task.drones, task.episode_seconds, task.observation_size, task.action_size
            );
        }
        output::print(&text)
    }
}
