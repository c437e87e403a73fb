//! Minimum of the cost for one body that touches the floor at one point.
//!
//! The residuals depend on the three components of the acceleration of the point only, and the response of the body to
//! a force at the point is a symmetric matrix of three rows. The minimum for given signs of the residuals is therefore
//! the solution of three equations.

use super::{MAX_SIGN_CHANGES, Settings, Spatial, Symmetric, dot, minus, negative, plus, times};
use crate::math::V3;

/// A number for each edge of the friction pyramid: towards x, −x, y and −y.
pub(in super::super) type PerEdge = [f64; 4];

/// Contact of one body at one point. Accelerations are linear in the world frame and angular in the body frame.
#[derive(Debug, Clone, Copy)]
pub(in super::super) struct PointContact {
    /// Mass (kg) and moments of inertia (kg·m²).
    pub inertia: Spatial,
    /// Reciprocals of `inertia`.
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

    /// Returns the acceleration of the body. `smooth` is its acceleration without contacts, and `start` the starting
    /// point of the solver. The signs of `edges` are an estimate of those of the residuals; they become the signs at
    /// the minimum.
    ///
    /// Returns `None` if MuJoCo may stop before the minimum.
    #[inline(always)]
    pub(in super::super) fn solve(
        &self,
        settings: &Settings,
        smooth: &Spatial,
        start: &Spatial,
        edges: &mut PerEdge,
    ) -> Option<Spatial> {
        let friction = settings.friction;
        let apparent = self.response().inverse();
        let free = self.residuals(friction, smooth);
        for _ in 0..MAX_SIGN_CHANGES {
            let gained = self.newton(friction, &apparent, &free, edges);
            let end = plus(&free, &Self::along_edges(friction, gained));
            let stays = has_signs_of(edges, &end);
            *edges = end;
            if stays {
                let gained = times(&self.inverse_inertia, &self.on_body(apparent.times(gained)));
                let reached = self.reaches(settings, smooth, start, &apparent, &free, edges);
                return reached.then_some(plus(smooth, &gained));
            }
        }
        None
    }

    /// Returns the change of the acceleration of the point by the edges whose residual is negative.
    #[inline(always)]
    fn newton(&self, friction: f64, apparent: &Symmetric, free: &PerEdge, edges: &PerEdge) -> V3<f64> {
        let (mut active, mut pulls) = ([0.0; 4], [0.0; 4]);
        for edge in 0..4 {
            active[edge] = if edges[edge] < 0.0 { self.weight } else { 0.0 };
            pulls[edge] = active[edge] * free[edge];
        }
        let [east, west, north, south] = active;
        let pull = Self::sum(friction, pulls);
        let [xx, yy, zz, xy, xz, yz] = apparent.0;
        let square = friction * friction;
        let (cofactors, inverse) = Symmetric([
            xx + square * (east + west),
            yy + square * (north + south),
            zz + ((east + west) + (north + south)),
            xy,
            xz + friction * (east - west),
            yz + friction * (north - south),
        ])
        .cofactors();
        cofactors.times(pull) * -inverse
    }

    /// Returns true if MuJoCo's iterations reach the minimum, where the residuals have the signs of `end`. The line
    /// searches are exact.
    #[inline(always)]
    fn reaches(
        &self,
        settings: &Settings,
        smooth: &Spatial,
        start: &Spatial,
        apparent: &Symmetric,
        free: &PerEdge,
        end: &PerEdge,
    ) -> bool {
        let friction = settings.friction;
        let (mut edges, mut from_smooth) = (self.residuals(friction, start), minus(start, smooth));
        let mut cost = self.cost(&edges, &from_smooth);
        let cost_of_smooth = self.cost(free, &[0.0; 6]);
        if cost > cost_of_smooth {
            (edges, from_smooth, cost) = (*free, [0.0; 6], cost_of_smooth);
        }
        for _ in 0..MAX_SIGN_CHANGES {
            // the next iteration ends at the minimum
            if has_signs_of(&edges, end) {
                return true;
            }
            let gained = self.newton(friction, apparent, free, &edges);
            let slope = minus(&plus(free, &Self::along_edges(friction, gained)), &edges);
            let gained = times(&self.inverse_inertia, &self.on_body(apparent.times(gained)));
            let search = minus(&gained, &from_smooth);
            let pull = times(&self.inertia, &search);
            let step = minimum(self.weight, &edges, &slope, dot(&pull, &from_smooth), dot(&pull, &search));
            for edge in 0..4 {
                edges[edge] += step * slope[edge];
            }
            for i in 0..6 {
                from_smooth[i] += step * search[i];
            }
            let mut forces = [0.0; 4];
            for edge in 0..4 {
                forces[edge] = self.weight * negative(edges[edge]);
            }
            let [x, y, z, ..] = times(&self.inertia, &from_smooth);
            let gradient = Self::sum(friction, forces) + V3::new(x, y, z);
            let new_cost = self.cost(&edges, &from_smooth);
            if !settings.goes_on(cost - new_cost, gradient) {
                return false;
            }
            cost = new_cost;
        }
        false
    }

    #[inline(always)]
    fn cost(&self, edges: &PerEdge, from_smooth: &Spatial) -> f64 {
        let mut squares = [0.0; 4];
        for edge in 0..4 {
            squares[edge] = negative(edges[edge]) * negative(edges[edge]);
        }
        let penalty = self.weight * ((squares[0] + squares[1]) + (squares[2] + squares[3]));
        0.5 * (dot(&times(&self.inertia, from_smooth), from_smooth) + penalty)
    }
}

/// Returns true if the numbers are negative at the same edges.
#[inline(always)]
fn has_signs_of(a: &PerEdge, b: &PerEdge) -> bool {
    let mut equal = true;
    for edge in 0..4 {
        equal &= (a[edge] < 0.0) == (b[edge] < 0.0);
    }
    equal
}

/// Returns the step at which the cost along a line is minimal. `slope` has the derivatives of the residuals; `linear`
/// and `square` are those of the part of the cost without contacts.
///
/// The derivative of the cost is piecewise linear and increases. Its corners are the zeros of the residuals.
#[inline(always)]
fn minimum(weight: f64, residual: &PerEdge, slope: &PerEdge, linear: f64, square: f64) -> f64 {
    let (mut corners, mut derivatives) = ([0.0; 4], [0.0; 4]);
    for edge in 0..4 {
        corners[edge] = -residual[edge] / slope[edge];
        derivatives[edge] = linear + corners[edge] * square;
    }
    for edge in 0..4 {
        let weighted = weight * slope[edge];
        for corner in 0..4 {
            derivatives[corner] += weighted * negative(residual[edge] + corners[corner] * slope[edge]);
        }
    }
    // the last corner before the minimum
    let mut last = 0.0;
    for corner in 0..4 {
        if derivatives[corner] < 0.0 && corners[corner] > last {
            last = corners[corner];
        }
    }
    let (mut linear, mut square) = (linear, square);
    for edge in 0..4 {
        let is_past = corners[edge] <= last;
        let active = if (slope[edge] < 0.0) == is_past { weight * slope[edge] } else { 0.0 };
        linear += active * residual[edge];
        square += active * slope[edge];
    }
    -linear / square
}
