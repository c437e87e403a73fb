//! Recorded flights in memory, with the checks of their files.

use std::fs::File;
use std::io::{Read, Write};
use std::path::{Path, PathBuf};

use nalgebra::{UnitQuaternion, Vector3};
use rayon::prelude::*;

use super::table::{
    ACCELERATION, ATTITUDE, BODY_RATE, COLUMNS, FlightTable, MOTORS, POSITION, TableError, VELOCITY, VOLTAGE,
};
use super::{FlightError, NORM_TOLERANCE};
use crate::drone::GRAVITY;
use crate::state::{DroneState, attitude_from_wxyz, wxyz};

/// Smallest number of rows of a flight.
const MIN_ROWS: usize = 10;

/// Largest deviation of a time from the constant step, as a fraction of the step.
const STEP_TOLERANCE: f64 = 0.1;

/// Smallest and largest battery voltage, V. Other values are in a wrong unit.
const VOLTAGES: std::ops::RangeInclusive<f64> = 0.5..=100.0;

/// Time on both sides of a row over which velocities and rates are compared with differences, s.
const HALF_SPAN: f64 = 0.02;

/// A recorded flight, one element per row. Rows have a constant time step.
///
/// Position and velocity are those of the centre of mass.
///
/// ```
/// use aviary::flights::Flight;
///
/// let mut text = String::from("t,px,py,pz,qw,qx,qy,qz,vx,vy,vz,vbat\n");
/// for row in 0..20 {
///     let t = 0.01 * f64::from(row);
///     text += &format!("{t},{},0,1,1,0,0,0,0.5,0,0,3.7\n", 0.5 * t);
/// }
/// let flight = Flight::from_csv("straight", text.as_bytes())?;
/// assert_eq!((flight.rows(), flight.step, flight.missing()[0]), (20, 0.01, "gx"));
/// assert_eq!(flight.row_at(0.1), Some(10));
///
/// let error = Flight::from_csv("damaged", text.replace("0.05,", "0.06,").as_bytes()).unwrap_err();
/// assert_eq!(error.to_string(), "damaged: line 7: t is 0.06, expected 0.05 (a constant step of 0.01 s)");
/// # Ok::<(), aviary::flights::FlightError>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct Flight {
    /// Name: the file name without `.csv`.
    pub name: String,
    /// Time of the first row, s.
    pub start: f64,
    /// Time between rows, s.
    pub step: f64,
    /// Position of the centre of mass, world frame, m.
    pub position: Vec<Vector3<f64>>,
    /// Rotation from the body to the world frame.
    pub attitude: Vec<UnitQuaternion<f64>>,
    /// Velocity of the centre of mass, world frame, m/s.
    pub velocity: Vec<Vector3<f64>>,
    /// Body rate (gyro), body frame, rad/s.
    pub body_rate: Option<Vec<Vector3<f64>>>,
    /// Specific force (accelerometer), body frame, m/s².
    pub acceleration: Option<Vec<Vector3<f64>>>,
    /// Duty of each motor, 0 to 1, in the order of the airframe's motors: motor 0 is `m4`, 1 is `m3`, 2 is `m2`, 3 is
    /// `m1`.
    pub duty: Option<Vec<[f64; 4]>>,
    /// Battery voltage under load, V.
    pub voltage: Option<Vec<f64>>,
}

impl Flight {
    /// Largest third difference of the position that is motion, m, for rows 10 ms apart or less.
    const MAX_THIRD_DIFFERENCE: f64 = 3e-3;

    /// Number of rows on both sides of a glitch that it affects.
    const GLITCH_ROWS: usize = 4;

    /// Reads a flight from a CSV file with the [`COLUMNS`](super::COLUMNS), in any order.
    ///
    /// # Errors
    /// [`FlightError::File`] for a file that cannot be read, and the errors of [`from_csv`](Self::from_csv).
    pub fn read(path: impl AsRef<Path>) -> Result<Self, FlightError> {
        let path = path.as_ref();
        let file = File::open(path).map_err(|error| FlightError::file(path, error))?;
        let name = path.file_stem().unwrap_or_default().to_string_lossy();
        Self::from_table(&name, file).map_err(|error| FlightError::read(path, error))
    }

