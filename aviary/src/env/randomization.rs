use std::sync::Arc;

use nalgebra::Vector3;
use rand::RngExt as _;
use serde::{Deserialize, Serialize};

use super::EnvError;
use crate::drone::{DroneParams, GRAVITY};
use crate::physics::actuators::ActuatorParams;
use crate::physics::wind::{WindConfig, WindModel};
use crate::random::{Rng, normals};
use crate::simulation::{SimData, SimModel, SimView, SimulationError};
use crate::state::{DroneState, attitude_from_rpy};
use crate::world::Obstacle;
use crate::world::placement::CollisionCylinder;

/// Least and greatest value of a uniform draw.
pub type Range = [f64; 2];

/// What is drawn anew for every episode (paper, §3.5.4 and its table of ranges). A group that is `None` is left alone.
///
/// Drawn parameters change the simulated body, not only somebody's copy: MuJoCo's mass, inertia and gravity, the rotors,
/// the aerodynamic effects, the motors. What an agent's action means stays that of the nominal airframe, and so do the
/// controllers beneath velocities and attitudes. Every drone has draws of its own; gravity and wind are one for all.
///
/// In TOML a group that is not there is off, and an empty one has the paper's ranges:
///
/// ```
/// use aviary::env::Randomization;
///
/// let some = Randomization::from_toml("[body]\nmass = [0.9, 1.1]\n[sensors]\n")?;
/// assert_eq!(some.body.unwrap().inertia, [0.8, 1.2]);
/// assert!(some.aerodynamics.is_none() && Randomization::default().aerodynamics.is_some());
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Randomization {
    /// The body.
    pub body: Option<BodyRanges>,
    /// Rotors and aerodynamic effects.
    pub aerodynamics: Option<AerodynamicRanges>,
    /// Motors.
    pub actuators: Option<ActuatorRanges>,
    /// What is seen.
    pub sensors: Option<SensorRanges>,
    /// Gravity and wind.
    pub environment: Option<EnvironmentRanges>,
    /// Where an episode starts.
    pub initial: Option<InitialRanges>,
}

/// Factors on the body's parameters.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BodyRanges {
    /// On the mass.
    pub mass: Range,
    /// On all moments of inertia at once.
    pub inertia: Range,
    /// On the arm length.
    pub arm_length: Range,
}

/// Factors on rotors and aerodynamic effects.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct AerodynamicRanges {
    /// On the thrust coefficient.
    pub thrust: Range,
    /// On the torque coefficient.
    pub torque: Range,
    /// On the blade drag, once for x and y and once for z.
    pub drag: Range,
    /// On the ground-effect coefficient.
    pub ground: Range,
    /// On the strength of the wake.
    pub downwash: Range,
}

/// How the motors answer.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ActuatorRanges {
    /// Factor on the speed of every motor, four draws.
    pub gain: Range,
    /// Time constant of the lag, s.
    pub lag: Range,
    /// Latency of actions, s.
    pub latency: Range,
    /// Factor on the greatest motor speed.
    pub max_rpm: Range,
}

/// What is seen of the state (pictures and rays are exact): standard deviations of noise that is drawn at every step, and of a bias that stays for the
/// episode, as a share of them.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SensorRanges {
    /// Of each coordinate, m.
    pub position: f64,
    /// Of each component, m/s.
    pub velocity: f64,
    /// Of roll, pitch and yaw, rad.
    pub attitude: f64,
    /// Of each body rate, rad/s.
    pub angular_velocity: f64,
    /// Standard deviation of the episode's bias over that of the noise.
    pub bias: f64,
    /// Age of what is seen, s, rounded to physics steps.
    pub latency: Range,
}

/// Gravity and wind.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct EnvironmentRanges {
    /// Factor on gravity.
    pub gravity: Range,
    /// Speed of a [combined](WindModel::Combined) wind from any side, m/s, in place of any other wind, of which only
    /// [`filter`](WindConfig::filter) and [`still_air_drag`](WindConfig::still_air_drag) are kept; `[0, 0]` leaves the wind alone.
    pub wind: Range,
}

/// Where an episode starts: largest change of each component, uniform both ways, about the environment's own start or a place beside it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct InitialRanges {
    /// Of the position, m. (No drone starts in the floor or in another one.)
    pub position: f64,
    /// Of roll, pitch and yaw, rad.
    pub attitude: f64,
    /// Of the velocity, m/s.
    pub velocity: f64,
    /// From the environment's own start to the middle of them, world frame, m; none by default.
    #[serde(deserialize_with = "crate::error::triple")]
    pub offset: [f64; 3],
}

