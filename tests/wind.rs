//! Wind: drift, drag in moving air, the medium, and the contract of environments in wind.
//!
//! "The paper" is *MuJoCo-Drones-Gym* (Tayal).

mod common;

use common::{assert_contract, reset_batch, step_env};
use mujoco_drones_gym::control::{Bandwidths, GeometricControl};
use mujoco_drones_gym::multi_agent::{ParallelAviary, check_parallel_env};
use mujoco_drones_gym::physics::drag;
use mujoco_drones_gym::physics::wind::{WindConfig, WindModel, drag_law};
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::tasks::NAMES;
use mujoco_drones_gym::world::Medium;
use nalgebra::Vector3;

/// Returns a constant wind.
fn constant(velocity: [f64; 3]) -> WindConfig {
    WindConfig { velocity, ..WindConfig::new(WindModel::Constant) }
}

/// Returns a combined wind with a constant velocity alone.
fn combined(velocity: [f64; 3]) -> WindConfig {
    let still = WindConfig { turbulence: 0.0, gust_force: 0.0, sinusoidal_force: 0.0, ..WindConfig::default() };
    WindConfig { model: WindModel::Combined, velocity, ..still }
}

/// The velocity of a drone at hover speed follows v(t) = U·k·U·t/(1 + k·U·t) with k = ρ·C_d·A/2m.
#[test]
fn a_drone_at_hover_speed_drifts_towards_the_velocity_of_the_wind() {
    let wind = [6.0, -8.0, 0.0];
    for (physics, config) in
        [(Physics::Mjc, constant(wind)), (Physics::Dyn, constant(wind)), (Physics::Mjc, combined(wind))]
    {
        for (model, yaw) in [(DroneModel::Cf2x, 0.0), (DroneModel::Race, 1.1)] {
            let params = model.params();
            let mut simulation = Simulation::builder(model)
                .physics(physics)
                .initial_positions([[0.0, 0.0, 5.0]])
                .initial_rpys([[0.0, 0.0, yaw]])
                .wind(config)
                .build()
                .unwrap();
            let k = 0.5 * 1.225 * params.drag_area() / params.mass;
            for step in 1..=48 * 60 {
                simulation.step(&[[params.hover_rpm(); 4]]).unwrap();
                let t = f64::from(step) / 48.0;
                let expected = Vector3::from(wind) * (k * 10.0 * t / (1.0 + k * 10.0 * t));
                let velocity = simulation.states()[0].velocity;
                assert!((velocity - expected).norm() < 0.01, "{model} {physics} at {t} s: {velocity} {expected}");
            }
            // after a minute the drone has more than half of the velocity of the wind
            assert!(simulation.states()[0].velocity.norm() > 5.0);
        }
    }
}

/// A drone with the velocity of the air keeps it: the drag law, blade drag and MuJoCo's medium exert no force. The load
/// cancels the force of the medium.
#[test]
fn a_drone_that_moves_with_the_air_has_no_drag() {
    let wind = Vector3::new(3.0, -1.0, 0.5);
    let params = DroneModel::Cf2x.params();
    for config in [constant(wind.into()), combined(wind.into())] {
        for (physics, medium) in [(Physics::Mjc, None), (Physics::MjcDrag, None), (Physics::MjcDrag, Some(Medium::AIR))]
        {
            for engine in EngineKind::WITH_CONTACTS {
                let mut simulation = Simulation::builder(DroneModel::Cf2x)
                    .num_drones(2)
                    .initial_positions([[0.0, 0.0, 5.0], [0.0, 3.0, 6.0]])
                    .initial_rpys([[0.0, 0.0, 0.8], [0.0, 0.0, -2.5]])
                    .initial_velocities([wind.into(); 2])
                    .physics(physics)
                    .medium(medium)
                    .engine(engine)
                    .wind(config)
                    .build()
                    .unwrap();
                for _ in 0..240 {
                    simulation.step(&[[params.hover_rpm(); 4]; 2]).unwrap();
                    for (state, load) in simulation.states().iter().zip(simulation.loads()) {
                        let error = (state.velocity - wind).norm();
                        assert!(error < 1e-9, "{config:?} {physics} {medium:?} {engine:?}: {error:e} m/s");
                        let force = load.external.force_world.norm();
                        assert!(medium.is_some() || force < 1e-9, "{config:?} {physics} {engine:?}: {force:e} N");
                    }
                }
            }
        }
    }
}

