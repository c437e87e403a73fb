//! Batches of environments.

pub mod buffers;
mod device;
mod members;
mod outputs;

use std::sync::{Mutex, MutexGuard, TryLockError};

use aviary::env::{DroneEnv, EndReason, EnvError};
use aviary::observation::{KIN_SIZE, Observation};
use aviary::vector::{Autoreset, OnFault, VecConfig, make_vec};
use aviary::vision::ImageSize;
use numpy::{IntoPyArray as _, PyArray1, PyArray2, PyArray3, PyArrayMethods as _, PyReadonlyArray1, ToPyArray as _};
use pyo3::exceptions::{PyMemoryError, PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use self::device::Environments;
use self::members::{Members, Seeds};
use self::outputs::{Images, Outputs, StepArrays, StepMemory};
use crate::conditions;
use crate::env::{Target, battery_numbers, checked_drone, info_dict, metrics_dict, target};
use crate::error::{env_error, guard};
use crate::gil::without_gil;
use crate::memory;
use crate::options::{env_config, task_options};

/// Adds the classes and functions of this file to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add("END_REASONS", EndReason::ALL.map(EndReason::name).to_vec())?;
    module.add_class::<Batch>()
}

/// A batch of environments with the memory of its results.
///
/// An array outlives the batch. One thread at a time may use a batch. A batch exists in the process that has created
/// it: the threads of a batch do not exist in a forked child.
#[pyclass(frozen, module = "mujoco_drones_gym._native")]
pub struct Batch {
    /// Process that has created the batch.
    process: u32,
    /// Images by name.
    images: Py<PyDict>,
    inner: Mutex<Option<Inner>>,
    environments: usize,
    drones: usize,
    action_size: usize,
    device: String,
}

/// Environments of a batch and the memory of their results.
struct Inner {
    members: Members,
    outputs: Outputs,
}

/// Returns the error of an option by its name in Python.
fn option_error(error: EnvError) -> PyErr {
    match error {
        EnvError::Option { option: "environments", got, expected } => {
            PyValueError::new_err(format!("num_envs is {got}, expected {expected}"))
        }
        EnvError::Option { option: "threads", got, expected } => {
            PyValueError::new_err(format!("num_threads is {got}, expected {expected}"))
        }
        error => env_error(error),
    }
}

