//! Flights and pictures as files.
//!
//! [`Recorder`] and [`Recorded`] write a flight while it is flown, [`Flight`] keeps one in memory or reads it back,
//! [`plot`] draws it, [`FrameRecorder`] makes pictures of it that [`animation`] puts into files.

pub mod animation;
mod files;
mod flight;
mod frame_recorder;
mod log;
pub mod picture;
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
pub use recorded::Recorded;
pub use recorder::Recorder;
pub use replay::{read_actions, read_motor_speeds};
pub use scenario::{ReplayError, Scenario, ScenarioBody};
pub use table::{COLUMNS, STATE_COLUMNS, state_numbers};

use crate::vision::ImageSize;

/// What can go wrong with a record.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RecordError {
    /// A file that cannot be made or written.
    #[error("{}: {error}", path.display())]
    File {
        /// Its path.
        path: PathBuf,
        /// Why.
        #[source]
        error: std::io::Error,
    },
    /// A file that is no record of a flight.
    #[error("{}: {message}", flight::at(path, *line))]
    Read {
        /// Its path.
        path: PathBuf,
        /// Line, from 1; 0 for the whole.
        line: usize,
        /// What is wrong there, and what is expected.
        message: String,
    },
    /// A recorder for another number of drones.
    #[error("a flight of {}, expected {expected}", crate::count(*got, "drone"))]
    Drones {
        /// How many there are.
        got: usize,
        /// How many the files are for.
        expected: usize,
    },
    /// A log cannot be written.
    #[error("the log cannot be written")]
    Write(#[from] csv::Error),
    /// What was written cannot be brought to where it belongs.
    #[error("the log cannot be written")]
    Flush(#[from] std::io::Error),
    /// A picture cannot be encoded or written.
    #[error("the picture cannot be written")]
    Encode(#[from] image::ImageError),
    /// An animation cannot be written.
    #[error("the animation cannot be written")]
    Animation(#[from] gif::EncodingError),
    /// A time from frame to frame that is none.
    #[error("a frame takes {} s, expected a positive number of seconds", crate::number(*got))]
    FrameTime {
        /// The time, s.
        got: f64,
    },
    /// `ffmpeg`, which makes videos, is missing or refuses.
    #[error("{0}")]
    Video(String),
    /// A plot cannot be drawn.
    #[error("the plot cannot be drawn: {0}")]
    Plot(String),
    /// A buffer that is not a picture of this size.
    #[error("a picture of {size} has {got} numbers, expected {expected}")]
    Picture {
        /// The size.
        size: ImageSize,
        /// Length of the buffer.
        got: usize,
        /// What the size needs.
        expected: usize,
    },
}

impl RecordError {
    fn file(path: &Path, error: std::io::Error) -> Self {
        Self::File { path: path.to_path_buf(), error }
    }
}
