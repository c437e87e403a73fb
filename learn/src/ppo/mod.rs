//! Proximal policy optimization (PPO, Schulman et al. 2017). Each iteration collects a rollout with the current
//! policy, estimates advantages (GAE, Schulman et al. 2016), and updates the policy in a few epochs over the
//! rollout, with a clipped probability ratio.
//!
//! Implementation details from the literature (Andrychowicz et al. 2021; Huang et al. 2022): normalized
//! observations and scaled rewards, orthogonal initial weights, state-independent standard deviations, advantages
//! normalized over the rollout, gradients clipped by norm, and a learning rate that adapts to the KL divergence of
//! each update (Rudin et al. 2022). The value after a truncated episode is bootstrapped from the critic (Pardo et
//! al. 2018). The first episode of every row is truncated at a random step, so that the rows are spread over the
//! length of an episode.
//!
//! A recurrent policy keeps the states of its recurrent layer from one rollout to the next. Its minibatches consist of
//! whole sequences: all steps of a row in the rollout. The gradient goes back through time to the start of the rollout,
//! whose states are constants, or to the start of the episode, where the state is zero.
//!
//! Results are bit-identical for any number of threads: every block of rows has its own random stream, and
//! gradients are summed in the order of the shards.

mod advantage;
mod config;
mod loss;
mod rollout;
mod update;

use std::time::{Duration, Instant};

use aviary::engine::flight::Width;
use aviary::env::{EnvError, Rng};
use aviary::policy::{Gru, Mlp};
use rand::{RngExt as _, SeedableRng as _};
use serde::{Deserialize, Serialize};

pub(crate) use config::PartialPpo;
pub use config::PpoConfig;
pub use loss::MAX_LOG_RATIO;

use self::loss::{Networks, Sums};
use self::rollout::Experience;
use crate::agents::{Agents, Outcome};
use crate::learner::LearnerState;
use crate::network::NetworkShape;
use crate::optimizer::Moments;
use crate::scale::{RewardScale, Running};

/// Number of rows that share a random stream.
const BLOCK: usize = 64;

/// Rows of a shard of a minibatch: the work of one thread.
const SHARD: usize = 256;

/// Returns the sequences of a shard of a minibatch with a recurrent layer. Twelve sequences fill the registers; very
/// long ones are fewer.
fn shard_sequences(horizon: usize) -> usize {
    (768 / horizon).clamp(1, 12)
}

/// Bound of normalized observations and scaled rewards.
pub const CLIP: f32 = 10.0;

/// Wall time by activity.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Clock {
    /// Environment steps.
    pub simulation: Duration,
    /// Forward passes of the networks and sampling of actions.
    pub inference: Duration,
    /// Gradients and optimizer steps.
    pub gradient: Duration,
    /// Evaluations.
    pub evaluation: Duration,
    /// Total.
    pub total: Duration,
}

/// Statistics of an iteration.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Report {
    /// Mean return of the episodes that ended in the iteration or were truncated; `None` without such an episode.
    pub mean_return: Option<f64>,
    /// Mean reward of a step.
    pub mean_reward: f64,
    /// Approximate KL divergence of the policies before and after the update.
    #[serde(alias = "divergence")]
    pub approx_kl: f64,
    /// Fraction of the rows whose probability ratio was clipped.
    #[serde(alias = "clipped")]
    pub clip_fraction: f64,
    /// Mean loss.
    pub loss: f64,
    /// Mean of the actions' standard deviations.
    #[serde(alias = "deviation")]
    pub action_std: f64,
    /// Fraction of the variance of the returns that the critic explains.
    #[serde(alias = "explained")]
    pub explained_variance: f64,
}

/// State of PPO: networks, optimizer, normalization and rollout buffers.
#[derive(Debug)]
pub(crate) struct Ppo {
    config: PpoConfig,
    pub shape: NetworkShape,
    parameters: Vec<f32>,
    optimizer: Moments,
    pub rate: f64,
    observations: Running,
    rewards: RewardScale,
    pub clock: Clock,
    actor: Mlp,
    critic: Mlp,
    recurrent: Option<Gru>,
    /// State of the recurrent layer of every row, zero at the start of an episode.
    memory: Vec<f32>,
    mean: Vec<f32>,
    deviation: Vec<f32>,
    /// Centre and half width of every entry of the action space; [0, 1] for an unbounded entry.
    reach: Vec<[f32; 2]>,
    /// Current observations of the agents.
    seen: Vec<f32>,
    /// Steps of every row's current episode, and the number of steps at which it is truncated.
    ages: Vec<[u64; 2]>,
    /// Sum of rewards of every row's current episode.
    sums: Vec<f64>,
    outcome: Outcome,
    experience: Experience,
    networks: Networks,
    width: Width,
    /// Gradient and sums of every shard of a minibatch.
    shards: Vec<(Vec<f32>, Sums)>,
}

