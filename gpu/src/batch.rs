//! Batch of environments on a GPU, with host buffers.

#[cfg(feature = "burn")]
mod tensors;

use std::sync::OnceLock;

use aviary::action::MotorScale;
use aviary::engine::Substeps;
use aviary::env::{
    Aviary, AviaryBuilder, BoxSpace, DroneEnv, EndReason, Env as _, EnvConfig, EnvError, EpisodeSummary, Info,
    ObservationSpace,
};
use aviary::observation::{KIN_SIZE, Observation, kinematic};
use aviary::physics::battery::BatteryState;
use aviary::state::{DroneState, attitude_from_wxyz};
use aviary::tasks::{Antipodal, FlyThrough, Formation, Hover, MultiHover, Race, Stabilize, Track, Velocity};
use aviary::vector::{Autoreset, OnFault, VecConfig, VecEnv, VecImages, VecStep};
use cubecl::prelude::*;

#[cfg(feature = "learn")]
use aviary::env::{InitialRanges, Randomization};

use crate::device::GpuDevice;
use crate::environment::{COMMAND, end};
use crate::error::GpuError;
use crate::launch::DeviceBatch;
use crate::parameters::Parameters;
#[cfg(feature = "learn")]
use crate::plan::check_starts;
use crate::plan::{Decoding, Plan, describe, reason_of};
use crate::tasks::GpuTask;
#[cfg(feature = "burn")]
pub use tensors::DeviceStep;

/// Precision of the numbers of a batch.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Precision {
    /// Single precision, on every adapter.
    #[default]
    Single,
    /// Double precision, on adapters that have it. On most GPUs it is many times slower.
    Double,
}

impl Precision {
    /// Returns the size of a number, bytes.
    pub(crate) fn bytes(self) -> usize {
        match self {
            Self::Single => size_of::<f32>(),
            Self::Double => size_of::<f64>(),
        }
    }
}

/// Episode of an environment, as the host knows it.
#[derive(Debug, Clone, Copy, Default)]
struct Progress {
    started: bool,
    /// The episode has ended, and the next one has not started.
    over: bool,
    /// Sum of the rewards.
    reward: f64,
    /// Control steps.
    steps: u64,
    /// True if the motors have had a command since the start of the episode.
    commanded: bool,
}

/// A batch of M environments of one task on a GPU.
///
/// One kernel per control step decodes the actions, computes the physics steps, evaluates the task and starts the next
/// episode where one has ended. The state of the environments stays in the memory of the GPU. Functions of [`VecEnv`]
/// copy actions to the device, and observations, rewards and ends back.
///
/// The kernel is built from the equations of the CPU's flight kernel. In double precision a flight differs from that
/// of [`VecAviary`](aviary::vector::VecAviary) by rounding. Random numbers are functions of the seed, the index of the
/// environment and the number of its episode, and differ from those of the CPU.
///
/// The kernels have the tasks of [`GpuTask`], the action types except `duty`, every effect, both kinds of forcing, the
/// medium, lag, latency, gains and saturation of motors, wind, and [`Randomization`](aviary::env::Randomization). They
/// detect contacts, which end the episode, and compute no contact forces, except for a drone that starts on the floor:
/// its lowest point has inelastic impacts with friction. Other options are errors of [`GpuAviary::new`].
/// [`VecConfig::threads`] and [`VecConfig::width`] have no effect.
///
/// ```
/// use aviary::env::EnvConfig;
/// use aviary::vector::{VecBuffers, VecConfig, VecEnv};
/// use aviary_gpu::{GpuAviary, GpuDevice, GpuError, Precision};
///
/// let device = match GpuDevice::open(None) {
///     Err(GpuError::NoAdapter { .. }) => return Ok(()), // no GPU on this machine
///     device => device?,
/// };
/// let (options, config) = (EnvConfig::default(), VecConfig::new(1000));
/// let mut env = GpuAviary::make("hover", options, config, &device, Precision::Single)?;
/// let mut buffers = VecBuffers::new(&env);
/// env.reset(Some(1), &mut buffers.observations)?;
/// env.step(&[0.0; 4000], buffers.step())?;
/// assert!(buffers.rewards.iter().all(|reward| (reward + 0.9).abs() < 1e-3), "at rest, 0.9 m below the target");
/// # Ok::<(), GpuError>(())
/// ```
#[derive(Debug)]
pub struct GpuAviary {
    name: &'static str,
    config: VecConfig,
    batch: DeviceBatch,
    /// Nominal parameters of each drone of an environment.
    nominal: Vec<Parameters>,
    observation_space: ObservationSpace,
    action_space: BoxSpace,
    /// Scale of the normalized motor speeds of each drone.
    scales: Vec<MotorScale>,
    control_period: f64,
    progress: Vec<Progress>,
    /// Summaries of the episodes that ended in the last step.
    summaries: Vec<Option<EpisodeSummary>>,
    finals: Vec<f32>,
    /// Last observations that the host has, if the batch keeps them.
    kept: Vec<f32>,
    faults: Vec<(usize, EnvError)>,
    /// Actions of the last step.
    actions: Vec<f64>,
    /// Number of control steps of the batch.
    control_steps: u64,
    /// True if the device has advanced without the host since [`GpuAviary::progress`] was current.
    ahead: bool,
    /// Contents of the device, once a caller has asked for the state of a drone since the last step or reset.
    downloaded: OnceLock<Downloaded>,
}

