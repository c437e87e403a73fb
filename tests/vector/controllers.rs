//! Actions that pass through control loops: a batch runs the loops in SIMD lanes, bit-identical to the controllers of
//! single environments.

use mujoco_drones_gym::control::CollisionCone;
use mujoco_drones_gym::engine::flight::Width;
use mujoco_drones_gym::env::{AviaryBuilder, Randomization};
use mujoco_drones_gym::physics::wind::{WindConfig, WindModel};
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::tasks::Antipodal;
use mujoco_drones_gym::wrappers::SafetyWrapper;
use mujoco_drones_gym::{Rng, RngExt, SeedableRng};

use super::pair::Pair;

/// Action types with control loops, each with the controllers that it uses.
fn loops() -> Vec<(ActionType, ControllerKind)> {
    let kinds = || ControllerKind::ALL.into_iter();
    let both =
        [ActionType::Vel, ActionType::Pid].into_iter().flat_map(|action| kinds().map(move |kind| (action, kind)));
    both.chain([(ActionType::Attitude, ControllerKind::Pid), (ActionType::Ctbr, ControllerKind::Pid)]).collect()
}

/// Commands that stay the same for some steps: gentle ones, and sometimes ones at and beyond the bounds.
struct Pilot {
    rng: Rng,
    /// Centre and half range of the gentle commands of one environment.
    gentle: Vec<[f32; 2]>,
    bounds: Vec<[f32; 2]>,
    held: Vec<f32>,
}

impl Pilot {
    fn new<T: Task + Clone + Send + Sync>(pair: &Pair<T>, seed: u64) -> Self {
        let (space, kind) = (pair.batch.action_space(), pair.alone[0].action_type());
        let bounds: Vec<_> = space.low().iter().zip(space.high()).map(|(&a, &b)| [a as f32, b as f32]).collect();
        let gentle = match kind {
            ActionType::Vel => [[0.0, 0.3], [0.0, 0.3], [0.0, 0.2], [0.0, 1.0]],
            ActionType::Pid => [[0.0, 1.0], [0.0, 1.0], [0.8, 0.4], [0.0, 3.2]],
            ActionType::Attitude => [[0.02, 0.05], [0.0, 0.3], [0.0, 0.3], [0.0, 0.5]],
            _ => [[0.02, 0.05], [0.0, 0.05], [0.0, 0.05], [0.0, 0.3]],
        };
        let drones = bounds.len() / 4;
        let held = vec![0.0; bounds.len() * pair.alone.len()];
        Self { rng: Rng::seed_from_u64(seed), gentle: gentle.repeat(drones), bounds, held }
    }

    fn next(&mut self) -> &[f32] {
        let Self { rng, gentle, bounds, held } = self;
        for row in held.chunks_exact_mut(bounds.len()) {
            let chance = rng.random::<f32>();
            if chance > 0.12 {
                continue;
            }
            for ((x, &[centre, range]), &[low, high]) in row.iter_mut().zip(&*gentle).zip(&*bounds) {
                let uniform = 2.0 * rng.random::<f32>() - 1.0;
                // one change in twenty is far from the drone's state, and saturates
                *x = if chance < 0.006 {
                    0.5 * (low + high) + 0.7 * (high - low) * uniform
                } else {
                    centre + range * uniform
                };
            }
        }
        held
    }
}

/// Flies a batch and single environments, with resets and changes in mid-flight. Returns the number of episodes that
/// ended.
fn fly<T: Task + Clone + Send + Sync>(builder: AviaryBuilder<T>, config: VecConfig, steps: usize) -> usize {
    let mut pair = Pair::new(&builder, config, 21);
    let (mut pilot, count) = (Pilot::new(&pair, 6), pair.alone.len());
    for step in 0..steps {
        pair.step(pilot.next());
        let i = step % count;
        match step {
            // the memory of the controllers must survive the exchange, the first step after it depends on it
            _ if step % 5 == 2 => pair.compare_exactly(i),
            17 => pair.reset_where(&(0..count).map(|i| i % 3 == 1).collect::<Vec<_>>(), None),
            24 => pair.change(i, |env| {
                // an environment that samples its wind refuses another one
                let sampled = env.sampled_params().is_some();
                assert_eq!(env.set_wind(Some(WindConfig::new(WindModel::Constant))).is_err(), sampled);
            }),
            _ => {}
        }
    }
    pair.compare_all_exactly();
    pair.ended
}

#[test]
fn control_loops_are_bit_identical_for_every_task_width_and_number_of_threads() {
    let config = |environments, threads, width, autoreset| VecConfig {
        threads,
        width,
        autoreset,
        ..VecConfig::new(environments)
    };
    let mut ended = 0;
    for (action, controller) in loops() {
        for width in Width::available() {
            let hover = Hover::builder()
                .action_type(action)
                .controller(controller)
                .initial_positions([[0.0, 0.0, 0.5]])
                .initial_rpys([[0.1, -0.1, 2.9]])
                .engine(EngineKind::Hybrid)
                .episode_seconds(1.2);
            ended += fly(hover, config(11, 2, width, Autoreset::SameStep), 90);
        }
        let swarm = MultiHover::builder()
            .num_drones(3)
            .action_type(action)
            .controller(controller)
            .physics(Physics::MjcGndDragDw)
            .engine(EngineKind::Hybrid)
            .episode_seconds(1.2);
        ended += fly(swarm, config(9, 1, Width::best(), Autoreset::NextStep), 90);
        let race =
            Race::builder().action_type(action).controller(controller).engine(EngineKind::Hybrid).episode_seconds(1.2);
        ended += fly(race, config(17, 3, Width::best(), Autoreset::Disabled), 70);
        let few = Velocity::builder()
            .action_type(action)
            .controller(controller)
            .engine(EngineKind::Hybrid)
            .episode_seconds(1.2);
        ended += fly(few, config(3, 1, Width::best(), Autoreset::SameStep), 70);
    }
    assert!(ended > 500, "{ended}");
}

