//! Steps per second of the engines and of batches, with their ratio to bare MuJoCo steps in the same run.

mod conditions;
#[cfg(feature = "gpu")]
mod gpu;
mod meter;
mod policy;
mod processes;
mod rows;

use std::fmt::Write as _;

use anyhow::anyhow;
use aviary::engine::EngineKind;
use aviary::engine::flight::{LANES, Width};
use aviary::env::EnvError;
use aviary::physics::Physics;
use clap::Args;
use serde_json::{Value, json};

use self::meter::Meter;
use self::rows::{Actions, batch, cameras, kernel_rows, resting, single, swarm};
use crate::failure::Failure;
use crate::output;

/// Measure steps per second of engines, environments and batches
///
/// Each measurement alternates with bare mj_step calls of MuJoCo. The ratio to them is
/// comparable between machines and runs; absolute rates are not.
///
/// Batches of hover climb slowly under noise that all motors share, and restart at the end of an
/// episode. A linear policy with noise flies single environments, swarms and the rows of
/// conditions. The time to compute actions does not count. In the rows of random actions, most
/// episodes end on the floor after a few steps.
///
/// The rows of conditions and action types alternate with each other: 4,096 environments of hover
/// on one thread, with their ratio to flight without wind, effects and randomization. A row of
/// processes is the sum of single-thread batches that run at the same time in processes of their
/// own.
///
/// The rows of `--device gpu` are batches on a GPU: hover and multi_hover by the number of
/// environments, without and with copies to the host.
#[derive(Debug, Args)]
#[command(verbatim_doc_comment)]
#[command(after_help = "Examples:
  aviary bench
  aviary bench --quick --json
  aviary bench --device gpu --quick")]
pub struct Bench {
    /// Fewer and shorter measurements, within 30 s
    #[arg(long)]
    quick: bool,
    /// Seed of the noise of the actions
    #[arg(long, value_name = "N", default_value_t = 0, allow_negative_numbers = true)]
    seed: u64,
    /// Widest instruction set: portable, avx2, avx512; default the machine's
    #[arg(long, value_name = "SET", value_parser = instructions)]
    instructions: Option<Width>,
    /// Device of the batches: cpu, gpu
    #[arg(
        long,
        value_name = "DEVICE",
        default_value = "cpu",
        value_parser = ["cpu", "gpu"],
        hide_possible_values = true
    )]
    device: String,
    /// GPU of the batches: a number or a part of a name [default: 0]
    #[arg(long, value_name = "GPU")]
    adapter: Option<String>,
    /// Only the rows whose name contains this text
    #[arg(long, value_name = "TEXT")]
    only: Option<String>,
    /// JSON output instead of a table
    #[arg(long)]
    json: bool,
    /// Measure one batch of this size until the standard input ends, for a row of processes
    #[arg(long, value_name = "M", hide = true)]
    process: Option<usize>,
}

/// Parses an instruction set that this machine has.
pub(crate) fn instructions(text: &str) -> Result<Width, String> {
    let width: Width = text.parse().map_err(|error: aviary::UnknownName| error.to_string())?;
    if width.is_available() { Ok(width) } else { Err(format!("this machine lacks {width}")) }
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
    /// Range of the ratio over the rounds, relative to its median.
    spread: f64,
    /// Ratio to the row `conditions/plain`, and its spread.
    ratio_to_plain: Option<[f64; 2]>,
    /// Share of the physics steps that MuJoCo computed.
    mujoco_share: Option<f64>,
    /// Ratio to bare `mj_step` calls with the same contacts, for the row of resting drones.
    ratio_in_contact: Option<f64>,
    bytes_per_environment: usize,
    /// Growth of the process for one environment, bytes; large batches only.
    resident_bytes: Option<usize>,
    frames_per_second: Option<f64>,
}

impl Bench {
    pub fn run(&self) -> Result<(), Failure> {
        if let Some(size) = self.process {
            return processes::serve(size, self.width());
        }
        if self.device == "gpu" {
            return self.on_a_gpu();
        }
        if self.adapter.is_some() {
            return Err(Failure::input(anyhow!("--adapter is set for batches on the cpu, expected --device gpu")));
        }
        let mut meter = Meter::new(self)?;
        let rows = self.rows(&mut meter).map_err(Failure::work)?;
        let mj_step = meter.bare_rate();
        if self.json {
            let list: Vec<Value> = rows.iter().map(Row::json).collect();
            return output::print_json(&json!({
                "machine": machine(),
                "instructions": self.width().name(),
                "threads": cores(),
                "mj_step_per_second": mj_step,
                "rows": list,
            }));
        }
        let mut text = title(self.width());
        let _ = writeln!(text, "bare mj_step: {mj_step:.0} per second ({:.2} µs)\n", 1e6 / mj_step);
        let _ = writeln!(
            text,
            "{:<44}{:>8}{:>8}{:>14}{:>15}{:>10}{:>8}{:>10}",
            "measurement", "drones", "threads", "env steps/s", "physics/s", "ratio", "spread", "bytes/env"
        );
        for row in &rows {
            row.print(&mut text);
        }
        text += "\nratio: physics steps of all drones per bare mj_step, median of alternating measurements\n\
                 spread: largest minus smallest ratio of the rounds, relative to the median\n";
        output::print(&text)
    }

    #[cfg(feature = "gpu")]
    fn on_a_gpu(&self) -> Result<(), Failure> {
        gpu::run(self)
    }

