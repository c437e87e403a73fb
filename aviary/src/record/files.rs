//! Names of the files of a flight.

use std::path::{Path, PathBuf};

/// The file of a drone in a directory, in which `prefix` tells one flight from another.
pub(super) fn file_of(directory: &Path, prefix: &str, drone: usize) -> PathBuf {
    directory.join(format!("{prefix}drone{drone}.csv"))
}

/// The files of a flight that are there.
pub fn files(directory: impl AsRef<Path>) -> Vec<PathBuf> {
    (0..).map(|drone| file_of(directory.as_ref(), "", drone)).take_while(|path| path.exists()).collect()
}
