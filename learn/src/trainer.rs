//! Training runs: iterations, evaluations, the best policy, checkpoints.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use aviary::env::Rng;
use aviary::policy::{Gru, Mlp, PolicyInfo, PolicyNetwork};
use rand::{Rng as _, SeedableRng as _};
use serde::{Deserialize, Serialize};

use crate::agents::Agents;
use crate::checkpoint::{Checkpoint, Limits, State};
use crate::curve::Point;
use crate::evaluation::{Arena, Episode, Score};
use crate::learner::{CpuLearner, Learner, LearnerState};
use crate::optimizer::Moments;
use crate::ppo::Clock;
use crate::scale::RewardScale;
use crate::{TrainConfig, TrainDevice, TrainError};

/// First seed of evaluation episodes; the environments of training use streams of other seeds.
const EVALUATION_SEED: u64 = 1 << 40;

/// First seed of the episodes that confirm a success.
const CONFIRMATION_SEED: u64 = 1 << 41;

/// Reason why a run stopped.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Stop {
    /// The run reached its number of steps.
    Steps,
    /// The policy succeeded, and the run was set to stop on success.
    Success,
}

/// Training run.
///
/// ```
/// use learn::{TrainConfig, Trainer};
///
/// let mut config = TrainConfig::of_task("hover")?;
/// config.steps = 2_000;
/// (config.ppo.environments, config.ppo.horizon, config.episodes) = (64, 16, 2);
/// let mut trainer = Trainer::new(config, "a test")?;
/// while trainer.stop().is_none() {
///     trainer.advance()?;
/// }
/// assert_eq!(trainer.curve().last().map(|point| point.steps), Some(2_048));
/// assert_eq!(trainer.best().info().task, "hover");
/// # Ok::<(), learn::TrainError>(())
/// ```
pub struct Trainer {
    config: TrainConfig,
    command: String,
    learner: Box<dyn Learner>,
    arena: Arena,
    iteration: u64,
    curve: Vec<Point>,
    best: (PolicyNetwork, Option<Score>),
    stop: Option<Stop>,
    /// Number of iterations before the run was resumed.
    first: u64,
    /// True if the environments must be reset before the next iteration.
    fresh: bool,
    began: Instant,
    /// Wall time of the evaluations.
    evaluation: Duration,
}

impl std::fmt::Debug for Trainer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Trainer")
            .field("config", &self.config)
            .field("iteration", &self.iteration)
            .finish_non_exhaustive()
    }
}

/// Number of rewards that count for the scale of a run that starts from another one.
const REMEMBERED: f64 = 1e6;

impl Trainer {
    /// Creates a run on the CPU. `command` is recorded in the policies' metadata.
    ///
    /// # Errors
    /// Invalid settings, and errors of the creation of environments.
    pub fn new(config: TrainConfig, command: &str) -> Result<Self, TrainError> {
        config.validate()?;
        let learner = on_the_cpu(&config)?;
        Self::with_learner(config, command, learner)
    }

    /// Creates a run with a learner, which has the environments of training. The environments of the configuration
    /// evaluate the policy.
    ///
    /// # Errors
    /// Invalid settings, and errors of the creation of environments.
    pub fn with_learner(config: TrainConfig, command: &str, learner: Box<dyn Learner>) -> Result<Self, TrainError> {
        config.validate()?;
        let arena = Arena::new(config.success, || config.environment())?;
        Self::assemble(config, command, learner, arena)
    }

    /// Creates a run of a custom task. `agents` collect experience, and the environments of `arena` evaluate the
    /// policy. The environment settings of the configuration are only recorded.
    ///
    /// # Errors
    /// Invalid settings.
    pub fn with(config: TrainConfig, command: &str, agents: Box<dyn Agents>, arena: Arena) -> Result<Self, TrainError> {
        config.validate()?;
        let learner = CpuLearner::new(&config, agents)?;
        Self::assemble(config, command, Box::new(learner), arena)
    }

    fn assemble(
        config: TrainConfig,
        command: &str,
        learner: Box<dyn Learner>,
        arena: Arena,
    ) -> Result<Self, TrainError> {
        // the run continues and its policy flies without the file of a track
        let track = config.track.as_ref().map(|track| track.without_path()).transpose()?;
        let config = TrainConfig { track, ..config };
        let (began, evaluation) = (Instant::now(), Duration::ZERO);
        let best = (policy_of(&config, command, &*learner, 0)?, None);
        let (command, curve) = (command.to_string(), Vec::new());
        let (iteration, first, stop, fresh) = (0, 0, None, true);
        Ok(Self { config, command, learner, arena, iteration, first, fresh, curve, best, stop, began, evaluation })
    }