#[pymethods]
impl Batch {
    /// Creates a batch. `autoreset` is "next_step", "same_step" or "disabled", `on_fault` is "error" or "truncate".
    /// An episode has at most `max_episode_steps` control steps; None for the time limit of the task. With `copy`,
    /// steps and resets return new arrays, otherwise the same ones every time. `device` is "cpu", "gpu", or "gpu:" and
    /// an adapter.
    #[new]
    #[pyo3(signature = (
        task, options, num_envs, threads, autoreset, on_fault, max_episode_steps = None, copy = true, device = "cpu"
    ))]
    #[allow(clippy::too_many_arguments)]
    fn new(
        py: Python<'_>,
        task: &str,
        options: &Bound<'_, PyDict>,
        num_envs: usize,
        threads: usize,
        autoreset: &str,
        on_fault: &str,
        max_episode_steps: Option<u64>,
        copy: bool,
        device: &str,
    ) -> PyResult<Self> {
        let autoreset = match autoreset {
            "next_step" => Autoreset::NextStep,
            "same_step" => Autoreset::SameStep,
            "disabled" => Autoreset::Disabled,
            other => {
                let message =
                    format!("autoreset_mode is {other:?}, expected \"NextStep\", \"SameStep\" or \"Disabled\"");
                return Err(PyValueError::new_err(message));
            }
        };
        let on_fault = match on_fault {
            "error" => OnFault::Error,
            "truncate" => OnFault::Truncate,
            other => {
                let message = format!("on_fault is {other:?}, expected \"error\" or \"truncate\"");
                return Err(PyValueError::new_err(message));
            }
        };
        let mut config = env_config(task, options)?;
        let batch = VecConfig { threads, autoreset, on_fault, keep_observations: copy, ..VecConfig::new(num_envs) };
        let Environments { mut env, mut probe } = without_gil(py, || {
            guard(|| {
                if let Some(steps) = max_episode_steps {
                    let one = VecConfig { threads: 1, ..VecConfig::new(1) };
                    let probe = make_vec(task, config.clone(), one).map_err(option_error)?;
                    if steps != probe.episode_steps() {
                        config = config.clone().episode_seconds(steps as f64 * probe.control_period());
                    }
                }
                // the memory of a GPU is not that of the process
                let check = || if device == "cpu" { memory::check(task, &config, batch) } else { Ok(None) };
                if let Some(message) = check().map_err(option_error)? {
                    return Err(PyMemoryError::new_err(message));
                }
                device::make(device, task, config, batch, option_error)
            })
        })?;
        let (images, arrays) = Images::new(py, &*env)?;
        let outputs = Outputs::new(py, &*env, copy)?;
        let (environments, action_size, mut drones) = (env.num_envs(), env.action_size(), 0);
        let count = &mut |env: &mut dyn DroneEnv| drones = env.simulation().num_drones();
        probe.as_mut().unwrap_or(&mut env).with_env(0, count).map_err(env_error)?;
        let inner = Mutex::new(Some(Inner { members: Members::new(env, probe, images), outputs }));
        let (process, device) = (std::process::id(), device.to_string());
        Ok(Self { process, images: arrays.unbind(), inner, environments, drones, action_size, device })
    }

    /// Starts an episode in every environment, or in those of a mask, and returns the observations, float32 (num_envs,
    /// entries). `seed` is None, a seed, or a seed or None for every environment.
    #[pyo3(signature = (seed = None, mask = None))]
    fn reset<'py>(
        &self,
        py: Python<'py>,
        seed: Option<Seeds>,
        mask: Option<PyReadonlyArray1<'py, bool>>,
    ) -> PyResult<Bound<'py, PyArray2<f32>>> {
        let seeds = seed.unwrap_or(Seeds::Same(None));
        if let Seeds::Each(seeds) = &seeds
            && seeds.len() != self.environments
        {
            let (got, expected) = (seeds.len(), self.environments);
            return Err(PyValueError::new_err(format!("seed has {got} entries, expected one, or {expected}")));
        }
        let mask = match &mask {
            Some(mask) => mask.as_array().to_vec(),
            None => vec![true; self.environments],
        };
        let (arrays, ()) = self.write(py, |members, memory| members.reset(&mask, &seeds, memory))?;
        Ok(arrays.0)
    }

    /// Advances every environment by one control step. `actions` is an array of `num_envs` rows; float32 and float64
    /// are taken as they are, other types as float64. Returns observations, float32 (num_envs, entries), rewards,
    /// float32 (num_envs,), terminations and truncations, bool (num_envs,), and True if an episode has ended.
    fn step<'py>(&self, py: Python<'py>, actions: &Bound<'py, PyAny>) -> PyResult<(StepArrays<'py>, bool)> {
        buffers::with_numbers(actions, self.environments, self.action_size, |numbers| {
            self.write(py, |members, memory| members.step(numbers, memory))
        })
    }

    /// Images of the onboard cameras by name, as views of their buffers: "rgb" uint8 (num_envs, drones, height, width,
    /// 4), "depth" float32 (num_envs, drones, height, width), "segmentation" int32 (num_envs, drones, height, width,
    /// 2).
    fn images(&self, py: Python<'_>) -> Py<PyDict> {
        self.images.clone_ref(py)
    }

    /// Returns the episodes that ended in the last step: indices of the environments, successes, ends as indices of
    /// `END_REASONS`, and lengths in control steps.
    fn ends<'py>(&self, py: Python<'py>) -> PyResult<Ends<'py>> {
        self.with(py, |inner| {
            let ended = inner.ended.iter();
            let summaries = ended.filter_map(|&index| Some((index as i64, inner.env.episode_summary(index)?)));
            let mut ends = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
            for (index, summary) in summaries {
                let reason = summary.end.and_then(|end| EndReason::ALL.iter().position(|reason| *reason == end));
                ends.0.push(index);
                ends.1.push(summary.success);
                ends.2.push(reason.map_or(-1, |reason| reason as i64));
                ends.3.push(summary.steps as i64);
            }
            let (indices, successes, reasons, steps) = ends;
            Ok((indices.into_pyarray(py), successes.into_pyarray(py), reasons.into_pyarray(py), steps.into_pyarray(py)))
        })
    }

    /// Returns the last observations of the episodes that ended in the last step, float32 (indices, entries), for the
    /// indices that `ends` has returned.
    fn final_observations<'py>(
        &self,
        py: Python<'py>,
        indices: PyReadonlyArray1<'py, i64>,
    ) -> PyResult<Bound<'py, PyArray2<f32>>> {
        self.with(py, |inner| {
            let (rows, size) = (inner.env.final_observations(), inner.env.observation_size());
            let indices = indices.as_array();
            let mut numbers = Vec::with_capacity(indices.len() * size);
            for &index in indices {
                let start = usize::try_from(index).map_or(usize::MAX, |index| index.saturating_mul(size));
                let row = rows.get(start..start.saturating_add(size));
                numbers.extend_from_slice(row.ok_or_else(|| self.no_environment(index))?);
            }
            numbers.into_pyarray(py).reshape([indices.len(), size])
        })
    }

    /// Returns time (s), progress, position error (m) and crashes at the ends of the episodes that ended in the last
    /// step, for the indices that `ends` has returned; zeros for an episode that could not start. Progress and position
    /// error are NaN for environments on a GPU.
    fn final_infos<'py>(&self, py: Python<'py>, indices: PyReadonlyArray1<'py, i64>) -> PyResult<FinalInfos<'py>> {
        self.with(py, |inner| {
            let (mut numbers, mut crashes) = ([Vec::new(), Vec::new(), Vec::new()], Vec::new());
            for &index in indices.as_array() {
                let index = usize::try_from(index).ok();
                let info = index.and_then(|index| inner.env.final_info(index));
                let summary = index.and_then(|index| inner.env.episode_summary(index));
                let (values, crashed) = match (info, summary) {
                    (Some(info), _) => ([info.time, info.progress, info.position_error], info.crashed()),
                    (None, Some(summary)) if inner.probe.is_some() => {
                        let time = summary.steps as f64 * inner.env.control_period();
                        ([time, f64::NAN, f64::NAN], summary.end.is_some_and(EndReason::is_crash))
                    }
                    _ => ([0.0; 3], false),
                };
                numbers.iter_mut().zip(values).for_each(|(numbers, value)| numbers.push(value));
                crashes.push(crashed);
            }
            let [time, progress, position_error] = numbers.map(|numbers| numbers.into_pyarray(py));
            Ok((time, progress, position_error, crashes.into_pyarray(py)))
        })
    }

    /// Returns the last images of the last episode that ended in an environment, by name.
    fn final_images<'py>(&self, py: Python<'py>, index: usize) -> PyResult<Bound<'py, PyDict>> {
        self.with(py, |inner| {
            let space = inner.env.observation_space();
            let blank = || Observation::with_sizes(space.kind, 0, space.cameras, space.camera_size, 0);
            match inner.env.final_images(index) {
                Some(seen) => buffers::image_dict(py, seen, space),
                None => buffers::image_dict(py, &blank(), space),
            }
        })
    }

    /// Returns the present state of a drone, float64 (20,): position, quaternion (w, x, y, z), roll, pitch and yaw,
    /// velocity, angular velocity in the body frame, motor speeds.
    fn state<'py>(&self, py: Python<'py>, index: usize, drone: usize) -> PyResult<Bound<'py, PyArray1<f64>>> {
        self.check_drone(index, drone)?;
        self.with(py, |inner| Ok(inner.env.kinematic(index, drone).ok_or_else(unreadable)?.to_pyarray(py)))
    }

    /// Returns the present states of all drones, float64 (num_envs, drones, 20), in the layout of `state`.
    fn states<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray3<f64>>> {
        let numbers = self.work(py, |inner| {
            let mut numbers = Vec::with_capacity(self.environments * self.drones * KIN_SIZE);
            for (index, drone) in self.all_drones() {
                numbers.extend(inner.env.kinematic(index, drone).ok_or_else(unreadable)?);
            }
            Ok(numbers)
        })?;
        numbers.into_pyarray(py).reshape([self.environments, self.drones, KIN_SIZE])
    }

    /// Returns charge, voltage and current of all batteries, float64 (num_envs, drones, 3); NaN without a battery.
    fn batteries<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray3<f64>>> {
        let numbers: Vec<f64> = self.work(py, |inner| {
            Ok(self.all_drones().flat_map(|(index, drone)| battery_numbers(inner.env.battery(index, drone))).collect())
        })?;
        numbers.into_pyarray(py).reshape([self.environments, self.drones, 3])
    }

    /// Returns charge, voltage and current of the batteries of an environment, float64 (drones, 3); NaN without a
    /// battery.
    fn battery<'py>(&self, py: Python<'py>, index: usize) -> PyResult<Bound<'py, PyArray2<f64>>> {
        self.check_drone(index, 0)?;
        let numbers: Vec<f64> = self.with(py, |inner| {
            Ok((0..self.drones).flat_map(|drone| battery_numbers(inner.env.battery(index, drone))).collect())
        })?;
        numbers.into_pyarray(py).reshape([self.drones, 3])
    }

    /// Returns the parameters of a drone's airframe in the present episode of an environment, with the keys of an
    /// airframe file.
    fn drone_params<'py>(&self, py: Python<'py>, index: usize, drone: usize) -> PyResult<Bound<'py, PyAny>> {
        self.with_env(py, index, |env| {
            let drone = checked_drone(env.simulation(), drone)?;
            conditions::python_of(py, env.simulation().params(drone))
        })
    }

    /// Returns position (m), velocity (m/s) and yaw (rad) of the reference of a drone in the world frame.
    fn reference<'py>(&self, py: Python<'py>, index: usize, drone: usize) -> PyResult<Target<'py>> {
        self.with_env(py, index, |env| {
            let drone = checked_drone(env.simulation(), drone)?;
            Ok(target(py, env, drone))
        })
    }

    /// Returns the terms of the rewards of the last step by name, float64 (num_envs, drones). They are NaN for an
    /// environment that has started an episode since.
    fn reward_terms<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let mut rows = Rows::new(self.environments, self.drones);
        self.each_env(py, |index, env| {
            for drone in 0..self.drones {
                for (name, value) in env.reward_terms(drone) {
                    rows.set(name, &[], index, drone, &[value]);
                }
            }
            Ok(())
        })?;
        rows.into_dict(py)
    }

    /// Returns the sampled parameters by name, float64 (num_envs, drones) or, for those with several numbers,
    /// (num_envs, drones, ...). They are NaN for an environment without randomization.
    fn sampled_params<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let mut rows = Rows::new(self.environments, self.drones);
        self.each_env(py, |index, env| {
            if let Some(sampled) = env.sampled_params() {
                for drone in 0..self.drones {
                    conditions::sampled_numbers(sampled, drone, &mut |name, shape, numbers| {
                        rows.set(name, shape, index, drone, numbers);
                    })?;
                }
            }
            Ok(())
        })?;
        rows.into_dict(py)
    }

    /// Returns the info of an environment.
    fn info<'py>(&self, py: Python<'py>, index: usize) -> PyResult<Bound<'py, PyDict>> {
        self.with_env(py, index, |env| info_dict(py, env))
    }

    /// Returns the metrics of an environment's task.
    fn metrics<'py>(&self, py: Python<'py>, index: usize) -> PyResult<Bound<'py, PyDict>> {
        self.with_env(py, index, |env| metrics_dict(py, env))
    }

    /// Sets the wind of an environment from now on; None for still air.
    fn set_wind(&self, py: Python<'_>, index: usize, wind: Option<Bound<'_, PyAny>>) -> PyResult<()> {
        let wind = wind.as_ref().map(conditions::wind).transpose()?;
        self.with_env(py, index, |env| env.set_wind(wind).map_err(env_error))
    }

    /// Sets the parameters that are sampled for every episode of an environment from its next reset on; None for none.
    fn set_randomization(&self, py: Python<'_>, index: usize, randomization: Option<Bound<'_, PyAny>>) -> PyResult<()> {
        let ranges = randomization.as_ref().map(conditions::randomization).transpose()?;
        self.with_env(py, index, |env| env.set_randomization(ranges).map_err(env_error))
    }

    /// Sets target heights of an environment from the next step on.
    fn set_task_options(&self, py: Python<'_>, index: usize, options: &Bound<'_, PyDict>) -> PyResult<()> {
        let options = task_options(options)?;
        // images may show the target
        self.with(py, |inner| {
            inner.images_are_current = false;
            Ok(())
        })?;
        self.with_env(py, index, |env| env.set_task_options(&options).map_err(env_error))
    }

    /// Returns the options of an environment's task with their present values.
    fn task_options<'py>(&self, py: Python<'py>, index: usize) -> PyResult<Bound<'py, PyAny>> {
        self.with_env(py, index, |env| conditions::python_of(py, &env.task_options()))
    }

    /// Returns the environments that failed in the last step, with their errors.
    fn faults(&self, py: Python<'_>) -> PyResult<Vec<(usize, String)>> {
        let fault = |(index, error): &(usize, EnvError)| (*index, error.to_string().replace('\n', " "));
        self.with(py, |inner| Ok(inner.env.faults().iter().map(fault).collect()))
    }

    /// Returns constants of the environments by name.
    fn constants<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let dict = PyDict::new(py);
        self.with(py, |inner| {
            dict.set_item("num_threads", inner.env.num_threads())?;
            dict.set_item("episode_steps", inner.env.episode_steps())?;
            dict.set_item("control_period", inner.env.control_period())
        })?;
        self.with_first(py, |env| {
            let simulation = env.simulation();
            dict.set_item("num_drones", simulation.num_drones())?;
            dict.set_item("sim_freq", simulation.sim_freq())?;
            dict.set_item("ctrl_freq", simulation.ctrl_freq())?;
            dict.set_item("gravity", simulation.gravity())?;
            let params = simulation.params(0);
            dict.set_item("mass", params.mass)?;
            dict.set_item("hover_rpm", params.hover_rpm())?;
            dict.set_item("max_rpm", params.max_rpm())?;
            dict.set_item("action_type", env.action_type().name())
        })?;
        Ok(dict)
    }

    /// Returns the lower and upper bounds of an environment's row of the observations, float32.
    fn observation_bounds<'py>(&self, py: Python<'py>) -> PyResult<Bounds<'py>> {
        self.with(py, |inner| {
            let (low, high) = inner.env.observation_space().row().bounds_f32();
            Ok((low.to_pyarray(py), high.to_pyarray(py)))
        })
    }

    /// Returns the lower and upper bounds of an environment's action, float32.
    fn action_bounds<'py>(&self, py: Python<'py>) -> PyResult<Bounds<'py>> {
        self.with(py, |inner| {
            let (low, high) = inner.env.action_space().bounds_f32();
            Ok((low.to_pyarray(py), high.to_pyarray(py)))
        })
    }

    /// Renders an environment for people, uint8 (height, width, 3).
    fn render<'py>(
        &self,
        py: Python<'py>,
        index: usize,
        view: &str,
        width: u32,
        height: u32,
    ) -> PyResult<Bound<'py, PyArray3<u8>>> {
        let view = view.parse().map_err(crate::error::value_error)?;
        let mut rgb = vec![0; 3 * (width as usize) * (height as usize)];
        self.work(py, |inner| {
            self.check_device(inner)?;
            let mut done = Ok(());
            let look = &mut |env: &mut dyn DroneEnv| done = env.render(view, ImageSize { width, height }, &mut rgb);
            inner.env.with_env(index, look).and(done).map_err(env_error)
        })?;
        rgb.to_pyarray(py).reshape([height as usize, width as usize, 3])
    }

    /// Returns the memory per environment, bytes.
    fn bytes_per_env(&self, py: Python<'_>) -> PyResult<usize> {
        self.with(py, |inner| Ok(inner.env.bytes_per_env()))
    }
}

