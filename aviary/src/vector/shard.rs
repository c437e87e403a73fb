//! Environments of a batch and the slices of them that a worker processes.

use std::ops::Range;

use smallvec::SmallVec;

use super::actions::Actions;
use super::conditions::{ConditionLanes, ConditionSlices};
use super::control_loops::LoopLanes;
use super::{Autoreset, OnFault};
use crate::engine::ClearanceCache;
use crate::engine::flight::{Decoding, Flow, LANES, LaneParams, Lanes, LateCommands, Width};
use crate::env::{Aviary, EnvParts, Episode, EpisodeSummary, Info, LaneFunctions, Phase, Task};
use crate::math::Row;
use crate::observation::Observation;
use crate::simulation::{SimData, SimModel, SimView, Simulation};

/// Constants that all environments of a batch share.
#[derive(Debug, Clone)]
pub(super) struct BatchModel {
    pub drones: usize,
    pub action_size: usize,
    pub observation_size: usize,
    pub autoreset: Autoreset,
    pub on_fault: OnFault,
    /// True if the batch keeps the last observations, see [`VecConfig`](super::VecConfig).
    pub keep_observations: bool,
    /// Settings of the flight kernel; `None` if no environment flies in lanes.
    pub flow: Option<Flow>,
    /// Instruction set.
    pub width: Width,
    pub downwash: bool,
    /// Conversion of each drone's numbers to motor speeds.
    pub decoding: Vec<Decoding>,
    /// True if the decoders have control loops.
    pub control_loops: bool,
    /// Bounds of the actions of one environment.
    pub action_bounds: Vec<[f64; 2]>,
    /// True if one action commands all four motors of a drone.
    pub one_action: bool,
    /// Physics steps of a control step.
    pub substeps: u32,
    /// Length of a physics step, s.
    pub dt: f64,
    /// Length of a control step, s.
    pub control_period: f64,
    /// Control steps of an episode.
    pub episode_steps: u64,
    /// Bounds of the observations, see [`LaneStep::bounds`](crate::env::LaneStep::bounds).
    pub bounds: Vec<(usize, f64, f64)>,
    /// Number of rows of the task per block; 0 if the task is not evaluated in lanes.
    pub task_rows: usize,
    /// Data of an environment that has not started an episode.
    pub fresh: SimData,
    /// Parameters of each drone if all environments share them.
    pub lane_params: Vec<LaneParams>,
    /// Entries in the images of one environment: bytes of RGBA, pixels of depth, pixels of segmentation.
    pub images: [usize; 3],
}

/// One environment of a batch, without the states in the lanes.
#[derive(Debug)]
pub(super) struct EnvSlot<T> {
    pub episode: Episode<T>,
    /// Own data if environments differ in parameters. Otherwise the lanes and this slot hold the complete state,
    /// except for the states at the start of the episode.
    pub data: Option<Box<SimData>>,
    /// Seed of the wind of this episode.
    pub wind_seed: u64,
    /// Summary of the last episode that ended; see [`Block::ended`].
    pub summary: Option<EpisodeSummary>,
}

/// State of a block of environments that every step reads and writes, as a structure of arrays.
#[derive(Debug, Clone, Default)]
#[repr(align(64))]
pub(super) struct Block {
    /// Control steps since the start of the episode.
    pub steps: Row<u64>,
    /// Sum of the rewards of the current episode.
    pub rewards: Row,
    /// True while an episode runs.
    pub running: [bool; LANES],
    /// True if contacts were solved in the last physics step, so that the warm start of the solver is valid.
    pub in_mujoco: [bool; LANES],
    /// True if the last step ended an episode.
    pub ended: [bool; LANES],
    /// True if the rows of the task are ahead of the scalar task: if the last step was evaluated in lanes.
    pub rows_ahead: [bool; LANES],
    /// True if the environment has ever started an episode.
    pub started: [bool; LANES],
    /// True if the last attempt to start an episode failed.
    pub start_failed: [bool; LANES],
}

impl Block {
    /// Returns true if the next step of an environment with an episode in this phase starts an episode because the last
    /// one ended or a change of the task cut it off.
    pub fn awaits_episode(&self, lane: usize, phase: Phase) -> bool {
        match phase {
            Phase::Running => false,
            Phase::Over => true,
            Phase::New => self.started[lane],
        }
    }
}

