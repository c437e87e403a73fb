//! State of a drone and its frames.
//!
//! The axes of the world frame are x forward, y left and z up. The body frame has the same axes and is fixed to the
//! airframe. Quaternions in the API are `[w, x, y, z]`, body to world. nalgebra stores `[x, y, z, w]`; only [`wxyz`]
//! and [`attitude_from_wxyz`] convert between the two orders.

pub use flight::state::FlightState;
use nalgebra::{Quaternion, UnitQuaternion, Vector3};

use crate::math::{self, ToFlight as _, ToNalgebra as _};

/// State of one drone: position, attitude, velocity and body rates (13 numbers, as in *MuJoCo-Drones-Gym*, Tayal).
///
/// ```
/// use std::f64::consts::FRAC_PI_2;
///
/// use aviary::state::DroneState;
/// use nalgebra::Vector3;
///
/// // 1 m above the ground, facing along y, moving along y
/// let state = DroneState {
///     velocity: Vector3::new(0.0, 2.0, 0.0),
///     ..DroneState::at_rest(Vector3::new(0.0, 0.0, 1.0), Vector3::new(0.0, 0.0, FRAC_PI_2))
/// };
/// assert!((state.velocity_body() - Vector3::new(2.0, 0.0, 0.0)).norm() < 1e-12, "forward");
/// assert!((state.yaw() - FRAC_PI_2).abs() < 1e-12 && state.tilt() < 1e-6);
/// ```
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct DroneState {
    /// Position of the centre of mass, world frame, m.
    #[serde(with = "crate::serial::vector")]
    pub position: Vector3<f64>,
    /// Rotation from the body to the world frame.
    #[serde(with = "crate::serial::attitude")]
    pub attitude: UnitQuaternion<f64>,
    /// Velocity of the centre of mass, world frame, m/s.
    #[serde(with = "crate::serial::vector")]
    pub velocity: Vector3<f64>,
    /// Angular velocity (body rates), **body** frame, rad/s.
    #[serde(with = "crate::serial::vector")]
    pub angular_velocity: Vector3<f64>,
}

impl Default for DroneState {
    fn default() -> Self {
        Self::at_rest(Vector3::zeros(), Vector3::zeros())
    }
}

impl DroneState {
    /// Creates a state at rest, from a position (world frame, m) and roll, pitch and yaw (rad).
    pub fn at_rest(position: Vector3<f64>, rpy: Vector3<f64>) -> Self {
        Self {
            position,
            attitude: attitude_from_rpy(rpy),
            velocity: Vector3::zeros(),
            angular_velocity: Vector3::zeros(),
        }
    }

    /// Returns roll, pitch and yaw, rad: intrinsic z-y'-x'' (yaw, then pitch, then roll). See [`rpy_from_attitude`].
    pub fn rpy(&self) -> Vector3<f64> {
        rpy_from_attitude(&self.attitude)
    }

    /// Returns the yaw of [`rpy`](Self::rpy), rad, in [−π, π].
    pub fn yaw(&self) -> f64 {
        self.attitude.to_flight().yaw()
    }

    /// Returns the angle between the z axes of body and world, rad: 0 upright, π inverted.
    ///
    /// The tilt is unambiguous, unlike roll and pitch: the pitch of an inverted drone can be 0.
    pub fn tilt(&self) -> f64 {
        self.up().z.clamp(-1.0, 1.0).acos()
    }

    /// Returns the z axis of the body in the world frame.
    pub fn up(&self) -> Vector3<f64> {
        body_z(&self.attitude)
    }

    /// Returns the velocity in the body frame, m/s.
    pub fn velocity_body(&self) -> Vector3<f64> {
        self.attitude.inverse_transform_vector(&self.velocity)
    }

    /// Returns the angular velocity in the world frame, rad/s.
    pub fn angular_velocity_world(&self) -> Vector3<f64> {
        self.attitude * self.angular_velocity
    }

    /// Returns true if every value is finite.
    pub fn is_finite(&self) -> bool {
        self.position.iter().chain(&self.velocity).chain(&self.angular_velocity).all(|x| x.is_finite())
            && self.attitude.coords.iter().all(|x| x.is_finite())
    }
}

impl From<&DroneState> for FlightState<f64> {
    #[inline(always)]
    fn from(state: &DroneState) -> Self {
        Self {
            position: state.position.to_flight(),
            attitude: state.attitude.to_flight(),
            velocity: state.velocity.to_flight(),
            rate: state.angular_velocity.to_flight(),
        }
    }
}

impl From<FlightState<f64>> for DroneState {
    #[inline(always)]
    fn from(motion: FlightState<f64>) -> Self {
        Self {
            position: motion.position.to_nalgebra(),
            attitude: motion.attitude.to_nalgebra(),
            velocity: motion.velocity.to_nalgebra(),
            angular_velocity: motion.rate.to_nalgebra(),
        }
    }
}