    /// Reads a flight from CSV.
    ///
    /// # Errors
    /// [`FlightError::Read`] with the name of the flight as the path, the line and the column: for a missing column or
    /// two columns of the same name, a row with missing cells, a number that is not finite, times without a constant
    /// step, a quaternion without unit norm, a duty or a voltage out of range, less than 10 rows, and for columns in a
    /// wrong unit or frame: a velocity that is not the derivative of the position, a body rate that is not the rate of
    /// the attitude, a specific force that is not one in m/s².
    pub fn from_csv(name: &str, source: impl Read) -> Result<Self, FlightError> {
        Self::from_table(name, source).map_err(|error| FlightError::read(Path::new(name), error))
    }

    fn from_table(name: &str, source: impl Read) -> Result<Self, TableError> {
        let table = FlightTable::read(source)?;
        let flight = Self::of(name, &table)?;
        flight.check_units().map_err(|(row, message)| (table.line(row), message))?;
        Ok(flight)
    }

    /// Creates a flight from a table, without the comparison of velocities and rates with differences.
    fn of(name: &str, table: &FlightTable) -> Result<Self, TableError> {
        let rows = table.rows();
        if rows < MIN_ROWS {
            return Err((0, format!("{}, expected at least {MIN_ROWS}", crate::count(rows, "row"))));
        }
        let required = "the reader requires these columns";
        let times = table.column("t").expect(required);
        let step = constant_step(times).map_err(|(row, message)| (table.line(row), message))?;
        let [w, x, y, z] = table.group(ATTITUDE).expect(required);
        let attitude = (0..rows).map(|row| {
            let q = [w[row], x[row], y[row], z[row]];
            let norm = q.iter().map(|x| x * x).sum::<f64>().sqrt();
            if (norm - 1.0).abs() > NORM_TOLERANCE {
                let message = format!("the norm of qw, qx, qy, qz is {norm:.4}, expected 1");
                return Err((table.line(row), message));
            }
            Ok(attitude_from_wxyz(q.map(|x| x / norm)))
        });
        let in_range = |column: usize, range: std::ops::RangeInclusive<f64>, expected: &str| {
            let numbers = table.column(COLUMNS[column]).unwrap_or_default();
            match numbers.iter().position(|x| !range.contains(x)) {
                Some(row) => {
                    let (name, got) = (COLUMNS[column], crate::number(numbers[row]));
                    Err((table.line(row), format!("{name} is {got}, expected {expected}")))
                }
                None => Ok(()),
            }
        };
        for motor in 0..4 {
            in_range(MOTORS.0 + motor, 0.0..=1.0, "a duty from 0 to 1")?;
        }
        in_range(VOLTAGE.0, VOLTAGES, "a battery voltage from 0.5 to 100 V")?;
        let vectors = |group| {
            let [x, y, z] = table.group(group)?;
            Some((0..rows).map(|row| Vector3::new(x[row], y[row], z[row])).collect::<Vec<_>>())
        };
        Ok(Self {
            name: name.into(),
            start: times[0],
            step,
            position: vectors(POSITION).expect(required),
            attitude: attitude.collect::<Result<_, _>>()?,
            velocity: vectors(VELOCITY).expect(required),
            body_rate: vectors(BODY_RATE),
            acceleration: vectors(ACCELERATION),
            duty: table
                .group(MOTORS)
                .map(|[m1, m2, m3, m4]| (0..rows).map(|row| [m4[row], m3[row], m2[row], m1[row]]).collect()),
            voltage: table.column("vbat").map(<[f64]>::to_vec),
        })
    }

