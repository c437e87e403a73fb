//! A flight drone by drone, moment by moment: what is logged, plotted and read back.

use std::path::Path;

use nalgebra::Vector3;

use super::RecordError;
use super::files::file_of;
use super::table::{self, Row};
use crate::control::Reference;
use crate::env::DroneEnv;
use crate::simulation::Simulation;
use crate::state::DroneState;

/// One drone at one moment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sample {
    /// Simulated time, s.
    pub time: f64,
    /// Position, attitude and motion; frames as in [`DroneState`].
    pub state: DroneState,
    /// Mean acceleration since the sample before, world frame, m/s²: what its velocity changed by over the time that went
    /// by. Zero for the first one.
    pub acceleration: Vector3<f64>,
    /// Motor speeds commanded during the last control step, rpm.
    pub motor_speeds: [f64; 4],
    /// The drone's reward for the last control step.
    pub reward: f64,
    /// Position (world frame, m) and yaw (rad) that it is asked to be at; `None` where nobody says.
    pub reference: Option<([f64; 3], f64)>,
}

impl Sample {
    /// A drone of a simulation now, after `before`, the sample of the same drone that was taken last.
    ///
    /// # Panics
    /// If there is no drone of that index.
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
    /// One list of samples for each drone.
    pub drones: Vec<Vec<Sample>>,
}

impl Flight {
    /// Notes every drone of an environment as it is now.
    pub fn note(&mut self, env: &dyn DroneEnv) {
        self.note_with(env.simulation(), |drone| (env.drone_reward(drone), Some(env.reference(drone))));
    }

    /// The same with another reward and reference for each drone.
    pub fn note_with(&mut self, simulation: &Simulation, of: impl Fn(usize) -> (f64, Option<Reference>)) {
        self.drones.resize_with(simulation.num_drones(), Vec::new);
        for (drone, samples) in self.drones.iter_mut().enumerate() {
            let (reward, reference) = of(drone);
            samples.push(Sample::of(simulation, drone, reward, reference.as_ref(), samples.last()));
        }
    }

    /// Positions of a drone, world frame, m.
    ///
    /// # Panics
    /// If there is no drone of that index.
    pub fn positions(&self, drone: usize) -> Vec<Vector3<f64>> {
        self.drones[drone].iter().map(|sample| sample.state.position).collect()
    }

    /// Reads a flight: a directory in which a [`Recorder`](super::Recorder) has written `drone0.csv` and on, also while it
    /// does, or one [table](super::COLUMNS) with the rows of every drone, as a replay writes it. A row that a program which
    /// was killed has left unfinished is left out.
    ///
    /// The table needs the columns of the state and of the motor speeds, in any order. Without columns for it, the
    /// acceleration is computed from the velocities and the reward is 0. Logs of earlier versions, with units in the names of
    /// their columns, are read as well.
    ///
    /// # Errors
    /// [`RecordError::Read`] naming the file, the line and the column.
    pub fn read(path: impl AsRef<Path>) -> Result<Self, RecordError> {
        let path = path.as_ref();
        if path.is_file() { read_table(path) } else { Self::read_named(path, "") }
    }

    /// Reads files of a directory with a prefix before their names, as [`Recorded`](super::Recorded) writes them.
    ///
    /// # Errors
    /// As for [`read`](Self::read).
    pub fn read_named(directory: impl AsRef<Path>, prefix: &str) -> Result<Self, RecordError> {
        let file = |drone| file_of(directory.as_ref(), prefix, drone);
        let mut drones = vec![read_drone(&file(0), 0)?];
        while file(drones.len()).exists() {
            drones.push(read_drone(&file(drones.len()), drones.len())?);
        }
        Ok(Self { drones })
    }
}

/// Rows of a file.
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

/// Reads one file with rows of every drone.
fn read_table(path: &Path) -> Result<Flight, RecordError> {
    let mut drones: Vec<Vec<Sample>> = Vec::new();
    for row in rows(path)? {
        let drone = row.drone.unwrap_or(0);
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

/// A row as a sample, after `before`, that of the same drone.
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

/// Mean acceleration of a drone since the sample before. Time goes backwards where another episode starts.
fn acceleration(time: f64, state: &DroneState, before: Option<&Sample>) -> Vector3<f64> {
    match before.filter(|before| before.time < time) {
        Some(before) => (state.velocity - before.state.velocity) / (time - before.time),
        None => Vector3::zeros(),
    }
}

/// Where a flight's error lies: for messages.
pub(super) fn at(path: &Path, line: usize) -> String {
    match line {
        0 => path.display().to_string(),
        line => format!("{}: line {line}", path.display()),
    }
}
