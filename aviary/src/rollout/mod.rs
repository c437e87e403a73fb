//! Episodes: policies that choose actions, and the loop that runs an environment with a policy.
//!
//! | policy | source of the actions |
//! | --- | --- |
//! | [`ControllerPolicy`] | one controller per drone, along the plans or references of the task or along a trajectory |
//! | [`NetworkPolicy`] | a trained network |
//! | [`from_fn`] | a function of the environment |
//! | [`PilotedPolicy`] | the sticks of a person for some drones, another policy for the others |
//!
//! [`fly_episode`] flies one episode and returns its [`EpisodeSummary`]; a [`Rollout`] flies it step by step.

mod controller;
mod network;
mod piloted;
mod snapshot;
mod steering;

pub use controller::ControllerPolicy;
pub use network::NetworkPolicy;
pub use piloted::{PilotMode, PilotedPolicy};
pub use snapshot::{PolicySnapshot, RolloutSnapshot};

use std::fmt;

use crate::env::{DroneEnv, EnvError, EpisodeSummary, Step};
use crate::policy::PolicyError;

/// Chooses the actions of all drones of an environment, with access to its observation, simulation and info.
///
/// ```
/// use aviary::env::{DroneEnv, Env};
/// use aviary::rollout::{Policy, RolloutError, fly_episode};
/// use aviary::tasks::Hover;
///
/// /// Climbs with full thrust for some control steps and then switches the motors off.
/// struct Hop {
///     left: u32,
/// }
///
/// impl Policy for Hop {
///     fn reset(&mut self, _: &dyn DroneEnv) -> Result<(), RolloutError> {
///         self.left = 10;
///         Ok(())
///     }
///
///     fn act(&mut self, _: &dyn DroneEnv, action: &mut [f64]) -> Result<(), RolloutError> {
///         action.fill(if self.left > 0 { 1.0 } else { -1.0 });
///         self.left = self.left.saturating_sub(1);
///         Ok(())
///     }
/// }
///
/// let mut env = Hover::builder().build()?;
/// let summary = fly_episode(&mut env, &mut Hop { left: 0 }, Some(1))?;
/// assert!(env.info().crashed() && summary.steps > 20);
/// # Ok::<(), RolloutError>(())
/// ```
pub trait Policy {
    /// Clears the internal state for the episode that `env` has just started.
    ///
    /// # Errors
    /// [`RolloutError`] for an environment that the policy cannot fly.
    fn reset(&mut self, env: &dyn DroneEnv) -> Result<(), RolloutError> {
        let _ = env;
        Ok(())
    }

    /// Writes the action of the next control step. The length of `action` is the size of the action space.
    ///
    /// # Errors
    /// [`RolloutError`] for an environment that the policy cannot fly.
    fn act(&mut self, env: &dyn DroneEnv, action: &mut [f64]) -> Result<(), RolloutError>;

    /// Clears the internal state of one drone during an episode, after something else has flown the drone. Policies
    /// without internal state per drone do nothing, which is the default.
    ///
    /// # Errors
    /// [`RolloutError`] for an environment that the policy cannot fly.
    fn reset_drone(&mut self, env: &dyn DroneEnv, drone: usize) -> Result<(), RolloutError> {
        let _ = (env, drone);
        Ok(())
    }

    /// Returns a copy of the internal state, such as integrals and plans, for [`restore`](Self::restore). Policies
    /// without internal state return an empty snapshot, which is the default. A policy with internal state overrides
    /// both functions. Otherwise a flight from a snapshot differs from the flight after the snapshot.
    ///
    /// ```
    /// use aviary::control::ControllerKind;
    /// use aviary::env::{Aviary, DroneEnv};
    /// use aviary::rollout::{ControllerPolicy, Rollout, RolloutError};
    /// use aviary::tasks::FlyThrough;
    ///
    /// let env = FlyThrough::builder().build()?;
    /// let pilot = ControllerPolicy::new(ControllerKind::Pid, &env);
    /// let mut rollout = Rollout::start(env, pilot, Some(1))?;
    /// let fly = |rollout: &mut Rollout<Aviary<FlyThrough>, ControllerPolicy>| -> Result<_, RolloutError> {
    ///     for _ in 0..20 {
    ///         rollout.step()?;
    ///     }
    ///     Ok(rollout.env().simulation().states().to_vec())
    /// };
    /// fly(&mut rollout)?;
    /// // environment, policy and summary
    /// let snapshot = rollout.snapshot();
    /// let states = fly(&mut rollout)?;
    /// rollout.restore(&snapshot)?;
    /// assert_eq!(fly(&mut rollout)?, states);
    /// # Ok::<(), RolloutError>(())
    /// ```
    fn snapshot(&self) -> PolicySnapshot {
        PolicySnapshot::default()
    }

