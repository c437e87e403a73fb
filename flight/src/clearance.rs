//! Collision cylinders of drones and their clearance from the floor, and bounding spheres.

use crate::math::{Real, V3};

/// Collision cylinder of a drone, centred on the body, with its axis along body z.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CollisionCylinder<R = f64> {
    /// Radius, m.
    pub radius: R,
    /// Height, m.
    pub height: R,
}

impl<R: Real> CollisionCylinder<R> {
    /// Returns the depth of the lowest point of the cylinder below its centre, m, for the cosine and the sine of the
    /// angle between its axis and the vertical.
    #[inline(always)]
    pub fn depth(&self, cos: R, sin: R) -> R {
        self.height * 0.5 * cos.abs() + self.radius * sin
    }

    /// Returns the height of the lowest point of the cylinder above the floor, m, from the height of its centre (m) and
    /// the world z component of body z; negative below the floor.
    #[inline(always)]
    pub fn floor_clearance(&self, height: R, up: R) -> R {
        // without trigonometric functions, because engines call this before physics steps
        let square = -(up * up) + 1.0;
        height - self.depth(up, square.greater(up.all(0.0)).sqrt())
    }

    /// Returns an upper bound of the rounding error of MuJoCo's contact points with the floor, m, for body z in the
    /// world frame, without a root and a division.
    #[inline(always)]
    pub fn coarse_rounding_of_contacts(&self, up: V3<R>) -> R {
        let square = up.x * up.x + up.y * up.y;
        let is_below = |sine: f64| square.less(square.all(sine * sine));
        let tilted = R::choose(is_below(2e-10), self.radius, self.radius * 1e-5);
        R::choose(is_below(4e-16), square.all(0.0), tilted)
    }
}

/// Returns the clearance between two spheres, m; negative if they overlap.
#[inline(always)]
pub fn sphere_clearance<R: Real>(position: V3<R>, radius: R, other: V3<R>, other_radius: R) -> R {
    (position - other).norm() - radius - other_radius
}

/// Returns the clearance of a sphere from the floor, m; negative if it meets the floor.
#[inline(always)]
pub fn sphere_floor_clearance<R: Real>(position: V3<R>, radius: R) -> R {
    position.z - radius
}
