//! The curve of a run: a point for every iteration.

use serde::{Deserialize, Serialize};

use crate::evaluation::Score;
use crate::ppo::Report;

/// How the training stood after an iteration.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Point {
    /// Iterations so far.
    pub iteration: u64,
    /// Environment steps so far.
    pub steps: u64,
    /// What the last one did.
    pub report: Report,
    /// Evaluation after it, if there was one.
    pub score: Option<Score>,
    /// Adam's rate.
    pub rate: f64,
}
