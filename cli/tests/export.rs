//! Policies for other programs, and ONNX files of other programs.

use std::path::Path;
use std::process::Command;

mod common;

use common::{assert_equal_files, directory, json, pretrained, refused, run, text, write};

/// Returns the names of the files of a directory.
fn names(directory: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(directory).unwrap();
    let mut names: Vec<_> = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

#[test]
fn exported_code_compiles_without_warnings() {
    let policy = pretrained("hover");
    for (weights, name) in [("float32", "hover_policy"), ("int8", "small")] {
        let out = directory(&format!("export_c_{weights}"));
        let mut arguments = vec!["export", "--policy", &policy, "--format", "c", "--weights", weights];
        if name != "hover_policy" {
            arguments.extend(["--name", name]);
        }
        arguments.extend(["--out", text(&out)]);
        let report = json(&arguments);
        assert_eq!((&report["observation_size"], &report["action_size"]), (&12.into(), &4.into()));
        assert_eq!(names(&out), [format!("{name}.c"), format!("{name}.h")]);
        let options = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O2", "-c"];
        let source = format!("{name}.c");
        let compiled =
            Command::new("cc").current_dir(&out).args(options).args([&source, "-o", "policy.o"]).output().unwrap();
        assert!(compiled.status.success(), "{}", String::from_utf8_lossy(&compiled.stderr));
    }
    let sizes = ["float32", "int8"].map(|weights| {
        let out = directory("export_c_size");
        let arguments = ["export", "--policy", &policy, "--format", "c", "--weights", weights, "--out", text(&out)];
        json(&arguments)["constant_bytes"].as_f64().unwrap()
    });
    assert!(sizes[1] < 0.35 * sizes[0], "{sizes:?}");
}

#[test]
fn an_exported_application_has_the_files_of_a_build() {
    let out = directory("export_crazyflie");
    let printed = run(&["export", "--policy", &pretrained("hover"), "--format", "crazyflie", "--out", text(&out)]);
    assert!(printed.contains("bytes") && printed.contains("hover_policy_app.c"), "{printed}");
    assert_eq!(names(&out), ["Kbuild", "Makefile", "README.md", "app-config", "src"]);
    let files = ["Kbuild", "hover_policy.c", "hover_policy.h", "hover_policy_app.c"];
    assert_eq!(names(&out.join("src")), files);
}

#[test]
fn onnx_files_fly_as_the_policies_they_come_from() {
    let out = directory("export_onnx");
    let onnx = out.join("hover.onnx");
    let policy = pretrained("hover");
    run(&["export", "--policy", &policy, "--format", "onnx", "--out", text(&onnx)]);
    let fly = |policy: &str| json(&["play", "--policy", policy, "--episodes", "4", "--seed", "11"]);
    let (here, there) = (fly(text(&onnx)), fly(&policy));
    assert_eq!((&here["success_rate"], &here["task"]), (&there["success_rate"], &there["task"]));
    let difference = here["mean_reward"].as_f64().unwrap() - there["mean_reward"].as_f64().unwrap();
    assert!(difference.abs() < 0.01, "{difference}");
    // options replace the metadata of the file
    let slow = json(&["play", "--policy", text(&onnx), "--episodes", "1", "--ctrl-freq", "60", "--sim-freq", "240"]);
    assert_eq!(slow["episodes"].as_array().unwrap().len(), 1);
}

#[test]
fn rounded_policies_are_policies() {
    let out = directory("export_safetensors");
    let [same, small] = ["same", "small"].map(|name| out.join(name).with_extension("safetensors"));
    let policy = pretrained("hover_cf21");
    run(&["export", "--policy", &policy, "--format", "safetensors", "--out", text(&same)]);
    assert_eq!(
        std::fs::read(&same).unwrap(),
        std::fs::read(&policy).unwrap(),
        "the format and its version are the same"
    );
    run(&["export", "--policy", &policy, "--format", "safetensors", "--weights", "int8", "--out", text(&small)]);
    assert_ne!(std::fs::read(&small).unwrap(), std::fs::read(&policy).unwrap());
    let flown = json(&["play", "--policy", text(&small), "--episodes", "2"]);
    assert_eq!(flown["episodes"].as_array().unwrap().len(), 2);
    // equal inputs give equal files
    let again = directory("export_again");
    for out in [&out, &again] {
        run(&["export", "--policy", &policy, "--format", "onnx", "--out", text(&out.join("a.onnx"))]);
        run(&["export", "--policy", &policy, "--format", "c", "--out", text(out)]);
    }
    assert_equal_files(&out, &again, &["a.onnx", "hover_policy.c", "hover_policy.h"]);
}

#[test]
fn wrong_exports_are_errors_that_name_the_option() {
    let out = directory("export_wrong");
    let policy = pretrained("hover");
    let export = |format: &'static str, more: &[&str], status: i32, texts: &[&str]| {
        let path = out.join("written");
        let arguments = ["export", "--policy", &policy, "--format", format, "--out", text(&path)];
        refused(&[&arguments[..], more].concat(), status, texts);
        assert!(!path.exists(), "{more:?}");
    };
    export("tflite", &[], 2, &["--format", "tflite"]);
    export(
        "onnx",
        &["--weights", "int8"],
        2,
        &["--weights int8", "--format onnx", "expected c, crazyflie or safetensors"],
    );
    export("onnx", &[], 2, &["--out is", "a name that ends in .onnx"]);
    export("onnx", &["--name", "a"], 2, &["--name", "expected c or crazyflie"]);
    export("c", &["--drone", "cf2x"], 2, &["--drone", "expected crazyflie"]);
    export("c", &["--name", "My Policy"], 2, &["--name is `My Policy`", "snake case"]);
    export("crazyflie", &["--drone", "cf2p"], 2, &["hover.safetensors", "layout"]);
    let (policy_of_race, directory_of_race) = (pretrained("race"), out.join("race"));
    let race = ["export", "--policy", &policy_of_race, "--format", "crazyflie", "--out", text(&directory_of_race)];
    refused(&race, 2, &["race.safetensors", "the task is `race`"]);
    refused(&["export", "--policy", "nowhere.safetensors", "--format", "c", "--out", "a"], 2, &["nowhere.safetensors"]);
    // an output that is the input keeps it
    std::fs::create_dir_all(&out).unwrap();
    let copy = out.join("copy.safetensors");
    std::fs::copy(&policy, &copy).unwrap();
    let onto = ["export", "--policy", text(&copy), "--format", "safetensors", "--out", text(&copy)];
    refused(&onto, 2, &["copy.safetensors", "it is an input"]);
    assert_eq!(std::fs::read(&copy).unwrap(), std::fs::read(&policy).unwrap());
    // a file where the directory should be
    let file = write(&out.join("file"), "text");
    refused(&["export", "--policy", &policy, "--format", "c", "--out", text(&file)], 1, &["is not a directory"]);
}

