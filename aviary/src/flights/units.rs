//! Check of the units and frames of a recorded flight, by comparing columns with differences of others.
//!
//! A wrong unit or frame is there from the first second on. Only the first seconds decide whether a flight can be read,
//! so that a flight with damaged or replaced later rows can still be predicted before them.

use nalgebra::Vector3;

use super::table::{BODY_RATE, COLUMNS, POSITION, VELOCITY};
use super::{Flight, FlightError};
use crate::drone::GRAVITY;

/// Time on both sides of a row over which columns are compared with differences, s.
const HALF_SPAN: f64 = 0.02;

/// Half of the time over which body rates are compared with the attitude, s.
const RATE_SPAN: f64 = 0.05;

/// Largest time shift of a gyro against the attitude, s.
const MAX_SHIFT: f64 = 0.3;

/// Largest deviation of a column as a share of its size.
const MAX_SHARE: f64 = 0.3;

/// Largest acceleration of a drone (root mean square over the first seconds), m/s².
const MAX_ACCELERATION: f64 = 80.0;

/// Number of time shifts up to [`MAX_SHIFT`] at which a gyro is compared.
const SHIFTS: isize = 30;

/// Time from the first row in which columns must agree for a flight to be read, s; the first window of a comparison
/// starts then.
const FIRST: f64 = 3.0;

/// Columns that disagree: the row of the largest deviation, and a description.
type Disagreement = (usize, String);

impl Flight {
    /// Checks that velocities, rates and specific forces agree with the motion, so that columns have their units and
    /// frames.
    ///
    /// A file whose first 3 s disagree cannot be read at all, so that the error concerns later rows.
    ///
    /// # Errors
    /// [`FlightError::Windows`] with the columns, the deviation and the time of the largest one.
    pub fn check_units(&self) -> Result<(), FlightError> {
        self.units_in(self.rows()).map_err(|(row, message)| FlightError::Windows {
            flight: self.name.clone(),
            message: format!("{message}; the largest deviation is at {:.3} s", self.time(row)),
        })
    }

    /// Checks the columns of the first seconds.
    pub(super) fn check_start(&self) -> Result<(), Disagreement> {
        let first = (FIRST / self.step).round() as usize;
        self.units_in(self.rows().min(first.max(1)))
    }

    /// Checks the columns of the first rows.
    fn units_in(&self, count: usize) -> Result<(), Disagreement> {
        let half_of = |time: f64| ((time / self.step).round() as usize).clamp(1, (count.max(3) - 1) / 2);
        let half = half_of(HALF_SPAN);
        let span = 2.0 * half as f64 * self.step;
        let rows = half..count.saturating_sub(half).max(half);
        let moved = |row: usize| (self.position[row + half] - self.position[row - half]) / span;
        let derived: Vec<_> = rows.clone().map(moved).collect();
        if let Some((axis, error, row)) = worst_axis(&self.velocity[..count], half, &derived, 0.05, 0) {
            let (name, of) = (COLUMNS[VELOCITY.0 + axis], COLUMNS[POSITION.0 + axis]);
            let differs = format!("{name} differs from the derivative of {of} by {error:.2} m/s (RMS)");
            return Err((row, format!("{differs}, expected m/s in the world frame")));
        }
        let change = |row: usize| (self.velocity[row + half] - self.velocity[row - half]) / span;
        let squares = rows.clone().map(|row| change(row).norm_squared());
        let acceleration = (squares.sum::<f64>() / rows.len().max(1) as f64).sqrt();
        if acceleration > MAX_ACCELERATION {
            let names = COLUMNS[VELOCITY.0..VELOCITY.0 + 3].join(", ");
            let message = format!("{names} have an acceleration of {acceleration:.0} m/s² (RMS), expected m and m/s");
            return Err((half.min(count - 1), message));
        }
        if let Some(rates) = &self.body_rate {
            let half = half_of(RATE_SPAN);
            let span = 2.0 * half as f64 * self.step;
            let rows = half..count.saturating_sub(half).max(half);
            let turned =
                |row: usize| (self.attitude[row - half].inverse() * self.attitude[row + half]).scaled_axis() / span;
            let derived: Vec<_> = rows.map(turned).collect();
            let shift = (MAX_SHIFT / self.step).round() as usize;
            if let Some((axis, error, row)) = worst_axis(&rates[..count], half, &derived, 0.15, shift) {
                let name = COLUMNS[BODY_RATE.0 + axis];
                let differs = format!("{name} differs from the rate of the attitude by {error:.2} rad/s (RMS)");
                return Err((row, format!("{differs}, expected rad/s, body frame")));
            }
        }
        if let Some(forces) = &self.acceleration {
            // the mean, because of the vibration of the accelerometer
            let count = rows.len().max(1) as f64;
            let expected = |row: usize| (self.attitude[row].inverse() * (change(row) + Vector3::z() * GRAVITY)).z;
            let (mut measured, mut sum, mut largest) = (0.0, 0.0, (0.0, 0));
            for row in rows {
                let (found, expected) = (forces[row].z, expected(row));
                (measured, sum) = (measured + found / count, sum + expected / count);
                if (found - expected).abs() > largest.0 {
                    largest = ((found - expected).abs(), row);
                }
            }
            if (measured - sum).abs() > 0.5 * sum.abs() + 1.0 {
                let message = format!("the mean of az is {measured:.2}, expected {sum:.2} (specific force in m/s²)");
                return Err((largest.1, message));
            }
        }
        Ok(())
    }
}

