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
const MAX_GAP: f64 = 5.0;

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
    fn set<const N: usize>(&self, names: [&str; N]) -> Option<Vec<(f64, [f64; N])>> {
        let find = |stream: &Stream| -> Option<Vec<(f64, [f64; N])>> {
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
    fn vector(&self, group: &str, names: [&str; 3], factors: [f64; 3]) -> Option<Vec<(f64, [f64; 3])>> {
        let names = names.map(|name| format!("{group}.{name}"));
        let mut samples = self.set([&*names[0], &names[1], &names[2]])?;
        for (_, sample) in &mut samples {
            sample.iter_mut().zip(factors).for_each(|(x, factor)| *x *= factor);
        }
        Some(samples)
    }

    /// Returns the attitude as quaternions `[w, x, y, z]`.
    fn attitude(&self) -> Result<Option<Vec<(f64, [f64; 4])>>, String> {
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
            if norm < 0.5 || norm > 2.0 {
                return Err(format!("the quaternion at {time:.3} s has the norm {norm:.3}, expected 1"));
            }
            Ok((time, q.map(|x| x / norm)))
        };
        samples.into_iter().map(unit).collect::<Result<_, _>>().map(Some)
    }

    /// Returns the duty of the motors, 0 to 1.
    fn duty(&self) -> Result<Option<Vec<(f64, [f64; 4])>>, String> {
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
        groups3.iter().filter_map(|(_, samples)| samples.as_deref()).try_for_each(|samples| span.add(samples))?;
        attitude.iter().chain(&duty).try_for_each(|samples| span.add(samples))?;
        voltage.iter().try_for_each(|samples| span.add(samples))?;
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
    /// Restricts the time to that of samples.
    fn add<const N: usize>(&mut self, samples: &[(f64, [f64; N])]) -> Result<(), String> {
        if let Some(pair) = samples.windows(2).find(|pair| pair[1].0 - pair[0].0 > MAX_GAP) {
            let (from, to) = (pair[0].0, pair[1].0);
            return Err(format!("no sample from {from:.3} s to {to:.3} s, expected one every {MAX_GAP} s"));
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

/// Returns the quaternion `[w, x, y, z]` of the firmware's 32-bit form: the index of the largest of x, y, z, w (2 bits),
/// and the other three with a sign bit and nine bits of magnitude, in units of 1/(511·√2).
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
