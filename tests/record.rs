//! Recorded flights: exact reading, plots, animations, and files that survive a crash of the program.

mod common;

use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use common::no_gl;
use mujoco_drones_gym::control::ControllerKind;
use mujoco_drones_gym::env::check_env;
use mujoco_drones_gym::mujoco::Quality;
use mujoco_drones_gym::nalgebra::Vector3;
use mujoco_drones_gym::physics::wind::{WindConfig, WindModel};
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::record::animation::{Animation, GifAnimation};
use mujoco_drones_gym::record::plot::Plot;
use mujoco_drones_gym::record::{
    COLUMNS, Flight, FrameRecorder, Overlays, Recorded, Recorder, files, read_obstacle_poses,
};
use mujoco_drones_gym::state::wxyz;
use mujoco_drones_gym::tasks::{Antipodal, GateMotion};
use mujoco_drones_gym::vision::{SceneRenderer, VisualEffects};
use proptest::prelude::*;

/// Returns an action of a slow tumble.
fn action(step: usize, size: usize) -> Vec<f64> {
    (0..size).map(|i| 0.3 * (0.9 * step as f64 + 1.7 * i as f64).sin() + 0.05).collect()
}

/// Records up to `steps` steps of an environment and returns the state, motor speeds and reward of every drone and row.
fn fly(env: &mut dyn DroneEnv, to: &Path, steps: usize) -> Vec<Vec<(DroneState, [f64; 4], f64)>> {
    let (drones, size) = (env.simulation().num_drones(), env.action_space().size());
    let mut recorder = Recorder::create(to, drones).unwrap();
    let mut rows = vec![Vec::new(); drones];
    let mut note = |env: &dyn DroneEnv| {
        recorder.record(env).unwrap();
        for (drone, rows) in rows.iter_mut().enumerate() {
            let simulation = env.simulation();
            rows.push((simulation.states()[drone], simulation.motor_speeds()[drone], env.drone_reward(drone)));
        }
    };
    env.reset(Some(3)).unwrap();
    note(env);
    for step in 0..steps {
        let over = env.step(&action(step, size)).map(|step| step.terminated || step.truncated).unwrap();
        note(env);
        if over {
            break;
        }
    }
    rows
}

/// A flight that goes on from an earlier state continues the log of the obstacles as that of the drone.
#[test]
fn a_log_with_moving_obstacles_is_continued_from_an_earlier_state() {
    let directory = tempfile::tempdir().unwrap();
    let motion = GateMotion { amplitude: 0.2, period: 1.0 };
    let builder = Race::builder().initial_positions([[0.0, -0.9, 1.0]]);
    let mut env = builder.task(|race| (race.solid, race.motion) = (true, motion)).build().unwrap();
    env.reset(Some(3)).unwrap();
    let (whole, parts) = (directory.path().join("whole"), directory.path().join("parts"));
    let mut recorder = Recorder::create(&whole, 1).unwrap();
    let (mut flight, mut poses, mut snapshot) = (Flight::default(), Vec::new(), None);
    let first = env.simulation().obstacles().len() - env.simulation().moving_obstacles().len();
    assert_eq!((first, env.simulation().moving_obstacles().len()), (0, 24));
    for step in 0..20 {
        recorder.record(&env).unwrap();
        if step <= 8 {
            flight.note(&env);
            snapshot = Some(env.snapshot());
        }
        env.step(&action(step, 4)).unwrap();
    }
    drop(recorder);
    let rows = read_obstacle_poses(&whole).unwrap();
    assert_eq!(rows.len(), 24 * 19);
    env.restore(&snapshot.unwrap()).unwrap();
    poses.extend(rows.iter().filter(|pose| pose.time <= env.simulation().time()));
    let mut recorder = Recorder::create(&parts, 1).unwrap();
    recorder.record_flight(&flight).unwrap();
    recorder.record_obstacle_poses(env.simulation(), &poses).unwrap();
    for step in 8..19 {
        env.step(&action(step, 4)).unwrap();
        recorder.record(&env).unwrap();
    }
    drop(recorder);
    for name in ["drone0.csv", "obstacles.csv"] {
        assert_eq!(std::fs::read(parts.join(name)).unwrap(), std::fs::read(whole.join(name)).unwrap(), "{name}");
    }
}

