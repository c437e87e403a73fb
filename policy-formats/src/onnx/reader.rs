//! Evaluation of ONNX files.

use std::path::Path;
use std::sync::Arc;

use aviary::SystemError;
use aviary::env::DroneEnv;
use aviary::policy::{PolicyError, PolicyInfo};
use aviary::rollout::{Policy, PolicySnapshot, RolloutError};
use prost::Message as _;
use rten::{Dimension, Model, ModelOptions, NodeId, ValueOrView, ValueView};

use rten_tensor::prelude::AsView as _;

use super::model::ModelProto;
use super::runtime::{guarded, wrong};
use super::{METADATA_KEY, limits};
use crate::{FormatError, unsupported};

/// Range of the outputs of a graph.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ActionRange {
    /// The output is the action. The environment clips it to the action space.
    #[default]
    Space,
    /// The output is scaled from −1…1 to the action space.
    Unit,
}

impl ActionRange {
    /// Returns the range of a name, `space` or `unit`.
    fn named(name: &str) -> Result<Self, FormatError> {
        match name {
            "space" => Ok(Self::Space),
            "unit" => Ok(Self::Unit),
            _ => Err(unsupported("action_range", format_args!("`{name}`"), "space or unit")),
        }
    }
}

/// Mapping of observations to the inputs of a graph and of its outputs to actions. What is `None` comes from the
/// metadata of the file, which has the same names for keys.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct OnnxOptions {
    /// Entries of the observation that are inputs, in the order of the graph; default all of them. The metadata has a
    /// list that [`parse_indices`] reads.
    pub observation_indices: Option<Vec<usize>>,
    /// Range of the outputs: `space` (default) or `unit`.
    pub action_range: Option<ActionRange>,
    /// Name of the output that is the action; default the first output.
    pub action_output: Option<String>,
    /// True if the policy also flies environments with another action type than that of its metadata.
    pub any_action_type: bool,
}

/// Input that the graph keeps between steps, such as the hidden state of a recurrent layer, and the output that is its
/// next value.
#[derive(Debug, Clone)]
struct Memory {
    input: NodeId,
    output: NodeId,
    /// Sizes of the dimensions of the input, with 0 for the dimension of rows.
    shape: Vec<usize>,
    /// Number of entries for one row.
    size: usize,
}

/// Largest number of entries of a memory.
const MAX_MEMORY: usize = 1 << 20;

/// A policy in an ONNX file.
///
/// The graph has one input for observations, with the shape rows × entries, and an output for actions, with the shape
/// rows × components, both in single precision. Each further input is a memory: it is zero at the start of an episode,
/// and then the further output at the same place. Other further outputs, such as values, are ignored.
///
/// ```
/// use aviary::policy::PolicyNetwork;
/// use aviary::rollout::fly_episode;
/// use aviary::tasks::Hover;
/// use policy_formats::onnx::{OnnxOptions, OnnxPolicy, to_bytes};
///
/// let trained = PolicyNetwork::load("../assets/policies/hover.safetensors")?;
/// let policy = OnnxPolicy::from_bytes(to_bytes(&trained)?, &OnnxOptions::default())?;
/// assert_eq!(policy.info().map(|info| info.task.as_str()), Some("hover"));
/// let summary = fly_episode(&mut Hover::builder().build()?, &mut policy.pilot(), Some(1))?;
/// assert!(summary.success);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone)]
pub struct OnnxPolicy {
    graph: Arc<Graph>,
    info: Option<PolicyInfo>,
    indices: Option<Vec<usize>>,
    range: ActionRange,
    /// True if an environment with another action type than that of the metadata does not fit.
    keeps_action_type: bool,
}

/// A graph with its inputs and outputs.
struct Graph {
    model: Model,
    input: NodeId,
    /// Number of entries of the input, if the file has it.
    entries: Option<usize>,
    output: NodeId,
    memories: Vec<Memory>,
    /// True if the graph evaluates a single row at a time.
    is_single: bool,
}

impl std::fmt::Debug for OnnxPolicy {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("OnnxPolicy").field("info", &self.info).field("range", &self.range).finish_non_exhaustive()
    }
}

impl OnnxPolicy {
    /// Reads a policy from a file.
    ///
    /// # Errors
    /// [`FormatError::Policy`] with the path if the file cannot be read, and the errors of
    /// [`from_bytes`](Self::from_bytes).
    pub fn load(path: impl AsRef<Path>, options: &OnnxOptions) -> Result<Self, FormatError> {
        let path = path.as_ref();
        let in_file = |error: std::io::Error| PolicyError::File {
            path: path.into(),
            error: Box::new(SystemError::from(error).into()),
        };
        Self::from_bytes(std::fs::read(path).map_err(in_file)?, options)
    }

