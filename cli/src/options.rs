//! Options that several commands share, and the environments that they describe.

use std::path::{Path, PathBuf};

use anyhow::anyhow;
use aviary::action::ActionType;
use aviary::control::trajectory::{self, Trajectory};
use aviary::control::{CollisionCone, ControllerKind};
use aviary::drone::{DroneModel, DroneParams};
use aviary::engine::{BuildError, EngineKind};
use aviary::env::{ConditionChoice, Conditions, DroneEnv, EnvConfig, EnvError, Randomization};
use aviary::physics::wind::WindModel;
use aviary::physics::{Effects, Physics};
use aviary::tasks::{self, Antipodal, Hover, RaceTrack, TaskSummary};
use aviary::world::ObstacleKind;
use aviary::wrappers::SafetyWrapper;
use clap::{Args, ValueHint};

use crate::failure::Failure;
use crate::parse::{self, NameOrFile, Variation};

// not a doc comment, which would replace the description of a command: wind, obstacles and randomization
#[derive(Debug, Clone, Args)]
pub struct ConditionOptions {
    /// Wind: none, constant, gust, dryden, sinusoidal or combined
    #[arg(long, value_name = "NAME", value_parser = parse::named::<WindModel>(), hide_possible_values = true)]
    pub wind: Option<WindModel>,
    /// Obstacles: forest, urban, indoor, random or gates
    #[arg(long, value_name = "NAME", value_parser = parse::obstacles(), hide_possible_values = true)]
    pub obstacles: Option<ObstacleKind>,
    /// TOML file with [wind], [obstacles] and [randomization]
    ///
    /// --wind sets the model in [wind], --obstacles sets the kind in [obstacles].
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub config: Option<PathBuf>,
}

impl ConditionOptions {
    /// Returns true if no option is set.
    pub fn is_default(&self) -> bool {
        self.wind.is_none() && self.obstacles.is_none() && self.config.is_none()
    }

    /// Reads wind, obstacles and randomization. `seed` is that of the obstacles, unless the file sets one.
    pub fn read(&self, seed: u64) -> Result<Conditions, Failure> {
        let mut conditions =
            self.read_with(|path, choice| Conditions::from_file_with(path, choice).map_err(Failure::input))?;
        if let Some(obstacles) = &mut conditions.obstacles {
            obstacles.seed.get_or_insert(seed);
        }
        Ok(conditions)
    }

    /// Reads wind, obstacles and randomization; `read` reads the file of --config with the kinds of the other options.
    pub fn read_with(
        &self,
        read: impl FnOnce(&Path, &ConditionChoice) -> Result<Conditions, Failure>,
    ) -> Result<Conditions, Failure> {
        let choice = ConditionChoice { wind: self.wind, obstacles: self.obstacles };
        match &self.config {
            Some(path) => read(path, &choice),
            None => Conditions::from_toml_with("", &choice).map_err(Failure::input),
        }
    }
}

impl Variation {
    /// Adds the variation to conditions; values that the conditions set stay.
    fn apply(self, conditions: &mut Conditions, task: &TaskSummary) -> Result<(), Failure> {
        let mut placed = conditions.obstacles.as_mut().filter(|obstacles| obstacles.kind != ObstacleKind::Custom);
        if let Some(obstacles) = &mut placed {
            obstacles.new_layout |= self.layouts;
        }
        if self.starts && task.varied_starts {
            let randomization = conditions.randomization.get_or_insert(Randomization::NONE);
            randomization.initial.get_or_insert_default();
            return Ok(());
        }
        // `all` varies what the task allows
        match (self.starts, self.layouts) {
            (false, true) if placed.is_none() => Err(Failure::input(anyhow!(
                "--vary is `layouts`, expected --obstacles or [obstacles] of a random kind in --config"
            ))),
            (true, false) => Err(Failure::input(anyhow!(
                "--vary is `starts`, expected layouts or none in {}, whose starts are fixed",
                task.name
            ))),
            _ => Ok(()),
        }
    }
}

