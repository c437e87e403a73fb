//! Serialization of [`SimData`]: stores what cannot be derived, and validates it on reading.

use serde::{Deserialize, Deserializer, Serialize, Serializer};

use super::data::{Drone, Memory, unique};
use super::{SimData, Simulation, SimulationError, out_of_range};
use crate::drone::DroneParams;
use crate::engine::{Bodies, Contact, Load, Touched};
use crate::physics::Wrench;
use crate::physics::actuators::{ActuatorParams, Actuators};
use crate::physics::airframe::AirframeEffects;
use crate::physics::battery::BatteryState;
use crate::physics::downwash::Wake;
use crate::physics::ground_effect::GroundEffect;
use crate::physics::rotor::{RotorModel, RotorWrench};
use crate::physics::wind::WindField;
use crate::serial::{Extended, Fingerprint};
use crate::state::DroneState;
use crate::world::{MarkerPose, Obstacle, World};

/// Serialized form of [`SimData`]. Reading recomputes rotors, wakes, bodies and angles, and assigns new workspace
/// marks.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Stored {
    model: Fingerprint,
    control_steps: u64,
    states: Vec<DroneState>,
    started: Vec<DroneState>,
    drones: Vec<StoredDrone>,
    motor_speeds: Vec<[f64; 4]>,
    /// States of the batteries; empty if no drone has one.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    batteries: Vec<BatteryState>,
    /// Thrust and torque of the rotors in the body frame, other forces and torques in the world frame. They
    /// overflow if a simulation diverges.
    loads: Vec<[Extended; 10]>,
    contacts: Vec<Contact>,
    failed: Option<String>,
    gravity: f64,
    wind: Option<WindField>,
    wind_seed: u64,
    /// External force on every drone, world frame, N; empty if all are zero.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    external_forces: Vec<[f64; 3]>,
    /// Delay of the observed states, physics steps.
    #[serde(default)]
    delay: u32,
    /// Recorded states of the last control steps, grouped by step.
    memory: Vec<DroneState>,
    obstacles: Option<Vec<Obstacle>>,
    obstacle_drift: f64,
    markers: Vec<(usize, MarkerPose)>,
    warm_start: Option<Vec<f64>>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct StoredDrone {
    params: DroneParams,
    max_rpm: f64,
    actuators: ActuatorParams,
    motors: Actuators,
}

impl Serialize for SimData {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        Stored::from(self).serialize(serializer)
    }
}

impl<'de> Deserialize<'de> for SimData {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        Self::try_from(Stored::deserialize(deserializer)?).map_err(serde::de::Error::custom)
    }
}

impl From<&SimData> for Stored {
    fn from(data: &SimData) -> Self {
        let drones = data.drones.iter().zip(&data.actuators).map(|(drone, motors)| StoredDrone {
            params: drone.params.clone(),
            max_rpm: drone.max_rpm,
            actuators: drone.actuators,
            motors: motors.clone(),
        });
        let load = |Load { rotors, external }: &Load| {
            let (a, b, c) = (rotors.torque_body, external.force_world, external.torque_world);
            [rotors.thrust, a.x, a.y, a.z, b.x, b.y, b.z, c.x, c.y, c.z].map(Extended)
        };
        Self {
            model: data.model,
            control_steps: data.control_steps,
            states: data.states.clone(),
            started: data.started.clone(),
            drones: drones.collect(),
            motor_speeds: data.motor_speeds.clone(),
            batteries: data.batteries.clone(),
            loads: data.loads.iter().map(load).collect(),
            contacts: data.contacts.to_vec(),
            failed: data.failed.as_ref().map(ToString::to_string),
            gravity: data.bodies.gravity,
            wind: data.wind.clone(),
            wind_seed: data.wind_seed,
            external_forces: data.external_forces.iter().flatten().map(|force| (*force).into()).collect(),
            delay: data.memory.delay,
            memory: data.memory.states.clone(),
            obstacles: data.obstacles.as_deref().map(<[_]>::to_vec),
            obstacle_drift: data.bodies.obstacle_drift,
            markers: data.marker_poses.clone(),
            warm_start: data.warm_start().map(<[_]>::to_vec),
        }
    }
}

impl TryFrom<Stored> for SimData {
    type Error = String;

    fn try_from(stored: Stored) -> Result<Self, String> {
        stored.validate()?;
        let count = stored.states.len();
        let load = |load: [Extended; 10]| {
            let [thrust, a, b, c, d, e, f, g, h, i] = load.map(|Extended(x)| x);
            Load {
                rotors: RotorWrench { thrust, torque_body: [a, b, c].into() },
                external: Wrench { force_world: [d, e, f].into(), torque_world: [g, h, i].into() },
            }
        };
        let actuators = stored.drones.iter().map(|drone| drone.motors.clone()).collect();
        let wakes = stored.drones.iter().map(|drone| Wake::new(&drone.params)).collect();
        let drones = stored.drones.into_iter().map(|drone| Drone {
            rotors: RotorModel::new(&drone.params),
            ground: GroundEffect::new(&drone.params),
            effects: AirframeEffects::of_params(&drone.params),
            max_rpm: drone.max_rpm,
            actuators: drone.actuators,
            params: drone.params,
        });
        let mut data = Self {
            model: stored.model,
            rpys: vec![nalgebra::Vector3::zeros(); count],
            states: stored.states,
            started: stored.started,
            control_steps: stored.control_steps,
            contacts: stored.contacts.into(),
            failed: stored.failed.map(|message| SimulationError::Stored { message }),
            loads: stored.loads.into_iter().map(load).collect(),
            drones: drones.collect(),
            actuators,
            batteries: stored.batteries,
            wakes,
            bodies: Bodies {
                drones: Vec::with_capacity(count),
                gravity: stored.gravity,
                obstacle_drift: stored.obstacle_drift,
            },
            wind: stored.wind,
            wind_seed: stored.wind_seed,
            external_forces: (!stored.external_forces.is_empty())
                .then(|| stored.external_forces.into_iter().map(Into::into).collect()),
            memory: Memory { delay: stored.delay, states: stored.memory },
            motor_speeds: stored.motor_speeds,
            changed: true,
            // no workspace has loaded these obstacles
            obstacle_revision: if stored.obstacles.is_some() { unique() } else { 0 },
            stamp: 0,
            obstacles: stored.obstacles.map(Into::into),
            marker_poses: stored.markers,
            in_mujoco: stored.warm_start.is_some(),
            warm_start: stored.warm_start.unwrap_or_else(|| vec![0.0; 6 * count]),
        };
        data.update_rpys();
        Ok(data)
    }
}

