//! Episodes on the GPU: resets, ends, random starts, faults and errors.
#![cfg(feature = "wgpu")]

mod support;

use aviary::action::ActionType;
use aviary::control::ControllerKind;
use aviary::drone::DroneModel;
use aviary::env::{EndReason, EnvConfig, EnvError, Randomization};
use aviary::physics::Physics;
use aviary::vector::{Autoreset, OnFault, VecBuffers, VecConfig, VecEnv, make_vec};
use aviary::world::Medium;
use aviary_gpu::{GpuAviary, GpuDevice, Precision, adapters};
use support::{Noise, device};

/// Control step and reason of an end.
type End = (i32, Option<EndReason>);

fn gpu(device: &GpuDevice, config: VecConfig) -> GpuAviary {
    GpuAviary::make("hover", EnvConfig::default(), config, device, Precision::Single).unwrap()
}

/// Random actions: a bias of every environment, larger for each motor in the second half of them, and noise.
fn random_actions(count: usize, noise: &mut Noise) -> Vec<f32> {
    (0..count)
        .flat_map(|index| {
            let mut bias = Noise(index as u64);
            let (common, spread) = (0.2 * bias.next(), if index < count / 2 { 0.0 } else { 0.05 });
            [0; 4].map(|_| (common - 0.05 + spread * bias.next() + 0.02 * noise.next()) as f32)
        })
        .collect()
}

/// The copy has more workgroups than a device allows along one axis.
#[test]
fn the_bandwidth_of_a_device_is_measurable() {
    let Some(device) = device("the_bandwidth_of_a_device_is_measurable") else { return };
    let bandwidth = aviary_gpu::bandwidth(&device).unwrap();
    assert!(bandwidth > 1e7 && bandwidth < 1e14, "{bandwidth}");
}

#[test]
fn random_flights_end_as_on_the_cpu() {
    let Some(device) = device("random_flights_end_as_on_the_cpu") else { return };
    const COUNT: usize = 10_000;
    let config = VecConfig { autoreset: Autoreset::NextStep, ..VecConfig::new(COUNT) };
    let mut cpu = make_vec("hover", EnvConfig::default(), config).unwrap();
    let mut gpu = gpu(&device, config);
    let (mut on_cpu, mut on_gpu) = (VecBuffers::new(&*cpu), VecBuffers::new(&gpu));
    cpu.reset(Some(1), &mut on_cpu.observations).unwrap();
    gpu.reset(Some(1), &mut on_gpu.observations).unwrap();
    let mut noise = Noise(3);
    // step and reason of the first end of every environment
    let mut ends = vec![[None; 2]; COUNT];
    let (mut rewards, mut equal_rewards) = (0, 0);
    for step in 0..480_i32 {
        let actions = random_actions(COUNT, &mut noise);
        cpu.step(&actions, on_cpu.step()).unwrap();
        gpu.step(&actions, on_gpu.step()).unwrap();
        for (environment, ends) in ends.iter_mut().enumerate() {
            // the contact slows the drone on the CPU, and changes the reward of its step
            let end = gpu.episode_summary(environment).and_then(|summary| summary.end);
            if *ends == [None; 2] && end != Some(EndReason::FloorContact) {
                rewards += 1;
                equal_rewards += usize::from((on_cpu.rewards[environment] - on_gpu.rewards[environment]).abs() < 1e-3);
            }
            let summaries = [cpu.episode_summary(environment), gpu.episode_summary(environment)];
            for (end, summary) in ends.iter_mut().zip(summaries) {
                *end = end.or(summary.map(|summary| (step, summary.end)));
            }
        }
    }
    let none = (-1000, None);
    let either = ends.iter().filter(|ends| **ends != [None; 2]);
    let both: Vec<(End, End)> = either.map(|[cpu, gpu]| (cpu.unwrap_or(none), gpu.unwrap_or(none))).collect();
    assert!(both.len() > 9 * COUNT / 10, "{} episodes ended", both.len());
    let reasons = [EndReason::FloorContact, EndReason::Tilt, EndReason::OutOfBounds];
    for reason in &reasons[..2] {
        let count = both.iter().filter(|((_, end), _)| *end == Some(*reason)).count();
        assert!(count > COUNT / 20, "{count} ends by {reason}");
    }
    let equal = both.iter().filter(|(cpu, gpu)| cpu == gpu).count();
    assert!(equal as f64 >= 0.999 * both.len() as f64, "{equal} of {} ends", both.len());
    assert!(both.iter().all(|(cpu, gpu)| (cpu.0 - gpu.0).abs() <= 1), "ends more than one control step apart");
    assert!(equal_rewards as f64 >= 0.999 * rewards as f64, "{equal_rewards} of {rewards} rewards");
}

