//! Bit-identity of batches and single environments.

use mujoco_drones_gym::env::{AviaryBuilder, Randomization};
use mujoco_drones_gym::physics::actuators::ActuatorParams;
use mujoco_drones_gym::physics::wind::{WindConfig, WindModel};
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::tasks::{self, Antipodal};
use mujoco_drones_gym::vector::VecImages;
use mujoco_drones_gym::world::{Forcing, Medium, ObstacleConfig, ObstacleKind};

use super::common::{reset_batch, step_env};
use super::{Wander, bits, compare, compare_as_built, narrow, widen};

#[test]
fn batches_of_every_task_are_bit_identical_to_single_environments() {
    fn all<T: Task + Clone + Send + Sync>(task: T, ended: &mut usize) {
        for (physics, autoreset, environments, threads) in [
            (Physics::Mjc, Autoreset::NextStep, 13, 1),
            (Physics::MjcGndDragDw, Autoreset::SameStep, 19, 2),
            (Physics::Dyn, Autoreset::NextStep, 3, 2),
        ] {
            let builder = AviaryBuilder::new(task.clone()).physics(physics).episode_seconds(1.1);
            let config = VecConfig { autoreset, threads, ..VecConfig::new(environments) };
            let hybrid = builder.clone().engine(EngineKind::Hybrid);
            let builder = if physics == Physics::Dyn { builder } else { hybrid };
            *ended += compare_as_built(&builder, config, 80);
        }
    }
    let mut ended = 0;
    all(Hover::default(), &mut ended);
    all(Velocity::default(), &mut ended);
    all(MultiHover::default(), &mut ended);
    all(FlyThrough::default(), &mut ended);
    all(Formation::default(), &mut ended);
    all(Race::default(), &mut ended);
    all(MultiHover::multi_agent(), &mut ended);
    all(Antipodal::default(), &mut ended);
    all(Stabilize::default(), &mut ended);
    all(Track::default(), &mut ended);
    assert!(ended > 200, "{ended}");
}

#[test]
fn conditions_and_controllers_in_a_batch_are_bit_identical_to_single_environments() {
    let hover =
        || Hover::builder().initial_positions([[0.0, 0.0, 0.6]]).physics(Physics::MjcGndDragDw).episode_seconds(1.4);
    let bodies = Randomization { sensors: None, environment: None, actuators: None, ..Randomization::default() };
    let config = |threads| VecConfig { threads, autoreset: Autoreset::SameStep, ..VecConfig::new(11) };
    let forest = |new_layout| ObstacleConfig {
        count: 20,
        arena: [2.0, 2.0, 2.0],
        safe_zone: 0.3,
        new_layout,
        ..ObstacleConfig::new(ObstacleKind::Forest)
    };
    assert!(compare(&hover().randomization(bodies), config(2), 90) > 5);
    assert!(compare(&hover().randomization(Randomization::default()), config(2), 90) > 5);
    assert!(compare(&hover().wind(WindConfig::new(WindModel::Combined)), config(2), 90) > 5);
    assert!(compare(&hover().wind(WindConfig { still_air_drag: true, ..WindConfig::default() }), config(2), 90) > 5);
    let lag = ActuatorParams { lag: 0.03, gains: [1.0, 0.99, 1.0, 1.01], ..ActuatorParams::default() };
    assert!(compare(&hover().actuators(lag), config(1), 90) > 5);
    let late = ActuatorParams { latency: 0.02, ..ActuatorParams::default() };
    assert!(compare(&hover().actuators(late), config(2), 90) > 5);
    assert!(compare(&hover().obstacle_generator(forest(false)), config(2), 90) > 5);
    assert!(compare(&hover().obstacle_generator(forest(true)), config(2), 90) > 5);
    for kind in [ActionType::Vel, ActionType::Pid, ActionType::Attitude, ActionType::Ctbr, ActionType::OneDRpm] {
        compare(&hover().action_type(kind), config(2), 90);
    }
}

#[test]
fn batches_of_the_mujoco_engine_are_bit_identical_with_contacts() {
    // drones bounce on the floor, and contacts do not end the episode
    let builder = Hover::builder()
        .engine(EngineKind::Mujoco)
        .initial_positions([[0.0, 0.0, 0.3]])
        .task(|hover| (hover.crash.floor_contact, hover.crash.max_tilt) = (false, 4.0));
    for threads in [1, 2] {
        let (mut batch, mut buffers) = reset_batch(builder.clone(), VecConfig { threads, ..VecConfig::new(9) }, 1);
        let mut alone: Vec<_> = (0..9).map(|_| builder.clone().build().unwrap()).collect();
        alone.iter_mut().for_each(|env| {
            env.reset(Some(1)).unwrap();
        });
        let mut wander = Wander::new(8, 9, 4);
        let mut touched = 0;
        for _ in 0..150 {
            let actions: Vec<f32> = wander.next().iter().map(|x| x - 0.1).collect();
            batch.step(&actions, buffers.step()).unwrap();
            for (i, env) in alone.iter_mut().enumerate() {
                if env.info().end.is_some() {
                    env.reset(None).unwrap();
                } else {
                    env.step(&widen(&actions[4 * i..][..4])).unwrap();
                }
                touched += env.info().contacts;
                assert_eq!(bits(&narrow(&env.observation().vector)), bits(&buffers.observations[12 * i..][..12]));
            }
        }
        assert!(touched > 200, "{touched}");
    }
}

