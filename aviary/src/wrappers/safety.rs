use nalgebra::Vector3;

use super::Wrapper;
use crate::action::ActionType;
use crate::control::CollisionCone;
use crate::env::{BoxSpace, DroneEnv, EnvError, EnvSnapshot, Step};
use crate::observation::Observation;
use crate::state::DroneState;

/// Keeps drones apart whatever the agent commands: a [`CollisionCone`] on the commanded velocities.
///
/// A velocity command v\* stands for the acceleration `response`·(v\* − v) that the controller beneath will give. Those are
/// filtered, and what comes out goes on as velocities. Commands that are safe pass unchanged, but for a yaw rate beyond
/// [`MAX_YAW_RATE`](Self::MAX_YAW_RATE): a drone that spins gives accelerations late and askew.
///
/// The filter keeps its radius as far as the controller beneath gives what is asked of it: leave a margin (an eighth is
/// enough for the geometric controller), and say how fast that controller is with [`response`](Self::response).
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
    guard: VelocityFilter,
    action: Vec<f64>,
    /// Control steps of this episode in which it had to change something.
    interventions: u64,
    /// True if it has been reset: before that there is no state to filter for.
    started: bool,
}

impl<E> SafetyWrapper<E> {
    /// Largest yaw rate that is passed on, rad/s.
    pub const MAX_YAW_RATE: f64 = 1.0;
}

impl<E: DroneEnv> SafetyWrapper<E> {
    /// Around an environment whose actions are velocities ([`ActionType::Vel`]). It must be reset before its first step, also
    /// where the environment has been.
    ///
    /// # Errors
    /// [`EnvError::Option`] for other actions, [`EnvError::Safety`] for a filter that cannot be.
    pub fn new(env: E, filter: CollisionCone) -> Result<Self, EnvError> {
        let guard = VelocityFilter::new(filter, 10.0, env.action_type(), env.simulation().num_drones())?;
        let action = vec![0.0; env.action_space().size()];
        Ok(Self { env, guard, action, interventions: 0, started: false })
    }

    /// How fast the controller beneath takes up a velocity, 1/s: 10 (the default) for the geometric controller, 5 for the
    /// DSL-PID, 0.9 for the paper's PID.
    ///
    /// # Errors
    /// [`EnvError::Option`] for what is not a positive number.
    pub fn response(mut self, response: f64) -> Result<Self, EnvError> {
        self.guard = self.guard.response(response)?;
        Ok(self)
    }

    /// The environment within.
    pub fn inner(&self) -> &E {
        &self.env
    }

    /// Control steps of this episode in which it had to change something.
    pub fn interventions(&self) -> u64 {
        self.interventions
    }
}

/// The filter of one environment's velocities.
#[derive(Debug, Clone)]
pub(crate) struct VelocityFilter {
    filter: CollisionCone,
    response: f64,
    positions: Vec<Vector3<f64>>,
    velocities: Vec<Vector3<f64>>,
    accelerations: Vec<Vector3<f64>>,
}

impl VelocityFilter {
    /// For actions of this type, which must be velocities, and so many drones.
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
                expected: "vel under a safety filter",
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

    /// Makes an action safe for drones in these states; whether it had to change it.
    pub(crate) fn make_safe(
        &mut self,
        states: &[DroneState],
        bounds: &BoxSpace,
        action: &mut [f64],
    ) -> Result<bool, EnvError> {
        for ((x, low), high) in action.iter_mut().zip(bounds.low()).zip(bounds.high()) {
            *x = x.clamp(*low, *high);
        }
        const MOST: f64 = SafetyWrapper::<()>::MAX_YAW_RATE;
        for command in action.chunks_exact_mut(4) {
            command[3] = command[3].clamp(-MOST, MOST);
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
        // what is wrong with an action the environment itself says best
        let sound = action.len() == this.action.len() && action.iter().all(|x| x.is_finite());
        if !sound || this.env.info().end.is_some() {
            return this.env.step(action);
        }
        this.action.copy_from_slice(action);
        let (states, bounds) = (this.env.simulation().states(), this.env.action_space());
        if this.guard.make_safe(states, bounds, &mut this.action)? {
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
    fn nothing_is_filtered_before_the_first_reset() {
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
