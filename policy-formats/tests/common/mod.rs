//! Policies that the tests convert, and random observations.

use aviary::env::{BoxSpace, Rng};
use aviary::policy::{Activation, Gru, Mlp, PolicyInfo, PolicyNetwork};
use rand::{RngExt as _, SeedableRng as _};

/// Returns a policy of the repository.
pub fn asset(name: &str) -> PolicyNetwork {
    PolicyNetwork::load(format!("../assets/policies/{name}.safetensors")).unwrap()
}

/// Returns a policy with random weights, odd sizes, softsign units, and actions without some of their bounds.
pub fn random() -> PolicyNetwork {
    let mut rng = Rng::seed_from_u64(5);
    let sizes = [7, 33, 18, 5];
    let parameters: Vec<f32> = (0..Mlp::count(&sizes)).map(|_| rng.random_range(-0.8..0.8)).collect();
    let net = Mlp::new(&sizes, Activation::Softsign, &parameters).unwrap();
    let info = PolicyInfo { task: "my task".into(), action_type: "vel".into(), ..asset("hover").info().clone() };
    let open = [f64::NEG_INFINITY, f64::INFINITY];
    let actions = BoxSpace::new([[-1.0, 1.0], [0.0, 20_000.0], open, [-0.5, f64::INFINITY], [f64::NEG_INFINITY, 0.25]]);
    let policy = PolicyNetwork::new(info, net, BoxSpace::new([open; 7]), actions).unwrap();
    let mean = (0..7).map(|k| 0.3 * k as f32 - 1.0).collect();
    let deviation = (0..7).map(|k| 0.1 + 0.7 * k as f32).collect();
    policy.normalized(mean, deviation).unwrap()
}

/// Returns a recurrent policy with random weights.
pub fn recurrent() -> PolicyNetwork {
    let mut rng = Rng::seed_from_u64(6);
    let mut numbers = |count: usize| (0..count).map(|_| rng.random_range(-0.6..0.6)).collect::<Vec<f32>>();
    let gru = Gru::new(12, 11, &numbers(Gru::count(12, 11))).unwrap();
    let sizes = [23, 17, 4];
    let net = Mlp::new(&sizes, Activation::Relu, &numbers(Mlp::count(&sizes))).unwrap();
    let info = PolicyInfo { version: PolicyInfo::RECURRENT_VERSION, ..asset("hover").info().clone() };
    let spaces = [BoxSpace::new([[f64::NEG_INFINITY, f64::INFINITY]; 12]), BoxSpace::new([[-1.0, 1.0]; 4])];
    let [observations, actions] = spaces;
    PolicyNetwork::new_recurrent(info, gru, net, observations, actions).unwrap()
}

/// Returns random observations in the range of a policy, and some far outside.
pub fn observations(policy: &PolicyNetwork, count: usize) -> Vec<f32> {
    let mut rng = Rng::seed_from_u64(9);
    let (mean, deviation) = policy.normalization();
    let mut observations = Vec::with_capacity(count * mean.len());
    for row in 0..count {
        let reach = if row % 100 == 0 { 1000.0 } else { 3.0 };
        let entries = mean.iter().zip(deviation);
        observations.extend(entries.map(|(mean, deviation)| mean + deviation * rng.random_range(-reach..reach)));
    }
    observations
}

/// Returns the actions of a policy for the observations of an episode.
pub fn actions(policy: &PolicyNetwork, observations: &[f32]) -> Vec<f32> {
    let mut memory = vec![0.0; policy.memory_size()];
    let mut action = vec![0.0; policy.action_size()];
    let mut actions = Vec::new();
    for row in observations.chunks_exact(policy.observation_size()) {
        let row: Vec<f64> = row.iter().map(|&x| f64::from(x)).collect();
        policy.forward_with(&row, &mut memory, &mut action);
        actions.extend(action.iter().map(|&x| x as f32));
    }
    actions
}