    /// Reads a policy from the bytes of a file.
    ///
    /// # Errors
    /// [`FormatError::Onnx`] for bytes that are not an ONNX file, operators that policies do not have, sizes above 2²⁴
    /// entries, and inputs or outputs of another kind. [`FormatError::Unsupported`] for invalid options or metadata.
    pub fn from_bytes(bytes: Vec<u8>, options: &OnnxOptions) -> Result<Self, FormatError> {
        // the runtime does not end at numbers of more than ten bytes
        limits::validate(&ModelProto::decode(&bytes[..]).map_err(wrong)?)?;
        let model = guarded(|| ModelOptions::with_all_ops().load(bytes))?;
        let of_file = |key: &str| model.metadata().get(key).map(str::to_string);
        let info = match of_file(METADATA_KEY) {
            Some(text) => Some(
                serde_json::from_str::<PolicyInfo>(&text)
                    .map_err(|error| wrong(format_args!("its metadata `policy`: {error}")))?,
            ),
            None => None,
        };
        let indices = match (&options.observation_indices, of_file("observation_indices")) {
            (Some(indices), _) => Some(indices.clone()),
            (None, Some(text)) => Some(parse_indices(&text)?),
            (None, None) => None,
        };
        let range = match (options.action_range, of_file("action_range")) {
            (Some(range), _) => range,
            (None, Some(name)) => ActionRange::named(&name)?,
            (None, None) => ActionRange::default(),
        };
        let output = options.action_output.clone().or_else(|| of_file("action_output"));
        let graph = Graph::new(model, output.as_deref())?;
        if let (Some(indices), Some(entries)) = (&indices, graph.entries)
            && indices.len() != entries
        {
            let expected = format!("{entries} numbers, one per input of the graph");
            return Err(unsupported("observation_indices", format_args!("{} numbers", indices.len()), expected));
        }
        let keeps_action_type = !options.any_action_type;
        Ok(Self { graph: Arc::new(graph), info, indices, range, keeps_action_type })
    }

    /// Returns the metadata, if this program or one that knows its format wrote the file.
    pub fn info(&self) -> Option<&PolicyInfo> {
        self.info.as_ref()
    }

    /// Returns the smallest number of entries of an observation (of one drone, if the policy is per drone) that the
    /// policy can read; `None` for any number.
    pub fn inputs(&self) -> Option<usize> {
        match &self.indices {
            Some(indices) => indices.iter().max().map(|largest| largest + 1),
            None => self.graph.entries,
        }
    }

    /// Returns true if the inputs are chosen entries of the observation, which may have any number of further entries.
    pub fn has_indices(&self) -> bool {
        self.indices.is_some()
    }

    /// Returns true if the policy maps the observation of each drone to the action of this drone.
    fn is_per_drone(&self) -> bool {
        self.info.as_ref().is_some_and(|info| info.per_drone)
    }

    /// Returns the number of memory entries for one row.
    pub fn memory_size(&self) -> usize {
        self.graph.memories.iter().map(|memory| memory.size).sum()
    }

    /// Checks that the policy can fly an environment, and evaluates it once.
    ///
    /// # Errors
    /// [`FormatError::Mismatch`] with the sizes of both, and [`FormatError::Onnx`] for a graph that cannot be evaluated.
    pub fn check(&self, env: &dyn DroneEnv) -> Result<(), FormatError> {
        let rows = if self.is_per_drone() { env.simulation().num_drones() } else { 1 };
        let (observed, acted) = (env.observation_space().vector.size() / rows, env.action_space().size() / rows);
        if let Some(info) = self.info.as_ref().filter(|_| self.keeps_action_type)
            && info.action_type != env.action_type().name()
        {
            let (policy, env) = (format!("actions {}", info.action_type), format!("actions {}", env.action_type()));
            return Err(FormatError::Mismatch { policy, env });
        }
        let mismatch = |policy: String| {
            let action_type = env.action_type();
            FormatError::Mismatch {
                policy,
                env: format!("{observed} observations and {acted} actions ({action_type})"),
            }
        };
        if observed == 0 {
            return Err(mismatch("an observation of numbers".into()));
        }
        let entries = match &self.indices {
            Some(indices) => {
                if let Some(index) = indices.iter().find(|&&index| index >= observed) {
                    return Err(mismatch(format!("the observation index {index}")));
                }
                indices.len()
            }
            None => observed,
        };
        if self.graph.entries.is_some_and(|expected| expected != entries) {
            let (inputs, name) = (self.graph.entries.unwrap_or_default(), self.graph.name(self.graph.input));
            return Err(mismatch(format!("{inputs} inputs (`{name}`)")));
        }
        let mut memory = vec![0.0; self.memory_size()];
        let mut output = Vec::new();
        self.graph.evaluate(1, &vec![0.0; entries], &mut memory, &mut output)?;
        if output.len() != acted {
            return Err(mismatch(format!("{} outputs (`{}`)", output.len(), self.graph.name(self.graph.output))));
        }
        Ok(())
    }

