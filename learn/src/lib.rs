//! Reinforcement learning of policies for `aviary` environments.
//!
//! A [`Trainer`] collects experience from a batch of environments, improves a policy by proximal policy
//! optimization (PPO), evaluates it and keeps the best one. A [`TrainConfig`] sets the task and the
//! hyperparameters. The result is an [`aviary::policy::PolicyNetwork`], which runs without this crate.

mod agents;
pub mod benchmark;
mod checkpoint;
mod config;
mod curve;
mod error;
mod evaluation;
mod gradient;
mod learner;
mod network;
mod optimizer;
mod ppo;
mod recipe;
mod scale;
mod tensorboard;
mod trainer;

pub use agents::{Agents, Batch, Next, Outcome, Swarm, Terms};
pub use config::{CourseRewards, TrackChoice, TrainConfig, TrainDevice, TrainingStart};
pub use curve::Point;
pub use error::TrainError;
pub use evaluation::{AnyEnv, Arena, Episode, Score, Success, fly};
pub use learner::{Learner, LearnerState};
pub use network::{LOG_DEVIATIONS, NetworkShape};
pub use optimizer::{DECAY, EPSILON};
pub use ppo::{CLIP, Clock, MAX_LOG_RATIO, PpoConfig, Report};
pub use scale::Running;
pub use tensorboard::TensorboardWriter;
pub use trainer::{Stop, Trainer, on_the_cpu};
