use std::any::Any;
use std::fmt;
use std::sync::Arc;

use serde::de::{DeserializeOwned, Error as _};
use serde::ser::Error as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use serde_json::Value;

use super::EnvError;
use crate::serial::Fingerprint;

/// Everything of an environment that changes, at one moment: states, motors, wind, sensors, random streams, task, controllers, and what
/// wrappers keep.
///
/// Threads can share a snapshot. A clone of a snapshot shares its contents.
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
///
/// A snapshot can be serialized, and restored in another program, in an environment with the same options. Tasks of this crate can be
/// saved; a task of your own implements [`Task::save`](super::Task::save) and [`Task::load`](super::Task::load), a wrapper makes its
/// snapshot with [`serializable`](Self::serializable). In any other case serializing is an error. Every number survives exactly in
/// JSON that is read with serde_json's feature `float_roundtrip`.
#[derive(Clone)]
pub struct EnvSnapshot {
    own: Own,
    /// Of the environment within a wrapper.
    inner: Option<Box<EnvSnapshot>>,
}

/// What an environment or a wrapper has kept.
#[derive(Clone)]
enum Own {
    Live { value: Arc<dyn Any + Send + Sync>, save: fn(&dyn Any) -> Result<Saved, String> },
    Saved(Saved),
}

/// A value as a snapshot in a file has it.
///
/// ```
/// use aviary::env::Saved;
///
/// let saved = Saved::new(&(3, "laps")).unwrap();
/// assert_eq!(saved.read::<(u32, String)>()?, (3, "laps".to_string()));
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Saved(Value);

impl Saved {
    /// Saves a value; `None` for one that has no form in JSON, such as a map whose keys are not text. Numbers that are not finite are
    /// lost: [`read`](Self::read) refuses what is saved of them.
    pub fn new(value: &impl Serialize) -> Option<Self> {
        serde_json::to_value(value).ok().map(Self)
    }

    /// Reads the value.
    ///
    /// # Errors
    /// [`EnvError::SavedSnapshot`] where it is of another type.
    pub fn read<V: DeserializeOwned>(&self) -> Result<V, EnvError> {
        V::deserialize(&self.0).map_err(|error| EnvError::SavedSnapshot { message: error.to_string() })
    }
}

impl EnvSnapshot {
    /// Makes a snapshot of what an environment keeps, which cannot be serialized.
    pub fn new(own: impl Any + Send + Sync) -> Self {
        let save = |_: &dyn Any| Err("the environment or wrapper keeps something that cannot be serialized".into());
        Self { own: Own::Live { value: Arc::new(own), save }, inner: None }
    }

    /// Makes a snapshot of what an environment keeps, which can be serialized.
    pub fn serializable<V: Any + Send + Sync + Serialize>(own: V) -> Self {
        fn save<V: Any + Serialize>(value: &dyn Any) -> Result<Saved, String> {
            let value: &V = value.downcast_ref().ok_or("a snapshot has changed its type")?;
            serde_json::to_value(value).map(Saved).map_err(|error| error.to_string())
        }
        Self { own: Own::Live { value: Arc::new(own), save: save::<V> }, inner: None }
    }

    /// Puts what a wrapper keeps around the snapshot of the environment within.
    #[must_use]
    pub fn with_inner(self, inner: Self) -> Self {
        Self { inner: Some(Box::new(inner)), ..self }
    }

    /// Makes a snapshot of what a wrapper keeps besides the environment within, which cannot be serialized.
    pub fn around(inner: Self, own: impl Any + Send + Sync) -> Self {
        Self::new(own).with_inner(inner)
    }

    /// Returns what the environment or the outermost wrapper has kept.
    ///
    /// # Errors
    /// [`EnvError::Snapshot`] where that is of another type, because the snapshot is of another environment, and where the snapshot
    /// was deserialized: [`read`](Self::read) takes both kinds.
    pub fn own<V: Any>(&self) -> Result<&V, EnvError> {
        match &self.own {
            Own::Live { value, .. } => value.downcast_ref().ok_or(EnvError::Snapshot),
            Own::Saved(_) => Err(EnvError::Snapshot),
        }
    }

    /// Returns a copy of what the environment or the outermost wrapper has kept, also where the snapshot was deserialized.
    ///
    /// # Errors
    /// [`EnvError::Snapshot`] and [`EnvError::SavedSnapshot`] where that is of another type: the snapshot is of another environment.
    pub fn read<V: Any + Clone + DeserializeOwned>(&self) -> Result<V, EnvError> {
        match &self.own {
            Own::Live { .. } => self.own().cloned(),
            Own::Saved(saved) => saved.read(),
        }
    }

    /// Returns what was deserialized; `None` for a snapshot of this program.
    pub fn saved(&self) -> Option<&Saved> {
        match &self.own {
            Own::Live { .. } => None,
            Own::Saved(saved) => Some(saved),
        }
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

/// A snapshot in a file.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Stored<V> {
    own: V,
    /// Of `own` as compact JSON: a task trusts its numbers to fit each other.
    checksum: Fingerprint,
    inner: Option<Box<EnvSnapshot>>,
}

#[derive(Serialize)]
struct StoredRef<'a, V> {
    own: V,
    checksum: Fingerprint,
    inner: Option<&'a EnvSnapshot>,
}

impl Serialize for EnvSnapshot {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let Saved(value) = match &self.own {
            Own::Live { value, save } => save(&**value).map_err(S::Error::custom)?,
            Own::Saved(saved) => saved.clone(),
        };
        let (checksum, inner) = (Fingerprint::of(&value), self.inner.as_deref());
        if serializer.is_human_readable() {
            StoredRef { own: value, checksum, inner }.serialize(serializer)
        } else {
            // formats that do not say what a value is cannot read any value
            StoredRef { own: value.to_string(), checksum, inner }.serialize(serializer)
        }
    }
}

impl<'de> Deserialize<'de> for EnvSnapshot {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let Stored { own, checksum, inner } = if deserializer.is_human_readable() {
            Stored::<Value>::deserialize(deserializer)?
        } else {
            let Stored { own, checksum, inner } = Stored::<String>::deserialize(deserializer)?;
            Stored { own: serde_json::from_str(&own).map_err(D::Error::custom)?, checksum, inner }
        };
        if Fingerprint::of(&own) != checksum {
            return Err(D::Error::custom("the checksum of the snapshot is wrong: it was changed or read inexactly"));
        }
        Ok(Self { own: Own::Saved(Saved(own)), inner })
    }
}
