//! Arithmetic that is generic over the type of numbers ([`Real`]): vectors, rotations and elementary functions.
//!
//! A number is a double, a SIMD register of doubles, or a value of a program that is being built for another device.
//! No operation is fused or reordered, so the results for a single drone and for a drone in a batch are bit-identical
//! with every instruction set.
//!
//! The rational approximations are from S. L. Moshier, *Methods and Programs for Mathematical Functions* (Cephes),
//! 1989.

mod functions;
mod trigonometry;
mod vector;

pub use functions::{
    MAX_HALF_ANGLE_SQUARED, ROUND, SHORT, asin, atan2, clamped, decay, exp_of_negative, exponential, finite_zero,
    half_angle, ln, mantissa_and_exponent_of_bits, natural_log, polynomial,
};
pub use trigonometry::{eighth_turn, sin_cos, sin_cos_of_turns, wrap_angle};
pub use vector::{Turn, V3};

use std::ops::{Add, BitAnd, BitOr, Div, Mul, Neg, Not, Sub};

/// A 64-bit integer or a SIMD register of 64-bit integers. Arithmetic wraps around.
pub trait Bits: Copy + std::fmt::Debug {
    /// Returns a register of the same width with every lane set to `x`.
    fn all(self, x: u64) -> Self;
    /// Returns the bitwise AND with a mask.
    fn and(self, mask: u64) -> Self;
    /// Returns the bitwise OR with the same bits in all lanes.
    fn or(self, bits: u64) -> Self;
    /// Returns the bitwise exclusive OR.
    fn xor(self, other: Self) -> Self;
    /// Returns the sum.
    fn plus(self, other: Self) -> Self;
    /// Returns the difference.
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

/// A number: a double, a SIMD register of doubles, or a value of a program that is being built.
///
/// Code that is generic over `Real` has no branches on numbers: it selects with masks ([`choose`](Self::choose)).
/// Constants are doubles; [`all`](Self::all) and the operators with an `f64` convert them.
///
/// The provided functions need arithmetic alone. They have the precision and the range of doubles; a narrower type
/// overrides [`MIN_POSITIVE`](Self::MIN_POSITIVE), [`rounded`](Self::rounded) and the functions for which its device
/// has instructions. Their names differ from those of `f64`, because an inherent function of `f64` would take
/// precedence.
pub trait Real:
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

    /// Smallest positive normal number.
    const MIN_POSITIVE: f64 = f64::MIN_POSITIVE;

    /// Returns a register of the same width with every lane set to `x`.
    fn all(self, x: f64) -> Self;
    /// Returns the magnitude.
    fn abs(self) -> Self;
    /// Returns the square root.
    fn sqrt(self) -> Self;
    /// Compares lane by lane; false where either value is NaN.
    fn less(self, other: Self) -> Self::Mask;
    /// Selects lane by lane: `yes` where the mask is true, `no` elsewhere.
    fn choose(mask: Self::Mask, yes: Self, no: Self) -> Self;
    /// Returns false if no lane of the mask is true, so that the caller can omit what only such lanes need. A type
    /// whose values are unknown returns true.
    fn any(mask: Self::Mask) -> bool;
    /// Returns the magnitude of `self` with the sign of `other`.
    fn with_sign_of(self, other: Self) -> Self;

    /// Returns the nearest integer, for magnitudes below 2⁵¹; half-integers round to even.
    #[inline(always)]
    fn rounded(self) -> Self {
        (self + functions::ROUND) - functions::ROUND
    }

    /// Returns 2^k for an integer k from −1022 to 1023.
    #[inline(always)]
    fn power_of_two(self) -> Self {
        functions::power_of_two(self)
    }

    /// Returns m and k of a positive normal number m·2^k with √½ ≤ m < √2.
    #[inline(always)]
    fn mantissa_and_exponent(self) -> (Self, Self) {
        functions::mantissa_and_exponent(self)
    }

    /// Computes [`exp_of_negative`].
    #[inline(always)]
    fn exp_of_negative(self) -> Self {
        functions::exponential(self)
    }

    /// Computes [`ln`].
    #[inline(always)]
    fn natural_log(self) -> Self {
        functions::natural_log(self)
    }

    /// Computes [`atan2`].
    #[inline(always)]
    fn arctan2(y: Self, x: Self) -> Self {
        functions::arctan2(y, x)
    }

    /// Computes [`asin`].
    #[inline(always)]
    fn arcsin(self) -> Self {
        functions::arcsin(self)
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

/// A double or a SIMD register of doubles: numbers with bit patterns.
pub trait Double: Real {
    /// Bit patterns, one per lane.
    type Bits: Bits;

    /// Returns the bit pattern.
    fn bits(self) -> Self::Bits;
    /// Creates a number from its bit pattern.
    fn of_bits(bits: Self::Bits) -> Self;

    /// Converts integers below 2⁵² to doubles.
    #[inline(always)]
    fn of_integer(integer: Self::Bits) -> Self {
        // the mantissa of 2⁵² counts integers
        Self::of_bits(integer.or(TWO_52.to_bits())) - TWO_52
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
        f64::from_bits((self + functions::ROUND).to_bits().wrapping_add(1023) << 52)
    }

    #[inline(always)]
    fn mantissa_and_exponent(self) -> (Self, Self) {
        mantissa_and_exponent_of_bits(self)
    }
}

impl Double for f64 {
    type Bits = u64;

    #[inline(always)]
    fn bits(self) -> u64 {
        self.to_bits()
    }

    #[inline(always)]
    fn of_bits(bits: u64) -> Self {
        f64::from_bits(bits)
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    std::thread_local! {
        /// Number of operations of this thread on [`Plain`]: arithmetic, square roots, comparisons and selections.
        pub static OPERATIONS: std::cell::Cell<u64> = const { std::cell::Cell::new(0) };
    }

    /// Counts the operation that has returned a value.
    fn counted<T>(value: T) -> T {
        OPERATIONS.set(OPERATIONS.get() + 1);
        value
    }

    /// A double that uses the provided functions of [`Real`].
    #[derive(Debug, Clone, Copy, PartialEq)]
    pub struct Plain(pub f64);

    macro_rules! operators {
        ($($operator:ident $name:ident;)*) => {$(
            impl $operator for Plain {
                type Output = Self;

                fn $name(self, other: Self) -> Self {
                    counted(Self(self.0.$name(other.0)))
                }
            }

            impl $operator<f64> for Plain {
                type Output = Self;

                fn $name(self, other: f64) -> Self {
                    counted(Self(self.0.$name(other)))
                }
            }
        )*};
    }

    operators! {
        Add add;
        Sub sub;
        Mul mul;
        Div div;
    }

    impl Neg for Plain {
        type Output = Self;

        fn neg(self) -> Self {
            Self(-self.0)
        }
    }

    impl Real for Plain {
        type Mask = bool;

        fn all(self, x: f64) -> Self {
            Self(x)
        }

        fn abs(self) -> Self {
            Self(self.0.abs())
        }

        fn sqrt(self) -> Self {
            counted(Self(self.0.sqrt()))
        }

        fn less(self, other: Self) -> bool {
            counted(self.0 < other.0)
        }

        fn choose(mask: bool, yes: Self, no: Self) -> Self {
            counted(if mask { yes } else { no })
        }

        fn any(_: bool) -> bool {
            true
        }

        fn with_sign_of(self, other: Self) -> Self {
            Self(self.0.copysign(other.0))
        }
    }
}
