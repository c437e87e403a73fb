//! Controllers, trajectories and action types on MuJoCo's dynamics: tracking errors, recovery and invalid inputs.
//!
//! "The paper" is *MuJoCo-Drones-Gym* (Tayal).

mod common;

use std::f64::consts::FRAC_PI_2;

use common::{airframe_with_duty, step_env};
use mujoco_drones_gym::action::ActionLimits;
use mujoco_drones_gym::control::trajectory::{Heading, PeriodicTrajectory, Plane, Steps, Trajectory, Waypoints, named};
use mujoco_drones_gym::control::{Bandwidths, ControllerKind, GeometricControl};
use mujoco_drones_gym::drone::{AirParams, MotorParams};
use mujoco_drones_gym::physics::actuators::ActuatorParams;
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::rollout::from_fn;
use mujoco_drones_gym::state::{attitude_from_rpy, wrap_angle};
use nalgebra::Vector3;
use proptest::prelude::*;

/// Errors of a flight along a trajectory.
struct Flight {
    /// Mean position error, m.
    mean: f64,
    /// Largest position error, m.
    peak: f64,
    /// Position error at the end, m.
    last: f64,
    /// Largest tilt, rad.
    tilt: f64,
    /// Largest yaw error, rad.
    yaw: f64,
}

/// Flies a trajectory for some seconds and returns the errors.
fn fly(mut simulation: Simulation, controller: &mut dyn Controller, path: &dyn Trajectory, seconds: f64) -> Flight {
    let dt = simulation.control_period();
    let mut flight = Flight { mean: 0.0, peak: 0.0, last: 0.0, tilt: 0.0, yaw: 0.0 };
    while simulation.time() < seconds - 0.5 * dt {
        let output = controller.control(dt, &simulation.states()[0], &path.reference(simulation.time()));
        simulation.step(&[output.rpm]).unwrap();
        let (state, reference) = (simulation.states()[0], path.reference(simulation.time()));
        flight.last = (state.position - reference.position).norm();
        flight.mean += flight.last;
        flight.peak = flight.peak.max(flight.last);
        flight.tilt = flight.tilt.max(state.tilt());
        flight.yaw = flight.yaw.max(wrap_angle(state.rpy().z - reference.yaw).abs());
        assert!(simulation.contacts().is_empty(), "contact at t = {} s", simulation.time());
    }
    flight.mean /= simulation.control_steps() as f64;
    flight
}

/// Creates a simulation of a drone at rest at the start of a trajectory.
fn at_start(model: impl Into<DroneParams>, path: &dyn Trajectory) -> Simulation {
    let start = path.start();
    Simulation::builder(model)
        .initial_positions([start.position.into()])
        .initial_rpys([[0.0, 0.0, start.yaw]])
        .build()
        .unwrap()
}

/// The paper reports a mean of 0.7 cm and a peak of 3.5 cm.
#[test]
fn the_mean_error_on_the_papers_vertical_circle_is_below_one_millimetre() {
    let circle = PeriodicTrajectory::circle(0.3, 8.0).unwrap().plane(Plane::YZ);
    for model in DroneModel::PAPER {
        let mut control = GeometricControl::new(&model.params());
        let flight = fly(at_start(model, &circle), &mut control, &circle, 8.0);
        assert!(flight.mean < 0.001 && flight.peak < 0.012, "{model}: {} {}", flight.mean, flight.peak);
    }
}

/// Airframes with lag, latency and rotational damping: the default bandwidths follow the motors.
#[test]
fn geometric_control_settles_with_slow_motors() {
    let hover = Steps::step([0.3, -0.4, 0.8], [0.0, 0.0, 1.0], 20.0).unwrap();
    let mut airframes = vec![DroneModel::Cf21.params()];
    for base in [DroneModel::Cf2x, DroneModel::Race].map(DroneModel::params) {
        for (lag, latency) in [(0.02, 0.0), (0.05, 0.01), (0.04, 0.04), (0.1, 0.0), (0.1, 0.03)] {
            for damping in [0.0, 5.0, 30.0] {
                let motors = MotorParams { rise_time: lag, fall_time: 0.5 * lag, latency, ..MotorParams::default() };
                let air = AirParams { rotational_damping: base.inertia.map(|j| damping * j), ..AirParams::default() };
                airframes.push(DroneParams { motors, air, ..base.clone() });
            }
        }
    }
    for params in airframes {
        let mut control = GeometricControl::new(&params);
        let last = fly(at_start(params.clone(), &hover), &mut control, &hover, 20.0).last;
        assert!(last < 0.01, "{}, {:?}, {:?}: {last}", params.name, params.motors, params.air);
    }
}

