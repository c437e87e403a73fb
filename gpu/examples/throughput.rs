//! Environment steps per second of Hover on the first adapter, with the results left on the device and copied to the
//! host.
//!
//! ```sh
//! cargo run --release -p aviary-gpu --features vulkan --example throughput -- 20
//! ```
//!
//! The argument is the binary logarithm of the largest batch; default 16.

use std::io::Write as _;
use std::time::Instant;

use aviary::env::EnvConfig;
use aviary::physics::Effects;
use aviary::physics::actuators::ActuatorParams;
use aviary::vector::{Autoreset, VecBuffers, VecConfig, VecEnv};
use aviary_gpu::{GpuAviary, GpuDevice, GpuError, Precision};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let largest: u32 = std::env::args().nth(1).map_or(Ok(16), |argument| argument.parse())?;
    let device = GpuDevice::open(None)?;
    let mut out = std::io::stdout().lock();
    writeln!(out, "{}", device.adapter())?;
    writeln!(out, "precision  effects  environments  on the device  with copies  (million environment steps/s)")?;
    for precision in [Precision::Single, Precision::Double] {
        for effects in [false, true] {
            for exponent in (12..=largest).step_by(2) {
                let rates = match measure(&device, precision, effects, 1 << exponent) {
                    Err(GpuError::NoDouble { .. }) => continue,
                    rates => rates?,
                };
                let [resident, copied] = rates.map(|rate| rate / 1e6);
                let on = if effects { "all" } else { "none" };
                let precision = format!("{precision:?}").to_lowercase();
                writeln!(out, "{precision:9}  {on:7}  {:12}  {resident:13.3}  {copied:11.3}", 1_u32 << exponent)?;
            }
        }
    }
    Ok(())
}

/// Returns the environment steps per second without and with copies to the host.
fn measure(device: &GpuDevice, precision: Precision, effects: bool, count: usize) -> Result<[f64; 2], GpuError> {
    let mut builder = EnvConfig::default();
    if effects {
        let lag = ActuatorParams { lag: 0.05, ..ActuatorParams::default() };
        builder = builder.effects(Effects { downwash: false, ..Effects::ALL }).actuators(lag);
    }
    let config = VecConfig { autoreset: Autoreset::SameStep, ..VecConfig::new(count) };
    let mut env = GpuAviary::make("hover", builder, config, device, precision)?;
    let mut buffers = VecBuffers::new(&env);
    env.reset(Some(1), &mut buffers.observations)?;
    let actions = vec![0.01; 4 * count];
    // the first step compiles the kernel
    env.step(&actions, buffers.step())?;
    env.repeat_on_device(2)?;
    let rate = |steps: u32, start: Instant| f64::from(steps) * count as f64 / start.elapsed().as_secs_f64();
    let mut steps = 8;
    let resident = loop {
        let start = Instant::now();
        env.repeat_on_device(steps)?;
        if start.elapsed().as_secs_f64() > 0.5 {
            break rate(steps, start);
        }
        steps *= 2;
    };
    let start = Instant::now();
    let copies = (steps / 4).max(4);
    for _ in 0..copies {
        env.step(&actions, buffers.step())?;
    }
    Ok([resident, rate(copies, start)])
}
