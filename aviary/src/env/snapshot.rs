use std::any::Any;
use std::fmt;
use std::sync::Arc;

use serde::de::{DeserializeOwned, Error as _};
use serde::ser::Error as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use serde_json::Value;

use super::EnvError;
use crate::serial::Fingerprint;

/// Copy of an environment's state: drones, motors, wind, sensors, random streams, task, controllers, and the state
/// of wrappers.
///
/// Threads can share a snapshot. A clone of a snapshot shares its contents.
///
/// [`Env::restore`](super::Env::restore) restores it. The same actions then lead to bit-identical steps and resets as
/// after [`Env::snapshot`](super::Env::snapshot).
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
/// A snapshot can be serialized, and restored in another process in an environment with the same options. Tasks of
/// this crate support this. Your own task implements [`Task::save`](super::Task::save) and
/// [`Task::load`](super::Task::load), and your own wrapper creates its snapshot with
/// [`serializable`](Self::serializable); otherwise serializing returns an error. JSON keeps every number exactly if
/// serde_json's feature `float_roundtrip` is on when it is read.
#[derive(Clone)]
pub struct EnvSnapshot {
    own: Own,
    /// Snapshot of the environment inside a wrapper.
    inner: Option<Box<EnvSnapshot>>,
}

/// State of an environment or a wrapper: a value of this process, or a deserialized one.
#[derive(Clone)]
enum Own {
    Live { value: Arc<dyn Any + Send + Sync>, save: fn(&dyn Any) -> Result<Saved, String> },
    Saved(Saved),
}

/// Serialized value inside a snapshot.
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
    /// Serializes a value; `None` if JSON cannot represent it, such as a map whose keys are not text. JSON turns
    /// non-finite numbers into `null`, which [`read`](Self::read) rejects.
    pub fn new(value: &impl Serialize) -> Option<Self> {
        serde_json::to_value(value).ok().map(Self)
    }

    /// Deserializes the value.
    ///
    /// # Errors
    /// [`EnvError::SavedSnapshot`] for a value of another type.
    pub fn read<V: DeserializeOwned>(&self) -> Result<V, EnvError> {
        V::deserialize(&self.0).map_err(|error| EnvError::SavedSnapshot { message: error.to_string() })
    }
}

impl EnvSnapshot {
    /// Creates a snapshot of an environment's state that cannot be serialized.
    pub fn new(own: impl Any + Send + Sync) -> Self {
        let save = |_: &dyn Any| Err("the environment or wrapper has a state that cannot be serialized".into());
        Self { own: Own::Live { value: Arc::new(own), save }, inner: None }
    }

    /// Creates a snapshot of an environment's state that can be serialized.
    pub fn serializable<V: Any + Send + Sync + Serialize>(own: V) -> Self {
        fn save<V: Any + Serialize>(value: &dyn Any) -> Result<Saved, String> {
            let value: &V = value.downcast_ref().ok_or("the type of the snapshot has changed")?;
            serde_json::to_value(value).map(Saved).map_err(|error| error.to_string())
        }
        Self { own: Own::Live { value: Arc::new(own), save: save::<V> }, inner: None }
    }

    /// Adds the snapshot of the environment inside a wrapper.
    #[must_use]
    pub fn with_inner(self, inner: Self) -> Self {
        Self { inner: Some(Box::new(inner)), ..self }
    }

    /// Creates a snapshot of a wrapper's state that cannot be serialized, around the snapshot of the environment
    /// inside.
    pub fn around(inner: Self, own: impl Any + Send + Sync) -> Self {
        Self::new(own).with_inner(inner)
    }

    /// Returns the state of the environment or of the outermost wrapper.
    ///
    /// # Errors
    /// [`EnvError::Snapshot`] if the state has another type, because the snapshot is of another environment, or if
    /// the snapshot was deserialized. [`read`](Self::read) supports both cases.
    pub fn own<V: Any>(&self) -> Result<&V, EnvError> {
        match &self.own {
            Own::Live { value, .. } => value.downcast_ref().ok_or(EnvError::Snapshot),
            Own::Saved(_) => Err(EnvError::Snapshot),
        }
    }

    /// Returns a copy of the state of the environment or of the outermost wrapper, also of a deserialized snapshot.
    ///
    /// # Errors
    /// [`EnvError::Snapshot`] and [`EnvError::SavedSnapshot`] if the state has another type, because the snapshot
    /// is of another environment.
    pub fn read<V: Any + Clone + DeserializeOwned>(&self) -> Result<V, EnvError> {
        match &self.own {
            Own::Live { .. } => self.own().cloned(),
            Own::Saved(saved) => saved.read(),
        }
    }

    /// Returns the deserialized state; `None` for a snapshot made in this process.
    pub fn saved(&self) -> Option<&Saved> {
        match &self.own {
            Own::Live { .. } => None,
            Own::Saved(saved) => Some(saved),
        }
    }

    /// Returns the snapshot of the environment inside a wrapper.
    ///
    /// # Errors
    /// [`EnvError::Snapshot`] if the snapshot is not of a wrapper.
    pub fn inner(&self) -> Result<&Self, EnvError> {
        self.inner.as_deref().ok_or(EnvError::Snapshot)
    }
}

impl fmt::Debug for EnvSnapshot {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("EnvSnapshot").field("inner", &self.inner).finish_non_exhaustive()
    }
}

/// Serialized form of a snapshot.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Stored<V> {
    own: V,
    /// Hash of `own` as compact JSON, since tasks do not check that their numbers are consistent.
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
            // formats that are not self-describing cannot deserialize a `Value`
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
            return Err(D::Error::custom("the checksum of the snapshot is wrong: it was edited or read inexactly"));
        }
        Ok(Self { own: Own::Saved(Saved(own)), inner })
    }
}
