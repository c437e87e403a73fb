use std::collections::VecDeque;

use serde::{Deserialize, Serialize};

use super::Wrapper;
use crate::env::{DroneEnv, EnvError, EnvSnapshot, Step};
use crate::observation::Observation;

/// Metric of a curriculum. The curriculum follows its mean over the last episodes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CurriculumMetric {
    /// 1 for an episode that ends in success, 0 otherwise.
    #[default]
    SuccessRate,
    /// Sum of the rewards of an episode.
    Reward,
    /// Length of an episode, control steps.
    EpisodeLength,
}

/// Settings of a curriculum (paper, §3.5.3).
///
/// ```
/// use aviary::wrappers::{CurriculumConfig, CurriculumMetric};
///
/// let by_reward = CurriculumConfig {
///     metric: CurriculumMetric::Reward,
///     advance: -20.0,
///     retreat: Some(-80.0),
///     ..CurriculumConfig::default()
/// };
/// assert!(by_reward.validate().is_ok());
/// assert!(CurriculumConfig { retreat: Some(0.9), ..CurriculumConfig::default() }.validate().is_err());
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CurriculumConfig {
    /// Number of levels; 5 by default.
    pub levels: usize,
    /// Metric that selects the level; success rate by default.
    pub metric: CurriculumMetric,
    /// Number of episodes in the mean; 20 by default. The level changes only after this many episodes on it.
    pub window: usize,
    /// Mean at or above which the level increases; 0.8 by default.
    pub advance: f64,
    /// Number of successive episodes with such a mean after which the level increases; 1 by default.
    pub advance_count: usize,
    /// Mean below which the level decreases; `None`, the default, never decreases it.
    pub retreat: Option<f64>,
    /// Level of the first episode; 0 by default.
    pub start_level: usize,
}

impl Default for CurriculumConfig {
    fn default() -> Self {
        Self {
            levels: 5,
            metric: CurriculumMetric::SuccessRate,
            window: 20,
            advance: 0.8,
            advance_count: 1,
            retreat: None,
            start_level: 0,
        }
    }
}

impl CurriculumConfig {
    /// Checks every setting.
    ///
    /// # Errors
    /// [`EnvError::Option`] with the first invalid setting.
    pub fn validate(&self) -> Result<(), EnvError> {
        let wrong = |option, got: String, expected| Err(EnvError::Option { option, got, expected });
        if !(1..=1_000_000).contains(&self.levels) {
            return wrong("levels", self.levels.to_string(), "1 to 1,000,000");
        }
        if !(1..=1_000_000).contains(&self.window) {
            return wrong("window", self.window.to_string(), "1 to 1,000,000 episodes");
        }
        if !(1..=1_000_000).contains(&self.advance_count) {
            return wrong("advance_count", self.advance_count.to_string(), "1 to 1,000,000 episodes");
        }
        if self.start_level >= self.levels {
            return wrong("start_level", self.start_level.to_string(), "less than levels");
        }
        if !self.advance.is_finite() {
            return wrong("advance", self.advance.to_string(), "a finite number");
        }
        match self.retreat {
            Some(retreat) if retreat.is_nan() || retreat >= self.advance => {
                wrong("retreat", retreat.to_string(), "less than advance")
            }
            _ => Ok(()),
        }
    }
}

/// State of a curriculum, for saving and restoring.
///
/// ```
/// use aviary::wrappers::{Curriculum, CurriculumConfig};
///
/// let mut before = Curriculum::new(CurriculumConfig::default())?;
/// before.episode_ended(true, 10.0, 480);
/// let mut after = Curriculum::new(CurriculumConfig::default())?;
/// after.restore_state(before.state().clone())?;
/// assert_eq!((after.state().episodes, after.mean()), (1, Some(1.0)));
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CurriculumState {
    /// Level, from 0.
    pub level: usize,
    /// Metric of the last episodes on this level, oldest first.
    pub recent: VecDeque<f64>,
    /// Number of episodes that ended, over all levels.
    pub episodes: u64,
    /// Number of episodes that ended on each level.
    pub episodes_per_level: Vec<u64>,
    /// Number of times that the level increased.
    pub advances: u64,
    /// Number of times that the level decreased.
    pub retreats: u64,
    /// Number of successive episodes on this level with a mean at or above [`CurriculumConfig::advance`].
    #[serde(default)]
    pub streak: usize,
}

