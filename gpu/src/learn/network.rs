//! Forward and backward passes of multilayer perceptrons: a thread computes all layers for a few rows of observations.
//!
//! Activations and gradients of a row are a column of a scratch matrix, whose rows are neurons, so that neighbouring
//! threads access neighbouring memory. All threads read the same weight at the same time. No thread waits for another.

use aviary::policy::{Activation, Mlp};
use cubecl::prelude::*;
use learn::{CLIP, NetworkShape};

/// Neurons that a thread computes at a time, in registers.
const BLOCK: usize = 8;

/// Columns of the scratch matrix that a thread computes: `first`, `first + stride`, …, as many as the comptime argument
/// of the functions.
#[derive(CubeType, Clone, Copy)]
pub(super) struct Columns {
    pub first: usize,
    pub stride: usize,
    /// Number of columns of the matrix.
    pub width: usize,
}

/// Actor or critic in a kernel: layer sizes, and the places of its parameters and of its rows of the scratch matrix.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(super) struct Network {
    sizes: Vec<usize>,
    activation: Activation,
    /// Index of the first parameter.
    first: usize,
    /// First row of the scratch matrix. The activations of all layers come first, input included, then the gradients
    /// with respect to the sums of all layers.
    row: usize,
}

impl Network {
    /// Returns the number of layers.
    pub fn layers(&self) -> usize {
        self.sizes.len() - 1
    }

    /// Returns the number of inputs.
    pub fn inputs(&self) -> usize {
        self.sizes[0]
    }

    /// Returns the number of outputs.
    pub fn outputs(&self) -> usize {
        self.sizes[self.layers()]
    }

    /// Returns the number of inputs and outputs of a layer, from 0 on.
    pub fn size(&self, layer: usize) -> [usize; 2] {
        [self.sizes[layer], self.sizes[layer + 1]]
    }

    /// Returns the index of the first parameter of a layer: weights, inputs × outputs, then biases.
    pub fn parameters(&self, layer: usize) -> usize {
        self.first + Mlp::count(&self.sizes[..=layer])
    }

    /// Returns the row of the first input of a layer; of the first output for the number of layers.
    pub fn values(&self, layer: usize) -> usize {
        self.row + self.sizes[..layer].iter().sum::<usize>()
    }

    /// Returns the row of the first gradient with respect to the sums of a layer.
    pub fn gradients(&self, layer: usize) -> usize {
        self.values(self.layers() + 1) + self.sizes[1..=layer].iter().sum::<usize>()
    }

    /// Returns the row after the last one.
    fn end(&self) -> usize {
        self.gradients(self.layers())
    }

    /// Returns what a kernel knows of a layer.
    fn layer(&self, layer: usize) -> Layer {
        let [inputs, outputs] = self.size(layer);
        Layer {
            inputs,
            outputs,
            weights: self.parameters(layer),
            biases: self.parameters(layer) + inputs * outputs,
            input: self.values(layer),
            output: self.values(layer + 1),
            gradient: self.gradients(layer),
            gradient_before: if layer > 0 { self.gradients(layer - 1) } else { 0 },
            hidden: layer + 1 < self.layers(),
            relu: self.activation == Activation::Relu,
        }
    }
}

/// Actor, critic and log standard deviations in a kernel.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(super) struct Networks {
    pub actor: Network,
    pub critic: Network,
}

impl Networks {
    /// Creates the description of a shape.
    pub fn new(shape: &NetworkShape) -> Self {
        let network =
            |sizes: &[usize], first, row| Network { sizes: sizes.to_vec(), activation: shape.activation, first, row };
        let actor = network(&shape.actor, 0, 0);
        let critic = network(&shape.critic, Mlp::count(&shape.actor), actor.end());
        Self { actor, critic }
    }

    /// Returns the number of entries of an observation.
    pub fn observation(&self) -> usize {
        self.actor.inputs()
    }

    /// Returns the number of entries of an action.
    pub fn action(&self) -> usize {
        self.actor.outputs()
    }

    /// Returns the index of the first log standard deviation.
    pub fn log_deviations(&self) -> usize {
        self.critic.parameters(self.critic.layers())
    }

