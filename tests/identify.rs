//! Identification of airframes from flights that the simulator itself makes: a controller with noise in its commands
//! flies an airframe with random parameters, and the recording has the noise of motion capture and gyro.

use mujoco_drones_gym::drone::{AirParams, DroneModel, DroneParams, MotorParams, YawConvention};
use mujoco_drones_gym::flights::identify::{
    FittedParameter, Identification, IdentifyOptions, Status, Unidentified, identify,
};
use mujoco_drones_gym::flights::{
    Flight, FlightError, HORIZONS, ObserverParams, RotationFilter, Score, TranslationFilter,
};
use mujoco_drones_gym::simulation::Simulation;
use nalgebra::{UnitQuaternion, Vector3, Vector4};
use rand::{RngExt, SeedableRng};

type Random = rand_chacha::ChaCha8Rng;

/// Physics steps per second, so short that their length has no effect on the flight.
const SIM_FREQ: u32 = 4000;

/// Commands per second, and per recorded row.
const CTRL_FREQ: u32 = 500;
const COMMANDS: u32 = 5;

/// Time between recorded rows, s.
const ROW: f64 = 0.01;

/// Noise of the recordings: position (m), velocity (m/s), attitude (rad), gyro (rad/s).
const POSITION_NOISE: f64 = 1e-4;
const VELOCITY_NOISE: f64 = 3e-3;
const ATTITUDE_NOISE: f64 = 1e-3;
const GYRO_NOISE: f64 = 0.02;

/// Approximately normal number.
fn normal(random: &mut Random) -> f64 {
    (0..12).map(|_| random.random_range(0.0..1.0)).sum::<f64>() - 6.0
}

fn normal_vector(random: &mut Random, deviation: f64) -> Vector3<f64> {
    Vector3::from_fn(|_, _| deviation * normal(random))
}

/// Returns a random airframe. Numbers that the identification fits only if they differ from their default (the
/// asymmetries, the lift, …) have the default or differ clearly.
fn airframe(random: &mut Random) -> DroneParams {
    let base = DroneModel::Cf2x.params();
    let mass = random.random_range(0.03..0.045);
    let hover = (mass * 9.81 / (4.0 * base.thrust_coefficient)).sqrt();
    let coin = |random: &mut Random| random.random_range(0.0..1.0) < 0.5;
    let x = 1.6e-5 * random.random_range(0.8..1.4);
    let y = if coin(random) { x } else { 1.3 * x };
    let rise = random.random_range(0.03..0.05);
    let at_zero = if coin(random) { 0.0 } else { hover * random.random_range(0.25..0.35) };
    let drag = mass * random.random_range(0.3..0.6);
    let damping = x * random.random_range(3.0..10.0);
    let arm = 0.01 * mass * 9.81 * base.arm_length;
    let speed_per_volt = (hover - at_zero) / (4.0 * random.random_range(0.55..0.65));
    DroneParams {
        mass,
        inertia: [x, y, (x + y) * random.random_range(0.75..0.85)],
        yaw_convention: if coin(random) { YawConvention::Crazyflie } else { YawConvention::Reversed },
        torque_coefficient: base.torque_coefficient * random.random_range(0.5..1.0),
        // full duty is below the limit of the speed
        thrust_to_weight: 4.0,
        motors: MotorParams {
            speed_at_zero: at_zero,
            speed_per_volt,
            voltage: 4.0,
            rise_time: rise,
            fall_time: if coin(random) { rise } else { 1.5 * rise },
            // the simulator rounds it to whole physics steps
            latency: f64::from(random.random_range(24..88)) / f64::from(SIM_FREQ),
            rotor_inertia: if coin(random) { 0.0 } else { 2e-8 },
        },
        air: AirParams {
            linear_drag: [drag, if coin(random) { drag } else { 1.5 * drag }, mass * random.random_range(0.4..0.8)],
            translational_lift: if coin(random) { 0.0 } else { 0.02 * mass * 9.81 },
            velocity_moment: x * random.random_range(3.0..10.0),
            rotational_damping: [damping, damping, random.random_range(2e-5..1e-4)],
            trim_torque: [0.0, 0.0, 0.5 * arm * random.random_range(-1.0..1.0)],
        },
        center_of_mass: [0, 1].map(|_| 0.03 * base.arm_length * random.random_range(-1.0..1.0)),
        ..base
    }
}

