//! Ground effect: rotors near the floor produce more thrust (*MuJoCo-Drones-Gym*, Tayal, eq. 2, after Shi et al.
//! 2019).
//!
//! ΔF_z = C_gnd · Σ k_f·nᵢ² · (r_p / 4h)²,  h = max(p_z, h_clip)
//!
//! The force acts along world z. It is zero for a drone that is upside down. h_clip keeps the force bounded as h → 0:
//! see [`DroneParams::ground_effect_clip`].

use flight::ground_effect;

use crate::drone::DroneParams;
use crate::state::DroneState;

/// Ground-effect constants of one drone.
///
/// ```
/// use aviary::drone::DroneModel;
/// use aviary::physics::ground_effect::GroundEffect;
/// use aviary::state::DroneState;
///
/// let params = DroneModel::Cf2x.params();
/// // from the clip down to the floor the force is at its maximum, 4/15 of the thrust
/// let lift = GroundEffect::new(&params).force(&DroneState::default(), params.weight());
/// assert!((lift / params.weight() - 4.0 / 15.0).abs() < 1e-12);
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct GroundEffect(pub(crate) ground_effect::GroundEffect);

impl GroundEffect {
    /// Creates the ground effect of a drone.
    pub fn new(params: &DroneParams) -> Self {
        let quarter = params.propeller_radius / 4.0;
        Self(ground_effect::GroundEffect {
            coefficient: params.ground_effect_coefficient * quarter * quarter,
            clip: params.ground_effect_clip(),
        })
    }

    /// Returns the additional force along world z, N, at a collective thrust in N.
    #[inline]
    pub fn force(&self, state: &DroneState, thrust: f64) -> f64 {
        self.0.force(state.position.z, state.up().z, thrust)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::drone::DroneModel;
    use nalgebra::Vector3;
    use proptest::prelude::*;

    fn at(z: f64, rpy: [f64; 3]) -> DroneState {
        DroneState::at_rest(Vector3::new(3.0, -2.0, z), rpy.into())
    }

    #[test]
    fn the_force_is_the_papers_formula() {
        for model in DroneModel::ALL {
            let p = model.params();
            let rpm = [1.1, 0.9, 1.05, 0.8].map(|share| share * p.hover_rpm());
            let thrust: f64 = rpm.iter().map(|n| p.thrust_coefficient * n * n).sum();
            for z in [0.2, 0.5, 3.0] {
                let ratio = p.propeller_radius / (4.0 * z);
                let wanted = p.ground_effect_coefficient * thrust * ratio * ratio;
                let got = GroundEffect::new(&p).force(&at(z, [0.3, -0.2, 2.0]), thrust);
                assert!((got - wanted).abs() < 1e-12 * wanted, "{model} at {z} m");
            }
        }
    }

    #[test]
    fn a_drone_without_the_effect_has_no_force_at_any_height() {
        let params = DroneParams { ground_effect_coefficient: 0.0, ..DroneModel::Cf2x.params() };
        for z in [-1.0, 0.0, 1.0] {
            assert_eq!(GroundEffect::new(&params).force(&at(z, [0.0; 3]), 0.3), 0.0);
        }
    }

    proptest! {
        #[test]
        fn the_force_falls_with_height_is_bounded_and_zero_upside_down(
            low in -1.0..5.0, more in 0.0..5.0, roll in -3.1..3.1, pitch in -1.5..1.5, yaw in -3.1..3.1,
        ) {
            let params = DroneModel::Cf2x.params();
            let effect = GroundEffect::new(&params);
            let thrust = params.weight();
            let level = |height| effect.force(&at(height, [0.0; 3]), thrust);
            let (near, far) = (level(low), level(low + more));
            prop_assert!(near >= far && far > 0.0);
            // the force at the clip is C·r²/16 / (r²/16·15/4·C) = 4/15 of the thrust
            prop_assert!(near <= thrust * 4.0 / 15.0 * (1.0 + 1e-12));
            let turned = effect.force(&at(low, [roll, pitch, yaw]), thrust);
            prop_assert_eq!(turned > 0.0, roll.abs() < std::f64::consts::FRAC_PI_2);
        }
    }
}
