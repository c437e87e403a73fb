//! Estimator of the state and of disturbances from the rows of a flight, one row at a time.
//!
//! A Kalman filter per axis of the body frame estimates the translation. Its states are position, velocity, a slow
//! disturbance of the acceleration (random walk) and a fast one (stationary, relaxing); its measurements are position
//! and velocity. The rotation starts from the measured attitude and body rate, because smoothing them does not improve
//! predictions. Of the angular acceleration, a filter per axis estimates a slow and a fast disturbance from the changes
//! of the body rate that the model does not explain.
//!
//! The model of the motion is that of the prediction, so that the disturbances are what the airframe lacks: trim
//! torque, thrust error, tilt error of the attitude, wind.
//!
//! [`Observer::advance`] receives the rows in their order. An estimate therefore depends on no later row.

use super::dynamics::{Disturbance, Dynamics, FastStep, between};
use crate::math::{Real, V3, exp_of_negative};
use crate::state::FlightState;

/// Settings of the filter of the translation along one axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TranslationFilter {
    /// Standard deviation of a measured position, m.
    pub position_error: f64,
    /// Standard deviation of a measured velocity, m/s.
    pub velocity_error: f64,
    /// Noise density of the velocity, m/s/√s.
    pub velocity_noise: f64,
    /// Noise density of the slow disturbance, m/s²/√s.
    pub slow_noise: f64,
    /// Standard deviation of the slow disturbance before the first row, m/s².
    pub slow_deviation: f64,
    /// Standard deviation of the fast disturbance, m/s².
    pub fast_deviation: f64,
    /// Time constant of the fast disturbance, s.
    pub fast_time: f64,
}

/// Settings of the filter of the rotation about one axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RotationFilter {
    /// Noise density of the body rate, rad/s/√s.
    pub rate_noise: f64,
    /// Noise density of the slow disturbance, rad/s²/√s.
    pub slow_noise: f64,
    /// Standard deviation of the slow disturbance before the first row, rad/s².
    pub slow_deviation: f64,
    /// Standard deviation of the fast disturbance, rad/s².
    pub fast_deviation: f64,
    /// Time constant of the fast disturbance, s.
    pub fast_time: f64,
}

/// Settings of the estimator.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ObserverParams {
    /// Translation along body x and y.
    pub level: TranslationFilter,
    /// Translation along body z.
    pub vertical: TranslationFilter,
    /// Rotation about body x and y.
    pub roll_pitch: RotationFilter,
    /// Rotation about body z.
    pub yaw: RotationFilter,
}

impl Default for ObserverParams {
    /// Settings for motion capture at 100 Hz and a small quadrotor indoors, from recorded flights of a Crazyflie 2.1.
    fn default() -> Self {
        Self {
            level: TranslationFilter {
                position_error: 1e-3,
                velocity_error: 1e-3,
                velocity_noise: 1e-3,
                slow_noise: 3e-5,
                slow_deviation: 0.2,
                fast_deviation: 0.01,
                fast_time: 0.64,
            },
            vertical: TranslationFilter {
                position_error: 3.2e-4,
                velocity_error: 3e-3,
                velocity_noise: 0.23,
                slow_noise: 0.32,
                slow_deviation: 0.5,
                fast_deviation: 0.74,
                fast_time: 0.35,
            },
            roll_pitch: RotationFilter {
                rate_noise: 0.1,
                slow_noise: 9.0,
                slow_deviation: 16.0,
                fast_deviation: 28.0,
                fast_time: 0.09,
            },
            yaw: RotationFilter {
                rate_noise: 0.1,
                slow_noise: 0.03,
                slow_deviation: 6.3,
                fast_deviation: 0.0,
                fast_time: 0.09,
            },
        }
    }
}

/// Number of states of the filter of the translation: position, velocity, slow and fast disturbance.
const STATES: usize = 4;

/// Gains of the filter of the translation at one row: the change of every state per deviation of the position and of
/// the velocity.
pub(crate) type Gain<R = f64> = [[R; 2]; STATES];

