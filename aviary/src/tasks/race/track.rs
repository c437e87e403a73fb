use std::f64::consts::PI;
use std::path::Path;

use serde::{Deserialize, Serialize};

use super::Race;
use crate::env::EnvError;
use crate::error::{SystemError, toml_message};
use crate::{UnknownName, number};

/// Track of a race: gates, laps, and properties of the gates, from a TOML file or by name.
///
/// | key | default | meaning |
/// | --- | --- | --- |
/// | `laps` | 2 | number of laps |
/// | `opening` | 0.5 | inner side of a gate, m |
/// | `solid` | `false` | `true`: drones collide with the frames |
/// | `normals` | see [`Race`](super::Race) | `true`: the observation includes the normals of the next two gates |
/// | `[[gates]]` | | one section per gate, in the order of the race |
/// | `gates.position` | | centre, world frame, m; the frames of solid gates are above the floor and do not overlap |
/// | `gates.yaw` | | direction in which drones pass the gate, rad from x; default that from the previous gate to the next |
/// | `[randomization]` `position` | 0 | largest offset of a gate in an episode, along each axis, m |
/// | `[randomization]` `yaw` | 0 | largest change of the yaw of a gate in an episode, rad |
/// | `[motion]` `amplitude` | 0 | amplitude of a gate that sways to its left and right, m |
/// | `[motion]` `period` | 4 | period of the sway, s |
///
/// ```
/// use aviary::env::EnvConfig;
/// use aviary::tasks::{Race, RaceTrack, make};
///
/// let track = RaceTrack::from_toml("solid = true\n[[gates]]\nposition = [1.0, 0.0, 1.0]\nyaw = 0.5\n")?;
/// assert_eq!((track.laps, track.gates.len()), (2, 1));
/// let mut env = make("race", EnvConfig::default().task(|options| options.track = Some(track)))?;
/// assert_eq!(env.simulation().obstacles().len(), 4, "the bars of the frame");
///
/// let oval = RaceTrack::named("oval")?;
/// assert_eq!(Race::builder().task(|race| race.set_track(&oval)).build()?.task().gates.len(), oval.gates.len());
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RaceTrack {
    /// Number of laps.
    #[serde(default = "two_laps")]
    pub laps: usize,
    /// Inner side of a gate, m.
    #[serde(default = "half_a_metre")]
    pub opening: f64,
    /// True if drones collide with the frames of the gates.
    #[serde(default)]
    pub solid: bool,
    /// True if the observation includes the normals of the next two gates; `None` for the default of
    /// [`Race::normals`](super::Race::normals).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub normals: Option<bool>,
    /// Changes of the gates in every episode.
    #[serde(default)]
    pub randomization: GateRanges,
    /// Motion of the gates.
    #[serde(default)]
    pub motion: GateMotion,
    /// Gates in the order of the race.
    pub gates: Vec<Gate>,
}

/// Gate of a [`RaceTrack`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Gate {
    /// Centre, world frame, m.
    #[serde(deserialize_with = "crate::error::triple")]
    pub position: [f64; 3],
    /// Direction in which drones pass the gate, rad from x; `None` for the direction from the previous gate to the
    /// next.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub yaw: Option<f64>,
}

/// Ranges of the offsets of the gates that every episode draws, uniformly and independently for each gate.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct GateRanges {
    /// Largest offset along each axis, m; default 0.
    pub position: f64,
    /// Largest change of the yaw, rad; default 0.
    pub yaw: f64,
}

/// Motion of the gates: each sways to its left and right like a sine, with a phase that every episode draws.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct GateMotion {
    /// Amplitude, m; default 0.
    pub amplitude: f64,
    /// Period, s; default 4.
    pub period: f64,
}

impl Default for GateMotion {
    fn default() -> Self {
        Self { amplitude: 0.0, period: 4.0 }
    }
}

fn two_laps() -> usize {
    2
}

fn half_a_metre() -> f64 {
    0.5
}

