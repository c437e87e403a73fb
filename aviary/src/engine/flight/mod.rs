//! The flight kernel: MuJoCo's RK4 over free bodies, restated without MuJoCo.
//!
//! A drone that touches nothing is a free rigid body under a wrench that is constant through a physics step (or whose
//! rotors turn with the body), and MuJoCo's fluid forces where the medium is on. Its equations are written once
//! ([`FreeBody::step`]), in numbers that are one double or a register of them: [`Lanes`] hold many drones number by number,
//! and are advanced as many at once as the machine can, to the same bits.

mod body;
mod lanes;
mod reach_bound;
mod width;

pub use body::FreeBody;
pub use lanes::{Airframe, Flow, LANES, LaneParams, Lanes, advance, compute_downwash, compute_rpys, find_clear};
pub use reach_bound::ReachBound;
pub use width::Width;