impl Stored {
    /// Returns an error unless the fields are consistent and every number is in its range.
    fn validate(&self) -> Result<(), String> {
        let count = self.states.len();
        if !(1..=Simulation::MAX_DRONES).contains(&count) {
            return Err(format!("{count} states, expected 1 to {}", Simulation::MAX_DRONES));
        }
        let warm_start = self.warm_start.as_ref().map_or(6 * count, Vec::len);
        let wind = self.wind.as_ref().map_or(count, WindField::num_drones);
        let has_batteries = self.drones.iter().any(|drone| drone.params.battery.is_some());
        let batteries = if has_batteries || !self.batteries.is_empty() { count } else { 0 };
        let forces = if self.external_forces.is_empty() { 0 } else { count };
        for (field, got, expected) in [
            ("started", self.started.len(), count),
            ("drones", self.drones.len(), count),
            ("motor_speeds", self.motor_speeds.len(), count),
            ("batteries", self.batteries.len(), batteries),
            ("loads", self.loads.len(), count),
            ("external_forces", self.external_forces.len(), forces),
            ("wind", wind, count),
            ("warm_start", warm_start, 6 * count),
        ] {
            if got != expected {
                return Err(format!("`{field}` has {}, expected {expected}", crate::count(got, "entry")));
            }
        }
        // the number of control steps depends on the model, see `SimData::validate`
        if !self.memory.len().is_multiple_of(count) || self.memory.is_empty() != (self.delay == 0) {
            return Err(format!("`memory` has {} states, expected a multiple of {count}", self.memory.len()));
        }
        let is_invalid =
            |state: &DroneState| out_of_range(state).is_some() || state.attitude.coords.norm_squared() <= 1e-6;
        if self.states.iter().chain(&self.started).chain(&self.memory).any(is_invalid) {
            return Err("a state is invalid, expected finite numbers below 1e10 and a nonzero quaternion".into());
        }
        for (index, drone) in self.drones.iter().enumerate() {
            drone.validate().map_err(|error| format!("drone {index}: {error}"))?;
        }
        if let Some(state) = self.batteries.iter().find(|state| !state.is_valid()) {
            let expected = "a charge from 0 to 1, and a voltage and a current that are finite and not negative";
            return Err(format!("a battery is {state:?}, expected {expected}"));
        }
        let numbers = self.motor_speeds.iter().flatten().chain(self.warm_start.iter().flatten());
        let numbers = numbers.chain(self.external_forces.iter().flatten());
        if let Some(x) = numbers.chain([&self.gravity, &self.obstacle_drift]).find(|x| !x.is_finite()) {
            return Err(format!("a number is {x}, expected finite numbers"));
        }
        if self.gravity.abs() > World::MAX_GRAVITY {
            return Err(SimulationError::Gravity { got: self.gravity }.to_string());
        }
        // later steps cannot overflow the counter
        if self.control_steps > 1 << 60 {
            return Err(format!("`control_steps` is {}, expected fewer than 2^60", self.control_steps));
        }
        let is_unknown = |contact: &Contact| {
            let other = if let Touched::Drone(other) = contact.with { other } else { 0 };
            contact.drone.max(other) >= count
        };
        if let Some(contact) = self.contacts.iter().find(|contact| is_unknown(contact)) {
            return Err(format!("the contact {contact:?} refers to a missing drone, expected indices below {count}"));
        }
        for (index, obstacle) in self.obstacles.iter().flatten().enumerate() {
            obstacle.validate(&format!("obstacle {index}")).map_err(|error| error.to_string())?;
        }
        for (index, pose) in &self.markers {
            if *index > u32::MAX as usize || pose.position.iter().chain(&pose.rpy).any(|x| x.is_nan() || x.abs() > 1e6)
            {
                return Err(format!("marker {index} is out of range, expected a pose of finite numbers up to 1e6"));
            }
        }
        Ok(())
    }
}

impl StoredDrone {
    fn validate(&self) -> Result<(), String> {
        // randomized parameters may have a thrust-to-weight ratio below 1
        let params = DroneParams { thrust_to_weight: self.params.thrust_to_weight.max(1.0), ..self.params.clone() };
        params.validate().map_err(|error| error.to_string())?;
        self.actuators.validate().map_err(|error| error.to_string())?;
        if !(self.max_rpm.is_finite() && self.max_rpm >= 0.0 && self.motors.is_valid()) {
            return Err("the motors have a negative or non-finite number, or an invalid queue index".into());
        }
        Ok(())
    }
}
