//! The simulator: quadrotors on MuJoCo.
//!
//! ```text
//! action -> controller -> motor speeds -> rotors -> wrench -> engine -> state -> observation -> task -> reward
//! ```
//!
//! [`Simulation`](simulation::Simulation) is N drones in one world; an [`Env`](env::Env) is a task on top of it.
//! SI units everywhere, rotor speeds in rpm where the name says so; frames are documented at every field.
//!
//! A module uses only modules above it in this list.

pub mod drone;
mod math;
mod names;
mod random;
mod serial;
pub mod state;
pub mod world;

pub mod control;

pub mod action;
pub mod physics;

pub mod engine;
pub mod simulation;

pub mod sensing;
pub mod vision;

pub mod observation;

pub mod env;
pub mod tasks;

pub mod multi_agent;
pub mod wrappers;

pub mod vector;

pub mod policy;
pub mod rollout;

pub mod record;

mod error;

pub use error::{OptionError, SystemError, count, did_you_mean, number, toml_message, without_byte_order_mark};
pub use names::{NamedEnum, UnknownName};
