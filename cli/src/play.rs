//! Flights of trained policies: success rate, rewards and errors.

use std::ops::Range;
use std::path::PathBuf;

use anyhow::anyhow;
use aviary::UnknownName;
use aviary::drone::DroneModel;
use aviary::env::{DroneEnv, Env as _};
use aviary::physics::Physics;
use aviary::policy::PolicyError;
use aviary::tasks::TaskSummary;
use clap::{Args, ValueHint};
use learn::{Arena, Episode, Score, TrackChoice, TrainConfig, TrainError};
use serde_json::json;

use crate::animation::AnimationOptions;
use crate::benchmark::warn_of_faults;
use crate::failure::Failure;
use crate::options::{ConditionOptions, check_track_task, in_options};
use crate::output;
use crate::parse::{self, NameOrFile, Shard};
use crate::policy_file::{OnnxFlags, PolicyFile};
use crate::{threads, window};

/// Fly a trained policy and print its success rate
///
/// Episodes start within ±0.2 m, ±0.1 rad and ±0.5 m/s of the task's start, or within the ranges
/// of --config; the starts of antipodal are fixed. Task, airframe, number of drones, action type
/// and rates are those of the training, unless options or --config change them. The default has
/// no wind and no obstacles; --as-trained restores the conditions of the training. Animations
/// show the first episode.
///
/// An ONNX file of another trainer flies too. Its graph maps rows of observations to rows of
/// actions. What its metadata does not say are options: --task, --drone, and those of ONNX files.
#[derive(Debug, Args)]
#[command(verbatim_doc_comment)]
#[command(after_help = "Examples:
  aviary play --policy assets/policies/hover.safetensors --episodes 20
  aviary play --policy assets/policies/race.safetensors --episodes 1 --gif out/race.gif --overlay trails
  aviary play --policy out/hover/policy.safetensors --as-trained
  aviary play --policy assets/policies/hover.safetensors --episodes 1 --view
  aviary play --policy assets/policies/hover_randomized.safetensors --config assets/policies/hover_randomized.toml
  aviary play --policy assets/policies/hover.safetensors --wind combined --physics mjc_gnd_drag_dw --json
  aviary play --policy hover.onnx --task hover --action-range unit

--config also reads a configuration file of `aviary train`: it uses the sections and the keys of the
environments (drone, physics, num_drones, sim_freq, ctrl_freq, episode_seconds, success) and ignores
the keys of the trainer.")]
pub struct Play {
    /// Policy file of `aviary train`, or an ONNX file (.onnx)
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    policy: PathBuf,
    /// Number of episodes
    #[arg(long, value_name = "N", default_value_t = 20, allow_negative_numbers = true)]
    episodes: usize,
    /// Task to fly [default: the policy's]
    #[arg(long, value_name = "NAME", value_parser = parse::task(), hide_possible_values = true)]
    task: Option<TaskSummary>,
    /// Airframe: cf2x, cf2p, race, cf21 or a TOML file [default: the policy's]
    #[arg(long, value_name = "NAME", value_parser = parse::airframe(), hide_possible_values = true)]
    drone: Option<NameOrFile<DroneModel>>,
    /// Track of race: figure_eight, stacked, oval or a TOML file
    ///
    /// The default is the track of the training. A policy whose observation has no normals of
    /// gates flies every track without them.
    #[arg(
        long,
        verbatim_doc_comment,
        value_name = "NAME",
        value_parser = parse::track(),
        hide_possible_values = true
    )]
    track: Option<NameOrFile<&'static str>>,
    /// Physics, wind, obstacles and randomization of the training
    ///
    /// The policy file has these conditions.
    #[arg(long, conflicts_with_all = ["task", "physics", "wind", "obstacles", "config"])]
    as_trained: bool,
    /// Physics mode: mjc, mjc_gnd, mjc_drag, mjc_dw, mjc_gnd_drag_dw, dyn
    ///
    /// A physics mode is the name of an engine and its aerodynamic effects in the paper. The
    /// default is the mode of --config, or mjc.
    #[arg(
        long,
        verbatim_doc_comment,
        value_name = "NAME",
        value_parser = parse::named::<Physics>(),
        hide_possible_values = true
    )]
    physics: Option<Physics>,
    /// Number of drones [default: the policy's]
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    num_drones: Option<usize>,
    #[command(flatten)]
    conditions: ConditionOptions,
    /// Length of an episode, s [default: the task's]
    #[arg(long, value_name = "S", allow_negative_numbers = true)]
    duration: Option<f64>,
    /// Seed of the first episode
    ///
    /// Each further episode has the next seed. The seed of the obstacles is the key `seed` in
    /// [obstacles] of --config; its default is 0.
    #[arg(long, verbatim_doc_comment, value_name = "N", default_value_t = 0, allow_negative_numbers = true)]
    seed: u64,
    /// Part of the episodes that this run flies, from 1/N to N/N [default: all]
    ///
    /// The episodes of all parts are together bit-identical to those of one run.
    #[arg(long, value_name = "I/N")]
    shard: Option<Shard>,
    #[command(flatten)]
    animation: AnimationOptions,
    /// Window in which the policy flies after the evaluation
    ///
    /// The window shows the first episode in real time. Panels and keys change the flight, N
    /// starts the next seed, H lists the keys. The command ends when the window is closed.
    #[arg(long, verbatim_doc_comment)]
    view: bool,
    /// JSON output instead of a table
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    onnx: OnnxFlags,
}

