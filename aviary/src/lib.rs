//! The simulator: quadrotors on MuJoCo.
//!
//! ```text
//! action -> controller -> motor speeds -> rotors -> wrench -> engine -> state -> observation -> task -> reward
//! ```
//!
//! [`Simulation`](simulation::Simulation) is N drones in one world; an [`Env`](env::Env) is a task on top of it.
//! SI units everywhere, rotor speeds in rpm where the name says so; frames are documented at every field.

pub mod drone;
pub mod state;
pub mod world;

pub mod control;
pub mod physics;

mod error;
