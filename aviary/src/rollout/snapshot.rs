//! Snapshots of policies and rollouts.

use std::any::Any;
use std::fmt;
use std::sync::Arc;

use super::{Policy, Rollout, RolloutError};
use crate::env::{DroneEnv, EnvSnapshot};

/// Copy of the internal state of a [`Policy`]; empty for a policy without internal state.
///
/// Threads can share a snapshot. A clone of a snapshot shares its contents.
///
/// ```
/// use aviary::env::DroneEnv;
/// use aviary::rollout::{Policy, PolicySnapshot, RolloutError};
///
/// /// Climbs with full thrust for some control steps.
/// struct Climb(u32);
///
/// impl Policy for Climb {
///     fn act(&mut self, _: &dyn DroneEnv, action: &mut [f64]) -> Result<(), RolloutError> {
///         action.fill(if self.0 > 0 { 1.0 } else { 0.0 });
///         self.0 = self.0.saturating_sub(1);
///         Ok(())
///     }
///
///     fn snapshot(&self) -> PolicySnapshot {
///         PolicySnapshot::new(self.0)
///     }
///
///     fn restore(&mut self, snapshot: &PolicySnapshot) -> Result<(), RolloutError> {
///         self.0 = *snapshot.own()?;
///         Ok(())
///     }
/// }
///
/// let mut climb = Climb(7);
/// climb.restore(&Climb(3).snapshot())?;
/// assert_eq!(climb.0, 3);
/// assert_eq!(climb.restore(&PolicySnapshot::default()), Err(RolloutError::Snapshot));
/// # Ok::<(), RolloutError>(())
/// ```
#[derive(Clone, Default)]
pub struct PolicySnapshot(Option<Arc<dyn Any + Send + Sync>>);

impl PolicySnapshot {
    /// Creates a snapshot of a policy's internal state.
    pub fn new(state: impl Any + Send + Sync) -> Self {
        Self(Some(Arc::new(state)))
    }

    /// Returns true for the snapshot of a policy without internal state.
    pub fn is_empty(&self) -> bool {
        self.0.is_none()
    }

    /// Returns the internal state.
    ///
    /// # Errors
    /// [`RolloutError::Snapshot`] if the state has another type, because the snapshot is of another kind of policy.
    pub fn own<V: Any>(&self) -> Result<&V, RolloutError> {
        self.0.as_deref().and_then(|state| state.downcast_ref()).ok_or(RolloutError::Snapshot)
    }
}

impl fmt::Debug for PolicySnapshot {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("PolicySnapshot").field("is_empty", &self.is_empty()).finish_non_exhaustive()
    }
}

/// Copy of the state of a [`Rollout`]: environment, policy, and summary of the episode so far.
#[derive(Debug, Clone)]
pub struct RolloutSnapshot {
    env: EnvSnapshot,
    policy: PolicySnapshot,
    reward: f64,
    steps: u64,
    over: bool,
}

impl RolloutSnapshot {
    /// Returns the snapshot of the environment.
    pub fn env(&self) -> &EnvSnapshot {
        &self.env
    }

    /// Returns the snapshot of the policy.
    pub fn policy(&self) -> &PolicySnapshot {
        &self.policy
    }
}

impl<E: DroneEnv, P: Policy> Rollout<E, P> {
    /// Returns a copy of the state, to rewind the flight with [`restore`](Self::restore).
    pub fn snapshot(&self) -> RolloutSnapshot {
        let (env, policy) = (self.env.snapshot(), self.policy.snapshot());
        RolloutSnapshot { env, policy, reward: self.reward, steps: self.steps, over: self.over }
    }

    /// Restores a snapshot of this rollout, or of one with the same options. The flight from there on is bit-identical
    /// to the flight after the snapshot.
    ///
    /// # Errors
    /// [`RolloutError::Snapshot`] for a snapshot with another kind of policy, and the errors of
    /// [`Env::restore`](crate::env::Env::restore). The rollout is unchanged after an error.
    pub fn restore(&mut self, snapshot: &RolloutSnapshot) -> Result<(), RolloutError> {
        let before = self.policy.snapshot();
        self.policy.restore(&snapshot.policy)?;
        if let Err(error) = self.env.restore(&snapshot.env) {
            // the policy accepts its own state
            self.policy.restore(&before)?;
            return Err(error.into());
        }
        (self.reward, self.steps, self.over) = (snapshot.reward, snapshot.steps, snapshot.over);
        Ok(())
    }
}
