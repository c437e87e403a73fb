//! Domain randomization: distributions, effects on the simulated body, and reproducibility from seeds.
//!
//! "The paper" is *MuJoCo-Drones-Gym* (Tayal).

mod common;

use std::f64::consts::PI;

use common::{assert_contract, step_env};
use mujoco_drones_gym::env::{Randomization, SampledParams, SensorRanges, check_env};
use mujoco_drones_gym::mujoco::{Data, Model};
use mujoco_drones_gym::physics::actuators::ActuatorParams;
use mujoco_drones_gym::physics::wind::{DrydenFilter, WindConfig, WindModel};
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::tasks::NAMES;
use mujoco_drones_gym::world::{DroneBody, Obstacle, Shape, World};
use nalgebra::Vector3;

/// Returns the sampled parameters of episodes with two drones 2 m above the floor.
fn samples_of_episodes(config: Randomization, episodes: u64) -> Vec<SampledParams> {
    let high = [[0.0, 0.0, 2.0], [3.0, 0.0, 2.0]];
    let mut env = MultiHover::builder().initial_positions(high).randomization(config).build().unwrap();
    (0..episodes)
        .map(|seed| {
            env.reset(Some(seed)).unwrap();
            env.sampled_params().unwrap().clone()
        })
        .collect()
}

#[test]
fn the_centre_of_mass_scales_with_the_arm_length() {
    let nominal = DroneParams { center_of_mass: [1e-3, -2e-3], ..DroneModel::Cf2x.params() };
    let mut env = MultiHover::builder().drone(nominal).randomization(only("[body]\n")).build().unwrap();
    for seed in 0..5 {
        env.reset(Some(seed)).unwrap();
        for (drone, sampled) in env.sampled_params().unwrap().drones.iter().enumerate() {
            let [x, y] = env.simulation().params(drone).center_of_mass;
            assert!(sampled.arm_length != 1.0 && [x, y] == [1e-3 * sampled.arm_length, -2e-3 * sampled.arm_length]);
        }
    }
}

/// Returns the Kolmogorov-Smirnov statistic times √n for a distribution function. It exceeds 1.95 with a probability of
/// 0.001.
fn kolmogorov_smirnov(mut samples: Vec<f64>, cdf: impl Fn(f64) -> f64) -> f64 {
    samples.sort_by(f64::total_cmp);
    let n = samples.len() as f64;
    let gaps = samples.iter().enumerate().map(|(i, &x)| {
        let at = cdf(x);
        (at - i as f64 / n).abs().max(((i + 1) as f64 / n - at).abs())
    });
    gaps.fold(0.0, f64::max) * n.sqrt()
}

/// Returns the distribution function of a uniform distribution.
fn uniform(low: f64, high: f64) -> impl Fn(f64) -> f64 {
    move |x| ((x - low) / (high - low)).clamp(0.0, 1.0)
}

/// Returns the normal distribution function (Abramowitz and Stegun 7.1.26, error below 1.5e-7).
fn normal(sigma: f64) -> impl Fn(f64) -> f64 {
    move |x| {
        let z = x.abs() / sigma / 2_f64.sqrt();
        let t = 1.0 / (1.0 + 0.327_591_1 * z);
        let poly =
            t * (0.254_829_592 + t * (-0.284_496_736 + t * (1.421_413_741 + t * (-1.453_152_027 + t * 1.061_405_429))));
        let erf = 1.0 - poly * (-z * z).exp();
        0.5 * (1.0 + erf.copysign(x))
    }
}

