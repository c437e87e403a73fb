//! Wind, obstacles, randomization and curricula: their options as Python dicts, wind fields and layouts of obstacles.

use aviary::drone::DroneParams;
use aviary::env::{Randomization, SampledParams};
use aviary::physics::wind::{WindConfig, WindField as Field};
use aviary::state::DroneState;
use aviary::world::ObstacleConfig;
use aviary::wrappers::{Curriculum as Levels, CurriculumConfig, CurriculumState};
use numpy::{PyArray1, PyReadonlyArray1, PyReadonlyArray2};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{PyBool, PyDict, PyFloat, PyInt, PyList, PyString, PyTuple};
use serde::Serialize;
use serde::de::DeserializeOwned;
use toml::Value;

use crate::control::{airframe, vector};
use crate::error::{guard, value_error};

/// Adds the classes and functions of this file to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<WindField>()?;
    module.add_class::<Curriculum>()?;
    module.add_function(wrap_pyfunction!(complete_options, module)?)?;
    module.add_function(wrap_pyfunction!(generate_obstacles, module)?)
}

/// Reads the options of a wind.
pub fn wind(options: &Bound<'_, PyAny>) -> PyResult<WindConfig> {
    let config: WindConfig = section("wind", options)?;
    config.validate().map_err(value_error)?;
    Ok(config)
}

/// Reads the options of generated obstacles.
pub fn obstacles(options: &Bound<'_, PyAny>) -> PyResult<ObstacleConfig> {
    let config: ObstacleConfig = section("obstacles", options)?;
    config.validate().map_err(value_error)?;
    Ok(config)
}

/// Reads the ranges of a randomization.
pub fn randomization(options: &Bound<'_, PyAny>) -> PyResult<Randomization> {
    let config: Randomization = section("randomization", options)?;
    config.validate().map_err(value_error)?;
    Ok(config)
}

fn curriculum(options: &Bound<'_, PyAny>) -> PyResult<CurriculumConfig> {
    let config: CurriculumConfig = section("curriculum", options)?;
    config.validate().map_err(value_error)?;
    Ok(config)
}

/// Validates the options of a section (`wind`, `obstacles`, `randomization` or `curriculum`) and returns them with
/// the defaults of all missing options.
#[pyfunction]
fn complete_options<'py>(section: &str, options: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
    let py = options.py();
    match section {
        "wind" => python_of(py, &wind(options)?),
        "obstacles" => python_of(py, &obstacles(options)?),
        "randomization" => python_of(py, &randomization(options)?),
        "curriculum" => python_of(py, &curriculum(options)?),
        _ => Err(value_error(format_args!(
            "section is {section}, expected wind, obstacles, randomization or curriculum"
        ))),
    }
}

/// Generates a layout of obstacles for drones that start at these positions (n × 3, world frame, m).
#[pyfunction]
fn generate_obstacles<'py>(
    options: &Bound<'py, PyAny>,
    starts: PyReadonlyArray2<'py, f64>,
) -> PyResult<Bound<'py, PyAny>> {
    let starts: Vec<[f64; 3]> = match starts.as_array().shape() {
        &[_, 3] => starts.as_array().rows().into_iter().map(|row| [row[0], row[1], row[2]]).collect(),
        shape => return Err(value_error(format_args!("starts has the shape {shape:?}, expected (n, 3)"))),
    };
    let config = obstacles(options)?;
    let layout = guard(|| config.first_layout(&starts).map_err(value_error))?;
    python_of(options.py(), &layout)
}

/// Wind at one drone.
#[pyclass(module = "mujoco_drones_gym._native")]
struct WindField {
    field: Field,
}

#[pymethods]
impl WindField {
    #[new]
    fn new(options: &Bound<'_, PyAny>, airframe_of: &Bound<'_, PyAny>, seed: u64) -> PyResult<Self> {
        let drone: DroneParams = airframe(airframe_of)?;
        let mut field = Field::new(wind(options)?, &[drone]).map_err(value_error)?;
        field.reset(seed, &[]);
        Ok(Self { field })
    }

    /// Restarts the wind.
    fn reset(&mut self, seed: u64) {
        self.field.reset(seed, &[]);
    }

    /// Advances the wind by `dt` seconds and returns the force on the drone (world frame, N) and the velocity of the
    /// air (world frame, m/s).
    #[allow(clippy::type_complexity)]
    fn advance<'py>(
        &mut self,
        py: Python<'py>,
        dt: f64,
        position: PyReadonlyArray1<'py, f64>,
        velocity: PyReadonlyArray1<'py, f64>,
    ) -> PyResult<(Bound<'py, PyArray1<f64>>, Bound<'py, PyArray1<f64>>)> {
        if !(0.0..=1.0).contains(&dt) {
            return Err(value_error(format_args!("dt is {}, expected 0 to 1 s", aviary::number(dt))));
        }
        let state = DroneState {
            position: vector("position", &position)?.into(),
            velocity: vector("velocity", &velocity)?.into(),
            ..DroneState::default()
        };
        let (force, air) = guard(|| Ok(self.field.advance(dt, 0, &state)))?;
        Ok((PyArray1::from_slice(py, force.as_slice()), PyArray1::from_slice(py, air.as_slice())))
    }

    /// Returns the complete state as text.
    fn to_json(&self) -> PyResult<String> {
        serde_json::to_string(&self.field).map_err(value_error)
    }

    /// Restores a state of [`to_json`](Self::to_json).
    #[staticmethod]
    fn from_json(text: &str) -> PyResult<Self> {
        Ok(Self { field: serde_json::from_str(text).map_err(value_error)? })
    }
}

