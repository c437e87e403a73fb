//! Curriculum: changes of level by results of episodes, saving, restoring, and the contract of environments.

mod common;

use common::step_to_end;
use mujoco_drones_gym::env::{Randomization, check_env};
use mujoco_drones_gym::physics::wind::{WindConfig, WindModel};
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::world::ObstacleConfig;
use mujoco_drones_gym::wrappers::{CurriculumConfig, CurriculumMetric, CurriculumState, CurriculumWrapper};

/// Raises the target height by 20 cm per level.
fn rise(env: &mut Aviary<Hover>, level: usize) -> Result<(), EnvError> {
    env.task_mut().target_height = 1.0 + 0.2 * level as f64;
    Ok(())
}

type Rising = CurriculumWrapper<Aviary<Hover>, fn(&mut Aviary<Hover>, usize) -> Result<(), EnvError>>;

/// Creates a Hover environment with a curriculum of target heights.
fn rising(config: CurriculumConfig) -> Rising {
    let hover = Hover::builder().initial_positions([[0.0, 0.0, 1.0]]).episode_seconds(0.25).build().unwrap();
    CurriculumWrapper::new(hover, config, rise as fn(&mut Aviary<Hover>, usize) -> Result<(), EnvError>).unwrap()
}

/// Flies an episode with a constant action. A drone that hovers reaches the target on level 0 only.
fn episode(env: &mut Rising, action: f64) {
    env.reset(None).unwrap();
    step_to_end(env, &[action; 4]);
}

#[test]
fn curriculum_advances_after_a_successful_window_and_retreats_after_a_failed_one() {
    let config =
        CurriculumConfig { levels: 3, window: 4, advance: 0.75, retreat: Some(0.25), ..CurriculumConfig::default() };
    let mut env = rising(config);
    for done in 1..4 {
        episode(&mut env, 0.0);
        assert_eq!((env.state().level, env.mean()), (0, Some(1.0)), "after {done} episodes");
    }
    episode(&mut env, 0.0);
    assert_eq!((env.state().level, env.state().advances, env.mean()), (1, 1, None));
    // hovering at the height of level 0 fails on level 1: the curriculum retreats after four episodes
    env.reset(None).unwrap();
    assert!((env.reference(0).position.z - 1.2).abs() < 1e-12, "level 1 raises the target");
    for _ in 0..4 {
        episode(&mut env, 0.0);
    }
    assert_eq!((env.state().level, env.state().retreats), (0, 1));
    assert_eq!((env.state().episodes, &env.state().episodes_per_level[..]), (8, &[4, 4, 0][..]));
    // an unfinished episode does not count
    env.reset(None).unwrap();
    env.step(&[0.0; 4]).unwrap();
    env.reset(None).unwrap();
    assert_eq!(env.state().episodes, 8);
}

#[test]
fn curriculum_level_stays_within_its_levels_for_reward_and_episode_length() {
    for (metric, advance) in [(CurriculumMetric::Reward, 5.0), (CurriculumMetric::EpisodeLength, 12.0)] {
        let config = CurriculumConfig { levels: 2, window: 2, metric, advance, ..CurriculumConfig::default() };
        let mut env = rising(config);
        for _ in 0..10 {
            // 12 steps at the target with a reward of 0.5 each
            episode(&mut env, 0.0);
            assert!(env.state().level < 2);
        }
        assert_eq!((env.state().level, env.state().advances), (1, 1), "{metric:?}: {:?}", env.state());
    }
}

#[test]
fn a_restored_curriculum_continues_like_an_uninterrupted_one() {
    let config = CurriculumConfig { window: 3, ..CurriculumConfig::default() };
    let (mut whole, mut first, mut second) = (rising(config), rising(config), rising(config));
    for index in 0..7 {
        episode(&mut whole, 0.0);
        if index < 2 {
            episode(&mut first, 0.0);
        }
    }
    let text = serde_json::to_string(first.state()).unwrap();
    second.restore_state(serde_json::from_str::<CurriculumState>(&text).unwrap()).unwrap();
    for _ in 2..7 {
        episode(&mut second, 0.0);
    }
    assert_eq!(second.state(), whole.state());
    let foreign = CurriculumState { level: 9, ..first.state().clone() };
    assert!(second.restore_state(foreign).unwrap_err().to_string().contains("level 9 of 5"));
    assert_eq!(second.state(), whole.state());
}

#[test]
fn a_curriculum_keeps_the_contract_with_wind_obstacles_and_randomization() {
    let blow = |env: &mut Box<dyn DroneEnv + Send>, level: usize| {
        let wind = WindConfig { velocity: [1.0 + level as f64, 0.0, 0.0], ..WindConfig::new(WindModel::Combined) };
        env.set_wind(Some(wind))
    };
    for name in mujoco_drones_gym::tasks::NAMES {
        let env = make(name, EnvConfig::default().episode_seconds(2.0)).unwrap();
        check_env(&mut CurriculumWrapper::new(env, CurriculumConfig::default(), blow).unwrap()).unwrap();
    }
    // a curriculum with wind, obstacles and randomization together
    for name in mujoco_drones_gym::tasks::NAMES {
        let field = ObstacleConfig {
            count: 15,
            arena: [10.0, 10.0, 2.0],
            safe_zone: 0.6,
            new_layout: true,
            ..Default::default()
        };
        let mut env = make(name, EnvConfig::default().episode_seconds(2.0).obstacle_generator(field)).unwrap();
        env.set_wind(Some(WindConfig::new(WindModel::Combined))).unwrap();
        // a sampled wind next to the configured wind is an error
        let randomization = Randomization { environment: None, ..Randomization::default() };
        env.set_randomization(Some(randomization)).unwrap();
        let easy = |_: &mut Box<dyn DroneEnv + Send>, _: usize| Ok(());
        check_env(&mut CurriculumWrapper::new(env, CurriculumConfig::default(), easy).unwrap()).unwrap();
    }
    let fails = |_: &mut Aviary<Hover>, _: usize| Err(EnvError::NeedsReset { when: "never" });
    let mut env =
        CurriculumWrapper::new(Hover::builder().build().unwrap(), CurriculumConfig::default(), fails).unwrap();
    assert!(env.reset(None).is_err());
}

#[test]
fn invalid_curricula_are_errors() {
    let refused = |config: CurriculumConfig, text: &str| {
        assert!(config.validate().unwrap_err().to_string().contains(text));
    };
    refused(CurriculumConfig { levels: 0, ..CurriculumConfig::default() }, "levels is 0");
    refused(CurriculumConfig { window: 0, ..CurriculumConfig::default() }, "window is 0");
    refused(CurriculumConfig { advance: f64::NAN, ..CurriculumConfig::default() }, "advance is NaN");
    refused(CurriculumConfig { retreat: Some(0.9), ..CurriculumConfig::default() }, "retreat is 0.9");
    refused(CurriculumConfig { retreat: Some(f64::NAN), ..CurriculumConfig::default() }, "retreat is NaN");
}