#[test]
fn every_parameter_has_the_papers_distribution() {
    let episodes = samples_of_episodes(Randomization::default(), 2000);
    let each = |value: &dyn Fn(&mujoco_drones_gym::env::SampledDroneParams) -> f64| {
        episodes.iter().flat_map(|sampled| &sampled.drones).map(value).collect::<Vec<_>>()
    };
    let mut statistics = Vec::new();
    let mut test = |name: String, samples: Vec<f64>, cdf: &dyn Fn(f64) -> f64| {
        statistics.push((name, kolmogorov_smirnov(samples, cdf)));
    };
    type Value = fn(&mujoco_drones_gym::env::SampledDroneParams) -> f64;
    let factors: [(&str, Value, [f64; 2]); 15] = [
        ("mass", |d| d.mass, [0.8, 1.2]),
        ("inertia", |d| d.inertia, [0.8, 1.2]),
        ("arm length", |d| d.arm_length, [0.98, 1.02]),
        ("thrust", |d| d.thrust, [0.85, 1.15]),
        ("torque", |d| d.torque, [0.85, 1.15]),
        ("drag xy", |d| d.drag[0], [0.7, 1.3]),
        ("drag z", |d| d.drag[1], [0.7, 1.3]),
        ("ground", |d| d.ground, [0.7, 1.3]),
        ("downwash", |d| d.downwash, [0.7, 1.3]),
        ("gain 0", |d| d.actuators.gains[0], [0.95, 1.05]),
        ("gain 3", |d| d.actuators.gains[3], [0.95, 1.05]),
        ("lag", |d| d.actuators.lag, [0.005, 0.05]),
        ("latency", |d| d.actuators.latency, [0.0, 0.05]),
        ("max rpm", |d| d.actuators.saturation, [0.95, 1.05]),
        ("yaw", |d| d.initial.yaw(), [-0.1, 0.1]),
    ];
    for (name, value, [low, high]) in factors {
        test(name.into(), each(&value), &uniform(low, high));
    }
    for axis in 0..3 {
        for (what, sigma) in [0.01, 0.05, 1_f64.to_radians(), 0.05].into_iter().enumerate() {
            test(format!("bias {what} {axis}"), each(&|d| d.bias[what][axis]), &normal(sigma));
        }
        let offset = |sampled: &SampledParams| sampled.drones[1].initial.position[axis] - [3.0, 0.0, 2.0][axis];
        test(format!("position {axis}"), episodes.iter().map(offset).collect(), &uniform(-0.2, 0.2));
        test(format!("velocity {axis}"), each(&|d| d.initial.velocity[axis]), &uniform(-0.5, 0.5));
    }
    test("gravity".into(), episodes.iter().map(|sampled| sampled.gravity).collect(), &uniform(0.98, 1.02));
    test("sensor latency".into(), episodes.iter().map(|sampled| sampled.sensor_latency).collect(), &uniform(0.0, 0.02));
    let wind = |sampled: &SampledParams| Vector3::from(sampled.wind.unwrap().velocity);
    test("wind".into(), episodes.iter().map(|sampled| wind(sampled).norm()).collect(), &uniform(0.0, 1.0));
    let direction = |sampled: &SampledParams| wind(sampled).y.atan2(wind(sampled).x);
    test("direction of the wind".into(), episodes.iter().map(direction).collect(), &uniform(-PI, PI));
    for (name, statistic) in statistics {
        assert!(statistic < 1.95, "{name}: {statistic}");
    }
    // mass and inertia are sampled independently
    let correlation: f64 = each(&|d| (d.mass - 1.0) * (d.inertia - 1.0) * 75.0).iter().sum::<f64>() / 4000.0;
    assert!(correlation.abs() < 0.06, "{correlation}");
}

/// Returns a randomization with the groups of a TOML text; other parameters are nominal.
fn only(toml: &str) -> Randomization {
    Randomization::from_toml(toml).unwrap()
}

/// Creates a Hover environment with a randomization, 2 m above the floor, and starts an episode.
fn hovering(config: Randomization) -> Aviary<Hover> {
    let mut env =
        Hover::builder().initial_positions([[0.0, 0.0, 2.0]]).ctrl_freq(240).randomization(config).build().unwrap();
    env.reset(Some(1)).unwrap();
    env
}

