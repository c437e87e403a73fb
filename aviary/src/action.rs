//! What an agent says, and the motor speeds that follow.

use crate::error::OptionError;
use std::f64::consts::{FRAC_PI_6, PI};

use nalgebra::Vector3;

use crate::control::{
    AnyController, AttitudeControl, Controller as _, ControllerKind, HeadingHold, RateControl, Reference,
};
use crate::drone::DroneParams;
use crate::names::named_enum;
use crate::state::{DroneState, attitude_from_rpy};

named_enum! {
    "action type"
    /// How an agent commands a drone (paper, action table), as so many numbers per drone.
    ///
    /// | | numbers | bounds |
    /// | --- | --- | --- |
    /// | `rpm` | four motor speeds, normalized, see [`MotorScale`] | −1 to 1 |
    /// | `raw_rpm` | four motor speeds, rpm | 0 to `MAX_RPM` |
    /// | `one_d_rpm` | one normalized motor speed for all four | −1 to 1 |
    /// | `vel` | velocity x, y, z in the heading frame (the body frame without its roll and pitch), m/s; yaw rate, rad/s | ± [`max_speed`](crate::drone::DroneParams::max_speed); ± [`yaw_rate`](ActionLimits::yaw_rate) |
    /// | `pid` | a waypoint: position x, y, z in the world frame, m; yaw, rad | [`arena`](ActionLimits::arena); ± π |
    /// | `attitude` | collective thrust, as a normalized motor speed; roll, pitch; yaw rate | −1 to 1, which is ± [`tilt`](ActionLimits::tilt) and ± [`yaw_rate`](ActionLimits::yaw_rate) |
    /// | `ctbr` | collective thrust, as a normalized motor speed; body rates x, y, z | −1 to 1, which is ± [`body_rate`](ActionLimits::body_rate) |
    ///
    /// What is out of bounds is clipped to them.
    ///
    /// ```
    /// use aviary::action::ActionType;
    /// use aviary::env::Env;
    /// use aviary::tasks::Hover;
    ///
    /// // the paper's PID flies to a waypoint, which is all that the agent says
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
        /// A waypoint and yaw, through a controller.
        Pid = "pid",
        /// Thrust, roll, pitch and yaw rate, through the paper's attitude loop.
        Attitude = "attitude",
        /// Collective thrust and body rates, through a rate loop.
        Ctbr = "ctbr",
    }
}

impl ActionType {
    /// Numbers per drone.
    pub fn size(self) -> usize {
        match self {
            Self::OneDRpm => 1,
            _ => 4,
        }
    }

