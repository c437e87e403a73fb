use std::f64::consts::PI;

use nalgebra::Vector3;

use super::{AttitudeGains, ControlOutput, Controller, PidControl, PidGains, PositionGains, Reference};
use crate::drone::DroneParams;
use crate::state::{DroneState, wrap_angle};

/// The paper's `DSLPIDControl`: the cascade of [`PidControl`] with stiffer gains, integral clamps half as large, a
/// rate-limited setpoint, and feed-forward of the reference acceleration.
///
/// The setpoint starts at the position and yaw of the drone. It moves to the reference at no more than
/// [`MAX_SPEED`](Self::MAX_SPEED) and [`MAX_YAW_RATE`](Self::MAX_YAW_RATE), so that a distant waypoint does not cause
/// a large tilt. It cannot keep up with a reference that moves faster than these limits.
///
/// ```
/// use aviary::control::{Controller, DslPidControl, Reference};
/// use aviary::drone::DroneModel;
/// use aviary::state::DroneState;
/// use nalgebra::Vector3;
///
/// let params = DroneModel::Cf2x.params();
/// let far = Reference::hover(Vector3::new(3.0, 0.0, 0.0), 0.0);
/// let output = DslPidControl::new(&params).control(1.0 / 48.0, &DroneState::default(), &far);
/// // the errors are relative to the reference, the motor speeds follow a setpoint 4 cm away
/// assert_eq!(output.position_error.x, 3.0);
/// assert!(output.rpm.iter().all(|rpm| (rpm / params.hover_rpm() - 1.0).abs() < 0.05));
/// ```
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct DslPidControl {
    cascade: PidControl,
    setpoint: Option<Setpoint>,
}

#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
struct Setpoint {
    #[serde(with = "crate::serial::vector")]
    position: Vector3<f64>,
    yaw: f64,
}

impl DslPidControl {
    /// Maximum speed of the setpoint, m/s.
    pub const MAX_SPEED: f64 = 2.0;

    /// Maximum yaw rate of the setpoint, rad/s.
    pub const MAX_YAW_RATE: f64 = PI;

    /// Largest position error that enters the integral, m. Larger errors are transients, which would wind it up.
    const INTEGRATED: f64 = 0.15;

    /// Creates a controller with [its gains](Self::gains) for an airframe.
    pub fn new(params: &DroneParams) -> Self {
        Self { cascade: PidControl::with_gains(params, Self::gains(params)), setpoint: None }
    }

    /// Returns the gains for an airframe. Torque gains scale with the inertia as in [`PidGains::paper`].
    pub fn gains(params: &DroneParams) -> PidGains {
        PidGains {
            position: PositionGains {
                proportional: Vector3::new(8.0, 8.0, 16.0),
                integral: Vector3::new(2.0, 2.0, 4.0),
                derivative: Vector3::new(5.0, 5.0, 7.5),
                integral_clamp: 1.0,
            },
            attitude: AttitudeGains::of_crazyflie(
                params,
                [4e-3, 4e-3, 1.2e-3],
                [0.0, 0.0, 1e-4],
                [4e-4, 4e-4, 2.5e-4],
                0.25,
            ),
        }
    }

    fn advance(&self, dt: f64, state: &DroneState, reference: &Reference) -> Setpoint {
        let here = Setpoint { position: state.position, yaw: state.yaw() };
        let last = self.setpoint.unwrap_or(here);
        let path = reference.position - last.position;
        let share = (Self::MAX_SPEED * dt / path.norm()).min(1.0);
        let turn = wrap_angle(reference.yaw - last.yaw).clamp(-Self::MAX_YAW_RATE * dt, Self::MAX_YAW_RATE * dt);
        Setpoint {
            position: if share < 1.0 { last.position + path * share } else { reference.position },
            yaw: wrap_angle(last.yaw + turn),
        }
    }
}

impl Controller for DslPidControl {
    fn reset(&mut self) {
        self.cascade.reset();
        self.setpoint = None;
    }