impl Default for BodyRanges {
    fn default() -> Self {
        Self { mass: [0.8, 1.2], inertia: [0.8, 1.2], arm_length: [0.98, 1.02] }
    }
}

impl Default for AerodynamicRanges {
    fn default() -> Self {
        let (rotor, effect) = ([0.85, 1.15], [0.7, 1.3]);
        Self { thrust: rotor, torque: rotor, drag: effect, ground: effect, downwash: effect }
    }
}

impl Default for ActuatorRanges {
    fn default() -> Self {
        Self { gain: [0.95, 1.05], lag: [0.005, 0.05], latency: [0.0, 0.05], max_rpm: [0.95, 1.05] }
    }
}

impl Default for SensorRanges {
    fn default() -> Self {
        Self {
            position: 0.01,
            velocity: 0.05,
            attitude: 1_f64.to_radians(),
            angular_velocity: 0.05,
            bias: 1.0,
            latency: [0.0, 0.02],
        }
    }
}

impl Default for EnvironmentRanges {
    fn default() -> Self {
        Self { gravity: [0.98, 1.02], wind: [0.0, 1.0] }
    }
}

impl Default for InitialRanges {
    fn default() -> Self {
        Self { position: 0.2, attitude: 0.1, velocity: 0.5, offset: [0.0; 3] }
    }
}

/// Every group with the paper's ranges.
impl Default for Randomization {
    fn default() -> Self {
        Self {
            body: Some(BodyRanges::default()),
            aerodynamics: Some(AerodynamicRanges::default()),
            actuators: Some(ActuatorRanges::default()),
            sensors: Some(SensorRanges::default()),
            environment: Some(EnvironmentRanges::default()),
            initial: Some(InitialRanges::default()),
        }
    }
}

impl Randomization {
    /// No group at all, to switch on those that one wants.
    pub const NONE: Self =
        Self { body: None, aerodynamics: None, actuators: None, sensors: None, environment: None, initial: None };

    /// Reads and checks a randomization from TOML text.
    ///
    /// # Errors
    /// [`EnvError::Toml`] with line and column, or what [`validate`](Self::validate) finds.
    pub fn from_toml(text: &str) -> Result<Self, EnvError> {
        let config: Self = toml::from_str(text)
            .map_err(|error| EnvError::Toml { message: crate::error::toml_message(text, &error) })?;
        config.validate()?;
        Ok(config)
    }

    /// Returns whether the wind of an episode is drawn, in place of the environment's own.
    pub fn draws_wind(&self) -> bool {
        self.environment.is_some_and(|ranges| ranges.wind[1] > 0.0)
    }

    /// Refuses a wind of the environment that the draws would replace in every episode.
    pub(super) fn check_wind(&self, wind: &WindConfig) -> Result<(), EnvError> {
        if !self.draws_wind() || wind.model == WindModel::None {
            return Ok(());
        }
        let expected =
            "none next to a randomization that draws the wind; environment.wind = [0, 0] there leaves the wind alone";
        Err(EnvError::Option { option: "the wind", got: wind.model.to_string(), expected })
    }

