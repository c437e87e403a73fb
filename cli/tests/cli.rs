//! Output, files, errors and exit status of the program.

use std::path::Path;
use std::process::Command;

use serde_json::Value;

mod common;

use common::{
    assert_equal_files, aviary, directory, entries, has_gl, json, reference, refused, run, send, spawn, text,
    wait_for_rows, write, write_script,
};

#[test]
fn hover_ends_at_its_target_and_reports_the_error() {
    for drone in ["cf2x", "cf2p", "race"] {
        let flight = json(&["fly", "--task", "hover", "--drone", drone]);
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
    assert!(run(&["fly", "--task", "hover"]).contains("final position error"));
}

#[test]
fn equal_seeds_give_equal_files() {
    let (a, b) = (directory("seed-a"), directory("seed-b"));
    for path in [&a, &b] {
        run(&["fly", "--task", "hover", "--seed", "1", "--duration", "2", "--out", text(path)]);
    }
    assert_equal_files(&a, &b, &["drone0.csv", "summary.json"]);
    let mut log = csv::Reader::from_path(a.join("drone0.csv")).unwrap();
    let rows: Vec<_> = log.records().map(Result::unwrap).collect();
    assert_eq!(rows.len(), 97, "the initial state and one row per control step");
    assert_eq!(&rows[96][0], "2.0");
    let summary: Value = serde_json::from_slice(&std::fs::read(a.join("summary.json")).unwrap()).unwrap();
    let z: f64 = rows[96][4].parse().unwrap();
    assert_eq!(summary["drones"][0]["final_position"][2], z);
}

#[test]
fn errors_of_the_command_line_have_one_line_and_status_2() {
    refused(&["fly", "--task", "nosuch"], 2, &["--task is `nosuch`", "`aviary tasks`"]);
    refused(&["fly", "--task", &"long".repeat(99)], 2, &["--task is `longlong", "…`"]);
    refused(&["fly", "--task", "hovr"], 2, &["did you mean `hover`?"]);
    refused(&["fly"], 2, &["--task is missing"]);
    refused(&["train"], 2, &["--task or --all or --resume is missing"]);
    refused(&["capture", "--task", "hover"], 2, &["--frames, --out are missing"]);
    refused(&["fly", "--task", "hover", "--sim-freq", "100", "--ctrl-freq", "48"], 2, &["100 Hz", "48 Hz", "multiple"]);
    refused(&["fly", "--task", "hover", "--ctrl-freq", "0"], 2, &["0 Hz"]);
    refused(&["fly", "--task", "hover", "--sim-freq", "-5"], 2, &["-5"]);
    refused(&["fly", "--task", "hover", "--duration", "-1"], 2, &["-1 s", "positive"]);
    refused(&["fly", "--task", "hover", "--duration", "nan"], 2, &["NaN"]);
    refused(&["fly", "--task", "hover", "--duration", "long"], 2, &["long"]);
    refused(&["fly", "--task", "hover", "--controller", "none"], 2, &["--controller is `none`", "pid"]);
    refused(&["fly", "--task", "hover", "--drone", "cf3x"], 2, &["--drone is `cf3x`", "cf2x"]);
    refused(&["fly", "--task", "hover", "--wings", "2"], 2, &["--wings"]);
    refused(&["fly", "--task", "hover", "--seed", "-1"], 2, &["--seed", "-1"]);
    refused(&["fly", "--task", "hover", "--camera", "front"], 2, &["--gif"]);
    refused(&["fly", "--task", "hover", "--drone", "cf2"], 2, &["did you mean `cf2x`?"]);
    refused(&["fly", "--task", "antipodal", "--num-drones", "17"], 2, &["--num-drones is 17, expected at most 16"]);
    refused(&["land"], 2, &["land"]);
    refused(&[], 2, &["--help"]);
}

#[test]
fn errors_of_airframe_files_name_file_line_and_field() {
    let dir = directory("airframes");
    let good = include_str!("../../assets/airframes/cf2x.toml");
    let file = |name: &str, content: &str| write(&dir.join(name), content);
    let heavy = file("heavy.toml", &good.replace("mass = 0.027", "mass = 0.035").replace("\"cf2x\"", "\"heavy\""));
    let flight = json(&["fly", "--task", "hover", "--drone", text(&heavy)]);
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
fn an_unwritable_output_has_status_1_before_the_flight() {
    let file = write(&directory("blocked").join("file"), "not a directory");
    refused(&["fly", "--task", "hover", "--out", text(&file.join("out"))], 1, &[text(&file)]);
    refused(&["fly", "--task", "hover", "--out", text(&file)], 1, &[text(&file)]);
    assert_eq!(std::fs::read_to_string(&file).unwrap(), "not a directory");
}

#[test]
fn every_airframe_hovers_in_every_physics_mode() {
    for physics in ["mjc", "mjc_gnd", "mjc_drag", "mjc_dw", "mjc_gnd_drag_dw", "dyn"] {
        for drone in ["cf2x", "cf2p", "race", "cf21"] {
            let flight = json(&["fly", "--task", "hover", "--physics", physics, "--drone", drone]);
            assert_eq!((&flight["physics"], &flight["success"]), (&physics.into(), &true.into()), "{physics} {drone}");
        }
    }
    refused(&["fly", "--task", "hover", "--physics", "mjc_dg"], 2, &["--physics is `mjc_dg`", "did you mean"]);
}

#[test]
fn an_output_replaces_neither_directories_nor_devices_nor_links() {
    let dir = directory("special");
    std::fs::create_dir_all(&dir).unwrap();
    let (scenario, actions) = (reference("mjc_cf2x.toml"), reference("mjc_cf2x.actions.csv"));
    let replay = |out: &str| aviary(&["replay", "--scenario", &scenario, "--actions", &actions, "--out", out]);
    assert_eq!(replay(text(&dir)).status.code(), Some(1));
    assert_eq!(replay("/dev/null").status.code(), Some(1));
    std::fs::write(dir.join("file"), "old").unwrap();
    std::os::unix::fs::symlink("file", dir.join("link")).unwrap();
    assert!(replay(text(&dir.join("link"))).status.success());
    assert!(std::fs::symlink_metadata(dir.join("link")).unwrap().is_symlink());
    assert!(std::fs::read_to_string(dir.join("file")).unwrap().starts_with("t,drone"));
}

/// Two runs with one output directory would mix their files.
#[test]
fn two_runs_cannot_share_an_output_directory() {
    let dir = directory("locked");
    let mut child = spawn(&["fly", "--task", "hover", "--duration", "100000", "--out", text(&dir)]);
    wait_for_rows(&dir, &mut child, 10);
    let fly = ["fly", "--task", "hover", "--duration", "0.1", "--plot", "--out", text(&dir)];
    let texts = [text(&dir), "another run is writing to this directory"];
    refused(&fly, 1, &texts);
    if has_gl() {
        refused(&["capture", "--task", "hover", "--frames", "1", "--out", text(&dir)], 1, &texts);
    }
    send("-KILL", &child);
    child.wait().unwrap();
    assert_eq!(entries(&dir), 2, "the log and the scenario, without a lock file");
    run(&fly);
}

#[test]
fn a_writable_directory_need_not_be_readable() {
    use std::os::unix::fs::PermissionsExt as _;
    let dir = directory("not-readable");
    std::fs::create_dir_all(&dir).unwrap();
    let mode = |mode| std::fs::set_permissions(&dir, std::fs::Permissions::from_mode(mode)).unwrap();
    mode(0o300);
    let output = aviary(&["fly", "--task", "hover", "--duration", "0.1", "--out", text(&dir)]);
    mode(0o700);
    let error = String::from_utf8(output.stderr).unwrap();
    assert!(dir.join("drone0.csv").is_file() && dir.join("scenario.toml").is_file(), "{error}");
}

#[test]
fn completion_scripts_have_commands_options_and_names() {
    for (shell, texts) in [
        ("bash", &["complete", "multi_hover", "--overlay", "geometric"][..]),
        ("zsh", &["#compdef aviary", "multi_hover", "mjc_gnd_drag_dw"]),
        ("fish", &["complete -c aviary", "fly_through"]),
    ] {
        let script = run(&["completions", shell]);
        for text in texts {
            assert!(script.contains(text), "{shell}: {text}");
        }
    }
    refused(&["completions", "fisch"], 2, &["the shell is `fisch`, expected one of: bash,", "did you mean `fish`?"]);
}

#[test]
fn errors_suggest_the_nearest_name() {
    let file = write(&directory("nearest").join("conditions.toml"), "[wind]\nmodle = \"gust\"\n");
    for (arguments, near) in [
        (&["flly"][..], "fly"),
        (&["fly", "--task", "hovr"], "hover"),
        (&["fly", "--tsk", "hover"], "--task"),
        (&["fly", "--task", "hover", "--drone", "cf2"], "cf2x"),
        (&["fly", "--task", "hover", "--physics", "mjc_ground"], "mjc_gnd"),
        (&["fly", "--task", "hover", "--controller", "geo"], "geometric"),
        (&["fly", "--task", "hover", "--trajectory", "cirle"], "circle"),
        (&["fly", "--task", "hover", "--obstacles", "florest"], "forest"),
        (&["fly", "--task", "hover", "--config", text(&file)], "did you mean `model`"),
        (&["render", "--task", "hover", "--out", "x.png", "--kind", "deph"], "depth"),
        (&["render", "--task", "hover", "--out", "x.jpg"], ".png"),
    ] {
        refused(arguments, 2, &[near]);
    }
}

/// An airframe in wrong units flies; its derived numbers are implausible.
#[test]
fn implausible_numbers_of_an_airframe_are_warnings() {
    for name in ["cf2x", "cf2p", "race"] {
        let airframe = json(&["airframe", name]);
        assert_eq!((&airframe["name"], &airframe["plausible"]), (&name.into(), &true.into()));
        assert_eq!((&airframe["warnings"], &airframe["suspected_unit"]), (&Value::Array(vec![]), &Value::Null));
    }
    let table = run(&["airframe", "cf2x"]);
    assert!(table.contains("14476 rpm") && table.contains("0.6667") && !table.contains("warning"), "{table}");

    let path = directory("airframes-checked").join("in_grams.toml");
    let crazyflie = include_str!("../../assets/airframes/cf2x.toml");
    let set_mass = |mass: &str| write(&path, &crazyflie.replace("mass = 0.027", &format!("mass = {mass}")));
    set_mass("1200");
    let table = run(&["airframe", text(&path)]);
    assert!(table.lines().any(|line| line.starts_with("warning: ") && line.contains("check mass")), "{table}");
    set_mass("27");
    let table = run(&["airframe", text(&path)]);
    assert!(table.contains("every warning disappears with mass in grams (in kg it is 0.027)"), "{table}");
    // a flight is possible, with a warning
    let fly = |drone: &str| {
        let output = aviary(&["fly", "--task", "hover", "--duration", "0.1", "--drone", drone]);
        String::from_utf8(output.stdout).unwrap()
    };
    assert!(fly(text(&path)).contains("implausible: see `aviary airframe`"));
    let table = fly("cf2x");
    assert!(table.contains("hover speed") && table.contains("14476 rpm, 67 % of the maximum"), "{table}");
    assert!(!table.contains("implausible"), "{table}");

    refused(&["airframe", "cf2xx"], 2, &["the airframe is `cf2xx`", "did you mean `cf2x`", ".toml"]);
    refused(&["airframe", "no.toml"], 2, &["no.toml: No such file"]);
    set_mass("\"27 g\"");
    refused(&["airframe", text(&path)], 2, &["in_grams.toml", "line 3"]);
}

/// ffmpeg is optional: a missing ffmpeg is not an error.
#[test]
fn doctor_reports_a_missing_ffmpeg_with_the_command_that_installs_it() {
    let dir = directory("no-ffmpeg");
    std::fs::create_dir_all(&dir).unwrap();
    let run = |arguments: &[&str]| {
        let output = Command::new(env!("CARGO_BIN_EXE_aviary")).args(arguments).env("PATH", &dir).output().unwrap();
        (output.status.code(), String::from_utf8(output.stdout).unwrap())
    };
    let works = if has_gl() { Some(0) } else { Some(1) };
    let (status, table) = run(&["doctor"]);
    assert_eq!(status, works, "{table}");
    assert_eq!(table.matches("apt-get install ffmpeg").count(), 1, "{table}");
    let (status, doctor) = run(&["doctor", "--json"]);
    let doctor: Value = serde_json::from_str(&doctor).unwrap();
    assert_eq!((status, &doctor["ffmpeg"]["works"]), (works, &false.into()));
    write_script(&dir.join("ffmpeg"), "echo 'ffmpeg version 5.1.6-0+deb12u1 Copyright (c) 2000-2024'");
    let (_, table) = run(&["doctor"]);
    assert!(table.contains("works (5.1.6-0+deb12u1)") && !table.contains("install ffmpeg"), "{table}");
}

/// The script runs as a normal user without sudo, packages, Rust and curl.
#[test]
fn setup_names_all_missing_packages_at_once() {
    use std::os::unix::fs::symlink;
    let dir = directory("bare-machine");
    std::fs::create_dir_all(dir.join("home")).unwrap();
    for tool in ["dirname", "sed", "cut", "sort", "head", "env"] {
        let path = ["/usr/bin", "/bin"].map(|at| Path::new(at).join(tool)).into_iter().find(|path| path.exists());
        symlink(path.unwrap(), dir.join(tool)).unwrap();
    }
    for (name, text) in [("id", "echo 1000"), ("dpkg-query", "exit 1")] {
        write_script(&dir.join(name), text);
    }
    let output = Command::new("/bin/sh")
        .arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("../setup"))
        .env_clear()
        .envs([("PATH", dir.as_path()), ("HOME", &dir.join("home"))])
        .output()
        .unwrap();
    let error = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(1), "{error}");
    let install: Vec<_> = error.lines().filter(|line| line.contains("apt-get")).collect();
    let [install] = install[..] else { panic!("{error}") };
    for part in ["apt-get update", "libmujoco-dev", "libclang-dev", "g++", "libegl1", "libosmesa6", "curl"] {
        assert!(install.contains(part), "{part}: {install}");
    }
}

