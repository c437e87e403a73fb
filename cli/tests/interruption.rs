//! Programs that a signal ends.

use std::process::Command;

mod common;

use common::{Running, directory, has_gl, send, spawn, text, wait_for_rows};

#[test]
fn an_interrupted_flight_leaves_its_log_and_nothing_else() {
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
        assert!(dir.join("scenario.toml").exists(), "what it takes to fly the log again");
        assert_eq!(std::fs::read_dir(&dir).unwrap().count(), 2);
        assert!(aviary::record::Flight::read(&dir).unwrap().drones[0].len() >= 200);
    }
}

#[test]
fn an_interrupted_capture_or_film_leaves_no_half_of_a_file() {
    if !has_gl() {
        return;
    }
    for (signal, status) in [("-INT", 130), ("-HUP", 129), ("-XCPU", 152)] {
        let dir = directory(&format!("interrupted-film{signal}"));
        std::fs::create_dir_all(&dir).unwrap();
        let mut child =
            spawn(&["fly", "--task", "hover", "--duration", "100000", "--gif", text(&dir.join("hover.gif"))]);
        while std::fs::read_dir(&dir).unwrap().count() == 0 {
            assert!(child.try_wait().unwrap().is_none(), "it has ended by itself");
            std::thread::sleep(std::time::Duration::from_millis(10));
        }
        std::thread::sleep(std::time::Duration::from_millis(100));
        send(signal, &child);
        assert_eq!(child.wait().unwrap().code(), Some(status));
        assert_eq!(std::fs::read_dir(&dir).unwrap().count(), 0, "{signal}");
    }
}

#[test]
fn a_hangup_that_nohup_ignores_ends_nothing() {
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
