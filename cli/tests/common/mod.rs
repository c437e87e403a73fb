//! The program as other programs call it.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

pub fn aviary(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_aviary")).args(arguments).output().expect("the program starts")
}

pub fn directory(name: &str) -> PathBuf {
    let path = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join(name);
    let _ = std::fs::remove_dir_all(&path);
    path
}

pub fn text(path: &Path) -> &str {
    path.to_str().expect("a path in UTF-8")
}

/// Runs, expects this status and one line on standard error that holds all of these texts, and nothing on standard
/// output.
pub fn refused(arguments: &[&str], status: i32, texts: &[&str]) {
    let output = aviary(arguments);
    let error = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(status), "{arguments:?}: {error}");
    assert_eq!(error.lines().count(), 1, "{arguments:?}: {error}");
    assert!(!error.contains("panicked"), "{error}");
    for text in texts {
        assert!(error.contains(text), "{arguments:?}: {error}");
    }
    assert!(output.stdout.is_empty());
}
