//! Logs of flights.

use aviary::observation::kinematic;
use aviary::record::{COLUMNS, Flight, RecordError};
use numpy::{PyArray1, PyArray2};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::error::{system_error, value_error};

/// Adds the classes and functions of this file to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_function(wrap_pyfunction!(flight_columns, module)?)?;
    module.add_function(wrap_pyfunction!(read_flight, module)?)
}

/// Returns the names of the columns of a flight log up to the motor speeds.
#[pyfunction]
fn flight_columns() -> Vec<&'static str> {
    let last = COLUMNS.iter().position(|&name| name == "rpm3").map_or(COLUMNS.len(), |last| last + 1);
    COLUMNS[..last].to_vec()
}

/// Reads a flight, or an episode in the directory of an environment: a dict of arrays per drone.
#[pyfunction]
#[pyo3(signature = (path, episode = None))]
fn read_flight<'py>(
    py: Python<'py>,
    path: std::path::PathBuf,
    episode: Option<u64>,
) -> PyResult<Vec<Bound<'py, PyDict>>> {
    let flight = match episode {
        Some(episode) => Flight::read_episode(&path, episode),
        None => Flight::read(&path),
    };
    let flight = flight.map_err(|error| match &error {
        RecordError::File { error: system, .. } => system_error(system.kind(), error.to_string()),
        _ => value_error(error),
    })?;
    let drone = |samples: &Vec<aviary::record::Sample>| {
        let dict = PyDict::new(py);
        let states: Vec<_> = samples.iter().map(|s| kinematic(&s.state, &s.motor_speeds).to_vec()).collect();
        let references: Vec<_> = samples
            .iter()
            .map(|sample| match sample.reference {
                Some(([x, y, z], yaw)) => vec![x, y, z, yaw],
                None => vec![f64::NAN; 4],
            })
            .collect();
        dict.set_item("t", PyArray1::from_iter(py, samples.iter().map(|sample| sample.time)))?;
        dict.set_item("state", PyArray2::from_vec2(py, &states)?)?;
        dict.set_item("reward", PyArray1::from_iter(py, samples.iter().map(|sample| sample.reward)))?;
        dict.set_item("reference", PyArray2::from_vec2(py, &references)?)?;
        Ok(dict)
    };
    flight.drones.iter().map(drone).collect()
}
