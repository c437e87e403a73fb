use nalgebra::{Matrix3, Matrix3x4, Matrix4, RowVector4, SMatrix, Vector3, Vector4};

use super::jet::Jet;
use super::{Trajectory, TrajectoryError};
use crate::control::Reference;
use crate::state::wrap_angle;

/// A minimum-snap trajectory through waypoints, from rest to rest (Mellinger and Kumar 2011, *Minimum snap trajectory
/// generation and control for quadrotors*).
///
/// Between two waypoints each coordinate is a polynomial of degree seven. Velocity, acceleration and jerk are zero at
/// both ends, and derivatives up to the sixth are continuous at the inner waypoints. These conditions minimize the
/// integral of the squared snap. Yaw is interpolated with the same polynomials, along the shorter direction of
/// rotation.
///
/// ```
/// use aviary::control::trajectory::{Trajectory, Waypoints};
///
/// let path = Waypoints::through(&[[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [1.0, 1.0, 1.5]])
///     .limits(1.5, 4.0)
///     .build()?;
/// let end = path.reference(path.duration());
/// assert!((end.position - nalgebra::Vector3::new(1.0, 1.0, 1.5)).norm() < 1e-9);
/// # Ok::<(), aviary::control::trajectory::TrajectoryError>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct Waypoints {
    /// Start time of each segment, s, followed by the end time of the last one.
    times: Vec<f64>,
    segments: Vec<Segment>,
}

/// Coefficients of x, y, z and yaw as polynomials in the normalized time of a segment, in [0, 1].
#[derive(Debug, Clone, PartialEq)]
struct Segment {
    coefficients: [[f64; 8]; 4],
}

impl Segment {
    /// Returns the derivatives of order 0 to 2 of x, y, z and yaw with respect to the normalized time.
    fn derivatives(&self, share: f64) -> [[f64; 4]; 3] {
        let mut derivatives = [[0.0; 4]; 3];
        for (axis, coefficients) in self.coefficients.iter().enumerate() {
            let [mut value, mut first, mut half_second] = [0.0; 3];
            for coefficient in coefficients.iter().rev() {
                half_second = half_second * share + first;
                first = first * share + value;
                value = value * share + coefficient;
            }
            [derivatives[0][axis], derivatives[1][axis], derivatives[2][axis]] = [value, first, 2.0 * half_second];
        }
        derivatives
    }
}

/// Velocity, acceleration and jerk (rows) of x, y, z and yaw at a waypoint.
type Derivatives = Matrix3x4<f64>;

/// Boundary values of one coordinate of a segment. Derivatives are with respect to the normalized time.
struct Hermite {
    from: f64,
    /// Change from start to end.
    step: f64,
    /// Velocity, acceleration and jerk at the start.
    start: Vector3<f64>,
    /// Velocity, acceleration and jerk at the end.
    end: Vector3<f64>,
}

impl Hermite {
    fn coefficients(&self) -> [f64; 8] {
        let [c1, c2, c3] = [self.start.x, self.start.y / 2.0, self.start.z / 6.0];
        // contribution of the upper four coefficients at the end
        let missing = Vector4::new(
            self.step - c1 - c2 - c3,
            self.end.x - c1 - 2.0 * c2 - 3.0 * c3,
            self.end.y - 2.0 * c2 - 6.0 * c3,
            self.end.z - 6.0 * c3,
        );
        // inverse of the matrix with the entries j!/(j − k)!, j = 4 to 7, k = 0 to 3
        #[rustfmt::skip]
        let inverse = Matrix4::new(
             35.0, -15.0,  2.5, -1.0 / 6.0,
            -84.0,  39.0, -7.0,  0.5,
             70.0, -34.0,  6.5, -0.5,
            -20.0,  10.0, -2.0,  1.0 / 6.0,
        );
        let upper = inverse * missing;
        [self.from, c1, c2, c3, upper[0], upper[1], upper[2], upper[3]]
    }

