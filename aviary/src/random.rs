//! Sequential random numbers of the simulator, for everything that happens at resets. Noise in every step is from the
//! counter-based generator of [`flight::random`].

use rand::{Rng as _, RngExt as _, SeedableRng as _};

/// Random number generator of the simulator: seeded once per environment, bit-identical on every machine.
pub type Rng = rand_chacha::ChaCha8Rng;

/// State of an [`Rng`] without its buffer of generated numbers, a fifth of its size.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct CompactRng {
    seed: [u8; 32],
    stream: u64,
    /// Position in the stream, in words of 32 bits; two halves, so that the alignment stays that of the other fields.
    position: [u64; 2],
}

impl From<&Rng> for CompactRng {
    fn from(rng: &Rng) -> Self {
        let position = rng.get_word_pos();
        Self { seed: rng.get_seed(), stream: rng.get_stream(), position: [position as u64, (position >> 64) as u64] }
    }
}

impl From<CompactRng> for Rng {
    fn from(CompactRng { seed, stream, position: [low, high] }: CompactRng) -> Self {
        let mut rng = Self::from_seed(seed);
        rng.set_stream(stream);
        // this generates numbers at once
        if [low, high] != [0; 2] {
            rng.set_word_pos(u128::from(high) << 64 | u128::from(low));
        }
        rng
    }
}

impl CompactRng {
    /// Selects another stream of the seed, at the same position.
    pub fn set_stream(&mut self, stream: u64) {
        self.stream = stream;
    }

    /// Calls a function with the generator, and keeps the generator's state after it.
    pub fn with<X>(&mut self, function: impl FnOnce(&mut Rng) -> X) -> X {
        let mut rng = Rng::from(*self);
        let result = function(&mut rng);
        *self = Self::from(&rng);
        result
    }
}

/// Returns a sample of the standard normal distribution (Box and Muller 1958).
pub(crate) fn normal(rng: &mut Rng) -> f64 {
    normals(rng)[0]
}

/// Returns two independent samples of the standard normal distribution.
pub(crate) fn normals(rng: &mut Rng) -> [f64; 2] {
    // uniform in (0, 1] with 53 bits, because the logarithm of 0 is infinite
    let u = ((rng.next_u64() >> 11) as f64 + 1.0) / (1_u64 << 53) as f64;
    let angle = std::f64::consts::TAU * rng.random::<f64>();
    let (sin, cos) = angle.sin_cos();
    let radius = (-2.0 * u.ln()).sqrt();
    [radius * cos, radius * sin]
}

#[cfg(test)]
mod tests {
    use super::{CompactRng, Rng};
    use proptest::prelude::{prop_assert_eq, proptest};
    use rand::{Rng as _, SeedableRng as _};

    proptest! {
        #[test]
        fn a_compact_generator_continues_the_stream(seed: u64, stream: u64, before in 0..300_usize) {
            let mut rng = Rng::seed_from_u64(seed);
            rng.set_stream(stream);
            // also odd numbers of words, which leave half of a number in the buffer
            (0..before).for_each(|_| _ = rng.next_u32());
            let mut compact = CompactRng::from(&rng);
            for _ in 0..3 {
                prop_assert_eq!(compact.with(|rng| [rng.next_u64(), rng.next_u64()]), [rng.next_u64(), rng.next_u64()]);
                prop_assert_eq!(compact.with(|rng| rng.next_u32()), rng.next_u32());
            }
        }
    }
}
