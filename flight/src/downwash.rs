//! Downwash: the wake of a drone pushes the drones below it down (eq. 4 of the paper, after the Dynamic
//! Systems Lab).
//!
//! For a lower drone at a height difference Δz > 0 and a lateral distance Δxy < 10 m:
//!
//! F_z = −α · exp(−½ (Δxy / β)²),  α = C1 · (r_p / 4Δz)²,  β = C2·Δz + C3
//!
//! The coefficients and the propeller radius r_p are those of the upper drone. The published formula is singular at
//! Δz → 0 and evaluates 0/0 where β vanishes (Δz = 0.6875 m for the Crazyflie). This implementation caps the force at
//! `MAX_THRUST` of the upper drone, because a wake carries at most the momentum that the rotors put into it. Where β
//! is zero, the force acts only on the axis of the wake.

use crate::math::{Real, exp_of_negative};

/// Lateral distance beyond which the downwash is zero, m.
pub const REACH: f64 = 10.0;

/// Value of (Δxy / β)² beyond which no exponential is computed. For height differences above [`CLOSE`] the force is
/// then below 1e-20 N, less than the last bit of any other force.
const NEGLIGIBLE: f64 = 120.0;

/// Height difference below which α is so large that the exponential is computed until it underflows, m.
const CLOSE: f64 = 0.01;

/// Value of (Δxy / β)² beyond which the exponential underflows to zero.
const VANISHING: f64 = 1491.0;

/// Wake of one drone.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Wake<R = f64> {
    /// C1·(r_p / 4)², N·m².
    pub strength: R,
    /// C2.
    pub spread: R,
    /// C3, m.
    pub offset: R,
    /// Largest force, N.
    pub cap: R,
}

impl<R: Real> Wake<R> {
    /// Returns true where the force is not negligible on a drone that is `below` (m) lower, at a squared lateral
    /// distance of `sideways_squared` (m²).
    #[inline(always)]
    pub fn reaches(&self, below: R, sideways_squared: R) -> R::Mask {
        let beta = self.spread * below + self.offset;
        let limit = R::choose(below.all(CLOSE).less(below), below.all(NEGLIGIBLE), below.all(VANISHING));
        // false for NaN, so that its force is zero; true on the axis of a wake with β = 0
        let near = sideways_squared.less(limit * (beta * beta) + R::MIN_POSITIVE);
        below.all(0.0).less(below) & sideways_squared.less(below.all(REACH * REACH)) & near
    }

    /// Returns the force along world z (N, zero or negative) on a drone that is `below` (m) lower, at a squared
    /// lateral distance of `sideways_squared` (m²).
    #[inline(always)]
    pub fn force(&self, below: R, sideways_squared: R) -> R {
        let inside = self.reaches(below, sideways_squared);
        let beta = self.spread * below + self.offset;
        let fallen = exp_of_negative(sideways_squared * -0.5 / (beta * beta));
        // 0/0 on the axis of a wake with β = 0
        let share = R::choose(sideways_squared.less(below.all(R::MIN_POSITIVE)), below.all(1.0), fallen);
        // the cap follows the product, because the strength is infinite at zero distance
        let force = -(self.strength / (below * below) * share).lesser(self.cap);
        R::choose(inside, force, below.all(0.0))
    }

    /// Selects `yes` where the mask is true and `no` elsewhere.
    #[inline(always)]
    pub fn choose(mask: R::Mask, yes: &Self, no: &Self) -> Self {
        Self {
            strength: R::choose(mask, yes.strength, no.strength),
            spread: R::choose(mask, yes.spread, no.spread),
            offset: R::choose(mask, yes.offset, no.offset),
            cap: R::choose(mask, yes.cap, no.cap),
        }
    }
}
