//! The option `--track` of races.

mod common;

use common::{directory, json, pretrained, refused, run, text, write};

#[test]
fn the_built_in_controller_flies_every_track() {
    for name in ["figure_eight", "stacked", "oval"] {
        let flight = json(&["fly", "--task", "race", "--track", name]);
        assert_eq!((&flight["success"], &flight["drones"][0]["crashed"]), (&true.into(), &false.into()), "{name}");
    }
}

#[test]
fn the_built_in_controller_flies_the_track_of_the_documentation() {
    let page = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/tasks.md")).unwrap();
    let mut blocks = page.split("```toml\n").skip(1).map(|rest| rest.split("```").next().unwrap());
    let example = blocks.find(|block| block.contains("[[gates]]")).unwrap();
    let path = write(&directory("documented").join("track.toml"), example);
    for seed in ["0", "1", "2"] {
        let flight = json(&["fly", "--task", "race", "--track", text(&path), "--engine", "hybrid", "--seed", seed]);
        assert_eq!(flight["success"], true, "{seed}: {flight}");
    }
}

#[test]
fn tracks_from_files_are_flown_trained_and_played() {
    let dir = directory("tracks");
    let path = write(
        &dir.join("short.toml"),
        "laps = 1\nsolid = true\n[randomization]\nposition = 0.1\n[motion]\namplitude = 0.1\n\
         [[gates]]\nposition = [1.0, 0.0, 1.0]\nyaw = 0.0\n[[gates]]\nposition = [2.5, 0.0, 1.2]\n",
    );
    let flight = json(&["fly", "--task", "race", "--track", text(&path), "--engine", "hybrid"]);
    assert_eq!(flight["success"], true);
    let out = dir.join("run");
    let train = ["train", "--task", "race", "--track", text(&path), "--steps", "600", "--envs", "8"];
    run(&[&train[..], &["--out", text(&out)]].concat());
    let shown = run(&["train", "--task", "race", "--track", "oval", "--show"]);
    assert!(shown.contains("track = \"oval\""), "{shown}");
    // a new policy flies the track of its training, with its 27 numbers, and no race with 21 of them
    let policy = out.join("policy.safetensors");
    // the policy file has the track itself
    std::fs::remove_file(&path).unwrap();
    let played = json(&["play", "--policy", text(&policy), "--episodes", "2"]);
    assert_eq!(played["task"], "race");
    // a policy of the default race flies tracks without normals
    let played = json(&["play", "--policy", &pretrained("race"), "--track", "oval", "--episodes", "2"]);
    assert_eq!(played["episodes"].as_array().unwrap().len(), 2);
}

#[test]
fn wrong_tracks_are_one_line() {
    let dir = directory("wrong-tracks");
    let wrong = |toml: &str| text(&write(&dir.join("a.toml"), toml)).to_string();
    let fly = |track: &str, texts: &[&str]| refused(&["fly", "--task", "race", "--track", track], 2, texts);
    fly("ovel", &["--track is `ovel`", "did you mean `oval`?"]);
    fly("no/such.toml", &["no/such.toml: No such file"]);
    fly(&wrong("solid = true\n[[gates]]\nposition = [1, 0]\n"), &["a.toml: line 3", "2 numbers, expected 3"]);
    fly(&wrong("slid = true\n[[gates]]\nposition = [1, 0, 1]\n"), &["a.toml: line 1", "did you mean `solid`?"]);
    fly(
        &wrong("opening = -1.0\n[[gates]]\nposition = [1, 0, 1]\n"),
        &["a.toml: opening is -1, expected 0.01 to 100 m"],
    );
    fly(&wrong("solid = true\nopening = 0.05\n[[gates]]\nposition = [1, 0, 1]\n"), &["opening is 0.05 m for a drone"]);
    refused(&["fly", "--task", "hover", "--track", "oval"], 2, &["--track goes with --task race, not with `hover`"]);
    refused(&["train", "--task", "hover", "--track", "oval"], 2, &["--track goes with --task race"]);
    refused(&["play", "--policy", &pretrained("hover"), "--track", "oval"], 2, &["--track goes with --task race"]);
}
