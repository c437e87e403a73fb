//! Files that commands write and read: logs, scenarios, datasets, encodings, and errors about their content.

use std::path::Path;
use std::process::{Command, Stdio};

use aviary::env::{Conditions, DroneEnv, Env, EnvConfig};
use aviary::record::{Flight, STATE_COLUMNS, images};
use aviary::tasks;
use aviary::vision::{ImageSize, SceneRenderer};
use serde_json::Value;

mod common;

use common::{Running, aviary, directory, has_gl, json, reference, refused, run, send, text, wait_while, write};

/// Asserts that a replay has the states and motor speeds of the flight.
fn assert_same_flight(flight: &Flight, again: &Flight, what: &str) {
    assert_eq!(flight.drones.len(), again.drones.len(), "{what}");
    for (drone, again) in flight.drones.iter().zip(&again.drones) {
        assert_eq!(drone.len(), again.len() + 1, "{what}: a replay has no row of the initial state");
        for (sample, again) in drone[1..].iter().zip(again) {
            assert_eq!((sample.time, sample.state), (again.time, again.state), "{what}");
            assert_eq!(sample.motor_speeds, again.motor_speeds, "{what}");
        }
    }
}

#[test]
fn the_replay_of_a_log_is_bit_exact() {
    let dir = directory("again");
    let heavy = include_str!("../../assets/airframes/cf2x.toml").replace("mass = 0.027", "mass = 0.031");
    let heavy = write(&dir.join("heavy.toml"), &heavy.replace("\"cf2x\"", "\"heavy\""));
    let sampled = "[randomization.body]\n[randomization.aerodynamics]\n[randomization.actuators]\n\
         [randomization.environment]\n[randomization.initial]\n[obstacles]\nkind = \"forest\"\nnew_layout = true\n";
    let sampled = write(&dir.join("sampled.toml"), sampled);
    for (name, options) in [
        ("hover", &["--task", "hover"][..]),
        ("race", &["--task", "race", "--drone", "race", "--engine", "hybrid", "--duration", "4"]),
        ("wind", &["--task", "multi_hover", "--wind", "combined", "--physics", "mjc_gnd_drag_dw", "--seed", "3"]),
        ("start", &["--task", "stabilize", "--seed", "9", "--sim-freq", "500", "--ctrl-freq", "100"]),
        ("dyn", &["--task", "hover", "--physics", "dyn", "--drone", "cf2p", "--trajectory", "circle"]),
        ("airframe", &["--task", "hover", "--drone", text(&heavy), "--obstacles", "forest"]),
        ("sampled", &["--task", "hover", "--controller", "geometric", "--config", text(&sampled), "--seed", "4"]),
    ] {
        let out = dir.join(name);
        let duration = if options.contains(&"--duration") { &[][..] } else { &["--duration", "2"] };
        // the log of a crash can be replayed as well
        aviary(&[&["fly", "--out", text(&out)], options, duration].concat());
        let (scenario, again) = (out.join("scenario.toml"), dir.join(format!("{name}.csv")));
        let replay = ["replay", "--scenario", text(&scenario), "--out", text(&again), "--actions"];
        let printed = run(&[&replay[..], &[text(&out)]].concat());
        assert!(printed.ends_with(&format!("wrote {}\n", again.display())), "{printed}");
        let (flight, flown) = (Flight::read(&out).unwrap(), Flight::read(&again).unwrap());
        assert!(flight.drones[0].len() > 90, "{name}");
        assert_same_flight(&flight, &flown, name);

        // the files of the drones in any order, and the output of the replay
        let mut files: Vec<_> = aviary::record::files(&out).iter().map(|path| text(path).to_string()).collect();
        files.reverse();
        let once = std::fs::read(&again).unwrap();
        run(&[&replay[..], &files.iter().map(String::as_str).collect::<Vec<_>>()].concat());
        assert!(std::fs::read(&again).unwrap() == once, "{name}");
        let third = dir.join("third.csv");
        run(&["replay", "--scenario", text(&scenario), "--out", text(&third), "--actions", text(&again)]);
        assert!(std::fs::read(&third).unwrap() == once, "{name}");
    }
}

