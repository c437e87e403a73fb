//! Wind at every drone, advanced by physics steps.

use flight::random::{Key, Noise};
use flight::wind::{WindParams, WindState};
use nalgebra::Vector3;

use super::WindConfig;
use crate::drone::DroneParams;
use crate::error::OptionError;
use crate::math::{ToFlight as _, ToNalgebra as _};
use crate::state::DroneState;

/// Returns the drag force ½·ρ·C_d·A·‖v‖²·v̂, world frame, N.
///
/// `air_density` is ρ, kg/m³. `drag_area` is C_d·A, m². `relative` is v, the velocity of the air minus that of the
/// drone, world frame, m/s.
///
/// ```
/// use aviary::physics::wind::drag_law;
/// use nalgebra::Vector3;
///
/// let force = drag_law(1.225, 0.01, &Vector3::new(0.0, -2.0, 0.0));
/// assert!((force - Vector3::new(0.0, -0.0245, 0.0)).norm() < 1e-12);
/// ```
#[inline]
pub fn drag_law(air_density: f64, drag_area: f64, relative: &Vector3<f64>) -> Vector3<f64> {
    0.5 * air_density * drag_area * relative.norm() * relative
}

/// Wind at one drone.
#[derive(Debug, Clone, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct Local {
    #[serde(with = "StoredKey")]
    key: Key,
    drag_area: f64,
    #[serde(with = "StoredState")]
    state: WindState<f64>,
}

/// Serialized form of [`Key`].
#[derive(serde::Serialize, serde::Deserialize)]
#[serde(remote = "Key")]
struct StoredKey([u64; 2]);

/// Serialized form of [`WindState`].
#[derive(serde::Serialize, serde::Deserialize)]
#[serde(remote = "WindState<f64>")]
struct StoredState {
    turbulence: [f64; 3],
    filters: [[f64; 2]; 2],
    peak: [f64; 3],
    elapsed: f64,
    calm: f64,
}

/// Wind at the drones of a simulation.
///
/// ```
/// use aviary::drone::DroneModel;
/// use aviary::physics::wind::{WindConfig, WindField, WindModel};
/// use aviary::state::DroneState;
/// use nalgebra::Vector3;
///
/// let params = DroneModel::Cf2x.params();
/// let config = WindConfig { velocity: [3.0, 0.0, 0.0], ..WindConfig::new(WindModel::Constant) };
/// let mut wind = WindField::new(config, &[params.clone()])?;
/// let (force, air) = wind.advance(1.0 / 240.0, 0, &DroneState::default());
/// // ½·ρ·C_d·A·v²
/// assert!((force.x - 0.5 * 1.225 * params.drag_area() * 9.0).abs() < 1e-12);
/// assert_eq!(air, Vector3::new(3.0, 0.0, 0.0));
/// # Ok::<(), aviary::OptionError>(())
/// ```
#[derive(Debug, Clone, serde::Serialize, serde::Deserialize)]
#[serde(try_from = "Stored", into = "Stored")]
pub struct WindField {
    config: WindConfig,
    /// Settings at a drone with a drag area of 1 m², for physics steps of `dt` seconds.
    params: WindParams<f64>,
    dt: f64,
    locals: Vec<Local>,
    /// Physics steps since the start of the episode.
    steps: u64,
}

/// Serialized form of [`WindField`]; the settings determine all other fields.
#[derive(serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct Stored {
    config: WindConfig,
    steps: u64,
    locals: Vec<Local>,
}

impl From<WindField> for Stored {
    fn from(field: WindField) -> Self {
        Self { config: field.config, steps: field.steps, locals: field.locals }
    }
}

impl TryFrom<Stored> for WindField {
    type Error = String;

    fn try_from(stored: Stored) -> Result<Self, String> {
        stored.config.validate().map_err(|error| error.to_string())?;
        if let Some(local) = stored.locals.iter().find(|local| !(0.0..=1e9).contains(&local.drag_area)) {
            return Err(format!("a drag area is {}, expected 0 to 1e9 m²", crate::number(local.drag_area)));
        }
        if stored.steps > 1 << 51 {
            return Err(format!("`steps` is {}, expected fewer than 2^51", stored.steps));
        }
        let Stored { config, steps, locals } = stored;
        Ok(Self { config, params: WindParams::default(), dt: f64::NAN, locals, steps })
    }
}