#[test]
fn a_loop_is_flown_upside_down_in_every_vertical_plane_and_at_every_yaw() {
    for (x, y) in [(1.0, 0.0), (0.0, 1.0), (0.6, 0.8), (-0.6, 0.8), (0.02, 1.0), (1.0, -0.02)] {
        for yaw in [0.0, 0.7, -2.0] {
            let path = PeriodicTrajectory::circle(1.0, 1.6)
                .and_then(|curve| curve.phase(-FRAC_PI_2)?.turns(1.0)?.ramp(0.8)?.heading(Heading::Fixed(yaw)))
                .unwrap()
                .plane(Plane::normal([x, y, 0.0]).unwrap())
                .centre([0.0, 0.0, 2.0]);
            let mut control = GeometricControl::new(&DroneModel::Race.params());
            let flight = fly(at_start(DroneModel::Race, &path), &mut control, &path, path.duration() + 1.0);
            assert!(flight.tilt > 3.0, "largest tilt of the loop: {} rad", flight.tilt);
            assert!(flight.peak < 0.05 && flight.last < 1e-3, "({x}, {y}) {yaw}: {} {}", flight.peak, flight.last);
        }
    }
}

#[test]
fn a_lemniscate_at_three_metres_per_second_is_tracked_with_a_forward_heading() {
    let path = PeriodicTrajectory::lemniscate_at(2.0, 1.0, 3.0)
        .and_then(|curve| curve.turns(2.0)?.ramp(2.0)?.heading(Heading::Forward))
        .unwrap();
    let fastest = (0..2000).map(|i| path.reference(f64::from(i) * 0.005).velocity.norm()).fold(0.0, f64::max);
    assert!((fastest - 3.0).abs() < 1e-3, "{fastest}");
    for model in DroneModel::PAPER {
        let flight = fly(at_start(model, &path), &mut GeometricControl::new(&model.params()), &path, path.duration());
        assert!(flight.peak < 0.01 && flight.yaw < 0.05, "{model}: {} {}", flight.peak, flight.yaw);
    }
}

#[test]
fn every_controller_settles_on_a_step_and_dsl_and_geometric_on_a_square() {
    let hover = Steps::step([0.0, 0.0, 0.1], [0.0, 0.0, 1.0], 10.0).unwrap();
    let square = Steps::square(1.0, 4.0).unwrap();
    for kind in ControllerKind::ALL {
        let model = DroneModel::Cf21;
        let flight = fly(at_start(model, &hover), &mut kind.build(&model.params()), &hover, 10.0);
        assert!(flight.last < 0.03, "{model} with {kind}: {}", flight.last);
    }
    for model in DroneModel::PAPER {
        for (kind, within) in
            [(ControllerKind::Pid, 0.02), (ControllerKind::Dsl, 0.005), (ControllerKind::Geometric, 1e-4)]
        {
            let flight = fly(at_start(model, &hover), &mut kind.build(&model.params()), &hover, 10.0);
            assert!(flight.last < within, "{model} with {kind}: {}", flight.last);
        }
        for (kind, within) in [(ControllerKind::Dsl, 0.02), (ControllerKind::Geometric, 1e-3)] {
            let flight = fly(at_start(model, &square), &mut kind.build(&model.params()), &square, 16.0);
            assert!(flight.last < within, "{model} with {kind}: {}", flight.last);
        }
    }
}

