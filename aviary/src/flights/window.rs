//! Windows of a flight in which predictions are compared with it, and the naive prediction.

use nalgebra::{UnitQuaternion, Vector3};

use super::{Flight, FlightError};
use crate::state::DroneState;

/// Horizons of a prediction, s.
pub const HORIZONS: [f64; 4] = [0.1, 0.25, 0.5, 1.0];

/// Start of the first window and time between the starts of windows, s.
const FIRST_START: f64 = 3.0;
const BETWEEN_STARTS: f64 = 0.5;

/// Shortest time between the first row of a flight and the start of a window, s.
const MIN_PAST: f64 = 1.0;

/// A window of a flight: a start t0, and an end at every one of the [`HORIZONS`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Window {
    /// Start t0, s.
    pub t0: f64,
    /// Row at the start.
    pub row: usize,
    /// Row at every horizon.
    pub ends: [usize; HORIZONS.len()],
    /// False for a horizon that starts or ends near a [glitch](Flight::glitches): it has no error.
    pub is_valid: [bool; HORIZONS.len()],
}

impl Window {
    /// Returns the windows of a flight: t0 = 3.0 s, 3.5 s, 4.0 s, … while t0 + 1.0 s is within the flight, and not
    /// earlier than 1 s after the first row.
    ///
    /// # Errors
    /// [`FlightError::Windows`] for a flight that is shorter than a window, or whose time step does not divide the
    /// horizons.
    pub fn of(flight: &Flight) -> Result<Vec<Self>, FlightError> {
        let wrong = |message| FlightError::Windows { flight: flight.name.clone(), message };
        let rows = HORIZONS.map(|horizon| horizon / flight.step);
        if rows.iter().any(|rows| (rows - rows.round()).abs() > 0.01 || *rows < 0.5) {
            let step = crate::number(flight.step);
            return Err(wrong(format!("t has a step of {step} s, expected one that divides 0.05 s")));
        }
        let rows = rows.map(|rows| rows.round() as usize);
        let longest = rows[rows.len() - 1];
        let glitches = flight.glitches();
        // computed, because the first row may be at any time
        let skipped = (flight.start + MIN_PAST - 0.5 * flight.step - FIRST_START) / BETWEEN_STARTS;
        let skipped = skipped.ceil().max(0.0);
        let starts = (0_u32..).map(|index| FIRST_START + (skipped + f64::from(index)) * BETWEEN_STARTS);
        let end = flight.time(flight.rows() - 1) + 0.5 * flight.step;
        let windows: Vec<_> = starts
            .take_while(|t0| t0 + HORIZONS[HORIZONS.len() - 1] <= end)
            // the rows may be between the starts
            .map(|t0| (t0, ((t0 - flight.start) / flight.step).round() as usize))
            .filter(|(_, row)| row + longest < flight.rows())
            .map(|(t0, row)| {
                let ends = rows.map(|rows| row + rows);
                Self { t0, row, ends, is_valid: ends.map(|end| !glitches[row] && !glitches[end]) }
            })
            .collect();
        if windows.is_empty() {
            let (first, last) = (crate::number(flight.start), crate::number(flight.time(flight.rows() - 1)));
            return Err(wrong(format!("t from {first} to {last}, expected rows from 2 s to 4 s for one window")));
        }
        Ok(windows)
    }
}

/// A predicted state. The attitude and the body rate are `None` if the recorded attitude was an input.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Predicted {
    /// Position of the centre of mass, world frame, m.
    pub position: Vector3<f64>,
    /// Velocity of the centre of mass, world frame, m/s.
    pub velocity: Vector3<f64>,
    /// Rotation from the body to the world frame.
    pub attitude: Option<UnitQuaternion<f64>>,
    /// Body rate, body frame, rad/s.
    pub body_rate: Option<Vector3<f64>>,
}

impl Predicted {
    /// Returns true if every number is finite.
    pub fn is_finite(&self) -> bool {
        let attitude = self.attitude.is_none_or(|attitude| attitude.coords.iter().all(|x| x.is_finite()));
        let vectors = [Some(self.position), Some(self.velocity), self.body_rate];
        attitude && vectors.iter().flatten().flat_map(|vector| vector.iter()).all(|x| x.is_finite())
    }

