//! Multi-agent environments with one agent per drone, after PettingZoo's `ParallelEnv`.

mod aviary;
mod checker;

pub use aviary::{MultiAgentAviary, ParallelAviary};
pub use checker::check_parallel_env;

use std::sync::Arc;

use crate::env::{BoxSpace, DroneEnv, EndReason, EnvConfig, EnvError, ObservationSpace};
use crate::observation::Observation;
use crate::simulation::Simulation;
use crate::tasks::for_task;
use crate::vision::{ImageSize, View};

/// Name of an agent: `drone0`, `drone1`, …
pub type Agent = Arc<str>;

/// Map from agents to values, in the order of the agents.
///
/// ```
/// use aviary::multi_agent::{Agent, AgentMap};
///
/// let rewards = [("drone0", 1.0), ("drone1", 0.5)];
/// let rewards: AgentMap<f64> = rewards.into_iter().map(|(agent, x)| (Agent::from(agent), x)).collect();
/// assert_eq!((rewards.get("drone1"), rewards.get("drone2")), (Some(&0.5), None));
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct AgentMap<V>(Vec<(Agent, V)>);

impl<V> AgentMap<V> {
    /// Returns the value of an agent.
    pub fn get(&self, agent: &str) -> Option<&V> {
        self.0.iter().find(|(name, _)| **name == *agent).map(|(_, value)| value)
    }

    /// Returns the number of agents.
    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// Returns true if the map is empty.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Returns an iterator over the agents and their values.
    pub fn iter(&self) -> impl Iterator<Item = (&Agent, &V)> {
        self.0.iter().map(|(agent, value)| (agent, value))
    }

    /// Returns an iterator over the agents.
    pub fn agents(&self) -> impl Iterator<Item = &Agent> {
        self.0.iter().map(|(agent, _)| agent)
    }
}

impl<V> Default for AgentMap<V> {
    fn default() -> Self {
        Self(Vec::new())
    }
}

impl<V> FromIterator<(Agent, V)> for AgentMap<V> {
    /// Collects entries. The last of several entries for the same agent wins.
    fn from_iter<I: IntoIterator<Item = (Agent, V)>>(entries: I) -> Self {
        let mut map: Vec<(Agent, V)> = Vec::new();
        for (agent, value) in entries {
            match map.iter_mut().find(|(name, _)| *name == agent) {
                Some(entry) => entry.1 = value,
                None => map.push((agent, value)),
            }
        }
        Self(map)
    }
}

/// State of an episode for one agent.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct AgentInfo {
    /// Simulated time of the episode, s.
    pub time: f64,
    /// True if the agent currently fulfils its part of the task.
    pub success: bool,
    /// Completed fraction of the agent's part, from 0 to 1.
    pub progress: f64,
    /// Reason why the episode ended for the agent; `None` while it runs.
    pub end: Option<EndReason>,
    /// Distance of the drone from its current reference position, m.
    pub position_error: f64,
}

/// Result of a step, with a value for every agent that was live before it.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ParallelStep {
    /// Observation after the step.
    pub observations: AgentMap<Observation>,
    /// Reward of the step.
    pub rewards: AgentMap<f64>,
    /// True if the task ended the episode of the agent.
    pub terminated: AgentMap<bool>,
    /// True if the time limit ended the episode.
    pub truncated: AgentMap<bool>,
    /// State of the episode.
    pub infos: AgentMap<AgentInfo>,
}

/// Creates a multi-agent environment of a task by name.
///
/// ```
/// use aviary::env::EnvConfig;
/// use aviary::multi_agent::make_parallel;
///
/// let env = make_parallel("multi_hover", EnvConfig::default().num_drones(5))?;
/// assert_eq!(env.possible_agents().len(), 5);
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
///
/// # Errors
/// [`EnvError::UnknownName`] if no task has the name, and the errors of
/// [`AviaryBuilder::build`](crate::env::AviaryBuilder::build).
pub fn make_parallel(name: &str, options: EnvConfig) -> Result<Box<dyn ParallelEnv + Send>, EnvError> {
    let env = for_task!(name, |task| {
        let env = options.for_task(task)?.build()?;
        Box::new(ParallelAviary::new(env)) as Box<dyn ParallelEnv + Send>
    });
    env.map_err(EnvError::from)
}