#[test]
fn sampled_mass_thrust_and_gravity_accelerate_a_drone_by_newtons_law() {
    for factor in [0.8, 1.2] {
        let mut env = hovering(only(&format!("[body]\nmass = [{factor}, {factor}]\n")));
        step_env(&mut env, &[0.0; 4], 24);
        let acceleration = env.simulation().states()[0].velocity.z / 0.1;
        let expected = -9.81 * (1.0 - 1.0 / factor);
        assert!((acceleration / expected - 1.0).abs() < 0.01, "{acceleration}, expected {expected}");
    }
    let mut env = hovering(only("[aerodynamics]\nthrust = [1.1, 1.1]\n"));
    step_env(&mut env, &[0.0; 4], 24);
    assert!(
        (env.simulation().states()[0].velocity.z / 0.1 / 0.981 - 1.0).abs() < 0.01,
        "10 % more thrust accelerates by g/10 upwards"
    );
    let mut env = hovering(only("[environment]\ngravity = [0.9, 0.9]\nwind = [0.0, 0.0]\n"));
    step_env(&mut env, &[0.0; 4], 24);
    assert!(
        (env.simulation().states()[0].velocity.z / 0.1 / 0.981 - 1.0).abs() < 0.01,
        "10 % less gravity accelerates by g/10 upwards"
    );
}

#[test]
fn sampled_inertia_arm_length_and_motor_gains_change_the_angular_velocity() {
    let turned = |config: Randomization| {
        let mut env = hovering(config);
        env.step(&[0.2, 0.2, -0.2, -0.2]).unwrap();
        env.simulation().states()[0].angular_velocity
    };
    let nominal = turned(Randomization::NONE);
    let heavy = turned(only("[body]\nmass = [1, 1]\narm_length = [1, 1]\ninertia = [1.2, 1.2]\n"));
    assert!((heavy.x * 1.2 / nominal.x - 1.0).abs() < 1e-6, "{heavy} {nominal}");
    let long = turned(only("[body]\nmass = [1, 1]\narm_length = [1.02, 1.02]\ninertia = [1, 1]\n"));
    assert!((long.x / 1.02 / nominal.x - 1.0).abs() < 1e-6);
    let mut env = hovering(only("[actuators]\ngain = [0.9, 1.1]\nlag = [0, 0]\nlatency = [0, 0]\n"));
    env.step(&[0.0; 4]).unwrap();
    assert!(env.simulation().states()[0].angular_velocity.norm() > 0.05, "unequal motor gains turn the drone");
}

#[test]
fn whole_airframes_are_consistent_and_hover_within_the_action_space() {
    let nominal = DroneModel::Cf2x.params();
    let scale = mujoco_drones_gym::action::MotorScale::new(&nominal);
    let mut env = hovering(only("[airframe]\n"));
    let (mut masses, mut ratios, mut lags) = (Vec::new(), Vec::new(), Vec::new());
    for _ in 0..2000 {
        env.reset(None).unwrap();
        let (params, motors) = (env.simulation().params(0), env.simulation().actuator_params(0));
        masses.push(params.mass.ln());
        ratios.push(params.thrust_to_weight);
        lags.push(motors.lag.ln());
        assert_eq!((motors.gains, motors.latency, motors.saturation), ([1.0; 4], 0.0, 1.0));
        let near = |x: f64, low: f64, high: f64| assert!((low - 1e-9..=high + 1e-9).contains(&x), "{x}: {params:?}");
        let (mass, arm) = (params.mass / nominal.mass, params.arm_length / nominal.arm_length);
        near(arm / mass.cbrt(), 0.9, 1.1);
        for axis in 0..3 {
            near(params.inertia[axis] / nominal.inertia[axis] / (mass * arm * arm), 0.8, 1.25);
            near(params.drag_coefficients[axis] / nominal.drag_coefficients[axis] / mass, 0.7, 1.3);
        }
        let thrust = params.thrust_coefficient / nominal.thrust_coefficient;
        near(params.torque_coefficient / nominal.torque_coefficient / (thrust * arm), 0.8, 1.25);
        near(params.max_rpm() / nominal.max_rpm(), 1.0, 1.0);
        let full = 4.0 * params.thrust_coefficient * nominal.max_rpm().powi(2);
        near(full / (params.mass * 9.81) / params.thrust_to_weight, 1.0, 1.0);
        near(scale.command(params.hover_rpm()), -0.34, 0.46);
        // angular acceleration at full torque, as a ratio to that of the nominal airframe
        let turn = |p: &DroneParams| p.thrust_to_weight * p.mass * p.arm_length / p.inertia[0];
        near(turn(params) / turn(&nominal), 0.11, 3.5);
    }
    let span = |[low, high]: [f64; 2]| uniform(low, high);
    assert!(kolmogorov_smirnov(masses, span([0.02, 2.0].map(f64::ln))) < 1.95);
    assert!(kolmogorov_smirnov(ratios, span([1.5, 5.0])) < 1.95);
    assert!(kolmogorov_smirnov(lags, span([0.01, 0.1].map(f64::ln))) < 1.95);
}

