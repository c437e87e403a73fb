use super::rim::MIN_NORM;
use crate::math::MAX_HALF_ANGLE_SQUARED;

/// Returns true if the tilt is so small that the last bits of the attitude decide about the contact points.
#[inline(always)]
pub(super) fn is_upright(q: &[f64; 4]) -> bool {
    let [w, x, y, z] = *q;
    // a quarter of the square of the sine of the tilt, which is below 0.03, for both ends of the body
    (x * x + y * y) * (w * w + z * z) < 2.5e-4
}

/// Returns a quaternion after a rotation at a constant body rate (`mju_quatIntegrate`). It repeats MuJoCo's operations
/// if the result is upright; otherwise its norm is one up to rounding.
#[inline(always)]
pub(super) fn turned(q: &[f64; 4], rate: [f64; 3], time: f64) -> [f64; 4] {
    let [x, y, z] = rate;
    let squared = x * x + y * y + z * z;
    let half_time = 0.5 * time;
    let half_squared = half_time * half_time * squared;
    if half_squared <= MAX_HALF_ANGLE_SQUARED {
        let (cos, sinc) = half_angle(half_squared);
        let by = half_time * sinc;
        let end = product(q, cos, [x * by, y * by, z * by]);
        if !is_upright(&end) {
            return end;
        }
    }
    let norm = squared.sqrt();
    let half = time * norm * 0.5;
    if half == 0.0 {
        return normalized(*q);
    }
    let [x, y, z] = if norm < MIN_NORM {
        [1.0, 0.0, 0.0]
    } else {
        let inverse = 1.0 / norm;
        [x * inverse, y * inverse, z * inverse]
    };
    let (sin, cos) = half.sin_cos();
    normalized(product(q, cos, [x * sin, y * sin, z * sin]))
}

/// Returns cos(a) and sin(a)/a from a², for |a| ≤ 0.25 rad, like [`crate::math::half_angle`], in fewer steps that
/// depend on each other.
#[inline(always)]
fn half_angle(x: f64) -> (f64, f64) {
    let square = x * x;
    let fourth = square * square;
    let cos =
        ((1.0 - 0.5 * x) + square * (1.0 / 24.0 - 1.0 / 720.0 * x)) + fourth * (1.0 / 40_320.0 - 1.0 / 3_628_800.0 * x);
    let sinc = ((1.0 - 1.0 / 6.0 * x) + square * (1.0 / 120.0 - 1.0 / 5040.0 * x))
        + fourth * (1.0 / 362_880.0 - 1.0 / 39_916_800.0 * x);
    (cos, sinc)
}

/// Returns the product of two quaternions (`mju_mulQuat`).
#[inline(always)]
fn product(q: &[f64; 4], cos: f64, [x, y, z]: [f64; 3]) -> [f64; 4] {
    let [a, b, c, d] = *q;
    [
        a * cos - b * x - c * y - d * z,
        a * x + b * cos + c * z - d * y,
        a * y - b * z + c * cos + d * x,
        a * z + b * y - c * x + d * cos,
    ]
}

/// Normalizes a quaternion whose norm is one up to rounding. It repeats MuJoCo's operations if the result is upright.
#[inline(always)]
pub(super) fn renormalized(q: [f64; 4]) -> [f64; 4] {
    let [w, x, y, z] = q;
    let excess = ((w * w + x * x) + (y * y + z * z)) - 1.0;
    if is_upright(&q) || excess.is_nan() || excess.abs() > 1e-8 {
        return normalized(q);
    }
    // one Newton step squares the error
    let scale = 1.0 - 0.5 * excess;
    [w * scale, x * scale, y * scale, z * scale]
}

/// Normalizes a quaternion (`mju_normalize4`).
#[inline(always)]
pub(super) fn normalized(q: [f64; 4]) -> [f64; 4] {
    let [w, x, y, z] = q;
    let norm = (w * w + x * x + y * y + z * z).sqrt();
    if norm == 1.0 {
        return q;
    }
    let inverse = 1.0 / norm;
    [w * inverse, x * inverse, y * inverse, z * inverse]
}

/// Returns the rotation matrix of a unit quaternion, by rows (`mju_quat2Mat`).
#[inline(always)]
pub(super) fn matrix(q: &[f64; 4]) -> [[f64; 3]; 3] {
    let [w, x, y, z] = *q;
    let (ww, xx, yy, zz) = (w * w, x * x, y * y, z * z);
    let (wx, wy, wz, xy, xz, yz) = (w * x, w * y, w * z, x * y, x * z, y * z);
    [
        [ww + xx - yy - zz, 2.0 * (xy - wz), 2.0 * (xz + wy)],
        [2.0 * (xy + wz), ww - xx + yy - zz, 2.0 * (yz - wx)],
        [2.0 * (xz - wy), 2.0 * (yz + wx), ww - xx - yy + zz],
    ]
}
