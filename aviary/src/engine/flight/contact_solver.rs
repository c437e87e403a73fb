//! Solver for the contacts of free bodies with the floor.
//!
//! The accelerations of the bodies minimize a convex function: half the squared distance from their unconstrained
//! accelerations, weighted by the inertia, plus half the weighted square of each edge's residual where it is negative.
//! Every contact point has a friction pyramid with four edges; the residual of an edge is the acceleration of the
//! point along the edge minus a reference.
//!
//! [`solve`] repeats the iterations of `mj_solNewton` from the same starting point, with the same line search and the
//! same conditions of termination, so that it agrees with MuJoCo to rounding also where MuJoCo stops early. The Hessian
//! is exact, therefore an iteration that changes no sign of a residual ends at the minimum.
//!
//! For a body that is alone, [`PointContact`] and [`PointContacts`] compute the minimum with fewer operations. The
//! signs of the residuals determine the minimum of a parabola, and the minimum of the cost is the one whose residuals
//! have the assumed signs. Line searches are exact: their steps differ from those of MuJoCo, whose line search has a
//! tolerance, but an iteration between the same signs ends at the same minimum. If an iteration comes close to a limit
//! at which MuJoCo stops early, [`solve`] takes over.

mod line_search;
mod quad;
mod several_points;
mod single_point;
mod symmetric;

use crate::math::V3;
use line_search::search_line;
pub(super) use several_points::{FloorPoints, PointContacts};
pub(super) use single_point::{PerEdge, PointContact};
use symmetric::Symmetric;

/// Largest number of contact points between a cylinder and a plane.
pub(super) const POINTS: usize = 4;

/// One number for each contact point.
pub(super) type PerPoint = [f64; POINTS];

/// A linear (first three numbers) and an angular vector, world frame.
pub(super) type Spatial = [f64; 6];

/// Reference acceleration of the edges of an absent point: no residual is negative.
const NEVER: f64 = -1e300;

/// Norm of a search direction below which MuJoCo treats the direction as zero.
const MIN_SEARCH: f64 = 1e-15;

/// Largest number of assumptions about the signs before [`solve`] takes over.
const MAX_SIGN_CHANGES: u32 = 10;

/// Constants of the solver.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Settings {
    /// Sliding friction coefficient.
    pub friction: f64,
    /// Relative improvement and gradient at which the solver stops.
    pub tolerance: f64,
    /// Product of the mean inertia and the number of degrees of freedom, the unit of `tolerance`.
    pub scale: f64,
    /// Largest number of iterations.
    pub iterations: u32,
}

impl Settings {
    /// Returns true if MuJoCo continues after an iteration that lowers the cost by this decrease, at a point with these
    /// linear components of the gradient. MuJoCo stops below a limit; twice the limit is a margin for rounding and for
    /// MuJoCo's line search, which is not exact.
    #[inline(always)]
    fn goes_on(&self, decrease: f64, gradient: V3<f64>) -> bool {
        let limit = 2.0 * self.tolerance * self.scale;
        decrease > limit && gradient.dot(gradient) > limit * limit
    }
}

/// Contact problem of one body.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Problem {
    /// Mass, kg.
    pub mass: f64,
    /// Inertia about the centre of mass, world frame, kg·m²: xx, yy, zz, xy, xz, yz.
    pub inertia: [f64; 6],
    /// Acceleration without contacts.
    pub smooth: Spatial,
    /// Starting point of the solver, and its result.
    pub acceleration: Spatial,
    /// Number of contact points.
    pub points: usize,
    /// Positions of the points relative to the centre of mass, world frame, m, by coordinate.
    pub arm: [PerPoint; 3],
    /// Weight of the four edges of each point, kg.
    pub weight: PerPoint,
    /// Reference accelerations of the edges, m/s².
    pub reference: [PerPoint; 4],
    work: Work,
}

/// Intermediate results of the solver.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Work {
    /// Residuals of the edges at the present acceleration, m/s².
    residual: [PerPoint; 4],
    /// Derivatives of the residuals along the search direction.
    slope: [PerPoint; 4],
    gradient: Spatial,
    search: Spatial,
}

impl Default for Problem {
    fn default() -> Self {
        Self {
            mass: 1.0,
            inertia: [1.0, 1.0, 1.0, 0.0, 0.0, 0.0],
            smooth: [0.0; 6],
            acceleration: [0.0; 6],
            points: 0,
            arm: [[0.0; POINTS]; 3],
            weight: [0.0; POINTS],
            reference: [[NEVER; POINTS]; 4],
            work: Work::default(),
        }
    }
}

