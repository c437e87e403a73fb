//! Steps per second of the engines and of batches, with their ratio to bare MuJoCo steps in the same run.

mod meter;
mod policy;

use std::fmt::Write as _;
use std::hint::black_box;
use std::time::{Duration, Instant};

use aviary::drone::DroneModel;
use aviary::engine::EngineKind;
use aviary::engine::flight::{Airframe, Flow, FreeBody, LANES, LaneParams, Lanes, ReachBound, Width, advance};
use aviary::env::{AviaryBuilder, DroneEnv, Env, EnvConfig, EnvError, Task};
use aviary::observation::ObservationType;
use aviary::physics::Physics;
use aviary::physics::downwash::Wake;
use aviary::physics::ground_effect::GroundEffect;
use aviary::physics::rotor::RotorModel;
use aviary::state::DroneState;
use aviary::tasks::{Hover, MultiHover, make};
use aviary::vector::{VecAviary, VecBuffers, VecConfig, VecEnv, VecImages};
use aviary::world::Medium;
use clap::Args;
use nalgebra::Vector3;
use serde_json::{Value, json};

use self::meter::{Bare, Meter, median};
use self::policy::{LinearPolicy, place};
use crate::failure::Failure;
use crate::output;

/// Measure steps per second of engines, environments and batches
///
/// Each measurement alternates with bare mj_step calls of MuJoCo. The ratio to them is
/// comparable between machines and runs; absolute rates are not.
///
/// Batches of hover climb slowly under noise that all motors share, and restart at the end of an
/// episode. A linear policy with noise flies single environments and swarms. The time to compute
/// actions does not count. In the row of random actions, most episodes end on the floor after a
/// few steps.
#[derive(Debug, Args)]
#[command(verbatim_doc_comment)]
#[command(after_help = "Examples:
  aviary bench
  aviary bench --quick --json")]
pub struct Bench {
    /// Fewer and shorter measurements, within 30 s
    #[arg(long)]
    quick: bool,
    /// Seed of the noise of the actions
    #[arg(long, value_name = "N", default_value_t = 0, allow_negative_numbers = true)]
    seed: u64,
    /// JSON output instead of a table
    #[arg(long)]
    json: bool,
}

/// One measurement.
struct Row {
    name: String,
    engine: &'static str,
    task: String,
    environments: usize,
    drones: usize,
    physics: Physics,
    threads: usize,
    env_steps_per_second: f64,
    physics_steps_per_second: f64,
    ratio: f64,
    /// Ratio to bare `mj_step` calls with the same contacts, for the row of resting drones.
    ratio_in_contact: Option<f64>,
    bytes_per_environment: usize,
    /// Growth of the process for one environment, bytes; large batches only.
    resident_bytes: Option<usize>,
    frames_per_second: Option<f64>,
}

impl Bench {
    pub fn run(&self) -> Result<(), Failure> {
        let mut meter = Meter::new(self)?;
        let rows = self.rows(&mut meter).map_err(Failure::work)?;
        let mj_step = meter.bare_rate();
        if self.json {
            let list: Vec<Value> = rows.iter().map(Row::json).collect();
            return output::print_json(&json!({
                "machine": machine(),
                "instructions": Width::best().name(),
                "threads": cores(),
                "mj_step_per_second": mj_step,
                "rows": list,
            }));
        }
        let mut text = title();
        let _ = writeln!(text, "bare mj_step: {mj_step:.0} per second ({:.2} µs)\n", 1e6 / mj_step);
        let _ = writeln!(
            text,
            "{:<44}{:>8}{:>8}{:>14}{:>15}{:>10}{:>10}",
            "measurement", "drones", "threads", "env steps/s", "physics/s", "ratio", "bytes/env"
        );
        for row in &rows {
            row.print(&mut text);
        }
        text += "\nratio: physics steps of all drones per bare mj_step, median of alternating measurements\n";
        output::print(&text)
    }