/// Gates move with the time of the episode and are drawn at its start. The scenario and the directory of a flight have
/// both.
#[test]
fn replays_move_the_obstacles_of_the_flight() {
    let dir = directory("moving");
    let track = "solid = true\n[randomization]\nposition = 0.1\nyaw = 0.2\n[motion]\namplitude = 0.15\nperiod = 2.0\n\
                 [[gates]]\nposition = [1.0, 0.0, 1.0]\n[[gates]]\nposition = [1.0, 2.0, 1.2]\n\
                 [[gates]]\nposition = [-1.0, 2.0, 1.2]\n[[gates]]\nposition = [-1.0, 0.0, 1.0]\n";
    let track = write(&dir.join("moving.toml"), track);
    // PID flies into a gate
    let mut ends = Vec::new();
    for (seed, engine) in [("1", "mujoco"), ("2", "hybrid"), ("3", "hybrid"), ("4", "hybrid")] {
        for controller in ["geometric", "pid"] {
            let out = dir.join(format!("{controller}{seed}"));
            let fly =
                ["fly", "--task", "race", "--track", text(&track), "--controller", controller, "--engine", engine];
            aviary(&[&fly[..], &["--seed", seed, "--out", text(&out)]].concat());
            let summary: Value = serde_json::from_slice(&std::fs::read(out.join("summary.json")).unwrap()).unwrap();
            ends.push(summary["end"].to_string());
            let (scenario, again) = (out.join("scenario.toml"), dir.join("again.csv"));
            let replay = ["replay", "--scenario", text(&scenario), "--out", text(&again), "--actions"];
            run(&[&replay[..], &[text(&out)]].concat());
            let (flight, flown) = (Flight::read(&out).unwrap(), Flight::read(&again).unwrap());
            assert!(flight.drones[0].len() > 40, "{controller} {seed}");
            assert_same_flight(&flight, &flown, controller);

            let rows = aviary::record::read_obstacle_poses(&out).unwrap();
            // 16 bars, of which all move in every step
            assert_eq!(rows.len(), 16 * (flight.drones[0].len() - 1), "{controller} {seed}");
            let wanted = "moving obstacles, expected the flight's directory with obstacles.csv";
            refused(&[&replay[..], &[text(&again)]].concat(), 2, &[wanted]);
            let poses = out.join("obstacles.csv");
            let good = std::fs::read_to_string(&poses).unwrap();
            for (from, to, wanted) in [
                (",0,", ",99,", "obstacle 99, expected one of the moving obstacles 0 to 15"),
                ("t,obstacle", "time,obstacle", "line 1: columns time,obstacle"),
                (",0,", ",0,x", "line 2"),
            ] {
                std::fs::write(&poses, good.replacen(from, to, 1)).unwrap();
                refused(&[&replay[..], &[text(&out)]].concat(), 2, &[wanted]);
            }
            std::fs::remove_file(&poses).unwrap();
            refused(&[&replay[..], &[text(&out)]].concat(), 2, &["obstacles.csv"]);
        }
    }
    ends.sort();
    ends.dedup();
    assert!(ends.len() > 1, "contacts with a moving gate are among the flights: {ends:?}");
}