#[test]
fn tasks_and_doctor_print_json_and_tables() {
    let tasks = json(&["tasks"]);
    let numbers = |task: usize| {
        ["drones", "episode_seconds", "observation_size", "action_size"].map(|key| tasks[task][key].as_f64().unwrap())
    };
    assert_eq!((&tasks[0]["name"], numbers(0)), (&"hover".into(), [1.0, 10.0, 12.0, 4.0]));
    assert_eq!((&tasks[6]["name"], numbers(6)), (&"multi_agent".into(), [3.0, 10.0, 13.0, 4.0]));
    assert!(run(&["tasks"]).contains("hover"));
    let output = aviary(&["doctor", "--json"]);
    let doctor: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert!(doctor["mujoco_version"].as_str().unwrap().starts_with("2.2."));
    let backends: Vec<_> = doctor["gl"].as_array().unwrap().iter().map(|answer| &answer["backend"]).collect();
    assert_eq!(backends, ["egl", "osmesa"]);
    assert_eq!(doctor["ok"], output.status.success());
    assert!(String::from_utf8(aviary(&["doctor"]).stdout).unwrap().contains("MuJoCo"));
}

#[test]
fn help_and_version_have_status_0() {
    for arguments in [&["--help"][..], &["fly", "--help"], &["--version"]] {
        let output = aviary(arguments);
        assert!(output.status.success() && output.stderr.is_empty() && !output.stdout.is_empty());
    }
}

