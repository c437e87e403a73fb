/// Error of the window.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ViewerError {
    /// Neither an X11 nor a Wayland display can be used.
    #[error(
        "no window can be opened: {reason}; the window needs a display: set DISPLAY or WAYLAND_DISPLAY, for example \
         with `xvfb-run`"
    )]
    NoDisplay {
        /// Answer of the display libraries.
        reason: String,
    },
    /// The display offers no OpenGL.
    #[error(
        "no window can be opened: the display has no OpenGL ({reason}); fix: apt-get install libegl1 libgl1-mesa-dri"
    )]
    NoGl {
        /// Answer of EGL.
        reason: String,
    },
    /// The connection to the display ended. The process cannot open another window.
    #[error("the connection to the display ended")]
    Disconnected,
    /// MuJoCo cannot draw the scene.
    #[error("the window cannot draw the scene: {reason}")]
    Scene {
        /// Message of MuJoCo or of OpenGL.
        reason: String,
    },
    /// The animation that the window was recording when it was closed cannot be completed.
    #[error("the animation of the window is not complete: {reason}")]
    Recording {
        /// File, and the error of the system or of the encoder.
        reason: String,
    },
    /// The process is a fork of the one that opened the first window.
    #[error("a forked process cannot use the window of its parent; open the window in the process that draws")]
    Forked,
}

impl ViewerError {
    /// Debian packages of the libraries that the window loads.
    pub const PACKAGES: &'static str =
        "libegl1 libgl1-mesa-dri libx11-6 libx11-xcb1 libxcursor1 libxi6 libxkbcommon-x11-0";

    /// Creates the error of a display that cannot be used, from the message of winit.
    pub(crate) fn no_display(message: &str) -> Self {
        // without the place in the source of winit
        let reason = message.split_once(".rs:").and_then(|(_, rest)| rest.split_once(": "));
        let reason = reason.map_or(message, |(_, reason)| reason).trim_end_matches('.');
        let fix = if reason.to_lowercase().contains("library") {
            format!(" (fix: apt-get install {})", Self::PACKAGES)
        } else {
            String::new()
        };
        Self::NoDisplay { reason: reason.to_owned() + &fix }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_of_the_display_name_the_cause_and_the_fix() {
        let error =
            ViewerError::no_display("os error at /root/winit/mod.rs:788: Failed to open connection to X server.");
        let text = error.to_string();
        assert!(text.contains("opened: Failed to open connection to X server;"), "{text}");
        assert!(!text.contains(".rs"), "{text}");
        let text = ViewerError::no_display("Library loading error: libXcursor.so.1").to_string();
        assert!(text.contains("libXcursor.so.1 (fix: apt-get install") && text.contains("libxcursor1"), "{text}");
    }
}
