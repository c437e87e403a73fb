//! A batch flies every environment to the bits that it would fly alone, whatever the number of threads.

use mujoco_drones_gym::env::{AviaryBuilder, BoxSpace, EndReason, Randomization, TaskDefaults};
use mujoco_drones_gym::physics::actuators::ActuatorParams;
use mujoco_drones_gym::physics::wind::{WindConfig, WindModel};
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::tasks::{self, Antipodal};
use mujoco_drones_gym::vector::VecPictures;
use mujoco_drones_gym::world::{ObstacleConfig, ObstacleKind};
use mujoco_drones_gym::{Rng, RngExt, SeedableRng};

/// Actions that wander, so that drones fly, tumble and crash: row after row.
struct Wander {
    rng: Rng,
    held: Vec<f32>,
    size: usize,
}

impl Wander {
    fn new(seed: u64, count: usize, size: usize) -> Self {
        Self { rng: Rng::seed_from_u64(seed), held: vec![0.0; count * size], size }
    }

    fn next(&mut self) -> &[f32] {
        for row in self.held.chunks_exact_mut(self.size) {
            // most of it common to all motors: drones stay in the air for a while
            let common = 0.3 * (self.rng.random::<f32>() - 0.45);
            for x in row {
                *x = (0.8 * *x + common + 0.01 * (self.rng.random::<f32>() - 0.5)).clamp(-1.2, 1.2);
            }
        }
        &self.held
    }
}

fn bits(row: &[f32]) -> Vec<u32> {
    row.iter().map(|x| x.to_bits()).collect()
}

/// Compares a batch of the hybrid engine with its environments.
fn compare<T: Task + Clone + Send>(builder: &AviaryBuilder<T>, config: VecConfig, steps: usize) -> usize {
    compare_as_built(&builder.clone().engine(EngineKind::Hybrid), config, steps)
}

/// Flies a batch and each of its environments alone and compares every number; says how many episodes ended.
fn compare_as_built<T: Task + Clone + Send>(builder: &AviaryBuilder<T>, config: VecConfig, steps: usize) -> usize {
    let mut batch = VecAviary::new(builder.clone(), config).unwrap();
    let count = batch.num_envs();
    let (a, o) = (batch.action_size(), batch.observation_size());
    let mut buffers = VecBuffers::new(&batch);
    let mut alone: Vec<_> = (0..count).map(|i| builder.clone().stream(i as u64).build().unwrap()).collect();
    let mut over = vec![false; count];
    let (space, mut row) = (batch.observation_space().vector.clone(), vec![0.0_f32; o]);
    batch.reset(Some(11), &mut buffers.observations).unwrap();
    for (i, env) in alone.iter_mut().enumerate() {
        space.write_f32(&env.reset(Some(11)).unwrap().vector, &mut row);
        assert_eq!(bits(&row), bits(&buffers.observations[i * o..][..o]), "reset of {i}");
    }
    let mut wander = Wander::new(5, count, a);
    let mut ended = 0;
    for step in 0..steps {
        let actions = wander.next().to_vec();
        batch.step(&actions, buffers.step()).unwrap();
        for (i, env) in alone.iter_mut().enumerate() {
            let seen = &buffers.observations[i * o..][..o];
            let got = (buffers.rewards[i], buffers.terminated[i], buffers.truncated[i]);
            if over[i] {
                space.write_f32(&env.reset(None).unwrap().vector, &mut row);
                assert_eq!(bits(&row), bits(seen), "next reset of {i}");
                assert_eq!(got, (0.0, false, false));
                over[i] = false;
                continue;
            }
            let action: Vec<f64> = actions[i * a..][..a].iter().map(|&x| f64::from(x)).collect();
            let Step { observation, reward, terminated, truncated } = env.step(&action).unwrap();
            space.write_f32(&observation.vector, &mut row);
            assert_eq!(got, (reward as f32, terminated, truncated), "step {step} of {i}");
            let ends = terminated || truncated;
            if ends {
                ended += 1;
                let report = batch.ended(i).copied().unwrap();
                assert_eq!(Some(report.reason), env.info().end);
                assert_eq!((report.success, report.steps), (env.info().success, env.simulation().control_steps()));
            } else {
                assert!(batch.ended(i).is_none());
            }
            if ends && config.autoreset == Autoreset::SameStep {
                assert_eq!(bits(&row), bits(&batch.final_observations()[i * o..][..o]));
                space.write_f32(&env.reset(None).unwrap().vector, &mut row);
            } else {
                over[i] = ends;
            }
            assert_eq!(bits(&row), bits(seen), "step {step} of {i}");
        }
    }
    ended
}