#[test]
fn recorded_flights_are_read_back_bit_identically() {
    let directory = tempfile::tempdir().unwrap();
    let wind = WindConfig::new(WindModel::Combined);
    let envs: [Box<dyn DroneEnv>; 4] = [
        Box::new(Hover::builder().sim_freq(500).ctrl_freq(100).initial_rpys([[0.0, 0.0, 2.5]]).build().unwrap()),
        Box::new(MultiHover::builder().num_drones(3).physics(Physics::MjcGndDragDw).build().unwrap()),
        Box::new(Race::builder().wind(wind).build().unwrap()),
        make("formation", EnvConfig::default()).unwrap(),
    ];
    for (index, mut env) in envs.into_iter().enumerate() {
        let to = directory.path().join(index.to_string());
        let expected = fly(&mut *env, &to, 60);
        let flight = Flight::read(&to).unwrap();
        assert_eq!((flight.drones.len(), files(&to).len()), (expected.len(), expected.len()));
        let dt = env.simulation().control_period();
        for (samples, expected) in flight.drones.iter().zip(&expected) {
            assert_eq!(samples.len(), expected.len());
            for (i, (sample, (state, motors, reward))) in samples.iter().zip(expected).enumerate() {
                assert_eq!((sample.state, sample.motor_speeds, sample.reward), (*state, *motors, *reward));
                assert!((sample.time - i as f64 * dt).abs() < 1e-12);
                let before = &samples[i.saturating_sub(1)];
                let change = before.state.velocity + sample.acceleration * dt;
                assert!(
                    (change - sample.state.velocity).norm() < 1e-9,
                    "acceleration is the change of velocity over dt"
                );
            }
        }
    }
}

#[test]
fn csv_readers_read_the_documented_columns() {
    let directory = tempfile::tempdir().unwrap();
    let mut env = Hover::builder().initial_rpys([[0.2, -0.1, 1.0]]).build().unwrap();
    fly(&mut env, directory.path(), 10);
    let mut reader = csv::Reader::from_path(directory.path().join("drone0.csv")).unwrap();
    assert_eq!(reader.headers().unwrap(), COLUMNS.to_vec());
    let rows: Vec<csv::StringRecord> = reader.records().map(Result::unwrap).collect();
    assert_eq!(rows.len(), 11);
    let column = |name: &str| COLUMNS.iter().position(|column| *column == name).unwrap();
    let last = |name: &str| -> f64 { rows[10][column(name)].parse().unwrap() };
    let (state, rpy) = (env.simulation().states()[0], *env.simulation().rpy(0));
    assert_eq!([last("x"), last("y"), last("z")], [state.position.x, state.position.y, state.position.z]);
    assert_eq!([last("qw"), last("qx"), last("qy"), last("qz")], wxyz(&state.attitude));
    assert_eq!([last("roll"), last("pitch"), last("yaw")], [rpy.x, rpy.y, rpy.z]);
    assert_eq!(last("wz"), state.angular_velocity.z);
    assert_eq!((last("z_ref"), last("t")), (1.0, 10.0 / 48.0));
    assert_eq!(&rows[10][1], "0", "index of the drone");
}

#[test]
fn a_recorded_environment_writes_a_new_file_per_episode_and_overwrites_none() {
    let directory = tempfile::tempdir().unwrap();
    let build = || MultiHover::builder().episode_seconds(0.25).build().unwrap();
    for first in [0, 2] {
        let mut env = Recorded::new(build(), directory.path()).unwrap();
        for episode in first..first + 2 {
            env.reset((episode == first).then_some(5)).unwrap();
            let (mut rewards, mut over) = (vec![0.0], false);
            while !over {
                let step = env.step(&action(rewards.len(), 8)).unwrap();
                over = step.truncated || step.terminated;
                rewards.push(step.reward);
            }
            let flight = Flight::read_named(directory.path(), &format!("episode_{episode:04}_")).unwrap();
            assert_eq!((flight.drones.len(), flight.drones[0].len()), (2, 13));
            for (i, reward) in rewards.iter().enumerate() {
                let sum: f64 = flight.drones.iter().map(|samples| samples[i].reward).sum();
                assert!((sum - reward).abs() < 1e-9, "the reward of the step is the sum over the drones");
            }
        }
    }
    check_env(&mut Recorded::new(build(), directory.path().join("checked")).unwrap()).unwrap();
    let file = directory.path().join("file");
    std::fs::write(&file, "").unwrap();
    assert!(Recorded::new(build(), &file).unwrap_err().to_string().contains("file"));
}

