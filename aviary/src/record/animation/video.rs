use std::ffi::{OsStr, OsString};
use std::io::{Read as _, Write as _};
use std::path::Path;
use std::process::{Child, ChildStdin, Command, Stdio};
use std::thread::JoinHandle;

use super::{Animation, check_time};
use crate::record::RecordError;
use crate::record::images::check;
use crate::vision::ImageSize;

/// A video in an MP4 file, encoded by the program `ffmpeg`.
#[derive(Debug)]
pub struct Mp4 {
    child: Child,
    pixels: Option<ChildStdin>,
    /// Thread that collects the error messages of `ffmpeg`, so that `ffmpeg` never blocks on its stderr.
    messages: Option<JoinHandle<String>>,
    size: ImageSize,
}

impl Mp4 {
    /// Creates a video with a time per frame in s. The file is complete after [`finish`](Self::finish).
    ///
    /// # Errors
    /// [`RecordError::Video`] if `ffmpeg` is not installed, and [`RecordError::FrameTime`] for an invalid time.
    pub fn create(path: impl AsRef<Path>, size: ImageSize, seconds_per_frame: f64) -> Result<Self, RecordError> {
        Self::with_program("ffmpeg", path, size, seconds_per_frame)
    }

    /// Creates a video with another program that accepts the options of `ffmpeg`.
    ///
    /// # Errors
    /// Returns the errors of [`create`](Self::create).
    pub fn with_program(
        program: impl AsRef<OsStr>,
        path: impl AsRef<Path>,
        size: ImageSize,
        seconds_per_frame: f64,
    ) -> Result<Self, RecordError> {
        let program = program.as_ref();
        check_time(seconds_per_frame)?;
        // the prefix `file:` allows names that start with a dash or contain a colon
        let mut file = OsString::from("file:");
        file.push(path.as_ref());
        let mut child = Command::new(program)
            .args(["-loglevel", "error", "-nostdin", "-y", "-f", "rawvideo", "-pixel_format", "rgb24"])
            .args(["-video_size", &size.to_string(), "-framerate", &(1.0 / seconds_per_frame).to_string()])
            // players need an even number of rows and columns, and colours at half the resolution
            .args(["-i", "-", "-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p"])
            // the index comes first, so that players can start before the file is loaded
            .args(["-movflags", "+faststart", "-f", "mp4"])
            .arg(&file)
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .map_err(|error| {
                let program = program.to_string_lossy();
                RecordError::Video(match error.kind() {
                    std::io::ErrorKind::NotFound => {
                        format!("`{program}` is not installed; run `apt-get install ffmpeg`, or write a GIF")
                    }
                    _ => format!("`{program}` cannot be started: {error}"),
                })
            })?;
        // its drop ends the program if the thread cannot start
        let mut video = Self { pixels: child.stdin.take(), child, messages: None, size };
        if let Some(mut pipe) = video.child.stderr.take() {
            let read = move || {
                let mut text = Vec::new();
                // a read error means that the pipe has closed; the text so far is complete
                let _ = pipe.read_to_end(&mut text);
                String::from_utf8_lossy(&text).into_owned()
            };
            let thread = std::thread::Builder::new().name("ffmpeg".into()).spawn(read);
            let thread = thread.map_err(|error| {
                let program = program.to_string_lossy();
                RecordError::Video(format!("a thread for the messages of `{program}` cannot be started: {error}"))
            })?;
            video.messages = Some(thread);
        }
        Ok(video)
    }

    /// Completes the video and closes the file.
    ///
    /// # Errors
    /// [`RecordError::Video`] with the last error message of `ffmpeg`.
    pub fn finish(mut self) -> Result<(), RecordError> {
        self.end()
    }

    fn end(&mut self) -> Result<(), RecordError> {
        drop(self.pixels.take());
        let status =
            self.child.wait().map_err(|error| RecordError::Video(format!("waiting for ffmpeg failed: {error}")))?;
        let messages = self.messages.take().and_then(|thread| thread.join().ok()).unwrap_or_default();
        if status.success() {
            return Ok(());
        }
        let last = messages.lines().rfind(|line| !line.trim().is_empty()).unwrap_or("no error message");
        Err(RecordError::Video(format!("ffmpeg failed ({status}): {last}")))
    }
}

impl Animation for Mp4 {
    fn frame(&mut self, rgb: &[u8]) -> Result<(), RecordError> {
        check(self.size, rgb.len(), 3)?;
        let Some(pixels) = &mut self.pixels else {
            return Err(RecordError::Video("the video has ended".into()));
        };
        match pixels.write_all(rgb) {
            Ok(()) => Ok(()),
            // `ffmpeg` has ended: its error message is more useful than a broken pipe
            Err(error) => Err(self.end().err().unwrap_or_else(|| RecordError::Video(format!("ffmpeg: {error}")))),
        }
    }
}

impl Drop for Mp4 {
    fn drop(&mut self) {
        // an unfinished video leaves no process behind
        if self.pixels.take().is_some() {
            let _ = self.child.kill();
        }
        let _ = self.child.wait();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::PermissionsExt as _;

    const SIZE: ImageSize = ImageSize { width: 4, height: 2 };

    /// Creates a program that runs a shell script.
    fn script(directory: &Path, text: &str) -> std::path::PathBuf {
        let path = directory.join("encoder");
        std::fs::write(&path, format!("#!/bin/sh\n{text}\n")).unwrap();
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o755)).unwrap();
        path
    }

    // one test, because a script cannot be started while another thread holds it open to start a program
    #[test]
    fn the_encoder_receives_every_frame_and_its_errors_are_reported() {
        let directory = tempfile::tempdir().unwrap();
        let file = directory.path().join("flight.mp4");
        let encoder = script(
            directory.path(),
            r#"for last; do :; done; file="${last#file:}"; echo "$@" > "$file.arguments"; cat > "$file""#,
        );
        let mut video = Mp4::with_program(&encoder, &file, SIZE, 1.0 / 24.0).unwrap();
        video.frame(&[7; 24]).unwrap();
        assert!(video.frame(&[7; 23]).is_err());
        video.frame(&[9; 24]).unwrap();
        video.finish().unwrap();
        assert_eq!(std::fs::read(&file).unwrap(), [[7; 24], [9; 24]].concat());
        let arguments = std::fs::read_to_string(directory.path().join("flight.mp4.arguments")).unwrap();
        assert!(arguments.contains("-video_size 4x2 -framerate 24"), "{arguments}");

        let missing = Mp4::with_program("no-such-encoder", &file, SIZE, 0.04).unwrap_err().to_string();
        assert!(missing.contains("not installed") && missing.contains("apt-get install ffmpeg"), "{missing}");

        let encoder = script(directory.path(), "echo 'Unknown encoder' >&2; exit 3");
        let mut video = Mp4::with_program(&encoder, &file, SIZE, 0.04).unwrap();
        // several frames may fit into the pipe before it breaks
        let failed = (0..100_000).find_map(|_| video.frame(&[0; 24]).err());
        let message = failed.map_or_else(|| video.finish().unwrap_err().to_string(), |error| error.to_string());
        assert!(message.contains("Unknown encoder"), "{message}");
        assert!(Mp4::with_program(&encoder, &file, SIZE, f64::NAN).is_err());
    }
}
