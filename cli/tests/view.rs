//! Windows of the program on a display without a screen. The tests pass without Xvfb.

use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

mod common;
#[path = "../../viewer/tests/support/mod.rs"]
mod support;

use common::{
    Running, assert_equal_files, directory, pretrained, run, send, text, wait_for_rows, wait_while, write_script,
};
use support::{Display, Server};

/// Options of a short flight.
const HOVER: [&str; 6] = ["--task", "hover", "--duration", "2", "--seed", "1"];

/// Options of a short training.
const SHORT: [&str; 8] = ["--task", "hover", "--envs", "64", "--steps", "204800", "--seed", "3"];

/// Files of a training that do not depend on the speed of the machine.
const TRAINED: [&str; 4] = ["policy.safetensors", "checkpoint.safetensors", "curve.csv", "curve.svg"];

/// Returns the program with default handlers of signals and a display; without a name, without any display.
fn program(display: Option<&str>, arguments: &[&str]) -> Command {
    let mut command = Command::new("env");
    command.args(["--default-signal", env!("CARGO_BIN_EXE_aviary")]).args(arguments);
    for variable in ["DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET", "RUST_LOG"] {
        command.env_remove(variable);
    }
    command.envs(display.map(|name| ("DISPLAY", name))).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

fn start(server: &Server, arguments: &[&str]) -> Running {
    Running::start(&mut program(Some(&server.name), arguments))
}

/// Starts an X server; prints that the test is skipped if there is none.
fn server(test: &str) -> Option<Server> {
    let server = Server::start();
    if server.is_none() {
        let _ = writeln!(std::io::stderr(), "{test}: skipped, because Xvfb is not installed");
    }
    server
}

/// Waits for the end of the program, at most a minute.
fn ended(mut program: Running) -> Output {
    let start = Instant::now();
    while program.try_wait().unwrap().is_none() {
        assert!(start.elapsed() < Duration::from_secs(60), "the program does not end");
        std::thread::sleep(Duration::from_millis(10));
    }
    program.output()
}

/// Asserts that the program ends with this status and these lines on standard error. Returns the standard output.
fn ends(program: Running, status: i32, errors: &[&str]) -> String {
    let output = ended(program);
    let error = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(status), "{error}");
    assert_eq!(error.lines().count(), errors.len(), "{error}");
    for (line, text) in error.lines().zip(errors) {
        assert!(line.contains(text), "{error}");
    }
    String::from_utf8(output.stdout).unwrap()
}

/// Longest time from a visible window to the flight in it. A display that ends earlier is an error.
const OPENING: Duration = Duration::from_millis(700);

/// Warning about a display that ended.
const LOST: &str = "the connection to the display ended";

#[test]
fn a_window_without_a_display_is_an_error_of_one_line() {
    let flown = directory("view-none-flown");
    run(&[&["fly", "--out", text(&flown)][..], &HOVER].concat());
    let (scenario, again, trained) = (flown.join("scenario.toml"), flown.join("again.csv"), directory("view-none"));
    let replay = ["replay", "--scenario", text(&scenario), "--actions", text(&flown), "--out", text(&again), "--view"];
    let play = ["play", "--policy", &pretrained("hover"), "--episodes", "1", "--view"];
    let train = [&["train", "--out", text(&trained), "--view"][..], &SHORT].concat();
    for arguments in
        [&[&["fly", "--view"][..], &HOVER].concat()[..], &[&["view"][..], &HOVER].concat(), &replay, &play, &train]
    {
        for display in [None, Some(":9999")] {
            let program = Running::start(&mut program(display, arguments));
            // also `play` looks for the display before its evaluation
            assert_eq!(ends(program, 1, &["no window can be opened"]), "");
        }
    }
    assert!(!again.exists(), "an incomplete file");
    assert_eq!(common::entries(&trained), 0, "the next training may use the directory");
}

