//! Settings of PPO.

use aviary::policy::Activation;
use serde::{Deserialize, Serialize};

/// Defines a struct of settings, and a struct with the subset that a file sets. A setting is also read under its
/// old name.
macro_rules! settings {
    ($(#[$doc:meta])* $name:ident, $partial:ident {
        $($(#[$field_doc:meta])* $field:ident $(was $old:literal)?: $kind:ty,)*
    }) => {
        $(#[$doc])*
        #[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
        #[serde(deny_unknown_fields)]
        pub struct $name {
            $($(#[$field_doc])* $(#[serde(alias = $old)])? pub $field: $kind,)*
        }

        /// Settings of a file.
        #[derive(Debug, Clone, PartialEq, Default, Deserialize)]
        #[serde(default, deny_unknown_fields)]
        pub(crate) struct $partial {
            $($(#[serde(alias = $old)])? $field: Option<$kind>,)*
        }

        impl $partial {
            /// Overrides the settings that the file sets.
            pub(crate) fn apply(self, config: &mut $name) {
                $(if let Some(value) = self.$field {
                    config.$field = value;
                })*
            }
        }
    };
}

settings! {
    /// Hyperparameters of PPO.
    PpoConfig, PartialPpo {
        /// Number of environments that collect experience.
        environments: usize,
        /// Control steps of each environment in a rollout.
        horizon: usize,
        /// Epochs of an update over the rollout.
        epochs: usize,
        /// Size of a minibatch, rows.
        minibatch: usize,
        /// Widths of the hidden layers of actor and critic.
        hidden: Vec<usize>,
        /// Activation function of the hidden layers.
        activation: Activation,
        /// Units of a recurrent layer before the hidden layers, which gives the policy a memory; 0 for none.
        #[serde(default, skip_serializing_if = "is_zero")]
        recurrent: usize,
        /// Maximum learning rate of Adam.
        learning_rate: f64,
        /// Target of the approximate KL divergence of an update. Above twice the target the learning rate
        /// decreases; 0 disables the adaptation.
        target_kl was "divergence": f64,
        /// Discount factor per step, γ.
        gamma was "discount": f64,
        /// λ of generalized advantage estimation (GAE).
        gae_lambda was "lambda": f64,
        /// Clip range of the probability ratio, ε.
        clip_range was "clip": f64,
        /// Weight of the value loss.
        value_coef was "value": f64,
        /// Weight of the entropy bonus.
        entropy_coef was "entropy": f64,
        /// Maximum norm of a gradient.
        max_grad_norm was "max_gradient": f64,
        /// Initial standard deviation of actions, in half widths of the action space.
        initial_std was "deviation": f64,
    }
}

/// Returns true for 0, which configurations of policies without memory do not contain.
fn is_zero(x: &usize) -> bool {
    *x == 0
}

impl PpoConfig {
    /// Returns the largest number of optimizer steps in an iteration with a number of rows.
    pub(crate) fn updates_per_iteration(&self, rows: usize) -> u64 {
        let minibatches = match self.recurrent {
            0 => (rows * self.horizon).div_ceil(self.minibatch),
            _ => rows.div_ceil(self.sequences()),
        };
        (self.epochs * minibatches) as u64
    }

    /// Returns the number of sequences of a minibatch with a recurrent layer; a sequence has all steps of a rollout.
    pub(crate) fn sequences(&self) -> usize {
        (self.minibatch / self.horizon).max(1)
    }
}
