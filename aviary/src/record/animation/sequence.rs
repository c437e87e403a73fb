use std::path::{Path, PathBuf};

use super::Animation;
use crate::record::RecordError;
use crate::record::images::png_rgb;
use crate::vision::ImageSize;

/// Numbered PNG files in a directory: `00000.png`, `00001.png`, …
#[derive(Debug)]
pub struct PngSequence {
    directory: PathBuf,
    size: ImageSize,
    frames: usize,
}

impl PngSequence {
    /// Creates a sequence in a directory, which is created if necessary. Removes the frames of an earlier sequence.
    ///
    /// # Errors
    /// [`RecordError::File`] if the directory cannot be created or an earlier frame cannot be removed.
    pub fn create(directory: impl AsRef<Path>, size: ImageSize) -> Result<Self, RecordError> {
        let directory = directory.as_ref().to_path_buf();
        std::fs::create_dir_all(&directory).map_err(|error| RecordError::file(&directory, error))?;
        let sequence = Self { directory, size, frames: 0 };
        for path in (0..).map(|frame| sequence.file(frame)).take_while(|path| path.exists()) {
            std::fs::remove_file(&path).map_err(|error| RecordError::file(&path, error))?;
        }
        Ok(sequence)
    }

    /// Returns the paths of the files written so far.
    pub fn files(&self) -> impl Iterator<Item = PathBuf> + '_ {
        (0..self.frames).map(|frame| self.file(frame))
    }

    fn file(&self, frame: usize) -> PathBuf {
        self.directory.join(format!("{frame:05}.png"))
    }
}

impl Animation for PngSequence {
    fn frame(&mut self, rgb: &[u8]) -> Result<(), RecordError> {
        let path = self.file(self.frames);
        // the file has another name until it is complete
        let part = path.with_extension("part");
        let written = std::fs::write(&part, png_rgb(self.size, rgb)?).and_then(|()| std::fs::rename(&part, &path));
        if let Err(error) = written {
            let _ = std::fs::remove_file(&part);
            return Err(RecordError::file(&path, error));
        }
        self.frames += 1;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_become_numbered_files_that_read_back() {
        let directory = tempfile::tempdir().unwrap();
        let size = ImageSize { width: 2, height: 1 };
        let mut sequence = PngSequence::create(directory.path().join("frames"), size).unwrap();
        sequence.frame(&[1, 2, 3, 4, 5, 6]).unwrap();
        assert!(sequence.frame(&[1, 2, 3]).is_err());
        sequence.frame(&[7; 6]).unwrap();
        let files: Vec<_> = sequence.files().collect();
        assert!(files[1].ends_with("frames/00001.png"));
        let back = image::load_from_memory(&std::fs::read(&files[0]).unwrap()).unwrap();
        assert_eq!(back.as_rgb8().unwrap().as_raw()[..], [1, 2, 3, 4, 5, 6]);
        // a new sequence in the same directory removes the old one
        PngSequence::create(directory.path().join("frames"), size).unwrap();
        assert!(!files[0].exists() && !files[1].exists());
    }
}
