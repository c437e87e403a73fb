//! Benchmark of policies and controllers: fixed tasks, conditions, seeds and statistics.
//!
//! A [`Suite`] is a list of conditions of one task. [`run`] flies episodes of every condition and returns a [`Report`].
//! The report depends only on the pilot, the suites and the number of episodes: it is bit-identical for any number of
//! threads.

mod pilot;
mod statistics;
mod suites;

use std::collections::BTreeMap;
use std::num::NonZeroUsize;
use std::sync::Arc;

use aviary::SystemError;
use aviary::control::ControllerKind;
use aviary::drone::DroneModel;
use aviary::policy::{PolicyInfo, PolicyNetwork};
use aviary::rollout::Policy;
use serde::Serialize;
use sha2::{Digest as _, Sha256};

use crate::{Arena, Episode, TrainError};
use pilot::MeasuredController;
pub use statistics::{Interval, mean_interval, wilson};
pub use suites::{Condition, Ladder, Quantity, SUITES_VERSION, Suite};

/// Version of the format of a [`Report`].
pub const FORMAT: u32 = 1;

/// Seed of the first episode of every condition. Each further episode has the next seed.
pub const FIRST_SEED: u64 = 20_000_000;

/// Default number of episodes of a condition.
pub const EPISODES: usize = 100;

/// Success rate at which a level of a [`Ladder`] counts as passed.
pub const PASSED: f64 = 0.95;

/// Pilot that a benchmark evaluates.
#[derive(Debug, Clone)]
pub enum Pilot {
    /// Built-in controller at physics and control rates of 240 Hz and 48 Hz. It receives the states of the
    /// observations, and follows the plans of the tasks.
    Controller(ControllerKind),
    /// Trained policy, at the rates and with the action type of its training.
    Policy(PolicyPilot),
}

/// Trained policy of a benchmark.
#[derive(Clone)]
pub struct PolicyPilot {
    /// Name of the file, without directories.
    file: String,
    /// SHA-256 of the file, hexadecimal.
    sha256: String,
    info: Box<PolicyInfo>,
    /// Number of entries of the observation; `None` for any number.
    inputs: Option<usize>,
    /// Options with which the file was read.
    options: BTreeMap<&'static str, String>,
    make: Arc<dyn Fn() -> Box<dyn Policy> + Send + Sync>,
}

impl std::fmt::Debug for PolicyPilot {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("PolicyPilot").field("file", &self.file).field("info", &self.info).finish_non_exhaustive()
    }
}

impl Pilot {
    /// Reads a policy from the content of its file.
    ///
    /// # Errors
    /// [`TrainError::Policy`] for bytes that are not a policy.
    pub fn policy(file: &str, bytes: &[u8]) -> Result<Self, TrainError> {
        let network = PolicyNetwork::from_bytes(bytes)?;
        let (info, inputs) = (network.info().clone(), network.observation_size());
        Ok(Self::other(file, bytes, info, Some(inputs), BTreeMap::new(), move || {
            Box::new(network.clone().into_pilot())
        }))
    }

    /// Creates a pilot from a policy of another format: the name and the content of its file, its environment, the
    /// number of entries of its observation if it is fixed, and a function that creates a policy for an episode.
    /// Policies whose results depend on the machine make reports that depend on it.
    pub fn other(
        file: &str,
        bytes: &[u8],
        info: PolicyInfo,
        inputs: Option<usize>,
        options: BTreeMap<&'static str, String>,
        make: impl Fn() -> Box<dyn Policy> + Send + Sync + 'static,
    ) -> Self {
        let sha256 = Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect();
        let (info, make) = (Box::new(info), Arc::new(make));
        Self::Policy(PolicyPilot { file: file.into(), sha256, info, inputs, options, make })
    }
}

/// Identity of a pilot in a report.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum PilotReport {
    /// Name of a built-in controller.
    Controller(&'static str),
    /// Policy file.
    Policy {
        /// Name of the file, without directories.
        file: String,
        /// SHA-256 of the file, hexadecimal.
        sha256: String,
        /// Task of the training.
        task: String,
        /// Options with which the file was read.
        #[serde(skip_serializing_if = "BTreeMap::is_empty")]
        options: BTreeMap<&'static str, String>,
    },
}