/// Speed, acceleration and tilt of a flight.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Style {
    /// Curves with tilts up to 25°, and noise in the commands.
    Agile,
    /// Hover without noise in the commands.
    Hover,
}

/// Flies an airframe and returns the recording.
fn fly(params: &DroneParams, style: Style, seconds: f64, random: &mut Random) -> Flight {
    let agile = style == Style::Agile;
    let waves: Vec<(f64, f64, f64)> = [(0.9, 1.3..2.0), (0.9, 1.3..2.0), (0.35, 1.5..2.5), (0.8, 0.8..1.5)]
        .into_iter()
        .map(|(size, frequencies)| {
            let size = if agile { size } else { 0.0 };
            (size, random.random_range(frequencies), random.random_range(0.0..6.0))
        })
        .collect();
    // derivative 0, 1 or 2 of a reference
    let wave = |index: usize, derivative: i32, t: f64| {
        let (size, w, phase) = waves[index];
        size * w.powi(derivative) * (w * t + phase + f64::from(derivative) * std::f64::consts::FRAC_PI_2).sin()
    };
    let reference = |derivative: i32, t: f64| Vector3::from_fn(|axis, _| wave(axis, derivative, t));
    let lift = Vector3::new(0.0, 0.0, 3.0);
    let mut simulation = Simulation::builder(params.clone())
        .sim_freq(SIM_FREQ)
        .ctrl_freq(CTRL_FREQ)
        .initial_positions([(reference(0, 0.0) + lift).into()])
        .build()
        .unwrap();
    let allocation = params.allocation().try_inverse().unwrap();
    let rows = (seconds / ROW).round() as usize;
    let open_circuit = random.random_range(3.9..4.2);
    let mut duty = [0.6; 4];
    let mut dither = [0.0; 4];
    let mut voltage = open_circuit - 0.3;
    let mut flight = Flight {
        name: format!("flight{}", random.random_range(0..1_000_000)),
        start: 0.0,
        step: ROW,
        position: Vec::new(),
        attitude: Vec::new(),
        velocity: Vec::new(),
        body_rate: Some(Vec::new()),
        acceleration: None,
        duty: Some(Vec::new()),
        voltage: Some(Vec::new()),
    };
    for row in 0..rows {
        let t = row as f64 * ROW;
        let state = simulation.states()[0];
        flight.position.push(state.position + normal_vector(random, POSITION_NOISE));
        flight.velocity.push(state.velocity + normal_vector(random, VELOCITY_NOISE));
        flight.attitude.push(state.attitude * UnitQuaternion::from_scaled_axis(normal_vector(random, ATTITUDE_NOISE)));
        let gyro = state.angular_velocity + normal_vector(random, GYRO_NOISE);
        flight.body_rate.as_mut().unwrap().push(gyro);
        flight.duty.as_mut().unwrap().push(duty);
        flight.voltage.as_mut().unwrap().push(voltage);

        // position, attitude and rate loops
        let off = reference(0, t) + lift - state.position;
        let slip = reference(1, t) - state.velocity;
        let wanted = reference(2, t) + off * 0.5 + slip * 1.0 + Vector3::z() * 9.81;
        let turn = UnitQuaternion::rotation_between(&Vector3::z(), &wanted).unwrap_or_default()
            * UnitQuaternion::from_axis_angle(&Vector3::z_axis(), wave(3, 0, t));
        let angle = (state.attitude.inverse() * turn).scaled_axis();
        let gains = Vector3::new(8.0, 8.0, 4.0);
        // a rate that the damping of the airframe does not reduce
        let damping = Vector3::from(params.air.rotational_damping).component_div(&params.inertia_vector());
        let spin = angle.component_mul(&Vector3::new(3.0, 3.0, 1.5)).component_mul(&(gains + damping));
        let spin = spin - state.angular_velocity.component_mul(&gains);
        let torque = spin.component_mul(&params.inertia_vector());
        // the moments that the controller knows
        let v = state.attitude.inverse() * state.velocity;
        let moment = Vector3::new(v.y, -v.x, 0.0) * params.air.velocity_moment;
        let torque = torque - moment - Vector3::from(params.air.trim_torque);
        let thrust = params.mass * wanted.dot(&(state.attitude * Vector3::z()));
        let forces = allocation * Vector4::new(thrust, torque.x, torque.y, torque.z);
        let mean: f64 = duty.iter().sum::<f64>() / 4.0;
        let next_voltage = open_circuit - 0.4 * mean - 0.004 * t;
        let mut next = [0.0; 4];
        for motor in 0..4 {
            dither[motor] = 0.7 * dither[motor] + if agile { 0.015 * normal(random) } else { 0.0 };
            let rpm = (forces[motor].max(0.0) / params.thrust_coefficient).sqrt();
            let steady = (rpm - params.motors.speed_at_zero) / (params.motors.speed_per_volt * next_voltage);
            next[motor] = (steady + dither[motor]).clamp(0.05, 0.98);
        }
        // duty and voltage are linear between rows
        for step in 0..COMMANDS {
            let part = (f64::from(step) + 0.5) / f64::from(COMMANDS);
            let at = |a: f64, b: f64| a + (b - a) * part;
            let command = [0, 1, 2, 3].map(|motor| {
                let drive = at(duty[motor], next[motor]) * at(voltage, next_voltage);
                params.motors.speed_at_zero + params.motors.speed_per_volt * drive
            });
            simulation.step(&[command]).unwrap();
        }
        (duty, voltage) = (next, next_voltage);
    }
    let largest = flight.position.iter().map(|position| (position - lift).norm()).fold(0.0, f64::max);
    assert!(largest < 5.0, "the controller of this test does not hold the airframe: {largest} m");
    flight
}

