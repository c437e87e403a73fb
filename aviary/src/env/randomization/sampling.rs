use std::sync::Arc;

use flight::random::Key;
use nalgebra::Vector3;
use rand::RngExt as _;
use smallvec::SmallVec;

use super::sensors::{Sensed, SensorParams};
use super::{AerodynamicRanges, AirframeRanges, InitialRanges, Randomization, Range};
use crate::drone::{DroneParams, GRAVITY};
use crate::env::EnvError;
use crate::env::workspace::Measured;
use crate::math::{ToFlight as _, ToNalgebra as _};
use crate::physics::actuators::ActuatorParams;
use crate::physics::wind::{WindConfig, WindModel};
use crate::random::{Rng, normals};
use crate::simulation::{SimData, SimModel, SimView, SimulationError};
use crate::state::{DroneState, attitude_from_rpy};
use crate::world::Obstacle;
use crate::world::placement::CollisionCylinder;

/// Parameters of one drone, sampled for an episode.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct SampledDroneParams {
    /// Factor on the mass.
    pub mass: f64,
    /// Factor on the inertia.
    pub inertia: f64,
    /// Factor on the arm length.
    pub arm_length: f64,
    /// Factor on the thrust coefficient.
    pub thrust: f64,
    /// Factor on the torque coefficient.
    pub torque: f64,
    /// Factors on the blade drag and on the linear drag: x and y, and z.
    pub drag: [f64; 2],
    /// Factor on the ground-effect coefficient.
    pub ground: f64,
    /// Factor on the strength of the wake.
    pub downwash: f64,
    /// Motor parameters.
    pub actuators: ActuatorParams,
    /// Factor on the moment of the velocity; in single precision, so that thousands of environments stay small.
    pub moment: f32,
    /// Factor on the rotational damping.
    pub damping: f32,
    /// Charge of the battery as a fraction of its capacity; `None` if it is not sampled.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub charge: Option<f32>,
    /// Bias of the observed position (m), velocity (m/s), roll-pitch-yaw (rad) and angular velocity (rad/s).
    #[serde(with = "crate::serial::vector_array")]
    pub bias: [Vector3<f64>; 4],
    /// Initial state, before changes by the task.
    pub initial: DroneState,
}

/// Parameters sampled for an episode.
///
/// ```
/// use aviary::env::{BodyRanges, DroneEnv, Env, Randomization};
/// use aviary::tasks::Hover;
///
/// // mass factor 1.1 in every episode, all other parameters nominal
/// let body = BodyRanges { mass: [1.1, 1.1], inertia: [1.0, 1.0], arm_length: [1.0, 1.0] };
/// let heavier = Randomization { body: Some(body), ..Randomization::NONE };
/// let mut env = Hover::builder().randomization(heavier).build()?;
/// env.reset(Some(1))?;
/// assert_eq!(env.sampled_params().map(|draw| draw.drones[0].mass), Some(1.1));
/// assert!((env.simulation().params(0).mass - 1.1 * 0.027).abs() < 1e-12);
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct SampledParams {
    /// Factor on gravity.
    pub gravity: f64,
    /// The wind; `None` if it is not sampled.
    pub wind: Option<WindConfig>,
    /// Delay of the observed states, s.
    pub sensor_latency: f64,
    /// Parameters of each drone.
    pub drones: Vec<SampledDroneParams>,
}

/// Samples the parameters of a [`Randomization`] and applies them.
#[derive(Debug, Clone, serde::Serialize, serde::Deserialize)]
pub(crate) struct Randomizer {
    #[serde(with = "crate::serial::shared")]
    basis: Arc<Basis>,
    pub(in crate::env) draw: SampledParams,
    /// Seed of the sensor noise in this episode.
    noise_seed: u64,
}

/// Constants of a [`Randomizer`], which the environments of a batch share.
#[derive(Debug, Clone, serde::Serialize, serde::Deserialize)]
struct Basis {
    config: Randomization,
    nominal: Vec<DroneParams>,
    /// Motor parameters and wind without randomization.
    motors: Vec<ActuatorParams>,
    wind: Option<WindConfig>,
}

