//! Effects of an airframe's own parameters: closed forms, conservation of angular momentum, an independent computation
//! of the loads, and equality of the engines.

mod common;

use std::f64::consts::{FRAC_PI_2, TAU};

use common::conditions::{strong, with_effects};
use mujoco_drones_gym::drone::{AirParams, DroneError, GRAVITY, MotorParams, YawConvention};
use mujoco_drones_gym::engine::flight::{Airframe, Flow, FreeBody, LANES, LaneParams, Lanes, Width, advance};
use mujoco_drones_gym::physics::actuators::ActuatorParams;
use mujoco_drones_gym::physics::airframe::AirframeEffects;
use mujoco_drones_gym::physics::rotor::RotorModel;
use mujoco_drones_gym::physics::wind::{WindConfig, WindModel};
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::simulation::SimulationBuilder;
use mujoco_drones_gym::state::attitude_from_rpy;
use mujoco_drones_gym::world::{Forcing, Medium};
use nalgebra::Vector3;
use proptest::prelude::*;

/// Position far above the floor.
const HIGH: [[f64; 3]; 1] = [[0.0, 0.0, 400.0]];

fn with_air(air: AirParams) -> DroneParams {
    DroneParams { air, ..DroneModel::Cf2x.params() }
}

fn with_motors(motors: MotorParams) -> DroneParams {
    DroneParams { motors, ..DroneModel::Cf2x.params() }
}

/// Returns a builder far above the floor, for control steps of one physics step.
fn airborne(params: DroneParams, engine: EngineKind, rate: u32) -> SimulationBuilder {
    Simulation::builder(params).engine(engine).sim_freq(rate).ctrl_freq(rate).initial_positions(HIGH)
}

/// Returns a random airframe with every effect. Numbers in ±1 scale each of them.
fn random_airframe(numbers: [f64; 16]) -> DroneParams {
    let [a, b, c, d, e, f, g, h, i, j, k, l, m, n, o, p] = numbers;
    let air = AirParams {
        linear_drag: [a, b, c].map(|x| 0.05 * x.abs()),
        translational_lift: 0.01 * d,
        velocity_moment: 3e-4 * e,
        rotational_damping: [f, g, h].map(|x| 3e-4 * x.abs()),
        trim_torque: [i, j, k].map(|x| 3e-5 * x),
    };
    let motors = MotorParams {
        rise_time: 0.1 * l.abs(),
        fall_time: 0.1 * m.abs(),
        latency: 0.02 * n.abs(),
        rotor_inertia: 1e-7 * o.abs(),
        ..MotorParams::default()
    };
    let yaw_convention = if p > 0.0 { YawConvention::Crazyflie } else { YawConvention::Reversed };
    let center_of_mass = [2e-3 * p, 2e-3 * o];
    DroneParams {
        air,
        motors,
        yaw_convention,
        center_of_mass,
        ..DroneModel::PAPER[(n.to_bits() % 3) as usize].params()
    }
}

fn numbers() -> impl Strategy<Value = [f64; 16]> {
    prop::array::uniform16(-1.0..1.0f64)
}

/// At a constant attitude, each component of the body-frame velocity approaches its own terminal speed g_b·m/d. The
/// drag is constant during a step, so that the distance to it shrinks by exactly 1 − d·dt/m per step.
#[test]
fn linear_drag_approaches_the_terminal_velocity_exponentially() {
    let drag = [0.02, 0.05, 0.1];
    let params = with_air(AirParams { linear_drag: drag, ..AirParams::default() });
    let (rpy, start) = (Vector3::new(0.4, -0.7, 2.1), Vector3::new(3.0, -2.0, 1.0));
    let attitude = attitude_from_rpy(rpy);
    for engine in EngineKind::ALL {
        for rate in [77, 240] {
            let builder = airborne(params.clone(), engine, rate);
            let builder = builder.initial_rpys([rpy.into()]).initial_velocities([start.into()]);
            let mut simulation = builder.build().unwrap();
            let (dt, mut largest) = (1.0 / f64::from(rate), 0.0_f64);
            for step in 1..=2 * rate as i32 {
                simulation.step(&[[0.0; 4]]).unwrap();
                let got = attitude.inverse() * simulation.states()[0].velocity;
                for axis in 0..3 {
                    let share = drag[axis] / params.mass;
                    let terminal = (attitude.inverse() * Vector3::new(0.0, 0.0, -GRAVITY))[axis] / share;
                    let begin = (attitude.inverse() * start)[axis];
                    let exact = terminal + (begin - terminal) * (1.0 - share * dt).powi(step);
                    assert!((got[axis] - exact).abs() < 1e-10, "{engine} {rate} {axis}: {} {exact}", got[axis]);
                    let limit = terminal + (begin - terminal) * (-share * dt * f64::from(step)).exp();
                    // the first-order error of (1 − x)ⁿ against exp(−n·x) is at most x/(2·e)
                    let bound = 0.2 * share * dt * (begin - terminal).abs();
                    largest = largest.max((got[axis] - limit).abs());
                    assert!((got[axis] - limit).abs() < bound, "{engine} {rate} {axis}");
                }
            }
            assert!(largest > 1e-3, "the test resolves the step");
        }
    }
}