/// Returns all commands with their description in the list of `aviary -h`.
fn commands() -> Vec<(String, String)> {
    let help = run(&["-h"]);
    let list = help.lines().skip_while(|line| *line != "Commands:").skip(1).take_while(|line| !line.is_empty());
    let commands: Vec<_> = list
        .filter_map(|line| line.trim().split_once(' '))
        .map(|(name, about)| (name.to_string(), about.trim().to_string()))
        .filter(|(name, _)| name != "help")
        .collect();
    assert_eq!(commands.len(), 17, "{help}");
    commands
}

#[test]
fn the_short_help_has_a_line_per_option_and_the_long_help_the_details() {
    /// Columns of the text of an option.
    const TEXT: usize = 70;
    /// Columns of a line.
    const LINE: usize = 100;
    for (command, about) in commands() {
        let (short, long) = (run(&[&command, "-h"]), run(&[&command, "--help"]));
        for help in [&short, &long] {
            assert_eq!(help.lines().next(), Some(&*about), "{command}");
            assert!(help.contains("\nExamples:\n"), "{command}");
            for line in help.lines().filter(|line| !line.starts_with("Usage:") && !line.starts_with("  aviary")) {
                assert!(line.chars().count() <= LINE, "{command}: {line}");
            }
        }
        let options = short.lines().skip_while(|line| *line != "Options:").skip(1).take_while(|line| !line.is_empty());
        for option in options {
            assert!(option.trim_start().starts_with('-'), "{command}: more than a line: {option}");
            let text = option.trim_start().split_once("  ").map_or("", |(_, text)| text.trim());
            assert!(!text.is_empty(), "{command}: {option}");
            let text = text.split(" [default").next().unwrap();
            assert!(text.chars().count() <= TEXT, "{command}: {text}");
        }
    }
    let long = run(&["fly", "--help"]);
    for detail in ["Missing the goal is not an error", "`hybrid` computes the same flight", "drone0.csv"] {
        assert!(long.contains(detail) && !run(&["fly", "-h"]).contains(detail), "{detail}");
    }
}