#[test]
fn the_same_gains_fly_control_rates_from_24_to_240_hertz_and_slow_motors() {
    let circle = PeriodicTrajectory::circle(0.3, 8.0).unwrap().plane(Plane::YZ);
    for (ctrl_freq, lag) in [(24, 0.0), (30, 0.0), (120, 0.0), (240, 0.0), (48, 0.03), (240, 0.03)] {
        for kind in [ControllerKind::Dsl, ControllerKind::Geometric] {
            let simulation = Simulation::builder(DroneModel::Cf2x)
                .ctrl_freq(ctrl_freq)
                .actuators(ActuatorParams { lag, ..ActuatorParams::default() })
                .initial_positions([circle.start().position.into()])
                .build()
                .unwrap();
            let flight = fly(simulation, &mut kind.build(&DroneModel::Cf2x.params()), &circle, 8.0);
            assert!(
                flight.mean < 0.006 && flight.peak < 0.04,
                "{kind} at {ctrl_freq} Hz, lag {lag} s: {}",
                flight.peak
            );
        }
    }
}

#[test]
fn an_integral_term_removes_the_static_error_of_a_wrong_mass() {
    let heavier = DroneParams { mass: 0.0297, ..DroneModel::Cf2x.params() };
    let path = Steps::step([0.0, 0.0, 1.0], [0.0, 0.0, 1.0], 12.0).unwrap();
    let end = |integral| {
        let simulation = Simulation::builder(heavier.clone()).initial_positions([[0.0, 0.0, 1.0]]).build().unwrap();
        let bandwidths = Bandwidths { integral, ..Bandwidths::default() };
        let mut control = GeometricControl::with_bandwidths(&DroneModel::Cf2x.params(), bandwidths);
        fly(simulation, &mut control, &path, 12.0).last
    };
    // static error: 10 % of g divided by the stiffness of 11² 1/s²
    assert!((end(0.0) - 0.1 * 9.81 / 121.0).abs() < 1e-3, "{}", end(0.0));
    assert!(end(0.1) < 1e-4, "{}", end(0.1));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]

    /// The geometric controller reaches its setpoint from any attitude, velocity and angular velocity.
    #[test]
    fn geometric_control_recovers_from_any_attitude(
        roll in -3.1..3.1, pitch in -1.5..1.5, yaw in -3.1..3.1, target in -3.1..3.1,
        velocity in prop::array::uniform3(-2.0..2.0), rate in prop::array::uniform3(-8.0..8.0),
        x in -4.0..4.0, y in -4.0..4.0, race in prop::bool::ANY,
    ) {
        let model = if race { DroneModel::Race } else { DroneModel::Cf2p };
        let mut simulation = Simulation::builder(model).build().unwrap();
        simulation.reset_to(&[DroneState {
            position: Vector3::new(x, y, 12.0),
            attitude: attitude_from_rpy(Vector3::new(roll, pitch, yaw)),
            velocity: velocity.into(),
            angular_velocity: rate.into(),
        }]).unwrap();
        let reference = Reference::hover(Vector3::new(0.0, 0.0, 12.0), target);
        let mut control = GeometricControl::new(&model.params());
        let dt = simulation.control_period();
        for _ in 0..48 * 8 {
            let rpm = control.control(dt, &simulation.states()[0], &reference).rpm;
            simulation.step(&[rpm]).unwrap();
            prop_assert!(simulation.contacts().is_empty(), "the drone hit the floor");
        }
        let state = simulation.states()[0];
        prop_assert!((state.position - reference.position).norm() < 0.01, "{}", state.position);
        prop_assert!(wrap_angle(state.rpy().z - target).abs() < 0.02, "{}", state.rpy().z);
    }

    /// A trajectory passes random waypoints on time, within the limits of speed and acceleration. The waypoints are
    /// high above the floor because the polynomials overshoot them.
    #[test]
    fn waypoint_trajectories_pass_their_points_within_limits_and_are_tracked(
        points in prop::collection::vec([-2.0..2.0, -2.0..2.0, 6.0..8.0], 2..7),
        yaws in prop::array::uniform7(-3.0..3.0),
    ) {
        let path = Waypoints::through(&points).yaws(&yaws[..points.len()]).limits(1.5, 3.0).build().unwrap();
        for (point, &time) in points.iter().zip(path.times()) {
            prop_assert!((path.reference(time).position - Vector3::from(*point)).norm() < 1e-6);
        }
        let samples = (0..=1000).map(|i| path.reference(path.duration() * f64::from(i) / 1000.0));
        for reference in samples {
            prop_assert!(reference.velocity.norm() < 1.51 && reference.acceleration.norm() < 3.02);
        }
        let mut control = GeometricControl::new(&DroneModel::Cf2x.params());
        let flight = fly(at_start(DroneModel::Cf2x, &path), &mut control, &path, path.duration());
        prop_assert!(flight.peak < 0.02, "{}", flight.peak);
    }
}