// not a doc comment, which would replace the description of a command: options of a flight
#[derive(Debug, Clone, Args)]
pub struct FlightOptions {
    /// Task to fly; `aviary tasks` lists them
    #[arg(long, value_name = "NAME", value_parser = parse::task(), hide_possible_values = true)]
    pub task: TaskSummary,
    /// Airframe: cf2x, cf2p, race, cf21 or a TOML file
    ///
    /// `aviary airframe` checks a file.
    #[arg(
        long,
        value_name = "NAME",
        default_value = "cf2x",
        value_parser = parse::airframe(),
        hide_possible_values = true
    )]
    pub drone: NameOrFile<DroneModel>,
    /// Physics mode: mjc, mjc_gnd, mjc_drag, mjc_dw, mjc_gnd_drag_dw, dyn
    ///
    /// A physics mode is the name of an engine and its aerodynamic effects in the paper. The
    /// default is mjc.
    #[arg(
        long,
        verbatim_doc_comment,
        value_name = "NAME",
        value_parser = parse::named::<Physics>(),
        hide_possible_values = true
    )]
    pub physics: Option<Physics>,
    /// Aerodynamic effects: ground, drag, downwash or none
    ///
    /// Names are separated by commas. The default is the effects of --physics.
    #[arg(long, value_name = "LIST", value_parser = parse::effects(), hide_possible_values = true)]
    pub effects: Option<Effects>,
    /// Engine: mujoco, hybrid or explicit
    ///
    /// `hybrid` computes the same flight as `mujoco` many times faster. `explicit` has no
    /// contacts and is the engine of --physics dyn. The default is the engine of --physics.
    #[arg(
        long,
        verbatim_doc_comment,
        value_name = "NAME",
        value_parser = parse::named::<EngineKind>(),
        hide_possible_values = true
    )]
    pub engine: Option<EngineKind>,
    /// Controller: pid, dsl or geometric
    ///
    /// `pid` is the paper's controller, `dsl` is stiffer and suits waypoints, `geometric` is
    /// the stiffest. The default is the controller of the task; `geometric` replaces it with
    /// --trajectory, and replaces `pid` in wind.
    #[arg(
        long,
        verbatim_doc_comment,
        value_name = "NAME",
        value_parser = parse::named::<ControllerKind>(),
        hide_possible_values = true
    )]
    pub controller: Option<ControllerKind>,
    /// Number of drones [default: the task's]
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    pub num_drones: Option<usize>,
    /// Trajectory: circle, lemniscate, helix, square, loop or a TOML file
    ///
    /// The trajectory replaces the target of the hover task. The flight begins at rest at the
    /// start of the trajectory and lasts as long as the trajectory. The circle is vertical,
    /// with a radius of 0.3 m.
    #[arg(
        long,
        verbatim_doc_comment,
        value_name = "NAME",
        value_parser = parse::trajectory(),
        hide_possible_values = true
    )]
    pub trajectory: Option<NameOrFile<&'static str>>,
    /// Track of race: figure_eight, stacked, oval or a TOML file
    ///
    /// A track has the gates, the laps, and whether the gates are solid, change in every episode
    /// or move. The default is the six gates of the task, which do not collide.
    #[arg(
        long,
        verbatim_doc_comment,
        value_name = "NAME",
        value_parser = parse::track(),
        hide_possible_values = true
    )]
    pub track: Option<NameOrFile<&'static str>>,
    #[command(flatten)]
    conditions: ConditionOptions,
    /// Length of an episode, s [default: the task's]
    ///
    /// With --trajectory, the default is the length of the trajectory.
    #[arg(long, value_name = "S", allow_negative_numbers = true)]
    pub duration: Option<f64>,
    /// Physics rate, Hz; a multiple of the control rate
    #[arg(long, value_name = "HZ", default_value_t = 240, allow_negative_numbers = true)]
    pub sim_freq: u32,
    /// Control rate, Hz
    #[arg(long, value_name = "HZ", default_value_t = 48, allow_negative_numbers = true)]
    pub ctrl_freq: u32,
    /// Seed of all random numbers
    ///
    /// Equal seeds give equal output files.
    #[arg(long, value_name = "N", default_value_t = 0, allow_negative_numbers = true)]
    pub seed: u64,
}