/// Returns the z axis of the body in the world frame, which is the third column of the rotation matrix.
#[inline]
pub fn body_z(attitude: &UnitQuaternion<f64>) -> Vector3<f64> {
    attitude.to_flight().up().to_nalgebra()
}

/// Returns the quaternion `[w, x, y, z]` of an attitude.
#[inline]
pub fn wxyz(attitude: &UnitQuaternion<f64>) -> [f64; 4] {
    let q = attitude.quaternion();
    [q.w, q.i, q.j, q.k]
}

/// Creates an attitude from a unit quaternion `[w, x, y, z]`. It does not normalize the quaternion, so [`wxyz`]
/// returns the same bits.
#[inline]
pub fn attitude_from_wxyz([w, x, y, z]: [f64; 4]) -> UnitQuaternion<f64> {
    UnitQuaternion::new_unchecked(Quaternion::new(w, x, y, z))
}

/// Creates an attitude from roll, pitch and yaw (rad): yaw about z, then pitch about y', then roll about x''.
///
/// ```
/// use std::f64::consts::FRAC_PI_2;
///
/// use aviary::state::{attitude_from_rpy, wxyz};
/// use nalgebra::Vector3;
///
/// // a quarter turn to the left
/// let left = attitude_from_rpy(Vector3::new(0.0, 0.0, FRAC_PI_2));
/// assert!((left * Vector3::new(1.0, 0.0, 0.0) - Vector3::new(0.0, 1.0, 0.0)).norm() < 1e-12);
/// let [w, _, _, z] = wxyz(&left);
/// assert!((w - 0.5_f64.sqrt()).abs() < 1e-12 && (z - w).abs() < 1e-12);
/// ```
pub fn attitude_from_rpy(rpy: Vector3<f64>) -> UnitQuaternion<f64> {
    UnitQuaternion::from_euler_angles(rpy.x, rpy.y, rpy.z)
}

/// Returns roll in [−π, π], pitch in [−π/2, π/2] and yaw in [−π, π], rad, of an attitude.
///
/// [`attitude_from_rpy`] restores the attitude to within 1e-12. At a pitch of ±π/2 (gimbal lock) only the sum or the
/// difference of roll and yaw is defined: roll is 0 and yaw is the rest of the rotation.
///
/// ```
/// use std::f64::consts::FRAC_PI_2;
///
/// use aviary::state::{attitude_from_rpy, rpy_from_attitude};
/// use nalgebra::Vector3;
///
/// // at a pitch of 90°, a roll of 0.3 and a yaw of 0.5 equal a yaw of 0.2
/// let up = attitude_from_rpy(Vector3::new(0.3, FRAC_PI_2, 0.5));
/// assert!((rpy_from_attitude(&up) - Vector3::new(0.0, FRAC_PI_2, 0.2)).norm() < 1e-12);
/// ```
#[inline]
pub fn rpy_from_attitude(attitude: &UnitQuaternion<f64>) -> Vector3<f64> {
    attitude.to_flight().rpy().to_nalgebra()
}