/// Returns the log of a flight in the format of an earlier version of the program.
fn earlier(log: &str) -> String {
    let names = [
        ("x_ref", "x_ref_m"),
        ("y_ref", "y_ref_m"),
        ("z_ref", "z_ref_m"),
        ("yaw_ref", "yaw_ref_rad"),
        ("t", "t_s"),
        ("x", "x_m"),
        ("y", "y_m"),
        ("z", "z_m"),
        ("vx", "vx_m_s"),
        ("vy", "vy_m_s"),
        ("vz", "vz_m_s"),
        ("wx", "wx_rad_s"),
        ("wy", "wy_rad_s"),
        ("wz", "wz_rad_s"),
        ("roll", "roll_rad"),
        ("pitch", "pitch_rad"),
        ("yaw", "yaw_rad"),
        ("ax", "ax_m_s2"),
        ("ay", "ay_m_s2"),
        ("az", "az_m_s2"),
        ("rpm0", "motor0_rpm"),
        ("rpm1", "motor1_rpm"),
        ("rpm2", "motor2_rpm"),
        ("rpm3", "motor3_rpm"),
    ];
    let order = "t_s,x_m,y_m,z_m,qw,qx,qy,qz,roll_rad,pitch_rad,yaw_rad,vx_m_s,vy_m_s,vz_m_s,wx_rad_s,wy_rad_s,\
         wz_rad_s,ax_m_s2,ay_m_s2,az_m_s2,motor0_rpm,motor1_rpm,motor2_rpm,motor3_rpm,reward,x_ref_m,y_ref_m,z_ref_m,\
         yaw_ref_rad";
    let mut lines = log.lines();
    let header: Vec<_> = (lines.next().unwrap().split(','))
        .map(|now| names.iter().find(|(name, _)| *name == now).map_or(now, |(_, earlier)| earlier))
        .collect();
    let places: Vec<_> =
        order.split(',').map(|name| header.iter().position(|column| *column == name).unwrap()).collect();
    let mut text = format!("{order}\n");
    for line in lines {
        let cells: Vec<_> = line.split(',').collect();
        text += &places.iter().map(|&place| cells[place]).collect::<Vec<_>>().join(",");
        text.push('\n');
    }
    text
}

#[test]
fn logs_of_earlier_versions_can_be_read_and_replayed() {
    let dir = directory("earlier-logs");
    let (now, before) = (dir.join("now"), dir.join("before"));
    run(&["fly", "--task", "multi_hover", "--duration", "0.5", "--out", text(&now)]);
    for drone in ["drone0.csv", "drone1.csv"] {
        // some editors write a byte-order mark
        let log = earlier(&std::fs::read_to_string(now.join(drone)).unwrap());
        write(&before.join(drone), &format!("\u{feff}{log}"));
    }
    assert_eq!(Flight::read(&before).unwrap(), Flight::read(&now).unwrap());
    let scenario = now.join("scenario.toml");
    let replay = |actions: &[&str], out: &str| {
        let out = dir.join(out);
        run(&[&["replay", "--scenario", text(&scenario), "--out", text(&out), "--actions"], actions].concat());
        std::fs::read(out).unwrap()
    };
    let same = replay(&[text(&now)], "now.csv");
    assert!(replay(&[text(&before)], "before.csv") == same);
    // the files of an earlier version have no index of the drone: their order counts
    let files = ["drone0.csv", "drone1.csv"].map(|name| before.join(name));
    assert!(replay(&[text(&files[0]), text(&files[1])], "files.csv") == same);
}

#[test]
fn errors_about_logs_of_other_scenarios_name_file_and_line() {
    let dir = directory("misfits");
    let out = dir.join("flight");
    run(&["fly", "--task", "hover", "--duration", "0.5", "--out", text(&out)]);
    let good = std::fs::read_to_string(out.join("scenario.toml")).unwrap();
    let scenario = |name: &str, from: &str, to: &str| {
        assert!(good.contains(from), "{good}");
        write(&dir.join(name), &good.replace(from, to))
    };
    let refuse = |scenario: &Path, actions: &Path, texts: &[&str]| {
        let again = dir.join("again.csv");
        let arguments = ["replay", "--scenario", text(scenario), "--actions", text(actions), "--out", text(&again)];
        refused(&arguments, 2, texts);
        assert!(!again.exists());
    };
    let slow = scenario("slow.toml", "ctrl_freq = 48", "ctrl_freq = 24");
    refuse(&slow, &out, &["drone0.csv: line 3", "t is 0.0208", "expected 0.0416", "24 Hz"]);
    let two = good.replace("num_drones = 1", "num_drones = 2");
    let two = two.replace("initial_xyzs = [[0.0, 0.0, 0.1]]", "initial_xyzs = [[0.0, 0.0, 0.1], [1.0, 0.0, 0.1]]");
    let two = two.replace("initial_rpys = [[0.0, 0.0, 0.0]]", "initial_rpys = [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]");
    refuse(&write(&dir.join("two.toml"), &two), &out, &["the log has 1 drone", "expected 2 drones"]);
    let states = write(&dir.join("states.csv"), &format!("{}\n0.5{}\n", STATE_COLUMNS.join(","), ",0".repeat(14)));
    refuse(&out.join("scenario.toml"), &states, &["states.csv: line 2", "t is 0.5"]);
    let states =
        write(&dir.join("s.csv"), &format!("{}\n{}{}\n", STATE_COLUMNS.join(","), 1.0 / 48.0, ",0".repeat(14)));
    refuse(&out.join("scenario.toml"), &states, &["s.csv: line 2", "no columns `rpm0` to `rpm3`"]);
    let seed = scenario("seed.toml", "ctrl_freq = 48", "ctrl_freq = 48\nwind_seed = \"-1\"");
    refuse(&seed, &out, &["seed.toml: line 6", "expected a whole number"]);
    let engine = scenario("engine.toml", "engine = \"mujoco\"", "engine = \"hybrid\"");
    let engine = write(&engine, &std::fs::read_to_string(&engine).unwrap().replace("\"mjc\"", "\"dyn\""));
    refuse(&engine, &out, &["engine.toml: line", "engine", "hybrid", "dyn"]);
}

