//! Update: epochs of minibatches over a rollout.

use std::time::Instant;

use aviary::env::Rng;
use rand::SeedableRng as _;
use rand::seq::SliceRandom as _;
use rayon::prelude::*;

use super::advantage::moments;
use super::loss::{Loss, Samples, Sequences, Sums};
use super::{Ppo, Report, SHARD, shard_sequences};
use crate::agents::Next;
use crate::network::LOG_DEVIATIONS;

impl Ppo {
    /// Updates the parameters in several epochs over the rollout.
    pub(super) fn update(&mut self, seed: u64, report: &mut Report) -> Result<(), crate::TrainError> {
        let began = Instant::now();
        let acts = self.shape.action();
        let experience = &mut self.experience;
        let mut order: Vec<u32> = (0..experience.next.len() as u32)
            .filter(|&entry| experience.next[entry as usize] != Next::Absent)
            .collect();
        let (mean, deviation) = moments(order.iter().map(|&entry| experience.advantages[entry as usize]));
        for advantage in &mut experience.advantages {
            *advantage = (*advantage - mean) / (deviation + 1e-8);
        }
        // without a recurrent layer a minibatch consists of steps, otherwise of whole sequences
        let (size, shard) = match self.shape.recurrent {
            0 => (self.config.minibatch, SHARD),
            _ => (self.config.sequences(), shard_sequences(self.config.horizon)),
        };
        let has_memory = self.shape.recurrent > 0;
        let count = experience.next.len() / self.config.horizon;
        let present = |sequence: u32| {
            let steps = experience.next.iter().skip(sequence as usize).step_by(count);
            steps.filter(|next| **next != Next::Absent).count()
        };
        if has_memory {
            order = (0..count as u32).filter(|&sequence| present(sequence) > 0).collect();
        }
        let samples = Samples {
            observations: &experience.observations,
            actions: &experience.actions,
            log_probs: &experience.log_probs,
            advantages: &experience.advantages,
            returns: &experience.returns,
            sequences: match has_memory {
                false => Sequences::default(),
                true => Sequences { count, next: &experience.next, starts: &experience.starts },
            },
        };
        let entropy = self.config.entropy_coef as f32;
        let mut rng = Rng::seed_from_u64(seed);
        let (mut totals, mut minibatches, mut seen) = (Sums::default(), 0, 0);
        for _ in 0..self.config.epochs {
            // the approximate KL divergence of the last epoch is that of the whole update
            (totals.approx_kl, seen) = (0.0, 0);
            order.shuffle(&mut rng);
            // a last minibatch of less than half the size is skipped; the shuffle moves its rows in the next epoch
            let minibatches_of = order.chunks(size).filter(|part| 2 * part.len() >= size.min(order.len()));
            for minibatch in minibatches_of {
                let rows = if has_memory { minibatch.iter().map(|&row| present(row)).sum() } else { minibatch.len() };
                let loss =
                    Loss { clip_range: self.config.clip_range as f32, value: self.config.value_coef as f32, rows };
                self.networks.set(&self.parameters);
                let networks = &self.networks;
                (minibatch.par_chunks(shard).zip(&mut self.shards)).for_each(|(part, (gradient, sums))| {
                    *sums = match has_memory {
                        false => networks.gradient(&samples, part, &loss, gradient),
                        true => networks.gradient_through_time(&samples, part, &loss, gradient),
                    };
                });
                let (first, others) = self.shards[..minibatch.len().div_ceil(shard)].split_at_mut(1);
                let (gradient, mut sums) = (&mut first[0].0, first[0].1);
                for (other, add) in others {
                    for (sum, x) in gradient.iter_mut().zip(&*other) {
                        *sum += x;
                    }
                    sums.loss += add.loss;
                    sums.approx_kl += add.approx_kl;
                    sums.clipped += add.clipped;
                }
                let first_log = gradient.len() - acts;
                for x in &mut gradient[first_log..] {
                    *x -= entropy;
                }
                let norm = norm(gradient);
                if !norm.is_finite() {
                    return Err(crate::TrainError::Diverged);
                }
                let shrink = (self.config.max_grad_norm / (norm + 1e-6)).min(1.0) as f32;
                self.optimizer.step(self.width, self.rate, &mut self.parameters, gradient, shrink);
                for log in &mut self.parameters[first_log..] {
                    *log = log.clamp(*LOG_DEVIATIONS.start(), *LOG_DEVIATIONS.end());
                }
                totals.loss += sums.loss;
                totals.approx_kl += sums.approx_kl;
                totals.clipped += sums.clipped;
                minibatches += 1;
                seen += rows;
            }
        }
        self.clock.gradient += began.elapsed();
        let count = seen.max(1) as f64;
        report.loss = totals.loss / f64::from(minibatches.max(1));
        report.approx_kl = totals.approx_kl / count;
        report.clip_fraction = totals.clipped / count / self.config.epochs as f64;
        self.rate = adapt_rate(self.rate, self.config.learning_rate, self.config.target_kl, report.approx_kl);
        // the observations of this rollout affect the normalization from the next iteration on
        self.observations.take(&self.experience.raw);
        self.refresh()?;
        let (_, _, logs) = self.shape.split(&self.parameters);
        report.action_std = logs.iter().map(|log| f64::from(log.exp())).sum::<f64>() / acts as f64;
        Ok(())
    }
}

/// Returns the length of a vector, from eight partial sums.
fn norm(vector: &[f32]) -> f64 {
    let (chunks, rest) = vector.as_chunks::<8>();
    let mut squares = [0.0_f64; 8];
    for chunk in chunks {
        for (sum, x) in squares.iter_mut().zip(chunk) {
            *sum += f64::from(*x) * f64::from(*x);
        }
    }
    (squares.iter().sum::<f64>() + rest.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>()).sqrt()
}

/// Returns the adapted learning rate: lower if the KL divergence exceeds twice the target, higher, up to `max`,
/// below the target.
fn adapt_rate(rate: f64, max: f64, target_kl: f64, approx_kl: f64) -> f64 {
    if target_kl > 0.0 && approx_kl > 2.0 * target_kl {
        (rate / 1.5).max(0.01 * max)
    } else if target_kl > 0.0 && approx_kl < target_kl {
        (rate * 1.1).min(max)
    } else {
        rate
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_learning_rate_adapts_to_the_kl_divergence_within_bounds() {
        assert_eq!(adapt_rate(1e-3, 2e-3, 0.01, 0.03), 1e-3 / 1.5);
        assert_eq!(adapt_rate(1e-3, 2e-3, 0.01, 0.001), 1.1e-3);
        assert_eq!(adapt_rate(1e-3, 2e-3, 0.01, 0.012), 1e-3);
        assert_eq!(adapt_rate(1e-3, 2e-3, 0.0, 0.5), 1e-3);
        assert_eq!(adapt_rate(2e-5, 2e-3, 0.01, 1.0), 2e-5);
        assert_eq!(adapt_rate(1.9e-3, 2e-3, 0.01, 1e-4), 2e-3);
    }
}
