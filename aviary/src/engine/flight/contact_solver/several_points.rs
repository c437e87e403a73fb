//! Minimum of the cost for one body that touches the floor at several points.

use pulp::Simd;

use super::super::floor_model::{FloorContact, Impedance};
use super::quad::Quad;
use super::{MAX_SIGN_CHANGES, NEVER, PerPoint, Settings, Spatial, Symmetric, dot, minus, plus, times};
use crate::math::V3;

/// Contact points of one body.
#[derive(Debug, Clone, Copy, Default)]
pub(in super::super) struct FloorPoints {
    /// Number of points.
    pub count: usize,
    /// Positions of the points relative to the centre of mass, world frame, m, by coordinate.
    pub arm: [PerPoint; 3],
    /// Heights of the points of the body above the floor, m: negative, and zero for absent points.
    pub height: PerPoint,
}

impl FloorPoints {
    /// Adds a point of the body at a position relative to the centre of mass and a height, m. MuJoCo's contact is
    /// halfway between the point and the floor.
    #[inline(always)]
    pub(in super::super) fn add(&mut self, place: V3<f64>, height: f64) {
        let Self { count, arm: [x, y, z], height: heights } = self;
        (x[*count], y[*count], z[*count]) = (place.x, place.y, place.z - 0.5 * height);
        heights[*count] = height;
        *count += 1;
    }
}

/// Contacts of one body. Accelerations are linear in the world frame and angular in the body frame.
#[derive(Debug, Clone, Copy)]
pub(in super::super) struct PointContacts<S: Simd> {
    simd: S,
    /// Mass (kg) and moments of inertia (kg·m²).
    inertia: Spatial,
    /// Accelerations of the points by angular accelerations about the body axes (rows), world frame, by coordinate, m.
    levers: [[Quad<S>; 3]; 3],
    /// Weight of the edges of each point, kg.
    weight: Quad<S>,
    /// Reference accelerations of the edges, m/s².
    reference: [Quad<S>; 4],
}

impl<S: Simd> PointContacts<S> {
    /// Creates the contacts of a body that has this inertia, rotation matrix (by rows) and velocity.
    #[inline(always)]
    pub(in super::super) fn new(
        simd: S,
        contact: &FloorContact,
        inertia: Spatial,
        matrix: &[[f64; 3]; 3],
        velocity: &Spatial,
        points: &FloorPoints,
    ) -> Self {
        let FloorContact { solver, stiffness, damping, .. } = contact;
        let [ax, ay, az] = points.arm;
        let (ax, ay, az) = (Quad::load(simd, ax), Quad::load(simd, ay), Quad::load(simd, az));
        let (height, zero) = (Quad::load(simd, points.height), Quad::load(simd, [0.0; 4]));
        let [r0, r1, r2] = matrix;
        let impedance = impedances(simd, &contact.impedance, height * -1.0);
        let rest = impedance * -1.0 + 1.0;
        let weight = impedance / (rest * contact.diagonal(1.0 / inertia[0]));
        let mut contacts = Self {
            simd,
            inertia,
            levers: [
                [az * r1[0] - ay * r2[0], ax * r2[0] - az * r0[0], ay * r0[0] - ax * r1[0]],
                [az * r1[1] - ay * r2[1], ax * r2[1] - az * r0[1], ay * r0[1] - ax * r1[1]],
                [az * r1[2] - ay * r2[2], ax * r2[2] - az * r0[2], ay * r0[2] - ax * r1[2]],
            ],
            weight: height.if_negative(weight, zero),
            reference: [zero; 4],
        };
        let never = Quad::load(simd, [NEVER; 4]);
        let push = impedance * height * *stiffness;
        let speeds = contacts.along_edges(solver.friction, velocity);
        for (reference, speeds) in contacts.reference.iter_mut().zip(speeds) {
            *reference = height.if_negative(speeds * -damping - push, never);
        }
        contacts
    }

    /// Returns the accelerations of the points along their edges for an acceleration of the body.
    #[inline(always)]
    fn along_edges(&self, friction: f64, motion: &Spatial) -> [Quad<S>; 4] {
        let [x, y, z, a, b, c] = *motion;
        let [la, lb, lc] = &self.levers;
        let across = (la[0] * a + (lb[0] * b + lc[0] * c) + x) * friction;
        let along = (la[1] * a + (lb[1] * b + lc[1] * c) + y) * friction;
        let up = la[2] * a + (lb[2] * b + lc[2] * c) + z;
        [up + across, up - across, up + along, up - along]
    }

