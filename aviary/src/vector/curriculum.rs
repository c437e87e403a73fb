use super::{Autoreset, VecAviary, VecEnv, VecImages, VecStep};
use crate::engine::Substeps;
use crate::env::{Aviary, BoxSpace, DroneEnv, EnvError, EpisodeSummary, Info, ObservationSpace, Task};
use crate::observation::{KIN_SIZE, Observation};
use crate::physics::battery::BatteryState;
use crate::wrappers::{Curriculum, CurriculumConfig};

/// A batch that becomes harder as an agent improves. All environments share one level, which follows the episodes
/// of all of them. A function of the caller configures an environment for the level before its next episode.
///
/// ```
/// use aviary::env::{DroneEnv, Env};
/// use aviary::physics::wind::{WindConfig, WindModel};
/// use aviary::tasks::Hover;
/// use aviary::vector::{VecAviary, VecBuffers, VecConfig, VecCurriculum, VecEnv};
/// use aviary::wrappers::CurriculumConfig;
///
/// let blow = |env: &mut aviary::env::Aviary<Hover>, level: usize| {
///     let wind = WindConfig { velocity: [0.5 * level as f64, 0.0, 0.0], ..WindConfig::new(WindModel::Constant) };
///     env.set_wind(Some(wind))
/// };
/// let batch = VecAviary::new(Hover::builder(), VecConfig::new(32))?;
/// let mut env = VecCurriculum::new(batch, CurriculumConfig::default(), blow)?;
/// let mut buffers = VecBuffers::new(&env);
/// env.reset(Some(1), &mut buffers.observations)?;
/// assert_eq!(env.curriculum().level(), 0);
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
pub struct VecCurriculum<T, F> {
    env: VecAviary<T>,
    curriculum: Curriculum,
    difficulty: F,
    /// Level that each environment is configured for.
    levels: Vec<Option<usize>>,
}

impl<T, F> std::fmt::Debug for VecCurriculum<T, F> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("VecCurriculum").field("curriculum", &self.curriculum).finish_non_exhaustive()
    }
}

impl<T, F> VecCurriculum<T, F>
where
    T: Task + Clone + Send + Sync,
    F: FnMut(&mut Aviary<T>, usize) -> Result<(), EnvError> + Send,
{
    /// Creates a curriculum around a batch, at level 0.
    ///
    /// # Errors
    /// [`EnvError::Option`] if a setting is invalid, or if the batch uses [`Autoreset::SameStep`], which leaves no
    /// time to configure the next episode.
    pub fn new(env: VecAviary<T>, config: CurriculumConfig, difficulty: F) -> Result<Self, EnvError> {
        if env.config().autoreset == Autoreset::SameStep {
            return Err(EnvError::Option {
                option: "autoreset",
                got: "SameStep".into(),
                expected: "NextStep or Disabled under a curriculum",
            });
        }
        let levels = vec![None; env.num_envs()];
        Ok(Self { env, curriculum: Curriculum::new(config)?, difficulty, levels })
    }

    /// Returns the curriculum.
    pub fn curriculum(&self) -> &Curriculum {
        &self.curriculum
    }

    /// Returns the curriculum for changes, such as restoring an earlier state.
    pub fn curriculum_mut(&mut self) -> &mut Curriculum {
        &mut self.curriculum
    }

    /// Returns the wrapped batch.
    pub fn inner(&mut self) -> &mut VecAviary<T> {
        &mut self.env
    }

    /// Configures the environments that are about to start an episode.
    fn set_up(&mut self, begins: impl Fn(&VecAviary<T>, usize) -> bool) -> Result<(), EnvError> {
        let level = self.curriculum.level();
        for environment in 0..self.levels.len() {
            if self.levels[environment] == Some(level) || !begins(&self.env, environment) {
                continue;
            }
            let difficulty = &mut self.difficulty;
            self.env
                .with(environment, |env| difficulty(env, level))?
                .map_err(|error| EnvError::InBatch { environment, error: Box::new(error) })?;
            self.levels[environment] = Some(level);
        }
        Ok(())
    }

    /// Steps the batch with `step`, and counts the episodes that end.
    fn step_with(&mut self, step: impl FnOnce(&mut VecAviary<T>) -> Result<(), EnvError>) -> Result<(), EnvError> {
        self.set_up(|env, environment| env.episode_summary(environment).is_some())?;
        let steps = self.env.steps();
        let done = step(&mut self.env);
        if self.env.steps() == steps {
            // the batch rejected the step before any environment moved, and its summaries are those of the step
            // before
            return done;
        }
        for environment in 0..self.levels.len() {
            if let Some(EpisodeSummary { success, reward, steps, .. }) = self.env.episode_summary(environment) {
                self.curriculum.episode_ended(*success, *reward, *steps);
            }
        }
        done
    }
}

