//! Images, animations and plots, and machines without OpenGL.

use std::process::Command;

use aviary::env::{Env as _, EnvConfig};
use aviary::rollout::{ControllerPolicy, Rollout};
use aviary::tasks::{self, RaceTrack};
use aviary::vision::ImageSize;
use serde_json::Value;

mod common;

use common::{directory, entries, has_gl, json, refused, run, text, write};

#[test]
fn render_writes_every_kind_of_image_from_every_camera() {
    if !has_gl() {
        return;
    }
    let dir = directory("images");
    for camera in ["track", "fpv", "fixed", "front"] {
        for kind in ["rgb", "depth", "segmentation"] {
            let path = dir.join(format!("{camera}_{kind}.png"));
            let arguments = ["render", "--task", "hover", "--at", "0.5", "--size", "80x50"];
            run(&[&arguments[..], &["--camera", camera, "--kind", kind, "--out", text(&path)]].concat());
            let image = image::open(&path).unwrap().into_rgb8();
            assert_eq!(image.dimensions(), (80, 50));
            let first = image.get_pixel(0, 0);
            assert!(image.pixels().any(|pixel| pixel != first), "{camera} {kind} is empty");
        }
    }
    let again = dir.join("again.png");
    run(&["render", "--task", "hover", "--at", "0.5", "--size", "80x50", "--out", text(&again)]);
    assert_eq!(std::fs::read(&again).unwrap(), std::fs::read(dir.join("track_rgb.png")).unwrap());
}

#[test]
fn a_capture_has_images_states_intrinsics_and_names_of_ids() {
    if !has_gl() {
        return;
    }
    let dir = directory("capture");
    let frames =
        ["--task", "hover", "--duration", "1", "--frames", "7", "--every", "10", "--size", "40x30", "--vary", "none"];
    run(&[&["capture", "--out", text(&dir)], &frames[..]].concat());

    let mut rows = csv::Reader::from_path(dir.join("frames.csv")).unwrap();
    let header: Vec<_> = rows.headers().unwrap().iter().map(str::to_string).collect();
    let column = |name: &str| header.iter().position(|column| column == name).unwrap();
    let rows: Vec<_> = rows.records().map(Result::unwrap).collect();
    assert_eq!(rows.len(), 7);
    let camera: Value = serde_json::from_slice(&std::fs::read(dir.join("camera.json")).unwrap()).unwrap();
    assert_eq!((&camera["width"], &camera["height"]), (&40.into(), &30.into()));
    assert_eq!(camera["position_in_body"], serde_json::json!([0.02, 0.0, 0.0]));
    let names: Value = serde_json::from_slice(&std::fs::read(dir.join("segmentation.json")).unwrap()).unwrap();
    let fy = camera["fy"].as_f64().unwrap();

    for (frame, row) in rows.iter().enumerate() {
        assert_eq!(row[column("frame")], frame.to_string());
        // an episode of 1 s has 48 control steps, so that the next episode begins at the sixth frame
        let (episode, step) = if frame < 5 { ("0", frame * 10) } else { ("1", (frame - 5) * 10) };
        assert_eq!((&row[column("episode")], &row[column("t")]), (episode, &*(step as f64 / 48.0).to_string()));
        let rgb = image::open(dir.join(&row[column("rgb")])).unwrap().into_rgb8();
        let depth = image::open(dir.join(&row[column("depth")])).unwrap();
        let depth = depth.as_luma16().expect("16 bit");
        let objects = image::open(dir.join(&row[column("segmentation")])).unwrap();
        let objects = objects.as_luma16().expect("16 bit");
        assert_eq!((rgb.dimensions(), depth.dimensions(), objects.dimensions()), ((40, 30), (40, 30), (40, 30)));
        // the drone is level: the rays of the lowest row of pixels point down by atan(14.5 / fy)
        let z: f64 = row[column("z")].parse().unwrap();
        let expected = z / (14.5 / fy) * 1000.0;
        assert!((f64::from(depth.get_pixel(20, 29)[0]) - expected).abs() < 2.0, "frame {frame}: {expected}");
        assert_eq!(depth.get_pixel(20, 0)[0], 0, "the background has no depth");
        assert_eq!(names[objects.get_pixel(20, 29)[0].to_string()]["name"], "floor");
        assert_eq!(names[objects.get_pixel(20, 0)[0].to_string()]["type"], "background");
    }
    assert_eq!((entries(&dir), entries(&dir.join("rgb"))), (6, 7), "no temporary file remains");
}

