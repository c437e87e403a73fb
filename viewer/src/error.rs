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
    #[error("the connection to the display was lost")]
    DisplayLost,
    /// MuJoCo cannot draw the scene.
    #[error("the window cannot draw the scene: {reason}")]
    Scene {
        /// Message of MuJoCo or of OpenGL.
        reason: String,
    },
    /// The process is a fork of the one that opened the first window.
    #[error("a forked process cannot use the window of its parent; open the window in the process that draws")]
    Forked,
}
