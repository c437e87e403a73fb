//! Free rigid body: MuJoCo's RK4, implemented without MuJoCo.
//!
//! A drone without contacts is a free rigid body under forces that are constant during a physics step; with body-fixed
//! forcing the rotors' wrench rotates with the body. MuJoCo's fluid forces act if the medium is on.

use crate::math::{MAX_HALF_ANGLE_SQUARED, Real, Turn, V3, half_angle, sin_cos};
use crate::state::FlightState;

/// Free rigid body with the coefficients of its equations of motion, scalar or SIMD.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct FreeBody<R = f64> {
    /// Reciprocal of the mass, 1/kg.
    pub inverse_mass: R,
    /// Acceleration of gravity, downwards, m/s².
    pub gravity: R,
    /// Reciprocals of the moments of inertia, body frame, 1/(kg·m²).
    pub inverse_inertia: [R; 3],
    /// Gyroscopic coefficients (Jy − Jz)/Jx, (Jz − Jx)/Jy and (Jx − Jy)/Jz.
    pub gyration: [R; 3],
    /// Coefficients of the medium's drag.
    pub fluid: Fluid<R>,
}

/// MuJoCo's fluid drag of the body's inertia box, divided by mass and inertia: −(viscous + quadratic·|x|)·x along
/// each body axis.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Fluid<R = f64> {
    /// Coefficient of the velocity, 1/s.
    pub viscous: R,
    /// Coefficients of the squared velocity, 1/m.
    pub quadratic: [R; 3],
    /// Coefficients of the body rates, 1/s.
    pub viscous_rate: [R; 3],
    /// Coefficients of the squared body rates.
    pub quadratic_rate: [R; 3],
}

/// Load on a body during a step.
#[derive(Debug, Clone, Copy)]
pub struct Push<R> {
    /// Thrust of the rotors along body z, N.
    pub thrust: R,
    /// Torque of the rotors, body frame, N·m.
    pub torque: V3<R>,
    /// External force, world frame, N.
    pub force: V3<R>,
}

/// Fluid around a body.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Medium {
    /// Density, kg/m³.
    pub density: f64,
    /// Dynamic viscosity, Pa·s.
    pub viscosity: f64,
}

impl FreeBody {
    /// Largest rotation angle of a body in one step for which [`rk4`](Self::rk4) is exact, rad.
    pub const MAX_TURN: f64 = 0.5;

    /// Creates a body of a mass (kg) and moments of inertia (kg·m²), with gravity (m/s², downwards) and an optional
    /// medium.
    pub fn new(mass: f64, inertia: [f64; 3], gravity: f64, medium: Option<Medium>) -> Self {
        const { assert!(Self::MAX_TURN * Self::MAX_TURN <= 4.0 * MAX_HALF_ANGLE_SQUARED) };
        let [x, y, z] = inertia;
        Self {
            inverse_mass: 1.0 / mass,
            gravity,
            inverse_inertia: [1.0 / x, 1.0 / y, 1.0 / z],
            gyration: [(y - z) / x, (z - x) / y, (x - y) / z],
            fluid: medium.map(|medium| Fluid::new(mass, inertia, medium)).unwrap_or_default(),
        }
    }
}

impl<R: Real> FreeBody<R> {
    /// Creates a body without a medium from its coefficients.
    #[inline(always)]
    pub fn without_medium(inverse_mass: R, gravity: R, inverse_inertia: [R; 3], gyration: [R; 3]) -> Self {
        Self { inverse_mass, gravity, inverse_inertia, gyration, fluid: Fluid::none(gravity) }
    }

    /// Computes one step of MuJoCo's RK4 over `dt` seconds under the rotors' wrench and a force that is constant in
    /// the world frame.
    ///
    /// With `BODY_FIXED` the rotors' wrench rotates with the body in the stages; otherwise it is constant in the
    /// world frame. `MEDIUM` may be false for a body without a medium, which is faster. The step is exact while the
    /// body rotates by less than [`MAX_TURN`](FreeBody::MAX_TURN).
    ///
    /// MuJoCo adds the angular velocities of the stages as vectors and rotates the attitude by the sum. All stages
    /// are therefore rotations from the initial attitude, and this function computes in the body frame of that
    /// attitude.
    #[inline(always)]
    pub fn rk4<const BODY_FIXED: bool, const MEDIUM: bool>(
        &self,
        dt: f64,
        push: &Push<R>,
        start: &FlightState<R>,
    ) -> FlightState<R> {
        self.step::<BODY_FIXED, MEDIUM>(dt, push, start, rotation)
    }

