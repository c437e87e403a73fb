//! Estimator of the state and of disturbances from the rows of a flight, one row at a time.
//!
//! A Kalman filter per axis of the body frame has the states position, velocity, a slow disturbance (random walk) and a
//! fast disturbance (stationary, relaxing or oscillating). Its measurements are the position and the velocity. The same
//! filter with an attitude error, a body rate and disturbances of the angular acceleration estimates the rotation. The
//! model of the motion is that of the prediction, so that the disturbances are what the airframe lacks: trim torque,
//! thrust error, wind.
//!
//! [`Observer::advance`] receives the rows in their order. An estimate therefore depends on no later row.

use super::dynamics::{Disturbance, Dynamics, FastStep, between};
use crate::engine::flight::{rotated, rotation as rotation_by};
use crate::math::{Real, V3};
use crate::state::FlightState;

/// Model of the fast part of a disturbance: a stationary random process.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum FastModel {
    /// Exponential relaxation.
    Relaxation {
        /// Time constant, s.
        time: f64,
    },
    /// Damped oscillation.
    Oscillation {
        /// Angular frequency without damping, rad/s.
        frequency: f64,
        /// Damping ratio, 0 to 1.
        damping: f64,
    },
}

impl FastModel {
    /// Returns the transition of (fast, swing) over a time (s) as `[a, b, c, d]`.
    pub(crate) fn transition(self, time: f64) -> [f64; 4] {
        match self {
            Self::Relaxation { time: constant } => [(-time / constant).exp(), 0.0, 0.0, 0.0],
            Self::Oscillation { frequency, damping } => {
                let root = (1.0 - damping * damping).sqrt();
                let (sin, cos) = (frequency * root * time).sin_cos();
                let (sin, decay) = (sin / root, (-damping * frequency * time).exp());
                [decay * (cos + damping * sin), decay * sin, -decay * sin, decay * (cos - damping * sin)]
            }
        }
    }
}

/// Settings of the filter of one axis. Position, velocity and acceleration are in m, m/s and m/s² for the translation,
/// and an angle, a body rate and an angular acceleration in rad, rad/s and rad/s² for the rotation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FilterParams {
    /// Noise density of the velocity, per √s.
    pub velocity_noise: f64,
    /// Noise density of the slow disturbance, per √s.
    pub slow_noise: f64,
    /// Standard deviation of the slow disturbance before the first row.
    pub slow_deviation: f64,
    /// Standard deviation of the fast disturbance.
    pub fast_deviation: f64,
    /// Model of the fast disturbance.
    pub fast: FastModel,
    /// Standard deviation of a measured position.
    pub position_error: f64,
    /// Standard deviation of a measured velocity.
    pub velocity_error: f64,
}

/// Settings of the estimator.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ObserverParams {
    /// Translation along body x and y.
    pub level: FilterParams,
    /// Translation along body z.
    pub vertical: FilterParams,
    /// Rotation about body x and y.
    pub roll_pitch: FilterParams,
    /// Rotation about body z.
    pub yaw: FilterParams,
}

/// Number of states of the filter of an axis: position, velocity, slow, fast, swing.
const STATES: usize = 5;

/// Gains of a filter at one row: the change of every state per deviation of the position and of the velocity.
pub(crate) type Gain<R = f64> = [[R; 2]; STATES];