impl WindField {
    /// Creates the wind at these drones.
    ///
    /// # Errors
    /// [`OptionError`] that names the first setting out of range.
    pub fn new(config: WindConfig, drones: &[DroneParams]) -> Result<Self, OptionError> {
        Self::of_areas(config, drones.iter().map(DroneParams::drag_area))
    }

    /// Creates the wind at drones whose airframes have these drag areas, m².
    pub(crate) fn of_areas(config: WindConfig, areas: impl Iterator<Item = f64>) -> Result<Self, OptionError> {
        config.validate()?;
        let local =
            |airframe| Local { key: Key::default(), drag_area: config.area_of(airframe), state: WindState::default() };
        let mut field = Self {
            config,
            params: WindParams::default(),
            // the settings for this length of a step are those of no step
            dt: f64::NAN,
            locals: areas.map(local).collect(),
            steps: 0,
        };
        field.reset(0, &[]);
        Ok(field)
    }

    /// Replaces the settings and the drag areas of the airframes (m²); the number of drones and the state of the wind
    /// stay the same.
    pub(crate) fn set(&mut self, config: WindConfig, areas: impl Iterator<Item = f64>) -> Result<(), OptionError> {
        config.validate()?;
        for (local, airframe) in self.locals.iter_mut().zip(areas) {
            local.drag_area = config.area_of(airframe);
        }
        (self.config, self.dt) = (config, f64::NAN);
        Ok(())
    }

    /// Sets the drag area of the airframe of a drone, m².
    pub(crate) fn set_area(&mut self, drone: usize, airframe: f64) {
        self.locals[drone].drag_area = self.config.area_of(airframe);
    }

    /// Returns the number of drones.
    pub(crate) fn num_drones(&self) -> usize {
        self.locals.len()
    }

    /// Returns the heap memory of the drones, bytes.
    pub(crate) fn bytes(&self) -> usize {
        size_of_val(&self.locals[..])
    }

    /// Returns the settings.
    pub fn config(&self) -> &WindConfig {
        &self.config
    }

    /// Starts an episode: gives each drone independent random numbers and samples the turbulence from its stationary
    /// distribution.
    pub fn reset(&mut self, seed: u64, states: &[DroneState]) {
        self.steps = 0;
        let params = self.config.params(0.0);
        for (drone, local) in self.locals.iter_mut().enumerate() {
            local.key = Key::new(seed, drone);
            let height = states.get(drone).map_or(0.0, |state| state.position.z);
            local.state = WindState::start(&params, local.key, height);
        }
    }

    /// Advances the wind at one drone by a physics step of `dt` seconds; returns the force on the airframe (world
    /// frame, N) and the velocity of the air (world frame, m/s).
    ///
    /// The caller calls this function once per drone and physics step, in the order of the drones: the last drone
    /// advances the clock.
    pub fn advance(&mut self, dt: f64, drone: usize, state: &DroneState) -> (Vector3<f64>, Vector3<f64>) {
        if self.dt != dt {
            (self.params, self.dt) = (self.config.params(dt), dt);
        }
        let last = drone + 1 == self.locals.len();
        let Some(local) = self.locals.get_mut(drone) else { return (Vector3::zeros(), Vector3::zeros()) };
        let params = WindParams { drag: self.params.drag * local.drag_area, ..self.params };
        let (height, velocity) = (state.position.z, state.velocity.to_flight());
        let noise = local.key.at(self.steps);
        let (force, air) = local.state.advance(params.parts(), dt, &params, noise, height, velocity);
        self.steps += u64::from(last);
        (force.to_nalgebra(), air.to_nalgebra())
    }

    /// Returns the settings of the wind at a drone for physics steps of `dt` seconds, its random numbers in the next
    /// step, and its state.
    pub(super) fn local(&self, dt: f64, drone: usize) -> (WindParams<f64>, Noise, &WindState<f64>) {
        let params = if self.dt == dt { self.params } else { self.config.params(dt) };
        let local = &self.locals[drone];
        (WindParams { drag: params.drag * local.drag_area, ..params }, local.key.at(self.steps), &local.state)
    }

    /// Replaces the random numbers and the state of the wind at a drone, and the number of physics steps since the
    /// start of the episode.
    pub(super) fn set_local(&mut self, drone: usize, key: Key, state: WindState<f64>, steps: u64) {
        let local = &mut self.locals[drone];
        (local.key, local.state, self.steps) = (key, state, steps);
    }
}

#[cfg(test)]
mod tests;
