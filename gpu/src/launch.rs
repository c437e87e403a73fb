//! A batch in the memory of the device, and the launches of its kernels.

#[cfg(feature = "learn")]
pub(crate) mod begin;

use std::time::Instant;

use cubecl::bytes::Bytes;
use cubecl::prelude::*;
use cubecl::server::Handle;

use crate::batch::Precision;
use crate::device::GpuDevice;
use crate::environment::{Memory, count_numbers};
use crate::error::GpuError;
use crate::kernel::{copy_kernel, reset_kernel, step_kernel};
use crate::parameters::Parameters;
use crate::plan::Plan;
use crate::traced::Group;

/// Usual number of threads in a workgroup.
const THREADS: u32 = 64;

/// Buffers of a batch on the device, and the options of its kernels.
#[derive(Debug)]
pub(crate) struct DeviceBatch {
    pub device: GpuDevice,
    pub precision: Precision,
    pub plan: Plan,
    /// Number of environments.
    pub environments: usize,
    /// Number of threads of a workgroup, a multiple of the number of drones.
    pub workgroup: u32,
    /// True if a step keeps the last observation of an episode.
    keeps_last: bool,
    pub numbers: Handle,
    pub words: Handle,
    /// Actions: a row per drone, in the precision of the batch.
    pub actions: Handle,
    parameters: Handle,
    /// Observations: a row per drone, single precision.
    pub observations: Handle,
    pub last_observations: Handle,
    /// Reward of each environment, single precision.
    pub rewards: Handle,
    /// End of each environment: the number of the reason and bits of [`end`](crate::environment::end).
    pub ends: Handle,
    /// Numbers that the drones of an environment exchange.
    exchange: Handle,
}

impl DeviceBatch {
    /// Allocates a batch. `parameters` has the nominal parameters of each drone of an environment.
    ///
    /// # Errors
    /// [`GpuError::NotPorted`] for more drones than threads in a workgroup. [`GpuError::Device`] without the memory.
    pub fn new(
        device: &GpuDevice,
        precision: Precision,
        plan: Plan,
        parameters: &[Parameters],
        environments: usize,
        keeps_last: bool,
    ) -> Result<Self, GpuError> {
        let client = device.client();
        let zeros = |bytes: usize| client.create(Bytes::from_elems(vec![0_u8; bytes]));
        let (drones, single) = (environments * plan.drones as usize, size_of::<f32>());
        let observations = drones * plan.observation_size();
        let parameters: Vec<f64> = parameters.iter().flat_map(|parameters| parameters.numbers()).collect();
        let mut batch = Self {
            device: device.clone(),
            precision,
            environments,
            workgroup: 0,
            keeps_last,
            numbers: zeros(drones * count_numbers(&plan) * precision.bytes()),
            words: zeros(drones * Memory::<f64>::WORDS * size_of::<u32>()),
            actions: zeros(drones * plan.action_size() * precision.bytes()),
            parameters: upload(device, precision, parameters.into_iter()),
            observations: zeros(observations * single),
            last_observations: zeros(if keeps_last { observations } else { 1 } * single),
            rewards: zeros(environments * single),
            ends: zeros(environments * size_of::<u32>()),
            exchange: zeros(precision.bytes()),
            plan,
        };
        batch.set_workgroup(THREADS.max(batch.plan.drones))?;
        // memory that the device does not have is an error here
        batch.wait()?;
        Ok(batch)
    }

    /// Sets the number of threads in a workgroup, rounded down to a multiple of the number of drones.
    pub fn set_workgroup(&mut self, threads: u32) -> Result<(), GpuError> {
        let hardware = &self.device.client().properties().hardware;
        let max = hardware.max_units_per_cube.min(hardware.max_cube_dim.0);
        let expected = "a positive number up to the limit of the device";
        let drones = self.plan.drones;
        if drones > max {
            return Err(GpuError::NotPorted { option: "num_drones", got: drones.to_string(), expected });
        }
        if threads < drones || threads > max {
            return Err(GpuError::NotPorted { option: "workgroup", got: threads.to_string(), expected });
        }
        self.workgroup = threads / drones * drones;
        let bytes = self.exchanged() * self.precision.bytes();
        self.exchange = self.device.client().create(Bytes::from_elems(vec![0_u8; bytes]));
        Ok(())
    }

    /// Returns the number of drones in all environments.
    pub fn drones(&self) -> usize {
        self.environments * self.plan.drones as usize
    }

    /// Returns the bytes of an environment.
    pub fn bytes_per_env(plan: &Plan, precision: Precision, keeps_last: bool) -> usize {
        let observations = plan.observation_size() * if keeps_last { 2 } else { 1 };
        let single = observations + Memory::<f64>::WORDS;
        let exchanged = if plan.drones > 1 { Group::ROWS } else { 0 };
        let numbers = count_numbers(plan) + plan.action_size() + exchanged;
        let drone = numbers * precision.bytes() + single * size_of::<f32>();
        plan.drones as usize * drone + size_of::<f32>() + size_of::<u32>()
    }

