//! Where experience comes from: rows of agents that all act at once, whatever they are made of.

use aviary::env::{BoxSpace, EndReason, EnvError};
use aviary::multi_agent::{Agent, AgentMap, ParallelEnv};
use aviary::vector::{VecBuffers, VecEnv};
use rayon::prelude::*;

/// How a step went on for an agent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Next {
    /// It goes on.
    #[default]
    Running,
    /// Its episode has come to an end of its own: no more reward can follow.
    Terminated,
    /// Its episode was cut off: reward could have followed.
    Truncated,
    /// It was not there, or what happened to it was nobody's doing: nothing can be learned from this step.
    Absent,
}

impl Next {
    /// Whether the row's next observation is not the one that follows from its action.
    pub fn is_end(self) -> bool {
        self != Self::Running
    }
}

/// What a step gave, for every row.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Outcome {
    /// rows × observation: what is seen now, of the next episode where one has ended.
    pub observations: Vec<f32>,
    /// rows × observation: what was seen last, where an episode was truncated.
    pub finals: Vec<f32>,
    /// Rewards.
    pub rewards: Vec<f32>,
    /// How it goes on.
    pub next: Vec<Next>,
}

impl Outcome {
    /// For so many agents with so large observations.
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
    /// Keeps what is seen now by rows that go on, before it is written over.
    pub(crate) fn keep_finals(&mut self) {
        let size = self.observations.len() / self.next.len();
        let rows = self.finals.chunks_exact_mut(size).zip(self.observations.chunks_exact(size));
        for ((last, seen), _) in rows.zip(&self.next).filter(|(_, next)| **next == Next::Running) {
            last.copy_from_slice(seen);
        }
    }
}

/// Agents that all act at once and whose episodes begin anew by themselves.
pub trait Agents: Send {
    /// How many there are.
    fn rows(&self) -> usize;

    /// What one of them sees.
    fn observation_space(&self) -> &BoxSpace;

    /// What one of them does.
    fn action_space(&self) -> &BoxSpace;

    /// Control steps after which an episode of an agent is cut off at the latest.
    fn longest(&self, row: usize) -> u64;

    /// Begins with everything anew, random draws from a seed, and writes what is seen.
    ///
    /// # Errors
    /// What the environments have.
    fn reset(&mut self, seed: u64, observations: &mut [f32]) -> Result<(), EnvError>;

    /// Every agent acts: rows × action.
    ///
    /// # Errors
    /// What the environments have.
    fn step(&mut self, actions: &[f32], outcome: &mut Outcome) -> Result<(), EnvError>;

    /// Begins new episodes for the agents of a mask (and for those that share an environment with them), marks in it all for whom one has begun, and writes what
    /// those see.
    ///
    /// # Errors
    /// What the environments have.
    fn restart(&mut self, mask: &mut [bool], observations: &mut [f32]) -> Result<(), EnvError>;
}

/// What training has of its own in the same environments.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Terms {
    /// What leaving the task's space costs more than the task says.
    pub out_of_bounds: f32,
    /// Control steps after which episodes are cut off, for one environment after the other and again, where that is before the task's
    /// own limit.
    pub lengths: Vec<Option<u64>>,
}

impl Terms {
    fn longest(&self, environment: usize, limit: u64) -> u64 {
        let own = self.lengths.get(environment % self.lengths.len().max(1)).copied().flatten();
        own.unwrap_or(limit).clamp(1, limit)
    }
}

/// One agent for every environment of a batch.
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
    /// Of a batch, whose episodes must begin in the step that the ones before end in, and whose faults must be truncations.
    pub fn new(env: Box<dyn VecEnv>, terms: Terms) -> Self {
        let buffers = VecBuffers::new(&*env);
        Self { env, buffers, terms }
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

/// One agent for every drone of many environments of several agents: all fly by the same policy, each by what it sees itself. An
/// environment begins anew as soon as one of them has left.
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

/// One environment of several agents.
struct World {
    env: Box<dyn ParallelEnv + Send>,
    /// How many agents there can be.
    agents: usize,
    /// Bounds of an agent's row.
    space: BoxSpace,
}

/// The rows of one environment.
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

    /// Every agent acts.
    fn step(&mut self, actions: &[f32], rows: Rows<'_>, out_of_bounds: f32) -> Result<(), EnvError> {
        let agents = self.agents;
        let (action_size, size) = (actions.len() / agents, rows.observations.len() / agents);
        let place = |agent: &str, possible: &[Agent]| possible.iter().position(|name| **name == *agent).unwrap_or(0);
        let possible = self.env.possible_agents();
        let said: AgentMap<Vec<f64>> = (self.env.agents().iter())
            .map(|agent| {
                let own = &actions[place(agent, possible) * action_size..][..action_size];
                (agent.clone(), own.iter().map(|&x| f64::from(x)).collect())
            })
            .collect();
        rows.next.fill(Next::Absent);
        rows.rewards.fill(0.0);
        // what a world that failed would have taught is lost, as in a batch
        let Ok(step) = self.env.step(&said) else { return self.reset(None, rows.observations) };
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
        // once one has left, the others are cut off: alone they would learn little, among wrecks slowly
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
    /// So many environments, each made by the function from its number, which is to be its random stream.
    ///
    /// # Errors
    /// What making them finds.
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

    /// The environments with their rows of something.
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
