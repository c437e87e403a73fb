//! Recording of flights and images to files.
//!
//! [`Recorder`] and [`Recorded`] write a flight to files while it runs. [`Flight`] holds a flight in memory and
//! reads it from files. [`plot`] draws flights. [`FrameRecorder`] renders frames, which [`animation`] writes to
//! files.

pub mod animation;
mod files;
mod flight;
mod frame_recorder;
pub mod images;
mod log;
mod obstacles;
pub mod plot;
mod recorded;
mod recorder;
mod replay;
mod scenario;
mod table;

use std::path::{Path, PathBuf};

pub use files::files;
pub use flight::{Flight, Sample};
pub use frame_recorder::{FrameRecorder, Overlays};
pub use log::CsvLog;
pub use obstacles::{ObstaclePose, poses as obstacle_poses, read_obstacle_poses, read_obstacle_poses_named};
pub use recorded::Recorded;
pub use recorder::Recorder;
pub use replay::{read_actions, read_motor_speeds};
pub use scenario::{ReplayError, Scenario, ScenarioBody};
pub use table::{COLUMNS, STATE_COLUMNS, state_numbers};

use crate::vision::ImageSize;

/// Error of a recording.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RecordError {
    /// A file that cannot be created or written.
    #[error("{}: {error}", path.display())]
    File {
        /// Path of the file.
        path: PathBuf,
        /// Error of the system.
        #[source]
        error: std::io::Error,
    },
    /// A file that is not a valid recording.
    #[error("{}: {message}", flight::at(path, *line))]
    Read {
        /// Path of the file.
        path: PathBuf,
        /// Line, from 1; 0 for the whole file.
        line: usize,
        /// Description of the error and the expected content.
        message: String,
    },
    /// A recorder for another number of drones.
    #[error("the simulation has {}, expected {expected}", crate::count(*got, "drone"))]
    Drones {
        /// Number of drones of the simulation.
        got: usize,
        /// Number of drones of the recorder.
        expected: usize,
    },
    /// A log that cannot be written.
    #[error("the log cannot be written")]
    Write(#[from] csv::Error),
    /// A log whose last rows cannot be written.
    #[error("the log cannot be written")]
    Flush(#[from] std::io::Error),
    /// An image that cannot be encoded or written.
    #[error("the image cannot be written")]
    Encode(#[from] image::ImageError),
    /// An animation that cannot be written.
    #[error("the animation cannot be written")]
    Animation(#[from] gif::EncodingError),
    /// An invalid time per frame.
    #[error("the time per frame is {} s, expected a positive number", crate::number(*got))]
    FrameTime {
        /// Time per frame, s.
        got: f64,
    },
    /// An error of `ffmpeg`, which encodes videos.
    #[error("{0}")]
    Video(String),
    /// A plot that cannot be drawn.
    #[error("the plot cannot be drawn: {0}")]
    Plot(String),
    /// A buffer whose length does not match the size of the image.
    #[error("an image of {size} has {got} values, expected {expected}")]
    Image {
        /// Size of the image.
        size: ImageSize,
        /// Length of the buffer.
        got: usize,
        /// Length for the size.
        expected: usize,
    },
}

impl RecordError {
    fn file(path: &Path, error: std::io::Error) -> Self {
        Self::File { path: path.to_path_buf(), error }
    }
}