#[test]
fn trajectories_through_unequal_legs_overshoot_little() {
    let extent = |points: &[[f64; 3]], yaws: &[f64]| {
        let path = Waypoints::through(points).yaws(yaws).build().unwrap();
        let samples: Vec<_> = (0..=500).map(|i| path.reference(path.duration() * f64::from(i) / 500.0)).collect();
        let beyond = samples.iter().map(|r| {
            let low = points.iter().map(|p| Vector3::from(*p)).fold(Vector3::repeat(f64::MAX), |a, b| a.inf(&b));
            let high = points.iter().map(|p| Vector3::from(*p)).fold(Vector3::repeat(f64::MIN), |a, b| a.sup(&b));
            (r.position - r.position.sup(&low).inf(&high)).norm()
        });
        let turning = samples.iter().map(|r| r.yaw_rate.abs()).fold(0.0, f64::max);
        (beyond.fold(0.0, f64::max), path.duration(), turning)
    };
    for (points, max) in [
        (&[[0.0, 0.0, 0.1], [0.0, 0.0, 1.0], [5.0, 0.0, 1.0]][..], 20.0),
        (&[[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [20.0, 0.0, 1.0]], 60.0),
        (&[[0.0, 0.0, 1.0], [0.05, 0.0, 1.0], [20.0, 0.0, 1.0]], 60.0),
        (&[[0.0, 0.0, 1.0], [0.01, 0.0, 1.0], [10.0, 0.0, 1.0], [10.0, 5.0, 1.0]], 60.0),
    ] {
        let (beyond, duration, _) = extent(points, &vec![0.0; points.len()]);
        assert!(beyond < 1.0 && duration < max, "{points:?}: {beyond} m beyond, {duration} s");
    }
    let (_, duration, turning) = extent(&[[0.0, 0.0, 1.0], [0.01, 0.0, 1.0]], &[0.0, 3.0]);
    assert!(turning < 3.2 && duration > 1.0, "{turning} rad/s");
    assert!(
        Waypoints::through(&[[0.0; 3], [1.0; 3], [2.0; 3], [3.0; 3]]).times([0.0, 1e-3, 1e3, 2e3]).build().is_err()
    );
}

#[test]
fn a_helix_climbs_in_both_directions_and_its_heading_stops_at_the_end() {
    for period in [4.0, -4.0] {
        let path = PeriodicTrajectory::helix(0.5, period, 0.2)
            .and_then(|curve| curve.turns(5.0)?.heading(Heading::Turning { yaw: 0.1, rate: 0.3 }))
            .unwrap();
        let [start, end, after] = [-1.0, 20.0, 30.0].map(|time| path.reference(time));
        assert!((end.position.z - start.position.z - 1.0).abs() < 1e-9);
        assert_eq!((start.yaw, start.yaw_rate), (0.1, 0.0));
        assert_eq!((after.yaw, after.yaw_rate, after.position), (end.yaw, 0.0, end.position));
    }
    let upright = PeriodicTrajectory::circle(0.3, 8.0).unwrap().heading(Heading::Forward).unwrap().plane(Plane::YZ);
    assert!((0..100).all(|i| upright.reference(0.08 * f64::from(i)).is_finite()));
}

#[test]
fn invalid_numbers_and_control_periods_give_nan_motor_speeds() {
    let params = DroneModel::Cf2x.params();
    let state = DroneState::default();
    for kind in ControllerKind::ALL {
        for dt in [0.0, -0.02, f64::NAN, f64::INFINITY] {
            let mut control = kind.build(&params);
            let before = control.clone();
            assert!(control.control(dt, &state, &Reference::default()).rpm[0].is_nan(), "{kind} {dt}");
            assert!(control.control_velocity(dt, &state, &Reference::default()).rpm[0].is_nan(), "{kind} {dt}");
            assert_eq!(control, before);
        }
        let broken = DroneParams { thrust_to_weight: f64::NAN, ..params.clone() };
        assert!(kind.build(&broken).control(0.02, &state, &Reference::default()).rpm[0].is_nan(), "{kind}");
        let huge = DroneState { velocity: Vector3::repeat(1e308), ..state };
        let rpm = kind.build(&params).control(0.02, &huge, &Reference::default()).rpm;
        assert!(rpm.iter().all(|n| n.is_nan() || (0.0..=params.max_rpm()).contains(n)), "{kind}: {rpm:?}");
    }
    for bad in [f64::NAN, -1.0, 0.0, f64::INFINITY] {
        let bandwidths = Bandwidths { tilt: bad, ..Bandwidths::default() };
        let mut control = GeometricControl::with_bandwidths(&params, bandwidths);
        assert!(control.control(0.02, &state, &Reference::default()).rpm[0].is_nan(), "{bad}");
    }
}

/// Asserts that an agent, a function of the observation, completes Hover through an action type.
fn assert_hovers(action_type: ActionType, controller: ControllerKind, agent: impl Fn(&[f64]) -> Vec<f64>) {
    for model in DroneModel::PAPER {
        let mut env = Hover::builder()
            .drone(model)
            .action_type(action_type)
            .controller(controller)
            .initial_rpys([[0.0, 0.0, 0.6]])
            .initial_positions([[0.3, -0.2, 0.2]])
            .build()
            .unwrap();
        let mut policy = from_fn(|env, action| {
            action.copy_from_slice(&agent(&env.observation().vector));
            assert!(env.action_space().contains(action), "{action_type}: {action:?}");
        });
        let summary = fly_episode(&mut env, &mut policy, Some(3)).unwrap();
        assert!(summary.success, "{model} through {action_type} with {controller}: {summary:?}");
    }
}

/// Returns the desired acceleration of the agents below, heading frame, m/s².
fn desired_acceleration(o: &[f64]) -> [f64; 3] {
    let (sin, cos) = o[5].sin_cos();
    let (x, y) = (-2.0 * o[0] - 2.4 * o[6], -2.0 * o[1] - 2.4 * o[7]);
    [(cos * x + sin * y).clamp(-3.0, 3.0), (cos * y - sin * x).clamp(-3.0, 3.0), 4.0 * (1.0 - o[2]) - 4.0 * o[8]]
}

#[test]
fn every_action_type_flies_hover() {
    use ControllerKind::{Dsl, Geometric, Pid};
    for controller in [Pid, Dsl, Geometric] {
        assert_hovers(ActionType::Vel, controller, |o| {
            let (sin, cos) = o[5].sin_cos();
            let (x, y) = (-0.7 * o[0], -0.7 * o[1]);
            vec![cos * x + sin * y, cos * y - sin * x, 0.8 * (1.0 - o[2]), -o[5].clamp(-1.0, 1.0)]
        });
    }
    for controller in [Dsl, Geometric] {
        assert_hovers(ActionType::Pid, controller, |_| vec![0.0, 0.0, 1.0, 0.2]);
    }
    // with the paper's gains, a sideways offset decays more slowly than an episode lasts
    assert_hovers(ActionType::Pid, Pid, |o| vec![-0.3 * o[6] - 0.4 * o[0], -0.3 * o[7] - 0.4 * o[1], 1.01, 0.0]);
    assert_hovers(ActionType::Attitude, Pid, |o| {
        let [x, y, z] = desired_acceleration(o);
        let tilt = 30_f64.to_radians();
        vec![(z / 9.81).clamp(-1.0, 1.0), -y / 9.81 / tilt, x / 9.81 / tilt, -(o[5] / 3.0).clamp(-1.0, 1.0)]
    });
    assert_hovers(ActionType::Ctbr, Pid, |o| {
        let [x, y, z] = desired_acceleration(o);
        let (roll, pitch) = (-y / 9.81, x / 9.81);
        let rates = [8.0 * (roll - o[3]) / 10.0, 8.0 * (pitch - o[4]) / 10.0, -o[5] / 5.0];
        let mut action = vec![(z / 9.81).clamp(-1.0, 1.0)];
        action.extend(rates.map(|x| x.clamp(-1.0, 1.0)));
        action
    });
}

#[test]
fn raw_and_normalized_motor_speeds_give_the_same_flight() {
    let flight = |action_type| {
        let mut env = Hover::builder().action_type(action_type).build().unwrap();
        let mut pid = PidControl::new(&DroneModel::Cf2x.params());
        env.reset(Some(1)).unwrap();
        let mut action = [0.0; 4];
        for _ in 0..200 {
            let rpm = pid.control(1.0 / 48.0, &env.simulation().states()[0], &env.reference(0)).rpm;
            env.action_of_motor_speeds(&[rpm], &mut action).unwrap();
            assert!(env.action_space().contains(&action));
            env.step(&action).unwrap();
        }
        env.simulation().states()[0].position
    };
    assert!((flight(ActionType::Rpm) - flight(ActionType::RawRpm)).norm() < 1e-9);
}

#[test]
fn one_command_for_all_motors_holds_a_height() {
    let mut env = Hover::builder().action_type(ActionType::OneDRpm).build().unwrap();
    let mut policy = from_fn(|env, action| {
        let observation = &env.observation().vector;
        action[0] = (1.2 * (1.0 - observation[2]) - 0.7 * observation[8]).clamp(-1.0, 1.0);
    });
    assert!(fly_episode(&mut env, &mut policy, None).unwrap().success);
}

/// Velocity commands are in the heading frame, which has the yaw of the body, and no roll or pitch.
#[test]
fn velocity_commands_follow_the_heading_and_yaw_rates_are_reached() {
    for yaw in [0.0, 1.2, -2.5] {
        let mut env = Hover::builder()
            .action_type(ActionType::Vel)
            .controller(ControllerKind::Geometric)
            .initial_positions([[0.0, 0.0, 1.0]])
            .initial_rpys([[0.0, 0.0, yaw]])
            .build()
            .unwrap();
        env.reset(None).unwrap();
        step_env(&mut env, &[0.5, 0.0, 0.0, 0.0], 96);
        let state = env.simulation().states()[0];
        let expected = Vector3::new(yaw.cos(), yaw.sin(), 0.0) * 0.5;
        assert!((state.velocity - expected).norm() < 0.01, "{} at yaw {yaw}", state.velocity);
        env.reset(None).unwrap();
        step_env(&mut env, &[1.0, 0.0, 0.0, 1.0], 144);
        let state = env.simulation().states()[0];
        let ahead = Vector3::new(state.yaw().cos(), state.yaw().sin(), 0.0);
        assert!((state.velocity - ahead).norm() < 0.12, "velocity {} on a circle, expected {ahead}", state.velocity);
        env.reset(None).unwrap();
        step_env(&mut env, &[0.0, 0.0, 0.0, 1.0], 96);
        assert!((env.simulation().states()[0].angular_velocity.z - 1.0).abs() < 0.02);
    }
}

#[test]
fn attitude_commands_are_reached() {
    let limits = ActionLimits { tilt: 0.4, yaw_rate: 1.0, ..ActionLimits::default() };
    let mut env = Hover::builder()
        .action_type(ActionType::Attitude)
        .action_limits(limits)
        .initial_positions([[0.0, 0.0, 2.0]])
        .initial_rpys([[0.0, 0.0, 0.9]])
        .build()
        .unwrap();
    for (roll, pitch, turn) in [(0.5, 0.0, 0.0), (0.0, -0.5, 0.0), (-0.3, 0.7, 0.0), (1.0, 0.0, 1.0), (0.3, -1.0, -0.8)]
    {
        env.reset(None).unwrap();
        step_env(&mut env, &[0.1, roll, pitch, turn], 60);
        let rpy = env.simulation().states()[0].rpy();
        let error = rpy - Vector3::new(0.4 * roll, 0.4 * pitch, 0.9 + turn * 60.0 / 48.0);
        // with a yaw rate, the yaw lags by a fraction of a control step
        assert!(error.xy().norm() < 0.012 && wrap_angle(error.z).abs() < 0.01 + 0.03 * turn.abs(), "{rpy}");
    }
}

#[test]
fn non_finite_actions_are_errors_and_actions_out_of_bounds_are_clipped() {
    for action_type in ActionType::ALL {
        let build = || Hover::builder().drone(airframe_with_duty()).action_type(action_type).build().unwrap();
        let (mut env, mut twin) = (build(), build());
        env.reset(Some(1)).unwrap();
        twin.reset(Some(1)).unwrap();
        let size = env.action_space().size();
        let zeros = vec![0.0; size];
        for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            let mut action = zeros.clone();
            action[size - 1] = bad;
            assert!(matches!(env.step(&action), Err(EnvError::Action { index, .. }) if index == size - 1));
        }
        for length in [0, size - 1, size + 1] {
            assert!(matches!(env.step(&vec![0.0; length]), Err(EnvError::ActionLength { .. })));
        }
        // the invalid actions moved nothing; the decoder clips actions to their bounds
        let space = env.action_space().clone();
        for (far, bound) in [(1e3, space.high()), (-1e3, space.low()), (1e3, space.high())] {
            let far: Vec<_> = bound.iter().map(|x| x + far * (1.0 + x.abs())).collect();
            env.step(&far).unwrap();
            twin.step(bound).unwrap();
        }
        assert_eq!(env.simulation().states(), twin.simulation().states(), "{action_type}");
    }
}

