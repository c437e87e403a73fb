use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, anyhow};
use aviary::record::{CsvLog, RecordError, Scenario, read_actions};
use clap::{Args, ValueHint};

use crate::failure::Failure;
use crate::output::{self, OutputFile};

/// Fly recorded motor speeds, open loop, and write the states
///
/// The scenario is TOML, the motor speeds CSV with the columns drone0_rpm0,drone0_rpm1,… and one row per control step;
/// the result has one row per control step and drone, after the step.
#[derive(Debug, Args)]
#[command(after_help = "Example:
  aviary replay --scenario tests/reference/mjc_cf2x.toml --actions tests/reference/mjc_cf2x.actions.csv --out out/flight.csv")]
pub struct Replay {
    /// Where and how the flight begins
    #[arg(long)]
    scenario: PathBuf,
    /// Motor speeds, rpm, as CSV: drone0_rpm0, drone0_rpm1, …, one row a control step
    #[arg(long, value_hint = ValueHint::FilePath)]
    actions: PathBuf,
    /// File to write
    #[arg(long)]
    out: PathBuf,
}

impl Replay {
    pub fn run(&self) -> Result<(), Failure> {
        let text = read(&self.scenario)?;
        let scenario = Scenario::from_toml(&text).map_err(|error| in_file(&self.scenario, error))?;
        let mut simulation = scenario.simulation().map_err(|error| in_file(&self.scenario, error))?;
        let actions = fs::File::open(&self.actions)
            .with_context(|| self.actions.display().to_string())
            .map_err(Failure::Input)?;
        let actions = read_actions(actions, scenario.num_drones).map_err(|error| in_file(&self.actions, error))?;

        let file = OutputFile::begin(&self.out)?;
        let mut log = CsvLog::new(file.into_writer()).map_err(Failure::work)?;
        let bar = output::progress(actions.len() as u64, "flying");
        let unwritten = |error: RecordError| Failure::Work(anyhow!(error).context(self.out.display().to_string()));
        for (index, row) in actions.iter().enumerate() {
            // the header is the first line
            simulation
                .step(row)
                .map_err(|error| Failure::Work(anyhow!("{}: line {}: {error}", self.actions.display(), index + 2)))?;
            log.record(&simulation).map_err(unwritten)?;
            bar.inc(1);
        }
        bar.finish_and_clear();
        log.finish().map_err(unwritten)?.keep()
    }
}

fn read(path: &Path) -> Result<String, Failure> {
    fs::read_to_string(path).with_context(|| path.display().to_string()).map_err(Failure::Input)
}

fn in_file(path: &Path, error: impl std::fmt::Display) -> Failure {
    Failure::Input(anyhow!("{}: {error}", path.display()))
}
