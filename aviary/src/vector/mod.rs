//! Vectorized environments: many environments of one task, stepped together on all cores.
//!
//! The state of all environments lies in compact arrays. The flight kernel reads and writes eight environments at a
//! time in SIMD registers, with their winds, motors, sensors and sampled parameters. Every worker owns one workspace
//! with one MuJoCo simulation for images and for environments whose drones may touch something. Environment i is
//! bit-identical to a single [`Aviary`](crate::env::Aviary) with the same options, engine, seed and
//! [stream](crate::env::AviaryBuilder::stream), for any number of threads and any instruction set.
//!
//! `batch` holds the public API, `threads` the threads, `pool` the division of the environments among them, `worker`
//! the stages of a control step, and `shard` the environments. `conditions` holds the wind, the sensor errors and the
//! latencies of the environments, `delays` their late commands and late observations.

mod actions;
mod batch;
mod conditions;
mod control_loops;
mod curriculum;
mod delays;
mod flight;
mod pool;
mod shard;
mod threads;
mod worker;

pub use batch::VecAviary;
pub use curriculum::VecCurriculum;

use crate::engine::Substeps;
use crate::engine::flight::Width;
use crate::env::{BoxSpace, DroneEnv, EnvConfig, EnvError, EpisodeSummary, Info, ObservationSpace};
use crate::observation::{KIN_SIZE, Observation};
use crate::physics::battery::BatteryState;
use crate::tasks::{Course, for_task};
use crate::vision::ImageSize;

/// Time of the reset after the end of an episode, as in Gymnasium's vector environments.
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
/// // the new episode starts at 0.1 m; the old one ended higher
/// assert!(buffers.observations[2] == 0.1 && env.final_observations()[2] > 0.1);
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Autoreset {
    /// The step after the end resets the environment and ignores its action. It returns the first observation,
    /// reward 0, and neither `terminated` nor `truncated`.
    #[default]
    NextStep,
    /// The step that ends the episode resets the environment and returns the first observation of the next episode.
    /// [`VecEnv::final_observations`] keeps the last observation of the old episode.
    SameStep,
    /// The caller resets the environment. A step after the end of the episode is a fault.
    Disabled,
}

/// Handling of an environment whose action is not finite or whose state diverges. Faults do not change the results of
/// other environments.
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
    /// The step returns an error. An action that is not finite is rejected before any environment moves. After any
    /// other fault, all other environments have completed their step.
    #[default]
    Error,
    /// The step truncates the episode with reward 0, and [`VecEnv::faults`] holds the error. An episode that cannot
    /// start counts as an episode of zero steps that ends with [`EndReason::Fault`](crate::env::EndReason::Fault).
    /// The step that tried to start it is truncated (with [`Autoreset::SameStep`], the step after that one), and
    /// the next step tries again.
    Truncate,
}

/// Configuration of a batch.
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
    /// Number of threads, each with its own MuJoCo simulation: at most 1024, and at most one per eight
    /// environments. 0, the default, selects as many as the machine has cores and the batch keeps busy.
    pub threads: usize,
    /// Time of the reset after the end of an episode.
    pub autoreset: Autoreset,
    /// Handling of environments that fail.
    pub on_fault: OnFault,
    /// If true, the batch keeps a copy of the last observations, so that every step and reset writes all rows of the
    /// observations and the caller may pass another buffer each time. A reset writes the last observations of the
    /// environments that its mask does not select, zeros before their first reset. By default it leaves their rows as
    /// they are, and the caller passes the buffer of the last step again.
    ///
    /// ```
    /// use aviary::tasks::Hover;
    /// use aviary::vector::{VecAviary, VecBuffers, VecConfig, VecEnv};
    ///
    /// let config = VecConfig { keep_observations: true, ..VecConfig::new(2) };
    /// let mut env = VecAviary::new(Hover::builder(), config)?;
    /// let mut buffers = VecBuffers::new(&env);
    /// env.reset(Some(1), &mut buffers.observations)?;
    /// env.step(&[0.5; 8], buffers.step())?;
    /// let mut observations = [0.0; 2 * 12];
    /// env.reset_where(&[false, true], None, &mut observations)?;
    /// assert_eq!(observations[..12], buffers.observations[..12]);
    /// # Ok::<(), aviary::env::EnvError>(())
    /// ```
    pub keep_observations: bool,
    /// Instruction set of the flight kernel; default the widest of the machine. The results are bit-identical for
    /// all of them. The kernel runs with the baseline if the machine lacks the selected one.
    pub width: Width,
}