/// Some editors write a byte-order mark.
#[test]
fn every_text_file_may_begin_with_a_byte_order_mark() {
    let dir = directory("marks");
    let marked = |name: &str, text: &str| write(&dir.join(name), &format!("\u{feff}{text}"));
    let airframe = marked("quad.toml", include_str!("../../assets/airframes/cf2x.toml"));
    let config = marked("config.toml", "[wind]\nmodel = \"constant\"\n");
    let circle = marked("circle.toml", "kind = \"circle\"\nradius = 0.3\nperiod = 6.0\n");
    let fly = ["fly", "--task", "hover", "--duration", "0.5", "--drone", text(&airframe), "--config", text(&config)];
    let out = dir.join("out");
    run(&[&fly[..], &["--trajectory", text(&circle), "--out", text(&out)]].concat());
    for name in ["scenario.toml", "drone0.csv"] {
        let written = std::fs::read_to_string(out.join(name)).unwrap();
        marked(&format!("out/{name}"), &written);
    }
    Flight::read(&out).unwrap();
    let again = dir.join("again.csv");
    let scenario = out.join("scenario.toml");
    run(&["replay", "--scenario", text(&scenario), "--actions", text(&out), "--out", text(&again)]);
    let actions = marked("actions.csv", "drone0_rpm0,drone0_rpm1,drone0_rpm2,drone0_rpm3\n1,2,3,4\n");
    run(&["replay", "--scenario", text(&scenario), "--actions", text(&actions), "--out", text(&again)]);
    let training = marked("training.toml", "steps = 1000\n");
    run(&["train", "--task", "hover", "--config", text(&training), "--show"]);
    // the column is that of an editor
    let wrong = marked("wrong.toml", "wnd = 1\n");
    refused(&["fly", "--task", "hover", "--config", text(&wrong)], 2, &["line 1, column 1", "wnd"]);
}

#[test]
fn errors_about_numbers_do_not_name_types_of_rust() {
    for (option, value, expected) in [
        ("--duration", "long", "expected a number"),
        ("--duration", "", "expected a number"),
        ("--sim-freq", "fast", "expected a whole number"),
        ("--sim-freq", "240.5", "expected a whole number"),
        ("--ctrl-freq", "-5", "expected a whole number from 0 to 4294967295"),
        ("--seed", "1e3", "expected a whole number, zero or positive"),
        ("--seed", "99999999999999999999", "expected a smaller whole number"),
        ("--sim-freq", "99999999999999999999", "expected a smaller whole number"),
        ("--num-drones", "two", "expected a whole number, zero or positive"),
    ] {
        let error = format!("{option} is `{value}`, {expected}");
        refused(&["fly", "--task", "hover", option, value], 2, &[&error]);
    }
    let dir = directory("numbers");
    for (content, expected) in [
        ("[obstacles]\ncount = \"many\"\n", "expected a whole number, zero or positive"),
        ("[obstacles]\ncount = -3\n", "expected a whole number, zero or positive"),
        ("[wind]\nturbulence = \"high\"\n", "expected a number"),
        ("wind = 3\n", "expected a section"),
    ] {
        let config = write(&dir.join("config.toml"), content);
        let output = aviary(&["fly", "--task", "hover", "--config", text(&config)]);
        let error = String::from_utf8(output.stderr).unwrap();
        assert!(output.status.code() == Some(2) && error.contains(expected), "{content}: {error}");
        for word in ["f64", "usize", "u64", "struct"] {
            assert!(!error.contains(word), "{content}: {error}");
        }
    }
}

