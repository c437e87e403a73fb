//! Flights on the GPU against those of the CPU's flight kernel.
#![cfg(feature = "wgpu")]

mod support;

use aviary::action::ActionType;
use aviary::control::ControllerKind;
use aviary::drone::DroneModel;
use aviary::env::{ActuatorRanges, AerodynamicRanges, BodyRanges, EnvConfig, EnvironmentRanges, Randomization};
use aviary::physics::Effects;
use aviary::physics::actuators::ActuatorParams;
use aviary::physics::wind::{DrydenFilter, WindConfig, WindModel};
use aviary::vector::{Autoreset, VecBuffers, VecConfig, VecEnv, make_vec};
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
    (0..count).map(|_| [0.2 * noise.next() as f32, 0.2 * noise.next() as f32, 2.0 * noise.next() as f32]).collect()
}

/// Largest differences between CPU and GPU.
#[derive(Debug, Clone, Copy, Default)]
struct Apart {
    /// Position, m.
    position: f64,
    /// Reward.
    reward: f64,
    /// Entry of an observation.
    observation: f64,
    /// Number of episodes that ended.
    ends: usize,
}

/// Source of the actions.
#[derive(Debug, Clone, Copy)]
enum Pilot {
    /// Motor speeds that hold the attitude of the manoeuvre.
    Motors,
    /// Thrust that holds the height, and body rates towards the attitude of the manoeuvre.
    Rates,
    /// Thrust that holds the height, and the attitude of the manoeuvre.
    Attitude,
    /// The numbers of the manoeuvre as a velocity.
    Velocity,
    /// Small velocities in the plane.
    Level,
    /// Velocity towards the point that the observation has relative to the drone.
    Towards,
    /// Waypoint at the point that the observation has.
    Waypoint,
}

/// A task that flies the same actions on CPU and GPU.
struct Comparison {
    task: &'static str,
    builder: EnvConfig,
    environments: usize,
    pilot: Pilot,
}

impl Comparison {
    fn hover(builder: EnvConfig) -> Self {
        Self { task: "hover", builder, environments: COUNT, pilot: Pilot::Motors }
    }

    /// Flies ten seconds, or an episode that is shorter.
    fn fly(&self, device: &GpuDevice, precision: Precision) -> Apart {
        let config = VecConfig { autoreset: Autoreset::NextStep, ..VecConfig::new(self.environments) };
        let mut cpu = make_vec(self.task, self.builder.clone(), config).unwrap();
        let mut gpu = GpuAviary::make(self.task, self.builder.clone(), config, device, precision).unwrap();
        let (mut on_cpu, mut on_gpu) = (VecBuffers::new(&*cpu), VecBuffers::new(&gpu));
        cpu.reset(Some(1), &mut on_cpu.observations).unwrap();
        gpu.reset(Some(1), &mut on_gpu.observations).unwrap();
        let drones = gpu.states().unwrap().len() / self.environments;
        let (observed, entries) = (gpu.observation_size() / drones, gpu.action_size() / drones);
        let (low, high) = (gpu.action_space().low().to_vec(), gpu.action_space().high().to_vec());
        let (mut noise, mut commands) = (Noise(1), Vec::new());
        let mut apart = Apart::default();
        let steps = (gpu.episode_steps() - 1).min((10.0 / gpu.control_period()) as u64);
        for step in 0..steps {
            if step % 24 == 0 {
                commands = manoeuvres(self.environments * drones, &mut noise);
            }
            let rows = on_cpu.observations.chunks_exact(observed).zip(&commands);
            let actions: Vec<f32> = rows
                .enumerate()
                .flat_map(|(drone, (row, command))| {
                    let bounds = [&low, &high].map(|list| &list[drone % drones * entries..][..entries]);
                    self.pilot.action(row, command, bounds)
                })
                .collect();
            cpu.step(&actions, on_cpu.step()).unwrap();
            gpu.step(&actions, on_gpu.step()).unwrap();
            assert_eq!(on_cpu.terminated, on_gpu.terminated, "step {step}");
            assert_eq!(on_cpu.truncated, on_gpu.truncated, "step {step}");
            for environment in 0..self.environments {
                let [one, other] = [cpu.episode_summary(environment), gpu.episode_summary(environment)]
                    .map(|summary| summary.map(|summary| (summary.steps, summary.end, summary.success)));
                assert_eq!(one, other, "step {step}");
                apart.ends += usize::from(one.is_some());
            }
            for (a, b) in on_cpu.rewards.iter().zip(&on_gpu.rewards) {
                apart.reward = apart.reward.max(f64::from((a - b).abs()));
            }
            for (entry, (a, b)) in on_cpu.observations.iter().zip(&on_gpu.observations).enumerate() {
                let mut difference = f64::from((a - b).abs());
                if (3..6).contains(&(entry % observed)) {
                    // angles near half a turn
                    difference = difference.min(std::f64::consts::TAU - difference);
                }
                apart.observation = apart.observation.max(difference);
            }
            if step % 16 == 0 || step + 1 == steps {
                for (index, state) in gpu.states().unwrap().into_iter().enumerate() {
                    let numbers = cpu.kinematic(index / drones, index % drones).unwrap();
                    let own = gpu_kinematic(&gpu, step, index, drones);
                    let from = [0, 1, 2].map(|axis| state.position[axis] - numbers[axis]);
                    apart.position = apart.position.max(from.iter().map(|x| x * x).sum::<f64>().sqrt());
                    // close wakes amplify the rounding of single precision
                    if let Some(own) = own.filter(|_| precision == Precision::Double) {
                        let commands = own[own.len() - 4..].iter().zip(&numbers[numbers.len() - 4..]);
                        for (own, other) in commands {
                            assert!((own - other).abs() < 1e-3, "step {step}, drone {index}: {own} and {other} rpm");
                        }
                    }
                }
            }
        }
        apart
    }
}

