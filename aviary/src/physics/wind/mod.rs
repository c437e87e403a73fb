//! Wind: forces of moving air on the airframe, and the velocity of the air that blades meet
//! (*MuJoCo-Drones-Gym*, Tayal, §3.5.1).
//!
//! The steady wind and the turbulence are velocities of one air mass. They are added, and one drag law acts on the velocity of
//! the drone relative to the sum. Gusts and the sinusoidal wind are forces and are added to that of the drag law.

mod config;
mod dryden;
mod field;

pub use config::{WindConfig, WindModel};
pub use dryden::{DrydenFilter, dryden};
pub use field::{WindField, drag_law};