    /// Restores an internal state that [`snapshot`](Self::snapshot) of this policy, or of one of the same kind, has
    /// returned. Settings such as gains are not part of it.
    ///
    /// # Errors
    /// [`RolloutError::Snapshot`] for a snapshot of another kind of policy. The policy is unchanged.
    fn restore(&mut self, snapshot: &PolicySnapshot) -> Result<(), RolloutError> {
        if snapshot.is_empty() { Ok(()) } else { Err(RolloutError::Snapshot) }
    }
}

impl<P: Policy + ?Sized> Policy for &mut P {
    fn reset(&mut self, env: &dyn DroneEnv) -> Result<(), RolloutError> {
        (**self).reset(env)
    }

    fn act(&mut self, env: &dyn DroneEnv, action: &mut [f64]) -> Result<(), RolloutError> {
        (**self).act(env, action)
    }

    fn reset_drone(&mut self, env: &dyn DroneEnv, drone: usize) -> Result<(), RolloutError> {
        (**self).reset_drone(env, drone)
    }

    fn snapshot(&self) -> PolicySnapshot {
        (**self).snapshot()
    }

    fn restore(&mut self, snapshot: &PolicySnapshot) -> Result<(), RolloutError> {
        (**self).restore(snapshot)
    }
}

impl<P: Policy + ?Sized> Policy for Box<P> {
    fn reset(&mut self, env: &dyn DroneEnv) -> Result<(), RolloutError> {
        (**self).reset(env)
    }

    fn act(&mut self, env: &dyn DroneEnv, action: &mut [f64]) -> Result<(), RolloutError> {
        (**self).act(env, action)
    }

    fn reset_drone(&mut self, env: &dyn DroneEnv, drone: usize) -> Result<(), RolloutError> {
        (**self).reset_drone(env, drone)
    }

    fn snapshot(&self) -> PolicySnapshot {
        (**self).snapshot()
    }

    fn restore(&mut self, snapshot: &PolicySnapshot) -> Result<(), RolloutError> {
        (**self).restore(snapshot)
    }
}

/// A [`Policy`] that calls a function; see [`from_fn`].
#[derive(Clone, Copy)]
pub struct FnPolicy<F>(F);

impl<F> fmt::Debug for FnPolicy<F> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("FnPolicy").finish_non_exhaustive()
    }
}

/// Creates a policy from a function that writes the action for an environment.
///
/// ```
/// use aviary::env::Env;
/// use aviary::rollout::{fly_episode, from_fn};
/// use aviary::tasks::Hover;
///
/// let mut climb = from_fn(|env, action| {
///     let observation = &env.observation().vector;
///     action.fill(0.5 * (1.0 - observation[2]) - 0.4 * observation[8]);
/// });
/// let summary = fly_episode(&mut Hover::builder().build()?, &mut climb, Some(1))?;
/// assert!(summary.success);
/// # Ok::<(), aviary::rollout::RolloutError>(())
/// ```
pub fn from_fn<F: FnMut(&dyn DroneEnv, &mut [f64])>(act: F) -> FnPolicy<F> {
    FnPolicy(act)
}

impl<F: FnMut(&dyn DroneEnv, &mut [f64])> Policy for FnPolicy<F> {
    fn act(&mut self, env: &dyn DroneEnv, action: &mut [f64]) -> Result<(), RolloutError> {
        (self.0)(env, action);
        Ok(())
    }
}

