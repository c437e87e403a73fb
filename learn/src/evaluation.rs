//! How well a policy flies: episodes of its own, one environment at a time, as anybody would fly it.

use std::collections::VecDeque;
use std::fmt;

use aviary::env::{DroneEnv, EndReason, EnvError, EpisodeSummary};
use aviary::policy::PolicyNetwork;
use aviary::rollout::{Policy, Rollout, RolloutError};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::TrainError;

/// What counts as success.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Success {
    /// No drone is further from where the task wants it than so many metres, at any moment of the last seconds of a whole episode.
    Near {
        /// s.
        seconds: f64,
        /// m.
        within: f64,
    },
    /// The task is fulfilled at every moment of the last seconds of a whole episode.
    Held {
        /// s.
        seconds: f64,
    },
    /// The task is fulfilled when the episode ends.
    Done,
}

impl Success {
    /// The same in episodes of so many seconds, which may be shorter than what is looked at.
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
            Self::Held { seconds } => write!(f, "the task fulfilled for the last {seconds} s"),
            Self::Done => f.write_str("the task fulfilled at the end"),
        }
    }
}

/// An episode that was flown.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Episode {
    /// Seed of its environment.
    pub seed: u64,
    /// Whether it succeeded.
    pub success: bool,
    /// Sum of its rewards.
    pub reward: f64,
    /// Its length, s.
    pub seconds: f64,
    /// Why it ended, by name.
    pub end: &'static str,
    /// Share of the task that was done.
    pub progress: f64,
    /// Distance from where the task wants the drones, of the furthest one, at the end, m.
    pub final_position_error: f64,
    /// Greatest such distance during the last 5 s of the episode, or during all of a shorter one, m.
    pub late_position_error: f64,
}

/// What many of them say.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Score {
    /// Share that succeeded.
    pub success: f64,
    /// Mean of the sums of rewards.
    pub reward: f64,
    /// Mean share of the task that was done.
    pub progress: f64,
}

impl Score {
    /// Of episodes; zeros of none.
    pub fn of(episodes: &[Episode]) -> Self {
        let mean = |value: fn(&Episode) -> f64| episodes.iter().map(value).sum::<f64>() / episodes.len().max(1) as f64;
        Self {
            success: mean(|episode| f64::from(u8::from(episode.success))),
            reward: mean(|episode| episode.reward),
            progress: mean(|episode| episode.progress),
        }
    }

    /// Whether it is better than another one: more successes, more of the task, more reward.
    pub fn beats(&self, other: &Self) -> bool {
        let key = |score: &Self| [score.success, score.progress, score.reward];
        key(self).partial_cmp(&key(other)).is_some_and(std::cmp::Ordering::is_gt)
    }
}

/// An environment that a thread may take over.
pub type AnyEnv = Box<dyn DroneEnv + Send>;

/// Time at the end of an episode over which errors are looked at, s.
const LATE: f64 = 5.0;

/// Position errors of the last control steps.
struct Recent {
    errors: VecDeque<f64>,
    length: usize,
}

impl Recent {
    /// An empty window of so many steps, at least one.
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

/// Flies an episode with any policy and calls `look` after the reset and after every control step.
///
/// # Errors
/// [`TrainError::Policy`] for a policy that cannot fly the environment, and the environment's.
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
        // an action that is not a number, a state out of range: the failure of the policy
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
        // after a failure the window is without the last error
        late_position_error: recent.greatest().max(info.position_error),
    })
}

/// Environments to be evaluated in, one for every thread.
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
    /// With environments made by a function.
    ///
    /// # Errors
    /// The function's.
    pub fn new(success: Success, make: impl Fn() -> Result<AnyEnv, TrainError>) -> Result<Self, TrainError> {
        let envs = (0..rayon::current_num_threads()).map(|_| make()).collect::<Result<_, _>>()?;
        Ok(Self { envs, success })
    }

    /// What counts as success here.
    pub fn success(&self) -> Success {
        self.success
    }

    /// Flies an episode for each of the seeds from one on.
    ///
    /// # Errors
    /// What [`fly`] finds.
    pub fn fly(
        &mut self,
        policy: &PolicyNetwork,
        first_seed: u64,
        episodes: usize,
    ) -> Result<Vec<Episode>, TrainError> {
        let (threads, success) = (self.envs.len(), self.success);
        let mut flown = (self.envs.par_iter_mut().enumerate())
            .map(|(thread, env)| {
                (thread..episodes)
                    .step_by(threads)
                    .map(|episode| {
                        fly(&mut **env, &mut &*policy, success, first_seed.wrapping_add(episode as u64), &mut |_| {})
                    })
                    .collect::<Result<Vec<_>, _>>()
            })
            .collect::<Result<Vec<_>, _>>()?;
        // the k-th of them was flown by thread k mod threads
        let mut lists: Vec<_> = flown.iter_mut().map(|list| list.drain(..)).collect();
        Ok((0..episodes).filter_map(|episode| lists[episode % threads].next()).collect())
    }
}
