//! Time of one action of trained policies, and of a batch of rows: `cargo bench --bench policy`.

use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
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

criterion_group!(benches, policies);
criterion_main!(benches);
