//! Late commands and late observations of the drones in a block, in lanes.
//!
//! Motors and sensors are late by whole physics steps. Only one observation counts in a control step, and a command is
//! constant during a control step, so that one state and one command are kept per control step.

use nalgebra::Vector3;

use crate::engine::flight::{LANES, LaneParams, Lanes, LateCommands, Record, Width, limit_late_targets};
use crate::math::Row;
use crate::simulation::SimData;
use crate::state::{DroneState, attitude_from_wxyz, wxyz};

/// Commands that reach the motors of one drone of a block late.
#[derive(Debug, Clone, Default)]
pub(super) struct MotorDelays {
    /// Latency, physics steps.
    steps: [u32; LANES],
    /// Command before the first one arrives, rpm.
    initial: Row,
    /// Commands of the last control steps, rpm; the index is the control step modulo the length.
    ring: Vec<[Row; 4]>,
    /// Target speeds of the rotors in the current control step.
    pub late: LateCommands,
}

impl MotorDelays {
    /// Creates memory for latencies up to `max` physics steps, with `substeps` physics steps per control step.
    pub fn new(max: u32, substeps: u32) -> Self {
        Self { ring: vec![[[0.0; LANES]; 4]; (max / substeps) as usize + 2], ..Self::default() }
    }

    /// Makes room for latencies up to `max` physics steps after `steps` control steps.
    pub fn grow(&mut self, max: u32, substeps: u32, steps: &Row<u64>) {
        let mut grown = Self { ring: Self::new(max, substeps).ring, ..self.clone() };
        for (lane, &step) in steps.iter().enumerate() {
            for step in step.saturating_sub(self.ring.len() as u64)..step {
                grown.put(lane, step, &self.get(lane, Some(step)));
            }
        }
        *self = grown;
    }

    /// Returns true if a lane has a latency.
    pub fn is_late(&self) -> bool {
        self.steps != [0; LANES]
    }

    /// Sets a lane to the motors of a drone.
    pub fn set(&mut self, lane: usize, data: &SimData, drone: usize, substeps: u32) {
        let (queue, initial) = data.queued_commands(drone);
        self.steps[lane] = queue.len() as u32;
        self.initial[lane] = initial;
        let control_steps = data.control_steps();
        for (position, command) in queue.enumerate() {
            let issued = self.issued_before(lane, substeps, position as u32);
            if let Some(step) = control_steps.checked_sub(issued) {
                self.put(lane, step, &command);
            }
        }
    }

    /// Returns the queue of a drone's motors: the commands that arrive in the next physics steps, as many as the
    /// latency.
    pub fn queue(&self, lane: usize, control_steps: u64, substeps: u32) -> impl Iterator<Item = [f64; 4]> {
        (0..self.steps[lane]).map(move |position| {
            let issued = self.issued_before(lane, substeps, position);
            self.get(lane, control_steps.checked_sub(issued))
        })
    }

    /// Returns how many control steps before the next one a command was issued that arrives `position` physics steps
    /// from now.
    fn issued_before(&self, lane: usize, substeps: u32, position: u32) -> u64 {
        u64::from((self.steps[lane] - position).div_ceil(substeps))
    }

    fn put(&mut self, lane: usize, step: u64, command: &[f64; 4]) {
        let index = (step % self.ring.len() as u64) as usize;
        self.ring[index].iter_mut().zip(command).for_each(|(row, speed)| row[lane] = *speed);
    }

    /// Returns the command of a control step, or the initial one.
    fn get(&self, lane: usize, step: Option<u64>) -> [f64; 4] {
        let index = |step: u64| (step % self.ring.len() as u64) as usize;
        step.map_or([self.initial[lane]; 4], |step| lane_of(&self.ring[index(step)], lane))
    }

    /// Stores the commands of a control step, and computes the target speeds of the rotors from the commands that
    /// arrive during it. `steps` are the control steps before this one.
    pub fn arrive(
        &mut self,
        width: Width,
        lanes: &mut Lanes,
        lane_params: &LaneParams,
        steps: &Row<u64>,
        count: usize,
        substeps: u32,
    ) {
        for lane in 0..count {
            let step = steps[lane];
            self.put(lane, step, &lanes.command(lane));
            let (whole, rest) = (u64::from(self.steps[lane] / substeps), self.steps[lane] % substeps);
            let now = self.get(lane, step.checked_sub(whole));
            let before = self.get(lane, step.checked_sub(whole + 1));
            lanes.set_target(lane, &now);
            self.late.arrival[lane] = f64::from(rest);
            self.late.early.iter_mut().zip(before).for_each(|(row, speed)| row[lane] = speed);
        }
        limit_late_targets(width, lanes, &mut self.late, lane_params, count);
    }

