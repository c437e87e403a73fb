use super::{BoxSpace, EndReason, EnvError, Rng};
use crate::control::Reference;
use crate::simulation::Simulation;

/// What a task starts from unless the caller says otherwise.
#[derive(Debug, Clone, PartialEq)]
pub struct TaskDefaults {
    /// Number of drones.
    pub num_drones: usize,
    /// Length of an episode, s.
    pub episode_seconds: f64,
}

/// A task: what is seen, what is rewarded and when it ends. [`Aviary`](super::Aviary) makes an environment of it.
///
/// The order of calls is `reset`, `observe` at the start of an episode, and after every control step `update`,
/// `end`, `reward`, `observe`: what `update` changes (a waypoint that was reached) is seen by all that follow.
pub trait Task {
    /// Name, in lower snake case.
    fn name(&self) -> &'static str;

    /// Where it starts from.
    fn defaults(&self) -> TaskDefaults;

    /// Initial positions for so many drones, world frame, m.
    fn initial_positions(&self, num_drones: usize) -> Vec<[f64; 3]>;

    /// What its observations look like for so many drones.
    fn observation_space(&self, num_drones: usize) -> BoxSpace;

    /// Checks the task's own options against the number of drones.
    ///
    /// # Errors
    /// [`EnvError::Option`] naming one that is impossible.
    fn check(&self, num_drones: usize) -> Result<(), EnvError>;

    /// Starts an episode; every random draw comes from `rng`.
    fn reset(&mut self, simulation: &Simulation, rng: &mut Rng);

    /// Looks at the new state after a control step.
    fn update(&mut self, simulation: &Simulation);

    /// Why the episode is over, if it is (the time limit is not the task's).
    fn end(&self, simulation: &Simulation) -> Option<EndReason>;

    /// Reward of the last control step, whose end was `end`.
    fn reward(&self, simulation: &Simulation, end: Option<EndReason>) -> f64;

    /// Writes the observation.
    fn observe(&self, simulation: &Simulation, out: &mut [f64]);

    /// Whether the task is fulfilled at this moment.
    fn success(&self, simulation: &Simulation) -> bool;

    /// What a controller flying this task would be asked to follow now.
    fn reference(&self, simulation: &Simulation, drone: usize) -> Reference;
}
