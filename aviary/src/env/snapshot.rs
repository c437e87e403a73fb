use std::any::Any;
use std::fmt;

use super::EnvError;

/// Everything of an environment that changes, at one moment: states, motors, wind, sensors, random streams, task, controllers, and what
/// wrappers keep.
///
/// After [`Env::restore`](super::Env::restore), an environment goes on bit-identically to after [`Env::snapshot`](super::Env::snapshot).
///
/// ```
/// use aviary::env::Env;
/// use aviary::tasks::Hover;
///
/// let mut env = Hover::builder().build()?;
/// env.reset(Some(1))?;
/// let snapshot = env.snapshot();
/// let first = env.step(&[0.1; 4])?.reward;
/// env.restore(&snapshot)?;
/// assert_eq!(env.step(&[0.1; 4])?.reward, first);
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
pub struct EnvSnapshot {
    own: Box<dyn Any + Send>,
    /// Of the environment within a wrapper.
    inner: Option<Box<EnvSnapshot>>,
}

impl EnvSnapshot {
    /// Makes a snapshot of what an environment keeps.
    pub fn new(own: impl Any + Send) -> Self {
        Self { own: Box::new(own), inner: None }
    }

    /// Makes a snapshot of what a wrapper keeps besides the environment within.
    pub fn around(inner: Self, own: impl Any + Send) -> Self {
        Self { own: Box::new(own), inner: Some(Box::new(inner)) }
    }

    /// Returns what the environment or the outermost wrapper has kept.
    ///
    /// # Errors
    /// [`EnvError::Snapshot`] where that is of another type: the snapshot is of another environment.
    pub fn own<V: Any>(&self) -> Result<&V, EnvError> {
        self.own.downcast_ref().ok_or(EnvError::Snapshot)
    }

    /// Returns the snapshot of the environment within a wrapper.
    ///
    /// # Errors
    /// [`EnvError::Snapshot`] where it is not one of a wrapper.
    pub fn inner(&self) -> Result<&Self, EnvError> {
        self.inner.as_deref().ok_or(EnvError::Snapshot)
    }
}

impl fmt::Debug for EnvSnapshot {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("EnvSnapshot").field("inner", &self.inner).finish_non_exhaustive()
    }
}
