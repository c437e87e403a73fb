//! Options that several commands share, and what they stand for.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use anyhow::anyhow;
use aviary::action::ActionType;
use aviary::control::trajectory::{self, Trajectory};
use aviary::control::{CollisionCone, ControllerKind};
use aviary::drone::{DroneModel, DroneParams};
use aviary::engine::{BuildError, EngineKind};
use aviary::env::{ConditionChoice, Conditions, Env, EnvConfig, EnvError, Randomization};
use aviary::physics::Physics;
use aviary::physics::wind::WindModel;
use aviary::tasks::{self, Antipodal, Hover, TaskSummary};
use aviary::vision::ImageSize;
use aviary::world::ObstacleKind;
use aviary::wrappers::SafetyWrapper;
use clap::builder::{PossibleValue, StringValueParser, TypedValueParser};
use clap::{Arg, Args, Command, ValueHint};

use crate::failure::Failure;

/// Obstacles that can be asked for by name: all but a list of one's own.
fn obstacle_kinds() -> Vec<ObstacleKind> {
    ObstacleKind::ALL.into_iter().filter(|&kind| kind != ObstacleKind::Custom).collect()
}

/// Names that a shell completes. What is not one of them is accepted, too: it may be a file, and what is wrong is said where the
/// name is looked up.
#[derive(Debug, Clone)]
pub struct Names(pub fn() -> Vec<&'static str>);

impl TypedValueParser for Names {
    type Value = String;

    fn parse_ref(&self, command: &Command, argument: Option<&Arg>, value: &OsStr) -> Result<String, clap::Error> {
        StringValueParser::new().parse_ref(command, argument, value)
    }

    fn possible_values(&self) -> Option<Box<dyn Iterator<Item = PossibleValue> + '_>> {
        Some(Box::new((self.0)().into_iter().map(PossibleValue::new)))
    }
}

/// What a flight is flown under.
#[derive(Debug, Clone, Args)]
pub struct ConditionOptions {
    /// Wind: none, constant, gust, dryden, sinusoidal, combined
    #[arg(
        long,
        value_parser = Names(|| WindModel::ALL.map(WindModel::name).to_vec()),
        hide_possible_values = true
    )]
    pub wind: Option<String>,
    /// Obstacles: forest, urban, indoor, random, gates
    #[arg(
        long,
        value_parser = Names(|| obstacle_kinds().iter().map(|kind| kind.name()).collect()),
        hide_possible_values = true
    )]
    pub obstacles: Option<String>,
    /// TOML file with sections [wind], [obstacles] and [randomization]; --wind and --obstacles choose the kind in them
    #[arg(long, value_hint = ValueHint::FilePath)]
    pub config: Option<PathBuf>,
}

impl ConditionOptions {
    /// Wind, obstacles and randomization, obstacles where a seed has them.
    pub fn read(&self, seed: u64) -> Result<Conditions, Failure> {
        let mut conditions =
            self.read_with(|path, choice| Conditions::from_file_with(path, choice).map_err(Failure::input))?;
        if let Some(obstacles) = &mut conditions.obstacles {
            obstacles.seed.get_or_insert(seed);
        }
        Ok(conditions)
    }

    /// Wind, obstacles and randomization, with a reader for the file of --config, of the kinds that --wind and --obstacles choose.
    pub fn read_with(
        &self,
        read: impl FnOnce(&Path, &ConditionChoice) -> Result<Conditions, Failure>,
    ) -> Result<Conditions, Failure> {
        let kinds = obstacle_kinds();
        let mut choice = ConditionChoice::default();
        if let Some(name) = &self.wind {
            choice.wind = Some(named("wind", name, &WindModel::ALL.map(WindModel::name))?);
        }
        if let Some(name) = &self.obstacles {
            one_of("obstacles", name, &kinds.iter().map(|kind| kind.name()).collect::<Vec<_>>())?;
            choice.obstacles = kinds.into_iter().find(|kind| kind.name() == name);
        }
        match &self.config {
            Some(path) => read(path, &choice),
            None => Conditions::from_toml_with("", &choice).map_err(Failure::input),
        }
    }
}

/// Differences between the episodes of one command.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Variation {
    /// True if episodes start from sampled states.
    pub starts: bool,
    /// True if episodes have sampled layouts of the obstacles.
    pub layouts: bool,
}

impl Variation {
    /// Episodes differ only in what a task or a configuration file samples.
    pub const NONE: Self = Self { starts: false, layouts: false };

