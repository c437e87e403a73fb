//! Kernels of a rollout. A thread computes a network for `per_thread` rows, or the rest for one row.

use aviary::env::EndReason;
use cubecl::prelude::*;
use learn::CLIP;

use super::network::{Columns, Networks, clamped, forward, read_observation};
use super::noise::normal;
use crate::environment::end;
use crate::plan::code_of;

/// Status of an episode after a step: it continues.
pub(super) const RUNNING: u32 = 0;
/// The task ended the episode.
pub(super) const TERMINATED: u32 = 1;
/// The episode was cut off.
pub(super) const TRUNCATED: u32 = 2;
/// The environment failed: training ignores the step.
pub(super) const ABSENT: u32 = 3;

/// Columns of the sums of a row: discounted sum of rewards, return of the current episode, sum of the returns and
/// number of the episodes that ended in the rollout, sum of the rewards of the rollout.
pub(super) const SUMS: usize = 5;

/// Acts in every row: the first half of the threads samples actions, the second half computes values.
///
/// `actions` has the actions in half widths of the action space and the log-probability of every step, and `commands`
/// the actions of the environments. `scale` has means and standard deviations of observations, the divisor of rewards,
/// and centre and half width of every entry of the action space.
#[cube(launch_unchecked)]
#[allow(clippy::too_many_arguments)] // the buffers of a kernel
pub(super) fn act_kernel(
    parameters: &[f32],
    scale: &[f32],
    seen: &[f32],
    scratch: &mut [f32],
    raw: &mut [f32],
    actions: &mut [f32],
    commands: &mut [f32],
    values: &mut [f32],
    step: u32,
    rows: u32,
    low: u32,
    high: u32,
    #[comptime] networks: Networks,
    #[comptime] per_thread: usize,
) {
    let rows = rows as usize;
    let threads = rows.div_ceil(per_thread);
    let (size, acts) = comptime!((networks.observation(), networks.action()));
    let start = step as usize * rows;
    if ABSOLUTE_POS < threads {
        let columns = Columns { first: ABSOLUTE_POS, stride: threads, width: threads * per_thread };
        let (inputs, outputs) = comptime!((networks.actor.values(0), networks.actor.values(networks.actor.layers())));
        for share in 0..per_thread {
            let row = ABSOLUTE_POS + share * threads;
            if row < rows {
                for entry in 0..size {
                    raw[(start + row) * size + entry] = seen[row * size + entry];
                }
                read_observation(seen, scale, scratch, row, row, columns.width, size, inputs);
            }
        }
        forward(parameters, scratch, &columns, comptime!(networks.actor.clone()), per_thread);
        let logs = comptime!(networks.log_deviations());
        let reach = comptime!(2 * size + 1);
        for share in 0..per_thread {
            let row = ABSOLUTE_POS + share * threads;
            if row < rows {
                let own = (start + row) * comptime!(acts + 1);
                let mut squares = 0.0f32;
                let mut spread = 0.0f32;
                for entry in 0..acts {
                    let z = normal(low, high, row as u32, step, entry as u32);
                    let log = parameters[logs + entry];
                    let x = scratch[(outputs + entry) * columns.width + row] + log.exp() * z;
                    squares += z * z;
                    spread += log + HALF_LOG_TAU;
                    actions[own + entry] = x;
                    commands[row * acts + entry] = scale[reach + entry] + scale[reach + acts + entry] * x;
                }
                actions[own + acts] = -(0.5 * squares + spread);
            }
        }
    } else if ABSOLUTE_POS < 2 * threads {
        let columns = Columns { first: ABSOLUTE_POS - threads, stride: threads, width: threads * per_thread };
        judge(parameters, scale, seen, scratch, values, start, rows, &columns, networks, per_thread);
    }
}

/// Computes the values of `per_thread` rows, and writes them from `start` on.
#[cube]
#[allow(clippy::too_many_arguments)]
fn judge(
    parameters: &[f32],
    scale: &[f32],
    seen: &[f32],
    scratch: &mut [f32],
    values: &mut [f32],
    start: usize,
    rows: usize,
    columns: &Columns,
    #[comptime] networks: Networks,
    #[comptime] per_thread: usize,
) {
    let size = comptime!(networks.observation());
    let (inputs, output) = comptime!((networks.critic.values(0), networks.critic.values(networks.critic.layers())));
    for share in 0..per_thread {
        let row = columns.first + share * columns.stride;
        if row < rows {
            read_observation(seen, scale, scratch, row, row, columns.width, size, inputs);
        }
    }
    forward(parameters, scratch, columns, comptime!(networks.critic.clone()), per_thread);
    for share in 0..per_thread {
        let row = columns.first + share * columns.stride;
        if row < rows {
            values[start + row] = scratch[output * columns.width + row];
        }
    }
}

/// Half of the logarithm of 2π.
pub(super) const HALF_LOG_TAU: f32 = 0.918_938_5;

