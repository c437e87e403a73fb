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
use crate::math::{Real, Turn};
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
            .then(|| self.flight.attitude[row..=end].iter().map(Turn::from).collect());
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
