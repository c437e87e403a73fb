//! Steps with tensors of burn.
#![cfg(feature = "burn")]

mod support;

use aviary::action::ActionType;
use aviary::env::EnvConfig;
use aviary::vector::{Autoreset, VecBuffers, VecConfig, VecEnv};
use aviary_gpu::{GpuAviary, GpuDevice, Precision};
use burn_tensor::{Tensor, TensorData};
use support::{Noise, device};

fn make(task: &str, device: &GpuDevice, autoreset: Autoreset, precision: Precision) -> GpuAviary {
    let config = VecConfig { autoreset, ..VecConfig::new(7) };
    GpuAviary::make(task, EnvConfig::default().episode_seconds(0.5), config, device, precision).unwrap()
}

fn numbers<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    tensor.into_data().try_to_vec::<f32>().unwrap()
}

/// Episodes end by time and by crashes, and start again.
#[test]
fn steps_with_tensors_equal_steps_with_host_buffers() {
    let Some(device) = device("steps_with_tensors_equal_steps_with_host_buffers") else { return };
    for (task, autoreset, precision) in [
        ("hover", Autoreset::SameStep, Precision::Single),
        ("hover", Autoreset::NextStep, Precision::Single),
        ("multi_hover", Autoreset::SameStep, Precision::Single),
        ("stabilize", Autoreset::SameStep, Precision::Double),
    ] {
        if precision == Precision::Double && !device.adapter().double {
            continue;
        }
        let [mut host, mut other] = [0, 1].map(|_| make(task, &device, autoreset, precision));
        let mut buffers = VecBuffers::new(&host);
        host.reset(Some(3), &mut buffers.observations).unwrap();
        assert_eq!(numbers(other.reset_on_device(Some(3))), buffers.observations);
        let (mut noise, mut ends, mut first) = (Noise(1), 0, None);
        let length = 7 * host.action_size();
        for step in 0..60 {
            let actions: Vec<f32> = (0..length).map(|_| 0.4 * noise.next() as f32).collect();
            host.step(&actions, buffers.step()).unwrap();
            let data = TensorData::new(actions, [7, host.action_size()]);
            let result = other.step_on_device(Tensor::from_data(data, &other.burn_device())).unwrap();
            assert_eq!(numbers(result.observations.clone()), buffers.observations, "{task}, step {step}");
            assert_eq!(numbers(result.rewards.clone()), buffers.rewards, "{task}, step {step}");
            let [terminated, truncated] = [result.terminated(), result.truncated()]
                .map(|tensor| tensor.into_data().iter::<bool>().collect::<Vec<_>>());
            assert_eq!((&terminated, &truncated), (&buffers.terminated, &buffers.truncated), "{task}, step {step}");
            let success: Vec<bool> = result.success().into_data().iter::<bool>().collect();
            for environment in 0..7 {
                if !(terminated[environment] || truncated[environment]) {
                    continue;
                }
                ends += 1;
                assert_eq!(success[environment], host.episode_summary(environment).unwrap().success);
                if let Some(last) = &result.last_observations {
                    let row = environment * host.observation_size()..(environment + 1) * host.observation_size();
                    assert_eq!(numbers(last.clone())[row.clone()], host.final_observations()[row]);
                }
            }
            assert_eq!(result.last_observations.is_some(), autoreset == Autoreset::SameStep);
            // with the speeds of the motors, for which the host needs the actions
            if step < 3 {
                assert_eq!(host.kinematic(4, 0), other.kinematic(4, 0), "{task}, step {step}");
            }
            first.get_or_insert((result, buffers.clone()));
        }
        assert!(ends >= 7, "{task}: {ends} ends");
        // the tensors of an earlier step have kept their values
        let (result, then) = first.unwrap();
        assert_eq!(numbers(result.observations), then.observations);
        assert_eq!(numbers(result.rewards), then.rewards);
        // and the host goes on where the device is
        let mut after = VecBuffers::new(&other);
        for _ in 0..30 {
            host.step(&vec![0.1; length], buffers.step()).unwrap();
            other.step(&vec![0.1; length], after.step()).unwrap();
            assert_eq!(after.observations, buffers.observations);
            let reasons = |env: &GpuAviary| {
                (0..7).map(|index| env.episode_summary(index).map(|summary| (summary.end, summary.steps))).collect()
            };
            let both: [Vec<_>; 2] = [reasons(&host), reasons(&other)];
            assert_eq!(both[0], both[1]);
        }
        assert_eq!(host.states().unwrap(), other.states().unwrap());
        assert_eq!(host.engine_substeps(), other.engine_substeps());
    }
}

/// Nothing but the last height comes to the host.
#[test]
fn a_controller_of_tensors_hovers() {
    let Some(device) = device("a_controller_of_tensors_hovers") else { return };
    const COUNT: usize = 64;
    let options = EnvConfig::default().action_type(ActionType::OneDRpm);
    let mut env = GpuAviary::make("hover", options, VecConfig::new(COUNT), &device, Precision::Single).unwrap();
    let mut seen = env.reset_on_device(None);
    for _ in 0..200 {
        let (height, climb) = (seen.clone().slice([0..COUNT, 2..3]), seen.slice([0..COUNT, 8..9]));
        let action = (height - 1.0).mul_scalar(-0.2) - climb.mul_scalar(0.2);
        seen = env.step_on_device(action.clamp(-1.0, 1.0)).unwrap().observations;
    }
    let heights = numbers(seen.slice([0..COUNT, 2..3]));
    assert!(heights.iter().all(|height| (height - 1.0).abs() < 0.05), "{heights:?}");
}

#[test]
fn errors_are_one_line() {
    let Some(device) = device("errors_are_one_line") else { return };
    let mut env = make("hover", &device, Autoreset::SameStep, Precision::Single);
    let zeros = |env: &GpuAviary, shape: [usize; 2]| Tensor::<2>::zeros(shape, &env.burn_device());
    let error = |env: &mut GpuAviary, shape| {
        let actions = zeros(env, shape);
        env.step_on_device(actions).map(|_| ()).unwrap_err().to_string()
    };
    let first = "environment 0: step was called on a new environment, expected a call of reset first";
    assert_eq!(error(&mut env, [7, 4]), first);
    env.reset_on_device(None);
    assert_eq!(error(&mut env, [4, 7]), "actions is [4, 7], expected a tensor of the shape [7, 4]");
    assert_eq!(error(&mut env, [7, 3]), "actions is [7, 3], expected a tensor of the shape [7, 4]");
    let mut env = make("hover", &device, Autoreset::Disabled, Precision::Single);
    env.reset_on_device(None);
    assert_eq!(error(&mut env, [7, 4]), "autoreset is disabled, expected next_step or same_step");
}

/// An action that is not finite ends the episode of its environment alone.
#[test]
fn a_fault_is_a_truncation() {
    let Some(device) = device("a_fault_is_a_truncation") else { return };
    let mut env = make("hover", &device, Autoreset::SameStep, Precision::Single);
    env.reset_on_device(None);
    let mut actions = vec![0.0_f32; 28];
    actions[9] = f32::NAN;
    let data = TensorData::new(actions, [7, 4]);
    let result = env.step_on_device(Tensor::from_data(data, &env.burn_device())).unwrap();
    let truncated: Vec<bool> = result.truncated().into_data().iter::<bool>().collect();
    assert_eq!(truncated, [false, false, true, false, false, false, false]);
    assert!(numbers(result.observations).iter().all(|number| number.is_finite()));
}
