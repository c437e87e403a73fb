//! Records of a flight: files, and samples in memory for plots.

use aviary::record::{Flight as Samples, ObstaclePose, RecordError, Recorder, obstacle_poses};
use aviary::simulation::Simulation;
use nalgebra::Vector3;

use super::result::Errors;
use crate::failure::Failure;
use crate::output::OutputDir;
use crate::pilot::Pilot;

/// Records of a flight: files, and samples in memory for plots.
pub(super) struct Log {
    recorder: Option<Recorder>,
    pub(super) samples: Option<Samples>,
    /// Poses of the moving obstacles after each control step, if there are samples.
    poses: Vec<ObstaclePose>,
}

impl Log {
    /// Creates the files, if the flight has a directory.
    pub(super) fn begin(out: Option<&OutputDir>, drones: usize, has_samples: bool) -> Result<Self, Failure> {
        let recorder = out.map(|out| Recorder::create(out.path(), drones)).transpose().map_err(Failure::work)?;
        Ok(Self { recorder, samples: has_samples.then(Samples::default), poses: Vec::new() })
    }

    /// Replaces the records by those of a new episode.
    pub(super) fn restart(&mut self, out: Option<&OutputDir>, drones: usize) -> Result<(), Failure> {
        // the old files end before the new ones replace them
        self.recorder = None;
        *self = Self::begin(out, drones, self.samples.is_some())?;
        Ok(())
    }

    /// Removes the records after the present time of the simulation.
    pub(super) fn rewind(&mut self, out: Option<&OutputDir>, simulation: &Simulation) -> Result<(), Failure> {
        let Some(mut samples) = self.samples.take() else { return Ok(()) };
        samples.rewind(simulation.time());
        // the old files end before the new ones replace them
        self.recorder = None;
        let mut poses = std::mem::take(&mut self.poses);
        poses.retain(|pose| pose.time <= simulation.time());
        *self = Self::begin(out, samples.drones.len(), false)?;
        if let Some(recorder) = &mut self.recorder {
            recorder.record_flight(&samples).map_err(Failure::work)?;
            if !simulation.moving_obstacles().is_empty() {
                recorder.record_obstacle_poses(simulation, &poses).map_err(Failure::work)?;
            }
        }
        (self.samples, self.poses) = (Some(samples), poses);
        Ok(())
    }

    /// Returns the errors and the reward of the control steps in the records.
    pub(super) fn totals(&self) -> (Errors, f64) {
        let (mut errors, mut reward) = (Errors::default(), 0.0);
        let drones = self.samples.as_ref().map_or(&[][..], |samples| &samples.drones);
        let rows = drones.first().map_or(0, Vec::len);
        // the first row is the state before the first control step
        for row in 1..rows {
            for samples in drones {
                let sample = &samples[row];
                reward += sample.reward;
                if let Some((position, _)) = sample.reference {
                    errors.add(sample.time, (sample.state.position - Vector3::from(position)).norm());
                }
            }
            errors.forget(drones[0][row].time);
        }
        (errors, reward)
    }

    pub(super) fn note(&mut self, pilot: &Pilot) -> Result<(), Failure> {
        let simulation = pilot.env().simulation();
        let of = |drone| (pilot.reward(drone), Some(pilot.reference(drone)));
        if let Some(samples) = &mut self.samples {
            samples.note_with(simulation, of);
            if simulation.control_steps() > 0 {
                self.poses.extend(obstacle_poses(simulation));
            }
        }
        match &mut self.recorder {
            Some(recorder) => recorder.record_with(simulation, of).map_err(|error: RecordError| Failure::work(error)),
            None => Ok(()),
        }
    }
}
