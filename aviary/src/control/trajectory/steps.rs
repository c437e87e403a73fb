use nalgebra::Vector3;

use super::{Trajectory, TrajectoryError};
use crate::control::Reference;

/// A sequence of positions and yaws that are held for a fixed time each.
///
/// ```
/// use aviary::control::trajectory::{Steps, Trajectory};
///
/// let square = Steps::square(1.0, 4.0)?;
/// assert_eq!(square.reference(4.1).position.as_slice(), [1.0, 1.0, 1.0]);
/// # Ok::<(), aviary::control::trajectory::TrajectoryError>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct Steps {
    places: Vec<(Vector3<f64>, f64)>,
    hold: f64,
    start: (Vector3<f64>, f64),
}

impl Steps {
    /// Creates a sequence of places (position in the world frame, m, and yaw, rad), each held for `hold` seconds.
    /// `start` is the position before time 0.
    ///
    /// # Errors
    /// [`TrajectoryError::Value`] for an empty list, or for a value outside its range.
    pub fn new(start: [f64; 3], places: &[([f64; 3], f64)], hold: f64) -> Result<Self, TrajectoryError> {
        let count = places.len();
        TrajectoryError::validate("the number of points", count as f64, count > 0, "at least 1")?;
        TrajectoryError::validate("hold", hold, (1e-3..=1e6).contains(&hold), "a positive time, s")?;
        for (position, yaw) in places.iter().map(|(position, yaw)| (position, *yaw)).chain([(&start, 0.0)]) {
            for x in position.iter().copied().chain([yaw]) {
                TrajectoryError::validate("a number in points or yaws", x, x.abs() <= 1e6, "finite numbers up to 1e6")?;
            }
        }
        let places: Vec<_> = places.iter().map(|&(position, yaw)| (position.into(), yaw)).collect();
        Ok(Self { start: (start.into(), places[0].1), places, hold })
    }

    /// Creates a step from one position to another (world frame, m) at time 0, with yaw 0.
    ///
    /// # Errors
    /// As for [`new`](Self::new).
    pub fn step(from: [f64; 3], to: [f64; 3], hold: f64) -> Result<Self, TrajectoryError> {
        Self::new(from, &[(to, 0.0)], hold)
    }

    /// Creates a square with sides of `side` metres at a height of 1 m. It starts at (0, 0), moves to (side, 0)
    /// first, and holds every corner for `hold` seconds.
    ///
    /// # Errors
    /// As for [`new`](Self::new).
    pub fn square(side: f64, hold: f64) -> Result<Self, TrajectoryError> {
        let corners = [[side, 0.0, 1.0], [side, side, 1.0], [0.0, side, 1.0], [0.0, 0.0, 1.0]];
        Self::new([0.0, 0.0, 1.0], &corners.map(|corner| (corner, 0.0)), hold)
    }
}

impl Trajectory for Steps {
    fn reference(&self, time: f64) -> Reference {
        let (position, yaw) = if time < 0.0 {
            self.start
        } else {
            self.places[((time / self.hold + 1e-9) as usize).min(self.places.len() - 1)]
        };
        Reference::hover(position, yaw)
    }

    fn start(&self) -> Reference {
        Reference::hover(self.start.0, self.start.1)
    }

    fn duration(&self) -> f64 {
        self.hold * self.places.len() as f64
    }
}
