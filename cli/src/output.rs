//! Standard output and output files.

use std::fs;
use std::io::Write as _;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use tempfile::NamedTempFile;

use crate::failure::Failure;

/// Prints text on standard output; a reader that has gone away is no failure of the work.
pub fn print(text: &str) -> Result<(), Failure> {
    match std::io::stdout().write_all(text.as_bytes()) {
        Err(error) if error.kind() != std::io::ErrorKind::BrokenPipe => {
            Err(Failure::work(anyhow::Error::new(error).context("standard output cannot be written")))
        }
        _ => Ok(()),
    }
}

/// Prints one JSON object on standard output.
pub fn print_json(value: &serde_json::Value) -> Result<(), Failure> {
    print(&format!("{value:#}\n"))
}

/// A table of labels and values.
pub fn table(rows: &[(&str, String)]) -> String {
    let width = rows.iter().map(|(label, _)| label.chars().count()).max().unwrap_or(0);
    rows.iter().map(|(label, value)| format!("{label:width$}  {value}\n")).collect()
}

/// A directory for output files, made where it is missing.
#[derive(Debug)]
pub struct OutputDir(PathBuf);

impl OutputDir {
    /// Makes sure that the directory is there and can be written to, before any work is done.
    pub fn create(path: &Path) -> Result<Self, Failure> {
        let prepare = || {
            fs::create_dir_all(path)?;
            NamedTempFile::new_in(path).map(drop)
        };
        prepare().with_context(|| path.display().to_string()).map_err(Failure::work)?;
        Ok(Self(path.to_path_buf()))
    }

    /// Begins a file that appears under its name when it is [kept](Self::keep), whole, or not at all.
    pub fn begin(&self) -> Result<NamedTempFile, Failure> {
        NamedTempFile::new_in(&self.0).with_context(|| self.0.display().to_string()).map_err(Failure::work)
    }

    /// Gives a finished file its name.
    pub fn keep(&self, file: NamedTempFile, name: &str) -> Result<PathBuf, Failure> {
        let path = self.0.join(name);
        let kept = (|| {
            // temporary files are private to their owner; output files are like any other
            #[cfg(unix)]
            {
                use std::os::unix::fs::PermissionsExt as _;
                file.as_file().set_permissions(fs::Permissions::from_mode(0o644))?;
            }
            file.persist(&path).map_err(|error| error.error)?;
            Ok::<_, std::io::Error>(())
        })();
        kept.with_context(|| path.display().to_string()).map_err(Failure::work)?;
        Ok(path)
    }

    /// Writes a whole file.
    pub fn write(&self, name: &str, bytes: &[u8]) -> Result<PathBuf, Failure> {
        let mut file = self.begin()?;
        let path = self.0.join(name);
        file.write_all(bytes).with_context(|| path.display().to_string()).map_err(Failure::work)?;
        self.keep(file, name)
    }
}
