//! A trained policy flies two laps of Race from its file, without the trainer.
//!
//! `cargo run --release --example policy -- [DIRECTORY] [POLICY.safetensors]` writes the path as `path.png` and prints
//! the time of each gate. Defaults: directory `out/policy`, policy `assets/policies/race.safetensors`.

use mujoco_drones_gym::env::EnvConfig;
use mujoco_drones_gym::policy::PolicyNetwork;
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::record::Flight;
use mujoco_drones_gym::record::plot::Plot;

#[allow(clippy::print_stdout)]
fn main() -> anyhow::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let directory = std::path::PathBuf::from(arguments.next().unwrap_or_else(|| "out/policy".into()));
    let known = concat!(env!("CARGO_MANIFEST_DIR"), "/assets/policies/race.safetensors");
    let policy = PolicyNetwork::load(arguments.next().unwrap_or_else(|| known.into()))?;
    std::fs::create_dir_all(&directory)?;

    let info = policy.info();
    let options = EnvConfig::default().drone(info.drone.parse::<DroneModel>()?).ctrl_freq(info.ctrl_freq);
    let env = make(&info.task, options)?;
    println!("{} steps of training by `{}`", info.steps, info.command);

    let mut flight = Flight::default();
    let mut progress = 0.0;
    let mut rollout = Rollout::start(env, policy.pilot(), Some(1))?;
    flight.note(rollout.env());
    let summary = rollout.finish(|env| {
        flight.note(env);
        if env.info().progress > progress {
            progress = env.info().progress;
            println!("{:5.2} s  {:3.0} %", env.info().time, 100.0 * progress);
        }
    })?;
    println!("success: {} after {:.2} s", summary.success, rollout.env().info().time);
    Plot::of_paths(&format!("{} by a trained policy", info.task), &flight)?.save(directory.join("path.png"))?;
    Ok(())
}
