//! Alignment of a recorded flight without a model of the drone: the time shift of the onboard columns against the
//! motion capture, and the tilt and the offset of the marker frame.

use nalgebra::{DMatrix, DVector, UnitQuaternion, Vector3};

use super::statistics::{Estimate, block_regression, instrumented_regression};
use crate::drone::GRAVITY;
use crate::flights::Flight;

/// Length of the blocks whose sums are taken as independent, s.
const BLOCK: f64 = 2.0;

/// Largest time shift that is searched for, s.
const MAX_SHIFT: f64 = 0.3;

/// Rows on both sides of a row in the differences and in the kernel of the acceleration.
const HALF: usize = 4;

/// Smallest corrections that are applied.
const MIN_SHIFT: f64 = 2e-3;
pub(super) const MIN_MOTOR_SHIFT: f64 = 5e-3;
const MIN_TILT: f64 = 4e-3;
const MIN_OFFSET: f64 = 3e-3;

/// Differences between the frames and clocks of one recorded flight. A correction is applied if it exceeds a minimum
/// (2 ms onboard, 5 ms of the motors, 4 mrad, 3 mm) and four standard errors; that of a tilt or an offset must also
/// have a standard error below the minimum. [`applied`](Self::applied) has the numbers that were.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct Alignment {
    /// Name of the flight.
    pub flight: String,
    /// Time by which the onboard columns (gyro, accelerometer, motors, voltage) lag behind the motion capture, s;
    /// `None` without a gyro, or if the drone hardly turns.
    pub onboard_shift: Option<Estimate>,
    /// Time by which the motor columns lag behind the other flights, s, in addition to the onboard shift; `None` before
    /// the fit of the rotation.
    pub motor_shift: Option<Estimate>,
    /// Rotation of the marker frame about body x and y, rad.
    pub tilt: [Estimate; 2],
    /// Position of the origin of the marker frame relative to the centre of mass, body frame, m.
    pub offset: [Estimate; 3],
    /// Corrections that were applied.
    pub applied: Correction,
}

/// Correction of a recorded flight; zero for a flight that is aligned.
#[derive(Debug, Clone, Copy, PartialEq, Default, serde::Serialize)]
pub struct Correction {
    /// Time by which the onboard columns are moved ahead, s.
    pub onboard_shift: f64,
    /// Time by which the motors and the voltage are moved ahead in addition, s.
    pub motor_shift: f64,
    /// Rotation of the marker frame about body x and y, rad.
    pub tilt: [f64; 2],
    /// Position of the origin of the marker frame relative to the centre of mass, body frame, m.
    pub offset: [f64; 3],
}

impl Correction {
    /// Returns true for no correction.
    pub fn is_zero(&self) -> bool {
        *self == Self::default()
    }
}

/// Returns an estimate as a correction, or zero if it is below a minimum, below four standard errors, or not accurate.
pub(super) fn significant(estimate: &Estimate, min: f64, max_error: f64) -> f64 {
    let size = estimate.value.abs();
    if size > min && estimate.error <= (0.25 * size).min(max_error) { estimate.value } else { 0.0 }
}

/// Estimates the alignment of a flight, and returns it with the corrected flight.
pub(super) fn align(flight: &Flight) -> (Alignment, Flight) {
    let mut corrected = flight.clone();
    let onboard_shift = onboard_shift(flight);
    let shift = onboard_shift.as_ref().map_or(0.0, |estimate| significant(estimate, MIN_SHIFT, f64::INFINITY));
    if shift != 0.0 {
        shift_onboard(&mut corrected, shift);
    }
    let [tilt_x, tilt_y, offset_x, offset_y, offset_z] = marker_frame(&corrected);
    let tilt = [tilt_x, tilt_y];
    let offset = [offset_x, offset_y, offset_z];
    let applied = Correction {
        onboard_shift: shift,
        motor_shift: 0.0,
        tilt: tilt.map(|estimate| significant(&estimate, MIN_TILT, MIN_TILT)),
        offset: offset.map(|estimate| significant(&estimate, MIN_OFFSET, MIN_OFFSET)),
    };
    correct_marker_frame(&mut corrected, &applied);
    let alignment = Alignment { flight: flight.name.clone(), onboard_shift, motor_shift: None, tilt, offset, applied };
    (alignment, corrected)
}

