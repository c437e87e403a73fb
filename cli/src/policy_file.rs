//! Policy files: those of `aviary train`, and ONNX files of other trainers.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::anyhow;
use aviary::action::ActionType;
use aviary::policy::{PolicyInfo, PolicyNetwork};
use aviary::rollout::Policy;
use clap::Args;
use learn::benchmark::Pilot;
use learn::{Arena, Episode, TrainError};
use policy_formats::FormatError;
use policy_formats::onnx::{self, ActionRange, OnnxOptions, OnnxPolicy};

use crate::failure::Failure;
use crate::parse;

// not a doc comment, which would replace the description of a command: options of ONNX files
#[derive(Debug, Clone, Default, Args)]
#[command(next_help_heading = "Options of ONNX files")]
pub struct OnnxFlags {
    /// Action type [default: the file's, or rpm]
    ///
    /// One of rpm, raw_rpm, one_d_rpm, vel, pid, attitude, ctbr and duty.
    #[arg(
        long,
        verbatim_doc_comment,
        value_name = "NAME",
        value_parser = parse::named::<ActionType>(),
        hide_possible_values = true
    )]
    action_type: Option<ActionType>,
    /// Physics rate, Hz [default: the file's, or 240]
    #[arg(long, value_name = "HZ", allow_negative_numbers = true)]
    sim_freq: Option<u32>,
    /// Control rate, Hz [default: the file's, or 48]
    #[arg(long, value_name = "HZ", allow_negative_numbers = true)]
    ctrl_freq: Option<u32>,
    /// Entries of the observation that are inputs of the graph
    ///
    /// Numbers from 0 and ranges, separated by commas, in the order of the graph: `6-8,0-5`.
    /// The default is the key `observation_indices` in the metadata, or all entries.
    #[arg(long, verbatim_doc_comment, value_name = "LIST")]
    observation_indices: Option<String>,
    /// Range of the outputs: space or unit
    ///
    /// `space` takes the outputs as actions, `unit` scales them from -1 to 1 to the bounds of
    /// the actions. The default is the key `action_range` in the metadata, or space.
    #[arg(long, verbatim_doc_comment, value_name = "NAME")]
    action_range: Option<String>,
    /// Output of the graph that is the action
    ///
    /// The default is the key `action_output` in the metadata, or the first output.
    #[arg(long, verbatim_doc_comment, value_name = "NAME")]
    action_output: Option<String>,
}

impl OnnxFlags {
    /// Returns the name of an option that is set.
    pub fn given(&self) -> Option<&'static str> {
        [
            (self.action_type.is_some(), "--action-type"),
            (self.sim_freq.is_some(), "--sim-freq"),
            (self.ctrl_freq.is_some(), "--ctrl-freq"),
            (self.observation_indices.is_some(), "--observation-indices"),
            (self.action_range.is_some(), "--action-range"),
            (self.action_output.is_some(), "--action-output"),
        ]
        .into_iter()
        .find_map(|(is_given, option)| is_given.then_some(option))
    }

    /// Returns the options of the mapping that are set, for reports.
    pub fn report(&self) -> BTreeMap<&'static str, String> {
        let options = [
            ("observation_indices", &self.observation_indices),
            ("action_range", &self.action_range),
            ("action_output", &self.action_output),
        ];
        options.into_iter().filter_map(|(name, value)| Some((name, value.clone()?))).collect()
    }

    fn options(&self) -> Result<OnnxOptions, Failure> {
        let action_range = match self.action_range.as_deref() {
            None => None,
            Some("space") => Some(ActionRange::Space),
            Some("unit") => Some(ActionRange::Unit),
            Some(name) => {
                return Err(Failure::input(anyhow!("--action-range is `{name}`, expected space or unit")));
            }
        };
        let indices = |list: &str| {
            onnx::parse_indices(list)
                .map_err(|error| Failure::input(anyhow!("--{}", error.to_string().replacen('_', "-", 1))))
        };
        let observation_indices = self.observation_indices.as_deref().map(indices).transpose()?;
        let (action_output, any_action_type) = (self.action_output.clone(), self.action_type.is_some());
        Ok(OnnxOptions { observation_indices, action_range, action_output, any_action_type })
    }
}

