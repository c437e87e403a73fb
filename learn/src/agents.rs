//! Sources of experience: rows of agents that are stepped together.

use aviary::env::{BoxSpace, EndReason, EnvError};
use aviary::multi_agent::{Agent, AgentMap, ParallelEnv};
use aviary::vector::{VecBuffers, VecEnv};
use rayon::prelude::*;

use crate::TrainError;

/// Status of an agent's episode after a step.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Next {
    /// The episode continues.
    #[default]
    Running,
    /// The episode ended by the task: no further reward is possible.
    Terminated,
    /// The episode was cut off: further reward was possible.
    Truncated,
    /// The agent was absent, or its environment failed: training ignores this step.
    Absent,
}

impl Next {
    /// Returns true if the row's next observation belongs to another episode.
    pub fn is_end(self) -> bool {
        self != Self::Running
    }
}

/// Results of a step, for every row.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Outcome {
    /// Observations after the step, rows × observation; of the next episode if one has ended.
    pub observations: Vec<f32>,
    /// Final observations of truncated episodes, rows × observation.
    pub finals: Vec<f32>,
    /// Rewards.
    pub rewards: Vec<f32>,
    /// Status of the episodes.
    pub next: Vec<Next>,
}

impl Outcome {
    /// Creates zeroed buffers for a number of agents and an observation size.
    pub fn new(rows: usize, observation: usize) -> Self {
        Self {
            observations: vec![0.0; rows * observation],
            finals: vec![0.0; rows * observation],
            rewards: vec![0.0; rows],
            next: vec![Next::Running; rows],
        }
    }
}

impl Outcome {
    /// Saves the observations of running rows as final observations, before they are overwritten.
    pub(crate) fn keep_finals(&mut self) {
        let size = self.observations.len() / self.next.len();
        let rows = self.finals.chunks_exact_mut(size).zip(self.observations.chunks_exact(size));
        for ((last, seen), _) in rows.zip(&self.next).filter(|(_, next)| **next == Next::Running) {
            last.copy_from_slice(seen);
        }
    }
}

/// Agents that are stepped together, with automatic resets of their episodes.
pub trait Agents: Send {
    /// Returns the number of agents.
    fn rows(&self) -> usize;

    /// Returns the observation space of one agent.
    fn observation_space(&self) -> &BoxSpace;

    /// Returns the action space of one agent.
    fn action_space(&self) -> &BoxSpace;

    /// Returns the maximum length of an episode of a row, control steps.
    fn longest(&self, row: usize) -> u64;

    /// Resets all environments with a seed, and writes the observations.
    ///
    /// # Errors
    /// The environments' errors.
    fn reset(&mut self, seed: u64, observations: &mut [f32]) -> Result<(), EnvError>;

    /// Steps all agents; `actions` is rows × action.
    ///
    /// # Errors
    /// The environments' errors.
    fn step(&mut self, actions: &[f32], outcome: &mut Outcome) -> Result<(), EnvError>;

    /// Resets the environments of the masked rows, sets the mask for all rows of these environments, and writes
    /// their observations.
    ///
    /// # Errors
    /// The environments' errors.
    fn restart(&mut self, mask: &mut [bool], observations: &mut [f32]) -> Result<(), EnvError>;
}

/// Differences of the environments of training from those of evaluation.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Terms {
    /// Additional penalty for leaving the task's bounds.
    pub out_of_bounds: f32,
    /// Maximum lengths of episodes, control steps, assigned to the environments cyclically. They apply if they are
    /// shorter than the task's limit.
    pub lengths: Vec<Option<u64>>,
}

impl Terms {
    /// Returns the maximum length of an episode of an environment, control steps, for a task with this limit.
    pub fn longest(&self, environment: usize, limit: u64) -> u64 {
        let own = self.lengths.get(environment % self.lengths.len().max(1)).copied().flatten();
        own.unwrap_or(limit).clamp(1, limit)
    }
}

/// One agent per environment of a batch.
pub struct Batch {
    env: Box<dyn VecEnv>,
    buffers: VecBuffers,
    terms: Terms,
}

impl std::fmt::Debug for Batch {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Batch").field("task", &self.env.name()).finish_non_exhaustive()
    }
}

impl Batch {
    /// Creates agents from a batch, which must use [`SameStep`](aviary::vector::Autoreset::SameStep) resets and
    /// [`Truncate`](aviary::vector::OnFault::Truncate) on faults.
    ///
    /// # Errors
    /// [`TrainError::Batch`] if the batch resets at another time, or observes more than the vector of the task.
    pub fn new(env: Box<dyn VecEnv>, terms: Terms) -> Result<Self, TrainError> {
        if env.final_observations().len() != env.num_envs() * env.observation_size() {
            return Err(TrainError::Batch { expected: "resets in the step that ends an episode" });
        }
        if env.observation_size() != env.observation_space().vector.size() {
            return Err(TrainError::Batch { expected: "observations of the task's vector alone" });
        }
        let buffers = VecBuffers::new(&*env);
        Ok(Self { env, buffers, terms })
    }
}

