use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::anyhow;
use aviary::drone::{DroneModel, DroneParams};
use aviary::flights::identify::{
    Alignment, Estimate, FittedParameter, Identification, IdentifyOptions, Status, Unidentified, identify,
};
use aviary::flights::{AttitudeSource, Compared, Flight, Predictor, flight_files, plot_window, read_flights};
use clap::{Args, ValueHint};
use serde_json::{Value, json};

use crate::airframe;
use crate::compare::{flight_table, total_table, totals, tracks, typical};
use crate::failure::Failure;
use crate::options;
use crate::output::{self, OutputFile};
use crate::parse::{self, NameOrFile};
use crate::threads;

/// Identify the parameters of an airframe from recorded flights
///
/// Motors, drag, inertia and trim are fitted to the flights: predictions in windows of one second
/// shall agree with the motion capture and the gyro. The mass and the dimensions are given,
/// because flights determine forces per mass only. The output has the parameters with standard
/// errors, the parameters that these flights do not determine, and the errors of predictions of
/// each flight from a fit to the others.
#[derive(Debug, Args)]
#[command(verbatim_doc_comment)]
#[command(after_help = "Examples:
  aviary identify flights --drone cf2x --mass 0.04085 --out cf21.toml
  aviary identify flights/*.csv --drone cf2x --mass 0.04085 --json
  aviary identify flights --drone cf2x --mass 0.04085 --out cf21.toml --plot window.svg")]
pub struct Identify {
    /// Recorded flights: CSV files, or directories with CSV files
    #[arg(value_name = "FLIGHTS", value_hint = ValueHint::AnyPath, num_args = 1.., required = true)]
    flights: Vec<PathBuf>,
    /// Airframe with the dimensions: cf2x, cf2p, race, cf21 or a TOML file
    #[arg(
        long,
        value_name = "AIRFRAME",
        value_hint = ValueHint::FilePath,
        value_parser = parse::airframe(),
        hide_possible_values = true
    )]
    drone: NameOrFile<DroneModel>,
    /// Mass in flight, kg
    #[arg(long, value_name = "KG")]
    mass: f64,
    /// File of the identified airframe (TOML), which has the file's name
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    out: Option<PathBuf>,
    /// Plot of measured and predicted position and attitude (.svg or .png)
    ///
    /// The window has the median position error after 0.5 s. With several flights, the
    /// prediction is that of the fit to the other flights.
    #[arg(long, verbatim_doc_comment, value_name = "FILE", value_hint = ValueHint::FilePath)]
    plot: Option<PathBuf>,
    /// JSON output instead of tables
    #[arg(long)]
    json: bool,
}

impl Identify {
    pub fn run(&self) -> Result<(), Failure> {
        let base = DroneParams { mass: self.mass, ..options::params(&self.drone)? };
        base.validate().map_err(|error| Failure::Input(anyhow!("--mass or --drone: {error}")))?;
        let name = self.name()?;
        let plot_kind = self.plot.as_deref().map(|path| path.extension().and_then(|ending| ending.to_str()));
        if plot_kind.is_some_and(|kind| !matches!(kind, Some("svg" | "png"))) {
            let path = self.plot.as_deref().unwrap_or(Path::new("")).display();
            return Err(Failure::Input(anyhow!("--plot is `{path}`, expected a file that ends in .svg or .png")));
        }
        threads::start()?;
        let flights = read_flights(&self.flights).map_err(Failure::input)?;
        let mut inputs = flight_files(&self.flights).map_err(Failure::input)?;
        if let NameOrFile::File(path) = &self.drone {
            inputs.push(path.clone());
        }
        let begin = |path: &Path| OutputFile::begin_apart(path, &inputs);
        let out = self.out.as_deref().map(begin).transpose()?;
        let plot = self.plot.as_deref().map(begin).transpose()?;

        let start = Instant::now();
        let progress = output::progress_with(100, "{msg} {wide_bar} {pos} %").with_message("identify");
        let options = IdentifyOptions { name, ..IdentifyOptions::default() };
        let identified = identify(&flights, &base, &options, &mut |part| progress.set_position((100.0 * part) as u64))
            .map_err(Failure::input)?;
        progress.finish_and_clear();
        let seconds = start.elapsed().as_secs_f64();

        let numbers = base.derived();
        for warning in numbers.iter().filter(|number| number.fields.contains("mass")).filter_map(airframe::warning) {
            tracing::warn!("{warning} (--mass in kg)");
        }

        let mut written = Vec::new();
        if let (Some(file), Some(path)) = (out, &self.out) {
            let names: Vec<_> = flights.iter().map(|flight| flight.name.clone()).collect();
            let text = identified.toml(&names);
            // flights that no airframe explains could leave a file that no command reads
            DroneParams::from_toml(&text)
                .map_err(|error| Failure::Work(anyhow!("the identified airframe is not valid: {error}")))?;
            file.write(text.as_bytes())?;
            written.push(path.clone());
        }
        if let (Some(file), Some(path), Some(Some(kind))) = (plot, &self.plot, plot_kind) {
            file.write(&plot_of(&flights, &identified, kind)?)?;
            written.push(path.clone());
        }
        if self.json {
            let files: Vec<_> = written.iter().map(|path| path.to_string_lossy()).collect();
            let mut value = as_json(&flights, &identified)?;
            value["seconds"] = json!(seconds);
            value["files"] = json!(files);
            return output::print_json(&value);
        }
        output::print(&report(&flights, &identified, seconds))?;
        output::print_written(&written)
    }

    /// Returns the name of the airframe: that of the output file, or of the base airframe with `_identified`.
    fn name(&self) -> Result<String, Failure> {
        let Some(path) = &self.out else { return Ok("identified".into()) };
        let stem = path.file_stem().unwrap_or_default().to_string_lossy();
        let is_valid = !stem.is_empty() && stem.chars().all(|c| c.is_ascii_alphanumeric() || c == '_' || c == '-');
        if is_valid && path.extension().is_some_and(|ending| ending == "toml") {
            return Ok(stem.into_owned());
        }
        let expected = "a file NAME.toml, with letters, digits, `_` and `-` in its name";
        Err(Failure::Input(anyhow!("--out is `{}`, expected {expected}", path.display())))
    }
}

/// Returns the predictions of all flights: by fits to the other flights, if there are several.
fn predictions(identified: &Identification) -> Vec<Compared> {
    if identified.leave_one_out.is_empty() {
        return identified.compared.clone();
    }
    identified.leave_one_out.iter().map(|left_out| left_out.compared.clone()).collect()
}

/// Draws measured and predicted position and attitude over a window.
fn plot_of(flights: &[Flight], identified: &Identification, kind: &str) -> Result<Vec<u8>, Failure> {
    let compared = predictions(identified);
    let (flight, of_flight, window) = typical(flights, &compared)
        .ok_or_else(|| Failure::Work(anyhow!("every window is near a glitch, expected one to plot")))?;
    let index = flights.iter().position(|other| std::ptr::eq(other, flight)).unwrap_or(0);
    let airframe = identified.leave_one_out.get(index).map_or(&identified.airframe, |left_out| &left_out.airframe);
    let predictor = Predictor::new(airframe, flight, &of_flight.windows).map_err(Failure::work)?;
    let states = predictor.trace(window, AttitudeSource::Predicted).map_err(Failure::work)?;
    let window = &of_flight.windows[window];
    let title = format!("{} from {} s, {}", flight.name, window.t0, identified.airframe.name);
    let plot = plot_window(&title, flight, window, &states).map_err(Failure::work)?;
    match kind {
        "svg" => plot.svg().map(String::into_bytes),
        _ => plot.png(),
    }
    .map_err(Failure::work)
}

/// Returns a number with five significant digits.
fn number(x: f64) -> String {
    match x.abs() {
        0.0 => "0".into(),
        size if (1e-3..1e5).contains(&size) => {
            let decimals = (4 - size.log10().floor() as i32).max(0);
            format!("{x:.0$}", decimals.unsigned_abs() as usize)
        }
        _ => format!("{x:.4e}"),
    }
}

/// Returns the result as tables.
fn report(flights: &[Flight], identified: &Identification, seconds: f64) -> String {
    let mut text = format!(
        "{} from {} of {}: {} evaluations, {seconds:.1} s\n\n",
        identified.airframe.name,
        aviary::count(identified.windows, "window"),
        aviary::count(flights.len(), "flight"),
        identified.evaluations
    );
    let width = identified.parameters.iter().map(|parameter| parameter.name.len()).max().unwrap_or(0);
    let mut line = |parameter: &FittedParameter| {
        let value = number(parameter.estimate.value);
        text += &format!("{:width$}  {value:>12}  {}\n", parameter.name, parameter.remark());
    };
    let (fitted, held): (Vec<_>, Vec<_>) =
        identified.parameters.iter().partition(|parameter| parameter.estimate.error.is_finite());
    fitted.into_iter().for_each(&mut line);
    if !held.is_empty() {
        text += "\nheld constant\n";
        let mut line = |parameter: &FittedParameter| {
            let value = number(parameter.estimate.value);
            text += &format!("{:width$}  {value:>12}  {}\n", parameter.name, parameter.remark());
        };
        held.into_iter().for_each(&mut line);
    }
    text += "\nalignment (applied: *)\n";
    for alignment in &identified.alignments {
        text += &alignment_line(alignment);
    }
    let sources = AttitudeSource::ALL;
    let compared = predictions(identified);
    text += match identified.leave_one_out.is_empty() {
        true if flights.len() == 1 => {
            "\npredictions of the fitted flight (leave-one-flight-out errors require two flights)\n\n"
        }
        true => {
            "\npredictions of the fitted flights (without one of them, the others do not determine an airframe)\n\n"
        }
        false => "\npredictions of every flight by a fit to the other flights\n\n",
    };
    for (index, source) in sources.into_iter().enumerate() {
        text += &total_table(source, &totals(&compared, index));
        text += &flight_table(flights, &compared, index);
    }
    text
}

/// Returns the alignment of a flight as text.
fn alignment_line(alignment: &Alignment) -> String {
    let shown = |estimate: &Estimate, factor: f64, decimals: usize, applied: f64| {
        let star = if applied == 0.0 { "" } else { "*" };
        match estimate.error.is_finite() {
            true => format!("{:.decimals$}±{:.decimals$}{star}", factor * estimate.value, factor * estimate.error),
            false => "unknown".into(),
        }
    };
    let applied = &alignment.applied;
    let time = |estimate: &Option<Estimate>, applied: f64| {
        estimate.as_ref().map_or("unknown".into(), |estimate| shown(estimate, 1e3, 1, applied))
    };
    let [x, y] = [0, 1].map(|axis| shown(&alignment.tilt[axis], 180.0 / std::f64::consts::PI, 2, applied.tilt[axis]));
    let offset = [0, 1, 2].map(|axis| shown(&alignment.offset[axis], 1e3, 1, applied.offset[axis])).join(", ");
    format!(
        "{}: onboard lag {} ms, motor lag {} ms, marker tilt {x}, {y}°, offset {offset} mm\n",
        alignment.flight,
        time(&alignment.onboard_shift, applied.onboard_shift),
        time(&alignment.motor_shift, applied.motor_shift),
    )
}

/// Returns the result as JSON.
fn as_json(flights: &[Flight], identified: &Identification) -> Result<Value, Failure> {
    let finite = |x: f64| if x.is_finite() { json!(x) } else { Value::Null };
    let parameters: Vec<_> = identified
        .parameters
        .iter()
        .map(|parameter| {
            let (status, reason, others) = match &parameter.status {
                Status::Identified => ("identified", None, &[][..]),
                Status::NotIdentifiable(reason) => {
                    let others = match reason {
                        Unidentified::Collinear(others) => &others[..],
                        Unidentified::NoEffect => &[],
                    };
                    ("not_identifiable", Some(reason.to_string()), others)
                }
                Status::Insignificant(_) => ("not_significant", Some(parameter.remark()), &[][..]),
                Status::AtBound => ("at_bound", Some(parameter.remark()), &[][..]),
            };
            json!({
                "name": parameter.name,
                "unit": parameter.unit,
                "value": parameter.estimate.value,
                "standard_error": finite(parameter.estimate.error),
                "status": status,
                "reason": reason,
                "collinear_with": others,
                "equal_to": parameter.like,
            })
        })
        .collect();
    let sources = AttitudeSource::ALL;
    let by_flight = |compared: &[Compared]| {
        let flights = flights.iter().zip(compared).map(|(flight, compared)| {
            json!({ "name": flight.name, "tracks": tracks(&sources, std::slice::from_ref(compared)) })
        });
        json!({ "tracks": tracks(&sources, compared), "flights": flights.collect::<Vec<_>>() })
    };
    let leave_one_out = match identified.leave_one_out.is_empty() {
        true => Value::Null,
        false => by_flight(&predictions(identified)),
    };
    Ok(json!({
        "airframe": serde_json::to_value(&identified.airframe).map_err(Failure::work)?,
        "parameters": parameters,
        "alignment": serde_json::to_value(&identified.alignments).map_err(Failure::work)?,
        "windows": identified.windows,
        "evaluations": identified.evaluations,
        "cost": identified.cost,
        "fit": by_flight(&identified.compared),
        "leave_one_out": leave_one_out,
    }))
}
