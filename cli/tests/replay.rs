//! Flights that are flown again from their files.

use std::path::Path;

mod common;

use common::{aviary, directory, reference, refused, text};

#[test]
fn a_recorded_flight_is_flown_again_to_the_reference() {
    let out = directory("replay").join("flight.csv");
    for name in ["mjc_dw_close", "dyn_cf2p", "body_fixed_cf2x"] {
        let (scenario, actions) = (reference(&format!("{name}.toml")), reference(&format!("{name}.actions.csv")));
        let output = aviary(&["replay", "--scenario", &scenario, "--actions", &actions, "--out", text(&out)]);
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let rows = |path: &str| -> (Vec<String>, Vec<Vec<f64>>) {
            let mut reader = csv::Reader::from_path(path).unwrap();
            let header = reader.headers().unwrap().iter().map(str::to_string).collect();
            (header, reader.records().map(|row| row.unwrap().iter().map(|x| x.parse().unwrap()).collect()).collect())
        };
        let ((header, got), (columns, wanted)) = (rows(text(&out)), rows(&reference(&format!("{name}.expected.csv"))));
        assert_eq!((&header[..15], got.len()), (&columns[..], wanted.len()));
        for (got, wanted) in got.iter().zip(&wanted) {
            for (got, wanted) in got.iter().zip(wanted) {
                assert!((got - wanted).abs() < 1e-8, "{name}");
            }
        }
    }
}

#[test]
fn replays_that_cannot_be_flown_are_refused_by_file_and_line() {
    let dir = directory("replay-refused");
    std::fs::create_dir_all(&dir).unwrap();
    let out = dir.join("flight.csv");
    let (scenario, actions) = (reference("mjc_cf2x.toml"), reference("mjc_cf2x.actions.csv"));
    let good = std::fs::read_to_string(&scenario).unwrap();
    let file = |name: &str, content: &str| {
        std::fs::write(dir.join(name), content).unwrap();
        text(&dir.join(name)).to_string()
    };
    let replay = |scenario: &str, actions: &str, texts: &[&str]| {
        refused(&["replay", "--scenario", scenario, "--actions", actions, "--out", text(&out)], 2, texts);
        assert!(!out.exists(), "a partial file");
    };
    let typo = file("typo.toml", &good.replace("sim_freq", "sim_frq"));
    replay(&typo, &actions, &["typo.toml: line", "sim_frq"]);
    replay(&file("two.toml", &good.replace("num_drones = 1", "num_drones = 2")), &actions, &["two.toml", "1 entry"]);
    replay(text(&dir.join("none.toml")), &actions, &["none.toml", "No such file"]);
    replay(&scenario, text(&dir.join("none.csv")), &["none.csv", "No such file"]);
    let header = "drone0_rpm0,drone0_rpm1,drone0_rpm2,drone0_rpm3\n";
    replay(
        &scenario,
        &file("short.csv", &format!("{header}1,2,3,4\n1,2\n")),
        &["short.csv: line 3", "2 numbers, expected 4"],
    );
    replay(&scenario, &file("nan.csv", &format!("{header}1,2,nan,4\n")), &["nan.csv: line 2", "drone0_rpm2 is `nan`"]);
    replay(&scenario, &file("header.csv", "a,b,c,d\n1,2,3,4\n"), &["header.csv: line 1", "`a`"]);
    let blocked = file("blocked", "in the way");
    refused(
        &["replay", "--scenario", &scenario, "--actions", &actions, "--out", &format!("{blocked}/x.csv")],
        1,
        &["x.csv"],
    );
}

/// A drawn start does not turn the scene that MuJoCo has compiled: the scenario has both.
#[test]
fn a_flight_from_a_drawn_start_along_a_turned_trajectory_is_flown_again_to_the_same_bits() {
    let dir = directory("turned");
    std::fs::create_dir_all(&dir).unwrap();
    let file = |name: &str, content: &str| {
        let path = dir.join(name);
        std::fs::write(&path, content).unwrap();
        path
    };
    let circle = "kind = \"circle\"\nradius = 0.5\nperiod = 6\nturns = 1\nramp = 1\nyaw = 1\n";
    let trajectory = file("turned.toml", circle);
    let config = file("drawn.toml", "[randomization.initial]\n");
    let (out, again) = (dir.join("out"), dir.join("again.csv"));
    let output = aviary(&[
        "fly",
        "--task",
        "hover",
        "--trajectory",
        text(&trajectory),
        "--config",
        text(&config),
        "--duration",
        "2",
        "--out",
        text(&out),
    ]);
    let scenario = out.join("scenario.toml");
    let written = std::fs::read_to_string(&scenario).unwrap_or_else(|_| panic!("{output:?}"));
    assert!(written.contains("scene_rpys = [[0.0, 0.0, 1.0]]"), "{written}");
    let output = aviary(&["replay", "--scenario", text(&scenario), "--actions", text(&out), "--out", text(&again)]);
    assert!(output.status.success(), "{output:?}");
    // a replay has no row of the start, and writes the columns up to the motor speeds
    let columns = |path: &Path, skip: usize| -> Vec<Vec<f64>> {
        let text = std::fs::read_to_string(path).unwrap();
        text.lines().skip(skip).map(|line| line.split(',').take(22).map(|x| x.parse().unwrap()).collect()).collect()
    };
    let (flown, again) = (columns(&out.join("drone0.csv"), 2), columns(&again, 1));
    assert!(flown.len() > 50 && flown == again, "{} rows, {} rows", flown.len(), again.len());
}
