//! Configuration of a training run.

mod course;
mod device;
mod file;
mod starts;
mod track;
mod validate;

use std::path::Path;

use aviary::action::ActionType;
use aviary::drone::{DroneModel, DroneParams};
use aviary::engine::EngineKind;
use aviary::engine::flight::Width;
use aviary::env::{Conditions, EnvConfig, EnvError, Randomization};
use aviary::multi_agent::make_parallel;
use aviary::physics::Physics;
use aviary::tasks::{self, Course};
use aviary::vector::{Autoreset, OnFault, VecConfig, make_vec, make_vec_course};
use serde::{Deserialize, Serialize};

pub use self::course::CourseRewards;
use self::course::course_of;
pub use self::device::TrainDevice;
use self::file::{take_conditions, wrong};
pub use self::starts::TrainingStart;
pub use self::track::TrackChoice;
use crate::TrainError;
use crate::agents::{Agents, Batch, Swarm, Terms};
use crate::evaluation::{AnyEnv, Success};
use crate::ppo::PpoConfig;
use crate::recipe;

/// Configuration of a training run. Equal configurations give bit-identical policies with the same program and
/// machine.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainConfig {
    /// Name of the task.
    pub task: String,
    /// Seed of all random streams.
    pub seed: u64,
    /// Device of the training. Evaluations run on the CPU.
    #[serde(default, skip_serializing_if = "TrainDevice::is_cpu")]
    pub device: TrainDevice,
    /// Airframe: the name of a built-in one, or the path of a TOML file.
    pub drone: String,
    /// Track of race; `None` for the task's gates.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub track: Option<TrackChoice>,
    /// True if observations of a track include the normals of gates, not recorded; `None` for the track's.
    #[serde(skip)]
    pub normals: Option<bool>,
    /// Physics mode.
    pub physics: Physics,
    /// Number of drones; `None` for the task's default.
    pub num_drones: Option<usize>,
    /// True if every drone is an agent, with a shared policy.
    pub per_drone: bool,
    /// Action type.
    pub action_type: ActionType,
    /// Physics rate, Hz.
    pub sim_freq: u32,
    /// Control rate, Hz.
    pub ctrl_freq: u32,
    /// Length of an episode, s; `None` for the task's default.
    pub episode_seconds: Option<f64>,
    /// Number of environment steps after which the run stops.
    pub steps: u64,
    /// True if the run stops as soon as all episodes of an evaluation succeed, and all of a second one of four
    /// times the size.
    pub until_success: bool,
    /// Iterations between two evaluations.
    pub evaluate_every: u64,
    /// Episodes of an evaluation. If none of the first quarter succeeds, the evaluation consists of this quarter.
    pub episodes: usize,
    /// Iterations between two checkpoints, where all environments are reset.
    pub checkpoint_every: u64,
    /// Success criterion.
    pub success: Success,
    /// Initial states of training episodes that differ from those of evaluations, assigned to the environments
    /// cyclically.
    pub training_starts: Vec<TrainingStart>,
    /// Additional penalty for leaving the task's bounds in training. Without it, early policies learn to leave.
    pub out_of_bounds: f32,
    /// Rewards of fly_through and race in training; `None` for the task's. The paper's speed reward is maximized by
    /// flying away from the course. A policy never passes a waypoint if staying close to it costs less than the
    /// flight to the next one.
    pub course: Option<CourseRewards>,
    /// Wind, obstacles and randomization of every episode, in training and evaluation.
    pub conditions: Conditions,
    /// Settings of PPO.
    pub ppo: PpoConfig,
    /// Instruction set of simulation and gradients, not recorded; default the widest of the machine. The results of
    /// AVX2 and AVX-512 are bit-identical. The baseline rounds gradients differently.
    #[serde(skip, default = "Width::best")]
    pub width: Width,
}

impl TrainConfig {
    /// Returns the recipe of a task: its default configuration for training.
    ///
    /// # Errors
    /// [`TrainError::Env`] for an unknown task.
    pub fn of_task(name: &str) -> Result<Self, TrainError> {
        let summary = tasks::summary(name).map_err(EnvError::from)?;
        let mut table = recipe::of_task(summary.name)?;
        let conditions = Conditions::from_toml(&toml::to_string(&take_conditions(&mut table)).map_err(wrong)?)?;
        table.insert("task".into(), name.into());
        table.insert("seed".into(), 0.into());
        table.insert("until_success".into(), false.into());
        table.insert("conditions".into(), toml::Value::try_from(&conditions).map_err(wrong)?);
        table.try_into().map_err(wrong)
    }

    /// Sets the randomization of every episode; keeps the previous initial states if it sets none.
    pub fn randomize(&mut self, mut randomization: Randomization) {
        let start = self.conditions.randomization.take().and_then(|before| before.initial);
        randomization.initial = randomization.initial.or(start);
        self.conditions.randomization = Some(randomization);
    }