    fn rows(&self, meter: &mut Meter) -> Result<Vec<Row>, EnvError> {
        let mut rows = Vec::new();
        kernel_rows(meter, &mut rows);
        for (physics, drones) in
            [(Physics::Mjc, 1), (Physics::MjcGndDragDw, 1), (Physics::Mjc, 4), (Physics::MjcGndDragDw, 4)]
        {
            for engine in EngineKind::WITH_CONTACTS {
                if self.quick && drones > 1 {
                    continue;
                }
                rows.push(single(meter, engine, physics, drones)?);
            }
        }
        let sizes: &[usize] = if self.quick { &[4096] } else { &[1, 64, 1024, 4096, 65_536] };
        let threads: &[usize] = if cores() > 1 { &[1, 0] } else { &[1] };
        for &size in sizes {
            for &threads in threads {
                if threads == 0 && size < 2 * LANES {
                    continue;
                }
                rows.push(batch(meter, "hover", size, threads, Physics::Mjc, EngineKind::Hybrid, Actions::Climb)?);
                if !self.quick || threads == 1 {
                    rows.push(batch(
                        meter,
                        "hover",
                        size,
                        threads,
                        Physics::MjcGndDragDw,
                        EngineKind::Hybrid,
                        Actions::Climb,
                    )?);
                }
            }
        }
        rows.push(batch(meter, "hover", 4096, 1, Physics::Mjc, EngineKind::Hybrid, Actions::Random)?);
        rows.push(batch(meter, "hover", 64, 1, Physics::Mjc, EngineKind::Mujoco, Actions::Climb)?);
        rows.push(resting(meter)?);
        if !self.quick {
            for threads in threads {
                rows.push(swarm(meter, 4, 1024, *threads)?);
            }
            rows.push(swarm(meter, 12, 256, 1)?);
        } else {
            rows.push(swarm(meter, 12, 64, 1)?);
        }
        for &threads in threads {
            // without OpenGL there is no row of cameras
            if let Ok(row) = cameras(meter, threads) {
                rows.push(row);
            }
        }
        Ok(rows)
    }
}

impl Row {
    fn json(&self) -> Value {
        let mut value = json!({
            "name": self.name,
            "engine": self.engine,
            "task": self.task,
            "environments": self.environments,
            "drones": self.drones,
            "physics": self.physics.name(),
            "threads": self.threads,
            "env_steps_per_second": self.env_steps_per_second,
            "physics_steps_per_second": self.physics_steps_per_second,
            "ratio_to_mj_step": self.ratio,
            "bytes_per_environment": self.bytes_per_environment,
        });
        if let Some(bytes) = self.resident_bytes {
            value["resident_bytes_per_environment"] = json!(bytes);
        }
        if let Some(ratio) = self.ratio_in_contact {
            value["ratio_to_mj_step_in_contact"] = json!(ratio);
        }
        if let Some(frames) = self.frames_per_second {
            value["frames_per_second"] = json!(frames);
        }
        value
    }

    fn print(&self, text: &mut String) {
        let bytes = self.bytes_per_environment;
        let bytes = if bytes == 0 { "-".to_string() } else { bytes.to_string() };
        // the kernel has no environments
        let steps = if self.task.is_empty() { "-".into() } else { format!("{:.0}", self.env_steps_per_second) };
        let _ = write!(
            text,
            "{:<44}{:>8}{:>8}{:>14}{:>15.0}{:>10.2}{:>10}",
            self.name, self.drones, self.threads, steps, self.physics_steps_per_second, self.ratio, bytes
        );
        if let Some(ratio) = self.ratio_in_contact {
            let _ = write!(text, "  ({ratio:.2} of mj_step with the same contacts)");
        }
        if let Some(frames) = self.frames_per_second {
            let _ = write!(text, "  ({frames:.0} frames/s)");
        }
        text.push('\n');
    }
}

/// Returns the first line of the table: processor, threads and the instruction set of the flight kernel.
fn title() -> String {
    format!("{}, {}, instruction set {}\n", machine(), aviary::count(cores(), "thread"), Width::best().name())
}

fn cores() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

fn machine() -> String {
    let info = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let model = info.lines().find_map(|line| line.strip_prefix("model name")).and_then(|line| line.split(": ").nth(1));
    model.unwrap_or(std::env::consts::ARCH).to_string()
}

/// Returns the resident memory of this process, bytes.
fn resident() -> usize {
    let statm = std::fs::read_to_string("/proc/self/statm").unwrap_or_default();
    statm.split_whitespace().nth(1).and_then(|pages| pages.parse::<usize>().ok()).unwrap_or(0) * 4096
}

