//! Trained policies: inference of a network, and its file format. The training is in a separate crate.

mod file;
pub mod gates;
mod gru;
mod mlp;

pub use gru::Gru;
pub use mlp::{Activation, Mlp};

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::SystemError;
use crate::action::ActionType;
use crate::env::DroneEnv;
use crate::simulation::Simulation;

/// Error of a policy.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum PolicyError {
    /// A network with invalid layers or parameters.
    #[error("the network has {got}, expected {expected}")]
    Network {
        /// Invalid layers or parameters.
        got: String,
        /// Valid layers or parameters.
        expected: String,
    },
    /// A value of a policy outside its range.
    #[error("{what} is {got}, expected {expected}")]
    Value {
        /// Name of the value.
        what: &'static str,
        /// Invalid value.
        got: String,
        /// Valid values.
        expected: String,
    },
    /// An environment with other sizes or another action type than the policy.
    #[error("the policy is for {policy}, the environment has {env}")]
    Mismatch {
        /// Sizes and action type of the policy.
        policy: String,
        /// Sizes and action type of the environment.
        env: String,
    },
    /// Bytes that are not a policy.
    #[error("not a policy: {message}")]
    Format {
        /// Reason.
        message: String,
    },
    /// A file that the system cannot read or write.
    #[error(transparent)]
    System(#[from] SystemError),
    /// A file that the system cannot read or write, or a file without a valid policy.
    #[error("{}: {error}", path.display())]
    File {
        /// Path of the file.
        path: PathBuf,
        /// Error in the file.
        #[source]
        error: Box<Self>,
    },
}

/// Metadata of a policy: the environment and the training that it comes from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PolicyInfo {
    /// Version of the file format: 1 or [`PolicyInfo::VERSION`] for a policy without memory,
    /// [`PolicyInfo::RECURRENT_VERSION`] for a recurrent one.
    pub version: u32,
    /// Name of the task, in lower snake case.
    pub task: String,
    /// Name of the airframe.
    pub drone: String,
    /// Number of drones in the environments of the training.
    pub num_drones: usize,
    /// True if the policy maps the observation of each drone to the action of this drone.
    pub per_drone: bool,
    /// Name of the action type.
    pub action_type: String,
    /// Physics rate, Hz.
    pub sim_freq: u32,
    /// Control rate, Hz.
    pub ctrl_freq: u32,
    /// Seed of the training.
    pub seed: u64,
    /// Environment steps of the training.
    pub steps: u64,
    /// Command that trained the policy.
    pub command: String,
    /// Name and version of the program that trained the policy.
    pub made_by: String,
    /// Configuration of the training, in TOML: physics, wind, obstacles, randomization and trainer options. `None` in
    /// policies of version 1.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub training: Option<String>,
}

impl PolicyInfo {
    /// Current version of the file format of policies without memory. Version 2 added [`training`](Self::training).
    pub const VERSION: u32 = 2;

    /// Version of the file format of recurrent policies, which older programs cannot fly.
    pub const RECURRENT_VERSION: u32 = 3;

    /// Creates the metadata of a policy without memory that was not trained, for a task with its default number of
    /// drones (1 for a task of the user's own), the airframe cf2x and the default action type and rates. A base for
    /// struct update syntax.
    pub fn of_task(task: &str) -> Self {
        Self {
            version: Self::VERSION,
            task: task.into(),
            drone: "cf2x".into(),
            num_drones: crate::tasks::summary(task).map_or(1, |task| task.defaults.num_drones),
            per_drone: false,
            action_type: ActionType::default().name().into(),
            sim_freq: 240,
            ctrl_freq: 48,
            seed: 0,
            steps: 0,
            command: String::new(),
            made_by: String::new(),
            training: None,
        }
    }
}

