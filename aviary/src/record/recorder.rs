use std::path::{Path, PathBuf};

use mujoco_rs::AppendFile;

use super::RecordError;
use super::flight::Sample;
use crate::control::Reference;
use crate::env::Env;
use crate::simulation::Simulation;
use crate::state::wxyz;

/// Columns of a drone's file, with their units. Positions, velocities and accelerations are in the world frame, the
/// quaternion is body to world, angular velocities are in the body frame.
pub const COLUMNS: [&str; 29] = [
    "t_s",
    "x_m",
    "y_m",
    "z_m",
    "qw",
    "qx",
    "qy",
    "qz",
    "roll_rad",
    "pitch_rad",
    "yaw_rad",
    "vx_m_s",
    "vy_m_s",
    "vz_m_s",
    "wx_rad_s",
    "wy_rad_s",
    "wz_rad_s",
    "ax_m_s2",
    "ay_m_s2",
    "az_m_s2",
    "motor0_rpm",
    "motor1_rpm",
    "motor2_rpm",
    "motor3_rpm",
    "reward",
    "x_ref_m",
    "y_ref_m",
    "z_ref_m",
    "yaw_ref_rad",
];

/// A drone's file in a directory, in which `prefix` tells one flight from another.
pub(super) fn file_of(directory: &Path, prefix: &str, drone: usize) -> PathBuf {
    directory.join(format!("{prefix}drone{drone}.csv"))
}

/// Writes a flight as CSV while it is flown: one file per drone, `drone0.csv` and on, one row per call with the
/// [columns](COLUMNS) of a [`Sample`]. Numbers read back to the same bits.
///
/// Every row belongs to the operating system before the call returns ([`AppendFile`]), so that a program that crashes or is
/// killed leaves files that can be read up to the last row. Empty lines follow in them until the recorder is dropped, and
/// nobody else may make them shorter until then.
///
/// ```
/// use aviary::env::Env;
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
    last: Vec<Option<Sample>>,
    rows: Vec<Row>,
}

impl Recorder {
    /// Begins the files of so many drones in a directory, which is made where there is none. Files of an earlier flight
    /// are replaced, also those of drones that this one does not have.
    ///
    /// # Errors
    /// [`RecordError::File`] naming the file.
    pub fn create(directory: impl AsRef<Path>, drones: usize) -> Result<Self, RecordError> {
        Self::create_named(directory, "", drones)
    }

    /// The same with a prefix before the names of the files, for several flights in one directory.
    ///
    /// # Errors
    /// As for [`create`](Self::create).
    pub fn create_named(directory: impl AsRef<Path>, prefix: &str, drones: usize) -> Result<Self, RecordError> {
        let directory = directory.as_ref();
        if !directory.is_dir() {
            std::fs::create_dir_all(directory).map_err(|error| RecordError::file(directory, error))?;
        }
        for path in (drones..).map(|drone| file_of(directory, prefix, drone)).take_while(|path| path.exists()) {
            std::fs::remove_file(&path).map_err(|error| RecordError::file(&path, error))?;
        }
        let header = COLUMNS.join(",") + "\n";
        let begin = |drone| {
            let path = file_of(directory, prefix, drone);
            let begun = AppendFile::create(&path).and_then(|mut file| file.append(header.as_bytes()).map(|()| file));
            match begun {
                Ok(file) => Ok((path, file)),
                Err(error) => Err(RecordError::file(&path, error)),
            }
        };
        let files = (0..drones).map(begin).collect::<Result<_, _>>()?;
        Ok(Self { files, last: vec![None; drones], rows: vec![Row::default(); drones] })
    }

    /// Writes a row for every drone of an environment as it is now: call it after every reset and every step.
    ///
    /// # Errors
    /// [`RecordError::File`] naming the file, [`RecordError::Drones`] for another number of drones.
    pub fn record(&mut self, env: &dyn Env) -> Result<(), RecordError> {
        self.record_with(env.simulation(), |drone| (env.drone_reward(drone), Some(env.reference(drone))))
    }

    /// The same with another reward and reference for each drone, or without an environment.
    ///
    /// # Errors
    /// As for [`record`](Self::record).
    pub fn record_with(
        &mut self,
        simulation: &Simulation,
        of: impl Fn(usize) -> (f64, Option<Reference>),
    ) -> Result<(), RecordError> {
        if simulation.num_drones() != self.files.len() {
            return Err(RecordError::Drones { got: simulation.num_drones(), expected: self.files.len() });
        }
        let drones = self.files.iter_mut().zip(&mut self.last).zip(&mut self.rows);
        for (drone, (((path, file), last), row)) in drones.enumerate() {
            let (reward, reference) = of(drone);
            let sample = Sample::of(simulation, drone, reward, reference.as_ref(), last.as_ref());
            row.write(&sample, simulation.rpy(drone).as_slice());
            file.append(&row.text).map_err(|error| RecordError::file(path, error))?;
            *last = Some(sample);
        }
        Ok(())
    }
}

/// A row as text. Numbers that are those of the row before are copied from it: a reference that stands still, what is zero.
#[derive(Debug, Clone, Default)]
struct Row {
    text: Vec<u8>,
    before: Vec<u8>,
    /// Bits of every number, and where its text begins and ends.
    cells: [(u64, usize, usize); COLUMNS.len()],
}

impl Row {
    fn write(&mut self, sample: &Sample, rpy: &[f64]) {
        let Sample { time, state, acceleration, motor_speeds, reward, reference } = sample;
        std::mem::swap(&mut self.text, &mut self.before);
        self.text.clear();
        let mut column = 0;
        let mut number = |x: f64| {
            self.number(column, x);
            column += 1;
        };
        number(*time);
        state.position.iter().for_each(|&x| number(x));
        wxyz(&state.attitude).into_iter().for_each(&mut number);
        rpy.iter().for_each(|&x| number(x));
        state.velocity.iter().chain(&state.angular_velocity).chain(acceleration).for_each(|&x| number(x));
        motor_speeds.iter().for_each(|&x| number(x));
        number(*reward);
        match reference {
            Some((position, yaw)) => position.iter().chain([yaw]).for_each(|&x| number(x)),
            None => {
                self.text.extend_from_slice(b",,,,");
                self.cells[COLUMNS.len() - 4..].fill((0, 0, 0));
            }
        }
        self.text.pop();
        self.text.push(b'\n');
    }

    fn number(&mut self, column: usize, x: f64) {
        let start = self.text.len();
        let (bits, begin, end) = self.cells[column];
        if bits == x.to_bits() && end > begin {
            self.text.extend_from_slice(&self.before[begin..end]);
        } else {
            // the shortest text that reads back to the same bits
            self.text.extend_from_slice(zmij::Buffer::new().format(x).as_bytes());
        }
        self.cells[column] = (x.to_bits(), start, self.text.len());
        self.text.push(b',');
    }
}

impl RecordError {
    pub(super) fn file(path: &Path, error: std::io::Error) -> Self {
        Self::File { path: path.to_path_buf(), error }
    }
}
