//! The graph of a policy.

use aviary::policy::{Activation, Gru, PolicyInfo, PolicyNetwork};
use prost::Message as _;

use super::METADATA_KEY;
use super::model::{
    AttributeProto, Dimension, FLOAT, GraphProto, INT64, INTEGER, ModelProto, NodeProto, OperatorSetIdProto,
    StringStringEntryProto, TensorProto, TensorShapeProto, TypeProto, TypeProtoTensor, ValueInfoProto,
};
use crate::FormatError;

/// Version of the operators (June 2022). onnxruntime and rten read it.
const OPSET: i64 = 17;

/// Version of the file format that belongs to [`OPSET`].
const IR_VERSION: i64 = 8;

/// Returns a policy as the bytes of an ONNX file.
///
/// The graph has the input `observation` and the output `action`, single precision, with any number of rows.
/// Normalization and bounds are part of it. That of a recurrent policy has the further input `memory`, which is zero at
/// the start of an episode, and the further output `next_memory`. Its metadata has the [`PolicyInfo`] as JSON under
/// [`METADATA_KEY`], so that [`OnnxPolicy`](super::OnnxPolicy) needs no options.
///
/// # Errors
/// [`FormatError::Onnx`] if the metadata cannot be written.
pub fn to_bytes(policy: &PolicyNetwork) -> Result<Vec<u8>, FormatError> {
    let mut graph = Graph::default();
    let net = policy.net();
    let (mean, deviation) = policy.normalization();
    let centred = graph.with_constant("Sub", "observation", "mean", &[mean.len()], mean);
    let scaled = graph.with_constant("Div", &centred, "deviation", &[deviation.len()], deviation);
    let limits = ["lowest", "highest"].map(String::from);
    graph.constant(&limits[0], &[], &[-PolicyNetwork::CLIP]);
    graph.constant(&limits[1], &[], &[PolicyNetwork::CLIP]);
    let mut here = graph.node("Clip", vec![scaled, limits[0].clone(), limits[1].clone()], Vec::new());
    if let Some(gru) = policy.recurrent() {
        here = graph.recurrent(gru, here);
    }
    let (mut left, layers) = (net.parameters(), net.sizes().len() - 1);
    for (index, pair) in net.sizes().windows(2).enumerate() {
        let (weights, rest) = left.split_at(pair[0] * pair[1]);
        let (biases, rest) = rest.split_at(pair[1]);
        left = rest;
        let names = [format!("weights{index}"), format!("biases{index}")];
        graph.constant(&names[0], pair, weights);
        graph.constant(&names[1], &pair[1..], biases);
        let [weights, biases] = names;
        here = graph.node("Gemm", vec![here, weights, biases], Vec::new());
        if index + 1 < layers {
            let activation = match net.activation() {
                Activation::Relu => "Relu",
                Activation::Softsign => "Softsign",
            };
            here = graph.node(activation, vec![here], Vec::new());
        }
    }
    let (low, high) = policy.bounds();
    let bounded: Vec<bool> = low.iter().zip(high).map(|(low, high)| low.is_finite() && high.is_finite()).collect();
    let of = |scaled: fn(f32, f32) -> f32, otherwise: f32| {
        let entries = low.iter().zip(high).zip(&bounded);
        entries.map(|((&low, &high), &bounded)| if bounded { scaled(low, high) } else { otherwise }).collect::<Vec<_>>()
    };
    if bounded.contains(&true) {
        here = graph.with_constant("Mul", &here, "half", &[low.len()], &of(|low, high| 0.5 * (high - low), 1.0));
        here = graph.with_constant("Add", &here, "middle", &[low.len()], &of(|low, high| 0.5 * (low + high), 0.0));
    }
    // runtimes differ in what they do with infinite constants
    let finite = |bounds: &[f32]| bounds.iter().map(|x| x.clamp(f32::MIN, f32::MAX)).collect::<Vec<_>>();
    here = graph.with_constant("Max", &here, "low", &[low.len()], &finite(low));
    graph.with_constant("Min", &here, "high", &[high.len()], &finite(high));
    graph.nodes.last_mut().into_iter().for_each(|node| node.output = vec!["action".into()]);
    let model = ModelProto {
        ir_version: IR_VERSION,
        producer_name: "mujoco-drones-gym".into(),
        producer_version: env!("CARGO_PKG_VERSION").into(),
        graph: Some(GraphProto {
            node: graph.nodes,
            name: "policy".into(),
            initializer: graph.constants,
            input: with_memory(value("observation", policy.observation_size()), "memory", policy),
            output: with_memory(value("action", policy.action_size()), "next_memory", policy),
            ..GraphProto::default()
        }),
        opset_import: vec![OperatorSetIdProto { domain: String::new(), version: OPSET }],
        metadata_props: vec![metadata(policy.info())?],
    };
    Ok(model.encode_to_vec())
}

/// Returns the metadata of a policy.
fn metadata(info: &PolicyInfo) -> Result<StringStringEntryProto, FormatError> {
    let text = serde_json::to_string(info).map_err(|error| FormatError::Onnx { message: error.to_string() })?;
    Ok(StringStringEntryProto { key: METADATA_KEY.into(), value: text })
}