impl FlightOptions {
    /// Returns the kind of controller.
    pub fn controller(&self) -> Result<ControllerKind, Failure> {
        match self.controller {
            Some(kind) => Ok(kind),
            // only the geometric controller follows the derivatives of a trajectory
            None if self.trajectory.is_some() => Ok(ControllerKind::Geometric),
            None => {
                let default = self.task.defaults.controller;
                // the paper's PID drifts tens of centimetres in gusts, and its integral compensates steady wind slowly
                let windy = || {
                    let conditions = self.conditions.read(self.seed)?;
                    let sampled = conditions.randomization.is_some_and(|randomization| randomization.draws_wind());
                    Ok::<_, Failure>(sampled || conditions.wind.is_some_and(|wind| !wind.is_calm()))
                };
                Ok(if default == ControllerKind::Pid && windy()? { ControllerKind::Geometric } else { default })
            }
        }
    }

    /// Returns the trajectory that replaces the reference of the task, if --trajectory is set.
    pub fn trajectory(&self) -> Result<Option<Box<dyn Trajectory>>, Failure> {
        let Some(trajectory) = &self.trajectory else { return Ok(None) };
        if self.task.name != "hover" {
            return Err(Failure::input(anyhow!(
                "--trajectory goes with --task hover, whose target it replaces, not with `{}`",
                self.task.name
            )));
        }
        match trajectory {
            NameOrFile::Name(name) => Ok(trajectory::named(name)),
            NameOrFile::File(path) => trajectory::from_file(path).map(Some).map_err(Failure::input),
        }
    }

    /// Returns the track of race, if --track is set.
    fn track(&self) -> Result<Option<RaceTrack>, Failure> {
        let Some(track) = &self.track else { return Ok(None) };
        check_track_task(self.task.name)?;
        RaceTrack::find(&track.to_string()).map(Some).map_err(Failure::input)
    }

    /// Builds the environment of these options.
    pub fn environment(
        &self,
        trajectory: Option<&dyn Trajectory>,
        variation: Variation,
    ) -> Result<Box<dyn DroneEnv>, Failure> {
        let mut conditions = self.conditions.read(self.seed)?;
        variation.apply(&mut conditions, &self.task)?;
        let mut config = EnvConfig::default()
            .drone(params(&self.drone)?)
            .sim_freq(self.sim_freq)
            .ctrl_freq(self.ctrl_freq)
            .conditions(&conditions);
        if let Some(physics) = self.physics {
            config = config.physics(physics);
        }
        if let Some(effects) = self.effects {
            config = config.effects(effects);
        }
        if let Some(engine) = self.engine {
            config = config.engine(engine);
        }
        if let Some(count) = self.num_drones {
            config = config.num_drones(count);
        }
        if let Some(track) = self.track()? {
            config = config.task(|options| options.track = Some(track));
        }
        if let Some(seconds) = self.duration.or(trajectory.map(Trajectory::duration)) {
            config = config.episode_seconds(seconds);
        }
        let env = match (trajectory, self.task.name) {
            (Some(trajectory), _) => {
                let start = trajectory.start();
                config
                    .with_task(Hover::default())
                    .initial_positions([start.position.into()])
                    .initial_rpys([[0.0, 0.0, start.yaw]])
                    // a trajectory may go upside down and above the height limit of hover
                    .task(|hover| (hover.crash.max_tilt, hover.max_height) = (std::f64::consts::PI, f64::INFINITY))
                    .build()
                    .map(|env| Box::new(env) as Box<dyn DroneEnv>)
            }
            (None, "antipodal") => antipodal(config, self.controller()?),
            (None, name) => tasks::make(name, config).map(|env| env as Box<dyn DroneEnv>),
        };
        let is_given = |option: &str| option != "--duration" || self.duration.is_some();
        env.map_err(|error| in_options(error, is_given))
    }
}

/// Returns an error for --track with another task than race.
pub fn check_track_task(task: &str) -> Result<(), Failure> {
    match task {
        "race" => Ok(()),
        other => Err(Failure::input(anyhow!("--track goes with --task race, not with `{other}`"))),
    }
}

/// Names of options in the library and on the command line.
const OPTIONS: [(&str, &str); 2] = [("episode_seconds", "--duration"), ("num_drones", "--num-drones")];

/// Returns the failure to build an environment. It names options as the command line does, if they are given there.
pub fn in_options(error: EnvError, is_given: impl Fn(&str) -> bool) -> Failure {
    match error {
        EnvError::Option { option: field, got, expected } => {
            let option = OPTIONS.iter().find(|(name, option)| *name == field && is_given(option));
            Failure::input(EnvError::Option { option: option.map_or(field, |(_, option)| option), got, expected })
        }
        _ => Failure::input(error),
    }
}

