//! Proximal policy optimization (Schulman et al. 2017): collect a stretch of experience with the policy as it is, estimate how much better than
//! expected every action turned out (generalised advantages, Schulman et al. 2016), and move the policy towards those that
//! did, a few times over the same experience and never far at once.
//!
//! Of what makes it work in practice (Andrychowicz et al. 2021; Huang et al. 2022) there are: observations and rewards on a common
//! scale, orthogonal weights to begin with, deviations that do not depend on the state, advantages normalised over the batch,
//! gradients clipped by their norm, and a rate that follows the divergence of each update (Rudin et al. 2022). Episodes
//! that are cut off are continued by the critic's estimate of what would have followed (Pardo et al. 2018), and the first episode of every
//! row is cut off at a random moment, so that the rows are spread over an episode's length.
//!
//! Everything is the same bits whatever the number of threads: rows are drawn for in blocks, gradients are summed in the order of their
//! shards.

use std::time::{Duration, Instant};

use aviary::env::{EnvError, Rng};
use aviary::policy::{Activation, Mlp};
use rand::seq::SliceRandom as _;
use rand::{RngExt as _, SeedableRng as _};
use rand_distr::StandardNormal;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::agents::{Agents, Next, Outcome};
use crate::network::{LOG_DEVIATIONS, Loss, Shape, Shard, Sums, gradient};
use crate::optimizer::Optimizer;
use crate::scale::{RewardScale, Running};

/// Rows that are drawn for together.
const BLOCK: usize = 64;

/// Rows of a shard: as many as stay in a core's cache on their way forth and back.
const SHARD: usize = 512;

/// How far a normalized observation and a scaled reward reach.
const CLIP: f32 = 10.0;

