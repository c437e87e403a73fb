//! Options of an environment: a Python dict of plain values to the options of the simulator.

use aviary::env::EnvConfig;
use pyo3::prelude::*;
use pyo3::types::PyDict;

/// Adds the classes and functions of this file to the module.
pub fn register(_module: &Bound<'_, PyModule>) -> PyResult<()> {
    Ok(())
}

/// Converts the options of an environment, task options included, for `aviary::tasks::make`, `make_vec` and
/// `make_parallel`.
#[allow(dead_code)]
pub fn env_config(_task: &str, _options: &Bound<'_, PyDict>) -> PyResult<EnvConfig> {
    Ok(EnvConfig::default())
}
