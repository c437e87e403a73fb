use super::*;
use crate::drone::DroneModel;
use crate::physics::wind::{DrydenFilter, WindModel, dryden};
use proptest::prelude::*;
use std::f64::consts::TAU;

const DT: f64 = 1.0 / 240.0;

fn field(config: WindConfig, drones: usize) -> WindField {
    let mut field = WindField::new(config, &vec![DroneModel::Cf2x.params(); drones]).unwrap();
    field.reset(11, &vec![DroneState::default(); drones]);
    field
}

/// Returns the mean product of a stationary Gaussian series at a lag, and the standard error of that mean by the
/// closed form of the autocovariance.
fn covariance_at(x: &[f64], lag: usize, closed: impl Fn(usize) -> f64) -> (f64, f64) {
    let n = (x.len() - lag) as f64;
    let mean = x.iter().zip(&x[lag..]).map(|(a, b)| a * b).sum::<f64>() / n;
    // Bartlett: Σ over all k of ρ(k)² + ρ(k + lag)·ρ(k − lag)
    let terms = (-4000..=4000_isize).map(|k: isize| {
        let at = |k: isize| closed(k.unsigned_abs());
        let lag = lag.cast_signed();
        at(k) * at(k) + at(k + lag) * at(k - lag)
    });
    (mean, (terms.sum::<f64>() / n).sqrt())
}

/// The variance and the autocorrelation of both filters and all components are within three standard errors of the
/// closed form, at lags of zero to three time constants, where the second-order filters are anticorrelated.
#[test]
fn turbulence_has_the_variance_and_the_autocorrelation_of_its_closed_form() {
    // long steps, so that 2·10⁵ of them cover many time constants of the turbulence
    let (dt, airspeed, count) = (0.5, 10.0, 200_000);
    let state = DroneState::at_rest(Vector3::new(0.0, 0.0, 30.0), Vector3::zeros());
    let (sigma, length) = dryden(30.0, 4.0);
    assert!((length[0] - 0.3048 * 98.425 / (0.177 + 8.23e-4 * 98.425_f64).powf(1.2)).abs() < 0.01);
    assert!((sigma[2] - 0.4).abs() < 1e-12 && (length[2] - 30.0).abs() < 1e-9);
    for filter in [DrydenFilter::FirstOrder, DrydenFilter::MilF8785c] {
        let config =
            WindConfig { velocity: [6.0, 8.0, 0.0], turbulence: 4.0, filter, ..WindConfig::new(WindModel::Dryden) };
        let mut field = field(config, 1);
        let mut samples = [vec![], vec![], vec![]];
        for _ in 0..count {
            let (_, air) = field.advance(dt, 0, &state);
            // longitudinal axis (0.6, 0.8, 0), lateral axis to its left, vertical axis
            let parts = [0.6 * air.x + 0.8 * air.y, 0.6 * air.y - 0.8 * air.x, air.z];
            samples.iter_mut().zip(parts).for_each(|(samples, x)| samples.push(x));
        }
        for axis in 0..3 {
            let time = length[axis] / airspeed;
            let second_order = filter == DrydenFilter::MilF8785c && axis > 0;
            let closed = |lag: usize| {
                let s = dt * lag as f64 / time;
                sigma[axis].powi(2) * (-s).exp() * if second_order { 1.0 - 0.5 * s } else { 1.0 }
            };
            for constants in [0.0, 0.5, 1.0, 2.0, 3.0] {
                let lag = (constants * time / dt).round() as usize;
                let (got, error) = covariance_at(&samples[axis], lag, closed);
                let expected = closed(lag);
                assert!((got - expected).abs() < 3.0 * error, "{filter:?} {axis} {lag}: {got}, {expected} ± {error}");
            }
            // at three time constants the two filters differ by more than the error of the test
            let lag = (3.0 * time / dt).round() as usize;
            let (got, error) = covariance_at(&samples[axis], lag, closed);
            let first_order = sigma[axis].powi(2) * (-dt * lag as f64 / time).exp();
            assert_eq!((got - first_order).abs() > 6.0 * error, second_order, "{filter:?} {axis}");
        }
    }
}

