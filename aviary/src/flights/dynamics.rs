//! Motion of a drone under recorded commands: rotor speeds, one physics step, and disturbances.
//!
//! The forces are those of the simulator, by the same functions: [`RotorModel`], [`AirframeEffects`] and the flight
//! kernel's [`FreeBody`]. Everything that a step computes is generic over a double and a SIMD register.

use flight::airframe::{AirframeEffects, AirframeMotion};
use flight::body::{FreeBody, Push};
use flight::rotor::RotorModel;

use super::{Flight, FlightError};
use crate::drone::{DroneParams, GRAVITY};
use crate::math::{Real, Turn, V3};
use crate::physics::{airframe, rotor};
use crate::state::FlightState;

/// Longest physics step of a prediction, s.
const MAX_STEP: f64 = 2e-3;

/// Returns the number of physics steps between two rows of a flight.
pub(crate) fn substeps(flight: &Flight) -> usize {
    // a step of 10 ms is five steps of 2 ms, also after rounding
    ((flight.step / MAX_STEP - 1e-6).ceil() as usize).max(1)
}

/// Returns the rotor speeds (rpm) of an airframe under the recorded duty and voltage: at the start of every physics
/// step, and at the end of the last one. Element `row · substeps` is the speed at a row.
///
/// Duty and voltage are linear between rows and constant before the first and after the last row. The speeds start in
/// balance with the first command. Without a recorded voltage, the airframe's nominal voltage drives the motors.
pub(crate) fn rotor_speeds(params: &DroneParams, flight: &Flight) -> Result<Vec<[f64; 4]>, FlightError> {
    let motors = &params.motors;
    flight.require(&["m1", "m2", "m3", "m4"], "the motor commands of a prediction")?;
    let nominal = params.nominal_voltage();
    if nominal <= 0.0 {
        flight.require(&["vbat"], "the motor speeds of a prediction")?;
    }
    if !motors.has_duty() {
        return Err(FlightError::Airframe { name: params.name.clone() });
    }
    let duty = flight.duty.as_deref().unwrap_or_default();
    let (count, rows) = (substeps(flight), flight.rows());
    let dt = flight.step / count as f64;
    let share = |time: f64| if time > 0.0 { -(-dt / time).exp_m1() } else { 1.0 };
    let (rise, fall) = (share(motors.rise_time), share(motors.fall_time));
    let command = |row: f64| {
        let row = row.clamp(0.0, (rows - 1) as f64);
        let before = (row as usize).min(rows - 2);
        let part = row - before as f64;
        let between = |a: f64, b: f64| a + (b - a) * part;
        let voltage = flight.voltage.as_ref().map_or(nominal, |v| between(v[before], v[before + 1]));
        [0, 1, 2, 3].map(|motor| motors.speed(between(duty[before][motor], duty[before + 1][motor]), voltage))
    };
    let mut speeds = Vec::with_capacity((rows - 1) * count + 1);
    let mut speed = command(0.0);
    speeds.push(speed);
    for step in 0..(rows - 1) * count {
        // the middle of the step, which makes the lag second order
        let command = command((step as f64 + 0.5) / count as f64 - motors.latency / flight.step);
        for (speed, command) in speed.iter_mut().zip(command) {
            *speed += (command - *speed) * if command > *speed { rise } else { fall };
        }
        speeds.push(speed);
    }
    Ok(speeds)
}

/// Coefficients of the motion of a drone, scalar or SIMD.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Dynamics<R = f64> {
    /// Length of a physics step, s.
    pub dt: f64,
    /// Rotors.
    pub rotors: RotorModel<R>,
    /// Air, trim and inertia of the rotors.
    pub effects: AirframeEffects<R>,
    /// Equations of motion.
    pub body: FreeBody<R>,
    /// Mass, kg.
    pub mass: R,
    /// Moments of inertia, body frame, kg·m².
    pub inertia: [R; 3],
}

impl Dynamics {
    /// Creates the coefficients of an airframe for physics steps of `dt` seconds.
    pub fn new(params: &DroneParams, dt: f64) -> Self {
        Self {
            dt,
            rotors: rotor::RotorModel::new(params).0,
            effects: airframe::AirframeEffects::new(params).0,
            body: crate::engine::flight::FreeBody::new(params.mass, &params.inertia_vector(), GRAVITY, None).0,
            mass: params.mass,
            inertia: params.inertia,
        }
    }
}

