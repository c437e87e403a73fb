//! Options of an environment: a Python dict of plain values to the options of the simulator.

use aviary::NamedEnum;
use aviary::action::ActionType;
use aviary::env::{EnvConfig, TaskOptions};
use aviary::observation::ObservationType;
use aviary::tasks::RaceTrack;
use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;
use pyo3::types::{PyBool, PyDict};

use crate::conditions;
use crate::control::airframe;
use crate::error::{option_error, value_error};

/// Adds the classes and functions of this file to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add("TASKS", aviary::tasks::NAMES.to_vec())?;
    module.add("TASK_OPTIONS", TaskOptions::NAMES.to_vec())
}

/// Names of the options of every task.
const NAMES: [&str; 16] = [
    "drone_model",
    "num_drones",
    "physics",
    "sim_freq",
    "ctrl_freq",
    "initial_xyzs",
    "initial_rpys",
    "obs_type",
    "act_type",
    "obstacles",
    "neighbourhood_radius",
    "episode_seconds",
    "wind",
    "randomization",
    "engine",
    "stream",
];

/// Converts the options of an environment, task options included, for `aviary::tasks::make`, `make_vec` and
/// `make_parallel`. An option that is `None` has its default. An unknown option is a `TypeError`, an invalid value a
/// `ValueError` that names the option.
pub fn env_config(task: &str, options: &Bound<'_, PyDict>) -> PyResult<EnvConfig> {
    let mut config = EnvConfig::default();
    let mut own = TaskOptions::default();
    for (key, value) in options {
        let name: String = key.extract()?;
        if value.is_none() {
            continue;
        }
        let option = Value { name: &name, value: &value };
        match &*name {
            "drone_model" => config = config.drone(airframe(&value)?),
            "num_drones" => config = config.num_drones(option.whole()?),
            "physics" => config = config.physics(option.named()?),
            "sim_freq" => config = config.sim_freq(option.whole()?),
            "ctrl_freq" => config = config.ctrl_freq(option.whole()?),
            "initial_xyzs" => config = config.initial_positions(option.triples()?),
            "initial_rpys" => config = config.initial_rpys(option.triples()?),
            "obs_type" => config = config.observation_type(option.observation_type()?),
            "act_type" => {
                let kind = match option.named()? {
                    // without a task, motor speeds are not normalized
                    ActionType::Rpm if task == aviary::tasks::BASE => ActionType::RawRpm,
                    kind => kind,
                };
                config = config.action_type(kind);
            }
            "obstacles" => config = config.obstacle_generator(conditions::obstacles(&value)?),
            "neighbourhood_radius" => config = config.neighbourhood_radius(option.number()?),
            "episode_seconds" => config = config.episode_seconds(option.number()?),
            "wind" => config = config.wind(conditions::wind(&value)?),
            "randomization" => config = config.randomization(conditions::randomization(&value)?),
            "engine" => config = config.engine(option.named()?),
            "stream" => config = config.stream(option.whole()?),
            _ => own.set(&option)?,
        }
    }
    Ok(config.task(|options| *options = own))
}

/// Reads options of a task.
pub fn task_options(options: &Bound<'_, PyDict>) -> PyResult<TaskOptions> {
    let mut own = TaskOptions::default();
    for (key, value) in options {
        if !value.is_none() {
            own.set(&Value { name: &key.extract::<String>()?, value: &value })?;
        }
    }
    Ok(own)
}

/// Sets one of the options of a task.
trait SetOption {
    fn set(&mut self, option: &Value<'_, '_>) -> PyResult<()>;
}

impl SetOption for TaskOptions {
    fn set(&mut self, option: &Value<'_, '_>) -> PyResult<()> {
        match option.name {
            "target_height" => self.target_height = Some(option.number()?),
            "target_heights" => {
                let heights = option.value.extract();
                self.target_heights = Some(heights.map_err(|_| option.wrong("a list of heights in m"))?);
            }
            "waypoints" => self.waypoints = Some(option.triples()?),
            "gates" => self.gates = Some(option.triples()?),
            "laps" => self.laps = Some(option.whole()?),
            "track" => self.track = Some(option.track()?),
            name => {
                let names: Vec<_> = NAMES.into_iter().chain(TaskOptions::NAMES).collect();
                let near = aviary::did_you_mean(name, &names);
                return Err(PyTypeError::new_err(format!("no option `{name}`, expected {}{near}", names.join(", "))));
            }
        }
        Ok(())
    }
}

/// The value of an option.
struct Value<'a, 'py> {
    name: &'a str,
    value: &'a Bound<'py, PyAny>,
}

impl Value<'_, '_> {
    /// Returns the error of a value of another kind.
    fn wrong(&self, expected: &str) -> PyErr {
        let text = self.value.repr().map_or_else(|_| "a value without a text".into(), |text| text.to_string());
        let text = text.split_whitespace().collect::<Vec<_>>().join(" ");
        let short: String = text.chars().take(80).collect();
        value_error(format_args!("{} is {short}, expected {expected}", self.name))
    }

    /// Reads the track of a race: the name of a built-in one, a TOML file, or a dict with the keys of such a file.
    fn track(&self) -> PyResult<RaceTrack> {
        let in_option = |error| option_error(self.name, &error);
        // a name or a path-like object
        if let Ok(name) = self.value.extract::<std::path::PathBuf>() {
            return RaceTrack::find(&name.to_string_lossy()).map_err(in_option);
        }
        if self.value.cast::<PyDict>().is_err() {
            return Err(self.wrong("the name of a track, a TOML file, or a dict with the keys of such a file"));
        }
        let track: RaceTrack = conditions::section(self.name, self.value)?;
        track.validate().map_err(in_option)?;
        Ok(track)
    }

    fn number(&self) -> PyResult<f64> {
        let is_number = !self.value.is_instance_of::<PyBool>();
        let number = self.value.extract().ok().filter(|_| is_number);
        number.ok_or_else(|| self.wrong("a number"))
    }

    fn whole<T: TryFrom<u64>>(&self) -> PyResult<T> {
        let is_number = !self.value.is_instance_of::<PyBool>();
        let number = self.value.extract::<u64>().ok().filter(|_| is_number).and_then(|number| T::try_from(number).ok());
        number.ok_or_else(|| self.wrong("a whole number, zero or positive"))
    }

    fn triples(&self) -> PyResult<Vec<[f64; 3]>> {
        self.value.extract().map_err(|_| self.wrong("a list of points [x, y, z]"))
    }

    fn named<T: NamedEnum>(&self) -> PyResult<T> {
        let expected = format!("one of {}", T::NAMES.join(", "));
        let name: String = self.value.extract().map_err(|_| self.wrong(&expected))?;
        name.parse().map_err(|_| self.wrong(&format!("{expected}{}", aviary::did_you_mean(&name, T::NAMES))))
    }

    fn observation_type(&self) -> PyResult<ObservationType> {
        let parts = "one or several of kin, rgb, depth, segmentation, adjacency, obstacle, ranges, joined by `_`";
        let name: Option<String> = self.value.extract().ok();
        name.and_then(|name| name.parse().ok()).ok_or_else(|| self.wrong(parts))
    }
}
