//! The table of a recorded flight: its columns, and their reader and writer.

use std::io::{Read, Write};

/// Columns of a recorded flight, in the order of written files. Rows have a constant time step.
///
/// | columns | | unit, frame |
/// | --- | --- | --- |
/// | `t` | time | s |
/// | `px`, `py`, `pz` | position of the centre of mass | m, world |
/// | `qw`, `qx`, `qy`, `qz` | attitude | body to world |
/// | `vx`, `vy`, `vz` | velocity of the centre of mass | m/s, world |
/// | `gx`, `gy`, `gz` | body rate (gyro) | rad/s, body |
/// | `ax`, `ay`, `az` | specific force (accelerometer), 9.81 along z at rest | m/s², body |
/// | `m1` … `m4` | duty of the motors: front right, back right, back left, front left | 0 to 1 |
/// | `vbat` | battery voltage under load | V |
///
/// The first eleven columns are required. The gyro, the accelerometer, the motors and the voltage are optional groups.
pub const COLUMNS: [&str; 22] = [
    "t", "px", "py", "pz", "qw", "qx", "qy", "qz", "vx", "vy", "vz", "gx", "gy", "gz", "ax", "ay", "az", "m1", "m2",
    "m3", "m4", "vbat",
];

/// Index of the first column of each group in [`COLUMNS`], and the number of its columns.
pub(super) const POSITION: (usize, usize) = (1, 3);
pub(super) const ATTITUDE: (usize, usize) = (4, 4);
pub(super) const VELOCITY: (usize, usize) = (8, 3);
pub(super) const BODY_RATE: (usize, usize) = (11, 3);
pub(super) const ACCELERATION: (usize, usize) = (14, 3);
pub(super) const MOTORS: (usize, usize) = (17, 4);
pub(super) const VOLTAGE: (usize, usize) = (21, 1);

/// Number of columns that every flight has: time and motion capture.
const REQUIRED: usize = 11;

/// An error in a table: its line (from 1, or 0 for the whole file) and a description.
pub(super) type TableError = (usize, String);

/// Numbers of a recorded flight by column, without any check beyond finite numbers. [`COLUMNS`] lists the columns.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct FlightTable {
    /// Number of rows.
    pub(super) rows: usize,
    /// Line of every row in the file; empty for a table without a file.
    pub(super) lines: Vec<usize>,
    columns: [Option<Vec<f64>>; COLUMNS.len()],
}

impl FlightTable {
    /// Returns the number of rows.
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// Returns the numbers of a column, or `None` if the table does not have it.
    pub fn column(&self, name: &str) -> Option<&[f64]> {
        let index = COLUMNS.iter().position(|column| *column == name)?;
        self.columns[index].as_deref()
    }

    /// Returns the names of the columns that the table does not have.
    pub fn missing(&self) -> Vec<&'static str> {
        let missing = COLUMNS.iter().zip(&self.columns).filter(|(_, column)| column.is_none());
        missing.map(|(name, _)| *name).collect()
    }

    /// Sets the numbers of a column by its index in [`COLUMNS`]. All columns must have equal lengths.
    pub(super) fn set(&mut self, index: usize, numbers: Vec<f64>) {
        self.rows = numbers.len();
        self.columns[index] = Some(numbers);
    }

    /// Returns the line of a row in the file, or its number from 1 if the table has no file.
    pub(super) fn line(&self, row: usize) -> usize {
        self.lines.get(row).copied().unwrap_or(row + 1)
    }

    /// Returns the columns of a group, or `None` if the table does not have the group.
    pub(super) fn group<const N: usize>(&self, (first, count): (usize, usize)) -> Option<[&[f64]; N]> {
        debug_assert_eq!(count, N);
        let mut group = [&[][..]; N];
        for (place, column) in group.iter_mut().zip(&self.columns[first..first + N]) {
            *place = column.as_deref()?;
        }
        Some(group)
    }

    /// Reads a table from CSV. Columns may have any order, and unknown columns are ignored.
    pub(super) fn read(source: impl Read) -> Result<Self, TableError> {
        let mut reader = csv::ReaderBuilder::new().has_headers(false).flexible(true).from_reader(source);
        let mut record = csv::ByteRecord::new();
        let mut table = Self::default();
        let Some(line) = next(&mut reader, &mut record)? else {
            return Err((1, format!("the file is empty, expected the columns {}", COLUMNS[..REQUIRED].join(","))));
        };
        let header = Header::of(&record).map_err(|message| (line, message))?;
        let mut numbers: Vec<Vec<f64>> = vec![Vec::new(); COLUMNS.len()];
        while let Some(line) = next(&mut reader, &mut record)? {
            header.row(&record, &mut numbers).map_err(|message| (line, message))?;
            table.lines.push(line);
        }
        table.rows = table.lines.len();
        for (index, numbers) in numbers.into_iter().enumerate() {
            table.columns[index] = header.has[index].then_some(numbers);
        }
        Ok(table)
    }

    /// Writes the table as CSV, with the columns that it has. Numbers read back to the same bits.
    ///
    /// # Errors
    /// Returns the errors of the writer.
    pub fn write(&self, target: impl Write) -> std::io::Result<()> {
        let mut target = std::io::BufWriter::new(target);
        let columns: Vec<_> =
            COLUMNS.iter().zip(&self.columns).filter_map(|(name, c)| Some((name, c.as_ref()?))).collect();
        let names: Vec<_> = columns.iter().map(|(name, _)| **name).collect();
        writeln!(target, "{}", names.join(","))?;
        let mut buffer = zmij::Buffer::new();
        for row in 0..self.rows {
            for (index, (_, numbers)) in columns.iter().enumerate() {
                if index > 0 {
                    target.write_all(b",")?;
                }
                // negative zero becomes zero
                let text = buffer.format_finite(numbers[row] + 0.0);
                target.write_all(text.strip_suffix(".0").unwrap_or(text).as_bytes())?;
            }
            target.write_all(b"\n")?;
        }
        target.flush()
    }
}

