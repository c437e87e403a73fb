//! Wind at every drone, advanced by physics steps.

use crate::error::OptionError;
use nalgebra::Vector3;
use rand::{RngExt as _, SeedableRng as _};

use super::dryden::{SecondOrder, dryden, feet};
use super::{DrydenFilter, WindConfig, WindModel};
use crate::drone::DroneParams;
use crate::random::{Rng, normals};
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

/// Gust and turbulence of one drone.
#[derive(Debug, Clone, serde::Serialize, serde::Deserialize)]
struct Local {
    rng: Rng,
    drag_area: f64,
    /// Longitudinal, lateral and vertical velocity of the turbulence, m/s. The second-order filters replace the
    /// lateral and the vertical component.
    turbulence: [f64; 3],
    /// Second-order filters of the lateral and the vertical component.
    filters: [SecondOrder; 2],
    /// Cached height in feet with the standard deviations and length scales at that height.
    #[serde(skip)]
    constants: (f64, [f64; 3], [f64; 3]),
    /// Unused second sample of the last pair of normal samples.
    spare: Option<f64>,
    /// Amplitude of the gust (world frame, N) and its elapsed fraction, 0 to 1; the fraction is 1 between gusts.
    #[serde(with = "crate::serial::vector_and_number")]
    gust: (Vector3<f64>, f64),
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
    velocity: Vector3<f64>,
    /// Longitudinal, lateral (to the left) and vertical axis of the turbulence.
    axes: [Vector3<f64>; 3],
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
        if stored.steps > 1 << 60 {
            return Err(format!("`steps` is {}, expected fewer than 2^60", stored.steps));
        }
        let Stored { config, steps, locals } = stored;
        let mut field = Self { config, velocity: Vector3::zeros(), axes: [Vector3::zeros(); 3], locals, steps };
        field.take(config);
        Ok(field)
    }
}

impl WindField {
    /// Minimum airspeed of the turbulence filters, m/s: at zero airspeed the turbulence would stay constant.
    const MIN_AIRSPEED: f64 = 0.5;

    /// Creates the wind at these drones.
    ///
    /// # Errors
    /// [`OptionError`] that names the first setting out of range.
    pub fn new(config: WindConfig, drones: &[DroneParams]) -> Result<Self, OptionError> {
        Self::of_areas(config, drones.iter().map(DroneParams::drag_area))
    }

    /// Creates the wind at drones of these drag areas, m².
    pub(crate) fn of_areas(config: WindConfig, areas: impl Iterator<Item = f64>) -> Result<Self, OptionError> {
        config.validate()?;
        let local = |drag_area: f64| Local {
            rng: Rng::seed_from_u64(0),
            drag_area,
            turbulence: [0.0; 3],
            filters: [SecondOrder::default(); 2],
            constants: (0.0, [0.0; 3], [1.0; 3]),
            spare: None,
            gust: (Vector3::zeros(), 1.0),
        };
        let mut field = Self {
            config,
            velocity: Vector3::zeros(),
            axes: [Vector3::zeros(); 3],
            locals: areas.map(local).collect(),
            steps: 0,
        };
        field.take(config);
        field.reset(0, &[]);
        Ok(field)
    }

    /// Replaces the settings and the drag areas (m²) and restarts the wind; the number of drones stays the same.
    pub(crate) fn set(&mut self, config: WindConfig, areas: impl Iterator<Item = f64>) -> Result<(), OptionError> {
        config.validate()?;
        for (local, drag_area) in self.locals.iter_mut().zip(areas) {
            // a height of 0 invalidates the cached constants, which depend on the settings
            (local.drag_area, local.constants.0) = (drag_area, 0.0);
        }
        self.take(config);
        self.reset(0, &[]);
        Ok(())
    }

    fn take(&mut self, config: WindConfig) {
        let velocity = Vector3::from(config.velocity);
        let level = Vector3::new(velocity.x, velocity.y, 0.0);
        let along = if level.norm() > 1e-9 { level.normalize() } else { Vector3::x() };
        self.axes = [along, Vector3::z().cross(&along), Vector3::z()];
        (self.config, self.velocity) = (config, velocity);
    }