impl<R: Real> Dynamics<R> {
    /// Returns thrust (N), torque (body frame, N·m) and drag (world frame, N) of a physics step with these rotor speeds
    /// at its start and end.
    #[inline(always)]
    fn load(&self, speeds: [&[R; 4]; 2], attitude: &Turn<R>, velocity: V3<R>, rate: V3<R>) -> Push<R> {
        let [a, b] = speeds;
        let middle = [(a[0] + b[0]) * 0.5, (a[1] + b[1]) * 0.5, (a[2] + b[2]) * 0.5, (a[3] + b[3]) * 0.5];
        let (mut thrust, mut torque) = self.rotors.thrust_and_torque(&middle);
        let momentum = [self.effects.momentum(a), self.effects.momentum(b)];
        let motion = AirframeMotion { attitude, relative: velocity, rate, momentum };
        let force = self.effects.add(self.dt, &motion, &mut thrust, &mut torque);
        Push { thrust, torque, force }
    }

    /// Computes a physics step under the rotors' thrust and a disturbance: an acceleration (body frame, m/s²) and an
    /// angular acceleration (body frame, rad/s²). The disturbances of roll and pitch, which unequal motors cause, are
    /// those at a thrust equal to the weight, and grow with the thrust.
    #[inline(always)]
    pub fn fly(
        &self,
        speeds: [&[R; 4]; 2],
        acceleration: V3<R>,
        angular: V3<R>,
        state: &FlightState<R>,
    ) -> FlightState<R> {
        let mut push = self.load(speeds, &state.attitude, state.velocity, state.rate);
        let [jx, jy, jz] = self.inertia;
        let load = push.thrust * self.body.inverse_mass / self.body.gravity;
        push.torque = push.torque + angular.times(V3::new(jx * load, jy * load, jz));
        push.force = push.force + state.attitude.forth(acceleration * self.mass);
        self.body.rk4::<true, false>(self.dt, &push, state)
    }

    /// Computes position (m) and velocity (m/s) after a physics step with a given attitude in its middle, under the
    /// rotors' thrust and a disturbance: an acceleration (body frame, m/s²).
    #[inline(always)]
    pub fn translate(
        &self,
        speeds: [&[R; 4]; 2],
        attitude: &Turn<R>,
        acceleration: V3<R>,
        (position, velocity): (V3<R>, V3<R>),
    ) -> (V3<R>, V3<R>) {
        let push = self.load(speeds, attitude, velocity, V3::zero(self.mass));
        let mut total = acceleration * self.mass;
        total.z = total.z + push.thrust;
        let mut change = (attitude.forth(total) + push.force) * self.body.inverse_mass;
        change.z = change.z - self.body.gravity;
        (position + (velocity + change * (0.5 * self.dt)) * self.dt, velocity + change * self.dt)
    }
}

/// A disturbance of an acceleration or of an angular acceleration, body frame.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Disturbance<R> {
    /// Slow part, which is constant during a prediction.
    pub slow: V3<R>,
    /// Fast part, which relaxes to zero.
    pub fast: V3<R>,
}

impl<R: Real> Disturbance<R> {
    /// Returns no disturbance.
    #[inline(always)]
    pub fn zero(like: R) -> Self {
        Self { slow: V3::zero(like), fast: V3::zero(like) }
    }

    /// Returns the disturbance.
    #[inline(always)]
    pub fn total(&self) -> V3<R> {
        self.slow + self.fast
    }

    /// Advances the fast part.
    #[inline(always)]
    pub fn advance(&mut self, by: &FastStep<R>) {
        self.fast = self.fast.times(V3::new(by.level, by.level, by.vertical));
    }
}

/// Factors of the fast part of a [`Disturbance`] over a time.
#[derive(Debug, Clone, Copy)]
pub(crate) struct FastStep<R> {
    /// Factor of the x and y components.
    pub level: R,
    /// Factor of the z component.
    pub vertical: R,
}

