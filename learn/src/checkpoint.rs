//! Checkpoints: the state of a run as one safetensors file.

use std::collections::HashMap;
use std::path::Path;

use aviary::SystemError;
use aviary::policy::{PolicyError, PolicyNetwork};
use safetensors::{Dtype, SafeTensors, tensor::TensorView};
use serde::{Deserialize, Serialize};

use crate::curve::Point;
use crate::evaluation::Score;
use crate::network::{LOG_DEVIATIONS, NetworkShape};
use crate::optimizer::Moments;
use crate::ppo::PpoConfig;
use crate::scale::{RewardScale, Running};
use crate::{TrainConfig, TrainError};

/// Metadata key of the state.
const KEY: &str = "training";

/// Part of a checkpoint that is stored as JSON metadata.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct State {
    pub config: TrainConfig,
    pub command: String,
    pub iteration: u64,
    /// Number of optimizer steps.
    pub time: usize,
    pub rate: f64,
    pub observations: Running,
    pub rewards: RewardScale,
    pub best: Option<Score>,
}

#[derive(Debug)]
pub(crate) struct Checkpoint {
    pub state: State,
    pub parameters: Vec<f32>,
    pub moments: Moments,
    pub curve: Vec<Point>,
    /// Content of the best policy's file.
    pub best: Vec<u8>,
}

/// Limits that the numbers of a checkpoint must satisfy.
pub(crate) struct Limits<'a> {
    pub shape: &'a NetworkShape,
    pub steps_per_iteration: u64,
    /// Largest number of optimizer steps in an iteration.
    pub updates_per_iteration: u64,
}

/// Validates a list of numbers.
fn validate_numbers(name: &str, numbers: &[f32], expected: usize) -> Result<(), String> {
    if numbers.len() != expected {
        return Err(format!("`{name}` has {} numbers, expected {expected}", numbers.len()));
    }
    match numbers.iter().enumerate().find(|(_, x)| !x.is_finite()) {
        Some((index, x)) => Err(format!("entry {index} of `{name}` is {x}, expected a finite number")),
        None => Ok(()),
    }
}

impl Checkpoint {
    /// Returns the shape of the networks: that of the configuration, with the number of observations in the state and
    /// `action` actions.
    pub fn shape(&self, action: usize) -> NetworkShape {
        let PpoConfig { hidden, activation, recurrent, .. } = &self.state.config.ppo;
        NetworkShape::new(self.state.observations.size(), action, hidden, *activation).with_recurrent(*recurrent)
    }

    /// Validates the parameters and the scales of the networks.
    pub fn validate_networks(&self, shape: &NetworkShape) -> Result<(), String> {
        let Self { state, parameters, .. } = self;
        validate_numbers("parameters", parameters, shape.count())?;
        let (_, _, logs) = shape.split(parameters);
        if let Some(log) = logs.iter().find(|log| !LOG_DEVIATIONS.contains(log)) {
            return Err(format!("the logarithm of a standard deviation is {log}, expected {LOG_DEVIATIONS:?}"));
        }
        if !state.observations.is_of(shape.observation()) {
            return Err("`observations` has no valid means and sums of squares of the observations".into());
        }
        if !state.rewards.is_sane() {
            return Err("`rewards` has no valid mean and sum of squares".into());
        }
        Ok(())
    }

