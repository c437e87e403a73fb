use crate::action::ActionDecoder;
use crate::engine::flight::{Airframes, Flow, LANES, Lanes, advance, compute_downwash, compute_rpys, find_clear};
use crate::engine::{Engine, Lookout};
use crate::env::{EndReason, EnvError, Phase, Task};
use crate::state::DroneState;
use crate::wrappers::Guard;

use super::stage::{Ended, Seat, Slot, Stage};
use super::{Autoreset, OnFault};

/// What is the same for all environments of a batch.
#[derive(Debug, Clone)]
pub(super) struct Common {
    pub drones: usize,
    pub action_size: usize,
    pub observation_size: usize,
    pub autoreset: Autoreset,
    pub on_fault: OnFault,
    /// How lanes fly; `None` where nothing flies as a lane.
    pub flow: Option<Flow>,
    pub downwash: bool,
    /// Physics steps of a control step.
    pub substeps: u32,
    /// Airframes of all environments, one per drone, where they are the same.
    pub frames: Vec<Airframes>,
    /// Numbers of an environment's pictures: bytes of colour, and pixels of depth and of objects.
    pub pictures: [usize; 3],
}

/// Neighbouring environments, whole blocks of them, with their rows of all buffers; a buffer that is not used is empty.
pub(super) struct Piece<'a, T> {
    /// Index of the first one.
    pub first: usize,
    pub slots: &'a mut [Slot<T>],
    pub lanes: &'a mut [Lanes],
    pub frames: &'a mut [Airframes],
    pub warm_starts: &'a mut [f64],
    pub lookouts: &'a mut [Lookout],
    pub actions: &'a [f32],
    pub mask: &'a [bool],
    pub observations: &'a mut [f32],
    pub finals: &'a mut [f32],
    pub rewards: &'a mut [f32],
    pub terminated: &'a mut [bool],
    pub truncated: &'a mut [bool],
    pub rgb: &'a mut [u8],
    pub depth: &'a mut [f32],
    pub objects: &'a mut [[i32; 2]],
}

/// The first so many entries and the rest; both empty of an empty one.
fn cut<X>(slice: &mut [X], at: usize) -> (&mut [X], &mut [X]) {
    let at = at.min(slice.len());
    slice.split_at_mut(at)
}

impl<'a, T> Piece<'a, T> {
    /// So many blocks of the front, and the rest.
    pub fn split(self, common: &Common, blocks: usize) -> (Self, Self) {
        let count = (blocks * LANES).min(self.slots.len());
        let drones = common.drones;
        let [rgb, depth, objects] = common.pictures;
        let (slots, slots2) = cut(self.slots, count);
        let (lanes, lanes2) = cut(self.lanes, blocks * drones);
        let (frames, frames2) = cut(self.frames, blocks * drones);
        let (warm_starts, warm_starts2) = cut(self.warm_starts, 6 * drones * count);
        let (lookouts, lookouts2) = cut(self.lookouts, drones * count);
        let (actions, actions2) = self.actions.split_at((common.action_size * count).min(self.actions.len()));
        let (mask, mask2) = self.mask.split_at(count.min(self.mask.len()));
        let (observations, observations2) = cut(self.observations, common.observation_size * count);
        let (finals, finals2) = cut(self.finals, common.observation_size * count);
        let (rewards, rewards2) = cut(self.rewards, count);
        let (terminated, terminated2) = cut(self.terminated, count);
        let (truncated, truncated2) = cut(self.truncated, count);
        let (rgb, rgb2) = cut(self.rgb, rgb * count);
        let (depth, depth2) = cut(self.depth, depth * count);
        let (objects, objects2) = cut(self.objects, objects * count);
        (
            Piece {
                first: self.first,
                slots,
                lanes,
                frames,
                warm_starts,
                lookouts,
                actions,
                mask,
                observations,
                finals,
                rewards,
                terminated,
                truncated,
                rgb,
                depth,
                objects,
            },
            Piece {
                first: self.first + count,
                slots: slots2,
                lanes: lanes2,
                frames: frames2,
                warm_starts: warm_starts2,
                lookouts: lookouts2,
                actions: actions2,
                mask: mask2,
                observations: observations2,
                finals: finals2,
                rewards: rewards2,
                terminated: terminated2,
                truncated: truncated2,
                rgb: rgb2,
                depth: depth2,
                objects: objects2,
            },
        )
    }

