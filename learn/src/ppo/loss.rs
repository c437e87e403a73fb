//! Loss of PPO and its gradient over a shard of a minibatch.

use std::cell::RefCell;

use aviary::engine::flight::Width;
use pulp::{Simd, WithSimd};

use crate::agents::Next;
use crate::gradient::{Aligned, Network, Pass, Place, Recurrent, RecurrentPass, TILE, Tile, padded, run};
use crate::network::NetworkShape;

/// Bound of the absolute log-ratio of new and old action probabilities. A row beyond it has the ratio exp(±20) and
/// no gradient; without the bound, exp overflows at 88.
pub const MAX_LOG_RATIO: f32 = 20.0;

/// Rows of experience.
#[derive(Debug, Clone, Copy)]
pub(super) struct Samples<'a> {
    /// Normalized observations; with a recurrent layer the inputs of actor and critic, which begin with these.
    pub observations: &'a [f32],
    pub actions: &'a [f32],
    /// Log-probabilities of the actions under the policy that sampled them.
    pub log_probs: &'a [f32],
    /// Normalized advantages.
    pub advantages: &'a [f32],
    pub returns: &'a [f32],
    /// Sequences of the rows; only read with a recurrent layer.
    pub sequences: Sequences<'a>,
}

/// Sequences of a rollout, steps × sequences.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Sequences<'a> {
    /// Number of sequences.
    pub count: usize,
    /// Status of the episodes after every step. The loss ignores rows of absent agents.
    pub next: &'a [Next],
    /// States of the recurrent layer before the first step, one row per sequence.
    pub starts: &'a [f32],
}

/// Coefficients of the loss (Schulman et al. 2017, eq. 9).
#[derive(Debug, Clone, Copy)]
pub(super) struct Loss {
    /// Clip range of the probability ratio.
    pub clip_range: f32,
    /// Weight of the value loss.
    pub value: f32,
    /// Number of rows of the minibatch, over which the loss is a mean.
    pub rows: usize,
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

/// Actor and critic, arranged for gradients.
#[derive(Debug)]
pub(super) struct Networks {
    shape: NetworkShape,
    width: Width,
    actor: Network,
    critic: Network,
    recurrent: Option<Recurrent>,
    log_deviations: Vec<f32>,
    /// Reciprocals of the standard deviations.
    precisions: Vec<f32>,
}

impl Networks {
    pub fn new(shape: &NetworkShape, width: Width) -> Self {
        Self {
            actor: Network::new(&shape.actor, shape.activation),
            critic: Network::new(&shape.critic, shape.activation),
            recurrent: (shape.recurrent > 0).then(|| Recurrent::new(shape.observation(), shape.recurrent)),
            log_deviations: vec![0.0; shape.action()],
            precisions: vec![1.0; shape.action()],
            shape: shape.clone(),
            width,
        }
    }

    /// Sets the parameters.
    pub fn set(&mut self, parameters: &[f32]) {
        let (actor, critic, log_deviations) = self.shape.split(parameters);
        self.actor.set(actor);
        self.critic.set(critic);
        if let Some(recurrent) = &mut self.recurrent {
            recurrent.set(self.shape.recurrent_part(parameters));
        }
        self.log_deviations.copy_from_slice(log_deviations);
        self.precisions.clear();
        self.precisions.extend(log_deviations.iter().map(|log| (-log).exp()));
    }

    /// Writes the gradient of the loss over rows of a minibatch, and returns the sums of these rows. The gradients of
    /// the shards add up to the minibatch's. The entropy bonus depends on no row, so that the caller adds its gradient
    /// once.
    pub fn gradient(&self, samples: &Samples<'_>, entries: &[u32], loss: &Loss, out: &mut [f32]) -> Sums {
        SCRATCH.with_borrow_mut(|scratch| {
            let scratch = match scratch {
                Some(scratch) if scratch.shape == self.shape => scratch,
                _ => scratch.insert(Scratch::new(&self.shape)),
            };
            run(self.width, Shard { networks: self, samples, entries, loss, scratch, out })
        })
    }

