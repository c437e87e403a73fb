use rand::SeedableRng as _;

use super::{BoxSpace, DroneEnv, EnvError, Rng};
use crate::action::ActionType;
use crate::observation::Observation;

/// Failure of [`check_env`] or [`check_independence`].
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum CheckFailure {
    /// A violated rule of the interface.
    #[error("{task}: {what}")]
    Broken {
        /// Name of the task.
        task: &'static str,
        /// Observed and expected behaviour.
        what: String,
    },
    /// An error where none was expected.
    #[error("{task}: {during}: {error}")]
    Error {
        /// Name of the task.
        task: &'static str,
        /// Part of the check in which the error occurred.
        during: &'static str,
        /// The error.
        error: EnvError,
    },
}

/// Statistics of a passed check.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CheckReport {
    /// Control steps taken.
    pub steps: u64,
    /// Episodes that ended.
    pub episodes: u64,
    /// Entries of the observation vector that never changed and may be constant.
    pub constant: Vec<usize>,
}

/// Record of one episode with random actions.
#[derive(Debug, PartialEq)]
struct EpisodeTrace {
    observations: Vec<Observation>,
    rewards: Vec<f64>,
    initial: Observation,
}

struct Checker<'a> {
    env: &'a mut dyn DroneEnv,
    task: &'static str,
    report: CheckReport,
}

/// Maximum number of control steps in an episode of the checker.
const LONGEST: usize = 400;

/// Checks that an environment follows the interface of [`Env`](super::Env), like Gymnasium's `check_env`. It flies
/// a few episodes with random actions and checks these rules:
///
/// - Observations lie in the observation space, also in single precision. Rewards and all values of
///   [`info`](super::Env::info) are finite.
/// - Episodes with the same seed are bit-identical, and no episode depends on an earlier one.
/// - A reset sets the time to zero, clears the end and puts the drones into the states that the episode starts from.
/// - Every entry of the observation changes, unless it [may be constant](DroneEnv::may_be_constant).
/// - The end of an episode has a reason that agrees with `terminated` and `truncated`, and the next step is an
///   error.
/// - Actions of the wrong length and actions with non-finite entries are errors that change nothing. Actions out of
///   bounds are clipped.
///
/// ```
/// use aviary::env::check_env;
/// use aviary::tasks::Hover;
///
/// let report = check_env(&mut Hover::builder().build()?)?;
/// assert!(report.episodes > 0);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
///
/// # Errors
/// [`CheckFailure`] for the first violated rule.
pub fn check_env(env: &mut dyn DroneEnv) -> Result<CheckReport, CheckFailure> {
    let task = env.name();
    let mut checker = Checker { env, task, report: CheckReport { steps: 0, episodes: 0, constant: Vec::new() } };
    checker.spaces()?;
    let first = checker.episode(1, 11, LONGEST)?;
    let again = checker.episode(1, 11, LONGEST)?;
    if first != again {
        let step = first.rewards.iter().zip(&again.rewards).position(|(a, b)| a != b);
        return checker.broken(format!("two episodes with one seed differ, from step {step:?} on"));
    }
    let mut episodes = vec![first];
    for seed in 2..6 {
        episodes.push(checker.episode(seed, seed + 10, LONGEST)?);
    }
    checker.movement(&episodes)?;
    checker.actions()?;
    checker.end()?;
    Ok(checker.report)
}

/// Checks that two environments with the same options do not affect each other. It flies the first alone, then both
/// in alternating steps.
///
/// ```
/// use aviary::env::check_independence;
/// use aviary::tasks::Hover;
///
/// check_independence(&mut Hover::builder().build()?, &mut Hover::builder().build()?)?;
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
///
/// # Errors
/// [`CheckFailure`] with the first step that differs.
pub fn check_independence(first: &mut dyn DroneEnv, second: &mut dyn DroneEnv) -> Result<(), CheckFailure> {
    let task = first.name();
    let failed = |error| CheckFailure::Error { task, during: "alternating steps of two instances", error };
    let alone = Checker::of(first).episode(7, 3, 60)?;
    let mut agent = RandomAgent::new(first.action_space(), 3);
    first.reset(Some(7)).map_err(failed)?;
    second.reset(Some(8)).map_err(failed)?;
    let mut over = false;
    for (step, observation) in alone.observations.iter().enumerate() {
        let step_now = first.step(&agent.action()).map_err(failed)?;
        let same = *step_now.observation == *observation && step_now.reward == alone.rewards[step];
        if !same {
            let what = format!("a second instance changes the observation or the reward of step {step}");
            return Err(CheckFailure::Broken { task, what });
        }
        if over {
            second.reset(None).map_err(failed)?;
        }
        let far: Vec<_> = second.action_space().high().to_vec();
        let other = second.step(&far).map_err(failed)?;
        over = other.terminated || other.truncated;
    }
    Ok(())
}