/// Returns the kinematic numbers of some drones; every call copies the whole batch.
fn gpu_kinematic(gpu: &GpuAviary, step: u64, index: usize, drones: usize) -> Option<[f64; 20]> {
    (step.is_multiple_of(160) && index < 4).then(|| gpu.kinematic(index / drones, index % drones).unwrap())
}

impl Pilot {
    /// Returns the action of a drone from its observation, its manoeuvre and the bounds of its action.
    fn action(self, row: &[f32], command: &[f32; 3], [low, high]: [&[f64]; 2]) -> Vec<f32> {
        let &[roll, pitch, yaw] = command;
        let (sin, cos) = row[5].sin_cos();
        let collective = 0.4 * (HEIGHT as f32 - row[2]) - 0.3 * row[8];
        let numbers = match self {
            Self::Motors => {
                // the velocity in the heading frame
                let (x, y) = (cos * row[6] + sin * row[7], cos * row[7] - sin * row[6]);
                return attitude_law(row, HEIGHT as f32, roll + 0.1 * y, pitch - 0.1 * x, yaw)[..high.len()].to_vec();
            }
            Self::Rates => [collective, 0.4 * (roll - row[3]), 0.4 * (pitch - row[4]), 0.2 * yaw],
            Self::Attitude => [collective, 2.0 * roll, 2.0 * pitch, 0.3 * yaw],
            Self::Velocity => [2.0 * roll, 2.0 * pitch, HEIGHT as f32 - row[2], 0.5 * yaw],
            Self::Level => [0.5 * roll, 0.5 * pitch, 0.0, 0.5 * yaw],
            // the frames of body and heading are close
            Self::Towards => [1.5 * row[15], 1.5 * row[16], 1.5 * row[17], 0.1],
            Self::Waypoint => [row[12], row[13], row[14], 0.3 * yaw],
        };
        numbers.iter().zip(low.iter().zip(high)).map(|(x, (low, high))| x.clamp(*low as f32, *high as f32)).collect()
    }
}

