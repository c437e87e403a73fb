//! Many environments of one task at once, on every core.
//!
//! The state of all of them lies in compact arrays, eight environments beside each other, as the flight kernel wants them. Every
//! worker has one workspace with one MuJoCo simulation for what the kernel cannot do: contacts, wind, images. Environment i is bit-identical
//! to an [`Aviary`](crate::env::Aviary) with the same options, engine, seed and [stream](crate::env::AviaryBuilder::stream) alone, for any
//! number of threads.
//!
//! `batch` has the public API, `pool` the threads, `worker` the stages of a control step, `shard` the environments and who works on which.

mod batch;
mod curriculum;
mod pool;
mod shard;
mod worker;

pub use batch::VecAviary;
pub use curriculum::VecCurriculum;

use crate::engine::Substeps;
use crate::env::{BoxSpace, DroneEnv, EnvConfig, EnvError, EpisodeSummary, ObservationSpace};
use crate::tasks::for_task;
use crate::vision::ImageSize;

/// When an environment that has ended begins its next episode, as in Gymnasium's vector environments.
///
/// ```
/// use aviary::tasks::Hover;
/// use aviary::vector::{Autoreset, VecAviary, VecBuffers, VecConfig, VecEnv};
///
/// let config = VecConfig { autoreset: Autoreset::SameStep, ..VecConfig::new(2) };
/// let mut env = VecAviary::new(Hover::builder().episode_seconds(0.1), config)?;
/// let mut buffers = VecBuffers::new(&env);
/// env.reset(Some(1), &mut buffers.observations)?;
/// for _ in 0..env.episode_steps() {
///     env.step(&[0.5; 8], buffers.step())?;
/// }
/// assert_eq!(buffers.truncated, [true, true]);
/// // the new episode stands where the old one began, which ended higher up
/// assert!(buffers.observations[2] == 0.1 && env.final_observations()[2] > 0.1);
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Autoreset {
    /// In the next step, whose action is ignored: that step returns the first observation, reward 0, and is neither terminated nor truncated.
    #[default]
    NextStep,
    /// In the same step: it returns the first observation of the next episode, and the last one of the old episode is kept in
    /// [`VecEnv::final_observations`].
    SameStep,
    /// Not by itself: a step of an environment that has ended is a fault.
    Disabled,
}

/// What becomes of an environment whose action is not a number or whose state leaves the range of numbers. Its neighbours'
/// bits do not change.
///
/// ```
/// use aviary::tasks::Hover;
/// use aviary::vector::{OnFault, VecAviary, VecBuffers, VecConfig, VecEnv};
///
/// let config = VecConfig { on_fault: OnFault::Truncate, ..VecConfig::new(2) };
/// let mut env = VecAviary::new(Hover::builder(), config)?;
/// let mut buffers = VecBuffers::new(&env);
/// env.reset(Some(1), &mut buffers.observations)?;
/// let mut actions = [0.0; 8];
/// actions[5] = f32::NAN;
/// env.step(&actions, buffers.step())?;
/// assert_eq!(buffers.truncated, [false, true]);
/// assert_eq!(env.faults()[0].0, 1, "the second environment");
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum OnFault {
    /// The step is an error. A bad action is found before anything has moved; after another fault all other environments have made their step.
    #[default]
    Error,
    /// Its episode is truncated, without a reward for this step; [`VecEnv::faults`] says why. An episode that cannot start is reported
    /// as one of zero steps: the step that should have started it (with [`Autoreset::SameStep`] the one after) is truncated with
    /// [`EndReason::Fault`](crate::env::EndReason::Fault), and the next step tries again.
    Truncate,
}

/// How a batch is run.
///
/// ```
/// use aviary::tasks::Hover;
/// use aviary::vector::{VecAviary, VecConfig, VecEnv};
///
/// let env = VecAviary::new(Hover::builder(), VecConfig { threads: 1, ..VecConfig::new(64) })?;
/// assert_eq!((env.num_envs(), env.num_threads()), (64, 1));
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct VecConfig {
    /// Number of environments.
    pub environments: usize,
    /// Threads, each with a MuJoCo simulation of its own, up to 1024 and never more than one for eight environments; 0, the
    /// default, for as many as the machine has cores and the batch keeps busy.
    pub threads: usize,
    /// When environments that have ended begin anew.
    pub autoreset: Autoreset,
    /// What becomes of environments that fail.
    pub on_fault: OnFault,
}