/// Contents of the memory of the device.
#[derive(Debug)]
struct Downloaded {
    /// Numbers of all drones.
    numbers: Vec<f64>,
    /// Actions of the last step, if the host does not have them.
    actions: Option<Vec<f64>>,
}

impl GpuAviary {
    /// Creates the environments. They must be [reset](VecEnv::reset) before the first step.
    ///
    /// # Errors
    /// - [`GpuError::NoEnvironments`] and [`GpuError::TooManyEnvironments`] for a number of environments that the
    ///   device cannot hold.
    /// - [`GpuError::NoDouble`] for double precision on a device without it.
    /// - [`GpuError::NotPorted`] for an option that the kernels do not have.
    /// - [`GpuError::Env`] for an invalid option, see [`AviaryBuilder::build`].
    /// - [`GpuError::Device`] if the device fails.
    pub fn new<T: GpuTask>(
        builder: AviaryBuilder<T>,
        config: VecConfig,
        device: &GpuDevice,
        precision: Precision,
    ) -> Result<Self, GpuError> {
        let count = config.environments;
        if count == 0 {
            return Err(GpuError::NoEnvironments);
        }
        if precision == Precision::Double && !device.adapter().double {
            return Err(GpuError::NoDouble { adapter: device.adapter().name.clone() });
        }
        let first: Aviary<T> = builder.build()?;
        let (plan, parameters) = describe(&first, config.autoreset, precision == Precision::Single)?;
        check_size(device, count, precision, &plan)?;
        let keeps_last = config.autoreset == Autoreset::SameStep;
        let batch = DeviceBatch::new(device, precision, plan, &parameters, count, keeps_last)?;
        let (observation_space, drones) = (first.observation_space().clone(), batch.drones());
        let kept = if config.keep_observations { count * observation_space.vector.size() } else { 0 };
        let finals = if keeps_last { drones * batch.plan.observation_size() } else { 0 };
        Ok(Self {
            name: first.name(),
            config,
            nominal: parameters,
            observation_space,
            action_space: first.action_space().clone(),
            scales: (0..first.simulation().num_drones()).map(|drone| *first.action_decoder(drone).scale()).collect(),
            control_period: first.simulation().control_period(),
            progress: vec![Progress::default(); count],
            summaries: vec![None; count],
            finals: vec![0.0; finals],
            kept: vec![0.0; kept],
            faults: Vec::new(),
            actions: vec![0.0; drones * batch.plan.action_size()],
            control_steps: 0,
            ahead: false,
            downloaded: OnceLock::new(),
            batch,
        })
    }