    /// Returns a policy for an episode, with a memory of its own.
    pub fn pilot(&self) -> OnnxPilot {
        OnnxPilot { policy: self.clone(), checked: None, memory: Vec::new(), input: Vec::new(), output: Vec::new() }
    }

    /// Returns the outputs of the graph for rows of its inputs, at the start of an episode: without the options that
    /// map observations and actions.
    ///
    /// # Errors
    /// [`FormatError::Onnx`] for a graph that cannot be evaluated.
    pub fn actions(&self, inputs: &[f32], rows: usize) -> Result<Vec<f32>, FormatError> {
        if rows == 0 || !inputs.len().is_multiple_of(rows) {
            return Err(wrong(format_args!("{} inputs are not {rows} rows of equal length", inputs.len())));
        }
        let mut output = Vec::new();
        self.graph.evaluate(rows, inputs, &mut vec![0.0; rows * self.memory_size()], &mut output)?;
        Ok(output)
    }

    /// Computes the actions for rows of observations, each of them of one drone if the policy is per drone, with the
    /// options that map observations and actions, and updates the memories of the rows. `memories` has
    /// [`memory_size`](Self::memory_size) entries per row, which are zero at the start of an episode. `bounds` are the
    /// lower and upper bounds of an action.
    ///
    /// ```
    /// use aviary::policy::PolicyNetwork;
    /// use policy_formats::onnx::{OnnxOptions, OnnxPolicy, to_bytes};
    ///
    /// let trained = PolicyNetwork::load("../assets/policies/hover.safetensors")?;
    /// let policy = OnnxPolicy::from_bytes(to_bytes(&trained)?, &OnnxOptions::default())?;
    /// let (observations, mut actions, mut expected) = ([0.1; 2 * 12], [0.0; 2 * 4], [0.0; 2 * 4]);
    /// policy.forward(&observations, 2, &mut [], (&[-1.0; 4], &[1.0; 4]), &mut actions)?;
    /// trained.forward(&observations, &mut expected);
    /// assert!(actions.iter().zip(expected).all(|(action, expected)| (action - expected).abs() < 1e-5));
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    ///
    /// # Errors
    /// [`FormatError::Onnx`] for lengths that do not fit, for a graph that cannot be evaluated, and for one that returns
    /// another number of components.
    pub fn forward(
        &self,
        observations: &[f64],
        rows: usize,
        memories: &mut [f32],
        bounds: (&[f64], &[f64]),
        actions: &mut [f64],
    ) -> Result<(), FormatError> {
        if rows == 0 || observations.is_empty() || !observations.len().is_multiple_of(rows) {
            return Err(wrong(format_args!("{} observations are not {rows} rows of equal length", observations.len())));
        }
        let (entries, expected) = (observations.len() / rows, rows * self.memory_size());
        if let Some(index) = self.indices.iter().flatten().find(|&&index| index >= entries) {
            return Err(wrong(format_args!(
                "an observation has {entries} entries, expected one with the index {index}"
            )));
        }
        if memories.len() != expected {
            return Err(wrong(format_args!("the memories have {} entries, expected {expected}", memories.len())));
        }
        self.evaluate(observations, rows, memories, (&mut Vec::new(), &mut Vec::new()), bounds, actions)
    }