impl Play {
    pub fn run(&self) -> Result<(), Failure> {
        self.animation.validate()?;
        if self.episodes == 0 {
            return Err(Failure::input(anyhow!("--episodes is 0, expected at least 1")));
        }
        let own = self.own_episodes();
        if own.is_empty() {
            let shard = self.shard.unwrap_or(Shard::WHOLE);
            let message = anyhow!("--shard is {shard} of {} episodes, expected a part with episodes", self.episodes);
            return Err(Failure::input(message));
        }
        let task = self.task.as_ref().map(|task| task.name);
        let drone = self.drone.as_ref().map(ToString::to_string);
        let policy = PolicyFile::load(&self.policy, &self.onnx, task, drone)?;
        let config = self.config(&policy)?;
        if self.view {
            // an evaluation may take long, and opens its window at the end
            viewer::check_display().map_err(Failure::work)?;
        }
        threads::start()?;
        let mut arena = Arena::new(config.success, || config.environment()).map_err(Failure::input)?;
        let bar = output::progress(own.end - own.start, "flying");
        let mut flown = Vec::new();
        // in small groups, for the progress bar
        for first in own.clone().step_by(64) {
            let count = (own.end - first).min(64) as usize;
            flown.extend(
                policy.fly(&mut arena, self.seed.wrapping_add(first), count).map_err(|error| self.flying(error))?,
            );
            bar.set_position(flown.len() as u64);
        }
        bar.finish_and_clear();
        warn_of_faults(flown.iter().filter(|episode| episode.has_fault()).count());
        self.draw(&policy, &config)?;
        if self.json {
            output::print_json(&self.report(&config, &flown))?;
        } else {
            output::print(&table(&config, &flown))?;
        }
        let succeeded = flown.iter().filter(|episode| episode.success).count();
        if !self.json && 2 * succeeded < flown.len() && self.could_fly_as_trained(&policy, &config) {
            tracing::warn!("most episodes failed; --as-trained restores the conditions of the training");
        }
        if self.view {
            window::fly(&config, policy.pilot(), policy.steps(), self.seed.wrapping_add(own.start))?;
        }
        Ok(())
    }

    /// Returns true if --as-trained is possible and changes the conditions.
    fn could_fly_as_trained(&self, policy: &PolicyFile, config: &TrainConfig) -> bool {
        let Self { as_trained, task, physics, conditions, .. } = self;
        let is_possible = !as_trained && task.is_none() && physics.is_none() && conditions.is_default();
        is_possible
            && training_of(policy).is_ok_and(|trained| {
                trained.is_some_and(|trained| {
                    (&trained.conditions, trained.physics) != (&config.conditions, config.physics)
                })
            })
    }

    /// Returns the failure of a training configuration in the policy file.
    fn in_training(&self, error: TrainError) -> Failure {
        Failure::input(anyhow!("{}: its training: {error}", self.policy.display()))
    }

    /// Returns the failure of a flight: of the input if the policy does not fit the task, otherwise of the work.
    fn flying(&self, error: TrainError) -> Failure {
        match error {
            // the sizes fill a line
            TrainError::Policy(PolicyError::Mismatch { .. }) => Failure::input(error),
            TrainError::Policy(_) => Failure::input(anyhow!("{}: {error}", self.policy.display())),
            _ => Failure::work(error),
        }
    }

