//! The program as other programs see it: output, files, errors, exit status.

use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;

mod common;

use common::{aviary, directory, has_gl, reference, refused, send, spawn, text, wait_for_rows};

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
    for name in ["drone0.csv", "summary.json"] {
        let read = |path: &PathBuf| std::fs::read(path.join(name)).unwrap();
        assert_eq!(read(&a), read(&b), "{name}");
    }
    let mut log = csv::Reader::from_path(a.join("drone0.csv")).unwrap();
    let rows: Vec<_> = log.records().map(Result::unwrap).collect();
    assert_eq!(rows.len(), 97, "the start and one row per control step");
    assert_eq!(&rows[96][0], "2.0");
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
    refused(&["fly", "--task", "hover", "--seed", "-1"], 2, &["--seed", "-1"]);
    refused(&["fly", "--task", "hover", "--camera", "front"], 2, &["--gif"]);
    refused(&["fly", "--task", "hover", "--drone", "cf2"], 2, &["did you mean `cf2x`?"]);
    refused(&["fly", "--task", "antipodal", "--num-drones", "17"], 2, &["--num-drones is 17, expected at most 16"]);
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
fn every_physics_mode_and_airframe_hovers() {
    for physics in ["mjc", "mjc_gnd", "mjc_drag", "mjc_dw", "mjc_gnd_drag_dw", "dyn"] {
        for drone in ["cf2x", "cf2p", "race"] {
            let output = aviary(&["fly", "--task", "hover", "--physics", physics, "--drone", drone, "--json"]);
            let flight: Value = serde_json::from_slice(&output.stdout).unwrap();
            assert_eq!((&flight["physics"], &flight["success"]), (&physics.into(), &true.into()), "{physics} {drone}");
        }
    }
    refused(&["fly", "--task", "hover", "--physics", "mjc_dg"], 2, &["--physics is `mjc_dg`", "did you mean"]);
}

#[test]
fn what_is_no_file_is_not_replaced_by_one_and_links_stay_links() {
    let dir = directory("special");
    std::fs::create_dir_all(&dir).unwrap();
    let (scenario, actions) = (reference("mjc_cf2x.toml"), reference("mjc_cf2x.actions.csv"));
    let replay =
        |out: &str| ["replay", "--scenario", &scenario, "--actions", &actions, "--out", out].map(str::to_string);
    let run = |out: &str| aviary(&replay(out).iter().map(String::as_str).collect::<Vec<_>>());
    assert_eq!(run(text(&dir)).status.code(), Some(1));
    assert_eq!(run("/dev/null").status.code(), Some(1));
    std::fs::write(dir.join("file"), "old").unwrap();
    std::os::unix::fs::symlink("file", dir.join("link")).unwrap();
    assert!(run(text(&dir.join("link"))).status.success());
    assert!(std::fs::symlink_metadata(dir.join("link")).unwrap().is_symlink());
    assert!(std::fs::read_to_string(dir.join("file")).unwrap().starts_with("t,drone"));
}

/// Two runs into one directory mixed their files, and both ended with status 0.
#[test]
fn a_directory_that_another_run_writes_to_is_refused() {
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
    assert_eq!(std::fs::read_dir(&dir).unwrap().count(), 2, "the log and the scenario: the lock is no file");
    assert!(aviary(&fly).status.success(), "whatever ended the other run");
}

