//! Benchmark of policies and controllers: success rates and errors with confidence intervals.

use std::num::NonZeroUsize;
use std::path::PathBuf;
use std::time::Instant;

use anyhow::Context as _;
use aviary::control::ControllerKind;
use aviary::policy::PolicyError;
use clap::{ArgGroup, Args, ValueHint};
use learn::TrainError;
use learn::benchmark::{self, ConditionReport, EPISODES, Pilot, Quantity, Report, Suite, SuiteReport};
use serde_json::{Value, json};

use crate::failure::Failure;
use crate::output::{self, OutputFile};
use crate::parse::{self, SuiteChoice};
use crate::policy_file::{OnnxFlags, PolicyFile};

/// Measure a policy or a controller in fixed tasks and conditions
///
/// Every condition has the same tasks, seeds and numbers for everybody. The report has success
/// rates and errors with 95 % confidence intervals. It is bit-identical for any number of threads,
/// except for the object `timing`. The airframe is cf2x; a policy has the rates and the action
/// type of its training.
#[derive(Debug, Args)]
#[command(verbatim_doc_comment)]
#[command(group(ArgGroup::new("pilot").required(true).args(["policy", "controller"])))]
#[command(after_help = "Examples:
  aviary benchmark --suite hover --controller pid --episodes 10
  aviary benchmark --policy assets/policies/hover.safetensors --suite robust --episodes 10
  aviary benchmark --policy assets/policies/race.safetensors --out out/race.json

With --suite all, a policy flies the suites that it fits.")]
pub struct Benchmark {
    /// Suite: hover, robust, race, tracks or all
    #[arg(
        long,
        value_name = "NAME",
        default_value = "all",
        value_parser = parse::suite(),
        hide_possible_values = true
    )]
    suite: SuiteChoice,
    /// Policy file of `aviary train`, or an ONNX file (.onnx)
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    policy: Option<PathBuf>,
    /// Controller: pid, dsl or geometric
    #[arg(
        long,
        value_name = "NAME",
        value_parser = parse::named::<ControllerKind>(),
        hide_possible_values = true
    )]
    controller: Option<ControllerKind>,
    /// Number of episodes of every condition
    #[arg(long, value_name = "N", default_value_t = EPISODES, allow_negative_numbers = true)]
    episodes: usize,
    /// Number of threads [default: all cores]
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    threads: Option<NonZeroUsize>,
    /// JSON file of the report
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    out: Option<PathBuf>,
    /// JSON output instead of a table
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    onnx: OnnxFlags,
}

/// Task of an ONNX file without metadata, in the report.
const NO_TASK: &str = "unknown";

impl Benchmark {
    pub fn run(&self) -> Result<(), Failure> {
        let pilot = self.pilot()?;
        let cores = || std::thread::available_parallelism().unwrap_or(NonZeroUsize::MIN);
        let threads = self.threads.unwrap_or_else(cores);
        let out = (self.out.as_ref()).map(|path| OutputFile::begin_apart(path, &self.policy)).transpose()?;
        let (suites, skip_unfit) = match self.suite {
            SuiteChoice(Some(suite)) => (vec![suite], false),
            SuiteChoice(None) => (Suite::ALL.to_vec(), true),
        };
        let conditions: usize = suites.iter().map(|suite| suite.conditions().len()).sum();
        let bar = output::progress(conditions.saturating_mul(self.episodes) as u64, "flying");
        let start = Instant::now();
        let mut progress = |done: usize| bar.set_position(done as u64);
        let report = benchmark::run(&pilot, &suites, self.episodes, threads, skip_unfit, &mut progress);
        bar.finish_and_clear();
        let report = report.map_err(|error| match error {
            TrainError::Policy(_) | TrainError::Option { .. } | TrainError::Unfit(_) => self.unfit(error),
            _ => Failure::work(error),
        })?;
        let json = with_timing(&report, start.elapsed().as_secs_f64(), threads)?;
        if let Some(out) = out {
            out.write(format!("{json:#}\n").as_bytes())?;
        }
        if self.json {
            return output::print_json(&json);
        }
        let faults: usize = report.suites.iter().flat_map(|suite| &suite.conditions).map(|report| report.faults).sum();
        warn_of_faults(faults);
        output::print(&table(&report))?;
        self.out.as_ref().map_or(Ok(()), |path| output::print_written(std::slice::from_ref(path)))
    }

