//! Selection of the OpenGL library by `MUJOCO_GL`. The library is final for a process, so that every case runs in a
//! process of its own.

use std::process::Command;

use mujoco_rs::{Error, gl_info};

const CHILD: &str = "MUJOCO_RS_TEST_SELECTION";

/// Runs a test of this file again, in a child process with a value of `MUJOCO_GL`. Returns true in the child.
fn is_child_with(test: &str, value: Option<&str>) -> bool {
    if std::env::var_os(CHILD).is_some() {
        return true;
    }
    let mut command = Command::new(std::env::current_exe().unwrap());
    command.args(["--exact", test]).env(CHILD, "1").env_remove("MUJOCO_GL");
    if let Some(value) = value {
        command.env("MUJOCO_GL", value);
    }
    let output = command.output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stdout));
    false
}

/// A value of `MUJOCO_GL` that MuJoCo does not know is an error that names both libraries.
#[test]
fn an_unknown_backend_is_an_error_with_the_accepted_names() {
    if is_child_with("an_unknown_backend_is_an_error_with_the_accepted_names", Some("vulkan")) {
        let error = gl_info().unwrap_err();
        assert_eq!(error, Error::GlName { got: "vulkan".into() });
        assert!(error.to_string().contains("egl or osmesa"));
    }
}

/// `glfw` is the window of MuJoCo's viewer: images without a window are rendered as if the variable were unset.
#[test]
fn the_viewers_choice_does_not_prevent_images() {
    const TEST: &str = "the_viewers_choice_does_not_prevent_images";
    if is_child_with(TEST, Some("glfw")) {
        let outcome = gl_info();
        assert!(matches!(outcome, Ok(_) | Err(Error::NoGl { .. })), "{outcome:?}");
    }
}
