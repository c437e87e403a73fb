//! Weights of eight bits, with one scale per neuron.

use aviary::policy::{Gru, Mlp, PolicyError, PolicyNetwork};

/// Largest magnitude of a rounded weight. The range is symmetric, without −128.
const LARGEST: f32 = 127.0;

/// Layer of a network with weights of eight bits: neuron j has the weights `scales[j]` · `weights[j][i]`.
#[derive(Debug, Clone, PartialEq)]
pub struct QuantizedLayer {
    /// Weights, outputs × inputs, row by row.
    pub weights: Vec<i8>,
    /// Scales of the neurons.
    pub scales: Vec<f32>,
    /// Biases of the neurons.
    pub biases: Vec<f32>,
}

/// Linear layer: its weights, outputs × inputs, and its biases.
pub(crate) struct Linear<'a> {
    pub inputs: usize,
    pub weights: Vec<f32>,
    pub biases: &'a [f32],
}

impl<'a> Linear<'a> {
    /// Creates a layer from weights that are inputs × outputs.
    fn new(weights: &[f32], biases: &'a [f32]) -> Self {
        let outputs = biases.len();
        let inputs = weights.len() / outputs;
        let entry = |index: usize| weights[index % inputs * outputs + index / inputs];
        Self { inputs, weights: (0..weights.len()).map(entry).collect(), biases }
    }

    /// Rounds the weights to eight bits.
    pub fn quantized(&self) -> QuantizedLayer {
        let rows = self.weights.chunks_exact(self.inputs);
        let scale = |row: &[f32]| row.iter().fold(0.0_f32, |largest, weight| largest.max(weight.abs())) / LARGEST;
        let scales: Vec<f32> = rows.clone().map(scale).collect();
        let round = |(row, &scale): (&[f32], &f32)| {
            // a neuron without weights, or with weights near the smallest number, has the scale 0
            let weight = move |weight: &f32| {
                if scale > 0.0 { (weight / scale).round().clamp(-LARGEST, LARGEST) as i8 } else { 0 }
            };
            row.iter().map(weight).collect::<Vec<_>>()
        };
        let weights = rows.zip(&scales).flat_map(round).collect();
        QuantizedLayer { weights, scales, biases: self.biases.to_vec() }
    }
}

/// Returns the layers of a network with the weights of a neuron next to each other.
pub(crate) fn layers(net: &Mlp) -> Vec<Linear<'_>> {
    let mut left = net.parameters();
    let layer = |pair: &[usize]| {
        let (weights, rest) = left.split_at(pair[0] * pair[1]);
        let (biases, rest) = rest.split_at(pair[1]);
        left = rest;
        Linear::new(weights, biases)
    };
    net.sizes().windows(2).map(layer).collect()
}

/// Returns the two linear layers of a recurrent layer: that of the input and that of the state.
pub(crate) fn layers_of_gru(gru: &Gru) -> [Linear<'_>; 2] {
    [Linear::new(gru.input_weights(), gru.input_biases()), Linear::new(gru.state_weights(), gru.state_biases())]
}

/// Rounds the weights of a network to eight bits. Biases stay in single precision.
///
/// The scale of a neuron is its largest weight over 127, so that the error of a weight is at most half a scale.
pub fn quantize(net: &Mlp) -> Vec<QuantizedLayer> {
    layers(net).iter().map(Linear::quantized).collect()
}

/// Returns the parameters of a layer after rounding, in the order of [`Mlp`]: weights, inputs × outputs, then biases.
fn rounded_parameters(layer: &Linear<'_>) -> Vec<f32> {
    let (inputs, outputs) = (layer.inputs, layer.biases.len());
    let QuantizedLayer { weights, scales, biases } = layer.quantized();
    let weight = |index: usize| {
        let (input, output) = (index / outputs, index % outputs);
        scales[output] * f32::from(weights[output * inputs + input])
    };
    (0..inputs * outputs).map(weight).chain(biases).collect()
}

/// Returns the policy with the weights that its quantized form has, in single precision, so that it can be evaluated
/// here.
///
/// # Errors
/// [`PolicyError::Network`] if a rounded weight is not finite.
pub fn rounded(policy: &PolicyNetwork) -> Result<PolicyNetwork, PolicyError> {
    let (mut net, mut recurrent) = (policy.net().clone(), policy.recurrent().cloned());
    let parameters: Vec<f32> = layers(policy.net()).iter().flat_map(rounded_parameters).collect();
    net.set(&parameters)?;
    if let (Some(rounded), Some(gru)) = (&mut recurrent, policy.recurrent()) {
        let parameters: Vec<f32> = layers_of_gru(gru).iter().flat_map(rounded_parameters).collect();
        rounded.set(&parameters)?;
    }
    policy.clone().with_layers(recurrent, net)
}

#[cfg(test)]
mod tests {
    use aviary::policy::Activation;
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn rounded_weights_are_within_half_a_scale(weights in proptest::collection::vec(-5.0f32..5.0, 3 * 4 + 4)) {
            let net = Mlp::new(&[3, 4], Activation::Relu, &weights).unwrap();
            let layer = &quantize(&net)[0];
            for output in 0..4 {
                let scale = layer.scales[output];
                for input in 0..3 {
                    let exact = weights[input * 4 + output];
                    let rounded = scale * f32::from(layer.weights[output * 3 + input]);
                    prop_assert!((exact - rounded).abs() <= 0.5001 * scale, "{exact} {rounded} {scale}");
                }
            }
            prop_assert_eq!(&layer.biases[..], &weights[12..]);
        }
    }

    #[test]
    fn neurons_without_weights_stay_without_weights() {
        let net = Mlp::new(&[2, 2], Activation::Relu, &[0.0, 1e-42, 0.0, -1e-42, 0.5, 0.25]).unwrap();
        let layer = &quantize(&net)[0];
        assert_eq!((layer.weights[0], layer.weights[1], layer.scales[0]), (0, 0, 0.0));
        assert_eq!(layer.biases, [0.5, 0.25]);
    }
}