impl<T: Task> EnvSlot<T> {
    /// Returns the parts of an environment that an episode needs: the own parts of the slot and the workspaces of a
    /// thread. `shared` is the data of an environment without its own.
    pub fn parts<'a>(&'a mut self, env: &'a mut Aviary<T>, shared: Option<&'a mut SimData>) -> EnvParts<'a, T> {
        let Aviary { model, simulation, decoders, workspace, .. } = env;
        let Simulation { model: sim_model, data, workspace: sim_workspace } = simulation;
        EnvParts {
            model,
            sim_model,
            data: match (&mut self.data, shared) {
                (Some(own), _) => own,
                (None, Some(shared)) => shared,
                (None, None) => data,
            },
            episode: &mut self.episode,
            decoders,
            workspace,
            sim_workspace,
        }
    }
}

/// All environments of a batch.
#[derive(Debug)]
pub(super) struct Environments<T> {
    pub slots: Vec<EnvSlot<T>>,
    pub blocks: Vec<Block>,
    /// Rows of the task, block by block and drone by drone.
    pub task_rows: Vec<Row>,
    pub lanes: Vec<Lanes>,
    /// Parameters of every environment's drones if environments differ; otherwise empty.
    pub lane_params: Vec<LaneParams>,
    pub conditions: ConditionLanes,
    /// Memory of the control loops of every block and drone; empty if the decoders keep none.
    pub control_memories: Vec<LoopLanes>,
    pub warm_starts: Vec<f64>,
    pub clearance_caches: Vec<ClearanceCache>,
    /// Observations of all environments as last written, if the batch keeps them; otherwise empty.
    pub kept_observations: Vec<f32>,
    /// Last observations of the episodes that ended in the last step.
    pub finals: Vec<f32>,
    /// Infos at the ends of the last episodes.
    pub final_infos: Vec<Option<Info>>,
    /// Last observations with images of the episodes that ended, if the batch observes images and resets in the same
    /// step.
    pub final_images: Vec<Option<Box<Observation>>>,
}

impl<T> Environments<T> {
    /// Returns slices of the environments.
    pub fn slices(&mut self) -> EnvSlices<'_, T> {
        EnvSlices {
            slots: &mut self.slots,
            blocks: &mut self.blocks,
            task_rows: &mut self.task_rows,
            lanes: &mut self.lanes,
            lane_params: &mut self.lane_params,
            conditions: self.conditions.slices(),
            control_memories: &mut self.control_memories,
            warm_starts: &mut self.warm_starts,
            clearance_caches: &mut self.clearance_caches,
            kept_observations: &mut self.kept_observations,
            finals: &mut self.finals,
            final_infos: &mut self.final_infos,
            final_images: &mut self.final_images,
        }
    }

    /// Returns the memory per environment, bytes.
    pub fn bytes_per_env(&self) -> usize {
        let Self { slots, blocks, task_rows, lanes, lane_params, conditions, warm_starts, .. } = self;
        let Self { control_memories, clearance_caches, kept_observations, .. } = self;
        let Self { finals, final_infos, final_images, .. } = self;
        let sum = size_of_val(&slots[..])
            + slots.iter().filter_map(|slot| slot.data.as_ref()).map(|data| data.bytes()).sum::<usize>()
            + slots.iter().map(|slot| slot.episode.bytes()).sum::<usize>()
            + size_of_val(&final_images[..])
            + final_images.iter().flatten().map(|images| images.bytes()).sum::<usize>()
            + size_of_val(&blocks[..])
            + size_of_val(&task_rows[..])
            + size_of_val(&lanes[..])
            + lanes.iter().map(Lanes::heap_bytes).sum::<usize>()
            + size_of_val(&lane_params[..])
            + lane_params.iter().map(LaneParams::heap_bytes).sum::<usize>()
            + conditions.bytes()
            + size_of_val(&control_memories[..])
            + size_of_val(&warm_starts[..])
            + size_of_val(&clearance_caches[..])
            + size_of_val(&kept_observations[..])
            + size_of_val(&finals[..])
            + size_of_val(&final_infos[..]);
        sum.div_ceil(slots.len())
    }
}

