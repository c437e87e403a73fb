//! Measurements of the kernel, of single environments and of batches.

use std::hint::black_box;
use std::time::{Duration, Instant};

use aviary::drone::DroneModel;
use aviary::engine::EngineKind;
use aviary::engine::flight::{Airframe, Flow, FreeBody, LANES, LaneParams, Lanes, ReachBound, Width, advance};
use aviary::env::{DroneEnv, Env, EnvConfig, EnvError};
use aviary::observation::ObservationType;
use aviary::physics::Physics;
use aviary::physics::airframe::AirframeEffects;
use aviary::physics::downwash::Wake;
use aviary::physics::ground_effect::GroundEffect;
use aviary::physics::rotor::RotorModel;
use aviary::state::DroneState;
use aviary::tasks::make;
use aviary::vector::{VecBuffers, VecConfig, VecEnv, VecImages, make_vec};
use aviary::world::Medium;
use nalgebra::Vector3;

use super::Row;
use super::meter::{Bare, Meter, median};
use super::policy::{LinearPolicy, place};

/// Returns the resident memory of this process, bytes.
pub(super) fn resident() -> usize {
    let statm = std::fs::read_to_string("/proc/self/statm").unwrap_or_default();
    statm.split_whitespace().nth(1).and_then(|pages| pages.parse::<usize>().ok()).unwrap_or(0) * 4096
}

/// Measures the flight kernel in every instruction set of the machine.
pub(super) fn kernel_rows(meter: &mut Meter, rows: &mut Vec<Row>) {
    let params = DroneModel::Cf2x.params();
    let hover = params.hover_rpm();
    const BLOCKS: usize = 64;
    for width in Width::available() {
        for (what, physics, body_fixed, medium) in [
            ("mjc", Physics::Mjc, false, false),
            ("all effects", Physics::MjcGndDragDw, false, false),
            ("body-fixed", Physics::Mjc, true, false),
            ("medium", Physics::Mjc, false, true),
        ] {
            let body = FreeBody::new(params.mass, &params.inertia_vector(), 9.81, medium.then_some(Medium::AIR));
            let air = physics != Physics::Mjc;
            let airframe = Airframe {
                body,
                rotors: RotorModel::new(&params),
                ground: if air { GroundEffect::new(&params) } else { GroundEffect::default() },
                drag: if air { params.drag_coefficients.into() } else { Vector3::zeros() },
                wake: Wake::new(&params),
                effects: AirframeEffects::default(),
                share: 1.0,
                fall_share: 1.0,
                max_command: params.max_rpm(),
                gains: [1.0; 4],
                max_rpm: params.max_rpm(),
                cylinder: [params.collision_radius, params.collision_height],
                reach_bound: ReachBound::default(),
            };
            let frames = LaneParams::all(&airframe);
            let mut start = vec![Lanes::default(); BLOCKS];
            for (block, lanes) in start.iter_mut().enumerate() {
                for lane in 0..LANES {
                    let state = DroneState {
                        angular_velocity: Vector3::new(0.3, 0.2 * lane as f64, 0.05 * block as f64),
                        ..DroneState::at_rest(Vector3::new(0.0, 0.0, 5.0), Vector3::new(0.1, 0.2, 0.3))
                    };
                    lanes.set(lane, &state, &[hover; 4], &[hover; 4]);
                }
            }
            let flow = Flow { dt: 1.0 / 240.0, body_fixed, medium, lag: false, air, airframe_effects: false, width };
            let mut all = start.clone();
            let measured = meter.measure(|| {
                all.clone_from(&start);
                let begin = Instant::now();
                for lanes in &mut all {
                    advance(&flow, lanes, &frames, LANES, 20);
                }
                black_box(&mut all);
                Ok(begin.elapsed())
            });
            let Ok(measured) = measured else { continue };
            let steps = (20 * BLOCKS * LANES) as f64;
            rows.push(Row {
                name: format!("kernel, {}, {what}", width.name()),
                engine: "flight",
                task: String::new(),
                environments: BLOCKS * LANES,
                drones: 1,
                physics,
                threads: 1,
                env_steps_per_second: 0.0,
                physics_steps_per_second: measured.rate * steps,
                ratio: measured.over_bare * steps,
                spread: measured.spread,
                ratio_to_plain: None,
                mujoco_share: None,
                ratio_in_contact: None,
                bytes_per_environment: 0,
                resident_bytes: None,
                frames_per_second: None,
            });
        }
    }
}

