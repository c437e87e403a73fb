//! A complete custom task, checked by `check_env`: `cargo run --release --example custom_task`

use mujoco_drones_gym::env::{AviaryBuilder, BoxSpace, EndReason, TaskDefaults, check_env};
use mujoco_drones_gym::observation::{STATE_SIZE, state_vector};
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::{Rng, RngExt};
use nalgebra::Vector3;

/// Task to land softly on a pad with a random position in each episode.
#[derive(Debug, Clone, Default)]
struct Land {
    pad: Vector3<f64>,
    landed: bool,
}

impl Task for Land {
    fn name(&self) -> &'static str {
        "land"
    }

    fn defaults(&self) -> TaskDefaults {
        TaskDefaults { num_drones: 1, episode_seconds: 10.0, controller: ControllerKind::Dsl }
    }

    fn initial_positions(&self, drones: &[DroneParams]) -> Vec<[f64; 3]> {
        vec![[0.0, 0.0, 1.0]; drones.len()]
    }

    fn observation_space(&self) -> BoxSpace {
        BoxSpace::new([[f64::NEG_INFINITY, f64::INFINITY]; STATE_SIZE + 2])
    }

    fn reset(&mut self, _simulation: SimView<'_>, rng: &mut Rng) {
        self.pad = Vector3::new(rng.random_range(-0.5..0.5), rng.random_range(-0.5..0.5), 0.0);
        self.landed = false;
    }

    fn update(&mut self, simulation: SimView<'_>) {
        self.landed = !simulation.contacts().is_empty();
    }

    fn end(&self, simulation: SimView<'_>, drone: usize) -> Option<EndReason> {
        let hard = simulation.states()[drone].velocity.norm() > 0.5;
        self.landed.then_some(if hard { EndReason::FloorContact } else { EndReason::Completed })
    }

    fn reward(&self, simulation: SimView<'_>, drone: usize, end: Option<EndReason>) -> f64 {
        -simulation.distance(drone, &self.pad) - if end.is_some_and(EndReason::is_crash) { 100.0 } else { 0.0 }
    }

    fn observe(&self, simulation: SimView<'_>, drone: usize, out: &mut [f64]) {
        out[..STATE_SIZE].copy_from_slice(&state_vector(&simulation.states()[drone]));
        out[STATE_SIZE..].copy_from_slice(self.pad.xy().as_slice());
    }

    fn success(&self, simulation: SimView<'_>, drone: usize) -> bool {
        self.landed && simulation.distance(drone, &self.pad) < 0.1
    }
    fn reference(&self, simulation: SimView<'_>, _drone: usize) -> Reference {
        Reference::hover(self.pad + Vector3::z() * (1.0 - 0.3 * simulation.time()), 0.0)
    }
}

#[allow(clippy::print_stdout)]
fn main() -> anyhow::Result<()> {
    let mut env = AviaryBuilder::new(Land::default()).build()?;
    println!("checked: {:?}", check_env(&mut env)?);
    let mut pilot = ControllerPolicy::new(ControllerKind::Dsl, &env);
    println!("flown: {:?}", fly_episode(&mut env, &mut pilot, Some(1))?);
    Ok(())
}
