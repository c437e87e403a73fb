use aviary::policy::Activation;
use pulp::Simd;

use super::product::{Ends, Product, Rows, Transpose, add_rows};
use super::{Aligned, padded};

/// Linear layer. Rows of all matrices are padded with zeros.
#[derive(Debug)]
pub(super) struct Layer {
    pub inputs: usize,
    pub outputs: usize,
    /// Weights, inputs × outputs.
    weights: Aligned,
    biases: Aligned,
    /// Weights, outputs × inputs.
    transpose: Aligned,
}

/// Gradient of a layer, summed over rows.
#[derive(Debug)]
pub(super) struct LayerGradient {
    inputs: usize,
    outputs: usize,
    /// Gradient of the weights, inputs × outputs, or outputs × inputs if `transposed`.
    weights: Aligned,
    biases: Aligned,
    /// True if there are so few outputs that registers hold inputs.
    transposed: bool,
}

impl Layer {
    pub fn new(inputs: usize, outputs: usize) -> Self {
        Self {
            inputs,
            outputs,
            weights: Aligned::new(inputs * padded(outputs)),
            biases: Aligned::new(padded(outputs)),
            transpose: Aligned::new(outputs * padded(inputs)),
        }
    }

    /// Sets weights and biases.
    pub fn set(&mut self, weights: &[f32], biases: &[f32]) {
        let (wide, long) = (padded(self.outputs), padded(self.inputs));
        for (i, (own, row)) in self.weights.chunks_exact_mut(wide).zip(weights.chunks_exact(self.outputs)).enumerate() {
            own[..row.len()].copy_from_slice(row);
            for (own, weight) in self.transpose.chunks_exact_mut(long).zip(row) {
                own[i] = *weight;
            }
        }
        self.biases[..biases.len()].copy_from_slice(biases);
    }

    /// Computes the outputs of rows of inputs.
    #[inline(always)]
    pub fn forward<S: Simd>(
        &self,
        simd: S,
        rows: usize,
        activation: Option<Activation>,
        input: &[f32],
        out: &mut [f32],
    ) {
        let product = Product {
            simd,
            shape: (rows, self.outputs),
            left: Rows { data: input, stride: padded(self.inputs), depth: self.inputs },
            right: &self.weights,
            stride: padded(self.outputs),
            ends: Activate::<S> { biases: S::as_simd_f32s(&self.biases).0, activation },
        };
        product.write(out);
    }

    /// Computes the gradient with respect to the sums of the layer before from the one with respect to this layer's
    /// sums. `input` are the activations between the layers.
    #[inline(always)]
    pub fn backward<S: Simd>(
        &self,
        simd: S,
        rows: usize,
        activation: Activation,
        gradient: &[f32],
        input: &[f32],
        out: &mut [f32],
    ) {
        let product = Product {
            simd,
            shape: (rows, self.inputs),
            left: Rows { data: gradient, stride: padded(self.outputs), depth: self.outputs },
            right: &self.transpose,
            stride: padded(self.inputs),
            ends: Differentiate::<S> { values: S::as_simd_f32s(input).0, activation },
        };
        product.write(out);
    }
}

impl Layer {
    /// Adds the gradient with respect to the inputs of the layer, computed from the one with respect to its sums.
    #[inline(always)]
    pub fn add_backward<S: Simd>(&self, simd: S, rows: usize, gradient: &[f32], out: &mut [f32]) {
        let product = Product {
            simd,
            shape: (rows, self.inputs),
            left: Rows { data: gradient, stride: padded(self.outputs), depth: self.outputs },
            right: &self.transpose,
            stride: padded(self.inputs),
            ends: Continue,
        };
        product.write(out);
    }
}

/// Sums that begin with the biases; the results are activations.
#[derive(Clone, Copy)]
struct Activate<'a, S: Simd> {
    biases: &'a [S::f32s],
    activation: Option<Activation>,
}

