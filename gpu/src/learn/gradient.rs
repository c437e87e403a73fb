//! Kernels of an update: gradient of the loss over a minibatch, and a step of Adam.
//!
//! 1. [`backpropagate_kernel`]: a thread per sample and network computes activations and their gradients.
//! 2. [`weights_kernel`]: [`LANES`] threads per [`TILE`] × [`TILE`] block of weights each sum the products of every
//!    [`LANES`]-th sample.
//! 3. [`reduce_kernel`]: a thread per parameter sums the results of the lanes.
//! 4. [`tally_kernel`]: [`LANES`] threads sum squares of the gradient, and loss, KL divergence and clipped ratios.
//! 5. [`adam_kernel`]: a thread per parameter clips the gradient by its norm and updates the parameter.
//!
//! Every sum has a fixed order, so that equal inputs give equal bits on a device.

use cubecl::prelude::*;
use learn::{DECAY, LOG_DEVIATIONS, MAX_LOG_RATIO};

use super::network::{Columns, Networks, backward, forward, read_observation};
use super::noise::permuted;
use super::rollout::HALF_LOG_TAU;

/// Threads that share a sum over samples.
pub(super) const LANES: usize = 64;

/// Rows and columns of a block of weights.
pub(super) const TILE: usize = 8;

/// Entries of `control`: learning rate, and 1 after a gradient that was not finite.
pub(super) const CONTROL: usize = 2;
/// Index of the learning rate in `control`.
pub(super) const RATE: usize = 0;
/// Index of the flag of a gradient that was not finite in `control`.
pub(super) const DIVERGED: usize = 1;

/// Rows of the losses of a minibatch: of the policy, of the critic, KL divergence, 1 for a clipped ratio.
pub(super) const LOSSES: usize = 4;

/// Rows of the tally: squares of the gradient, loss, KL divergence, clipped ratios; [`LANES`] numbers each.
pub(super) const TALLY: usize = 4;

/// Largest square of the norm of a finite gradient.
const MAX_SQUARE: f32 = 1e37;

/// Blocks of weights, and the place of every parameter in them.
#[derive(Debug)]
pub(super) struct Tiles {
    /// Rows of the scratch matrix of every block: [`TILE`] inputs and [`TILE`] gradients.
    pub rows: Vec<u32>,
    /// Index of every parameter among the numbers of all blocks.
    pub places: Vec<u32>,
}

impl Tiles {
    /// Arranges the parameters of networks in blocks. The biases of a layer are weights of an input of one, and the log
    /// standard deviations are biases.
    pub fn new(networks: &Networks) -> Self {
        let mut tiles = Self { rows: Vec::new(), places: vec![0; networks.count()] };
        for network in [&networks.actor, &networks.critic] {
            for layer in 0..network.layers() {
                let [inputs, outputs] = network.size(layer);
                let first = network.values(layer);
                let input_rows: Vec<_> = (first..first + inputs).chain([networks.ones()]).collect();
                tiles.add(networks, &input_rows, network.gradients(layer), outputs, network.parameters(layer));
            }
        }
        tiles.add(networks, &[networks.ones()], networks.log_gradients(), networks.action(), networks.log_deviations());
        tiles
    }

    /// Adds the matrix of the products of input rows and `outputs` gradient rows, whose parameters begin at `first`.
    fn add(&mut self, networks: &Networks, inputs: &[usize], gradient: usize, outputs: usize, first: usize) {
        for top in (0..inputs.len()).step_by(TILE) {
            for left in (0..outputs).step_by(TILE) {
                let tile = self.rows.len() / (2 * TILE);
                // sums beyond the matrix are no parameter's
                let spare = networks.ones();
                let rows = (top..top + TILE).map(|i| inputs.get(i).copied().unwrap_or(spare));
                let columns = (left..left + TILE).map(|j| if j < outputs { gradient + j } else { spare });
                self.rows.extend(rows.chain(columns).map(|row| row as u32));
                for i in top..inputs.len().min(top + TILE) {
                    for j in left..outputs.min(left + TILE) {
                        let place = (tile * TILE + i - top) * TILE + j - left;
                        self.places[first + i * outputs + j] = place as u32;
                    }
                }
            }
        }
    }

