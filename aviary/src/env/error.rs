use std::path::PathBuf;

use crate::control::SafetyError;
use crate::engine::BuildError;
use crate::error::OptionError;
use crate::simulation::SimulationError;
use crate::world::ObstacleGeneratorError;
use crate::{SystemError, UnknownName};

/// Error of an environment.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum EnvError {
    /// An action of the wrong length.
    #[error("the action has {got} numbers, expected {expected}")]
    ActionLength {
        /// Length of the action.
        got: usize,
        /// Size of the action space.
        expected: usize,
    },
    /// An action that is not finite.
    #[error("action[{index}] is {} at t = {time} s, expected a finite number", crate::number(*got))]
    Action {
        /// Index of the entry.
        index: usize,
        /// Value of the entry.
        got: f64,
        /// Simulated time, s.
        time: f64,
    },
    /// A step outside an episode.
    #[error("step was called {when}, expected a call of reset first")]
    NeedsReset {
        /// Occasion of the call: a new environment, or the end of an episode.
        when: &'static str,
    },
    /// A snapshot of another kind of environment.
    #[error("the snapshot is of another kind of environment, expected one of an environment with the same options")]
    Snapshot,
    /// A snapshot from a file whose content does not fit.
    #[error("the snapshot cannot be read: {message}")]
    SavedSnapshot {
        /// Reason.
        message: String,
    },
    /// An unknown name of a task.
    #[error(transparent)]
    UnknownName(#[from] UnknownName),
    /// An invalid option.
    #[error("{option} is {got}, expected {expected}")]
    Option {
        /// Name of the field, or of the builder's method, that sets it.
        option: &'static str,
        /// Value that was set.
        got: String,
        /// Valid values.
        expected: &'static str,
    },
    /// An option that the task does not have.
    #[error("the task `{task}` has no option `{option}`, expected {}", known_options(known))]
    TaskOption {
        /// Name of the task.
        task: &'static str,
        /// Name of the option.
        option: &'static str,
        /// Names of the options of the task.
        known: &'static [&'static str],
    },
    /// A configuration that is not valid TOML.
    #[error("{message}")]
    Toml {
        /// Line, column and what was expected.
        message: String,
    },
    /// A file that the system cannot read or write.
    #[error(transparent)]
    System(#[from] SystemError),
    /// A file that the system cannot read or write, or without valid content.
    #[error("{}: {error}", path.display())]
    File {
        /// Path of the file.
        path: PathBuf,
        /// Error of the content, or of reading the file.
        #[source]
        error: Box<EnvError>,
    },
    /// Obstacles that cannot be placed.
    #[error(transparent)]
    Field(#[from] ObstacleGeneratorError),
    /// An error of the simulation.
    #[error(transparent)]
    Simulation(#[from] SimulationError),
    /// An error of the safety filter.
    #[error(transparent)]
    Safety(#[from] SafetyError),
    /// An action for an unknown agent, or a missing action of a live one.
    #[error("{what} the agent `{agent}`, expected one for each of: {expected}")]
    Agent {
        /// Description of the error.
        what: &'static str,
        /// Name of the agent.
        agent: String,
        /// The live agents.
        expected: String,
    },
    /// A buffer of a batch with a wrong length.
    #[error("{what} has {got} entries, expected {expected}")]
    Buffer {
        /// Name of the buffer.
        what: &'static str,
        /// Length of the buffer.
        got: usize,
        /// Length that the batch needs.
        expected: usize,
    },
    /// An index of an environment that is out of range.
    #[error("environment {got} does not exist, expected an index from 0 to {}", environments - 1)]
    NoEnvironment {
        /// Index of the environment.
        got: usize,
        /// Number of environments.
        environments: usize,
    },
    /// A task of a batch that panicked in an earlier step.
    #[error("a task panicked in an earlier step of this batch, expected a new batch")]
    Panicked,
    /// An error of one environment of a batch.
    #[error("environment {environment}: {error}")]
    InBatch {
        /// Index of the environment.
        environment: usize,
        /// Error of the environment.
        #[source]
        error: Box<EnvError>,
    },
    /// An error of one of several agents.
    #[error("the agent `{agent}`: {error}")]
    OfAgent {
        /// Name of the agent.
        agent: String,
        /// Error of the agent.
        #[source]
        error: Box<EnvError>,
    },
    /// A device of a batch that failed, or an option that it does not have.
    #[error("{message}")]
    Device {
        /// Description of the error.
        message: String,
    },
    /// Images that cannot be rendered.
    #[error(transparent)]
    Vision(#[from] BuildError),
}

/// Returns the names of options for an error message.
fn known_options(known: &[&str]) -> String {
    if known.is_empty() { "none".into() } else { known.join(" or ") }
}

impl From<OptionError> for EnvError {
    fn from(error: OptionError) -> Self {
        let OptionError { option, got, expected } = error;
        Self::Option { option, got, expected }
    }
}

impl From<mujoco_rs::Error> for EnvError {
    fn from(error: mujoco_rs::Error) -> Self {
        Self::Vision(BuildError::Mujoco(error))
    }
}
