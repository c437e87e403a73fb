//! Poses of moving obstacles during a flight, `obstacles.csv` in its directory.

use std::path::{Path, PathBuf};

use append_file::AppendFile;
use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use super::table::written;
use super::{RecordError, flight};
use crate::simulation::Simulation;
use crate::world::{MarkerPose, Obstacle};

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

/// Reads the poses of the moving obstacles of a flight from its directory, in the order of time. Obstacles have the
/// poses of the scenario until their first row.
///
/// # Errors
/// [`RecordError::Read`] with the file and the line for a file that does not exist or has another format, for times
/// that decrease, and for numbers that are not finite.
pub fn read_obstacle_poses(directory: impl AsRef<Path>) -> Result<Vec<ObstaclePose>, RecordError> {
    let path = file_of(directory.as_ref(), "");
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
        if let Some(x) = position.iter().chain(&rpy).chain([&row.t]).find(|x| !x.is_finite()) {
            return Err(wrong(line, format!("{x}, expected finite numbers")));
        }
        if let Some(before) = poses.last().filter(|before| before.time > row.t) {
            let (time, before) = (crate::number(row.t), crate::number(before.time));
            return Err(wrong(line, format!("t is {time}, expected {before} or later")));
        }
        poses.push(ObstaclePose { time: row.t, obstacle: row.obstacle, pose: MarkerPose { position, rpy } });
    }
    Ok(poses)
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

    /// Writes a row for every obstacle that has moved since the last call.
    pub fn record(&mut self, simulation: &Simulation) -> Result<(), RecordError> {
        let first = simulation.obstacles().len() - simulation.moving_obstacles().len();
        let mut text = Vec::new();
        for (index, (last, now)) in self.last.iter_mut().zip(simulation.moving_obstacles()).enumerate() {
            if last != now {
                *last = *now;
                let pose = MarkerPose { position: now.position, rpy: now.rpy };
                write(&mut text, &ObstaclePose { time: simulation.time(), obstacle: first + index, pose });
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