#[test]
fn resets_happen_at_the_same_steps_as_on_the_cpu() {
    let Some(device) = device("resets_happen_at_the_same_steps_as_on_the_cpu") else { return };
    for autoreset in [Autoreset::NextStep, Autoreset::SameStep] {
        let config = VecConfig { autoreset, ..VecConfig::new(3) };
        let builder = EnvConfig::default().episode_seconds(0.25);
        let mut cpu = make_vec("hover", builder.clone(), config).unwrap();
        let mut gpu = GpuAviary::make("hover", builder, config, &device, Precision::Single).unwrap();
        let (mut on_cpu, mut on_gpu) = (VecBuffers::new(&*cpu), VecBuffers::new(&gpu));
        cpu.reset(Some(1), &mut on_cpu.observations).unwrap();
        gpu.reset(Some(1), &mut on_gpu.observations).unwrap();
        for step in 0..40 {
            // the second drone crashes on the floor, the third one tilts
            let actions = [0.2, 0.2, 0.2, 0.2, -1.0, -1.0, -1.0, -1.0, 0.3, 0.3, -0.3, -0.3];
            cpu.step(&actions, on_cpu.step()).unwrap();
            gpu.step(&actions, on_gpu.step()).unwrap();
            assert_eq!(on_cpu.terminated, on_gpu.terminated, "{autoreset:?}, step {step}");
            assert_eq!(on_cpu.truncated, on_gpu.truncated, "{autoreset:?}, step {step}");
            for environment in 0..3 {
                let (a, b) = (cpu.episode_summary(environment), gpu.episode_summary(environment));
                assert_eq!(a.map(|a| (a.steps, a.end, a.success)), b.map(|b| (b.steps, b.end, b.success)));
                let difference = a.zip(b).map_or(0.0, |(a, b)| (a.reward - b.reward).abs());
                // the contact slows the drone on the CPU
                let contact = a.is_some_and(|a| a.end == Some(EndReason::FloorContact));
                assert!(difference < if contact { 0.1 } else { 1e-3 }, "{difference}");
                // after a contact the CPU computes its force, and the GPU resets
                let ended = on_cpu.terminated[environment] && autoreset == Autoreset::NextStep;
                let rows = [&on_cpu, &on_gpu].map(|buffers| &buffers.observations[12 * environment..][..12]);
                let apart = rows[0].iter().zip(rows[1]).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
                assert!(ended || apart < 1e-3, "{autoreset:?}, step {step}, environment {environment}: {rows:?}");
            }
        }
        if autoreset == Autoreset::SameStep {
            let finals = gpu.final_observations();
            assert!(finals[2] > 0.11 && finals[14] < 0.1, "{finals:?}");
        }
    }
}

