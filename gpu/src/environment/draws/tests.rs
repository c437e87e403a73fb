use std::f64::consts::{PI, TAU};

use aviary::env::{EnvConfig, InitialRanges, Randomization, SensorRanges};
use aviary::tasks::{Stabilize, Track, Velocity};
use aviary::vector::Autoreset;

use super::*;
use crate::plan::describe;
use crate::tasks::GpuTask;

/// Number of samples.
const COUNT: usize = 20_000;

/// Samples an episode in every environment. `quantities` returns the numbers to test, from the nominal parameters and
/// the sample.
fn sample<T: GpuTask, const K: usize>(
    task: T,
    options: EnvConfig,
    quantities: impl Fn(&Parameters, &Start<f64>) -> [f64; K],
) -> [Vec<f64>; K] {
    let env = options.for_task(task).unwrap().build().unwrap();
    let (plan, nominal) = describe(&env, Autoreset::NextStep, false).unwrap();
    let mut columns = [(); K].map(|()| Vec::new());
    for environment in 0..COUNT as u32 {
        let place = Place { seed: [3, 5], environment, drone: 0, episode: 1 };
        let start = Start::sample(&plan, &nominal[0], place);
        for (column, number) in columns.iter_mut().zip(quantities(&nominal[0], &start)) {
            column.push(number);
        }
    }
    columns
}

/// Kolmogorov–Smirnov test at the level of 1e-6.
fn assert_distributed(name: &str, samples: &[f64], cumulative: impl Fn(f64) -> f64) {
    let mut sorted = samples.to_vec();
    sorted.sort_by(f64::total_cmp);
    let count = sorted.len() as f64;
    let apart = sorted.iter().enumerate().map(|(index, &x)| {
        let (below, above) = (index as f64 / count, (index + 1) as f64 / count);
        (cumulative(x) - below).abs().max((cumulative(x) - above).abs())
    });
    let distance = apart.fold(0.0, f64::max);
    assert!(distance < 2.7 / count.sqrt(), "{name}: {distance}, from {} to {}", sorted[0], sorted[sorted.len() - 1]);
}

fn assert_uniform(name: &str, samples: &[f64], [low, high]: [f64; 2]) {
    assert!(samples.iter().all(|x| (low..=high).contains(x)), "{name}: outside of its range");
    assert_distributed(name, samples, |x| (x - low) / (high - low));
}

/// Cumulative distribution of the standard normal, as Marsaglia's series.
fn normal(x: f64) -> f64 {
    let x = x.clamp(-8.0, 8.0);
    let (mut sum, mut term, mut n) = (x, x, 1.0);
    while term.abs() > 1e-18 {
        n += 2.0;
        term *= x * x / n;
        sum += term;
    }
    0.5 + sum * (-0.5 * x * x).exp() / TAU.sqrt()
}

fn correlation(a: &[f64], b: &[f64]) -> f64 {
    let mean = |list: &[f64]| list.iter().sum::<f64>() / list.len() as f64;
    let (x, y) = (mean(a), mean(b));
    let product = |p: &[f64], q: &[f64], x: f64, y: f64| p.iter().zip(q).map(|(p, q)| (p - x) * (q - y)).sum::<f64>();
    product(a, b, x, y) / (product(a, a, x, x) * product(b, b, y, y)).sqrt()
}

/// High above the floor, so that no start is lifted.
fn options() -> EnvConfig {
    EnvConfig::default().initial_positions([[0.0, 0.0, 3.0]]).effects(aviary::physics::Effects::ALL)
}

