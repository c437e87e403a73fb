//! Initial states of training episodes.

use aviary::env::InitialRanges;
use serde::{Deserialize, Serialize};

/// Initial states and length of some training episodes.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TrainingStart {
    /// Largest change of each position coordinate, m.
    pub position: f64,
    /// Largest change of roll, pitch and yaw, rad.
    pub attitude: f64,
    /// Largest change of each velocity component, m/s.
    pub velocity: f64,
    /// Offset of the centre of these ranges from the task's initial position, world frame, m.
    pub offset: [f64; 3],
    /// Maximum length of these episodes, s; `None` for the task's default.
    pub seconds: Option<f64>,
    /// True if the other groups of the randomization apply as well; false for nominal parameters and perfect sensors.
    #[serde(skip_serializing_if = "is_true")]
    pub randomized: bool,
}

/// Returns true for true.
fn is_true(value: &bool) -> bool {
    *value
}

impl Default for TrainingStart {
    fn default() -> Self {
        let InitialRanges { position, attitude, velocity, offset } = InitialRanges::default();
        Self { position, attitude, velocity, offset, seconds: None, randomized: true }
    }
}

impl TrainingStart {
    /// Returns the ranges of the initial states.
    pub fn ranges(&self) -> InitialRanges {
        let Self { position, attitude, velocity, offset, .. } = *self;
        InitialRanges { position, attitude, velocity, offset }
    }
}