#[test]
fn a_full_standard_output_has_status_1_and_a_closed_pipe_status_0() {
    for arguments in [&["--help"][..], &["--version"], &["fly", "--help"], &["tasks"], &["completions", "bash"]] {
        let full = std::fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
        let output = Command::new(env!("CARGO_BIN_EXE_aviary")).args(arguments).stdout(full).output().unwrap();
        let error = String::from_utf8(output.stderr).unwrap();
        assert_eq!((output.status.code(), error.lines().count()), (Some(1), 1), "{arguments:?}: {error}");
        assert!(error.contains("standard output"), "{error}");
        let (reader, writer) = std::io::pipe().unwrap();
        drop(reader);
        let closed = Command::new(env!("CARGO_BIN_EXE_aviary")).args(arguments).stdout(writer).output().unwrap();
        assert!(closed.status.success() && closed.stderr.is_empty(), "{arguments:?}");
    }
}

#[test]
fn tables_have_units_whole_counts_and_no_negative_zeros() {
    let row = |task: &[&str], label: &str| {
        let table = run(&[&["fly"], task].concat());
        let row = table.lines().find_map(|line| line.strip_prefix(label)).unwrap_or_else(|| panic!("{label}: {table}"));
        row.trim().to_string()
    };
    assert_eq!(row(&["--task", "race", "--drone", "race"], "gates passed"), "12");
    assert_eq!(row(&["--task", "fly_through"], "waypoints captured"), "5");
    for (task, label, unit) in [
        ("antipodal", "minimum distance", " m"),
        ("formation", "mean formation error", " m"),
        ("track", "tracking error", " m"),
        ("velocity", "velocity error", " m/s"),
        ("stabilize", "body rate", " rad/s"),
    ] {
        assert!(row(&["--task", task, "--duration", "1"], label).ends_with(unit), "{task}");
    }
    let dir = directory("zeros");
    run(&["fly", "--task", "hover", "--duration", "1", "--out", text(&dir)]);
    let again = dir.join("again.csv");
    let scenario = dir.join("scenario.toml");
    run(&["replay", "--scenario", text(&scenario), "--actions", text(&dir), "--out", text(&again)]);
    for path in [dir.join("drone0.csv"), again, dir.join("summary.json")] {
        let text = std::fs::read_to_string(path).unwrap();
        let zero = |cell: &str| cell.starts_with('-') && cell.parse().is_ok_and(|x: f64| x == 0.0);
        assert!(!text.split([',', '\n', ' ']).any(zero));
    }
}

/// A trajectory replaces the target of hover, 1 m.
#[test]
fn the_reward_of_a_trajectory_refers_to_the_trajectory() {
    let dir = directory("trajectory-reward");
    let fly = |trajectory: &str| {
        let arguments = ["fly", "--task", "hover", "--trajectory", trajectory, "--duration", "2", "--out", text(&dir)];
        let flight = json(&arguments);
        let logged: f64 = Flight::read(&dir).unwrap().drones[0].iter().map(|sample| sample.reward).sum();
        assert!((flight["reward"].as_f64().unwrap() - logged).abs() < 1e-9);
        flight
    };
    // the trajectory is a point 5 m above the target of the task; the reward of a drone at its target is 0.5 per step
    let high = write(&dir.join("high.toml"), "kind = \"steps\"\nstart = [0, 0, 6]\npoints = [[0, 0, 6]]\nhold = 2.0\n");
    let flight = fly(text(&high));
    assert!((flight["reward"].as_f64().unwrap() - 0.5 * 96.0).abs() < 0.5, "{flight}");
    assert_eq!((&flight["success"], &flight["progress"]), (&true.into(), &1.0.into()));
}