    /// Checks that every range is one, and that nothing in it is impossible.
    ///
    /// # Errors
    /// [`EnvError::Option`] naming the field.
    pub fn validate(&self) -> Result<(), EnvError> {
        let wrong = |option, got: String, expected| Err(EnvError::Option { option, got, expected });
        let (b, a) = (self.body.unwrap_or_default(), self.aerodynamics.unwrap_or_default());
        let (m, e) = (self.actuators.unwrap_or_default(), self.environment.unwrap_or_default());
        for (option, [low, high]) in [
            ("the randomized body.mass", b.mass),
            ("the randomized body.inertia", b.inertia),
            ("the randomized body.arm_length", b.arm_length),
            ("the randomized aerodynamics.thrust", a.thrust),
            ("the randomized aerodynamics.torque", a.torque),
            ("the randomized actuators.max_rpm", m.max_rpm),
        ] {
            if !(low >= 1e-2 && high >= low && high <= 1e2) {
                return wrong(option, format!("[{low}, {high}]"), "a range of factors from 0.01 to 100");
            }
        }
        let s = self.sensors.unwrap_or_default();
        for (option, [low, high], most) in [
            ("the randomized aerodynamics.drag", a.drag, 1e2),
            ("the randomized aerodynamics.ground", a.ground, 1e2),
            ("the randomized aerodynamics.downwash", a.downwash, 1e2),
            ("the randomized actuators.gain", m.gain, 1e2),
            ("the randomized actuators.lag", m.lag, 10.0),
            ("the randomized actuators.latency", m.latency, ActuatorParams::MAX_LATENCY),
            ("the randomized sensors.latency", s.latency, 1.0),
            ("the randomized environment.gravity", e.gravity, 1e2),
            ("the randomized environment.wind", e.wind, 1e2),
        ] {
            if !(low >= 0.0 && high >= low && high <= most) {
                return wrong(
                    option,
                    format!("[{low}, {high}]"),
                    "a range that starts at 0 or above and is not too wide",
                );
            }
        }
        let i = self.initial.unwrap_or_default();
        for (option, got) in [
            ("the randomized sensors.position", s.position),
            ("the randomized sensors.velocity", s.velocity),
            ("the randomized sensors.attitude", s.attitude),
            ("the randomized sensors.angular_velocity", s.angular_velocity),
            ("the randomized sensors.bias", s.bias),
            ("the randomized initial.position", i.position),
            ("the randomized initial.attitude", i.attitude),
            ("the randomized initial.velocity", i.velocity),
        ] {
            if !(0.0..=1e3).contains(&got) {
                return wrong(option, got.to_string(), "zero or a positive number up to 1000");
            }
        }
        match i.offset.iter().find(|x| !(-1e3..=1e3).contains(*x)) {
            Some(x) => wrong("the randomized initial.offset", x.to_string(), "three numbers from −1000 to 1000"),
            None => Ok(()),
        }
    }
}

/// What was drawn for one drone.
#[derive(Debug, Clone, Copy, PartialEq)]
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
    /// Factors on the blade drag: x and y, and z.
    pub drag: [f64; 2],
    /// Factor on the ground-effect coefficient.
    pub ground: f64,
    /// Factor on the strength of the wake.
    pub downwash: f64,
    /// The motors.
    pub actuators: ActuatorParams,
    /// Bias of what is seen: position (m), velocity (m/s), roll-pitch-yaw (rad), body rates (rad/s).
    pub bias: [Vector3<f64>; 4],
    /// The state that the episode started from, but for what the task made of it.
    pub initial: DroneState,
}

/// What was drawn for an episode.
///
/// ```
/// use aviary::env::{BodyRanges, DroneEnv, Env, Randomization};
/// use aviary::tasks::Hover;
///
/// // always a tenth heavier, and nothing else
/// let body = BodyRanges { mass: [1.1, 1.1], inertia: [1.0, 1.0], arm_length: [1.0, 1.0] };
/// let heavier = Randomization { body: Some(body), ..Randomization::NONE };
/// let mut env = Hover::builder().randomization(heavier).build()?;
/// env.reset(Some(1))?;
/// assert_eq!(env.sampled_params().map(|draw| draw.drones[0].mass), Some(1.1));
/// assert!((env.simulation().params(0).mass - 1.1 * 0.027).abs() < 1e-12);
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct SampledParams {
    /// Factor on gravity.
    pub gravity: f64,
    /// The wind; `None` where none was drawn.
    pub wind: Option<WindConfig>,
    /// Age of what is seen, s.
    pub sensor_latency: f64,
    /// Every drone's.
    pub drones: Vec<SampledDroneParams>,
}

/// Draws and applies what a [`Randomization`] says.
#[derive(Debug, Clone)]
pub(super) struct Randomizer {
    // what environments of a batch have in common is there once
    pub(super) config: Arc<Randomization>,
    pub(super) draw: SampledParams,
    /// Whence the noise of the sensors comes.
    noise: Rng,
    nominal: Arc<[DroneParams]>,
    /// How the motors and the wind were before.
    motors: Arc<[ActuatorParams]>,
    wind: Option<WindConfig>,
    measured: Vec<DroneState>,
    measured_rpys: Vec<Vector3<f64>>,
}

fn within(rng: &mut Rng, [low, high]: Range) -> f64 {
    low + (high - low) * rng.random::<f64>()
}

/// Three uniform draws in ± `most`.
fn around(rng: &mut Rng, most: f64) -> Vector3<f64> {
    Vector3::from_fn(|_, _| within(rng, [-most, most]))
}

