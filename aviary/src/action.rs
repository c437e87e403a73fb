//! Action types, and the decoder that converts actions into motor speeds.

mod duty;

pub(crate) use duty::DutyScale;

use crate::error::OptionError;
use std::f64::consts::{FRAC_PI_6, PI};

use nalgebra::Vector3;

use crate::control::{
    AnyController, AttitudeControl, ControlMemory, Controller as _, ControllerKind, Goal, HeadingHold,
    LaneController as _, RateControl, Target,
};
use crate::drone::DroneParams;
use crate::math::{Real, Turn, V3, Weighted as _, clamped, finite_zero, sin_cos, wrap_angle};
use crate::names::named_enum;
use crate::state::{DroneState, FlightState};

named_enum! {
    "action type"
    /// Action types of a drone (*MuJoCo-Drones-Gym*, Tayal, action table).
    ///
    /// | type | components per drone | bounds |
    /// | --- | --- | --- |
    /// | `rpm` | four normalized motor speeds, see [`MotorScale`] | −1 to 1 |
    /// | `raw_rpm` | four motor speeds, rpm | 0 to `MAX_RPM` |
    /// | `one_d_rpm` | one normalized motor speed for all four motors | −1 to 1 |
    /// | `vel` | velocity x, y, z in the heading frame, m/s; yaw rate, rad/s | ± `max_speed`; ± `yaw_rate` |
    /// | `pid` | waypoint: position x, y, z in the world frame, m; yaw, rad | `arena`; ± π |
    /// | `attitude` | collective thrust as a normalized motor speed; roll, pitch; yaw rate | −1 to 1 |
    /// | `ctbr` | collective thrust as a normalized motor speed; body rates x, y, z | −1 to 1 |
    /// | `duty` | four duties of the motors (normalized PWM) | 0 to 1 |
    ///
    /// The heading frame is the body frame without roll and pitch. `max_speed` is [`DroneParams::max_speed`];
    /// `yaw_rate` and `arena` are fields of [`ActionLimits`]. The limits also scale the angles and rates of
    /// `attitude` and `ctbr`: an action of 1 is [`tilt`](ActionLimits::tilt), [`yaw_rate`](ActionLimits::yaw_rate) or
    /// [`body_rate`](ActionLimits::body_rate). The environment clips actions to their bounds.
    ///
    /// The action type `duty` needs an airframe with [`MotorParams::speed_per_volt`](crate::drone::MotorParams): the
    /// speed of a motor is [`MotorParams::speed`](crate::drone::MotorParams::speed) of its duty and of the voltage of
    /// the battery at the start of the control step.
    ///
    /// ```
    /// use aviary::action::ActionType;
    /// use aviary::env::Env;
    /// use aviary::tasks::Hover;
    ///
    /// // the agent sets a waypoint, and the paper's PID controller flies to it
    /// let mut env = Hover::builder().action_type(ActionType::Pid).build()?;
    /// env.reset(Some(1))?;
    /// while env.info().end.is_none() {
    ///     env.step(&[0.0, 0.0, 1.0, 0.0])?;
    /// }
    /// assert!(env.info().success);
    /// # Ok::<(), aviary::env::EnvError>(())
    /// ```
    #[derive(Default)]
    #[non_exhaustive]
    pub enum ActionType {
        /// Four normalized motor speeds.
        #[default]
        Rpm = "rpm",
        /// Four motor speeds, rpm.
        RawRpm = "raw_rpm",
        /// One normalized motor speed for all four motors.
        OneDRpm = "one_d_rpm",
        /// Velocity in the heading frame and yaw rate, through a controller.
        Vel = "vel",
        /// Waypoint and yaw, through a controller.
        Pid = "pid",
        /// Collective thrust, roll, pitch and yaw rate, through the paper's attitude loop.
        Attitude = "attitude",
        /// Collective thrust and body rates, through a rate loop.
        Ctbr = "ctbr",
        /// Four duties of the motors, for airframes with a law from duty to speed.
        Duty = "duty",
    }
}

