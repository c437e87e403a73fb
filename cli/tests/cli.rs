//! The program as other programs see it: output, files, errors, exit status.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use serde_json::Value;

fn aviary(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_aviary")).args(arguments).output().expect("the program starts")
}

fn directory(name: &str) -> PathBuf {
    let path = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join(name);
    let _ = std::fs::remove_dir_all(&path);
    path
}

fn text(path: &Path) -> &str {
    path.to_str().expect("a path in UTF-8")
}

/// Runs, expects this status and one line on standard error that holds all of these texts, and nothing on standard
/// output.
fn refused(arguments: &[&str], status: i32, texts: &[&str]) {
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

#[test]
fn hover_reaches_its_height_and_says_so() {
    for drone in ["cf2x", "cf2p", "race"] {
        let output = aviary(&["fly", "--task", "hover", "--drone", drone, "--json"]);
        assert_eq!(output.status.code(), Some(0));
        let flight: Value = serde_json::from_slice(&output.stdout).unwrap();
        let number = |key: &str| flight[key].as_f64().unwrap_or_else(|| panic!("{key}"));
        assert_eq!(flight["task"], "hover");
        assert_eq!(flight["drone_model"], drone);
        assert_eq!((&flight["physics"], &flight["engine"]), (&"mjc".into(), &"mujoco".into()));
        assert_eq!(flight["success"], true);
        assert_eq!(flight["drones"][0]["crashed"], false);
        let z = flight["drones"][0]["final_position"][2].as_f64().unwrap();
        assert!((z - 1.0).abs() < 0.02);
        assert!((number("final_position_error") - (z - 1.0).abs()).abs() < 1e-12);
        assert_eq!(number("simulated_seconds"), 10.0);
        assert!(number("rms_position_error_last_2s") < 0.02);
        assert!(number("rms_position_error") > number("rms_position_error_last_2s"));
        assert!((0.85..0.95).contains(&number("peak_position_error")));
        assert!(number("wall_seconds") > 0.0 && number("reward") > 0.0);
    }
    let table = aviary(&["fly", "--task", "hover"]);
    assert!(String::from_utf8(table.stdout).unwrap().contains("final position error"));
}

#[test]
fn equal_seeds_write_equal_files() {
    let (a, b) = (directory("seed-a"), directory("seed-b"));
    for path in [&a, &b] {
        let output = aviary(&["fly", "--task", "hover", "--seed", "1", "--duration", "2", "--out", text(path)]);
        assert!(output.status.success());
    }
    for name in ["log.csv", "summary.json"] {
        let read = |path: &PathBuf| std::fs::read(path.join(name)).unwrap();
        assert_eq!(read(&a), read(&b), "{name}");
    }
    let mut log = csv::Reader::from_path(a.join("log.csv")).unwrap();
    let rows: Vec<_> = log.records().map(Result::unwrap).collect();
    assert_eq!(rows.len(), 97, "the start and one row per control step");
    assert_eq!(&rows[96][0], "2");
    let summary: Value = serde_json::from_slice(&std::fs::read(a.join("summary.json")).unwrap()).unwrap();
    let z: f64 = rows[96][4].parse().unwrap();
    assert_eq!(summary["drones"][0]["final_position"][2], z);
}

#[test]
fn wrong_command_lines_are_one_line_and_status_2() {
    refused(&["fly", "--task", "nosuch"], 2, &["--task is `nosuch`", "hover"]);
    refused(&["fly", "--task", "hovr"], 2, &["did you mean `hover`?"]);
    refused(&["fly"], 2, &["--task"]);
    refused(&["fly", "--task", "hover", "--sim-freq", "100", "--ctrl-freq", "48"], 2, &["100 Hz", "48 Hz", "multiple"]);
    refused(&["fly", "--task", "hover", "--ctrl-freq", "0"], 2, &["0 Hz"]);
    refused(&["fly", "--task", "hover", "--sim-freq", "-5"], 2, &["-5"]);
    refused(&["fly", "--task", "hover", "--duration", "-1"], 2, &["-1 s", "positive"]);
    refused(&["fly", "--task", "hover", "--duration", "nan"], 2, &["NaN"]);
    refused(&["fly", "--task", "hover", "--duration", "long"], 2, &["long"]);
    refused(&["fly", "--task", "hover", "--controller", "none"], 2, &["--controller is `none`", "pid"]);
    refused(&["fly", "--task", "hover", "--drone", "cf3x"], 2, &["--drone is `cf3x`", "cf2x"]);
    refused(&["fly", "--task", "hover", "--wings", "2"], 2, &["--wings"]);
    refused(&["land"], 2, &["land"]);
    refused(&[], 2, &["--help"]);
}

#[test]
fn airframe_files_are_flown_or_refused_by_file_line_and_field() {
    let dir = directory("airframes");
    std::fs::create_dir_all(&dir).unwrap();
    let good = include_str!("../../assets/airframes/cf2x.toml");
    let file = |name: &str, content: &str| {
        let path = dir.join(name);
        std::fs::write(&path, content).unwrap();
        path
    };
    let heavy = file("heavy.toml", &good.replace("mass = 0.027", "mass = 0.035").replace("\"cf2x\"", "\"heavy\""));
    let output = aviary(&["fly", "--task", "hover", "--drone", text(&heavy), "--json"]);
    assert!(output.status.success());
    let flight: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!((&flight["drone_model"], &flight["success"]), (&"heavy".into(), &true.into()));

    let refused_file = |path: &Path, texts: &[&str]| {
        refused(&["fly", "--task", "hover", "--drone", text(path)], 2, &[&[text(path)], texts].concat());
    };
    refused_file(&file("negative.toml", &good.replace("mass = 0.027", "mass = -1.0")), &["mass is -1", "positive"]);
    refused_file(&file("corrupt.toml", &good.replace("mass = 0.027", "mass == 1")), &["line 3"]);
    refused_file(&file("unknown.toml", &format!("{good}\nwings = 2\n")), &["wings"]);
    refused_file(&dir.join("missing.toml"), &["No such file"]);
    std::fs::write(dir.join("binary.toml"), [0xff, 0xfe, 0x00]).unwrap();
    refused_file(&dir.join("binary.toml"), &["UTF-8"]);
}

#[test]
fn an_output_that_cannot_be_written_is_status_1_before_anything_is_flown() {
    let dir = directory("blocked");
    std::fs::create_dir_all(&dir).unwrap();
    let file = dir.join("file");
    std::fs::write(&file, "in the way").unwrap();
    refused(&["fly", "--task", "hover", "--out", text(&file.join("out"))], 1, &[text(&file)]);
    refused(&["fly", "--task", "hover", "--out", text(&file)], 1, &[text(&file)]);
    assert_eq!(std::fs::read_to_string(&file).unwrap(), "in the way");
}

#[test]
fn tasks_and_doctor_answer_in_json_and_as_tables() {
    let tasks: Value = serde_json::from_slice(&aviary(&["tasks", "--json"]).stdout).unwrap();
    assert_eq!(
        tasks[0],
        serde_json::json!({
            "name": "hover", "drones": 1, "episode_seconds": 10.0, "observation_size": 12, "action_size": 4,
        })
    );
    assert!(String::from_utf8(aviary(&["tasks"]).stdout).unwrap().contains("hover"));
    let doctor: Value = serde_json::from_slice(&aviary(&["doctor", "--json"]).stdout).unwrap();
    assert_eq!(doctor["ok"], true);
    assert!(doctor["mujoco_version"].as_str().unwrap().starts_with("2.2."));
    assert!(aviary(&["doctor"]).status.success());
}

#[test]
fn help_and_version_are_no_errors() {
    for arguments in [&["--help"][..], &["fly", "--help"], &["--version"]] {
        let output = aviary(arguments);
        assert!(output.status.success() && output.stderr.is_empty() && !output.stdout.is_empty());
    }
    assert!(String::from_utf8(aviary(&["fly", "--help"]).stdout).unwrap().contains("Examples:"));
}