#[test]
fn a_whole_airframe_hovers_at_the_command_of_its_own_hover_speed() {
    let scale = mujoco_drones_gym::action::MotorScale::new(&DroneModel::Cf2x.params());
    let mut env = hovering(only("[airframe]\nlag = [0.02, 0.05]\n"));
    for _ in 0..5 {
        env.reset(None).unwrap();
        let command = scale.command(env.simulation().params(0).hover_rpm());
        step_env(&mut env, &[command; 4], 240);
        let before = env.simulation().states()[0].velocity.z;
        step_env(&mut env, &[command; 4], 24);
        let acceleration = (env.simulation().states()[0].velocity.z - before) / 0.1;
        assert!(acceleration.abs() < 1e-6, "{acceleration}");
    }
}

#[test]
fn whole_airframes_leave_the_samples_of_other_groups_as_they_are() {
    let others = only("[sensors]\n[environment]\n[initial]\n");
    let with = Randomization { airframe: Some(Default::default()), ..others.clone() };
    for (plain, sampled) in samples_of_episodes(others, 1).iter().zip(&samples_of_episodes(with, 1)) {
        assert_eq!(
            (plain.gravity, plain.wind, plain.sensor_latency),
            (sampled.gravity, sampled.wind, sampled.sensor_latency)
        );
        for (plain, sampled) in plain.drones.iter().zip(&sampled.drones) {
            assert_eq!((plain.bias, plain.initial), (sampled.bias, sampled.initial));
            assert!(plain.mass == 1.0 && sampled.mass != 1.0);
        }
    }
}

#[test]
fn whole_airframes_exclude_the_groups_that_they_replace() {
    let refused = |toml: &str| Randomization::from_toml(toml).unwrap_err().to_string();
    for group in ["body", "aerodynamics", "actuators"] {
        let error = refused(&format!("[airframe]\n[{group}]\n"));
        assert!(error.contains("the randomized airframe is set together with body"), "{error}");
    }
    let error = refused("[airframe]\nmass = [0.0, 1.0]\n");
    assert!(error.contains("the randomized airframe.mass is [0, 1], expected a range from 0.001 to 100 kg"), "{error}");
    assert!(refused("[airframe]\nthrust_to_weight = [0.9, 2.0]\n").contains("airframe.thrust_to_weight"));
}

/// The rotor speed completes 63 % of a step in one time constant, and does not change during the latency.
#[test]
fn motors_have_the_sampled_lag_latency_and_maximum_speed() {
    let hover = DroneModel::Cf2x.params().hover_rpm();
    let step = 0.1 * (DroneModel::Cf2x.params().max_rpm() - hover);
    let answer = |config: &str, steps: usize| {
        let mut env = hovering(only(config));
        step_env(&mut env, &[0.1; 4], steps);
        (env.simulation().rotor_speeds(0)[0] - hover) / step
    };
    let rest = "gain = [1, 1]\nmax_rpm = [1, 1]\n";
    let lag = answer(&format!("[actuators]\nlag = [0.05, 0.05]\nlatency = [0, 0]\n{rest}"), 12);
    assert!((lag - (1.0 - (-1_f64).exp())).abs() < 1e-9, "{lag}");
    let late = format!("[actuators]\nlag = [0, 0]\nlatency = [0.025, 0.025]\n{rest}");
    assert!(answer(&late, 6).abs() < 1e-12 && (answer(&late, 7) - 1.0).abs() < 1e-12);
    let mut env =
        hovering(only("[actuators]\nlag = [0, 0]\nlatency = [0, 0]\ngain = [1, 1]\nmax_rpm = [0.95, 0.95]\n"));
    env.step(&[1.0; 4]).unwrap();
    let max = DroneModel::Cf2x.params().max_rpm();
    assert!((env.simulation().rotor_speeds(0)[0] / max - 0.95).abs() < 1e-12);
}

