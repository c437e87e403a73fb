use pulp::{Simd, WithSimd};
use serde::{Deserialize, Serialize};

use super::PolicyError;

/// Activation function of the hidden layers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Activation {
    /// Rectifier max(0, x).
    #[default]
    Relu,
    /// Softsign x / (1 + |x|): bounded like tanh, and faster.
    Softsign,
}

/// Number of neurons in a block of SIMD registers.
pub(super) const BLOCK: usize = 16;

/// Number of rows that share a load of the weights.
pub(super) const ROWS: usize = 4;

/// A multilayer perceptron: linear layers with an [`Activation`] between them.
///
/// The parameters are stored layer by layer: the weights as a row-major matrix of inputs × outputs, then the biases.
/// The output for a row is bit-identical alone, in a batch and on every machine.
///
/// ```
/// use aviary::policy::{Activation, Mlp};
///
/// // max(0, x − y) · 2 + 1
/// let net = Mlp::new(&[2, 1, 1], Activation::Relu, &[1.0, -1.0, 0.0, 2.0, 1.0])?;
/// let mut out = [0.0; 2];
/// net.forward(&[3.0, 1.0, 1.0, 3.0], &mut out);
/// assert_eq!(out, [5.0, 1.0]);
/// # Ok::<(), aviary::policy::PolicyError>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct Mlp {
    sizes: Vec<usize>,
    activation: Activation,
    parameters: Vec<f32>,
    /// Parameters for SIMD registers: per layer the biases and then the weights, with rows padded to whole blocks by
    /// zeros.
    blocks: Vec<[f32; BLOCK]>,
}

impl Mlp {
    /// Maximum number of neurons in a layer.
    pub const MAX_WIDTH: usize = 256;

    /// Maximum number of layers.
    pub const MAX_LAYERS: usize = 8;

    /// Returns the number of parameters of a network with the given layer sizes, input first.
    pub fn count(sizes: &[usize]) -> usize {
        sizes.windows(2).map(|pair| (pair[0] + 1) * pair[1]).sum()
    }

    /// Creates a network from the sizes of its layers, input first, and its parameters.
    ///
    /// # Errors
    /// [`PolicyError::Network`] for sizes out of range, a wrong number of parameters, or non-finite parameters.
    pub fn new(sizes: &[usize], activation: Activation, parameters: &[f32]) -> Result<Self, PolicyError> {
        check_sizes(sizes)?;
        let blocks = sizes.windows(2).map(|pair| (pair[0] + 1) * pair[1].div_ceil(BLOCK)).sum();
        let mut net = Self {
            sizes: sizes.to_vec(),
            activation,
            parameters: vec![0.0; Self::count(sizes)],
            blocks: vec![[0.0; BLOCK]; blocks],
        };
        net.set(parameters)?;
        Ok(net)
    }

    /// Returns the sizes of the layers, input first.
    pub fn sizes(&self) -> &[usize] {
        &self.sizes
    }

    /// Returns the activation function of the hidden layers.
    pub fn activation(&self) -> Activation {
        self.activation
    }

    /// Returns the parameters.
    pub fn parameters(&self) -> &[f32] {
        &self.parameters
    }

    /// Returns the number of inputs.
    pub fn inputs(&self) -> usize {
        self.sizes[0]
    }

    /// Returns the number of outputs.
    pub fn outputs(&self) -> usize {
        self.sizes[self.sizes.len() - 1]
    }

    /// Sets the parameters.
    ///
    /// # Errors
    /// [`PolicyError::Network`] for a wrong number of parameters or non-finite ones, with the network unchanged.
    pub fn set(&mut self, parameters: &[f32]) -> Result<(), PolicyError> {
        let expected = self.parameters.len();
        if parameters.len() != expected {
            let got = format!("{} parameters", parameters.len());
            return Err(PolicyError::Network { got, expected: format!("{expected} for layers of {:?}", self.sizes) });
        }
        if let Some((index, x)) = parameters.iter().enumerate().find(|(_, x)| !x.is_finite()) {
            let got = format!("{x} as parameter {index}");
            return Err(PolicyError::Network { got, expected: "finite numbers".into() });
        }
        self.parameters.copy_from_slice(parameters);
        let (mut blocks, mut left) = (self.blocks.iter_mut(), parameters);
        for pair in self.sizes.windows(2) {
            let (weights, rest) = left.split_at(pair[0] * pair[1]);
            let (biases, rest) = rest.split_at(pair[1]);
            left = rest;
            for row in std::iter::once(biases).chain(weights.chunks_exact(pair[1])) {
                for (chunk, block) in row.chunks(BLOCK).zip(&mut blocks) {
                    block[..chunk.len()].copy_from_slice(chunk);
                }
            }
        }
        Ok(())
    }

