//! Training on the GPU: reproducibility, checkpoints, progress, and errors.
#![cfg(all(feature = "wgpu", feature = "learn"))]

mod support;

use std::io::Write as _;
use std::time::Instant;

use aviary::env::{BodyRanges, Randomization};
use aviary::physics::Physics;
use aviary::policy::Activation;
use aviary_gpu::{GpuDevice, GpuError, GpuPpo};
use learn::{Learner as _, Running, Stop, TrainConfig, TrainDevice, TrainError, Trainer, TrainingStart};
use support::device;

/// Returns the configuration of a short run.
fn small(task: &str) -> TrainConfig {
    let mut config = TrainConfig::of_task(task).unwrap();
    (config.seed, config.device) = (7, TrainDevice::Gpu);
    config.steps = 5 * 64 * 16;
    (config.ppo.environments, config.ppo.horizon, config.ppo.minibatch) = (64, 16, 300);
    config.ppo.hidden = vec![16, 16];
    (config.evaluate_every, config.episodes, config.checkpoint_every) = (3, 3, 2);
    config.episode_seconds = Some(1.0);
    config
}

fn trainer(config: &TrainConfig, device: &GpuDevice) -> Trainer {
    let learner = GpuPpo::new(config, device).unwrap();
    Trainer::with_learner(config.clone(), "a test", Box::new(learner)).unwrap()
}

fn finish(mut trainer: Trainer) -> Trainer {
    while trainer.stop().is_none() {
        trainer.advance().unwrap();
    }
    trainer
}

fn bytes(trainer: &Trainer) -> Vec<u8> {
    trainer.policy().unwrap().to_bytes().unwrap()
}

#[test]
fn equal_seeds_give_equal_policies() {
    let Some(device) = device("equal_seeds_give_equal_policies") else { return };
    for (task, activation) in [("hover", Activation::Relu), ("stabilize", Activation::Softsign)] {
        let mut config = small(task);
        config.ppo.activation = activation;
        let first = finish(trainer(&config, &device));
        let second = finish(trainer(&config, &device));
        assert_eq!((bytes(&first), first.curve()), (bytes(&second), second.curve()));
        assert_eq!(first.steps(), 5 * 64 * 16);
        assert_eq!(first.policy().unwrap().info().task, task);
        config.seed = 8;
        assert_ne!(bytes(&first), bytes(&finish(trainer(&config, &device))));
    }
}

#[test]
fn a_resumed_run_is_bit_identical_to_an_uninterrupted_one() {
    let Some(device) = device("a_resumed_run_is_bit_identical_to_an_uninterrupted_one") else { return };
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("checkpoint.safetensors");
    let config = small("hover");
    let mut whole = trainer(&config, &device);
    for _ in 0..2 {
        whole.advance().unwrap();
    }
    assert!(whole.is_checkpoint());
    std::fs::write(&path, whole.checkpoint().unwrap()).unwrap();
    let whole = finish(whole);
    let make = |config: &TrainConfig| -> Result<Box<dyn learn::Learner>, TrainError> {
        assert_eq!(config.device, TrainDevice::Gpu);
        Ok(Box::new(GpuPpo::new(config, &device).unwrap()))
    };
    let resumed = finish(Trainer::resume_with(&path, make).unwrap());
    assert_eq!((bytes(&whole), whole.curve()), (bytes(&resumed), resumed.curve()));
    assert_eq!(whole.checkpoint().unwrap(), resumed.checkpoint().unwrap());
    // the learner of the CPU does not continue it
    let error = Trainer::resume(&path).unwrap_err().to_string();
    assert_eq!(error, "device is gpu, expected cpu, or a learner of another device");
}