    /// Checks that velocities, rates and specific forces agree with the motion, so that columns have their units and
    /// frames. The error contains the row with the largest deviation.
    fn check_units(&self) -> Result<(), (usize, String)> {
        let half = ((HALF_SPAN / self.step).round() as usize).max(1);
        let span = 2.0 * half as f64 * self.step;
        let rows = half..self.rows().saturating_sub(half);
        let compare = |group: (usize, usize),
                       measured: &[Vector3<f64>],
                       difference: &dyn Fn(usize) -> Vector3<f64>,
                       room: f64,
                       describe: &dyn Fn(usize, f64) -> String| {
            for axis in 0..3 {
                let (mut signal, mut derived, mut error, mut worst) = (0.0, 0.0, 0.0, (0.0, 0));
                for row in rows.clone() {
                    let around = row - half..=row + half;
                    let mean = around.map(|row| measured[row][axis]).sum::<f64>() / (2 * half + 1) as f64;
                    let expected = difference(row)[axis];
                    signal += mean * mean;
                    derived += expected * expected;
                    error += (mean - expected) * (mean - expected);
                    if (mean - expected).abs() > worst.0 {
                        worst = ((mean - expected).abs(), row);
                    }
                }
                let rms = |sum: f64| (sum / rows.len().max(1) as f64).sqrt();
                if rms(error) > 0.5 * rms(signal.max(derived)) + room {
                    return Err((worst.1, describe(group.0 + axis, rms(error))));
                }
            }
            Ok(())
        };
        let position = |row: usize| (self.position[row + half] - self.position[row - half]) / span;
        compare(VELOCITY, &self.velocity, &position, 0.05, &|column, error| {
            let (name, of) = (COLUMNS[column], COLUMNS[column - VELOCITY.0 + POSITION.0]);
            format!(
                "{name} differs from the derivative of {of} by {error:.2} m/s (RMS), expected m/s in the world frame"
            )
        })?;
        if let Some(rates) = &self.body_rate {
            let attitude =
                |row: usize| (self.attitude[row - half].inverse() * self.attitude[row + half]).scaled_axis() / span;
            compare(BODY_RATE, rates, &attitude, 0.3, &|column, error| {
                let name = COLUMNS[column];
                format!(
                    "{name} differs from the rate of the attitude by {error:.2} rad/s (RMS), expected rad/s, body frame"
                )
            })?;
        }
        if let Some(forces) = &self.acceleration {
            // the mean over the flight, because of the vibration of the accelerometer
            let rows = rows.len().max(1) as f64;
            let (mut measured, mut expected) = (0.0, 0.0);
            for row in half..self.rows().saturating_sub(half) {
                let change = (self.velocity[row + half] - self.velocity[row - half]) / span;
                measured += forces[row].z / rows;
                expected += (self.attitude[row].inverse() * (change + Vector3::z() * GRAVITY)).z / rows;
            }
            if (measured - expected).abs() > 0.5 * expected.abs() + 1.0 {
                let message =
                    format!("the mean of az is {measured:.2}, expected {expected:.2} (specific force in m/s²)");
                return Err((0, message));
            }
        }
        Ok(())
    }

    /// Returns the number of rows.
    pub fn rows(&self) -> usize {
        self.position.len()
    }

    /// Returns the time of a row, s.
    pub fn time(&self, row: usize) -> f64 {
        self.start + row as f64 * self.step
    }

    /// Returns the row at a time, or `None` if no row is within a tenth of a step of it.
    pub fn row_at(&self, time: f64) -> Option<usize> {
        let row = (time - self.start) / self.step;
        let near = (row - row.round()).abs() < STEP_TOLERANCE && row.round() >= 0.0;
        Some(row.round() as usize).filter(|&row| near && row < self.rows())
    }

