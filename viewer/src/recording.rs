//! Images and animations of the window.

use std::fs::{self, File};
use std::io::{BufWriter, Write as _};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use aviary::record::animation::{Animation as _, GifAnimation, Mp4};
use aviary::record::images::png_rgb;
use aviary::vision::ImageSize;
use egui::ColorImage;

/// Format of an animation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum RecordingKind {
    Gif,
    Mp4,
}

/// Directory for the files of a window.
pub(crate) struct Saver {
    directory: PathBuf,
    name: String,
}

impl Saver {
    pub fn new(directory: PathBuf, name: &str) -> Self {
        Self { directory, name: name.into() }
    }

    /// Saves an image as PNG and returns a message with its name.
    pub fn image(&self, image: &ColorImage) -> Result<String, String> {
        let size = size_of(image);
        let png = png_rgb(size, &rgb_of(image, size)).map_err(|error| error.to_string())?;
        let path = self.next("png")?;
        // a file appears whole or not at all
        let part = path.with_extension("png.part");
        let written =
            File::create(&part).and_then(|mut file| file.write_all(&png)).and_then(|()| fs::rename(&part, &path));
        written.map_err(|error| {
            let _ = fs::remove_file(&part);
            format!("{}: {error}", path.display())
        })?;
        Ok(format!("saved {}", path.display()))
    }

    /// Starts an animation of the window at a size.
    pub fn recording(&self, kind: RecordingKind, [width, height]: [u32; 2]) -> Result<Recording, String> {
        let size = ImageSize { width: width.max(2) & !1, height: height.max(2) & !1 };
        let path = self.next(if kind == RecordingKind::Gif { "gif" } else { "mp4" })?;
        let seconds = Recording::SECONDS_PER_FRAME;
        let in_file = |error: &dyn std::fmt::Display| format!("{}: {error}", path.display());
        let writer = match kind {
            RecordingKind::Gif => {
                let file = File::create(&path).map_err(|error| in_file(&error))?;
                let gif = GifAnimation::new(BufWriter::new(file), size, seconds);
                Writer::Gif(Box::new(gif.map_err(|error| in_file(&error))?))
            }
            RecordingKind::Mp4 => Writer::Mp4(Mp4::create(&path, size, seconds).map_err(|error| in_file(&error))?),
        };
        Ok(Recording { writer, path, size, start: Instant::now(), frames: 0 })
    }

    /// Returns the first free name.
    fn next(&self, ending: &str) -> Result<PathBuf, String> {
        fs::create_dir_all(&self.directory).map_err(|error| format!("{}: {error}", self.directory.display()))?;
        let path = |number: u32| self.directory.join(format!("{}-{number:03}.{ending}", self.name));
        let free = (1..10_000).map(path).find(|path| !path.exists());
        free.ok_or_else(|| format!("{}: no free name for a .{ending} file", self.directory.display()))
    }
}

enum Writer {
    Gif(Box<GifAnimation<BufWriter<File>>>),
    Mp4(Mp4),
}

/// Animation in progress. It shows the window in real time.
pub(crate) struct Recording {
    writer: Writer,
    path: PathBuf,
    size: ImageSize,
    start: Instant,
    frames: u32,
}

impl Recording {
    /// Time between frames, s.
    pub const SECONDS_PER_FRAME: f64 = 1.0 / 20.0;

    /// Largest number of frames that one image fills.
    const MAX_REPEATS: u32 = 20;

    /// Returns true if the next frame is due.
    pub fn is_due(&self) -> bool {
        self.start.elapsed() >= Duration::from_secs_f64(Self::SECONDS_PER_FRAME).saturating_mul(self.frames)
    }

    /// Adds an image. An image of another size is cut off or has a black margin. An image that comes late is
    /// repeated, so that the animation has the speed of the window.
    pub fn add(&mut self, image: &ColorImage) -> Result<(), String> {
        let rgb = rgb_of(image, self.size);
        let due = (self.start.elapsed().as_secs_f64() / Self::SECONDS_PER_FRAME) as u32 + 1;
        let late = due.saturating_sub(self.frames);
        if late > Self::MAX_REPEATS {
            // an interruption of the window is left out
            self.start += Duration::from_secs_f64(Self::SECONDS_PER_FRAME) * (late - Self::MAX_REPEATS);
        }
        for _ in 0..late.min(Self::MAX_REPEATS) {
            let added = match &mut self.writer {
                Writer::Gif(gif) => gif.frame(&rgb),
                Writer::Mp4(mp4) => mp4.frame(&rgb),
            };
            added.map_err(|error| format!("{}: {error}", self.path.display()))?;
            self.frames += 1;
        }
        Ok(())
    }

