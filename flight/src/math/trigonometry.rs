use std::f64::consts::{PI, TAU};

use super::Real;
use super::functions::polynomial;

/// Returns the sine and the cosine of x eighths of a turn (45°), for x in [−1, 1], as minimax polynomials with full
/// double precision.
#[inline(always)]
pub fn eighth_turn<R: Real>(x: R) -> (R, R) {
    let square = x * x;
    let sin = polynomial(
        square,
        [
            6.877_101_763_716_926e-12,
            -1.757_149_296_785_638_9e-9,
            3.133_616_216_661_576_4e-7,
            -3.657_620_415_845_773_5e-5,
            2.490_394_570_188_736_4e-3,
            -8.074_551_218_828_054e-2,
            std::f64::consts::FRAC_PI_4,
        ],
    );
    let cos = polynomial(
        square,
        [
            -3.857_762_633_385_365_4e-13,
            1.150_049_704_451_981e-10,
            -2.461_136_382_664_002_5e-8,
            3.590_860_445_885_998e-6,
            -3.259_918_869_266_876e-4,
            1.585_434_424_381_541e-2,
            -3.084_251_375_340_424_4e-1,
            1.0,
        ],
    );
    (x * sin, cos)
}

/// Returns the sine and the cosine of an angle in turns, of a magnitude below 2⁵¹.
#[inline(always)]
pub fn sin_cos_of_turns<R: Real>(turns: R) -> (R, R) {
    // every step of the reduction is exact: to half a turn, to a quarter, to an eighth
    let turns = turns - turns.rounded();
    let half = turns.abs();
    let quarter = half.lesser(turns.all(0.5) - half);
    let above = turns.all(0.125).less(quarter);
    let (sin, cos) = eighth_turn(R::choose(above, turns.all(0.25) - quarter, quarter) * 8.0);
    (R::choose(above, cos, sin).with_sign_of(turns), R::choose(above, sin, cos).with_sign_of(turns.all(0.25) - half))
}

/// Returns the sine and the cosine of an angle, rad, of a magnitude below 2⁵¹.
#[inline(always)]
pub fn sin_cos<R: Real>(angle: R) -> (R, R) {
    sin_cos_of_turns(angle * (1.0 / TAU))
}

/// Wraps an angle, rad, of a magnitude below 2⁵¹ to (−π, π]. An angle in this range keeps its bits.
#[inline(always)]
pub fn wrap_angle<R: Real>(angle: R) -> R {
    let (half, minus_half) = (angle.all(PI), angle.all(-PI));
    let rest = angle - (angle * (1.0 / TAU)).rounded() * TAU;
    // the number of turns may be rounded to the wrong side of a half turn
    let rest = R::choose(half.less(rest), rest - TAU, rest);
    let rest = R::choose(minus_half.less(rest), rest, rest + TAU);
    let is_wrapped = minus_half.less(angle) & !half.less(angle);
    R::choose(is_wrapped, angle, rest)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn sine_and_cosine_match_the_standard_library(
            angle in -10.0..10.0f64, whole in -1_000_000..1_000_000_i32, scale in -300.0..0.0f64,
        ) {
            for angle in [angle, 10f64.powf(scale), -10f64.powf(scale)] {
                let ((sin, cos), wanted) = (sin_cos_of_turns(angle / TAU), angle.sin_cos());
                // the argument has a rounding error
                let error = 2.0 * f64::EPSILON * angle.abs();
                prop_assert!((sin - wanted.0).abs() <= error && (cos - wanted.1).abs() <= error + 2.3e-16, "{angle}");
            }
            // turns as a fraction of 2²⁰, so that an added integer is exact
            let turns = (angle * 104_857.6).round() / 1_048_576.0;
            let (sin, cos) = sin_cos_of_turns(turns);
            prop_assert!((sin * sin + cos * cos - 1.0).abs() < 5e-16);
            prop_assert_eq!(sin_cos_of_turns(turns + f64::from(whole)), (sin, cos));
            prop_assert_eq!(sin_cos_of_turns(-turns), (-sin, cos));
        }
    }

    #[test]
    fn angles_at_the_ends_of_the_range_wrap_to_plus_pi() {
        for (angle, wrapped) in [(PI, PI), (-PI, PI), (0.0, 0.0), (TAU, 0.0), (-TAU, 0.0)] {
            assert_eq!(wrap_angle(angle), wrapped, "{angle}");
        }
        let below = PI.next_up();
        assert!((wrap_angle(below) + PI).abs() < 1e-15 && wrap_angle(f64::NAN).is_nan());
    }

    #[test]
    fn multiples_of_an_eighth_of_a_turn_are_exact() {
        let root = std::f64::consts::FRAC_1_SQRT_2;
        let expected = [(0.0, 1.0), (root, root), (1.0, 0.0), (root, -root), (0.0, -1.0)];
        for (turns, (sin, cos)) in [0.0, 0.125, 0.25, 0.375, 0.5].into_iter().zip(expected) {
            let got = sin_cos_of_turns(turns);
            assert!((got.0 - sin).abs() < 2e-16 && (got.1 - cos).abs() < 2e-16, "{turns}: {got:?}");
            assert!((sin != 0.0 || got.0 == 0.0) && (cos != 0.0 || got.1 == 0.0), "{turns}: {got:?}");
        }
        let (sin, cos) = sin_cos_of_turns(f64::NAN);
        assert!(sin.is_nan() && cos.is_nan());
    }
}
