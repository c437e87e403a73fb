//! The command `aviary benchmark`.

use serde_json::Value;

mod common;

use common::{directory, json, pretrained, refused, run, text};

/// Returns a report without its times.
fn without_timing(mut report: Value) -> Value {
    let timing = report.as_object_mut().unwrap().remove("timing").unwrap();
    assert!(timing["seconds"].as_f64().unwrap() > 0.0 && timing["threads"].as_u64().unwrap() > 0);
    report
}

#[test]
fn reports_are_equal_for_any_number_of_threads_except_for_their_times() {
    let dir = directory("benchmark");
    let path = dir.join("report.json");
    let policy = pretrained("hover_randomized");
    let arguments = ["benchmark", "--policy", &policy, "--suite", "hover", "--episodes", "6"];
    let one = without_timing(json(&[&arguments[..], &["--threads", "1"]].concat()));
    let two = without_timing(json(&[&arguments[..], &["--threads", "2", "--out", text(&path)]].concat()));
    assert_eq!(one, two);
    let file: Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
    assert_eq!(without_timing(file), one);
    assert_eq!((&one["format"], &one["suites_version"], &one["episodes"]), (&1.into(), &1.into(), &6.into()));
    assert_eq!(one["pilot"]["policy"]["file"], "hover_randomized.safetensors");
    assert_eq!(one["pilot"]["policy"]["sha256"].as_str().unwrap().len(), 64);
    assert_eq!(one["suites"][0]["conditions"].as_array().unwrap().len(), 4);
}

#[test]
fn tables_have_a_row_per_condition_and_a_score() {
    let table = run(&["benchmark", "--controller", "geometric", "--suite", "tracks", "--episodes", "3"]);
    for name in ["figure_eight", "stacked", "oval", "score of tracks: 100.0"] {
        assert!(table.lines().any(|line| line.starts_with(name)), "{table}");
    }
    let policy = pretrained("hover");
    let table = run(&["benchmark", "--policy", &policy, "--episodes", "1"]);
    assert!(table.contains("skipped race: ") && table.contains("score of robust"), "{table}");
}

#[test]
fn wrong_input_is_one_line() {
    let (hover, race) = (pretrained("hover"), pretrained("race"));
    refused(&["benchmark"], 2, &["--policy or --controller is missing"]);
    refused(&["benchmark", "--controller", "pid", "--policy", &hover], 2, &["--controller"]);
    refused(&["benchmark", "--controller", "lqr"], 2, &["--controller is `lqr`", "pid"]);
    refused(
        &["benchmark", "--controller", "pid", "--suite", "hovr"],
        2,
        &["--suite is `hovr`", "did you mean `hover`?"],
    );
    refused(&["benchmark", "--controller", "pid", "--episodes", "0"], 2, &["episodes is 0, expected 1 to 100,000"]);
    refused(&["benchmark", "--controller", "pid", "--threads", "0"], 2, &["--threads"]);
    refused(&["benchmark", "--policy", "no/such.safetensors"], 2, &["no/such.safetensors: No such file"]);
    refused(&["benchmark", "--policy", "Cargo.toml"], 2, &["Cargo.toml: "]);
    refused(&["benchmark", "--policy", &race, "--suite", "hover"], 2, &["21 observations", "12 observations"]);
}
