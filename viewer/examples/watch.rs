//! Shows a hover that the program steps itself.

use aviary::control::ControllerKind;
use aviary::env::{DroneEnv as _, EnvConfig};
use aviary::rollout::{ControllerPolicy, Rollout};
use viewer::{Viewer, ViewerOptions};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let task = std::env::args().nth(1).unwrap_or("hover".into());
    let env = aviary::tasks::make(&task, EnvConfig::default())?;
    let policy = ControllerPolicy::new(ControllerKind::Geometric, &env);
    let mut rollout = Rollout::start(env, policy, Some(1))?;
    let mut viewer = Viewer::open(rollout.env(), ViewerOptions::default())?;
    let period = std::time::Duration::from_secs_f64(rollout.env().simulation().control_period());
    while viewer.sync(rollout.env())? {
        if rollout.is_over() {
            rollout.restart(None)?;
        } else {
            rollout.step()?;
        }
        std::thread::sleep(period);
    }
    Ok(())
}
