//! Training of policies: learning curve, checkpoints and the best policy.

mod run;

use std::path::{Path, PathBuf};

use anyhow::anyhow;
use aviary::engine::flight::Width;
use aviary::tasks::{self, TaskSummary};
use clap::{ArgGroup, Args, ValueHint};
use learn::{Learner, Point, TrackChoice, TrainConfig, TrainDevice, Trainer};
use serde_json::json;

#[cfg(feature = "gpu")]
use self::run::say;
use self::run::{CHECKPOINT, Extras, Run, check_new, quoted};
use crate::failure::Failure;
use crate::options::check_track_task;
use crate::output::{self, OutputDir};
use crate::parse::{self, NameOrFile};
use crate::threads;

/// Train a policy with PPO
///
/// The output directory has policy.safetensors (the best policy so far), checkpoint.safetensors
/// (for --resume), curve.csv, curve.svg and curve.png. The command refuses a directory with an
/// earlier run.
///
/// Ctrl-C (SIGINT), SIGTERM and SIGHUP end the run after the current iteration and print the
/// command that continues it; a second signal ends it at once. The exit status is 128 plus the
/// number of the signal (130, 143, 129), and 1 if --until-success is not reached.
///
/// Each evaluation prints a line on standard error unless that is a terminal or --json is set.
#[derive(Debug, Args)]
#[command(verbatim_doc_comment)]
#[command(group(ArgGroup::new("what").required(true).args(["task", "all", "resume"])))]
#[command(after_help = "Examples:
  aviary train --task hover --until-success --out out/hover
  aviary train --task race --seed 3 --config race.toml --out out/race
  aviary train --resume out/race --steps 60000000
  aviary train --task race --start-from out/race --config harder.toml --out out/harder
  aviary train --task hover --out out/watched --view
  aviary train --task hover --tensorboard --out out/logged
  aviary train --task hover --device gpu --envs 16384 --out out/gpu
  aviary train --all --steps 100000 --out out/all

`aviary train --task hover --show` prints the defaults of a task as a configuration file.")]
pub struct Train {
    /// Task to train; `aviary tasks` lists them
    #[arg(long, value_name = "NAME", value_parser = parse::task(), hide_possible_values = true)]
    task: Option<TaskSummary>,
    /// Short run of every task, as a test of the installation
    ///
    /// The defaults are 100,000 steps in 256 environments per task.
    #[arg(long, conflicts_with_all = ["config", "until_success"])]
    all: bool,
    /// Directory of an earlier run to continue
    ///
    /// The resumed run is bit-identical to an uninterrupted run.
    #[arg(
        long,
        value_name = "DIR",
        value_hint = ValueHint::DirPath,
        conflicts_with_all = ["config", "seed", "envs", "out"]
    )]
    resume: Option<PathBuf>,
    /// Track of race: figure_eight, stacked, oval or a TOML file
    ///
    /// The key `track` of --config has the same values.
    #[arg(
        long,
        value_name = "NAME",
        value_parser = parse::track(),
        hide_possible_values = true,
        conflicts_with_all = ["all", "resume"]
    )]
    track: Option<NameOrFile<&'static str>>,
    /// Directory of an earlier run whose networks this run starts with
    ///
    /// The networks of its last checkpoint replace random ones, for example to continue with
    /// other conditions, rewards or settings. Observations, actions and layers must be the same.
    /// Optimizer and curve are new. --resume continues a run unchanged.
    #[arg(
        long,
        verbatim_doc_comment,
        value_name = "DIR",
        value_hint = ValueHint::DirPath,
        conflicts_with_all = ["all", "resume", "show"]
    )]
    start_from: Option<PathBuf>,
    /// TOML file with changes to the task's defaults
    ///
    /// Keys: steps, drone, physics, …; sections: [ppo], [wind], [obstacles], [randomization].
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    config: Option<PathBuf>,
    /// Seed of all random numbers [default: 0]
    ///
    /// Equal seeds give equal policies on one machine.
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    seed: Option<u64>,
    /// Number of environment steps [default: the task's]
    ///
    /// The run rounds the number up to whole iterations of all environments.
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    steps: Option<u64>,
    /// End of the run as soon as every episode succeeds
    ///
    /// The run ends as soon as every episode of an evaluation and of a second evaluation with
    /// four times as many episodes succeeds.
    #[arg(long, verbatim_doc_comment)]
    until_success: bool,
    /// Number of parallel environments [default: the task's]
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    envs: Option<usize>,
    /// Device of the training: cpu, gpu [default: cpu]
    ///
    /// On a GPU, the environments, the networks and the optimizer are in its memory. It has
    /// fewer tasks and options; evaluations and the policy file are the same. The option needs a
    /// program that was built with `--features gpu`. A resumed run stays on its device.
    #[arg(
        long,
        verbatim_doc_comment,
        value_name = "DEVICE",
        value_parser = parse::named::<TrainDevice>(),
        hide_possible_values = true,
        conflicts_with_all = ["all", "resume"]
    )]
    device: Option<TrainDevice>,
    /// GPU of the training: a number or a part of a name [default: 0]
    ///
    /// `aviary doctor` lists the GPUs with their numbers.
    #[arg(long, value_name = "GPU")]
    adapter: Option<String>,
    /// Output directory [default: out/train/TASK]
    #[arg(long, value_name = "DIR", value_hint = ValueHint::DirPath)]
    out: Option<PathBuf>,
    /// Configuration as TOML on standard output, without training
    #[arg(long, conflicts_with_all = ["resume", "all"])]
    show: bool,
    /// Widest instruction set: portable, avx2, avx512; default the machine's
    #[arg(long, value_name = "SET", value_parser = crate::bench::instructions, conflicts_with = "resume")]
    instructions: Option<Width>,
    /// Window in which the current policy flies during the training
    ///
    /// The window's threads have the lowest priority. The results are bit-identical to those
    /// without a window. The training goes on without the window when it is closed.
    #[arg(long, verbatim_doc_comment, conflicts_with_all = ["all", "show"])]
    view: bool,
    /// Event file for TensorBoard in the output directory
    ///
    /// The file has the numbers of curve.csv, at every iteration; `tensorboard --logdir DIR`
    /// shows them during the run. A resumed run writes the file again, from its beginning. The
    /// events have the time of the day, so that the file differs between equal runs.
    #[arg(long, verbatim_doc_comment, conflicts_with = "show")]
    tensorboard: bool,
    /// JSON output instead of a table
    ///
    /// With --json, standard error has neither notes nor evaluations.
    #[arg(long)]
    json: bool,
}

