//! Every example runs, headless and short. `cargo test` builds them beside the tests.

use std::path::PathBuf;
use std::process::Command;

use mujoco_drones_gym::mujoco::{Error, gl_info};
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::record::Flight;

/// Runs an example and gives the directory that it wrote to; `None` where there is nothing to draw with or where this
/// test alone was built.
fn run(name: &str, more: &[&str]) -> Option<(tempfile::TempDir, String)> {
    if matches!(gl_info(), Err(Error::NoGl { .. })) {
        return None;
    }
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().to_string_lossy().into_owned();
    let printed = print(name, &[&[&*path], more].concat())?;
    Some((directory, printed))
}

/// Runs an example and gives what it printed.
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

#[test]
fn views_draws_every_view() {
    let Some((directory, printed)) = run("views", &[]) else { return };
    let files = std::fs::read_dir(directory.path()).unwrap().count();
    assert_eq!((files, printed.lines().count()), (14, 14));
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

#[test]
fn hover_is_filmed_recorded_and_plotted() {
    let Some((directory, printed)) = run("hover", &["1"]) else { return };
    for name in ["hover.gif", "hover.png", "flight.png", "path.png"] {
        assert!(directory.path().join(name).metadata().unwrap().len() > 10_000, "{name}");
    }
    assert_eq!(Flight::read(directory.path()).unwrap().drones[0].len(), 49);
    assert_eq!(printed.lines().count(), 6, "{printed}");
}

#[test]
fn a_formation_is_drawn_with_the_ways_of_its_drones() {
    let Some((directory, printed)) = run("formation", &["6", "4"]) else { return };
    for name in ["formation.png", "flight.svg", "path.svg"] {
        assert!(directory.path().join(name).metadata().unwrap().len() > 10_000, "{name}");
    }
    let worst: f64 = printed.lines().last().unwrap().split_whitespace().rev().nth(1).unwrap().parse().unwrap();
    assert!(worst < 5.0, "{printed}");
}

#[test]
fn a_batch_is_flown_and_its_heights_plotted() {
    let directory = tempfile::tempdir().unwrap();
    let Some(printed) = print("batch", &[&directory.path().to_string_lossy(), "1", "256"]) else { return };
    assert!(directory.path().join("batch.svg").metadata().unwrap().len() > 5_000);
    assert!(printed.contains("million environment steps a second") && printed.contains("by the flight kernel"));
}

#[test]
fn an_airframe_of_ones_own_flies() {
    let Some((directory, printed)) = run("custom_airframe", &["6"]) else { return };
    let courier = DroneParams::from_file(directory.path().join("courier.toml")).unwrap();
    assert!(printed.contains(&format!("{:.0} rpm", courier.hover_rpm())));
    let off: f64 = printed.lines().last().unwrap().split_whitespace().next().unwrap().parse().unwrap();
    assert!(off < 2.0, "{printed}");
}

#[test]
fn a_dataset_has_three_pictures_and_a_pose_for_every_frame() {
    let Some((directory, _)) = run("camera_dataset", &["3"]) else { return };
    for kind in ["rgb", "depth", "objects"] {
        for frame in 0..3 {
            assert!(directory.path().join(format!("{kind}_{frame:05}.png")).exists(), "{kind} {frame}");
        }
    }
    assert_eq!(std::fs::read_to_string(directory.path().join("poses.csv")).unwrap().lines().count(), 4);
    assert!(directory.path().join("sheet.png").metadata().unwrap().len() > 5_000);
}

#[test]
fn pid_flies_the_three_demos() {
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

/// The README tells what the wind example prints.
#[test]
fn the_drift_in_the_readme_is_what_the_example_prints() {
    let Some((_directory, printed)) = run("wind", &[]) else { return };
    let readme = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/README.md")).unwrap();
    for line in printed.lines().filter(|line| line.contains("downwind")) {
        let number = line.split(": ").nth(1).unwrap().split(" cm").next().unwrap();
        assert!(readme.contains(&format!("{number} cm")), "{line}");
    }
}

#[test]
fn mppi_flies_to_its_waypoint_by_sampling_from_snapshots() {
    let Some(printed) = print("mppi", &[]) else { return };
    let error: f64 = printed.split(' ').next().unwrap().parse().unwrap();
    assert!(error < 0.1 && printed.contains("after 6 s") && printed.contains("a snapshot takes"), "{printed}");
}

/// Every example has a test in this file and is no longer than a screen or two.
#[test]
fn every_example_is_tested_and_short() {
    let tests = include_str!("examples.rs");
    for entry in std::fs::read_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/examples")).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_stem().unwrap().to_string_lossy().into_owned();
        assert!(tests.contains(&format!("(\"{name}\"")), "no test runs {name}");
        assert!(std::fs::read_to_string(&path).unwrap().lines().count() < 80, "{name}");
    }
}

#[test]
fn the_vertical_circle_is_drawn_and_its_errors_printed() {
    let Some((directory, printed)) = run("vertical_circle", &["2"]) else { return };
    assert!(directory.path().join("vertical_circle.png").metadata().unwrap().len() > 10_000);
    assert!(printed.contains("mean 0.0"), "{printed}");
}

#[test]
fn a_task_of_ones_own_keeps_the_contract_and_is_flown() {
    let Some(printed) = print("custom_task", &[]) else { return };
    assert!(printed.contains("checked") && printed.contains("success: true"), "{printed}");
}

#[test]
fn a_trained_policy_flies_two_laps_from_its_file() {
    let Some((directory, printed)) = run("policy", &[]) else { return };
    assert!(directory.path().join("path.png").metadata().unwrap().len() > 10_000);
    assert!(printed.contains("aviary train --task race") && printed.contains("success: true"), "{printed}");
}

#[test]
fn antipodal_swaps_places_in_six_pictures() {
    let Some((directory, printed)) = run("antipodal", &["1.5"]) else { return };
    assert!(directory.path().join("antipodal.png").metadata().unwrap().len() > 50_000);
    assert!(printed.contains("minimum distance: 0."), "{printed}");
}

#[test]
fn wind_obstacles_and_randomization_are_drawn_and_reported() {
    let Some((directory, printed)) = run("wind", &["3"]) else { return };
    assert!(directory.path().join("wind.png").exists() && printed.matches("downwind").count() == 2, "{printed}");
    let Some((directory, _)) = run("obstacles", &[]) else { return };
    for kind in ["forest", "urban", "indoor", "random", "gates"] {
        assert!(directory.path().join(kind).with_extension("png").metadata().unwrap().len() > 10_000, "{kind}");
    }
    let Some((directory, printed)) = run("randomization", &["1"]) else { return };
    assert!(directory.path().join("randomization.svg").exists() && printed.lines().count() == 8, "{printed}");
}

#[test]
fn the_table_of_tracking_errors_is_the_one_in_the_documentation() {
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
