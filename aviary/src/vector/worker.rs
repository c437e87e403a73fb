//! Work of one thread: the four stages of a control step (decode, advance, evaluate, reset) over the blocks of a
//! shard.

use std::ops::Range;
use std::sync::{Mutex, PoisonError};

use smallvec::SmallVec;

use super::actions::Actions;
use super::control_loops::clear_memories;
use super::delays::StateDelays;
use super::shard::{BatchModel, EnvSlices, Shard};
use super::{Autoreset, OnFault};
use crate::engine::flight::{LANES, LaneParams, Lanes, LateCommands, Record, compute_rpys, set_commands};
use crate::env::{
    Aviary, EndReason, EnvError, EpisodeSummary, Info, LaneFunctions, LaneStep, Phase, Sensing, SensorLanes, Task,
};
use crate::math::Row;
use crate::physics::wind::MovingWind;
use crate::simulation::{SimData, SimView};
use crate::state::DroneState;
use crate::wrappers::VelocityFilter;

/// Errors of the environments that failed, with their indices.
pub(super) type Faults = Mutex<Vec<(usize, EnvError)>>;

/// Action of an environment in a step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum StepKind {
    /// Advance the physics, in its lane or in MuJoCo.
    Fly,
    /// Start an episode.
    Begin,
    /// Fail with the error in [`Worker::errors`].
    Fail,
}

/// Memory of one thread.
#[derive(Debug)]
pub(super) struct Worker<T> {
    /// Workspaces, and the data of the current environment if it has no own data.
    pub env: Aviary<T>,
    /// Data of the environments of a block that have no own data and do not advance in lanes, or that are evaluated one
    /// at a time.
    grounded: Vec<SimData>,
    /// Actions of a block: four rows per drone.
    pub(super) actions: Vec<[Row; 4]>,
    /// Lanes of a block before the step, for environments that do not fly in lanes.
    pub(super) saved: Vec<Lanes>,
    /// Wind of a block before the step.
    pub(super) saved_wind: Vec<MovingWind>,
    /// Commands of a block that arrive during the step.
    pub(super) late: Vec<LateCommands>,
    /// States of a block during the step that the sensors observe later.
    pub(super) records: Vec<Record>,
    /// States of a block that the sensors observe.
    seen: Vec<Lanes>,
    /// Bound of the travel of every drone of a block, m; see [`Extras::travel`].
    pub(super) travels: Vec<Row>,
    pub(super) step_kinds: [StepKind; LANES],
    /// Errors of the environments of a block that fail.
    pub(super) errors: [Option<EnvError>; LANES],
    /// Drone states of the environment whose action is filtered.
    pub(super) states: Vec<DroneState>,
    /// Filter of velocity commands, if the batch has one.
    pub velocity_filter: Option<VelocityFilter>,
    /// Scratch buffer for the filtered action.
    pub(super) action: Vec<f64>,
    /// SIMD form of the task, if the batch evaluates its task in lanes.
    pub functions: Option<LaneFunctions<T>>,
    /// Observations of a block, a row per entry.
    observations: Vec<Row>,
    /// Number of physics steps computed in lanes.
    pub flown: u64,
}

impl<T: Task> Worker<T> {
    pub fn new(env: Aviary<T>, functions: Option<LaneFunctions<T>>) -> Self {
        let drones = env.simulation.num_drones();
        Self {
            grounded: vec![env.simulation.snapshot(); LANES],
            actions: vec![[[0.0; LANES]; 4]; drones],
            saved: vec![Lanes::default(); drones],
            saved_wind: Vec::new(),
            late: vec![LateCommands::default(); drones],
            records: vec![Record::default(); drones],
            seen: vec![Lanes::default(); drones],
            travels: vec![[0.0; LANES]; drones],
            step_kinds: [StepKind::Fly; LANES],
            errors: Default::default(),
            states: vec![DroneState::default(); drones],
            velocity_filter: None,
            action: Vec::new(),
            functions,
            observations: vec![[0.0; LANES]; drones * env.model.block],
            flown: 0,
            env,
        }
    }