/// About one principal axis, the body rate approaches τ/d, and the distance shrinks by exactly 1 − d·dt/J per step.
#[test]
fn rotational_damping_and_trim_approach_a_constant_rate_exponentially() {
    let (damping, trim) = ([1e-4, 2e-4, 3e-4], [2e-5, -3e-5, 4e-5]);
    for axis in 0..3 {
        let mut air = AirParams { rotational_damping: damping, ..AirParams::default() };
        air.trim_torque[axis] = trim[axis];
        let params = with_air(air);
        let mut rate = [0.0; 3];
        rate[axis] = 4.0;
        for engine in EngineKind::ALL {
            let builder = airborne(params.clone(), engine, 240).initial_rpys([[0.3, 0.5, -2.0]]);
            let mut simulation = builder.initial_angular_velocities([rate]).build().unwrap();
            let (share, terminal) = (damping[axis] / params.inertia[axis], trim[axis] / damping[axis]);
            for step in 1..=480 {
                simulation.step(&[[0.0; 4]]).unwrap();
                let got = simulation.states()[0].angular_velocity;
                let exact = terminal + (4.0 - terminal) * (1.0 - share / 240.0).powi(step);
                assert!((got[axis] - exact).abs() < 1e-10, "{engine} {axis} {step}: {} {exact}", got[axis]);
                assert!((got.norm() - got[axis].abs()).abs() < 1e-10, "{engine} {axis}: {got}");
                let limit = terminal + (4.0 - terminal) * (-share * f64::from(step) / 240.0).exp();
                assert!((got[axis] - limit).abs() < 0.2 * share / 240.0 * 4.2, "{engine} {axis} {step}");
            }
        }
    }
}

/// Returns the angular momentum of airframe and rotors, world frame.
fn momentum(simulation: &Simulation) -> Vector3<f64> {
    let (params, state, n) = (simulation.params(0), &simulation.states()[0], simulation.rotor_speeds(0));
    // the reaction torque of rotors 1 and 3 is positive, so that they turn clockwise
    let sign = if params.yaw_convention == YawConvention::Crazyflie { 1.0 } else { -1.0 };
    let spin = sign * params.motors.rotor_inertia * TAU / 60.0 * (n[0] - n[1] + n[2] - n[3]);
    let body = params.inertia_vector().component_mul(&state.angular_velocity) + Vector3::new(0.0, 0.0, spin);
    state.attitude * body
}

/// Tumbles for a second with rotors that speed up and slow down, without aerodynamic torques. Returns the largest
/// relative change of the angular momentum, and the largest change of that of the airframe alone.
fn tumble(yaw_convention: YawConvention, forcing: Forcing, rate: u32) -> [f64; 2] {
    let motors = MotorParams { rotor_inertia: 2e-7, rise_time: 0.05, fall_time: 0.1, ..MotorParams::default() };
    // pairs of equal rotors have no torque about roll and pitch, and this coefficient hardly any about yaw
    let params = DroneParams { torque_coefficient: 1e-18, yaw_convention, ..with_motors(motors) };
    let hover = params.hover_rpm();
    let builder = Simulation::builder(params.clone()).forcing(forcing).sim_freq(rate).ctrl_freq(10);
    let builder = builder.initial_positions(HIGH).initial_rpys([[0.4, -0.3, 2.0]]);
    let mut simulation = builder.initial_angular_velocities([[5.0, -4.0, 3.0]]).build().unwrap();
    let (start, mut largest) = (momentum(&simulation), [0.0_f64; 2]);
    for step in 0..10 {
        let (a, b) = if step % 4 < 2 { (1.4, 0.6) } else { (0.4, 1.2) };
        simulation.step(&[[a * hover, b * hover, a * hover, b * hover]]).unwrap();
        let state = simulation.states()[0];
        let alone = state.attitude * params.inertia_vector().component_mul(&state.angular_velocity);
        for (largest, now) in largest.iter_mut().zip([momentum(&simulation), alone]) {
            *largest = largest.max((now - start).norm() / start.norm());
        }
    }
    largest
}

