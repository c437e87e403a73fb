//! Gates with an opening that a drone flies through.

use crate::math::{Real, V3, sin_cos, sin_cos_of_turns};

/// Returns the normal of a gate with a yaw, rad: the horizontal unit vector in which drones pass it, world frame.
#[inline(always)]
pub fn normal<R: Real>(yaw: R) -> V3<R> {
    let (sin, cos) = sin_cos(yaw);
    V3::new(cos, sin, yaw.all(0.0))
}

/// Returns a point (world frame, m) in the frame of a gate: x along its normal, y to the left, z up, from its centre.
#[inline(always)]
pub fn in_gate_frame<R: Real>(point: V3<R>, centre: V3<R>, normal: V3<R>) -> V3<R> {
    let away = point - centre;
    V3::new(away.x * normal.x + away.y * normal.y, away.y * normal.x - away.x * normal.y, away.z)
}

/// Returns true if the line segment between two points in the frame of a gate crosses its plane along its normal and
/// inside its square opening. A segment that ends in the plane crosses it; a segment that starts there does not.
#[inline(always)]
pub fn crosses<R: Real>(from: V3<R>, to: V3<R>, half_opening: R) -> R::Mask {
    let zero = half_opening.all(0.0);
    let forward = from.x.less(zero) & !to.x.less(zero);
    let share = from.x / (from.x - to.x);
    let (y, z) = (from.y + (to.y - from.y) * share, from.z + (to.z - from.z) * share);
    forward & y.abs().less(half_opening) & z.abs().less(half_opening)
}

/// Returns the offset of a swaying gate to its left, m, at a time (s): a sine with an amplitude (m), a period (s) and a
/// phase at time zero (turns).
#[inline(always)]
pub fn sway<R: Real>(amplitude: R, period: R, phase: R, time: R) -> R {
    amplitude * sin_cos_of_turns(phase + time / period).0
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn v(x: f64, y: f64, z: f64) -> V3<f64> {
        V3::new(x, y, z)
    }

    #[test]
    fn only_segments_through_the_opening_along_the_normal_cross_a_gate() {
        let half = 0.25;
        for (from, to, expected) in [
            (v(-0.1, 0.0, 0.0), v(0.1, 0.0, 0.0), true),
            // the crossing at a quarter of the segment is inside, its end is not
            (v(-0.1, 0.15, 0.0), v(0.3, 0.45, 0.0), true),
            (v(-0.3, 0.15, 0.0), v(0.1, 0.35, 0.0), false),
            (v(-0.1, 0.0, 0.26), v(0.1, 0.0, 0.26), false),
            (v(-0.1, 0.0, -0.26), v(0.1, 0.0, -0.24), false),
            (v(0.1, 0.0, 0.0), v(-0.1, 0.0, 0.0), false),
            (v(-0.2, 0.0, 0.0), v(-0.1, 0.0, 0.0), false),
            (v(-0.2, 0.0, 0.0), v(0.0, 0.0, 0.0), true),
            (v(0.0, 0.0, 0.0), v(0.2, 0.0, 0.0), false),
            (v(f64::NAN, 0.0, 0.0), v(0.2, 0.0, 0.0), false),
            (v(-0.2, 0.0, 0.0), v(f64::NAN, 0.0, 0.0), false),
        ] {
            assert_eq!(crosses(from, to, half), expected, "{from:?} {to:?}");
        }
    }

    #[test]
    fn a_gate_sways_like_a_sine() {
        for (phase, time, expected) in [(0.0, 0.0, 0.0), (0.0, 1.0, 0.2), (0.25, 2.0, -0.2), (0.5, 5.0, -0.2)] {
            let got: f64 = sway(0.2, 4.0, phase, time);
            assert!((got - expected).abs() < 1e-15, "{got}");
        }
    }

    proptest! {
        /// A crossing does not depend on the pose of the gate in the world.
        #[test]
        fn crossings_turn_with_the_gate(
            yaw in -6.0..6.0_f64, centre in [-5.0..5.0_f64, -5.0..5.0, 0.0..5.0],
            from in [-0.5..0.5_f64, -0.5..0.5, -0.5..0.5], to in [-0.5..0.5_f64, -0.5..0.5, -0.5..0.5],
        ) {
            let (sin, cos) = yaw.sin_cos();
            let centre = V3::new(centre[0], centre[1], centre[2]);
            let world = |p: [f64; 3]| centre + V3::new(cos * p[0] - sin * p[1], sin * p[0] + cos * p[1], p[2]);
            let own = [from, to].map(|point| in_gate_frame(world(point), centre, normal(yaw)));
            for (got, point) in own.iter().zip([from, to]) {
                prop_assert!((*got - V3::new(point[0], point[1], point[2])).norm() < 1e-12);
            }
            // a crossing next to a bar may be rounded to either side
            let share = from[0] / (from[0] - to[0]);
            let at = |axis: usize| (from[axis] + share * (to[axis] - from[axis])).abs();
            prop_assume!(!(from[0] < 0.0 && to[0] >= 0.0) || [at(1), at(2)].iter().all(|x| (x - 0.25).abs() > 1e-9));
            let inside = from[0] < 0.0 && to[0] >= 0.0 && at(1) < 0.25 && at(2) < 0.25;
            prop_assert_eq!(crosses(own[0], own[1], 0.25), inside);
        }
    }
}