    /// Computes a control step of every environment of a shard.
    pub fn step(&mut self, model: &BatchModel, shard: &mut Shard<'_, T>, faults: &Faults) {
        let count = shard.envs.slots.len();
        for block in 0..count.div_ceil(LANES) {
            let range = block * LANES..count.min((block + 1) * LANES);
            let fits_lanes = self.decode(model, shard, range.clone());
            shard.delay_commands(model, block, &mut self.late);
            let (flew, evaluable) = self.advance(model, shard, range.clone(), &fits_lanes);
            let done = self.evaluate_lanes(model, shard, range.clone(), &flew, &evaluable);
            for index in range.clone().filter(|index| !done[index % LANES]) {
                // an environment that fails does not always write its observation
                shard.recall_observations(model, index..index + 1);
                self.evaluate(model, shard, index, flew[index % LANES], faults);
            }
            shard.keep_observations(model, range);
        }
    }

    /// Stage 1: selects the action of every environment of a block and decodes the commands of flying environments
    /// to motor speeds. Returns true for environments that a lane can represent.
    fn decode(&mut self, model: &BatchModel, shard: &mut Shard<'_, T>, range: Range<usize>) -> [bool; LANES] {
        let (count, start, size) = (range.len(), range.start, model.action_size);
        let block = &mut shard.envs.blocks[start / LANES];
        block.ended = [false; LANES];
        let mut fits_lanes = [false; LANES];
        fits_lanes[..count].fill(model.flow.is_some());
        // with `OnFault::Error`, `check_actions` has rejected actions that are not finite before the step
        let usual = model.on_fault == OnFault::Error && block.running[..count].iter().all(|running| *running);
        self.step_kinds = [StepKind::Fly; LANES];
        if !usual {
            for index in range.clone() {
                let action = shard.step.actions.slice(size * index..size * (index + 1));
                let kind = self.step_kind(model, shard, index, action);
                self.step_kinds[index % LANES] = kind;
                fits_lanes[index % LANES] &= kind == StepKind::Fly;
            }
        }
        let actions = shard.step.actions.slice(size * start..size * (start + count));
        actions.transpose(size, model.one_action, &mut self.actions);
        if self.velocity_filter.is_some() {
            self.filter_actions(model, shard, range.clone());
        }
        // environments that do not fly may have actions that are not finite, and keep their last command
        let mut kept = SmallVec::<[[f64; 4]; LANES]>::new();
        let step_kinds = self.step_kinds;
        let grounded = (0..count).filter(|&lane| step_kinds[lane] != StepKind::Fly);
        for lane in grounded.clone() {
            fits_lanes[lane] = false;
            self.actions.iter_mut().flatten().for_each(|row| row[lane] = 0.0);
            kept.extend(lanes_and_params(model, shard, start).0.iter().map(|lanes| lanes.command(lane)));
        }
        if model.control_loops {
            self.run_loops(model, shard, range, &mut fits_lanes);
        }
        let (block, drones) = (start / LANES, model.drones);
        let EnvSlices { lanes, lane_params, conditions, .. } = &mut shard.envs;
        let block_range = block * drones..(block + 1) * drones;
        let lanes = &mut lanes[block_range.clone()];
        let lane_params = if lane_params.is_empty() { &model.lane_params[..] } else { &lane_params[block_range] };
        let batteries = conditions.block(block, drones).batteries;
        let drones = lanes.iter_mut().zip(lane_params).zip(&model.decoding).zip(&self.actions);
        for (drone, (((lanes, lane_params), decoding), actions)) in drones.enumerate() {
            set_commands(model.width, *decoding, lanes, lane_params, batteries.get(drone), count, actions);
        }
        for (lane, kept) in grounded.zip(kept.chunks_exact(lanes.len())) {
            lanes.iter_mut().zip(kept).for_each(|(lanes, command)| lanes.set_command(lane, command));
        }
        fits_lanes
    }

