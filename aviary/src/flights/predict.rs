//! Open-loop prediction of a flight in windows.
//!
//! The estimator ([`Observer`]) receives the rows of the flight one by one up to the start t0 of a window. From its
//! estimate, the airframe's equations of motion are integrated under the recorded motor commands and the recorded
//! voltage. The integration has no access to the flight: its only inputs are rotor speeds and, with
//! [`AttitudeSource::Recorded`], attitudes.

use rayon::prelude::*;

use super::dynamics::{Dynamics, between, rotor_speeds, substeps};
use super::observer::{Estimate, FastSteps, Observer, ObserverParams};
use super::window::{HORIZONS, Predicted, Window};
use super::{Flight, FlightError};
use crate::drone::DroneParams;
use crate::math::{Real, ToFlight as _, Turn};
use crate::names::named_enum;
use crate::state::FlightState;

named_enum! {
    "attitude source"
    /// Attitude in a prediction.
    pub enum AttitudeSource {
        /// Recorded attitude as an input: the prediction has position and velocity.
        Recorded = "recorded",
        /// Predicted attitude: the prediction has all quantities.
        Predicted = "predicted",
    }
}

/// Recorded inputs of a prediction after the start of its window, scalar or SIMD.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Inputs<'a, R = f64> {
    /// Rotor speeds (rpm) at the start of every physics step, and at the end of the last one.
    pub speeds: &'a [[R; 4]],
    /// Attitudes at every row from the start of the window, if they are an input.
    pub attitudes: Option<&'a [Turn<R>]>,
    /// Number of physics steps between two rows.
    pub substeps: usize,
}

/// Integrates the equations of motion from an estimate under recorded inputs, and calls `at_row` with the index of
/// every following row, from 1, and the state at it. With attitudes as inputs, the attitude and the body rate of the
/// state are those of the start.
#[inline(always)]
pub(crate) fn integrate<R: Real>(
    dynamics: &Dynamics<R>,
    fast: &FastSteps<R>,
    start: &Estimate<R>,
    inputs: &Inputs<'_, R>,
    mut at_row: impl FnMut(usize, &FlightState<R>),
) {
    let Estimate { mut state, mut translation, mut rotation } = *start;
    let count = inputs.substeps;
    for (step, pair) in inputs.speeds.windows(2).enumerate() {
        let (row, substep) = (step / count, step % count);
        let speeds = [&pair[0], &pair[1]];
        match inputs.attitudes {
            Some(attitudes) => {
                let part = (substep as f64 + 0.5) / count as f64;
                let attitude = between(&attitudes[row], &attitudes[row + 1], part);
                let moved = (state.position, state.velocity);
                (state.position, state.velocity) = dynamics.translate(speeds, &attitude, translation.total(), moved);
            }
            None => {
                state = dynamics.fly(speeds, translation.total(), rotation.total(), &state);
                rotation.advance(&fast.rotation);
            }
        }
        translation.advance(&fast.translation);
        if substep + 1 == count {
            at_row(row + 1, &state);
        }
    }
}

/// A flight with everything that its predictions have in common: rotor speeds and estimates at the starts of windows.
#[derive(Debug)]
pub struct Predictor<'a> {
    flight: &'a Flight,
    windows: &'a [Window],
    dynamics: Dynamics,
    /// Factors of the fast disturbances over a physics step.
    fast: FastSteps<f64>,
    substeps: usize,
    speeds: Vec<[f64; 4]>,
    /// Estimate at the start of every window.
    estimates: Vec<Estimate>,
}

impl<'a> Predictor<'a> {
    /// Prepares predictions of the windows of a flight by an airframe. `windows` must be in the order of time.
    ///
    /// # Errors
    /// [`FlightError::Missing`] for a flight without motor commands, and without a voltage if the airframe has none;
    /// [`FlightError::Airframe`] for an airframe without motors that a duty drives.
    pub fn new(params: &DroneParams, flight: &'a Flight, windows: &'a [Window]) -> Result<Self, FlightError> {
        Self::with_observer(params, &ObserverParams::default(), flight, windows)
    }

