//! Policies as C99: one header and one source file, without other files, allocation or libraries.

mod firmware;
mod text;

pub use firmware::{FirmwareOptions, firmware};

use std::fmt::Write as _;

use aviary::drone::{DroneModel, DroneParams};
use aviary::policy::{Activation, PolicyInfo, PolicyNetwork, gates};

use self::text::{array, comment, fill, number, wrapped};
use crate::layout::{self, Entry};
use crate::quantization::{Linear, layers, layers_of_gru};
use crate::{FormatError, unsupported};

/// Type of the weights in the generated code. Everything else is in single precision.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Weights {
    /// Single precision, bit-identical to [`PolicyNetwork::forward`] if the compiler rounds every operation
    /// (`-ffp-contract=off`, which `-std=c99` implies in GCC).
    #[default]
    Float32,
    /// Eight bits, a quarter of the size, with one scale per neuron; see [`quantization`](crate::quantization).
    Int8,
}

/// Generated code.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CSource {
    /// Name of the policy in the code, and of the files without their extensions.
    pub name: String,
    /// Content of the header.
    pub header: String,
    /// Content of the source file.
    pub source: String,
    /// Size of the constants: weights, biases, normalization and bounds, bytes.
    pub constant_bytes: usize,
}

/// File of a directory.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TextFile {
    /// Path relative to the directory.
    pub path: String,
    /// Content.
    pub content: String,
}

/// Returns the name of a policy in generated code: its task and `_policy`.
pub fn default_name(info: &PolicyInfo) -> String {
    let known = |c: char| if c.is_ascii_alphanumeric() { c.to_ascii_lowercase() } else { '_' };
    let task: String = info.task.chars().take(40).map(known).collect();
    // a name must not begin with a digit, and one that begins with `_` belongs to the compiler
    let task = task.trim_start_matches(|c: char| c.is_ascii_digit() || c == '_');
    if task.is_empty() { "policy".into() } else { format!("{task}_policy") }
}

/// Generates the C99 code of a policy. `name` begins every name in it, and is the name of both files.
///
/// The function `NAME_evaluate(observation, action)` is reentrant: its buffers are on the stack. That of a recurrent
/// policy is `NAME_evaluate(observation, memory, action)`, whose caller keeps the memory, and sets it to zero at the
/// start of an episode.
///
/// ```
/// use aviary::policy::PolicyNetwork;
/// use policy_formats::c::{Weights, source};
///
/// let policy = PolicyNetwork::load("../assets/policies/hover.safetensors")?;
/// let code = source(&policy, "hover_policy", Weights::Float32)?;
/// assert!(code.header.contains("void hover_policy_evaluate(const float observation[12], float action[4]);"));
/// assert!(code.header.contains("HOVER_POLICY_OBSERVATION_POSITION_Z = 2, /* position along z, m, world frame */"));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
///
/// # Errors
/// [`FormatError::Unsupported`] for a name that is not an identifier in lower snake case.
pub fn source(policy: &PolicyNetwork, name: &str, weights: Weights) -> Result<CSource, FormatError> {
    let drone = policy.info().drone.parse::<DroneModel>().ok().map(DroneModel::params);
    generate(policy, name, weights, drone.as_ref(), false)
}

/// Generates the code of [`source`], with buffers that are static if `is_static` is true: for tasks with a small stack.
/// The header describes the motors of `drone`.
fn generate(
    policy: &PolicyNetwork,
    name: &str,
    weights: Weights,
    drone: Option<&DroneParams>,
    is_static: bool,
) -> Result<CSource, FormatError> {
    let is_name = name.starts_with(|c: char| c.is_ascii_lowercase())
        && name.len() <= 60
        && name.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_');
    if !is_name {
        let expected = "lower snake case with at most 60 letters, digits and `_`, such as `hover_policy`";
        return Err(unsupported("the name", format_args!("`{name}`"), expected));
    }
    let code = Code { policy, name, weights, drone, is_static };
    let (source, constant_bytes) = code.source();
    Ok(CSource { name: name.into(), header: code.header(), source, constant_bytes })
}

/// Generator of one policy.
struct Code<'a> {
    policy: &'a PolicyNetwork,
    name: &'a str,
    weights: Weights,
    drone: Option<&'a DroneParams>,
    /// True if the buffers are static.
    is_static: bool,
}