impl VecConfig {
    /// Most environments in a batch.
    pub const MAX_ENVIRONMENTS: usize = 1 << 24;

    /// So many environments, on all cores.
    pub fn new(environments: usize) -> Self {
        Self { environments, ..Self::default() }
    }
}

/// What a step of a batch writes, in the caller's buffers. Row i is environment i's.
///
/// ```
/// use aviary::tasks::Hover;
/// use aviary::vector::{VecAviary, VecConfig, VecEnv, VecStep};
///
/// let mut env = VecAviary::new(Hover::builder(), VecConfig::new(4))?;
/// let (mut observations, mut rewards) = ([0.0; 4 * 12], [0.0; 4]);
/// let (mut terminated, mut truncated) = ([false; 4], [false; 4]);
/// env.reset(Some(1), &mut observations)?;
/// let out = VecStep {
///     observations: &mut observations,
///     rewards: &mut rewards,
///     terminated: &mut terminated,
///     truncated: &mut truncated,
/// };
/// env.step(&[0.0; 4 * 4], out)?;
/// assert!(rewards.iter().all(|reward| (reward + 0.9).abs() < 1e-3), "at rest, 0.9 m below the target");
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug)]
pub struct VecStep<'a> {
    /// M × [`observation_size`](VecEnv::observation_size): see there.
    pub observations: &'a mut [f32],
    /// M: rewards of this step.
    pub rewards: &'a mut [f32],
    /// M: whether the episode came to an end of its own.
    pub terminated: &'a mut [bool],
    /// M: whether the episode was cut off.
    pub truncated: &'a mut [bool],
}

/// Pictures of all environments, in the caller's buffers: M × what one [`Observation`](crate::observation::Observation) has. Those that
/// the observation type does not have are empty.
///
/// ```
/// use aviary::observation::ObservationType;
/// use aviary::tasks::Hover;
/// use aviary::vector::{VecAviary, VecBuffers, VecConfig, VecEnv, VecPictures};
///
/// # if mujoco_rs::gl_info().is_err() { return Ok(()); } // nothing to draw with
/// let builder = Hover::builder().observation_type(ObservationType::KIN_RGB);
/// let mut env = VecAviary::new(builder, VecConfig::new(2))?;
/// let mut buffers = VecBuffers::new(&env);
/// env.reset(Some(1), &mut buffers.observations)?;
/// let mut rgb = vec![0; 2 * 4 * env.camera_size().pixels()];
/// env.pictures(VecPictures { rgb: &mut rgb, ..VecPictures::default() })?;
/// assert!(rgb.chunks_exact(4).all(|pixel| pixel[3] == 255));
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Default)]
pub struct VecPictures<'a> {
    /// M × N × height × width × 4: RGBA.
    pub rgb: &'a mut [u8],
    /// M × N × height × width: m along the camera's axis.
    pub depth: &'a mut [f32],
    /// M × N × height × width: `[type, index]` of objects.
    pub segmentation: &'a mut [[i32; 2]],
}

/// Buffers for a batch.
///
/// ```
/// use aviary::tasks::Hover;
/// use aviary::vector::{VecAviary, VecBuffers, VecConfig, VecEnv};
///
/// let mut env = VecAviary::new(Hover::builder(), VecConfig::new(64))?;
/// let mut buffers = VecBuffers::new(&env);
/// env.reset(Some(1), &mut buffers.observations)?;
/// let actions = vec![0.01; env.num_envs() * env.action_size()];
/// for _ in 0..10 {
///     env.step(&actions, buffers.step())?;
/// }
/// assert!(buffers.rewards.iter().all(|reward| reward.is_finite()));
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct VecBuffers {
    /// M × [`observation_size`](VecEnv::observation_size).
    pub observations: Vec<f32>,
    /// M.
    pub rewards: Vec<f32>,
    /// M.
    pub terminated: Vec<bool>,
    /// M.
    pub truncated: Vec<bool>,
}

impl VecBuffers {
    /// For a batch.
    pub fn new(env: &(impl VecEnv + ?Sized)) -> Self {
        let count = env.num_envs();
        Self {
            observations: vec![0.0; count * env.observation_size()],
            rewards: vec![0.0; count],
            terminated: vec![false; count],
            truncated: vec![false; count],
        }
    }

    /// All of them, to be written by a step.
    pub fn step(&mut self) -> VecStep<'_> {
        VecStep {
            observations: &mut self.observations,
            rewards: &mut self.rewards,
            terminated: &mut self.terminated,
            truncated: &mut self.truncated,
        }
    }
}

