//! Residuals of the identification: weighted deviations of predictions in overlapping windows.

use rayon::prelude::*;

use super::parameters::PARAMETERS;
use super::propagate::{Filter, FittedFlight, Tracks, deviations};
use super::solve::Residuals;
use crate::drone::DroneParams;
use crate::flights::dynamics::Dynamics;
use crate::flights::observer::ObserverParams;
use crate::flights::window::{HORIZONS, Predicted};
use crate::math::{LANES, Row};

/// Weight of a mean deviation of the naive prediction: of position and velocity with the recorded attitude, and of
/// position, velocity, attitude and body rate with the predicted attitude.
const RECORDED_WEIGHT: f64 = 5.0;
const PREDICTED_WEIGHTS: [f64; 4] = [3.0, 0.8, 2.0, 0.6];

/// Factor on the weight of the predicted position at the longest horizon, where errors of all parameters add up.
const LAST_POSITION_WEIGHT: f64 = 2.0;

/// Slow disturbance along body z with a weight of 1, m/s². It determines the mean thrust, which the estimator hides
/// from the predictions.
const SLOW_THRUST: f64 = 2.0;

/// Slow disturbances of the angular acceleration with a weight of 1, rad/s². They determine the trim torque, and only
/// it: they differ between flights, and in a fit of the inertia a large inertia would make them smaller.
const SLOW_TORQUES: [f64; 3] = [20.0, 20.0, 6.0];

/// Residual above which its influence does not grow further.
const ROBUST: f64 = 0.5;

/// Length of the blocks of windows that are taken as independent, s.
const BLOCK: f64 = 3.0;

/// Step of the differences, as a part of the scales of the parameters.
const DIFFERENCE: f64 = 1e-5;

/// Weights of the deviations at every horizon.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Weights {
    /// Position and velocity with the recorded attitude.
    recorded: [[f64; 2]; HORIZONS.len()],
    /// Position, velocity, attitude and body rate.
    predicted: [[f64; 4]; HORIZONS.len()],
}

impl Weights {
    /// Returns weights by the mean deviations of the naive prediction over all windows.
    pub fn of(flights: &[FittedFlight]) -> Self {
        let (mut sums, mut counts) = ([[0.0; 4]; HORIZONS.len()], [0.0; HORIZONS.len()]);
        for fitted in flights {
            for window in &fitted.windows {
                let start = fitted.flight.state(window.row);
                for index in (0..HORIZONS.len()).filter(|&index| window.is_valid[index]) {
                    let measured = fitted.flight.state(window.ends[index]);
                    let errors = Predicted::naive(&start, HORIZONS[index]).errors(&measured);
                    let errors = [Some(errors.position), Some(errors.velocity), errors.attitude, errors.body_rate];
                    for (sum, error) in sums[index].iter_mut().zip(errors) {
                        *sum += error.unwrap_or(0.0);
                    }
                    counts[index] += 1.0;
                }
            }
        }
        let mut weights = Self { recorded: Default::default(), predicted: Default::default() };
        // a drone at rest has no naive deviation
        const SMALLEST: [f64; 4] = [1e-3, 1e-2, 5e-3, 5e-2];
        for index in 0..HORIZONS.len() {
            let mean = |quantity: usize| (sums[index][quantity] / f64::max(counts[index], 1.0)).max(SMALLEST[quantity]);
            let weight = |weight: f64, quantity: usize| weight / (mean(quantity) * 3.0_f64.sqrt());
            weights.recorded[index] = [0, 1].map(|quantity| weight(RECORDED_WEIGHT, quantity));
            weights.predicted[index] = [0, 1, 2, 3].map(|quantity| weight(PREDICTED_WEIGHTS[quantity], quantity));
        }
        if let Some(last) = weights.predicted.last_mut() {
            last[0] *= LAST_POSITION_WEIGHT;
        }
        weights
    }
}

/// The least-squares problem of some parameters of an airframe, the others held constant.
pub(super) struct Problem<'a> {
    /// Flights.
    pub flights: &'a [FittedFlight],
    /// Airframe with the constant parameters.
    pub airframe: &'a DroneParams,
    /// Indices of the fitted parameters in [`PARAMETERS`].
    pub fitted: &'a [usize],
    /// Compared tracks.
    pub tracks: Tracks,
    /// Filters of the flights.
    pub filters: &'a [Filter],
    pub weights: &'a Weights,
}

/// Returns the filters of flights for an airframe. The gains depend on it only through its damping, so they stay
/// constant during a fit.
pub(super) fn filters(observer: &ObserverParams, airframe: &DroneParams, flights: &[FittedFlight]) -> Vec<Filter> {
    let of = |fitted: &FittedFlight| {
        let (step, dt) = (fitted.flight.step, fitted.flight.step / fitted.substeps as f64);
        Filter {
            gains: observer.gains(&Dynamics::new(airframe, dt), fitted.observed_rows(), step),
            per_row: observer.fast_steps(step),
            per_step: observer.fast_steps(dt),
        }
    };
    flights.par_iter().map(of).collect()
}

