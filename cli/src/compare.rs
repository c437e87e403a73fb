use std::path::{Path, PathBuf};

use anyhow::anyhow;
use aviary::drone::DroneModel;
use aviary::flights::{
    AttitudeSource, Compared, Errors, Flight, HORIZONS, Predictor, Score, flight_files, plot_window, read_flights,
    write_predictions,
};
use clap::{Args, ValueHint};
use serde_json::{Map, Value, json};

use crate::failure::Failure;
use crate::options;
use crate::output::{self, OutputDir, OutputFile};
use crate::parse::{self, NameOrFile};
use crate::threads;

/// Files of `--plot`.
const PLOTS: [&str; 2] = ["window.svg", "window.png"];

/// Compare open-loop predictions with recorded flights
///
/// Windows start at t0 = 3.0, 3.5, 4.0, … s in every flight. From the rows up to t0 and the
/// motor commands and battery voltage after t0, the airframe predicts the states 0.1, 0.25, 0.5
/// and 1.0 s after t0. The table has the mean errors and their ratios to constant velocity and
/// constant body rate.
#[derive(Debug, Args)]
#[command(verbatim_doc_comment)]
#[command(after_help = "Examples:
  aviary compare --flights flights --drone cf21
  aviary compare --flights flights --drone cf21 --attitude recorded --json
  aviary compare --flights flights/star.csv --drone cf21.toml --predictions out/star.csv --plot")]
pub struct Compare {
    /// Recorded flights: CSV files, or directories with CSV files
    #[arg(long, value_name = "PATH", value_hint = ValueHint::AnyPath, num_args = 1.., required = true)]
    flights: Vec<PathBuf>,
    /// Airframe: built-in or a TOML file, with [motors] speed_per_volt
    #[arg(
        long,
        value_name = "AIRFRAME",
        value_hint = ValueHint::FilePath,
        value_parser = parse::airframe(),
        hide_possible_values = true
    )]
    drone: NameOrFile<DroneModel>,
    /// Attitude: recorded (predicts position and velocity) or predicted
    ///
    /// Without this option, the output has both.
    #[arg(
        long,
        verbatim_doc_comment,
        value_name = "SOURCE",
        value_parser = parse::named::<AttitudeSource>(),
        hide_possible_values = true
    )]
    attitude: Option<AttitudeSource>,
    /// File of all predictions (CSV)
    ///
    /// The columns are flight,t0,h,px,py,pz,qw,qx,qy,qz,vx,vy,vz,wx,wy,wz. With recorded
    /// attitude, the columns of the attitude and of the body rate are empty.
    #[arg(long, verbatim_doc_comment, value_name = "FILE", value_hint = ValueHint::FilePath)]
    predictions: Option<PathBuf>,
    /// Plot of the window with the median position error after 0.5 s
    ///
    /// The files are window.svg and window.png in the directory of --out, or in out/compare
    /// without --out.
    #[arg(long, verbatim_doc_comment)]
    plot: bool,
    /// Directory of the plot
    #[arg(long, value_name = "DIR", value_hint = ValueHint::DirPath, requires = "plot")]
    out: Option<PathBuf>,
    /// JSON output instead of a table
    #[arg(long)]
    json: bool,
}

