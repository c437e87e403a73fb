//! Tests of the gradient of the loss.

use aviary::env::Rng;
use aviary::policy::{Activation, Mlp};
use proptest::prelude::*;
use rand::SeedableRng as _;
use rand_distr::StandardNormal;

use super::*;
use crate::network::LOG_DEVIATIONS;

/// Rows of a minibatch.
struct Rows {
    observations: Vec<f32>,
    actions: Vec<f32>,
    log_probs: Vec<f32>,
    advantages: Vec<f32>,
    returns: Vec<f32>,
}

impl Rows {
    fn samples(&self) -> Samples<'_> {
        let Self { observations, actions, log_probs, advantages, returns } = self;
        Samples { observations, actions, log_probs, advantages, returns, sequences: Sequences::default() }
    }
}

/// Returns the gradient over some of the rows.
fn gradient_of(
    width: Width,
    shape: &NetworkShape,
    parameters: &[f32],
    rows: &Rows,
    entries: &[u32],
    loss: &Loss,
) -> (Vec<f32>, Sums) {
    let mut networks = Networks::new(shape, width);
    networks.set(parameters);
    let mut gradient = vec![f32::NAN; shape.count()];
    let sums = networks.gradient(&rows.samples(), entries, loss, &mut gradient);
    (gradient, sums)
}

/// Returns the gradient over all rows, in order.
fn gradient(shape: &NetworkShape, parameters: &[f32], rows: &Rows, loss: &Loss) -> (Vec<f32>, Sums) {
    let entries: Vec<u32> = (0..rows.returns.len() as u32).collect();
    gradient_of(Width::best(), shape, parameters, rows, &entries, loss)
}

/// Computes the loss as in the papers, in double precision, with textbook networks.
fn loss(shape: &NetworkShape, parameters: &[f64], shard: &Rows, weights: &Loss) -> f64 {
    let rows = 0..shard.returns.len();
    let each = rows.map(|row| {
        let seen = &shard.observations[row * shape.observation()..][..shape.observation()];
        let seen: Vec<f64> = seen.iter().map(|&x| f64::from(x)).collect();
        loss_of_row(shape, parameters, [&seen, &seen], shard, row, weights)
    });
    each.sum()
}

