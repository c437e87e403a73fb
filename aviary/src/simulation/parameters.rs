//! Parameters of one environment, and the quantities that engines derive from them.

use super::data::Drone;
use super::{SimData, SimModel, SimulationError};
use crate::drone::{DroneError, DroneParams};
use crate::engine::Body;
use crate::engine::flight::{Airframe, DrivenBound, FreeBody, ReachBound};
use crate::physics::actuators::{ActuatorParams, Actuators};
use crate::physics::airframe::AirframeEffects;
use crate::physics::downwash::Wake;
use crate::physics::ground_effect::GroundEffect;
use crate::physics::rotor::RotorModel;
use crate::physics::wind::{WindConfig, WindField};
use crate::world::World;
use crate::world::placement::CollisionCylinder;

impl SimData {
    /// Updates bodies and reach bounds if parameters have changed.
    pub(crate) fn refresh(&mut self, model: &SimModel) {
        if !std::mem::take(&mut self.changed) {
            return;
        }
        let (world, effects) = (&model.world, model.effects);
        let wakes: f64 = self.wakes.iter().map(|wake| wake.0.cap).sum();
        let gravity = self.bodies.gravity;
        let body = |(index, (drone, motors)): (usize, (&Drone, &Actuators))| {
            let (params, inertia) = (&drone.params, drone.params.inertia_vector());
            let free = FreeBody::new(params.mass, &inertia, gravity, world.medium);
            let (rpm, rotors) = (motors.max_rpm(), &drone.rotors);
            let speeds = [rpm; 4];
            let mut force = rotors.wrench(&speeds).thrust;
            let mut slowing = if effects.drag {
                let slope = params.drag_coefficients.into_iter().fold(0.0, f64::max);
                slope * 4.0 * rpm * (std::f64::consts::TAU / 60.0) / params.mass
            } else {
                0.0
            };
            if effects.ground && drone.ground.0.coefficient > 0.0 {
                force += force * drone.ground.0.coefficient / (drone.ground.0.clip * drone.ground.0.clip);
            }
            if effects.downwash {
                force += wakes;
            }
            if let Some(forces) = &self.external_forces {
                force += forces[index].norm();
            }
            let (mut quadratic, mut air_speed) = (0.0, 0.0);
            if let Some(wind) = &self.wind {
                let bound = wind.config().bound(params.drag_area());
                // a moving medium exerts further forces
                force += if world.medium.is_some() { f64::INFINITY } else { bound[0] };
                slowing += bound[1] / params.mass;
                quadratic = bound[2] / params.mass;
                air_speed = wind.config().air_speed_bound();
            }
            let torque = rotors.0.torque.iter().map(|row| row.iter().map(|x| x.abs()).sum::<f64>() * rpm * rpm);
            let torque = torque.map(|x| x * x).sum::<f64>().sqrt();
            let mut reach_bound = ReachBound::new(&free, 0.0, force / params.mass, torque, [slowing, quadratic]);
            if let Some(effects) = &drone.effects {
                reach_bound = reach_bound.driven_by(&free, DrivenBound::new(effects, &free, rpm, air_speed));
            }
            Body { mass: params.mass, inertia, free, reach_bound }
        };
        self.bodies.drones.clear();
        self.bodies.drones.extend(self.drones.iter().zip(&self.actuators).enumerate().map(body));
        for (body, drone) in self.bodies.drones.iter_mut().zip(&world.drones) {
            // collision cylinders always keep the size that the scene was built with
            let reach = CollisionCylinder::from(&drone.params).bounding_radius();
            body.reach_bound = body.reach_bound.reaching(reach);
        }
    }

    /// Changes the parameters of a drone's airframe. Invalid parameters are an error and stay in place.
    pub(super) fn change(&mut self, drone: usize, change: impl FnOnce(&mut DroneParams)) -> Result<(), DroneError> {
        let own = &mut self.drones[drone];
        let had_battery = own.params.battery.is_some();
        change(&mut own.params);
        let params = &mut own.params;
        // randomized parameters may have a thrust-to-weight ratio below 1
        let ratio = params.thrust_to_weight;
        params.thrust_to_weight = ratio.max(1.0);
        let result = params.validate();
        params.thrust_to_weight = ratio;
        (own.rotors, own.ground) = (RotorModel::new(&own.params), GroundEffect::new(&own.params));
        own.effects = AirframeEffects::of_params(&own.params);
        self.wakes[drone] = Wake::new(&own.params);
        if let Some(wind) = &mut self.wind {
            wind.set_area(drone, own.params.drag_area());
        }
        self.changed = true;
        if result.is_ok() && !had_battery && self.drones[drone].params.battery.is_some() {
            self.need_batteries();
            self.reset_battery(drone);
        }
        result
    }

    /// Returns true if the motors of any drone have lag.
    pub(crate) fn has_lag(&self) -> bool {
        self.actuators.iter().any(Actuators::has_lag)
    }

    /// Returns true if the lanes of any drone need [`Flow::airframe_effects`](crate::engine::flight::Flow), with the
    /// present motors or with those that a randomization can sample.
    pub(crate) fn has_airframe_effects(&self, model: &SimModel) -> bool {
        self.drones.iter().zip(&self.actuators).enumerate().any(|(index, (drone, actuators))| {
            let motors = &model.nominal_params(index).motors;
            let rises_as_it_falls = motors.rise_time == motors.fall_time && actuators.share() == actuators.fall_share();
            drone.effects.is_some() || !rises_as_it_falls
        })
    }

    /// Changes the parameters of a drone's airframe, from the next step on.
    ///
    /// # Errors
    /// [`SimulationError::Drone`] for invalid parameters, which stay in place.
    pub(crate) fn change_params(
        &mut self,
        drone: usize,
        change: impl FnOnce(&mut DroneParams),
    ) -> Result<(), SimulationError> {
        self.change(drone, change).map_err(|error| SimulationError::Drone { drone, error })
    }

