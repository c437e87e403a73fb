//! Model-predictive path integral control (Williams et al. 2017, *Information-theoretic model predictive control*).
//! It flies a Crazyflie to a waypoint by sampling flights from snapshots of the environment.
//!
//! `cargo run --release --example mppi`

use std::time::{Duration, Instant};

use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::{Rng, RngExt as _, SeedableRng as _};
use nalgebra::Vector3;

const SAMPLES: usize = 64;
/// Control steps of the prediction horizon: 1 s.
const HORIZON: usize = 48;
/// Temperature of the weights, in units of the cost.
const TEMPERATURE: f64 = 0.01;
/// Standard deviations of the sampled thrust, roll, pitch and yaw rate, in normalized units.
const SPREAD: [f64; 4] = [0.25, 0.35, 0.35, 0.05];

fn cost(env: &dyn DroneEnv, goal: &Vector3<f64>) -> f64 {
    let state = &env.simulation().states()[0];
    let crash = if env.info().end.is_some_and(|end| end.is_crash()) { 100.0 } else { 0.0 };
    (state.position - goal).norm() + 0.12 * state.velocity.norm() + 0.02 * state.angular_velocity.norm() + crash
}

#[allow(clippy::print_stdout)]
fn main() -> Result<(), EnvError> {
    let goal = Vector3::new(1.0, -0.5, 1.5);
    let hover = Hover::builder().action_type(ActionType::Attitude).engine(EngineKind::Hybrid).episode_seconds(6.0);
    let mut env = hover.initial_positions([[0.0, 0.0, 0.5]]).build()?;
    let mut rng = Rng::seed_from_u64(1);
    let mut plan = [[0.0; 4]; HORIZON];
    let (mut snapshots, mut restores, start) = (Duration::ZERO, Duration::ZERO, Instant::now());
    env.reset(Some(1))?;
    while env.info().end.is_none() {
        let begin = Instant::now();
        let snapshot = env.snapshot();
        snapshots += begin.elapsed();
        let mut samples = Vec::with_capacity(SAMPLES);
        for _ in 0..SAMPLES {
            let begin = Instant::now();
            env.restore(&snapshot)?;
            restores += begin.elapsed();
            // the noise is constant over four control steps; twelve uniform numbers approximate a normal one
            let mut noise = [[0.0; 4]; HORIZON];
            for part in noise.chunks_mut(4) {
                part.fill(SPREAD.map(|sigma| sigma * (0..12).map(|_| rng.random::<f64>() - 0.5).sum::<f64>()));
            }
            let mut sum = 0.0;
            for (planned, noise) in plan.iter().zip(&noise) {
                let action: [f64; 4] = std::array::from_fn(|i| (planned[i] + noise[i]).clamp(-1.0, 1.0));
                if env.info().end.is_none() {
                    env.step(&action)?;
                }
                sum += cost(&env, &goal);
            }
            samples.push((sum / HORIZON as f64, noise));
        }
        let best = samples.iter().map(|(cost, _)| *cost).fold(f64::INFINITY, f64::min);
        let weight = |cost: f64| (-(cost - best) / TEMPERATURE).exp();
        let total: f64 = samples.iter().map(|(cost, _)| weight(*cost)).sum();
        for (cost, noise) in &samples {
            for (planned, noise) in plan.iter_mut().zip(noise) {
                (0..4).for_each(|i| planned[i] = (planned[i] + weight(*cost) / total * noise[i]).clamp(-1.0, 1.0));
            }
        }
        env.restore(&snapshot)?;
        env.step(&plan[0])?;
        plan.rotate_left(1);
        plan[HORIZON - 1] = plan[HORIZON - 2];
    }
    let (steps, error) = (env.simulation().control_steps(), (env.simulation().states()[0].position - goal).norm());
    println!("{error:.3} m from the waypoint after {} s", env.simulation().time());
    let sampled = (steps * (SAMPLES * HORIZON) as u64) as f64 / start.elapsed().as_secs_f64();
    let [taken, restored] = [(snapshots, steps), (restores, steps * SAMPLES as u64)]
        .map(|(duration, count)| duration.as_nanos() as f64 / count as f64);
    println!("{sampled:.0} sampled steps per second; a snapshot takes {taken:.0} ns, a restore {restored:.0} ns");
    Ok(())
}
