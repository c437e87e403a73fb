//! Proximal policy optimization (PPO) on a GPU: environments, networks, rollouts, advantages, gradients and optimizer
//! are in the memory of the device. An iteration copies its statistics (11 numbers) to the host, and nothing to the
//! device.
//!
//! The algorithm is that of the crate `learn`, with the same hyperparameters. These parts differ:
//!
//! - Random numbers are functions of the seed of an iteration and of an index (Philox4x32-10).
//! - The order of the samples in an epoch is a pseudorandom permutation that every thread computes for its sample. A
//!   sample of a failed environment stays in its minibatch with the weight 0.
//! - Statistics and learning rate are in single precision.
//! - Initial states with ranges of their own in training are at least 1 cm above the floor, so that the first contact
//!   with it is a crash.
//!
//! Results depend neither on the size of workgroups nor on their order: every sum has a fixed order. Equal seeds give
//! equal policies on one device with one driver; devices round differently.
#![allow(clippy::needless_range_loop)] // kernels have no iterators

mod gradient;
mod network;
mod noise;
mod rollout;
mod statistics;

use std::time::{Duration, Instant};

use aviary::env::{BoxSpace, EnvConfig, EnvError, InitialRanges, Randomization, Rng};
use aviary::tasks::Course;
use aviary::vector::{Autoreset, OnFault, VecConfig, VecEnv as _};
use cubecl::bytes::Bytes;
use cubecl::prelude::*;
use cubecl::server::Handle;
use cubecl_environment::stream::StreamId;
use learn::{Clock, Learner, LearnerState, NetworkShape, PpoConfig, Report, Running, Terms, TrainConfig, TrainError};
use rand::{RngExt as _, SeedableRng as _};

use self::gradient::{
    CONTROL, DECAY, EPSILON, LANES, LOSSES, TALLY, TILE, Tiles, adam_kernel, backpropagate_kernel, reduce_kernel,
    tally_kernel, weights_kernel,
};
use self::network::Networks;
use self::rollout::{SUMS, act_kernel, advantage_kernel, bootstrap_kernel, settle_kernel, value_kernel};
use self::statistics::{
    CHUNKS, MOMENTS, REPORT, chunk_kernel, merge_kernel, report_kernel, rescale_kernel, scale_kernel,
};
use crate::batch::{GpuAviary, Precision};
use crate::device::{AdapterKind, GpuDevice};
use crate::error::GpuError;
use crate::launch::begin::ranges_of;

/// Threads of a workgroup.
const WORKGROUP: u32 = 64;

/// Buffer on the device.
#[derive(Debug, Clone)]
struct Buffer {
    handle: Handle,
    /// Number of entries, each of four bytes.
    length: usize,
}

impl Buffer {
    /// Returns the argument of a kernel.
    #[allow(unsafe_code)]
    fn arg(&self) -> BufferArg {
        // SAFETY: every constructor allocates `length` entries
        unsafe { BufferArg::from_raw_parts(self.handle.clone(), self.length) }
    }
}

/// Kernels and buffers of the networks and their optimizer. Its functions enqueue work and do not wait for it.
#[derive(Debug)]
struct Machine {
    device: GpuDevice,
    networks: Networks,
    /// Rows of observations that a thread computes.
    per_thread: usize,
    /// Number of columns of the scratch matrix.
    width: usize,
    /// Actor, critic, log standard deviations.
    parameters: Buffer,
    /// First and second moments of Adam.
    moments: Buffer,
    gradient: Buffer,
    /// Learning rate and flag, see [`gradient`].
    control: Buffer,
    /// Scratch matrix, rows of [`Networks`] × the largest number of threads.
    scratch: Buffer,
    losses: Buffer,
    partial: Buffer,
    tally: Buffer,
    tile_rows: Buffer,
    places: Buffer,
    tiles: usize,
    /// Partial moments of [`chunk_kernel`].
    chunks: Buffer,
}

/// Samples of a rollout, steps × rows.
#[derive(Debug)]
struct Experience {
    steps: usize,
    rows: usize,
    /// Observations as the environments return them.
    raw: Buffer,
    /// Actions in half widths of the action space, and their log-probability.
    actions: Buffer,
    /// Values at every step and after the last one.
    values: Buffer,
    /// Values after truncations.
    next_values: Buffer,
    /// Scaled rewards and discounted sums.
    rewards: Buffer,
    /// Status of the episodes after every step.
    next: Buffer,
    /// Advantages, returns and weights.
    targets: Buffer,
    /// Moments of the columns of `targets`.
    target_moments: Buffer,
}