/// Level of difficulty, without an environment. [`CurriculumWrapper`] and
/// [`VecCurriculum`](crate::vector::VecCurriculum) each contain one.
///
/// ```
/// use aviary::wrappers::{Curriculum, CurriculumConfig};
///
/// let config = CurriculumConfig { levels: 3, window: 2, ..CurriculumConfig::default() };
/// let mut curriculum = Curriculum::new(config)?;
/// for success in [false, true, true] {
///     curriculum.episode_ended(success, 10.0, 480);
/// }
/// assert_eq!(curriculum.level(), 1, "both of the last two episodes were a success");
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Curriculum {
    config: CurriculumConfig,
    state: CurriculumState,
}

impl Curriculum {
    /// Creates a curriculum at [`start_level`](CurriculumConfig::start_level).
    ///
    /// # Errors
    /// [`EnvError::Option`] if a setting is invalid.
    pub fn new(config: CurriculumConfig) -> Result<Self, EnvError> {
        config.validate()?;
        let state = CurriculumState {
            level: config.start_level,
            recent: VecDeque::with_capacity(config.window),
            episodes: 0,
            episodes_per_level: vec![0; config.levels],
            advances: 0,
            retreats: 0,
            streak: 0,
        };
        Ok(Self { config, state })
    }

    /// Returns the state.
    pub fn state(&self) -> &CurriculumState {
        &self.state
    }

    /// Returns the level, from 0.
    pub fn level(&self) -> usize {
        self.state.level
    }

    /// Restores an earlier state. The restored level applies from the next reset.
    ///
    /// # Errors
    /// [`EnvError::Option`] for a state that does not fit the settings of this curriculum. Nothing has changed.
    pub fn restore_state(&mut self, state: CurriculumState) -> Result<(), EnvError> {
        self.validate_state(&state)?;
        self.state = state;
        self.state.recent.reserve(self.config.window);
        Ok(())
    }

    fn validate_state(&self, state: &CurriculumState) -> Result<(), EnvError> {
        let levels = self.config.levels;
        let fits = state.level < levels
            && state.episodes_per_level.len() == levels
            && state.recent.len() <= self.config.window
            && state.recent.iter().all(|x| x.is_finite());
        if !fits {
            return Err(EnvError::Option {
                option: "state",
                got: format!(
                    "level {} of {}, {} episodes",
                    state.level,
                    state.episodes_per_level.len(),
                    state.recent.len()
                ),
                expected: "the state of a curriculum with the same levels and window",
            });
        }
        Ok(())
    }

    /// Returns the mean of the metric over the last episodes on this level; `None` before the first episode.
    pub fn mean(&self) -> Option<f64> {
        let recent = &self.state.recent;
        (!recent.is_empty()).then(|| recent.iter().sum::<f64>() / recent.len() as f64)
    }

    /// Records the end of an episode, with its success, the sum of its rewards and its length in control steps.
    pub fn episode_ended(&mut self, success: bool, reward: f64, steps: u64) {
        let metric = match self.config.metric {
            CurriculumMetric::SuccessRate => f64::from(u8::from(success)),
            CurriculumMetric::Reward => reward,
            CurriculumMetric::EpisodeLength => steps as f64,
        };
        let state = &mut self.state;
        state.episodes += 1;
        state.episodes_per_level[state.level] += 1;
        if state.recent.len() == self.config.window {
            state.recent.pop_front();
        }
        state.recent.push_back(metric);
        if state.recent.len() < self.config.window {
            return;
        }
        let mean = state.recent.iter().sum::<f64>() / self.config.window as f64;
        state.streak = if mean >= self.config.advance { state.streak + 1 } else { 0 };
        if state.streak >= self.config.advance_count && state.level + 1 < self.config.levels {
            state.level += 1;
            state.advances += 1;
            state.streak = 0;
            state.recent.clear();
        } else if self.config.retreat.is_some_and(|retreat| mean < retreat) && state.level > 0 {
            state.level -= 1;
            state.retreats += 1;
            state.recent.clear();
        }
    }
}

/// A wrapper that makes an environment harder as an agent improves. After every episode, the level follows the mean
/// of a metric. At every reset, a function of the caller configures the environment for the level. The function
/// receives the whole environment: its wind and randomization and, for an [`Aviary`](crate::env::Aviary), its task.
///
/// An episode counts when it is terminated or truncated. An episode that a reset interrupts does not count.
///
/// ```
/// use aviary::env::{DroneEnv, Env};
/// use aviary::physics::wind::{WindConfig, WindModel};
/// use aviary::tasks::Hover;
/// use aviary::wrappers::{CurriculumConfig, CurriculumWrapper};
///
/// // wind increases with the level
/// let blow = |env: &mut aviary::env::Aviary<Hover>, level: usize| {
///     let wind = WindConfig { velocity: [0.5 * level as f64, 0.0, 0.0], ..WindConfig::new(WindModel::Constant) };
///     env.set_wind(Some(wind))
/// };
/// let mut env = CurriculumWrapper::new(Hover::builder().build()?, CurriculumConfig::default(), blow)?;
/// env.reset(Some(1))?;
/// assert_eq!(env.state().level, 0);
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
pub struct CurriculumWrapper<E, F> {
    env: E,
    curriculum: Curriculum,
    difficulty: F,
    /// Sum of the rewards and number of steps of the running episode.
    running: (f64, u64),
}

