//! Trained policies.

use aviary::policy::{PolicyError, PolicyNetwork};
use numpy::{PyArray1, PyReadonlyArray1};
use pyo3::exceptions::PyOSError;
use pyo3::prelude::*;
use pyo3::types::PyBytes;

use crate::conditions::python_of;
use crate::error::{guard, value_error};
use crate::gil::without_gil;

/// Adds the classes and functions of this file to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<Policy>()
}

/// Array of numbers in single precision.
type Numbers<'py> = Bound<'py, PyArray1<f32>>;

/// A policy of `aviary train`.
#[pyclass(module = "mujoco_drones_gym._native", frozen)]
struct Policy {
    network: PolicyNetwork,
}

/// Converts an error: an error of the system to the `OSError` of its kind, other errors to `ValueError`.
fn policy_error(error: PolicyError) -> PyErr {
    if let PolicyError::File { error: inner, .. } = &error
        && let PolicyError::System(system) = &**inner
    {
        let kind = system.kind();
        return match kind {
            // the conversion of these kinds expects an interrupted call or a socket
            std::io::ErrorKind::Interrupted | std::io::ErrorKind::WouldBlock => PyOSError::new_err(error.to_string()),
            _ => std::io::Error::new(kind, error.to_string()).into(),
        };
    }
    value_error(error)
}

#[pymethods]
impl Policy {
    /// Reads a file.
    #[new]
    fn new(path: std::path::PathBuf) -> PyResult<Self> {
        Ok(Self { network: PolicyNetwork::load(path).map_err(policy_error)? })
    }

    /// Reads the bytes of a file.
    #[staticmethod]
    fn from_bytes(bytes: &[u8]) -> PyResult<Self> {
        Ok(Self { network: PolicyNetwork::from_bytes(bytes).map_err(policy_error)? })
    }

    /// Returns the bytes of a file.
    fn to_bytes<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyBytes>> {
        Ok(PyBytes::new(py, &self.network.to_bytes().map_err(policy_error)?))
    }

    /// Size of an observation, or of that of one drone.
    #[getter]
    fn observation_size(&self) -> usize {
        self.network.observation_size()
    }

    /// Size of an action, or of that of one drone.
    #[getter]
    fn action_size(&self) -> usize {
        self.network.action_size()
    }

    /// Size of the memory, or of that of one drone; 0 for a policy without memory.
    #[getter]
    fn memory_size(&self) -> usize {
        self.network.memory_size()
    }

    /// Metadata as a dict.
    fn info<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        python_of(py, self.network.info())
    }

    /// Computes the actions for concatenated observations and concatenated memories. Returns the actions and the next
    /// memories.
    fn act<'py>(
        &self,
        py: Python<'py>,
        observations: PyReadonlyArray1<'py, f64>,
        memories: PyReadonlyArray1<'py, f32>,
    ) -> PyResult<(Numbers<'py>, Numbers<'py>)> {
        let (inputs, outputs) = (self.network.observation_size(), self.network.action_size());
        let observations = observations.as_slice().map_err(value_error)?;
        let count = observations.len() / inputs;
        if observations.len() != count * inputs {
            return Err(value_error(format_args!(
                "observation has {} numbers, expected a multiple of {inputs}",
                observations.len()
            )));
        }
        let mut memories = memories.as_slice().map_err(value_error)?.to_vec();
        if memories.len() != count * self.network.memory_size() {
            return Err(value_error(format_args!(
                "state has {} numbers, expected {}",
                memories.len(),
                count * self.network.memory_size()
            )));
        }
        let mut actions = vec![0.0; count * outputs];
        if count > 0 {
            guard(|| {
                without_gil(py, || self.network.forward_with(observations, &mut memories, &mut actions));
                Ok(())
            })?;
        }
        // the bounds and outputs are single precision, so that this conversion is exact
        let actions = PyArray1::from_iter(py, actions.into_iter().map(|x| x as f32));
        Ok((actions, PyArray1::from_vec(py, memories)))
    }
}
