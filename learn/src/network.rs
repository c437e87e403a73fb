//! Parameters of actor and critic.
//!
//! One vector holds all parameters: the actor's, the critic's (each in the order of [`Mlp`]), those of the recurrent
//! layer (in the order of [`Gru`]), and the log standard deviations of the actions.

use std::fmt;

use aviary::env::Rng;
use aviary::policy::{Activation, Gru, Mlp};
use nalgebra::DMatrix;
use rand::RngExt as _;
use rand_distr::StandardNormal;

/// Layer sizes of an actor and a critic, which have the same inputs and hidden layers.
///
/// With recurrent units, a [`Gru`] reads the observation, and actor and critic read the observation and the state of
/// this layer.
///
/// One vector holds their parameters: the actor's, the critic's (each in the order of [`Mlp`]), those of the recurrent
/// layer (in the order of [`Gru`]), and the log standard deviations of the actions.
#[derive(Debug, Clone, PartialEq)]
pub struct NetworkShape {
    /// Sizes of the actor's layers: observation and recurrent units, hidden layers, action.
    pub actor: Vec<usize>,
    /// Sizes of the critic's layers: observation and recurrent units, hidden layers, 1.
    pub critic: Vec<usize>,
    /// Activation function of the hidden layers.
    pub activation: Activation,
    /// Number of recurrent units; 0 without a recurrent layer.
    pub recurrent: usize,
}

impl fmt::Display for NetworkShape {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let sizes: Vec<_> = self.actor.iter().map(ToString::to_string).collect();
        write!(f, "{} ({:?}", sizes.join("-"), self.activation)?;
        if self.recurrent == 0 { f.write_str(")") } else { write!(f, ", {} recurrent units)", self.recurrent) }
    }
}

impl NetworkShape {
    /// Creates the shape from the number of entries of an observation and of an action, and the hidden layers.
    pub fn new(observation: usize, action: usize, hidden: &[usize], activation: Activation) -> Self {
        let sizes = |last: usize| std::iter::once(observation).chain(hidden.iter().copied()).chain([last]).collect();
        Self { actor: sizes(action), critic: sizes(1), activation, recurrent: 0 }
    }

    /// Adds a recurrent layer with a number of units; 0 for none.
    #[must_use]
    pub fn with_recurrent(mut self, units: usize) -> Self {
        let inputs = self.observation() + units;
        (self.actor[0], self.critic[0], self.recurrent) = (inputs, inputs, units);
        self
    }

    /// Returns the number of entries of an observation.
    pub fn observation(&self) -> usize {
        self.actor[0] - self.recurrent
    }

    /// Returns the number of inputs of actor and critic: the entries of an observation and the recurrent units.
    pub fn features(&self) -> usize {
        self.actor[0]
    }

    /// Returns the number of parameters of the recurrent layer.
    fn recurrent_count(&self) -> usize {
        if self.recurrent == 0 { 0 } else { Gru::count(self.observation(), self.recurrent) }
    }

    /// Returns the number of entries of an action.
    pub fn action(&self) -> usize {
        self.actor[self.actor.len() - 1]
    }

    /// Returns the total number of parameters.
    pub fn count(&self) -> usize {
        Mlp::count(&self.actor) + Mlp::count(&self.critic) + self.recurrent_count() + self.action()
    }

