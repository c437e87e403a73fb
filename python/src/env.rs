//! Environments of a single agent.

use std::ops::{Deref, DerefMut};
use std::path::PathBuf;
use std::sync::Mutex;

use aviary::action::MotorScale;
use aviary::engine::EngineKind;
use aviary::env::{BoxSpace, DroneEnv, EnvError, EnvSnapshot};
use aviary::observation::{KIN_SIZE, Observation, kinematic};
use aviary::physics::battery::BatteryState;
use aviary::record::Recorded;
use aviary::simulation::Simulation;
use aviary::tasks::make;
use aviary::vision::{CAMERA_SIZE, ImageSize, SceneRenderer, View};
use numpy::{PyArray1, PyArray2, PyArray3, PyArrayMethods as _, ToPyArray as _};
use pyo3::exceptions::PyValueError;
use pyo3::intern;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict, PyTuple, PyType};

use crate::conditions;
use crate::error::{env_error, guard, option_error, value_error};
use crate::gil::without_gil;
use crate::options::{env_config, task_options};
use crate::vector::buffers::{Numbers, image_dict, to_vec, with_array};

/// Adds the classes and functions of this file to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<Env>()?;
    module.add_class::<Snapshot>()
}

/// Lower and upper bounds.
type Bounds<'py> = (Bound<'py, PyArray1<f32>>, Bound<'py, PyArray1<f32>>);

/// Position, velocity and yaw.
pub type Target<'py> = (Bound<'py, PyArray1<f64>>, Bound<'py, PyArray1<f64>>, f64);

/// An environment in which one agent commands all drones. One thread at a time may use it.
#[pyclass(module = "mujoco_drones_gym._native")]
pub struct Env {
    // the environment is not `Sync`; every method has exclusive access and never locks
    inner: Mutex<Inner>,
}

/// An environment whose episodes may be recorded.
enum Recordable {
    Plain(Box<dyn DroneEnv + Send>),
    Recorded(Box<Recorded<Box<dyn DroneEnv + Send>>>),
}

impl Deref for Recordable {
    type Target = dyn DroneEnv + Send;

    fn deref(&self) -> &Self::Target {
        match self {
            Self::Plain(env) => &**env,
            Self::Recorded(env) => &**env,
        }
    }
}

impl DerefMut for Recordable {
    fn deref_mut(&mut self) -> &mut Self::Target {
        match self {
            Self::Plain(env) => &mut **env,
            Self::Recorded(env) => &mut **env,
        }
    }
}

struct Inner {
    env: Recordable,
    /// Space of the numbers of an observation.
    row: BoxSpace,
    /// True if an observation is the task's vector alone.
    is_vector: bool,
    /// True if a step takes longer than the release of the GIL.
    releases_gil: bool,
    /// Observed numbers in double and in single precision.
    numbers: (Vec<f64>, Vec<f32>),
    action: Vec<f64>,
    /// Renderer of the onboard cameras, created by the first request of their images.
    cameras: Option<SceneRenderer>,
}

/// Number of drones from which on a step of the hybrid engine releases the GIL.
const MANY_DRONES: usize = 8;

impl Inner {
    fn new(env: Recordable) -> Self {
        let (space, simulation) = (env.observation_space(), env.simulation());
        let kind = space.kind;
        let row = space.row();
        let is_fast = simulation.model().engine_kind() == EngineKind::Hybrid && simulation.num_drones() < MANY_DRONES;
        Self {
            is_vector: kind.kinematic && row.size() == space.vector.size() && !kind.has_images(),
            releases_gil: !is_fast || kind.has_images() || kind.ranges,
            numbers: (Vec::with_capacity(row.size()), vec![0.0; row.size()]),
            action: Vec::with_capacity(env.action_space().size()),
            cameras: None,
            row,
            env,
        }
    }

    fn simulation(&self) -> &Simulation {
        self.env.simulation()
    }

    fn drone(&self, drone: usize) -> PyResult<usize> {
        checked_drone(self.simulation(), drone)
    }

    /// Calls a function of the environment, without the GIL if it takes long.
    fn work<T: Send>(&mut self, py: Python<'_>, function: impl FnOnce(&mut Self) -> PyResult<T> + Send) -> PyResult<T> {
        if self.releases_gil { without_gil(py, || guard(|| function(self))) } else { guard(|| function(self)) }
    }

