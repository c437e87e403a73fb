//! Training of policies: learning curve, checkpoints and the best policy.

use std::io::{IsTerminal as _, Write as _};
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context as _, anyhow};
use aviary::engine::flight::Width;
use aviary::record::plot::{Plot, Series};
use aviary::tasks::{self, TaskSummary};
use clap::{ArgGroup, Args, ValueHint};
use learn::{Clock, Learner, Point, Report, Stop, TensorboardWriter, TrackChoice, TrainConfig, TrainDevice, Trainer};
use serde_json::{Value, json};

use crate::failure::Failure;
use crate::interrupt::{self, Interruption};
use crate::options::check_track_task;
use crate::output::{self, OutputDir};
use crate::parse::{self, NameOrFile};
use crate::window::TrainingWindow;

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
    /// The networks of its last checkpoint replace random ones: to continue with other conditions,
    /// rewards or settings. Observations, actions and layers must be the same. The optimizer and
    /// the curve start anew. --resume continues a run unchanged.
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
    /// `aviary doctor` lists the GPUs, from number 0 on.
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

/// Policy file of a run.
const POLICY: &str = "policy.safetensors";
/// Checkpoint file of a run.
const CHECKPOINT: &str = "checkpoint.safetensors";
/// Learning curve of a run.
const CURVE: &str = "curve.csv";
/// All files of a run.
const FILES: [&str; 5] = [CHECKPOINT, POLICY, CURVE, "curve.svg", "curve.png"];

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
        if self.until_success {
            command += " --until-success";
        }
        command
    }

    /// Creates the learner of the device of a configuration.
    fn learner(&self, config: &TrainConfig) -> Result<Box<dyn Learner>, Failure> {
        match config.device {
            TrainDevice::Gpu => on_a_gpu(config, self.adapter.as_deref()),
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

    fn extras(&self) -> Extras {
        Extras { view: self.view, tensorboard: self.tensorboard }
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

/// Creates the learner of a GPU.
#[cfg(feature = "gpu")]
fn on_a_gpu(config: &TrainConfig, adapter: Option<&str>) -> Result<Box<dyn Learner>, Failure> {
    use aviary_gpu::{GpuDevice, GpuError, GpuPpo};

    let learner =
        GpuDevice::open(adapter).and_then(|device| GpuPpo::new(config, &device)).map_err(|error| match error {
            GpuError::NoAdapter { .. } | GpuError::Open { .. } | GpuError::Device { .. } => Failure::work(error),
            error => Failure::input(error),
        })?;
    Ok(Box::new(learner))
}

/// Returns the error of a program that was built without the feature `gpu`.
#[cfg(not(feature = "gpu"))]
fn on_a_gpu(_: &TrainConfig, _: Option<&str>) -> Result<Box<dyn Learner>, Failure> {
    let fix = "cargo run --release -p cli --features gpu -- train …";
    Err(Failure::input(anyhow!("this program was built without training on a GPU; fix: {fix}")))
}

/// Refuses a directory with files of an earlier run.
fn check_new(directory: &Path) -> Result<(), Failure> {
    let Some(name) = FILES.iter().find(|name| directory.join(name).exists()) else { return Ok(()) };
    let resume = if *name == CHECKPOINT { format!("--resume {} or ", quoted(directory)) } else { String::new() };
    Err(Failure::input(anyhow!(
        "{}: it has {name} of an earlier run, expected {resume}another --out",
        directory.display()
    )))
}

/// Prints a line on standard error. A reader that has closed it is not an error.
fn say(line: &str) {
    let _ = writeln!(std::io::stderr(), "{line}");
}

/// Returns a path quoted for a shell.
fn quoted(path: &Path) -> String {
    let text = path.display().to_string();
    let plain = |c: char| c.is_alphanumeric() || "_-./+=:,@%".contains(c);
    if !text.is_empty() && text.chars().all(plain) { text } else { format!("'{}'", text.replace('\'', "'\\''")) }
}

/// Additions to a run.
#[derive(Clone, Copy)]
struct Extras {
    /// A window.
    view: bool,
    /// An event file for TensorBoard.
    tensorboard: bool,
}

/// A run with its files.
struct Run {
    trainer: Trainer,
    out: OutputDir,
    /// Iteration of the checkpoint in the directory.
    saved: u64,
    window: Option<TrainingWindow>,
    events: Option<TensorboardWriter>,
}

impl Run {
    /// Starts a run in a directory without one.
    fn begin(trainer: Trainer, out: &Path, extras: Extras) -> Result<Self, Failure> {
        let out = OutputDir::create(out)?;
        check_new(out.path())?;
        // a window that cannot be opened leaves no files that refuse the next run
        let window = extras.view.then(|| TrainingWindow::open(&trainer)).transpose()?;
        let mut run = Self { trainer, out, saved: 0, window, events: None };
        run.begin_events(extras)?;
        run.save_policy()?;
        run.save_checkpoint()?;
        Ok(run)
    }

    /// Continues the run of a directory.
    fn resume(trainer: Trainer, directory: &Path, locked: Option<OutputDir>, extras: Extras) -> Result<Self, Failure> {
        let Some(out) = locked.filter(|_| trainer.stop().is_none()) else {
            let steps = trainer.steps();
            return Err(Failure::input(anyhow!(
                "{}: the run has made {steps} steps already, expected more in --steps",
                directory.display()
            )));
        };
        let window = extras.view.then(|| TrainingWindow::open(&trainer)).transpose()?;
        let mut run = Self { trainer, out, saved: 0, window, events: None };
        run.begin_events(extras)?;
        // the checkpoint has the number of steps, which may have changed
        run.save_checkpoint()?;
        Ok(run)
    }

    /// Creates the event file, if the run has one, with the iterations so far.
    fn begin_events(&mut self, extras: Extras) -> Result<(), Failure> {
        if extras.tensorboard {
            let file = self.out.path().join(TensorboardWriter::NAME);
            let begin = || {
                let mut events = TensorboardWriter::create(self.out.path())?;
                self.trainer.curve().iter().try_for_each(|point| events.write(point))?;
                Ok::<_, std::io::Error>(events)
            };
            self.events = Some(begin().with_context(|| file.display().to_string()).map_err(Failure::work)?);
        }
        Ok(())
    }

    /// Prints on standard error that the run rounds the number of steps up.
    fn note_rounded_steps(&self) {
        let (asked, iteration, steps) =
            (self.trainer.config().steps, self.trainer.steps_per_iteration(), self.total_steps());
        if steps != asked {
            say(&format!("note: {asked} steps are rounded up to {steps}, whole iterations of {iteration} steps"));
        }
    }

    /// Returns the steps of the whole run: the steps of the configuration, in whole iterations.
    fn total_steps(&self) -> u64 {
        let iteration = self.trainer.steps_per_iteration();
        self.trainer.config().steps.div_ceil(iteration).saturating_mul(iteration)
    }

    /// Trains to the end of the run. A quiet run prints no evaluations.
    fn finish(mut self, quiet: bool) -> Result<Self, Failure> {
        let total = self.total_steps();
        let bar = output::progress_with(total, "{msg} {wide_bar} {human_pos}/{human_len} {eta}");
        let lines = !quiet && !std::io::stderr().is_terminal();
        interrupt::defer();
        while self.trainer.stop().is_none() {
            if let Some(signal) = interrupt::received() {
                bar.finish_and_clear();
                return Err(self.interrupted(signal));
            }
            let best = self.trainer.best().info().steps;
            let point = self.trainer.advance().map_err(Failure::work)?;
            let evaluated = point.score.is_some();
            if let Some(events) = &mut self.events {
                let written = events.write(point);
                written.with_context(|| events.path().display().to_string()).map_err(Failure::work)?;
            }
            if self.trainer.best().info().steps != best {
                self.save_policy()?;
            }
            if self.trainer.is_checkpoint() {
                self.save_checkpoint()?;
                self.save_curve()?;
            }
            if let Some(window) = &mut self.window {
                window.update(&self.trainer);
            }
            bar.set_position(self.trainer.steps());
            bar.set_message(self.message());
            if evaluated && lines {
                let (task, steps) = (&self.trainer.config().task, self.trainer.steps());
                say(&format!("{task}: {steps} of {total} steps, {}", self.message()));
            }
        }
        bar.finish_and_clear();
        self.save_policy()?;
        self.save_checkpoint()?;
        self.save_curve()?;
        let curve = self.trainer.curve();
        let plot = plot(self.trainer.config(), curve).map_err(Failure::work)?;
        self.out.write("curve.svg", plot.svg().map_err(Failure::work)?.as_bytes())?;
        self.out.write("curve.png", &plot.png().map_err(Failure::work)?)?;
        // the end of the window takes a moment, and the files do not wait for it
        self.window = None;
        Ok(self)
    }

    /// Returns the failure of a run that a signal stopped. The checkpoint stays that of the last restart of the
    /// environments: only a run from there, which repeats the iterations since then, is bit-identical.
    fn interrupted(&self, signal: i32) -> Failure {
        let iterations = self.trainer.curve().len() as u64;
        let (steps, saved) = (self.trainer.steps(), self.saved * self.trainer.steps_per_iteration());
        let repeated = match iterations - self.saved {
            0 => String::new(),
            _ => format!(" and repeats {} steps", steps - saved),
        };
        let (name, resume) =
            (signal_hook::low_level::signal_name(signal).unwrap_or("a signal"), quoted(self.out.path()));
        match self.save_curve() {
            Ok(()) => Failure::work(Interruption {
                signal,
                message: format!(
                    "stopped by {name} after {steps} steps; `aviary train --resume {resume}` continues{repeated}"
                ),
            }),
            Err(failure) => failure,
        }
    }

    /// Returns the message of the progress bar.
    fn message(&self) -> String {
        let curve = self.trainer.curve();
        let (mean_return, score) = latest(curve);
        format!(
            "{:.0} steps/s, return {}, success {}",
            per_second(self.trainer.steps_here(), &self.trainer.clock()),
            mean_return.map_or("–".into(), |mean| format!("{mean:.1}")),
            score.map_or("–".into(), |success| format!("{:.0} %", 100.0 * success)),
        )
    }

    fn save_policy(&self) -> Result<(), Failure> {
        self.out.write(POLICY, &self.trainer.best().to_bytes().map_err(Failure::work)?)
    }

    fn save_checkpoint(&mut self) -> Result<(), Failure> {
        self.out.write(CHECKPOINT, &self.trainer.checkpoint().map_err(Failure::work)?)?;
        self.saved = self.trainer.curve().len() as u64;
        Ok(())
    }

    fn save_curve(&self) -> Result<(), Failure> {
        self.out.write(CURVE, curve(self.trainer.curve()).as_bytes())
    }

    fn json(&self) -> Value {
        let (trainer, clock) = (&self.trainer, self.trainer.clock());
        let shares: serde_json::Map<_, _> =
            shares(&clock).into_iter().map(|(name, share)| (name.to_string(), json!(share))).collect();
        let events = self.events.iter().map(|_| TensorboardWriter::NAME);
        let names = FILES.into_iter().chain(events);
        let files: Vec<_> = names.map(|name| self.out.path().join(name).to_string_lossy().into_owned()).collect();
        json!({
            "task": trainer.config().task,
            "seed": trainer.config().seed,
            "device": trainer.config().device,
            "stop": trainer.stop(),
            "iterations": trainer.curve().len(),
            "steps": trainer.steps(),
            "requested_steps": trainer.config().steps,
            "wall_seconds": clock.total.as_secs_f64(),
            "steps_per_second": per_second(trainer.steps_here(), &clock),
            "time": shares,
            "best": trainer.best_score(),
            "best_steps": trainer.best().info().steps,
            "files": files,
        })
    }

    fn table(&self) -> String {
        let (trainer, clock) = (&self.trainer, self.trainer.clock());
        let shares: Vec<_> =
            shares(&clock).iter().map(|(name, share)| format!("{name} {:.0} %", 100.0 * share)).collect();
        let score = trainer.best_score().map_or("not evaluated".into(), |score| {
            format!(
                "{:.0} % of {} episodes ({}), mean return {:.1}",
                100.0 * score.success,
                trainer.config().episodes,
                trainer.config().success,
                score.reward
            )
        });
        let (made, asked) = (trainer.steps(), trainer.config().steps);
        let steps = if made > asked { format!("{made} ({asked} in whole iterations)") } else { made.to_string() };
        output::table(&[
            ("task", format!("{} with seed {}", trainer.config().task, trainer.config().seed)),
            ("device", trainer.config().device.to_string()),
            ("best policy", score),
            ("environment steps", format!("{steps}, the best policy's {}", trainer.best().info().steps)),
            ("wall time", format!("{:.1} s", clock.total.as_secs_f64())),
            ("environment steps per s", format!("{:.0}", per_second(trainer.steps_here(), &clock))),
            ("breakdown of wall time", shares.join(", ")),
            ("policy", self.out.path().join(POLICY).display().to_string()),
        ])
    }

    fn verdict(&self) -> Result<(), Failure> {
        if self.trainer.config().until_success && self.trainer.stop() != Some(Stop::Success) {
            let score = self.trainer.best_score().map_or(0.0, |score| score.success);
            let steps = self.trainer.steps();
            let best = 100.0 * score;
            return Err(Failure::work(anyhow!("no success within {steps} steps; the best policy had {best:.0} %")));
        }
        Ok(())
    }
}

/// Returns the latest mean return and success rate.
fn latest(curve: &[Point]) -> (Option<f64>, Option<f64>) {
    let mean = curve.iter().rev().find_map(|point| point.report.mean_return);
    let success = curve.iter().rev().find_map(|point| point.score.map(|score| score.success));
    (mean, success)
}

fn per_second(steps: u64, clock: &Clock) -> f64 {
    steps as f64 / clock.total.as_secs_f64().max(1e-9)
}

/// Returns the fractions of the wall time.
fn shares(clock: &Clock) -> [(&'static str, f64); 5] {
    let total = clock.total.as_secs_f64().max(1e-9);
    let known = [clock.simulation, clock.inference, clock.gradient, clock.evaluation];
    let other = clock.total.saturating_sub(known.iter().sum::<Duration>());
    let share = |time: Duration| time.as_secs_f64() / total;
    let [simulation, inference, gradient, evaluation] = known.map(share);
    [
        ("simulation", simulation),
        ("inference", inference),
        ("gradient", gradient),
        ("evaluation", evaluation),
        ("other", share(other)),
    ]
}

/// Returns the learning curve as CSV. No column depends on the speed of the machine.
fn curve(points: &[Point]) -> String {
    let mut text = String::from(
        "iteration,steps,mean_return,mean_reward,success,progress,evaluation_return,approx_kl,clip_fraction,loss,\
         action_std,explained_variance,learning_rate\n",
    );
    let number = |x: Option<f64>| x.map_or(String::new(), |x| x.to_string());
    for point in points {
        let Point { iteration, steps, report, score, rate } = point;
        let Report { mean_return, mean_reward, approx_kl, clip_fraction, loss, action_std, explained_variance } =
            report;
        text += &format!(
            "{iteration},{steps},{},{mean_reward},{},{},{},{approx_kl},{clip_fraction},{loss},{action_std},\
             {explained_variance},{rate}\n",
            number(*mean_return),
            number(score.map(|score| score.success)),
            number(score.map(|score| score.progress)),
            number(score.map(|score| score.reward)),
        );
    }
    text
}

fn plot(config: &TrainConfig, points: &[Point]) -> Result<Plot, aviary::record::RecordError> {
    let series = |name: &str, value: &dyn Fn(&Point) -> Option<f64>| Series {
        name: name.into(),
        points: points.iter().filter_map(|point| Some((point.steps as f64 / 1e6, value(point)?))).collect(),
    };
    let evaluated = |value: fn(&learn::Score) -> f64| move |point: &Point| point.score.as_ref().map(value);
    let panels = [
        (
            "evaluation (%)",
            vec![
                series("success", &evaluated(|score| 100.0 * score.success)),
                series("progress", &evaluated(|score| 100.0 * score.progress)),
            ],
        ),
        (
            "return",
            vec![
                series("evaluation", &evaluated(|score| score.reward)),
                series("training", &|point| point.report.mean_return),
            ],
        ),
        ("standard deviation of actions", vec![series("action_std", &|point| Some(point.report.action_std))]),
    ];
    let title = format!("{}, seed {}", config.task, config.seed);
    Ok(Plot::time_series(&title, &panels)?.over("environment steps (millions)"))
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
