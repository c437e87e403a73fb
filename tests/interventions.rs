//! Interventions in the running episode of an environment: pushes, failed motors, new obstacles. A reset ends them.

mod common;

use common::step_env;
use mujoco_drones_gym::control::CollisionCone;
use mujoco_drones_gym::env::{EnvSnapshot, Randomization};
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::world::{Obstacle, ObstacleConfig, ObstacleKind, Shape};
use mujoco_drones_gym::wrappers::SafetyWrapper;
use nalgebra::Vector3;

const FORCE: Vector3<f64> = Vector3::new(0.02, -0.03, 0.01);

fn forest(new_layout: bool) -> ObstacleConfig {
    ObstacleConfig { arena: [4.0, 4.0, 2.0], new_layout, ..ObstacleConfig::new(ObstacleKind::Forest) }
}

/// Returns the bits of an episode of 60 steps.
fn episode(env: &mut dyn DroneEnv, seed: u64) -> Vec<u64> {
    env.reset(Some(seed)).unwrap();
    flight(env, 60)
}

/// Returns the bits of the next steps of a running episode.
fn flight(env: &mut dyn DroneEnv, steps: usize) -> Vec<u64> {
    let mut out = Vec::new();
    for _ in 0..steps {
        if env.info().end.is_none() {
            out.push(env.step(&[0.02, 0.03, 0.01, 0.02]).unwrap().reward.to_bits());
        }
        out.extend(env.observation().vector.iter().map(|x| x.to_bits()));
    }
    out
}

type Intervention = fn(&mut dyn DroneEnv);

/// Every intervention acts on the running episode, is part of a snapshot, and ends with the episode.
#[test]
fn a_reset_ends_every_intervention_of_an_environment() {
    let push = |env: &mut dyn DroneEnv| env.set_external_force(0, FORCE).unwrap();
    let fail = |env: &mut dyn DroneEnv| env.set_motor_gain(0, 1, 0.9).unwrap();
    let plant = |env: &mut dyn DroneEnv| env.new_obstacles(8).unwrap();
    let interventions: [(&str, Intervention); 3] = [("push", push), ("fail", fail), ("plant", plant)];
    let hover = || Hover::builder().engine(EngineKind::Hybrid).initial_positions([[0.0, 0.0, 1.0]]);
    for new_layout in [false, true] {
        for randomization in [None, Some(Randomization::default())] {
            let build = || hover().obstacle_generator(forest(new_layout)).randomization(randomization.clone()).build();
            let mut fresh = build().unwrap();
            let expected = [1, 2].map(|seed| episode(&mut fresh, seed));
            let layout = fresh.simulation().obstacles().to_vec();
            for (name, intervene) in interventions {
                let mut env = build().unwrap();
                env.reset(Some(1)).unwrap();
                let first = flight(&mut env, 10);
                assert!(expected[0].starts_with(&first), "{name}");
                let states = env.simulation().states().to_vec();
                intervene(&mut env);
                assert_eq!(env.simulation().states(), states, "{name}");
                let snapshot = env.snapshot();
                let second = flight(&mut env, 50);
                if name != "plant" {
                    assert_ne!([first, second.clone()].concat(), expected[0], "{name}");
                }
                let changed = env.simulation().obstacles().to_vec();
                // in another environment, from the text of the snapshot
                let mut other = build().unwrap();
                let text = serde_json::to_string(&snapshot).unwrap();
                other.restore(&serde_json::from_str::<EnvSnapshot>(&text).unwrap()).unwrap();
                assert_eq!(flight(&mut other, 50), second, "{name}");
                assert_eq!(other.simulation().obstacles(), changed, "{name}");
                for mut env in [env, other] {
                    assert_eq!(episode(&mut env, 2), expected[1], "{name}");
                    assert_eq!(env.simulation().obstacles(), layout, "{name}");
                }
            }
        }
    }
}