#[test]
fn every_task_is_what_its_environments_are_alone() {
    fn all<T: Task + Clone + Send>(task: T, ended: &mut usize) {
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
fn wind_randomization_obstacles_slow_motors_and_controllers_are_what_they_are_alone() {
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
    assert!(compare(&hover().obstacle_field(forest(false)), config(2), 90) > 5);
    assert!(compare(&hover().obstacle_field(forest(true)), config(2), 90) > 5);
    for kind in [ActionType::Vel, ActionType::Pid, ActionType::Attitude, ActionType::Ctbr, ActionType::OneDRpm] {
        compare(&hover().action_type(kind), config(2), 90);
    }
}

#[test]
fn mujoco_alone_makes_the_same_bits_in_a_batch_contacts_included() {
    // on the floor, bouncing, without an end
    let builder = Hover::builder()
        .engine(EngineKind::Mujoco)
        .initial_positions([[0.0, 0.0, 0.3]])
        .task(|hover| (hover.crash.floor_contact, hover.crash.max_tilt) = (false, 4.0));
    for threads in [1, 2] {
        let mut batch = VecAviary::new(builder.clone(), VecConfig { threads, ..VecConfig::new(9) }).unwrap();
        let mut alone: Vec<_> = (0..9).map(|_| builder.clone().build().unwrap()).collect();
        let mut buffers = VecBuffers::new(&batch);
        batch.reset(Some(1), &mut buffers.observations).unwrap();
        alone.iter_mut().for_each(|env| {
            env.reset(Some(1)).unwrap();
        });
        let mut wander = Wander::new(8, 9, 4);
        let mut touched = 0;
        for _ in 0..150 {
            let actions: Vec<f32> = wander.next().iter().map(|x| x - 0.1).collect();
            batch.step(&actions, buffers.step()).unwrap();
            for (i, env) in alone.iter_mut().enumerate() {
                let action: Vec<f64> = actions[4 * i..][..4].iter().map(|&x| f64::from(x)).collect();
                if env.info().end.is_some() {
                    env.reset(None).unwrap();
                } else {
                    env.step(&action).unwrap();
                }
                touched += env.info().contacts;
                let seen: Vec<f32> = env.observation().vector.iter().map(|&x| x as f32).collect();
                assert_eq!(bits(&seen), bits(&buffers.observations[12 * i..][..12]));
            }
        }
        assert!(touched > 200, "{touched}");
    }
}

#[test]
fn threads_change_no_bits() {
    let builder = || {
        MultiHover::builder()
            .num_drones(3)
            .physics(Physics::MjcGndDragDw)
            .randomization(Randomization { sensors: None, ..Randomization::default() })
    };
    let mut digests = Vec::new();
    for threads in [1, 2, 3, 5] {
        let mut batch = VecAviary::new(builder(), VecConfig { threads, ..VecConfig::new(100) }).unwrap();
        let mut buffers = VecBuffers::new(&batch);
        batch.reset(Some(3), &mut buffers.observations).unwrap();
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
fn a_mask_resets_those_that_it_names_and_leaves_the_others_alone() {
    let config = VecConfig::new(20);
    let make = || VecAviary::new(Velocity::builder(), config).unwrap();
    let (mut one, mut other) = (make(), make());
    let (mut a, mut b) = (VecBuffers::new(&one), VecBuffers::new(&other));
    one.reset(Some(2), &mut a.observations).unwrap();
    other.reset(Some(2), &mut b.observations).unwrap();
    let mut wander = Wander::new(1, 20, 4);
    for _ in 0..10 {
        let actions = wander.next();
        one.step(actions, a.step()).unwrap();
        other.step(actions, b.step()).unwrap();
    }
    let mask: Vec<bool> = (0..20).map(|i| i % 3 == 1).collect();
    let before = a.observations.clone();
    one.reset_where(&mask, None, &mut a.observations).unwrap();
    for i in 0..20 {
        let same = a.observations[16 * i..][..16] == before[16 * i..][..16];
        assert_eq!(same, !mask[i], "{i}");
        let steps = one.with(i, |env| env.simulation().control_steps()).unwrap();
        assert_eq!(steps, if mask[i] { 0 } else { 10 });
    }
    let actions = wander.next();
    one.step(actions, a.step()).unwrap();
    other.step(actions, b.step()).unwrap();
    for i in (0..20).filter(|&i| !mask[i]) {
        assert_eq!(a.observations[16 * i..][..16], b.observations[16 * i..][..16], "{i}");
    }
    // a seed starts the streams of those that it names anew
    one.reset_where(&mask, Some(2), &mut a.observations).unwrap();
    let first = one.with(1, |env| env.task().target(0)).unwrap();
    other.reset(Some(2), &mut b.observations).unwrap();
    assert_eq!(first, other.with(1, |env| env.task().target(0)).unwrap());
    assert_ne!(first, other.with(2, |env| env.task().target(0)).unwrap(), "every environment has a stream of its own");
}

#[test]
fn a_poisoned_action_concerns_its_own_environment_alone() {
    for (engine, poison) in
        [(EngineKind::Hybrid, f32::NAN), (EngineKind::Mujoco, f32::INFINITY), (EngineKind::Hybrid, f32::NEG_INFINITY)]
    {
        let builder = || Hover::builder().engine(engine).initial_positions([[0.0, 0.0, 1.0]]);
        let make = |on_fault| VecAviary::new(builder(), VecConfig { on_fault, ..VecConfig::new(12) }).unwrap();
        let (mut clean, mut strict, mut lenient) =
            (make(OnFault::Error), make(OnFault::Error), make(OnFault::Truncate));
        let mut buffers = [(); 3].map(|()| VecBuffers::new(&clean));
        clean.reset(Some(1), &mut buffers[0].observations).unwrap();
        strict.reset(Some(1), &mut buffers[1].observations).unwrap();
        lenient.reset(Some(1), &mut buffers[2].observations).unwrap();
        let mut wander = Wander::new(9, 12, 4);
        for step in 0..40 {
            let good = wander.next().to_vec();
            let mut bad = good.clone();
            if step == 20 {
                bad[4 * 5 + 2] = poison;
                // nothing moves
                let before = buffers[1].clone();
                let error = strict.step(&bad, buffers[1].step()).unwrap_err().to_string();
                assert!(error.starts_with("environment 5: action[2] is"), "{error}");
                assert_eq!(buffers[1], before);
            }
            clean.step(&good, buffers[0].step()).unwrap();
            strict.step(&good, buffers[1].step()).unwrap();
            lenient.step(&bad, buffers[2].step()).unwrap();
            assert_eq!(buffers[0], buffers[1]);
            for i in (0..12).filter(|&i| i != 5) {
                assert_eq!(buffers[0].observations[12 * i..][..12], buffers[2].observations[12 * i..][..12]);
                assert_eq!(buffers[0].rewards[i], buffers[2].rewards[i]);
            }
            if step == 20 {
                assert_eq!(lenient.faults().len(), 1);
                assert_eq!(lenient.faults()[0].0, 5);
                assert!(buffers[2].truncated[5] && !buffers[2].terminated[5] && buffers[2].rewards[5] == 0.0);
                assert_eq!(lenient.ended(5).unwrap().reason, EndReason::Fault);
            } else {
                assert!(lenient.faults().is_empty());
            }
            if step == 21 {
                assert_eq!(buffers[2].observations[12 * 5 + 2], 1.0, "it began anew");
            }
        }
    }
}

#[test]
fn mistakes_are_errors_that_lose_nothing() {
    let make = |config| VecAviary::new(Hover::builder(), config);
    assert!(make(VecConfig::new(0)).unwrap_err().to_string().contains("environments is 0"));
    let mut batch = make(VecConfig { autoreset: Autoreset::Disabled, ..VecConfig::new(10) }).unwrap();
    let mut buffers = VecBuffers::new(&batch);
    let actions = vec![0.0; 40];
    let error = batch.step(&actions, buffers.step()).unwrap_err().to_string();
    assert!(error.contains("environment 0") && error.contains("reset"), "{error}");
    assert!(batch.reset(None, &mut [0.0; 7]).unwrap_err().to_string().contains("expected 120"));
    batch.reset(None, &mut buffers.observations).unwrap();
    assert!(batch.step(&actions[1..], buffers.step()).unwrap_err().to_string().contains("expected 40"));
    let falling = vec![-1.0; 40];
    let mut steps = 0;
    let error = loop {
        match batch.step(&falling, buffers.step()) {
            Ok(()) => steps += 1,
            Err(error) => break error.to_string(),
        }
    };
    assert!(steps > 3 && buffers.terminated[9] && error.contains("after the end"), "{steps} {error}");
    batch.reset_where(&[true; 10], None, &mut buffers.observations).unwrap();
    batch.step(&actions, buffers.step()).unwrap();
}

#[test]
fn an_environment_can_be_changed_as_if_it_were_alone() {
    let mut batch = VecAviary::new(Hover::builder().initial_positions([[0.0, 0.0, 2.0]]), VecConfig::new(10)).unwrap();
    let mut buffers = VecBuffers::new(&batch);
    batch.reset(Some(1), &mut buffers.observations).unwrap();
    let wind = WindConfig { velocity: [3.0, 0.0, 0.0], ..WindConfig::new(WindModel::Constant) };
    batch.with(4, |env| env.set_wind(Some(wind))).unwrap().unwrap();
    let mut seen = 0;
    batch.with_env(7, &mut |env| seen = env.episode_steps()).unwrap();
    let error = batch.with(10, |_| ()).unwrap_err().to_string();
    assert_eq!(error, "there is no environment 10, expected one of 0 to 9");
    assert_eq!(seen, 480);
    for _ in 0..48 {
        batch.step(&[0.0; 40], buffers.step()).unwrap();
    }
    for i in 0..10 {
        let x = buffers.observations[12 * i];
        assert_eq!(x > 0.005, i == 4, "{i}: {x}");
    }
}

#[test]
fn randomizing_one_environment_leaves_the_bodies_of_the_others_alone() {
    let config = VecConfig { threads: 1, ..VecConfig::new(10) };
    let mut batch = VecAviary::new(Hover::builder(), config).unwrap();
    let mut buffers = VecBuffers::new(&batch);
    batch.reset(Some(1), &mut buffers.observations).unwrap();
    let bodies = Randomization { body: Some(Default::default()), ..Randomization::NONE };
    batch.with(4, |env| env.set_randomization(Some(bodies))).unwrap().unwrap();
    batch.reset(Some(1), &mut buffers.observations).unwrap();
    batch.step(&[0.0; 40], buffers.step()).unwrap();
    let nominal = DroneModel::Cf2x.params().mass;
    for i in 0..10 {
        let mass = batch.with(i, |env| env.simulation().params(0).mass).unwrap();
        assert_eq!(mass != nominal, i == 4, "{i}: {mass}");
    }
    // and it can be taken back
    batch.with(4, |env| env.set_randomization(None)).unwrap().unwrap();
    batch.reset(Some(1), &mut buffers.observations).unwrap();
    assert_eq!(batch.with(4, |env| env.simulation().params(0).mass).unwrap(), nominal);
}

#[test]
fn what_a_batch_observes_beside_vectors_stands_behind_them() {
    let field = ObstacleConfig { count: 4, arena: [4.0, 4.0, 2.0], ..ObstacleConfig::new(ObstacleKind::Forest) };
    let kind: ObservationType = "kin_obstacle_ranges_adjacency".parse().unwrap();
    let builder = MultiHover::builder().obstacle_field(field).observation_type(kind);
    let mut batch = VecAviary::new(builder.clone(), VecConfig::new(9)).unwrap();
    assert_eq!(batch.observation_size(), 26 + 2 + 20 + 4);
    let mut buffers = VecBuffers::new(&batch);
    batch.reset(Some(1), &mut buffers.observations).unwrap();
    batch.step(&[0.1; 72], buffers.step()).unwrap();
    let mut env = builder.engine(EngineKind::Hybrid).build().unwrap();
    env.reset(Some(1)).unwrap();
    env.step(&[0.1_f32 as f64; 8]).unwrap();
    let seen = env.observation();
    let mut row: Vec<f32> = seen.vector.iter().chain(&seen.obstacle).chain(&seen.ranges).map(|&x| x as f32).collect();
    row.extend(seen.adjacency.iter().map(|&near| f32::from(u8::from(near))));
    for i in 0..9 {
        assert_eq!(bits(&row), bits(&buffers.observations[52 * i..][..52]), "{i}");
    }
}

#[test]
fn every_task_has_a_batch_by_name() {
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

/// A hundred thousand environment steps here, a million with `--ignored`.
fn long_run(steps: usize) {
    let randomized = Randomization { sensors: None, environment: None, ..Randomization::default() };
    for builder in [Hover::builder(), Hover::builder().physics(Physics::MjcGndDragDw).randomization(randomized)] {
        let count = 500;
        let config = VecConfig { autoreset: Autoreset::SameStep, ..VecConfig::new(count) };
        let mut env = VecAviary::new(builder, config).unwrap();
        let mut buffers = VecBuffers::new(&env);
        env.reset(Some(1), &mut buffers.observations).unwrap();
        let mut rng = Rng::seed_from_u64(2);
        let (mut ended, mut lengths) = (vec![0_u64; count], 0);
        let mut actions = vec![0.0_f32; 4 * count];
        for _ in 0..steps / count / 2 {
            actions.fill_with(|| 2.0 * rng.random::<f32>() - 1.0);
            env.step(&actions, buffers.step()).unwrap();
            assert!(buffers.observations.iter().chain(&buffers.rewards).all(|x| x.is_finite()));
            for (i, ended) in ended.iter_mut().enumerate() {
                if let Some(report) = env.ended(i) {
                    *ended += 1;
                    lengths += report.steps;
                }
            }
        }
        // none is lost: every step of every environment belongs to an episode that has ended or is still running
        let running: u64 = (0..count).map(|i| env.with(i, |env| env.simulation().control_steps()).unwrap()).sum();
        assert_eq!((lengths + running) as usize, steps / 2);
        let all = ended.iter().sum::<u64>() as usize;
        assert!(all > steps / 100, "{all} ended");
    }
}

#[test]
fn random_actions_for_long_lose_no_environment_and_make_no_nan() {
    long_run(100_000);
}

#[test]
#[ignore = "a million steps"]
fn a_million_random_steps_lose_no_environment_and_make_no_nan() {
    long_run(1_000_000);
}

#[test]
fn pictures_of_a_batch_are_those_of_its_environments_alone() {
    let builder = || {
        Hover::builder()
            .initial_positions([[0.0, 0.0, 0.4]])
            .observation_type("kin_rgb_depth_segmentation".parse().unwrap())
            .obstacle_field(ObstacleConfig { arena: [4.0, 4.0, 2.0], ..ObstacleConfig::new(ObstacleKind::Forest) })
    };
    let count = 9;
    let mut env = match VecAviary::new(builder(), VecConfig { threads: 2, ..VecConfig::new(count) }) {
        Ok(env) => env,
        // nothing to draw with
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
    env.pictures(VecPictures { rgb: &mut rgb, depth: &mut depth, segmentation: &mut segmentation }).unwrap();
    for i in [0, 4, 8] {
        let mut alone = builder().engine(EngineKind::Hybrid).stream(i as u64).build().unwrap();
        alone.reset(Some(1)).unwrap();
        let action: Vec<f64> = actions[4 * i..][..4].iter().map(|&x| f64::from(x)).collect();
        for _ in 0..15 {
            alone.step(&action).unwrap();
        }
        let seen = alone.observation();
        assert_eq!(seen.rgb, rgb[4 * pixels * i..][..4 * pixels]);
        assert_eq!(seen.depth, depth[pixels * i..][..pixels]);
        assert_eq!(seen.segmentation, segmentation[pixels * i..][..pixels]);
    }
    assert_ne!(rgb[..4 * pixels], rgb[4 * 8 * pixels..][..4 * pixels], "they are in different places");
    let error = env.pictures(VecPictures::default()).unwrap_err().to_string();
    assert!(error.contains("buffer of colours"), "{error}");
}

#[test]
fn a_batch_behind_the_safety_filter_is_its_environments_behind_it() {
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
        // all straight to the middle
        let action: Vec<f32> = (0..4)
            .flat_map(|drone| {
                let position = alone.simulation().states()[drone].position;
                [-0.7 * position.x as f32, -0.7 * position.y as f32, 0.0, 0.0]
            })
            .collect();
        batch.step(&action.repeat(10), buffers.step()).unwrap();
        let action: Vec<f64> = action.iter().map(|&x| f64::from(x)).collect();
        alone.step(&action).unwrap();
        let seen: Vec<f32> = alone.observation().vector.iter().map(|&x| x as f32).collect();
        for row in buffers.observations.chunks_exact(seen.len()) {
            assert_eq!(bits(row), bits(&seen));
        }
    }
    assert!(alone.interventions() > 30, "{}", alone.interventions());
    let wrong = VecAviary::new(Hover::builder(), VecConfig::new(2)).unwrap().safety(filter(), 10.0);
    assert!(wrong.unwrap_err().to_string().contains("expected vel"));
}

#[test]
fn a_curriculum_of_a_batch_follows_the_episodes_of_all_environments() {
    use mujoco_drones_gym::vector::VecCurriculum;
    use mujoco_drones_gym::wrappers::{CurriculumConfig, CurriculumMetric};
    let config = CurriculumConfig {
        levels: 3,
        metric: CurriculumMetric::EpisodeLength,
        window: 10,
        advance: 9.5,
        retreat: None,
    };
    // an episode of ten steps in the air; higher on every level
    let builder = || Hover::builder().initial_positions([[0.0, 0.0, 1.0]]).episode_seconds(10.0 / 48.0);
    let raise = |env: &mut Aviary<Hover>, level: usize| {
        env.task_mut().target_height = 1.0 + 0.5 * level as f64;
        Ok(())
    };
    let batch = VecAviary::new(builder(), VecConfig::new(16)).unwrap();
    let mut env = VecCurriculum::new(batch, config, raise).unwrap();
    let mut buffers = VecBuffers::new(&env);
    env.reset(Some(1), &mut buffers.observations).unwrap();
    let actions = vec![0.0; 64];
    let mut levels = Vec::new();
    for _ in 0..40 {
        env.step(&actions, buffers.step()).unwrap();
        levels.push(env.curriculum().level());
    }
    // sixteen episodes end together: one level and six episodes of the next, which are too few
    assert_eq!((levels[8], levels[9], levels[20], levels[39]), (0, 1, 2, 2));
    assert_eq!(env.curriculum().state().episodes, 48);
    for i in 0..16 {
        assert_eq!(env.inner().with(i, |env| env.task().target_height).unwrap(), 2.0);
    }
    let same = VecAviary::new(builder(), VecConfig { autoreset: Autoreset::SameStep, ..VecConfig::new(2) }).unwrap();
    assert!(VecCurriculum::new(same, config, raise).is_err());
}

/// Hover with something else in its `update`, and the thrust of the last physics step as reward.
#[derive(Debug, Clone)]
struct Odd {
    hover: Hover,
    update: fn(SimView<'_>),
    /// True if the n-th call of `start` gives an impossible state.
    impossible: fn(u32) -> bool,
    starts: u32,
}

impl Task for Odd {
    fn name(&self) -> &'static str {
        "odd"
    }

    fn defaults(&self) -> TaskDefaults {
        self.hover.defaults()
    }

    fn initial_positions(&self, drones: &[DroneParams]) -> Vec<[f64; 3]> {
        self.hover.initial_positions(drones)
    }

    fn observation_space(&self) -> BoxSpace {
        self.hover.observation_space()
    }

    fn start(&mut self, _: SimView<'_>, _: &mut Rng, states: &mut [DroneState]) -> bool {
        self.starts += 1;
        let impossible = (self.impossible)(self.starts);
        if impossible {
            states[0].position.z = f64::NAN;
        }
        impossible
    }

    fn reset(&mut self, simulation: SimView<'_>, rng: &mut Rng) {
        self.hover.reset(simulation, rng);
    }

    fn update(&mut self, simulation: SimView<'_>) {
        (self.update)(simulation);
        self.hover.update(simulation);
    }

    fn end(&self, simulation: SimView<'_>, drone: usize) -> Option<EndReason> {
        self.hover.end(simulation, drone)
    }

    fn reward(&self, simulation: SimView<'_>, drone: usize, _: Option<EndReason>) -> f64 {
        let load = &simulation.loads()[drone];
        load.rotors.thrust + load.external.force_world.z + simulation.motor_speeds()[drone][1]
    }

    fn observe(&self, simulation: SimView<'_>, drone: usize, out: &mut [f64]) {
        self.hover.observe(simulation, drone, out);
    }

    fn success(&self, simulation: SimView<'_>, drone: usize) -> bool {
        self.hover.success(simulation, drone)
    }

    fn reference(&self, simulation: SimView<'_>, drone: usize) -> Reference {
        self.hover.reference(simulation, drone)
    }
}

fn odd(update: fn(SimView<'_>)) -> AviaryBuilder<Odd> {
    AviaryBuilder::new(Odd { hover: Hover::default(), update, impossible: |_| false, starts: 0 })
}

#[test]
fn a_task_may_use_threads_of_its_own_and_sees_loads_and_commands() {
    fn busy(simulation: SimView<'_>) {
        let (time, states) = (simulation.time(), simulation.states());
        let (a, b) = rayon::join(|| time + 0.0, || states[0].position.z);
        assert!(a + b > 0.0);
    }
    let config = VecConfig { threads: 2, ..VecConfig::new(600) };
    let builder = odd(busy).physics(Physics::MjcGndDragDw).initial_positions([[0.0, 0.0, 0.4]]);
    let mut batch = VecAviary::new(builder, config).unwrap();
    let mut buffers = VecBuffers::new(&batch);
    batch.reset(Some(1), &mut buffers.observations).unwrap();
    for _ in 0..20 {
        batch.step(&[0.01; 2400], buffers.step()).unwrap();
    }
    let builder = odd(busy).physics(Physics::MjcGndDragDw).initial_positions([[0.0, 0.0, 0.4]]);
    assert!(compare(&builder, VecConfig { threads: 2, ..VecConfig::new(17) }, 60) > 0);
}

#[test]
fn a_task_that_panicked_is_an_error_ever_after() {
    fn panics(simulation: SimView<'_>) {
        assert!(simulation.control_steps() < 3, "on purpose");
    }
    let mut batch = VecAviary::new(odd(panics), VecConfig { threads: 2, ..VecConfig::new(40) }).unwrap();
    let mut buffers = VecBuffers::new(&batch);
    batch.reset(Some(1), &mut buffers.observations).unwrap();
    let caught = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
        for _ in 0..5 {
            batch.step(&[0.0; 160], buffers.step()).unwrap();
        }
    }));
    assert!(caught.is_err());
    assert_eq!(batch.reset(Some(1), &mut buffers.observations), Err(EnvError::Panicked));
    assert_eq!(batch.step(&[0.0; 160], buffers.step()), Err(EnvError::Panicked));
}

#[test]
fn a_state_that_leaves_the_numbers_is_the_fault_that_it_is_alone() {
    use mujoco_drones_gym::world::Medium;
    // falling in a liquid so dense that a step overshoots
    let builder = |speed: f64| {
        Hover::builder()
            .medium(Medium { density: 1000.0, viscosity: 1.8e-5 })
            .initial_positions([[0.0, 0.0, 5.0]])
            .initial_velocities([[0.0, 0.0, -speed]])
            .task(|hover| hover.max_height = 1e9)
    };
    let mut failed = 0;
    for speed in [1.0, 4.0, 6.0, 8.0, 10.0, 12.0, 20.0] {
        let mut alone = builder(speed).engine(EngineKind::Hybrid).build().unwrap();
        let config = VecConfig { on_fault: OnFault::Truncate, ..VecConfig::new(3) };
        let mut batch = VecAviary::new(builder(speed), config).unwrap();
        let mut buffers = VecBuffers::new(&batch);
        batch.reset(Some(1), &mut buffers.observations).unwrap();
        alone.reset(Some(1)).unwrap();
        for _ in 0..20 {
            let outcome = alone.step(&[0.0; 4]).map(|step| step.terminated).map_err(|error| error.to_string());
            batch.step(&[0.0; 12], buffers.step()).unwrap();
            assert!(buffers.observations.iter().all(|x| x.is_finite()), "{speed}");
            match outcome {
                Ok(over) => {
                    assert_eq!(buffers.terminated, [over; 3]);
                    assert!(batch.faults().is_empty(), "{speed}");
                    if over {
                        break;
                    }
                }
                Err(error) => {
                    assert_eq!(batch.faults()[2].1.to_string(), error);
                    assert_eq!(buffers.truncated, [true; 3]);
                    failed += 1;
                    break;
                }
            }
        }
    }
    assert!(failed > 1, "{failed}");
}

#[test]
fn looking_at_an_environment_shows_its_own_commands_and_end_and_changes_nothing() {
    let make = || VecAviary::new(Hover::builder(), VecConfig { threads: 1, ..VecConfig::new(10) }).unwrap();
    let (mut looked, mut other) = (make(), make());
    let mut buffers = [VecBuffers::new(&looked), VecBuffers::new(&other)];
    looked.reset(Some(1), &mut buffers[0].observations).unwrap();
    other.reset(Some(1), &mut buffers[1].observations).unwrap();
    let actions: Vec<f32> = (0..40).map(|i| if i / 4 == 7 { -1.0 } else { 0.002 * (i / 4) as f32 }).collect();
    for step in 0..30 {
        looked.step(&actions, buffers[0].step()).unwrap();
        other.step(&actions, buffers[1].step()).unwrap();
        assert_eq!(buffers[0], buffers[1], "{step}");
        let crashed = buffers[0].terminated[7];
        for i in [2, 5, 7] {
            let (speeds, rpm, end) = looked
                .with(i, |env| {
                    let simulation = env.simulation();
                    (simulation.motor_speeds()[0], *simulation.rotor_speeds(0), env.drone_end(0))
                })
                .unwrap();
            let ended = end.is_some();
            assert!(ended == (crashed && i == 7), "{i}: {end:?}");
            if i != 7 {
                let wanted = 14_475.8 + f64::from(0.002 * i as f32) * (21_713.7 - 14_475.8);
                assert!((speeds[0] - wanted).abs() < 2.0 && rpm == speeds, "{i}: {speeds:?} {rpm:?}");
            }
        }
    }
    // an end that is known already is not another one
    let config = VecConfig { autoreset: Autoreset::Disabled, on_fault: OnFault::Truncate, ..VecConfig::new(1) };
    let mut batch = VecAviary::new(Hover::builder(), config).unwrap();
    let mut buffers = VecBuffers::new(&batch);
    batch.reset(None, &mut buffers.observations).unwrap();
    let mut ends = Vec::new();
    for _ in 0..20 {
        batch.step(&[-1.0; 4], buffers.step()).unwrap();
        ends.extend(batch.ended(0).map(|ended| ended.reason));
    }
    assert_eq!(ends, [EndReason::FloorContact]);
    assert!(!buffers.truncated[0] && !buffers.terminated[0]);
    assert!(batch.faults()[0].1.to_string().contains("after the end"));
}

#[test]
fn a_step_that_could_not_start_an_episode_is_no_step_of_an_episode() {
    for autoreset in [Autoreset::SameStep, Autoreset::NextStep] {
        let config = VecConfig { autoreset, on_fault: OnFault::Truncate, ..VecConfig::new(9) };
        // two episodes in a row cannot start, and another one; each start is tried 20 times
        let impossible = |start| (2..42).contains(&start) || (44..64).contains(&start);
        let builder = odd(|_| {}).episode_seconds(0.25).task(move |odd| odd.impossible = impossible);
        let mut batch = VecAviary::new(builder, config).unwrap();
        let mut buffers = VecBuffers::new(&batch);
        batch.reset(Some(1), &mut buffers.observations).unwrap();
        let (mut ends, mut steps, mut faults) = (Vec::new(), 0, 0);
        for _ in 0..65 {
            // with NextStep, the step after an end starts the next episode
            let starts = autoreset == Autoreset::NextStep && batch.ended(8).is_some();
            batch.step(&[0.01; 36], buffers.step()).unwrap();
            assert_eq!(batch.ended(0), batch.ended(8));
            faults += batch.faults().len();
            match batch.ended(8) {
                Some(ended) => {
                    assert!(buffers.truncated[8] && !buffers.terminated[8]);
                    ends.push((ended.reason, ended.steps));
                    steps += u32::from(ended.reason != EndReason::Fault);
                }
                None => {
                    assert!(!buffers.truncated[8]);
                    steps += u32::from(!starts);
                }
            }
        }
        let whole = (EndReason::TimeLimit, 12);
        let failed = (EndReason::Fault, 0);
        assert_eq!(ends[..7], [whole, failed, failed, whole, whole, failed, whole], "{autoreset:?}");
        assert_eq!(faults, 3 * 9);
        let running = batch.with(8, |env| env.simulation().control_steps()).unwrap() as u32;
        let wholes = ends.iter().filter(|end| **end == whole).count() as u32;
        assert_eq!(steps, 12 * wholes + running, "{autoreset:?}: every other step belongs to an episode");
    }
}
