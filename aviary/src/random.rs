//! Random number generators of the simulator: a sequential one for everything that happens at resets ([`Rng`]), and a
//! counter-based one for noise in every step ([`counter`]).

pub(crate) mod counter;

use rand::{Rng as _, RngExt as _};

/// Random number generator of the simulator: seeded once per environment, bit-identical on every machine.
pub type Rng = rand_chacha::ChaCha8Rng;

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
