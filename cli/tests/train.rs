//! Training of policies, and flights with them.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use serde_json::Value;

mod common;

use common::{
    Running, assert_equal_files, aviary, directory, entries, has_gl, json, pretrained, refused, run, send, text, write,
};
use learn::Trainer;

/// Steps of a run that a test ends.
const LONG: u64 = 20_000_000;

/// Options of a short run.
const SMALL: [&str; 6] = ["--envs", "64", "--steps", "12288", "--seed", "3"];

/// Writes a configuration file.
fn config_file(name: &str, text: &str) -> PathBuf {
    write(&directory(name).with_extension("toml"), text)
}

#[test]
fn training_writes_a_policy_a_learning_curve_and_a_breakdown_of_the_time() {
    let out = directory("train");
    let run = json(&[&["train", "--task", "hover", "--out", text(&out)][..], &SMALL].concat());
    assert_eq!((&run["task"], &run["stop"], &run["steps"]), (&"hover".into(), &"steps".into(), &12_288.into()));
    let shares: f64 = run["time"].as_object().unwrap().values().map(|share| share.as_f64().unwrap()).sum();
    assert!((shares - 1.0).abs() < 1e-6, "{shares}");
    for file in run["files"].as_array().unwrap() {
        assert!(Path::new(file.as_str().unwrap()).metadata().unwrap().len() > 100, "{file}");
    }
    let curve = std::fs::read_to_string(out.join("curve.csv")).unwrap();
    let rows: Vec<Vec<&str>> = curve.lines().map(|line| line.split(',').collect()).collect();
    assert_eq!((rows.len(), rows[0].len()), (7, 13));
    assert!(rows[1..].iter().enumerate().all(|(k, row)| row.len() == 13 && row[1] == (2048 * (k + 1)).to_string()));

    // equal seeds give equal files
    let again = directory("train_again");
    json(&[&["train", "--task", "hover", "--out", text(&again)][..], &SMALL].concat());
    assert_equal_files(&out, &again, &["policy.safetensors", "curve.csv", "curve.svg", "curve.png"]);

    // the policy file has the command of the training, without paths
    let policy = std::fs::read(out.join("policy.safetensors")).unwrap();
    let head = String::from_utf8_lossy(&policy);
    assert!(head.contains("aviary train --task hover --seed 3 --steps 12288 --envs 64"), "{head}");
    assert!(!head.contains(text(&out)));
}

#[test]
fn a_run_starts_with_the_networks_of_another_run() {
    let (first, second) = (directory("stage_first"), directory("stage_second"));
    run(&[&["train", "--task", "hover", "--out", text(&first)][..], &SMALL].concat());
    let harder = config_file("harder", "[ppo]\ngamma = 0.98\n[wind]\nmodel = \"gust\"\n");
    let start = ["train", "--task", "hover", "--start-from", text(&first), "--config", text(&harder)];
    let trained = json(&[&start[..], &["--out", text(&second)], &SMALL].concat());
    assert_eq!(trained["steps"], 12_288);
    let head = std::fs::read(second.join("policy.safetensors")).unwrap();
    let command = "aviary train --task hover --start-from stage_first --config harder.toml --seed 3";
    assert!(String::from_utf8_lossy(&head).contains(command));
    assert_ne!(head, std::fs::read(first.join("policy.safetensors")).unwrap());
    // the first run is complete, and its files stay
    let third = directory("stage_third");
    let wide = config_file("wide", "[ppo]\nhidden = [16]\n");
    let refusals: [(&[&str], &str); 3] = [
        (&["--config", text(&wide)], "its networks are"),
        (&["--envs", "0"], "environments is 0"),
        (&["--start-from", "nowhere"], "cannot be used multiple times"),
    ];
    for (more, wanted) in refusals {
        let start = ["train", "--task", "hover", "--start-from", text(&first), "--out", text(&third)];
        refused(&[&start[..], more].concat(), 2, &[wanted]);
        assert!(!third.exists());
    }
    let none = ["train", "--task", "hover", "--start-from", "nowhere", "--out", text(&third)];
    refused(&none, 2, &["nowhere/checkpoint.safetensors"]);
}