/// Moves the onboard columns ahead by a time, s.
fn shift_onboard(flight: &mut Flight, shift: f64) {
    let rows = shift / flight.step;
    for vectors in [&mut flight.body_rate, &mut flight.acceleration].into_iter().flatten() {
        *vectors = shifted(vectors, rows, |a, b, share| a * (1.0 - share) + b * share);
    }
    shift_motors(flight, shift);
}

/// Moves the motors and the voltage ahead by a time, s.
pub(super) fn shift_motors(flight: &mut Flight, shift: f64) {
    let rows = shift / flight.step;
    if let Some(duty) = &mut flight.duty {
        *duty = shifted(duty, rows, |a, b, share| std::array::from_fn(|i| a[i] * (1.0 - share) + b[i] * share));
    }
    if let Some(voltage) = &mut flight.voltage {
        *voltage = shifted(voltage, rows, |a, b, share| a * (1.0 - share) + b * share);
    }
}

/// Returns samples at later rows, interpolated linearly; the first and the last sample continue.
fn shifted<T>(samples: &[T], rows: f64, mix: impl Fn(&T, &T, f64) -> T) -> Vec<T> {
    let last = samples.len() - 1;
    let at = |row: usize| {
        let place = (row as f64 + rows).clamp(0.0, last as f64);
        let first = (place as usize).min(last.saturating_sub(1));
        mix(&samples[first], &samples[(first + 1).min(last)], place - first as f64)
    };
    (0..samples.len()).map(at).collect()
}

/// Returns the mean body rates between rows `HALF` before and after each row, from the attitude.
fn rates_of_attitude(flight: &Flight) -> Vec<Vector3<f64>> {
    let span = 2.0 * HALF as f64 * flight.step;
    (HALF..flight.rows() - HALF)
        .map(|row| (flight.attitude[row - HALF].inverse() * flight.attitude[row + HALF]).scaled_axis() / span)
        .collect()
}

/// Returns the time by which the gyro lags behind the attitude: the shift with the smallest squared difference of mean
/// body rates, with a bias per axis and a small rotation between the frames.
fn onboard_shift(flight: &Flight) -> Option<Estimate> {
    let gyro = flight.body_rate.as_ref()?;
    let max_rows = (MAX_SHIFT / flight.step).ceil() as usize;
    if flight.rows() < 4 * (max_rows + HALF) {
        return None;
    }
    let reference = rates_of_attitude(flight);
    let glitches = flight.glitches();
    // sums, for means between the same rows as the reference
    let mut sums = vec![Vector3::zeros()];
    for rate in gyro {
        sums.push(sums[sums.len() - 1] + rate);
    }
    let mean = |row: usize| {
        // trapezoidal rule
        let inner = sums[row + HALF] - sums[row - HALF + 1];
        (inner + (gyro[row - HALF] + gyro[row + HALF]) * 0.5) / (2 * HALF) as f64
    };
    let means: Vec<_> = (HALF..flight.rows() - HALF).map(mean).collect();
    let inside = max_rows + 2..means.len() - max_rows - 2;
    let is_good = |index: usize| !glitches[index] && !glitches[index + 2 * HALF];
    let used: Vec<usize> = inside.filter(|&index| is_good(index)).collect();
    if used.len() < 20 {
        return None;
    }
    let value = |index: usize, rows: f64| {
        let place = index as f64 + rows;
        let first = place.floor();
        let (share, first) = (place - first, first as usize);
        means[first] * (1.0 - share) + means[first + 1] * share
    };
    let cost = |rows: f64| {
        let differences = used.iter().map(|&index| value(index, rows) - reference[index]);
        let (mut sum, mut squares) = (Vector3::zeros(), 0.0);
        for difference in differences {
            sum += difference;
            squares += difference.norm_squared();
        }
        squares - sum.norm_squared() / used.len() as f64
    };
    let steps = -(max_rows as i64)..=max_rows as i64;
    let start = steps.map(|rows| rows as f64).min_by(|a, b| cost(*a).total_cmp(&cost(*b)))?;
    // Gauss–Newton; the slope of the gyro is its central difference
    let (mut rows, mut error) = (start, f64::INFINITY);
    for _ in 0..5 {
        let count = used.len();
        // shift, three biases, three rotations
        let mut design = DMatrix::zeros(3 * count, 7);
        let mut target = DVector::zeros(3 * count);
        let mut blocks = Vec::with_capacity(3 * count);
        for (place, &index) in used.iter().enumerate() {
            let rate = value(index, rows);
            let slope = (value(index, rows + 1.0) - value(index, rows - 1.0)) * 0.5;
            let rest = reference[index] - rate;
            for axis in 0..3 {
                design[(3 * place + axis, 0)] = slope[axis];
                design[(3 * place + axis, axis + 1)] = 1.0;
                for turn in 0..3 {
                    design[(3 * place + axis, turn + 4)] = rate.cross(&Vector3::ith(turn, 1.0))[axis];
                }
                target[3 * place + axis] = rest[axis];
                blocks.push((index as f64 * flight.step / BLOCK) as usize);
            }
        }
        let [change, ..] = block_regression(&design, &target, &blocks)[..] else { return None };
        rows = (rows + change.value).clamp(-(max_rows as f64), max_rows as f64);
        error = change.error;
    }
    error.is_finite().then_some(Estimate { value: rows * flight.step, error: error * flight.step })
}

