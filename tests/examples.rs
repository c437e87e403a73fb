//! Every example runs, headless and short. `cargo test` builds them beside the tests.

use std::path::PathBuf;
use std::process::Command;

use mujoco_drones_gym::mujoco::{Error, gl_info};

/// Runs an example and gives the directory that it wrote to; `None` where there is nothing to draw with or where this
/// test alone was built.
fn run(name: &str, more: &[&str]) -> Option<(tempfile::TempDir, String)> {
    if matches!(gl_info(), Err(Error::NoGl { .. })) {
        return None;
    }
    let mut program: PathBuf = std::env::current_exe().unwrap();
    program.pop();
    program.pop();
    program.extend(["examples", name]);
    if !program.exists() {
        return None;
    }
    let directory = tempfile::tempdir().unwrap();
    let output = Command::new(program).arg(directory.path()).args(more).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    Some((directory, String::from_utf8(output.stdout).unwrap()))
}

#[test]
fn views_draws_every_view() {
    let Some((directory, printed)) = run("views", &[]) else { return };
    let files = std::fs::read_dir(directory.path()).unwrap().count();
    assert_eq!((files, printed.lines().count()), (12, 12));
}

#[test]
fn downwash_raises_the_lower_drones_thrust() {
    let Some((directory, printed)) = run("downwash", &["6"]) else { return };
    for name in ["downwash.svg", "downwash.png"] {
        assert!(directory.path().join(name).metadata().unwrap().len() > 10_000, "{name}");
    }
    let line = printed.lines().last().unwrap();
    let thrusts: Vec<f64> =
        line.split([' ', ',']).filter_map(|word| word.parse().ok()).filter(|x: &f64| *x > 0.5).collect();
    assert!(thrusts.len() == 2 && (thrusts[0] - 1.0).abs() < 0.01 && thrusts[1] > 1.05, "{line}");
}