/// An episode starts from the stationary distribution: variances over many seeds, before and after a step.
#[test]
fn second_order_turbulence_starts_from_its_stationary_distribution() {
    let config = WindConfig { filter: DrydenFilter::MilF8785c, turbulence: 4.0, ..WindConfig::new(WindModel::Dryden) };
    let state = DroneState::at_rest(Vector3::new(0.0, 0.0, 30.0), Vector3::zeros());
    let (sigma, _) = dryden(30.0, 4.0);
    let mut field = field(config, 1);
    let count = 20_000_u32;
    for dt in [1e-6, 20.0] {
        let mut sums = [0.0; 3];
        for seed in 0..count {
            field.reset(u64::from(seed), &[state]);
            let (_, air) = field.advance(dt, 0, &state);
            // the mean wind is along y
            let parts = [air.y, -air.x, air.z];
            sums.iter_mut().zip(parts).zip(sigma).for_each(|((sum, x), sigma)| *sum += (x / sigma).powi(2));
        }
        let error = (2.0 / f64::from(count)).sqrt();
        assert!(sums.iter().all(|sum| (sum / f64::from(count) - 1.0).abs() < 3.0 * error), "{dt}: {sums:?}");
    }
}

#[test]
fn gusts_have_their_rate_a_half_sine_profile_and_uniform_directions() {
    let config = WindConfig { gust_rate: 2.0, gust_duration: 0.25, ..WindConfig::new(WindModel::Gust) };
    let mut field = field(config, 1);
    let state = DroneState::default();
    let (mut gusts, mut idle, mut sum) = (0, 0, Vector3::zeros());
    let mut current: Vec<Vector3<f64>> = Vec::new();
    for _ in 0..200_000 {
        let (force, air) = field.advance(DT, 0, &state);
        assert_eq!(air, Vector3::zeros());
        assert!(force.norm() <= config.gust_force);
        // the force at the start of a gust is zero
        if field.locals[0].state.elapsed < 1.0 {
            current.push(force);
            continue;
        }
        idle += 1;
        if !current.is_empty() {
            let peak = Vector3::from(field.locals[0].state.peak);
            assert_eq!(current.len(), 60, "0.25 s at 240 Hz");
            for (step, force) in current.iter().enumerate() {
                let envelope = (std::f64::consts::PI * step as f64 / 60.0).sin();
                assert!((force - peak * envelope).norm() < 1e-12);
            }
            gusts += 1;
            sum += peak.normalize();
            current.clear();
        }
    }
    // the waiting time is geometric: one gust per 1/(rate·dt) idle steps
    let expected = f64::from(idle) * config.gust_rate * DT;
    assert!((f64::from(gusts) - expected).abs() < 4.0 * expected.sqrt(), "{gusts} for {expected}");
    // the mean of n random directions has components of standard deviation 1/√(3n)
    assert!((sum / f64::from(gusts)).amax() < 4.0 / (3.0 * f64::from(gusts)).sqrt());
}

#[test]
fn drones_have_independent_winds_that_a_seed_reproduces() {
    let states = [DroneState::at_rest(Vector3::z(), Vector3::zeros()); 2];
    let record = |seed: u64| {
        let mut field = field(WindConfig::new(WindModel::Combined), 2);
        field.reset(seed, &states);
        (0..500).map(|_| [field.advance(DT, 0, &states[0]).0, field.advance(DT, 1, &states[1]).0]).collect::<Vec<_>>()
    };
    let first = record(3);
    assert!(first.iter().all(|[a, b]| a != b));
    assert_eq!(first, record(3));
    assert_ne!(first, record(4));
    // another drone changes neither the wind of the first nor the rate of the clock
    let mut alone = field(WindConfig::new(WindModel::Combined), 1);
    alone.reset(3, &states[..1]);
    assert!(first.iter().all(|[a, _]| *a == alone.advance(DT, 0, &states[0]).0));
}

#[test]
fn the_sinusoidal_force_is_the_papers_formula() {
    let config =
        WindConfig { sinusoidal_force: 0.01, sinusoidal_frequency: 3.0, ..WindConfig::new(WindModel::Sinusoidal) };
    let mut field = field(config, 1);
    for step in 0..500 {
        let phase = 3.0 * f64::from(step) * DT;
        let expected = 0.01 * Vector3::new(phase.sin(), phase.cos(), 0.3 * (2.0 * phase).sin());
        assert!((field.advance(DT, 0, &DroneState::default()).0 - expected).norm() < 1e-15);
    }
}

