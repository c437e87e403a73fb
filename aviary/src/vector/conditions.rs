//! Conditions in lanes that only some batches have: wind, sensor errors, latencies, batteries.

use super::delays::{MotorDelays, StateDelays};
use super::shard::{BatchModel, cut};
use crate::engine::flight::LANES;
use crate::env::{Episode, SensorLanes};
use crate::physics::battery::{BatteryLanes, BatteryState};
use crate::physics::wind::WindLanes;
use crate::simulation::SimData;

/// Conditions that environments need.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Needs {
    pub wind: bool,
    pub sensors: bool,
    pub batteries: bool,
    /// Largest latency of the motors, physics steps.
    pub motors: u32,
    /// Largest latency of the observed states, physics steps.
    pub states: u32,
}

impl Needs {
    /// Returns the needs of an environment, in this episode and in those that its randomization can sample.
    /// `motor_latency` is the part of the motors' latency that no randomization replaces, s.
    pub fn of<T>(episode: &Episode<T>, data: &SimData, dt: f64, motor_latency: f64) -> Self {
        let [motors, states] = data.latencies();
        let (wind, batteries) = (data.wind_field().is_some(), data.has_batteries());
        let mut needs = Self { wind, sensors: false, batteries, motors, states };
        let steps = |seconds: f64| (seconds / dt).round() as u32;
        for config in episode.randomizations() {
            needs.wind |= config.draws_wind();
            needs.motors =
                needs.motors.max(config.actuators.map_or(0, |ranges| steps(ranges.latency[1] + motor_latency)));
            if let Some(ranges) = &config.sensors {
                needs.sensors = true;
                needs.states = needs.states.max(steps(ranges.latency[1]));
            }
        }
        needs
    }

    /// Returns the size of the late commands and states in a number of blocks, bytes.
    pub fn delay_bytes(self, model: &BatchModel, blocks: usize) -> usize {
        let of_drone = MotorDelays::bytes_for(self.motors, model.substeps)
            .saturating_add(StateDelays::bytes_for(self.states, model.substeps));
        of_drone.saturating_mul(blocks * model.drones)
    }

    /// Returns the needs of both.
    #[must_use]
    pub fn and(self, other: Self) -> Self {
        Self {
            wind: self.wind || other.wind,
            sensors: self.sensors || other.sensors,
            batteries: self.batteries || other.batteries,
            motors: self.motors.max(other.motors),
            states: self.states.max(other.states),
        }
    }
}

/// Conditions of every block and drone. A list is empty if no environment needs it.
#[derive(Debug, Default)]
pub(super) struct ConditionLanes {
    pub needs: Needs,
    wind: Vec<WindLanes>,
    sensors: Vec<SensorLanes>,
    batteries: Vec<BatteryLanes>,
    motors: Vec<MotorDelays>,
    states: Vec<StateDelays>,
}

impl ConditionLanes {
    /// Extends the lists of a number of blocks for more needs.
    pub fn extend(&mut self, needs: Needs, model: &BatchModel, blocks: usize) {
        let (count, substeps) = (blocks * model.drones, model.substeps);
        let needs = self.needs.and(needs);
        if needs.wind {
            self.wind.resize_with(count, || WindLanes::new(model.dt));
        }
        if needs.sensors {
            self.sensors.resize_with(count, SensorLanes::default);
        }
        if needs.batteries {
            self.batteries.resize_with(count, BatteryLanes::default);
        }
        if needs.motors > self.needs.motors {
            self.motors.resize_with(count, MotorDelays::default);
            self.motors.iter_mut().for_each(|motors| motors.extend(needs.motors, substeps));
        }
        if needs.states > self.needs.states {
            self.states.resize_with(count, StateDelays::default);
            self.states.iter_mut().for_each(|states| states.extend(needs.states, substeps));
        }
        self.needs = needs;
    }

