use serde::{Deserialize, Serialize};

use crate::drone::DroneParams;
use crate::env::EnvError;
use crate::error::pair;
use crate::physics::actuators::ActuatorParams;
use crate::physics::wind::{WindConfig, WindModel};

/// Lower and upper bound of a uniform distribution.
pub type Range = [f64; 2];

/// Ranges of the parameters that are sampled for every episode (paper, §3.5.4 and its table of ranges). A group
/// that is `None` stays nominal.
///
/// Sampled parameters change the simulated body: MuJoCo's mass, inertia and gravity, the rotors, the aerodynamic
/// effects, the motors. The mapping from actions to motor speeds stays that of the nominal airframe, and so do the
/// controllers of velocities and attitudes. Every drone has its own samples, except for gravity and wind.
///
/// In TOML, a missing group is off, and an empty one has the paper's ranges:
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
    /// Mass, inertia and arm length.
    pub body: Option<BodyRanges>,
    /// Rotors and aerodynamic effects.
    pub aerodynamics: Option<AerodynamicRanges>,
    /// Motors.
    pub actuators: Option<ActuatorRanges>,
    /// Sensors.
    pub sensors: Option<SensorRanges>,
    /// Gravity and wind.
    pub environment: Option<EnvironmentRanges>,
    /// Initial states.
    pub initial: Option<InitialRanges>,
    /// Batteries; for airframes with [one](crate::drone::BatteryParams). The paper has none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub battery: Option<BatteryRanges>,
    /// Whole airframes, from small to large ones; in place of `body`, `aerodynamics` and `actuators`. The paper has
    /// none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub airframe: Option<AirframeRanges>,
}

/// Factors on mass, inertia and arm length.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BodyRanges {
    /// Factor on the mass.
    #[serde(deserialize_with = "pair")]
    pub mass: Range,
    /// Common factor on all moments of inertia.
    #[serde(deserialize_with = "pair")]
    pub inertia: Range,
    /// Factor on the arm length, and on the offset of the centre of mass.
    #[serde(deserialize_with = "pair")]
    pub arm_length: Range,
}

/// Factors on rotors and aerodynamic effects.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct AerodynamicRanges {
    /// Factor on the thrust coefficient.
    #[serde(deserialize_with = "pair")]
    pub thrust: Range,
    /// Factor on the torque coefficient.
    #[serde(deserialize_with = "pair")]
    pub torque: Range,
    /// Factors on the blade drag and on the linear drag: one sample for x and y, one for z.
    #[serde(deserialize_with = "pair")]
    pub drag: Range,
    /// Factor on the ground-effect coefficient.
    #[serde(deserialize_with = "pair")]
    pub ground: Range,
    /// Factor on the strength of the wake.
    #[serde(deserialize_with = "pair")]
    pub downwash: Range,
    /// Factor on the [moment of the velocity](crate::drone::AirParams::velocity_moment). The paper has none.
    #[serde(deserialize_with = "pair")]
    pub moment: Range,
    /// Factor on the [rotational damping](crate::drone::AirParams::rotational_damping). The paper has none.
    #[serde(deserialize_with = "pair")]
    pub damping: Range,
}

/// Ranges of the motor parameters.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ActuatorRanges {
    /// Factor on the speed of each motor, four samples.
    #[serde(deserialize_with = "pair")]
    pub gain: Range,
    /// Time constant of the lag, s; 0 for those of the airframe.
    #[serde(deserialize_with = "pair")]
    pub lag: Range,
    /// Latency of commands, s, in addition to that of the airframe.
    #[serde(deserialize_with = "pair")]
    pub latency: Range,
    /// Factor on the maximum motor speed.
    #[serde(deserialize_with = "pair")]
    pub max_rpm: Range,
}

