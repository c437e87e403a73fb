use anyhow::anyhow;
use clap::Args;
use serde_json::json;

use crate::failure::Failure;
use crate::output;

/// What the program needs from this machine, and whether it is there
#[derive(Debug, Args)]
pub struct Doctor {
    /// Print JSON instead of a table
    #[arg(long)]
    json: bool,
}

impl Doctor {
    pub fn run(&self) -> Result<(), Failure> {
        let checked = mujoco_rs::check_library();
        let [major, minor, patch] = mujoco_rs::library_version();
        let version = format!("{major}.{minor}.{patch}");
        if self.json {
            output::print_json(&json!({ "mujoco_version": version, "ok": checked.is_ok() }))?;
        } else {
            let answer = match &checked {
                Ok(()) => "works".to_string(),
                Err(error) => error.to_string(),
            };
            output::print(&output::table(&[("MuJoCo", version), ("library", answer)]))?;
        }
        checked.map_err(|error| Failure::work(anyhow!("{error}: run ./setup and build again")))
    }
}