/// The force of the medium on a drone at rest in moving air equals the force at the opposite velocity in still air.
#[test]
fn the_medium_moves_with_the_wind() {
    let wind = Vector3::new(2.0, 1.0, -0.5);
    let settle = |velocity: Vector3<f64>, config: Option<WindConfig>, engine| {
        let mut simulation = Simulation::builder(DroneModel::Race)
            .initial_positions([[0.0, 0.0, 5.0]])
            .initial_rpys([[0.1, -0.2, 0.8]])
            .initial_velocities([velocity.into()])
            .medium(Medium::AIR)
            .engine(engine)
            .sim_freq(24_000)
            .ctrl_freq(24_000)
            .wind(config)
            .build()
            .unwrap();
        simulation.step(&[[0.0; 4]]).unwrap();
        simulation.states()[0].velocity - velocity
    };
    // an air density of zero switches the drag law off
    let config = WindConfig { air_density: 0.0, ..constant(wind.into()) };
    for engine in EngineKind::WITH_CONTACTS {
        let moving = settle(Vector3::zeros(), Some(config), engine);
        let still = settle(-wind, None, engine);
        let gained = (still - settle(Vector3::zeros(), None, engine)).norm();
        // the force is constant in a physics step, which gives an error of first order in its length
        assert!((moving - still).norm() < 1e-3 * gained && gained > 1e-7, "{engine:?}: {moving} {still} {gained}");
    }
}

/// Flights in constant wind of 0 m/s and in combined wind without any part are bit-identical to flights without wind,
/// in single environments and batches.
#[test]
fn flights_in_wind_of_zero_velocity_are_bit_identical_to_flights_without_wind() {
    let task = MultiHover::builder()
        .initial_positions([[0.0, 0.0, 0.05], [0.5, 0.0, 1.0]])
        .initial_rpys([[0.0, 0.0, 2.0], [0.2, -0.1, -1.3]])
        .initial_velocities([[0.0, 0.3, 0.4], [1.0, -2.0, 0.0]])
        .physics(Physics::MjcGndDragDw)
        .task(|task| task.crash.floor_contact = false)
        .episode_seconds(1.0);
    let fly = |wind: Option<WindConfig>, engine| {
        let mut env = task.clone().engine(engine).wind(wind).build().unwrap();
        let config = VecConfig { threads: 1, ..VecConfig::new(9) };
        let (mut batch, mut buffers) = reset_batch(task.clone().engine(engine).wind(wind), config, 5);
        env.reset(Some(5)).unwrap();
        let mut bits = Vec::new();
        for step in 0..60 {
            if env.info().end.is_some() {
                env.reset(None).unwrap();
            }
            let action = [0.3, 0.31, 0.3, 0.31, 0.0, 0.01, 0.0, 0.0].map(|a| if step % 20 < 10 { a } else { -0.2 * a });
            env.step(&action).unwrap();
            bits.extend(env.observation().vector.iter().map(|x| x.to_bits()));
            let actions: Vec<f32> = action.iter().cycle().take(8 * 9).map(|&x| x as f32).collect();
            batch.step(&actions, buffers.step()).unwrap();
            bits.extend(buffers.observations.iter().map(|x| u64::from(x.to_bits())));
        }
        bits
    };
    for engine in EngineKind::WITH_CONTACTS {
        let none = fly(None, engine);
        for config in [WindConfig::default(), constant([0.0; 3]), combined([0.0; 3])] {
            assert!(fly(Some(config), engine) == none, "{engine:?} {config:?}");
        }
        assert!(fly(Some(constant([1e-6, 0.0, 0.0])), engine) != none, "moving air exerts drag");
        assert!(fly(Some(WindConfig { still_air_drag: true, ..WindConfig::default() }), engine) != none);
    }
}

