//! Physics compared with closed forms, conservation laws and independent calculations.
//!
//! "The paper" is *MuJoCo-Drones-Gym* (Tayal).

mod common;

use common::step_simulation;
use mujoco_drones_gym::drone::GRAVITY;
use mujoco_drones_gym::engine::{Contact, Touched};
use mujoco_drones_gym::physics::actuators::ActuatorParams;
use mujoco_drones_gym::physics::drag;
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::state::attitude_from_rpy;
use mujoco_drones_gym::world::{Forcing, Integrator, Medium, Obstacle, Shape};
use nalgebra::Vector3;

/// Returns an initial state with velocity, angular velocity and a nonzero yaw.
fn tumbling() -> DroneState {
    DroneState {
        velocity: Vector3::new(0.5, -0.3, 0.8),
        angular_velocity: Vector3::new(3.0, -2.0, 1.5),
        ..DroneState::at_rest(Vector3::new(0.1, 0.2, 50.0), Vector3::new(0.3, -0.2, 1.1))
    }
}

/// Flies an aggressive manoeuvre of 0.5 s with constant motor speeds at a physics rate, and returns the final state.
fn manoeuvre(configure: impl Fn(f64) -> (Physics, Forcing, Integrator), sim_freq: u32) -> DroneState {
    let (physics, forcing, integrator) = configure(f64::from(sim_freq));
    let mut simulation = Simulation::builder(DroneModel::Cf2x)
        .physics(physics)
        .forcing(forcing)
        .integrator(integrator)
        .sim_freq(sim_freq)
        .ctrl_freq(20)
        .build()
        .unwrap();
    simulation.reset_to(&[tumbling()]).unwrap();
    let hover = DroneModel::Cf2x.params().hover_rpm();
    step_simulation(&mut simulation, &[[1.06 * hover, 1.05 * hover, 1.04 * hover, 1.05 * hover]], 10);
    simulation.states()[0]
}

/// Returns the observed orders of convergence to `exact`: log2 of the ratio of position errors at successive rates.
/// Each rate is twice the previous one.
fn orders(rates: &[u32], exact: Vector3<f64>, fly: impl Fn(u32) -> DroneState) -> Vec<f64> {
    let errors: Vec<_> = rates.iter().map(|&rate| (fly(rate).position - exact).norm()).collect();
    errors.windows(2).map(|pair| (pair[0] / pair[1]).log2()).collect()
}

/// Flies a pull-up with increasing angular velocity about one body axis at a nonzero yaw, and returns the final state.
fn pull_up(forcing: Forcing, sim_freq: u32) -> DroneState {
    let mut simulation =
        Simulation::builder(DroneModel::Cf2x).forcing(forcing).sim_freq(sim_freq).ctrl_freq(20).build().unwrap();
    let start = DroneState {
        angular_velocity: Vector3::new(0.0, 2.0, 0.0),
        ..DroneState::at_rest(Vector3::new(0.1, 0.2, 50.0), Vector3::new(0.2, 0.1, 1.1))
    };
    simulation.reset_to(&[start]).unwrap();
    let hover = DroneModel::Cf2x.params().hover_rpm();
    step_simulation(&mut simulation, &[[1.1 * hover, 1.11 * hover, 1.11 * hover, 1.1 * hover]], 10);
    assert!(simulation.states()[0].angular_velocity.y > 3.0);
    simulation.states()[0]
}

#[test]
#[allow(clippy::print_stdout)]
fn rotation_about_one_axis_is_first_order_with_frozen_and_fourth_order_with_body_fixed_forcing() {
    let exact = pull_up(Forcing::BodyFixed, 8000).position;
    let fourth = orders(&[20, 40, 80, 160], exact, |rate| pull_up(Forcing::BodyFixed, rate));
    let first = orders(&[120, 240, 480, 960], exact, |rate| pull_up(Forcing::Frozen, rate));
    println!("observed orders about one axis: body_fixed {fourth:.3?}, frozen {first:.3?}");
    assert!(fourth.iter().all(|order| (3.7..4.4).contains(order)), "{fourth:?}");
    assert!(first.iter().all(|order| (0.9..1.1).contains(order)), "{first:?}");
    let apart = (pull_up(Forcing::Frozen, 240).position - exact).norm();
    println!("position error of frozen forcing at 240 Hz after 0.5 s: {:.2} mm", 1000.0 * apart);
    assert!((1e-4..2e-2).contains(&apart));
}

