//! Loss of PPO and its gradient over a shard of a minibatch.

use std::cell::RefCell;

use aviary::engine::flight::Width;
use pulp::{Simd, WithSimd};

use crate::gradient::{Aligned, Network, Pass, TILE, padded, run};
use crate::network::NetworkShape;

/// Bound of the absolute log-ratio of new and old action probabilities. A row beyond it has the ratio exp(±20) and
/// no gradient; without the bound, exp overflows at 88.
const MAX_LOG_RATIO: f32 = 20.0;

/// Rows of experience.
#[derive(Debug, Clone, Copy)]
pub(super) struct Samples<'a> {
    /// Normalized observations.
    pub observations: &'a [f32],
    pub actions: &'a [f32],
    /// Log-probabilities of the actions under the policy that sampled them.
    pub log_probs: &'a [f32],
    /// Normalized advantages.
    pub advantages: &'a [f32],
    pub returns: &'a [f32],
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
    log_deviations: Vec<f32>,
    /// Reciprocals of the standard deviations.
    precisions: Vec<f32>,
}

impl Networks {
    pub fn new(shape: &NetworkShape, width: Width) -> Self {
        Self {
            actor: Network::new(&shape.actor, shape.activation),
            critic: Network::new(&shape.critic, shape.activation),
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

thread_local! {
    static SCRATCH: RefCell<Option<Scratch>> = const { RefCell::new(None) };
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
