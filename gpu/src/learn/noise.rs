//! Random numbers of an iteration: exploration noise of the actions, and the order of the samples in an epoch. They are
//! functions of the seed of the iteration and of an index, so that no thread keeps a generator.

use cubecl::prelude::*;

use crate::number::Word as _;
use crate::random::philox;
use crate::traced::{TracedWord, within};

/// Last word of the counters of exploration noise.
const NOISE: u32 = 2;

/// Last word of the counters of the keys of permutations.
const ORDER: u32 = 3;

/// Share of the range of a word.
const UNIT: f32 = 1.0 / 4_294_967_296.0;

/// Angle of a unit of a word whose range is a full turn, rad.
const TURN: f32 = std::f32::consts::TAU / 4_294_967_296.0;

/// Two random words.
#[derive(CubeType, Clone, Copy)]
pub(super) struct Words {
    pub first: u32,
    pub second: u32,
}

/// Returns two words of Philox4x32-10; `random_words::expand` emits its operations.
#[allow(unused_variables)]
fn random_words(low: u32, high: u32, row: u32, step: u32, pair: u32) -> Words {
    unreachable!("kernels run on the device")
}

mod random_words {
    use super::*;

    pub fn expand(
        scope: &Scope,
        low: NativeExpand<u32>,
        high: NativeExpand<u32>,
        row: NativeExpand<u32>,
        step: NativeExpand<u32>,
        pair: NativeExpand<u32>,
    ) -> WordsExpand {
        within(scope, || {
            let [low, high, row, step, pair] = [low, high, row, step, pair].map(|word| TracedWord(word.expand));
            let [first, second, ..] = philox([low, high], [row, step, pair, TracedWord::of(NOISE)]);
            WordsExpand { first: first.0.into(), second: second.0.into() }
        })
    }
}

/// Returns a standard normal number for an entry of the action of a row in a step (Box & Muller 1958).
#[cube]
pub(super) fn normal(low: u32, high: u32, row: u32, step: u32, entry: u32) -> f32 {
    let words = random_words(low, high, row, step, entry / 2);
    // between 0 and 1, without 0
    let uniform = (f32::cast_from(words.first) + 0.5) * UNIT;
    let square = -(2.0 * uniform.ln());
    // the logarithm of a number close to 1 may be positive on a device
    let radius = select(square > 0.0, square, 0.0).sqrt();
    let angle = f32::cast_from(words.second) * TURN;
    radius * select(entry & 1 == 0, angle.cos(), angle.sin())
}

/// Keys of the permutation of an epoch.
pub(super) fn keys(seed: u64, epoch: u32) -> [u32; 4] {
    philox([seed as u32, (seed >> 32) as u32], [epoch, 0, 0, ORDER])
}

/// Returns the number of bits of an index below `count`, at least 2.
pub(super) fn bits(count: usize) -> u32 {
    count.next_power_of_two().trailing_zeros().max(2)
}

/// Returns the sample at a position of a permutation of `count` samples.
///
/// A Feistel network of eight rounds permutes all numbers of `bits` bits. Numbers from `count` on are permuted again
/// until one is below `count`, which permutes those below `count` alone (Black & Rogaway 2002). `bits` is [`bits`] of
/// `count`, so that at most half of the numbers need that.
#[cube]
pub(super) fn permuted(position: u32, count: u32, bits: u32, a: u32, b: u32, c: u32, d: u32) -> u32 {
    let mut number = shuffled(position, bits, a, b, c, d);
    while number >= count {
        number = shuffled(number, bits, a, b, c, d);
    }
    number
}

/// Permutes the numbers of `bits` bits.
#[cube]
fn shuffled(number: u32, bits: u32, a: u32, b: u32, c: u32, d: u32) -> u32 {
    let low_bits = bits / 2;
    let low_mask = (1u32 << low_bits) - 1;
    let high_mask = (1u32 << (bits - low_bits)) - 1;
    let mut low = number & low_mask;
    let mut high = number >> low_bits;
    high ^= mixed(low, a) & high_mask;
    low ^= mixed(high, b) & low_mask;
    high ^= mixed(low, c) & high_mask;
    low ^= mixed(high, d) & low_mask;
    high ^= mixed(low, a ^ 0x9e37_79b9) & high_mask;
    low ^= mixed(high, b ^ 0x9e37_79b9) & low_mask;
    high ^= mixed(low, c ^ 0x9e37_79b9) & high_mask;
    low ^= mixed(high, d ^ 0x9e37_79b9) & low_mask;
    (high << low_bits) | low
}

/// Returns a hash of a number under a key (the finalizer of MurmurHash3).
#[cube]
fn mixed(number: u32, key: u32) -> u32 {
    let mut hash = number ^ key;
    hash ^= hash >> 16;
    hash *= 0x85eb_ca6b;
    hash ^= hash >> 13;
    hash *= 0xc2b2_ae35;
    hash ^ (hash >> 16)
}

/// Kernel of normal numbers, for tests: `entries` per row.
#[cfg(test)]
#[cube(launch_unchecked)]
pub(super) fn normal_kernel(out: &mut [f32], rows: u32, entries: u32, low: u32, high: u32, step: u32) {
    if ABSOLUTE_POS < rows as usize {
        for entry in 0..entries {
            out[ABSOLUTE_POS * entries as usize + entry as usize] = normal(low, high, ABSOLUTE_POS as u32, step, entry);
        }
    }
}

/// Kernel of a permutation, for tests.
#[cfg(test)]
#[cube(launch_unchecked)]
pub(super) fn permutation_kernel(out: &mut [u32], count: u32, bits: u32, a: u32, b: u32, c: u32, d: u32) {
    if ABSOLUTE_POS < count as usize {
        out[ABSOLUTE_POS] = permuted(ABSOLUTE_POS as u32, count, bits, a, b, c, d);
    }
}