#[test]
fn every_controller_follows_trajectories_and_the_geometric_one_flies_a_loop() {
    for (trajectory, controller, drone, within) in [
        ("circle", "geometric", "cf2x", 0.012),
        ("circle", "dsl", "cf2p", 0.03),
        ("helix", "geometric", "race", 0.005),
        ("loop", "geometric", "race", 0.02),
        ("square", "pid", "cf2x", 1.2),
    ] {
        let flight =
            json(&["fly", "--task", "hover", "--trajectory", trajectory, "--controller", controller, "--drone", drone]);
        assert_eq!((&flight["controller"], &flight["trajectory"]), (&controller.into(), &trajectory.into()));
        assert!(flight["peak_position_error"].as_f64().unwrap() < within, "{trajectory}: {flight}");
        assert_eq!(flight["success"], trajectory != "square", "{trajectory}: {flight}");
    }
}

#[test]
fn errors_of_trajectory_files_name_file_line_and_key() {
    let path = directory("trajectories").join("path.toml");
    let write = |text: &str| write(&path, text);
    let fly = ["fly", "--task", "hover", "--controller", "geometric", "--trajectory", text(&path)];
    write("kind = \"waypoints\"\npoints = [[0, 0, 1], [1, 0, 1], [1, 1, 4]]\nyaws = [0, 1, 2]\n");
    let flight = json(&fly);
    assert_eq!(flight["success"], true);
    assert!((flight["drones"][0]["final_position"][2].as_f64().unwrap() - 4.0).abs() < 0.01, "above the task's limit");
    write("kind = \"circle\"\nradius = 0.5\nspeed = 1.0\n");
    refused(&fly, 2, &["path.toml", "line 3", "speed"]);
    write("kind = \"circle\"\nradius = 0.5\nperiod = 0.0\n");
    refused(&fly, 2, &["path.toml", "period"]);
    refused(&["fly", "--task", "hover", "--trajectory", "circel"], 2, &["did you mean `circle`"]);
    refused(&["fly", "--task", "hover", "--trajectory", "no.toml"], 2, &["no.toml: No such file"]);
}