#[test]
fn a_watched_flight_has_the_files_of_a_flight_without_a_window() {
    let Some(mut server) = server("a_watched_flight_has_the_files_of_a_flight_without_a_window") else { return };
    let flown = ["none", "seen", "cut"].map(|name| directory(&format!("view-fly-{name}")));
    let [none, seen, cut] = &flown;
    let fly = |out: &PathBuf| -> Vec<String> {
        [&["fly", "--out", text(out)][..], &HOVER].concat().iter().map(ToString::to_string).collect()
    };
    let watched = |server: &Server, out: &PathBuf| {
        let arguments = [fly(out), vec!["--view".into()]].concat();
        start(server, &arguments.iter().map(String::as_str).collect::<Vec<_>>())
    };
    run(&fly(none).iter().map(String::as_str).collect::<Vec<_>>());
    let printed = ends(watched(&server, seen), 0, &[]);
    assert!(printed.contains("final position error"), "{printed}");
    let mut program = watched(&server, cut);
    wait_for_rows(cut, &mut program, 5);
    server.kill();
    ends(program, 0, &[LOST]);
    for out in [seen, cut] {
        assert_equal_files(none, out, &["drone0.csv", "scenario.toml", "summary.json"]);
    }
}

#[test]
fn a_watched_replay_has_the_file_of_a_replay_without_a_window() {
    let Some(mut server) = server("a_watched_replay_has_the_file_of_a_replay_without_a_window") else { return };
    let dir = directory("view-replay");
    run(&[&["fly", "--out", text(&dir)][..], &HOVER].concat());
    let (scenario, plain) = (dir.join("scenario.toml"), dir.join("plain.csv"));
    let replay = ["replay", "--scenario", text(&scenario), "--actions", text(&dir), "--out"];
    run(&[&replay[..], &[text(&plain)]].concat());
    let expected = std::fs::read(&plain).unwrap();
    let watched = |server: &Server, out: &Path| start(server, &[&replay[..], &[text(out), "--view"]].concat());
    let same = |out: &Path| assert!(std::fs::read(out).unwrap() == expected, "{}", out.display());
    let title = "aviary: replay of scenario.toml";

    let (seen, closed, cut) = (dir.join("seen.csv"), dir.join("closed.csv"), dir.join("cut.csv"));
    let begin = Instant::now();
    let printed = ends(watched(&server, &seen), 0, &[]);
    assert!(begin.elapsed() > Duration::from_millis(1900), "the flight of 2 s is shown in real time");
    assert!(printed.contains("control steps"), "{printed}");
    same(&seen);
    let program = watched(&server, &closed);
    let display = Display::connect(&server.name);
    display.close(display.windows(title, 1)[0]);
    ends(program, 0, &[]);
    same(&closed);
    let program = watched(&server, &cut);
    display.windows(title, 1);
    std::thread::sleep(OPENING);
    server.kill();
    ends(program, 0, &[LOST]);
    same(&cut);
}

#[test]
fn the_close_button_ends_a_view_with_its_results() {
    let Some(server) = server("the_close_button_ends_a_view_with_its_results") else { return };
    let dir = directory("view-closed");
    let mut program = start(&server, &[&["view", "--out", text(&dir)][..], &HOVER].concat());
    let display = Display::connect(&server.name);
    let window = display.windows("aviary: hover with cf2x", 1)[0];
    // the whole episode, after which the window stays open
    wait_for_rows(&dir, &mut program, 97);
    display.close(window);
    let printed = ends(program, 0, &[]);
    assert!(printed.contains("final position error"), "{printed}");
    // nobody has changed the flight
    let plain = directory("view-closed-plain");
    run(&[&["fly", "--out", text(&plain)][..], &HOVER].concat());
    assert_equal_files(&plain, &dir, &["drone0.csv", "scenario.toml"]);
}

