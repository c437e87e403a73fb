//! Randomization: parameters that are sampled for every episode.

mod ranges;
mod sampling;

pub use ranges::{
    ActuatorRanges, AerodynamicRanges, BodyRanges, EnvironmentRanges, InitialRanges, Randomization, Range, SensorRanges,
};
pub(super) use sampling::Randomizer;
pub use sampling::{SampledDroneParams, SampledParams};
