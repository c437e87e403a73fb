// the inner loops use indices, because the compiler does not always inline iterators (see `product`)
#![allow(clippy::needless_range_loop)]

use aviary::policy::gates::{sigmoid, tanh};
use pulp::Simd;

use super::layer::{Layer, LayerGradient};
use super::{Aligned, padded};

/// Parameters of a [`Gru`](aviary::policy::Gru), arranged for forward and backward passes: two linear layers, whose
/// outputs are the sums of the three gates, each [`padded`].
#[derive(Debug)]
pub(crate) struct Recurrent {
    inputs: usize,
    units: usize,
    of_input: Layer,
    of_state: Layer,
    /// Weights and biases of a layer with padded gates.
    spread: Vec<f32>,
}

impl Recurrent {
    /// Creates a layer of zeros.
    pub fn new(inputs: usize, units: usize) -> Self {
        let gates = 3 * padded(units);
        let (of_input, of_state) = (Layer::new(inputs, gates), Layer::new(units, gates));
        Self { inputs, units, of_input, of_state, spread: Vec::new() }
    }

    /// Sets the parameters, in the order of [`Gru`](aviary::policy::Gru).
    pub fn set(&mut self, parameters: &[f32]) {
        let (units, wide) = (self.units, padded(self.units));
        let (of_input, of_state) = parameters.split_at((self.inputs + 1) * 3 * units);
        for (layer, parameters) in [(&mut self.of_input, of_input), (&mut self.of_state, of_state)] {
            self.spread.clear();
            self.spread.resize((layer.inputs + 1) * 3 * wide, 0.0);
            for (gate, own) in self.spread.chunks_exact_mut(wide).zip(parameters.chunks_exact(units)) {
                gate[..units].copy_from_slice(own);
            }
            let (weights, biases) = self.spread.split_at(layer.inputs * 3 * wide);
            layer.set(weights, biases);
        }
    }
}

/// Rows of a tile of sequences: the sequences of the first step, then those of the second, and so on.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Tile<'a> {
    /// Number of sequences.
    pub count: usize,
    /// Inputs of the layer, with padded rows.
    pub input: &'a [f32],
    /// True for rows after which the episode ends, so that the next state is zero.
    pub has_ended: &'a [bool],
}

/// Rows of features, which contain the states from an entry on.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Place {
    pub stride: usize,
    pub first: usize,
}

/// Buffers of forward and backward passes through time over a tile of sequences, and the sum of gradients.
#[derive(Debug)]
pub(crate) struct RecurrentPass {
    inputs: usize,
    units: usize,
    /// Sums of the input; after the forward pass the gates r, z and n; after the backward pass the gradients with
    /// respect to the sums of the input.
    gates: Aligned,
    /// Sums of the state, and after the backward pass the gradients with respect to them.
    sums: Aligned,
    /// States before every step.
    before: Aligned,
    /// States after a step, and gradients with respect to them.
    state: Aligned,
    of_input: LayerGradient,
    of_state: LayerGradient,
    /// Gradient of a layer with padded gates.
    spread: Vec<f32>,
}

impl RecurrentPass {
    /// Creates buffers for a number of rows, which is the product of sequences and steps.
    pub fn new(inputs: usize, units: usize, rows: usize) -> Self {
        let wide = padded(units);
        Self {
            inputs,
            units,
            gates: Aligned::new(rows * 3 * wide),
            sums: Aligned::new(rows * 3 * wide),
            before: Aligned::new(rows * wide),
            state: Aligned::new(rows * wide),
            of_input: LayerGradient::new(inputs, 3 * wide),
            of_state: LayerGradient::new(units, 3 * wide),
            spread: Vec::new(),
        }
    }

    /// Sets the sum of gradients to zero.
    pub fn clear(&mut self) {
        self.of_input.clear();
        self.of_state.clear();
    }

    /// Sets the state of a sequence before the first step.
    pub fn start(&mut self, sequence: usize, state: &[f32]) {
        self.before[sequence * padded(self.units)..][..state.len()].copy_from_slice(state);
    }

