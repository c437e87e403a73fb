//! Readers of the motor speeds of recorded flights.

use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};

use super::flight::{rows, wrong};
use super::{RecordError, ReplayError, table};

/// Reads motor speeds (rpm) from CSV with the columns `drone0_rpm0,…,drone0_rpm3,drone1_rpm0,…` and one row per
/// control step.
///
/// # Errors
/// [`ReplayError::Actions`] with the line of an invalid header, row or number.
pub fn read_actions(source: impl Read, num_drones: usize) -> Result<Vec<Vec<[f64; 4]>>, ReplayError> {
    let wrong = |line: usize, message: String| ReplayError::Actions { line, message };
    let columns: Vec<_> =
        (0..num_drones).flat_map(|drone| (0..4).map(move |motor| format!("drone{drone}_rpm{motor}"))).collect();
    let mut rows = Vec::new();
    let mut blank = None;
    let mut has_header = false;
    // numbers need no quotes, so that every line is a row
    for (index, text) in BufReader::new(source).lines().enumerate() {
        let line = index + 1;
        let text = text.map_err(|error| wrong(line, error.to_string()))?;
        let text = text.trim_start_matches('\u{feff}').trim();
        if text.is_empty() {
            blank = blank.or(Some(line));
            continue;
        }
        if let Some(line) = blank {
            return Err(wrong(line, "an empty line, expected a row of motor speeds".into()));
        }
        let cells: Vec<_> = text.split(',').map(str::trim).collect();
        if !has_header {
            has_header = true;
            if cells.len() != columns.len() {
                let (got, expected) = (cells.len(), columns.len());
                return Err(wrong(
                    line,
                    format!(
                        "{}, expected {expected} for {}",
                        crate::count(got, "column"),
                        crate::count(num_drones, "drone")
                    ),
                ));
            }
            if let Some((found, expected)) = cells.iter().zip(&columns).find(|(found, expected)| found != expected) {
                return Err(wrong(line, format!("column `{found}`, expected `{expected}`")));
            }
            continue;
        }
        if cells.len() != columns.len() {
            return Err(wrong(line, format!("{}, expected {}", crate::count(cells.len(), "number"), columns.len())));
        }
        let mut row = vec![[0.0; 4]; num_drones];
        for (index, text) in cells.into_iter().enumerate() {
            let Some(rpm) = text.parse::<f64>().ok().filter(|rpm| rpm.is_finite()) else {
                return Err(wrong(line, format!("{} is `{text}`, expected a finite speed in rpm", columns[index])));
            };
            row[index / 4][index % 4] = rpm;
        }
        rows.push(row);
    }
    if has_header { Ok(rows) } else { Err(wrong(1, format!("the file is empty, expected {}", columns.join(",")))) }
}

/// Reads the motor speeds (rpm) of a flight at a control rate (Hz), one row per control step. `paths` is one of:
///
/// - A file of motor speeds in the format of [`read_actions`].
/// - The log of a flight: a directory with `drone0.csv`, `drone1.csv`, …, these files, or one table with the rows
///   of all drones ([`COLUMNS`](super::COLUMNS) of this version or an earlier one). A row contains the command of
///   the previous control step. A row at t = 0 is the start of the flight and contains no command.
///
/// # Errors
/// [`RecordError::Read`] with the file and the line: for a file in another format, for a time that is not the time
/// of the next control step, and for a drone with missing rows.
pub fn read_motor_speeds(
    paths: &[PathBuf],
    num_drones: usize,
    ctrl_freq: u32,
) -> Result<Vec<Vec<[f64; 4]>>, RecordError> {
    let whole = |path: &Path, message: String| wrong(path, 0, message);
    let files: Vec<PathBuf> = match paths {
        [directory] if directory.is_dir() => {
            let there = super::files(directory);
            if there.len() != num_drones {
                let (found, expected) = (crate::count(there.len(), "drone"), crate::count(num_drones, "drone"));
                return Err(whole(
                    directory,
                    format!("the log has {found} (drone0.csv, drone1.csv, …), expected {expected}"),
                ));
            }
            there
        }
        [file] => {
            let bytes = std::fs::read(file).map_err(|error| whole(file, error.to_string()))?;
            let header = bytes.split(|&byte| byte == b'\n').next().unwrap_or_default();
            let header = String::from_utf8_lossy(header);
            if !table::is_header(crate::without_byte_order_mark(&header)) {
                return read_actions(&bytes[..], num_drones).map_err(|error| match error {
                    ReplayError::Actions { line, message } => wrong(file, line, message),
                    other => whole(file, other.to_string()),
                });
            }
            vec![file.clone()]
        }
        files => files.to_vec(),
    };
    let mut speeds: Vec<Vec<[f64; 4]>> = vec![Vec::new(); num_drones];
    for (index, file) in files.iter().enumerate() {
        for row in rows(file)? {
            let wrong = |message: String| wrong(file, row.line, message);
            // logs of a single drone of earlier versions have no drone index
            let drone = row.drone.unwrap_or(index);
            let Some(list) = speeds.get_mut(drone) else {
                let drones = crate::count(num_drones, "drone");
                return Err(wrong(format!("drone is {drone}, expected an index of {drones}")));
            };
            let step = row.time * f64::from(ctrl_freq);
            if list.is_empty() && step.abs() < NEAR {
                continue;
            }
            let expected = list.len() + 1;
            if (step - expected as f64).abs() >= NEAR {
                let (time, seconds) = (row.time, expected as f64 / f64::from(ctrl_freq));
                return Err(wrong(format!(
                    "t is {}, expected {seconds} (step {expected} at {ctrl_freq} Hz)",
                    crate::number(time)
                )));
            }
            let rpm =
                row.motor_speeds.ok_or_else(|| wrong("no columns `rpm0` to `rpm3`, expected motor speeds".into()))?;
            list.push(rpm);
        }
    }
    // a killed program may have written the last row for some of the drones only
    let steps = speeds.iter().map(Vec::len).min().unwrap_or(0);
    if let Some(drone) = speeds.iter().position(|list| list.len() > steps + 1) {
        let file = files.first().map_or(Path::new(""), PathBuf::as_path);
        let found = crate::count(speeds[drone].len(), "row");
        return Err(whole(
            file,
            format!("{found} of drone {drone} and {steps} of another drone, expected equal numbers"),
        ));
    }
    Ok((0..steps).map(|step| speeds.iter().map(|list| list[step]).collect()).collect())
}