    /// Prepares predictions with other settings of the estimator.
    ///
    /// # Errors
    /// Returns the errors of [`new`](Self::new).
    pub fn with_observer(
        params: &DroneParams,
        observer: &ObserverParams,
        flight: &'a Flight,
        windows: &'a [Window],
    ) -> Result<Self, FlightError> {
        let speeds = rotor_speeds(params, flight)?;
        let substeps = substeps(flight);
        let dt = flight.step / substeps as f64;
        let dynamics = Dynamics::new(params, dt);
        let estimates = estimates(observer, &dynamics, flight, &speeds, substeps, windows);
        Ok(Self { flight, windows, dynamics, fast: observer.fast_steps(dt), substeps, speeds, estimates })
    }

    /// Predicts the states of all windows at every horizon.
    ///
    /// # Errors
    /// [`FlightError::Missing`] for a flight without a gyro if the attitude is predicted.
    pub fn predict(&self, attitude: AttitudeSource) -> Result<Vec<[Predicted; HORIZONS.len()]>, FlightError> {
        self.check(attitude)?;
        let predict = |index: usize| {
            let window = &self.windows[index];
            let states = self.states(index, attitude, window.ends[HORIZONS.len() - 1]);
            window.ends.map(|end| states[end - window.row])
        };
        Ok((0..self.windows.len()).into_par_iter().map(predict).collect())
    }

    /// Predicts the states of one window at all of its rows.
    ///
    /// # Errors
    /// [`FlightError::Missing`] for a flight without a gyro if the attitude is predicted.
    ///
    /// # Panics
    /// If no window has the index.
    pub fn trace(&self, window: usize, attitude: AttitudeSource) -> Result<Vec<Predicted>, FlightError> {
        self.check(attitude)?;
        Ok(self.states(window, attitude, self.windows[window].ends[HORIZONS.len() - 1]))
    }

    fn check(&self, attitude: AttitudeSource) -> Result<(), FlightError> {
        match attitude {
            AttitudeSource::Recorded => Ok(()),
            AttitudeSource::Predicted => self.flight.require(&["gx", "gy", "gz"], "the body rate of a prediction"),
        }
    }

    /// Returns the states of a window from its start to a row.
    fn states(&self, index: usize, attitude: AttitudeSource, end: usize) -> Vec<Predicted> {
        let (row, estimate) = (self.windows[index].row, &self.estimates[index]);
        let attitudes: Option<Vec<_>> = (attitude == AttitudeSource::Recorded)
            .then(|| self.flight.attitude[row..=end].iter().map(|attitude| attitude.to_flight()).collect());
        let inputs = Inputs {
            speeds: &self.speeds[row * self.substeps..=end * self.substeps],
            attitudes: attitudes.as_deref(),
            substeps: self.substeps,
        };
        let predicted = |state: &FlightState<f64>| {
            let predicted = Predicted::of(&(*state).into());
            if inputs.attitudes.is_some() { predicted.without_attitude() } else { predicted }
        };
        let mut states = Vec::with_capacity(end - row + 1);
        states.push(predicted(&estimate.state));
        integrate(&self.dynamics, &self.fast, estimate, &inputs, |_, state| states.push(predicted(state)));
        states
    }
}

