use nalgebra::{DMatrix, Vector3};

use super::jet::Jet;
use super::{Trajectory, TrajectoryError};
use crate::control::Reference;
use crate::state::wrap_angle;

/// Through waypoints from rest to rest along the polynomials of least snap (Mellinger and Kumar 2011, *Minimum snap
/// trajectory generation and control for quadrotors*).
///
/// Between two waypoints each coordinate is a polynomial of the seventh order. Positions are met, speed, acceleration and
/// jerk are zero at both ends, and derivatives up to the sixth are continuous at the waypoints between, which is what
/// makes the integral of the squared snap the least. Yaw goes the same way, by the shorter turns.
///
/// ```
/// use aviary::control::trajectory::{Trajectory, Waypoints};
///
/// let way = Waypoints::through(&[[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [1.0, 1.0, 1.5]])
///     .limits(1.5, 4.0)
///     .build()?;
/// let end = way.reference(way.duration());
/// assert!((end.position - nalgebra::Vector3::new(1.0, 1.0, 1.5)).norm() < 1e-9);
/// # Ok::<(), aviary::control::trajectory::TrajectoryError>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct Waypoints {
    /// When each segment begins, s, and when the last one ends.
    times: Vec<f64>,
    segments: Vec<Segment>,
}

/// Coefficients of x, y, z and yaw over the segment's share of time in [0, 1].
#[derive(Debug, Clone, PartialEq)]
struct Segment {
    coefficients: [[f64; 8]; 4],
}

/// The options of [`Waypoints`].
///
/// ```
/// use std::f64::consts::FRAC_PI_2;
///
/// use aviary::control::trajectory::{Trajectory, Waypoints};
///
/// // there and back, two seconds each
/// let way = Waypoints::through(&[[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
///     .times([0.0, 2.0, 4.0])
///     .yaws([0.0, FRAC_PI_2, 0.0])
///     .build()?;
/// let far = way.reference(2.0);
/// assert!((far.position.x - 1.0).abs() < 1e-6 && (far.yaw - FRAC_PI_2).abs() < 1e-6);
/// assert!(far.velocity.norm() < 1e-6, "at rest, because the way back mirrors the way there");
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
    /// Yaw at every waypoint, rad; 0 by default.
    #[must_use]
    pub fn yaws(mut self, yaws: impl Into<Vec<f64>>) -> Self {
        self.yaws = Some(yaws.into());
        self
    }

    /// When to be at every waypoint, s, the first at 0; allocated by distance and limits by default.
    #[must_use]
    pub fn times(mut self, times: impl Into<Vec<f64>>) -> Self {
        self.times = Some(times.into());
        self
    }

    /// Speed (m/s) and acceleration (m/s²) that allocated times keep to; 1 and 2 by default. Yaw turns at no more than half
    /// a turn a second.
    #[must_use]
    pub fn limits(mut self, max_speed: f64, max_acceleration: f64) -> Self {
        (self.max_speed, self.max_acceleration) = (max_speed, max_acceleration);
        self
    }

    /// Computes the polynomials.
    ///
    /// # Errors
    /// [`TrajectoryError`] naming what is impossible.
    pub fn build(self) -> Result<Waypoints, TrajectoryError> {
        let count = self.points.len();
        let expected = "2 to 200";
        TrajectoryError::check("the number of waypoints", count as f64, (2..=200).contains(&count), expected)?;
        for &x in self.points.iter().flatten() {
            TrajectoryError::check(
                "a waypoint's coordinate",
                x,
                x.abs() <= 1e6,
                "a finite number of metres up to 1e6",
            )?;
        }
        let yaws = self.yaws.unwrap_or_else(|| vec![0.0; count]);
        let expected = "one per waypoint";
        TrajectoryError::check("the number of yaws", yaws.len() as f64, yaws.len() == count, expected)?;
        for &yaw in &yaws {
            TrajectoryError::check("a waypoint's yaw", yaw, yaw.is_finite(), "a finite angle, rad")?;
        }
        // by the shorter turns
        let mut turned = vec![yaws[0]];
        for yaw in &yaws[1..] {
            let last = turned[turned.len() - 1];
            turned.push(last + wrap_angle(yaw - last));
        }
        if let Some(times) = self.times {
            TrajectoryError::check("the number of times", times.len() as f64, times.len() == count, expected)?;
            TrajectoryError::check("the first waypoint's time", times[0], times[0] == 0.0, "0")?;
            for pair in times.windows(2) {
                let gap = pair[1] - pair[0];
                let good = (1e-3..=1e6).contains(&gap);
                TrajectoryError::check("the time between two waypoints", gap, good, "at least 1 ms, and up to 1e6 s")?;
            }
            return Waypoints::solve(&self.points, &turned, times);
        }
        let (speed, acceleration) = (self.max_speed, self.max_acceleration);
        for (what, limit) in [("the greatest speed", speed), ("the greatest acceleration", acceleration)] {
            TrajectoryError::check(what, limit, (1e-6..=1e6).contains(&limit), "a positive number")?;
        }
        Waypoints::allocate(&self.points, &turned, speed, acceleration)
    }
}

