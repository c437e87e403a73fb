//! Trained policies, their exports, and ONNX files of other trainers.

use aviary::action::ActionType;
use aviary::drone::{DroneModel, DroneParams};
use aviary::env::{BoxSpace, Env as _, EnvConfig};
use aviary::policy::{PolicyError, PolicyInfo, PolicyNetwork};
use aviary::tasks::make;
use numpy::{PyArray1, PyReadonlyArray1};
use policy_formats::c::{self, FirmwareOptions, Weights};
use policy_formats::onnx::{self, ActionRange, OnnxOptions, OnnxPolicy};
use policy_formats::{FormatError, quantization};
use pyo3::prelude::*;
use pyo3::types::PyBytes;

use crate::conditions::python_of;
use crate::control::airframe;
use crate::error::{env_error, guard, system_error, value_error};
use crate::gil::without_gil;

/// Adds the classes and functions of this file to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<Policy>()
}

/// Array of numbers in single precision.
type Numbers<'py> = Bound<'py, PyArray1<f32>>;

/// A policy of `aviary train`, or an ONNX file.
#[pyclass(module = "mujoco_drones_gym._native", frozen)]
struct Policy {
    content: Content,
}

enum Content {
    Network(Box<PolicyNetwork>),
    Onnx(Box<Onnx>),
}

/// An ONNX file with the sizes and bounds of its task.
struct Onnx {
    policy: OnnxPolicy,
    info: PolicyInfo,
    /// Sizes of an observation and of an action, or of those of one drone.
    sizes: [usize; 2],
    /// Bounds of an action, or of that of one drone, exact in single precision.
    bounds: [Vec<f64>; 2],
    has_indices: bool,
}

/// Converts an error: an error of the system to the `OSError` of its kind, other errors to `ValueError`.
fn policy_error(error: PolicyError) -> PyErr {
    if let PolicyError::File { error: inner, .. } = &error
        && let PolicyError::System(system) = &**inner
    {
        return system_error(system.kind(), error.to_string());
    }
    value_error(error)
}

/// Converts an error of a format, with the names of options in Python.
fn format_error(error: FormatError) -> PyErr {
    match error {
        FormatError::Unsupported { what: "the name", got, expected } => {
            value_error(format_args!("name is {got}, expected {expected}"))
        }
        error => value_error(error),
    }
}

/// Options of an ONNX file.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
struct Declarations {
    task: Option<String>,
    drone: Option<String>,
    action_type: Option<String>,
    sim_freq: Option<u32>,
    ctrl_freq: Option<u32>,
    observation_indices: Option<String>,
    action_range: Option<String>,
    action_output: Option<String>,
}

impl Declarations {
    fn options(&self) -> PyResult<OnnxOptions> {
        let action_range = match self.action_range.as_deref() {
            None => None,
            Some("space") => Some(ActionRange::Space),
            Some("unit") => Some(ActionRange::Unit),
            Some(other) => {
                return Err(value_error(format_args!("action_range is {other:?}, expected \"space\" or \"unit\"")));
            }
        };
        let indices = self.observation_indices.as_deref().map(onnx::parse_indices);
        Ok(OnnxOptions {
            observation_indices: indices.transpose().map_err(format_error)?,
            action_range,
            action_output: self.action_output.clone(),
            any_action_type: self.action_type.is_some(),
        })
    }

    /// Returns the metadata of a file, with the options in place of its own.
    fn complete(&self, policy: &OnnxPolicy) -> PyResult<PolicyInfo> {
        let mut info = match (policy.info(), &self.task) {
            (Some(info), _) => info.clone(),
            (None, Some(task)) => PolicyInfo::of_task(task),
            (None, None) => {
                return Err(value_error("task is None, expected the name of a task: the file has no metadata"));
            }
        };
        if policy.info().is_some()
            && let Some(task) = &self.task
        {
            info.task.clone_from(task);
        }
        if let Some(drone) = &self.drone {
            info.drone.clone_from(drone);
        }
        if let Some(action_type) = &self.action_type {
            info.action_type.clone_from(action_type);
        }
        info.sim_freq = self.sim_freq.unwrap_or(info.sim_freq);
        info.ctrl_freq = self.ctrl_freq.unwrap_or(info.ctrl_freq);
        Ok(info)
    }
}

