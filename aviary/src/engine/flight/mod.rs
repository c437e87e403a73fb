//! Flight kernel: MuJoCo's RK4 for free bodies, implemented without MuJoCo.
//!
//! A drone without contacts is a free rigid body under forces that are constant during a physics step; with
//! body-fixed forcing the rotors' wrench rotates with the body. MuJoCo's fluid forces act if the medium is on. The
//! equations of motion ([`FreeBody::step`]) are those of the crate `flight`, generic over scalars and SIMD registers.
//! [`Lanes`] hold eight drones as a structure of arrays; the kernel advances as many of them at once as the
//! instruction set allows. The results are bit-identical for all instruction sets.
//!
//! The module `floor` computes a step of drones that touch the floor, as `mj_step` does.

mod body;
mod commands;
mod contact_solver;
mod floor;
mod floor_model;
mod kernel;
mod lanes;
mod reach_bound;
mod width;

pub use body::FreeBody;
pub(crate) use commands::{Decoding, advance_batteries, set_commands};
pub(super) use floor::{FloorKernel, StepKind};
pub(super) use floor_model::FloorModel;
pub(crate) use kernel::{Extras, LateCommands, Record, advance_with, find_apart};
pub use kernel::{Flow, advance, compute_downwash, compute_rpys, find_clear};
pub(crate) use lanes::Part;
pub use lanes::{Airframe, LANES, LaneParams, Lanes};
pub(crate) use reach_bound::DrivenBound;
pub use reach_bound::ReachBound;
pub use width::Width;
