use std::sync::Arc;

use super::steering::velocity_to;
use super::{Policy, PolicySnapshot, RolloutError};
use crate::action::ActionType;
use crate::control::trajectory::Trajectory;
use crate::control::{Controller, ControllerKind, Reference};
use crate::env::{DroneEnv, EnvError};

/// Flies a task with one controller per drone.
///
/// Each drone follows its given trajectory, or the [plan](DroneEnv::plans) of the task for the episode, or the
/// present [reference](DroneEnv::reference) of the task. The controllers command motor speeds ([`ActionType::Rpm`],
/// [`ActionType::RawRpm`], and [`ActionType::Duty`] at the present voltage). With velocity actions
/// ([`ActionType::Vel`]) the environment runs the controllers; the policy then commands velocities of up to 1 m/s
/// towards the references, with a bias to the right so that drones pass each other.
///
/// ```
/// use aviary::control::trajectory::named;
/// use aviary::control::{Bandwidths, ControllerKind, GeometricControl};
/// use aviary::drone::DroneModel;
/// use aviary::env::{DroneEnv, Env};
/// use aviary::rollout::{ControllerPolicy, fly_episode};
/// use aviary::tasks::{Hover, MultiHover};
///
/// // one built-in controller for every drone of a task
/// let mut env = MultiHover::builder().num_drones(3).build()?;
/// let mut pilot = ControllerPolicy::new(ControllerKind::Pid, &env);
/// assert!(fly_episode(&mut env, &mut pilot, Some(1))?.success);
///
/// // a controller with custom bandwidths, along a trajectory
/// let circle = named("circle").expect("a trajectory");
/// let start = circle.start();
/// let mut env = Hover::builder().initial_positions([start.position.into()]).episode_seconds(4.0).build()?;
/// let integral = Bandwidths { integral: 0.1, ..Bandwidths::default() };
/// let controller = GeometricControl::with_bandwidths(&DroneModel::Cf2x.params(), integral);
/// let mut pilot = ControllerPolicy::with_controllers([controller]).follow([circle]);
/// fly_episode(&mut env, &mut pilot, Some(1))?;
/// let reference = pilot.reference(&env, 0);
/// assert!(env.simulation().distance(0, &reference.position) < 0.02);
/// # Ok::<(), aviary::rollout::RolloutError>(())
/// ```
#[derive(Debug)]
pub struct ControllerPolicy {
    controllers: Vec<Box<dyn Controller>>,
    /// True if drones without a trajectory follow the plans of the task.
    planned: bool,
    /// Given or planned trajectory of each drone, if it has one.
    trajectories: Vec<Option<Followed>>,
    /// Motor speeds of each drone, rpm.
    speeds: Vec<[f64; 4]>,
}

/// Trajectory of a drone.
#[derive(Debug, Clone)]
struct Followed {
    trajectory: Arc<dyn Trajectory>,
    /// Simulated time at the start of the trajectory, s.
    start: f64,
}

/// Internal state in a snapshot.
#[derive(Debug)]
struct State {
    controllers: Vec<Vec<f64>>,
    trajectories: Vec<Option<Followed>>,
}

impl Followed {
    fn new(trajectory: Box<dyn Trajectory>, start: f64) -> Self {
        Self { trajectory: trajectory.into(), start }
    }
}

impl ControllerPolicy {
    /// Creates a controller of one kind for every drone of an environment, with the nominal parameters of its
    /// airframe.
    pub fn new(kind: ControllerKind, env: &dyn DroneEnv) -> Self {
        Self::with_controllers(env.simulation().world().drones.iter().map(|drone| kind.build(&drone.params)))
    }

    /// Creates a policy from one controller per drone.
    pub fn with_controllers(controllers: impl IntoIterator<Item = impl Controller + 'static>) -> Self {
        let controllers: Vec<Box<dyn Controller>> =
            controllers.into_iter().map(|controller| Box::new(controller) as Box<dyn Controller>).collect();
        let speeds = vec![[0.0; 4]; controllers.len()];
        Self { controllers, planned: true, trajectories: Vec::new(), speeds }
    }

    /// Sets one trajectory per drone, which replaces the plans and references of the task. Drones beyond the last
    /// trajectory follow the references.
    #[must_use]
    pub fn follow(mut self, trajectories: impl IntoIterator<Item = Box<dyn Trajectory>>) -> Self {
        self.trajectories = trajectories.into_iter().map(|path| Some(Followed::new(path, 0.0))).collect();
        self.planned = false;
        self
    }

    /// Disables the plans of the task, so that every drone follows the references.
    #[must_use]
    pub fn without_plans(self) -> Self {
        self.follow([])
    }

    /// Returns the trajectory of a drone, if it has one: the given trajectory, or the plan for this episode.
    pub fn trajectory(&self, drone: usize) -> Option<&dyn Trajectory> {
        Some(&*self.trajectories.get(drone)?.as_ref()?.trajectory)
    }

    /// Returns the present reference of a drone.
    ///
    /// # Panics
    /// If the index of the drone is out of range.
    pub fn reference(&self, env: &dyn DroneEnv, drone: usize) -> Reference {
        match self.trajectories.get(drone).and_then(Option::as_ref) {
            Some(Followed { trajectory, start }) => trajectory.reference(env.simulation().time() - start),
            None => env.reference(drone),
        }
    }
}