#[test]
fn a_killed_and_resumed_run_is_bit_identical_to_an_uninterrupted_run() {
    let config = config_file("killed_config", "checkpoint_every = 2\nevaluate_every = 3\nepisodes = 2\n");
    let run = |steps: u64, out: &Path| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_aviary"));
        command.args(["train", "--task", "hover", "--envs", "64", "--config", text(&config), "--out", text(out)]);
        command.args(["--steps", &steps.to_string()]).stdout(Stdio::null()).stderr(Stdio::null());
        command
    };
    let (whole, killed) = (directory("whole"), directory("killed"));
    let mut child = Running::start(&mut run(LONG, &killed));
    // the run writes the curve after its first iterations, the first checkpoint before them
    wait_for(&killed.join("curve.csv"));
    child.kill().unwrap();
    child.wait().unwrap();
    let saved = Trainer::resume(killed.join("checkpoint.safetensors")).unwrap().steps();
    assert!(saved > 0);
    let steps = saved + 6 * 2048;
    assert!(run(steps, &whole).status().unwrap().success());
    let output = aviary(&["train", "--resume", text(&killed), "--steps", &steps.to_string()]);
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    assert_equal_files(&whole, &killed, &["curve.csv", "curve.svg", "curve.png"]);
    // the policies differ in the command that made them
    let best = |run: &Path| tensors(&std::fs::read(run.join("policy.safetensors")).unwrap());
    assert_eq!(best(&whole), best(&killed));
    // a finished run keeps its files
    let files = ["policy.safetensors", "checkpoint.safetensors", "curve.csv"];
    let before = files.map(|name| std::fs::read(killed.join(name)).unwrap());
    let policy = std::fs::read(killed.join("policy.safetensors")).unwrap();
    refused(&["train", "--resume", text(&killed)], 2, &[&format!("made {steps} steps already")]);
    assert_eq!(std::fs::read(killed.join("policy.safetensors")).unwrap(), policy);
    assert_eq!(files.map(|name| std::fs::read(killed.join(name)).unwrap()), before);
    // above the largest integer of a checkpoint
    let large = (1_u64 << 63).to_string();
    refused(&["train", "--resume", text(&killed), "--steps", &large], 2, &["steps is 9223372036854775808"]);
    assert_eq!(files.map(|name| std::fs::read(killed.join(name)).unwrap()), before);
    // more steps continue the run
    let steps = steps + 2 * 2048;
    let longer = json(&["train", "--resume", text(&killed), "--steps", &steps.to_string()]);
    assert_eq!(longer["steps"], steps);
}

/// Returns the tensors of a safetensors file without the metadata.
fn tensors(bytes: &[u8]) -> Vec<u8> {
    let metadata = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
    let tensors = bytes[8 + metadata..].to_vec();
    assert!(!tensors.is_empty());
    tensors
}

/// Waits until a file exists.
fn wait_for(path: &Path) {
    let began = Instant::now();
    while !path.exists() && began.elapsed() < Duration::from_secs(60) {
        std::thread::sleep(Duration::from_millis(5));
    }
    assert!(path.exists(), "{}", path.display());
}