#[test]
fn results_are_bit_identical_for_any_number_of_threads() {
    let builder = || {
        MultiHover::builder()
            .num_drones(3)
            .physics(Physics::MjcGndDragDw)
            .randomization(Randomization { sensors: None, ..Randomization::default() })
    };
    let mut digests = Vec::new();
    for threads in [1, 2, 3, 5] {
        let (mut batch, mut buffers) = reset_batch(builder(), VecConfig { threads, ..VecConfig::new(100) }, 3);
        let mut wander = Wander::new(4, 100, 12);
        let mut digest = Vec::new();
        for _ in 0..60 {
            batch.step(wander.next(), buffers.step()).unwrap();
            digest.extend(bits(&buffers.observations));
            digest.extend(bits(&buffers.rewards));
        }
        digests.push(digest);
    }
    assert!(digests.windows(2).all(|pair| pair[0] == pair[1]));
}

#[test]
fn obstacle_distances_ranges_and_adjacency_follow_the_vector_in_a_row() {
    let field = ObstacleConfig { count: 4, arena: [4.0, 4.0, 2.0], ..ObstacleConfig::new(ObstacleKind::Forest) };
    let kind: ObservationType = "kin_obstacle_ranges_adjacency".parse().unwrap();
    let builder = MultiHover::builder().obstacle_generator(field).observation_type(kind);
    let (mut batch, mut buffers) = reset_batch(builder.clone(), VecConfig::new(9), 1);
    assert_eq!(batch.observation_size(), 26 + 2 + 20 + 4);
    batch.step(&[0.1; 72], buffers.step()).unwrap();
    let mut env = builder.engine(EngineKind::Hybrid).build().unwrap();
    env.reset(Some(1)).unwrap();
    env.step(&[0.1_f32 as f64; 8]).unwrap();
    let observation = env.observation();
    let mut row: Vec<f32> =
        observation.vector.iter().chain(&observation.obstacle).chain(&observation.ranges).map(|&x| x as f32).collect();
    row.extend(observation.adjacency.iter().map(|&near| f32::from(u8::from(near))));
    for i in 0..9 {
        assert_eq!(bits(&row), bits(&buffers.observations[52 * i..][..52]), "{i}");
    }
}

#[test]
fn make_vec_creates_a_batch_of_every_task() {
    for name in tasks::NAMES {
        let mut env = make_vec(name, EnvConfig::default(), VecConfig::new(10)).unwrap();
        let mut buffers = VecBuffers::new(&*env);
        env.reset(Some(1), &mut buffers.observations).unwrap();
        let actions = vec![0.0; 10 * env.action_size()];
        env.step(&actions, buffers.step()).unwrap();
        assert_eq!(env.name(), name);
        assert!(buffers.observations.iter().chain(&buffers.rewards).all(|x| x.is_finite()), "{name}");
    }
    let error = make_vec("nosuch", EnvConfig::default(), VecConfig::new(1)).err().unwrap().to_string();
    assert!(error.contains("nosuch") && error.contains("stabilize"), "{error}");
}

#[test]
fn images_of_a_batch_are_identical_to_those_of_single_environments() {
    let builder = || {
        Hover::builder()
            .initial_positions([[0.0, 0.0, 0.4]])
            .observation_type("kin_rgb_depth_segmentation".parse().unwrap())
            .obstacle_generator(ObstacleConfig { arena: [4.0, 4.0, 2.0], ..ObstacleConfig::new(ObstacleKind::Forest) })
    };
    let count = 9;
    let mut env = match VecAviary::new(builder(), VecConfig { threads: 2, ..VecConfig::new(count) }) {
        Ok(env) => env,
        // without OpenGL, the test passes without rendering
        Err(EnvError::Vision(_)) => return,
        Err(error) => panic!("{error}"),
    };
    let mut buffers = VecBuffers::new(&env);
    env.reset(Some(1), &mut buffers.observations).unwrap();
    let actions: Vec<f32> = (0..4 * count).map(|i| 0.02 * (i / 4) as f32 + 0.003 * (i % 4) as f32).collect();
    let pixels = env.camera_size().pixels();
    let mut rgb = vec![0; count * 4 * pixels];
    let (mut depth, mut segmentation) = (vec![0.0; count * pixels], vec![[0; 2]; count * pixels]);
    for _ in 0..15 {
        env.step(&actions, buffers.step()).unwrap();
    }
    env.render_images(VecImages { rgb: &mut rgb, depth: &mut depth, segmentation: &mut segmentation }).unwrap();
    for i in [0, 4, 8] {
        let mut alone = builder().engine(EngineKind::Hybrid).stream(i as u64).build().unwrap();
        alone.reset(Some(1)).unwrap();
        step_env(&mut alone, &widen(&actions[4 * i..][..4]), 15);
        let observation = alone.observation();
        assert_eq!(observation.rgb, rgb[4 * pixels * i..][..4 * pixels]);
        assert_eq!(observation.depth, depth[pixels * i..][..pixels]);
        assert_eq!(observation.segmentation, segmentation[pixels * i..][..pixels]);
    }
    assert_ne!(
        rgb[..4 * pixels],
        rgb[4 * 8 * pixels..][..4 * pixels],
        "environments with different actions have different images"
    );
    let error = env.render_images(VecImages::default()).unwrap_err().to_string();
    assert!(error.contains("rgb has 0 entries"), "{error}");
    assert_eq!(env.final_images(0), None);
}