/// Effects and airframes of the comparison.
fn variants() -> Vec<(&'static str, Comparison)> {
    let lag =
        ActuatorParams { lag: 0.05, gains: [1.0, 0.98, 1.01, 0.99], saturation: 0.9, ..ActuatorParams::default() };
    let late = |latency| ActuatorParams { latency, ..ActuatorParams::default() };
    let medium = Medium { density: 1.225, viscosity: 1.8e-5 };
    let wind = |model| WindConfig { velocity: [0.5, -0.3, 0.1], ..WindConfig::new(model) };
    let all = Effects { downwash: false, ..Effects::ALL };
    let variants = [
        ("plain", free_flight()),
        ("drag and ground effect", free_flight().effects(all)),
        ("motors", free_flight().actuators(lag)),
        ("late motors", free_flight().actuators(late(0.0125))),
        ("motors late by a control step", free_flight().actuators(late(0.0208))),
        ("late motors with lag", free_flight().actuators(ActuatorParams { latency: 0.021, ..lag })),
        ("body-fixed forcing", free_flight().forcing(Forcing::BodyFixed)),
        ("medium", free_flight().medium(medium)),
        ("constant wind", free_flight().effects(all).wind(wind(WindModel::Constant))),
        ("sinusoidal wind", free_flight().wind(wind(WindModel::Sinusoidal))),
        ("constant wind in a medium", free_flight().medium(medium).wind(wind(WindModel::Constant))),
        ("plus frame", free_flight().drone(DroneModel::Cf2p)),
        ("one motor speed", free_flight().action_type(ActionType::OneDRpm)),
    ];
    let mut all: Vec<_> = variants.into_iter().map(|(name, builder)| (name, Comparison::hover(builder))).collect();
    for (name, action_type, controller, pilot) in [
        ("ctbr", ActionType::Ctbr, ControllerKind::Dsl, Pilot::Rates),
        ("attitude", ActionType::Attitude, ControllerKind::Dsl, Pilot::Attitude),
        ("vel with pid", ActionType::Vel, ControllerKind::Pid, Pilot::Velocity),
        ("vel with dsl", ActionType::Vel, ControllerKind::Dsl, Pilot::Velocity),
        ("vel with geometric", ActionType::Vel, ControllerKind::Geometric, Pilot::Velocity),
    ] {
        let builder = free_flight().action_type(action_type).controller(controller);
        all.push((name, Comparison { pilot, ..Comparison::hover(builder) }));
    }
    let options = EnvConfig::default;
    for (name, task, action_type, controller, pilot) in [
        ("fly_through", "fly_through", ActionType::Vel, ControllerKind::Dsl, Pilot::Towards),
        ("waypoints", "fly_through", ActionType::Pid, ControllerKind::Geometric, Pilot::Waypoint),
        ("waypoints with pid", "fly_through", ActionType::Pid, ControllerKind::Pid, Pilot::Waypoint),
        ("race", "race", ActionType::Vel, ControllerKind::Dsl, Pilot::Towards),
        ("waypoints of a race", "race", ActionType::Pid, ControllerKind::Dsl, Pilot::Waypoint),
    ] {
        let builder = options().action_type(action_type).controller(controller);
        all.push((name, Comparison { task, builder, environments: 3, pilot }));
    }
    all
}

/// Worlds of several drones. The wake of a drone at the same height is singular: in single precision rounding decides
/// which of two drones is above the other.
fn swarms(downwash: bool) -> Vec<(&'static str, Comparison)> {
    let with = |drones: usize, effects| EnvConfig::default().num_drones(drones).effects(effects);
    let options = |drones| with(drones, Effects { downwash, ..Effects::ALL });
    let waypoints = |drones| options(drones).action_type(ActionType::Pid).controller(ControllerKind::Dsl);
    let stack = with(3, Effects::ALL).initial_positions([[0.0, 0.0, 1.0], [0.05, 0.1, 1.5], [0.3, -0.1, 2.1]]);
    let stack = stack.action_type(ActionType::Vel).controller(ControllerKind::Dsl);
    let level = |drones| options(drones).action_type(ActionType::Vel).controller(ControllerKind::Pid);
    let comparison = |task, builder, pilot| Comparison { task, builder, environments: 5, pilot };
    vec![
        ("wakes", comparison("multi_hover", stack, Pilot::Level)),
        ("formation", comparison("formation", waypoints(3), Pilot::Waypoint)),
        ("antipodal", comparison("antipodal", level(12), Pilot::Level)),
    ]
}

fn assert_close(name: &str, apart: Apart, position: f64, others: f64) {
    assert!(apart.position < position, "{name}: {apart:?}");
    assert!(apart.reward < others && apart.observation < others, "{name}: {apart:?}");
}

#[test]
fn double_precision_agrees_with_the_cpu() {
    let Some(device) = device("double_precision_agrees_with_the_cpu") else { return };
    if !device.adapter().double {
        return;
    }
    for (name, comparison) in variants().into_iter().chain(swarms(true)) {
        // observations and rewards are in single precision
        assert_close(name, comparison.fly(&device, Precision::Double), 1e-12, 2e-6);
    }
}