impl Onnx {
    /// Reads a file, and evaluates it once for the size of its action.
    fn new(bytes: Vec<u8>, given: &Declarations, drone: Option<DroneParams>) -> PyResult<Self> {
        let options = given.options()?;
        let policy = OnnxPolicy::from_bytes(bytes, &options).map_err(format_error)?;
        let info = given.complete(&policy)?;
        let action_type: ActionType =
            info.action_type.parse().map_err(|error| value_error(format_args!("act_type: {error}")))?;
        let known = || info.drone.parse::<DroneModel>().ok().map(DroneModel::params);
        let mut config =
            EnvConfig::default().action_type(action_type).sim_freq(info.sim_freq).ctrl_freq(info.ctrl_freq);
        if let Some(drone) = drone.or_else(known) {
            config = config.drone(drone);
        }
        if policy.info().is_some() {
            config = config.num_drones(info.num_drones);
        }
        let env = make(&info.task, config).map_err(env_error)?;
        let rows = if info.per_drone { env.simulation().num_drones() } else { 1 };
        let (observed, space) = (env.observation_space().vector.size() / rows, env.action_space());
        let components = space.size() / rows;
        let entries = policy.inputs().unwrap_or(observed);
        let has_indices = policy.has_indices();
        let observation = if has_indices { entries.max(observed) } else { entries };
        let exact = |bounds: Vec<f32>| bounds[..components].iter().copied().map(f64::from).collect();
        let mut actions = vec![0.0; components];
        let mut memory = vec![0.0; policy.memory_size()];
        let bounds = (&space.low()[..components], &space.high()[..components]);
        policy.forward(&vec![0.0; observation], 1, &mut memory, bounds, &mut actions).map_err(format_error)?;
        let (low, high) = BoxSpace::bounds_f32(space);
        Ok(Self { policy, sizes: [observation, components], bounds: [exact(low), exact(high)], has_indices, info })
    }

    fn act(&self, observations: &[f64], rows: usize, memories: &mut [f32], actions: &mut [f64]) -> PyResult<()> {
        let [low, high] = &self.bounds;
        self.policy.forward(observations, rows, memories, (low, high), actions).map_err(format_error)?;
        for (index, action) in actions.iter_mut().enumerate() {
            *action = action.clamp(low[index % low.len()], high[index % high.len()]);
        }
        Ok(())
    }
}

impl Policy {
    fn network(&self) -> PyResult<&PolicyNetwork> {
        match &self.content {
            Content::Network(network) => Ok(network),
            Content::Onnx(_) => Err(value_error("the policy is from an ONNX file, expected one of `aviary train`")),
        }
    }

    fn metadata(&self) -> &PolicyInfo {
        match &self.content {
            Content::Network(network) => network.info(),
            Content::Onnx(onnx) => &onnx.info,
        }
    }
}

#[pymethods]
impl Policy {
    /// Reads a file of `aviary train`.
    #[new]
    fn new(path: std::path::PathBuf) -> PyResult<Self> {
        Ok(Self { content: Content::Network(Box::new(PolicyNetwork::load(path).map_err(policy_error)?)) })
    }

    /// Reads the bytes of a file of `aviary train`.
    #[staticmethod]
    fn from_bytes(bytes: &[u8]) -> PyResult<Self> {
        Ok(Self { content: Content::Network(Box::new(PolicyNetwork::from_bytes(bytes).map_err(policy_error)?)) })
    }

