use std::ops::{Add, BitAnd, BitOr, Div, Mul, Neg, Not, Sub};

use pulp::Simd;

use flight::math::{ROUND, mantissa_and_exponent_of_bits};

use super::{Bits, Double, Real};

/// Number of drones in one set of lanes.
pub(crate) const LANES: usize = 8;

/// One value per lane.
pub(crate) type Row<T = f64> = [T; LANES];

/// A SIMD register of doubles.
#[derive(Clone, Copy)]
pub(crate) struct Pack<S: Simd> {
    simd: S,
    values: S::f64s,
}

/// A SIMD register of 64-bit integers.
#[derive(Clone, Copy)]
pub(crate) struct PackBits<S: Simd> {
    simd: S,
    values: S::u64s,
}

/// A SIMD register of booleans.
#[derive(Clone, Copy)]
pub(crate) struct PackMask<S: Simd> {
    simd: S,
    values: S::m64s,
}

impl<S: Simd> std::fmt::Debug for Pack<S> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.values.fmt(f)
    }
}

impl<S: Simd> Pack<S> {
    #[inline(always)]
    pub(crate) fn new(simd: S, values: S::f64s) -> Self {
        Self { simd, values }
    }

    #[inline(always)]
    pub(crate) fn values(self) -> S::f64s {
        self.values
    }

    /// Loads the register with this index from a row.
    #[inline(always)]
    pub(crate) fn load(simd: S, row: &Row, index: usize) -> Self {
        Self { simd, values: S::as_simd_f64s(row).0[index] }
    }

    /// Stores the register with this index in a row.
    #[inline(always)]
    pub(crate) fn store(self, row: &mut Row, index: usize) {
        S::as_mut_simd_f64s(row).0[index] = self.values;
    }
}

impl<S: Simd> PackBits<S> {
    /// Loads the register with this index from a row.
    #[inline(always)]
    pub(crate) fn load(simd: S, row: &Row<u64>, index: usize) -> Self {
        Self { simd, values: S::as_simd_u64s(row).0[index] }
    }

    /// Stores the register with this index in a row.
    #[inline(always)]
    pub(crate) fn store(self, row: &mut Row<u64>, index: usize) {
        S::as_mut_simd_u64s(row).0[index] = self.values;
    }
}

impl<S: Simd> std::fmt::Debug for PackBits<S> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.values.fmt(f)
    }
}

impl<S: Simd> Bits for PackBits<S> {
    #[inline(always)]
    fn all(self, x: u64) -> Self {
        Self { values: self.simd.splat_u64s(x), ..self }
    }

    #[inline(always)]
    fn and(self, mask: u64) -> Self {
        Self { values: self.simd.and_u64s(self.values, self.simd.splat_u64s(mask)), ..self }
    }

    #[inline(always)]
    fn or(self, bits: u64) -> Self {
        Self { values: self.simd.or_u64s(self.values, self.simd.splat_u64s(bits)), ..self }
    }

    #[inline(always)]
    fn xor(self, other: Self) -> Self {
        Self { values: self.simd.xor_u64s(self.values, other.values), ..self }
    }

    #[inline(always)]
    fn plus(self, other: Self) -> Self {
        Self { values: self.simd.add_u64s(self.values, other.values), ..self }
    }

    #[inline(always)]
    fn minus(self, other: Self) -> Self {
        Self { values: self.simd.sub_u64s(self.values, other.values), ..self }
    }

    #[inline(always)]
    fn lower_times(self, factor: u32) -> Self {
        // a product of two numbers below 2³² is one instruction
        let lower = self.and(0xffff_ffff).values;
        Self { values: self.simd.mul_u64s(lower, self.simd.splat_u64s(u64::from(factor))), ..self }
    }

    #[inline(always)]
    fn swap_halves(self) -> Self {
        let halves: S::c32s = pulp::cast(self.values);
        Self { values: pulp::cast(self.simd.swap_re_im_c32s(halves)), ..self }
    }
}