impl VecConfig {
    /// Maximum number of environments in a batch.
    pub const MAX_ENVIRONMENTS: usize = 1 << 24;

    /// Creates a configuration with a number of environments on all cores and default options.
    pub fn new(environments: usize) -> Self {
        Self { environments, ..Self::default() }
    }
}

/// Output of a step of a batch, in buffers of the caller. Row i belongs to environment i.
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
    /// Observations, M × [`observation_size`](VecEnv::observation_size), in the layout described there.
    pub observations: &'a mut [f32],
    /// Rewards of this step, M.
    pub rewards: &'a mut [f32],
    /// True where the task ended the episode, M.
    pub terminated: &'a mut [bool],
    /// True where the episode was cut off, M.
    pub truncated: &'a mut [bool],
}

/// Camera images of all environments, in buffers of the caller. The shapes are M times those of an
/// [`Observation`]. Buffers of images outside the observation type are empty.
///
/// ```
/// use aviary::observation::ObservationType;
/// use aviary::tasks::Hover;
/// use aviary::vector::{VecAviary, VecBuffers, VecConfig, VecEnv, VecImages};
///
/// # if mujoco_rs::gl_info().is_err() { return Ok(()); } // no OpenGL
/// let builder = Hover::builder().observation_type(ObservationType::KIN_RGB);
/// let mut env = VecAviary::new(builder, VecConfig::new(2))?;
/// let mut buffers = VecBuffers::new(&env);
/// env.reset(Some(1), &mut buffers.observations)?;
/// let mut rgb = vec![0; 2 * 4 * env.camera_size().pixels()];
/// env.render_images(VecImages { rgb: &mut rgb, ..VecImages::default() })?;
/// assert!(rgb.chunks_exact(4).all(|pixel| pixel[3] == 255));
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Default)]
pub struct VecImages<'a> {
    /// RGBA bytes, M × N × height × width × 4.
    pub rgb: &'a mut [u8],
    /// Depth along the camera's axis, m, M × N × height × width.
    pub depth: &'a mut [f32],
    /// Segmentation, `[type, index]` of the object, M × N × height × width.
    pub segmentation: &'a mut [[i32; 2]],
}

/// Buffers for the observations, rewards and ends of a batch.
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
    /// Observations, M × [`observation_size`](VecEnv::observation_size).
    pub observations: Vec<f32>,
    /// Rewards, M.
    pub rewards: Vec<f32>,
    /// True where the task ended the episode, M.
    pub terminated: Vec<bool>,
    /// True where the episode was cut off, M.
    pub truncated: Vec<bool>,
}

impl VecBuffers {
    /// Creates buffers for a batch.
    pub fn new(env: &(impl VecEnv + ?Sized)) -> Self {
        let count = env.num_envs();
        Self {
            observations: vec![0.0; count * env.observation_size()],
            rewards: vec![0.0; count],
            terminated: vec![false; count],
            truncated: vec![false; count],
        }
    }

    /// Returns all buffers as the output of a step.
    pub fn step(&mut self) -> VecStep<'_> {
        VecStep {
            observations: &mut self.observations,
            rewards: &mut self.rewards,
            terminated: &mut self.terminated,
            truncated: &mut self.truncated,
        }
    }
}

/// A batch with its buffers.
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
/// // a batch of a task that is chosen by name
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

    /// Starts an episode in every environment and returns the observations. See [`VecEnv::reset`].
    ///
    /// # Errors
    /// Returns the errors of [`VecEnv::reset`].
    pub fn reset(&mut self, seed: Option<u64>) -> Result<&[f32], EnvError> {
        self.env.reset(seed, &mut self.buffers.observations)?;
        Ok(&self.buffers.observations)
    }

    /// Advances every environment by one control step and returns the buffers that the step has written. See
    /// [`VecEnv::step`].
    ///
    /// # Errors
    /// Returns the errors of [`VecEnv::step`].
    pub fn step(&mut self, actions: &[f32]) -> Result<&VecBuffers, EnvError> {
        self.env.step(actions, self.buffers.step())?;
        Ok(&self.buffers)
    }

    /// Returns the buffers as the last reset and the last step left them.
    pub fn buffers(&self) -> &VecBuffers {
        &self.buffers
    }

    /// Returns the batch.
    pub fn env(&self) -> &E {
        &self.env
    }

    /// Returns the batch for changes.
    pub fn env_mut(&mut self) -> &mut E {
        &mut self.env
    }
}