    /// Writes the gradient of the loss over sequences of a minibatch, through the recurrent layer and through time, and
    /// returns the sums of their rows, like [`gradient`](Self::gradient). The critic reads the states of the recurrent
    /// layer as constants.
    ///
    /// # Panics
    /// Without a recurrent layer.
    pub fn gradient_through_time(
        &self,
        samples: &Samples<'_>,
        sequences: &[u32],
        loss: &Loss,
        out: &mut [f32],
    ) -> Sums {
        let rows = sequences.len() * samples.sequences.next.len() / samples.sequences.count;
        UNROLLED.with_borrow_mut(|scratch| {
            let scratch = match scratch {
                Some(scratch) if scratch.shape == self.shape && scratch.capacity >= rows => scratch,
                _ => scratch.insert(Unrolled::new(&self.shape, rows)),
            };
            run(self.width, ThroughTime { networks: self, samples, sequences, loss, scratch, out })
        })
    }
}

/// Buffers of a thread.
#[derive(Debug)]
struct Scratch {
    shape: NetworkShape,
    /// Observations of a tile.
    input: Aligned,
    actor: Pass,
    critic: Pass,
}

/// Buffers of a thread for sequences.
#[derive(Debug)]
struct Unrolled {
    shape: NetworkShape,
    /// Maximum number of rows.
    capacity: usize,
    /// Observations.
    input: Aligned,
    /// Inputs of actor and critic.
    features: Aligned,
    feature_gradients: Aligned,
    /// Entries of the rows in the experience.
    entries: Vec<u32>,
    has_ended: Vec<bool>,
    recurrent: RecurrentPass,
    actor: Pass,
    critic: Pass,
}

thread_local! {
    static SCRATCH: RefCell<Option<Scratch>> = const { RefCell::new(None) };
    static UNROLLED: RefCell<Option<Unrolled>> = const { RefCell::new(None) };
}

impl Unrolled {
    fn new(shape: &NetworkShape, capacity: usize) -> Self {
        let features = || Aligned::new(capacity * padded(shape.features()));
        Self {
            capacity,
            input: Aligned::new(capacity * padded(shape.observation())),
            features: features(),
            feature_gradients: features(),
            entries: Vec::new(),
            has_ended: Vec::new(),
            recurrent: RecurrentPass::new(shape.observation(), shape.recurrent, capacity),
            actor: Pass::new(&shape.actor),
            critic: Pass::new(&shape.critic),
            shape: shape.clone(),
        }
    }
}

impl Scratch {
    fn new(shape: &NetworkShape) -> Self {
        Self {
            input: Aligned::new(TILE * padded(shape.observation())),
            actor: Pass::new(&shape.actor),
            critic: Pass::new(&shape.critic),
            shape: shape.clone(),
        }
    }
}

/// Gradient over a shard of a minibatch, tile by tile.
struct Shard<'a> {
    networks: &'a Networks,
    samples: &'a Samples<'a>,
    /// Rows of the shard.
    entries: &'a [u32],
    loss: &'a Loss,
    scratch: &'a mut Scratch,
    out: &'a mut [f32],
}

impl WithSimd for Shard<'_> {
    type Output = Sums;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Sums {
        let Self { networks, samples, entries, loss, scratch, out } = self;
        let Scratch { input, actor, critic, .. } = scratch;
        actor.clear();
        critic.clear();
        let size = networks.shape.observation();
        let (rest, log_gradients) = out.split_at_mut(out.len() - networks.shape.action());
        log_gradients.fill(0.0);
        let mut sums = Sums::default();
        for entries in entries.chunks(TILE) {
            for (row, &entry) in input.chunks_exact_mut(padded(size)).zip(entries) {
                row[..size].copy_from_slice(&samples.observations[entry as usize * size..][..size]);
            }
            actor.forward(simd, &networks.actor, entries.len(), input);
            critic.forward(simd, &networks.critic, entries.len(), input);
            networks.differentiate(samples, entries, loss, actor.ends(), critic.ends(), log_gradients, &mut sums);
            actor.backward(simd, &networks.actor, entries.len(), input);
            critic.backward(simd, &networks.critic, entries.len(), input);
        }
        let rest = actor.write(rest);
        critic.write(rest);
        sums
    }
}

/// Gradient over sequences of a minibatch, all of them in one pass through time.
struct ThroughTime<'a> {
    networks: &'a Networks,
    samples: &'a Samples<'a>,
    /// Indices of the sequences.
    sequences: &'a [u32],
    loss: &'a Loss,
    scratch: &'a mut Unrolled,
    out: &'a mut [f32],
}

