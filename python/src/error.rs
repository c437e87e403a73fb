//! Errors of the simulator as Python exceptions of one line.

use std::io::{Error as IoError, ErrorKind};
use std::panic::{AssertUnwindSafe, catch_unwind};

use aviary::env::EnvError;
use aviary::simulation::SimulationError;
use aviary::world::ObstacleGeneratorError;
use pyo3::exceptions::{PyOSError, PyRuntimeError, PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;
use pyo3::types::PyType;
use viewer::ViewerError;

/// Adds the classes and functions of this file to the module.
pub fn register(_module: &Bound<'_, PyModule>) -> PyResult<()> {
    Ok(())
}

/// Names of options in Python whose names differ from those of the simulator.
const RENAMED: [(&str, &str); 5] = [
    ("initial_positions", "initial_xyzs"),
    ("observation_type", "obs_type"),
    ("action_type", "act_type"),
    ("directory", "output_folder"),
    ("obstacle_generator", "obstacles"),
];

/// Converts an error of an environment: a `ValueError` about an argument, `ResetNeeded` outside an episode, a
/// `TypeError` for an option that the task does not have, an `OSError` of a file, or a `RuntimeError` of the
/// simulation or of a device.
pub fn env_error(error: EnvError) -> PyErr {
    let message = match innermost(&error) {
        EnvError::Field(ObstacleGeneratorError::Full { .. }) => format!("obstacles: {}", line(&error)),
        _ => line(&error),
    };
    env_error_with(&error, message)
}

/// Converts an error of an environment about an option or its file, with the name of the option.
pub fn option_error(option: &str, error: &EnvError) -> PyErr {
    env_error_with(error, format!("{option}: {}", line(error)))
}

fn env_error_with(error: &EnvError, message: String) -> PyErr {
    match innermost(error) {
        EnvError::NeedsReset { .. } => reset_needed(message),
        EnvError::TaskOption { .. } => PyTypeError::new_err(message),
        EnvError::System(error) => system_error(error.kind(), message),
        EnvError::Panicked | EnvError::Vision(_) | EnvError::Device { .. } => PyRuntimeError::new_err(message),
        EnvError::Simulation(
            SimulationError::Diverged { .. } | SimulationError::Engine { .. } | SimulationError::Stored { .. },
        ) => PyRuntimeError::new_err(message),
        _ => PyValueError::new_err(message),
    }
}

/// Converts an error of the system into the `OSError` of its kind, such as `FileNotFoundError`.
pub fn system_error(kind: ErrorKind, message: String) -> PyErr {
    match kind {
        // the conversion of these kinds expects an interrupted call or a socket
        ErrorKind::Interrupted | ErrorKind::WouldBlock => PyOSError::new_err(message),
        kind => IoError::new(kind, message).into(),
    }
}

/// Converts an error of a window into a `RuntimeError`.
pub fn viewer_error(error: ViewerError) -> PyErr {
    PyRuntimeError::new_err(line(&error))
}

/// Returns the error inside those that add the name of an environment, an agent or a file.
fn innermost(error: &EnvError) -> &EnvError {
    match error {
        EnvError::InBatch { error, .. } | EnvError::OfAgent { error, .. } | EnvError::File { error, .. } => {
            innermost(error)
        }
        error => error,
    }
}

/// Returns the message of an error on one line, with the names of the options in Python.
fn line(error: &dyn std::fmt::Display) -> String {
    let message = error.to_string().replace('\n', " ");
    for (old, new) in RENAMED {
        if let Some(rest) = message.strip_prefix(old) {
            return format!("{new}{rest}");
        }
    }
    message
}

/// Creates gymnasium's error for a step outside an episode.
fn reset_needed(message: String) -> PyErr {
    static CLASS: PyOnceLock<Py<PyType>> = PyOnceLock::new();
    Python::attach(|py| match CLASS.import(py, "gymnasium.error", "ResetNeeded") {
        Ok(class) => PyErr::from_type(class.clone(), message),
        Err(error) => error,
    })
}

/// Converts an error about an argument into a `ValueError` of one line.
pub fn value_error(error: impl std::fmt::Display) -> PyErr {
    PyValueError::new_err(line(&error))
}

/// Calls a function and turns its panic into a `RuntimeError`.
pub fn guard<T>(function: impl FnOnce() -> PyResult<T>) -> PyResult<T> {
    catch_unwind(AssertUnwindSafe(function)).unwrap_or_else(|cause| {
        let message = cause
            .downcast_ref::<String>()
            .map(String::as_str)
            .or_else(|| cause.downcast_ref::<&str>().copied())
            .unwrap_or("unknown cause");
        Err(PyRuntimeError::new_err(format!("internal error: {}", message.replace('\n', " "))))
    })
}
