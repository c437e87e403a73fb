use std::f64::consts::{FRAC_1_SQRT_2, FRAC_PI_2, FRAC_PI_4, LOG2_E, PI, SQRT_2};

use super::{Bits as _, Double, Real};

/// Difference between π/2 and the double closest to it.
const FRAC_PI_2_REST: f64 = 6.123_233_995_736_766e-17;

/// tan(π/8).
const TAN_PI_8: f64 = 0.414_213_562_373_095_03;

/// Evaluates a polynomial by Horner's method, with the coefficient of the highest power first.
#[inline(always)]
pub fn polynomial<R: Real, const N: usize>(x: R, coefficients: [f64; N]) -> R {
    let mut sum = x.all(coefficients[0]);
    for &coefficient in &coefficients[1..] {
        sum = sum * x + coefficient;
    }
    sum
}

/// Clamps a number as [`f64::clamp`] does, lane by lane: NaN stays NaN.
#[inline(always)]
pub fn clamped<R: Real>(x: R, min: R, max: R) -> R {
    let above = R::choose(x.less(min), min, x);
    R::choose(max.less(above), max, above)
}

/// Returns a zero if all numbers are finite, and NaN otherwise.
#[inline(always)]
pub fn finite_zero<R: Real, const N: usize>(numbers: [R; N]) -> R {
    // infinity times zero is NaN
    let mut sum = numbers[0] * 0.0;
    for number in &numbers[1..] {
        sum = sum + *number * 0.0;
    }
    sum
}

/// Returns the angle of the point (x, y), in [−π, π], as [`f64::atan2`] for finite arguments that are not subnormal.
#[inline(always)]
pub fn atan2<R: Real>(y: R, x: R) -> R {
    R::arctan2(y, x)
}

/// Computes [`atan2`] with arithmetic alone.
#[inline(always)]
pub(super) fn arctan2<R: Real>(y: R, x: R) -> R {
    let (across, along) = (y.abs(), x.abs());
    let steep = along.less(across);
    let (min, max) = (R::choose(steep, along, across), R::choose(steep, across, along));
    // the addition theorem reduces an angle above π/8 to π/4 plus a smaller angle
    let far = (max * TAN_PI_8).less(min);
    // at the origin it divides 0 by the smallest normal number
    let above = R::choose(far, min - max, min);
    let below = R::choose(far, min + max, max.greater(x.all(R::MIN_POSITIVE)));
    let t = above / below;
    let square = t * t;
    let p = polynomial(
        square,
        [
            -8.750_608_600_031_904e-1,
            -1.615_753_718_733_365e1,
            -7.500_855_792_314_705e1,
            -1.228_866_684_490_136_2e2,
            -6.485_021_904_942_025e1,
        ],
    );
    let q = polynomial(
        square,
        [
            1.0,
            2.485_846_490_142_306_3e1,
            1.650_270_098_316_988_5e2,
            4.328_810_604_912_903e2,
            4.853_903_996_359_137e2,
            1.945_506_571_482_614e2,
        ],
    );
    let small = t + t * (square * p / q);
    let angle = R::choose(far, small + 0.5 * FRAC_PI_2_REST + FRAC_PI_4, small);
    let angle = R::choose(steep, -(angle - FRAC_PI_2_REST) + FRAC_PI_2, angle);
    // a negative zero counts as negative
    let backwards = x.all(1.0).with_sign_of(x).less(x.all(0.0));
    let angle = R::choose(backwards, -(angle - 2.0 * FRAC_PI_2_REST) + PI, angle);
    angle.with_sign_of(y)
}

/// Returns the arcsine of a number after clamping it to [−1, 1].
#[inline(always)]
pub fn asin<R: Real>(sine: R) -> R {
    R::arcsin(sine)
}

/// Computes [`asin`] with arithmetic and an arctangent.
#[inline(always)]
pub(super) fn arcsin<R: Real>(sine: R) -> R {
    let one = sine.all(1.0);
    // this order of the arguments preserves NaN
    let sine = one.lesser(sine);
    let sine = sine.all(-1.0).greater(sine);
    atan2(sine, ((one - sine) * (one + sine)).sqrt())
}

/// Rounding constant 1.5 · 2⁵²: adding it to a number below 2⁵¹ leaves the nearest integer in the low bits.
pub const ROUND: f64 = 6_755_399_441_055_744.0;