    /// Returns the parameters of the recurrent layer; empty without one.
    pub fn recurrent_part<'a>(&self, parameters: &'a [f32]) -> &'a [f32] {
        &parameters[Mlp::count(&self.actor) + Mlp::count(&self.critic)..][..self.recurrent_count()]
    }

    /// Splits parameters into the actor's, the critic's, and the log standard deviations.
    pub fn split<'a>(&self, parameters: &'a [f32]) -> (&'a [f32], &'a [f32], &'a [f32]) {
        let (actor, rest) = parameters.split_at(Mlp::count(&self.actor));
        let (critic, rest) = rest.split_at(Mlp::count(&self.critic));
        (actor, critic, &rest[self.recurrent_count()..])
    }

    /// Returns initial parameters: orthogonal weights (Saxe et al. 2014), scaled by √2 in hidden layers, by 0.01 in
    /// the actor's last layer, by 1 in the critic's and in the gates of the recurrent layer; biases of zero, and of 1
    /// for the update gates, so that the initial layer keeps most of its state; and the logarithm of a standard
    /// deviation.
    pub fn initial(&self, deviation: f32, rng: &mut Rng) -> Vec<f32> {
        let mut parameters = Vec::with_capacity(self.count());
        for (sizes, last) in [(&self.actor, 0.01), (&self.critic, 1.0)] {
            for (layer, pair) in sizes.windows(2).enumerate() {
                let gain = if layer + 2 == sizes.len() { last } else { std::f32::consts::SQRT_2 };
                let weights = orthogonal(pair[0], pair[1], rng);
                parameters.extend(weights.iter().map(|weight| gain * weight));
                parameters.extend(std::iter::repeat_n(0.0, pair[1]));
            }
        }
        if self.recurrent > 0 {
            let units = self.recurrent;
            for (inputs, update_bias) in [(self.observation(), 1.0), (units, 0.0)] {
                let gates = [(); 3].map(|()| orthogonal(inputs, units, rng));
                for row in 0..inputs {
                    parameters.extend(gates.iter().flat_map(|gate| &gate[row * units..][..units]));
                }
                for bias in [0.0, update_bias, 0.0] {
                    parameters.extend(std::iter::repeat_n(bias, units));
                }
            }
        }
        parameters.extend(std::iter::repeat_n(deviation.ln(), self.action()));
        parameters
    }
}

/// Returns a row-major matrix with orthonormal rows or columns, whichever are fewer.
fn orthogonal(rows: usize, columns: usize, rng: &mut Rng) -> Vec<f32> {
    let (long, short) = (rows.max(columns), rows.min(columns));
    let normal = DMatrix::from_fn(long, short, |_, _| rng.sample::<f64, _>(StandardNormal));
    let (q, r) = normal.qr().unpack();
    // the signs of R's diagonal make the matrix uniformly distributed
    let entry = |i: usize, j: usize| q[(i, j)] * r[(j, j)].signum();
    let at = |row: usize, column: usize| if rows >= columns { entry(row, column) } else { entry(column, row) };
    (0..rows).flat_map(|row| (0..columns).map(move |column| (row, column))).map(|(i, j)| at(i, j) as f32).collect()
}

/// Range of the log standard deviations of actions. The bounds (4.5e-5 and 20, in half widths of the action space)
/// keep every term of the loss within single precision.
pub const LOG_DEVIATIONS: std::ops::RangeInclusive<f32> = -10.0..=3.0;

#[cfg(test)]
mod tests {
    use aviary::env::Rng;
    use rand::SeedableRng as _;

    use super::*;

    #[test]
    fn initial_weights_are_orthogonal_and_deviations_match_the_setting() {
        let shape = NetworkShape::new(12, 4, &[64, 48], Activation::Relu);
        let parameters = shape.initial(0.3, &mut Rng::seed_from_u64(1));
        assert_eq!(parameters.len(), shape.count());
        let (actor, _, logs) = shape.split(&parameters);
        assert!(logs.iter().all(|log| (log.exp() - 0.3).abs() < 1e-6));
        // the 12 rows of 64 numbers are orthogonal with length √2, and so are the 48 columns of 64 numbers
        let row = |i: usize| &actor[i * 64..(i + 1) * 64];
        let second = &actor[13 * 64..13 * 64 + 64 * 48];
        let column = |j: usize| (0..64).map(move |i| second[i * 48 + j]).collect::<Vec<f32>>();
        let dot = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f32>();
        for (i, j) in [(0, 0), (3, 3), (0, 1), (2, 11)] {
            let wanted = if i == j { 2.0 } else { 0.0 };
            assert!((dot(row(i), row(j)) - wanted).abs() < 1e-5);
            assert!((dot(&column(i), &column(j)) - wanted).abs() < 1e-5);
        }
    }
}