    /// Creates the environments of a task by name, like [`make_vec`](aviary::vector::make_vec). A program that calls
    /// [`new`](Self::new) instead compiles the environments of the task once more, which takes minutes.
    ///
    /// # Errors
    /// The errors of [`new`](Self::new). [`GpuError::NotPorted`] for a task that the kernels do not have.
    pub fn make(
        name: &str,
        options: EnvConfig,
        config: VecConfig,
        device: &GpuDevice,
        precision: Precision,
    ) -> Result<Self, GpuError> {
        macro_rules! by_name {
            ($($name:literal: $task:expr,)*) => {
                match name {
                    $($name => Self::new(options.for_task($task)?, config, device, precision),)*
                    other => {
                        let expected = concat!("one of", $(" ", $name),*);
                        Err(GpuError::NotPorted { option: "task", got: other.into(), expected })
                    }
                }
            };
        }
        by_name! {
            "antipodal": Antipodal::default(),
            "fly_through": FlyThrough::default(),
            "formation": Formation::default(),
            "hover": Hover::default(),
            "multi_agent": MultiHover::multi_agent(),
            "multi_hover": MultiHover::default(),
            "race": Race::default(),
            "stabilize": Stabilize::default(),
            "track": Track::default(),
            "velocity": Velocity::default(),
        }
    }

    /// Sets the number of threads in a workgroup; default 64. A workgroup has whole worlds, so that a multiple of the
    /// number of drones is used. The results do not depend on it.
    ///
    /// # Errors
    /// [`GpuError::NotPorted`] for a number that is below the number of drones or larger than the device allows.
    pub fn workgroup(mut self, threads: u32) -> Result<Self, GpuError> {
        self.batch.set_workgroup(threads)?;
        Ok(self)
    }

    /// Returns the batch on the device, for kernels of this crate. The host does not learn of steps and resets there.
    #[cfg(feature = "learn")]
    pub(crate) fn on_device(&self) -> &DeviceBatch {
        &self.batch
    }

    /// Returns the device.
    pub fn device(&self) -> &GpuDevice {
        &self.batch.device
    }

    /// Returns the precision.
    pub fn precision(&self) -> Precision {
        self.batch.precision
    }

    /// Returns the number of bytes that a control step of one environment reads and writes in the memory of the device,
    /// without the parameters that all environments share.
    pub fn bytes_per_step(&self) -> usize {
        DeviceBatch::bytes_per_step(&self.batch.plan, self.batch.precision, !self.finals.is_empty())
    }

    /// Returns the present states of all drones, environment by environment.
    ///
    /// # Errors
    /// [`GpuError::Device`] if the device fails.
    pub fn states(&self) -> Result<Vec<DroneState>, GpuError> {
        let (numbers, count) = (self.batch.download_numbers()?, self.batch.drones());
        Ok((0..count).map(|drone| state_of(|row| numbers[row * count + drone])).collect())
    }

    /// Advances every environment by several control steps with the actions of the last step, without copies between
    /// host and device, and waits for the device. For measurements: observations, rewards, ends and
    /// [`episode_summary`](VecEnv::episode_summary) of these steps stay on the device, and the sum of rewards of the
    /// present episodes begins again.
    ///
    /// # Errors
    /// [`GpuError::Env`] if an environment has not been reset, or with [`Autoreset::Disabled`], whose environments stop
    /// at the end of their episode. [`GpuError::Device`] if the device fails.
    pub fn repeat_on_device(&mut self, steps: u32) -> Result<(), GpuError> {
        self.check_runs_on_device()?;
        for _ in 0..steps {
            self.batch.step();
        }
        self.left_behind(steps);
        self.batch.wait()
    }

    /// Returns the error of a batch that cannot advance without the host.
    fn check_runs_on_device(&self) -> Result<(), EnvError> {
        if self.config.autoreset == Autoreset::Disabled {
            let (got, expected) = ("disabled".into(), "next_step or same_step");
            return Err(EnvError::Option { option: "autoreset", got, expected });
        }
        self.check_started()
    }

