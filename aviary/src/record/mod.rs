//! Flights and pictures as files.

mod log;
pub mod picture;
pub mod plot;
mod recorded;
mod replay;

pub use log::CsvLog;
pub use recorded::Recorded;
pub use replay::{ReplayError, Scenario, read_actions};

use crate::vision::ImageSize;

/// What can go wrong with a record.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RecordError {
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