/// Computes the accelerations of bodies that touch nothing but the floor by MuJoCo's iterations.
pub(super) fn solve(settings: &Settings, problems: &mut [Problem]) {
    if problems.iter().all(|problem| problem.points == 0) {
        problems.iter_mut().for_each(|problem| problem.acceleration = problem.smooth);
        return;
    }
    let mut cost = start(settings, problems);
    problems.iter_mut().for_each(|problem| problem.find_gradient(settings.friction));
    for _ in 0..settings.iterations {
        let (mut descent, mut length, mut stays) = (0.0, 0.0, true);
        for problem in &mut *problems {
            problem.find_search(settings.friction);
            let Work { gradient, search, residual, slope } = &problem.work;
            descent += dot(gradient, search);
            length += dot(search, search);
            for (residual, slope) in residual.iter().zip(slope) {
                for point in 0..POINTS {
                    stays &= (residual[point] < 0.0) == (residual[point] + slope[point] < 0.0);
                }
            }
        }
        let length = length.sqrt();
        if length < MIN_SEARCH {
            return;
        }
        if stays {
            // the cost is a parabola up to the minimum
            problems.iter_mut().for_each(|problem| problem.advance(1.0));
            return;
        }
        let step = search_line(settings, problems, cost, descent, length);
        if step == 0.0 {
            return;
        }
        let (mut new_cost, mut gradient) = (0.0, 0.0);
        for problem in &mut *problems {
            problem.advance(step);
            new_cost += problem.cost(&problem.work.residual, &problem.acceleration);
            problem.find_gradient(settings.friction);
            gradient += dot(&problem.work.gradient, &problem.work.gradient);
        }
        let limit = settings.tolerance * settings.scale;
        if cost - new_cost < limit || gradient.sqrt() < limit {
            return;
        }
        cost = new_cost;
    }
}

/// Starts at the better of the previous and the unconstrained accelerations, and returns its cost.
#[inline(always)]
fn start(settings: &Settings, problems: &mut [Problem]) -> f64 {
    let (mut previous, mut smooth) = (0.0, 0.0);
    for problem in &mut *problems {
        problem.work.residual = problem.residuals(settings.friction, &problem.acceleration);
        problem.work.slope = problem.residuals(settings.friction, &problem.smooth);
        previous += problem.cost(&problem.work.residual, &problem.acceleration);
        smooth += problem.penalty(&problem.work.slope);
    }
    if previous > smooth {
        for problem in problems {
            problem.acceleration = problem.smooth;
            problem.work.residual = problem.work.slope;
        }
        smooth
    } else {
        previous
    }
}

impl Problem {
    /// Replaces the points, without weights and references.
    #[inline(always)]
    pub(super) fn set_points(&mut self, points: &FloorPoints) {
        (self.points, self.arm) = (points.count, points.arm);
        self.weight = [0.0; POINTS];
        self.reference = [[NEVER; POINTS]; 4];
    }

    /// Returns the accelerations of the points along their edges for an acceleration of the body. Velocities of the
    /// body give velocities along the edges.
    #[inline(always)]
    pub(super) fn along_edges(&self, friction: f64, motion: &Spatial) -> [PerPoint; 4] {
        let [x, y, z, turn_x, turn_y, turn_z] = *motion;
        let [arm_x, arm_y, arm_z] = &self.arm;
        let mut edges = [[0.0; POINTS]; 4];
        for point in 0..POINTS {
            let across = friction * (x + (turn_y * arm_z[point] - turn_z * arm_y[point]));
            let along = friction * (y + (turn_z * arm_x[point] - turn_x * arm_z[point]));
            let up = z + (turn_x * arm_y[point] - turn_y * arm_x[point]);
            edges[0][point] = up + across;
            edges[1][point] = up - across;
            edges[2][point] = up + along;
            edges[3][point] = up - along;
        }
        edges
    }

    #[inline(always)]
    fn residuals(&self, friction: f64, acceleration: &Spatial) -> [PerPoint; 4] {
        let mut residuals = self.along_edges(friction, acceleration);
        for (residual, reference) in residuals.iter_mut().zip(&self.reference) {
            for point in 0..POINTS {
                residual[point] -= reference[point];
            }
        }
        residuals
    }

    /// Returns the cost of negative residuals.
    #[inline(always)]
    fn penalty(&self, residuals: &[PerPoint; 4]) -> f64 {
        let mut sums = [0.0; POINTS];
        for residual in residuals {
            for point in 0..POINTS {
                let residual = negative(residual[point]);
                sums[point] += residual * residual;
            }
        }
        for (sum, weight) in sums.iter_mut().zip(&self.weight) {
            *sum *= weight;
        }
        0.5 * sum(&sums)
    }

    #[inline(always)]
    fn cost(&self, residuals: &[PerPoint; 4], acceleration: &Spatial) -> f64 {
        let from_smooth = minus(acceleration, &self.smooth);
        self.penalty(residuals) + 0.5 * dot(&self.times_inertia(&from_smooth), &from_smooth)
    }