proptest! {
    /// The air moves at the constant velocity plus the turbulence; the forces of gusts and of the sinusoidal wind are
    /// added.
    #[test]
    fn the_combined_wind_adds_velocities_before_the_drag_law_and_forces_after_it(
        wind in prop::array::uniform3(-5.0..5.0), velocity in prop::array::uniform3(-5.0..5.0f64), seed in 0..1000u64,
    ) {
        let config = WindConfig { velocity: wind, gust_rate: 100.0, ..WindConfig::default() };
        let state = DroneState { velocity: velocity.into(), ..DroneState::default() };
        let area = DroneModel::Cf2x.params().drag_area();
        let law = |air: Vector3<f64>| drag_law(1.225, area, &(air - state.velocity));
        let start = |model| {
            let mut field = field(WindConfig { model, ..config }, 1);
            field.reset(seed, &[state]);
            field
        };
        let mut all = start(WindModel::Combined);
        let [mut turbulent, mut turning] = [WindModel::Dryden, WindModel::Sinusoidal].map(start);
        let (total, air) = all.advance(DT, 0, &state);
        let (turbulence_force, turbulence) = turbulent.advance(DT, 0, &state);
        prop_assert!((turbulence_force - law(turbulence)).norm() < 1e-15);
        prop_assert!((air - (Vector3::from(wind) + turbulence)).norm() < 1e-12);
        // the force at the start of a gust is zero
        prop_assert!((total - law(air) - turning.advance(DT, 0, &state).0).norm() < 1e-15);
        let (total, air) = all.advance(DT, 0, &state);
        let WindState { peak, elapsed, .. } = all.locals[0].state;
        let phase = std::f64::consts::PI * elapsed;
        let gust = if elapsed < 1.0 { Vector3::from(peak) * phase.sin() } else { Vector3::zeros() };
        prop_assert!((total - law(air) - gust - turning.advance(DT, 0, &state).0).norm() < 1e-15);
    }

    /// A drone that moves with the air has no drag; otherwise the drag is parallel to the relative velocity and
    /// quadratic in it.
    #[test]
    fn drag_is_along_the_velocity_relative_to_the_air(
        wind in prop::array::uniform3(-5.0..5.0), velocity in prop::array::uniform3(-5.0..5.0f64),
    ) {
        let still = WindConfig { turbulence: 0.0, gust_rate: 0.0, sinusoidal_force: 0.0, ..WindConfig::default() };
        let force = |model, velocity: Vector3<f64>| {
            let state = DroneState { velocity, ..DroneState::default() };
            field(WindConfig { model, velocity: wind, ..still }, 1).advance(DT, 0, &state).0
        };
        let relative = Vector3::from(wind) - Vector3::from(velocity);
        let area = DroneModel::Cf2x.params().drag_area();
        for model in [WindModel::Constant, WindModel::Combined] {
            prop_assert_eq!(force(model, wind.into()), Vector3::zeros());
            let force = force(model, velocity.into());
            prop_assert!((force.norm() - 0.5 * 1.225 * area * relative.norm_squared()).abs() < 1e-12);
            prop_assert!(force.dot(&relative) >= 0.0);
        }
        prop_assert_eq!(force(WindModel::None, velocity.into()), Vector3::zeros());
    }
}

