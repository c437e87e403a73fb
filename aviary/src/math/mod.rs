//! Arithmetic that is the same for one drone and for many at once: numbers ([`Real`]) that are one double or a register
//! of them, vectors and rotations of such numbers, and elementary functions in arithmetic alone.
//!
//! No operation is fused or reordered, so that a single drone gets the same bits as one of thousands, with whatever
//! instructions.
//!
//! The rational approximations are those of S. L. Moshier, Methods and Programs for Mathematical Functions (Cephes), 1989.

mod functions;
mod pack;
mod vector;

pub(crate) use functions::{MAX_HALF_ANGLE_SQUARED, asin, atan2, exp_of_negative, half_angle};
pub(crate) use pack::Pack;
pub(crate) use vector::{Turn, V3};

use std::ops::{Add, BitAnd, Div, Mul, Neg, Sub};

/// A double, or a register of them that are computed with at once.
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
    /// Truth values, one per number.
    type Mask: Copy + BitAnd<Output = Self::Mask>;

    /// As many numbers as there are here, all of them this one.
    fn all(self, x: f64) -> Self;
    fn abs(self) -> Self;
    fn sqrt(self) -> Self;
    /// Whether each is less than its counterpart; not where one is NaN.
    fn less(self, other: Self) -> Self::Mask;
    /// The one where true, the other where not.
    fn choose(mask: Self::Mask, yes: Self, no: Self) -> Self;
    /// Whether it is true of any.
    fn any(mask: Self::Mask) -> bool;
    /// Each with the sign of its counterpart.
    fn with_sign_of(self, other: Self) -> Self;
    /// 2^k of a whole k from −1022 to 1023 to which `functions::ROUND` was added.
    fn power_of_two(self) -> Self;

    /// The lesser; the second where one is NaN.
    #[inline(always)]
    fn lesser(self, other: Self) -> Self {
        Self::choose(self.less(other), self, other)
    }

    /// The greater; the second where one is NaN.
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
