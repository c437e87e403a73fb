//! Rollouts: the policy acts for a horizon in every row.

use std::time::Instant;

use aviary::env::{EnvError, Rng};
use aviary::policy::Gru;
use rand::{RngExt as _, SeedableRng as _};
use rand_distr::StandardNormal;
use rayon::prelude::*;

use super::{BLOCK, CLIP, Ppo, Report};
use crate::agents::{Agents, Next};

/// Rollout buffer, steps × rows.
#[derive(Debug, Default)]
pub(super) struct Experience {
    /// Inputs of actor and critic: normalized observations, followed by the states of a recurrent layer.
    pub observations: Vec<f32>,
    /// States of a recurrent layer before the rollout, rows × units.
    pub starts: Vec<f32>,
    /// Observations as the environments return them.
    pub raw: Vec<f32>,
    pub actions: Vec<f32>,
    pub log_probs: Vec<f32>,
    pub rewards: Vec<f32>,
    pub next: Vec<Next>,
    /// Value estimates at every step.
    pub values: Vec<f32>,
    /// Value estimates after every step.
    pub next_values: Vec<f32>,
    /// Inputs of the critic after truncated episodes, from their final observations; `cut` has their entries.
    pub finals: Vec<f32>,
    pub cut: Vec<usize>,
    pub advantages: Vec<f32>,
    pub returns: Vec<f32>,
}

impl Experience {
    fn clear(&mut self) {
        let Self { raw, rewards, next, finals, cut, .. } = self;
        raw.clear();
        rewards.clear();
        next.clear();
        finals.clear();
        cut.clear();
    }
}