#[test]
fn the_hybrid_engine_contradicts_the_dyn_mode() {
    let fly = ["fly", "--task", "hover", "--physics", "dyn"];
    refused(&[&fly[..], &["--engine", "hybrid"]].concat(), 2, &["hybrid", "dyn"]);
    assert_eq!(json(&fly)["engine"], "explicit");
}

#[test]
fn the_earlier_option_frames_names_the_option_png() {
    let dir = directory("png-frames");
    refused(&["fly", "--task", "hover", "--frames", text(&dir)], 2, &["--frames", "expected --png"]);
    assert!(!dir.exists());
}

#[test]
fn commands_print_the_files_that_they_write() {
    let dir = directory("named");
    let (scenario, actions) = (reference("mjc_cf2x.toml"), reference("mjc_cf2x.actions.csv"));
    let out = dir.join("flight.csv");
    let replay = ["replay", "--scenario", &scenario, "--actions", &actions, "--out", text(&out)];
    assert!(run(&replay).contains(&format!("wrote {}", out.display())));
    let flight = json(&replay);
    assert_eq!(flight["files"][0], text(&out));
    let rows = Flight::read(&out).unwrap().drones[0].len();
    assert_eq!(flight["control_steps"], rows);
    if !has_gl() {
        return;
    }
    let out = dir.join("hover.png");
    let render = ["render", "--task", "hover", "--size", "40x30", "--out", text(&out)];
    assert_eq!(run(&render), format!("wrote {}\n", out.display()));
    assert_eq!(json(&render)["files"][0], text(&out));
}

/// Without variation, every episode of a dataset ends in the same tree.
#[test]
fn episodes_of_a_dataset_differ_unless_vary_is_none() {
    if !has_gl() {
        return;
    }
    let dir = directory("varied");
    let capture = |name: &str, more: &[&str]| {
        let out = dir.join(name);
        let arguments =
            ["capture", "--task", "fly_through", "--obstacles", "forest", "--every", "8", "--size", "16x12"];
        json(&[&arguments[..], &["--frames", "60", "--out", text(&out)], more].concat())
    };
    let number = |summary: &Value, key: &str| summary[key].as_u64().unwrap();
    let varied = capture("a", &[]);
    assert!(number(&varied, "episodes") > 2, "{varied}");
    assert_eq!(varied["distinct_episodes"], varied["episodes"], "{varied}");
    assert!(number(&varied, "distinct_images") > 50, "{varied}");
    let equal = capture("equal", &["--vary", "none"]);
    assert!(number(&equal, "episodes") > 2 && number(&equal, "distinct_episodes") == 1, "{equal}");
    assert!(number(&equal, "distinct_images") < 30 && number(&equal, "crashes") > 1, "{equal}");
    // equal seeds give equal files, different seeds different files
    capture("b", &[]);
    capture("c", &["--seed", "1"]);
    let bytes = |name: &str, file: &str| std::fs::read(dir.join(name).join(file)).unwrap();
    for file in ["frames.csv", "rgb/000059_0.png", "depth/000059_0.png", "segmentation.json"] {
        assert!(bytes("a", file) == bytes("b", file), "{file}");
    }
    assert!(bytes("a", "frames.csv") != bytes("c", "frames.csv"));
    let refuse = |task: &str, vary: &str, texts: &[&str]| {
        refused(&["capture", "--task", task, "--frames", "1", "--vary", vary, "--out", "x"], 2, texts);
    };
    refuse("hover", "al", &["`all`", "starts"]);
    refuse("hover", "layouts", &["expected --obstacles or [obstacles]"]);
    refuse("antipodal", "starts", &["antipodal", "start"]);
}

