//! Limits of the graphs that the runtime evaluates: it has operators whose output has any size, and loops.

use std::collections::HashMap;

use super::model::{INT64, ModelProto, NodeProto, TensorProto};
use super::runtime::wrong;
use crate::FormatError;

/// Operators that a graph of a policy may have: those of feedforward, recurrent and attention layers, of normalization,
/// and of arithmetic. Images, loops, lists and random numbers have further ones.
const OPERATORS: &str = "Abs Acos Acosh Add And ArgMax ArgMin Asin Asinh Atan Atanh Attention BatchNormalization \
    BiasGelu Cast CastLike Ceil Celu Clip Compress Concat Constant ConstantOfShape Cos Cosh CumSum DequantizeLinear \
    Div Dropout DynamicQuantizeLinear Einsum Elu Equal Erf Exp Expand EyeLike FastGelu Flatten Floor FusedMatMul \
    GRU Gather GatherElements GatherND Gelu Gemm Greater GreaterOrEqual GroupNormalization HardSigmoid HardSwish \
    Hardmax Identity InstanceNormalization IsInf IsNaN LSTM LayerNormalization LeakyRelu Less LessOrEqual Log \
    LogSoftmax LpNormalization MatMul MatMulInteger Max Mean MeanVarianceNormalization Min Mish Mod Mul Neg NonZero \
    Not OneHot Or PRelu Pow QuantizeLinear QuickGelu RMSNormalization RNN Reciprocal ReduceL1 ReduceL2 ReduceLogSum \
    ReduceLogSumExp ReduceMax ReduceMean ReduceMin ReduceProd ReduceSum ReduceSumSquare Relu Reshape Round \
    ScatterElements ScatterND Selu Shape Shrink Sigmoid Sign SimplifiedLayerNormalization Sin Sinh Size \
    SkipLayerNormalization SkipSimplifiedLayerNormalization Slice Softmax Softplus Softsign Split Sqrt Squeeze Sub \
    Sum Swish Tan Tanh ThresholdedRelu Tile TopK Transpose Trilu Unsqueeze Where Xor";

/// Largest number of entries of a value that an operator makes from a list of sizes.
const MAX_ENTRIES: u64 = 1 << 24;

/// Checks the operators of a graph, and the sizes in the file that determine the sizes of values.
pub(super) fn validate(model: &ModelProto) -> Result<(), FormatError> {
    let Some(graph) = &model.graph else { return Ok(()) };
    let mut lists: HashMap<&str, Vec<i64>> = HashMap::new();
    lists.extend(graph.initializer.iter().filter_map(|tensor| Some((&*tensor.name, integers(tensor)?))));
    lists.extend(graph.node.iter().filter_map(constant));
    for node in &graph.node {
        let operator = &*node.op_type;
        if !OPERATORS.split(' ').any(|known| known == operator) {
            return Err(wrong(format_args!(
                "it has the operator `{operator}`, expected operators of layers and arithmetic"
            )));
        }
        let sizes = match operator {
            "ConstantOfShape" => node.input.first(),
            "Expand" | "Tile" => node.input.get(1),
            _ => None,
        };
        let Some(sizes) = sizes.and_then(|name| lists.get(&**name)) else { continue };
        let entries = sizes.iter().try_fold(1_u64, |all, &size| all.checked_mul(size.unsigned_abs().max(1)));
        if entries.is_none_or(|entries| entries > MAX_ENTRIES) {
            return Err(wrong(format_args!(
                "the output of its operator `{operator}` is larger than {MAX_ENTRIES} entries, expected a smaller one"
            )));
        }
    }
    Ok(())
}

/// Returns the name and the integers of a node that is a list of integers.
fn constant(node: &NodeProto) -> Option<(&str, Vec<i64>)> {
    let name = node.output.first().filter(|_| node.op_type == "Constant")?;
    let value = node.attribute.first()?;
    let list = match &value.t {
        Some(tensor) => integers(tensor)?,
        None => value.ints.clone(),
    };
    Some((name, list))
}

/// Returns the entries of a tensor of integers.
fn integers(tensor: &TensorProto) -> Option<Vec<i64>> {
    let in_bytes = || tensor.raw_data.as_chunks().0.iter().map(|bytes| i64::from_le_bytes(*bytes)).collect();
    match tensor.data_type {
        INT64 if tensor.raw_data.is_empty() => Some(tensor.int64_data.clone()),
        INT64 => Some(in_bytes()),
        _ => None,
    }
}