    /// An environment's place.
    pub fn seat(&mut self, common: &Common, index: usize) -> Seat<'_, T> {
        let (block, drones) = (index / LANES, common.drones);
        let own_frames = if self.frames.is_empty() { 0..0 } else { block * drones..(block + 1) * drones };
        Seat {
            slot: &mut self.slots[index],
            lanes: &mut self.lanes[block * drones..][..drones],
            lane: index % LANES,
            warm_start: &mut self.warm_starts[6 * drones * index..][..6 * drones],
            frames: &mut self.frames[own_frames],
        }
    }
}

/// What an environment does in a step.
#[derive(Debug, Clone, PartialEq)]
enum Turn {
    Fly,
    Begin,
    Fail(EnvError),
}

/// A thread's memory for the block that it works on.
#[derive(Debug)]
pub(super) struct Desk {
    /// Motor speeds of every environment and drone, rpm.
    commands: Vec<[f64; 4]>,
    /// Lanes as they were, of environments that do not fly as lanes.
    saved: Vec<(DroneState, [f64; 4], [f64; 4])>,
    turns: Vec<Turn>,
    /// Makes velocities safe, where it is asked for.
    guard: Option<Guard>,
    /// An action on its way through the guard.
    action: Vec<f64>,
}

impl Desk {
    pub fn set_guard(&mut self, guard: Guard) {
        self.guard = Some(guard);
    }

    pub fn new(drones: usize) -> Self {
        Self {
            commands: vec![[0.0; 4]; LANES * drones],
            saved: vec![(DroneState::default(), [0.0; 4], [0.0; 4]); LANES * drones],
            turns: vec![Turn::Fly; LANES],
            guard: None,
            action: Vec::new(),
        }
    }
}

/// Environments that failed.
pub(super) type Faults = std::sync::Mutex<Vec<(usize, EnvError)>>;

fn note(faults: &Faults, environment: usize, error: EnvError) {
    faults.lock().unwrap_or_else(std::sync::PoisonError::into_inner).push((environment, error));
}

/// One thread's work on a piece.
pub(super) struct Worker<'a, T> {
    pub common: &'a Common,
    pub stage: &'a mut Stage<T>,
    pub desk: &'a mut Desk,
    pub flown: &'a mut u64,
    pub faults: &'a Faults,
}