    /// Computes the actions for the observations of several drones, row by row; `memories` has
    /// [`memory_size`](Self::memory_size) entries per row, which are zero at the start of an episode.
    ///
    /// # Errors
    /// [`FormatError::Onnx`] for a graph that cannot be evaluated, or that returns another number of components.
    fn evaluate(
        &self,
        observations: &[f64],
        rows: usize,
        memories: &mut [f32],
        scratch: (&mut Vec<f32>, &mut Vec<f32>),
        bounds: (&[f64], &[f64]),
        actions: &mut [f64],
    ) -> Result<(), FormatError> {
        let (input, output) = scratch;
        input.clear();
        for row in observations.chunks_exact(observations.len() / rows) {
            match &self.indices {
                Some(indices) => input.extend(indices.iter().map(|&index| row[index] as f32)),
                None => input.extend(row.iter().map(|&x| x as f32)),
            }
        }
        self.graph.evaluate(rows, input, memories, output)?;
        if output.len() != actions.len() {
            return Err(wrong(format_args!("it returns {} numbers, expected {}", output.len(), actions.len())));
        }
        let (low, high) = bounds;
        for (index, (action, &x)) in actions.iter_mut().zip(&*output).enumerate() {
            let (low, high) = (low[index % low.len()], high[index % high.len()]);
            *action = match self.range {
                ActionRange::Unit if low.is_finite() && high.is_finite() => {
                    0.5 * (low + high) + 0.5 * (high - low) * f64::from(x).clamp(-1.0, 1.0)
                }
                _ => f64::from(x),
            };
        }
        Ok(())
    }
}

/// Reads a list of indices and ranges that are separated by commas, such as `6-8,0-5`.
///
/// # Errors
/// [`FormatError::Unsupported`] for the part of the list that is not a number up to 9999 or a rising range.
pub fn parse_indices(list: &str) -> Result<Vec<usize>, FormatError> {
    /// Largest index, far beyond every observation.
    const LARGEST: usize = 9999;
    let wrong = |part: &str| {
        let expected = format!("numbers from 0 to {LARGEST} and ranges such as 6-8, separated by commas");
        unsupported("observation_indices", format_args!("`{part}`"), expected)
    };
    let mut indices = Vec::new();
    for part in list.split(',').map(str::trim) {
        let number =
            |text: &str| text.parse::<usize>().ok().filter(|&index| index <= LARGEST).ok_or_else(|| wrong(part));
        match part.split_once('-') {
            None => indices.push(number(part)?),
            Some((first, last)) => {
                let range = number(first)?..=number(last)?;
                if range.is_empty() {
                    return Err(wrong(part));
                }
                indices.extend(range);
            }
        }
    }
    Ok(indices)
}

/// Returns the size of a dimension, if it is fixed.
fn fixed(dimension: &Dimension) -> Option<usize> {
    match dimension {
        Dimension::Fixed(size) => Some(*size),
        Dimension::Symbolic(_) => None,
    }
}

impl Graph {
    fn new(model: Model, action_output: Option<&str>) -> Result<Self, FormatError> {
        let name = |id: NodeId| model.node_info(id).and_then(|info| info.name()).unwrap_or_default().to_string();
        let shape = |id: NodeId| model.node_info(id).and_then(|info| info.shape());
        let (&input, further) =
            model.input_ids().split_first().ok_or_else(|| wrong("it has no input, expected observations"))?;
        let dimensions = shape(input).unwrap_or_default();
        let (is_single, entries) = match &dimensions[..] {
            [] => (false, None),
            [rows, entries] => match fixed(rows) {
                None => (false, fixed(entries)),
                Some(1) => (true, fixed(entries)),
                Some(rows) => {
                    return Err(wrong(format_args!(
                        "its input `{}` has {rows} rows, expected any number or one",
                        name(input)
                    )));
                }
            },
            _ => {
                return Err(wrong(format_args!(
                    "its input `{}` has {} dimensions, expected rows and entries",
                    name(input),
                    dimensions.len()
                )));
            }
        };
        let outputs = model.output_ids();
        let output = match action_output {
            Some(wanted) => outputs.iter().copied().find(|&id| name(id) == wanted).ok_or_else(|| {
                let names: Vec<_> = outputs.iter().map(|&id| name(id)).collect();
                unsupported("action_output", format_args!("`{wanted}`"), names.join(" or "))
            })?,
            None => *outputs.first().ok_or_else(|| wrong("it has no output, expected actions"))?,
        };
        let mut others = outputs.iter().copied().filter(|&id| id != output);
        let mut memories = Vec::new();
        for &input in further {
            let what = name(input);
            let output = others.next().ok_or_else(|| {
                wrong(format_args!(
                    "its input `{what}` has no output for its next value, expected one per further input"
                ))
            })?;
            let dimensions = shape(input).unwrap_or_default();
            let rows = dimensions.iter().position(|dimension| fixed(dimension).is_none());
            let sizes: Vec<usize> = dimensions.iter().map(|dimension| fixed(dimension).unwrap_or(0)).collect();
            // the rows must lie one after the other
            let begins = rows.unwrap_or(sizes.len());
            let usable = !sizes.is_empty()
                && (rows.is_some() || is_single)
                && sizes.iter().filter(|&&size| size == 0).count() == usize::from(rows.is_some())
                && (is_single || sizes[..begins].iter().all(|&size| size == 1));
            if !usable {
                return Err(wrong(format_args!(
                    "its input `{what}` has the shape {sizes:?}, expected any number of rows (0), then fixed sizes"
                )));
            }
            let entries = sizes.iter().filter(|&&size| size > 0).try_fold(1_usize, |all, &size| all.checked_mul(size));
            let size = entries.filter(|&size| size <= MAX_MEMORY).ok_or_else(|| {
                let limit = format!("at most {MAX_MEMORY} entries");
                wrong(format_args!("its input `{what}` has the shape {sizes:?}, expected {limit}"))
            })?;
            memories.push(Memory { input, output, shape: sizes, size });
        }
        Ok(Self { input, entries, output, memories, is_single, model })
    }

