//! The table of a flight: the columns of all files of states, and their reader.
//!
//! A table is CSV with one row per time and drone. Every table has the [`STATE_COLUMNS`], with these names, units and
//! frames. The table of a flight that can be replayed also has the other [`COLUMNS`]:
//!
//! | columns | | unit, frame |
//! | --- | --- | --- |
//! | `t` | simulated time | s |
//! | `drone` | index of the drone | |
//! | `x`, `y`, `z` | position | m, world |
//! | `qw`, `qx`, `qy`, `qz` | attitude | body to world |
//! | `vx`, `vy`, `vz` | velocity | m/s, world |
//! | `wx`, `wy`, `wz` | angular velocity | rad/s, body |
//! | `roll`, `pitch`, `yaw` | attitude as intrinsic z-y'-x'' angles | rad |
//! | `rpm0` … `rpm3` | motor speeds commanded during the last control step | rpm |
//! | `ax`, `ay`, `az` | mean acceleration since the previous row | m/s², world |
//! | `reward` | reward of the drone for the last control step | |
//! | `x_ref`, `y_ref`, `z_ref`, `yaw_ref` | reference; empty without a reference | m, rad, world |
//!
//! Readers find columns by name and ignore unknown columns. A table may therefore have additional columns, in any
//! order.

use nalgebra::Vector3;

use crate::state::{DroneState, attitude_from_wxyz, wxyz};

/// Columns of every table of states, in this order. [`COLUMNS`] lists their units and frames.
pub const STATE_COLUMNS: [&str; 15] =
    ["t", "drone", "x", "y", "z", "qw", "qx", "qy", "qz", "vx", "vy", "vz", "wx", "wy", "wz"];

/// Columns of a recorded flight, in the order of the files: time (s), index of the drone, position (m, world
/// frame), quaternion (body to world), velocity (m/s, world frame), angular velocity (rad/s, body frame), roll,
/// pitch and yaw (rad), motor speeds commanded during the last control step (rpm), mean acceleration since the
/// previous row (m/s², world frame), reward, reference position (m, world frame) and reference yaw (rad).
pub const COLUMNS: [&str; 30] = [
    "t", "drone", "x", "y", "z", "qw", "qx", "qy", "qz", "vx", "vy", "vz", "wx", "wy", "wz", "roll", "pitch", "yaw",
    "rpm0", "rpm1", "rpm2", "rpm3", "ax", "ay", "az", "reward", "x_ref", "y_ref", "z_ref", "yaw_ref",
];

/// Number of columns up to the motor speeds, which the table of a replay has.
pub(super) const FLOWN_COLUMNS: usize = 22;

/// Column names of logs of earlier versions, with their current names.
const EARLIER_NAMES: [(&str, &str); 24] = [
    ("t_s", "t"),
    ("x_m", "x"),
    ("y_m", "y"),
    ("z_m", "z"),
    ("vx_m_s", "vx"),
    ("vy_m_s", "vy"),
    ("vz_m_s", "vz"),
    ("wx_rad_s", "wx"),
    ("wy_rad_s", "wy"),
    ("wz_rad_s", "wz"),
    ("roll_rad", "roll"),
    ("pitch_rad", "pitch"),
    ("yaw_rad", "yaw"),
    ("motor0_rpm", "rpm0"),
    ("motor1_rpm", "rpm1"),
    ("motor2_rpm", "rpm2"),
    ("motor3_rpm", "rpm3"),
    ("ax_m_s2", "ax"),
    ("ay_m_s2", "ay"),
    ("az_m_s2", "az"),
    ("x_ref_m", "x_ref"),
    ("y_ref_m", "y_ref"),
    ("z_ref_m", "z_ref"),
    ("yaw_ref_rad", "yaw_ref"),
];

/// Index of the first column of each group in [`COLUMNS`].
const POSITION: usize = 2;
const ATTITUDE: usize = 5;
const VELOCITY: usize = 9;
const ANGULAR_VELOCITY: usize = 12;
const MOTOR_SPEEDS: usize = 18;
const ACCELERATION: usize = 22;
const REWARD: usize = 25;
const REFERENCE: usize = 26;

/// Returns a number as tables contain it: negative zero becomes zero.
pub(super) fn written(x: f64) -> f64 {
    x + 0.0
}

