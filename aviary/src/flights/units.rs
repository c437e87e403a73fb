//! Check of the units and frames of a recorded flight, by comparing columns with differences of others.

use nalgebra::Vector3;

use super::Flight;
use super::table::{BODY_RATE, COLUMNS, POSITION, VELOCITY};
use crate::drone::GRAVITY;

/// Time on both sides of a row over which columns are compared with differences, s.
const HALF_SPAN: f64 = 0.02;

impl Flight {
    /// Checks that velocities, rates and specific forces agree with the motion, so that columns have their units and
    /// frames. The error contains the row with the largest deviation.
    pub(super) fn check_units(&self) -> Result<(), (usize, String)> {
        let half = ((HALF_SPAN / self.step).round() as usize).max(1);
        let span = 2.0 * half as f64 * self.step;
        let rows = half..self.rows().saturating_sub(half).max(half);
        let moved = |row: usize| (self.position[row + half] - self.position[row - half]) / span;
        if let Some((axis, error, row)) = worst_axis(&self.velocity, half, rows.clone().map(moved), 0.05) {
            let (name, of) = (COLUMNS[VELOCITY.0 + axis], COLUMNS[POSITION.0 + axis]);
            let differs = format!("{name} differs from the derivative of {of} by {error:.2} m/s (RMS)");
            return Err((row, format!("{differs}, expected m/s in the world frame")));
        }
        if let Some(rates) = &self.body_rate {
            let turned =
                |row: usize| (self.attitude[row - half].inverse() * self.attitude[row + half]).scaled_axis() / span;
            if let Some((axis, error, row)) = worst_axis(rates, half, rows.clone().map(turned), 0.3) {
                let name = COLUMNS[BODY_RATE.0 + axis];
                let differs = format!("{name} differs from the rate of the attitude by {error:.2} rad/s (RMS)");
                return Err((row, format!("{differs}, expected rad/s, body frame")));
            }
        }
        if let Some(forces) = &self.acceleration {
            // the mean over the flight, because of the vibration of the accelerometer
            let count = rows.len().max(1) as f64;
            let expected = |row: usize| {
                let change = (self.velocity[row + half] - self.velocity[row - half]) / span;
                (self.attitude[row].inverse() * (change + Vector3::z() * GRAVITY)).z
            };
            let measured = forces[rows.clone()].iter().map(|force| force.z).sum::<f64>() / count;
            let expected = rows.map(expected).sum::<f64>() / count;
            if (measured - expected).abs() > 0.5 * expected.abs() + 1.0 {
                let message =
                    format!("the mean of az is {measured:.2}, expected {expected:.2} (specific force in m/s²)");
                return Err((0, message));
            }
        }
        Ok(())
    }
}

/// Compares the means of a column over `2·half + 1` rows with values from differences, one for every row from `half`
/// on. Returns the first axis whose deviation exceeds half of the signal plus `room`, with the deviation (root mean
/// square) and the row of the largest one.
fn worst_axis(
    measured: &[Vector3<f64>],
    half: usize,
    derived: impl Iterator<Item = Vector3<f64>>,
    room: f64,
) -> Option<(usize, f64, usize)> {
    let (mut signal, mut expected, mut error) = ([0.0; 3], [0.0; 3], [0.0; 3]);
    let (mut largest, mut count) = ([(0.0, 0); 3], 0.0);
    for (index, (around, derived)) in measured.windows(2 * half + 1).zip(derived).enumerate() {
        let mean = around.iter().sum::<Vector3<f64>>() / around.len() as f64;
        count += 1.0;
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
    let rms = |sum: f64| (sum / f64::max(count, 1.0)).sqrt();
    let exceeds = |axis: &usize| rms(error[*axis]) > 0.5 * rms(signal[*axis].max(expected[*axis])) + room;
    (0..3).find(exceeds).map(|axis| (axis, rms(error[axis]), largest[axis].1))
}
