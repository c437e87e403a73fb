//! Counter-based random numbers: functions of a key and a counter without any other state, so that SIMD lanes compute
//! them for several environments at once.
//!
//! The generator is Philox4x32-10 (Salmon, Moraes, Dror and Shaw, "Parallel Random Numbers: As Easy as 1, 2, 3", SC11,
//! 2011). A [`Key`] identifies a drone in an episode. The counter contains the number of the step and a
//! [`Purpose`], so that every number depends only on the episode, the drone, the step and its use.

use crate::math::{Bits, Double, Real, eighth_turn, ln};

/// Lower half of a 64-bit integer.
const LOWER: u64 = 0xffff_ffff;

/// Numbers that are computed from random integers.
pub trait Sampled: Real {
    /// Integers of 64 bits, one per lane.
    type Integer: Bits;

    /// Converts integers below 2⁵².
    fn from_integer(integer: Self::Integer) -> Self;
    /// Negates the numbers where the upper bit of the integer, bit 63, is one.
    fn negated_by(self, integer: Self::Integer) -> Self;
}

impl<R: Double> Sampled for R {
    type Integer = R::Bits;

    #[inline(always)]
    fn from_integer(integer: R::Bits) -> Self {
        R::of_integer(integer)
    }

    #[inline(always)]
    fn negated_by(self, integer: R::Bits) -> Self {
        const SIGN: u64 = 1 << 63;
        R::of_bits(self.bits().xor(integer.and(SIGN)))
    }
}

/// Key of the random numbers of one drone in one episode; the lower 32 bits of two integers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Key<B = u64>(pub [B; 2]);

/// Use of random numbers. Numbers for different uses are independent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u64)]
pub enum Purpose {
    /// Keys, from the seed of an episode.
    Key = 1,
    /// State of the wind at the start of an episode.
    WindStart = 2,
    /// Turbulence in a physics step.
    Turbulence = 3,
    /// Gust that starts in a physics step.
    Gust = 4,
    /// Sensor noise in a control step.
    Sensor = 5,
}

impl Key {
    /// Creates the key of a drone from the seed of an episode. The generator itself mixes the seed and the index, so
    /// that neighbouring seeds and drones have independent keys.
    pub fn new(seed: u64, drone: usize) -> Self {
        let [a, b, ..] = Self([seed & LOWER, seed >> 32]).at(drone as u64).block(Purpose::Key, 0);
        Self([a, b])
    }
}

impl<B: Bits> Key<B> {
    /// Returns the random numbers of a step.
    #[inline(always)]
    pub fn at(self, step: B) -> Noise<B> {
        Noise { key: self, step }
    }
}

/// Random numbers of one drone in one step.
#[derive(Debug, Clone, Copy)]
pub struct Noise<B = u64> {
    /// Key of the drone.
    pub key: Key<B>,
    /// Number of the step.
    pub step: B,
}

impl<B: Bits> Noise<B> {
    /// Returns four random integers below 2³².
    #[inline(always)]
    pub fn block(self, purpose: Purpose, index: u32) -> [B; 4] {
        let step = self.step;
        let (purpose, index) = (step.all(purpose as u64), step.all(u64::from(index)));
        philox(self.key.0, [step, step.swap_halves(), purpose, index])
    }

    /// Returns four independent standard normal samples.
    #[inline(always)]
    pub fn normals<R: Sampled<Integer = B>>(self, purpose: Purpose, index: u32) -> [R; 4] {
        let [a, b, c, d] = self.block(purpose, index);
        let ([a, b], [c, d]) = (NormalPair::<R>::new(a, b).samples(), NormalPair::<R>::new(c, d).samples());
        [a, b, c, d]
    }
}

/// Philox4x32-10 on the lower 32 bits of every integer.
#[inline(always)]
fn philox<B: Bits>(key: [B; 2], counter: [B; 4]) -> [B; 4] {
    let ([mut k, mut l], [mut a, mut b, mut c, mut d]) = (key, counter);
    for _ in 0..10 {
        let (p, q) = (a.lower_times(0xd251_1f53), c.lower_times(0xcd9e_8d57));
        // carries into the upper halves never return to the lower ones
        [a, b, c, d] = [q.swap_halves().xor(b).xor(k), q, p.swap_halves().xor(d).xor(l), p];
        (k, l) = (k.plus(k.all(0x9e37_79b9)), l.plus(l.all(0xbb67_ae85)));
    }
    [a.and(LOWER), b.and(LOWER), c.and(LOWER), d.and(LOWER)]
}

/// Converts a random integer below 2³² to a uniform number in (0, 1).
///
/// The number is the centre of one of 2³² intervals of equal length. This resolution determines the largest normal
/// sample, 6.8 standard deviations, which a longer stream than any episode would have to exceed; mean and variance of
/// uniform numbers differ from the exact values by less than 1e-19.
#[inline(always)]
pub fn uniform<R: Sampled>(word: R::Integer) -> R {
    (R::from_integer(word) + 0.5) * (1.0 / 4_294_967_296.0)
}

/// Two independent standard normal samples (Box and Muller 1958), as factors: √`square`·`first` and
/// √`square`·`second`. A caller that scales a sample by a square root computes one root of the product instead of
/// two.
#[derive(Debug, Clone, Copy)]
pub struct NormalPair<R> {
    /// Half of the square of the radius.
    pub square: R,
    /// √2 times the cosine of the angle.
    pub first: R,
    /// √2 times the sine of the angle.
    pub second: R,
}

impl<R: Sampled> NormalPair<R> {
    /// Creates the samples from two random integers below 2³². The first one determines the radius. Of the second one,
    /// 2 bits determine the quadrant and 30 bits the angle in it.
    #[inline(always)]
    pub fn new(radius: R::Integer, angle: R::Integer) -> Self {
        let square = -ln(uniform::<R>(radius));
        // the angle is 45° plus up to ±45°: by the addition theorem, √2·cos = cos − sin and √2·sin = cos + sin
        let eighths = (R::from_integer(angle.and(0x3fff_ffff)) + 0.5) * (1.0 / 536_870_912.0) - 1.0;
        let (sin, cos) = eighth_turn(eighths);
        // bits 31 and 30 are the signs
        let (left, down) = (angle.swap_halves(), angle.plus(angle).swap_halves());
        Self { square, first: (cos - sin).negated_by(left), second: (cos + sin).negated_by(down) }
    }

    /// Returns the samples.
    #[inline(always)]
    pub fn samples(self) -> [R; 2] {
        let radius = self.square.sqrt();
        [radius * self.first, radius * self.second]
    }
}

#[cfg(test)]
mod tests;