/// Level of difficulty that follows the mean of a metric over episodes.
#[pyclass(module = "mujoco_drones_gym._native")]
struct Curriculum {
    levels: Levels,
}

#[pymethods]
impl Curriculum {
    #[new]
    fn new(options: &Bound<'_, PyAny>) -> PyResult<Self> {
        Ok(Self { levels: Levels::new(curriculum(options)?).map_err(value_error)? })
    }

    /// Level from 0.
    #[getter]
    fn level(&self) -> usize {
        self.levels.level()
    }

    /// Mean of the metric over the last episodes on this level; `None` before the first episode.
    #[getter]
    fn mean(&self) -> Option<f64> {
        self.levels.mean()
    }

    /// Records the end of an episode.
    fn episode_ended(&mut self, success: bool, reward: f64, steps: u64) -> PyResult<()> {
        if !reward.is_finite() {
            return Err(value_error(format_args!(
                "the sum of the rewards is {}, expected a finite number",
                aviary::number(reward)
            )));
        }
        self.levels.episode_ended(success, reward, steps);
        Ok(())
    }

    /// Returns the state as a dict.
    fn state<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        python_of(py, self.levels.state())
    }

    /// Restores an earlier state.
    fn restore(&mut self, state: &Bound<'_, PyAny>) -> PyResult<()> {
        let state: CurriculumState = section("state", state)?;
        self.levels.restore_state(state).map_err(value_error)
    }
}

/// Function that gets a name, the shape of the numbers, and the numbers.
pub type NumberReport<'a> = dyn FnMut(&str, &[usize], &[f64]) + 'a;

/// Reports the sampled numbers of a drone by name, with their shapes: those of the drone and those of the environment.
/// The names have dots, as in `actuators.lag`.
pub fn sampled_numbers(sampled: &SampledParams, drone: usize, report: &mut NumberReport<'_>) -> PyResult<()> {
    let mut report_all = |table: Value| {
        if let Value::Table(table) = table {
            table.iter().for_each(|(name, value)| report_numbers(name, value, report));
        }
    };
    if let Some(drone) = sampled.drones.get(drone) {
        report_all(Value::try_from(drone).map_err(value_error)?);
    }
    let shared = SampledParams { drones: Vec::new(), ..sampled.clone() };
    report_all(Value::try_from(shared).map_err(value_error)?);
    Ok(())
}

fn report_numbers(name: &str, value: &Value, report: &mut NumberReport<'_>) {
    if let Value::Table(table) = value {
        table.iter().for_each(|(key, value)| report_numbers(&format!("{name}.{key}"), value, report));
        return;
    }
    let (mut shape, mut numbers) = (Vec::new(), Vec::new());
    collect_numbers(value, 0, &mut shape, &mut numbers);
    if !numbers.is_empty() {
        report(name, &shape, &numbers);
    }
}

/// Appends the numbers of nested arrays; `shape` gets the lengths of the arrays, and `depth` is that of the value.
fn collect_numbers(value: &Value, depth: usize, shape: &mut Vec<usize>, numbers: &mut Vec<f64>) {
    match value {
        Value::Float(number) => numbers.push(*number),
        Value::Integer(number) => numbers.push(*number as f64),
        Value::Array(values) => {
            if shape.len() == depth {
                shape.push(values.len());
            }
            values.iter().for_each(|value| collect_numbers(value, depth + 1, shape, numbers));
        }
        _ => {}
    }
}

/// Converts a value to Python.
pub fn python_of<'py>(py: Python<'py>, value: &impl Serialize) -> PyResult<Bound<'py, PyAny>> {
    to_python(py, &Value::try_from(value).map_err(value_error)?)
}

fn to_python<'py>(py: Python<'py>, value: &Value) -> PyResult<Bound<'py, PyAny>> {
    Ok(match value {
        Value::String(text) => PyString::new(py, text).into_any(),
        Value::Integer(number) => number.into_pyobject(py)?.into_any(),
        Value::Float(number) => PyFloat::new(py, *number).into_any(),
        Value::Boolean(flag) => PyBool::new(py, *flag).to_owned().into_any(),
        Value::Datetime(time) => PyString::new(py, &time.to_string()).into_any(),
        Value::Array(values) => {
            let values = values.iter().map(|value| to_python(py, value)).collect::<PyResult<Vec<_>>>()?;
            PyList::new(py, values)?.into_any()
        }
        Value::Table(table) => {
            let dict = PyDict::new(py);
            for (key, value) in table {
                dict.set_item(key, to_python(py, value)?)?;
            }
            dict.into_any()
        }
    })
}

