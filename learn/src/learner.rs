//! Interface between a training run and the algorithm that improves its policy.

use aviary::env::BoxSpace;

use crate::agents::Agents;
use crate::network::NetworkShape;
use crate::ppo::{Clock, Ppo, Report};
use crate::scale::Running;
use crate::{TrainConfig, TrainError};

/// Algorithm that improves a policy: it owns the environments of training, the networks and the optimizer.
///
/// [`Trainer`](crate::Trainer) calls [`iterate`](Self::iterate), evaluates the policy of [`state`](Self::state), and
/// writes checkpoints. [`Trainer::new`](crate::Trainer::new) creates the learner of the CPU; the crate `aviary-gpu` has
/// one whose environments, networks and optimizer are in the memory of a GPU.
pub trait Learner: Send {
    /// Returns the number of agents that are stepped together.
    fn rows(&self) -> usize;

    /// Returns the observation space of one agent.
    fn observation_space(&self) -> &BoxSpace;

    /// Returns the action space of one agent.
    fn action_space(&self) -> &BoxSpace;

    /// Returns the layer sizes of actor and critic.
    fn shape(&self) -> &NetworkShape;

    /// Returns true if the scales of observations and rewards have been estimated.
    fn has_scales(&self) -> bool;

    /// Estimates the scales of observations and rewards from one rollout of the initial policy, which is used for
    /// nothing else. The seeds are those of the environments and of the actions. Call [`restart`](Self::restart)
    /// afterwards.
    ///
    /// # Errors
    /// The environments' errors.
    fn estimate_scales(&mut self, seeds: [u64; 2]) -> Result<(), TrainError>;

    /// Resets the environments of all rows with a seed.
    ///
    /// # Errors
    /// The environments' errors.
    fn restart(&mut self, seed: u64) -> Result<(), TrainError>;

    /// Runs one iteration: rollout, advantages, update. The seed determines all random numbers of the iteration.
    ///
    /// # Errors
    /// [`TrainError::Diverged`], and the environments' errors.
    fn iterate(&mut self, seed: u64) -> Result<Report, TrainError>;

    /// Returns the current learning rate.
    fn learning_rate(&self) -> f64;

    /// Returns the wall time by activity since the learner was created; `evaluation` and `total` are zero.
    fn clock(&self) -> Clock;

    /// Returns everything that a later iteration depends on, after which [`restart`](Self::restart) is called.
    ///
    /// # Errors
    /// The errors of a device.
    fn state(&self) -> Result<LearnerState, TrainError>;

    /// Continues from a state. The caller validates its numbers.
    ///
    /// # Errors
    /// [`TrainError::Policy`] for parameters that are not finite, and the errors of a device.
    fn restore(&mut self, state: LearnerState) -> Result<(), TrainError>;
}

/// State of a [`Learner`] between two iterations.
#[derive(Debug, Clone, PartialEq)]
pub struct LearnerState {
    /// Parameters in the order of [`NetworkShape`].
    pub parameters: Vec<f32>,
    /// Number of steps of Adam.
    pub optimizer_steps: usize,
    /// First moments of Adam, one per parameter.
    pub first_moments: Vec<f32>,
    /// Second moments of Adam, one per parameter.
    pub second_moments: Vec<f32>,
    /// Learning rate.
    pub learning_rate: f64,
    /// Statistics of the observations.
    pub observations: Running,
    /// Statistics of the discounted sums of rewards; vectors of one entry.
    pub rewards: Running,
}

impl LearnerState {
    /// Returns mean and standard deviation with which observations are normalized. A lower bound of 0.01 keeps
    /// observations that were constant so far from being amplified.
    pub fn normalization(&self) -> (Vec<f32>, Vec<f32>) {
        self.observations.normalization()
    }
}

/// Largest number of inputs of the networks in a rollout: 8 GiB. The number of steps of all agents then also fits the
/// indices of an update.
const MAX_INPUTS: usize = 1 << 31;

/// Learner of the CPU: PPO over agents of the CPU.
pub(crate) struct CpuLearner {
    agents: Box<dyn Agents>,
    ppo: Ppo,
}

impl CpuLearner {
    /// Creates a learner with initial parameters.
    ///
    /// # Errors
    /// [`TrainError::Option`] for a rollout of too many numbers, and [`TrainError::Policy`] for layers that a policy
    /// cannot have.
    pub fn new(config: &TrainConfig, agents: Box<dyn Agents>) -> Result<Self, TrainError> {
        let (rows, horizon) = (agents.rows(), config.ppo.horizon);
        let inputs = agents.observation_space().size() + config.ppo.recurrent;
        if rows.saturating_mul(horizon).saturating_mul(inputs) > MAX_INPUTS {
            return Err(TrainError::Option {
                option: "agents × horizon × inputs",
                got: format!("{rows} × {horizon} × {inputs}"),
                expected: "up to 2,147,483,648",
            });
        }
        let ppo = Ppo::new(config.ppo.clone(), config.width, &*agents, config.seed)?;
        Ok(Self { agents, ppo })
    }
}

impl Learner for CpuLearner {
    fn rows(&self) -> usize {
        self.agents.rows()
    }

    fn observation_space(&self) -> &BoxSpace {
        self.agents.observation_space()
    }

    fn action_space(&self) -> &BoxSpace {
        self.agents.action_space()
    }

    fn shape(&self) -> &NetworkShape {
        &self.ppo.shape
    }

    fn has_scales(&self) -> bool {
        self.ppo.has_scales()
    }

    fn estimate_scales(&mut self, seeds: [u64; 2]) -> Result<(), TrainError> {
        self.ppo.estimate_scales(&mut *self.agents, seeds)
    }

    fn restart(&mut self, seed: u64) -> Result<(), TrainError> {
        Ok(self.ppo.restart(&mut *self.agents, seed)?)
    }

    fn iterate(&mut self, seed: u64) -> Result<Report, TrainError> {
        self.ppo.iterate(&mut *self.agents, seed)
    }

    fn learning_rate(&self) -> f64 {
        self.ppo.rate
    }

    fn clock(&self) -> Clock {
        self.ppo.clock
    }

    fn state(&self) -> Result<LearnerState, TrainError> {
        Ok(self.ppo.state())
    }

    fn restore(&mut self, state: LearnerState) -> Result<(), TrainError> {
        Ok(self.ppo.restore(state)?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rollouts_of_too_many_numbers_are_errors() {
        let mut config = TrainConfig::of_task("hover").unwrap();
        (config.ppo.environments, config.ppo.horizon, config.ppo.recurrent) = (1 << 10, 1 << 16, 256);
        config.validate().unwrap();
        let Err(error) = crate::on_the_cpu(&config) else { panic!("a learner of 68 GB") };
        assert_eq!(error.to_string(), "agents × horizon × inputs is 1024 × 65536 × 268, expected up to 2,147,483,648");
    }
}
