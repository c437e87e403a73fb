//! State of the learner for checkpoints, and back.

use learn::{LearnerState, Running};

use super::GpuPpo;
use super::machine::{Machine, launch};
use super::statistics::rescale_kernel;
use crate::error::GpuError;

impl GpuPpo {
    /// Copies the state to the host.
    pub(super) fn read_state(&self) -> Result<LearnerState, GpuError> {
        let Machine { parameters, moments, control, .. } = &self.machine;
        let [parameters, moments, control, running] =
            self.machine.read([parameters, moments, control, &self.running])?;
        let size = self.shape.observation();
        let (first, second) = moments.split_at(moments.len() / 2);
        let (means, variances) = running.split_at(size + 1);
        let wide = |numbers: &[f32]| numbers.iter().map(|&x| f64::from(x)).collect::<Vec<f64>>();
        let statistics = |count: f64, range: std::ops::Range<usize>| {
            Running::of(count, wide(&means[range.clone()]), &wide(&variances[range]))
        };
        Ok(LearnerState {
            parameters,
            optimizer_steps: self.time,
            first_moments: first.to_vec(),
            second_moments: second.to_vec(),
            learning_rate: f64::from(control[0]).min(self.config.learning_rate),
            observations: statistics(self.seen[0], 0..size),
            rewards: statistics(self.seen[1], size..size + 1),
        })
    }

    /// Copies a state to the device.
    pub(super) fn write_state(&mut self, state: &LearnerState) -> Result<(), GpuError> {
        let machine = &mut self.machine;
        let narrow = |numbers: &[f64]| numbers.iter().map(|&x| x as f32).collect::<Vec<f32>>();
        machine.parameters = machine.floats(&state.parameters);
        machine.moments = machine.floats(&[&state.first_moments[..], &state.second_moments[..]].concat());
        machine.control = machine.floats(&[state.learning_rate as f32, 0.0]);
        let means = [state.observations.means(), state.rewards.means()].concat();
        // the scale is 1 without samples, as on the CPU
        let spread = |of: &Running| if of.count() > 1.0 { of.variances() } else { vec![1.0; of.size()] };
        let variances = [spread(&state.observations), spread(&state.rewards)].concat();
        self.running = machine.floats(&[narrow(&means), narrow(&variances)].concat());
        self.seen = [state.observations.count(), state.rewards.count()];
        (self.time, self.rate) = (state.optimizer_steps, state.learning_rate);
        let size = self.shape.observation();
        let machine = &self.machine;
        launch!(machine, rescale_kernel, size + 1, self.running.arg(), self.scale.arg(), size);
        self.machine.wait()
    }
}
