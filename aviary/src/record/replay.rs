//! Recorded flights that can be flown again: a scenario in TOML, motor speeds in CSV.

use std::io::Read;

use serde::Deserialize;

use crate::drone::{DroneError, DroneModel, DroneParams};
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
    pub initial_xyzs: Vec<[f64; 3]>,
    /// Initial roll, pitch, yaw, rad.
    pub initial_rpys: Vec<[f64; 3]>,
    /// Initial velocities, world frame, m/s.
    pub initial_velocities: Option<Vec<[f64; 3]>>,
    /// Initial body rates, body frame, rad/s.
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
    pub engine: EngineName,
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

/// Engines by name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum EngineName {
    /// MuJoCo.
    #[default]
    Mujoco,
}

/// What can be wrong with a recorded flight.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ReplayError {
    /// The scenario is not one.
    #[error("{0}")]
    Toml(String),
    /// Its airframe is not one.
    #[error("drone_model: {0}")]
    Drone(#[from] DroneError),
    /// It cannot be flown.
    #[error(transparent)]
    Simulation(#[from] SimulationError),
    /// A file of motor speeds that is not one.
    #[error("line {line}: {message}")]
    Actions {
        /// Line of the file, from 1.
        line: u64,
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
        toml::from_str(text).map_err(|error| ReplayError::Toml(crate::error::toml_message(text, &error)))
    }

    /// The airframe.
    ///
    /// # Errors
    /// [`ReplayError::Drone`].
    pub fn drone(&self) -> Result<DroneParams, ReplayError> {
        if self.drone_model.ends_with(".toml") {
            return Ok(DroneParams::from_file(&self.drone_model)?);
        }
        Ok(self.drone_model.parse::<DroneModel>()?.params())
    }

    /// The simulation at its start.
    ///
    /// # Errors
    /// [`ReplayError::Drone`] and [`ReplayError::Simulation`] naming what is impossible.
    pub fn simulation(&self) -> Result<Simulation, ReplayError> {
        let mut builder: SimulationBuilder = Simulation::builder(self.drone()?)
            .num_drones(self.num_drones)
            .physics(self.physics)
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
        Ok(builder.build()?)
    }
}

/// Reads motor speeds (rpm) from CSV: columns `drone0_rpm0,…,drone0_rpm3,drone1_rpm0,…`, one row per control step.
///
/// # Errors
/// [`ReplayError::Actions`] with the line of a header, a row or a number that is not right.
pub fn read_actions(source: impl Read, num_drones: usize) -> Result<Vec<Vec<[f64; 4]>>, ReplayError> {
    let wrong = |line: u64, message: String| ReplayError::Actions { line, message };
    let mut reader = csv::ReaderBuilder::new().flexible(true).trim(csv::Trim::All).from_reader(source);
    let at = |error: csv::Error| {
        let line = error.position().map_or(1, csv::Position::line);
        wrong(line, error.to_string())
    };
    let columns: Vec<_> =
        (0..num_drones).flat_map(|drone| (0..4).map(move |motor| format!("drone{drone}_rpm{motor}"))).collect();
    let header = reader.headers().map_err(at)?;
    if header.len() != columns.len() {
        return Err(wrong(1, format!("{} columns, expected {} for {num_drones} drones", header.len(), columns.len())));
    }
    if let Some((found, expected)) = header.iter().zip(&columns).find(|(found, expected)| found != expected) {
        return Err(wrong(1, format!("column `{found}`, expected `{expected}`")));
    }
    let mut rows = Vec::new();
    for record in reader.records() {
        let record = record.map_err(at)?;
        let line = record.position().map_or(0, csv::Position::line);
        if record.len() != columns.len() {
            return Err(wrong(line, format!("{} numbers, expected {}", record.len(), columns.len())));
        }
        let mut row = vec![[0.0; 4]; num_drones];
        for (index, text) in record.iter().enumerate() {
            let rpm = text.parse::<f64>().ok().filter(|rpm| rpm.is_finite());
            let Some(rpm) = rpm else {
                return Err(wrong(line, format!("{} is `{text}`, expected a finite speed in rpm", columns[index])));
            };
            row[index / 4][index % 4] = rpm;
        }
        rows.push(row);
    }
    Ok(rows)
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
        assert!(message("\"cf2x\"", "\"cf3x\"").contains("cf3x"));
        assert!(message("= 48", "= 49").contains("49 Hz"));
        assert!(message("num_drones = 1", "num_drones = 2").contains("1 entries"));
        assert!(message("1.0]]", "nan]]").contains("NaN"));
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