/// MuJoCo's RK4 adds the angular velocities of its stages as vectors. The result is fourth order only while the axis of
/// rotation is fixed in the body; a tumbling body is second order under any forcing.
#[test]
#[allow(clippy::print_stdout)]
fn a_tumble_is_second_order_with_body_fixed_forcing() {
    let body_fixed = |rate| manoeuvre(|_| (Physics::Mjc, Forcing::BodyFixed, Integrator::Rk4), rate);
    let second = orders(&[40, 80, 160, 320], body_fixed(8000).position, body_fixed);
    println!("observed orders about a moving axis: body_fixed {second:.3?}");
    assert!(second.iter().all(|order| (1.9..2.3).contains(order)), "{second:?}");
}

#[test]
#[allow(clippy::print_stdout)]
fn the_explicit_engine_converges_to_mujoco_at_first_order() {
    let exact = manoeuvre(|_| (Physics::Mjc, Forcing::BodyFixed, Integrator::Rk4), 8000);
    let explicit = |rate| manoeuvre(|_| (Physics::Dyn, Forcing::Frozen, Integrator::Rk4), rate);
    let observed = orders(&[240, 480, 960, 1920], exact.position, explicit);
    println!("observed orders of dyn against mjc: {observed:.3?}");
    assert!(observed.iter().all(|order| (0.9..1.1).contains(order)), "{observed:?}");
    let fine = explicit(64_000);
    assert!((fine.position - exact.position).norm() < 1e-4);
    assert!(fine.attitude.angle_to(&exact.attitude) < 1e-3);
}

#[test]
fn constant_thrust_without_rotation_matches_its_closed_form_in_every_engine() {
    for model in DroneModel::PAPER {
        let params = model.params();
        for engine in EngineKind::ALL {
            for forcing in [Forcing::Frozen, Forcing::BodyFixed] {
                for (sim_freq, ctrl_freq) in [(240, 48), (77, 11)] {
                    let rpy = [0.2, -0.3, 2.0];
                    let mut simulation = Simulation::builder(model)
                        .engine(engine)
                        .forcing(forcing)
                        .sim_freq(sim_freq)
                        .ctrl_freq(ctrl_freq)
                        .initial_positions([[1.0, 2.0, 30.0]])
                        .initial_rpys([rpy])
                        .initial_velocities([[0.5, 0.25, 1.0]])
                        .build()
                        .unwrap();
                    let speed = 1.2 * params.hover_rpm();
                    let acceleration = attitude_from_rpy(rpy.into()) * Vector3::new(0.0, 0.0, 1.44 * GRAVITY)
                        - Vector3::new(0.0, 0.0, GRAVITY);
                    step_simulation(&mut simulation, &[[speed; 4]], ctrl_freq as usize);
                    let (t, dt) = (simulation.time(), 1.0 / f64::from(sim_freq));
                    // the position of semi-implicit Euler exceeds the closed form by exactly a·t·dt/2
                    let lead = if engine == EngineKind::Explicit { 0.5 * t * dt } else { 0.0 };
                    let expected = Vector3::new(1.0, 2.0, 30.0)
                        + Vector3::new(0.5, 0.25, 1.0) * t
                        + acceleration * (0.5 * t * t + lead);
                    let error = simulation.distance(0, &expected);
                    assert!(error < 1e-10, "{model} {engine} {forcing:?} at {sim_freq} Hz: {error:e}");
                }
            }
        }
    }
}

