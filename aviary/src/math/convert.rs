use nalgebra::{UnitQuaternion, Vector3};

use super::{Real, Turn, V3};
use crate::state::{attitude_from_wxyz, wxyz};

/// Conversion to the type of `flight` for the same quantity.
pub(crate) trait ToFlight {
    type Flight;

    fn to_flight(&self) -> Self::Flight;
}

/// Conversion to the type of nalgebra for the same quantity.
pub(crate) trait ToNalgebra {
    type Nalgebra;

    fn to_nalgebra(self) -> Self::Nalgebra;
}

impl ToFlight for Vector3<f64> {
    type Flight = V3<f64>;

    #[inline(always)]
    fn to_flight(&self) -> V3<f64> {
        V3 { x: self.x, y: self.y, z: self.z }
    }
}

impl ToNalgebra for V3<f64> {
    type Nalgebra = Vector3<f64>;

    #[inline(always)]
    fn to_nalgebra(self) -> Vector3<f64> {
        Vector3::new(self.x, self.y, self.z)
    }
}

impl ToFlight for UnitQuaternion<f64> {
    type Flight = Turn<f64>;

    #[inline(always)]
    fn to_flight(&self) -> Turn<f64> {
        let [w, x, y, z] = wxyz(self);
        Turn { w, v: V3 { x, y, z } }
    }
}

impl ToNalgebra for Turn<f64> {
    type Nalgebra = UnitQuaternion<f64>;

    #[inline(always)]
    fn to_nalgebra(self) -> UnitQuaternion<f64> {
        attitude_from_wxyz([self.w, self.v.x, self.v.y, self.v.z])
    }
}

/// Product with factors that are the same in all lanes.
pub(crate) trait Weighted {
    /// Multiplies every component by a factor that is the same in all lanes.
    fn weighted(self, weights: &Vector3<f64>) -> Self;
}

impl<R: Real> Weighted for V3<R> {
    #[inline(always)]
    fn weighted(self, weights: &Vector3<f64>) -> Self {
        Self { x: self.x * weights.x, y: self.y * weights.y, z: self.z * weights.z }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::state::attitude_from_rpy;
    use proptest::prelude::*;
    use std::f64::consts::PI;

    proptest! {
        #[test]
        fn a_rotation_from_rpy_is_that_of_the_state(rpy in prop::array::uniform3(-10.0..10.0f64)) {
            let turn = Turn::from_rpy(Vector3::from(rpy).to_flight());
            let expected = attitude_from_rpy(rpy.into()).to_flight();
            prop_assert!((turn.w - expected.w).abs() < 2e-15 && (turn.v - expected.v).norm() < 4e-15);
            prop_assert!((turn.w * turn.w + turn.v.dot(turn.v) - 1.0).abs() < 2e-15);
        }

        #[test]
        fn axes_and_rotation_vectors_match_nalgebra(
            a in prop::array::uniform3(-3.2..3.2f64), b in prop::array::uniform3(-3.2..3.2f64), small: bool,
        ) {
            let b = if small { b.map(|x| 1e-8 * x) } else { b };
            let [a, b] = [a, b].map(|vector| UnitQuaternion::from_scaled_axis(Vector3::from(vector)));
            let [x, y, z] = [Vector3::x(), Vector3::y(), Vector3::z()].map(|axis| (a * axis).to_flight());
            let from_axes = Turn::from_axes(x, y, z).to_nalgebra();
            prop_assert!(from_axes.angle_to(&a) < 1e-7 && (from_axes.norm() - 1.0).abs() < 1e-14);
            let (expected, negative) = (a.coords, -a.coords);
            let off = (from_axes.coords - expected).norm().min((from_axes.coords - negative).norm());
            prop_assert!(off < 1e-14, "{off:e}");
            let to_b = a.to_flight().turn_to(&(a * b).to_flight());
            let (got, expected) = (to_b.rotation_vector().to_nalgebra(), b.scaled_axis());
            // at half a turn, the sign of the axis is undefined
            prop_assume!(expected.norm() < 0.999_99 * PI);
            prop_assert!((got - expected).norm() < 2e-14, "{got} {expected}");
        }
    }
}
