//! Device of a batch: the CPU or a GPU.

use aviary::env::{EnvConfig, EnvError};
use aviary::vector::{VecConfig, VecEnv, make_vec};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

/// Environments of a batch.
pub struct Environments {
    pub env: Box<dyn VecEnv>,
    /// One environment on the CPU with the constants of all, for a batch whose environments are elsewhere.
    pub probe: Option<Box<dyn VecEnv>>,
}

/// Creates the environments of a batch on a device: "cpu", "gpu", or "gpu:" and the number or a part of the name of an
/// adapter. `option_error` converts the error of an option.
pub fn make(
    device: &str,
    task: &str,
    config: EnvConfig,
    batch: VecConfig,
    option_error: fn(EnvError) -> PyErr,
) -> PyResult<Environments> {
    let adapter = match device.split_once(':') {
        _ if device == "cpu" => {
            let env = make_vec(task, config, batch).map_err(option_error)?;
            return Ok(Environments { env, probe: None });
        }
        None if device == "gpu" => None,
        Some(("gpu", name)) if !name.is_empty() => Some(name),
        _ => {
            let message = format!("device is {device:?}, expected \"cpu\", \"gpu\" or \"gpu:\" and an adapter");
            return Err(PyValueError::new_err(message));
        }
    };
    let probe = make_vec(task, config.clone(), VecConfig { threads: 1, environments: 1, ..batch });
    let probe = Some(probe.map_err(option_error)?);
    Ok(Environments { env: on_gpu(adapter, task, config, batch)?, probe })
}

#[cfg(feature = "gpu")]
fn on_gpu(adapter: Option<&str>, task: &str, config: EnvConfig, batch: VecConfig) -> PyResult<Box<dyn VecEnv>> {
    use aviary_gpu::{GpuAviary, GpuDevice, GpuError, Precision};
    use pyo3::exceptions::PyRuntimeError;

    let error = |error: GpuError| match error {
        GpuError::Env(error) => crate::error::env_error(error),
        GpuError::Device { .. } | GpuError::NoAdapter { .. } => PyRuntimeError::new_err(error.to_string()),
        // the option has another name in Python
        other => PyValueError::new_err(other.to_string().replacen("environments is", "num_envs is", 1)),
    };
    let device = GpuDevice::open(adapter).map_err(error)?;
    Ok(Box::new(GpuAviary::make(task, config, batch, &device, Precision::Single).map_err(error)?))
}

#[cfg(not(feature = "gpu"))]
fn on_gpu(adapter: Option<&str>, _: &str, _: EnvConfig, _: VecConfig) -> PyResult<Box<dyn VecEnv>> {
    let device = adapter.map_or_else(|| "gpu".into(), |name| format!("gpu:{name}"));
    let message = format!("device is {device:?}, but this package has no GPU back end: build it with the feature gpu");
    Err(PyValueError::new_err(message))
}