#[test]
#[allow(clippy::print_stdout)]
fn a_torque_free_tumble_conserves_angular_momentum_and_energy() {
    let mut params = DroneModel::Race.params();
    // with three different moments of inertia, rotation about the intermediate axis is unstable
    params.inertia = [4.0e-4, 6.0e-4, 8.8e-4];
    let mut simulation = Simulation::builder(params.clone()).sim_freq(1000).ctrl_freq(100).build().unwrap();
    let start = DroneState {
        angular_velocity: Vector3::new(0.2, 5.0, 0.1),
        velocity: Vector3::new(0.0, 0.0, 49.0),
        ..DroneState::at_rest(Vector3::new(0.0, 0.0, 100.0), Vector3::new(0.1, 0.7, -2.0))
    };
    simulation.reset_to(&[start]).unwrap();
    let momentum = |s: &DroneState| s.attitude * params.inertia_vector().component_mul(&s.angular_velocity);
    let rotation =
        |s: &DroneState| 0.5 * s.angular_velocity.dot(&params.inertia_vector().component_mul(&s.angular_velocity));
    let energy = |s: &DroneState| {
        rotation(s) + 0.5 * params.mass * s.velocity.norm_squared() + params.mass * GRAVITY * s.position.z
    };
    let (l0, e0) = (momentum(&start), energy(&start));
    let (mut turned_over, mut length, mut direction, mut drift) = (false, 0.0_f64, 0.0_f64, 0.0_f64);
    for _ in 0..1000 {
        simulation.step(&[[0.0; 4]]).unwrap();
        let state = simulation.states()[0];
        let l = momentum(&state);
        length = length.max((l.norm() / l0.norm() - 1.0).abs());
        direction = direction.max(l.angle(&l0));
        // rotational energy is checked separately because it is a small part of the total
        drift = drift.max((energy(&state) / e0 - 1.0).abs()).max((rotation(&state) / rotation(&start) - 1.0).abs());
        turned_over |= state.angular_velocity.y < -3.0;
    }
    println!(
        "drift over 10 s at 1 kHz: energy {drift:.1e}, angular momentum {length:.1e}, its direction {direction:.1e} rad"
    );
    assert!(turned_over, "the body tumbles about the intermediate axis");
    assert!(length < 1e-6 && drift < 1e-6 && direction < 1e-6);
}

#[test]
fn modes_differ_by_exactly_the_forces_of_their_effects() {
    let start = |x: f64, z: f64, yaw: f64| DroneState {
        velocity: Vector3::new(1.0, -2.0, 0.5),
        ..DroneState::at_rest(Vector3::new(x, 0.0, z), Vector3::new(0.1, 0.2, yaw))
    };
    let states = [start(0.0, 0.2, 1.0), start(0.05, 1.2, -2.0)];
    let hover = DroneModel::Cf2x.params().hover_rpm();
    let external = |effects: Effects| {
        let mut simulation =
            Simulation::builder(DroneModel::Cf2x).num_drones(2).effects(effects).ctrl_freq(240).build().unwrap();
        simulation.reset_to(&states).unwrap();
        simulation.step(&[[hover; 4]; 2]).unwrap();
        [0, 1].map(|drone| simulation.loads()[drone].external.force_world)
    };
    let only = |ground, drag, downwash| external(Effects { ground, drag, downwash });
    let (ground, drag, downwash) = (only(true, false, false), only(false, true, false), only(false, false, true));
    assert_eq!(only(false, false, false), [Vector3::zeros(); 2]);
    assert!(ground[0].z > ground[1].z && ground[1].z > 0.0 && ground[0].xy().norm() == 0.0);
    assert!(downwash[0].z < 0.0 && downwash[1].z == 0.0);
    assert!(drag[0].dot(&states[0].velocity) < 0.0);
    let by_hand = drag::force(&DroneModel::Cf2x.params(), &states[1], &[hover; 4], &Vector3::zeros());
    assert_eq!(drag[1], by_hand);
    for drone in 0..2 {
        let all = only(true, true, true)[drone];
        assert!((all - ground[drone] - drag[drone] - downwash[drone]).norm() < 1e-15);
    }
    for (mode, effects) in Physics::ALL.map(|mode| (mode, mode.effects())) {
        let simulation = Simulation::builder(DroneModel::Cf2x).physics(mode).build().unwrap();
        assert_eq!((simulation.physics(), simulation.effects()), (Some(mode), effects));
    }
}