#[test]
fn results_do_not_depend_on_the_size_of_the_batch_or_of_the_workgroup() {
    let Some(device) = device("results_do_not_depend_on_the_size_of_the_batch_or_of_the_workgroup") else { return };
    let fly = |count: usize, workgroup: u32| {
        let config = VecConfig { autoreset: Autoreset::SameStep, ..VecConfig::new(count) };
        let builder = EnvConfig::default().episode_seconds(0.5);
        let env = GpuAviary::make("stabilize", builder, config, &device, Precision::Single).unwrap();
        let mut env = env.workgroup(workgroup).unwrap();
        let mut buffers = VecBuffers::new(&env);
        env.reset(Some(7), &mut buffers.observations).unwrap();
        let mut rows = buffers.observations[..12 * 10].to_vec();
        for _ in 0..40 {
            env.step(&vec![0.01; 4 * count], buffers.step()).unwrap();
            rows.extend_from_slice(&buffers.observations[..12 * 10]);
        }
        rows
    };
    let expected = fly(10, 64);
    assert_eq!(expected, fly(1000, 64));
    assert_eq!(expected, fly(300, 256));
    assert_eq!(expected, fly(33, 1));
}

#[test]
fn seeds_and_episodes_have_different_starts_within_the_ranges() {
    let Some(device) = device("seeds_and_episodes_have_different_starts_within_the_ranges") else { return };
    const COUNT: usize = 20_000;
    let mut env =
        GpuAviary::make("stabilize", EnvConfig::default(), VecConfig::new(COUNT), &device, Precision::Single).unwrap();
    let start = |env: &mut GpuAviary, seed| {
        let mut rows = vec![0.0; 12 * COUNT];
        env.reset(seed, &mut rows).unwrap();
        rows
    };
    let first = start(&mut env, Some(1));
    let second = start(&mut env, None);
    assert_ne!(first, second);
    assert_ne!(first, start(&mut env, Some(1 << 40)));
    assert_eq!(first, start(&mut env, Some(1)));
    assert_eq!(second, start(&mut env, None));
    // Kolmogorov–Smirnov at the level of 1e-6, for roll to body rate z
    let pi = std::f32::consts::PI;
    for (entry, max) in [(3, 0.5), (4, 0.5), (5, pi), (6, 1.0), (7, 1.0), (8, 1.0), (9, 2.0), (10, 2.0), (11, 2.0)] {
        let mut values: Vec<f64> =
            first.chunks_exact(12).map(|row| f64::from((row[entry] / max + 1.0) / 2.0)).collect();
        values.sort_by(f64::total_cmp);
        let count = COUNT as f64;
        let distance = values.iter().enumerate().map(|(index, x)| (x - index as f64 / count).abs());
        let distance = distance.fold(0.0, f64::max);
        assert!(distance < 2.7 / count.sqrt(), "entry {entry}: {distance}");
    }
}

#[test]
fn a_mask_resets_some_environments() {
    let Some(device) = device("a_mask_resets_some_environments") else { return };
    let mut env = gpu(&device, VecConfig::new(2));
    let mut buffers = VecBuffers::new(&env);
    env.reset(Some(1), &mut buffers.observations).unwrap();
    for _ in 0..10 {
        env.step(&[0.5; 8], buffers.step()).unwrap();
    }
    let before = buffers.observations.clone();
    env.reset_where(&[false, true], None, &mut buffers.observations).unwrap();
    assert_eq!(buffers.observations[..12], before[..12]);
    assert_eq!(buffers.observations[14], 0.1);
    env.step(&[0.5; 8], buffers.step()).unwrap();
    assert!(buffers.observations[2] > before[2]);
}

