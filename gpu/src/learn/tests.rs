//! Tests of the kernels against direct computations in double precision.

use aviary::policy::{Activation, Mlp};
use learn::LOG_DEVIATIONS;
use rand_distr::StandardNormal;

use super::gradient::{DIVERGED, LANES, RATE, TALLY};
use super::noise::{normal_kernel, permutation_kernel};
use super::rollout::{ABSENT, RUNNING, TERMINATED, TRUNCATED};
use super::*;

fn config() -> PpoConfig {
    let mut config = TrainConfig::of_task("hover").unwrap().ppo;
    (config.entropy_coef, config.value_coef, config.clip_range) = (0.02, 0.7, 0.2);
    config
}

fn normals(rng: &mut Rng, count: usize) -> Vec<f32> {
    (0..count).map(|_| rng.sample(StandardNormal)).collect()
}

fn words_of(machine: &Machine, buffer: &Buffer) -> Vec<u32> {
    u32::from_bytes(&machine.device.client().read_one(buffer.handle.clone()).unwrap()).to_vec()
}

/// Samples on the host.
struct Samples {
    raw: Vec<f32>,
    /// Actions and log-probability.
    actions: Vec<f32>,
    /// Advantage, return and weight.
    targets: Vec<f32>,
    /// Means and standard deviations of the observations.
    scale: Vec<f32>,
}

impl Samples {
    /// Draws samples whose actions are likely for the parameters.
    fn new(shape: &NetworkShape, parameters: &[f32], rows: usize, rng: &mut Rng) -> Self {
        let (size, acts) = (shape.observation(), shape.action());
        let raw: Vec<f32> = normals(rng, rows * size).iter().map(|x| 3.0 + 2.0 * x).collect();
        let mut scale = vec![2.5; size];
        scale.extend(vec![1.8; size + 1]);
        scale.extend(vec![0.0; acts]);
        scale.extend(vec![1.0; acts]);
        let (actor, _, logs) = shape.split(parameters);
        let mut actions = Vec::new();
        for row in raw.chunks_exact(size) {
            let mean = run(&shape.actor, shape.activation, &wide(actor), &normalized(row, &scale));
            let mut log_prob = 0.0;
            for (mean, log) in mean.iter().zip(logs) {
                let z: f32 = rng.sample(StandardNormal);
                actions.push((mean + f64::from(log.exp() * z)) as f32);
                log_prob += -0.5 * z * z - log - 0.5 * std::f32::consts::TAU.ln();
            }
            // of a slightly different policy
            actions.push(log_prob + 0.3 * rng.sample::<f32, _>(StandardNormal));
        }
        let targets = (0..rows).flat_map(|row| {
            let weight = if row % 7 == 3 { 0.0 } else { 1.0 };
            [rng.sample::<f32, _>(StandardNormal) + 0.3, rng.sample(StandardNormal), weight]
        });
        Self { targets: targets.collect(), raw, actions, scale }
    }

    /// Copies the samples to a device as one step of `rows` rows.
    fn upload(&self, machine: &Machine) -> (Experience, Buffer) {
        let rows = self.targets.len() / 3;
        let mut experience = Experience::new(machine, 1, rows);
        experience.raw = machine.floats(&self.raw);
        experience.actions = machine.floats(&self.actions);
        experience.targets = machine.floats(&self.targets);
        machine.moments_of(&experience.targets, 3, Some(2), &experience.target_moments);
        (experience, machine.floats(&self.scale))
    }
}

fn wide(numbers: &[f32]) -> Vec<f64> {
    numbers.iter().map(|&x| f64::from(x)).collect()
}

fn normalized(row: &[f32], scale: &[f32]) -> Vec<f64> {
    let size = row.len();
    (0..size).map(|entry| f64::from((row[entry] - scale[entry]) / scale[size + entry]).clamp(-10.0, 10.0)).collect()
}