/// A trained policy: a network with normalized observations and scaled actions.
///
/// For an observation o the action is `clip(centre + half · net(x), low, high)` with x = `clip((o − mean) / deviation,
/// ±10)`. `centre` and `half` are the centre and half the width of a bounded action space, and 0 and 1 for an unbounded
/// one. With the usual two or three small layers the inference takes about 0.5 µs per drone.
///
/// A recurrent policy has a [`Gru`] before the network. Its state h is a memory of the earlier observations of the
/// episode, zero at the start. The layer computes the next state h' from x and h, and the network reads x and h', in
/// this order. A recurrent policy acts through [`forward_with`](Self::forward_with), or through a
/// [pilot](Self::pilot), which holds the memory.
///
/// ```
/// use aviary::env::Env;
/// use aviary::policy::{Activation, Mlp, PolicyNetwork, PolicyInfo};
/// use aviary::tasks::Hover;
///
/// let mut env = Hover::builder().build()?;
/// // full thrust below 1 m, zero thrust above
/// let mut weights = vec![0.0; 12 * 4 + 4];
/// weights[2 * 4..3 * 4].fill(-100.0);
/// weights[12 * 4..].fill(100.0);
/// let info = PolicyInfo::of_task("hover");
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
    gru: Option<Gru>,
    net: Mlp,
    low: Vec<f32>,
    high: Vec<f32>,
}

impl PolicyNetwork {
    /// Bound of the magnitude of a normalized observation.
    pub const CLIP: f32 = 10.0;

    /// Creates a policy from a network, with the observation and action spaces of an environment, or of one drone if
    /// [`per_drone`](PolicyInfo::per_drone) is set.
    ///
    /// # Errors
    /// [`PolicyError::Network`] if the sizes of the network differ from those of the spaces, and [`PolicyError::Value`]
    /// for an invalid version or number of drones.
    pub fn new(
        info: PolicyInfo,
        net: Mlp,
        observations: crate::env::BoxSpace,
        actions: crate::env::BoxSpace,
    ) -> Result<Self, PolicyError> {
        Self::of_spaces(info, None, net, &observations, &actions)
    }

    /// Creates a recurrent policy from a layer with memory and a network, which reads the normalized observation and
    /// the state of the layer, with the spaces of [`new`](Self::new).
    ///
    /// # Errors
    /// As for [`new`](Self::new), for a version other than [`PolicyInfo::RECURRENT_VERSION`] as well.
    pub fn new_recurrent(
        info: PolicyInfo,
        gru: Gru,
        net: Mlp,
        observations: crate::env::BoxSpace,
        actions: crate::env::BoxSpace,
    ) -> Result<Self, PolicyError> {
        Self::of_spaces(info, Some(gru), net, &observations, &actions)
    }

    fn of_spaces(
        info: PolicyInfo,
        gru: Option<Gru>,
        net: Mlp,
        observations: &crate::env::BoxSpace,
        actions: &crate::env::BoxSpace,
    ) -> Result<Self, PolicyError> {
        let size = observations.size();
        let (low, high) = actions.bounds_f32();
        Self::from_parts(info, gru, net, [vec![0.0; size], vec![1.0; size]], [low, high])
    }

