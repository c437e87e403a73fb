//! Wind: forces on the airframe and the velocity of the air at the blades (§3.5.1 of the paper).
//!
//! The constant wind and the turbulence are velocities of one air mass. The wind adds them and applies one drag law
//! to the velocity of the air relative to the drone. Gusts and the sinusoidal wind are forces, which the wind adds to
//! the drag.

mod dryden;
mod local;

pub use dryden::{SIGMA_OF_WIND, dryden, max_speed};
pub use local::{WindParams, WindParts, WindState};