macro_rules! pack_operators {
    ($($operator:ident $name:ident $with:ident;)*) => {$(
        impl<S: Simd> $operator for Pack<S> {
            type Output = Self;

            #[inline(always)]
            fn $name(self, other: Self) -> Self {
                Self { values: self.simd.$with(self.values, other.values), ..self }
            }
        }

        impl<S: Simd> $operator<f64> for Pack<S> {
            type Output = Self;

            #[inline(always)]
            fn $name(self, other: f64) -> Self {
                Self { values: self.simd.$with(self.values, self.simd.splat_f64s(other)), ..self }
            }
        }
    )*};
}

pack_operators! {
    Add add add_f64s;
    Sub sub sub_f64s;
    Mul mul mul_f64s;
    Div div div_f64s;
}

impl<S: Simd> Neg for Pack<S> {
    type Output = Self;

    #[inline(always)]
    fn neg(self) -> Self {
        Self { values: self.simd.xor_f64s(self.values, self.simd.splat_f64s(-0.0)), ..self }
    }
}

impl<S: Simd> BitAnd for PackMask<S> {
    type Output = Self;

    #[inline(always)]
    fn bitand(self, other: Self) -> Self {
        Self { values: self.simd.and_m64s(self.values, other.values), ..self }
    }
}

impl<S: Simd> BitOr for PackMask<S> {
    type Output = Self;

    #[inline(always)]
    fn bitor(self, other: Self) -> Self {
        Self { values: self.simd.or_m64s(self.values, other.values), ..self }
    }
}

impl<S: Simd> Not for PackMask<S> {
    type Output = Self;

    #[inline(always)]
    fn not(self) -> Self {
        Self { values: self.simd.not_m64s(self.values), ..self }
    }
}

impl<S: Simd> Real for Pack<S> {
    type Mask = PackMask<S>;

    #[inline(always)]
    fn all(self, x: f64) -> Self {
        Self { values: self.simd.splat_f64s(x), ..self }
    }

    #[inline(always)]
    fn abs(self) -> Self {
        Self { values: self.simd.abs_f64s(self.values), ..self }
    }

    #[inline(always)]
    fn sqrt(self) -> Self {
        Self { values: self.simd.sqrt_f64s(self.values), ..self }
    }

    #[inline(always)]
    fn less(self, other: Self) -> PackMask<S> {
        PackMask { simd: self.simd, values: self.simd.less_than_f64s(self.values, other.values) }
    }

    #[inline(always)]
    fn choose(mask: PackMask<S>, yes: Self, no: Self) -> Self {
        Self { values: mask.simd.select_f64s(mask.values, yes.values, no.values), ..yes }
    }

    #[inline(always)]
    fn any(mask: PackMask<S>) -> bool {
        mask.simd.first_true_m64s(mask.values) < S::F64_LANES
    }

    #[inline(always)]
    fn with_sign_of(self, other: Self) -> Self {
        let sign = self.simd.and_f64s(other.values, self.simd.splat_f64s(-0.0));
        Self { values: self.simd.or_f64s(self.simd.abs_f64s(self.values), sign), ..self }
    }

    #[inline(always)]
    fn power_of_two(self) -> Self {
        let simd = self.simd;
        // adding 1.5 · 2⁵² leaves the integer in the low bits
        let integer = (self + ROUND).values;
        let biased = simd.add_u64s(simd.transmute_u64s_f64s(integer), simd.splat_u64s(1023));
        // the product is a shift by 52 bits
        let shifted = simd.mul_u64s(biased, simd.splat_u64s(1 << 52));
        Self { values: simd.transmute_f64s_u64s(shifted), ..self }
    }

    #[inline(always)]
    fn mantissa_and_exponent(self) -> (Self, Self) {
        mantissa_and_exponent_of_bits(self)
    }
}

impl<S: Simd> Double for Pack<S> {
    type Bits = PackBits<S>;

    #[inline(always)]
    fn bits(self) -> PackBits<S> {
        PackBits { simd: self.simd, values: self.simd.transmute_u64s_f64s(self.values) }
    }

    #[inline(always)]
    fn of_bits(bits: PackBits<S>) -> Self {
        Self { simd: bits.simd, values: bits.simd.transmute_f64s_u64s(bits.values) }
    }
}
