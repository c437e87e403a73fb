use aviary::policy::Activation;
use pulp::Simd;

use super::layer::{Layer, LayerGradient};
use super::{Aligned, TILE, padded};

/// Parameters of a multilayer perceptron, arranged for forward and backward passes.
#[derive(Debug)]
pub(crate) struct Network {
    layers: Vec<Layer>,
    activation: Activation,
}

impl Network {
    /// Creates a network of zeros from the sizes of its layers, input first.
    pub fn new(sizes: &[usize], activation: Activation) -> Self {
        Self { layers: sizes.windows(2).map(|pair| Layer::new(pair[0], pair[1])).collect(), activation }
    }

    /// Sets the parameters, in the order of [`Mlp`](aviary::policy::Mlp).
    pub fn set(&mut self, parameters: &[f32]) {
        let mut left = parameters;
        for layer in &mut self.layers {
            let (weights, rest) = left.split_at(layer.inputs * layer.outputs);
            let (biases, rest) = rest.split_at(layer.outputs);
            layer.set(weights, biases);
            left = rest;
        }
    }
}

/// Buffers of forward and backward passes of a network over a tile, and the sum of gradients.
///
/// Rows of all matrices are [`padded`]; the padding of inputs and of gradients is zero.
#[derive(Debug)]
pub(crate) struct Pass {
    /// Outputs of every layer, TILE × outputs.
    outputs: Vec<Aligned>,
    /// Gradients with respect to the sums of every layer, TILE × outputs.
    gradients: Vec<Aligned>,
    sums: Vec<LayerGradient>,
}

impl Pass {
    /// Creates buffers for a network from the sizes of its layers, input first.
    pub fn new(sizes: &[usize]) -> Self {
        let tiles = || sizes[1..].iter().map(|&size| Aligned::new(TILE * padded(size))).collect();
        let sums = sizes.windows(2).map(|pair| LayerGradient::new(pair[0], pair[1])).collect();
        Self { outputs: tiles(), gradients: tiles(), sums }
    }

    /// Sets the sum of gradients to zero.
    pub fn clear(&mut self) {
        self.sums.iter_mut().for_each(LayerGradient::clear);
    }

    /// Computes the outputs for rows of inputs.
    #[inline(always)]
    pub fn forward<S: Simd>(&mut self, simd: S, network: &Network, rows: usize, input: &[f32]) {
        let last = network.layers.len() - 1;
        for (index, layer) in network.layers.iter().enumerate() {
            let (before, out) = self.outputs.split_at_mut(index);
            let input = before.last().map_or(input, |before| &before[..]);
            let activation = (index < last).then_some(network.activation);
            layer.forward(simd, rows, activation, input, &mut out[0]);
        }
    }

    /// Returns the outputs, and the gradient of the loss with respect to them, which the caller sets.
    #[inline(always)]
    pub fn ends(&mut self) -> (&[f32], &mut [f32]) {
        let last = self.outputs.len() - 1;
        (&self.outputs[last], &mut self.gradients[last])
    }

    /// Adds the gradients of the rows of the last forward pass to the sums.
    #[inline(always)]
    pub fn backward<S: Simd>(&mut self, simd: S, network: &Network, rows: usize, input: &[f32]) {
        for (index, layer) in network.layers.iter().enumerate().rev() {
            let (before, own) = self.gradients.split_at_mut(index);
            let input = if index == 0 { input } else { &self.outputs[index - 1][..] };
            self.sums[index].add(simd, rows, input, &own[0]);
            if let Some(before) = before.last_mut() {
                layer.backward(simd, rows, network.activation, &own[0], input, before);
            }
        }
    }

    /// Adds the gradients with respect to the inputs of the rows of the last backward pass.
    #[inline(always)]
    pub fn add_input_gradients<S: Simd>(&self, simd: S, network: &Network, rows: usize, out: &mut [f32]) {
        network.layers[0].add_backward(simd, rows, &self.gradients[0], out);
    }

    /// Writes the sums, in the order of the parameters. Returns the rest of `out`.
    pub fn write<'a>(&self, mut out: &'a mut [f32]) -> &'a mut [f32] {
        for sum in &self.sums {
            out = sum.write(out);
        }
        out
    }
}
