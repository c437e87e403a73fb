//! Logs of a Crazyflie as time series by variable, and their conversion to the table of a recorded flight.

use std::path::Path;

use nalgebra::{UnitQuaternion, Vector3};

use super::table::{
    ACCELERATION, ATTITUDE, BODY_RATE, COLUMNS, FlightTable, MOTORS, POSITION, TableError, VELOCITY, VOLTAGE,
};
use super::{FlightError, cflib_log, usd_log};
use crate::drone::GRAVITY;
use crate::state::{attitude_from_rpy, attitude_from_wxyz, wxyz};

/// Longest time without a sample of a variable, s. It limits the size of the table.
const MAX_GAP: f64 = 0.45;

/// Largest time between two samples of the voltage, s.
const MAX_VOLTAGE_GAP: f64 = 5.0;

/// Samples of N variables with their times, s, in the order of time.
type Samples<const N: usize> = Vec<(f64, [f64; N])>;

/// Variables with common times.
#[derive(Debug, Clone, PartialEq, Default)]
pub(super) struct Stream {
    /// Time of every sample, s.
    pub times: Vec<f64>,
    /// Name and samples of every variable; NaN where the log has no sample.
    pub variables: Vec<(String, Vec<f64>)>,
}

/// Log of a Crazyflie: time series of variables of the firmware.
///
/// [`read`](Self::read) reads the binary logs of the micro-SD card deck (versions 1 and 2) and CSV files with the
/// samples of `cflib` or of the client. [`table`](Self::table) converts the log to the table of a recorded flight.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct CrazyflieLog {
    pub(super) streams: Vec<Stream>,
}

impl CrazyflieLog {
    /// Reads a log. The first byte of the file selects the format.
    ///
    /// # Errors
    /// [`FlightError::File`] for a file that cannot be read, and the errors of [`from_bytes`](Self::from_bytes).
    pub fn read(path: impl AsRef<Path>) -> Result<Self, FlightError> {
        let path = path.as_ref();
        let bytes = std::fs::read(path).map_err(|error| FlightError::file(path, error))?;
        Self::of(&bytes).map_err(|error| FlightError::read(path, error))
    }

    /// Reads a log from memory.
    ///
    /// # Errors
    /// [`FlightError::Read`] with the name of the log as the path: for a binary log with the offset of a damaged byte,
    /// an unknown type or event, or a wrong checksum; for a CSV file with the line and the column.
    pub fn from_bytes(name: &str, bytes: &[u8]) -> Result<Self, FlightError> {
        Self::of(bytes).map_err(|error| FlightError::read(Path::new(name), error))
    }

    fn of(bytes: &[u8]) -> Result<Self, TableError> {
        if bytes.first() == Some(&usd_log::MAGIC) {
            usd_log::read(bytes).map_err(|message| (0, message))
        } else {
            cflib_log::read(bytes)
        }
    }

    /// Returns the names of all variables.
    pub fn variables(&self) -> impl Iterator<Item = &str> {
        self.streams.iter().flat_map(|stream| &stream.variables).map(|(name, _)| &**name)
    }

    /// Converts the log to the table of a recorded flight with rows every `step` seconds. The table has the columns
    /// whose variables the log has; [`FlightTable::missing`] lists the other ones. Of the variables below, the first
    /// complete set is used:
    ///
    /// | columns | variables |
    /// | --- | --- |
    /// | `px` … | `stateEstimate.x` … (m), `locSrv.x` … (m), `stateEstimateZ.x` … (mm) |
    /// | `qw` … | `stateEstimate.qw` …, `locSrv.qw` …, `stateEstimateZ.quat`, `stateEstimate.roll` … or `stabilizer.roll` … (°, inverted pitch) |
    /// | `vx` … | `stateEstimate.vx` … (m/s), `stateEstimateZ.vx` … (mm/s) |
    /// | `gx` … | `gyro.x` … (°/s), `stateEstimateZ.rateRoll` … (mrad/s, inverted pitch rate) |
    /// | `ax` … | `acc.x` … (g) |
    /// | `m1` … | `pwm.m1_pwm` …, `motor.m1` … (0 to 65535) |
    /// | `vbat` | `pm.vbat` (V), `pm.vbatMV` (mV) |
    ///
    /// Rows start at the first time at which all of these variables have a sample. Samples are interpolated linearly,
    /// attitudes along the shortest rotation.
    ///
    /// # Errors
    /// [`FlightError::Windows`] for a step that is not positive and at most 1 s, a log without any of these variables
    /// or without a common time, more than 5 s between two samples, a motor command outside 0 to 65535, and a
    /// quaternion of zero.
    pub fn table(&self, name: &str, step: f64) -> Result<FlightTable, FlightError> {
        self.converted(step).map_err(|message| FlightError::Windows { flight: name.into(), message })
    }

