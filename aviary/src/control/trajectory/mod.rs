//! Trajectories: position and yaw as functions of time, with exact derivatives of the position up to the snap.

mod file;
mod jet;
mod periodic;
mod steps;
mod time_law;
mod waypoints;

use std::fmt;
use std::path::PathBuf;

use super::Reference;
use crate::SystemError;

pub use file::{NAMES, from_file, from_toml, named};
pub use periodic::{Heading, PeriodicTrajectory, Plane};
pub use steps::Steps;
pub use waypoints::{Waypoints, WaypointsBuilder};

/// A reference as a function of time.
///
/// ```
/// use aviary::control::Reference;
/// use aviary::control::trajectory::Trajectory;
/// use nalgebra::Vector3;
///
/// /// Climb at 0.5 m/s for 2 s.
/// #[derive(Debug)]
/// struct Climb;
///
/// impl Trajectory for Climb {
///     fn reference(&self, time: f64) -> Reference {
///         let inside = time.clamp(0.0, self.duration());
///         let climb = if time == inside { 0.5 } else { 0.0 };
///         let place = Reference::hover(Vector3::new(0.0, 0.0, 0.1 + 0.5 * inside), 0.0);
///         Reference { velocity: Vector3::new(0.0, 0.0, climb), ..place }
///     }
///
///     fn duration(&self) -> f64 {
///         2.0
///     }
/// }
///
/// assert_eq!(Climb.start(), Reference::hover(Vector3::new(0.0, 0.0, 0.1), 0.0));
/// assert!((Climb.reference(9.0).position.z - 1.1).abs() < 1e-12);
/// ```
pub trait Trajectory: fmt::Debug + Send + Sync {
    /// Returns the reference at a time, s.
    ///
    /// Before time 0 it is the start of the trajectory, after the end it is the end, both at rest.
    fn reference(&self, time: f64) -> Reference;

    /// Returns the duration, s. For a trajectory without an end it is the duration of one turn, including the ramp.
    fn duration(&self) -> f64;

    /// Returns the position and yaw at which the trajectory starts, at rest.
    fn start(&self) -> Reference {
        let first = self.reference(0.0);
        Reference::hover(first.position, first.yaw)
    }
}

/// Error of a trajectory.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum TrajectoryError {
    /// A value outside its range.
    #[error("{what} is {}, expected {expected}", crate::number(*got))]
    Value {
        /// Name of the value.
        what: &'static str,
        /// Invalid value.
        got: f64,
        /// Valid values.
        expected: &'static str,
    },
    /// Gaps between waypoint times that differ too much to compute the polynomials.
    #[error("the gaps between the waypoint times differ too much, expected gaps of one order of magnitude")]
    Unsolvable,
    /// Text that is not a trajectory in TOML.
    #[error("{message}")]
    Toml {
        /// Line, column and expected value.
        message: String,
    },
    /// A file that the system cannot read or write.
    #[error(transparent)]
    System(#[from] SystemError),
    /// A file without a valid trajectory.
    #[error("{}: {error}", path.display())]
    File {
        /// Path of the file.
        path: PathBuf,
        /// Error in the file.
        #[source]
        error: Box<Self>,
    },
}

impl TrajectoryError {
    fn validate(what: &'static str, got: f64, good: bool, expected: &'static str) -> Result<(), Self> {
        if good { Ok(()) } else { Err(Self::Value { what, got, expected }) }
    }
}