impl ActionType {
    /// Returns the number of components per drone.
    pub fn size(self) -> usize {
        match self {
            Self::OneDRpm => 1,
            _ => 4,
        }
    }

    /// Returns the lower and the upper bound of every component, for one drone.
    pub fn bounds(self, params: &DroneParams, limits: &ActionLimits) -> Vec<[f64; 2]> {
        let around_zero = |max: f64| [-max, max];
        match self {
            Self::Rpm | Self::OneDRpm | Self::Attitude | Self::Ctbr => vec![[-1.0, 1.0]; self.size()],
            Self::RawRpm => vec![[0.0, params.max_rpm()]; 4],
            Self::Duty => vec![[0.0, 1.0]; 4],
            Self::Vel => {
                let speed = around_zero(params.max_speed);
                vec![speed, speed, speed, around_zero(limits.yaw_rate)]
            }
            Self::Pid => {
                let [x, y, z] = limits.arena;
                vec![x, y, z, around_zero(PI)]
            }
        }
    }
}

/// Limits of the actions that are not motor speeds.
///
/// ```
/// use aviary::action::{ActionLimits, ActionType};
/// use aviary::env::Env;
/// use aviary::tasks::Hover;
///
/// // waypoints in a room of 4 m × 4 m × 2 m
/// let limits = ActionLimits { arena: [[-2.0, 2.0], [-2.0, 2.0], [0.0, 2.0]], ..ActionLimits::default() };
/// let env = Hover::builder().action_type(ActionType::Pid).action_limits(limits).build()?;
/// assert_eq!(env.action_space().high()[..3], [2.0, 2.0, 2.0]);
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct ActionLimits {
    /// Lower and upper bound of a waypoint's x, y and z, world frame, m; default ±10 m horizontally and 0 to 10 m
    /// vertically.
    pub arena: [[f64; 2]; 3],
    /// Roll and pitch of an action of 1, rad; default 30°.
    pub tilt: f64,
    /// Largest yaw rate, rad/s; default π.
    pub yaw_rate: f64,
    /// Body rates of an action of 1, body frame, rad/s; default 10, 10 and 5.
    pub body_rate: [f64; 3],
}

impl Default for ActionLimits {
    fn default() -> Self {
        Self {
            arena: [[-10.0, 10.0], [-10.0, 10.0], [0.0, 10.0]],
            tilt: FRAC_PI_6,
            yaw_rate: PI,
            body_rate: [10.0, 10.0, 5.0],
        }
    }
}

impl ActionLimits {
    /// Checks that the bounds are finite and ordered, and that the angle and the rates are positive and below their
    /// maximum.
    ///
    /// # Errors
    /// [`OptionError`] that names the first invalid field.
    pub fn validate(&self) -> Result<(), OptionError> {
        let error = |option, got, expected| Err(OptionError { option, got: crate::number(got), expected });
        for [low, high] in self.arena {
            if !(low.is_finite() && high.is_finite() && low <= high) {
                return error("action_limits.arena", high - low, "finite bounds in ascending order");
            }
        }
        if !(self.tilt > 0.0 && self.tilt < 1.5) {
            return error("action_limits.tilt", self.tilt, "a positive angle below 1.5 rad");
        }
        let rates = self.body_rate.map(|rate| ("action_limits.body_rate", rate));
        for (option, got) in [("action_limits.yaw_rate", self.yaw_rate)].into_iter().chain(rates) {
            if !(got > 0.0 && got <= 1e3) {
                return error(option, got, "a positive rate up to 1000 rad/s");
            }
        }
        Ok(())
    }
}