    /// Returns the size on the heap in bytes.
    pub fn bytes(&self) -> usize {
        size_of_val(&self.ring[..])
    }
}

/// Late observations of one drone of a block.
#[derive(Debug, Clone, Default)]
pub(super) struct StateDelays {
    /// Latency, physics steps.
    steps: [u32; LANES],
    /// State of the current control step, recorded by the kernel where the latency is not a multiple of the control
    /// period.
    pub record: Record,
    /// Recorded states of the last control steps; each lane uses as many entries as its latency needs.
    ring: Vec<[Row; 13]>,
}

impl StateDelays {
    /// Creates memory for latencies up to `max` physics steps, with `substeps` physics steps per control step.
    pub fn new(max: u32, substeps: u32) -> Self {
        let record = Record { at: [f64::INFINITY; LANES], ..Record::default() };
        Self { record, ring: vec![[[0.0; LANES]; 13]; (max / substeps) as usize + 1], ..Self::default() }
    }

    /// Returns true if a lane has a latency.
    pub fn is_late(&self) -> bool {
        self.steps != [0; LANES]
    }

    /// Makes room for latencies up to `max` physics steps.
    pub fn grow(&mut self, max: u32, substeps: u32) {
        let length = (max / substeps) as usize + 1;
        self.ring.reserve_exact(length.saturating_sub(self.ring.len()));
        self.ring.resize(length, [[0.0; LANES]; 13]);
    }

    fn length(&self, lane: usize, substeps: u32) -> u64 {
        u64::from(self.steps[lane] / substeps) + 1
    }

    /// Sets a lane to the remembered states of a drone.
    pub fn set(&mut self, lane: usize, data: &SimData, drone: usize, substeps: u32) {
        let (delay, states) = data.recorded_states(drone);
        self.steps[lane] = delay;
        let rest = delay % substeps;
        self.record.at[lane] = if rest > 0 { f64::from(substeps - rest) } else { f64::INFINITY };
        for (rows, state) in self.ring.iter_mut().zip(states) {
            rows.iter_mut().zip(numbers(state)).for_each(|(row, number)| row[lane] = number);
        }
    }

    /// Returns the remembered states of a lane, in the order of [`SimData::recorded_states`].
    pub fn states(&self, lane: usize, substeps: u32) -> impl Iterator<Item = DroneState> {
        let count = if self.steps[lane] == 0 { 0 } else { self.length(lane, substeps) as usize };
        self.ring[..count].iter().map(move |rows| {
            let [px, py, pz, w, x, y, z, vx, vy, vz, a, b, c] = lane_of(rows, lane);
            DroneState {
                position: Vector3::new(px, py, pz),
                attitude: attitude_from_wxyz([w, x, y, z]),
                velocity: Vector3::new(vx, vy, vz),
                angular_velocity: Vector3::new(a, b, c),
            }
        })
    }

    /// Stores the recorded states of the lanes that flew a control step, and writes the late states to `seen`, which
    /// has the present ones. `steps` are the control steps including this one.
    pub fn observe(&mut self, lanes: &Lanes, seen: &mut Lanes, steps: &Row<u64>, flew: &[bool; LANES], substeps: u32) {
        for lane in (0..LANES).filter(|&lane| flew[lane] && self.steps[lane] > 0) {
            let (length, step) = (self.length(lane, substeps), steps[lane]);
            let at_end = self.steps[lane].is_multiple_of(substeps);
            let state = if at_end { numbers(&lanes.state(lane)) } else { lane_of(&self.record.state, lane) };
            let newest = &mut self.ring[((step - 1) % length) as usize];
            newest.iter_mut().zip(state).for_each(|(row, number)| row[lane] = number);
            let oldest = &self.ring[(step % length) as usize];
            seen.set_numbers(lane, &lane_of(oldest, lane));
        }
    }

    /// Returns the size on the heap in bytes.
    pub fn bytes(&self) -> usize {
        size_of_val(&self.ring[..])
    }
}

/// Returns the numbers of a lane. (The method `map` of arrays would copy all lanes.)
#[inline]
fn lane_of<const N: usize>(rows: &[Row; N], lane: usize) -> [f64; N] {
    std::array::from_fn(|index| rows[index][lane])
}

fn numbers(state: &DroneState) -> [f64; 13] {
    let DroneState { position: p, velocity: v, angular_velocity: rate, attitude } = state;
    let [w, x, y, z] = wxyz(attitude);
    [p.x, p.y, p.z, w, x, y, z, v.x, v.y, v.z, rate.x, rate.y, rate.z]
}