    /// Returns the last observation: an array if it has one part, otherwise a dict of arrays.
    fn observed<'py>(&mut self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        if self.is_vector {
            let (_, row) = &mut self.numbers;
            self.row.write_f32(&self.env.observation().vector, row);
            return Ok(PyArray1::from_slice(py, row).into_any());
        }
        let parts = image_dict(py, self.env.observation(), self.env.observation_space())?;
        if self.row.size() > 0 {
            let Observation { vector, obstacle, ranges, adjacency, .. } = self.env.observation();
            let (numbers, row) = &mut self.numbers;
            numbers.clear();
            numbers.extend(vector.iter().chain(obstacle).chain(ranges).copied());
            numbers.extend(adjacency.iter().map(|&near| f64::from(u8::from(near))));
            self.row.write_f32(numbers, row);
            let kin = PyArray1::from_slice(py, row);
            if parts.is_empty() {
                return Ok(kin.into_any());
            }
            let all = PyDict::new(py);
            all.set_item(intern!(py, "kin"), kin)?;
            all.update(parts.as_mapping())?;
            return Ok(all.into_any());
        }
        if parts.len() == 1 { parts.values().get_item(0) } else { Ok(parts.into_any()) }
    }

    fn state(&self, drone: usize) -> [f64; KIN_SIZE] {
        let simulation = self.simulation();
        kinematic(&simulation.states()[drone], &simulation.motor_speeds()[drone])
    }

    /// Reads an action of any shape into `action`, in the order of its indices.
    fn read_action(&mut self, action: &Bound<'_, PyAny>) -> PyResult<()> {
        let buffer = &mut self.action;
        buffer.clear();
        let read = with_array(action, |_, numbers| {
            match numbers {
                Numbers::Single(numbers) => buffer.extend(numbers.iter().copied().map(f64::from)),
                Numbers::Double(numbers) => buffer.extend_from_slice(numbers),
            }
            Ok(())
        });
        read.map_err(|error| {
            let expected = aviary::count(self.env.action_space().size(), "number");
            value_error(format_args!("the action is not an array of numbers, expected {expected}: {error}"))
        })
    }

    /// Returns the images of the onboard cameras: RGBA, depth and segmentation, drone after drone.
    fn onboard(&mut self, size: ImageSize) -> PyResult<Observation> {
        let wrong = |error: EnvError| env_error(error);
        let simulation = self.env.simulation();
        let cameras = match &mut self.cameras {
            Some(cameras) => cameras,
            none => {
                none.insert(SceneRenderer::for_observations(simulation.world()).map_err(|error| wrong(error.into()))?)
            }
        };
        let kind = "rgb_depth_segmentation".parse().map_err(value_error)?;
        let mut images = Observation::with_sizes(kind, 0, simulation.num_drones(), size, 0);
        cameras.set_obstacles(simulation.obstacles()).map_err(|error| wrong(error.into()))?;
        cameras.set_markers(&simulation.markers()).map_err(|error| wrong(error.into()))?;
        cameras.update(simulation.states()).map_err(|error| wrong(error.into()))?;
        images.take_images(cameras, size).map_err(|error| wrong(error.into()))?;
        Ok(images)
    }
}

impl Env {
    fn inner(&mut self) -> &mut Inner {
        self.inner.get_mut().unwrap_or_else(std::sync::PoisonError::into_inner)
    }

    /// Returns the environment.
    pub fn env(&mut self) -> &mut (dyn DroneEnv + Send) {
        &mut *self.inner().env
    }
}

/// Returns the state of the episode of an environment as a dict.
pub fn info_dict<'py>(py: Python<'py>, env: &dyn DroneEnv) -> PyResult<Bound<'py, PyDict>> {
    let (info, dict) = (env.info(), PyDict::new(py));
    dict.set_item(intern!(py, "time"), info.time)?;
    dict.set_item(intern!(py, "success"), info.success)?;
    dict.set_item(intern!(py, "progress"), info.progress)?;
    dict.set_item(intern!(py, "position_error"), info.position_error)?;
    dict.set_item(intern!(py, "crashed"), info.crashed())?;
    if let Some(end) = info.end {
        dict.set_item(intern!(py, "end"), end.name())?;
        dict.set_item(intern!(py, "is_success"), info.success)?;
    }
    Ok(dict)
}

