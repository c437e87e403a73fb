//! Rotors: thrust and reaction torque are quadratic in the rotor speed (*MuJoCo-Drones-Gym*, Tayal, eq. 1 and the
//! torques below it).

use flight::rotor;
use nalgebra::{UnitQuaternion, Vector3};

use super::Wrench;
use crate::drone::DroneParams;
use crate::math::ToNalgebra as _;

/// Rotors of one drone: the allocation matrix times k_f, so that one matrix product gives the wrench.
///
/// ```
/// use aviary::drone::DroneModel;
/// use aviary::physics::rotor::RotorModel;
///
/// let params = DroneModel::Cf2x.params();
/// let wrench = RotorModel::new(&params).wrench(&[params.hover_rpm(); 4]);
/// assert!((wrench.thrust - params.weight()).abs() < 1e-12 && wrench.torque_body.norm() < 1e-12);
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct RotorModel(pub(crate) rotor::RotorModel);

/// Collective thrust and torque of the four rotors, body frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RotorWrench {
    /// Thrust along body z, N.
    pub thrust: f64,
    /// Torque, body frame, N·m.
    pub torque_body: Vector3<f64>,
}

impl RotorModel {
    /// Creates the rotors of a drone.
    pub fn new(params: &DroneParams) -> Self {
        let matrix = params.allocation() * params.thrust_coefficient;
        let row = |row: usize| [0, 1, 2, 3].map(|rotor| matrix[(row, rotor)]);
        Self(rotor::RotorModel { thrust: matrix[(0, 0)], torque: [row(1), row(2), row(3)] })
    }

    /// Returns the wrench of four rotors at these speeds, rpm:
    /// Fᵢ = k_f·nᵢ², τx and τy from the lever arms, τz = k_m·Σ ±nᵢ².
    #[inline]
    pub fn wrench(&self, rpm: &[f64; 4]) -> RotorWrench {
        let (thrust, torque_body) = self.0.thrust_and_torque(rpm);
        RotorWrench { thrust, torque_body: torque_body.to_nalgebra() }
    }
}

impl RotorWrench {
    /// Returns the wrench in the world frame for a drone of this attitude.
    #[inline]
    pub fn in_world(&self, attitude: &UnitQuaternion<f64>) -> Wrench {
        Wrench { force_world: crate::state::body_z(attitude) * self.thrust, torque_world: attitude * self.torque_body }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::drone::DroneModel;
    use crate::state::attitude_from_rpy;
    use proptest::prelude::*;

    #[test]
    fn hover_speed_carries_the_weight_without_torque() {
        for model in DroneModel::PAPER {
            let params = model.params();
            let wrench = RotorModel::new(&params).wrench(&[params.hover_rpm(); 4]);
            assert!((wrench.thrust - params.weight()).abs() < 1e-12);
            assert!(wrench.torque_body.norm() < 1e-15);
        }
    }

    proptest! {
        #[test]
        fn force_points_along_body_z_and_torque_rotates_with_the_body(
            rpm in prop::array::uniform4(0.0..20_000.0), roll in -3.0..3.0, pitch in -1.5..1.5, yaw in -3.0..3.0,
        ) {
            let model = RotorModel::new(&DroneModel::Cf2p.params());
            let attitude = attitude_from_rpy(Vector3::new(roll, pitch, yaw));
            let body = model.wrench(&rpm);
            let world = body.in_world(&attitude);
            prop_assert!((world.force_world - attitude * Vector3::new(0.0, 0.0, body.thrust)).norm() < 1e-12);
            prop_assert!((attitude.inverse() * world.torque_world - body.torque_body).norm() < 1e-15);
            let by_hand: f64 = rpm.iter().map(|n| 3.16e-10 * n * n).sum();
            prop_assert!((body.thrust - by_hand).abs() < 1e-12);
        }
    }
}
