//! Dryden turbulence: standard deviations, length scales and filters.

use crate::math::{Real, SHORT, polynomial};

/// Returns the standard deviations (m/s) and the length scales (m) of low-altitude turbulence by MIL-F-8785C,
/// §3.7.2.5.
///
/// The order is longitudinal, lateral, vertical. `height` is in m; `turbulence` is the mean wind speed at 20 feet,
/// m/s. The function clamps the height to the range of the model, 10 to 1,000 feet. The filters of first and of
/// second order use these scales.
///
/// ```
/// use flight::wind::dryden;
///
/// // vertical: σ is a tenth of the mean wind speed, L is the height
/// let ([_, _, sigma], [_, _, length]) = dryden(30.0, 4.0);
/// assert!((sigma - 0.4).abs() < 1e-12 && (length - 30.0).abs() < 1e-9);
/// ```
pub fn dryden(height: f64, turbulence: f64) -> ([f64; 3], [f64; 3]) {
    let scales = Scales::at(height);
    let vertical = SIGMA_OF_WIND * turbulence;
    let sideways = vertical * scales.sideways;
    let [horizontal, upwards] = scales.inverse_lengths.map(|inverse| 1.0 / inverse);
    ([sideways, sideways, vertical], [horizontal, horizontal, upwards])
}

const FOOT: f64 = 0.3048;

/// Vertical standard deviation of the turbulence over the mean wind speed at 20 feet.
pub const SIGMA_OF_WIND: f64 = 0.1;

/// Limit of the velocity of the turbulence along each axis, standard deviations. A normal sample exceeds it with a
/// probability of 1.5e-23. The limit has no other purpose than to bound the travel of a drone.
pub const MAX_SIGMAS: f64 = 10.0;

/// Returns a bound of the speed of the turbulence, m/s. `turbulence` is the mean wind speed at 20 feet, m/s.
pub fn max_speed(turbulence: f64) -> f64 {
    // the standard deviations are largest near the ground
    let ([x, y, z], _) = dryden(0.0, turbulence);
    MAX_SIGMAS * (x * x + y * y + z * z).sqrt()
}

/// Standard deviations and length scales of the turbulence at a height. The lateral ones equal the longitudinal ones.
#[derive(Debug, Clone, Copy)]
pub struct Scales<R> {
    /// Longitudinal over vertical standard deviation.
    pub sideways: R,
    /// Reciprocals of the longitudinal and the vertical length scale, 1/m.
    pub inverse_lengths: [R; 2],
}

impl<R: Real> Scales<R> {
    /// Range of heights of the model, m.
    const HEIGHTS: [f64; 2] = [10.0 * FOOT, 1000.0 * FOOT];

    /// Computes the scales at a height, m, which it clamps to the range of the model.
    #[inline(always)]
    pub fn at(height: R) -> Self {
        let [min, max] = Self::HEIGHTS.map(|bound| height.all(bound));
        if R::any(min.less(height)) {
            return Self::within(height.greater(min).lesser(max));
        }
        // near the ground, where most drones fly, the scales are constants
        let ground = Scales::<f64>::within(Scales::<f64>::HEIGHTS[0]);
        Self {
            sideways: height.all(ground.sideways),
            inverse_lengths: [height.all(ground.inverse_lengths[0]), height.all(ground.inverse_lengths[1])],
        }
    }

    #[inline(always)]
    fn within(height: R) -> Self {
        // between 0.185 and 1
        let shape = height * (8.23e-4 / FOOT) + 0.177;
        // shape^(−1/5): a polynomial with an error of 0.14 %, and three steps of Newton's method
        let mut root = shape * 1.349_738 - 3.982_602;
        for coefficient in [4.551_84, -2.681_803, 1.764_243] {
            root = root * shape + coefficient;
        }
        for _ in 0..3 {
            let square = root * root;
            let error = -(square * square * root * shape) + 1.0;
            root = root + root * error * 0.2;
        }
        let square = root * root;
        let inverse = height.all(1.0) / height;
        let power = shape * square;
        Self { sideways: square, inverse_lengths: [power * power * inverse, inverse] }
    }
}

/// State of the filter (1 + √3·T·s)/(1 + T·s)² under white noise, with an output of variance 1.
///
/// With T·ṗ = −p + noise and T·ṙ = −r + p the output is √3·p + (1 − √3)·r. A step of s = dt/T multiplies (p, r) by
/// e⁻ˢ·[[1, 0], [s, 1]] and adds normal noise of covariance ∫₀ˢ [[1, u], [u, u²]]·e⁻²ᵘ du. This discretization is
/// exact for steps of any length.
#[derive(Debug, Clone, Copy)]
pub struct SecondOrder<R> {
    /// Output of the first stage.
    pub p: R,
    /// Output of the second stage.
    pub r: R,
}

impl<R: Real> SecondOrder<R> {
    /// Samples a state from the stationary distribution, of covariance [[1/2, 1/4], [1/4, 1/4]], with two standard
    /// normal samples.
    #[inline(always)]
    pub fn stationary([a, b]: [R; 2]) -> Self {
        let p = a * 0.5_f64.sqrt();
        Self { p, r: p * 0.5 + b * 0.125_f64.sqrt() }
    }

