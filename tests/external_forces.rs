//! External forces on drones and gains of motors that change in flight. The engines agree under them, snapshots keep
//! them, and a reset ends them.

mod common;

use common::step_simulation;
use mujoco_drones_gym::engine::Touched;
use mujoco_drones_gym::physics::actuators::ActuatorParams;
use mujoco_drones_gym::physics::wind::{WindConfig, WindModel};
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::record::Scenario;
use mujoco_drones_gym::simulation::{SimData, SimulationBuilder};
use mujoco_drones_gym::world::{Forcing, Medium, Obstacle, Shape};
use mujoco_drones_gym::{Rng, RngExt as _, SeedableRng as _};
use nalgebra::Vector3;

const FORCE: Vector3<f64> = Vector3::new(0.02, -0.03, 0.01);

/// Returns the largest difference of a number of the states.
fn apart(a: &DroneState, b: &DroneState) -> f64 {
    (a.position - b.position)
        .amax()
        .max((a.attitude.coords - b.attitude.coords).amax())
        .max((a.velocity - b.velocity).amax())
        .max((a.angular_velocity - b.angular_velocity).amax())
}

fn random_force(rng: &mut Rng, scale: f64) -> Vector3<f64> {
    Vector3::from([(); 3].map(|()| scale * rng.random_range(-1.0..1.0)))
}

/// Returns motor speeds of an aperiodic tumble.
fn tumbling(params: &DroneParams, step: u32) -> [f64; 4] {
    let wave = |motor: usize| (f64::from(step) * (0.11 + 0.03 * motor as f64)).sin();
    std::array::from_fn(|motor| params.hover_rpm() * (0.25 + 0.1 * wave(motor)))
}

#[test]
fn a_constant_force_without_gravity_moves_a_drone_by_half_of_f_over_m_t_squared() {
    for engine in EngineKind::WITH_CONTACTS {
        let builder = Simulation::builder(DroneModel::Cf2x).engine(engine).initial_rpys([[0.2, -0.4, 2.0]]);
        let mut simulation = builder.initial_positions([[0.0, 0.0, 5.0]]).build().unwrap();
        simulation.set_gravity(0.0).unwrap();
        simulation.set_external_force(0, FORCE).unwrap();
        assert_eq!(simulation.external_force(0), FORCE);
        step_simulation(&mut simulation, &[[0.0; 4]], 96);
        let (state, time) = (simulation.states()[0], simulation.time());
        let path = FORCE * (0.5 * time * time / simulation.params(0).mass);
        let error = (state.position - Vector3::new(0.0, 0.0, 5.0) - path).norm() / path.norm();
        assert!(error < 1e-12, "{engine}: {error:e}");
        assert_eq!(simulation.loads()[0].external.force_world, FORCE);
        assert!(state.angular_velocity.norm() < 1e-12, "the force acts at the centre of mass");
        // the force stays until it is set again
        simulation.set_external_force(0, Vector3::zeros()).unwrap();
        step_simulation(&mut simulation, &[[0.0; 4]], 48);
        assert!((simulation.states()[0].velocity - state.velocity).norm() < 1e-12, "{engine}");
    }
}

#[test]
fn the_explicit_engine_adds_the_force_to_its_euler_step() {
    let builder = Simulation::builder(DroneModel::Cf2x).physics(Physics::Dyn).initial_positions([[0.0, 0.0, 5.0]]);
    let mut simulation = builder.build().unwrap();
    simulation.set_gravity(0.0).unwrap();
    simulation.set_external_force(0, FORCE).unwrap();
    step_simulation(&mut simulation, &[[0.0; 4]], 48);
    // v_n = n·a·dt and p_n = Σ v_i·dt = n·(n + 1)/2·a·dt²
    let (n, dt) = (240.0, 1.0 / 240.0);
    let path = FORCE * (0.5 * n * (n + 1.0) * dt * dt / simulation.params(0).mass);
    let error = simulation.states()[0].position - Vector3::new(0.0, 0.0, 5.0) - path;
    assert!(error.norm() < 1e-12 * path.norm(), "{error:e}");
}

