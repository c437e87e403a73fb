//! Training curve: one point per iteration.

use serde::{Deserialize, Serialize};

use crate::evaluation::Score;
use crate::ppo::Report;

/// State of the training after an iteration.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Point {
    /// Number of iterations so far.
    pub iteration: u64,
    /// Number of environment steps so far.
    pub steps: u64,
    /// Statistics of the last iteration.
    pub report: Report,
    /// Score of the evaluation after the iteration, if one was due.
    pub score: Option<Score>,
    /// Learning rate.
    pub rate: f64,
}
