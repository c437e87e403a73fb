//! Wind: forces on the airframe and the velocity of the air at the blades (*MuJoCo-Drones-Gym*, Tayal, §3.5.1).
//!
//! The constant wind and the turbulence are velocities of one air mass. The wind adds them and applies one drag law
//! to the velocity of the air relative to the drone. Gusts and the sinusoidal wind are forces, which the wind adds to
//! the drag.

mod config;
mod dryden;
mod field;
mod lanes;

pub use config::{WindConfig, WindModel};
pub use dryden::DrydenFilter;
pub use field::{WindField, drag_law};
pub use flight::wind::dryden;
pub(crate) use lanes::{MovingWind, WindLanes};