#[test]
fn a_free_tumble_conserves_the_angular_momentum_of_airframe_and_rotors() {
    for convention in [YawConvention::Crazyflie, YawConvention::Reversed] {
        for forcing in [Forcing::Frozen, Forcing::BodyFixed] {
            let [coarse, fine] = [2000, 4000].map(|rate| tumble(convention, forcing, rate));
            // the torque is constant during a step, so that the error is first order
            let ratio = coarse[0] / fine[0];
            let text = format!("{convention:?} {forcing:?}: {coarse:?} {fine:?}");
            // the rotors exchange several times the momentum of the airframe with it
            assert!(fine[1] > 1.0 && fine[0] < 0.01 * fine[1] && (1.8..2.2).contains(&ratio), "{text}");
        }
    }
}

/// Without a tumble, the airframe gains exactly the momentum about yaw that the rotors lose.
#[test]
fn rotors_that_speed_up_turn_the_airframe_backwards() {
    let motors = MotorParams { rotor_inertia: 5e-8, rise_time: 0.04, fall_time: 0.07, ..MotorParams::default() };
    for engine in EngineKind::ALL {
        for convention in [YawConvention::Crazyflie, YawConvention::Reversed] {
            let params = DroneParams { torque_coefficient: 1e-18, yaw_convention: convention, ..with_motors(motors) };
            let hover = params.hover_rpm();
            let mut simulation = airborne(params.clone(), engine, 240).initial_rpys([[0.0, 0.0, 1.0]]).build().unwrap();
            let before = momentum(&simulation).z;
            for _ in 0..60 {
                simulation.step(&[[1.3 * hover, 0.7 * hover, 1.3 * hover, 0.7 * hover]]).unwrap();
                let after = momentum(&simulation).z;
                assert!((after - before).abs() < 1e-9, "{engine} {convention:?}: {after}");
            }
            // rotors 0 and 2 of a Crazyflie turn counterclockwise
            let rate = simulation.states()[0].angular_velocity.z;
            let sign = if convention == YawConvention::Crazyflie { -1.0 } else { 1.0 };
            assert!(sign * rate > 1.0, "{engine} {convention:?}: {rate}");
        }
    }
}

/// The gyroscopic torque alone: a pitching airframe with fast counterclockwise rotors rolls.
#[test]
fn the_gyroscopic_torque_has_its_closed_form() {
    let motors = MotorParams { rotor_inertia: 5e-8, ..MotorParams::default() };
    let params = DroneParams { torque_coefficient: 1e-18, ..with_motors(motors) };
    let hover = params.hover_rpm();
    let speeds = [1.2 * hover, 0.8 * hover, 1.2 * hover, 0.8 * hover];
    let mut simulation = airborne(params.clone(), EngineKind::Explicit, 240).build().unwrap();
    simulation.step(&[speeds]).unwrap();
    let spin = 5e-8 * TAU / 60.0 * 1.6 * hover * 0.5;
    for (rate, torque) in [([0.0, 2.0, 0.0], [-2.0 * spin, 0.0]), ([3.0, 0.0, 0.0], [0.0, 3.0 * spin])] {
        let state = DroneState { angular_velocity: rate.into(), ..simulation.initial_states()[0] };
        let mut data = simulation.snapshot();
        data.reset_to(&[state]).unwrap();
        simulation.restore(&data).unwrap();
        // from hover speed, at which the momenta of the rotors cancel
        simulation.step(&[speeds]).unwrap();
        let load = simulation.loads()[0].rotors.torque_body;
        assert!((load.x - torque[0]).abs() < 1e-15 && (load.y - torque[1]).abs() < 1e-15, "{load} {torque:?}");
        assert!((load.z + spin * 240.0).abs() < 1e-8, "{load}");
    }
}