    /// Returns the bytes that a step of an environment reads and writes, without the exchange between drones.
    pub fn bytes_per_step(plan: &Plan, precision: Precision, keeps_last: bool) -> usize {
        let observations = plan.observation_size() * if keeps_last { 2 } else { 1 };
        let single = observations + 2 * Memory::<f64>::WORDS;
        let drone = (2 * count_numbers(plan) + plan.action_size()) * precision.bytes() + single * size_of::<f32>();
        plan.drones as usize * drone + size_of::<f32>() + size_of::<u32>()
    }

    /// Returns the largest number of entries, and the largest number of bytes, that one buffer needs for an
    /// environment.
    pub fn largest_rows(plan: &Plan, precision: Precision) -> [usize; 2] {
        let exchanged = if plan.drones > 1 { Group::ROWS } else { 0 };
        let in_precision = count_numbers(plan).max(plan.action_size()).max(exchanged);
        let single = plan.observation_size().max(Memory::<f64>::WORDS);
        let bytes = (in_precision * precision.bytes()).max(single * size_of::<f32>());
        [in_precision.max(single), bytes].map(|drone| plan.drones as usize * drone)
    }

    /// Copies actions to the device.
    pub fn set_actions(&mut self, actions: &[f64]) {
        /// Magnitude beyond all bounds of actions, and within single precision.
        const MAX: f64 = 1e30;
        // infinities are faults, and clamp keeps NaN
        let limited = |&x: &f64| if x.is_infinite() { x } else { x.clamp(-MAX, MAX) };
        self.actions = upload(&self.device, self.precision, actions.iter().map(limited));
    }

    /// Replaces the buffers of the results of steps and resets, so that those of earlier steps keep their values.
    #[cfg(feature = "burn")]
    pub fn renew_outputs(&mut self) {
        let client = self.device.client();
        let rows = self.drones() * self.plan.observation_size() * size_of::<f32>();
        self.observations = client.empty(rows);
        if self.keeps_last {
            self.last_observations = client.empty(rows);
        }
        self.rewards = client.empty(self.environments * size_of::<f32>());
        self.ends = client.empty(self.environments * size_of::<u32>());
    }

    /// Copies buffers to the host.
    pub fn read<const N: usize>(&self, handles: [&Handle; N]) -> Result<Vec<Bytes>, GpuError> {
        self.device.client().read(handles.map(Handle::clone).to_vec()).map_err(|error| GpuError::device(&error))
    }

    /// Copies the numbers of all drones to the host.
    pub fn download_numbers(&self) -> Result<Vec<f64>, GpuError> {
        self.download(&self.numbers)
    }

    /// Copies the actions of the last step to the host.
    pub fn download_actions(&self) -> Result<Vec<f64>, GpuError> {
        self.download(&self.actions)
    }

    /// Copies a buffer in the precision of the batch to the host.
    fn download(&self, handle: &Handle) -> Result<Vec<f64>, GpuError> {
        let bytes = self.read([handle])?;
        Ok(match self.precision {
            Precision::Single => f32::from_bytes(&bytes[0]).iter().map(|&x| f64::from(x)).collect(),
            Precision::Double => f64::from_bytes(&bytes[0]).to_vec(),
        })
    }

    /// Copies the control steps of the present episode and the end of the last step of every environment to the host.
    pub fn download_progress(&self) -> Result<Vec<[u32; 2]>, GpuError> {
        let (bytes, count, drones) = (self.read([&self.words])?, self.drones(), self.plan.drones as usize);
        let words = u32::from_bytes(&bytes[0]);
        // the order of `Memory::words`
        let at = |row: usize, environment: usize| words[row * count + environment * drones];
        Ok((0..self.environments).map(|environment| [at(3, environment), at(4, environment)]).collect())
    }

    /// Waits until the device has computed everything.
    pub fn wait(&self) -> Result<(), GpuError> {
        cubecl::future::block_on(self.device.client().sync()).map_err(|error| GpuError::device(&error))
    }

    /// Returns the number of threads in all workgroups.
    fn threads(&self) -> usize {
        let (width, height) = self.groups();
        width * height * self.workgroup as usize
    }

    /// Returns the number of numbers that the drones of an environment exchange.
    fn exchanged(&self) -> usize {
        if self.plan.drones > 1 { Group::ROWS * self.threads() } else { 1 }
    }

    /// Returns the width and the height of the grid of workgroups.
    fn groups(&self) -> (usize, usize) {
        let [width, height] = self.device.grid(self.drones().div_ceil(self.workgroup as usize));
        (width as usize, height as usize)
    }

    /// Returns the grid of workgroups with a thread per drone.
    fn grid(&self) -> (CubeCount, CubeDim) {
        let (width, height) = self.groups();
        (CubeCount::Static(width as u32, height as u32, 1), CubeDim::new_1d(self.workgroup))
    }

    /// Advances every environment by one control step with the present actions.
    pub fn step(&self) {
        match self.precision {
            Precision::Single => self.step_in::<f32>(),
            Precision::Double => self.step_in::<f64>(),
        }
    }

