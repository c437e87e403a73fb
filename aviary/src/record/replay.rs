//! Recorded flights that can be flown again: a scenario in TOML, motor speeds in CSV.

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Read};

use serde::Deserialize;

use crate::drone::{DroneError, DroneModel, DroneParams};
use crate::engine::EngineKind;
use crate::physics::Physics;
use crate::simulation::{Simulation, SimulationBuilder, SimulationError};
use crate::world::{Forcing, Integrator, Medium};

/// The start and the rules of a flight.
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
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scenario {
    /// Airframe: a built-in one by name, or a TOML file.
    pub drone_model: String,
    /// Physics mode.
    pub physics: Physics,
    /// Number of drones.
    pub num_drones: usize,
    /// Physics rate, Hz.
    pub sim_freq: u32,
    /// Control rate, Hz.
    pub ctrl_freq: u32,
    /// Initial positions, world frame, m.
    #[serde(deserialize_with = "crate::error::triples")]
    pub initial_xyzs: Vec<[f64; 3]>,
    /// Initial roll, pitch, yaw, rad.
    #[serde(deserialize_with = "crate::error::triples")]
    pub initial_rpys: Vec<[f64; 3]>,
    /// Initial velocities, world frame, m/s.
    #[serde(default, deserialize_with = "crate::error::optional_triples")]
    pub initial_velocities: Option<Vec<[f64; 3]>>,
    /// Initial body rates, body frame, rad/s.
    #[serde(default, deserialize_with = "crate::error::optional_triples")]
    pub initial_angular_velocities: Option<Vec<[f64; 3]>>,
    /// MuJoCo's fluid forces.
    pub medium: Option<Medium>,
    /// How the rotors' wrench acts during a physics step.
    #[serde(default)]
    pub forcing: Forcing,
    /// MuJoCo's integrator.
    #[serde(default)]
    pub integrator: IntegratorName,
    /// Who integrates.
    #[serde(default)]
    pub engine: EngineKind,
    /// The line that each field stands on, where it was read from text.
    #[serde(skip)]
    lines: BTreeMap<&'static str, usize>,
}

/// MuJoCo's integrators by name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum IntegratorName {
    /// Fourth-order Runge-Kutta.
    #[default]
    Rk4,
    /// Semi-implicit Euler.
    Euler,
    /// Implicit in velocity.
    Implicit,
}

/// What can be wrong with a recorded flight.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ReplayError {
    /// The scenario is not one.
    #[error("{0}")]
    Toml(String),
    /// A field of it is impossible.
    #[error("{}{field}: {message}", line.map_or_else(String::new, |line| format!("line {line}: ")))]
    Field {
        /// The field.
        field: &'static str,
        /// Its line, from 1, where it was read from text.
        line: Option<usize>,
        /// What is wrong with it, and what is expected.
        message: String,
    },
    /// A file of motor speeds that is not one.
    #[error("line {line}: {message}")]
    Actions {
        /// Line of the file, from 1.
        line: usize,
        /// What is wrong there, and what is expected.
        message: String,
    },
}

impl Scenario {
    /// Reads a scenario.
    ///
    /// # Errors
    /// [`ReplayError::Toml`] with line and column.
    pub fn from_toml(text: &str) -> Result<Self, ReplayError> {
        let mut scenario: Self =
            toml::from_str(text).map_err(|error| ReplayError::Toml(crate::error::toml_message(text, &error)))?;
        for field in FIELDS {
            let line = text.lines().position(|line| {
                line.trim_start().strip_prefix(field).is_some_and(|rest| rest.trim_start().starts_with('='))
            });
            scenario.lines.extend(line.map(|line| (field, line + 1)));
        }
        Ok(scenario)
    }

    fn wrong(&self, field: &'static str, message: impl ToString) -> ReplayError {
        ReplayError::Field { field, line: self.lines.get(field).copied(), message: message.to_string() }
    }

    /// The airframe. A file is found relative to the current directory.
    ///
    /// # Errors
    /// [`ReplayError::Field`].
    pub fn drone(&self) -> Result<DroneParams, ReplayError> {
        let params = if self.drone_model.ends_with(".toml") {
            DroneParams::from_file(&self.drone_model)
        } else {
            self.drone_model.parse::<DroneModel>().map(DroneModel::params)
        };
        params.map_err(|error: DroneError| self.wrong("drone_model", error))
    }

