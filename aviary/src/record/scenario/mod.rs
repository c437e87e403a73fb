//! Scenarios: the initial state and the configuration of a flight, as a file that reproduces it.

mod build;
mod capture;

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::drone::DroneParams;
use crate::engine::EngineKind;
use crate::physics::actuators::ActuatorParams;
use crate::physics::wind::WindConfig;
use crate::physics::{Effects, Physics};
use crate::world::{Forcing, Integrator, Medium, ObstacleConfig};

/// Initial state and configuration of a flight.
///
/// ```
/// use aviary::record::Scenario;
///
/// let scenario = Scenario::from_toml(
///     r#"
///     drone_model = "cf2x"
///     physics = "mjc_gnd"
///     num_drones = 1
///     sim_freq = 240
///     ctrl_freq = 48
///     initial_xyzs = [[0.0, 0.0, 0.3]]
///     initial_rpys = [[0.0, 0.0, 1.0]]
///     "#,
/// )?;
/// let mut simulation = scenario.simulation()?;
/// simulation.step(&[[14_476.0; 4]])?;
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
///
/// [`Scenario::of`] describes a simulation at its start, with the sampled wind, obstacles, motors and bodies. With
/// the motor speeds of the log, the simulation of the scenario reproduces the flight bit-exactly.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scenario {
    /// Airframe: the name of a built-in one, a TOML file, or the name of `airframe`.
    pub drone_model: String,
    /// Physics mode, the shorthand for `effects` and `engine`; required unless `effects` is set.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub physics: Option<Physics>,
    /// Number of drones.
    pub num_drones: usize,
    /// Physics rate, Hz.
    pub sim_freq: u32,
    /// Control rate, Hz.
    pub ctrl_freq: u32,
    /// Initial positions, world frame, m.
    #[serde(deserialize_with = "crate::error::triples")]
    pub initial_xyzs: Vec<[f64; 3]>,
    /// Initial roll, pitch and yaw, rad.
    #[serde(deserialize_with = "crate::error::triples")]
    pub initial_rpys: Vec<[f64; 3]>,
    /// Initial attitudes `[w, x, y, z]`, body to world, of unit length, if they differ from the attitudes of the
    /// compiled scene. They equal `initial_rpys` without its rounding.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub initial_quaternions: Option<Vec<[f64; 4]>>,
    /// Roll, pitch and yaw of the compiled scene, rad, if `initial_quaternions` is set; level by default.
    #[serde(default, deserialize_with = "crate::error::optional_triples", skip_serializing_if = "Option::is_none")]
    pub scene_rpys: Option<Vec<[f64; 3]>>,
    /// Initial velocities, world frame, m/s.
    #[serde(default, deserialize_with = "crate::error::optional_triples", skip_serializing_if = "Option::is_none")]
    pub initial_velocities: Option<Vec<[f64; 3]>>,
    /// Initial angular velocities, body frame, rad/s.
    #[serde(default, deserialize_with = "crate::error::optional_triples", skip_serializing_if = "Option::is_none")]
    pub initial_angular_velocities: Option<Vec<[f64; 3]>>,
    /// Frame of the rotor wrench during a physics step.
    #[serde(default)]
    pub forcing: Forcing,
    /// Integrator of MuJoCo.
    #[serde(default = "paper_integrator", with = "IntegratorName")]
    pub integrator: Integrator,
    /// Engine; by default `explicit` for the physics mode `dyn`, otherwise `mujoco`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub engine: Option<EngineKind>,
    /// Downward gravity, m/s²; 9.81 by default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub gravity: Option<f64>,
    /// Seed of the wind, as text because TOML has no unsigned 64-bit integers.
    #[serde(default, with = "seed", skip_serializing_if = "Option::is_none")]
    pub wind_seed: Option<u64>,
    /// Aerodynamic effects; by default those of the physics mode.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub effects: Option<Effects>,
    /// Fluid of MuJoCo's fluid forces.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub medium: Option<Medium>,
    /// Wind.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub wind: Option<WindConfig>,
    /// Obstacles, of kind `custom`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub obstacles: Option<ObstacleConfig>,
    /// Number of obstacles that move, the last ones of the list. Their poses during the flight are in its directory.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub moving_obstacles: usize,
    /// Parameters of the airframe, if it is not built in.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub airframe: Option<DroneParams>,
    /// Bodies and motors of the drones, if they differ from the airframe.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub bodies: Option<Vec<ScenarioBody>>,
    /// Lines of the fields in the text of the scenario.
    #[serde(skip)]
    lines: BTreeMap<&'static str, usize>,
}