/// Reads a section of options from a Python dict. Its errors have one line with the name of the option.
pub fn section<T: DeserializeOwned>(name: &str, options: &Bound<'_, PyAny>) -> PyResult<T> {
    let value = from_python(name, options, 0)?;
    if !value.is_table() {
        let got = shown(options);
        return Err(value_error(format_args!("{name} is {got}, expected a dict of options")));
    }
    value.try_into().map_err(|error: toml::de::Error| {
        // without a text, the error ends in a line with the path of the option
        let display = error.to_string();
        let path = display.lines().last().and_then(|line| line.strip_prefix("in `")?.strip_suffix('`'));
        let option = path.map_or_else(|| name.to_string(), |path| format!("{name}.{path}"));
        let message = match error.message() {
            // all names that are possible
            text if text.starts_with("unknown ") => with_suggestion(text),
            _ => aviary::toml_message("", &error),
        };
        let message = match message.strip_prefix("invalid type: ").or(message.strip_prefix("invalid value: ")) {
            Some(rest) => format!("{option} is {}", without_type(rest)),
            None => format!("{option}: {message}"),
        };
        value_error(message)
    })
}

/// Returns a message of serde about an unknown name with the most similar one of the names that are possible.
fn with_suggestion(message: &str) -> String {
    let line = message.split_whitespace().collect::<Vec<_>>().join(" ");
    // serde quotes the unknown name and then every known one
    let quoted: Vec<_> = line.split('`').skip(1).step_by(2).collect();
    let near = quoted.split_first().map_or_else(String::new, |(name, names)| aviary::did_you_mean(name, names));
    line + &near
}

/// Returns a message of serde about a value of a wrong type without the name of this type and its quotes.
fn without_type(message: &str) -> String {
    for kind in ["floating point `", "integer `", "boolean `"] {
        if let Some((value, rest)) = message.strip_prefix(kind).and_then(|rest| rest.split_once('`')) {
            return format!("{value}{rest}");
        }
    }
    message.strip_prefix("string ").unwrap_or(message).to_string()
}

/// Largest number of nested lists, dicts, arrays and enums in an option.
const MAX_DEPTH: usize = 16;

/// Converts plain Python values: numbers, strings, lists, tuples, dicts, arrays and enums. `None` in a dict is a
/// missing option. `depth` is the number of values that contain this one: a value that contains itself is an error.
fn from_python(name: &str, value: &Bound<'_, PyAny>, depth: usize) -> PyResult<Value> {
    if depth > MAX_DEPTH {
        let option = name.split('.').next().unwrap_or(name);
        return Err(value_error(format_args!(
            "{option} has more than {MAX_DEPTH} levels of lists and dicts, expected at most {MAX_DEPTH}"
        )));
    }
    if let Ok(flag) = value.cast::<PyBool>() {
        Ok(Value::Boolean(flag.is_true()))
    } else if let Ok(number) = value.cast::<PyInt>() {
        let number = number.extract::<i64>();
        number
            .map(Value::Integer)
            .map_err(|_| value_error(format_args!("{name} is {}, expected a whole number below 2^63", shown(value))))
    } else if let Ok(number) = value.cast::<PyFloat>() {
        Ok(Value::Float(number.extract()?))
    } else if let Ok(text) = value.cast::<PyString>() {
        Ok(Value::String(text.extract()?))
    } else if let Ok(dict) = value.cast::<PyDict>() {
        let mut table = toml::Table::new();
        for (key, value) in dict.iter() {
            let Ok(key) = key.extract::<String>() else {
                return Err(value_error(format_args!("a key of {name} is {}, expected a string", shown(&key))));
            };
            if !value.is_none() {
                let value = from_python(&format!("{name}.{key}"), &value, depth + 1)?;
                table.insert(key, value);
            }
        }
        Ok(Value::Table(table))
    } else if value.cast::<PyList>().is_ok() || value.cast::<PyTuple>().is_ok() {
        let values = value.try_iter()?.map(|value| from_python(name, &value?, depth + 1));
        Ok(Value::Array(values.collect::<PyResult<_>>()?))
    } else if let Ok(plain) = value.call_method0("tolist") {
        // arrays and scalars of numpy
        from_python(name, &plain, depth + 1)
    } else if let Ok(own) = value.getattr("value") {
        // enums
        from_python(name, &own, depth + 1)
    } else {
        Err(PyValueError::new_err(format!("{name} is {}, expected a number, a string, a list or a dict", shown(value))))
    }
}

/// Returns a Python value as error messages print it.
fn shown(value: &Bound<'_, PyAny>) -> String {
    let text = value.repr().map_or_else(|_| "a value without a text".into(), |text| text.to_string());
    let line = text.split_whitespace().collect::<Vec<_>>().join(" ");
    if line.chars().count() > 60 { line.chars().take(59).chain(['…']).collect() } else { line }
}
