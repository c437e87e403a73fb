//! Buffers of networks, optimizer and samples, and the launches of their kernels.

use cubecl::bytes::Bytes;
use cubecl::prelude::*;
use cubecl::server::Handle;
use learn::{DECAY, EPSILON, NetworkShape, PpoConfig};

use super::gradient::{
    CONTROL, LANES, LOSSES, TALLY, TILE, Tiles, adam_kernel, backpropagate_kernel, reduce_kernel, tally_kernel,
    weights_kernel,
};
use super::network::Networks;
use super::noise;
use super::rollout::{SUMS, advantage_kernel};
use super::statistics::{CHUNKS, MOMENTS, chunk_kernel, merge_kernel};
use crate::device::{AdapterKind, GpuDevice};
use crate::error::GpuError;

/// Threads of a workgroup.
const WORKGROUP: u32 = 64;

/// Buffer on the device.
#[derive(Debug, Clone)]
pub(super) struct Buffer {
    pub handle: Handle,
    /// Number of entries, each of four bytes.
    pub length: usize,
}

impl Buffer {
    /// Returns the argument of a kernel.
    #[allow(unsafe_code)]
    pub fn arg(&self) -> BufferArg {
        // SAFETY: every constructor allocates `length` entries
        unsafe { BufferArg::from_raw_parts(self.handle.clone(), self.length) }
    }
}

/// Kernels and buffers of the networks and their optimizer. Its functions enqueue work and do not wait for it.
#[derive(Debug)]
pub(super) struct Machine {
    pub device: GpuDevice,
    pub networks: Networks,
    /// Rows of observations that a thread computes.
    pub per_thread: usize,
    /// Number of columns of the scratch matrix.
    pub width: usize,
    /// Actor, critic, log standard deviations.
    pub parameters: Buffer,
    /// First and second moments of Adam.
    pub moments: Buffer,
    pub gradient: Buffer,
    /// Learning rate and flag, see [`gradient`].
    pub control: Buffer,
    /// Scratch matrix, rows of [`Networks`] × the largest number of threads.
    pub scratch: Buffer,
    pub losses: Buffer,
    pub partial: Buffer,
    pub tally: Buffer,
    pub tile_rows: Buffer,
    pub places: Buffer,
    pub tiles: usize,
    /// Partial moments of [`chunk_kernel`].
    pub chunks: Buffer,
}

/// Samples of a rollout, steps × rows.
#[derive(Debug)]
pub(super) struct Experience {
    pub steps: usize,
    pub rows: usize,
    /// Observations as the environments return them.
    pub raw: Buffer,
    /// Actions in half widths of the action space, and their log-probability.
    pub actions: Buffer,
    /// Values at every step and after the last one.
    pub values: Buffer,
    /// Values after truncations.
    pub next_values: Buffer,
    /// Scaled rewards and discounted sums.
    pub rewards: Buffer,
    /// Status of the episodes after every step.
    pub next: Buffer,
    /// Advantages, returns and weights.
    pub targets: Buffer,
    /// Moments of the columns of `targets`.
    pub target_moments: Buffer,
}

