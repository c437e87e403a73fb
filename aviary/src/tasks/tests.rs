use rand::{RngExt as _, SeedableRng as _};

use super::{NAMES, make, summary};
use crate::env::{DroneEnv, EndReason, EnvConfig, Rng};
use crate::rollout::{ControllerPolicy, Policy as _};

/// Names of the terms of a task's reward, in their order.
fn terms_of(task: &str) -> &'static [&'static str] {
    match task {
        "hover" | "multi_hover" | "multi_agent" => {
            &["height_error", "horizontal_error", "speed", "tilt", "at_target", "crash"]
        }
        "velocity" => &["velocity_error", "yaw_rate_error", "tilt", "tracked", "crash"],
        "fly_through" => &["capture", "distance", "angular_velocity", "crash"],
        "formation" => &["slot_error", "distance_errors", "crash"],
        "race" => &["gate", "speed", "distance", "crash"],
        "antipodal" => &["distance", "at_goal", "too_close", "crash"],
        "stabilize" => &["speed", "angular_velocity", "tilt", "at_rest", "crash"],
        "track" => &["position_error", "velocity_error", "tilt", "tracked", "crash"],
        other => panic!("{other} has no list of terms"),
    }
}

/// Checks the terms of every drone after a step, and notes which of them were not zero.
fn check(env: &dyn DroneEnv, reward: f64, seen: &mut [bool]) {
    let expected = terms_of(env.name());
    let drones = 0..env.simulation().num_drones();
    for drone in drones.clone() {
        let terms = env.reward_terms(drone);
        let names: Vec<_> = terms.iter().map(|(name, _)| *name).collect();
        assert_eq!(names, expected, "{}", env.name());
        let (sum, of_drone) = (terms.iter().map(|(_, value)| value).sum::<f64>(), env.drone_reward(drone));
        assert!(sum == of_drone, "{}: {terms:?} add up to {sum}, expected {of_drone}", env.name());
        let penalty = if env.drone_end(drone).is_some_and(EndReason::is_crash) { -100.0 } else { 0.0 };
        assert_eq!(terms.last(), Some(&("crash", penalty)));
        for (seen, (_, value)) in seen.iter_mut().zip(&terms) {
            *seen |= *value != 0.0;
        }
    }
    let sum: f64 = drones.map(|drone| env.drone_reward(drone)).sum();
    assert!(sum == reward, "{}: {sum}, expected {reward}", env.name());
}

/// Flies an episode with the controllers of the task, from a yaw that is not zero. `wild` is the share of control steps
/// with random actions, and `failure` the step in which a motor of the last drone fails.
fn fly(task: &str, drones: usize, wild: f64, failure: Option<u64>, seen: &mut [bool]) {
    let rpys: Vec<_> = (0..drones).map(|drone| [0.0, 0.0, 0.7 - 1.3 * drone as f64]).collect();
    let config = EnvConfig::default().num_drones(drones).initial_rpys(rpys).episode_seconds(16.0);
    let mut env = make(task, config).unwrap();
    let mut rng = Rng::seed_from_u64(drones as u64);
    env.reset(Some(7)).unwrap();
    let mut policy = ControllerPolicy::new(summary(task).unwrap().defaults.controller, &env);
    policy.reset(&env).unwrap();
    assert_eq!(env.reward_terms(drones - 1), [], "before the first step");
    let mut action = vec![0.0; env.action_space().size()];
    while env.info().end.is_none() {
        policy.act(&env, &mut action).unwrap();
        if rng.random_bool(wild) {
            action.iter_mut().for_each(|entry| *entry = rng.random_range(-1.0..1.0));
        }
        if failure == Some(env.simulation().control_steps()) {
            env.set_motor_gain(drones - 1, 2, 0.0).unwrap();
        }
        let reward = env.step(&action).unwrap().reward;
        check(&*env, reward, seen);
    }
    let (last, snapshot) = (env.reward_terms(0), env.snapshot());
    env.reset(None).unwrap();
    assert_eq!(env.reward_terms(0), []);
    env.restore(&snapshot).unwrap();
    assert_eq!(env.reward_terms(0), last);
}

#[test]
fn the_terms_of_every_task_add_up_to_its_reward() {
    for task in NAMES {
        let names = terms_of(task);
        assert!(names.iter().enumerate().all(|(index, name)| !names[..index].contains(name)), "{task}");
        let mut seen = vec![false; names.len()];
        let counts: &[usize] = if task == "hover" { &[1] } else { &[1, 2, 3] };
        for &drones in counts {
            fly(task, drones, 0.0, None, &mut seen);
            fly(task, drones, 0.3, None, &mut seen);
            fly(task, drones, 0.0, Some(100), &mut seen);
        }
        for (name, seen) in names.iter().zip(seen) {
            assert!(seen, "{task}: {name} was zero in every step");
        }
    }
}

#[test]
fn an_environment_without_a_task_has_no_terms() {
    let mut env = make(super::BASE, EnvConfig::default()).unwrap();
    env.reset(Some(1)).unwrap();
    assert_eq!(env.step(&[0.0; 4]).unwrap().reward, 0.0);
    assert_eq!(env.reward_terms(0), []);
}
