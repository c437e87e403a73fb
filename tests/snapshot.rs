//! Snapshots: what follows a restore is bit-identical to what followed the snapshot, whatever the environment is made of.

use mujoco_drones_gym::control::{CollisionCone, ControllerKind};
use mujoco_drones_gym::env::{EnvConfig, EnvSnapshot, Randomization};
use mujoco_drones_gym::physics::actuators::ActuatorParams;
use mujoco_drones_gym::physics::wind::{WindConfig, WindModel};
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::tasks::{Antipodal, NAMES, make};
use mujoco_drones_gym::world::{Obstacle, ObstacleConfig, ObstacleKind, Shape};
use mujoco_drones_gym::wrappers::{CurriculumConfig, CurriculumWrapper, SafetyWrapper};
use mujoco_drones_gym::{Rng, RngExt as _, SeedableRng as _};
use nalgebra::Vector3;

/// Everything that a step of an environment says, as bits.
fn step(env: &mut dyn DroneEnv, rng: &mut Rng, out: &mut Vec<u64>) {
    let action: Vec<f64> = (0..env.action_space().size()).map(|_| 0.6 * rng.random::<f64>() - 0.28).collect();
    if env.info().end.is_some() {
        env.reset(None).unwrap();
        out.push(1);
    } else {
        let step = env.step(&action).unwrap();
        out.extend([step.reward.to_bits(), step.terminated.into(), step.truncated.into()]);
    }
    let observation = env.observation();
    let numbers = observation.vector.iter().chain(&observation.ranges).chain(&observation.obstacle);
    out.extend(numbers.map(|x| x.to_bits()));
    out.extend(env.info_map().into_values().map(f64::to_bits));
    for (drone, state) in env.simulation().states().iter().enumerate() {
        let (p, v) = (state.position.iter(), state.velocity.iter());
        out.extend(p.chain(v).chain(state.attitude.coords.iter()).chain(&state.angular_velocity).map(|x| x.to_bits()));
        out.extend(env.simulation().rotor_speeds(drone).map(f64::to_bits));
        out.push(env.drone_reward(drone).to_bits());
    }
    let contacts = env.simulation().contacts().iter().map(|contact| contact.drone as u64);
    out.extend(contacts);
    out.extend(env.simulation().obstacles().iter().map(|obstacle| obstacle.position.x.to_bits()));
}

fn flight(env: &mut dyn DroneEnv, seed: u64, steps: usize) -> Vec<u64> {
    let (mut rng, mut out) = (Rng::seed_from_u64(seed), Vec::new());
    (0..steps).for_each(|_| step(env, &mut rng, &mut out));
    out
}

/// Flies to a snapshot and on, and again from the snapshot in the same environment and in another one.
fn check(what: &str, build: &dyn Fn() -> Box<dyn DroneEnv>) {
    let (mut env, mut other) = (build(), build());
    for (seed, before) in [(1, 0), (2, 7), (3, 40)] {
        env.reset(Some(seed)).unwrap();
        flight(&mut *env, seed, before);
        let snapshot: EnvSnapshot = env.snapshot();
        let (seen, info) = (env.observation().clone(), env.info());
        let wanted = flight(&mut *env, 100 + seed, 90);
        // what happens in between does not matter
        other.reset(Some(9)).unwrap();
        flight(&mut *other, 5, 13);
        for env in [&mut env, &mut other] {
            env.restore(&snapshot).unwrap();
            assert_eq!((env.observation(), env.info()), (&seen, info), "{what}, seed {seed}");
            let got = flight(&mut **env, 100 + seed, 90);
            assert!(got == wanted, "{what}, seed {seed} after {before} steps");
        }
    }
}

/// Conditions of flights, each with its name.
fn conditions() -> Vec<(&'static str, EnvConfig)> {
    let config = EnvConfig::default;
    let forest = ObstacleConfig { new_layout: true, ..ObstacleConfig::new(ObstacleKind::Forest) };
    let motors =
        ActuatorParams { lag: 0.03, latency: 0.02, gains: [1.0, 0.98, 1.02, 0.99], ..ActuatorParams::default() };
    vec![
        ("still air", config()),
        ("all effects", config().physics(Physics::MjcGndDragDw)),
        ("wind", config().wind(WindConfig::new(WindModel::Combined))),
        ("motors", config().actuators(motors)),
        ("randomization", config().physics(Physics::MjcDrag).randomization(Randomization::default())),
        ("obstacles", config().obstacle_field(forest).randomization(Randomization::default())),
        ("explicit", config().physics(Physics::Dyn)),
    ]
}

#[test]
fn every_task_goes_on_from_a_snapshot_bit_identically() {
    for name in NAMES {
        for (condition, config) in conditions() {
            let explicit = condition == "explicit";
            let engines = if explicit { &[EngineKind::Explicit][..] } else { &EngineKind::WITH_CONTACTS[..] };
            for &engine in engines {
                let config = config.clone().engine(engine).episode_seconds(1.5);
                check(&format!("{name}, {condition}, {engine}"), &|| make(name, config.clone()).unwrap());
            }
        }
    }
}