    /// Returns the number of parameters.
    pub fn count(&self) -> usize {
        self.log_deviations() + self.action()
    }

    /// Returns the row of the first gradient with respect to the log standard deviations.
    pub fn log_gradients(&self) -> usize {
        self.critic.end()
    }

    /// Returns the row of ones, the input of biases.
    pub fn ones(&self) -> usize {
        self.log_gradients() + self.action()
    }

    /// Returns the number of rows of the scratch matrix.
    pub fn rows(&self) -> usize {
        self.ones() + 1
    }
}

/// A layer in a kernel: its sizes, the indices of its first parameters, and rows of the scratch matrix.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
struct Layer {
    inputs: usize,
    outputs: usize,
    weights: usize,
    biases: usize,
    input: usize,
    output: usize,
    gradient: usize,
    /// Row of the first gradient with respect to the sums of the layer before; unused for the first layer.
    gradient_before: usize,
    /// True for a layer with an activation function.
    hidden: bool,
    /// True for the rectifier, false for softsign.
    relu: bool,
}

/// Writes the normalized observation of a row to the inputs of a network. `scale` begins with the means and the
/// standard deviations.
#[cube]
pub(super) fn read_observation(
    observations: &[f32],
    scale: &[f32],
    scratch: &mut [f32],
    row: usize,
    column: usize,
    width: usize,
    #[comptime] size: usize,
    #[comptime] first: usize,
) {
    for entry in 0..size {
        let x = (observations[row * size + entry] - scale[entry]) / scale[size + entry];
        scratch[(first + entry) * width + column] = clamped(x, CLIP);
    }
}

/// Returns a number clamped to ±`max`.
#[cube]
pub(super) fn clamped(x: f32, #[comptime] max: f32) -> f32 {
    let low = select(x < -max, -max, x);
    select(low > max, max, low)
}

/// Computes the outputs of a network from its inputs, in columns of the scratch matrix; `forward::expand` emits its
/// operations.
#[allow(unused_variables)]
pub(super) fn forward(parameters: &[f32], scratch: &mut [f32], columns: &Columns, network: Network, per_thread: usize) {
    unreachable!("kernels run on the device")
}

pub(super) mod forward {
    use super::*;

    pub fn expand(
        scope: &Scope,
        parameters: &NativeExpand<[f32]>,
        scratch: &mut NativeExpand<[f32]>,
        columns: &ColumnsExpand,
        network: Network,
        per_thread: usize,
    ) {
        for layer in 0..network.layers() {
            apply_layer::expand(scope, parameters, scratch, columns, network.layer(layer), per_thread);
        }
    }
}

/// Computes the gradients with respect to the sums of all layers from those of the last one, in columns of the scratch
/// matrix; `backward::expand` emits its operations.
#[allow(unused_variables)]
pub(super) fn backward(
    parameters: &[f32],
    scratch: &mut [f32],
    columns: &Columns,
    network: Network,
    per_thread: usize,
) {
    unreachable!("kernels run on the device")
}

pub(super) mod backward {
    use super::*;

    pub fn expand(
        scope: &Scope,
        parameters: &NativeExpand<[f32]>,
        scratch: &mut NativeExpand<[f32]>,
        columns: &ColumnsExpand,
        network: Network,
        per_thread: usize,
    ) {
        for layer in (1..network.layers()).rev() {
            differentiate_layer::expand(scope, parameters, scratch, columns, network.layer(layer), per_thread);
        }
    }
}

#[cube]
fn apply_layer(
    parameters: &[f32],
    scratch: &mut [f32],
    columns: &Columns,
    #[comptime] layer: Layer,
    #[comptime] per_thread: usize,
) {
    let blocks = comptime!(layer.outputs / BLOCK);
    let rest = comptime!(layer.outputs % BLOCK);
    for block in 0..blocks {
        apply_block(parameters, scratch, columns, block * BLOCK, layer, BLOCK, per_thread);
    }
    if comptime!(rest > 0) {
        let first = comptime!(blocks * BLOCK).runtime();
        apply_block(parameters, scratch, columns, first, layer, rest, per_thread);
    }
}