/// Wraps an angle (rad) to (−π, π].
#[inline]
pub fn wrap_angle(angle: f64) -> f64 {
    /// Magnitude from which the number of turns is too large for the arithmetic of [`math`].
    const LARGE: f64 = 1e6;
    math::wrap_angle(if angle.abs() < LARGE { angle } else { angle % std::f64::consts::TAU })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::f64::consts::{FRAC_PI_2, PI};

    fn angle() -> impl Strategy<Value = f64> {
        -3.1..3.1
    }

    proptest! {
        #[test]
        fn rpy_is_yaw_then_pitch_then_roll(roll in angle(), pitch in -1.5..1.5, yaw in angle()) {
            let rotation = attitude_from_rpy(Vector3::new(roll, pitch, yaw));
            let by_hand = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw)
                * UnitQuaternion::from_axis_angle(&Vector3::y_axis(), pitch)
                * UnitQuaternion::from_axis_angle(&Vector3::x_axis(), roll);
            prop_assert!(rotation.angle_to(&by_hand) < 1e-7);
            let back = rpy_from_attitude(&rotation);
            prop_assert!((back - Vector3::new(roll, pitch, yaw)).norm() < 1e-7, "{back}");
        }

        /// Covers both sides of a pitch of ±90°, where the angles of nalgebra are inaccurate.
        #[test]
        fn rpy_restores_every_attitude_including_gimbal_lock(
            roll in -PI..=PI, yaw in -PI..=PI, exponent in 0.0..17.0f64, beyond: bool, down: bool,
            axis in prop::array::uniform3(-1.0..1.0f64), scale in prop::array::uniform4(-1.0..1.0f64),
        ) {
            let off = if exponent > 16.5 { 0.0 } else { 10f64.powf(-exponent) };
            let pitch = (FRAC_PI_2 + if beyond { off } else { -off }) * if down { -1.0 } else { 1.0 };
            let by_axes = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw)
                * UnitQuaternion::from_axis_angle(&Vector3::y_axis(), pitch)
                * UnitQuaternion::from_axis_angle(&Vector3::x_axis(), roll);
            let lock = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), FRAC_PI_2.copysign(pitch));
            // attitudes: a small rotation away from gimbal lock about any axis, and a random rotation
            let nearby = UnitQuaternion::new(Vector3::from(axis) * off) * by_axes * lock.inverse() * lock;
            let any = UnitQuaternion::new_normalize(Quaternion::new(scale[0], scale[1], scale[2], scale[3] + 1e-3));
            for attitude in [by_axes, nearby, any] {
                let rpy = rpy_from_attitude(&attitude);
                let again = attitude_from_rpy(rpy).coords;
                let apart = (again - attitude.coords).norm().min((again + attitude.coords).norm());
                prop_assert!(apart < 1e-12, "{attitude} has {rpy}, which is {apart:e} away");
                prop_assert!(rpy.x.abs() <= PI && rpy.y.abs() <= FRAC_PI_2 && rpy.z.abs() <= PI, "{rpy}");
                let state = DroneState { attitude, ..DroneState::default() };
                prop_assert_eq!(state.yaw().to_bits(), rpy.z.to_bits());
            }
        }

        /// The yaw is continuous with that of a drone without roll that pitches up to gimbal lock.
        #[test]
        fn roll_is_zero_in_gimbal_lock(roll in -PI..=PI, yaw in -PI..=PI) {
            for pitch in [FRAC_PI_2, -FRAC_PI_2] {
                let rest = if pitch > 0.0 { yaw - roll } else { yaw + roll };
                let rpy = rpy_from_attitude(&attitude_from_rpy(Vector3::new(roll, pitch, yaw)));
                prop_assert!(rpy.x == 0.0 && (rpy.y - pitch).abs() < 1e-12, "{rpy}");
                prop_assert!(wrap_angle(rpy.z - rest).abs() < 1e-12, "{rpy}, expected yaw {rest}");
                for off in [1e-12, 1e-9, 1e-6, 1e-3] {
                    let before = rpy_from_attitude(&attitude_from_rpy(Vector3::new(0.0, pitch * (1.0 - off), yaw)));
                    prop_assert!(wrap_angle(before.z - yaw).abs() < 1e-3, "{before} at {off:e}");
                }
            }
        }

        #[test]
        fn quaternions_keep_their_bits_and_order(w in -1.0..1.0, x in -1.0..1.0, y in -1.0..1.0, z in -1.0..1.0f64) {
            prop_assert_eq!(wxyz(&attitude_from_wxyz([w, x, y, z])), [w, x, y, z]);
        }

        #[test]
        fn up_and_tilt_match_the_rotation(roll in angle(), pitch in -1.5..1.5, yaw in angle()) {
            let state = DroneState::at_rest(Vector3::zeros(), Vector3::new(roll, pitch, yaw));
            prop_assert!((state.up() - state.attitude * Vector3::z()).norm() < 1e-12);
            prop_assert_eq!(state.yaw(), state.rpy().z);
            prop_assert!((state.tilt().cos() - roll.cos() * pitch.cos()).abs() < 1e-12);
        }

        #[test]
        fn wrapping_keeps_the_direction(angle in -100.0..100.0f64, scale in 0.0..300.0f64) {
            let huge = wrap_angle(angle * 10f64.powf(scale));
            prop_assert!(huge.abs() <= PI);
            let wrapped = wrap_angle(angle);
            prop_assert!(wrapped > -PI - 1e-12 && wrapped <= PI + 1e-12);
            prop_assert!((wrapped.sin() - angle.sin()).abs() < 1e-9 && (wrapped.cos() - angle.cos()).abs() < 1e-9);
        }
    }

    #[test]
    fn a_quarter_turn_to_the_left_maps_x_to_y() {
        let half = FRAC_PI_2 / 2.0;
        let left = attitude_from_wxyz([half.cos(), 0.0, 0.0, half.sin()]);
        assert!((left * Vector3::x() - Vector3::y()).norm() < 1e-12);
        assert!((rpy_from_attitude(&left) - Vector3::new(0.0, 0.0, FRAC_PI_2)).norm() < 1e-12);
        let state = DroneState { attitude: left, velocity: Vector3::y(), ..DroneState::default() };
        assert!((state.velocity_body() - Vector3::x()).norm() < 1e-12);
    }
}
