//! Races through gates with frames: crossings, contacts, gates that change in every episode or move, and tracks.

mod common;

use std::f64::consts::{FRAC_PI_2, TAU};

use common::step_env;
use mujoco_drones_gym::env::{Randomization, TaskOptions};
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::tasks::{GateMotion, GateRanges, RaceTrack};
use mujoco_drones_gym::{Rng, RngExt as _, SeedableRng};
use nalgebra::Vector3;

/// Returns a race with solid gates.
fn solid() -> Race {
    let mut race = Race::default();
    race.solid = true;
    race
}

/// Returns a race whose solid gates change in every episode and move.
fn moving() -> Race {
    let mut race = solid();
    race.randomization = GateRanges { position: 0.15, yaw: 0.2 };
    race.motion = GateMotion { amplitude: 0.15, period: 4.0 };
    race
}

/// Moves the drones of a simulation from one set of positions to another in one control step of a race.
fn cross(race: &mut Race, from: &[Vector3<f64>], to: &[Vector3<f64>]) -> Vec<usize> {
    let mut simulation = Simulation::builder(DroneModel::Cf2x)
        .num_drones(from.len())
        .initial_positions((0..from.len()).map(|drone| [0.0, 10.0 * drone as f64, 20.0]))
        .build()
        .unwrap();
    let still = |positions: &[Vector3<f64>]| -> Vec<_> {
        positions.iter().map(|&position| DroneState { position, ..DroneState::default() }).collect()
    };
    simulation.reset_to(&still(from)).unwrap();
    race.reset(simulation.view(), &mut Rng::seed_from_u64(1));
    simulation.reset_to(&still(to)).unwrap();
    race.update(simulation.view());
    (0..from.len()).map(|drone| race.gates_passed(drone)).collect()
}

#[test]
fn a_solid_gate_is_passed_through_its_opening_in_the_direction_of_its_normal() {
    for yaw in [0.0, 0.7, -2.5] {
        let mut race = solid();
        (race.gates, race.yaws) = (vec![[1.0, 2.0, 3.0]], vec![yaw]);
        let (sin, cos) = f64::sin_cos(yaw);
        let at = |along: f64, left: f64, up: f64| {
            Vector3::new(1.0 + cos * along - sin * left, 2.0 + sin * along + cos * left, 3.0 + up)
        };
        let away = at(-3.0, 3.0, 3.0);
        for (from, to, expected) in [
            (at(-0.05, 0.0, 0.0), at(0.05, 0.0, 0.0), 1),
            (at(-0.05, 0.24, -0.24), at(0.05, 0.24, -0.24), 1),
            (at(-0.05, 0.26, 0.0), at(0.05, 0.26, 0.0), 0),
            (at(-0.05, 0.0, 0.26), at(0.05, 0.0, 0.26), 0),
            (at(0.05, 0.0, 0.0), at(-0.05, 0.0, 0.0), 0),
            // within the radius of a gate that is not solid
            (at(-0.15, 0.0, 0.0), at(-0.05, 0.0, 0.0), 0),
        ] {
            assert_eq!(cross(&mut race, &[from], &[to]), [expected], "{yaw}: {from} {to}");
            // every drone has its own gates
            assert_eq!(cross(&mut race, &[away, from, away], &[away, to, away]), [0, expected, 0]);
        }
        race.solid = false;
        assert_eq!(cross(&mut race, &[at(0.3, 0.0, 0.0)], &[at(0.1, 0.0, 0.0)]), [1], "backwards into the sphere");
    }
}

