//! Track of a race in a configuration.

use aviary::env::EnvError;
use aviary::tasks::RaceTrack;
use serde::{Deserialize, Serialize};

/// Track of a race.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum TrackChoice {
    /// Name of a built-in track, or path of a TOML file.
    NameOrFile(String),
    /// The track itself, as policy files record the track of a TOML file.
    Track(Box<RaceTrack>),
}

impl TrackChoice {
    /// Returns the track.
    ///
    /// # Errors
    /// An unknown name, or the errors of the file.
    pub fn track(&self) -> Result<RaceTrack, EnvError> {
        match self {
            Self::NameOrFile(name) => RaceTrack::find(name),
            Self::Track(track) => Ok((**track).clone()),
        }
    }

    /// Returns the choice without the path of a file: its track instead.
    ///
    /// # Errors
    /// As for [`track`](Self::track).
    pub(crate) fn without_path(&self) -> Result<Self, EnvError> {
        match self {
            Self::NameOrFile(name) if !RaceTrack::NAMES.contains(&name.as_str()) => {
                Ok(Self::Track(Box::new(RaceTrack::find(name)?)))
            }
            choice => Ok(choice.clone()),
        }
    }
}