/// Rising and falling speeds follow their own exponentials, after the latencies of environment and airframe. A lag of
/// the environment replaces both time constants.
#[test]
fn motors_rise_and_fall_with_their_own_time_constants() {
    let motors = MotorParams { rise_time: 0.03, fall_time: 0.09, latency: 2.6 / 240.0, ..MotorParams::default() };
    let params = with_motors(motors);
    let (hover, max) = (params.hover_rpm(), params.max_rpm());
    for (lag, taus) in [(0.0, [0.03, 0.09]), (0.05, [0.05, 0.05])] {
        for engine in EngineKind::ALL {
            let own = ActuatorParams { lag, latency: 1.8 / 240.0, ..ActuatorParams::default() };
            let mut simulation = airborne(params.clone(), engine, 240).actuators(own).build().unwrap();
            // 2.6 and 1.8 physics steps are 4.4, so that the command of the fifth step finds the motors after four
            for step in 1..=100 {
                simulation.step(&[[max, 0.0, hover, 0.9 * hover]]).unwrap();
                let [up, down, same, slower] = *simulation.rotor_speeds(0);
                let time = f64::from((step - 4).max(0)) / 240.0;
                let [rise, fall] = taus.map(|tau| (-time / tau).exp());
                assert!((up - (max + (hover - max) * rise)).abs() < 1e-8, "{engine} {step}: {up}");
                assert!((down - hover * fall).abs() < 1e-8, "{engine} {step}: {down}");
                assert!((slower - hover * (0.9 + 0.1 * fall)).abs() < 1e-8 && same == hover, "{engine} {step}");
            }
        }
    }
}

/// The thrust of equal rotors acts at the centre of the motors: c × T about the centre of mass.
#[test]
fn an_offset_of_the_centre_of_mass_shifts_the_lever_arms() {
    for model in DroneModel::PAPER {
        let offset = [4e-3, -3e-3];
        let params = DroneParams { center_of_mass: offset, ..model.params() };
        let speeds = [0.9, 1.0, 1.1, 1.05].map(|x| x * params.hover_rpm());
        let [centred, shifted] =
            [model.params(), params.clone()].map(|params| RotorModel::new(&params).wrench(&speeds));
        let change = shifted.torque_body - centred.torque_body;
        let wanted = Vector3::new(-offset[1], offset[0], 0.0) * centred.thrust;
        assert!((change - wanted).norm() < 1e-15 && shifted.thrust == centred.thrust, "{model}: {change} {wanted}");
        for engine in EngineKind::ALL {
            let mut simulation = airborne(params.clone(), engine, 240).initial_rpys([[0.1, 0.0, 2.0]]).build().unwrap();
            simulation.step(&[[params.hover_rpm(); 4]]).unwrap();
            let wanted = Vector3::new(-offset[1], offset[0], 0.0) * params.weight() / 240.0;
            let gained = simulation.states()[0].angular_velocity.component_mul(&params.inertia_vector());
            assert!((gained - wanted).norm() < 1e-6 * wanted.norm(), "{model} {engine}: {gained} {wanted}");
        }
    }
}