    /// Returns the measured state at a row. The body rate is zero if the flight has no gyro.
    ///
    /// # Panics
    /// If the flight does not have the row.
    pub fn state(&self, row: usize) -> DroneState {
        DroneState {
            position: self.position[row],
            attitude: self.attitude[row],
            velocity: self.velocity[row],
            angular_velocity: self.body_rate.as_ref().map_or_else(Vector3::zeros, |rates| rates[row]),
        }
    }

    /// Returns the names of the optional columns that the flight does not have.
    pub fn missing(&self) -> Vec<&'static str> {
        let groups = [
            (BODY_RATE, self.body_rate.is_some()),
            (ACCELERATION, self.acceleration.is_some()),
            (MOTORS, self.duty.is_some()),
            (VOLTAGE, self.voltage.is_some()),
        ];
        let missing = groups.iter().filter(|(_, has)| !has);
        missing.flat_map(|&((first, count), _)| COLUMNS[first..first + count].iter().copied()).collect()
    }

    /// Checks that the flight has all columns of these names.
    ///
    /// # Errors
    /// [`FlightError::Missing`] with the missing columns.
    pub fn require(&self, columns: &[&str], purpose: &'static str) -> Result<(), FlightError> {
        let mut missing = self.missing();
        missing.retain(|name| columns.contains(name));
        if missing.is_empty() {
            return Ok(());
        }
        Err(FlightError::Missing { flight: self.name.clone(), columns: missing, purpose })
    }

    /// Returns true for every row that is within four rows of a jump of the markers: four rows whose third difference
    /// of the position has a component above 3 mm. The limit increases with the cube of the step if rows are more than
    /// 20 ms apart, because motion itself has a third difference then.
    pub fn glitches(&self) -> Vec<bool> {
        let limit = Self::MAX_THIRD_DIFFERENCE.max(375.0 * self.step.powi(3));
        let mut glitches = vec![false; self.rows()];
        for (row, p) in self.position.windows(4).enumerate() {
            let difference = p[3] - (p[2] - p[1]) * 3.0 - p[0];
            // a comparison that is true for NaN
            if !(difference.amax() <= limit) {
                let first = row.saturating_sub(Self::GLITCH_ROWS);
                let end = (row + 4 + Self::GLITCH_ROWS).min(self.rows());
                glitches[first..end].fill(true);
            }
        }
        glitches
    }

    /// Returns the flight as a table.
    pub fn table(&self) -> FlightTable {
        let mut table = FlightTable::default();
        // times are multiples of a decimal step
        table.set(0, (0..self.rows()).map(|row| (self.time(row) * 1e9).round() / 1e9).collect());
        let mut vectors = |(first, _): (usize, usize), vectors: Option<&Vec<Vector3<f64>>>| {
            for axis in 0..3 {
                if let Some(vectors) = vectors {
                    table.set(first + axis, vectors.iter().map(|vector| vector[axis]).collect());
                }
            }
        };
        vectors(POSITION, Some(&self.position));
        vectors(VELOCITY, Some(&self.velocity));
        vectors(BODY_RATE, self.body_rate.as_ref());
        vectors(ACCELERATION, self.acceleration.as_ref());
        for part in 0..4 {
            table.set(ATTITUDE.0 + part, self.attitude.iter().map(|attitude| wxyz(attitude)[part]).collect());
            if let Some(duty) = &self.duty {
                table.set(MOTORS.0 + part, duty.iter().map(|duty| duty[3 - part]).collect());
            }
        }
        if let Some(voltage) = &self.voltage {
            table.set(VOLTAGE.0, voltage.clone());
        }
        table
    }

    /// Writes the flight as CSV with the [`COLUMNS`](super::COLUMNS) that it has.
    ///
    /// # Errors
    /// Returns the errors of the writer.
    pub fn write(&self, target: impl Write) -> std::io::Result<()> {
        self.table().write(target)
    }
}

