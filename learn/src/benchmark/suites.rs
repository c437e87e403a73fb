//! Tasks and conditions of the suites. A change of anything here needs a new [`SUITES_VERSION`].

use std::fmt;
use std::str::FromStr;

use aviary::engine::EngineKind;
use aviary::env::{
    AerodynamicRanges, BodyRanges, DroneEnv, Env as _, EnvConfig, EnvError, EnvironmentRanges, InitialRanges,
    Randomization, SensorRanges,
};
use aviary::observation::Observation;
use aviary::tasks::{GateMotion, GateRanges, Hover, Race, RaceTrack};
use aviary::wrappers::Wrapper;
use aviary::{NamedEnum, UnknownName};
use serde::Serialize;

use super::Craft;
use crate::{AnyEnv, Episode, Success, TrainError};

/// Version of the suites. Results of different versions cannot be compared.
pub const SUITES_VERSION: u32 = 1;

/// List of conditions of one task.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Suite {
    /// Hovering: without disturbances, in wind, with sensor errors, with randomized parameters.
    Hover,
    /// Hovering with rising loss of thrust of a motor, mass and wind.
    Robust,
    /// Races through solid gates, from known gates to moving ones.
    Race,
    /// Races on the built-in tracks.
    Tracks,
}

impl Suite {
    /// All suites.
    pub const ALL: [Self; 4] = [Self::Hover, Self::Robust, Self::Race, Self::Tracks];

    /// Returns the name.
    pub fn name(self) -> &'static str {
        Self::NAMES[self as usize]
    }

    /// Returns the conditions, in their order in a report.
    pub fn conditions(self) -> Vec<Condition> {
        match self {
            Self::Hover => hover(),
            Self::Robust => robust(),
            Self::Race => race(),
            Self::Tracks => tracks(),
        }
    }

    /// Returns the ladders of the conditions.
    pub fn ladders(self) -> Vec<Ladder> {
        if self == Self::Robust { LADDERS.to_vec() } else { Vec::new() }
    }
}

impl fmt::Display for Suite {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

impl FromStr for Suite {
    type Err = UnknownName;

    fn from_str(name: &str) -> Result<Self, UnknownName> {
        let found = Self::ALL.into_iter().find(|suite| suite.name() == name);
        found.ok_or_else(|| UnknownName { noun: Self::NOUN, name: name.into(), names: Self::NAMES })
    }
}

impl NamedEnum for Suite {
    const NOUN: &'static str = "suite";
    const NAMES: &'static [&'static str] = &["hover", "robust", "race", "tracks"];
}

/// Quantity that a condition measures in successful episodes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Quantity {
    /// Largest distance from the target during the last 5 s, m.
    LatePositionError,
    /// Length of the episode divided by the number of laps, s.
    LapTime,
}

impl Quantity {
    /// Returns the quantity of an episode.
    pub(super) fn of(self, episode: &Episode, laps: usize) -> f64 {
        match self {
            Self::LatePositionError => episode.late_position_error,
            Self::LapTime => episode.seconds / laps.max(1) as f64,
        }
    }
}

/// Task with its conditions.
#[derive(Debug, Clone, PartialEq)]
pub struct Condition {
    /// Name, unique in a suite.
    pub name: String,
    /// Success criterion.
    pub success: Success,
    /// Measured quantity.
    pub quantity: Quantity,
    /// Track of a race; `None` for hover.
    track: Option<RaceTrack>,
    randomization: Randomization,
    /// Reduction of the thrust of one motor, as a share. Episodes choose the motor in turn.
    motor_loss: f64,
}

impl Condition {
    /// Creates a condition of hover that succeeds within a distance (m) of the target during the last 5 s.
    fn hover(name: &str, within: f64, randomization: Randomization) -> Self {
        Self {
            name: name.into(),
            success: Success::Near { seconds: 5.0, within },
            quantity: Quantity::LatePositionError,
            track: None,
            randomization,
            motor_loss: 0.0,
        }
    }

    /// Creates a condition of a race.
    fn race(name: &str, track: RaceTrack, randomization: Randomization) -> Self {
        Self {
            name: name.into(),
            success: Success::Done,
            quantity: Quantity::LapTime,
            track: Some(track),
            randomization,
            motor_loss: 0.0,
        }
    }

    /// Returns the name of the task.
    pub fn task_name(&self) -> &'static str {
        if self.track.is_some() { "race" } else { "hover" }
    }

    /// Returns the number of laps of a race, otherwise 1.
    pub fn laps(&self) -> usize {
        self.track.as_ref().map_or(1, |track| track.laps)
    }

    /// Creates an environment with the rates, the action type and the observation of a pilot.
    pub(super) fn environment(&self, craft: &Craft) -> Result<AnyEnv, TrainError> {
        let config = EnvConfig::default()
            .engine(EngineKind::Hybrid)
            .drone(Craft::AIRFRAME.params())
            .action_type(craft.action_type)
            .sim_freq(craft.sim_freq)
            .ctrl_freq(craft.ctrl_freq)
            .randomization(self.randomization.clone());
        let env: AnyEnv = match &self.track {
            Some(track) => {
                let mut race = Race::default();
                race.set_track(track);
                race.normals = Some(craft.normals);
                Box::new(config.with_task(race).build()?)
            }
            None => Box::new(config.with_task(Hover::default()).build()?),
        };
        if self.motor_loss == 0.0 {
            return Ok(env);
        }
        Ok(Box::new(WeakMotor { env, gain: (1.0 - self.motor_loss).sqrt() }))
    }
}

