//! Helpers of the tests of the program.

#![allow(dead_code, reason = "each test binary uses some of the helpers")]

use std::ops::{Deref, DerefMut};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};

use serde_json::Value;

/// Widest error line, columns.
const MAX_WIDTH: usize = 120;

/// Runs the program.
pub fn aviary(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_aviary")).args(arguments).output().expect("the program starts")
}

/// Asserts that the program ends with status 0. Returns its standard output.
pub fn run(arguments: &[&str]) -> String {
    let output = aviary(arguments);
    assert_eq!(output.status.code(), Some(0), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

/// Asserts that the program ends with status 0. Returns the output of `--json`.
pub fn json(arguments: &[&str]) -> Value {
    serde_json::from_str(&run(&[arguments, &["--json"]].concat())).unwrap()
}

/// Asserts that the program ends with this status and prints one line, an error that contains all texts.
///
/// Without the directories of paths, the line has at most 120 columns.
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
    // without the directories of paths, which have any length
    let file_name = |word: &str| word.rsplit('/').next().filter(|_| word.starts_with('/')).unwrap_or(word).to_string();
    let short = error.trim_end().split(' ').map(file_name).collect::<Vec<_>>().join(" ");
    assert!(short.chars().count() <= MAX_WIDTH, "{} columns: {short}", short.chars().count());
}

/// Returns the path of an empty place for files of a test. The directory is not created.
pub fn directory(name: &str) -> PathBuf {
    let path = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join(name);
    let _ = std::fs::remove_dir_all(&path);
    path
}

/// Writes a file, and its directory if it is missing. Returns the path.
pub fn write(path: &Path, text: &str) -> PathBuf {
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    std::fs::write(path, text).unwrap();
    path.to_path_buf()
}

/// Writes an executable shell script.
pub fn write_script(path: &Path, text: &str) {
    use std::os::unix::fs::PermissionsExt as _;
    write(path, &format!("#!/bin/sh\n{text}\n"));
    std::fs::set_permissions(path, std::fs::Permissions::from_mode(0o755)).unwrap();
}

/// Returns a path as an argument.
pub fn text(path: &Path) -> &str {
    path.to_str().expect("a path in UTF-8")
}

/// Returns the path of a file of the reference flights.
pub fn reference(name: &str) -> String {
    format!("{}/../tests/reference/{name}", env!("CARGO_MANIFEST_DIR"))
}

/// Returns the path of a policy in `assets/policies`.
pub fn pretrained(name: &str) -> String {
    format!("{}/../assets/policies/{name}.safetensors", env!("CARGO_MANIFEST_DIR"))
}

/// Returns true if OpenGL works on this machine.
pub fn has_gl() -> bool {
    mujoco_rs::gl_info().is_ok()
}

/// Asserts that two directories have equal files of these names.
pub fn assert_equal_files(a: &Path, b: &Path, names: &[&str]) {
    for name in names {
        let [a, b] = [a, b].map(|directory| std::fs::read(directory.join(name)).unwrap());
        assert!(a == b, "{name}");
    }
}

/// Returns the number of entries of a directory.
pub fn entries(directory: &Path) -> usize {
    std::fs::read_dir(directory).unwrap().count()
}

/// Running program. It ends with the test, also if an assertion fails.
pub struct Running(Option<Child>);

impl Running {
    /// Starts a command.
    pub fn start(command: &mut Command) -> Self {
        Self(Some(command.spawn().expect("the program starts")))
    }

    /// Waits for the end of the program. Returns the output that it wrote to its pipes.
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
            // both fail for a program that has ended
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

/// Starts the program with the default handlers of all signals, as a terminal does.
pub fn spawn(arguments: &[&str]) -> Running {
    let mut command = Command::new("env");
    command.args(["--default-signal", env!("CARGO_BIN_EXE_aviary")]).args(arguments);
    Running::start(command.stdout(Stdio::null()))
}

/// Sends a signal (`-INT`) to a program.
pub fn send(signal: &str, child: &Child) {
    assert!(Command::new("kill").args([signal, &child.id().to_string()]).status().unwrap().success());
}

/// Waits until a flight has written this number of rows.
pub fn wait_for_rows(dir: &Path, child: &mut Child, count: usize) {
    wait_while(child, || aviary::record::Flight::read(dir).map_or(0, |flight| flight.drones[0].len()) < count);
}

/// Waits until a condition of a running program is false.
pub fn wait_while(child: &mut Child, condition: impl Fn() -> bool) {
    while condition() {
        assert!(child.try_wait().unwrap().is_none(), "the program has ended");
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
}

/// Returns an airframe whose motors a duty drives: cf2x with motors that hover at a duty of 0.7 and 3.7 V.
pub fn airframe_with_motors() -> String {
    let cf2x = include_str!("../../../assets/airframes/cf2x.toml");
    format!("{cf2x}\n[motors]\nspeed_per_volt = 5589.0\nvoltage = 3.7\n")
}

/// Returns a recorded flight of the [`airframe_with_motors`]: the drone climbs and descends while it yaws.
pub fn recorded_flight(seconds: f64) -> String {
    let mut text = String::from("t,px,py,pz,qw,qx,qy,qz,vx,vy,vz,gx,gy,gz,ax,ay,az,m1,m2,m3,m4,vbat\n");
    for row in 0..=(100.0 * seconds).round() as u32 {
        let t = 0.01 * f64::from(row);
        let (wave, slope, change) = (0.2 * (2.0 * t).sin(), 0.4 * (2.0 * t).cos(), -0.8 * (2.0 * t).sin());
        let (qz, qw) = (0.25 * t).sin_cos();
        let duty = 0.7 * (1.0 + change / 9.81).sqrt();
        text += &format!("{t:.2},0.5,-0.2,{},{qw},0,0,{qz},0,0,{slope}", 1.0 + wave);
        text += &format!(",0,0,0.5,0,0,{},{duty},{duty},{duty},{duty},3.7\n", 9.81 + change);
    }
    text
}
