//! Flights as files.

mod log;

pub use log::{CsvLog, RecordError};