#[test]
fn training_improves_the_reward() {
    let Some(device) = device("training_improves_the_reward") else { return };
    let mut config = TrainConfig::of_task("hover").unwrap();
    config.device = TrainDevice::Gpu;
    (config.ppo.environments, config.ppo.minibatch) = (512, 1024);
    (config.evaluate_every, config.steps, config.episodes) = (1000, 25 * 512 * 32, 4);
    let trainer = finish(trainer(&config, &device));
    let rewards: Vec<f64> = trainer.curve().iter().map(|point| point.report.mean_reward).collect();
    let mean = |rewards: &[f64]| rewards.iter().sum::<f64>() / rewards.len() as f64;
    let [before, after] = [mean(&rewards[..3]), mean(&rewards[22..])];
    assert!(after > 0.5 * before, "mean reward {before} before, {after} after");
    for point in trainer.curve() {
        let report = &point.report;
        let numbers = [report.approx_kl, report.loss, report.action_std, report.explained_variance, point.rate];
        assert!(numbers.iter().all(|x| x.is_finite()), "{report:?}");
        assert!((0.0..0.5).contains(&report.approx_kl) && (0.0..=1.0).contains(&report.clip_fraction), "{report:?}");
    }
    let last = trainer.curve().last().unwrap();
    assert!(last.report.explained_variance > 0.2, "{:?}", last.report);
    let clock = trainer.clock();
    assert!(!clock.simulation.is_zero() && !clock.gradient.is_zero() && clock.total > clock.simulation);
}

/// Trains Hover until every episode of five evaluations succeeds, and flies 300 other episodes in MuJoCo.
///
/// `cargo test --release -p aviary-gpu --features vulkan,learn --test learn -- --ignored --nocapture`
#[test]
#[ignore = "takes minutes on a software device"]
fn hover_is_learned_and_flies_in_mujoco() {
    let Some(device) = device("hover_is_learned_and_flies_in_mujoco") else { return };
    let mut config = TrainConfig::of_task("hover").unwrap();
    (config.device, config.until_success, config.seed) = (TrainDevice::Gpu, true, 1);
    let began = Instant::now();
    let mut trainer = trainer(&config, &device);
    while trainer.stop().is_none() {
        if let Some(score) = trainer.advance().unwrap().score {
            let (steps, seconds) = (trainer.steps(), began.elapsed().as_secs_f64());
            let report = &trainer.curve().last().unwrap().report;
            let _ = writeln!(std::io::stderr(), "{steps} steps, {seconds:.1} s, {score:?}, {report:?}");
        }
    }
    let seconds = began.elapsed().as_secs_f64();
    let episodes = trainer.fly(5000, 300).unwrap();
    let successes = episodes.iter().filter(|episode| episode.success).count();
    let _ = writeln!(
        std::io::stderr(),
        "{}: {} steps in {seconds:.1} s, {:?}; {successes} of 300 episodes succeed in MuJoCo",
        device.adapter(),
        trainer.steps(),
        trainer.clock(),
    );
    assert_eq!(trainer.stop(), Some(Stop::Success));
    assert_eq!(successes, 300);
}

#[test]
fn options_that_the_kernels_do_not_have_are_errors_of_one_line() {
    let Some(device) = device("options_that_the_kernels_do_not_have_are_errors_of_one_line") else { return };
    let error = |config: &TrainConfig| {
        let error = GpuPpo::new(config, &device).map(|_| ()).unwrap_err();
        assert!(!error.to_string().contains('\n'));
        error
    };
    let config = TrainConfig { per_drone: true, ..small("hover") };
    assert_eq!(error(&config).to_string(), "per_drone is true, expected false on the GPU");
    let mut config = small("hover");
    config.ppo.recurrent = 32;
    assert_eq!(error(&config).to_string(), "recurrent is 32, expected 0 on the GPU");
    let mut config = small("hover");
    config.conditions.randomization = Some(Randomization { airframe: Some(Default::default()), ..Randomization::NONE });
    let expected = "randomization.airframe is set, expected no randomized airframes on the GPU";
    assert_eq!(error(&config).to_string(), expected);
    let config = TrainConfig { physics: Physics::Dyn, ..small("hover") };
    assert_eq!(error(&config).to_string(), "engine is explicit, expected mujoco or hybrid on the GPU");
    let mut config = small("hover");
    (config.ppo.environments, config.ppo.horizon) = (1 << 20, 64);
    config.ppo.hidden = vec![256; 7];
    config.ppo.minibatch = 1 << 24;
    let many = error(&config);
    assert!(matches!(many, GpuError::TooLarge { option: "environments × horizon", got: 0x400_0000, .. }), "{many}");
    let config = TrainConfig { device: TrainDevice::Cpu, ..small("hover") };
    assert_eq!(error(&config).to_string(), "device is cpu, expected gpu on the GPU");
    let mut config = small("hover");
    config.ppo.horizon = 0;
    assert_eq!(error(&config).to_string(), "horizon is 0, expected a positive number that fits in memory");
}