#[test]
fn a_fault_ends_the_episode_of_its_environment_alone() {
    let Some(device) = device("a_fault_ends_the_episode_of_its_environment_alone") else { return };
    let mut actions = [0.01; 12];
    actions[5] = f32::NAN;
    let config = VecConfig { on_fault: OnFault::Truncate, ..VecConfig::new(3) };
    let mut env = gpu(&device, config);
    let mut buffers = VecBuffers::new(&env);
    env.reset(Some(1), &mut buffers.observations).unwrap();
    env.step(&actions, buffers.step()).unwrap();
    assert_eq!(buffers.truncated, [false, true, false]);
    assert_eq!(buffers.rewards[1], 0.0);
    assert!(buffers.observations.iter().all(|x| x.is_finite()));
    assert!(matches!(env.faults(), [(1, EnvError::Action { index: 1, .. })]), "{:?}", env.faults());
    let summary = env.episode_summary(1).unwrap();
    assert_eq!((summary.end, summary.steps), (Some(EndReason::Fault), 0));
    env.step(&actions, buffers.step()).unwrap();
    assert_eq!((buffers.truncated[1], buffers.observations[14]), (false, 0.1));
    assert_eq!(env.episode_summary(1), None);
    // by default, the step is rejected
    let mut env = gpu(&device, VecConfig::new(3));
    env.reset(Some(1), &mut buffers.observations).unwrap();
    let error = env.step(&actions, buffers.step()).unwrap_err().to_string();
    assert_eq!(error, "environment 1: action[1] is NaN at t = 0 s, expected a finite number");
}

#[test]
fn steps_outside_an_episode_are_errors() {
    let Some(device) = device("steps_outside_an_episode_are_errors") else { return };
    let config = VecConfig { autoreset: Autoreset::Disabled, ..VecConfig::new(1) };
    let builder = EnvConfig::default().episode_seconds(0.05);
    let mut env = GpuAviary::make("hover", builder, config, &device, Precision::Single).unwrap();
    let mut buffers = VecBuffers::new(&env);
    let error = env.step(&[0.0; 4], buffers.step()).unwrap_err().to_string();
    assert_eq!(error, "environment 0: step was called on a new environment, expected a call of reset first");
    env.reset(Some(1), &mut buffers.observations).unwrap();
    for _ in 0..env.episode_steps() {
        env.step(&[0.0; 4], buffers.step()).unwrap();
    }
    assert_eq!((buffers.terminated[0], buffers.truncated[0]), (false, true));
    assert!(env.step(&[0.0; 4], buffers.step()).unwrap_err().to_string().contains("after the end of the episode"));
    env.reset(None, &mut buffers.observations).unwrap();
    env.step(&[0.0; 4], buffers.step()).unwrap();
    assert!(env.repeat_on_device(1).is_err());
}

#[test]
fn steps_without_copies_equal_steps_with_them() {
    let Some(device) = device("steps_without_copies_equal_steps_with_them") else { return };
    let config = VecConfig { autoreset: Autoreset::SameStep, ..VecConfig::new(5) };
    let [mut one, mut other] = [gpu(&device, config), gpu(&device, config)];
    let mut buffers = VecBuffers::new(&one);
    one.reset(Some(1), &mut buffers.observations).unwrap();
    other.reset(Some(1), &mut buffers.observations).unwrap();
    for _ in 0..30 {
        one.step(&[0.1; 20], buffers.step()).unwrap();
    }
    other.step(&[0.1; 20], buffers.step()).unwrap();
    other.repeat_on_device(29).unwrap();
    assert_eq!(one.states().unwrap(), other.states().unwrap());
    assert_eq!(other.engine_substeps().flight, 30 * 5 * 5);
}