/// Airframe that is given to the identification: the mass, and the moment of inertia about z, which flights determine
/// only relative to the torques about z.
fn base(truth: &DroneParams) -> DroneParams {
    let base = DroneModel::Cf2x.params();
    let [x, y, _] = base.inertia;
    DroneParams { mass: truth.mass, inertia: [x.max(truth.inertia[2] - y), y, truth.inertia[2]], ..base }
}

/// Returns options with an estimator for the noise of these flights, which have no disturbances: no wind, and commands
/// that are recorded exactly. The default expects disturbances, and turns the noise of the gyro into some. The slow
/// disturbances change fast enough to forget the first rows, before which the commands are unknown.
fn options() -> IdentifyOptions {
    let translation = TranslationFilter {
        position_error: POSITION_NOISE,
        velocity_error: VELOCITY_NOISE,
        velocity_noise: 0.02,
        slow_noise: 0.05,
        slow_deviation: 0.2,
        fast_deviation: 0.01,
        fast_time: 0.5,
    };
    let rotation = RotationFilter {
        rate_noise: 2.0_f64.sqrt() * GYRO_NOISE / ROW.sqrt(),
        slow_noise: 3.0,
        slow_deviation: 10.0,
        fast_deviation: 0.0,
        fast_time: 0.1,
    };
    let observer = ObserverParams { level: translation, vertical: translation, roll_pitch: rotation, yaw: rotation };
    IdentifyOptions { observer, ..IdentifyOptions::default() }
}

fn identified(truth: &DroneParams, flights: &[Flight]) -> Identification {
    let mut last = 0.0;
    let result = identify(flights, &base(truth), &options(), &mut |part| {
        assert!((last..=1.0).contains(&part), "progress from {last} to {part}");
        last = part;
    });
    assert_eq!(last, 1.0);
    result.unwrap()
}

/// Returns the number of an airframe by the name of a parameter.
fn number(params: &DroneParams, name: &str) -> f64 {
    let value = serde_json::to_value(params).unwrap();
    let mut place = &value;
    for part in name.split(['.', '[', ']']).filter(|part| !part.is_empty()) {
        // absent numbers are zero
        let inner = match part.parse::<usize>() {
            Ok(index) => place.get(index),
            Err(_) => place.get(part),
        };
        let Some(inner) = inner else { return 0.0 };
        place = inner;
    }
    place.as_f64().unwrap()
}