/// Returns e^x for x ≤ 0.
#[inline(always)]
pub fn exp_of_negative<R: Real>(x: R) -> R {
    R::exp_of_negative(x)
}

/// Computes [`exp_of_negative`] with arithmetic and powers of two.
#[inline(always)]
pub fn exponential<R: Real>(x: R) -> R {
    // the result underflows to zero below −750
    let x = x.greater(x.all(-750.0));
    let whole = (x * LOG2_E).rounded();
    // ln 2 in two parts; the product with the first one is exact
    let rest = (x - whole * 6.931_457_519_531_25e-1) - whole * 1.428_606_820_309_417_3e-6;
    let square = rest * rest;
    let p =
        rest * polynomial(square, [1.261_771_930_748_105_9e-4, 3.029_944_077_074_419_6e-2, 9.999_999_999_999_999e-1]);
    let q = polynomial(square, [3.001_985_051_386_644_5e-6, 2.524_483_403_496_841e-3, 2.272_655_482_081_550_3e-1, 2.0]);
    let fraction = p / (q - p) * 2.0 + 1.0;
    // two factors, because one alone would underflow where the result is subnormal
    let first = (whole * 0.5).rounded();
    fraction * first.power_of_two() * (whole - first).power_of_two()
}

/// 2 to the powers 1, 2, 4, … 512.
const POWERS: [f64; 10] = {
    let (mut powers, mut power, mut bit) = ([0.0; 10], 2.0, 0);
    while bit < 10 {
        powers[bit] = power;
        power *= power;
        bit += 1;
    }
    powers
};

/// Computes [`Real::power_of_two`] with arithmetic alone, exactly.
#[inline(always)]
pub(super) fn power_of_two<R: Real>(exponent: R) -> R {
    let is_negative = exponent.less(exponent.all(0.0));
    let (mut rest, mut power) = (exponent.abs(), exponent.all(1.0));
    for bit in (0..10).rev() {
        let value = f64::from(1_u32 << bit);
        let factor = R::choose(is_negative, power.all(1.0 / POWERS[bit]), power.all(POWERS[bit]));
        let is_absent = rest.less(rest.all(value));
        power = R::choose(is_absent, power, power * factor);
        rest = R::choose(is_absent, rest, rest - value);
    }
    power
}

/// Computes [`Real::mantissa_and_exponent`] with arithmetic alone, exactly.
#[inline(always)]
pub(super) fn mantissa_and_exponent<R: Real>(x: R) -> (R, R) {
    let (mut m, mut k) = (x, x.all(0.0));
    for bit in (0..10).rev() {
        let larger = m * POWERS[bit];
        let fits = larger.less(x.all(SQRT_2));
        m = R::choose(fits, larger, m);
        k = R::choose(fits, k - f64::from(1_u32 << bit), k);
    }
    for bit in (0..10).rev() {
        let smaller = m * (1.0 / POWERS[bit]);
        let is_too_small = smaller.less(x.all(FRAC_1_SQRT_2));
        m = R::choose(is_too_small, m, smaller);
        k = R::choose(is_too_small, k, k + f64::from(1_u32 << bit));
    }
    (m, k)
}

/// Computes [`Real::mantissa_and_exponent`] from the bit pattern.
#[inline(always)]
pub fn mantissa_and_exponent_of_bits<R: Double>(x: R) -> (R, R) {
    const EXPONENT: u64 = 0x7ff << 52;
    const ONE: u64 = 1.0_f64.to_bits();
    // adding the distance from √½ to 1 carries into the exponent where the mantissa is above √2
    let bits = x.bits();
    let exponent = bits.plus(bits.all(ONE - FRAC_1_SQRT_2.to_bits())).and(EXPONENT);
    let m = R::of_bits(bits.plus(bits.all(ONE)).minus(exponent));
    // the upper half of the exponent is (k + 1023)·2²⁰
    let k = (R::of_integer(exponent.swap_halves()) - 1023.0 * 1_048_576.0) * (1.0 / 1_048_576.0);
    (m, k)
}

/// Bound of the arguments for which [`decay`] needs no general exponential function.
pub const SHORT: f64 = 0.031_25;