/// Computes `size` outputs of a layer from `first` on.
#[cube]
fn apply_block(
    parameters: &[f32],
    scratch: &mut [f32],
    columns: &Columns,
    first: usize,
    #[comptime] layer: Layer,
    #[comptime] size: usize,
    #[comptime] per_thread: usize,
) {
    let (inputs, outputs) = comptime!((layer.inputs, layer.outputs));
    let (weights, biases) = comptime!((layer.weights, layer.biases));
    let (input, output) = comptime!((layer.input, layer.output));
    let mut sums = Array::<f32>::new(comptime!(size * per_thread));
    let mut x = Array::<f32>::new(per_thread);
    #[unroll]
    for k in 0..size {
        let bias = parameters[biases + first + k];
        #[unroll]
        for row in 0..per_thread {
            sums[k * per_thread + row] = bias;
        }
    }
    for i in 0..inputs {
        let place = (input + i) * columns.width + columns.first;
        #[unroll]
        for row in 0..per_thread {
            x[row] = scratch[place + row * columns.stride];
        }
        #[unroll]
        for k in 0..size {
            let weight = parameters[weights + i * outputs + first + k];
            #[unroll]
            for row in 0..per_thread {
                sums[k * per_thread + row] += x[row] * weight;
            }
        }
    }
    #[unroll]
    for k in 0..size {
        let place = (output + first + k) * columns.width + columns.first;
        #[unroll]
        for row in 0..per_thread {
            let mut y = sums[k * per_thread + row];
            if comptime!(layer.hidden) {
                if comptime!(layer.relu) {
                    y = select(y > 0.0, y, 0.0);
                } else {
                    y /= 1.0 + y.abs();
                }
            }
            scratch[place + row * columns.stride] = y;
        }
    }
}

#[cube]
fn differentiate_layer(
    parameters: &[f32],
    scratch: &mut [f32],
    columns: &Columns,
    #[comptime] layer: Layer,
    #[comptime] per_thread: usize,
) {
    let blocks = comptime!(layer.inputs / BLOCK);
    let rest = comptime!(layer.inputs % BLOCK);
    for block in 0..blocks {
        differentiate_block(parameters, scratch, columns, block * BLOCK, layer, BLOCK, per_thread);
    }
    if comptime!(rest > 0) {
        let first = comptime!(blocks * BLOCK).runtime();
        differentiate_block(parameters, scratch, columns, first, layer, rest, per_thread);
    }
}

/// Computes the gradients with respect to `size` sums of the layer before from `first` on.
#[cube]
fn differentiate_block(
    parameters: &[f32],
    scratch: &mut [f32],
    columns: &Columns,
    first: usize,
    #[comptime] layer: Layer,
    #[comptime] size: usize,
    #[comptime] per_thread: usize,
) {
    let (outputs, weights) = comptime!((layer.outputs, layer.weights));
    let (gradient, before, input) = comptime!((layer.gradient, layer.gradient_before, layer.input));
    let mut sums = Array::<f32>::new(comptime!(size * per_thread));
    let mut slope = Array::<f32>::new(per_thread);
    #[unroll]
    for k in 0..comptime!(size * per_thread) {
        sums[k] = 0.0;
    }
    for j in 0..outputs {
        let place = (gradient + j) * columns.width + columns.first;
        #[unroll]
        for row in 0..per_thread {
            slope[row] = scratch[place + row * columns.stride];
        }
        #[unroll]
        for k in 0..size {
            let weight = parameters[weights + (first + k) * outputs + j];
            #[unroll]
            for row in 0..per_thread {
                sums[k * per_thread + row] += slope[row] * weight;
            }
        }
    }
    #[unroll]
    for k in 0..size {
        let (from, to) = ((input + first + k) * columns.width, (before + first + k) * columns.width);
        #[unroll]
        for row in 0..per_thread {
            // the derivatives of the activations are functions of their values
            let column = columns.first + row * columns.stride;
            let y = scratch[from + column];
            let mut product = sums[k * per_thread + row];
            if comptime!(layer.relu) {
                product = select(y > 0.0, product, 0.0);
            } else {
                // y = x / (1 + |x|) has the derivative (1 − |y|)²
                let root = 1.0 - y.abs();
                product *= root * root;
            }
            scratch[to + column] = product;
        }
    }
}
