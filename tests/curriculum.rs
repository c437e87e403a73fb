//! The curriculum follows what its episodes bring, up and down, and can be saved and restored.

use mujoco_drones_gym::env::{Randomization, check_env};
use mujoco_drones_gym::physics::wind::{WindConfig, WindModel};
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::world::ObstacleConfig;
use mujoco_drones_gym::wrappers::{CurriculumConfig, CurriculumMetric, CurriculumState, CurriculumWrapper};

/// The target rises by 20 cm with every level.
fn rise(env: &mut Aviary<Hover>, level: usize) -> Result<(), EnvError> {
    env.task_mut().target_height = 1.0 + 0.2 * level as f64;
    Ok(())
}

type Rising = CurriculumWrapper<Aviary<Hover>, fn(&mut Aviary<Hover>, usize) -> Result<(), EnvError>>;

fn rising(config: CurriculumConfig) -> Rising {
    let hover = Hover::builder().initial_positions([[0.0, 0.0, 1.0]]).episode_seconds(0.25).build().unwrap();
    CurriculumWrapper::new(hover, config, rise as fn(&mut Aviary<Hover>, usize) -> Result<(), EnvError>).unwrap()
}

/// An episode at hover: at the target on level 0, below it on the others.
fn episode(env: &mut Rising, action: f64) {
    env.reset(None).unwrap();
    while env.info().end.is_none() {
        env.step(&[action; 4]).unwrap();
    }
}

#[test]
fn it_advances_on_success_after_a_whole_window_and_retreats_on_failure() {
    let config =
        CurriculumConfig { levels: 3, window: 4, advance: 0.75, retreat: Some(0.25), ..CurriculumConfig::default() };
    let mut env = rising(config);
    for done in 1..4 {
        episode(&mut env, 0.0);
        assert_eq!((env.state().level, env.mean()), (0, Some(1.0)), "after {done} episodes");
    }
    episode(&mut env, 0.0);
    assert_eq!((env.state().level, env.state().advances, env.mean()), (1, 1, None));
    // hovering where level 0 was is no success on level 1: four episodes later it is back
    env.reset(None).unwrap();
    assert!((env.reference(0).position.z - 1.2).abs() < 1e-12, "the difficulty has been set");
    for _ in 0..4 {
        episode(&mut env, 0.0);
    }
    assert_eq!((env.state().level, env.state().retreats), (0, 1));
    assert_eq!((env.state().episodes, &env.state().episodes_per_level[..]), (8, &[4, 4, 0][..]));
    // an episode that is left in its middle does not count
    env.reset(None).unwrap();
    env.step(&[0.0; 4]).unwrap();
    env.reset(None).unwrap();
    assert_eq!(env.state().episodes, 8);
}

#[test]
fn it_never_leaves_its_levels_and_goes_by_reward_or_length_as_well() {
    for (metric, advance) in [(CurriculumMetric::Reward, 5.0), (CurriculumMetric::EpisodeLength, 12.0)] {
        let config = CurriculumConfig { levels: 2, window: 2, metric, advance, retreat: None };
        let mut env = rising(config);
        for _ in 0..10 {
            // 12 steps at the target: 0.5 each
            episode(&mut env, 0.0);
            assert!(env.state().level < 2);
        }
        assert_eq!((env.state().level, env.state().advances), (1, 1), "{metric:?}: {:?}", env.state());
    }
}

#[test]
fn saved_and_restored_it_goes_on_as_if_nothing_had_happened() {
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
fn it_keeps_the_contract_and_its_difficulty_may_be_wind() {
    let blow = |env: &mut Box<dyn DroneEnv + Send>, level: usize| {
        let wind = WindConfig { velocity: [1.0 + level as f64, 0.0, 0.0], ..WindConfig::new(WindModel::Combined) };
        env.set_wind(Some(wind))
    };
    for name in mujoco_drones_gym::tasks::NAMES {
        let env = make(name, EnvConfig::default().episode_seconds(2.0)).unwrap();
        check_env(&mut CurriculumWrapper::new(env, CurriculumConfig::default(), blow).unwrap()).unwrap();
    }
    // and over everything else at once
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
        // a drawn wind would replace the one that is set
        let drawn = Randomization { environment: None, ..Randomization::default() };
        env.set_randomization(Some(drawn)).unwrap();
        let easy = |_: &mut Box<dyn DroneEnv + Send>, _: usize| Ok(());
        check_env(&mut CurriculumWrapper::new(env, CurriculumConfig::default(), easy).unwrap()).unwrap();
    }
    let fails = |_: &mut Aviary<Hover>, _: usize| Err(EnvError::NeedsReset { when: "never" });
    let mut env =
        CurriculumWrapper::new(Hover::builder().build().unwrap(), CurriculumConfig::default(), fails).unwrap();
    assert!(env.reset(None).is_err());
}

#[test]
fn impossible_curricula_are_refused() {
    let refused = |config: CurriculumConfig, text: &str| {
        assert!(config.validate().unwrap_err().to_string().contains(text));
    };
    refused(CurriculumConfig { levels: 0, ..CurriculumConfig::default() }, "levels is 0");
    refused(CurriculumConfig { window: 0, ..CurriculumConfig::default() }, "window is 0");
    refused(CurriculumConfig { advance: f64::NAN, ..CurriculumConfig::default() }, "advance is NaN");
    refused(CurriculumConfig { retreat: Some(0.9), ..CurriculumConfig::default() }, "retreat is 0.9");
    refused(CurriculumConfig { retreat: Some(f64::NAN), ..CurriculumConfig::default() }, "retreat is NaN");
}
