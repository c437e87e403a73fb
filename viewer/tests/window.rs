//! The window on a display without a screen: it opens, draws, obeys mouse and keyboard, closes, and never disturbs the
//! flight.

mod support;

use std::time::Duration;

use aviary::control::ControllerKind;
use aviary::env::{DroneEnv, EnvConfig};
use aviary::rollout::{ControllerPolicy, Rollout};
use aviary::state::DroneState;
use aviary::tasks::make;
use support::{Server, in_display, wait_until};
use viewer::{Command, FlightStatus, OrbitCamera, ViewStatus, Viewer, ViewerError, ViewerOptions};

type Flight = Rollout<Box<dyn DroneEnv>, ControllerPolicy>;

fn flight(task: &str) -> Flight {
    let env = make(task, EnvConfig::default()).unwrap();
    let env: Box<dyn DroneEnv> = env;
    let policy = ControllerPolicy::new(ControllerKind::Geometric, &env);
    Rollout::start(env, policy, Some(1)).unwrap()
}

fn options(title: &str) -> ViewerOptions {
    ViewerOptions { title: title.into(), size: [800, 600], panels: false, ..ViewerOptions::default() }
}

/// Waits for a state of the window.
fn status(viewer: &Viewer, what: &str, is_so: impl Fn(&ViewStatus) -> bool) -> ViewStatus {
    wait_until(what, || Some(viewer.status()).filter(&is_so))
}

/// Waits until the camera does not move any more.
fn still(viewer: &Viewer) -> OrbitCamera {
    wait_until("a camera that stands still", || {
        let before = viewer.status().camera;
        std::thread::sleep(Duration::from_millis(500));
        (viewer.status().camera == before).then_some(before)
    })
}

#[test]
fn a_window_opens_draws_a_hover_and_closes_by_its_button() {
    in_display("a_window_opens_draws_a_hover_and_closes_by_its_button", |display| {
        let mut flight = flight("hover");
        let mut viewer = Viewer::open(flight.env(), options("hover")).unwrap();
        let window = display.windows("hover", 1)[0];
        status(&viewer, "the first image", |status| status.images > 0);
        for _ in 0..48 {
            flight.step().unwrap();
            assert!(viewer.sync(flight.env()).unwrap());
        }
        let shown = status(&viewer, "the last state", |status| status.step == 48);
        assert_eq!(shown.size, [800, 600]);
        display.close(window);
        wait_until("the window to close", || (!viewer.sync(flight.env()).unwrap()).then_some(()));
        // a closed window is no error, and the flight goes on
        flight.step().unwrap();
        assert_eq!(viewer.sync(flight.env()), Ok(false));
        assert_eq!(viewer.is_open(), Ok(false));
    });
}

/// A flight is bit-identical with and without a window, whatever the person does with the camera.
#[test]
fn a_window_does_not_change_the_flight() {
    in_display("a_window_does_not_change_the_flight", |display| {
        let fly = |look: &mut dyn FnMut(&dyn DroneEnv, u64)| -> Vec<DroneState> {
            let mut flight = flight("multi_hover");
            let mut states = Vec::new();
            for step in 0..120 {
                flight.step().unwrap();
                look(flight.env(), step);
                states.extend_from_slice(flight.env().simulation().states());
            }
            states
        };
        let alone = fly(&mut |_, _| {});
        let first = flight("multi_hover");
        let mut viewer = Viewer::open(first.env(), options("bits")).unwrap();
        let window = display.windows("bits", 1)[0];
        display.focus(window);
        let watched = fly(&mut |env, step| {
            assert!(viewer.sync(env).unwrap());
            match step {
                30 => display.text("vdmxgt"),
                60 => display.drag(1, [200, 200], [400, 260]),
                90 => display.text("2345"),
                _ => {}
            }
        });
        assert_eq!(watched, alone);
        let shown = status(&viewer, "the keys", |status| status.preset == "top");
        assert!(shown.images > 3);
    });
}