/// Still-air drag gives a speed of v/(1 + k·v·t) with k = ρ·C_d·A/2m under every wind model.
#[test]
fn still_air_drag_matches_its_closed_form() {
    let params = DroneModel::Cf2x.params();
    let k = 0.5 * 1.225 * params.drag_area() / params.mass;
    for config in [WindConfig::default(), constant([0.0; 3]), combined([0.0; 3])] {
        let mut simulation = Simulation::builder(DroneModel::Cf2x)
            .initial_positions([[0.0, 0.0, 5.0]])
            .initial_velocities([[3.0, 4.0, 0.0]])
            .wind(WindConfig { still_air_drag: true, ..config })
            .build()
            .unwrap();
        for step in 1..=240 {
            simulation.step(&[[params.hover_rpm(); 4]]).unwrap();
            let expected = 5.0 / (1.0 + k * 5.0 * f64::from(step) / 48.0);
            assert!((simulation.states()[0].velocity.norm() - expected).abs() < 0.005, "{config:?}");
        }
        assert!(simulation.states()[0].velocity.norm() < 2.0);
    }
}

/// After `set_airframe`, the wind acts on the drag area of the new airframe.
#[test]
fn a_changed_airframe_changes_the_drag_area_in_wind() {
    let mut simulation = Simulation::builder(DroneModel::Cf2x).wind(constant([3.0, 0.0, 0.0])).build().unwrap();
    let large = DroneParams { drag_area_override: Some(0.02), ..DroneModel::Cf2x.params() };
    simulation.set_airframe(0, large).unwrap();
    simulation.reset().unwrap();
    simulation.step(&[[14_000.0; 4]]).unwrap();
    let relative = 0.5 * 1.225 * 0.02 * 9.0;
    assert!((simulation.loads()[0].external.force_world.x / relative - 1.0).abs() < 0.05);
}

/// The time of the wind advances once per step for any number of drones.
#[test]
fn the_time_of_the_wind_does_not_depend_on_the_number_of_drones() {
    let config = WindConfig { sinusoidal_force: 0.05, ..WindConfig::new(WindModel::Sinusoidal) };
    let end = |count: usize| {
        let mut simulation = Simulation::builder(DroneModel::Cf2x)
            .num_drones(count)
            .initial_positions((0..count).map(|i| [3.0 * i as f64, 0.0, 5.0]))
            .wind(config)
            .build()
            .unwrap();
        let hover = DroneModel::Cf2x.params().hover_rpm();
        for _ in 0..100 {
            simulation.step(&vec![[hover; 4]; count]).unwrap();
        }
        simulation.states().iter().map(|state| state.velocity).collect::<Vec<_>>()
    };
    let (one, three) = (end(1), end(3));
    assert!(one[0].norm() > 0.1);
    assert!(three.iter().all(|velocity| (velocity - one[0]).norm() < 1e-9));
}

/// Blade drag uses the velocity relative to the air. The load is the sum of the drag law and blade drag.
#[test]
fn blade_drag_uses_the_velocity_relative_to_the_air() {
    let wind = Vector3::new(2.0, 1.0, -0.5);
    let params = DroneModel::Cf2x.params();
    let start = DroneState {
        velocity: Vector3::new(0.5, -1.0, 0.3),
        ..DroneState::at_rest(Vector3::new(0.0, 0.0, 3.0), Vector3::new(0.2, -0.3, 2.0))
    };
    let mut simulation = Simulation::builder(DroneModel::Cf2x)
        .physics(Physics::MjcDrag)
        .ctrl_freq(240)
        .wind(constant(wind.into()))
        .build()
        .unwrap();
    simulation.reset_to(&[start]).unwrap();
    let rpm = [14_000.0, 15_000.0, 13_000.0, 14_500.0];
    simulation.step(&[rpm]).unwrap();
    let expected =
        drag_law(1.225, params.drag_area(), &(wind - start.velocity)) + drag::force(&params, &start, &rpm, &wind);
    assert!((simulation.loads()[0].external.force_world - expected).norm() < 1e-15);
}

