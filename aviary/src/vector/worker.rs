//! Work of one thread: the four stages of a control step (decode, advance, evaluate, reset) over the blocks of a
//! shard.

use std::ops::Range;
use std::sync::{Mutex, PoisonError};

use super::shard::{BatchModel, Shard};
use super::{Autoreset, OnFault};
use crate::engine::flight::{Flow, LANES, LaneParams, Lanes, advance, compute_downwash, compute_rpys, find_clear};
use crate::env::{Aviary, EndReason, EnvError, EpisodeSummary, Phase, Task};
use crate::simulation::SimData;
use crate::state::DroneState;
use crate::wrappers::VelocityFilter;

/// Errors of the environments that failed, with their indices.
pub(super) type Faults = Mutex<Vec<(usize, EnvError)>>;

/// Action of an environment in a step.
#[derive(Debug, Clone, Copy, PartialEq)]
enum StepKind {
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
    /// Data of the environments of a block that advance in MuJoCo and have no own data.
    grounded: Vec<SimData>,
    /// Motor speeds of every environment and drone of a block, rpm.
    commands: Vec<[f64; 4]>,
    /// Saved lanes of environments that do not fly in lanes: state, rotor speeds and target speeds.
    saved: Vec<(DroneState, [f64; 4], [f64; 4])>,
    step_kinds: [StepKind; LANES],
    /// Errors of the environments of a block that fail.
    errors: [Option<EnvError>; LANES],
    /// Drone states of the environment whose action is decoded.
    states: Vec<DroneState>,
    /// Filter of velocity commands, if the batch has one.
    pub velocity_filter: Option<VelocityFilter>,
    /// Scratch buffer for the filtered action.
    action: Vec<f64>,
    /// Number of physics steps computed in lanes.
    pub flown: u64,
}

impl<T: Task> Worker<T> {
    pub fn new(env: Aviary<T>) -> Self {
        let drones = env.simulation.num_drones();
        Self {
            grounded: vec![env.simulation.snapshot(); LANES],
            commands: vec![[0.0; 4]; LANES * drones],
            saved: vec![(DroneState::default(), [0.0; 4], [0.0; 4]); LANES * drones],
            step_kinds: [StepKind::Fly; LANES],
            errors: Default::default(),
            states: vec![DroneState::default(); drones],
            velocity_filter: None,
            action: Vec::new(),
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
            let clear = self.find_clear(model, shard, range.clone(), &fits_lanes);
            self.advance(model, shard, range.clone(), &clear);
            for index in range {
                self.evaluate(model, shard, index, clear[index % LANES], faults);
            }
        }
    }

    /// Stage 1: selects the action of every environment of a block and decodes the commands of flying environments
    /// to motor speeds. Returns true for environments that a lane can represent.
    fn decode(&mut self, model: &BatchModel, shard: &mut Shard<'_, T>, range: Range<usize>) -> [bool; LANES] {
        let mut fits_lanes = [false; LANES];
        for index in range {
            let lane = index % LANES;
            let action = &shard.step.actions[model.action_size * index..][..model.action_size];
            self.step_kinds[lane] = self.step_kind(model, shard, index, action);
            shard.envs.slots[index].summary = None;
            if self.step_kinds[lane] != StepKind::Fly {
                continue;
            }
            if let Err(error) = self.decode_one(model, shard, index, action) {
                (self.step_kinds[lane], self.errors[lane]) = (StepKind::Fail, Some(error));
                continue;
            }
            let (commands, slot) = (&self.env.workspace.commands, &mut shard.envs.slots[index]);
            // the scalar path reports commands that are not finite
            fits_lanes[lane] = slot.fits_lanes && commands.iter().flatten().all(|rpm| rpm.is_finite());
            let data = slot.data.as_deref_mut().unwrap_or(&mut self.env.simulation.data);
            let lanes = &mut shard.envs.lanes[index / LANES * model.drones..][..model.drones];
            for (drone, (command, lanes)) in commands.iter().zip(lanes).enumerate() {
                self.commands[lane * model.drones + drone] = *command;
                lanes.set_target(lane, &data.command(drone, command));
            }
        }
        fits_lanes
    }

