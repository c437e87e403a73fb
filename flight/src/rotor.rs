//! Rotors: thrust and reaction torque are quadratic in the rotor speed (eq. 1 of the paper and the torques below it).

use crate::math::{Real, V3};

/// Rotors of one drone: the allocation matrix times k_f, so that one matrix product gives the wrench.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct RotorModel<R = f64> {
    /// Thrust coefficient of each rotor, N/rpm².
    pub thrust: R,
    /// Torque coefficients of the rotors about body x, y and z, N·m/rpm².
    pub torque: [[R; 4]; 3],
}

impl<R: Real> RotorModel<R> {
    /// Returns the collective thrust (along body z, N) and the torque (body frame, N·m) of four rotors at these
    /// speeds, rpm: Fᵢ = k_f·nᵢ², τx and τy from the lever arms, τz = k_m·Σ ±nᵢ².
    #[inline(always)]
    pub fn thrust_and_torque(&self, rpm: &[R; 4]) -> (R, V3<R>) {
        let squared = [rpm[0] * rpm[0], rpm[1] * rpm[1], rpm[2] * rpm[2], rpm[3] * rpm[3]];
        let [x, y, z] = &self.torque;
        let torque = V3::new(product(x, &squared), product(y, &squared), product(z, &squared));
        (self.thrust * (squared[0] + squared[1] + squared[2] + squared[3]), torque)
    }

    /// Computes [`thrust_and_torque`](Self::thrust_and_torque) at the speeds `base` + `change`, rpm, for an allocation
    /// whose torques cancel at equal speeds.
    ///
    /// The torque is a difference of squared speeds. The squares themselves would cancel to few digits in single
    /// precision; n² − base² = change·(2·base + change) does not.
    #[inline(always)]
    pub fn thrust_and_torque_about(&self, base: R, change: &[R; 4]) -> (R, V3<R>) {
        let double = base + base;
        let squared = [
            change[0] * (double + change[0]),
            change[1] * (double + change[1]),
            change[2] * (double + change[2]),
            change[3] * (double + change[3]),
        ];
        let [x, y, z] = &self.torque;
        let torque = V3::new(product(x, &squared), product(y, &squared), product(z, &squared));
        (self.thrust * (base * base * 4.0 + (squared[0] + squared[1] + squared[2] + squared[3])), torque)
    }
}

// a function, because a closure is not always inlined and then lacks the caller's instruction set
#[inline(always)]
fn product<R: Real>(row: &[R; 4], column: &[R; 4]) -> R {
    row[0] * column[0] + row[1] * column[1] + row[2] * column[2] + row[3] * column[3]
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn speeds_about_a_base_have_the_same_wrench(
            base in 0.0..20_000.0f64, change in prop::array::uniform4(-5_000.0..5_000.0f64),
        ) {
            let (x, y, z) = (1e-11, 2e-11, 3e-12);
            let model = RotorModel { thrust: 3e-10, torque: [[x, x, -x, -x], [-y, y, y, -y], [-z, z, -z, z]] };
            let (thrust, torque) = model.thrust_and_torque(&change.map(|change| base + change));
            let (other, about) = model.thrust_and_torque_about(base, &change);
            prop_assert!((thrust - other).abs() < 1e-14 && (torque - about).norm() < 1e-15);
        }
    }
}