/// Returns e^(−x) for x ≥ 0, faster than [`exp_of_negative`] if all lanes are below [`SHORT`].
#[inline(always)]
pub fn decay<R: Real>(x: R) -> R {
    // Taylor polynomial with full double precision
    let short = polynomial(x, [-1.0 / 5040.0, 1.0 / 720.0, -1.0 / 120.0, 1.0 / 24.0, -1.0 / 6.0, 0.5, -1.0, 1.0]);
    let is_short = x.less(x.all(SHORT));
    if R::any(!is_short) { R::choose(is_short, short, exp_of_negative(-x)) } else { short }
}

/// Returns the natural logarithm of a positive normal number.
#[inline(always)]
pub fn ln<R: Real>(x: R) -> R {
    R::natural_log(x)
}

/// Computes [`ln`] with arithmetic alone.
///
/// With x = m·2^k, √½ ≤ m < √2 and s = (m − 1)/(m + 1), ln x = k·ln 2 + 2·artanh s.
#[inline(always)]
pub fn natural_log<R: Real>(x: R) -> R {
    let (m, k) = x.mantissa_and_exponent();
    let s = (m - 1.0) / (m + 1.0);
    let square = s * s;
    // minimax polynomial of (2·artanh(s)/s − 2)/s², relative error 5e-16
    let tail = polynomial(
        square,
        [
            1.461_701_084_787_323e-1,
            1.533_167_305_995_739e-1,
            1.818_289_069_887_174_8e-1,
            2.222_221_111_129_927_5e-1,
            2.857_142_862_613_391_6e-1,
            3.999_999_999_989_911_6e-1,
            6.666_666_666_666_67e-1,
        ],
    );
    // ln 2 in two parts; the product with the first one is exact
    k * 6.931_457_519_531_25e-1 + (s * (square * tail + 2.0) + k * 1.428_606_820_309_417_3e-6)
}

/// Square of the largest half angle for which [`half_angle`] is accurate, rad²: (0.25 rad)².
pub const MAX_HALF_ANGLE_SQUARED: f64 = 0.0625;

/// Returns cos(a) and sin(a)/a from a², for |a| ≤ 0.25 rad, as Taylor polynomials with full double precision.
#[inline(always)]
pub fn half_angle<R: Real>(a_squared: R) -> (R, R) {
    const fn inverse_factorial(n: u64) -> f64 {
        let (mut product, mut factor) = (1, 2);
        while factor <= n {
            product *= factor;
            factor += 1;
        }
        1.0 / product as f64
    }
    const COS: [f64; 6] =
        [-inverse_factorial(10), inverse_factorial(8), -inverse_factorial(6), inverse_factorial(4), -0.5, 1.0];
    const SINC: [f64; 6] = [
        -inverse_factorial(11),
        inverse_factorial(9),
        -inverse_factorial(7),
        inverse_factorial(5),
        -inverse_factorial(3),
        1.0,
    ];
    (polynomial(a_squared, COS), polynomial(a_squared, SINC))
}

#[cfg(test)]
mod tests {
    use super::super::tests::Plain;
    use super::*;
    use proptest::prelude::*;
    use std::f64::consts::LN_2;

    /// Returns the difference of two numbers, in units of the last place of the larger one.
    fn apart(a: f64, b: f64) -> f64 {
        (a - b).abs() / (a.abs().max(b.abs()).max(f64::MIN_POSITIVE) * f64::EPSILON)
    }