    /// The simulation at its start.
    ///
    /// # Errors
    /// [`ReplayError::Field`] naming what is impossible.
    pub fn simulation(&self) -> Result<Simulation, ReplayError> {
        let vectors = [
            ("initial_xyzs", Some(&self.initial_xyzs)),
            ("initial_rpys", Some(&self.initial_rpys)),
            ("initial_velocities", self.initial_velocities.as_ref()),
            ("initial_angular_velocities", self.initial_angular_velocities.as_ref()),
        ];
        for (field, list) in vectors {
            let Some(list) = list else { continue };
            if list.len() != self.num_drones {
                let expected = self.num_drones;
                return Err(
                    self.wrong(field, format!("{} entries, expected one for each of {expected} drones", list.len()))
                );
            }
            // what is further away or faster than this is no flight, and MuJoCo gives up on it
            if let Some(got) = list.iter().flatten().find(|x| !(-1e9..=1e9).contains(*x)) {
                return Err(self.wrong(field, format!("{got}, expected finite numbers between -1e9 and 1e9")));
            }
        }
        if let Some(medium) = self.medium {
            for (what, got) in [("density", medium.density), ("viscosity", medium.viscosity)] {
                if !(0.0..=1e5).contains(&got) {
                    return Err(self.wrong("medium", format!("{what} is {got}, expected 0 to 1e5")));
                }
            }
        }
        let mut builder: SimulationBuilder = Simulation::builder(self.drone()?)
            .num_drones(self.num_drones)
            .physics(self.physics)
            .engine(self.engine)
            .sim_freq(self.sim_freq)
            .ctrl_freq(self.ctrl_freq)
            .initial_positions(self.initial_xyzs.iter().copied())
            .initial_rpys(self.initial_rpys.iter().copied())
            .medium(self.medium)
            .forcing(self.forcing)
            .integrator(match self.integrator {
                IntegratorName::Rk4 => Integrator::Rk4,
                IntegratorName::Euler => Integrator::Euler,
                IntegratorName::Implicit => Integrator::Implicit,
            });
        if let Some(velocities) = &self.initial_velocities {
            builder = builder.initial_velocities(velocities.iter().copied());
        }
        if let Some(rates) = &self.initial_angular_velocities {
            builder = builder.initial_angular_velocities(rates.iter().copied());
        }
        builder.build().map_err(|error| {
            let field = match &error {
                SimulationError::Rates { .. } => "sim_freq",
                SimulationError::NumDrones { .. } => "num_drones",
                _ => "drone_model",
            };
            self.wrong(field, error)
        })
    }
}

/// Fields of a scenario that can be impossible although they are well-formed.
const FIELDS: [&str; 8] = [
    "drone_model",
    "num_drones",
    "sim_freq",
    "initial_xyzs",
    "initial_rpys",
    "initial_velocities",
    "initial_angular_velocities",
    "medium",
];

