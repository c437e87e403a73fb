//! Numbers and words with which the step of an environment is written: those of the host, or those of a kernel that
//! is being built.

use flight::math::Real;

/// Unsigned 32-bit integer. Arithmetic wraps around.
pub trait Word: Copy {
    /// Truth value.
    type Mask;

    /// Creates a constant.
    fn of(x: u32) -> Self;
    /// Returns the sum.
    fn plus(self, other: Self) -> Self;
    /// Returns the lower half of the product.
    fn times(self, other: Self) -> Self;
    /// Returns the upper half of the product.
    fn times_high(self, other: Self) -> Self;
    /// Returns the bitwise exclusive OR.
    fn xor(self, other: Self) -> Self;
    /// Compares two integers.
    fn less(self, other: Self) -> Self::Mask;
    /// Selects `yes` where the mask is true, and `no` elsewhere.
    fn choose(mask: Self::Mask, yes: Self, no: Self) -> Self;
}

/// Number with the integers, loops and branches of its device.
pub trait Number: Real {
    /// Integers of the device.
    type Word: Word<Mask = Self::Mask>;

    /// Converts an integer to the nearest number.
    fn of_word(word: Self::Word) -> Self;

    /// Applies `step` to the values `count` times.
    fn repeat<const N: usize>(count: u32, values: [Self; N], step: impl FnMut([Self; N]) -> [Self; N]) -> [Self; N];

    /// Returns the values of `change` where the mask is true, and `values` elsewhere. Only threads whose mask is true
    /// execute `change`.
    fn when<const N: usize, const K: usize>(
        mask: Self::Mask,
        values: ([Self; N], [Self::Word; K]),
        change: impl FnOnce() -> ([Self; N], [Self::Word; K]),
    ) -> ([Self; N], [Self::Word; K]);
}

impl Word for u32 {
    type Mask = bool;

    fn of(x: u32) -> Self {
        x
    }

    fn plus(self, other: Self) -> Self {
        self.wrapping_add(other)
    }

    fn times(self, other: Self) -> Self {
        self.wrapping_mul(other)
    }

    fn times_high(self, other: Self) -> Self {
        ((u64::from(self) * u64::from(other)) >> 32) as u32
    }

    fn xor(self, other: Self) -> Self {
        self ^ other
    }

    fn less(self, other: Self) -> bool {
        self < other
    }

    fn choose(mask: bool, yes: Self, no: Self) -> Self {
        if mask { yes } else { no }
    }
}

impl Number for f64 {
    type Word = u32;

    fn of_word(word: u32) -> Self {
        f64::from(word)
    }

    fn repeat<const N: usize>(
        count: u32,
        mut values: [Self; N],
        mut step: impl FnMut([Self; N]) -> [Self; N],
    ) -> [Self; N] {
        for _ in 0..count {
            values = step(values);
        }
        values
    }

    fn when<const N: usize, const K: usize>(
        mask: bool,
        values: ([Self; N], [u32; K]),
        change: impl FnOnce() -> ([Self; N], [u32; K]),
    ) -> ([Self; N], [u32; K]) {
        if mask { change() } else { values }
    }
}