#[test]
fn the_flight_kernel_matches_mj_step_under_a_force_in_a_tumble() {
    for (drone, forcing, medium) in [
        (DroneModel::Cf2x, Forcing::Frozen, None),
        (DroneModel::Cf2p, Forcing::BodyFixed, None),
        (DroneModel::Race, Forcing::Frozen, Some(Medium::AIR)),
    ] {
        let mut simulations = EngineKind::WITH_CONTACTS.map(|engine| {
            let builder = Simulation::builder(drone).engine(engine).forcing(forcing).medium(medium);
            let builder = builder.initial_positions([[1.0, 2.0, 60.0]]).initial_rpys([[0.3, -0.2, 2.2]]);
            let mut simulation =
                builder.initial_angular_velocities([[3.0, -2.0, 1.0]]).initial_velocities([[0.4, -0.3, 0.2]]).build();
            simulation.as_mut().unwrap().set_gravity(0.0).unwrap();
            simulation.unwrap()
        });
        let params = drone.params();
        let mut rng = Rng::seed_from_u64(1);
        for step in 0..240 {
            if step % 24 == 0 {
                let force = random_force(&mut rng, 0.5 * params.weight());
                simulations.iter_mut().for_each(|simulation| simulation.set_external_force(0, force).unwrap());
            }
            simulations.iter_mut().for_each(|simulation| simulation.step(&[tumbling(&params, step)]).unwrap());
        }
        let [a, b] = &simulations;
        let error = apart(&a.states()[0], &b.states()[0]);
        assert!(error < 1e-11, "{drone:?}: {error:e}");
        assert!(a.states()[0].angular_velocity.norm() > 2.0, "the drone tumbles");
        assert_eq!(b.engine_substeps().mujoco, 0, "the kernel flies");
    }
}

/// A drone is pressed onto the floor, dragged along it and lifted: the kernel of the floor matches MuJoCo. Both engines
/// continue from the states of MuJoCo every few steps, because sliding amplifies rounding errors.
#[test]
fn a_pushed_drone_on_the_floor_moves_identically_with_both_engines() {
    for drone in DroneModel::PAPER {
        let weight = drone.params().weight();
        let mut simulations = EngineKind::WITH_CONTACTS.map(|engine| {
            let builder = Simulation::builder(drone).engine(engine).initial_rpys([[0.0, 0.0, 1.0]]);
            builder.initial_positions([[0.0, 0.0, 0.03]]).build().unwrap()
        });
        let pushes = [
            Vector3::zeros(),
            Vector3::new(0.2, 0.1, -3.0) * weight,
            Vector3::new(1.5, -0.4, 0.2) * weight,
            Vector3::new(-2.0, 0.0, -0.5) * weight,
            Vector3::new(0.0, 0.0, 1.5) * weight,
        ];
        let (mut worst, mut touching) = (0.0_f64, 0);
        for push in pushes {
            for step in 0..16 {
                if step % 4 == 0 {
                    let state = simulations[0].states()[0];
                    for simulation in &mut simulations {
                        simulation.reset_to(&[state]).unwrap();
                        simulation.set_external_force(0, push).unwrap();
                    }
                }
                simulations.iter_mut().for_each(|simulation| simulation.step(&[[0.0; 4]]).unwrap());
                let [a, b] = &simulations;
                assert_eq!(a.contacts(), b.contacts(), "{drone:?} {push:?}");
                touching += usize::from(!a.contacts().is_empty());
                let (a, b) = (&a.states()[0], &b.states()[0]);
                worst = worst.max((a.position - b.position).norm()).max((a.attitude.coords - b.attitude.coords).norm());
            }
        }
        assert!(worst < 1e-9, "{drone:?}: {worst:e}");
        let [a, b] = &simulations;
        assert!(touching > 50 && a.states()[0].position.z > 0.1, "{touching} {:?}", a.states()[0].position);
        assert!(b.engine_substeps().flight > 10 * b.engine_substeps().mujoco, "{:?}", b.engine_substeps());
    }
}