/// Consecutive environments in whole blocks of lanes, with their rows of all buffers. Unused buffers are empty.
pub(super) struct Shard<'a, T> {
    /// Index of the first environment.
    pub first: usize,
    pub mask: &'a [bool],
    pub envs: EnvSlices<'a, T>,
    pub step: StepSlices<'a>,
    pub images: ImageSlices<'a>,
}

/// Slices of the state that environments keep between steps.
pub(super) struct EnvSlices<'a, T> {
    pub slots: &'a mut [EnvSlot<T>],
    pub blocks: &'a mut [Block],
    pub task_rows: &'a mut [Row],
    pub lanes: &'a mut [Lanes],
    pub lane_params: &'a mut [LaneParams],
    pub conditions: ConditionSlices<'a>,
    pub control_memories: &'a mut [LoopLanes],
    pub warm_starts: &'a mut [f64],
    pub clearance_caches: &'a mut [ClearanceCache],
    pub kept_observations: &'a mut [f32],
    pub finals: &'a mut [f32],
    pub final_infos: &'a mut [Option<Info>],
    pub final_images: &'a mut [Option<Box<Observation>>],
}

/// Slices of the buffers of a step.
#[derive(Default)]
pub(super) struct StepSlices<'a> {
    pub actions: Actions<'a>,
    pub observations: &'a mut [f32],
    pub rewards: &'a mut [f32],
    pub terminated: &'a mut [bool],
    pub truncated: &'a mut [bool],
}

/// Slices of the buffers of images.
#[derive(Default)]
pub(super) struct ImageSlices<'a> {
    pub rgb: &'a mut [u8],
    pub depth: &'a mut [f32],
    pub segmentation: &'a mut [[i32; 2]],
}

/// Splits a slice at an index. Both parts of an empty slice are empty.
pub(super) fn cut<X>(slice: &mut [X], at: usize) -> (&mut [X], &mut [X]) {
    let at = at.min(slice.len());
    slice.split_at_mut(at)
}

impl<'a, T> Shard<'a, T> {
    /// Returns the number of blocks of lanes.
    pub fn blocks(&self) -> usize {
        self.envs.slots.len().div_ceil(LANES)
    }

    /// Copies an environment's observation to the final observations.
    pub fn keep_final(&mut self, model: &BatchModel, index: usize) {
        let row = model.observation_size * index..model.observation_size * (index + 1);
        self.envs.finals[row.clone()].copy_from_slice(&self.step.observations[row]);
    }

    /// Copies the observations of environments to the kept observations, if the batch keeps them.
    pub fn keep_observations(&mut self, model: &BatchModel, range: Range<usize>) {
        if model.keep_observations {
            let rows = model.observation_size * range.start..model.observation_size * range.end;
            self.envs.kept_observations[rows.clone()].copy_from_slice(&self.step.observations[rows]);
        }
    }

    /// Writes the kept observations of environments to their rows of the output, if the batch keeps them.
    pub fn recall_observations(&mut self, model: &BatchModel, range: Range<usize>) {
        if model.keep_observations {
            let rows = model.observation_size * range.start..model.observation_size * range.end;
            self.step.observations[rows.clone()].copy_from_slice(&self.envs.kept_observations[rows]);
        }
    }

    /// Computes the commands that reach the motors of a block during a control step, if any arrive late.
    pub fn delay_commands(&mut self, model: &BatchModel, block: usize, late: &mut [LateCommands]) {
        let lanes = &self.envs.lanes[block * model.drones..(block + 1) * model.drones];
        let motors = self.envs.conditions.block(block, model.drones).motors;
        for ((motors, lanes), late) in motors.iter().zip(lanes).zip(late).filter(|((motors, _), _)| motors.is_late()) {
            motors.arrive(lanes, late, model.substeps);
        }
    }

    /// Splits `blocks` blocks off the front.
    pub fn split(self, model: &BatchModel, blocks: usize) -> (Self, Self) {
        let count = (blocks * LANES).min(self.envs.slots.len());
        let (mask, mask2) = self.mask.split_at(count.min(self.mask.len()));
        let (envs, envs2) = self.envs.split(model, count);
        let (step, step2) = self.step.split(model, count);
        let (images, images2) = self.images.split(model, count);
        (
            Self { first: self.first, mask, envs, step, images },
            Self { first: self.first + count, mask: mask2, envs: envs2, step: step2, images: images2 },
        )
    }
}

