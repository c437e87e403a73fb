//! Ground effect: rotors near the floor produce more thrust (eq. 2 of the paper, after Shi et al. 2019).
//!
//! ΔF_z = C_gnd · Σ k_f·nᵢ² · (r_p / 4h)²,  h = max(p_z, h_clip)
//!
//! The force acts along world z. It is zero for a drone that is upside down. h_clip keeps the force bounded as h → 0.

use crate::math::Real;

/// Ground-effect constants of one drone.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct GroundEffect<R = f64> {
    /// C_gnd·(r_p / 4)², m².
    pub coefficient: R,
    /// Height below which the force stays constant, m.
    pub clip: R,
}

impl<R: Real> GroundEffect<R> {
    /// Returns the additional force along world z, N, from the height (m), the world z component of body z and the
    /// collective thrust (N).
    #[inline(always)]
    pub fn force(&self, height: R, up: R, thrust: R) -> R {
        let (zero, height) = (height.all(0.0), self.clip.greater(height));
        let force = thrust * self.coefficient / (height * height);
        // body z points upwards if |roll| and |pitch| are below 90°
        // without the effect the clip is zero, so the height may be zero
        R::choose(zero.less(up) & zero.less(self.coefficient), force, zero)
    }
}
