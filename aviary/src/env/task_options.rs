use serde::{Deserialize, Serialize};

use super::{AviaryBuilder, EnvConfig, EnvError, Task};
use crate::tasks::RaceTrack;

/// Options of a task by name, for callers that know the task only by its name. `None` is the task's default.
///
/// | option | tasks |
/// | --- | --- |
/// | `target_height` | `hover` |
/// | `target_heights` | `multi_hover`, `multi_agent` |
/// | `waypoints` | `fly_through` |
/// | `gates`, `laps`, `track` | `race` |
///
/// An option that the task does not have is an error.
///
/// ```
/// use aviary::env::{DroneEnv, EnvConfig};
/// use aviary::tasks::make;
///
/// let env = make("hover", EnvConfig::default().task(|options| options.target_height = Some(1.5)))?;
/// assert_eq!(env.reference(0).position.z, 1.5);
/// let error = make("hover", EnvConfig::default().task(|options| options.laps = Some(3))).err();
/// let message = "the task `hover` has no option `laps`, expected target_height";
/// assert_eq!(error.map(|error| error.to_string()).as_deref(), Some(message));
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TaskOptions {
    /// Target height, m.
    pub target_height: Option<f64>,
    /// Target height of each drone, m.
    pub target_heights: Option<Vec<f64>>,
    /// Waypoints, world frame, m.
    #[serde(default, deserialize_with = "crate::error::optional_triples")]
    pub waypoints: Option<Vec<[f64; 3]>>,
    /// Centres of the gates, world frame, m.
    #[serde(default, deserialize_with = "crate::error::optional_triples")]
    pub gates: Option<Vec<[f64; 3]>>,
    /// Number of laps.
    pub laps: Option<usize>,
    /// Track, with its gates and laps; `gates` and `laps` replace those of the track.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub track: Option<RaceTrack>,
}

impl TaskOptions {
    /// Names of all options.
    pub const NAMES: [&str; 6] = ["target_height", "target_heights", "waypoints", "gates", "laps", "track"];

    /// Options that can be changed [during an episode](super::DroneEnv::set_task_options).
    pub(crate) const TARGETS: [&str; 2] = ["target_height", "target_heights"];

    /// Returns the names of the options that are set.
    pub fn names(&self) -> impl Iterator<Item = &'static str> {
        let Self { target_height, target_heights, waypoints, gates, laps, track } = self;
        let set = [
            target_height.is_some(),
            target_heights.is_some(),
            waypoints.is_some(),
            gates.is_some(),
            laps.is_some(),
            track.is_some(),
        ];
        Self::NAMES.into_iter().zip(set).filter_map(|(name, set)| set.then_some(name))
    }

    /// Checks that only options of a task are set. `known` has the names of its options.
    ///
    /// # Errors
    /// [`EnvError::TaskOption`] naming another option that is set.
    pub fn check(&self, task: &'static str, known: &'static [&'static str]) -> Result<(), EnvError> {
        match self.names().find(|name| !known.contains(name)) {
            Some(option) => Err(EnvError::TaskOption { task, option, known }),
            None => Ok(()),
        }
    }
}

impl EnvConfig {
    /// Returns the same options for a task, with the [options by name](TaskOptions) applied to it.
    ///
    /// ```
    /// use aviary::env::EnvConfig;
    /// use aviary::tasks::Race;
    ///
    /// let config = EnvConfig::default().task(|options| options.laps = Some(3));
    /// assert_eq!(config.for_task(Race::default())?.build()?.task().laps, 3);
    /// # Ok::<(), aviary::env::EnvError>(())
    /// ```
    ///
    /// # Errors
    /// [`EnvError::TaskOption`] for an option that the task does not have.
    pub fn for_task<T: Task>(self, mut task: T) -> Result<AviaryBuilder<T>, EnvError> {
        task.set_options(self.task_options())?;
        Ok(self.with_task(task))
    }
}