/// Converts the actions of one drone into motor speeds.
///
/// The controllers of the decoder keep state during an episode; a reset clears it. The decoder uses the nominal
/// parameters of the drone even if the simulated ones are randomized. An agent with the true mass in its trim would
/// have nothing to learn from the randomization.
///
/// ```
/// use aviary::action::{ActionDecoder, ActionLimits, ActionType};
/// use aviary::control::ControllerKind;
/// use aviary::drone::DroneModel;
/// use aviary::state::DroneState;
///
/// let params = DroneModel::Cf2x.params();
/// let limits = ActionLimits::default();
/// let mut decoder = ActionDecoder::new(ActionType::Ctbr, ControllerKind::Pid, &params, &limits)?;
/// // the action of zeros is hover thrust and body rates of zero
/// let rpm = decoder.motor_speeds(1.0 / 48.0, &DroneState::default(), &[0.0; 4]);
/// assert!(rpm.iter().all(|n| (n - params.hover_rpm()).abs() < 1e-6));
/// # Ok::<(), aviary::OptionError>(())
/// ```
#[derive(Debug, Clone, serde::Serialize, serde::Deserialize)]
pub struct ActionDecoder {
    kind: ActionType,
    limits: ActionLimits,
    scale: MotorScale,
    loops: Loops,
}

/// Control loops between an action and the motors.
#[derive(Debug, Clone, serde::Serialize, serde::Deserialize)]
enum Loops {
    None,
    Duty(DutyScale),
    Velocity { controller: AnyController, heading: HeadingHold },
    Waypoint { controller: AnyController },
    Attitude { control: AttitudeControl, heading: HeadingHold, thrust_coefficient: f64 },
    Rates { control: RateControl, thrust_coefficient: f64 },
}

impl ActionDecoder {
    /// Creates the decoder of an action type. `controller` follows velocities and waypoints.
    ///
    /// # Errors
    /// [`OptionError`] that names the first invalid limit, or the action type if the airframe has no law from duty to
    /// speed.
    pub fn new(
        kind: ActionType,
        controller: ControllerKind,
        params: &DroneParams,
        limits: &ActionLimits,
    ) -> Result<Self, OptionError> {
        limits.validate()?;
        let thrust_coefficient = params.thrust_coefficient;
        let loops = match kind {
            ActionType::Rpm | ActionType::RawRpm | ActionType::OneDRpm => Loops::None,
            ActionType::Duty => Loops::Duty(DutyScale::new(params)?),
            ActionType::Vel => {
                Loops::Velocity { controller: controller.build(params), heading: HeadingHold::default() }
            }
            ActionType::Pid => Loops::Waypoint { controller: controller.build(params) },
            ActionType::Attitude => Loops::Attitude {
                control: AttitudeControl::new(params),
                heading: HeadingHold::default(),
                thrust_coefficient,
            },
            ActionType::Ctbr => Loops::Rates { control: RateControl::new(params), thrust_coefficient },
        };
        Ok(Self { kind, limits: *limits, scale: MotorScale::new(params), loops })
    }

    /// Returns true if both decoders convert equal actions into equal commands for equal airframes, given equal
    /// controller states: action type, controller and limits are equal.
    pub(crate) fn is_like(&self, other: &Self) -> bool {
        let controller = |decoder: &Self| match &decoder.loops {
            Loops::Velocity { controller, .. } | Loops::Waypoint { controller } => {
                Some(std::mem::discriminant(controller))
            }
            _ => None,
        };
        (self.kind, self.limits, controller(self)) == (other.kind, other.limits, controller(other))
    }

    /// Returns the scale of normalized motor speeds.
    pub fn scale(&self) -> &MotorScale {
        &self.scale
    }

    /// Returns true if the decoder has control loops, which depend on the drone's state and on earlier actions.
    pub fn has_memory(&self) -> bool {
        !matches!(self.loops, Loops::None | Loops::Duty(_))
    }

    /// Clears the state of the controllers.
    pub fn reset(&mut self) {
        match &mut self.loops {
            Loops::None | Loops::Duty(_) | Loops::Rates { .. } => {}
            Loops::Velocity { controller, heading } => {
                controller.reset();
                heading.reset();
            }
            Loops::Waypoint { controller } => controller.reset(),
            Loops::Attitude { control, heading, .. } => {
                control.reset();
                heading.reset();
            }
        }
    }