/// Random agent: noise around a constant random action, since white noise alone would hardly lift or turn a drone.
struct RandomAgent {
    space: BoxSpace,
    drift: Vec<f64>,
    rng: Rng,
}

impl RandomAgent {
    fn new(space: &BoxSpace, seed: u64) -> Self {
        let mut rng = Rng::seed_from_u64(seed);
        Self { space: space.clone(), drift: space.sample(&mut rng), rng }
    }

    fn action(&mut self) -> Vec<f64> {
        let noise = self.space.sample(&mut self.rng);
        self.drift.iter().zip(&noise).map(|(a, b)| 0.5 * (a + b)).collect()
    }
}

impl<'a> Checker<'a> {
    fn of(env: &'a mut dyn DroneEnv) -> Self {
        let task = env.name();
        Self { env, task, report: CheckReport { steps: 0, episodes: 0, constant: Vec::new() } }
    }

    fn broken<T>(&self, what: String) -> Result<T, CheckFailure> {
        Err(CheckFailure::Broken { task: self.task, what })
    }

    fn error(&self, during: &'static str) -> impl Fn(EnvError) -> CheckFailure + use<> {
        let task = self.task;
        move |error| CheckFailure::Error { task, during, error }
    }

    fn spaces(&self) -> Result<(), CheckFailure> {
        let (actions, kind) = (self.env.action_space(), self.env.action_type());
        let drones = self.env.simulation().num_drones();
        if actions.size() != kind.size() * drones {
            let (got, expected) = (actions.size(), kind.size() * drones);
            return self.broken(format!("the action space has {got} entries, expected {expected} for {kind}"));
        }
        if actions.low().iter().chain(actions.high()).any(|x| !x.is_finite()) {
            return self.broken("the action space has an infinite bound".into());
        }
        let space = self.env.observation_space();
        let mut rng = Rng::seed_from_u64(0);
        if !space.contains(&space.sample(&mut rng)) {
            return self.broken("the observation space does not contain its own sample".into());
        }
        if space.parts().iter().any(|part| part.shape.contains(&0)) {
            return self.broken(format!("a part of the observation is empty: {:?}", space.parts()));
        }
        Ok(())
    }

    /// Flies one episode with random actions, for at most `steps` steps.
    fn episode(&mut self, seed: u64, actions: u64, steps: usize) -> Result<EpisodeTrace, CheckFailure> {
        let failed = self.error("an episode with random actions");
        let initial = self.env.reset(Some(seed)).map_err(&failed)?.clone();
        self.started()?;
        let mut episode = EpisodeTrace { observations: Vec::new(), rewards: Vec::new(), initial };
        let mut agent = RandomAgent::new(self.env.action_space(), actions);
        for _ in 0..steps {
            let action = agent.action();
            let step = self.env.step(&action).map_err(&failed)?;
            let (reward, terminated, truncated) = (step.reward, step.terminated, step.truncated);
            episode.observations.push(step.observation.clone());
            episode.rewards.push(reward);
            self.report.steps += 1;
            self.check_values(reward)?;
            let info = self.env.info();
            let at_limit = self.env.simulation().control_steps() >= self.env.episode_steps();
            if truncated != at_limit {
                return self.broken(format!("truncated is {truncated} at t = {} s", info.time));
            }
            let is_time_limit = info.end.map(|end| end == super::EndReason::TimeLimit);
            let expected = if terminated { Some(false) } else { truncated.then_some(true) };
            if is_time_limit != expected {
                return self.broken(format!(
                    "terminated is {terminated} and truncated {truncated}, but the end in info is {:?}",
                    info.end
                ));
            }
            if terminated || truncated {
                self.report.episodes += 1;
                if !matches!(self.env.step(&action), Err(EnvError::NeedsReset { .. })) {
                    return self.broken("step succeeds after the end of the episode, expected an error".into());
                }
                break;
            }
        }
        Ok(episode)
    }

    /// Checks the state after a reset.
    fn started(&self) -> Result<(), CheckFailure> {
        let (info, simulation) = (self.env.info(), self.env.simulation());
        if info.end.is_some() || info.time != 0.0 || simulation.control_steps() != 0 {
            return self.broken(format!("info after a reset is {info:?}, expected time 0 and no end"));
        }
        if simulation.states() != simulation.started_from() {
            return self.broken("the states after a reset differ from the states that the episode started from".into());
        }
        self.check_values(0.0)
    }

