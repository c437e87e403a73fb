//! Animations: GIF, numbered PNG files, and MP4 through `ffmpeg`.

mod gif;
mod sequence;
mod video;

pub use gif::GifAnimation;
pub use sequence::PngSequence;
pub use video::Mp4;

use super::RecordError;

/// Returns an error unless the time per frame (s) is positive and finite.
fn check_time(seconds: f64) -> Result<(), RecordError> {
    if seconds.is_finite() && seconds > 0.0 { Ok(()) } else { Err(RecordError::FrameTime { got: seconds }) }
}

/// Sink for frames of an animation.
pub trait Animation {
    /// Adds a frame: RGB, three bytes per pixel, top row first.
    ///
    /// # Errors
    /// [`RecordError::Image`] for a buffer of the wrong length, and other variants if the frame cannot be encoded
    /// or written.
    fn frame(&mut self, rgb: &[u8]) -> Result<(), RecordError>;
}
