//! Batteries of the drones of a simulation.

use super::SimData;
use super::data::Drone;
use crate::physics::battery::{Battery, BatteryState};

impl SimData {
    /// Adds the states of the batteries if a drone has one.
    pub(super) fn need_batteries(&mut self) {
        if self.batteries.is_empty() && self.drones.iter().any(|drone| drone.params.battery.is_some()) {
            self.batteries = vec![BatteryState::default(); self.drones.len()];
            self.reset_batteries();
        }
    }

    /// Resets the batteries to the start of an episode, with the present rotor speeds.
    pub(super) fn reset_batteries(&mut self) {
        (0..self.batteries.len()).for_each(|drone| self.reset_battery(drone));
    }

    /// Resets a drone's battery to the start of an episode, with the present rotor speeds.
    pub(super) fn reset_battery(&mut self, drone: usize) {
        let (Drone { params, .. }, rpm) = (&self.drones[drone], self.actuators[drone].rpm());
        let charge = params.battery.map_or(0.0, |battery| battery.initial_charge);
        let state = Battery::of(params).map_or(BatteryState::default(), |battery| battery.at_rest(charge, rpm));
        self.set_battery_state(drone, state);
    }

    /// Limits the commanded motor speeds to those that the voltages allow.
    pub(super) fn limit_to_batteries(&mut self) {
        for ((drone, state), speeds) in self.drones.iter().zip(&self.batteries).zip(&mut self.motor_speeds) {
            if let Some(battery) = Battery::of(&drone.params) {
                let reach = battery.reach(state.voltage);
                *speeds = speeds.map(|rpm| rpm.min(reach));
            }
        }
    }

    /// Advances the batteries by a control step of `dt` seconds, with the present rotor speeds.
    pub(super) fn advance_batteries(&mut self, dt: f64) {
        for ((drone, actuators), state) in self.drones.iter().zip(&self.actuators).zip(&mut self.batteries) {
            if let Some(battery) = Battery::of(&drone.params) {
                *state = battery.advance(dt, state, actuators.rpm());
            }
        }
    }

    /// Returns a drone's battery and its state, if it has one.
    pub(crate) fn battery(&self, drone: usize) -> Option<(Battery, &BatteryState)> {
        Some((Battery::of(&self.drones[drone].params)?, self.batteries.get(drone)?))
    }

    /// Returns true if a drone has a battery.
    pub(crate) fn has_batteries(&self) -> bool {
        !self.batteries.is_empty()
    }

    /// Replaces the state of a drone's battery, if it has one.
    pub(crate) fn set_battery_state(&mut self, drone: usize, state: BatteryState) {
        if let Some(own) = self.batteries.get_mut(drone) {
            *own = state;
        }
    }

    /// Returns the voltage at a drone's motors, V: that of its battery, or the constant one.
    pub(crate) fn voltage(&self, drone: usize) -> f64 {
        let constant = self.drones[drone].params.motors.voltage;
        self.battery(drone).map_or(constant, |(_, state)| state.voltage)
    }
}