    /// Returns the action of an environment in this step.
    fn step_kind(&mut self, model: &BatchModel, shard: &Shard<'_, T>, index: usize, action: Actions<'_>) -> StepKind {
        let (phase, block) = (shard.envs.slots[index].episode.phase, &shard.envs.blocks[index / LANES]);
        let error = match phase {
            // `check_actions` has rejected actions that are not finite before the step
            Phase::Running if model.on_fault == OnFault::Error => return StepKind::Fly,
            Phase::Running => match action.first_bad() {
                None => return StepKind::Fly,
                Some(entry) => {
                    let time = block.steps[index % LANES] as f64 * model.control_period;
                    EnvError::Action { index: entry, got: action.get(entry), time }
                }
            },
            _ if block.awaits_episode(index % LANES, phase) && model.autoreset != Autoreset::Disabled => {
                return StepKind::Begin;
            }
            Phase::Over => EnvError::NeedsReset { when: "after the end of the episode" },
            Phase::New => EnvError::NeedsReset { when: "on a new environment" },
        };
        self.errors[index % LANES] = Some(error);
        StepKind::Fail
    }

    /// Stage 2: advances the physics of a block, in lanes where nothing is in reach, otherwise one environment at a
    /// time. Returns true for the environments that flew in lanes, and true for those whose task the lanes can
    /// evaluate:
    /// those that have advanced without a contact.
    fn advance(
        &mut self,
        model: &BatchModel,
        shard: &mut Shard<'_, T>,
        range: Range<usize>,
        fits_lanes: &[bool; LANES],
    ) -> ([bool; LANES], [bool; LANES]) {
        let flew = match &model.flow {
            Some(flow) if fits_lanes.contains(&true) => {
                self.advance_lanes(model, flow, shard, range.clone(), fits_lanes)
            }
            _ => [false; LANES],
        };
        let mut evaluable = flew;
        for index in range.filter(|index| !flew[index % LANES]) {
            let lane = index % LANES;
            if self.step_kinds[lane] != StepKind::Fly {
                continue;
            }
            let shared = &mut self.grounded[lane];
            shard.envs.load(model, &self.env.simulation.model, index, shared);
            let mut parts = shard.envs.slots[index].parts(&mut self.env, Some(shared));
            parts.workspace.commands.copy_from_slice(parts.data.motor_speeds());
            if let Err(error) = parts.advance() {
                (self.step_kinds[lane], self.errors[lane]) = (StepKind::Fail, Some(error));
            } else if parts.view().contacts().is_empty() {
                evaluable[lane] = true;
            }
            shard.envs.store(model, index, Some(shared), None);
            if !evaluable[lane] {
                // the rows of a task know nothing of contacts, so that the task leaves them before they are updated
                shard.envs.load_task(model, self.functions, index);
            }
        }
        (flew, evaluable)
    }

    /// Stage 3 in lanes: evaluates the task of environments and writes their rewards and observations. Returns true
    /// for the environments whose step is complete.
    fn evaluate_lanes(
        &mut self,
        model: &BatchModel,
        shard: &mut Shard<'_, T>,
        range: Range<usize>,
        flew: &[bool; LANES],
        evaluable: &[bool; LANES],
    ) -> [bool; LANES] {
        let mut done = [false; LANES];
        if !evaluable.contains(&true) {
            return done;
        }
        let (start, count) = (range.start, range.len());
        let conditions = shard.envs.conditions.block(start / LANES, model.drones);
        let noisy = conditions.sensors.iter().any(SensorLanes::is_inexact);
        let late = conditions.states.iter().any(StateDelays::is_late);
        if late {
            let lanes = &shard.envs.lanes[start / LANES * model.drones..][..model.drones];
            let drones = shard.envs.conditions.block(start / LANES, model.drones).states.iter_mut().zip(lanes);
            for (((states, lanes), seen), record) in drones.zip(&mut self.seen).zip(&self.records) {
                states.observe(lanes, record, seen, flew, model.substeps);
            }
        }
        let Some(functions) = self.functions else {
            let (lanes, _) = lanes_and_params(model, shard, start);
            lanes.iter_mut().for_each(|lanes| compute_rpys(model.width, lanes, count));
            return done;
        };
        let (mut rewards, mut events) = ([0.0; LANES], [0.0; LANES]);
        let block = &mut shard.envs.blocks[start / LANES];
        let sensors = shard.envs.conditions.block(start / LANES, model.drones).sensors;
        let sensing = (noisy || late).then_some(Sensing { sensors, late, seen: &mut self.seen });
        (functions.evaluate)(LaneStep {
            sensing,
            width: model.width,
            count,
            lanes: &mut shard.envs.lanes[start / LANES * model.drones..][..model.drones],
            rows: &mut shard.envs.task_rows[start / LANES * model.task_rows..][..model.task_rows],
            steps: &block.steps,
            evaluable,
            period: model.control_period,
            episode_steps: model.episode_steps as f64,
            bounds: &model.bounds,
            rewards: &mut rewards,
            events: &mut events,
            observation: &mut self.observations,
        });
        for lane in 0..count {
            done[lane] = evaluable[lane] && events[lane] <= 0.0;
            block.rows_ahead[lane] |= done[lane];
        }
        let size = model.observation_size;
        if done[..count].iter().all(|done| *done) {
            for (lane, reward) in rewards[..count].iter().enumerate() {
                block.rewards[lane] += reward;
                shard.step.rewards[start + lane] = *reward as f32;
            }
            shard.step.terminated[range.clone()].fill(false);
            shard.step.truncated[range].fill(false);
            let rows = &mut shard.step.observations[size * start..][..size * count];
            for (entry, numbers) in self.observations.iter().enumerate() {
                for (row, number) in rows.chunks_exact_mut(size).zip(numbers) {
                    row[entry] = *number as f32;
                }
            }
            return done;
        }
        for lane in (0..count).filter(|&lane| done[lane]) {
            block.rewards[lane] += rewards[lane];
            shard.step.write(start + lane, rewards[lane], false, false);
            let row = shard.step.observation(model, start + lane);
            row.iter_mut().zip(&self.observations).for_each(|(out, numbers)| *out = numbers[lane] as f32);
        }
        done
    }