    fn control(&mut self, dt: f64, state: &DroneState, reference: &Reference) -> ControlOutput {
        let errors = ControlOutput::of_errors(state, reference);
        if !(state.is_finite() && reference.is_finite() && dt > 0.0 && dt.is_finite()) {
            return errors;
        }
        let setpoint = self.advance(dt, state, reference);
        self.setpoint = Some(setpoint);
        // the velocity command has the same limit as the speed of the setpoint
        let speed = reference.velocity.norm();
        let limited = Reference {
            position: setpoint.position,
            velocity: reference.velocity * (Self::MAX_SPEED / speed.max(Self::MAX_SPEED)),
            yaw: setpoint.yaw,
            yaw_rate: reference.yaw_rate.clamp(-Self::MAX_YAW_RATE, Self::MAX_YAW_RATE),
            ..*reference
        };
        let feed_forward = &reference.acceleration;
        let output = self.cascade.follow(dt, state, &limited, feed_forward, Self::INTEGRATED);
        ControlOutput { rpm: output.rpm, ..errors }
    }

    /// Bypasses the position setpoint, whose speed limit would also limit the commanded velocity.
    fn control_velocity(&mut self, dt: f64, state: &DroneState, reference: &Reference) -> ControlOutput {
        let here = Reference { position: state.position, ..*reference };
        let errors = ControlOutput::of_errors(state, &here);
        if !(state.is_finite() && reference.is_finite() && dt > 0.0 && dt.is_finite()) {
            return errors;
        }
        let setpoint = Setpoint { position: state.position, ..self.advance(dt, state, &here) };
        self.setpoint = Some(setpoint);
        let yaw_rate = reference.yaw_rate.clamp(-Self::MAX_YAW_RATE, Self::MAX_YAW_RATE);
        let limited = Reference { yaw: setpoint.yaw, yaw_rate, ..here };
        let output = self.cascade.follow(dt, state, &limited, &reference.acceleration, Self::INTEGRATED);
        ControlOutput { rpm: output.rpm, ..errors }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::drone::DroneModel;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn the_setpoint_moves_no_faster_than_its_limits_and_arrives(
            x in -5.0..5.0, y in -5.0..5.0, z in -5.0..5.0, yaw in -10.0..10.0, dt in 0.001..0.1,
        ) {
            let mut control = DslPidControl::new(&DroneModel::Cf2x.params());
            let state = DroneState::default();
            let reference = Reference::hover(Vector3::new(x, y, z), yaw);
            let mut last = Setpoint { position: state.position, yaw: 0.0 };
            for _ in 0..(6.0 / dt) as usize {
                control.control(dt, &state, &reference);
                let setpoint = control.setpoint.unwrap();
                prop_assert!((setpoint.position - last.position).norm() <= DslPidControl::MAX_SPEED * dt + 1e-9);
                prop_assert!(wrap_angle(setpoint.yaw - last.yaw).abs() <= DslPidControl::MAX_YAW_RATE * dt + 1e-9);
                last = setpoint;
            }
            prop_assert_eq!(last.position, reference.position);
            prop_assert!(wrap_angle(last.yaw - yaw).abs() < 1e-9);
        }
    }

    #[test]
    fn integral_clamps_are_half_of_the_papers_pid() {
        let params = DroneModel::Race.params();
        let (dsl, pid) = (DslPidControl::gains(&params), PidGains::paper(&params));
        assert_eq!(2.0 * dsl.position.integral_clamp, pid.position.integral_clamp);
        assert_eq!(2.0 * dsl.attitude.integral_clamp, pid.attitude.integral_clamp);
    }

    #[test]
    fn reference_acceleration_tilts_the_drone_in_the_first_step() {
        let params = DroneModel::Cf2x.params();
        let moving = Reference { acceleration: Vector3::new(0.0, -3.0, 0.0), ..Reference::default() };
        let state = DroneState::default();
        let fed = DslPidControl::new(&params).control(0.02, &state, &moving).rpm;
        assert!(fed[0] > fed[3], "rolls towards −y: {fed:?}");
        let plain = PidControl::new(&params).control(0.02, &state, &moving).rpm;
        assert!((plain[0] - plain[3]).abs() < 1e-9, "the plain PID has no feed-forward");
    }
}
