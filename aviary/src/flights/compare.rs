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
/// [`FlightError::Windows`] for a prediction that is not finite.
pub fn compare(
    params: &DroneParams,
    flights: &[Flight],
    sources: &[AttitudeSource],
) -> Result<Vec<Compared>, FlightError> {
    let compared = compare_any(params, flights, sources)?;
    for (flight, compared) in flights.iter().zip(&compared) {
        for track in &compared.tracks {
            let is_finite = |window: &[Predicted; HORIZONS.len()]| window.iter().all(Predicted::is_finite);
            if let Some(index) = track.predictions.iter().position(|window| !is_finite(window)) {
                let t0 = compared.windows[index].t0;
                let message = format!("the prediction from {t0} s is not finite, expected another airframe");
                return Err(FlightError::Windows { flight: flight.name.clone(), message });
            }
        }
    }
    Ok(compared)
}

/// Compares flights as [`compare`] does; predictions need not be finite.
pub(super) fn compare_any(
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flights::dynamics::tests::airframe;
    use crate::flights::log::tests::tumbling;

    #[test]
    fn flights_are_compared_in_their_order_with_every_source() {
        let flights = [tumbling(450, 0.01), Flight { name: "longer".into(), ..tumbling(651, 0.01) }];
        let compared = compare(&airframe(), &flights, &AttitudeSource::ALL).unwrap();
        assert_eq!(compared.iter().map(|compared| compared.windows.len()).collect::<Vec<_>>(), [1, 6]);
        for compared in &compared {
            let sources: Vec<_> = compared.tracks.iter().map(|track| track.attitude).collect();
            assert_eq!(sources, AttitudeSource::ALL);
            assert!(compared.tracks[0].predictions[0][0].attitude.is_none());
            assert!(compared.tracks[1].predictions[0][0].attitude.is_some());
            assert_eq!(compared.tracks[1].scores[3].windows, compared.windows.len());
        }
        let alone = compare(&airframe(), &flights[1..], &[AttitudeSource::Recorded]).unwrap();
        assert_eq!(alone[0].tracks[0], compared[1].tracks[0]);
        let without = [flights[0].clone(), Flight { duty: None, ..flights[1].clone() }];
        let error = compare(&airframe(), &without, &AttitudeSource::ALL).unwrap_err().to_string();
        assert!(error.starts_with("longer: no columns `m1`"), "{error}");
    }

    #[test]
    fn the_plot_of_a_window_has_measured_and_predicted_lines() {
        let flight = tumbling(450, 0.01);
        let windows = Window::of(&flight).unwrap();
        let predictor = Predictor::new(&airframe(), &flight, &windows).unwrap();
        for (source, labels) in
            [(AttitudeSource::Recorded, ["x (m)", "vz (m/s)"]), (AttitudeSource::Predicted, ["z (m)", "yaw (°)"])]
        {
            let trace = predictor.trace(0, source).unwrap();
            let svg = plot_window("A window", &flight, &windows[0], &trace).unwrap().svg().unwrap();
            for text in labels.iter().chain(&["A window", "measured", "predicted", "time (s)"]) {
                assert!(svg.contains(text), "{source}: {text}");
            }
        }
    }

    #[test]
    fn unwrapped_angles_have_no_jumps() {
        let angles = unwrapped((0..100).map(|i| (f64::from(i) * 17.0 + 180.0) % 360.0 - 180.0));
        assert!(angles.windows(2).all(|pair| (pair[1] - pair[0] - 17.0).abs() < 1e-9), "{angles:?}");
    }
}