/// Measures a single environment.
pub(super) fn single(meter: &mut Meter, engine: EngineKind, physics: Physics, drones: usize) -> Result<Row, EnvError> {
    let task = if drones == 1 { "hover" } else { "multi_hover" };
    let config = EnvConfig::default().engine(engine).physics(physics).num_drones(drones);
    let config = if drones == 1 { config } else { config.initial_positions((0..drones).map(place)) };
    let mut env = make(task, config)?;
    env.reset(Some(1))?;
    let mut policy = LinearPolicy::new(meter.seed, 1, drones, env.observation_space().vector.size() / drones);
    let mut observation = vec![0.0_f32; env.observation_space().vector.size()];
    let mut action = vec![0.0; 4 * drones];
    let measured = meter.measure(|| {
        let mut spent = Duration::ZERO;
        for _ in 0..20 {
            env.observation_space().vector.write_f32(&env.observation().vector, &mut observation);
            for (out, &x) in action.iter_mut().zip(policy.act(&observation)) {
                *out = f64::from(x);
            }
            let begin = Instant::now();
            let step = env.step(&action)?;
            let over = step.terminated || step.truncated;
            black_box(step.reward);
            spent += begin.elapsed();
            if over {
                let begin = Instant::now();
                env.reset(None)?;
                spent += begin.elapsed();
            }
        }
        Ok(spent)
    })?;
    let substeps = f64::from(env.simulation().substeps());
    Ok(Row {
        name: format!("{task} alone, {engine}, {physics}"),
        engine: engine.name(),
        task: task.into(),
        environments: 1,
        drones,
        physics,
        threads: 1,
        env_steps_per_second: 20.0 * measured.rate,
        physics_steps_per_second: 20.0 * measured.rate * substeps,
        ratio: 20.0 * measured.over_bare * substeps * drones as f64,
        spread: measured.spread,
        ratio_to_plain: None,
        mujoco_share: None,
        ratio_in_contact: None,
        bytes_per_environment: 0,
        resident_bytes: None,
        frames_per_second: None,
    })
}

/// Source of the actions of a batch.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Actions {
    /// Precomputed actions of a slow climb under noise.
    Climb,
    /// Actions of a linear policy.
    Policy,
    /// Uniform actions.
    Random,
}

/// Measures a batch of hover.
pub(super) fn batch(
    meter: &mut Meter,
    size: usize,
    threads: usize,
    physics: Physics,
    engine: EngineKind,
    actions: Actions,
) -> Result<Row, EnvError> {
    let options = EnvConfig::default().physics(physics).engine(engine);
    let before = resident();
    let mut env = make_vec("hover", options, VecConfig { threads, width: meter.width, ..VecConfig::new(size) })?;
    let bytes = (size >= 65_536).then(|| resident().saturating_sub(before) / size);
    let label = if actions == Actions::Random { "random actions, " } else { "" };
    let row_name = format!("hover × {size}, {label}{engine}, {physics}");
    fly(meter, &mut *env, row_name, physics, engine, actions, bytes)
}

/// Measures a batch of swarms with all effects.
pub(super) fn swarm(meter: &mut Meter, drones: usize, size: usize, threads: usize) -> Result<Row, EnvError> {
    let (physics, engine) = (Physics::MjcGndDragDw, EngineKind::Hybrid);
    let options = EnvConfig::default()
        .num_drones(drones)
        .physics(physics)
        .engine(engine)
        .task(|task| task.target_heights = Some((0..drones).map(|drone| place(drone)[2]).collect()))
        .initial_positions((0..drones).map(place));
    let mut env = make_vec("multi_hover", options, VecConfig { threads, width: meter.width, ..VecConfig::new(size) })?;
    let name = format!("multi_hover × {size}, {engine}, {physics}");
    fly(meter, &mut *env, name, physics, engine, Actions::Policy, None)
}

fn fly(
    meter: &mut Meter,
    env: &mut dyn VecEnv,
    name: String,
    physics: Physics,
    engine: EngineKind,
    actions: Actions,
    resident_bytes: Option<usize>,
) -> Result<Row, EnvError> {
    let (size, drones, threads) = (env.num_envs(), env.action_size() / 4, env.num_threads());
    let mut buffers = VecBuffers::new(env);
    env.reset(Some(1), &mut buffers.observations)?;
    let mut policy = LinearPolicy::new(meter.seed, size, drones, env.observation_size() / drones);
    let calls = (20_000 / size).clamp(1, 100);
    let before = env.engine_substeps();
    let prepared = policy.climb();
    let mut turn = 0;
    let measured = meter.measure(|| {
        let mut spent = Duration::ZERO;
        for _ in 0..calls {
            turn += 1_usize;
            let action = match actions {
                Actions::Climb => &prepared[turn % prepared.len()],
                Actions::Policy => policy.act(&buffers.observations),
                Actions::Random => policy.random(),
            };
            let begin = Instant::now();
            env.step(action, buffers.step())?;
            spent += begin.elapsed();
        }
        Ok(spent)
    })?;
    let after = env.engine_substeps();
    if engine == EngineKind::Hybrid && actions != Actions::Random && after.mujoco - before.mujoco > after.flight / 100 {
        tracing::warn!("{name}: MuJoCo computed more than 1 % of the physics steps");
    }
    let per_call = (calls * size) as f64;
    // 240 Hz physics, 48 Hz control
    let substeps = 5.0;
    Ok(Row {
        name,
        engine: engine.name(),
        task: env.name().into(),
        environments: size,
        drones,
        physics,
        threads,
        env_steps_per_second: measured.rate * per_call,
        physics_steps_per_second: measured.rate * per_call * substeps,
        ratio: measured.over_bare * per_call * substeps * drones as f64,
        spread: measured.spread,
        ratio_to_plain: None,
        mujoco_share: None,
        ratio_in_contact: None,
        bytes_per_environment: env.bytes_per_env(),
        resident_bytes,
        frames_per_second: None,
    })
}

