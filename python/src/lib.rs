//! The module `mujoco_drones_gym._native`: the simulator for the Python package, which is its only caller.

mod conditions;
mod control;
mod env;
mod error;
mod gil;
mod memory;
mod multi_agent;
mod options;
mod policy;
mod record;
mod vector;
mod window;

use pyo3::prelude::*;

#[pymodule]
fn _native(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    error::register(module)?;
    options::register(module)?;
    env::register(module)?;
    vector::register(module)?;
    multi_agent::register(module)?;
    control::register(module)?;
    conditions::register(module)?;
    policy::register(module)?;
    record::register(module)?;
    window::register(module)
}
