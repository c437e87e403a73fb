//! Flights on the device against the same equations on the host, with equal random numbers.

use aviary::action::ActionType;
use aviary::control::ControllerKind;
use aviary::env::{EnvConfig, Randomization, SensorRanges};
use aviary::physics::Effects;
use aviary::physics::wind::{DrydenFilter, WindConfig, WindModel};
use aviary::vector::{VecBuffers, VecConfig};

use super::*;
use crate::environment::{Memory, Outcome, control_step, reset};

/// Number of environments.
const COUNT: usize = 6;

/// Environments on the host.
struct Host {
    memories: Vec<Memory<f64>>,
    observations: Vec<Vec<f64>>,
}

impl Host {
    fn new(env: &GpuAviary, seed: u64) -> Self {
        let plan = &env.batch.plan;
        let blank = Memory::filled(plan, 0.0, 0);
        let blank = Memory { seed: [seed as u32, (seed >> 32) as u32], ..blank };
        let (memories, observations) = (0..COUNT as u32).map(|i| reset(plan, &env.nominal[0], &blank, i, 0)).unzip();
        Self { memories, observations }
    }

    fn step(&mut self, env: &GpuAviary, actions: &[f64]) -> Vec<(f64, u32)> {
        let (plan, size) = (&env.batch.plan, env.batch.plan.action_size());
        let mut results = Vec::new();
        for (index, memory) in self.memories.iter_mut().enumerate() {
            let action = &actions[index * size..][..size];
            let action = [0, 1, 2, 3].map(|motor| action[motor % size]);
            let Outcome { memory: next, observation, reward, end, .. } =
                control_step(plan, &env.nominal[0], memory, index as u32, 0, action);
            (*memory, self.observations[index]) = (next, observation);
            results.push((reward, end));
        }
        results
    }
}

/// Returns a number in [−1, 1] of two integers.
fn noise(a: u64, b: u64) -> f64 {
    let mut z = (a << 32 ^ b).wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 52) as f64 - 1.0
}

/// Environments with random numbers: tasks, action types and conditions.
fn cases() -> Vec<(&'static str, &'static str, EnvConfig)> {
    let options = || EnvConfig::default().episode_seconds(1.0);
    let all = Effects { downwash: false, ..Effects::ALL };
    let wind = |model, filter| WindConfig { filter, ..WindConfig::new(model) };
    let second = DrydenFilter::MilF8785c;
    let first = DrydenFilter::FirstOrder;
    let gyro = SensorRanges { gyro_bias: Some(0.1), latency: [0.03, 0.05], ..SensorRanges::default() };
    let sensors = Randomization { sensors: Some(gyro), ..Randomization::NONE };
    let randomization = Randomization::default;
    vec![
        ("plain", "hover", options()),
        ("random start", "stabilize", options()),
        ("random circle", "track", options()),
        ("random velocity", "velocity", options()),
        ("turbulence", "hover", options().wind(wind(WindModel::Dryden, first))),
        ("second-order turbulence", "velocity", options().wind(wind(WindModel::Dryden, second)).effects(all)),
        ("gusts", "hover", options().wind(WindConfig { gust_rate: 5.0, ..wind(WindModel::Gust, first) })),
        ("combined wind", "track", options().wind(wind(WindModel::Combined, second))),
        ("late noisy sensors", "race", options().randomization(sensors)),
        ("hover, randomized", "hover", options().randomization(randomization()).effects(all)),
        ("track, randomized", "track", options().randomization(randomization())),
        ("velocity, randomized", "velocity", options().randomization(randomization()).effects(all)),
        ("fly_through, randomized", "fly_through", options().randomization(randomization())),
        (
            "loops, randomized",
            "race",
            options().randomization(randomization()).action_type(ActionType::Vel).controller(ControllerKind::Dsl),
        ),
    ]
}

#[test]
fn the_device_computes_what_the_host_computes() {
    let Some(device) = crate::device::for_tests() else { return };
    if !device.adapter().double {
        return;
    }
    for (name, task, options) in cases() {
        for autoreset in [Autoreset::NextStep, Autoreset::SameStep] {
            let config = VecConfig { autoreset, ..VecConfig::new(COUNT) };
            let mut env = GpuAviary::make(task, options.clone(), config, &device, Precision::Double).unwrap();
            let mut buffers = VecBuffers::new(&env);
            env.reset(Some(7), &mut buffers.observations).unwrap();
            let mut host = Host::new(&env, 7);
            let (mut ends, mut on_floor) = (0, [env.batch.plan.floor; COUNT]);
            for step in 0..120 {
                let actions: Vec<f64> = (0..env.action_size() * COUNT)
                    .map(|entry| 0.02 + 0.05 * noise(entry as u64, step) + 0.1 * noise(entry as u64, 1 << 40))
                    .collect();
                let expected = host.step(&env, &actions);
                env.step_f64(&actions, buffers.step()).unwrap();
                for (index, (reward, end)) in expected.iter().enumerate() {
                    let flags = [buffers.terminated[index], buffers.truncated[index]];
                    let ended = [end::TERMINATED, end::TRUNCATED].map(|bit| end & bit != 0);
                    assert_eq!(flags, ended, "{name}, {autoreset:?}: step {step}, environment {index}");
                    ends += usize::from(*end != 0);
                    let got = f64::from(buffers.rewards[index]);
                    assert!((got - reward).abs() < 1e-5 * (1.0 + reward.abs()), "{name}: {got}, expected {reward}");
                }
                let size = env.batch.plan.observation_size();
                let rows = buffers.observations.chunks_exact(size).zip(&host.observations);
                for (row, expected) in rows {
                    for (entry, (got, expected)) in row.iter().zip(expected).enumerate() {
                        let apart = (f64::from(*got) - expected).abs();
                        assert!(apart < 1e-5 * (1.0 + expected.abs()), "{name}: entry {entry} of step {step}: {apart}");
                    }
                }
                let numbers = env.batch.download_numbers().unwrap();
                for (index, memory) in host.memories.iter().enumerate() {
                    on_floor[index] = memory.airborne < 0.5 || memory.steps > 0 && on_floor[index];
                    for (row, number) in memory.numbers().into_iter().enumerate() {
                        let got = numbers[row * COUNT + index];
                        let apart = (got - number).abs() / (1.0 + number.abs());
                        // impacts on the floor amplify rounding
                        let limit = if on_floor[index] { 1e-3 } else { 1e-9 };
                        assert!(apart < limit, "{name}, {autoreset:?}: step {step}, row {row}: {got}, {number}");
                    }
                }
            }
            assert!(ends > 0 || task == "race", "{name}: no episode has ended");
        }
    }
}
