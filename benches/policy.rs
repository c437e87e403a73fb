//! Time of one action of trained policies, of a batch of rows, and of an iteration of the trainer without simulation:
//! `cargo bench --bench policy`.

use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use learn::{Agents, Arena, Next, Outcome, TrainConfig, Trainer};
use mujoco_drones_gym::env::{BoxSpace, EnvError};
use mujoco_drones_gym::policy::{Activation, Mlp, PolicyNetwork};

fn policies(c: &mut Criterion) {
    for name in ["hover", "race"] {
        let path = format!("{}/assets/policies/{name}.safetensors", env!("CARGO_MANIFEST_DIR"));
        let policy = PolicyNetwork::load(path).expect("a policy in assets/policies");
        let (observation, mut action) = (vec![0.1; policy.observation_size()], [0.0; 4]);
        c.bench_function(&format!("{name}: one action"), |b| {
            b.iter(|| policy.forward(black_box(&observation), &mut action))
        });
    }
    let sizes = [12, 64, 64, 4];
    let parameters: Vec<f32> = (0..Mlp::count(&sizes)).map(|k| 0.1 * (k as f32).sin()).collect();
    let net = Mlp::new(&sizes, Activation::Relu, &parameters).expect("a network");
    let (input, mut output) = (vec![0.1; 1024 * 12], vec![0.0; 1024 * 4]);
    c.bench_function("1,024 rows at once", |b| b.iter(|| net.forward(black_box(&input), &mut output)));
}

/// Agents without a simulation.
struct Still {
    rows: usize,
    observations: BoxSpace,
    actions: BoxSpace,
    steps: u64,
}

impl Still {
    fn observe(&self, out: &mut [f32]) {
        for (k, x) in out.iter_mut().enumerate() {
            *x = ((k as u64 * 7919 + self.steps * 104_729) % 1000) as f32 / 250.0 - 2.0;
        }
    }
}

impl Agents for Still {
    fn rows(&self) -> usize {
        self.rows
    }

    fn observation_space(&self) -> &BoxSpace {
        &self.observations
    }

    fn action_space(&self) -> &BoxSpace {
        &self.actions
    }

    fn longest(&self, _: usize) -> u64 {
        100
    }

    fn reset(&mut self, _: u64, observations: &mut [f32]) -> Result<(), EnvError> {
        self.observe(observations);
        Ok(())
    }

    fn step(&mut self, actions: &[f32], outcome: &mut Outcome) -> Result<(), EnvError> {
        self.steps += 1;
        for (reward, action) in outcome.rewards.iter_mut().zip(actions.chunks_exact(4)) {
            *reward = -action.iter().map(|x| x * x).sum::<f32>();
        }
        outcome.next.fill(Next::Running);
        self.observe(&mut outcome.observations);
        Ok(())
    }

    fn restart(&mut self, _: &mut [bool], _: &mut [f32]) -> Result<(), EnvError> {
        Ok(())
    }
}

fn iterations(c: &mut Criterion) {
    for hidden in [32, 64] {
        let mut config = TrainConfig::of_task("hover").expect("a task");
        (config.evaluate_every, config.steps) = (u64::MAX >> 1, u64::MAX >> 1);
        config.ppo.hidden = vec![hidden; 2];
        let space = |size, bound: f64| BoxSpace::new(vec![[-bound, bound]; size]);
        let agents =
            Still { rows: config.ppo.environments, observations: space(12, 10.0), actions: space(4, 1.0), steps: 0 };
        let arena = Arena::new(config.success, || config.environment()).expect("an environment");
        let rows = config.ppo.environments * config.ppo.horizon;
        let epochs = config.ppo.epochs;
        let mut trainer = Trainer::with(config, "a benchmark", Box::new(agents), arena).expect("a run");
        c.bench_function(&format!("iteration of {rows} rows, {epochs} epochs, layers of {hidden}"), |b| {
            b.iter(|| trainer.advance().map(|point| point.report.loss).expect("an iteration"))
        });
    }
}

criterion_group!(benches, policies, iterations);
criterion_main!(benches);