/// Computes the outputs of a network in double precision.
fn run(sizes: &[usize], activation: Activation, parameters: &[f64], input: &[f64]) -> Vec<f64> {
    let (mut here, mut left) = (input.to_vec(), parameters);
    for (layer, pair) in sizes.windows(2).enumerate() {
        let (weights, rest) = left.split_at(pair[0] * pair[1]);
        let (biases, rest) = rest.split_at(pair[1]);
        left = rest;
        let sum = |j: usize| biases[j] + (0..pair[0]).map(|i| here[i] * weights[i * pair[1] + j]).sum::<f64>();
        let act = |x: f64| match activation {
            _ if layer + 2 == sizes.len() => x,
            Activation::Relu => x.max(0.0),
            Activation::Softsign => x / (1.0 + x.abs()),
        };
        here = (0..pair[1]).map(|j| act(sum(j))).collect();
    }
    here
}

/// Computes loss, approximate KL divergence and number of clipped ratios as in the papers, in double precision.
fn loss(shape: &NetworkShape, parameters: &[f64], samples: &Samples, config: &PpoConfig) -> [f64; 3] {
    let (size, acts) = (shape.observation(), shape.action());
    let actor = &parameters[..Mlp::count(&shape.actor)];
    let critic = &parameters[actor.len()..parameters.len() - acts];
    let logs = &parameters[parameters.len() - acts..];
    let counted: Vec<f64> =
        samples.targets.chunks_exact(3).filter(|target| target[2] > 0.0).map(|target| f64::from(target[0])).collect();
    let mean = counted.iter().sum::<f64>() / counted.len() as f64;
    let deviation = (counted.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / counted.len() as f64).sqrt();
    let rows = samples.targets.len() / 3;
    let mut sums = [0.0; 3];
    for row in 0..rows {
        let target = &samples.targets[3 * row..][..3];
        if target[2] == 0.0 {
            continue;
        }
        let seen = normalized(&samples.raw[row * size..][..size], &samples.scale);
        let own = &samples.actions[row * (acts + 1)..][..acts + 1];
        let means = run(&shape.actor, shape.activation, actor, &seen);
        let log_prob: f64 = (0..acts)
            .map(|j| {
                let z = (f64::from(own[j]) - means[j]) / logs[j].exp();
                -0.5 * z * z - logs[j] - 0.5 * std::f64::consts::TAU.ln()
            })
            .sum();
        let ratio = (log_prob - f64::from(own[acts])).exp();
        let (advantage, clip) = ((f64::from(target[0]) - mean) / deviation, config.clip_range);
        sums[0] -= (ratio * advantage).min(ratio.clamp(1.0 - clip, 1.0 + clip) * advantage) / rows as f64;
        let error = run(&shape.critic, shape.activation, critic, &seen)[0] - f64::from(target[1]);
        sums[0] += 0.5 * config.value_coef * error * error / rows as f64;
        sums[1] += ratio - 1.0 - ratio.ln();
        sums[2] += f64::from(u8::from((ratio - 1.0).abs() > clip));
    }
    sums
}

fn whole(samples: usize) -> Minibatch {
    Minibatch { start: 0, count: samples, keys: noise::keys(3, 0), first: true, renews: true }
}

fn tally_of(machine: &Machine) -> [f64; TALLY] {
    let [tally] = machine.read([&machine.tally]).unwrap();
    std::array::from_fn(|row| wide(&tally[row * LANES..][..LANES]).iter().sum())
}

