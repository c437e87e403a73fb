//! Blade drag: proportional to the body-frame velocity and to the rotor speeds (eq. 3 of the paper, after Forster
//! 2015).
//!
//! F_body = −diag(c_xy, c_xy, c_z) · (Σ 2π·nᵢ / 60) · v_body, rotated into the world frame.

use crate::math::{Real, Turn, V3};

/// Returns the drag of the blades on a drone, world frame, N.
///
/// `coefficients` are those of the body axes, N/(m/s)/(rad/s). `rpm` are the actual rotor speeds. `relative` is the
/// velocity relative to the air, world frame, m/s.
#[inline(always)]
pub fn force<R: Real>(coefficients: V3<R>, attitude: &Turn<R>, rpm: &[R; 4], relative: V3<R>) -> V3<R> {
    let total = (rpm[0] + rpm[1] + rpm[2] + rpm[3]) * (std::f64::consts::TAU / 60.0);
    let velocity_body = attitude.back(relative);
    attitude.forth(-(coefficients.times(velocity_body) * total))
}
