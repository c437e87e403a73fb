use pulp::{Simd, WithSimd};

use super::gates::{sigmoid, tanh};
use super::mlp::{BLOCK, ROWS, columns};
use super::{Mlp, PolicyError};

/// A layer of gated recurrent units (GRU; Cho et al. 2014, in the variant of cuDNN, PyTorch and ONNX's
/// `linear_before_reset = 1`).
///
/// From an input x and a state h the layer computes the next state, with the logistic function σ:
///
/// ```text
/// r  = σ(W_ir x + b_ir + W_hr h + b_hr)             reset gate
/// z  = σ(W_iz x + b_iz + W_hz h + b_hz)             update gate
/// n  = tanh(W_in x + b_in + r ∘ (W_hn h + b_hn))    candidate
/// h' = (1 − z) ∘ n + z ∘ h
/// ```
///
/// The parameters are those of two linear layers in the order of [`Mlp`], one of the input and one of the state: the
/// weights of the input as a row-major matrix of inputs × 3·units, the biases of the input, the weights of the state
/// as a row-major matrix of units × 3·units, and the biases of the state. The columns of the matrices and the entries
/// of the biases belong to r, z and n, in this order. PyTorch's `weight_ih_l0` and `weight_hh_l0` are the transposes.
/// σ and tanh are [rational functions](super::gates) with an error below 4e-7. The state is bit-identical for a row
/// alone, in a batch and on every machine.
///
/// ```
/// use aviary::policy::Gru;
///
/// // one input, one unit: the update gate is σ(−20) ≈ 0, so that the state is tanh(x)
/// let gru = Gru::new(1, 1, &[0.0, 0.0, 1.0, 0.0, -20.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])?;
/// let mut state = [0.9];
/// gru.forward(&[0.5], &mut state);
/// assert!((state[0] - 0.5_f32.tanh()).abs() < 1e-6);
/// # Ok::<(), aviary::policy::PolicyError>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct Gru {
    inputs: usize,
    units: usize,
    parameters: Vec<f32>,
    /// Parameters for SIMD registers: the biases and the weights of the input, then those of the state. The three
    /// gates of a row are padded to whole blocks by zeros.
    blocks: Vec<[f32; BLOCK]>,
}

impl Gru {
    /// Maximum number of inputs and of units.
    pub const MAX_WIDTH: usize = Mlp::MAX_WIDTH;

    /// Returns the number of parameters of a layer.
    pub fn count(inputs: usize, units: usize) -> usize {
        (inputs + units + 2) * 3 * units
    }

    /// Creates a layer from its number of inputs and of units, and its parameters.
    ///
    /// # Errors
    /// [`PolicyError::Network`] for sizes out of range, a wrong number of parameters, or non-finite parameters.
    pub fn new(inputs: usize, units: usize, parameters: &[f32]) -> Result<Self, PolicyError> {
        let range = 1..=Self::MAX_WIDTH;
        if !(range.contains(&inputs) && range.contains(&units)) {
            return Err(PolicyError::Network {
                got: format!("{units} recurrent units with {inputs} inputs"),
                expected: format!("1 to {} of each", Self::MAX_WIDTH),
            });
        }
        let blocks = (inputs + units + 2) * 3 * units.div_ceil(BLOCK);
        let parameters_of = vec![0.0; Self::count(inputs, units)];
        let mut layer = Self { inputs, units, parameters: parameters_of, blocks: vec![[0.0; BLOCK]; blocks] };
        layer.set(parameters)?;
        Ok(layer)
    }

    /// Returns the number of inputs.
    pub fn inputs(&self) -> usize {
        self.inputs
    }

    /// Returns the number of units, which is the size of the state.
    pub fn units(&self) -> usize {
        self.units
    }

    /// Returns the parameters.
    pub fn parameters(&self) -> &[f32] {
        &self.parameters
    }

    /// Returns the weights of the input, inputs × 3·units.
    pub fn input_weights(&self) -> &[f32] {
        self.part(0, self.inputs)
    }

    /// Returns the biases of the input, 3·units.
    pub fn input_biases(&self) -> &[f32] {
        self.part(self.inputs, 1)
    }

    /// Returns the weights of the state, units × 3·units.
    pub fn state_weights(&self) -> &[f32] {
        self.part(self.inputs + 1, self.units)
    }

    /// Returns the biases of the state, 3·units.
    pub fn state_biases(&self) -> &[f32] {
        self.part(self.inputs + 1 + self.units, 1)
    }

    /// Returns rows of the parameters.
    fn part(&self, first: usize, rows: usize) -> &[f32] {
        &self.parameters[first * 3 * self.units..][..rows * 3 * self.units]
    }