    /// Computes the states after every step, and writes them into rows of features.
    #[inline(always)]
    pub fn forward<S: Simd>(&mut self, simd: S, layer: &Recurrent, tile: Tile<'_>, features: &mut [f32], place: Place) {
        let Tile { count, input, has_ended } = tile;
        let (units, wide, one) = (self.units, padded(self.units), simd.splat_f32s(1.0));
        layer.of_input.forward(simd, has_ended.len(), None, input, &mut self.gates);
        for first in (0..has_ended.len()).step_by(count) {
            layer.of_state.forward(simd, count, None, &self.before[first * wide..], &mut self.sums[first * 3 * wide..]);
            for row in first..first + count {
                let (gates, _) = S::as_mut_simd_f32s(&mut self.gates[row * 3 * wide..][..3 * wide]);
                let (sums, _) = S::as_simd_f32s(&self.sums[row * 3 * wide..][..3 * wide]);
                let (before, _) = S::as_simd_f32s(&self.before[row * wide..][..wide]);
                let (after, _) = S::as_mut_simd_f32s(&mut self.state[(row - first) * wide..][..wide]);
                let width = after.len();
                for column in 0..width {
                    let (r, z, n) = (column, width + column, 2 * width + column);
                    let reset = sigmoid(simd, simd.add_f32s(gates[r], sums[r]));
                    let update = sigmoid(simd, simd.add_f32s(gates[z], sums[z]));
                    let candidate = tanh(simd, simd.add_f32s(gates[n], simd.mul_f32s(reset, sums[n])));
                    (gates[r], gates[z], gates[n]) = (reset, update, candidate);
                    let added = simd.mul_f32s(simd.sub_f32s(one, update), candidate);
                    after[column] = simd.add_f32s(added, simd.mul_f32s(update, before[column]));
                }
                let after = &self.state[(row - first) * wide..][..wide];
                features[row * place.stride + place.first..][..units].copy_from_slice(&after[..units]);
                if first + count < has_ended.len() {
                    let next = &mut self.before[(row + count) * wide..][..wide];
                    if has_ended[row] { next.fill(0.0) } else { next.copy_from_slice(after) }
                }
            }
        }
    }

    /// Adds the gradients of the rows of the last forward pass to the sums, from the gradients with respect to the
    /// features. The state before the first step is a constant.
    #[inline(always)]
    pub fn backward<S: Simd>(
        &mut self,
        simd: S,
        layer: &Recurrent,
        tile: Tile<'_>,
        feature_gradients: &[f32],
        place: Place,
    ) {
        let Tile { count, input, has_ended } = tile;
        let (units, wide, one) = (self.units, padded(self.units), simd.splat_f32s(1.0));
        self.state[..count * wide].fill(0.0);
        for first in (0..has_ended.len()).step_by(count).rev() {
            for row in first..first + count {
                let gradient = &mut self.state[(row - first) * wide..][..wide];
                if has_ended[row] {
                    // the next state belongs to another episode
                    gradient.fill(0.0);
                }
                let own = &feature_gradients[row * place.stride + place.first..][..units];
                for (sum, x) in gradient.iter_mut().zip(own) {
                    *sum += x;
                }
                let (gradient, _) = S::as_mut_simd_f32s(gradient);
                let (gates, _) = S::as_mut_simd_f32s(&mut self.gates[row * 3 * wide..][..3 * wide]);
                let (sums, _) = S::as_mut_simd_f32s(&mut self.sums[row * 3 * wide..][..3 * wide]);
                let (before, _) = S::as_simd_f32s(&self.before[row * wide..][..wide]);
                let width = gradient.len();
                for column in 0..width {
                    let (r, z, n) = (column, width + column, 2 * width + column);
                    let (own, before) = (gradient[column], before[column]);
                    let (reset, update, candidate) = (gates[r], gates[z], gates[n]);
                    // σ' = σ (1 − σ) and tanh' = 1 − tanh²
                    let slope = simd.sub_f32s(one, simd.mul_f32s(candidate, candidate));
                    let of_candidate = simd.mul_f32s(simd.mul_f32s(own, simd.sub_f32s(one, update)), slope);
                    let slope = simd.mul_f32s(reset, simd.sub_f32s(one, reset));
                    let of_reset = simd.mul_f32s(simd.mul_f32s(of_candidate, sums[n]), slope);
                    let slope = simd.mul_f32s(update, simd.sub_f32s(one, update));
                    let of_update = simd.mul_f32s(simd.mul_f32s(own, simd.sub_f32s(before, candidate)), slope);
                    gradient[column] = simd.mul_f32s(own, update);
                    (gates[r], gates[z], gates[n]) = (of_reset, of_update, of_candidate);
                    (sums[r], sums[z], sums[n]) = (of_reset, of_update, simd.mul_f32s(of_candidate, reset));
                }
            }
            layer.of_state.add_backward(simd, count, &self.sums[first * 3 * wide..], &mut self.state);
        }
        self.of_input.add(simd, has_ended.len(), input, &self.gates);
        self.of_state.add(simd, has_ended.len(), &self.before, &self.sums);
    }

    /// Writes the sums, in the order of the parameters. Returns the rest of `out`.
    pub fn write<'a>(&mut self, mut out: &'a mut [f32]) -> &'a mut [f32] {
        let (units, wide) = (self.units, padded(self.units));
        for (sum, inputs) in [(&self.of_input, self.inputs), (&self.of_state, self.units)] {
            self.spread.resize((inputs + 1) * 3 * wide, 0.0);
            sum.write(&mut self.spread);
            let (own, rest) = out.split_at_mut((inputs + 1) * 3 * units);
            for (own, gate) in own.chunks_exact_mut(units).zip(self.spread.chunks_exact(wide)) {
                own.copy_from_slice(&gate[..units]);
            }
            out = rest;
        }
        out
    }
}