    /// Creates a prediction of all quantities from a state.
    pub fn of(state: &DroneState) -> Self {
        Self {
            position: state.position,
            velocity: state.velocity,
            attitude: Some(state.attitude),
            body_rate: Some(state.angular_velocity),
        }
    }

    /// Returns the naive prediction: constant velocity and constant body rate for `horizon` seconds.
    ///
    /// ```
    /// use aviary::flights::Predicted;
    /// use aviary::state::DroneState;
    /// use nalgebra::Vector3;
    ///
    /// let turning = DroneState { angular_velocity: Vector3::new(0.0, 0.0, 2.0), ..DroneState::default() };
    /// let half_a_radian = Predicted::naive(&turning, 0.25).attitude.unwrap();
    /// assert!((half_a_radian.angle() - 0.5).abs() < 1e-12);
    /// ```
    pub fn naive(start: &DroneState, horizon: f64) -> Self {
        Self::of(&DroneState {
            position: start.position + start.velocity * horizon,
            attitude: start.attitude * UnitQuaternion::from_scaled_axis(start.angular_velocity * horizon),
            ..*start
        })
    }

    /// Returns the prediction without attitude and body rate.
    pub fn without_attitude(self) -> Self {
        Self { attitude: None, body_rate: None, ..self }
    }

    /// Returns the errors against a measured state.
    pub fn errors(&self, measured: &DroneState) -> Errors {
        Errors {
            position: (self.position - measured.position).norm(),
            velocity: (self.velocity - measured.velocity).norm(),
            attitude: self.attitude.map(|attitude| angle_between(&attitude, &measured.attitude)),
            body_rate: self.body_rate.map(|rate| (rate - measured.angular_velocity).norm()),
        }
    }
}

/// Errors of a prediction, or their means over windows.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Errors {
    /// Distance between the positions, m.
    pub position: f64,
    /// Norm of the velocity difference, m/s.
    pub velocity: f64,
    /// Angle of the rotation between the attitudes, rad; `None` if the attitude was an input.
    pub attitude: Option<f64>,
    /// Norm of the difference of the body rates, rad/s; `None` if the attitude was an input.
    pub body_rate: Option<f64>,
}

impl Errors {
    /// Returns a function of every error of two predictions.
    fn zip(&self, other: &Self, with: impl Fn(f64, f64) -> f64) -> Self {
        let both = |a: Option<f64>, b: Option<f64>| Some(with(a?, b?));
        Self {
            position: with(self.position, other.position),
            velocity: with(self.velocity, other.velocity),
            attitude: both(self.attitude, other.attitude),
            body_rate: both(self.body_rate, other.body_rate),
        }
    }
}

/// Returns the angle of the rotation between two attitudes, 0 to π, rad. It is exact for small angles, unlike the arc
/// cosine of the product.
fn angle_between(a: &UnitQuaternion<f64>, b: &UnitQuaternion<f64>) -> f64 {
    let turn = a.inverse() * b;
    2.0 * turn.imag().norm().atan2(turn.scalar().abs())
}

/// Errors of predictions at one horizon over several windows, next to those of the naive prediction.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Score {
    /// Number of windows.
    pub windows: usize,
    /// Sums of the errors.
    sum: Errors,
    naive: Errors,
}

impl Score {
    /// Score without windows.
    pub const EMPTY: Self = {
        let zero = Errors { position: 0.0, velocity: 0.0, attitude: Some(0.0), body_rate: Some(0.0) };
        Self { windows: 0, sum: zero, naive: zero }
    };