impl Code<'_> {
    /// Returns an enumeration of the indices of an observation or action.
    fn indices(&self, what: &str, entries: &[Entry]) -> String {
        let prefix = self.name.to_uppercase();
        let mut text = format!("enum {}_{} {{\n", self.name, what.to_lowercase());
        for (index, Entry { name, description }) in entries.iter().enumerate() {
            let comma = if index + 1 < entries.len() { "," } else { "" };
            let comment =
                if description.is_empty() { String::new() } else { format!(" /* {} */", comment(description)) };
            let _ = writeln!(text, "    {prefix}_{what}_{name} = {index}{comma}{comment}");
        }
        text + "};\n"
    }

    fn header(&self) -> String {
        let (info, name) = (self.policy.info(), self.name);
        let prefix = name.to_uppercase();
        let (inputs, outputs) = (self.policy.observation_size(), self.policy.action_size());
        let of = if info.per_drone && info.num_drones > 1 { "one of the drones" } else { "all drones" };
        let drones = if info.num_drones == 1 { String::new() } else { format!(", {} drones", info.num_drones) };
        let mut text = format!(
            "/*\n * Policy for the task {}, airframe {}{drones}, action type {}.\n *\n",
            comment(&info.task),
            comment(&info.drone),
            comment(&info.action_type)
        );
        text += &wrapped(&format!("Trained with: {}", info.command));
        text += &wrapped(&format!("Made by: {}", info.made_by));
        if info.num_drones > 1 {
            text += &wrapped(&format!("Observation and action are those of {of}."));
        }
        let notes = layout::notes(info, self.drone);
        if !notes.is_empty() {
            text += " *\n";
            notes.iter().for_each(|note| text += &wrapped(note));
        }
        let _ = write!(
            text,
            " */\n#ifndef {prefix}_H\n#define {prefix}_H\n\n#ifdef __cplusplus\nextern \"C\" {{\n#endif\n\n\
             #define {prefix}_OBSERVATION_SIZE {inputs}\n#define {prefix}_ACTION_SIZE {outputs}\n\n\
             /* Rate at which the policy was trained to be evaluated, Hz. */\n#define {prefix}_RATE {}\n\n\
             /* Indices of the observation. */\n{}\n/* Indices of the action. */\n{}\n",
            info.ctrl_freq,
            self.indices("OBSERVATION", &layout::observation(info, inputs)),
            self.indices("ACTION", &layout::action(info, outputs)),
        );
        if self.policy.memory_size() > 0 {
            let _ = write!(
                text,
                "/* Size of the memory of a policy with a recurrent layer. */\n#define {prefix}_MEMORY_SIZE {}\n\n",
                self.policy.memory_size()
            );
        }
        let memory = if self.policy.memory_size() > 0 {
            "\n * The function replaces the memory of the evaluation before, which is zero at the start of an episode."
        } else {
            ""
        };
        let threads = if self.is_static {
            "\n * Its buffers are static: only one thread may call it."
        } else {
            "\n * Different threads may call it at the same time."
        };
        let _ = write!(
            text,
            "/*\n * Computes the action for an observation of finite numbers, with normalization and bounds.{memory}\
             {threads}\n */\n{};\n\n#ifdef __cplusplus\n}}\n#endif\n\n#endif\n",
            self.signature()
        );
        text
    }

    /// Returns the declaration of the function.
    fn signature(&self) -> String {
        let (inputs, outputs) = (self.policy.observation_size(), self.policy.action_size());
        let memory = match self.policy.memory_size() {
            0 => String::new(),
            size => format!("float memory[{size}], "),
        };
        format!("void {}_evaluate(const float observation[{inputs}], {memory}float action[{outputs}])", self.name)
    }

    /// Writes the constants of a linear layer, and returns their size, bytes.
    fn layer(&self, text: &mut String, name: &str, layer: &Linear<'_>) -> usize {
        let numbers = |numbers: &[f32]| numbers.iter().map(|&x| number(x)).collect::<Vec<_>>().into_iter();
        let biases = array("float", &format!("{name}_biases"), numbers(layer.biases));
        match self.weights {
            Weights::Float32 => {
                *text += &array("float", &format!("{name}_weights"), numbers(&layer.weights));
                *text += &biases;
                4 * (layer.weights.len() + layer.biases.len())
            }
            Weights::Int8 => {
                let rounded = layer.quantized();
                let weights = rounded.weights.iter().map(ToString::to_string);
                *text += &array("signed char", &format!("{name}_weights"), weights);
                *text += &array("float", &format!("{name}_scales"), numbers(&rounded.scales));
                *text += &biases;
                rounded.weights.len() + 4 * (rounded.scales.len() + rounded.biases.len())
            }
        }
    }

    /// Returns the call of a linear layer.
    fn call(&self, name: &str, layer: &Linear<'_>, x: &str, y: &str) -> String {
        let (inputs, outputs) = (layer.inputs, layer.biases.len());
        let scales = if self.weights == Weights::Int8 { format!("{name}_scales, ") } else { String::new() };
        format!("    linear({name}_weights, {scales}{name}_biases, {inputs}, {outputs}, {x}, {y});\n")
    }

    /// Returns the source file and the size of its constants, bytes.
    fn source(&self) -> (String, usize) {
        let net = self.policy.net();
        let (mean, deviation) = self.policy.normalization();
        let recurrent = self.policy.recurrent().map(layers_of_gru);
        let layers = layers(net);
        let widest = net.sizes().iter().copied().max().unwrap_or(1);
        let mut text = format!("#include \"{}.h\"\n\n", self.name);
        let mut bytes = 4 * (2 * mean.len());
        text += &array("float", "observation_mean", mean.iter().map(|&x| number(x)));
        text += &array("float", "observation_deviation", deviation.iter().map(|&x| number(x)));
        for (name, layer) in ["input", "state"].iter().zip(recurrent.iter().flatten()) {
            bytes += self.layer(&mut text, name, layer);
        }
        for (index, layer) in layers.iter().enumerate() {
            bytes += self.layer(&mut text, &format!("layer{index}"), layer);
        }
        text += include_str!("../templates/clipped.c");
        text += match self.weights {
            Weights::Float32 => include_str!("../templates/linear_float32.c"),
            Weights::Int8 => include_str!("../templates/linear_int8.c"),
        };
        if layers.len() > 1 {
            text += match net.activation() {
                Activation::Relu => include_str!("../templates/relu.c"),
                Activation::Softsign => include_str!("../templates/softsign.c"),
            };
        }
        if recurrent.is_some() {
            text += &gate_functions();
        }
        let (inputs, clip) = (self.policy.observation_size(), number(PolicyNetwork::CLIP));
        let storage = if self.is_static { "static " } else { "" };
        let _ = write!(
            text,
            "{}\n{{\n    {storage}float first[{widest}];\n    {storage}float second[{widest}];\n",
            self.signature()
        );
        if let Some(gates) = recurrent.as_ref().map(|layers| layers[0].biases.len()) {
            let _ = writeln!(text, "    {storage}float of_input[{gates}];\n    {storage}float of_state[{gates}];");
        }
        let _ = write!(
            text,
            "\n    for (int i = 0; i < {inputs}; i++) {{\n        \
             first[i] = clipped((observation[i] - observation_mean[i]) / observation_deviation[i], -{clip}, \
             {clip});\n    }}\n"
        );
        if let Some([of_input, of_state]) = &recurrent {
            let units = of_state.inputs;
            text += &self.call("input", of_input, "first", "of_input");
            text += &self.call("state", of_state, "memory", "of_state");
            let _ = write!(
                text,
                "    for (int i = 0; i < {units}; i++) {{\n        \
                 const float reset = logistic(of_input[i] + of_state[i]);\n        \
                 const float update = logistic(of_input[{units} + i] + of_state[{units} + i]);\n        \
                 const float candidate = hyperbolic_tangent(of_input[{0} + i] + reset * of_state[{0} + i]);\n\n        \
                 memory[i] = (1.0f - update) * candidate + update * memory[i];\n        \
                 first[{inputs} + i] = memory[i];\n    }}\n",
                2 * units
            );
        }
        let mut buffers = ["first", "second"];
        for (index, layer) in layers.iter().enumerate() {
            let [here, next] = buffers;
            text += &self.call(&format!("layer{index}"), layer, here, next);
            if index + 1 < layers.len() {
                let _ = writeln!(text, "    activate({}, {next});", layer.biases.len());
            }
            buffers.swap(0, 1);
        }
        text += &self.actions(buffers[0]);
        text += "}\n";
        (text, bytes)
    }

    /// Returns the assignments of the action from the outputs of the network.
    fn actions(&self, result: &str) -> String {
        let (low, high) = self.policy.bounds();
        let mut text = String::new();
        for (index, (&low, &high)) in low.iter().zip(high).enumerate() {
            let scaled = if low.is_finite() && high.is_finite() {
                let (middle, half) = (number(0.5 * (low + high)), number(0.5 * (high - low)));
                format!("{middle} + {half} * {result}[{index}]")
            } else {
                format!("{result}[{index}]")
            };
            // a policy without bounds has infinite ones, which C99 cannot write without its mathematical library
            let bounded = match (low.is_finite(), high.is_finite()) {
                (true, true) => format!("clipped({scaled}, {}, {})", number(low), number(high)),
                (true, false) => format!("{scaled} < {0} ? {0} : {scaled}", number(low)),
                (false, true) => format!("{scaled} > {0} ? {0} : {scaled}", number(high)),
                (false, false) => scaled,
            };
            let _ = writeln!(text, "    action[{index}] = {bounded};");
        }
        text
    }
}

