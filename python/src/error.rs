//! Errors of the simulator as Python exceptions of one line.

use std::panic::{AssertUnwindSafe, catch_unwind};

use aviary::env::EnvError;
use pyo3::exceptions::{PyRuntimeError, PyValueError};
use pyo3::prelude::*;

pyo3::create_exception!(_native, NotReset, PyRuntimeError, "The environment must be reset first.");

/// Adds the classes and functions of this file to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add("NotReset", module.py().get_type::<NotReset>())
}

/// Converts an error of an environment.
#[allow(dead_code)]
pub fn env_error(error: EnvError) -> PyErr {
    value_error(error)
}

/// Converts an error about an argument into a `ValueError` of one line.
#[allow(dead_code)]
pub fn value_error(error: impl std::fmt::Display) -> PyErr {
    PyValueError::new_err(error.to_string().replace('\n', " "))
}

/// Calls a function and turns its panic into a `RuntimeError`.
#[allow(dead_code)]
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