    fn from_parts(
        info: PolicyInfo,
        gru: Option<Gru>,
        net: Mlp,
        [mean, deviation]: [Vec<f32>; 2],
        [low, high]: [Vec<f32>; 2],
    ) -> Result<Self, PolicyError> {
        let wrong =
            |what, got: String, expected: &str| Err(PolicyError::Value { what, got, expected: expected.into() });
        let memory = gru.as_ref().map_or(0, Gru::units);
        if (net.inputs(), net.outputs()) != (mean.len() + memory, low.len()) {
            let inputs = if memory > 0 { format!("{} + {memory}", mean.len()) } else { mean.len().to_string() };
            return Err(PolicyError::Network {
                got: format!("layers of {:?}", net.sizes()),
                expected: format!("{inputs} inputs and {} outputs", low.len()),
            });
        }
        if let Some(gru) = gru.as_ref().filter(|gru| gru.inputs() != mean.len()) {
            return Err(PolicyError::Network {
                got: format!("a recurrent layer with {} inputs", gru.inputs()),
                expected: mean.len().to_string(),
            });
        }
        if deviation.len() != mean.len() || high.len() != low.len() {
            return wrong(
                "the number of deviations or upper bounds",
                format!("{} and {}", deviation.len(), high.len()),
                "one per mean or lower bound",
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
            return wrong("the range of an action", format!("{low} to {high}"), "low ≤ high");
        }
        let (versions, expected) = match gru {
            None => (1..=PolicyInfo::VERSION, "1 or 2, or a recurrent layer"),
            Some(_) => (PolicyInfo::RECURRENT_VERSION..=PolicyInfo::RECURRENT_VERSION, "3 with a recurrent layer"),
        };
        if !versions.contains(&info.version) {
            return wrong("the version", info.version.to_string(), expected);
        }
        if !(1..=Simulation::MAX_DRONES).contains(&info.num_drones) {
            let expected = format!("1 to {}", Simulation::MAX_DRONES);
            return wrong("the number of drones", info.num_drones.to_string(), &expected);
        }
        Ok(Self { info, mean, deviation, gru, net, low, high })
    }

    /// Sets the normalization of the observation o to (o − `mean`) / `deviation`; default mean 0 and deviation 1.
    ///
    /// # Errors
    /// [`PolicyError::Network`] or [`PolicyError::Value`] for a wrong number of values, and [`PolicyError::Value`] for
    /// values that are not finite and deviations that are not positive.
    pub fn normalized(self, mean: Vec<f32>, deviation: Vec<f32>) -> Result<Self, PolicyError> {
        Self::from_parts(self.info, self.gru, self.net, [mean, deviation], [self.low, self.high])
    }

    /// Replaces the recurrent layer and the network by others with the same sizes, for example with rounded weights.
    ///
    /// # Errors
    /// [`PolicyError::Network`] if inputs or outputs differ, and [`PolicyError::Value`] if the policy gains or loses its
    /// recurrent layer.
    pub fn with_layers(self, recurrent: Option<Gru>, net: Mlp) -> Result<Self, PolicyError> {
        Self::from_parts(self.info, recurrent, net, [self.mean, self.deviation], [self.low, self.high])
    }

    /// Returns the metadata.
    pub fn info(&self) -> &PolicyInfo {
        &self.info
    }

    /// Returns the network.
    pub fn net(&self) -> &Mlp {
        &self.net
    }

    /// Returns the layer with memory before the network; `None` for a policy without memory.
    pub fn recurrent(&self) -> Option<&Gru> {
        self.gru.as_ref()
    }

    /// Returns the size of the memory: the units of the recurrent layer, or 0. A policy that is
    /// [`per_drone`](PolicyInfo::per_drone) has a memory of this size for every drone.
    pub fn memory_size(&self) -> usize {
        self.gru.as_ref().map_or(0, Gru::units)
    }

    /// Returns mean and deviation of the normalization.
    pub fn normalization(&self) -> (&[f32], &[f32]) {
        (&self.mean, &self.deviation)
    }

    /// Returns the lower and upper bounds of the action, infinite where it has none. Outputs of the network from −1 to
    /// 1 are scaled to the bounds if both are finite.
    pub fn bounds(&self) -> (&[f32], &[f32]) {
        (&self.low, &self.high)
    }

    /// Returns the size of an observation, or of the observation of one drone if the policy is
    /// [`per_drone`](PolicyInfo::per_drone).
    pub fn observation_size(&self) -> usize {
        self.mean.len()
    }

    /// Returns the size of an action, or of the action of one drone if the policy is
    /// [`per_drone`](PolicyInfo::per_drone).
    pub fn action_size(&self) -> usize {
        self.low.len()
    }

    /// Checks that the policy can fly an environment: the sizes of observation and action and the action type must
    /// match.
    ///
    /// Task, airframe and conditions may differ from those of the training.
    ///
    /// # Errors
    /// [`PolicyError::Mismatch`] with the sizes and the action type of both.
    pub fn check(&self, env: &dyn DroneEnv) -> Result<(), PolicyError> {
        let blocks = if self.info.per_drone { env.simulation().num_drones() } else { 1 };
        let sides = |observation: usize, action: usize, kind: &str| {
            format!("{observation} observations and {action} actions ({kind})")
        };
        let own = sides(blocks * self.observation_size(), blocks * self.action_size(), &self.info.action_type);
        let (observed, acted) = (env.observation_space().vector.size(), env.action_space().size());
        let there = sides(observed, acted, env.action_type().name());
        if own == there { Ok(()) } else { Err(PolicyError::Mismatch { policy: own, env: there }) }
    }

    /// Returns the action type, or `None` for a name that this version does not define.
    pub fn action_type(&self) -> Option<ActionType> {
        self.info.action_type.parse().ok()
    }

    /// Computes the action for an observation, or the actions of several drones from the concatenated observations of
    /// all of them if the policy is [`per_drone`](PolicyInfo::per_drone).
    ///
    /// # Panics
    /// If the lengths of the slices are not the same multiple of the observation size and of the action size, and for a
    /// recurrent policy, which needs a memory.
    pub fn forward(&self, observation: &[f64], action: &mut [f64]) {
        assert!(self.gru.is_none(), "expected a policy without memory: a recurrent one needs `forward_with`");
        self.forward_with(observation, &mut [], action);
    }

    /// Computes the action for an observation like [`forward`](Self::forward), and updates the memory, which is zero at
    /// the start of an episode. Several drones have concatenated memories. The memory of a policy without memory is
    /// empty.
    ///
    /// # Panics
    /// If the lengths of the slices are not the same multiple of the observation size, of the
    /// [memory size](Self::memory_size) and of the action size.
    pub fn forward_with(&self, observation: &[f64], memory: &mut [f32], action: &mut [f64]) {
        let (inputs, outputs, units) = (self.observation_size(), self.action_size(), self.memory_size());
        let count = observation.len() / inputs;
        assert!(
            count > 0 && observation.len() == count * inputs && action.len() == count * outputs,
            "expected observations of size {inputs} and as many actions of size {outputs}"
        );
        assert!(memory.len() == count * units, "expected {count} memories of size {units}");
        let mut scaled = [0.0; Mlp::MAX_WIDTH];
        let mut out = [0.0; Mlp::MAX_WIDTH];
        for (row, (observation, action)) in
            observation.chunks_exact(inputs).zip(action.chunks_exact_mut(outputs)).enumerate()
        {
            for ((scaled, &x), (mean, deviation)) in
                scaled.iter_mut().zip(observation).zip(self.mean.iter().zip(&self.deviation))
            {
                *scaled = ((x as f32 - mean) / deviation).clamp(-Self::CLIP, Self::CLIP);
            }
            if let Some(gru) = &self.gru {
                let memory = &mut memory[row * units..][..units];
                gru.forward(&scaled[..inputs], memory);
                scaled[inputs..inputs + units].copy_from_slice(memory);
            }
            self.net.forward(&scaled[..inputs + units], &mut out[..outputs]);
            for ((action, &x), (&low, &high)) in action.iter_mut().zip(&out).zip(self.low.iter().zip(&self.high)) {
                *action = f64::from(to_bounds(x, low, high));
            }
        }
    }
}

/// Scales an output of the network from [−1, 1] to the bounds of the action if both are finite, and clips it to them.
fn to_bounds(x: f32, low: f32, high: f32) -> f32 {
    let (middle, half) =
        if low.is_finite() && high.is_finite() { (0.5 * (low + high), 0.5 * (high - low)) } else { (0.0, 1.0) };
    (middle + half * x).clamp(low, high)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::drone::{DroneModel, DroneParams, MotorParams};
    use crate::env::Env as _;
    use crate::tasks::Hover;

    /// Rounding to single precision must not take a saturated action outside the action space.
    #[test]
    fn saturated_actions_are_in_the_action_space() {
        let mut rounded_up = 0;
        let motors = MotorParams { speed_per_volt: 6000.0, voltage: 3.7, ..MotorParams::default() };
        let params = DroneParams { motors, ..DroneModel::Cf2x.params() };
        for action_type in ActionType::ALL {
            let env = Hover::builder().drone(params.clone()).action_type(action_type).build().unwrap();
            let (seen, space) = (env.observation_space().vector.clone(), env.action_space().clone());
            rounded_up += space.high().iter().filter(|&&x| f64::from(x as f32) > x).count();
            let sizes = [seen.size(), space.size()];
            let info = PolicyInfo { action_type: action_type.name().into(), ..PolicyInfo::of_task("hover") };
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
        assert!(rounded_up > 0, "single precision rounds no bound up");
    }
}
