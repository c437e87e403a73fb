//! Exchange of one environment's data with the SIMD lanes of a batch.

use super::{SimData, SimModel};
use crate::engine::Load;
use crate::engine::flight::{LaneParams, Lanes};
use crate::physics::Wrench;
use crate::physics::wind::WindField;
use crate::state::DroneState;

impl SimData {
    /// Returns the commands that arrive at a drone's motors in the next physics steps, as many as the latency, rpm.
    pub(crate) fn queued_commands(&self, drone: usize) -> impl ExactSizeIterator<Item = [f64; 4]> {
        self.actuators[drone].queued()
    }

    /// Replaces the commands that arrive at a drone's motors in the next physics steps.
    pub(crate) fn set_queued_commands(&mut self, drone: usize, queue: impl Iterator<Item = [f64; 4]>) {
        self.actuators[drone].set_queue(queue);
    }

    /// Returns the delay of the observed states, physics steps, and a drone's recorded states by control step.
    pub(crate) fn recorded_states(&self, drone: usize) -> (u32, impl ExactSizeIterator<Item = &DroneState>) {
        (self.memory.delay, self.memory.states.iter().skip(drone).step_by(self.states.len()))
    }

    /// Replaces a drone's recorded states.
    pub(crate) fn set_recorded_states(&mut self, drone: usize, states: impl Iterator<Item = DroneState>) {
        let own = self.memory.states.iter_mut().skip(drone).step_by(self.states.len());
        own.zip(states).for_each(|(own, state)| *own = state);
    }

    /// Returns the largest latencies of motors and observations, physics steps.
    pub(crate) fn latencies(&self) -> [u32; 2] {
        [self.actuators.iter().map(|motors| motors.queued().len() as u32).max().unwrap_or(0), self.memory.delay]
    }

    /// Returns the seed of the last start of the wind.
    pub(crate) fn wind_seed(&self) -> u64 {
        self.wind_seed
    }

    /// Sets the seed of the last start of the wind, which goes on as it is.
    pub(crate) fn set_wind_seed(&mut self, seed: u64) {
        self.wind_seed = seed;
    }

    /// Replaces the states at the start of the episode by the present ones, for environments that do not keep them.
    pub(crate) fn forget_start(&mut self) {
        self.started.copy_from_slice(&self.states);
    }

    /// Returns the wind.
    pub(crate) fn wind_field(&self) -> Option<&WindField> {
        self.wind.as_ref()
    }

    /// Returns the wind, for changes of its state.
    pub(crate) fn wind_field_mut(&mut self) -> Option<&mut WindField> {
        self.wind.as_mut()
    }

    /// Returns true if both environments have the same parameters and obstacles.
    pub(crate) fn has_parameters_of(&self, other: &Self) -> bool {
        let wind = |data: &Self| data.wind.as_ref().map(|wind| *wind.config());
        wind(self) == wind(other)
            && self.memory.delay == other.memory.delay
            && self.bodies == other.bodies
            && self.obstacle_revision == other.obstacle_revision
            && self.drones.iter().zip(&other.drones).all(|(a, b)| a.params == b.params && a.actuators == b.actuators)
            && self.actuators.iter().zip(&other.actuators).all(|(a, b)| a.gains() == b.gains())
    }

    /// Copies an environment from a lane after `control_steps` steps: states, motor speeds, loads, and, if MuJoCo
    /// made the last step, the warm start of its solver.
    #[inline]
    pub(crate) fn read_lane(&mut self, lanes: &[Lanes], lane: usize, control_steps: u64, warm_start: Option<&[f64]>) {
        (self.control_steps, self.stamp, self.in_mujoco) = (control_steps, 0, warm_start.is_some());
        if let Some(warm_start) = warm_start {
            self.warm_start.copy_from_slice(warm_start);
        }
        self.contacts.clear();
        self.failed = None;
        for (drone, lanes) in lanes.iter().enumerate() {
            self.states[drone] = lanes.state(lane);
            self.rpys[drone] = lanes.rpy(lane);
            self.motor_speeds[drone] = lanes.command(lane);
            self.actuators[drone].set_rpm(&lanes.rpm(lane));
            let (rotors, force_world) = lanes.push(lane);
            self.loads[drone] = Load { rotors, external: Wrench { force_world, ..Wrench::ZERO } };
        }
    }