    pub fn slices(&mut self) -> ConditionSlices<'_> {
        let Self { wind, sensors, batteries, motors, states, .. } = self;
        ConditionSlices { wind, sensors, batteries, motors, states }
    }

    /// Sets all batteries to those of the data of an environment.
    pub fn start_batteries(&mut self, data: &SimData) {
        let drones = data.states().len();
        for (index, batteries) in self.batteries.iter_mut().enumerate() {
            if let Some((battery, state)) = data.battery(index % drones) {
                (0..LANES).for_each(|lane| batteries.set(lane, &battery, state));
            }
        }
    }

    /// Returns the state of the battery in a lane of one block and drone, if it has one.
    pub fn battery(&self, index: usize, lane: usize) -> Option<BatteryState> {
        self.batteries.get(index)?.state(lane)
    }

    /// Returns the size in bytes.
    pub fn bytes(&self) -> usize {
        size_of_val(&self.wind[..])
            + size_of_val(&self.sensors[..])
            + size_of_val(&self.batteries[..])
            + size_of_val(&self.motors[..])
            + size_of_val(&self.states[..])
            + self.motors.iter().map(MotorDelays::bytes).sum::<usize>()
            + self.states.iter().map(StateDelays::bytes).sum::<usize>()
    }
}

/// Slices of [`ConditionLanes`].
pub(super) struct ConditionSlices<'a> {
    pub wind: &'a mut [WindLanes],
    pub sensors: &'a mut [SensorLanes],
    pub batteries: &'a mut [BatteryLanes],
    pub motors: &'a mut [MotorDelays],
    pub states: &'a mut [StateDelays],
}

impl<'a> ConditionSlices<'a> {
    pub fn split(self, at: usize) -> (Self, Self) {
        let (wind, wind2) = cut(self.wind, at);
        let (sensors, sensors2) = cut(self.sensors, at);
        let (batteries, batteries2) = cut(self.batteries, at);
        let (motors, motors2) = cut(self.motors, at);
        let (states, states2) = cut(self.states, at);
        (
            Self { wind, sensors, batteries, motors, states },
            Self { wind: wind2, sensors: sensors2, batteries: batteries2, motors: motors2, states: states2 },
        )
    }

    /// Returns the conditions of one block.
    pub fn block(&mut self, block: usize, drones: usize) -> ConditionSlices<'_> {
        fn part<X>(list: &mut [X], block: usize, drones: usize) -> &mut [X] {
            if list.is_empty() { list } else { &mut list[block * drones..][..drones] }
        }
        ConditionSlices {
            wind: part(self.wind, block, drones),
            sensors: part(self.sensors, block, drones),
            batteries: part(self.batteries, block, drones),
            motors: part(self.motors, block, drones),
            states: part(self.states, block, drones),
        }
    }

    /// Sets a lane of one block to the state of an environment: wind, latencies and batteries, and, if `parameters` is
    /// set, also the sensors.
    pub fn set<T>(&mut self, lane: usize, data: &SimData, episode: &Episode<T>, substeps: u32, parameters: bool) {
        for (drone, wind) in self.wind.iter_mut().enumerate() {
            match data.wind_field() {
                Some(field) => wind.set(lane, field, drone),
                None if parameters => wind.clear(lane),
                None => {}
            }
        }
        for (drone, batteries) in self.batteries.iter_mut().enumerate() {
            match data.battery(drone) {
                Some((battery, state)) => batteries.set(lane, &battery, state),
                None => batteries.clear(lane),
            }
        }
        for (drone, motors) in self.motors.iter_mut().enumerate() {
            motors.set(lane, data, drone, substeps);
        }
        for (drone, states) in self.states.iter_mut().enumerate() {
            states.set(lane, data, drone, substeps);
        }
        if parameters {
            for (drone, sensors) in self.sensors.iter_mut().enumerate() {
                match episode.randomizer() {
                    Some(randomizer) => sensors.set(lane, randomizer, drone),
                    None => sensors.clear(lane),
                }
            }
        }
    }

    /// Reads wind, latencies and batteries of a lane of one block.
    pub fn read(&self, lane: usize, data: &mut SimData, substeps: u32) {
        if let Some(field) = data.wind_field_mut() {
            for (drone, wind) in self.wind.iter().enumerate() {
                wind.read(lane, field, drone);
            }
        }
        for (drone, batteries) in self.batteries.iter().enumerate() {
            if let Some(state) = batteries.state(lane) {
                data.set_battery_state(drone, state);
            }
        }
        for (drone, motors) in self.motors.iter().enumerate() {
            data.set_queued_commands(drone, motors.queue(lane, substeps));
        }
        for (drone, states) in self.states.iter().enumerate() {
            let (present, control_steps) = (data.states()[drone], data.control_steps());
            data.set_recorded_states(drone, states.states(lane, present, control_steps, substeps));
        }
    }
}