/// Noise, bias and latency of the observed states. Images and rangefinders are exact.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SensorRanges {
    /// Standard deviation of the noise on each coordinate, sampled at every step, m.
    pub position: f64,
    /// Standard deviation of the noise on each component of the velocity, m/s.
    pub velocity: f64,
    /// Standard deviation of the noise on roll, pitch and yaw, rad.
    pub attitude: f64,
    /// Standard deviation of the noise on each component of the angular velocity, rad/s.
    pub angular_velocity: f64,
    /// Ratio of the standard deviation of the bias, sampled once per episode, to that of the noise.
    pub bias: f64,
    /// Standard deviation of the bias of the angular velocity, rad/s; `None` for `bias` times the noise.
    pub gyro_bias: Option<f64>,
    /// Delay of the observed states, s, rounded to whole physics steps.
    #[serde(deserialize_with = "pair")]
    pub latency: Range,
}

/// Gravity and wind.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct EnvironmentRanges {
    /// Factor on gravity.
    #[serde(deserialize_with = "pair")]
    pub gravity: Range,
    /// Speed of a horizontal [combined](WindModel::Combined) wind with a random direction, m/s. It replaces the
    /// environment's wind except for [`filter`](WindConfig::filter), [`drag_area`](WindConfig::drag_area) and
    /// [`still_air_drag`](WindConfig::still_air_drag). `[0, 0]` keeps the environment's wind.
    #[serde(deserialize_with = "pair")]
    pub wind: Range,
}

/// Ranges of the initial states: maximum change of each component, uniform in both directions, around the shifted
/// nominal start.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct InitialRanges {
    /// Maximum change of each coordinate, m. The sampler rejects positions inside the floor, obstacles and drones.
    pub position: f64,
    /// Maximum change of roll, pitch and yaw, rad.
    pub attitude: f64,
    /// Maximum change of each component of the velocity, m/s.
    pub velocity: f64,
    /// Shift of the nominal start, world frame, m; default zero.
    #[serde(deserialize_with = "crate::error::triple")]
    pub offset: [f64; 3],
}

/// Batteries.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BatteryRanges {
    /// Charge at the start of the episode as a fraction of the capacity.
    #[serde(deserialize_with = "pair")]
    pub charge: Range,
}

/// Whole airframes of different size and thrust, each consistent in itself.
///
/// A sample has a mass m, a thrust-to-weight ratio and a lag of the motors. The other parameters follow from those of
/// the nominal airframe by geometric scaling, each with a factor of its own around it:
///
/// | parameter | proportional to |
/// | --- | --- |
/// | arm length L, offset of the centre of mass | ∛m |
/// | moments of inertia | m·L² |
/// | thrust coefficient | m · thrust-to-weight ratio, so that `MAX_RPM` stays nominal |
/// | torque coefficient | thrust coefficient · L |
/// | blade drag, linear drag | m, so that the deceleration at a speed stays similar |
/// | moment of the velocity | m·L |
/// | rotational damping | moments of inertia |
///
/// Collision cylinder, propeller radius, rotor inertia, ground-effect coefficient and wake stay nominal.
///
/// Normalized motor speeds keep the scale of the nominal airframe, whose maximum speed is also that of every sample: a
/// command of −1 is standstill, and a command of 1 is the full thrust of the sample, as the throttle of a flight
/// controller. A sample hovers at `MAX_RPM` divided by the square root of its thrust-to-weight ratio, which no
/// observation contains.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct AirframeRanges {
    /// Mass, kg; the logarithm is uniform.
    #[serde(deserialize_with = "pair")]
    pub mass: Range,
    /// Ratio of the maximum thrust to the weight.
    #[serde(deserialize_with = "pair")]
    pub thrust_to_weight: Range,
    /// Time constant of the lag of the motors, s; the logarithm is uniform.
    #[serde(deserialize_with = "pair")]
    pub lag: Range,
    /// Factor on the arm length in proportion to the mass.
    #[serde(deserialize_with = "pair")]
    pub arm_length: Range,
    /// Factor on the moments of inertia in proportion to mass and arm length.
    #[serde(deserialize_with = "pair")]
    pub inertia: Range,
    /// Factor on the torque coefficient in proportion to thrust coefficient and arm length.
    #[serde(deserialize_with = "pair")]
    pub torque: Range,
    /// Factor on the drag in proportion to the mass.
    #[serde(deserialize_with = "pair")]
    pub drag: Range,
}