/// Forces of up to 50 times the weight drive drones into the floor, obstacles and each other. The hybrid engine sees
/// the first contact in the same control step as MuJoCo, and the flight before it is the same.
#[test]
fn the_hybrid_engine_misses_no_contact_under_forces_of_50_times_the_weight() {
    let obstacles = [
        Obstacle::new(Shape::Box { half_size: [0.05, 1.0, 1.0] }, Vector3::new(1.0, 0.0, 1.0)),
        Obstacle::new(Shape::Sphere { radius: 0.3 }, Vector3::new(-1.0, 0.3, 1.0)),
        Obstacle::new(Shape::Cylinder { radius: 0.05, half_height: 1.0 }, Vector3::new(0.0, -1.0, 1.0)),
    ];
    let mut met = [0; 3];
    for seed in 0..if cfg!(debug_assertions) { 60 } else { 600 } {
        let mut rng = Rng::seed_from_u64(seed);
        let drone = DroneModel::PAPER[seed as usize % 3];
        let params = drone.params();
        let rates = [(240, 48), (240, 20), (1000, 20)][rng.random_range(0..3)];
        let physics = [Physics::Mjc, Physics::MjcGndDragDw][rng.random_range(0..2)];
        let heights = [(); 2].map(|()| rng.random_range(0.2..1.2));
        let mut simulations = EngineKind::WITH_CONTACTS.map(|engine| {
            let builder = Simulation::builder(drone).num_drones(2).engine(engine).obstacles(obstacles).physics(physics);
            let builder = builder.initial_positions([[0.0, 0.0, heights[0]], [0.2, 0.6, heights[1]]]);
            builder.sim_freq(rates.0).ctrl_freq(rates.1).build().unwrap()
        });
        let mut stepped = 0;
        for step in 0..60_u32 {
            if step.is_multiple_of(7) {
                let scale = 50.0 * rng.random::<f64>().powi(2) * params.weight();
                for drone in 0..2 {
                    let force = random_force(&mut rng, scale);
                    simulations.iter_mut().for_each(|simulation| simulation.set_external_force(drone, force).unwrap());
                }
            }
            let commands = [0, 1].map(|drone| tumbling(&params, step + 9 * drone));
            simulations.iter_mut().for_each(|simulation| simulation.step(&commands).unwrap());
            let [a, b] = &simulations;
            let pairs = a.states().iter().zip(b.states());
            let error = pairs.map(|(a, b)| (a.position - b.position).norm()).fold(0.0, f64::max);
            // MuJoCo does not report contacts before the last stage of a step, and its solver amplifies rounding errors
            let alone = b.engine_substeps().mujoco == stepped;
            stepped = b.engine_substeps().mujoco;
            assert!(error < if alone { 1e-9 } else { 1e-3 }, "seed {seed}, step {step}: {error:e}");
            if error > 1e-9 {
                break;
            }
            assert_eq!(a.contacts().first(), b.contacts().first(), "seed {seed}, step {step}");
            let Some(contact) = a.contacts().first() else { continue };
            met[match contact.with {
                Touched::Floor => 0,
                Touched::Obstacle(_) => 1,
                Touched::Drone(_) => 2,
            }] += 1;
            break;
        }
    }
    assert!(met[0] > 5 && met[1] > 3, "{met:?}");
}