fn within(rng: &mut Rng, [low, high]: Range) -> f64 {
    low + (high - low) * rng.random::<f64>()
}

/// Returns a sample whose logarithm is uniform.
fn within_logarithm(rng: &mut Rng, range: Range) -> f64 {
    within(rng, range.map(f64::ln)).exp()
}

/// Returns three uniform samples from [−max, max].
fn around(rng: &mut Rng, max: f64) -> Vector3<f64> {
    Vector3::from_fn(|_, _| within(rng, [-max, max]))
}

/// Returns three normal samples.
fn gaussian(rng: &mut Rng, sigma: f64) -> Vector3<f64> {
    let ([a, b], [c, _]) = (normals(rng), normals(rng));
    sigma * Vector3::new(a, b, c)
}

impl Randomizer {
    /// Creates a randomizer from a simulation with nominal parameters and from its wind settings. A sampled wind
    /// keeps some of these settings even if they are calm.
    pub(in crate::env) fn new(
        config: Randomization,
        simulation: SimView<'_>,
        wind: Option<WindConfig>,
    ) -> Result<Self, EnvError> {
        config.validate()?;
        let nominal: Vec<_> = simulation.world().drones.iter().map(|drone| drone.params.clone()).collect();
        config.validate_batteries(nominal.iter())?;
        let initial = simulation.initial_states().to_vec();
        let still = |initial: &DroneState| SampledDroneParams {
            mass: 1.0,
            inertia: 1.0,
            arm_length: 1.0,
            thrust: 1.0,
            torque: 1.0,
            drag: [1.0; 2],
            ground: 1.0,
            downwash: 1.0,
            actuators: ActuatorParams::default(),
            moment: 1.0,
            damping: 1.0,
            charge: None,
            bias: [Vector3::zeros(); 4],
            initial: *initial,
        };
        let draw = SampledParams {
            gravity: 1.0,
            wind: None,
            sensor_latency: 0.0,
            drones: initial.iter().map(still).collect(),
        };
        let motors = (0..nominal.len()).map(|drone| *simulation.actuator_params(drone)).collect();
        Ok(Self { basis: Arc::new(Basis { config, nominal, motors, wind }), draw, noise_seed: 0 })
    }

    /// Returns the ranges of the samples.
    pub(in crate::env) fn config(&self) -> &Randomization {
        &self.basis.config
    }

