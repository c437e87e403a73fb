//! Late commands and late observations of the drones in a block, in lanes.
//!
//! Motors and sensors are late by whole physics steps. Only one observation counts in a control step, and a command is
//! constant during a control step, so that one state and one command are kept per control step.

use nalgebra::Vector3;

use crate::engine::flight::{LANES, Lanes, LateCommands, Record};
use crate::math::Row;
use crate::simulation::SimData;
use crate::state::{DroneState, attitude_from_wxyz, wxyz};

/// Numbers of the last control steps, newest first.
type History<const N: usize> = Vec<[Row; N]>;

/// Adds the newest numbers of some lanes to a history, and drops their oldest ones.
fn shift<const N: usize>(history: &mut History<N>, newest: &[Row; N], lanes: &[bool; LANES]) {
    if lanes == &[true; LANES] {
        history.rotate_right(1);
        if let Some(first) = history.first_mut() {
            *first = *newest;
        }
        return;
    }
    for lane in (0..LANES).filter(|&lane| lanes[lane]) {
        let mut numbers = lane_of(newest, lane);
        for rows in &mut *history {
            for (row, number) in rows.iter_mut().zip(&mut numbers) {
                std::mem::swap(&mut row[lane], number);
            }
        }
    }
}

/// Returns the size of a history for latencies up to `max` physics steps, bytes.
fn history_bytes<const N: usize>(max: u32, substeps: u32) -> usize {
    max.div_ceil(substeps) as usize * size_of::<[Row; N]>()
}

/// Extends a history to the length for latencies up to `max` physics steps.
fn extend<const N: usize>(history: &mut History<N>, max: u32, substeps: u32) {
    let length = max.div_ceil(substeps) as usize;
    history.reserve_exact(length.saturating_sub(history.len()));
    history.resize(length, [[0.0; LANES]; N]);
}

/// Commands that reach the motors of one drone of a block late.
#[derive(Debug, Clone, Default)]
pub(super) struct MotorDelays {
    /// Latency, physics steps.
    steps: [u32; LANES],
    /// Commands of the control steps before the next one, rpm.
    past: History<4>,
}

impl MotorDelays {
    /// Returns the size for latencies up to `max` physics steps, bytes.
    pub fn bytes_for(max: u32, substeps: u32) -> usize {
        history_bytes::<4>(max, substeps)
    }

    /// Makes room for latencies up to `max` physics steps, with `substeps` physics steps per control step.
    pub fn extend(&mut self, max: u32, substeps: u32) {
        extend(&mut self.past, max, substeps);
    }

    /// Returns true if a lane has a latency.
    pub fn is_late(&self) -> bool {
        self.steps != [0; LANES]
    }

    /// Sets a lane to the motors of a drone.
    pub fn set(&mut self, lane: usize, data: &SimData, drone: usize, substeps: u32) {
        let queue = data.queued_commands(drone);
        self.steps[lane] = queue.len() as u32;
        for (position, command) in queue.enumerate() {
            let past = &mut self.past[issued(self.steps[lane], position as u32, substeps)];
            past.iter_mut().zip(command).for_each(|(row, speed)| row[lane] = speed);
        }
    }

    /// Returns the queue of a drone's motors: the commands that arrive in the next physics steps, as many as the
    /// latency.
    pub fn queue(&self, lane: usize, substeps: u32) -> impl Iterator<Item = [f64; 4]> {
        let steps = self.steps[lane];
        (0..steps).map(move |position| lane_of(&self.past[issued(steps, position, substeps)], lane))
    }

    /// Computes which commands reach the motors during the next control step.
    pub fn arrive(&self, lanes: &Lanes, late: &mut LateCommands, substeps: u32) {
        for lane in 0..LANES {
            let (whole, rest) = ((self.steps[lane] / substeps) as usize, self.steps[lane] % substeps);
            let arriving = match whole.checked_sub(1) {
                None => lanes.command(lane),
                Some(index) => lane_of(&self.past[index], lane),
            };
            // nothing is early where the command arrives at the first physics step
            let early = if rest > 0 { lane_of(&self.past[whole], lane) } else { arriving };
            late.arrival[lane] = f64::from(rest);
            late.early.iter_mut().zip(early).for_each(|(row, speed)| row[lane] = speed);
            late.late.iter_mut().zip(arriving).for_each(|(row, speed)| row[lane] = speed);
        }
    }

