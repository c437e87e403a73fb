//! Recordings of flights for Rerun.

use std::path::PathBuf;

use clap::{Args, ValueHint};

use crate::failure::Failure;
use crate::pilot::Pilot;

// not a doc comment, which would replace the description of a command: options of a recording
#[derive(Debug, Default, Args)]
pub struct RerunOptions {
    /// Recording for Rerun: a file (.rrd), or the address of a viewer
    ///
    /// The recording has the scene with meshes, trails and cameras, and series over time. A
    /// viewer on this machine has the address rerun+http://127.0.0.1:9876/proxy. The option
    /// needs a program that was built with `--features rerun`.
    #[arg(long, verbatim_doc_comment, value_name = "TARGET", value_hint = ValueHint::FilePath)]
    rerun: Option<String>,
    /// Images of the onboard cameras in the recording, ten per second
    #[arg(long, requires = "rerun")]
    rerun_images: bool,
}

pub use implementation::RerunWriter;

#[cfg(feature = "rerun")]
mod implementation {
    use viewer::Flown as _;
    use viewer::rerun::{RerunError, RerunLog, RerunTarget};

    use super::*;
    use crate::output::OutputFile;

    impl RerunOptions {
        pub fn validate(&self) -> Result<(), Failure> {
            Ok(())
        }

        fn target(&self) -> Option<RerunTarget> {
            self.rerun.as_ref().map(|text| RerunTarget::from(text.as_str()))
        }

        /// Returns the file of the recording, if there is one.
        pub fn file(&self) -> Option<PathBuf> {
            match self.target()? {
                RerunTarget::File(path) => Some(path),
                RerunTarget::Viewer(_) => None,
            }
        }

        /// Begins the recording of a flight that has just started, if the option is set.
        pub fn begin(&self, pilot: &Pilot) -> Result<Option<RerunWriter>, Failure> {
            let Some(mut target) = self.target() else { return Ok(None) };
            let file = match &mut target {
                RerunTarget::File(path) => {
                    let file = OutputFile::begin(path)?;
                    *path = file.path().into();
                    Some(file)
                }
                RerunTarget::Viewer(_) => None,
            };
            let log = RerunLog::begin_with(&target, pilot.source(), references(pilot), self.rerun_images);
            Ok(Some(RerunWriter { log: log.map_err(failure)?, file }))
        }
    }

    /// Recording of a flight.
    pub struct RerunWriter {
        log: RerunLog,
        file: Option<OutputFile>,
    }

    impl RerunWriter {
        /// Records the present state.
        pub fn note(&mut self, pilot: &Pilot) -> Result<(), Failure> {
            self.log.note_with(pilot.source(), references(pilot)).map_err(failure)
        }

        /// Writes what is still in memory, and gives the file its name.
        pub fn finish(self) -> Result<(), Failure> {
            self.log.finish().map_err(failure)?;
            self.file.map_or(Ok(()), OutputFile::keep)
        }
    }

    fn references(pilot: &Pilot) -> impl Fn(usize) -> Option<nalgebra::Vector3<f64>> {
        |drone| Some(pilot.reference(drone).position)
    }

    fn failure(error: RerunError) -> Failure {
        Failure::work(error)
    }
}

#[cfg(not(feature = "rerun"))]
mod implementation {
    use super::*;

    impl RerunOptions {
        pub fn validate(&self) -> Result<(), Failure> {
            match (&self.rerun, self.rerun_images) {
                (None, false) => Ok(()),
                _ => Err(Failure::input(anyhow::anyhow!(
                    "this program was built without Rerun; fix: cargo run --release -p cli --features rerun -- fly …"
                ))),
            }
        }

        /// Returns the file of the recording: none.
        pub fn file(&self) -> Option<PathBuf> {
            None
        }

        /// Begins no recording.
        pub fn begin(&self, _: &Pilot) -> Result<Option<RerunWriter>, Failure> {
            Ok(None)
        }
    }

    /// Recording of a flight, of which this program has none.
    pub enum RerunWriter {}

    impl RerunWriter {
        /// Records the present state.
        pub fn note(&mut self, _: &Pilot) -> Result<(), Failure> {
            match *self {}
        }

        /// Writes what is still in memory.
        pub fn finish(self) -> Result<(), Failure> {
            match self {}
        }
    }
}