/// A structure of settings, and one that has them as far as they were said.
macro_rules! settings {
    ($(#[$doc:meta])* $name:ident, $said:ident { $($(#[$field_doc:meta])* $field:ident: $kind:ty,)* }) => {
        $(#[$doc])*
        #[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
        #[serde(deny_unknown_fields)]
        pub struct $name {
            $($(#[$field_doc])* pub $field: $kind,)*
        }

        /// The same, as far as it is said.
        #[derive(Debug, Clone, PartialEq, Default, Deserialize)]
        #[serde(default, deny_unknown_fields)]
        pub(crate) struct $said {
            $($field: Option<$kind>,)*
        }

        impl $said {
            /// Changes what is said.
            pub(crate) fn apply(self, config: &mut $name) {
                $(if let Some(said) = self.$field {
                    config.$field = said;
                })*
            }
        }
    };
}

settings! {
    /// The knobs of the algorithm.
    PpoConfig, SaidPpo {
        /// Environments that gather experience.
        environments: usize,
        /// Steps that each makes between two updates.
        horizon: usize,
        /// Times that an update goes through the experience.
        epochs: usize,
        /// Rows of a minibatch.
        minibatch: usize,
        /// Neurons of the hidden layers, of actor and critic each.
        hidden: Vec<usize>,
        /// What they do.
        activation: Activation,
        /// Adam's rate, at most.
        learning_rate: f64,
        /// Divergence that an update is to have, above whose double the rate goes down; 0 leaves the rate alone.
        divergence: f64,
        /// Discount per step, γ.
        discount: f64,
        /// λ of the advantages.
        lambda: f64,
        /// Largest distance of the ratio of probabilities from 1, ε.
        clip: f64,
        /// Weight of the critic's error.
        value: f64,
        /// Weight of the entropy.
        entropy: f64,
        /// Largest norm of a gradient.
        max_gradient: f64,
        /// Standard deviation of actions at the start, where 1 is half the width of the action space.
        deviation: f64,
    }
}

/// Where the time went.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Clock {
    /// In the environments.
    pub simulation: Duration,
    /// In the networks, forwards, with the draws of actions.
    pub inference: Duration,
    /// In gradients and Adam.
    pub gradient: Duration,
    /// In evaluations.
    pub evaluation: Duration,
    /// All of it.
    pub total: Duration,
}

/// What an iteration did.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Report {
    /// Mean return of the episodes that ended in it or were cut off, if any were.
    pub mean_return: Option<f64>,
    /// Mean reward of a step.
    pub mean_reward: f64,
    /// Divergence of the new policy from the old one.
    pub divergence: f64,
    /// Share of the rows whose ratio left the clip.
    pub clipped: f64,
    /// Mean loss.
    pub loss: f64,
    /// Mean of the actions' standard deviations.
    pub deviation: f64,
    /// Share of the returns' variance that the critic explains.
    pub explained: f64,
}

/// A stretch of experience: steps × rows.
#[derive(Debug, Default)]
struct Experience {
    /// As the networks see them.
    observations: Vec<f32>,
    /// As they were.
    raw: Vec<f32>,
    actions: Vec<f32>,
    log_probs: Vec<f32>,
    rewards: Vec<f32>,
    next: Vec<Next>,
    /// Estimates of the return at every step.
    values: Vec<f32>,
    /// Estimates of the return after it.
    next_values: Vec<f32>,
    /// What was seen last of episodes that were cut off, as the networks see it, and at which entry.
    finals: Vec<f32>,
    cut: Vec<usize>,
    advantages: Vec<f32>,
    returns: Vec<f32>,
}

/// A learner: its networks, what it scales with, and how it goes on.
#[derive(Debug)]
pub(crate) struct Ppo {
    pub config: PpoConfig,
    pub shape: Shape,
    pub parameters: Vec<f32>,
    pub optimizer: Optimizer,
    pub rate: f64,
    pub observations: Running,
    pub rewards: RewardScale,
    pub clock: Clock,
    actor: Mlp,
    critic: Mlp,
    mean: Vec<f32>,
    deviation: Vec<f32>,
    /// −1 and 1 of the networks' actions in the agents' units: the middle and half the width of every entry.
    reach: Vec<[f32; 2]>,
    /// What the agents see now.
    seen: Vec<f32>,
    /// Steps of every row's episode so far, and after how many it is cut off.
    ages: Vec<[u64; 2]>,
    /// Rewards of every row's episode so far.
    sums: Vec<f64>,
    outcome: Outcome,
    experience: Experience,
    shards: Vec<Shard>,
}

impl Ppo {
    pub fn new(config: PpoConfig, agents: &dyn Agents, seed: u64) -> Result<Self, aviary::policy::PolicyError> {
        let (observation, actions) = (agents.observation_space().size(), agents.action_space());
        let shape = Shape::new(observation, actions.size(), &config.hidden, config.activation);
        let parameters = shape.initial(config.deviation as f32, &mut Rng::seed_from_u64(seed));
        let reach = actions.low().iter().zip(actions.high()).map(|(&low, &high)| {
            if low.is_finite() && high.is_finite() {
                [0.5 * (low + high) as f32, 0.5 * (high - low) as f32]
            } else {
                [0.0, 1.0]
            }
        });
        let (actor, critic, _) = shape.split(&parameters);
        let shard_count = config.minibatch.div_ceil(SHARD);
        Ok(Self {
            actor: Mlp::new(&shape.actor, shape.activation, actor)?,
            critic: Mlp::new(&shape.critic, shape.activation, critic)?,
            mean: vec![0.0; observation],
            deviation: vec![1.0; observation],
            reach: reach.collect(),
            seen: vec![0.0; agents.rows() * observation],
            ages: vec![[0; 2]; agents.rows()],
            sums: vec![0.0; agents.rows()],
            outcome: Outcome::new(agents.rows(), observation),
            experience: Experience::default(),
            shards: vec![Shard::default(); shard_count],
            optimizer: Optimizer::new(),
            rate: config.learning_rate,
            observations: Running::new(observation),
            rewards: RewardScale::new(),
            clock: Clock::default(),
            parameters,
            shape,
            config,
        })
    }

    /// Observations of the last iteration, as the networks see them.
    #[cfg(test)]
    pub fn inputs(&self) -> &[f32] {
        &self.experience.observations
    }

    /// The actor as it is.
    pub fn actor(&self) -> &Mlp {
        &self.actor
    }

    /// Largest number of optimizer steps in an iteration of so many rows.
    pub fn updates_per_iteration(&self, rows: usize) -> u64 {
        let minibatches = (rows * self.config.horizon).div_ceil(self.config.minibatch);
        (self.config.epochs * minibatches) as u64
    }

    /// What observations are scaled with: mean and deviation.
    pub fn normalization(&self) -> (&[f32], &[f32]) {
        (&self.mean, &self.deviation)
    }

    /// Takes over what has been changed: parameters and scales.
    pub fn refresh(&mut self) -> Result<(), aviary::policy::PolicyError> {
        let (actor, critic, _) = self.shape.split(&self.parameters);
        self.actor.set(actor)?;
        self.critic.set(critic)?;
        self.mean = self.observations.mean();
        // what never moves is not blown up when it does
        self.deviation = self.observations.deviation().iter().map(|deviation| deviation.max(1e-2)).collect();
        Ok(())
    }

    /// Returns whether the scales of observations and rewards have been estimated.
    pub fn has_scales(&self) -> bool {
        !self.observations.is_empty()
    }

    /// Estimates the scales of observations and rewards before the first update, from one horizon of the initial policy. Nothing
    /// else is learned from it. Call [`restart`](Self::restart) afterwards.
    pub fn estimate_scales(&mut self, agents: &mut dyn Agents, seeds: [u64; 2]) -> Result<(), crate::TrainError> {
        self.restart(agents, seeds[0])?;
        self.collect(agents, seeds[1])?;
        self.observations.take(&self.experience.raw);
        self.refresh()?;
        Ok(())
    }

    /// Begins episodes anew in every row.
    pub fn restart(&mut self, agents: &mut dyn Agents, seed: u64) -> Result<(), EnvError> {
        let mut rng = Rng::seed_from_u64(seed);
        agents.reset(rng.random(), &mut self.seen)?;
        for (row, age) in self.ages.iter_mut().enumerate() {
            *age = [0, rng.random_range(1..=agents.longest(row))];
        }
        self.sums.fill(0.0);
        self.rewards.restart(agents.rows());
        Ok(())
    }

    /// One iteration: experience, advantages, update. Everything random comes from the seed.
    pub fn iterate(&mut self, agents: &mut dyn Agents, seed: u64) -> Result<Report, crate::TrainError> {
        let mut report = self.collect(agents, seed)?;
        let began = Instant::now();
        self.estimate();
        self.clock.inference += began.elapsed();
        report.explained = explained(&self.experience);
        self.update(seed, &mut report)?;
        Ok(report)
    }

    /// Acts for a horizon.
    fn collect(&mut self, agents: &mut dyn Agents, seed: u64) -> Result<Report, EnvError> {
        let (rows, size, acts) = (agents.rows(), self.shape.observation(), self.shape.action());
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
        experience.observations.resize(self.config.horizon * rows * size, 0.0);
        experience.actions.resize(self.config.horizon * rows * acts, 0.0);
        experience.log_probs.resize(self.config.horizon * rows, 0.0);
        for step in 0..self.config.horizon {
            let began = Instant::now();
            let own = step * rows..(step + 1) * rows;
            let scaled = &mut experience.observations[step * rows * size..][..rows * size];
            let drawn = &mut experience.actions[step * rows * acts..][..rows * acts];
            experience.raw.extend_from_slice(&self.seen);
            let (seen, mean, deviation, reach, actor) =
                (&self.seen, &self.mean, &self.deviation, &self.reach, &self.actor);
            (seen.par_chunks(BLOCK * size), scaled.par_chunks_mut(BLOCK * size), drawn.par_chunks_mut(BLOCK * acts))
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
                    normalize(seen, mean, deviation, scaled);
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
            self.rewards.take(&self.outcome.rewards, |row| next[row].is_end(), self.config.discount as f32);
            for (row, next) in next.iter().enumerate() {
                if *next == Next::Truncated {
                    experience.cut.push(step * rows + row);
                    let start = experience.finals.len();
                    experience.finals.resize(start + size, 0.0);
                    let last = &self.outcome.finals[row * size..][..size];
                    normalize(last, &self.mean, &self.deviation, &mut experience.finals[start..]);
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

    /// Asks the critic, and estimates advantages and returns.
    fn estimate(&mut self) {
        let (rows, size) = (self.ages.len(), self.shape.observation());
        let experience = &mut self.experience;
        let critic = &self.critic;
        let judge = |observations: &[f32], values: &mut Vec<f32>| {
            values.clear();
            values.resize(observations.len() / size, 0.0);
            let blocks = observations.par_chunks(BLOCK * size).zip(values.par_chunks_mut(BLOCK));
            blocks.for_each(|(observations, values)| critic.forward(observations, values));
        };
        judge(&experience.observations, &mut experience.values);
        let mut last = vec![0.0; self.seen.len()];
        normalize(&self.seen, &self.mean, &self.deviation, &mut last);
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
        estimate.advantages(self.config.discount as f32, self.config.lambda as f32, advantages);
        returns.clear();
        returns.extend(advantages.iter().zip(&*values).map(|(advantage, value)| advantage + value));
    }

    /// Goes through the experience a few times.
    fn update(&mut self, seed: u64, report: &mut Report) -> Result<(), crate::TrainError> {
        let (size, acts) = (self.shape.observation(), self.shape.action());
        let experience = &self.experience;
        let mut order: Vec<u32> = (0..experience.next.len() as u32)
            .filter(|&entry| experience.next[entry as usize] != Next::Absent)
            .collect();
        let (mean, deviation) = moments(order.iter().map(|&entry| experience.advantages[entry as usize]));
        let loss = Loss { clip: self.config.clip as f32, value: self.config.value as f32 };
        let entropy = self.config.entropy as f32;
        let mut rng = Rng::seed_from_u64(seed);
        let (mut totals, mut minibatches, mut seen) = (Sums::default(), 0, 0);
        for _ in 0..self.config.epochs {
            // the divergence of the last epoch is what the whole update did
            (totals.approx_kl, seen) = (0.0, 0);
            order.shuffle(&mut rng);
            // what would be a much smaller minibatch than the others is left for another epoch
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
                let shrink = (self.config.max_gradient / (norm + 1e-6)).min(1.0) as f32;
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
        report.divergence = totals.approx_kl / count;
        report.clipped = totals.clipped / count / self.config.epochs as f64;
        self.rate = follow(self.rate, self.config.learning_rate, self.config.divergence, report.divergence);
        // what was seen counts from the next iteration on
        self.observations.take(&self.experience.raw);
        self.refresh()?;
        let (_, _, logs) = self.shape.split(&self.parameters);
        report.deviation = logs.iter().map(|log| f64::from(log.exp())).sum::<f64>() / acts as f64;
        Ok(())
    }
}

/// The rate goes down when the policy has moved too far, and up to what it was while it moves too little.
fn follow(rate: f64, most: f64, wanted: f64, divergence: f64) -> f64 {
    if wanted > 0.0 && divergence > 2.0 * wanted {
        (rate / 1.5).max(0.01 * most)
    } else if wanted > 0.0 && divergence < wanted {
        (rate * 1.1).min(most)
    } else {
        rate
    }
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

/// What advantages are estimated from: steps × rows.
#[derive(Debug)]
pub(crate) struct Estimate<'a> {
    pub rewards: &'a [f32],
    /// The critic's estimate before every step,
    pub values: &'a [f32],
    /// and after it: of the next observation, or of the last one of an episode that is cut off.
    pub next_values: &'a [f32],
    pub next: &'a [Next],
    pub rows: usize,
}

impl Estimate<'_> {
    /// Generalised advantages (Schulman et al. 2016, eq. 16): a = δ + γ·λ·a', δ = r + γ·V' − V. Nothing follows a termination, the
    /// critic's estimate follows a truncation, and neither lets the next episode's advantages through.
    pub fn advantages(&self, discount: f32, lambda: f32, out: &mut Vec<f32>) {
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

/// Brings rows of observations to a common scale.
fn normalize(seen: &[f32], mean: &[f32], deviation: &[f32], out: &mut [f32]) {
    for (seen, out) in seen.chunks_exact(mean.len()).zip(out.chunks_exact_mut(mean.len())) {
        for ((out, x), (mean, deviation)) in out.iter_mut().zip(seen).zip(mean.iter().zip(deviation)) {
            *out = ((x - mean) / deviation).clamp(-CLIP, CLIP);
        }
    }
}

/// Mean and standard deviation.
fn moments(numbers: impl Iterator<Item = f32> + Clone) -> (f32, f32) {
    let count = numbers.clone().count().max(1) as f64;
    let mean = numbers.clone().map(f64::from).sum::<f64>() / count;
    let variance = numbers.map(|x| (f64::from(x) - mean).powi(2)).sum::<f64>() / count;
    (mean as f32, variance.sqrt() as f32)
}

/// Share of the returns' variance that the critic explains.
fn explained(experience: &Experience) -> f64 {
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
    fn advantages_are_those_computed_by_hand() {
        use Next::{Running, Terminated};
        // one row, three steps, γ = λ = 1/2: δ₂ = 4 + 2 − 1 = 5; δ₁ = 2 + 0.5 − 3 = −0.5; δ₀ = 1 + 1.5 − 2 = 0.5
        let found = advantages(&[1.0, 2.0, 4.0], &[2.0, 3.0, 1.0], &[3.0, 1.0, 4.0], &[Running; 3], 1);
        assert_eq!(found, [0.5 + 0.25 * 0.75, -0.5 + 0.25 * 5.0, 5.0]);
        // two rows beside each other do not see each other
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
    fn nothing_follows_a_termination_and_the_critics_estimate_a_truncation() {
        use Next::{Absent, Running, Terminated, Truncated};
        let of = |end: Next| advantages(&[1.0, 1.0, 1.0], &[0.0; 3], &[0.0, 8.0, 0.0], &[Running, end, Running], 1);
        // the third step is another episode's: it is let through by neither
        assert_eq!(of(Running), [1.0 + 0.25 * 5.25, 5.0 + 0.25, 1.0]);
        assert_eq!(of(Truncated), [1.0 + 0.25 * 5.0, 5.0, 1.0]);
        assert_eq!(of(Terminated), [1.0 + 0.25, 1.0, 1.0]);
        assert_eq!(of(Absent), [1.0, 0.0, 1.0]);
    }

    #[test]
    fn the_rate_follows_the_divergence_within_bounds() {
        assert_eq!(follow(1e-3, 2e-3, 0.01, 0.03), 1e-3 / 1.5);
        assert_eq!(follow(1e-3, 2e-3, 0.01, 0.001), 1.1e-3);
        assert_eq!(follow(1e-3, 2e-3, 0.01, 0.012), 1e-3);
        assert_eq!(follow(1e-3, 2e-3, 0.0, 0.5), 1e-3);
        assert_eq!(follow(2e-5, 2e-3, 0.01, 1.0), 2e-5);
        assert_eq!(follow(1.9e-3, 2e-3, 0.01, 1e-4), 2e-3);
    }
}
