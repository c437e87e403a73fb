//! Recordings for Rerun; the tests run with the feature `rerun`.

mod common;

use common::{directory, refused, run, text};

#[cfg(not(feature = "rerun"))]
#[test]
fn a_program_without_the_feature_names_the_build_that_has_it() {
    let file = directory("rerun").join("hover.rrd");
    for option in [&["--rerun", text(&file)][..], &["--rerun", text(&file), "--rerun-images"]] {
        let arguments = [&["fly", "--task", "hover"][..], option].concat();
        refused(&arguments, 2, &["built without Rerun", "--features rerun"]);
    }
    assert!(!file.exists());
    refused(&["fly", "--task", "hover", "--rerun-images"], 2, &["--rerun is missing"]);
    assert!(run(&["fly", "--help"]).contains("--rerun <TARGET>"));
}

#[cfg(feature = "rerun")]
#[test]
fn a_recording_does_not_change_the_flight() {
    let (with, without) = (directory("rerun-with"), directory("rerun-without"));
    let flight = ["fly", "--task", "multi_hover", "--duration", "2", "--seed", "4", "--out"];
    let file = with.join("new/flight.rrd");
    let printed = run(&[&flight[..], &[text(&with), "--rerun", text(&file)]].concat());
    assert!(printed.contains("flight.rrd"), "{printed}");
    run(&[&flight[..], &[text(&without)]].concat());
    common::assert_equal_files(&with, &without, &["drone0.csv", "drone1.csv", "summary.json"]);
    let bytes = std::fs::read(&file).unwrap();
    assert!(bytes.starts_with(b"RRF2") && bytes.len() > 100_000, "{} bytes", bytes.len());
}

#[cfg(feature = "rerun")]
#[test]
fn targets_that_cannot_be_reached_have_one_error_before_the_flight() {
    let file = directory("rerun-errors");
    std::fs::create_dir_all(&file).unwrap();
    refused(&["fly", "--task", "hover", "--rerun", text(&file)], 1, &[text(&file), "not a file"]);
    let nobody = "rerun+http://127.0.0.1:1/proxy";
    refused(&["fly", "--task", "hover", "--rerun", nobody], 1, &[nobody, "no viewer of Rerun answers"]);
}