    /// Names, for `--vary`.
    pub const NAMES: [&'static str; 4] = ["all", "starts", "layouts", "none"];

    /// The variation of a name.
    pub fn named(name: &str) -> Result<Self, Failure> {
        one_of("vary", name, &Self::NAMES)?;
        let has = |part| name == "all" || name == part;
        Ok(Self { starts: has("starts"), layouts: has("layouts") })
    }

    /// Adds it to conditions that do not say otherwise.
    fn apply(self, conditions: &mut Conditions, task: &str) -> Result<(), Failure> {
        let mut placed = conditions.obstacles.as_mut().filter(|obstacles| obstacles.kind != ObstacleKind::Custom);
        if let Some(obstacles) = &mut placed {
            obstacles.new_layout |= self.layouts;
        }
        // the drones of antipodal start close to their safety radius
        let starts = self.starts && task != "antipodal";
        if starts {
            let randomization = conditions.randomization.get_or_insert(Randomization::NONE);
            randomization.initial.get_or_insert_default();
            return Ok(());
        }
        // of all there may be one without the other
        match (self.starts, self.layouts) {
            (false, true) if placed.is_none() => Err(Failure::input(anyhow!(
                "--vary is `layouts`, but no obstacles are placed at random; expected --obstacles, or [obstacles] in --config"
            ))),
            (true, false) => Err(Failure::input(anyhow!(
                "--vary is `starts`, but the drones of {task} start from their places on a circle; expected layouts or none"
            ))),
            _ => Ok(()),
        }
    }
}

/// Which flight it is.
#[derive(Debug, Clone, Args)]
pub struct FlightOptions {
    /// Task to fly; `aviary tasks` lists them
    #[arg(long, value_parser = Names(|| tasks::NAMES.to_vec()), hide_possible_values = true)]
    pub task: String,
    /// Airframe: cf2x, cf2p, race, or a TOML file with one of your own
    #[arg(long, default_value = "cf2x", value_parser = Names(|| DroneModel::ALL.map(DroneModel::name).to_vec()), hide_possible_values = true)]
    pub drone: String,
    /// Physics mode: mjc, mjc_gnd, mjc_drag, mjc_dw, mjc_gnd_drag_dw, dyn
    #[arg(
        long,
        default_value = "mjc",
        value_parser = Names(|| Physics::ALL.map(Physics::name).to_vec()),
        hide_possible_values = true
    )]
    pub physics: String,
    /// Engine: mujoco, or hybrid, which gives the same flight many times faster
    #[arg(long, default_value = "mujoco", value_parser = Names(|| EngineKind::ALL.map(EngineKind::name).to_vec()), hide_possible_values = true)]
    pub engine: String,
    /// Controller: pid (the paper's), dsl (stiffer, for waypoints), geometric (stiffest); by default the task's, and geometric
    /// for trajectories and, in place of pid, in wind
    #[arg(long, value_parser = Names(|| ControllerKind::ALL.map(ControllerKind::name).to_vec()), hide_possible_values = true)]
    pub controller: Option<String>,
    /// Number of drones; the task's by default
    #[arg(long, allow_negative_numbers = true)]
    pub num_drones: Option<usize>,
    /// Trajectory to follow in place of the task's own target: circle (upright, 0.3 m), lemniscate, helix, square, loop, or a TOML
    /// file.
    /// The flight starts at rest where it starts, and lasts as long as it does
    #[arg(long, value_parser = Names(|| trajectory::NAMES.to_vec()), hide_possible_values = true)]
    pub trajectory: Option<String>,
    #[command(flatten)]
    conditions: ConditionOptions,
    /// Simulated seconds of an episode; the task's or the trajectory's by default
    #[arg(long, allow_negative_numbers = true)]
    pub duration: Option<f64>,
    /// Physics rate, Hz, a multiple of the control rate
    #[arg(long, default_value_t = 240, allow_negative_numbers = true)]
    pub sim_freq: u32,
    /// Control rate, Hz
    #[arg(long, default_value_t = 48, allow_negative_numbers = true)]
    pub ctrl_freq: u32,
    /// Seed of everything random: equal seeds give equal files
    #[arg(long, default_value_t = 0, allow_negative_numbers = true)]
    pub seed: u64,
}

impl FlightOptions {
    /// The task's summary.
    fn summary(&self) -> Result<TaskSummary, Failure> {
        one_of("task", &self.task, &tasks::NAMES)?;
        tasks::summary(&self.task).ok_or_else(|| Failure::input(anyhow!("--task is `{}`", self.task)))
    }

    /// The controller's kind.
    pub fn controller(&self) -> Result<ControllerKind, Failure> {
        match &self.controller {
            Some(name) => named("controller", name, &ControllerKind::ALL.map(ControllerKind::name)),
            // a trajectory wants its derivatives followed
            None if self.trajectory.is_some() => Ok(ControllerKind::Geometric),
            None => {
                let default = self.summary()?.defaults.controller;
                // the paper's PID drifts tens of centimetres in gusts, and its integral is slow to carry a steady wind
                let windy = || {
                    let conditions = self.conditions.read(self.seed)?;
                    let drawn = conditions.randomization.is_some_and(|randomization| randomization.draws_wind());
                    Ok(drawn || conditions.wind.is_some_and(|wind| !wind.is_calm()))
                };
                Ok(if default == ControllerKind::Pid && windy()? { ControllerKind::Geometric } else { default })
            }
        }
    }