impl FilterParams {
    /// Returns the gains at `rows` rows that are `step` seconds apart. `damping` is the rate at which the model slows
    /// the velocity down, 1/s.
    pub(crate) fn gains(&self, rows: usize, step: f64, damping: f64) -> Vec<Gain> {
        let square = |x: f64| x * x;
        let [a, b, c, d] = self.fast.transition(step);
        let mut f = [[0.0; STATES]; STATES];
        f[0] = [1.0, step, 0.5 * step * step, 0.5 * step * step, 0.0];
        f[1] = [0.0, (-damping * step).exp(), step, step, 0.0];
        f[2][2] = 1.0;
        (f[3][3], f[3][4], f[4][3], f[4][4]) = (a, b, c, d);
        let variance = square(self.fast_deviation);
        let (position, velocity) = (square(self.position_error), square(self.velocity_error));
        let mut p = [[0.0; STATES]; STATES];
        for (index, start) in
            [position, 4.0 * velocity, square(self.slow_deviation), variance, variance].into_iter().enumerate()
        {
            p[index][index] = start;
        }
        (0..rows)
            .map(|row| {
                if row > 0 {
                    p = product(&product(&f, &p), &transposed(&f));
                    p[1][1] += square(self.velocity_noise) * step;
                    p[2][2] += square(self.slow_noise) * step;
                    // the noise that keeps the fast part stationary
                    p[3][3] += variance * (1.0 - a * a - b * b);
                    p[4][4] += variance * (1.0 - c * c - d * d);
                    p[3][4] -= variance * (a * c + b * d);
                    p[4][3] -= variance * (a * c + b * d);
                }
                let (s00, s01, s11) = (p[0][0] + position, p[0][1], p[1][1] + velocity);
                let determinant = s00 * s11 - s01 * s01;
                let gain =
                    p.map(|of| [(of[0] * s11 - of[1] * s01) / determinant, (of[1] * s00 - of[0] * s01) / determinant]);
                let before = p;
                for i in 0..STATES {
                    for j in 0..STATES {
                        let change = |i: usize, j: usize| gain[i][0] * before[0][j] + gain[i][1] * before[1][j];
                        // the mean of both triangles stays symmetric
                        p[i][j] = before[i][j] - 0.5 * (change(i, j) + change(j, i));
                    }
                }
                gain
            })
            .collect()
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

/// Gains at one row and transitions of the fast disturbances over a row, scalar or SIMD.
#[derive(Debug, Clone, Copy)]
pub(crate) struct RowGains<R> {
    /// Translation along body x and y, and along body z.
    pub translation: [Gain<R>; 2],
    /// Rotation about body x and y, and about body z.
    pub rotation: [Gain<R>; 2],
}

/// Transitions of the fast disturbances over a time, scalar or SIMD.
#[derive(Debug, Clone, Copy)]
pub(crate) struct FastSteps<R> {
    /// Transition for the translation.
    pub translation: FastStep<R>,
    /// Transition for the rotation.
    pub rotation: FastStep<R>,
}

impl ObserverParams {
    /// Returns the gains of an airframe at `rows` rows that are `step` seconds apart.
    pub(crate) fn gains(&self, dynamics: &Dynamics, rows: usize, step: f64) -> Vec<RowGains<f64>> {
        let (drag, damping) = (dynamics.effects.linear_drag, dynamics.effects.rotational_damping);
        let (mass, inertia) = (dynamics.mass, dynamics.inertia);
        let level = self.level.gains(rows, step, drag[0] / mass);
        let vertical = self.vertical.gains(rows, step, drag[2] / mass);
        let roll_pitch = self.roll_pitch.gains(rows, step, damping[0] / inertia[0]);
        let yaw = self.yaw.gains(rows, step, damping[2] / inertia[2]);
        let row =
            |row: usize| RowGains { translation: [level[row], vertical[row]], rotation: [roll_pitch[row], yaw[row]] };
        (0..rows).map(row).collect()
    }

    /// Returns the transitions of the fast disturbances over a time, s.
    pub(crate) fn fast_steps(&self, time: f64) -> FastSteps<f64> {
        let step = |level: &FilterParams, vertical: &FilterParams| FastStep {
            level: level.fast.transition(time),
            vertical: vertical.fast.transition(time),
        };
        FastSteps { translation: step(&self.level, &self.vertical), rotation: step(&self.roll_pitch, &self.yaw) }
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
    /// and at this row, `fast` the transitions over a row, and `measured` the measured state at this row.
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
        let (acceleration, angular) = (translation.total(), rotation.total());
        let mut moved = (state.position, state.velocity);
        // the rotation has the measured velocity, and the translation the measured attitude
        let mut turned = FlightState { velocity: self.measured.velocity, ..*state };
        for (index, pair) in speeds.windows(2).enumerate() {
            let part = (index as f64 + 0.5) / steps;
            let attitude = between(&self.measured.attitude, &measured.attitude, part);
            moved = dynamics.translate([&pair[0], &pair[1]], &attitude, acceleration, moved);
            turned.velocity = self.measured.velocity;
            turned = dynamics.fly([&pair[0], &pair[1]], acceleration, angular, &turned);
        }
        translation.advance(&fast.translation);
        rotation.advance(&fast.rotation);

        let frame = &measured.attitude;
        let off = frame.back(measured.position - moved.0);
        let slip = frame.back(measured.velocity - moved.1);
        let [position, velocity] = correct(translation, &gains.translation, off, slip);
        state.position = moved.0 + frame.forth(position);
        state.velocity = moved.1 + frame.forth(velocity);

        let turn = turned.attitude.turn_to(&measured.attitude);
        let zero = turn.w.all(0.0);
        let off = V3::choose(turn.w.less(zero), -turn.v, turn.v) * 2.0;
        let [angle, rate] = correct(rotation, &gains.rotation, off, measured.rate - turned.rate);
        state.attitude = rotated(&turned.attitude, &rotation_by(angle));
        state.rate = turned.rate + rate;
        self.measured = *measured;
    }
}

/// Corrects a disturbance and returns the corrections of position and velocity, all in the body frame.
#[inline(always)]
fn correct<R: Real>(disturbance: &mut Disturbance<R>, gains: &[Gain<R>; 2], off: V3<R>, slip: V3<R>) -> [V3<R>; 2] {
    disturbance.slow = disturbance.slow + corrections(gains, 2, off, slip);
    disturbance.fast = disturbance.fast + corrections(gains, 3, off, slip);
    disturbance.swing = disturbance.swing + corrections(gains, 4, off, slip);
    [corrections(gains, 0, off, slip), corrections(gains, 1, off, slip)]
}

/// Returns the correction of a state of the three axes.
#[inline(always)]
fn corrections<R: Real>([level, vertical]: &[Gain<R>; 2], state: usize, off: V3<R>, slip: V3<R>) -> V3<R> {
    let ([a, b], [c, d]) = (level[state], vertical[state]);
    V3::new(a * off.x + b * slip.x, a * off.y + b * slip.y, c * off.z + d * slip.z)
}

impl Default for ObserverParams {
    /// Settings for motion capture at 100 Hz and a small quadrotor indoors: maximum accuracy on recorded flights of a
    /// Crazyflie 2.1.
    fn default() -> Self {
        let relaxation = |time: f64| FastModel::Relaxation { time };
        Self {
            level: FilterParams {
                velocity_noise: 8.6e-4,
                slow_noise: 1.8e-4,
                slow_deviation: 0.2,
                fast_deviation: 0.01,
                fast: relaxation(0.58),
                position_error: 1e-3,
                velocity_error: 1e-3,
            },
            vertical: FilterParams {
                velocity_noise: 0.23,
                slow_noise: 0.36,
                slow_deviation: 0.5,
                fast_deviation: 0.75,
                fast: relaxation(0.28),
                position_error: 3.7e-4,
                velocity_error: 6.2e-4,
            },
            roll_pitch: FilterParams {
                velocity_noise: 0.013,
                slow_noise: 1.6,
                slow_deviation: 16.0,
                fast_deviation: 5.8,
                fast: relaxation(0.094),
                position_error: 1e-6,
                velocity_error: 1e-6,
            },
            yaw: FilterParams {
                velocity_noise: 0.081,
                slow_noise: 0.12,
                slow_deviation: 6.3,
                fast_deviation: 196.0,
                fast: relaxation(0.0445),
                position_error: 1e-6,
                velocity_error: 1e-6,
            },
        }
    }
}