    /// Checks observation, reward and info.
    fn check_values(&self, reward: f64) -> Result<(), CheckFailure> {
        let observation = self.env.observation();
        if !self.env.observation_space().contains(observation) {
            let space = &self.env.observation_space().vector;
            let bounds = space.low().iter().zip(space.high());
            let out = observation.vector.iter().zip(bounds).position(|(x, (low, high))| !(low <= x && x <= high));
            return self.broken(match out {
                Some(entry) => format!("observation[{entry}] is {}, outside its bounds", observation.vector[entry]),
                None => "an observation is outside the observation space".into(),
            });
        }
        let space = &self.env.observation_space().vector;
        let mut row = vec![0.0; space.size()];
        space.write_f32(&observation.vector, &mut row);
        if !space.contains(&row) {
            return self.broken(format!("an observation in single precision is outside its space: {row:?}"));
        }
        if !reward.is_finite() {
            return self.broken(format!("a reward is {reward}, expected a finite number"));
        }
        if let Some((name, value)) = self.env.info_map().into_iter().find(|(_, value)| !value.is_finite()) {
            return self.broken(format!("`{name}` in info is {value}, expected a finite number"));
        }
        let progress = self.env.info().progress;
        if !(0.0..=1.0).contains(&progress) {
            return self.broken(format!("progress is {progress}, expected 0 to 1"));
        }
        Ok(())
    }

    /// Checks that every entry of the observation changes, unless it may be constant.
    fn movement(&mut self, episodes: &[EpisodeTrace]) -> Result<(), CheckFailure> {
        if !self.env.observation_space().kind.kinematic {
            return Ok(());
        }
        // equal speeds of all motors neither turn nor tilt a drone
        let straight = self.env.action_type() == ActionType::OneDRpm;
        for entry in 0..self.env.observation_space().vector.size() {
            let start = episodes[0].initial.vector[entry];
            if episodes.iter().flat_map(|episode| &episode.observations).all(|o| o.vector[entry] == start) {
                self.report.constant.push(entry);
                if !(straight || self.env.may_be_constant(entry)) {
                    return self.broken(format!("observation[{entry}] is always {start}"));
                }
            }
        }
        let moved = episodes.iter().any(|episode| episode.observations.iter().any(|o| *o != episode.initial));
        if moved { Ok(()) } else { self.broken("the observation never changes".into()) }
    }

    /// Checks invalid actions and actions out of bounds.
    fn actions(&mut self) -> Result<(), CheckFailure> {
        let failed = self.error("an action out of bounds");
        let space = self.env.action_space().clone();
        if space.size() == 0 {
            return self.broken("the action space is empty".into());
        }
        for (bound, beyond) in [(space.high(), 1.0), (space.low(), -1.0)] {
            let mut outcomes = Vec::new();
            for factor in [0.0, 3.0] {
                self.env.reset(Some(5)).map_err(&failed)?;
                let before = (self.env.simulation().states().to_vec(), self.env.simulation().control_steps());
                let mut bad = space.high().to_vec();
                bad[0] = f64::NAN;
                if !matches!(self.env.step(&bad), Err(EnvError::Action { index: 0, .. })) {
                    return self.broken("step accepts an action that is not finite, expected an error".into());
                }
                if !matches!(self.env.step(&space.high()[1..]), Err(EnvError::ActionLength { .. })) {
                    return self.broken("step accepts an action of the wrong length, expected an error".into());
                }
                if before.0 != self.env.simulation().states() || before.1 != self.env.simulation().control_steps() {
                    return self.broken("step moves the drones although it returns an error".into());
                }
                let widths = space.high().iter().zip(space.low()).map(|(high, low)| high - low);
                let far: Vec<_> = bound.iter().zip(widths).map(|(x, width)| x + beyond * factor * width).collect();
                let step = self.env.step(&far).map_err(&failed)?;
                outcomes.push((step.observation.clone(), step.reward));
            }
            if outcomes[0] != outcomes[1] {
                return self.broken("step does not clip actions to their bounds".into());
            }
        }
        Ok(())
    }

    /// Checks that an unfinished episode does not affect the next one.
    fn end(&mut self) -> Result<(), CheckFailure> {
        let one = self.episode(9, 9, 20)?;
        self.episode(10, 10, 7)?;
        if one == self.episode(9, 9, 20)? {
            Ok(())
        } else {
            self.broken("an episode depends on the previous one".into())
        }
    }
}