#[test]
fn observations_have_noise_bias_and_latency_and_true_states_do_not() {
    let quiet = |more: &str| {
        only(&format!("[sensors]\nposition = 0\nvelocity = 0\nattitude = 0\nangular_velocity = 0\nbias = 0\n{more}"))
    };
    // a latency of five physics steps; a control step is one physics step
    let mut env = hovering(quiet("latency = [0.02083, 0.02083]\n"));
    let mut heights = vec![2.0; 6];
    for _ in 0..30 {
        let measured = env.step(&[0.5; 4]).unwrap().observation.vector[2];
        heights.push(env.simulation().states()[0].position.z);
        assert_eq!(measured, heights[heights.len() - 6], "the height five steps ago");
    }
    // noise with a constant bias: mean and standard deviation over an episode
    let config = only("[sensors]\nlatency = [0, 0]\nposition = 0.02\nvelocity = 0.1\n");
    let mut env = hovering(config);
    let bias = env.sampled_params().unwrap().drones[0].bias;
    let mut differences = Vec::new();
    for _ in 0..2000 {
        let truth = env.simulation().states()[0];
        let measured = &env.observation().vector;
        differences.push([
            measured[0] - truth.position.x,
            measured[6] - truth.velocity.x,
            measured[5] - truth.yaw(),
            measured[9] - truth.angular_velocity.x,
        ]);
        env.step(&[0.0; 4]).unwrap();
    }
    for (what, sigma) in [0.02, 0.1, 1_f64.to_radians(), 0.05].into_iter().enumerate() {
        let axis = if what == 2 { 2 } else { 0 };
        let n = differences.len() as f64;
        let mean = differences.iter().map(|d| d[what]).sum::<f64>() / n;
        let spread = (differences.iter().map(|d| (d[what] - mean).powi(2)).sum::<f64>() / n).sqrt();
        assert!((mean - bias[what][axis]).abs() < 4.0 * sigma / n.sqrt(), "{what}: {mean} {}", bias[what][axis]);
        assert!((spread / sigma - 1.0).abs() < 0.08, "{what}: {spread}");
    }
    assert!((env.simulation().states()[0].position.z - 2.0).abs() < 1e-3, "sensor noise does not move the drone");
    // the target in the observation has no noise
    let mut env = Velocity::builder().randomization(only("[sensors]\n")).build().unwrap();
    env.reset(Some(1)).unwrap();
    let (target, rate) = env.task().target(0);
    assert_eq!((&env.observation().vector[12..15], env.observation().vector[15]), (target.as_slice(), rate));
}

/// `set_airframe` changes MuJoCo's model to the one that MuJoCo compiles for the airframe.
#[test]
fn a_changed_airframe_gives_the_compiled_model() {
    let other = DroneParams { mass: 0.031, inertia: [1.7e-5, 1.6e-5, 2.9e-5], ..DroneModel::Cf2x.params() };
    let body = |params: &DroneParams, x: f64| DroneBody {
        params: params.clone(),
        position: Vector3::new(x, 0.0, 1.0),
        rpy: Vector3::zeros(),
    };
    let nominal = DroneModel::Cf2x.params();
    let compiled =
        Model::from_xml(&World::new(vec![body(&nominal, 0.0), body(&other, 1.0)]).to_mjcf().unwrap()).unwrap();
    let mut simulation = Simulation::builder(nominal).num_drones(2).build().unwrap();
    simulation.set_airframe(1, other.clone()).unwrap();
    let data: &Data = simulation.mujoco().unwrap();
    let patched = data.model();
    let close = |a: &[f64], b: &[f64]| {
        assert!(a.len() == b.len() && a.iter().zip(b).all(|(a, b)| (a - b).abs() <= 1e-9 * b.abs()), "{a:?} {b:?}");
    };
    close(patched.body_mass(), compiled.body_mass());
    close(patched.body_inertia(), compiled.body_inertia());
    close(patched.body_subtreemass(), compiled.body_subtreemass());
    close(patched.body_invweight0(), compiled.body_invweight0());
    close(patched.dof_invweight0(), compiled.dof_invweight0());
    close(patched.dof_M0(), compiled.dof_M0());
    assert_eq!(simulation.params(1), &other);
}