#[test]
fn the_command_that_a_stopped_run_prints_continues_the_run() {
    let config = config_file("stopped_config", "checkpoint_every = 4\nevaluate_every = 3\nepisodes = 2\n");
    let (whole, stopped) = (directory("not stopped"), directory("it is stopped"));
    let long = LONG.to_string();
    let train = ["train", "--task", "hover", "--envs", "64", "--steps", &long, "--config", text(&config)];
    let mut arguments: Vec<String> = train.iter().map(ToString::to_string).collect();
    arguments.extend(["--out".into(), text(&stopped).into()]);
    for (signal, status) in [("INT", 130), ("TERM", 143), ("HUP", 129)] {
        // the tests may run under nohup, which ignores SIGHUP
        let mut command = Command::new("env");
        command.args(["--default-signal=HUP", env!("CARGO_BIN_EXE_aviary")]).args(&arguments);
        let child = Running::start(command.stdout(Stdio::piped()).stderr(Stdio::piped()));
        // the run writes the curve at the next checkpoint
        wait_for(&stopped.join("curve.csv"));
        send(&format!("-{signal}"), &child);
        let output = child.output();
        let error = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(status), "{signal}: {error}");
        assert!(output.stdout.is_empty());
        let last = error.lines().last().unwrap();
        assert!(last.contains(&format!("stopped by SIG{signal} after")), "{error}");
        // the arguments of the command in a shell
        let quoted = last.split('`').nth(1).unwrap().strip_prefix("aviary ").unwrap();
        let words = Command::new("sh").args(["-c", &format!("printf '%s\\n' {quoted}")]).output().unwrap();
        arguments = String::from_utf8(words.stdout).unwrap().lines().map(str::to_string).collect();
        assert_eq!(arguments, ["train", "--resume", text(&stopped)]);
        let left = std::fs::read_dir(&stopped).unwrap().map(|entry| entry.unwrap().file_name());
        let mut left: Vec<_> = left.map(|name| name.into_string().unwrap()).collect();
        left.sort();
        assert_eq!(left, ["checkpoint.safetensors", "curve.csv", "policy.safetensors"]);
        std::fs::remove_file(stopped.join("curve.csv")).unwrap();
    }
    // the run ends a few iterations after the last checkpoint
    let checkpoint = |run: &Path| Trainer::resume(run.join("checkpoint.safetensors")).unwrap();
    let steps = (checkpoint(&stopped).steps() + 6 * 2048).to_string();
    let train = ["train", "--task", "hover", "--envs", "64", "--steps", &steps, "--config", text(&config)];
    for arguments in [
        [&train[..], &["--out", text(&whole)]].concat(),
        ["train", "--resume", text(&stopped), "--steps", &steps].to_vec(),
    ] {
        run(&arguments);
    }
    assert_equal_files(&whole, &stopped, &["curve.csv", "curve.svg", "curve.png"]);
    // the policies differ in the command that made them
    let best = |run: &Path| tensors(&std::fs::read(run.join("policy.safetensors")).unwrap());
    assert_eq!(best(&whole), best(&stopped));
    let last = |run: &Path| tensors(&checkpoint(run).policy().unwrap().to_bytes().unwrap());
    assert_eq!(last(&whole), last(&stopped));
}

#[test]
fn a_run_does_not_replace_an_earlier_run() {
    let out = directory("train_earlier");
    let train = [&["train", "--task", "hover", "--out", text(&out)][..], &SMALL].concat();
    run(&train);
    let files = || ["checkpoint.safetensors", "policy.safetensors"].map(|name| std::fs::read(out.join(name)).unwrap());
    let before = files();
    let resume = format!("--resume {} or another --out", text(&out));
    refused(&train, 2, &[text(&out), "checkpoint.safetensors of an earlier run", &resume]);
    // a run of another task does not replace it either
    refused(&["train", "--task", "race", "--out", text(&out)], 2, &["checkpoint.safetensors"]);
    assert_eq!(files(), before);
    std::fs::remove_file(out.join("checkpoint.safetensors")).unwrap();
    refused(&train, 2, &["policy.safetensors of an earlier run, expected another --out"]);

    // --all trains no task if one task has an earlier run
    let all = directory("earlier_all");
    std::fs::create_dir_all(all.join("race")).unwrap();
    std::fs::write(all.join("race/policy.safetensors"), b"mine").unwrap();
    refused(&["train", "--all", "--out", text(&all)], 2, &["race: it has policy.safetensors"]);
    assert_eq!(entries(&all), 1);
}

#[test]
fn two_runs_cannot_write_to_one_directory_at_a_time() {
    let out = directory("together");
    let mut command = Command::new(env!("CARGO_BIN_EXE_aviary"));
    command.args(["train", "--task", "hover", "--envs", "64", "--steps", "20000000", "--out", text(&out)]);
    let first = Running::start(command.stdout(Stdio::null()).stderr(Stdio::null()));
    wait_for(&out.join("checkpoint.safetensors"));
    let train = [&["train", "--task", "hover", "--out", text(&out)][..], &SMALL].concat();
    refused(&train, 1, &[text(&out), "another run is writing"]);
    refused(&["train", "--resume", text(&out)], 1, &[text(&out), "another run is writing"]);
    drop(first);
}

#[test]
fn the_number_of_steps_is_rounded_up_to_whole_iterations_with_a_note() {
    let out = directory("rounded");
    let output = aviary(&["train", "--task", "hover", "--envs", "64", "--steps", "100", "--out", text(&out)]);
    let (error, table) = (String::from_utf8(output.stderr).unwrap(), String::from_utf8(output.stdout).unwrap());
    assert_eq!(output.status.code(), Some(0), "{error}");
    assert!(error.contains("note: 100 steps are rounded up to 2048, whole iterations of 2048 steps"), "{error}");
    assert!(error.contains("hover: 2048 of 2048 steps"), "{error}");
    assert!(table.contains("2048 (100 in whole iterations)"), "{table}");
    let longer = aviary(&["train", "--resume", text(&out), "--steps", "2049", "--json"]);
    assert_eq!(String::from_utf8(longer.stderr).unwrap(), "", "only JSON");
    let run: Value = serde_json::from_slice(&longer.stdout).unwrap();
    assert_eq!((&run["steps"], &run["requested_steps"]), (&4096.into(), &2049.into()));
}