#[test]
fn gradients_match_finite_differences() {
    let Some(device) = crate::device::for_tests() else { return };
    let config = config();
    for (hidden, activation, rows) in [
        (&[][..], Activation::Relu, 5),
        (&[1], Activation::Softsign, 70),
        (&[9, 6], Activation::Relu, 131),
        (&[8, 17, 3], Activation::Softsign, 64),
    ] {
        let mut rng = Rng::seed_from_u64(rows as u64);
        let shape = NetworkShape::new(5, 3, hidden, activation);
        let mut parameters = shape.initial(0.4, &mut rng);
        // the initial biases and the actor's last layer are too small to test with
        parameters.iter_mut().for_each(|x| *x += 0.2 * rng.sample::<f32, _>(StandardNormal));
        let samples = Samples::new(&shape, &parameters, rows, &mut rng);
        let mut machine = Machine::new(&device, &shape, rows);
        machine.parameters = machine.floats(&parameters);
        let (experience, scale) = samples.upload(&machine);
        machine.differentiate(&experience, &scale, &whole(rows), &config);
        let [gradient] = machine.read([&machine.gradient]).unwrap();
        let parameters = wide(&parameters);
        // short, because the rectifier and the clipped ratio have kinks
        let step = 1e-8;
        let first_log = shape.count() - shape.action();
        for index in 0..shape.count() {
            let at = |change: f64| {
                let mut parameters = parameters.clone();
                parameters[index] += change;
                loss(&shape, &parameters, &samples, &config)[0]
            };
            let bonus = if index >= first_log { config.entropy_coef } else { 0.0 };
            let expected = (at(step) - at(-step)) / (2.0 * step) - bonus;
            let apart = (f64::from(gradient[index]) - expected).abs();
            assert!(apart < 2e-5 * (1.0 + expected.abs()), "{hidden:?}, {index}: {} {expected}", gradient[index]);
        }
        let [loss, kl, clipped] = loss(&shape, &parameters, &samples, &config);
        let [squares, total, total_kl, total_clipped] = tally_of(&machine);
        assert!((squares - wide(&gradient).iter().map(|x| x * x).sum::<f64>()).abs() < 1e-5 * squares);
        assert!((total - loss).abs() < 1e-5 * (1.0 + loss.abs()), "{total} {loss}");
        assert!((total_kl - kl).abs() < 1e-4 * (1.0 + kl), "{total_kl} {kl}");
        assert_eq!(total_clipped, clipped);
    }
}

#[test]
fn gradients_of_wide_layers_match_finite_differences_along_directions() {
    let Some(device) = crate::device::for_tests() else { return };
    let (config, rows) = (config(), 300);
    let mut rng = Rng::seed_from_u64(5);
    // softsign is smooth, so that long steps are accurate
    let shape = NetworkShape::new(12, 4, &[64, 64], Activation::Softsign);
    let parameters = shape.initial(0.3, &mut rng);
    let samples = Samples::new(&shape, &parameters, rows, &mut rng);
    let mut machine = Machine::new(&device, &shape, rows);
    machine.parameters = machine.floats(&parameters);
    let (experience, scale) = samples.upload(&machine);
    let gradient_of = |part: &Minibatch| {
        machine.differentiate(&experience, &scale, part, &config);
        machine.read([&machine.gradient]).unwrap()[0].clone()
    };
    let gradient = gradient_of(&whole(rows));
    let parameters = wide(&parameters);
    let first_log = shape.count() - shape.action();
    for _ in 0..10 {
        let direction = wide(&normals(&mut rng, shape.count()));
        let at = |step: f64| {
            let moved: Vec<f64> = parameters.iter().zip(&direction).map(|(x, way)| x + step * way).collect();
            loss(&shape, &moved, &samples, &config)[0]
        };
        let bonus = config.entropy_coef * direction[first_log..].iter().sum::<f64>();
        let expected = (at(1e-6) - at(-1e-6)) / 2e-6 - bonus;
        let found: f64 = wide(&gradient).iter().zip(&direction).map(|(x, y)| x * y).sum();
        assert!((found - expected).abs() < 1e-3 * (1.0 + expected.abs()), "{found} {expected}");
    }
    // a second run gives the same bits, and the gradients of parts add up to the whole one
    assert_eq!(gradient, gradient_of(&whole(rows)));
    let parts = [(0, 128), (128, 128), (256, 44)].map(|(start, count)| {
        let share = count as f32 / rows as f32;
        let part = gradient_of(&Minibatch { start, count, ..whole(rows) });
        part.into_iter().map(|x| share * x).collect::<Vec<f32>>()
    });
    for (index, expected) in gradient.iter().enumerate() {
        let sum: f32 = parts.iter().map(|part| part[index]).sum();
        assert!((sum - expected).abs() < 1e-5 * (1.0 + expected.abs()), "{index}: {sum} {expected}");
    }
}

