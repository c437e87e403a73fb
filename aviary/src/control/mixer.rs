use nalgebra::{Matrix4, Vector3};

use crate::drone::DroneParams;
use crate::math::{Real, ToFlight as _, V3, finite_zero};

/// Motor mixer: maps a collective thrust and body torques to motor speeds.
///
/// It inverts the [allocation matrix](DroneParams::allocation) of an airframe and saturates the result.
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
    /// Shares of the motors in the collective thrust; `None` for a quarter each.
    #[serde(default)]
    shares: Option<[f64; 4]>,
    thrust_coefficient: f64,
    /// Maximum thrust of one rotor, N.
    max_rotor_thrust: f64,
    max_rpm: f64,
}

impl Mixer {
    /// Share of the maximum thrust below which a motor stops. The thrust of a motor that just stops is zero up to
    /// rounding, of which the square root would make a speed.
    const LEAST_SHARE: f64 = 1e-13;

    /// Creates the mixer of an airframe. Parameters that fail [`validate`](DroneParams::validate) can give NaN
    /// speeds.
    pub fn new(params: &DroneParams) -> Self {
        let inverse = params.allocation().try_inverse().unwrap_or_else(|| Matrix4::repeat(f64::NAN));
        let max_rpm = params.max_rpm();
        // in the inverse the shares of a centred mass have rounding errors
        let shares = (params.center_of_mass != [0.0; 2]).then(|| [0, 1, 2, 3].map(|motor| inverse[(motor, 0)]));
        Self {
            inverse,
            shares,
            thrust_coefficient: params.thrust_coefficient,
            max_rotor_thrust: params.thrust_coefficient * max_rpm * max_rpm,
            max_rpm,
        }
    }

    /// Returns the motor speeds, rpm, within [0, `MAX_RPM`], for a collective thrust (N) and a torque (body frame,
    /// N·m).
    ///
    /// If the motors saturate, the mixer reduces the yaw torque first, then changes the thrust, and finally scales
    /// roll and pitch torque by a common factor. Any non-finite input returns NaN speeds, which a simulation rejects.
    pub fn rpm(&self, thrust: f64, torque_body: Vector3<f64>) -> [f64; 4] {
        self.speeds(thrust, torque_body.to_flight())
    }

    /// Returns the motor speeds of [`rpm`](Self::rpm).
    #[inline(always)]
    pub(super) fn speeds<R: Real>(&self, thrust: R, torque: V3<R>) -> [R; 4] {
        let valid = self.inverse[0].is_finite() && self.max_rotor_thrust.is_finite();
        let mut zero = finite_zero([thrust, torque.x, torque.y, torque.z]);
        let (none, max, coefficient) = (thrust.all(0.0), thrust.all(self.max_rpm), thrust.all(self.thrust_coefficient));
        let least = thrust.all(Self::LEAST_SHARE * self.max_rotor_thrust);
        let mut speeds = self.saturate(thrust, torque);
        for speed in &mut speeds {
            // a comparison with NaN is false, so that NaN stays NaN
            let force = R::choose(speed.less(least), none, *speed);
            let unlimited = (force / coefficient).sqrt();
            *speed = R::choose(max.less(unlimited), max, unlimited);
            // finite inputs can overflow
            zero = zero + *speed * 0.0;
        }
        for speed in &mut speeds {
            *speed = if valid { *speed + zero } else { thrust.all(f64::NAN) };
        }
        speeds
    }

    /// Returns the part of a motor in the collective thrust of [`saturate`](Self::saturate), N.
    #[inline(always)]
    fn share<R: Real>(&self, motor: usize, collective: R) -> R {
        match &self.shares {
            None => collective,
            Some(shares) => collective * shares[motor],
        }
    }

