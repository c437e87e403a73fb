use std::path::PathBuf;

use aviary::flights::CrazyflieLog;
use clap::{Args, ValueHint};
use serde_json::json;

use crate::failure::Failure;
use crate::output::{self, OutputFile};

/// Convert a log of a Crazyflie to the table of a recorded flight
///
/// LOG is a binary log of the micro-SD card deck (versions 1 and 2) or a CSV file with logged
/// variables, as programs with cflib and the client write them. The table has the columns whose
/// variables the log has, in SI units and with a constant time step; the output names the
/// others.
#[derive(Debug, Args)]
#[command(verbatim_doc_comment)]
#[command(after_help = "Examples:
  aviary convert log00 --out flight.csv
  aviary convert cflib_log.csv --out flight.csv --rate 200")]
pub struct Convert {
    /// Log: a uSD file, or a CSV file with a column `timestamp`
    #[arg(value_name = "LOG", value_hint = ValueHint::FilePath)]
    log: PathBuf,
    /// Output file (CSV)
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    out: PathBuf,
    /// Rows per second
    #[arg(long, value_name = "HZ", default_value_t = 100.0)]
    rate: f64,
    /// JSON output instead of a table
    #[arg(long)]
    json: bool,
}

impl Convert {
    pub fn run(&self) -> Result<(), Failure> {
        if !(1.0..=10_000.0).contains(&self.rate) {
            let rate = aviary::number(self.rate);
            return Err(Failure::Input(anyhow::anyhow!("--rate is {rate}, expected 1 to 10000 Hz")));
        }
        let log = CrazyflieLog::read(&self.log).map_err(Failure::input)?;
        let table = log.table(&self.log.to_string_lossy(), 1.0 / self.rate).map_err(Failure::input)?;
        let mut writer = OutputFile::begin_apart(&self.out, [&self.log])?.into_writer();
        table.write(&mut writer).map_err(Failure::work)?;
        writer.keep()?;
        let (variables, missing) = (log.variables().count(), table.missing());
        let seconds = (table.rows() - 1) as f64 / self.rate;
        if self.json {
            return output::print_json(&json!({
                "variables": variables,
                "rows": table.rows(),
                "seconds": seconds,
                "missing_columns": missing,
                "files": [self.out.to_string_lossy()],
            }));
        }
        let missing = if missing.is_empty() { "none".to_string() } else { missing.join(", ") };
        output::print(&output::table(&[
            ("variables", variables.to_string()),
            ("rows", table.rows().to_string()),
            ("time", format!("{seconds:.2} s")),
            ("missing columns", missing),
        ]))?;
        output::print_written(std::slice::from_ref(&self.out))
    }
}
