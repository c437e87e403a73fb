//! Environments with one agent per drone.

use std::sync::{Mutex, TryLockError};

use aviary::env::ObservationSpace;
use aviary::multi_agent::{AgentInfo, AgentMap, ParallelEnv, make_parallel};
use aviary::observation::{KIN_SIZE, Observation, kinematic};
use aviary::vision::ImageSize;
use numpy::{PyArray1, PyArray2, PyArray3, PyArrayMethods as _, ToPyArray as _};
use pyo3::exceptions::{PyKeyError, PyRuntimeError};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::conditions;
use crate::env::{battery_rows, checked_drone, metrics_dict, terms_dict};
use crate::error::{env_error, guard, value_error};
use crate::gil::without_gil;
use crate::options::env_config;
use crate::vector::buffers::{image_dict, to_vec};

/// Adds the classes and functions of this file to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<Parallel>()
}

/// An environment with one agent per drone. One thread at a time may use it.
#[pyclass(frozen, module = "mujoco_drones_gym._native")]
pub struct Parallel {
    env: Mutex<Box<dyn ParallelEnv + Send>>,
}

/// Observations and infos by agent.
type Reset<'py> = (Bound<'py, PyDict>, Bound<'py, PyDict>);

/// Observations, rewards, ends by the task, ends by the time limit and infos by agent.
type Step<'py> = (Bound<'py, PyDict>, Bound<'py, PyDict>, Bound<'py, PyDict>, Bound<'py, PyDict>, Bound<'py, PyDict>);

/// Lower and upper bounds.
type Bounds<'py> = (Bound<'py, PyArray1<f32>>, Bound<'py, PyArray1<f32>>);

#[pymethods]
impl Parallel {
    /// Creates an environment.
    #[new]
    fn new(py: Python<'_>, task: &str, options: &Bound<'_, PyDict>) -> PyResult<Self> {
        let config = env_config(task, options)?;
        let env = without_gil(py, || guard(|| make_parallel(task, config).map_err(env_error)))?;
        Ok(Self { env: Mutex::new(env) })
    }