    /// Returns the options of the environments.
    ///
    /// # Errors
    /// An unknown airframe, or an airframe file that cannot be read.
    pub fn options(&self) -> Result<EnvConfig, TrainError> {
        let mut options = EnvConfig::default();
        if !self.physics.is_explicit() {
            options = options.engine(EngineKind::Hybrid);
        }
        options = options
            .drone(self.airframe()?)
            .physics(self.physics)
            .action_type(self.action_type)
            .sim_freq(self.sim_freq)
            .ctrl_freq(self.ctrl_freq)
            .conditions(&self.conditions);
        if let Some(count) = self.num_drones {
            options = options.num_drones(count);
        }
        if let Some(seconds) = self.episode_seconds {
            options = options.episode_seconds(seconds);
        }
        if let Some(choice) = &self.track {
            let mut track = choice.track()?;
            track.normals = self.normals.or(track.normals);
            options = options.task(|task| task.track = Some(track));
        }
        Ok(options)
    }

    fn airframe(&self) -> Result<DroneParams, TrainError> {
        if Path::new(&self.drone).extension().is_some_and(|ending| ending == "toml") {
            return Ok(DroneParams::from_file(&self.drone)?);
        }
        Ok(self.drone.parse::<DroneModel>().map_err(EnvError::from)?.params())
    }

    /// Returns the number of drones; 1 for a custom task without a setting.
    pub(crate) fn drones(&self) -> usize {
        let of_task = tasks::summary(&self.task).map(|summary| summary.defaults.num_drones);
        self.num_drones.or(of_task.ok()).unwrap_or(1)
    }

    /// Returns the name of the airframe; for an airframe file, the name in it.
    pub(crate) fn airframe_name(&self) -> String {
        self.airframe().map_or_else(|_| self.drone.clone(), |params| params.name)
    }

    /// Returns the differences of the environments of training from those of evaluation.
    pub fn terms(&self) -> Terms {
        let period = 1.0 / f64::from(self.ctrl_freq.max(1));
        let steps = |start: &TrainingStart| start.seconds.map(|seconds| (seconds / period).round() as u64);
        Terms { out_of_bounds: self.out_of_bounds, lengths: self.training_starts.iter().map(steps).collect() }
    }

    /// Returns the task of training if it has other rewards than the task.
    pub fn course(&self) -> Option<Course> {
        self.course.and_then(|rewards| course_of(&self.task, rewards))
    }

    /// Returns the randomizations of the training episodes, assigned to the environments cyclically; empty if they are
    /// those of the evaluations.
    fn randomizations_of_training(&self) -> Vec<Randomization> {
        let of = |start: &TrainingStart| {
            let all = self.conditions.randomization.clone().filter(|_| start.randomized);
            Randomization { initial: Some(start.ranges()), ..all.unwrap_or(Randomization::NONE) }
        };
        self.training_starts.iter().map(of).collect()
    }

    /// Creates the agents that collect experience.
    ///
    /// # Errors
    /// Errors of the creation of the environments.
    pub fn agents(&self) -> Result<Box<dyn Agents>, TrainError> {
        let options = self.options()?;
        let starts = self.randomizations_of_training();
        let options = match starts.first() {
            Some(first) => options.randomization(first.clone()),
            None => options,
        };
        let terms = self.terms();
        let environments = self.ppo.environments;
        if !self.per_drone {
            let config = VecConfig {
                autoreset: Autoreset::SameStep,
                on_fault: OnFault::Truncate,
                width: self.width,
                ..VecConfig::new(environments)
            };
            let mut env = match self.course() {
                Some(course) => make_vec_course(course, options, config)?,
                None => make_vec(&self.task, options, config)?,
            };
            for (environment, start) in (0..environments).zip(starts.iter().cycle()) {
                let mut done = Ok(());
                env.with_env(environment, &mut |env| done = env.set_randomization(Some(start.clone())))?;
                done?;
            }
            return Ok(Box::new(Batch::new(env, terms)?));
        }
        let make = |stream| {
            let options = options.clone().stream(stream);
            let start = starts.iter().cycle().nth(stream as usize % starts.len().max(1));
            make_parallel(
                &self.task,
                start.iter().fold(options, |options, &start| options.randomization(start.clone())),
            )
        };
        Ok(Box::new(Swarm::new(environments, terms, make)?))
    }

    /// Creates an environment for evaluation.
    ///
    /// # Errors
    /// Errors of the creation of the environment.
    pub fn environment(&self) -> Result<AnyEnv, TrainError> {
        Ok(tasks::make(&self.task, self.options()?)?)
    }
}

#[cfg(test)]
mod tests {
    use aviary::env::InitialRanges;

    use super::*;

    #[test]
    fn training_episodes_have_their_own_starts_and_may_be_nominal() {
        let mut config = TrainConfig::of_task("hover").unwrap();
        let text =
            "training_starts = [{ position = 0.5 }, { position = 0.7, randomized = false }]\n[randomization.body]\n";
        config.read_toml(text).unwrap();
        let [sampled, nominal] = &config.randomizations_of_training()[..] else { panic!("{config:?}") };
        assert!(sampled.body.is_some() && sampled.initial.unwrap().position == 0.5);
        let initial = InitialRanges { position: 0.7, ..InitialRanges::default() };
        assert_eq!(*nominal, Randomization { initial: Some(initial), ..Randomization::NONE });
        let written = config.to_toml().unwrap();
        assert_eq!(written.matches("randomized").count(), 1, "{written}");
        let mut again = TrainConfig::of_task("hover").unwrap();
        again.read_toml(&written).unwrap();
        assert_eq!(again, config);
        config.training_starts.clear();
        assert!(config.randomizations_of_training().is_empty());
    }
}
