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

mod advantage;
mod config;
mod loss;
mod rollout;
mod update;

use std::time::{Duration, Instant};

use aviary::env::{EnvError, Rng};
use aviary::policy::Mlp;
use rand::{RngExt as _, SeedableRng as _};
use serde::{Deserialize, Serialize};

pub use config::PpoConfig;
pub(crate) use config::SaidPpo;

use self::loss::Shard;
use self::rollout::Experience;
use crate::agents::{Agents, Outcome};
use crate::network::NetworkShape;
use crate::optimizer::Optimizer;
use crate::scale::{RewardScale, Running};

/// Rows that are drawn for together.
const BLOCK: usize = 64;

/// Rows of a shard: as many as stay in a core's cache on their way forth and back.
const SHARD: usize = 512;

/// How far a normalized observation and a scaled reward reach.
const CLIP: f32 = 10.0;

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

/// A learner: its networks, what it scales with, and how it goes on.
#[derive(Debug)]
pub(crate) struct Ppo {
    pub config: PpoConfig,
    pub shape: NetworkShape,
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
        let shape = NetworkShape::new(observation, actions.size(), &config.hidden, config.activation);
        let parameters = shape.initial(config.initial_std as f32, &mut Rng::seed_from_u64(seed));
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
        report.explained_variance = advantage::explained(&self.experience);
        self.update(seed, &mut report)?;
        Ok(report)
    }
}