/// Three parts of a dataset of several episodes and drones contain together the files and rows of one run.
#[test]
fn the_parts_of_a_dataset_are_together_bit_identical_to_one_run() {
    if !has_gl() {
        return;
    }
    let dir = directory("shards");
    let capture = |name: &str, more: &[&str]| {
        let out = dir.join(name);
        let arguments =
            ["capture", "--task", "multi_hover", "--obstacles", "forest", "--every", "7", "--size", "16x12"];
        let rest = ["--frames", "20", "--duration", "0.9", "--seed", "3", "--out", text(&out)];
        json(&[&arguments[..], &rest, more].concat())
    };
    let whole = capture("whole", &[]);
    assert!(whole["episodes"].as_u64().unwrap() > 2 && whole["shard"] == Value::Null, "{whole}");
    let table = |name: &str| std::fs::read_to_string(dir.join(name).join("frames.csv")).unwrap();
    let mut rows: Vec<String> = table("whole").lines().take(1).map(Into::into).collect();
    let mut files = 0;
    for (index, frames) in [(1, 6), (2, 7), (3, 7)] {
        let (name, shard) = (format!("part{index}"), format!("{index}/3"));
        let summary = capture(&name, &["--shard", &shard]);
        assert_eq!((summary["frames"].as_u64(), &summary["shard"]), (Some(frames), &Value::from(shard)));
        rows.extend(table(&name).lines().skip(1).map(Into::into));
        for kind in ["rgb", "depth", "segmentation"] {
            for entry in std::fs::read_dir(dir.join(&name).join(kind)).unwrap() {
                let entry = entry.unwrap();
                let same = dir.join("whole").join(kind).join(entry.file_name());
                assert!(std::fs::read(entry.path()).unwrap() == std::fs::read(same).unwrap(), "{:?}", entry.path());
                files += 1;
            }
        }
        for file in ["camera.json", "segmentation.json"] {
            assert_eq!(
                std::fs::read(dir.join(&name).join(file)).unwrap(),
                std::fs::read(dir.join("whole").join(file)).unwrap()
            );
        }
    }
    assert_eq!(rows, table("whole").lines().map(String::from).collect::<Vec<_>>());
    assert_eq!(files, 3 * 20 * 2);
    // a part without frames has the header only
    assert_eq!(capture("none", &["--shard", "1/21"])["frames"], 0);
    assert_eq!(table("none").lines().count(), 1);
    refused(&["capture", "--task", "hover", "--frames", "9", "--shard", "0/3", "--out", "x"], 2, &["--shard", "I/N"]);
}

#[test]
fn images_show_the_layout_of_their_episode() {
    if !has_gl() {
        return;
    }
    let dir = directory("layouts");
    let capture = |out: &Path, more: &[&str]| {
        let arguments = ["capture", "--task", "hover", "--obstacles", "forest", "--size", "64x48", "--out", text(out)];
        run(&[&arguments[..], &["--duration", "0.1", "--vary", "layouts"], more].concat());
    };
    // the first frame of each of four episodes, from the same camera pose
    capture(&dir, &["--frames", "4", "--every", "5"]);
    let rows = std::fs::read_to_string(dir.join("frames.csv")).unwrap();
    let episodes: Vec<_> = rows.lines().skip(1).map(|row| row.split(',').nth(1).unwrap()).collect();
    assert_eq!(episodes, ["0", "1", "2", "3"]);
    let images: std::collections::HashSet<_> =
        (0..4).map(|frame| std::fs::read(dir.join(format!("segmentation/{frame:06}_0.png"))).unwrap()).collect();
    assert_eq!(images.len(), 4);
}

/// The first reset samples a layout, which differs from that of the compiled scene.
#[test]
fn images_of_the_first_episode_show_the_layout_of_its_reset() {
    if !has_gl() {
        return;
    }
    let dir = directory("first-layout");
    let conditions = "[randomization.initial]\n[obstacles]\nkind = \"forest\"\ncount = 20\narena = [4.0, 4.0, 2.0]\n\
         new_layout = true\nseed = 5\n";
    let config = write(&dir.join("conditions.toml"), conditions);
    let conditions = Conditions::from_toml(conditions).unwrap();
    let mut env = tasks::make("hover", EnvConfig::default().conditions(&conditions)).unwrap();
    env.reset(Some(3)).unwrap();
    let (simulation, size) = (env.simulation(), ImageSize { width: 64, height: 48 });
    assert_ne!(simulation.obstacles(), simulation.world().obstacles);
    let mut renderer = SceneRenderer::for_observations(simulation.world()).unwrap();
    renderer.set_obstacles(simulation.obstacles()).unwrap();
    renderer.update(simulation.states()).unwrap();
    let mut objects = vec![[0; 2]; size.pixels()];
    renderer.onboard_segmentation(0, size, &mut objects).unwrap();
    let expected = images::png_segmentation(size, &objects).unwrap();

    let common = ["--task", "hover", "--config", text(&config), "--seed", "3", "--size", "64x48"];
    let set = dir.join("set");
    run(&[&["capture", "--frames", "1", "--out", text(&set)], &common[..]].concat());
    assert!(std::fs::read(set.join("segmentation/000000_0.png")).unwrap() == expected);
    let image = dir.join("segmentation.png");
    let render = ["render", "--at", "0", "--camera", "fpv", "--kind", "segmentation", "--out", text(&image)];
    run(&[&render[..], &common[..]].concat());
    let colours = images::segmentation_in_colour(&objects);
    assert!(std::fs::read(&image).unwrap() == images::png_rgb(size, &colours).unwrap());
}