    /// Reads the bytes of an ONNX file. `declarations` is a dict of the options, each of which may be None, and
    /// `drone_model` the airframe of the bounds of the actions.
    #[staticmethod]
    fn from_onnx(
        py: Python<'_>,
        bytes: &[u8],
        declarations: &Bound<'_, PyAny>,
        drone_model: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Self> {
        let given: Declarations = declarations.extract()?;
        let drone = drone_model.map(airframe).transpose()?;
        let bytes = bytes.to_vec();
        let onnx = without_gil(py, || guard(|| Onnx::new(bytes, &given, drone)))?;
        Ok(Self { content: Content::Onnx(Box::new(onnx)) })
    }

    /// Returns the bytes of a file of `aviary train`.
    fn to_bytes<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyBytes>> {
        Ok(PyBytes::new(py, &self.network()?.to_bytes().map_err(policy_error)?))
    }

    /// Returns the files of the policy in another format, each with its path and content: "c", "crazyflie", "onnx" or
    /// "safetensors", with the weights "float32" or "int8". The path of a single file is empty. `name` is that of the
    /// C code, and `drone_model` the airframe of "crazyflie".
    fn export<'py>(
        &self,
        py: Python<'py>,
        format: &str,
        weights: &str,
        name: Option<&str>,
        drone_model: Option<&Bound<'py, PyAny>>,
    ) -> PyResult<Vec<(String, Bound<'py, PyBytes>)>> {
        let policy = self.network()?;
        let weights = match weights {
            "float32" => Weights::Float32,
            "int8" => Weights::Int8,
            other => return Err(value_error(format_args!("weights is {other:?}, expected \"float32\" or \"int8\""))),
        };
        let name = name.map_or_else(|| c::default_name(policy.info()), str::to_string);
        let one = |bytes: Vec<u8>| vec![(String::new(), PyBytes::new(py, &bytes))];
        let text = |path: String, content: String| (path, PyBytes::new(py, content.as_bytes()));
        Ok(match format {
            "c" => {
                let code = c::source(policy, &name, weights).map_err(format_error)?;
                vec![text(format!("{name}.h"), code.header), text(format!("{name}.c"), code.source)]
            }
            "crazyflie" => {
                let drone = match drone_model {
                    Some(given) => airframe(given)?,
                    None => {
                        let known = &policy.info().drone;
                        let expected = format!("expected the file of the policy's airframe `{known}`");
                        let known = known.parse::<DroneModel>();
                        known.map_err(|_| value_error(format_args!("drone_model is None, {expected}")))?.params()
                    }
                };
                // the target of the task, which its policies know
                let options = FirmwareOptions { name: &name, weights, drone: &drone, target: [0.0, 0.0, 1.0] };
                let files = c::firmware(policy, &options).map_err(format_error)?;
                files.into_iter().map(|file| text(file.path, file.content)).collect()
            }
            "onnx" => one(onnx::to_bytes(policy).map_err(format_error)?),
            "safetensors" => {
                let rounded = match weights {
                    Weights::Float32 => policy.clone(),
                    Weights::Int8 => quantization::rounded(policy).map_err(policy_error)?,
                };
                one(rounded.to_bytes().map_err(policy_error)?)
            }
            other => {
                let expected = "\"c\", \"crazyflie\", \"onnx\" or \"safetensors\"";
                return Err(value_error(format_args!("format is {other:?}, expected {expected}")));
            }
        })
    }

    /// Size of an observation, or of that of one drone.
    #[getter]
    fn observation_size(&self) -> usize {
        match &self.content {
            Content::Network(network) => network.observation_size(),
            Content::Onnx(onnx) => onnx.sizes[0],
        }
    }

    /// Size of an action, or of that of one drone.
    #[getter]
    fn action_size(&self) -> usize {
        match &self.content {
            Content::Network(network) => network.action_size(),
            Content::Onnx(onnx) => onnx.sizes[1],
        }
    }

    /// Size of the memory, or of that of one drone; 0 for a policy without memory.
    #[getter]
    fn memory_size(&self) -> usize {
        match &self.content {
            Content::Network(network) => network.memory_size(),
            Content::Onnx(onnx) => onnx.policy.memory_size(),
        }
    }

    /// True if the policy reads some entries of an observation, which may have any number of further entries.
    #[getter]
    fn selects_entries(&self) -> bool {
        matches!(&self.content, Content::Onnx(onnx) if onnx.has_indices)
    }

    /// Metadata as a dict.
    fn info<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        python_of(py, self.metadata())
    }

    /// Computes the actions for rows of concatenated observations and concatenated memories. Returns the actions and
    /// the next memories.
    fn act<'py>(
        &self,
        py: Python<'py>,
        observations: PyReadonlyArray1<'py, f64>,
        memories: PyReadonlyArray1<'py, f32>,
        rows: usize,
    ) -> PyResult<(Numbers<'py>, Numbers<'py>)> {
        let observations = observations.as_slice().map_err(value_error)?;
        let size = observations.len().checked_div(rows).unwrap_or(0);
        let fits =
            if self.selects_entries() { size >= self.observation_size() } else { size == self.observation_size() };
        if rows > 0 && !(fits && observations.len() == rows * size) {
            return Err(value_error(format_args!(
                "observation has {} numbers, expected {rows} rows of {}",
                observations.len(),
                self.observation_size()
            )));
        }
        let mut memories = memories.as_slice().map_err(value_error)?.to_vec();
        if memories.len() != rows * self.memory_size() {
            return Err(value_error(format_args!(
                "state has {} numbers, expected {}",
                memories.len(),
                rows * self.memory_size()
            )));
        }
        let mut actions = vec![0.0; rows * self.action_size()];
        if rows > 0 {
            guard(|| {
                without_gil(py, || match &self.content {
                    Content::Network(network) => {
                        network.forward_with(observations, &mut memories, &mut actions);
                        Ok(())
                    }
                    Content::Onnx(onnx) => onnx.act(observations, rows, &mut memories, &mut actions),
                })
            })?;
        }
        // the bounds and outputs are single precision, so that this conversion is exact
        let actions = PyArray1::from_iter(py, actions.into_iter().map(|x| x as f32));
        Ok((actions, PyArray1::from_vec(py, memories)))
    }
}