/// The images of a capture are those of the environment's own cameras, also of gates that move or only stand elsewhere
/// in the next episode.
#[test]
fn a_capture_has_the_present_poses_of_gates() {
    if !has_gl() {
        return;
    }
    let dir = directory("capture-gates");
    let moving = include_str!("../../assets/tracks/moving_gates.toml");
    let size = ImageSize { width: 64, height: 48 };
    let still = moving.replace("amplitude = 0.15", "amplitude = 0");
    for (name, toml) in [("moving", moving), ("still", &still)] {
        let (out, track) = (dir.join(name), write(&dir.join(format!("{name}.toml")), toml));
        let capture = ["capture", "--task", "race", "--track", text(&track), "--vary", "none", "--size", "64x48"];
        let frames = ["--duration", "2", "--frames", "5", "--every", "32"];
        run(&[&capture[..], &frames, &["--out", text(&out)]].concat());
        let config = EnvConfig::default()
            .task(|options| options.track = Some(RaceTrack::from_file(&track).unwrap()))
            .observation_type("rgb".parse().unwrap())
            .camera_size(size)
            .episode_seconds(2.0);
        let env = tasks::make("race", config).unwrap();
        let controller = tasks::summary("race").unwrap().defaults.controller;
        let policy = ControllerPolicy::new(controller, &env);
        let mut rollout = Rollout::start(env, policy, Some(0)).unwrap();
        let mut seen = Vec::new();
        for frame in 0..5 {
            let captured = image::open(out.join(format!("rgb/{frame:06}_0.png"))).unwrap().into_rgb8().into_raw();
            let observed = rollout.env().observation().rgb.chunks_exact(4).flat_map(|pixel| &pixel[..3]);
            assert!(captured.iter().eq(observed), "{name} {frame}");
            assert!(!seen.contains(&captured), "{name} {frame}");
            seen.push(captured);
            for _ in 0..32 {
                rollout.step().unwrap();
                if rollout.is_over() {
                    rollout.restart(None).unwrap();
                    break;
                }
            }
        }
    }
}

#[test]
fn an_animation_is_complete_or_missing() {
    if !has_gl() {
        return;
    }
    let dir = directory("animation");
    let path = dir.join("hover.gif");
    let fly = ["fly", "--task", "hover", "--duration", "0.5", "--size", "64x48", "--camera", "front"];
    run(&[&fly[..], &["--gif", text(&path)]].concat());
    let bytes = std::fs::read(&path).unwrap();
    assert!(bytes.starts_with(b"GIF89a") && bytes.ends_with(b";"));
    let blocked = dir.join("hover.gif").join("x.gif");
    refused(&[&fly[..], &["--gif", text(&blocked)]].concat(), 1, &["x.gif"]);
    assert_eq!(entries(&dir), 1, "no temporary file remains");
}

#[test]
fn a_shorter_capture_replaces_a_longer_one() {
    if !has_gl() {
        return;
    }
    let dir = directory("capture-again");
    let capture =
        |frames: &str| json(&["capture", "--task", "hover", "--out", text(&dir), "--frames", frames])["frames"].clone();
    assert_eq!(capture("5"), 5);
    std::fs::write(dir.join("rgb").join("mine.png"), "a file of the user").unwrap();
    assert_eq!(capture("2"), 2);
    assert_eq!(["rgb", "depth", "segmentation"].map(|kind| entries(&dir.join(kind))), [3, 2, 2]);
}