    /// Returns the matrix of the integral of the squared snap as a quadratic form in the value, velocity,
    /// acceleration and jerk at the start, followed by those at the end.
    fn cost() -> SMatrix<f64, 8, 8> {
        // snap for each unit boundary value: Σ j!/(j − 4)!·c(j)·τʲ⁻⁴
        let snaps: [[f64; 4]; 8] = std::array::from_fn(|entry| {
            let unit = |index: usize| if entry == index { 1.0 } else { 0.0 };
            let [from, to] = [unit(0), unit(4)];
            let start = Vector3::new(unit(1), unit(2), unit(3));
            let end = Vector3::new(unit(5), unit(6), unit(7));
            let coefficients = Self { from, step: to - from, start, end }.coefficients();
            std::array::from_fn(|k| [24.0, 120.0, 360.0, 840.0][k] * coefficients[4 + k])
        });
        SMatrix::from_fn(|row, column| {
            let terms = (0..4).flat_map(|i| (0..4).map(move |j| (i, j)));
            terms.map(|(i, j)| snaps[row][i] * snaps[column][j] / (i + j + 1) as f64).sum()
        })
    }
}

/// Builder of a [`Waypoints`] trajectory.
///
/// ```
/// use std::f64::consts::FRAC_PI_2;
///
/// use aviary::control::trajectory::{Trajectory, Waypoints};
///
/// // out and back, 2 s each
/// let path = Waypoints::through(&[[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
///     .times([0.0, 2.0, 4.0])
///     .yaws([0.0, FRAC_PI_2, 0.0])
///     .build()?;
/// let far = path.reference(2.0);
/// assert!((far.position.x - 1.0).abs() < 1e-6 && (far.yaw - FRAC_PI_2).abs() < 1e-6);
/// assert!(far.velocity.norm() < 1e-6, "at rest, because the two legs are symmetric");
/// # Ok::<(), aviary::control::trajectory::TrajectoryError>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct WaypointsBuilder {
    points: Vec<[f64; 3]>,
    yaws: Option<Vec<f64>>,
    times: Option<Vec<f64>>,
    max_speed: f64,
    max_acceleration: f64,
}

impl WaypointsBuilder {
    /// Sets the yaw at every waypoint, rad; default 0.
    #[must_use]
    pub fn yaws(mut self, yaws: impl Into<Vec<f64>>) -> Self {
        self.yaws = Some(yaws.into());
        self
    }

    /// Sets the time of every waypoint, s, starting at 0; default times are allocated from distances and
    /// [`limits`](Self::limits).
    #[must_use]
    pub fn times(mut self, times: impl Into<Vec<f64>>) -> Self {
        self.times = Some(times.into());
        self
    }

    /// Sets the maximum speed (m/s) and acceleration (m/s²) for the allocation of times; default 1 m/s and 2 m/s².
    /// The maximum yaw rate is π rad/s.
    #[must_use]
    pub fn limits(mut self, max_speed: f64, max_acceleration: f64) -> Self {
        (self.max_speed, self.max_acceleration) = (max_speed, max_acceleration);
        self
    }

    /// Computes the polynomials.
    ///
    /// # Errors
    /// [`TrajectoryError::Value`] for a value or a number of values outside its range, and
    /// [`TrajectoryError::Unsolvable`] if the gaps between the times differ too much.
    pub fn build(self) -> Result<Waypoints, TrajectoryError> {
        let count = self.points.len();
        let expected = "2 to 200";
        TrajectoryError::validate("the number of points", count as f64, (2..=200).contains(&count), expected)?;
        for &x in self.points.iter().flatten() {
            TrajectoryError::validate(
                "a coordinate in points",
                x,
                x.abs() <= 1e6,
                "a finite number of metres up to 1e6",
            )?;
        }
        let yaws = self.yaws.unwrap_or_else(|| vec![0.0; count]);
        let expected = "one per waypoint";
        TrajectoryError::validate("the number of yaws", yaws.len() as f64, yaws.len() == count, expected)?;
        for &yaw in &yaws {
            TrajectoryError::validate("a yaw in yaws", yaw, yaw.is_finite(), "a finite angle, rad")?;
        }
        // unwraps the yaws along the shorter direction of rotation
        let mut turned = vec![yaws[0]];
        for yaw in &yaws[1..] {
            let last = turned[turned.len() - 1];
            turned.push(last + wrap_angle(yaw - last));
        }
        if let Some(times) = self.times {
            TrajectoryError::validate("the number of times", times.len() as f64, times.len() == count, expected)?;
            TrajectoryError::validate("the first of times", times[0], times[0] == 0.0, "0")?;
            for pair in times.windows(2) {
                let gap = pair[1] - pair[0];
                let good = (1e-3..=1e6).contains(&gap);
                TrajectoryError::validate("a gap in times", gap, good, "at least 1 ms, and up to 1e6 s")?;
            }
            return Waypoints::solve(&self.points, &turned, times);
        }
        let (speed, acceleration) = (self.max_speed, self.max_acceleration);
        for (what, limit) in [("max_speed", speed), ("max_acceleration", acceleration)] {
            TrajectoryError::validate(what, limit, (1e-6..=1e6).contains(&limit), "a positive number")?;
        }
        Waypoints::allocate(&self.points, &turned, speed, acceleration)
    }
}