impl<T: Task> Worker<'_, T> {
    /// A control step of every environment.
    pub fn step(&mut self, mut piece: Piece<'_, T>) {
        let count = piece.slots.len();
        for block in 0..count.div_ceil(LANES) {
            let range = block * LANES..count.min((block + 1) * LANES);
            let clear = self.command(&mut piece, range.clone());
            self.fly(&mut piece, range.clone(), &clear);
            for index in range {
                self.conclude(&mut piece, index, clear[index % LANES]);
            }
        }
    }

    /// Says what every environment of a block does, makes motor speeds of the actions of those that fly, and tells which of
    /// them fly as lanes.
    fn command(&mut self, piece: &mut Piece<'_, T>, range: std::ops::Range<usize>) -> [bool; LANES] {
        let (common, drones) = (self.common, self.common.drones);
        let mut any = false;
        let mut plain = [false; LANES];
        for index in range.clone() {
            let lane = index % LANES;
            let action = &piece.actions[common.action_size * index..][..common.action_size];
            let turn = self.turn(&piece.slots[index], action);
            let flies = turn == Turn::Fly;
            self.desk.turns[lane] = turn;
            piece.slots[index].ended = None;
            if !flies {
                continue;
            }
            let env = &mut self.stage.env;
            let (slot, block) = (&mut piece.slots[index], index / LANES);
            let lanes = &mut piece.lanes[block * drones..][..drones];
            let numbers = action.iter().map(|&x| f64::from(x));
            if slot.decoders.is_empty() {
                env.decode(numbers);
            } else {
                for (drone, lanes) in lanes.iter().enumerate() {
                    env.simulation.place(drone, lanes.state(lane), nalgebra::Vector3::zeros());
                }
                let decoders: &mut Vec<ActionDecoder> = &mut slot.decoders;
                std::mem::swap(&mut env.decoders, decoders);
                let mut safe = Ok(false);
                if let Some(guard) = &mut self.desk.guard {
                    self.desk.action.clear();
                    self.desk.action.extend(numbers);
                    let states = env.simulation.states();
                    safe = guard.make_safe(states, env.space_of_actions(), &mut self.desk.action);
                    env.decode(self.desk.action.iter().copied());
                } else {
                    env.decode(numbers);
                }
                std::mem::swap(&mut env.decoders, decoders);
                if let Err(error) = safe {
                    self.desk.turns[lane] = Turn::Fail(error);
                    continue;
                }
            }
            // what is no number shall be an error where such things are
            plain[lane] = slot.plain && env.commands.iter().flatten().all(|rpm| rpm.is_finite());
            any |= plain[lane];
            for (drone, lanes) in lanes.iter_mut().enumerate() {
                let command = &env.commands[drone];
                self.desk.commands[lane * drones + drone] = *command;
                let target = match &mut slot.equipment {
                    Some(equipment) => equipment.command(drone, command),
                    None => env.simulation.equipment_mut().command(drone, command),
                };
                lanes.set_target(lane, &target);
            }
        }
        match &common.flow {
            Some(flow) if any => self.find_clear(piece, range, &plain, flow),
            _ => [false; LANES],
        }
    }

    fn turn(&self, slot: &Slot<T>, action: &[f32]) -> Turn {
        match slot.episode.phase {
            Phase::Running => match action.iter().position(|x| !x.is_finite()) {
                None => Turn::Fly,
                Some(index) => {
                    let time = slot.control_steps as f64 * self.stage.env.simulation.control_period();
                    Turn::Fail(EnvError::Action { index, got: f64::from(action[index]), time })
                }
            },
            _ if slot.awaits_episode() && self.common.autoreset != Autoreset::Disabled => Turn::Begin,
            Phase::Over => Turn::Fail(EnvError::NeedsReset { when: "after the end of the episode" }),
            Phase::New => Turn::Fail(EnvError::NeedsReset { when: "on a new environment" }),
        }
    }

    fn find_clear(
        &mut self,
        piece: &mut Piece<'_, T>,
        range: std::ops::Range<usize>,
        plain: &[bool; LANES],
        flow: &Flow,
    ) -> [bool; LANES] {
        let (common, drones, block) = (self.common, self.common.drones, range.start / LANES);
        let lanes = &piece.lanes[block * drones..][..drones];
        let own = !piece.frames.is_empty();
        let frames = if own { &piece.frames[block * drones..][..drones] } else { &common.frames };
        let mut clear = find_clear(flow.width, lanes, frames, flow.dt, common.substeps);
        for (clear, plain) in clear.iter_mut().zip(plain) {
            *clear &= plain;
        }
        if piece.lookouts.is_empty() {
            return clear;
        }
        for index in range {
            let lane = index % LANES;
            if !clear[lane] {
                continue;
            }
            let simulation = &self.stage.env.simulation;
            let equipment = piece.slots[index].equipment.as_deref().unwrap_or(simulation.equipment());
            let own = equipment.obstacles();
            let obstacles = if own.is_empty() { &simulation.world().obstacles } else { own };
            let lookouts = &mut piece.lookouts[drones * index..][..drones];
            let drift = equipment.bodies().obstacle_drift;
            clear[lane] = lanes.iter().zip(lookouts).zip(&equipment.bodies().drones).all(|((lanes, lookout), body)| {
                let state = lanes.state(lane);
                let room = body.envelope.radius(flow.dt, common.substeps, &state);
                lookout.has_room(obstacles, &state.position, room + drift)
            });
        }
        clear
    }

    /// Flies the clear environments of a block, all at once.
    fn fly(&mut self, piece: &mut Piece<'_, T>, range: std::ops::Range<usize>, clear: &[bool; LANES]) {
        let (common, drones, block) = (self.common, self.common.drones, range.start / LANES);
        let Some(flow) = &common.flow else { return };
        let flying = clear.iter().filter(|clear| **clear).count();
        if flying == 0 {
            return;
        }
        let lanes = &mut piece.lanes[block * drones..][..drones];
        let own = !piece.frames.is_empty();
        let frames = if own { &piece.frames[block * drones..][..drones] } else { &common.frames };
        // all lanes fly; those that should not are put back
        let grounded = range.map(|index| index % LANES).filter(|&lane| !clear[lane]);
        for lane in grounded.clone() {
            for (drone, lanes) in lanes.iter().enumerate() {
                self.desk.saved[lane * drones + drone] = (lanes.state(lane), lanes.rpm(lane), lanes.target(lane));
            }
        }
        if common.downwash {
            for _ in 0..common.substeps {
                compute_downwash(flow.width, lanes, frames);
                for (lanes, frames) in lanes.iter_mut().zip(frames) {
                    advance(flow, lanes, frames, 1);
                }
            }
        } else {
            for (lanes, frames) in lanes.iter_mut().zip(frames) {
                advance(flow, lanes, frames, common.substeps);
            }
        }
        for lane in grounded {
            for (drone, lanes) in lanes.iter_mut().enumerate() {
                let (state, rpm, target) = &self.desk.saved[lane * drones + drone];
                lanes.set(lane, state, rpm, target);
            }
        }
        for lanes in lanes {
            compute_rpys(flow.width, lanes);
        }
        *self.flown += u64::from(common.substeps) * flying as u64;
    }

    /// What a step brought to an environment.
    fn conclude(&mut self, piece: &mut Piece<'_, T>, index: usize, flown: bool) {
        match std::mem::replace(&mut self.desk.turns[index % LANES], Turn::Fly) {
            Turn::Fly if flown => {
                let slot = &mut piece.slots[index];
                slot.control_steps += 1;
                slot.in_mujoco = false;
                if slot.is_individual() {
                    self.whole(piece, index, Self::finish);
                } else {
                    let seat = piece.seat(self.common, index);
                    self.stage.show(&seat);
                    self.finish(piece, index, false);
                }
            }
            Turn::Fly => self.whole(piece, index, |worker, piece, index, whole| {
                let drones = worker.common.drones;
                let commands = &worker.desk.commands[(index % LANES) * drones..][..drones];
                worker.stage.env.commands.copy_from_slice(commands);
                match worker.stage.env.fly() {
                    Ok(()) => worker.finish(piece, index, whole),
                    Err(error) => worker.fail(piece, index, error, true),
                }
            }),
            Turn::Begin => {
                (piece.rewards[index], piece.terminated[index], piece.truncated[index]) = (0.0, false, false);
                // with a reset in the same step, this step has ignored its action because the start in the step before failed
                let late = self.common.autoreset == Autoreset::SameStep && piece.slots[index].start_failed;
                self.begin(piece, index, None);
                if late || piece.slots[index].start_failed {
                    self.end_without_start(piece, index);
                }
            }
            Turn::Fail(error) => {
                let running = piece.slots[index].episode.phase == Phase::Running;
                self.whole(piece, index, |worker, piece, index, _| worker.fail(piece, index, error, running));
            }
        }
    }

    /// Does something with an environment that is put on the stage whole.
    pub fn whole(
        &mut self,
        piece: &mut Piece<'_, T>,
        index: usize,
        act: impl FnOnce(&mut Self, &mut Piece<'_, T>, usize, bool),
    ) {
        let entered = self.stage.enter(&mut piece.seat(self.common, index));
        match entered {
            Ok(()) => act(self, piece, index, true),
            Err(error) => {
                let running = self.stage.env.episode.phase == Phase::Running;
                self.fail(piece, index, error, running);
            }
        }
        self.stage.leave(&mut piece.seat(self.common, index));
    }

    fn row(common: &Common, index: usize) -> std::ops::Range<usize> {
        common.observation_size * index..common.observation_size * (index + 1)
    }

    /// Lets the task look at a step of the environment on the stage, and writes what it says.
    fn finish(&mut self, piece: &mut Piece<'_, T>, index: usize, whole: bool) {
        let slot = &mut piece.slots[index];
        let (verdict, success) = match self.stage.judge(slot, whole) {
            Ok(judged) => judged,
            Err(error) => return self.fail(piece, index, error, true),
        };
        if self.stage.env.has_moving_obstacles() {
            // what was near is elsewhere now
            let lookouts = piece.lookouts.iter_mut().skip(self.common.drones * index);
            lookouts.take(self.common.drones).for_each(|lookout| *lookout = Lookout::default());
        }
        let slot = &mut piece.slots[index];
        slot.reward += verdict.reward;
        piece.rewards[index] = verdict.reward as f32;
        piece.terminated[index] = verdict.terminated;
        piece.truncated[index] = verdict.truncated;
        if let Some(reason) = verdict.end {
            self.end(piece, index, whole, reason, success);
        } else {
            self.observe(piece, index, whole);
        }
    }

    /// Ends an episode.
    fn end(&mut self, piece: &mut Piece<'_, T>, index: usize, whole: bool, reason: EndReason, success: bool) {
        let slot = &mut piece.slots[index];
        let steps = if whole { self.stage.env.simulation.control_steps() } else { slot.control_steps };
        slot.ended = Some(Ended { reason, success, steps, reward: slot.reward });
        let episode = if whole { &mut self.stage.env.episode } else { &mut slot.episode };
        (episode.phase, episode.end) = (Phase::Over, Some(reason));
        slot.ends.clear();
        slot.ends.extend_from_slice(self.stage.env.ends());
        self.observe(piece, index, whole);
        if self.common.autoreset == Autoreset::SameStep {
            let row = Self::row(self.common, index);
            piece.finals[row.clone()].copy_from_slice(&piece.observations[row]);
            if whole {
                self.start(piece, index, None);
            } else {
                self.begin(piece, index, None);
            }
        }
    }

    /// Reports an episode that could not start, as a fault after zero steps.
    fn end_without_start(&mut self, piece: &mut Piece<'_, T>, index: usize) {
        piece.truncated[index] = true;
        piece.slots[index].ended = Some(Ended { reason: EndReason::Fault, success: false, steps: 0, reward: 0.0 });
        if self.common.autoreset == Autoreset::SameStep {
            let row = Self::row(self.common, index);
            piece.finals[row.clone()].copy_from_slice(&piece.observations[row]);
        }
    }

    fn observe(&mut self, piece: &mut Piece<'_, T>, index: usize, whole: bool) {
        let row = Self::row(self.common, index);
        let seen = self.stage.observe(&mut piece.slots[index], whole, &mut piece.observations[row]);
        if let Err(error) = seen {
            note(self.faults, piece.first + index, error);
        }
    }

    /// Starts an episode.
    pub fn begin(&mut self, piece: &mut Piece<'_, T>, index: usize, seed: Option<u64>) {
        self.whole(piece, index, |worker, piece, index, _| worker.start(piece, index, seed));
    }

    /// Starts an episode of the environment on the stage.
    fn start(&mut self, piece: &mut Piece<'_, T>, index: usize, seed: Option<u64>) {
        (piece.slots[index].reward, piece.slots[index].begun) = (0.0, true);
        piece.slots[index].ends.clear();
        for lookout in piece.lookouts.iter_mut().skip(self.common.drones * index).take(self.common.drones) {
            *lookout = Lookout::default();
        }
        let started = self.stage.env.begin(seed);
        piece.slots[index].start_failed = started.is_err();
        match started {
            Ok(()) => self.observe(piece, index, true),
            Err(error) => {
                self.stage.env.episode.phase = Phase::New;
                note(self.faults, piece.first + index, error);
            }
        }
    }

    /// An environment, on the stage, that has failed: its episode is over, if it was in one.
    fn fail(&mut self, piece: &mut Piece<'_, T>, index: usize, error: EnvError, running: bool) {
        note(self.faults, piece.first + index, error);
        if piece.rewards.is_empty() {
            return;
        }
        // what has ended already is not cut off once more
        (piece.rewards[index], piece.terminated[index], piece.truncated[index]) = (0.0, false, running);
        if running {
            self.end(piece, index, true, EndReason::Fault, false);
        }
    }

    /// Starts episodes where the mask says so.
    pub fn reset(&mut self, mut piece: Piece<'_, T>, seed: Option<u64>) {
        for index in 0..piece.slots.len() {
            if piece.mask[index] {
                piece.slots[index].ended = None;
                self.begin(&mut piece, index, seed);
            }
        }
    }

    /// Draws what the cameras of every environment see.
    pub fn draw(&mut self, mut piece: Piece<'_, T>) {
        let [rgb, depth, objects] = self.common.pictures;
        for index in 0..piece.slots.len() {
            self.whole(&mut piece, index, |worker, piece, index, _| {
                if let Err(error) = worker.stage.env.observe_pictures() {
                    return note(worker.faults, piece.first + index, error);
                }
                let seen = worker.stage.env.seen();
                piece.rgb[rgb * index..][..rgb].copy_from_slice(&seen.rgb);
                piece.depth[depth * index..][..depth].copy_from_slice(&seen.depth);
                piece.objects[objects * index..][..objects].copy_from_slice(&seen.segmentation);
            });
        }
    }

    /// Whether the stage's engine knows lanes.
    pub fn knows_lanes(engine: &Engine) -> bool {
        matches!(engine, Engine::Hybrid(engine) if engine.can_fly())
    }
}
