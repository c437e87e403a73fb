//! Means and variances over the rows of a matrix, in two steps: [`CHUNKS`] threads per column each take every
//! [`CHUNKS`]-th row, and one thread per column merges their results in a fixed order. Equal inputs therefore give
//! equal bits on a device.

use cubecl::prelude::*;

use super::gradient::{DIVERGED, LANES, RATE};

/// Number of threads per column.
pub(super) const CHUNKS: usize = 256;

/// Numbers of the moments of a column: number of rows, mean, sum of the squared distances from the mean.
pub(super) const MOMENTS: usize = 3;

/// Computes the moments of the columns of a chunk of rows (Welford 1962). `weights` is the column that is 0 in rows
/// that do not count.
#[cube(launch_unchecked)]
pub(super) fn chunk_kernel(
    matrix: &[f32],
    partial: &mut [f32],
    rows: u32,
    #[comptime] columns: usize,
    #[comptime] weights: Option<usize>,
) {
    if ABSOLUTE_POS < CHUNKS * columns {
        let (chunk, column) = (ABSOLUTE_POS / columns, ABSOLUTE_POS % columns);
        let mut count = 0.0f32;
        let mut mean = 0.0f32;
        let mut squares = 0.0f32;
        for round in 0..(rows as usize).div_ceil(CHUNKS) {
            let row = round * CHUNKS + chunk;
            if row < rows as usize {
                let mut weight = 1.0f32;
                if comptime!(weights.is_some()) {
                    weight = matrix[row * columns + comptime!(weights.unwrap_or(0))];
                }
                if weight > 0.0 {
                    let x = matrix[row * columns + column];
                    let apart = x - mean;
                    count += 1.0;
                    mean += apart / count;
                    squares += apart * (x - mean);
                }
            }
        }
        partial[ABSOLUTE_POS * MOMENTS] = count;
        partial[ABSOLUTE_POS * MOMENTS + 1] = mean;
        partial[ABSOLUTE_POS * MOMENTS + 2] = squares;
    }
}

/// Merges the moments of the chunks of every column (Chan, Golub & LeVeque 1983).
#[cube(launch_unchecked)]
pub(super) fn merge_kernel(partial: &[f32], moments: &mut [f32], #[comptime] columns: usize) {
    if ABSOLUTE_POS < columns {
        let column = ABSOLUTE_POS;
        let mut count = 0.0f32;
        let mut mean = 0.0f32;
        let mut squares = 0.0f32;
        for chunk in 0..CHUNKS {
            let first = (chunk * columns + column) * MOMENTS;
            let (other, other_mean, other_squares) = (partial[first], partial[first + 1], partial[first + 2]);
            if other > 0.0 {
                let total = count + other;
                let share = other / total;
                let apart = other_mean - mean;
                mean += apart * share;
                squares += other_squares + apart * apart * count * share;
                count = total;
            }
        }
        moments[column * MOMENTS] = count;
        moments[column * MOMENTS + 1] = mean;
        moments[column * MOMENTS + 2] = squares;
    }
}

/// Adds the moments of a rollout to the running statistics, and sets the scale of observations and rewards. One thread
/// per entry of an observation, and one for the rewards.
///
/// `running` has the means of the observations and of the discounted sums of rewards, and then their variances.
/// The shares are those of the rollout in all observations and in all rewards.
#[cube(launch_unchecked)]
#[allow(clippy::too_many_arguments)] // the buffers of a kernel
pub(super) fn scale_kernel(
    observations: &[f32],
    rewards: &[f32],
    running: &mut [f32],
    scale: &mut [f32],
    share_of_observations: f32,
    share_of_rewards: f32,
    #[comptime] size: usize,
) {
    if ABSOLUTE_POS < size {
        let entry = ABSOLUTE_POS;
        let first = entry * MOMENTS;
        let (count, mean, squares) = (observations[first], observations[first + 1], observations[first + 2]);
        add_moments(running, entry, count, mean, squares, share_of_observations, size);
    } else if ABSOLUTE_POS == size {
        // the discounted sums are the second column
        let first = comptime!(MOMENTS);
        let (count, mean, squares) = (rewards[first], rewards[first + 1], rewards[first + 2]);
        add_moments(running, ABSOLUTE_POS, count, mean, squares, share_of_rewards, size);
    }
    if ABSOLUTE_POS <= size {
        set_scale(running, scale, ABSOLUTE_POS, size);
    }
}

