//! The exchange file of predictions: CSV with one row per flight, window and horizon.

use std::fs::File;
use std::io::{Read, Write};
use std::path::Path;

use nalgebra::Vector3;

use super::window::{HORIZONS, Predicted, Window};
use super::{Flight, FlightError, NORM_TOLERANCE};
use crate::state::{attitude_from_wxyz, wxyz};

/// Columns of the exchange file: name of the flight, start of the window (s), horizon (s), position (m, world frame),
/// attitude (body to world), velocity (m/s, world frame) and body rate (rad/s, body frame). Attitude and body rate are
/// empty if the recorded attitude was an input.
pub const PREDICTION_COLUMNS: [&str; 16] =
    ["flight", "t0", "h", "px", "py", "pz", "qw", "qx", "qy", "qz", "vx", "vy", "vz", "wx", "wy", "wz"];

/// A prediction in the exchange file.
#[derive(Debug, Clone, PartialEq)]
pub struct PredictionRow {
    /// Name of the flight.
    pub flight: String,
    /// Start of the window, s.
    pub t0: f64,
    /// Horizon, s.
    pub horizon: f64,
    /// Predicted state at t0 + horizon.
    pub predicted: Predicted,
}

/// Writes predictions as CSV: for every flight its windows and their predictions at every horizon. Numbers read back to
/// the same bits.
///
/// # Errors
/// Returns the errors of the writer.
pub fn write_predictions<'a>(
    target: impl Write,
    flights: impl IntoIterator<Item = (&'a Flight, &'a [Window], &'a [[Predicted; HORIZONS.len()]])>,
) -> std::io::Result<()> {
    let mut writer = csv::Writer::from_writer(target);
    writer.write_record(PREDICTION_COLUMNS)?;
    for (flight, windows, predictions) in flights {
        for (window, predictions) in windows.iter().zip(predictions) {
            for (horizon, predicted) in HORIZONS.iter().zip(predictions) {
                let three = |vector: Option<&Vector3<f64>>| match vector {
                    Some(vector) => [0, 1, 2].map(|axis| (vector[axis] + 0.0).to_string()),
                    None => Default::default(),
                };
                let attitude = predicted.attitude.as_ref();
                let attitude = attitude.map_or_else(Default::default, |q| wxyz(q).map(|x| (x + 0.0).to_string()));
                let cells = [flight.name.clone(), window.t0.to_string(), horizon.to_string()].into_iter();
                let cells = cells.chain(three(Some(&predicted.position))).chain(attitude);
                let cells = cells.chain(three(Some(&predicted.velocity))).chain(three(predicted.body_rate.as_ref()));
                writer.write_record(cells)?;
            }
        }
    }
    writer.flush()
}

/// Reads an exchange file. Columns may have any order, and unknown columns are ignored.
///
/// # Errors
/// [`FlightError::File`] for a file that cannot be read, [`FlightError::Read`] with the line and the column.
pub fn read_predictions(path: impl AsRef<Path>) -> Result<Vec<PredictionRow>, FlightError> {
    let path = path.as_ref();
    let file = File::open(path).map_err(|error| FlightError::file(path, error))?;
    read(file).map_err(|error| FlightError::read(path, error))
}

fn read(source: impl Read) -> Result<Vec<PredictionRow>, (usize, String)> {
    let mut reader = csv::ReaderBuilder::new().flexible(true).from_reader(source);
    let at = |error: csv::Error| {
        let line = error.position().map_or(0, |position| position.line() as usize);
        (line, super::table::shown(&error.to_string()))
    };
    let header = reader.headers().map_err(at)?.clone();
    let names: Vec<_> = header.iter().map(|name| crate::without_byte_order_mark(name).trim()).collect();
    let column = |name: &str| {
        let found = names.iter().position(|column| *column == name);
        found.ok_or_else(|| (1, format!("no column `{name}`, expected {}", PREDICTION_COLUMNS.join(","))))
    };
    let mut columns = [0; PREDICTION_COLUMNS.len()];
    for (place, name) in columns.iter_mut().zip(PREDICTION_COLUMNS) {
        *place = column(name)?;
    }
    let mut rows = Vec::new();
    for record in reader.records() {
        let record = record.map_err(at)?;
        let line = record.position().map_or(0, |position| position.line() as usize);
        let row = row(&record, &columns).map_err(|message| (line, message))?;
        rows.push(row);
    }
    Ok(rows)
}

