//! Pictures that follow each other: GIF, numbered PNG files, MP4 through `ffmpeg`.

mod gif;
mod sequence;
mod video;

pub use gif::GifAnimation;
pub use sequence::PngSequence;
pub use video::Mp4;

use super::RecordError;

/// Whether a frame may take so long, s.
fn check_time(seconds: f64) -> Result<(), RecordError> {
    if seconds.is_finite() && seconds > 0.0 { Ok(()) } else { Err(RecordError::FrameTime { got: seconds }) }
}

/// Something that frames can be put into, one after the other.
pub trait Animation {
    /// Adds a frame: RGB, three bytes per pixel, top row first.
    ///
    /// # Errors
    /// [`RecordError::Picture`] for a buffer of the wrong length, else where it cannot be encoded or written.
    fn frame(&mut self, rgb: &[u8]) -> Result<(), RecordError>;
}