/// A drone that moves with the air feels nothing of it. Otherwise lift and torque have their closed forms in the body
/// frame.
#[test]
fn lift_and_the_torque_of_a_velocity_depend_on_the_relative_velocity_in_the_body_frame() {
    let (lift, moment) = (0.004, 2e-4);
    let air = AirParams {
        translational_lift: lift,
        velocity_moment: moment,
        linear_drag: [0.01, 0.02, 0.03],
        ..AirParams::default()
    };
    let params = with_air(air);
    let wind = Vector3::new(2.0, -1.0, 0.5);
    for engine in EngineKind::ALL {
        for relative in [Vector3::zeros(), Vector3::new(1.5, -2.5, 4.0)] {
            let yaw = FRAC_PI_2;
            // at a yaw of 90°, body x is world y and body y is −world x
            let velocity = wind + Vector3::new(-relative.y, relative.x, relative.z);
            // no drag area: the force of the wind is that of the airframe's own parameters
            let config =
                WindConfig { velocity: wind.into(), drag_area: Some(0.0), ..WindConfig::new(WindModel::Constant) };
            let builder = airborne(params.clone(), engine, 240).wind(config).initial_rpys([[0.0, 0.0, yaw]]);
            let mut simulation = builder.initial_velocities([velocity.into()]).build().unwrap();
            simulation.step(&[[params.hover_rpm(); 4]]).unwrap();
            let gain = lift * (relative.x.powi(2) + relative.y.powi(2));
            let load = simulation.loads()[0];
            assert!((load.rotors.thrust - params.weight() - gain).abs() < 1e-12, "{engine}");
            let torque = moment * Vector3::new(relative.y, -relative.x, 0.0);
            assert!((load.rotors.torque_body - torque).norm() < 1e-12, "{engine}: {:?}", load.rotors);
            let drag = -Vector3::new(0.02 * -relative.y, 0.01 * relative.x, 0.03 * relative.z);
            assert!((load.external.force_world - drag).norm() < 1e-12, "{engine}: {:?}", load.external);
            let state = simulation.states()[0];
            assert!((state.velocity.z - velocity.z - (gain + drag.z) / params.mass / 240.0).abs() < 1e-12);
        }
    }
}

/// Returns the load of a physics step, computed with matrices from the formulas in the documentation: thrust along body
/// z, torque in the body frame, and other forces in the world frame.
fn load_by_hand(
    params: &DroneParams,
    state: &DroneState,
    air: &Vector3<f64>,
    [before, now]: [&[f64; 4]; 2],
    dt: f64,
) -> (f64, Vector3<f64>, Vector3<f64>) {
    let rotation = state.attitude.to_rotation_matrix();
    let velocity = rotation.transpose() * (state.velocity - air);
    let (a, rate) = (&params.air, state.angular_velocity);
    let yaw = if params.yaw_convention == YawConvention::Crazyflie { 1.0 } else { -1.0 };
    let mut torque = Vector3::from(a.trim_torque);
    let (mut thrust, mut spin) = (0.0, [0.0; 2]);
    for motor in 0..4 {
        let force = params.thrust_coefficient * now[motor].powi(2);
        let [x, y] = params.motor_positions()[motor];
        let arm = Vector3::new(x - params.center_of_mass[0], y - params.center_of_mass[1], 0.0);
        torque += arm.cross(&Vector3::new(0.0, 0.0, force));
        // the reaction to the drag of the propeller points against its rotation
        let direction = yaw * [1.0, -1.0, 1.0, -1.0][motor];
        torque.z -= direction * params.torque_coefficient * now[motor].powi(2);
        thrust += force;
        for (spin, speeds) in spin.iter_mut().zip([before, now]) {
            *spin += direction * params.motors.rotor_inertia * speeds[motor] * TAU / 60.0;
        }
    }
    thrust += a.translational_lift * velocity.xy().norm_squared();
    torque += a.velocity_moment * Vector3::new(velocity.y, -velocity.x, 0.0);
    torque -= Vector3::from(a.rotational_damping).component_mul(&rate);
    torque -= rate.cross(&Vector3::new(0.0, 0.0, spin[1]));
    torque.z -= (spin[1] - spin[0]) / dt;
    let drag = -(rotation * Vector3::from(a.linear_drag).component_mul(&velocity));
    (thrust, torque, drag)
}

/// Command of a motor in a control step: an aperiodic tumble.
fn command(params: &DroneParams, drone: usize, step: u32) -> [f64; 4] {
    std::array::from_fn(|motor| {
        let phase = f64::from(step) * (0.31 + 0.07 * motor as f64) + 2.0 * drone as f64;
        params.hover_rpm() * (0.7 + 0.3 * phase.sin())
    })
}

fn start(drone: usize, numbers: &[f64; 16]) -> DroneState {
    let [a, b, c, d, e, f, ..] = *numbers;
    let x = drone as f64;
    DroneState {
        velocity: Vector3::new(4.0 * a, 4.0 * b, 4.0 * c),
        angular_velocity: Vector3::new(6.0 * d, 6.0 * e, 6.0 * f),
        ..DroneState::at_rest(Vector3::new(1.0 - 2.0 * x, x, 30.0), Vector3::new(2.0 * b, f, 3.0 * d))
    }
}

