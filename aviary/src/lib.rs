//! Simulator of quadrotor swarms on MuJoCo, after *MuJoCo-Drones-Gym* (Tayal), called "the paper" in this crate.
//!
//! ```text
//! action -> controller -> motor speeds -> rotors -> wrench -> engine -> state -> observation -> task -> reward
//! ```
//!
//! A [`Simulation`](simulation::Simulation) contains N drones in one world. An [`Env`](env::Env) adds a task with
//! actions, observations and rewards. All quantities are in SI units, except rotor speeds in rpm where the name
//! contains `rpm`. Each field documents its frame.
//!
//! A module depends only on the modules declared before it, except for the basic modules `names`, `math`, `state`,
//! `serial` and `error`.

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

pub mod flights;

mod error;

pub use error::{OptionError, SystemError, count, did_you_mean, number, toml_message, without_byte_order_mark};
pub use names::{NamedEnum, UnknownName};