/// Body and motors of a drone that differ from its airframe, such as sampled parameters. Motor commands are clipped
/// to the largest speed of the airframe.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ScenarioBody {
    /// Parameters of the body.
    pub airframe: DroneParams,
    /// Parameters of the motors.
    #[serde(default)]
    pub actuators: ActuatorParams,
}

/// Returns true for zero.
fn is_zero(count: &usize) -> bool {
    *count == 0
}

/// Returns the paper's integrator.
fn paper_integrator() -> Integrator {
    Integrator::Rk4
}

/// Serialization of seeds as text.
mod seed {
    use serde::{Deserialize as _, Deserializer, Serializer, de::Error as _};

    pub fn serialize<S: Serializer>(seed: &Option<u64>, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(&seed.unwrap_or_default())
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<u64>, D::Error> {
        let text = String::deserialize(deserializer)?;
        let expected = || D::Error::custom(format!("`{text}`, expected a whole number up to {} as text", u64::MAX));
        text.parse().map(Some).map_err(|_| expected())
    }
}

/// Names of MuJoCo's integrators, for serde.
#[derive(Serialize, Deserialize)]
#[serde(remote = "Integrator", rename_all = "snake_case")]
enum IntegratorName {
    Rk4,
    Euler,
    Implicit,
}

/// Error of a recorded flight.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ReplayError {
    /// TOML that is not a scenario.
    #[error("{0}")]
    Toml(String),
    /// An invalid field of a scenario.
    #[error("{}{field}: {message}", line.map_or_else(String::new, |line| format!("line {line}: ")))]
    Field {
        /// Name of the field.
        field: &'static str,
        /// Line of the field, from 1, if the scenario was read from text.
        line: Option<usize>,
        /// Description of the error and the expected value.
        message: String,
    },
    /// An invalid file of motor speeds.
    #[error("line {line}: {message}")]
    Actions {
        /// Line in the file, from 1.
        line: usize,
        /// Description of the error and the expected value.
        message: String,
    },
}

impl Scenario {
    /// Reads a scenario from TOML.
    ///
    /// # Errors
    /// [`ReplayError::Toml`] with line and column, and [`ReplayError::Field`] for a scenario without `physics` and
    /// `effects`.
    pub fn from_toml(text: &str) -> Result<Self, ReplayError> {
        let mut scenario: Self =
            toml::from_str(text).map_err(|error| ReplayError::Toml(crate::error::toml_message(text, &error)))?;
        if scenario.physics.is_none() && scenario.effects.is_none() {
            return Err(scenario.wrong("physics", "missing, expected a physics mode or `effects`"));
        }
        for field in FIELDS {
            let line = text.lines().position(|line| {
                line.trim_start().strip_prefix(field).is_some_and(|rest| rest.trim_start().starts_with('='))
            });
            scenario.lines.extend(line.map(|line| (field, line + 1)));
        }
        Ok(scenario)
    }

    /// Converts the scenario to TOML, which [`from_toml`](Self::from_toml) reads back to the same scenario.
    ///
    /// # Errors
    /// [`ReplayError::Toml`] if TOML cannot represent a value.
    pub fn to_toml(&self) -> Result<String, ReplayError> {
        toml::to_string(self).map_err(|error| ReplayError::Toml(error.to_string()))
    }