/// Tolerance of a time, fraction of a control step.
const NEAR: f64 = 0.01;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::record::scenario::tests::SCENARIO;
    use proptest::prelude::*;

    #[test]
    fn invalid_actions_are_errors_with_their_line() {
        let read = |text: &str, drones| read_actions(text.as_bytes(), drones).map_err(|error| error.to_string());
        let header = "drone0_rpm0,drone0_rpm1,drone0_rpm2,drone0_rpm3\n";
        assert_eq!(
            read(&format!("{header}1,2,3,4\n5,6,7,8.5\n"), 1).unwrap(),
            [[[1.0, 2.0, 3.0, 4.0]], [[5.0, 6.0, 7.0, 8.5]]]
        );
        let short = read(&format!("{header}1,2,3,4\n1,2,3\n"), 1).unwrap_err();
        assert!(short.starts_with("line 3: 3 numbers"), "{short}");
        let word = read(&format!("{header}1,two,3,4\n"), 1).unwrap_err();
        assert!(word.starts_with("line 2: drone0_rpm1 is `two`"), "{word}");
        for bad in ["nan", "inf", "-inf", "1e999", ""] {
            assert!(
                read(&format!("{header}1,2,3,{bad}\n"), 1).unwrap_err().starts_with("line 2: drone0_rpm3"),
                "{bad}"
            );
        }
        assert_eq!(read(&format!("\u{feff}{header}1,2,3,4\n\n\n").replace('\n', "\r\n"), 1).unwrap().len(), 1);
        let later = read(&format!("{header}1,2,3,4\n5,6,7,x\n").replace('\n', "\r\n"), 1).unwrap_err();
        assert!(later.starts_with("line 3:"), "{later}");
        let gap = read(&format!("{header}1,2,3,4\n\n5,6,7,8\n"), 1).unwrap_err();
        assert!(gap.starts_with("line 3: an empty line"), "{gap}");
        assert!(read(header, 2).unwrap_err().contains("4 columns, expected 8"));
        assert!(read("a,b,c,d\n", 1).unwrap_err().contains("`a`"));
        assert!(read("", 1).unwrap_err().contains("line 1"));
    }

    proptest! {
        #[test]
        fn damaged_files_are_errors_or_valid(
            bytes in prop::collection::vec(any::<u8>(), 0..300), cut in 0usize..200, letter in any::<u8>(),
        ) {
            let _ = read_actions(&bytes[..], 1);
            if let Ok(text) = std::str::from_utf8(&bytes) {
                let _ = super::super::Scenario::from_toml(text);
            }
            let mut damaged = SCENARIO.as_bytes().to_vec();
            let place = cut % damaged.len();
            damaged[place] = letter;
            if let Ok(text) = std::str::from_utf8(&damaged)
                && let Ok(scenario) = super::super::Scenario::from_toml(text)
            {
                prop_assert!(scenario.initial_xyzs.len() <= 1);
            }
        }
    }
}