    #[inline(always)]
    fn residuals(&self, friction: f64, motion: &Spatial) -> [Quad<S>; 4] {
        let [east, west, north, south] = self.along_edges(friction, motion);
        let reference = &self.reference;
        [east - reference[0], west - reference[1], north - reference[2], south - reference[3]]
    }

    /// Returns the acceleration of the body by MuJoCo's iterations from `start`, with exact line searches. `smooth` is
    /// the acceleration without contacts. Returns `None` if MuJoCo may stop before the minimum.
    #[inline(always)]
    pub(in super::super) fn solve(&self, settings: &Settings, smooth: &Spatial, start: &Spatial) -> Option<Spatial> {
        let friction = settings.friction;
        let free = self.residuals(friction, smooth);
        let (mut edges, mut acceleration) = (self.residuals(friction, start), *start);
        let mut cost = self.cost(&edges, &minus(start, smooth));
        let cost_of_smooth = self.cost(&free, &[0.0; 6]);
        if cost > cost_of_smooth {
            (edges, acceleration, cost) = (free, *smooth, cost_of_smooth);
        }
        for _ in 0..MAX_SIGN_CHANGES {
            let from_smooth = minus(&acceleration, smooth);
            let search = self.newton(friction, &edges, &from_smooth);
            let slopes = self.along_edges(friction, &search);
            let mut stays = true;
            for edge in 0..4 {
                stays &= (edges[edge] + slopes[edge]).has_signs_of(edges[edge]);
            }
            if stays {
                return Some(plus(&acceleration, &search));
            }
            let step = self.search(&edges, &slopes, &search, &from_smooth)?;
            for edge in 0..4 {
                edges[edge] = edges[edge] + slopes[edge] * step;
            }
            for (acceleration, search) in acceleration.iter_mut().zip(&search) {
                *acceleration += step * search;
            }
            let from_smooth = minus(&acceleration, smooth);
            let (new_cost, force) = (self.cost(&edges, &from_smooth), self.force(friction, &edges));
            let [x, y, z, ..] = times(&self.inertia, &from_smooth);
            let gradient = force + V3::new(x, y, z);
            if !settings.goes_on(cost - new_cost, gradient) {
                return None;
            }
            cost = new_cost;
        }
        None
    }

    /// Returns the step along a line to the minimum of the cost, by Newton's method. `slopes` are the derivatives of
    /// the residuals along the line. Returns `None` if the method does not end.
    #[inline(always)]
    fn search(
        &self,
        edges: &[Quad<S>; 4],
        slopes: &[Quad<S>; 4],
        search: &Spatial,
        from_smooth: &Spatial,
    ) -> Option<f64> {
        let zero = Quad::load(self.simd, [0.0; 4]);
        let pull = times(&self.inertia, search);
        let (linear, square) = (dot(&pull, from_smooth), dot(&pull, search));
        let mut step = 1.0;
        for _ in 0..MAX_SIGN_CHANGES {
            let (mut slope, mut curvature) = (zero, zero);
            for edge in 0..4 {
                let active = (edges[edge] + slopes[edge] * step).if_negative(slopes[edge], zero);
                slope = slope + active * edges[edge];
                curvature = curvature + active * active;
            }
            // the minimum of the parabola with these active edges
            let next = -(linear + (slope * self.weight).sum()) / (square + (curvature * self.weight).sum());
            let mut stays = true;
            for edge in 0..4 {
                stays &= (edges[edge] + slopes[edge] * step).has_signs_of(edges[edge] + slopes[edge] * next);
            }
            step = next;
            if stays {
                return Some(step);
            }
        }
        None
    }

    /// Returns the force of the negative residuals on the body.
    #[inline(always)]
    fn force(&self, friction: f64, edges: &[Quad<S>; 4]) -> V3<f64> {
        let zero = Quad::load(self.simd, [0.0; 4]);
        let east = edges[0].if_negative(edges[0], zero) * self.weight;
        let west = edges[1].if_negative(edges[1], zero) * self.weight;
        let north = edges[2].if_negative(edges[2], zero) * self.weight;
        let south = edges[3].if_negative(edges[3], zero) * self.weight;
        total(&[(east - west) * friction, (north - south) * friction, (east + west) + (north + south)])
    }

    #[inline(always)]
    fn cost(&self, edges: &[Quad<S>; 4], from_smooth: &Spatial) -> f64 {
        let zero = Quad::load(self.simd, [0.0; 4]);
        let mut squares = zero;
        for edge in edges {
            let negative = edge.if_negative(*edge, zero);
            squares = squares + negative * negative;
        }
        0.5 * (dot(&times(&self.inertia, from_smooth), from_smooth) + (squares * self.weight).sum())
    }