/// Sets the scale of observations and rewards from the running statistics, as [`scale_kernel`].
#[cube(launch_unchecked)]
pub(super) fn rescale_kernel(running: &mut [f32], scale: &mut [f32], #[comptime] size: usize) {
    if ABSOLUTE_POS <= size {
        set_scale(running, scale, ABSOLUTE_POS, size);
    }
}

#[cube]
fn add_moments(
    running: &mut [f32],
    entry: usize,
    count: f32,
    mean: f32,
    squares: f32,
    share: f32,
    #[comptime] size: usize,
) {
    let before = running[entry];
    let variance_before = running[size + 1 + entry];
    let apart = mean - before;
    let variance = squares / count;
    running[entry] = before + apart * share;
    running[size + 1 + entry] =
        variance_before + (variance - variance_before) * share + apart * apart * share * (1.0 - share);
}

#[cube]
fn set_scale(running: &mut [f32], scale: &mut [f32], entry: usize, #[comptime] size: usize) {
    let deviation = running[size + 1 + entry].sqrt();
    if entry < size {
        scale[entry] = running[entry];
        scale[size + entry] = select(deviation > 1e-2, deviation, 1e-2);
    } else {
        scale[2 * size] = select(deviation > 1e-4, deviation, 1e-4);
    }
}

/// Entries of a report: number and sum of the returns, sum of the rewards, sums of the loss over the minibatches, and
/// of the approximate KL divergence and of clipped ratios over the samples, mean of the standard deviations of the
/// actions, variances of returns and advantages, learning rate, and 1 if a gradient was not finite.
pub(super) const REPORT: usize = 11;

/// Writes the report of an iteration and adapts the learning rate; one thread.
///
/// `sums` and `targets` are moments of the columns of the sums of the rows and of the targets.
#[cube(launch_unchecked)]
#[allow(clippy::too_many_arguments)] // the buffers of a kernel
pub(super) fn report_kernel(
    sums: &[f32],
    targets: &[f32],
    tally: &[f32],
    parameters: &[f32],
    control: &mut [f32],
    report: &mut [f32],
    samples: f32,
    target_kl: f32,
    max_rate: f32,
    #[comptime] log_deviations: usize,
    #[comptime] acts: usize,
) {
    if ABSOLUTE_POS == 0 {
        let rows = sums[0];
        report[0] = rows * sums[3 * MOMENTS + 1];
        report[1] = rows * sums[2 * MOMENTS + 1];
        report[2] = rows * sums[4 * MOMENTS + 1];
        let mut loss = 0.0f32;
        let mut kl = 0.0f32;
        let mut clipped = 0.0f32;
        for lane in 0..LANES {
            loss += tally[LANES + lane];
            kl += tally[2 * LANES + lane];
            clipped += tally[3 * LANES + lane];
        }
        report[3] = loss;
        report[4] = kl;
        report[5] = clipped;
        let mut deviation = 0.0f32;
        for entry in 0..acts {
            deviation += parameters[log_deviations + entry].exp();
        }
        report[6] = deviation / acts as f32;
        let count = targets[0];
        report[7] = targets[MOMENTS + 2] / count;
        report[8] = targets[2] / count;
        // lower if the KL divergence exceeds twice the target, higher, up to the maximum, below the target
        let rate = control[RATE];
        let mean = kl / samples;
        let mut adapted = rate;
        if target_kl > 0.0 {
            if mean > 2.0 * target_kl {
                let lower = rate / 1.5;
                adapted = select(lower > 0.01 * max_rate, lower, 0.01 * max_rate);
            } else if mean < target_kl {
                let higher = rate * 1.1;
                adapted = select(higher < max_rate, higher, max_rate);
            }
        }
        control[RATE] = adapted;
        report[9] = adapted;
        report[10] = control[DIVERGED];
    }
}
