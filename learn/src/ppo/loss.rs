//! Loss of PPO and its gradient over a shard of a minibatch.
//!
//! burn's autodiff computes the gradients; inference uses [`Mlp`](aviary::policy::Mlp).

use aviary::policy::Activation;
use burn::tensor::activation::relu;
use burn::tensor::{Device, Tensor, TensorData};

use crate::network::NetworkShape;

/// Bound of the absolute log-ratio of new and old action probabilities. A row beyond it has the ratio exp(±20) and
/// no gradient; without the bound, exp overflows at 88.
const MAX_LOG_RATIO: f32 = 20.0;

/// Rows of a part of a minibatch.
#[derive(Debug, Clone, Default)]
pub(super) struct Shard {
    pub observations: Vec<f32>,
    pub actions: Vec<f32>,
    /// Log-probabilities of the actions under the policy that sampled them.
    pub log_probs: Vec<f32>,
    pub advantages: Vec<f32>,
    pub returns: Vec<f32>,
}

impl Shard {
    pub fn clear(&mut self) {
        let Self { observations, actions, log_probs, advantages, returns } = self;
        for list in [observations, actions, log_probs, advantages, returns] {
            list.clear();
        }
    }
}

/// Coefficients of the loss (Schulman et al. 2017, eq. 9).
#[derive(Debug, Clone, Copy)]
pub(super) struct Loss {
    /// Clip range of the probability ratio.
    pub clip_range: f32,
    /// Weight of the value loss.
    pub value: f32,
}

/// Sums over the rows of a shard.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Sums {
    /// Loss, already divided by the size of the minibatch.
    pub loss: f64,
    /// Approximate KL divergence of the policy from the one that sampled the actions.
    pub approx_kl: f64,
    /// Number of rows whose ratio was clipped.
    pub clipped: f64,
}

/// Returns the gradient of the loss over a shard of a minibatch of `size` rows, and the shard's sums. The gradients
/// of the shards add up to the minibatch's. The entropy bonus depends on no row, so that the caller adds its
/// gradient once.
pub(super) fn gradient(
    shape: &NetworkShape,
    parameters: &[f32],
    shard: &Shard,
    loss: &Loss,
    size: usize,
) -> (Vec<f32>, Sums) {
    let device = Device::flex().autodiff();
    let rows = shard.returns.len();
    let tensor =
        |data: &[f32], shape: [usize; 2]| Tensor::<2>::from_data(TensorData::new(data.to_vec(), shape), &device);
    let leaf = |data: &[f32], shape: [usize; 2]| tensor(data, shape).require_grad();
    let leaves = |sizes: &[usize], parameters: &[f32]| {
        let (mut leaves, mut left) = (Vec::new(), parameters);
        for pair in sizes.windows(2) {
            let (weights, rest) = left.split_at(pair[0] * pair[1]);
            let (biases, rest) = rest.split_at(pair[1]);
            left = rest;
            leaves.extend([leaf(weights, [pair[0], pair[1]]), leaf(biases, [1, pair[1]])]);
        }
        leaves
    };
    let (actor, critic, deviations) = shape.split(parameters);
    let (actor, critic) = (leaves(&shape.actor, actor), leaves(&shape.critic, critic));
    let deviations = leaf(deviations, [1, shape.action()]);
    let forward = |leaves: &[Tensor<2>], x| forward(shape.activation, leaves, x);
    let observations = tensor(&shard.observations, [rows, shape.observation()]);
    let column = |data: &[f32]| tensor(data, [rows, 1]);
    let advantages = column(&shard.advantages);

    let off = (tensor(&shard.actions, [rows, shape.action()]) - forward(&actor, observations.clone()))
        * (deviations.clone() * -1.0).exp();
    let half_log_tau = 0.5 * std::f32::consts::TAU.ln() * shape.action() as f32;
    let log_probs = (off.clone() * off).sum_dim(1) * -0.5 - deviations.clone().sum_dim(1) - half_log_tau;
    let log_ratio = (log_probs - column(&shard.log_probs)).clamp(-MAX_LOG_RATIO, MAX_LOG_RATIO);
    let ratio = log_ratio.clone().exp();
    let clipped = ratio.clone().clamp(1.0 - loss.clip_range, 1.0 + loss.clip_range);
    let gain = (ratio.clone() * advantages.clone()).min_pair(clipped * advantages).sum();
    let error = forward(&critic, observations) - column(&shard.returns);
    let total = ((error.clone() * error).sum() * (0.5 * loss.value) - gain) * (1.0 / size as f32);

    let gradients = total.backward();
    let mut gradient = Vec::with_capacity(shape.count());
    for leaf in actor.iter().chain(&critic).chain([&deviations]) {
        gradient.extend(numbers(leaf.grad(&gradients).unwrap_or_else(|| leaf.clone().inner().zeros_like())));
    }
    let mut sums = Sums { loss: f64::from(numbers(total.inner())[0]), ..Sums::default() };
    for (log_ratio, ratio) in numbers(log_ratio.inner()).into_iter().zip(numbers(ratio.inner())) {
        // (r − 1) − log r is never negative, and its mean estimates the KL divergence (Schulman 2020)
        sums.approx_kl += f64::from(ratio - 1.0 - log_ratio);
        sums.clipped += f64::from(u8::from((ratio - 1.0).abs() > loss.clip_range));
    }
    (gradient, sums)
}