    /// Adds the commands of the control step that some lanes have flown.
    pub fn commit(&mut self, lanes: &Lanes, flew: &[bool; LANES]) {
        shift(&mut self.past, lanes.commands(), flew);
    }

    /// Returns the size on the heap in bytes.
    pub fn bytes(&self) -> usize {
        size_of_val(&self.past[..])
    }
}

/// Returns the index in the past of the command that arrives `position` physics steps from now under a latency.
fn issued(latency: u32, position: u32, substeps: u32) -> usize {
    (latency - position).div_ceil(substeps) as usize - 1
}

/// Late observations of one drone of a block.
///
/// A latency of n physics steps and control steps of m physics steps determine the physics step of each control step
/// whose first state is observed later: m − n mod m, or the first one if n is a multiple of m.
#[derive(Debug, Clone, Default)]
pub(super) struct StateDelays {
    /// Latency, physics steps.
    steps: [u32; LANES],
    /// Recorded states of the last control steps.
    past: History<13>,
}

impl StateDelays {
    /// Returns the size for latencies up to `max` physics steps, bytes.
    pub fn bytes_for(max: u32, substeps: u32) -> usize {
        history_bytes::<13>(max, substeps)
    }

    /// Makes room for latencies up to `max` physics steps, with `substeps` physics steps per control step.
    pub fn extend(&mut self, max: u32, substeps: u32) {
        extend(&mut self.past, max, substeps);
    }

    /// Returns true if a lane has a latency.
    pub fn is_late(&self) -> bool {
        self.steps != [0; LANES]
    }

    /// Returns the physics steps of a control step whose first states are recorded; infinity for none.
    pub fn recorded_steps(&self, substeps: u32) -> Row {
        std::array::from_fn(|lane| match self.steps[lane] {
            0 => f64::INFINITY,
            latency => f64::from((substeps - latency % substeps) % substeps),
        })
    }

    /// Sets a lane to the remembered states of a drone.
    pub fn set(&mut self, lane: usize, data: &SimData, drone: usize, substeps: u32) {
        let (latency, states) = data.recorded_states(drone);
        self.steps[lane] = latency;
        if latency == 0 {
            return;
        }
        let count = states.len() as u64;
        let newest = data.control_steps() + count - 1;
        for (index, state) in states.enumerate() {
            let ago = ((newest - index as u64) % count) as usize;
            // the state at the end of the last control step is the present one
            let ago = if latency.is_multiple_of(substeps) { ago.checked_sub(1) } else { Some(ago) };
            let Some(past) = ago.map(|ago| &mut self.past[ago]) else { continue };
            past.iter_mut().zip(numbers(state)).for_each(|(row, number)| row[lane] = number);
        }
    }

    /// Returns the remembered states of a lane, in the order of [`SimData::recorded_states`]. `present` is the state
    /// after `control_steps` steps.
    pub fn states(
        &self,
        lane: usize,
        present: DroneState,
        control_steps: u64,
        substeps: u32,
    ) -> impl Iterator<Item = DroneState> {
        let latency = self.steps[lane];
        let count = if latency == 0 { 0 } else { u64::from(latency / substeps) + 1 };
        (0..count).map(move |index| {
            let ago = ((control_steps + count - 1 - index) % count) as usize;
            let ago = if latency.is_multiple_of(substeps) { ago.checked_sub(1) } else { Some(ago) };
            ago.map_or(present, |ago| {
                let [px, py, pz, w, x, y, z, vx, vy, vz, a, b, c] = lane_of(&self.past[ago], lane);
                DroneState {
                    position: Vector3::new(px, py, pz),
                    attitude: attitude_from_wxyz([w, x, y, z]),
                    velocity: Vector3::new(vx, vy, vz),
                    angular_velocity: Vector3::new(a, b, c),
                }
            })
        })
    }

    /// Adds the recorded states of the control step that some lanes have flown, and writes the observed states to
    /// `seen`.
    pub fn observe(&mut self, lanes: &Lanes, record: &Record, seen: &mut Lanes, flew: &[bool; LANES], substeps: u32) {
        shift(&mut self.past, &record.state, flew);
        seen.copy_motion(lanes);
        for (lane, latency) in self.steps.into_iter().enumerate() {
            if latency > 0 {
                let oldest = &self.past[latency.div_ceil(substeps) as usize - 1];
                seen.set_numbers(lane, &lane_of(oldest, lane));
            }
        }
    }

    /// Returns the size on the heap in bytes.
    pub fn bytes(&self) -> usize {
        size_of_val(&self.past[..])
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