/// Measures the flight kernel in every instruction set of the machine.
fn kernel_rows(meter: &mut Meter, rows: &mut Vec<Row>) {
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
                share: 1.0,
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
            let flow = Flow { dt: 1.0 / 240.0, body_fixed, medium, air, width };
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
                ratio_in_contact: None,
                bytes_per_environment: 0,
                resident_bytes: None,
                frames_per_second: None,
            });
        }
    }
}

/// Measures a single environment.
fn single(meter: &mut Meter, engine: EngineKind, physics: Physics, drones: usize) -> Result<Row, EnvError> {
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
        ratio_in_contact: None,
        bytes_per_environment: 0,
        resident_bytes: None,
        frames_per_second: None,
    })
}

/// Source of the actions of a batch.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Actions {
    /// Precomputed actions of a slow climb under noise.
    Climb,
    /// Actions of a linear policy.
    Policy,
    /// Uniform actions.
    Random,
}

/// Measures a batch of hover.
fn batch(
    meter: &mut Meter,
    name: &str,
    size: usize,
    threads: usize,
    physics: Physics,
    engine: EngineKind,
    actions: Actions,
) -> Result<Row, EnvError> {
    let builder = Hover::builder().physics(physics).engine(engine);
    let before = resident();
    let mut env = VecAviary::new(builder, VecConfig { threads, ..VecConfig::new(size) })?;
    let bytes = (size >= 65_536).then(|| resident().saturating_sub(before) / size);
    let label = if actions == Actions::Random { "random actions, " } else { "" };
    let row_name = format!("{name} × {size}, {label}{engine}, {physics}");
    fly(meter, &mut env, row_name, physics, engine, actions, bytes)
}

/// Measures a batch of swarms with all effects.
fn swarm(meter: &mut Meter, drones: usize, size: usize, threads: usize) -> Result<Row, EnvError> {
    let (physics, engine) = (Physics::MjcGndDragDw, EngineKind::Hybrid);
    let builder = MultiHover::builder()
        .num_drones(drones)
        .physics(physics)
        .engine(engine)
        .task(|task| task.target_heights = Some((0..drones).map(|drone| place(drone)[2]).collect()))
        .initial_positions((0..drones).map(place));
    let mut env = VecAviary::new(builder, VecConfig { threads, ..VecConfig::new(size) })?;
    let name = format!("multi_hover × {size}, {engine}, {physics}");
    fly(meter, &mut env, name, physics, engine, Actions::Policy, None)
}

fn fly<T: Task + Clone + Send + Sync>(
    meter: &mut Meter,
    env: &mut VecAviary<T>,
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
        ratio_in_contact: None,
        bytes_per_environment: env.bytes_per_env(),
        resident_bytes,
        frames_per_second: None,
    })
}

/// Measures drones that rest on the floor, with the ratio to bare MuJoCo steps with the same contacts.
fn resting(meter: &mut Meter) -> Result<Row, EnvError> {
    let (size, engine) = (64, EngineKind::Hybrid);
    let builder = Hover::builder().engine(engine).initial_positions([[0.0, 0.0, 0.015]]);
    let mut env = VecAviary::new(builder, VecConfig { threads: 1, ..VecConfig::new(size) })?;
    let mut buffers = VecBuffers::new(&env);
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
        ratio_in_contact: Some(median(&mut ratios)),
        bytes_per_environment: env.bytes_per_env(),
        resident_bytes: None,
        frames_per_second: None,
    })
}

/// Measures a batch with onboard cameras.
fn cameras(meter: &mut Meter, threads: usize) -> Result<Row, EnvError> {
    let size = 64;
    let builder: AviaryBuilder<Hover> =
        Hover::builder().observation_type(ObservationType::KIN_RGB).engine(EngineKind::Hybrid);
    let mut env = VecAviary::new(builder, VecConfig { threads, ..VecConfig::new(size) })?;
    let mut buffers = VecBuffers::new(&env);
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
        ratio_in_contact: None,
        bytes_per_environment: env.bytes_per_env(),
        resident_bytes: None,
        frames_per_second: Some(measured.rate * per_call),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_names_the_processor_and_the_instruction_set() {
        let title = title();
        assert!(
            title.starts_with(&machine()) && title.ends_with(&format!("set {}\n", Width::best().name())),
            "{title}"
        );
    }
}