/// Converts an error of a reset, of a step or of a restored state, whose files are those of the option
/// `output_folder`.
fn flight_error(error: EnvError) -> PyErr {
    match error {
        EnvError::File { .. } => option_error("output_folder", &error),
        error => env_error(error),
    }
}

/// Returns the metrics of an environment's task by name.
pub fn metrics_dict<'py>(py: Python<'py>, env: &dyn DroneEnv) -> PyResult<Bound<'py, PyDict>> {
    let dict = PyDict::new(py);
    let mut done = Ok(());
    env.metrics(&mut |name, value| {
        if let Err(error) = dict.set_item(name, value) {
            done = Err(error);
        }
    });
    done.map(|()| dict)
}

/// Returns the terms of the reward of a drone in the last step by name.
pub fn terms_dict<'py>(py: Python<'py>, env: &dyn DroneEnv, drone: usize) -> PyResult<Bound<'py, PyDict>> {
    let dict = PyDict::new(py);
    for (name, value) in env.reward_terms(drone) {
        dict.set_item(name, value)?;
    }
    Ok(dict)
}

/// Returns position (m), velocity (m/s) and yaw (rad) of a drone's reference in the world frame.
pub fn target<'py>(py: Python<'py>, env: &dyn DroneEnv, drone: usize) -> Target<'py> {
    let reference = env.reference(drone);
    let [position, velocity] = [reference.position, reference.velocity].map(|v| v.as_slice().to_pyarray(py));
    (position, velocity, reference.yaw)
}

/// Returns the index of a drone, or an error if the simulation has fewer drones.
pub fn checked_drone(simulation: &Simulation, drone: usize) -> PyResult<usize> {
    let count = simulation.num_drones();
    if drone < count {
        return Ok(drone);
    }
    Err(PyValueError::new_err(format!("drone {drone} does not exist, expected an index from 0 to {}", count - 1)))
}

/// Returns the numbers of a battery: charge (0 to 1), voltage (V), current (A); NaN for none.
pub fn battery_numbers(battery: Option<BatteryState>) -> [f64; 3] {
    battery.map_or([f64::NAN; 3], |BatteryState { charge, voltage, current }| [charge, voltage, current])
}

/// Returns the numbers of the batteries of a simulation, float64 (N, 3).
pub fn battery_rows<'py>(py: Python<'py>, simulation: &Simulation) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let count = simulation.num_drones();
    let numbers: Vec<f64> = (0..count).flat_map(|drone| battery_numbers(simulation.battery(drone))).collect();
    numbers.to_pyarray(py).reshape([count, 3])
}

#[pymethods]
impl Env {
    /// Creates the environment of a task by name, or the one without a task, "base". `output_folder` receives the
    /// flight of every episode as CSV files.
    #[new]
    #[pyo3(signature = (task, options, output_folder = None))]
    fn new(py: Python<'_>, task: &str, options: &Bound<'_, PyDict>, output_folder: Option<PathBuf>) -> PyResult<Self> {
        let config = env_config(task, options)?;
        let env = without_gil(py, || {
            guard(|| {
                let env = make(task, config).map_err(env_error)?;
                let Some(folder) = output_folder else { return Ok(Recordable::Plain(env)) };
                let recorded = Recorded::new(env, &folder).map_err(|error| {
                    value_error(format_args!(
                        "output_folder is {}, expected a writable directory: {error}",
                        folder.display()
                    ))
                })?;
                Ok(Recordable::Recorded(Box::new(recorded)))
            })
        })?;
        Ok(Self { inner: Mutex::new(Inner::new(env)) })
    }