#[test]
fn a_directory_that_can_be_written_to_and_not_read_takes_files() {
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
fn shells_are_told_commands_options_and_names() {
    for (shell, texts) in [
        ("bash", &["complete", "multi_hover", "--overlay", "geometric"][..]),
        ("zsh", &["#compdef aviary", "multi_hover", "mjc_gnd_drag_dw"]),
        ("fish", &["complete -c aviary", "fly_through"]),
    ] {
        let output = aviary(&["completions", shell]);
        assert!(output.status.success());
        let script = String::from_utf8(output.stdout).unwrap();
        for text in texts {
            assert!(script.contains(text), "{shell}: {text}");
        }
    }
    refused(&["completions", "fisch"], 2, &["fisch", "fish"]);
}

#[test]
fn nearest_names_are_suggested_everywhere() {
    let dir = directory("nearest");
    std::fs::create_dir_all(&dir).unwrap();
    let file = dir.join("conditions.toml");
    std::fs::write(&file, "[wind]\nmodle = \"gust\"\n").unwrap();
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

/// An airframe in wrong units flies: its derived numbers show it.
#[test]
fn airframes_are_checked_for_numbers_that_no_quadrotor_has() {
    for name in ["cf2x", "cf2p", "race"] {
        let output = aviary(&["airframe", name, "--json"]);
        let airframe: Value = serde_json::from_slice(&output.stdout).unwrap();
        assert_eq!((&airframe["name"], &airframe["plausible"]), (&name.into(), &true.into()));
        assert_eq!((&airframe["warnings"], &airframe["suspected_unit"]), (&Value::Array(vec![]), &Value::Null));
    }
    let table = String::from_utf8(aviary(&["airframe", "cf2x"]).stdout).unwrap();
    assert!(table.contains("14476 rpm") && table.contains("0.6667") && !table.contains("warning"), "{table}");

    let dir = directory("airframes-checked");
    std::fs::create_dir_all(&dir).unwrap();
    let path = dir.join("in_grams.toml");
    let crazyflie = include_str!("../../assets/airframes/cf2x.toml");
    std::fs::write(&path, crazyflie.replace("mass = 0.027", "mass = 1200")).unwrap();
    let output = aviary(&["airframe", text(&path)]);
    assert_eq!(output.status.code(), Some(0));
    let table = String::from_utf8(output.stdout).unwrap();
    assert!(table.lines().any(|line| line.starts_with("warning: ") && line.contains("check mass")), "{table}");
    std::fs::write(&path, crazyflie.replace("mass = 0.027", "mass = 27")).unwrap();
    let table = String::from_utf8(aviary(&["airframe", text(&path)]).stdout).unwrap();
    assert!(table.contains("every warning disappears with mass in grams (in kg it is 0.027)"), "{table}");
    // a flight with it goes on, and says so
    let fly = |drone: &str| {
        let output = aviary(&["fly", "--task", "hover", "--duration", "0.1", "--drone", drone]);
        String::from_utf8(output.stdout).unwrap()
    };
    assert!(fly(text(&path)).contains("implausible: see `aviary airframe`"));
    let table = fly("cf2x");
    assert!(table.contains("hover speed") && table.contains("14476 rpm, 67 % of the largest"), "{table}");
    assert!(!table.contains("implausible"), "{table}");

    refused(&["airframe", "cf2xx"], 2, &["the airframe is `cf2xx`", "did you mean `cf2x`", ".toml"]);
    refused(&["airframe", "no.toml"], 2, &["no.toml: No such file"]);
    std::fs::write(&path, crazyflie.replace("mass = 0.027", "mass = \"27 g\"")).unwrap();
    refused(&["airframe", text(&path)], 2, &["in_grams.toml", "line 3"]);
}

/// ffmpeg is optional: its absence is reported with the command that installs it, and is no failure.
#[test]
fn doctor_reports_whether_there_is_an_ffmpeg() {
    let dir = directory("no-ffmpeg");
    std::fs::create_dir_all(&dir).unwrap();
    let run = |arguments: &[&str], fake: Option<&str>| {
        if let Some(text) = fake {
            use std::os::unix::fs::PermissionsExt as _;
            let path = dir.join("ffmpeg");
            std::fs::write(&path, text).unwrap();
            std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o755)).unwrap();
        }
        let output = Command::new(env!("CARGO_BIN_EXE_aviary")).args(arguments).env("PATH", &dir).output().unwrap();
        (output.status.code(), String::from_utf8(output.stdout).unwrap())
    };
    let works = if has_gl() { Some(0) } else { Some(1) };
    let (status, table) = run(&["doctor"], None);
    assert_eq!(status, works, "{table}");
    assert_eq!(table.matches("apt-get install ffmpeg").count(), 1, "{table}");
    let (status, doctor) = run(&["doctor", "--json"], None);
    let doctor: Value = serde_json::from_str(&doctor).unwrap();
    assert_eq!((status, &doctor["ffmpeg"]["works"]), (works, &false.into()));
    let fake = "#!/bin/sh\necho 'ffmpeg version 5.1.6-0+deb12u1 Copyright (c) 2000-2024'\n";
    let (_, table) = run(&["doctor"], Some(fake));
    assert!(table.contains("works (5.1.6-0+deb12u1)") && !table.contains("install ffmpeg"), "{table}");
}

