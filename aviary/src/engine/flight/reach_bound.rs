use ::flight::body::{self, Push};
use ::flight::clearance::{CollisionCylinder, sphere_floor_clearance};
use nalgebra::Vector3;

use super::FreeBody;
use crate::math::{Real, ToFlight as _, V3};
use crate::physics::airframe::AirframeEffects;
use crate::physics::rotor::RotorWrench;
use crate::state::{DroneState, FlightState};

/// Upper bound of the distance that a drone can travel within a time, whatever its motors do; scalar or SIMD.
///
/// The bound is the radius of a ball around the drone's centre that grows with time. Every bound is conservative.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ReachBound<R = f64> {
    /// Radius of the sphere around the drone, m.
    reach: R,
    /// Largest acceleration by thrust, gravity and wakes, m/s²; infinite if it has no bound.
    acceleration: R,
    /// Linear (1/s) and quadratic (1/m) drag coefficients of a velocity.
    slowing: [R; 2],
    /// Linear (1/s) and quadratic (1) drag coefficients of a body rate.
    braking: [R; 2],
    /// Ratio of the largest to the smallest moment of inertia: the factor by which a body rate can grow without
    /// torque.
    growth: R,
    /// Largest angular acceleration by the rotors, rad/s².
    turning: R,
    /// Bound of the airframe's own effects; `None` if there are none.
    driven: Option<DrivenBound<R>>,
}

/// Upper bound of forces and torques that grow with the motion and may drive it; scalar or SIMD.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct DrivenBound<R = f64> {
    /// Linear (1/s) and quadratic (1/m) coefficients of the acceleration at a speed.
    accelerating: [R; 2],
    /// Largest angular acceleration per speed, rad/s² per m/s.
    turning_per_speed: R,
    /// Largest growth rate of the angular momentum by torques that grow with the body rate, 1/s.
    turning_per_rate: R,
    /// Largest change of the body rate by an exchange of angular momentum with the rotors, rad/s.
    spin_up: R,
}

/// Number of coefficients of a [`DrivenBound`].
pub(super) const DRIVEN: usize = 5;

/// Largest coordinate (m) and speed (m/s) with a finite bound.
const FAR: f64 = 1e6;

/// Margin for rounding, m.
const SLACK: f64 = 1e-9;

impl DrivenBound {
    /// Creates the bound of the effects of an airframe with this body, whose rotors turn with at most `max_rpm`, in air
    /// that moves with at most `air_speed` (m/s). Returns with it the acceleration (m/s²) and the torque (N·m) that are
    /// possible at rest, and the coefficient of the damping (1/s).
    pub(crate) fn new(effects: &AirframeEffects, body: &FreeBody, max_rpm: f64, air_speed: f64) -> (Self, [f64; 3]) {
        let (body, effects) = (&body.0, &effects.0);
        let [x, y, z] = body.inverse_inertia;
        let (max, largest) = (x.max(y).max(z), |numbers: [f64; 3]| numbers.into_iter().fold(0.0, f64::max));
        let linear = largest(effects.linear_drag) * body.inverse_mass;
        let quadratic = effects.translational_lift.abs() * body.inverse_mass;
        let moment = effects.velocity_moment.abs();
        let momentum = effects.momentum_per_rpm.abs() * max_rpm;
        let bound = Self {
            // (v + w)² = v² + 2·w·v + w²
            accelerating: [linear + 2.0 * quadratic * air_speed, quadratic],
            turning_per_speed: moment * max,
            // Damping in a constant direction reduces the angular momentum. It turns with the body, by half of
            // `FreeBody::MAX_TURN` on average.
            //
            // Body and rotors exchange momentum, and the sum is constant (see `spin_up`), except that the torques of
            // the rotors are constant during a step: they miss up to ¾ of the turn of the rotors' momentum
            turning_per_rate: (largest(effects.rotational_damping) * (0.5 * FreeBody::MAX_TURN) + 1.5 * momentum) * max,
            // two rotors turn in each direction, so that their momentum is at most twice that of one, before and after
            spin_up: 4.0 * momentum * max,
        };
        let trim = Vector3::from(effects.trim_torque).norm();
        let [a, b, c] = effects.rotational_damping;
        let damping = largest([a * x, b * y, c * z]);
        (bound, [(linear + quadratic * air_speed) * air_speed, trim + moment * air_speed, damping])
    }
}

impl<R: Real> DrivenBound<R> {
    #[inline(always)]
    pub(super) fn numbers(&self) -> [R; DRIVEN] {
        let [linear, quadratic] = self.accelerating;
        [linear, quadratic, self.turning_per_speed, self.turning_per_rate, self.spin_up]
    }

    #[inline(always)]
    pub(super) fn of([linear, quadratic, turning_per_speed, turning_per_rate, spin_up]: [R; DRIVEN]) -> Self {
        Self { accelerating: [linear, quadratic], turning_per_speed, turning_per_rate, spin_up }
    }