/// Reads flights from files, and from directories all files that end in `.csv`, in the order of their names.
///
/// # Errors
/// [`FlightError::File`] for a path that cannot be read, [`FlightError::Read`] for a directory without a `.csv` file,
/// two flights of the same name, and an invalid file.
pub fn read_flights(paths: &[PathBuf]) -> Result<Vec<Flight>, FlightError> {
    let mut files = Vec::new();
    for path in paths {
        if !path.is_dir() {
            files.push(path.clone());
            continue;
        }
        let entries = std::fs::read_dir(path).and_then(Iterator::collect::<Result<Vec<_>, _>>);
        let entries = entries.map_err(|error| FlightError::file(path, error))?;
        let mut found: Vec<_> = entries.into_iter().map(|entry| entry.path()).collect();
        found.retain(|file| file.extension().is_some_and(|ending| ending == "csv") && file.is_file());
        if found.is_empty() {
            return Err(FlightError::read(path, (0, "no file that ends in .csv, expected recorded flights".into())));
        }
        found.sort();
        files.extend(found);
    }
    let flights = files.par_iter().map(Flight::read).collect::<Vec<_>>();
    // the first error in the order of the files
    let flights = flights.into_iter().collect::<Result<Vec<_>, _>>()?;
    for (index, flight) in flights.iter().enumerate() {
        if let Some(other) = flights[..index].iter().position(|other| other.name == flight.name) {
            let message = format!("it has the name of {}, expected different names", files[other].display());
            return Err(FlightError::read(&files[index], (0, message)));
        }
    }
    Ok(flights)
}

