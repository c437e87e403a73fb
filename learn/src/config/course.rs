//! Rewards of courses in training.

use aviary::tasks::{Course, FlyThrough, Race};
use serde::{Deserialize, Serialize};

/// Rewards of a course; see [`FlyThrough`] and [`Race`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CourseRewards {
    /// Reward for a waypoint or gate.
    pub point: f64,
    /// Penalty per control step and metre of distance to the next waypoint or gate.
    pub distance: f64,
    /// Reward per control step and m/s of speed; used by race only.
    pub speed: f64,
}

/// Returns the task with a name and with course rewards; `None` if it has no course.
pub(super) fn course_of(name: &str, rewards: CourseRewards) -> Option<Course> {
    let CourseRewards { point, distance, speed } = rewards;
    match name {
        "fly_through" => {
            let mut task = FlyThrough::default();
            (task.capture_reward, task.distance_penalty) = (point, distance);
            Some(Course::FlyThrough(task))
        }
        "race" => {
            let mut race = Race::default();
            (race.gate_reward, race.speed_reward, race.distance_penalty) = (point, speed, distance);
            Some(Course::Race(race))
        }
        _ => None,
    }
}