    /// What to follow in place of the task's own reference.
    pub fn trajectory(&self) -> Result<Option<Box<dyn Trajectory>>, Failure> {
        let Some(name) = &self.trajectory else { return Ok(None) };
        if self.summary()?.name != "hover" {
            return Err(Failure::input(anyhow!(
                "--trajectory goes with --task hover, whose target it replaces, not with `{}`",
                self.task
            )));
        }
        if Path::new(name).extension().is_some_and(|extension| extension == "toml") {
            return trajectory::from_file(name).map(Some).map_err(Failure::input);
        }
        one_of_or_file("--trajectory", name, &trajectory::NAMES)?;
        Ok(trajectory::named(name))
    }

    /// The environment they describe.
    pub fn environment(
        &self,
        trajectory: Option<&dyn Trajectory>,
        variation: Variation,
    ) -> Result<Box<dyn Env>, Failure> {
        let summary = self.summary()?;
        let mut conditions = self.conditions.read(self.seed)?;
        variation.apply(&mut conditions, summary.name)?;
        let physics = named::<Physics>("physics", &self.physics, &Physics::ALL.map(Physics::name))?;
        let mut config = EnvConfig::default()
            .drone(drone("--drone", &self.drone)?)
            .physics(physics)
            .engine(named("engine", &self.engine, &EngineKind::ALL.map(EngineKind::name))?)
            .sim_freq(self.sim_freq)
            .ctrl_freq(self.ctrl_freq)
            .conditions(&conditions);
        if let Some(count) = self.num_drones {
            config = config.num_drones(count);
        }
        if let Some(seconds) = self.duration.or(trajectory.map(Trajectory::duration)) {
            config = config.episode_seconds(seconds);
        }
        let env = match (trajectory, summary.name) {
            (Some(trajectory), _) => {
                let start = trajectory.start();
                config
                    .with_task(Hover::default())
                    .initial_positions([start.position.into()])
                    .initial_rpys([[0.0, 0.0, start.yaw]])
                    // a trajectory may go upside down, and as high as it likes
                    .task(|hover| (hover.crash.max_tilt, hover.max_height) = (std::f64::consts::PI, f64::INFINITY))
                    .build()
                    .map(|env| Box::new(env) as Box<dyn Env>)
            }
            (None, "antipodal") => antipodal(config, self.controller()?),
            (None, name) => tasks::make(name, config).map(|env| env as Box<dyn Env>),
        };
        env.map_err(|error| match (&error, self.duration) {
            (EnvError::Option { option: "the length of an episode", expected, .. }, Some(seconds)) => {
                Failure::input(anyhow!("--duration is {seconds} s, expected {expected}"))
            }
            _ => Failure::input(error),
        })
    }
}

/// Most drones that the built-in pilot of antipodal brings to their goals.
const MAX_SWAPPING: usize = 16;

/// Velocities behind a safety filter, which is what the task is for.
fn antipodal(config: EnvConfig, controller: ControllerKind) -> Result<Box<dyn Env>, EnvError> {
    let response = match controller {
        ControllerKind::Pid => 0.9,
        ControllerKind::Dsl => 5.0,
        ControllerKind::Geometric => 10.0,
    };
    let task = Antipodal::default();
    // a drone has somewhat left of the way to its setpoint when the filter speaks
    let filter = CollisionCone::new(1.2 * task.safety_radius);
    let env = config.with_task(task).action_type(ActionType::Vel).controller(controller).build()?;
    let drones = env.simulation().num_drones();
    if drones > MAX_SWAPPING {
        return Err(EnvError::Option {
            option: "--num-drones",
            got: drones.to_string(),
            expected: "at most 16 with the built-in pilot of antipodal, which more drones bring to a stop in the middle",
        });
    }
    Ok(Box::new(SafetyWrapper::new(env, filter)?.response(response)?))
}

/// A built-in airframe by name, or one from a file.
pub fn drone(option: &str, name: &str) -> Result<DroneParams, Failure> {
    if let Ok(model) = name.parse::<DroneModel>() {
        return Ok(model.params());
    }
    if Path::new(name).extension().is_some_and(|extension| extension == "toml") {
        return DroneParams::from_file(name).map_err(Failure::input);
    }
    let models: Vec<_> = DroneModel::ALL.iter().map(|model| model.name()).collect();
    one_of_or_file(option, name, &models)?;
    Err(Failure::input(anyhow!("{option} is `{name}`")))
}