    /// Returns the indices of the episodes that this run flies.
    fn own_episodes(&self) -> Range<u64> {
        self.shard.unwrap_or(Shard::WHOLE).range(self.episodes as u64)
    }

    /// Returns the configuration of the episodes: task, airframe and rates of the policy, and the conditions of the
    /// options, the file or the training.
    fn config(&self, policy: &PolicyFile) -> Result<TrainConfig, Failure> {
        let info = policy.info();
        let mut config =
            TrainConfig::of_task(self.task.as_ref().map_or(&info.task, |task| task.name)).map_err(Failure::input)?;
        config.drone = info.drone.clone();
        config.num_drones = (info.task == config.task).then_some(info.num_drones);
        config.per_drone = info.per_drone;
        config.action_type = info
            .action_type
            .parse()
            .map_err(|error: UnknownName| Failure::input(anyhow!("{}: {error}", self.policy.display())))?;
        (config.sim_freq, config.ctrl_freq) = (info.sim_freq, info.ctrl_freq);
        if self.as_trained {
            let Some(text) = &info.training else {
                return Err(Failure::input(anyhow!(
                    "{}: version {} has no training conditions, expected --config in place of --as-trained",
                    self.policy.display(),
                    info.version
                )));
            };
            config.read_toml(text).map_err(|error| self.in_training(error))?;
        } else {
            // --seed is the seed of the episodes; the layout of the obstacles stays that of the training
            let given = self.conditions.read_with(|path, choice| {
                config.read_file_with(path, choice).map_err(Failure::input)?;
                Ok(config.conditions.clone())
            })?;
            // the configuration has the randomization already, merged with the task's starts
            (config.conditions.wind, config.conditions.obstacles) = (given.wind, given.obstacles);
        }
        if let Some(track) = &self.track {
            check_track_task(&config.task)?;
            config.track = Some(TrackChoice::NameOrFile(track.to_string()));
        } else if config.task == "race" && config.track.is_none() {
            let training = training_of(policy).map_err(|error| self.in_training(error))?;
            config.track = training.and_then(|training| training.track);
        }
        let blocks = if policy.info().per_drone { 1 } else { config.num_drones.unwrap_or(1).max(1) };
        let inputs = policy.inputs().map(|inputs| inputs / blocks);
        config.normals =
            [(21, false), (27, true)].into_iter().find(|(size, _)| Some(*size) == inputs).map(|(_, has)| has);
        config.drone = self.drone.as_ref().map_or(config.drone, ToString::to_string);
        config.physics = self.physics.unwrap_or(config.physics);
        config.num_drones = self.num_drones.or(config.num_drones);
        config.episode_seconds = self.duration.or(config.episode_seconds);
        let is_given = |option: &str| match option {
            "--duration" => self.duration.is_some(),
            _ => self.num_drones.is_some(),
        };
        let env = config.environment().map_err(|error| match error {
            TrainError::Env(error) => in_options(error, is_given),
            _ => Failure::input(error),
        })?;
        let seconds = env.episode_steps() as f64 / f64::from(config.ctrl_freq);
        config.success = config.success.within(seconds);
        Ok(config)
    }

    /// Renders the animations of the first episode, if any option is set.
    fn draw(&self, policy: &PolicyFile, config: &TrainConfig) -> Result<(), Failure> {
        if self.animation.files().is_empty() {
            return Ok(());
        }
        let mut env = config.environment().map_err(Failure::input)?;
        let seed = self.seed.wrapping_add(self.own_episodes().start);
        env.reset(Some(seed)).map_err(Failure::work)?;
        let mut kept = Vec::new();
        if self.animation.wants_preview(env.simulation()) {
            // the first flight only positions the camera
            kept = env.extent();
            let mut note =
                |env: &dyn DroneEnv| kept.extend(env.simulation().states().iter().map(|state| state.position));
            learn::fly(&mut *env, &mut policy.pilot(), config.success, seed, &mut note)
                .map_err(|error| self.flying(error))?;
            env.reset(Some(seed)).map_err(Failure::work)?;
        }
        let mut animation = self.animation.begin(env.simulation(), &kept, |_| None)?;
        let mut result = Ok(());
        let mut look = |env: &dyn DroneEnv| {
            // `finish` adds the last frame
            if let (Some(animation), Ok(()), None) = (&mut animation, &result, env.info().end) {
                result = animation.look(env.simulation(), |drone| env.reference(drone));
            }
        };
        learn::fly(&mut *env, &mut policy.pilot(), config.success, seed, &mut look)
            .map_err(|error| self.flying(error))?;
        result?;
        match animation {
            Some(animation) => animation.finish(env.simulation(), |drone| env.reference(drone)),
            None => Ok(()),
        }
    }