#[test]
fn only_the_pushed_drone_of_a_swarm_moves_differently() {
    for engine in EngineKind::WITH_CONTACTS {
        let mut simulations =
            [(); 2].map(|()| Simulation::builder(DroneModel::Cf2x).num_drones(3).engine(engine).build());
        let [a, b] = simulations.each_mut().map(|simulation| simulation.as_mut().unwrap());
        b.set_external_force(1, Vector3::new(0.1, 0.0, 0.4)).unwrap();
        for simulation in [&mut *a, &mut *b] {
            step_simulation(simulation, &[[14_000.0; 4], [14_100.0; 4], [14_200.0; 4]], 20);
        }
        assert_eq!((a.states()[0], a.states()[2]), (b.states()[0], b.states()[2]));
        assert!((a.states()[1].position - b.states()[1].position).norm() > 0.1);
    }
}

fn windy(engine: EngineKind) -> SimulationBuilder {
    let motors = ActuatorParams { lag: 0.03, latency: 0.01, ..ActuatorParams::default() };
    Simulation::builder(DroneModel::Cf2x)
        .num_drones(2)
        .engine(engine)
        .physics(Physics::MjcGndDragDw)
        .actuators(motors)
        .wind(WindConfig::new(WindModel::Combined))
}

#[test]
fn a_zero_force_is_bit_identical_to_none_and_a_reset_removes_a_force() {
    for engine in EngineKind::WITH_CONTACTS {
        let mut simulations = [(); 3].map(|()| windy(engine).build().unwrap());
        let speeds = [[14_600.0; 4], [14_700.0; 4]];
        simulations[1].set_external_force(1, Vector3::zeros()).unwrap();
        // a force before the reset does not act after it
        simulations[2].set_external_force(0, FORCE).unwrap();
        simulations[2].set_motor_gain(1, 2, 0.3).unwrap();
        step_simulation(&mut simulations[2], &speeds, 5);
        for simulation in &mut simulations {
            simulation.reset().unwrap();
            simulation.reset_wind(4);
            step_simulation(simulation, &speeds, 40);
        }
        let text = |simulation: &Simulation| serde_json::to_string(simulation.data()).unwrap();
        for other in &simulations[1..] {
            assert_eq!(text(&simulations[0]), text(other), "{engine}");
            assert_eq!(simulations[0].engine_substeps().mujoco > 0, engine == EngineKind::Mujoco);
        }
        assert!(!text(&simulations[0]).contains("external_forces"));
    }
}

#[test]
fn a_snapshot_in_the_middle_of_a_push_repeats_the_flight_bit_identically() {
    for engine in EngineKind::WITH_CONTACTS {
        let (mut one, mut other) = (windy(engine).build().unwrap(), windy(engine).build().unwrap());
        let fly = |simulation: &mut Simulation| {
            step_simulation(simulation, &[[14_600.0; 4], [13_000.0; 4]], 30);
            serde_json::to_string(simulation.data()).unwrap()
        };
        one.set_external_force(1, FORCE).unwrap();
        one.set_motor_gain(0, 3, 0.4).unwrap();
        fly(&mut one);
        let snapshot = one.snapshot();
        let text = serde_json::to_string(&snapshot).unwrap();
        one.set_external_force(0, FORCE).unwrap();
        one.restore(&snapshot).unwrap();
        assert_eq!(one.external_force(0), Vector3::zeros());
        let expected = fly(&mut one);
        let read: SimData = serde_json::from_str(&text).unwrap();
        for snapshot in [&snapshot, &read] {
            other.set_external_force(0, -FORCE).unwrap();
            other.restore(snapshot).unwrap();
            assert_eq!((other.external_force(1), other.motor_gains(0)[3]), (FORCE, 0.4));
            assert_eq!(fly(&mut other), expected, "{engine}");
        }
        // the wrong number of forces and a number out of range
        for (from, to) in [("[[0.0,0.0,0.0],", "["), ("[[0.0,0.0,0.0],", "[[0.0,0.0,1e999],")] {
            let start = text.find("\"external_forces\":").unwrap();
            let edited = format!("{}{}", &text[..start], text[start..].replacen(from, to, 1));
            assert_ne!(edited, text);
            assert!(serde_json::from_str::<SimData>(&edited).is_err());
        }
    }
}