    /// Returns true if both have been created as one.
    pub(in crate::env) fn shares_basis(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.basis, &other.basis)
    }

    /// Returns the settings of the environment's own wind.
    pub(in crate::env) fn own_wind(&self) -> Option<&WindConfig> {
        self.basis.wind.as_ref()
    }

    /// Replaces the settings of the environment's own wind, and a sampled wind until the next episode.
    pub(in crate::env) fn replace_wind(&mut self, wind: Option<WindConfig>) {
        // environments of a batch share the basis until their winds differ
        if self.basis.wind != wind {
            Arc::make_mut(&mut self.basis).wind = wind;
        }
        self.draw.wind = None;
    }

    /// Returns an error for a wind of the environment that the samples would replace in every episode.
    pub(in crate::env) fn validate_wind(&self, wind: &WindConfig) -> Result<(), EnvError> {
        self.basis.config.validate_wind(wind)
    }

    /// Returns the size in bytes, without shared memory.
    pub(in crate::env) fn bytes(&self) -> usize {
        size_of::<Self>() + size_of_val(&self.draw.drones[..])
    }

    /// Samples an episode. Each group has its own random stream, so that its samples do not depend on the other
    /// groups.
    fn draw(&mut self, simulation: SimView<'_>, rng: &mut Rng, obstacles_move: bool) {
        let mut streams = [(); 6].map(|()| stream(rng));
        let [body, aerodynamics, actuators, sensors, environment, initial] = &mut streams;
        let config = &self.basis.config;
        for (drone, draw) in self.draw.drones.iter_mut().enumerate() {
            if let Some(ranges) = &config.body {
                draw.mass = within(body, ranges.mass);
                draw.inertia = within(body, ranges.inertia);
                draw.arm_length = within(body, ranges.arm_length);
            }
            if let Some(ranges) = &config.aerodynamics {
                draw.thrust = within(aerodynamics, ranges.thrust);
                draw.torque = within(aerodynamics, ranges.torque);
                draw.drag = [(); 2].map(|()| within(aerodynamics, ranges.drag));
                draw.ground = within(aerodynamics, ranges.ground);
                draw.downwash = within(aerodynamics, ranges.downwash);
            }
            if let Some(ranges) = &config.actuators {
                draw.actuators = ActuatorParams {
                    gains: [(); 4].map(|()| within(actuators, ranges.gain)),
                    lag: within(actuators, ranges.lag),
                    latency: within(actuators, ranges.latency),
                    saturation: within(actuators, ranges.max_rpm),
                };
            }
            if let Some(ranges) = &config.sensors {
                let sigmas = [ranges.position, ranges.velocity, ranges.attitude].map(|sigma| ranges.bias * sigma);
                let gyro = ranges.gyro_bias.unwrap_or(ranges.bias * ranges.angular_velocity);
                draw.bias = [sigmas[0], sigmas[1], sigmas[2], gyro].map(|sigma| gaussian(sensors, sigma));
            }
            draw.initial = simulation.initial_states()[drone];
        }
        if let Some(ranges) = &config.sensors {
            self.draw.sensor_latency = within(sensors, ranges.latency);
        }
        if let Some(ranges) = &config.environment {
            self.draw.gravity = within(environment, ranges.gravity);
            let (sin, cos) = (std::f64::consts::TAU * environment.random::<f64>()).sin_cos();
            let speed = within(environment, ranges.wind);
            let velocity = [speed * cos, speed * sin, 0.0];
            // gusts and turbulence scale with the wind speed
            let WindConfig { filter, drag_area, still_air_drag, .. } = self.basis.wind.unwrap_or_default();
            let full = WindConfig { filter, drag_area, still_air_drag, ..WindConfig::new(WindModel::Combined) };
            let wind = WindConfig {
                velocity,
                turbulence: full.turbulence * speed,
                gust_force: full.gust_force * speed,
                sinusoidal_force: full.sinusoidal_force * speed,
                ..full
            };
            self.draw.wind = (ranges.wind[1] > 0.0).then_some(wind);
        }
        if let Some(ranges) = &config.initial {
            for drone in 0..self.draw.drones.len() {
                let start = simulation.initial_states()[drone];
                // a new layout of obstacles will leave room for the drones
                let there: &[Obstacle] = if obstacles_move { &[] } else { simulation.obstacles() };
                let state = self.start(ranges, drone, &start, there, initial);
                self.draw.drones[drone].initial = state;
            }
        }
        self.noise_seed = streams[3].random();
        // after all other samples, which stay as they are without these
        if let Some(ranges) = &config.battery {
            let mut charges = stream(rng);
            for draw in &mut self.draw.drones {
                draw.charge = Some(within(&mut charges, ranges.charge) as f32);
            }
        }
        if let Some(ranges) = config.aerodynamics.filter(AerodynamicRanges::has_torques) {
            let mut torques = stream(rng);
            for draw in &mut self.draw.drones {
                draw.moment = within(&mut torques, ranges.moment) as f32;
                draw.damping = within(&mut torques, ranges.damping) as f32;
            }
        }
        if let Some(ranges) = &config.airframe {
            let mut airframes = stream(rng);
            let nominal = self.basis.nominal.iter().zip(&self.basis.motors);
            for (draw, (nominal, motors)) in self.draw.drones.iter_mut().zip(nominal) {
                draw_airframe(ranges, nominal, draw, &mut airframes);
                // latency and gains stay those of the environment
                draw.actuators = ActuatorParams { lag: within_logarithm(&mut airframes, ranges.lag), ..*motors };
            }
        }
    }

    /// Samples an initial state around `start` outside the floor, the obstacles and the drones already placed.
    /// After 20 failed samples, uses the shifted nominal position.
    fn start(
        &self,
        ranges: &InitialRanges,
        drone: usize,
        start: &DroneState,
        obstacles: &[Obstacle],
        rng: &mut Rng,
    ) -> DroneState {
        let cylinder = CollisionCylinder::from(&self.basis.nominal[drone]);
        let middle = start.position + Vector3::from(ranges.offset);
        let rpy = start.rpy() + around(rng, ranges.attitude);
        let velocity = start.velocity + around(rng, ranges.velocity);
        let attitude = attitude_from_rpy(rpy);
        let tilted = DroneState { attitude, ..*start }.tilt();
        let lowest = cylinder.depth_at_tilt(tilted);
        let above_floor = |place: Vector3<f64>| Vector3::new(place.x, place.y, place.z.max(lowest + 1e-3));
        let mut position = above_floor(middle);
        for _ in 0..20 {
            let place = above_floor(middle + around(rng, ranges.position));
            let others = self.draw.drones[..drone].iter().zip(&self.basis.nominal);
            let others = others.map(|(draw, params)| (draw.initial.position, CollisionCylinder::from(params)));
            if cylinder.has_room(&place, others, obstacles) {
                position = place;
                break;
            }
        }
        DroneState { position, attitude, velocity, angular_velocity: start.angular_velocity }
    }

    /// Samples an episode, applies it to the data, and resets the data.
    pub(in crate::env) fn begin(
        &mut self,
        model: &SimModel,
        data: &mut SimData,
        rng: &mut Rng,
        obstacles_move: bool,
    ) -> Result<(), SimulationError> {
        self.draw(SimView::new(model, data), rng, obstacles_move);
        self.apply(model, data)?;
        if self.basis.config.initial.is_some() {
            let initial: SmallVec<[DroneState; 8]> = self.draw.drones.iter().map(|draw| draw.initial).collect();
            data.reset_to(&initial)
        } else {
            data.reset_unchecked(model);
            Ok(())
        }
    }

    /// Applies the sampled parameters to data with the parameters of any episode.
    pub(crate) fn apply(&self, model: &SimModel, data: &mut SimData) -> Result<(), SimulationError> {
        let max = |ranges: Option<Range>| ranges.map_or(0.0, |[_, max]| max);
        data.reserve(
            model,
            max(self.basis.config.actuators.map(|ranges| ranges.latency)),
            max(self.basis.config.sensors.map(|ranges| ranges.latency)),
        );
        for (drone, (draw, nominal)) in self.draw.drones.iter().zip(&self.basis.nominal).enumerate() {
            let Randomization { body, aerodynamics, battery, airframe, .. } = &self.basis.config;
            if body.is_some() || aerodynamics.is_some() || battery.is_some() || airframe.is_some() {
                data.change_params(drone, |params| randomize(params, nominal, draw))?;
            }
            if self.basis.config.draws_actuators() {
                data.set_actuators(model, drone, &draw.actuators)?;
            }
        }
        if self.basis.config.environment.is_some() {
            data.set_gravity(GRAVITY * self.draw.gravity)?;
            if self.draw.wind.is_some() {
                data.change_wind(self.draw.wind)?;
            }
        }
        if self.basis.config.sensors.is_some() {
            data.remember(model, self.draw.sensor_latency);
        }
        Ok(())
    }

    /// Restores the nominal parameters.
    pub(in crate::env) fn undo(&self, model: &SimModel, data: &mut SimData) -> Result<(), SimulationError> {
        for (drone, (nominal, motors)) in self.basis.nominal.iter().zip(&self.basis.motors).enumerate() {
            data.set_params(drone, nominal.clone())?;
            if self.basis.config.draws_actuators() {
                data.set_actuators(model, drone, motors)?;
            }
        }
        data.remember(model, 0.0);
        if self.basis.config.environment.is_some() {
            data.set_gravity(GRAVITY)?;
            if self.draw.wind.is_some() {
                data.set_wind(self.basis.wind, 0)?;
            }
        }
        Ok(())
    }

    /// Returns the errors of a drone's sensors and the key of their noise; `None` if the sensors are exact.
    pub(in crate::env) fn sensors(&self, drone: usize) -> Option<(SensorParams<f64>, Key)> {
        let ranges = self.basis.config.sensors.as_ref()?;
        let sigmas = [ranges.position, ranges.velocity, ranges.attitude, ranges.angular_velocity];
        let params = SensorParams { sigmas, biases: self.draw.drones[drone].bias.map(Into::into) };
        Some((params, Key::new(self.noise_seed, drone)))
    }

    /// Computes the measured states (delayed, biased, noisy) and returns them with their roll, pitch and yaw;
    /// `None` if the sensors are exact.
    pub(in crate::env) fn measure<'a>(
        &self,
        data: &SimData,
        out: &'a mut Measured,
    ) -> Option<(&'a [DroneState], &'a [Vector3<f64>])> {
        out.states.clear();
        out.rpys.clear();
        for (drone, truth) in data.remembered().iter().enumerate() {
            let (params, key) = self.sensors(drone)?;
            let attitude = truth.attitude.to_flight();
            let truth = Sensed {
                position: truth.position.to_flight(),
                attitude,
                rpy: attitude.rpy(),
                velocity: truth.velocity.to_flight(),
                rate: truth.angular_velocity.to_flight(),
            };
            let measured = params.measure(key.at(data.control_steps()), &truth);
            out.states.push(DroneState {
                position: measured.position.to_nalgebra(),
                attitude: measured.attitude.to_nalgebra(),
                velocity: measured.velocity.to_nalgebra(),
                angular_velocity: measured.rate.to_nalgebra(),
            });
            out.rpys.push(measured.rpy.to_nalgebra());
        }
        Some((&out.states, &out.rpys))
    }
}

