//! Serialization of the state that an [`Aviary`](super::Aviary) keeps in a snapshot.

use serde::ser::Error as _;
use serde::{Deserialize, Serialize, Serializer};

use super::episode::{Episode, Phase};
use super::randomization::Randomizer;
use super::{EndReason, EnvError, Randomization, Rng, Saved, Task};
use crate::action::{ActionDecoder, ActionType};
use crate::observation::Observation;
use crate::simulation::SimData;

/// State that an [`Aviary`](super::Aviary) keeps in a snapshot.
#[derive(Debug, Serialize)]
#[serde(bound = "T: Task")]
pub(super) struct Snapshot<T> {
    pub data: SimData,
    #[serde(serialize_with = "save_episode")]
    pub episode: Episode<T>,
    pub decoders: Vec<ActionDecoder>,
    pub observation: Observation,
    pub action_type: ActionType,
}

/// Deserialized [`Snapshot`], before the task is restored.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Stored {
    data: SimData,
    episode: StoredEpisode,
    decoders: Vec<ActionDecoder>,
    observation: Observation,
    action_type: ActionType,
}

/// Deserialized [`Episode`], before the task is restored.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct StoredEpisode {
    task_name: String,
    task: Saved,
    rng: Rng,
    stream: u64,
    task_changed: bool,
    randomizer: Option<Box<Randomizer>>,
    /// One entry if the randomization was changed; the entry is `None` if it was switched off.
    next_randomization: Option<[Option<Box<Randomization>>; 1]>,
    phase: Phase,
    end: Option<EndReason>,
    ends: Vec<Option<EndReason>>,
}

fn save_episode<T: Task, S: Serializer>(episode: &Episode<T>, serializer: S) -> Result<S::Ok, S::Error> {
    let task_name = episode.task.name();
    let task = episode.task.save().ok_or_else(|| {
        S::Error::custom(format_args!(
            "the task `{task_name}` cannot be saved, expected one that implements Task::save"
        ))
    })?;
    let stored = StoredEpisode {
        task_name: task_name.into(),
        task,
        rng: episode.rng.into(),
        stream: episode.stream,
        task_changed: episode.task_changed,
        randomizer: episode.randomizer.clone(),
        next_randomization: episode.next_randomization.clone().map(|next| [next]),
        phase: episode.phase,
        end: episode.end,
        ends: episode.ends.to_vec(),
    };
    stored.serialize(serializer)
}

impl<T: Task + Clone> Snapshot<T> {
    /// Reads a snapshot for an environment with this task.
    pub(super) fn read(saved: &Saved, task: &T) -> Result<Self, EnvError> {
        let Stored { data, episode, decoders, observation, action_type } = saved.read()?;
        let mut task = task.clone();
        if episode.task_name != task.name() {
            return Err(EnvError::Snapshot);
        }
        task.load(&episode.task)?;
        let StoredEpisode { rng, stream, task_changed, randomizer, next_randomization, phase, end, ends, .. } = episode;
        let episode = Episode {
            task,
            rng: (&rng).into(),
            stream,
            task_changed,
            randomizer,
            next_randomization: next_randomization.map(|[next]| next),
            phase,
            end,
            ends: ends.into(),
        };
        Ok(Self { data, episode, decoders, observation, action_type })
    }
}