#[test]
fn every_task_keeps_its_contract_with_randomization_and_wind() {
    for name in NAMES {
        let config = || EnvConfig::default().physics(Physics::MjcGndDragDw).episode_seconds(3.0);
        let build = || {
            let mut env = make(name, config()).unwrap();
            env.set_randomization(Some(Randomization::default())).unwrap();
            env
        };
        assert_contract(build);
        let wind = WindConfig::new(WindModel::Combined);
        let some = only("[body]\n[actuators]\n[sensors]\n[initial]\n");
        let stacked = || {
            let mut env = make(name, config()).unwrap();
            env.set_wind(Some(wind)).unwrap();
            env.set_randomization(Some(some.clone())).unwrap();
            env
        };
        check_env(&mut stacked()).unwrap_or_else(|error| panic!("{error}"));
    }
}

/// Regression test: the configured wind was ignored without an error, in both orders of the two calls.
#[test]
fn a_configured_wind_next_to_a_sampled_wind_is_an_error() {
    let wind = WindConfig::new(WindModel::Combined);
    let mut windy = Hover::builder().build().unwrap();
    windy.set_wind(Some(wind)).unwrap();
    let message = "wind is combined, expected none";
    let error = windy.set_randomization(Some(Randomization::default())).unwrap_err().to_string();
    assert!(error.contains(message), "{error}");
    let mut randomized = Hover::builder().randomization(Randomization::default()).build().unwrap();
    for _ in 0..2 {
        let error = randomized.set_wind(Some(wind)).unwrap_err().to_string();
        assert!(error.contains(message), "{error}");
        randomized.reset(Some(1)).unwrap();
    }
    randomized.set_wind(None).unwrap();
    randomized.set_randomization(None).unwrap();
    randomized.set_wind(Some(wind)).unwrap();
}

/// The Dryden filter and still-air drag do not belong to a wind model: a sampled wind uses those of the configuration.
#[test]
fn a_sampled_wind_uses_the_configured_filter() {
    let settings = WindConfig { filter: DrydenFilter::MilF8785c, ..WindConfig::default() };
    let build = |settings| Hover::builder().wind(settings).randomization(only("[environment]\n")).build().unwrap();
    for (settings, filter) in [(settings, DrydenFilter::MilF8785c), (WindConfig::default(), DrydenFilter::FirstOrder)] {
        let mut env = build(settings);
        for seed in 0..3 {
            env.reset(Some(seed)).unwrap();
            assert_eq!(env.simulation().wind().unwrap().filter, filter);
        }
    }
}

#[test]
fn no_drone_starts_in_the_floor_or_in_another_drone() {
    let mut env =
        Formation::builder().task(|task| task.radius = 0.12).randomization(only("[initial]\n")).build().unwrap();
    let mut low = Hover::builder().randomization(only("[initial]\n")).build().unwrap();
    for seed in 0..300 {
        env.reset(Some(seed)).unwrap();
        let states = env.simulation().states();
        for i in 0..3 {
            for j in 0..i {
                assert!((states[i].position - states[j].position).norm() > 0.12, "seed {seed}");
            }
        }
        low.reset(Some(seed)).unwrap();
        let state = low.simulation().states()[0];
        let tilt = state.tilt();
        assert!(state.position.z > 0.015 * tilt.cos() + 0.06 * tilt.sin(), "seed {seed}");
    }
}

