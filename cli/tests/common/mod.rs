//! The program as other programs call it.

use std::ops::{Deref, DerefMut};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};

use serde_json::Value;

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
#[allow(dead_code, reason = "not every file of tests needs it")]
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

/// A started program that ends with the test, also where an assertion fails.
pub struct Running(Option<Child>);

impl Running {
    pub fn start(command: &mut Command) -> Self {
        Self(Some(command.spawn().expect("the program starts")))
    }

    /// Waits for the end of the program, and gives what it has written to its pipes.
    #[allow(dead_code, reason = "not every file of tests reads the output")]
    pub fn output(mut self) -> Output {
        self.0.take().expect("a program").wait_with_output().unwrap()
    }
}

impl Deref for Running {
    type Target = Child;

    fn deref(&self) -> &Child {
        self.0.as_ref().expect("a program")
    }
}

impl DerefMut for Running {
    fn deref_mut(&mut self) -> &mut Child {
        self.0.as_mut().expect("a program")
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        if let Some(child) = &mut self.0 {
            // one that has ended already is left alone
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

#[allow(dead_code, reason = "not every file of tests needs it")]
pub fn has_gl() -> bool {
    let doctor: Value = serde_json::from_slice(&aviary(&["doctor", "--json"]).stdout).unwrap();
    doctor["gl"].as_array().unwrap().iter().any(|answer| answer["works"] == true)
}

/// Starts the program, with the signals of a terminal's programs.
#[allow(dead_code, reason = "not every file of tests needs it")]
pub fn spawn(arguments: &[&str]) -> Running {
    let mut command = Command::new("env");
    command.args(["--default-signal", env!("CARGO_BIN_EXE_aviary")]).args(arguments);
    Running::start(command.stdout(Stdio::null()))
}

#[allow(dead_code, reason = "not every file of tests needs it")]
pub fn send(signal: &str, child: &Child) {
    assert!(Command::new("kill").args([signal, &child.id().to_string()]).status().unwrap().success());
}

/// Waits until a flight has written so many rows.
#[allow(dead_code, reason = "not every file of tests needs it")]
pub fn wait_for_rows(dir: &Path, child: &mut Child, count: usize) {
    while aviary::record::Flight::read(dir).map_or(0, |flight| flight.drones[0].len()) < count {
        assert!(child.try_wait().unwrap().is_none(), "it has ended by itself");
        std::thread::sleep(std::time::Duration::from_millis(10));
    }
}

/// Path of a reference flight's file.
#[allow(dead_code, reason = "not every file of tests needs it")]
pub fn reference(name: &str) -> String {
    format!("{}/../tests/reference/{name}", env!("CARGO_MANIFEST_DIR"))
}
