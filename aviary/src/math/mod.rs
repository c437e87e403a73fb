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
mod trigonometry;
mod vector;

pub(crate) use functions::{
    MAX_HALF_ANGLE_SQUARED, SHORT, asin, atan2, clamped, decay, exp_of_negative, finite_zero, half_angle, ln,
    polynomial,
};
pub(crate) use pack::{LANES, Pack, PackBits, Row};
pub(crate) use trigonometry::{eighth_turn, sin_cos, sin_cos_of_turns, wrap_angle};
pub(crate) use vector::{Turn, V3};

use std::ops::{Add, BitAnd, BitOr, Div, Mul, Neg, Not, Sub};

/// A 64-bit integer or a SIMD register of 64-bit integers. Arithmetic wraps around.
pub(crate) trait Bits: Copy + std::fmt::Debug {
    /// Returns a register of the same width with every lane set to `x`.
    fn all(self, x: u64) -> Self;
    fn and(self, mask: u64) -> Self;
    fn or(self, bits: u64) -> Self;
    fn xor(self, other: Self) -> Self;
    fn plus(self, other: Self) -> Self;
    fn minus(self, other: Self) -> Self;
    /// Returns the next integer.
    #[inline(always)]
    fn next(self) -> Self {
        self.plus(self.all(1))
    }
    /// Returns the 64-bit product of the lower 32 bits and a factor.
    fn lower_times(self, factor: u32) -> Self;
    /// Exchanges the upper and the lower 32 bits.
    fn swap_halves(self) -> Self;
}

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
    type Mask: Copy + BitAnd<Output = Self::Mask> + BitOr<Output = Self::Mask> + Not<Output = Self::Mask>;
    /// Bit patterns, one per lane.
    type Bits: Bits;

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
    /// Returns the bit pattern.
    fn bits(self) -> Self::Bits;
    /// Creates a number from its bit pattern.
    fn of_bits(bits: Self::Bits) -> Self;

    /// Returns the nearest integer, for magnitudes below 2⁵¹; half-integers round to even.
    #[inline(always)]
    fn rounded(self) -> Self {
        (self + functions::ROUND) - functions::ROUND
    }

    /// Converts integers below 2⁵² to doubles.
    #[inline(always)]
    fn of_integer(integer: Self::Bits) -> Self {
        // the mantissa of 2⁵² counts integers
        Self::of_bits(integer.or(TWO_52.to_bits())) - TWO_52
    }

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

/// 2⁵².
const TWO_52: f64 = 4_503_599_627_370_496.0;

impl Bits for u64 {
    #[inline(always)]
    fn all(self, x: u64) -> Self {
        x
    }

    #[inline(always)]
    fn and(self, mask: u64) -> Self {
        self & mask
    }

    #[inline(always)]
    fn or(self, bits: u64) -> Self {
        self | bits
    }

    #[inline(always)]
    fn xor(self, other: Self) -> Self {
        self ^ other
    }

    #[inline(always)]
    fn plus(self, other: Self) -> Self {
        self.wrapping_add(other)
    }

    #[inline(always)]
    fn minus(self, other: Self) -> Self {
        self.wrapping_sub(other)
    }

    #[inline(always)]
    fn lower_times(self, factor: u32) -> Self {
        (self & 0xffff_ffff).wrapping_mul(u64::from(factor))
    }

    #[inline(always)]
    fn swap_halves(self) -> Self {
        self.rotate_left(32)
    }
}

impl Real for f64 {
    type Mask = bool;
    type Bits = u64;

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

    #[inline(always)]
    fn bits(self) -> u64 {
        self.to_bits()
    }

    #[inline(always)]
    fn of_bits(bits: u64) -> Self {
        f64::from_bits(bits)
    }
}
