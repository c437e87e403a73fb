//! Wind models and their settings.

use flight::wind::{SIGMA_OF_WIND, WindParams, max_speed};
use serde::{Deserialize, Serialize};

use super::DrydenFilter;
use crate::error::OptionError;
use crate::math::ln;
use crate::names::named_enum;

named_enum! {
    "wind"
    /// Wind models.
    #[derive(Default)]
    pub enum WindModel {
        /// Still air.
        #[default]
        None = "none",
        /// Air that moves at a constant velocity.
        Constant = "constant",
        /// Forces of random start times, directions and amplitudes.
        Gust = "gust",
        /// Air that moves at the velocity of Dryden turbulence, with the spectra of [`DrydenFilter`].
        Dryden = "dryden",
        /// Force that oscillates at a constant angular frequency.
        Sinusoidal = "sinusoidal",
        /// All four: the air moves at the sum of the constant velocity and the turbulence; the forces of gusts and of
        /// the sinusoidal wind are added.
        Combined = "combined",
    }
}

impl WindModel {
    #[inline]
    pub(super) fn has(self, part: Self) -> bool {
        self == part || self == Self::Combined
    }
}

/// Settings of the wind.
///
/// Each drone has independent gusts and turbulence. The constant and the sinusoidal wind are equal for all drones.
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
    /// Wind model.
    pub model: WindModel,
    /// Velocity of the constant wind, world frame, m/s; default 0.9 m/s along y, as in the paper. Its horizontal
    /// direction is the longitudinal axis of the turbulence.
    #[serde(deserialize_with = "crate::error::triple")]
    pub velocity: [f64; 3],
    /// Maximum amplitude of a gust, N; amplitudes are uniform in 0 to this value, directions uniform on the sphere.
    pub gust_force: f64,
    /// Duration of a gust, s; its force follows sin(π·s) for s from 0 to 1.
    pub gust_duration: f64,
    /// Average number of gusts per second of calm: a gust starts in a physics step with probability `gust_rate`·dt.
    pub gust_rate: f64,
    /// Mean wind speed 20 feet (6 m) above the ground, which scales the turbulence, m/s: σ_w is a tenth of it (see
    /// [`dryden`](super::dryden)).
    pub turbulence: f64,
    /// Spectra of the turbulence.
    pub filter: DrydenFilter,
    /// Amplitude A of the sinusoidal force, N.
    pub sinusoidal_force: f64,
    /// Angular frequency ω of the sinusoidal force, rad/s.
    pub sinusoidal_frequency: f64,
    /// Density of the air, kg/m³.
    pub air_density: f64,
    /// Drag area C_d·A of every drone, m²; `None` for [that of its airframe](crate::drone::DroneParams::drag_area).
    pub drag_area: Option<f64>,
    /// True to apply the drag law in still air as well: with model `none`, with gusts or the sinusoidal force alone,
    /// and with a constant wind of zero velocity; default false. The drag law always applies in moving air.
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
            drag_area: None,
            still_air_drag: false,
        }
    }
}

impl WindConfig {
    /// Creates the default settings of a wind model.
    pub fn new(model: WindModel) -> Self {
        Self { model, ..Self::default() }
    }