/// Gains of the filter of the rotation at one row: the changes of the slow and of the fast disturbance per deviation of
/// the angular acceleration.
pub(crate) type RotationGain<R = f64> = [R; 2];

fn square(x: f64) -> f64 {
    x * x
}

impl TranslationFilter {
    /// Returns the gains at `rows` rows that are `step` seconds apart. `damping` is the rate at which the drag slows
    /// the velocity down, 1/s.
    fn gains(&self, rows: usize, step: f64, damping: f64) -> Vec<Gain> {
        let decay = (-step / self.fast_time).exp();
        let by_force = 0.5 * step * step;
        let f = [
            [1.0, step, by_force, by_force],
            [0.0, (-damping * step).exp(), step, step],
            [0.0, 0.0, 1.0, 0.0],
            [0.0, 0.0, 0.0, decay],
        ];
        let (position, velocity) = (square(self.position_error), square(self.velocity_error));
        let fast = square(self.fast_deviation);
        let mut p: Matrix = [[0.0; STATES]; STATES];
        for (index, start) in [position, 4.0 * velocity, square(self.slow_deviation), fast].into_iter().enumerate() {
            p[index][index] = start;
        }
        let gain_at = |row: usize| {
            if row > 0 {
                p = product(&product(&f, &p), &transposed(&f));
                p[1][1] += square(self.velocity_noise) * step;
                p[2][2] += square(self.slow_noise) * step;
                // the noise that keeps the fast disturbance stationary
                p[3][3] += fast * (1.0 - decay * decay);
            }
            let (s00, s01, s11) = (p[0][0] + position, p[0][1], p[1][1] + velocity);
            let determinant = s00 * s11 - s01 * s01;
            let gain =
                p.map(|of| [(of[0] * s11 - of[1] * s01) / determinant, (of[1] * s00 - of[0] * s01) / determinant]);
            let before = p;
            let change = |i: usize, j: usize| gain[i][0] * before[0][j] + gain[i][1] * before[1][j];
            // the mean of both triangles stays symmetric
            p = std::array::from_fn(|i| std::array::from_fn(|j| before[i][j] - 0.5 * (change(i, j) + change(j, i))));
            gain
        };
        (0..rows).map(gain_at).collect()
    }
}

impl RotationFilter {
    /// Returns the gains at `rows` rows that are `step` seconds apart.
    fn gains(&self, rows: usize, step: f64) -> Vec<RotationGain> {
        let decay = (-step / self.fast_time).exp();
        let fast = square(self.fast_deviation);
        // variances of the slow and of the fast disturbance, and their covariance
        let [mut slow_p, mut fast_p, mut both_p] = [square(self.slow_deviation), fast, 0.0];
        let gain_at = |row: usize| {
            if row == 0 {
                // the first row has no change of the body rate
                return [0.0; 2];
            }
            slow_p += square(self.slow_noise) * step;
            fast_p = fast_p * decay * decay + fast * (1.0 - decay * decay);
            both_p *= decay;
            let [slow_s, fast_s] = [slow_p + both_p, fast_p + both_p];
            let total = slow_s + fast_s + square(self.rate_noise) / step;
            let gain = [slow_s / total, fast_s / total];
            slow_p -= gain[0] * slow_s;
            both_p -= gain[0] * fast_s;
            fast_p -= gain[1] * fast_s;
            gain
        };
        (0..rows).map(gain_at).collect()
    }
}

type Matrix = [[f64; STATES]; STATES];

fn product(a: &Matrix, b: &Matrix) -> Matrix {
    let entry = |i: usize, j: usize| (0..STATES).map(|k| a[i][k] * b[k][j]).sum();
    std::array::from_fn(|i| std::array::from_fn(|j| entry(i, j)))
}

fn transposed(a: &Matrix) -> Matrix {
    std::array::from_fn(|i| std::array::from_fn(|j| a[j][i]))
}

/// Gains at one row, scalar or SIMD.
#[derive(Debug, Clone, Copy)]
pub(crate) struct RowGains<R> {
    /// Translation along body x and y, and along body z.
    pub translation: [Gain<R>; 2],
    /// Rotation about body x and y, and about body z.
    pub rotation: [RotationGain<R>; 2],
}

