//! Settings of the algorithm.

use aviary::policy::Activation;
use serde::{Deserialize, Serialize};

/// A structure of settings, and one that has them as far as they were said.
macro_rules! settings {
    ($(#[$doc:meta])* $name:ident, $said:ident { $($(#[$field_doc:meta])* $field:ident: $kind:ty,)* }) => {
        $(#[$doc])*
        #[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
        #[serde(deny_unknown_fields)]
        pub struct $name {
            $($(#[$field_doc])* pub $field: $kind,)*
        }

        /// The same, as far as it is said.
        #[derive(Debug, Clone, PartialEq, Default, Deserialize)]
        #[serde(default, deny_unknown_fields)]
        pub(crate) struct $said {
            $($field: Option<$kind>,)*
        }

        impl $said {
            /// Changes what is said.
            pub(crate) fn apply(self, config: &mut $name) {
                $(if let Some(said) = self.$field {
                    config.$field = said;
                })*
            }
        }
    };
}

settings! {
    /// The knobs of the algorithm.
    PpoConfig, SaidPpo {
        /// Environments that gather experience.
        environments: usize,
        /// Steps that each makes between two updates.
        horizon: usize,
        /// Times that an update goes through the experience.
        epochs: usize,
        /// Rows of a minibatch.
        minibatch: usize,
        /// Neurons of the hidden layers, of actor and critic each.
        hidden: Vec<usize>,
        /// What they do.
        activation: Activation,
        /// Adam's rate, at most.
        learning_rate: f64,
        /// Divergence that an update is to have, above whose double the rate goes down; 0 leaves the rate alone.
        divergence: f64,
        /// Discount per step, γ.
        discount: f64,
        /// λ of the advantages.
        lambda: f64,
        /// Largest distance of the ratio of probabilities from 1, ε.
        clip: f64,
        /// Weight of the critic's error.
        value: f64,
        /// Weight of the entropy.
        entropy: f64,
        /// Largest norm of a gradient.
        max_gradient: f64,
        /// Standard deviation of actions at the start, where 1 is half the width of the action space.
        deviation: f64,
    }
}