#[test]
fn advantages_match_a_direct_computation() {
    let Some(device) = crate::device::for_tests() else { return };
    let mut rng = Rng::seed_from_u64(2);
    let (steps, rows, config) = (17, 70, config());
    let machine = Machine::new(&device, &NetworkShape::new(2, 1, &[], Activation::Relu), rows);
    let mut experience = Experience::new(&machine, steps, rows);
    let samples = steps * rows;
    let rewards = normals(&mut rng, 2 * samples);
    let (values, next_values) = (normals(&mut rng, samples + rows), normals(&mut rng, samples));
    let next: Vec<u32> =
        (0..samples).map(|_| [RUNNING, RUNNING, TERMINATED, TRUNCATED, ABSENT][rng.random_range(0..5)]).collect();
    experience.rewards = machine.floats(&rewards);
    experience.values = machine.floats(&values);
    experience.next_values = machine.floats(&next_values);
    experience.next = words(&device, &next);
    machine.estimate(&experience, &config);
    let [targets, moments] = machine.read([&experience.targets, &experience.target_moments]).unwrap();
    let mut counted = Vec::new();
    for row in 0..rows {
        let mut after = 0.0;
        for step in (0..steps).rev() {
            let sample = step * rows + row;
            let (reward, value) = (f64::from(rewards[2 * sample]), f64::from(values[sample]));
            let (next_value, cut_value) = (f64::from(values[sample + rows]), f64::from(next_values[sample]));
            after = match next[sample] {
                RUNNING => reward + config.gamma * (next_value + config.gae_lambda * after) - value,
                TRUNCATED => reward + config.gamma * cut_value - value,
                TERMINATED => reward - value,
                _ => 0.0,
            };
            let found = wide(&targets[3 * sample..][..3]);
            assert!((found[0] - after).abs() < 1e-5 * (1.0 + after.abs()), "{found:?} {after}");
            assert!((found[1] - after - value).abs() < 1e-5 * (1.0 + after.abs()), "{found:?} {after}");
            assert_eq!(found[2], f64::from(u8::from(next[sample] != ABSENT)));
            if next[sample] != ABSENT {
                counted.push(after);
            }
        }
    }
    let mean = counted.iter().sum::<f64>() / counted.len() as f64;
    let squares = counted.iter().map(|x| (x - mean).powi(2)).sum::<f64>();
    assert_eq!(f64::from(moments[0]), counted.len() as f64);
    assert!((f64::from(moments[1]) - mean).abs() < 1e-5 && (f64::from(moments[2]) / squares - 1.0).abs() < 1e-5);
}

#[test]
fn steps_of_adam_match_the_algorithm() {
    let Some(device) = crate::device::for_tests() else { return };
    let mut rng = Rng::seed_from_u64(4);
    let shape = NetworkShape::new(7, 3, &[11], Activation::Relu);
    let config = PpoConfig { max_grad_norm: 5.0, ..config() };
    let mut machine = Machine::new(&device, &shape, 64);
    let start = normals(&mut rng, shape.count());
    machine.parameters = machine.floats(&start);
    machine.control = machine.floats(&[0.01, 0.0]);
    let first_log = shape.count() - shape.action();
    let mut expected: Vec<[f64; 3]> = start.iter().map(|&x| [f64::from(x), 0.0, 0.0]).collect();
    for time in 1..=30 {
        // norms on both sides of the limit, and large steps of the log standard deviations
        let size = if time % 2 == 0 { 0.1 } else { 2.0 };
        let gradient: Vec<f32> = normals(&mut rng, shape.count()).iter().map(|x| size * x).collect();
        let norm = wide(&gradient).iter().map(|x| x * x).sum::<f64>().sqrt();
        let shrink = (config.max_grad_norm / (norm + 1e-6)).min(1.0);
        let correction = |decay: f64| 1.0 - decay.powi(time);
        for (index, ([x, first, second], gradient)) in expected.iter_mut().zip(&gradient).enumerate() {
            let gradient = shrink * f64::from(*gradient);
            *first = 0.9 * *first + 0.1 * gradient;
            *second = 0.999 * *second + 0.001 * gradient * gradient;
            *x -= 0.01 * (*first / correction(0.9)) / ((*second / correction(0.999)).sqrt() + 1e-5);
            if index >= first_log {
                *x = x.clamp(f64::from(*LOG_DEVIATIONS.start()), f64::from(*LOG_DEVIATIONS.end()));
            }
        }
        machine.gradient = machine.floats(&gradient);
        machine.tally(0, true, true);
        machine.descend(time as usize, &config);
    }
    let [parameters, moments] = machine.read([&machine.parameters, &machine.moments]).unwrap();
    for (index, [x, first, second]) in expected.iter().enumerate() {
        assert!((f64::from(parameters[index]) - x).abs() < 1e-4, "{} {x}", parameters[index]);
        assert!((f64::from(moments[index]) - first).abs() < 1e-5);
        assert!((f64::from(moments[shape.count() + index]) - second).abs() < 1e-5);
    }
    // log standard deviations stay within their bounds
    machine.parameters = machine.floats(&[&vec![0.0; first_log][..], &[2.999, -9.999, 0.0]].concat());
    machine.control = machine.floats(&[1.0, 0.0]);
    machine.gradient = machine.floats(&[&vec![0.0; first_log][..], &[-1.0, 1.0, 0.0]].concat());
    machine.moments = machine.zeros(2 * shape.count());
    machine.tally(0, true, true);
    machine.descend(1, &config);
    let [parameters] = machine.read([&machine.parameters]).unwrap();
    assert_eq!(parameters[first_log..first_log + 2], [*LOG_DEVIATIONS.end(), *LOG_DEVIATIONS.start()]);
}