    /// Computes the step of [`rk4`](Self::rk4) for a body that may rotate by any angle, with more operations.
    #[inline(always)]
    pub fn rk4_of_any_turn<const BODY_FIXED: bool, const MEDIUM: bool>(
        &self,
        dt: f64,
        push: &Push<R>,
        start: &FlightState<R>,
    ) -> FlightState<R> {
        self.step::<BODY_FIXED, MEDIUM>(dt, push, start, rotation_by_any_angle)
    }

    #[inline(always)]
    fn step<const BODY_FIXED: bool, const MEDIUM: bool>(
        &self,
        dt: f64,
        push: &Push<R>,
        start: &FlightState<R>,
        rotation: impl Fn(V3<R>) -> Turn<R>,
    ) -> FlightState<R> {
        let (half, sixth) = (0.5 * dt, dt / 6.0);
        let (torque, rate) = (push.torque, start.rate);
        let a1 = self.angular_acceleration::<MEDIUM>(torque, rate);
        let turn2 = rotation(rate * half);
        let rate2 = rate + a1 * half;
        let a2 = self.angular_acceleration::<MEDIUM>(torque_at::<R, BODY_FIXED>(torque, &turn2), rate2);
        let turn3 = rotation(rate2 * half);
        let rate3 = rate + a2 * half;
        let a3 = self.angular_acceleration::<MEDIUM>(torque_at::<R, BODY_FIXED>(torque, &turn3), rate3);
        let turn4 = rotation(rate3 * dt);
        let rate4 = rate + a3 * dt;
        let a4 = self.angular_acceleration::<MEDIUM>(torque_at::<R, BODY_FIXED>(torque, &turn4), rate4);
        let turn = rotation((rate + (rate2 + rate3) * 2.0 + rate4) * sixth);
        let new_rate = rate + (a1 + (a2 + a3) * 2.0 + a4) * sixth;

        let (gained, moved) = if BODY_FIXED || MEDIUM {
            // in the body frame of the initial attitude
            let frame = &start.attitude;
            let mut constant = push.force * self.inverse_mass;
            constant.z = constant.z - self.gravity;
            let mut constant = frame.back(constant);
            let lift = push.thrust * self.inverse_mass;
            if !BODY_FIXED {
                constant.z = constant.z + lift;
            }
            let velocity = frame.back(start.velocity);
            let stage = StageAcceleration::<R, BODY_FIXED, MEDIUM> { constant, lift, fluid: &self.fluid };
            let b1 = stage.acceleration_at_start(velocity);
            let b2 = stage.acceleration(&turn2, velocity + b1 * half);
            let b3 = stage.acceleration(&turn3, velocity + b2 * half);
            let b4 = stage.acceleration(&turn4, velocity + b3 * dt);
            (frame.forth((b1 + (b2 + b3) * 2.0 + b4) * sixth), frame.forth((b1 + b2 + b3) * sixth))
        } else {
            let mut acceleration = (start.attitude.up() * push.thrust + push.force) * self.inverse_mass;
            acceleration.z = acceleration.z - self.gravity;
            (acceleration * dt, acceleration * half)
        };
        FlightState {
            position: start.position + (start.velocity + moved) * dt,
            attitude: rotated(&start.attitude, &turn),
            velocity: start.velocity + gained,
            rate: new_rate,
        }
    }

    /// Returns the force of a medium that moves with the air, minus the force of a still medium, world frame, N.
    /// [`rk4`](Self::rk4) and MuJoCo compute the force of the still medium.
    ///
    /// `velocity` of the body and `air`, the velocity of the medium, are in the world frame, m/s.
    #[inline(always)]
    pub fn medium_change(&self, attitude: &Turn<R>, velocity: V3<R>, air: V3<R>) -> V3<R> {
        let still = self.fluid.slowing(attitude.back(velocity));
        let moving = self.fluid.slowing(attitude.back(velocity - air));
        attitude.forth(moving - still) * (self.inverse_mass.all(1.0) / self.inverse_mass)
    }