impl Experience {
    fn new(machine: &Machine, steps: usize, rows: usize) -> Self {
        let samples = steps * rows;
        let (size, acts) = (machine.networks.observation(), machine.networks.action());
        Self {
            steps,
            rows,
            raw: machine.zeros(samples * size),
            actions: machine.zeros(samples * (acts + 1)),
            values: machine.zeros(samples + rows),
            next_values: machine.zeros(samples),
            rewards: machine.zeros(2 * samples),
            next: machine.zeros(samples),
            targets: machine.zeros(3 * samples),
            target_moments: machine.zeros(3 * MOMENTS),
        }
    }

    fn samples(&self) -> usize {
        self.steps * self.rows
    }
}

/// Samples of a minibatch: entries of a permutation.
#[derive(Debug, Clone, Copy)]
struct Minibatch {
    /// Position of the first sample in the permutation.
    start: usize,
    /// Number of samples.
    count: usize,
    /// Keys of the permutation.
    keys: [u32; 4],
    /// True for the first minibatch of an update.
    first: bool,
    /// True for the first minibatch of the last epoch.
    renews: bool,
}

/// Calls a kernel with a thread per unit of work.
macro_rules! launch {
    ($machine:expr, $kernel:ident, $threads:expr, $($argument:expr),+ $(,)?) => {{
        let machine: &Machine = $machine;
        let (grid, group) = machine.grid($threads);
        // SAFETY: `Buffer` guarantees the length of every buffer. Kernels derive their indices from the numbers of
        // rows, samples and parameters that the buffers were allocated with, and threads beyond them do nothing.
        #[allow(unsafe_code)]
        unsafe {
            $kernel::launch_unchecked(machine.device.client(), grid, group, $($argument),+)
        }
    }};
}

impl Machine {
    /// Creates the buffers for up to a number of rows at a time.
    fn new(device: &GpuDevice, shape: &NetworkShape, rows: usize) -> Self {
        let networks = Networks::new(shape);
        let per_thread = per_thread(device);
        let width = rows.next_multiple_of(per_thread);
        let tiles = Tiles::new(&networks);
        let count = networks.count();
        let columns = networks.observation().max(SUMS);
        let zeros = |length: usize| zeros(device, length);
        Self {
            parameters: zeros(count),
            moments: zeros(2 * count),
            gradient: zeros(count),
            control: zeros(CONTROL),
            scratch: zeros(networks.rows() * width),
            losses: zeros(LOSSES * width),
            partial: zeros(LANES * tiles.count() * TILE * TILE),
            tally: zeros(TALLY * LANES),
            tile_rows: words(device, &tiles.rows),
            places: words(device, &tiles.places),
            tiles: tiles.count(),
            chunks: zeros(CHUNKS * columns * MOMENTS),
            device: device.clone(),
            networks,
            per_thread,
            width,
        }
    }

    fn zeros(&self, length: usize) -> Buffer {
        zeros(&self.device, length)
    }

    fn floats(&self, numbers: &[f32]) -> Buffer {
        floats(&self.device, numbers)
    }

    fn read<const N: usize>(&self, buffers: [&Buffer; N]) -> Result<[Vec<f32>; N], GpuError> {
        let handles = buffers.map(|buffer| buffer.handle.clone()).to_vec();
        let bytes = self.device.client().read(handles).map_err(|error| GpuError::device(&error))?;
        let mut lists = bytes.iter().map(|bytes| f32::from_bytes(bytes).to_vec());
        Ok([(); N].map(|()| lists.next().unwrap_or_default()))
    }

    /// Waits for the device.
    fn wait(&self) -> Result<(), GpuError> {
        cubecl::future::block_on(self.device.client().sync()).map_err(|error| GpuError::device(&error))
    }