fn row(record: &csv::StringRecord, columns: &[usize; PREDICTION_COLUMNS.len()]) -> Result<PredictionRow, String> {
    let cell = |index: usize| record.get(columns[index]).unwrap_or_default().trim();
    let number = |index: usize| {
        let read = cell(index).parse().ok().filter(|x: &f64| x.is_finite());
        let (name, text) = (PREDICTION_COLUMNS[index], super::table::shown(cell(index)));
        read.ok_or_else(|| format!("{name} is `{text}`, expected a finite number"))
    };
    let three = |index: usize| Ok::<_, String>(Vector3::new(number(index)?, number(index + 1)?, number(index + 2)?));
    let given = (6..10).chain(13..16).filter(|&index| !cell(index).is_empty()).count();
    let (attitude, body_rate) = match given {
        0 => (None, None),
        7 => {
            let q = [number(6)?, number(7)?, number(8)?, number(9)?];
            let norm = q.iter().map(|x| x * x).sum::<f64>().sqrt();
            if (norm - 1.0).abs() > NORM_TOLERANCE {
                return Err(format!("the norm of qw, qx, qy, qz is {norm:.4}, expected 1"));
            }
            (Some(attitude_from_wxyz(q)), Some(three(13)?))
        }
        _ => return Err("some of qw to qz and wx to wz are empty, expected all or none of them".into()),
    };
    let predicted = Predicted { position: three(3)?, velocity: three(10)?, attitude, body_rate };
    Ok(PredictionRow { flight: cell(0).into(), t0: number(1)?, horizon: number(2)?, predicted })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flights::log::tests::tumbling;

    fn text() -> (Flight, Vec<Window>, Vec<[Predicted; 4]>, String) {
        let flight = tumbling(500, 0.01);
        let windows = Window::of(&flight).unwrap();
        let mut predictions: Vec<_> =
            windows.iter().map(|w| HORIZONS.map(|h| Predicted::naive(&flight.state(w.row), h))).collect();
        predictions[1] = predictions[1].map(Predicted::without_attitude);
        let mut bytes = Vec::new();
        write_predictions(&mut bytes, [(&flight, &windows[..], &predictions[..])]).unwrap();
        (flight, windows, predictions, String::from_utf8(bytes).unwrap())
    }

    #[test]
    fn predictions_read_back_to_the_same_bits() {
        let (flight, windows, predictions, text) = text();
        assert!(text.starts_with("flight,t0,h,px,py,pz,qw,qx,qy,qz,vx,vy,vz,wx,wy,wz\ntumbling,3,0.1,"), "{text}");
        assert!(text.contains(",,,,") && text.lines().count() == 1 + 4 * windows.len());
        let rows = read(text.as_bytes()).unwrap();
        let expected = windows.iter().zip(&predictions).flat_map(|(window, predictions)| {
            HORIZONS.iter().zip(predictions).map(|(&horizon, &predicted)| PredictionRow {
                flight: flight.name.clone(),
                t0: window.t0,
                horizon,
                predicted,
            })
        });
        assert_eq!(rows, expected.collect::<Vec<_>>());
    }

    #[test]
    fn invalid_predictions_are_errors_with_line_and_column() {
        let (.., text) = text();
        let error = |text: &str| {
            let (line, message) = read(text.as_bytes()).unwrap_err();
            format!("line {line}: {message}")
        };
        assert!(error(&text.replacen(",px,", ",x,", 1)).starts_with("line 1: no column `px`, expected flight,t0,h,"));
        assert_eq!(error(&text.replacen(",0.25,", ",soon,", 1)), "line 3: h is `soon`, expected a finite number");
        let second = text.lines().nth(1).unwrap();
        let cells: Vec<_> = second.split(',').collect();
        let with = |index: usize, cell: &str| {
            let mut cells = cells.clone();
            cells[index] = cell;
            text.replacen(second, &cells.join(","), 1)
        };
        assert!(error(&with(6, "")).starts_with("line 2: some of qw to qz and wx to wz are empty"));
        assert!(error(&with(6, "3")).starts_with("line 2: the norm of qw, qx, qy, qz is 3."));
        assert!(error(&with(11, "inf")).starts_with("line 2: vy is `inf`"));
        assert!(error(&text.replacen(second, "tumbling,3,0.1", 1)).starts_with("line 2: px is ``"));
    }
}