#[test]
fn six_combinations_of_effects_and_engine_have_the_papers_names_and_contradictions_are_errors() {
    for bits in 0..8 {
        let effects = Effects { ground: bits & 1 > 0, drag: bits & 2 > 0, downwash: bits & 4 > 0 };
        assert_eq!(effects.to_string().parse(), Ok(effects));
        for engine in EngineKind::ALL {
            let builder = || Simulation::builder(DroneModel::Race).effects(effects).engine(engine);
            let simulation = builder().build().unwrap();
            assert_eq!((simulation.effects(), simulation.engine().name()), (effects, engine.name()));
            for mode in Physics::ALL {
                let explicit = engine == EngineKind::Explicit;
                let agrees = mode.effects() == effects && (mode == Physics::Dyn) == explicit;
                assert_eq!(simulation.physics() == Some(mode), agrees, "{mode} {effects} {engine}");
                match builder().physics(mode).build() {
                    Ok(same) => assert!(agrees && same.physics() == Some(mode), "{mode} {effects} {engine}"),
                    Err(error) => {
                        let named =
                            ["effects is", "engine is"].iter().any(|start| error.to_string().starts_with(start));
                        assert!(!agrees && named && error.to_string().contains(mode.name()), "{error}");
                    }
                }
            }
        }
    }
    assert!("drag,lift".parse::<Effects>().unwrap_err().to_string().contains("no aerodynamic effect `lift`"));
    let alone = "none,drag".parse::<Effects>().unwrap_err().to_string();
    assert!(alone.contains("no aerodynamic effect `none`, expected ground, drag or downwash"), "{alone}");
    assert!("".parse::<Effects>().is_err() && "ground,".parse::<Effects>().is_err());
}

/// The explicit engine integrates the forces of the effects: drag changes the velocity by the force of the drag law.
#[test]
fn the_explicit_engine_applies_the_forces_of_effects() {
    let fly = |effects| {
        let mut simulation = Simulation::builder(DroneModel::Cf2x)
            .engine(EngineKind::Explicit)
            .effects(effects)
            .initial_positions([[0.0, 0.0, 50.0]])
            .initial_rpys([[0.0, 0.0, 0.7]])
            .initial_velocities([[2.0, 1.0, 0.0]])
            .sim_freq(48)
            .build()
            .unwrap();
        let start = simulation.states()[0];
        let hover = simulation.params(0).hover_rpm();
        simulation.step(&[[hover; 4]]).unwrap();
        (start, simulation.states()[0].velocity)
    };
    let ((start, with), (_, without)) = (fly(Effects { drag: true, ..Effects::NONE }), fly(Effects::NONE));
    let params = DroneModel::Cf2x.params();
    let force = drag::force(&params, &start, &[params.hover_rpm(); 4], &Vector3::zeros());
    assert!(((with - without) - force / (48.0 * params.mass)).norm() < 1e-15 && force.norm() > 1e-3);
}

#[test]
fn a_medium_slows_a_fall_and_vacuum_does_not() {
    let fall = |medium: Option<Medium>| {
        let mut simulation = Simulation::builder(DroneModel::Cf2x).medium(medium).build().unwrap();
        simulation.reset_to(&[DroneState::at_rest(Vector3::new(0.0, 0.0, 90.0), Vector3::zeros())]).unwrap();
        step_simulation(&mut simulation, &[[0.0; 4]], 96);
        simulation.states()[0].velocity.z
    };
    assert!((fall(None) + 2.0 * GRAVITY).abs() < 1e-9);

    // MuJoCo's fluid forces on the equivalent inertia box, integrated independently for a fall without rotation
    let params = DroneModel::Cf2x.params();
    let [x, y, z] = params.inertia;
    let side = |a: f64, b: f64, c: f64| (6.0 * (b + c - a) / params.mass).sqrt();
    let sides = [side(x, y, z), side(y, x, z), side(z, x, y)];
    let Medium { density, viscosity } = Medium::AIR;
    let acceleration = |v: f64| {
        let form = 0.5 * density * sides[0] * sides[1] * v * v.abs();
        let skin = 3.0 * std::f64::consts::PI * viscosity * (sides.iter().sum::<f64>() / 3.0) * v;
        -GRAVITY - (form + skin) / params.mass
    };
    let mut v: f64 = 0.0;
    let dt = 1e-5;
    for _ in 0..200_000 {
        let half = v + 0.5 * dt * acceleration(v);
        v += dt * acceleration(half);
    }
    let slowed = fall(Some(Medium::AIR));
    assert!((slowed - v).abs() < 1e-6, "{slowed} {v}");
}