#[test]
fn without_a_terminal_every_evaluation_prints_a_line() {
    let config = config_file("lines_config", "evaluate_every = 2\nepisodes = 2\n");
    let out = directory("lines");
    let train = ["train", "--task", "hover", "--config", text(&config), "--out", text(&out)];
    let output = aviary(&[&train[..], &SMALL].concat());
    assert_eq!(output.status.code(), Some(0));
    let error = String::from_utf8(output.stderr).unwrap();
    let lines: Vec<&str> = error.lines().collect();
    assert_eq!(lines.len(), 3, "{error}");
    for (line, steps) in lines.iter().zip([4096, 8192, 12_288]) {
        assert!(line.starts_with(&format!("hover: {steps} of 12288 steps, ")), "{line}");
        assert!(line.contains("success") && line.contains("steps/s"), "{line}");
    }
}

#[test]
fn every_task_can_be_trained_and_its_policy_flown() {
    let out = directory("train_all");
    let runs = json(&["train", "--all", "--steps", "2048", "--envs", "16", "--out", text(&out)]);
    let tasks: Vec<_> = runs.as_array().unwrap().iter().map(|run| run["task"].as_str().unwrap().to_string()).collect();
    assert_eq!(tasks, aviary::tasks::NAMES);
    for task in tasks {
        let policy = out.join(&task).join("policy.safetensors");
        let flown = json(&["play", "--policy", text(&policy), "--episodes", "2", "--duration", "0.5"]);
        assert_eq!((flown["task"].as_str(), flown["episodes"].as_array().unwrap().len()), (Some(&*task), 2));
    }
}

#[test]
fn show_prints_the_recipe_of_every_task() {
    for task in aviary::tasks::NAMES {
        let shown = aviary(&["train", "--task", task, "--show"]);
        assert_eq!(shown.status.code(), Some(0), "{task}");
        let table = |text: &str| text.parse::<toml::Table>().unwrap();
        let mut recipe = table(&learn::TrainConfig::of_task(task).unwrap().to_toml().unwrap());
        // recorded configurations contain this option only if it is set
        recipe["ppo"].as_table_mut().unwrap().insert("recurrent".into(), 0.into());
        assert_eq!(table(&String::from_utf8(shown.stdout).unwrap()), recipe, "{task}");
    }
}

/// The episodes of two parts are together bit-identical to those of one run.
#[test]
fn the_parts_of_an_evaluation_are_together_one_run() {
    let policy = pretrained("hover");
    let play = |more: &[&str]| {
        let arguments = ["play", "--policy", &policy, "--episodes", "5", "--duration", "1", "--seed", "40"];
        json(&[&arguments[..], more].concat())
    };
    let episodes = |summary: &Value| summary["episodes"].as_array().unwrap().clone();
    let whole = play(&[]);
    let parts = [play(&["--shard", "1/2"]), play(&["--shard", "2/2"])];
    assert_eq!((episodes(&parts[0]).len(), &parts[0]["shard"]), (2, &Value::from("1/2")));
    assert_eq!(parts.iter().flat_map(episodes).collect::<Vec<_>>(), episodes(&whole));
    refused(&["play", "--policy", &policy, "--episodes", "2", "--shard", "1/3"], 2, &["--shard is 1/3 of 2 episodes"]);
}