#[test]
fn every_error_is_one_line() {
    let Some(device) = device("every_error_is_one_line") else { return };
    let error = |builder, config| -> String {
        let error =
            GpuAviary::make("hover", builder, config, &device, Precision::Single).map(|_| ()).unwrap_err().to_string();
        assert!(!error.contains('\n') && !error.is_empty(), "{error}");
        error
    };
    let hover = EnvConfig::default;
    assert_eq!(error(hover(), VecConfig::new(0)), "environments is 0, expected at least 1");
    let many = error(hover(), VecConfig::new(usize::MAX));
    assert!(many.starts_with("environments is 18446744073709551615, expected at most "), "{many}");
    assert!(many.contains(&device.adapter().name), "{many}");
    let action = error(hover().drone(DroneModel::Cf21), VecConfig::new(1));
    assert_eq!(action, "drone.motors is set, expected an airframe without it on the GPU");
    let medium = hover().medium(Medium { density: 1.2, viscosity: 1.8e-5 }).randomization(Randomization::default());
    let medium = error(medium, VecConfig::new(1));
    let expected = "medium is set with a randomized body, expected no medium, or no randomized body on the GPU";
    assert_eq!(medium, expected);
    let engine = error(hover().physics(Physics::Dyn), VecConfig::new(1));
    assert_eq!(engine, "engine is explicit, expected mujoco or hybrid on the GPU");
    let task = |name: &str, options| {
        let made = GpuAviary::make(name, options, VecConfig::new(1), &device, Precision::Single);
        made.map(|_| ()).unwrap_err().to_string()
    };
    let unknown = task("no_such_task", hover());
    assert!(unknown.starts_with("task is no_such_task, expected one of antipodal fly_through "), "{unknown}");
    let low = task("stabilize", hover().initial_positions([[0.0, 0.0, 0.05]]));
    assert!(low.contains("initial_positions") && low.contains("more than 0.01 m"), "{low}");
    let close = task("formation", hover().randomization(Randomization::default()));
    assert!(close.contains("initial_positions is 0.") && close.contains("cannot meet"), "{close}");
    let unknown = GpuDevice::open(Some("no such device")).map(|_| ()).unwrap_err().to_string();
    assert!(unknown.contains("does not exist") && unknown.contains(&adapters()[0].name), "{unknown}");
}

/// The body rate grows to hundreds of radians per second, beyond the range of the usual equations of a physics step.
#[test]
fn a_fast_spin_is_that_of_the_cpu() {
    let Some(device) = device("a_fast_spin_is_that_of_the_cpu") else { return };
    let options = EnvConfig::default().initial_positions([[0.0, 0.0, 1.5]]);
    let config = VecConfig { autoreset: Autoreset::Disabled, ..VecConfig::new(1) };
    let mut cpu = make_vec("hover", options.clone(), config).unwrap();
    for precision in [Precision::Single, Precision::Double] {
        if precision == Precision::Double && !device.adapter().double {
            continue;
        }
        let mut gpu = GpuAviary::make("hover", options.clone(), config, &device, precision).unwrap();
        let (mut on_cpu, mut on_gpu) = (VecBuffers::new(&*cpu), VecBuffers::new(&gpu));
        cpu.reset(Some(1), &mut on_cpu.observations).unwrap();
        gpu.reset(Some(1), &mut on_gpu.observations).unwrap();
        let mut fastest: f32 = 0.0;
        for step in 0..80 {
            // two motors carry the weight
            cpu.step(&[-1.0, 0.82, -1.0, 0.82], on_cpu.step()).unwrap();
            gpu.step(&[-1.0, 0.82, -1.0, 0.82], on_gpu.step()).unwrap();
            assert_eq!(on_cpu.terminated, on_gpu.terminated, "step {step}");
            let limit = if precision == Precision::Single { 2e-3 } else { 1e-6 };
            for (entry, (a, b)) in on_cpu.observations.iter().zip(&on_gpu.observations).enumerate() {
                let mut apart = (a - b).abs() / (1.0 + 0.01 * a.abs());
                if (3..6).contains(&entry) {
                    apart = apart.min(std::f32::consts::TAU - apart);
                }
                assert!(apart < limit, "{precision:?}, step {step}, entry {entry}: {a} and {b}");
            }
            fastest = fastest.max(on_gpu.observations[11].abs());
            if on_gpu.terminated[0] {
                break;
            }
        }
        assert!(fastest > 500.0, "{fastest} rad/s");
    }
}

/// Large finite actions are clipped to their bounds.
#[test]
fn large_actions_are_those_at_the_bounds() {
    let Some(device) = device("large_actions_are_those_at_the_bounds") else { return };
    let mut env = gpu(&device, VecConfig::new(2));
    let mut buffers = VecBuffers::new(&env);
    env.reset(Some(1), &mut buffers.observations).unwrap();
    for _ in 0..5 {
        env.step_f64(&[1.0, 1.0, 1.0, 1.0, 1e300, f64::MAX, 1e9, 1.0], buffers.step()).unwrap();
    }
    assert_eq!(buffers.observations[..12], buffers.observations[12..]);
}