    /// Starts a run with the networks and the scales of another one, in place of random networks: to continue with
    /// other conditions, rewards or settings. Observations, actions and layers must be those of the other run.
    /// Optimizer, curve and best policy are new, and the scale of the rewards adapts within some millions of steps.
    ///
    /// # Errors
    /// [`TrainError::File`] for an invalid checkpoint, or one with other sizes or another action type.
    /// [`TrainError::Option`] after the first iteration.
    pub fn start_from(&mut self, path: impl AsRef<Path>) -> Result<(), TrainError> {
        let path = path.as_ref();
        if self.iteration > 0 {
            let got = format!("iteration {}", self.iteration);
            return Err(TrainError::Option { option: "start_from", got, expected: "a run before its first iteration" });
        }
        let checkpoint = Checkpoint::load(path)?;
        let wrong = |message| {
            let error = Box::new(TrainError::Checkpoint { message });
            TrainError::File { path: path.into(), error }
        };
        let shape = self.learner.shape();
        let other = checkpoint.shape(shape.action());
        if other != *shape {
            return Err(wrong(format!("its networks are {other}, expected {shape}")));
        }
        checkpoint.validate_networks(shape).map_err(wrong)?;
        let meaning = |config: &TrainConfig| (config.action_type, config.per_drone);
        if meaning(&checkpoint.state.config) != meaning(&self.config) {
            let text = |config: &TrainConfig| format!("{} (per_drone = {})", config.action_type, config.per_drone);
            let (got, expected) = (text(&checkpoint.state.config), text(&self.config));
            return Err(wrong(format!("its actions are {got}, expected {expected}")));
        }
        // the scale follows the rewards of this run soon
        let mut rewards = checkpoint.state.rewards.sums().clone();
        rewards.limit(REMEMBERED);
        let zeros = vec![0.0; checkpoint.parameters.len()];
        self.learner.restore(LearnerState {
            parameters: checkpoint.parameters,
            optimizer_steps: 0,
            first_moments: zeros.clone(),
            second_moments: zeros,
            learning_rate: self.config.ppo.learning_rate,
            observations: checkpoint.state.observations,
            rewards,
        })?;
        self.best = (policy_of(&self.config, &self.command, &*self.learner, 0)?, None);
        Ok(())
    }

    /// Resumes a run on the CPU from a checkpoint. The result is bit-identical to that of an uninterrupted run if
    /// [`is_checkpoint`](Self::is_checkpoint) was true when the checkpoint was taken.
    ///
    /// # Errors
    /// [`TrainError::File`] for an invalid checkpoint. [`TrainError::Option`] for the checkpoint of a run on another
    /// device.
    pub fn resume(path: impl AsRef<Path>) -> Result<Self, TrainError> {
        Self::resume_with(path, on_the_cpu)
    }

    /// Resumes a run from a checkpoint, like [`resume`](Self::resume), with the learner that `make` creates for the
    /// configuration of the checkpoint.
    ///
    /// # Errors
    /// [`TrainError::File`] for an invalid checkpoint, and the errors of `make`.
    pub fn resume_with<E: From<TrainError>>(
        path: impl AsRef<Path>,
        make: impl FnOnce(&TrainConfig) -> Result<Box<dyn Learner>, E>,
    ) -> Result<Self, E> {
        let path: PathBuf = path.as_ref().into();
        let checkpoint = Checkpoint::load(&path)?;
        let config = checkpoint.state.config.clone();
        config.validate()?;
        let mut trainer = Self::with_learner(config.clone(), &checkpoint.state.command, make(&config)?)?;
        trainer.restore(checkpoint, path)?;
        Ok(trainer)
    }

    /// Restores the state of a checkpoint.
    fn restore(&mut self, checkpoint: Checkpoint, path: PathBuf) -> Result<(), TrainError> {
        let trainer = self;
        let wrong = |error| TrainError::File { path: path.clone(), error: Box::new(error) };
        let best = PolicyNetwork::from_bytes(&checkpoint.best).map_err(|error| wrong(error.into()))?;
        let run = Limits {
            shape: trainer.learner.shape(),
            steps_per_iteration: trainer.steps_per_iteration(),
            updates_per_iteration: trainer.config.ppo.updates_per_iteration(trainer.learner.rows()),
        };
        checkpoint.validate(&run, &best).map_err(|message| wrong(TrainError::Checkpoint { message }))?;
        let Checkpoint { state, parameters, moments, curve, .. } = checkpoint;
        let learner = LearnerState {
            parameters,
            optimizer_steps: moments.time,
            first_moments: moments.first,
            second_moments: moments.second,
            learning_rate: state.rate,
            observations: state.observations,
            rewards: state.rewards.sums().clone(),
        };
        trainer.learner.restore(learner).map_err(wrong)?;
        trainer.iteration = state.iteration;
        trainer.first = state.iteration;
        trainer.curve = curve;
        trainer.best = (best, state.best);
        trainer.stop = trainer.out_of_steps();
        Ok(())
    }

