//! Downwash: a drone in another's wake is pushed down (paper, eq. 4, of the Dynamic Systems Lab).
//!
//! For a drone above another by Δz > 0, at a lateral distance Δxy < 10 m:
//!
//! F_z = −α · exp(−½ (Δxy / β)²),  α = C1 · (r_p / 4Δz)²,  β = C2·Δz + C3
//!
//! with the coefficients and propellers of the upper drone. The published formula is singular at Δz → 0 and divides
//! 0 by 0 where β vanishes (Δz = 0.6875 m for the Crazyflie). A wake carries no more momentum than the rotors above
//! can put into it, so that the force is capped at the upper airframe's `MAX_THRUST`; and where β is zero, the wake is
//! a line, outside of which there is nothing.

use crate::drone::DroneParams;
use crate::math::{Real, exp_of_negative};
use crate::state::DroneState;

/// Lateral distance beyond which there is no downwash, m.
pub const REACH: f64 = 10.0;

/// (Δxy / β)² beyond which the force of a drone that is lower by more than [`CLOSE`] is below 1e-20 N, and less than the
/// last bit of any other: no exponential is computed for it.
const NEGLIGIBLE: f64 = 120.0;

/// Difference in height below which α is so large that the exponential counts as far as it is a number, m.
const CLOSE: f64 = 0.01;

/// (Δxy / β)² beyond which the exponential is zero.
const VANISHING: f64 = 1491.0;

/// The wake of one airframe.
///
/// ```
/// use aviary::drone::DroneModel;
/// use aviary::physics::downwash::{REACH, Wake};
///
/// let params = DroneModel::Cf2x.params();
/// let wake = Wake::new(&params);
/// // 1 m straight below: −α
/// let alpha = params.downwash_coefficients[0] * (params.propeller_radius / 4.0).powi(2);
/// assert!((wake.force(1.0, 0.0) + alpha).abs() < 1e-12);
/// assert_eq!([wake.force(-1.0, 0.0), wake.force(1.0, REACH * REACH)], [0.0, 0.0], "above, and too far");
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Wake<R = f64> {
    /// C1·(r_p / 4)², N·m².
    pub(crate) strength: R,
    /// C2.
    pub(crate) spread: R,
    /// C3, m.
    pub(crate) offset: R,
    /// Largest force, N.
    pub(crate) cap: R,
}

impl Wake {
    /// Of an airframe.
    pub fn new(params: &DroneParams) -> Self {
        let [c1, spread, offset] = params.downwash_coefficients;
        let quarter = params.propeller_radius / 4.0;
        Self { strength: c1 * quarter * quarter, spread, offset, cap: params.max_thrust() }
    }

    /// Force along world z (N, not positive) on a drone that is lower by `below` (m) at a squared lateral distance of
    /// `sideways_squared` (m²).
    #[inline]
    pub fn force(&self, below: f64, sideways_squared: f64) -> f64 {
        self.push(below, sideways_squared)
    }
}

#[allow(private_bounds)] // for one number or for many
impl<R: Real> Wake<R> {
    /// Where there is a force worth computing on a drone that is lower by `below` (m) at a squared lateral distance of
    /// `sideways_squared` (m²); of one pair or of many.
    #[inline(always)]
    pub(crate) fn reaches(&self, below: R, sideways_squared: R) -> R::Mask {
        let beta = self.spread * below + self.offset;
        let limit = R::choose(below.all(CLOSE).less(below), below.all(NEGLIGIBLE), below.all(VANISHING));
        // false for NaN, which is then no force; true on the axis of a wake that is a line
        let near = sideways_squared.less(limit * (beta * beta) + f64::MIN_POSITIVE);
        below.all(0.0).less(below) & sideways_squared.less(below.all(REACH * REACH)) & near
    }

    /// [`force`](Self::force) of one pair or of many.
    #[inline(always)]
    pub(crate) fn push(&self, below: R, sideways_squared: R) -> R {
        let inside = self.reaches(below, sideways_squared);
        let beta = self.spread * below + self.offset;
        let fallen = exp_of_negative(sideways_squared * -0.5 / (beta * beta));
        // on the axis of a wake that is a line, 0 / 0
        let share = R::choose(sideways_squared.less(below.all(f64::MIN_POSITIVE)), below.all(1.0), fallen);
        // the lesser after the product: the strength of a wake at no distance at all is infinite
        let force = -(self.strength / (below * below) * share).lesser(self.cap);
        R::choose(inside, force, below.all(0.0))
    }

    /// One wake where true, the other where not.
    #[inline(always)]
    pub(crate) fn choose(mask: R::Mask, yes: &Self, no: &Self) -> Self {
        Self {
            strength: R::choose(mask, yes.strength, no.strength),
            spread: R::choose(mask, yes.spread, no.spread),
            offset: R::choose(mask, yes.offset, no.offset),
            cap: R::choose(mask, yes.cap, no.cap),
        }
    }
}

