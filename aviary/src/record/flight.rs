//! A flight drone by drone, moment by moment: what is logged, plotted and read back.

use std::path::{Path, PathBuf};

use nalgebra::Vector3;

use super::RecordError;
use super::recorder::{COLUMNS, file_of};
use crate::control::Reference;
use crate::env::Env;
use crate::simulation::Simulation;
use crate::state::{DroneState, attitude_from_wxyz};

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
        // another episode has begun where time goes backwards
        let acceleration = match before.filter(|before| before.time < time) {
            Some(before) => (state.velocity - before.state.velocity) / (time - before.time),
            None => Vector3::zeros(),
        };
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
    pub fn note(&mut self, env: &dyn Env) {
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

    /// Reads what a [`Recorder`](super::Recorder) wrote into a directory, `drone0.csv` and on, also while it does. A row that a
    /// program which was killed has left unfinished is left out.
    ///
    /// # Errors
    /// [`RecordError::Read`] naming the file, the line and the column.
    pub fn read(directory: impl AsRef<Path>) -> Result<Self, RecordError> {
        Self::read_named(directory, "")
    }

    /// The same for files with a prefix before their names, as [`Recorded`](super::Recorded) writes them.
    ///
    /// # Errors
    /// As for [`read`](Self::read).
    pub fn read_named(directory: impl AsRef<Path>, prefix: &str) -> Result<Self, RecordError> {
        let file = |drone| file_of(directory.as_ref(), prefix, drone);
        let mut drones = vec![read_drone(&file(0))?];
        while file(drones.len()).exists() {
            drones.push(read_drone(&file(drones.len()))?);
        }
        Ok(Self { drones })
    }
}

/// The column of the reward; those of the reference follow.
const REWARD: usize = 24;

fn read_drone(path: &Path) -> Result<Vec<Sample>, RecordError> {
    let wrong = |line: usize, message: String| RecordError::Read { path: path.to_path_buf(), line, message };
    let bytes = std::fs::read(path).map_err(|error| wrong(0, error.to_string()))?;
    // empty lines are what a recorder that was not dropped leaves behind; what a killed program had begun and not finished comes
    // after one, or has no end
    let ends = (0..bytes.len()).filter(|&at| bytes[at] == b'\n');
    let mut whole = 0;
    for end in ends {
        if end == whole && whole > 0 {
            break;
        }
        whole = end + 1;
    }
    let text = std::str::from_utf8(&bytes[..whole]).map_err(|error| wrong(0, error.to_string()))?;
    let mut lines = text.lines().enumerate().map(|(index, line)| (index + 1, line));
    match lines.next() {
        Some((_, header)) if header.split(',').eq(COLUMNS) => {}
        Some((line, header)) => {
            return Err(wrong(line, format!("the columns are `{header}`, expected `{}`", COLUMNS.join(","))));
        }
        None => return Err(wrong(1, "the file is empty, expected a line with the names of the columns".into())),
    }
    lines.map(|(line, row)| sample(row).map_err(|message| wrong(line, message))).collect()
}

/// Reads a row.
fn sample(row: &str) -> Result<Sample, String> {
    let mut numbers = [None; COLUMNS.len()];
    let mut count = 0;
    for cell in row.split(',') {
        if let Some(number) = numbers.get_mut(count).filter(|_| !cell.is_empty()) {
            // rewards and references are whatever a task says
            let column = COLUMNS[count];
            let read = cell.parse().ok().filter(|x: &f64| x.is_finite() || count >= REWARD);
            *number = Some(read.ok_or_else(|| format!("{column} is `{cell}`, expected a finite number"))?);
        }
        count += 1;
    }
    if count != COLUMNS.len() {
        return Err(format!("{count} columns, expected {}", COLUMNS.len()));
    }
    let required = COLUMNS.len() - 4;
    if let Some(column) = numbers[..required].iter().position(Option::is_none) {
        return Err(format!("{} is empty, expected a number", COLUMNS[column]));
    }
    let number = |column: usize| numbers[column].unwrap_or(0.0);
    let vector = |column: usize| Vector3::new(number(column), number(column + 1), number(column + 2));
    let four = |column: usize| [0, 1, 2, 3].map(|i| number(column + i));
    // columns 8 to 10 are roll, pitch and yaw, which follow from the quaternion
    let state = DroneState {
        position: vector(1),
        attitude: attitude_from_wxyz(four(4)),
        velocity: vector(11),
        angular_velocity: vector(14),
    };
    let reference = match numbers[required..] {
        [Some(x), Some(y), Some(z), Some(yaw)] => Some(([x, y, z], yaw)),
        [None, None, None, None] => None,
        _ => return Err("a reference is there in part, expected all four columns of it or none".into()),
    };
    Ok(Sample {
        time: number(0),
        state,
        acceleration: vector(17),
        motor_speeds: four(20),
        reward: number(REWARD),
        reference,
    })
}

/// Where a flight's error lies: for messages.
pub(super) fn at(path: &Path, line: usize) -> String {
    match line {
        0 => path.display().to_string(),
        line => format!("{}: line {line}", path.display()),
    }
}

/// The files of a flight that are there.
pub fn files(directory: impl AsRef<Path>) -> Vec<PathBuf> {
    (0..).map(|drone| file_of(directory.as_ref(), "", drone)).take_while(|path| path.exists()).collect()
}
