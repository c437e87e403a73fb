//! Training and flying of policies, as other programs see them.

use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use serde_json::Value;

mod common;

use common::{aviary, directory, refused, text};

/// Options of a run that is over soon.
const SMALL: [&str; 6] = ["--envs", "64", "--steps", "12288", "--seed", "3"];

fn json(arguments: &[&str]) -> Value {
    let output = aviary(arguments);
    assert_eq!(output.status.code(), Some(0), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

#[test]
fn training_writes_a_policy_a_curve_and_where_the_time_went() {
    let out = directory("train");
    let run = json(&[&["train", "--task", "hover", "--json", "--out", text(&out)][..], &SMALL].concat());
    assert_eq!((&run["task"], &run["stop"], &run["steps"]), (&"hover".into(), &"steps".into(), &12_288.into()));
    let shares: f64 = run["time"].as_object().unwrap().values().map(|share| share.as_f64().unwrap()).sum();
    assert!((shares - 1.0).abs() < 1e-6, "{shares}");
    for file in run["files"].as_array().unwrap() {
        assert!(std::path::Path::new(file.as_str().unwrap()).metadata().unwrap().len() > 100, "{file}");
    }
    let curve = std::fs::read_to_string(out.join("curve.csv")).unwrap();
    let rows: Vec<Vec<&str>> = curve.lines().map(|line| line.split(',').collect()).collect();
    assert_eq!((rows.len(), rows[0].len()), (7, 13));
    assert!(rows[1..].iter().enumerate().all(|(k, row)| row.len() == 13 && row[1] == (2048 * (k + 1)).to_string()));

    // equal seeds, equal files
    let again = directory("train_again");
    json(&[&["train", "--task", "hover", "--json", "--out", text(&again)][..], &SMALL].concat());
    for name in ["policy.safetensors", "curve.csv", "curve.svg", "curve.png"] {
        assert_eq!(std::fs::read(out.join(name)).unwrap(), std::fs::read(again.join(name)).unwrap(), "{name}");
    }

    // what it was made with is in the file, without a path of this machine
    let policy = std::fs::read(out.join("policy.safetensors")).unwrap();
    let head = String::from_utf8_lossy(&policy);
    assert!(head.contains("aviary train --task hover --seed 3 --steps 12288 --envs 64"), "{head}");
    assert!(!head.contains(text(&out)));
}

#[test]
fn a_run_that_is_killed_is_resumed_to_the_same_files() {
    let config = directory("killed_config").with_extension("toml");
    std::fs::create_dir_all(config.parent().unwrap()).unwrap();
    std::fs::write(&config, "checkpoint_every = 2\nevaluate_every = 3\nepisodes = 2\n").unwrap();
    let run = |out: &std::path::Path| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_aviary"));
        command.args(["train", "--task", "hover", "--envs", "64", "--steps", "40960", "--config", text(&config)]);
        command.args(["--out", text(out)]).stdout(Stdio::null()).stderr(Stdio::null());
        command
    };
    let (whole, killed) = (directory("whole"), directory("killed"));
    assert!(run(&whole).status().unwrap().success());
    let mut child = run(&killed).spawn().unwrap();
    let checkpoint = killed.join("checkpoint.safetensors");
    let began = Instant::now();
    // beyond the first checkpoint, which is written before anything is done
    while !killed.join("curve.csv").exists() && began.elapsed() < Duration::from_secs(60) {
        std::thread::sleep(Duration::from_millis(5));
    }
    child.kill().unwrap();
    child.wait().unwrap();
    let rows = std::fs::read_to_string(killed.join("curve.csv")).unwrap().lines().count();
    assert!(rows < 41, "it had ended before it was killed");
    assert!(checkpoint.exists());
    let output = aviary(&["train", "--resume", text(&killed)]);
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    for name in ["policy.safetensors", "curve.csv", "curve.svg"] {
        assert_eq!(std::fs::read(whole.join(name)).unwrap(), std::fs::read(killed.join(name)).unwrap(), "{name}");
    }
    // nothing is left to do, and nothing is touched
    let policy = std::fs::read(killed.join("policy.safetensors")).unwrap();
    refused(&["train", "--resume", text(&killed)], 2, &["40960 steps are made already"]);
    assert_eq!(std::fs::read(killed.join("policy.safetensors")).unwrap(), policy);
    // and it goes on from there
    let longer = json(&["train", "--resume", text(&killed), "--steps", "45056", "--json"]);
    assert_eq!(longer["steps"], 45_056);
}

#[test]
fn every_task_can_be_trained_and_its_policy_flown() {
    let out = directory("train_all");
    let runs = json(&["train", "--all", "--steps", "2048", "--envs", "16", "--out", text(&out), "--json"]);
    let tasks: Vec<_> = runs.as_array().unwrap().iter().map(|run| run["task"].as_str().unwrap().to_string()).collect();
    assert_eq!(tasks, aviary::tasks::NAMES);
    for task in tasks {
        let policy = out.join(&task).join("policy.safetensors");
        let flown = json(&["play", "--policy", text(&policy), "--episodes", "2", "--duration", "0.5", "--json"]);
        assert_eq!((flown["task"].as_str(), flown["episodes"].as_array().unwrap().len()), (Some(&*task), 2));
    }
}

fn pretrained(name: &str) -> String {
    format!("{}/../assets/policies/{name}.safetensors", env!("CARGO_MANIFEST_DIR"))
}

#[test]
fn policies_that_come_along_do_what_they_are_for() {
    for (task, episodes) in [("hover", 20), ("velocity", 10), ("fly_through", 5), ("race", 5)] {
        let (policy, count) = (pretrained(task), episodes.to_string());
        let flown = json(&["play", "--policy", &policy, "--episodes", &count, "--seed", "777", "--json"]);
        assert_eq!(flown["task"], task);
        assert_eq!(flown["success_rate"], 1.0, "{flown:#}");
        let numbers = |key: &str| -> Vec<f64> {
            flown["episodes"].as_array().unwrap().iter().map(|episode| episode[key].as_f64().unwrap()).collect()
        };
        if task == "hover" {
            assert!(numbers("late_position_error").iter().all(|&error| error < 0.05));
        }
        let mean = numbers("reward").iter().sum::<f64>() / f64::from(episodes);
        assert!((flown["mean_reward"].as_f64().unwrap() - mean).abs() < 1e-9);
    }
    let table = aviary(&["play", "--policy", &pretrained("hover"), "--episodes", "3"]);
    let table = String::from_utf8(table.stdout).unwrap();
    assert!(table.lines().count() == 5 && table.contains("3 of 3 episodes of hover succeeded"), "{table}");
}

#[test]
fn a_policy_is_flown_under_other_conditions_and_filmed() {
    let policy = pretrained("hover");
    let calm = json(&["play", "--policy", &policy, "--episodes", "2", "--json"]);
    let wind = json(&["play", "--policy", &policy, "--episodes", "2", "--wind", "combined", "--json"]);
    let physics = json(&["play", "--policy", &policy, "--episodes", "2", "--physics", "mjc_gnd_drag_dw", "--json"]);
    assert_ne!(calm["episodes"], wind["episodes"]);
    assert_ne!(calm["episodes"], physics["episodes"]);
    if mujoco_rs::gl_info().is_ok() {
        let gif = directory("played").with_extension("gif");
        json(&["play", "--policy", &policy, "--episodes", "1", "--duration", "0.5", "--gif", text(&gif), "--json"]);
        assert!(std::fs::read(&gif).unwrap().starts_with(b"GIF89a"));
    }
}

#[test]
fn what_cannot_be_trained_or_flown_is_refused_on_one_line() {
    let out = directory("refused");
    let path = text(&out);
    refused(&["train", "--task", "hoover", "--out", path], 2, &["hoover", "did you mean `hover`"]);
    refused(&["train", "--out", path], 2, &["--task"]);
    refused(&["train", "--task", "hover", "--envs", "0", "--out", path], 2, &["environments is 0"]);
    refused(&["train", "--task", "hover", "--config", "nowhere.toml", "--out", path], 2, &["nowhere.toml"]);
    refused(&["train", "--resume", path], 2, &["checkpoint.safetensors"]);
    refused(&["train", "--task", "hover", "--resume", path], 2, &["--resume"]);
    // what was reached is said all the same
    let failed = aviary(&[&["train", "--task", "hover", "--until-success", "--out", path][..], &SMALL].concat());
    assert_eq!(failed.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&failed.stderr).contains("no success within 12288 steps"));
    assert!(String::from_utf8_lossy(&failed.stdout).contains("where the time went"));
    refused(&["play", "--policy", "nowhere.safetensors"], 2, &["nowhere.safetensors"]);
    refused(&["play", "--policy", &pretrained("hover"), "--episodes", "0"], 2, &["--episodes is 0"]);
    refused(
        &["play", "--policy", &pretrained("hover"), "--task", "race"],
        2,
        &["12 observed numbers", "21 observed numbers"],
    );
    let file = out.join("no.safetensors");
    std::fs::write(&file, b"no policy").unwrap();
    refused(&["play", "--policy", text(&file)], 2, &["no.safetensors", "not a policy"]);
}

#[test]
fn what_would_be_trained_with_is_shown_as_a_file_that_can_be_read() {
    let shown = aviary(&["train", "--task", "race", "--show"]);
    assert_eq!(shown.status.code(), Some(0));
    let file = directory("shown").with_extension("toml");
    std::fs::create_dir_all(file.parent().unwrap()).unwrap();
    std::fs::write(&file, &shown.stdout).unwrap();
    let again = aviary(&["train", "--task", "race", "--config", text(&file), "--show"]);
    assert_eq!(String::from_utf8(again.stdout).unwrap(), String::from_utf8(shown.stdout).unwrap());
}