/// `./setup` of a user who is not root, on a machine without sudo, without the packages, without Rust and without curl.
#[test]
fn setup_names_everything_that_is_missing_at_once() {
    use std::os::unix::fs::{PermissionsExt as _, symlink};
    let dir = directory("bare-machine");
    std::fs::create_dir_all(dir.join("home")).unwrap();
    for tool in ["dirname", "sed", "cut", "sort", "head", "env"] {
        let path = ["/usr/bin", "/bin"].map(|at| Path::new(at).join(tool)).into_iter().find(|path| path.exists());
        symlink(path.unwrap(), dir.join(tool)).unwrap();
    }
    for (name, text) in [("id", "echo 1000"), ("dpkg-query", "exit 1")] {
        std::fs::write(dir.join(name), format!("#!/bin/sh\n{text}\n")).unwrap();
        std::fs::set_permissions(dir.join(name), std::fs::Permissions::from_mode(0o755)).unwrap();
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
fn tasks_and_doctor_answer_in_json_and_as_tables() {
    let tasks: Value = serde_json::from_slice(&aviary(&["tasks", "--json"]).stdout).unwrap();
    let numbers = |task: usize| {
        ["drones", "episode_seconds", "observation_size", "action_size"].map(|key| tasks[task][key].as_f64().unwrap())
    };
    assert_eq!((&tasks[0]["name"], numbers(0)), (&"hover".into(), [1.0, 10.0, 12.0, 4.0]));
    assert_eq!((&tasks[6]["name"], numbers(6)), (&"multi_agent".into(), [3.0, 10.0, 13.0, 4.0]));
    assert!(String::from_utf8(aviary(&["tasks"]).stdout).unwrap().contains("hover"));
    let output = aviary(&["doctor", "--json"]);
    let doctor: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert!(doctor["mujoco_version"].as_str().unwrap().starts_with("2.2."));
    let backends: Vec<_> = doctor["gl"].as_array().unwrap().iter().map(|answer| &answer["backend"]).collect();
    assert_eq!(backends, ["egl", "osmesa"]);
    assert_eq!(doctor["ok"], output.status.success());
    assert!(String::from_utf8(aviary(&["doctor"]).stdout).unwrap().contains("MuJoCo"));
}

#[test]
fn help_and_version_are_no_errors() {
    for arguments in [&["--help"][..], &["fly", "--help"], &["--version"]] {
        let output = aviary(arguments);
        assert!(output.status.success() && output.stderr.is_empty() && !output.stdout.is_empty());
    }
    for command in ["fly", "capture", "render", "replay", "bench", "tasks", "airframe", "doctor", "completions"] {
        let help = String::from_utf8(aviary(&[command, "--help"]).stdout).unwrap();
        assert!(help.contains("Example"), "{command}");
    }
    assert!(String::from_utf8(aviary(&["--help"]).stdout).unwrap().contains("Examples:"));
}

#[test]
fn trajectories_are_followed_by_every_controller_and_the_geometric_one_loops() {
    for (trajectory, controller, drone, within) in [
        ("circle", "geometric", "cf2x", 0.012),
        ("circle", "dsl", "cf2p", 0.03),
        ("helix", "geometric", "race", 0.005),
        ("loop", "geometric", "race", 0.02),
        ("square", "pid", "cf2x", 1.2),
    ] {
        let options =
            ["fly", "--task", "hover", "--trajectory", trajectory, "--controller", controller, "--drone", drone];
        let output = aviary(&[&options[..], &["--json"]].concat());
        assert_eq!(output.status.code(), Some(0), "{trajectory}");
        let flight: Value = serde_json::from_slice(&output.stdout).unwrap();
        assert_eq!((&flight["controller"], &flight["trajectory"]), (&controller.into(), &trajectory.into()));
        assert!(flight["peak_position_error"].as_f64().unwrap() < within, "{trajectory}: {flight}");
        assert_eq!(flight["success"], trajectory != "square", "{trajectory}: {flight}");
    }
}

#[test]
fn trajectory_files_are_followed_or_refused_by_file_line_and_key() {
    let directory = directory("trajectories");
    std::fs::create_dir_all(&directory).unwrap();
    let path = directory.join("way.toml");
    let write = |text: &str| std::fs::write(&path, text).unwrap();
    let fly = ["fly", "--task", "hover", "--controller", "geometric", "--trajectory", text(&path)];
    write("kind = \"waypoints\"\npoints = [[0, 0, 1], [1, 0, 1], [1, 1, 4]]\nyaws = [0, 1, 2]\n");
    let output = aviary(&[&fly[..], &["--json"]].concat());
    let flight: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(flight["success"], true);
    assert!((flight["drones"][0]["final_position"][2].as_f64().unwrap() - 4.0).abs() < 0.01, "above the task's limit");
    write("kind = \"circle\"\nradius = 0.5\nspeed = 1.0\n");
    refused(&fly, 2, &["way.toml", "line 3", "speed"]);
    write("kind = \"circle\"\nradius = 0.5\nperiod = 0.0\n");
    refused(&fly, 2, &["way.toml", "period"]);
    refused(&["fly", "--task", "hover", "--trajectory", "circel"], 2, &["did you mean `circle`"]);
    refused(&["fly", "--task", "hover", "--trajectory", "no.toml"], 2, &["no.toml: No such file"]);
}

#[test]
fn every_task_is_flown_to_success() {
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
        let output = aviary(&["fly", "--task", task, "--drone", drone, "--seed", "5", "--json"]);
        assert_eq!(output.status.code(), Some(0), "{task}");
        let flight: Value = serde_json::from_slice(&output.stdout).unwrap();
        assert_eq!(
            (&flight["success"], &flight["progress"]),
            (&true.into(), &1.0.into()),
            "{task} with {drone}: {flight}"
        );
        assert!(flight["simulated_seconds"].as_f64().unwrap() <= seconds, "{task} with {drone}");
        assert!(flight["drones"].as_array().unwrap().iter().all(|drone| drone["crashed"] == false));
    }
    let output = aviary(&["fly", "--task", "multi_hover", "--num-drones", "8", "--json"]);
    let flight: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!((&flight["success"], flight["drones"].as_array().unwrap().len()), (&true.into(), 8));
    let output = aviary(&["fly", "--task", "antipodal", "--physics", "mjc_gnd_drag_dw", "--json"]);
    let flight: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(flight["success"], true, "{flight}");
    assert!(flight["info"]["minimum_distance"].as_f64().unwrap() > 0.3);
    refused(&["fly", "--task", "race", "--trajectory", "circle"], 2, &["--trajectory goes with --task hover"]);
    refused(&["fly", "--task", "hover", "--num-drones", "2"], 2, &["--num-drones is 2, expected 1 in hover"]);
    refused(&["fly", "--task", "flythrough"], 2, &["did you mean `fly_through`"]);
}

#[test]
fn wind_obstacles_and_randomization_are_flown_from_options_and_files() {
    let fly = |more: &[&str]| {
        let output = aviary(&[&["fly", "--task", "hover", "--controller", "geometric", "--json"][..], more].concat());
        let error = String::from_utf8(output.stderr).unwrap();
        (serde_json::from_slice::<Value>(&output.stdout).unwrap_or_else(|_| panic!("{more:?}: {error}")), output.status)
    };
    let (still, _) = fly(&[]);
    for wind in ["constant", "gust", "dryden", "sinusoidal", "combined"] {
        let (flight, status) = fly(&["--wind", wind, "--seed", "3"]);
        assert!(status.success() && flight["wind"] == wind, "{flight}");
        assert_ne!(flight["final_position_error"], still["final_position_error"], "{wind}");
        assert_eq!(fly(&["--wind", wind, "--seed", "3"]).0["reward"], flight["reward"]);
    }
    for (kind, parts) in [("forest", 20), ("urban", 8), ("indoor", 14), ("random", 8), ("gates", 16)] {
        let (flight, status) = fly(&["--obstacles", kind, "--duration", "1"]);
        assert!(status.success() && flight["obstacles"] == parts, "{kind}: {flight}");
    }
    let directory = directory("conditions");
    std::fs::create_dir_all(&directory).unwrap();
    let path = directory.join("conditions.toml");
    let write = |text: &str| std::fs::write(&path, text).unwrap();
    write(
        "[wind]\nmodel = \"constant\"\nvelocity = [2, 0, 0]\n[obstacles]\nkind = \"custom\"\n[[obstacles.custom]]\n\
         shape = \"box\"\nsize = [0.1, 0.1, 1]\nposition = [1, 0, 1]\n[randomization.body]\nmass = [1.1, 1.1]\n",
    );
    let (flight, _) = fly(&["--config", text(&path)]);
    assert_eq!((&flight["wind"], &flight["obstacles"]), (&"constant".into(), &1.into()));
    assert_eq!(flight["info"]["drawn_mass"], 1.1);
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
        &["1 sizes"],
    );
    refuse("[randomization.body]\nmass = [2, 1]\n", &["body.mass"]);
    refused(&["fly", "--task", "hover", "--wind", "combine"], 2, &["did you mean `combined`"]);
    refused(&["fly", "--task", "hover", "--obstacles", "forrest"], 2, &["did you mean `forest`"]);
    refused(&["fly", "--task", "hover", "--config", "no.toml"], 2, &["no.toml: No such file"]);
}