    #[cfg(not(feature = "gpu"))]
    #[allow(clippy::unused_self)] // the form of the other function
    fn on_a_gpu(&self) -> Result<(), Failure> {
        Err(Failure::input(anyhow!(
            "--device is gpu, but this program has no GPU back end: build it with --features gpu"
        )))
    }

    /// Returns the instruction set of the batches.
    fn width(&self) -> Width {
        self.instructions.unwrap_or_else(Width::best)
    }

    fn rows(&self, meter: &mut Meter) -> Result<Vec<Row>, EnvError> {
        let mut rows = Vec::new();
        if self.wants("kernel") {
            kernel_rows(meter, &mut rows);
        }
        for (physics, drones) in
            [(Physics::Mjc, 1), (Physics::MjcGndDragDw, 1), (Physics::Mjc, 4), (Physics::MjcGndDragDw, 4)]
        {
            for engine in EngineKind::WITH_CONTACTS {
                if self.wants("alone") && (drones == 1 || !self.quick) {
                    rows.push(single(meter, engine, physics, drones)?);
                }
            }
        }
        let threads: &[usize] = if cores() > 1 { &[1, 0] } else { &[1] };
        if self.wants("hover ×") {
            self.hover_rows(meter, threads, &mut rows)?;
        }
        if self.wants("conditions/") || self.wants("actions/") {
            // the rows of action types take as long as half of the conditions
            let wanted = |name: &str| match &self.only {
                Some(text) => name.contains(text.as_str()),
                None => !self.quick || name.starts_with("conditions/"),
            };
            rows.extend(conditions::rows(meter, wanted)?);
        }
        if cores() > 1 && self.wants("processes") {
            let sizes: &[usize] = if self.quick { &[4096] } else { &[64, 256, 1024, 4096] };
            for &size in sizes {
                rows.push(processes::row(meter, size, cores())?);
            }
        }
        if self.wants("multi_hover ×") {
            if self.quick {
                rows.push(swarm(meter, 12, 64, 1)?);
            } else {
                for &threads in threads {
                    rows.push(swarm(meter, 4, 1024, threads)?);
                }
                rows.push(swarm(meter, 12, 256, 1)?);
            }
        }
        for &threads in threads {
            // without OpenGL there is no row of cameras
            if self.wants("RGB")
                && let Ok(row) = cameras(meter, threads)
            {
                rows.push(row);
            }
        }
        if let Some(text) = &self.only {
            rows.retain(|row| row.name.contains(text.as_str()));
        }
        Ok(rows)
    }

    /// Measures batches of hover by their size and number of threads.
    fn hover_rows(&self, meter: &mut Meter, threads: &[usize], rows: &mut Vec<Row>) -> Result<(), EnvError> {
        let sizes: &[usize] = if self.quick { &[4096] } else { &[1, 64, 256, 1024, 4096, 65_536] };
        let hybrid = EngineKind::Hybrid;
        for &size in sizes {
            for &threads in threads {
                if threads == 0 && size < 2 * LANES {
                    continue;
                }
                rows.push(batch(meter, size, threads, Physics::Mjc, hybrid, Actions::Climb)?);
                if !self.quick || threads == 1 {
                    rows.push(batch(meter, size, threads, Physics::MjcGndDragDw, hybrid, Actions::Climb)?);
                }
            }
        }
        rows.push(batch(meter, 4096, 1, Physics::Mjc, hybrid, Actions::Random)?);
        rows.push(batch(meter, 64, 1, Physics::Mjc, EngineKind::Mujoco, Actions::Climb)?);
        rows.push(resting(meter)?);
        Ok(())
    }

    /// Returns true if rows of a group may be selected. `group` is a part of the names of all its rows.
    fn wants(&self, group: &str) -> bool {
        self.only.as_ref().is_none_or(|text| text.contains(group) || group.contains(text.as_str()))
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
            "spread": self.spread,
            "bytes_per_environment": self.bytes_per_environment,
        });
        if let Some([ratio, spread]) = self.ratio_to_plain {
            value["ratio_to_plain"] = json!(ratio);
            value["spread_of_ratio_to_plain"] = json!(spread);
        }
        if let Some(share) = self.mujoco_share {
            value["mujoco_share"] = json!(share);
        }
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
            "{:<44}{:>8}{:>8}{:>14}{:>15.0}{:>10.2}{:>8.2}{:>10}",
            self.name, self.drones, self.threads, steps, self.physics_steps_per_second, self.ratio, self.spread, bytes
        );
        if let Some([ratio, _]) = self.ratio_to_plain {
            let _ = write!(text, "  ({ratio:.3} of plain");
            let share = self.mujoco_share.unwrap_or(0.0);
            text.push_str(if share > 0.0 { ", " } else { ")" });
            if share > 0.0 {
                let _ = write!(text, "{:.3} % of the steps in MuJoCo)", 100.0 * share);
            }
        }
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
fn title(width: Width) -> String {
    format!("{}, {}, instruction set {}\n", machine(), aviary::count(cores(), "thread"), width.name())
}

fn cores() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

fn machine() -> String {
    let info = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let model = info.lines().find_map(|line| line.strip_prefix("model name")).and_then(|line| line.split(": ").nth(1));
    model.unwrap_or(std::env::consts::ARCH).to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_names_the_processor_and_the_instruction_set() {
        let title = title(Width::best());
        assert!(
            title.starts_with(&machine()) && title.ends_with(&format!("set {}\n", Width::best().name())),
            "{title}"
        );
    }
}
