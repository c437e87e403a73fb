use std::f64::consts::PI;

use nalgebra::Vector3;

use super::memory::is_set;
use super::{
    AttitudeGains, ControlMemory, ControlOutput, Controller, Goal, LaneController, PidControl, PidGains, PositionGains,
    Reference, Target, run,
};
use crate::drone::DroneParams;
use crate::math::{Real, ToFlight as _, ToNalgebra as _, V3, clamped, wrap_angle};
use crate::state::{DroneState, FlightState};

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

    /// Returns the gains of this controller.
    pub fn current_gains(&self) -> PidGains {
        self.cascade.gains()
    }

    /// Replaces the gains. The integrals and the setpoint stay the same.
    pub fn set_gains(&mut self, gains: PidGains) {
        self.cascade.set_gains(gains);
    }

    /// Returns the default gains for an airframe. Torque gains scale with the inertia as in [`PidGains::paper`].
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

    /// Moves the setpoint towards a target.
    #[inline(always)]
    fn advance<R: Real>(dt: f64, memory: &mut ControlMemory<R>, state: &FlightState<R>, target: &Target<R>) {
        let (one, is_held) = (target.yaw.all(1.0), is_set(memory.setpoint_yaw));
        let last = V3::choose(is_held, memory.setpoint, state.position);
        let last_yaw = R::choose(is_held, memory.setpoint_yaw, state.attitude.yaw());
        let path = target.position - last;
        let share = one.all(Self::MAX_SPEED * dt) / path.norm();
        memory.setpoint = V3::choose(share.less(one), last + path * share, target.position);
        let max = one.all(Self::MAX_YAW_RATE * dt);
        memory.setpoint_yaw = wrap_angle(last_yaw + clamped(wrap_angle(target.yaw - last_yaw), -max, max));
    }
}

impl LaneController for DslPidControl {
    fn memory(&self) -> ControlMemory<f64> {
        let memory = self.cascade.memory();
        match &self.setpoint {
            Some(setpoint) => {
                ControlMemory { setpoint: setpoint.position.to_flight(), setpoint_yaw: setpoint.yaw, ..memory }
            }
            None => memory,
        }
    }

    fn set_memory(&mut self, memory: &ControlMemory<f64>) {
        self.cascade.set_memory(memory);
        let setpoint = Setpoint { position: memory.setpoint.to_nalgebra(), yaw: memory.setpoint_yaw };
        self.setpoint = Some(setpoint).filter(|setpoint| !setpoint.yaw.is_nan());
    }

    #[inline(always)]
    fn track<R: Real>(
        &self,
        dt: f64,
        memory: &mut ControlMemory<R>,
        state: &FlightState<R>,
        target: &Target<R>,
        goal: Goal,
    ) -> [R; 4] {
        Self::advance(dt, memory, state, target);
        let max_yaw_rate = target.yaw.all(Self::MAX_YAW_RATE);
        let mut limited = *target;
        if goal == Goal::Position {
            limited.position = memory.setpoint;
            // the velocity command has the same limit as the speed of the setpoint
            let max = target.yaw.all(Self::MAX_SPEED);
            limited.velocity = target.velocity * (max / target.velocity.norm().greater(max));
        } else {
            // the speed limit of the position setpoint would also limit the commanded velocity
            memory.setpoint = state.position;
        }
        limited.yaw = memory.setpoint_yaw;
        limited.yaw_rate = clamped(target.yaw_rate, -max_yaw_rate, max_yaw_rate);
        self.cascade.follow(dt, memory, state, &limited, target.acceleration, Self::INTEGRATED)
    }
}

impl Controller for DslPidControl {
    fn reset(&mut self) {
        self.cascade.reset();
        self.setpoint = None;
    }

    fn control(&mut self, dt: f64, state: &DroneState, reference: &Reference) -> ControlOutput {
        run(self, dt, state, reference, Goal::Position)
    }

    /// Bypasses the position setpoint, whose speed limit would also limit the commanded velocity.
    fn control_velocity(&mut self, dt: f64, state: &DroneState, reference: &Reference) -> ControlOutput {
        run(self, dt, state, reference, Goal::Velocity)
    }

    /// Returns the integrals of the position errors and of the attitude errors, and position and yaw of the setpoint;
    /// the yaw is NaN before the first control step.
    fn internal_state(&self) -> Vec<f64> {
        let memory = self.memory();
        let V3 { x, y, z } = memory.setpoint;
        memory.integrals().into_iter().chain([x, y, z, memory.setpoint_yaw]).collect()
    }

    fn set_internal_state(&mut self, state: &[f64]) -> bool {
        let Ok([a, b, c, d, e, f, x, y, z, setpoint_yaw]) = <[f64; 10]>::try_from(state) else { return false };
        let integrals = ControlMemory::of_integrals([a, b, c, d, e, f]);
        self.set_memory(&ControlMemory { setpoint: V3 { x, y, z }, setpoint_yaw, ..integrals });
        true
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
