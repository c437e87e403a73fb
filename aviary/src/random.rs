//! The generator behind every random draw.

use rand::{Rng as _, RngExt as _};

/// The generator behind every random draw: seeded once per environment, the same bits on every machine.
pub type Rng = rand_chacha::ChaCha8Rng;

/// A standard normal draw (Box and Muller 1958).
pub(crate) fn normal(rng: &mut Rng) -> f64 {
    normals(rng)[0]
}

/// Two independent standard normal draws.
pub(crate) fn normals(rng: &mut Rng) -> [f64; 2] {
    // 53 bits, never zero
    let u = ((rng.next_u64() >> 11) as f64 + 1.0) / (1_u64 << 53) as f64;
    let angle = std::f64::consts::TAU * rng.random::<f64>();
    let (sin, cos) = angle.sin_cos();
    let radius = (-2.0 * u.ln()).sqrt();
    [radius * cos, radius * sin]
}