/// An environment of several agents that act at the same time, after PettingZoo's `ParallelEnv`.
///
/// ```
/// use aviary::multi_agent::{MultiAgentAviary, ParallelEnv};
/// use aviary::tasks::MultiHover;
///
/// let mut env = MultiAgentAviary::new(MultiHover::builder().num_drones(3).build()?);
/// let (observations, _) = env.reset(Some(7))?;
/// assert_eq!(observations.get("drone2").map(|seen| seen.vector.len()), Some(13));
/// while !env.agents().is_empty() {
///     let actions = env.agents().iter().map(|agent| (agent.clone(), vec![0.01; 4])).collect();
///     let step = env.step(&actions)?;
///     assert_eq!(step.rewards.len(), step.observations.len());
/// }
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
pub trait ParallelEnv {
    /// Returns the name of the task, in lower snake case.
    fn name(&self) -> &'static str;

    /// Returns all agents of the environment, in order.
    fn possible_agents(&self) -> &[Agent];

    /// Returns the live agents: all agents after a reset, and none after the end of the episode.
    fn agents(&self) -> &[Agent];

    /// Returns the observation space of an agent; `None` for an unknown agent.
    fn observation_space(&self, agent: &str) -> Option<&ObservationSpace>;

    /// Returns the action space of an agent; `None` for an unknown agent.
    fn action_space(&self, agent: &str) -> Option<&BoxSpace>;

    /// Starts an episode and returns the observations and infos of all agents. A seed restarts every random stream.
    ///
    /// # Errors
    /// Returns the errors of [`Env::reset`](crate::env::Env::reset).
    fn reset(&mut self, seed: Option<u64>) -> Result<(AgentMap<Observation>, AgentMap<AgentInfo>), EnvError>;

    /// Advances the environment by one control step, with one action for every live agent. The maps of the step
    /// contain an agent for the last time when its episode ends.
    ///
    /// # Errors
    /// - [`EnvError::Agent`] for a missing action or an action of an agent that is not live. Nothing has changed.
    /// - [`EnvError::OfAgent`] for an action of the wrong length or an action that is not finite. Nothing has
    ///   changed.
    /// - The errors of [`Env::step`](crate::env::Env::step). The environment must be reset after them.
    fn step(&mut self, actions: &AgentMap<Vec<f64>>) -> Result<ParallelStep, EnvError>;

    /// Returns the number of control steps after which an episode is truncated.
    fn episode_steps(&self) -> u64;

    /// Returns the states of all drones, N × [`STATE_SIZE`](crate::observation::STATE_SIZE), each as a
    /// [`state_vector`](crate::observation::state_vector). This is PettingZoo's `state`, for centralized critics.
    fn state(&self) -> Vec<f64>;

    /// Renders an RGB image, like [`Env::render`](crate::env::Env::render).
    ///
    /// # Errors
    /// Returns the errors of [`Env::render`](crate::env::Env::render).
    fn render(&mut self, view: View, size: ImageSize, rgb: &mut [u8]) -> Result<(), EnvError>;

    /// Returns the underlying simulation.
    fn simulation(&self) -> &Simulation;

    /// Returns the underlying environment, in which one agent commands all drones: its metrics, the terms of rewards,
    /// the sampled parameters.
    ///
    /// ```
    /// use aviary::env::EnvConfig;
    /// use aviary::multi_agent::make_parallel;
    ///
    /// let mut env = make_parallel("race", EnvConfig::default().num_drones(2))?;
    /// env.reset(Some(1))?;
    /// assert_eq!(env.drone_env().info_map()["gates_passed"], 0.0);
    /// # Ok::<(), aviary::env::EnvError>(())
    /// ```
    fn drone_env(&self) -> &dyn DroneEnv;

    /// Returns the underlying environment for changes of its wind, randomization or task options. The caller must not
    /// step, reset or restore it.
    fn drone_env_mut(&mut self) -> &mut dyn DroneEnv;
}