#[test]
fn the_file_of_one_drone_is_a_flight_of_one_drone() {
    let directory = tempfile::tempdir().unwrap();
    let mut env = Recorded::new(MultiHover::builder().num_drones(3).build().unwrap(), directory.path()).unwrap();
    env.reset(Some(1)).unwrap();
    env.step(&[0.1; 12]).unwrap();
    env.end_episode();
    env.step(&[0.1; 12]).unwrap();
    let whole = Flight::read_episode(directory.path(), 0).unwrap();
    assert_eq!(whole.drones.len(), 3);
    for (drone, samples) in whole.drones.iter().enumerate() {
        assert_eq!(samples.len(), 2, "the step after the end of the files is not recorded");
        let path = directory.path().join(format!("episode_0000_drone{drone}.csv"));
        assert!(!std::fs::read_to_string(&path).unwrap().ends_with("\n\n"), "the file has ended");
        assert_eq!(Flight::read(path).unwrap().drones, std::slice::from_ref(samples));
    }
}

#[test]
fn a_log_that_cannot_be_written_is_an_error_of_the_system() {
    let directory = tempfile::tempdir().unwrap();
    let folder = directory.path().join("flights");
    let mut env = Recorded::new(Hover::builder().build().unwrap(), &folder).unwrap();
    std::fs::remove_dir(&folder).unwrap();
    let error = env.reset(Some(1)).unwrap_err();
    let EnvError::File { path, error } = &error else { panic!("{error}") };
    assert_eq!(*path, folder.join("episode_0000_drone0.csv"));
    assert!(matches!(&**error, EnvError::System(error) if error.kind() == std::io::ErrorKind::NotFound));
}

#[test]
fn a_flight_after_a_restore_is_recorded_as_a_new_episode() {
    let directory = tempfile::tempdir().unwrap();
    let mut env = Recorded::new(Hover::builder().episode_seconds(0.25).build().unwrap(), directory.path()).unwrap();
    env.reset(Some(1)).unwrap();
    for _ in 0..5 {
        env.step(&[0.1; 4]).unwrap();
    }
    let snapshot = env.snapshot();
    // the first recording has ended before the restore
    while env.info().end.is_none() {
        env.step(&[0.3; 4]).unwrap();
    }
    let ended = env.snapshot();
    env.restore(&snapshot).unwrap();
    env.step(&[-0.1; 4]).unwrap();
    env.restore(&ended).unwrap();
    let read = |name| Flight::read_named(directory.path(), name);
    let (first, second) = (read("episode_0000_").unwrap(), read("episode_0001_").unwrap());
    assert_eq!((first.drones[0].len(), second.drones[0].len()), (13, 2));
    assert_eq!(second.drones[0][0].state, first.drones[0][5].state);
    assert!(second.drones[0][1].time > second.drones[0][0].time && read("episode_0002_").is_err());
}

/// Regression test: in a loop over episodes, the next recorder is created before the previous one is dropped.
/// The old recorder then ended the program.
#[test]
fn a_new_recorder_in_a_directory_replaces_its_flight() {
    let directory = tempfile::tempdir().unwrap();
    let mut env = Hover::builder().build().unwrap();
    let mut recorder = Recorder::create(directory.path(), 1).unwrap();
    for episode in 0..3 {
        env.reset(Some(episode)).unwrap();
        for step in 0..400 {
            recorder.record(&env).unwrap();
            if env.info().end.is_none() {
                env.step(&action(step, 4)).unwrap();
            }
        }
        assert_eq!(Flight::read(directory.path()).unwrap().drones[0].len(), 400);
        recorder = Recorder::create(directory.path(), 1).unwrap();
    }
    assert_eq!(Flight::read(directory.path()).unwrap().drones[0].len(), 0);
}

/// Regression test: two recorders used the same episode numbers, and a recorder overwrote existing files after a gap in
/// the numbers.
#[test]
fn two_environments_record_into_one_directory() {
    let directory = tempfile::tempdir().unwrap();
    let new = || Recorded::new(Hover::builder().build().unwrap(), directory.path()).unwrap();
    let rows = |episode: usize| {
        Flight::read_named(directory.path(), &format!("episode_{episode:04}_"))
            .map_or(0, |flight| flight.drones[0].len())
    };
    let mut envs = [new(), new()];
    for (index, steps) in [(0, 10), (1, 20), (0, 30)] {
        let env = &mut envs[index];
        env.reset(Some(1)).unwrap();
        for _ in 0..steps {
            env.step(&[0.05; 4]).unwrap();
        }
    }
    assert_eq!([rows(0), rows(1), rows(2)], [11, 21, 31]);
    std::fs::remove_file(directory.path().join("episode_0000_drone0.csv")).unwrap();
    let mut third = new();
    for steps in [3, 4] {
        third.reset(None).unwrap();
        for _ in 0..steps {
            third.step(&[0.05; 4]).unwrap();
        }
    }
    assert_eq!([rows(0), rows(1), rows(2), rows(3)], [4, 21, 31, 5]);
}