    /// Notes that the device has advanced by some steps without the host.
    fn left_behind(&mut self, steps: u32) {
        self.control_steps += u64::from(steps);
        self.downloaded = OnceLock::new();
        if !self.ahead {
            self.ahead = true;
            self.summaries.fill(None);
            self.faults.clear();
            self.progress.iter_mut().for_each(|progress| progress.commanded = true);
        }
    }

    /// Copies what the host has to know of the episodes, if the device has advanced without it.
    fn catch_up(&mut self) -> Result<(), GpuError> {
        if !self.ahead {
            return Ok(());
        }
        // episodes may have ended and started
        let next_step = self.config.autoreset == Autoreset::NextStep;
        for (progress, [steps, end]) in self.progress.iter_mut().zip(self.batch.download_progress()?) {
            let over = next_step && end != 0;
            let steps = if over { 0 } else { u64::from(steps) };
            *progress = Progress { started: true, over, reward: 0.0, steps, commanded: true };
        }
        self.ahead = false;
        Ok(())
    }

    /// Starts an episode in every environment that the mask selects, with the seeds that `seed_of` returns.
    fn reset_with(
        &mut self,
        mask: &[bool],
        seed_of: impl Fn(usize) -> Option<u64>,
        observations: &mut [f32],
    ) -> Result<(), EnvError> {
        self.faults.clear();
        let (count, size) = (self.progress.len(), self.observation_size());
        check_len("mask", mask.len(), count)?;
        check_len("observations", observations.len(), count * size)?;
        self.catch_up()?;
        self.select(mask, seed_of);
        let waits: Vec<bool> = (0..count).map(|environment| self.needs_reset(environment).is_some()).collect();
        let bytes = self.batch.read([&self.batch.observations])?;
        let rows = f32::from_bytes(&bytes[0]).chunks_exact(size);
        for (environment, (row, out)) in rows.zip(observations.chunks_exact_mut(size)).enumerate() {
            if self.config.keep_observations {
                let kept = &mut self.kept[environment * size..][..size];
                // without an episode the device has another row
                if !waits[environment] {
                    kept.copy_from_slice(row);
                }
                out.copy_from_slice(kept);
            } else if mask[environment] {
                out.copy_from_slice(row);
            }
        }
        Ok(())
    }

    /// Starts an episode on the device in every environment that the mask selects.
    fn select(&mut self, mask: &[bool], seed_of: impl Fn(usize) -> Option<u64>) {
        let count = self.progress.len();
        let mut selection = vec![0_u32; 3 * count];
        for environment in (0..count).filter(|&environment| mask[environment]) {
            let seed = seed_of(environment);
            selection[environment] = if seed.is_some() { 2 } else { 1 };
            let seed = seed.unwrap_or_default();
            (selection[count + environment], selection[2 * count + environment]) = (seed as u32, (seed >> 32) as u32);
        }
        self.batch.reset(&selection);
        self.downloaded = OnceLock::new();
        for environment in (0..count).filter(|&environment| mask[environment]) {
            self.progress[environment] = Progress { started: true, ..Progress::default() };
            self.summaries[environment] = None;
        }
    }

    /// Returns the error of an environment that needs a reset before its next step.
    fn needs_reset(&self, environment: usize) -> Option<EnvError> {
        let Progress { started, over, .. } = self.progress[environment];
        let when = match (started, over && self.config.autoreset == Autoreset::Disabled) {
            (false, _) => "on a new environment",
            (true, true) => "after the end of the episode",
            (true, false) => return None,
        };
        Some(EnvError::NeedsReset { when })
    }

    fn check_started(&self) -> Result<(), EnvError> {
        match (0..self.progress.len()).find_map(|environment| Some((environment, self.needs_reset(environment)?))) {
            Some((environment, error)) => Err(EnvError::InBatch { environment, error: Box::new(error) }),
            None => Ok(()),
        }
    }

    /// Returns true if the next step of an environment starts an episode and ignores the action.
    fn ignores_action(&self, environment: usize) -> bool {
        self.config.autoreset == Autoreset::NextStep && self.progress[environment].over
    }

