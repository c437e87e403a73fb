//! Flights as samples per drone and time, for logs, plots and files.

use std::path::Path;

use nalgebra::Vector3;

use super::RecordError;
use super::files::file_of;
use super::recorded::prefix;
use super::table::{self, Row};
use crate::control::Reference;
use crate::env::DroneEnv;
use crate::simulation::Simulation;
use crate::state::DroneState;

/// State of one drone at one time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sample {
    /// Simulated time, s.
    pub time: f64,
    /// Position, attitude and motion; frames as in [`DroneState`].
    pub state: DroneState,
    /// Mean acceleration since the previous sample, world frame, m/s²: the change of velocity divided by the
    /// elapsed time. Zero for the first sample.
    pub acceleration: Vector3<f64>,
    /// Motor speeds commanded during the last control step, rpm.
    pub motor_speeds: [f64; 4],
    /// Reward of the drone for the last control step.
    pub reward: f64,
    /// Reference position (world frame, m) and yaw (rad); `None` without a reference.
    pub reference: Option<([f64; 3], f64)>,
}

impl Sample {
    /// Creates a sample of a drone from the current state of a simulation. `before` is the previous sample of the
    /// same drone.
    ///
    /// # Panics
    /// If no drone has the index.
    pub fn of(
        simulation: &Simulation,
        drone: usize,
        reward: f64,
        reference: Option<&Reference>,
        before: Option<&Self>,
    ) -> Self {
        let (time, state) = (simulation.time(), simulation.states()[drone]);
        let acceleration = acceleration(time, &state, before);
        Self {
            time,
            state,
            acceleration,
            motor_speeds: simulation.motor_speeds()[drone],
            reward,
            reference: reference.map(|reference| (reference.position.into(), reference.yaw)),
        }
    }
}

/// A flight in memory: the samples of every drone, in order of time.
///
/// ```
/// use aviary::env::Env;
/// use aviary::record::Flight;
/// use aviary::record::plot::Plot;
/// use aviary::tasks::Hover;
///
/// let mut env = Hover::builder().build()?;
/// let mut flight = Flight::default();
/// env.reset(Some(1))?;
/// for _ in 0..48 {
///     flight.note(&env);
///     env.step(&[0.05; 4])?;
/// }
/// assert!(flight.drones[0][47].acceleration.z > 0.3);
/// let svg = Plot::of_flight("Climbing", &flight)?.svg()?;
/// assert!(svg.contains("Climbing"));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Flight {
    /// Samples of each drone.
    pub drones: Vec<Vec<Sample>>,
}

impl Flight {
    /// Adds a sample of every drone of an environment.
    pub fn note(&mut self, env: &dyn DroneEnv) {
        self.note_with(env.simulation(), |drone| (env.drone_reward(drone), Some(env.reference(drone))));
    }

    /// Adds a sample of every drone of a simulation. `of` returns the reward and the reference of a drone.
    pub fn note_with(&mut self, simulation: &Simulation, of: impl Fn(usize) -> (f64, Option<Reference>)) {
        self.drones.resize_with(simulation.num_drones(), Vec::new);
        for (drone, samples) in self.drones.iter_mut().enumerate() {
            let (reward, reference) = of(drone);
            samples.push(Sample::of(simulation, drone, reward, reference.as_ref(), samples.last()));
        }
    }

    /// Removes all samples after a time, s.
    pub fn rewind(&mut self, time: f64) {
        for samples in &mut self.drones {
            samples.retain(|sample| sample.time <= time);
        }
    }

    /// Returns the positions of a drone, world frame, m.
    ///
    /// # Panics
    /// If no drone has the index.
    pub fn positions(&self, drone: usize) -> Vec<Vector3<f64>> {
        self.drones[drone].iter().map(|sample| sample.state.position).collect()
    }

    /// Reads a flight. `path` is a directory with the files `drone0.csv`, `drone1.csv`, … of a
    /// [`Recorder`](super::Recorder), which may still be writing them, or one [table](super::COLUMNS) with the rows
    /// of all drones, such as the table of a replay. The flight of a table with the rows of one drone, such as
    /// `drone1.csv`, has one drone. The reader skips an unfinished row of a program that was killed.
    ///
    /// The columns of the state and of the motor speeds are required, in any order. If the table has no
    /// acceleration, the reader computes it from the velocities; a missing reward is 0. The reader also accepts
    /// logs of earlier versions, whose column names contain units.
    ///
    /// # Errors
    /// [`RecordError::Read`] with the file, the line and the column.
    pub fn read(path: impl AsRef<Path>) -> Result<Self, RecordError> {
        let path = path.as_ref();
        if path.is_file() { read_table(path) } else { Self::read_named(path, "") }
    }