impl RaceTrack {
    /// Names of the built-in tracks.
    ///
    /// | name | track |
    /// | --- | --- |
    /// | `figure_eight` | six gates on a figure eight of 4.8 m × 2.1 m |
    /// | `stacked` | six gates between 0.8 m and 2.1 m, two of them one above the other |
    /// | `oval` | six gates on an oval of 9 m × 3 m |
    ///
    /// All have solid gates with an opening of 0.5 m, and two laps.
    pub const NAMES: [&str; 3] = ["figure_eight", "stacked", "oval"];

    /// Returns a built-in track.
    ///
    /// # Errors
    /// [`EnvError::UnknownName`] for an unknown name.
    pub fn named(name: &str) -> Result<Self, EnvError> {
        let text = match name {
            "figure_eight" => include_str!("../../../../assets/tracks/figure_eight.toml"),
            "stacked" => include_str!("../../../../assets/tracks/stacked.toml"),
            "oval" => include_str!("../../../../assets/tracks/oval.toml"),
            _ => return Err(UnknownName { noun: "track", name: name.into(), names: &Self::NAMES }.into()),
        };
        Self::from_toml(text)
    }

    /// Returns a built-in track, or reads a file whose name ends in `.toml`.
    ///
    /// # Errors
    /// Those of [`named`](Self::named) and [`from_file`](Self::from_file).
    pub fn find(name_or_file: &str) -> Result<Self, EnvError> {
        let is_file = Path::new(name_or_file).extension().is_some_and(|extension| extension == "toml");
        if is_file { Self::from_file(name_or_file) } else { Self::named(name_or_file) }
    }

    /// Reads a track from a TOML file.
    ///
    /// # Errors
    /// [`EnvError::File`] with the path, around an error of [`from_toml`](Self::from_toml) or of the system.
    pub fn from_file(path: impl AsRef<Path>) -> Result<Self, EnvError> {
        let path = path.as_ref();
        let in_file = |error| EnvError::File { path: path.into(), error: Box::new(error) };
        let text = std::fs::read_to_string(path).map_err(|error| in_file(SystemError::from(error).into()))?;
        Self::from_toml(&text).map_err(in_file)
    }

    /// Reads a track from TOML text.
    ///
    /// # Errors
    /// [`EnvError::Toml`] with line, column and field, or an error of [`validate`](Self::validate).
    pub fn from_toml(text: &str) -> Result<Self, EnvError> {
        let track: Self =
            toml::from_str(text).map_err(|error| EnvError::Toml { message: toml_message(text, &error) })?;
        track.validate()?;
        Ok(track)
    }

    /// Validates the numbers of the track.
    ///
    /// # Errors
    /// [`EnvError::Option`] naming the first invalid key.
    pub fn validate(&self) -> Result<(), EnvError> {
        let wrong = |option, got: String, expected| Err(EnvError::Option { option, got, expected });
        let points: Vec<_> = self.gates.iter().map(|gate| gate.position).collect();
        crate::tasks::waypoint_progress::validate("gates", &points, self.laps, 1.0)?;
        let total = points.len() * self.laps;
        if self.solid && total > Self::MAX_SOLID {
            return wrong("gates", crate::count(total, "gate"), "1 to 99 over all laps if they are solid");
        }
        for (option, got, low, high, expected) in [
            ("opening", self.opening, 0.01, 100.0, "0.01 to 100 m"),
            ("randomization.position", self.randomization.position, 0.0, 10.0, "0 to 10 m for the gates"),
            ("randomization.yaw", self.randomization.yaw, 0.0, PI, "0 to π rad for the gates"),
            ("motion.amplitude", self.motion.amplitude, 0.0, 10.0, "0 to 10 m"),
            ("motion.period", self.motion.period, 0.1, 1000.0, "0.1 to 1000 s"),
        ] {
            if !(low..=high).contains(&got) {
                return wrong(option, number(got), expected);
            }
        }
        if let Some(yaw) = self.gates.iter().filter_map(|gate| gate.yaw).find(|yaw| !(-100.0..=100.0).contains(yaw)) {
            return wrong("gates.yaw", number(yaw), "an angle within ±100 rad");
        }
        if self.solid {
            let mut race = Race::default();
            race.set_track(self);
            race.validate_frames()?;
        }
        Ok(())
    }

    /// Largest number of solid gates over all laps: a plan has two points per gate.
    const MAX_SOLID: usize = 99;
}