    /// Returns the action of an environment.
    fn action_of<'a>(&self, actions: &'a [f64], environment: usize) -> &'a [f64] {
        let size = self.action_size();
        &actions[environment * size..][..size]
    }

    /// Returns the error of an action that is not finite.
    fn bad_action(&self, actions: &[f64], environment: usize) -> Option<EnvError> {
        let action = self.action_of(actions, environment);
        let index = action.iter().position(|x| !x.is_finite())?;
        let time = self.progress[environment].steps as f64 * self.control_period;
        Some(EnvError::Action { index, got: action[index], time })
    }

    /// Advances every environment by one control step with the actions of `self.actions`.
    fn step_with(&mut self, actions: Vec<f64>, out: VecStep<'_>) -> Result<(), EnvError> {
        let count = self.progress.len();
        check_len("observations", out.observations.len(), count * self.observation_size())?;
        check_len("rewards", out.rewards.len(), count)?;
        check_len("terminated", out.terminated.len(), count)?;
        check_len("truncated", out.truncated.len(), count)?;
        self.catch_up()?;
        let fatal = self.config.on_fault == OnFault::Error;
        if fatal {
            self.check_started()?;
        }
        if fatal && actions.iter().any(|x| !x.is_finite()) {
            let running = (0..count).filter(|&environment| !self.ignores_action(environment));
            let bad = running.map(|environment| (environment, self.bad_action(&actions, environment)));
            if let Some((environment, Some(error))) = bad.into_iter().find(|(_, error)| error.is_some()) {
                return Err(EnvError::InBatch { environment, error: Box::new(error) });
            }
        }
        self.batch.set_actions(&actions);
        self.actions = actions;
        self.downloaded = OnceLock::new();
        self.batch.step();
        let DeviceBatch { observations, rewards, ends, .. } = &self.batch;
        let bytes = self.batch.read([observations, rewards, ends])?;
        self.control_steps += 1;
        let size = self.observation_size();
        let rows = f32::from_bytes(&bytes[0]).chunks_exact(size).zip(out.observations.chunks_exact_mut(size));
        for (environment, (row, out)) in rows.enumerate() {
            // an environment that waits for its reset keeps its row
            let waits = self.needs_reset(environment).is_some();
            if self.config.keep_observations {
                let kept = &mut self.kept[environment * size..][..size];
                if !waits {
                    kept.copy_from_slice(row);
                }
                out.copy_from_slice(kept);
            } else if !waits {
                out.copy_from_slice(row);
            }
        }
        out.rewards.copy_from_slice(f32::from_bytes(&bytes[1]));
        let mut any_ended = false;
        for (environment, &end) in u32::from_bytes(&bytes[2]).iter().enumerate() {
            out.terminated[environment] = end & end::TERMINATED != 0;
            out.truncated[environment] = end & end::TRUNCATED != 0;
            if let Some(error) = self.needs_reset(environment) {
                (out.rewards[environment], out.terminated[environment]) = (0.0, false);
                out.truncated[environment] = false;
                self.summaries[environment] = None;
                self.faults.push((environment, error));
                continue;
            }
            any_ended |= end != 0;
            self.note(environment, f64::from(out.rewards[environment]), end);
        }
        if any_ended && self.config.autoreset == Autoreset::SameStep {
            let bytes = self.batch.read([&self.batch.last_observations])?;
            self.finals.copy_from_slice(f32::from_bytes(&bytes[0]));
        }
        match self.faults.first() {
            Some((environment, error)) if fatal => {
                Err(EnvError::InBatch { environment: *environment, error: Box::new(error.clone()) })
            }
            _ => Ok(()),
        }
    }

    /// Updates what the host knows of an environment after a step with this reward and end.
    fn note(&mut self, environment: usize, reward: f64, end: u32) {
        self.summaries[environment] = None;
        if self.ignores_action(environment) {
            self.progress[environment] = Progress { started: true, ..Progress::default() };
            return;
        }
        let reason = reason_of(end & end::REASON);
        if reason == Some(EndReason::Fault) {
            let time = self.progress[environment].steps as f64 * self.control_period;
            let diverged = || EnvError::Device { message: format!("the state of a drone diverged after {time} s") };
            let error = self.bad_action(&self.actions, environment).unwrap_or_else(diverged);
            self.faults.push((environment, error));
        }
        let progress = &mut self.progress[environment];
        progress.reward += reward;
        // a step that fails does not count
        progress.steps += u64::from(reason != Some(EndReason::Fault));
        progress.commanded = true;
        if end == 0 {
            return;
        }
        let Progress { reward, steps, .. } = *progress;
        let success = end & end::SUCCESS != 0;
        self.summaries[environment] = Some(EpisodeSummary { reward, steps, end: reason, success });
        let over = self.config.autoreset != Autoreset::SameStep;
        self.progress[environment] = Progress { started: true, over, commanded: over, ..Progress::default() };
    }

    /// Checks that no start of an episode in these ranges needs a second sample.
    #[cfg(feature = "learn")]
    pub(crate) fn check_starts(&self, ranges: &[InitialRanges]) -> Result<(), GpuError> {
        for initial in ranges {
            let ranges = Randomization { initial: Some(*initial), ..Randomization::NONE };
            check_starts(&self.batch.plan.task, &ranges, &self.nominal)?;
        }
        Ok(())
    }

    /// Returns the contents of the device.
    fn downloaded(&self) -> Option<&Downloaded> {
        if self.downloaded.get().is_none() {
            let numbers = self.batch.download_numbers().ok()?;
            let actions = if self.ahead { Some(self.batch.download_actions().ok()?) } else { None };
            let _ = self.downloaded.set(Downloaded { numbers, actions });
        }
        self.downloaded.get()
    }
}

