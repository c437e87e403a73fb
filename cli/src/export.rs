//! Policies for other programs.

use std::path::{Path, PathBuf};

use anyhow::anyhow;
use aviary::drone::{DroneModel, DroneParams};
use aviary::policy::PolicyNetwork;
use clap::{Args, ValueEnum, ValueHint};
use policy_formats::c::{self, FirmwareOptions, Weights};
use policy_formats::{FormatError, onnx, quantization};
use serde_json::json;

use crate::failure::Failure;
use crate::options;
use crate::output::{self, OutputDir, OutputFile};
use crate::parse::{self, NameOrFile};
use crate::policy_file::is_onnx;

/// Write a policy in the format of another program
///
/// `c` writes a header and a source file in C99, which need no library and allocate nothing, to
/// the directory of --out. `crazyflie` writes a directory for the out-of-tree build of the
/// firmware of a Crazyflie, with a controller that flies a policy of the task hover. `onnx` and
/// `safetensors` write a file. Normalization and bounds of the actions are part of all formats.
#[derive(Debug, Args)]
#[command(verbatim_doc_comment)]
#[command(after_help = "Examples:
  aviary export --policy assets/policies/hover.safetensors --format c --out out/hover_c
  aviary export --policy assets/policies/hover.safetensors --format c --weights int8 --out out/hover_int8
  aviary export --policy assets/policies/race.safetensors --format onnx --out out/race.onnx
  aviary export --policy assets/policies/hover.safetensors --format crazyflie --out out/hover_app")]
pub struct Export {
    /// Policy file of `aviary train`
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    policy: PathBuf,
    /// Format: c, crazyflie, onnx or safetensors
    #[arg(long, value_name = "NAME", hide_possible_values = true)]
    format: Format,
    /// Output: a directory (c, crazyflie) or a file (onnx, safetensors)
    #[arg(long, value_name = "PATH", value_hint = ValueHint::AnyPath)]
    out: PathBuf,
    /// Weights: float32 or int8
    ///
    /// `int8` rounds the weights to eight bits with one scale per neuron, a quarter of the size.
    /// `--format safetensors --weights int8` writes the policy with the rounded weights, so that
    /// `aviary play` shows how well it flies.
    #[arg(long, verbatim_doc_comment, value_name = "NAME", default_value = "float32", hide_possible_values = true)]
    weights: WeightType,
    /// Name in the C code, in lower snake case [default: TASK_policy]
    #[arg(long, value_name = "NAME")]
    name: Option<String>,
    /// Airframe of --format crazyflie [default: the policy's]
    ///
    /// Its thrust coefficient and motor speeds turn actions into forces.
    #[arg(long, value_name = "NAME", value_parser = parse::airframe(), hide_possible_values = true)]
    drone: Option<NameOrFile<DroneModel>>,
    /// JSON output instead of a table
    #[arg(long)]
    json: bool,
}

/// Output format.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Format {
    C,
    Crazyflie,
    Onnx,
    Safetensors,
}

impl Format {
    fn name(self) -> &'static str {
        match self {
            Self::C => "c",
            Self::Crazyflie => "crazyflie",
            Self::Onnx => "onnx",
            Self::Safetensors => "safetensors",
        }
    }
}

/// Type of the weights.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum WeightType {
    Float32,
    Int8,
}