#[test]
fn wrong_onnx_files_and_options_are_errors_of_one_line() {
    let out = directory("onnx_wrong");
    let onnx = out.join("hover.onnx");
    run(&["export", "--policy", &pretrained("hover"), "--format", "onnx", "--out", text(&onnx)]);
    let play = |policy: &Path, more: &[&str], texts: &[&str]| {
        refused(&[&["play", "--policy", text(policy), "--episodes", "1"][..], more].concat(), 2, texts);
    };
    play(
        &onnx,
        &["--observation-indices", "0-3"],
        &["hover.onnx", "observation_indices is 4 numbers", "expected 12 numbers"],
    );
    play(&onnx, &["--observation-indices", "3-0"], &["--observation-indices is `3-0`, expected numbers"]);
    play(&onnx, &["--observation-indices", "1-12"], &["the observation index 12", "12 observations"]);
    play(&onnx, &["--action-range", "tanh"], &["--action-range is `tanh`, expected space or unit"]);
    play(&onnx, &["--action-output", "mean"], &["action_output is `mean`, expected action"]);
    play(&onnx, &["--action-type", "one_d_rpm"], &["4 outputs", "1 actions (one_d_rpm)"]);
    play(&onnx, &["--task", "race"], &["12 inputs", "21 observations"]);
    play(&write(&out.join("text.onnx"), "not a graph"), &[], &["text.onnx", "not a policy in ONNX"]);
    play(&out.join("nowhere.onnx"), &["--task", "hover"], &["nowhere.onnx"]);
    let native = pretrained("hover");
    for option in [["--action-type", "rpm"], ["--ctrl-freq", "48"], ["--action-range", "unit"]] {
        play(Path::new(&native), &option, &[option[0], "expected an ONNX file"]);
    }
}
