//! Starts of episodes that a kernel selects, for the learner.

use aviary::env::InitialRanges;
use cubecl::prelude::*;
use cubecl::server::Handle;

use super::DeviceBatch;
use crate::environment::{Memory, count_numbers};
use crate::kernel::begin::{RANGE, begin_kernel};
use crate::parameters::Parameters;

impl DeviceBatch {
    /// Starts an episode in every environment that `selection` selects; it is that of
    /// [`reset`](DeviceBatch::reset), on the device. `ranges` is a buffer of [`ranges_of`], for initial states around
    /// those of the batch. The batch is in single precision.
    #[allow(unsafe_code)]
    pub fn begin(&self, selection: &Handle, ranges: Option<&Handle>) {
        let (count, (grid, group)) = (self.drones(), self.grid());
        let (ranges, ranged, length) = match ranges {
            Some(ranges) => (ranges.clone(), true, RANGE * self.environments),
            // a buffer that the kernel does not read
            None => (self.rewards.clone(), false, self.environments),
        };
        // SAFETY: as in `reset_in`; `ranges` has six rows of an entry per environment
        unsafe {
            begin_kernel::launch_unchecked(
                self.device.client(),
                grid,
                group,
                BufferArg::from_raw_parts(self.numbers.clone(), count * count_numbers(&self.plan)),
                BufferArg::from_raw_parts(self.words.clone(), count * Memory::<f64>::WORDS),
                BufferArg::from_raw_parts(self.parameters.clone(), self.plan.drones as usize * Parameters::COUNT),
                BufferArg::from_raw_parts(selection.clone(), 3 * self.environments),
                BufferArg::from_raw_parts(ranges, length),
                BufferArg::from_raw_parts(self.observations.clone(), count * self.plan.observation_size()),
                count as u32,
                self.plan.clone(),
                self.plan.drones,
                ranged,
            );
        }
    }
}

/// Returns the ranges of the initial states of a number of environments, to which `ranges` are assigned cyclically.
pub(crate) fn ranges_of(ranges: &[InitialRanges], environments: usize) -> Vec<f32> {
    let mut numbers = vec![0.0; RANGE * environments];
    for (environment, range) in (0..environments).zip(ranges.iter().cycle()) {
        let InitialRanges { position, attitude, velocity, offset: [x, y, z] } = *range;
        for (row, number) in [position, attitude, velocity, x, y, z].into_iter().enumerate() {
            numbers[row * environments + environment] = number as f32;
        }
    }
    numbers
}