impl Agents for Batch {
    fn rows(&self) -> usize {
        self.env.num_envs()
    }

    fn observation_space(&self) -> &BoxSpace {
        &self.env.observation_space().vector
    }

    fn action_space(&self) -> &BoxSpace {
        self.env.action_space()
    }

    fn longest(&self, row: usize) -> u64 {
        self.terms.longest(row, self.env.episode_steps())
    }

    fn reset(&mut self, seed: u64, observations: &mut [f32]) -> Result<(), EnvError> {
        self.env.reset(Some(seed), observations)
    }

    fn step(&mut self, actions: &[f32], outcome: &mut Outcome) -> Result<(), EnvError> {
        self.env.step(
            actions,
            aviary::vector::VecStep {
                observations: &mut outcome.observations,
                rewards: &mut outcome.rewards,
                terminated: &mut self.buffers.terminated,
                truncated: &mut self.buffers.truncated,
            },
        )?;
        let size = self.env.observation_size();
        let ends = self.buffers.terminated.iter().zip(&self.buffers.truncated);
        for (row, ((&terminated, &truncated), next)) in ends.zip(&mut outcome.next).enumerate() {
            *next = match (terminated, truncated) {
                (true, _) => Next::Terminated,
                (false, true) => Next::Truncated,
                (false, false) => Next::Running,
            };
            if let Some(summary) = next.is_end().then(|| self.env.episode_summary(row)).flatten() {
                match summary.end {
                    Some(EndReason::Fault) => *next = Next::Absent,
                    Some(EndReason::OutOfBounds) => outcome.rewards[row] -= self.terms.out_of_bounds,
                    _ => {}
                }
            }
            if *next == Next::Truncated {
                let own = row * size..(row + 1) * size;
                outcome.finals[own.clone()].copy_from_slice(&self.env.final_observations()[own]);
            }
        }
        Ok(())
    }

    fn restart(&mut self, mask: &mut [bool], observations: &mut [f32]) -> Result<(), EnvError> {
        self.env.reset_where(mask, None, observations)
    }
}

/// One agent per drone of several multi-agent environments, with a shared policy over individual observations. An
/// environment is reset as soon as one of its agents has ended.
pub struct Swarm {
    worlds: Vec<World>,
    terms: Terms,
    agents: usize,
    observation_space: BoxSpace,
    action_space: BoxSpace,
    episode_steps: u64,
}

impl std::fmt::Debug for Swarm {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Swarm").field("worlds", &self.worlds.len()).finish_non_exhaustive()
    }
}

/// One multi-agent environment.
struct World {
    env: Box<dyn ParallelEnv + Send>,
    /// Number of possible agents.
    agents: usize,
    /// Bounds of an agent's observation.
    space: BoxSpace,
}

/// Rows of one environment.
struct Rows<'a> {
    observations: &'a mut [f32],
    finals: &'a mut [f32],
    rewards: &'a mut [f32],
    next: &'a mut [Next],
}

impl World {
    fn reset(&mut self, seed: Option<u64>, observations: &mut [f32]) -> Result<(), EnvError> {
        let (seen, _) = self.env.reset(seed)?;
        let size = observations.len() / self.agents;
        for ((_, seen), row) in seen.iter().zip(observations.chunks_exact_mut(size)) {
            self.space.write_f32(&seen.vector, row);
        }
        Ok(())
    }