#[test]
fn the_built_in_controllers_complete_every_task() {
    for (task, drone, seconds) in [
        ("velocity", "cf2x", 10.0),
        ("multi_hover", "cf2p", 10.0),
        ("multi_agent", "cf2x", 10.0),
        ("fly_through", "cf2x", 20.0),
        ("fly_through", "race", 20.0),
        ("formation", "cf2x", 30.0),
        ("race", "cf2x", 30.0),
        ("race", "race", 12.0),
        ("antipodal", "cf2x", 20.0),
    ] {
        let flight = json(&["fly", "--task", task, "--drone", drone, "--seed", "5"]);
        assert_eq!(
            (&flight["success"], &flight["progress"]),
            (&true.into(), &1.0.into()),
            "{task} with {drone}: {flight}"
        );
        assert!(flight["simulated_seconds"].as_f64().unwrap() <= seconds, "{task} with {drone}");
        assert!(flight["drones"].as_array().unwrap().iter().all(|drone| drone["crashed"] == false));
    }
    let flight = json(&["fly", "--task", "multi_hover", "--num-drones", "8"]);
    assert_eq!((&flight["success"], flight["drones"].as_array().unwrap().len()), (&true.into(), 8));
    let flight = json(&["fly", "--task", "antipodal", "--physics", "mjc_gnd_drag_dw"]);
    assert_eq!(flight["success"], true, "{flight}");
    assert!(flight["info"]["minimum_distance"].as_f64().unwrap() > 0.3);
    refused(&["fly", "--task", "race", "--trajectory", "circle"], 2, &["--trajectory goes with --task hover"]);
    refused(&["fly", "--task", "hover", "--num-drones", "2"], 2, &["--num-drones is 2, expected 1 in hover"]);
    refused(&["fly", "--task", "flythrough"], 2, &["did you mean `fly_through`"]);
}