impl<S: Simd> Ends<S> for Activate<'_, S> {
    #[inline(always)]
    fn begin(self, _: S, column: usize, _: S::f32s) -> S::f32s {
        self.biases[column]
    }

    #[inline(always)]
    fn end(self, simd: S, _: usize, sum: S::f32s) -> S::f32s {
        match self.activation {
            None => sum,
            Some(Activation::Relu) => simd.max_f32s(simd.splat_f32s(0.0), sum),
            Some(Activation::Softsign) => simd.div_f32s(sum, simd.add_f32s(simd.splat_f32s(1.0), simd.abs_f32s(sum))),
        }
    }
}

/// Sums that begin with zero; the results are multiplied by the derivatives of the activations.
#[derive(Clone, Copy)]
struct Differentiate<'a, S: Simd> {
    values: &'a [S::f32s],
    activation: Activation,
}

impl<S: Simd> Ends<S> for Differentiate<'_, S> {
    #[inline(always)]
    fn begin(self, simd: S, _: usize, _: S::f32s) -> S::f32s {
        simd.splat_f32s(0.0)
    }

    #[inline(always)]
    fn end(self, simd: S, index: usize, sum: S::f32s) -> S::f32s {
        let (value, zero) = (self.values[index], simd.splat_f32s(0.0));
        match self.activation {
            Activation::Relu => simd.select_f32s(simd.less_than_f32s(zero, value), sum, zero),
            // y = x / (1 + |x|) has the derivative (1 − |y|)²
            Activation::Softsign => {
                let root = simd.sub_f32s(simd.splat_f32s(1.0), simd.abs_f32s(value));
                simd.mul_f32s(sum, simd.mul_f32s(root, root))
            }
        }
    }
}

/// Sums that continue those of the output.
#[derive(Clone, Copy)]
struct Continue;

impl<S: Simd> Ends<S> for Continue {
    #[inline(always)]
    fn begin(self, _: S, _: usize, out: S::f32s) -> S::f32s {
        out
    }

    #[inline(always)]
    fn end(self, _: S, _: usize, sum: S::f32s) -> S::f32s {
        sum
    }
}

impl LayerGradient {
    pub fn new(inputs: usize, outputs: usize) -> Self {
        let transposed = outputs * padded(inputs) < inputs * padded(outputs);
        let weights = if transposed { outputs * padded(inputs) } else { inputs * padded(outputs) };
        let (weights, biases) = (Aligned::new(weights), Aligned::new(padded(outputs)));
        Self { inputs, outputs, weights, biases, transposed }
    }

    pub fn clear(&mut self) {
        self.weights.fill(0.0);
        self.biases.fill(0.0);
    }

    /// Adds the gradients of rows, from the inputs of the layer and the gradient with respect to its sums.
    #[inline(always)]
    pub fn add<S: Simd>(&mut self, simd: S, rows: usize, input: &[f32], gradient: &[f32]) {
        let (long, wide) = (padded(self.inputs), padded(self.outputs));
        if self.transposed {
            let product = Product {
                simd,
                shape: (self.outputs, self.inputs),
                left: Transpose { data: gradient, stride: wide, depth: rows },
                right: input,
                stride: long,
                ends: Continue,
            };
            product.write(&mut self.weights);
        } else {
            let product = Product {
                simd,
                shape: (self.inputs, self.outputs),
                left: Transpose { data: input, stride: long, depth: rows },
                right: gradient,
                stride: wide,
                ends: Continue,
            };
            product.write(&mut self.weights);
        }
        add_rows(simd, rows, gradient, &mut self.biases);
    }

    /// Writes the gradient of the weights, inputs × outputs, and of the biases. Returns the rest of `out`.
    pub fn write<'a>(&self, out: &'a mut [f32]) -> &'a mut [f32] {
        let (weights, rest) = out.split_at_mut(self.inputs * self.outputs);
        let (biases, rest) = rest.split_at_mut(self.outputs);
        if self.transposed {
            for (j, row) in self.weights.chunks_exact(padded(self.inputs)).enumerate() {
                for (weight, x) in weights[j..].iter_mut().step_by(self.outputs).zip(row) {
                    *weight = *x;
                }
            }
        } else {
            for (weights, row) in
                weights.chunks_exact_mut(self.outputs).zip(self.weights.chunks_exact(padded(self.outputs)))
            {
                weights.copy_from_slice(&row[..weights.len()]);
            }
        }
        biases.copy_from_slice(&self.biases[..biases.len()]);
        rest
    }
}