#[test]
fn the_hybrid_engine_flies_the_same_flight() {
    for (task, physics) in [("hover", "mjc_gnd_drag_dw"), ("race", "mjc"), ("stabilize", "mjc"), ("track", "mjc_drag")]
    {
        let fly = |engine: &str| -> Value {
            let output = aviary(&["fly", "--task", task, "--physics", physics, "--engine", engine, "--json"]);
            assert_eq!(output.status.code(), Some(0));
            serde_json::from_slice(&output.stdout).unwrap()
        };
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
fn the_benchmark_says_what_other_programs_read() {
    let output = aviary(&["bench", "--quick", "--json"]);
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    let bench: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert!(bench["machine"].is_string() && bench["threads"].as_u64().unwrap() > 0);
    let mj_step = bench["mj_step_per_second"].as_f64().unwrap();
    assert!(mj_step > 1e3);
    let rows = bench["rows"].as_array().unwrap();
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
        // the ratio is what its name says, as far as a noisy machine lets the medians of two things be one
        let drones = row["drones"].as_f64().unwrap();
        let ratio = drones * row["physics_steps_per_second"].as_f64().unwrap() / mj_step;
        let got = row["ratio_to_mj_step"].as_f64().unwrap();
        assert!(got > 0.2 * ratio && got < 5.0 * ratio, "{row}");
    }
    let batch =
        |environments: u64| rows.iter().any(|row| row["environments"] == environments && row["task"] == "hover");
    assert!(batch(1) && batch(4096));
}

/// Logs had mode 0600 and all other files 0644, whatever the umask was.
#[test]
fn every_output_file_has_the_permissions_that_the_umask_leaves() {
    use std::os::unix::fs::PermissionsExt as _;
    for (umask, mode) in [("077", 0o600), ("027", 0o640), ("022", 0o644)] {
        let dir = directory(&format!("umask_{umask}"));
        let status = std::process::Command::new("sh")
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