    /// Returns the samples of a set of variables: one element per time at which all of them have a sample, in the
    /// order of time.
    fn set<const N: usize>(&self, names: [&str; N]) -> Option<Samples<N>> {
        let find = |stream: &Stream| -> Option<Samples<N>> {
            let mut columns = [&[][..]; N];
            for (column, name) in columns.iter_mut().zip(names) {
                *column = &stream.variables.iter().find(|(variable, _)| variable == name)?.1;
            }
            let sample = |(index, &time): (usize, &f64)| {
                let sample = columns.map(|column| column[index]);
                sample.iter().all(|x| x.is_finite()).then_some((time, sample))
            };
            let mut samples: Vec<_> = stream.times.iter().enumerate().filter_map(sample).collect();
            // tasks of the firmware write their events slightly out of order
            samples.sort_by(|a, b| a.0.total_cmp(&b.0));
            samples.dedup_by(|later, earlier| later.0 <= earlier.0);
            (!samples.is_empty()).then_some(samples)
        };
        self.streams.iter().find_map(find)
    }

    /// Returns the three components of a vector times a factor.
    fn vector(&self, group: &str, names: [&str; 3], factors: [f64; 3]) -> Option<Samples<3>> {
        let names = names.map(|name| format!("{group}.{name}"));
        let mut samples = self.set([&*names[0], &names[1], &names[2]])?;
        for (_, sample) in &mut samples {
            sample.iter_mut().zip(factors).for_each(|(x, factor)| *x *= factor);
        }
        Some(samples)
    }

    /// Returns the attitude as quaternions `[w, x, y, z]`.
    fn attitude(&self) -> Result<Option<Samples<4>>, String> {
        let quaternion = |group: &str| {
            let [w, x, y, z] = ["qw", "qx", "qy", "qz"].map(|name| format!("{group}.{name}"));
            self.set([&*w, &x, &y, &z])
        };
        let angles = |group: &str| {
            // the firmware's pitch is positive with the nose up
            let samples = self.vector(group, ["roll", "pitch", "yaw"], [1.0, -1.0, 1.0])?;
            let attitude = |[roll, pitch, yaw]: [f64; 3]| {
                wxyz(&attitude_from_rpy(Vector3::new(roll, pitch, yaw).map(f64::to_radians)))
            };
            Some(samples.into_iter().map(|(time, angles)| (time, attitude(angles))).collect())
        };
        let compressed = || {
            let samples = self.set(["stateEstimateZ.quat"])?;
            Some(samples.into_iter().map(|(time, [bits])| (time, decompressed(bits as u32))).collect())
        };
        let samples = quaternion("stateEstimate").or_else(|| quaternion("locSrv")).or_else(compressed);
        let Some(samples) = samples.or_else(|| angles("stateEstimate")).or_else(|| angles("stabilizer")) else {
            return Ok(None);
        };
        let unit = |(time, q): (f64, [f64; 4])| {
            let norm = q.iter().map(|x| x * x).sum::<f64>().sqrt();
            if !(0.5..=2.0).contains(&norm) {
                return Err(format!("the quaternion at {time:.3} s has the norm {norm:.3}, expected 1"));
            }
            Ok((time, q.map(|x| x / norm)))
        };
        samples.into_iter().map(unit).collect::<Result<_, _>>().map(Some)
    }

    /// Returns the duty of the motors, 0 to 1.
    fn duty(&self) -> Result<Option<Samples<4>>, String> {
        const FULL: f64 = 65_535.0;
        for names in
            [["pwm.m1_pwm", "pwm.m2_pwm", "pwm.m3_pwm", "pwm.m4_pwm"], ["motor.m1", "motor.m2", "motor.m3", "motor.m4"]]
        {
            let Some(samples) = self.set(names) else { continue };
            let duty = |(time, sample): (f64, [f64; 4])| {
                if let Some(motor) = sample.iter().position(|x| !(0.0..=FULL).contains(x)) {
                    let (name, got) = (names[motor], crate::number(sample[motor]));
                    return Err(format!("{name} at {time:.3} s is {got}, expected 0 to 65535"));
                }
                Ok((time, sample.map(|x| x / FULL)))
            };
            return samples.into_iter().map(duty).collect::<Result<_, _>>().map(Some);
        }
        Ok(None)
    }

