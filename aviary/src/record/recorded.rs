use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use super::{CsvLog, RecordError};
use crate::env::{Env, EnvError, Step};
use crate::observation::Observation;
use crate::wrappers::forward_env;

/// Writes every episode of an environment as CSV: `episode_0000.csv`, `episode_0001.csv`, …, the first number that is free and on, in a directory (the paper's
/// `output_folder`), with the columns of a [`CsvLog`].
///
/// ```
/// use aviary::env::Env;
/// use aviary::record::Recorded;
/// use aviary::tasks::Hover;
///
/// # let directory = tempfile::tempdir()?;
/// # let directory = directory.path();
/// let mut env = Recorded::new(Hover::builder().build()?, directory)?;
/// env.reset(Some(1))?;
/// env.step(&[0.1; 4])?;
/// env.finish()?;
/// assert!(directory.join("episode_0000.csv").exists());
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct Recorded<E> {
    env: E,
    directory: PathBuf,
    log: Option<CsvLog<BufWriter<File>>>,
    episodes: u64,
}

impl<E: Env> Recorded<E> {
    /// Around an environment, into a directory that is made where there is none.
    ///
    /// # Errors
    /// [`RecordError::Flush`] where it cannot be made.
    pub fn new(env: E, directory: impl AsRef<Path>) -> Result<Self, RecordError> {
        let directory = directory.as_ref().to_path_buf();
        std::fs::create_dir_all(&directory)?;
        // an earlier run's files are left alone
        let mut episodes = 0;
        while path(&directory, episodes).exists() {
            episodes += 1;
        }
        Ok(Self { env, directory, log: None, episodes })
    }

    /// The environment within.
    pub fn inner(&self) -> &E {
        &self.env
    }

    /// Ends the log of the running episode and gives the environment back.
    ///
    /// # Errors
    /// [`RecordError`] where something could not be written.
    pub fn finish(mut self) -> Result<E, RecordError> {
        self.end_log()?;
        Ok(self.env)
    }

    fn end_log(&mut self) -> Result<(), RecordError> {
        if let Some(log) = self.log.take() {
            let file = log.finish()?;
            file.into_inner().map_err(|error| RecordError::Flush(error.into_error()))?;
        }
        Ok(())
    }

    fn begin_log(&mut self) -> Result<(), RecordError> {
        self.end_log()?;
        let file = File::create(path(&self.directory, self.episodes))?;
        let mut log = CsvLog::new(BufWriter::new(file))?;
        log.record(self.env.simulation())?;
        self.log = Some(log);
        self.episodes += 1;
        Ok(())
    }
}

fn path(directory: &Path, episode: u64) -> PathBuf {
    directory.join(format!("episode_{episode:04}.csv"))
}

/// The directory is the user's: what is wrong with it is an option.
fn unwritable(directory: &Path, error: &RecordError) -> EnvError {
    let cause = std::error::Error::source(error).map_or_else(|| error.to_string(), ToString::to_string);
    let got = format!("{} ({cause})", directory.display());
    EnvError::Option { option: "the directory for records", got, expected: "one that can be written" }
}

impl<E: Env> Env for Recorded<E> {
    forward_env!(self => self.env);

    fn reset(&mut self, seed: Option<u64>) -> Result<&Observation, EnvError> {
        self.env.reset(seed)?;
        self.begin_log().map_err(|error| unwritable(&self.directory, &error))?;
        Ok(self.env.observation())
    }

    fn step(&mut self, action: &[f64]) -> Result<Step<'_>, EnvError> {
        let Step { reward, terminated, truncated, .. } = self.env.step(action)?;
        if let Some(log) = &mut self.log {
            log.record(self.env.simulation()).map_err(|error| unwritable(&self.directory, &error))?;
        }
        if terminated || truncated {
            self.end_log().map_err(|error| unwritable(&self.directory, &error))?;
        }
        Ok(Step { observation: self.env.observation(), reward, terminated, truncated })
    }
}
