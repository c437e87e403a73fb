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
fn pid_flies_the_three_demos() {
    let Some((directory, printed)) = run("pid", &["3"]) else { return };
    for name in ["hover", "square", "swarm"] {
        let csv = std::fs::read_to_string(directory.path().join(name).with_extension("csv")).unwrap();
        assert!(csv.lines().count() > 3 * 48, "{name}");
        assert!(directory.path().join(name).with_extension("svg").exists());
    }
    assert!(directory.path().join("swarm.png").exists() && printed.lines().count() == 4);
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
