use aviary::policy::Activation;
use pulp::Simd;

use super::product::{Registers, Rows, Transpose, add_rows, multiply};
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
        let wide = padded(self.outputs);
        let left = Rows { data: input, stride: padded(self.inputs), depth: self.inputs };
        let right = Registers::new::<S>(&self.weights, wide);
        let (biases, _) = S::as_simd_f32s(&self.biases);
        let begin = |column: usize, _| biases[column];
        let (zero, one) = (simd.splat_f32s(0.0), simd.splat_f32s(1.0));
        let (shape, out) = ((rows, self.outputs), (out, wide));
        match activation {
            None => multiply(simd, shape, &left, right, out, begin, |_, sum| sum),
            Some(Activation::Relu) => {
                multiply(simd, shape, &left, right, out, begin, |_, sum| simd.max_f32s(zero, sum));
            }
            Some(Activation::Softsign) => multiply(simd, shape, &left, right, out, begin, |_, sum| {
                simd.div_f32s(sum, simd.add_f32s(one, simd.abs_f32s(sum)))
            }),
        }
    }

    /// Computes the gradient with respect to the sums of the layer before from the one with respect to this layer's
    /// outputs. `input` are the activations between the layers.
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
        let long = padded(self.inputs);
        let left = Rows { data: gradient, stride: padded(self.outputs), depth: self.outputs };
        let right = Registers::new::<S>(&self.transpose, long);
        let (input, _) = S::as_simd_f32s(input);
        let (zero, one) = (simd.splat_f32s(0.0), simd.splat_f32s(1.0));
        let (shape, out) = ((rows, self.inputs), (out, long));
        match activation {
            Activation::Relu => multiply(
                simd,
                shape,
                &left,
                right,
                out,
                |_, _| zero,
                |index, sum| simd.select_f32s(simd.less_than_f32s(zero, input[index]), sum, zero),
            ),
            // y = x / (1 + |x|) has the derivative (1 − |y|)²
            Activation::Softsign => multiply(
                simd,
                shape,
                &left,
                right,
                out,
                |_, _| zero,
                |index, sum| {
                    let root = simd.sub_f32s(one, simd.abs_f32s(input[index]));
                    simd.mul_f32s(sum, simd.mul_f32s(root, root))
                },
            ),
        }
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
        let (inputs, gradients) = (
            Transpose { data: input, stride: long, depth: rows },
            Transpose { data: gradient, stride: wide, depth: rows },
        );
        let (begin, finish) = (|_, sum| sum, |_, sum| sum);
        if self.transposed {
            let (shape, out) = ((self.outputs, self.inputs), (&mut *self.weights, long));
            multiply(simd, shape, &gradients, Registers::new::<S>(input, long), out, begin, finish);
        } else {
            let (shape, out) = ((self.inputs, self.outputs), (&mut *self.weights, wide));
            multiply(simd, shape, &inputs, Registers::new::<S>(gradient, wide), out, begin, finish);
        }
        add_rows(simd, rows, Registers::new::<S>(gradient, wide), &mut self.biases);
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