    /// Returns the grid of workgroups with at least a number of threads.
    fn grid(&self, threads: usize) -> (CubeCount, CubeDim) {
        let groups = threads.div_ceil(WORKGROUP as usize).max(1);
        let width = groups.min(self.device.client().properties().hardware.max_cube_count.0 as usize);
        (CubeCount::Static(width as u32, groups.div_ceil(width) as u32, 1), CubeDim::new_1d(WORKGROUP))
    }

    /// Computes the moments of the columns of a matrix. `weights` is the column that is 0 in rows that do not count.
    fn moments_of(&self, matrix: &Buffer, columns: usize, weights: Option<usize>, out: &Buffer) {
        let rows = (matrix.length / columns) as u32;
        launch!(self, chunk_kernel, CHUNKS * columns, matrix.arg(), self.chunks.arg(), rows, columns, weights);
        launch!(self, merge_kernel, columns, self.chunks.arg(), out.arg(), columns);
    }

    /// Computes advantages and returns, and their moments.
    fn estimate(&self, experience: &Experience, config: &PpoConfig) {
        let Experience { rewards, values, next_values, next, targets, .. } = experience;
        launch!(
            self,
            advantage_kernel,
            experience.rows,
            rewards.arg(),
            values.arg(),
            next_values.arg(),
            next.arg(),
            targets.arg(),
            experience.steps as u32,
            experience.rows as u32,
            config.gamma as f32,
            config.gae_lambda as f32,
        );
        self.moments_of(targets, 3, Some(2), &experience.target_moments);
    }

    /// Computes the gradient over a minibatch, and adds its losses to the tally.
    fn differentiate(&self, experience: &Experience, scale: &Buffer, part: &Minibatch, config: &PpoConfig) {
        let Minibatch { start, count, keys: [a, b, c, d], first, renews } = *part;
        let (networks, samples) = (&self.networks, experience.samples());
        let width = self.width as u32;
        launch!(
            self,
            backpropagate_kernel,
            2 * count.div_ceil(self.per_thread),
            experience.raw.arg(),
            experience.actions.arg(),
            experience.targets.arg(),
            experience.target_moments.arg(),
            scale.arg(),
            self.parameters.arg(),
            self.scratch.arg(),
            self.losses.arg(),
            start as u32,
            count as u32,
            width,
            samples as u32,
            noise::bits(samples),
            a,
            b,
            c,
            d,
            config.clip_range as f32,
            config.value_coef as f32,
            networks.clone(),
            self.per_thread,
        );
        launch!(
            self,
            weights_kernel,
            self.tiles * LANES,
            self.tile_rows.arg(),
            self.scratch.arg(),
            self.partial.arg(),
            count as u32,
            width,
            self.tiles as u32,
        );
        launch!(
            self,
            reduce_kernel,
            networks.count(),
            self.places.arg(),
            self.partial.arg(),
            self.gradient.arg(),
            self.tiles as u32,
            config.entropy_coef as f32,
            networks.count(),
            networks.log_deviations(),
        );
        self.tally(count, first, renews);
    }

    /// Sums the squares of the gradient, and adds the losses of a number of samples to the tally.
    fn tally(&self, count: usize, first: bool, renews: bool) {
        launch!(
            self,
            tally_kernel,
            LANES,
            self.gradient.arg(),
            self.losses.arg(),
            self.tally.arg(),
            count as u32,
            self.width as u32,
            u32::from(first),
            u32::from(renews),
            self.networks.count(),
        );
    }

    /// Updates the parameters against the gradient; `time` is the number of the step, from 1 on.
    fn descend(&self, time: usize, config: &PpoConfig) {
        let power = time.min(i32::MAX as usize) as i32;
        let [first, second] = DECAY.map(|decay| 1.0 - decay.powi(power));
        let root = second.sqrt();
        let (count, logs) = (self.networks.count(), self.networks.log_deviations());
        launch!(
            self,
            adam_kernel,
            count,
            self.gradient.arg(),
            self.tally.arg(),
            self.parameters.arg(),
            self.moments.arg(),
            self.control.arg(),
            config.max_grad_norm as f32,
            root / first,
            EPSILON * root,
            count,
            logs,
        );
    }
}

/// Returns the number of rows of observations that a thread computes. More of them share a load of a weight. GPUs have
/// more threads than rows, and broadcast a weight to all threads of a group; software loads it once per thread.
fn per_thread(device: &GpuDevice) -> usize {
    if device.adapter().kind == AdapterKind::Cpu { 8 } else { 1 }
}