/// Reads the next record and returns its line; `None` at the end of the file.
fn next<R: Read>(reader: &mut csv::Reader<R>, record: &mut csv::ByteRecord) -> Result<Option<usize>, TableError> {
    let at = |position: Option<&csv::Position>| position.map_or(0, |position| position.line() as usize);
    match reader.read_byte_record(record) {
        Ok(true) => Ok(Some(at(record.position()))),
        Ok(false) => Ok(None),
        Err(error) => Err((at(error.position()), error.to_string())),
    }
}

/// Returns a cell as messages print it: on one line, at most 40 characters.
pub(super) fn shown(cell: &str) -> String {
    cell.trim().chars().map(|c| if c.is_control() { '?' } else { c }).take(40).collect()
}

/// Positions of the columns in a file.
struct Header {
    /// Index in [`COLUMNS`] of every cell of a row; `None` for unknown columns.
    cells: Vec<Option<usize>>,
    /// True for each of [`COLUMNS`] that the file has.
    has: [bool; COLUMNS.len()],
}

impl Header {
    fn of(record: &csv::ByteRecord) -> Result<Self, String> {
        let (mut cells, mut unknown, mut has) = (Vec::new(), Vec::new(), [false; COLUMNS.len()]);
        for cell in record {
            let name = String::from_utf8_lossy(cell);
            let name = crate::without_byte_order_mark(&name).trim();
            let column = COLUMNS.iter().position(|column| *column == name);
            if column.is_some_and(|column| std::mem::replace(&mut has[column], true)) {
                return Err(format!("two columns `{name}`, expected one"));
            }
            if column.is_none() {
                unknown.push(shown(name));
            }
            cells.push(column);
        }
        let quoted = |names: &[&str]| names.iter().map(|name| format!("`{name}`")).collect::<Vec<_>>().join(", ");
        let missing = |range: std::ops::Range<usize>| -> Vec<&str> {
            range.filter(|&index| !has[index]).map(|index| COLUMNS[index]).collect()
        };
        let required = missing(0..REQUIRED);
        if let Some(name) = required.first() {
            let unknown: Vec<_> = unknown.iter().map(String::as_str).collect();
            let near = crate::did_you_mean(name, &unknown).replace("did you mean", "is it");
            let separator =
                [';', '\t'].into_iter().find(|separator| unknown.iter().any(|name| name.contains(*separator)));
            if let Some(separator) = separator {
                return Err(format!("cells are separated by {separator:?}, expected commas"));
            }
            return Err(match required.len() {
                1..=5 => format!("no column {}, expected time and motion capture{near}", quoted(&required)),
                _ => format!("no columns {} …, expected {} …", quoted(&required[..3]), COLUMNS[..REQUIRED].join(",")),
            });
        }
        for (first, count) in [BODY_RATE, ACCELERATION, MOTORS] {
            let missing = missing(first..first + count);
            if !missing.is_empty() && missing.len() < count {
                let all = COLUMNS[first..first + count].join(",");
                return Err(format!("no column {}, expected all of {all} or none", quoted(&missing)));
            }
        }
        Ok(Self { cells, has })
    }

    /// Appends the numbers of a row to their columns.
    fn row(&self, record: &csv::ByteRecord, numbers: &mut [Vec<f64>]) -> Result<(), String> {
        if record.len() != self.cells.len() {
            let (found, expected) = (crate::count(record.len(), "cell"), self.cells.len());
            let first = self.cells.get(record.len()).map(|cell| cell.map_or("an unknown column", |c| COLUMNS[c]));
            let first = first.map(|name| format!("; the first missing one is {name}")).unwrap_or_default();
            return Err(format!("{found}, expected {expected}{first}"));
        }
        for (cell, column) in record.iter().zip(&self.cells) {
            let &Some(column) = column else { continue };
            let text = std::str::from_utf8(cell).map(str::trim);
            let number = text.ok().and_then(|text| text.parse().ok()).filter(|x: &f64| x.is_finite());
            let Some(number) = number else {
                let text = String::from_utf8_lossy(cell);
                let text = shown(&text);
                return Err(format!("{} is `{text}`, expected a finite number", COLUMNS[column]));
            };
            numbers[column].push(number);
        }
        Ok(())
    }
}