    /// Returns a bound of |v₀| + ∫|F(v)|/m·dt for forces F that drive the motion, where other forces accelerate it by
    /// at most `acceleration`; infinite if `time` is too long for a bound.
    ///
    /// While |v| ≤ V = 2·(|v₀| + a·t), these forces add at most (k₁ + k₂·V)·V·t. If (k₁ + k₂·V)·t ≤ ½, |v| stays below
    /// |v₀| + a·t + V/2 = V.
    #[inline(always)]
    fn speed(&self, time: f64, acceleration: R, speed: R) -> R {
        let max = (speed + acceleration * time) * 2.0;
        let share = (self.accelerating[0] + self.accelerating[1] * max) * time;
        R::choose(share.less(speed.all(0.5)), speed + share * max, speed.all(f64::INFINITY))
    }

    /// Returns the bound of the body rate for a bound without these torques and a bound of the speed; infinite if
    /// `time` is too long.
    ///
    /// The angular momentum L grows by at most k·|L|, so that its growth is at most exp(x) ≤ (1 + x/2)/(1 − x/2) with
    /// x = k·t < 1.
    #[inline(always)]
    fn turn_rate(&self, time: f64, rate: R, speed: R) -> R {
        let share = self.turning_per_rate * time;
        let total = rate + self.turning_per_speed * speed * time + self.spin_up;
        let (one, half) = (rate.all(1.0), share * 0.5);
        R::choose(share.less(one), total * (one + half) / (one - half), rate.all(f64::INFINITY))
    }
}

impl ReachBound {
    /// Creates the bound of a drone of radius `reach` (m) with this body. `acceleration` (m/s², without gravity) and
    /// `torque` (N·m) bound the rotors and the surroundings. `slowing` bounds the accelerations by blade drag and wind,
    /// which grow with the speed: linear (1/s) and quadratic (1/m).
    pub fn new(body: &FreeBody, reach: f64, acceleration: f64, torque: f64, slowing: [f64; 2]) -> Self {
        let body = &body.0;
        let [x, y, z] = body.inverse_inertia;
        let (max, min) = (x.max(y).max(z), x.min(y).min(z));
        let ([linear, quadratic], braking) = body.fluid.max_coefficients();
        Self {
            reach: reach + SLACK,
            acceleration: acceleration + body.gravity.abs(),
            slowing: [slowing[0] + linear, slowing[1] + quadratic],
            braking,
            growth: max / min,
            turning: torque * max,
            driven: None,
        }
    }

    /// Returns the bound of a drone with the effects of [`DrivenBound::new`].
    #[must_use]
    pub(crate) fn driven_by(self, body: &FreeBody, effects: (DrivenBound, [f64; 3])) -> Self {
        let ([x, y, z], (driven, [acceleration, torque, damping])) = (body.0.inverse_inertia, effects);
        Self {
            braking: [self.braking[0] + damping, self.braking[1]],
            acceleration: self.acceleration + acceleration,
            turning: self.turning + torque * x.max(y).max(z),
            driven: Some(driven),
            ..self
        }
    }

    /// Returns the bound of the airframe's own effects.
    pub(super) fn driven(&self) -> Option<DrivenBound> {
        self.driven
    }

    /// Returns the bound of a drone of another radius, m.
    #[must_use]
    pub fn reaching(self, reach: f64) -> Self {
        Self { reach: reach + SLACK, ..self }
    }

    /// Returns the radius of the sphere around the drone, m.
    pub fn reach(&self) -> f64 {
        self.reach
    }

    /// Returns the radius of the ball that a drone cannot leave in `steps` physics steps of `dt` seconds, m. The ball
    /// is centred on the current position. The radius is NaN or infinite if there is no bound, or if the drone may
    /// rotate too fast for the kernel.
    pub fn radius(&self, dt: f64, steps: u32, state: &DroneState) -> f64 {
        self.ball(dt, steps, &FlightState::from(state))
    }

    /// Returns upper bounds of the distance (m) and the rotation angle (rad) in one physics step of `dt` seconds
    /// under a known load of the rotors and an external force (world frame, N).
    pub(crate) fn one_step(
        &self,
        dt: f64,
        body: &FreeBody,
        rotors: &RotorWrench,
        force_world: &Vector3<f64>,
        state: &DroneState,
    ) -> (f64, f64) {
        let push =
            Push { thrust: rotors.thrust, torque: rotors.torque_body.to_flight(), force: force_world.to_flight() };
        self.step_under(dt, &body.0, &push, state.velocity.to_flight(), state.angular_velocity.to_flight())
    }

    pub(super) fn numbers(&self) -> [f64; 8] {
        let ([linear, quadratic], [viscous, drag]) = (self.slowing, self.braking);
        [self.reach, self.acceleration, linear, quadratic, viscous, drag, self.growth, self.turning]
    }
}