    /// Returns the angular acceleration by Euler's equations, body frame, rad/s².
    #[inline(always)]
    pub fn angular_acceleration<const MEDIUM: bool>(&self, torque: V3<R>, rate: V3<R>) -> V3<R> {
        let ([jx, jy, jz], [gx, gy, gz]) = (self.inverse_inertia, self.gyration);
        let V3 { x, y, z } = rate;
        let free = V3::new(torque.x * jx + gx * (y * z), torque.y * jy + gy * (z * x), torque.z * jz + gz * (x * y));
        if MEDIUM { free + self.fluid.slowing_rate(rate) } else { free }
    }
}

/// Accelerations of a body in the stages of a step, in the body frame of the initial attitude.
struct StageAcceleration<'a, R, const BODY_FIXED: bool, const MEDIUM: bool> {
    /// Constant part, m/s².
    constant: V3<R>,
    /// Acceleration by the rotors along body z, m/s², used if it rotates with the body.
    lift: R,
    fluid: &'a Fluid<R>,
}

impl<R: Real, const BODY_FIXED: bool, const MEDIUM: bool> StageAcceleration<'_, R, BODY_FIXED, MEDIUM> {
    #[inline(always)]
    fn acceleration_at_start(&self, velocity: V3<R>) -> V3<R> {
        let mut total = self.constant;
        if BODY_FIXED {
            total.z = total.z + self.lift;
        }
        if MEDIUM { total + self.fluid.slowing(velocity) } else { total }
    }

    #[inline(always)]
    fn acceleration(&self, turn: &Turn<R>, velocity: V3<R>) -> V3<R> {
        let mut total = self.constant;
        if BODY_FIXED {
            total = total + turn.up() * self.lift;
        }
        if MEDIUM {
            total = total + turn.forth(self.fluid.slowing(turn.back(velocity)));
        }
        total
    }
}

/// Returns the rotors' torque in the body frame of a stage.
#[inline(always)]
fn torque_at<R: Real, const BODY_FIXED: bool>(torque: V3<R>, turn: &Turn<R>) -> V3<R> {
    if BODY_FIXED { torque } else { turn.back(torque) }
}

/// Returns the drag along one axis.
#[inline(always)]
fn axis_drag<R: Real>(viscous: R, quadratic: R, x: R) -> R {
    -((viscous + quadratic * x.abs()) * x)
}

impl Fluid {
    /// Creates the coefficients of `mj_inertiaBoxFluidModel`.
    fn new(mass: f64, [x, y, z]: [f64; 3], medium: Medium) -> Self {
        use std::f64::consts::PI;
        let edge = |rest: f64| (rest.max(1e-15) / mass * 6.0).sqrt();
        let sides = [edge(y + z - x), edge(x + z - y), edge(x + y - z)];
        let diameter = (sides[0] + sides[1] + sides[2]) / 3.0;
        let around = |axis: usize| (sides[(axis + 1) % 3], sides[(axis + 2) % 3]);
        let inertia = [x, y, z];
        let axes = [0, 1, 2];
        Self {
            viscous: 3.0 * PI * diameter * medium.viscosity / mass,
            quadratic: axes.map(|axis| 0.5 * medium.density * around(axis).0 * around(axis).1 / mass),
            viscous_rate: axes.map(|axis| PI * diameter.powi(3) * medium.viscosity / inertia[axis]),
            quadratic_rate: axes.map(|axis| {
                let (a, b) = around(axis);
                medium.density * sides[axis] * (a.powi(4) + b.powi(4)) / 64.0 / inertia[axis]
            }),
        }
    }

    /// Returns the largest coefficients for a velocity (1/s and 1/m) and for a body rate (1/s and 1).
    pub fn max_coefficients(&self) -> ([f64; 2], [f64; 2]) {
        let max = |values: [f64; 3]| values.into_iter().fold(0.0, f64::max);
        ([self.viscous, max(self.quadratic)], [max(self.viscous_rate), max(self.quadratic_rate)])
    }
}

impl<R: Real> Fluid<R> {
    /// Returns no drag.
    #[inline(always)]
    pub fn none(like: R) -> Self {
        let zero = like.all(0.0);
        Self { viscous: zero, quadratic: [zero; 3], viscous_rate: [zero; 3], quadratic_rate: [zero; 3] }
    }

    /// Returns the drag acceleration at a velocity, both body frame.
    #[inline(always)]
    pub fn slowing(&self, v: V3<R>) -> V3<R> {
        let [x, y, z] = self.quadratic;
        let viscous = self.viscous;
        V3::new(axis_drag(viscous, x, v.x), axis_drag(viscous, y, v.y), axis_drag(viscous, z, v.z))
    }