/// Returns the estimates at the starts of windows, which must be in the order of time.
fn estimates(
    params: &ObserverParams,
    dynamics: &Dynamics,
    flight: &Flight,
    speeds: &[[f64; 4]],
    substeps: usize,
    windows: &[Window],
) -> Vec<Estimate> {
    let measured = |row: usize| FlightState::from(&flight.state(row));
    let rows = windows.last().map_or(0, |window| window.row + 1);
    let gains = params.gains(dynamics, rows, flight.step);
    let fast = params.fast_steps(flight.step);
    let mut observer = Observer::new(&measured(0));
    let mut estimates = Vec::with_capacity(windows.len());
    for row in 0..rows {
        if row > 0 {
            let since = &speeds[(row - 1) * substeps..=row * substeps];
            observer.advance(dynamics, since, &fast, &gains[row], &measured(row));
        }
        while windows.get(estimates.len()).is_some_and(|window| window.row == row) {
            estimates.push(*observer.estimate());
        }
    }
    estimates
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flights::dynamics::tests::airframe;
    use crate::math::{ToNalgebra as _, V3};
    use crate::state::{DroneState, attitude_from_rpy};
    use nalgebra::{UnitQuaternion, Vector3};
    use proptest::prelude::*;

    /// Returns a flight that the model itself flies, with a disturbance of the acceleration and of the angular
    /// acceleration (body frame), without noise. A controller, which the model does not know, keeps it in the air.
    fn flown(seconds: f64, acceleration: Vector3<f64>, angular: Vector3<f64>) -> Flight {
        let params = airframe();
        let rows = (seconds / 0.01).round() as usize + 1;
        let vectors = vec![Vector3::zeros(); rows];
        let mut flight = Flight {
            name: "flown".into(),
            start: 0.0,
            step: 0.01,
            position: vectors.clone(),
            attitude: vec![UnitQuaternion::identity(); rows],
            velocity: vectors.clone(),
            body_rate: Some(vectors),
            acceleration: None,
            duty: Some(vec![[0.5; 4]; rows]),
            voltage: Some((0..rows).map(|row| 3.7 - 0.01 * row as f64 * 0.01).collect()),
        };
        let mut state = DroneState::at_rest(Vector3::new(0.0, 0.0, 1.0), Vector3::new(0.05, -0.04, 0.9));
        let allocation = params.allocation().try_inverse().unwrap();
        let inertia = params.inertia_vector();
        for row in 0..rows {
            let time = flight.time(row);
            flight.position[row] = state.position;
            flight.attitude[row] = state.attitude;
            flight.velocity[row] = state.velocity;
            flight.body_rate.as_mut().unwrap()[row] = state.angular_velocity;
            if row + 1 == rows {
                break;
            }
            // a slow attitude loop that turns and tilts
            let wanted = attitude_from_rpy(Vector3::new(0.2 * (1.3 * time).sin(), 0.25 * (0.9 * time).cos(), time));
            let off = (state.attitude.inverse() * wanted).scaled_axis();
            let torque = (off * 60.0 - state.angular_velocity * 12.0).component_mul(&inertia);
            let thrust = params.weight() * (1.0 + 0.05 * (2.0 * time).sin());
            let forces = allocation * nalgebra::Vector4::new(thrust, torque.x, torque.y, torque.z);
            let voltage = flight.voltage.as_ref().unwrap()[row];
            let duty = [0, 1, 2, 3].map(|motor| {
                let speed = (forces[motor].max(0.0) / params.thrust_coefficient).sqrt();
                ((speed - params.motors.speed_at_zero) / (params.motors.speed_per_volt * voltage)).clamp(0.0, 1.0)
            });
            // a command acts in the next row
            flight.duty.as_mut().unwrap()[row + 1] = duty;
            // the speeds up to the next row follow from the commands up to it
            let so_far = Flight {
                position: vec![Vector3::zeros(); row + 2],
                duty: flight.duty.as_ref().map(|duty| duty[..row + 2].to_vec()),
                voltage: flight.voltage.as_ref().map(|voltage| voltage[..row + 2].to_vec()),
                ..flight.clone()
            };
            let speeds = rotor_speeds(&params, &so_far).unwrap();
            let dynamics = Dynamics::new(&params, 0.002);
            let mut next = FlightState::from(&state);
            for pair in speeds[row * 5..].windows(2) {
                next = dynamics.fly([&pair[0], &pair[1]], acceleration.to_flight(), angular.to_flight(), &next);
            }
            state = next.into();
        }
        flight
    }

    #[test]
    fn predictions_of_a_flight_of_the_model_are_exact() {
        let flight = flown(6.0, Vector3::zeros(), Vector3::zeros());
        assert!(flight.position.iter().all(|position| position.norm() < 20.0));
        let windows = Window::of(&flight).unwrap();
        let predictor = Predictor::new(&airframe(), &flight, &windows).unwrap();
        for (attitude, limits) in [(AttitudeSource::Recorded, [1e-4, 1e-3]), (AttitudeSource::Predicted, [1e-4, 1e-3])]
        {
            for (window, predicted) in windows.iter().zip(predictor.predict(attitude).unwrap()) {
                for (end, predicted) in window.ends.iter().zip(predicted) {
                    let errors = predicted.errors(&flight.state(*end));
                    assert!(errors.position < limits[0] && errors.velocity < limits[1], "{attitude}: {errors:?}");
                    assert!(errors.attitude.is_none_or(|angle| angle < 2e-4), "{errors:?}");
                    assert!(errors.body_rate.is_none_or(|rate| rate < 2e-3), "{errors:?}");
                }
            }
        }
    }

    #[test]
    fn constant_disturbances_are_estimated_from_the_past() {
        let (acceleration, angular) = (Vector3::new(0.0, 0.0, -0.6), Vector3::new(6.0, -4.0, 0.8));
        let flight = flown(7.0, acceleration, angular);
        let windows = Window::of(&flight).unwrap();
        let predictor = Predictor::new(&airframe(), &flight, &windows).unwrap();
        for estimate in &predictor.estimates {
            let (a, b) = (estimate.translation.total().to_nalgebra(), estimate.rotation.total().to_nalgebra());
            assert!((a - acceleration).norm() < 0.02, "{a}");
            // the filter neglects the ratio of the thrust to the weight, here 0.94 to 1.06
            assert!((b - angular).norm() < 0.07 * angular.norm(), "{b}");
        }
        // an airframe that ignores them drifts away
        let error = |predicted: &Predicted, end: usize| predicted.errors(&flight.state(end)).position;
        let window = &windows[windows.len() - 1];
        let predicted = predictor.predict(AttitudeSource::Predicted).unwrap()[windows.len() - 1];
        let mut ignored = predictor.estimates[windows.len() - 1];
        ignored.translation.slow = V3::zero(0.0);
        ignored.rotation.slow = V3::zero(0.0);
        let inputs =
            Inputs { speeds: &predictor.speeds[window.row * 5..=window.ends[3] * 5], attitudes: None, substeps: 5 };
        let mut last = ignored.state;
        integrate(&predictor.dynamics, &predictor.fast, &ignored, &inputs, |_, state| last = *state);
        let without = error(&Predicted::of(&last.into()), window.ends[3]);
        assert!(
            error(&predicted[3], window.ends[3]) < 0.1 * without,
            "{} {without}",
            error(&predicted[3], window.ends[3])
        );
    }

    /// Replaces everything after a row except motors, voltage and, if `keep_attitude`, the attitude.
    fn blinded(flight: &Flight, row: usize, keep_attitude: bool, with: f64) -> Flight {
        let mut flight = flight.clone();
        let vector = Vector3::new(with, -with, 0.5 * with);
        for later in row + 1..flight.rows() {
            flight.position[later] = vector;
            flight.velocity[later] = vector;
            flight.body_rate.as_mut().unwrap()[later] = vector;
            if !keep_attitude {
                let turned = if with.is_nan() { vector } else { vector.map(|x| x.sin()) };
                flight.attitude[later] = UnitQuaternion::from_scaled_axis(turned);
            }
        }
        flight
    }

    #[test]
    fn predictions_depend_on_no_later_row_except_motors_and_voltage() {
        let flight = flown(5.6, Vector3::new(0.1, -0.05, 0.3), Vector3::new(3.0, 2.0, -0.4));
        let params = airframe();
        let windows = Window::of(&flight).unwrap();
        let bits = |predicted: &[Predicted; 4]| format!("{predicted:?}");
        for attitude in AttitudeSource::ALL {
            let all = Predictor::new(&params, &flight, &windows).unwrap().predict(attitude).unwrap();
            for (window, expected) in windows.iter().zip(&all) {
                for with in [f64::NAN, f64::INFINITY, 1e6, -3.0] {
                    let blind = blinded(&flight, window.row, attitude == AttitudeSource::Recorded, with);
                    let alone = [*window];
                    let predictor = Predictor::new(&params, &blind, &alone).unwrap();
                    assert_eq!(bits(&predictor.predict(attitude).unwrap()[0]), bits(expected), "{attitude} {with}");
                }
            }
            // the inputs after the start of a window do change its prediction
            let mut other = flight.clone();
            let row = windows[0].row;
            other.duty.as_mut().unwrap()[row + 5][1] += 0.05;
            let changed = Predictor::new(&params, &other, &windows).unwrap().predict(attitude).unwrap();
            assert_ne!(bits(&changed[0]), bits(&all[0]));
            let mut other = flight.clone();
            other.voltage.as_mut().unwrap()[row + 5] += 0.05;
            let changed = Predictor::new(&params, &other, &windows).unwrap().predict(attitude).unwrap();
            assert_ne!(bits(&changed[0]), bits(&all[0]));
        }
    }

    #[test]
    fn traces_have_the_predictions_at_the_horizons() {
        let flight = flown(4.6, Vector3::zeros(), Vector3::new(1.0, 0.0, 0.0));
        let windows = Window::of(&flight).unwrap();
        let predictor = Predictor::new(&airframe(), &flight, &windows).unwrap();
        for attitude in AttitudeSource::ALL {
            let (trace, predicted) = (predictor.trace(1, attitude).unwrap(), predictor.predict(attitude).unwrap());
            assert_eq!(trace.len(), 101);
            for (end, predicted) in windows[1].ends.iter().zip(predicted[1]) {
                assert_eq!(trace[end - windows[1].row], predicted);
            }
            let has_attitude = attitude == AttitudeSource::Predicted;
            assert!(
                trace.iter().all(|p| p.attitude.is_some() == has_attitude && p.body_rate.is_some() == has_attitude)
            );
        }
        let without = Flight { body_rate: None, ..flight.clone() };
        let predictor = Predictor::new(&airframe(), &without, &windows).unwrap();
        assert!(predictor.predict(AttitudeSource::Recorded).is_ok());
        let error = predictor.predict(AttitudeSource::Predicted).unwrap_err().to_string();
        assert_eq!(error, "flown: no columns `gx`, `gy`, `gz`, expected for the body rate of a prediction");
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(16))]

        /// A flight seen from another place and heading has the same errors.
        #[test]
        fn predictions_do_not_depend_on_place_and_heading(
            heading in -3.0_f64..3.0, place in prop::array::uniform3(-50.0_f64..50.0),
        ) {
            let flight = flown(4.2, Vector3::new(0.1, 0.0, 0.2), Vector3::new(2.0, -1.0, 0.3));
            let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), heading);
            let place = Vector3::from(place);
            let moved = Flight {
                position: flight.position.iter().map(|position| place + turn * position).collect(),
                velocity: flight.velocity.iter().map(|velocity| turn * velocity).collect(),
                attitude: flight.attitude.iter().map(|attitude| turn * attitude).collect(),
                ..flight.clone()
            };
            let windows = Window::of(&flight).unwrap();
            for attitude in AttitudeSource::ALL {
                let predict = |flight: &Flight| {
                    Predictor::new(&airframe(), flight, &windows).unwrap().predict(attitude).unwrap()[0][3]
                };
                let (here, there) = (predict(&flight), predict(&moved));
                prop_assert!((there.position - place - turn * here.position).norm() < 1e-8);
                prop_assert!((there.velocity - turn * here.velocity).norm() < 1e-8);
                if let (Some(here), Some(there)) = (here.attitude, there.attitude) {
                    prop_assert!((turn * here).angle_to(&there) < 1e-6);
                }
            }
        }
    }
}