    proptest! {
        #[test]
        fn atan2_matches_the_standard_library(
            y in -2.0..2.0f64, x in -2.0..2.0f64, scale in -300.0..300.0f64, other in -20.0..20.0f64,
        ) {
            let (y, x) = (y * 10f64.powf(scale), x * 10f64.powf((scale + other).clamp(-300.0, 300.0)));
            prop_assert!(apart(atan2(y, x), f64::atan2(y, x)) < 3.0, "{y} {x}: {} {}", atan2(y, x), f64::atan2(y, x));
        }

        #[test]
        fn asin_matches_the_standard_library(sine in -1.0..=1.0f64, near in 0.0..16.0f64) {
            for sine in [sine, 1.0 - 10f64.powf(-near), 10f64.powf(-near)] {
                prop_assert!(apart(asin(sine), sine.asin()) < 4.0);
            }
        }

        #[test]
        fn exp_of_negative_matches_the_standard_library(x in -800.0..0.0f64, scale in -300.0..0.0f64) {
            for x in [x, x / 800.0, -10f64.powf(scale)] {
                let (got, wanted) = (exp_of_negative(x), x.exp());
                // the unit of the last place is constant for subnormal numbers
                prop_assert!(apart(got, wanted) < 3.0 || (got - wanted).abs() <= 5e-324, "{x}: {got} {wanted}");
            }
        }

        #[test]
        fn decay_matches_the_standard_library(x in 0.0..800.0f64, scale in -300.0..0.0f64) {
            for x in [x, x / 12_800.0, 10f64.powf(scale)] {
                let (got, wanted) = (decay(x), (-x).exp());
                prop_assert!(apart(got, wanted) < 3.0 || (got - wanted).abs() <= 5e-324, "{x}: {got} {wanted}");
            }
        }

        #[test]
        fn ln_matches_the_standard_library(m in 0.5..2.0f64, scale in -307.0..308.0f64, near in 0.0..16.0f64) {
            for x in [m, 10f64.powf(scale), 1.0 + 10f64.powf(-near), 1.0 - 0.5 * 10f64.powf(-near)] {
                prop_assert!(apart(ln(x), x.ln()) < 4.0, "{x}: {} {}", ln(x), x.ln());
            }
        }

        /// Types of numbers without bit patterns get the same bits.
        #[test]
        fn functions_with_arithmetic_alone_are_bit_identical(
            m in 0.5..2.0f64, scale in -307.0..308.0f64, x in -750.0..0.0f64,
        ) {
            for y in [m, 10f64.powf(scale), m.sqrt()] {
                prop_assert_eq!(ln(Plain(y)).0, ln(y));
                prop_assert_eq!(mantissa_and_exponent_of_bits(y), mantissa_and_exponent(y));
            }
            for x in [x, 1e-3 * x] {
                prop_assert_eq!(exp_of_negative(Plain(x)).0, exp_of_negative(x));
                prop_assert_eq!(decay(Plain(-x)).0, decay(-x));
            }
            prop_assert_eq!(atan2(Plain(x), Plain(m - 1.0)).0, atan2(x, m - 1.0));
            prop_assert_eq!(asin(Plain(m - 1.0)).0, asin(m - 1.0));
        }

        #[test]
        fn half_angle_is_accurate_within_its_range(a in -0.25..0.25f64) {
            let (cos, sinc) = half_angle(a * a);
            prop_assert!(apart(cos, a.cos()) < 3.0);
            prop_assert!(apart(sinc * a, a.sin()) < 3.0);
        }
    }

    #[test]
    fn numbers_that_are_not_finite_have_no_finite_zero() {
        assert_eq!(finite_zero([1.0, -f64::MAX, f64::MAX, -0.0]), 0.0);
        for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            assert!(finite_zero([0.0, bad]).is_nan() && finite_zero([bad, 0.0]).is_nan());
        }
        assert!(clamped(f64::NAN, -1.0, 1.0).is_nan());
        assert_eq!([-2.0, 0.5, 2.0].map(|x| clamped(x, -1.0, 1.0)), [-1.0, 0.5, 1.0]);
    }

    #[test]
    fn powers_of_two_are_exact() {
        for exponent in -1022..=1023 {
            let exponent = f64::from(exponent);
            assert_eq!(exponent.power_of_two(), exponent.exp2());
            assert_eq!(Plain(exponent).power_of_two().0, exponent.exp2());
        }
    }

    #[test]
    fn special_values_match_the_standard_library() {
        for y in [0.0, -0.0, 1.0, -1.0, f64::MIN_POSITIVE] {
            for x in [0.0, -0.0, 1.0, -1.0, 1e300] {
                assert!(apart(atan2(y, x), f64::atan2(y, x)) < 2.0, "{y} {x}");
                assert_eq!(atan2(y, x).is_sign_negative(), f64::atan2(y, x).is_sign_negative(), "{y} {x}");
            }
        }
        assert!(atan2(f64::NAN, 1.0).is_nan() && asin(f64::NAN).is_nan());
        assert_eq!([asin(1.0), asin(-1.0), asin(2.0), asin(0.0)], [FRAC_PI_2, -FRAC_PI_2, FRAC_PI_2, 0.0]);
        assert_eq!(
            [decay(0.0), decay(f64::INFINITY), ln(1.0), ln(0.5), ln(1024.0)],
            [1.0, 0.0, 0.0, -LN_2, 10.0 * LN_2]
        );
        assert_eq!([exp_of_negative(0.0), exp_of_negative(f64::NEG_INFINITY)], [1.0, 0.0]);
    }
}