/// Returns a state from the numbers of the device.
fn state_of(at: impl Fn(usize) -> f64) -> DroneState {
    DroneState {
        position: [at(0), at(1), at(2)].into(),
        attitude: attitude_from_wxyz([at(3), at(4), at(5), at(6)]),
        velocity: [at(7), at(8), at(9)].into(),
        angular_velocity: [at(10), at(11), at(12)].into(),
    }
}

/// Checks that the buffers of a batch are within the limits of the device.
fn check_size(device: &GpuDevice, count: usize, precision: Precision, plan: &Plan) -> Result<(), GpuError> {
    let adapter = device.adapter();
    let [entries, bytes] = DeviceBatch::largest_rows(plan, precision).map(|row| row as u64);
    // entries of the buffers have indices of 32 bits
    let max = (adapter.max_buffer / bytes).min(u64::from(u32::MAX) / entries) as usize;
    let max = max.min(VecConfig::MAX_ENVIRONMENTS);
    if count <= max {
        return Ok(());
    }
    Err(GpuError::TooManyEnvironments { got: count, max, bytes: adapter.max_buffer, adapter: adapter.name.clone() })
}

fn check_len(what: &'static str, got: usize, expected: usize) -> Result<(), EnvError> {
    if got == expected { Ok(()) } else { Err(EnvError::Buffer { what, got, expected }) }
}