fn zeros(device: &GpuDevice, length: usize) -> Buffer {
    floats(device, &vec![0.0; length])
}

fn floats(device: &GpuDevice, numbers: &[f32]) -> Buffer {
    let handle = device.client().create(Bytes::from_elems(numbers.to_vec()));
    Buffer { handle, length: numbers.len() }
}

fn words(device: &GpuDevice, numbers: &[u32]) -> Buffer {
    Buffer { handle: device.client().create_from_slice(u32::as_bytes(numbers)), length: numbers.len() }
}

/// Learner of a GPU: PPO whose environments, networks and optimizer are in the memory of the device.
///
/// It is the [`Learner`] of a [`Trainer`](learn::Trainer), which evaluates the policy on the CPU, in MuJoCo.
///
/// ```no_run
/// use aviary_gpu::{GpuDevice, GpuPpo};
/// use learn::{TrainConfig, TrainDevice, Trainer};
///
/// let mut config = TrainConfig::of_task("hover")?;
/// (config.device, config.until_success) = (TrainDevice::Gpu, true);
/// let device = GpuDevice::open(None)?;
/// let learner = GpuPpo::new(&config, &device)?;
/// let mut trainer = Trainer::with_learner(config, "an example", Box::new(learner))?;
/// while trainer.stop().is_none() {
///     trainer.advance()?;
/// }
/// trainer.best().save("hover.safetensors")?;
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct GpuPpo {
    config: PpoConfig,
    terms: Terms,
    shape: NetworkShape,
    env: GpuAviary,
    /// All work of the learner is on one stream, whichever thread calls it.
    stream: StreamId,
    machine: Machine,
    experience: Experience,
    /// Means and variances of observations and discounted sums, see [`scale_kernel`].
    running: Buffer,
    /// Means and standard deviations of observations, divisor of rewards, centres and half widths of actions.
    scale: Buffer,
    observation_moments: Buffer,
    reward_moments: Buffer,
    sum_moments: Buffer,
    /// Sums of every row, rows × [`SUMS`].
    sums: Buffer,
    /// Age and length of the current episode and largest length of every row.
    counters: Buffer,
    selection: Buffer,
    /// Ranges of the initial states, if training has its own.
    ranges: Option<Buffer>,
    report: Buffer,
    /// Number of rollouts in the statistics.
    rollouts: u64,
    /// Number of steps of Adam.
    time: usize,
    rate: f64,
    clock: Clock,
    /// True if the next rollout waits for the device after every kernel, to measure its parts.
    measures: bool,
    /// Share of inference in the wall time of a measured rollout.
    inference: f64,
}

impl GpuPpo {
    /// Creates environments, networks and optimizer for a configuration.
    ///
    /// # Errors
    /// - [`GpuError::NotPorted`] for a task or an option that the kernels do not have.
    /// - The errors of [`GpuAviary::make`].
    /// - [`GpuError::TooManyEnvironments`] if the samples of a rollout exceed the buffers of the device.
    /// - [`GpuError::Env`] for an airframe that does not exist.
    pub fn new(config: &TrainConfig, device: &GpuDevice) -> Result<Self, GpuError> {
        let stream = StreamId::allocate();
        stream.executes(|| Self::on_stream(config, device, stream))
    }

