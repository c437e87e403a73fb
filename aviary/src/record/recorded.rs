use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use super::{RecordError, Recorder};
use crate::env::{DroneEnv, EnvError, EnvSnapshot, Step};
use crate::observation::Observation;
use crate::wrappers::Wrapper;

/// Writes every episode of an environment as CSV into a directory (the paper's `output_folder`): `episode_0000_drone0.csv`, …,
/// in the numbers that are free. A step whose record cannot be written is an error, and has been made. What stands in them and what a crash leaves of them is said at
/// [`Recorder`].
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
/// let flight = Flight::read_named(directory, "episode_0000_")?;
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
    /// Around an environment, into a directory that is made where there is none.
    ///
    /// # Errors
    /// [`RecordError::File`] where it cannot be made.
    pub fn new(env: E, directory: impl AsRef<Path>) -> Result<Self, RecordError> {
        let directory = directory.as_ref().to_path_buf();
        std::fs::create_dir_all(&directory).map_err(|error| RecordError::file(&directory, error))?;
        Ok(Self { env, directory, recorder: None, episodes: 0 })
    }

    /// The environment within.
    pub fn inner(&self) -> &E {
        &self.env
    }

    /// The environment within, to be changed.
    pub fn inner_mut(&mut self) -> &mut E {
        &mut self.env
    }

    /// The environment, recorded no more.
    pub fn into_inner(self) -> E {
        self.env
    }

    fn begin(&mut self) -> Result<(), RecordError> {
        let drones = self.env.simulation().num_drones();
        let mut recorder = loop {
            match Recorder::begin(&self.directory, &prefix(self.episodes), drones, true) {
                // somebody else's, or an earlier run's
                Err(RecordError::File { error, .. }) if error.kind() == ErrorKind::AlreadyExists => self.episodes += 1,
                begun => break begun?,
            }
        };
        recorder.record(&self.env)?;
        self.recorder = Some(recorder);
        self.episodes += 1;
        Ok(())
    }
}

fn prefix(episode: u64) -> String {
    format!("episode_{episode:04}_")
}

/// The directory is the user's: what is wrong with it is an option.
fn unwritable(error: &RecordError) -> EnvError {
    EnvError::Option { option: "directory", got: error.to_string(), expected: "one that can be written" }
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
        this.begin().map_err(|error| unwritable(&error))?;
        Ok(this.env.observation())
    }

    /// Restores the environment within. The flight from there on is another episode in the directory, whose first row is the state of
    /// the snapshot.
    fn restore(this: &mut Self, snapshot: &EnvSnapshot) -> Result<(), EnvError> {
        this.recorder = None;
        this.env.restore(snapshot)?;
        if this.env.info().end.is_none() {
            this.begin().map_err(|error| unwritable(&error))?;
        }
        Ok(())
    }

    fn step<'a>(this: &'a mut Self, action: &[f64]) -> Result<Step<'a>, EnvError> {
        let Step { reward, terminated, truncated, .. } = this.env.step(action)?;
        if let Some(recorder) = &mut this.recorder {
            let env = &this.env;
            // a wrapper within may have changed the reward, and of one drone it is that drone's
            let alone = env.simulation().num_drones() == 1;
            let of = |drone| (if alone { reward } else { env.drone_reward(drone) }, Some(env.reference(drone)));
            recorder.record_with(env.simulation(), of).map_err(|error| unwritable(&error))?;
        }
        if terminated || truncated {
            this.recorder = None;
        }
        Ok(Step { observation: this.env.observation(), reward, terminated, truncated })
    }
}