#[test]
fn non_finite_rewards_are_read_back_unchanged() {
    let directory = tempfile::tempdir().unwrap();
    let simulation = Simulation::builder(DroneModel::Cf2x).build().unwrap();
    let mut recorder = Recorder::create(directory.path(), 1).unwrap();
    for reward in [f64::NAN, f64::NEG_INFINITY, -0.0, 1e-300] {
        recorder.record_with(&simulation, |_| (reward, None)).unwrap();
    }
    let flight = Flight::read(directory.path()).unwrap();
    let rewards: Vec<_> = flight.drones[0].iter().map(|sample| sample.reward).collect();
    assert!(rewards[0].is_nan() && rewards[1] == f64::NEG_INFINITY && rewards[2].to_bits() == 0.0_f64.to_bits());
    assert_eq!((rewards[3], flight.drones[0][3].reference), (1e-300, None));
}

/// Program that the next two tests start as a child process. It returns at once without `RECORD_INTO`.
#[test]
fn child_program_that_records_and_aborts() {
    let Ok(directory) = std::env::var("RECORD_INTO") else { return };
    let steps: usize = std::env::var("RECORD_STEPS").unwrap().parse().unwrap();
    let mut env = Hover::builder().build().unwrap();
    let mut recorder = Recorder::create(directory, 1).unwrap();
    env.reset(Some(1)).unwrap();
    recorder.record(&env).unwrap();
    for step in 0.. {
        if step == steps {
            std::process::abort();
        }
        if env.step(&action(step, 4)).is_err() {
            env.reset(None).unwrap();
        }
        recorder.record(&env).unwrap();
    }
}

fn start(directory: &Path, steps: usize) -> std::process::Child {
    Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "child_program_that_records_and_aborts"])
        .env("RECORD_INTO", directory)
        .env("RECORD_STEPS", steps.to_string())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap()
}

#[test]
fn a_program_that_aborts_has_written_every_row() {
    for steps in [0, 1, 77, 1000] {
        let directory = tempfile::tempdir().unwrap();
        assert!(!start(directory.path(), steps).wait().unwrap().success());
        let flight = Flight::read(directory.path()).unwrap();
        assert_eq!(flight.drones[0].len(), steps + 1);
        // CSV readers skip the empty lines at the end
        let mut reader = csv::Reader::from_path(directory.path().join("drone0.csv")).unwrap();
        assert_eq!(reader.records().filter(|row| row.as_ref().unwrap().len() == COLUMNS.len()).count(), steps + 1);
    }
}

#[test]
fn files_of_a_killed_program_are_readable() {
    for _ in 0..5 {
        let directory = tempfile::tempdir().unwrap();
        let mut child = start(directory.path(), usize::MAX);
        let rows = || Flight::read(directory.path()).map_or(0, |flight| flight.drones[0].len());
        let started = Instant::now();
        while rows() < 300 && started.elapsed() < Duration::from_secs(60) {
            std::thread::sleep(Duration::from_millis(2));
        }
        child.kill().unwrap();
        child.wait().unwrap();
        assert!(rows() >= 300);
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]
    /// A file with a changed byte and a new length is read in part, or refused by an error that contains its name.
    #[test]
    fn damaged_files_are_read_in_part_or_refused(cut in 0usize..6000, at in 0usize..6000, byte in any::<u8>()) {
        let directory = tempfile::tempdir().unwrap();
        fly(&mut Hover::builder().build().unwrap(), directory.path(), 12);
        let path = directory.path().join("drone0.csv");
        let mut bytes = std::fs::read(&path).unwrap();
        let whole = Flight::read(directory.path()).unwrap();
        let place = at % bytes.len();
        bytes[place] = byte;
        bytes.truncate(cut.max(1));
        std::fs::write(&path, &bytes).unwrap();
        match Flight::read(directory.path()) {
            Ok(flight) => prop_assert!(flight.drones[0].len() <= whole.drones[0].len() + 1),
            Err(error) => prop_assert!(error.to_string().contains("drone0.csv"), "{error}"),
        }
    }
}