/// Differences of positions, attitudes, velocities and body rates.
fn apart(a: &Simulation, b: &Simulation) -> f64 {
    let pairs = a.states().iter().zip(b.states());
    pairs.fold(0.0, |largest, (a, b)| {
        let position = (a.position - b.position).amax().max((a.velocity - b.velocity).amax());
        let attitude = (a.attitude.coords - b.attitude.coords).amax();
        largest.max(position).max(attitude).max(0.1 * (a.angular_velocity - b.angular_velocity).amax())
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    /// Every load and every step of random airframes in wind follows the formulas, in every engine.
    #[test]
    fn loads_match_an_independent_computation(numbers in numbers(), kind in 0usize..3) {
        let (engine, rate) = (EngineKind::ALL[kind], [240, 77][kind % 2]);
        let params = random_airframe(numbers);
        let wind = WindConfig { velocity: [3.0, -2.0, 1.0], ..WindConfig::new(WindModel::Constant) };
        let builder = airborne(params.clone(), engine, rate).wind(wind);
        let mut simulation = builder.build().unwrap();
        let mut data = simulation.snapshot();
        data.reset_to(&[start(0, &numbers)]).unwrap();
        simulation.restore(&data).unwrap();
        let (dt, air) = (1.0 / f64::from(rate), Vector3::new(3.0, -2.0, 1.0));
        for step in 0..40 {
            let (state, before) = (simulation.states()[0], *simulation.rotor_speeds(0));
            simulation.step(&[command(&params, 0, step)]).unwrap();
            let load = simulation.loads()[0];
            let (thrust, torque, drag) = load_by_hand(&params, &state, &air, [&before, simulation.rotor_speeds(0)], dt);
            let relative = air - state.velocity;
            let pushed = drag + 0.5 * 1.225 * params.drag_area() * relative.norm() * relative;
            prop_assert!((load.rotors.thrust - thrust).abs() < 1e-13 * (1.0 + thrust.abs()));
            prop_assert!((load.rotors.torque_body - torque).norm() < 1e-13, "{} {torque}", load.rotors.torque_body);
            prop_assert!((load.external.force_world - pushed).norm() < 1e-13, "{} {pushed}", load.external.force_world);
            prop_assert_eq!(load.external.torque_world, Vector3::zeros());
        }
    }

    /// The flight kernel and `mj_step` agree for random airframes: several of them, tumbling, in wind, at odd rates.
    #[test]
    fn the_kernel_matches_mj_step_for_random_airframes(
        airframes in prop::collection::vec(numbers(), 1..4), body_fixed in any::<bool>(), medium in any::<bool>(),
        windy in any::<bool>(), rates in prop::sample::select(vec![(240, 48), (240, 240), (77, 11), (500, 100)]),
    ) {
        let params: Vec<_> = airframes.iter().map(|numbers| random_airframe(*numbers)).collect();
        let states: Vec<_> = airframes.iter().enumerate().map(|(drone, numbers)| start(drone, numbers)).collect();
        let mut simulations = EngineKind::WITH_CONTACTS.map(|engine| {
            let builder = Simulation::builder(params[0].clone()).drones(params.clone()).engine(engine);
            let builder = builder.sim_freq(rates.0).ctrl_freq(rates.1).medium(medium.then_some(Medium::AIR));
            let forcing = if body_fixed { Forcing::BodyFixed } else { Forcing::Frozen };
            let builder = builder.forcing(forcing).effects(Effects { downwash: false, ..Effects::ALL });
            let positions = states.iter().map(|state| state.position.into());
            let wind = windy.then(|| strong(WindModel::Combined));
            let mut simulation = builder.initial_positions(positions).wind(wind).build().unwrap();
            let mut data = simulation.snapshot();
            data.reset_to(&states).unwrap();
            simulation.restore(&data).unwrap();
            simulation
        });
        for step in 0..rates.1 {
            let commands: Vec<_> = params.iter().enumerate().map(|(drone, p)| command(p, drone, step)).collect();
            let results = simulations.each_mut().map(|simulation| simulation.step(&commands));
            // a drone that turns beyond the range of the simulator has left the comparison
            prop_assert_eq!(results[0].is_err(), results[1].is_err(), "{:?}", results);
            if results[0].is_err() {
                break;
            }
            let [mujoco, hybrid] = &simulations;
            let error = apart(mujoco, hybrid);
            prop_assert!(error < 1e-11, "{error:e} after {} s", mujoco.time());
        }
        // the kernel passes drones that turn fast for a physics rate to MuJoCo
        let (substeps, share) = (simulations[1].engine_substeps(), if rates.0 < 240 { 0 } else { 10 });
        prop_assert!(substeps.flight > share * substeps.mujoco, "{substeps:?}");
    }

    /// A clone of the data and data that was serialized go on bit-identically.
    #[test]
    fn a_snapshot_of_a_random_airframe_continues_bit_identically(numbers in numbers()) {
        let params = random_airframe(numbers);
        let builder = Simulation::builder(params.clone()).engine(EngineKind::Hybrid).initial_positions(HIGH);
        let mut simulation = builder.build().unwrap();
        (0..7).for_each(|step| simulation.step(&[command(&params, 0, step)]).unwrap());
        let text = serde_json::to_string(&simulation.snapshot()).unwrap();
        let stored = serde_json::from_str(&text).unwrap();
        let mut fly = |data: Option<&mujoco_drones_gym::simulation::SimData>| {
            data.into_iter().for_each(|data| simulation.restore(data).unwrap());
            (7..20).for_each(|step| simulation.step(&[command(&params, 0, step)]).unwrap());
            (simulation.states()[0], *simulation.rotor_speeds(0))
        };
        let first = fly(None);
        prop_assert_eq!(first, fly(Some(&stored)));
    }
}

/// Every controller hovers with every effect. Constant torques, which only controllers with an integral of the attitude
/// balance, move the others.
#[test]
fn controllers_hover_with_every_effect() {
    let motors =
        MotorParams { rise_time: 0.02, fall_time: 0.03, latency: 0.004, rotor_inertia: 4e-8, ..MotorParams::default() };
    let air = AirParams {
        linear_drag: [0.012, 0.012, 0.02],
        translational_lift: 0.002,
        velocity_moment: 1e-5,
        rotational_damping: [3e-5, 3e-5, 5e-5],
        trim_torque: [1e-6, -2e-6, 1e-6],
    };
    let params = DroneParams { center_of_mass: [1e-4, -1e-4], motors, ..with_air(air) };
    for controller in ControllerKind::ALL {
        let mut env = Hover::builder().drone(params.clone()).build().unwrap();
        let mut pilot = ControllerPolicy::new(controller, &env);
        let summary = fly_episode(&mut env, &mut pilot, Some(1)).unwrap();
        let (state, target) = (env.simulation().states()[0], env.reference(0).position);
        let error = (state.position - target).norm();
        assert!(summary.steps == 480 && error < 0.6 && state.velocity.norm() < 0.1, "{controller}: {error} {state:?}");
    }
}

/// A lane without effects is bit-identical to a flight without them, also next to lanes with effects, whose kernel
/// computes them for all.
#[test]
fn a_lane_without_effects_flies_as_if_there_were_none() {
    let plain = DroneModel::Cf2x.params();
    let measured = with_effects(plain.clone(), [0.05, 0.03, 0.0], 1.0);
    let airframe = |params: &DroneParams, fall_share| {
        let body = FreeBody::new(params.mass, &params.inertia_vector(), 9.81, None);
        let (rotors, effects) = (RotorModel::new(params), AirframeEffects::new(params));
        Airframe { body, rotors, effects, share: 0.3, fall_share, ..Airframe::default() }
    };
    let (without, with) = (airframe(&plain, 0.3), airframe(&measured, 0.1));
    for (count, width) in Width::available().flat_map(|width| [1, 5, LANES].map(|count| (count, width))) {
        let fly = |effects: bool| {
            let mut frames = LaneParams::all(&without);
            (0..LANES).filter(|lane| effects && lane % 2 == 1).for_each(|lane| frames.set(lane, &with));
            let mut lanes = Lanes::default();
            for lane in 0..LANES {
                let numbers = [0.1 * lane as f64; 16];
                lanes.set(lane, &start(lane, &numbers), &[14_000.0; 4], &command(&plain, lane, 2));
            }
            let (dt, body_fixed, medium) = (1.0 / 240.0, false, false);
            let flow = Flow { dt, body_fixed, medium, lag: true, air: false, airframe_effects: effects, width };
            advance(&flow, &mut lanes, &frames, count, 24);
            lanes
        };
        let [lanes, reference] = [true, false].map(fly);
        for lane in 0..count {
            let same = lanes.state(lane) == reference.state(lane) && lanes.push(lane) == reference.push(lane);
            assert_eq!(same && lanes.rpm(lane) == reference.rpm(lane), lane % 2 == 0, "{width:?} {lane} of {count}");
        }
    }
}

/// A file without effects has no key of theirs, and zeros mean the same.
#[test]
fn absent_effects_have_no_keys() {
    for model in DroneModel::PAPER {
        let params = model.params();
        let text = toml::to_string(&params).unwrap();
        for key in ["center_of_mass", "motors", "air"] {
            assert!(!text.lines().any(|line| line.trim_start_matches('[').starts_with(key)), "{key}: {text}");
        }
        let explicit =
            text + "center_of_mass = [0, 0]\n[motors]\nrise_time = 0\nlatency = 0\n[air]\ntrim_torque = [0, 0, 0]\n";
        assert_eq!(DroneParams::from_toml(&explicit).unwrap(), params);
    }
    let full = with_effects(DroneModel::Cf2x.params(), [0.1, 0.2, 0.3], 1.0);
    assert_eq!(DroneParams::from_toml(&toml::to_string(&full).unwrap()).unwrap(), full);
}

/// An invalid number is an error of one line that names the field, and a wrong key one that names the line.
#[test]
fn errors_of_the_tables_name_the_field() {
    let refused = |params: DroneParams, start: &str| {
        let error = params.validate().unwrap_err();
        let text = error.to_string();
        assert!(matches!(error, DroneError::Parameter { .. }) && text.starts_with(start), "{text}");
        assert!(text.contains("expected") && !text.contains('\n'), "{text}");
    };
    let air = |change: fn(&mut AirParams)| {
        let mut air = AirParams::default();
        change(&mut air);
        with_air(air)
    };
    let motors = |change: fn(&mut MotorParams)| {
        let mut motors = MotorParams::default();
        change(&mut motors);
        with_motors(motors)
    };
    refused(air(|air| air.linear_drag[1] = -0.1), "air.linear_drag[1] is -0.1, expected 0 to");
    refused(air(|air| air.rotational_damping[2] = f64::NAN), "air.rotational_damping[2] is NaN");
    refused(air(|air| air.trim_torque[0] = f64::INFINITY), "air.trim_torque[0] is inf");
    refused(air(|air| air.translational_lift = 1e9), "air.translational_lift is 1000000000");
    refused(motors(|motors| motors.rise_time = -1.0), "motors.rise_time is -1, expected 0 to 1000 s");
    refused(motors(|motors| motors.latency = 1.5), "motors.latency is 1.5, expected 0 to 1 s");
    refused(motors(|motors| motors.rotor_inertia = -1e-9), "motors.rotor_inertia is -1e-9");
    for (offset, start) in [
        ([0.04, 0.0], "center_of_mass[0] is 0.04, expected a position where all motors carry weight"),
        ([0.0, f64::NAN], "center_of_mass[1] is NaN"),
        ([-0.01, -0.03], "center_of_mass[1] is -0.03"),
    ] {
        refused(DroneParams { center_of_mass: offset, ..DroneModel::Cf2x.params() }, start);
    }
    refused(DroneParams { center_of_mass: [0.02, 0.02], ..DroneModel::Cf2p.params() }, "center_of_mass[0]");
    let text = toml::to_string(&DroneModel::Cf2x.params()).unwrap();
    let error = DroneParams::from_toml(&format!("{text}[air]\nlinear_drg = [0, 0, 0]\n")).unwrap_err().to_string();
    assert!(error.contains("linear_drg") && error.contains("linear_drag") && error.contains("line"), "{error}");
    let error = DroneParams::from_toml(&format!("{text}[air]\ntrim_torque = [0, 0]\n")).unwrap_err().to_string();
    assert!(error.contains("2 numbers, expected 3"), "{error}");
}