    fn report(&self, config: &TrainConfig, flown: &[Episode]) -> serde_json::Value {
        let score = Score::of(flown);
        json!({
            "task": config.task,
            "drone_model": config.drone,
            "num_drones": config.num_drones,
            "track": config.track,
            "action_type": config.action_type,
            "sim_freq": config.sim_freq,
            "ctrl_freq": config.ctrl_freq,
            "physics": config.physics,
            "conditions": config.conditions,
            "seed": self.seed,
            "shard": self.shard.map(|shard| shard.to_string()),
            "policy": self.policy.to_string_lossy(),
            "onnx_options": self.onnx.report(),
            "criterion": config.success.to_string(),
            "success_rate": score.success,
            "succeeded": flown.iter().filter(|episode| episode.success).count(),
            "mean_reward": score.reward,
            "mean_progress": score.progress,
            "episodes": flown,
            "files": self.animation.files().iter().map(|path| path.to_string_lossy()).collect::<Vec<_>>(),
        })
    }
}

/// Returns the configuration of the training of a policy, if its file has it.
fn training_of(policy: &PolicyFile) -> Result<Option<TrainConfig>, TrainError> {
    let Some(text) = &policy.info().training else { return Ok(None) };
    let mut config = TrainConfig::of_task(&policy.info().task)?;
    config.read_toml(text)?;
    Ok(Some(config))
}

fn table(config: &TrainConfig, flown: &[Episode]) -> String {
    let mut text = format!(
        "{:>7} {:>8} {:>10} {:>9} {:>9} {:>17} {:>15}  {}\n",
        "seed", "success", "reward", "time (s)", "progress", "final error (cm)", "late error (cm)", "end"
    );
    for episode in flown {
        text += &format!(
            "{:>7} {:>8} {:>10.1} {:>9.2} {:>8.0}% {:>17.1} {:>15.1}  {}\n",
            episode.seed,
            if episode.success { "yes" } else { "no" },
            episode.reward,
            episode.seconds,
            100.0 * episode.progress,
            100.0 * episode.final_position_error,
            100.0 * episode.late_position_error,
            episode.end,
        );
    }
    let score = Score::of(flown);
    let succeeded = flown.iter().filter(|episode| episode.success).count();
    text + &format!(
        "{} of {} episodes of {} succeeded ({}), mean reward {:.1}\n",
        succeeded,
        flown.len(),
        config.task,
        config.success,
        score.reward
    )
}

#[cfg(test)]
mod tests {
    use aviary::policy::PolicyNetwork;
    use clap::Parser;
    use learn::Trainer;

    use super::*;

    #[derive(Debug, Parser)]
    struct Line {
        #[command(flatten)]
        play: Play,
    }

    #[test]
    fn the_file_of_a_training_gives_the_obstacles_of_the_training() {
        let directory = tempfile::tempdir().unwrap();
        let file = directory.path().join("forest.toml");
        let obstacles = |config: &TrainConfig| config.environment().unwrap().simulation().obstacles().to_vec();
        let fly = |policy: &PolicyNetwork, more: &[&str]| {
            let policy = &PolicyFile::Network(policy.clone());
            let line = [&["play", "--policy", "a.safetensors", "--seed", "5000"][..], more].concat();
            obstacles(&Line::try_parse_from(line).unwrap().play.config(policy).unwrap())
        };
        let mut layouts = Vec::new();
        for seed in ["", "seed = 7\n"] {
            std::fs::write(&file, format!("[obstacles]\nkind = \"forest\"\n{seed}[ppo]\nenvironments = 2\n")).unwrap();
            let mut config = TrainConfig::of_task("hover").unwrap();
            config.seed = 3;
            config.read_file(&file).unwrap();
            let trained = obstacles(&config);
            let trainer = Trainer::new(config, "a test").unwrap();
            assert_eq!(fly(trainer.best(), &["--as-trained"]), trained, "{seed}");
            assert_eq!(fly(trainer.best(), &["--config", file.to_str().unwrap()]), trained, "{seed}");
            if seed.is_empty() {
                assert_eq!(fly(trainer.best(), &["--obstacles", "forest"]), trained);
            }
            layouts.push(trained);
        }
        assert_ne!(layouts[0], layouts[1]);
    }
}