impl<R: Real> ReachBound<R> {
    #[inline(always)]
    pub(super) fn of(
        [reach, acceleration, linear, quadratic, viscous, drag, growth, turning]: [R; 8],
        driven: Option<DrivenBound<R>>,
    ) -> Self {
        Self { reach, acceleration, slowing: [linear, quadratic], braking: [viscous, drag], growth, turning, driven }
    }

    /// Computes [`one_step`](ReachBound::one_step), scalar or SIMD.
    #[inline(always)]
    pub(super) fn step_under(
        &self,
        dt: f64,
        body: &body::FreeBody<R>,
        push: &Push<R>,
        velocity: V3<R>,
        body_rate: V3<R>,
    ) -> (R, R) {
        let [x, y, z] = body.inverse_inertia;
        let force = push.thrust.abs() + push.force.norm();
        let known = Self {
            acceleration: force * body.inverse_mass + body.gravity.abs(),
            turning: push.torque.norm() * x.greater(y).greater(z),
            // the load contains them
            driven: None,
            ..*self
        };
        let (speed, rate) = (velocity.norm(), body_rate.norm());
        let turn = known.turn_rate(dt, rate, speed) * dt;
        let stable = known.is_stable(dt, dt, speed, rate);
        (known.travel(dt, speed) + SLACK, R::choose(stable, turn, turn.all(f64::INFINITY)))
    }

    /// Returns a bound of the distance that a drone travels in one physics step under a load, m; infinite where it
    /// may touch the floor, or may rotate too fast for the kernel.
    #[inline(always)]
    pub(super) fn free_travel(
        &self,
        dt: f64,
        body: &body::FreeBody<R>,
        push: &Push<R>,
        cylinder: &CollisionCylinder<R>,
        motion: &FlightState<R>,
    ) -> R {
        let (travel, turn) = self.step_under(dt, body, push, motion.velocity, motion.rate);
        let V3 { x, y, z } = motion.position;
        let ball = sphere_floor_clearance(motion.position, self.reach + travel);
        let up = motion.attitude.up();
        let lowest =
            cylinder.floor_clearance(z, up.z) - (travel + turn * self.reach) - cylinder.coarse_rounding_of_contacts(up);
        let (zero, far) = (z.all(0.0), z.all(FAR));
        let free = zero.less(ball.greater(lowest)) & turn.less(z.all(FreeBody::MAX_TURN));
        let sane = x.abs().less(far) & y.abs().less(far) & z.abs().less(far) & motion.velocity.norm().less(far);
        R::choose(free & sane, travel, z.all(f64::INFINITY))
    }

    /// Computes [`radius`](ReachBound::radius), scalar or SIMD.
    #[inline(always)]
    pub(super) fn ball(&self, dt: f64, steps: u32, motion: &FlightState<R>) -> R {
        let time = dt * f64::from(steps);
        let (mut speed, rate) = (motion.velocity.norm(), motion.rate.norm());
        if let Some(driven) = &self.driven {
            speed = driven.speed(time, self.acceleration, speed);
        }
        let slow_enough = (self.turn_rate(time, rate, speed) * dt).less(rate.all(FreeBody::MAX_TURN));
        let V3 { x, y, z } = motion.position;
        let far = x.all(FAR);
        let stable = self.is_stable(dt, time, speed, rate);
        let sane = x.abs().less(far) & y.abs().less(far) & z.abs().less(far) & speed.less(far);
        R::choose(sane & slow_enough & stable, self.reach + self.travel(time, speed), rate.all(f64::INFINITY))
    }

    /// Returns |v|·t·(1 + t·slowing) + a·t². The last term is twice that of a constant acceleration, because the
    /// forces are held during a step.
    #[inline(always)]
    fn travel(&self, time: f64, speed: R) -> R {
        let slowing = self.slowing[0] + self.slowing[1] * speed;
        (speed * (slowing * time + 1.0) + self.acceleration * time) * time
    }

    /// Returns true if drag removes less than half of a speed or a body rate in each physics step of `dt` seconds,
    /// during `time`. Otherwise a step can overshoot and no bound holds.
    #[inline(always)]
    fn is_stable(&self, dt: f64, time: f64, speed: R, rate: R) -> R::Mask {
        let max = speed + self.acceleration * time;
        let turning = self.turn_rate(time, rate, speed);
        let half = speed.all(0.5);
        ((self.slowing[0] + self.slowing[1] * max) * dt).less(half)
            & ((self.braking[0] + self.braking[1] * turning) * dt).less(half)
    }

    /// Returns the bound of the body rate, |ω| ≤ (J_max·|ω₀| + t·τ)/J_min, for a bound of the speed.
    #[inline(always)]
    fn turn_rate(&self, time: f64, rate: R, speed: R) -> R {
        let free = self.growth * rate + self.turning * time;
        match &self.driven {
            // the speed during `time`, accelerations included
            Some(driven) => driven.turn_rate(time, free, speed + self.acceleration * time),
            None => free,
        }
    }
}
