//! Settings of the algorithm.

use aviary::policy::Activation;
use serde::{Deserialize, Serialize};

/// Defines a structure of settings, and a structure of those that a file sets. A setting is read under its old name as well.
macro_rules! settings {
    ($(#[$doc:meta])* $name:ident, $said:ident {
        $($(#[$field_doc:meta])* $field:ident $(was $old:literal)?: $kind:ty,)*
    }) => {
        $(#[$doc])*
        #[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
        #[serde(deny_unknown_fields)]
        pub struct $name {
            $($(#[$field_doc])* $(#[serde(alias = $old)])? pub $field: $kind,)*
        }

        /// Settings that a file sets.
        #[derive(Debug, Clone, PartialEq, Default, Deserialize)]
        #[serde(default, deny_unknown_fields)]
        pub(crate) struct $said {
            $($(#[serde(alias = $old)])? $field: Option<$kind>,)*
        }

        impl $said {
            /// Overwrites the settings that are set.
            pub(crate) fn apply(self, config: &mut $name) {
                $(if let Some(said) = self.$field {
                    config.$field = said;
                })*
            }
        }
    };
}

settings! {
    /// Hyperparameters of PPO.
    PpoConfig, SaidPpo {
        /// Environments that collect steps.
        environments: usize,
        /// Control steps of each environment between two updates.
        horizon: usize,
        /// Passes of an update over the collected steps.
        epochs: usize,
        /// Rows of a minibatch.
        minibatch: usize,
        /// Neurons of the hidden layers, of actor and critic each.
        hidden: Vec<usize>,
        /// What they do.
        activation: Activation,
        /// Maximum learning rate of Adam.
        learning_rate: f64,
        /// Approximate KL divergence that an update aims at. Above its double the learning rate goes down; 0 keeps the rate.
        target_kl was "divergence": f64,
        /// Discount factor per step, γ.
        gamma was "discount": f64,
        /// λ of generalized advantage estimation.
        gae_lambda was "lambda": f64,
        /// Largest distance of the ratio of probabilities from 1, ε.
        clip_range was "clip": f64,
        /// Weight of the value loss.
        value_coef was "value": f64,
        /// Weight of the entropy bonus.
        entropy_coef was "entropy": f64,
        /// Maximum norm of a gradient.
        max_grad_norm was "max_gradient": f64,
        /// Standard deviation of actions at the start, where 1 is half the width of the action space.
        initial_std was "deviation": f64,
    }
}