/// Returns the kernel of a second derivative by a cubic through `2·HALF + 1` rows, as weights of the accelerations
/// between the rows' neighbours: the second derivative of positions is the weighted mean of the accelerations.
fn kernels() -> ([f64; 2 * HALF + 1], [f64; 2 * HALF + 1]) {
    let m = HALF as f64;
    let offsets: [f64; 2 * HALF + 1] = std::array::from_fn(|index| index as f64 - m);
    let mean = m * (m + 1.0) / 3.0;
    let norm: f64 = offsets.iter().map(|x| 0.5 * x * x * (x * x - mean)).sum();
    let second = offsets.map(|x| (x * x - mean) / norm);
    // p(k + j) = p(k) + … + Σ (j − i)·a(i): the weight of a(i) is the sum of the weights beyond i
    let weight = |at: usize| {
        let beyond = |x: f64| (x - offsets[at]).max(0.0);
        offsets.iter().zip(second).map(|(&x, w)| w * beyond(x)).sum::<f64>()
    };
    (second, std::array::from_fn(weight))
}

/// Estimates the tilt about body x and y, and the position of the marker frame.
///
/// With the tilt θ and the offset r, the lateral specific force of the marker frame's origin in the measured body frame
/// is (−θ_y·T, θ_x·T) − diag(d)·v + (ω̇ × r + ω × (ω × r)): a linear regression with one drag coefficient per axis.
/// Noise of the gyro in ω̇ would make r too small, so that the same terms with the rates from the attitude, whose noise
/// is independent, serve as instrumental variables.
fn marker_frame(flight: &Flight) -> [Estimate; 5] {
    let unknown = Estimate { value: 0.0, error: f64::INFINITY };
    let rows = flight.rows();
    if rows < 6 * HALF + 20 {
        return [unknown; 5];
    }
    let inner = rates_of_attitude(flight);
    let own_rates: Vec<_> = (0..rows).map(|row| inner[row.clamp(HALF, rows - HALF - 1) - HALF]).collect();
    let rates = flight.body_rate.as_ref().unwrap_or(&own_rates);
    let (second, weights) = kernels();
    let squared = flight.step * flight.step;
    let glitches = flight.glitches();
    let used: Vec<usize> = (HALF + 1..rows - HALF - 1).filter(|&row| !glitches[row]).collect();
    // two equations a row; θ_x, θ_y, r_x, r_y, r_z, d_x, d_y
    let mut design = DMatrix::zeros(2 * used.len(), 7);
    let mut instruments = DMatrix::zeros(2 * used.len(), 7);
    let mut target = DVector::zeros(2 * used.len());
    let mut blocks = Vec::with_capacity(2 * used.len());
    for (place, &row) in used.iter().enumerate() {
        let mut force = Vector3::z() * GRAVITY;
        for (index, weight) in second.iter().enumerate() {
            force += (flight.position[row + index - HALF] - flight.position[row]) * (weight / squared);
        }
        let back = flight.attitude[row].inverse();
        let force = back * force;
        let thrust = force.z;
        let (mut up, mut drag) = (Vector3::zeros(), [Vector3::zeros(); 2]);
        // with the measured rates, and with those from the attitude
        let mut levers = [[Vector3::zeros(); 3]; 2];
        for (index, &weight) in weights.iter().enumerate() {
            let at = row + index - HALF;
            let turn = back * flight.attitude[at];
            up += turn * Vector3::z() * weight;
            let velocity = flight.attitude[at].inverse() * flight.velocity[at];
            drag[0] -= turn * Vector3::x() * (velocity.x * weight);
            drag[1] -= turn * Vector3::y() * (velocity.y * weight);
            for (lever, rates) in levers.iter_mut().zip([rates, &own_rates]) {
                let acceleration = (rates[at + 1] - rates[at - 1]) / (2.0 * flight.step);
                for (axis, lever) in lever.iter_mut().enumerate() {
                    let r = Vector3::ith(axis, 1.0);
                    *lever += turn * (acceleration.cross(&r) + rates[at].cross(&rates[at].cross(&r))) * weight;
                }
            }
        }
        for axis in 0..2 {
            let line = 2 * place + axis;
            // the direction of the thrust changes within the kernel
            target[line] = force[axis] - up[axis] * thrust;
            for (matrix, lever) in [&mut design, &mut instruments].into_iter().zip(&levers) {
                matrix[(line, 1 - axis)] = if axis == 0 { -thrust } else { thrust };
                for (column, lever) in lever.iter().enumerate() {
                    matrix[(line, 2 + column)] = lever[axis];
                }
                matrix[(line, 5)] = drag[0][axis];
                matrix[(line, 6)] = drag[1][axis];
            }
            blocks.push((row as f64 * flight.step / BLOCK) as usize);
        }
    }
    let estimates = instrumented_regression(&design, &instruments, &target, &blocks);
    if estimates.len() < 5 { [unknown; 5] } else { std::array::from_fn(|index| estimates[index]) }
}

