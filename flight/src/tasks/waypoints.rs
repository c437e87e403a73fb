//! Progress along waypoints and gates.

use crate::math::{Real, Turn, V3};

/// Returns the distance of a point from the line segment between two others, m. A drone passes a point if its path in
/// a control step comes within a radius of it.
#[inline(always)]
pub fn distance_to_leg<R: Real>(from: V3<R>, to: V3<R>, point: V3<R>) -> R {
    let leg = to - from;
    let length = leg.dot(leg);
    let (zero, one) = (length.all(0.0), length.all(1.0));
    let share = (point - from).dot(leg) / length;
    let share = R::choose(zero.less(length), zero.greater(one.lesser(share)), zero);
    (from + leg * share - point).norm()
}

/// Returns a vector of the world frame in the body frame.
#[inline(always)]
pub fn in_body_frame<R: Real>(attitude: &Turn<R>, world: V3<R>) -> V3<R> {
    // the order of the operations is nalgebra's
    let inverse = -attitude.v;
    let across = inverse.cross(world) * 2.0;
    across * attitude.w + inverse.cross(across) + world
}