/// Refuses a name that is not in the list, with the nearest one that is.
pub fn one_of(option: &str, name: &str, names: &[&str]) -> Result<(), Failure> {
    one_of_with(&format!("--{option}"), name, names, "")
}

/// The same where a TOML file would do, too.
fn one_of_or_file(option: &str, name: &str, names: &[&str]) -> Result<(), Failure> {
    one_of_with(option, name, names, ", or a file whose name ends in .toml")
}

fn one_of_with(option: &str, name: &str, names: &[&str], more: &str) -> Result<(), Failure> {
    if names.contains(&name) {
        return Ok(());
    }
    let near = aviary::did_you_mean(name, names);
    Err(Failure::input(anyhow!("{option} is `{name}`, expected one of: {}{more}{near}", names.join(", "))))
}

/// A value with a name from a list.
pub fn named<T: FromStr + Copy>(option: &str, name: &str, names: &[&str]) -> Result<T, Failure> {
    one_of(option, name, names)?;
    name.parse().map_err(|_| Failure::input(anyhow!("--{option} is `{name}`, expected one of: {}", names.join(", "))))
}

/// Width and height as `640x480`.
pub fn size(text: &str) -> Result<ImageSize, String> {
    let expected = || format!("expected WIDTHxHEIGHT in pixels, each from 1 to {}", ImageSize::MAX_SIDE);
    let (width, height) = text.split_once('x').ok_or_else(expected)?;
    let side =
        |text: &str| text.parse().ok().filter(|side| (1..=ImageSize::MAX_SIDE).contains(side)).ok_or_else(expected);
    Ok(ImageSize { width: side(width)?, height: side(height)? })
}

/// A picture that cannot be drawn: the machine's fault, or that of what was asked for.
pub fn vision_failure(error: impl Into<EnvError>) -> Failure {
    let error = error.into();
    match &error {
        EnvError::Vision(BuildError::Scene(_)) => Failure::input(error),
        EnvError::Vision(BuildError::Mujoco(
            mujoco_rs::Error::GlName { .. } | mujoco_rs::Error::GlDevice { .. } | mujoco_rs::Error::Load { .. },
        )) => Failure::input(error),
        _ => Failure::work(error),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(
        wind: Option<&str>,
        obstacles: Option<&str>,
        config: Option<&str>,
        seed: u64,
    ) -> Result<Conditions, String> {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("conditions.toml");
        if let Some(text) = config {
            std::fs::write(&path, text).unwrap();
        }
        let text = |name: Option<&str>| name.map(str::to_string);
        let config = config.map(|_| path);
        let options = ConditionOptions { wind: text(wind), obstacles: text(obstacles), config };
        options.read(seed).map_err(|failure| match failure {
            Failure::Input(error) | Failure::Work(error) => error.to_string(),
        })
    }

    #[test]
    fn a_file_about_something_else_leaves_the_obstacles_as_they_are() {
        let wind = "[wind]\nmodel = \"constant\"\n";
        for kind in obstacle_kinds() {
            let alone = read(None, Some(kind.name()), None, 7).unwrap();
            assert_eq!(alone.obstacles.as_ref().unwrap().seed, Some(7));
            for text in [wind, "[obstacles]\n", "[randomization]\n"] {
                assert_eq!(read(None, Some(kind.name()), Some(text), 7).unwrap().obstacles, alone.obstacles, "{text}");
            }
            let named = format!("[obstacles]\nkind = \"{}\"\n", kind.name());
            assert_eq!(read(None, None, Some(&named), 7).unwrap().obstacles, alone.obstacles);
        }
        let given =
            read(None, Some("urban"), Some("[obstacles]\ncount = 3\nseed = 2\n"), 7).unwrap().obstacles.unwrap();
        assert_eq!((given.count, given.seed), (3, Some(2)));
    }

    #[test]
    fn options_that_contradict_the_file_are_refused() {
        let refused = |wind, obstacles, text, expected: &str| {
            let error = read(wind, obstacles, Some(text), 0).unwrap_err();
            assert!(error.contains("conditions.toml: ") && error.contains(expected), "{error}");
        };
        refused(Some("constant"), None, "[randomization.environment]\n", "the wind is constant, expected none");
        refused(Some("gust"), None, "[wind]\nmodel = \"dryden\"\n", "[wind] has model = \"dryden\"");
        refused(None, Some("urban"), "[obstacles]\nkind = \"forest\"\n", "[obstacles] has kind = \"forest\"");
        refused(None, None, "[wind]\nvelocity = [1.0, 0.0, 0.0]\n", "[wind] has no model");
        assert!(Conditions::from_toml("[wind]\nstill_air_drag = true\n").unwrap().wind.unwrap().still_air_drag);
    }
}