#[test]
fn an_offset_moves_the_sampled_starts_and_not_the_reference() {
    let shifted = only("[initial]\nposition = 0.3\nvelocity = 0.0\nattitude = 0.0\noffset = [1.0, -2.0, 3.0]\n");
    let mut env = MultiHover::builder().randomization(shifted.clone()).build().unwrap();
    let mut sums = [0.0; 3];
    for seed in 0..200 {
        env.reset(Some(seed)).unwrap();
        for (drone, state) in env.simulation().states().iter().enumerate() {
            for (axis, middle) in [drone as f64 + 1.0, -2.0, 3.1].into_iter().enumerate() {
                let off = state.position[axis] - middle;
                assert!(off.abs() <= 0.3, "drone {drone}, axis {axis}: {off}");
                sums[axis] += off / 400.0;
            }
        }
        // the reference of the task does not move
        assert_eq!(env.reference(1).position.x, 1.0);
    }
    assert!(sums.iter().all(|mean| mean.abs() < 0.03), "{sums:?}");
    // a start below the floor is moved onto it
    let below = only("[initial]\noffset = [0.0, 0.0, -5.0]\n");
    let mut env = Hover::builder().randomization(below).build().unwrap();
    env.reset(Some(1)).unwrap();
    let z = env.simulation().states()[0].position.z;
    assert!((0.015..0.03).contains(&z), "{z}");
    for wrong in ["[initial]\noffset = [0.0, nan, 0.0]\n", "[initial]\noffset = [0.0, 2e3, 0.0]\n"] {
        assert!(Randomization::from_toml(wrong).unwrap_err().to_string().contains("initial.offset"));
    }
    assert!(Randomization::from_toml("[initial]\noffset = [0.0, 1.0]\n").is_err());
    assert!(MultiHover::builder().randomization(shifted).build().is_ok());
}

#[test]
fn removing_randomization_restores_nominal_flights_and_a_seed_reproduces_its_sample() {
    let flight = |env: &mut Aviary<Hover>| {
        env.reset(Some(4)).unwrap();
        let mut observations = Vec::new();
        while observations.len() < 100 && env.info().end.is_none() {
            observations.push(env.step(&[0.03; 4]).unwrap().observation.vector.clone());
        }
        observations
    };
    let mut env = Hover::builder().build().unwrap();
    let nominal = flight(&mut env);
    env.set_randomization(Some(Randomization::default())).unwrap();
    let randomized = flight(&mut env);
    let sampled = env.sampled_params().unwrap().clone();
    assert_ne!(randomized, nominal);
    env.reset(None).unwrap();
    assert_ne!(env.sampled_params().unwrap(), &sampled);
    assert_eq!(flight(&mut env), randomized);
    assert_eq!(env.sampled_params().unwrap(), &sampled);
    assert_eq!(env.info_map()["sampled_mass"], sampled.drones[0].mass);
    env.set_randomization(None).unwrap();
    assert_eq!(flight(&mut env), nominal);
    assert!(env.sampled_params().is_none());
    assert_eq!(env.simulation().params(0), &DroneModel::Cf2x.params());
}

#[test]
fn torques_of_the_air_are_sampled_and_leave_other_samples_alone() {
    let fly = |text: &str| {
        let mut env = MultiHover::builder().drone(DroneModel::Cf21).randomization(only(text)).build().unwrap();
        let mut all = Vec::new();
        for seed in 0..20 {
            env.reset(Some(seed)).unwrap();
            for (drone, sampled) in env.sampled_params().unwrap().drones.iter().enumerate() {
                all.push((*sampled, env.simulation().params(drone).air));
            }
        }
        all
    };
    let nominal = DroneModel::Cf21.params().air;
    let (sampled, plain) =
        (fly("[aerodynamics]\nmoment = [0.9, 1.1]\ndamping = [0.5, 0.6]\n"), fly("[aerodynamics]\n"));
    for ((with, air), (without, plain)) in sampled.iter().zip(&plain) {
        assert_eq!((with.thrust, with.drag), (without.thrust, without.drag));
        assert!((0.9..=1.1).contains(&with.moment) && (0.5..=0.6).contains(&with.damping));
        assert_eq!(air.velocity_moment, nominal.velocity_moment * f64::from(with.moment));
        assert_eq!(air.rotational_damping, nominal.rotational_damping.map(|d| d * f64::from(with.damping)));
        assert_eq!((without.moment, without.damping), (1.0, 1.0));
        assert_eq!(
            (plain.velocity_moment, plain.rotational_damping),
            (nominal.velocity_moment, nominal.rotational_damping)
        );
    }
    let mut moments: Vec<_> = sampled.iter().map(|(with, _)| with.moment).collect();
    moments.sort_by(f32::total_cmp);
    moments.dedup();
    assert!(moments.len() > 35 && moments[0] < 0.93 && moments[moments.len() - 1] > 1.07, "{moments:?}");
}