    /// Returns the action of an environment in this step.
    fn step_kind(&mut self, model: &BatchModel, shard: &Shard<'_, T>, index: usize, action: &[f32]) -> StepKind {
        let slot = &shard.envs.slots[index];
        let error = match slot.episode.phase {
            // `check_actions` has rejected actions that are not finite before the step
            Phase::Running if model.on_fault == OnFault::Error => return StepKind::Fly,
            Phase::Running => match action.iter().position(|x| !x.is_finite()) {
                None => return StepKind::Fly,
                Some(entry) => {
                    let time = slot.control_steps as f64 * self.env.simulation.control_period();
                    EnvError::Action { index: entry, got: f64::from(action[entry]), time }
                }
            },
            _ if slot.awaits_episode() && model.autoreset != Autoreset::Disabled => return StepKind::Begin,
            Phase::Over => EnvError::NeedsReset { when: "after the end of the episode" },
            Phase::New => EnvError::NeedsReset { when: "on a new environment" },
        };
        self.errors[index % LANES] = Some(error);
        StepKind::Fail
    }

    /// Decodes an environment's action to the commands of the workspace.
    fn decode_one(
        &mut self,
        model: &BatchModel,
        shard: &mut Shard<'_, T>,
        index: usize,
        action: &[f32],
    ) -> Result<(), EnvError> {
        let Aviary { model: env_model, simulation, workspace, decoders, .. } = &mut self.env;
        let (numbers, dt) = (action.iter().map(|&x| f64::from(x)), simulation.model.control_period());
        let slot = &mut shard.envs.slots[index];
        if slot.decoders.is_empty() {
            // decoders without memory ignore the states
            workspace.decode(env_model, dt, &self.states, decoders, numbers);
            return Ok(());
        }
        let lanes = &shard.envs.lanes[index / LANES * model.drones..][..model.drones];
        for (state, lanes) in self.states.iter_mut().zip(lanes) {
            *state = lanes.state(index % LANES);
        }
        if let Some(velocity_filter) = &mut self.velocity_filter {
            self.action.clear();
            self.action.extend(numbers);
            let safe = velocity_filter.make_safe(&self.states, &env_model.action_space, &mut self.action);
            workspace.decode(env_model, dt, &self.states, &mut slot.decoders, self.action.iter().copied());
            safe.map(|_| ())
        } else {
            workspace.decode(env_model, dt, &self.states, &mut slot.decoders, numbers);
            Ok(())
        }
    }

    /// Returns true for the environments of a block that cannot touch anything during the control step and
    /// therefore fly in lanes.
    fn find_clear(
        &mut self,
        model: &BatchModel,
        shard: &mut Shard<'_, T>,
        range: Range<usize>,
        fits_lanes: &[bool; LANES],
    ) -> [bool; LANES] {
        let Some(flow) = model.flow.as_ref().filter(|_| fits_lanes.contains(&true)) else { return [false; LANES] };
        let drones = model.drones;
        let (lanes, lane_params) = lanes_and_params(model, shard, range.start);
        let mut clear = find_clear(flow, lanes, lane_params, range.len(), model.substeps);
        clear.iter_mut().zip(fits_lanes).for_each(|(clear, fits)| *clear &= fits);
        if shard.envs.clearance_caches.is_empty() {
            return clear;
        }
        let simulation = &self.env.simulation;
        for index in range {
            if !clear[index % LANES] {
                continue;
            }
            let lanes = &shard.envs.lanes[index / LANES * drones..][..drones];
            let data = shard.envs.slots[index].data.as_deref().unwrap_or(&simulation.data);
            let clearance_caches = &mut shard.envs.clearance_caches[drones * index..][..drones];
            clear[index % LANES] =
                data.is_clear_of_obstacles(&simulation.model, lanes, index % LANES, clearance_caches);
        }
        clear
    }

    /// Stage 2: advances the physics of a block, of all clear environments in lanes and of the others in MuJoCo.
    fn advance(&mut self, model: &BatchModel, shard: &mut Shard<'_, T>, range: Range<usize>, clear: &[bool; LANES]) {
        if let Some(flow) = model.flow.as_ref().filter(|_| clear.contains(&true)) {
            self.advance_lanes(model, flow, shard, range.clone(), clear);
        }
        for index in range.filter(|index| !clear[index % LANES]) {
            let lane = index % LANES;
            if self.step_kinds[lane] != StepKind::Fly {
                continue;
            }
            let shared = &mut self.grounded[lane];
            if shard.envs.slots[index].data.is_none() {
                shard.envs.load(model, index, shared);
            }
            let mut parts = shard.envs.slots[index].parts(&mut self.env, Some(shared));
            parts.workspace.commands.copy_from_slice(&self.commands[lane * model.drones..][..model.drones]);
            if let Err(error) = parts.advance() {
                (self.step_kinds[lane], self.errors[lane]) = (StepKind::Fail, Some(error));
            }
            shard.envs.store(model, index, Some(shared), None);
        }
    }