/// Environment with a weak motor: that of the seed modulo four.
struct WeakMotor {
    env: AnyEnv,
    /// Factor on the speed of the motor.
    gain: f64,
}

impl Wrapper for WeakMotor {
    type Inner = dyn DroneEnv + Send;

    fn inner(this: &Self) -> &Self::Inner {
        &*this.env
    }

    fn inner_mut(this: &mut Self) -> &mut Self::Inner {
        &mut *this.env
    }

    fn reset(this: &mut Self, seed: Option<u64>) -> Result<&Observation, EnvError> {
        this.env.reset(seed)?;
        this.env.set_motor_gain(0, (seed.unwrap_or(0) % 4) as usize, this.gain)?;
        Ok(this.env.observation())
    }
}

/// Conditions of a suite that differ in one number, in rising order.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ladder {
    /// Name.
    pub name: &'static str,
    /// Unit of the levels.
    pub unit: &'static str,
    /// Levels.
    pub levels: &'static [f64],
}

impl Ladder {
    /// Returns the name of the condition of a level.
    pub fn condition_name(&self, level: f64) -> String {
        format!("{} {level}", self.name)
    }
}

/// Ladders of [`Suite::Robust`]: reduction of the thrust of one motor, factor on the mass, speed of a combined wind.
const LADDERS: [Ladder; 3] = [
    Ladder { name: "motor_loss", unit: "share of thrust", levels: &[0.1, 0.2, 0.3, 0.4, 0.5, 0.6] },
    Ladder { name: "mass", unit: "factor", levels: &[1.2, 1.4, 1.6, 1.8, 2.0] },
    Ladder { name: "wind", unit: "m/s", levels: &[1.0, 2.0, 3.0, 4.0, 5.0] },
];

/// Initial states of all conditions.
fn starts() -> Randomization {
    Randomization { initial: Some(InitialRanges::default()), ..Randomization::NONE }
}

/// Returns a combined wind of a speed range, m/s, with a random direction.
fn wind(low: f64, high: f64) -> Option<EnvironmentRanges> {
    Some(EnvironmentRanges { gravity: [1.0, 1.0], wind: [low, high] })
}

fn hover() -> Vec<Condition> {
    const WITHIN: f64 = 0.1;
    // with latency and lag, no pilot recovers from a fall just above the floor
    let in_flight = InitialRanges { offset: [0.0, 0.0, 0.6], ..InitialRanges::default() };
    let randomized = Randomization { initial: Some(in_flight), ..Randomization::default() };
    vec![
        Condition::hover("nominal", WITHIN, starts()),
        Condition::hover("wind", WITHIN, Randomization { environment: wind(1.0, 1.0), ..starts() }),
        Condition::hover("noise", WITHIN, Randomization { sensors: Some(SensorRanges::default()), ..starts() }),
        Condition::hover("randomized", 2.0 * WITHIN, randomized),
    ]
}

fn robust() -> Vec<Condition> {
    const WITHIN: f64 = 0.2;
    let condition = |ladder: &Ladder, level: f64| {
        let (mut randomization, mut motor_loss) = (starts(), 0.0);
        match ladder.name {
            "motor_loss" => motor_loss = level,
            "mass" => {
                let body = BodyRanges { mass: [level, level], inertia: [1.0, 1.0], arm_length: [1.0, 1.0] };
                randomization.body = Some(body);
            }
            _ => randomization.environment = wind(level, level),
        }
        Condition { motor_loss, ..Condition::hover(&ladder.condition_name(level), WITHIN, randomization) }
    };
    LADDERS.iter().flat_map(|ladder| ladder.levels.iter().map(move |&level| condition(ladder, level))).collect()
}

fn race() -> Vec<Condition> {
    // clear of the last gate, which is above the start of the task
    let offset = [0.0, -0.7, 0.0];
    let start = Randomization { initial: Some(InitialRanges { offset, ..InitialRanges::default() }), ..starts() };
    let known = RaceTrack { solid: true, ..Race::default().track() };
    let varied = RaceTrack { randomization: GateRanges { position: 0.15, yaw: 0.2 }, ..known.clone() };
    let moving = RaceTrack { motion: GateMotion { amplitude: 0.15, period: 4.0 }, ..varied.clone() };
    // the motors have no lag and no latency
    let rotor = [0.95, 1.05];
    let dynamics = Randomization {
        body: Some(BodyRanges::default()),
        aerodynamics: Some(AerodynamicRanges { thrust: rotor, torque: rotor, ..AerodynamicRanges::default() }),
        environment: wind(0.0, 1.0),
        ..start.clone()
    };
    vec![
        Condition::race("level 0", known.clone(), start),
        Condition::race("level 1", known, dynamics.clone()),
        Condition::race("level 2", varied, dynamics.clone()),
        Condition::race("level 3", moving, dynamics),
    ]
}

fn tracks() -> Vec<Condition> {
    let track = |name: &&str| RaceTrack::named(name).ok().map(|track| Condition::race(name, track, starts()));
    RaceTrack::NAMES.iter().filter_map(track).collect()
}