    /// Returns the conversion of the action type `duty`.
    pub(crate) fn duty_scale(&self) -> Option<&DutyScale> {
        if let Loops::Duty(scale) = &self.loops { Some(scale) } else { None }
    }

    /// Returns the motor speeds (rpm) for the next control step of `dt` seconds, from an action within its bounds. The
    /// speeds of duties are those at the voltage of the charged battery, see
    /// [`motor_speeds_at`](Self::motor_speeds_at).
    ///
    /// # Panics
    /// If the length of the action is not [`size`](ActionType::size).
    pub fn motor_speeds(&mut self, dt: f64, state: &DroneState, action: &[f64]) -> [f64; 4] {
        let voltage = self.duty_scale().map_or(0.0, DutyScale::voltage);
        self.motor_speeds_at(voltage, dt, state, action)
    }

    /// Returns the motor speeds of [`motor_speeds`](Self::motor_speeds) at a voltage of the battery (V), on which those
    /// of duties depend.
    ///
    /// # Panics
    /// If the length of the action is not [`size`](ActionType::size).
    pub fn motor_speeds_at(&mut self, voltage: f64, dt: f64, state: &DroneState, action: &[f64]) -> [f64; 4] {
        let numbers = match (self.kind, action) {
            (ActionType::OneDRpm, &[x]) => [x; 4],
            (kind, &[a, b, c, d]) if kind.size() == 4 => [a, b, c, d],
            (kind, _) => panic!("an action of length {}, expected {}", action.len(), kind.size()),
        };
        if let Loops::Duty(scale) = &self.loops {
            return numbers.map(|duty| scale.speed(duty, voltage));
        }
        let mut memory = self.memory();
        let speeds = self.speeds(dt, &mut memory, &FlightState::from(state), numbers);
        self.set_memory(&memory);
        speeds
    }

