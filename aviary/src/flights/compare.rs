//! Comparison of predictions with recorded flights: scores of many flights, and the plot of one window.

use rayon::prelude::*;

use super::predict::{AttitudeSource, Predictor};
use super::window::{HORIZONS, Predicted, Score, Window};
use super::{Flight, FlightError};
use crate::drone::DroneParams;
use crate::record::RecordError;
use crate::record::plot::{Plot, Series};
use crate::state::rpy_from_attitude;

/// Predictions of a flight by an airframe, with their errors.
#[derive(Debug, Clone, PartialEq)]
pub struct Compared {
    /// Windows of the flight.
    pub windows: Vec<Window>,
    /// Predictions with each source of the attitude.
    pub tracks: Vec<Track>,
}

/// Predictions of a flight with one source of the attitude.
#[derive(Debug, Clone, PartialEq)]
pub struct Track {
    /// Source of the attitude.
    pub attitude: AttitudeSource,
    /// Predictions of every window at every horizon.
    pub predictions: Vec<[Predicted; HORIZONS.len()]>,
    /// Errors at every horizon.
    pub scores: [Score; HORIZONS.len()],
}

/// Predicts flights by an airframe and compares the predictions with them, in parallel. The result has one element per
/// flight, with one track per source of the attitude.
///
/// # Errors
/// Returns the error of the first flight that cannot be predicted; see [`Window::of`] and [`Predictor`].
pub fn compare(
    params: &DroneParams,
    flights: &[Flight],
    sources: &[AttitudeSource],
) -> Result<Vec<Compared>, FlightError> {
    let compared = flights.par_iter().map(|flight| {
        let windows = Window::of(flight)?;
        let predictor = Predictor::new(params, flight, &windows)?;
        let track = |&attitude: &AttitudeSource| {
            let predictions = predictor.predict(attitude)?;
            let scores = Score::of_flight(flight, &windows, &predictions);
            Ok(Track { attitude, predictions, scores })
        };
        let tracks = sources.iter().map(track).collect::<Result<_, _>>()?;
        Ok(Compared { windows, tracks })
    });
    // the first error in the order of the flights
    compared.collect::<Vec<_>>().into_iter().collect()
}

/// Draws measured and predicted position and attitude over a window of a flight. With recorded attitude, the plot has
/// the position and the velocity.
///
/// # Errors
/// [`RecordError::Plot`] for a prediction that is not finite.
///
/// # Panics
/// If `predicted` has more rows than the flight has from the start of the window.
pub fn plot_window(
    title: &str,
    flight: &Flight,
    window: &Window,
    predicted: &[Predicted],
) -> Result<Plot, RecordError> {
    let rows = window.row..window.row + predicted.len();
    let times: Vec<_> = rows.clone().map(|row| flight.time(row)).collect();
    let lines = |measured: Vec<f64>, predicted: Vec<f64>| {
        [("measured", measured), ("predicted", predicted)]
            .map(|(name, values)| Series { name: name.into(), points: times.iter().copied().zip(values).collect() })
    };
    let measured: Vec<_> = rows.map(|row| flight.state(row)).collect();
    let with_attitude = predicted.iter().all(|predicted| predicted.attitude.is_some());
    let mut panels = Vec::new();
    for axis in 0..3 {
        let position = measured.iter().map(|state| state.position[axis]).collect();
        let expected = predicted.iter().map(|state| state.position[axis]).collect();
        panels.push((["x (m)", "y (m)", "z (m)"][axis], lines(position, expected).into()));
        if with_attitude {
            let angles = unwrapped(measured.iter().map(|state| state.rpy()[axis].to_degrees()));
            let expected = predicted.iter().filter_map(|state| state.attitude);
            let mut expected = unwrapped(expected.map(|attitude| rpy_from_attitude(&attitude)[axis].to_degrees()));
            // both lines start in the same turn
            let turns = angles.first().zip(expected.first()).map_or(0.0, |(a, b)| ((a - b) / 360.0).round());
            expected.iter_mut().for_each(|angle| *angle += 360.0 * turns);
            panels.push((["roll (°)", "pitch (°)", "yaw (°)"][axis], lines(angles, expected).into()));
        } else {
            let velocity = measured.iter().map(|state| state.velocity[axis]).collect();
            let expected = predicted.iter().map(|state| state.velocity[axis]).collect();
            panels.push((["vx (m/s)", "vy (m/s)", "vz (m/s)"][axis], lines(velocity, expected).into()));
        }
    }
    Ok(Plot::time_series(title, &panels)?.in_columns(2))
}

/// Returns angles in degrees without jumps of whole turns.
fn unwrapped(angles: impl Iterator<Item = f64>) -> Vec<f64> {
    let mut last = None;
    angles
        .map(|angle| {
            let angle = last.map_or(angle, |last: f64| angle + 360.0 * ((last - angle) / 360.0).round());
            last = Some(angle);
            angle
        })
        .collect()
}