    /// Sets the parameters.
    ///
    /// # Errors
    /// [`PolicyError::Network`] for a wrong number of parameters or non-finite ones, with the layer unchanged.
    pub fn set(&mut self, parameters: &[f32]) -> Result<(), PolicyError> {
        let expected = self.parameters.len();
        if parameters.len() != expected {
            let (got, units) = (format!("{} recurrent parameters", parameters.len()), self.units);
            let expected = format!("{expected} for {units} units with {} inputs", self.inputs);
            return Err(PolicyError::Network { got, expected });
        }
        if let Some((index, x)) = parameters.iter().enumerate().find(|(_, x)| !x.is_finite()) {
            let got = format!("{x} as recurrent parameter {index}");
            return Err(PolicyError::Network { got, expected: "finite numbers".into() });
        }
        self.parameters.copy_from_slice(parameters);
        let (inputs, units) = (self.inputs, self.units);
        let (of_input, of_state) = parameters.split_at((inputs + 1) * 3 * units);
        let mut blocks = self.blocks.iter_mut();
        for (part, rows) in [(of_input, inputs), (of_state, units)] {
            let (weights, biases) = part.split_at(rows * 3 * units);
            for gate in biases.chunks_exact(units).chain(weights.chunks_exact(units)) {
                for (chunk, block) in gate.chunks(BLOCK).zip(&mut blocks) {
                    block[..chunk.len()].copy_from_slice(chunk);
                }
            }
        }
        Ok(())
    }

    /// Replaces rows of states by the next states for rows of inputs.
    ///
    /// # Panics
    /// If the slices do not have the same number of complete rows.
    pub fn forward(&self, input: &[f32], state: &mut [f32]) {
        let rows = input.len() / self.inputs;
        assert!(
            input.len() == rows * self.inputs && state.len() == rows * self.units,
            "expected one row of the state per input row"
        );
        pulp::Arch::new().dispatch(Forward { gru: self, input, state });
    }
}

/// A step of rows. No operation is fused or reordered, so the result is bit-identical for all instruction sets.
struct Forward<'a> {
    gru: &'a Gru,
    input: &'a [f32],
    state: &'a mut [f32],
}

/// Length of a row of the sums of three gates.
const GATES: usize = 3 * Gru::MAX_WIDTH;

/// Buffers for R rows.
struct Buffers<const R: usize> {
    input: [[f32; Gru::MAX_WIDTH]; R],
    state: [[f32; Gru::MAX_WIDTH]; R],
    /// Sums of the gates, of the input and of the state.
    sums: [[[f32; GATES]; R]; 2],
}

impl<const R: usize> Buffers<R> {
    const ZERO: Self =
        Self { input: [[0.0; Gru::MAX_WIDTH]; R], state: [[0.0; Gru::MAX_WIDTH]; R], sums: [[[0.0; GATES]; R]; 2] };
}

impl WithSimd for Forward<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Gru { inputs, units, .. } = *self.gru;
        let groups = ROWS * inputs * (self.input.len() / (ROWS * inputs));
        let (input, input_rest) = self.input.split_at(groups);
        let (state, state_rest) = self.state.split_at_mut(groups / inputs * units);
        if !input.is_empty() {
            let mut buffers = Buffers::<ROWS>::ZERO;
            for (input, state) in input.chunks_exact(ROWS * inputs).zip(state.chunks_exact_mut(ROWS * units)) {
                step::<S, ROWS>(simd, self.gru, &mut buffers, input, state);
            }
        }
        if !input_rest.is_empty() {
            let mut buffers = Buffers::<1>::ZERO;
            for (input, state) in input_rest.chunks_exact(inputs).zip(state_rest.chunks_exact_mut(units)) {
                step::<S, 1>(simd, self.gru, &mut buffers, input, state);
            }
        }
    }
}

/// Computes the next states of R rows.
#[inline(always)]
// an iterator may not be inlined into a function with other instructions
#[allow(clippy::needless_range_loop)]
fn step<S: Simd, const R: usize>(simd: S, gru: &Gru, buffers: &mut Buffers<R>, input: &[f32], state: &mut [f32]) {
    let Buffers { input: inputs, state: states, sums: [of_input, of_state] } = buffers;
    for (row, input) in inputs.iter_mut().zip(input.chunks_exact(gru.inputs)) {
        row[..input.len()].copy_from_slice(input);
    }
    for (row, state) in states.iter_mut().zip(state.chunks_exact(gru.units)) {
        row[..state.len()].copy_from_slice(state);
    }
    let wide = gru.units.next_multiple_of(BLOCK);
    let (first, second) = gru.blocks.as_flattened().split_at((gru.inputs + 1) * 3 * wide);
    linear(simd, first, 3 * wide, gru.inputs, inputs, of_input);
    linear(simd, second, 3 * wide, gru.units, states, of_state);
    let (wide, one) = (wide / S::F32_LANES, simd.splat_f32s(1.0));
    for ((states, of_input), of_state) in states.iter_mut().zip(&*of_input).zip(&*of_state) {
        let (states, _) = S::as_mut_simd_f32s(states);
        let ((x, _), (h, _)) = (S::as_simd_f32s(of_input), S::as_simd_f32s(of_state));
        for column in 0..wide {
            let (r, z, n) = (column, wide + column, 2 * wide + column);
            let reset = sigmoid(simd, simd.add_f32s(x[r], h[r]));
            let update = sigmoid(simd, simd.add_f32s(x[z], h[z]));
            let candidate = tanh(simd, simd.add_f32s(x[n], simd.mul_f32s(reset, h[n])));
            let added = simd.mul_f32s(simd.sub_f32s(one, update), candidate);
            states[column] = simd.add_f32s(added, simd.mul_f32s(update, states[column]));
        }
    }
    for (row, state) in states.iter().zip(state.chunks_exact_mut(gru.units)) {
        state.copy_from_slice(&row[..state.len()]);
    }
}