    /// Reads the files of a directory whose names start with a prefix, as [`Recorded`](super::Recorded) writes
    /// them.
    ///
    /// # Errors
    /// Returns the errors of [`read`](Self::read).
    pub fn read_named(directory: impl AsRef<Path>, prefix: &str) -> Result<Self, RecordError> {
        let file = |drone| file_of(directory.as_ref(), prefix, drone);
        let mut drones = vec![read_drone(&file(0), 0)?];
        while file(drones.len()).exists() {
            drones.push(read_drone(&file(drones.len()), drones.len())?);
        }
        Ok(Self { drones })
    }

    /// Reads an episode from the directory of a [`Recorded`](super::Recorded).
    ///
    /// # Errors
    /// Returns the errors of [`read`](Self::read).
    pub fn read_episode(directory: impl AsRef<Path>, episode: u64) -> Result<Self, RecordError> {
        Self::read_named(directory, &prefix(episode))
    }
}

/// Reads the rows of a file.
pub(super) fn rows(path: &Path) -> Result<Vec<Row>, RecordError> {
    let bytes = std::fs::read(path).map_err(|error| wrong(path, 0, error.to_string()))?;
    table::read(&bytes).map_err(|(line, message)| wrong(path, line, message))
}

pub(super) fn wrong(path: &Path, line: usize, message: String) -> RecordError {
    RecordError::Read { path: path.to_path_buf(), line, message }
}

/// Reads the file of one drone.
fn read_drone(path: &Path, drone: usize) -> Result<Vec<Sample>, RecordError> {
    let mut samples = Vec::new();
    for row in rows(path)? {
        if let Some(other) = row.drone.filter(|&other| other != drone) {
            return Err(wrong(path, row.line, format!("drone is {other}, expected {drone} in this file")));
        }
        let sample = sample(&row, samples.last()).map_err(|message| wrong(path, row.line, message))?;
        samples.push(sample);
    }
    Ok(samples)
}

/// Reads one file with the rows of all drones, or of one of them.
fn read_table(path: &Path) -> Result<Flight, RecordError> {
    let mut drones: Vec<Vec<Sample>> = Vec::new();
    let rows = rows(path)?;
    // the file of one drone has the index of this drone in every row
    let first = rows.first().and_then(|row| row.drone).filter(|_| rows.iter().all(|row| row.drone == rows[0].drone));
    for row in rows {
        let drone = row.drone.unwrap_or(0) - first.unwrap_or(0);
        if drone > drones.len() {
            let expected = drones.len();
            return Err(wrong(path, row.line, format!("drone is {drone}, expected one up to {expected}")));
        }
        if drone == drones.len() {
            drones.push(Vec::new());
        }
        let sample = sample(&row, drones[drone].last()).map_err(|message| wrong(path, row.line, message))?;
        drones[drone].push(sample);
    }
    Ok(Flight { drones: if drones.is_empty() { vec![Vec::new()] } else { drones } })
}

/// Converts a row to a sample. `before` is the previous sample of the same drone.
fn sample(row: &Row, before: Option<&Sample>) -> Result<Sample, String> {
    let motor_speeds = row.motor_speeds.ok_or("no columns `rpm0` to `rpm3`, expected the motor speeds of a flight")?;
    let acceleration = row.acceleration.unwrap_or_else(|| acceleration(row.time, &row.state, before));
    Ok(Sample {
        time: row.time,
        state: row.state,
        acceleration,
        motor_speeds,
        reward: row.reward.unwrap_or(0.0),
        reference: row.reference,
    })
}

/// Returns the mean acceleration of a drone since the previous sample; zero for the first sample of an episode,
/// whose time is not later than that of the previous sample.
fn acceleration(time: f64, state: &DroneState, before: Option<&Sample>) -> Vector3<f64> {
    match before.filter(|before| before.time < time) {
        Some(before) => (state.velocity - before.state.velocity) / (time - before.time),
        None => Vector3::zeros(),
    }
}

/// Returns the place of an error in a file, for messages.
pub(super) fn at(path: &Path, line: usize) -> String {
    match line {
        0 => path.display().to_string(),
        line => format!("{}: line {line}", path.display()),
    }
}
