use aviary::env::EnvError;

/// Error of a batch on a GPU.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum GpuError {
    /// No GPU and no software device.
    #[error("no GPU: {api} lists no adapter on this machine, expected a driver (lavapipe runs on the CPU)")]
    NoAdapter {
        /// Programming interface that was searched.
        api: &'static str,
    },
    /// An adapter that does not exist.
    #[error("the adapter {got:?} does not exist, expected one of: {}", adapters.join(", "))]
    UnknownAdapter {
        /// Index or part of the name.
        got: String,
        /// Indices and names of the adapters.
        adapters: Vec<String>,
    },
    /// An adapter that cannot be opened.
    #[error("the adapter {adapter} cannot be opened: {message}")]
    Open {
        /// Name of the adapter.
        adapter: String,
        /// Reason.
        message: String,
    },
    /// Double precision on an adapter without it.
    #[error("the adapter {adapter} has no double precision, expected `precision` single")]
    NoDouble {
        /// Name of the adapter.
        adapter: String,
    },
    /// A batch without environments.
    #[error("environments is 0, expected at least 1")]
    NoEnvironments,
    /// A batch whose buffers exceed the limits of the adapter.
    #[error("environments is {got}, expected at most {max} on {adapter}, whose buffers have at most {bytes} bytes")]
    TooManyEnvironments {
        /// Number of environments.
        got: usize,
        /// Largest number of environments.
        max: usize,
        /// Largest buffer, bytes.
        bytes: u64,
        /// Name of the adapter.
        adapter: String,
    },
    /// An option of training whose buffers exceed the limits of the adapter.
    #[error("{option} is {got}, expected at most {max} on {adapter}, whose buffers have at most {bytes} bytes")]
    TooLarge {
        /// Name of the option.
        option: &'static str,
        /// Value of the option; for layers, their number of parameters.
        got: usize,
        /// Largest value.
        max: usize,
        /// Largest buffer, bytes.
        bytes: u64,
        /// Name of the adapter.
        adapter: String,
    },
    /// An option that the kernels do not have.
    #[error("{option} is {got}, expected {expected} on the GPU")]
    NotPorted {
        /// Name of the option.
        option: &'static str,
        /// Value of the option.
        got: String,
        /// Values that the kernels have.
        expected: &'static str,
    },
    /// A tensor of actions of another shape, or that has no memory on the device of the batch.
    #[cfg(feature = "burn")]
    #[error("actions is {got}, expected a tensor {expected}")]
    Actions {
        /// The tensor.
        got: String,
        /// Tensor that the batch needs.
        expected: String,
    },
    /// An error of the device during its work: out of memory, or no longer available.
    #[error("the GPU failed: {message}")]
    Device {
        /// Reason.
        message: String,
    },
    /// An error of the environment.
    #[error(transparent)]
    Env(#[from] EnvError),
}

impl GpuError {
    /// Creates an error from an error of the runtime, which has several lines and a backtrace.
    pub(crate) fn device(error: &impl std::fmt::Display) -> Self {
        Self::Device { message: one_line(error) }
    }
}

/// Returns the text of an error of the runtime on one line, without its backtrace.
pub(crate) fn one_line(error: &impl std::fmt::Display) -> String {
    let text = error.to_string();
    let lines = text.lines().map(str::trim).take_while(|line| !line.starts_with("Backtrace"));
    lines.filter(|line| !line.is_empty()).collect::<Vec<_>>().join(" ")
}

impl From<GpuError> for EnvError {
    fn from(error: GpuError) -> Self {
        match error {
            GpuError::Env(error) => error,
            error => Self::Device { message: error.to_string() },
        }
    }
}