/// Drones that touch the floor and take off again leave the lanes and return to them.
#[test]
fn control_loops_are_bit_identical_through_contacts_and_with_other_engines() {
    for (action, controller) in loops() {
        let hover = || {
            Hover::builder()
                .action_type(action)
                .controller(controller)
                .initial_positions([[0.0, 0.0, 0.05]])
                .initial_rpys([[0.0, 0.0, -2.0]])
                .engine(EngineKind::Hybrid)
                .task(|hover| (hover.crash.floor_contact, hover.crash.max_tilt) = (false, 4.0))
        };
        let config = VecConfig { threads: 2, autoreset: Autoreset::SameStep, ..VecConfig::new(10) };
        fly(hover(), config, 60);
        fly(hover().randomization(Randomization::default()), config, 60);
        fly(hover().engine(EngineKind::Mujoco), config, 40);
        fly(Hover::builder().physics(Physics::Dyn).action_type(action).controller(controller), config, 40);
    }
}

#[test]
fn snapshots_of_environments_in_a_batch_keep_the_memory_of_their_controllers() {
    for (action, controller) in loops() {
        let builder = Hover::builder()
            .action_type(action)
            .controller(controller)
            .engine(EngineKind::Hybrid)
            .initial_positions([[0.0, 0.0, 1.0]]);
        let mut pair = Pair::new(&builder, VecConfig::new(9), 4);
        let mut pilot = Pilot::new(&pair, 8);
        (0..20).for_each(|_| pair.step(pilot.next()));
        for i in [0, 4, 8] {
            let snapshot = pair.batch.with(i, |env| env.snapshot()).unwrap();
            let mut env = builder.clone().stream(99).build().unwrap();
            env.restore(&snapshot).unwrap();
            pair.alone[i] = env;
        }
        (0..15).for_each(|_| pair.step(pilot.next()));
        pair.compare_all_exactly();
    }
}

#[test]
fn actions_that_are_not_finite_affect_their_own_environment_alone() {
    for (action, controller) in loops() {
        let builder = Hover::builder()
            .action_type(action)
            .controller(controller)
            .engine(EngineKind::Hybrid)
            .initial_positions([[0.0, 0.0, 1.0]]);
        for autoreset in [Autoreset::SameStep, Autoreset::NextStep] {
            let config = VecConfig { on_fault: OnFault::Truncate, autoreset, threads: 2, ..VecConfig::new(12) };
            let mut pair = Pair::new(&builder, config, 4);
            let mut pilot = Pilot::new(&pair, 3);
            for step in 0..30 {
                let mut actions = pilot.next().to_vec();
                if step % 7 == 3 {
                    actions[4 * (step % 12) + step % 4] = [f32::NAN, f32::INFINITY][step % 2];
                }
                pair.step(&actions);
            }
            pair.compare_all_exactly();
            assert!(pair.ended >= 3);
        }
    }
}

/// The filter changes the actions of one environment at a time, before the control loops in lanes.
#[test]
fn control_loops_after_the_safety_filter_are_bit_identical_in_every_width() {
    for controller in ControllerKind::ALL {
        let builder = || Antipodal::builder().num_drones(4).action_type(ActionType::Vel).controller(controller);
        let filter = || CollisionCone::new(0.36);
        for width in Width::available() {
            let config = VecConfig { width, threads: 2, ..VecConfig::new(10) };
            let mut batch = VecAviary::new(builder(), config).unwrap().safety(filter(), 10.0).unwrap();
            let mut buffers = VecBuffers::new(&batch);
            batch.reset(Some(1), &mut buffers.observations).unwrap();
            let mut alone: Vec<_> = (0..10)
                .map(|i| {
                    let env = builder().engine(EngineKind::Hybrid).stream(i).build().unwrap();
                    SafetyWrapper::new(env, filter()).unwrap()
                })
                .collect();
            alone.iter_mut().for_each(|env| {
                env.reset(Some(1)).unwrap();
            });
            let size = batch.observation_size();
            let mut row = vec![0.0; size];
            for _ in 0..60 {
                // all drones fly towards the centre, at different speeds
                let towards = |(i, env): (usize, &SafetyWrapper<Aviary<Antipodal>>)| -> Vec<f32> {
                    let gain = -0.4 - 0.05 * i as f32;
                    let states = env.simulation().states().iter();
                    states.flat_map(|s| [gain * s.position.x as f32, gain * s.position.y as f32, 0.0, 0.2]).collect()
                };
                let actions: Vec<f32> = alone.iter().enumerate().flat_map(towards).collect();
                batch.step(&actions, buffers.step()).unwrap();
                for (i, env) in alone.iter_mut().enumerate() {
                    env.step(&super::widen(&actions[16 * i..][..16])).unwrap();
                    batch.observation_space().vector.write_f32(&env.observation().vector, &mut row);
                    let got = &buffers.observations[size * i..][..size];
                    assert_eq!(super::bits(got), super::bits(&row), "{controller} {width} {i}");
                }
            }
            assert!(alone.iter().map(SafetyWrapper::interventions).sum::<u64>() > 50);
        }
    }
}