    /// Starts an episode. Returns the observation and the info.
    fn reset<'py>(&mut self, py: Python<'py>, seed: Option<u64>) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyDict>)> {
        let inner = self.inner();
        inner.work(py, |inner| inner.env.reset(seed).map(|_| ()).map_err(flight_error))?;
        Ok((inner.observed(py)?, info_dict(py, &*inner.env)?))
    }

    /// Advances the environment by one control step. Returns observation, reward, terminated, truncated and info.
    fn step<'py>(&mut self, py: Python<'py>, action: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyTuple>> {
        let inner = self.inner();
        inner.read_action(action)?;
        let (reward, terminated, truncated) = inner.work(py, |inner| {
            let step = inner.env.step(&inner.action).map_err(flight_error)?;
            Ok((step.reward, step.terminated, step.truncated))
        })?;
        (inner.observed(py)?, reward, terminated, truncated, info_dict(py, &*inner.env)?).into_pyobject(py)
    }

    /// Returns the last observation; zeros before the first reset.
    fn observation<'py>(&mut self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        self.inner().observed(py)
    }

    /// Returns the images of the last observation by name.
    fn images<'py>(&mut self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let inner = self.inner();
        image_dict(py, inner.env.observation(), inner.env.observation_space())
    }

    /// Returns the shapes of the images of an observation by name.
    fn image_shapes<'py>(&mut self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let (space, dict) = (self.inner().env.observation_space(), PyDict::new(py));
        let shapes = [
            ("rgb", space.rgb_shape().map(Vec::from)),
            ("depth", space.depth_shape().map(Vec::from)),
            ("segmentation", space.segmentation_shape().map(Vec::from)),
        ];
        for (name, shape) in shapes {
            if let Some(shape) = shape {
                dict.set_item(name, PyTuple::new(py, shape)?)?;
            }
        }
        Ok(dict)
    }

    /// Renders the onboard cameras of all drones in the present state. Returns a dict: "rgb" uint8 (N, 48, 64, 4),
    /// "depth" float32 (N, 48, 64), "segmentation" int32 (N, 48, 64, 2).
    fn onboard<'py>(&mut self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let inner = self.inner();
        let images = without_gil(py, || guard(|| inner.onboard(CAMERA_SIZE)))?;
        let shape = [inner.simulation().num_drones(), CAMERA_SIZE.height as usize, CAMERA_SIZE.width as usize];
        let dict = PyDict::new(py);
        dict.set_item("rgb", images.rgb.to_pyarray(py).reshape([shape[0], shape[1], shape[2], 4])?)?;
        dict.set_item("depth", images.depth.to_pyarray(py).reshape(shape)?)?;
        let pairs = images.segmentation.as_flattened().to_pyarray(py);
        dict.set_item("segmentation", pairs.reshape([shape[0], shape[1], shape[2], 2])?)?;
        Ok(dict)
    }

    /// Renders an image for people, uint8 (height, width, 3).
    fn render<'py>(
        &mut self,
        py: Python<'py>,
        view: &str,
        width: u32,
        height: u32,
    ) -> PyResult<Bound<'py, PyArray3<u8>>> {
        let view: View = view.parse().map_err(value_error)?;
        let inner = self.inner();
        let mut rgb = vec![0; 3 * width as usize * height as usize];
        let buffer = &mut rgb;
        without_gil(py, || guard(|| inner.env.render(view, ImageSize { width, height }, buffer).map_err(env_error)))?;
        rgb.to_pyarray(py).reshape([height as usize, width as usize, 3])
    }

    /// Returns the state of the episode.
    fn info<'py>(&mut self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        info_dict(py, &*self.inner().env)
    }

    /// Returns the scalar metrics of the task by name.
    fn metrics<'py>(&mut self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        metrics_dict(py, &*self.inner().env)
    }

    /// Returns the terms of the reward of a drone in the last step by name; none before the first step.
    fn reward_terms<'py>(&mut self, py: Python<'py>, drone: usize) -> PyResult<Bound<'py, PyDict>> {
        let inner = self.inner();
        let drone = inner.drone(drone)?;
        terms_dict(py, &*inner.env, drone)
    }

    /// Returns the present poses of the gates, float64 (n, 4): the centres (m, world frame) and the directions of the
    /// normals (rad); (0, 4) for a task without gates.
    fn gates<'py>(&mut self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let gates = self.inner().env.gates();
        gates.as_flattened().to_pyarray(py).reshape([gates.len(), 4])
    }

    /// Ends the files of the running episode, if the environment has an output folder.
    fn close(&mut self) {
        if let Recordable::Recorded(env) = &mut self.inner().env {
            env.end_episode();
        }
    }

    /// Returns the lower and upper bounds of the numbers of an observation; empty arrays if it has none.
    fn observation_bounds<'py>(&mut self, py: Python<'py>) -> Bounds<'py> {
        let (low, high) = self.inner().row.bounds_f32();
        (low.to_pyarray(py), high.to_pyarray(py))
    }

    /// Returns the lower and upper bounds of an action.
    fn action_bounds<'py>(&mut self, py: Python<'py>) -> Bounds<'py> {
        let (low, high) = self.inner().env.action_space().bounds_f32();
        (low.to_pyarray(py), high.to_pyarray(py))
    }

    /// Returns constants of the environment by name.
    fn constants<'py>(&mut self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let inner = self.inner();
        let (simulation, dict) = (inner.simulation(), PyDict::new(py));
        let params = simulation.params(0);
        dict.set_item("num_drones", simulation.num_drones())?;
        dict.set_item("sim_freq", simulation.sim_freq())?;
        dict.set_item("ctrl_freq", simulation.ctrl_freq())?;
        dict.set_item("control_period", simulation.control_period())?;
        dict.set_item("hover_rpm", params.hover_rpm())?;
        dict.set_item("max_rpm", params.max_rpm())?;
        dict.set_item("episode_steps", inner.env.episode_steps())?;
        dict.set_item("action_type", inner.env.action_type().name())?;
        dict.set_item("airframe", conditions::python_of(py, params)?)?;
        let starts: Vec<_> =
            simulation.initial_states().iter().map(|state| state.position.as_slice().to_vec()).collect();
        dict.set_item("initial_xyzs", PyArray2::from_vec2(py, &starts)?)?;
        let rpys: Vec<_> = simulation.initial_states().iter().map(|state| state.rpy().as_slice().to_vec()).collect();
        dict.set_item("initial_rpys", PyArray2::from_vec2(py, &rpys)?)?;
        Ok(dict)
    }

    /// Returns the state of a drone, float64 (20,).
    fn state<'py>(&mut self, py: Python<'py>, drone: usize) -> PyResult<Bound<'py, PyArray1<f64>>> {
        let inner = self.inner();
        Ok(inner.state(inner.drone(drone)?).to_pyarray(py))
    }

    /// Returns the states of all drones, float64 (N, 20).
    fn states<'py>(&mut self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let inner = self.inner();
        let count = inner.simulation().num_drones();
        let numbers: Vec<f64> = (0..count).flat_map(|drone| inner.state(drone)).collect();
        numbers.to_pyarray(py).reshape([count, KIN_SIZE])
    }

    /// Returns charge, voltage and current of all batteries, float64 (N, 3); NaN without a battery.
    fn batteries<'py>(&mut self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        battery_rows(py, self.inner().simulation())
    }

    /// Returns the rewards of the drones in the last step, float64 (N,).
    fn drone_rewards<'py>(&mut self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        let inner = self.inner();
        let rewards: Vec<f64> =
            (0..inner.simulation().num_drones()).map(|drone| inner.env.drone_reward(drone)).collect();
        rewards.to_pyarray(py)
    }

    /// Returns position (m), velocity (m/s) and yaw (rad) of a drone's reference in the world frame.
    fn reference<'py>(&mut self, py: Python<'py>, drone: usize) -> PyResult<Target<'py>> {
        let inner = self.inner();
        let drone = inner.drone(drone)?;
        Ok(target(py, &*inner.env, drone))
    }

    /// Returns the action that commands these motor speeds (rpm), of an action type that commands single motors.
    fn action_of_rpm<'py>(&mut self, py: Python<'py>, rpm: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyArray1<f64>>> {
        let (speeds, inner) = (to_vec(rpm)?, self.inner());
        let mut action = vec![0.0; inner.env.action_space().size()];
        let (speeds, []) = speeds.as_chunks() else {
            return Err(value_error(format_args!(
                "rpm has {}, expected 4 per drone",
                aviary::count(speeds.len(), "number")
            )));
        };
        inner.env.action_of_motor_speeds(speeds, &mut action).map_err(env_error)?;
        Ok(action.to_pyarray(py))
    }

    /// Returns the motor speeds (rpm) of normalized ones, an array of the same length.
    fn rpm_of_normalized<'py>(
        &mut self,
        py: Python<'py>,
        normalized: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArray1<f64>>> {
        let scale = MotorScale::new(&self.inner().simulation().world().drones[0].params);
        let speeds: Vec<_> = to_vec(normalized)?.into_iter().map(|command| scale.rpm(command)).collect();
        Ok(speeds.to_pyarray(py))
    }

    /// Returns which drones are within a radius (m) of each other, bool (N, N), false on the diagonal.
    fn adjacency<'py>(&mut self, py: Python<'py>, radius: f64) -> PyResult<Bound<'py, PyArray2<bool>>> {
        let inner = self.inner();
        let count = inner.simulation().num_drones();
        let mut matrix = vec![false; count * count];
        inner.simulation().adjacency(radius, &mut matrix);
        matrix.to_pyarray(py).reshape([count, count])
    }

    /// Returns the parameters of a drone's airframe in this episode.
    fn drone_params<'py>(&mut self, py: Python<'py>, drone: usize) -> PyResult<Bound<'py, PyAny>> {
        let inner = self.inner();
        conditions::python_of(py, inner.simulation().params(inner.drone(drone)?))
    }

    /// Returns the mass of the first drone in this episode, kg.
    fn mass(&mut self) -> f64 {
        self.inner().simulation().params(0).mass
    }

    /// Returns gravity in this episode, m/s².
    fn gravity(&mut self) -> f64 {
        self.inner().simulation().gravity()
    }

    /// Returns the obstacles at their present poses.
    fn obstacles<'py>(&mut self, py: Python<'py>) -> PyResult<Vec<Bound<'py, PyAny>>> {
        self.inner().simulation().obstacles().iter().map(|obstacle| conditions::python_of(py, obstacle)).collect()
    }

    /// Sets the wind from now on; None for still air.
    fn set_wind(&mut self, wind: Option<Bound<'_, PyAny>>) -> PyResult<()> {
        let wind = wind.as_ref().map(conditions::wind).transpose()?;
        self.inner().env.set_wind(wind).map_err(env_error)
    }

    /// Sets the parameters that are sampled from the next reset on; None for nominal values.
    fn set_randomization(&mut self, randomization: Option<Bound<'_, PyAny>>) -> PyResult<()> {
        let randomization = randomization.as_ref().map(conditions::randomization).transpose()?;
        self.inner().env.set_randomization(randomization).map_err(env_error)
    }

    /// Returns the sampled parameters of this episode; None without randomization.
    fn sampled_params<'py>(&mut self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyAny>>> {
        self.inner().env.sampled_params().map(|sampled| conditions::python_of(py, sampled)).transpose()
    }

    /// Sets target heights from the next step on.
    fn set_task_options(&mut self, options: &Bound<'_, PyDict>) -> PyResult<()> {
        let options = task_options(options)?;
        self.inner().env.set_task_options(&options).map_err(env_error)
    }

    /// Returns the options of the task with their present values.
    fn task_options<'py>(&mut self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        conditions::python_of(py, &self.inner().env.task_options())
    }

    /// Returns a snapshot of the state.
    fn snapshot(&mut self) -> Snapshot {
        Snapshot(self.inner().env.snapshot())
    }

    /// Restores a snapshot.
    fn restore(&mut self, snapshot: &Snapshot) -> PyResult<()> {
        let inner = self.inner();
        guard(|| inner.env.restore(&snapshot.0).map_err(flight_error))
    }
}

/// State of an environment. It can be pickled.
#[pyclass(frozen, module = "mujoco_drones_gym._native")]
pub struct Snapshot(EnvSnapshot);

#[pymethods]
impl Snapshot {
    /// Reads a snapshot from the bytes of `to_bytes`.
    #[classmethod]
    fn from_bytes(_class: &Bound<'_, PyType>, data: &[u8]) -> PyResult<Self> {
        serde_json::from_slice(data)
            .map(Self)
            .map_err(|error| value_error(format_args!("the snapshot is invalid: {error}")))
    }

    /// Returns the snapshot as bytes.
    fn to_bytes<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyBytes>> {
        Ok(PyBytes::new(py, &serde_json::to_vec(&self.0).map_err(value_error)?))
    }

    fn __reduce__<'py>(slf: &Bound<'py, Self>) -> PyResult<(Bound<'py, PyAny>, (Bound<'py, PyBytes>,))> {
        let py = slf.py();
        Ok((py.get_type::<Self>().getattr("from_bytes")?, (slf.get().to_bytes(py)?,)))
    }
}
