//! Equations of the flight of quadrotors, after *MuJoCo-Drones-Gym* (Tayal), called "the paper" in this crate.
//!
//! Every equation is written once and generic over the type of its numbers ([`math::Real`]): a double, a SIMD register
//! of doubles, or a value of a kernel that is being built for a GPU. The crate has no dependencies, and its types are
//! plain numbers. Conversions from the parameters and the states of a simulator are the simulator's.
//!
//! All quantities are in SI units, except rotor speeds in rpm where the name contains `rpm`. The world frame has x
//! forward, y left and z up. The body frame has the same axes and is fixed to the airframe.
//!
//! Functions of a physics step are `inline(always)` and have no closures that the compiler might not inline: a caller
//! that compiles for an instruction set needs their code in its own functions.

pub mod math;
pub mod random;
pub mod state;

pub mod airframe;
pub mod body;
pub mod clearance;
pub mod downwash;
pub mod drag;
pub mod ground_effect;
pub mod motors;
pub mod rotor;
pub mod sensors;
pub mod tasks;
pub mod wind;

#[cfg(test)]
mod tests;