    #[allow(unsafe_code)]
    fn step_in<F: Float + CubeElement>(&self) {
        let (count, (grid, group)) = (self.drones(), self.grid());
        let observations = count * self.plan.observation_size();
        // SAFETY: every buffer has the length that is passed with it, `new` and `set_workgroup` have allocated them,
        // and no entry that the kernel accesses is outside. The threads beyond the last drone read the entries of the
        // last one, maybe while its thread stores them, and have entries of their own in the exchange alone; nothing
        // reads their results
        unsafe {
            step_kernel::launch_unchecked::<F>(
                self.device.client(),
                grid,
                group,
                BufferArg::from_raw_parts(self.numbers.clone(), count * count_numbers(&self.plan)),
                BufferArg::from_raw_parts(self.words.clone(), count * Memory::<f64>::WORDS),
                BufferArg::from_raw_parts(self.actions.clone(), count * self.plan.action_size()),
                BufferArg::from_raw_parts(self.parameters.clone(), self.plan.drones as usize * Parameters::COUNT),
                BufferArg::from_raw_parts(self.observations.clone(), observations),
                BufferArg::from_raw_parts(
                    self.last_observations.clone(),
                    if self.keeps_last { observations } else { 1 },
                ),
                BufferArg::from_raw_parts(self.rewards.clone(), self.environments),
                BufferArg::from_raw_parts(self.ends.clone(), self.environments),
                BufferArg::from_raw_parts(self.exchange.clone(), self.exchanged()),
                count as u32,
                self.threads() as u32,
                self.plan.clone(),
                self.keeps_last,
            );
        }
    }

    /// Starts an episode in some environments; `selection` is that of the kernel.
    pub fn reset(&self, selection: &[u32]) {
        let selection = self.device.client().create_from_slice(u32::as_bytes(selection));
        match self.precision {
            Precision::Single => self.reset_in::<f32>(selection),
            Precision::Double => self.reset_in::<f64>(selection),
        }
    }

    #[allow(unsafe_code)]
    fn reset_in<F: Float + CubeElement>(&self, selection: Handle) {
        let (count, (grid, group)) = (self.drones(), self.grid());
        // SAFETY: as in `step_in`; `selection` has three rows of an entry per environment, and threads from `count` on
        // do nothing
        unsafe {
            reset_kernel::launch_unchecked::<F>(
                self.device.client(),
                grid,
                group,
                BufferArg::from_raw_parts(self.numbers.clone(), count * count_numbers(&self.plan)),
                BufferArg::from_raw_parts(self.words.clone(), count * Memory::<f64>::WORDS),
                BufferArg::from_raw_parts(self.parameters.clone(), self.plan.drones as usize * Parameters::COUNT),
                BufferArg::from_raw_parts(selection, 3 * self.environments),
                BufferArg::from_raw_parts(self.observations.clone(), count * self.plan.observation_size()),
                count as u32,
                self.plan.clone(),
                self.plan.drones,
            );
        }
    }
}

/// Measures the memory bandwidth of copies within a device, bytes per second, reads and writes together.
///
/// # Errors
/// [`GpuError::Device`] if the device fails.
#[allow(unsafe_code)]
pub fn bandwidth(device: &GpuDevice) -> Result<f64, GpuError> {
    /// Number of numbers of a buffer.
    const SIZE: usize = 1 << 24;
    const GROUP: u32 = 256;
    /// Workgroups along x; devices allow 65,535 along each axis.
    const WIDTH: u32 = 256;
    let client = device.client();
    let zeros = || client.create(Bytes::from_elems(vec![0_u8; SIZE * size_of::<f32>()]));
    let (from, to) = (zeros(), zeros());
    let copy = || {
        // SAFETY: both buffers have SIZE entries, and the kernel has a thread per entry
        unsafe {
            copy_kernel::launch_unchecked(
                client,
                CubeCount::Static(WIDTH, SIZE as u32 / GROUP / WIDTH, 1),
                CubeDim::new_1d(GROUP),
                BufferArg::from_raw_parts(from.clone(), SIZE),
                BufferArg::from_raw_parts(to.clone(), SIZE),
            );
        }
    };
    let wait = || cubecl::future::block_on(client.sync()).map_err(|error| GpuError::device(&error));
    // the first launch compiles the kernel
    copy();
    wait()?;
    let mut copies = 1_u32;
    loop {
        let start = Instant::now();
        (0..copies).for_each(|_| copy());
        wait()?;
        let seconds = start.elapsed().as_secs_f64();
        if seconds > 0.2 {
            return Ok(f64::from(copies) * (2 * SIZE * size_of::<f32>()) as f64 / seconds);
        }
        copies *= 2;
    }
}

/// Copies numbers to the device.
pub(crate) fn upload(device: &GpuDevice, precision: Precision, numbers: impl Iterator<Item = f64>) -> Handle {
    let bytes = match precision {
        Precision::Single => Bytes::from_elems(numbers.map(|x| x as f32).collect::<Vec<f32>>()),
        Precision::Double => Bytes::from_elems(numbers.collect::<Vec<f64>>()),
    };
    device.client().create(bytes)
}