/// Steps and environments per task of --all.
const TRIAL: (u64, usize) = (100_000, 256);

impl Train {
    pub fn run(&self) -> Result<(), Failure> {
        if self.all {
            return self.every_task();
        }
        let run = match &self.resume {
            Some(directory) => self.resume(directory)?,
            None => {
                let task = self.task.as_ref().map_or("", |task| task.name);
                let config = self.config(task)?;
                if self.show {
                    return output::print(&shown(&config)?);
                }
                let out = self.out.clone().unwrap_or_else(|| Path::new("out/train").join(task));
                let learner = self.learner(&config)?;
                let mut trainer =
                    Trainer::with_learner(config, &self.command(task), learner).map_err(Failure::input)?;
                if let Some(directory) = &self.start_from {
                    trainer.start_from(directory.join(CHECKPOINT)).map_err(Failure::input)?;
                }
                Run::begin(trainer, &out, self.extras())?
            }
        };
        if self.steps.is_some() && !self.json {
            run.note_rounded_steps();
        }
        let run = run.finish(self.json)?;
        if self.json {
            output::print_json(&run.json())?;
        } else {
            output::print(&run.table())?;
        }
        run.verdict()
    }

    /// Returns the command that trains the same policy, without directories.
    fn command(&self, task: &str) -> String {
        let mut command = format!("aviary train --task {task}");
        for (option, path) in [("start-from", &self.start_from), ("config", &self.config)] {
            if let Some(path) = path {
                let name = path.file_name().unwrap_or(path.as_os_str());
                command += &format!(" --{option} {}", name.to_string_lossy());
            }
        }
        if let Some(track) = &self.track {
            let name = track.to_string();
            let file = Path::new(&name).file_name().map_or(name.clone(), |name| name.to_string_lossy().into_owned());
            command += &format!(" --track {file}");
        }
        let (steps, envs) = (self.trial(self.steps, TRIAL.0), self.trial(self.envs, TRIAL.1));
        let numbers = [("seed", self.seed), ("steps", steps), ("envs", envs.map(|envs| envs as u64))];
        for (option, number) in numbers {
            if let Some(number) = number {
                command += &format!(" --{option} {number}");
            }
        }
        if self.device == Some(TrainDevice::Gpu) {
            command += " --device gpu";
        }
        if let Some(adapter) = &self.adapter {
            command += &format!(" --adapter {}", quoted(adapter));
        }
        if self.until_success {
            command += " --until-success";
        }
        command
    }

    /// Creates the learner of the device of a configuration.
    fn learner(&self, config: &TrainConfig) -> Result<Box<dyn Learner>, Failure> {
        threads::start()?;
        match config.device {
            TrainDevice::Gpu => on_a_gpu(config, self.adapter.as_deref(), self.json),
            TrainDevice::Cpu if self.adapter.is_some() => {
                Err(Failure::input(anyhow!("--adapter is set for a training on the cpu, expected --device gpu")))
            }
            TrainDevice::Cpu => learn::on_the_cpu(config).map_err(Failure::input),
        }
    }

