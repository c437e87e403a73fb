use std::path::PathBuf;

use aviary::SystemError;
use aviary::drone::DroneError;
use aviary::env::EnvError;
use aviary::policy::PolicyError;
use aviary::rollout::RolloutError;

/// Errors of training.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum TrainError {
    /// Error of an environment.
    #[error(transparent)]
    Env(#[from] EnvError),
    /// Error of a policy.
    #[error(transparent)]
    Policy(#[from] PolicyError),
    /// Rates or an action type of a policy with which no environment of a benchmark can be created.
    #[error(transparent)]
    Unfit(EnvError),
    /// Invalid value of a setting.
    #[error("{option} is {got}, expected {expected}")]
    Option {
        /// Name of the setting.
        option: &'static str,
        /// Given value.
        got: String,
        /// Accepted values.
        expected: &'static str,
    },
    /// Invalid configuration in TOML.
    #[error("{message}")]
    Toml {
        /// Line, column and expected content.
        message: String,
    },
    /// Error of the operating system.
    #[error(transparent)]
    System(#[from] SystemError),
    /// Error that concerns a file.
    #[error("{}: {error}", path.display())]
    File {
        /// Path of the file.
        path: PathBuf,
        /// Cause.
        #[source]
        error: Box<Self>,
    },
    /// Invalid checkpoint.
    #[error("not a checkpoint: {message}")]
    Checkpoint {
        /// Cause.
        message: String,
    },
    /// Error of an airframe.
    #[error(transparent)]
    Drone(#[from] DroneError),
    /// Batch that the trainer cannot use.
    #[error("the batch does not fit the trainer, expected {expected}")]
    Batch {
        /// Needed property.
        expected: &'static str,
    },
    /// Non-finite gradient.
    #[error("the gradient is not finite: try a lower learning_rate or max_grad_norm")]
    Diverged,
}

impl From<RolloutError> for TrainError {
    fn from(error: RolloutError) -> Self {
        match error {
            RolloutError::Env(error) => error.into(),
            // training restores no policies
            RolloutError::Snapshot => EnvError::Snapshot.into(),
            RolloutError::Policy(error) => error.into(),
        }
    }
}