#[test]
fn invalid_ranges_are_errors_with_the_field_and_invalid_toml_with_the_line() {
    let error = |text: &str| Randomization::from_toml(text).unwrap_err().to_string();
    assert!(error("[body]\nmass = [1.2, 0.8]\n").contains("body.mass is [1.2, 0.8]"));
    assert!(error("[body]\nmass = [0.0, 1.0]\n").contains("body.mass"));
    assert!(error("[aerodynamics]\ndamping = [0.5, -1]\n").contains("aerodynamics.damping is [0.5, -1]"));
    assert!(error("[actuators]\nlatency = [0, 9]\n").contains("actuators.latency"));
    assert!(error("[sensors]\nbias = -1\n").contains("sensors.bias is -1"));
    assert!(error("[sensors]\nposition = nan\n").contains("sensors.position is NaN"));
    assert!(error("[body]\nmass = [0.9, 1.1]\nweight = 2\n").contains("line 3"));
    assert!(error("[boddy]\n").contains("line 1"));
    let config = Randomization {
        sensors: Some(SensorRanges { latency: [0.0, f64::INFINITY], ..SensorRanges::default() }),
        ..Randomization::NONE
    };
    assert!(Hover::builder().randomization(config).build().is_err());
    assert!(ActuatorParams::default().validate().is_ok());
}

#[test]
fn configured_motors_and_wind_return_when_randomization_is_removed() {
    let motors = ActuatorParams { lag: 0.03, ..ActuatorParams::default() };
    let wind = WindConfig { velocity: [2.0, 0.0, 0.0], ..WindConfig::new(WindModel::Constant) };
    let build = || Hover::builder().initial_positions([[0.0, 0.0, 1.0]]).actuators(motors).wind(wind).build().unwrap();
    let flight = |env: &mut Aviary<Hover>| {
        env.reset(Some(4)).unwrap();
        (0..30).map(|_| env.step(&[0.03; 4]).unwrap().observation.vector.clone()).collect::<Vec<_>>()
    };
    let (mut plain, mut env) = (build(), build());
    let expected = flight(&mut plain);
    let without_wind =
        Randomization { environment: only("[environment]\nwind = [0, 0]\n").environment, ..Randomization::default() };
    for config in [without_wind, only("[body]\n[environment]\nwind = [0, 0]\n")] {
        env.set_randomization(Some(config)).unwrap();
        env.reset(Some(1)).unwrap();
        env.step(&[0.0; 4]).unwrap();
        env.set_randomization(None).unwrap();
        assert_eq!(flight(&mut env), expected);
        assert_eq!(env.simulation().wind(), Some(&wind));
    }
    // a sampled wind is removed with the randomization
    let mut still = Hover::builder().initial_positions([[0.0, 0.0, 1.0]]).actuators(motors).build().unwrap();
    let expected = flight(&mut still);
    still.set_randomization(Some(Randomization::default())).unwrap();
    still.reset(Some(1)).unwrap();
    assert!(still.simulation().wind().is_some());
    still.set_randomization(None).unwrap();
    assert_eq!(flight(&mut still), expected);
    assert!(still.simulation().wind().is_none());
}

#[test]
fn sampled_starts_near_the_floor_and_a_tree_touch_neither() {
    let tree = Obstacle::new(Shape::Cylinder { radius: 0.1, half_height: 1.0 }, Vector3::new(0.25, 0.0, 1.0));
    let mut env = Hover::builder()
        .initial_positions([[0.0, 0.0, 0.0151]])
        .obstacles([tree])
        .randomization(only("[initial]\n"))
        .build()
        .unwrap();
    for seed in 0..300 {
        env.reset(Some(seed)).unwrap();
        let state = env.simulation().states()[0];
        let tilt = state.tilt();
        assert!(state.position.z > 0.015 * tilt.cos() + 0.06 * tilt.sin(), "seed {seed}");
        assert!(env.simulation().obstacle_distance(0) > 0.06, "seed {seed}");
    }
}