impl<'a, T> EnvSlices<'a, T> {
    fn split(self, model: &BatchModel, count: usize) -> (Self, Self) {
        let (drones, blocks) = (model.drones, count.div_ceil(LANES));
        let (slots, slots2) = cut(self.slots, count);
        let (block_states, block_states2) = cut(self.blocks, blocks);
        let (task_rows, task_rows2) = cut(self.task_rows, blocks * model.task_rows);
        let (lanes, lanes2) = cut(self.lanes, blocks * drones);
        let (lane_params, lane_params2) = cut(self.lane_params, blocks * drones);
        let (conditions, conditions2) = self.conditions.split(blocks * drones);
        let (control_memories, control_memories2) = cut(self.control_memories, blocks * drones);
        let (warm_starts, warm_starts2) = cut(self.warm_starts, 6 * drones * count);
        let (clearance_caches, clearance_caches2) = cut(self.clearance_caches, drones * count);
        let (kept_observations, kept_observations2) = cut(self.kept_observations, model.observation_size * count);
        let (finals, finals2) = cut(self.finals, model.observation_size * count);
        let (final_infos, final_infos2) = cut(self.final_infos, count);
        let (final_images, final_images2) = cut(self.final_images, count);
        (
            Self {
                slots,
                blocks: block_states,
                task_rows,
                lanes,
                lane_params,
                conditions,
                control_memories,
                warm_starts,
                clearance_caches,
                kept_observations,
                finals,
                final_infos,
                final_images,
            },
            Self {
                slots: slots2,
                blocks: block_states2,
                task_rows: task_rows2,
                lanes: lanes2,
                lane_params: lane_params2,
                conditions: conditions2,
                control_memories: control_memories2,
                warm_starts: warm_starts2,
                clearance_caches: clearance_caches2,
                kept_observations: kept_observations2,
                finals: finals2,
                final_infos: final_infos2,
                final_images: final_images2,
            },
        )
    }

    /// Writes an environment's data to its lane after a MuJoCo step, a reset or a change. This covers the states,
    /// the motors, the solver's warm start and, if environments differ, the parameters.
    pub fn store(&mut self, model: &BatchModel, index: usize, data: Option<&SimData>, parameters: Option<&Simulation>) {
        let (drones, lane) = (model.drones, index % LANES);
        let (slot, block) = (&mut self.slots[index], &mut self.blocks[index / LANES]);
        block.running[lane] = slot.episode.phase == Phase::Running;
        let Some(data) = slot.data.as_deref().or(data) else { return };
        let lanes = &mut self.lanes[index / LANES * drones..][..drones];
        data.write_lane(lanes, lane);
        block.steps[lane] = data.control_steps();
        let warm_start = data.warm_start();
        block.in_mujoco[lane] = warm_start.is_some();
        if let Some(warm_start) = warm_start {
            self.warm_starts[6 * drones * index..][..6 * drones].copy_from_slice(warm_start);
        }
        slot.wind_seed = data.wind_seed();
        let mut conditions = self.conditions.block(index / LANES, drones);
        conditions.set(lane, data, &slot.episode, model.substeps, parameters.is_some());
        if let Some(simulation) = parameters
            && !self.lane_params.is_empty()
        {
            let lane_params = &mut self.lane_params[index / LANES * drones..][..drones];
            data.write_lane_params(&simulation.model, lane_params, lane);
        }
    }

    /// Reads the data of an environment from its lane, into its own data or into `shared`. Applies the
    /// sampled parameters of environments without their own data.
    pub fn load(&mut self, model: &BatchModel, sim_model: &SimModel, index: usize, shared: &mut SimData) {
        let (drones, lane, block) = (model.drones, index % LANES, &self.blocks[index / LANES]);
        let lanes = &self.lanes[index / LANES * drones..][..drones];
        let warm_start = block.in_mujoco[lane].then(|| &self.warm_starts[6 * drones * index..][..6 * drones]);
        let slot = &mut self.slots[index];
        let data = match slot.data.as_deref_mut() {
            Some(own) => own,
            None => {
                if let Some(randomizer) = slot.episode.randomizer().filter(|_| block.started[lane]) {
                    // the start of the episode has accepted the parameters
                    let _ = randomizer.apply(sim_model, shared);
                    shared.refresh(sim_model);
                }
                shared
            }
        };
        data.read_lane(lanes, lane, block.steps[lane], warm_start);
        data.set_wind_seed(slot.wind_seed);
        let conditions = self.conditions.block(index / LANES, drones);
        conditions.read(lane, data, model.substeps);
    }