impl Ppo {
    pub fn new(
        config: PpoConfig,
        width: Width,
        agents: &dyn Agents,
        seed: u64,
    ) -> Result<Self, aviary::policy::PolicyError> {
        let (observation, actions) = (agents.observation_space().size(), agents.action_space());
        let shape = NetworkShape::new(observation, actions.size(), &config.hidden, config.activation)
            .with_recurrent(config.recurrent);
        let parameters = shape.initial(config.initial_std as f32, &mut Rng::seed_from_u64(seed));
        let reach = actions.low().iter().zip(actions.high()).map(|(&low, &high)| {
            if low.is_finite() && high.is_finite() {
                [0.5 * (low + high) as f32, 0.5 * (high - low) as f32]
            } else {
                [0.0, 1.0]
            }
        });
        let (actor, critic, _) = shape.split(&parameters);
        // a minibatch has at most all steps of an iteration
        let shard_count = match config.recurrent {
            0 => config.minibatch.min(agents.rows().saturating_mul(config.horizon)).div_ceil(SHARD),
            _ => config.sequences().min(agents.rows()).div_ceil(shard_sequences(config.horizon)),
        };
        let recurrent = match shape.recurrent {
            0 => None,
            units => Some(Gru::new(observation, units, shape.recurrent_part(&parameters))?),
        };
        Ok(Self {
            actor: Mlp::new(&shape.actor, shape.activation, actor)?,
            critic: Mlp::new(&shape.critic, shape.activation, critic)?,
            recurrent,
            memory: vec![0.0; agents.rows() * shape.recurrent],
            mean: vec![0.0; observation],
            deviation: vec![1.0; observation],
            reach: reach.collect(),
            seen: vec![0.0; agents.rows() * observation],
            ages: vec![[0; 2]; agents.rows()],
            sums: vec![0.0; agents.rows()],
            outcome: Outcome::new(agents.rows(), observation),
            experience: Experience::default(),
            shards: vec![(vec![0.0; parameters.len()], Sums::default()); shard_count],
            networks: Networks::new(&shape, width),
            width,
            optimizer: Moments::new(parameters.len()),
            rate: config.learning_rate,
            observations: Running::new(observation),
            rewards: RewardScale::new(),
            clock: Clock::default(),
            parameters,
            shape,
            config,
        })
    }

    /// Returns the normalized observations of the last rollout.
    #[cfg(test)]
    pub fn inputs(&self) -> &[f32] {
        &self.experience.observations
    }

    /// Applies changed parameters and scales to the networks.
    fn refresh(&mut self) -> Result<(), aviary::policy::PolicyError> {
        let (actor, critic, _) = self.shape.split(&self.parameters);
        self.actor.set(actor)?;
        self.critic.set(critic)?;
        if let Some(recurrent) = &mut self.recurrent {
            recurrent.set(self.shape.recurrent_part(&self.parameters))?;
        }
        (self.mean, self.deviation) = self.observations.normalization();
        Ok(())
    }

    /// Returns the state between two iterations.
    pub fn state(&self) -> LearnerState {
        LearnerState {
            parameters: self.parameters.clone(),
            optimizer_steps: self.optimizer.time,
            first_moments: self.optimizer.first.clone(),
            second_moments: self.optimizer.second.clone(),
            learning_rate: self.rate,
            observations: self.observations.clone(),
            rewards: self.rewards.sums().clone(),
        }
    }

    /// Continues from a state. Call [`restart`](Self::restart) afterwards.
    pub fn restore(&mut self, state: LearnerState) -> Result<(), aviary::policy::PolicyError> {
        self.parameters = state.parameters;
        let (first, second) = (state.first_moments, state.second_moments);
        self.optimizer = Moments { time: state.optimizer_steps, first, second };
        self.rate = state.learning_rate;
        self.observations = state.observations;
        self.rewards = RewardScale::of(state.rewards);
        self.refresh()
    }

    /// Returns true if the scales of observations and rewards have been estimated.
    pub fn has_scales(&self) -> bool {
        !self.observations.is_empty()
    }

    /// Estimates the scales of observations and rewards before the first update, from one rollout of the initial
    /// policy, which is used for nothing else. Call [`restart`](Self::restart) afterwards.
    pub fn estimate_scales(&mut self, agents: &mut dyn Agents, seeds: [u64; 2]) -> Result<(), crate::TrainError> {
        self.restart(agents, seeds[0])?;
        self.collect(agents, seeds[1])?;
        self.observations.take(&self.experience.raw);
        self.refresh()?;
        Ok(())
    }

    /// Resets the environments of all rows.
    pub fn restart(&mut self, agents: &mut dyn Agents, seed: u64) -> Result<(), EnvError> {
        let mut rng = Rng::seed_from_u64(seed);
        agents.reset(rng.random(), &mut self.seen)?;
        for (row, age) in self.ages.iter_mut().enumerate() {
            *age = [0, rng.random_range(1..=agents.longest(row))];
        }
        self.sums.fill(0.0);
        self.memory.fill(0.0);
        self.rewards.restart(agents.rows());
        Ok(())
    }

    /// Runs one iteration: rollout, advantages, update. The seed determines all random numbers.
    pub fn iterate(&mut self, agents: &mut dyn Agents, seed: u64) -> Result<Report, crate::TrainError> {
        let mut report = self.collect(agents, seed)?;
        let began = Instant::now();
        self.estimate();
        self.clock.inference += began.elapsed();
        report.explained_variance = advantage::explained(&self.experience);
        self.update(seed, &mut report)?;
        Ok(report)
    }
}

#[cfg(test)]
mod tests;
