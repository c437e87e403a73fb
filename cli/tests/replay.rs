//! Replays of flights from their files.

use std::path::Path;

mod common;

use common::{aviary, directory, reference, refused, run, text, write};

#[test]
fn replays_agree_with_the_reference_flights() {
    let out = directory("replay").join("flight.csv");
    for name in ["mjc_dw_close", "dyn_cf2p", "body_fixed_cf2x"] {
        let (scenario, actions) = (reference(&format!("{name}.toml")), reference(&format!("{name}.actions.csv")));
        run(&["replay", "--scenario", &scenario, "--actions", &actions, "--out", text(&out)]);
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
fn outputs_of_replays_do_not_replace_their_inputs() {
    let dir = directory("replay-onto-input");
    let copy = |name: &str, of: &str| write(&dir.join(name), &std::fs::read_to_string(reference(of)).unwrap());
    let (scenario, actions) = (copy("a.toml", "mjc_cf2x.toml"), copy("a.csv", "mjc_cf2x.actions.csv"));
    let before = [&scenario, &actions].map(|path| std::fs::read(path).unwrap());
    for out in [&scenario, &actions] {
        let replay = ["replay", "--scenario", text(&scenario), "--actions", text(&actions), "--out", text(out)];
        refused(&replay, 2, &["it is an input"]);
    }
    assert_eq!([&scenario, &actions].map(|path| std::fs::read(path).unwrap()), before);
    // the directory of a flight stands for its logs; other files in it are outputs
    let flight = dir.join("flight");
    run(&["fly", "--task", "hover", "--duration", "0.2", "--out", text(&flight)]);
    let replay = |out: &str| {
        let (scenario, out) = (flight.join("scenario.toml"), flight.join(out));
        ["replay", "--scenario", text(&scenario), "--actions", text(&flight), "--out", text(&out)].map(str::to_string)
    };
    let refused_onto = replay("drone0.csv");
    refused(&refused_onto.each_ref().map(String::as_str), 2, &["drone0.csv: it is an input"]);
    for _ in 0..2 {
        run(&replay("again.csv").each_ref().map(String::as_str));
    }
}

#[test]
fn errors_of_replays_name_file_and_line() {
    let dir = directory("replay-refused");
    let out = dir.join("flight.csv");
    let (scenario, actions) = (reference("mjc_cf2x.toml"), reference("mjc_cf2x.actions.csv"));
    let good = std::fs::read_to_string(&scenario).unwrap();
    let file = |name: &str, content: &str| text(&write(&dir.join(name), content)).to_string();
    let replay = |scenario: &str, actions: &str, texts: &[&str]| {
        refused(&["replay", "--scenario", scenario, "--actions", actions, "--out", text(&out)], 2, texts);
        assert!(!out.exists(), "an incomplete file");
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
    let blocked = file("blocked", "not a directory");
    refused(
        &["replay", "--scenario", &scenario, "--actions", &actions, "--out", &format!("{blocked}/x.csv")],
        1,
        &["x.csv"],
    );
}

/// The scenario has the sampled initial attitudes and those of the compiled scene, which differ.
#[test]
fn the_replay_of_a_sampled_start_on_a_rotated_trajectory_is_bit_exact() {
    let dir = directory("rotated");
    let file = |name: &str, content: &str| write(&dir.join(name), content);
    let circle = "kind = \"circle\"\nradius = 0.5\nperiod = 6\nturns = 1\nramp = 1\nyaw = 1\n";
    let trajectory = file("rotated.toml", circle);
    let config = file("sampled.toml", "[randomization.initial]\n");
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
    run(&["replay", "--scenario", text(&scenario), "--actions", text(&out), "--out", text(&again)]);
    // a replay has no row of the initial state, and has the columns up to the motor speeds
    let columns = |path: &Path, skip: usize| -> Vec<Vec<f64>> {
        let text = std::fs::read_to_string(path).unwrap();
        text.lines().skip(skip).map(|line| line.split(',').take(22).map(|x| x.parse().unwrap()).collect()).collect()
    };
    let (flown, again) = (columns(&out.join("drone0.csv"), 2), columns(&again, 1));
    assert!(flown.len() > 50 && flown == again, "{} rows, {} rows", flown.len(), again.len());
}