/// Factors of the fast disturbances over a time, scalar or SIMD.
#[derive(Debug, Clone, Copy)]
pub(crate) struct FastSteps<R> {
    /// Factors for the translation.
    pub translation: FastStep<R>,
    /// Factors for the rotation.
    pub rotation: FastStep<R>,
}

impl ObserverParams {
    /// Returns the gains of an airframe at `rows` rows that are `step` seconds apart.
    pub(crate) fn gains(&self, dynamics: &Dynamics, rows: usize, step: f64) -> Vec<RowGains<f64>> {
        let drag = dynamics.effects.linear_drag.map(|drag| drag / dynamics.mass);
        let level = self.level.gains(rows, step, drag[0]);
        let vertical = self.vertical.gains(rows, step, drag[2]);
        let (roll_pitch, yaw) = (self.roll_pitch.gains(rows, step), self.yaw.gains(rows, step));
        let row =
            |row: usize| RowGains { translation: [level[row], vertical[row]], rotation: [roll_pitch[row], yaw[row]] };
        (0..rows).map(row).collect()
    }

    /// Returns the factors of the fast disturbances over a time, s.
    pub(crate) fn fast_steps(&self, time: f64) -> FastSteps<f64> {
        let decay = |constant: f64| (-time / constant).exp();
        FastSteps {
            translation: FastStep { level: decay(self.level.fast_time), vertical: decay(self.vertical.fast_time) },
            rotation: FastStep { level: decay(self.roll_pitch.fast_time), vertical: decay(self.yaw.fast_time) },
        }
    }
}

/// Estimate of the state and of the disturbances at a row, scalar or SIMD.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Estimate<R = f64> {
    /// State.
    pub state: FlightState<R>,
    /// Disturbance of the acceleration, body frame, m/s².
    pub translation: Disturbance<R>,
    /// Disturbance of the angular acceleration, body frame, rad/s².
    pub rotation: Disturbance<R>,
}

/// The estimator, scalar or SIMD.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Observer<R = f64> {
    /// Estimate at the last row.
    estimate: Estimate<R>,
    /// Measured state at the last row.
    measured: FlightState<R>,
}

impl<R: Real> Observer<R> {
    /// Creates the estimator at the first row.
    #[inline(always)]
    pub fn new(measured: &FlightState<R>) -> Self {
        let none = Disturbance::zero(measured.position.x);
        let estimate = Estimate { state: *measured, translation: none, rotation: none };
        Self { estimate, measured: *measured }
    }

    /// Returns the estimate at the last row.
    #[inline(always)]
    pub fn estimate(&self) -> &Estimate<R> {
        &self.estimate
    }

    /// Advances by one row. `speeds` has the rotor speeds (rpm) at the starts of the physics steps since the last row
    /// and at this row, `fast` the factors over a row, and `measured` the measured state at this row.
    #[inline(always)]
    pub fn advance(
        &mut self,
        dynamics: &Dynamics<R>,
        speeds: &[[R; 4]],
        fast: &FastSteps<R>,
        gains: &RowGains<R>,
        measured: &FlightState<R>,
    ) {
        let Estimate { state, translation, rotation } = &mut self.estimate;
        let steps = (speeds.len() - 1) as f64;
        let acceleration = translation.total();
        let none = V3::zero(measured.position.x);
        let mut moved = (state.position, state.velocity);
        let mut turned = self.measured;
        for (index, pair) in speeds.windows(2).enumerate() {
            let part = (index as f64 + 0.5) / steps;
            let attitude = between(&self.measured.attitude, &measured.attitude, part);
            moved = dynamics.translate([&pair[0], &pair[1]], &attitude, acceleration, moved);
            turned = dynamics.fly([&pair[0], &pair[1]], acceleration, none, &turned);
        }
        translation.advance(&fast.translation);
        rotation.advance(&fast.rotation);

        let frame = &measured.attitude;
        let off = frame.back(measured.position - moved.0);
        let slip = frame.back(measured.velocity - moved.1);
        translation.slow = translation.slow + corrections(&gains.translation, 2, off, slip);
        translation.fast = translation.fast + corrections(&gains.translation, 3, off, slip);
        let unexplained = mean_acceleration(dynamics, measured.rate - turned.rate, dynamics.dt * steps);
        // the filter neglects the ratio of the thrust to the weight
        let deviation = unexplained - rotation.total();
        let [level, vertical] = gains.rotation;
        rotation.slow = rotation.slow + deviation.times(V3::new(level[0], level[0], vertical[0]));
        rotation.fast = rotation.fast + deviation.times(V3::new(level[1], level[1], vertical[1]));
        *state = FlightState {
            position: moved.0 + frame.forth(corrections(&gains.translation, 0, off, slip)),
            velocity: moved.1 + frame.forth(corrections(&gains.translation, 1, off, slip)),
            ..*measured
        };
        self.measured = *measured;
    }
}