#[test]
fn every_sampled_parameter_has_its_distribution() {
    let columns = sample(Velocity::default(), options().randomization(Randomization::default()), |nominal, start| {
        let (own, body) = (&start.parameters, &start.parameters.body);
        let full = nominal.hover_rpm + nominal.rpm_above_hover;
        let lag = -(1.0 / 240.0) / (1.0 - own.lag_share).ln();
        let [x, y, _] = own.wind.constant;
        [
            nominal.body.inverse_mass / body.inverse_mass,
            nominal.body.inverse_inertia[1] / body.inverse_inertia[1],
            own.rotors.thrust / nominal.rotors.thrust,
            own.rotors.torque[2][3] / nominal.rotors.torque[2][3],
            own.rotors.torque[0][0] / nominal.rotors.torque[0][0] / (own.rotors.thrust / nominal.rotors.thrust),
            own.drag.x / nominal.drag.x,
            own.drag.z / nominal.drag.z,
            own.ground.coefficient / nominal.ground.coefficient,
            own.wake.strength / nominal.wake.strength,
            own.gains[0],
            own.gains[3],
            lag,
            (own.max_change + nominal.hover_rpm) / full,
            body.gravity / nominal.body.gravity,
            x.hypot(y),
            y.atan2(x),
        ]
    });
    let ranges: [(&str, [f64; 2]); 16] = [
        ("mass", [0.8, 1.2]),
        ("inertia", [0.8, 1.2]),
        ("thrust", [0.85, 1.15]),
        ("torque", [0.85, 1.15]),
        ("arm length", [0.98, 1.02]),
        ("drag x", [0.7, 1.3]),
        ("drag z", [0.7, 1.3]),
        ("ground effect", [0.7, 1.3]),
        ("downwash", [0.7, 1.3]),
        ("gain 0", [0.95, 1.05]),
        ("gain 3", [0.95, 1.05]),
        ("lag", [0.005, 0.05]),
        ("maximum speed", [0.95, 1.05]),
        ("gravity", [0.98, 1.02]),
        ("wind speed", [0.0, 1.0]),
        ("wind direction", [-PI, PI]),
    ];
    for (column, (name, [low, high])) in columns.iter().zip(ranges) {
        // ratios of the parameters have rounding errors
        let slack = 1e-9;
        assert!(column.iter().all(|x| (low - slack..=high + slack).contains(x)), "{name}: outside of its range");
        assert_distributed(name, column, |x| ((x - low) / (high - low)).clamp(0.0, 1.0));
    }
    for (i, a) in columns.iter().enumerate() {
        for (j, b) in columns.iter().enumerate().take(i) {
            assert!(correlation(a, b).abs() < 0.04, "{} and {}", ranges[i].0, ranges[j].0);
        }
    }
}

#[test]
fn latencies_are_uniform_before_they_are_rounded_to_physics_steps() {
    let columns = sample(Velocity::default(), options().randomization(Randomization::default()), |_, start| {
        [start.parameters.motor_latency, start.parameters.sensor_latency]
    });
    for (column, most) in columns.iter().zip([12.0, 4.8]) {
        for steps in 0..=12_u32 {
            let share = column.iter().filter(|&&x| x == f64::from(steps)).count() as f64 / COUNT as f64;
            let [low, high] = [-0.5, 0.5].map(|side| (f64::from(steps) + side).clamp(0.0, most));
            let expected = (high - low) / most;
            assert!((share - expected).abs() < 0.02, "{steps} of {most} steps: {share}, expected {expected}");
        }
    }
}

#[test]
fn biases_of_sensors_are_normal() {
    let sensors = SensorRanges { bias: 2.0, gyro_bias: Some(0.3), ..SensorRanges::default() };
    let randomization = Randomization { sensors: Some(sensors), ..Randomization::NONE };
    let columns = sample(Velocity::default(), options().randomization(randomization), |_, start| {
        let biases = &start.parameters.biases;
        [
            biases[0][0] / 0.02,
            biases[1][1] / 0.1,
            biases[2][2] / 2_f64.to_radians(),
            biases[3][0] / 0.3,
            biases[3][2] / 0.3,
        ]
    });
    for (index, column) in columns.iter().enumerate() {
        assert_distributed(&format!("bias {index}"), column, normal);
    }
    assert!(correlation(&columns[3], &columns[4]).abs() < 0.04);
}