/// Computes a network's outputs for rows of inputs, as [`Mlp`] does, with autodiff. The leaves are the weights and
/// biases of each layer.
fn forward(activation: Activation, leaves: &[Tensor<2>], mut x: Tensor<2>) -> Tensor<2> {
    let last = leaves.len() / 2 - 1;
    for (layer, pair) in leaves.chunks_exact(2).enumerate() {
        x = x.matmul(pair[0].clone()) + pair[1].clone();
        if layer < last {
            x = match activation {
                Activation::Relu => relu(x),
                Activation::Softsign => x.clone() / (x.abs() + 1.0),
            };
        }
    }
    x
}

fn numbers<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    tensor.into_data().try_to_vec().unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use aviary::env::Rng;
    use aviary::policy::Mlp;
    use proptest::prelude::*;
    use rand::SeedableRng as _;
    use rand_distr::StandardNormal;

    use super::*;
    use crate::network::LOG_DEVIATIONS;

    /// Computes the loss as in the papers, in double precision, with textbook networks.
    fn loss(shape: &NetworkShape, parameters: &[f64], shard: &Shard, weights: &Loss, size: usize) -> f64 {
        let run = |sizes: &[usize], parameters: &[f64], input: &[f32]| {
            let mut here: Vec<f64> = input.iter().map(|&x| f64::from(x)).collect();
            let mut left = parameters;
            for (layer, pair) in sizes.windows(2).enumerate() {
                let (weights, rest) = left.split_at(pair[0] * pair[1]);
                let (biases, rest) = rest.split_at(pair[1]);
                left = rest;
                let sum = |j: usize| biases[j] + (0..pair[0]).map(|i| here[i] * weights[i * pair[1] + j]).sum::<f64>();
                let act = |x: f64| match shape.activation {
                    _ if layer + 2 == sizes.len() => x,
                    Activation::Relu => x.max(0.0),
                    Activation::Softsign => x / (1.0 + x.abs()),
                };
                here = (0..pair[1]).map(|j| act(sum(j))).collect();
            }
            here
        };
        let (actors, critics) = (Mlp::count(&shape.actor), Mlp::count(&shape.critic));
        let (actor, rest) = parameters.split_at(actors);
        let (critic, logs) = rest.split_at(critics);
        let mut total = 0.0;
        for row in 0..shard.returns.len() {
            let seen = &shard.observations[row * shape.observation()..][..shape.observation()];
            let mean = run(&shape.actor, actor, seen);
            let mut log_prob = 0.0;
            for (j, log) in logs.iter().enumerate() {
                let off = (f64::from(shard.actions[row * shape.action() + j]) - mean[j]) / log.exp();
                log_prob += -0.5 * off * off - log - 0.5 * std::f64::consts::TAU.ln();
            }
            let ratio = (log_prob - f64::from(shard.log_probs[row])).exp();
            let (advantage, clip) = (f64::from(shard.advantages[row]), f64::from(weights.clip_range));
            total -= (ratio * advantage).min(ratio.clamp(1.0 - clip, 1.0 + clip) * advantage);
            let error = run(&shape.critic, critic, seen)[0] - f64::from(shard.returns[row]);
            total += 0.5 * f64::from(weights.value) * error * error;
        }
        total / size as f64
    }

    fn shard(shape: &NetworkShape, parameters: &[f32], rows: usize, rng: &mut Rng) -> Shard {
        let mut normals = |count: usize| -> Vec<f32> { (0..count).map(|_| rng.sample(StandardNormal)).collect() };
        let observations = normals(rows * shape.observation());
        let (actions, noise) = (normals(rows * shape.action()), normals(rows));
        let (actor, _, logs) = shape.split(parameters);
        let actor = Mlp::new(&shape.actor, shape.activation, actor).unwrap();
        let mut mean = vec![0.0; actions.len()];
        actor.forward(&observations, &mut mean);
        // actions sampled from the policy, with log-probabilities of a slightly different one
        let actions: Vec<f32> = actions.iter().zip(&mean).map(|(x, mean)| mean + 0.3 * x).collect();
        let log_prob = |row: usize| -> f32 {
            let entries = row * shape.action()..(row + 1) * shape.action();
            let each = entries.zip(logs).map(|(entry, log)| {
                let off = (actions[entry] - mean[entry]) / log.exp();
                -0.5 * off * off - log - 0.5 * std::f32::consts::TAU.ln()
            });
            each.sum()
        };
        let log_probs = (0..rows).map(|row| log_prob(row) + 0.3 * noise[row]).collect();
        Shard { observations, actions, log_probs, advantages: normals(rows), returns: normals(rows) }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]

        #[test]
        fn gradients_match_finite_differences(
            seed in 0..10_000_u64,
            smooth in any::<bool>(),
            hidden in proptest::collection::vec(1..9_usize, 0..3),
            rows in 1..7_usize,
        ) {
            let activation = if smooth { Activation::Softsign } else { Activation::Relu };
            let shape = NetworkShape::new(3, 2, &hidden, activation);
            let mut rng = Rng::seed_from_u64(seed);
            let mut parameters = shape.initial(0.4, &mut rng);
            for parameter in &mut parameters {
                *parameter += 0.1 * rng.sample::<f32, _>(StandardNormal);
            }
            let shard = shard(&shape, &parameters, rows, &mut rng);
            let weights = Loss { clip_range: 0.2, value: 0.7 };
            let (found, sums) = gradient(&shape, &parameters, &shard, &weights, 10);
            let exact: Vec<f64> = parameters.iter().map(|&x| f64::from(x)).collect();
            let at = |index: usize, by: f64| {
                let mut moved = exact.clone();
                moved[index] += by;
                loss(&shape, &moved, &shard, &weights, 10)
            };
            let expected = loss(&shape, &exact, &shard, &weights, 10);
            prop_assert!((sums.loss - expected).abs() < 1e-4 * (1.0 + sums.loss.abs()));
            for (index, &found) in found.iter().enumerate() {
                let [small, large] = [1e-6, 1e-5].map(|by| (at(index, by) - at(index, -by)) / (2.0 * by));
                // the loss has no derivative at a kink within the step
                if (small - large).abs() < 1e-4 * (1.0 + small.abs()) {
                    prop_assert!(
                        (f64::from(found) - small).abs() < 2e-3 * (1.0 + small.abs()),
                        "parameter {}: {} and {}", index, found, small
                    );
                }
            }
        }
    }

    #[test]
    fn inference_matches_the_network_of_training() {
        for activation in [Activation::Relu, Activation::Softsign] {
            let mut rng = Rng::seed_from_u64(5);
            let sizes = [21, 64, 64, 4];
            let mut draw = |count: usize, by: f32| -> Vec<f32> {
                (0..count).map(|_| by * rng.sample::<f32, _>(StandardNormal)).collect()
            };
            let (parameters, input) = (draw(Mlp::count(&sizes), 0.2), draw(300 * 21, 2.0));
            let mut flown = vec![0.0; 300 * 4];
            Mlp::new(&sizes, activation, &parameters).unwrap().forward(&input, &mut flown);
            let device = Device::flex();
            let (mut leaves, mut left) = (Vec::new(), &parameters[..]);
            for pair in sizes.windows(2) {
                for shape in [[pair[0], pair[1]], [1, pair[1]]] {
                    let (data, rest) = left.split_at(shape[0] * shape[1]);
                    left = rest;
                    leaves.push(Tensor::from_data(TensorData::new(data.to_vec(), shape), &device));
                }
            }
            let trained = forward(activation, &leaves, Tensor::from_data(TensorData::new(input, [300, 21]), &device));
            for (flown, trained) in flown.iter().zip(numbers(trained)) {
                assert!((flown - trained).abs() < 1e-5 * (1.0 + trained.abs()), "{flown} {trained}");
            }
        }
    }

    #[test]
    fn gradients_of_shards_add_up_to_the_gradient_of_the_minibatch() {
        let shape = NetworkShape::new(12, 4, &[64, 64], Activation::Relu);
        let mut rng = Rng::seed_from_u64(3);
        let parameters = shape.initial(0.3, &mut rng);
        let whole = shard(&shape, &parameters, 100, &mut rng);
        let weights = Loss { clip_range: 0.2, value: 1.0 };
        let (all, sums) = gradient(&shape, &parameters, &whole, &weights, 100);
        let part = |rows: std::ops::Range<usize>| Shard {
            observations: whole.observations[rows.start * 12..rows.end * 12].to_vec(),
            actions: whole.actions[rows.start * 4..rows.end * 4].to_vec(),
            log_probs: whole.log_probs[rows.clone()].to_vec(),
            advantages: whole.advantages[rows.clone()].to_vec(),
            returns: whole.returns[rows].to_vec(),
        };
        let parts = [part(0..37), part(37..100)].map(|part| gradient(&shape, &parameters, &part, &weights, 100));
        for (index, all) in all.iter().enumerate() {
            let sum = parts[0].0[index] + parts[1].0[index];
            assert!((all - sum).abs() < 1e-5, "{index}: {all} {sum}");
        }
        let sum = |value: fn(&Sums) -> f64| parts.iter().map(|(_, sums)| value(sums)).sum::<f64>();
        assert!((sums.loss - sum(|sums| sums.loss)).abs() < 1e-5);
        assert!((sums.approx_kl - sum(|sums| sums.approx_kl)).abs() < 1e-3);
        assert_eq!(sums.clipped, sum(|sums| sums.clipped));
    }

    #[test]
    fn gradients_stay_finite_if_probabilities_exceed_single_precision() {
        let shape = NetworkShape::new(3, 2, &[8], Activation::Relu);
        let mut rng = Rng::seed_from_u64(4);
        for log_deviation in [*LOG_DEVIATIONS.start(), 0.0, *LOG_DEVIATIONS.end()] {
            let mut parameters = shape.initial(1.0, &mut rng);
            let first = parameters.len() - shape.action();
            parameters[first..].fill(log_deviation);
            // log-ratios of up to ±4e19; exp overflows beyond 88
            for (action, log_prob) in [(1e5, 0.0), (0.0, -1e5), (0.1, 1e5), (1e5, -1e30)] {
                for advantage in [1.0, -1.0] {
                    let shard = Shard {
                        observations: vec![0.5; 6],
                        actions: vec![action; 4],
                        log_probs: vec![log_prob; 2],
                        advantages: vec![advantage; 2],
                        returns: vec![0.0; 2],
                    };
                    let weights = Loss { clip_range: 0.2, value: 1.0 };
                    let (found, sums) = gradient(&shape, &parameters, &shard, &weights, 2);
                    assert!(found.iter().all(|x| x.is_finite()), "{log_deviation} {action} {log_prob}: {found:?}");
                    assert!(sums.loss.is_finite() && sums.approx_kl.is_finite(), "{sums:?}");
                    assert!(sums.approx_kl > 0.0);
                }
            }
        }
    }
}