impl Waypoints {
    /// Returns a builder for a trajectory through points, world frame, m.
    pub fn through(points: &[[f64; 3]]) -> WaypointsBuilder {
        WaypointsBuilder { points: points.to_vec(), yaws: None, times: None, max_speed: 1.0, max_acceleration: 2.0 }
    }

    /// Returns the time of each waypoint, s.
    pub fn times(&self) -> &[f64] {
        &self.times
    }

    /// Solves for the velocity, acceleration and jerk at the inner waypoints that minimize the integral of the
    /// squared snap.
    ///
    /// The linear system is positive definite and block tridiagonal, because each waypoint depends only on its
    /// neighbours.
    fn solve(points: &[[f64; 3]], yaws: &[f64], times: Vec<f64>) -> Result<Self, TrajectoryError> {
        let count = points.len() - 1;
        let spans: Vec<f64> = times.windows(2).map(|pair| pair[1] - pair[0]).collect();
        let steps: Vec<RowVector4<f64>> = (0..count)
            .map(|i| {
                let [a, b] = [points[i], points[i + 1]];
                RowVector4::new(b[0] - a[0], b[1] - a[1], b[2] - a[2], yaws[i + 1] - yaws[i])
            })
            .collect();
        // unknowns are scaled by the geometric mean of the two spans at their waypoint, for a well-conditioned system
        let unit = |i: usize| match i {
            0 => spans[0],
            i if i == count => spans[count - 1],
            i => (spans[i - 1] * spans[i]).sqrt(),
        };
        // factors from these units to the normalized time of a segment
        let factors = |segment: usize, waypoint: usize| {
            let ratio = spans[segment] / unit(waypoint);
            Matrix3::from_diagonal(&Vector3::new(ratio, ratio * ratio, ratio * ratio * ratio))
        };
        let cost = Hermite::cost();
        let weight = |segment: usize| spans[segment].powi(-7);
        // forward elimination: x(k) = value(k) − link(k)·x(k + 1)
        let mut values: Vec<Derivatives> = Vec::with_capacity(count);
        let mut links: Vec<Matrix3<f64>> = Vec::with_capacity(count);
        let mut coupling = Matrix3::zeros();
        for k in 1..count {
            let (end, start) = (factors(k - 1, k), factors(k, k));
            let (before, after) = (weight(k - 1), weight(k));
            let mut diagonal = before * end * cost.fixed_view::<3, 3>(5, 5) * end
                + after * start * cost.fixed_view::<3, 3>(1, 1) * start;
            let mut right = -(before * end * cost.fixed_view::<3, 1>(5, 4) * steps[k - 1]
                + after * start * cost.fixed_view::<3, 1>(1, 4) * steps[k]);
            if let (Some(link), Some(value)) = (links.last(), values.last()) {
                diagonal -= coupling.transpose() * link;
                right -= coupling.transpose() * value;
            }
            let diagonal = diagonal.cholesky().ok_or(TrajectoryError::Unsolvable)?;
            coupling = after * start * cost.fixed_view::<3, 3>(1, 5) * factors(k, k + 1);
            values.push(diagonal.solve(&right));
            links.push(diagonal.solve(&coupling));
        }
        // back substitution; the derivatives at both ends are zero
        let mut derivatives = vec![Derivatives::zeros(); count + 1];
        for k in (1..count).rev() {
            derivatives[k] = values[k - 1] - links[k - 1] * derivatives[k + 1];
        }
        let segment = |i: usize| {
            let [start, end] = [factors(i, i) * derivatives[i], factors(i, i + 1) * derivatives[i + 1]];
            Segment {
                coefficients: std::array::from_fn(|axis| {
                    let from = if axis < 3 { points[i][axis] } else { yaws[i] };
                    let [start, end] = [start.column(axis).into(), end.column(axis).into()];
                    Hermite { from, step: steps[i][axis], start, end }.coefficients()
                }),
            }
        };
        let path = Self { segments: (0..count).map(segment).collect(), times };
        // spans that differ by orders of magnitude lead to cancellation
        let missed = points.iter().zip(&path.times).any(|(point, &time)| {
            let off = (path.reference(time).position - Vector3::from(*point)).norm();
            off.is_nan() || off > 1e-6 * (1.0 + Vector3::from(*point).norm())
        });
        if missed { Err(TrajectoryError::Unsolvable) } else { Ok(path) }
    }