/// A start that overlaps another drone, or is too close to the floor, would need a second sample.
#[test]
fn starts_that_need_a_second_sample_are_errors() {
    let Some(device) = device("starts_that_need_a_second_sample_are_errors") else { return };
    let error = |config: &TrainConfig| GpuPpo::new(config, &device).map(|_| ()).unwrap_err().to_string();
    let expected = "expected drones whose random starts cannot meet on the GPU";
    // the recipe itself has such starts
    let formation = error(&small("formation"));
    assert!(formation.starts_with("initial_positions is 0.") && formation.ends_with(expected), "{formation}");
    let mut config = TrainConfig { per_drone: false, ..small("multi_hover") };
    config.conditions.randomization = None;
    config.training_starts = vec![TrainingStart { position: 0.1, ..TrainingStart::default() }];
    GpuPpo::new(&config, &device).unwrap();
    config.training_starts.push(TrainingStart { position: 0.9, ..TrainingStart::default() });
    let far = error(&config);
    assert!(far.starts_with("initial_positions is 0.") && far.ends_with(expected), "{far}");
    let mut config = small("stabilize");
    config.training_starts = vec![TrainingStart { offset: [0.0, 0.0, -5.0], ..TrainingStart::default() }];
    let low = error(&config);
    assert!(low.starts_with("initial_positions is ") && low.contains("above the floor"), "{low}");
}

/// The weights of both statistics come from the other run, whatever its number of samples.
#[test]
fn a_run_that_starts_from_another_one_keeps_its_scales() {
    let Some(device) = device("a_run_that_starts_from_another_one_keeps_its_scales") else { return };
    let config = small("hover");
    let mut learner = GpuPpo::new(&config, &device).unwrap();
    assert!(!learner.has_scales());
    let mut state = learner.state().unwrap();
    // fewer samples than half a rollout of 1024; those of the rewards outweigh it
    state.observations = Running::of(100.0, vec![0.5; 12], &[4.0; 12]);
    state.rewards = Running::of(1e9, vec![-3.0], &[9.0]);
    learner.restore(state).unwrap();
    assert!(learner.has_scales());
    let state = learner.state().unwrap();
    assert_eq!((state.observations.count(), state.rewards.count()), (100.0, 1e9));
    assert_eq!((state.observations.means(), state.observations.variances()), (&[0.5; 12][..], vec![4.0; 12]));
    learner.restart(1).unwrap();
    learner.iterate(2).unwrap();
    let state = learner.state().unwrap();
    assert_eq!((state.observations.count(), state.rewards.count()), (1124.0, 1e9 + 1024.0));
    // x has the mean 0 in this rollout
    let x = state.observations.means()[0];
    assert!(x > 0.0 && x < 0.1, "{x}");
    let (mean, variance) = (state.rewards.means()[0], state.rewards.variances()[0]);
    assert!((mean + 3.0).abs() < 1e-3 && (variance - 9.0).abs() < 1e-3, "{mean} {variance}");
}

#[test]
fn tasks_with_several_drones_and_courses_with_other_rewards_train() {
    let Some(device) = device("tasks_with_several_drones_and_courses_with_other_rewards_train") else { return };
    for task in ["formation", "race"] {
        let mut config = small(task);
        config.conditions.randomization =
            Some(Randomization { initial: None, body: Some(BodyRanges::default()), ..Randomization::NONE });
        let learner = GpuPpo::new(&config, &device).unwrap();
        let env = config.environment().unwrap();
        let sizes = (env.observation_space().vector.size(), env.action_space().size());
        assert_eq!((learner.shape().observation(), learner.shape().action()), sizes, "{task}");
        config.steps = 1;
        let mut trainer = Trainer::with_learner(config, "a test", Box::new(learner)).unwrap();
        let report = trainer.advance().unwrap().report.clone();
        assert!(report.loss.is_finite() && report.approx_kl > 0.0 && report.action_std > 0.0, "{task}: {report:?}");
    }
}