    #[inline(always)]
    fn times_inertia(&self, motion: &Spatial) -> Spatial {
        let [x, y, z, a, b, c] = *motion;
        let ([xx, yy, zz, xy, xz, yz], m) = (self.inertia, self.mass);
        [m * x, m * y, m * z, xx * a + xy * b + xz * c, xy * a + yy * b + yz * c, xz * a + yz * b + zz * c]
    }

    /// Computes the gradient of the cost.
    #[inline(always)]
    fn find_gradient(&mut self, friction: f64) {
        let mut sums = [[0.0; POINTS]; 6];
        let [arm_x, arm_y, arm_z] = &self.arm;
        let [east, west, north, south] = &self.work.residual;
        for point in 0..POINTS {
            let weight = self.weight[point];
            let (east, west) = (weight * negative(east[point]), weight * negative(west[point]));
            let (north, south) = (weight * negative(north[point]), weight * negative(south[point]));
            let (x, y, z) = (friction * (east - west), friction * (north - south), (east + west) + (north + south));
            sums[0][point] = x;
            sums[1][point] = y;
            sums[2][point] = z;
            sums[3][point] = arm_y[point] * z - arm_z[point] * y;
            sums[4][point] = arm_z[point] * x - arm_x[point] * z;
            sums[5][point] = arm_x[point] * y - arm_y[point] * x;
        }
        let mut gradient = self.times_inertia(&minus(&self.acceleration, &self.smooth));
        for (gradient, sums) in gradient.iter_mut().zip(&sums) {
            *gradient += sum(sums);
        }
        self.work.gradient = gradient;
    }

    /// Computes the Newton direction, and the derivatives of the residuals along it.
    #[inline(always)]
    fn find_search(&mut self, friction: f64) {
        self.work.search = if self.points == 0 {
            minus(&self.smooth, &self.acceleration)
        } else {
            self.hessian(friction).solve(&self.work.gradient).map(|x| -x)
        };
        self.work.slope = self.along_edges(friction, &self.work.search);
    }

    #[inline(always)]
    fn hessian(&self, friction: f64) -> Hessian {
        // Σ w·(edge·Jacobian)ᵀ(edge·Jacobian) over the edges with a negative residual, for each point
        let mut linear = [[0.0; POINTS]; 5];
        let mut mixed = [[0.0; POINTS]; 9];
        let mut angular = [[0.0; POINTS]; 6];
        let [arm_x, arm_y, arm_z] = &self.arm;
        let [east, west, north, south] = &self.work.residual;
        for point in 0..POINTS {
            let weight = self.weight[point];
            let active = |residual: f64| if residual < 0.0 { weight } else { 0.0 };
            let (east, west, north, south) =
                (active(east[point]), active(west[point]), active(north[point]), active(south[point]));
            let (rx, ry, rz) = (arm_x[point], arm_y[point], arm_z[point]);
            // symmetric weights of the acceleration of the point; that of x with y is zero
            let xx = friction * friction * (east + west);
            let yy = friction * friction * (north + south);
            let zz = (east + west) + (north + south);
            let xz = friction * (east - west);
            let yz = friction * (north - south);
            let all = [xx, yy, zz, xz, yz];
            for (sum, value) in linear.iter_mut().zip(all) {
                sum[point] = value;
            }
            // products with the Jacobian of the angular acceleration, with rows (0, z, −y), (−z, 0, x), (y, −x, 0)
            let rows = [
                [xz * ry, xx * rz - xz * rx, -xx * ry],
                [yz * ry - yy * rz, -yz * rx, yy * rx],
                [zz * ry - yz * rz, xz * rz - zz * rx, yz * rx - xz * ry],
            ];
            for (row, values) in rows.iter().enumerate() {
                for (column, value) in values.iter().enumerate() {
                    mixed[3 * row + column][point] = *value;
                }
            }
            let [x, y, z] = &rows;
            angular[0][point] = ry * z[0] - rz * y[0];
            angular[1][point] = rz * x[1] - rx * z[1];
            angular[2][point] = rx * y[2] - ry * x[2];
            angular[3][point] = ry * z[1] - rz * y[1];
            angular[4][point] = ry * z[2] - rz * y[2];
            angular[5][point] = rz * x[2] - rx * z[2];
        }
        let mut hessian =
            Hessian { linear: [self.mass, self.mass, self.mass, 0.0, 0.0], mixed: [0.0; 9], angular: self.inertia };
        for (total, sums) in hessian.linear.iter_mut().zip(&linear) {
            *total += sum(sums);
        }
        for (total, sums) in hessian.mixed.iter_mut().zip(&mixed) {
            *total += sum(sums);
        }
        for (total, sums) in hessian.angular.iter_mut().zip(&angular) {
            *total += sum(sums);
        }
        hessian
    }