/// Returns the functions of the gates of a recurrent layer: those of [`gates`], which need no library.
fn gate_functions() -> String {
    let list = |numbers: [f32; 5]| numbers.map(number).join(", ");
    let values = [
        ("numerator", list(gates::NUMERATOR)),
        ("denominator", list(gates::DENOMINATOR)),
        ("bound", number(gates::BOUND)),
    ];
    fill(include_str!("../templates/gates.c"), &values)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn hover() -> PolicyNetwork {
        PolicyNetwork::load("../assets/policies/hover.safetensors").unwrap()
    }

    #[test]
    fn names_are_identifiers() {
        let name = |task: &str| default_name(&PolicyInfo { task: task.into(), ..hover().info().clone() });
        assert_eq!(name("hover"), "hover_policy");
        assert_eq!(name("3 Gates!"), "gates__policy");
        assert_eq!([name(""), name("__"), name("日本")], ["policy", "policy", "policy"]);
        for bad in ["", "Hover", "9lives", "a b", "a-b", "_a", "\u{e4}", &"a".repeat(61)] {
            let error = source(&hover(), bad, Weights::Float32).unwrap_err().to_string();
            assert!(error.contains("the name is") && error.contains("snake case"), "{error}");
        }
    }

    #[test]
    fn the_size_of_the_constants_is_that_of_the_policy() {
        let policy = hover();
        let (parameters, neurons) = (policy.net().parameters().len(), policy.net().sizes()[1..].iter().sum::<usize>());
        let sizes =
            [Weights::Float32, Weights::Int8].map(|weights| source(&policy, "a", weights).unwrap().constant_bytes);
        let scale = 4 * 2 * policy.observation_size();
        assert_eq!(sizes, [scale + 4 * parameters, scale + parameters - neurons + 8 * neurons]);
    }

    /// Text of the file must not end a comment, or begin a trigraph or a line of code.
    #[test]
    fn metadata_cannot_leave_its_comment() {
        let policy = hover();
        let info = PolicyInfo { command: "*/ int x;\n#error /* ??/".into(), ..policy.info().clone() };
        let space = |bounds: (&[f32], &[f32])| {
            let bounds = bounds.0.iter().zip(bounds.1).map(|(&low, &high)| [f64::from(low), f64::from(high)]);
            aviary::env::BoxSpace::new(bounds)
        };
        let observations =
            aviary::env::BoxSpace::new(vec![[f64::NEG_INFINITY, f64::INFINITY]; policy.observation_size()]);
        let policy = PolicyNetwork::new(info, policy.net().clone(), observations, space(policy.bounds())).unwrap();
        let header = source(&policy, "a", Weights::Float32).unwrap().header;
        let first = header.split("*/").next().unwrap();
        assert!(first.contains("int x;") && first.contains("#error") && !header.contains("??/"), "{header}");
    }
}