/// Three normal draws.
fn gaussian(rng: &mut Rng, sigma: f64) -> Vector3<f64> {
    let ([a, b], [c, _]) = (normals(rng), normals(rng));
    sigma * Vector3::new(a, b, c)
}

impl Randomizer {
    /// Starts from a simulation that nothing has been drawn for, and from the settings of its wind, of which a drawn wind keeps
    /// a part even where they are calm.
    pub(super) fn new(
        config: Randomization,
        simulation: SimView<'_>,
        wind: Option<WindConfig>,
    ) -> Result<Self, EnvError> {
        config.validate()?;
        let nominal: Arc<[_]> = simulation.world().drones.iter().map(|drone| drone.params.clone()).collect();
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
            bias: [Vector3::zeros(); 4],
            initial: *initial,
        };
        let draw = SampledParams {
            gravity: 1.0,
            wind: None,
            sensor_latency: 0.0,
            drones: initial.iter().map(still).collect(),
        };
        use rand::SeedableRng as _;
        let motors = (0..nominal.len()).map(|drone| *simulation.actuator_params(drone)).collect();
        Ok(Self {
            config: Arc::new(config),
            draw,
            noise: Rng::seed_from_u64(0),
            nominal,
            motors,
            wind,
            measured_rpys: vec![Vector3::zeros(); initial.len()],
            measured: initial,
        })
    }

    /// Settings of the environment's own wind.
    pub(super) fn own_wind(&self) -> Option<&WindConfig> {
        self.wind.as_ref()
    }

    /// Refuses a wind of the environment that the draws would replace in every episode.
    pub(super) fn check_wind(&self, wind: &WindConfig) -> Result<(), EnvError> {
        self.config.check_wind(wind)
    }

    /// Bytes that it takes, beside what others have, too.
    pub(super) fn bytes(&self) -> usize {
        size_of::<Self>()
            + size_of_val(&self.draw.drones[..])
            + size_of_val(&self.measured[..])
            + size_of_val(&self.measured_rpys[..])
    }

    /// Draws an episode. Every group has the same number of draws whatever the others are.
    fn draw(&mut self, simulation: SimView<'_>, rng: &mut Rng, obstacles_move: bool) {
        let mut streams = [(); 6].map(|()| stream(rng));
        let [body, aerodynamics, actuators, sensors, environment, initial] = &mut streams;
        let config = &self.config;
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
                let sigmas = [ranges.position, ranges.velocity, ranges.attitude, ranges.angular_velocity];
                draw.bias = sigmas.map(|sigma| gaussian(sensors, ranges.bias * sigma));
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
            // gusts and turbulence grow with the wind
            let WindConfig { filter, still_air_drag, .. } = self.wind.unwrap_or_default();
            let full = WindConfig { filter, still_air_drag, ..WindConfig::new(WindModel::Combined) };
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
                // those that will be elsewhere make room for the drones
                let there: &[Obstacle] = if obstacles_move { &[] } else { simulation.obstacles() };
                let state = self.start(ranges, drone, &start, there, initial);
                self.draw.drones[drone].initial = state;
            }
        }
        self.noise = streams[3].clone();
    }

    /// A start about this one, not in the floor, not in an obstacle and not in a drone that has its place already; where
    /// twenty draws find none, this one.
    fn start(
        &self,
        ranges: &InitialRanges,
        drone: usize,
        start: &DroneState,
        obstacles: &[Obstacle],
        rng: &mut Rng,
    ) -> DroneState {
        let cylinder = CollisionCylinder::from(&self.nominal[drone]);
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
            let others = self.draw.drones[..drone].iter().zip(&*self.nominal);
            let others = others.map(|(draw, params)| (draw.initial.position, CollisionCylinder::from(params)));
            if cylinder.has_room(&place, others, obstacles) {
                position = place;
                break;
            }
        }
        DroneState { position, attitude, velocity, angular_velocity: start.angular_velocity }
    }

    /// Draws an episode and puts the data into it: afterwards it is reset.
    pub(super) fn begin(
        &mut self,
        model: &SimModel,
        data: &mut SimData,
        rng: &mut Rng,
        obstacles_move: bool,
    ) -> Result<(), SimulationError> {
        self.draw(SimView::new(model, data), rng, obstacles_move);
        let most = |ranges: Option<Range>| ranges.map_or(0.0, |[_, most]| most);
        data.reserve(
            model,
            most(self.config.actuators.map(|ranges| ranges.latency)),
            most(self.config.sensors.map(|ranges| ranges.latency)),
        );
        for (drone, (draw, nominal)) in self.draw.drones.iter().zip(&*self.nominal).enumerate() {
            if self.config.body.is_some() || self.config.aerodynamics.is_some() {
                data.change_params(drone, |params| randomize(params, nominal, draw))?;
            }
            if self.config.actuators.is_some() {
                data.set_actuators(model, drone, &draw.actuators)?;
            }
        }
        if self.config.environment.is_some() {
            data.set_gravity(GRAVITY * self.draw.gravity)?;
            if self.draw.wind.is_some() {
                data.set_wind(self.draw.wind, 0)?;
            }
        }
        if self.config.sensors.is_some() {
            data.remember(model, self.draw.sensor_latency);
        }
        if self.config.initial.is_some() {
            for (state, draw) in self.measured.iter_mut().zip(&self.draw.drones) {
                *state = draw.initial;
            }
            data.reset_to(&self.measured)
        } else {
            data.reset(model);
            Ok(())
        }
    }

    /// Puts everything back to the nominal airframes.
    pub(super) fn undo(&self, model: &SimModel, data: &mut SimData) -> Result<(), SimulationError> {
        for (drone, (nominal, motors)) in self.nominal.iter().zip(&*self.motors).enumerate() {
            data.set_params(drone, nominal.clone())?;
            if self.config.actuators.is_some() {
                data.set_actuators(model, drone, motors)?;
            }
        }
        data.remember(model, 0.0);
        if self.config.environment.is_some() {
            data.set_gravity(GRAVITY)?;
            if self.draw.wind.is_some() {
                data.set_wind(self.wind, 0)?;
            }
        }
        Ok(())
    }

    /// Measures the states: old, biased and noisy. Returns them with their roll, pitch and yaw; `None` where the sensors are exact.
    pub(super) fn measure(&mut self, data: &SimData) -> Option<(&[DroneState], &[Vector3<f64>])> {
        let ranges = self.config.sensors.as_ref()?;
        let draws = &self.draw.drones;
        for ((measured, truth), draw) in self.measured.iter_mut().zip(data.remembered()).zip(draws) {
            // twelve draws, two at a time
            let n: [[f64; 2]; 6] = std::array::from_fn(|_| normals(&mut self.noise));
            let position = ranges.position * Vector3::new(n[0][0], n[0][1], n[1][0]);
            let velocity = ranges.velocity * Vector3::new(n[1][1], n[2][0], n[2][1]);
            let rpy = ranges.attitude * Vector3::new(n[3][0], n[3][1], n[4][0]);
            let rates = ranges.angular_velocity * Vector3::new(n[4][1], n[5][0], n[5][1]);
            *measured = DroneState {
                position: truth.position + position + draw.bias[0],
                velocity: truth.velocity + velocity + draw.bias[1],
                attitude: attitude_from_rpy(truth.rpy() + rpy + draw.bias[2]),
                angular_velocity: truth.angular_velocity + rates + draw.bias[3],
            };
        }
        for (rpy, state) in self.measured_rpys.iter_mut().zip(&self.measured) {
            *rpy = state.rpy();
        }
        Some((&self.measured, &self.measured_rpys))
    }
}

/// A generator of its own for a group.
fn stream(rng: &mut Rng) -> Rng {
    use rand::SeedableRng as _;
    Rng::seed_from_u64(rng.random())
}

/// Makes an airframe one with these factors, whose motors are as fast as before.
fn randomize(params: &mut DroneParams, nominal: &DroneParams, draw: &SampledDroneParams) {
    let [sideways, upwards] = draw.drag;
    let [x, y, z] = nominal.drag_coefficients;
    let [c1, c2, c3] = nominal.downwash_coefficients;
    params.mass = nominal.mass * draw.mass;
    params.inertia = nominal.inertia.map(|moment| moment * draw.inertia);
    params.arm_length = nominal.arm_length * draw.arm_length;
    params.thrust_coefficient = nominal.thrust_coefficient * draw.thrust;
    params.torque_coefficient = nominal.torque_coefficient * draw.torque;
    params.thrust_to_weight = nominal.thrust_to_weight * draw.thrust / draw.mass;
    params.drag_coefficients = [x * sideways, y * sideways, z * upwards];
    params.ground_effect_coefficient = nominal.ground_effect_coefficient * draw.ground;
    params.downwash_coefficients = [c1 * draw.downwash, c2, c3];
}
