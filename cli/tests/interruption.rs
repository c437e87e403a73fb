//! Signals that end the program.

use std::process::Command;

mod common;

use common::{Running, directory, entries, has_gl, send, spawn, text, wait_for_rows, wait_while};

#[test]
fn an_interrupted_flight_leaves_its_log_and_scenario() {
    let signals = [
        ("-INT", Some(130)),
        ("-TERM", Some(143)),
        ("-HUP", Some(129)),
        ("-QUIT", Some(131)),
        ("-USR1", Some(138)),
        ("-KILL", None),
    ];
    for (signal, status) in signals {
        let dir = directory(&format!("interrupted{signal}"));
        let mut child = spawn(&["fly", "--task", "hover", "--duration", "100000", "--out", text(&dir)]);
        wait_for_rows(&dir, &mut child, 200);
        send(signal, &child);
        assert_eq!(child.wait().unwrap().code(), status, "{signal}");
        assert!(dir.join("scenario.toml").exists());
        assert_eq!(entries(&dir), 2);
        assert!(aviary::record::Flight::read(&dir).unwrap().drones[0].len() >= 200);
    }
}

#[test]
fn an_interrupted_animation_leaves_no_incomplete_file() {
    if !has_gl() {
        return;
    }
    for (signal, status) in [("-INT", 130), ("-HUP", 129), ("-XCPU", 152)] {
        let dir = directory(&format!("interrupted-animation{signal}"));
        std::fs::create_dir_all(&dir).unwrap();
        let mut child =
            spawn(&["fly", "--task", "hover", "--duration", "100000", "--gif", text(&dir.join("hover.gif"))]);
        wait_while(&mut child, || entries(&dir) == 0);
        std::thread::sleep(std::time::Duration::from_millis(100));
        send(signal, &child);
        assert_eq!(child.wait().unwrap().code(), Some(status));
        assert_eq!(entries(&dir), 0, "{signal}");
    }
}

#[test]
fn the_program_continues_after_a_hangup_under_nohup() {
    let dir = directory("nohup");
    let mut command = Command::new("sh");
    command.args(["-c", "trap '' HUP; exec \"$@\"", "sh", env!("CARGO_BIN_EXE_aviary")]);
    command.args(["fly", "--task", "hover", "--duration", "100000", "--out", text(&dir)]);
    let mut child = Running::start(&mut command);
    wait_for_rows(&dir, &mut child, 10);
    send("-HUP", &child);
    let rows = aviary::record::Flight::read(&dir).unwrap().drones[0].len();
    wait_for_rows(&dir, &mut child, rows + 1000);
    send("-TERM", &child);
    assert_eq!(child.wait().unwrap().code(), Some(143));
}