    /// Returns the Newton direction. The error of its rounding is relative to the direction, which is small at rest,
    /// where rounding decides about the contact points.
    #[inline(always)]
    fn newton(&self, friction: f64, edges: &[Quad<S>; 4], from_smooth: &Spatial) -> Spatial {
        let [la, lb, lc] = &self.levers;
        let zero = Quad::load(self.simd, [0.0; 4]);
        let east = edges[0].if_negative(self.weight, zero);
        let west = edges[1].if_negative(self.weight, zero);
        let north = edges[2].if_negative(self.weight, zero);
        let south = edges[3].if_negative(self.weight, zero);
        // symmetric weights of the acceleration of the point; that of x with y is zero
        let square = friction * friction;
        let (xx, yy, zz) = ((east + west) * square, (north + south) * square, (east + west) + (north + south));
        let (xz, yz) = ((east - west) * friction, (north - south) * friction);
        let (east, west, north, south) = (east * edges[0], west * edges[1], north * edges[2], south * edges[3]);
        let (x, y, z) = ((east - west) * friction, (north - south) * friction, (east + west) + (north + south));
        // columns of the product of the weights and the Jacobian of the angular acceleration
        let ka = [xx * la[0] + xz * la[2], yy * la[1] + yz * la[2], xz * la[0] + yz * la[1] + zz * la[2]];
        let kb = [xx * lb[0] + xz * lb[2], yy * lb[1] + yz * lb[2], xz * lb[0] + yz * lb[1] + zz * lb[2]];
        let kc = [xx * lc[0] + xz * lc[2], yy * lc[1] + yz * lc[2], xz * lc[0] + yz * lc[1] + zz * lc[2]];
        let [m, _, _, ja, jb, jc] = self.inertia;
        let linear = Symmetric([m + xx.sum(), m + yy.sum(), m + zz.sum(), 0.0, xz.sum(), yz.sum()]).inverse();
        let (qa, qb, qc) = (total(&ka), total(&kb), total(&kc));
        let (wa, wb, wc) = (linear.times(qa), linear.times(qb), linear.times(qc));
        let rest = Symmetric([
            ja + product(la, &ka) - qa.dot(wa),
            jb + product(lb, &kb) - qb.dot(wb),
            jc + product(lc, &kc) - qc.dot(wc),
            product(la, &kb) - qa.dot(wb),
            product(la, &kc) - qa.dot(wc),
            product(lb, &kc) - qb.dot(wc),
        ]);
        let pulls = [x, y, z];
        let [fx, fy, fz, ta, tb, tc] = times(&self.inertia, from_smooth);
        let pull = total(&pulls) + V3::new(fx, fy, fz);
        let torque = V3::new(
            wa.dot(pull) - (product(la, &pulls) + ta),
            wb.dot(pull) - (product(lb, &pulls) + tb),
            wc.dot(pull) - (product(lc, &pulls) + tc),
        );
        let (cofactors, inverse) = rest.cofactors();
        let V3 { x: a, y: b, z: c } = cofactors.times(torque) * inverse;
        let V3 { x, y, z } = -(linear.times(pull) + wa * a + (wb * b + wc * c));
        [x, y, z, a, b, c]
    }
}

/// Returns the sum of vectors over the points.
#[inline(always)]
fn total<S: Simd>([x, y, z]: &[Quad<S>; 3]) -> V3<f64> {
    V3::new(x.sum(), y.sum(), z.sum())
}

/// Returns the sum of dot products over the points.
#[inline(always)]
fn product<S: Simd>(a: &[Quad<S>; 3], b: &[Quad<S>; 3]) -> f64 {
    (a[0] * b[0] + a[1] * b[1] + a[2] * b[2]).sum()
}

/// Computes [`Impedance::at`] for all points.
#[inline(always)]
fn impedances<S: Simd>(simd: S, impedance: &Impedance, depths: Quad<S>) -> Quad<S> {
    let Impedance { min, max, inverse_width, midpoint, parabolas: [before, after] } = *impedance;
    let x = depths * inverse_width;
    let rest = x * -1.0 + 1.0;
    let y = (x - midpoint).if_negative(x * x * before, rest * rest * -after + 1.0);
    (x - 1.0).if_negative(y * (max - min) + min, Quad::load(simd, [max; 4]))
}