#[test]
fn a_reset_clears_the_state_of_controllers() {
    for action_type in [ActionType::Vel, ActionType::Pid, ActionType::Attitude] {
        for controller in ControllerKind::ALL {
            let mut env = Hover::builder().action_type(action_type).controller(controller).build().unwrap();
            let mut flight = || {
                env.reset(Some(1)).unwrap();
                for i in 0..60 {
                    env.step(&[0.3, 0.2, 0.5, if i < 30 { 0.4 } else { -0.1 }]).unwrap();
                }
                env.simulation().states()[0]
            };
            assert_eq!(flight(), flight(), "{action_type} {controller}");
        }
    }
}

#[test]
fn named_trajectories_start_at_rest_and_their_derivatives_are_consistent() {
    for name in mujoco_drones_gym::control::trajectory::NAMES {
        let path = named(name).unwrap();
        assert!(path.reference(-1.0).velocity.norm() == 0.0 && path.duration() > 1.0);
        if name == "square" {
            continue;
        }
        let h = 1e-4;
        for i in 1..200 {
            let t = path.duration() * f64::from(i) / 201.0;
            let [before, now, after] = [t - h, t, t + h].map(|t| path.reference(t));
            let close =
                |a: Vector3<f64>, b: Vector3<f64>| assert!((a - b).norm() < 1e-3 * (1.0 + a.norm()), "{name} {t}");
            close((after.position - before.position) / (2.0 * h), now.velocity);
            close((after.velocity - before.velocity) / (2.0 * h), now.acceleration);
            close((after.acceleration - before.acceleration) / (2.0 * h), now.jerk);
            close((after.jerk - before.jerk) / (2.0 * h), now.snap);
        }
    }
    let forward = PeriodicTrajectory::helix(1.0, -3.0, 0.3)
        .and_then(|curve| {
            curve.plane(Plane::normal([0.3, -0.4, 1.0])?).turns(3.0)?.ramp(1.0)?.heading(Heading::Forward)
        })
        .unwrap();
    for i in 1..300 {
        let (t, h) = (f64::from(i) * 0.03, 1e-4);
        let [before, now, after] = [t - h, t, t + h].map(|t| forward.reference(t));
        assert!((wrap_angle(after.yaw - before.yaw) / (2.0 * h) - now.yaw_rate).abs() < 1e-3);
        assert!(((after.yaw_rate - before.yaw_rate) / (2.0 * h) - now.yaw_acceleration).abs() < 1e-3);
        if now.velocity.norm() > 0.1 {
            assert!(
                wrap_angle(now.velocity.y.atan2(now.velocity.x) - now.yaw).abs() < 1e-9,
                "the yaw follows the velocity"
            );
        }
    }
}
