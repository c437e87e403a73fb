//! Configurations as files: reading and writing TOML.

use std::path::Path;

use aviary::SystemError;
use aviary::action::ActionType;
use aviary::env::{ConditionChoice, Conditions, Randomization};
use aviary::physics::Physics;
use aviary::physics::wind::WindConfig;
use aviary::world::ObstacleConfig;
use serde::Deserialize;

use super::{CourseRewards, TrackChoice, TrainConfig, TrainingStart};
use crate::TrainError;
use crate::evaluation::Success;
use crate::ppo::PartialPpo;

/// Settings of a configuration file.
#[derive(Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct PartialConfig {
    drone: Option<String>,
    track: Option<TrackChoice>,
    physics: Option<Physics>,
    num_drones: Option<usize>,
    per_drone: Option<bool>,
    action_type: Option<ActionType>,
    sim_freq: Option<u32>,
    ctrl_freq: Option<u32>,
    episode_seconds: Option<f64>,
    steps: Option<u64>,
    evaluate_every: Option<u64>,
    episodes: Option<usize>,
    checkpoint_every: Option<u64>,
    success: Option<Success>,
    training_starts: Option<Vec<TrainingStart>>,
    out_of_bounds: Option<f32>,
    course: Option<CourseRewards>,
    ppo: PartialPpo,
    // parsed only for line and column of errors: `Conditions` reads these sections again
    wind: Option<WindConfig>,
    obstacles: Option<ObstacleConfig>,
    randomization: Option<Randomization>,
}

impl TrainConfig {
    /// Overrides settings with those of a configuration in TOML.
    ///
    /// # Errors
    /// [`TrainError::Toml`] with line and column; [`TrainError::Env`] for invalid wind, obstacles or randomization.
    pub fn read_toml(&mut self, text: &str) -> Result<(), TrainError> {
        self.read_toml_with(text, &ConditionChoice::default())
    }

    /// Overrides settings with those of a configuration in TOML, with the kinds of wind and obstacles chosen
    /// elsewhere.
    ///
    /// # Errors
    /// As for [`read_toml`](Self::read_toml), and if the file has another kind than the chosen one.
    pub fn read_toml_with(&mut self, text: &str, choice: &ConditionChoice) -> Result<(), TrainError> {
        let file: PartialConfig =
            toml::from_str(text).map_err(|error| TrainError::Toml { message: aviary::toml_message(text, &error) })?;
        let mut table: toml::Table = text.parse().map_err(wrong)?;
        let conditions = toml::to_string(&take_conditions(&mut table)).map_err(wrong)?;
        let conditions = Conditions::from_toml_with(&conditions, choice)?;
        macro_rules! take {
            ($($field:ident)*) => {$(
                if let Some(value) = file.$field {
                    self.$field = value;
                }
            )*};
        }
        take!(
            drone physics per_drone action_type sim_freq ctrl_freq steps evaluate_every episodes checkpoint_every
            success out_of_bounds
        );
        self.training_starts = file.training_starts.unwrap_or(std::mem::take(&mut self.training_starts));
        self.num_drones = file.num_drones.or(self.num_drones);
        self.track = file.track.or(self.track.take());
        self.course = file.course.or(self.course);
        self.episode_seconds = file.episode_seconds.or(self.episode_seconds);
        file.ppo.apply(&mut self.ppo);
        self.conditions.wind = conditions.wind.or(self.conditions.wind);
        self.conditions.obstacles = conditions.obstacles.or(self.conditions.obstacles.take());
        if let Some(randomization) = conditions.randomization {
            self.randomize(randomization);
        }
        self.conditions.validate()?;
        Ok(())
    }

    /// Returns the configuration as TOML.
    ///
    /// # Errors
    /// [`TrainError::Toml`] for values that TOML cannot represent.
    pub fn to_toml(&self) -> Result<String, TrainError> {
        let mut table = toml::Table::try_from(self).map_err(wrong)?;
        // these are options of the command line
        for key in ["task", "seed", "device", "until_success"] {
            table.remove(key);
        }
        if let Some(toml::Value::Table(conditions)) = table.remove("conditions") {
            table.extend(conditions);
        }
        toml::to_string_pretty(&table).map_err(wrong)
    }

    /// Overrides settings with those of a configuration file.
    ///
    /// # Errors
    /// [`TrainError::File`] with the path and the error of [`read_toml`](Self::read_toml).
    pub fn read_file(&mut self, path: impl AsRef<Path>) -> Result<(), TrainError> {
        self.read_file_with(path, &ConditionChoice::default())
    }

    /// Overrides settings with those of a configuration file, with the kinds of wind and obstacles chosen
    /// elsewhere.
    ///
    /// # Errors
    /// [`TrainError::File`] with the path and the error of [`read_toml_with`](Self::read_toml_with).
    pub fn read_file_with(&mut self, path: impl AsRef<Path>, choice: &ConditionChoice) -> Result<(), TrainError> {
        let path = path.as_ref();
        let in_file = |error| TrainError::File { path: path.into(), error: Box::new(error) };
        let text = std::fs::read_to_string(path).map_err(|error| in_file(SystemError::from(error).into()))?;
        self.read_toml_with(&text, choice).map_err(in_file)
    }
}

/// Removes the sections that [`Conditions`] reads from a configuration, and returns them.
pub(super) fn take_conditions(table: &mut toml::Table) -> toml::Table {
    ["wind", "obstacles", "randomization"].iter().filter_map(|section| table.remove_entry(*section)).collect()
}

pub(super) fn wrong(error: impl ToString) -> TrainError {
    TrainError::Toml { message: error.to_string() }
}
