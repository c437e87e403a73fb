//! Safe models and simulations of MuJoCo 2.2.
//!
//! A [`Model`] is compiled once from MJCF text and shared between threads; a [`Data`] holds one simulation of it.
//! Every array of `mjModel` and `mjData` is a slice of the right length. MuJoCo's errors are values of [`Error`]
//! with MuJoCo's message. No public type of this crate exposes a pointer.
//!
//! ```
//! use mujoco_rs::{BodyId, Data, Model};
//!
//! let model = Model::from_xml(
//!     "<mujoco><worldbody><body name='ball' pos='0 0 1'><freejoint/><geom size='.1'/></body></worldbody></mujoco>",
//! )?;
//! let ball: BodyId = model.find("ball")?;
//! let mut data = Data::new(model)?;
//! while data.time() < 0.1 {
//!     data.step()?;
//! }
//! let height = data.xpos()[3 * ball.index() + 2];
//! assert!(height < 1.0);
//! # Ok::<(), mujoco_rs::Error>(())
//! ```
//!
//! This crate contains all unsafe code for MuJoCo and OpenGL, and no drone-specific code.
#![allow(unsafe_code)]

mod arrays;
mod backend;
mod contact;
mod data;
mod error;
mod gl;
mod id;
mod limits;
mod mesh;
mod mjcf;
mod model;
mod renderer;
mod runtime;
mod scene;

pub use backend::GlBackend;
pub use contact::Contact;
pub use data::{Data, WarningKind, WarningStat};
pub use error::{DivergedQuantity, Divergence, Error, GlAttempt};
pub use gl::{GlInfo, gl_info};
pub use id::{
    ActuatorId, BodyId, CameraId, GeomId, JointId, LightId, MaterialId, MeshId, ObjectId, ObjectKind, SensorId, SiteId,
    TextureId,
};
pub use model::{Assets, ConstraintOptions, Integrator, Model, ModelMut};
pub use renderer::{ImageSize, Quality, Renderer, RendererContext};
pub use runtime::{HEADER_VERSION, check_library, library_version};
pub use scene::{Camera, Decor, Scene, VisualEffects};

#[doc(hidden)]
pub mod testing {
    //! Helpers for this crate's tests.
    pub use crate::model::load_unchecked;
    pub use crate::runtime::{assert_host_is_left_alone, raise};
}