    /// Maximum yaw rate for the allocation of times, rad/s.
    const MAX_YAW_RATE: f64 = std::f64::consts::PI;

    /// Maximum number of segments whose times are optimized: every trial solves for all segments.
    const MAX_OPTIMIZED: usize = 24;

    /// Allocates times within the limits by coordinate descent on the duration and on the largest detour from the
    /// straight legs. An unsuitable allocation causes large overshoots.
    fn allocate(points: &[[f64; 3]], yaws: &[f64], speed: f64, acceleration: f64) -> Result<Self, TrajectoryError> {
        // initial spans: the time of a trapezoidal speed profile from rest to rest, or that of the yaw
        let legs = points.windows(2).zip(yaws.windows(2)).map(|(pair, yaw)| {
            let path = (Vector3::from(pair[1]) - Vector3::from(pair[0])).norm();
            let seconds = if path * acceleration < speed * speed {
                2.0 * (path / acceleration).sqrt()
            } else {
                path / speed + speed / acceleration
            };
            seconds.max(2.0 * (yaw[1] - yaw[0]).abs() / Self::MAX_YAW_RATE)
        });
        let mut spans: Vec<f64> = legs.collect();
        // very different neighbouring spans cause overshoots and an ill-conditioned system
        let longest = spans.iter().copied().fold(0.0, f64::max);
        spans.iter_mut().for_each(|span| *span = span.max(1e-3 * longest).max(0.01));
        for _ in 0..spans.len() {
            for i in 1..spans.len() {
                let (a, b) = (spans[i - 1], spans[i]);
                (spans[i - 1], spans[i]) = (a.max(b / 4.0), b.max(a / 4.0));
            }
        }
        let within = |spans: &[f64], samples: u32| -> Result<Self, TrajectoryError> {
            let mut times = vec![0.0];
            for span in spans {
                times.push(times[times.len() - 1] + span);
            }
            let mut path = Self::solve(points, yaws, times)?;
            // scaling time by k divides speeds by k and accelerations by k²
            let [fastest, hardest, turning] = path.peaks(samples);
            let scale = (fastest / speed).max((hardest / acceleration).sqrt()).max(turning / Self::MAX_YAW_RATE);
            if scale > 0.0 {
                path.times.iter_mut().for_each(|time| *time *= scale);
            }
            Ok(path)
        };
        if (2..=Self::MAX_OPTIMIZED).contains(&spans.len()) {
            // a detour costs twice the time to fly it out and back
            let cost = |path: &Self| path.duration() + 4.0 * path.detour(points) / speed;
            let mut min = cost(&within(&spans, 24)?);
            for factor in [1.6, 1.25, 1.1] {
                for _ in 0..4 {
                    let before = min;
                    for i in 0..spans.len() {
                        for factor in [factor, 1.0 / factor] {
                            let span = spans[i];
                            spans[i] = span * factor;
                            match within(&spans, 24) {
                                Ok(path) if cost(&path) < min => min = cost(&path),
                                _ => spans[i] = span,
                            }
                        }
                    }
                    if min > 0.99 * before {
                        break;
                    }
                }
            }
        }
        within(&spans, 200)
    }

