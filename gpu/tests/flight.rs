//! Flights on the GPU against those of the CPU's flight kernel.
#![cfg(feature = "wgpu")]

mod support;

use aviary::action::ActionType;
use aviary::drone::DroneModel;
use aviary::env::EnvConfig;
use aviary::physics::Effects;
use aviary::physics::actuators::ActuatorParams;
use aviary::vector::{VecBuffers, VecConfig, VecEnv, make_vec};
use aviary::world::{Forcing, Medium};
use aviary_gpu::{GpuAviary, GpuDevice, Precision};
use support::{Noise, attitude_law, device};

/// Number of environments of a comparison.
const COUNT: usize = 24;

/// Height of the flights above the floor, m.
const HEIGHT: f64 = 1.5;

/// Creates options of Hover with a start in the middle of its height range.
fn free_flight() -> EnvConfig {
    EnvConfig::default().initial_positions([[0.0, 0.0, HEIGHT]])
}

/// Commands of a manoeuvre: roll, pitch (rad) and yaw rate (rad/s), which change every half second.
fn manoeuvres(count: usize, noise: &mut Noise) -> Vec<[f32; 3]> {
    (0..count).map(|_| [0.3 * noise.next() as f32, 0.3 * noise.next() as f32, 2.0 * noise.next() as f32]).collect()
}

/// Flies the same actions on CPU and GPU for ten seconds. Returns the largest distance between both, m.
fn distance(device: &GpuDevice, builder: EnvConfig, precision: Precision) -> f64 {
    let config = VecConfig::new(COUNT);
    let mut cpu = make_vec("hover", builder.clone(), config).unwrap();
    let mut gpu = GpuAviary::make("hover", builder, config, device, precision).unwrap();
    let (mut on_cpu, mut on_gpu) = (VecBuffers::new(&*cpu), VecBuffers::new(&gpu));
    cpu.reset(Some(1), &mut on_cpu.observations).unwrap();
    gpu.reset(Some(1), &mut on_gpu.observations).unwrap();
    let (size, mut noise, mut commands) = (gpu.action_size(), Noise(1), Vec::new());
    let mut largest: f64 = 0.0;
    for step in 0..gpu.episode_steps() - 1 {
        if step % 24 == 0 {
            commands = manoeuvres(COUNT, &mut noise);
        }
        let rows = on_cpu.observations.chunks_exact(12).zip(&commands);
        let actions: Vec<f32> = rows
            .flat_map(|(row, &[roll, pitch, yaw])| {
                // the velocity in the heading frame
                let (sin, cos) = row[5].sin_cos();
                let (x, y) = (cos * row[6] + sin * row[7], cos * row[7] - sin * row[6]);
                attitude_law(row, HEIGHT as f32, roll + 0.1 * y, pitch - 0.1 * x, yaw)[..size].to_vec()
            })
            .collect();
        cpu.step(&actions, on_cpu.step()).unwrap();
        gpu.step(&actions, on_gpu.step()).unwrap();
        assert!(!on_gpu.terminated.contains(&true) && !on_gpu.truncated.contains(&true), "step {step}");
        if step % 16 == 0 || step + 2 == gpu.episode_steps() {
            for (environment, state) in gpu.states().unwrap().into_iter().enumerate() {
                let numbers = cpu.kinematic(environment, 0).unwrap();
                let apart = [0, 1, 2].map(|axis| state.position[axis] - numbers[axis]);
                largest = largest.max(apart.iter().map(|x| x * x).sum::<f64>().sqrt());
            }
        }
    }
    largest
}

/// Effects and airframes of the comparison.
fn variants() -> Vec<(&'static str, EnvConfig)> {
    let lag =
        ActuatorParams { lag: 0.05, gains: [1.0, 0.98, 1.01, 0.99], saturation: 0.9, ..ActuatorParams::default() };
    let medium = Medium { density: 1.225, viscosity: 1.8e-5 };
    vec![
        ("plain", free_flight()),
        ("drag and ground effect", free_flight().effects(Effects { downwash: false, ..Effects::ALL })),
        ("motors", free_flight().actuators(lag)),
        ("body-fixed forcing", free_flight().forcing(Forcing::BodyFixed)),
        ("medium", free_flight().medium(medium)),
        ("plus frame", free_flight().drone(DroneModel::Cf2p)),
        ("one motor speed", free_flight().action_type(ActionType::OneDRpm)),
    ]
}

#[test]
fn double_precision_agrees_with_the_cpu() {
    let Some(device) = device("double_precision_agrees_with_the_cpu") else { return };
    if !device.adapter().double {
        return;
    }
    for (name, builder) in variants() {
        let apart = distance(&device, builder, Precision::Double);
        assert!(apart < 1e-12, "{name}: {apart:e} m");
    }
}

#[test]
fn single_precision_stays_close_to_the_cpu_under_the_same_actions() {
    let Some(device) = device("single_precision_stays_close_to_the_cpu_under_the_same_actions") else { return };
    for (name, builder) in variants() {
        // open loop: nothing corrects the rounding
        let apart = distance(&device, builder, Precision::Single);
        assert!(apart < 5e-3, "{name}: {apart:e} m");
    }
}

#[test]
fn single_precision_agrees_with_the_cpu_in_a_closed_loop() {
    let Some(device) = device("single_precision_agrees_with_the_cpu_in_a_closed_loop") else { return };
    let builder = EnvConfig::default().effects(Effects { downwash: false, ..Effects::ALL });
    let config = VecConfig::new(COUNT);
    let mut cpu = make_vec("hover", builder.clone(), config).unwrap();
    let mut gpu = GpuAviary::make("hover", builder, config, &device, Precision::Single).unwrap();
    let mut batches: [(&mut dyn VecEnv, VecBuffers); 2] = {
        let buffers = [VecBuffers::new(&*cpu), VecBuffers::new(&gpu)];
        let [a, b] = buffers;
        [(&mut *cpu, a), (&mut gpu, b)]
    };
    for (env, buffers) in &mut batches {
        env.reset(Some(1), &mut buffers.observations).unwrap();
    }
    let mut largest: f32 = 0.0;
    for step in 0..batches[1].0.episode_steps() - 1 {
        for (env, buffers) in &mut batches {
            let actions: Vec<f32> = (0..COUNT)
                .flat_map(|index| {
                    let row = &buffers.observations[12 * index..][..12];
                    // returns to the axis from a different side in every environment
                    let phase = index as f32 + 0.02 * step as f32;
                    let (x, y) = (0.3 * phase.cos() - row[0], 0.3 * phase.sin() - row[1]);
                    let (roll, pitch) = (-0.2 * y + 0.2 * row[7], 0.2 * x - 0.2 * row[6]);
                    attitude_law(row, 1.0, roll, pitch, 0.0)
                })
                .collect();
            env.step(&actions, buffers.step()).unwrap();
        }
        let [(_, cpu), (_, gpu)] = &batches;
        assert_eq!((&cpu.terminated, &cpu.truncated), (&gpu.terminated, &gpu.truncated), "step {step}");
        for (a, b) in cpu.observations.chunks_exact(12).zip(gpu.observations.chunks_exact(12)) {
            largest = (0..3).map(|axis| (a[axis] - b[axis]).abs()).fold(largest, f32::max);
        }
    }
    assert!(largest < 1e-4, "{largest:e} m");
}