/// A policy from a file.
#[derive(Debug)]
pub enum PolicyFile {
    /// Policy of `aviary train`.
    Network(PolicyNetwork),
    /// ONNX file, and what is known of its environment.
    Onnx(OnnxPolicy, Box<PolicyInfo>),
}

/// Returns true for the path of an ONNX file.
pub fn is_onnx(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("onnx"))
}

impl PolicyFile {
    /// Reads a policy. `task` and `drone` are those of the command line, for ONNX files without metadata.
    pub fn load(path: &Path, flags: &OnnxFlags, task: Option<&str>, drone: Option<String>) -> Result<Self, Failure> {
        if !is_onnx(path) {
            if let Some(option) = flags.given() {
                let message = anyhow!("{option} is given, expected an ONNX file (.onnx), not {}", path.display());
                return Err(Failure::input(message));
            }
            return PolicyNetwork::load(path).map(Self::Network).map_err(Failure::input);
        }
        let in_file = |error: FormatError| match error {
            FormatError::Policy(error) => Failure::input(error),
            error => Failure::input(anyhow!("{}: {error}", path.display())),
        };
        let policy = OnnxPolicy::load(path, &flags.options()?).map_err(in_file)?;
        let mut info = match policy.info() {
            Some(info) => info.clone(),
            None => {
                let task = task.ok_or_else(|| {
                    Failure::input(anyhow!("{}: its metadata has no task, expected --task", path.display()))
                })?;
                let unnamed = PolicyInfo::of_task(task);
                PolicyInfo { drone: drone.unwrap_or(unnamed.drone), ..unnamed }
            }
        };
        info.action_type = flags.action_type.map_or(info.action_type, |action_type| action_type.name().into());
        info.sim_freq = flags.sim_freq.unwrap_or(info.sim_freq);
        info.ctrl_freq = flags.ctrl_freq.unwrap_or(info.ctrl_freq);
        Ok(Self::Onnx(policy, Box::new(info)))
    }

    /// Returns the metadata; those of an ONNX file that has none are the options and defaults.
    pub fn info(&self) -> &PolicyInfo {
        match self {
            Self::Network(policy) => policy.info(),
            Self::Onnx(_, info) => info,
        }
    }

    /// Returns the number of entries of the observation; `None` for an ONNX file that does not fix it.
    pub fn inputs(&self) -> Option<usize> {
        match self {
            Self::Network(policy) => Some(policy.observation_size()),
            Self::Onnx(policy, _) => policy.inputs(),
        }
    }

    /// Returns the policy as a pilot of a benchmark, with the name and the content of its file.
    pub fn into_benchmark(self, file: &str, bytes: &[u8], flags: &OnnxFlags) -> Pilot {
        let (info, inputs) = (self.info().clone(), self.inputs());
        Pilot::other(file, bytes, info, inputs, flags.report(), move || self.pilot())
    }

    /// Returns the environment steps of the training; `None` for the policy of another trainer.
    pub fn steps(&self) -> Option<u64> {
        match self {
            Self::Network(policy) => Some(policy.info().steps),
            Self::Onnx(policy, _) => policy.info().map(|info| info.steps),
        }
    }

    /// Flies episodes with the policy, from a seed on.
    pub fn fly(&self, arena: &mut Arena, first_seed: u64, episodes: usize) -> Result<Vec<Episode>, TrainError> {
        match self {
            Self::Network(policy) => arena.fly(|| policy.pilot(), first_seed, episodes),
            Self::Onnx(policy, _) => {
                onnx::on_threads_of_the_runtime(|| arena.fly(|| policy.pilot(), first_seed, episodes))
            }
        }
    }

    /// Returns a pilot with a memory of its own.
    pub fn pilot(&self) -> Box<dyn Policy> {
        match self {
            Self::Network(policy) => Box::new(policy.clone().into_pilot()),
            Self::Onnx(policy, _) => Box::new(policy.pilot()),
        }
    }
}