#[test]
fn options_and_files_set_wind_obstacles_and_randomization() {
    let fly = |more: &[&str]| json(&[&["fly", "--task", "hover", "--controller", "geometric"][..], more].concat());
    let still = fly(&[]);
    for wind in ["constant", "gust", "dryden", "sinusoidal", "combined"] {
        let flight = fly(&["--wind", wind, "--seed", "3"]);
        assert_eq!(flight["wind"], wind, "{flight}");
        assert_ne!(flight["final_position_error"], still["final_position_error"], "{wind}");
        assert_eq!(fly(&["--wind", wind, "--seed", "3"])["reward"], flight["reward"]);
    }
    for (kind, parts) in [("forest", 20), ("urban", 8), ("indoor", 14), ("random", 8), ("gates", 16)] {
        let flight = fly(&["--obstacles", kind, "--duration", "1"]);
        assert_eq!(flight["obstacles"], parts, "{kind}: {flight}");
    }
    let path = directory("conditions").join("conditions.toml");
    let write = |text: &str| write(&path, text);
    write(
        "[wind]\nmodel = \"constant\"\nvelocity = [2, 0, 0]\n[obstacles]\nkind = \"custom\"\n[[obstacles.custom]]\n\
         shape = \"box\"\nsize = [0.1, 0.1, 1]\nposition = [1, 0, 1]\n[randomization.body]\nmass = [1.1, 1.1]\n",
    );
    let output = aviary(&["fly", "--task", "hover", "--controller", "geometric", "--json", "--config", text(&path)]);
    let flight: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!((&flight["wind"], &flight["obstacles"]), (&"constant".into(), &1.into()));
    assert_eq!(flight["info"]["sampled_mass"], 1.1);
    assert!(flight["drones"][0]["final_position"][0].as_f64().unwrap() > 0.0, "downwind");
    let refuse = |content: &str, texts: &[&str]| {
        write(content);
        refused(&["fly", "--task", "hover", "--config", text(&path)], 2, texts);
    };
    refuse("[wind]\nmodel = \"stormy\"\n", &["conditions.toml", "line 2"]);
    refuse("[wind]\nmodel = \"dryden\"\nturbulence = -1\n", &["conditions.toml", "turbulence is -1"]);
    refuse("[obstacles]\nkind = \"forest\"\ncount = 900\n", &["of 900 obstacles fit"]);
    refuse(
        "[obstacles]\nkind = \"custom\"\n[[obstacles.custom]]\nshape = \"box\"\nsize = [1]\nposition = [0, 0, 0]\n",
        &["size has 1 number, expected 3 for a box"],
    );
    refuse("[randomization.body]\nmass = [2, 1]\n", &["body.mass"]);
    refused(&["fly", "--task", "hover", "--wind", "combine"], 2, &["did you mean `combined`"]);
    refused(&["fly", "--task", "hover", "--obstacles", "forrest"], 2, &["did you mean `forest`"]);
    refused(&["fly", "--task", "hover", "--config", "no.toml"], 2, &["no.toml: No such file"]);
}