impl Experience {
    pub fn new(machine: &Machine, steps: usize, rows: usize) -> Self {
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

    pub fn samples(&self) -> usize {
        self.steps * self.rows
    }
}

/// Samples of a minibatch: entries of a permutation.
#[derive(Debug, Clone, Copy)]
pub(super) struct Minibatch {
    /// Position of the first sample in the permutation.
    pub start: usize,
    /// Number of samples.
    pub count: usize,
    /// Keys of the permutation.
    pub keys: [u32; 4],
    /// True for the first minibatch of an update.
    pub first: bool,
    /// True for the first minibatch of the last epoch.
    pub renews: bool,
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
pub(super) use launch;

impl Machine {
    /// Creates the buffers for up to a number of rows at a time.
    pub fn new(device: &GpuDevice, shape: &NetworkShape, rows: usize) -> Self {
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

    pub fn zeros(&self, length: usize) -> Buffer {
        zeros(&self.device, length)
    }

    pub fn floats(&self, numbers: &[f32]) -> Buffer {
        floats(&self.device, numbers)
    }

    pub fn read<const N: usize>(&self, buffers: [&Buffer; N]) -> Result<[Vec<f32>; N], GpuError> {
        let handles = buffers.map(|buffer| buffer.handle.clone()).to_vec();
        let bytes = self.device.client().read(handles).map_err(|error| GpuError::device(&error))?;
        let mut lists = bytes.iter().map(|bytes| f32::from_bytes(bytes).to_vec());
        Ok([(); N].map(|()| lists.next().unwrap_or_default()))
    }

    /// Waits for the device.
    pub fn wait(&self) -> Result<(), GpuError> {
        cubecl::future::block_on(self.device.client().sync()).map_err(|error| GpuError::device(&error))
    }

    /// Returns the grid of workgroups with at least a number of threads.
    pub fn grid(&self, threads: usize) -> (CubeCount, CubeDim) {
        let [width, height] = self.device.grid(threads.div_ceil(WORKGROUP as usize));
        (CubeCount::Static(width, height, 1), CubeDim::new_1d(WORKGROUP))
    }

    /// Computes the moments of the columns of a matrix. `weights` is the column that is 0 in rows that do not count.
    pub fn moments_of(&self, matrix: &Buffer, columns: usize, weights: Option<usize>, out: &Buffer) {
        let rows = (matrix.length / columns) as u32;
        launch!(self, chunk_kernel, CHUNKS * columns, matrix.arg(), self.chunks.arg(), rows, columns, weights);
        launch!(self, merge_kernel, columns, self.chunks.arg(), out.arg(), columns);
    }

    /// Computes advantages and returns, and their moments.
    pub fn estimate(&self, experience: &Experience, config: &PpoConfig) {
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
    pub fn differentiate(&self, experience: &Experience, scale: &Buffer, part: &Minibatch, config: &PpoConfig) {
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
    pub fn tally(&self, count: usize, first: bool, renews: bool) {
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
    pub fn descend(&self, time: usize, config: &PpoConfig) {
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
pub(super) fn per_thread(device: &GpuDevice) -> usize {
    if device.adapter().kind == AdapterKind::Cpu { 8 } else { 1 }
}

pub(super) fn zeros(device: &GpuDevice, length: usize) -> Buffer {
    Buffer { handle: device.client().create(Bytes::from_elems(vec![0.0_f32; length])), length }
}

pub(super) fn floats(device: &GpuDevice, numbers: &[f32]) -> Buffer {
    let handle = device.client().create(Bytes::from_elems(numbers.to_vec()));
    Buffer { handle, length: numbers.len() }
}

pub(super) fn words(device: &GpuDevice, numbers: &[u32]) -> Buffer {
    Buffer { handle: device.client().create_from_slice(u32::as_bytes(numbers)), length: numbers.len() }
}

/// Returns the number of rows that are computed at a time: those of a step or of a minibatch.
pub(super) fn rows_at_a_time(rows: usize, config: &PpoConfig) -> usize {
    rows.max(config.minibatch.min(rows * config.horizon))
}

/// Checks that the buffers of a learner are within the limits of the device.
pub(super) fn check_size(
    device: &GpuDevice,
    shape: &NetworkShape,
    rows: usize,
    config: &PpoConfig,
) -> Result<(), GpuError> {
    let networks = Networks::new(shape);
    let width = rows_at_a_time(rows, config);
    let sample = shape.observation().max(shape.action() + 1).max(3);
    let scratch = networks.rows() * width.next_multiple_of(per_thread(device));
    let adapter = device.adapter();
    // entries have indices of 32 bits
    let max = (adapter.max_buffer / size_of::<f32>() as u64).min(u64::from(u32::MAX)) as usize;
    let at_a_time = if width > rows { ("minibatch", width) } else { ("environments", rows) };
    let sizes = [
        (("environments × horizon", rows * config.horizon), rows * config.horizon * sample),
        (at_a_time, scratch),
        (("hidden", networks.count()), LANES * Tiles::new(&networks).count() * TILE * TILE),
    ];
    for ((option, got), length) in sizes {
        if length > max {
            let max = (got as u128 * max as u128 / length as u128) as usize;
            let (bytes, adapter) = (adapter.max_buffer, adapter.name.clone());
            return Err(GpuError::TooLarge { option, got, max, bytes, adapter });
        }
    }
    Ok(())
}