#[test]
fn set_wind_equals_building_with_wind_and_every_task_keeps_its_contract() {
    let config = WindConfig::new(WindModel::Combined);
    for name in NAMES {
        let build = || {
            let mut env = make(name, EnvConfig::default().episode_seconds(3.0)).unwrap();
            env.set_wind(Some(config)).unwrap();
            env
        };
        assert_contract(build);
    }
    let mut set = Hover::builder().build().unwrap();
    set.set_wind(Some(config)).unwrap();
    let mut built = Hover::builder().wind(config).build().unwrap();
    let mut still = Hover::builder().build().unwrap();
    let mut flights = Vec::new();
    for env in [&mut set as &mut dyn DroneEnv, &mut built, &mut still] {
        env.reset(Some(3)).unwrap();
        step_env(env, &[0.05; 4], 100);
        flights.push(env.observation().vector.clone());
    }
    assert!(flights[0] == flights[1]);
    assert_ne!(flights[1], flights[2], "the wind changes the flight");
    // the next episode has another sequence of gusts; without wind, the flight in still air is repeated
    set.reset(None).unwrap();
    step_env(&mut set, &[0.05; 4], 100);
    assert_ne!(*set.observation().vector, flights[1]);
    set.set_wind(None).unwrap();
    set.reset(Some(3)).unwrap();
    step_env(&mut set, &[0.05; 4], 100);
    assert_eq!(set.observation().vector, flights[2]);
    let bad = WindConfig { gust_force: f64::NAN, ..config };
    assert!(set.set_wind(Some(bad)).unwrap_err().to_string().contains("gust_force is NaN"));
    check_parallel_env(&mut ParallelAviary::new(MultiHover::builder().wind(config).build().unwrap()), 2).unwrap();
}

/// In the combined wind of the paper's figure (0.9 m/s along +y), the paper's PID drifts, and a geometric controller
/// with an integral term does not. The correlation time of the turbulence is as long as a flight, so that the drift is
/// an average over flights.
#[test]
fn in_the_papers_wind_the_pid_drifts_by_centimetres_and_an_integral_term_prevents_it() {
    let fly = |mut pilot: ControllerPolicy| {
        let wind = WindConfig::new(WindModel::Combined);
        let mut env =
            Hover::builder().initial_positions([[0.0, 0.0, 1.0]]).episode_seconds(20.0).wind(wind).build().unwrap();
        let (mut offset, flights) = (Vector3::zeros(), 16_u32);
        for seed in 0..flights {
            let mut rollout = Rollout::start(&mut env, &mut pilot, Some(u64::from(seed))).unwrap();
            rollout
                .finish(|env| {
                    if env.info().time > 10.0 {
                        offset += (env.simulation().states()[0].position - Vector3::z()) / 480.0;
                    }
                })
                .unwrap();
            assert!(!env.info().crashed());
        }
        offset / f64::from(flights)
    };
    let params = DroneModel::Cf2x.params();
    let pid = fly(ControllerPolicy::with_controllers([PidControl::new(&params)]));
    let integral = Bandwidths { integral: 0.1, ..Bandwidths::default() };
    let held = fly(ControllerPolicy::with_controllers([GeometricControl::with_bandwidths(&params, integral)]));
    assert!(pid.y > 0.03, "mean offset of the PID: {pid}");
    assert!(held.norm() < 0.01 && held.norm() < 0.2 * pid.norm(), "mean offset {held}, of the PID {pid}");
}