    /// Least and greatest value of every number, for one drone.
    pub fn bounds(self, params: &DroneParams, limits: &ActionLimits) -> Vec<[f64; 2]> {
        let around_zero = |max: f64| [-max, max];
        match self {
            Self::Rpm | Self::OneDRpm | Self::Attitude | Self::Ctbr => vec![[-1.0, 1.0]; self.size()],
            Self::RawRpm => vec![[0.0, params.max_rpm()]; 4],
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

/// How far actions reach that are not motor speeds.
///
/// ```
/// use aviary::action::{ActionLimits, ActionType};
/// use aviary::env::Env;
/// use aviary::tasks::Hover;
///
/// // waypoints in a room of 4 m by 4 m, 2 m high
/// let limits = ActionLimits { arena: [[-2.0, 2.0], [-2.0, 2.0], [0.0, 2.0]], ..ActionLimits::default() };
/// let env = Hover::builder().action_type(ActionType::Pid).action_limits(limits).build()?;
/// assert_eq!(env.action_space().high()[..3], [2.0, 2.0, 2.0]);
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct ActionLimits {
    /// Least and greatest x, y and z of a waypoint, world frame, m; ±10 m sideways and 0 to 10 m up by default.
    pub arena: [[f64; 2]; 3],
    /// Roll and pitch at 1, rad; 30° by default.
    pub tilt: f64,
    /// Yaw rate at its bound, rad/s; π by default.
    pub yaw_rate: f64,
    /// Body rates at 1, body frame, rad/s; 10, 10 and 5 by default.
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
    /// Checks that they are numbers, the right way round, and attitudes that can be held.
    ///
    /// # Errors
    /// [`OptionError`] naming the field.
    pub fn validate(&self) -> Result<(), OptionError> {
        let error = |option, got, expected| Err(OptionError { option, got: crate::number(got), expected });
        for [low, high] in self.arena {
            if !(low.is_finite() && high.is_finite() && low <= high) {
                return error("action_limits.arena", high - low, "finite bounds, the lower before the upper");
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

/// Turns one drone's actions into motor speeds. Its controllers live as long as an episode: they remember from step to
/// step, and a reset clears them.
///
/// It is made from the nominal airframe, whatever is flown: an agent that trims for the true mass would have nothing
/// to learn from a randomized one.
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
/// // thrust as at hover, and no body rates, of a drone that has none
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

/// What stands between an action and the motors.
#[derive(Debug, Clone, serde::Serialize, serde::Deserialize)]
enum Loops {
    None,
    Velocity { controller: AnyController, heading: HeadingHold },
    Waypoint { controller: AnyController },
    Attitude { control: AttitudeControl, heading: HeadingHold, thrust_coefficient: f64 },
    Rates { control: RateControl, thrust_coefficient: f64 },
}

impl ActionDecoder {
    /// For actions of a kind, with this controller beneath velocities and waypoints.
    ///
    /// # Errors
    /// [`OptionError`].
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

    /// Returns true if another decoder turns the same actions into the same commands from the same memory: action type, controller,
    /// limits and airframe are equal.
    pub(crate) fn is_like(&self, other: &Self) -> bool {
        let controller = |decoder: &Self| match &decoder.loops {
            Loops::Velocity { controller, .. } | Loops::Waypoint { controller } => {
                Some(std::mem::discriminant(controller))
            }
            _ => None,
        };
        (self.kind, self.limits, controller(self)) == (other.kind, other.limits, controller(other))
            && self.scale == other.scale
    }

    /// The scale of normalized motor speeds.
    pub fn scale(&self) -> &MotorScale {
        &self.scale
    }

    /// Whether it remembers anything from step to step, or looks at the state.
    pub fn has_memory(&self) -> bool {
        !matches!(self.loops, Loops::None)
    }

    /// Forgets everything that an earlier episode left.
    pub fn reset(&mut self) {
        match &mut self.loops {
            Loops::None | Loops::Rates { .. } => {}
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

    /// Motor speeds (rpm) for the coming control step of `dt` seconds, from an action within its bounds.
    ///
    /// # Panics
    /// If the action does not have [`size`](ActionType::size) numbers.
    pub fn motor_speeds(&mut self, dt: f64, state: &DroneState, action: &[f64]) -> [f64; 4] {
        let [a, b, c, d] = match (self.kind, action) {
            (ActionType::OneDRpm, &[x]) => return [self.scale.rpm(x); 4],
            (kind, &[a, b, c, d]) if kind.size() == 4 => [a, b, c, d],
            (kind, _) => panic!("an action of {} numbers, expected {}", action.len(), kind.size()),
        };
        let (scale, limits) = (self.scale, &self.limits);
        let collective = |command: f64, thrust_coefficient: f64| 4.0 * thrust_coefficient * scale.rpm(command).powi(2);
        match &mut self.loops {
            Loops::None if self.kind == ActionType::RawRpm => [a, b, c, d],
            Loops::None => [a, b, c, d].map(|command| scale.rpm(command)),
            Loops::Velocity { controller, heading } => {
                let (sin, cos) = state.yaw().sin_cos();
                let velocity = Vector3::new(cos * a - sin * b, sin * a + cos * b, c);
                let yaw = heading.advance(dt, state, d);
                // the heading frame turns, and the velocity with it
                let acceleration = Vector3::new(-d * velocity.y, d * velocity.x, 0.0);
                let reference = Reference { velocity, acceleration, yaw, yaw_rate: d, ..Reference::default() };
                controller.control_velocity(dt, state, &reference).rpm
            }
            Loops::Waypoint { controller } => {
                controller.control(dt, state, &Reference::hover(Vector3::new(a, b, c), d)).rpm
            }
            Loops::Attitude { control, heading, thrust_coefficient } => {
                let rate = d * limits.yaw_rate;
                let rpy = Vector3::new(b * limits.tilt, c * limits.tilt, heading.advance(dt, state, rate));
                let wanted = attitude_from_rpy(rpy);
                // yaw turns about world z, whatever the roll and pitch
                let body_rate = wanted.inverse_transform_vector(&Vector3::new(0.0, 0.0, rate));
                control.control(dt, state, collective(a, *thrust_coefficient), &wanted, &body_rate)
            }
            Loops::Rates { control, thrust_coefficient } => {
                let body_rate = Vector3::new(b, c, d).component_mul(&Vector3::from(limits.body_rate));
                control.control(dt, state, collective(a, *thrust_coefficient), &body_rate)
            }
        }
    }
}

/// The mapping between normalized commands and motor speeds:
/// `a ≤ 0: (a + 1)·HOVER_RPM`, otherwise `HOVER_RPM + a·(MAX_RPM − HOVER_RPM)`.
///
/// −1 is standing still, 0 is hovering, 1 is full speed. It keeps the constants of the nominal airframe even where
/// the flown one is randomized: otherwise 0 would be the perfect trim and there would be nothing to learn.
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
    /// Of an airframe.
    pub fn new(params: &DroneParams) -> Self {
        Self { hover_rpm: params.hover_rpm(), max_rpm: params.max_rpm() }
    }

    /// Motor speed (rpm) of a normalized command, which is clipped to [−1, 1].
    #[inline]
    pub fn rpm(&self, command: f64) -> f64 {
        let command = command.clamp(-1.0, 1.0);
        // both are computed: nobody could guess which one of them an agent will want
        let (below, above) =
            ((command + 1.0) * self.hover_rpm, self.hover_rpm + command * (self.max_rpm - self.hover_rpm));
        if command <= 0.0 { below } else { above }
    }

    /// The normalized command of a motor speed (rpm), which is clipped to what the motor can do.
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
    fn the_ends_and_the_middle_are_still_hover_and_full_speed() {
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
    fn a_drone_that_can_only_just_hover_has_a_scale_too() {
        let params = DroneParams { thrust_to_weight: 1.0, ..DroneModel::Cf2x.params() };
        let scale = MotorScale::new(&params);
        assert_eq!(scale.rpm(1.0), params.hover_rpm());
        assert_eq!(scale.command(params.max_rpm()), 0.0);
    }

    proptest! {
        #[test]
        fn commands_and_speeds_are_inverse(command in -1.0..1.0) {
            let scale = MotorScale::new(&DroneModel::Race.params());
            prop_assert!((scale.command(scale.rpm(command)) - command).abs() < 1e-12);
        }
    }
}
