use std::path::{Path, PathBuf};

use append_file::AppendFile;

use super::files::file_of;
use super::flight::{Flight, Sample};
use super::obstacles::{self, ObstacleLog};
use super::table::{state_numbers, written};
use super::{COLUMNS, ObstaclePose, RecordError};
use crate::control::Reference;
use crate::env::DroneEnv;
use crate::simulation::Simulation;

/// Writes a flight as CSV while it runs: one file per drone, `drone0.csv`, `drone1.csv`, …, with one row of
/// [`COLUMNS`] per call. Numbers read back bit-exactly, except that negative zero is written as zero. If obstacles move,
/// `obstacles.csv` has their poses, which [`read_obstacle_poses`](super::read_obstacle_poses) reads.
///
/// The operating system owns every row before the call returns ([`AppendFile`]). After a crash or a kill of the
/// program, the files are readable up to the last row. The files end in empty lines until the recorder is dropped,
/// and no other program may truncate them until then.
///
/// ```
/// use aviary::env::{DroneEnv, Env};
/// use aviary::record::{Flight, Recorder};
/// use aviary::tasks::Hover;
///
/// # let directory = tempfile::tempdir()?;
/// # let directory = directory.path();
/// let mut env = Hover::builder().build()?;
/// let mut recorder = Recorder::create(directory, 1)?;
/// env.reset(Some(1))?;
/// recorder.record(&env)?;
/// env.step(&[0.1; 4])?;
/// recorder.record(&env)?;
///
/// let flight = Flight::read(directory)?;
/// assert_eq!(flight.drones[0][1].state, env.simulation().states()[0]);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct Recorder {
    files: Vec<(PathBuf, AppendFile)>,
    /// File of the moving obstacles, and its writer from the first row of the flight on.
    obstacles: (PathBuf, Option<ObstacleLog>),
    last: Vec<Option<Sample>>,
    rows: Vec<Row>,
}

impl Recorder {
    /// Creates the files for a number of drones in a directory, which is created if necessary. Files of an earlier
    /// flight are replaced, and files of additional drones are removed.
    ///
    /// # Errors
    /// [`RecordError::File`] with the path of the file.
    pub fn create(directory: impl AsRef<Path>, drones: usize) -> Result<Self, RecordError> {
        Self::create_named(directory, "", drones)
    }

    /// Creates files whose names start with a prefix, for several flights in one directory.
    ///
    /// # Errors
    /// Returns the errors of [`create`](Self::create).
    pub fn create_named(directory: impl AsRef<Path>, prefix: &str, drones: usize) -> Result<Self, RecordError> {
        let directory = directory.as_ref();
        std::fs::create_dir_all(directory).map_err(|error| RecordError::file(directory, error))?;
        for path in (drones..).map(|drone| file_of(directory, prefix, drone)).take_while(|path| path.exists()) {
            std::fs::remove_file(&path).map_err(|error| RecordError::file(&path, error))?;
        }
        Self::begin(directory, prefix, drones, false)
    }

    /// Creates the files in an existing directory. If `new` is set, returns an error if a flight with the prefix
    /// exists.
    pub(super) fn begin(directory: &Path, prefix: &str, drones: usize, new: bool) -> Result<Self, RecordError> {
        let header = COLUMNS.join(",") + "\n";
        let begin = |drone| {
            let path = file_of(directory, prefix, drone);
            // the file of the first drone stands for the files of all drones
            let file = if new && drone == 0 { AppendFile::create_new(&path) } else { AppendFile::create(&path) };
            let created = file.and_then(|mut file| file.append(header.as_bytes()).map(|()| file));
            match created {
                Ok(file) => Ok((path, file)),
                Err(error) => Err(RecordError::file(&path, error)),
            }
        };
        let files = (0..drones).map(begin).collect::<Result<_, _>>()?;
        let obstacles = obstacles::file_of(directory, prefix);
        if obstacles.exists() {
            std::fs::remove_file(&obstacles).map_err(|error| RecordError::file(&obstacles, error))?;
        }
        Ok(Self { files, obstacles: (obstacles, None), last: vec![None; drones], rows: vec![Row::default(); drones] })
    }

    /// Writes a row for every drone of an environment; call it after every reset and every step.
    ///
    /// # Errors
    /// [`RecordError::File`] with the path of the file, and [`RecordError::Drones`] for another number of drones.
    pub fn record(&mut self, env: &dyn DroneEnv) -> Result<(), RecordError> {
        self.record_with(env.simulation(), |drone| (env.drone_reward(drone), Some(env.reference(drone))))
    }

    /// Writes a row for every drone of a simulation. `of` returns the reward and the reference of a drone.
    ///
    /// # Errors
    /// Returns the errors of [`record`](Self::record).
    pub fn record_with(
        &mut self,
        simulation: &Simulation,
        of: impl Fn(usize) -> (f64, Option<Reference>),
    ) -> Result<(), RecordError> {
        if simulation.num_drones() != self.files.len() {
            return Err(RecordError::Drones { got: simulation.num_drones(), expected: self.files.len() });
        }
        // before the drones: a killed program leaves no state without the obstacles of its control step
        match &mut self.obstacles {
            (_, Some(log)) => log.record(simulation)?,
            (path, log @ None) if !simulation.moving_obstacles().is_empty() => {
                *log = Some(ObstacleLog::create(path.clone(), simulation)?);
            }
            (_, None) => {}
        }
        let drones = self.files.iter_mut().zip(&mut self.last).zip(&mut self.rows);
        for (drone, (((path, file), last), row)) in drones.enumerate() {
            let (reward, reference) = of(drone);
            let sample = Sample::of(simulation, drone, reward, reference.as_ref(), last.as_ref());
            row.write(drone, &sample, simulation.rpy(drone).as_slice());
            file.append(&row.text).map_err(|error| RecordError::file(path, error))?;
            *last = Some(sample);
        }
        Ok(())
    }
}