#[test]
fn new_obstacles_leave_the_drones_free_and_other_obstacles_are_refused() {
    let generator = ObstacleConfig { safe_zone: 0.0, count: 40, spacing: 0.05, ..forest(false) };
    let positions = [[0.0, 0.0, 1.0], [0.6, 0.0, 1.0], [0.0, 0.7, 1.0]];
    let builder = MultiHover::builder().num_drones(3).initial_positions(positions).obstacle_generator(generator);
    let mut env: Box<dyn DroneEnv> = Box::new(builder.build().unwrap());
    env.reset(Some(1)).unwrap();
    let radius = DroneModel::Cf2x.params().collision_radius.hypot(0.5 * DroneModel::Cf2x.params().collision_height);
    for seed in 0..200 {
        env.new_obstacles(seed).unwrap();
        for drone in 0..3 {
            assert!(env.simulation().obstacle_distance(drone) > radius, "seed {seed}");
        }
    }
    let obstacles = env.simulation().obstacles().to_vec();
    let place = env.simulation().states()[1].position;
    // moving one obstacle onto a drone is refused, away from all drones it is not
    let mut moved = obstacles.clone();
    moved[5].position = Vector3::new(place.x + 0.02, place.y, moved[5].position.z);
    let error = env.set_obstacles(&moved).unwrap_err().to_string();
    assert!(error.starts_with("obstacles is obstacle 5 at -0.0"), "{error}");
    assert!(error.ends_with("of drone 1, expected obstacles that do not overlap a drone"), "{error}");
    assert!(env.set_obstacles(&moved[..5]).is_err());
    assert_eq!(env.simulation().obstacles(), obstacles);
    moved[5].position = Vector3::new(9.0, 9.0, 1.0);
    env.set_obstacles(&moved).unwrap();
    assert_eq!(env.simulation().obstacles(), moved);
    step_env(&mut *env, &[0.0; 12], 3);
}

/// An obstacle moved into the path of a drone is an obstacle for both engines.
#[test]
fn a_drone_meets_an_obstacle_that_was_moved_into_its_path_in_both_engines() {
    let ball = |x| Obstacle::new(Shape::Sphere { radius: 0.2 }, Vector3::new(x, 0.0, 1.0));
    let times = EngineKind::WITH_CONTACTS.map(|engine| {
        let builder = Hover::builder().engine(engine).initial_positions([[0.0, 0.0, 1.0]]).obstacles([ball(5.0)]);
        let mut env = builder.build().unwrap();
        env.reset(Some(1)).unwrap();
        env.set_external_force(0, Vector3::new(0.05, 0.0, 0.0)).unwrap();
        step_env(&mut env, &[0.0; 4], 5);
        env.set_obstacles(&[ball(0.6)]).unwrap();
        while env.info().end.is_none() {
            env.step(&[0.0; 4]).unwrap();
        }
        assert_eq!(env.info().end, Some(EndReason::ObstacleContact), "{engine}");
        env.simulation().control_steps()
    });
    assert_eq!(times[0], times[1]);
}

#[test]
fn environments_refuse_interventions_with_the_reason() {
    let error = |result: Result<(), EnvError>| result.unwrap_err().to_string();
    let mut env = Hover::builder().build().unwrap();
    env.reset(Some(1)).unwrap();
    let expected = "drone 1 does not exist, expected an index from 0 to 0";
    assert_eq!(error(env.set_external_force(1, FORCE)), expected);
    assert_eq!(error(env.set_motor_gain(1, 0, 0.0)), expected);
    assert_eq!(error(env.set_motor_gain(0, 9, 0.0)), "motor is 9, expected an index from 0 to 3");
    let expected = "expected a generator of random obstacles in the options of the environment";
    assert_eq!(error(env.new_obstacles(1)), format!("obstacle_generator is none, {expected}"));
    let ball = Obstacle::new(Shape::Sphere { radius: 0.2 }, Vector3::new(3.0, 0.0, 1.0));
    assert!(error(env.set_obstacles(&[ball])).starts_with("obstacles has 1 entry"));
    let capsule = |half_height| Obstacle { shape: Shape::Capsule { radius: 0.1, half_height }, ..ball };
    let mut with_capsule = Hover::builder().obstacles([capsule(0.2)]).build().unwrap();
    with_capsule.reset(Some(1)).unwrap();
    for (half_height, got) in [(-1.0, "-1"), (f64::NAN, "NaN")] {
        assert!(!capsule(half_height).distance(&Vector3::z()).is_nan());
        let expected = format!("the size of obstacle 0 is {got}, expected 0.0001 to 10,000 m");
        let got = error(with_capsule.set_obstacles(&[capsule(half_height)]));
        assert!(got.ends_with(&expected), "{got}");
    }
    let custom = ObstacleConfig { custom: vec![ball], ..ObstacleConfig::new(ObstacleKind::Custom) };
    let mut env = Hover::builder().obstacle_generator(custom).build().unwrap();
    env.reset(Some(1)).unwrap();
    assert_eq!(error(env.new_obstacles(1)), format!("obstacle_generator is a custom list, {expected}"));
    // a forest without room
    let full = ObstacleConfig { count: 4, arena: [0.9, 0.9, 2.0], safe_zone: 0.7, ..forest(false) };
    let mut env = Hover::builder().initial_positions([[3.0, 0.0, 1.0]]).obstacle_generator(full).build().unwrap();
    env.reset(Some(1)).unwrap();
    env.set_external_force(0, Vector3::new(-0.1, 0.0, 0.0)).unwrap();
    while env.simulation().states()[0].position.x > 0.05 {
        env.step(&[0.0; 4]).unwrap();
    }
    assert!(error(env.new_obstacles(1)).contains("obstacles fit into"));
}

