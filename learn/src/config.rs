//! Configuration of a training run.

use std::path::Path;

use aviary::action::ActionType;
use aviary::drone::{DroneModel, DroneParams};
use aviary::engine::EngineKind;
use aviary::engine::flight::Width;
use aviary::env::{ConditionChoice, Conditions, EnvConfig, EnvError, InitialRanges, Randomization};
use aviary::multi_agent::make_parallel;
use aviary::physics::Physics;
use aviary::physics::wind::WindConfig;
use aviary::policy::{Gru, Mlp};
use aviary::tasks::{self, Course, FlyThrough, Race, RaceTrack};
use aviary::vector::{Autoreset, OnFault, VecConfig, make_vec, make_vec_course};
use aviary::world::ObstacleConfig;
use aviary::{NamedEnum, SystemError, UnknownName};
use serde::{Deserialize, Serialize};

use crate::TrainError;
use crate::agents::{Agents, Batch, Swarm, Terms};
use crate::evaluation::{AnyEnv, Success};
use crate::ppo::{PartialPpo, PpoConfig};
use crate::recipe;

/// Device that simulates the environments of training and computes the gradients.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TrainDevice {
    /// CPU, with all tasks and options.
    #[default]
    Cpu,
    /// GPU, with the learner of the crate `aviary-gpu`.
    Gpu,
}

impl TrainDevice {
    /// Returns true for the CPU.
    fn is_cpu(&self) -> bool {
        *self == Self::Cpu
    }
}

impl std::fmt::Display for TrainDevice {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.pad(Self::NAMES[*self as usize])
    }
}

impl std::str::FromStr for TrainDevice {
    type Err = UnknownName;

    fn from_str(name: &str) -> Result<Self, UnknownName> {
        let found = [Self::Cpu, Self::Gpu].into_iter().find(|device| device.to_string() == name);
        found.ok_or_else(|| UnknownName { noun: Self::NOUN, name: name.into(), names: Self::NAMES })
    }
}

impl NamedEnum for TrainDevice {
    const NOUN: &'static str = "device";
    const NAMES: &'static [&'static str] = &["cpu", "gpu"];
}

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

/// Track of a race.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum TrackChoice {
    /// Name of a built-in track, or path of a TOML file.
    NameOrFile(String),
    /// The track itself, as policy files record the track of a TOML file.
    Track(Box<RaceTrack>),
}

impl TrackChoice {
    /// Returns the track.
    ///
    /// # Errors
    /// An unknown name, or the errors of the file.
    pub fn track(&self) -> Result<RaceTrack, EnvError> {
        match self {
            Self::NameOrFile(name) => RaceTrack::find(name),
            Self::Track(track) => Ok((**track).clone()),
        }
    }

    /// Returns the choice without the path of a file: its track instead.
    ///
    /// # Errors
    /// As for [`track`](Self::track).
    pub(crate) fn without_path(&self) -> Result<Self, EnvError> {
        match self {
            Self::NameOrFile(name) if !RaceTrack::NAMES.contains(&name.as_str()) => {
                Ok(Self::Track(Box::new(RaceTrack::find(name)?)))
            }
            choice => Ok(choice.clone()),
        }
    }
}

/// Initial states and length of some training episodes.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TrainingStart {
    /// Largest change of each position coordinate, m.
    pub position: f64,
    /// Largest change of roll, pitch and yaw, rad.
    pub attitude: f64,
    /// Largest change of each velocity component, m/s.
    pub velocity: f64,
    /// Offset of the centre of these ranges from the task's initial position, world frame, m.
    pub offset: [f64; 3],
    /// Maximum length of these episodes, s; `None` for the task's default.
    pub seconds: Option<f64>,
    /// True if the other groups of the randomization apply as well; false for nominal parameters and perfect sensors.
    #[serde(skip_serializing_if = "is_true")]
    pub randomized: bool,
}

/// Returns true for true.
fn is_true(value: &bool) -> bool {
    *value
}

impl Default for TrainingStart {
    fn default() -> Self {
        let InitialRanges { position, attitude, velocity, offset } = InitialRanges::default();
        Self { position, attitude, velocity, offset, seconds: None, randomized: true }
    }
}

impl TrainingStart {
    /// Returns the ranges of the initial states.
    pub fn ranges(&self) -> InitialRanges {
        let Self { position, attitude, velocity, offset, .. } = *self;
        InitialRanges { position, attitude, velocity, offset }
    }
}

/// Rewards of a course; see [`FlyThrough`] and [`Race`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CourseRewards {
    /// Reward for a waypoint or gate.
    pub point: f64,
    /// Penalty per control step and metre of distance to the next waypoint or gate.
    pub distance: f64,
    /// Reward per control step and m/s of speed; used by race only.
    pub speed: f64,
}

