//! Minimum of the cost for one body that touches the floor at one point.
//!
//! The residuals depend on the three components of the acceleration of the point only, and the response of the body to
//! a force at the point is a symmetric matrix of three rows. The minimum for given signs of the residuals is therefore
//! the solution of three equations.

use super::{MAX_SIGN_CHANGES, Settings, Spatial, Symmetric, minus, plus, times};
use crate::math::V3;

/// A number for each edge of the friction pyramid: towards x, −x, y and −y.
pub(in super::super) type PerEdge = [f64; 4];

/// Contact of one body at one point. Accelerations are linear in the world frame and angular in the body frame.
#[derive(Debug, Clone, Copy)]
pub(in super::super) struct PointContact {
    /// Reciprocals of mass (1/kg) and moments of inertia (1/(kg·m²)).
    pub inverse_inertia: Spatial,
    /// Accelerations of the point by angular accelerations about the body axes, world frame, m.
    pub levers: [V3<f64>; 3],
    /// Weight of the edges, kg.
    pub weight: f64,
    /// Reference accelerations of the edges, m/s².
    pub reference: PerEdge,
}

impl PointContact {
    /// Returns the acceleration or velocity of the point for a motion of the body.
    #[inline(always)]
    pub(in super::super) fn of_point(levers: &[V3<f64>; 3], motion: &Spatial) -> V3<f64> {
        let [x, y, z, a, b, c] = *motion;
        V3::new(x, y, z) + levers[0] * a + (levers[1] * b + levers[2] * c)
    }

    /// Returns the components of a vector along the edges.
    #[inline(always)]
    pub(in super::super) fn along_edges(friction: f64, v: V3<f64>) -> PerEdge {
        let (across, along) = (friction * v.x, friction * v.y);
        [v.z + across, v.z - across, v.z + along, v.z - along]
    }

    /// Returns the sum of forces along the edges.
    #[inline(always)]
    fn sum(friction: f64, [east, west, north, south]: PerEdge) -> V3<f64> {
        V3::new(friction * (east - west), friction * (north - south), (east + west) + (north + south))
    }

    /// Returns the product of the transposed Jacobian and a force at the point.
    #[inline(always)]
    fn on_body(&self, force: V3<f64>) -> Spatial {
        let [a, b, c] = &self.levers;
        [force.x, force.y, force.z, a.dot(force), b.dot(force), c.dot(force)]
    }

    /// Returns the inverse of the apparent inertia of the body at the point.
    #[inline(always)]
    fn response(&self) -> Symmetric {
        let [m, _, _, ja, jb, jc] = self.inverse_inertia;
        let [a, b, c] = &self.levers;
        let (sa, sb, sc) = (*a * ja, *b * jb, *c * jc);
        Symmetric([
            m + a.x * sa.x + (b.x * sb.x + c.x * sc.x),
            m + a.y * sa.y + (b.y * sb.y + c.y * sc.y),
            m + a.z * sa.z + (b.z * sb.z + c.z * sc.z),
            a.x * sa.y + (b.x * sb.y + c.x * sc.y),
            a.x * sa.z + (b.x * sb.z + c.x * sc.z),
            a.y * sa.z + (b.y * sb.z + c.y * sc.z),
        ])
    }

    /// Returns the residuals of the edges for an acceleration of the body.
    #[inline(always)]
    pub(in super::super) fn residuals(&self, friction: f64, motion: &Spatial) -> PerEdge {
        minus(&Self::along_edges(friction, Self::of_point(&self.levers, motion)), &self.reference)
    }

    /// Returns the acceleration of the body. `smooth` is its acceleration without contacts. The signs of `edges` are an
    /// estimate of those of the residuals; they become the signs at the minimum.
    ///
    /// Returns `None` if MuJoCo may stop before the minimum.
    #[inline(always)]
    pub(in super::super) fn solve(
        &self,
        settings: &Settings,
        smooth: &Spatial,
        edges: &mut PerEdge,
    ) -> Option<Spatial> {
        let friction = settings.friction;
        let Self { inverse_inertia, weight, .. } = self;
        let response = self.response();
        let [xx, yy, zz, ..] = response.0;
        let apparent = response.inverse();
        let free = self.residuals(friction, smooth);
        let square = friction * friction;
        // sum over the edges of eᵀM⁻¹e, and a bound of the largest one
        let trace = 2.0 * square * (xx + yy) + 4.0 * zz;
        let largest = trace - 2.0 * zz;
        let near = settings.margin(1.0 + weight * trace) * largest;
        let scale = weight * largest;
        for _ in 0..MAX_SIGN_CHANGES {
            let (mut active, mut pulls) = ([0.0; 4], [0.0; 4]);
            for edge in 0..4 {
                active[edge] = if edges[edge] < 0.0 { *weight } else { 0.0 };
                pulls[edge] = active[edge] * free[edge];
            }
            let [east, west, north, south] = active;
            let pull = Self::sum(friction, pulls);
            let [xx, yy, zz, xy, xz, yz] = apparent.0;
            let (cofactors, inverse) = Symmetric([
                xx + square * (east + west),
                yy + square * (north + south),
                zz + ((east + west) + (north + south)),
                xy,
                xz + friction * (east - west),
                yz + friction * (north - south),
            ])
            .cofactors();
            let gained = cofactors.times(pull) * -inverse;
            let end = plus(&free, &Self::along_edges(friction, gained));
            let (mut stays, mut clear) = (true, true);
            for i in 0..4 {
                stays &= (edges[i] < 0.0) == (end[i] < 0.0);
                clear &= end[i] * end[i] * (if end[i] < 0.0 { scale } else { 1.0 }) > near;
            }
            if stays {
                let gained = times(inverse_inertia, &self.on_body(apparent.times(gained)));
                return clear.then_some(plus(smooth, &gained));
            }
            *edges = end;
        }
        None
    }
}
