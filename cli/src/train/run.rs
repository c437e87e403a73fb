//! A run of the trainer with its files.

use std::io::{IsTerminal as _, Write as _};
use std::path::Path;
use std::time::Duration;

use anyhow::{Context as _, anyhow};
use aviary::record::plot::{Plot, Series};
use learn::{Clock, Point, Report, Stop, TensorboardWriter, TrainConfig, Trainer};
use serde_json::{Value, json};

use crate::failure::Failure;
use crate::interrupt::{self, Interruption};
use crate::output::{self, OutputDir};
use crate::window::TrainingWindow;

/// Policy file of a run.
const POLICY: &str = "policy.safetensors";
/// Checkpoint file of a run.
pub(super) const CHECKPOINT: &str = "checkpoint.safetensors";
/// Learning curve of a run.
const CURVE: &str = "curve.csv";
/// All files of a run.
const FILES: [&str; 5] = [CHECKPOINT, POLICY, CURVE, "curve.svg", "curve.png"];

/// Refuses a directory with files of an earlier run.
pub(super) fn check_new(directory: &Path) -> Result<(), Failure> {
    let Some(name) = FILES.iter().find(|name| directory.join(name).exists()) else { return Ok(()) };
    let resume = if *name == CHECKPOINT { format!("--resume {} or ", quoted_path(directory)) } else { String::new() };
    Err(Failure::input(anyhow!(
        "{}: it has {name} of an earlier run, expected {resume}another --out",
        directory.display()
    )))
}

/// Prints a line on standard error. A reader that has closed it is not an error.
pub(super) fn say(line: &str) {
    let _ = writeln!(std::io::stderr(), "{line}");
}

/// Returns a path quoted for a shell.
fn quoted_path(path: &Path) -> String {
    quoted(&path.display().to_string())
}

/// Returns a text quoted for a shell.
pub(super) fn quoted(text: &str) -> String {
    let plain = |c: char| c.is_alphanumeric() || "_-./+=:,@%".contains(c);
    if !text.is_empty() && text.chars().all(plain) { text.into() } else { format!("'{}'", text.replace('\'', "'\\''")) }
}

/// Additions to a run.
#[derive(Clone, Copy)]
pub(super) struct Extras<'a> {
    /// A window.
    pub(super) view: bool,
    /// An event file for TensorBoard.
    pub(super) tensorboard: bool,
    /// GPU of the training, as chosen.
    pub(super) adapter: Option<&'a str>,
}

/// A run with its files.
pub(super) struct Run {
    pub(super) trainer: Trainer,
    out: OutputDir,
    /// Iteration of the checkpoint in the directory.
    saved: u64,
    window: Option<TrainingWindow>,
    events: Option<TensorboardWriter>,
    /// GPU of the training, as chosen.
    adapter: Option<String>,
}

impl Run {
    /// Starts a run in a directory without one.
    pub(super) fn begin(trainer: Trainer, out: &Path, extras: Extras<'_>) -> Result<Self, Failure> {
        let out = OutputDir::create(out)?;
        check_new(out.path())?;
        // a window that cannot be opened leaves no files that refuse the next run
        let window = extras.view.then(|| TrainingWindow::open(&trainer)).transpose()?;
        let mut run = Self { trainer, out, saved: 0, window, events: None, adapter: extras.adapter.map(Into::into) };
        run.begin_events(extras)?;
        run.save_policy()?;
        run.save_checkpoint()?;
        Ok(run)
    }

    /// Continues the run of a directory.
    pub(super) fn resume(
        trainer: Trainer,
        directory: &Path,
        locked: Option<OutputDir>,
        extras: Extras<'_>,
    ) -> Result<Self, Failure> {
        let Some(out) = locked.filter(|_| trainer.stop().is_none()) else {
            let steps = trainer.steps();
            return Err(Failure::input(anyhow!(
                "{}: the run has made {steps} steps already, expected more in --steps",
                directory.display()
            )));
        };
        let window = extras.view.then(|| TrainingWindow::open(&trainer)).transpose()?;
        let mut run = Self { trainer, out, saved: 0, window, events: None, adapter: extras.adapter.map(Into::into) };
        run.begin_events(extras)?;
        // the checkpoint has the number of steps, which may have changed
        run.save_checkpoint()?;
        Ok(run)
    }

    /// Creates the event file, if the run has one, with the iterations so far.
    fn begin_events(&mut self, extras: Extras<'_>) -> Result<(), Failure> {
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
    pub(super) fn note_rounded_steps(&self) {
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
    pub(super) fn finish(mut self, quiet: bool) -> Result<Self, Failure> {
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
        let (name, resume) = (signal_hook::low_level::signal_name(signal).unwrap_or("a signal"), self.resume_options());
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

    /// Returns the options that continue the run.
    fn resume_options(&self) -> String {
        let directory = quoted_path(self.out.path());
        match &self.adapter {
            Some(adapter) => format!("{directory} --adapter {}", quoted(adapter)),
            None => directory,
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

    pub(super) fn json(&self) -> Value {
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

    pub(super) fn table(&self) -> String {
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

    pub(super) fn verdict(&self) -> Result<(), Failure> {
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