impl WithSimd for ThroughTime<'_> {
    type Output = Sums;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Sums {
        let Self { networks, samples, sequences, loss, scratch, out } = self;
        let Unrolled { input, features, feature_gradients, entries, has_ended, recurrent, actor, critic, .. } = scratch;
        let Some(layer) = &networks.recurrent else { unreachable!("a gradient through time has a recurrent layer") };
        let Sequences { count, next, starts } = samples.sequences;
        let shape = &networks.shape;
        let (size, units) = (shape.observation(), shape.recurrent);
        let place = Place { stride: padded(shape.features()), first: size };
        recurrent.clear();
        actor.clear();
        critic.clear();
        for (row, &sequence) in sequences.iter().enumerate() {
            recurrent.start(row, &starts[sequence as usize * units..][..units]);
        }
        entries.clear();
        for step in 0..next.len() / count {
            entries.extend(sequences.iter().map(|&sequence| (step * count) as u32 + sequence));
        }
        has_ended.clear();
        has_ended.extend(entries.iter().map(|&entry| next[entry as usize].is_end()));
        let rows = entries.len();
        for (row, &entry) in entries.iter().enumerate() {
            let observation = &samples.observations[entry as usize * shape.features()..][..size];
            input[row * padded(size)..][..size].copy_from_slice(observation);
            features[row * place.stride..][..size].copy_from_slice(observation);
        }
        let tile = Tile { count: sequences.len(), input, has_ended };
        recurrent.forward(simd, layer, tile, features, place);
        feature_gradients[..rows * place.stride].fill(0.0);
        let (rest, log_gradients) = out.split_at_mut(out.len() - shape.action());
        log_gradients.fill(0.0);
        let mut sums = Sums::default();
        for (index, entries) in entries.chunks(TILE).enumerate() {
            let (first, rows) = (index * TILE * place.stride, entries.len());
            let features = &features[first..];
            actor.forward(simd, &networks.actor, rows, features);
            critic.forward(simd, &networks.critic, rows, features);
            networks.differentiate(samples, entries, loss, actor.ends(), critic.ends(), log_gradients, &mut sums);
            actor.backward(simd, &networks.actor, rows, features);
            critic.backward(simd, &networks.critic, rows, features);
            actor.add_input_gradients(simd, &networks.actor, rows, &mut feature_gradients[first..]);
        }
        recurrent.backward(simd, layer, tile, feature_gradients, place);
        let rest = actor.write(rest);
        let rest = critic.write(rest);
        recurrent.write(rest);
        sums
    }
}

impl Networks {
    /// Computes the loss of the rows of a tile, and writes its gradient with respect to the outputs of the networks.
    /// Adds the gradient with respect to the log standard deviations.
    #[inline(always)]
    #[allow(clippy::too_many_arguments)]
    fn differentiate(
        &self,
        samples: &Samples<'_>,
        entries: &[u32],
        loss: &Loss,
        (means, mean_gradients): (&[f32], &mut [f32]),
        (values, value_gradients): (&[f32], &mut [f32]),
        log_gradients: &mut [f32],
        sums: &mut Sums,
    ) {
        let acts = self.log_deviations.len();
        let wide = padded(acts);
        let share = 1.0 / loss.rows as f32;
        let constant: f32 = self.log_deviations.iter().map(|log| log + 0.5 * std::f32::consts::TAU.ln()).sum();
        let (low, high) = (1.0 - loss.clip_range, 1.0 + loss.clip_range);
        let mut total = 0.0;
        for (row, &entry) in entries.iter().enumerate() {
            let entry = entry as usize;
            if samples.sequences.next.get(entry) == Some(&Next::Absent) {
                mean_gradients[row * wide..][..acts].fill(0.0);
                value_gradients[row * padded(1)] = 0.0;
                continue;
            }
            let actions = &samples.actions[entry * acts..][..acts];
            let means = &means[row * wide..][..acts];
            let mean_gradients = &mut mean_gradients[row * wide..][..acts];
            // the distances from the means in standard deviations, z
            let mut squares = 0.0;
            for (((z, action), mean), precision) in
                mean_gradients.iter_mut().zip(actions).zip(means).zip(&self.precisions)
            {
                *z = (action - mean) * precision;
                squares += *z * *z;
            }
            let free = -0.5 * squares - constant - samples.log_probs[entry];
            let log_ratio = free.clamp(-MAX_LOG_RATIO, MAX_LOG_RATIO);
            let ratio = log_ratio.exp();
            let advantage = samples.advantages[entry];
            let gain = ratio * advantage;
            let clipped_gain = ratio.clamp(low, high) * advantage;
            // d log p / d mean = z / σ, and d log p / d log σ = z² − 1
            let slope = if gain <= clipped_gain && free == log_ratio { -share * gain } else { 0.0 };
            for ((z, precision), log) in mean_gradients.iter_mut().zip(&self.precisions).zip(&mut *log_gradients) {
                *log += slope * (*z * *z - 1.0);
                *z *= slope * precision;
            }
            let error = values[row * padded(1)] - samples.returns[entry];
            value_gradients[row * padded(1)] = share * loss.value * error;
            total += f64::from(0.5 * loss.value * error * error - gain.min(clipped_gain));
            // (r − 1) − log r is never negative, and its mean estimates the KL divergence (Schulman 2020)
            sums.approx_kl += f64::from(ratio - 1.0 - log_ratio);
            sums.clipped += f64::from(u8::from((ratio - 1.0).abs() > loss.clip_range));
        }
        sums.loss += total / loss.rows as f64;
    }
}

#[cfg(test)]
mod tests;