/// Error of an episode.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum RolloutError {
    /// Error of the environment.
    #[error(transparent)]
    Env(#[from] EnvError),
    /// A snapshot of another kind of policy.
    #[error("the snapshot is of another kind of policy, expected one of a policy with the same controllers")]
    Snapshot,
    /// Error of a trained policy.
    #[error(transparent)]
    Policy(#[from] PolicyError),
}

/// Flies one episode to its end.
///
/// ```
/// use aviary::control::ControllerKind;
/// use aviary::env::{Env, EnvConfig};
/// use aviary::rollout::{ControllerPolicy, fly_episode};
/// use aviary::tasks::make;
///
/// let mut env = make("race", EnvConfig::default())?;
/// let mut pilot = ControllerPolicy::new(ControllerKind::Geometric, &env);
/// let summary = fly_episode(&mut env, &mut pilot, Some(1))?;
/// assert!(summary.success && env.info_map()["gates_passed"] == 12.0);
/// # Ok::<(), aviary::rollout::RolloutError>(())
/// ```
///
/// # Errors
/// As for [`Rollout::start`] and [`Rollout::step`].
pub fn fly_episode(
    env: &mut dyn DroneEnv,
    policy: &mut dyn Policy,
    seed: Option<u64>,
) -> Result<EpisodeSummary, RolloutError> {
    Rollout::start(env, policy, seed)?.finish(|_| {})
}

/// An environment with a policy that flies its episodes step by step.
///
/// ```
/// use aviary::control::ControllerKind;
/// use aviary::env::{DroneEnv, Env};
/// use aviary::rollout::{ControllerPolicy, Rollout};
/// use aviary::tasks::Hover;
///
/// let env = Hover::builder().build()?;
/// let pilot = ControllerPolicy::new(ControllerKind::Dsl, &env);
/// let mut rollout = Rollout::start(env, pilot, Some(1))?;
/// let mut highest = 0.0_f64;
/// while !rollout.is_over() {
///     rollout.step()?;
///     highest = highest.max(rollout.env().simulation().states()[0].position.z);
/// }
/// assert!(rollout.summary().success && highest < 1.1);
/// # Ok::<(), aviary::rollout::RolloutError>(())
/// ```
#[derive(Debug)]
pub struct Rollout<E, P> {
    env: E,
    policy: P,
    action: Vec<f64>,
    reward: f64,
    steps: u64,
    over: bool,
}

impl<E: DroneEnv, P: Policy> Rollout<E, P> {
    /// Starts the first episode. The environment and the policy are owned, or borrowed as `&mut`.
    ///
    /// # Errors
    /// As for [`restart`](Self::restart).
    pub fn start(env: E, policy: P, seed: Option<u64>) -> Result<Self, RolloutError> {
        let action = vec![0.0; env.action_space().size()];
        let mut rollout = Self { env, policy, action, reward: 0.0, steps: 0, over: false };
        rollout.restart(seed)?;
        Ok(rollout)
    }

    /// Starts another episode. Without a seed the random generator continues its sequence.
    ///
    /// # Errors
    /// The errors of [`reset`](crate::env::Env::reset) and [`Policy::reset`].
    pub fn restart(&mut self, seed: Option<u64>) -> Result<(), RolloutError> {
        (self.reward, self.steps, self.over) = (0.0, 0, false);
        self.env.reset(seed)?;
        self.policy.reset(&self.env)
    }

    /// Flies one control step.
    ///
    /// # Errors
    /// The errors of [`Policy::act`] and [`step`](crate::env::Env::step).
    pub fn step(&mut self) -> Result<Step<'_>, RolloutError> {
        self.policy.act(&self.env, &mut self.action)?;
        let step = self.env.step(&self.action)?;
        self.reward += step.reward;
        self.steps += 1;
        self.over = step.terminated || step.truncated;
        Ok(step)
    }

    /// Flies the rest of the episode and calls `look` after every control step.
    ///
    /// # Errors
    /// As for [`step`](Self::step).
    pub fn finish(&mut self, mut look: impl FnMut(&E)) -> Result<EpisodeSummary, RolloutError> {
        while !self.over {
            self.step()?;
            look(&self.env);
        }
        Ok(self.summary())
    }

    /// Returns true if the episode has ended.
    pub fn is_over(&self) -> bool {
        self.over
    }

    /// Returns the summary of the episode so far.
    pub fn summary(&self) -> EpisodeSummary {
        let info = self.env.info();
        EpisodeSummary { reward: self.reward, steps: self.steps, end: info.end, success: info.success }
    }

    /// Returns the environment.
    pub fn env(&self) -> &E {
        &self.env
    }

    /// Returns the environment mutably, for example to change its wind or randomization.
    pub fn env_mut(&mut self) -> &mut E {
        &mut self.env
    }

    /// Returns the policy.
    pub fn policy(&self) -> &P {
        &self.policy
    }

    /// Returns the policy mutably, for example to [pilot](PilotedPolicy) a drone.
    pub fn policy_mut(&mut self) -> &mut P {
        &mut self.policy
    }
}
