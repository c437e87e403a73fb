//! Short headless runs of all examples. `cargo test` builds the examples together with the tests.

mod common;

use std::path::{Path, PathBuf};
use std::process::Command;

use common::no_gl;
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::record::Flight;

/// Runs an example and returns its output directory and its standard output. Returns `None` without OpenGL, or if the
/// example was not built.
fn run(name: &str, more: &[&str]) -> Option<(tempfile::TempDir, String)> {
    if no_gl() {
        return None;
    }
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().to_string_lossy().into_owned();
    let printed = print(name, &[&[&*path], more].concat())?;
    Some((directory, printed))
}

/// Runs an example and returns its standard output, or `None` if the example was not built.
fn print(name: &str, arguments: &[&str]) -> Option<String> {
    let mut program: PathBuf = std::env::current_exe().unwrap();
    program.pop();
    program.pop();
    program.extend(["examples", name]);
    if !program.exists() {
        return None;
    }
    let output = Command::new(program).args(arguments).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    Some(String::from_utf8(output.stdout).unwrap())
}

/// Asserts that files of a directory are larger than `bytes`.
fn assert_larger(directory: &Path, names: &[&str], bytes: u64) {
    for name in names {
        let length = directory.join(name).metadata().unwrap().len();
        assert!(length > bytes, "{name} has {length} bytes");
    }
}

#[test]
fn views_writes_every_view() {
    let Some((directory, printed)) = run("views", &[]) else { return };
    let files = std::fs::read_dir(directory.path()).unwrap().count();
    assert_eq!((files, printed.lines().count()), (14, 14));
}

#[test]
fn downwash_increases_the_thrust_of_the_lower_drone() {
    let Some((directory, printed)) = run("downwash", &["6"]) else { return };
    assert_larger(directory.path(), &["downwash.svg", "downwash.png"], 10_000);
    let line = printed.lines().last().unwrap();
    let thrusts: Vec<f64> =
        line.split([' ', ',']).filter_map(|word| word.parse().ok()).filter(|x: &f64| *x > 0.5).collect();
    assert!(thrusts.len() == 2 && (thrusts[0] - 1.0).abs() < 0.01 && thrusts[1] > 1.05, "{line}");
}

#[test]
fn hover_writes_an_animation_a_recording_and_plots() {
    let Some((directory, printed)) = run("hover", &["1"]) else { return };
    assert_larger(directory.path(), &["hover.gif", "hover.png", "flight.png", "path.png"], 10_000);
    assert_eq!(Flight::read(directory.path()).unwrap().drones[0].len(), 49);
    assert_eq!(printed.lines().count(), 6, "{printed}");
}

#[test]
fn formation_writes_an_image_and_the_plots_of_its_paths() {
    let Some((directory, printed)) = run("formation", &["6", "4"]) else { return };
    assert_larger(directory.path(), &["formation.png", "flight.svg", "path.svg"], 10_000);
    let worst: f64 = printed.lines().last().unwrap().split_whitespace().rev().nth(1).unwrap().parse().unwrap();
    assert!(worst < 5.0, "{printed}");
}

#[test]
fn batch_plots_the_heights_of_its_environments() {
    let directory = tempfile::tempdir().unwrap();
    let Some(printed) = print("batch", &[&directory.path().to_string_lossy(), "1", "256"]) else { return };
    assert_larger(directory.path(), &["batch.svg"], 5_000);
    assert!(printed.contains("million environment steps per second") && printed.contains("by the flight kernel"));
}

#[test]
fn custom_airframe_hovers() {
    let Some((directory, printed)) = run("custom_airframe", &["6"]) else { return };
    let courier = DroneParams::from_file(directory.path().join("courier.toml")).unwrap();
    assert!(printed.contains(&format!("{:.0} rpm", courier.hover_rpm())));
    let off: f64 = printed.lines().last().unwrap().split_whitespace().next().unwrap().parse().unwrap();
    assert!(off < 2.0, "{printed}");
}

#[test]
fn camera_dataset_has_three_images_and_a_pose_per_frame() {
    let Some((directory, _)) = run("camera_dataset", &["3"]) else { return };
    for kind in ["rgb", "depth", "objects"] {
        for frame in 0..3 {
            assert!(directory.path().join(format!("{kind}_{frame:05}.png")).exists(), "{kind} {frame}");
        }
    }
    assert_eq!(std::fs::read_to_string(directory.path().join("poses.csv")).unwrap().lines().count(), 4);
    assert_larger(directory.path(), &["sheet.png"], 5_000);
}