#[test]
fn plots_and_animations_are_in_the_list_of_files() {
    let dir = directory("plots");
    let flight = json(&["fly", "--task", "multi_hover", "--duration", "1", "--plot", "--out", text(&dir)]);
    let files: Vec<&str> = flight["files"].as_array().unwrap().iter().map(|file| file.as_str().unwrap()).collect();
    let names = [
        "drone0.csv",
        "drone1.csv",
        "scenario.toml",
        "summary.json",
        "flight.svg",
        "flight.png",
        "path.svg",
        "path.png",
    ];
    assert_eq!(files, names.map(|name| text(&dir.join(name)).to_string()));
    for name in names {
        assert!(dir.join(name).metadata().unwrap().len() > 200, "{name}");
    }
    image::open(dir.join("flight.png")).unwrap();

    // the next flight in this directory removes the files of this one, and file names need not be UTF-8
    run(&["fly", "--task", "hover", "--duration", "1", "--out", text(&dir)]);
    assert!(!dir.join("drone1.csv").exists() && !dir.join("path.png").exists() && dir.join("drone0.csv").exists());
    use std::os::unix::ffi::OsStrExt as _;
    let odd = dir.join(std::ffi::OsStr::from_bytes(b"o\xff"));
    let fly = ["fly", "--task", "hover", "--duration", "0.1", "--json", "--out"];
    let output = Command::new(env!("CARGO_BIN_EXE_aviary")).args(fly).arg(&odd).output().unwrap();
    assert!(output.status.success() && odd.join("drone0.csv").exists());

    // without --out, all files of the flight are in out/fly/TASK, so that plots belong to the log next to them
    let here = directory("plots-here");
    std::fs::create_dir_all(&here).unwrap();
    let fly = ["fly", "--task", "hover", "--duration", "1", "--plot"];
    let output = Command::new(env!("CARGO_BIN_EXE_aviary")).args(fly).current_dir(&here).output().unwrap();
    assert!(String::from_utf8(output.stdout).unwrap().contains("wrote out/fly/hover/path.png"));
    for name in ["flight.svg", "drone0.csv", "summary.json"] {
        assert!(here.join("out/fly/hover").join(name).exists(), "{name}");
    }

    if !has_gl() {
        return;
    }
    let frames = dir.join("frames");
    let options =
        ["--size", "64x48", "--camera", "top", "--overlay", "trails,references,rings,wind", "--wind", "constant"];
    let fly = ["fly", "--task", "hover", "--duration", "0.5", "--png", text(&frames)];
    run(&[&fly[..], &options].concat());
    assert_eq!(entries(&frames), 13, "24 frames per second and the last one");
}

#[test]
fn impossible_animations_are_refused_before_the_flight() {
    for (more, texts) in [
        (&["--gif", "flight.png"][..], &["--gif is `flight.png`", "ends in .gif"][..]),
        (&["--video", "flight.avi"], &["--video is `flight.avi`", "ends in .mp4"]),
        (&["--gif", "a.gif", "--overlay", "trials"], &["no overlay `trials`", "did you mean `trails`?"]),
        (&["--gif", "a.gif", "--camera", "trak"], &["--camera is `trak`", "did you mean `track`?"]),
        (&["--overlay", "trails"], &["--gif or --video or --png is missing"]),
    ] {
        refused(&[&["fly", "--task", "hover"], more].concat(), 2, texts);
    }
    if !has_gl() {
        return;
    }
    // without ffmpeg in PATH
    let video = directory("no-encoder").join("video.mp4");
    let output = Command::new(env!("CARGO_BIN_EXE_aviary"))
        .args(["fly", "--task", "hover", "--duration", "0.1", "--video", text(&video)])
        .env("PATH", "")
        .output()
        .unwrap();
    let error = String::from_utf8(output.stderr).unwrap();
    assert_eq!((output.status.code(), error.lines().count()), (Some(1), 1), "{error}");
    assert!(error.contains("`ffmpeg` is not installed") && error.contains("apt-get install ffmpeg"), "{error}");
    assert_eq!(entries(video.parent().unwrap()), 0);
}