impl Problem<'_> {
    /// Returns the airframe with these values of the fitted parameters.
    pub fn airframe(&self, values: &[f64]) -> DroneParams {
        let mut params = self.airframe.clone();
        for (&index, &value) in self.fitted.iter().zip(values) {
            (PARAMETERS[index].set)(&mut params, value);
        }
        params
    }

    /// Returns the values of the fitted parameters of an airframe.
    pub fn values(&self, params: &DroneParams) -> Vec<f64> {
        self.fitted.iter().map(|&index| (PARAMETERS[index].get)(params)).collect()
    }

    /// Returns the scales of the fitted parameters.
    pub fn scales(&self) -> Vec<f64> {
        self.fitted.iter().map(|&index| (PARAMETERS[index].scale)(self.airframe)).collect()
    }

    /// Returns the block of every residual, and the flight of every block.
    pub fn blocks(&self) -> (Vec<usize>, Vec<usize>) {
        let (mut blocks, mut flights) = (Vec::new(), Vec::new());
        for (flight, fitted) in self.flights.iter().enumerate() {
            let first = flights.len();
            for window in &fitted.windows {
                let block = first + (window.row as f64 * fitted.flight.step / BLOCK) as usize;
                flights.resize(flights.len().max(block + 1), flight);
                blocks.resize(blocks.len() + self.tracks.deviations(window), block);
            }
        }
        (blocks, flights)
    }

    /// Returns the weighted deviations of a flight for sets of parameters, one row each.
    fn weighted(&self, flight: usize, sets: &[DroneParams]) -> Vec<Row> {
        let fitted = &self.flights[flight];
        let mut rows = deviations(fitted, sets, &self.filters[flight], self.tracks)
            .expect("the flights have motors and a voltage, which `identify` checks");
        let mut remaining = rows.iter_mut();
        let mut scale = |weight: f64, count: usize| {
            for row in remaining.by_ref().take(count) {
                // a prediction that diverges has a large finite deviation
                *row = row.map(|x| if x.is_finite() { (x * weight).clamp(-MAX, MAX) } else { MAX });
            }
        };
        for window in &fitted.windows {
            scale(1.0 / SLOW_THRUST, 1);
            let is_fit_of_trim = !self.tracks.recorded && !self.tracks.predicted;
            SLOW_TORQUES.iter().for_each(|slow| scale(if is_fit_of_trim { 1.0 / slow } else { 0.0 }, 1));
            let valid = || (0..HORIZONS.len()).filter(|&index| window.is_valid[index]);
            if self.tracks.recorded {
                valid().for_each(|index| self.weights.recorded[index].iter().for_each(|&weight| scale(weight, 3)));
            }
            if self.tracks.predicted {
                valid().for_each(|index| self.weights.predicted[index].iter().for_each(|&weight| scale(weight, 3)));
            }
        }
        rows
    }
}

/// Largest weighted deviation.
const MAX: f64 = 1e3;

/// Returns the residual of a weighted deviation, whose square is the pseudo-Huber loss, and its derivative.
fn robust(x: f64) -> (f64, f64) {
    let scaled = x / ROBUST;
    let root = (1.0 + scaled * scaled).sqrt();
    // √(2·(root − 1)) without cancellation
    let residual = ROBUST * scaled * (2.0 / (root + 1.0)).sqrt();
    let slope = if x == 0.0 { 1.0 } else { x / (residual * root) };
    (residual, slope)
}

impl Residuals for Problem<'_> {
    fn residuals(&self, parameters: &[f64]) -> Vec<f64> {
        let set = [self.airframe(parameters)];
        let flights = 0..self.flights.len();
        let rows: Vec<_> = flights.into_par_iter().map(|flight| self.weighted(flight, &set)).collect();
        rows.iter().flatten().map(|row| robust(row[0]).0).collect()
    }

    fn jacobian(&self, parameters: &[f64]) -> (Vec<f64>, Vec<f64>) {
        // set 0 has the parameters, and each further set one changed parameter
        let steps: Vec<_> = self.scales().iter().map(|scale| scale * DIFFERENCE).collect();
        let mut sets = vec![self.airframe(parameters)];
        for (index, step) in steps.iter().enumerate() {
            let mut changed = parameters.to_vec();
            changed[index] += step;
            sets.push(self.airframe(&changed));
        }
        let batches: Vec<_> = sets.chunks(LANES).collect();
        let jobs = (0..self.flights.len()).flat_map(|flight| (0..batches.len()).map(move |batch| (flight, batch)));
        let jobs: Vec<_> = jobs.collect();
        let rows: Vec<_> = jobs.par_iter().map(|&(flight, batch)| self.weighted(flight, batches[batch])).collect();
        let (rows, count) = (&rows, batches.len());
        let of_set = |set: usize| {
            let flights = 0..self.flights.len();
            flights.flat_map(move |flight| lane(&rows[flight * count + set / LANES], set % LANES))
        };
        let base: Vec<f64> = of_set(0).collect();
        let (residuals, slopes): (Vec<_>, Vec<_>) = base.iter().map(|&x| robust(x)).unzip();
        let mut jacobian = Vec::with_capacity(base.len() * steps.len());
        for (index, step) in steps.iter().enumerate() {
            let changed = of_set(index + 1);
            jacobian.extend(changed.zip(&base).zip(&slopes).map(|((x, base), slope)| (x - base) / step * slope));
        }
        (residuals, jacobian)
    }
}

/// Returns the numbers of one lane.
fn lane(rows: &[Row], index: usize) -> impl Iterator<Item = f64> + '_ {
    rows.iter().map(move |row| row[index])
}