    /// Returns the scores of the predictions of a flight at every horizon. `predictions` has the predictions of every
    /// window. Horizons near glitches do not count.
    pub fn of_flight(
        flight: &Flight,
        windows: &[Window],
        predictions: &[[Predicted; HORIZONS.len()]],
    ) -> [Self; HORIZONS.len()] {
        let mut scores = [Self::EMPTY; HORIZONS.len()];
        for (window, predicted) in windows.iter().zip(predictions) {
            let start = flight.state(window.row);
            for (index, score) in scores.iter_mut().enumerate().filter(|(index, _)| window.is_valid[*index]) {
                let measured = flight.state(window.ends[index]);
                let naive = Predicted::naive(&start, HORIZONS[index]).errors(&measured);
                let errors = predicted[index].errors(&measured);
                score.sum = score.sum.zip(&errors, |a, b| a + b);
                score.naive = score.naive.zip(&naive, |a, b| a + b);
                score.windows += 1;
            }
        }
        scores
    }

    /// Adds the windows of another score.
    pub fn add(&mut self, other: &Self) {
        self.windows += other.windows;
        self.sum = self.sum.zip(&other.sum, |a, b| a + b);
        self.naive = self.naive.zip(&other.naive, |a, b| a + b);
    }

    /// Returns the mean errors of the predictions. They are NaN without windows.
    pub fn errors(&self) -> Errors {
        self.sum.zip(&self.sum, |sum, _| sum / self.windows as f64)
    }

    /// Returns the mean errors of the naive prediction. They are NaN without windows.
    pub fn naive(&self) -> Errors {
        self.naive.zip(&self.naive, |sum, _| sum / self.windows as f64)
    }

