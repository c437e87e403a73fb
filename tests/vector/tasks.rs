//! Tasks that a batch evaluates in SIMD lanes are bit-identical to those of single environments, in their results and
//! in their state.

use mujoco_drones_gym::env::{Aviary, AviaryBuilder, InitialRanges, Randomization};
use mujoco_drones_gym::physics::actuators::ActuatorParams;
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::tasks::{Antipodal, CrashConditions};
use mujoco_drones_gym::{Rng, RngExt, SeedableRng};
use serde::Serialize;

use super::pair::Pair;
use super::{Wander, bits, widen};

/// Returns the options and the state of a task as text. Different numbers have different texts.
fn state<T: Task + Serialize>(env: &Aviary<T>) -> String {
    serde_json::to_string(env.task()).unwrap()
}

/// Returns waypoints at the references of all drones. A third of the environments flies too low, into the floor.
fn piloted<T: Task + Clone + Send + Sync>(environments: &[Aviary<T>], actions: &mut [f32]) {
    let drones = environments[0].simulation().num_drones();
    for (index, row) in actions.chunks_exact_mut(4).enumerate() {
        let (environment, drone) = (index / drones, index % drones);
        let Reference { position, yaw, .. } = environments[environment].reference(drone);
        let low = if environment % 3 == 2 { 0.9 } else { 0.0 };
        row.copy_from_slice(&[position.x, position.y, position.z - low, yaw].map(|x| x as f32));
    }
}

/// Number of episodes that ended in a flight, and number of successes.
#[derive(Debug, Default)]
struct Ends {
    episodes: usize,
    successes: usize,
}

/// Flies a batch and single environments with the same actions, compares every number and, in turn, the tasks, and
/// changes the task of one environment during the flight.
fn fly<T: Task + Clone + Send + Sync + Serialize>(
    builder: &AviaryBuilder<T>,
    config: VecConfig,
    pilot: bool,
    change: fn(&mut T),
    ends: &mut Ends,
) {
    let builder = builder.clone().engine(EngineKind::Hybrid);
    let builder = if pilot { builder.action_type(ActionType::Pid) } else { builder };
    let mut batch = VecAviary::new(builder.clone(), config).unwrap();
    let (count, a, o) = (batch.num_envs(), batch.action_size(), batch.observation_size());
    let mut buffers = VecBuffers::new(&batch);
    let mut alone: Vec<_> = (0..count).map(|i| builder.clone().stream(i as u64).build().unwrap()).collect();
    let (space, mut row) = (batch.observation_space().vector.clone(), vec![0.0_f32; o]);
    batch.reset(Some(3), &mut buffers.observations).unwrap();
    for env in &mut alone {
        env.reset(Some(3)).unwrap();
    }
    let (mut over, mut wander, mut actions) = (vec![false; count], Wander::new(9, count, a), vec![0.0; count * a]);
    for step in 0..130 {
        if step == 40 {
            let changed = 3 % count;
            batch.with(changed, |env| change(env.task_mut())).unwrap();
            change(alone[changed].task_mut());
            over[changed] = true;
        }
        if pilot {
            piloted(&alone, &mut actions);
        } else {
            actions.copy_from_slice(wander.next());
        }
        batch.step(&actions, buffers.step()).unwrap();
        for (i, env) in alone.iter_mut().enumerate() {
            let got = (buffers.rewards[i].to_bits(), buffers.terminated[i], buffers.truncated[i]);
            if std::mem::take(&mut over[i]) {
                space.write_f32(&env.reset(None).unwrap().vector, &mut row);
                assert_eq!(got, (0, false, false));
            } else {
                let Step { observation, reward, terminated, truncated } =
                    env.step(&widen(&actions[i * a..][..a])).unwrap();
                space.write_f32(&observation.vector, &mut row);
                assert_eq!(got, ((reward as f32).to_bits(), terminated, truncated), "step {step} of {i}: {reward}");
                if terminated || truncated {
                    let summary = batch.episode_summary(i).copied().unwrap();
                    assert_eq!((summary.end, summary.success), (env.info().end, env.info().success));
                    ends.episodes += 1;
                    ends.successes += usize::from(summary.success);
                    if config.autoreset == Autoreset::SameStep {
                        space.write_f32(&env.reset(None).unwrap().vector, &mut row);
                    } else {
                        over[i] = true;
                    }
                }
            }
            assert_eq!(bits(&row), bits(&buffers.observations[i * o..][..o]), "step {step} of {i}");
        }
        let looked = step % count;
        let in_batch = batch.with(looked, |env| state(env)).unwrap();
        assert_eq!(in_batch, state(&alone[looked]), "step {step} of {looked}");
    }
    for (i, env) in alone.iter().enumerate() {
        assert_eq!(batch.with(i, |env| state(env)).unwrap(), state(env), "at the end of {i}");
    }
}

