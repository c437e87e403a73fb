//! Numbers and words with which the step of an environment is written: those of the host, or those of a kernel that
//! is being built.

use flight::random::{Key, Sampled};

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
pub trait Number: Sampled {
    /// Integers of the device.
    type Word: Word<Mask = Self::Mask>;

    /// Converts an integer to the nearest number.
    fn of_word(word: Self::Word) -> Self;

    /// Returns the integer of 64 bits of its halves.
    fn wide(low: Self::Word, high: Self::Word) -> Self::Integer;

    /// Applies `step` to the values `count` times. The first argument of `step` is the number of the repetition.
    fn repeat(count: u32, values: Vec<Self>, step: impl FnMut(Self::Word, Vec<Self>) -> Vec<Self>) -> Vec<Self>;

    /// Returns the values of `change` where the mask is true, and `values` elsewhere. Only threads whose mask is true
    /// execute `change`.
    fn when(
        mask: Self::Mask,
        values: (Vec<Self>, Vec<Self::Word>),
        change: impl FnOnce() -> (Vec<Self>, Vec<Self::Word>),
    ) -> (Vec<Self>, Vec<Self::Word>);

    /// Returns the values of every drone of the world, in the order of the drones; `own` are those of this one. All
    /// threads of a workgroup execute this function together.
    fn gather(drones: u32, own: &[Self]) -> Vec<Vec<Self>>;

    /// Returns the key of random numbers of two integers.
    fn key([a, b]: [Self::Word; 2]) -> Key<Self::Integer> {
        let none = Self::Word::of(0);
        Key([Self::wide(a, none), Self::wide(b, none)])
    }
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

/// Numbers of the host, which has worlds of one drone.
impl Number for f64 {
    type Word = u32;

    fn of_word(word: u32) -> Self {
        f64::from(word)
    }

    fn wide(low: u32, high: u32) -> u64 {
        u64::from(low) | u64::from(high) << 32
    }

    fn repeat(count: u32, mut values: Vec<Self>, mut step: impl FnMut(u32, Vec<Self>) -> Vec<Self>) -> Vec<Self> {
        for index in 0..count {
            values = step(index, values);
        }
        values
    }

    fn when(
        mask: bool,
        values: (Vec<Self>, Vec<u32>),
        change: impl FnOnce() -> (Vec<Self>, Vec<u32>),
    ) -> (Vec<Self>, Vec<u32>) {
        if mask { change() } else { values }
    }

    fn gather(drones: u32, own: &[Self]) -> Vec<Vec<Self>> {
        assert_eq!(drones, 1, "the host has worlds of one drone");
        vec![own.to_vec()]
    }
}