impl Export {
    pub fn run(&self) -> Result<(), Failure> {
        let is_code = matches!(self.format, Format::C | Format::Crazyflie);
        let wrong = |option: &str, formats: &str| {
            let message = anyhow!("{option} is given with --format {}, expected {formats}", self.format.name());
            Err(Failure::input(message))
        };
        if self.name.is_some() && !is_code {
            return wrong("--name", "c or crazyflie");
        }
        if self.drone.is_some() && self.format != Format::Crazyflie {
            return wrong("--drone", "crazyflie");
        }
        if self.weights == WeightType::Int8 && self.format == Format::Onnx {
            return wrong("--weights int8", "c, crazyflie or safetensors (whose file exports to onnx)");
        }
        if self.format == Format::Onnx && !is_onnx(&self.out) {
            let message = anyhow!("--out is {}, expected a name that ends in .onnx", self.out.display());
            return Err(Failure::input(message));
        }
        let policy = PolicyNetwork::load(&self.policy).map_err(Failure::input)?;
        let in_file = |error: FormatError| match error {
            FormatError::Unsupported { what: "the name", got, expected } => {
                Failure::input(anyhow!("--name is {got}, expected {expected}"))
            }
            error => Failure::input(anyhow!("{}: {error}", self.policy.display())),
        };
        let weights = match self.weights {
            WeightType::Float32 => Weights::Float32,
            WeightType::Int8 => Weights::Int8,
        };
        let name = self.name.clone().unwrap_or_else(|| c::default_name(policy.info()));
        let mut constants = None;
        let files = match self.format {
            Format::C => {
                let code = c::source(&policy, &name, weights).map_err(in_file)?;
                constants = Some(code.constant_bytes);
                let files = [(format!("{name}.h"), code.header), (format!("{name}.c"), code.source)];
                self.write_directory(&files)?
            }
            Format::Crazyflie => {
                let drone = self.airframe(&policy)?;
                // the target of the task, which its policies know
                let target = [0.0, 0.0, 1.0];
                let options = FirmwareOptions { name: &name, weights, drone: &drone, target };
                constants = Some(c::source(&policy, &name, weights).map_err(in_file)?.constant_bytes);
                let files = c::firmware(&policy, &options).map_err(in_file)?;
                let files: Vec<_> = files.into_iter().map(|file| (file.path, file.content)).collect();
                self.write_directory(&files)?
            }
            Format::Onnx => self.write_file(&onnx::to_bytes(&policy).map_err(in_file)?)?,
            Format::Safetensors => {
                let written = match self.weights {
                    WeightType::Float32 => policy.clone(),
                    WeightType::Int8 => quantization::rounded(&policy).map_err(Failure::input)?,
                };
                self.write_file(&written.to_bytes().map_err(Failure::input)?)?
            }
        };
        self.report(&policy, constants, &files)
    }

    /// Returns the airframe whose motors the application drives.
    fn airframe(&self, policy: &PolicyNetwork) -> Result<DroneParams, Failure> {
        if let Some(drone) = &self.drone {
            return options::params(drone);
        }
        let name = &policy.info().drone;
        let known = name.parse::<DroneModel>().map_err(|_| {
            Failure::input(anyhow!(
                "{}: its airframe `{name}` is from a file, expected --drone with this file",
                self.policy.display()
            ))
        })?;
        Ok(known.params())
    }

    /// Writes files to the directory of --out, all of them or none.
    fn write_directory(&self, files: &[(String, String)]) -> Result<Vec<PathBuf>, Failure> {
        let directory = OutputDir::create(&self.out)?;
        let mut unfinished = Vec::new();
        for (path, content) in files {
            let mut writer = directory.begin(path)?.into_writer();
            std::io::Write::write_all(&mut writer, content.as_bytes()).map_err(Failure::work)?;
            unfinished.push(writer);
        }
        unfinished.into_iter().try_for_each(|writer| writer.keep())?;
        Ok(files.iter().map(|(path, _)| self.out.join(path)).collect())
    }

    fn write_file(&self, bytes: &[u8]) -> Result<Vec<PathBuf>, Failure> {
        let inputs: [&Path; 1] = [&self.policy];
        OutputFile::begin_apart(&self.out, inputs)?.write(bytes)?;
        Ok(vec![self.out.clone()])
    }

    fn report(&self, policy: &PolicyNetwork, constants: Option<usize>, files: &[PathBuf]) -> Result<(), Failure> {
        let parameters =
            policy.net().parameters().len() + policy.recurrent().map_or(0, |layer| layer.parameters().len());
        let weights = match self.weights {
            WeightType::Float32 => "float32",
            WeightType::Int8 => "int8",
        };
        if self.json {
            return output::print_json(&json!({
                "policy": self.policy.to_string_lossy(),
                "task": policy.info().task,
                "format": self.format.name(),
                "weights": weights,
                "parameters": parameters,
                "constant_bytes": constants,
                "observation_size": policy.observation_size(),
                "memory_size": policy.memory_size(),
                "action_size": policy.action_size(),
                "files": files.iter().map(|path| path.to_string_lossy()).collect::<Vec<_>>(),
            }));
        }
        let mut rows = vec![
            ("task", policy.info().task.clone()),
            ("observation", format!("{} numbers", policy.observation_size())),
            ("action", format!("{} numbers", policy.action_size())),
            ("parameters", format!("{parameters} ({weights})")),
        ];
        if policy.memory_size() > 0 {
            rows.push(("memory", format!("{} numbers", policy.memory_size())));
        }
        if let Some(bytes) = constants {
            rows.push(("constants", format!("{bytes} bytes")));
        }
        output::print(&output::table(&rows))?;
        output::print_written(files)
    }
}