/// A drone climbs into the lower bar of the last gate, which is above its start, in both engines and in a batch.
#[test]
fn a_contact_with_a_bar_is_a_crash_in_every_engine_and_in_a_batch() {
    let climb = |env: &mut dyn DroneEnv| {
        env.reset(Some(3)).unwrap();
        let mut path = Vec::new();
        while env.info().end.is_none() {
            env.step(&[0.3; 4]).unwrap();
            path.push(env.simulation().states()[0].position.z);
        }
        (env.info().end, path)
    };
    let builder = || AviaryBuilder::new(solid()).episode_seconds(3.0);
    let build = |engine| builder().engine(engine).build().unwrap();
    let (end, path) = climb(&mut build(EngineKind::Mujoco));
    assert_eq!(end, Some(EndReason::ObstacleContact));
    // the lower side of the bar minus half the height of the drone
    let touched = 0.8 - 0.28 - 0.5 * DroneModel::Cf2x.params().collision_height;
    assert!((path[path.len() - 1] - touched).abs() < 0.02, "{path:?}");
    let (hybrid_end, hybrid) = climb(&mut build(EngineKind::Hybrid));
    assert_eq!((hybrid_end, hybrid.len()), (end, path.len()));
    assert!(path.iter().zip(&hybrid).all(|(a, b)| (a - b).abs() < 1e-6));
    let (visible_end, _) = climb(&mut Race::builder().episode_seconds(3.0).build().unwrap());
    assert_eq!(visible_end, Some(EndReason::TimeLimit), "gates that are not solid have no contacts");

    let options = EnvConfig::default().task(|task| task.track = Some(solid().track())).episode_seconds(3.0);
    let mut batch = make_vec("race", options, VecConfig::new(3)).unwrap();
    let mut buffers = VecBuffers::new(&*batch);
    batch.reset(Some(3), &mut buffers.observations).unwrap();
    for step in 0..path.len() {
        assert!(!buffers.terminated.contains(&true), "{step}");
        batch.step(&[0.3; 12], buffers.step()).unwrap();
    }
    assert_eq!(buffers.terminated, [true; 3]);
    assert!(buffers.rewards.iter().all(|&reward| reward < -90.0), "the penalty for a crash");
}

/// Environment i of a batch equals the single environment with stream i, for any number of threads. Some drones fly
/// with random actions, the others with the actions of a controller.
#[test]
fn environments_of_a_batch_are_bit_identical_to_single_ones() {
    const COUNT: usize = 11;
    let mut passed = 0;
    let mut crashes = 0;
    let mut visible = moving();
    visible.solid = false;
    for (race, threads, drones) in [(solid(), 2, 1), (moving(), 1, 1), (moving(), 2, 2), (visible, 2, 1)] {
        let mut track = race.track();
        track.gates.truncate(2);
        let initial = Randomization { initial: Some(Default::default()), ..Randomization::NONE };
        let options = EnvConfig::default()
            .task(|task| task.track = Some(track))
            .num_drones(drones)
            .engine(EngineKind::Hybrid)
            .randomization(initial)
            .episode_seconds(4.0);
        let config = VecConfig { threads, autoreset: Autoreset::NextStep, ..VecConfig::new(COUNT) };
        let mut batch = make_vec("race", options.clone(), config).unwrap();
        let mut buffers = VecBuffers::new(&*batch);
        batch.reset(Some(5), &mut buffers.observations).unwrap();
        let mut single: Vec<_> =
            (0..COUNT as u64).map(|stream| make("race", options.clone().stream(stream)).unwrap()).collect();
        let mut pilots: Vec<_> =
            single.iter().map(|env| ControllerPolicy::new(ControllerKind::Geometric, &**env)).collect();
        for (env, pilot) in single.iter_mut().zip(&mut pilots) {
            env.reset(Some(5)).unwrap();
            pilot.reset(&**env).unwrap();
        }
        let (row, mut over, mut rng) = (batch.observation_size(), [false; COUNT], Rng::seed_from_u64(8));
        for _ in 0..260 {
            let mut actions = vec![0.0_f64; 4 * drones * COUNT];
            for (index, action) in actions.chunks_exact_mut(4 * drones).enumerate() {
                pilots[index].act(&*single[index], action).unwrap();
                if index % 3 == 2 {
                    action.iter_mut().for_each(|x| *x += 0.6 * (rng.random::<f64>() - 0.5));
                }
                action.iter_mut().for_each(|x| *x = x.clamp(-1.0, 1.0));
            }
            batch.step_f64(&actions, buffers.step()).unwrap();
            for (index, env) in single.iter_mut().enumerate() {
                if std::mem::take(&mut over[index]) {
                    env.reset(None).unwrap();
                    pilots[index].reset(&**env).unwrap();
                } else {
                    let step = env.step(&actions[4 * drones * index..][..4 * drones]).unwrap();
                    over[index] = step.terminated || step.truncated;
                    let got = (buffers.rewards[index].to_bits(), buffers.terminated[index], buffers.truncated[index]);
                    assert_eq!(got, ((step.reward as f32).to_bits(), step.terminated, step.truncated), "{index}");
                    passed += usize::from(step.reward > 15.0);
                    crashes += usize::from(env.info().end == Some(EndReason::ObstacleContact));
                }
                let seen = env.observation().vector.iter().map(|&x| (x as f32).to_bits());
                let own = buffers.observations[row * index..][..row].iter().map(|x| x.to_bits());
                assert!(seen.eq(own), "observation {index}");
            }
        }
    }
    assert!(passed > 40 && crashes > 2, "{passed} gates passed, {crashes} contacts with frames");
}