    /// Returns the number of blocks.
    pub fn count(&self) -> usize {
        self.rows.len() / (2 * TILE)
    }
}

/// Computes the loss of the samples of a minibatch and its gradients with respect to all sums of the networks: the
/// first half of the threads those of the actor, the second half those of the critic (Schulman et al. 2017, eq. 9). A
/// thread computes `per_thread` samples.
///
/// `raw`, `actions`, `targets` and `scale` are those of the rollout, and `moments` those of the columns of `targets`.
/// The minibatch begins at `start` of the permutation of `samples` samples with these keys.
#[cube(launch_unchecked)]
#[allow(clippy::too_many_arguments)] // the buffers of a kernel
pub(super) fn backpropagate_kernel(
    raw: &[f32],
    actions: &[f32],
    targets: &[f32],
    moments: &[f32],
    scale: &[f32],
    parameters: &[f32],
    scratch: &mut [f32],
    losses: &mut [f32],
    start: u32,
    count: u32,
    width: u32,
    samples: u32,
    bits: u32,
    a: u32,
    b: u32,
    c: u32,
    d: u32,
    clip_range: f32,
    value_coef: f32,
    #[comptime] networks: Networks,
    #[comptime] per_thread: usize,
) {
    let (count, width) = (count as usize, width as usize);
    let threads = count.div_ceil(per_thread);
    let size = comptime!(networks.observation());
    let share = 1.0 / count as f32;
    if ABSOLUTE_POS < threads {
        let columns = Columns { first: ABSOLUTE_POS, stride: threads, width };
        let acts = comptime!(networks.action());
        let (inputs, means, slopes) = comptime!((
            networks.actor.values(0),
            networks.actor.values(networks.actor.layers()),
            networks.actor.gradients(networks.actor.layers() - 1)
        ));
        let (logs, log_slopes) = comptime!((networks.log_deviations(), networks.log_gradients()));
        for part in 0..per_thread {
            let column = columns.first + part * columns.stride;
            let sample = sample_of(column, start, count, samples, bits, a, b, c, d);
            read_observation(raw, scale, scratch, sample, column, width, size, inputs);
        }
        forward(parameters, scratch, &columns, comptime!(networks.actor.clone()), per_thread);
        let deviation = (moments[2] / moments[0]).sqrt();
        for part in 0..per_thread {
            let column = columns.first + part * columns.stride;
            let sample = sample_of(column, start, count, samples, bits, a, b, c, d);
            // distances from the means in standard deviations, z
            let mut squares = 0.0f32;
            let mut spread = 0.0f32;
            for entry in 0..acts {
                let log = parameters[logs + entry];
                let apart = actions[sample * (acts + 1) + entry] - scratch[(means + entry) * width + column];
                let z = apart * (-log).exp();
                squares += z * z;
                spread += log + HALF_LOG_TAU;
                scratch[(slopes + entry) * width + column] = z;
            }
            let free = -(0.5 * squares + spread) - actions[sample * (acts + 1) + acts];
            let below = select(free < -MAX_LOG_RATIO, -MAX_LOG_RATIO, free);
            let log_ratio = select(below > MAX_LOG_RATIO, MAX_LOG_RATIO, below);
            let ratio = log_ratio.exp();
            let advantage = (targets[3 * sample] - moments[1]) / (deviation + 1e-8);
            let weight = targets[3 * sample + 2];
            let gain = ratio * advantage;
            let above = select(ratio < 1.0 - clip_range, 1.0 - clip_range, ratio);
            let clipped_gain = select(above > 1.0 + clip_range, 1.0 + clip_range, above) * advantage;
            // d log p / d mean = z / σ, and d log p / d log σ = z² − 1
            let has_slope = gain <= clipped_gain && free == log_ratio;
            let slope = select(has_slope, -share * gain * weight, 0.0);
            for entry in 0..acts {
                let z = scratch[(slopes + entry) * width + column];
                scratch[(log_slopes + entry) * width + column] = slope * (z * z - 1.0);
                scratch[(slopes + entry) * width + column] = slope * z * (-parameters[logs + entry]).exp();
            }
            scratch[comptime!(networks.ones()) * width + column] = 1.0;
            losses[column] = -share * weight * select(gain <= clipped_gain, gain, clipped_gain);
            // (r − 1) − log r is never negative, and its mean estimates the KL divergence (Schulman 2020)
            losses[2 * width + column] = weight * (ratio - 1.0 - log_ratio);
            losses[3 * width + column] = select((ratio - 1.0).abs() > clip_range, weight, 0.0);
        }
        backward(parameters, scratch, &columns, comptime!(networks.actor.clone()), per_thread);
    } else if ABSOLUTE_POS < 2 * threads {
        let columns = Columns { first: ABSOLUTE_POS - threads, stride: threads, width };
        let (inputs, output, slope) = comptime!((
            networks.critic.values(0),
            networks.critic.values(networks.critic.layers()),
            networks.critic.gradients(networks.critic.layers() - 1)
        ));
        for part in 0..per_thread {
            let column = columns.first + part * columns.stride;
            let sample = sample_of(column, start, count, samples, bits, a, b, c, d);
            read_observation(raw, scale, scratch, sample, column, width, size, inputs);
        }
        forward(parameters, scratch, &columns, comptime!(networks.critic.clone()), per_thread);
        for part in 0..per_thread {
            let column = columns.first + part * columns.stride;
            let sample = sample_of(column, start, count, samples, bits, a, b, c, d);
            let error = (scratch[output * width + column] - targets[3 * sample + 1]) * targets[3 * sample + 2];
            scratch[slope * width + column] = share * value_coef * error;
            losses[width + column] = share * 0.5 * value_coef * error * error;
        }
        backward(parameters, scratch, &columns, comptime!(networks.critic.clone()), per_thread);
    }
}