#[test]
fn the_hybrid_engine_computes_the_same_flight_as_mujoco() {
    for (task, physics) in [("hover", "mjc_gnd_drag_dw"), ("race", "mjc"), ("stabilize", "mjc"), ("track", "mjc_drag")]
    {
        let fly = |engine: &str| json(&["fly", "--task", task, "--physics", physics, "--engine", engine]);
        let (a, b) = (fly("mujoco"), fly("hybrid"));
        assert_eq!((&a["engine"], &b["engine"]), (&"mujoco".into(), &"hybrid".into()));
        assert_eq!((&a["success"], &b["success"]), (&true.into(), &true.into()), "{task}");
        for axis in 0..3 {
            let place = |flight: &Value| flight["drones"][0]["final_position"][axis].as_f64().unwrap();
            assert!((place(&a) - place(&b)).abs() < 1e-9, "{task}");
        }
        assert!((a["reward"].as_f64().unwrap() - b["reward"].as_f64().unwrap()).abs() < 1e-6);
    }
    refused(
        &["fly", "--task", "hover", "--engine", "hybird"],
        2,
        &["--engine", "mujoco, hybrid", "did you mean `hybrid`"],
    );
}

#[test]
fn the_json_of_the_benchmark_has_all_keys() {
    let bench = json(&["bench", "--quick"]);
    assert!(bench["machine"].is_string() && bench["threads"].as_u64().unwrap() > 0);
    let instructions = bench["instructions"].as_str().unwrap();
    let mj_step = bench["mj_step_per_second"].as_f64().unwrap();
    assert!(mj_step > 1e3);
    let rows = bench["rows"].as_array().unwrap();
    // the last rows of the kernel use the widest instruction set
    let kernel = rows.iter().rfind(|row| row["engine"] == "flight").unwrap();
    assert!(kernel["name"].as_str().unwrap().starts_with(&format!("kernel, {instructions},")), "{kernel}");
    for row in rows {
        for key in ["name", "engine", "task", "physics"] {
            assert!(row[key].is_string(), "{key}: {row}");
        }
        for key in ["environments", "drones", "threads", "bytes_per_environment"] {
            assert!(row[key].is_u64(), "{key}: {row}");
        }
        for key in ["env_steps_per_second", "physics_steps_per_second", "ratio_to_mj_step"] {
            assert!(row[key].as_f64().unwrap() >= 0.0, "{key}: {row}");
        }
        // medians of two measurements differ on a noisy machine
        let drones = row["drones"].as_f64().unwrap();
        let ratio = drones * row["physics_steps_per_second"].as_f64().unwrap() / mj_step;
        let got = row["ratio_to_mj_step"].as_f64().unwrap();
        assert!(got > 0.2 * ratio && got < 5.0 * ratio, "{row}");
    }
    let batch =
        |environments: u64| rows.iter().any(|row| row["environments"] == environments && row["task"] == "hover");
    assert!(batch(1) && batch(4096));
}

#[test]
fn every_output_file_has_the_permissions_of_the_umask() {
    use std::os::unix::fs::PermissionsExt as _;
    for (umask, mode) in [("077", 0o600), ("027", 0o640), ("022", 0o644)] {
        let dir = directory(&format!("umask_{umask}"));
        let status = Command::new("sh")
            .args(["-c", "umask $0; exec \"$@\"", umask, env!("CARGO_BIN_EXE_aviary")])
            .args(["fly", "--task", "hover", "--duration", "0.2", "--plot", "--out", text(&dir)])
            .output()
            .unwrap()
            .status;
        assert!(status.success());
        let files: Vec<_> = std::fs::read_dir(&dir).unwrap().flatten().collect();
        assert!(files.len() > 2, "{files:?}");
        for file in files {
            let permissions = file.metadata().unwrap().permissions().mode() & 0o777;
            assert_eq!(permissions, mode, "umask {umask}: {} has {permissions:o}", file.path().display());
        }
    }
}