#[test]
fn a_gradient_that_is_not_finite_changes_nothing_and_sets_the_flag() {
    let Some(device) = crate::device::for_tests() else { return };
    let shape = NetworkShape::new(2, 1, &[3], Activation::Relu);
    for bad in [f32::NAN, f32::INFINITY, 1e30] {
        let mut machine = Machine::new(&device, &shape, 64);
        let start = normals(&mut Rng::seed_from_u64(1), shape.count());
        machine.parameters = machine.floats(&start);
        machine.control = machine.floats(&[0.01, 0.0]);
        let mut gradient = vec![0.5; shape.count()];
        gradient[4] = bad;
        machine.gradient = machine.floats(&gradient);
        machine.tally(0, true, true);
        machine.descend(1, &config());
        let [parameters, moments, control] =
            machine.read([&machine.parameters, &machine.moments, &machine.control]).unwrap();
        assert_eq!((parameters, control[DIVERGED], control[RATE]), (start, 1.0, 0.01), "{bad}");
        assert!(moments.iter().all(|x| *x == 0.0));
    }
}

#[test]
fn running_statistics_match_those_of_all_rows() {
    let Some(device) = crate::device::for_tests() else { return };
    let mut rng = Rng::seed_from_u64(6);
    let (size, rows) = (3, 1100);
    let machine = Machine::new(&device, &NetworkShape::new(size, 1, &[], Activation::Relu), rows);
    let running = machine.zeros(2 * (size + 1));
    let scale = machine.zeros(2 * size + 3);
    let (of_observations, of_rewards) = (machine.zeros(size * MOMENTS), machine.zeros(2 * MOMENTS));
    let mut all = [Vec::new(), Vec::new()];
    for rollout in 1..=3 {
        // a shift that single precision could not square
        let shift = [1000.0, 0.0, -5.0];
        let spread = [0.5, 1e-4, 30.0];
        let drift = rollout as f32;
        let observations: Vec<f32> = normals(&mut rng, rows * size)
            .chunks_exact(size)
            .flat_map(|row| [0, 1, 2].map(|entry| shift[entry] + spread[entry] * (row[entry] + drift)))
            .collect();
        let rewards: Vec<f32> = normals(&mut rng, 2 * rows).iter().map(|x| 4.0 * x - drift).collect();
        machine.moments_of(&machine.floats(&observations), size, None, &of_observations);
        machine.moments_of(&machine.floats(&rewards), 2, None, &of_rewards);
        launch!(
            &machine,
            scale_kernel,
            size + 1,
            of_observations.arg(),
            of_rewards.arg(),
            running.arg(),
            scale.arg(),
            1.0 / rollout as f32,
            1.0 / rollout as f32,
            size
        );
        all[0].extend(observations);
        all[1].extend(rewards);
        let [running, scale] = machine.read([&running, &scale]).unwrap();
        for entry in 0..=size {
            let column: Vec<f64> = if entry < size {
                all[0].iter().skip(entry).step_by(size).map(|&x| f64::from(x)).collect()
            } else {
                all[1].iter().skip(1).step_by(2).map(|&x| f64::from(x)).collect()
            };
            let mean = column.iter().sum::<f64>() / column.len() as f64;
            let deviation = (column.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / column.len() as f64).sqrt();
            assert!((f64::from(running[entry]) - mean).abs() < 1e-6 * (1.0 + mean.abs()) + 1e-4 * deviation);
            let found = f64::from(running[size + 1 + entry]).sqrt();
            assert!((found / deviation - 1.0).abs() < 1e-3, "{entry}: {found} {deviation}");
            let lower = if entry < size { 1e-2 } else { 1e-4 };
            let scaled = f64::from(scale[size + entry]);
            assert!((scaled / deviation.max(lower) - 1.0).abs() < 1e-3, "{entry}: {scaled} {deviation}");
        }
    }
}