#[test]
fn invalid_flight_files_are_errors_with_line_and_column() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("drone0.csv");
    let refused = |text: &str| {
        std::fs::write(&path, text).unwrap();
        Flight::read(directory.path()).unwrap_err().to_string()
    };
    let header = COLUMNS.join(",");
    assert!(Flight::read(directory.path()).unwrap_err().to_string().contains("drone0.csv"));
    assert!(refused("").contains("empty"));
    assert!(refused("t,x,y\n1,2,3\n").contains("line 1"));
    assert!(refused(&format!("{header}\n1,2,3\n")).contains("line 2: 3 cells, expected 30"));
    let row =
        |cell: &str| format!("{header}\n{}\n{}\n", vec!["0"; 30].join(","), ["1,0", cell].join(",") + &",1".repeat(27));
    for bad in ["NaN", "inf", "one", "1e999"] {
        let message = refused(&row(bad));
        assert!(message.contains("line 3: x is") && message.contains(bad), "{message}");
    }
    assert!(refused(&row("")).contains("line 3: x is ``, expected a finite number"));
    let other = format!("{header}\n{}\n", ["0", "1"].join(",") + &",0".repeat(28));
    assert!(refused(&other).contains("line 2: drone is 1, expected 0"));
    let part = format!("{header}\n{},1,,,\n", vec!["0"; 26].join(","));
    assert!(refused(&part).contains("the reference is incomplete"));
    let recorder = Recorder::create(directory.path(), 2).unwrap();
    drop(recorder);
    let mut wrong = Recorder::create(directory.path(), 1).unwrap();
    assert!(!directory.path().join("drone1.csv").exists(), "files of the previous flight are removed");
    let env = MultiHover::builder().build().unwrap();
    assert!(wrong.record(&env).unwrap_err().to_string().contains("2 drones, expected 1"));
}

#[test]
fn frames_of_impossible_sizes_are_errors() {
    let mut env = Hover::builder().build().unwrap();
    env.reset(Some(1)).unwrap();
    for (width, height) in [(u32::MAX, u32::MAX), (8193, 1), (0, 240)] {
        let size = ImageSize { width, height };
        let error = FrameRecorder::new(&env, View::Track, size, Overlays::default()).unwrap_err().to_string();
        assert_eq!(error, format!("size is {width}x{height}, expected sides of 1 to 8192 pixels"));
    }
}

/// Flies 1 s of Antipodal with an animation and returns the last frame, or `None` without OpenGL.
fn last_frame(overlays: Overlays, view: View) -> Option<Vec<u8>> {
    if no_gl() {
        return None;
    }
    let size = ImageSize { width: 320, height: 240 };
    let mut env = Antipodal::builder()
        .num_drones(4)
        .controller(ControllerKind::Geometric)
        .wind(WindConfig::new(WindModel::Constant))
        .build()
        .unwrap();
    env.reset(Some(1)).unwrap();
    let mut frame_recorder = FrameRecorder::new(&env, view, size, overlays).unwrap();
    let mut gif = GifAnimation::new(Vec::new(), size, frame_recorder.seconds_per_frame()).unwrap();
    let mut frames = 0;
    for step in 0..48 {
        if let Some(rgb) = frame_recorder.look(&env).unwrap() {
            gif.frame(rgb).unwrap();
            frames += 1;
        }
        let gently: Vec<f64> = action(step, 16).iter().map(|x| 0.1 * x).collect();
        env.step(&gently).unwrap();
    }
    assert_eq!(frames, 24, "24 frames per second");
    assert!((frame_recorder.seconds_per_frame() - 1.0 / 24.0).abs() < 1e-12);
    assert!(gif.finish().unwrap().len() > 1000);
    Some(frame_recorder.frame(env.simulation(), |drone| Some(env.reference(drone))).unwrap().to_vec())
}

#[test]
fn every_overlay_changes_the_frame() {
    let Some(plain) = last_frame(Overlays::default(), View::Top) else { return };
    let none = Overlays::default();
    for (name, overlays) in [
        ("trails", Overlays { trails: true, ..none }),
        ("references", Overlays { references: true, ..none }),
        ("wind", Overlays { wind: true, ..none }),
        ("rings", Overlays { rings: Some(0.15), ..none }),
    ] {
        assert_eq!(name.parse::<Overlays>().unwrap(), overlays);
        let with = last_frame(overlays, View::Top).unwrap();
        let changed = plain.chunks(3).zip(with.chunks(3)).filter(|(a, b)| a != b).count();
        assert!((10..16_000).contains(&changed), "{name}: {changed} pixels");
    }
}