#[test]
fn wrong_forces_and_gains_are_clear_errors_and_change_nothing() {
    let mut simulation = Simulation::builder(DroneModel::Cf2x).num_drones(2).build().unwrap();
    let error = |result: Result<(), SimulationError>| result.unwrap_err().to_string();
    let nan = Vector3::new(0.0, f64::NAN, 0.0);
    let expected = "the external force on drone 1 is [0.0, NaN, 0.0] N, expected three finite numbers";
    assert_eq!(error(simulation.set_external_force(1, nan)), expected);
    let expected = "drone 2 does not exist, expected an index from 0 to 1";
    assert_eq!(error(simulation.set_external_force(2, FORCE)), expected);
    assert_eq!(error(simulation.set_motor_gain(2, 0, 1.0)), expected);
    assert_eq!(error(simulation.set_motor_gain(0, 4, 1.0)), "motor is 4, expected an index from 0 to 3");
    assert_eq!(error(simulation.set_motor_gain(0, 1, -0.5)), "motor_gain is -0.5, expected a factor from 0 to 1000");
    assert!(simulation.set_motor_gain(0, 1, f64::NAN).is_err());
    assert_eq!((simulation.external_force(1), simulation.motor_gains(0)), (Vector3::zeros(), &[1.0; 4]));
    // a force beyond every bound is an error of the step
    simulation.set_external_force(0, Vector3::repeat(1e300)).unwrap();
    assert!(matches!(simulation.step(&[[0.0; 4]; 2]), Err(SimulationError::Diverged { drone: 0, .. })));
}

#[test]
fn a_scenario_describes_changed_gains_and_refuses_a_force() {
    let mut simulation = Simulation::builder(DroneModel::Cf2x).build().unwrap();
    simulation.set_motor_gain(0, 1, 0.5).unwrap();
    let bodies = Scenario::of(&simulation).unwrap().bodies.unwrap();
    assert_eq!(bodies[0].actuators.gains, [1.0, 0.5, 1.0, 1.0]);
    simulation.set_external_force(0, FORCE).unwrap();
    let error = Scenario::of(&simulation).unwrap_err().to_string();
    assert!(error.contains("a drone has an external force, expected none"), "{error}");
}

/// A change of a gain keeps rotor speeds, lag and queue, in contrast to a replacement of the motor parameters.
#[test]
fn a_motor_fails_from_its_present_speed_and_delayed_commands_still_arrive() {
    let motors = ActuatorParams { lag: 0.05, latency: 2.0 / 240.0, gains: [0.9; 4], ..ActuatorParams::default() };
    let builder = Simulation::builder(DroneModel::Cf2x).actuators(motors).ctrl_freq(240);
    let mut simulation = builder.initial_positions([[0.0, 0.0, 2.0]]).build().unwrap();
    step_simulation(&mut simulation, &[[18_000.0; 4]], 30);
    let before = *simulation.rotor_speeds(0);
    simulation.set_motor_gain(0, 2, 0.0).unwrap();
    assert_eq!(*simulation.rotor_speeds(0), before);
    let decay = (-1.0_f64 / 240.0 / 0.05).exp();
    let mut last = before[0];
    for step in 1..=10 {
        // a new command arrives after two steps
        simulation.step(&[[10_000.0; 4]]).unwrap();
        let [a, _, c, _] = *simulation.rotor_speeds(0);
        assert!((c - before[2] * decay.powi(step)).abs() < 1e-6, "step {step}");
        assert_eq!(step <= 2, a > last, "the old command raises the speed for two steps");
        last = a;
    }
    assert_eq!(simulation.actuator_params(0).gains, [0.9; 4]);
    simulation.reset().unwrap();
    assert_eq!(simulation.motor_gains(0), &[0.9; 4]);
}