/// Error of the steps of 2 ms of a prediction, as a part of a number: damping and drag are constant in a step.
const STEP_ERROR: f64 = 0.01;

/// Returns the deviations of all fitted parameters from the truth in standard errors.
fn deviations(truth: &DroneParams, identified: &Identification) -> Vec<(&'static str, f64)> {
    let fitted = |parameter: &&FittedParameter| parameter.estimate.error.is_finite();
    let fitted = identified.parameters.iter().filter(fitted);
    let deviation = |parameter: &FittedParameter| {
        let off = parameter.estimate.value - number(truth, parameter.name);
        let off = (off.abs() - STEP_ERROR * parameter.estimate.value.abs()).max(0.0);
        (parameter.name, off / parameter.estimate.error)
    };
    fitted.map(deviation).collect()
}

/// Identifies a random airframe and returns the deviations of its parameters.
fn case(seed: u64) -> Vec<(&'static str, f64)> {
    let mut random = Random::seed_from_u64(seed);
    let truth = airframe(&mut random);
    let flights: Vec<_> = (0..3).map(|_| fly(&truth, Style::Agile, 25.0, &mut random)).collect();
    let identified = identified(&truth, &flights);
    assert_eq!(identified.airframe.yaw_convention, truth.yaw_convention, "{seed}");
    assert!(identified.alignments.iter().all(|alignment| alignment.applied.is_zero()), "{:?}", identified.alignments);
    let deviations = deviations(&truth, &identified);
    for name in ["motors.speed_per_volt", "motors.rise_time", "motors.latency", "air.linear_drag[0]", "inertia[0]"] {
        assert!(deviations.iter().any(|(other, _)| *other == name), "seed {seed}: {name} is not identified");
    }
    deviations
}

#[test]
fn parameters_of_random_airframes_are_within_three_standard_errors() {
    for seed in [1, 2, 3, 4] {
        for (name, deviation) in case(seed) {
            assert!(deviation < 3.0, "seed {seed}: {name} is {deviation:.1} standard errors off");
        }
    }
}

#[test]
#[ignore = "takes minutes"]
fn standard_errors_of_many_airframes_cover_the_truth() {
    let mut deviations = Vec::new();
    for seed in 100..140 {
        deviations.extend(case(seed).into_iter().map(|(_, deviation)| deviation));
    }
    let share = |limit: f64| deviations.iter().filter(|x| **x < limit).count() as f64 / deviations.len() as f64;
    let shares = [1.0, 2.0, 3.0, 5.0].map(share);
    // a normal distribution has 0.68, 0.95 and 0.997
    assert!(shares[0] > 0.55 && shares[1] > 0.88 && shares[2] > 0.97 && shares[3] == 1.0, "{shares:?}");
}

/// Returns the sum of the scores of all flights with the predicted attitude.
fn position_ratio(identified: &Identification) -> f64 {
    let mut sum = Score::EMPTY;
    for left_out in &identified.leave_one_out {
        sum.add(&left_out.compared.tracks[1].scores[HORIZONS.len() - 1]);
    }
    sum.ratio().position
}

#[test]
fn the_file_reads_back_and_predicts_flights_that_were_left_out() {
    let mut random = Random::seed_from_u64(11);
    let truth = airframe(&mut random);
    let flights: Vec<_> = (0..2).map(|_| fly(&truth, Style::Agile, 12.0, &mut random)).collect();
    let result = identified(&truth, &flights);
    let text = result.toml(&["a".into(), "b".into()]);
    assert_eq!(
        DroneParams { provenance: "identified from a, b".into(), ..result.airframe.clone() },
        DroneParams::from_toml(&text).unwrap()
    );
    assert!(text.contains("± ") && text.contains("speed_per_volt"), "{text}");
    assert_eq!(result.leave_one_out.len(), 2);
    let ratio = position_ratio(&result);
    assert!(ratio < 0.25, "{ratio}");
    // the same flights give the same airframe
    assert_eq!(result, identified(&truth, &flights));

    let single = identified(&truth, &flights[..1]);
    assert!(single.leave_one_out.is_empty() && single.compared.len() == 1);
}