    /// Validates every number.
    pub fn validate(&self, run: &Limits<'_>, best: &PolicyNetwork) -> Result<(), String> {
        let Self { state, moments, curve, .. } = self;
        self.validate_networks(run.shape)?;
        for (name, numbers) in [("moments.first", &moments.first), ("moments.second", &moments.second)] {
            validate_numbers(name, numbers, run.shape.count())?;
        }
        if let Some((index, x)) = moments.second.iter().enumerate().find(|(_, x)| **x < 0.0) {
            return Err(format!("entry {index} of `moments.second` is {x}, expected 0 or more"));
        }
        let entries = curve.len() as u64;
        if state.iteration != entries {
            return Err(format!("`iteration` is {}, expected {entries}, the length of `curve`", state.iteration));
        }
        // the optimizer raises its decay rates to this power, as an i32
        let max = entries
            .saturating_mul(run.updates_per_iteration)
            .min((i32::MAX as u64).saturating_sub(run.updates_per_iteration));
        if moments.time as u64 > max {
            return Err(format!("`time` is {}, expected up to {max} optimizer steps", moments.time));
        }
        if !(state.rate > 0.0 && state.rate <= state.config.ppo.learning_rate) {
            let max = state.config.ppo.learning_rate;
            return Err(format!("`rate` is {}, expected above 0 and up to {max}", aviary::number(state.rate)));
        }
        for (index, point) in (1..).zip(curve) {
            let steps = index * run.steps_per_iteration;
            if (point.iteration, point.steps) != (index, steps) {
                let (iteration, got) = (point.iteration, point.steps);
                return Err(format!(
                    "entry {index} of `curve` is iteration {iteration} with {got} steps, expected {index} with {steps}"
                ));
            }
        }
        let sizes = (best.observation_size(), best.memory_size(), best.action_size());
        let wanted = (run.shape.observation(), run.shape.recurrent, run.shape.action());
        if (&best.info().task, sizes) != (&state.config.task, wanted) {
            return Err(format!(
                "the best policy is for {} with sizes {sizes:?}, expected {} with {wanted:?}",
                best.info().task,
                state.config.task
            ));
        }
        Ok(())
    }

    pub fn to_bytes(&self) -> Result<Vec<u8>, TrainError> {
        let wrong = |message: String| TrainError::from(PolicyError::Format { message });
        let bytes = |numbers: &[f32]| numbers.iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>();
        let curve = serde_json::to_vec(&self.curve).map_err(|error| wrong(error.to_string()))?;
        let parts = [
            ("parameters", Dtype::F32, bytes(&self.parameters)),
            ("moments.first", Dtype::F32, bytes(&self.moments.first)),
            ("moments.second", Dtype::F32, bytes(&self.moments.second)),
            ("curve", Dtype::U8, curve),
            ("best", Dtype::U8, self.best.clone()),
        ];
        let mut views = Vec::new();
        for (name, kind, bytes) in &parts {
            let size = if *kind == Dtype::F32 { 4 } else { 1 };
            let view = TensorView::new(*kind, vec![bytes.len() / size], bytes);
            views.push((*name, view.map_err(|error| wrong(error.to_string()))?));
        }
        let state = serde_json::to_string(&self.state).map_err(|error| wrong(error.to_string()))?;
        safetensors::serialize(views, Some(HashMap::from([(KEY.to_string(), state)])))
            .map_err(|error| wrong(error.to_string()))
    }

    pub fn load(path: &Path) -> Result<Self, TrainError> {
        let in_file = |error| TrainError::File { path: path.into(), error: Box::new(error) };
        let bytes = std::fs::read(path).map_err(|error| in_file(SystemError::from(error).into()))?;
        Self::from_bytes(&bytes).map_err(|message| in_file(TrainError::Checkpoint { message }))
    }

    pub fn from_bytes(bytes: &[u8]) -> Result<Self, String> {
        let (_, metadata) = SafeTensors::read_metadata(bytes).map_err(|error| error.to_string())?;
        let tensors = SafeTensors::deserialize(bytes).map_err(|error| error.to_string())?;
        let state = metadata.metadata().as_ref().and_then(|metadata| metadata.get(KEY));
        let state: State =
            serde_json::from_str(state.ok_or("the metadata has no `training`")?).map_err(|error| error.to_string())?;
        let tensor = |name: &str, kind: Dtype| {
            let view = tensors.tensor(name).map_err(|error| error.to_string())?;
            if view.dtype() == kind { Ok(view.data()) } else { Err(format!("`{name}` has type {:?}", view.dtype())) }
        };
        let numbers = |name: &str| -> Result<Vec<f32>, String> {
            let data = tensor(name, Dtype::F32)?;
            Ok(data.chunks_exact(4).map(|x| f32::from_le_bytes([x[0], x[1], x[2], x[3]])).collect())
        };
        Ok(Self {
            parameters: numbers("parameters")?,
            moments: Moments { time: state.time, first: numbers("moments.first")?, second: numbers("moments.second")? },
            curve: serde_json::from_slice(tensor("curve", Dtype::U8)?).map_err(|error| error.to_string())?,
            best: tensor("best", Dtype::U8)?.to_vec(),
            state,
        })
    }
}