    fn converted(&self, step: f64) -> Result<FlightTable, String> {
        if !(step > 0.0 && step <= 1.0) {
            return Err(format!("the time step is {} s, expected a positive one up to 1 s", crate::number(step)));
        }
        let vector = |group: &str, names: [&str; 3], factor: f64| self.vector(group, names, [factor; 3]);
        let xyz = ["x", "y", "z"];
        let degree = 1_f64.to_radians();
        let groups3 = [
            (
                POSITION,
                vector("stateEstimate", xyz, 1.0)
                    .or_else(|| vector("locSrv", xyz, 1.0))
                    .or_else(|| vector("stateEstimateZ", xyz, 1e-3)),
            ),
            (
                VELOCITY,
                vector("stateEstimate", ["vx", "vy", "vz"], 1.0)
                    .or_else(|| vector("stateEstimateZ", ["vx", "vy", "vz"], 1e-3)),
            ),
            (
                BODY_RATE,
                vector("gyro", xyz, degree).or_else(|| {
                    self.vector("stateEstimateZ", ["rateRoll", "ratePitch", "rateYaw"], [1e-3, -1e-3, 1e-3])
                }),
            ),
            (ACCELERATION, vector("acc", xyz, GRAVITY)),
        ];
        let (attitude, duty) = (self.attitude()?, self.duty()?);
        let voltage = self.set(["pm.vbat"]).or_else(|| {
            let samples = self.set(["pm.vbatMV"])?;
            Some(samples.into_iter().map(|(time, [mv])| (time, [1e-3 * mv])).collect())
        });

        let mut span = Span::default();
        for ((first, _), samples) in &groups3 {
            samples.iter().try_for_each(|samples| span.add(COLUMNS[*first], samples, MAX_GAP))?;
        }
        for ((first, _), samples) in [(ATTITUDE, &attitude), (MOTORS, &duty)] {
            samples.iter().try_for_each(|samples| span.add(COLUMNS[first], samples, MAX_GAP))?;
        }
        voltage.iter().try_for_each(|samples| span.add(COLUMNS[VOLTAGE.0], samples, MAX_VOLTAGE_GAP))?;
        let times = span.times(step)?;

        let mut table = FlightTable::default();
        table.set(0, times.iter().map(|time| ((time - times[0]) * 1e9).round() / 1e9).collect());
        for (group, samples) in groups3 {
            fill(&mut table, group, samples.as_deref(), &times, lerp);
        }
        fill(&mut table, ATTITUDE, attitude.as_deref(), &times, slerp);
        fill(&mut table, MOTORS, duty.as_deref(), &times, lerp);
        fill(&mut table, VOLTAGE, voltage.as_deref(), &times, lerp);
        Ok(table)
    }
}

/// Common time of several time series.
#[derive(Debug, Default)]
struct Span(Option<(f64, f64)>);

impl Span {
    /// Restricts the time to that of the samples of a column.
    fn add<const N: usize>(&mut self, name: &str, samples: &[(f64, [f64; N])], max_gap: f64) -> Result<(), String> {
        if let Some(pair) = samples.windows(2).find(|pair| pair[1].0 - pair[0].0 > max_gap) {
            let (from, to) = (pair[0].0, pair[1].0);
            return Err(format!("no sample of {name} from {from:.3} s to {to:.3} s, expected one every {max_gap} s"));
        }
        let (first, last) = (samples[0].0, samples[samples.len() - 1].0);
        let (start, end) = self.0.unwrap_or((first, last));
        self.0 = Some((start.max(first), end.min(last)));
        Ok(())
    }

    /// Returns times with a constant step.
    fn times(&self, step: f64) -> Result<Vec<f64>, String> {
        let (start, end) = self.0.ok_or_else(|| {
            "no variable of a flight, expected for example stateEstimate.x, gyro.x, motor.m1 or pm.vbat".to_string()
        })?;
        if end < start {
            return Err(format!(
                "variables end at {end:.3} s before others start at {start:.3} s, expected an overlap"
            ));
        }
        let rows = ((end - start) / step + 1e-6).floor() as usize + 1;
        Ok((0..rows).map(|row| start + row as f64 * step).collect())
    }
}

