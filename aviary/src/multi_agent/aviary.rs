use super::{Agent, AgentInfo, AgentMap, ParallelEnv, ParallelStep};
use crate::control::{Controller as _, DslPidControl, Reference};
use crate::env::{Aviary, BoxSpace, DroneEnv, EndReason, Env, EnvError, ObservationSpace, Task};
use crate::observation::{Observation, state_vector};
use crate::simulation::Simulation;
use crate::state::DroneState;
use crate::tasks::MultiHover;
use crate::vision::{ImageSize, View};

/// Parallel environment over a task, with one agent per drone. Every agent has its own observation, action, reward
/// and termination. A drone stays in the simulation after its agent has left. Its motors are off; if it has
/// completed its part of the task, it hovers at that place instead, so that it does not fall onto other drones.
///
/// ```
/// use aviary::multi_agent::{AgentMap, ParallelAviary, ParallelEnv};
/// use aviary::tasks::MultiHover;
///
/// let mut env = ParallelAviary::new(MultiHover::builder().build()?);
/// env.reset(Some(1))?;
/// // drone0 climbs; drone1 falls and leaves
/// let actions: AgentMap<_> = env.agents().iter().cloned().zip([vec![0.3; 4], vec![-1.0; 4]]).collect();
/// while env.agents().len() == 2 {
///     env.step(&actions)?;
/// }
/// assert_eq!(&*env.agents()[0], "drone0");
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug)]
pub struct ParallelAviary<T> {
    env: Aviary<T>,
    possible: Vec<Agent>,
    live: Vec<Agent>,
    /// Index of the drone of each live agent.
    drones: Vec<usize>,
    observation_space: ObservationSpace,
    action_spaces: Vec<BoxSpace>,
    action: Vec<f64>,
    /// Controller and target of each drone that hovers after completing its part.
    hover_controllers: Vec<Option<(DslPidControl, Reference)>>,
}

/// The paper's `MultiAgentAviary`.
///
/// ```
/// use aviary::env::AviaryBuilder;
/// use aviary::multi_agent::{MultiAgentAviary, ParallelEnv};
/// use aviary::tasks::MultiHover;
///
/// let env = MultiAgentAviary::new(AviaryBuilder::new(MultiHover::multi_agent()).build()?);
/// assert_eq!(env.possible_agents().len(), 3);
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
pub type MultiAgentAviary = ParallelAviary<MultiHover>;

impl<T: Task + Clone + Send + Sync> ParallelAviary<T> {
    /// Creates a parallel environment over an environment.
    pub fn new(env: Aviary<T>) -> Self {
        let count = env.simulation().num_drones();
        let joint = env.observation_space();
        let vector = if joint.kind.kinematic { env.task().observation_space() } else { BoxSpace::new([]) };
        let bounds = |drone: usize| {
            let (space, size) = (env.action_space(), env.action_type().size());
            let own = drone * size..(drone + 1) * size;
            BoxSpace::new(space.low()[own.clone()].iter().zip(&space.high()[own]).map(|(&low, &high)| [low, high]))
        };
        Self {
            possible: (0..count).map(|drone| format!("drone{drone}").into()).collect(),
            live: Vec::new(),
            drones: Vec::new(),
            observation_space: ObservationSpace { vector, cameras: 1, neighbours: count, ..joint.clone() },
            action_spaces: (0..count).map(bounds).collect(),
            action: vec![0.0; env.action_space().size()],
            hover_controllers: vec![None; count],
            env,
        }
    }

    /// Returns the underlying environment.
    pub fn into_inner(self) -> Aviary<T> {
        self.env
    }

    /// Returns the task.
    pub fn task(&self) -> &T {
        self.env.task()
    }

    fn index(&self, agent: &str) -> Option<usize> {
        self.possible.iter().position(|name| **name == *agent)
    }

    /// Returns a map with a value for every live agent.
    fn each<V>(&self, value: impl Fn(usize) -> V) -> AgentMap<V> {
        self.drones.iter().map(|&drone| (self.possible[drone].clone(), value(drone))).collect()
    }

    fn observations(&self) -> AgentMap<Observation> {
        self.each(|drone| self.env.observation().of_drone(drone, self.possible.len()))
    }

    fn infos(&self, end: impl Fn(usize) -> Option<EndReason>) -> AgentMap<AgentInfo> {
        let (task, simulation) = (self.env.task(), self.env.simulation().view());
        self.each(|drone| AgentInfo {
            time: simulation.time(),
            success: task.success(simulation, drone),
            progress: task.progress(simulation, drone),
            end: end(drone),
            position_error: simulation.distance(drone, &task.reference(simulation, drone).position),
        })
    }