    /// Computes the outputs for rows of inputs.
    ///
    /// # Panics
    /// If the slices do not have the same number of complete rows.
    pub fn forward(&self, input: &[f32], output: &mut [f32]) {
        let (inputs, outputs) = (self.inputs(), self.outputs());
        let rows = input.len() / inputs;
        assert!(
            input.len() == rows * inputs && output.len() == rows * outputs,
            "expected one output row per input row"
        );
        pulp::Arch::new().dispatch(Forward { net: self, input, output });
    }
}

/// A forward pass over rows of inputs. No operation is fused or reordered, so the result is bit-identical for all
/// instruction sets.
struct Forward<'a> {
    net: &'a Mlp,
    input: &'a [f32],
    output: &'a mut [f32],
}

impl WithSimd for Forward<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let (inputs, outputs) = (self.net.inputs(), self.net.outputs());
        let groups = self.input.chunks(ROWS * inputs).zip(self.output.chunks_mut(ROWS * outputs));
        // a layer reads only what the layer before has written
        let mut buffers = [[[0.0; Mlp::MAX_WIDTH]; ROWS]; 2];
        for (input, output) in groups {
            if input.len() == ROWS * inputs {
                rows::<S, ROWS>(simd, self.net, &mut buffers, input, output);
            } else {
                let mut buffers = [[[0.0; Mlp::MAX_WIDTH]]; 2];
                for (input, output) in input.chunks_exact(inputs).zip(output.chunks_exact_mut(outputs)) {
                    rows::<S, 1>(simd, self.net, &mut buffers, input, output);
                }
            }
        }
    }
}

/// Activations of R rows.
pub(super) type Activations<const R: usize> = [[f32; Mlp::MAX_WIDTH]; R];

#[inline(always)]
fn rows<S: Simd, const R: usize>(
    simd: S,
    net: &Mlp,
    [first, second]: &mut [Activations<R>; 2],
    input: &[f32],
    output: &mut [f32],
) {
    let (mut here, mut next) = (first, second);
    for (row, input) in here.iter_mut().zip(input.chunks_exact(net.inputs())) {
        row[..input.len()].copy_from_slice(input);
    }
    let mut left = net.blocks.as_flattened();
    for pair in net.sizes.windows(2) {
        let wide = pair[1].next_multiple_of(BLOCK);
        let (layer, rest) = left.split_at((pair[0] + 1) * wide);
        left = rest;
        let (layer, _) = S::as_simd_f32s(layer);
        let wide = wide / S::F32_LANES;
        let activation = (!rest.is_empty()).then_some(net.activation);
        let mut column = 0;
        while column + 2 <= wide {
            columns::<S, R, 2, { Mlp::MAX_WIDTH }>(simd, layer, wide, column, pair[0], activation, here, next);
            column += 2;
        }
        if column < wide {
            columns::<S, R, 1, { Mlp::MAX_WIDTH }>(simd, layer, wide, column, pair[0], activation, here, next);
        }
        std::mem::swap(&mut here, &mut next);
    }
    for (row, output) in here.iter().zip(output.chunks_exact_mut(net.outputs())) {
        output.copy_from_slice(&row[..output.len()]);
    }
}

/// Computes C registers of neurons of a layer for R rows.
#[inline(always)]
#[allow(clippy::too_many_arguments)]
pub(super) fn columns<S: Simd, const R: usize, const C: usize, const W: usize>(
    simd: S,
    layer: &[S::f32s],
    wide: usize,
    column: usize,
    inputs: usize,
    activation: Option<Activation>,
    here: &Activations<R>,
    next: &mut [[f32; W]; R],
) {
    let mut sums = [std::array::from_fn::<_, C, _>(|c| layer[column + c]); R];
    for (input, weights) in layer[wide..].chunks_exact(wide).enumerate().take(inputs) {
        let weights: [S::f32s; C] = std::array::from_fn(|c| weights[column + c]);
        for (sums, row) in sums.iter_mut().zip(here) {
            let x = simd.splat_f32s(row[input % Mlp::MAX_WIDTH]);
            for (sum, weight) in sums.iter_mut().zip(weights) {
                *sum = simd.add_f32s(*sum, simd.mul_f32s(x, weight));
            }
        }
    }
    let (zero, one) = (simd.splat_f32s(0.0), simd.splat_f32s(1.0));
    for (sums, row) in sums.iter().zip(next) {
        let (row, _) = S::as_mut_simd_f32s(row);
        for (c, &sum) in sums.iter().enumerate() {
            row[column + c] = match activation {
                None => sum,
                Some(Activation::Relu) => simd.max_f32s(zero, sum),
                Some(Activation::Softsign) => simd.div_f32s(sum, simd.add_f32s(one, simd.abs_f32s(sum))),
            };
        }
    }
}

