//! Reader of CSV files with logged variables of a Crazyflie, as programs with `cflib` and the client write them.
//!
//! A file has a column with the time and a column per variable, for example `timestamp,stateEstimate.x,pm.vbat`. The
//! times of the firmware are in milliseconds. A cell is empty where the log block of its variable has no sample.

use super::raw_log::{CrazyflieLog, Stream};
use super::table::{TableError, shown};

/// Names of the time column, in lower case.
const TIMES: [&str; 6] = ["timestamp", "time", "t", "timestamp_ms", "time_ms", "tick"];

/// Smallest median of the time between samples in milliseconds. Smaller ones are in seconds.
const MIN_MILLISECONDS: f64 = 0.5;

/// Largest step back in time between two rows, s.
const MAX_DISORDER: f64 = 0.1;

/// Reads a log. Errors have the line.
pub(super) fn read(bytes: &[u8]) -> Result<CrazyflieLog, TableError> {
    let mut reader = csv::ReaderBuilder::new().flexible(true).from_reader(bytes);
    let at = |error: csv::Error| {
        let line = error.position().map_or(0, |position| position.line() as usize);
        (line, shown(&error.to_string()))
    };
    let header = reader.headers().map_err(at)?.clone();
    let names: Vec<_> = header.iter().map(|name| crate::without_byte_order_mark(name).trim().to_string()).collect();
    let time = names.iter().position(|name| TIMES.contains(&&*name.to_lowercase()));
    let Some(time) = time.filter(|_| names.iter().any(|name| name.contains('.'))) else {
        if let Some(separator) =
            [';', '\t'].into_iter().find(|separator| names.iter().any(|name| name.contains(*separator)))
        {
            return Err((1, format!("cells are separated by {separator:?}, expected commas")));
        }
        let expected = "expected a uSD log (first byte 0xBC) or CSV with variables such as gyro.x";
        return Err((1, format!("no column timestamp, {expected}")));
    };
    if let Some((_, name)) = names.iter().enumerate().find(|(index, name)| names[..*index].contains(name)) {
        return Err((1, format!("two columns `{}`, expected one", shown(name))));
    }
    let (mut columns, mut lines): (Vec<Vec<f64>>, _) = (vec![Vec::new(); names.len()], Vec::new());
    for record in reader.records() {
        let record = record.map_err(at)?;
        let line = record.position().map_or(0, |position| position.line() as usize);
        if record.len() != names.len() {
            let found = crate::count(record.len(), "cell");
            return Err((line, format!("{found}, expected {}", names.len())));
        }
        lines.push(line);
        for (index, cell) in record.iter().map(str::trim).enumerate() {
            let number = match cell {
                "" if index != time => f64::NAN,
                _ => match cell.parse::<f64>() {
                    Ok(number) if number.is_finite() => number,
                    // pandas writes missing samples as nan
                    Ok(number) if number.is_nan() && index != time => number,
                    // a column of text, such as the name of the log block, is no variable
                    Err(_) if index != time && !names[index].contains('.') => f64::NAN,
                    _ => {
                        let (name, cell) = (shown(&names[index]), shown(cell));
                        return Err((line, format!("{name} is `{cell}`, expected a finite number")));
                    }
                },
            };
            columns[index].push(number);
        }
    }
    let times = seconds(&columns[time]);
    // log blocks arrive slightly out of order
    let is_back = |pair: &[f64]| pair[1] < pair[0] - MAX_DISORDER;
    if let Some(row) = times.windows(2).position(is_back) {
        let [before, got] = [row, row + 1].map(|row| crate::number(columns[time][row]));
        let name = shown(&names[time]);
        return Err((lines[row + 1], format!("{name} is {got} after {before}, expected increasing times")));
    }
    let variables = names.into_iter().zip(columns).enumerate();
    let variables = variables.filter(|(index, _)| *index != time).map(|(_, variable)| variable).collect();
    Ok(CrazyflieLog { streams: vec![Stream { times, variables }] })
}

/// Returns times in seconds.
fn seconds(times: &[f64]) -> Vec<f64> {
    let mut steps: Vec<_> = times.windows(2).map(|pair| pair[1] - pair[0]).filter(|step| *step > 0.0).collect();
    let middle = steps.len() / 2;
    let is_milliseconds =
        !steps.is_empty() && *steps.select_nth_unstable_by(middle, f64::total_cmp).1 >= MIN_MILLISECONDS;
    times.iter().map(|time| if is_milliseconds { 1e-3 * time } else { *time }).collect()
}
