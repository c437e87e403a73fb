//! Windows that show flights.

use std::ffi::CString;
use std::process;
use std::sync::{Mutex, PoisonError};

use pyo3::exceptions::PyUserWarning;
use pyo3::prelude::*;
use viewer::{Source, Viewer, ViewerError, ViewerOptions};

use crate::env::Env;
use crate::error::{guard, viewer_error};
use crate::gil::without_gil;
use crate::multi_agent::Parallel;

/// Adds the classes and functions of this file to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<Window>()?;
    module.add_function(wrap_pyfunction!(close_windows, module)?)
}

/// Closes all windows and waits until their resources are released. The package calls it before the process ends.
#[pyfunction]
fn close_windows(py: Python<'_>) {
    without_gil(py, viewer::close_windows);
}

/// A window that shows the flight of an environment.
#[pyclass(module = "mujoco_drones_gym._native")]
pub struct Window {
    // the mutex makes the class `Sync`; every method has exclusive access and never locks. `None` after `close`
    viewer: Mutex<Option<Viewer>>,
    /// Process that opened the window.
    process: u32,
}

#[pymethods]
impl Window {
    /// Opens a window for an `Env` or a `Parallel` that has been reset.
    #[new]
    fn new(py: Python<'_>, env: &Bound<'_, PyAny>, title: String) -> PyResult<Self> {
        let options = ViewerOptions { title, ..ViewerOptions::default() };
        let viewer = with_source(py, env, |source| match source {
            Source::Env(env) => Viewer::open(env, options),
            Source::Simulation(simulation) => Viewer::open_simulation(simulation, options),
        })?;
        Ok(Self { viewer: Mutex::new(Some(viewer.map_err(viewer_error)?)), process: process::id() })
    }

    /// Shows the present state. Returns False after the window was closed. A broken connection is a `UserWarning`.
    fn sync(&mut self, py: Python<'_>, env: &Bound<'_, PyAny>) -> PyResult<bool> {
        if self.is_forked() {
            return Err(viewer_error(ViewerError::Forked));
        }
        let Some(viewer) = self.viewer() else { return Ok(false) };
        let shown = with_source(py, env, |source| match source {
            Source::Env(env) => viewer.sync(env),
            Source::Simulation(simulation) => viewer.sync_simulation(simulation),
        })?;
        match shown {
            Ok(is_open) => Ok(is_open),
            Err(error) => {
                let message = CString::new(format!("{error}; the flight continues without a window"))?;
                PyErr::warn(py, &py.get_type::<PyUserWarning>(), &message, 1)?;
                Ok(false)
            }
        }
    }

    /// Closes the window.
    fn close(&mut self, py: Python<'_>) {
        without_gil(py, || self.end());
    }
}

impl Window {
    fn is_forked(&self) -> bool {
        self.process != process::id()
    }

    fn viewer(&mut self) -> &mut Option<Viewer> {
        self.viewer.get_mut().unwrap_or_else(PoisonError::into_inner)
    }

    fn end(&mut self) {
        let is_forked = self.is_forked();
        let viewer = self.viewer().take();
        if is_forked {
            // a thread of the parent may have held the locks of the window during the fork
            std::mem::forget(viewer);
        }
    }
}

impl Drop for Window {
    fn drop(&mut self) {
        self.end();
    }
}

/// Calls a function with an `Env` or a `Parallel`, without the GIL.
fn with_source<T: Send>(
    py: Python<'_>,
    env: &Bound<'_, PyAny>,
    function: impl FnOnce(Source<'_>) -> T + Send,
) -> PyResult<T> {
    if let Ok(env) = env.cast::<Env>() {
        let mut env = env.try_borrow_mut()?;
        let env = env.env();
        // `DroneEnv` is not `Sync`: the closures own the exclusive reference
        return without_gil(py, move || guard(move || Ok(function(Source::Env(&*env)))));
    }
    let parallel = env.cast::<Parallel>()?;
    parallel.get().work(py, |env| Ok(function(Source::Simulation(env.simulation()))))
}