/// Flies a task with these numbers of drones, piloted and with random actions, with and without randomization.
fn fly_all<T: Task + Clone + Send + Sync + Serialize>(task: &T, drones: &[usize], change: fn(&mut T)) -> Ends {
    let mut ends = Ends::default();
    // antipodal has no room for other starts
    let initial = Randomization::default().initial.filter(|_| task.name() != "antipodal");
    let randomization = Randomization { initial, ..Randomization::default() };
    for &drones in drones {
        let builder = AviaryBuilder::new(task.clone()).num_drones(drones).episode_seconds(1.1);
        let randomized = builder.clone().randomization(randomization.clone());
        let config =
            |environments, autoreset, threads| VecConfig { autoreset, threads, ..VecConfig::new(environments) };
        fly(&builder, config(13, Autoreset::NextStep, 1), true, change, &mut ends);
        fly(&builder, config(11, Autoreset::SameStep, 2), false, change, &mut ends);
        fly(&randomized, config(5, Autoreset::SameStep, 2), true, change, &mut ends);
        fly(&randomized, config(13, Autoreset::NextStep, 1), false, change, &mut ends);
    }
    ends
}

#[test]
fn tasks_that_hold_a_place_are_bit_identical_in_lanes() {
    let ends = fly_all(&Hover::default(), &[1], |task| task.target_height = 0.4);
    assert!(ends.episodes > 80, "{ends:?}");
    let ends = fly_all(&MultiHover::default(), &[1, 3], |task| task.max_height = 1.5);
    assert!(ends.episodes > 160, "{ends:?}");
    let ends = fly_all(&MultiHover::multi_agent(), &[2], |task| task.crash.floor_contact = false);
    assert!(ends.episodes > 80, "{ends:?}");
    let change = |task: &mut Stabilize| task.crash = CrashConditions::with_max_tilt(0.3);
    assert!(fly_all(&Stabilize::default(), &[1, 2], change).episodes > 160);
}

#[test]
fn tasks_with_moving_targets_are_bit_identical_in_lanes() {
    let ends = fly_all(&Velocity::default(), &[1, 2], |task| task.max_speed = 0.2);
    assert!(ends.episodes > 160, "{ends:?}");
    let mut track = Track::default();
    (track.radius, track.max_distance) = (0.3, 0.25);
    let ends = fly_all(&track, &[1, 3], |task| (task.speed, task.max_distance) = (0.0, 1.0));
    assert!(ends.episodes > 160, "{ends:?}");
    // several laps in an episode
    let mut formation = Formation::default();
    formation.path = vec![[0.0, 0.0, 1.0], [0.3, 0.0, 1.0], [0.3, 0.3, 1.2]];
    formation.speed = 2.0;
    let ends = fly_all(&formation, &[1, 3, 4], |task| task.path.truncate(1));
    assert!(ends.episodes > 240, "{ends:?}");
}

#[test]
fn tasks_with_points_to_pass_are_bit_identical_in_lanes() {
    let mut fly_through = FlyThrough::default();
    fly_through.waypoints = vec![[0.0, 0.0, 0.3], [0.1, 0.0, 0.35], [0.1, 0.1, 0.4]];
    fly_through.radius = 0.2;
    let ends = fly_all(&fly_through, &[1, 2], |task| task.waypoints.truncate(1));
    assert!(ends.episodes > 160 && ends.successes > 3, "{ends:?}");
    let mut race = Race::default();
    race.gates = vec![[0.1, 0.0, 0.4], [0.2, 0.1, 0.5], [0.0, 0.1, 0.6]];
    race.radius = 0.3;
    let ends = fly_all(&race, &[1, 3], |task| (task.laps, task.radius) = (1, 0.2));
    assert!(ends.episodes > 160 && ends.successes > 0, "{ends:?}");
    let mut antipodal = Antipodal::default();
    (antipodal.radius, antipodal.safety_radius) = (0.45, 0.2);
    let ends = fly_all(&antipodal, &[1, 2, 5], |task| task.safety_radius = 0.3);
    assert!(ends.episodes > 240, "{ends:?}");
}

/// Drones start close to the floor, touch it, and take off. They are not airborne before that, so that the contact is
/// no crash.
#[test]
fn drones_that_take_off_from_the_floor_are_bit_identical() {
    const COUNT: usize = 32;
    let initial = InitialRanges { position: 0.02, attitude: 0.0, velocity: 0.0, offset: [0.0, 0.0, -0.09] };
    let builder = Hover::builder()
        .engine(EngineKind::Hybrid)
        .ctrl_freq(12)
        .actuators(ActuatorParams { lag: 0.05, ..ActuatorParams::default() })
        .randomization(Randomization { initial: Some(initial), ..Randomization::NONE });
    let mut pair = Pair::new(&builder, VecConfig::new(COUNT), 3);
    let mut rng = Rng::seed_from_u64(5);
    let mut touches = 0;
    for _ in 0..300 {
        let thrust: Vec<f32> = (0..COUNT).map(|_| [-1.0, -0.1, 0.0, 0.1, 1.0][rng.random_range(0..5)]).collect();
        pair.step(&thrust.into_iter().flat_map(|x| [x; 4]).collect::<Vec<_>>());
        touches += pair.alone.iter().filter(|env| !env.simulation().contacts().is_empty()).count();
    }
    assert!(touches > 20, "{touches}");
    pair.compare_all_exactly();
}