#[test]
fn a_dropped_drone_rests_on_its_collision_cylinder() {
    for model in DroneModel::ALL {
        let half = 0.5 * model.params().collision_height;
        let mut simulation =
            Simulation::builder(model).initial_positions([[0.0, 0.0, 0.4 + half]]).sim_freq(480).build().unwrap();
        step_simulation(&mut simulation, &[[0.0; 4]], 48 * 4);
        let state = simulation.states()[0];
        assert!((state.position.z - half).abs() < 2e-3, "{model} rests at {} m", state.position.z);
        assert!(state.velocity.norm() < 1e-2 && state.tilt() < 0.02, "{model}");
        assert_eq!(simulation.contacts(), [Contact { drone: 0, with: Touched::Floor }]);
    }
}

#[test]
fn a_drone_stops_at_a_wall_and_reports_the_contact() {
    let wall = |x: f64, yaw: f64| Obstacle {
        rpy: Vector3::new(0.0, 0.0, yaw),
        ..Obstacle::new(Shape::Box { half_size: [0.05, 2.0, 2.0] }, Vector3::new(x, 0.0, 1.0))
    };
    // obstacle 1 stands behind obstacle 0
    let mut simulation = Simulation::builder(DroneModel::Cf2x)
        .initial_positions([[0.0, 0.0, 1.0]])
        .initial_rpys([[0.0, 0.0, 0.4]])
        .initial_velocities([[2.0, 0.0, 0.0]])
        .obstacles([wall(1.0, 0.0), wall(1.5, 0.3)])
        .build()
        .unwrap();
    let hover = DroneModel::Cf2x.params().hover_rpm();
    let mut touched = Vec::new();
    for _ in 0..48 {
        simulation.step(&[[hover; 4]]).unwrap();
        touched.extend(simulation.contacts().iter().copied());
        let x = simulation.states()[0].position.x;
        // face of the wall minus collision radius; MuJoCo's soft contacts allow a penetration of 1.4 cm at 2 m/s
        assert!(x < 1.0 - 0.05 - 0.06 + 0.02, "the drone is inside the wall: x = {x} m");
    }
    let speed = simulation.states()[0].velocity.x;
    assert!(speed.abs() < 0.2, "the drone still moves at {speed} m/s of 2");
    assert!(touched.contains(&Contact { drone: 0, with: Touched::Obstacle(0) }), "{touched:?}");
    assert!(!touched.contains(&Contact { drone: 0, with: Touched::Obstacle(1) }));

    let mut env = Hover::builder()
        .initial_rpys([[0.0, 0.5, 0.0]])
        .initial_positions([[0.0, 0.0, 1.0]])
        .obstacles([wall(0.5, 0.0)])
        .build()
        .unwrap();
    env.reset(None).unwrap();
    while env.info().end.is_none() {
        env.step(&[0.1; 4]).unwrap();
    }
    assert_eq!(env.info().end.unwrap().name(), "obstacle_contact");
    let bad = Obstacle::new(Shape::Sphere { radius: -1.0 }, Vector3::zeros());
    let text = Simulation::builder(DroneModel::Cf2x).obstacles([bad]).build().unwrap_err().to_string();
    assert!(text.contains("size of obstacle 0 is -1"), "{text}");
}