    /// Starts an episode. Returns the observations and the infos by agent. An observation is a dict of its parts: "kin"
    /// float32 (entries,), "rgb" uint8 (1, height, width, 4), "depth" float32 (1, height, width), "segmentation" int32
    /// (1, height, width, 2).
    #[pyo3(signature = (seed = None))]
    fn reset<'py>(&self, py: Python<'py>, seed: Option<u64>) -> PyResult<Reset<'py>> {
        let (observations, infos) = self.work(py, |env| env.reset(seed).map_err(env_error))?;
        Ok((self.observations(py, &observations)?, info_dicts(py, &infos)?))
    }

    /// Advances the environment by one control step with an action for every live agent. Returns dicts by agent: the
    /// observations, the rewards, the ends by the task, the ends by the time limit, and the infos.
    fn step<'py>(&self, py: Python<'py>, actions: &Bound<'py, PyDict>) -> PyResult<Step<'py>> {
        let action = |(agent, action): (Bound<'py, PyAny>, Bound<'py, PyAny>)| {
            Ok((agent.extract::<String>()?.into(), to_vec(&action)?))
        };
        let actions: AgentMap<Vec<f64>> = actions.iter().map(action).collect::<PyResult<_>>()?;
        let step = self.work(py, |env| env.step(&actions).map_err(env_error))?;
        Ok((
            self.observations(py, &step.observations)?,
            dict(py, &step.rewards)?,
            dict(py, &step.terminated)?,
            dict(py, &step.truncated)?,
            info_dicts(py, &step.infos)?,
        ))
    }

    /// Names of all agents.
    #[getter]
    fn possible_agents(&self, py: Python<'_>) -> PyResult<Vec<String>> {
        self.work(py, |env| Ok(env.possible_agents().iter().map(ToString::to_string).collect()))
    }

    /// Names of the live agents.
    #[getter]
    fn agents(&self, py: Python<'_>) -> PyResult<Vec<String>> {
        self.work(py, |env| Ok(env.agents().iter().map(ToString::to_string).collect()))
    }

    /// Returns the lower and upper bounds of the part "kin" of an agent's observation, float32.
    fn observation_bounds<'py>(&self, py: Python<'py>, agent: &str) -> PyResult<Bounds<'py>> {
        let (low, high) = self.work(py, |env| {
            let space = env.observation_space(agent).ok_or_else(|| unknown(agent))?;
            Ok(space.row().bounds_f32())
        })?;
        Ok((low.to_pyarray(py), high.to_pyarray(py)))
    }

    /// Returns the lower and upper bounds of an agent's action, float32.
    fn action_bounds<'py>(&self, py: Python<'py>, agent: &str) -> PyResult<Bounds<'py>> {
        let (low, high) = self.work(py, |env| {
            let space = env.action_space(agent).ok_or_else(|| unknown(agent))?;
            Ok(space.bounds_f32())
        })?;
        Ok((low.to_pyarray(py), high.to_pyarray(py)))
    }

    /// Returns the shapes of the images in an agent's observation by name.
    fn image_shapes<'py>(&self, py: Python<'py>, agent: &str) -> PyResult<Bound<'py, PyDict>> {
        let (env, dict) = (self.lock()?, PyDict::new(py));
        let space = env.observation_space(agent).ok_or_else(|| unknown(agent))?;
        if let Some(shape) = space.rgb_shape() {
            dict.set_item("rgb", shape)?;
        }
        if let Some(shape) = space.depth_shape() {
            dict.set_item("depth", shape)?;
        }
        if let Some(shape) = space.segmentation_shape() {
            dict.set_item("segmentation", shape)?;
        }
        Ok(dict)
    }

    /// Returns the states of all drones, float64 (12 per drone,): position, roll, pitch and yaw, velocity, and angular
    /// velocity in the body frame.
    fn state<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray1<f64>>> {
        Ok(self.work(py, |env| Ok(env.state()))?.to_pyarray(py))
    }

    /// Returns the states of all drones, float64 (N, 20).
    fn states<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let env = self.lock()?;
        let simulation = env.simulation();
        let drones = simulation.states().iter().zip(simulation.motor_speeds());
        let numbers: Vec<f64> = drones.flat_map(|(state, speeds)| kinematic(state, speeds)).collect();
        numbers.to_pyarray(py).reshape([simulation.num_drones(), KIN_SIZE])
    }

    /// Returns charge, voltage and current of all batteries, float64 (N, 3); NaN without a battery.
    fn batteries<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        battery_rows(py, self.lock()?.simulation())
    }

    /// Returns the parameters of a drone's airframe in this episode, with the keys of an airframe file.
    fn drone_params<'py>(&self, py: Python<'py>, drone: usize) -> PyResult<Bound<'py, PyAny>> {
        let env = self.lock()?;
        let simulation = env.simulation();
        conditions::python_of(py, simulation.params(checked_drone(simulation, drone)?))
    }

    /// Returns the terms of the reward of a drone in the last step by name; none before the first step.
    fn reward_terms<'py>(&self, py: Python<'py>, drone: usize) -> PyResult<Bound<'py, PyDict>> {
        let env = self.lock()?;
        terms_dict(py, env.drone_env(), checked_drone(env.simulation(), drone)?)
    }

    /// Returns the scalar metrics of the task by name.
    fn metrics<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        metrics_dict(py, self.lock()?.drone_env())
    }

    /// Sets the wind from now on; None for still air.
    fn set_wind(&self, wind: Option<Bound<'_, PyAny>>) -> PyResult<()> {
        let wind = wind.as_ref().map(conditions::wind).transpose()?;
        self.lock()?.drone_env_mut().set_wind(wind).map_err(env_error)
    }

    /// Sets the parameters that are sampled from the next reset on; None for nominal values.
    fn set_randomization(&self, randomization: Option<Bound<'_, PyAny>>) -> PyResult<()> {
        let randomization = randomization.as_ref().map(conditions::randomization).transpose()?;
        self.lock()?.drone_env_mut().set_randomization(randomization).map_err(env_error)
    }

    /// Returns the sampled parameters of this episode; None without randomization.
    fn sampled_params<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyAny>>> {
        let env = self.lock()?;
        env.drone_env().sampled_params().map(|sampled| conditions::python_of(py, sampled)).transpose()
    }

    /// Returns constants of the environment by name.
    fn constants<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let dict = PyDict::new(py);
        let env = self.lock()?;
        dict.set_item("episode_steps", env.episode_steps())?;
        let simulation = env.simulation();
        dict.set_item("num_drones", simulation.num_drones())?;
        dict.set_item("sim_freq", simulation.sim_freq())?;
        dict.set_item("ctrl_freq", simulation.ctrl_freq())?;
        dict.set_item("action_type", env.drone_env().action_type().name())?;
        dict.set_item("gravity", simulation.gravity())?;
        let params = simulation.params(0);
        dict.set_item("mass", params.mass)?;
        dict.set_item("hover_rpm", params.hover_rpm())?;
        dict.set_item("max_rpm", params.max_rpm())?;
        Ok(dict)
    }

    /// Renders the environment for people, uint8 (height, width, 3).
    fn render<'py>(&self, py: Python<'py>, view: &str, width: u32, height: u32) -> PyResult<Bound<'py, PyArray3<u8>>> {
        let view = view.parse().map_err(value_error)?;
        let mut rgb = vec![0; 3 * (width as usize) * (height as usize)];
        self.work(py, |env| env.render(view, ImageSize { width, height }, &mut rgb).map_err(env_error))?;
        rgb.to_pyarray(py).reshape([height as usize, width as usize, 3])
    }
}

