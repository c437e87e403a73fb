//! Dryden turbulence: its scales and filters.

use crate::names::named_enum;

named_enum! {
    "Dryden filter"
    /// Spectra of the Dryden turbulence, all with the standard deviations σ and length scales L of [`dryden`].
    ///
    /// With T = L/V, V the airspeed, the autocorrelation at a lag τ is
    ///
    /// | component | `first_order` | `mil_f_8785c` |
    /// | --- | --- | --- |
    /// | along the mean wind | σ²·exp(−τ/T) | σ²·exp(−τ/T) |
    /// | across it, and upwards | σ²·exp(−τ/T) | σ²·exp(−τ/T)·(1 − τ/2T) |
    ///
    /// ```
    /// use aviary::physics::wind::{DrydenFilter, WindConfig, WindModel};
    ///
    /// let wind = WindConfig { filter: DrydenFilter::MilF8785c, ..WindConfig::new(WindModel::Dryden) };
    /// assert!(wind.validate().is_ok());
    /// ```
    #[derive(Default)]
    pub enum DrydenFilter {
        /// First-order noise along every axis, x ← α·x + σ·√(1 − α²)·ξ with α = exp(−dt/T): the recursion of the paper.
        #[default]
        FirstOrder = "first_order",
        /// The spectra of MIL-F-8785C, §3.7.2.1: a first-order filter along the mean wind, the second-order filter
        /// (1 + √3·T·s)/(1 + T·s)² across it and upwards.
        MilF8785c = "mil_f_8785c",
    }
}

/// Scales of low-altitude turbulence by MIL-F-8785C (§3.7.2.5), which both [filters](DrydenFilter) have: standard deviations (m/s) and length scales (m) along the mean wind,
/// across it and upwards, at a height (m) and for a mean wind at 20 feet (m/s). Heights below 10 and above 1,000 feet, where
/// the model ends, count as those.
///
/// ```
/// use aviary::physics::wind::dryden;
///
/// // upwards: a tenth of the mean wind, and the height
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

/// Height in feet, within the model's limits.
#[inline]
pub(super) fn feet(height: f64) -> f64 {
    (height / FOOT).clamp(10.0, 1000.0)
}

/// The filter (1 + √3·T·s)/(1 + T·s)² under white noise, with an output of variance 1.
///
/// With T·ṗ = −p + noise and T·ṙ = −r + p the output is √3·p + (1 − √3)·r. Over a step of s = dt/T both are multiplied by
/// e⁻ˢ·[[1, 0], [s, 1]] and gain normal noise of covariance ∫₀ˢ [[1, u], [u, u²]]·e⁻²ᵘ du: the discretization is exact for
/// steps of any length.
#[derive(Debug, Clone, Copy, Default, serde::Serialize, serde::Deserialize)]
pub(super) struct SecondOrder {
    p: f64,
    r: f64,
}

impl SecondOrder {
    /// From the stationary distribution, of covariance [[1/2, 1/4], [1/4, 1/4]], by two normal draws.
    pub(super) fn stationary([a, b]: [f64; 2]) -> Self {
        let p = 0.5_f64.sqrt() * a;
        Self { p, r: 0.5 * p + 0.125_f64.sqrt() * b }
    }

    /// Goes through a step of `s` time constants with two normal draws.
    #[inline]
    pub(super) fn advance(&mut self, s: f64, [a, b]: [f64; 2]) {
        let decay = (-s).exp();
        let [[pp, pr], [_, rr]] = Self::covariance(s);
        // Cholesky's factor; no noise in a step of no length
        let first = pp.sqrt();
        let second = if first > 0.0 { pr / first } else { 0.0 };
        let third = (rr - second * second).max(0.0).sqrt();
        let (p, r) = (self.p, self.r);
        self.p = decay * p + first * a;
        self.r = decay * (s * p + r) + second * a + third * b;
    }

    /// ∫₀ˢ [[1, u], [u, u²]]·e⁻²ᵘ du.
    fn covariance(s: f64) -> [[f64; 2]; 2] {
        let pp = -0.5 * (-2.0 * s).exp_m1();
        let (pr, rr) = if s < 0.125 {
            // the closed forms below cancel: integrals of the terms of the exponential series
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

    /// A step of a filter of second order keeps the stationary covariance, for steps of every length.
    #[test]
    fn the_second_order_filter_is_stationary_in_steps_of_every_length() {
        for exponent in -40..=10 {
            let s = 2f64.powi(exponent);
            let [[pp, pr], [_, rr]] = SecondOrder::covariance(s);
            let decay = (-2.0 * s).exp();
            // Φ·Σ·Φᵀ + Q = Σ
            assert!((decay * 0.5 + pp - 0.5).abs() < 1e-15, "{s}");
            assert!((decay * (0.5 * s + 0.25) + pr - 0.25).abs() < 1e-15, "{s}");
            assert!((decay * (0.5 * s * s + 0.5 * s + 0.25) + rr - 0.25).abs() < 1e-15, "{s}");
            // the noise of short steps is that of twice integrated white noise, s³/3 and s³/12 about the regression
            if s < 1e-3 {
                assert!((rr / s.powi(3) * 3.0 - 1.0).abs() < 2.0 * s && rr * pp - pr * pr > 0.0, "{s}");
            }
        }
        assert_eq!(SecondOrder::covariance(0.0), [[0.0; 2]; 2]);
        // two half steps are a whole one
        let (a, b) = (SecondOrder { p: 0.3, r: -0.8 }, SecondOrder { p: 0.3, r: -0.8 });
        let (mut whole, mut halves) = (a, b);
        whole.advance(0.2, [0.0; 2]);
        (0..2).for_each(|_| halves.advance(0.1, [0.0; 2]));
        assert!((whole.p - halves.p).abs() < 1e-15 && (whole.r - halves.r).abs() < 1e-15);
    }
}