/// Computes the part of a row in the loss, from the inputs of actor and critic.
fn loss_of_row(
    shape: &NetworkShape,
    parameters: &[f64],
    [of_actor, of_critic]: [&[f64]; 2],
    shard: &Rows,
    row: usize,
    weights: &Loss,
) -> f64 {
    let run = |sizes: &[usize], parameters: &[f64], input: &[f64]| {
        let mut here = input.to_vec();
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
    let (actor, rest) = parameters.split_at(Mlp::count(&shape.actor));
    let critic = &rest[..Mlp::count(&shape.critic)];
    let logs = &parameters[parameters.len() - shape.action()..];
    let mean = run(&shape.actor, actor, of_actor);
    let mut log_prob = 0.0;
    for (j, log) in logs.iter().enumerate() {
        let off = (f64::from(shard.actions[row * shape.action() + j]) - mean[j]) / log.exp();
        log_prob += -0.5 * off * off - log - 0.5 * std::f64::consts::TAU.ln();
    }
    let ratio = (log_prob - f64::from(shard.log_probs[row])).exp();
    let (advantage, clip) = (f64::from(shard.advantages[row]), f64::from(weights.clip_range));
    let gain = (ratio * advantage).min(ratio.clamp(1.0 - clip, 1.0 + clip) * advantage);
    let error = run(&shape.critic, critic, of_critic)[0] - f64::from(shard.returns[row]);
    (0.5 * f64::from(weights.value) * error * error - gain) / weights.rows as f64
}

fn shard(shape: &NetworkShape, parameters: &[f32], rows: usize, rng: &mut Rng) -> Rows {
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
    Rows { observations, actions, log_probs, advantages: normals(rows), returns: normals(rows) }
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
        let weights = Loss { clip_range: 0.2, value: 0.7, rows: 10 };
        let (found, sums) = gradient(&shape, &parameters, &shard, &weights);
        let exact: Vec<f64> = parameters.iter().map(|&x| f64::from(x)).collect();
        let at = |index: usize, by: f64| {
            let mut moved = exact.clone();
            moved[index] += by;
            loss(&shape, &moved, &shard, &weights)
        };
        let expected = loss(&shape, &exact, &shard, &weights);
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

/// Textbook backpropagation in double precision, row by row.
fn in_double_precision(
    shape: &NetworkShape,
    parameters: &[f32],
    rows: &Rows,
    entries: &[u32],
    loss: &Loss,
) -> Vec<f64> {
    let parameters: Vec<f64> = parameters.iter().map(|&x| f64::from(x)).collect();
    let (actor, critic) = (Mlp::count(&shape.actor), Mlp::count(&shape.critic));
    let logs = &parameters[actor + critic..];
    let mut gradient = vec![0.0; parameters.len()];
    let forward = |sizes: &[usize], mut start: usize, input: &[f32]| {
        let mut layers: Vec<Vec<f64>> = vec![input.iter().map(|&x| f64::from(x)).collect()];
        for (layer, pair) in sizes.windows(2).enumerate() {
            let weight = |i: usize, j: usize| parameters[start + i * pair[1] + j];
            let here = &layers[layer];
            let sum = |j: usize| weight(pair[0], j) + (0..pair[0]).map(|i| here[i] * weight(i, j)).sum::<f64>();
            let act = |x: f64| match shape.activation {
                _ if layer + 2 == sizes.len() => x,
                Activation::Relu => x.max(0.0),
                Activation::Softsign => x / (1.0 + x.abs()),
            };
            let next = (0..pair[1]).map(|j| act(sum(j))).collect();
            layers.push(next);
            start += (pair[0] + 1) * pair[1];
        }
        layers
    };
    let backward = |sizes: &[usize], start: usize, layers: &[Vec<f64>], end: Vec<f64>, gradient: &mut [f64]| {
        let (mut delta, mut start) = (end, start + Mlp::count(sizes));
        for (layer, pair) in sizes.windows(2).enumerate().rev() {
            start -= (pair[0] + 1) * pair[1];
            let mut before = vec![0.0; pair[0]];
            for (j, &delta) in delta.iter().enumerate() {
                for i in 0..pair[0] {
                    gradient[start + i * pair[1] + j] += layers[layer][i] * delta;
                    before[i] += parameters[start + i * pair[1] + j] * delta;
                }
                gradient[start + pair[0] * pair[1] + j] += delta;
            }
            for (x, y) in before.iter_mut().zip(&layers[layer]) {
                *x *= match shape.activation {
                    Activation::Relu => f64::from(u8::from(*y > 0.0)),
                    Activation::Softsign => (1.0 - y.abs()).powi(2),
                };
            }
            delta = before;
        }
    };
    let (share, clip) = (1.0 / loss.rows as f64, f64::from(loss.clip_range));
    for row in entries.iter().map(|&entry| entry as usize) {
        let (size, acts) = (shape.observation(), shape.action());
        let seen = &rows.observations[row * size..][..size];
        let layers = forward(&shape.actor, 0, seen);
        let z = |j: usize| (f64::from(rows.actions[row * acts + j]) - layers[layers.len() - 1][j]) / logs[j].exp();
        let log_prob: f64 = (0..acts).map(|j| -0.5 * z(j).powi(2) - logs[j] - 0.5 * std::f64::consts::TAU.ln()).sum();
        let (ratio, advantage) = ((log_prob - f64::from(rows.log_probs[row])).exp(), f64::from(rows.advantages[row]));
        let clipped = if advantage > 0.0 { ratio > 1.0 + clip } else { ratio < 1.0 - clip };
        let slope = if clipped { 0.0 } else { -share * ratio * advantage };
        for j in 0..acts {
            gradient[actor + critic + j] += slope * (z(j).powi(2) - 1.0);
        }
        let end = (0..acts).map(|j| slope * z(j) / logs[j].exp()).collect();
        backward(&shape.actor, 0, &layers, end, &mut gradient);
        let layers = forward(&shape.critic, actor, seen);
        let error = layers[layers.len() - 1][0] - f64::from(rows.returns[row]);
        backward(&shape.critic, actor, &layers, vec![share * f64::from(loss.value) * error], &mut gradient);
    }
    gradient
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn gradients_of_any_size_match_backpropagation_in_double_precision(
        seed in 0..10_000_u64,
        smooth in any::<bool>(),
        (observation, action) in (1..40_usize, 1..20_usize),
        hidden in proptest::collection::vec(1..70_usize, 0..4),
        count in 1..230_usize,
    ) {
        let activation = if smooth { Activation::Softsign } else { Activation::Relu };
        let shape = NetworkShape::new(observation, action, &hidden, activation);
        let mut rng = Rng::seed_from_u64(seed);
        let mut parameters = shape.initial(0.4, &mut rng);
        for parameter in &mut parameters {
            *parameter += 0.1 * rng.sample::<f32, _>(StandardNormal);
        }
        let rows = shard(&shape, &parameters, count, &mut rng);
        // rows in any order, some of them twice
        let entries: Vec<u32> = (0..count as u32).map(|k| (k * 7 + 3) % count as u32).collect();
        let loss = Loss { clip_range: 0.2, value: 0.7, rows: count };
        let expected = in_double_precision(&shape, &parameters, &rows, &entries, &loss);
        let scale = expected.iter().fold(0.0_f64, |largest, x| largest.max(x.abs()));
        let mut fused = Vec::new();
        for width in Width::available() {
            let (found, sums) = gradient_of(width, &shape, &parameters, &rows, &entries, &loss);
            for (index, (found, expected)) in found.iter().zip(&expected).enumerate() {
                prop_assert!(
                    (f64::from(*found) - expected).abs() < 2e-3 * (0.01 * scale + expected.abs()),
                    "{} parameter {}: {} and {}", width, index, found, expected
                );
            }
            if width != Width::Portable {
                fused.push((found, sums));
            }
        }
        prop_assert!(fused.windows(2).all(|pair| pair[0] == pair[1]), "AVX2 and AVX-512 differ");
    }
}

#[test]
fn inference_matches_the_network_of_training() {
    for activation in [Activation::Relu, Activation::Softsign] {
        let mut rng = Rng::seed_from_u64(5);
        let shape = NetworkShape::new(21, 4, &[64, 64], activation);
        let mut parameters = shape.initial(0.3, &mut rng);
        for parameter in &mut parameters {
            *parameter += 0.1 * rng.sample::<f32, _>(StandardNormal);
        }
        let input: Vec<f32> = (0..TILE * 21).map(|_| 2.0 * rng.sample::<f32, _>(StandardNormal)).collect();
        let mut flown = vec![0.0; TILE * 4];
        let (actor, ..) = shape.split(&parameters);
        Mlp::new(&shape.actor, activation, actor).unwrap().forward(&input, &mut flown);
        for width in Width::available() {
            let mut network = Network::new(&shape.actor, activation);
            network.set(actor);
            let mut pass = Pass::new(&shape.actor);
            let mut rows = Aligned::new(TILE * padded(21));
            for (row, input) in rows.chunks_exact_mut(padded(21)).zip(input.chunks_exact(21)) {
                row[..21].copy_from_slice(input);
            }
            run(width, Forward { pass: &mut pass, network: &network, input: &rows });
            for (flown, trained) in flown.chunks_exact(4).zip(pass.ends().0.chunks_exact(padded(4))) {
                for (flown, trained) in flown.iter().zip(trained) {
                    assert!((flown - trained).abs() < 1e-5 * (1.0 + trained.abs()), "{flown} {trained}");
                }
            }
        }
    }
}

struct Forward<'a> {
    pass: &'a mut Pass,
    network: &'a Network,
    input: &'a [f32],
}

impl WithSimd for Forward<'_> {
    type Output = ();

    fn with_simd<S: Simd>(self, simd: S) {
        self.pass.forward(simd, self.network, TILE, self.input);
    }
}

