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
mod machine;
mod network;
mod noise;
mod rollout;
mod state;
mod statistics;

use std::time::{Duration, Instant};

use aviary::env::{BoxSpace, EnvConfig, EnvError, InitialRanges, Randomization, Rng};
use aviary::tasks::Course;
use aviary::vector::{Autoreset, OnFault, VecConfig, VecEnv as _};
use cubecl::prelude::*;
use cubecl::server::Handle;
use cubecl_environment::stream::StreamId;
use learn::{
    Clock, Learner, LearnerState, NetworkShape, PpoConfig, Report, Terms, TrainConfig, TrainDevice, TrainError,
};
use rand::{RngExt as _, SeedableRng as _};

use self::machine::{Buffer, Experience, Machine, Minibatch, check_size, launch, rows_at_a_time, words};
use self::rollout::{SUMS, act_kernel, bootstrap_kernel, settle_kernel, value_kernel};
use self::statistics::{MOMENTS, REPORT, report_kernel, scale_kernel};
use crate::batch::{GpuAviary, Precision};
use crate::device::GpuDevice;
use crate::error::GpuError;
use crate::launch::begin::ranges_of;

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
    /// Numbers of samples in the statistics of observations and of rewards.
    seen: [f64; 2],
    /// Number of steps of Adam.
    time: usize,
    rate: f64,
    clock: Clock,
    /// True if the next rollout waits for the device after every kernel, to measure its parts.
    measures: bool,
    /// True after the first rollout, which compiles the kernels.
    compiled: bool,
    /// Share of inference in the wall time of a measured rollout.
    inference: f64,
}

impl GpuPpo {
    /// Creates environments, networks and optimizer for a configuration.
    ///
    /// # Errors
    /// - [`GpuError::NotPorted`] for a task or an option that the kernels do not have.
    /// - The errors of [`GpuAviary::make`].
    /// - [`GpuError::TooLarge`] if the samples of a rollout exceed the buffers of the device.
    /// - [`GpuError::Env`] for an invalid configuration, or an airframe that does not exist.
    pub fn new(config: &TrainConfig, device: &GpuDevice) -> Result<Self, GpuError> {
        let stream = StreamId::allocate();
        stream.executes(|| Self::on_stream(config, device, stream))
    }

    fn on_stream(config: &TrainConfig, device: &GpuDevice, stream: StreamId) -> Result<Self, GpuError> {
        let not_ported = |option, got: &str, expected| GpuError::NotPorted { option, got: got.into(), expected };
        config.validate().map_err(env_error)?;
        if config.device != TrainDevice::Gpu {
            return Err(not_ported("device", &config.device.to_string(), "gpu"));
        }
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
        env.check_starts(&ranges)?;
        let shape = NetworkShape::new(observations.size(), actions.size(), &ppo.hidden, ppo.activation);
        check_size(device, &shape, rows, &ppo)?;
        let machine = Machine::new(device, &shape, rows_at_a_time(rows, &ppo));
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
            seen: [0.0; 2],
            time: 0,
            rate: ppo.learning_rate,
            clock: Clock::default(),
            measures: false,
            compiled: false,
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
        let measured = self.compiled && std::mem::take(&mut self.measures);
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
        self.compiled = true;
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
        let samples = self.experience.samples() as f64;
        self.seen = self.seen.map(|seen| seen + samples);
        let [observations, rewards] = self.seen.map(|seen| (samples / seen) as f32);
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
            observations,
            rewards,
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
        self.measures = true;
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
    Ok((config.options().map_err(env_error)?, ranges))
}

/// Returns an error of a configuration as one of the environment.
fn env_error(error: TrainError) -> GpuError {
    match error {
        TrainError::Env(error) => GpuError::Env(error),
        TrainError::Option { option, got, expected } => GpuError::Env(EnvError::Option { option, got, expected }),
        error => GpuError::Env(EnvError::Device { message: error.to_string() }),
    }
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
        self.seen[0] > 0.0
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