#[test]
fn rings_and_gates_are_rendered_at_their_poses() {
    if no_gl() {
        return;
    }
    let simulation = Simulation::builder(DroneModel::Cf2x).initial_positions([[0.0, 0.0, 1.0]]).build().unwrap();
    let mut renderer = SceneRenderer::new(&simulation.scene(), Quality::FAST, VisualEffects::default()).unwrap();
    renderer.set_stage([0.0, 0.0, 1.0], 0.2);
    let size = ImageSize { width: 201, height: 201 };
    // centre, width and height of the magenta region, pixels
    let mut extent = |add: &dyn Fn(&mut SceneRenderer) -> bool| {
        renderer.update(simulation.states()).unwrap();
        assert!(add(&mut renderer));
        let mut rgb = vec![0; 3 * size.pixels()];
        renderer.rgb(View::Top, size, &mut rgb).unwrap();
        let pixels = rgb.chunks_exact(3).enumerate().filter(|(_, c)| c[0].min(c[2]).saturating_sub(c[1]) > 60);
        let places: Vec<_> = pixels.map(|(i, _)| ((i % 201) as f64, (i / 201) as f64)).collect();
        let count = places.len() as f64;
        let mean = places.iter().fold((0.0, 0.0), |(x, y), p| (x + p.0 / count, y + p.1 / count));
        let reach = |axis: fn(&(f64, f64)) -> f64| {
            let values = || places.iter().map(axis);
            values().fold(f64::MIN, f64::max) - values().fold(f64::MAX, f64::min)
        };
        (mean, reach(|p| p.0), reach(|p| p.1))
    };
    let magenta = [1.0, 0.0, 1.0, 1.0];
    // in the top view, x points right and y points up
    let level = extent(&|renderer| renderer.add_ring(Vector3::new(0.3, 0.2, 1.0), Vector3::z(), 0.2, 0.02, magenta));
    assert!(level.0.0 > 115.0 && level.0.1 < 90.0 && (level.1 - level.2).abs() < 4.0, "{level:?}");
    let upright = extent(&|renderer| renderer.add_ring(Vector3::new(0.0, 0.0, 1.0), Vector3::x(), 0.2, 0.02, magenta));
    assert!(upright.2 > 5.0 * upright.1, "a ring with its axis along x appears as a line along y: {upright:?}");
    let gate = extent(&|renderer| renderer.add_gate(Vector3::new(0.0, 0.0, 1.0), 0.0, 0.2, magenta));
    assert!(gate.2 > 4.0 * gate.1, "a gate with its axis along x appears as a line along y: {gate:?}");
}

/// Regression test: the recorder made no frames after the first episode unless `look` was called right after the reset.
#[test]
fn a_frame_recorder_continues_over_several_episodes() {
    if no_gl() {
        return;
    }
    let size = ImageSize { width: 32, height: 24 };
    let mut env = Hover::builder().ctrl_freq(40).build().unwrap();
    env.reset(Some(1)).unwrap();
    let mut frame_recorder = FrameRecorder::new(&env, View::Track, size, Overlays::ALL).unwrap();
    assert!(
        (frame_recorder.seconds_per_frame() - 0.05).abs() < 1e-12,
        "20 frames per second are nearer to 24 than 40 are"
    );
    for _ in 0..3 {
        env.reset(None).unwrap();
        let mut frames = 0;
        for _ in 0..40 {
            env.step(&[0.05; 4]).unwrap();
            frames += usize::from(frame_recorder.look(&env).unwrap().is_some());
        }
        assert_eq!(frames, 20);
    }
}

#[test]
fn a_recorded_flight_is_plotted_as_svg_and_png() {
    let directory = tempfile::tempdir().unwrap();
    let mut env = Formation::builder().build().unwrap();
    fly(&mut env, directory.path(), 60);
    let flight = Flight::read(directory.path()).unwrap();
    for (name, plot) in [("flight", Plot::of_flight("f", &flight)), ("path", Plot::of_paths("p", &flight))] {
        let plot = plot.unwrap();
        for ending in ["svg", "png"] {
            let path = directory.path().join(name).with_extension(ending);
            plot.save(&path).unwrap();
            assert!(path.metadata().unwrap().len() > 5_000);
        }
    }
}