#[test]
fn a_lag_of_the_motor_columns_of_one_flight_is_found_and_removed() {
    let mut random = Random::seed_from_u64(12);
    let truth = airframe(&mut random);
    let mut flights: Vec<_> = (0..3).map(|_| fly(&truth, Style::Agile, 15.0, &mut random)).collect();
    let lag = 4;
    let late = &mut flights[1];
    let columns = late.duty.as_mut().unwrap();
    columns.rotate_right(lag);
    let first = columns[lag];
    columns[..lag].fill(first);
    let result = identified(&truth, &flights);
    let shifts: Vec<f64> = result.alignments.iter().map(|alignment| alignment.applied.motor_shift).collect();
    assert!((shifts[1] - shifts[0] - lag as f64 * ROW).abs() < 6e-3, "{:?}", result.alignments);
}

#[test]
fn hovering_flights_do_not_determine_drag_and_lift() {
    let mut random = Random::seed_from_u64(13);
    let truth = airframe(&mut random);
    let mut flights: Vec<_> = (0..2).map(|_| fly(&truth, Style::Hover, 20.0, &mut random)).collect();
    // without the first seconds, in which the drone comes to rest
    flights.iter_mut().for_each(|flight| {
        flight.position.drain(..800);
        flight.velocity.drain(..800);
        flight.attitude.drain(..800);
        flight.body_rate.as_mut().unwrap().drain(..800);
        flight.duty.as_mut().unwrap().drain(..800);
        flight.voltage.as_mut().unwrap().drain(..800);
    });
    let result = identified(&truth, &flights);
    let status = |name: &str| &result.parameters.iter().find(|parameter| parameter.name == name).unwrap().status;
    for name in ["air.linear_drag[0]", "air.linear_drag[2]", "air.velocity_moment"] {
        assert!(matches!(status(name), Status::NotIdentifiable(_)), "{name}: {:?}", status(name));
    }
    assert_eq!(*status("air.linear_drag[2]"), Status::NotIdentifiable(Unidentified::NoEffect));
    // what they do determine: the duty of hover
    let motors = &result.airframe.motors;
    let duty = flights[0].duty.as_ref().unwrap()[800][0] * flights[0].voltage.as_ref().unwrap()[800];
    let ratio = (motors.speed_at_zero + motors.speed_per_volt * duty) / result.airframe.hover_rpm();
    assert!((ratio - 1.0).abs() < 0.05, "{ratio}");
    assert!(DroneParams::from_toml(&result.toml(&[])).is_ok());
}

#[test]
fn flights_that_cannot_be_used_are_errors_that_name_the_reason() {
    let mut random = Random::seed_from_u64(14);
    let truth = airframe(&mut random);
    let flight = fly(&truth, Style::Agile, 6.0, &mut random);
    let failed = |flights: &[Flight]| {
        let error = identify(flights, &base(&truth), &IdentifyOptions::default(), &mut |_| ()).unwrap_err();
        assert_eq!(error.to_string().lines().count(), 1);
        error
    };
    let without_motors = Flight { duty: None, ..flight.clone() };
    let error = failed(&[flight.clone(), without_motors]);
    assert!(
        matches!(&error, FlightError::Missing { columns, .. } if columns[..] == ["m1", "m2", "m3", "m4"]),
        "{error}"
    );
    assert!(matches!(failed(&[Flight { body_rate: None, ..flight.clone() }]), FlightError::Missing { .. }));
    let error = failed(&[Flight { voltage: None, ..flight.clone() }]);
    assert!(error.to_string().contains("vbat"), "{error}");
    let mut short = flight.clone();
    short.position.truncate(300);
    short.velocity.truncate(300);
    short.attitude.truncate(300);
    short.body_rate.as_mut().unwrap().truncate(300);
    short.duty.as_mut().unwrap().truncate(300);
    short.voltage.as_mut().unwrap().truncate(300);
    let error = failed(&[short]);
    assert!(error.to_string().contains("expected"), "{error}");
    assert!(matches!(failed(&[]), FlightError::Windows { .. }));
}
