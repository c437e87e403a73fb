use smallvec::SmallVec;

use crate::action::ActionDecoder;
use crate::engine::flight::{Airframes, Lanes};
use crate::env::{Aviary, EndReason, EnvError, Episode, Phase, Task, Verdict};
use crate::simulation::Equipment;

/// An episode that has ended.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ended {
    /// Why.
    pub reason: EndReason,
    /// Whether the task was fulfilled at its end.
    pub success: bool,
    /// Its length in control steps.
    pub steps: u64,
    /// Sum of its rewards.
    pub reward: f64,
}

/// What one environment has besides its place in the lanes.
#[derive(Debug)]
pub(super) struct Slot<T> {
    pub episode: Episode<T>,
    /// Its own, where environments differ; otherwise all have the threads'.
    pub equipment: Option<Box<Equipment>>,
    /// Its own, where decoders have a memory.
    pub decoders: Vec<ActionDecoder>,
    pub control_steps: u64,
    /// Whether it has ever begun an episode.
    pub begun: bool,
    /// True if its last attempt to start an episode failed.
    pub start_failed: bool,
    /// Sum of the episode's rewards so far.
    pub reward: f64,
    pub ended: Option<Ended>,
    /// How the episode ended for every drone; empty while it runs.
    pub ends: SmallVec<[Option<EndReason>; 8]>,
    /// Whether MuJoCo made its last physics step, so that there is a warm start of its solver to be kept.
    pub in_mujoco: bool,
    /// Whether it can be flown as a lane, when it is in the open.
    pub plain: bool,
}

impl<T> Slot<T> {
    /// Whether its next step begins an episode, where that is done by itself: the last one has ended, or was cut off by a change of
    /// the task.
    pub fn awaits_episode(&self) -> bool {
        match self.episode.phase {
            Phase::Running => false,
            Phase::Over => true,
            Phase::New => self.begun,
        }
    }

    /// Whether it has something that others have not, so that its thread must take it over to look at it.
    pub fn is_individual(&self) -> bool {
        self.equipment.is_some() || self.episode.is_randomized()
    }
}

/// One environment among the lanes of its block.
pub(super) struct Seat<'a, T> {
    pub slot: &'a mut Slot<T>,
    /// One per drone.
    pub lanes: &'a mut [Lanes],
    pub lane: usize,
    /// Six numbers per drone.
    pub warm_start: &'a mut [f64],
    /// One per drone, where environments differ.
    pub frames: &'a mut [Airframes],
}

/// One thread's environment, into which it puts those of the batch.
#[derive(Debug)]
pub(super) struct Stage<T> {
    pub env: Aviary<T>,
}

impl<T: Task> Stage<T> {
    /// Shows an environment that has just flown as a lane: what a task looks at, and nothing more.
    #[inline]
    pub fn show(&mut self, seat: &Seat<'_, T>) {
        let simulation = &mut self.env.simulation;
        simulation.set_progress(seat.slot.control_steps);
        for (drone, lanes) in seat.lanes.iter().enumerate() {
            simulation.place(drone, lanes.state(seat.lane), lanes.rpy(seat.lane));
            let speeds = lanes.target(seat.lane);
            simulation.set_speeds(drone, &speeds, &speeds);
            let (rotors, force) = lanes.push(seat.lane);
            simulation.set_load(drone, rotors, force);
        }
    }

    /// Exchanges what belongs to the environment, both ways.
    fn exchange(&mut self, slot: &mut Slot<T>) {
        std::mem::swap(&mut self.env.episode, &mut slot.episode);
        if let Some(equipment) = &mut slot.equipment {
            self.env.simulation.swap_equipment(equipment);
        }
        if !slot.decoders.is_empty() {
            std::mem::swap(&mut self.env.decoders, &mut slot.decoders);
        }
    }

    /// Puts an environment here, whole.
    pub fn enter(&mut self, seat: &mut Seat<'_, T>) -> Result<(), EnvError> {
        self.exchange(seat.slot);
        let simulation = &mut self.env.simulation;
        simulation.set_progress(seat.slot.control_steps);
        for (drone, lanes) in seat.lanes.iter().enumerate() {
            let state = lanes.state(seat.lane);
            simulation.place(drone, state, state.rpy());
            let commanded = match seat.slot.equipment {
                Some(_) => *simulation.equipment().commanded(drone),
                None => lanes.target(seat.lane),
            };
            let rpm = if seat.slot.plain { lanes.rpm(seat.lane) } else { *simulation.equipment().rpm(drone) };
            simulation.set_speeds(drone, &commanded, &rpm);
            let (rotors, force) = lanes.push(seat.lane);
            simulation.set_load(drone, rotors, force);
        }
        self.env.set_ends(&seat.slot.ends);
        let simulation = &mut self.env.simulation;
        simulation.resume(seat.slot.in_mujoco.then_some(&*seat.warm_start))?;
        if simulation.equipment().has_obstacles() {
            self.env.follow_obstacles()?;
        }
        Ok(())
    }

    /// Puts it back to its place.
    pub fn leave(&mut self, seat: &mut Seat<'_, T>) {
        let simulation = &mut self.env.simulation;
        simulation.refresh();
        seat.slot.control_steps = simulation.control_steps();
        seat.slot.in_mujoco = simulation.leave(seat.warm_start);
        seat.slot.plain = simulation.equipment().is_plain();
        for (drone, lanes) in seat.lanes.iter_mut().enumerate() {
            let equipment = simulation.equipment();
            let (state, target) = (&simulation.states()[drone], equipment.target(drone));
            lanes.set(seat.lane, state, equipment.rpm(drone), &target);
            let load = &simulation.loads()[drone];
            lanes.set_push(seat.lane, &load.rotors, &load.external.force_world);
        }
        for (drone, frames) in seat.frames.iter_mut().enumerate() {
            frames.set(seat.lane, &simulation.equipment().airframe(drone, simulation.effects()));
        }
        self.exchange(seat.slot);
    }

    /// Lets the task of an environment that is shown look at a step; individual ones are here whole, the others' task is
    /// taken for this.
    pub fn judge(&mut self, slot: &mut Slot<T>, whole: bool) -> Result<(Verdict, bool), EnvError> {
        let episode = &mut slot.episode;
        if !whole {
            std::mem::swap(&mut self.env.episode.task, &mut episode.task);
        }
        let verdict = self.env.judge();
        let judged = verdict.map(|verdict| {
            let success = verdict.end.is_some() && self.env.is_success(verdict.end);
            (verdict, success)
        });
        if !whole {
            std::mem::swap(&mut self.env.episode.task, &mut episode.task);
        }
        judged
    }

    /// Writes what an environment that is shown sees.
    pub fn observe(&mut self, slot: &mut Slot<T>, whole: bool, row: &mut [f32]) -> Result<(), EnvError> {
        if !whole {
            std::mem::swap(&mut self.env.episode.task, &mut slot.episode.task);
        }
        let done = self.env.observe_numbers();
        self.env.write_numbers(row);
        if !whole {
            std::mem::swap(&mut self.env.episode.task, &mut slot.episode.task);
        }
        done
    }
}