    fn name(&self, id: NodeId) -> String {
        self.model.node_info(id).and_then(|info| info.name()).unwrap_or_default().to_string()
    }

    /// Evaluates rows; `memory` has the memories of a row next to each other.
    fn evaluate(
        &self,
        rows: usize,
        input: &[f32],
        memory: &mut [f32],
        output: &mut Vec<f32>,
    ) -> Result<(), FormatError> {
        output.clear();
        let together = if self.is_single { 1 } else { rows };
        let (entries, kept) = (input.len() / rows, memory.len() / rows);
        for first in (0..rows).step_by(together.max(1)) {
            let input = &input[first * entries..(first + together) * entries];
            let memory = &mut memory[first * kept..(first + together) * kept];
            self.run(together, input, memory, output)?;
        }
        Ok(())
    }

    fn run(&self, rows: usize, input: &[f32], memory: &mut [f32], output: &mut Vec<f32>) -> Result<(), FormatError> {
        let entries = input.len() / rows;
        let kept = memory.len() / rows;
        let seen = ValueView::from_shape([rows, entries], input).map_err(wrong)?;
        let mut values: Vec<(NodeId, ValueOrView<'_>)> = vec![(self.input, seen.into())];
        let mut packed = Vec::new();
        let mut begin = 0;
        for slot in &self.memories {
            let of_row = |row: usize| &memory[row * kept + begin..row * kept + begin + slot.size];
            packed.push((0..rows).flat_map(|row| of_row(row).iter().copied()).collect::<Vec<f32>>());
            begin += slot.size;
        }
        for (slot, values_of_slot) in self.memories.iter().zip(&packed) {
            let shape: Vec<usize> = slot.shape.iter().map(|&size| if size == 0 { rows } else { size }).collect();
            let view = rten_tensor::TensorView::from_data(&shape[..], &values_of_slot[..]);
            values.push((slot.input, ValueView::from(view).into()));
        }
        let wanted: Vec<NodeId> =
            [self.output].into_iter().chain(self.memories.iter().map(|slot| slot.output)).collect();
        let results = guarded(|| self.model.run(values, &wanted, None))?;
        let mut results = results.into_iter();
        let numbers = |value: Option<rten::Value>, output: NodeId| -> Result<Vec<f32>, FormatError> {
            let tensor: rten_tensor::Tensor<f32> =
                value.ok_or_else(|| wrong("an output is missing"))?.try_into().map_err(|_| {
                    wrong(format_args!("its output `{}` has another type than single precision", self.name(output)))
                })?;
            Ok(tensor.to_vec())
        };
        let actions = numbers(results.next(), self.output)?;
        if actions.len() % rows != 0 {
            let name = self.name(self.output);
            return Err(wrong(format_args!("its output `{name}` has {} numbers for {rows} rows", actions.len())));
        }
        output.extend(actions);
        let mut begin = 0;
        for slot in &self.memories {
            let next = numbers(results.next(), slot.output)?;
            if next.len() != rows * slot.size {
                let (got, expected, name) = (next.len(), rows * slot.size, self.name(slot.output));
                return Err(wrong(format_args!(
                    "its output `{name}` has {got} numbers, expected {expected} of a memory"
                )));
            }
            for (row, next) in next.chunks_exact(slot.size).enumerate() {
                memory[row * kept + begin..row * kept + begin + slot.size].copy_from_slice(next);
            }
            begin += slot.size;
        }
        Ok(())
    }
}

/// An [`OnnxPolicy`] with its memory, which flies an environment.
#[derive(Debug, Clone)]
pub struct OnnxPilot {
    policy: OnnxPolicy,
    /// Observation and action sizes and the number of drones of the last checked environment.
    checked: Option<[usize; 3]>,
    /// Memories of the rows, one after the other.
    memory: Vec<f32>,
    input: Vec<f32>,
    output: Vec<f32>,
}

/// Returns an error of a format as one of a policy.
fn of_policy(error: FormatError) -> RolloutError {
    RolloutError::Policy(match error {
        FormatError::Policy(error) => error,
        FormatError::Mismatch { policy, env } => PolicyError::Mismatch { policy, env },
        FormatError::Onnx { message } => PolicyError::Format { message },
        error => PolicyError::Format { message: error.to_string() },
    })
}

impl OnnxPilot {
    fn rows(&self, env: &dyn DroneEnv) -> usize {
        if self.policy.is_per_drone() { env.simulation().num_drones() } else { 1 }
    }
}

impl Policy for OnnxPilot {
    fn reset(&mut self, env: &dyn DroneEnv) -> Result<(), RolloutError> {
        let sizes = [env.observation_space().vector.size(), env.action_space().size(), env.simulation().num_drones()];
        if self.checked != Some(sizes) {
            self.policy.check(env).map_err(of_policy)?;
            self.checked = Some(sizes);
        }
        self.memory.clear();
        self.memory.resize(self.rows(env) * self.policy.memory_size(), 0.0);
        Ok(())
    }