/// Returns the sample of a column of the scratch matrix. Columns beyond the minibatch, which nobody reads, repeat its
/// last sample.
#[cube]
#[allow(clippy::too_many_arguments)]
fn sample_of(
    column: usize,
    start: u32,
    count: usize,
    samples: u32,
    bits: u32,
    a: u32,
    b: u32,
    c: u32,
    d: u32,
) -> usize {
    let position = start + select(column < count, column, count - 1) as u32;
    permuted(position, samples, bits, a, b, c, d) as usize
}

/// Computes partial sums of the gradient with respect to a block of weights: the thread of a lane sums the samples
/// lane, lane + [`LANES`], ….
#[cube(launch_unchecked)]
pub(super) fn weights_kernel(rows: &[u32], scratch: &[f32], partial: &mut [f32], count: u32, width: u32, tiles: u32) {
    let (tile, lane) = (ABSOLUTE_POS / LANES, ABSOLUTE_POS % LANES);
    let (count, width, tiles) = (count as usize, width as usize, tiles as usize);
    if tile < tiles {
        let first = tile * comptime!(2 * TILE);
        let mut inputs = Array::<usize>::new(TILE);
        let mut slopes = Array::<usize>::new(TILE);
        #[unroll]
        for k in 0..TILE {
            inputs[k] = rows[first + k] as usize * width;
            slopes[k] = rows[first + TILE + k] as usize * width;
        }
        let mut sums = Array::<f32>::new(comptime!(TILE * TILE));
        #[unroll]
        for k in 0..comptime!(TILE * TILE) {
            sums[k] = 0.0;
        }
        for round in 0..count.div_ceil(LANES) {
            let column = round * LANES + lane;
            if column < count {
                #[unroll]
                for i in 0..TILE {
                    let x = scratch[inputs[i] + column];
                    #[unroll]
                    for j in 0..TILE {
                        sums[i * TILE + j] += x * scratch[slopes[j] + column];
                    }
                }
            }
        }
        let out = (lane * tiles + tile) * comptime!(TILE * TILE);
        #[unroll]
        for k in 0..comptime!(TILE * TILE) {
            partial[out + k] = sums[k];
        }
    }
}