/// Returns the centre of a gate from its four bars.
fn centre_of_bars(env: &Aviary<Race>, gate: usize) -> Vector3<f64> {
    let bars = &env.simulation().obstacles()[4 * gate..][..4];
    bars.iter().map(|bar| bar.position).sum::<Vector3<f64>>() / 4.0
}

#[test]
fn moving_gates_follow_a_sine_to_their_left_in_every_engine() {
    const QUARTER: usize = 48;
    let build = |engine| AviaryBuilder::new(moving()).engine(engine).episode_seconds(20.0).build().unwrap();
    for engine in [EngineKind::Mujoco, EngineKind::Hybrid] {
        let mut env = build(engine);
        env.reset(Some(7)).unwrap();
        let mut centres = vec![Vec::new(); 6];
        for _ in 0..4 * QUARTER + 1 {
            for (gate, centres) in centres.iter_mut().enumerate() {
                let (centre, normal) = env.task().gate_pose(gate).unwrap();
                let bars = centre_of_bars(&env, gate);
                assert!((bars - centre).norm() < 1e-12, "the bars are where the task says");
                assert!((normal.norm() - 1.0).abs() < 1e-12 && normal.z == 0.0);
                centres.push((centre, normal));
            }
            env.step(&[0.0; 4]).unwrap();
        }
        for centres in &centres {
            let (first, normal) = centres[0];
            let left = Vector3::z().cross(&normal);
            let middle = 0.5 * (first + centres[2 * QUARTER].0);
            let offset = |step: usize| (centres[step].0 - middle).dot(&left);
            let phase = offset(0).atan2(offset(QUARTER));
            for (step, (centre, same)) in centres.iter().enumerate() {
                assert_eq!(*same, normal, "the yaw stays");
                let time = step as f64 / 48.0;
                let expected = middle + left * 0.15 * (phase + TAU * time / 4.0).sin();
                assert!((centre - expected).norm() < 1e-12, "{engine}, {step}: {centre} {expected}");
            }
        }
    }
}

