use aviary::control::{AnyController, Controller as _, ControllerKind};
use aviary::drone::DroneParams;
use aviary::env::DroneEnv;
use aviary::rollout::{ControllerPolicy, Policy, RolloutError};
use aviary::state::DroneState;
use nalgebra::Vector3;

/// Built-in controller of one drone that receives the measured state, which the observation contains, instead of the
/// true one. It follows the plan or the reference of the task.
pub(super) struct MeasuredController {
    controller: AnyController,
    /// Plans and references of the task.
    guide: ControllerPolicy,
}

impl MeasuredController {
    pub(super) fn new(kind: ControllerKind, params: &DroneParams) -> Self {
        Self { controller: kind.build(params), guide: ControllerPolicy::with_controllers([kind.build(params)]) }
    }
}

impl Policy for MeasuredController {
    fn reset(&mut self, env: &dyn DroneEnv) -> Result<(), RolloutError> {
        self.controller.reset();
        self.guide.reset(env)
    }

    fn act(&mut self, env: &dyn DroneEnv, action: &mut [f64]) -> Result<(), RolloutError> {
        let seen = &env.observation().vector;
        // entries 0 to 11 of every task are the state vector
        let part = |first: usize| Vector3::from_column_slice(&seen[first..first + 3]);
        let state =
            DroneState { velocity: part(6), angular_velocity: part(9), ..DroneState::at_rest(part(0), part(3)) };
        let reference = self.guide.reference(env, 0);
        let speeds = self.controller.control(env.simulation().control_period(), &state, &reference).rpm;
        Ok(env.action_of_motor_speeds(&[speeds], action)?)
    }
}
