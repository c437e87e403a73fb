//! Poses of moving obstacles during a flight, `obstacles.csv` in its directory.

use std::path::{Path, PathBuf};

use append_file::AppendFile;
use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use super::table::written;
use super::{RecordError, flight};
use crate::simulation::Simulation;
use crate::world::{MarkerPose, Obstacle, World};

/// Pose of a moving obstacle from a time on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ObstaclePose {
    /// Simulated time, s.
    pub time: f64,
    /// Index of the obstacle.
    pub obstacle: usize,
    /// Pose.
    pub pose: MarkerPose,
}

/// Row of the file: time (s), index, position (world frame, m), roll, pitch and yaw (rad).
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Row {
    t: f64,
    obstacle: usize,
    x: f64,
    y: f64,
    z: f64,
    roll: f64,
    pitch: f64,
    yaw: f64,
}

/// First line of the file.
const HEADER: &str = "t,obstacle,x,y,z,roll,pitch,yaw\n";

/// Returns the file in the directory of a flight. `prefix` distinguishes the flights in the directory.
pub(super) fn file_of(directory: &Path, prefix: &str) -> PathBuf {
    directory.join(format!("{prefix}obstacles.csv"))
}

/// Reads the poses of the moving obstacles of a flight from its directory, in the order of the file. Obstacles have the
/// poses of the scenario until their first row.
///
/// # Errors
/// [`RecordError::Read`] with the file and the line for a file that does not exist or has another format, and for numbers
/// out of range.
pub fn read_obstacle_poses(directory: impl AsRef<Path>) -> Result<Vec<ObstaclePose>, RecordError> {
    read_obstacle_poses_named(directory, "")
}

/// Reads the file of a directory whose name starts with a prefix, as [`Recorded`](super::Recorded) writes it.
///
/// # Errors
/// As for [`read_obstacle_poses`].
pub fn read_obstacle_poses_named(directory: impl AsRef<Path>, prefix: &str) -> Result<Vec<ObstaclePose>, RecordError> {
    let path = file_of(directory.as_ref(), prefix);
    let wrong = |line: usize, message: String| flight::wrong(&path, line, message);
    let bytes = std::fs::read(&path).map_err(|error| wrong(0, error.to_string()))?;
    let mut reader = csv::Reader::from_reader(&bytes[..]);
    let header: Vec<_> = reader.headers().map_err(|error| wrong(1, error.to_string()))?.iter().collect();
    if !header.iter().copied().eq(HEADER.trim_end().split(',')) {
        return Err(wrong(1, format!("columns {}, expected {}", header.join(","), HEADER.trim_end())));
    }
    let mut poses: Vec<ObstaclePose> = Vec::new();
    for row in reader.deserialize() {
        let row: Row = row.map_err(|error| {
            let line = error.position().map_or(0, csv::Position::line);
            let message = match error.kind() {
                csv::ErrorKind::Deserialize { err, .. } => err.to_string(),
                _ => error.to_string(),
            };
            wrong(line as usize, message)
        })?;
        let line = poses.len() + 2;
        let (position, rpy) = (Vector3::new(row.x, row.y, row.z), Vector3::new(row.roll, row.pitch, row.yaw));
        let limits = [(position.as_slice(), World::MAX_COORDINATE), (rpy.as_slice(), World::MAX_ANGLE)];
        for (numbers, max) in limits.into_iter().chain([(&[row.t][..], f64::MAX)]) {
            if let Some(x) = numbers.iter().find(|x| !(-max..=max).contains(*x)) {
                let x = crate::number(*x);
                return Err(wrong(line, format!("{x}, expected finite numbers within ±{max:e}")));
            }
        }
        poses.push(ObstaclePose { time: row.t, obstacle: row.obstacle, pose: MarkerPose { position, rpy } });
    }
    Ok(poses)
}

/// Returns the present poses of the moving obstacles of a simulation.
pub fn poses(simulation: &Simulation) -> impl Iterator<Item = ObstaclePose> {
    let first = simulation.obstacles().len() - simulation.moving_obstacles().len();
    simulation.moving_obstacles().iter().enumerate().map(move |(index, body)| ObstaclePose {
        time: simulation.time(),
        obstacle: first + index,
        pose: MarkerPose { position: body.position, rpy: body.rpy },
    })
}

/// Writer of the file.
#[derive(Debug)]
pub(super) struct ObstacleLog {
    path: PathBuf,
    file: AppendFile,
    /// Obstacles of the last row, and all others that move.
    last: Vec<Obstacle>,
}

impl ObstacleLog {
    /// Creates the file at the start of a flight. The first poses are those of the scenario.
    pub fn create(path: PathBuf, simulation: &Simulation) -> Result<Self, RecordError> {
        let file = AppendFile::create(&path).and_then(|mut file| file.append(HEADER.as_bytes()).map(|()| file));
        match file {
            Ok(file) => Ok(Self { path, file, last: simulation.moving_obstacles().to_vec() }),
            Err(error) => Err(RecordError::file(&path, error)),
        }
    }

    /// Writes a row for every obstacle that has moved since the last call, and for the last obstacle, so that every
    /// control step has a row.
    pub fn record(&mut self, simulation: &Simulation) -> Result<(), RecordError> {
        let mut text = Vec::new();
        let count = self.last.len();
        let moved = self.last.iter_mut().zip(simulation.moving_obstacles()).zip(poses(simulation));
        for (index, ((last, now), pose)) in moved.enumerate() {
            if last != now || index + 1 == count {
                *last = *now;
                write(&mut text, &pose);
            }
        }
        self.append(&text)
    }

    /// Writes rows of the same flight that were read from an earlier file.
    pub fn repeat(&mut self, poses: &[ObstaclePose]) -> Result<(), RecordError> {
        let mut text = Vec::new();
        poses.iter().for_each(|pose| write(&mut text, pose));
        self.append(&text)
    }

    fn append(&mut self, text: &[u8]) -> Result<(), RecordError> {
        if text.is_empty() {
            return Ok(());
        }
        self.file.append(text).map_err(|error| RecordError::file(&self.path, error))
    }
}

/// Writes a row.
fn write(text: &mut Vec<u8>, pose: &ObstaclePose) {
    let ObstaclePose { time, obstacle, pose: MarkerPose { position, rpy } } = pose;
    let mut buffer = zmij::Buffer::new();
    text.extend_from_slice(buffer.format(*time).as_bytes());
    text.extend_from_slice(format!(",{obstacle}").as_bytes());
    for &number in position.iter().chain(rpy) {
        text.push(b',');
        text.extend_from_slice(buffer.format(written(number)).as_bytes());
    }
    text.push(b'\n');
}