/// Returns the constant angular acceleration that changes the body rate by `change` in `time` seconds against the
/// damping of the airframe: change / (t·(1 − e^(−x))/x) with x = damping·t.
#[inline(always)]
fn mean_acceleration<R: Real>(dynamics: &Dynamics<R>, change: V3<R>, time: f64) -> V3<R> {
    let ([dx, dy, dz], [jx, jy, jz]) = (dynamics.effects.rotational_damping, dynamics.inertia);
    V3::new(
        change.x / (shortened(dx / jx * time) * time),
        change.y / (shortened(dy / jy * time) * time),
        change.z / (shortened(dz / jz * time) * time),
    )
}

/// Returns (1 − e^(−x))/x, by its series with an error below 2e-4 for x from 0 to 1.
#[inline(always)]
fn shortened<R: Real>(x: R) -> R {
    let one = x.all(1.0);
    let inner = one - x * (one - x * (1.0 / 6.0)) * (1.0 / 5.0);
    let series = one - x * (one - x * (one - x * inner * (1.0 / 4.0)) * (1.0 / 3.0)) * (1.0 / 2.0);
    let is_large = one.less(x);
    if R::any(is_large) { R::choose(is_large, (one - exp_of_negative(-x)) / x, series) } else { series }
}

/// Returns the corrections of a state of the three axes of the translation, body frame.
#[inline(always)]
fn corrections<R: Real>([level, vertical]: &[Gain<R>; 2], state: usize, off: V3<R>, slip: V3<R>) -> V3<R> {
    let ([a, b], [c, d]) = (level[state], vertical[state]);
    V3::new(a * off.x + b * slip.x, a * off.y + b * slip.y, c * off.z + d * slip.z)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{DMatrix, DVector};

    /// Returns the mean of the last state of a linear Gaussian model given all measurements, by the joint covariance.
    fn batch(
        f: &DMatrix<f64>,
        q: &DMatrix<f64>,
        h: &DMatrix<f64>,
        r: &DMatrix<f64>,
        start: &DMatrix<f64>,
        measured: &[DVector<f64>],
    ) -> DVector<f64> {
        let (states, outputs, count) = (f.nrows(), h.nrows(), measured.len());
        // covariance of the states at every time
        let mut variance = vec![start.clone()];
        for k in 1..count {
            variance.push(f * &variance[k - 1] * f.transpose() + q);
        }
        let power = |n: usize| (0..n).fold(DMatrix::identity(states, states), |power, _| f * power);
        let covariance = |i: usize, j: usize| {
            if i >= j { power(i - j) * &variance[j] } else { &variance[i] * power(j - i).transpose() }
        };
        let mut joint = DMatrix::zeros(outputs * count, outputs * count);
        let mut cross = DMatrix::zeros(states, outputs * count);
        for i in 0..count {
            for j in 0..count {
                let mut block = h * covariance(i, j) * h.transpose();
                if i == j {
                    block += r;
                }
                joint.view_mut((outputs * i, outputs * j), (outputs, outputs)).copy_from(&block);
            }
            let block = covariance(count - 1, i) * h.transpose();
            cross.view_mut((0, outputs * i), (states, outputs)).copy_from(&block);
        }
        let stacked = DVector::from_iterator(outputs * count, measured.iter().flat_map(|y| y.iter().copied()));
        cross * joint.lu().solve(&stacked).unwrap()
    }

    #[test]
    fn gains_of_the_translation_are_those_of_the_optimal_filter() {
        let params = ObserverParams::default().vertical;
        let (step, damping) = (0.01, 0.7);
        let decay = (-step / params.fast_time).exp();
        let half = 0.5 * step * step;
        #[rustfmt::skip]
        let f = DMatrix::from_row_slice(4, 4, &[
            1.0, step, half, half,
            0.0, (-damping * step).exp(), step, step,
            0.0, 0.0, 1.0, 0.0,
            0.0, 0.0, 0.0, decay,
        ]);
        let diagonal = |numbers: &[f64]| DMatrix::from_diagonal(&DVector::from_row_slice(numbers));
        let fast = square(params.fast_deviation);
        let q = diagonal(&[
            0.0,
            square(params.velocity_noise) * step,
            square(params.slow_noise) * step,
            fast * (1.0 - decay * decay),
        ]);
        let (p, v) = (square(params.position_error), square(params.velocity_error));
        let start = diagonal(&[p, 4.0 * v, square(params.slow_deviation), fast]);
        let h = DMatrix::from_row_slice(2, 4, &[1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0]);
        let rows = 12;
        let measured: Vec<_> = (0..rows)
            .map(|k| DVector::from_row_slice(&[1e-3 * (1.7 * k as f64).sin(), 1e-2 * (2.3 * k as f64).cos()]))
            .collect();
        let gains = params.gains(rows, step, damping);
        let mut x = DVector::zeros(4);
        for (k, y) in measured.iter().enumerate() {
            if k > 0 {
                x = &f * x;
            }
            let deviation = y - &h * &x;
            for (state, gain) in x.iter_mut().zip(&gains[k]) {
                *state += gain[0] * deviation[0] + gain[1] * deviation[1];
            }
        }
        let expected = batch(&f, &q, &h, &diagonal(&[p, v]), &start, &measured);
        for (found, expected) in x.iter().zip(&expected) {
            assert!((found - expected).abs() < 1e-9 * (1.0 + expected.abs()), "{x} {expected}");
        }
    }

    #[test]
    fn gains_of_the_rotation_are_those_of_the_optimal_filter() {
        let params = ObserverParams::default().roll_pitch;
        let step = 0.01;
        let decay = (-step / params.fast_time).exp();
        let fast = square(params.fast_deviation);
        let diagonal = |numbers: &[f64]| DMatrix::from_diagonal(&DVector::from_row_slice(numbers));
        let f = diagonal(&[1.0, decay]);
        let q = diagonal(&[square(params.slow_noise) * step, fast * (1.0 - decay * decay)]);
        let start = diagonal(&[square(params.slow_deviation), fast]);
        let (h, r) = (DMatrix::from_row_slice(1, 2, &[1.0, 1.0]), diagonal(&[square(params.rate_noise) / step]));
        let rows = 15;
        let gains = params.gains(rows, step);
        assert_eq!(gains[0], [0.0; 2], "the first row has no measurement");
        let (mut x, mut measured) = (DVector::zeros(2), Vec::new());
        for gain in &gains[1..] {
            let y = 10.0 * (3.1 * measured.len() as f64).sin() + 4.0;
            measured.push(DVector::from_row_slice(&[y]));
            x = &f * x;
            let deviation = y - x[0] - x[1];
            x += DVector::from_row_slice(gain) * deviation;
        }
        // the prior is that before the first row
        let before = &f * start * f.transpose() + &q;
        let expected = batch(&f, &q, &h, &r, &before, &measured);
        assert!((&x - &expected).norm() < 1e-9 * expected.norm(), "{x} {expected}");
    }

    #[test]
    fn the_series_of_a_shortened_response_is_accurate() {
        for x in [1e-9, 0.01, 0.3, 0.7, 1.0_f64] {
            assert!((shortened(x) / (-(-x).exp_m1() / x) - 1.0).abs() < 3e-4, "{x}");
        }
        assert_eq!(shortened(0.0), 1.0);
    }
}
