//! Inputs of extreme lengths and sizes.

use std::process::Command;

mod common;

use common::{directory, json, recorded_flight, refused, text, write};

/// A trajectory that is much longer than the episode is checked against obstacles as far as it is flown.
#[test]
fn trajectories_are_much_longer_than_an_episode() {
    let path = directory("long-trajectories").join("path.toml");
    let steps =
        format!("kind = \"steps\"\nstart = [0, 0, 1]\nhold = 1e6\npoints = [{}]\n", ["[0, 0, 1]"; 100].join(", "));
    let circle = "kind = \"circle\"\nradius = 0.3\nperiod = 6e6\ncentre = [-0.3, 0.0, 1.0]\n";
    for toml in [&steps[..], circle] {
        write(&path, toml);
        let fly = ["fly", "--task", "hover", "--trajectory", text(&path), "--duration", "0.5", "--engine", "hybrid"];
        let flight = json(&[&fly[..], &["--obstacles", "forest"]].concat());
        assert_eq!(flight["simulated_seconds"], 0.5, "{flight}");
    }
}

/// The limit of the memory allows some threads.
#[test]
fn threads_that_cannot_be_started_are_an_error_of_one_line() {
    let dir = directory("too-many-threads");
    write(&dir.join("flight.csv"), &recorded_flight(5.0));
    let program = format!("ulimit -v 1000000; exec {} compare --flights . --drone cf2x", env!("CARGO_BIN_EXE_aviary"));
    let mut shell = Command::new("sh");
    shell.args(["-c", &program]).env("RAYON_NUM_THREADS", "60000").current_dir(&dir);
    let output = shell.output().unwrap();
    let error = String::from_utf8(output.stderr).unwrap();
    assert_eq!((output.status.code(), error.lines().count()), (Some(1), 1), "{error}");
    assert!(error.contains("60000 threads cannot be started") && error.contains("RAYON_NUM_THREADS"), "{error}");
}

/// The plans of two drones are not compared at every moment of weeks.
#[test]
fn races_over_thousands_of_kilometres_are_planned_at_once() {
    let gate = |index: usize| {
        format!("[[gates]]\nposition = [{}, 0.0, 1.0]\n", if index.is_multiple_of(2) { 1e4 } else { -1e4 })
    };
    let track = (0..198).map(gate).collect::<String>();
    let path = write(&directory("far-gates").join("far.toml"), &format!("laps = 1\n{track}"));
    let fly = ["fly", "--task", "race", "--num-drones", "2", "--duration", "2", "--engine", "hybrid"];
    refused(&[&fly[..], &["--track", text(&path)]].concat(), 2, &["--num-drones is 2, expected at most 1"]);
}
