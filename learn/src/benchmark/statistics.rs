//! Confidence intervals.

use aviary::env::Rng;
use rand::{RngExt as _, SeedableRng as _};

/// Lower and upper bound of a confidence interval.
pub type Interval = [f64; 2];

/// 97.5 % quantile of the standard normal distribution.
const Z: f64 = 1.959_963_984_540_054;

/// Returns the 95 % confidence interval of a success rate (E. B. Wilson, *Probable inference, the law of succession,
/// and statistical inference*, 1927). Without trials, the interval is 0 to 1.
///
/// ```
/// let [low, high] = learn::benchmark::wilson(100, 100);
/// assert!((low - 0.9630).abs() < 1e-4 && high == 1.0);
/// ```
pub fn wilson(successes: usize, trials: usize) -> Interval {
    if trials == 0 {
        return [0.0, 1.0];
    }
    let (n, z2) = (trials as f64, Z * Z);
    let rate = successes as f64 / n;
    let centre = (rate + z2 / (2.0 * n)) / (1.0 + z2 / n);
    let half = Z / (1.0 + z2 / n) * (rate * (1.0 - rate) / n + z2 / (4.0 * n * n)).sqrt();
    // the bounds of no and of all successes are exact
    let low = if successes == 0 { 0.0 } else { (centre - half).max(0.0) };
    let high = if successes == trials { 1.0 } else { (centre + half).min(1.0) };
    [low, high]
}

/// Returns the 95 % confidence interval of the mean of values: the percentiles of 2000 bootstrap samples from a fixed
/// seed. `None` for fewer than two values.
pub fn mean_interval(values: &[f64]) -> Option<Interval> {
    const SAMPLES: usize = 2000;
    if values.len() < 2 {
        return None;
    }
    let mut rng = Rng::seed_from_u64(0);
    let mut means: Vec<f64> = (0..SAMPLES)
        .map(|_| {
            let drawn = (0..values.len()).map(|_| values[rng.random_range(0..values.len())]);
            drawn.sum::<f64>() / values.len() as f64
        })
        .collect();
    means.sort_by(f64::total_cmp);
    Some([means[SAMPLES / 40], means[SAMPLES - 1 - SAMPLES / 40]])
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Values from the closed form, evaluated with other software.
    #[test]
    fn wilson_intervals_have_known_values() {
        for (successes, trials, [low, high]) in [
            (0, 10, [0.0, 0.277_532_8]),
            (10, 10, [0.722_467_2, 1.0]),
            (5, 10, [0.236_593_1, 0.763_406_9]),
            (95, 100, [0.888_249_5, 0.978_456_3]),
            (1, 1, [0.206_549_3, 1.0]),
        ] {
            let got = wilson(successes, trials);
            assert!((got[0] - low).abs() < 1e-6 && (got[1] - high).abs() < 1e-6, "{successes}/{trials}: {got:?}");
        }
        assert_eq!(wilson(0, 0), [0.0, 1.0]);
    }

    #[test]
    fn the_interval_of_a_mean_shrinks_with_the_root_of_the_number_of_values() {
        let values = |count: usize| (0..count).map(|k| (k % 10) as f64).collect::<Vec<_>>();
        let width = |count: usize| mean_interval(&values(count)).map(|[low, high]| high - low).unwrap();
        // the standard deviation of 0 to 9 is 2.872
        for count in [100, 400] {
            let expected = 2.0 * Z * 2.872 / (count as f64).sqrt();
            assert!((width(count) / expected - 1.0).abs() < 0.1, "{count}: {} against {expected}", width(count));
        }
        assert_eq!(mean_interval(&[1.0]), None);
        assert_eq!(mean_interval(&[2.0; 5]), Some([2.0, 2.0]));
        assert_eq!(mean_interval(&values(30)), mean_interval(&values(30)), "the seed is fixed");
    }

    proptest! {
        #[test]
        fn a_wilson_interval_contains_its_rate_and_narrows_with_more_trials(trials in 1usize..500, part in 0.0..1.0) {
            let successes = (part * trials as f64) as usize;
            let [low, high] = wilson(successes, trials);
            let rate = successes as f64 / trials as f64;
            prop_assert!(0.0 <= low && low <= rate && rate <= high && high <= 1.0);
            let [more_low, more_high] = wilson(4 * successes, 4 * trials);
            prop_assert!(more_high - more_low < high - low);
        }
    }
}