/// Maximum number of drones in antipodal: among more drones, the built-in controllers stop before their goals.
const MAX_SWAPPING: usize = 16;

/// Builds the antipodal task: velocity commands behind a safety filter.
fn antipodal(config: EnvConfig, controller: ControllerKind) -> Result<Box<dyn DroneEnv>, EnvError> {
    let response = match controller {
        ControllerKind::Pid => 0.9,
        ControllerKind::Dsl => 5.0,
        ControllerKind::Geometric => 10.0,
    };
    let task = Antipodal::default();
    // a drone does not reach its velocity setpoint at once, so that the filter needs a margin
    let filter = CollisionCone::new(1.2 * task.safety_radius);
    let env = config.with_task(task).action_type(ActionType::Vel).controller(controller).build()?;
    let drones = env.simulation().num_drones();
    if drones > MAX_SWAPPING {
        return Err(EnvError::Option {
            option: "num_drones",
            got: drones.to_string(),
            expected: "at most 16 with the built-in controllers of antipodal",
        });
    }
    Ok(Box::new(SafetyWrapper::new(env, filter)?.response(response)?))
}

/// Returns the parameters of an airframe.
pub fn params(drone: &NameOrFile<DroneModel>) -> Result<DroneParams, Failure> {
    match drone {
        NameOrFile::Name(model) => Ok(model.params()),
        NameOrFile::File(path) => DroneParams::from_file(path).map_err(Failure::input),
    }
}

/// Returns the failure to render an image: of the input for a scene or an environment variable, otherwise of the work.
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
        wind: Option<WindModel>,
        obstacles: Option<ObstacleKind>,
        config: Option<&str>,
        seed: u64,
    ) -> Result<Conditions, String> {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("conditions.toml");
        if let Some(text) = config {
            std::fs::write(&path, text).unwrap();
        }
        let config = config.map(|_| path);
        let options = ConditionOptions { wind, obstacles, config };
        options.read(seed).map_err(|failure| match failure {
            Failure::Input(error) | Failure::Work(error) => error.to_string(),
        })
    }

    #[test]
    fn a_file_without_obstacles_keeps_the_defaults_of_the_obstacles() {
        let wind = "[wind]\nmodel = \"constant\"\n";
        for kind in ObstacleKind::ALL.into_iter().filter(|&kind| kind != ObstacleKind::Custom) {
            let alone = read(None, Some(kind), None, 7).unwrap();
            assert_eq!(alone.obstacles.as_ref().unwrap().seed, Some(7));
            for text in [wind, "[obstacles]\n", "[randomization]\n"] {
                assert_eq!(read(None, Some(kind), Some(text), 7).unwrap().obstacles, alone.obstacles, "{text}");
            }
            let named = format!("[obstacles]\nkind = \"{}\"\n", kind.name());
            assert_eq!(read(None, None, Some(&named), 7).unwrap().obstacles, alone.obstacles);
        }
        let given = read(None, Some(ObstacleKind::Urban), Some("[obstacles]\ncount = 3\nseed = 2\n"), 7)
            .unwrap()
            .obstacles
            .unwrap();
        assert_eq!((given.count, given.seed), (3, Some(2)));
    }

    #[test]
    fn options_that_contradict_the_file_are_refused() {
        let refused = |wind, obstacles, text, expected: &str| {
            let error = read(wind, obstacles, Some(text), 0).unwrap_err();
            assert!(error.contains("conditions.toml: ") && error.contains(expected), "{error}");
        };
        refused(Some(WindModel::Constant), None, "[randomization.environment]\n", "wind is constant, expected none");
        refused(Some(WindModel::Gust), None, "[wind]\nmodel = \"dryden\"\n", "[wind] has model = \"dryden\"");
        refused(
            None,
            Some(ObstacleKind::Urban),
            "[obstacles]\nkind = \"forest\"\n",
            "[obstacles] has kind = \"forest\"",
        );
        refused(None, None, "[wind]\nvelocity = [1.0, 0.0, 0.0]\n", "[wind] has no model");
        assert!(Conditions::from_toml("[wind]\nstill_air_drag = true\n").unwrap().wind.unwrap().still_air_drag);
    }
}