/// Creates a batch of a task by name.
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
/// [`EnvError::UnknownName`] if no task has the name, and the errors of [`VecAviary::new`].
pub fn make_vec(name: &str, options: EnvConfig, config: VecConfig) -> Result<Box<dyn VecEnv>, EnvError> {
    let env = for_task!(name, |task| Box::new(VecAviary::new(options.for_task(task)?, config)?) as Box<dyn VecEnv>);
    env.map_err(EnvError::from)
}

/// Creates a batch of a task with a course, for example with other rewards. The options of the task are part of the
/// options. A program that calls [`VecAviary::new`] instead compiles the batch of the task once more, which takes
/// minutes.
///
/// # Errors
/// [`EnvError::TaskOption`] for an option of another task, and the errors of [`VecAviary::new`].
pub fn make_vec_course(course: Course, options: EnvConfig, config: VecConfig) -> Result<Box<dyn VecEnv>, EnvError> {
    Ok(match course {
        Course::FlyThrough(task) => Box::new(VecAviary::new(options.for_task(task)?, config)?),
        Course::Race(task) => Box::new(VecAviary::new(options.for_task(task)?, config)?),
    })
}

/// A batch of environments of one task. M is the number of environments, N the number of drones in each.
///
/// ```
/// use aviary::env::{EnvConfig, EnvError};
/// use aviary::vector::{VecBuffers, VecConfig, VecEnv, make_vec};
///
/// /// Returns the mean reward of ten steps with zero actions.
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
    /// Returns the name of the task, in lower snake case.
    fn name(&self) -> &'static str;

    /// Returns the number of environments, M.
    fn num_envs(&self) -> usize;

    /// Returns the number of threads.
    fn num_threads(&self) -> usize;

    /// Returns the observation space of one environment.
    fn observation_space(&self) -> &ObservationSpace;

    /// Returns the action space of one environment. A step clips actions to its bounds.
    fn action_space(&self) -> &BoxSpace;

    /// Returns the length of one environment's row of `observations`. The row holds the vector of the task,
    /// followed by the observed distances from obstacles, the ranges of the rays and the adjacency as 0 and 1.
    fn observation_size(&self) -> usize;

    /// Returns the length of one environment's action.
    fn action_size(&self) -> usize {
        self.action_space().size()
    }

    /// Returns the number of control steps after which an episode is truncated.
    fn episode_steps(&self) -> u64;

    /// Returns the length of a control step, s.
    fn control_period(&self) -> f64;

    /// Starts an episode in every environment. A seed restarts every random stream; each environment has its own
    /// stream.
    ///
    /// # Errors
    /// [`EnvError::Buffer`] for a buffer of the wrong length, [`EnvError::InBatch`] if an environment cannot start
    /// its episode, and [`EnvError::Panicked`] after a panic in a task.
    fn reset(&mut self, seed: Option<u64>, observations: &mut [f32]) -> Result<(), EnvError> {
        let all = vec![true; self.num_envs()];
        self.reset_where(&all, seed, observations)
    }

    /// Starts an episode in every environment that `mask` selects, and writes the observations of those
    /// environments. With [`VecConfig::keep_observations`], it also writes the last observations of the others.
    ///
    /// # Errors
    /// Returns the errors of [`reset`](Self::reset).
    fn reset_where(&mut self, mask: &[bool], seed: Option<u64>, observations: &mut [f32]) -> Result<(), EnvError>;

    /// Starts an episode in every environment that `mask` selects, like [`reset_where`](Self::reset_where), with a seed
    /// per environment, M. An environment without a seed continues its random stream. Each environment uses its own
    /// stream of its seed.
    ///
    /// ```
    /// use aviary::env::{DroneEnv, Env};
    /// use aviary::tasks::Stabilize;
    /// use aviary::vector::{VecAviary, VecBuffers, VecConfig, VecEnv};
    ///
    /// let mut env = VecAviary::new(Stabilize::builder(), VecConfig::new(3))?;
    /// let mut buffers = VecBuffers::new(&env);
    /// env.reset_with_seeds(&[true; 3], &[Some(5), Some(6), None], &mut buffers.observations)?;
    /// // environment 1 alone
    /// let mut alone = Stabilize::builder().stream(1).build()?;
    /// alone.reset(Some(6))?;
    /// let row = &buffers.observations[env.observation_size()..];
    /// assert!(row.iter().zip(&alone.observation().vector).all(|(got, &expected)| *got == expected as f32));
    /// # Ok::<(), aviary::env::EnvError>(())
    /// ```
    ///
    /// # Errors
    /// Returns the errors of [`reset`](Self::reset).
    fn reset_with_seeds(
        &mut self,
        mask: &[bool],
        seeds: &[Option<u64>],
        observations: &mut [f32],
    ) -> Result<(), EnvError>;

    /// Advances every environment by one control step. `actions` is M × [`action_size`](Self::action_size).
    ///
    /// # Errors
    /// - [`EnvError::Buffer`] for a buffer of the wrong length. No environment has moved.
    /// - [`EnvError::InBatch`] with the first environment that failed, see [`OnFault`].
    /// - [`EnvError::Panicked`] after a panic in a task.
    fn step(&mut self, actions: &[f32], out: VecStep<'_>) -> Result<(), EnvError>;

    /// Advances every environment by one control step, with actions in double precision, like [`step`](Self::step).
    /// Actions that single precision represents exactly have the same results.
    ///
    /// # Errors
    /// Returns the errors of [`step`](Self::step).
    fn step_f64(&mut self, actions: &[f64], out: VecStep<'_>) -> Result<(), EnvError>;

    /// Renders the images of the onboard cameras of all environments in their current states.
    ///
    /// # Errors
    /// [`EnvError::Buffer`] for a buffer of the wrong length, [`EnvError::InBatch`] around an [`EnvError::Vision`]
    /// if an image cannot be rendered, and [`EnvError::Panicked`] after a panic in a task.
    fn render_images(&mut self, out: VecImages<'_>) -> Result<(), EnvError> {
        let all = vec![true; self.num_envs()];
        self.render_images_where(&all, out)
    }

    /// Renders the images of the environments that `mask` selects, like [`render_images`](Self::render_images). The
    /// images of other environments stay as they are.
    ///
    /// # Errors
    /// Returns the errors of [`render_images`](Self::render_images).
    fn render_images_where(&mut self, mask: &[bool], out: VecImages<'_>) -> Result<(), EnvError>;

    /// Returns the last observations of the episodes that ended in the last step, in the rows of their
    /// environments, M × [`observation_size`](Self::observation_size). The slice is empty unless the batch uses
    /// [`Autoreset::SameStep`].
    fn final_observations(&self) -> &[f32];

    /// Returns the last observation, with its images, of the last episode that ended in an environment. Returns `None`
    /// if no episode has ended, if the last one could not start, or unless the batch uses [`Autoreset::SameStep`] and
    /// observes images.
    fn final_images(&self, environment: usize) -> Option<&Observation>;

    /// Returns the state of the episode that ended in the last step of an environment, as
    /// [`Env::info`](crate::env::Env::info) returned it at the end of the episode. Returns `None` if no episode ended, if
    /// it could not start, or if a change of the task has made its options invalid.
    fn final_info(&self, environment: usize) -> Option<&Info>;

    /// Returns the present state of a drone: the numbers of [`kinematic`](crate::observation::kinematic) with the motor
    /// speeds commanded in the last control step. The states of an environment without an episode are those of its
    /// start. Returns `None` if the environment or the drone does not exist.
    fn kinematic(&self, environment: usize, drone: usize) -> Option<[f64; KIN_SIZE]>;

    /// Returns charge, voltage and current of a drone's battery after the last control step, for
    /// [duties](crate::action::ActionType::Duty) that follow from motor speeds. Returns `None` without a battery, or if
    /// the environment or the drone does not exist.
    fn battery(&self, environment: usize, drone: usize) -> Option<BatteryState>;

    /// Returns the summary of the episode that ended in the last step of an environment. Returns `None` if no
    /// episode ended, or if the environment does not exist.
    fn episode_summary(&self, environment: usize) -> Option<&EpisodeSummary>;

    /// Returns the environments that failed in the last step, with their errors. The slice is empty if an action
    /// was rejected before any environment moved.
    fn faults(&self) -> &[(usize, EnvError)];

    /// Calls `look` with one environment as a single environment, for reading and for changes of its wind or
    /// randomization. The environment does not hold the observation of the last step; the caller's buffers do.
    ///
    /// # Errors
    /// [`EnvError::NoEnvironment`] for an index outside the batch, and [`EnvError::Panicked`] after a panic in a
    /// task or in `look`.
    fn with_env(&mut self, environment: usize, look: &mut dyn FnMut(&mut dyn DroneEnv)) -> Result<(), EnvError>;

    /// Returns the memory per environment, bytes, without the memory of the threads and the caller's buffers.
    fn bytes_per_env(&self) -> usize;

    /// Returns the number of physics steps that each engine has computed since the batch was created, summed over
    /// all environments.
    fn engine_substeps(&self) -> Substeps;

    /// Returns the size of the images of the onboard cameras.
    fn camera_size(&self) -> ImageSize {
        self.observation_space().camera_size
    }
}
