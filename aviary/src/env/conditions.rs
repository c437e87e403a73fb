use std::path::Path;

use serde::{Deserialize, Serialize};

use super::{AviaryBuilder, EnvError, Randomization};
use crate::physics::wind::WindConfig;
use crate::world::ObstacleConfig;

/// What an episode is flown under, as a configuration file says it: wind, obstacles, randomization. A section that is not
/// there is left alone.
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
/// assert_eq!(env.simulation().world().obstacles.len(), 10);
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Conditions {
    /// The wind.
    pub wind: Option<WindConfig>,
    /// Obstacles.
    pub obstacles: Option<ObstacleConfig>,
    /// What is drawn anew for every episode.
    pub randomization: Option<Randomization>,
}

impl Conditions {
    /// Reads and checks conditions from TOML text.
    ///
    /// # Errors
    /// [`EnvError::Toml`] with line and column, or what is impossible in a section.
    pub fn from_toml(text: &str) -> Result<Self, EnvError> {
        let conditions: Self = toml::from_str(text)
            .map_err(|error| EnvError::Toml { message: crate::error::toml_message(text, &error) })?;
        conditions.validate()?;
        Ok(conditions)
    }

    /// Checks all of them.
    ///
    /// # Errors
    /// What is impossible in a section.
    pub fn validate(&self) -> Result<(), EnvError> {
        if let Some(wind) = &self.wind {
            wind.validate().map_err(|error| EnvError::Simulation(error.into()))?;
        }
        if let Some(obstacles) = &self.obstacles {
            obstacles.validate()?;
        }
        if let Some(randomization) = &self.randomization {
            randomization.validate()?;
        }
        Ok(())
    }

    /// Reads and checks a file.
    ///
    /// # Errors
    /// [`EnvError::Toml`] with the file, the line and what is expected.
    pub fn from_file(path: impl AsRef<Path>) -> Result<Self, EnvError> {
        let path = path.as_ref();
        let in_file = |message: String| EnvError::Toml { message: format!("{}: {message}", path.display()) };
        let text = std::fs::read_to_string(path).map_err(|error| in_file(error.to_string()))?;
        Self::from_toml(&text).map_err(|error| in_file(error.to_string()))
    }
}

impl<T> AviaryBuilder<T> {
    /// Flown under these conditions, as far as they say something.
    #[must_use]
    pub fn conditions(mut self, conditions: &Conditions) -> Self {
        if let Some(wind) = conditions.wind {
            self = self.wind(wind);
        }
        if let Some(obstacles) = &conditions.obstacles {
            self = self.obstacle_field(obstacles.clone());
        }
        if let Some(randomization) = &conditions.randomization {
            self = self.randomization(randomization.clone());
        }
        self
    }
}
