use super::FreeBody;
use super::body::FlightState;
use crate::math::{Real, V3};
use crate::state::DroneState;

/// How far a drone can come within a time, whatever its motors do; of one drone or of many.
///
/// A drone is a ball about its middle that grows by what it can travel. Every bound is on the safe side.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ReachBound<R = f64> {
    /// How far the drone reaches from its middle, m.
    reach: R,
    /// Greatest acceleration of thrust, gravity and wakes, m/s²; infinite where there is none that is sure.
    acceleration: R,
    /// What drag may change of a velocity, 1/s and 1/m.
    slowing: [R; 2],
    /// What the medium may change of a body rate, 1/s and 1.
    braking: [R; 2],
    /// Greatest moment of inertia over the least one: as much may a body rate grow by itself.
    growth: R,
    /// Greatest angular acceleration of the rotors, rad/s².
    turning: R,
}

/// Room that a bound leaves for rounding, m.
const SLACK: f64 = 1e-9;

impl ReachBound {
    /// Of a drone that reaches so far (m), of that body, whose rotors and surroundings give at most this acceleration (m/s²,
    /// beside gravity) and torque (N·m), and whose blades drag at most so much (1/s).
    pub fn new(body: &FreeBody, reach: f64, acceleration: f64, torque: f64, slowing: f64) -> Self {
        let [x, y, z] = body.inverse_inertia;
        let (max, min) = (x.max(y).max(z), x.min(y).min(z));
        let ([linear, quadratic], braking) = body.fluid.max_coefficients();
        Self {
            reach: reach + SLACK,
            acceleration: acceleration + body.gravity.abs(),
            slowing: [slowing + linear, quadratic],
            braking,
            growth: max / min,
            turning: torque * max,
        }
    }

    /// The same of a drone that reaches so far, m.
    #[must_use]
    pub fn reaching(self, reach: f64) -> Self {
        Self { reach: reach + SLACK, ..self }
    }

    /// How far the drone reaches from its middle, m.
    pub fn reach(&self) -> f64 {
        self.reach
    }

    /// The ball that a drone does not leave in so many physics steps of `dt` seconds, about its present position: its
    /// radius, m; NaN or infinite where there is none, or where the drone may turn too fast for the kernel.
    pub fn radius(&self, dt: f64, steps: u32, state: &DroneState) -> f64 {
        self.ball(dt, steps, &FlightState::from(state))
    }

    /// How far a drone comes in one physics step of `dt` seconds under a known force (N, with its weight) and torque (N·m) at
    /// most, and by what angle it turns, rad.
    pub(crate) fn one_step(&self, dt: f64, body: &FreeBody, force: f64, torque: f64, state: &DroneState) -> (f64, f64) {
        let known = Self {
            acceleration: force * body.inverse_mass,
            turning: torque * body.inverse_inertia.into_iter().fold(0.0, f64::max),
            ..*self
        };
        let (speed, rate) = (V3::from(&state.velocity).norm(), V3::from(&state.angular_velocity).norm());
        let turn = known.turn_rate(dt, rate) * dt;
        (known.travel(dt, speed) + SLACK, if known.is_tame(dt, dt, speed, rate) { turn } else { f64::INFINITY })
    }

    pub(super) fn numbers(&self) -> [f64; 8] {
        let ([linear, quadratic], [viscous, drag]) = (self.slowing, self.braking);
        [self.reach, self.acceleration, linear, quadratic, viscous, drag, self.growth, self.turning]
    }
}

#[allow(private_bounds)] // for one number or for many
impl<R: Real> ReachBound<R> {
    #[inline(always)]
    pub(super) fn of([reach, acceleration, linear, quadratic, viscous, drag, growth, turning]: [R; 8]) -> Self {
        Self { reach, acceleration, slowing: [linear, quadratic], braking: [viscous, drag], growth, turning }
    }

    /// [`radius`](ReachBound::radius) of one or of many.
    #[inline(always)]
    pub(super) fn ball(&self, dt: f64, steps: u32, motion: &FlightState<R>) -> R {
        /// Beyond that the numbers themselves are to be looked at: m and m/s.
        const FAR: f64 = 1e6;
        let time = dt * f64::from(steps);
        let (speed, rate) = (motion.velocity.norm(), motion.rate.norm());
        let slow_enough = (self.turn_rate(time, rate) * dt).less(rate.all(FreeBody::MAX_TURN));
        let V3 { x, y, z } = motion.position;
        let far = x.all(FAR);
        let tame = self.is_tame(dt, time, speed, rate);
        let sane = x.abs().less(far) & y.abs().less(far) & z.abs().less(far) & speed.less(far);
        R::choose(sane & slow_enough & tame, self.reach + self.travel(time, speed), rate.all(f64::INFINITY))
    }

    /// |v|·t·(1 + t·slowing) + a·t²: twice what a constant acceleration comes to, for those that are held through a step.
    #[inline(always)]
    fn travel(&self, time: f64, speed: R) -> R {
        let slowing = self.slowing[0] + self.slowing[1] * speed;
        (speed * (slowing * time + 1.0) + self.acceleration * time) * time
    }

    /// Whether drag takes less than half of a speed or a body rate in a physics step of `dt` seconds, for a time: beyond that a step can
    /// overshoot, and no bound here holds.
    #[inline(always)]
    fn is_tame(&self, dt: f64, time: f64, speed: R, rate: R) -> R::Mask {
        let (max, turning) = (speed + self.acceleration * time, self.turn_rate(time, rate));
        let half = speed.all(0.5);
        ((self.slowing[0] + self.slowing[1] * max) * dt).less(half)
            & ((self.braking[0] + self.braking[1] * turning) * dt).less(half)
    }

    /// |ω| ≤ (J_max·|ω₀| + t·τ)/J_min.
    #[inline(always)]
    fn turn_rate(&self, time: f64, rate: R) -> R {
        self.growth * rate + self.turning * time
    }
}