impl Default for AirframeRanges {
    fn default() -> Self {
        Self {
            mass: [0.02, 2.0],
            thrust_to_weight: [1.5, 5.0],
            lag: [0.01, 0.1],
            arm_length: [0.9, 1.1],
            inertia: [0.8, 1.25],
            torque: [0.8, 1.25],
            drag: [0.7, 1.3],
        }
    }
}

impl Default for BatteryRanges {
    fn default() -> Self {
        Self { charge: [0.3, 1.0] }
    }
}

impl Default for BodyRanges {
    fn default() -> Self {
        Self { mass: [0.8, 1.2], inertia: [0.8, 1.2], arm_length: [0.98, 1.02] }
    }
}

impl Default for AerodynamicRanges {
    fn default() -> Self {
        let (rotor, effect, none) = ([0.85, 1.15], [0.7, 1.3], [1.0, 1.0]);
        let (moment, damping) = (none, none);
        Self { thrust: rotor, torque: rotor, drag: effect, ground: effect, downwash: effect, moment, damping }
    }
}

impl AerodynamicRanges {
    /// Returns true if the torques of the air are sampled.
    pub(super) fn has_torques(&self) -> bool {
        [self.moment, self.damping] != [[1.0; 2]; 2]
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
            gyro_bias: None,
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

/// Enables every group of the paper with its ranges.
impl Default for Randomization {
    fn default() -> Self {
        Self {
            body: Some(BodyRanges::default()),
            aerodynamics: Some(AerodynamicRanges::default()),
            actuators: Some(ActuatorRanges::default()),
            sensors: Some(SensorRanges::default()),
            environment: Some(EnvironmentRanges::default()),
            initial: Some(InitialRanges::default()),
            battery: None,
            airframe: None,
        }
    }
}

impl Randomization {
    /// No groups; a base for struct update syntax.
    pub const NONE: Self = Self {
        body: None,
        aerodynamics: None,
        actuators: None,
        sensors: None,
        environment: None,
        initial: None,
        battery: None,
        airframe: None,
    };

    /// Reads and validates a randomization from TOML text.
    ///
    /// # Errors
    /// [`EnvError::Toml`] with line and column, or the error of [`validate`](Self::validate).
    pub fn from_toml(text: &str) -> Result<Self, EnvError> {
        let config: Self = toml::from_str(text)
            .map_err(|error| EnvError::Toml { message: crate::error::toml_message(text, &error) })?;
        config.validate()?;
        Ok(config)
    }

    /// Returns true if the wind of an episode is sampled and replaces the environment's.
    pub fn draws_wind(&self) -> bool {
        self.environment.is_some_and(|ranges| ranges.wind[1] > 0.0)
    }

    /// Returns true if the parameters of the motors are sampled.
    pub(crate) fn draws_actuators(&self) -> bool {
        self.actuators.is_some() || self.airframe.is_some()
    }

    /// Returns an error for a wind of the environment that the samples would replace in every episode.
    pub(in crate::env) fn validate_wind(&self, wind: &WindConfig) -> Result<(), EnvError> {
        if !self.draws_wind() || wind.model == WindModel::None {
            return Ok(());
        }
        let expected = "none, or a randomization with environment.wind = [0, 0]";
        Err(EnvError::Option { option: "wind", got: wind.model.to_string(), expected })
    }

    /// Returns an error for a charge that is sampled without batteries in all airframes.
    pub(in crate::env) fn validate_batteries<'a>(
        &self,
        mut airframes: impl Iterator<Item = &'a DroneParams>,
    ) -> Result<(), EnvError> {
        match airframes.find(|params| params.battery.is_none()) {
            Some(params) if self.battery.is_some() => {
                let (option, got) = ("the randomized battery", format!("set for {}, which has none", params.name));
                Err(EnvError::Option { option, got, expected: "an airframe with a section [battery]" })
            }
            _ => Ok(()),
        }
    }

    /// Validates every range.
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
                return wrong(option, range_text([low, high]), "a range of factors from 0.01 to 100");
            }
        }
        if let Some(BatteryRanges { charge: [low, high] }) = self.battery
            && !(low >= 0.0 && high >= low && high <= 1.0)
        {
            return wrong("the randomized battery.charge", range_text([low, high]), "a range from 0 to 1");
        }
        if let Some(a) = self.airframe {
            if self.body.is_some() || self.aerodynamics.is_some() || self.actuators.is_some() {
                let got = "set together with body, aerodynamics or actuators".into();
                return wrong("the randomized airframe", got, "it alone: it replaces the other three");
            }
            for (option, [low, high], [min, max], expected) in [
                ("the randomized airframe.mass", a.mass, [1e-3, 1e2], "a range from 0.001 to 100 kg"),
                (
                    "the randomized airframe.thrust_to_weight",
                    a.thrust_to_weight,
                    [1.05, 20.0],
                    "a range from 1.05 to 20",
                ),
                ("the randomized airframe.lag", a.lag, [1e-4, 10.0], "a range from 0.0001 to 10 s"),
                ("the randomized airframe.arm_length", a.arm_length, [0.1, 10.0], "a range of factors from 0.1 to 10"),
                ("the randomized airframe.inertia", a.inertia, [0.1, 10.0], "a range of factors from 0.1 to 10"),
                ("the randomized airframe.torque", a.torque, [0.01, 100.0], "a range of factors from 0.01 to 100"),
                ("the randomized airframe.drag", a.drag, [0.0, 100.0], "a range of factors from 0 to 100"),
            ] {
                if !(low >= min && high >= low && high <= max) {
                    return wrong(option, range_text([low, high]), expected);
                }
            }
        }
        let s = self.sensors.unwrap_or_default();
        let factor = (1e2, "a range of factors from 0 to 100");
        let latency = (ActuatorParams::MAX_LATENCY, "a range from 0 to 1 s");
        for (option, [low, high], (max, expected)) in [
            ("the randomized aerodynamics.drag", a.drag, factor),
            ("the randomized aerodynamics.ground", a.ground, factor),
            ("the randomized aerodynamics.downwash", a.downwash, factor),
            ("the randomized aerodynamics.moment", a.moment, factor),
            ("the randomized aerodynamics.damping", a.damping, factor),
            ("the randomized actuators.gain", m.gain, factor),
            ("the randomized actuators.lag", m.lag, (10.0, "a range from 0 to 10 s")),
            ("the randomized actuators.latency", m.latency, latency),
            ("the randomized sensors.latency", s.latency, (1.0, latency.1)),
            ("the randomized environment.gravity", e.gravity, factor),
            ("the randomized environment.wind", e.wind, (1e2, "a range from 0 to 100 m/s")),
        ] {
            if !(low >= 0.0 && high >= low && high <= max) {
                return wrong(option, range_text([low, high]), expected);
            }
        }
        let i = self.initial.unwrap_or_default();
        for (option, got) in [
            ("the randomized sensors.position", s.position),
            ("the randomized sensors.velocity", s.velocity),
            ("the randomized sensors.attitude", s.attitude),
            ("the randomized sensors.angular_velocity", s.angular_velocity),
            ("the randomized sensors.bias", s.bias),
            ("the randomized sensors.gyro_bias", s.gyro_bias.unwrap_or(0.0)),
            ("the randomized initial.position", i.position),
            ("the randomized initial.attitude", i.attitude),
            ("the randomized initial.velocity", i.velocity),
        ] {
            if !(0.0..=1e3).contains(&got) {
                return wrong(option, crate::number(got), "zero or a positive number up to 1000");
            }
        }
        match i.offset.iter().find(|x| !(-1e3..=1e3).contains(*x)) {
            Some(x) => wrong("the randomized initial.offset", crate::number(*x), "three numbers from −1000 to 1000"),
            None => Ok(()),
        }
    }
}

/// Returns a range as error messages print it.
fn range_text([low, high]: Range) -> String {
    format!("[{}, {}]", crate::number(low), crate::number(high))
}
