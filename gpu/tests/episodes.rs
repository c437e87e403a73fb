//! Episodes on the GPU: resets, ends, random starts, faults and errors.
#![cfg(feature = "wgpu")]

mod support;

use aviary::action::ActionType;
use aviary::env::{EndReason, EnvConfig, EnvError, Randomization};
use aviary::physics::wind::{WindConfig, WindModel};
use aviary::vector::{Autoreset, OnFault, VecBuffers, VecConfig, VecEnv, make_vec};
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
    // true where the floor has changed the velocity on the CPU in the step that ended the episode on the GPU
    let mut slowed = vec![false; COUNT];
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
            if ends[0].is_none() && ends[1].is_some_and(|(end, _)| end == step) {
                let [a, b] = [&on_cpu, &on_gpu].map(|buffers| &buffers.observations[12 * environment..][..12]);
                slowed[environment] = (6..9).any(|axis| (a[axis] - b[axis]).abs() > 1e-3);
            }
        }
    }
    let both: Vec<(End, End, bool)> =
        ends.iter().zip(&slowed).filter_map(|([cpu, gpu], &slowed)| Some(((*cpu)?, (*gpu)?, slowed))).collect();
    assert!(both.len() > 9 * COUNT / 10, "{} episodes ended", both.len());
    let reasons = [EndReason::FloorContact, EndReason::Tilt, EndReason::OutOfBounds];
    for reason in &reasons[..2] {
        let count = both.iter().filter(|((_, end), ..)| *end == Some(*reason)).count();
        assert!(count > COUNT / 20, "{count} ends by {reason}");
    }
    // MuJoCo reports the contacts of the last stage of RK4 alone, and misses one that has ended before
    let missed =
        |(cpu, gpu): &(End, End), slowed: bool| gpu.1 == Some(EndReason::FloorContact) && cpu.0 > gpu.0 && slowed;
    let equal = both.iter().filter(|(cpu, gpu, slowed)| cpu == gpu || missed(&(*cpu, *gpu), *slowed)).count();
    let reported = both.iter().filter(|(cpu, gpu, _)| cpu == gpu).count();
    assert!(reported as f64 >= 0.98 * both.len() as f64, "{reported} of {} ends", both.len());
    assert!(equal as f64 >= 0.999 * both.len() as f64, "{equal} of {} ends", both.len());
    let apart = |(cpu, gpu, slowed): &(End, End, bool)| !missed(&(*cpu, *gpu), *slowed) && (cpu.0 - gpu.0).abs() > 1;
    assert!(!both.iter().any(apart), "ends more than one control step apart");
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
    assert_eq!(env.episode_summary(1).unwrap().end, Some(EndReason::Fault));
    env.step(&actions, buffers.step()).unwrap();
    assert_eq!((buffers.truncated[1], buffers.observations[14]), (false, 0.1));
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
    let wind = error(hover().wind(WindConfig::new(WindModel::Gust)), VecConfig::new(1));
    assert_eq!(wind, "wind is set, expected none on the GPU");
    let randomized = error(hover().randomization(Randomization::default()), VecConfig::new(1));
    assert_eq!(randomized, "randomization is set, expected none on the GPU");
    let action = error(hover().action_type(ActionType::Ctbr), VecConfig::new(1));
    assert_eq!(action, "action_type is ctbr, expected rpm or one_d_rpm on the GPU");
    let task = GpuAviary::make("race", hover(), VecConfig::new(1), &device, Precision::Single).unwrap_err().to_string();
    assert_eq!(task, "task is race, expected hover or stabilize on the GPU");
    let low = error(hover().initial_positions([[0.0, 0.0, 0.02]]), VecConfig::new(1));
    assert!(low.contains("initial_positions") && low.contains("more than 0.01 m"), "{low}");
    let unknown = GpuDevice::open(Some("no such device")).map(|_| ()).unwrap_err().to_string();
    assert!(unknown.contains("does not exist") && unknown.contains(&adapters()[0].name), "{unknown}");
}
