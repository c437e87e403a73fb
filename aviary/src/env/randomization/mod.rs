//! Randomization: parameters that are sampled for every episode.

mod ranges;
mod sampling;
mod sensors;

pub use ranges::{
    ActuatorRanges, AerodynamicRanges, AirframeRanges, BatteryRanges, BodyRanges, EnvironmentRanges, InitialRanges,
    Randomization, Range, SensorRanges,
};
pub(crate) use sampling::Randomizer;
pub use sampling::{SampledDroneParams, SampledParams};
pub(crate) use sensors::{Sensed, SensorLanes};