/// A batch that owns its buffers, for callers that need not decide where they lie.
///
/// ```
/// use aviary::env::EnvConfig;
/// use aviary::tasks::Hover;
/// use aviary::vector::{BufferedVecEnv, VecAviary, VecConfig, make_vec};
///
/// let mut batch = BufferedVecEnv::new(VecAviary::new(Hover::builder(), VecConfig::new(64))?);
/// batch.reset(Some(1))?;
/// let mut actions = [0.0; 64 * 4];
/// for _ in 0..10 {
///     let step = batch.step(&actions)?;
///     for (action, seen) in actions.chunks_exact_mut(4).zip(step.observations.chunks_exact(12)) {
///         action.fill(0.5 * (1.0 - seen[2]) - 0.4 * seen[8]);
///     }
/// }
/// // a batch whose task is chosen at run time
/// let mut named = BufferedVecEnv::boxed(make_vec("hover", EnvConfig::default(), VecConfig::new(64))?);
/// named.reset(Some(1))?;
/// assert_ne!(named.buffers().observations, batch.buffers().observations);
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
pub struct BufferedVecEnv<E: ?Sized> {
    buffers: VecBuffers,
    env: Box<E>,
}

impl<E: ?Sized> std::fmt::Debug for BufferedVecEnv<E> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("BufferedVecEnv").field("environments", &self.buffers.rewards.len()).finish_non_exhaustive()
    }
}

impl<E: VecEnv> BufferedVecEnv<E> {
    /// Allocates the buffers of a batch.
    pub fn new(env: E) -> Self {
        Self::boxed(Box::new(env))
    }
}

impl<E: VecEnv + ?Sized> BufferedVecEnv<E> {
    /// Allocates the buffers of a boxed batch, as [`make_vec`] returns it.
    pub fn boxed(env: Box<E>) -> Self {
        Self { buffers: VecBuffers::new(&*env), env }
    }

    /// Starts an episode in every environment, and returns the observations: see [`VecEnv::reset`].
    ///
    /// # Errors
    /// As for [`VecEnv::reset`].
    pub fn reset(&mut self, seed: Option<u64>) -> Result<&[f32], EnvError> {
        self.env.reset(seed, &mut self.buffers.observations)?;
        Ok(&self.buffers.observations)
    }

    /// Advances every environment by one control step, and returns what the step wrote: see [`VecEnv::step`].
    ///
    /// # Errors
    /// As for [`VecEnv::step`].
    pub fn step(&mut self, actions: &[f32]) -> Result<&VecBuffers, EnvError> {
        self.env.step(actions, self.buffers.step())?;
        Ok(&self.buffers)
    }

    /// Returns what the last reset and the last step wrote.
    pub fn buffers(&self) -> &VecBuffers {
        &self.buffers
    }

    /// Returns the batch.
    pub fn env(&self) -> &E {
        &self.env
    }

    /// Returns the batch, to be changed.
    pub fn env_mut(&mut self) -> &mut E {
        &mut self.env
    }
}

/// Makes a batch of a task by name.
///
/// ```
/// use aviary::env::EnvConfig;
/// use aviary::vector::{VecConfig, make_vec};
///
/// let env = make_vec("track", EnvConfig::default(), VecConfig::new(256))?;
/// assert_eq!((env.num_envs(), env.observation_size()), (256, 18));
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
///
/// # Errors
/// [`EnvError::UnknownName`], and what making it finds.
pub fn make_vec(name: &str, options: EnvConfig, config: VecConfig) -> Result<Box<dyn VecEnv>, EnvError> {
    let env = for_task!(name, |task| Box::new(VecAviary::new(options.with_task(task), config)?) as Box<dyn VecEnv>);
    env.map_err(EnvError::from)
}

/// A batch of environments of one task.
///
/// ```
/// use aviary::env::{EnvConfig, EnvError};
/// use aviary::vector::{VecBuffers, VecConfig, VecEnv, make_vec};
///
/// /// The mean reward of doing nothing for ten steps.
/// fn idle(env: &mut dyn VecEnv) -> Result<f32, EnvError> {
///     let mut buffers = VecBuffers::new(&*env);
///     let actions = vec![0.0; env.num_envs() * env.action_size()];
///     env.reset(Some(1), &mut buffers.observations)?;
///     let mut sum = 0.0;
///     for _ in 0..10 {
///         env.step(&actions, buffers.step())?;
///         sum += buffers.rewards.iter().sum::<f32>();
///     }
///     Ok(sum / (10 * env.num_envs()) as f32)
/// }
///
/// let mean = idle(&mut *make_vec("hover", EnvConfig::default(), VecConfig::new(16))?)?;
/// assert!((mean + 0.9).abs() < 1e-3, "at rest, 0.9 m below the target");
/// # Ok::<(), EnvError>(())
/// ```
pub trait VecEnv: Send {
    /// Name of the task, in lower snake case.
    fn name(&self) -> &'static str;