impl Ppo {
    /// Collects a rollout.
    pub(super) fn collect(&mut self, agents: &mut dyn Agents, seed: u64) -> Result<Report, EnvError> {
        let (rows, size, acts) = (agents.rows(), self.shape.observation(), self.shape.action());
        let features = self.shape.features();
        let (_, _, logs) = self.shape.split(&self.parameters);
        let deviations: Vec<f32> = logs.iter().map(|log| log.exp()).collect();
        let spread: f32 = logs.iter().map(|log| log + 0.5 * std::f32::consts::TAU.ln()).sum();
        let mut draws: Vec<Rng> = (0..rows.div_ceil(BLOCK))
            .map(|block| {
                let mut rng = Rng::seed_from_u64(seed);
                rng.set_stream(1 + block as u64);
                rng
            })
            .collect();
        let mut actions = vec![0.0; rows * acts];
        let mut mask = vec![false; rows];
        let (mut returns, mut rewards) = (Vec::new(), 0.0);
        let divisor = self.rewards.divisor();
        let experience = &mut self.experience;
        experience.clear();
        experience.observations.resize(self.config.horizon * rows * features, 0.0);
        experience.starts.clone_from(&self.memory);
        experience.actions.resize(self.config.horizon * rows * acts, 0.0);
        experience.log_probs.resize(self.config.horizon * rows, 0.0);
        for step in 0..self.config.horizon {
            let began = Instant::now();
            let own = step * rows..(step + 1) * rows;
            let scaled = &mut experience.observations[step * rows * features..][..rows * features];
            let drawn = &mut experience.actions[step * rows * acts..][..rows * acts];
            experience.raw.extend_from_slice(&self.seen);
            let (seen, mean, deviation, reach, actor) =
                (&self.seen, &self.mean, &self.deviation, &self.reach, &self.actor);
            if let Some(recurrent) = &self.recurrent {
                remember(recurrent, [mean, deviation], seen, &mut self.memory, scaled);
            }
            let has_memory = self.recurrent.is_some();
            (
                seen.par_chunks(BLOCK * size),
                scaled.par_chunks_mut(BLOCK * features),
                drawn.par_chunks_mut(BLOCK * acts),
            )
                .into_par_iter()
                .zip(
                    (
                        actions.par_chunks_mut(BLOCK * acts),
                        experience.log_probs[own].par_chunks_mut(BLOCK),
                        draws.par_iter_mut(),
                    )
                        .into_par_iter(),
                )
                .for_each(|((seen, scaled, drawn), (actions, log_probs, rng))| {
                    if !has_memory {
                        normalize(seen, mean, deviation, scaled);
                    }
                    actor.forward(scaled, drawn);
                    let each = drawn.chunks_exact_mut(acts).zip(actions.chunks_exact_mut(acts)).zip(log_probs);
                    for ((drawn, action), log_prob) in each {
                        let mut off = 0.0;
                        for (entry, (x, action)) in drawn.iter_mut().zip(action).enumerate() {
                            let normal: f32 = rng.sample(StandardNormal);
                            *x += deviations[entry] * normal;
                            off += normal * normal;
                            let [middle, half] = reach[entry];
                            *action = middle + half * *x;
                        }
                        *log_prob = -0.5 * off - spread;
                    }
                });
            self.clock.inference += began.elapsed();
            let began = Instant::now();
            agents.step(&actions, &mut self.outcome)?;
            for ((cut, [age, last]), next) in mask.iter_mut().zip(&mut self.ages).zip(&self.outcome.next) {
                *age += 1;
                *cut = *age >= *last && *next == Next::Running;
            }
            if mask.contains(&true) {
                self.outcome.keep_finals();
                agents.restart(&mut mask, &mut self.outcome.observations)?;
                for (next, _) in self.outcome.next.iter_mut().zip(&mask).filter(|(_, cut)| **cut) {
                    if *next == Next::Running {
                        *next = Next::Truncated;
                    }
                }
            }
            for (row, (age, next)) in self.ages.iter_mut().zip(&self.outcome.next).enumerate() {
                if next.is_end() {
                    *age = [0, agents.longest(row)];
                }
            }
            self.clock.simulation += began.elapsed();
            let next = &self.outcome.next;
            self.rewards.take(&self.outcome.rewards, |row| next[row].is_end(), self.config.gamma as f32);
            for (row, next) in next.iter().enumerate() {
                if *next == Next::Truncated {
                    experience.cut.push(step * rows + row);
                    let start = experience.finals.len();
                    experience.finals.resize(start + features, 0.0);
                    let last = &self.outcome.finals[row * size..][..size];
                    let out = &mut experience.finals[start..];
                    match &self.recurrent {
                        None => normalize(last, &self.mean, &self.deviation, out),
                        Some(recurrent) => {
                            let memory = &mut self.memory[row * recurrent.units()..][..recurrent.units()];
                            remember(recurrent, [&self.mean, &self.deviation], last, memory, out);
                        }
                    }
                }
            }
            if let Some(recurrent) = &self.recurrent {
                let memories = self.memory.chunks_exact_mut(recurrent.units());
                for (memory, _) in memories.zip(next).filter(|(_, next)| next.is_end()) {
                    memory.fill(0.0);
                }
            }
            experience.next.extend_from_slice(next);
            let scale = |reward: &f32| (reward / divisor).clamp(-CLIP, CLIP);
            experience.rewards.extend(self.outcome.rewards.iter().map(scale));
            rewards += self.outcome.rewards.iter().map(|&x| f64::from(x)).sum::<f64>();
            for ((sum, reward), next) in self.sums.iter_mut().zip(&self.outcome.rewards).zip(&self.outcome.next) {
                *sum += f64::from(*reward);
                if next.is_end() {
                    let whole = std::mem::take(sum);
                    if *next != Next::Absent {
                        returns.push(whole);
                    }
                }
            }
            self.seen.copy_from_slice(&self.outcome.observations);
        }
        Ok(Report {
            mean_return: (!returns.is_empty()).then(|| returns.iter().sum::<f64>() / returns.len() as f64),
            mean_reward: rewards / (self.config.horizon * rows) as f64,
            ..Report::default()
        })
    }
}

/// Updates rows of memories with observations, and writes the inputs of actor and critic: the normalized observations,
/// followed by the memories.
pub(super) fn remember(
    recurrent: &Gru,
    [mean, deviation]: [&[f32]; 2],
    seen: &[f32],
    memory: &mut [f32],
    out: &mut [f32],
) {
    let (size, units) = (mean.len(), recurrent.units());
    let features = out.par_chunks_mut(BLOCK * (size + units));
    (seen.par_chunks(BLOCK * size), memory.par_chunks_mut(BLOCK * units), features).into_par_iter().for_each(
        |(seen, memory, out)| {
            let mut scaled = vec![0.0; seen.len()];
            normalize(seen, mean, deviation, &mut scaled);
            recurrent.forward(&scaled, memory);
            let rows = scaled.chunks_exact(size).zip(memory.chunks_exact(units));
            for (out, (scaled, memory)) in out.chunks_exact_mut(size + units).zip(rows) {
                out[..size].copy_from_slice(scaled);
                out[size..].copy_from_slice(memory);
            }
        },
    );
}

/// Normalizes rows of observations.
pub(super) fn normalize(seen: &[f32], mean: &[f32], deviation: &[f32], out: &mut [f32]) {
    for (seen, out) in seen.chunks_exact(mean.len()).zip(out.chunks_exact_mut(mean.len())) {
        for ((out, x), (mean, deviation)) in out.iter_mut().zip(seen).zip(mean.iter().zip(deviation)) {
            *out = ((x - mean) / deviation).clamp(-CLIP, CLIP);
        }
    }
}