/// Fills the columns of a group with samples at times between the first and the last sample.
fn fill<const N: usize>(
    table: &mut FlightTable,
    (first, _): (usize, usize),
    samples: Option<&[(f64, [f64; N])]>,
    times: &[f64],
    between: fn(&[f64; N], &[f64; N], f64) -> [f64; N],
) {
    let Some(samples) = samples else { return };
    debug_assert!(first + N <= COLUMNS.len());
    let mut columns = vec![Vec::with_capacity(times.len()); N];
    let mut index = 0;
    for &time in times {
        while index + 2 < samples.len() && samples[index + 1].0 <= time {
            index += 1;
        }
        let (a, b) = (&samples[index], &samples[(index + 1).min(samples.len() - 1)]);
        let part = if b.0 > a.0 { ((time - a.0) / (b.0 - a.0)).clamp(0.0, 1.0) } else { 0.0 };
        for (column, number) in columns.iter_mut().zip(between(&a.1, &b.1, part)) {
            column.push(number);
        }
    }
    for (index, column) in columns.into_iter().enumerate() {
        table.set(first + index, column);
    }
}

fn lerp<const N: usize>(a: &[f64; N], b: &[f64; N], part: f64) -> [f64; N] {
    std::array::from_fn(|i| a[i] + (b[i] - a[i]) * part)
}

fn slerp(a: &[f64; 4], b: &[f64; 4], part: f64) -> [f64; 4] {
    let (a, b): (UnitQuaternion<f64>, UnitQuaternion<f64>) = (attitude_from_wxyz(*a), attitude_from_wxyz(*b));
    let turn = (a.inverse() * b).scaled_axis();
    wxyz(&(a * UnitQuaternion::from_scaled_axis(turn * part)))
}