#[test]
fn wrappers_forward_every_intervention() {
    let builder = Antipodal::builder().num_drones(2).action_type(ActionType::Vel).obstacle_generator(forest(false));
    let env = builder.controller(ControllerKind::Geometric).build().unwrap();
    let mut env: Box<dyn DroneEnv> = Box::new(SafetyWrapper::new(env, CollisionCone::new(0.4)).unwrap());
    env.reset(Some(1)).unwrap();
    env.set_external_force(1, FORCE).unwrap();
    env.set_motor_gain(0, 2, 0.7).unwrap();
    env.new_obstacles(5).unwrap();
    assert_eq!((env.simulation().external_force(1), env.simulation().motor_gains(0)[2]), (FORCE, 0.7));
    let obstacles = env.simulation().obstacles().to_vec();
    env.set_obstacles(&obstacles).unwrap();
}

/// Changed gains and obstacles act on one environment of a batch until its next episode. A force is refused.
#[test]
fn a_batch_takes_gains_and_obstacles_of_one_environment_and_refuses_a_force() {
    let builder = || Hover::builder().engine(EngineKind::Hybrid).obstacle_generator(forest(false)).episode_seconds(0.5);
    let (mut batch, mut buffers) = common::reset_batch(
        builder(),
        VecConfig { threads: 1, autoreset: Autoreset::NextStep, ..VecConfig::new(10) },
        1,
    );
    let mut twin = builder().build().unwrap();
    let mut plain = builder().build().unwrap();
    for env in [&mut twin, &mut plain] {
        batch.with(3, |other| env.restore(&other.snapshot()).unwrap()).unwrap();
    }
    let change = |env: &mut dyn DroneEnv| {
        env.set_motor_gain(0, 1, 0.8).unwrap();
        env.new_obstacles(9).unwrap();
    };
    batch.with(3, |env| change(env)).unwrap();
    change(&mut twin);
    let actions = vec![0.1_f32; 40];
    let action = [f64::from(0.1_f32); 4];
    for step in 0..60 {
        batch.step(&actions, buffers.step()).unwrap();
        for env in [&mut twin, &mut plain] {
            if env.info().end.is_some() {
                env.reset(None).unwrap()
            } else {
                env.step(&action).unwrap().observation
            };
        }
        let row = |index: usize| buffers.observations[12 * index..12 * (index + 1)].to_vec();
        let of = |env: &Aviary<Hover>| env.observation().vector.iter().map(|&x| x as f32).collect::<Vec<_>>();
        assert_eq!(row(3), of(&twin), "step {step}");
        assert!(step != 3 || row(3) != of(&plain), "the changes act");
    }
    assert_eq!(twin.simulation().motor_gains(0), &[1.0; 4], "the second episode has all motors");
    let refused = batch.with(2, |env| env.set_external_force(0, FORCE).unwrap()).unwrap_err().to_string();
    let expected = "an environment that is not in a batch";
    assert_eq!(refused, format!("external_force is set in an environment of a batch, expected {expected}"));
    assert_eq!(batch.with(2, |env| env.simulation().external_force(0)).unwrap(), Vector3::zeros());
    batch.step(&actions, buffers.step()).unwrap();
}
