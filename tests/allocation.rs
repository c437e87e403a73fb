//! Steps and resets do not allocate Rust memory after construction. MuJoCo has its own buffers, which are not counted.

mod common;

use allocation_counter::measure;
use common::{airframe_with_battery, reset_batch};
use mujoco_drones_gym::control::{ControllerKind, trajectory};
use mujoco_drones_gym::env::{AviaryBuilder, Randomization};
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::tasks;
use mujoco_drones_gym::world::ObstacleConfig;
use mujoco_drones_gym::wrappers::{CurriculumConfig, CurriculumWrapper};

#[test]
fn steps_of_a_simulation_do_not_allocate_in_the_air_and_on_the_floor() {
    for count in [1, 12] {
        let mut simulation = Simulation::builder(DroneModel::Cf2x).num_drones(count).build().unwrap();
        let commands = vec![[9_000.0; 4]; count];
        let mut touched = 0;
        let allocations = measure(|| {
            for _ in 0..200 {
                simulation.step(&commands).unwrap();
                touched += simulation.contacts().len();
            }
            simulation.reset().unwrap();
        });
        assert!(touched > 100 * count, "{touched} contacts with the floor");
        assert_eq!(allocations.count_total, 0, "{count} drones");
    }
}

#[test]
fn steps_and_resets_of_an_environment_do_not_allocate() {
    let mut env = Hover::builder().build().unwrap();
    let mut pid = PidControl::new(env.simulation().params(0));
    env.reset(Some(1)).unwrap();
    let allocations = measure(|| {
        let mut action = [0.0; 4];
        for _ in 0..100 {
            let rpm = pid.control(1.0 / 48.0, &env.simulation().states()[0], &env.reference(0)).rpm;
            env.action_of_motor_speeds(&[rpm], &mut action).unwrap();
            env.step(&action).unwrap();
            assert!(env.info().position_error < 1.0);
        }
        env.reset(Some(2)).unwrap();
        env.step(&action).unwrap();
    });
    assert_eq!(allocations.count_total, 0);
}

#[test]
fn controllers_trajectories_and_action_types_do_not_allocate() {
    let params = DroneModel::Cf2x.params();
    let path = trajectory::named("lemniscate").unwrap();
    for kind in ControllerKind::ALL {
        let mut control = kind.build(&params);
        let state = DroneState::default();
        let allocations = measure(|| {
            control.reset();
            for step in 0..100 {
                let output = control.control(0.02, &state, &path.reference(0.02 * f64::from(step)));
                assert!(output.rpm[0] >= 0.0);
            }
        });
        assert_eq!(allocations.count_total, 0, "{kind}");
    }
    for action_type in ActionType::ALL {
        let builder = Hover::builder().drone(airframe_with_battery(0.25)).action_type(action_type);
        let mut env = builder.initial_positions([[0.0, 0.0, 1.0]]).build().unwrap();
        let action = vec![0.1; env.action_space().size()];
        env.reset(Some(1)).unwrap();
        let allocations = measure(|| {
            for _ in 0..5 {
                env.step(&action).unwrap();
            }
        });
        assert_eq!(allocations.count_total, 0, "{action_type}");
    }
}

#[test]
fn steps_and_resets_of_every_task_do_not_allocate() {
    for name in tasks::NAMES {
        let mut env = make(name, EnvConfig::default().physics(Physics::MjcGndDragDw)).unwrap();
        env.reset(Some(1)).unwrap();
        let action = vec![0.01; env.action_space().size()];
        let allocations = measure(|| {
            for _ in 0..20 {
                env.step(&action).unwrap();
                assert!(env.info().progress <= 1.0);
            }
            env.reset(Some(2)).unwrap();
            env.step(&action).unwrap();
        });
        assert_eq!(allocations.count_total, 0, "{name}");
    }
}

#[test]
fn steps_with_wind_randomization_obstacles_and_a_curriculum_do_not_allocate() {
    let field = ObstacleConfig { count: 60, arena: [8.0, 8.0, 2.0], new_layout: true, ..ObstacleConfig::default() };
    let config = EnvConfig::default()
        .initial_positions([[0.0, 0.0, 1.0]])
        // includes a sampled wind
        .randomization(Randomization::default())
        .obstacle_generator(field)
        .observation_type(ObservationType::KIN_RANGES);
    let env = config.with_task(Hover::default()).build().unwrap();
    let easy = |_: &mut Aviary<Hover>, _: usize| Ok(());
    let mut env = CurriculumWrapper::new(env, CurriculumConfig::default(), easy).unwrap();
    env.reset(Some(1)).unwrap();
    env.step(&[0.0; 4]).unwrap();
    let allocations = measure(|| {
        for _ in 0..8 {
            env.step(&[0.02, 0.0, 0.01, 0.0]).unwrap();
        }
    });
    assert_eq!(allocations.count_total, 0);
}

#[test]
fn a_batch_does_not_allocate_after_its_first_steps() {
    let randomized = Randomization::default();
    for builder in [Hover::builder(), Hover::builder().physics(Physics::MjcGndDragDw).randomization(randomized)] {
        // with one thread, the batch runs on this thread, where allocations are counted
        let config = VecConfig { threads: 1, autoreset: Autoreset::SameStep, ..VecConfig::new(100) };
        let (mut env, mut buffers) = reset_batch(builder, config, 1);
        let actions: Vec<f32> = (0..400).map(|i| 0.3 * (i as f32).sin() - 0.1).collect();
        let mut ended = 0;
        for _ in 0..30 {
            env.step(&actions, buffers.step()).unwrap();
        }
        let allocations = measure(|| {
            for _ in 0..100 {
                env.step(&actions, buffers.step()).unwrap();
                ended += (0..100).filter(|&i| env.episode_summary(i).is_some()).count();
            }
        });
        assert!(ended > 100, "{ended} episodes ended");
        assert_eq!(allocations.count_total, 0);
    }
}

#[test]
fn an_environment_of_a_batch_needs_less_than_1200_bytes_and_randomized_less_than_5000() {
    let count = 8192;
    let config = VecConfig { threads: 1, ..VecConfig::new(count) };
    let size = |builder: AviaryBuilder<Hover>| {
        let mut reported = 0;
        let allocations = measure(|| {
            let env = VecAviary::new(builder, config).unwrap();
            reported = env.bytes_per_env();
            std::mem::forget(env);
        });
        let measured = allocations.bytes_current as usize / count;
        assert!(reported.abs_diff(measured) < 200, "{reported} bytes reported, {measured} measured");
        measured
    };
    let plain = size(Hover::builder());
    assert!(plain < 1200, "{plain}");
    // environments with their own airframe, motors and sensors
    let own = size(Hover::builder().randomization(Randomization::default()));
    assert!(own < 5000, "{own}");
}