    /// Returns the errors of the predictions divided by those of the naive prediction.
    pub fn ratio(&self) -> Errors {
        self.sum.zip(&self.naive, |sum, naive| sum / naive)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flights::log::tests::tumbling;
    use proptest::prelude::*;

    #[test]
    fn windows_start_every_half_second_while_a_second_follows() {
        // rows from 0 s to 6.5 s
        let flight = tumbling(651, 0.01);
        let windows = Window::of(&flight).unwrap();
        let starts: Vec<_> = windows.iter().map(|window| window.t0).collect();
        assert_eq!(starts, [3.0, 3.5, 4.0, 4.5, 5.0, 5.5]);
        assert_eq!((windows[1].row, windows[1].ends), (350, [360, 375, 400, 450]));
        assert!(windows.iter().all(|window| window.is_valid == [true; 4]));
        // a row less: the last window ends after the flight
        assert_eq!(Window::of(&tumbling(650, 0.01)).unwrap().len(), 5);
        // rows of 5 ms
        assert_eq!(Window::of(&tumbling(1301, 0.005)).unwrap()[1].ends, [720, 750, 800, 900]);
        // a flight whose first row is much later
        let times = Window::of(&Flight { start: 1e6, ..flight.clone() }).unwrap();
        assert_eq!((times[0].t0, times[0].row, times.len()), (1e6 + 1.0, 100, 10));
        // a flight whose first row is later needs a second before the first window
        let later = Flight { start: 4.2, ..flight.clone() };
        assert_eq!(Window::of(&later).unwrap()[0].t0, 5.5);
        assert_eq!(Window::of(&later).unwrap()[0].row, 130);
    }

    #[test]
    fn flights_without_a_window_are_errors() {
        let error = Window::of(&tumbling(400, 0.01)).unwrap_err().to_string();
        assert_eq!(error, "tumbling: t from 0 to 3.99, expected rows from 2 s to 4 s for one window");
        let error = Window::of(&tumbling(400, 0.02)).unwrap_err().to_string();
        assert_eq!(error, "tumbling: t has a step of 0.02 s, expected one that divides 0.05 s");
    }

    #[test]
    fn horizons_near_glitches_do_not_count() {
        let mut flight = tumbling(651, 0.01);
        let naive = |flight: &Flight, windows: &[Window]| {
            let of = |window: &Window| HORIZONS.map(|horizon| Predicted::naive(&flight.state(window.row), horizon));
            windows.iter().map(of).collect::<Vec<_>>()
        };
        let windows = Window::of(&flight).unwrap();
        let clean = Score::of_flight(&flight, &windows, &naive(&flight, &windows));
        assert_eq!(clean.map(|score| score.windows), [6; 4]);
        // the end of the horizon of 0.25 s of the first window, and no other end
        flight.position[325] += Vector3::new(0.1, 0.0, 0.0);
        let windows = Window::of(&flight).unwrap();
        let scores = Score::of_flight(&flight, &windows, &naive(&flight, &windows));
        assert_eq!(scores.map(|score| score.windows), [6, 5, 6, 6]);
        assert_eq!((scores[0], scores[3]), (clean[0], clean[3]));
        // the start of the third window
        flight.position[400] += Vector3::new(0.1, 0.0, 0.0);
        let windows = Window::of(&flight).unwrap();
        assert_eq!(windows[2].is_valid, [false; 4]);
        assert_eq!(windows[0].is_valid, [true, false, true, false]);
    }

    #[test]
    fn the_naive_prediction_has_a_ratio_of_one_and_the_truth_of_zero() {
        let flight = tumbling(651, 0.01);
        let windows = Window::of(&flight).unwrap();
        let naive: Vec<_> =
            windows.iter().map(|w| HORIZONS.map(|h| Predicted::naive(&flight.state(w.row), h))).collect();
        let truth: Vec<_> = windows.iter().map(|w| w.ends.map(|end| Predicted::of(&flight.state(end)))).collect();
        for (index, score) in Score::of_flight(&flight, &windows, &naive).iter().enumerate() {
            let ratio = score.ratio();
            assert_eq!((ratio.position, ratio.velocity), (1.0, 1.0));
            // the flight has a constant body rate
            assert!(score.errors().attitude.unwrap() < 1e-9 && score.errors().body_rate.unwrap() == 0.0);
            // |p(t + h) − p(t) − v·h| by hand
            let by_hand = windows.iter().map(|w| {
                let (start, end) = (flight.state(w.row), flight.state(w.ends[index]));
                (end.position - start.position - start.velocity * HORIZONS[index]).norm()
            });
            assert!((score.errors().position - by_hand.sum::<f64>() / 6.0).abs() < 1e-12);
        }
        for score in Score::of_flight(&flight, &windows, &truth) {
            let ratio = score.ratio();
            assert_eq!((ratio.position, ratio.velocity), (0.0, 0.0));
        }
    }

    #[test]
    fn scores_of_flights_add_up_to_the_mean_over_all_windows() {
        let flights = [tumbling(651, 0.01), tumbling(1001, 0.01)];
        let mut total = Score::EMPTY;
        let mut sum = 0.0;
        for flight in &flights {
            let windows = Window::of(flight).unwrap();
            let still = windows.iter().map(|w| [Predicted::of(&flight.state(w.row)).without_attitude(); 4]);
            let score = Score::of_flight(flight, &windows, &still.collect::<Vec<_>>())[2];
            sum += score.errors().position * score.windows as f64;
            total.add(&score);
        }
        assert_eq!(total.windows, 6 + 13);
        assert!((total.errors().position - sum / 19.0).abs() < 1e-12);
        assert_eq!((total.errors().attitude, total.ratio().body_rate), (None, None));
        assert!(total.naive().attitude.is_some());
    }

    proptest! {
        #[test]
        fn the_attitude_error_is_the_geodesic_angle(
            axis in prop::array::uniform3(-1.0_f64..1.0), angle in 0.0_f64..3.1,
            first in prop::array::uniform3(-3.0_f64..3.0), exponent in 0_i32..9,
        ) {
            let axis = Vector3::from(axis);
            prop_assume!(axis.norm() > 0.1);
            let angle = angle * 10.0_f64.powi(-exponent);
            let a = UnitQuaternion::from_scaled_axis(Vector3::from(first));
            let b = a * UnitQuaternion::from_scaled_axis(axis.normalize() * angle);
            prop_assert!((angle_between(&a, &b) - angle).abs() < 1e-14 + 1e-12 * angle);
            let negative = UnitQuaternion::new_unchecked(-b.into_inner());
            prop_assert!((angle_between(&a, &negative) - angle).abs() < 1e-14 + 1e-12 * angle);
        }
    }
}