/// Computes the sums of a linear layer with `wide` outputs for R rows.
#[inline(always)]
fn linear<S: Simd, const R: usize>(
    simd: S,
    layer: &[f32],
    wide: usize,
    inputs: usize,
    here: &[[f32; Gru::MAX_WIDTH]; R],
    out: &mut [[f32; GATES]; R],
) {
    let (layer, _) = S::as_simd_f32s(layer);
    let wide = wide / S::F32_LANES;
    let mut column = 0;
    while column + 2 <= wide {
        columns::<S, R, 2, GATES>(simd, layer, wide, column, inputs, None, here, out);
        column += 2;
    }
    if column < wide {
        columns::<S, R, 1, GATES>(simd, layer, wide, column, inputs, None, here, out);
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Computes the next state by the equations of the layer, in double precision.
    fn in_double_precision(inputs: usize, units: usize, parameters: &[f32], input: &[f32], state: &[f32]) -> Vec<f64> {
        let sums = |parameters: &[f32], input: &[f32]| -> Vec<f64> {
            let at = |row: usize, column: usize| f64::from(parameters[row * 3 * units + column]);
            let sum = |column| {
                let each = input.iter().enumerate().map(|(row, &x)| f64::from(x) * at(row, column));
                at(input.len(), column) + each.sum::<f64>()
            };
            (0..3 * units).map(sum).collect()
        };
        let (of_input, of_state) = parameters.split_at((inputs + 1) * 3 * units);
        let (x, h) = (sums(of_input, input), sums(of_state, state));
        let sigmoid = |x: f64| 1.0 / (1.0 + (-x).exp());
        let next = |unit: usize| {
            let reset = sigmoid(x[unit] + h[unit]);
            let update = sigmoid(x[units + unit] + h[units + unit]);
            let candidate = (x[2 * units + unit] + reset * h[2 * units + unit]).tanh();
            (1.0 - update) * candidate + update * f64::from(state[unit])
        };
        (0..units).map(next).collect()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        #[test]
        fn states_match_the_equations_and_do_not_depend_on_the_batch(
            inputs in 1..30_usize,
            units in 1..40_usize,
            rows in 1..11_usize,
            seed in 0..1000_u32,
        ) {
            let value = |k: usize| ((k as u32 * 7919 + seed) % 1000) as f32 / 500.0 - 1.0;
            let parameters: Vec<f32> = (0..Gru::count(inputs, units)).map(value).collect();
            let gru = Gru::new(inputs, units, &parameters).unwrap();
            let input: Vec<f32> = (0..rows * inputs).map(|k| 2.0 * value(3 * k + 1)).collect();
            let before: Vec<f32> = (0..rows * units).map(|k| value(7 * k + 5)).collect();
            let mut state = before.clone();
            gru.forward(&input, &mut state);
            let rows = input.chunks(inputs).zip(before.chunks(units)).zip(state.chunks(units));
            for ((input, before), state) in rows {
                let mut alone = before.to_vec();
                gru.forward(input, &mut alone);
                prop_assert_eq!(&alone, state);
                for (x, wanted) in state.iter().zip(in_double_precision(inputs, units, &parameters, input, before)) {
                    prop_assert!((f64::from(*x) - wanted).abs() <= 2e-5, "{} {}", x, wanted);
                }
            }
        }
    }

    #[test]
    fn invalid_layers_are_rejected_with_the_reason() {
        let refused = |inputs, units, parameters: &[f32]| Gru::new(inputs, units, parameters).unwrap_err().to_string();
        assert!(refused(2, 0, &[]).contains("0 recurrent units with 2 inputs"));
        assert!(refused(300, 1, &[]).contains("1 to 256 of each"));
        assert!(refused(1, 1, &[1.0]).contains("1 recurrent parameters, expected 12"));
        let mut parameters = [0.0; 12];
        parameters[7] = f32::NAN;
        assert!(refused(1, 1, &parameters).contains("NaN as recurrent parameter 7"));
    }

    #[test]
    fn accessors_return_the_parts_in_order() {
        let parameters: Vec<f32> = (0..Gru::count(2, 3)).map(|k| k as f32).collect();
        let gru = Gru::new(2, 3, &parameters).unwrap();
        let parts = [gru.input_weights(), gru.input_biases(), gru.state_weights(), gru.state_biases()];
        assert_eq!(parts.map(<[f32]>::len), [2 * 9, 9, 3 * 9, 9]);
        assert_eq!(parts.concat(), parameters);
    }
}