    fn wrong(&self, field: &'static str, message: impl ToString) -> ReplayError {
        ReplayError::Field { field, line: self.lines.get(field).copied(), message: message.to_string() }
    }
}

/// Fields of a scenario whose values can be invalid in well-formed TOML.
const FIELDS: [&str; 17] = [
    "drone_model",
    "num_drones",
    "sim_freq",
    "initial_xyzs",
    "initial_rpys",
    "initial_quaternions",
    "scene_rpys",
    "initial_velocities",
    "initial_angular_velocities",
    "effects",
    "engine",
    "gravity",
    "wind_seed",
    "medium",
    "wind",
    "obstacles",
    "moving_obstacles",
];

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::drone::DroneModel;
    use crate::physics::wind::WindModel;
    use crate::record::{CsvLog, Recorder, read_motor_speeds};
    use crate::simulation::Simulation;
    use crate::state::{DroneState, attitude_from_rpy};
    use crate::world::ObstacleKind;
    use nalgebra::Vector3;
    use proptest::prelude::*;

    /// One drone at rest.
    pub(in crate::record) const SCENARIO: &str = r#"
drone_model = "cf2x"
physics = "mjc"
num_drones = 1
sim_freq = 240
ctrl_freq = 48
initial_xyzs = [[0.0, 0.0, 1.0]]
initial_rpys = [[0.0, 0.0, 0.0]]
"#;

    #[test]
    fn invalid_scenarios_are_errors_with_line_and_field() {
        let message = |from: &str, to: &str| match Scenario::from_toml(&SCENARIO.replace(from, to)) {
            Err(error) => error.to_string(),
            Ok(scenario) => scenario.simulation().unwrap_err().to_string(),
        };
        assert!(message("num_drones", "nmu_drones").contains("line 4") && message("num_drones", "x").contains("x"));
        assert!(message("\"mjc\"", "\"bullet\"").contains("line 3"));
        assert!(message("\"cf2x\"", "\"cf3x\"").starts_with("line 2: drone_model: no drone model `cf3x`"));
        assert!(message("= 48", "= 49").starts_with("line 5: sim_freq: sim_freq is 240 Hz and ctrl_freq 49 Hz"));
        assert!(message("num_drones = 1", "num_drones = 2").starts_with("line 7: initial_xyzs: 1 entry"));
        assert!(message("1.0]]", "nan]]").starts_with("line 7: initial_xyzs: NaN"));
        assert!(message("1.0]]", "1e12]]").starts_with("line 7: initial_xyzs: 1000000000000"));
        let far = message("1.0]]", "2e5]]");
        assert!(far.starts_with("line 7: initial_xyzs: 200000, expected finite numbers within ±1e5"), "{far}");
        let turned = message("initial_rpys = [[0.0", "initial_rpys = [[2e3");
        assert!(turned.starts_with("line 8: initial_rpys: 2000, expected finite numbers within ±1e3"), "{turned}");
        assert!(message("1.0]]", "1.0, 7]]").contains("4 numbers, expected 3"));
        assert!(message("1.0]]", "1.0], [1.0]]").contains("line"));
        assert!(message("ctrl_freq = 48\n", "ctrl_freq = 48\nengine = \"bullet\"\n").contains("bullet"));
        assert!(message("ctrl_freq = 48\n", "ctrl_freq = 48\nforcing = \"soft\"\n").contains("soft"));
        assert!(
            message("ctrl_freq = 48\n", "ctrl_freq = 48\nmedium = { density = -1, viscosity = 0 }\n").contains("-1")
        );
        assert!(message("ctrl_freq = 48\n", "ctrl_freq = 48\ninitial_velocities = []\n").contains("velocities"));
        assert!(message("ctrl_freq = 48\n", "ctrl_freq = 48\ninitial_velocities = [[inf, 0, 0]]\n").contains("finite"));
    }

    #[test]
    fn contradictions_are_errors_and_seeds_have_64_bits() {
        let with = |more: &str| Scenario::from_toml(&format!("{SCENARIO}{more}"));
        let message = |more: &str| match with(more) {
            Err(error) => error.to_string(),
            Ok(scenario) => scenario.simulation().unwrap_err().to_string(),
        };
        assert!(message("wind_seed = \"3\"\n").starts_with("line 9: wind_seed: a seed without"));
        assert!(message("wind_seed = \"x\"\n").contains("expected a whole number up to 18446744073709551615"));
        let seed = with(&format!("wind_seed = \"{}\"\n[wind]\nmodel = \"gust\"\n", u64::MAX)).unwrap();
        assert_eq!(seed.simulation().unwrap().wind_seed(), u64::MAX);
        assert!(message("initial_quaternions = [[1, 0, 0, 1]]\n").starts_with("line 9: initial_quaternions:"));
        assert!(
            message("initial_quaternions = [[0, 1, 0, 0]]\n").contains("differs from the attitude of initial_rpys")
        );
        assert!(message("initial_quaternions = []\n").contains("0 entries, expected one for each of 1 drone"));
        assert!(message("scene_rpys = [[0, 0, 1]]\n").starts_with("line 9: scene_rpys: no initial_quaternions"));
        let two = message("initial_quaternions = [[1, 0, 0, 0]]\nscene_rpys = [[0, 0, 1], [0, 0, 1]]\n");
        assert!(two.starts_with("line 10: scene_rpys: 2 entries, expected one for each of 1 drone"), "{two}");
        assert!(message("gravity = nan\n").starts_with("line 9: gravity"));
        assert!(message("[obstacles]\nkind = \"forest\"\n").contains("expected custom"));
        let hybrid = SCENARIO.replace("\"mjc\"", "\"dyn\"") + "engine = \"hybrid\"\n";
        let error = Scenario::from_toml(&hybrid).unwrap().simulation().unwrap_err().to_string();
        assert!(
            error.starts_with("line 9: engine: engine is hybrid and physics dyn, which implies explicit"),
            "{error}"
        );
        let airframe = include_str!("../../../../assets/airframes/race.toml");
        assert!(
            message(&format!("[airframe]\n{airframe}")).starts_with("line 2: drone_model: `cf2x`, expected `race`")
        );
    }

    #[test]
    fn a_stepped_simulation_or_mixed_airframes_have_no_scenario() {
        let mut simulation = Simulation::builder(DroneModel::Cf2x).build().unwrap();
        simulation.step(&[[1e4; 4]]).unwrap();
        assert!(Scenario::of(&simulation).unwrap_err().to_string().contains("has been stepped"));
        let two = [DroneModel::Cf2x.params(), DroneModel::Race.params()];
        let simulation = Simulation::builder(DroneModel::Cf2x).drones(two).build().unwrap();
        assert!(Scenario::of(&simulation).unwrap_err().to_string().contains("different airframes"));
    }

    #[test]
    fn effects_and_engine_without_a_physics_mode_are_written_and_read() {
        let (drag, none) = (Effects { drag: true, downwash: true, ..Effects::NONE }, Effects::NONE);
        for (effects, engine, physics) in [
            (drag, EngineKind::Hybrid, None),
            (drag, EngineKind::Explicit, None),
            (none, EngineKind::Explicit, Some(Physics::Dyn)),
            (Effects::ALL, EngineKind::Mujoco, Some(Physics::MjcGndDragDw)),
        ] {
            let builder = Simulation::builder(DroneModel::Cf2x).num_drones(2).effects(effects).engine(engine);
            let simulation = builder.build().unwrap();
            let text = Scenario::of(&simulation).unwrap().to_toml().unwrap();
            let scenario = Scenario::from_toml(&text).unwrap();
            assert_eq!((scenario.physics, scenario.effects), (physics, physics.is_none().then_some(effects)), "{text}");
            let again = scenario.simulation().unwrap();
            assert_eq!((again.effects(), again.model().engine_kind()), (effects, engine), "{text}");
        }
        // the scenario that earlier versions wrote for a flight in the mode `dyn`
        let early = SCENARIO.replace("\"mjc\"", "\"dyn\"") + "engine = \"mujoco\"\n";
        let early = Scenario::from_toml(&early).unwrap().simulation().unwrap();
        assert_eq!(early.model().engine_kind(), EngineKind::Explicit);
        let message = |text: &str| match Scenario::from_toml(text) {
            Err(error) => error.to_string(),
            Ok(scenario) => scenario.simulation().unwrap_err().to_string(),
        };
        assert_eq!(
            message(&SCENARIO.replace("physics = \"mjc\"\n", "")),
            "physics: missing, expected a physics mode or `effects`"
        );
        let contradiction = message(&format!("{SCENARIO}effects = {{ drag = true }}\n"));
        let expected = "line 9: effects: effects is drag and physics mjc, which implies none";
        assert!(contradiction.starts_with(expected), "{contradiction}");
        let contradiction = message(&format!("{SCENARIO}engine = \"explicit\"\n"));
        assert!(contradiction.starts_with("line 9: engine: engine is explicit and physics mjc"), "{contradiction}");
    }

    /// A scenario can list all bars of the largest random set of gates.
    #[test]
    fn the_largest_random_set_of_obstacles_can_be_listed() {
        let gates =
            ObstacleConfig { count: 501, arena: [200.0, 200.0, 2.0], ..ObstacleConfig::new(ObstacleKind::Gates) };
        let mut rng = <crate::env::Rng as rand::SeedableRng>::seed_from_u64(1);
        let bars = gates.generate(&[[0.0, 0.0, 0.1]], &mut rng).unwrap();
        assert_eq!(bars.len(), 2004);
        let mut list = ObstacleConfig { custom: bars.clone(), ..ObstacleConfig::new(ObstacleKind::Custom) };
        list.validate().unwrap();
        list.count = bars.len();
        list.validate().unwrap();
        list.custom.resize(ObstacleConfig::MAX_CUSTOM + 1, bars[0]);
        list.count = 0;
        assert!(list.validate().unwrap_err().to_string().contains("is 8001, expected 0 to 8000"));
    }

    /// The rounding of MuJoCo's derived quantities depends on the attitude of the compiled scene.
    #[test]
    fn a_rotated_scene_is_compiled_with_its_rotation() {
        let mut as_level = 0;
        let scenes = [[0.0, 0.0, 1.0], [0.0, 0.0, 2.1], [0.0, 0.0, -0.6], [0.4, -0.2, 1.0], [1.3, 0.7, -2.9]];
        for rpy in scenes {
            let mut simulation = Simulation::builder(DroneModel::Cf2x).initial_rpys([rpy]).build().unwrap();
            assert_eq!(Scenario::of(&simulation).unwrap().scene_rpys, None);
            let start = DroneState {
                angular_velocity: Vector3::new(3.0, -2.0, 5.0),
                ..DroneState::at_rest(Vector3::new(0.1, 0.2, 1.0), Vector3::new(0.1, -0.2, 0.7))
            };
            simulation.reset_to(&[start]).unwrap();
            let scenario = Scenario::of(&simulation).unwrap();
            assert_eq!(scenario.scene_rpys, Some(vec![rpy]));
            let mut again = scenario.simulation().unwrap();
            let mut level = Scenario { scene_rpys: None, ..scenario }.simulation().unwrap();
            for step in 0..100 {
                let speeds = [[14_000.0, 14_500.0, 14_200.0 + f64::from(step), 14_300.0]];
                for simulation in [&mut simulation, &mut again, &mut level] {
                    simulation.step(&speeds).unwrap();
                }
                assert_eq!(again.states(), simulation.states(), "{rpy:?}, step {step}");
            }
            as_level += usize::from(level.states() == simulation.states());
        }
        assert!(as_level < scenes.len(), "level scenes give the same bits, so that this test shows nothing");
    }

    fn vector(size: f64) -> impl Strategy<Value = [f64; 3]> {
        prop::array::uniform3(-size..size)
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(48))]
        /// The scenario and the log of a flight reproduce it bit-exactly for any initial state and configuration,
        /// from each of the two table formats.
        #[test]
        fn a_scenario_and_a_log_reproduce_the_flight(
            starts in prop::collection::vec((vector(3.0), vector(3.1), vector(5.0), vector(20.0)), 1..4),
            speeds in prop::collection::vec(prop::array::uniform4(-1e3..3e4_f64), 1..12),
            effects in prop::sample::select(&Physics::ALL[..]).prop_map(Physics::effects),
            engine in prop::sample::select(&EngineKind::ALL[..]),
            wind in prop::option::of(any::<u64>()),
            lag in prop::option::of(0.0..0.1_f64),
            heavier in prop::option::of(0.9..1.3_f64),
            gravity in prop::option::of(9.0..10.0_f64),
            scene in prop::option::of(vector(3.1)),
        ) {
            let count = starts.len();
            let mut simulation = Simulation::builder(DroneModel::Cf2p)
                .num_drones(count)
                .initial_rpys(vec![scene.unwrap_or_default(); count])
                .effects(effects)
                .engine(engine)
                .wind(wind.map(|_| WindConfig::new(WindModel::Combined)))
                .build()
                .unwrap();
            for drone in 0..count {
                if let Some(factor) = heavier {
                    let nominal = simulation.params(drone).clone();
                    simulation.set_airframe(drone, DroneParams { mass: factor * nominal.mass, ..nominal }).unwrap();
                }
                if let Some(lag) = lag {
                    simulation.set_actuators(drone, &ActuatorParams { lag, ..ActuatorParams::default() }).unwrap();
                }
            }
            if let Some(gravity) = gravity {
                simulation.set_gravity(gravity).unwrap();
            }
            let states: Vec<_> = (starts.iter().enumerate())
                .map(|(drone, &(place, rpy, velocity, rate))| DroneState {
                    position: Vector3::from(place) + Vector3::new(10.0 * drone as f64, 0.0, 5.0),
                    // // the product of two rotations, which roll, pitch and yaw represent only with rounding
                    attitude: attitude_from_rpy(rpy.into()) * attitude_from_rpy(place.into()),
                    velocity: velocity.into(),
                    angular_velocity: rate.into(),
                })
                .collect();
            simulation.reset_to(&states).unwrap();
            if let Some(seed) = wind {
                simulation.reset_wind(seed);
            }
            let text = Scenario::of(&simulation).unwrap().to_toml().unwrap();
            let scenario = Scenario::from_toml(&text).unwrap();
            let mut again = scenario.simulation().unwrap();
            prop_assert_eq!(again.states(), simulation.states());
            prop_assert_eq!(Scenario::of(&again).unwrap().to_toml().unwrap(), text);

            let directory = tempfile::tempdir().unwrap();
            let mut recorder = Recorder::create(directory.path(), count).unwrap();
            let mut log = CsvLog::new(Vec::new()).unwrap();
            let mut flown = Vec::new();
            recorder.record_with(&simulation, |_| (0.0, None)).unwrap();
            for speeds in &speeds {
                simulation.step(&vec![*speeds; count]).unwrap();
                recorder.record_with(&simulation, |_| (0.0, None)).unwrap();
                log.record(&simulation).unwrap();
                flown.push(simulation.states().to_vec());
            }
            let table = directory.path().join("table.csv");
            std::fs::write(&table, log.finish().unwrap()).unwrap();
            let read =
                |path: &std::path::Path| read_motor_speeds(&[path.to_path_buf()], count, scenario.ctrl_freq).unwrap();
            let speeds = read(directory.path());
            prop_assert_eq!(&read(&table), &speeds);
            for (speeds, states) in speeds.iter().zip(&flown) {
                again.step(speeds).unwrap();
                prop_assert_eq!(again.states(), &states[..]);
            }
            prop_assert_eq!(speeds.len(), flown.len());
        }
    }
}