/// Indices, successes, ends and lengths of the episodes that have ended.
type Ends<'py> =
    (Bound<'py, PyArray1<i64>>, Bound<'py, PyArray1<bool>>, Bound<'py, PyArray1<i64>>, Bound<'py, PyArray1<i64>>);

/// Times, progress, position errors and crashes at the ends of episodes.
type FinalInfos<'py> =
    (Bound<'py, PyArray1<f64>>, Bound<'py, PyArray1<f64>>, Bound<'py, PyArray1<f64>>, Bound<'py, PyArray1<bool>>);

/// Lower and upper bounds.
type Bounds<'py> = (Bound<'py, PyArray1<f32>>, Bound<'py, PyArray1<f32>>);

impl Batch {
    /// Returns the environments, unless another thread uses them or this process is a fork of theirs.
    fn lock(&self) -> PyResult<MutexGuard<'_, Option<Inner>>> {
        if std::process::id() != self.process {
            let message = "this batch belongs to the parent of this forked process, expected a new batch in the child";
            return Err(PyRuntimeError::new_err(message));
        }
        match self.inner.try_lock() {
            Ok(inner) => Ok(inner),
            Err(TryLockError::Poisoned(inner)) => Ok(inner.into_inner()),
            Err(TryLockError::WouldBlock) => {
                Err(PyRuntimeError::new_err("another thread uses this batch, expected one thread at a time"))
            }
        }
    }

    /// Calls a function with the environments, without the GIL.
    fn work<R: Send>(&self, py: Python<'_>, work: impl FnOnce(&mut Members) -> PyResult<R> + Send) -> PyResult<R> {
        let mut inner = self.lock()?;
        let inner = inner.as_mut().ok_or_else(gone)?;
        without_gil(py, || guard(|| work(&mut inner.members)))
    }

    /// Calls a function with the environments and the memory of their next results, without the GIL, and returns the
    /// arrays of that memory.
    fn write<'py, R: Send>(
        &self,
        py: Python<'py>,
        work: impl FnOnce(&mut Members, &mut StepMemory) -> PyResult<R> + Send,
    ) -> PyResult<(StepArrays<'py>, R)> {
        let mut inner = self.lock()?;
        let Inner { members, outputs } = inner.as_mut().ok_or_else(gone)?;
        let (arrays, memory) = outputs.next(py)?;
        let result = without_gil(py, || guard(|| work(members, memory)))?;
        Ok((arrays, result))
    }

    /// Calls a function with the environments.
    fn with<R>(&self, _: Python<'_>, look: impl FnOnce(&mut Members) -> PyResult<R>) -> PyResult<R> {
        let mut inner = self.lock()?;
        let inner = inner.as_mut().ok_or_else(gone)?;
        guard(|| look(&mut inner.members))
    }

    /// Calls a function with one environment as a single environment.
    fn with_env<R>(
        &self,
        py: Python<'_>,
        index: usize,
        look: impl FnOnce(&mut dyn DroneEnv) -> PyResult<R>,
    ) -> PyResult<R> {
        self.with(py, |inner| {
            self.check_device(inner)?;
            let (mut look, mut result) = (Some(look), None);
            let call = &mut |env: &mut dyn DroneEnv| result = look.take().map(|look| look(env));
            inner.env.with_env(index, call).map_err(env_error)?;
            result.unwrap_or_else(|| Err(gone()))
        })
    }

    /// Calls a function with the index of every environment and the environment as a single one, without the GIL.
    fn each_env(
        &self,
        py: Python<'_>,
        mut look: impl FnMut(usize, &mut dyn DroneEnv) -> PyResult<()> + Send,
    ) -> PyResult<()> {
        self.work(py, |inner| {
            self.check_device(inner)?;
            for index in 0..self.environments {
                let mut done = Ok(());
                inner.env.with_env(index, &mut |env| done = look(index, env)).map_err(env_error)?;
                done?;
            }
            Ok(())
        })
    }

    /// Returns the indices of all environments and drones.
    fn all_drones(&self) -> impl Iterator<Item = (usize, usize)> {
        let drones = self.drones;
        (0..self.environments).flat_map(move |index| (0..drones).map(move |drone| (index, drone)))
    }

    /// Returns an error if the environments are on a GPU, where only their states can be read.
    fn check_device(&self, inner: &Members) -> PyResult<()> {
        if inner.probe.is_none() {
            return Ok(());
        }
        let expected = "expected \"cpu\": an environment on a GPU gives access to its states alone";
        Err(PyValueError::new_err(format!("device is {:?}, {expected}", self.device)))
    }

    fn check_drone(&self, index: usize, drone: usize) -> PyResult<()> {
        if index < self.environments && drone < self.drones { Ok(()) } else { Err(self.no_environment(index)) }
    }

    /// Calls a function with an environment that has the constants of all.
    fn with_first<R>(&self, py: Python<'_>, look: impl FnOnce(&mut dyn DroneEnv) -> PyResult<R>) -> PyResult<R> {
        self.with(py, |inner| {
            let (mut look, mut result) = (Some(look), None);
            let call = &mut |env: &mut dyn DroneEnv| result = look.take().map(|look| look(env));
            inner.probe.as_mut().unwrap_or(&mut inner.env).with_env(0, call).map_err(env_error)?;
            result.unwrap_or_else(|| Err(gone()))
        })
    }

    fn no_environment(&self, index: impl std::fmt::Display) -> PyErr {
        PyValueError::new_err(format!(
            "environment {index} or its drone does not exist, expected an environment from 0 to {}",
            self.environments - 1
        ))
    }
}