    /// Advances the clear environments of a block in lanes.
    fn advance_lanes(
        &mut self,
        model: &BatchModel,
        flow: &Flow,
        shard: &mut Shard<'_, T>,
        range: Range<usize>,
        clear: &[bool; LANES],
    ) {
        let drones = model.drones;
        let flying = clear.iter().filter(|clear| **clear).count();
        let count = range.len();
        let (lanes, lane_params) = lanes_and_params(model, shard, range.start);
        // the kernel advances all lanes, therefore the lanes of environments that are not clear are restored
        // afterwards
        let grounded = range.map(|index| index % LANES).filter(|&lane| !clear[lane]);
        for lane in grounded.clone() {
            for (drone, lanes) in lanes.iter().enumerate() {
                self.saved[lane * drones + drone] = (lanes.state(lane), lanes.rpm(lane), lanes.target(lane));
            }
        }
        if model.downwash {
            for _ in 0..model.substeps {
                compute_downwash(flow.width, lanes, lane_params, count);
                for (lanes, lane_params) in lanes.iter_mut().zip(lane_params) {
                    advance(flow, lanes, lane_params, count, 1);
                }
            }
        } else {
            for (lanes, lane_params) in lanes.iter_mut().zip(lane_params) {
                advance(flow, lanes, lane_params, count, model.substeps);
            }
        }
        for lane in grounded {
            for (drone, lanes) in lanes.iter_mut().enumerate() {
                let (state, rpm, target) = &self.saved[lane * drones + drone];
                lanes.set(lane, state, rpm, target);
            }
        }
        for lanes in lanes {
            compute_rpys(flow.width, lanes, count);
        }
        self.flown += u64::from(model.substeps) * flying as u64;
    }

    /// Stage 3: updates the task of an environment and writes its reward, end and observation.
    fn evaluate(&mut self, model: &BatchModel, shard: &mut Shard<'_, T>, index: usize, clear: bool, faults: &Faults) {
        let lane = index % LANES;
        match self.step_kinds[lane] {
            StepKind::Fly => {
                let grounded = self.read(model, shard, index, clear);
                let shared = grounded.then(|| &mut self.grounded[lane]);
                let slot = &mut shard.envs.slots[index];
                let mut parts = slot.parts(&mut self.env, shared);
                if let Err(error) = parts.update_task() {
                    return self.fail(model, shard, index, grounded, error, faults);
                }
                let outcome = parts.outcome();
                let end = outcome.end.map(|end| (end, parts.episode.is_success(parts.view(), Some(end))));
                let moved = parts.workspace.moving.has_solid();
                slot.reward += outcome.reward;
                shard.step.write(index, outcome.reward, outcome.terminated, outcome.truncated);
                if moved {
                    // moved obstacles invalidate the cached distances
                    shard.envs.forget_clearances(model, index);
                }
                match end {
                    Some((reason, success)) => self.end(model, shard, index, grounded, reason, success, faults),
                    None => self.observe(model, shard, index, grounded, faults),
                }
            }
            StepKind::Begin => {
                shard.step.write(index, 0.0, false, false);
                // under `SameStep`, a reset is pending here only after a failed start in the step before
                let late = model.autoreset == Autoreset::SameStep && shard.envs.slots[index].start_failed;
                self.reset(model, shard, index, None, faults);
                if late || shard.envs.slots[index].start_failed {
                    self.end_without_start(model, shard, index);
                }
            }
            StepKind::Fail => {
                let grounded = shard.envs.slots[index].data.is_none();
                if grounded {
                    shard.envs.load(model, index, &mut self.grounded[lane]);
                }
                if let Some(error) = self.errors[lane].take() {
                    self.fail(model, shard, index, grounded, error, faults);
                }
            }
        }
    }

    /// Reads the state of an environment from its lane to the data that the task reads. Returns true if a MuJoCo
    /// step has left that data in the worker's `grounded` data.
    fn read(&mut self, model: &BatchModel, shard: &mut Shard<'_, T>, index: usize, clear: bool) -> bool {
        let slot = &mut shard.envs.slots[index];
        if !clear {
            return slot.data.is_none();
        }
        slot.control_steps += 1;
        slot.in_mujoco = false;
        let lanes = &shard.envs.lanes[index / LANES * model.drones..][..model.drones];
        match slot.data.as_deref_mut() {
            Some(own) => own.read_lane(lanes, index % LANES, slot.control_steps, false, None),
            None => self.env.simulation.data.read_lane(lanes, index % LANES, slot.control_steps, true, None),
        }
        false
    }