    pub(super) fn check_drone(&self, drone: usize) -> Result<(), SimulationError> {
        let drones = self.drones.len();
        if drone < drones { Ok(()) } else { Err(SimulationError::NoDrone { got: drone, drones }) }
    }

    /// Replaces the parameters of a drone's airframe, from the next step on; see
    /// [`Simulation::set_airframe`](super::Simulation::set_airframe).
    ///
    /// # Errors
    /// [`SimulationError::Drone`] for invalid parameters, [`SimulationError::NoDrone`] for an index out of range; the
    /// data is unchanged.
    pub fn set_params(&mut self, drone: usize, params: DroneParams) -> Result<(), SimulationError> {
        self.check_drone(drone)?;
        let before = self.drones[drone].params.clone();
        if let Err(error) = self.change(drone, |own| *own = params) {
            // the previous parameters were valid
            let _ = self.change(drone, |own| *own = before);
            return Err(SimulationError::Drone { drone, error });
        }
        Ok(())
    }

    /// Replaces the motor parameters of a drone and resets its motors.
    ///
    /// # Errors
    /// [`SimulationError::Option`] naming an invalid setting, [`SimulationError::Model`] for data of another model,
    /// [`SimulationError::NoDrone`] for an index out of range.
    pub fn set_actuators(
        &mut self,
        model: &SimModel,
        drone: usize,
        actuators: &ActuatorParams,
    ) -> Result<(), SimulationError> {
        if self.model != model.fingerprint {
            return Err(SimulationError::Model);
        }
        self.check_drone(drone)?;
        actuators.validate()?;
        self.drones[drone].actuators = *actuators;
        // the motors stay those of the airframe that the drone was built with
        self.actuators[drone].set(model.nominal_params(drone), actuators, model.world.timestep);
        self.changed = true;
        Ok(())
    }

    /// Reserves memory for these latencies (s) of motors, without that of the airframe, and of sensors, so that later
    /// changes up to them do not allocate.
    pub(crate) fn reserve(&mut self, model: &SimModel, motors: f64, sensors: f64) {
        let steps = |seconds: f64| (seconds / model.world.timestep).round() as usize;
        let motors = motors + model.motor_latency();
        let entries = steps(sensors) / model.substeps() as usize + 1;
        let (motors, states) = (steps(motors), self.states.len() * entries);
        self.actuators.iter_mut().for_each(|actuators| actuators.reserve(motors));
        self.memory.states.reserve(states.saturating_sub(self.memory.states.len()));
    }

    /// Sets gravity (m/s², downwards), from the next step on.
    ///
    /// # Errors
    /// [`SimulationError::Gravity`] for NaN or a value out of range.
    pub fn set_gravity(&mut self, gravity: f64) -> Result<(), SimulationError> {
        if !(-World::MAX_GRAVITY..=World::MAX_GRAVITY).contains(&gravity) {
            return Err(SimulationError::Gravity { got: gravity });
        }
        self.bodies.gravity = gravity;
        self.changed = true;
        Ok(())
    }

    /// Sets the wind and restarts it from a seed; `None` for still air.
    ///
    /// # Errors
    /// [`SimulationError::Option`] naming an invalid setting; the data is unchanged.
    pub fn set_wind(&mut self, wind: Option<WindConfig>, seed: u64) -> Result<(), SimulationError> {
        self.change_wind(wind)?;
        self.reset_wind(seed);
        Ok(())
    }

    /// Sets the wind, which does not blow until it is restarted or its state is set.
    pub(crate) fn change_wind(&mut self, wind: Option<WindConfig>) -> Result<(), SimulationError> {
        let areas = self.drones.iter().map(|drone| drone.params.drag_area());
        if let Some(wind) = &wind {
            wind.validate()?;
        }
        match (wind.filter(|wind| !wind.is_calm()), &mut self.wind) {
            (Some(config), Some(field)) => field.set(config, areas)?,
            (Some(config), field) => *field = Some(WindField::of_areas(config, areas)?),
            (None, field) => *field = None,
        }
        self.changed = true;
        Ok(())
    }

    /// Restarts the wind from a seed.
    pub(crate) fn reset_wind(&mut self, seed: u64) {
        self.wind_seed = seed;
        if let Some(wind) = &mut self.wind {
            wind.reset(seed, &self.states);
        }
    }

    /// Returns the parameters of a drone for the lanes of the flight kernel.
    pub(crate) fn airframe(&self, model: &SimModel, drone: usize) -> Airframe {
        let effects = model.effects;
        // collision cylinders always keep the size that the scene was built with
        let cylinder = CollisionCylinder::from(model.nominal_params(drone));
        let Drone { params, rotors, ground, effects: own_effects, .. } = &self.drones[drone];
        Airframe {
            body: self.bodies.drones[drone].free,
            rotors: *rotors,
            ground: if effects.ground { *ground } else { GroundEffect::default() },
            drag: if effects.drag { params.drag_coefficients.into() } else { nalgebra::Vector3::zeros() },
            wake: if effects.downwash { self.wakes[drone] } else { Wake::default() },
            effects: own_effects.unwrap_or_default(),
            share: self.actuators[drone].share(),
            fall_share: self.actuators[drone].fall_share(),
            max_command: self.drones[drone].max_rpm,
            gains: *self.actuators[drone].gains(),
            max_rpm: self.actuators[drone].max_rpm(),
            cylinder: [cylinder.0.radius, cylinder.0.height],
            reach_bound: self.bodies.drones[drone].reach_bound,
        }
    }
}

#[cfg(test)]
mod tests;