    /// Returns the thrusts of the rotors, N, which are below the maximum.
    #[inline(always)]
    fn saturate<R: Real>(&self, thrust: R, torque: V3<R>) -> [R; 4] {
        let (zero, one, max) = (thrust.all(0.0), thrust.all(1.0), thrust.all(self.max_rotor_thrust));
        let collective = if self.shares.is_some() { thrust } else { thrust * 0.25 };
        let (mut roll_pitch, mut yaw, mut forces) = ([zero; 4], [zero; 4], [zero; 4]);
        for motor in 0..4 {
            let row = self.inverse.row(motor);
            roll_pitch[motor] = torque.x * row[1] + torque.y * row[2];
            yaw[motor] = torque.z * row[3];
            forces[motor] = roll_pitch[motor] + yaw[motor] + self.share(motor, collective);
        }
        let (low, high) = extremes(&forces);
        let saturates = low.less(zero) | max.less(high);
        if !R::any(saturates) {
            return forces;
        }

        // moves the thrust to leave room for roll and pitch, and scales these if no thrust leaves enough
        let (scale, lowest, highest) = match &self.shares {
            None => {
                let (low, high) = extremes(&roll_pitch);
                let scale = R::choose(max.less(high - low), max / (high - low), one);
                (scale, -low * scale, max - high * scale)
            }
            Some(shares) => room(shares, &roll_pitch, max),
        };
        let collective = collective.lesser(highest).greater(lowest);

        // largest share of the yaw torque that fits
        let mut share = one;
        for motor in 0..4 {
            roll_pitch[motor] = roll_pitch[motor] * scale + self.share(motor, collective);
            let room = R::choose(zero.less(yaw[motor]), max - roll_pitch[motor], roll_pitch[motor]);
            let size = yaw[motor].abs();
            share = R::choose(zero.less(size), share.lesser(room / size), share);
        }
        let share = share.greater(zero);
        for motor in 0..4 {
            forces[motor] = R::choose(saturates, roll_pitch[motor] + yaw[motor] * share, forces[motor]);
        }
        forces
    }
}

/// Returns the largest factor up to 1 on the thrusts for roll and pitch that leaves room for a collective thrust, and
/// the smallest and the largest collective thrust (N) with this factor.
#[inline(always)]
fn room<R: Real>(shares: &[f64; 4], roll_pitch: &[R; 4], max: R) -> (R, R, R) {
    // a motor has room for the collective thrusts T with 0 <= scale·demand + T <= cap
    let (mut demand, mut cap) = ([max; 4], [max; 4]);
    for motor in 0..4 {
        demand[motor] = roll_pitch[motor] / max.all(shares[motor]);
        cap[motor] = max / max.all(shares[motor]);
    }
    let mut scale = max.all(1.0);
    for high in 0..4 {
        for low in 0..4 {
            let apart = demand[high] - demand[low];
            scale = R::choose(cap[high].less(apart), scale.lesser(cap[high] / apart), scale);
        }
    }
    let (mut lowest, mut highest) = (-demand[0] * scale, cap[0] - demand[0] * scale);
    for motor in 1..4 {
        lowest = lowest.greater(-demand[motor] * scale);
        highest = highest.lesser(cap[motor] - demand[motor] * scale);
    }
    (scale, lowest, highest)
}