#[test]
fn exploration_noise_is_normal_and_independent() {
    let Some(device) = crate::device::for_tests() else { return };
    let (rows, entries) = (20_000, 5);
    let machine = Machine::new(&device, &NetworkShape::new(1, 1, &[], Activation::Relu), 64);
    let draw = |seed: u32, step: u32| {
        let out = machine.zeros(rows * entries);
        launch!(&machine, normal_kernel, rows, out.arg(), rows as u32, entries as u32, seed, 7, step);
        machine.read([&out]).unwrap()[0].clone()
    };
    let numbers = draw(1, 0);
    // the error function of Abramowitz & Stegun, 7.1.26, within 1.5e-7
    let cumulative = |x: f64| {
        let t = 1.0 / (1.0 + 0.327_591_1 * x.abs() / std::f64::consts::SQRT_2);
        let series = [1.061_405_429, -1.453_152_027, 1.421_413_741, -0.284_496_736, 0.254_829_592];
        let erf = 1.0 - series.iter().fold(0.0, |sum, c| (sum + c) * t) * (-0.5 * x * x).exp();
        0.5 * (1.0 + erf.copysign(x))
    };
    for entry in 0..entries {
        // Kolmogorov–Smirnov at the level of 1e-6
        let mut column: Vec<f64> = numbers.iter().skip(entry).step_by(entries).map(|&x| f64::from(x)).collect();
        column.sort_by(f64::total_cmp);
        let apart = column.iter().enumerate().map(|(index, x)| (cumulative(*x) - index as f64 / rows as f64).abs());
        let distance = apart.fold(0.0, f64::max);
        assert!(distance < 2.7 / (rows as f64).sqrt(), "entry {entry}: {distance}");
    }
    let correlation = |a: &[f32], b: &[f32]| {
        let products = a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b));
        products.sum::<f64>() / a.len() as f64
    };
    let limit = 5.0 / ((rows * entries) as f64).sqrt();
    assert!(correlation(&numbers, &draw(2, 0)).abs() < limit, "seeds");
    assert!(correlation(&numbers, &draw(1, 1)).abs() < limit, "steps");
    assert!(correlation(&numbers[1..], &numbers[..numbers.len() - 1]).abs() < limit, "entries");
    assert_eq!(numbers, draw(1, 0));
}

#[test]
fn orders_of_samples_are_permutations() {
    let Some(device) = crate::device::for_tests() else { return };
    let machine = Machine::new(&device, &NetworkShape::new(1, 1, &[], Activation::Relu), 64);
    let permutation = |count: usize, seed: u64, epoch: u32| {
        let [a, b, c, d] = noise::keys(seed, epoch);
        let (out, bits) = (machine.zeros(count), noise::bits(count));
        launch!(&machine, permutation_kernel, count, out.arg(), count as u32, bits, a, b, c, d);
        words_of(&machine, &out)
    };
    for count in [1, 2, 3, 5, 64, 1000, 32_768, 33_000] {
        let order = permutation(count, 9, 1);
        let mut sorted = order.clone();
        sorted.sort_unstable();
        assert!(sorted.iter().enumerate().all(|(index, &sample)| index == sample as usize), "{count}");
        if count >= 1000 {
            // few samples stay in place or next to each other
            let fixed = order.iter().enumerate().filter(|(index, sample)| *index == **sample as usize).count();
            let adjacent = order.windows(2).filter(|pair| pair[0].abs_diff(pair[1]) == 1).count();
            assert!(fixed < 12 && adjacent < 16, "{count}: {fixed} {adjacent}");
            for (seed, epoch) in [(9, 2), (10, 1)] {
                let other = permutation(count, seed, epoch);
                let equal = order.iter().zip(&other).filter(|(a, b)| a == b).count();
                assert!(equal < 12, "{count}: {equal}");
            }
        }
    }
}

