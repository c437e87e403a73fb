use crate::backend::GlBackend;
use crate::id::ObjectKind;

/// What can go wrong between a caller and MuJoCo.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The library that is loaded is not the one that the headers describe.
    #[error("MuJoCo {} is loaded, but this program was built for {}", dotted(.found), dotted(.expected))]
    Version {
        /// Version of the library.
        found: [u32; 3],
        /// Version of the headers.
        expected: [u32; 3],
    },
    /// A scene did not parse or compile; the message is MuJoCo's own, with line and column where it gives them.
    #[error("{source_name}: {message}")]
    Load {
        /// The file, or a name for text in memory.
        source_name: String,
        /// MuJoCo's message, on one line.
        message: String,
    },
    /// An in-memory asset that MuJoCo cannot take.
    #[error("asset `{name}`: {reason}")]
    Asset {
        /// The asset's file name.
        name: String,
        /// Why not.
        reason: String,
    },
    /// MuJoCo raised an error (`mju_error`) inside a call. The [`Data`](crate::Data) must be reset before it is used
    /// again; until then its calls return this error.
    #[error("MuJoCo's {call}: {message}")]
    Raised {
        /// The function that was called.
        call: &'static str,
        /// MuJoCo's message.
        message: String,
    },
    /// The simulation diverged; MuJoCo has already put it back to its initial state, or one step on from it.
    #[error(transparent)]
    Diverged(Divergence),
    /// No object of that kind has that name.
    #[error("no {kind} named `{name}` in the model")]
    UnknownName {
        /// Kind of object.
        kind: ObjectKind,
        /// The name looked for.
        name: String,
    },
    /// A value that MuJoCo cannot work with.
    #[error("{what} is {got}, expected {expected}")]
    Value {
        /// What it is of.
        what: &'static str,
        /// What was given.
        got: f64,
        /// What is possible.
        expected: &'static str,
    },
    /// An id that is not of this model.
    #[error("{kind} {index} is not of this model, which has {count}")]
    NotOfModel {
        /// Kind of object.
        kind: ObjectKind,
        /// The index.
        index: usize,
        /// How many there are.
        count: usize,
    },
    /// A simulation, scene and renderer that are not of the same model.
    #[error("the simulation, the scene and the renderer are not of the same model")]
    OtherModel,
    /// A scene that has not been looked at by a camera yet.
    #[error("the scene has not been updated, so that there is no camera to draw it from")]
    NoCamera,
    /// Segmentation asked of a renderer that mixes colours.
    #[error("segmentation needs a renderer with one sample per pixel")]
    Multisampled,
    /// A buffer of the wrong length.
    #[error("the {what} buffer has {got} entries, expected {expected}")]
    Buffer {
        /// What it is for.
        what: &'static str,
        /// Its length.
        got: usize,
        /// The length for the size asked for.
        expected: usize,
    },
    /// No OpenGL context can be made on this machine.
    #[error("no OpenGL to draw with: {}; install it with `apt-get install {}`", answers(.attempts), packages(.attempts))]
    NoGl {
        /// What was tried and what it answered.
        attempts: Vec<GlAttempt>,
    },
    /// `MUJOCO_GL` names nothing that is known.
    #[error("MUJOCO_GL is `{got}`, expected egl or osmesa, or unset to try both")]
    GlName {
        /// Its value.
        got: String,
    },
    /// `MUJOCO_EGL_DEVICE_ID` names no device.
    #[error("MUJOCO_EGL_DEVICE_ID is `{got}`, expected {expected}")]
    GlDevice {
        /// Its value.
        got: String,
        /// What is possible.
        expected: String,
    },
    /// OpenGL failed after it had worked.
    #[error("OpenGL: {message}")]
    Gl {
        /// What it answered.
        message: String,
    },
    /// A string with a zero byte, which C cannot read.
    #[error("the {what} holds a zero byte")]
    Nul {
        /// What the string is.
        what: &'static str,
    },
}

/// One way to OpenGL that was tried in vain.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GlAttempt {
    /// The library.
    pub backend: GlBackend,
    /// What it answered.
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

/// Which quantity stopped being a number, or grew past MuJoCo's limit of 1e10.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DivergedQuantity {
    /// `qpos`.
    Position,
    /// `qvel`.
    Velocity,
    /// `qacc`.
    Acceleration,
}

/// A simulation that left the range of numbers MuJoCo works with.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[error("the simulation diverged at t = {time} s: {} {index} is not finite or exceeds 1e10", match .quantity {
    DivergedQuantity::Position => "position coordinate",
    DivergedQuantity::Velocity => "velocity of degree of freedom",
    DivergedQuantity::Acceleration => "acceleration of degree of freedom",
})]
pub struct Divergence {
    /// The quantity.
    pub quantity: DivergedQuantity,
    /// Index into `qpos` for positions, otherwise into `qvel`.
    pub index: usize,
    /// Time of the step's start, s.
    pub time: f64,
}