/// Returns the error of states that a device does not return.
fn unreadable() -> PyErr {
    PyRuntimeError::new_err("the states cannot be read from the memory of the GPU")
}

/// Numbers of all drones of a batch by name.
struct Rows {
    environments: usize,
    drones: usize,
    /// Name, shape of the numbers of one drone, and the numbers of all drones; NaN where they are not set.
    named: Vec<(String, Vec<usize>, Vec<f64>)>,
}

impl Rows {
    fn new(environments: usize, drones: usize) -> Self {
        Self { environments, drones, named: Vec::new() }
    }

    /// Sets the numbers of one drone, which have a shape.
    fn set(&mut self, name: &str, shape: &[usize], index: usize, drone: usize, numbers: &[f64]) {
        let size = numbers.len();
        let place = match self.named.iter().position(|(known, ..)| known == name) {
            Some(place) => place,
            None => {
                let all = vec![f64::NAN; self.environments * self.drones * size];
                self.named.push((name.to_string(), shape.to_vec(), all));
                self.named.len() - 1
            }
        };
        let start = (index * self.drones + drone) * size;
        if let Some(row) = self.named[place].2.get_mut(start..start + size) {
            row.copy_from_slice(numbers);
        }
    }

    fn into_dict(self, py: Python<'_>) -> PyResult<Bound<'_, PyDict>> {
        let dict = PyDict::new(py);
        for (name, shape, numbers) in self.named {
            let shape: Vec<usize> = [self.environments, self.drones].into_iter().chain(shape).collect();
            dict.set_item(name, numbers.into_pyarray(py).reshape(shape)?)?;
        }
        Ok(dict)
    }
}

fn gone() -> PyErr {
    PyRuntimeError::new_err("the batch has been closed")
}

impl Drop for Batch {
    fn drop(&mut self) {
        if std::process::id() != self.process {
            // the threads exist in the parent alone, so that waiting for their end would not return
            let inner = self.inner.get_mut().unwrap_or_else(std::sync::PoisonError::into_inner);
            std::mem::forget(inner.take());
        }
    }
}