#[test]
fn single_precision_stays_close_to_the_cpu_under_the_same_actions() {
    let Some(device) = device("single_precision_stays_close_to_the_cpu_under_the_same_actions") else { return };
    for (name, comparison) in variants().into_iter().chain(swarms(false)) {
        // open loop: nothing corrects the rounding
        assert_close(name, comparison.fly(&device, Precision::Single), 5e-3, 2e-2);
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

/// Ranges of one number draw the same parameters on CPU and GPU.
#[test]
fn sampled_parameters_act_as_on_the_cpu() {
    let Some(device) = device("sampled_parameters_act_as_on_the_cpu") else { return };
    if !device.adapter().double {
        return;
    }
    let exactly = |x: f64| [x, x];
    let body = BodyRanges { mass: exactly(1.1), inertia: exactly(0.9), arm_length: exactly(1.02) };
    let air = AerodynamicRanges {
        thrust: exactly(1.05),
        torque: exactly(0.9),
        drag: exactly(1.3),
        ground: exactly(0.7),
        ..AerodynamicRanges::default()
    };
    let motors =
        ActuatorRanges { gain: exactly(1.02), lag: exactly(0.04), latency: exactly(0.0125), max_rpm: exactly(0.95) };
    let gravity = EnvironmentRanges { gravity: exactly(1.02), wind: exactly(0.0) };
    let ranges = Randomization {
        body: Some(body),
        aerodynamics: Some(air),
        actuators: Some(motors),
        environment: Some(gravity),
        ..Randomization::NONE
    };
    let options = free_flight().effects(Effects { downwash: false, ..Effects::ALL }).randomization(ranges.clone());
    let hover = Comparison { environments: 4, ..Comparison::hover(options.clone()) };
    // nothing corrects the rounding of the sampled parameters
    assert_close("motors", hover.fly(&device, Precision::Double), 1e-11, 2e-6);
    // the loops of the controller are unstable with these motors, and a tumbling drone amplifies every rounding
    let motors = ActuatorRanges { lag: exactly(0.01), latency: exactly(0.0), ..motors };
    let ranges = Randomization { actuators: Some(motors), ..ranges };
    let builder = options.randomization(ranges).action_type(ActionType::Vel).controller(ControllerKind::Dsl);
    let loops = Comparison { pilot: Pilot::Velocity, environments: 4, ..Comparison::hover(builder) };
    let apart = loops.fly(&device, Precision::Double);
    assert_eq!(apart.ends, 0, "all drones fly for the whole time: {apart:?}");
    assert_close("velocities", apart, 1e-12, 2e-6);
}

/// A sampled wind has a random direction: drones that follow no position drift equally far on CPU and GPU.
#[test]
fn a_sampled_wind_carries_drones_as_on_the_cpu() {
    let Some(device) = device("a_sampled_wind_carries_drones_as_on_the_cpu") else { return };
    const COUNT: usize = 400;
    for (drag_area, min) in [(None, 0.02), (Some(0.03), 0.2)] {
        let wind = EnvironmentRanges { gravity: [1.0, 1.0], wind: [1.0, 1.0] };
        let settings = WindConfig { drag_area, filter: DrydenFilter::MilF8785c, ..WindConfig::default() };
        let ranges = Randomization { environment: Some(wind), ..Randomization::NONE };
        let options = free_flight().wind(settings).randomization(ranges);
        let mut cpu = make_vec("hover", options.clone(), VecConfig::new(COUNT)).unwrap();
        let mut gpu = GpuAviary::make("hover", options, VecConfig::new(COUNT), &device, Precision::Single).unwrap();
        let mut batches: [&mut dyn VecEnv; 2] = [&mut *cpu, &mut gpu];
        let [one, other] = batches.each_mut().map(|env| {
            let mut buffers = VecBuffers::new(*env);
            env.reset(Some(1), &mut buffers.observations).unwrap();
            for _ in 0..96 {
                let rows = buffers.observations.chunks_exact(12);
                let actions: Vec<f32> = rows.flat_map(|row| attitude_law(row, HEIGHT as f32, 0.0, 0.0, 0.0)).collect();
                env.step(&actions, buffers.step()).unwrap();
            }
            let drift = |row: &[f32]| f64::from(row[0].hypot(row[1]));
            let mut drifts: Vec<f64> = buffers.observations.chunks_exact(12).map(drift).collect();
            drifts.sort_by(f64::total_cmp);
            drifts
        });
        // medians and quartiles
        for part in [COUNT / 4, COUNT / 2, 3 * COUNT / 4] {
            let ratio = other[part] / one[part];
            assert!((0.85..1.18).contains(&ratio), "{} m and {} m", one[part], other[part]);
        }
        assert!(one[COUNT / 2] > min, "{} m", one[COUNT / 2]);
    }
}

/// Environments of another stream are others.
#[test]
fn streams_are_shifted_environments() {
    let Some(device) = device("streams_are_shifted_environments") else { return };
    let start = |stream: u64, count: usize| {
        let options = EnvConfig::default().stream(stream);
        let mut env = GpuAviary::make("stabilize", options, VecConfig::new(count), &device, Precision::Single).unwrap();
        let mut rows = vec![0.0; 12 * count];
        env.reset(Some(1), &mut rows).unwrap();
        rows
    };
    assert_eq!(start(0, 8)[12 * 5..], start(5, 3));
}