    /// Stage 3 of one environment: updates its task and writes its reward, end and observation.
    fn evaluate(&mut self, model: &BatchModel, shard: &mut Shard<'_, T>, index: usize, flew: bool, faults: &Faults) {
        let lane = index % LANES;
        match self.step_kinds[lane] {
            StepKind::Fly => {
                if flew {
                    shard.envs.load(model, &self.env.simulation.model, index, &mut self.grounded[lane]);
                }
                shard.envs.load_task(model, self.functions, index);
                let slot = &mut shard.envs.slots[index];
                let mut parts = slot.parts(&mut self.env, Some(&mut self.grounded[lane]));
                if let Err(error) = parts.update_task() {
                    return self.fail(model, shard, index, error, faults);
                }
                let outcome = parts.outcome();
                let end = outcome.end.map(|end| (end, parts.episode.is_success(parts.view(), Some(end))));
                let moved = parts.workspace.moving.moves_solid();
                shard.envs.blocks[index / LANES].rewards[lane] += outcome.reward;
                shard.step.write(index, outcome.reward, outcome.terminated, outcome.truncated);
                if moved {
                    // moved obstacles invalidate the cached distances
                    shard.envs.forget_clearances(model, index);
                }
                match end {
                    Some((reason, success)) => self.end(model, shard, index, reason, success, faults),
                    None => {
                        self.observe(model, shard, index, Some(lane), faults);
                        self.store_task(model, shard, index, Some(lane));
                    }
                }
            }
            StepKind::Begin => {
                shard.step.write(index, 0.0, false, false);
                // under `SameStep`, a reset is pending here only after a failed start in the step before
                let failed = |shard: &Shard<'_, T>| shard.envs.blocks[index / LANES].start_failed[lane];
                let late = model.autoreset == Autoreset::SameStep && failed(shard);
                self.reset(model, shard, index, None, faults);
                if late || failed(shard) {
                    self.end_without_start(model, shard, index);
                }
            }
            StepKind::Fail => {
                shard.envs.load(model, &self.env.simulation.model, index, &mut self.grounded[lane]);
                shard.envs.load_task(model, self.functions, index);
                if let Some(error) = self.errors[lane].take() {
                    self.fail(model, shard, index, error, faults);
                }
            }
        }
    }

    /// Writes the task of an environment to its rows. `grounded` is the lane of an environment whose data is the
    /// worker's `grounded` data, if it has no own data.
    fn store_task(&mut self, model: &BatchModel, shard: &mut Shard<'_, T>, index: usize, grounded: Option<usize>) {
        if self.functions.is_none() {
            return;
        }
        let own = shard.envs.slots[index].data.take();
        let simulation = &self.env.simulation;
        let data = match (&own, grounded) {
            (Some(own), _) => own,
            (None, Some(lane)) => &self.grounded[lane],
            (None, None) => &simulation.data,
        };
        shard.envs.store_task(model, self.functions, index, SimView::new(&simulation.model, data));
        shard.envs.slots[index].data = own;
    }