    /// Writes the task of an environment to its rows.
    pub fn store_task(
        &mut self,
        model: &BatchModel,
        functions: Option<LaneFunctions<T>>,
        index: usize,
        view: SimView<'_>,
    ) {
        self.blocks[index / LANES].rows_ahead[index % LANES] = false;
        // no step reads the rows of a task without a running episode, whose options may be invalid
        let running = self.slots[index].episode.phase == Phase::Running;
        let Some(functions) = functions.filter(|_| running) else { return };
        let rows = &mut self.task_rows[index / LANES * model.task_rows..][..model.task_rows];
        let mut numbers = SmallVec::<[f64; 32]>::from_elem(0.0, functions.rows);
        for (drone, rows) in rows.chunks_exact_mut(functions.rows).enumerate() {
            (functions.write_rows)(&self.slots[index].episode.task, view, drone, &mut numbers);
            rows.iter_mut().zip(&numbers).for_each(|(row, number)| row[index % LANES] = *number);
        }
    }

    /// Reads the task of an environment from its rows, if they are ahead of it.
    pub fn load_task(&mut self, model: &BatchModel, functions: Option<LaneFunctions<T>>, index: usize) {
        let ahead = &mut self.blocks[index / LANES].rows_ahead[index % LANES];
        let Some(functions) = functions.filter(|_| std::mem::take(ahead)) else { return };
        let rows = &self.task_rows[index / LANES * model.task_rows..][..model.task_rows];
        for (drone, rows) in rows.chunks_exact(functions.rows).enumerate() {
            let numbers: SmallVec<[f64; 32]> = rows.iter().map(|row| row[index % LANES]).collect();
            (functions.read_rows)(&mut self.slots[index].episode.task, drone, &numbers);
        }
    }

    /// Returns the memories of the control loops in the block of an environment, one per drone; empty if the decoders
    /// keep none.
    pub fn control_memories(&mut self, model: &BatchModel, index: usize) -> &mut [LoopLanes] {
        let memories = &mut *self.control_memories;
        if memories.is_empty() { memories } else { &mut memories[index / LANES * model.drones..][..model.drones] }
    }

    /// Clears the cached obstacle distances of an environment's drones.
    pub fn forget_clearances(&mut self, model: &BatchModel, index: usize) {
        let clearance_caches = self.clearance_caches.iter_mut().skip(model.drones * index).take(model.drones);
        clearance_caches.for_each(|clearance| *clearance = ClearanceCache::default());
    }
}

impl<'a> StepSlices<'a> {
    fn split(self, model: &BatchModel, count: usize) -> (Self, Self) {
        let (actions, actions2) = self.actions.cut(model.action_size * count);
        let (observations, observations2) = cut(self.observations, model.observation_size * count);
        let (rewards, rewards2) = cut(self.rewards, count);
        let (terminated, terminated2) = cut(self.terminated, count);
        let (truncated, truncated2) = cut(self.truncated, count);
        (
            Self { actions, observations, rewards, terminated, truncated },
            Self {
                actions: actions2,
                observations: observations2,
                rewards: rewards2,
                terminated: terminated2,
                truncated: truncated2,
            },
        )
    }

    /// Writes the reward and the end of an environment's step.
    pub fn write(&mut self, index: usize, reward: f64, terminated: bool, truncated: bool) {
        (self.rewards[index], self.terminated[index], self.truncated[index]) = (reward as f32, terminated, truncated);
    }

    /// Returns an environment's row of the observations.
    pub fn observation(&mut self, model: &BatchModel, index: usize) -> &mut [f32] {
        &mut self.observations[model.observation_size * index..][..model.observation_size]
    }
}

impl<'a> ImageSlices<'a> {
    fn split(self, model: &BatchModel, count: usize) -> (Self, Self) {
        let [rgb, depth, segmentation] = model.images;
        let (rgb, rgb2) = cut(self.rgb, rgb * count);
        let (depth, depth2) = cut(self.depth, depth * count);
        let (segmentation, segmentation2) = cut(self.segmentation, segmentation * count);
        (Self { rgb, depth, segmentation }, Self { rgb: rgb2, depth: depth2, segmentation: segmentation2 })
    }
}