/// Asserts that every row of a dataset has its images, and every id its object. Returns the number of rows.
fn assert_dataset_is_complete(dir: &Path) -> usize {
    let mut rows = csv::Reader::from_path(dir.join("frames.csv")).unwrap();
    let header: Vec<_> = rows.headers().unwrap().iter().map(str::to_string).collect();
    assert_eq!(header[2..17], STATE_COLUMNS);
    let segmentation: Value = serde_json::from_slice(&std::fs::read(dir.join("segmentation.json")).unwrap()).unwrap();
    let camera: Value = serde_json::from_slice(&std::fs::read(dir.join("camera.json")).unwrap()).unwrap();
    assert!(camera["fx"].is_number());
    let rows: Vec<_> = rows.records().map(Result::unwrap).collect();
    for row in &rows {
        assert_eq!(row.len(), header.len());
        for file in 17..20 {
            image::open(dir.join(&row[file])).unwrap();
        }
        let objects = image::open(dir.join(&row[19])).unwrap().into_luma16();
        assert!(objects.pixels().all(|pixel| segmentation[pixel[0].to_string()].is_object()));
    }
    // the program may end between the last image of a set and its row
    let sets = std::fs::read_dir(dir.join("segmentation")).unwrap();
    let sets = sets.filter(|entry| entry.as_ref().unwrap().path().extension().is_some_and(|ending| ending == "png"));
    assert!((0..=1).contains(&(sets.count() - rows.len())));
    rows.len()
}

#[test]
fn an_interrupted_capture_keeps_all_complete_frames() {
    if !has_gl() {
        return;
    }
    for signal in ["-KILL", "-INT", "-HUP"] {
        let dir = directory(&format!("killed-capture{signal}"));
        let mut command = Command::new("env");
        command.args(["--default-signal", env!("CARGO_BIN_EXE_aviary"), "capture", "--task", "multi_hover"]);
        command.args(["--obstacles", "forest", "--size", "16x12", "--frames", "1000000", "--out", text(&dir)]);
        let mut child = Running::start(command.stdout(Stdio::null()));
        wait_while(&mut child, || !dir.join("segmentation/000040_0.png").exists());
        send(signal, &child);
        child.wait().unwrap();
        assert!(assert_dataset_is_complete(&dir) >= 80, "{signal}");
    }
}

/// A size limit of the shell makes writes fail, as a full disk does.
#[test]
fn a_capture_on_a_full_disk_keeps_all_complete_frames() {
    if !has_gl() {
        return;
    }
    let dir = directory("full-capture");
    // the table grows by 64 KiB, and the limit is in blocks of 512 bytes
    let output = Command::new("sh")
        .args(["-c", "ulimit -f 200; exec \"$@\"", "sh", env!("CARGO_BIN_EXE_aviary"), "capture", "--task", "hover"])
        .args(["--size", "8x6", "--frames", "100000", "--out", text(&dir)])
        .output()
        .unwrap();
    let error = String::from_utf8(output.stderr).unwrap();
    assert_eq!((output.status.code(), error.lines().count()), (Some(1), 1), "{error}");
    assert!(error.contains("frames.csv"), "{error}");
    assert!(assert_dataset_is_complete(&dir) > 100);
}