/// Returns the smallest and the largest number.
#[inline(always)]
fn extremes<R: Real>(&[a, b, c, d]: &[R; 4]) -> (R, R) {
    (a.lesser(b).lesser(c.lesser(d)), a.greater(b).greater(c.greater(d)))
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector4;

    use super::*;
    use crate::drone::DroneModel;
    use crate::physics::rotor::RotorModel;
    use proptest::prelude::*;

    /// Airframes with a centred mass, and with a centre of mass at a fraction of the way to the motors.
    fn airframe() -> impl Strategy<Value = DroneParams> {
        let models = prop::sample::select(DroneModel::PAPER.to_vec());
        let offset = prop::option::of(prop::array::uniform2(-0.34..0.34));
        (models, offset).prop_map(|(model, offset)| {
            let params = model.params();
            let center_of_mass = offset.map_or([0.0; 2], |offset| offset.map(|x: f64| x * params.arm_length));
            DroneParams { center_of_mass, ..params }
        })
    }

    proptest! {
        /// The square root would make a speed of the rounding error of a motor that just stops.
        #[test]
        fn a_motor_stops_or_turns_clearly(
            params in airframe(), thrust in 0.0..2.0, x in -0.1..0.1, y in -0.1..0.1, z in -0.1..0.1,
        ) {
            let torque = Vector3::new(x, y, z) * params.weight() * params.arm_length * 10.0;
            for speed in Mixer::new(&params).rpm(thrust * params.weight(), torque) {
                prop_assert!(speed == 0.0 || speed > 1e-7 * params.max_rpm(), "{speed}");
            }
        }
    }

    #[test]
    fn non_finite_inputs_and_invalid_airframes_return_nan() {
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
        fn feasible_wrenches_are_reproduced(params in airframe(), speeds in prop::array::uniform4(0.0..1.0)) {
            let rotors = RotorModel::new(&params);
            let asked = rotors.wrench(&speeds.map(|share: f64| share * params.max_rpm()));
            let given = rotors.wrench(&Mixer::new(&params).rpm(asked.thrust, asked.torque_body));
            let lever = params.max_thrust() * params.arm_length;
            prop_assert!((given.thrust - asked.thrust).abs() < 1e-9 * params.max_thrust());
            prop_assert!((given.torque_body - asked.torque_body).norm() < 1e-9 * lever);
        }

        #[test]
        fn saturation_reduces_yaw_first_then_thrust_then_roll_and_pitch(
            params in airframe(), thrust in -1.0..3.0, x in -2.0..2.0, y in -2.0..2.0, z in -2.0..2.0,
        ) {
            let rotors = RotorModel::new(&params);
            let lever = params.max_thrust() * params.arm_length / 4.0;
            let reaction = params.max_thrust() * params.torque_coefficient / params.thrust_coefficient;
            let (thrust, torque) = (thrust * params.max_thrust(), Vector3::new(x * lever, y * lever, z * reaction));
            let rpm = Mixer::new(&params).rpm(thrust, torque);
            prop_assert!(rpm.iter().all(|&n| (0.0..=params.max_rpm()).contains(&n)), "{rpm:?}");
            let given = rotors.wrench(&rpm);
            let tolerance = 1e-9 * lever;
            let kept = |a: f64, b: f64| (a - b).abs() < tolerance;

            // the yaw torque keeps its sign and never exceeds the command
            prop_assert!(given.torque_body.z * torque.z >= -1e-9 * reaction * reaction);
            prop_assert!(given.torque_body.z.abs() <= torque.z.abs() + 1e-9 * reaction);
            let roll_pitch_kept = kept(given.torque_body.x, torque.x) && kept(given.torque_body.y, torque.y);
            if roll_pitch_kept {
                if !kept(given.thrust, thrust) {
                    // the thrust changes only if dropping the yaw torque is not enough
                    let without_yaw = params.allocation().try_inverse().unwrap()
                        * Vector4::new(thrust, torque.x, torque.y, 0.0);
                    let max = params.max_thrust() / 4.0;
                    prop_assert!(without_yaw.min() < 1e-12 || without_yaw.max() > max - 1e-12);
                }
            } else {
                // roll and pitch keep their ratio, with one motor stopped and one at full speed
                let cross = given.torque_body.x * torque.y - given.torque_body.y * torque.x;
                prop_assert!(cross.abs() < 1e-9 * lever * lever);
                let (low, high) = rpm.iter().fold((f64::MAX, 0.0_f64), |(l, h), &n| (l.min(n), h.max(n)));
                prop_assert!(low < 1e-3 * params.max_rpm() && high > (1.0 - 1e-9) * params.max_rpm());
            }
        }
    }
}
