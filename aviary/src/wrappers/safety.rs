use nalgebra::Vector3;

use super::Wrapper;
use crate::action::ActionType;
use crate::control::CollisionCone;
use crate::env::{BoxSpace, DroneEnv, EnvError, EnvSnapshot, Step};
use crate::observation::Observation;
use crate::state::DroneState;

/// A wrapper that keeps drones apart: a [`CollisionCone`] filter on the commanded velocities.
///
/// The wrapper converts a velocity command v\* to the acceleration `response`·(v\* − v) that the controller would
/// produce. It filters the accelerations and converts them back to velocity commands. Safe commands pass unchanged,
/// except that the wrapper clamps yaw rates to [`MAX_YAW_RATE`](Self::MAX_YAW_RATE): a spinning drone produces its
/// acceleration late and in the wrong direction.
///
/// The distance between drones stays above the radius of the filter as far as the controller produces the commanded
/// acceleration. Add a margin to the radius (an eighth is enough for the geometric controller), and set the rate of
/// the controller with [`response`](Self::response).
///
/// ```
/// use aviary::action::ActionType;
/// use aviary::control::{CollisionCone, ControllerKind};
/// use aviary::env::{DroneEnv, Env};
/// use aviary::tasks::Antipodal;
/// use aviary::wrappers::SafetyWrapper;
///
/// let env = Antipodal::builder().action_type(ActionType::Vel).controller(ControllerKind::Geometric).build()?;
/// let mut env = SafetyWrapper::new(env, CollisionCone::new(0.4))?;
/// env.reset(Some(1))?;
/// env.step(&[0.5, 0.0, 0.0, 0.0].repeat(12))?;
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug)]
pub struct SafetyWrapper<E> {
    env: E,
    velocity_filter: VelocityFilter,
    action: Vec<f64>,
    /// Number of control steps of this episode in which the filter changed the action.
    interventions: u64,
    /// True after a reset. Before it there are no states to filter with.
    started: bool,
}

impl<E> SafetyWrapper<E> {
    /// Largest yaw rate that the wrapper passes on, rad/s.
    pub const MAX_YAW_RATE: f64 = 1.0;
}

impl<E: DroneEnv> SafetyWrapper<E> {
    /// Creates a wrapper around an environment with velocity actions ([`ActionType::Vel`]). The wrapper must be
    /// reset before its first step, even if the environment has been reset.
    ///
    /// # Errors
    /// [`EnvError::Option`] for other action types, and [`EnvError::Safety`] for invalid options of the filter.
    pub fn new(env: E, filter: CollisionCone) -> Result<Self, EnvError> {
        let velocity_filter = VelocityFilter::new(filter, 10.0, env.action_type(), env.simulation().num_drones())?;
        let action = vec![0.0; env.action_space().size()];
        Ok(Self { env, velocity_filter, action, interventions: 0, started: false })
    }

    /// Sets the rate at which the controller tracks a velocity command, 1/s; default 10, which fits the geometric
    /// controller. 5 fits the DSL-PID and 0.9 the paper's PID.
    ///
    /// # Errors
    /// [`EnvError::Option`] if the rate is not a positive number.
    pub fn response(mut self, response: f64) -> Result<Self, EnvError> {
        self.velocity_filter = self.velocity_filter.response(response)?;
        Ok(self)
    }

    /// Returns the wrapped environment.
    pub fn inner(&self) -> &E {
        &self.env
    }

    /// Returns the number of control steps of this episode in which the filter changed the action.
    pub fn interventions(&self) -> u64 {
        self.interventions
    }
}

/// Filter of the velocity commands of one environment.
#[derive(Debug, Clone)]
pub(crate) struct VelocityFilter {
    filter: CollisionCone,
    response: f64,
    positions: Vec<Vector3<f64>>,
    velocities: Vec<Vector3<f64>>,
    accelerations: Vec<Vector3<f64>>,
}

impl VelocityFilter {
    /// Creates a filter for a number of drones. The action type must be [`ActionType::Vel`].
    pub(crate) fn new(
        filter: CollisionCone,
        response: f64,
        action_type: ActionType,
        drones: usize,
    ) -> Result<Self, EnvError> {
        filter.validate()?;
        if action_type != ActionType::Vel {
            return Err(EnvError::Option {
                option: "action_type",
                got: action_type.to_string(),
                expected: "vel for a safety filter",
            });
        }
        let vectors = || vec![Vector3::zeros(); drones];
        let (positions, velocities, accelerations) = (vectors(), vectors(), vectors());
        Self { filter, response: 1.0, positions, velocities, accelerations }.response(response)
    }