#[test]
fn gates_of_an_episode_are_within_their_ranges_and_depend_on_the_seed_alone() {
    let mut race = solid();
    race.randomization = GateRanges { position: 0.15, yaw: 0.2 };
    let nominal = race.clone();
    let mut env = AviaryBuilder::new(race).build().unwrap();
    let mut poses = |seed: u64| {
        env.reset(Some(seed)).unwrap();
        (0..6).map(|gate| env.task().gate_pose(gate).unwrap()).collect::<Vec<_>>()
    };
    let mut still = AviaryBuilder::new(nominal.clone()).build().unwrap();
    still.task_mut().randomization = GateRanges::default();
    still.reset(Some(1)).unwrap();
    let mut spread: f64 = 0.0;
    for seed in 0..40 {
        let drawn = poses(seed);
        for (gate, (centre, normal)) in drawn.iter().enumerate() {
            let (nominal_centre, nominal_normal) = still.task().gate_pose(gate).unwrap();
            let offset = centre - nominal_centre;
            let turn = nominal_normal.cross(normal).z.asin();
            assert!(offset.amax() <= 0.15 && turn.abs() <= 0.2 + 1e-12, "{offset} {turn}");
            spread = spread.max(offset.amax() / 0.15).max(turn.abs() / 0.2);
        }
        assert_eq!(poses(seed), drawn);
        assert_ne!(poses(seed + 1), drawn);
    }
    assert!(spread > 0.95, "the ranges are used: {spread}");
}

/// A gate whose range contains the start of the drone stays clear of it.
#[test]
fn solid_gates_keep_away_from_the_starts_of_the_drones() {
    let mut race = solid();
    race.gates = vec![[0.5, 0.0, 0.5], [2.0, 0.0, 1.0]];
    race.randomization = GateRanges { position: 0.5, yaw: 1.0 };
    let mut env = AviaryBuilder::new(race).num_drones(2).build().unwrap();
    for seed in 0..200 {
        env.reset(Some(seed)).unwrap();
        assert!((0..2).all(|drone| env.simulation().obstacle_distance(drone) > 0.05), "{seed}");
    }
}

#[test]
fn the_observation_has_the_gates_of_the_moment_and_their_normals() {
    let mut env = AviaryBuilder::new(moving()).build().unwrap();
    assert_eq!(env.observation_space().vector.size(), 27);
    env.reset(Some(2)).unwrap();
    for _ in 0..20 {
        step_env(&mut env, &[0.02, -0.01, 0.03, 0.01], 1);
        let seen = env.observation().vector.clone();
        let state = env.simulation().states()[0];
        let (next, second) = (env.task().gate_pose(0).unwrap(), env.task().gate_pose(1).unwrap());
        let body = |world: Vector3<f64>| state.attitude.inverse_transform_vector(&world);
        let expected = [next.0, body(next.0 - state.position), body(second.0 - state.position)];
        for (index, expected) in expected.into_iter().chain([body(next.1), body(second.1)]).enumerate() {
            let got = Vector3::from_column_slice(&seen[12 + 3 * index..][..3]);
            assert!((got - expected).norm() < 1e-12, "{index}: {got} {expected}");
        }
    }
    // the default race keeps its 21 numbers, also with normals turned off on solid gates
    assert_eq!(Race::builder().build().unwrap().observation_space().vector.size(), 21);
    let mut plain = solid();
    plain.normals = Some(false);
    assert_eq!(AviaryBuilder::new(plain).build().unwrap().observation_space().vector.size(), 21);
    let mut seen = Race::default();
    seen.normals = Some(true);
    assert_eq!(AviaryBuilder::new(seen).build().unwrap().observation_space().vector.size(), 27);
}

#[test]
fn races_with_frames_keep_the_contract_of_environments() {
    let mut visible = moving();
    visible.solid = false;
    let mut normals = Race::default();
    normals.normals = Some(true);
    for race in [solid(), moving(), visible, normals] {
        check_env(&mut AviaryBuilder::new(race).num_drones(2).build().unwrap()).unwrap();
    }
}

#[test]
fn a_flight_from_a_snapshot_equals_the_flight_after_it() {
    let mut env = AviaryBuilder::new(moving()).engine(EngineKind::Hybrid).build().unwrap();
    env.reset(Some(4)).unwrap();
    step_env(&mut env, &[0.02; 4], 20);
    let snapshot = env.snapshot();
    let ahead = |env: &mut Aviary<Race>| {
        step_env(env, &[0.05; 4], 15);
        (env.observation().vector.clone(), env.simulation().obstacles().to_vec())
    };
    let first = ahead(&mut env);
    env.restore(&snapshot).unwrap();
    assert_eq!(ahead(&mut env), first);
}

