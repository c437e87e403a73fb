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
use crate::state::{DroneState, attitude_from_wxyz, wxyz};

/// Smallest number of rows of a flight.
const MIN_ROWS: usize = 10;

/// Largest deviation of a time from the constant step, as a fraction of the step.
const STEP_TOLERANCE: f64 = 0.1;

/// Smallest and largest battery voltage, V. Other values are in a wrong unit.
const VOLTAGES: std::ops::RangeInclusive<f64> = 0.5..=100.0;

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
/// let expected = "damaged: line 8: t is 0.06, expected a time after 0.06 (rows in the order of time)";
/// assert_eq!(error.to_string(), expected);
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

/// Largest numbers of the measured columns, and largest changes within a row and back: m, m/s, rad/s, m/s².
const MAGNITUDES: [((usize, usize), f64, f64); 4] =
    [(POSITION, 1e6, 1.0), (VELOCITY, 1e4, 5.0), (BODY_RATE, 1e3, 30.0), (ACCELERATION, 1e5, 200.0)];

/// Largest time between rows, s.
const MAX_STEP: f64 = 0.5;

/// Smallest duty that a motor of a flying drone reaches.
const MIN_DUTY: f64 = 0.01;

/// Returns an error for a number that no flight has, or that differs from both neighbours where these agree.
fn check_magnitudes(table: &FlightTable) -> Result<(), TableError> {
    for ((first, count), max, max_jump) in MAGNITUDES {
        for name in &COLUMNS[first..first + count] {
            let numbers = table.column(name).unwrap_or_default();
            if let Some(row) = numbers.iter().position(|x| x.abs() > max) {
                let got = crate::number(numbers[row]);
                return Err((table.line(row), format!("{name} is {got}, expected at most {max:e} (SI units)")));
            }
            let jumps = |[a, b, c]: [f64; 3]| {
                let (up, down) = ((b - a).abs(), (b - c).abs());
                up.min(down) > max_jump && (c - a).abs() < 0.1 * up.min(down)
            };
            if let Some(row) = numbers.windows(3).position(|three| jumps([three[0], three[1], three[2]])) {
                let [before, got, after] = [0, 1, 2].map(|index| crate::number(numbers[row + index]));
                return Err((table.line(row + 1), format!("{name} is {got} between {before} and {after}")));
            }
        }
    }
    Ok(())
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
        flight.check_start().map_err(|(row, message)| (table.line(row), message))?;
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
        if step > MAX_STEP {
            let got = crate::number(step);
            return Err((
                table.line(1),
                format!("t has a step of {got} s, expected at most {MAX_STEP} s (t in seconds)"),
            ));
        }
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
        check_magnitudes(table)?;
        for motor in 0..4 {
            in_range(MOTORS.0 + motor, 0.0..=1.0, "a duty from 0 to 1")?;
        }
        let duties = (0..4).filter_map(|motor| table.column(COLUMNS[MOTORS.0 + motor])).flatten();
        let highest = duties.fold(0.0_f64, |highest, duty| highest.max(*duty));
        if highest > 0.0 && highest < MIN_DUTY {
            let got = crate::number(highest);
            return Err((0, format!("m1 to m4 are at most {got}, expected duties from 0 to 1")));
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
            // NaN is no motion
            let is_motion = difference.iter().all(|x| x.abs() <= limit);
            if !is_motion {
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
    let files = flight_files(paths)?;
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

/// Returns the files that [`read_flights`] reads.
///
/// # Errors
/// [`FlightError::File`] for a directory that cannot be read, [`FlightError::Read`] for one without a `.csv` file.
pub fn flight_files(paths: &[PathBuf]) -> Result<Vec<PathBuf>, FlightError> {
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
    Ok(files)
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
pub(super) mod tests;
