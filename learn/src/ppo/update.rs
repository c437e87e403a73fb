//! Update: epochs of minibatches over a rollout.

use std::time::Instant;

use aviary::env::Rng;
use rand::SeedableRng as _;
use rand::seq::SliceRandom as _;
use rayon::prelude::*;

use super::advantage::moments;
use super::loss::{Loss, Shard, Sums, gradient};
use super::{Ppo, Report, SHARD};
use crate::agents::Next;
use crate::network::LOG_DEVIATIONS;

impl Ppo {
    /// Updates the parameters in several epochs over the rollout.
    pub(super) fn update(&mut self, seed: u64, report: &mut Report) -> Result<(), crate::TrainError> {
        let (size, acts) = (self.shape.observation(), self.shape.action());
        let experience = &self.experience;
        let mut order: Vec<u32> = (0..experience.next.len() as u32)
            .filter(|&entry| experience.next[entry as usize] != Next::Absent)
            .collect();
        let (mean, deviation) = moments(order.iter().map(|&entry| experience.advantages[entry as usize]));
        let loss = Loss { clip_range: self.config.clip_range as f32, value: self.config.value_coef as f32 };
        let entropy = self.config.entropy_coef as f32;
        let mut rng = Rng::seed_from_u64(seed);
        let (mut totals, mut minibatches, mut seen) = (Sums::default(), 0, 0);
        for _ in 0..self.config.epochs {
            // the approximate KL divergence of the last epoch is that of the whole update
            (totals.approx_kl, seen) = (0.0, 0);
            order.shuffle(&mut rng);
            // a last minibatch of less than half the size is skipped; the shuffle moves its rows in the next epoch
            let minibatches_of = order
                .chunks(self.config.minibatch)
                .filter(|part| 2 * part.len() >= self.config.minibatch.min(order.len()));
            for minibatch in minibatches_of {
                let began = Instant::now();
                let parts: Vec<(&[u32], &mut Shard)> = minibatch.chunks(SHARD).zip(&mut self.shards).collect();
                let (shape, parameters) = (&self.shape, &self.parameters);
                let parts: Vec<(Vec<f32>, Sums)> = parts
                    .into_par_iter()
                    .map(|(entries, shard)| {
                        shard.clear();
                        for entry in entries.iter().map(|&entry| entry as usize) {
                            shard.observations.extend_from_slice(&experience.observations[entry * size..][..size]);
                            shard.actions.extend_from_slice(&experience.actions[entry * acts..][..acts]);
                            shard.log_probs.push(experience.log_probs[entry]);
                            shard.advantages.push((experience.advantages[entry] - mean) / (deviation + 1e-8));
                            shard.returns.push(experience.returns[entry]);
                        }
                        gradient(shape, parameters, shard, &loss, minibatch.len())
                    })
                    .collect();
                let mut sum = vec![0.0; self.parameters.len()];
                let mut sums = Sums::default();
                for (part, add) in &parts {
                    for (sum, x) in sum.iter_mut().zip(part) {
                        *sum += x;
                    }
                    sums.loss += add.loss;
                    sums.approx_kl += add.approx_kl;
                    sums.clipped += add.clipped;
                }
                let first_log = sum.len() - acts;
                for x in &mut sum[first_log..] {
                    *x -= entropy;
                }
                let norm = sum.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>().sqrt();
                if !norm.is_finite() {
                    return Err(crate::TrainError::Diverged);
                }
                let shrink = (self.config.max_grad_norm / (norm + 1e-6)).min(1.0) as f32;
                for x in &mut sum {
                    *x *= shrink;
                }
                self.optimizer.step(self.rate, &mut self.parameters, &sum);
                for log in &mut self.parameters[first_log..] {
                    *log = log.clamp(*LOG_DEVIATIONS.start(), *LOG_DEVIATIONS.end());
                }
                self.clock.gradient += began.elapsed();
                totals.loss += sums.loss;
                totals.approx_kl += sums.approx_kl;
                totals.clipped += sums.clipped;
                minibatches += 1;
                seen += minibatch.len();
            }
        }
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
