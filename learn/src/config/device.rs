//! Device of the training.

use aviary::{NamedEnum, UnknownName};
use serde::{Deserialize, Serialize};

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
    pub(super) fn is_cpu(&self) -> bool {
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
