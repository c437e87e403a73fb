//! Weights of eight bits, with one scale per neuron.

use aviary::policy::{Mlp, PolicyError, PolicyNetwork};

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

/// Returns the layers of a network with the weights of a neuron next to each other.
pub(crate) fn layers(net: &Mlp) -> Vec<Linear<'_>> {
    let mut left = net.parameters();
    let layer = |pair: &[usize]| {
        let (inputs, outputs) = (pair[0], pair[1]);
        let (weights, rest) = left.split_at(inputs * outputs);
        let (biases, rest) = rest.split_at(outputs);
        left = rest;
        let entry = |index: usize| weights[index % inputs * outputs + index / inputs];
        Linear { inputs, weights: (0..weights.len()).map(entry).collect(), biases }
    };
    net.sizes().windows(2).map(layer).collect()
}

/// Rounds the weights of a network to eight bits. Biases stay in single precision.
///
/// The scale of a neuron is its largest weight over 127, so that the error of a weight is at most half a scale.
pub fn quantize(net: &Mlp) -> Vec<QuantizedLayer> {
    let layer = |layer: Linear<'_>| {
        let rows = layer.weights.chunks_exact(layer.inputs);
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
        QuantizedLayer { weights, scales, biases: layer.biases.to_vec() }
    };
    layers(net).into_iter().map(layer).collect()
}

/// Returns the policy with the weights that its quantized form has, in single precision, so that it can be evaluated
/// here.
///
/// # Errors
/// [`PolicyError::Network`] if a rounded weight is not finite.
pub fn rounded(policy: &PolicyNetwork) -> Result<PolicyNetwork, PolicyError> {
    let mut net = policy.net().clone();
    let mut parameters = Vec::with_capacity(net.parameters().len());
    for (layer, pair) in quantize(&net).iter().zip(net.sizes().windows(2)) {
        let weight = |index: usize| {
            let (input, output) = (index / pair[1], index % pair[1]);
            layer.scales[output] * f32::from(layer.weights[output * pair[0] + input])
        };
        parameters.extend((0..pair[0] * pair[1]).map(weight));
        parameters.extend_from_slice(&layer.biases);
    }
    net.set(&parameters)?;
    policy.clone().with_net(net)
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