/// Settings of a configuration file.
#[derive(Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct PartialConfig {
    drone: Option<String>,
    track: Option<TrackChoice>,
    physics: Option<Physics>,
    num_drones: Option<usize>,
    per_drone: Option<bool>,
    action_type: Option<ActionType>,
    sim_freq: Option<u32>,
    ctrl_freq: Option<u32>,
    episode_seconds: Option<f64>,
    steps: Option<u64>,
    evaluate_every: Option<u64>,
    episodes: Option<usize>,
    checkpoint_every: Option<u64>,
    success: Option<Success>,
    training_starts: Option<Vec<TrainingStart>>,
    out_of_bounds: Option<f32>,
    course: Option<CourseRewards>,
    ppo: PartialPpo,
    // parsed only for line and column of errors: `Conditions` reads these sections again
    wind: Option<WindConfig>,
    obstacles: Option<ObstacleConfig>,
    randomization: Option<Randomization>,
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

    /// Overrides settings with those of a configuration in TOML.
    ///
    /// # Errors
    /// [`TrainError::Toml`] with line and column; [`TrainError::Env`] for invalid wind, obstacles or randomization.
    pub fn read_toml(&mut self, text: &str) -> Result<(), TrainError> {
        self.read_toml_with(text, &ConditionChoice::default())
    }

    /// Overrides settings with those of a configuration in TOML, with the kinds of wind and obstacles chosen
    /// elsewhere.
    ///
    /// # Errors
    /// As for [`read_toml`](Self::read_toml), and if the file has another kind than the chosen one.
    pub fn read_toml_with(&mut self, text: &str, choice: &ConditionChoice) -> Result<(), TrainError> {
        let file: PartialConfig =
            toml::from_str(text).map_err(|error| TrainError::Toml { message: aviary::toml_message(text, &error) })?;
        let mut table: toml::Table = text.parse().map_err(wrong)?;
        let conditions = toml::to_string(&take_conditions(&mut table)).map_err(wrong)?;
        let conditions = Conditions::from_toml_with(&conditions, choice)?;
        macro_rules! take {
            ($($field:ident)*) => {$(
                if let Some(value) = file.$field {
                    self.$field = value;
                }
            )*};
        }
        take!(
            drone physics per_drone action_type sim_freq ctrl_freq steps evaluate_every episodes checkpoint_every
            success out_of_bounds
        );
        self.training_starts = file.training_starts.unwrap_or(std::mem::take(&mut self.training_starts));
        self.num_drones = file.num_drones.or(self.num_drones);
        self.track = file.track.or(self.track.take());
        self.course = file.course.or(self.course);
        self.episode_seconds = file.episode_seconds.or(self.episode_seconds);
        file.ppo.apply(&mut self.ppo);
        self.conditions.wind = conditions.wind.or(self.conditions.wind);
        self.conditions.obstacles = conditions.obstacles.or(self.conditions.obstacles.take());
        if let Some(randomization) = conditions.randomization {
            self.randomize(randomization);
        }
        self.conditions.validate()?;
        Ok(())
    }

    /// Sets the randomization of every episode; keeps the previous initial states if it sets none.
    pub fn randomize(&mut self, mut randomization: Randomization) {
        let start = self.conditions.randomization.take().and_then(|before| before.initial);
        randomization.initial = randomization.initial.or(start);
        self.conditions.randomization = Some(randomization);
    }

    /// Returns the configuration as TOML.
    ///
    /// # Errors
    /// [`TrainError::Toml`] for values that TOML cannot represent.
    pub fn to_toml(&self) -> Result<String, TrainError> {
        let mut table = toml::Table::try_from(self).map_err(wrong)?;
        // these are options of the command line
        for key in ["task", "seed", "device", "until_success"] {
            table.remove(key);
        }
        if let Some(toml::Value::Table(conditions)) = table.remove("conditions") {
            table.extend(conditions);
        }
        toml::to_string_pretty(&table).map_err(wrong)
    }

    /// Overrides settings with those of a configuration file.
    ///
    /// # Errors
    /// [`TrainError::File`] with the path and the error of [`read_toml`](Self::read_toml).
    pub fn read_file(&mut self, path: impl AsRef<Path>) -> Result<(), TrainError> {
        self.read_file_with(path, &ConditionChoice::default())
    }

    /// Overrides settings with those of a configuration file, with the kinds of wind and obstacles chosen
    /// elsewhere.
    ///
    /// # Errors
    /// [`TrainError::File`] with the path and the error of [`read_toml_with`](Self::read_toml_with).
    pub fn read_file_with(&mut self, path: impl AsRef<Path>, choice: &ConditionChoice) -> Result<(), TrainError> {
        let path = path.as_ref();
        let in_file = |error| TrainError::File { path: path.into(), error: Box::new(error) };
        let text = std::fs::read_to_string(path).map_err(|error| in_file(SystemError::from(error).into()))?;
        self.read_toml_with(&text, choice).map_err(in_file)
    }

    /// Validates all settings.
    ///
    /// # Errors
    /// [`TrainError::Option`] with the first invalid setting.
    pub fn validate(&self) -> Result<(), TrainError> {
        let PpoConfig {
            environments,
            horizon,
            epochs,
            minibatch,
            learning_rate,
            target_kl,
            gamma,
            gae_lambda,
            clip_range,
            value_coef,
            entropy_coef,
            max_grad_norm,
            initial_std,
            ..
        } = &self.ppo;
        // TOML has no larger integers
        let largest = i64::MAX as u64;
        let counts: [(&str, u64, u64); 9] = [
            ("environments", *environments as u64, 1 << 20),
            ("horizon", *horizon as u64, 1 << 16),
            ("epochs", *epochs as u64, 1000),
            ("minibatch", *minibatch as u64, 1 << 24),
            ("evaluate_every", self.evaluate_every, largest),
            ("episodes", self.episodes as u64, 1 << 20),
            ("checkpoint_every", self.checkpoint_every, largest),
            ("steps", self.steps, largest),
            ("ctrl_freq", self.ctrl_freq.into(), largest),
        ];
        for (option, got, max) in counts {
            if !(1..=max).contains(&got) {
                return Err(TrainError::Option {
                    option,
                    got: got.to_string(),
                    expected: "a positive number that fits in memory",
                });
            }
        }
        if environments.saturating_mul(*horizon) > 1 << 26 {
            let got = format!("{environments} × {horizon}");
            return Err(TrainError::Option { option: "environments × horizon", got, expected: "up to 67,108,864" });
        }
        for (option, got, low, high, expected) in [
            ("learning_rate", *learning_rate, 1e-9, 1.0, "1e-9 to 1"),
            ("target_kl", *target_kl, 0.0, 10.0, "0 to 10"),
            ("gamma", *gamma, 0.0, 1.0, "0 to 1"),
            ("gae_lambda", *gae_lambda, 0.0, 1.0, "0 to 1"),
            ("clip_range", *clip_range, 1e-3, 10.0, "0.001 to 10"),
            ("value_coef", *value_coef, 0.0, 1e3, "0 to 1000"),
            ("entropy_coef", *entropy_coef, 0.0, 1e3, "0 to 1000"),
            ("max_grad_norm", *max_grad_norm, 1e-6, 1e9, "a positive number"),
            ("initial_std", *initial_std, 1e-4, 10.0, "0.0001 to 10"),
        ] {
            if !(low..=high).contains(&got) {
                return Err(TrainError::Option { option, got: aviary::number(got), expected });
            }
        }
        for &width in &self.ppo.hidden {
            if !(1..=Mlp::MAX_WIDTH).contains(&width) || self.ppo.hidden.len() >= Mlp::MAX_LAYERS {
                let got = format!("{:?}", self.ppo.hidden);
                return Err(TrainError::Option {
                    option: "hidden",
                    got,
                    expected: "up to 7 layers of 1 to 256 neurons",
                });
            }
        }
        if self.ppo.recurrent > Gru::MAX_WIDTH {
            let got = self.ppo.recurrent.to_string();
            return Err(TrainError::Option { option: "recurrent", got, expected: "0 to 256 units" });
        }
        let positive = |x: f64| x > 0.0 && x <= 1e6;
        if let Some(seconds) = self.training_starts.iter().filter_map(|start| start.seconds).find(|&x| !positive(x)) {
            let got = format!("{} s", aviary::number(seconds));
            return Err(TrainError::Option {
                option: "training_starts.seconds",
                got,
                expected: "a positive number of seconds",
            });
        }
        if !(0.0..=1e6).contains(&self.out_of_bounds) {
            let got = aviary::number(self.out_of_bounds.into());
            return Err(TrainError::Option { option: "out_of_bounds", got, expected: "0 to 1,000,000" });
        }
        if self.course.is_some_and(|rewards| self.per_drone || course_of(&self.task, rewards).is_none()) {
            let got = format!("set for {}", self.task);
            return Err(TrainError::Option {
                option: "course",
                got,
                expected: "fly_through or race, without per_drone",
            });
        }
        let (seconds, within) = match self.success {
            Success::Near { seconds, within } => (seconds, within),
            Success::Held { seconds } => (seconds, 1.0),
            Success::Done => (1.0, 1.0),
        };
        if !(positive(seconds) && within > 0.0) {
            let got = format!("{:?}", self.success);
            return Err(TrainError::Option {
                option: "success",
                got,
                expected: "positive numbers of seconds and metres",
            });
        }
        Ok(())
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

/// Removes the sections that [`Conditions`] reads from a configuration, and returns them.
fn take_conditions(table: &mut toml::Table) -> toml::Table {
    ["wind", "obstacles", "randomization"].iter().filter_map(|section| table.remove_entry(*section)).collect()
}

fn wrong(error: impl ToString) -> TrainError {
    TrainError::Toml { message: error.to_string() }
}

/// Returns the task with a name and with course rewards; `None` if it has no course.
fn course_of(name: &str, rewards: CourseRewards) -> Option<Course> {
    let CourseRewards { point, distance, speed } = rewards;
    match name {
        "fly_through" => {
            let mut task = FlyThrough::default();
            (task.capture_reward, task.distance_penalty) = (point, distance);
            Some(Course::FlyThrough(task))
        }
        "race" => {
            let mut race = Race::default();
            (race.gate_reward, race.speed_reward, race.distance_penalty) = (point, speed, distance);
            Some(Course::Race(race))
        }
        _ => None,
    }
}

#[cfg(test)]
mod tests {
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