/// Returns the numbers of a state in the order of the [`STATE_COLUMNS`] after `t` and `drone`. Negative zero
/// becomes zero.
///
/// ```
/// use aviary::record::{STATE_COLUMNS, state_numbers};
/// use aviary::state::DroneState;
///
/// let numbers = state_numbers(&DroneState::default());
/// assert_eq!((STATE_COLUMNS[5], numbers[3]), ("qw", 1.0));
/// ```
pub fn state_numbers(state: &DroneState) -> [f64; 13] {
    let (p, v, w) = (&state.position, &state.velocity, &state.angular_velocity);
    let [qw, qx, qy, qz] = wxyz(&state.attitude);
    [p.x, p.y, p.z, qw, qx, qy, qz, v.x, v.y, v.z, w.x, w.y, w.z].map(written)
}

/// A row of a table. Optional fields are `None` if the table does not have their columns.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Row {
    /// Line in the file, from 1.
    pub line: usize,
    pub time: f64,
    pub drone: Option<usize>,
    pub state: DroneState,
    pub motor_speeds: Option<[f64; 4]>,
    pub acceleration: Option<Vector3<f64>>,
    pub reward: Option<f64>,
    pub reference: Option<([f64; 3], f64)>,
}

/// An error in a table: its line (from 1, or 0 for the whole file) and a description.
pub(super) type TableError = (usize, String);

/// Returns the text of a table without a byte-order mark and without unfinished rows of a killed program. A log
/// that was not closed ends in empty lines. An unfinished row follows such an empty line or has no line end. The
/// second value is the content from the first empty line; it is empty if no line is empty.
fn finished(bytes: &[u8]) -> Result<(&str, &[u8]), TableError> {
    let (mut whole, mut rest) = (0, &bytes[bytes.len()..]);
    for end in (0..bytes.len()).filter(|&at| bytes[at] == b'\n') {
        let blank = bytes[whole..end].iter().all(u8::is_ascii_whitespace);
        if blank && whole > 0 {
            rest = &bytes[whole..];
            break;
        }
        whole = end + 1;
    }
    let text = std::str::from_utf8(&bytes[..whole]).map_err(|error| {
        let line = bytes[..error.valid_up_to()].iter().filter(|&&byte| byte == b'\n').count() + 1;
        (line, "a byte that is not UTF-8 text".to_string())
    })?;
    Ok((crate::without_byte_order_mark(text), rest))
}

/// Returns true if a line is the header of a table of states, of any version.
pub(super) fn is_header(line: &str) -> bool {
    line.split(',').any(|cell| ["t", "t_s"].contains(&cell.trim()))
}

/// Reads a table.
pub(super) fn read(bytes: &[u8]) -> Result<Vec<Row>, TableError> {
    let (text, rest) = finished(bytes)?;
    let mut lines = text.lines().enumerate().map(|(index, line)| (index + 1, line));
    let Some((line, header)) = lines.next() else {
        return Err((1, "the file is empty, expected a line with the names of the columns".into()));
    };
    let columns = Columns::of(header).map_err(|message| (line, message))?;
    let rows = lines.map(|(line, row)| columns.row(line, row).map_err(|message| (line, message)));
    let rows = rows.collect::<Result<Vec<_>, _>>()?;
    if let Some(index) = columns.row_in(&String::from_utf8_lossy(rest), rows.last()) {
        let line = text.lines().count() + index + 1;
        return Err((line, "a row after an empty line, expected no empty lines between rows".into()));
    }
    Ok(rows)
}

/// Positions of the columns in a table.
struct Columns {
    /// Index in [`COLUMNS`] of every cell of a row; `None` for unknown columns.
    cells: Vec<Option<usize>>,
    /// True for each of [`COLUMNS`] that the table has.
    has: [bool; COLUMNS.len()],
}

impl Columns {
    fn of(header: &str) -> Result<Self, String> {
        let (mut cells, mut has) = (Vec::new(), [false; COLUMNS.len()]);
        for cell in header.split(',').map(str::trim) {
            let earlier = EARLIER_NAMES.iter().find(|(earlier, _)| *earlier == cell);
            let name = earlier.map_or(cell, |(_, name)| name);
            let column = COLUMNS.iter().position(|column| *column == name);
            if column.is_some_and(|column| std::mem::replace(&mut has[column], true)) {
                return Err(format!("two columns `{name}`, expected one"));
            }
            cells.push(column);
        }
        // the file of a single drone needs no column with its index
        let needed = STATE_COLUMNS.iter().enumerate().filter(|&(_, name)| *name != "drone");
        let missing: Vec<_> = needed.filter(|&(column, _)| !has[column]).map(|(_, name)| *name).collect();
        if !missing.is_empty() {
            return Err(format!(
                "no column {}, expected a table with the columns {}",
                missing.iter().map(|name| format!("`{name}`")).collect::<Vec<_>>().join(", "),
                STATE_COLUMNS.join(",")
            ));
        }
        Ok(Self { cells, has })
    }

