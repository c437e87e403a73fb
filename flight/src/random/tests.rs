use super::*;

/// Known answers of the Random123 distribution.
#[test]
fn the_generator_gives_the_known_answers() {
    let pi = [0x243f_6a88, 0x85a3_08d3, 0x1319_8a2e, 0x0370_7344, 0xa409_3822, 0x299f_31d0];
    for (key, counter, expected) in [
        ([0; 2], [0; 4], [0x6627_e8d5, 0xe169_c58d, 0xbc57_ac4c, 0x9b00_dbd8]),
        ([LOWER; 2], [LOWER; 4], [0x408f_276d, 0x41c8_3b0e, 0xa20b_c7c6, 0x6d54_51fd]),
        ([pi[4], pi[5]], [pi[0], pi[1], pi[2], pi[3]], [0xd16c_fe09, 0x94fd_cceb, 0x5001_e420, 0x2412_6ea1]),
    ] {
        assert_eq!(philox(key, counter), expected);
        // the upper halves have no influence
        assert_eq!(philox(key.map(|x| x | 7 << 40), counter.map(|x| x | 9 << 50)), expected);
    }
    let [a, b, c, d] = philox([11, 12], [0xffff_ffff, 3, Purpose::Gust as u64, 5]);
    assert_eq!(Key([11, 12]).at((3 << 32) + LOWER).block(Purpose::Gust, 5), [a, b, c, d]);
}

#[test]
fn keys_of_neighbouring_seeds_and_drones_differ_in_half_of_their_bits() {
    let bits = |a: Key, b: Key| (a.0[0] ^ b.0[0]).count_ones() + (a.0[1] ^ b.0[1]).count_ones();
    let (mut sum, mut count) = (0.0, 0.0_f64);
    for seed in (0..500).chain([u64::MAX - 1, 1 << 32]) {
        for drone in 0..4 {
            let key = Key::new(seed, drone);
            for other in [Key::new(seed.wrapping_add(1), drone), Key::new(seed, drone + 1), Key::new(drone as u64, 7)] {
                let apart = bits(key, other);
                assert!(apart > 8 && apart < 56, "{seed} {drone}: {apart}");
                (sum, count) = (sum + f64::from(apart), count + 1.0);
            }
        }
    }
    assert!((sum / count - 32.0).abs() < 4.0 * 4.0 / count.sqrt(), "{}", sum / count);
}

#[test]
fn uniform_numbers_exclude_zero_and_one() {
    let (low, high) = (uniform::<f64>(0), uniform::<f64>(LOWER));
    assert!(low > 0.0 && high < 1.0 && low == 1.0 - high);
    assert_eq!(uniform::<f64>(1 << 31), 0.5 + low);
}

/// Returns normal samples for many keys, steps and uses.
fn samples(count: u64) -> Vec<f64> {
    (0..count)
        .flat_map(|step| {
            let noise = Key::new(step % 7, (step % 3) as usize).at(step);
            noise.normals::<f64>([Purpose::Turbulence, Purpose::Sensor][(step % 2) as usize], (step % 5) as u32)
        })
        .collect()
}

/// Compares the distribution with the closed form at twenty quantiles, and the mean, the variance, the skewness and
/// the kurtosis, within four standard errors.
#[test]
fn samples_are_normal() {
    let samples = samples(100_000);
    let n = samples.len() as f64;
    let moment = |k: i32| samples.iter().map(|x| x.powi(k)).sum::<f64>() / n;
    for (k, expected, variance) in [(1, 0.0, 1.0), (2, 1.0, 2.0), (3, 0.0, 15.0), (4, 3.0, 96.0_f64)] {
        assert!((moment(k) - expected).abs() < 4.0 * (variance / n).sqrt(), "{k}: {}", moment(k));
    }
    for i in -10..=10 {
        let x = 0.3 * f64::from(i);
        // Simpson's rule for the distribution function
        let f = |t: f64| (-0.5 * t * t).exp() / std::f64::consts::TAU.sqrt();
        let h = x / 200.0;
        let sum: f64 =
            (0..100).map(|k| f64::from(2 * k) * h).map(|t| (f(t) + 4.0 * f(t + h) + f(t + 2.0 * h)) * h / 3.0).sum();
        let expected = 0.5 + sum;
        let below = samples.iter().filter(|&&sample| sample < x).count() as f64 / n;
        let error = (expected * (1.0 - expected) / n).sqrt();
        assert!((below - expected).abs() < 4.0 * error, "{x}: {below}, expected {expected}");
    }
    let max = samples.iter().fold(0.0_f64, |max, x| max.max(x.abs()));
    assert!(max > 4.0 && max < 6.9, "{max}");
}

/// The four samples of a block, samples of successive steps and samples of different uses are uncorrelated, and so are
/// their squares.
#[test]
fn samples_are_independent() {
    let key = Key::new(5, 0);
    let count = 20_000_u64;
    let row = |step: u64| {
        let now = key.at(step).normals::<f64>(Purpose::Turbulence, 0);
        let [next, ..] = key.at(step + 1).normals::<f64>(Purpose::Turbulence, 0);
        let [other, ..] = key.at(step).normals::<f64>(Purpose::Sensor, 0);
        let [later, ..] = key.at(step).normals::<f64>(Purpose::Turbulence, 1);
        let [neighbour, ..] = Key::new(6, 0).at(step).normals::<f64>(Purpose::Turbulence, 0);
        [now[0], now[1], now[2], now[3], next, other, later, neighbour]
    };
    let rows: Vec<_> = (0..count).map(row).collect();
    let n = count as f64;
    for i in 0..8 {
        for j in 0..i {
            let product = rows.iter().map(|x| x[i] * x[j]).sum::<f64>() / n;
            let squares = rows.iter().map(|x| (x[i] * x[i] - 1.0) * (x[j] * x[j] - 1.0)).sum::<f64>() / n;
            assert!(product.abs() < 4.5 / n.sqrt(), "{i} {j}: {product}");
            assert!(squares.abs() < 4.5 * 2.0 / n.sqrt(), "{i} {j}: {squares}");
        }
    }
}

#[test]
fn pairs_have_every_quadrant_and_the_exact_radius() {
    let mut quadrants = [0; 4];
    for step in 0..4000 {
        let [a, b, ..] = Key([1, 2]).at(step).block(Purpose::Sensor, 0);
        let pair = NormalPair::<f64>::new(a, b);
        assert!((pair.first * pair.first + pair.second * pair.second - 2.0).abs() < 1e-14);
        let [x, y] = pair.samples();
        assert!(((x * x + y * y) * 0.5 + uniform::<f64>(a).ln()).abs() < 1e-13);
        quadrants[usize::from(x < 0.0) + 2 * usize::from(y < 0.0)] += 1;
    }
    assert!(quadrants.iter().all(|&count| (count - 1000_i32).abs() < 110), "{quadrants:?}");
}