    /// Continues the run of a directory.
    fn resume(&self, directory: &Path) -> Result<Run, Failure> {
        let path = directory.join(CHECKPOINT);
        // only an existing directory is locked: the lock creates a missing one
        let locked = path.exists().then(|| OutputDir::create(directory)).transpose()?;
        let mut trainer = Trainer::resume_with(&path, |config| self.learner(config))?;
        trainer.extend(self.steps, self.until_success).map_err(Failure::input)?;
        Run::resume(trainer, directory, locked, self.extras())
    }

    fn extras(&self) -> Extras<'_> {
        Extras { view: self.view, tensorboard: self.tensorboard, adapter: self.adapter.as_deref() }
    }

    /// Returns the value of an option, or the value of --all if that is set.
    fn trial<T>(&self, given: Option<T>, trial: T) -> Option<T> {
        given.or(self.all.then_some(trial))
    }

    fn config(&self, task: &str) -> Result<TrainConfig, Failure> {
        let mut config = TrainConfig::of_task(task).map_err(Failure::input)?;
        if let Some(path) = &self.config {
            config.read_file(path).map_err(Failure::input)?;
        }
        if let Some(track) = &self.track {
            check_track_task(task)?;
            config.track = Some(TrackChoice::NameOrFile(track.to_string()));
        }
        config.seed = self.seed.unwrap_or(config.seed);
        config.device = self.device.unwrap_or(config.device);
        config.steps = self.trial(self.steps, TRIAL.0).unwrap_or(config.steps);
        config.ppo.environments = self.trial(self.envs, TRIAL.1).unwrap_or(config.ppo.environments);
        config.until_success = self.until_success;
        config.width = self.instructions.unwrap_or(config.width);
        config.validate().map_err(Failure::input)?;
        Ok(config)
    }

    fn every_task(&self) -> Result<(), Failure> {
        let out = self.out.clone().unwrap_or_else(|| "out/train".into());
        for task in tasks::NAMES {
            check_new(&out.join(task))?;
        }
        threads::start()?;
        let (mut rows, mut list) = (Vec::new(), Vec::new());
        for task in tasks::NAMES {
            let mut config = self.config(task)?;
            config.episodes = config.episodes.min(8);
            let trainer = Trainer::new(config, &self.command(task)).map_err(Failure::input)?;
            let run =
                Run::begin(trainer, &out.join(task), Extras { view: false, ..self.extras() })?.finish(self.json)?;
            let curve = run.trainer.curve();
            let reward = |point: Option<&Point>| point.map_or(f64::NAN, |point| point.report.mean_reward);
            rows.push((
                task,
                format!(
                    "{} steps in {:.1} s, mean reward {:.2} before, {:.2} after",
                    run.trainer.steps(),
                    run.trainer.clock().total.as_secs_f64(),
                    reward(curve.first()),
                    reward(curve.last()),
                ),
            ));
            list.push(run.json());
        }
        if self.json { output::print_json(&json!(list)) } else { output::print(&output::table(&rows)) }
    }
}

/// Creates the learner of a GPU, and prints on standard error which one it is unless `quiet`.
#[cfg(feature = "gpu")]
fn on_a_gpu(config: &TrainConfig, adapter: Option<&str>, quiet: bool) -> Result<Box<dyn Learner>, Failure> {
    use aviary_gpu::{AdapterKind, GpuDevice, GpuPpo};

    let device = GpuDevice::open(adapter)?;
    if !quiet {
        let adapter = device.adapter();
        let slow = if adapter.kind == AdapterKind::Cpu { ": slower than --device cpu" } else { "" };
        say(&format!("note: training on {adapter}{slow}"));
    }
    Ok(Box::new(GpuPpo::new(config, &device)?))
}

/// Returns the error of a program that was built without the feature `gpu`.
#[cfg(not(feature = "gpu"))]
fn on_a_gpu(_: &TrainConfig, _: Option<&str>, _: bool) -> Result<Box<dyn Learner>, Failure> {
    let fix = "cargo run --release -p cli --features gpu -- train …";
    Err(Failure::input(anyhow!("this program was built without training on a GPU; fix: {fix}")))
}

/// Returns a configuration as `--show` prints it: with the option `recurrent`, which recorded configurations of
/// policies without memory do not have.
fn shown(config: &TrainConfig) -> Result<String, Failure> {
    let mut table: toml::Table = config.to_toml().map_err(Failure::input)?.parse().map_err(Failure::work)?;
    if let Some(toml::Value::Table(ppo)) = table.get_mut("ppo") {
        ppo.entry("recurrent").or_insert(toml::Value::Integer(0));
    }
    toml::to_string_pretty(&table).map_err(Failure::work)
}