/// Compares the means of a column over `2·half + 1` rows with values from differences, one for every row from `half`
/// on, at the time shift of up to `shift` rows with the smallest deviation. Returns the first axis whose deviation
/// exceeds [`MAX_SHARE`] of the signal plus `room`, with the deviation (root mean square) and the row of the largest
/// one.
fn worst_axis(
    measured: &[Vector3<f64>],
    half: usize,
    derived: &[Vector3<f64>],
    room: f64,
    shift: usize,
) -> Option<(usize, f64, usize)> {
    let mean = |around: &[Vector3<f64>]| around.iter().sum::<Vector3<f64>>() / around.len() as f64;
    let means: Vec<_> = measured.windows(2 * half + 1).map(mean).collect();
    let count = means.len().min(derived.len());
    // at least half of the rows are compared
    let shift = shift.min(count / 2).cast_signed();
    let pairs = |by: isize| {
        let (skipped, ahead) = ((-by).max(0).cast_unsigned(), by.max(0).cast_unsigned());
        means[ahead..count].iter().zip(&derived[skipped..count]).enumerate().map(move |(i, pair)| (i + skipped, pair))
    };
    let deviation = |by: isize| {
        let (sum, rows) = pairs(by).fold((0.0, 0), |(sum, rows), (_, (a, b))| (sum + (a - b).norm_squared(), rows + 1));
        sum / f64::from(rows.max(1))
    };
    let best = if shift == 0 {
        0
    } else {
        // steps of 10 ms at any rate: the means are over more
        let step = (shift / SHIFTS).max(1);
        (-shift..=shift)
            .step_by(step.unsigned_abs())
            .min_by(|a, b| deviation(*a).total_cmp(&deviation(*b)))
            .unwrap_or(0)
    };
    let (mut signal, mut expected, mut error) = ([0.0; 3], [0.0; 3], [0.0; 3]);
    let (mut largest, mut rows) = ([(0.0, 0); 3], 0.0_f64);
    for (index, (mean, derived)) in pairs(best) {
        rows += 1.0;
        for axis in 0..3 {
            let deviation = (mean[axis] - derived[axis]).abs();
            signal[axis] += mean[axis] * mean[axis];
            expected[axis] += derived[axis] * derived[axis];
            error[axis] += deviation * deviation;
            if deviation > largest[axis].0 {
                largest[axis] = (deviation, index + half);
            }
        }
    }
    let rms = |sum: f64| (sum / rows.max(1.0)).sqrt();
    let exceeds = |axis: &usize| rms(error[*axis]) > MAX_SHARE * rms(signal[*axis].max(expected[*axis])) + room;
    (0..3).find(exceeds).map(|axis| (axis, rms(error[axis]), largest[axis].1))
}