/// Notes rewards and ends of a step in every row, and selects the environments that begin an episode: those whose
/// episode reached the length of its row, and with `all` those whose episode has ended.
///
/// `rewards` has scaled reward and discounted sum of every step, and `counters` age and length of the current episode
/// and the largest length of every row, control steps.
#[cube(launch_unchecked)]
#[allow(clippy::too_many_arguments)]
pub(super) fn settle_kernel(
    ends: &[u32],
    step_rewards: &[f32],
    scale: &[f32],
    next: &mut [u32],
    rewards: &mut [f32],
    sums: &mut [f32],
    counters: &mut [u32],
    selection: &mut [u32],
    step: u32,
    rows: u32,
    gamma: f32,
    penalty: f32,
    #[comptime] divisor: usize,
    #[comptime] all: bool,
) {
    let rows = rows as usize;
    if ABSOLUTE_POS < rows {
        let row = ABSOLUTE_POS;
        let sample = step as usize * rows + row;
        let (fault, bounds) = comptime!((code_of(EndReason::Fault), code_of(EndReason::OutOfBounds)));
        let ended = ends[row];
        let reason = ended & end::REASON;
        let reward = step_rewards[row] - select(reason == bounds, penalty, 0.0);
        let age = counters[row] + 1;
        let is_old = age >= counters[rows + row];
        let mut status = select(is_old, TRUNCATED, RUNNING);
        if ended > 0 {
            status = select(ended & end::TERMINATED > 0, TERMINATED, TRUNCATED);
            status = select(reason == fault, ABSENT, status);
        }
        next[sample] = status;
        let is_over = status != RUNNING;
        let begins = if comptime!(all) { is_over } else { is_over && ended == 0 };
        selection[row] = select(begins, 1u32, 0u32);
        counters[row] = select(is_over, 0u32, age);
        if is_over {
            counters[rows + row] = counters[2 * rows + row];
        }
        let first = row * SUMS;
        let discounted = gamma * sums[first] + reward;
        let whole = sums[first + 1] + reward;
        rewards[2 * sample] = clamped(reward / scale[divisor], CLIP);
        rewards[2 * sample + 1] = discounted;
        sums[first] = select(is_over, 0.0, discounted);
        sums[first + 1] = select(is_over, 0.0, whole);
        let counts = is_over && status != ABSENT;
        let is_first = step == 0;
        let (returns, episodes, total) = (sums[first + 2], sums[first + 3], sums[first + 4]);
        sums[first + 2] = select(is_first, 0.0, returns) + select(counts, whole, 0.0);
        sums[first + 3] = select(is_first, 0.0, episodes) + select(counts, 1.0, 0.0);
        sums[first + 4] = select(is_first, 0.0, total) + reward;
    }
}

/// Computes the value of the last observation of every episode that was truncated in a step. It is in `observations`
/// where the learner truncated the episode, and in `last_observations` where the environment did.
#[cube(launch_unchecked)]
#[allow(clippy::too_many_arguments)]
pub(super) fn bootstrap_kernel(
    parameters: &[f32],
    scale: &[f32],
    ends: &[u32],
    next: &[u32],
    observations: &[f32],
    last_observations: &[f32],
    scratch: &mut [f32],
    next_values: &mut [f32],
    step: u32,
    rows: u32,
    #[comptime] networks: Networks,
) {
    let rows = rows as usize;
    if ABSOLUTE_POS < rows {
        let row = ABSOLUTE_POS;
        let sample = step as usize * rows + row;
        if next[sample] == TRUNCATED {
            let size = comptime!(networks.observation());
            let (inputs, output) =
                comptime!((networks.critic.values(0), networks.critic.values(networks.critic.layers())));
            if ends[row] > 0 {
                read_observation(last_observations, scale, scratch, row, row, rows, size, inputs);
            } else {
                read_observation(observations, scale, scratch, row, row, rows, size, inputs);
            }
            let columns = Columns { first: row, stride: rows, width: rows };
            forward(parameters, scratch, &columns, comptime!(networks.critic.clone()), 1usize);
            next_values[sample] = scratch[output * rows + row];
        }
    }
}

/// Computes the values after the last step of the rollout.
#[cube(launch_unchecked)]
#[allow(clippy::too_many_arguments)]
pub(super) fn value_kernel(
    parameters: &[f32],
    scale: &[f32],
    seen: &[f32],
    scratch: &mut [f32],
    values: &mut [f32],
    step: u32,
    rows: u32,
    #[comptime] networks: Networks,
    #[comptime] per_thread: usize,
) {
    let rows = rows as usize;
    let threads = rows.div_ceil(per_thread);
    if ABSOLUTE_POS < threads {
        let columns = Columns { first: ABSOLUTE_POS, stride: threads, width: threads * per_thread };
        judge(parameters, scale, seen, scratch, values, step as usize * rows, rows, &columns, networks, per_thread);
    }
}

/// Computes generalized advantage estimates (GAE; Schulman et al. 2016, eq. 16) and returns of every row: a = δ +
/// γ·λ·a', δ = r + γ·V' − V. V' is 0 after a termination and the critic's estimate after a truncation. Neither
/// propagates advantages of the next episode.
///
/// `values` has the values of all steps and after the last one, and `next_values` those after truncations. `targets`
/// has advantage, return and weight of every sample; the weight is 0 where the environment failed.
#[cube(launch_unchecked)]
#[allow(clippy::too_many_arguments)]
pub(super) fn advantage_kernel(
    rewards: &[f32],
    values: &[f32],
    next_values: &[f32],
    next: &[u32],
    targets: &mut [f32],
    steps: u32,
    rows: u32,
    gamma: f32,
    lambda: f32,
) {
    let rows = rows as usize;
    if ABSOLUTE_POS < rows {
        let row = ABSOLUTE_POS;
        let mut advantage = 0.0f32;
        for back in 1..steps as usize + 1 {
            let sample = (steps as usize - back) * rows + row;
            let (status, reward, value) = (next[sample], rewards[2 * sample], values[sample]);
            let after = select(status == TRUNCATED, next_values[sample], values[sample + rows]);
            let future = after + select(status == RUNNING, lambda * advantage, 0.0);
            let gain = reward + select(status == TERMINATED, 0.0, gamma * future) - value;
            advantage = select(status == ABSENT, 0.0, gain);
            targets[3 * sample] = advantage;
            targets[3 * sample + 1] = advantage + value;
            targets[3 * sample + 2] = select(status == ABSENT, 0.0, 1.0);
        }
    }
}