    /// Returns the motor speeds (rpm) of [`motor_speeds`](Self::motor_speeds) from the four numbers of an action within
    /// its bounds (equal numbers for `one_d_rpm`), and updates the memory of the control loops. The memory of the
    /// decoder itself stays the same.
    ///
    /// The function is generic over the type of the numbers: a double, SIMD lanes, or a number of a program that is
    /// being built for another device.
    ///
    /// ```
    /// use aviary::action::{ActionDecoder, ActionLimits, ActionType};
    /// use aviary::control::{ControlMemory, ControllerKind};
    /// use aviary::drone::DroneModel;
    /// use aviary::state::{DroneState, FlightState};
    ///
    /// let (params, limits) = (DroneModel::Cf2x.params(), ActionLimits::default());
    /// let mut decoder = ActionDecoder::new(ActionType::Vel, ControllerKind::Dsl, &params, &limits)?;
    /// let (mut memory, state) = (ControlMemory::default(), DroneState::default());
    /// let speeds = decoder.speeds(0.02, &mut memory, &FlightState::from(&state), [0.1, 0.2, 0.0, 1.0]);
    /// assert_eq!(speeds, decoder.motor_speeds(0.02, &state, &[0.1, 0.2, 0.0, 1.0]));
    /// # Ok::<(), aviary::OptionError>(())
    /// ```
    #[inline(always)]
    pub fn speeds<R: Real>(
        &self,
        dt: f64,
        memory: &mut ControlMemory<R>,
        state: &FlightState<R>,
        [a, b, c, d]: [R; 4],
    ) -> [R; 4] {
        let (limits, scale) = (&self.limits, &self.scale);
        let (controller, target, goal) = match &self.loops {
            Loops::None if self.kind == ActionType::RawRpm => return [a, b, c, d],
            Loops::None => return [scale.speed(a), scale.speed(b), scale.speed(c), scale.speed(d)],
            Loops::Duty(scale) => {
                let volts = a.all(scale.voltage());
                return [scale.speed(a, volts), scale.speed(b, volts), scale.speed(c, volts), scale.speed(d, volts)];
            }
            Loops::Attitude { control, thrust_coefficient, .. } => {
                let rate = d * limits.yaw_rate;
                let yaw = HeadingHold::turn(&mut memory.heading, dt, state.attitude.yaw(), rate);
                let wanted = Turn::from_rpy(V3::new(b * limits.tilt, c * limits.tilt, yaw));
                // the yaw rate is about world z for any roll and pitch
                let body_rate = wanted.back(V3::vertical(rate));
                let thrust = scale.collective(a, *thrust_coefficient);
                return control.track(dt, &mut memory.attitude_integral, state, thrust, &wanted, body_rate);
            }
            Loops::Rates { control, thrust_coefficient } => {
                let body_rate = V3::new(b, c, d).weighted(&Vector3::from(limits.body_rate));
                return control.track(dt, state.rate, scale.collective(a, *thrust_coefficient), body_rate);
            }
            Loops::Velocity { controller, .. } => {
                let actual = state.attitude.yaw();
                let (sin, cos) = sin_cos(actual);
                let velocity = V3::new(cos * a - sin * b, sin * a + cos * b, c);
                let mut target = Target::hover(state.position, actual);
                target.velocity = velocity;
                // the velocity rotates with the heading frame
                target.acceleration = V3::new(-d * velocity.y, d * velocity.x, d.all(0.0));
                target.yaw = HeadingHold::turn(&mut memory.heading, dt, actual, d);
                target.yaw_rate = d;
                (controller, target, Goal::Velocity)
            }
            Loops::Waypoint { controller } => {
                (controller, Target::hover(V3::new(a, b, c), wrap_angle(d)), Goal::Position)
            }
        };
        // controllers need finite numbers: a NaN in an integral would stay there until the next reset
        let zero = state.finite_zero() + finite_zero([a, b, c, d]);
        let mut next = *memory;
        let mut speeds = controller.track(dt, &mut next, state, &target, goal);
        memory.replace_where(zero.less(zero.all(1.0)), &next);
        for speed in &mut speeds {
            *speed = *speed + zero;
        }
        speeds
    }

    /// Returns the memory of the control loops; the parts that no loop uses have their default values.
    pub(crate) fn memory(&self) -> ControlMemory<f64> {
        match &self.loops {
            Loops::None | Loops::Duty(_) | Loops::Rates { .. } => ControlMemory::default(),
            Loops::Velocity { controller, heading } => {
                ControlMemory { heading: heading.setpoint(), ..controller.memory() }
            }
            Loops::Waypoint { controller } => controller.memory(),
            Loops::Attitude { control, heading, .. } => ControlMemory {
                heading: heading.setpoint(),
                attitude_integral: control.integral(),
                ..ControlMemory::default()
            },
        }
    }

    /// Sets the memory of the control loops.
    pub(crate) fn set_memory(&mut self, memory: &ControlMemory<f64>) {
        match &mut self.loops {
            Loops::None | Loops::Duty(_) | Loops::Rates { .. } => {}
            Loops::Velocity { controller, heading } => {
                controller.set_memory(memory);
                heading.set_setpoint(memory.heading);
            }
            Loops::Waypoint { controller } => controller.set_memory(memory),
            Loops::Attitude { control, heading, .. } => {
                control.set_integral(memory.attitude_integral);
                heading.set_setpoint(memory.heading);
            }
        }
    }

    /// Returns true if the motor speeds depend on earlier actions of the episode.
    pub fn keeps_memory(&self) -> bool {
        !matches!(self.loops, Loops::None | Loops::Duty(_) | Loops::Rates { .. })
    }
}

