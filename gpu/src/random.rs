//! Random numbers: Philox4x32-10, a function of a key and a counter, so that no thread keeps a generator
//! (J. K. Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC11).

use flight::math::V3;
use flight::random::NormalPair;

use crate::number::{Number, Word};

const MULTIPLIERS: [u32; 2] = [0xd251_1f53, 0xcd9e_8d57];
const WEYL: [u32; 2] = [0x9e37_79b9, 0xbb67_ae85];
const ROUNDS: u32 = 10;

/// Returns the four words of a counter under a key.
///
/// ```
/// # #[cfg(feature = "wgpu")]
/// # {
/// use aviary_gpu::philox;
///
/// // known answer of the authors' library Random123
/// assert_eq!(philox([0; 2], [0; 4]), [0x6627e8d5, 0xe169c58d, 0xbc57ac4c, 0x9b00dbd8]);
/// # }
/// ```
pub fn philox<W: Word>(key: [W; 2], counter: [W; 4]) -> [W; 4] {
    let ([mut k0, mut k1], [mut a, mut b, mut c, mut d]) = (key, counter);
    let [m0, m1] = MULTIPLIERS.map(W::of);
    for round in 0..ROUNDS {
        if round > 0 {
            k0 = k0.plus(W::of(WEYL[0]));
            k1 = k1.plus(W::of(WEYL[1]));
        }
        (a, b, c, d) = (m1.times_high(c).xor(b).xor(k0), m1.times(c), m0.times_high(a).xor(d).xor(k1), m0.times(a));
    }
    [a, b, c, d]
}

/// Stream of random numbers in an episode.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Stream<W> {
    /// Numbers that the drones of a world share.
    World,
    /// One drone.
    Drone(W),
}

/// Random numbers of one episode of one environment. The numbers depend on the seed, the index of the environment, the
/// number of the episode and the stream, and not on the size of the batch.
pub(crate) struct Draws<N: Number> {
    key: [N::Word; 2],
    environment: N::Word,
    episode: N::Word,
    stream: N::Word,
    block: u32,
    words: [N::Word; 4],
    used: usize,
}

impl<N: Number> Draws<N> {
    /// Creates the numbers of an episode.
    pub fn new(key: [N::Word; 2], environment: N::Word, episode: N::Word, stream: Stream<N::Word>) -> Self {
        let stream = match stream {
            Stream::World => N::Word::of(u32::MAX),
            Stream::Drone(drone) => drone,
        };
        Self { key, environment, episode, stream, block: 0, words: [key[0]; 4], used: 4 }
    }

    /// Returns the next random integer.
    pub fn word(&mut self) -> N::Word {
        if self.used == 4 {
            let counter = [self.environment, self.episode, N::Word::of(self.block), self.stream];
            self.words = philox(self.key, counter);
            (self.block, self.used) = (self.block + 1, 0);
        }
        self.used += 1;
        self.words[self.used - 1]
    }

    /// Returns a number between −1 and 1. It is the same in both precisions, except for rounding.
    pub fn symmetric(&mut self) -> N {
        let number = N::of_word(self.word());
        (number + 0.5) * (2.0 / 4_294_967_296.0) - 1.0
    }

    /// Returns a number between 0 and 1.
    pub fn unit(&mut self) -> N {
        let number = N::of_word(self.word());
        (number + 0.5) * (1.0 / 4_294_967_296.0)
    }

    /// Returns a number within a range.
    pub fn within(&mut self, [low, high]: [f64; 2]) -> N {
        self.unit() * (high - low) + low
    }

    /// Returns three numbers between −1 and 1.
    pub fn symmetric_triple(&mut self) -> V3<N> {
        V3::new(self.symmetric(), self.symmetric(), self.symmetric())
    }

    /// Returns two independent standard normal numbers.
    pub fn normals(&mut self) -> [N; 2] {
        let none = N::Word::of(0);
        let [radius, angle] = [self.word(), self.word()].map(|word| N::wide(word, none));
        NormalPair::new(radius, angle).samples()
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// Known answers of Random123 1.09 (`kat_vectors`).
    pub const KNOWN: [([u32; 2], [u32; 4], [u32; 4]); 3] = [
        ([0; 2], [0; 4], [0x6627_e8d5, 0xe169_c58d, 0xbc57_ac4c, 0x9b00_dbd8]),
        ([u32::MAX; 2], [u32::MAX; 4], [0x408f_276d, 0x41c8_3b0e, 0xa20b_c7c6, 0x6d54_51fd]),
        (
            [0xa409_3822, 0x299f_31d0],
            [0x243f_6a88, 0x85a3_08d3, 0x1319_8a2e, 0x0370_7344],
            [0xd16c_fe09, 0x94fd_cceb, 0x5001_e420, 0x2412_6ea1],
        ),
    ];

    #[test]
    fn philox_has_the_known_answers() {
        for (key, counter, expected) in KNOWN {
            assert_eq!(philox(key, counter), expected);
        }
    }

    #[test]
    fn symmetric_numbers_are_uniform() {
        // Kolmogorov–Smirnov at the level of 1e-6
        let mut numbers: Vec<f64> = (0..20_000)
            .flat_map(|environment| {
                let mut draws = Draws::<f64>::new([1, 2], environment, 3, Stream::World);
                [draws.symmetric(), draws.symmetric(), draws.symmetric(), draws.symmetric(), draws.symmetric()]
            })
            .collect();
        numbers.sort_by(f64::total_cmp);
        let count = numbers.len() as f64;
        let distance = numbers.iter().enumerate().map(|(index, x)| ((x + 1.0) / 2.0 - index as f64 / count).abs());
        assert!(distance.fold(0.0, f64::max) < 2.7 / count.sqrt());
    }
}