    fn on_stream(config: &TrainConfig, device: &GpuDevice, stream: StreamId) -> Result<Self, GpuError> {
        let not_ported = |option, got: &str, expected| GpuError::NotPorted { option, got: got.into(), expected };
        if config.per_drone {
            return Err(not_ported("per_drone", "true", "false"));
        }
        if config.ppo.recurrent > 0 {
            return Err(not_ported("recurrent", &config.ppo.recurrent.to_string(), "0"));
        }
        if config.training_starts.iter().any(|start| !start.randomized) {
            return Err(not_ported("training_starts", "randomized = false", "true"));
        }
        let (options, ranges) = environment_of(config)?;
        let rows = config.ppo.environments;
        let batch = VecConfig { autoreset: Autoreset::SameStep, on_fault: OnFault::Truncate, ..VecConfig::new(rows) };
        let single = Precision::Single;
        let env = match config.course() {
            Some(Course::FlyThrough(task)) => GpuAviary::new(options.for_task(task)?, batch, device, single)?,
            Some(Course::Race(task)) => GpuAviary::new(options.for_task(task)?, batch, device, single)?,
            None => GpuAviary::make(&config.task, options, batch, device, single)?,
        };
        let ppo = config.ppo.clone();
        let (observations, actions) = (&env.observation_space().vector, env.action_space());
        if env.observation_size() != observations.size() {
            return Err(not_ported("observation_type", "another type", "kin"));
        }
        let shape = NetworkShape::new(observations.size(), actions.size(), &ppo.hidden, ppo.activation);
        let samples = rows * ppo.horizon;
        let width = rows.max(ppo.minibatch.min(samples));
        check_size(device, &shape, samples, rows, width)?;
        let machine = Machine::new(device, &shape, width);
        let (size, acts) = (shape.observation(), shape.action());
        let mut scale = vec![0.0; size];
        scale.extend(std::iter::repeat_n(1.0, size + 1));
        let bounds = actions.low().iter().zip(actions.high());
        let reach = bounds.map(|(&low, &high)| {
            let bounded = low.is_finite() && high.is_finite();
            if bounded { [0.5 * (low + high) as f32, 0.5 * (high - low) as f32] } else { [0.0, 1.0] }
        });
        let reach: Vec<[f32; 2]> = reach.collect();
        scale.extend(reach.iter().map(|[middle, _]| middle));
        scale.extend(reach.iter().map(|[_, half]| half));
        let parameters = shape.initial(ppo.initial_std as f32, &mut Rng::seed_from_u64(config.seed));
        let learner = Self {
            terms: config.terms(),
            stream,
            experience: Experience::new(&machine, ppo.horizon, rows),
            running: machine.zeros(2 * (size + 1)),
            scale: machine.floats(&scale),
            observation_moments: machine.zeros(size * MOMENTS),
            reward_moments: machine.zeros(2 * MOMENTS),
            sum_moments: machine.zeros(SUMS * MOMENTS),
            sums: machine.zeros(rows * SUMS),
            counters: machine.zeros(3 * rows),
            selection: machine.zeros(3 * rows),
            ranges: (!ranges.is_empty()).then(|| machine.floats(&ranges_of(&ranges, rows))),
            report: machine.zeros(REPORT),
            rollouts: 0,
            time: 0,
            rate: ppo.learning_rate,
            clock: Clock::default(),
            measures: false,
            inference: 0.0,
            machine: Machine {
                parameters: machine.floats(&parameters),
                control: machine.floats(&[ppo.learning_rate as f32, 0.0]),
                ..machine
            },
            config: ppo,
            shape,
            env,
        };
        debug_assert_eq!((acts, size), (learner.machine.networks.action(), learner.machine.networks.observation()));
        learner.machine.wait()?;
        Ok(learner)
    }

    /// Collects a rollout.
    fn collect(&mut self, seed: u64) -> Result<(), GpuError> {
        let began = Instant::now();
        let measured = std::mem::take(&mut self.measures);
        let (rows, steps) = (self.experience.rows, self.experience.steps);
        let (low, high) = (seed as u32, (seed >> 32) as u32);
        let mut inference = Duration::ZERO;
        if measured {
            self.machine.wait()?;
        }
        for step in 0..steps as u32 {
            let part = Instant::now();
            self.act(step, low, high);
            if measured {
                self.machine.wait()?;
                inference += part.elapsed();
            }
            self.env.on_device().step();
            self.settle(step);
            self.begin();
        }
        let (machine, batch) = (&self.machine, self.env.on_device());
        launch!(
            machine,
            value_kernel,
            rows.div_ceil(machine.per_thread),
            machine.parameters.arg(),
            self.scale.arg(),
            self.arg(&batch.observations, self.shape.observation()),
            machine.scratch.arg(),
            self.experience.values.arg(),
            steps as u32,
            rows as u32,
            machine.networks.clone(),
            machine.per_thread,
        );
        machine.moments_of(&self.sums, SUMS, None, &self.sum_moments);
        machine.moments_of(&self.experience.rewards, 2, None, &self.reward_moments);
        machine.wait()?;
        let elapsed = began.elapsed();
        if measured {
            self.inference = inference.as_secs_f64() / elapsed.as_secs_f64().max(1e-9);
        }
        let inference = elapsed.mul_f64(self.inference.min(1.0));
        self.clock.inference += inference;
        self.clock.simulation += elapsed.saturating_sub(inference);
        Ok(())
    }