#[test]
fn controllers_and_wrappers_go_on_from_a_snapshot_bit_identically() {
    for action_type in [ActionType::Vel, ActionType::Pid, ActionType::Attitude] {
        for controller in [ControllerKind::Pid, ControllerKind::Dsl, ControllerKind::Geometric] {
            let config = EnvConfig::default().action_type(action_type).controller(controller).episode_seconds(1.5);
            let config = config.randomization(Randomization::default());
            check(&format!("{action_type} {controller}"), &|| make("multi_hover", config.clone()).unwrap());
        }
    }
    check("safety in a curriculum", &|| {
        let env = Antipodal::builder().num_drones(3).action_type(ActionType::Vel).episode_seconds(1.0).build().unwrap();
        let env = SafetyWrapper::new(env, CollisionCone::new(0.4)).unwrap();
        let config = CurriculumConfig { window: 2, ..CurriculumConfig::default() };
        Box::new(CurriculumWrapper::new(env, config, |_: &mut SafetyWrapper<_>, _| Ok(())).unwrap())
    });
}

/// Between two snapshots of one flight, in any order and any number of times.
#[test]
fn branches_of_a_flight_do_not_touch_each_other() {
    let mut env = make("race", EnvConfig::default().num_drones(2).engine(EngineKind::Hybrid)).unwrap();
    env.reset(Some(4)).unwrap();
    flight(&mut *env, 1, 5);
    let first = env.snapshot();
    let trunk = flight(&mut *env, 2, 20);
    let second = env.snapshot();
    let branch = flight(&mut *env, 3, 20);
    for _ in 0..3 {
        env.restore(&second).unwrap();
        assert!(flight(&mut *env, 3, 20) == branch);
        env.restore(&first).unwrap();
        assert!(flight(&mut *env, 2, 20) == trunk);
    }
}

#[test]
fn a_simulation_goes_on_from_its_data_and_refuses_that_of_another() {
    let build = |drones| {
        let builder = Simulation::builder(DroneModel::Cf2x).num_drones(drones).physics(Physics::MjcGndDragDw);
        builder.wind(WindConfig::new(WindModel::Dryden)).build().unwrap()
    };
    let mut simulation = build(3);
    // on the floor, where MuJoCo's solver has a warm start
    let fly = |simulation: &mut Simulation, from: u32| {
        for step in from..from + 50 {
            let rpm = 13_500.0 + 1_500.0 * f64::from(step).sin();
            simulation.step(&[[rpm; 4], [rpm + 900.0; 4], [rpm, rpm + 20.0, rpm, rpm - 20.0]]).unwrap();
        }
        simulation.states().to_vec()
    };
    fly(&mut simulation, 0);
    let data = simulation.snapshot();
    let wanted = fly(&mut simulation, 50);
    for _ in 0..2 {
        simulation.restore(&data).unwrap();
        assert_eq!(fly(&mut simulation, 50), wanted);
    }
    // obstacles of another shape
    let among = |shape| {
        let obstacle = Obstacle::new(shape, Vector3::new(3.0, 0.0, 1.0));
        Simulation::builder(DroneModel::Cf2x).obstacles([obstacle]).build().unwrap()
    };
    // that have moved: others are the model's
    let mut ball = among(Shape::Sphere { radius: 0.2 });
    ball.set_obstacles(&[Obstacle::new(Shape::Sphere { radius: 0.2 }, Vector3::new(2.0, 0.0, 1.0))]).unwrap();
    let ball = ball.snapshot();
    let error = among(Shape::Box { half_size: [0.2; 3] }).restore(&ball).unwrap_err().to_string();
    assert!(error.contains("another shape"), "{error}");
    let mut two = build(2);
    let states = two.states().to_vec();
    assert!(two.restore(&data).unwrap_err().to_string().contains("the snapshot has 3 entries"), "two drones");
    assert_eq!(two.states(), states);
}

#[test]
fn a_snapshot_of_another_environment_is_refused() {
    let snapshot = |name: &str| {
        let mut env = make(name, EnvConfig::default()).unwrap();
        env.reset(Some(1)).unwrap();
        env.snapshot()
    };
    let mut hover = make("hover", EnvConfig::default()).unwrap();
    hover.reset(Some(1)).unwrap();
    let before = flight(&mut *make_reset("hover"), 3, 10);
    let error = hover.restore(&snapshot("race")).unwrap_err().to_string();
    assert!(error.contains("another kind of environment"), "{error}");
    assert!(flight(&mut *hover, 3, 10) == before, "and nothing has changed");
    // of the same task with other actions, or with other observations
    for config in [
        EnvConfig::default().action_type(ActionType::Vel),
        EnvConfig::default().observation_type(ObservationType::KIN_RANGES),
    ] {
        let mut other = make("hover", config).unwrap();
        other.reset(Some(1)).unwrap();
        assert!(hover.restore(&other.snapshot()).unwrap_err().to_string().contains("another kind of environment"));
    }
    let mut multi = make("multi_hover", EnvConfig::default().num_drones(3)).unwrap();
    multi.reset(Some(1)).unwrap();
    assert!(multi.restore(&snapshot("multi_hover")).is_err(), "two drones for three");
}

fn make_reset(name: &str) -> Box<dyn DroneEnv + Send> {
    let mut env = make(name, EnvConfig::default()).unwrap();
    env.reset(Some(1)).unwrap();
    env
}
