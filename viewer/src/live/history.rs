//! Saved states of an episode, to continue from.

use super::Flown;

/// Saved states. Their spacing grows so that their number stays limited.
#[derive(Debug)]
pub(super) struct History<S> {
    saved: Vec<(u64, S)>,
    /// Number of control steps between saved states.
    every: u64,
}

impl<S> Default for History<S> {
    fn default() -> Self {
        Self { saved: Vec::new(), every: 1 }
    }
}

impl<S> History<S> {
    /// Largest number of saved states of one drone.
    const MAX: usize = 4_096;

    /// Saves the present state if it is due.
    pub fn keep(&mut self, flown: &dyn Flown<Saved = S>) {
        let step = flown.source().simulation().control_steps();
        // a step that is shown again replaces its state, which a command may have changed
        while self.saved.last().is_some_and(|(last, _)| *last >= step) {
            self.saved.pop();
        }
        if !step.is_multiple_of(self.every) {
            return;
        }
        let drones = flown.source().simulation().num_drones();
        if self.saved.len() >= (Self::MAX / drones.max(1)).max(64) {
            self.every *= 2;
            let every = self.every;
            self.saved.retain(|(step, _)| step.is_multiple_of(every));
            if !step.is_multiple_of(every) {
                return;
            }
        }
        self.saved.push((step, flown.save()));
    }

    /// Restores the last saved state up to a control step, and returns its step.
    pub fn rewind(&mut self, flown: &mut dyn Flown<Saved = S>, step: u64) -> Result<u64, String> {
        let Some(index) = self.saved.iter().rposition(|(saved, _)| *saved <= step) else {
            return Err(format!("the state of control step {step} is not saved"));
        };
        flown.restore(&self.saved[index].1)?;
        self.saved.truncate(index + 1);
        Ok(self.saved[index].0)
    }
}
