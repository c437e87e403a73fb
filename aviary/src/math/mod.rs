//! Arithmetic that is generic over a double or a SIMD register of doubles ([`Real`]): vectors, rotations and
//! elementary functions.
//!
//! No operation is fused or reordered, so the results for a single drone and for a drone in a batch are bit-identical
//! with every instruction set.
//!
//! The rational approximations are from S. L. Moshier, *Methods and Programs for Mathematical Functions* (Cephes),
//! 1989.

mod functions;
mod pack;
mod vector;

pub(crate) use functions::{MAX_HALF_ANGLE_SQUARED, asin, atan2, exp_of_negative, half_angle};
pub(crate) use pack::Pack;
pub(crate) use vector::{Turn, V3};

use std::ops::{Add, BitAnd, Div, Mul, Neg, Sub};

/// A double or a SIMD register of doubles.
pub(crate) trait Real:
    Copy
    + std::fmt::Debug
    + Neg<Output = Self>
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Add<f64, Output = Self>
    + Sub<f64, Output = Self>
    + Mul<f64, Output = Self>
{
    /// Booleans, one per lane.
    type Mask: Copy + BitAnd<Output = Self::Mask>;

    /// Returns a register of the same width with every lane set to `x`.
    fn all(self, x: f64) -> Self;
    fn abs(self) -> Self;
    fn sqrt(self) -> Self;
    /// Compares lane by lane; false where either value is NaN.
    fn less(self, other: Self) -> Self::Mask;
    /// Selects lane by lane: `yes` where the mask is true, `no` elsewhere.
    fn choose(mask: Self::Mask, yes: Self, no: Self) -> Self;
    /// Returns true if any lane of the mask is true.
    fn any(mask: Self::Mask) -> bool;
    /// Returns the magnitude of `self` with the sign of `other`.
    fn with_sign_of(self, other: Self) -> Self;
    /// Returns 2^k for an integer k from −1022 to 1023 to which `functions::ROUND` was added.
    fn power_of_two(self) -> Self;

    /// Returns the smaller value, and `other` where either is NaN.
    #[inline(always)]
    fn lesser(self, other: Self) -> Self {
        Self::choose(self.less(other), self, other)
    }

    /// Returns the larger value, and `other` where either is NaN.
    #[inline(always)]
    fn greater(self, other: Self) -> Self {
        Self::choose(other.less(self), self, other)
    }
}

impl Real for f64 {
    type Mask = bool;

    #[inline(always)]
    fn all(self, x: f64) -> Self {
        x
    }

    #[inline(always)]
    fn abs(self) -> Self {
        f64::abs(self)
    }

    #[inline(always)]
    fn sqrt(self) -> Self {
        f64::sqrt(self)
    }

    #[inline(always)]
    fn less(self, other: Self) -> bool {
        self < other
    }

    #[inline(always)]
    fn choose(mask: bool, yes: Self, no: Self) -> Self {
        if mask { yes } else { no }
    }

    #[inline(always)]
    fn any(mask: bool) -> bool {
        mask
    }

    #[inline(always)]
    fn with_sign_of(self, other: Self) -> Self {
        self.copysign(other)
    }

    #[inline(always)]
    fn power_of_two(self) -> Self {
        f64::from_bits(self.to_bits().wrapping_add(1023) << 52)
    }
}