    /// Samples the actions of a step.
    fn act(&self, step: u32, low: u32, high: u32) {
        let (machine, batch, rows) = (&self.machine, self.env.on_device(), self.experience.rows);
        launch!(
            machine,
            act_kernel,
            2 * rows.div_ceil(machine.per_thread),
            machine.parameters.arg(),
            self.scale.arg(),
            self.arg(&batch.observations, self.shape.observation()),
            machine.scratch.arg(),
            self.experience.raw.arg(),
            self.experience.actions.arg(),
            self.arg(&batch.actions, self.shape.action()),
            self.experience.values.arg(),
            step,
            rows as u32,
            low,
            high,
            machine.networks.clone(),
            machine.per_thread,
        );
    }

    /// Notes rewards and ends of a step, and computes the values after truncations.
    fn settle(&self, step: u32) {
        let (machine, batch, rows) = (&self.machine, self.env.on_device(), self.experience.rows);
        launch!(
            machine,
            settle_kernel,
            rows,
            self.arg(&batch.ends, 1),
            self.arg(&batch.rewards, 1),
            self.scale.arg(),
            self.experience.next.arg(),
            self.experience.rewards.arg(),
            self.sums.arg(),
            self.counters.arg(),
            self.selection.arg(),
            step,
            rows as u32,
            self.config.gamma as f32,
            self.terms.out_of_bounds,
            2 * self.shape.observation(),
            self.ranges.is_some(),
        );
        launch!(
            machine,
            bootstrap_kernel,
            rows,
            machine.parameters.arg(),
            self.scale.arg(),
            self.arg(&batch.ends, 1),
            self.experience.next.arg(),
            self.arg(&batch.observations, self.shape.observation()),
            self.arg(&batch.last_observations, self.shape.observation()),
            machine.scratch.arg(),
            self.experience.next_values.arg(),
            step,
            rows as u32,
            machine.networks.clone(),
        );
    }

    /// Starts an episode in the selected environments.
    fn begin(&self) {
        self.env.on_device().begin(&self.selection.handle, self.ranges.as_ref().map(|ranges| &ranges.handle));
    }

    /// Returns the argument of a buffer of the environments with a number of entries per row.
    fn arg(&self, handle: &Handle, entries: usize) -> BufferArg {
        Buffer { handle: handle.clone(), length: entries * self.experience.rows }.arg()
    }

    /// Adds the rollout to the statistics of observations and rewards.
    fn rescale(&mut self) {
        self.rollouts += 1;
        let (machine, size) = (&self.machine, self.shape.observation());
        machine.moments_of(&self.experience.raw, size, None, &self.observation_moments);
        launch!(
            machine,
            scale_kernel,
            size + 1,
            self.observation_moments.arg(),
            self.reward_moments.arg(),
            self.running.arg(),
            self.scale.arg(),
            1.0 / self.rollouts as f32,
            size,
        );
    }

    /// Updates the parameters in several epochs over the rollout. Returns the number of minibatches, and the number of
    /// samples in those of an epoch.
    fn update(&mut self, seed: u64) -> (usize, usize) {
        let samples = self.experience.samples();
        let size = self.config.minibatch.min(samples);
        let (mut minibatches, mut seen) = (0, 0);
        for epoch in 0..self.config.epochs {
            let keys = noise::keys(seed, epoch as u32);
            seen = 0;
            for start in (0..samples).step_by(size) {
                let count = size.min(samples - start);
                // a last minibatch of less than half the size is skipped; the permutations of other epochs move its
                // samples
                if 2 * count < size {
                    continue;
                }
                let renews = start == 0 && epoch + 1 == self.config.epochs;
                let part = Minibatch { start, count, keys, first: minibatches == 0, renews };
                self.machine.differentiate(&self.experience, &self.scale, &part, &self.config);
                self.time += 1;
                self.machine.descend(self.time, &self.config);
                minibatches += 1;
                seen += count;
            }
        }
        (minibatches, seen)
    }

