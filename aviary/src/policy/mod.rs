//! Trained policies: what they are, and how they are flown. Training is not here: a policy is one file, which needs no trainer.

mod file;
mod mlp;

pub use mlp::{Activation, Mlp};

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::SystemError;
use crate::action::ActionType;
use crate::env::DroneEnv;

/// What can go wrong with a policy.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum PolicyError {
    /// A network that cannot be.
    #[error("the network has {got}, expected {expected}")]
    Network {
        /// What it has.
        got: String,
        /// What would do.
        expected: String,
    },
    /// Something of a policy that cannot be.
    #[error("{what} is {got}, expected {expected}")]
    Value {
        /// Which part.
        what: &'static str,
        /// What it is.
        got: String,
        /// What would do.
        expected: String,
    },
    /// An environment that the policy cannot fly.
    #[error("the policy is for {policy}, the environment has {env}")]
    Mismatch {
        /// What the policy was made for.
        policy: String,
        /// What there is.
        env: String,
    },
    /// Bytes that are no policy.
    #[error("not a policy: {message}")]
    Format {
        /// What is wrong with them.
        message: String,
    },
    /// A file that the system cannot read or write.
    #[error(transparent)]
    System(#[from] SystemError),
    /// A file that cannot be read or written, or whose content is no policy.
    #[error("{}: {error}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        #[source]
        error: Box<Self>,
    },
}

/// What a policy was made for, and how it came to be.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PolicyInfo {
    /// Version of the format: [`PolicyInfo::VERSION`].
    pub version: u32,
    /// The task, in lower snake case.
    pub task: String,
    /// Name of the airframe.
    pub drone: String,
    /// Number of drones in the environments that it was trained in.
    pub num_drones: usize,
    /// Whether it flies every drone by itself, from the drone's own observation.
    pub per_drone: bool,
    /// What the numbers of an action mean, by name.
    pub action_type: String,
    /// Physics rate, Hz.
    pub sim_freq: u32,
    /// Control rate, Hz.
    pub ctrl_freq: u32,
    /// Seed of its training.
    pub seed: u64,
    /// Environment steps of its training.
    pub steps: u64,
    /// The command that made it.
    pub command: String,
    /// The program that made it, and its version.
    pub made_by: String,
    /// Configuration of its training, in TOML: physics, wind, obstacles, randomization, and the trainer's own options. `None` in
    /// policies of version 1.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub training: Option<String>,
}

impl PolicyInfo {
    /// Version of the format that this program writes, and the newest that it reads. Version 2 added
    /// [`training`](Self::training).
    pub const VERSION: u32 = 2;
}

/// A policy: a network between numbers that are brought to a common scale and actions.
///
/// What it does is, for an observation o, `clip(centre + half · net(clip((o − mean) / deviation, ±10)), low, high)`, with the middle and half the width of the
/// action space where that is bounded, else 0 and 1. The network is two or three small layers; flying a drone costs about half a microsecond.
///
/// ```
/// use aviary::env::Env;
/// use aviary::policy::{Activation, Mlp, PolicyNetwork, PolicyInfo};
/// use aviary::tasks::Hover;
///
/// let mut env = Hover::builder().build()?;
/// // full thrust below 1 m, none above
/// let mut weights = vec![0.0; 12 * 4 + 4];
/// weights[2 * 4..3 * 4].fill(-100.0);
/// weights[12 * 4..].fill(100.0);
/// let info = PolicyInfo {
///     version: PolicyInfo::VERSION,
///     task: "hover".into(),
///     drone: "cf2x".into(),
///     num_drones: 1,
///     per_drone: false,
///     action_type: "rpm".into(),
///     sim_freq: 240,
///     ctrl_freq: 48,
///     seed: 0,
///     steps: 0,
///     command: String::new(),
///     made_by: String::new(),
///     training: None,
/// };
/// let net = Mlp::new(&[12, 4], Activation::Relu, &weights)?;
/// let policy = PolicyNetwork::new(info, net, env.observation_space().vector.clone(), env.action_space().clone())?;
/// policy.check(&env)?;
///
/// let mut action = [0.0; 4];
/// policy.forward(&env.reset(Some(1))?.vector, &mut action);
/// assert_eq!(action, [1.0; 4]);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct PolicyNetwork {
    info: PolicyInfo,
    mean: Vec<f32>,
    deviation: Vec<f32>,
    net: Mlp,
    low: Vec<f32>,
    high: Vec<f32>,
}