    fn response(self, response: f64) -> Result<Self, EnvError> {
        if !(response > 0.0 && response <= 1e6) {
            return Err(EnvError::Option {
                option: "response",
                got: format!("{} 1/s", crate::number(response)),
                expected: "a positive number",
            });
        }
        Ok(Self { response, ..self })
    }

    /// Makes an action safe for drones in the given states. Returns true if the filter changed the velocities.
    pub(crate) fn make_safe(
        &mut self,
        states: &[DroneState],
        bounds: &BoxSpace,
        action: &mut [f64],
    ) -> Result<bool, EnvError> {
        for ((x, low), high) in action.iter_mut().zip(bounds.low()).zip(bounds.high()) {
            *x = x.clamp(*low, *high);
        }
        const MAX: f64 = SafetyWrapper::<()>::MAX_YAW_RATE;
        for command in action.chunks_exact_mut(4) {
            command[3] = command[3].clamp(-MAX, MAX);
        }
        for (drone, (state, command)) in states.iter().zip(action.chunks_exact(4)).enumerate() {
            let (sin, cos) = state.yaw().sin_cos();
            let (x, y) = (command[0], command[1]);
            let wanted = Vector3::new(cos * x - sin * y, sin * x + cos * y, command[2]);
            self.positions[drone] = state.position;
            self.velocities[drone] = state.velocity;
            self.accelerations[drone] = self.response * (wanted - state.velocity);
        }
        if !self.filter.filter(&self.positions, &self.velocities, &mut self.accelerations)? {
            return Ok(false);
        }
        for (drone, (state, command)) in states.iter().zip(action.chunks_exact_mut(4)).enumerate() {
            let (sin, cos) = state.yaw().sin_cos();
            let velocity = state.velocity + self.accelerations[drone] / self.response;
            command[0] = cos * velocity.x + sin * velocity.y;
            command[1] = cos * velocity.y - sin * velocity.x;
        }
        Ok(true)
    }
}

impl<E: DroneEnv> Wrapper for SafetyWrapper<E> {
    type Inner = E;

    fn inner(this: &Self) -> &E {
        &this.env
    }

    fn inner_mut(this: &mut Self) -> &mut E {
        &mut this.env
    }

    fn snapshot(this: &Self) -> EnvSnapshot {
        EnvSnapshot::serializable((this.interventions, this.started)).with_inner(this.env.snapshot())
    }

    fn restore(this: &mut Self, snapshot: &EnvSnapshot) -> Result<(), EnvError> {
        let own = snapshot.read::<(u64, bool)>()?;
        this.env.restore(snapshot.inner()?)?;
        (this.interventions, this.started) = own;
        Ok(())
    }

    fn reset(this: &mut Self, seed: Option<u64>) -> Result<&Observation, EnvError> {
        (this.interventions, this.started) = (0, false);
        let observation = this.env.reset(seed)?;
        this.started = true;
        Ok(observation)
    }

    fn step<'a>(this: &'a mut Self, action: &[f64]) -> Result<Step<'a>, EnvError> {
        if !this.started {
            return Err(EnvError::NeedsReset { when: "on a new safety filter" });
        }
        // the environment reports an invalid action
        let valid = action.len() == this.action.len() && action.iter().all(|x| x.is_finite());
        if !valid || this.env.info().end.is_some() {
            return this.env.step(action);
        }
        this.action.copy_from_slice(action);
        let (states, bounds) = (this.env.simulation().states(), this.env.action_space());
        if this.velocity_filter.make_safe(states, bounds, &mut this.action)? {
            this.interventions += 1;
        }
        this.env.step(&this.action)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::ControllerKind;
    use crate::env::Env as _;
    use crate::tasks::Antipodal;

    #[test]
    fn a_step_before_the_first_reset_is_an_error() {
        let env = Antipodal::builder().num_drones(2).action_type(ActionType::Vel).controller(ControllerKind::Geometric);
        let mut env = SafetyWrapper::new(env.build().unwrap(), CollisionCone::new(0.4)).unwrap();
        // towards each other
        let action = [-1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0];
        assert!(matches!(env.step(&action), Err(EnvError::NeedsReset { .. })));
        assert_eq!(env.interventions(), 0);
        env.reset(Some(1)).unwrap();
        env.step(&action).unwrap();
    }
}
