//! Identification: parameters of an airframe from recorded flights.
//!
//! [`identify`] compares predictions with the flights in overlapping windows of one second and minimizes the weighted
//! squares of their deviations by the Levenberg–Marquardt algorithm. The predictions are those of
//! [`Predictor`](super::Predictor): the estimator receives the rows up to the start of a window, and the simulator's
//! equations of motion are integrated under the recorded motor commands.
//!
//! 1. Each flight is aligned ([`Alignment`]).
//! 2. Motors, drag and lift are fitted to position and velocity with the recorded attitude.
//! 3. Inertia, damping, moments and trim are fitted to predictions of the attitude.
//! 4. All parameters are fitted to both. Parameters that the flights do not determine are held constant
//!    ([`Unidentified`]), and the fit is repeated without them.
//!
//! Forces determine parameters per mass only: the mass, the thrust coefficient and the arm length of the airframe are
//! given.

mod align;
mod fit;
mod parameters;
mod problem;
mod propagate;
mod report;
mod solve;
mod statistics;

pub use align::{Alignment, Correction};
pub use statistics::Estimate;

use super::{Compared, Flight, FlightError, ObserverParams};
use crate::drone::DroneParams;

/// Options of [`identify`].
#[derive(Debug, Clone, PartialEq)]
pub struct IdentifyOptions {
    /// Name of the identified airframe.
    pub name: String,
    /// Settings of the estimator of the predictions.
    pub observer: ObserverParams,
}

impl Default for IdentifyOptions {
    fn default() -> Self {
        Self { name: "identified".into(), observer: ObserverParams::default() }
    }
}

/// Reason for which flights do not determine a parameter.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Unidentified {
    /// The parameter hardly changes the predictions of these flights, even if all others are known.
    NoEffect,
    /// A change of the parameter has almost the same effect as changes of these other parameters.
    Collinear(Vec<&'static str>),
}

impl std::fmt::Display for Unidentified {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::NoEffect => f.write_str("no effect on these flights"),
            Self::Collinear(others) if others.is_empty() => f.write_str("collinear with the other parameters"),
            Self::Collinear(others) => write!(f, "collinear with {}", others.join(", ")),
        }
    }
}

/// Status of a parameter after an identification.
#[derive(Debug, Clone, PartialEq)]
pub enum Status {
    /// The flights determine the parameter.
    Identified,
    /// The flights do not determine the parameter. It has its default, or a number near it that fits these flights as
    /// well as others would.
    NotIdentifiable(Unidentified),
    /// The flights do not show that the parameter differs from its default. It has its default. The estimate is the
    /// difference from the default in one step of the fit, for an inertia that of the logarithms.
    Insignificant(Estimate),
    /// The fit reached the smallest valid number.
    AtBound,
}

/// A parameter of an identified airframe.
///
/// The default of a parameter is no effect, and equal numbers for [`like`](Self::like). The default moments of inertia
/// about x and z and of the torque coefficient are those of the base airframe, the default motors hover at the mean
/// duty and voltage of the flights with a time constant of 0.05 s.
#[derive(Debug, Clone, PartialEq)]
pub struct FittedParameter {
    /// Key in the airframe file.
    pub name: &'static str,
    /// Unit.
    pub unit: &'static str,
    /// Number with its standard error, which is infinite if the number was not fitted.
    ///
    /// The standard error is robust to the correlation of the windows: a sandwich estimate with blocks of windows of
    /// 3 s, or the jackknife over flights if that is larger and there are at least four flights.
    pub estimate: Estimate,
    /// Identified parameter to which the number was fitted equal, because the flights do not separate them.
    pub like: Option<&'static str>,
    /// Status.
    pub status: Status,
}

/// Result of [`identify`].
#[derive(Debug, Clone, PartialEq)]
pub struct Identification {
    /// Airframe with the identified parameters.
    pub airframe: DroneParams,
    /// Parameters, in the order of the airframe file's keys by their effect.
    pub parameters: Vec<FittedParameter>,
    /// Alignment of every flight.
    pub alignments: Vec<Alignment>,
    /// Number of windows in the fit.
    pub windows: usize,
    /// Half the sum of the squared weighted deviations at the minimum.
    pub cost: f64,
    /// Number of evaluations of all deviations.
    pub evaluations: usize,
    /// Predictions of the flights by the airframe, with the recorded and with the predicted attitude. The flights are
    /// as recorded, without the corrections of their alignment.
    pub compared: Vec<Compared>,
    /// Predictions of every flight by an airframe that was fitted to the other flights. Empty for a single flight, and
    /// if the other flights of one do not determine a valid airframe.
    pub leave_one_out: Vec<LeftOut>,
}

/// Prediction of a flight by an airframe that was fitted to other flights.
#[derive(Debug, Clone, PartialEq)]
pub struct LeftOut {
    /// Airframe that was fitted to the other flights: one Gauss–Newton step from the minimum of all flights.
    pub airframe: DroneParams,
    /// Predictions of the flight.
    pub compared: Compared,
}

/// Identifies an airframe from recorded flights.
///
/// `base` has the mass, the dimensions and the coefficients that flights do not determine. `progress` receives the
/// part of the work that is done, from 0 to 1.
///
/// # Errors
/// [`FlightError::Missing`] for a flight without motors, gyro, or voltage; [`FlightError::Windows`] for a flight that
/// is too short, and without any flight.
pub fn identify(
    flights: &[Flight],
    base: &DroneParams,
    options: &IdentifyOptions,
    progress: &mut dyn FnMut(f64),
) -> Result<Identification, FlightError> {
    if flights.is_empty() {
        let message = "no flight, expected at least one".into();
        return Err(FlightError::Windows { flight: "identification".into(), message });
    }
    fit::run(flights, base, options, progress)
}

/// Serializes a number, or null if it is not finite.
#[allow(clippy::trivially_copy_pass_by_ref)] // serde passes a reference
fn finite_or_null<S: serde::Serializer>(number: &f64, serializer: S) -> Result<S::Ok, S::Error> {
    if number.is_finite() { serializer.serialize_f64(*number) } else { serializer.serialize_none() }
}