/// Results of a benchmark.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Report {
    /// [`FORMAT`].
    pub format: u32,
    /// [`SUITES_VERSION`]: results of different versions cannot be compared.
    pub suites_version: u32,
    /// Version of the program.
    pub program: &'static str,
    /// Pilot.
    pub pilot: PilotReport,
    /// Name of the airframe.
    pub airframe: &'static str,
    /// Action type.
    pub action_type: &'static str,
    /// Physics rate, Hz.
    pub sim_freq: u32,
    /// Control rate, Hz.
    pub ctrl_freq: u32,
    /// Seed of the first episode of every condition.
    pub first_seed: u64,
    /// Number of episodes of every condition.
    pub episodes: usize,
    /// Results of each suite.
    pub suites: Vec<SuiteReport>,
    /// Suites that the pilot does not fit, if [`run`] was called with `skip_unfit`.
    pub skipped: Vec<Skipped>,
}

/// Suite that a pilot does not fit.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Skipped {
    /// Name of the suite.
    pub suite: &'static str,
    /// Sizes and action types of both.
    pub reason: String,
}

/// Results of a suite.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SuiteReport {
    /// Name of the suite.
    pub suite: &'static str,
    /// Mean success rate over the conditions.
    pub score: f64,
    /// Results of each condition.
    pub conditions: Vec<ConditionReport>,
    /// Margins: for each ladder of conditions, the highest level up to which all levels reach [`PASSED`].
    pub margins: Vec<Margin>,
}

/// Results of a condition.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ConditionReport {
    /// Name of the condition, unique in its suite.
    pub condition: String,
    /// Name of the task.
    pub task: &'static str,
    /// Success criterion.
    pub criterion: String,
    /// Number of episodes.
    pub episodes: usize,
    /// Number of successful episodes.
    pub succeeded: usize,
    /// Share of successful episodes.
    pub success_rate: f64,
    /// Wilson's 95 % confidence interval of the success rate.
    pub success_interval: Interval,
    /// Number of episodes that ended because an action or the state was not finite.
    pub faults: usize,
    /// Mean fraction of the task that was completed; 0 for tasks without parts, such as hover.
    pub mean_progress: f64,
    /// Measured quantity.
    pub quantity: Quantity,
    /// Mean of the quantity over the successful episodes; `None` without any.
    pub mean: Option<f64>,
    /// 95 % confidence interval of this mean from a bootstrap; `None` for fewer than two successful episodes.
    pub interval: Option<Interval>,
}

/// Margin of a ladder of conditions.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Margin {
    /// Name of the ladder.
    pub ladder: &'static str,
    /// Unit of the levels.
    pub unit: &'static str,
    /// Highest level up to which all levels are passed; `None` if the first one is not.
    pub passed: Option<f64>,
}

/// Flies all conditions of suites with a pilot on a number of threads, and calls `progress` with the number of finished
/// episodes. With `skip_unfit`, suites whose observations or actions do not fit a policy are skipped.
///
/// # Errors
/// [`TrainError::Policy`] or [`TrainError::Unfit`] for a policy that does not fit a suite, or none with `skip_unfit`;
/// [`TrainError::Option`] for a number of episodes or threads out of range.
pub fn run(
    pilot: &Pilot,
    suites: &[Suite],
    episodes: usize,
    threads: NonZeroUsize,
    skip_unfit: bool,
    progress: &mut (dyn FnMut(usize) + Send),
) -> Result<Report, TrainError> {
    let range = |option, got: usize, expected| Err(TrainError::Option { option, got: got.to_string(), expected });
    if !(1..=100_000).contains(&episodes) {
        return range("episodes", episodes, "1 to 100,000");
    }
    if threads.get() > 1024 {
        return range("threads", threads.get(), "1 to 1024");
    }
    let unfit_env = |error| match error {
        TrainError::Env(error) => TrainError::Unfit(error),
        error => error,
    };
    let craft = Craft::of(pilot).map_err(unfit_env)?;
    let (mut fitting, mut skipped, mut unfit) = (Vec::new(), Vec::new(), None);
    for &suite in suites {
        match craft.check(pilot, suite).map_err(unfit_env) {
            Ok(()) => fitting.push(suite),
            Err(error @ (TrainError::Policy(_) | TrainError::Unfit(_))) if skip_unfit => {
                skipped.push(Skipped { suite: suite.name(), reason: error.to_string() });
                unfit.get_or_insert(error);
            }
            Err(error) => return Err(error),
        }
    }
    if let (true, Some(error)) = (fitting.is_empty(), unfit) {
        return Err(error);
    }
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads.get()).build();
    let pool = pool.map_err(|error| TrainError::System(SystemError::from(std::io::Error::other(error))))?;
    let mut finished = 0;
    let mut reports = Vec::new();
    for suite in fitting {
        let mut conditions = Vec::new();
        for condition in suite.conditions() {
            let flown = pool.install(|| craft.fly(pilot, &condition, episodes))?;
            finished += episodes;
            progress(finished);
            conditions.push(ConditionReport::new(&condition, &flown));
        }
        reports.push(SuiteReport::new(suite, conditions));
    }
    Ok(Report {
        format: FORMAT,
        suites_version: SUITES_VERSION,
        program: env!("CARGO_PKG_VERSION"),
        pilot: match pilot {
            Pilot::Controller(kind) => PilotReport::Controller(kind.name()),
            Pilot::Policy(PolicyPilot { file, sha256, info, options, .. }) => PilotReport::Policy {
                file: file.clone(),
                sha256: sha256.clone(),
                task: info.task.clone(),
                options: options.clone(),
            },
        },
        airframe: Craft::AIRFRAME.name(),
        action_type: craft.action_type.name(),
        sim_freq: craft.sim_freq,
        ctrl_freq: craft.ctrl_freq,
        first_seed: FIRST_SEED,
        episodes,
        suites: reports,
        skipped,
    })
}