    /// Joins the actions of the agents into one action of the underlying environment.
    fn gather(&mut self, actions: &AgentMap<Vec<f64>>) -> Result<(), EnvError> {
        let wrong = |what, agent: &str| {
            let expected = self.live.iter().map(|agent| &**agent).collect::<Vec<_>>().join(", ");
            Err(EnvError::Agent { what, agent: agent.into(), expected })
        };
        if let Some(agent) = actions.agents().find(|agent| !self.live.contains(agent)) {
            return wrong("unexpected action for", agent);
        }
        let size = self.env.action_type().size();
        // the environment ignores the entries of agents that have left, but they must be within the bounds
        self.action.copy_from_slice(self.env.action_space().low());
        for (agent, &drone) in self.live.iter().zip(&self.drones) {
            let Some(action) = actions.get(agent) else { return wrong("missing action for", agent) };
            let invalid = |error| Err(EnvError::OfAgent { agent: agent.to_string(), error: Box::new(error) });
            if action.len() != size {
                return invalid(EnvError::ActionLength { got: action.len(), expected: size });
            }
            if let Some((index, &got)) = action.iter().enumerate().find(|(_, x)| !x.is_finite()) {
                return invalid(EnvError::Action { index, got, time: self.env.simulation().time() });
            }
            self.action[drone * size..][..size].copy_from_slice(action);
        }
        Ok(())
    }
}

impl<T: Task + Clone + Send + Sync> ParallelEnv for ParallelAviary<T> {
    fn name(&self) -> &'static str {
        self.env.name()
    }

    fn possible_agents(&self) -> &[Agent] {
        &self.possible
    }

    fn agents(&self) -> &[Agent] {
        &self.live
    }

    fn observation_space(&self, agent: &str) -> Option<&ObservationSpace> {
        self.index(agent).map(|_| &self.observation_space)
    }

    fn action_space(&self, agent: &str) -> Option<&BoxSpace> {
        self.index(agent).map(|drone| &self.action_spaces[drone])
    }

    fn reset(&mut self, seed: Option<u64>) -> Result<(AgentMap<Observation>, AgentMap<AgentInfo>), EnvError> {
        self.live.clear();
        self.drones.clear();
        self.hover_controllers.fill(None);
        self.env.reset(seed)?;
        self.live.extend_from_slice(&self.possible);
        self.drones.extend(0..self.possible.len());
        Ok((self.observations(), self.infos(|_| None)))
    }

    fn step(&mut self, actions: &AgentMap<Vec<f64>>) -> Result<ParallelStep, EnvError> {
        if self.live.is_empty() {
            return Err(EnvError::NeedsReset { when: "while no agent is live" });
        }
        self.gather(actions)?;
        let (drones, hover_controllers, dt) =
            (&self.drones, &mut self.hover_controllers, self.env.simulation().control_period());
        let override_rpm = |drone: usize, state: &DroneState| {
            let held =
                hover_controllers[drone].as_mut().map(|(control, target)| control.control(dt, state, target).rpm);
            if drones.contains(&drone) { None } else { Some(held.unwrap_or([0.0; 4])) }
        };
        let done = self.env.advance(&self.action, override_rpm).and_then(|()| {
            let mut parts = self.env.parts();
            parts.observe_numbers()?;
            parts.observe_images()
        });
        if let Err(error) = done {
            // the drones may have moved, so that only a reset can continue
            self.live.clear();
            self.drones.clear();
            return Err(error);
        }
        let out_of_time = self.env.is_out_of_time();
        let end = |drone: usize| self.env.drone_end(drone);
        let step = ParallelStep {
            observations: self.observations(),
            rewards: self.each(|drone| self.env.reward_of(drone)),
            terminated: self.each(|drone| end(drone).is_some()),
            truncated: self.each(|_| out_of_time),
            infos: self.infos(|drone| end(drone).or(out_of_time.then_some(EndReason::TimeLimit))),
        };
        for &drone in &self.drones {
            if self.env.drone_end(drone) == Some(EndReason::Completed) {
                let (simulation, state) = (self.env.simulation(), &self.env.simulation().states()[drone]);
                let target = Reference::hover(state.position, state.yaw());
                self.hover_controllers[drone] = Some((DslPidControl::new(simulation.params(drone)), target));
            }
        }
        let last = self.drones.last().and_then(|&drone| self.env.drone_end(drone));
        let stays = |drone: &usize| !out_of_time && self.env.drone_end(*drone).is_none();
        self.drones.retain(stays);
        self.live.clear();
        self.live.extend(self.drones.iter().map(|&drone| self.possible[drone].clone()));
        if self.live.is_empty() {
            self.env.episode.finish(last.unwrap_or(EndReason::TimeLimit));
        }
        Ok(step)
    }

    fn episode_steps(&self) -> u64 {
        self.env.episode_steps()
    }

    fn state(&self) -> Vec<f64> {
        self.env.simulation().states().iter().flat_map(state_vector).collect()
    }

    fn render(&mut self, view: View, size: ImageSize, rgb: &mut [u8]) -> Result<(), EnvError> {
        self.env.render(view, size, rgb)
    }

    fn simulation(&self) -> &Simulation {
        self.env.simulation()
    }

    fn drone_env(&self) -> &dyn DroneEnv {
        &self.env
    }

    fn drone_env_mut(&mut self) -> &mut dyn DroneEnv {
        &mut self.env
    }
}