    /// Number of environments, M.
    fn num_envs(&self) -> usize;

    /// Number of threads.
    fn num_threads(&self) -> usize;

    /// What one environment's observation looks like.
    fn observation_space(&self) -> &ObservationSpace;

    /// What one environment's action looks like. Steps clip to its bounds.
    fn action_space(&self) -> &BoxSpace;

    /// Numbers in one environment's row of `observations`: the task's vector, then, where they are observed, the distances
    /// from obstacles, the ranges of the rays and the adjacency as 0 and 1.
    fn observation_size(&self) -> usize;

    /// Numbers in one environment's action.
    fn action_size(&self) -> usize {
        self.action_space().size()
    }

    /// Control steps after which an episode is cut off.
    fn episode_steps(&self) -> u64;

    /// Length of a control step, s.
    fn control_period(&self) -> f64;

    /// Starts an episode in every environment. With a seed everything random starts anew from it, in a stream for each.
    ///
    /// # Errors
    /// [`EnvError::Buffer`], [`EnvError::InBatch`] where an environment cannot begin, and [`EnvError::Panicked`].
    fn reset(&mut self, seed: Option<u64>, observations: &mut [f32]) -> Result<(), EnvError> {
        let all = vec![true; self.num_envs()];
        self.reset_where(&all, seed, observations)
    }

    /// Starts an episode where the mask says so, and writes the rows of those environments.
    ///
    /// # Errors
    /// As for [`reset`](Self::reset).
    fn reset_where(&mut self, mask: &[bool], seed: Option<u64>, observations: &mut [f32]) -> Result<(), EnvError>;

    /// Advances every environment by one control step under its row of `actions`, M × [`action_size`](Self::action_size).
    ///
    /// # Errors
    /// [`EnvError::Buffer`] for a buffer of the wrong length, and then nothing has moved; [`EnvError::InBatch`] with the first
    /// environment that failed, see [`OnFault`]; [`EnvError::Panicked`] where a task has panicked before.
    fn step(&mut self, actions: &[f32], out: VecStep<'_>) -> Result<(), EnvError>;

    /// Draws what the onboard cameras of every environment see now.
    ///
    /// # Errors
    /// [`EnvError::Buffer`], [`EnvError::InBatch`] around an [`EnvError::Vision`] where they cannot be drawn, and
    /// [`EnvError::Panicked`].
    fn pictures(&mut self, out: VecPictures<'_>) -> Result<(), EnvError>;

    /// The last observations of the episodes that ended in the last step, in the rows of their environments; M ×
    /// [`observation_size`](Self::observation_size), empty but with [`Autoreset::SameStep`].
    fn final_observations(&self) -> &[f32];

    /// Returns the summary of the episode of an environment that ended in the last step, if one did; `None` for an environment that
    /// is not there.
    fn episode_summary(&self, environment: usize) -> Option<&EpisodeSummary>;

    /// Environments that failed in the last step, and why; none where a bad action was an error before anything moved.
    fn faults(&self) -> &[(usize, EnvError)];

    /// Puts an environment where it can be looked at and changed as if it were alone: its information, its wind, its
    /// randomization. Its observation is not that of the last step: those are in the caller's buffers.
    ///
    /// # Errors
    /// [`EnvError::NoEnvironment`]; [`EnvError::InBatch`] where it cannot be put there; [`EnvError::Panicked`].
    fn with_env(&mut self, environment: usize, look: &mut dyn FnMut(&mut dyn DroneEnv)) -> Result<(), EnvError>;

    /// Bytes that the batch takes for every environment, beside what the threads share and the caller's buffers.
    fn bytes_per_env(&self) -> usize;

    /// How many physics steps of an environment each engine did, over all environments, since the batch was made.
    fn engine_substeps(&self) -> Substeps;

    /// Size of the onboard cameras' pictures.
    fn camera_size(&self) -> ImageSize {
        self.observation_space().camera_size
    }
}