/// How far a normalized observation reaches, either way.
const CLIP: f32 = 10.0;

impl PolicyNetwork {
    /// Of a network, for these spaces, which are one drone's where the policy flies every drone by itself.
    ///
    /// # Errors
    /// [`PolicyError::Mismatch`] where the network has other sizes than the spaces.
    pub fn new(
        info: PolicyInfo,
        net: Mlp,
        observations: crate::env::BoxSpace,
        actions: crate::env::BoxSpace,
    ) -> Result<Self, PolicyError> {
        let size = observations.size();
        let (low, high) = actions.bounds_f32();
        Self::from_parts(info, net, [vec![0.0; size], vec![1.0; size]], [low, high])
    }

    fn from_parts(
        info: PolicyInfo,
        net: Mlp,
        [mean, deviation]: [Vec<f32>; 2],
        [low, high]: [Vec<f32>; 2],
    ) -> Result<Self, PolicyError> {
        let wrong =
            |what, got: String, expected: &str| Err(PolicyError::Value { what, got, expected: expected.into() });
        if (net.inputs(), net.outputs()) != (mean.len(), low.len()) {
            return Err(PolicyError::Network {
                got: format!("layers of {:?}", net.sizes()),
                expected: format!("{} numbers to come in and {} to go out", mean.len(), low.len()),
            });
        }
        if deviation.len() != mean.len() || high.len() != low.len() {
            return wrong(
                "the number of scales or bounds",
                format!("{} and {}", deviation.len(), high.len()),
                "one for each entry",
            );
        }
        if let Some(x) = mean.iter().find(|x| !x.is_finite()) {
            return wrong("a mean", x.to_string(), "a finite number");
        }
        if let Some(x) = deviation.iter().find(|x| !(x.is_finite() && **x > 0.0)) {
            return wrong("a deviation", x.to_string(), "a positive number");
        }
        if let Some((low, high)) = low.iter().zip(&high).find(|(low, high)| low.is_nan() || high.is_nan() || low > high)
        {
            return wrong("the bounds of an action", format!("{low} and {high}"), "one below the other");
        }
        if info.version == 0 || info.version > PolicyInfo::VERSION {
            return wrong("the version", info.version.to_string(), "1 or 2");
        }
        if info.num_drones == 0 {
            return wrong("the number of drones", "0".into(), "at least 1");
        }
        Ok(Self { info, mean, deviation, net, low, high })
    }

    /// With every observed number brought to a common scale: `mean` is taken from it, and the rest divided by `deviation`.
    ///
    /// # Errors
    /// [`PolicyError::Value`] for too few or too many, numbers that are not finite, and deviations that are not positive.
    pub fn normalized(self, mean: Vec<f32>, deviation: Vec<f32>) -> Result<Self, PolicyError> {
        Self::from_parts(self.info, self.net, [mean, deviation], [self.low, self.high])
    }

    /// What it was made for.
    pub fn info(&self) -> &PolicyInfo {
        &self.info
    }

    /// Its network.
    pub fn net(&self) -> &Mlp {
        &self.net
    }

    /// What is taken from every observed number, and what the rest is divided by.
    pub fn normalization(&self) -> (&[f32], &[f32]) {
        (&self.mean, &self.deviation)
    }

    /// Numbers of an observation, of one drone's where it flies every drone by itself.
    pub fn observation_size(&self) -> usize {
        self.mean.len()
    }

    /// Numbers of an action, of one drone's where it flies every drone by itself.
    pub fn action_size(&self) -> usize {
        self.low.len()
    }

    /// Whether it can fly an environment: as many numbers, of the same meaning. What task it is, how heavy the drone and what the wind is
    /// may differ.
    ///
    /// # Errors
    /// [`PolicyError::Mismatch`] with both sides.
    pub fn check(&self, env: &dyn DroneEnv) -> Result<(), PolicyError> {
        let blocks = if self.info.per_drone { env.simulation().num_drones() } else { 1 };
        let sides = |observation: usize, action: usize, kind: &str| {
            format!("{observation} observed numbers and {action} of an action by {kind}")
        };
        let own = sides(blocks * self.observation_size(), blocks * self.action_size(), &self.info.action_type);
        let (observed, acted) = (env.observation_space().vector.size(), env.action_space().size());
        let there = sides(observed, acted, env.action_type().name());
        if own == there { Ok(()) } else { Err(PolicyError::Mismatch { policy: own, env: there }) }
    }