#[test]
fn an_animation_of_the_window_that_cannot_be_saved_is_an_error() {
    /// Key symbol of the left shift key.
    const SHIFT: u32 = 0xffe1;
    let Some(server) = server("an_animation_of_the_window_that_cannot_be_saved_is_an_error") else { return };
    let (dir, programs) = (directory("view-unsaved"), directory("view-unsaved-programs"));
    let encoder = programs.join("ffmpeg");
    write_script(&encoder, "touch \"$0.started\"; cat > /dev/null; echo 'the disk is full' >&2; exit 1");
    let arguments = [&["view", "--out", text(&dir)][..], &HOVER].concat();
    let path = format!("{}:{}", text(&programs), std::env::var("PATH").unwrap());
    let mut program = Running::start(program(Some(&server.name), &arguments).env("PATH", path));
    let display = Display::connect(&server.name);
    let window = display.windows("aviary: hover with cf2x", 1)[0];
    display.focus(window);
    display.key_down(SHIFT);
    display.text("r");
    display.key_up(SHIFT);
    wait_while(&mut program, || !programs.join("ffmpeg.started").exists());
    display.close(window);
    let printed = ends(program, 1, &["error: the animation of the window is not complete: "]);
    assert!(printed.contains("final position error"), "{printed}");
}

#[test]
fn an_interrupted_view_ends_at_once_and_leaves_its_log() {
    let Some(server) = server("an_interrupted_view_ends_at_once_and_leaves_its_log") else { return };
    let dir = directory("view-interrupted");
    let mut program = start(&server, &["view", "--task", "hover", "--out", text(&dir)]);
    wait_for_rows(&dir, &mut program, 20);
    send("-INT", &program);
    let sent = Instant::now();
    ends(program, 130, &[]);
    assert!(sent.elapsed() < Duration::from_secs(2), "{:?}", sent.elapsed());
    let log = std::fs::read_to_string(dir.join("drone0.csv")).unwrap();
    assert!(log.ends_with('\n'));
    assert!(aviary::record::Flight::read(&dir).unwrap().drones[0].len() >= 20);
}

#[test]
fn a_policy_flies_in_a_window_after_its_evaluation() {
    let Some(mut server) = server("a_policy_flies_in_a_window_after_its_evaluation") else { return };
    let policy = pretrained("hover");
    let play = ["play", "--policy", &policy, "--episodes", "2", "--duration", "2"];
    let expected = run(&play);
    let watched = |server: &Server| start(server, &[&play[..], &["--view"]].concat());
    let title = "aviary: hover with a policy";

    let program = watched(&server);
    let display = Display::connect(&server.name);
    let window = display.windows(title, 1)[0];
    display.focus(window);
    display.text("n");
    // after the end of the episode, the window stays open
    std::thread::sleep(Duration::from_millis(2500));
    display.close(display.windows(title, 1)[0]);
    assert_eq!(ends(program, 0, &[]), expected);

    let program = watched(&server);
    display.windows(title, 1);
    std::thread::sleep(OPENING);
    server.kill();
    assert_eq!(ends(program, 0, &[LOST]), expected);
}

#[test]
fn a_watched_training_has_the_results_of_a_training_without_a_window() {
    let Some(mut server) = server("a_watched_training_has_the_results_of_a_training_without_a_window") else { return };
    let flown = ["none", "seen", "closed", "cut"].map(|name| directory(&format!("view-train-{name}")));
    let [none, seen, closed, cut] = &flown;
    run(&[&["train", "--json", "--out", text(none)][..], &SHORT].concat());
    let watched = |server: &Server, out: &Path| {
        start(server, &[&["train", "--json", "--view", "--out", text(out)][..], &SHORT].concat())
    };
    let title = "aviary: hover with a policy";
    ends(watched(&server, seen), 0, &[]);
    let program = watched(&server, closed);
    let display = Display::connect(&server.name);
    display.close(display.windows(title, 1)[0]);
    ends(program, 0, &[]);
    let program = watched(&server, cut);
    display.windows(title, 1);
    std::thread::sleep(OPENING);
    server.kill();
    ends(program, 0, &[LOST]);
    for out in [seen, closed, cut] {
        assert_equal_files(none, out, &TRAINED);
    }
}

#[test]
fn a_window_shows_one_training() {
    for other in [&["--all"][..], &["--task", "hover", "--show"]] {
        common::refused(&[&["train", "--view"][..], other].concat(), 2, &["--view"]);
    }
}
