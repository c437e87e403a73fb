//! Dryden turbulence: standard deviations, length scales and filters.

use crate::names::named_enum;

named_enum! {
    "Dryden filter"
    /// Filter of the Dryden turbulence.
    ///
    /// Both filters use the standard deviations σ and the length scales L of [`dryden`]. With T = L/V and the
    /// airspeed V, the autocorrelation at a lag τ is
    ///
    /// | component | `first_order` | `mil_f_8785c` |
    /// | --- | --- | --- |
    /// | longitudinal (along the mean wind) | σ²·exp(−τ/T) | σ²·exp(−τ/T) |
    /// | lateral and vertical | σ²·exp(−τ/T) | σ²·exp(−τ/T)·(1 − τ/2T) |
    ///
    /// ```
    /// use aviary::physics::wind::{DrydenFilter, WindConfig, WindModel};
    ///
    /// let wind = WindConfig { filter: DrydenFilter::MilF8785c, ..WindConfig::new(WindModel::Dryden) };
    /// assert!(wind.validate().is_ok());
    /// ```
    #[derive(Default)]
    pub enum DrydenFilter {
        /// First-order noise on every axis, the paper's recursion: x ← α·x + σ·√(1 − α²)·ξ with α = exp(−dt/T).
        #[default]
        FirstOrder = "first_order",
        /// Spectra of MIL-F-8785C, §3.7.2.1: a first-order filter for the longitudinal component, and the
        /// second-order filter (1 + √3·T·s)/(1 + T·s)² for the lateral and the vertical component.
        MilF8785c = "mil_f_8785c",
    }
}

/// Returns the standard deviations (m/s) and the length scales (m) of low-altitude turbulence by MIL-F-8785C,
/// §3.7.2.5.
///
/// The order is longitudinal, lateral, vertical. `height` is in m; `turbulence` is the mean wind speed at 20 feet,
/// m/s. The function clamps the height to the range of the model, 10 to 1,000 feet. Both [filters](DrydenFilter) use
/// these scales.
///
/// ```
/// use aviary::physics::wind::dryden;
///
/// // vertical: σ is a tenth of the mean wind speed, L is the height
/// let ([_, _, sigma], [_, _, length]) = dryden(30.0, 4.0);
/// assert!((sigma - 0.4).abs() < 1e-12 && (length - 30.0).abs() < 1e-9);
/// ```
pub fn dryden(height: f64, turbulence: f64) -> ([f64; 3], [f64; 3]) {
    let h = feet(height);
    let shape = 0.177 + 8.23e-4 * h;
    let horizontal = h / shape.powf(1.2) * FOOT;
    let vertical = 0.1 * turbulence;
    let sideways = vertical / shape.powf(0.4);
    ([sideways, sideways, vertical], [horizontal, horizontal, h * FOOT])
}

const FOOT: f64 = 0.3048;

/// Returns the height in feet, clamped to the range of the model.
#[inline]
pub(super) fn feet(height: f64) -> f64 {
    (height / FOOT).clamp(10.0, 1000.0)
}

/// State of the filter (1 + √3·T·s)/(1 + T·s)² under white noise, with an output of variance 1.
///
/// With T·ṗ = −p + noise and T·ṙ = −r + p the output is √3·p + (1 − √3)·r. A step of s = dt/T multiplies (p, r) by
/// e⁻ˢ·[[1, 0], [s, 1]] and adds normal noise of covariance ∫₀ˢ [[1, u], [u, u²]]·e⁻²ᵘ du. This discretization is
/// exact for steps of any length.
#[derive(Debug, Clone, Copy, Default, serde::Serialize, serde::Deserialize)]
pub(super) struct SecondOrder {
    p: f64,
    r: f64,
}

impl SecondOrder {
    /// Samples a state from the stationary distribution, of covariance [[1/2, 1/4], [1/4, 1/4]], with two standard
    /// normal samples.
    pub(super) fn stationary([a, b]: [f64; 2]) -> Self {
        let p = 0.5_f64.sqrt() * a;
        Self { p, r: 0.5 * p + 0.125_f64.sqrt() * b }
    }

    /// Advances the state by `s` time constants with two standard normal samples.
    #[inline]
    pub(super) fn advance(&mut self, s: f64, [a, b]: [f64; 2]) {
        let decay = (-s).exp();
        let [[pp, pr], [_, rr]] = Self::covariance(s);
        // Cholesky factor of the covariance; zero for a step of length zero
        let first = pp.sqrt();
        let second = if first > 0.0 { pr / first } else { 0.0 };
        let third = (rr - second * second).max(0.0).sqrt();
        let (p, r) = (self.p, self.r);
        self.p = decay * p + first * a;
        self.r = decay * (s * p + r) + second * a + third * b;
    }

    /// Returns ∫₀ˢ [[1, u], [u, u²]]·e⁻²ᵘ du.
    fn covariance(s: f64) -> [[f64; 2]; 2] {
        let pp = -0.5 * (-2.0 * s).exp_m1();
        let (pr, rr) = if s < 0.125 {
            // the closed forms below suffer from cancellation; this is the integrated exponential series
            let (mut term, mut pr, mut rr) = (1.0, 0.0, 0.0);
            for k in 0..12 {
                let order = f64::from(k);
                pr += term / (order + 2.0);
                rr += term / (order + 3.0);
                term *= -2.0 * s / (order + 1.0);
            }
            (pr * s * s, rr * s * s * s)
        } else {
            let decay = (-2.0 * s).exp();
            (0.25 - decay * (0.5 * s + 0.25), 0.25 - decay * (0.5 * s * s + 0.5 * s + 0.25))
        };
        [[pp, pr], [pr, rr]]
    }

    #[inline]
    pub(super) fn output(self) -> f64 {
        let root = 3.0_f64.sqrt();
        root * self.p + (1.0 - root) * self.r
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A step of the second-order filter preserves the stationary covariance for any step length.
    #[test]
    fn the_second_order_filter_is_stationary_for_any_step_length() {
        for exponent in -40..=10 {
            let s = 2f64.powi(exponent);
            let [[pp, pr], [_, rr]] = SecondOrder::covariance(s);
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
        assert_eq!(SecondOrder::covariance(0.0), [[0.0; 2]; 2]);
        // two half steps equal one whole step
        let (a, b) = (SecondOrder { p: 0.3, r: -0.8 }, SecondOrder { p: 0.3, r: -0.8 });
        let (mut whole, mut halves) = (a, b);
        whole.advance(0.2, [0.0; 2]);
        (0..2).for_each(|_| halves.advance(0.1, [0.0; 2]));
        assert!((whole.p - halves.p).abs() < 1e-15 && (whole.r - halves.r).abs() < 1e-15);
    }
}