#[test]
fn the_mouse_moves_the_camera_and_selects_drones() {
    in_display("the_mouse_moves_the_camera_and_selects_drones", |display| {
        let flight = flight("multi_hover");
        let mut viewer = Viewer::open(flight.env(), options("mouse")).unwrap();
        let window = display.windows("mouse", 1)[0];
        display.focus(window);
        let before = status(&viewer, "an image", |status| status.images > 1).camera;

        display.drag(1, [300, 300], [360, 300]);
        // 60 of 600 pixels are 18°, and the camera turns against the mouse
        let turn = |camera: &OrbitCamera| (camera.azimuth - before.azimuth + 180.0).rem_euclid(360.0) - 180.0;
        status(&viewer, "a turn", |status| status.preset == "free" && (turn(&status.camera) + 18.0).abs() < 2.5);
        assert_eq!(viewer.status().camera.lookat, before.lookat);

        // down turns the camera downwards
        let before = still(&viewer);
        display.drag(1, [300, 300], [300, 340]);
        let tilt = |camera: &OrbitCamera| camera.elevation - before.elevation;
        status(&viewer, "a tilt", |status| (tilt(&status.camera) + 12.0).abs() < 2.5);

        let before = still(&viewer);
        display.drag(3, [300, 300], [300, 240]);
        // the scene moves up with the mouse, so that the camera moves down
        let moved = |camera: &OrbitCamera| (camera.lookat - before.lookat).dot(&before.axes()[1]) / before.height();
        let panned = status(&viewer, "a movement", |status| (moved(&status.camera) + 0.1).abs() < 0.02).camera;
        assert_eq!((panned.azimuth, panned.distance), (before.azimuth, before.distance));

        let before = still(&viewer);
        display.press(4);
        display.release(4);
        let zoomed = status(&viewer, "a zoom", |status| status.camera.distance < before.distance);
        assert_eq!(zoomed.selected, None);
        // scrolling is smooth: it goes on for a moment
        still(&viewer);

        // a double click on the second drone
        display.text("1");
        let shown = status(&viewer, "the preset", |status| status.preset == "track");
        let camera = still(&viewer);
        let size = aviary::vision::ImageSize { width: shown.scene[2], height: shown.scene[3] };
        let place = flight.env().simulation().states()[1].position;
        let [x, y] = camera.pose().project(&place, size).unwrap();
        let at = [(0.5 + 0.5 * x) * 800.0, (0.5 - 0.5 * y) * 600.0].map(|x| x as i16);
        display.click(at[0], at[1]);
        display.click(at[0], at[1]);
        status(&viewer, "the selection", |status| status.selected == Some(1));
        display.text("f");
        status(&viewer, "following", |status| {
            status.followed == Some(1) && (status.camera.lookat - place).norm() < 1e-9
        });
        assert!(viewer.sync(flight.env()).unwrap());
    });
}

/// The window sends what the person does as commands, and only those that the flight executes.
#[test]
fn keys_become_commands_of_a_flight_that_executes_them() {
    in_display("keys_become_commands_of_a_flight_that_executes_them", |display| {
        let mut flight = flight("hover");
        let mut viewer = Viewer::open(flight.env(), options("keys")).unwrap();
        let window = display.windows("keys", 1)[0];
        display.focus(window);
        display.text("n -");
        status(&viewer, "an image", |status| status.images > 2);
        assert!(viewer.commands().is_empty(), "the flight of a program has no commands");

        viewer.set_flight_status(FlightStatus { is_interactive: true, is_paced: true, ..FlightStatus::default() });
        for _ in 0..20 {
            flight.step().unwrap();
            viewer.sync(flight.env()).unwrap();
        }
        status(&viewer, "the state", |status| status.step == 20);
        // Tab shows and hides the panels, and keys are commands as before
        display.key(support::TAB);
        display.key(support::TAB);
        display.text(" n-");
        display.key(support::BACKSPACE);
        // two states back, and continue from there
        display.key(support::LEFT);
        display.key(support::LEFT);
        let shown = status(&viewer, "an earlier state", |status| status.step == 18);
        assert_eq!(shown.preset, "track");
        display.text("c");
        let mut commands = Vec::new();
        wait_until("the last command", || {
            commands.extend(viewer.commands());
            commands.contains(&Command::Rewind { step: 18 }).then_some(())
        });
        let expected = [
            Command::Pause(true),
            Command::Restart { next_seed: true },
            Command::Speed(0.5),
            Command::Restart { next_seed: false },
            Command::Pause(true),
        ];
        for command in expected {
            assert!(commands.contains(&command), "{command:?} is not in {commands:?}");
        }
    });
}

#[test]
fn two_windows_show_two_flights() {
    in_display("two_windows_show_two_flights", |display| {
        let mut flights = ["hover", "race"].map(flight);
        let mut viewers =
            [0, 1].map(|index| Viewer::open(flights[index].env(), options(&format!("window{index}"))).unwrap());
        let first = display.windows("window0", 1)[0];
        display.windows("window1", 1);
        for step in 1..=10 {
            for (flight, viewer) in flights.iter_mut().zip(&mut viewers) {
                flight.step().unwrap();
                assert!(viewer.sync(flight.env()).unwrap(), "{step}");
            }
        }
        for viewer in &viewers {
            status(viewer, "the last state", |status| status.step == 10);
        }
        display.close(first);
        wait_until("the first window to close", || (!viewers[0].is_open().unwrap()).then_some(()));
        flights[1].step().unwrap();
        assert!(viewers[1].sync(flights[1].env()).unwrap());
        status(&viewers[1], "the next state", |status| status.step == 11);
        // a third window opens after the first one
        let third = Viewer::open(flights[0].env(), options("window2")).unwrap();
        status(&third, "an image", |status| status.images > 0);
    });
}

