use std::fs::File;
use std::io::Write as _;
use std::path::{Path, PathBuf};

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

/// A drone's file in a directory.
pub(super) fn file_of(directory: &Path, drone: usize) -> PathBuf {
    directory.join(format!("drone{drone}.csv"))
}

/// Writes a flight as CSV while it is flown: one file per drone, `drone0.csv` and on, one row per call with the
/// [columns](COLUMNS) of a [`Sample`]. Numbers read back to the same bits.
///
/// Every row is handed to the operating system whole before the call returns, so that a program that crashes or is killed
/// leaves files that can be read up to its last row or the one before.
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
    files: Vec<(PathBuf, File)>,
    last: Vec<Option<Sample>>,
    line: Vec<u8>,
}

impl Recorder {
    /// Begins the files of so many drones in a directory, which is made where there is none. Files of an earlier flight
    /// are replaced, also those of drones that this one does not have.
    ///
    /// # Errors
    /// [`RecordError::File`] naming the file.
    pub fn create(directory: impl AsRef<Path>, drones: usize) -> Result<Self, RecordError> {
        let directory = directory.as_ref();
        std::fs::create_dir_all(directory).map_err(|error| RecordError::file(directory, error))?;
        for path in (drones..).map(|drone| file_of(directory, drone)).take_while(|path| path.exists()) {
            std::fs::remove_file(&path).map_err(|error| RecordError::file(&path, error))?;
        }
        let header = COLUMNS.join(",") + "\n";
        let begin = |drone| {
            let path = file_of(directory, drone);
            let begun = File::create(&path).and_then(|mut file| file.write_all(header.as_bytes()).map(|()| file));
            match begun {
                Ok(file) => Ok((path, file)),
                Err(error) => Err(RecordError::file(&path, error)),
            }
        };
        let files = (0..drones).map(begin).collect::<Result<_, _>>()?;
        Ok(Self { files, last: vec![None; drones], line: Vec::with_capacity(1024) })
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
        for (drone, ((path, file), last)) in self.files.iter_mut().zip(&mut self.last).enumerate() {
            let (reward, reference) = of(drone);
            let sample = Sample::of(simulation, drone, reward, reference.as_ref(), last.as_ref());
            self.line.clear();
            write_row(&mut self.line, &sample, simulation.rpy(drone).as_slice());
            // one call for one row: nothing of it waits in the program
            file.write_all(&self.line).map_err(|error| RecordError::file(path, error))?;
            *last = Some(sample);
        }
        Ok(())
    }
}

/// Writes a sample as a row.
fn write_row(line: &mut Vec<u8>, sample: &Sample, rpy: &[f64]) {
    let Sample { time, state, acceleration, motor_speeds, reward, reference } = sample;
    let mut buffer = zmij::Buffer::new();
    let mut number = |x: f64| {
        // the shortest text that reads back to the same bits
        line.extend_from_slice(buffer.format(x).as_bytes());
        line.push(b',');
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
        None => line.extend_from_slice(b",,,,"),
    }
    line.pop();
    line.push(b'\n');
}

impl RecordError {
    pub(super) fn file(path: &Path, error: std::io::Error) -> Self {
        Self::File { path: path.to_path_buf(), error }
    }
}
