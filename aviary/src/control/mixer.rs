use nalgebra::{Matrix4, Vector3, Vector4};

use crate::drone::DroneParams;

/// From thrust and torques to motor speeds: the inverse of an airframe's allocation, within what its motors can do.
///
/// ```
/// use aviary::control::Mixer;
/// use aviary::drone::DroneModel;
/// use aviary::physics::rotor::RotorModel;
/// use nalgebra::Vector3;
///
/// let params = DroneModel::Cf2x.params();
/// let torque = Vector3::new(1e-4, -2e-4, 0.0);
/// let rpm = Mixer::new(&params).rpm(params.weight(), torque);
/// let given = RotorModel::new(&params).wrench(&rpm);
/// assert!((given.thrust - params.weight()).abs() < 1e-9 && (given.torque_body - torque).norm() < 1e-9);
/// ```
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Mixer {
    #[serde(with = "crate::serial::matrix")]
    inverse: Matrix4<f64>,
    thrust_coefficient: f64,
    /// Thrust of one rotor at full speed, N.
    max_rotor_thrust: f64,
    max_rpm: f64,
}

impl Mixer {
    /// The mixer of an airframe. One that [`validate`](DroneParams::validate) refuses may have none, and then every
    /// speed is not a number.
    pub fn new(params: &DroneParams) -> Self {
        let inverse = params.allocation().try_inverse().unwrap_or_else(|| Matrix4::repeat(f64::NAN));
        let max_rpm = params.max_rpm();
        Self {
            inverse,
            thrust_coefficient: params.thrust_coefficient,
            max_rotor_thrust: params.thrust_coefficient * max_rpm * max_rpm,
            max_rpm,
        }
    }

    /// Motor speeds (rpm, within [0, `MAX_RPM`]) that give a collective thrust (N) and a torque (body frame, N·m).
    ///
    /// What the motors cannot do together is given up in this order: yaw torque, then thrust, and roll and pitch
    /// torque last and in proportion. What is not a number gives speeds that are not numbers, which a simulation
    /// refuses, and never a plausible speed.
    pub fn rpm(&self, thrust: f64, torque_body: Vector3<f64>) -> [f64; 4] {
        let sound = self.inverse[0].is_finite() && self.max_rotor_thrust.is_finite();
        if !(sound && thrust.is_finite() && torque_body.iter().all(|x| x.is_finite())) {
            return [f64::NAN; 4];
        }
        let forces = self.saturate(thrust, torque_body);
        if forces.iter().any(|force| force.is_nan()) {
            // so large that it is beyond counting
            return [f64::NAN; 4];
        }
        let rpm = |force: f64| (force.max(0.0) / self.thrust_coefficient).sqrt().min(self.max_rpm);
        [rpm(forces[0]), rpm(forces[1]), rpm(forces[2]), rpm(forces[3])]
    }

