//! File names of a flight.

use std::path::{Path, PathBuf};

/// Returns the file of a drone in a directory. `prefix` distinguishes the flights in the directory.
pub(super) fn file_of(directory: &Path, prefix: &str, drone: usize) -> PathBuf {
    directory.join(format!("{prefix}drone{drone}.csv"))
}

/// Returns the existing files of a flight, `drone0.csv`, `drone1.csv`, …
pub fn files(directory: impl AsRef<Path>) -> Vec<PathBuf> {
    (0..).map(|drone| file_of(directory.as_ref(), "", drone)).take_while(|path| path.exists()).collect()
}
