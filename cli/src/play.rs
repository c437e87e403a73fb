//! Trained policies flown: how often they succeed, and how well.

use std::path::PathBuf;

use anyhow::anyhow;
use aviary::UnknownName;
use aviary::drone::DroneModel;
use aviary::env::{DroneEnv, Env as _};
use aviary::physics::Physics;
use aviary::policy::PolicyNetwork;
use aviary::tasks::TaskSummary;
use clap::{Args, ValueHint};
use learn::{Arena, Episode, Score, TrainConfig, TrainError};
use serde_json::json;

use crate::failure::Failure;
use crate::film::FilmOptions;
use crate::options::{ConditionOptions, in_options};
use crate::output;
use crate::parse::{self, NameOrFile};

/// Fly a trained policy and report how well
///
/// Episodes start within ±0.2 m, ±0.1 rad and ±0.5 m/s of the task's start (antipodal's at it) unless a configuration file says
/// otherwise. Task, airframe, number of drones, actions and rates are those that the policy was trained with, unless options or the
/// file change them. Physics is mjc in still air without obstacles by default; --as-trained flies what the policy was trained under.
/// Pictures show the first episode.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  aviary play --policy assets/policies/hover.safetensors --episodes 20
  aviary play --policy assets/policies/race.safetensors --episodes 1 --gif out/race.gif --overlay trails
  aviary play --policy out/hover/policy.safetensors --as-trained
  aviary play --policy assets/policies/hover_randomized.safetensors --config assets/policies/hover_randomized.toml
  aviary play --policy assets/policies/hover.safetensors --wind combined --physics mjc_gnd_drag_dw --json

The file of --config may be the one that `aviary train` was given: its options of the environments (drone, physics, num_drones,
sim_freq, ctrl_freq, episode_seconds, success) and its sections count, those of the trainer do not.")]
pub struct Play {
    /// Policy to fly: a file that `aviary train` wrote
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    policy: PathBuf,
    /// Episodes to fly
    #[arg(long, default_value_t = 20, allow_negative_numbers = true)]
    episodes: usize,
    /// Task to fly; the policy's by default
    #[arg(long, value_parser = parse::task(), hide_possible_values = true)]
    task: Option<TaskSummary>,
    /// Airframe: cf2x, cf2p, race, or a TOML file with one of your own; the policy's by default
    #[arg(long, value_parser = parse::airframe(), hide_possible_values = true)]
    drone: Option<NameOrFile<DroneModel>>,
    /// Fly under the physics, wind, obstacles and randomization of the training, which the policy's file has
    #[arg(long, conflicts_with_all = ["task", "physics", "wind", "obstacles", "config"])]
    as_trained: bool,
    /// Physics mode: mjc, mjc_gnd, mjc_drag, mjc_dw, mjc_gnd_drag_dw, dyn; mjc by default
    #[arg(long, value_parser = parse::named::<Physics>(), hide_possible_values = true)]
    physics: Option<Physics>,
    /// Number of drones; the policy's by default
    #[arg(long, allow_negative_numbers = true)]
    num_drones: Option<usize>,
    #[command(flatten)]
    conditions: ConditionOptions,
    /// Simulated seconds of an episode; the task's by default
    #[arg(long, allow_negative_numbers = true)]
    duration: Option<f64>,
    /// Seed of the first episode; the others have the next ones. Obstacles have the seed in [obstacles] of --config, or 0
    #[arg(long, default_value_t = 0, allow_negative_numbers = true)]
    seed: u64,
    #[command(flatten)]
    film: FilmOptions,
    /// Print JSON instead of a table
    #[arg(long)]
    json: bool,
}

impl Play {
    pub fn run(&self) -> Result<(), Failure> {
        self.film.validate()?;
        if self.episodes == 0 {
            return Err(Failure::input(anyhow!("--episodes is 0, expected at least 1")));
        }
        let policy = PolicyNetwork::load(&self.policy).map_err(Failure::input)?;
        let config = self.config(&policy)?;
        let mut arena = Arena::new(config.success, || config.environment()).map_err(Failure::input)?;
        let bar = output::progress(self.episodes as u64, "flying");
        let mut flown = Vec::new();
        // in handfuls, for the bar
        while flown.len() < self.episodes {
            let count = (self.episodes - flown.len()).min(64);
            let seed = self.seed.wrapping_add(flown.len() as u64);
            flown.extend(arena.fly(&policy, seed, count).map_err(flying)?);
            bar.set_position(flown.len() as u64);
        }
        bar.finish_and_clear();
        self.draw(&policy, &config)?;
        if self.json {
            output::print_json(&self.report(&config, &flown))
        } else {
            output::print(&table(&config, &flown))
        }
    }

