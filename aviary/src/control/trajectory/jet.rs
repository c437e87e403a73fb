use std::ops::{Add, Mul, Sub};

/// A function value with its first four time derivatives, as Taylor coefficients f⁽ᵏ⁾/k!.
///
/// Sums, products, sines and compositions of jets have exact derivatives (Griewank and Walther 2008, *Evaluating
/// Derivatives*, §13.2).
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Jet([f64; 5]);

impl Jet {
    pub(super) const fn constant(value: f64) -> Self {
        Self([value, 0.0, 0.0, 0.0, 0.0])
    }

    /// Creates the jet of the time.
    pub(super) const fn time(value: f64) -> Self {
        Self([value, 1.0, 0.0, 0.0, 0.0])
    }

    pub(super) fn value(&self) -> f64 {
        self.0[0]
    }

    /// Returns the k-th derivative, k ≤ 4.
    pub(super) fn derivative(&self, k: usize) -> f64 {
        const FACTORIALS: [f64; 5] = [1.0, 1.0, 2.0, 6.0, 24.0];
        self.0[k] * FACTORIALS[k]
    }

    /// Returns Σ coefficients\[k\]·xᵏ.
    pub(super) fn polynomial(self, coefficients: &[f64]) -> Self {
        coefficients.iter().rev().fold(Self::constant(0.0), |sum, &c| sum * self + Self::constant(c))
    }

    pub(super) fn sin_cos(self) -> (Self, Self) {
        let (mut s, mut c) = ([0.0; 5], [0.0; 5]);
        (s[0], c[0]) = self.0[0].sin_cos();
        for k in 1..5 {
            for j in 1..=k {
                let share = j as f64 / k as f64 * self.0[j];
                s[k] += share * c[k - j];
                c[k] -= share * s[k - j];
            }
        }
        (Self(s), Self(c))
    }
}

impl Add for Jet {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self(std::array::from_fn(|k| self.0[k] + other.0[k]))
    }
}

impl Sub for Jet {
    type Output = Self;

    fn sub(self, other: Self) -> Self {
        Self(std::array::from_fn(|k| self.0[k] - other.0[k]))
    }
}

impl Mul for Jet {
    type Output = Self;

    fn mul(self, other: Self) -> Self {
        Self(std::array::from_fn(|k| (0..=k).map(|j| self.0[j] * other.0[k - j]).sum()))
    }
}

impl Mul<f64> for Jet {
    type Output = Self;

    fn mul(self, factor: f64) -> Self {
        Self(self.0.map(|x| x * factor))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn derivatives_of_a_sine_of_a_polynomial_are_exact() {
        // f(t) = sin(t²): f'' = 2·cos(t²) − 4t²·sin(t²), f''' = −12t·sin(t²) − 8t³·cos(t²),
        // f'''' = −12·sin(t²) − 48t²·cos(t²) + 16t⁴·sin(t²)
        for t in [-1.3, 0.0, 0.4, 2.0] {
            let (f, g) = Jet::time(t).polynomial(&[0.0, 0.0, 1.0]).sin_cos();
            let (s, c) = (t * t).sin_cos();
            let expected = [
                s,
                2.0 * t * c,
                2.0 * c - 4.0 * t * t * s,
                -12.0 * t * s - 8.0 * t.powi(3) * c,
                -12.0 * s - 48.0 * t * t * c + 16.0 * t.powi(4) * s,
            ];
            for (k, expected) in expected.into_iter().enumerate() {
                assert!((f.derivative(k) - expected).abs() < 1e-9, "t = {t}, k = {k}");
            }
            let one = f * f + g * g;
            assert!((one.value() - 1.0).abs() < 1e-12 && (1..5).all(|k| one.derivative(k).abs() < 1e-9));
        }
    }
}
