//! Measurements of batches on a GPU.

use std::fmt::Write as _;
use std::time::Instant;

use aviary::env::{EnvConfig, Randomization};
use aviary::physics::Effects;
use aviary::physics::actuators::ActuatorParams;
use aviary::vector::{Autoreset, VecBuffers, VecConfig, VecEnv, make_vec};
use aviary_gpu::{GpuAviary, GpuDevice, GpuError, Precision, bandwidth};
use serde_json::{Value, json};

use super::Bench;
use crate::failure::Failure;
use crate::output;

/// Conditions of a measurement.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Conditions {
    Plain,
    Effects,
    Randomized,
}

impl Conditions {
    const ALL: [Self; 3] = [Self::Plain, Self::Effects, Self::Randomized];

    fn name(self) -> &'static str {
        match self {
            Self::Plain => "plain",
            Self::Effects => "all effects and lag",
            Self::Randomized => "all effects, randomized",
        }
    }

    fn options(self, drones: usize) -> EnvConfig {
        let options = EnvConfig::default().num_drones(drones);
        let lag = ActuatorParams { lag: 0.05, ..ActuatorParams::default() };
        match self {
            Self::Plain => options,
            Self::Effects => options.effects(Effects::ALL).actuators(lag),
            Self::Randomized => options.effects(Effects::ALL).randomization(Randomization::default()),
        }
    }
}

/// A batch to measure.
#[derive(Debug, Clone, Copy)]
struct Case {
    task: &'static str,
    conditions: Conditions,
    precision: Precision,
    drones: usize,
    environments: usize,
}

/// Measurement of a batch.
struct Rates {
    case: Case,
    /// Environment steps per second without copies to the host.
    resident: f64,
    /// Environment steps per second with copies of actions, observations, rewards and ends.
    copied: f64,
    bytes_per_environment: usize,
    /// Bytes that an environment step reads and writes.
    traffic: usize,
    /// Physics steps of a control step.
    substeps: u64,
}

impl Case {
    /// Measures the batch for about `seconds` with and without copies.
    fn measure(self, device: &GpuDevice, seconds: f64) -> Result<Rates, GpuError> {
        let config = VecConfig { autoreset: Autoreset::SameStep, ..VecConfig::new(self.environments) };
        let options = self.conditions.options(self.drones);
        let mut env = GpuAviary::make(self.task, options, config, device, self.precision)?;
        let mut buffers = VecBuffers::new(&env);
        env.reset(Some(1), &mut buffers.observations)?;
        let actions = vec![0.01; env.action_size() * self.environments];
        // the first step compiles the kernel
        env.step(&actions, buffers.step())?;
        env.repeat_on_device(1)?;
        let rate =
            |steps: u32, start: Instant| f64::from(steps) * self.environments as f64 / start.elapsed().as_secs_f64();
        let mut steps = 1;
        let resident = loop {
            let start = Instant::now();
            env.repeat_on_device(steps)?;
            if start.elapsed().as_secs_f64() > 0.5 * seconds || steps > 1 << 20 {
                break rate(steps, start);
            }
            steps *= 2;
        };
        let (start, mut count) = (Instant::now(), 0);
        while count == 0 || start.elapsed().as_secs_f64() < 0.5 * seconds {
            env.step(&actions, buffers.step())?;
            count += 1;
        }
        let copied = rate(count, start);
        let before = env.engine_substeps().flight;
        env.step(&actions, buffers.step())?;
        let substeps = env.engine_substeps().flight - before;
        Ok(Rates {
            case: self,
            resident,
            copied,
            bytes_per_environment: env.bytes_per_env(),
            traffic: env.bytes_per_step(),
            substeps: substeps / self.environments as u64,
        })
    }
}