    /// Ends the file and returns a message with its name.
    pub fn finish(self) -> Result<String, String> {
        let in_file = |path: &Path, error: &dyn std::fmt::Display| format!("{}: {error}", path.display());
        match self.writer {
            Writer::Gif(gif) => {
                let mut file = gif.finish().map_err(|error| in_file(&self.path, &error))?;
                file.flush().map_err(|error| in_file(&self.path, &error))?;
            }
            Writer::Mp4(mp4) => mp4.finish().map_err(|error| in_file(&self.path, &error))?,
        }
        Ok(format!("saved {}", self.path.display()))
    }
}

fn size_of(image: &ColorImage) -> ImageSize {
    ImageSize { width: image.size[0] as u32, height: image.size[1] as u32 }
}

/// Returns the pixels in a size, top row first.
fn rgb_of(image: &ColorImage, size: ImageSize) -> Vec<u8> {
    let (width, height) = (size.width as usize, size.height as usize);
    let mut rgb = vec![0; 3 * width * height];
    for (row, out) in rgb.chunks_exact_mut(3 * width).enumerate().take(image.size[1]) {
        let pixels = &image.pixels[row * image.size[0]..][..image.size[0]];
        for (pixel, out) in pixels.iter().zip(out.chunks_exact_mut(3)) {
            out.copy_from_slice(&pixel.to_array()[..3]);
        }
    }
    rgb
}

#[cfg(test)]
mod tests {
    use super::*;
    use egui::Color32;

    fn image(width: usize, height: usize) -> ColorImage {
        let pixel = |i: usize| Color32::from_rgb((i % width) as u8, (i / width) as u8, 7);
        ColorImage::new([width, height], (0..width * height).map(pixel).collect())
    }

    #[test]
    fn files_have_new_names_and_whole_images() {
        let directory = tempfile::tempdir().unwrap();
        let saver = Saver::new(directory.path().join("new"), "hover");
        assert!(saver.image(&image(5, 3)).unwrap().ends_with("hover-001.png"));
        assert!(saver.image(&image(5, 3)).unwrap().ends_with("hover-002.png"));
        assert!(fs::read(directory.path().join("new/hover-002.png")).unwrap().starts_with(b"\x89PNG"));
        assert_eq!(fs::read_dir(directory.path().join("new")).unwrap().count(), 2);
    }

    #[test]
    fn other_sizes_are_cut_off_or_have_a_margin() {
        let rgb = rgb_of(&image(4, 2), ImageSize { width: 2, height: 3 });
        assert_eq!(rgb, [0, 0, 7, 1, 0, 7, 0, 1, 7, 1, 1, 7, 0, 0, 0, 0, 0, 0]);
    }

    #[test]
    fn an_animation_of_a_window_that_changes_its_size_is_complete() {
        let directory = tempfile::tempdir().unwrap();
        let saver = Saver::new(directory.path().into(), "race");
        let mut recording = saver.recording(RecordingKind::Gif, [33, 20]).unwrap();
        for size in [(33, 20), (10, 40), (64, 8)] {
            recording.add(&image(size.0, size.1)).unwrap();
            std::thread::sleep(Duration::from_millis(60));
        }
        let message = recording.finish().unwrap();
        let gif = fs::read(message.strip_prefix("saved ").unwrap()).unwrap();
        assert!(gif.starts_with(b"GIF89a") && gif.ends_with(b";"));
        assert_eq!(gif[6..10], [32, 0, 20, 0]);
    }

    #[test]
    fn a_directory_that_cannot_be_written_is_an_error_with_its_name() {
        let directory = tempfile::tempdir().unwrap();
        let file = directory.path().join("file");
        fs::write(&file, "").unwrap();
        let error = Saver::new(file.join("inside"), "hover").image(&image(2, 2)).unwrap_err();
        assert!(error.contains("file/inside"), "{error}");
    }
}
