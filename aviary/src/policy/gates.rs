//! Activation functions of gates, in SIMD registers.
//!
//! Both functions consist of additions, multiplications, divisions, minima and maxima, none of them fused. They are
//! therefore bit-identical for all instruction sets, in contrast to functions of a system's mathematical library.

use pulp::Simd;

/// Bound of the argument of tanh: beyond it, tanh differs from ±1 by less than 2.8e-7.
pub const BOUND: f32 = 7.9;

/// Coefficients of x, x³, x⁵, x⁷ and x⁹ in the numerator of tanh.
pub const NUMERATOR: [f32; 5] = [1.0, 0.134_506_24, 0.003_578_995_8, 2.202_330_9e-5, 1.542_806_2e-8];

/// Coefficients of 1, x², x⁴, x⁶ and x⁸ in the denominator of tanh.
pub const DENOMINATOR: [f32; 5] = [1.0, 0.467_839_5, 0.026_192_252, 0.000_342_365_67, 8.598_816_5e-7];

/// Returns the hyperbolic tangent, with a relative error of up to 4e-7 and an absolute value of up to 1.
///
/// A rational function approximates tanh on [−7.9, 7.9]: the quotient of two polynomials of degrees 9 and 8, fitted to
/// the least maximum of the relative error, 6e-9 before rounding. Larger arguments are clamped.
#[inline(always)]
pub fn tanh<S: Simd>(simd: S, x: S::f32s) -> S::f32s {
    // in this order of the arguments, NaN remains NaN
    let x = simd.max_f32s(simd.splat_f32s(-BOUND), simd.min_f32s(simd.splat_f32s(BOUND), x));
    let square = simd.mul_f32s(x, x);
    let numerator = simd.mul_f32s(x, polynomial(simd, &NUMERATOR, square));
    simd.div_f32s(numerator, polynomial(simd, &DENOMINATOR, square))
}

/// Returns the logistic function 1 / (1 + e⁻ˣ) = ½ + ½·tanh(x / 2), with an absolute error of up to 3e-7.
#[inline(always)]
pub fn sigmoid<S: Simd>(simd: S, x: S::f32s) -> S::f32s {
    let half = simd.splat_f32s(0.5);
    simd.add_f32s(half, simd.mul_f32s(half, tanh(simd, simd.mul_f32s(half, x))))
}

/// Returns the polynomial with these coefficients, the constant first, by Horner's method.
#[inline(always)]
fn polynomial<S: Simd>(simd: S, coefficients: &[f32; 5], x: S::f32s) -> S::f32s {
    // without a closure or an iterator, which the compiler may not inline into a function with other instructions
    let [a, b, c, d, e] = *coefficients;
    let mut sum = simd.splat_f32s(e);
    sum = simd.add_f32s(simd.mul_f32s(sum, x), simd.splat_f32s(d));
    sum = simd.add_f32s(simd.mul_f32s(sum, x), simd.splat_f32s(c));
    sum = simd.add_f32s(simd.mul_f32s(sum, x), simd.splat_f32s(b));
    simd.add_f32s(simd.mul_f32s(sum, x), simd.splat_f32s(a))
}

#[cfg(test)]
mod tests {
    use pulp::{Scalar128b, WithSimd};

    use super::*;

    /// Both functions for all arguments.
    struct Both<'a>(&'a [f32], &'a mut [Vec<f32>; 2]);

    impl WithSimd for Both<'_> {
        type Output = ();

        #[inline(always)]
        fn with_simd<S: Simd>(self, simd: S) {
            let Self(arguments, [tanhs, sigmoids]) = self;
            let mut row = [0.0_f32; 16];
            for chunk in arguments.chunks_exact(16) {
                for (function, out) in [(true, &mut *tanhs), (false, &mut *sigmoids)] {
                    row.copy_from_slice(chunk);
                    let (registers, _) = S::as_mut_simd_f32s(&mut row);
                    for x in registers {
                        *x = if function { tanh(simd, *x) } else { sigmoid(simd, *x) };
                    }
                    out.extend_from_slice(&row);
                }
            }
        }
    }

    #[test]
    fn functions_match_double_precision_and_are_bit_identical_for_all_instruction_sets() {
        let mut arguments: Vec<f32> = (-640_000..=640_000).map(|k| k as f32 / 64_000.0).collect();
        arguments.extend((0..4000).map(|k| 1e-30 * (k as f32 * 0.0175).exp()));
        arguments.extend([1e30, -1e30, f32::MAX, f32::INFINITY, f32::NEG_INFINITY, 0.0, -0.0, f32::MIN_POSITIVE]);
        arguments.resize(arguments.len().next_multiple_of(16), 100.0);
        let mut found = [Vec::new(), Vec::new()];
        pulp::Arch::new().dispatch(Both(&arguments, &mut found));
        let mut portable = [Vec::new(), Vec::new()];
        Both(&arguments, &mut portable).with_simd(Scalar128b);
        let bits = |lists: &[Vec<f32>; 2]| lists.concat().iter().map(|x| x.to_bits()).collect::<Vec<_>>();
        assert_eq!(bits(&found), bits(&portable));
        for ((&x, &tanh), &sigmoid) in arguments.iter().zip(&found[0]).zip(&found[1]) {
            let exact = f64::from(x).tanh();
            assert!((f64::from(tanh) - exact).abs() <= 4e-7 * exact.abs(), "tanh {x}: {tanh} and {exact}");
            let exact = 1.0 / (1.0 + (-f64::from(x)).exp());
            assert!((f64::from(sigmoid) - exact).abs() <= 3e-7, "sigmoid {x}: {sigmoid} and {exact}");
            assert!(tanh.abs() <= 1.0 && (0.0..=1.0).contains(&sigmoid));
        }
        let mut nans = [Vec::new(), Vec::new()];
        pulp::Arch::new().dispatch(Both(&[f32::NAN; 16], &mut nans));
        assert!(nans.concat().iter().all(|x| x.is_nan()));
    }
}