#[test]
fn the_policies_in_assets_complete_their_tasks() {
    for (task, episodes) in [("hover", 20), ("velocity", 10), ("fly_through", 5), ("race", 5)] {
        let (policy, count) = (pretrained(task), episodes.to_string());
        let flown = json(&["play", "--policy", &policy, "--episodes", &count, "--seed", "777"]);
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
    let randomized = pretrained("hover_randomized");
    let flown = json(&["play", "--policy", &randomized, "--as-trained", "--episodes", "10", "--seed", "777"]);
    assert_eq!(flown["success_rate"], 1.0, "{flown:#}");
    let identified = pretrained("hover_cf21");
    let flown = json(&["play", "--policy", &identified, "--as-trained", "--episodes", "40", "--seed", "777"]);
    assert_eq!(flown["drone_model"], "cf21");
    // a drone that starts down near the floor touches it before slow motors carry it
    let airborne = |episode: &&Value| episode["seconds"].as_f64().unwrap() > 0.5;
    let flights: Vec<_> = flown["episodes"].as_array().unwrap().iter().filter(airborne).collect();
    assert!(flights.len() >= 34 && flights.iter().all(|episode| episode["success"] == true), "{flown:#}");
    let table = run(&["play", "--policy", &pretrained("hover"), "--episodes", "3"]);
    assert!(table.lines().count() == 5 && table.contains("3 of 3 episodes of hover succeeded"), "{table}");
}

#[test]
fn options_change_the_conditions_of_a_policy_and_write_animations() {
    let policy = pretrained("hover");
    let play = |more: &[&str]| json(&[&["play", "--policy", &policy, "--episodes", "2"][..], more].concat());
    let calm = play(&[]);
    assert_ne!(calm["episodes"], play(&["--wind", "combined"])["episodes"]);
    assert_ne!(calm["episodes"], play(&["--physics", "mjc_gnd_drag_dw"])["episodes"]);
    if has_gl() {
        let gif = directory("played").with_extension("gif");
        play(&["--duration", "0.5", "--gif", text(&gif)]);
        assert!(std::fs::read(&gif).unwrap().starts_with(b"GIF89a"));
    }
}

#[test]
fn as_trained_restores_the_conditions_of_the_training() {
    let content = "physics = \"mjc_drag\"\nepisode_seconds = 1.5\nevaluate_every = 2\nepisodes = 2\n\
        [ppo]\nhidden = [8]\n\
        [wind]\nmodel = \"constant\"\nvelocity = [3.0, 0.0, 0.0]\n[randomization.body]\nmass = [0.8, 1.2]\n";
    let config = config_file("trained_config", content);
    let (config, out) = (text(&config), directory("trained"));
    json(&[&["train", "--task", "hover", "--config", config, "--out", text(&out)][..], &SMALL].concat());
    let policy = out.join("policy.safetensors");
    let policy = text(&policy);
    let play = |more: &[&str]| json(&[&["play", "--policy", policy, "--episodes", "3"][..], more].concat());
    let trained = play(&["--as-trained"]);
    assert_eq!(trained["physics"], "mjc_drag");
    // the options of the trainer in the file have no effect
    assert_eq!(play(&["--config", config]), trained);
    let plain = play(&[]);
    assert_eq!(plain["physics"], "mjc");
    assert_ne!(plain["episodes"], trained["episodes"]);
    // options override the file
    assert_eq!(play(&["--config", config, "--physics", "mjc"])["physics"], "mjc");
    let shorter = play(&["--as-trained", "--duration", "0.25"]);
    let lengths = |run: &Value| -> Vec<f64> {
        run["episodes"].as_array().unwrap().iter().map(|episode| episode["seconds"].as_f64().unwrap()).collect()
    };
    assert!(lengths(&shorter).iter().all(|&seconds| seconds <= 0.25));
    assert!(lengths(&trained).iter().all(|&seconds| seconds <= 1.5), "{trained:#}");

    refused(&["play", "--policy", policy, "--as-trained", "--wind", "gust"], 2, &["--as-trained", "--wind"]);
    refused(&["play", "--policy", policy, "--as-trained", "--config", config], 2, &["--as-trained", "--config"]);
    let wrong = config_file("wrong_config", "steps = 1\nstepps = 2\n");
    refused(&["play", "--policy", policy, "--config", text(&wrong)], 2, &["wrong_config.toml", "line 2", "stepps"]);
    let old = pretrained("race");
    refused(&["play", "--policy", &old, "--as-trained"], 2, &["race.safetensors", "version 1", "expected --config"]);
}

#[test]
fn impossible_runs_and_policies_are_refused() {
    let out = directory("train_refused");
    let path = text(&out);
    refused(&["train", "--task", "hoover", "--out", path], 2, &["hoover", "did you mean `hover`"]);
    refused(&["train", "--out", path], 2, &["--task or --all or --resume is missing"]);
    refused(&["train", "--task", "hover", "--envs", "0", "--out", path], 2, &["environments is 0"]);
    refused(&["train", "--task", "hover", "--config", "nowhere.toml", "--out", path], 2, &["nowhere.toml"]);
    let file = config_file("no_model", "[wind]\nvelocity = [3.0, 0.0, 0.0]\n");
    let texts = ["no_model.toml", "[wind] has no model"];
    refused(&["train", "--task", "hover", "--config", text(&file), "--out", path], 2, &texts);
    // --wind sets the model
    run(&["play", "--policy", &pretrained("hover"), "--config", text(&file), "--wind", "gust", "--episodes", "1"]);
    refused(&["train", "--resume", path], 2, &["checkpoint.safetensors"]);
    refused(&["train", "--task", "hover", "--resume", path], 2, &["--resume"]);
    // the table of a run without success is complete
    let failed = aviary(&[&["train", "--task", "hover", "--until-success", "--out", path][..], &SMALL].concat());
    assert_eq!(failed.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&failed.stderr).contains("no success within 12288 steps"));
    assert!(String::from_utf8_lossy(&failed.stdout).contains("breakdown of wall time"));
    refused(&["play", "--policy", "nowhere.safetensors"], 2, &["nowhere.safetensors"]);
    refused(&["play", "--policy", &pretrained("hover"), "--episodes", "0"], 2, &["--episodes is 0"]);
    refused(&["play", "--policy", &pretrained("hover"), "--task", "race"], 2, &["12 observations", "21 observations"]);
    let file = out.join("no.safetensors");
    std::fs::write(&file, b"no policy").unwrap();
    refused(&["play", "--policy", text(&file)], 2, &["no.safetensors", "not a policy"]);
}

