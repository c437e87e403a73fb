//! Downwash: the wake of a drone pushes the drones below it down (*MuJoCo-Drones-Gym*, Tayal, eq. 4, after the
//! Dynamic Systems Lab).
//!
//! For a lower drone at a height difference Δz > 0 and a lateral distance Δxy < 10 m:
//!
//! F_z = −α · exp(−½ (Δxy / β)²),  α = C1 · (r_p / 4Δz)²,  β = C2·Δz + C3
//!
//! The coefficients and the propeller radius r_p are those of the upper drone. The published formula is singular at
//! Δz → 0 and evaluates 0/0 where β vanishes (Δz = 0.6875 m for the Crazyflie). This implementation caps the force at
//! `MAX_THRUST` of the upper drone, because a wake carries at most the momentum that the rotors put into it. Where β
//! is zero, the force acts only on the axis of the wake.

use flight::downwash;
pub use flight::downwash::REACH;

use crate::drone::DroneParams;
use crate::state::DroneState;

/// Wake of one drone.
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
pub struct Wake(pub(crate) downwash::Wake);

impl Wake {
    /// Creates the wake of a drone.
    pub fn new(params: &DroneParams) -> Self {
        let [c1, spread, offset] = params.downwash_coefficients;
        let quarter = params.propeller_radius / 4.0;
        Self(downwash::Wake { strength: c1 * quarter * quarter, spread, offset, cap: params.max_thrust() })
    }

    /// Returns the force along world z (N, zero or negative) on a drone that is `below` (m) lower, at a squared
    /// lateral distance of `sideways_squared` (m²).
    #[inline]
    pub fn force(&self, below: f64, sideways_squared: f64) -> f64 {
        self.0.force(below, sideways_squared)
    }
}

/// Adds the wake of every drone to the forces (along world z, N) on the drones below it.
///
/// `wakes`, `states` and `forces` have one entry per drone. The function tests each pair once, and computes an
/// exponential only if one drone is within reach of the other's wake.
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
///
/// # Panics
/// If `wakes` or `forces` is shorter than `states`.
pub fn add_forces(wakes: &[Wake], states: &[DroneState], forces: &mut [f64]) {
    for i in 1..states.len() {
        let a = states[i].position;
        for j in 0..i {
            let apart = a - states[j].position;
            let sideways_squared = apart.x * apart.x + apart.y * apart.y;
            let (lower, wake) = if apart.z > 0.0 { (j, &wakes[i]) } else { (i, &wakes[j]) };
            // most pairs are out of reach of each other
            if wake.0.reaches(apart.z.abs(), sideways_squared) {
                forces[lower] += wake.force(apart.z.abs(), sideways_squared);
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

    /// Returns the force by the published formula, without a cap.
    fn published(params: &DroneParams, below: f64, sideways: f64) -> f64 {
        let [c1, c2, c3] = params.downwash_coefficients;
        let alpha = c1 * (params.propeller_radius / (4.0 * below)).powi(2);
        let beta = c2 * below + c3;
        -alpha * (-0.5 * (sideways / beta).powi(2)).exp()
    }

    #[test]
    fn the_force_is_the_published_formula_where_that_is_finite() {
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
    fn singular_positions_have_finite_forces() {
        let params = DroneModel::Cf2x.params();
        let wake = Wake::new(&params);
        for below in [f64::MIN_POSITIVE, 1e-300, 1e-9, 0.2] {
            assert_eq!(wake.force(below, 0.0), -params.max_thrust(), "{below}");
        }
        // at equal height within rounding the published formula still applies
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
        fn the_force_is_finite_zero_on_the_upper_drone_and_symmetric_about_the_axis(
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
        fn each_drone_gets_the_sum_over_all_pairs(
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