/// Returns an independent random stream for a group.
fn stream(rng: &mut Rng) -> Rng {
    use rand::SeedableRng as _;
    Rng::seed_from_u64(rng.random())
}

/// Samples a whole airframe as factors on the nominal one; see [`AirframeRanges`] for the law of each.
fn draw_airframe(ranges: &AirframeRanges, nominal: &DroneParams, draw: &mut SampledDroneParams, rng: &mut Rng) {
    draw.mass = within_logarithm(rng, ranges.mass) / nominal.mass;
    let thrust_to_weight = within(rng, ranges.thrust_to_weight);
    draw.arm_length = draw.mass.cbrt() * within(rng, ranges.arm_length);
    draw.inertia = draw.mass * draw.arm_length.powi(2) * within(rng, ranges.inertia);
    draw.thrust = draw.mass * thrust_to_weight / nominal.thrust_to_weight;
    draw.torque = draw.thrust * draw.arm_length * within(rng, ranges.torque);
    draw.drag = [(); 2].map(|()| draw.mass * within(rng, ranges.drag));
    draw.moment = (draw.mass * draw.arm_length) as f32;
    draw.damping = draw.inertia as f32;
}

/// Applies the sampled factors to the nominal parameters. The maximum motor speed stays the same.
fn randomize(params: &mut DroneParams, nominal: &DroneParams, draw: &SampledDroneParams) {
    let [sideways, upwards] = draw.drag;
    let [x, y, z] = nominal.drag_coefficients;
    let [c1, c2, c3] = nominal.downwash_coefficients;
    params.mass = nominal.mass * draw.mass;
    params.inertia = nominal.inertia.map(|moment| moment * draw.inertia);
    params.arm_length = nominal.arm_length * draw.arm_length;
    params.center_of_mass = nominal.center_of_mass.map(|offset| offset * draw.arm_length);
    params.thrust_coefficient = nominal.thrust_coefficient * draw.thrust;
    params.torque_coefficient = nominal.torque_coefficient * draw.torque;
    params.thrust_to_weight = nominal.thrust_to_weight * draw.thrust / draw.mass;
    params.drag_coefficients = [x * sideways, y * sideways, z * upwards];
    let [x, y, z] = nominal.air.linear_drag;
    params.air.linear_drag = [x * sideways, y * sideways, z * upwards];
    params.air.velocity_moment = nominal.air.velocity_moment * f64::from(draw.moment);
    params.air.rotational_damping = nominal.air.rotational_damping.map(|damping| damping * f64::from(draw.damping));
    params.ground_effect_coefficient = nominal.ground_effect_coefficient * draw.ground;
    params.downwash_coefficients = [c1 * draw.downwash, c2, c3];
    if let (Some(battery), Some(charge)) = (&mut params.battery, draw.charge) {
        battery.initial_charge = f64::from(charge);
    }
}
