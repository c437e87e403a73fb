//! ONNX files: written and read here, and files of other programs.

mod common;

use std::cell::RefCell;

use aviary::env::{DroneEnv as _, Env as _, EnvConfig};
use aviary::policy::{PolicyError, PolicyNetwork};
use aviary::rollout::{Policy as _, Rollout, RolloutError, fly_episode};
use aviary::tasks::{self, Hover};
use policy_formats::FormatError;
use policy_formats::onnx::{ActionRange, OnnxOptions, OnnxPolicy, to_bytes};
use proptest::prelude::*;
use rten_onnx::onnx::{
    AttributeProto, AttributeType, DataType, Dimension, GraphProto, ModelProto, NodeProto, OperatorSetIdProto,
    StringStringEntryProto, TensorProto, TensorShapeProto, TypeProto, TypeProtoTensor, ValueInfoProto,
};

fn read(bytes: Vec<u8>) -> Result<OnnxPolicy, FormatError> {
    OnnxPolicy::from_bytes(bytes, &OnnxOptions::default())
}

/// Size of a dimension: `None` for any.
type Size = Option<i64>;

fn value(name: &str, sizes: &[Size]) -> ValueInfoProto {
    let dimension = |size: &Size| match size {
        Some(size) => Dimension { dim_value: Some(*size), dim_param: None },
        None => Dimension { dim_value: None, dim_param: Some("batch".into()) },
    };
    let tensor = TypeProtoTensor {
        elem_type: Some(DataType::FLOAT),
        shape: Some(TensorShapeProto { dim: sizes.iter().map(dimension).collect() }),
    };
    ValueInfoProto { name: Some(name.into()), r#type: Some(TypeProto { tensor_type: Some(tensor), sequence: None }) }
}

fn constant(name: &str, shape: &[i64], numbers: &[f32]) -> TensorProto {
    TensorProto {
        dims: shape.to_vec(),
        data_type: Some(DataType::FLOAT),
        raw_data: Some(RefCell::new(numbers.iter().flat_map(|x| x.to_le_bytes()).collect())),
        name: Some(name.into()),
        ..TensorProto::default()
    }
}

fn node(operator: &str, input: &[&str], output: &[&str], attribute: Vec<AttributeProto>) -> NodeProto {
    NodeProto {
        domain: None,
        name: None,
        input: input.iter().map(ToString::to_string).collect(),
        output: output.iter().map(ToString::to_string).collect(),
        op_type: Some(operator.into()),
        attribute,
    }
}

/// Returns the file of a graph with metadata.
fn file(graph: GraphProto, metadata: &[(&str, &str)]) -> Vec<u8> {
    let entry = |(key, value): &(&str, &str)| StringStringEntryProto {
        key: Some(key.to_string()),
        value: Some(value.to_string()),
    };
    let model = ModelProto {
        ir_version: Some(8),
        graph: Some(graph),
        opset_import: vec![OperatorSetIdProto { domain: Some(String::new()), version: Some(17) }],
        metadata_props: metadata.iter().map(entry).collect(),
        producer_name: Some("another trainer".into()),
        producer_version: None,
    };
    model.write_buf().unwrap()
}

/// Returns a file with the layers of a trainer in Python: the weights of a layer as outputs × inputs, `tanh` at the
/// end, and the value of a critic as a second output. It hovers: thrust from height and vertical speed, the motors
/// against tilt and angular velocity.
fn of_another_trainer(order: &[usize], rows: Size, metadata: &[(&str, &str)]) -> Vec<u8> {
    // motors 0 and 1 are on the left, 0 and 3 at the front
    let (left, front) = ([1.0, 1.0, -1.0, -1.0], [1.0, -1.0, -1.0, 1.0]);
    let spin = [-1.0, 1.0, -1.0, 1.0];
    let mut weights = [0.0_f32; 4 * 12];
    for motor in 0..4 {
        let row = &mut weights[12 * motor..12 * motor + 12];
        let (roll, pitch) = (left[motor], -front[motor]);
        // roll to the right accelerates to −y, pitch forward to x
        row[0] -= 0.02 * pitch;
        row[6] -= 0.03 * pitch;
        row[4] -= 0.15 * pitch;
        row[10] -= 0.025 * pitch;
        row[1] += 0.02 * roll;
        row[7] += 0.03 * roll;
        row[3] -= 0.15 * roll;
        row[9] -= 0.025 * roll;
        row[2] -= 0.5;
        row[8] -= 0.4;
        row[5] -= 0.03 * spin[motor];
        row[11] -= 0.03 * spin[motor];
    }
    let sorted: Vec<f32> =
        (0..4).flat_map(|motor| order.iter().map(move |&index| 12 * motor + index)).map(|at| weights[at]).collect();
    let entries = order.len() as i64;
    let transposed = AttributeProto {
        name: Some("transB".into()),
        i: Some(1),
        r#type: Some(AttributeType::INT),
        ..AttributeProto::default()
    };
    let graph = GraphProto {
        node: vec![
            node("Gemm", &["obs", "weight", "bias"], &["hidden"], vec![transposed]),
            node("Tanh", &["hidden"], &["act"], Vec::new()),
            node("ReduceSum", &["obs"], &["value"], Vec::new()),
        ],
        initializer: vec![constant("weight", &[4, entries], &sorted), constant("bias", &[4], &[0.5; 4])],
        input: vec![value("obs", &[rows, Some(entries)])],
        output: vec![value("act", &[rows, Some(4)]), value("value", &[])],
        value_info: Vec::new(),
    };
    file(graph, metadata)
}

#[test]
fn exported_graphs_compute_the_actions_of_the_policy() {
    let policies = ["hover", "race", "velocity", "hover_cf21"].map(common::asset);
    for policy in policies.into_iter().chain([common::random()]) {
        let bytes = to_bytes(&policy).unwrap();
        assert_eq!(bytes, to_bytes(&policy).unwrap(), "equal policies have equal bytes");
        let read = read(bytes).unwrap();
        assert_eq!(read.info(), Some(policy.info()));
        let observations = common::observations(&policy, 100_000);
        let expected = common::actions(&policy, &observations);
        let found = read.actions(&observations, 100_000).unwrap();
        let (low, high) = policy.bounds();
        let (mut largest, mut far) = (0.0_f32, 0.0_f32);
        for (index, (found, expected)) in found.iter().zip(&expected).enumerate() {
            let (row, component) = (index / policy.action_size(), index % policy.action_size());
            let range = high[component] - low[component];
            let scale = if range.is_finite() { 0.5 * range } else { 1.0 + expected.abs() };
            // the first of every hundred observations is far outside of the range
            let error = if row % 100 == 0 { &mut far } else { &mut largest };
            *error = error.max((found - expected).abs() / scale);
        }
        assert!(largest < 3e-6 && far < 1e-5, "{}: {largest} {far}", policy.info().task);
    }
}

/// Inputs and actions of an exported recurrent policy over an episode; it gives its memory from step to step.
#[test]
fn exported_recurrent_policies_fly_alike() {
    let trained = common::recurrent();
    let policy = read(to_bytes(&trained).unwrap()).unwrap();
    assert_eq!(policy.memory_size(), 11);
    let mut env = Hover::builder().build().unwrap();
    let (mut here, mut there) = (policy.pilot(), trained.pilot());
    for seed in 0..3 {
        env.reset(Some(seed)).unwrap();
        here.reset(&env).unwrap();
        there.reset(&env).unwrap();
        let (mut found, mut expected) = ([0.0; 4], [0.0; 4]);
        while env.info().end.is_none() {
            here.act(&env, &mut found).unwrap();
            there.act(&env, &mut expected).unwrap();
            assert!(found.iter().zip(&expected).all(|(a, b)| (a - b).abs() < 5e-6), "{found:?} {expected:?}");
            env.step(&expected).unwrap();
        }
    }
}

#[test]
fn exported_policies_fly_alike() {
    let trained = common::asset("hover");
    let policy = read(to_bytes(&trained).unwrap()).unwrap();
    for seed in 0..5 {
        let mut env = Hover::builder().build().unwrap();
        let here = fly_episode(&mut env, &mut policy.pilot(), Some(seed)).unwrap();
        let there = fly_episode(&mut env, &mut trained.pilot(), Some(seed)).unwrap();
        assert_eq!((here.success, here.steps), (there.success, there.steps));
        assert!((here.reward - there.reward).abs() < 1e-2, "{} {}", here.reward, there.reward);
    }
}

#[test]
fn a_policy_of_another_trainer_hovers() {
    let all: Vec<usize> = (0..12).collect();
    // velocities first, without the yaw
    let order = [6, 7, 8, 0, 1, 2, 3, 4, 9, 10, 11];
    let listed = order.map(|index| index.to_string()).join(", ");
    let cases = [
        (of_another_trainer(&all, None, &[]), OnnxOptions::default()),
        (of_another_trainer(&all, Some(1), &[]), OnnxOptions::default()),
        (of_another_trainer(&order, None, &[("observation_indices", &listed)]), OnnxOptions::default()),
        (
            of_another_trainer(&order, None, &[("observation_indices", "0")]),
            OnnxOptions { observation_indices: Some(order.to_vec()), ..OnnxOptions::default() },
        ),
        (
            of_another_trainer(&all, None, &[]),
            OnnxOptions {
                action_output: Some("act".into()),
                action_range: Some(ActionRange::Unit),
                ..OnnxOptions::default()
            },
        ),
    ];
    for (bytes, options) in cases {
        let policy = OnnxPolicy::from_bytes(bytes, &options).unwrap();
        let mut env = Hover::builder().build().unwrap();
        let summary = fly_episode(&mut env, &mut policy.pilot(), Some(3)).unwrap();
        let state = env.simulation().states()[0];
        assert!(summary.end == Some(aviary::env::EndReason::TimeLimit), "{summary:?} {:?}", state.position);
        assert!((state.position.z - 1.0).abs() < 0.1 && state.velocity.norm() < 0.05, "{:?}", state.position);
    }
}

/// Returns a file of a policy that adds up the heights that it has seen: the action is the sum over 100.
fn with_memory(shape: &[Size]) -> Vec<u8> {
    let mut height = [0.0; 12];
    height[2] = 1.0;
    let picked = constant("pick", &[12, 1], &height);
    let graph = GraphProto {
        node: vec![
            node("MatMul", &["obs", "pick"], &["height"], Vec::new()),
            node("Add", &["height", "sum_in"], &["sum_out"], Vec::new()),
            node("Reshape", &["sum_out", "columns"], &["flat"], Vec::new()),
            node("MatMul", &["flat", "motors"], &["act"], Vec::new()),
        ],
        initializer: vec![
            picked,
            TensorProto {
                dims: vec![2],
                data_type: Some(DataType::INT64),
                raw_data: Some(RefCell::new([-1_i64, 1].iter().flat_map(|x| x.to_le_bytes()).collect())),
                name: Some("columns".into()),
                ..TensorProto::default()
            },
            constant("motors", &[1, 4], &[0.01; 4]),
        ],
        input: vec![value("obs", &[None, Some(12)]), value("sum_in", shape)],
        output: vec![value("act", &[None, Some(4)]), value("sum_out", shape)],
        value_info: Vec::new(),
    };
    file(graph, &[])
}

#[test]
fn memories_belong_to_an_episode() {
    for shape in [vec![None, Some(1)], vec![Some(1), None, Some(1)]] {
        let policy = read(with_memory(&shape)).unwrap();
        assert_eq!(policy.memory_size(), 1);
        let mut pilot = policy.pilot();
        let mut env = Hover::builder().build().unwrap();
        for _ in 0..2 {
            env.reset(Some(1)).unwrap();
            pilot.reset(&env).unwrap();
            let mut action = [0.0; 4];
            let mut sum = 0.0;
            for _ in 0..10 {
                sum += env.observation().vector[2];
                pilot.act(&env, &mut action).unwrap();
                assert!((action[3] - 0.01 * sum).abs() < 1e-6, "{action:?} {sum}");
                env.step(&action).unwrap();
            }
        }
        // a rollout goes back with the memory
        let mut rollout = Rollout::start(&mut env, policy.pilot(), Some(2)).unwrap();
        let fly = |rollout: &mut Rollout<_, _>| {
            for _ in 0..20 {
                rollout.step().unwrap();
            }
            rollout.summary().reward
        };
        fly(&mut rollout);
        let snapshot = rollout.snapshot();
        let reward = fly(&mut rollout);
        rollout.restore(&snapshot).unwrap();
        assert_eq!(fly(&mut rollout), reward);
    }
}

#[test]
fn policies_per_drone_act_for_each_drone() {
    let hover = common::asset("hover");
    let info = aviary::policy::PolicyInfo { per_drone: true, num_drones: 3, ..hover.info().clone() };
    let bytes = to_bytes(&hover).unwrap();
    let text = serde_json::to_string(&info).unwrap();
    let mut model = ModelProto::parse_buf(&bytes).unwrap();
    model.metadata_props[0].value = Some(text);
    let policy = read(model.write_buf().unwrap()).unwrap();
    let mut env = tasks::make("stabilize", EnvConfig::default().num_drones(3)).unwrap();
    env.reset(Some(4)).unwrap();
    let (mut pilot, mut together, mut alone) = (policy.pilot(), [0.0; 12], [0.0; 12]);
    pilot.reset(&env).unwrap();
    pilot.act(&env, &mut together).unwrap();
    hover.forward(&env.observation().vector, &mut alone);
    assert!(together.iter().zip(&alone).all(|(a, b)| (a - b).abs() < 1e-5), "{together:?} {alone:?}");
}

#[test]
fn files_that_do_not_fit_are_errors_of_one_line() {
    let all: Vec<usize> = (0..12).collect();
    let message = |result: Result<OnnxPolicy, FormatError>| {
        let message = result.unwrap_err().to_string();
        assert!(!message.contains('\n'), "{message}");
        message
    };
    assert!(message(read(Vec::new())).starts_with("not a policy in ONNX: "));
    assert!(message(read(b"{\"task\": \"hover\"}".to_vec())).starts_with("not a policy in ONNX: "));
    assert!(message(read(std::fs::read("../assets/policies/hover.safetensors").unwrap())).starts_with("not a policy"));
    let options = |options: OnnxOptions| message(OnnxPolicy::from_bytes(of_another_trainer(&all, None, &[]), &options));
    assert!(
        options(OnnxOptions { observation_indices: Some(vec![1, 2]), ..OnnxOptions::default() })
            .contains("expected 12 numbers")
    );
    let output = options(OnnxOptions { action_output: Some("action".into()), ..OnnxOptions::default() });
    assert_eq!(output, "action_output is `action`, expected act or value");
    let bad = read(of_another_trainer(&all, None, &[("action_range", "tanh")]));
    assert_eq!(message(bad), "action_range is `tanh`, expected space or unit");
    assert!(message(read(of_another_trainer(&all, None, &[("observation_indices", "1,x")]))).contains("is `x`"));
    assert!(message(read(of_another_trainer(&all, None, &[("policy", "{}")]))).contains("its metadata `policy`"));
    assert!(message(read(of_another_trainer(&all, Some(5), &[]))).contains("has 5 rows"));
    assert!(message(read(with_memory(&[Some(2), None, Some(1)]))).contains("shape"));
    for size in [1 << 40, i64::from(u32::MAX) + 1] {
        let huge = message(read(with_memory(&[None, Some(size), Some(size)])));
        assert!(huge.contains("at most 1048576 entries"), "{huge}");
    }
    let path = OnnxPolicy::load("nowhere.onnx", &OnnxOptions::default()).unwrap_err().to_string();
    assert!(path.starts_with("nowhere.onnx: "), "{path}");

    let refused = |policy: OnnxPolicy, task: &str| {
        let env = tasks::make(task, EnvConfig::default()).unwrap();
        let mut pilot = policy.pilot();
        let Err(RolloutError::Policy(PolicyError::Mismatch { policy, env })) = pilot.reset(&env) else {
            panic!("{task}")
        };
        format!("{policy}; {env}")
    };
    let other = read(of_another_trainer(&all, None, &[])).unwrap();
    assert_eq!(refused(other, "race"), "12 inputs (`obs`); 21 observations and 4 actions (rpm)");
    let far = OnnxOptions { observation_indices: Some((1..13).collect()), ..OnnxOptions::default() };
    let far = OnnxPolicy::from_bytes(of_another_trainer(&all, None, &[]), &far).unwrap();
    assert_eq!(refused(far, "hover"), "the observation index 12; 12 observations and 4 actions (rpm)");
    // an action type of the metadata, with an action of the same size
    let info = aviary::policy::PolicyInfo { action_type: "vel".into(), ..common::asset("hover").info().clone() };
    let text = serde_json::to_string(&info).unwrap();
    let metadata = [("policy", text.as_str())];
    let velocities = read(of_another_trainer(&all, None, &metadata)).unwrap();
    assert_eq!(refused(velocities, "hover"), "actions vel; actions rpm");
    let value = OnnxOptions { action_output: Some("value".into()), ..OnnxOptions::default() };
    let value = OnnxPolicy::from_bytes(of_another_trainer(&all, None, &[]), &value).unwrap();
    assert_eq!(refused(value, "hover"), "1 outputs (`value`); 12 observations and 4 actions (rpm)");
}

fn integers(name: &str, numbers: &[i64]) -> TensorProto {
    TensorProto {
        dims: vec![numbers.len() as i64],
        data_type: Some(DataType::INT64),
        raw_data: Some(RefCell::new(numbers.iter().flat_map(|x| x.to_le_bytes()).collect())),
        name: Some(name.into()),
        ..TensorProto::default()
    }
}

/// Returns the error of a graph with the output `act`, when it is read or evaluated.
fn error_of(node: Vec<NodeProto>, initializer: Vec<TensorProto>) -> String {
    let (input, output) = (vec![value("obs", &[None, Some(12)])], vec![value("act", &[])]);
    let bytes = file(GraphProto { node, initializer, input, output, value_info: Vec::new() }, &[]);
    let error = read(bytes).and_then(|policy| policy.actions(&[0.0; 12], 1)).unwrap_err().to_string();
    assert!(error.starts_with("not a policy in ONNX: ") && !error.contains('\n'), "{error}");
    error
}

#[test]
fn operators_and_sizes_that_no_policy_needs_are_errors() {
    let huge = [1_000_000, 1_000_000, 1, 1];
    for (operator, inputs) in
        [("Expand", &["obs", "sizes"][..]), ("Tile", &["obs", "sizes"]), ("ConstantOfShape", &["sizes"])]
    {
        let error = error_of(vec![node(operator, inputs, &["act"], Vec::new())], vec![integers("sizes", &huge)]);
        assert!(error.contains(operator) && error.contains("larger than 16777216 entries"), "{error}");
    }
    let ends = [("first", 0.0), ("last", f32::INFINITY), ("step", 1.0)].map(|(name, x)| constant(name, &[], &[x]));
    let range = node("Range", &["first", "last", "step"], &["act"], Vec::new());
    assert!(error_of(vec![range], ends.to_vec()).contains("the operator `Range`"));
    assert!(error_of(vec![node("Loop", &["obs"], &["act"], Vec::new())], Vec::new()).contains("`Loop`"));
}

/// Sizes that the graph computes are not known before: the runtime panics.
#[test]
fn panics_of_the_runtime_are_errors_without_a_message() {
    /// Variable that is set in the process whose messages are read.
    const INSIDE: &str = "ONNX_TEST_INSIDE";
    if std::env::var_os(INSIDE).is_none() {
        let mut inside = std::process::Command::new(std::env::current_exe().unwrap());
        inside.args(["panics_of_the_runtime_are_errors_without_a_message", "--exact", "--nocapture"]);
        let output = inside.env(INSIDE, "1").output().unwrap();
        let messages = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success() && messages.is_empty(), "{messages}");
        return;
    }
    let sizes = node("Add", &["large", "large"], &["sizes"], Vec::new());
    let numbers = node("ConstantOfShape", &["sizes"], &["act"], Vec::new());
    error_of(vec![sizes, numbers], vec![integers("large", &[1 << 29; 4])]);
}

fn small() -> PolicyNetwork {
    common::random()
}

proptest! {
    #[test]
    fn damaged_files_are_errors_or_policies(
        changes in proptest::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..4),
        length in any::<prop::sample::Index>(),
        cut in any::<bool>(),
    ) {
        let mut bytes = to_bytes(&small()).unwrap();
        for (place, byte) in changes {
            let place = place.index(bytes.len());
            bytes[place] = byte;
        }
        if cut {
            bytes.truncate(length.index(bytes.len()));
        }
        if let Ok(policy) = read(bytes) {
            let _ = policy.actions(&[0.5; 14], 2);
        }
    }
}
