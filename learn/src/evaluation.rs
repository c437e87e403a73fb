//! Evaluation of a policy in separate episodes, one environment at a time.

use std::collections::VecDeque;
use std::fmt;

use aviary::env::{DroneEnv, EndReason, EnvError, EpisodeSummary};
use aviary::rollout::{Policy, Rollout, RolloutError};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::TrainError;

/// Success criterion of an episode.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Success {
    /// Every drone stays within a distance of its target during the last seconds of a complete episode.
    Near {
        /// Duration at the end of the episode, s.
        seconds: f64,
        /// Largest distance from the target, m.
        within: f64,
    },
    /// The task reports success at every step during the last seconds of a complete episode.
    Held {
        /// Duration at the end of the episode, s.
        seconds: f64,
    },
    /// The task reports success when the episode ends.
    Done,
}

impl Success {
    /// Returns the criterion for episodes of `length` seconds, with its duration limited to that length.
    #[must_use]
    pub fn within(self, length: f64) -> Self {
        match self {
            Self::Near { seconds, within } => Self::Near { seconds: seconds.min(length), within },
            Self::Held { seconds } => Self::Held { seconds: seconds.min(length) },
            Self::Done => Self::Done,
        }
    }
}

impl fmt::Display for Success {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Near { seconds, within } => write!(f, "within {} cm for the last {seconds} s", 100.0 * within),
            Self::Held { seconds } => write!(f, "task succeeded for the last {seconds} s"),
            Self::Done => f.write_str("task succeeded at the end"),
        }
    }
}

/// Result of an episode.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Episode {
    /// Seed of the environment.
    pub seed: u64,
    /// True if the episode satisfied the success criterion.
    pub success: bool,
    /// Sum of the rewards.
    pub reward: f64,
    /// Length, s.
    pub seconds: f64,
    /// Name of the reason of the end.
    pub end: &'static str,
    /// Fraction of the task that was completed.
    pub progress: f64,
    /// Largest distance of a drone from its target at the end, m.
    pub final_position_error: f64,
    /// Largest distance of a drone from its target during the last 5 s, or during all of a shorter episode, m.
    pub late_position_error: f64,
}

impl Episode {
    /// Returns true if the episode ended because an action or the state was not finite.
    pub fn has_fault(&self) -> bool {
        self.end == EndReason::Fault.name()
    }
}

/// Averages over several episodes.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Score {
    /// Fraction of successful episodes.
    pub success: f64,
    /// Mean return.
    pub reward: f64,
    /// Mean fraction of the task that was completed.
    pub progress: f64,
}

impl Score {
    /// Returns the averages of episodes; zeros for an empty slice.
    pub fn of(episodes: &[Episode]) -> Self {
        let mean = |value: fn(&Episode) -> f64| episodes.iter().map(value).sum::<f64>() / episodes.len().max(1) as f64;
        Self {
            success: mean(|episode| f64::from(u8::from(episode.success))),
            reward: mean(|episode| episode.reward),
            progress: mean(|episode| episode.progress),
        }
    }

    /// Returns true if this score is higher, compared by success, then progress, then reward.
    pub fn beats(&self, other: &Self) -> bool {
        let key = |score: &Self| [score.success, score.progress, score.reward];
        key(self).partial_cmp(&key(other)).is_some_and(std::cmp::Ordering::is_gt)
    }
}

/// Boxed environment that can be moved between threads.
pub type AnyEnv = Box<dyn DroneEnv + Send>;

/// Duration of the window of `late_position_error`, s.
const LATE: f64 = 5.0;

/// Window of the latest position errors.
struct Recent {
    errors: VecDeque<f64>,
    length: usize,
}

impl Recent {
    /// Creates an empty window of a number of steps, at least one.
    fn new(steps: u64) -> Self {
        let length = usize::try_from(steps).unwrap_or(usize::MAX).max(1);
        Self { errors: VecDeque::new(), length }
    }

    fn push(&mut self, error: f64) {
        if self.errors.len() == self.length {
            self.errors.pop_front();
        }
        self.errors.push_back(error);
    }

