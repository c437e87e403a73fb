//! The window's copy of a flight.

use std::sync::Arc;

use crate::frame::{EpisodeView, Frame};
use crate::shared::{FlightStatus, Shared};

/// Frames of the episode that the window has read.
pub(crate) struct Flight {
    pub episode: Arc<EpisodeView>,
    pub frames: Vec<Arc<Frame>>,
    pub status: FlightStatus,
    /// Index of the frame that the window shows; `None` for the last one.
    pub shown: Option<usize>,
    revision: u64,
}

impl Flight {
    /// Reads a flight, which has at least one frame.
    pub fn of(shared: &Shared) -> Self {
        let state = shared.state();
        Self {
            episode: state.episode.clone(),
            frames: state.frames.clone(),
            status: state.flight.clone(),
            shown: None,
            revision: state.revision,
        }
    }

    /// Reads what has changed.
    pub fn update(&mut self, shared: &Shared) {
        shared.read();
        let state = shared.state();
        if state.frames.is_empty() {
            return;
        }
        if state.revision == self.revision {
            self.frames.extend_from_slice(&state.frames[self.frames.len().min(state.frames.len())..]);
        } else {
            if !Arc::ptr_eq(&state.episode, &self.episode) {
                self.shown = None;
            }
            self.frames.clone_from(&state.frames);
            self.revision = state.revision;
        }
        self.episode = state.episode.clone();
        self.status.clone_from(&state.flight);
        if self.shown.is_some_and(|shown| shown + 1 >= self.frames.len()) {
            self.shown = None;
        }
    }

    /// Returns the frame that the window shows.
    pub fn frame(&self) -> &Arc<Frame> {
        let last = self.frames.len() - 1;
        &self.frames[self.shown.map_or(last, |shown| shown.min(last))]
    }

    /// Returns the frames up to the shown one.
    pub fn past(&self) -> &[Arc<Frame>] {
        &self.frames[..self.shown.map_or(self.frames.len(), |shown| (shown + 1).min(self.frames.len()))]
    }
}