/// Returns the type of a tensor with any number of rows.
fn value(name: &str, size: usize) -> ValueInfoProto {
    let rows = Dimension { dim_value: None, dim_param: Some("rows".into()) };
    let columns = Dimension { dim_value: Some(size as i64), dim_param: None };
    let tensor = TypeProtoTensor { elem_type: FLOAT, shape: Some(TensorShapeProto { dim: vec![rows, columns] }) };
    ValueInfoProto { name: name.into(), r#type: Some(TypeProto { tensor_type: Some(tensor), ..TypeProto::default() }) }
}

/// Returns an input or output, and that of the memory of a recurrent policy.
fn with_memory(first: ValueInfoProto, name: &str, policy: &PolicyNetwork) -> Vec<ValueInfoProto> {
    let memory = (policy.memory_size() > 0).then(|| value(name, policy.memory_size()));
    [first].into_iter().chain(memory).collect()
}

/// Graph under construction. Each node has the name of its output.
#[derive(Default)]
struct Graph {
    nodes: Vec<NodeProto>,
    constants: Vec<TensorProto>,
}

impl Graph {
    /// Adds a constant.
    fn constant(&mut self, name: &str, shape: &[usize], numbers: &[f32]) {
        self.constants.push(TensorProto {
            dims: shape.iter().map(|&size| size as i64).collect(),
            data_type: FLOAT,
            name: name.into(),
            raw_data: numbers.iter().flat_map(|x| x.to_le_bytes()).collect(),
            ..TensorProto::default()
        });
    }

    /// Adds a node and returns the name of its output.
    fn node(&mut self, operator: &str, input: Vec<String>, attribute: Vec<AttributeProto>) -> String {
        let name = format!("{}{}", operator.to_lowercase(), self.nodes.len());
        self.nodes.push(NodeProto {
            input,
            output: vec![name.clone()],
            name: name.clone(),
            op_type: operator.into(),
            attribute,
            ..NodeProto::default()
        });
        name
    }

    /// Adds a constant of integers.
    fn integers(&mut self, name: &str, numbers: &[i64]) {
        self.constants.push(TensorProto {
            dims: vec![numbers.len() as i64],
            data_type: INT64,
            name: name.into(),
            raw_data: numbers.iter().flat_map(|x| x.to_le_bytes()).collect(),
            ..TensorProto::default()
        });
    }

    /// Adds a recurrent layer between the inputs `memory` and the output `next_memory`, and returns the name of its
    /// input and next state side by side.
    fn recurrent(&mut self, gru: &Gru, input: String) -> String {
        let units = gru.units();
        // ONNX has the gates in the order z, r, n, and the weights of a unit next to each other
        let gates = [1, 0, 2];
        let weights = |weights: &[f32], inputs: usize| {
            let of_gate = |gate: usize| (0..units).map(move |unit| gate * units + unit);
            let columns = gates.into_iter().flat_map(of_gate);
            columns.flat_map(|column| (0..inputs).map(move |row| weights[row * 3 * units + column])).collect::<Vec<_>>()
        };
        let biases = |biases: &[f32]| gates.map(|gate| biases[gate * units..][..units].to_vec()).concat();
        self.constant("input_weights", &[1, 3 * units, gru.inputs()], &weights(gru.input_weights(), gru.inputs()));
        self.constant("state_weights", &[1, 3 * units, units], &weights(gru.state_weights(), units));
        let both = [biases(gru.input_biases()), biases(gru.state_biases())].concat();
        self.constant("recurrent_biases", &[1, 6 * units], &both);
        self.integers("sequence", &[0]);
        let unsqueezed =
            |graph: &mut Self, name: &str| graph.node("Unsqueeze", vec![name.into(), "sequence".into()], Vec::new());
        let (row, state) = (unsqueezed(self, &input), unsqueezed(self, "memory"));
        let integer = |name: &str, value: i64| AttributeProto {
            name: name.into(),
            i: value,
            r#type: INTEGER,
            ..AttributeProto::default()
        };
        let attributes = vec![integer("hidden_size", units as i64), integer("linear_before_reset", 1)];
        let names = ["input_weights", "state_weights", "recurrent_biases", ""].map(String::from);
        let inputs = [row].into_iter().chain(names).chain([state]).collect();
        self.node("GRU", inputs, attributes);
        // the first output has the states of all steps, the second one the last state
        let last = "last_state".to_string();
        self.nodes.last_mut().into_iter().for_each(|node| node.output = vec![String::new(), last.clone()]);
        self.node("Squeeze", vec![last, "sequence".into()], Vec::new());
        self.nodes.last_mut().into_iter().for_each(|node| node.output = vec!["next_memory".into()]);
        self.node("Concat", vec![input, "next_memory".into()], vec![integer("axis", 1)])
    }

    /// Adds a node with a constant as its second input.
    fn with_constant(&mut self, operator: &str, input: &str, name: &str, shape: &[usize], numbers: &[f32]) -> String {
        self.constant(name, shape, numbers);
        self.node(operator, vec![input.into(), name.into()], Vec::new())
    }
}