#[test]
fn pid_records_and_plots_its_three_flights() {
    let Some((directory, printed)) = run("pid", &["3"]) else { return };
    for (name, drones) in [("hover", 1), ("square", 1), ("swarm", 3)] {
        let flight = Flight::read(directory.path().join(name)).unwrap();
        assert_eq!((flight.drones.len(), flight.drones[0].len()), (drones, 3 * 48 + 1), "{name}");
        for plot in ["flight.svg", "path.svg"] {
            assert!(directory.path().join(name).join(plot).exists());
        }
    }
    assert!(directory.path().join("swarm.png").exists() && printed.lines().count() == 4);
}

#[test]
fn the_guide_has_the_drift_that_the_wind_example_prints() {
    let Some((_directory, printed)) = run("wind", &[]) else { return };
    let guide = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/docs/conditions.md")).unwrap();
    for line in printed.lines().filter(|line| line.contains("downwind")) {
        let number = line.split(": ").nth(1).unwrap().split(" cm").next().unwrap();
        assert!(guide.contains(&format!("{number} cm")), "{line}");
    }
}

#[test]
fn mppi_reaches_its_waypoint() {
    let Some(printed) = print("mppi", &[]) else { return };
    let error: f64 = printed.split(' ').next().unwrap().parse().unwrap();
    assert!(error < 0.1 && printed.contains("after 6 s") && printed.contains("a snapshot takes"), "{printed}");
}

#[test]
fn every_example_is_tested_and_shorter_than_80_lines() {
    let tests = include_str!("examples.rs");
    for entry in std::fs::read_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/examples")).unwrap() {
        let path = entry.unwrap().path();
        // the tests of the Python package run examples/python
        if path.is_dir() {
            continue;
        }
        let name = path.file_stem().unwrap().to_string_lossy().into_owned();
        assert!(tests.contains(&format!("(\"{name}\"")), "no test runs {name}");
        assert!(std::fs::read_to_string(&path).unwrap().lines().count() < 80, "{name}");
    }
}

#[test]
fn vertical_circle_writes_an_image_and_prints_its_errors() {
    let Some((directory, printed)) = run("vertical_circle", &["2"]) else { return };
    assert_larger(directory.path(), &["vertical_circle.png"], 10_000);
    assert!(printed.contains("mean 0.0"), "{printed}");
}

#[test]
fn custom_task_keeps_the_contract_and_succeeds() {
    let Some(printed) = print("custom_task", &[]) else { return };
    assert!(printed.contains("checked") && printed.contains("success: true"), "{printed}");
}

#[test]
fn policy_flies_two_laps() {
    let Some((directory, printed)) = run("policy", &[]) else { return };
    assert_larger(directory.path(), &["path.png"], 10_000);
    assert!(printed.contains("aviary train --task race") && printed.contains("success: true"), "{printed}");
}

#[test]
fn antipodal_writes_six_images_and_its_minimum_distance() {
    let Some((directory, printed)) = run("antipodal", &["1.5"]) else { return };
    assert_larger(directory.path(), &["antipodal.png"], 50_000);
    assert!(printed.contains("minimum distance: 0."), "{printed}");
}

#[test]
fn wind_obstacles_and_randomization_write_images_and_results() {
    let Some((directory, printed)) = run("wind", &["3"]) else { return };
    assert!(directory.path().join("wind.png").exists() && printed.matches("downwind").count() == 2, "{printed}");
    let Some((directory, _)) = run("obstacles", &[]) else { return };
    assert_larger(directory.path(), &["forest.png", "urban.png", "indoor.png", "random.png", "gates.png"], 10_000);
    let Some((directory, printed)) = run("randomization", &["1"]) else { return };
    assert!(directory.path().join("randomization.svg").exists() && printed.lines().count() == 8, "{printed}");
}

#[test]
fn the_guide_has_the_tracking_errors_that_the_example_prints() {
    let Some(printed) = print("tracking", &[]) else { return };
    let documented = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/docs/control.md")).unwrap();
    for row in printed.lines().filter(|line| line.starts_with("| ")) {
        let name = row.split(" | ").take(3).collect::<Vec<_>>().join(" | ");
        let known = documented.lines().find(|line| line.starts_with(&name)).unwrap_or_else(|| panic!("no row {name}"));
        let numbers =
            |row: &str| row.split(" | ").filter_map(|word| word.trim_end_matches(" |").parse().ok()).collect();
        let (now, then): (Vec<f64>, Vec<f64>) = (numbers(row), numbers(known));
        assert!(now.len() == then.len() && now.iter().zip(&then).all(|(a, b)| (a - b).abs() < 0.02), "{row}: {known}");
    }
}