impl<E: DroneEnv, F: FnMut(&mut E, usize) -> Result<(), EnvError>> CurriculumWrapper<E, F> {
    /// Creates a curriculum around an environment, at [`start_level`](CurriculumConfig::start_level). Every reset calls
    /// `difficulty` with the environment and the level.
    ///
    /// # Errors
    /// [`EnvError::Option`] if a setting is invalid.
    pub fn new(env: E, config: CurriculumConfig, difficulty: F) -> Result<Self, EnvError> {
        Ok(Self { env, curriculum: Curriculum::new(config)?, difficulty, running: (0.0, 0) })
    }

    /// Returns the wrapped environment.
    pub fn inner(&self) -> &E {
        &self.env
    }

    /// Returns the state of the curriculum.
    pub fn state(&self) -> &CurriculumState {
        self.curriculum.state()
    }

    /// Restores an earlier state of the curriculum. The restored level applies from the next reset.
    ///
    /// # Errors
    /// [`EnvError::Option`] for a state that does not fit the settings of this curriculum. Nothing has changed.
    pub fn restore_state(&mut self, state: CurriculumState) -> Result<(), EnvError> {
        self.curriculum.restore_state(state)
    }

    /// Returns the mean of the metric over the last episodes on this level; `None` before the first episode.
    pub fn mean(&self) -> Option<f64> {
        self.curriculum.mean()
    }
}

impl<E: DroneEnv, F: FnMut(&mut E, usize) -> Result<(), EnvError>> Wrapper for CurriculumWrapper<E, F> {
    type Inner = E;

    fn inner(this: &Self) -> &E {
        &this.env
    }

    fn inner_mut(this: &mut Self) -> &mut E {
        &mut this.env
    }

    fn snapshot(this: &Self) -> EnvSnapshot {
        EnvSnapshot::serializable((this.curriculum.clone(), this.running)).with_inner(this.env.snapshot())
    }

    fn restore(this: &mut Self, snapshot: &EnvSnapshot) -> Result<(), EnvError> {
        let (curriculum, running) = snapshot.read::<(Curriculum, (f64, u64))>()?;
        this.curriculum.validate_state(curriculum.state())?;
        this.env.restore(snapshot.inner()?)?;
        this.running = running;
        this.curriculum.restore_state(curriculum.state)
    }

    fn reset(this: &mut Self, seed: Option<u64>) -> Result<&Observation, EnvError> {
        (this.difficulty)(&mut this.env, this.curriculum.level())?;
        this.running = (0.0, 0);
        this.env.reset(seed)
    }

    fn step<'a>(this: &'a mut Self, action: &[f64]) -> Result<Step<'a>, EnvError> {
        let Step { reward, terminated, truncated, .. } = this.env.step(action)?;
        this.running.0 += reward;
        this.running.1 += 1;
        if terminated || truncated {
            let (reward, steps) = this.running;
            this.curriculum.episode_ended(this.env.info().success, reward, steps);
        }
        Ok(Step { observation: this.env.observation(), reward, terminated, truncated })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn advance_count_and_start_level_delay_and_shift_the_levels() {
        let config =
            CurriculumConfig { levels: 4, window: 2, advance_count: 3, start_level: 2, ..CurriculumConfig::default() };
        let mut curriculum = Curriculum::new(config).unwrap();
        let levels: Vec<_> = [true, true, true, false, true, true, true, true, true]
            .map(|success| {
                curriculum.episode_ended(success, 0.0, 1);
                curriculum.level()
            })
            .into();
        // the failure restarts the count; the mean is 1 again after the sixth episode
        assert_eq!(levels, [2, 2, 2, 2, 2, 2, 2, 3, 3]);
        let refused = |config: CurriculumConfig, text: &str| {
            assert!(Curriculum::new(config).unwrap_err().to_string().starts_with(text));
        };
        refused(CurriculumConfig { start_level: 4, ..config }, "start_level is 4");
        refused(CurriculumConfig { advance_count: 0, ..config }, "advance_count is 0");
    }
}