impl Compare {
    pub fn run(&self) -> Result<(), Failure> {
        let params = options::params(&self.drone)?;
        let sources = self.attitude.map_or(AttitudeSource::ALL.to_vec(), |source| vec![source]);
        threads::start()?;
        let flights = read_flights(&self.flights).map_err(Failure::input)?;
        let doubts: Vec<_> = flights.iter().map(|flight| flight.check_units().err().map(|e| e.to_string())).collect();
        let inputs = flight_files(&self.flights).map_err(Failure::input)?;
        let predictions = self.predictions.as_deref();
        let predictions = predictions.map(|path| OutputFile::begin_apart(path, &inputs)).transpose()?;
        let out = self.plot.then(|| OutputDir::create(self.out.as_deref().unwrap_or(Path::new("out/compare"))));
        let out = out.transpose()?;
        let compared = aviary::flights::compare(&params, &flights, &sources).map_err(Failure::input)?;

        for doubt in doubts.iter().flatten() {
            tracing::warn!("{doubt}");
        }
        let mut written = Vec::new();
        if let (Some(file), Some(path)) = (predictions, &self.predictions) {
            let mut writer = file.into_writer();
            // the last source: the predicted attitude, unless the option selects one
            let rows = flights.iter().zip(&compared).filter_map(|(flight, compared)| {
                Some((flight, &compared.windows[..], &compared.tracks.last()?.predictions[..]))
            });
            write_predictions(&mut writer, rows).map_err(Failure::work)?;
            writer.keep()?;
            written.push(path.clone());
        }
        if let Some(out) = &out {
            out.remove(&PLOTS)?;
            let (flight, compared, window) = typical(&flights, &compared)
                .ok_or_else(|| Failure::Work(anyhow!("every window is near a glitch, expected one to plot")))?;
            let source = compared.tracks[compared.tracks.len() - 1].attitude;
            let predictor = Predictor::new(&params, flight, &compared.windows).map_err(Failure::input)?;
            let states = predictor.trace(window, source).map_err(Failure::input)?;
            let window = &compared.windows[window];
            let title = format!("{} from {} s, {source} attitude, {}", flight.name, window.t0, params.name);
            let plot = plot_window(&title, flight, window, &states).map_err(Failure::work)?;
            let (svg, png) = (plot.svg().map_err(Failure::work)?, plot.png().map_err(Failure::work)?);
            for (name, bytes) in PLOTS.into_iter().zip([svg.as_bytes(), &png]) {
                out.write(name, bytes)?;
                written.push(out.path().join(name));
            }
        }
        if self.json {
            let flights: Vec<_> = flights
                .iter()
                .zip(&compared)
                .zip(&doubts)
                .map(|((flight, compared), doubt)| {
                    json!({
                        "name": flight.name,
                        "warning": doubt,
                        "missing_columns": flight.missing(),
                        "tracks": tracks(&sources, std::slice::from_ref(compared)),
                    })
                })
                .collect();
            return output::print_json(&json!({
                "drone_model": params.name,
                "tracks": tracks(&sources, &compared),
                "flights": flights,
                "files": written.iter().map(|path| path.to_string_lossy()).collect::<Vec<_>>(),
            }));
        }
        let mut text = String::new();
        for (index, source) in sources.iter().enumerate() {
            text += &total_table(*source, &totals(&compared, index));
            text += &flight_table(&flights, &compared, index);
        }
        for flight in flights.iter().filter(|flight| !flight.missing().is_empty()) {
            text += &format!("{} has no columns {}\n", flight.name, flight.missing().join(", "));
        }
        output::print(&text)?;
        output::print_written(&written)
    }
}

/// Returns the scores of all flights at every horizon.
pub fn totals(compared: &[Compared], track: usize) -> [Score; HORIZONS.len()] {
    let mut totals = [Score::EMPTY; HORIZONS.len()];
    for compared in compared {
        for (total, score) in totals.iter_mut().zip(&compared.tracks[track].scores) {
            total.add(score);
        }
    }
    totals
}

/// Returns the flight and the window whose position error after 0.5 s is the median of all windows.
pub fn typical<'a>(flights: &'a [Flight], compared: &'a [Compared]) -> Option<(&'a Flight, &'a Compared, usize)> {
    const HORIZON: usize = 2;
    let mut errors = Vec::new();
    for (flight, compared) in flights.iter().zip(compared) {
        let predictions = &compared.tracks.last()?.predictions;
        for (index, window) in compared.windows.iter().enumerate().filter(|(_, window)| window.is_valid[HORIZON]) {
            let error = predictions[index][HORIZON].errors(&flight.state(window.ends[HORIZON])).position;
            errors.push((error, flight, compared, index));
        }
    }
    errors.sort_by(|a, b| a.0.total_cmp(&b.0));
    let (_, flight, compared, index) = *errors.get(errors.len() / 2)?;
    Some((flight, compared, index))
}