/// Returns the quaternion `[w, x, y, z]` of the firmware's 32-bit form: the index of the largest of x, y, z, w (2
/// bits), and the other three with a sign bit and nine bits of magnitude, in units of 1/(511·√2).
fn decompressed(bits: u32) -> [f64; 4] {
    let largest = (bits >> 30) as usize;
    let (mut rest, mut sum, mut xyzw) = (bits, 0.0, [0.0; 4]);
    for index in (0..4).rev().filter(|&index| index != largest) {
        let magnitude = f64::from(rest & 511) / 511.0 * std::f64::consts::FRAC_1_SQRT_2;
        xyzw[index] = if rest & 512 == 0 { magnitude } else { -magnitude };
        sum += magnitude * magnitude;
        rest >>= 10;
    }
    xyzw[largest] = (1.0 - sum).max(0.0).sqrt();
    let [x, y, z, w] = xyzw;
    [w, x, y, z]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flights::usd_log::tests::{Writer, sample};
    use proptest::prelude::*;

    fn table(bytes: &[u8], step: f64) -> Result<FlightTable, String> {
        let log = CrazyflieLog::from_bytes("log00", bytes).map_err(|error| error.to_string())?;
        log.table("log00", step).map_err(|error| error.to_string())
    }

    fn near(found: &[f64], expected: impl Fn(f64) -> f64, times: &[f64], tolerance: f64) {
        assert_eq!(found.len(), times.len());
        for (found, &time) in found.iter().zip(times) {
            assert!((found - expected(time)).abs() < tolerance, "{time}: {found} {}", expected(time));
        }
    }

    #[test]
    fn variables_of_both_versions_have_the_units_of_the_table() {
        for version in [1, 2] {
            let table = table(&sample(version), 0.01).unwrap();
            assert_eq!(table.missing(), [""; 0]);
            let times = table.column("t").unwrap();
            // the voltage starts 20 ms after the other variables
            let start = 0.02;
            assert_eq!((times[0], times[1], times.len()), (0.0, 0.01, 299));
            let column = |name: &str| table.column(name).unwrap();
            near(column("px"), |t| 0.5 * (t + start), times, 1e-6);
            near(column("vx"), |_| 0.5, times, 1e-6);
            near(column("gz"), |_| 90_f64.to_radians(), times, 1e-6);
            near(column("az"), |_| GRAVITY, times, 1e-6);
            near(column("m2"), |_| 40_000.0 / 65_535.0, times, 1e-9);
            near(column("vbat"), |t| 4.0 - 0.01 * (t + start), times, 1e-5);
            near(column("qw"), |t| (0.5 * 90_f64.to_radians() * (t + start)).cos(), times, 1e-6);
            near(column("qz"), |t| (0.5 * 90_f64.to_radians() * (t + start)).sin(), times, 1e-6);
        }
    }

    #[test]
    fn a_converted_log_is_a_flight() {
        let mut text = Vec::new();
        table(&sample(2), 0.01).unwrap().write(&mut text).unwrap();
        let flight = crate::flights::Flight::from_csv("log00", &text[..]).unwrap();
        assert!(flight.missing().is_empty());
        // motor 3 of the airframe is m1
        assert!((flight.duty.unwrap()[3][3] - 30_000.0 / 65_535.0).abs() < 1e-12);
    }

    #[test]
    fn compressed_variables_and_angles_replace_missing_ones() {
        let mut writer = Writer::new(2);
        let event = writer.event(
            "fixedFrequency",
            &[
                ("stateEstimateZ.x", 'h'),
                ("stateEstimateZ.y", 'h'),
                ("stateEstimateZ.z", 'h'),
                ("stateEstimateZ.rateRoll", 'h'),
                ("stateEstimateZ.ratePitch", 'h'),
                ("stateEstimateZ.rateYaw", 'h'),
                ("stabilizer.roll", 'f'),
                ("stabilizer.pitch", 'f'),
                ("stabilizer.yaw", 'f'),
                ("pm.vbatMV", 'H'),
            ],
        );
        for row in 0..5 {
            writer.sample(event, 10_000 * row, &[100.0, -200.0, 300.0, 10.0, 20.0, -30.0, 5.0, -10.0, 40.0, 3700.0]);
        }
        let table = table(&writer.finish(), 0.01).unwrap();
        assert_eq!(table.missing(), ["vx", "vy", "vz", "ax", "ay", "az", "m1", "m2", "m3", "m4"]);
        let first = |name: &str| table.column(name).unwrap()[0];
        assert_eq!([first("px"), first("py"), first("pz")].map(|x| (1e3 * x).round()), [100.0, -200.0, 300.0]);
        // the firmware's pitch and pitch rate are inverted
        assert_eq!([first("gx"), first("gy"), first("gz")].map(|x| (1e3 * x).round()), [10.0, -20.0, -30.0]);
        let attitude = attitude_from_wxyz(["qw", "qx", "qy", "qz"].map(first));
        let rpy = crate::state::rpy_from_attitude(&attitude).map(f64::to_degrees);
        assert!((rpy - Vector3::new(5.0, 10.0, 40.0)).norm() < 1e-4, "{rpy}");
        assert!((first("vbat") - 3.7).abs() < 1e-12);
    }

    #[test]
    fn csv_logs_of_several_blocks_have_empty_cells() {
        let mut text = String::from("timestamp,stateEstimate.x,stateEstimate.y,stateEstimate.z,pm.vbat,block\n");
        for row in 0..50 {
            let time = 123_456 + 10 * row;
            text += &match row % 10 {
                0 => format!("{time},,,,{},battery\n", 3.8 - 1e-3 * f64::from(row)),
                _ => format!("{time},{},1,2,nan,position\n", 0.1 * f64::from(row)),
            };
        }
        let converted = table(text.as_bytes(), 0.02).unwrap();
        assert_eq!(converted.column("py").unwrap(), [1.0; 20]);
        near(converted.column("px").unwrap(), |t| 10.0 * (t + 0.01), converted.column("t").unwrap(), 1e-9);
        near(converted.column("vbat").unwrap(), |t| 3.8 - 0.1 * (t + 0.01), converted.column("t").unwrap(), 1e-9);
        // seconds in place of milliseconds
        let mut seconds = String::from("t,gyro.x,gyro.y,gyro.z\n");
        (0..20).for_each(|row| seconds += &format!("{},0,180,0\n", 5.0 + 0.01 * f64::from(row)));
        let converted = table(seconds.as_bytes(), 0.01).unwrap();
        assert_eq!(converted.rows(), 20);
        assert!((converted.column("gy").unwrap()[3] - std::f64::consts::PI).abs() < 1e-12);
    }

    #[test]
    fn invalid_logs_are_errors_of_one_line() {
        let csv = |text: &str| table(text.as_bytes(), 0.01).unwrap_err();
        assert!(csv("").starts_with("log00: line 1: no column timestamp, expected a uSD log"));
        assert!(csv("a,b\n1,2\n").starts_with("log00: line 1: no column timestamp"));
        let header = "timestamp,gyro.x,gyro.y,gyro.z\n";
        assert_eq!(
            csv(&format!("{header}0,1,2,3\n10,1,x,3\n")),
            "log00: line 3: gyro.y is `x`, expected a finite number"
        );
        assert_eq!(csv(&format!("{header}0,1,2,3\n10,1\n")), "log00: line 3: 2 cells, expected 4");
        assert_eq!(
            csv(&format!("{header}0,1,2,3\n,1,2,3\n")),
            "log00: line 3: timestamp is ``, expected a finite number"
        );
        assert!(csv("timestamp,gyro.x,gyro.x\n").ends_with("two columns `gyro.x`, expected one"));
        assert!(csv("timestamp,foo.x\n0,1\n").starts_with("log00: no variable of a flight"));
        let gap = csv(&format!("{header}0,1,2,3\n10,1,2,3\n9000,1,2,3\n"));
        assert_eq!(gap, "log00: no sample of gx from 0.010 s to 9.000 s, expected one every 0.45 s");
        let back = "timestamp,gyro.x,gyro.y,gyro.z\n0,0,0,0\n200,0,0,0\n50,0,0,0\n";
        assert_eq!(csv(back), "log00: line 4: timestamp is 50 after 200, expected increasing times");
        let motors = "timestamp,motor.m1,motor.m2,motor.m3,motor.m4\n0,1,2,3,4\n10,1,2,70000,4\n";
        assert_eq!(csv(motors), "log00: motor.m3 at 0.010 s is 70000, expected 0 to 65535");
        let apart = "timestamp,pm.vbat,acc.x,acc.y,acc.z\n0,3.7,,,\n10,3.7,,,\n20,,0,0,1\n30,,0,0,1\n";
        assert!(csv(apart).starts_with("log00: variables end at 0.010 s before others start at 0.020 s"));
        let zero =
            "timestamp,stateEstimate.qw,stateEstimate.qx,stateEstimate.qy,stateEstimate.qz\n0,0,0,0,0\n10,1,0,0,0\n";
        assert!(csv(zero).starts_with("log00: the quaternion at 0.000 s has the norm 0.000"));
        for step in [0.0, -1.0, f64::NAN, 2.0] {
            assert!(table(&sample(2), step).unwrap_err().contains("the time step is"), "{step}");
        }
    }

    #[test]
    fn samples_out_of_order_are_sorted() {
        let text = "timestamp,pm.vbat\n0,1\n20,3\n10,2\n20,9\n30,4\n";
        assert_eq!(table(text.as_bytes(), 0.01).unwrap().column("vbat").unwrap(), [1.0, 2.0, 3.0, 4.0]);
    }

    /// Compresses a quaternion as the firmware does.
    fn compressed([w, x, y, z]: [f64; 4]) -> u32 {
        let xyzw = [x, y, z, w];
        let largest = (0..4).max_by(|a, b| xyzw[*a].abs().total_cmp(&xyzw[*b].abs())).unwrap();
        (0..4).filter(|index| *index != largest).fold(largest as u32, |bits, index| {
            let is_negative = u32::from((xyzw[index] < 0.0) != (xyzw[largest] < 0.0));
            let magnitude = (511.0 * xyzw[index].abs() * std::f64::consts::SQRT_2 + 0.5) as u32;
            bits << 10 | is_negative << 9 | magnitude.min(511)
        })
    }

    proptest! {
        #[test]
        fn compressed_quaternions_are_within_their_resolution(angles in prop::array::uniform3(-3.0_f64..3.0)) {
            let attitude = UnitQuaternion::from_scaled_axis(Vector3::from(angles));
            let again = attitude_from_wxyz(decompressed(compressed(wxyz(&attitude))));
            prop_assert!(attitude.angle_to(&again) < 0.008, "{}", attitude.angle_to(&again));
        }

        #[test]
        fn any_file_is_a_log_or_an_error_of_one_line(
            noise in prop::collection::vec(any::<u8>(), 0..400), binary in any::<bool>(),
        ) {
            let mut bytes = noise;
            if binary && !bytes.is_empty() {
                bytes[0] = 0xBC;
            }
            if let Err(error) = table(&bytes, 0.01) {
                prop_assert!(error.lines().count() == 1 && error.chars().count() < 300, "{}", error);
            }
        }
    }
}