/// The built-in controller flies two laps of every built-in track from starts that vary, and of the default gates if
/// they are solid.
#[test]
fn the_geometric_controller_flies_every_track_without_a_contact() {
    let initial = Some(Randomization { initial: Some(Default::default()), ..Randomization::NONE });
    let tracks = RaceTrack::NAMES.map(|name| RaceTrack::named(name).unwrap());
    for track in tracks.into_iter().chain([solid().track()]) {
        // the last of the default gates is above the start
        let initial = initial.clone().filter(|_| track.gates[5].position[0] != 0.0);
        for (engine, seeds) in [(EngineKind::Mujoco, 1), (EngineKind::Hybrid, 12)] {
            let mut race = Race::default();
            race.set_track(&track);
            let builder = AviaryBuilder::new(race).engine(engine);
            let builder = initial.iter().fold(builder, |builder, initial| builder.randomization(initial.clone()));
            let mut env = builder.build().unwrap();
            for seed in 0..seeds {
                let mut pilot = ControllerPolicy::new(ControllerKind::Geometric, &env);
                let summary = fly_episode(&mut env, &mut pilot, Some(seed)).unwrap();
                assert!(summary.success, "{track:?}, {engine}, {seed}: {summary:?}");
                assert_eq!(env.task().gates_passed(0), 2 * track.gates.len());
            }
        }
    }
}

#[test]
fn the_geometric_controller_flies_through_gates_that_change_and_move() {
    let mut env = AviaryBuilder::new(moving()).engine(EngineKind::Hybrid).build().unwrap();
    let mut pilot = ControllerPolicy::new(ControllerKind::Geometric, &env);
    let flown = (0..20).filter(|&seed| fly_episode(&mut env, &mut pilot, Some(seed)).unwrap().success).count();
    assert!(flown >= 19, "{flown} of 20");
}

#[test]
fn options_of_a_track_reach_the_race_by_name() {
    let track = RaceTrack::named("stacked").unwrap();
    let config = |options: TaskOptions| EnvConfig::default().task(|own| *own = options);
    let set = TaskOptions { track: Some(track.clone()), ..TaskOptions::default() };
    let env = make("race", config(set.clone())).unwrap();
    assert_eq!(env.simulation().obstacles().len(), 24);
    let options = env.task_options();
    assert_eq!((options.laps, &options.track), (Some(2), &Some(track.clone())));
    // the options of an environment make the same environment
    assert_eq!(make("race", config(options.clone())).unwrap().task_options(), options);
    let fewer = TaskOptions { laps: Some(1), gates: Some(vec![[1.0, 0.0, 1.0]]), ..set.clone() };
    let options = make("race", config(fewer)).unwrap().task_options();
    assert_eq!((options.laps, options.gates.unwrap().len(), options.track.unwrap().solid), (Some(1), 1, true));
    let error = make("hover", config(set)).err().unwrap().to_string();
    assert_eq!(error, "the task `hover` has no option `track`, expected target_height");
}

#[test]
fn invalid_gates_are_errors_that_name_the_option() {
    let refused = |change: fn(&mut Race), text: &str| {
        let mut race = solid();
        change(&mut race);
        let error: EnvError = AviaryBuilder::new(race).build().map(|_| ()).unwrap_err();
        assert!(error.to_string().contains(text), "{error}");
    };
    refused(|race| race.opening = 0.1, "opening is 0.1 m for a drone of 0.12 m, expected more than the size");
    refused(|race| race.opening = -1.0, "opening is -1");
    refused(|race| race.yaws = vec![0.0], "yaws is 1 angle, expected none, or one per gate");
    refused(|race| race.yaws = vec![f64::NAN; 6], "gates.yaw is NaN");
    refused(|race| race.laps = 20, "gates is 120 gates");
    refused(|race| race.randomization.yaw = FRAC_PI_2 * 3.0, "randomization.yaw is");
    refused(|race| race.motion.period = 0.0, "motion.period is 0");
}
