use std::path::Path;

use serde::{Deserialize, Serialize};

use super::{AviaryBuilder, EnvError, Randomization};
use crate::SystemError;
use crate::physics::wind::{WindConfig, WindModel};
use crate::world::{ObstacleConfig, ObstacleKind};

/// Conditions of an episode from a configuration file: wind, obstacles, randomization. A missing section changes
/// nothing.
///
/// ```
/// use aviary::env::{Conditions, EnvConfig};
/// use aviary::tasks::make;
///
/// let conditions = Conditions::from_toml(
///     r#"
///     [wind]
///     model = "combined"
///     velocity = [0.5, 0.0, 0.0]
///
///     [obstacles]
///     kind = "forest"
///     count = 10
///     new_layout = true
///
///     [randomization.body]
///     mass = [0.9, 1.1]
///     "#,
/// )?;
/// let env = make("hover", EnvConfig::default().conditions(&conditions))?;
/// assert_eq!(env.simulation().obstacles().len(), 10);
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Conditions {
    /// The wind.
    pub wind: Option<WindConfig>,
    /// Obstacles.
    pub obstacles: Option<ObstacleConfig>,
    /// Parameters that are sampled for every episode.
    pub randomization: Option<Randomization>,
}

/// Kinds selected outside the configuration file, for example on a command line.
///
/// The sections of the file give the numbers. A section that names a different kind is an error.
///
/// ```
/// use aviary::env::{ConditionChoice, Conditions};
/// use aviary::world::ObstacleKind;
///
/// let choice = ConditionChoice { obstacles: Some(ObstacleKind::Urban), ..ConditionChoice::default() };
/// let conditions = Conditions::from_toml_with("[obstacles]\nspacing = 0.3\n", &choice)?;
/// assert_eq!(conditions.obstacles.map(|obstacles| (obstacles.count, obstacles.spacing)), Some((8, 0.3)));
/// assert!(Conditions::from_toml_with("[obstacles]\nkind = \"forest\"\n", &choice).is_err());
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ConditionChoice {
    /// Wind model; `None` for the file's.
    pub wind: Option<WindModel>,
    /// Kind of obstacles; `None` for the file's.
    pub obstacles: Option<ObstacleKind>,
}

impl ConditionChoice {
    /// Writes the selected kinds into the sections of a file.
    fn apply(&self, table: &mut toml::Table) -> Result<(), EnvError> {
        let choices = [
            ("wind", "model", self.wind.map(WindModel::name)),
            ("obstacles", "kind", self.obstacles.map(ObstacleKind::name)),
        ];
        for (section, key, chosen) in choices {
            let Some(chosen) = chosen else { continue };
            let entry = table.entry(section).or_insert_with(|| toml::Table::new().into());
            // an entry that is not a table has already been rejected
            let Some(section_table) = entry.as_table_mut() else { continue };
            if let Some(own) = section_table.insert(key.into(), chosen.into())
                && own.as_str() != Some(chosen)
            {
                let message =
                    format!("[{section}] has {key} = {own} next to the option `{chosen}`, expected one of the two");
                return Err(EnvError::Toml { message });
            }
        }
        Ok(())
    }
}

impl Conditions {
    /// Reads and validates conditions from TOML text.
    ///
    /// # Errors
    /// [`EnvError::Toml`] with line and column, or the error of an invalid section.
    pub fn from_toml(text: &str) -> Result<Self, EnvError> {
        Self::from_toml_with(text, &ConditionChoice::default())
    }

    /// Reads and validates conditions from TOML text with the selected kinds.
    ///
    /// # Errors
    /// [`EnvError::Toml`] with line and column, or for a kind that differs from the selected one; otherwise the
    /// error of an invalid section.
    pub fn from_toml_with(text: &str, choice: &ConditionChoice) -> Result<Self, EnvError> {
        let wrong = |error: toml::de::Error| EnvError::Toml { message: crate::error::toml_message(text, &error) };
        let mut conditions: Self = toml::from_str(text).map_err(wrong)?;
        let mut table: toml::Table = text.parse().map_err(wrong)?;
        let wind = table.get("wind").and_then(toml::Value::as_table);
        // these also act in still air or on a sampled wind
        let independent = ["still_air_drag", "filter", "air_density", "drag_area"];
        let needs_model = |wind: &toml::Table| {
            !wind.contains_key("model") && wind.keys().any(|key| !independent.contains(&key.as_str()))
        };
        if choice.wind.is_none() && wind.is_some_and(needs_model) {
            let message =
                "[wind] has no model, expected one of constant, gust, dryden, sinusoidal, combined and none".into();
            return Err(EnvError::Toml { message });
        }
        if *choice != ConditionChoice::default() {
            // defaults depend on the kind, so the table must contain it
            choice.apply(&mut table)?;
            conditions =
                table.try_into().map_err(|error: toml::de::Error| EnvError::Toml { message: error.to_string() })?;
        }
        conditions.validate()?;
        Ok(conditions)
    }

    /// Validates all sections.
    ///
    /// # Errors
    /// [`EnvError`] for an invalid number in a section, or for a wind together with a randomization that samples
    /// the wind.
    pub fn validate(&self) -> Result<(), EnvError> {
        if let Some(wind) = &self.wind {
            wind.validate().map_err(|error| EnvError::Simulation(error.into()))?;
        }
        if let Some(obstacles) = &self.obstacles {
            obstacles.validate()?;
        }
        if let Some(randomization) = &self.randomization {
            randomization.validate()?;
            if let Some(wind) = &self.wind {
                randomization.validate_wind(wind)?;
            }
        }
        Ok(())
    }

    /// Reads and validates a file.
    ///
    /// # Errors
    /// [`EnvError::File`] with the path and the error of the file or of [`from_toml`](Self::from_toml).
    pub fn from_file(path: impl AsRef<Path>) -> Result<Self, EnvError> {
        Self::from_file_with(path, &ConditionChoice::default())
    }

    /// Reads and validates a file with the selected kinds.
    ///
    /// # Errors
    /// [`EnvError::File`] with the path and the error of the file or of [`from_toml_with`](Self::from_toml_with).
    pub fn from_file_with(path: impl AsRef<Path>, choice: &ConditionChoice) -> Result<Self, EnvError> {
        let path = path.as_ref();
        let in_file = |error| EnvError::File { path: path.into(), error: Box::new(error) };
        let text = std::fs::read_to_string(path).map_err(|error| in_file(SystemError::from(error).into()))?;
        Self::from_toml_with(&text, choice).map_err(in_file)
    }
}

impl<T> AviaryBuilder<T> {
    /// Sets the wind, the obstacle generator and the randomization, if the conditions have them.
    #[must_use]
    pub fn conditions(mut self, conditions: &Conditions) -> Self {
        if let Some(wind) = conditions.wind {
            self = self.wind(wind);
        }
        if let Some(obstacles) = &conditions.obstacles {
            self = self.obstacle_generator(obstacles.clone());
        }
        if let Some(randomization) = &conditions.randomization {
            self = self.randomization(randomization.clone());
        }
        self
    }
}