#[test]
fn the_output_of_show_is_a_configuration_file() {
    let shown = run(&["train", "--task", "race", "--show"]);
    let file = config_file("shown", &shown);
    assert_eq!(run(&["train", "--task", "race", "--config", text(&file), "--show"]), shown);
}

#[test]
fn training_on_a_gpu_needs_the_feature() {
    let out = directory("train_gpu");
    let options = [&["train", "--task", "hover", "--device", "gpu", "--out", text(&out)][..], &SMALL].concat();
    if cfg!(not(feature = "gpu")) {
        refused(&options, 2, &["without training on a GPU", "--features gpu"]);
        assert!(!out.exists());
    }
    refused(&["train", "--task", "hover", "--adapter", "1"], 2, &["--adapter", "expected --device gpu"]);
    refused(&["train", "--task", "hover", "--device", "tpu"], 2, &["--device is `tpu`, expected one of: cpu, gpu"]);
}

#[cfg(feature = "gpu")]
#[test]
fn a_training_on_a_gpu_is_resumed_on_a_gpu() {
    let config = config_file("gpu_config", "checkpoint_every = 2\nevaluate_every = 2\nepisodes = 2\n");
    let (whole, resumed) = (directory("gpu_whole"), directory("gpu_resumed"));
    let task = ["train", "--task", "hover", "--device", "gpu"];
    let train = |out: &Path, steps: &str| {
        let options = ["--envs", "64", "--config", text(&config), "--out", text(out), "--steps", steps, "--json"];
        aviary(&[&task[..], &options].concat())
    };
    let output = train(&whole, "12288");
    if String::from_utf8_lossy(&output.stderr).contains("error: no GPU") {
        // .ci/features runs on a machine with an adapter
        assert_eq!(output.status.code(), Some(1));
        return;
    }
    let run: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!((&run["device"], &run["steps"], &run["stop"]), (&"gpu".into(), &12_288.into(), &"steps".into()));
    assert_eq!(train(&resumed, "8192").status.code(), Some(0));
    json(&["train", "--resume", text(&resumed), "--steps", "12288"]);
    assert_equal_files(&whole, &resumed, &["curve.csv"]);
    let explicit = config_file("gpu_explicit", "physics = \"dyn\"\n");
    for (options, message) in [
        (["--config", text(&explicit)], "error: engine is explicit, expected mujoco or hybrid on the GPU"),
        (["--adapter", "no such GPU"], "error: the adapter \"no such GPU\" does not exist, expected one of"),
    ] {
        let output = aviary(&[&task[..], &options].concat());
        let errors = String::from_utf8(output.stderr).unwrap();
        // Mesa prints lines of its own on a machine without a session
        assert!(errors.lines().last().unwrap().starts_with(message), "{errors}");
        assert_eq!(output.status.code(), Some(2));
    }
}