    /// Returns the configuration.
    pub fn config(&self) -> &TrainConfig {
        &self.config
    }

    /// Changes the number of steps of a resumed run, or sets it to stop on success.
    ///
    /// # Errors
    /// [`TrainError::Option`] for an invalid number of steps; the run is then unchanged.
    pub fn extend(&mut self, steps: Option<u64>, until_success: bool) -> Result<(), TrainError> {
        TrainConfig { steps: steps.unwrap_or(self.config.steps), ..self.config.clone() }.validate()?;
        if let Some(steps) = steps {
            self.command += &format!(", resumed with --steps {steps}");
        }
        if until_success && !self.config.until_success {
            self.command += ", resumed with --until-success";
        }
        self.config.steps = steps.unwrap_or(self.config.steps);
        self.config.until_success |= until_success;
        self.stop = self.out_of_steps();
        Ok(())
    }

    /// Returns the number of environment steps of an iteration.
    pub fn steps_per_iteration(&self) -> u64 {
        (self.learner.rows() * self.config.ppo.horizon) as u64
    }

    /// Returns the number of environment steps so far, of all agents.
    pub fn steps(&self) -> u64 {
        self.iteration * self.steps_per_iteration()
    }

    /// Returns the number of environment steps since the trainer was created or resumed.
    pub fn steps_here(&self) -> u64 {
        (self.iteration - self.first) * self.steps_per_iteration()
    }

    /// Returns why the run stopped; `None` while it continues.
    pub fn stop(&self) -> Option<Stop> {
        self.stop
    }

    /// Returns the points of all iterations so far.
    pub fn curve(&self) -> &[Point] {
        &self.curve
    }

    /// Returns the current policy.
    ///
    /// # Errors
    /// [`TrainError::Policy`] if its parameters are not finite, and the errors of a device.
    pub fn policy(&self) -> Result<PolicyNetwork, TrainError> {
        policy_of(&self.config, &self.command, &*self.learner, self.steps())
    }

    /// Returns the best evaluated policy; the initial one before the first evaluation.
    pub fn best(&self) -> &PolicyNetwork {
        &self.best.0
    }

    /// Returns the score of the best policy.
    pub fn best_score(&self) -> Option<Score> {
        self.best.1
    }

    /// Returns the wall time by activity since the trainer was created or resumed.
    pub fn clock(&self) -> Clock {
        Clock { total: self.began.elapsed(), evaluation: self.evaluation, ..self.learner.clock() }
    }

    fn out_of_steps(&self) -> Option<Stop> {
        (self.steps() >= self.config.steps).then_some(Stop::Steps)
    }

    /// Returns the seed of an iteration's stream `what`.
    fn seed_of(&self, iteration: u64, what: u64) -> u64 {
        let mut rng = Rng::seed_from_u64(self.config.seed);
        rng.set_stream(4 * iteration + what);
        rng.next_u64()
    }

    /// Runs one iteration, and the evaluation that is due after it.
    ///
    /// # Errors
    /// [`TrainError::Diverged`], and the environments' errors.
    pub fn advance(&mut self) -> Result<&Point, TrainError> {
        // on a thread of the pool, which distributes work without a change of threads
        rayon::scope(|_| self.iterate())?;
        Ok(&self.curve[self.curve.len() - 1])
    }

    fn iterate(&mut self) -> Result<(), TrainError> {
        if self.is_checkpoint() || self.fresh {
            // a resumed run starts here, too
            self.fresh = false;
            if !self.learner.has_scales() {
                let seeds = [2, 3].map(|what| self.seed_of(self.iteration, what));
                self.learner.estimate_scales(seeds)?;
            }
            let seed = self.seed_of(self.iteration, 0);
            self.learner.restart(seed)?;
        }
        let seed = self.seed_of(self.iteration, 1);
        let report = self.learner.iterate(seed)?;
        self.iteration += 1;
        self.stop = self.out_of_steps();
        let due = self.iteration.is_multiple_of(self.config.evaluate_every) || self.stop.is_some();
        let score = if due { Some(self.evaluate()?) } else { None };
        let rate = self.learner.learning_rate();
        self.curve.push(Point { iteration: self.iteration, steps: self.steps(), report, score, rate });
        Ok(())
    }

