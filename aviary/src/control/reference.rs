use nalgebra::Vector3;

use crate::math::{Real, ToFlight as _, V3};
use crate::state::wrap_angle;

/// Target state of a drone at one time: position and yaw with their derivatives.
///
/// Each controller uses the derivatives that its feed-forward supports.
///
/// ```
/// use aviary::control::Reference;
/// use nalgebra::Vector3;
///
/// let cruise = Reference { velocity: Vector3::new(1.0, 0.0, 0.0), ..Reference::hover(Vector3::z(), 0.0) };
/// assert_eq!(cruise.acceleration, Vector3::zeros());
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Reference {
    /// Position, world frame, m.
    pub position: Vector3<f64>,
    /// Velocity, world frame, m/s.
    pub velocity: Vector3<f64>,
    /// Acceleration, world frame, m/s².
    pub acceleration: Vector3<f64>,
    /// Jerk, world frame, m/s³. It determines the body rates along a trajectory.
    pub jerk: Vector3<f64>,
    /// Snap, world frame, m/s⁴. It determines the torques along a trajectory.
    pub snap: Vector3<f64>,
    /// Yaw, rad.
    pub yaw: f64,
    /// Yaw rate, rad/s.
    pub yaw_rate: f64,
    /// Yaw acceleration, rad/s².
    pub yaw_acceleration: f64,
}

impl Reference {
    /// Creates a reference at rest, from a position (world frame, m) and a yaw (rad).
    pub fn hover(position: Vector3<f64>, yaw: f64) -> Self {
        Self { position, yaw, ..Self::default() }
    }

    /// Returns true if every value is finite.
    pub fn is_finite(&self) -> bool {
        [self.position, self.velocity, self.acceleration, self.jerk, self.snap].iter().flatten().all(|x| x.is_finite())
            && [self.yaw, self.yaw_rate, self.yaw_acceleration].iter().all(|x| x.is_finite())
    }
}

/// [`Reference`] of one drone or of a register of drones. The yaw is in [−π, π].
#[derive(Debug, Clone, Copy)]
pub(crate) struct Target<R> {
    pub position: V3<R>,
    pub velocity: V3<R>,
    pub acceleration: V3<R>,
    pub jerk: V3<R>,
    pub snap: V3<R>,
    pub yaw: R,
    pub yaw_rate: R,
    pub yaw_acceleration: R,
}

impl<R: Real> Target<R> {
    /// Creates a target at rest, from a position (world frame, m) and a yaw (rad).
    #[inline(always)]
    pub fn hover(position: V3<R>, yaw: R) -> Self {
        let none = V3::zero(yaw);
        Self {
            position,
            velocity: none,
            acceleration: none,
            jerk: none,
            snap: none,
            yaw,
            yaw_rate: none.x,
            yaw_acceleration: none.x,
        }
    }
}

impl From<&Reference> for Target<f64> {
    fn from(reference: &Reference) -> Self {
        Self {
            position: reference.position.to_flight(),
            velocity: reference.velocity.to_flight(),
            acceleration: reference.acceleration.to_flight(),
            jerk: reference.jerk.to_flight(),
            snap: reference.snap.to_flight(),
            yaw: wrap_angle(reference.yaw),
            yaw_rate: reference.yaw_rate,
            yaw_acceleration: reference.yaw_acceleration,
        }
    }
}

/// Part of a target that a controller tracks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Goal {
    /// Position and its derivatives.
    Position,
    /// Velocity and its derivatives. The position of the target is that of the drone.
    Velocity,
}
