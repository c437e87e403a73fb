use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use super::{RecordError, Recorder};
use crate::env::{DroneEnv, EnvError, EnvSnapshot, Step};
use crate::observation::Observation;
use crate::wrappers::Wrapper;

/// A wrapper that writes every episode of an environment as CSV into a directory (the paper's `output_folder`). The
/// files are `episode_0000_drone0.csv`, …, with the next free episode numbers. If a row cannot be written, the step
/// returns an [`EnvError::File`] around an [`EnvError::System`] although the environment has advanced. [`Recorder`]
/// describes the content of the files and their state after a crash.
///
/// ```
/// use aviary::env::Env;
/// use aviary::record::{Flight, Recorded};
/// use aviary::tasks::Hover;
///
/// # let directory = tempfile::tempdir()?;
/// # let directory = directory.path();
/// let mut env = Recorded::new(Hover::builder().build()?, directory)?;
/// env.reset(Some(1))?;
/// let reward = env.step(&[0.1; 4])?.reward;
/// let flight = Flight::read_episode(directory, 0)?;
/// assert_eq!(flight.drones[0].len(), 2);
/// assert_eq!(flight.drones[0][1].reward, reward);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct Recorded<E> {
    env: E,
    directory: PathBuf,
    recorder: Option<Recorder>,
    episodes: u64,
}

impl<E: DroneEnv> Recorded<E> {
    /// Creates a wrapper around an environment. The directory is created if necessary.
    ///
    /// # Errors
    /// [`RecordError::File`] if the directory cannot be created.
    pub fn new(env: E, directory: impl AsRef<Path>) -> Result<Self, RecordError> {
        let directory = directory.as_ref().to_path_buf();
        std::fs::create_dir_all(&directory).map_err(|error| RecordError::file(&directory, error))?;
        Ok(Self { env, directory, recorder: None, episodes: 0 })
    }

    /// Returns the wrapped environment.
    pub fn inner(&self) -> &E {
        &self.env
    }

    /// Returns the wrapped environment for changes.
    pub fn inner_mut(&mut self) -> &mut E {
        &mut self.env
    }

    /// Ends the files of the running episode. The environment continues, and the next reset begins the next files.
    pub fn end_episode(&mut self) {
        self.recorder = None;
    }

    /// Returns the wrapped environment and stops recording.
    pub fn into_inner(self) -> E {
        self.env
    }

    fn begin(&mut self) -> Result<(), RecordError> {
        let drones = self.env.simulation().num_drones();
        let mut recorder = loop {
            match Recorder::begin(&self.directory, &prefix(self.episodes), drones, true) {
                // the number belongs to an earlier run or to another program
                Err(RecordError::File { error, .. }) if error.kind() == ErrorKind::AlreadyExists => self.episodes += 1,
                created => break created?,
            }
        };
        recorder.record(&self.env)?;
        self.recorder = Some(recorder);
        self.episodes += 1;
        Ok(())
    }
}

/// Returns the start of the names of an episode's files.
pub(super) fn prefix(episode: u64) -> String {
    format!("episode_{episode:04}_")
}

/// Converts an error of a recording: that of a file to an error of the system with the path of the file.
fn unwritable(error: RecordError) -> EnvError {
    let system = |error: std::io::Error| EnvError::System(error.into());
    match error {
        RecordError::File { path, error } => EnvError::File { path, error: Box::new(system(error)) },
        error => system(std::io::Error::other(error.to_string())),
    }
}

impl<E: DroneEnv> Wrapper for Recorded<E> {
    type Inner = E;

    fn inner(this: &Self) -> &E {
        &this.env
    }

    fn inner_mut(this: &mut Self) -> &mut E {
        &mut this.env
    }

    fn reset(this: &mut Self, seed: Option<u64>) -> Result<&Observation, EnvError> {
        this.recorder = None;
        this.env.reset(seed)?;
        this.begin().map_err(unwritable)?;
        Ok(this.env.observation())
    }

    /// Restores the wrapped environment. The flight after the snapshot is a new episode in the directory, whose
    /// first row is the state of the snapshot.
    fn restore(this: &mut Self, snapshot: &EnvSnapshot) -> Result<(), EnvError> {
        this.recorder = None;
        this.env.restore(snapshot)?;
        if this.env.info().end.is_none() {
            this.begin().map_err(unwritable)?;
        }
        Ok(())
    }

    fn step<'a>(this: &'a mut Self, action: &[f64]) -> Result<Step<'a>, EnvError> {
        let Step { reward, terminated, truncated, .. } = this.env.step(action)?;
        if let Some(recorder) = &mut this.recorder {
            let env = &this.env;
            // a wrapper inside may have changed the reward, which for a single drone is the reward of that drone
            let alone = env.simulation().num_drones() == 1;
            let of = |drone| (if alone { reward } else { env.drone_reward(drone) }, Some(env.reference(drone)));
            recorder.record_with(env.simulation(), of).map_err(unwritable)?;
        }
        if terminated || truncated {
            this.recorder = None;
        }
        Ok(Step { observation: this.env.observation(), reward, terminated, truncated })
    }
}