/// Scale between normalized commands and motor speeds:
/// `a ≤ 0: (a + 1)·HOVER_RPM`, otherwise `HOVER_RPM + a·(MAX_RPM − HOVER_RPM)`.
///
/// −1 is zero speed, 0 is hover speed and 1 is full speed. The scale keeps the constants of the nominal drone even if
/// the simulated one is randomized. Otherwise 0 would always be the exact trim, and an agent would have nothing to
/// learn.
///
/// ```
/// use aviary::action::MotorScale;
/// use aviary::drone::DroneModel;
///
/// let params = DroneModel::Cf2x.params();
/// let scale = MotorScale::new(&params);
/// assert_eq!([-1.0, 0.0].map(|command| scale.rpm(command)), [0.0, params.hover_rpm()]);
/// assert!((scale.rpm(1.0) - params.max_rpm()).abs() < 1e-9);
/// assert!((scale.command(scale.rpm(0.3)) - 0.3).abs() < 1e-12);
/// ```
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct MotorScale {
    hover_rpm: f64,
    max_rpm: f64,
}

impl MotorScale {
    /// Creates the scale of a drone.
    pub fn new(params: &DroneParams) -> Self {
        Self { hover_rpm: params.hover_rpm(), max_rpm: params.max_rpm() }
    }

    /// Returns the motor speed (rpm) of a normalized command, which the function clamps to [−1, 1].
    #[inline]
    pub fn rpm(&self, command: f64) -> f64 {
        self.speed(command)
    }

    /// Returns the motor speed of [`rpm`](Self::rpm).
    #[inline(always)]
    pub(crate) fn speed<R: Real>(&self, command: R) -> R {
        let zero = command.all(0.0);
        let command = clamped(command, zero.all(-1.0), zero.all(1.0));
        // computes both branches, because a branch on the command would be unpredictable
        let below = (command + 1.0) * self.hover_rpm;
        let above = command * (self.max_rpm - self.hover_rpm) + self.hover_rpm;
        R::choose(zero.less(command), above, below)
    }

    /// Returns the collective thrust (N) of a normalized speed of all four motors.
    #[inline(always)]
    fn collective<R: Real>(&self, command: R, thrust_coefficient: f64) -> R {
        let speed = self.speed(command);
        speed * speed * (4.0 * thrust_coefficient)
    }

    /// Returns the normalized command of a motor speed (rpm), which the function clamps to 0 to the maximum speed.
    #[inline]
    pub fn command(&self, rpm: f64) -> f64 {
        let rpm = rpm.clamp(0.0, self.max_rpm);
        if rpm <= self.hover_rpm {
            rpm / self.hover_rpm - 1.0
        } else {
            (rpm - self.hover_rpm) / (self.max_rpm - self.hover_rpm)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::drone::DroneModel;
    use proptest::prelude::*;

    #[test]
    fn minus_one_zero_and_one_are_zero_hover_and_full_speed() {
        for model in DroneModel::ALL {
            let params = model.params();
            let scale = MotorScale::new(&params);
            assert_eq!([-1.0, 0.0, -9.0].map(|a| scale.rpm(a)), [0.0, params.hover_rpm(), 0.0]);
            assert!(
                (scale.rpm(1.0) - params.max_rpm()).abs() < 1e-9 && (scale.rpm(7.0) - params.max_rpm()).abs() < 1e-9
            );
            assert!((scale.rpm(-0.5) - 0.5 * params.hover_rpm()).abs() < 1e-9);
        }
    }

    #[test]
    fn the_scale_is_defined_for_a_thrust_to_weight_ratio_of_one() {
        let params = DroneParams { thrust_to_weight: 1.0, ..DroneModel::Cf2x.params() };
        let scale = MotorScale::new(&params);
        assert_eq!(scale.rpm(1.0), params.hover_rpm());
        assert_eq!(scale.command(params.max_rpm()), 0.0);
    }

    proptest! {
        #[test]
        fn rpm_and_command_are_inverse(command in -1.0..1.0) {
            let scale = MotorScale::new(&DroneModel::Race.params());
            prop_assert!((scale.command(scale.rpm(command)) - command).abs() < 1e-12);
        }
    }
}