/// Reads motor speeds (rpm) from CSV: columns `drone0_rpm0,…,drone0_rpm3,drone1_rpm0,…`, one row per control step.
///
/// # Errors
/// [`ReplayError::Actions`] with the line of a header, a row or a number that is not right.
pub fn read_actions(source: impl Read, num_drones: usize) -> Result<Vec<Vec<[f64; 4]>>, ReplayError> {
    let wrong = |line: usize, message: String| ReplayError::Actions { line, message };
    let columns: Vec<_> =
        (0..num_drones).flat_map(|drone| (0..4).map(move |motor| format!("drone{drone}_rpm{motor}"))).collect();
    let mut rows = Vec::new();
    let mut blank = None;
    let mut has_header = false;
    // numbers need no quoting: a line is a row
    for (index, text) in BufReader::new(source).lines().enumerate() {
        let line = index + 1;
        let text = text.map_err(|error| wrong(line, error.to_string()))?;
        let text = text.trim_start_matches('\u{feff}').trim();
        if text.is_empty() {
            blank = blank.or(Some(line));
            continue;
        }
        if let Some(line) = blank {
            return Err(wrong(line, "an empty line, expected a row of motor speeds".into()));
        }
        let cells: Vec<_> = text.split(',').map(str::trim).collect();
        if !has_header {
            has_header = true;
            if cells.len() != columns.len() {
                let (got, expected) = (cells.len(), columns.len());
                return Err(wrong(line, format!("{got} columns, expected {expected} for {num_drones} drones")));
            }
            if let Some((found, expected)) = cells.iter().zip(&columns).find(|(found, expected)| found != expected) {
                return Err(wrong(line, format!("column `{found}`, expected `{expected}`")));
            }
            continue;
        }
        if cells.len() != columns.len() {
            return Err(wrong(line, format!("{} numbers, expected {}", cells.len(), columns.len())));
        }
        let mut row = vec![[0.0; 4]; num_drones];
        for (index, text) in cells.into_iter().enumerate() {
            let Some(rpm) = text.parse::<f64>().ok().filter(|rpm| rpm.is_finite()) else {
                return Err(wrong(line, format!("{} is `{text}`, expected a finite speed in rpm", columns[index])));
            };
            row[index / 4][index % 4] = rpm;
        }
        rows.push(row);
    }
    if has_header { Ok(rows) } else { Err(wrong(1, format!("the file is empty, expected {}", columns.join(",")))) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const SCENARIO: &str = r#"
drone_model = "cf2x"
physics = "mjc"
num_drones = 1
sim_freq = 240
ctrl_freq = 48
initial_xyzs = [[0.0, 0.0, 1.0]]
initial_rpys = [[0.0, 0.0, 0.0]]
"#;

    #[test]
    fn wrong_scenarios_are_refused_by_line_and_field() {
        let message = |from: &str, to: &str| match Scenario::from_toml(&SCENARIO.replace(from, to)) {
            Err(error) => error.to_string(),
            Ok(scenario) => scenario.simulation().unwrap_err().to_string(),
        };
        assert!(message("num_drones", "nmu_drones").contains("line 4") && message("num_drones", "x").contains("x"));
        assert!(message("\"mjc\"", "\"bullet\"").contains("line 3"));
        assert!(message("\"cf2x\"", "\"cf3x\"").starts_with("line 2: drone_model: no drone model `cf3x`"));
        assert!(message("= 48", "= 49").starts_with("line 5: sim_freq: sim_freq is 240 Hz and ctrl_freq 49 Hz"));
        assert!(message("num_drones = 1", "num_drones = 2").starts_with("line 7: initial_xyzs: 1 entries"));
        assert!(message("1.0]]", "nan]]").starts_with("line 7: initial_xyzs: NaN"));
        assert!(message("1.0]]", "1e12]]").starts_with("line 7: initial_xyzs: 1000000000000"));
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
    fn wrong_actions_are_refused_by_line() {
        let read = |text: &str, drones| read_actions(text.as_bytes(), drones).map_err(|error| error.to_string());
        let header = "drone0_rpm0,drone0_rpm1,drone0_rpm2,drone0_rpm3\n";
        assert_eq!(
            read(&format!("{header}1,2,3,4\n5,6,7,8.5\n"), 1).unwrap(),
            [[[1.0, 2.0, 3.0, 4.0]], [[5.0, 6.0, 7.0, 8.5]]]
        );
        let short = read(&format!("{header}1,2,3,4\n1,2,3\n"), 1).unwrap_err();
        assert!(short.starts_with("line 3: 3 numbers"), "{short}");
        let word = read(&format!("{header}1,two,3,4\n"), 1).unwrap_err();
        assert!(word.starts_with("line 2: drone0_rpm1 is `two`"), "{word}");
        for bad in ["nan", "inf", "-inf", "1e999", ""] {
            assert!(
                read(&format!("{header}1,2,3,{bad}\n"), 1).unwrap_err().starts_with("line 2: drone0_rpm3"),
                "{bad}"
            );
        }
        assert_eq!(read(&format!("\u{feff}{header}1,2,3,4\n\n\n").replace('\n', "\r\n"), 1).unwrap().len(), 1);
        let later = read(&format!("{header}1,2,3,4\n5,6,7,x\n").replace('\n', "\r\n"), 1).unwrap_err();
        assert!(later.starts_with("line 3:"), "{later}");
        let gap = read(&format!("{header}1,2,3,4\n\n5,6,7,8\n"), 1).unwrap_err();
        assert!(gap.starts_with("line 3: an empty line"), "{gap}");
        assert!(read(header, 2).unwrap_err().contains("4 columns, expected 8"));
        assert!(read("a,b,c,d\n", 1).unwrap_err().contains("`a`"));
        assert!(read("", 1).unwrap_err().contains("line 1"));
    }

    proptest! {
        #[test]
        fn damaged_files_are_errors_or_sound(bytes in prop::collection::vec(any::<u8>(), 0..300), cut in 0usize..200, letter in any::<u8>()) {
            let _ = read_actions(&bytes[..], 1);
            if let Ok(text) = std::str::from_utf8(&bytes) {
                let _ = Scenario::from_toml(text);
            }
            let mut damaged = SCENARIO.as_bytes().to_vec();
            let place = cut % damaged.len();
            damaged[place] = letter;
            if let Ok(text) = std::str::from_utf8(&damaged) && let Ok(scenario) = Scenario::from_toml(text) {
                prop_assert!(scenario.initial_xyzs.len() <= 1);
            }
        }
    }
}