    fn pilot(&self) -> Result<Pilot, Failure> {
        let Some(path) = &self.policy else {
            if let Some(option) = self.onnx.given() {
                return Err(Failure::input(anyhow::anyhow!(
                    "{option} is given with --controller, expected an ONNX file"
                )));
            }
            return Ok(Pilot::Controller(self.controller.unwrap_or_default()));
        };
        let bytes = std::fs::read(path).with_context(|| path.display().to_string()).map_err(Failure::Input)?;
        let name = path.file_name().map_or_else(Default::default, |name| name.to_string_lossy().into_owned());
        // the suites determine task and airframe
        Ok(PolicyFile::load(path, &self.onnx, Some(NO_TASK), None)?.into_benchmark(&name, &bytes, &self.onnx))
    }

    /// Returns the failure of a policy with its path.
    fn unfit(&self, error: TrainError) -> Failure {
        match (&self.policy, &error) {
            // the sizes fill a line
            (_, TrainError::Policy(PolicyError::Mismatch { .. })) => Failure::input(error),
            (Some(path), TrainError::Policy(_) | TrainError::Unfit(_)) => {
                Failure::Input(anyhow::anyhow!("{}: {error}", path.display()))
            }
            _ => Failure::input(error),
        }
    }
}

/// Warns of episodes that ended because an action or the state was not finite.
pub fn warn_of_faults(count: usize) {
    if count > 0 {
        let episodes = aviary::count(count, "episode");
        tracing::warn!("{episodes} ended with a fault: an action or the state was not finite");
    }
}

/// Returns the text of the mean progress; a dash for a task without parts.
fn progress(report: &ConditionReport) -> String {
    match report.quantity {
        Quantity::LatePositionError => "–".into(),
        Quantity::LapTime => format!("{} %", output::decimals(100.0 * report.mean_progress, 0)),
    }
}

/// Returns a report with the times of the run.
fn with_timing(report: &Report, seconds: f64, threads: NonZeroUsize) -> Result<Value, Failure> {
    let mut json = serde_json::to_value(report).map_err(Failure::work)?;
    let flown: usize = report.suites.iter().map(|suite| suite.conditions.len() * report.episodes).sum();
    json["timing"] = json!({
        "seconds": seconds,
        "threads": threads,
        "episodes_per_second": flown as f64 / seconds.max(1e-9),
    });
    Ok(json)
}

/// Returns the text of an interval of percentages or of another unit.
fn interval([low, high]: [f64; 2], factor: f64, count: usize) -> String {
    format!("{}–{}", output::decimals(factor * low, count), output::decimals(factor * high, count))
}

fn table(report: &Report) -> String {
    let mut text = report.suites.iter().map(suite_table).collect::<Vec<_>>().join("\n");
    for skipped in &report.skipped {
        text += &format!("skipped {}: {}\n", skipped.suite, skipped.reason);
    }
    text
}

fn suite_table(suite: &SuiteReport) -> String {
    let first = suite.conditions.first().map_or(Quantity::LapTime, |report| report.quantity);
    let (heading, factor) = match first {
        Quantity::LatePositionError => ("error (cm)", 100.0),
        Quantity::LapTime => ("lap (s)", 1.0),
    };
    let mut text = format!(
        "{:<16} {:>9} {:>11} {:>9} {:>11} {:>12}\n",
        suite.suite, "success", "95 %", "progress", heading, "95 %"
    );
    for report in &suite.conditions {
        let dash = || "–".to_string();
        text += &format!(
            "{:<16} {:>7} % {:>11} {:>9} {:>11} {:>12}\n",
            report.condition,
            output::decimals(100.0 * report.success_rate, 1),
            interval(report.success_interval, 100.0, 1),
            progress(report),
            report.mean.map_or_else(dash, |mean| output::decimals(factor * mean, 2)),
            report.interval.map_or_else(dash, |bounds| interval(bounds, factor, 2)),
        );
    }
    for margin in &suite.margins {
        let passed =
            margin.passed.map_or_else(|| "no level".to_string(), |level| format!("up to {level} ({})", margin.unit));
        text += &format!("{:<16} passed {passed}\n", margin.ladder);
    }
    text + &format!("score of {}: {}\n", suite.suite, output::decimals(100.0 * suite.score, 1))
}