impl Recorder {
    /// Writes the rows of a flight in memory, for example to continue the log of a flight that was rewound.
    ///
    /// # Errors
    /// Returns the errors of [`record`](Self::record).
    pub fn record_flight(&mut self, flight: &Flight) -> Result<(), RecordError> {
        if flight.drones.len() != self.files.len() {
            return Err(RecordError::Drones { got: flight.drones.len(), expected: self.files.len() });
        }
        let drones = self.files.iter_mut().zip(&mut self.last).zip(&mut self.rows).zip(&flight.drones);
        for (drone, ((((path, file), last), row), samples)) in drones.enumerate() {
            for sample in samples {
                row.write(drone, sample, sample.state.rpy().as_slice());
                file.append(&row.text).map_err(|error| RecordError::file(path, error))?;
                *last = Some(*sample);
            }
        }
        Ok(())
    }

    /// Writes the poses of the moving obstacles of a flight that was rewound; `simulation` is at the last of them.
    ///
    /// # Errors
    /// [`RecordError::File`] with the path of the file.
    pub fn record_obstacle_poses(
        &mut self,
        simulation: &Simulation,
        poses: &[ObstaclePose],
    ) -> Result<(), RecordError> {
        let (path, log) = &mut self.obstacles;
        log.insert(ObstacleLog::create(path.clone(), simulation)?).repeat(poses)
    }
}

/// Number of columns without the reference, which may be empty.
const WITHOUT_REFERENCE: usize = COLUMNS.len() - 4;

/// Column of the drone's index.
const DRONE: usize = 1;

/// A row as text. Numbers that have not changed, such as a constant reference, are copied from the text of the
/// previous row.
#[derive(Debug, Clone, Default)]
struct Row {
    text: Vec<u8>,
    before: Vec<u8>,
    /// Bits of every number of the previous row, and the end of its text including the comma.
    bits: [u64; COLUMNS.len()],
    ends: [usize; COLUMNS.len()],
    /// Number of numbers in the previous row.
    count: usize,
}

impl Row {
    fn write(&mut self, drone: usize, sample: &Sample, rpy: &[f64]) {
        let Sample { time, state, acceleration, motor_speeds, reward, reference } = sample;
        let mut numbers = [0.0; COLUMNS.len()];
        let mut count = 0;
        let mut add = |part: &[f64]| {
            numbers[count..count + part.len()].copy_from_slice(part);
            count += part.len();
        };
        add(&[*time, drone as f64]);
        add(&state_numbers(state));
        add(rpy);
        add(motor_speeds);
        add(acceleration.as_slice());
        add(&[*reward]);
        debug_assert_eq!(count, WITHOUT_REFERENCE);
        if let Some((position, yaw)) = reference {
            numbers[WITHOUT_REFERENCE..].copy_from_slice(&[position[0], position[1], position[2], *yaw]);
            count = COLUMNS.len();
        }
        numbers = numbers.map(written);
        self.format(&numbers[..count]);
        if count == WITHOUT_REFERENCE {
            self.text.extend_from_slice(b",,,,");
        }
        self.text.pop();
        self.text.push(b'\n');
    }

    fn format(&mut self, numbers: &[f64]) {
        std::mem::swap(&mut self.text, &mut self.before);
        self.text.clear();
        let mut buffer = zmij::Buffer::new();
        let mut ends = [0; COLUMNS.len()];
        let mut column = 0;
        while column < numbers.len() {
            // a run of unchanged numbers is copied at once
            let same = |i: &usize| *i < self.count && numbers[*i].to_bits() == self.bits[*i];
            let run = (column..numbers.len()).take_while(same).count();
            if run > 0 {
                let begin = if column > 0 { self.ends[column - 1] } else { 0 };
                let end = self.ends[column + run - 1];
                let here = self.text.len();
                self.text.extend_from_slice(&self.before[begin..end]);
                // in the previous row, the last column ends in a line end
                self.text[here + end - begin - 1] = b',';
                for (end, before) in ends.iter_mut().zip(&self.ends).skip(column).take(run) {
                    *end = here + before - begin;
                }
                column += run;
            } else {
                // the shortest text that reads back bit-exactly; an index has no decimals
                let text = buffer.format(numbers[column]);
                let text = if column == DRONE { text.trim_end_matches(".0") } else { text };
                self.text.extend_from_slice(text.as_bytes());
                self.text.push(b',');
                ends[column] = self.text.len();
                column += 1;
            }
        }
        self.ends = ends;
        self.bits.iter_mut().zip(numbers).for_each(|(bits, number)| *bits = number.to_bits());
        self.count = numbers.len();
    }
}
