//! Models of the wind and their settings.

use crate::error::OptionError;
use serde::{Deserialize, Serialize};

use super::DrydenFilter;
use crate::names::named_enum;

named_enum! {
    "wind"
    /// Which winds blow.
    #[derive(Default)]
    pub enum WindModel {
        /// Still air.
        #[default]
        None = "none",
        /// Air that moves at a constant velocity.
        Constant = "constant",
        /// Forces that start at random times.
        Gust = "gust",
        /// Air that moves as Dryden turbulence does, through the filters of [`DrydenFilter`].
        Dryden = "dryden",
        /// A force that turns at a constant rate.
        Sinusoidal = "sinusoidal",
        /// All four: the air moves at the sum of the constant velocity and the turbulence; gusts and the sinusoidal force add.
        Combined = "combined",
    }
}

impl WindModel {
    #[inline]
    pub(super) fn has(self, part: Self) -> bool {
        self == part || self == Self::Combined
    }
}

/// A wind. Every drone has its own gusts and its own turbulence; the steady and the sinusoidal wind are the same for all.
///
/// ```
/// use aviary::physics::wind::{WindConfig, WindModel};
///
/// let wind = WindConfig { velocity: [3.0, 0.0, 0.0], ..WindConfig::new(WindModel::Constant) };
/// assert!(wind.validate().is_ok());
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct WindConfig {
    /// Which winds blow.
    pub model: WindModel,
    /// Velocity of the steady wind, world frame, m/s; 0.9 m/s along y by default, the paper's figure. Turbulence is along and
    /// across it.
    #[serde(deserialize_with = "crate::error::triple")]
    pub velocity: [f64; 3],
    /// Largest force of a gust, N; each one's is uniform up to it, its direction uniform over all.
    pub gust_force: f64,
    /// Length of a gust, s; its force follows sin(π·s), s from 0 to 1.
    pub gust_duration: f64,
    /// Gusts per second on average while there is none: one begins in a physics step with this probability times its length.
    pub gust_rate: f64,
    /// Mean wind 20 feet (6 m) above the ground that the turbulence belongs to, m/s: σ_w is a tenth of it ([`dryden`](super::dryden)).
    pub turbulence: f64,
    /// Spectra of the turbulence.
    pub filter: DrydenFilter,
    /// Amplitude A of the sinusoidal force, N.
    pub sinusoidal_force: f64,
    /// Its angular frequency ω, rad/s.
    pub sinusoidal_frequency: f64,
    /// Density of the air, kg/m³.
    pub air_density: f64,
    /// True if the drag law acts in still air, too: with model `none`, for gusts and the sinusoidal force alone, and for a
    /// wind of zero velocity; off by default. The drag law always acts in air that moves.
    pub still_air_drag: bool,
}

impl Default for WindConfig {
    fn default() -> Self {
        Self {
            model: WindModel::None,
            velocity: [0.0, 0.9, 0.0],
            gust_force: 0.02,
            gust_duration: 0.5,
            gust_rate: 0.3,
            turbulence: 3.0,
            filter: DrydenFilter::FirstOrder,
            sinusoidal_force: 0.002,
            sinusoidal_frequency: 1.0,
            air_density: 1.225,
            still_air_drag: false,
        }
    }
}

impl WindConfig {
    /// The defaults of a wind.
    pub fn new(model: WindModel) -> Self {
        Self { model, ..Self::default() }
    }

    /// Checks every setting.
    ///
    /// # Errors
    /// [`OptionError`] naming one that is impossible.
    pub fn validate(&self) -> Result<(), OptionError> {
        for got in self.velocity {
            OptionError::check("wind.velocity", got, -1e3..=1e3, "finite numbers up to 1000 m/s")?;
        }
        OptionError::check("wind.gust_duration", self.gust_duration, 1e-3..=1e3, "1 ms to 1000 s")?;
        for (option, got) in [
            ("wind.gust_force", self.gust_force),
            ("wind.gust_rate", self.gust_rate),
            ("wind.turbulence", self.turbulence),
            ("wind.sinusoidal_force", self.sinusoidal_force),
            ("wind.sinusoidal_frequency", self.sinusoidal_frequency),
            ("wind.air_density", self.air_density),
        ] {
            OptionError::check(option, got, 0.0..=1e3, "0 to 1000")?;
        }
        Ok(())
    }

    /// Whether the drag law acts: in air that moves, and in still air where [`still_air_drag`](Self::still_air_drag) says so.
    pub(crate) fn has_drag(&self) -> bool {
        self.still_air_drag
            || self.model.has(WindModel::Constant) && self.velocity != [0.0; 3]
            || self.model.has(WindModel::Dryden) && self.turbulence > 0.0
    }

    /// Returns whether a flight under these settings is a flight without wind.
    ///
    /// ```
    /// use aviary::physics::wind::{WindConfig, WindModel};
    ///
    /// let calm = WindConfig { velocity: [0.0; 3], ..WindConfig::new(WindModel::Constant) };
    /// assert!(calm.is_calm() && WindConfig::default().is_calm());
    /// assert!(!WindConfig { still_air_drag: true, ..calm }.is_calm());
    /// ```
    pub fn is_calm(&self) -> bool {
        let gusts = self.model.has(WindModel::Gust) && self.gust_force > 0.0 && self.gust_rate > 0.0;
        let sinusoidal = self.model.has(WindModel::Sinusoidal) && self.sinusoidal_force > 0.0;
        !(self.has_drag() || gusts || sinusoidal)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn impossible_winds_are_refused_by_field() {
        let refused = |config: WindConfig, text: &str| {
            assert!(config.validate().unwrap_err().to_string().starts_with(text));
        };
        refused(WindConfig { velocity: [0.0, f64::NAN, 0.0], ..WindConfig::default() }, "wind.velocity is NaN");
        refused(WindConfig { turbulence: -1.0, ..WindConfig::default() }, "wind.turbulence is -1");
        refused(WindConfig { gust_duration: 0.0, ..WindConfig::default() }, "wind.gust_duration is 0");
        let error = toml::from_str::<WindConfig>("filter = \"mil\"").unwrap_err().to_string();
        assert!(error.contains("first_order") && error.contains("mil_f_8785c"), "{error}");
        refused(WindConfig { air_density: f64::INFINITY, ..WindConfig::default() }, "wind.air_density is inf");
    }
}