/// Measures batches on a GPU, and prints them.
pub(super) fn run(bench: &Bench) -> Result<(), Failure> {
    let device = GpuDevice::open(bench.adapter.as_deref())?;
    let seconds = if bench.quick { 0.3 } else { 1.0 };
    let (mut rows, bandwidth) = (Vec::new(), bandwidth(&device)?);
    let launch =
        Case { task: "hover", conditions: Conditions::Plain, precision: Precision::Single, drones: 1, environments: 1 };
    let launch = launch.measure(&device, seconds)?.resident.recip();
    // before the batches of the device, one of which may fail
    let cpu = on_the_cpu(seconds).map_err(Failure::work)?;
    let mut failure = None;
    for case in cases(bench, &device) {
        match case.measure(&device, seconds) {
            Ok(row) => rows.push(row),
            // the largest batches do not fit every device
            Err(GpuError::TooManyEnvironments { .. }) => {}
            // the rows so far are printed; a device that has failed measures no more
            Err(error) => {
                failure = Some(error.into());
                break;
            }
        }
    }
    let adapter = device.adapter();
    if bench.json {
        output::print_json(&json!({
            "adapter": adapter.to_string(),
            "bandwidth_bytes_per_second": bandwidth,
            "seconds_per_launch": launch,
            "cpu_env_steps_per_second": cpu,
            "rows": rows.iter().map(|row| row.json(bandwidth)).collect::<Vec<Value>>(),
        }))?;
        return failure.map_or(Ok(()), Err);
    }
    let mut text = format!("{adapter}\n");
    let _ = writeln!(text, "memory bandwidth of copies: {:.1} GB/s", bandwidth / 1e9);
    let _ = writeln!(text, "launch of a control step of one environment: {:.1} µs", launch * 1e6);
    let _ = writeln!(text, "batch of the CPU, hover × 4096, all threads: {:.3} million env steps/s\n", cpu / 1e6);
    let _ = writeln!(
        text,
        "{:<13}{:<26}{:<8}{:>7}{:>10}{:>15}{:>13}{:>14}{:>11}",
        "task", "conditions", "number", "drones", "envs", "Menv steps/s", "with copies", "of bandwidth", "bytes/env"
    );
    for row in &rows {
        row.print(bandwidth, &mut text);
    }
    text += "\nof bandwidth: memory traffic of the kernel relative to the bandwidth of copies\n";
    output::print(&text)?;
    failure.map_or(Ok(()), Err)
}

/// Returns the batches to measure.
fn cases(bench: &Bench, device: &GpuDevice) -> Vec<Case> {
    let sizes: &[u32] = if bench.quick { &[12] } else { &[12, 14, 16, 18, 20] };
    let mut cases = Vec::new();
    for precision in [Precision::Single, Precision::Double] {
        if precision == Precision::Double && !device.adapter().double {
            continue;
        }
        for conditions in Conditions::ALL {
            for &exponent in sizes {
                let environments = 1 << exponent;
                cases.push(Case { task: "hover", conditions, precision, drones: 1, environments });
            }
        }
    }
    for drones in [4, 12] {
        for &exponent in &sizes[..sizes.len().min(4)] {
            cases.push(Case {
                task: "multi_hover",
                conditions: Conditions::Effects,
                precision: Precision::Single,
                drones,
                environments: (1 << exponent) / 4,
            });
        }
    }
    if let Some(only) = &bench.only {
        cases.retain(|case| case.task.contains(only.as_str()) || case.conditions.name().contains(only.as_str()));
    }
    cases
}

/// Returns the environment steps per second of the batch of the CPU.
fn on_the_cpu(seconds: f64) -> Result<f64, aviary::env::EnvError> {
    let config = VecConfig { autoreset: Autoreset::SameStep, ..VecConfig::new(4096) };
    let mut env = make_vec("hover", EnvConfig::default(), config)?;
    let mut buffers = VecBuffers::new(&*env);
    env.reset(Some(1), &mut buffers.observations)?;
    let actions = vec![0.01; 4 * 4096];
    env.step(&actions, buffers.step())?;
    let (start, mut count) = (Instant::now(), 0_u32);
    while start.elapsed().as_secs_f64() < seconds {
        env.step(&actions, buffers.step())?;
        count += 1;
    }
    Ok(f64::from(count) * 4096.0 / start.elapsed().as_secs_f64())
}

fn number(precision: Precision) -> &'static str {
    match precision {
        Precision::Single => "single",
        Precision::Double => "double",
    }
}

impl Rates {
    fn share(&self, bandwidth: f64) -> f64 {
        self.resident * self.traffic as f64 / bandwidth
    }

    fn json(&self, bandwidth: f64) -> Value {
        let Case { task, conditions, precision, drones, environments } = self.case;
        json!({
            "task": task,
            "conditions": conditions.name(),
            "precision": number(precision),
            "drones": drones,
            "environments": environments,
            "env_steps_per_second": self.resident,
            "env_steps_per_second_with_copies": self.copied,
            "drone_physics_steps_per_second": self.resident * (drones as u64 * self.substeps) as f64,
            "bytes_per_environment": self.bytes_per_environment,
            "bytes_per_env_step": self.traffic,
            "share_of_bandwidth": self.share(bandwidth),
        })
    }

    fn print(&self, bandwidth: f64, text: &mut String) {
        let Case { task, conditions, precision, drones, environments } = self.case;
        let _ = writeln!(
            text,
            "{task:<13}{:<26}{:<8}{drones:>7}{environments:>10}{:>15.3}{:>13.3}{:>12.0} %{:>11}",
            conditions.name(),
            number(precision),
            self.resident / 1e6,
            self.copied / 1e6,
            100.0 * self.share(bandwidth),
            self.bytes_per_environment,
        );
    }
}
