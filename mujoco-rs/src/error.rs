use crate::backend::GlBackend;
use crate::id::ObjectKind;

/// Errors of this crate.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The version of the loaded library differs from that of the headers.
    #[error("MuJoCo {} is loaded, but this program was built for {}", dotted(.found), dotted(.expected))]
    Version {
        /// Version of the library.
        found: [u32; 3],
        /// Version of the headers.
        expected: [u32; 3],
    },
    /// A scene did not parse or compile; the message has line and column if MuJoCo reports them.
    #[error("{source_name}: {message}")]
    Load {
        /// Path of the file, or a placeholder for text in memory.
        source_name: String,
        /// MuJoCo's message, on one line.
        message: String,
    },
    /// An in-memory asset is invalid.
    #[error("asset `{name}`: {reason}")]
    Asset {
        /// File name of the asset.
        name: String,
        /// Reason for the rejection.
        reason: String,
    },
    /// MuJoCo raised an error (`mju_error`) inside a call. Calls on the [`Data`](crate::Data) return this error
    /// until it is reset.
    #[error("MuJoCo's {call}: {message}")]
    Raised {
        /// MuJoCo function that was called.
        call: &'static str,
        /// MuJoCo's message.
        message: String,
    },
    /// The simulation diverged; MuJoCo has reset it to its initial state (and may have advanced it by one step
    /// since).
    #[error(transparent)]
    Diverged(Divergence),
    /// The model has no object of this kind and name.
    #[error("no {kind} named `{name}` in the model")]
    UnknownName {
        /// Kind of object.
        kind: ObjectKind,
        /// Requested name.
        name: String,
    },
    /// A value is outside MuJoCo's range.
    #[error("{what} is {got}, expected {expected}")]
    Value {
        /// Name of the quantity.
        what: &'static str,
        /// Given value.
        got: f64,
        /// Accepted values.
        expected: &'static str,
    },
    /// An id belongs to another model.
    #[error("{kind} {index} is not in this model, which has {count}")]
    NotOfModel {
        /// Kind of object.
        kind: ObjectKind,
        /// Index of the id.
        index: usize,
        /// Number of objects of this kind in the model.
        count: usize,
    },
    /// Simulation, scene and renderer belong to different models.
    #[error("the simulation, the scene and the renderer belong to different models")]
    OtherModel,
    /// A scene has no camera yet.
    #[error("the scene has no camera: call `update` first")]
    NoCamera,
    /// Segmentation requires a renderer without multisampling.
    #[error("segmentation needs a renderer with one sample per pixel")]
    Multisampled,
    /// A buffer has the wrong length.
    #[error("the {what} buffer has {got} entries, expected {expected}")]
    Buffer {
        /// Content of the buffer.
        what: &'static str,
        /// Given length.
        got: usize,
        /// Required length for the image size.
        expected: usize,
    },
    /// No OpenGL context can be created on this machine.
    #[error("no OpenGL available: {}; install it with `apt-get install {}`", answers(.attempts), packages(.attempts))]
    NoGl {
        /// Attempted backends with their answers.
        attempts: Vec<GlAttempt>,
    },
    /// `MUJOCO_GL` has an unknown value.
    #[error("MUJOCO_GL is `{got}`, expected egl or osmesa, or unset to try both")]
    GlName {
        /// Value of the variable.
        got: String,
    },
    /// `MUJOCO_EGL_DEVICE_ID` names no device.
    #[error("MUJOCO_EGL_DEVICE_ID is `{got}`, expected {expected}")]
    GlDevice {
        /// Value of the variable.
        got: String,
        /// Accepted values.
        expected: String,
    },
    /// OpenGL failed after successful initialization.
    #[error("OpenGL: {message}")]
    Gl {
        /// Message of OpenGL or its driver.
        message: String,
    },
    /// A string contains a zero byte, which terminates strings in C.
    #[error("the {what} holds a zero byte")]
    Nul {
        /// Content of the string.
        what: &'static str,
    },
}

/// Failed attempt to load an OpenGL library.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GlAttempt {
    /// Backend of the attempt.
    pub backend: GlBackend,
    /// Error message of the library.
    pub answer: String,
}

fn answers(attempts: &[GlAttempt]) -> String {
    attempts.iter().map(|attempt| format!("{}: {}", attempt.backend, attempt.answer)).collect::<Vec<_>>().join("; ")
}

fn packages(attempts: &[GlAttempt]) -> String {
    attempts.iter().map(|attempt| attempt.backend.packages()).collect::<Vec<_>>().join(" ")
}

fn dotted(version: &[u32; 3]) -> String {
    format!("{}.{}.{}", version[0], version[1], version[2])
}

/// Quantity that became non-finite or exceeded MuJoCo's limit of 1e10.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DivergedQuantity {
    /// Positions, `qpos`.
    Position,
    /// Velocities, `qvel`.
    Velocity,
    /// Accelerations, `qacc`.
    Acceleration,
}

/// Simulation whose state became non-finite or too large.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[error("the simulation diverged at t = {time} s: {} {index} is not finite or exceeds 1e10", match .quantity {
    DivergedQuantity::Position => "position coordinate",
    DivergedQuantity::Velocity => "velocity of degree of freedom",
    DivergedQuantity::Acceleration => "acceleration of degree of freedom",
})]
pub struct Divergence {
    /// Quantity that diverged.
    pub quantity: DivergedQuantity,
    /// Index into `qpos` for positions, otherwise into `qvel`.
    pub index: usize,
    /// Time at the start of the step, s.
    pub time: f64,
}