    /// Moves along the search direction.
    #[inline(always)]
    fn advance(&mut self, step: f64) {
        for (acceleration, search) in self.acceleration.iter_mut().zip(&self.work.search) {
            *acceleration += step * search;
        }
        for (residual, slope) in self.work.residual.iter_mut().zip(&self.work.slope) {
            for point in 0..POINTS {
                residual[point] += step * slope[point];
            }
        }
    }
}

/// Symmetric positive definite matrix of six rows in blocks of three.
struct Hessian {
    /// xx, yy, zz, xz, yz; xy is zero.
    linear: [f64; 5],
    /// Rows of the linear and columns of the angular acceleration.
    mixed: [f64; 9],
    /// xx, yy, zz, xy, xz, yz.
    angular: [f64; 6],
}

impl Hessian {
    /// Solves the linear system by LDLᵀ decomposition.
    #[inline(always)]
    fn solve(&self, right: &Spatial) -> Spatial {
        let [xx, yy, zz, xz, yz] = self.linear;
        let [ax, ay, az, bx, by, bz, cx, cy, cz] = self.mixed;
        let [txx, tyy, tzz, txy, txz, tyz] = self.angular;
        let (rx, ry) = (1.0 / xx, 1.0 / yy);
        let (lx, ly) = (xz * rx, yz * ry);
        let rz = 1.0 / (zz - xz * lx - yz * ly);
        let (cx, cy, cz) = (cx - lx * ax - ly * bx, cy - lx * ay - ly * by, cz - lx * az - ly * bz);
        let (px, py, pz) = (ax * rx, ay * rx, az * rx);
        let (qx, qy, qz) = (bx * ry, by * ry, bz * ry);
        let (sx, sy, sz) = (cx * rz, cy * rz, cz * rz);
        // the rest of the angular block
        let uxx = txx - (ax * px + bx * qx + cx * sx);
        let uyy = tyy - (ay * py + by * qy + cy * sy);
        let uzz = tzz - (az * pz + bz * qz + cz * sz);
        let uxy = txy - (ax * py + bx * qy + cx * sy);
        let uxz = txz - (ax * pz + bx * qz + cx * sz);
        let uyz = tyz - (ay * pz + by * qz + cy * sz);
        let [fx, fy, fz, gx, gy, gz] = *right;
        let fz = fz - lx * fx - ly * fy;
        let gx = gx - (px * fx + qx * fy + sx * fz);
        let gy = gy - (py * fx + qy * fy + sy * fz);
        let gz = gz - (pz * fx + qz * fy + sz * fz);
        let vx = 1.0 / uxx;
        let (ky, kz) = (uxy * vx, uxz * vx);
        let (wyy, wyz) = (uyy - ky * uxy, uyz - ky * uxz);
        let vy = 1.0 / wyy;
        let hz = wyz * vy;
        let vz = 1.0 / (uzz - kz * uxz - hz * wyz);
        let gy = gy - ky * gx;
        let gz = gz - kz * gx - hz * gy;
        let c = gz * vz;
        let b = gy * vy - hz * c;
        let a = gx * vx - ky * b - kz * c;
        let z = fz * rz - (sx * a + sy * b + sz * c);
        let y = fy * ry - (qx * a + qy * b + qz * c) - ly * z;
        let x = fx * rx - (px * a + py * b + pz * c) - lx * z;
        [x, y, z, a, b, c]
    }
}

/// Returns the smaller of a number and zero.
#[inline(always)]
fn negative(x: f64) -> f64 {
    // one instruction, unlike `f64::min`, which handles NaN
    if x < 0.0 { x } else { 0.0 }
}

#[inline(always)]
fn sum(values: &PerPoint) -> f64 {
    (values[0] + values[1]) + (values[2] + values[3])
}

#[inline(always)]
fn dot(a: &Spatial, b: &Spatial) -> f64 {
    (a[0] * b[0] + a[1] * b[1] + a[2] * b[2]) + (a[3] * b[3] + a[4] * b[4] + a[5] * b[5])
}

#[inline(always)]
fn plus<const N: usize>(a: &[f64; N], b: &[f64; N]) -> [f64; N] {
    let mut sum = *a;
    for i in 0..N {
        sum[i] += b[i];
    }
    sum
}

#[inline(always)]
fn minus<const N: usize>(a: &[f64; N], b: &[f64; N]) -> [f64; N] {
    let mut difference = *a;
    for i in 0..N {
        difference[i] -= b[i];
    }
    difference
}

/// Returns the component-wise product.
#[inline(always)]
fn times<const N: usize>(a: &[f64; N], b: &[f64; N]) -> [f64; N] {
    let mut product = *a;
    for i in 0..N {
        product[i] *= b[i];
    }
    product
}