    /// Returns the segment with the lowest point of the path, and the height of that point, m.
    pub(crate) fn lowest(&self) -> (usize, f64) {
        let heights = self.segments.iter().enumerate().flat_map(|(index, segment)| {
            (0..=50).map(move |sample| (index, segment.derivatives(f64::from(sample) / 50.0)[0][2]))
        });
        heights.fold((0, f64::INFINITY), |lowest, point| if point.1 < lowest.1 { point } else { lowest })
    }

    /// Returns the largest distance from the straight line between two waypoints, m.
    fn detour(&self, points: &[[f64; 3]]) -> f64 {
        let legs = self.segments.iter().zip(points.windows(2));
        let samples = legs.flat_map(|(segment, points)| {
            let (from, path) = (Vector3::from(points[0]), Vector3::from(points[1]) - Vector3::from(points[0]));
            (1..12).map(move |sample| {
                let [[x, y, z, _], ..] = segment.derivatives(f64::from(sample) / 12.0);
                let position = Vector3::new(x, y, z);
                let share = ((position - from).dot(&path) / path.norm_squared().max(1e-12)).clamp(0.0, 1.0);
                (from + path * share - position).norm()
            })
        });
        samples.fold(0.0, f64::max)
    }

    /// Returns the largest speed (m/s), acceleration (m/s²) and yaw rate (rad/s), from a number of samples per
    /// segment.
    fn peaks(&self, samples: u32) -> [f64; 3] {
        let mut peaks = [0.0_f64; 3];
        for (segment, pair) in self.segments.iter().zip(self.times.windows(2)) {
            let span = pair[1] - pair[0];
            for sample in 0..=samples {
                let [_, velocity, acceleration] = segment.derivatives(f64::from(sample) / f64::from(samples));
                let length = |of: &[f64; 4]| Vector3::new(of[0], of[1], of[2]).norm();
                let now = [length(&velocity) / span, length(&acceleration) / (span * span), velocity[3].abs() / span];
                for (peak, now) in peaks.iter_mut().zip(now) {
                    *peak = peak.max(now);
                }
            }
        }
        peaks
    }
}

impl Trajectory for Waypoints {
    fn reference(&self, time: f64) -> Reference {
        let end = self.duration();
        let inside = time.clamp(0.0, end);
        // the segment that contains the time, or the last one at the end
        let index = self.times.partition_point(|&start| start <= inside).clamp(1, self.segments.len()) - 1;
        let span = self.times[index + 1] - self.times[index];
        let share = if time.is_nan() {
            Jet::constant(f64::NAN)
        } else if time == inside {
            (Jet::time(time) - Jet::constant(self.times[index])) * (1.0 / span)
        } else {
            Jet::constant(if time < 0.0 { 0.0 } else { 1.0 })
        };
        let jets = self.segments[index].coefficients.map(|c| share.polynomial(&c));
        let derivative = |k: usize| Vector3::from_fn(|axis, _| jets[axis].derivative(k));
        Reference {
            position: derivative(0),
            velocity: derivative(1),
            acceleration: derivative(2),
            jerk: derivative(3),
            snap: derivative(4),
            yaw: wrap_angle(jets[3].value()),
            yaw_rate: jets[3].derivative(1),
            yaw_acceleration: jets[3].derivative(2),
        }
    }

