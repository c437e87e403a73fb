//! A batch of 2,048 Crazyflies with randomized airframes, which hold 1 m under one proportional-derivative law.
//!
//! `cargo run --release --example batch -- [DIRECTORY] [SECONDS] [ENVIRONMENTS]` writes `batch.svg`: quantiles of the
//! heights over time. Defaults: directory `out/batch`, 10 s, 2,048 environments.

use std::time::Instant;

use mujoco_drones_gym::env::Randomization;
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::record::plot::{Plot, Series};

#[allow(clippy::print_stdout)]
fn main() -> anyhow::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let directory = std::path::PathBuf::from(arguments.next().unwrap_or_else(|| "out/batch".into()));
    let seconds: f64 = arguments.next().map_or(Ok(10.0), |text| text.parse())?;
    let environments: usize = arguments.next().map_or(Ok(2048), |text| text.parse())?;
    std::fs::create_dir_all(&directory)?;

    let bodies = Randomization { actuators: None, sensors: None, environment: None, ..Randomization::default() };
    let builder = Hover::builder()
        .initial_positions([[0.0, 0.0, 1.0]])
        .randomization(Randomization { initial: None, ..bodies })
        .episode_seconds(seconds + 1.0);
    let mut env = VecAviary::new(builder, VecConfig::new(environments))?;
    let mut buffers = VecBuffers::new(&env);
    let mut actions = vec![0.0_f32; environments * env.action_size()];
    let size = env.observation_size();
    env.reset(Some(1), &mut buffers.observations)?;

    let quantiles = [("95 %", 0.95), ("75 %", 0.75), ("median", 0.5), ("25 %", 0.25), ("5 %", 0.05)];
    let mut lines = quantiles.map(|(name, _)| Series { name: name.into(), points: vec![] });
    let (steps, mut spent) = ((48.0 * seconds) as usize, 0.0);
    for step in 0..=steps {
        let mut heights: Vec<f32> = buffers.observations.chunks_exact(size).map(|observation| observation[2]).collect();
        heights.sort_by(f32::total_cmp);
        for (line, (_, share)) in lines.iter_mut().zip(quantiles) {
            let height = heights[(share * (environments - 1) as f64).round() as usize];
            line.points.push((step as f64 / 48.0, height.into()));
        }
        for (action, observation) in actions.chunks_exact_mut(4).zip(buffers.observations.chunks_exact(size)) {
            action.fill(0.5 * (1.0 - observation[2]) - 0.4 * observation[8]);
        }
        let start = Instant::now();
        env.step(&actions, buffers.step())?;
        spent += start.elapsed().as_secs_f64();
    }
    let title = format!("{environments} drones with randomized mass, inertia, arms and rotors");
    let path = directory.join("batch.svg");
    Plot::time_series(&title, &[("height (m)", lines.to_vec())])?.save(&path)?;
    println!("{}", path.display());
    let count = environments as f64 * (steps + 1) as f64;
    println!("{:.2} million environment steps per second", 1e-6 * count / spent);
    let substeps = env.engine_substeps();
    println!("{} of {} physics steps by the flight kernel", substeps.flight, substeps.flight + substeps.mujoco);
    Ok(())
}