fn check_sizes(sizes: &[usize]) -> Result<(), PolicyError> {
    let layers = 2..=Mlp::MAX_LAYERS + 1;
    if layers.contains(&sizes.len()) && sizes.iter().all(|size| (1..=Mlp::MAX_WIDTH).contains(size)) {
        return Ok(());
    }
    let expected = format!("up to {} layers, each of 1 to {} neurons", Mlp::MAX_LAYERS, Mlp::MAX_WIDTH);
    Err(PolicyError::Network { got: format!("layers of {sizes:?}"), expected })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Computes a forward pass in double precision, without blocks.
    fn in_double_precision(sizes: &[usize], activation: Activation, parameters: &[f32], input: &[f32]) -> Vec<f64> {
        let mut here: Vec<f64> = input.iter().map(|&x| f64::from(x)).collect();
        let mut start = 0;
        for (layer, pair) in sizes.windows(2).enumerate() {
            let weight = |i: usize, j: usize| f64::from(parameters[start + i * pair[1] + j]);
            let bias = |j: usize| f64::from(parameters[start + pair[0] * pair[1] + j]);
            let sum = |j: usize| bias(j) + (0..pair[0]).map(|i| here[i] * weight(i, j)).sum::<f64>();
            let last = layer + 2 == sizes.len();
            let act = |x: f64| match activation {
                _ if last => x,
                Activation::Relu => x.max(0.0),
                Activation::Softsign => x / (1.0 + x.abs()),
            };
            let next = (0..pair[1]).map(|j| act(sum(j))).collect();
            start += (pair[0] + 1) * pair[1];
            here = next;
        }
        here
    }

    fn network() -> impl Strategy<Value = (Vec<usize>, Activation, Vec<f32>)> {
        let activation = prop_oneof![Just(Activation::Relu), Just(Activation::Softsign)];
        (proptest::collection::vec(1..70_usize, 2..5), activation).prop_flat_map(|(sizes, activation)| {
            let parameters = proptest::collection::vec(-0.5_f32..0.5, Mlp::count(&sizes));
            (Just(sizes), Just(activation), parameters)
        })
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        #[test]
        fn outputs_match_double_precision_and_do_not_depend_on_the_batch(
            (sizes, activation, parameters) in network(),
            rows in 1..11_usize,
            seed in 0..1000_u32,
        ) {
            let net = Mlp::new(&sizes, activation, &parameters).unwrap();
            let value = |k: usize| ((k as u32 * 7919 + seed) % 1000) as f32 / 250.0 - 2.0;
            let input: Vec<f32> = (0..rows * sizes[0]).map(value).collect();
            let mut output = vec![0.0; rows * net.outputs()];
            net.forward(&input, &mut output);
            for (input, output) in input.chunks(net.inputs()).zip(output.chunks(net.outputs())) {
                let mut alone = vec![0.0; output.len()];
                net.forward(input, &mut alone);
                prop_assert_eq!(&alone, output);
                let wanted = in_double_precision(&sizes, activation, &parameters, input);
                for (x, wanted) in output.iter().zip(wanted) {
                    prop_assert!((f64::from(*x) - wanted).abs() <= 1e-4 * (1.0 + wanted.abs()), "{} {}", x, wanted);
                }
            }
        }
    }

    #[test]
    fn invalid_networks_are_rejected_with_the_reason() {
        let refused = |sizes: &[usize], parameters: &[f32]| {
            Mlp::new(sizes, Activation::Relu, parameters).unwrap_err().to_string()
        };
        assert!(refused(&[2], &[]).contains("layers of [2]"));
        assert!(refused(&[2, 0], &[]).contains("layers of [2, 0]"));
        assert!(refused(&[2, 300], &[]).contains("1 to 256 neurons"));
        assert!(refused(&[1, 1], &[1.0]).contains("1 parameters, expected 2"));
        assert!(refused(&[1, 1], &[1.0, f32::NAN]).contains("NaN as parameter 1"));
    }
}