    /// Returns the warm start of MuJoCo's solver, if it is valid.
    pub(crate) fn warm_start(&self) -> Option<&[f64]> {
        self.in_mujoco.then_some(&self.warm_start[..])
    }

    /// Writes states, motor speeds and loads to a lane.
    pub(crate) fn write_lane(&self, lanes: &mut [Lanes], lane: usize) {
        for (drone, lanes) in lanes.iter_mut().enumerate() {
            lanes.set(lane, &self.states[drone], self.actuators[drone].rpm(), &[0.0; 4]);
            lanes.set_command(lane, &self.motor_speeds[drone]);
            lanes.set_rpy(lane, &self.rpys[drone]);
            let load = &self.loads[drone];
            lanes.set_push(lane, &load.rotors, &load.external.force_world);
        }
    }

    /// Writes parameters to a lane.
    pub(crate) fn write_lane_params(&self, model: &SimModel, lane_params: &mut [LaneParams], lane: usize) {
        for (drone, lane_params) in lane_params.iter_mut().enumerate() {
            lane_params.set(lane, &self.airframe(model, drone));
        }
    }

    /// Returns true if no drone can reach an obstacle in a control step, whatever its motors do.
    pub(crate) fn is_clear_of_obstacles(
        &self,
        model: &SimModel,
        lanes: &[Lanes],
        lane: usize,
        caches: &mut [crate::engine::ClearanceCache],
    ) -> bool {
        let (dt, substeps, obstacles) = (model.world.timestep, model.substeps(), self.obstacles(model));
        let drift = self.bodies.obstacle_drift;
        lanes.iter().zip(caches).zip(&self.bodies.drones).all(|((lanes, cache), body)| {
            let state = lanes.state(lane);
            let room = body.reach_bound.radius(dt, substeps, &state);
            cache.has_room(obstacles, &state.position, room + drift)
        })
    }

    /// Returns true if the drones of a lane do not reach an obstacle while they travel at most these distances (m)
    /// from their states in `lanes`.
    pub(crate) fn travels_clear_of_obstacles(
        &self,
        model: &SimModel,
        lanes: &[Lanes],
        lane: usize,
        travels: impl Iterator<Item = f64>,
        caches: &mut [crate::engine::ClearanceCache],
    ) -> bool {
        let (obstacles, drift) = (self.obstacles(model), self.bodies.obstacle_drift);
        let bodies = self.bodies.drones.iter();
        lanes.iter().zip(caches).zip(bodies).zip(travels).all(|(((lanes, cache), body), travel)| {
            let room = body.reach_bound.reach() + travel + drift;
            cache.has_room(obstacles, &lanes.state(lane).position, room)
        })
    }

    /// Returns the size in bytes.
    pub(crate) fn bytes(&self) -> usize {
        let texts: usize =
            self.drones.iter().map(|drone| drone.params.name.len() + drone.params.provenance.len()).sum();
        size_of::<Self>()
            + texts
            + 2 * size_of_val(&self.states[..])
            + size_of_val(&self.rpys[..])
            + size_of_val(&self.loads[..])
            + size_of_val(&self.warm_start[..])
            + size_of_val(&self.drones[..])
            + size_of_val(&self.actuators[..])
            + size_of_val(&self.batteries[..])
            + size_of_val(&self.wakes[..])
            + size_of_val(&self.bodies.drones[..])
            + self.wind.as_ref().map_or(0, WindField::bytes)
            + size_of_val(&self.memory.states[..])
            + size_of_val(&self.motor_speeds[..])
            + self.external_forces.as_deref().map_or(0, size_of_val)
            + self.own_obstacles_bytes()
    }
}