/// Options of every environment that the pilot determines.
#[derive(Debug)]
struct Craft {
    action_type: aviary::action::ActionType,
    sim_freq: u32,
    ctrl_freq: u32,
    /// True if the observations of races have the normals of gates.
    normals: bool,
}

impl Craft {
    const AIRFRAME: DroneModel = DroneModel::Cf2x;

    fn of(pilot: &Pilot) -> Result<Self, TrainError> {
        Ok(match pilot {
            Pilot::Controller(_) => {
                Self { action_type: Default::default(), sim_freq: 240, ctrl_freq: 48, normals: false }
            }
            Pilot::Policy(PolicyPilot { info, inputs, .. }) => {
                let action_type = info.action_type.parse().map_err(aviary::env::EnvError::from)?;
                // a race without normals has 21 numbers
                let normals = inputs.is_some_and(|inputs| inputs > 21);
                Self { action_type, sim_freq: info.sim_freq, ctrl_freq: info.ctrl_freq, normals }
            }
        })
    }

    /// Checks that a pilot fits the environments of a suite.
    fn check(&self, pilot: &Pilot, suite: Suite) -> Result<(), TrainError> {
        if let (Pilot::Policy(policy), Some(condition)) = (pilot, suite.conditions().first()) {
            (policy.make)().reset(&*condition.environment(self)?)?;
        }
        Ok(())
    }

    /// Flies the episodes of a condition.
    fn fly(&self, pilot: &Pilot, condition: &Condition, episodes: usize) -> Result<Vec<Episode>, TrainError> {
        let mut arena = Arena::new(condition.success, || condition.environment(self))?;
        match pilot {
            Pilot::Controller(kind) => {
                let params = Self::AIRFRAME.params();
                arena.fly(|| MeasuredController::new(*kind, &params), FIRST_SEED, episodes)
            }
            Pilot::Policy(policy) => arena.fly(|| (policy.make)(), FIRST_SEED, episodes),
        }
    }
}

impl ConditionReport {
    fn new(condition: &Condition, flown: &[Episode]) -> Self {
        let succeeded = flown.iter().filter(|episode| episode.success).count();
        let values: Vec<f64> = (flown.iter())
            .filter(|episode| episode.success)
            .map(|episode| condition.quantity.of(episode, condition.laps()))
            .collect();
        let mean = (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64);
        Self {
            condition: condition.name.clone(),
            task: condition.task_name(),
            criterion: condition.success.to_string(),
            episodes: flown.len(),
            succeeded,
            success_rate: succeeded as f64 / flown.len().max(1) as f64,
            success_interval: wilson(succeeded, flown.len()),
            faults: flown.iter().filter(|episode| episode.has_fault()).count(),
            mean_progress: flown.iter().map(|episode| episode.progress).sum::<f64>() / flown.len().max(1) as f64,
            quantity: condition.quantity,
            mean,
            interval: mean_interval(&values),
        }
    }
}

impl SuiteReport {
    fn new(suite: Suite, conditions: Vec<ConditionReport>) -> Self {
        let score = conditions.iter().map(|report| report.success_rate).sum::<f64>() / conditions.len().max(1) as f64;
        let margins = suite.ladders().iter().map(|ladder| ladder.margin(&conditions)).collect();
        Self { suite: suite.name(), score, conditions, margins }
    }
}

impl Ladder {
    /// Returns the margin of the results of a suite.
    fn margin(&self, conditions: &[ConditionReport]) -> Margin {
        let passes = |&&level: &&f64| {
            let name = self.condition_name(level);
            conditions.iter().any(|report| report.condition == name && report.success_rate >= PASSED)
        };
        let passed = self.levels.iter().take_while(passes).last().copied();
        Margin { ladder: self.name, unit: self.unit, passed }
    }
}

#[cfg(test)]
mod tests;