#[test]
fn gradients_of_shards_add_up_to_the_gradient_of_the_minibatch() {
    let shape = NetworkShape::new(12, 4, &[64, 64], Activation::Relu);
    let mut rng = Rng::seed_from_u64(3);
    let parameters = shape.initial(0.3, &mut rng);
    let whole = shard(&shape, &parameters, 100, &mut rng);
    let loss = Loss { clip_range: 0.2, value: 1.0, rows: 100 };
    let (all, sums) = gradient(&shape, &parameters, &whole, &loss);
    let part = |rows: std::ops::Range<u32>| {
        gradient_of(Width::best(), &shape, &parameters, &whole, &rows.collect::<Vec<_>>(), &loss)
    };
    let parts = [part(0..37), part(37..100)];
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
                let shard = Rows {
                    observations: vec![0.5; 6],
                    actions: vec![action; 4],
                    log_probs: vec![log_prob; 2],
                    advantages: vec![advantage; 2],
                    returns: vec![0.0; 2],
                };
                let weights = Loss { clip_range: 0.2, value: 1.0, rows: 2 };
                let (found, sums) = gradient(&shape, &parameters, &shard, &weights);
                assert!(found.iter().all(|x| x.is_finite()), "{log_deviation} {action} {log_prob}: {found:?}");
                assert!(sums.loss.is_finite() && sums.approx_kl.is_finite(), "{sums:?}");
                assert!(sums.approx_kl > 0.0);
            }
        }
    }
}