    /// What the numbers of its actions mean, where this version knows it.
    pub fn action_type(&self) -> Option<ActionType> {
        self.info.action_type.parse().ok()
    }

    /// The action for an observation; of every drone, where there are several and it flies each by itself.
    ///
    /// # Panics
    /// If the slices are not of its sizes, or as many times those for one as for the other.
    pub fn forward(&self, observation: &[f64], action: &mut [f64]) {
        let (inputs, outputs) = (self.observation_size(), self.action_size());
        let count = observation.len() / inputs;
        assert!(
            count > 0 && observation.len() == count * inputs && action.len() == count * outputs,
            "an observation of {inputs} numbers and an action of {outputs}"
        );
        let mut scaled = [0.0; Mlp::MAX_WIDTH];
        let mut out = [0.0; Mlp::MAX_WIDTH];
        for (observation, action) in observation.chunks_exact(inputs).zip(action.chunks_exact_mut(outputs)) {
            for ((scaled, &x), (mean, deviation)) in
                scaled.iter_mut().zip(observation).zip(self.mean.iter().zip(&self.deviation))
            {
                *scaled = ((x as f32 - mean) / deviation).clamp(-CLIP, CLIP);
            }
            self.net.forward(&scaled[..inputs], &mut out[..outputs]);
            for ((action, &x), (&low, &high)) in action.iter_mut().zip(&out).zip(self.low.iter().zip(&self.high)) {
                *action = f64::from(to_bounds(x, low, high));
            }
        }
    }
}

/// What a network's output stands for: −1 to 1 are the bounds where there are two.
fn to_bounds(x: f32, low: f32, high: f32) -> f32 {
    let (middle, half) =
        if low.is_finite() && high.is_finite() { (0.5 * (low + high), 0.5 * (high - low)) } else { (0.0, 1.0) };
    (middle + half * x).clamp(low, high)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::env::Env as _;
    use crate::tasks::Hover;

    /// Actions of single precision are of the action space where the network's output is beyond both bounds.
    #[test]
    fn actions_at_the_bounds_are_of_their_space() {
        let mut rounded_up = 0;
        for action_type in ActionType::ALL {
            let env = Hover::builder().action_type(action_type).build().unwrap();
            let (seen, space) = (env.observation_space().vector.clone(), env.action_space().clone());
            rounded_up += space.high().iter().filter(|&&x| f64::from(x as f32) > x).count();
            let sizes = [seen.size(), space.size()];
            let info = PolicyInfo {
                version: PolicyInfo::VERSION,
                task: "hover".into(),
                drone: "cf2x".into(),
                num_drones: 1,
                per_drone: false,
                action_type: action_type.name().into(),
                sim_freq: 240,
                ctrl_freq: 48,
                seed: 0,
                steps: 0,
                command: String::new(),
                made_by: String::new(),
                training: None,
            };
            for sign in [-1.0, 1.0] {
                let mut weights = vec![0.0; Mlp::count(&sizes)];
                let bias = weights.len() - space.size();
                weights[bias..].fill(100.0 * sign);
                let net = Mlp::new(&sizes, Activation::Relu, &weights).unwrap();
                let policy = PolicyNetwork::new(info.clone(), net, seen.clone(), space.clone()).unwrap();
                let mut action = vec![0.0; space.size()];
                policy.forward(&vec![0.0; seen.size()], &mut action);
                assert!(space.contains(&action), "{action_type}: {action:?}");
                let bound = if sign > 0.0 { space.high() } else { space.low() };
                let close = |(x, bound): (&f64, &f64)| (x - bound).abs() <= 2e-7 * bound.abs();
                assert!(action.iter().zip(bound).all(close), "{action_type}: {action:?}");
            }
        }
        assert!(rounded_up > 0, "no bound that single precision rounds up");
    }
}
