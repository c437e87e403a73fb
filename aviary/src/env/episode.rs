use rand::SeedableRng as _;
use smallvec::SmallVec;

use super::randomization::Randomizer;
use super::{EndReason, EnvError, Info, Randomization, Rng, Task};
use crate::random::CompactRng;
use crate::simulation::SimView;

/// State of an environment in addition to its [`SimData`](crate::simulation::SimData): task, random stream, sampled
/// parameters, end of the episode.
#[derive(Debug, Clone)]
pub(crate) struct Episode<T> {
    pub task: T,
    pub rng: CompactRng,
    /// Index of the seed's random stream that the environment uses.
    pub stream: u64,
    /// True if the task's options may have changed since they were validated.
    pub task_changed: bool,
    pub(super) randomizer: Option<Box<Randomizer>>,
    /// The randomization from the next reset on, if it was changed.
    pub(super) next_randomization: Option<Option<Box<Randomization>>>,
    pub phase: Phase,
    /// Reason of the end of the episode.
    pub end: Option<EndReason>,
    /// Reason of the end for each drone, from the last step.
    pub ends: SmallVec<[Option<EndReason>; 8]>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub(crate) enum Phase {
    New,
    Running,
    Over,
}

/// Outcome of a control step for an agent of all drones.
#[derive(Debug, Clone, Copy)]
pub(crate) struct StepOutcome {
    pub reward: f64,
    pub terminated: bool,
    pub truncated: bool,
    /// Reason of the end, if the episode is over.
    pub end: Option<EndReason>,
}

impl<T> Episode<T> {
    pub(super) fn new(task: T, stream: u64, randomizer: Option<Randomizer>, drones: usize) -> Self {
        let mut rng = Rng::seed_from_u64(0);
        rng.set_stream(stream);
        Self {
            task,
            rng: CompactRng::from(&rng),
            stream,
            task_changed: false,
            randomizer: randomizer.map(Box::new),
            next_randomization: None,
            phase: Phase::New,
            end: None,
            ends: SmallVec::from_elem(None, drones),
        }
    }

    /// Uses another of the seed's random streams from now on.
    pub(crate) fn set_stream(&mut self, stream: u64) {
        self.stream = stream;
        self.rng.set_stream(stream);
    }

    /// Returns the size on the heap in bytes, without the task's.
    pub(crate) fn bytes(&self) -> usize {
        self.randomizer.as_ref().map_or(0, |randomizer| randomizer.bytes())
    }

    /// Returns true if parameters are sampled for every episode.
    pub(crate) fn is_randomized(&self) -> bool {
        self.randomizer.is_some() || self.next_randomization.is_some()
    }

    /// Returns the randomizations of this episode and of the next one.
    pub(crate) fn randomizations(&self) -> impl Iterator<Item = &Randomization> {
        let next = self.next_randomization.iter().flatten().map(|config| &**config);
        self.randomizer.iter().map(|randomizer| randomizer.config()).chain(next)
    }

    /// Returns true if this episode and the next one have the same randomization as another episode.
    pub(crate) fn shares_randomization(&self, other: &Self) -> bool {
        let same = match (&self.randomizer, &other.randomizer) {
            (Some(own), Some(other)) => own.shares_basis(other),
            (None, None) => true,
            _ => false,
        };
        self.next_randomization.is_none() && same
    }

    /// Returns the sampled parameters, if there are any.
    pub(crate) fn randomizer(&self) -> Option<&Randomizer> {
        self.randomizer.as_deref()
    }

    /// Returns an error unless an episode is running.
    pub(crate) fn check_running(&self) -> Result<(), EnvError> {
        match self.phase {
            Phase::Running => Ok(()),
            Phase::New => Err(EnvError::NeedsReset { when: "on a new environment" }),
            Phase::Over => Err(EnvError::NeedsReset { when: "after the end of the episode" }),
        }
    }

    /// Ends the episode.
    pub(crate) fn finish(&mut self, end: EndReason) {
        self.end = Some(end);
        self.phase = Phase::Over;
    }
}

impl<T: Task> Episode<T> {
    /// Returns a drone's reward for the last step.
    pub(crate) fn reward_of(&self, simulation: SimView<'_>, drone: usize) -> f64 {
        self.task.reward(simulation, drone, self.ends[drone])
    }

    /// Returns the terms of a drone's reward for the last step.
    pub(crate) fn reward_terms_of(&self, simulation: SimView<'_>, drone: usize) -> Vec<(&'static str, f64)> {
        self.task.reward_terms(simulation, drone, self.ends[drone])
    }

    /// Returns true if no drone has crashed and all fulfil the task in this state.
    pub(crate) fn is_success(&self, simulation: SimView<'_>, end: Option<EndReason>) -> bool {
        let crashed = end.is_some_and(EndReason::is_crash);
        !crashed && (0..self.ends.len()).all(|drone| self.task.success(simulation, drone))
    }

    /// Returns the state of the episode.
    pub(crate) fn info(&self, simulation: SimView<'_>) -> Info {
        let count = self.ends.len();
        // the task must not be evaluated with options that have not been validated
        let evaluated = if self.task_changed { 0 } else { count };
        let distance = |drone| simulation.distance(drone, &self.task.reference(simulation, drone).position);
        let started = self.phase != Phase::New;
        Info {
            time: simulation.time(),
            success: started && self.is_success(simulation, self.end),
            progress: if started {
                (0..count).map(|drone| self.task.progress(simulation, drone)).sum::<f64>() / count as f64
            } else {
                0.0
            },
            end: self.end,
            position_error: (0..evaluated).map(distance).fold(0.0, f64::max),
            contacts: simulation.contacts().len(),
        }
    }

    /// Returns the outcome of the last control step in an episode of at most `episode_steps` steps.
    pub(crate) fn outcome(&self, simulation: SimView<'_>, episode_steps: u64) -> StepOutcome {
        // one crash ends the episode; completion ends it once all drones have completed
        let (mut crash, mut early, mut completed) = (None, None, true);
        for &end in &self.ends {
            completed &= end == Some(EndReason::Completed);
            early = early.or(end.filter(|&end| end != EndReason::Completed));
            crash = crash.or(end.filter(|end| end.is_crash()));
        }
        let end = crash.or(early).or(completed.then_some(EndReason::Completed));
        let (terminated, truncated) = (end.is_some(), simulation.control_steps() >= episode_steps);
        let reward = (0..self.ends.len()).map(|drone| self.reward_of(simulation, drone)).sum();
        StepOutcome { reward, terminated, truncated, end: end.or(truncated.then_some(EndReason::TimeLimit)) }
    }
}