/// Sequences of a rollout with a recurrent layer, steps × sequences.
struct Unrolling {
    rows: Rows,
    next: Vec<Next>,
    starts: Vec<f32>,
    count: usize,
}

impl Unrolling {
    /// Creates a rollout with ends of episodes and absent agents.
    fn new(shape: &NetworkShape, parameters: &[f32], [steps, count]: [usize; 2], rng: &mut Rng) -> Self {
        // a rollout without recurrence, whose observations have the size of the features
        let plain = NetworkShape { recurrent: 0, ..shape.clone() };
        let (actor, critic, logs) = shape.split(parameters);
        let mut rows = shard(&plain, &[actor, critic, logs].concat(), steps * count, rng);
        let ends = [Next::Running, Next::Running, Next::Running, Next::Terminated, Next::Truncated, Next::Absent];
        let next = (0..steps * count).map(|_| ends[rng.random_range(0..ends.len())]).collect();
        let starts = (0..count * shape.recurrent).map(|_| 0.5 * rng.sample::<f32, _>(StandardNormal)).collect();
        // the states are not those of the observations
        for row in rows.observations.chunks_exact_mut(shape.features()) {
            row[shape.observation()..].fill(f32::NAN);
        }
        Self { rows, next, starts, count }
    }

    fn samples(&self) -> Samples<'_> {
        let sequences = Sequences { count: self.count, next: &self.next, starts: &self.starts };
        Samples { sequences, ..self.rows.samples() }
    }

    fn gradient(
        &self,
        width: Width,
        shape: &NetworkShape,
        parameters: &[f32],
        sequences: &[u32],
        loss: &Loss,
    ) -> (Vec<f32>, Sums) {
        let mut networks = Networks::new(shape, width);
        networks.set(parameters);
        let mut gradient = vec![f32::NAN; shape.count()];
        let sums = networks.gradient_through_time(&self.samples(), sequences, loss, &mut gradient);
        (gradient, sums)
    }

    /// Returns the states of the recurrent layer after every step in double precision, by the equations of the layer.
    fn states(&self, shape: &NetworkShape, parameters: &[f64]) -> Vec<Vec<f64>> {
        let (size, units) = (shape.observation(), shape.recurrent);
        let first = Mlp::count(&shape.actor) + Mlp::count(&shape.critic);
        let (of_input, of_state) = parameters[first..].split_at((size + 1) * 3 * units);
        let sums = |parameters: &[f64], input: &[f64]| -> Vec<f64> {
            let at = |row: usize, column: usize| parameters[row * 3 * units + column];
            let products = |column| input.iter().enumerate().map(move |(row, x)| x * at(row, column));
            (0..3 * units).map(|column| at(input.len(), column) + products(column).sum::<f64>()).collect()
        };
        let sigmoid = |x: f64| 1.0 / (1.0 + (-x).exp());
        let mut states: Vec<Vec<f64>> = Vec::new();
        for entry in 0..self.next.len() {
            let observation: Vec<f64> =
                self.rows.observations[entry * shape.features()..][..size].iter().map(|&x| f64::from(x)).collect();
            let before: Vec<f64> = match entry.checked_sub(self.count) {
                None => self.starts[entry * units..][..units].iter().map(|&x| f64::from(x)).collect(),
                Some(last) if self.next[last].is_end() => vec![0.0; units],
                Some(last) => states[last].clone(),
            };
            let (x, h) = (sums(of_input, &observation), sums(of_state, &before));
            let next = |unit: usize| {
                let reset = sigmoid(x[unit] + h[unit]);
                let update = sigmoid(x[units + unit] + h[units + unit]);
                let candidate = (x[2 * units + unit] + reset * h[2 * units + unit]).tanh();
                (1.0 - update) * candidate + update * before[unit]
            };
            states.push((0..units).map(next).collect());
        }
        states
    }

    /// Computes the loss in double precision: of the actor with the states by `parameters`, and of the critic with
    /// given states.
    fn loss(
        &self,
        shape: &NetworkShape,
        parameters: &[f64],
        critic_states: &Vec<Vec<f64>>,
        sequences: &[u32],
        weights: &Loss,
    ) -> f64 {
        let states = self.states(shape, parameters);
        let mut total = 0.0;
        for entry in (0..self.next.len()).filter(|&entry| self.next[entry] != Next::Absent) {
            if sequences.contains(&((entry % self.count) as u32)) {
                let seen = &self.rows.observations[entry * shape.features()..][..shape.observation()];
                let seen: Vec<f64> = seen.iter().map(|&x| f64::from(x)).collect();
                let inputs = [&states, critic_states].map(|states| [&seen[..], &states[entry]].concat());
                let inputs = [&inputs[0][..], &inputs[1]];
                total += loss_of_row(shape, parameters, inputs, &self.rows, entry, weights);
            }
        }
        total
    }
}