/// The batch has one thread on the host. It has no images, and no environment on the CPU:
/// [`with_env`](VecEnv::with_env) is an error, and [`final_info`](VecEnv::final_info) returns `None`.
impl VecEnv for GpuAviary {
    fn name(&self) -> &'static str {
        self.name
    }

    fn num_envs(&self) -> usize {
        self.progress.len()
    }

    fn num_threads(&self) -> usize {
        1
    }

    fn observation_space(&self) -> &ObservationSpace {
        &self.observation_space
    }

    fn action_space(&self) -> &BoxSpace {
        &self.action_space
    }

    fn observation_size(&self) -> usize {
        self.observation_space.vector.size()
    }

    fn episode_steps(&self) -> u64 {
        u64::from(self.batch.plan.episode_steps)
    }

    fn control_period(&self) -> f64 {
        self.control_period
    }

    fn reset_where(&mut self, mask: &[bool], seed: Option<u64>, observations: &mut [f32]) -> Result<(), EnvError> {
        self.reset_with(mask, |_| seed, observations)
    }

    fn reset_with_seeds(
        &mut self,
        mask: &[bool],
        seeds: &[Option<u64>],
        observations: &mut [f32],
    ) -> Result<(), EnvError> {
        check_len("seeds", seeds.len(), self.progress.len())?;
        self.reset_with(mask, |environment| seeds[environment], observations)
    }

    fn step(&mut self, actions: &[f32], out: VecStep<'_>) -> Result<(), EnvError> {
        self.faults.clear();
        check_len("actions", actions.len(), self.actions.len())?;
        self.step_with(actions.iter().map(|&action| f64::from(action)).collect(), out)
    }

    fn step_f64(&mut self, actions: &[f64], out: VecStep<'_>) -> Result<(), EnvError> {
        self.faults.clear();
        check_len("actions", actions.len(), self.actions.len())?;
        self.step_with(actions.to_vec(), out)
    }

    fn render_images_where(&mut self, mask: &[bool], out: VecImages<'_>) -> Result<(), EnvError> {
        check_len("mask", mask.len(), self.progress.len())?;
        check_len("rgb", out.rgb.len(), 0)?;
        check_len("depth", out.depth.len(), 0)?;
        check_len("segmentation", out.segmentation.len(), 0)
    }

    fn final_observations(&self) -> &[f32] {
        &self.finals
    }

    fn final_images(&self, _: usize) -> Option<&Observation> {
        None
    }

    fn final_info(&self, _: usize) -> Option<&Info> {
        None
    }

    fn kinematic(&self, environment: usize, drone: usize) -> Option<[f64; KIN_SIZE]> {
        let (count, drones) = (self.batch.drones(), self.scales.len());
        if environment >= self.progress.len() || drone >= drones {
            return None;
        }
        let (Downloaded { numbers, actions }, index) = (self.downloaded()?, environment * drones + drone);
        let at = |row: usize| numbers[row * count + index];
        let size = self.batch.plan.action_size();
        let action = &self.action_of(actions.as_ref().unwrap_or(&self.actions), environment)[drone * size..][..size];
        let hover = if self.batch.plan.relative { self.nominal[drone].hover_rpm } else { 0.0 };
        let command = |motor: usize| match self.batch.plan.decoding {
            _ if !self.progress[environment].commanded => 0.0,
            Decoding::Scaled { .. } => self.scales[drone].rpm(action[motor % size]),
            Decoding::Raw => {
                let [low, high] = self.batch.plan.action_bounds[motor];
                action[motor].clamp(low, high)
            }
            Decoding::Loops(_) => at(COMMAND + motor) + hover,
        };
        Some(kinematic(&state_of(at), &[0, 1, 2, 3].map(command)))
    }

    fn battery(&self, _: usize, _: usize) -> Option<BatteryState> {
        None
    }

    fn episode_summary(&self, environment: usize) -> Option<&EpisodeSummary> {
        self.summaries.get(environment)?.as_ref()
    }

    fn faults(&self) -> &[(usize, EnvError)] {
        &self.faults
    }

    fn with_env(&mut self, _: usize, _: &mut dyn FnMut(&mut dyn DroneEnv)) -> Result<(), EnvError> {
        let (got, expected) = ("called on a batch of the GPU".into(), "a batch of the CPU");
        Err(EnvError::Option { option: "with_env", got, expected })
    }

    fn bytes_per_env(&self) -> usize {
        DeviceBatch::bytes_per_env(&self.batch.plan, self.batch.precision, !self.finals.is_empty())
    }

    fn engine_substeps(&self) -> Substeps {
        let steps = self.control_steps * u64::from(self.batch.plan.substeps) * self.progress.len() as u64;
        Substeps { flight: steps, ..Substeps::default() }
    }
}

#[cfg(test)]
mod tests;