    /// Returns true if the next iteration resets all environments, so that a run resumed from here is
    /// bit-identical.
    pub fn is_checkpoint(&self) -> bool {
        self.iteration.is_multiple_of(self.config.checkpoint_every)
    }

    fn evaluate(&mut self) -> Result<Score, TrainError> {
        let began = Instant::now();
        let policy = self.policy()?;
        // a quarter of the episodes shows whether a policy succeeds at all
        let first = self.config.episodes.div_ceil(4);
        let mut episodes = self.arena.fly(|| policy.pilot(), EVALUATION_SEED, first)?;
        if episodes.iter().any(|episode| episode.success) {
            let others = self.config.episodes - first;
            episodes.extend(self.arena.fly(|| policy.pilot(), EVALUATION_SEED + first as u64, others)?);
        }
        let score = Score::of(&episodes);
        let better = self.best.1.is_none_or(|best| score.beats(&best));
        let mut confirmed = false;
        if score.success == 1.0 && self.config.until_success {
            // a policy may pass one evaluation by chance
            let episodes = self.config.episodes;
            let mut seeds = (0..4).map(|part| CONFIRMATION_SEED + part * episodes as u64);
            confirmed = seeds.try_fold(true, |confirmed, seed| -> Result<_, TrainError> {
                let passed = |flown: Vec<Episode>| flown.iter().all(|episode| episode.success);
                Ok(confirmed && passed(self.arena.fly(|| policy.pilot(), seed, episodes)?))
            })?;
        }
        if better || confirmed {
            self.best = (policy, Some(score));
        }
        if confirmed {
            self.stop = Some(Stop::Success);
        }
        self.evaluation += began.elapsed();
        Ok(score)
    }

    /// Runs episodes with the best policy.
    ///
    /// # Errors
    /// The environments' errors.
    pub fn fly(&mut self, first_seed: u64, episodes: usize) -> Result<Vec<Episode>, TrainError> {
        self.arena.fly(|| self.best.0.pilot(), first_seed, episodes)
    }

    /// Returns the content of a checkpoint file. If [`is_checkpoint`](Self::is_checkpoint) returns true, a run
    /// resumed from it is bit-identical to an uninterrupted run; otherwise the resumed run resets its environments
    /// at another iteration.
    ///
    /// # Errors
    /// [`TrainError::Policy`] if serialization fails, and the errors of a device.
    pub fn checkpoint(&self) -> Result<Vec<u8>, TrainError> {
        let learner = self.learner.state()?;
        let (first, second) = (learner.first_moments, learner.second_moments);
        let moments = Moments { time: learner.optimizer_steps, first, second };
        let state = State {
            config: self.config.clone(),
            command: self.command.clone(),
            iteration: self.iteration,
            time: moments.time,
            rate: learner.learning_rate,
            observations: learner.observations,
            rewards: RewardScale::of(learner.rewards),
            best: self.best.1,
        };
        let (parameters, curve, best) = (learner.parameters, self.curve.clone(), self.best.0.to_bytes()?);
        Checkpoint { state, parameters, moments, curve, best }.to_bytes()
    }
}

/// Creates the learner of the CPU for a configuration, with initial parameters.
///
/// # Errors
/// Errors of the creation of the environments. [`TrainError::Option`] for a configuration of another device.
pub fn on_the_cpu(config: &TrainConfig) -> Result<Box<dyn Learner>, TrainError> {
    if config.device != TrainDevice::Cpu {
        let got = config.device.to_string();
        return Err(TrainError::Option { option: "device", got, expected: "cpu, or a learner of another device" });
    }
    Ok(Box::new(CpuLearner::new(config, config.agents()?)?))
}