impl Waypoints {
    /// Options for a way through points, world frame, m.
    pub fn through(points: &[[f64; 3]]) -> WaypointsBuilder {
        WaypointsBuilder { points: points.to_vec(), yaws: None, times: None, max_speed: 1.0, max_acceleration: 2.0 }
    }

    /// When each waypoint is reached, s.
    pub fn times(&self) -> &[f64] {
        &self.times
    }

    /// Solves for all segments at once: 8 unknowns each, four coordinates on the right.
    fn solve(points: &[[f64; 3]], yaws: &[f64], times: Vec<f64>) -> Result<Self, TrajectoryError> {
        let count = points.len() - 1;
        let spans: Vec<f64> = times.windows(2).map(|pair| pair[1] - pair[0]).collect();
        let mut matrix = DMatrix::zeros(8 * count, 8 * count);
        let mut right = DMatrix::zeros(8 * count, 4);
        // j!/(j−k)!, what the k-th derivative of τʲ is at τ = 1
        let falling = |j: usize, k: usize| (j + 1 - k.min(j + 1)..=j).map(|x| x as f64).product::<f64>();
        let mut row = 0;
        for i in 0..count {
            for (end, point) in [(0.0, i), (1.0, i + 1)] {
                for j in 0..8 {
                    matrix[(row, 8 * i + j)] = if j == 0 { 1.0 } else { end };
                }
                for axis in 0..3 {
                    right[(row, axis)] = points[point][axis];
                }
                right[(row, 3)] = yaws[point];
                row += 1;
            }
        }
        for k in 1..=3 {
            matrix[(row, k)] = 1.0;
            for j in k..8 {
                matrix[(row + 1, 8 * (count - 1) + j)] = falling(j, k);
            }
            row += 2;
        }
        for i in 1..count {
            // in units of the geometric mean of the two spans, so that rows are of one size
            let ratio = spans[i - 1] / spans[i];
            for k in 1..=6 {
                let (before, after) = (ratio.powf(-0.5 * k as f64), ratio.powf(0.5 * k as f64));
                for j in k..8 {
                    matrix[(row, 8 * (i - 1) + j)] = before * falling(j, k);
                }
                matrix[(row, 8 * i + k)] = -after * falling(k, k);
                row += 1;
            }
        }
        let solution = matrix.lu().solve(&right).filter(|solution| solution.iter().all(|x| x.is_finite()));
        let Some(solution) = solution else {
            return Err(TrajectoryError::Unsolvable);
        };
        let coefficients = |i: usize| std::array::from_fn(|axis| std::array::from_fn(|j| solution[(8 * i + j, axis)]));
        let way = Self { times, segments: (0..count).map(|i| Segment { coefficients: coefficients(i) }).collect() };
        // times that differ by orders of magnitude leave no digits
        let missed = points.iter().zip(&way.times).any(|(point, &time)| {
            let off = (way.reference(time).position - Vector3::from(*point)).norm();
            off > 1e-6 * (1.0 + Vector3::from(*point).norm())
        });
        if missed { Err(TrajectoryError::Unsolvable) } else { Ok(way) }
    }

    /// Most yaw rate of allocated times, rad/s.
    const MAX_YAW_RATE: f64 = std::f64::consts::PI;

    /// Most segments whose times are sought one against the other: every trial solves for all of them.
    const SOUGHT: usize = 24;