    /// Returns the index of a line after the first empty line that shows more than one unfinished row.
    fn row_in(&self, rest: &str, last: Option<&Row>) -> Option<usize> {
        // the first byte of a row is written last: without it, a time has no digit before the point or is an
        // earlier time
        let unfinished = |line: &str| {
            let cell = line.split(',').next().unwrap_or_default().trim();
            let earlier = |time: f64| last.is_some_and(|row| time < row.time);
            self.cells.first() == Some(&Some(0)) && (cell.starts_with(['.', 'e']) || cell.parse().is_ok_and(earlier))
        };
        // an unfinished row may be split into several lines
        let mut commas = 0;
        rest.lines().position(|line| {
            let here = line.matches(',').count();
            commas += here;
            commas >= self.cells.len() || (here + 1 == self.cells.len() && !unfinished(line))
        })
    }

    fn row(&self, line: usize, text: &str) -> Result<Row, String> {
        let mut cells = [""; COLUMNS.len()];
        let mut count = 0;
        for cell in text.split(',') {
            if let Some(&Some(column)) = self.cells.get(count) {
                cells[column] = cell.trim();
            }
            count += 1;
        }
        if count != self.cells.len() {
            return Err(format!("{}, expected {}", crate::count(count, "cell"), self.cells.len()));
        }
        let number = |column: usize| {
            let cell = cells[column];
            // tasks may return any reward and reference
            let read = cell.parse().ok().filter(|x: &f64| x.is_finite() || column >= REWARD);
            read.ok_or_else(|| format!("{} is `{cell}`, expected a finite number", COLUMNS[column]))
        };
        let vector = |column: usize| Ok::<_, String>([number(column)?, number(column + 1)?, number(column + 2)?]);
        let four = |column: usize| {
            let [a, b, c] = vector(column)?;
            Ok::<_, String>([a, b, c, number(column + 3)?])
        };
        // a group with a missing column counts as missing
        let has = |column: usize, width: usize| self.has[column..column + width].iter().all(|&has| has);
        let index = || cells[1].parse().map_err(|_| format!("drone is `{}`, expected its index", cells[1]));
        let drone = self.has[1].then(index).transpose()?;
        let reference = if has(REFERENCE, 4) {
            match cells[REFERENCE..].iter().filter(|cell| cell.is_empty()).count() {
                4 => None,
                0 => Some((vector(REFERENCE)?, number(REFERENCE + 3)?)),
                _ => return Err("the reference is incomplete, expected all four columns or none".into()),
            }
        } else {
            None
        };
        Ok(Row {
            line,
            time: number(0)?,
            drone,
            state: DroneState {
                position: vector(POSITION)?.into(),
                attitude: attitude_from_wxyz(four(ATTITUDE)?),
                velocity: vector(VELOCITY)?.into(),
                angular_velocity: vector(ANGULAR_VELOCITY)?.into(),
            },
            motor_speeds: has(MOTOR_SPEEDS, 4).then(|| four(MOTOR_SPEEDS)).transpose()?,
            acceleration: has(ACCELERATION, 3).then(|| vector(ACCELERATION)).transpose()?.map(Vector3::from),
            reward: has(REWARD, 1).then(|| number(REWARD)).transpose()?,
            reference,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_start_with_the_state_and_groups_have_their_indices() {
        assert_eq!(COLUMNS[..STATE_COLUMNS.len()], STATE_COLUMNS);
        for (index, name) in [
            (POSITION, "x"),
            (ATTITUDE, "qw"),
            (VELOCITY, "vx"),
            (ANGULAR_VELOCITY, "wx"),
            (MOTOR_SPEEDS, "rpm0"),
            (ACCELERATION, "ax"),
            (REWARD, "reward"),
            (REFERENCE, "x_ref"),
        ] {
            assert_eq!(COLUMNS[index], name);
        }
        assert_eq!(COLUMNS[FLOWN_COLUMNS - 1], "rpm3");
        assert!(EARLIER_NAMES.iter().all(|(_, name)| COLUMNS.contains(name)));
    }

    const HEADER: &str = "t,drone,x,y,z,qw,qx,qy,qz,vx,vy,vz,wx,wy,wz";

    #[test]
    fn columns_are_found_by_name_in_any_order_and_others_are_ignored() {
        let rows = read(
            b"\xef\xbb\xbfnote,wz,wy,wx,vz,vy,vx,qz,qy,qx,qw,z,y,x,t,rpm3,rpm2,rpm1,rpm0\r\n\
                     a,0.3,0.2,0.1,6,5,4,0,0,0,1,3,2,1,0.5,40,30,20,10\r\n",
        )
        .unwrap();
        let row = &rows[0];
        assert_eq!((row.line, row.time, row.drone), (2, 0.5, None));
        assert_eq!(state_numbers(&row.state), [1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0, 4.0, 5.0, 6.0, 0.1, 0.2, 0.3]);
        assert_eq!(row.motor_speeds, Some([10.0, 20.0, 30.0, 40.0]));
        assert_eq!((row.reward, row.acceleration, row.reference), (None, None, None));
    }

    #[test]
    fn errors_name_the_line_and_the_column() {
        let row = "0,1,0,0,1,1,0,0,0,0,0,0,0,0,0";
        let message = |header: &str, row: &str| {
            let (line, message) = read(format!("{header}\n{row}\n").as_bytes()).unwrap_err();
            format!("line {line}: {message}")
        };
        assert!(read(format!("{HEADER}\n{row}\n").as_bytes()).is_ok());
        assert!(message(HEADER, &format!("{row},1")).starts_with("line 2: 16 cells, expected 15"));
        assert!(message(HEADER, &row.replacen('1', "one", 1)).starts_with("line 2: drone is `one`"));
        assert!(message(HEADER, &row.replace("1,1,0", "1,nan,0")).starts_with("line 2: qw is `nan`"));
        assert!(message(&HEADER.replace("qz", "pz"), row).starts_with("line 1: no column `qz`, expected"));
        assert!(message(&HEADER.replace("qz", "qy"), row).starts_with("line 1: two columns `qy`"));
        assert_eq!(read(b"").unwrap_err().0, 1);
        assert!(is_header(HEADER) && is_header("t_s,x_m,qw") && !is_header("drone0_rpm0,drone0_rpm1"));
    }

    /// A killed program leaves empty lines and possibly an unfinished row.
    #[test]
    fn unfinished_rows_are_skipped() {
        let row = "0,1,0,0,1,1,0,0,0,0,0,0,0,0,0";
        for rest in ["\n\n\n", "\n0,1,2\n\n", "0,1,2", "\r\n\r\n"] {
            let text = format!("{HEADER}\n{row}\n{rest}");
            assert_eq!(read(text.as_bytes()).unwrap().len(), 1, "{rest:?}");
        }
        // a row without its first byte, at t = 0 and at t = 10
        for (time, rest) in [("0", ".5"), ("10", "0.5")] {
            let row = |time: &str| row.replacen('0', time, 1);
            let text = format!("{HEADER}\n{}\n\n{}\n\n\n", row(time), row(rest));
            assert_eq!(read(text.as_bytes()).unwrap().len(), 1, "{rest}");
        }
    }

    #[test]
    fn a_complete_row_after_an_empty_line_is_an_error_with_its_line() {
        let row = |time: &str| format!("{time},1,0,0,1,1,0,0,0,0,0,0,0,0,0");
        let refused_at = |rest: &str| {
            let (line, message) = read(format!("{HEADER}\n{}\n{rest}", row("1.0")).as_bytes()).unwrap_err();
            assert!(message.starts_with("a row after an empty line, expected"), "{message}");
            line
        };
        assert_eq!(refused_at(&format!("\n{}\n", row("1.5"))), 4);
        assert_eq!(refused_at(&format!("\n\r\n{}\n{}\n", row("1.5"), row("2.0"))), 5);
        // // a row of another drone at the same time, without a line end
        assert_eq!(refused_at(&format!("\n{}", row("1.0"))), 4);
        // two unfinished rows
        assert_eq!(refused_at("\n0,1,2,3,4,5,6,7,8\n0,1,2,3,4,5,6,7,8\n"), 5);
    }
}
