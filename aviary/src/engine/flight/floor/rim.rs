use super::super::contact_solver::FloorPoints;
use super::super::floor_model::Cylinder;
use crate::math::V3;

/// Smallest norm that MuJoCo divides by.
pub(super) const MIN_NORM: f64 = 1e-15;

/// Points of a cylinder that MuJoCo tests against the floor (`mjc_PlaneCylinder`), relative to the centre.
#[derive(Debug, Clone, Copy)]
pub(super) struct RimPoints {
    /// From the centre of the lower rim to its lowest point, m.
    out: V3<f64>,
    /// From the centre of the cylinder to the centre of the lower rim, m.
    axis: V3<f64>,
    /// Height of the lowest point of the lower rim, m.
    lowest: f64,
    /// Height of the lowest point of the upper rim, m.
    upper: f64,
    /// Height of two more points on the lower rim, which form a triangle with the lowest one, m.
    side: f64,
}

impl RimPoints {
    /// Finds the points of a cylinder at a height (m) of its centre with a rotation matrix (by rows).
    #[inline(always)]
    pub(super) fn new(cylinder: &Cylinder, height: f64, matrix: &[[f64; 3]; 3]) -> Self {
        let [[x0, _, mut ax], [x1, _, mut ay], [x2, _, mut az]] = *matrix;
        // the axis points down
        if az > 0.0 {
            (ax, ay, az) = (-ax, -ay, -az);
        }
        // towards the lowest point of the lower rim
        let out = V3::new(ax * az, ay * az, az * az - 1.0);
        let length = out.norm();
        let out =
            if length >= MIN_NORM { out * (cylinder.radius / length) } else { V3::new(x0, x1, x2) * cylinder.radius };
        let axis = V3::new(ax, ay, az) * cylinder.half_height;
        let (above, below) = (height - axis.z, height + axis.z);
        Self { out, axis, lowest: below + out.z, upper: above + out.z, side: below - 0.5 * out.z }
    }

    /// Returns the number of contact points.
    #[inline(always)]
    pub(super) fn count(&self) -> usize {
        // a touch at a distance of zero is no contact for the solver; NaN touches nothing
        if self.lowest <= 0.0 {
            usize::from(self.lowest < 0.0) + usize::from(self.upper < 0.0) + 2 * usize::from(self.side < 0.0)
        } else {
            0
        }
    }

    /// Returns the height (m) of the lowest point of the lower rim, and the position of its contact.
    #[inline(always)]
    pub(super) fn lowest(&self) -> (f64, V3<f64>) {
        let V3 { x, y, z } = self.out + self.axis;
        (self.lowest, V3::new(x, y, z - 0.5 * self.lowest))
    }

    /// Returns the contact points of a cylinder of this radius, m.
    #[inline(always)]
    pub(super) fn points(&self, radius: f64) -> FloorPoints {
        let Self { out, axis, lowest, upper, side } = *self;
        let mut points = FloorPoints::default();
        if self.count() == 0 {
            return points;
        }
        if lowest < 0.0 {
            points.add(out + axis, lowest);
        }
        if upper < 0.0 {
            points.add(out - axis, upper);
        }
        if side < 0.0 {
            let across = out.cross(axis);
            let norm = across.norm();
            let scale = radius * 3.0_f64.sqrt() / 2.0;
            let across = if norm < MIN_NORM { V3::new(scale, 0.0, 0.0) } else { across * (1.0 / norm) * scale };
            let place = axis - out * 0.5;
            points.add(place + across, side);
            points.add(place - across, side);
        }
        points
    }
}