    fn run_iteration(&mut self, seed: u64) -> Result<Report, TrainError> {
        self.collect(seed).map_err(train_error)?;
        let began = Instant::now();
        self.machine.estimate(&self.experience, &self.config);
        let (minibatches, seen) = self.update(seed);
        self.rescale();
        let machine = &self.machine;
        launch!(
            machine,
            report_kernel,
            1,
            self.sum_moments.arg(),
            self.experience.target_moments.arg(),
            machine.tally.arg(),
            machine.parameters.arg(),
            machine.control.arg(),
            self.report.arg(),
            seen as f32,
            self.config.target_kl as f32,
            self.config.learning_rate as f32,
            machine.networks.log_deviations(),
            machine.networks.action(),
        );
        let [report] = machine.read([&self.report]).map_err(train_error)?;
        self.clock.gradient += began.elapsed();
        let report: [f32; REPORT] = report.try_into().unwrap_or([f32::NAN; REPORT]);
        let [episodes, returns, rewards, loss, kl, clipped, deviation, all, left, rate, diverged] =
            report.map(f64::from);
        if diverged != 0.0 {
            return Err(TrainError::Diverged);
        }
        // single precision may round the largest rate up
        self.rate = rate.min(self.config.learning_rate);
        let seen = seen.max(1) as f64;
        Ok(Report {
            // the number is a mean times the rows, which rounds
            mean_return: (episodes > 0.5).then(|| returns / episodes),
            mean_reward: rewards / self.experience.samples() as f64,
            approx_kl: kl / seen,
            clip_fraction: clipped / seen / self.config.epochs as f64,
            loss: loss / minibatches.max(1) as f64,
            action_std: deviation,
            explained_variance: 1.0 - left / all.max(1e-12),
        })
    }

    fn restart_rows(&mut self, seed: u64) {
        let rows = self.experience.rows;
        let mut rng = Rng::seed_from_u64(seed);
        let environments: u64 = rng.random();
        let mut selection = vec![2_u32; rows];
        selection.extend(std::iter::repeat_n(environments as u32, rows));
        selection.extend(std::iter::repeat_n((environments >> 32) as u32, rows));
        let limit = self.env.episode_steps();
        let longest = |row: usize| self.terms.longest(row, limit) as u32;
        let mut counters = vec![0_u32; rows];
        // the first episode of every row is truncated at a random step, so that the rows are spread
        counters.extend((0..rows).map(|row| rng.random_range(1..=longest(row))));
        counters.extend((0..rows).map(longest));
        self.selection = words(&self.machine.device, &selection);
        self.counters = words(&self.machine.device, &counters);
        self.sums = self.machine.zeros(rows * SUMS);
        self.begin();
        // the first rollout compiles the kernels
        self.measures = self.rollouts > 0;
    }

    fn read_state(&self) -> Result<LearnerState, GpuError> {
        let Machine { parameters, moments, control, .. } = &self.machine;
        let [parameters, moments, control, running] =
            self.machine.read([parameters, moments, control, &self.running])?;
        let size = self.shape.observation();
        let (first, second) = moments.split_at(moments.len() / 2);
        let (means, variances) = running.split_at(size + 1);
        let wide = |numbers: &[f32]| numbers.iter().map(|&x| f64::from(x)).collect::<Vec<f64>>();
        let count = (self.rollouts * self.experience.samples() as u64) as f64;
        let statistics =
            |range: std::ops::Range<usize>| Running::of(count, wide(&means[range.clone()]), &wide(&variances[range]));
        Ok(LearnerState {
            parameters,
            optimizer_steps: self.time,
            first_moments: first.to_vec(),
            second_moments: second.to_vec(),
            learning_rate: f64::from(control[0]).min(self.config.learning_rate),
            observations: statistics(0..size),
            rewards: statistics(size..size + 1),
        })
    }

