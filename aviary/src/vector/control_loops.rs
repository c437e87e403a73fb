//! Control loops between actions and motors, in lanes.
//!
//! The loops of a batch have the settings of the worker's decoders. The memory of the loops is in rows, so that the
//! decoders of a worker serve every environment. The safety filter solves a quadratic program for one environment at a
//! time; the loops that follow it run in lanes.

use std::ops::Range;

use pulp::{Simd, WithSimd};

use super::shard::{BatchModel, Shard};
use super::worker::{StepKind, Worker};
use crate::action::ActionDecoder;
use crate::control::ControlMemory;
use crate::engine::flight::{LANES, Lanes, Part};
use crate::env::{Aviary, EnvError, Task};
use crate::math::{Pack, Real, Row, clamped};

/// Memory of the control loops of [`LANES`] drones, each in its own environment, as a structure of arrays.
#[derive(Debug, Clone)]
#[repr(align(64))]
pub(super) struct LoopLanes(ControlMemory<Row>);

impl Default for LoopLanes {
    fn default() -> Self {
        Self(ControlMemory::default().map(|&number| [number; LANES]))
    }
}

impl LoopLanes {
    fn set(&mut self, lane: usize, memory: &ControlMemory<f64>) {
        self.0.update(memory, |row, number| row[lane] = number);
    }

    fn read(&self, lane: usize) -> ControlMemory<f64> {
        self.0.map(|row| row[lane])
    }
}

/// Copies the memories of an environment's drones to decoders.
pub(super) fn read_memories(memories: &[LoopLanes], index: usize, decoders: &mut [ActionDecoder]) {
    for (memory, decoder) in memories.iter().zip(decoders) {
        decoder.set_memory(&memory.read(index % LANES));
    }
}

/// Copies the memories of decoders to those of an environment's drones.
pub(super) fn write_memories(memories: &mut [LoopLanes], index: usize, decoders: &[ActionDecoder]) {
    for (memory, decoder) in memories.iter_mut().zip(decoders) {
        memory.set(index % LANES, &decoder.memory());
    }
}

/// Clears the memories of an environment's drones, as a reset does.
pub(super) fn clear_memories(memories: &mut [LoopLanes], index: usize) {
    memories.iter_mut().for_each(|memory| memory.set(index % LANES, &ControlMemory::default()));
}

/// Control step of the loops of one drone in a block.
struct Loops<'a> {
    decoder: &'a ActionDecoder,
    /// Bounds of the four numbers of an action.
    bounds: &'a [[f64; 2]],
    /// Length of a control step, s.
    dt: f64,
    lanes: &'a Lanes,
    memory: Option<&'a mut LoopLanes>,
    /// 1 in the lanes that fly, 0 in the others, which keep their memory.
    flies: &'a Row,
    /// Actions; receives the motor speeds, rpm.
    numbers: &'a mut [Row; 4],
    count: usize,
}

impl WithSimd for Loops<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { decoder, bounds, dt, lanes, mut memory, flies, numbers, count } = self;
        for part in Part::first(simd, count) {
            let (state, mut action) = (part.motion(lanes), part.get4(numbers));
            for (number, &[low, high]) in action.iter_mut().zip(bounds) {
                *number = clamped(*number, number.all(low), number.all(high));
            }
            let (simd, index) = part.register();
            let flies = part.get(flies);
            let mut next = match &memory {
                Some(memory) => memory.0.map(
                    #[inline(always)]
                    |row| Pack::load(simd, row, index),
                ),
                None => ControlMemory::default().map(
                    #[inline(always)]
                    |&number| flies.all(number),
                ),
            };
            let mut kept = next;
            let speeds = decoder.speeds(dt, &mut next, &state, action);
            for (row, speed) in numbers.iter_mut().zip(speeds) {
                part.put(row, speed);
            }
            if let Some(memory) = &mut memory {
                kept.replace_where(flies.all(0.0).less(flies), &next);
                memory.0.update(
                    &kept,
                    #[inline(always)]
                    |row, number| number.store(row, index),
                );
            }
        }
    }
}

impl<T: Task> Worker<T> {
    /// Replaces the actions of a block by the motor speeds of the control loops. Clears the flags of environments
    /// whose motor speeds are not finite.
    pub(super) fn run_loops(
        &mut self,
        model: &BatchModel,
        shard: &mut Shard<'_, T>,
        range: Range<usize>,
        fits_lanes: &mut [bool; LANES],
    ) {
        let (block, count) = (range.start / LANES, range.len());
        let flies = self.step_kinds.map(|kind| if kind == StepKind::Fly { 1.0 } else { 0.0 });
        let block_range = block * model.drones..(block + 1) * model.drones;
        let lanes = &shard.envs.lanes[block_range.clone()];
        let memories = &mut shard.envs.control_memories;
        let mut memories = if memories.is_empty() { [].iter_mut() } else { memories[block_range].iter_mut() };
        let drones = self.env.decoders.iter().zip(lanes).zip(model.action_bounds.chunks_exact(4));
        for (((decoder, lanes), bounds), numbers) in drones.zip(&mut self.actions) {
            let (dt, memory) = (model.control_period, memories.next());
            let work = Loops { decoder, bounds, dt, lanes, memory, flies: &flies, numbers, count };
            model.width.run(count, work);
        }
        // the scalar path reports commands that are not finite
        for (lane, fits) in fits_lanes[..count].iter_mut().enumerate() {
            *fits &= self.actions.iter().flatten().all(|row| row[lane].is_finite());
        }
    }

    /// Makes the actions of the environments in a block safe that fly. An environment whose filter fails does not fly.
    pub(super) fn filter_actions(&mut self, model: &BatchModel, shard: &Shard<'_, T>, range: Range<usize>) {
        for index in range {
            let lane = index % LANES;
            if self.step_kinds[lane] == StepKind::Fly
                && let Err(error) = self.filter_action(model, shard, index)
            {
                (self.step_kinds[lane], self.errors[lane]) = (StepKind::Fail, Some(error));
            }
        }
    }

    fn filter_action(&mut self, model: &BatchModel, shard: &Shard<'_, T>, index: usize) -> Result<(), EnvError> {
        let Some(velocity_filter) = &mut self.velocity_filter else { return Ok(()) };
        let Aviary { model: env_model, .. } = &self.env;
        let lanes = &shard.envs.lanes[index / LANES * model.drones..][..model.drones];
        for (state, lanes) in self.states.iter_mut().zip(lanes) {
            *state = lanes.state(index % LANES);
        }
        let rows = self.actions.as_flattened_mut();
        self.action.clear();
        self.action.extend(rows.iter().map(|row| row[index % LANES]));
        velocity_filter.make_safe(&self.states, &env_model.action_space, &mut self.action)?;
        rows.iter_mut().zip(&self.action).for_each(|(row, number)| row[index % LANES] = *number);
        Ok(())
    }
}