    /// Chooses times: such shares of the duration as make it short within the limits, and the way straight. A bad share makes
    /// it swing out far.
    fn allocate(points: &[[f64; 3]], yaws: &[f64], speed: f64, acceleration: f64) -> Result<Self, TrajectoryError> {
        // as long as a trapezoid of speed would take from rest to rest, or the turn
        let legs = points.windows(2).zip(yaws.windows(2)).map(|(pair, yaw)| {
            let way = (Vector3::from(pair[1]) - Vector3::from(pair[0])).norm();
            let seconds = if way * acceleration < speed * speed {
                2.0 * (way / acceleration).sqrt()
            } else {
                way / speed + speed / acceleration
            };
            seconds.max(2.0 * (yaw[1] - yaw[0]).abs() / Self::MAX_YAW_RATE)
        });
        let mut spans: Vec<f64> = legs.collect();
        // neighbours that differ much swing the way out, and make the equations ill to solve
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
            let mut way = Self::solve(points, yaws, times)?;
            // scaling time by k divides speeds by k and accelerations by k²
            let [fastest, hardest, turning] = way.peaks(samples);
            let scale = (fastest / speed).max((hardest / acceleration).sqrt()).max(turning / Self::MAX_YAW_RATE);
            if scale > 0.0 {
                way.times.iter_mut().for_each(|time| *time *= scale);
            }
            Ok(way)
        };
        if (2..=Self::SOUGHT).contains(&spans.len()) {
            // a detour counts as the time to fly it there and back, and as much again
            let cost = |way: &Self| way.duration() + 4.0 * way.detour(points) / speed;
            let mut least = cost(&within(&spans, 24)?);
            for factor in [1.6, 1.25, 1.1] {
                for _ in 0..4 {
                    let before = least;
                    for i in 0..spans.len() {
                        for factor in [factor, 1.0 / factor] {
                            let span = spans[i];
                            spans[i] = span * factor;
                            match within(&spans, 24) {
                                Ok(way) if cost(&way) < least => least = cost(&way),
                                _ => spans[i] = span,
                            }
                        }
                    }
                    if least > 0.99 * before {
                        break;
                    }
                }
            }
        }
        within(&spans, 200)
    }

    /// Greatest distance from the straight way between two waypoints, m.
    fn detour(&self, points: &[[f64; 3]]) -> f64 {
        let legs = self.times.windows(2).zip(points.windows(2));
        let samples = legs.flat_map(|(times, points)| {
            let (from, way) = (Vector3::from(points[0]), Vector3::from(points[1]) - Vector3::from(points[0]));
            (1..12).map(move |sample| {
                let position = self.reference(times[0] + (times[1] - times[0]) * f64::from(sample) / 12.0).position;
                let share = ((position - from).dot(&way) / way.norm_squared().max(1e-12)).clamp(0.0, 1.0);
                (from + way * share - position).norm()
            })
        });
        samples.fold(0.0, f64::max)
    }

    /// Greatest speed (m/s), acceleration (m/s²) and yaw rate (rad/s), from so many samples per segment.
    fn peaks(&self, samples: u32) -> [f64; 3] {
        let mut peaks = [0.0_f64; 3];
        for pair in self.times.windows(2) {
            for sample in 0..=samples {
                let share = f64::from(sample) / f64::from(samples);
                let reference = self.reference(pair[0] + (pair[1] - pair[0]) * share);
                let now = [reference.velocity.norm(), reference.acceleration.norm(), reference.yaw_rate.abs()];
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
        // the segment that has begun, the last one at its end
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
    fn between_two_points_it_is_the_known_polynomial() {
        let way = Waypoints::through(&[[0.0; 3], [1.0, -2.0, 0.5]]).times([0.0, 2.0]).build().unwrap();
        for i in 0..=20 {
            let tau = f64::from(i) / 20.0;
            let share = 35.0 * tau.powi(4) - 84.0 * tau.powi(5) + 70.0 * tau.powi(6) - 20.0 * tau.powi(7);
            let expected = Vector3::new(1.0, -2.0, 0.5) * share;
            assert!((way.reference(2.0 * tau).position - expected).norm() < 1e-9);
        }
    }

    #[test]
    fn it_rests_before_its_start_and_after_its_end() {
        let way =
            Waypoints::through(&[[0.0; 3], [1.0, 0.0, 1.0], [2.0, 1.0, 0.0]]).yaws([3.0, -3.0, 0.0]).build().unwrap();
        let end = way.duration() + 1.0;
        for (time, position, yaw) in [(-1.0, Vector3::zeros(), 3.0), (end, Vector3::new(2.0, 1.0, 0.0), 0.0)] {
            let reference = way.reference(time);
            assert!((reference.position - position).norm() < 1e-9 && wrap_angle(reference.yaw - yaw).abs() < 1e-9);
            assert_eq!((reference.velocity.norm(), reference.snap.norm(), reference.yaw_rate), (0.0, 0.0, 0.0));
        }
        let turn = Waypoints::through(&[[0.0; 3], [1.0; 3]]).yaws([3.0, -3.0]).build().unwrap();
        assert!(turn.reference(turn.duration() / 2.0).yaw.abs() > 3.1, "by the shorter turn, across π");
    }

    proptest! {
        /// The integral of snap times the fourth derivative of any change of the way that keeps ends and waypoints is
        /// zero: no neighbouring way has less snap.
        #[test]
        fn snap_is_least(seed in prop::array::uniform32(-1.0..1.0f64)) {
            let points: Vec<_> = seed.chunks_exact(3).take(4).map(|c| [c[0], c[1], c[2]]).collect();
            let mut times = vec![0.0];
            for i in 0..3 {
                times.push(times[i] + 1.0 + 0.5 * seed[20 + i]);
            }
            let way = Waypoints::through(&points).times(times.clone()).build().unwrap();
            let end = way.duration();
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
                let product = way.reference(t).snap.x * change.derivative(4);
                inner += product;
                size += product.abs();
            }
            prop_assert!(inner.abs() < 1e-4 * size, "{inner} of {size}");
        }

        #[test]
        fn derivatives_are_continuous_at_waypoints(seed in prop::array::uniform32(-1.0..1.0f64)) {
            let points: Vec<_> = seed.chunks_exact(3).map(|c| [c[0], c[1], c[2]]).collect();
            let way = Waypoints::through(&points).limits(2.0, 4.0).build().unwrap();
            for &time in &way.times()[1..way.times().len() - 1] {
                let [before, after] = [-1e-9, 1e-9].map(|h| way.reference(time + h));
                prop_assert!((before.jerk - after.jerk).norm() < 1e-4 * (1.0 + after.jerk.norm()));
                prop_assert!((before.snap - after.snap).norm() < 1e-4 * (1.0 + after.snap.norm()));
            }
        }
    }

    #[test]
    fn impossible_waypoints_are_refused() {
        let refused = |builder: WaypointsBuilder, what: &str| {
            let text = builder.build().unwrap_err().to_string();
            assert!(text.contains(what), "{text}");
        };
        let two = || Waypoints::through(&[[0.0; 3], [1.0; 3]]);
        refused(Waypoints::through(&[[0.0; 3]]), "2 to 200");
        refused(Waypoints::through(&[[0.0; 3], [f64::NAN; 3]]), "coordinate is NaN");
        refused(two().yaws([0.0]), "one per waypoint");
        refused(two().times([0.0, 0.0]), "at least 1 ms");
        refused(two().times([1.0, 2.0]), "first waypoint's time is 1");
        refused(two().limits(0.0, 1.0), "greatest speed is 0");
        refused(two().limits(1.0, f64::INFINITY), "greatest acceleration is inf");
    }

    #[test]
    fn two_hundred_waypoints_and_equal_neighbours_are_solved() {
        let points: Vec<_> = (0..200).map(|i| [f64::from(i / 2 % 7), f64::from(i % 3), 1.0]).collect();
        let way = Waypoints::through(&points).build().unwrap();
        for (point, &time) in points.iter().zip(way.times()) {
            assert!((way.reference(time).position - Vector3::from(*point)).norm() < 1e-6);
        }
        let still = Waypoints::through(&[[1.0; 3], [1.0; 3]]).build().unwrap();
        assert!((still.reference(0.05).position - Vector3::repeat(1.0)).norm() < 1e-12);
    }
}
