use std::path::PathBuf;

use aviary::SystemError;
use aviary::drone::DroneError;
use aviary::env::EnvError;
use aviary::policy::PolicyError;
use aviary::rollout::RolloutError;

/// What can go wrong with training.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum TrainError {
    /// An environment.
    #[error(transparent)]
    Env(#[from] EnvError),
    /// A policy.
    #[error(transparent)]
    Policy(#[from] PolicyError),
    /// An option that is impossible.
    #[error("{option} is {got}, expected {expected}")]
    Option {
        /// Which one.
        option: &'static str,
        /// What it is.
        got: String,
        /// What is possible.
        expected: &'static str,
    },
    /// Text that is no configuration in TOML.
    #[error("{message}")]
    Toml {
        /// Line, column and what was expected.
        message: String,
    },
    /// A file that the system cannot read or write.
    #[error(transparent)]
    System(#[from] SystemError),
    /// A file that cannot be read or written, or is not what it should be.
    #[error("{}: {error}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        #[source]
        error: Box<Self>,
    },
    /// Bytes that are no checkpoint.
    #[error("not a checkpoint: {message}")]
    Checkpoint {
        /// What is wrong with them.
        message: String,
    },
    /// An airframe.
    #[error(transparent)]
    Drone(#[from] DroneError),
    /// Gradients without bounds.
    #[error("the gradient is no longer a number; try a lower learning_rate or max_gradient")]
    Diverged,
}

impl From<RolloutError> for TrainError {
    fn from(error: RolloutError) -> Self {
        match error {
            RolloutError::Env(error) => error.into(),
            RolloutError::Policy(error) => error.into(),
        }
    }
}