#[test]
fn a_rollout_has_the_actions_values_and_ends_of_its_policy() {
    let Some(device) = crate::device::for_tests() else { return };
    let mut config = TrainConfig::of_task("hover").unwrap();
    config.device = TrainDevice::Gpu;
    (config.ppo.environments, config.ppo.horizon) = (100, 24);
    config.episode_seconds = Some(0.25);
    config.training_starts.clear();
    let mut learner = GpuPpo::new(&config, &device).unwrap();
    let stream = learner.stream;
    stream.executes(|| {
        learner.restart_rows(1);
        learner.collect(2).unwrap();
        learner.rescale();
        learner.restart_rows(3);
        let before = learner.machine.read([&learner.scale]).unwrap()[0].clone();
        let counters = words_of(&learner.machine, &learner.counters);
        learner.collect(4).unwrap();
        let (shape, machine, experience) = (&learner.shape, &learner.machine, &learner.experience);
        let (rows, size, acts) = (100, shape.observation(), shape.action());
        let [parameters, raw, actions, values, rewards] = machine
            .read([&machine.parameters, &experience.raw, &experience.actions, &experience.values, &experience.rewards])
            .unwrap();
        let next = words_of(machine, &experience.next);
        let (actor, critic, logs) = shape.split(&parameters);
        for sample in 0..experience.samples() {
            let seen = normalized(&raw[sample * size..][..size], &before);
            let means = run(&shape.actor, shape.activation, &wide(actor), &seen);
            let own = wide(&actions[sample * (acts + 1)..][..acts + 1]);
            let log_prob: f64 = (0..acts)
                .map(|j| {
                    let z = (own[j] - means[j]) / f64::from(logs[j]).exp();
                    -0.5 * z * z - f64::from(logs[j]) - 0.5 * std::f64::consts::TAU.ln()
                })
                .sum();
            assert!((own[acts] - log_prob).abs() < 1e-3, "{sample}: {} {log_prob}", own[acts]);
            let value = run(&shape.critic, shape.activation, &wide(critic), &seen)[0];
            assert!((f64::from(values[sample]) - value).abs() < 1e-4, "{sample}: {} {value}", values[sample]);
        }
        let divisor = before[2 * size];
        let limit = learner.env.episode_steps() as u32;
        let mut ends = [0; 4];
        let (mut first_ends, mut discounted) = (Vec::new(), vec![0.0; rows]);
        for (row, discounted) in discounted.iter_mut().enumerate() {
            let (mut age, mut length) = (0, counters[rows + row]);
            assert!((1..=limit).contains(&length));
            for step in 0..24 {
                let sample = step * rows + row;
                age += 1;
                // an episode ends at its length at the latest
                assert!(age < length || next[sample] != RUNNING, "row {row}, step {step}");
                assert!(next[sample] != TRUNCATED || age == length, "row {row}, step {step}");
                let [scaled, sum] = [rewards[2 * sample], rewards[2 * sample + 1]];
                if scaled.abs() < 9.99 {
                    let expected = learner.config.gamma as f32 * *discounted + scaled * divisor;
                    assert!((sum - expected).abs() < 1e-3 * (1.0 + expected.abs()), "{sum} {expected}");
                }
                *discounted = sum;
                ends[next[sample] as usize] += 1;
                if next[sample] != RUNNING {
                    if length != limit {
                        first_ends.push(step);
                    }
                    (age, length, *discounted) = (0, limit, 0.0);
                }
            }
        }
        assert!(ends[TRUNCATED as usize] > 100, "{ends:?}");
        // the first truncations are spread over the length of an episode
        first_ends.sort_unstable();
        first_ends.dedup();
        assert!(first_ends.len() >= 10, "{first_ends:?}");
    });
}