/// Returns the attitude at a part (0 to 1) of the time between two attitudes.
#[inline(always)]
pub(crate) fn between<R: Real>(a: &Turn<R>, b: &Turn<R>, part: f64) -> Turn<R> {
    let zero = a.w.all(0.0);
    // a quaternion and its negative are the same rotation
    let is_opposite = (a.w * b.w + a.v.dot(b.v)).less(zero);
    let (bw, bv) = (R::choose(is_opposite, -b.w, b.w), V3::choose(is_opposite, -b.v, b.v));
    let (w, v) = (a.w + (bw - a.w) * part, a.v + (bv - a.v) * part);
    let scale = zero.all(1.0) / (w * w + v.dot(v)).sqrt();
    Turn { w: w * scale, v: v * scale }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::drone::{AirParams, DroneModel, MotorParams};
    use crate::flights::log::tests::tumbling;
    use crate::math::{ToFlight as _, ToNalgebra as _};
    use crate::state::{DroneState, attitude_from_rpy};
    use nalgebra::Vector3;

    /// Returns an airframe like the Crazyflie 2.1, with motors and air.
    pub(crate) fn airframe() -> DroneParams {
        let cf2x = DroneModel::Cf2x.params();
        DroneParams {
            name: "like_cf21".into(),
            mass: 0.04,
            inertia: [1.9e-5, 2.1e-5, 3.0e-5],
            motors: MotorParams {
                speed_at_zero: 900.0,
                speed_per_volt: 5600.0,
                rise_time: 0.05,
                fall_time: 0.08,
                latency: 0.013,
                rotor_inertia: 1e-8,
                ..MotorParams::default()
            },
            air: AirParams {
                linear_drag: [0.017, 0.016, 0.03],
                translational_lift: 2e-3,
                velocity_moment: 3e-4,
                rotational_damping: [2e-4, 3e-4, 1e-4],
                trim_torque: [1e-5, -2e-5, 3e-6],
            },
            ..cf2x
        }
    }

    /// Returns a flight of 1 s with a duty that steps from 0.4 to 0.6 and, half a second later, to 0.3.
    fn steps() -> Flight {
        let duty = |row: usize| match row {
            0..30 => 0.4,
            30..80 => 0.6,
            _ => 0.3,
        };
        let flight = tumbling(101, 0.01);
        Flight { duty: Some((0..101).map(|row| [duty(row); 4]).collect()), voltage: Some(vec![3.5; 101]), ..flight }
    }

    #[test]
    fn rotor_speeds_follow_steps_of_the_duty_in_closed_form() {
        let params = airframe();
        let motors = &params.motors;
        let speeds = rotor_speeds(&params, &steps()).unwrap();
        assert_eq!((speeds.len(), substeps(&steps())), (501, 5));
        let target = |duty: f64| motors.speed_at_zero + motors.speed_per_volt * duty * 3.5;
        assert_eq!(speeds[0], [target(0.4); 4]);
        // the ramp of a row before a step delays the response by half a row
        let delay = 0.01 * 29.5 + motors.latency;
        let after = |time: f64, from: f64, to: f64, constant: f64| to + (from - to) * (-time / constant).exp();
        let up = after(0.7 - delay, target(0.4), target(0.6), motors.rise_time);
        assert!((speeds[350][0] / up - 1.0).abs() < 1e-3, "{} {up}", speeds[350][0]);
        let top = after(0.5, target(0.4), target(0.6), motors.rise_time);
        let down = after(1.0 - delay - 0.5, top, target(0.3), motors.fall_time);
        assert!((speeds[500][2] / down - 1.0).abs() < 2e-3, "{} {down}", speeds[500][2]);
    }

    #[test]
    fn rotor_speeds_of_each_motor_depend_on_its_duty_and_the_voltage() {
        let params = airframe();
        let mut flight = steps();
        flight.duty = Some(vec![[0.1, 0.2, 0.3, 0.4]; 101]);
        let target = |duty: f64, voltage: f64| 900.0 + 5600.0 * duty * voltage;
        assert_eq!(rotor_speeds(&params, &flight).unwrap()[400], [0.1, 0.2, 0.3, 0.4].map(|duty| target(duty, 3.5)));
        // the nominal voltage replaces a missing one
        flight.voltage = None;
        let error = rotor_speeds(&params, &flight).unwrap_err().to_string();
        assert_eq!(error, "tumbling: no column `vbat`, expected for the motor speeds of a prediction");
        let mut nominal = params.clone();
        nominal.motors.voltage = 4.0;
        let speeds = rotor_speeds(&nominal, &flight).unwrap()[400];
        assert!(speeds.iter().zip([0.1, 0.2, 0.3, 0.4]).all(|(speed, duty)| (speed - target(duty, 4.0)).abs() < 1e-9));
        flight.duty = None;
        let error = rotor_speeds(&nominal, &flight).unwrap_err().to_string();
        let expected = "no columns `m1`, `m2`, `m3`, `m4`, expected for the motor commands of a prediction";
        assert!(error.ends_with(expected), "{error}");
        let error = rotor_speeds(&DroneModel::Cf2x.params(), &steps()).unwrap_err().to_string();
        assert_eq!(error, "the airframe cf2x has no `motors.speed_per_volt`, expected motors that a duty drives");
    }

    fn state() -> FlightState<f64> {
        FlightState::from(&DroneState {
            position: Vector3::new(1.0, -2.0, 3.0),
            attitude: attitude_from_rpy(Vector3::new(0.4, -0.7, 2.1)),
            velocity: Vector3::new(1.5, 0.5, -1.0),
            angular_velocity: Vector3::new(0.7, -1.1, 0.4),
        })
    }

    #[test]
    fn a_disturbance_is_an_acceleration_in_the_body_frame() {
        let dynamics = Dynamics::new(&airframe(), 1e-3);
        let speeds = [[15_000.0, 15_500.0, 14_000.0, 16_000.0], [15_010.0, 15_490.0, 14_020.0, 15_980.0]];
        let pair = [&speeds[0], &speeds[1]];
        let none = V3::zero(0.0);
        let (a, b) = (V3::new(0.3, -0.2, 0.5), V3::new(2.0, -1.0, 0.7));
        let before = DroneState::from(dynamics.fly(pair, none, none, &state()));
        let after = DroneState::from(dynamics.fly(pair, a, b, &state()));
        let start = DroneState::from(state());
        let gained = start.attitude.inverse() * (after.velocity - before.velocity) / 1e-3;
        assert!((gained - a.to_nalgebra()).norm() < 1e-3, "{gained}");
        // roll and pitch disturbances grow with the thrust
        let (thrust, _) = dynamics.rotors.thrust_and_torque(&[15_005.0, 15_495.0, 14_010.0, 15_990.0]);
        let lift = airframe().air.translational_lift * start.velocity_body().xy().norm_squared();
        let load = (thrust + lift) / airframe().weight();
        let turned = (after.angular_velocity - before.angular_velocity) / 1e-3;
        let expected = Vector3::new(2.0 * load, -load, 0.7);
        assert!((turned - expected).norm() < 1e-3, "{turned} {expected}");
    }

    #[test]
    fn translation_with_a_given_attitude_is_that_of_the_flight() {
        let params = airframe();
        // many short steps, whose error is of the order of the step
        let dynamics = Dynamics::new(&params, 1e-5);
        let speeds = [[15_000.0, 15_500.0, 14_000.0, 16_000.0]; 2];
        let pair = [&speeds[0], &speeds[1]];
        let bias = V3::new(0.3, -0.2, 0.5);
        let mut flown = state();
        let mut moved = (flown.position, flown.velocity);
        for _ in 0..2000 {
            let next = dynamics.fly(pair, bias, V3::zero(0.0), &flown);
            let middle = between(&flown.attitude, &next.attitude, 0.5);
            moved = dynamics.translate(pair, &middle, bias, moved);
            flown = next;
        }
        assert!((moved.0 - flown.position).norm() < 1e-6 && (moved.1 - flown.velocity).norm() < 1e-4);
    }

    #[test]
    fn attitudes_between_two_ignore_the_sign_of_the_quaternion() {
        let a = attitude_from_rpy(Vector3::new(0.1, 0.2, 0.3)).to_flight();
        let b = attitude_from_rpy(Vector3::new(0.12, 0.17, 0.36)).to_flight();
        let negative = Turn { w: -b.w, v: -b.v };
        for part in [0.0, 0.3, 1.0] {
            let (c, d) = (between(&a, &b, part), between(&a, &negative, part));
            assert!((c.w - d.w).abs() < 1e-15 && (c.v - d.v).norm() < 1e-15);
            assert!((c.w * c.w + c.v.dot(c.v) - 1.0).abs() < 1e-15);
            let turned = a.turn_to(&c).rotation_vector().norm() / a.turn_to(&b).rotation_vector().norm();
            assert!((turned - part).abs() < 1e-4, "{turned}");
        }
    }
}
