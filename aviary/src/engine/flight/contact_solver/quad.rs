use std::ops::{Add, Div, Mul, Sub};

use pulp::Simd;

use super::{PerPoint, sum};
use crate::math::{Pack, Real, Row};

/// One number for each contact point, in a register of four numbers or in two registers of two.
#[derive(Debug, Clone, Copy)]
pub(super) struct Quad<S: Simd> {
    first: Pack<S>,
    /// Equal to `first` if that has all numbers.
    second: Pack<S>,
}

impl<S: Simd> Quad<S> {
    /// True if four numbers need two registers.
    const SPLIT: bool = S::F64_LANES < 4;

    #[inline(always)]
    pub(super) fn load(simd: S, [a, b, c, d]: PerPoint) -> Self {
        let row: Row = [a, b, c, d, 0.0, 0.0, 0.0, 0.0];
        let first = Pack::load(simd, &row, 0);
        Self { first, second: if Self::SPLIT { Pack::load(simd, &row, 1) } else { first } }
    }

    #[inline(always)]
    pub(super) fn numbers(self) -> PerPoint {
        let mut row = Row::default();
        self.first.store(&mut row, 0);
        if Self::SPLIT {
            self.second.store(&mut row, 1);
        }
        [row[0], row[1], row[2], row[3]]
    }

    /// Returns the sum of the numbers.
    #[inline(always)]
    pub(super) fn sum(self) -> f64 {
        sum(&self.numbers())
    }

    /// Returns `yes` where this number is negative, and `no` elsewhere.
    #[inline(always)]
    pub(super) fn if_negative(self, yes: Self, no: Self) -> Self {
        let zero = self.first.all(0.0);
        let first = Real::choose(self.first.less(zero), yes.first, no.first);
        Self {
            first,
            second: if Self::SPLIT { Real::choose(self.second.less(zero), yes.second, no.second) } else { first },
        }
    }

    /// Returns true if the numbers are negative where those of `other` are.
    #[inline(always)]
    pub(super) fn has_signs_of(self, other: Self) -> bool {
        let zero = self.first.all(0.0);
        let (a, b) = (self.first.less(zero), other.first.less(zero));
        let mut differs = (a & !b) | (b & !a);
        if Self::SPLIT {
            let (a, b) = (self.second.less(zero), other.second.less(zero));
            differs = differs | (a & !b) | (b & !a);
        }
        !Pack::<S>::any(differs)
    }
}

macro_rules! quad_operators {
    ($($operator:ident $name:ident;)*) => {$(
        impl<S: Simd> $operator for Quad<S> {
            type Output = Self;

            #[inline(always)]
            fn $name(self, other: Self) -> Self {
                let first = self.first.$name(other.first);
                Self { first, second: if Self::SPLIT { self.second.$name(other.second) } else { first } }
            }
        }

        impl<S: Simd> $operator<f64> for Quad<S> {
            type Output = Self;

            #[inline(always)]
            fn $name(self, other: f64) -> Self {
                let first = self.first.$name(other);
                Self { first, second: if Self::SPLIT { self.second.$name(other) } else { first } }
            }
        }
    )*};
}

quad_operators! {
    Add add;
    Sub sub;
    Mul mul;
    Div div;
}