    /// Sets the drag area of a drone, m².
    pub(crate) fn set_area(&mut self, drone: usize, drag_area: f64) {
        self.locals[drone].drag_area = drag_area;
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

    /// Starts an episode: seeds an independent random stream for each drone and samples the turbulence from its
    /// stationary distribution.
    pub fn reset(&mut self, seed: u64, states: &[DroneState]) {
        self.steps = 0;
        for (drone, local) in self.locals.iter_mut().enumerate() {
            local.rng = Rng::seed_from_u64(seed);
            local.rng.set_stream(1 + drone as u64);
            local.gust = (Vector3::zeros(), 1.0);
            local.spare = None;
            let height = states.get(drone).map_or(0.0, |state| state.position.z);
            let (sigma, _) = dryden(height, self.config.turbulence);
            let [a, b] = normals(&mut local.rng);
            let [c, _] = normals(&mut local.rng);
            local.turbulence = [a * sigma[0], b * sigma[1], c * sigma[2]];
            if self.config.filter == DrydenFilter::MilF8785c {
                local.filters = [(); 2].map(|()| SecondOrder::stationary(normals(&mut local.rng)));
            }
        }
    }

    /// Advances the wind at one drone by a physics step of `dt` seconds; returns the force on the airframe (world
    /// frame, N) and the velocity of the air (world frame, m/s).
    ///
    /// The caller calls this function once per drone and physics step, in the order of the drones: the last drone
    /// advances the clock.
    pub fn advance(&mut self, dt: f64, drone: usize, state: &DroneState) -> (Vector3<f64>, Vector3<f64>) {
        let Self { config, velocity, axes, locals, steps } = self;
        let last = drone + 1 == locals.len();
        let Some(local) = locals.get_mut(drone) else { return (Vector3::zeros(), Vector3::zeros()) };
        let (mut force, mut air) = (Vector3::zeros(), Vector3::zeros());
        if config.model.has(WindModel::Constant) {
            air += *velocity;
        }
        if config.model.has(WindModel::Dryden) {
            let airspeed = (*velocity - state.velocity).norm().max(Self::MIN_AIRSPEED);
            // near the ground, where most drones fly, the clamped height and so the constants do not change
            let h = feet(state.position.z);
            if local.constants.0 != h {
                let (sigma, length) = dryden(state.position.z, config.turbulence);
                local.constants = (h, sigma, length);
            }
            let (_, sigma, length) = local.constants;
            let [a, b] = normals(&mut local.rng);
            // α = exp(−dt·V/L); the longitudinal and the lateral length scale are equal
            let level = (-dt * airspeed / length[0]).exp();
            let spread = (1.0 - level * level).sqrt();
            let [x, y, z] = &mut local.turbulence;
            *x = level * *x + sigma[0] * spread * a;
            let parts = match config.filter {
                DrydenFilter::FirstOrder => {
                    let c = match local.spare.take() {
                        Some(spare) => spare,
                        None => {
                            let [now, next] = normals(&mut local.rng);
                            local.spare = Some(next);
                            now
                        }
                    };
                    let upwards = (-dt * airspeed / length[2]).exp();
                    *y = level * *y + sigma[1] * spread * b;
                    *z = upwards * *z + sigma[2] * (1.0 - upwards * upwards).sqrt() * c;
                    [*x, *y, *z]
                }
                DrydenFilter::MilF8785c => {
                    let [across, up] = &mut local.filters;
                    let [c, d] = normals(&mut local.rng);
                    let e = match local.spare.take() {
                        Some(spare) => spare,
                        None => {
                            let [now, next] = normals(&mut local.rng);
                            local.spare = Some(next);
                            now
                        }
                    };
                    across.advance(dt * airspeed / length[1], [b, c]);
                    up.advance(dt * airspeed / length[2], [d, e]);
                    [*x, sigma[1] * across.output(), sigma[2] * up.output()]
                }
            };
            air += axes[0] * parts[0] + axes[1] * parts[1] + axes[2] * parts[2];
        }
        // the drag law is not linear, so that velocities are added before it
        if config.has_drag() {
            force += drag_law(config.air_density, local.drag_area, &(air - state.velocity));
        }
        if config.model.has(WindModel::Gust) {
            let (peak, over) = &mut local.gust;
            if *over >= 1.0 {
                if local.rng.random::<f64>() < config.gust_rate * dt {
                    // height and azimuth are uniform for a uniform direction on the sphere
                    let (up, azimuth) = (2.0 * local.rng.random::<f64>() - 1.0, local.rng.random::<f64>());
                    let (sin, cos) = (std::f64::consts::TAU * azimuth).sin_cos();
                    let level = (1.0 - up * up).sqrt();
                    *peak = Vector3::new(level * cos, level * sin, up) * config.gust_force * local.rng.random::<f64>();
                    *over = 0.0;
                }
            } else {
                *over = (*over + dt / config.gust_duration).min(1.0);
            }
            if *over < 1.0 {
                force += *peak * (std::f64::consts::PI * *over).sin();
            }
        }
        if config.model.has(WindModel::Sinusoidal) {
            let phase = config.sinusoidal_frequency * *steps as f64 * dt;
            let (sin, cos) = phase.sin_cos();
            force += config.sinusoidal_force * Vector3::new(sin, cos, 0.6 * sin * cos);
        }
        *steps += u64::from(last);
        (force, air)
    }
}

#[cfg(test)]
mod tests;