    /// Ends an episode.
    fn end(
        &mut self,
        model: &BatchModel,
        shard: &mut Shard<'_, T>,
        index: usize,
        reason: EndReason,
        success: bool,
        faults: &Faults,
    ) {
        let (lane, block) = (index % LANES, &mut shard.envs.blocks[index / LANES]);
        let (steps, reward) = (block.steps[lane], block.rewards[lane]);
        (block.ended[lane], block.running[lane]) = (true, false);
        let slot = &mut shard.envs.slots[index];
        slot.summary = Some(EpisodeSummary { end: Some(reason), success, steps, reward });
        slot.episode.finish(reason);
        let parts = slot.parts(&mut self.env, Some(&mut self.grounded[lane]));
        // a task with invalid options must not be evaluated
        let info = (!parts.episode.task_changed).then(|| Info { success, ..parts.episode.info(parts.view()) });
        shard.envs.final_infos[index] = info;
        self.observe(model, shard, index, Some(lane), faults);
        self.store_task(model, shard, index, Some(lane));
        if model.autoreset == Autoreset::SameStep {
            shard.keep_final(model, index);
            self.keep_final_images(shard, index, faults);
            self.reset(model, shard, index, None, faults);
        }
    }

    /// Renders the last images of an episode, if the batch observes images.
    fn keep_final_images(&mut self, shard: &mut Shard<'_, T>, index: usize, faults: &Faults) {
        let Some(images) = shard.envs.final_images.get_mut(index) else { return };
        let slot = &mut shard.envs.slots[index];
        let mut parts = slot.parts(&mut self.env, Some(&mut self.grounded[index % LANES]));
        let drawn = parts.observe_images();
        let seen = parts.workspace.observation.clone();
        match images {
            Some(images) => **images = seen,
            none => *none = Some(Box::new(seen)),
        }
        if let Err(error) = drawn {
            report(faults, shard.first + index, error);
        }
    }

    /// Reports an episode that could not start as a fault after zero steps.
    fn end_without_start(&mut self, model: &BatchModel, shard: &mut Shard<'_, T>, index: usize) {
        shard.step.truncated[index] = true;
        let summary = EpisodeSummary { end: Some(EndReason::Fault), success: false, steps: 0, reward: 0.0 };
        shard.envs.slots[index].summary = Some(summary);
        shard.envs.blocks[index / LANES].ended[index % LANES] = true;
        // that of an earlier episode
        shard.envs.final_infos[index] = None;
        if model.autoreset == Autoreset::SameStep {
            shard.keep_final(model, index);
            if let Some(images) = shard.envs.final_images.get_mut(index) {
                *images = None;
            }
        }
    }

    /// Writes an environment's observation. `grounded` is the lane of an environment whose data is the worker's
    /// `grounded` data, if it has no own data.
    fn observe(
        &mut self,
        model: &BatchModel,
        shard: &mut Shard<'_, T>,
        index: usize,
        grounded: Option<usize>,
        faults: &Faults,
    ) {
        let shared = grounded.map(|lane| &mut self.grounded[lane]);
        let mut parts = shard.envs.slots[index].parts(&mut self.env, shared);
        let observed = parts.observe_numbers();
        parts.workspace.write_row(parts.model, shard.step.observation(model, index));
        if let Err(error) = observed {
            report(faults, shard.first + index, error);
        }
    }

    /// Ends the running episode of an environment that has failed.
    fn fail(&mut self, model: &BatchModel, shard: &mut Shard<'_, T>, index: usize, error: EnvError, faults: &Faults) {
        report(faults, shard.first + index, error);
        // an episode that has already ended is not truncated again
        let episode = &shard.envs.slots[index].episode;
        let started = shard.envs.blocks[index / LANES].started[index % LANES];
        let running = started && episode.end.is_none() && episode.phase != Phase::New;
        shard.step.write(index, 0.0, false, running);
        if running {
            self.end(model, shard, index, EndReason::Fault, false, faults);
        }
    }