/// Turns the attitude and moves the position and the velocity to those of the centre of mass.
fn correct_marker_frame(flight: &mut Flight, correction: &Correction) {
    let ([x, y], offset) = (correction.tilt, Vector3::from(correction.offset));
    if correction.offset != [0.0; 3] {
        let inner = rates_of_attitude(flight);
        for row in 0..flight.rows() {
            let rate = match &flight.body_rate {
                Some(rates) => rates[row],
                None => inner[row.clamp(HALF, flight.rows() - HALF - 1) - HALF],
            };
            flight.position[row] -= flight.attitude[row] * offset;
            flight.velocity[row] -= flight.attitude[row] * rate.cross(&offset);
        }
    }
    if [x, y] != [0.0; 2] {
        let back = UnitQuaternion::from_scaled_axis(Vector3::new(-x, -y, 0.0));
        flight.attitude.iter_mut().for_each(|attitude| *attitude *= back);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Returns position, velocity, attitude and body rate of a drone that flies a curve with tilts up to 30° under
    /// thrust along body z and a drag of 0.3 1/s.
    fn motion(t: f64) -> (Vector3<f64>, Vector3<f64>, UnitQuaternion<f64>, Vector3<f64>) {
        let waves = [(0.5, 2.6, 0.0), (0.4, 3.1, 1.0), (0.2, 1.7, 2.0)];
        let part = |derivative: u32, at: f64| {
            Vector3::from_iterator(waves.iter().map(|(size, w, phase)| {
                let angle = w * at + phase + f64::from(derivative) * std::f64::consts::FRAC_PI_2;
                size * w.powi(derivative.cast_signed()) * angle.sin()
            }))
        };
        let attitude = |at: f64| {
            let up = part(2, at) + Vector3::z() * GRAVITY + part(1, at) * 0.3;
            let yaw = 1.2 * (2.3 * at).sin();
            let tilted = UnitQuaternion::rotation_between(&Vector3::z(), &up).unwrap();
            tilted * UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw)
        };
        let (before, after) = (attitude(t - 1e-4), attitude(t + 1e-4));
        (part(0, t), part(1, t), attitude(t), (before.inverse() * after).scaled_axis() / 2e-4)
    }

    /// Returns the recorded flight of a drone whose markers and onboard sensors have errors.
    fn recorded(shift: f64, tilt: [f64; 2], offset: Vector3<f64>, noise: f64) -> Flight {
        let turned = UnitQuaternion::from_scaled_axis(Vector3::new(tilt[0], tilt[1], 0.0));
        let mut random = 1_u64;
        let mut draw = || {
            random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (random >> 11) as f64 / 2.0_f64.powi(52) - 1.0
        };
        let mut vector = |size: f64| Vector3::new(draw(), draw(), draw()) * size * noise;
        let rows = 1500;
        let mut flight = Flight {
            name: "curve".into(),
            start: 0.0,
            step: 0.01,
            position: Vec::new(),
            attitude: Vec::new(),
            velocity: Vec::new(),
            body_rate: None,
            acceleration: None,
            duty: Some((0..rows).map(|row| [(0.01 * f64::from(row) - shift).sin().abs(); 4]).collect()),
            voltage: None,
        };
        let mut gyro = Vec::new();
        for row in 0..rows {
            let t = 0.01 * f64::from(row);
            let (position, velocity, attitude, rate) = motion(t);
            flight.position.push(position + attitude * offset + vector(2e-4));
            flight.velocity.push(velocity + attitude * rate.cross(&offset) + vector(3e-3));
            flight.attitude.push(attitude * turned * UnitQuaternion::from_scaled_axis(vector(2e-3)));
            gyro.push(motion(t - shift).3 + Vector3::new(0.01, -0.02, 0.005) + vector(0.1));
        }
        flight.body_rate = Some(gyro);
        flight
    }

    #[test]
    fn an_aligned_flight_is_unchanged() {
        for noise in [0.0, 1.0] {
            let flight = recorded(0.0, [0.0; 2], Vector3::zeros(), noise);
            let (alignment, corrected) = align(&flight);
            assert!(alignment.applied.is_zero(), "{alignment:?}");
            assert_eq!(corrected, flight);
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]

        #[test]
        fn shift_tilt_and_offset_are_found_and_removed(
            shift in -0.2..0.2_f64, tilt in prop::array::uniform2(-0.03..0.03_f64),
            offset in prop::array::uniform3(-0.03..0.03_f64), noise in 0.0..1.0_f64,
        ) {
            let offset = Vector3::from(offset);
            let (alignment, corrected) = align(&recorded(shift, tilt, offset, noise));
            let onboard = alignment.onboard_shift.unwrap();
            prop_assert!((onboard.value - shift).abs() < 3e-4 + 4.0 * onboard.error, "{onboard:?} {shift}");
            prop_assert!(onboard.error < 5e-4, "{onboard:?}");
            for (found, truth) in alignment.tilt.iter().zip(tilt) {
                prop_assert!((found.value - truth).abs() < 5e-4 + 4.0 * found.error, "{found:?} {truth}");
                prop_assert!(found.error < 1e-3, "{found:?}");
            }
            for (found, truth) in alignment.offset.iter().zip(offset.iter()) {
                prop_assert!((found.value - truth).abs() < 5e-4 + 4.0 * found.error, "{found:?} {truth}");
                prop_assert!(found.error < 2e-3, "{found:?}");
            }
            // rows away from the ends, where the shift has no samples
            let mut worst = [0.0_f64; 3];
            for row in 50..1450 {
                let (position, _, attitude, rate) = motion(0.01 * row as f64);
                worst[0] = worst[0].max((corrected.position[row] - position).norm());
                worst[1] = worst[1].max(corrected.attitude[row].angle_to(&attitude));
                worst[2] = worst[2].max((corrected.body_rate.as_ref().unwrap()[row] - rate).norm());
            }
            prop_assert!(worst[0] < 9e-3 && worst[1] < 0.015 && worst[2] < 0.3, "{worst:?}");
            let duty = corrected.duty.unwrap()[700][0];
            prop_assert!((duty - 7.0_f64.sin().abs()).abs() < 3e-3);
        }
    }

    #[test]
    fn a_short_or_still_flight_has_no_estimate_and_no_correction() {
        let mut still = recorded(0.05, [0.01, 0.0], Vector3::z() * 0.01, 1.0);
        still.attitude.fill(UnitQuaternion::identity());
        still.position.fill(Vector3::z());
        still.velocity.fill(Vector3::zeros());
        still.body_rate.as_mut().unwrap().fill(Vector3::zeros());
        let (alignment, corrected) = align(&still);
        assert!(alignment.applied.is_zero() && corrected == still, "{alignment:?}");
        let Flight { position, velocity, attitude, .. } = &mut still;
        position.truncate(20);
        velocity.truncate(20);
        attitude.truncate(20);
        still.body_rate = None;
        still.duty = None;
        assert!(align(&still).0.applied.is_zero());
    }
}
