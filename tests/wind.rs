//! Wind does in the physics what it says: drift, hover, blades, and nothing that it should not.

use mujoco_drones_gym::control::{Bandwidths, GeometricControl};
use mujoco_drones_gym::env::{check_env, check_independence};
use mujoco_drones_gym::multi_agent::{ParallelAviary, check_parallel_env};
use mujoco_drones_gym::physics::drag;
use mujoco_drones_gym::physics::wind::{WindConfig, WindModel, drag_law};
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::tasks::NAMES;
use mujoco_drones_gym::wrappers::WindWrapper;
use nalgebra::Vector3;

fn constant(velocity: [f64; 3]) -> WindConfig {
    WindConfig { velocity, ..WindConfig::new(WindModel::Constant) }
}

/// A drone that hovers by motor speeds alone is carried away: v(t) = U·k·U·t/(1 + k·U·t), k = ρ·C_d·A/2m, and ends at U.
#[test]
fn a_drone_that_only_carries_its_weight_drifts_to_the_winds_velocity() {
    for physics in [Physics::Mjc, Physics::Dyn] {
        for (model, yaw) in [(DroneModel::Cf2x, 0.0), (DroneModel::Race, 1.1)] {
            let params = model.params();
            let wind = [6.0, -8.0, 0.0];
            let mut simulation = Simulation::builder(model)
                .physics(physics)
                .initial_positions([[0.0, 0.0, 5.0]])
                .initial_rpys([[0.0, 0.0, yaw]])
                .wind(constant(wind))
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
            // after a minute a good part of it
            assert!(simulation.states()[0].velocity.norm() > 5.0);
        }
    }
}

/// Two drones in one wind fly as each would alone: the clock does not run faster for more of them.
#[test]
fn several_drones_share_a_clock_and_not_their_gusts() {
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

/// Blades meet the air, not the ground: with drag on, the load is that of the drag law plus blades in the relative wind.
#[test]
fn blade_drag_is_against_the_moving_air() {
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
fn setting_the_wind_and_wrapping_in_it_are_the_same_and_every_task_keeps_its_contract() {
    let config = WindConfig::new(WindModel::Combined);
    for name in NAMES {
        let build =
            || WindWrapper::new(make(name, EnvConfig::default().episode_seconds(3.0)).unwrap(), config).unwrap();
        check_env(&mut build()).unwrap_or_else(|error| panic!("{error}"));
        check_independence(&mut build(), &mut build()).unwrap();
    }
    let mut wrapped = WindWrapper::new(Hover::builder().build().unwrap(), config).unwrap();
    let mut set = Hover::builder().build().unwrap();
    set.set_wind(Some(config)).unwrap();
    let mut built = Hover::builder().wind(config).build().unwrap();
    let mut still = Hover::builder().build().unwrap();
    let mut flights = Vec::new();
    for env in [&mut wrapped as &mut dyn Env, &mut set, &mut built, &mut still] {
        env.reset(Some(3)).unwrap();
        for _ in 0..100 {
            env.step(&[0.05; 4]).unwrap();
        }
        flights.push(env.observation().vector.clone());
    }
    assert!(flights[0] == flights[1] && flights[1] == flights[2]);
    assert_ne!(flights[2], flights[3], "and it does blow");
    // another episode has another wind; none again is none
    set.reset(None).unwrap();
    for _ in 0..100 {
        set.step(&[0.05; 4]).unwrap();
    }
    assert_ne!(*set.observation().vector, flights[1]);
    set.set_wind(None).unwrap();
    set.reset(Some(3)).unwrap();
    for _ in 0..100 {
        set.step(&[0.05; 4]).unwrap();
    }
    assert_eq!(set.observation().vector, flights[3]);
    let bad = WindConfig { gust_force: f64::NAN, ..config };
    assert!(set.set_wind(Some(bad)).unwrap_err().to_string().contains("gust_force is NaN"));
    check_parallel_env(&mut ParallelAviary::new(MultiHover::builder().wind(config).build().unwrap()), 2).unwrap();
}

/// The paper's figure: combined wind, steady 0.9 m/s along +y. Its PID drifts; a controller with an integral stays.
#[test]
fn an_integral_holds_a_hover_in_the_papers_wind_and_the_papers_pid_is_off_by_centimetres() {
    let fly = |controller: &mut dyn Controller| {
        let wind = WindConfig::new(WindModel::Combined);
        let mut env =
            Hover::builder().initial_positions([[0.0, 0.0, 1.0]]).episode_seconds(20.0).wind(wind).build().unwrap();
        env.reset(Some(2)).unwrap();
        let (mut action, mut offset) = ([0.0; 4], Vector3::zeros());
        while env.info().end.is_none() {
            let rpm = controller.control(1.0 / 48.0, &env.simulation().states()[0], &env.reference(0)).rpm;
            env.action_of_motor_speeds(&[rpm], &mut action).unwrap();
            env.step(&action).unwrap();
            if env.info().time > 10.0 {
                offset += (env.simulation().states()[0].position - Vector3::z()) / 480.0;
            }
        }
        assert!(!env.info().crashed());
        offset
    };
    let params = DroneModel::Cf2x.params();
    let pid = fly(&mut PidControl::new(&params));
    let held =
        fly(&mut GeometricControl::with_bandwidths(&params, Bandwidths { integral: 0.1, ..Bandwidths::default() }));
    assert!(pid.y > 0.03, "downwind: {pid}");
    assert!(held.norm() < 0.01 && held.norm() < 0.2 * pid.norm(), "{held} beside {pid}");
}