#[test]
fn the_last_images_of_an_episode_are_those_of_a_single_environment() {
    let builder = || {
        let kind = "kin_rgb_depth".parse().unwrap();
        Hover::builder().observation_type(kind).episode_seconds(0.25).initial_positions([[0.0, 0.0, 0.5]])
    };
    let config = VecConfig { autoreset: Autoreset::SameStep, threads: 2, ..VecConfig::new(10) };
    let (mut batch, mut buffers) = reset_batch(builder(), config, 1);
    let actions: Vec<f32> = (0..40).map(|i| 0.01 * i as f32).collect();
    for _ in 0..batch.episode_steps() {
        assert_eq!(batch.final_images(0), None);
        batch.step(&actions, buffers.step()).unwrap();
    }
    for i in 0..10 {
        let mut alone = builder().engine(EngineKind::Hybrid).stream(i as u64).build().unwrap();
        alone.reset(Some(1)).unwrap();
        step_env(&mut alone, &widen(&actions[4 * i..][..4]), 12);
        assert_eq!(batch.final_images(i), Some(alone.observation()));
    }
    assert_eq!(batch.final_images(10), None);
}

#[test]
fn a_batch_with_the_safety_filter_is_bit_identical_to_wrapped_environments() {
    use mujoco_drones_gym::control::{CollisionCone, ControllerKind};
    use mujoco_drones_gym::wrappers::SafetyWrapper;
    let builder =
        || Antipodal::builder().num_drones(4).action_type(ActionType::Vel).controller(ControllerKind::Geometric);
    let filter = || CollisionCone::new(0.36);
    let batch = VecAviary::new(builder(), VecConfig { threads: 2, ..VecConfig::new(10) }).unwrap();
    let mut batch = batch.safety(filter(), 10.0).unwrap();
    let env = builder().engine(EngineKind::Hybrid).build().unwrap();
    let mut alone = SafetyWrapper::new(env, filter()).unwrap();
    let mut buffers = VecBuffers::new(&batch);
    batch.reset(Some(1), &mut buffers.observations).unwrap();
    alone.reset(Some(1)).unwrap();
    for _ in 0..120 {
        // all drones fly towards the centre
        let action: Vec<f32> = (0..4)
            .flat_map(|drone| {
                let position = alone.simulation().states()[drone].position;
                [-0.7 * position.x as f32, -0.7 * position.y as f32, 0.0, 0.0]
            })
            .collect();
        batch.step(&action.repeat(10), buffers.step()).unwrap();
        alone.step(&widen(&action)).unwrap();
        let expected = narrow(&alone.observation().vector);
        for row in buffers.observations.chunks_exact(expected.len()) {
            assert_eq!(bits(row), bits(&expected));
        }
    }
    assert!(alone.interventions() > 30, "{}", alone.interventions());
    let wrong = VecAviary::new(Hover::builder(), VecConfig::new(2)).unwrap().safety(filter(), 10.0);
    assert!(wrong.unwrap_err().to_string().contains("expected vel"));
}

/// A batch that does not fill its last block of eight uses narrower registers for it.
#[test]
fn partial_blocks_are_bit_identical_to_single_environments() {
    let lag = ActuatorParams { lag: 0.03, ..ActuatorParams::default() };
    let mut ended = 0;
    for environments in [1, 2, 3, 5, 9] {
        let config = VecConfig { threads: 1, autoreset: Autoreset::SameStep, ..VecConfig::new(environments) };
        let hover = || Hover::builder().initial_positions([[0.0, 0.0, 0.6]]).episode_seconds(1.1);
        let several = || MultiHover::builder().num_drones(3).episode_seconds(1.1);
        ended += compare(&hover(), config, 80);
        ended += compare(&hover().actuators(lag), config, 80);
        ended += compare(&hover().randomization(Randomization::default()), config, 80);
        ended += compare(&hover().forcing(Forcing::BodyFixed), config, 80);
        ended += compare(&hover().forcing(Forcing::BodyFixed).medium(Medium::AIR), config, 80);
        ended += compare(&hover().medium(Medium::AIR), config, 80);
        ended += compare(&several(), config, 80);
        let effects = several().physics(Physics::MjcGndDragDw).actuators(lag).randomization(Randomization::default());
        ended += compare(&effects, config, 80);
    }
    assert!(ended > 200, "{ended}");
}
