//! Recorded flights of real drones: reading, and comparison with the simulator.
//!
//! A [`Flight`] is a table with one row per time step: motion capture, gyro, accelerometer, motor commands and battery
//! voltage. [`COLUMNS`] lists its columns with their units.

pub mod identify;

mod cflib_log;
mod compare;
mod dynamics;
mod exchange;
mod log;
mod observer;
mod predict;
mod raw_log;
mod table;
mod units;
mod usd_log;
mod window;

use std::path::{Path, PathBuf};

pub use compare::{Compared, Track, compare, plot_window};
pub use exchange::{PREDICTION_COLUMNS, PredictionRow, read_predictions, write_predictions};
pub use log::{Flight, flight_files, read_flights};
pub use observer::{ObserverParams, RotationFilter, TranslationFilter};
pub use predict::{AttitudeSource, Predictor};
pub use raw_log::CrazyflieLog;
pub use table::{COLUMNS, FlightTable};
pub use window::{Errors, HORIZONS, Predicted, Score, Window};

use crate::SystemError;

/// Largest deviation of the norm of a quaternion in a file from 1.
const NORM_TOLERANCE: f64 = 1e-3;

/// Error of a recorded flight.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum FlightError {
    /// A file that cannot be read or written.
    #[error("{}: {error}", path.display())]
    File {
        /// Path of the file.
        path: PathBuf,
        /// Error of the system.
        #[source]
        error: SystemError,
    },
    /// A file that is not a valid flight.
    #[error("{}: {message}", place(path, *line))]
    Read {
        /// Path of the file.
        path: PathBuf,
        /// Line in the file, from 1; 0 for the whole file.
        line: usize,
        /// Description of the error and the expected content.
        message: String,
    },
    /// An airframe whose motors a duty cannot drive.
    #[error("the airframe {name} has no `motors.speed_per_volt`, expected motors that a duty drives")]
    Airframe {
        /// Name of the airframe.
        name: String,
    },
    /// A flight without windows for predictions.
    #[error("{flight}: {message}")]
    Windows {
        /// Name of the flight.
        flight: String,
        /// Description of the error and the expected content.
        message: String,
    },
    /// A flight without columns that a computation requires.
    #[error(
        "{flight}: no {} {}, expected for {purpose}",
        if columns.len() == 1 { "column" } else { "columns" },
        columns.iter().map(|name| format!("`{name}`")).collect::<Vec<_>>().join(", ")
    )]
    Missing {
        /// Name of the flight.
        flight: String,
        /// Names of the missing columns.
        columns: Vec<&'static str>,
        /// Purpose of the columns.
        purpose: &'static str,
    },
}

impl FlightError {
    fn file(path: &Path, error: std::io::Error) -> Self {
        Self::File { path: path.into(), error: error.into() }
    }

    fn read(path: &Path, (line, message): table::TableError) -> Self {
        Self::Read { path: path.into(), line, message }
    }
}

/// Returns the place of an error in a file, for messages.
fn place(path: &Path, line: usize) -> String {
    match line {
        0 => path.display().to_string(),
        line => format!("{}: line {line}", path.display()),
    }
}