    /// Ends an episode.
    #[expect(clippy::too_many_arguments, reason = "an environment at hand and what its last step brought")]
    fn end(
        &mut self,
        model: &BatchModel,
        shard: &mut Shard<'_, T>,
        index: usize,
        grounded: bool,
        reason: EndReason,
        success: bool,
        faults: &Faults,
    ) {
        let slot = &mut shard.envs.slots[index];
        slot.summary =
            Some(EpisodeSummary { end: Some(reason), success, steps: slot.control_steps, reward: slot.reward });
        slot.episode.finish(reason);
        self.observe(model, shard, index, grounded, faults);
        if model.autoreset == Autoreset::SameStep {
            shard.keep_final(model, index);
            self.reset(model, shard, index, None, faults);
        }
    }

    /// Reports an episode that could not start as a fault after zero steps.
    fn end_without_start(&mut self, model: &BatchModel, shard: &mut Shard<'_, T>, index: usize) {
        shard.step.truncated[index] = true;
        let summary = EpisodeSummary { end: Some(EndReason::Fault), success: false, steps: 0, reward: 0.0 };
        shard.envs.slots[index].summary = Some(summary);
        if model.autoreset == Autoreset::SameStep {
            shard.keep_final(model, index);
        }
    }

    /// Writes an environment's observation.
    fn observe(&mut self, model: &BatchModel, shard: &mut Shard<'_, T>, index: usize, grounded: bool, faults: &Faults) {
        let shared = grounded.then(|| &mut self.grounded[index % LANES]);
        let mut parts = shard.envs.slots[index].parts(&mut self.env, shared);
        let observed = parts.observe_numbers();
        parts.workspace.write_row(parts.model, shard.step.observation(model, index));
        if let Err(error) = observed {
            report(faults, shard.first + index, error);
        }
    }

    /// Ends the running episode of an environment that has failed.
    fn fail(
        &mut self,
        model: &BatchModel,
        shard: &mut Shard<'_, T>,
        index: usize,
        grounded: bool,
        error: EnvError,
        faults: &Faults,
    ) {
        report(faults, shard.first + index, error);
        // an episode that has already ended is not truncated again
        let slot = &shard.envs.slots[index];
        let running = slot.started && slot.episode.end.is_none() && slot.episode.phase != Phase::New;
        shard.step.write(index, 0.0, false, running);
        if running {
            self.end(model, shard, index, grounded, EndReason::Fault, false, faults);
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
        let slot = &mut shard.envs.slots[index];
        (slot.reward, slot.started) = (0.0, true);
        let started = slot.parts(&mut self.env, None).begin(seed);
        slot.start_failed = started.is_err();
        match started {
            Ok(()) => self.observe(model, shard, index, false, faults),
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
    }

    /// Starts an episode in every environment that the mask selects.
    pub fn reset_where(&mut self, model: &BatchModel, shard: &mut Shard<'_, T>, seed: Option<u64>, faults: &Faults) {
        for index in 0..shard.envs.slots.len() {
            if shard.mask[index] {
                shard.envs.slots[index].summary = None;
                self.reset(model, shard, index, seed, faults);
            }
        }
    }

    /// Renders the camera images of every environment.
    pub fn render(&mut self, model: &BatchModel, shard: &mut Shard<'_, T>, faults: &Faults) {
        let [rgb, depth, segmentation] = model.images;
        for index in 0..shard.envs.slots.len() {
            let shared = &mut self.grounded[index % LANES];
            if shard.envs.slots[index].data.is_none() {
                shard.envs.load(model, index, shared);
            }
            let mut parts = shard.envs.slots[index].parts(&mut self.env, Some(shared));
            if let Err(error) = parts.observe_images() {
                report(faults, shard.first + index, error);
                continue;
            }
            let seen = &parts.workspace.observation;
            shard.images.rgb[rgb * index..][..rgb].copy_from_slice(&seen.rgb);
            shard.images.depth[depth * index..][..depth].copy_from_slice(&seen.depth);
            let objects = &mut shard.images.segmentation[segmentation * index..][..segmentation];
            objects.copy_from_slice(&seen.segmentation);
        }
    }
}

fn report(faults: &Faults, environment: usize, error: EnvError) {
    faults.lock().unwrap_or_else(PoisonError::into_inner).push((environment, error));
}

/// Returns the lanes of the block that starts at an environment, and the parameters of their drones.
fn lanes_and_params<'a, T>(
    model: &'a BatchModel,
    shard: &'a mut Shard<'_, T>,
    start: usize,
) -> (&'a mut [Lanes], &'a [LaneParams]) {
    let range = start / LANES * model.drones..(start / LANES + 1) * model.drones;
    let lane_params =
        if shard.envs.lane_params.is_empty() { &model.lane_params[..] } else { &shard.envs.lane_params[range.clone()] };
    (&mut shard.envs.lanes[range], lane_params)
}