/// The force along a mean wind of 3 m/s with turbulence on a drone at rest has the mean and the standard deviation of
/// ½·ρ·C_d·A·‖U + u‖·(U + u), with u normal with the variances of [`dryden`], computed by quadrature.
#[test]
fn turbulence_in_a_mean_wind_has_the_force_of_the_total_velocity() {
    let config = WindConfig {
        velocity: [3.0, 0.0, 0.0],
        turbulence: 15.0,
        gust_rate: 0.0,
        sinusoidal_force: 0.0,
        ..WindConfig::new(WindModel::Combined)
    };
    // the first step after a reset samples the stationary distribution, so that every reset gives an independent
    // sample
    let mut field = field(config, 1);
    let state = DroneState::at_rest(Vector3::new(0.0, 0.0, 30.0), Vector3::zeros());
    let count = 20_000_u32;
    let samples: Vec<f64> = (0..count)
        .map(|seed| {
            field.reset(u64::from(seed), &[state]);
            field.advance(DT, 0, &state).0.x
        })
        .collect();
    let mean = samples.iter().sum::<f64>() / f64::from(count);
    let central = |power: i32| samples.iter().map(|x| (x - mean).powi(power)).sum::<f64>() / f64::from(count);
    let ([u, v, w], _) = dryden(30.0, 15.0);
    // the trapezoidal rule over ±6 standard deviations is exact to rounding for smooth integrands
    let nodes: Vec<(f64, f64)> =
        (-24..=24).map(|i| f64::from(i) * 0.25).map(|x| (x, 0.25 * (-0.5 * x * x).exp() / TAU.sqrt())).collect();
    let k = 0.5 * 1.225 * DroneModel::Cf2x.params().drag_area();
    let (mut first, mut second) = (0.0, 0.0);
    for (a, wa) in &nodes {
        for (b, wb) in &nodes {
            for (c, wc) in &nodes {
                let air = Vector3::new(3.0 + u * a, v * b, w * c);
                let force = k * air.norm() * air.x;
                first += wa * wb * wc * force;
                second += wa * wb * wc * force * force;
            }
        }
    }
    let (variance, n) = (second - first * first, f64::from(count));
    assert!((mean - first).abs() < 3.0 * (variance / n).sqrt(), "mean {mean}, expected {first}");
    let error = ((central(4) - variance * variance) / n).sqrt();
    assert!((central(2) - variance).abs() < 3.0 * error, "variance {}, expected {variance}", central(2));
    // two separate drag laws, for the mean wind and for the turbulence, would give less than half the deviation
    assert!(variance.sqrt() > 0.03, "{}", variance.sqrt());
}

/// Settings with zero wind: no force on a moving drone unless still-air drag is on.
#[test]
fn still_air_has_drag_only_with_the_option() {
    let zero = WindConfig {
        velocity: [0.0; 3],
        turbulence: 0.0,
        gust_force: 0.0,
        sinusoidal_force: 0.0,
        ..WindConfig::default()
    };
    let state = DroneState { velocity: Vector3::new(1.0, -2.0, 2.0), ..DroneState::default() };
    let area = DroneModel::Cf2x.params().drag_area();
    for model in WindModel::ALL {
        let still = WindConfig { model, ..zero };
        assert!(still.is_calm());
        assert_eq!(field(still, 1).advance(DT, 0, &state), (Vector3::zeros(), Vector3::zeros()), "{model}");
        let drag = WindConfig { still_air_drag: true, ..still };
        assert!(!drag.is_calm());
        let (force, air) = field(drag, 1).advance(DT, 0, &state);
        assert!((force + 0.5 * 1.225 * area * 3.0 * state.velocity).norm() < 1e-15, "{model}: {force}");
        assert_eq!(air, Vector3::zeros());
        // in moving air the option changes nothing
        let windy = WindConfig { model, velocity: [0.1, 0.0, 0.0], turbulence: 1.0, ..zero };
        let dragged = WindConfig { still_air_drag: true, ..windy };
        if windy.has_drag() {
            assert_eq!(field(windy, 1).advance(DT, 0, &state), field(dragged, 1).advance(DT, 0, &state));
        }
    }
}

/// A drag area of the wind replaces that of the airframe, also after changes of the airframe and of the wind.
#[test]
fn drag_area_of_the_wind_replaces_that_of_the_airframe() {
    let constant = WindConfig { velocity: [2.0, 0.0, 0.0], ..WindConfig::new(WindModel::Constant) };
    let wide = WindConfig { drag_area: Some(0.02), ..constant };
    let force = |field: &mut WindField| field.advance(DT, 0, &DroneState::default()).0.x;
    let expected = 0.5 * 1.225 * 0.02 * 4.0;
    let mut wind = field(wide, 1);
    assert!((force(&mut wind) - expected).abs() < 1e-15);
    wind.set_area(0, 0.5);
    assert!((force(&mut wind) - expected).abs() < 1e-15);
    wind.set(constant, std::iter::once(0.01)).unwrap();
    assert!((force(&mut wind) - 0.5 * expected).abs() < 1e-15);
    wind.set(wide, std::iter::once(0.01)).unwrap();
    assert!((force(&mut wind) - expected).abs() < 1e-15);
    assert_eq!(wide.bound(0.5), wide.bound(0.02));
}
