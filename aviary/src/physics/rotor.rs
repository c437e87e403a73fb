//! The rotors: thrust and reaction torque are quadratic in speed (paper, eq. 1 and the torques below it).

use nalgebra::{Matrix4, UnitQuaternion, Vector3, Vector4};

use super::Wrench;
use crate::drone::DroneParams;

/// The rotors of one airframe: its allocation matrix times k_f, so that a wrench is one product.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RotorModel {
    /// `[T, τx, τy, τz]` per rpm².
    per_rpm_squared: Matrix4<f64>,
}

/// Collective thrust and torque of the four rotors, body frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RotorWrench {
    /// Thrust T = Σ k_f·nᵢ² along body z, N.
    pub thrust: f64,
    /// Torque, body frame, N·m.
    pub torque_body: Vector3<f64>,
}

impl RotorModel {
    /// The rotors of an airframe.
    pub fn new(params: &DroneParams) -> Self {
        Self { per_rpm_squared: params.allocation() * params.thrust_coefficient }
    }

    /// What four rotors at these speeds (rpm) do to the airframe:
    /// Fᵢ = k_f·nᵢ², τx and τy by the lever arms, τz = k_m·Σ ±nᵢ².
    #[inline]
    pub fn wrench(&self, rpm: &[f64; 4]) -> RotorWrench {
        let squared = Vector4::new(rpm[0] * rpm[0], rpm[1] * rpm[1], rpm[2] * rpm[2], rpm[3] * rpm[3]);
        let wrench = self.per_rpm_squared * squared;
        RotorWrench { thrust: wrench[0], torque_body: Vector3::new(wrench[1], wrench[2], wrench[3]) }
    }
}

impl RotorWrench {
    /// The same in the world frame, for a body of this attitude.
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
    fn hover_speed_carries_the_weight_and_turns_nothing() {
        for model in DroneModel::ALL {
            let params = model.params();
            let wrench = RotorModel::new(&params).wrench(&[params.hover_rpm(); 4]);
            assert!((wrench.thrust - params.weight()).abs() < 1e-12);
            assert!(wrench.torque_body.norm() < 1e-15);
        }
    }

    proptest! {
        #[test]
        fn force_points_along_body_z_and_torque_turns_with_the_body(
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
