//! The rotors: thrust and reaction torque are quadratic in speed (paper, eq. 1 and the torques below it).

use nalgebra::{UnitQuaternion, Vector3};

use super::Wrench;
use crate::drone::DroneParams;
use crate::math::{Real, V3};

/// The rotors of one airframe: its allocation matrix times k_f, so that a wrench is one product.
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
pub struct RotorModel<R = f64> {
    /// Thrust of any rotor, N/rpm².
    pub(crate) thrust: R,
    /// Torque of each about body x, y and z, N·m/rpm².
    pub(crate) torque: [[R; 4]; 3],
}

/// Collective thrust and torque of the four rotors, body frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RotorWrench {
    /// Along body z, N.
    pub thrust: f64,
    /// N·m.
    pub torque_body: Vector3<f64>,
}

impl RotorModel {
    /// The rotors of an airframe.
    pub fn new(params: &DroneParams) -> Self {
        let matrix = params.allocation() * params.thrust_coefficient;
        let row = |row: usize| [0, 1, 2, 3].map(|rotor| matrix[(row, rotor)]);
        Self { thrust: matrix[(0, 0)], torque: [row(1), row(2), row(3)] }
    }

    /// What four rotors at these speeds (rpm) do to the airframe:
    /// Fᵢ = k_f·nᵢ², τx and τy by the lever arms, τz = k_m·Σ ±nᵢ².
    #[inline]
    pub fn wrench(&self, rpm: &[f64; 4]) -> RotorWrench {
        let (thrust, torque_body) = self.thrust_and_torque(rpm);
        RotorWrench { thrust, torque_body: torque_body.into() }
    }
}

#[allow(private_bounds)] // for one number or for many
impl<R: Real> RotorModel<R> {
    /// The same of one drone or of many.
    #[inline(always)]
    pub(crate) fn thrust_and_torque(&self, rpm: &[R; 4]) -> (R, V3<R>) {
        let squared = [rpm[0] * rpm[0], rpm[1] * rpm[1], rpm[2] * rpm[2], rpm[3] * rpm[3]];
        let [x, y, z] = &self.torque;
        let torque = V3::new(product(x, &squared), product(y, &squared), product(z, &squared));
        (self.thrust * (squared[0] + squared[1] + squared[2] + squared[3]), torque)
    }
}

// inlined for sure, unlike a closure: only so are the instructions those of the caller
#[inline(always)]
fn product<R: Real>(row: &[R; 4], column: &[R; 4]) -> R {
    row[0] * column[0] + row[1] * column[1] + row[2] * column[2] + row[3] * column[3]
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