#[test]
fn motor_lag_latency_and_gains_change_the_rotor_speeds_and_thrust() {
    let params = DroneModel::Cf2x.params();
    let hover = params.hover_rpm();
    let start = DroneState::at_rest(Vector3::new(0.0, 0.0, 20.0), Vector3::zeros());
    // after one time constant, the rotor speed has completed 63 % of a step from hover speed to 1.2 times hover speed
    let lag = 0.05;
    let mut simulation = Simulation::builder(DroneModel::Cf2x)
        .actuators(ActuatorParams { lag, ..ActuatorParams::default() })
        .sim_freq(1000)
        .ctrl_freq(20)
        .build()
        .unwrap();
    simulation.reset_to(&[start]).unwrap();
    simulation.step(&[[1.2 * hover; 4]]).unwrap();
    let share = (simulation.rotor_speeds(0)[0] - hover) / (0.2 * hover);
    assert!((share - (1.0 - (-1.0_f64).exp())).abs() < 1e-9, "{share}");
    assert_eq!(simulation.motor_speeds()[0], [1.2 * hover; 4]);

    // with a latency of 0.5 s, the drone hovers until the first command arrives
    let mut simulation = Simulation::builder(DroneModel::Cf2x)
        .actuators(ActuatorParams { latency: 0.5, ..ActuatorParams::default() })
        .build()
        .unwrap();
    simulation.reset_to(&[start]).unwrap();
    step_simulation(&mut simulation, &[[0.0; 4]], 24);
    assert!((simulation.states()[0].position.z - 20.0).abs() < 1e-9);
    simulation.step(&[[0.0; 4]]).unwrap();
    assert!(simulation.states()[0].velocity.z < -0.1);

    // a gain of 0.9 of one motor scales a quarter of the thrust by 0.9²
    let mut simulation = Simulation::builder(DroneModel::Cf2x)
        .actuators(ActuatorParams { gains: [1.0, 1.0, 0.9, 1.0], ..ActuatorParams::default() })
        .ctrl_freq(240)
        .build()
        .unwrap();
    simulation.reset_to(&[start]).unwrap();
    simulation.step(&[[hover; 4]]).unwrap();
    let missing = simulation.loads()[0].rotors.thrust / params.weight();
    assert!((missing - (0.75 + 0.25 * 0.81)).abs() < 1e-12);
    let text = Simulation::builder(DroneModel::Cf2x)
        .actuators(ActuatorParams { lag: f64::NAN, ..ActuatorParams::default() })
        .build()
        .unwrap_err()
        .to_string();
    assert!(text.contains("lag is NaN"), "{text}");
}

#[test]
fn the_explicit_engine_writes_its_state_to_mujoco_and_ignores_the_floor() {
    let mut simulation = Simulation::builder(DroneModel::Cf2p).physics(Physics::Dyn).build().unwrap();
    simulation.reset_to(&[tumbling()]).unwrap();
    step_simulation(&mut simulation, &[[14_000.0, 14_100.0, 14_200.0, 14_300.0]], 20);
    let state = simulation.states()[0];
    let data = simulation.mujoco().unwrap();
    assert_eq!(data.qpos()[..3], *state.position.as_slice());
    assert!((data.xpos()[3] - state.position.x).abs() < 1e-12, "derived quantities are updated");
    // the explicit engine has no contacts: the drone falls through the floor
    simulation.reset_to(&[DroneState::at_rest(Vector3::new(0.0, 0.0, 0.1), Vector3::zeros())]).unwrap();
    step_simulation(&mut simulation, &[[0.0; 4]], 48);
    assert!(simulation.states()[0].position.z < -1.0 && simulation.contacts().is_empty());
}

#[test]
fn adjacency_contains_the_drones_within_the_radius() {
    let simulation = Simulation::builder(DroneModel::Cf2x)
        .num_drones(3)
        .initial_positions([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [1.0, 1.0, 1.0]])
        .build()
        .unwrap();
    let mut matrix = [true; 9];
    simulation.adjacency(1.2, &mut matrix);
    assert_eq!(matrix, [false, true, false, true, false, true, false, true, false]);
    simulation.adjacency(2.0, &mut matrix);
    assert_eq!(matrix.iter().filter(|near| **near).count(), 6);
    simulation.adjacency(0.5, &mut matrix);
    assert!(matrix.iter().all(|near| !near));
}
