//! Arithmetic of [`flight::math`], its type for SIMD registers, and conversions from and to nalgebra.

mod convert;
mod pack;

pub(crate) use convert::{ToFlight, ToNalgebra, Weighted};
pub(crate) use flight::math::{
    Bits, Double, MAX_HALF_ANGLE_SQUARED, Real, Turn, V3, clamped, exp_of_negative, finite_zero, ln, polynomial,
    sin_cos, wrap_angle,
};
pub(crate) use pack::{LANES, Pack, PackBits, Row};