    /// What is flown: the policy's own task, airframe and rates, under what the options, the file or the policy's training say.
    fn config(&self, policy: &PolicyNetwork) -> Result<TrainConfig, Failure> {
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
                    "{}: a policy of version {} does not say what it was trained under, expected --config with the file of its training \
                     in place of --as-trained",
                    self.policy.display(),
                    info.version
                )));
            };
            let in_file = |error: TrainError| anyhow!("{}: its training: {error}", self.policy.display());
            config.read_toml(text).map_err(in_file).map_err(Failure::input)?;
        } else {
            // without a seed of their own, obstacles keep the layout of the training: --seed is that of the episodes
            let said = self.conditions.read_with(|path, choice| {
                config.read_file_with(path, choice).map_err(Failure::input)?;
                Ok(config.conditions.clone())
            })?;
            // a randomization has been added to the task's starts already
            (config.conditions.wind, config.conditions.obstacles) = (said.wind, said.obstacles);
        }
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

    /// Films the first episode, if that is asked for.
    fn draw(&self, policy: &PolicyNetwork, config: &TrainConfig) -> Result<(), Failure> {
        if self.film.files().is_empty() {
            return Ok(());
        }
        let mut env = config.environment().map_err(Failure::input)?;
        env.reset(Some(self.seed)).map_err(Failure::work)?;
        let mut kept = Vec::new();
        if self.film.wants_preview(env.simulation()) {
            // flown once to know where a camera is to stand
            kept = env.extent();
            let mut note =
                |env: &dyn DroneEnv| kept.extend(env.simulation().states().iter().map(|state| state.position));
            learn::fly(&mut *env, &mut &*policy, config.success, self.seed, &mut note).map_err(flying)?;
            env.reset(Some(self.seed)).map_err(Failure::work)?;
        }
        let mut film = self.film.begin(env.simulation(), &kept, |_| None)?;
        let mut went_wrong = Ok(());
        let mut look = |env: &dyn DroneEnv| {
            // the last moment is added when the film is finished
            if let (Some(film), Ok(()), None) = (&mut film, &went_wrong, env.info().end) {
                went_wrong = film.look(env.simulation(), |drone| env.reference(drone));
            }
        };
        learn::fly(&mut *env, &mut &*policy, config.success, self.seed, &mut look).map_err(flying)?;
        went_wrong?;
        match film {
            Some(film) => film.finish(env.simulation(), |drone| env.reference(drone)),
            None => Ok(()),
        }
    }

    fn report(&self, config: &TrainConfig, flown: &[Episode]) -> serde_json::Value {
        let score = Score::of(flown);
        json!({
            "task": config.task,
            "drone_model": config.drone,
            "physics": config.physics,
            "seed": self.seed,
            "policy": self.policy.to_string_lossy(),
            "criterion": config.success.to_string(),
            "success_rate": score.success,
            "succeeded": flown.iter().filter(|episode| episode.success).count(),
            "mean_reward": score.reward,
            "mean_progress": score.progress,
            "episodes": flown,
            "files": self.film.files().iter().map(|path| path.to_string_lossy()).collect::<Vec<_>>(),
        })
    }
}

/// A policy that does not fit is the fault of who asked, everything else the work's.
fn flying(error: TrainError) -> Failure {
    match error {
        TrainError::Policy(_) => Failure::input(error),
        _ => Failure::work(error),
    }
}

fn table(config: &TrainConfig, flown: &[Episode]) -> String {
    let mut text = format!(
        "{:>7} {:>8} {:>10} {:>9} {:>9} {:>17} {:>22}  {}\n",
        "seed", "success", "reward", "time (s)", "progress", "final error (cm)", "worst of last 5 s (cm)", "end"
    );
    for episode in flown {
        text += &format!(
            "{:>7} {:>8} {:>10.1} {:>9.2} {:>8.0}% {:>17.1} {:>22.1}  {}\n",
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
