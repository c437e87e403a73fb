use nalgebra::Vector3;

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
