//! Adam (Kingma & Ba 2015) over all parameters as one vector.

use aviary::engine::flight::Width;
use pulp::{Simd, WithSimd};

use crate::gradient::run;

/// Decay rates of the moments, β₁ and β₂.
pub const DECAY: [f32; 2] = [0.9, 0.999];

/// Lower bound of the step's denominator, ε.
pub const EPSILON: f32 = 1e-5;

/// State of Adam: number of steps, first and second moments.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Moments {
    pub time: usize,
    pub first: Vec<f32>,
    pub second: Vec<f32>,
}

impl Moments {
    /// Returns the state before the first step.
    pub fn new(count: usize) -> Self {
        Self { time: 0, first: vec![0.0; count], second: vec![0.0; count] }
    }

    /// Updates the parameters by one step against `scale` times the gradient.
    pub fn step(&mut self, width: Width, rate: f64, parameters: &mut [f32], gradient: &[f32], scale: f32) {
        self.time += 1;
        let power = self.time.min(i32::MAX as usize) as i32;
        let [first, second] = DECAY.map(|decay| 1.0 - decay.powi(power));
        let root = second.sqrt();
        let (rate, epsilon) = ((rate * f64::from(root / first)) as f32, EPSILON * root);
        run(width, Step { moments: self, parameters, gradient, scale, rate, epsilon });
    }
}

/// A step of Adam.
struct Step<'a> {
    moments: &'a mut Moments,
    parameters: &'a mut [f32],
    gradient: &'a [f32],
    scale: f32,
    rate: f32,
    epsilon: f32,
}

impl WithSimd for Step<'_> {
    type Output = ();

    /// The compiler vectorizes the loop for the instruction set, without fused operations.
    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Self { moments: Moments { first, second, .. }, parameters, gradient, scale, rate, epsilon } = self;
        for (((parameter, gradient), first), second) in parameters.iter_mut().zip(gradient).zip(first).zip(second) {
            let x = scale * gradient;
            *first = DECAY[0] * *first + (1.0 - DECAY[0]) * x;
            *second = DECAY[1] * *second + (1.0 - DECAY[1]) * (x * x);
            *parameter -= rate * *first / (second.sqrt() + epsilon);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_match_the_algorithm_in_double_precision_on_every_instruction_set() {
        let gradients = |step: usize| -> Vec<f32> { (0..37).map(|k| ((3 * k + 7 * step) as f32).sin()).collect() };
        let mut expected: Vec<[f64; 3]> = (0..37).map(|k| [f64::from((k as f32).cos()), 0.0, 0.0]).collect();
        for step in 0..20 {
            let correction = |decay: f64| 1.0 - decay.powi(step as i32 + 1);
            for ([x, first, second], gradient) in expected.iter_mut().zip(gradients(step)) {
                let gradient = 0.7_f32 as f64 * f64::from(gradient);
                *first = 0.9 * *first + 0.1 * gradient;
                *second = 0.999 * *second + 0.001 * gradient * gradient;
                *x -= 0.01 * (*first / correction(0.9)) / ((*second / correction(0.999)).sqrt() + 1e-5);
            }
        }
        let run = |width: Width| {
            let (mut moments, mut parameters) =
                (Moments::new(37), (0..37).map(|k| (k as f32).cos()).collect::<Vec<_>>());
            for step in 0..20 {
                moments.step(width, 0.01, &mut parameters, &gradients(step), 0.7);
            }
            (moments, parameters)
        };
        let (moments, parameters) = run(Width::best());
        for (x, [expected, ..]) in parameters.iter().zip(expected) {
            assert!((f64::from(*x) - expected).abs() < 1e-5, "{x} {expected}");
        }
        for width in Width::available() {
            assert_eq!(run(width), (moments.clone(), parameters.clone()), "{width}");
        }
    }
}
