//! What controllers follow: positions as functions of time, with exact derivatives up to the snap, and yaw.

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

/// A reference that moves.
///
/// ```
/// use aviary::control::Reference;
/// use aviary::control::trajectory::Trajectory;
/// use nalgebra::Vector3;
///
/// /// Up by half a metre per second, for two seconds.
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
    /// What to follow at a time, s: before 0 the start, at rest, and after the end what was there.
    fn reference(&self, time: f64) -> Reference;

    /// When it is over, s; one turn (and its ramp) where it never is.
    fn duration(&self) -> f64;

    /// Where a drone should be that is about to follow it, at rest.
    fn start(&self) -> Reference {
        let first = self.reference(0.0);
        Reference::hover(first.position, first.yaw)
    }
}

/// What can be wrong with a trajectory.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum TrajectoryError {
    /// A number that no trajectory has.
    #[error("{what} is {}, expected {expected}", crate::number(*got))]
    Value {
        /// What it is.
        what: &'static str,
        /// What was given.
        got: f64,
        /// What is possible.
        expected: &'static str,
    },
    /// Waypoints whose times differ so much that the polynomials cannot be computed.
    #[error("no polynomials go through these waypoints at these times, expected times of one order of magnitude")]
    Unsolvable,
    /// Text that is no trajectory in TOML.
    #[error("{message}")]
    Toml {
        /// Line, column and what was expected.
        message: String,
    },
    /// A file that the system cannot read or write.
    #[error(transparent)]
    System(#[from] SystemError),
    /// A file that holds no valid trajectory.
    #[error("{}: {error}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        #[source]
        error: Box<Self>,
    },
}

impl TrajectoryError {
    fn validate(what: &'static str, got: f64, good: bool, expected: &'static str) -> Result<(), Self> {
        if good { Ok(()) } else { Err(Self::Value { what, got, expected }) }
    }
}