    fn act(&mut self, env: &dyn DroneEnv, action: &mut [f64]) -> Result<(), RolloutError> {
        let rows = self.rows(env);
        self.memory.resize(rows * self.policy.memory_size(), 0.0);
        let space = env.action_space();
        let scratch = (&mut self.input, &mut self.output);
        let observation = &env.observation().vector;
        (self.policy)
            .evaluate(observation, rows, &mut self.memory, scratch, (space.low(), space.high()), action)
            .map_err(of_policy)
    }

    fn reset_drone(&mut self, env: &dyn DroneEnv, drone: usize) -> Result<(), RolloutError> {
        let size = self.policy.memory_size();
        // a memory that several drones share stays as it is
        let is_own = self.policy.is_per_drone() || env.simulation().num_drones() == 1;
        if let Some(memory) = self.memory.get_mut(drone * size..(drone + 1) * size).filter(|_| is_own) {
            memory.fill(0.0);
        }
        Ok(())
    }

    fn snapshot(&self) -> PolicySnapshot {
        PolicySnapshot::new(self.memory.clone())
    }

    fn restore(&mut self, snapshot: &PolicySnapshot) -> Result<(), RolloutError> {
        self.memory.clone_from(snapshot.own()?);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Numbers of ten bytes that do not end, in every message: the runtime alone reads them for ever.
    #[test]
    fn numbers_that_do_not_end_are_errors() {
        fn tagged(tag: u8, content: &[u8]) -> Vec<u8> {
            [&[tag, content.len() as u8], content].concat()
        }
        // a field that no message has
        let endless = [&[0x78][..], &[0xff; 24]].concat();
        // graph: initializer, node with an attribute with a tensor, input, value_info
        let nested: [&[u8]; 6] = [&[], &[0x3a], &[0x2a, 0x3a], &[0x2a, 0x2a, 0x0a, 0x3a], &[0x5a, 0x3a], &[0x6a, 0x3a]];
        for tags in nested {
            let bytes = tags.iter().fold(endless.clone(), |content, &tag| tagged(tag, &content));
            let error = OnnxPolicy::from_bytes(bytes, &OnnxOptions::default()).unwrap_err().to_string();
            assert!(error.starts_with("not a policy in ONNX") && error.contains("varint"), "{tags:x?}: {error}");
        }
    }

    #[test]
    fn lists_of_indices_have_numbers_and_ranges() {
        assert_eq!(parse_indices("6-8,0, 2-2").unwrap(), [6, 7, 8, 0, 2]);
        for bad in ["", "1,", "a", "3-1", "-1", "1-", "0-10000", "1--2", "[1,2]", "99999999999999999999"] {
            let error = parse_indices(bad).unwrap_err().to_string();
            assert!(error.contains("expected numbers from 0 to 9999 and ranges"), "{bad}: {error}");
        }
    }
}