/// Measures drones that rest on the floor, with the ratio to bare MuJoCo steps with the same contacts.
pub(super) fn resting(meter: &mut Meter) -> Result<Row, EnvError> {
    let (size, engine) = (64, EngineKind::Hybrid);
    let options = EnvConfig::default().engine(engine).initial_positions([[0.0, 0.0, 0.015]]);
    let mut env = make_vec("hover", options, VecConfig { threads: 1, width: meter.width, ..VecConfig::new(size) })?;
    let mut buffers = VecBuffers::new(&*env);
    env.reset(Some(1), &mut buffers.observations)?;
    // rotors at half their hover speed
    let action = vec![-0.5; 4 * size];
    let mut bare = Bare::new(0.015, 0.25)?;
    let (mut own, mut spent_all) = (Vec::new(), Vec::new());
    let measured = meter.measure(|| {
        let begin = Instant::now();
        env.step(&action, buffers.step())?;
        let spent = begin.elapsed();
        let rate = (5 * size) as f64 / spent.as_secs_f64();
        own.push(bare.rate(5 * size)?);
        spent_all.push(rate);
        Ok(spent)
    })?;
    let mut ratios: Vec<_> = spent_all.iter().zip(&own).map(|(rate, bare)| rate / bare).collect();
    let per_call = size as f64;
    Ok(Row {
        name: format!("hover × {size}, resting on the floor, {engine}"),
        engine: engine.name(),
        task: "hover".into(),
        environments: size,
        drones: 1,
        physics: Physics::Mjc,
        threads: 1,
        env_steps_per_second: measured.rate * per_call,
        physics_steps_per_second: measured.rate * per_call * 5.0,
        ratio: measured.over_bare * per_call * 5.0,
        spread: measured.spread,
        ratio_to_plain: None,
        mujoco_share: None,
        ratio_in_contact: Some(median(&mut ratios)),
        bytes_per_environment: env.bytes_per_env(),
        resident_bytes: None,
        frames_per_second: None,
    })
}

/// Measures a batch with onboard cameras.
pub(super) fn cameras(meter: &mut Meter, threads: usize) -> Result<Row, EnvError> {
    let size = 64;
    let options = EnvConfig::default().observation_type(ObservationType::KIN_RGB).engine(EngineKind::Hybrid);
    let mut env = make_vec("hover", options, VecConfig { threads, width: meter.width, ..VecConfig::new(size) })?;
    let mut buffers = VecBuffers::new(&*env);
    env.reset(Some(1), &mut buffers.observations)?;
    let mut policy = LinearPolicy::new(meter.seed, size, 1, env.observation_size());
    let mut rgb = vec![0; size * 4 * env.camera_size().pixels()];
    let measured = meter.measure(|| {
        let action = policy.act(&buffers.observations);
        let begin = Instant::now();
        env.step(action, buffers.step())?;
        env.render_images(VecImages { rgb: &mut rgb, ..VecImages::default() })?;
        Ok(begin.elapsed())
    })?;
    let per_call = size as f64;
    Ok(Row {
        name: format!("hover × {size} with RGB {}", env.camera_size()),
        engine: "hybrid",
        task: "hover".into(),
        environments: size,
        drones: 1,
        physics: Physics::Mjc,
        threads: env.num_threads(),
        env_steps_per_second: measured.rate * per_call,
        physics_steps_per_second: measured.rate * per_call * 5.0,
        ratio: measured.over_bare * per_call * 5.0,
        spread: measured.spread,
        ratio_to_plain: None,
        mujoco_share: None,
        ratio_in_contact: None,
        bytes_per_environment: env.bytes_per_env(),
        resident_bytes: None,
        frames_per_second: Some(measured.rate * per_call),
    })
}