fn policy_of(
    config: &TrainConfig,
    command: &str,
    learner: &dyn Learner,
    steps: u64,
) -> Result<PolicyNetwork, TrainError> {
    // the recorded configuration contains no path of this machine
    let training = TrainConfig { drone: config.airframe_name(), ..config.clone() }.to_toml()?;
    let info = PolicyInfo {
        version: if config.ppo.recurrent > 0 { PolicyInfo::RECURRENT_VERSION } else { PolicyInfo::VERSION },
        task: config.task.clone(),
        drone: config.airframe_name(),
        num_drones: config.drones(),
        per_drone: config.per_drone,
        action_type: config.action_type.to_string(),
        sim_freq: config.sim_freq,
        ctrl_freq: config.ctrl_freq,
        seed: config.seed,
        steps,
        command: command.into(),
        made_by: concat!("mujoco-drones-gym ", env!("CARGO_PKG_VERSION")).into(),
        training: Some(training),
    };
    let (shape, state) = (learner.shape(), learner.state()?);
    let (actor, ..) = shape.split(&state.parameters);
    let actor = Mlp::new(&shape.actor, shape.activation, actor)?;
    let (observations, actions) = (learner.observation_space().clone(), learner.action_space().clone());
    let policy = match shape.recurrent {
        0 => PolicyNetwork::new(info, actor, observations, actions)?,
        units => {
            let recurrent = Gru::new(shape.observation(), units, shape.recurrent_part(&state.parameters))?;
            PolicyNetwork::new_recurrent(info, recurrent, actor, observations, actions)?
        }
    };
    let (mean, deviation) = state.normalization();
    Ok(policy.normalized(mean, deviation)?)
}

#[cfg(test)]
mod tests {
    use aviary::env::{BoxSpace, EnvError};

    use rand::RngExt as _;

    use super::*;
    use crate::agents::Outcome;
    use crate::evaluation::Success;
    use crate::ppo::Ppo;

    /// Agents that observe 1000 ± 50, independently of their actions.
    struct Far {
        observations: BoxSpace,
        actions: BoxSpace,
        rng: Rng,
    }

    impl Far {
        fn observe(&mut self, out: &mut [f32]) {
            out.fill_with(|| 1000.0 + 50.0 * self.rng.sample::<f32, _>(rand_distr::StandardNormal));
        }
    }

    impl Agents for Far {
        fn rows(&self) -> usize {
            64
        }

        fn observation_space(&self) -> &BoxSpace {
            &self.observations
        }

        fn action_space(&self) -> &BoxSpace {
            &self.actions
        }

        fn longest(&self, _: usize) -> u64 {
            100
        }

        fn reset(&mut self, seed: u64, observations: &mut [f32]) -> Result<(), EnvError> {
            self.rng = Rng::seed_from_u64(seed);
            self.observe(observations);
            Ok(())
        }

        fn step(&mut self, _: &[f32], outcome: &mut Outcome) -> Result<(), EnvError> {
            outcome.rewards.fill(1.0);
            self.observe(&mut outcome.observations);
            Ok(())
        }

        fn restart(&mut self, _: &mut [bool], _: &mut [f32]) -> Result<(), EnvError> {
            Ok(())
        }
    }

    #[test]
    fn evaluations_without_success_end_after_a_quarter_of_the_episodes() {
        for (within, episodes) in [(1e-3, 2), (50.0, 8)] {
            let mut config = TrainConfig::of_task("hover").unwrap();
            (config.ppo.environments, config.ppo.horizon) = (8, 4);
            (config.evaluate_every, config.episodes, config.episode_seconds) = (1, 8, Some(0.1));
            config.success = Success::Near { seconds: 0.1, within };
            let mut trainer = Trainer::new(config, "a test").unwrap();
            trainer.advance().unwrap();
            let flown = trainer.fly(EVALUATION_SEED, episodes).unwrap();
            assert_eq!(trainer.best_score(), Some(Score::of(&flown)));
        }
    }

    #[test]
    fn the_first_iteration_trains_on_normalized_observations() {
        let mut config = TrainConfig::of_task("hover").unwrap();
        config.ppo.horizon = 16;
        let space = |size| BoxSpace::new(vec![[f64::NEG_INFINITY, f64::INFINITY]; size]);
        let mut agents = Far { observations: space(3), actions: space(2), rng: Rng::seed_from_u64(0) };
        let mut ppo = Ppo::new(config.ppo, config.width, &agents, 0).unwrap();
        ppo.estimate_scales(&mut agents, [1, 2]).unwrap();
        ppo.restart(&mut agents, 3).unwrap();
        ppo.iterate(&mut agents, 4).unwrap();
        let inputs = ppo.inputs();
        assert_eq!(inputs.len(), 16 * 64 * 3);
        let count = inputs.len() as f32;
        let mean = inputs.iter().sum::<f32>() / count;
        let variance = inputs.iter().map(|x| (x - mean).powi(2)).sum::<f32>() / count;
        // unscaled, all observations would be clipped to 10
        assert!(mean.abs() < 0.1 && (variance - 1.0).abs() < 0.2, "{mean} {variance}");
    }
}