/// Sums the gradient of every parameter over the lanes, and adds that of the entropy bonus, which depends on no sample.
#[cube(launch_unchecked)]
pub(super) fn reduce_kernel(
    places: &[u32],
    partial: &[f32],
    gradient: &mut [f32],
    tiles: u32,
    entropy_coef: f32,
    #[comptime] parameters: usize,
    #[comptime] log_deviations: usize,
) {
    if ABSOLUTE_POS < parameters {
        let place = places[ABSOLUTE_POS] as usize;
        let mut sum = select(ABSOLUTE_POS >= log_deviations, -entropy_coef, 0.0);
        for lane in 0..LANES {
            sum += partial[lane * tiles as usize * comptime!(TILE * TILE) + place];
        }
        gradient[ABSOLUTE_POS] = sum;
    }
}

/// Sums the squares of the gradient, and adds the losses of a minibatch to the tally. With `first`, the tally begins
/// with this minibatch; with `renews`, the KL divergence does.
#[cube(launch_unchecked)]
#[allow(clippy::too_many_arguments)]
pub(super) fn tally_kernel(
    gradient: &[f32],
    losses: &[f32],
    tally: &mut [f32],
    count: u32,
    width: u32,
    first: u32,
    renews: u32,
    #[comptime] parameters: usize,
) {
    if ABSOLUTE_POS < LANES {
        let lane = ABSOLUTE_POS;
        let (count, width) = (count as usize, width as usize);
        let mut squares = 0.0f32;
        for round in 0..comptime!(parameters.div_ceil(LANES)) {
            let index = round * LANES + lane;
            if index < parameters {
                squares += gradient[index] * gradient[index];
            }
        }
        tally[lane] = squares;
        let mut loss = select(first > 0, 0.0, tally[LANES + lane]);
        let mut kl = select(renews > 0, 0.0, tally[2 * LANES + lane]);
        let mut clipped = select(first > 0, 0.0, tally[3 * LANES + lane]);
        for round in 0..count.div_ceil(LANES) {
            let column = round * LANES + lane;
            if column < count {
                loss += losses[column] + losses[width + column];
                kl += losses[2 * width + column];
                clipped += losses[3 * width + column];
            }
        }
        tally[LANES + lane] = loss;
        tally[2 * LANES + lane] = kl;
        tally[3 * LANES + lane] = clipped;
    }
}

/// Updates the parameters by a step of Adam (Kingma & Ba 2015) against the gradient, clipped to a norm. `moments` has
/// the first and then the second moments. `correction` is √(1 − β₂ᵗ) / (1 − β₁ᵗ), and `epsilon` is ε·√(1 − β₂ᵗ). A
/// gradient that is not finite changes nothing and sets the flag of `control`.
#[cube(launch_unchecked)]
#[allow(clippy::too_many_arguments)]
pub(super) fn adam_kernel(
    gradient: &[f32],
    tally: &[f32],
    parameters: &mut [f32],
    moments: &mut [f32],
    control: &mut [f32],
    max_norm: f32,
    correction: f32,
    epsilon: f32,
    #[comptime] count: usize,
    #[comptime] log_deviations: usize,
) {
    if ABSOLUTE_POS < count {
        let index = ABSOLUTE_POS;
        let mut square = 0.0f32;
        for lane in 0..LANES {
            square += tally[lane];
        }
        // a comparison with NaN is false
        if square < MAX_SQUARE {
            let norm = square.sqrt();
            let shrink = max_norm / (norm + 1e-6);
            let x = gradient[index] * select(shrink < 1.0, shrink, 1.0);
            let (decay, slow_decay) = comptime!((DECAY[0], DECAY[1]));
            let first = decay * moments[index] + comptime!(1.0 - DECAY[0]) * x;
            let second = slow_decay * moments[count + index] + comptime!(1.0 - DECAY[1]) * (x * x);
            moments[index] = first;
            moments[count + index] = second;
            let mut parameter = parameters[index] - control[RATE] * correction * first / (second.sqrt() + epsilon);
            if index >= log_deviations {
                let (low, high) = comptime!((*LOG_DEVIATIONS.start(), *LOG_DEVIATIONS.end()));
                parameter = select(parameter < low, low, parameter);
                parameter = select(parameter > high, high, parameter);
            }
            parameters[index] = parameter;
        } else if index == 0 {
            control[DIVERGED] = 1.0;
        }
    }
}