    fn write_state(&mut self, state: &LearnerState) -> Result<(), GpuError> {
        let machine = &mut self.machine;
        let narrow = |numbers: &[f64]| numbers.iter().map(|&x| x as f32).collect::<Vec<f32>>();
        machine.parameters = machine.floats(&state.parameters);
        machine.moments = machine.floats(&[&state.first_moments[..], &state.second_moments[..]].concat());
        machine.control = machine.floats(&[state.learning_rate as f32, 0.0]);
        let means = [state.observations.means(), state.rewards.means()].concat();
        let variances = [state.observations.variances(), state.rewards.variances()].concat();
        self.running = machine.floats(&[narrow(&means), narrow(&variances)].concat());
        self.rollouts = (state.observations.count() / self.experience.samples() as f64).round() as u64;
        (self.time, self.rate) = (state.optimizer_steps, state.learning_rate);
        let size = self.shape.observation();
        if self.rollouts > 0 {
            let machine = &self.machine;
            launch!(machine, rescale_kernel, size + 1, self.running.arg(), self.scale.arg(), size);
        }
        self.machine.wait()
    }
}

/// Returns the options of the environments of training, and the ranges of their initial states, assigned to the
/// environments cyclically; empty if training has none of its own.
fn environment_of(config: &TrainConfig) -> Result<(EnvConfig, Vec<InitialRanges>), GpuError> {
    let mut config = config.clone();
    let ranges: Vec<_> = config.training_starts.iter().map(learn::TrainingStart::ranges).collect();
    if !ranges.is_empty() {
        let others = config.conditions.randomization.take();
        let others = others.map(|randomization| Randomization { initial: None, ..randomization });
        config.conditions.randomization = others.filter(|others| *others != Randomization::NONE);
    }
    let options = config.options().map_err(|error| match error {
        TrainError::Env(error) => GpuError::Env(error),
        error => GpuError::Env(EnvError::Device { message: error.to_string() }),
    })?;
    Ok((options, ranges))
}

/// Checks that the buffers of a learner are within the limits of the device.
fn check_size(
    device: &GpuDevice,
    shape: &NetworkShape,
    samples: usize,
    rows: usize,
    width: usize,
) -> Result<(), GpuError> {
    let networks = Networks::new(shape);
    let experience = samples * shape.observation().max(shape.action() + 1).max(3);
    let width = width.next_multiple_of(per_thread(device));
    let largest = experience.max(networks.rows() * width).max(LANES * Tiles::new(&networks).count() * TILE * TILE);
    let adapter = device.adapter();
    // entries have indices of 32 bits
    let max = (adapter.max_buffer / 4).min(u64::from(u32::MAX)) as usize;
    if largest <= max {
        return Ok(());
    }
    let (got, adapter_name) = (rows, adapter.name.clone());
    let max = (rows as u128 * max as u128 / largest as u128) as usize;
    Err(GpuError::TooManyEnvironments { got, max, bytes: adapter.max_buffer, adapter: adapter_name })
}

fn train_error(error: GpuError) -> TrainError {
    TrainError::Env(error.into())
}

impl Learner for GpuPpo {
    fn rows(&self) -> usize {
        self.experience.rows
    }

    fn observation_space(&self) -> &BoxSpace {
        &self.env.observation_space().vector
    }

    fn action_space(&self) -> &BoxSpace {
        self.env.action_space()
    }

    fn shape(&self) -> &NetworkShape {
        &self.shape
    }

    fn has_scales(&self) -> bool {
        self.rollouts > 0
    }

    fn estimate_scales(&mut self, seeds: [u64; 2]) -> Result<(), TrainError> {
        let stream = self.stream;
        stream.executes(|| {
            self.restart_rows(seeds[0]);
            self.collect(seeds[1]).map_err(train_error)?;
            self.rescale();
            self.machine.wait().map_err(train_error)
        })
    }

    fn restart(&mut self, seed: u64) -> Result<(), TrainError> {
        let stream = self.stream;
        stream.executes(|| self.restart_rows(seed));
        Ok(())
    }

    fn iterate(&mut self, seed: u64) -> Result<Report, TrainError> {
        let stream = self.stream;
        stream.executes(|| self.run_iteration(seed))
    }

    fn learning_rate(&self) -> f64 {
        self.rate
    }

    fn clock(&self) -> Clock {
        self.clock
    }

    fn state(&self) -> Result<LearnerState, TrainError> {
        self.stream.executes(|| self.read_state()).map_err(train_error)
    }

    fn restore(&mut self, state: LearnerState) -> Result<(), TrainError> {
        let stream = self.stream;
        stream.executes(|| self.write_state(&state)).map_err(train_error)
    }
}

#[cfg(test)]
mod tests;
