//! The wind about drones: one step of every model.

use crate::error::OptionError;
use nalgebra::Vector3;
use rand::{RngExt as _, SeedableRng as _};

use super::dryden::{SecondOrder, dryden, feet};
use super::{DrydenFilter, WindConfig, WindModel};
use crate::drone::DroneParams;
use crate::random::{Rng, normals};
use crate::state::DroneState;

/// Force of air that moves at `relative` (velocity of the air minus that of the drone, m/s): ½·ρ·C_d·A·‖v‖²·v̂, N.
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

/// One drone's gust and turbulence.
#[derive(Debug, Clone, serde::Serialize, serde::Deserialize)]
struct Local {
    rng: Rng,
    drag_area: f64,
    /// Velocity of the turbulence along the mean wind, across it and upwards, m/s; of the latter two nothing by the filters
    /// of second order.
    turbulence: [f64; 3],
    /// Filters of second order, across the mean wind and upwards.
    filters: [SecondOrder; 2],
    /// The turbulence's constants at a height within the model's limits.
    #[serde(skip)]
    constants: (f64, [f64; 3], [f64; 3]),
    /// A normal draw that is left over.
    spare: Option<f64>,
    /// Force at its height (world frame, N) and how much of it is over, 0 to 1; 1 while there is none.
    #[serde(with = "crate::serial::vector_and_number")]
    gust: (Vector3<f64>, f64),
}

/// The wind about the drones of a simulation.
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
    /// Axes of the turbulence: along the mean wind, to its left, up.
    axes: [Vector3<f64>; 3],
    locals: Vec<Local>,
    /// Steps since the episode began.
    steps: u64,
}

/// [`WindField`] as it is serialized; the rest follows from the settings.
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
            return Err(format!("a drag area is {}, expected 0 to 1e9 m²", local.drag_area));
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
    /// Speed of a drone through the turbulence that is assumed at least, m/s: in still air it would otherwise stand.
    const MIN_AIRSPEED: f64 = 0.5;

    /// About these drones.
    ///
    /// # Errors
    /// [`OptionError`].
    pub fn new(config: WindConfig, drones: &[DroneParams]) -> Result<Self, OptionError> {
        Self::of_areas(config, drones.iter().map(DroneParams::drag_area))
    }

    /// About drones of these drag areas, m².
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

    /// Another wind about drones of these drag areas (m²), as many as before.
    pub(crate) fn set(&mut self, config: WindConfig, areas: impl Iterator<Item = f64>) -> Result<(), OptionError> {
        config.validate()?;
        for (local, drag_area) in self.locals.iter_mut().zip(areas) {
            // the turbulence's constants are those of the wind
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

    /// Changes the drag area of a drone, m².
    pub(crate) fn set_area(&mut self, drone: usize, drag_area: f64) {
        self.locals[drone].drag_area = drag_area;
    }

    /// Number of drones.
    pub(crate) fn num_drones(&self) -> usize {
        self.locals.len()
    }

    /// Bytes that it takes for its drones.
    pub(crate) fn bytes(&self) -> usize {
        size_of_val(&self.locals[..])
    }

    /// The settings.
    pub fn config(&self) -> &WindConfig {
        &self.config
    }

    /// Starts an episode: a random stream of its own for every drone, and turbulence that has always been there.
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

    /// Goes through a physics step of `dt` seconds with a drone: the force on its airframe (world frame, N) and the
    /// velocity of the air about it (world frame, m/s). Call it once per drone and step, the last drone last.
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
            // near the ground, where drones fly, the constants are always the same
            let h = feet(state.position.z);
            if local.constants.0 != h {
                let (sigma, length) = dryden(state.position.z, config.turbulence);
                local.constants = (h, sigma, length);
            }
            let (_, sigma, length) = local.constants;
            let [a, b] = normals(&mut local.rng);
            // α = exp(−dt·V/L); along and across the wind L is the same
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
        // velocities of one air mass are summed before the law, which is not linear
        if config.has_drag() {
            force += drag_law(config.air_density, local.drag_area, &(air - state.velocity));
        }
        if config.model.has(WindModel::Gust) {
            let (peak, over) = &mut local.gust;
            if *over >= 1.0 {
                if local.rng.random::<f64>() < config.gust_rate * dt {
                    // uniform over the sphere: height and azimuth are
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