/// Rewards and observations of tasks with random starts, recomputed from the observed numbers.
#[test]
fn random_tasks_have_their_rewards() {
    let Some(device) = device("random_tasks_have_their_rewards") else { return };
    const COUNT: usize = 50;
    for task in ["stabilize", "track", "velocity"] {
        let options = EnvConfig::default();
        let mut env = GpuAviary::make(task, options, VecConfig::new(COUNT), &device, Precision::Single).unwrap();
        let size = env.observation_size();
        let mut buffers = VecBuffers::new(&env);
        env.reset(Some(3), &mut buffers.observations).unwrap();
        let mut over = [false; COUNT];
        for step in 1..60 {
            env.step(&[0.01; 4 * COUNT], buffers.step()).unwrap();
            for (index, row) in buffers.observations.chunks_exact(size).enumerate() {
                over[index] |= buffers.terminated[index];
                if over[index] {
                    continue;
                }
                let at = |entry: usize| f64::from(row[entry]);
                let norm = |list: &[f64]| list.iter().map(|x| x * x).sum::<f64>().sqrt();
                let three = |first: usize| [0, 1, 2].map(|axis| at(first + axis));
                let lean = 0.05 * (at(3).abs() + at(4).abs());
                let bonus = |near: bool| if near { 0.5 } else { 0.0 };
                let expected = match task {
                    "stabilize" => {
                        let (speed, rate) = (norm(&three(6)), norm(&three(9)));
                        bonus(speed < 0.05 && rate < 0.1) - speed - 0.1 * rate - lean
                    }
                    "track" => {
                        let (error, target) = (norm(&three(12)), three(15));
                        // the reference turns about the axis at a radius of 0.5 m, faster and faster for a second
                        let reference = [0, 1, 2].map(|axis| at(axis) + at(12 + axis));
                        assert!((norm(&reference[..2]) - 0.5).abs() < 1e-5 && (reference[2] - 1.0).abs() < 1e-5);
                        let time = f64::from(step) / 48.0;
                        assert!((norm(&target) - 0.5 * time.min(1.0)).abs() < 1e-5, "step {step}: {target:?}");
                        assert!((reference[0] * target[0] + reference[1] * target[1]).abs() < 1e-5);
                        let velocity = [0, 1, 2].map(|axis| at(6 + axis) - target[axis]);
                        bonus(error < 0.05) - error - 0.1 * norm(&velocity) - lean
                    }
                    _ => {
                        let velocity = [0, 1, 2].map(|axis| at(6 + axis) - at(12 + axis));
                        let error = norm(&velocity);
                        bonus(error < 0.05) - error - 0.1 * (at(11) - at(15)).abs() - lean
                    }
                };
                let got = f64::from(buffers.rewards[index]);
                assert!((got - expected).abs() < 1e-4, "{task}, step {step}: {got}, expected {expected}");
            }
        }
        assert!(over.iter().filter(|over| **over).count() < COUNT / 2, "{task}: most drones have crashed");
    }
}