#[test]
fn starts_are_uniform_around_their_shifted_middle() {
    let initial = InitialRanges { offset: [0.1, -0.2, 0.3], ..InitialRanges::default() };
    let randomization = Randomization { initial: Some(initial), ..Randomization::NONE };
    let columns = sample(Velocity::default(), options().randomization(randomization), |_, start| {
        let (p, rpy, v) = (start.motion.position, start.motion.attitude.rpy(), start.motion.velocity);
        [p.x, p.y, p.z, rpy.x, rpy.y, rpy.z, v.x, v.y, v.z]
    });
    let middles = [0.1, -0.2, 3.3, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
    let reaches = [0.2, 0.2, 0.2, 0.1, 0.1, 0.1, 0.5, 0.5, 0.5];
    for (index, column) in columns.iter().enumerate() {
        let (middle, reach) = (middles[index], reaches[index] + 1e-12);
        assert_uniform(&format!("entry {index}"), column, [middle - reach, middle + reach]);
    }
}

#[test]
fn starts_below_the_floor_are_lifted_to_it() {
    let randomization = Randomization { initial: Some(InitialRanges::default()), ..Randomization::NONE };
    let options = EnvConfig::default().initial_positions([[0.0, 0.0, 0.1]]).randomization(randomization);
    let [clearances, heights] = sample(Velocity::default(), options, |nominal, start| {
        let (z, up) = (start.motion.position.z, start.motion.attitude.up().z);
        [nominal.cylinder.floor_clearance(z, up), z]
    });
    let lowest = clearances.iter().fold(f64::INFINITY, |a, &b| a.min(b));
    assert!((lowest - LIFTED).abs() < 1e-12, "{lowest}");
    // a third of the heights are below the floor, and a part of the others up to the depth of the tilted cylinder
    let lifted = clearances.iter().filter(|x| **x < LIFTED + 1e-9).count() as f64 / COUNT as f64;
    assert!((0.3..0.4).contains(&lifted), "{lifted}");
    assert!(heights.iter().all(|z| *z <= 0.3));
}

#[test]
fn random_starts_of_the_tasks_have_their_distributions() {
    let task = Stabilize::default();
    let columns = sample(task.clone(), options(), |_, start| {
        let (rpy, v, rate) = (start.motion.attitude.rpy(), start.motion.velocity, start.motion.rate);
        [rpy.x, rpy.y, rpy.z, v.x, v.y, v.z, rate.x, rate.y, rate.z]
    });
    let (lean, speed, rate) = (task.max_lean, task.max_speed, task.max_rate);
    for (index, (column, reach)) in
        columns.iter().zip([lean, lean, PI, speed, speed, speed, rate, rate, rate]).enumerate()
    {
        assert_uniform(&format!("entry {index} of stabilize"), column, [-reach - 1e-12, reach + 1e-12]);
    }
    let [phase, direction, radius, height] = sample(Track::default(), EnvConfig::default(), |_, start| {
        let p = start.motion.position;
        [start.task[0], start.task[1], p.x.hypot(p.y), p.z]
    });
    assert_uniform("phase", &phase, [0.0, TAU]);
    let clockwise = direction.iter().filter(|x| **x < 0.0).count() as f64 / COUNT as f64;
    assert!((clockwise - 0.5).abs() < 0.02 && direction.iter().all(|x| x.abs() == 1.0), "{clockwise}");
    assert!(radius.iter().all(|x| (x - 0.5).abs() < 1e-12) && height.iter().all(|x| *x == 1.0));
    let columns = sample(Velocity::default(), EnvConfig::default(), |_, start| {
        [start.task[0], start.task[1], start.task[2], start.task[3]]
    });
    for (column, reach) in columns.iter().zip([0.5, 0.5, 0.5, 0.25]) {
        assert_uniform("target velocity", column, [-reach, reach]);
    }
}

#[test]
fn drones_of_a_world_share_what_belongs_to_the_world() {
    let options = options().num_drones(1).randomization(Randomization::default());
    let env = options.for_task(Velocity::default()).unwrap().build().unwrap();
    let (plan, nominal) = describe(&env, Autoreset::NextStep, false).unwrap();
    let start = |drone, episode| {
        Start::<f64>::sample(&plan, &nominal[0], Place { seed: [1, 1], environment: 4, drone, episode })
    };
    let (a, b, later) = (start(0, 0), start(1, 0), start(0, 1));
    assert_eq!(a.parameters.body.gravity, b.parameters.body.gravity);
    assert_eq!(a.parameters.wind.constant, b.parameters.wind.constant);
    assert_eq!(a.parameters.sensor_latency, b.parameters.sensor_latency);
    assert_ne!(a.parameters.body.inverse_mass, b.parameters.body.inverse_mass);
    assert_ne!((a.key, a.task), (b.key, b.task));
    assert_ne!(a.parameters.body.gravity, later.parameters.body.gravity);
}