impl<T, F> VecEnv for VecCurriculum<T, F>
where
    T: Task + Clone + Send + Sync,
    F: FnMut(&mut Aviary<T>, usize) -> Result<(), EnvError> + Send,
{
    fn name(&self) -> &'static str {
        self.env.name()
    }

    fn num_envs(&self) -> usize {
        self.env.num_envs()
    }

    fn num_threads(&self) -> usize {
        self.env.num_threads()
    }

    fn observation_space(&self) -> &ObservationSpace {
        self.env.observation_space()
    }

    fn action_space(&self) -> &BoxSpace {
        self.env.action_space()
    }

    fn observation_size(&self) -> usize {
        self.env.observation_size()
    }

    fn episode_steps(&self) -> u64 {
        self.env.episode_steps()
    }

    fn control_period(&self) -> f64 {
        self.env.control_period()
    }

    fn reset_where(&mut self, mask: &[bool], seed: Option<u64>, observations: &mut [f32]) -> Result<(), EnvError> {
        // the batch reports a mask of the wrong length
        self.set_up(|_, environment| mask.get(environment) == Some(&true))?;
        self.env.reset_where(mask, seed, observations)
    }

    fn reset_with_seeds(
        &mut self,
        mask: &[bool],
        seeds: &[Option<u64>],
        observations: &mut [f32],
    ) -> Result<(), EnvError> {
        self.set_up(|_, environment| mask.get(environment) == Some(&true))?;
        self.env.reset_with_seeds(mask, seeds, observations)
    }

    fn step(&mut self, actions: &[f32], out: VecStep<'_>) -> Result<(), EnvError> {
        self.step_with(|env| env.step(actions, out))
    }

    fn step_f64(&mut self, actions: &[f64], out: VecStep<'_>) -> Result<(), EnvError> {
        self.step_with(|env| env.step_f64(actions, out))
    }

    fn render_images(&mut self, out: VecImages<'_>) -> Result<(), EnvError> {
        self.env.render_images(out)
    }

    fn final_observations(&self) -> &[f32] {
        self.env.final_observations()
    }

    fn final_images(&self, environment: usize) -> Option<&Observation> {
        self.env.final_images(environment)
    }

    fn final_info(&self, environment: usize) -> Option<&Info> {
        self.env.final_info(environment)
    }

    fn kinematic(&self, environment: usize, drone: usize) -> Option<[f64; KIN_SIZE]> {
        self.env.kinematic(environment, drone)
    }

    fn battery(&self, environment: usize, drone: usize) -> Option<BatteryState> {
        self.env.battery(environment, drone)
    }

    fn episode_summary(&self, environment: usize) -> Option<&EpisodeSummary> {
        self.env.episode_summary(environment)
    }

    fn faults(&self) -> &[(usize, EnvError)] {
        self.env.faults()
    }

    fn with_env(&mut self, environment: usize, look: &mut dyn FnMut(&mut dyn DroneEnv)) -> Result<(), EnvError> {
        self.env.with_env(environment, look)
    }

    fn bytes_per_env(&self) -> usize {
        self.env.bytes_per_env()
    }

    fn engine_substeps(&self) -> Substeps {
        self.env.engine_substeps()
    }
}