impl Policy for ControllerPolicy {
    /// Resets the controllers and computes the plans from the present states.
    ///
    /// # Errors
    /// [`EnvError::Option`] if the number of controllers differs from the number of drones.
    fn reset(&mut self, env: &dyn DroneEnv) -> Result<(), RolloutError> {
        if self.controllers.len() != env.simulation().num_drones() {
            let got = format!("{} for {} drones", self.controllers.len(), env.simulation().num_drones());
            let option = "controllers";
            return Err(EnvError::Option { option, got, expected: "one for each drone" }.into());
        }
        for controller in &mut self.controllers {
            controller.reset();
        }
        if self.planned {
            let time = env.simulation().time();
            let plans = env.plans().into_iter();
            self.trajectories = plans.map(|plan| plan.map(|plan| Followed::new(plan, time))).collect();
        }
        Ok(())
    }

    /// Resets the controller of a drone and, if drones follow the plans of the task, computes the plan of this drone
    /// from its present state.
    ///
    /// # Errors
    /// None.
    fn reset_drone(&mut self, env: &dyn DroneEnv, drone: usize) -> Result<(), RolloutError> {
        if let Some(controller) = self.controllers.get_mut(drone) {
            controller.reset();
        }
        if let Some(followed) = self.trajectories.get_mut(drone).filter(|_| self.planned) {
            let time = env.simulation().time();
            *followed = env.plan(drone).map(|plan| Followed::new(plan, time));
        }
        Ok(())
    }

    fn snapshot(&self) -> PolicySnapshot {
        let controllers = self.controllers.iter().map(|controller| controller.internal_state()).collect();
        PolicySnapshot::new(State { controllers, trajectories: self.trajectories.clone() })
    }

    fn restore(&mut self, snapshot: &PolicySnapshot) -> Result<(), RolloutError> {
        let State { controllers, trajectories } = snapshot.own()?;
        let before: Vec<_> = self.controllers.iter().map(|controller| controller.internal_state()).collect();
        let same =
            controllers.len() == before.len() && controllers.iter().zip(&before).all(|(a, b)| a.len() == b.len());
        let mut pairs = self.controllers.iter_mut().zip(controllers);
        if !(same && pairs.all(|(controller, state)| controller.set_internal_state(state))) {
            return Err(RolloutError::Snapshot);
        }
        self.trajectories.clone_from(trajectories);
        Ok(())
    }

    /// Writes the action.
    ///
    /// # Errors
    /// [`EnvError::Option`] for an action type that is neither motor speeds nor velocities.
    fn act(&mut self, env: &dyn DroneEnv, action: &mut [f64]) -> Result<(), RolloutError> {
        let simulation = env.simulation();
        if env.action_type() == ActionType::Vel {
            for (drone, command) in action.chunks_exact_mut(4).enumerate() {
                command.copy_from_slice(&velocity_to(&simulation.states()[drone], &self.reference(env, drone)));
            }
            return Ok(());
        }
        for drone in 0..self.controllers.len() {
            let reference = self.reference(env, drone);
            let state = &simulation.states()[drone];
            self.speeds[drone] = self.controllers[drone].control(simulation.control_period(), state, &reference).rpm;
        }
        Ok(env.action_of_motor_speeds(&self.speeds, action)?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rollout::{Rollout, fly_episode};
    use crate::tasks::{FlyThrough, Hover, MultiHover};

    #[test]
    fn drones_follow_the_plans_of_a_task_by_default() {
        let mut env = FlyThrough::builder().build().unwrap();
        let mut planned = ControllerPolicy::new(ControllerKind::Geometric, &env);
        let start = Rollout::start(&mut env, &mut planned, Some(1)).map(|_| ());
        assert!(start.is_ok() && planned.trajectory(0).is_some());
        let mut plain = ControllerPolicy::new(ControllerKind::Geometric, &env).without_plans();
        fly_episode(&mut env, &mut plain, Some(1)).unwrap();
        assert!(plain.trajectory(0).is_none());
        assert_eq!(plain.reference(&env, 0), env.reference(0));
    }

    #[test]
    fn unsupported_environments_are_rejected_with_the_reason() {
        let refused = |env: &mut dyn DroneEnv, pilot: &mut ControllerPolicy| {
            fly_episode(env, pilot, Some(1)).unwrap_err().to_string()
        };
        let mut one = ControllerPolicy::new(ControllerKind::Pid, &Hover::builder().build().unwrap());
        let error = refused(&mut MultiHover::builder().build().unwrap(), &mut one);
        assert_eq!(error, "controllers is 1 for 2 drones, expected one for each drone");
        let error = refused(&mut Hover::builder().action_type(ActionType::Attitude).build().unwrap(), &mut one);
        assert!(error.starts_with("action_type is attitude, expected rpm, raw_rpm or duty"), "{error}");
    }

    #[test]
    fn restarting_with_the_same_seed_repeats_the_episode() {
        let mut env = FlyThrough::builder().build().unwrap();
        let pilot = ControllerPolicy::new(ControllerKind::Pid, &env);
        let mut rollout = Rollout::start(&mut env, pilot, Some(3)).unwrap();
        let first = rollout.finish(|_| {}).unwrap();
        assert!(rollout.is_over() && first.end.is_some());
        rollout.restart(Some(3)).unwrap();
        assert!(!rollout.is_over() && rollout.summary().steps == 0);
        assert_eq!(rollout.finish(|_| {}).unwrap(), first);
    }
}
