//! Every drone an agent: PettingZoo's parallel contract.

mod aviary;
mod checker;

pub use aviary::{MultiAgentAviary, ParallelAviary};
pub use checker::check_parallel_env;

use std::sync::Arc;

use crate::env::{BoxSpace, EndReason, EnvConfig, EnvError, ObservationSpace};
use crate::observation::Observation;
use crate::simulation::Simulation;
use crate::tasks::for_task;
use crate::vision::{ImageSize, View};

/// The name of an agent: `drone0`, `drone1`, …
pub type Agent = Arc<str>;

/// Something for each of several agents, in the order of the agents.
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
    /// That of an agent.
    pub fn get(&self, agent: &str) -> Option<&V> {
        self.0.iter().find(|(name, _)| **name == *agent).map(|(_, value)| value)
    }

    /// How many agents there are in it.
    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Agents with what is theirs.
    pub fn iter(&self) -> impl Iterator<Item = (&Agent, &V)> {
        self.0.iter().map(|(agent, value)| (agent, value))
    }

    /// The agents.
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
    /// Of several entries of one agent the last one counts.
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

/// How an episode stands for one agent.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct AgentInfo {
    /// Simulated time of the episode, s.
    pub time: f64,
    /// Whether the agent fulfils its part of the task at this moment.
    pub success: bool,
    /// How much of its part it has done, from 0 to 1.
    pub progress: f64,
    /// Why the episode ended for it; `None` while it runs.
    pub end: Option<EndReason>,
    /// Distance from where the task wants it now, m.
    pub position_error: f64,
}

/// What a step returns, for every agent that was live at its start.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ParallelStep {
    /// What each agent sees now.
    pub observations: AgentMap<Observation>,
    /// Reward of this step.
    pub rewards: AgentMap<f64>,
    /// The episode has come to an end of its own for the agent.
    pub terminated: AgentMap<bool>,
    /// The episode was cut off by its time limit.
    pub truncated: AgentMap<bool>,
    /// How the episode stands.
    pub infos: AgentMap<AgentInfo>,
}

/// Makes an environment of several agents for the task of a name.
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
/// [`EnvError::UnknownName`], and what building it finds.
pub fn make_parallel(name: &str, options: EnvConfig) -> Result<Box<dyn ParallelEnv + Send>, EnvError> {
    let env = for_task!(name, |task| {
        let env = options.with_task(task).build()?;
        Box::new(ParallelAviary::new(env)) as Box<dyn ParallelEnv + Send>
    });
    env.map_err(EnvError::from)
}

/// An environment of several agents that all act at once (PettingZoo's `ParallelEnv`).
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
    /// Name of the task, in lower snake case.
    fn name(&self) -> &'static str;

    /// Every agent that there can be, in order.
    fn possible_agents(&self) -> &[Agent];

    /// The agents that are live: all after a reset, fewer as they leave, none when the episode is over.
    fn agents(&self) -> &[Agent];

    /// What an agent's observations look like; `None` for an agent that cannot be.
    fn observation_space(&self, agent: &str) -> Option<&ObservationSpace>;

    /// What an agent's actions look like; `None` for an agent that cannot be.
    fn action_space(&self, agent: &str) -> Option<&BoxSpace>;

    /// Starts an episode. With a seed, everything random starts anew from it.
    ///
    /// # Errors
    /// As for [`Env::reset`](crate::env::Env::reset).
    fn reset(&mut self, seed: Option<u64>) -> Result<(AgentMap<Observation>, AgentMap<AgentInfo>), EnvError>;

    /// Advances by one control step, under one action for every live agent. An agent whose episode has ended is in this
    /// step's maps for the last time.
    ///
    /// # Errors
    /// [`EnvError::Agent`] where an action is missing or for nobody, and [`EnvError::OfAgent`] where it is of the wrong length or
    /// not a number: nothing has moved then. And what [`Env::step`](crate::env::Env::step) has, after which only a reset leads
    /// on.
    fn step(&mut self, actions: &AgentMap<Vec<f64>>) -> Result<ParallelStep, EnvError>;

    /// Control steps after which an episode is cut off.
    fn episode_steps(&self) -> u64;

    /// The states of all drones, one after the other, each as a [`state_vector`](crate::observation::state_vector) (PettingZoo's
    /// `state`, for critics that see everything).
    fn state(&self) -> Vec<f64>;

    /// Draws a picture for people, as [`Env::render`](crate::env::Env::render).
    ///
    /// # Errors
    /// As there.
    fn render(&mut self, view: View, size: ImageSize, rgb: &mut [u8]) -> Result<(), EnvError>;

    /// The simulation underneath.
    fn simulation(&self) -> &Simulation;
}