    fn greatest(&self) -> f64 {
        self.errors.iter().copied().fold(0.0, f64::max)
    }
}

/// Runs an episode with any policy and calls `look` after the reset and after every control step.
///
/// # Errors
/// [`TrainError::Policy`] for a policy that does not fit the environment; the environment's errors.
pub fn fly(
    env: &mut dyn DroneEnv,
    policy: &mut dyn Policy,
    success: Success,
    seed: u64,
    look: &mut dyn FnMut(&dyn DroneEnv),
) -> Result<Episode, TrainError> {
    let period = env.simulation().control_period();
    let steps_of = |seconds: f64| (seconds / period).round() as u64;
    let mut recent = Recent::new(steps_of(LATE));
    let mut held = 0_u64;
    let mut rollout = Rollout::start(env, policy, Some(seed))?;
    look(rollout.env());
    let flown = rollout.finish(|env| {
        let info = env.info();
        let good = match success {
            Success::Near { within, .. } => info.position_error < within,
            Success::Held { .. } | Success::Done => info.success,
        };
        held = if good { held + 1 } else { 0 };
        recent.push(info.position_error);
        look(env);
    });
    let summary = match flown {
        Ok(summary) => summary,
        // a non-finite action or a diverged state counts as a failure of the policy
        Err(RolloutError::Env(EnvError::Action { .. } | EnvError::Simulation(_))) => {
            EpisodeSummary { end: Some(EndReason::Fault), success: false, ..rollout.summary() }
        }
        Err(error) => return Err(error.into()),
    };
    let info = rollout.env().info();
    let success = match success {
        Success::Near { seconds, .. } | Success::Held { seconds } => {
            let whole = summary.end == Some(EndReason::TimeLimit);
            whole && held >= steps_of(seconds).min(rollout.env().episode_steps())
        }
        Success::Done => summary.success,
    };
    Ok(Episode {
        seed,
        success,
        reward: summary.reward,
        seconds: summary.steps as f64 * period,
        end: summary.end.map_or("time_limit", EndReason::name),
        progress: info.progress,
        final_position_error: info.position_error,
        // after a failure, the window does not contain the last error
        late_position_error: recent.greatest().max(info.position_error),
    })
}

/// Evaluation environments, one per thread.
pub struct Arena {
    envs: Vec<AnyEnv>,
    success: Success,
}

impl fmt::Debug for Arena {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Arena").field("success", &self.success).finish_non_exhaustive()
    }
}

impl Arena {
    /// Creates the environments with a function.
    ///
    /// # Errors
    /// The errors of `make`.
    pub fn new(success: Success, make: impl Fn() -> Result<AnyEnv, TrainError>) -> Result<Self, TrainError> {
        let envs = (0..rayon::current_num_threads()).map(|_| make()).collect::<Result<_, _>>()?;
        Ok(Self { envs, success })
    }

    /// Returns the success criterion.
    pub fn success(&self) -> Success {
        self.success
    }

    /// Runs one episode per seed, from `first_seed` on. Each thread flies its episodes with a policy of its own, which
    /// `make` creates.
    ///
    /// # Errors
    /// As for [`fly`].
    pub fn fly<P: Policy>(
        &mut self,
        make: impl Fn() -> P + Sync,
        first_seed: u64,
        episodes: usize,
    ) -> Result<Vec<Episode>, TrainError> {
        let (threads, success) = (self.envs.len(), self.success);
        let mut flown = (self.envs.par_iter_mut().enumerate())
            .map(|(thread, env)| {
                let mut policy = make();
                (thread..episodes)
                    .step_by(threads)
                    .map(|episode| {
                        fly(&mut **env, &mut policy, success, first_seed.wrapping_add(episode as u64), &mut |_| {})
                    })
                    .collect::<Result<Vec<_>, _>>()
            })
            .collect::<Result<Vec<_>, _>>()?;
        // thread k mod threads ran the k-th episode
        let mut lists: Vec<_> = flown.iter_mut().map(|list| list.drain(..)).collect();
        Ok((0..episodes).filter_map(|episode| lists[episode % threads].next()).collect())
    }
}