/// Two drones fly towards each other.
#[test]
fn drones_collide_as_on_the_cpu() {
    let Some(device) = device("drones_collide_as_on_the_cpu") else { return };
    const COUNT: usize = 200;
    let mut equal = 0;
    let options = EnvConfig::default()
        .episode_seconds(4.0)
        .num_drones(2)
        .initial_positions([[0.0, 0.0, 1.0], [0.8, 0.0, 1.0]])
        .action_type(ActionType::Vel)
        .controller(ControllerKind::Dsl);
    let config = VecConfig { autoreset: Autoreset::NextStep, ..VecConfig::new(COUNT) };
    let mut cpu = make_vec("multi_hover", options.clone(), config).unwrap();
    let mut gpu = GpuAviary::make("multi_hover", options, config, &device, Precision::Single).unwrap();
    let (mut on_cpu, mut on_gpu) = (VecBuffers::new(&*cpu), VecBuffers::new(&gpu));
    cpu.reset(Some(1), &mut on_cpu.observations).unwrap();
    gpu.reset(Some(1), &mut on_gpu.observations).unwrap();
    let mut noise = Noise(5);
    let courses: Vec<[f32; 8]> = (0..COUNT)
        .map(|_| {
            let mut random = |scale: f64| (scale * noise.next()) as f32;
            [0.2, random(0.02), random(0.01), random(0.3), -0.25, random(0.02), random(0.01), random(0.3)]
        })
        .collect();
    let mut ends: Vec<[Option<End>; 2]> = vec![[None; 2]; COUNT];
    for step in 0..300_i32 {
        cpu.step(courses.as_flattened(), on_cpu.step()).unwrap();
        gpu.step(courses.as_flattened(), on_gpu.step()).unwrap();
        for (environment, ends) in ends.iter_mut().enumerate() {
            let summaries = [cpu.episode_summary(environment), gpu.episode_summary(environment)];
            for (end, summary) in ends.iter_mut().zip(summaries) {
                *end = end.or(summary.map(|summary| (step, summary.end)));
            }
        }
    }
    let mut collisions = 0;
    for [one, other] in ends {
        let (Some(one), Some(other)) = (one, other) else { panic!("an episode without an end") };
        collisions += usize::from(one.1 == Some(EndReason::DroneContact));
        equal += usize::from(one == other);
        assert!((one.0 - other.0).abs() <= 1, "{one:?} and {other:?}");
    }
    assert!(collisions > COUNT / 2 && equal as f64 >= 0.95 * COUNT as f64, "{equal} equal, {collisions} collisions");
}

/// A drone that starts on the floor takes off from it.
#[test]
fn a_drone_stands_on_the_floor_until_it_takes_off() {
    let Some(device) = device("a_drone_stands_on_the_floor_until_it_takes_off") else { return };
    let options = EnvConfig::default().initial_positions([[0.0, 0.0, 0.016]]);
    let mut cpu = make_vec("hover", options.clone(), VecConfig::new(1)).unwrap();
    let mut gpu = GpuAviary::make("hover", options, VecConfig::new(1), &device, Precision::Single).unwrap();
    let (mut on_cpu, mut on_gpu) = (VecBuffers::new(&*cpu), VecBuffers::new(&gpu));
    cpu.reset(Some(1), &mut on_cpu.observations).unwrap();
    gpu.reset(Some(1), &mut on_gpu.observations).unwrap();
    for step in 0..150 {
        let action = if step < 48 {
            -0.5
        } else if step < 100 {
            0.1
        } else {
            -0.5
        };
        cpu.step(&[action; 4], on_cpu.step()).unwrap();
        gpu.step(&[action; 4], on_gpu.step()).unwrap();
        assert_eq!(on_cpu.terminated, on_gpu.terminated, "step {step}");
        if on_gpu.terminated[0] {
            assert!(step > 100);
            return;
        }
        let (a, b) = (on_cpu.observations[2], on_gpu.observations[2]);
        assert!((a - b).abs() < 5e-3, "step {step}: {a} m and {b} m");
    }
    panic!("the drone has not fallen back to the floor");
}

