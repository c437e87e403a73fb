//! Everything that a run needs to go on, as one safetensors file.

use std::collections::HashMap;
use std::path::Path;

use aviary::policy::PolicyError;
use safetensors::{Dtype, SafeTensors, tensor::TensorView};
use serde::{Deserialize, Serialize};

use crate::evaluation::Score;
use crate::optimizer::Moments;
use crate::scale::{RewardScale, Running};
use crate::trainer::{Point, Trainer};
use crate::{TrainConfig, TrainError};

/// Key of the metadata.
const KEY: &str = "training";

/// What is no tensor of it.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct State {
    pub config: TrainConfig,
    pub command: String,
    pub iteration: u64,
    /// Adam's steps.
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
    /// The best policy's file.
    pub best: Vec<u8>,
}

impl Checkpoint {
    pub fn of(trainer: &Trainer) -> Self {
        let (command, ppo, iteration, best) = trainer.parts();
        let moments = ppo.optimizer.moments(ppo.parameters.len());
        Self {
            state: State {
                config: trainer.config().clone(),
                command: command.into(),
                iteration,
                time: moments.time,
                rate: ppo.rate,
                observations: ppo.observations.clone(),
                rewards: ppo.rewards.clone(),
                best,
            },
            parameters: ppo.parameters.clone(),
            moments,
            curve: trainer.curve().to_vec(),
            best: trainer.best().to_bytes(),
        }
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
        let wrong = |message: String| TrainError::File { path: path.into(), message };
        let bytes = std::fs::read(path).map_err(|error| wrong(error.to_string()))?;
        Self::from_bytes(&bytes).map_err(|message| wrong(format!("not a checkpoint: {message}")))
    }

    pub fn from_bytes(bytes: &[u8]) -> Result<Self, String> {
        let (_, metadata) = SafeTensors::read_metadata(bytes).map_err(|error| error.to_string())?;
        let tensors = SafeTensors::deserialize(bytes).map_err(|error| error.to_string())?;
        let state = metadata.metadata().as_ref().and_then(|metadata| metadata.get(KEY));
        let state: State =
            serde_json::from_str(state.ok_or("its metadata has no `training`")?).map_err(|error| error.to_string())?;
        let tensor = |name: &str, kind: Dtype| {
            let view = tensors.tensor(name).map_err(|error| error.to_string())?;
            if view.dtype() == kind { Ok(view.data()) } else { Err(format!("`{name}` is of {:?}", view.dtype())) }
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
