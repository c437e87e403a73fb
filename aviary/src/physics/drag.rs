//! Blade drag: proportional to the body-frame velocity and to the rotor speeds (*MuJoCo-Drones-Gym*, Tayal, eq. 3,
//! after Forster 2015).
//!
//! F_body = −diag(c_xy, c_xy, c_z) · (Σ 2π·nᵢ / 60) · v_body, rotated into the world frame.

use nalgebra::Vector3;

use crate::drone::DroneParams;
use crate::math::{ToFlight as _, ToNalgebra as _};
use crate::state::DroneState;

/// Returns the drag of the blades on a drone, world frame, N.
///
/// `rpm` are the actual rotor speeds. `wind` is the velocity of the air, world frame, m/s: the drag depends on the
/// velocity relative to the air.
///
/// ```
/// use aviary::drone::DroneModel;
/// use aviary::physics::drag;
/// use aviary::state::DroneState;
/// use nalgebra::Vector3;
///
/// let params = DroneModel::Cf2x.params();
/// let state = DroneState { velocity: Vector3::new(2.0, 0.0, 0.0), ..DroneState::default() };
/// let rpm = [params.hover_rpm(); 4];
/// assert!(drag::force(&params, &state, &rpm, &Vector3::zeros()).x < 0.0);
/// // a drone that moves with the air has no drag
/// assert!(drag::force(&params, &state, &rpm, &state.velocity).norm() < 1e-15);
/// ```
#[inline]
pub fn force(params: &DroneParams, state: &DroneState, rpm: &[f64; 4], wind: &Vector3<f64>) -> Vector3<f64> {
    let coefficients = Vector3::from(params.drag_coefficients).to_flight();
    let relative = state.velocity.to_flight() - wind.to_flight();
    flight::drag::force(coefficients, &state.attitude.to_flight(), rpm, relative).to_nalgebra()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::drone::DroneModel;
    use proptest::prelude::*;

    #[test]
    fn the_drag_has_hand_computed_values_at_any_heading_and_pitch() {
        let params = DroneModel::Cf2x.params();
        let rpm = [10_000.0, 12_000.0, 14_000.0, 16_000.0];
        let total = 52_000.0 * 2.0 * std::f64::consts::PI / 60.0;
        for yaw in [0.0, 0.7, 2.5] {
            let state = DroneState {
                velocity: Vector3::new(0.0, 2.0, -1.0),
                ..DroneState::at_rest(Vector3::z(), Vector3::new(0.0, 0.0, yaw))
            };
            let wanted = Vector3::new(0.0, -2.0 * 9.1785e-7 * total, 1.0311e-6 * total);
            assert!((force(&params, &state, &rpm, &Vector3::zeros()) - wanted).norm() < 1e-15);
        }
        // at a pitch of 90° body x points down, so a fall is motion along body x
        let state = DroneState {
            velocity: Vector3::new(0.0, 0.0, -1.0),
            ..DroneState::at_rest(Vector3::z(), Vector3::new(0.0, std::f64::consts::FRAC_PI_2, 0.4))
        };
        let wanted = Vector3::new(0.0, 0.0, 9.1785e-7 * total);
        assert!((force(&params, &state, &rpm, &Vector3::zeros()) - wanted).norm() < 1e-15);
    }

    proptest! {
        #[test]
        fn drag_opposes_motion_through_the_air_at_every_attitude(
            v in prop::array::uniform3(-20.0..20.0), w in prop::array::uniform3(-10.0..10.0),
            roll in -3.1..3.1, pitch in -1.5..1.5, yaw in -3.1..3.1, rpm in prop::array::uniform4(1.0..2e4),
        ) {
            let (velocity, wind) = (Vector3::from(v), Vector3::from(w));
            let state = DroneState { velocity, ..DroneState::at_rest(Vector3::z(), Vector3::new(roll, pitch, yaw)) };
            let drag = force(&DroneModel::Race.params(), &state, &rpm, &wind);
            prop_assert!(drag.dot(&(velocity - wind)) < 0.0);
            let carried = DroneState { velocity: wind, ..state };
            prop_assert!(force(&DroneModel::Race.params(), &carried, &rpm, &wind).norm() < 1e-15);
        }
    }
}