/// An environment that needs a reset does not stop the others of a batch whose faults truncate.
#[test]
fn an_episode_that_has_ended_waits_for_its_reset() {
    let Some(device) = device("an_episode_that_has_ended_waits_for_its_reset") else { return };
    let config = VecConfig { autoreset: Autoreset::Disabled, on_fault: OnFault::Truncate, ..VecConfig::new(2) };
    let mut cpu = make_vec("hover", EnvConfig::default(), config).unwrap();
    let mut gpu = gpu(&device, config);
    let (mut on_cpu, mut on_gpu) = (VecBuffers::new(&*cpu), VecBuffers::new(&gpu));
    cpu.reset(Some(1), &mut on_cpu.observations).unwrap();
    gpu.reset(Some(1), &mut on_gpu.observations).unwrap();
    let mut waited = 0;
    for step in 0..30 {
        // the first drone falls
        let actions = [-1.0, -1.0, -1.0, -1.0, 0.1, 0.1, 0.1, 0.1];
        cpu.step(&actions, on_cpu.step()).unwrap();
        gpu.step(&actions, on_gpu.step()).unwrap();
        assert_eq!((&on_cpu.terminated, &on_cpu.truncated), (&on_gpu.terminated, &on_gpu.truncated), "step {step}");
        let texts = |faults: &[(usize, EnvError)]| -> Vec<(usize, String)> {
            faults.iter().map(|(index, error)| (*index, error.to_string())).collect()
        };
        assert_eq!(texts(cpu.faults()), texts(gpu.faults()), "step {step}");
        waited += gpu.faults().len();
    }
    assert!(waited > 5 && !on_gpu.terminated[1], "{waited}");
    let height = on_gpu.observations[2];
    gpu.reset_where(&[true, false], None, &mut on_gpu.observations).unwrap();
    assert!((on_gpu.observations[2] - 0.1).abs() < 1e-6 && height < 0.1);
}

/// The caller passes another buffer with other contents each time.
#[test]
fn a_batch_that_keeps_observations_writes_every_row() {
    let Some(device) = device("a_batch_that_keeps_observations_writes_every_row") else { return };
    for autoreset in [Autoreset::Disabled, Autoreset::NextStep] {
        let on_fault = OnFault::Truncate;
        let config = VecConfig { autoreset, on_fault, keep_observations: true, ..VecConfig::new(3) };
        let mut cpu = make_vec("hover", EnvConfig::default(), config).unwrap();
        let mut gpu = gpu(&device, config);
        let (mut on_cpu, mut on_gpu) = (VecBuffers::new(&*cpu), VecBuffers::new(&gpu));
        let compare = |on_cpu: &mut VecBuffers, on_gpu: &mut VecBuffers, context: &str| {
            for (a, b) in on_cpu.observations.iter().zip(&on_gpu.observations) {
                assert!((a - b).abs() < 2e-3, "{context}: {:?} {:?}", on_cpu.observations, on_gpu.observations);
            }
            on_cpu.observations.fill(f32::NAN);
            on_gpu.observations.fill(f32::NAN);
        };
        // the last environment has no episode yet
        cpu.reset_where(&[true, true, false], Some(1), &mut on_cpu.observations).unwrap();
        gpu.reset_where(&[true, true, false], Some(1), &mut on_gpu.observations).unwrap();
        compare(&mut on_cpu, &mut on_gpu, "reset");
        for step in 0..14 {
            // the first drone falls
            let actions = [-1.0, -1.0, -1.0, -1.0, 0.1, 0.1, 0.1, 0.1, 0.0, 0.0, 0.0, 0.0];
            cpu.step(&actions, on_cpu.step()).unwrap();
            gpu.step(&actions, on_gpu.step()).unwrap();
            // the contact slows the drone on the CPU alone
            if on_cpu.terminated[0] {
                break;
            }
            compare(&mut on_cpu, &mut on_gpu, &format!("{autoreset:?}, step {step}"));
        }
        let last = on_gpu.observations[..12].to_vec();
        if autoreset == Autoreset::Disabled {
            on_gpu.observations.fill(f32::NAN);
            gpu.step(&[0.0; 12], on_gpu.step()).unwrap();
            assert_eq!(on_gpu.observations[..12], last);
        }
        on_gpu.observations.fill(f32::NAN);
        gpu.reset_where(&[false, true, false], None, &mut on_gpu.observations).unwrap();
        assert!(on_gpu.observations.iter().all(|number| number.is_finite()));
        assert_eq!(on_gpu.observations[24..], [0.0; 12]);
    }
}