    /// Returns the state after `s` time constants with two standard normal samples; `decay` is e⁻ˢ.
    #[inline(always)]
    pub fn advance(self, s: R, decay: R, [a, b]: [R; 2]) -> Self {
        let [pp, pr, rr] = Self::covariance(s, decay);
        let zero = s.all(0.0);
        // Cholesky factor of the covariance; zero for a step of length zero
        let first = pp.sqrt();
        let second = R::choose(zero.less(first), pr / first, zero);
        let third = (rr - second * second).greater(zero).sqrt();
        Self { p: decay * self.p + first * a, r: decay * (s * self.p + self.r) + second * a + third * b }
    }

    /// Returns ∫₀ˢ e⁻²ᵘ du, ∫₀ˢ u·e⁻²ᵘ du and ∫₀ˢ u²·e⁻²ᵘ du; `decay` is e⁻ˢ.
    #[inline(always)]
    fn covariance(s: R, decay: R) -> [R; 3] {
        /// Coefficients of the integrated exponential series ∫₀ˢ uⁿ⁻¹·e⁻²ᵘ du / sⁿ, highest power first.
        const fn series(n: u32) -> [f64; 9] {
            let (mut coefficients, mut term, mut k) = ([0.0; 9], 1.0, 0);
            while k < 9 {
                coefficients[8 - k as usize] = term / (k + n) as f64;
                k += 1;
                term *= -2.0 / k as f64;
            }
            coefficients
        }
        const SERIES: [[f64; 9]; 3] = [series(1), series(2), series(3)];
        let square = s * s;
        let [pp, pr, rr] = SERIES;
        let short = [s * polynomial(s, pp), square * polynomial(s, pr), square * s * polynomial(s, rr)];
        // the closed forms suffer from cancellation for short steps
        let is_short = s.less(s.all(SHORT));
        if !R::any(!is_short) {
            return short;
        }
        let double = decay * decay;
        let pr = s * 0.5 + 0.25;
        let long = [-(double * 0.5) + 0.5, -(double * pr) + 0.25, -(double * (square * 0.5 + s * 0.5 + 0.25)) + 0.25];
        [
            R::choose(is_short, short[0], long[0]),
            R::choose(is_short, short[1], long[1]),
            R::choose(is_short, short[2], long[2]),
        ]
    }

    /// Returns the output of the filter.
    #[inline(always)]
    pub fn output(self) -> R {
        const ROOT: f64 = 1.732_050_807_568_877_2;
        self.p * ROOT + self.r * (1.0 - ROOT)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::decay;

    /// A step of the second-order filter preserves the stationary covariance for any step length.
    #[test]
    fn the_second_order_filter_is_stationary_for_any_step_length() {
        for exponent in -40..=10 {
            let s = 2f64.powi(exponent);
            let [pp, pr, rr] = SecondOrder::covariance(s, decay(s));
            let decay = (-2.0 * s).exp();
            // Φ·Σ·Φᵀ + Q = Σ
            assert!((decay * 0.5 + pp - 0.5).abs() < 1e-15, "{s}");
            assert!((decay * (0.5 * s + 0.25) + pr - 0.25).abs() < 1e-15, "{s}");
            assert!((decay * (0.5 * s * s + 0.5 * s + 0.25) + rr - 0.25).abs() < 1e-15, "{s}");
            // for short steps the noise is that of twice integrated white noise: s³/3, and s³/12 about the regression
            if s < 1e-3 {
                assert!((rr / s.powi(3) * 3.0 - 1.0).abs() < 2.0 * s && rr * pp - pr * pr > 0.0, "{s}");
            }
        }
        assert_eq!(SecondOrder::covariance(0.0, 1.0), [0.0; 3]);
        // two half steps equal one whole step
        let start = SecondOrder { p: 0.3, r: -0.8 };
        let step = |state: SecondOrder<f64>, s: f64| state.advance(s, decay(s), [0.0; 2]);
        let (whole, halves) = (step(start, 0.2), step(step(start, 0.1), 0.1));
        assert!((whole.p - halves.p).abs() < 1e-15 && (whole.r - halves.r).abs() < 1e-15);
    }

    /// The scales are those of MIL-F-8785C to rounding, with the height clamped.
    #[test]
    fn the_scales_match_their_formulas() {
        for height in [-1.0, 0.0, 3.0, 3.048, 3.05, 3.7, 10.0, 47.11, 150.0, 304.0, 304.8, 1e4] {
            let h = (height / FOOT).clamp(10.0, 1000.0);
            let shape = 0.177 + 8.23e-4 * h;
            let expected = ([0.4 / shape.powf(0.4), 0.4], [h / shape.powf(1.2) * FOOT, h * FOOT]);
            let ([along, across, up], [long, wide, high]) = dryden(height, 4.0);
            assert_eq!((along, long), (across, wide));
            for (got, expected) in [(along, expected.0[0]), (up, 0.4), (long, expected.1[0]), (high, expected.1[1])] {
                assert!((got / expected - 1.0).abs() < 2e-15, "{height}: {got}, expected {expected}");
            }
        }
    }
}
