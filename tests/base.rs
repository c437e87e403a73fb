//! Options of tasks by name, and the environment without a task.

use mujoco_drones_gym::action::ActionType;
use mujoco_drones_gym::env::{DroneEnv, EndReason, Env, EnvConfig, EnvError, TaskOptions, check_env};
use mujoco_drones_gym::multi_agent::make_parallel;
use mujoco_drones_gym::observation::kinematic;
use mujoco_drones_gym::tasks::{BASE, Base, NAMES, make};
use mujoco_drones_gym::vector::{VecBuffers, VecConfig, make_vec};

fn with(set: impl FnOnce(&mut TaskOptions)) -> EnvConfig {
    EnvConfig::default().task(set)
}

#[test]
fn every_option_reaches_its_task_by_name() {
    let points = vec![[0.0, 0.0, 1.0], [0.5, 0.0, 1.0], [0.5, 0.5, 1.0]];
    let cases = [
        ("hover", TaskOptions { target_height: Some(1.25), ..TaskOptions::default() }),
        ("multi_hover", TaskOptions { target_heights: Some(vec![0.5, 1.5]), ..TaskOptions::default() }),
        ("fly_through", TaskOptions { waypoints: Some(points.clone()), ..TaskOptions::default() }),
        ("race", TaskOptions { gates: Some(points), laps: Some(3), ..TaskOptions::default() }),
    ];
    for (name, options) in cases {
        let config = with(|own| own.clone_from(&options));
        assert_eq!(make(name, config.clone()).unwrap().task_options(), options, "{name}");
        make_vec(name, config.clone(), VecConfig::new(2)).unwrap();
        make_parallel(name, config).unwrap();
        for other in NAMES.into_iter().chain([BASE]).filter(|other| *other != name) {
            let is_same = matches!((name, other), ("multi_hover", "multi_agent"));
            let made = make(other, with(|own| own.clone_from(&options)));
            let error = made.err();
            let is_refused = matches!(error, Some(EnvError::TaskOption { task, .. }) if task == other);
            assert!(is_refused || is_same, "{name} {other}: {error:?}");
        }
    }
}

#[test]
fn batches_and_agents_have_the_options() {
    let config = || with(|own| own.target_heights = Some(vec![0.5, 1.5]));
    let mut batch = make_vec("multi_hover", config(), VecConfig::new(3)).unwrap();
    let mut buffers = VecBuffers::new(&*batch);
    batch.reset(Some(1), &mut buffers.observations).unwrap();
    for row in buffers.observations.chunks_exact(26) {
        assert_eq!([row[12], row[25]], [0.5, 1.5]);
    }
    let mut agents = make_parallel("multi_hover", config()).unwrap();
    let (observations, _) = agents.reset(Some(1)).unwrap();
    assert_eq!(observations.get("drone1").unwrap().vector[12], 1.5);
}

#[test]
fn target_heights_change_during_an_episode_and_wrong_ones_change_nothing() {
    let mut env = make("hover", with(|own| own.target_height = Some(2.0))).unwrap();
    env.reset(Some(1)).unwrap();
    let height = |target_height| TaskOptions { target_height: Some(target_height), ..TaskOptions::default() };
    let far = env.step(&[0.0; 4]).unwrap().reward;
    env.set_task_options(&height(0.1)).unwrap();
    let near = env.step(&[0.0; 4]).unwrap().reward;
    assert!((far + 1.9).abs() < 1e-3 && near > 0.49, "{far} {near}");
    for wrong in [height(-1.0), height(f64::NAN), height(3.0)] {
        let error = env.set_task_options(&wrong).unwrap_err();
        assert!(matches!(error, EnvError::Option { option: "target_height", .. }), "{error}");
    }
    let error = env.set_task_options(&TaskOptions { laps: Some(1), ..TaskOptions::default() }).unwrap_err();
    assert!(error.to_string().starts_with("laps is set after the environment was built"), "{error}");
    assert_eq!(env.task_options(), height(0.1));
    assert_eq!(env.step(&[0.0; 4]).unwrap().reward, near);
    // the next episode has the new target as well
    env.reset(None).unwrap();
    assert!(env.step(&[0.0; 4]).unwrap().reward > 0.49);
}

#[test]
fn the_environment_without_a_task_has_states_and_no_end() {
    let mut env =
        make(BASE, EnvConfig::default().num_drones(2).initial_positions([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0]])).unwrap();
    assert_eq!((env.name(), env.action_type()), (BASE, ActionType::RawRpm));
    let max_rpm = env.simulation().params(0).max_rpm();
    assert_eq!((env.action_space().low(), env.action_space().high()), (&[0.0; 8][..], &[max_rpm; 8][..]));
    env.reset(Some(1)).unwrap();
    // from 1 m with the motors off: the floor does not end the episode
    for step in 0..200 {
        let action = [f64::from(step); 8];
        let step = env.step(&action).unwrap();
        assert_eq!((step.reward, step.terminated, step.truncated), (0.0, false, false));
        let observed = step.observation.vector.clone();
        assert!(env.observation_space().vector.contains(&observed));
        let simulation = env.simulation();
        for (drone, block) in observed.chunks_exact(20).enumerate() {
            assert_eq!(block, kinematic(&simulation.states()[drone], &simulation.motor_speeds()[drone]));
            assert_eq!(block[16..], action[..4]);
        }
    }
    assert!(env.simulation().states()[0].position.z < 0.1 && env.info().end.is_none());
    let mut short = make(BASE, EnvConfig::default().episode_seconds(0.5)).unwrap();
    short.reset(Some(1)).unwrap();
    while !short.step(&[0.0; 4]).unwrap().truncated {}
    assert_eq!((short.info().end, short.simulation().control_steps()), (Some(EndReason::TimeLimit), 24));
}

#[test]
fn the_environment_without_a_task_keeps_the_contract() {
    let start = [[0.0, 0.0, 5.0]];
    check_env(&mut Base::builder().initial_positions(start).episode_seconds(1.0).build().unwrap()).unwrap();
    let config = EnvConfig::default().initial_positions(start);
    let mut batch = make_vec(BASE, config, VecConfig::new(2)).unwrap();
    let mut buffers = VecBuffers::new(&*batch);
    batch.reset(Some(1), &mut buffers.observations).unwrap();
    batch.step(&[14_000.0; 8], buffers.step()).unwrap();
    assert_eq!(buffers.observations[16..20], [14_000.0; 4]);
    assert_eq!(buffers.rewards, [0.0; 2]);
}