impl Parallel {
    /// Returns the environment, unless another thread uses it.
    fn lock(&self) -> PyResult<std::sync::MutexGuard<'_, Box<dyn ParallelEnv + Send>>> {
        match self.env.try_lock() {
            Ok(env) => Ok(env),
            Err(TryLockError::Poisoned(env)) => Ok(env.into_inner()),
            Err(TryLockError::WouldBlock) => {
                Err(PyRuntimeError::new_err("another thread uses this environment, expected one thread at a time"))
            }
        }
    }

    /// Calls a function with the environment, without the GIL.
    pub fn work<R: Send>(
        &self,
        py: Python<'_>,
        work: impl FnOnce(&mut (dyn ParallelEnv + Send)) -> PyResult<R> + Send,
    ) -> PyResult<R> {
        let mut env = self.lock()?;
        let env = &mut **env;
        without_gil(py, || guard(|| work(env)))
    }

    /// Returns the parts of the observations by agent.
    fn observations<'py>(&self, py: Python<'py>, map: &AgentMap<Observation>) -> PyResult<Bound<'py, PyDict>> {
        let (env, dict) = (self.lock()?, PyDict::new(py));
        for (agent, observation) in map.iter() {
            let space = env.observation_space(agent).ok_or_else(|| unknown(agent))?;
            let parts = image_dict(py, observation, space)?;
            let row = row(observation, space);
            if !row.is_empty() {
                parts.set_item("kin", row.to_pyarray(py))?;
            }
            dict.set_item(&**agent, parts)?;
        }
        Ok(dict)
    }
}

/// Returns the numbers of an observation: the vector, the obstacle distance, the ranges and the adjacency.
fn row(observation: &Observation, space: &ObservationSpace) -> Vec<f32> {
    let adjacency = observation.adjacency.iter().map(|&near| f64::from(u8::from(near)));
    let numbers = observation.vector.iter().chain(&observation.obstacle).chain(&observation.ranges).copied();
    let numbers: Vec<f64> = numbers.chain(adjacency).collect();
    let mut row = vec![0.0; numbers.len()];
    space.row().write_f32(&numbers, &mut row);
    row
}

/// Returns values by agent.
fn dict<'py, V: IntoPyObject<'py> + Copy>(py: Python<'py>, map: &AgentMap<V>) -> PyResult<Bound<'py, PyDict>> {
    let dict = PyDict::new(py);
    for (agent, value) in map.iter() {
        dict.set_item(&**agent, *value)?;
    }
    Ok(dict)
}

fn info_dicts<'py>(py: Python<'py>, map: &AgentMap<AgentInfo>) -> PyResult<Bound<'py, PyDict>> {
    let dict = PyDict::new(py);
    for (agent, info) in map.iter() {
        let own = PyDict::new(py);
        own.set_item("time", info.time)?;
        own.set_item("success", info.success)?;
        own.set_item("progress", info.progress)?;
        own.set_item("position_error", info.position_error)?;
        own.set_item("crashed", info.end.is_some_and(|end| end.is_crash()))?;
        if let Some(end) = info.end {
            own.set_item("end", end.name())?;
            own.set_item("is_success", info.success && !end.is_crash())?;
        }
        dict.set_item(&**agent, own)?;
    }
    Ok(dict)
}

fn unknown(agent: &str) -> PyErr {
    PyKeyError::new_err(format!("no agent {agent:?}, expected drone0, drone1, ..."))
}