    /// Returns the angular drag acceleration at body rates.
    #[inline(always)]
    fn slowing_rate(&self, rate: V3<R>) -> V3<R> {
        let ([vx, vy, vz], [x, y, z]) = (self.viscous_rate, self.quadratic_rate);
        V3::new(axis_drag(vx, x, rate.x), axis_drag(vy, y, rate.y), axis_drag(vz, z, rate.z))
    }
}

/// Returns the rotation by a rotation vector, rad, of a magnitude up to [`FreeBody::MAX_TURN`].
#[inline(always)]
fn rotation<R: Real>(angle: V3<R>) -> Turn<R> {
    let (cos, sinc) = half_angle(angle.dot(angle) * 0.25);
    Turn { w: cos, v: angle * (sinc * 0.5) }
}

/// Returns the rotation by a rotation vector of any magnitude, rad.
#[inline(always)]
fn rotation_by_any_angle<R: Real>(angle: V3<R>) -> Turn<R> {
    let square = angle.dot(angle) * 0.25;
    let (short_cos, short_sinc) = half_angle(square);
    let is_short = !square.all(MAX_HALF_ANGLE_SQUARED).less(square);
    let half = square.sqrt();
    let (sin, cos) = sin_cos(half);
    let sinc = R::choose(is_short, short_sinc, sin / half);
    Turn { w: R::choose(is_short, short_cos, cos), v: angle * (sinc * 0.5) }
}

/// Returns an attitude after a rotation.
#[inline(always)]
fn rotated<R: Real>(attitude: &Turn<R>, turn: &Turn<R>) -> Turn<R> {
    let (w, V3 { x, y, z }, c, s) = (attitude.w, attitude.v, turn.w, turn.v);
    let q = [
        w * c - x * s.x - y * s.y - z * s.z,
        w * s.x + x * c + y * s.z - z * s.y,
        w * s.y - x * s.z + y * c + z * s.x,
        w * s.z + x * s.y - y * s.x + z * c,
    ];
    // the norm is one up to rounding; one Newton step squares the error
    let scale = (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]) * -0.5 + 1.5;
    Turn { w: q[0] * scale, v: V3::new(q[1], q[2], q[3]) * scale }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn body() -> FreeBody {
        FreeBody::new(0.027, [1.4e-5, 1.4e-5, 2.17e-5], 9.81, None)
    }

    fn spinning(rate: [f64; 3]) -> FlightState<f64> {
        let zero = V3::zero(0.0);
        let [x, y, z] = rate;
        FlightState { position: zero, attitude: Turn::from_rpy(zero), velocity: zero, rate: V3::new(x, y, z) }
    }

    proptest! {
        /// Below the limit both steps agree.
        #[test]
        fn both_steps_agree_for_small_turns(x in -60.0..60.0f64, y in -60.0..60.0f64, z in -60.0..60.0f64) {
            let push = Push { thrust: 0.3, torque: V3::new(1e-4, -2e-4, 1e-5), force: V3::new(0.01, 0.0, 0.02) };
            let start = spinning([x, y, z]);
            let one = body().rk4::<true, false>(1.0 / 240.0, &push, &start);
            let other = body().rk4_of_any_turn::<true, false>(1.0 / 240.0, &push, &start);
            let apart = (one.velocity - other.velocity).norm() + (one.attitude.v - other.attitude.v).norm();
            prop_assert!(apart < 1e-14, "{apart:e}");
        }
    }

    /// A rotation about a principal axis is exact for any rate.
    #[test]
    fn a_fast_spin_turns_by_rate_times_time() {
        let (dt, none) = (1.0 / 240.0, Push { thrust: 0.0, torque: V3::zero(0.0), force: V3::zero(0.0) });
        for rate in [100.0, 480.0, 1_000.0, -5_000.0, 1e5] {
            let end = body().rk4_of_any_turn::<false, false>(dt, &none, &spinning([0.0, 0.0, rate]));
            let (sin, cos) = (0.5 * rate * dt).sin_cos();
            assert!((end.attitude.w - cos).abs() < 1e-13 * rate.abs(), "{rate}: {}", end.attitude.w);
            assert!((end.attitude.v.z - sin).abs() < 1e-13 * rate.abs(), "{rate}: {}", end.attitude.v.z);
        }
    }
}