    /// Stage 4: starts an episode of an environment and writes its first observation.
    pub fn reset(
        &mut self,
        model: &BatchModel,
        shard: &mut Shard<'_, T>,
        index: usize,
        seed: Option<u64>,
        faults: &Faults,
    ) {
        shard.envs.forget_clearances(model, index);
        let (lane, block) = (index % LANES, &mut shard.envs.blocks[index / LANES]);
        let slot = &mut shard.envs.slots[index];
        (block.rewards[lane], block.started[lane]) = (0.0, true);
        let started = slot.parts(&mut self.env, None).begin(seed);
        block.start_failed[lane] = started.is_err();
        match started {
            Ok(()) => self.observe(model, shard, index, None, faults),
            Err(error) => {
                slot.episode.phase = Phase::New;
                report(faults, shard.first + index, error);
            }
        }
        let simulation = &mut self.env.simulation;
        match &mut shard.envs.slots[index].data {
            Some(own) => own.refresh(&simulation.model),
            None => simulation.data.refresh(&simulation.model),
        }
        shard.envs.store(model, index, Some(&simulation.data), Some(simulation));
        clear_memories(shard.envs.control_memories(model, index), index);
        self.store_task(model, shard, index, None);
    }

    /// Starts an episode in every environment that the mask selects, with the seeds that `seed_of` returns for the
    /// indices of the environments in the batch.
    pub fn reset_where(
        &mut self,
        model: &BatchModel,
        shard: &mut Shard<'_, T>,
        seed_of: impl Fn(usize) -> Option<u64>,
        faults: &Faults,
    ) {
        let count = shard.envs.slots.len();
        shard.recall_observations(model, 0..count);
        for index in 0..count {
            if shard.mask[index] {
                shard.envs.blocks[index / LANES].ended[index % LANES] = false;
                self.reset(model, shard, index, seed_of(shard.first + index), faults);
                shard.keep_observations(model, index..index + 1);
            }
        }
    }

    /// Renders the camera images of every environment that the mask selects.
    pub fn render(&mut self, model: &BatchModel, shard: &mut Shard<'_, T>, faults: &Faults) {
        let Some(cameras) = &self.env.workspace.cameras else { return };
        // a change of the context takes a noticeable part of the time of a small image
        let drawn = cameras.value.context().keep_current(|| {
            for index in (0..shard.envs.slots.len()).filter(|&index| shard.mask[index]) {
                if let Err(error) = self.render_one(model, shard, index) {
                    report(faults, shard.first + index, error);
                }
            }
        });
        if let Err(error) = drawn {
            report(faults, shard.first, error.into());
        }
    }

    fn render_one(&mut self, model: &BatchModel, shard: &mut Shard<'_, T>, index: usize) -> Result<(), EnvError> {
        let [rgb, depth, segmentation] = model.images;
        let shared = &mut self.grounded[index % LANES];
        shard.envs.load(model, &self.env.simulation.model, index, shared);
        let mut parts = shard.envs.slots[index].parts(&mut self.env, Some(shared));
        parts.observe_images()?;
        let seen = &parts.workspace.observation;
        shard.images.rgb[rgb * index..][..rgb].copy_from_slice(&seen.rgb);
        shard.images.depth[depth * index..][..depth].copy_from_slice(&seen.depth);
        let objects = &mut shard.images.segmentation[segmentation * index..][..segmentation];
        objects.copy_from_slice(&seen.segmentation);
        Ok(())
    }
}

fn report(faults: &Faults, environment: usize, error: EnvError) {
    faults.lock().unwrap_or_else(PoisonError::into_inner).push((environment, error));
}

/// Returns the lanes of the block that starts at an environment, and the parameters of their drones.
pub(super) fn lanes_and_params<'a, T>(
    model: &'a BatchModel,
    shard: &'a mut Shard<'_, T>,
    start: usize,
) -> (&'a mut [Lanes], &'a [LaneParams]) {
    let range = start / LANES * model.drones..(start / LANES + 1) * model.drones;
    let lane_params =
        if shard.envs.lane_params.is_empty() { &model.lane_params[..] } else { &shard.envs.lane_params[range.clone()] };
    (&mut shard.envs.lanes[range], lane_params)
}