fn recurrent_shape(rng: &mut Rng, hidden: &[usize], units: usize) -> (NetworkShape, Vec<f32>) {
    let shape = NetworkShape::new(3, 2, hidden, Activation::Softsign).with_recurrent(units);
    let mut parameters = shape.initial(0.4, rng);
    for parameter in &mut parameters {
        *parameter += 0.2 * rng.sample::<f32, _>(StandardNormal);
    }
    (shape, parameters)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(16))]

    #[test]
    fn gradients_through_time_match_finite_differences(
        seed in 0..10_000_u64,
        hidden in proptest::collection::vec(1..6_usize, 0..2),
        units in 1..20_usize,
        steps in 1..7_usize,
        count in 1..4_usize,
    ) {
        let mut rng = Rng::seed_from_u64(seed);
        let (shape, parameters) = recurrent_shape(&mut rng, &hidden, units);
        let unrolling = Unrolling::new(&shape, &parameters, [steps, count], &mut rng);
        // some of the sequences, not in order
        let sequences: Vec<u32> = (0..count as u32).rev().take(2).collect();
        let weights = Loss { clip_range: 0.2, value: 0.7, rows: 10 };
        let (found, sums) = unrolling.gradient(Width::best(), &shape, &parameters, &sequences, &weights);
        let exact: Vec<f64> = parameters.iter().map(|&x| f64::from(x)).collect();
        let constant = unrolling.states(&shape, &exact);
        let at = |index: usize, by: f64| {
            let mut moved = exact.clone();
            moved[index] += by;
            unrolling.loss(&shape, &moved, &constant, &sequences, &weights)
        };
        let expected = unrolling.loss(&shape, &exact, &constant, &sequences, &weights);
        prop_assert!((sums.loss - expected).abs() < 1e-4 * (1.0 + expected.abs()), "{} {}", sums.loss, expected);
        for (index, &found) in found.iter().enumerate() {
            let step = 1e-6;
            let (up, down) = (at(index, step), at(index, -step));
            let [left, right] = [(expected - down) / step, (up - expected) / step];
            let found = f64::from(found);
            // at a kink of the clipped gain, the gradient is that of one side
            let slack = 1e-4 + 2e-3 * (left.abs() + right.abs());
            prop_assert!(
                found >= left.min(right) - slack && found <= left.max(right) + slack,
                "parameter {}: {}, expected {} to {}", index, found, left, right
            );
        }
    }
}

#[test]
fn gradients_through_time_are_bit_identical_for_avx2_and_avx512_and_add_up() {
    let mut rng = Rng::seed_from_u64(9);
    for units in [5, 32, 40] {
        let (shape, parameters) = recurrent_shape(&mut rng, &[24], units);
        // several tiles of rows
        let unrolling = Unrolling::new(&shape, &parameters, [17, 14], &mut rng);
        let loss = Loss { clip_range: 0.2, value: 1.0, rows: 150 };
        let all: Vec<u32> = (0..14).map(|k| (5 * k) % 14).collect();
        let of = |width, sequences: &[u32]| unrolling.gradient(width, &shape, &parameters, sequences, &loss);
        let widths = Width::available().filter(|width| *width != Width::Portable);
        let fused: Vec<_> = widths.map(|width| of(width, &all)).collect();
        assert!(fused.windows(2).all(|pair| pair[0] == pair[1]), "AVX2 and AVX-512 differ");
        let (whole, _) = of(Width::best(), &all);
        let (portable, _) = of(Width::Portable, &all);
        let ((first, _), (second, _)) = (of(Width::best(), &all[..6]), of(Width::best(), &all[6..]));
        for index in 0..whole.len() {
            let (whole, sum) = (whole[index], first[index] + second[index]);
            assert!((whole - sum).abs() < 1e-5 * (1.0 + whole.abs()), "{index}: {whole} {sum}");
            assert!((whole - portable[index]).abs() < 1e-4 * (1.0 + whole.abs()), "{index}: {whole}");
        }
    }
}