    /// Checks every setting.
    ///
    /// # Errors
    /// [`OptionError`] that names the first setting out of range.
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
        OptionError::check("wind.drag_area", self.drag_area.unwrap_or(0.0), 0.0..=1e3, "0 to 1000 m²")
    }

    /// Returns the drag area of a drone whose airframe has this drag area, m².
    pub fn area_of(&self, airframe: f64) -> f64 {
        self.drag_area.unwrap_or(airframe)
    }

    /// Returns the settings at a drone with a drag area of 1 m², for physics steps of `dt` seconds, as the equations of
    /// the crate `flight` read them.
    pub fn params(&self, dt: f64) -> WindParams<f64> {
        let has = |part, number: f64| if self.model.has(part) { number } else { 0.0 };
        // adding zero removes the sign of a zero
        let mean = self.velocity.map(|x| x + 0.0);
        let [x, y, _] = mean;
        let level = (x * x + y * y).sqrt();
        let sigma = has(WindModel::Dryden, SIGMA_OF_WIND * self.turbulence);
        let second_order = sigma > 0.0 && self.filter == DrydenFilter::MilF8785c;
        let gusts = self.gust_force > 0.0 && self.model.has(WindModel::Gust);
        let probability = if gusts { self.gust_rate * dt } else { 0.0 };
        WindParams {
            mean,
            constant: mean.map(|x| has(WindModel::Constant, x)),
            along: if level > 1e-9 { [x / level, y / level] } else { [1.0, 0.0] },
            sigma,
            second_order: f64::from(u8::from(second_order)),
            drag: if self.has_drag() { 0.5 * self.air_density } else { 0.0 },
            gust_force: has(WindModel::Gust, self.gust_force),
            gust_hazard: if probability < 1.0 { -ln(1.0 - probability) + 0.0 } else { f64::INFINITY },
            gust_share: dt / self.gust_duration,
            sinusoidal_force: has(WindModel::Sinusoidal, self.sinusoidal_force),
            sinusoidal_turns: self.sinusoidal_frequency * dt / std::f64::consts::TAU,
        }
    }

    /// Returns true if the drag law applies: in moving air, or in still air if
    /// [`still_air_drag`](Self::still_air_drag) is set.
    pub(crate) fn has_drag(&self) -> bool {
        self.still_air_drag
            || self.model.has(WindModel::Constant) && self.velocity != [0.0; 3]
            || self.model.has(WindModel::Dryden) && self.turbulence > 0.0
    }

    /// Returns coefficients that bound the force (N) on an airframe of a drag area (m²) at a speed v (m/s):
    /// c₀ + c₁·v + c₂·v².
    pub(crate) fn bound(&self, drag_area: f64) -> [f64; 3] {
        let drag_area = self.area_of(drag_area);
        let has = |part| self.model.has(part);
        let air = self.air_speed_bound();
        let drag = if self.has_drag() { 0.5 * self.air_density * drag_area } else { 0.0 };
        let gust = if has(WindModel::Gust) { self.gust_force } else { 0.0 };
        // A·(sin, cos, 0.6·sin·cos) is at most A·√1.09 long
        let sinusoidal = if has(WindModel::Sinusoidal) { 1.05 * self.sinusoidal_force } else { 0.0 };
        // a margin for rounding
        [drag * air * air + gust + sinusoidal, 2.0 * drag * air, drag].map(|x| x * 1.000_001)
    }

    /// Returns an upper bound of the speed of the air, m/s.
    pub(crate) fn air_speed_bound(&self) -> f64 {
        let has = |part| self.model.has(part);
        let constant = if has(WindModel::Constant) { nalgebra::Vector3::from(self.velocity).norm() } else { 0.0 };
        constant + if has(WindModel::Dryden) { max_speed(self.turbulence) } else { 0.0 }
    }

    /// Returns true if a flight with these settings is equal to a flight without wind.
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
    fn settings_out_of_range_are_errors_that_name_the_field() {
        let refused = |config: WindConfig, text: &str| {
            assert!(config.validate().unwrap_err().to_string().starts_with(text));
        };
        refused(WindConfig { velocity: [0.0, f64::NAN, 0.0], ..WindConfig::default() }, "wind.velocity is NaN");
        refused(WindConfig { turbulence: -1.0, ..WindConfig::default() }, "wind.turbulence is -1");
        refused(WindConfig { gust_duration: 0.0, ..WindConfig::default() }, "wind.gust_duration is 0");
        let error = toml::from_str::<WindConfig>("filter = \"mil\"").unwrap_err().to_string();
        assert!(error.contains("first_order") && error.contains("mil_f_8785c"), "{error}");
        refused(WindConfig { drag_area: Some(-0.01), ..WindConfig::default() }, "wind.drag_area is -0.01");
        refused(WindConfig { air_density: f64::INFINITY, ..WindConfig::default() }, "wind.air_density is inf");
    }
}