#[test]
fn every_command_reports_a_missing_device() {
    for (variable, value, expected) in
        [("MUJOCO_EGL_DEVICE_ID", "x", "expected a number from 0"), ("MUJOCO_GL", "vulkan", "expected egl or osmesa")]
    {
        let run = |arguments: &[&str]| {
            let output =
                Command::new(env!("CARGO_BIN_EXE_aviary")).args(arguments).env(variable, value).output().unwrap();
            (output.status.code(), String::from_utf8(output.stderr).unwrap())
        };
        let (status, error) = run(&["render", "--task", "hover", "--out", text(&directory("device").join("x.png"))]);
        assert!(status == Some(2) && error.contains(expected) && !error.contains("apt-get"), "{error}");
        let (status, error) = run(&["doctor"]);
        assert!(status == Some(1) && error.contains(expected), "{error}");
    }
}

#[test]
fn impossible_images_are_refused() {
    let out = directory("images-refused").join("x.png");
    let render = |more: &[&str], status: i32, texts: &[&str]| {
        refused(&[&["render", "--task", "hover", "--out", text(&out)], more].concat(), status, texts);
        assert!(!out.exists());
    };
    render(&["--camera", "frnt"], 2, &["--camera is `frnt`", "did you mean `front`?"]);
    render(&["--kind", "lidar"], 2, &["--kind is `lidar`", "depth"]);
    render(&["--size", "0x48"], 2, &["--size is `0x48`, expected WIDTHxHEIGHT"]);
    render(&["--size", "64"], 2, &["WIDTHxHEIGHT"]);
    render(&["--at", "-1"], 2, &["--at is -1 s"]);
    render(&["--at", "99"], 2, &["--at is 99 s", "time_limit"]);
    refused(&["capture", "--task", "hover", "--frames", "0", "--out", "x"], 2, &["--frames is 0"]);
    refused(&["capture", "--task", "hover", "--frames", "1", "--every", "0", "--out", "x"], 2, &["--every is 0"]);
}

#[test]
fn errors_without_opengl_name_the_packages_and_flights_need_no_opengl() {
    // a search path where these libraries are text files
    let dir = directory("no-gl");
    std::fs::create_dir_all(&dir).unwrap();
    for name in ["libEGL.so.1", "libEGL.so", "libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so"] {
        std::fs::write(dir.join(name), "no library").unwrap();
    }
    let run = |arguments: &[&str]| {
        let output =
            Command::new(env!("CARGO_BIN_EXE_aviary")).args(arguments).env("LD_LIBRARY_PATH", &dir).output().unwrap();
        (output.status.code(), String::from_utf8(output.stdout).unwrap(), String::from_utf8(output.stderr).unwrap())
    };
    for command in ["doctor", "render", "capture"] {
        let out = dir.join(if command == "render" { "render.png" } else { command });
        let arguments = match command {
            "doctor" => vec!["doctor"],
            "render" => vec!["render", "--task", "hover", "--out", text(&out)],
            _ => vec!["capture", "--task", "hover", "--frames", "1", "--out", text(&out)],
        };
        let (status, table, error) = run(&arguments);
        assert_eq!((status, error.lines().count()), (Some(1), 1), "{error}");
        assert!(error.contains("apt-get install libegl1 libgl1-mesa-dri libosmesa6"), "{error}");
        // one short reason per library: doctor prints them in its table
        let reasons = if command == "doctor" { table } else { error };
        for library in ["libEGL", "libOSMesa"] {
            assert_eq!(reasons.matches(library).count(), 1, "{reasons}");
        }
        assert!(reasons.contains("libEGL.so.1: file too short") && reasons.contains("libOSMesa.so.8: "), "{reasons}");
        assert!(!out.exists());
    }
    let (status, doctor, _) = run(&["doctor", "--json"]);
    let doctor: Value = serde_json::from_str(&doctor).unwrap();
    assert_eq!((status, &doctor["ok"]), (Some(1), &false.into()));
    for answer in doctor["gl"].as_array().unwrap() {
        assert!(answer["works"] == false && answer["detail"].as_str().unwrap().contains(".so"), "{answer}");
        assert!(answer["install"].as_str().unwrap().starts_with("apt-get install lib"), "{answer}");
    }
    assert_eq!(run(&["fly", "--task", "hover"]).0, Some(0));
}