    /// Steps all agents of the environment.
    fn step(&mut self, actions: &[f32], rows: Rows<'_>, out_of_bounds: f32) -> Result<(), EnvError> {
        let agents = self.agents;
        let (action_size, size) = (actions.len() / agents, rows.observations.len() / agents);
        let place = |agent: &str, possible: &[Agent]| possible.iter().position(|name| **name == *agent).unwrap_or(0);
        let possible = self.env.possible_agents();
        let agent_actions: AgentMap<Vec<f64>> = (self.env.agents().iter())
            .map(|agent| {
                let own = &actions[place(agent, possible) * action_size..][..action_size];
                (agent.clone(), own.iter().map(|&x| f64::from(x)).collect())
            })
            .collect();
        rows.next.fill(Next::Absent);
        rows.rewards.fill(0.0);
        // steps of a failed environment are discarded, as in a batch
        let Ok(step) = self.env.step(&agent_actions) else { return self.reset(None, rows.observations) };
        let flags = step.terminated.iter().zip(step.truncated.iter()).zip(step.rewards.iter());
        for ((agent, seen), (((_, &terminated), (_, &truncated)), (_, &reward))) in step.observations.iter().zip(flags)
        {
            let row = place(agent, self.env.possible_agents());
            let left = step.infos.get(agent).is_some_and(|info| info.end == Some(EndReason::OutOfBounds));
            rows.rewards[row] = reward as f32 - if left { out_of_bounds } else { 0.0 };
            rows.next[row] = match (terminated, truncated) {
                (true, _) => Next::Terminated,
                (false, true) => Next::Truncated,
                (false, false) => Next::Running,
            };
            self.space.write_f32(&seen.vector, &mut rows.observations[row * size..(row + 1) * size]);
        }
        // the other agents are truncated with the first that ends: a partial swarm adds little experience, and
        // wrecks are slow
        if rows.next.iter().any(|next| next.is_end()) {
            for next in rows.next.iter_mut().filter(|next| **next == Next::Running) {
                *next = Next::Truncated;
            }
            rows.finals.copy_from_slice(rows.observations);
            self.reset(None, rows.observations)?;
        }
        Ok(())
    }
}

impl Swarm {
    /// Creates a number of environments. `make` receives the index of each, which selects its random stream.
    ///
    /// # Errors
    /// The errors of `make`.
    pub fn new(
        environments: usize,
        terms: Terms,
        make: impl Fn(u64) -> Result<Box<dyn ParallelEnv + Send>, EnvError>,
    ) -> Result<Self, EnvError> {
        let empty = || BoxSpace::new([]);
        let worlds = (0..environments.max(1) as u64)
            .map(|stream| {
                let env = make(stream)?;
                let agents = env.possible_agents();
                let space = agents.first().and_then(|agent| env.observation_space(agent));
                let space = space.map_or_else(empty, |space| space.vector.clone());
                Ok(World { agents: agents.len(), space, env })
            })
            .collect::<Result<Vec<_>, EnvError>>()?;
        let first = &worlds[0].env;
        let agents = first.possible_agents();
        Ok(Self {
            terms,
            agents: agents.len(),
            observation_space: worlds[0].space.clone(),
            action_space: agents.first().and_then(|agent| first.action_space(agent).cloned()).unwrap_or_else(empty),
            episode_steps: first.episode_steps(),
            worlds,
        })
    }

    /// Returns the environments, each with its rows of observations.
    fn rows<'a>(
        &'a mut self,
        observations: &'a mut [f32],
    ) -> impl IndexedParallelIterator<Item = (&'a mut World, &'a mut [f32])> {
        let size = self.agents * self.observation_space.size();
        self.worlds.par_iter_mut().zip(observations.par_chunks_exact_mut(size))
    }
}

impl Agents for Swarm {
    fn rows(&self) -> usize {
        self.worlds.len() * self.agents
    }

    fn observation_space(&self) -> &BoxSpace {
        &self.observation_space
    }

    fn action_space(&self) -> &BoxSpace {
        &self.action_space
    }

    fn longest(&self, row: usize) -> u64 {
        self.terms.longest(row / self.agents, self.episode_steps)
    }

    fn reset(&mut self, seed: u64, observations: &mut [f32]) -> Result<(), EnvError> {
        self.rows(observations).try_for_each(|(world, rows)| world.reset(Some(seed), rows))
    }

    fn step(&mut self, actions: &[f32], outcome: &mut Outcome) -> Result<(), EnvError> {
        let (agents, action, out_of_bounds) = (self.agents, self.action_space.size(), self.terms.out_of_bounds);
        let size = agents * self.observation_space.size();
        let Outcome { observations, finals, rewards, next } = outcome;
        let rows = (observations.par_chunks_exact_mut(size).zip(finals.par_chunks_exact_mut(size)))
            .zip(rewards.par_chunks_exact_mut(agents).zip(next.par_chunks_exact_mut(agents)))
            .map(|((observations, finals), (rewards, next))| Rows { observations, finals, rewards, next });
        (self.worlds.par_iter_mut().zip(rows).zip(actions.par_chunks_exact(agents * action)))
            .try_for_each(|((world, rows), actions)| world.step(actions, rows, out_of_bounds))
    }

    fn restart(&mut self, mask: &mut [bool], observations: &mut [f32]) -> Result<(), EnvError> {
        let agents = self.agents;
        self.rows(observations).zip(mask.par_chunks_exact_mut(agents)).try_for_each(|((world, rows), mask)| {
            if !mask.contains(&true) {
                return Ok(());
            }
            mask.fill(true);
            world.reset(None, rows)
        })
    }
}