    fn saturate(&self, thrust: f64, torque_body: Vector3<f64>) -> Vector4<f64> {
        let max = self.max_rotor_thrust;
        let roll_pitch = self.inverse * Vector4::new(0.0, torque_body.x, torque_body.y, 0.0);
        let yaw = self.inverse * Vector4::new(0.0, 0.0, 0.0, torque_body.z);
        let collective = thrust / 4.0;
        let wanted = roll_pitch + yaw + Vector4::repeat(collective);
        if wanted.min() >= 0.0 && wanted.max() <= max {
            return wanted;
        }

        // thrust moves to where roll and pitch fit beside it; where they fit nowhere, they shrink together
        let (low, high) = (roll_pitch.min(), roll_pitch.max());
        let scale = if high - low > max { max / (high - low) } else { 1.0 };
        let roll_pitch = roll_pitch * scale;
        let (lowest, highest) = (-low * scale, max - high * scale);
        let collective = collective.min(highest).max(lowest);

        // and as much of yaw as there is room for
        let mut share: f64 = 1.0;
        for motor in 0..4 {
            let base = roll_pitch[motor] + collective;
            if yaw[motor] > 0.0 {
                share = share.min((max - base) / yaw[motor]);
            } else if yaw[motor] < 0.0 {
                share = share.min(base / -yaw[motor]);
            }
        }
        roll_pitch + Vector4::repeat(collective) + yaw * share.max(0.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::drone::DroneModel;
    use crate::physics::rotor::RotorModel;
    use proptest::prelude::*;

    fn model() -> impl Strategy<Value = DroneModel> {
        prop::sample::select(DroneModel::ALL.to_vec())
    }

    #[test]
    fn what_is_not_a_number_is_no_speed() {
        let mixer = Mixer::new(&DroneModel::Cf2x.params());
        for (thrust, x) in [(f64::NAN, 0.0), (0.3, f64::NAN), (f64::INFINITY, 0.0), (0.3, f64::NEG_INFINITY)] {
            assert!(mixer.rpm(thrust, Vector3::new(x, 0.0, 0.0)).iter().all(|n| n.is_nan()));
        }
        for broken in [
            DroneParams { arm_length: 0.0, ..DroneModel::Race.params() },
            DroneParams { mass: f64::NAN, ..DroneModel::Race.params() },
            DroneParams { torque_coefficient: f64::INFINITY, ..DroneModel::Cf2p.params() },
            DroneParams { thrust_coefficient: 0.0, ..DroneModel::Cf2x.params() },
        ] {
            assert!(Mixer::new(&broken).rpm(0.3, Vector3::zeros()).iter().all(|n| n.is_nan()), "{broken:?}");
        }
        assert!(mixer.rpm(1e300, Vector3::new(1e300, -1e300, 1e300)).iter().all(|n| n.is_finite()));
    }

    proptest! {
        #[test]
        fn inside_the_envelope_the_rotors_give_what_was_asked(model in model(), speeds in prop::array::uniform4(0.0..1.0)) {
            let params = model.params();
            let rotors = RotorModel::new(&params);
            let asked = rotors.wrench(&speeds.map(|share: f64| share * params.max_rpm()));
            let given = rotors.wrench(&Mixer::new(&params).rpm(asked.thrust, asked.torque_body));
            prop_assert!((given.thrust - asked.thrust).abs() < 1e-9 * params.max_thrust());
            prop_assert!((given.torque_body - asked.torque_body).norm() < 1e-9 * params.max_thrust() * params.arm_length);
        }

        #[test]
        fn outside_it_yaw_goes_first_then_thrust_and_roll_and_pitch_last(
            model in model(), thrust in -1.0..3.0, x in -2.0..2.0, y in -2.0..2.0, z in -2.0..2.0,
        ) {
            let params = model.params();
            let rotors = RotorModel::new(&params);
            let lever = params.max_thrust() * params.arm_length / 4.0;
            let reaction = params.max_thrust() * params.torque_coefficient / params.thrust_coefficient;
            let (thrust, torque) = (thrust * params.max_thrust(), Vector3::new(x * lever, y * lever, z * reaction));
            let rpm = Mixer::new(&params).rpm(thrust, torque);
            prop_assert!(rpm.iter().all(|&n| (0.0..=params.max_rpm()).contains(&n)));
            let given = rotors.wrench(&rpm);
            let tolerance = 1e-9 * lever;
            let kept = |a: f64, b: f64| (a - b).abs() < tolerance;

            // yaw is never pushed beyond or against what was asked
            prop_assert!(given.torque_body.z * torque.z >= -1e-9 * reaction * reaction);
            prop_assert!(given.torque_body.z.abs() <= torque.z.abs() + 1e-9 * reaction);
            let roll_pitch_kept = kept(given.torque_body.x, torque.x) && kept(given.torque_body.y, torque.y);
            if roll_pitch_kept {
                if !kept(given.thrust, thrust) {
                    // thrust was moved, which only happens when yaw alone would not have made room
                    let without_yaw = params.allocation().try_inverse().unwrap()
                        * Vector4::new(thrust, torque.x, torque.y, 0.0);
                    let max = params.max_thrust() / 4.0;
                    prop_assert!(without_yaw.min() < 1e-12 || without_yaw.max() > max - 1e-12);
                }
            } else {
                // in proportion, and with one motor standing still and one at full speed
                let cross = given.torque_body.x * torque.y - given.torque_body.y * torque.x;
                prop_assert!(cross.abs() < 1e-9 * lever * lever);
                let (low, high) = rpm.iter().fold((f64::MAX, 0.0_f64), |(l, h), &n| (l.min(n), h.max(n)));
                prop_assert!(low < 1e-3 * params.max_rpm() && high > (1.0 - 1e-9) * params.max_rpm());
            }
        }
    }
}