/// Returns the scores of the tracks as JSON.
pub fn tracks(sources: &[AttitudeSource], compared: &[Compared]) -> Value {
    let errors = |errors: &Errors| {
        json!({
            "position": errors.position,
            "velocity": errors.velocity,
            "attitude_deg": errors.attitude.map(f64::to_degrees),
            "body_rate": errors.body_rate,
        })
    };
    let mut tracks = Map::new();
    for (index, source) in sources.iter().enumerate() {
        let rows: Vec<_> = HORIZONS
            .iter()
            .zip(totals(compared, index))
            .map(|(horizon, score)| {
                let mut row = errors(&score.errors());
                row["horizon"] = json!(horizon);
                row["windows"] = json!(score.windows);
                row["naive"] = errors(&score.naive());
                let ratio = score.ratio();
                // a ratio of angles has no unit
                row["ratio"] = json!({
                    "position": ratio.position,
                    "velocity": ratio.velocity,
                    "attitude": ratio.attitude,
                    "attitude_deg": ratio.attitude,
                    "body_rate": ratio.body_rate,
                });
                row
            })
            .collect();
        tracks.insert(source.name().into(), rows.into());
    }
    tracks.into()
}

/// Returns the table of the errors of all flights, with their ratios to the naive prediction.
pub fn total_table(source: AttitudeSource, scores: &[Score]) -> String {
    let mut text = format!(
        "attitude {source}\n{:>11}{:>9}{:>22}{:>23}",
        "horizon (s)", "windows", "position (mm), ratio", "velocity (mm/s), ratio"
    );
    if source == AttitudeSource::Predicted {
        text += &format!("{:>20}{:>26}", "attitude (°), ratio", "body rate (rad/s), ratio");
    }
    text += "\n";
    for (horizon, score) in HORIZONS.iter().zip(scores) {
        let (errors, ratio) = (score.errors(), score.ratio());
        let (position, velocity) = (1e3 * errors.position, 1e3 * errors.velocity);
        text += &format!(
            "{horizon:>11.2}{:>9}{position:>15.2}{:>7.3}{velocity:>16.1}{:>7.3}",
            score.windows, ratio.position, ratio.velocity
        );
        if let (Some(angle), Some(rate)) = (errors.attitude, errors.body_rate) {
            let ratios = (ratio.attitude.unwrap_or(f64::NAN), ratio.body_rate.unwrap_or(f64::NAN));
            text += &format!("{:>13.3}{:>7.3}{rate:>19.3}{:>7.3}", angle.to_degrees(), ratios.0, ratios.1);
        }
        text += "\n";
    }
    text
}

/// Returns the table of the ratios of every flight.
pub fn flight_table(flights: &[Flight], compared: &[Compared], track: usize) -> String {
    let width = flights.iter().map(|flight| flight.name.chars().count()).max().unwrap_or(0).max(6);
    let with_attitude = compared.iter().any(|compared| compared.tracks[track].attitude == AttitudeSource::Predicted);
    let horizons = HORIZONS.map(|horizon| format!("{horizon:>7}")).concat();
    let mut text = format!("{:width$}  position ratio after {horizons} s", "flight");
    if with_attitude {
        text += &format!("  attitude ratio after {horizons} s");
    }
    text += "\n";
    for (flight, compared) in flights.iter().zip(compared) {
        let ratios = compared.tracks[track].scores.map(|score| score.ratio());
        let position = ratios.map(|ratio| format!("{:>7.3}", ratio.position)).concat();
        text += &format!("{:width$}  {:>20}{position}", flight.name, "");
        if with_attitude {
            let attitude = ratios.map(|ratio| format!("{:>7.3}", ratio.attitude.unwrap_or(f64::NAN))).concat();
            text += &format!("  {:>22}{attitude}", "");
        }
        text += "\n";
    }
    text + "\n"
}