#[test]
fn any_size_of_a_window_is_drawn() {
    in_display("any_size_of_a_window_is_drawn", |display| {
        let mut flight = flight("hover");
        let mut viewer = Viewer::open(flight.env(), ViewerOptions { panels: true, ..options("sizes") }).unwrap();
        let window = display.windows("sizes", 1)[0];
        for [width, height] in [[1, 1], [3840, 2160], [300, 1], [20, 700], [801, 601]] {
            display.resize(window, width, height);
            flight.step().unwrap();
            assert!(viewer.sync(flight.env()).unwrap());
            status(&viewer, "the size", |status| status.size == [width, height]);
            let images = viewer.status().images;
            flight.step().unwrap();
            assert!(viewer.sync(flight.env()).unwrap());
            status(&viewer, "an image of the size", |status| status.images > images);
        }
    });
}

#[test]
fn a_display_that_disconnects_is_one_error_and_the_flight_goes_on() {
    in_display("a_display_that_disconnects_is_one_error_and_the_flight_goes_on", |display| {
        let mut flight = flight("hover");
        let mut viewer = Viewer::open(flight.env(), options("disconnected")).unwrap();
        status(&viewer, "an image", |status| status.images > 0);
        display.kill_server();
        let disconnected = wait_until("the loss", || {
            flight.step().unwrap();
            if flight.is_over() {
                flight.restart(None).unwrap();
            }
            std::thread::sleep(Duration::from_millis(5));
            viewer.sync(flight.env()).err()
        });
        assert_eq!(disconnected, ViewerError::Disconnected);
        assert_eq!(viewer.sync(flight.env()), Ok(false));
        let again = Viewer::open(flight.env(), options("again")).map(|_| ()).unwrap_err();
        assert_eq!(again, ViewerError::Disconnected);
    });
}

/// A process without a display has an error that names it. The server has ended before the window opens.
#[test]
fn without_a_display_the_error_names_the_display() {
    in_display("without_a_display_the_error_names_the_display", |display| {
        display.kill_server();
        let error = Viewer::open(flight("hover").env(), options("none")).map(|_| ()).unwrap_err();
        assert!(matches!(error, ViewerError::NoDisplay { .. }), "{error:?}");
        let text = error.to_string();
        assert!(text.contains("DISPLAY") && !text.contains(".rs") && !text.contains('\n'), "{text}");
        // the second attempt has the same answer
        assert_eq!(Viewer::open(flight("hover").env(), options("none")).map(|_| ()).unwrap_err(), error);
    });
}

#[test]
fn images_and_animations_of_the_window_are_saved() {
    in_display("images_and_animations_of_the_window_are_saved", |display| {
        let directory = tempfile::tempdir().unwrap();
        let mut flight = flight("hover");
        let output = directory.path().join("saved");
        let options = ViewerOptions { output: output.clone(), ..options("save") };
        let mut viewer = Viewer::open(flight.env(), options).unwrap();
        let window = display.windows("save", 1)[0];
        display.focus(window);
        display.text("pr");
        status(&viewer, "a recording", |status| status.is_recording);
        for _ in 0..20 {
            flight.step().unwrap();
            viewer.sync(flight.env()).unwrap();
            std::thread::sleep(Duration::from_millis(20));
        }
        display.text("r");
        status(&viewer, "the end of the recording", |status| !status.is_recording);
        let png = wait_until("the image", || std::fs::read(output.join("hover-001.png")).ok());
        assert!(png.starts_with(b"\x89PNG"));
        // width and height of the image
        assert_eq!(png[16..24], [0, 0, 3, 32, 0, 0, 2, 88]);
        let gif = std::fs::read(output.join("hover-001.gif")).unwrap();
        assert!(gif.starts_with(b"GIF89a") && gif.ends_with(b";") && gif[6..10] == [32, 3, 88, 2]);
    });
}

/// The tests above pass without a display server; this one shows that they have run where it is installed.
#[test]
fn xvfb_answers_where_it_is_installed() {
    if let Some(server) = Server::start() {
        assert!(server.name.starts_with(':') && server.name.len() > 1);
    }
}