    fn duration(&self) -> f64 {
        self.times[self.times.len() - 1]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn two_waypoints_give_the_closed_form_polynomial() {
        let path = Waypoints::through(&[[0.0; 3], [1.0, -2.0, 0.5]]).times([0.0, 2.0]).build().unwrap();
        for i in 0..=20 {
            let tau = f64::from(i) / 20.0;
            let share = 35.0 * tau.powi(4) - 84.0 * tau.powi(5) + 70.0 * tau.powi(6) - 20.0 * tau.powi(7);
            let expected = Vector3::new(1.0, -2.0, 0.5) * share;
            assert!((path.reference(2.0 * tau).position - expected).norm() < 1e-9);
        }
    }

    #[test]
    fn reference_is_at_rest_before_the_start_and_after_the_end() {
        let path =
            Waypoints::through(&[[0.0; 3], [1.0, 0.0, 1.0], [2.0, 1.0, 0.0]]).yaws([3.0, -3.0, 0.0]).build().unwrap();
        let end = path.duration() + 1.0;
        for (time, position, yaw) in [(-1.0, Vector3::zeros(), 3.0), (end, Vector3::new(2.0, 1.0, 0.0), 0.0)] {
            let reference = path.reference(time);
            assert!((reference.position - position).norm() < 1e-9 && wrap_angle(reference.yaw - yaw).abs() < 1e-9);
            assert_eq!((reference.velocity.norm(), reference.snap.norm(), reference.yaw_rate), (0.0, 0.0, 0.0));
        }
        let turn = Waypoints::through(&[[0.0; 3], [1.0; 3]]).yaws([3.0, -3.0]).build().unwrap();
        assert!(turn.reference(turn.duration() / 2.0).yaw.abs() > 3.1, "the shorter direction, across π");
    }

    proptest! {
        /// First-order optimality: the integral of the snap times the fourth derivative of any variation that keeps
        /// ends and waypoints is zero.
        #[test]
        fn snap_is_minimal(seed in prop::array::uniform32(-1.0..1.0f64)) {
            let points: Vec<_> = seed.chunks_exact(3).take(4).map(|c| [c[0], c[1], c[2]]).collect();
            let mut times = vec![0.0];
            for i in 0..3 {
                times.push(times[i] + 1.0 + 0.5 * seed[20 + i]);
            }
            let path = Waypoints::through(&points).times(times.clone()).build().unwrap();
            let end = path.duration();
            let (mut inner, mut size) = (0.0, 0.0);
            for i in 0..4000 {
                let t = end * (f64::from(i) + 0.5) / 4000.0;
                let x = Jet::time(t);
                let mut change = Jet::constant(1.0);
                for _ in 0..4 {
                    change = change * x * (x - Jet::constant(end)) * (1.0 / end / end);
                }
                for &knot in &times[1..3] {
                    change = change * (x - Jet::constant(knot)) * (1.0 / end);
                }
                let product = path.reference(t).snap.x * change.derivative(4);
                inner += product;
                size += product.abs();
            }
            prop_assert!(inner.abs() < 1e-4 * size, "{inner} of {size}");
        }

        #[test]
        fn derivatives_are_continuous_at_waypoints(seed in prop::array::uniform32(-1.0..1.0f64)) {
            let points: Vec<_> = seed.chunks_exact(3).map(|c| [c[0], c[1], c[2]]).collect();
            let path = Waypoints::through(&points).limits(2.0, 4.0).build().unwrap();
            for &time in &path.times()[1..path.times().len() - 1] {
                let [before, after] = [-1e-9, 1e-9].map(|h| path.reference(time + h));
                prop_assert!((before.jerk - after.jerk).norm() < 1e-4 * (1.0 + after.jerk.norm()));
                prop_assert!((before.snap - after.snap).norm() < 1e-4 * (1.0 + after.snap.norm()));
            }
        }
    }

    #[test]
    fn invalid_waypoints_are_rejected() {
        let refused = |builder: WaypointsBuilder, what: &str| {
            let text = builder.build().unwrap_err().to_string();
            assert!(text.contains(what), "{text}");
        };
        let two = || Waypoints::through(&[[0.0; 3], [1.0; 3]]);
        refused(Waypoints::through(&[[0.0; 3]]), "2 to 200");
        refused(Waypoints::through(&[[0.0; 3], [f64::NAN; 3]]), "a coordinate in points is NaN");
        refused(two().yaws([0.0]), "one per waypoint");
        refused(two().times([0.0, 0.0]), "at least 1 ms");
        refused(two().times([1.0, 2.0]), "the first of times is 1");
        refused(two().limits(0.0, 1.0), "max_speed is 0");
        refused(two().limits(1.0, f64::INFINITY), "max_acceleration is inf");
    }

    #[test]
    fn two_hundred_waypoints_and_repeated_points_are_solved() {
        let points: Vec<_> = (0..200).map(|i| [f64::from(i / 2 % 7), f64::from(i % 3), 1.0]).collect();
        let path = Waypoints::through(&points).build().unwrap();
        for (point, &time) in points.iter().zip(path.times()) {
            assert!((path.reference(time).position - Vector3::from(*point)).norm() < 1e-6);
        }
        let still = Waypoints::through(&[[1.0; 3], [1.0; 3]]).build().unwrap();
        assert!((still.reference(0.05).position - Vector3::repeat(1.0)).norm() < 1e-12);
    }
}