/// Adds every drone's wake to the forces (along world z, N) on those below it.
///
/// `wakes`, `states` and `forces` have one entry per drone. Each pair is looked at once, and costs an exponential only
/// where one drone is in reach of the other's wake.
///
/// ```
/// use aviary::drone::DroneModel;
/// use aviary::physics::downwash::{Wake, add_forces};
/// use aviary::state::DroneState;
/// use nalgebra::Vector3;
///
/// let at = |z| DroneState::at_rest(Vector3::new(0.0, 0.0, z), Vector3::zeros());
/// let mut forces = [0.0; 2];
/// add_forces(&[Wake::new(&DroneModel::Cf2x.params()); 2], &[at(1.0), at(2.0)], &mut forces);
/// assert!(forces[0] < 0.0 && forces[1] == 0.0, "only the lower one is pushed");
/// ```
pub fn add_forces(wakes: &[Wake], states: &[DroneState], forces: &mut [f64]) {
    for i in 1..states.len() {
        let a = states[i].position;
        for j in 0..i {
            let apart = a - states[j].position;
            let sideways_squared = apart.x * apart.x + apart.y * apart.y;
            let (lower, wake) = if apart.z > 0.0 { (j, &wakes[i]) } else { (i, &wakes[j]) };
            // most pairs are out of each other's reach
            if wake.reaches(apart.z.abs(), sideways_squared) {
                forces[lower] += wake.push(apart.z.abs(), sideways_squared);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::drone::DroneModel;
    use nalgebra::Vector3;
    use proptest::prelude::*;

    /// The published formula, as it stands.
    fn published(params: &DroneParams, below: f64, sideways: f64) -> f64 {
        let [c1, c2, c3] = params.downwash_coefficients;
        let alpha = c1 * (params.propeller_radius / (4.0 * below)).powi(2);
        let beta = c2 * below + c3;
        -alpha * (-0.5 * (sideways / beta).powi(2)).exp()
    }

    #[test]
    fn where_the_published_formula_is_sound_it_is_the_force() {
        let params = DroneModel::Cf2x.params();
        let wake = Wake::new(&params);
        for below in [0.4, 0.5, 0.9, 1.5, 4.0] {
            for sideways in [0.0, 0.03, 0.1, 0.4, 2.0] {
                let wanted = published(&params, below, sideways).max(-params.max_thrust());
                assert!((wake.force(below, sideways * sideways) - wanted).abs() < 1e-15, "{below} {sideways}");
            }
        }
    }

    #[test]
    fn singular_places_are_finite() {
        let params = DroneModel::Cf2x.params();
        let wake = Wake::new(&params);
        for below in [f64::MIN_POSITIVE, 1e-300, 1e-9, 0.2] {
            assert_eq!(wake.force(below, 0.0), -params.max_thrust(), "{below}");
        }
        // beside each other, but for a rounding error: the published formula still counts
        for below in [1e-15, 1e-9, 1e-6, 1e-3, 0.009, 0.011] {
            for sideways in [0.24_f64, 0.5, 1.0, 1.5] {
                let wanted = published(&params, below, sideways).max(-params.max_thrust());
                let got = wake.force(below, sideways * sideways);
                assert!((got - wanted).abs() < 1e-12, "{below} {sideways}: {got} {wanted}");
            }
        }
        let vanishing = 0.11 / 0.16;
        assert!((wake.force(vanishing, 0.0) - published(&params, vanishing * (1.0 + 1e-9), 0.0)).abs() < 1e-6);
        assert_eq!(wake.force(vanishing, 1.0), 0.0);
        assert_eq!((wake.force(0.0, 0.0), wake.force(-1.0, 0.0), wake.force(1.0, f64::NAN)), (0.0, 0.0, 0.0));
    }

    proptest! {
        #[test]
        fn it_is_finite_for_every_pair_zero_above_and_symmetric_around_the_axis(
            p in prop::array::uniform3(-12.0..12.0), q in prop::array::uniform3(-12.0..12.0), angle in -3.1..3.1f64,
        ) {
            let wakes = [Wake::new(&DroneModel::Cf2x.params()), Wake::new(&DroneModel::Race.params())];
            let states = [p, q].map(|at| DroneState::at_rest(Vector3::from(at), Vector3::zeros()));
            let mut forces = [0.0; 2];
            add_forces(&wakes, &states, &mut forces);
            let upper = usize::from(states[1].position.z > states[0].position.z);
            prop_assert_eq!(forces[upper], 0.0);
            let cap = [DroneModel::Cf2x, DroneModel::Race][upper].params().max_thrust();
            prop_assert!(forces[1 - upper] <= 0.0 && forces[1 - upper] >= -cap);

            let apart = states[1].position - states[0].position;
            let turned = nalgebra::UnitQuaternion::from_axis_angle(&Vector3::z_axis(), angle) * apart;
            let mut moved = states;
            moved[1].position = states[0].position + turned;
            let mut again = [0.0; 2];
            add_forces(&wakes, &moved, &mut again);
            prop_assert!((again[1 - upper] - forces[1 - upper]).abs() < 1e-9 * cap);
        }

        #[test]
        fn many_drones_feel_the_sum_of_all_pairs(
            at in prop::collection::vec(prop::array::uniform3(-2.0..2.0), 1..40),
        ) {
            let params = DroneModel::Cf2x.params();
            let wakes = vec![Wake::new(&params); at.len()];
            let states: Vec<_> = at.iter().map(|&p| DroneState::at_rest(p.into(), Vector3::zeros())).collect();
            let mut forces = vec![0.0; at.len()];
            add_forces(&wakes, &states, &mut forces);
            for (j, force) in forces.iter().enumerate() {
                let wanted: f64 = (0..at.len())
                    .map(|i| {
                        let apart = states[i].position - states[j].position;
                        if apart.z > 0.0 && apart.xy().norm() < REACH {
                            published(&params, apart.z, apart.xy().norm()).max(-params.max_thrust())
                        } else {
                            0.0
                        }
                    })
                    .sum();
                prop_assert!((force - wanted).abs() < 1e-12, "{force} {wanted}");
            }
        }
    }
}