/// Returns the constant step of times, s. The error contains the row.
fn constant_step(times: &[f64]) -> Result<f64, (usize, String)> {
    let later = |pair: &[f64]| pair[1] - pair[0];
    if let Some(row) = times.windows(2).position(|pair| later(pair) <= 0.0) {
        let (got, before) = (crate::number(times[row + 1]), crate::number(times[row]));
        return Err((row + 1, format!("t is {got}, expected a time after {before} (rows in the order of time)")));
    }
    let mut steps: Vec<_> = times.windows(2).map(later).collect();
    let middle = steps.len() / 2;
    let median = *steps.select_nth_unstable_by(middle, f64::total_cmp).1;
    let short = |x: f64| crate::number((x * 1e6).round() / 1e6);
    if let Some(row) = times.windows(2).position(|pair| (later(pair) - median).abs() > STEP_TOLERANCE * median) {
        let (got, expected) = (crate::number(times[row + 1]), short(times[row] + median));
        let step = short(median);
        return Err((row + 1, format!("t is {got}, expected {expected} (a constant step of {step} s)")));
    }
    let step = (times[times.len() - 1] - times[0]) / (times.len() - 1) as f64;
    // times with few digits determine a decimal step only up to rounding
    let decimal = (step * 1e6).round() / 1e6;
    let step = if (step - decimal).abs() < 1e-9 { decimal } else { step };
    for (row, &time) in times.iter().enumerate() {
        let expected = times[0] + row as f64 * step;
        if (time - expected).abs() > STEP_TOLERANCE * step {
            let (got, expected, step) = (crate::number(time), short(expected), short(step));
            return Err((row, format!("t is {got}, expected {expected} (a constant step of {step} s)")));
        }
    }
    Ok(step)
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Returns a flight on a tumbling path in closed form: position, velocity, attitude and body rate agree.
    pub(crate) fn tumbling(rows: usize, step: f64) -> Flight {
        let axis = nalgebra::Unit::new_normalize(Vector3::new(0.3, -0.5, 0.8));
        let rate = axis.into_inner() * 2.5;
        let times: Vec<f64> = (0..rows).map(|row| row as f64 * step).collect();
        let wave = |t: f64, k: f64| Vector3::new((2.0 * t + k).sin(), (3.0 * t + k).sin(), 0.5 * (t + k).sin());
        let slope = |t: f64| Vector3::new(2.0 * (2.0 * t).cos(), 3.0 * (3.0 * t).cos(), 0.5 * t.cos());
        let change = |t: f64| Vector3::new(-4.0 * (2.0 * t).sin(), -9.0 * (3.0 * t).sin(), -0.5 * t.sin());
        let attitude: Vec<_> = times.iter().map(|&t| UnitQuaternion::from_axis_angle(&axis, 2.5 * t + 1.0)).collect();
        let force = |(t, q): (&f64, &UnitQuaternion<f64>)| q.inverse() * (change(*t) + Vector3::z() * GRAVITY);
        Flight {
            name: "tumbling".into(),
            start: 0.0,
            step,
            position: times.iter().map(|&t| wave(t, 0.0)).collect(),
            velocity: times.iter().map(|&t| slope(t)).collect(),
            body_rate: Some(vec![rate; rows]),
            acceleration: Some(times.iter().zip(&attitude).map(force).collect()),
            duty: Some(times.iter().map(|&t| [0.1, 0.2, 0.3, 0.4].map(|x| x + 0.05 * t.sin())).collect()),
            voltage: Some(times.iter().map(|&t| 4.0 - 0.01 * t).collect()),
            attitude,
        }
    }

    fn text_of(flight: &Flight) -> String {
        let mut bytes = Vec::new();
        flight.write(&mut bytes).unwrap();
        String::from_utf8(bytes).unwrap()
    }

    fn read(text: &str) -> Result<Flight, String> {
        Flight::from_csv("f", text.as_bytes()).map_err(|error| error.to_string())
    }

    /// Returns the text with a function applied to the cells of every line.
    fn with_cells(text: &str, change: impl Fn(usize, &mut Vec<String>)) -> String {
        let lines = text.lines().enumerate().map(|(index, line)| {
            let mut cells: Vec<_> = line.split(',').map(str::to_string).collect();
            change(index, &mut cells);
            cells.join(",") + "\n"
        });
        lines.collect()
    }

    #[test]
    fn written_flights_read_back_and_columns_may_have_any_order() {
        let flight = tumbling(200, 0.01);
        let text = text_of(&flight);
        assert!(text.starts_with(&(COLUMNS.join(",") + "\n0,0,0,0,")), "{text}");
        let again = read(&text).unwrap();
        assert_eq!(Flight { name: flight.name.clone(), attitude: flight.attitude.clone(), ..again.clone() }, flight);
        let turned = again.attitude.iter().zip(&flight.attitude).map(|(a, b)| a.angle_to(b)).fold(0.0, f64::max);
        assert!(turned < 1e-7, "{turned}");
        let reversed = with_cells(&text, |index, cells| {
            cells.push(if index == 0 { "unknown".into() } else { "text".into() });
            cells.reverse();
        });
        assert_eq!(read(&reversed).unwrap(), again);
        assert_eq!(read(&format!("\u{feff}{}", text.replace('\n', "\r\n"))).unwrap(), again);
    }

    #[test]
    fn motors_have_the_order_of_the_airframe() {
        let flight = read(&text_of(&tumbling(50, 0.01))).unwrap();
        let table = flight.table();
        let duty = flight.duty.unwrap()[7];
        for (motor, column) in ["m4", "m3", "m2", "m1"].into_iter().enumerate() {
            assert_eq!(table.column(column).unwrap()[7], duty[motor], "{column}");
        }
    }

    #[test]
    fn flights_without_optional_columns_name_them() {
        let text = text_of(&tumbling(50, 0.01));
        let without = |names: &[&str]| {
            let at: Vec<_> =
                names.iter().map(|name| COLUMNS.iter().position(|column| column == name).unwrap()).collect();
            with_cells(&text, |_, cells| {
                let mut index = 0;
                cells.retain(|_| (!at.contains(&index), index += 1).0);
            })
        };
        let optional = ["gx", "gy", "gz", "ax", "ay", "az", "m1", "m2", "m3", "m4", "vbat"];
        let flight = read(&without(&optional)).unwrap();
        assert_eq!(flight.missing(), optional);
        let error = flight.require(&["vbat", "m3"], "a prediction").unwrap_err().to_string();
        assert_eq!(error, "f: no columns `m3`, `vbat`, expected for a prediction");
        assert_eq!(flight.require(&[], "a prediction"), Ok(()));
        assert_eq!(
            read(&without(&["m2"])),
            Err("f: line 1: no column `m2`, expected all of m1,m2,m3,m4 or none".into())
        );
        let error = read(&without(&["px"])).unwrap_err();
        assert_eq!(error, "f: line 1: no column `px`, expected time and motion capture");
        let error = read(&text.replacen("px", "px_m", 1)).unwrap_err();
        assert_eq!(error, "f: line 1: no column `px`, expected time and motion capture; is it `px_m`?");
        assert!(read("a,b,c\n1,2,3\n").unwrap_err().starts_with("f: line 1: no columns `t`, `px`, `py` …"));
    }

    #[test]
    fn invalid_rows_are_errors_with_line_and_column() {
        let text = text_of(&tumbling(60, 0.01));
        let changed = |row: usize, column: &str, value: &str| {
            let at = COLUMNS.iter().position(|name| *name == column).unwrap();
            read(&with_cells(&text, |index, cells| {
                if index == row + 1 {
                    cells[at] = value.into();
                }
            }))
            .unwrap_err()
        };
        for bad in ["", "nan", "inf", "-inf", "1e999", "x1", "1,5"] {
            let message = changed(4, "vy", bad);
            let expected =
                if bad == "1,5" { "23 cells, expected 22".into() } else { format!("vy is `{bad}`, expected a") };
            assert!(message.starts_with(&format!("f: line 6: {expected}")), "{message}");
        }
        assert_eq!(changed(9, "m3", "1.01"), "f: line 11: m3 is 1.01, expected a duty from 0 to 1");
        assert_eq!(changed(9, "m3", "-0.5"), "f: line 11: m3 is -0.5, expected a duty from 0 to 1");
        assert_eq!(changed(0, "vbat", "3700"), "f: line 2: vbat is 3700, expected a battery voltage from 0.5 to 100 V");
        assert!(changed(3, "qw", "0.99").starts_with("f: line 5: the norm of qw, qx, qy, qz is"));
        assert_eq!(
            changed(5, "t", "0.02"),
            "f: line 7: t is 0.02, expected a time after 0.04 (rows in the order of time)"
        );
        assert_eq!(changed(5, "t", "0.053"), "f: line 7: t is 0.053, expected 0.05 (a constant step of 0.01 s)");
        let mut lines: Vec<_> = text.lines().collect();
        lines.remove(20);
        let gap = read(&lines.join("\n")).unwrap_err();
        assert_eq!(gap, "f: line 21: t is 0.2, expected 0.19 (a constant step of 0.01 s)");
        lines[30] = &lines[30][..40];
        assert!(read(&lines.join("\n")).unwrap_err().starts_with("f: line 31: "), "a row that ends early");
        let short: Vec<_> = text.lines().take(5).collect();
        assert_eq!(read(&short.join("\n")), Err("f: 4 rows, expected at least 10".into()));
        assert!(read("").unwrap_err().starts_with("f: line 1: the file is empty"));
        let twice = text.replacen("m1,m2", "m2,m2", 1);
        assert_eq!(read(&twice), Err("f: line 1: two columns `m2`, expected one".into()));
        let bytes: Vec<u8> = text.bytes().map(|byte| if byte == b'.' { 0xff } else { byte }).collect();
        assert!(Flight::from_csv("f", &bytes[..]).is_err());
    }

    #[test]
    fn columns_in_a_wrong_unit_or_under_a_wrong_name_are_errors() {
        let flight = tumbling(300, 0.01);
        let text = text_of(&flight);
        let renamed = |from: &str, to: &str| read(&text.replacen(from, to, 1)).unwrap_err();
        assert!(renamed("vx,vy", "vy,vx").contains("vx differs from the derivative of px by"));
        assert!(renamed("gx,gy", "gy,gx").contains("gx differs from the rate of the attitude by"));
        assert!(renamed("px,py", "py,px").contains("vx differs from the derivative of px by"));
        // the scalar part last, as some libraries write it
        assert!(renamed("qw,qx,qy,qz", "qx,qy,qz,qw").contains("differs from the rate of the attitude"));
        let degrees =
            flight.body_rate.as_ref().map(|rates| rates.iter().map(|rate| rate.map(f64::to_degrees)).collect());
        let error = read(&text_of(&Flight { body_rate: degrees, ..flight.clone() })).unwrap_err();
        assert!(error.contains("expected rad/s, body frame"), "{error}");
        let in_g = flight.acceleration.as_ref().map(|forces| forces.iter().map(|force| force / GRAVITY).collect());
        let error = read(&text_of(&Flight { acceleration: in_g, ..flight })).unwrap_err();
        assert!(error.contains("the mean of az is") && error.contains("expected"), "{error}");
    }

    #[test]
    fn glitches_are_jumps_of_the_position_and_four_rows_around_them() {
        let mut flight = tumbling(100, 0.01);
        assert!(!flight.glitches().contains(&true));
        flight.position[40].y += 2.9e-3;
        // a single jump is three times as large in the two third differences from rows 38 and 39
        let rows: Vec<_> = (0..100).filter(|&row| flight.glitches()[row]).collect();
        assert_eq!(rows, (34..=46).collect::<Vec<_>>());
        flight.position[40].y -= 2.0e-3;
        assert!(!flight.glitches().contains(&true));
    }

    #[test]
    fn directories_are_read_in_the_order_of_names() {
        let directory = tempfile::tempdir().unwrap();
        let write = |name: &str| std::fs::write(directory.path().join(name), text_of(&tumbling(20, 0.01))).unwrap();
        let paths = [directory.path().to_path_buf()];
        assert!(
            read_flights(&paths)
                .unwrap_err()
                .to_string()
                .ends_with("no file that ends in .csv, expected recorded flights")
        );
        ["b.csv", "a.csv", "notes.txt"].into_iter().for_each(write);
        let names: Vec<_> = read_flights(&paths).unwrap().into_iter().map(|flight| flight.name).collect();
        assert_eq!(names, ["a", "b"]);
        let twice = [paths[0].clone(), paths[0].join("a.csv")];
        assert!(read_flights(&twice).unwrap_err().to_string().contains("it has the name of"));
        assert!(matches!(read_flights(&[paths[0].join("c.csv")]), Err(FlightError::File { .. })));
    }

    proptest! {
        #[test]
        fn damaged_files_are_errors_of_one_line_or_valid_flights(
            cut in 0_usize..5000, byte in any::<u8>(), at in 0_usize..5000, noise in prop::collection::vec(any::<u8>(), 0..200),
        ) {
            let text = text_of(&tumbling(30, 0.01));
            let mut damaged = text.as_bytes().to_vec();
            let place = at % damaged.len();
            damaged[place] = byte;
            damaged.truncate(cut);
            for bytes in [&damaged, &noise] {
                match Flight::from_csv("f", &bytes[..]) {
                    Ok(flight) => prop_assert!(flight.rows() >= MIN_ROWS && flight.step > 0.0),
                    Err(error) => {
                        let error = error.to_string();
                        prop_assert!(error.lines().count() == 1 && error.chars().count() < 250, "{}", error);
                    }
                }
            }
        }

        #[test]
        fn any_decimal_step_is_found(step in 0.001_f64..0.1, rows in 10_usize..200, start in -5.0_f64..100.0) {
            let times: Vec<_> = (0..rows).map(|row| start + row as f64 * step).collect();
            let found = constant_step(&times).unwrap();
            prop_assert!((found - step).abs() < 1e-8, "{} {}", found, step);
        }
    }
}
