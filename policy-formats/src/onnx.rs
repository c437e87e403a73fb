//! Policies as ONNX.

mod limits;
mod model;
mod reader;
mod runtime;
mod writer;

pub use reader::{ActionRange, OnnxOptions, OnnxPilot, OnnxPolicy, parse_indices};
pub use runtime::on_threads_of_the_runtime;
pub use writer::to_bytes;

/// Key of the metadata of a policy in an ONNX file: the [`PolicyInfo`](aviary::policy::PolicyInfo) as JSON.
pub const METADATA_KEY: &str = "policy";
