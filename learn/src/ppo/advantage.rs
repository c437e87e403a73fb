//! Advantages and returns of a rollout.

use rayon::prelude::*;

use super::rollout::{Experience, normalize, remember};
use super::{BLOCK, Ppo};
use crate::agents::Next;

impl Ppo {
    /// Evaluates the critic, and estimates advantages and returns.
    pub(super) fn estimate(&mut self) {
        let (rows, size) = (self.ages.len(), self.shape.features());
        let experience = &mut self.experience;
        let critic = &self.critic;
        let judge = |observations: &[f32], values: &mut Vec<f32>| {
            values.clear();
            values.resize(observations.len() / size, 0.0);
            let blocks = observations.par_chunks(BLOCK * size).zip(values.par_chunks_mut(BLOCK));
            blocks.for_each(|(observations, values)| critic.forward(observations, values));
        };
        judge(&experience.observations, &mut experience.values);
        let mut last = vec![0.0; rows * size];
        match &self.recurrent {
            None => normalize(&self.seen, &self.mean, &self.deviation, &mut last),
            // the next rollout updates the memory with these observations
            Some(recurrent) => {
                let scale = [&self.mean[..], &self.deviation];
                remember(recurrent, scale, &self.seen, &mut self.memory.clone(), &mut last);
            }
        }
        let (mut after, mut finals) = (Vec::new(), Vec::new());
        judge(&last, &mut after);
        judge(&experience.finals, &mut finals);
        experience.next_values.clear();
        experience.next_values.extend_from_slice(&experience.values[rows..]);
        experience.next_values.extend_from_slice(&after);
        for (&entry, &value) in experience.cut.iter().zip(&finals) {
            experience.next_values[entry] = value;
        }
        let Experience { rewards, values, next_values, next, advantages, returns, .. } = experience;
        let estimate = Estimate { rewards, values, next_values, next, rows };
        estimate.advantages(self.config.gamma as f32, self.config.gae_lambda as f32, advantages);
        returns.clear();
        returns.extend(advantages.iter().zip(&*values).map(|(advantage, value)| advantage + value));
    }
}

/// Inputs of the estimation of advantages, steps × rows.
#[derive(Debug)]
struct Estimate<'a> {
    rewards: &'a [f32],
    /// Value estimates before every step.
    values: &'a [f32],
    /// Value estimates after every step: of the next observation, or of the final observation of a truncated
    /// episode.
    next_values: &'a [f32],
    next: &'a [Next],
    rows: usize,
}

impl Estimate<'_> {
    /// Computes generalized advantage estimates (GAE; Schulman et al. 2016, eq. 16): a = δ + γ·λ·a', δ = r + γ·V' −
    /// V. V' is 0 after a termination and the critic's estimate after a truncation. Neither propagates advantages
    /// of the next episode.
    fn advantages(&self, discount: f32, lambda: f32, out: &mut Vec<f32>) {
        out.clear();
        out.resize(self.rewards.len(), 0.0);
        let mut after = vec![0.0_f32; self.rows];
        for entry in (0..self.rewards.len()).rev() {
            let after = &mut after[entry % self.rows];
            let (value, next_value) = (self.values[entry], self.next_values[entry]);
            *after = match self.next[entry] {
                Next::Running => self.rewards[entry] + discount * (next_value + lambda * *after) - value,
                Next::Truncated => self.rewards[entry] + discount * next_value - value,
                Next::Terminated => self.rewards[entry] - value,
                Next::Absent => 0.0,
            };
            out[entry] = *after;
        }
    }
}

/// Returns mean and standard deviation.
pub(super) fn moments(numbers: impl Iterator<Item = f32> + Clone) -> (f32, f32) {
    let count = numbers.clone().count().max(1) as f64;
    let mean = numbers.clone().map(f64::from).sum::<f64>() / count;
    let variance = numbers.map(|x| (f64::from(x) - mean).powi(2)).sum::<f64>() / count;
    (mean as f32, variance.sqrt() as f32)
}

/// Returns the fraction of the returns' variance that the critic explains.
pub(super) fn explained(experience: &Experience) -> f64 {
    let (_, all) = moments(experience.returns.iter().copied());
    let (_, left) = moments(experience.advantages.iter().copied());
    1.0 - f64::from(left).powi(2) / f64::from(all).powi(2).max(1e-12)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn advantages(rewards: &[f32], values: &[f32], next_values: &[f32], next: &[Next], rows: usize) -> Vec<f32> {
        let mut out = Vec::new();
        Estimate { rewards, values, next_values, next, rows }.advantages(0.5, 0.5, &mut out);
        out
    }

    #[test]
    fn advantages_match_values_computed_by_hand() {
        use Next::{Running, Terminated};
        // one row, three steps, γ = λ = 1/2: δ₂ = 4 + 2 − 1 = 5; δ₁ = 2 + 0.5 − 3 = −0.5; δ₀ = 1 + 1.5 − 2 = 0.5
        let found = advantages(&[1.0, 2.0, 4.0], &[2.0, 3.0, 1.0], &[3.0, 1.0, 4.0], &[Running; 3], 1);
        assert_eq!(found, [0.5 + 0.25 * 0.75, -0.5 + 0.25 * 5.0, 5.0]);
        // two rows are independent of each other
        let found = advantages(
            &[1.0, 9.0, 2.0, 9.0, 4.0, 9.0],
            &[2.0, 0.0, 3.0, 0.0, 1.0, 0.0],
            &[3.0, 0.0, 1.0, 0.0, 4.0, 0.0],
            &[Running, Terminated, Running, Terminated, Running, Terminated],
            2,
        );
        assert_eq!(found, [0.6875, 9.0, 0.75, 9.0, 5.0, 9.0]);
    }

    #[test]
    fn the_value_after_the_end_is_zero_for_terminations_and_bootstrapped_for_truncations() {
        use Next::{Absent, Running, Terminated, Truncated};
        let of = |end: Next| advantages(&[1.0, 1.0, 1.0], &[0.0; 3], &[0.0, 8.0, 0.0], &[Running, end, Running], 1);
        // the third step belongs to another episode, whose advantage neither end propagates
        assert_eq!(of(Running), [1.0 + 0.25 * 5.25, 5.0 + 0.25, 1.0]);
        assert_eq!(of(Truncated), [1.0 + 0.25 * 5.0, 5.0, 1.0]);
        assert_eq!(of(Terminated), [1.0 + 0.25, 1.0, 1.0]);
        assert_eq!(of(Absent), [1.0, 0.0, 1.0]);
    }
}
