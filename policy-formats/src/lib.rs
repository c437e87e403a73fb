//! Policies for other programs, and policies of other programs.
//!
//! | format | function |
//! | --- | --- |
//! | C99, one header and one source file without dependencies | [`c::source`] |
//! | application for the firmware of a Crazyflie | [`c::firmware`] |
//! | ONNX, with the normalization in the graph | [`onnx::to_bytes`] |
//! | ONNX files of other trainers, as a policy of this simulator | [`onnx::OnnxPolicy`] |
//!
//! [`layout`] names the entries of observations and actions, and [`quantization`] rounds weights to eight bits.

pub mod c;
pub mod layout;
pub mod onnx;
pub mod quantization;

/// Error of a conversion.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum FormatError {
    /// A policy that the format cannot represent.
    #[error("{what} is {got}, expected {expected}")]
    Unsupported {
        /// Property of the policy, or option.
        what: &'static str,
        /// Its value.
        got: String,
        /// Values that the format can represent.
        expected: String,
    },
    /// A file that is not a policy, or that cannot be evaluated.
    #[error("not a policy in ONNX: {message}")]
    Onnx {
        /// Reason.
        message: String,
    },
    /// A policy that does not fit an environment.
    #[error("the policy has {policy}, the environment has {env}")]
    Mismatch {
        /// Sizes of the policy.
        policy: String,
        /// Sizes of the environment.
        env: String,
    },
    /// An error of the policy itself.
    #[error(transparent)]
    Policy(#[from] aviary::policy::PolicyError),
}

/// Returns the error of a property that a format cannot represent.
fn unsupported(what: &'static str, got: impl ToString, expected: impl ToString) -> FormatError {
    FormatError::Unsupported { what, got: got.to_string(), expected: expected.to_string() }
}
