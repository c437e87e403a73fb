use std::path::PathBuf;
use std::sync::Arc;

use aviary::env::DroneEnv;
use aviary::simulation::Simulation;
use nalgebra::Vector3;

use crate::command::Command;
use crate::error::ViewerError;
use crate::frame::{EpisodeView, Frame, Source};
use crate::shared::{FlightStatus, Shared, ViewStatus};
use crate::window;

/// Options of a window.
#[derive(Debug, Clone, PartialEq)]
pub struct ViewerOptions {
    /// Title of the window.
    pub title: String,
    /// Initial width and height, pixels.
    pub size: [u32; 2],
    /// Directory for images and animations that the person saves. It is created when it is needed.
    pub output: PathBuf,
    /// True if the window shows its panels when it opens.
    pub panels: bool,
    /// True for shadows, reflections and several samples per pixel; `None` for a choice by the device: true on a GPU.
    pub is_pretty: Option<bool>,
    /// True to leave the processors to other work: the threads of the window run while a processor is idle, and draw
    /// at most ten images per second and 1/60 of the time, except under the mouse and the keys.
    pub in_background: bool,
}

impl Default for ViewerOptions {
    fn default() -> Self {
        Self {
            title: "MuJoCo-Drones-Gym".into(),
            size: [1280, 720],
            output: "out/view".into(),
            panels: true,
            is_pretty: None,
            in_background: false,
        }
    }
}

/// Window that shows a flight.
///
/// All windows of a process have one thread, which the first window starts. [`sync`](Self::sync) copies the state and
/// returns at once, so that a slow display does not slow the flight. The window draws with its own copy of the scene:
/// the flight is bit-identical to one without a window.
///
/// ```no_run
/// use aviary::env::{DroneEnv, Env};
/// use aviary::tasks::Hover;
/// use viewer::{Viewer, ViewerOptions};
///
/// let mut env = Hover::builder().build()?;
/// env.reset(Some(1))?;
/// let mut viewer = Viewer::open(&env, ViewerOptions::default())?;
/// while viewer.sync(&env)? {
///     let step = env.step(&[0.1; 4])?;
///     if step.terminated || step.truncated {
///         env.reset(None)?;
///     }
/// }
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct Viewer {
    shared: Arc<Shared>,
    last: Option<Arc<Frame>>,
    episodes: u64,
}

impl Viewer {
    /// Opens a window for an environment that has been reset.
    ///
    /// # Errors
    /// [`ViewerError`] that names what is missing: a display, OpenGL, or a scene that MuJoCo can draw.
    pub fn open(env: &dyn DroneEnv, options: ViewerOptions) -> Result<Self, ViewerError> {
        Self::open_source(Source::Env(env), options)
    }

    /// Opens a window for a simulation without a task.
    ///
    /// # Errors
    /// As for [`open`](Self::open).
    pub fn open_simulation(simulation: &Simulation, options: ViewerOptions) -> Result<Self, ViewerError> {
        Self::open_source(Source::Simulation(simulation), options)
    }

    fn open_source(source: Source<'_>, options: ViewerOptions) -> Result<Self, ViewerError> {
        let shared = Arc::new(Shared::new(EpisodeView::new(source, 1)));
        let mut viewer = Self { shared, last: None, episodes: 0 };
        viewer.publish(source, |drone| source.reference(drone), |_| {});
        window::open(viewer.shared.clone(), options)?;
        Ok(viewer)
    }

    /// Creates a viewer that has no window.
    #[cfg(test)]
    pub(crate) fn without_window(source: Source<'_>) -> Self {
        let shared = Arc::new(Shared::new(EpisodeView::new(source, 1)));
        Self { shared, last: None, episodes: 0 }
    }

    /// Shows the present state of an environment. Call it after every reset and every step. A smaller number of control
    /// steps than in the last call, or another environment, starts a new episode in the window.
    ///
    /// Returns false after the window was closed; further calls have no effect.
    ///
    /// # Errors
    /// [`ViewerError::Disconnected`] once if the connection to the display ended, [`ViewerError::Scene`] once if the
    /// scene cannot be drawn, and [`ViewerError::Recording`] once if the person has closed the window and its animation
    /// cannot be completed. Later calls return false.
    pub fn sync(&mut self, env: &dyn DroneEnv) -> Result<bool, ViewerError> {
        self.sync_with(Source::Env(env), |drone| Some(env.reference(drone).position), |_| {})
    }

    /// Shows the present state of a simulation like [`sync`](Self::sync).
    ///
    /// # Errors
    /// As for [`sync`](Self::sync).
    pub fn sync_simulation(&mut self, simulation: &Simulation) -> Result<bool, ViewerError> {
        self.sync_with(Source::Simulation(simulation), |_| None, |_| {})
    }

    /// Shows the present state like [`sync`](Self::sync), with references (world frame, m) of the caller. `edit` may
    /// change the frame.
    pub(crate) fn sync_with(
        &mut self,
        source: Source<'_>,
        reference: impl Fn(usize) -> Option<Vector3<f64>>,
        edit: impl FnOnce(&mut Frame),
    ) -> Result<bool, ViewerError> {
        if self.is_open()? {
            self.publish(source, reference, edit);
            return Ok(true);
        }
        Ok(false)
    }

    fn publish(
        &mut self,
        source: Source<'_>,
        reference: impl Fn(usize) -> Option<Vector3<f64>>,
        edit: impl FnOnce(&mut Frame),
    ) {
        let simulation = source.simulation();
        let step = simulation.control_steps();
        let is_same = |last: &Frame| last.drones.iter().map(|drone| &drone.state).eq(simulation.states());
        let name = self.shared.state().episode.task.clone();
        let is_same_scene = |last: &Frame| {
            name == source.name()
                && last.drones.len() == simulation.num_drones()
                && last.obstacles.len() == simulation.obstacles().len()
                && last.markers.len() == simulation.world().markers.len()
        };
        let continues = self
            .last
            .as_ref()
            .filter(|last| is_same_scene(last) && (last.step < step || last.step == step && is_same(last)));
        let is_repeated = continues.is_some_and(|last| last.step == step);
        let mut frame = Frame::new(source, continues.map(|last| &**last), reference);
        if is_repeated && let Some(last) = continues {
            frame.episode_reward = last.episode_reward;
        }
        edit(&mut frame);
        let episode = continues.is_none().then(|| {
            self.episodes += 1;
            Arc::new(EpisodeView::new(source, self.episodes))
        });
        let frame = Arc::new(frame);
        let mut state = self.shared.state();
        if let Some(episode) = episode {
            state.episode = episode;
            state.frames.clear();
            state.revision += 1;
        }
        if is_repeated {
            state.frames.pop();
            state.revision += 1;
        }
        state.push(frame.clone());
        drop(state);
        self.last = Some(frame);
        self.wake();
    }

    /// Removes the frames after a control step from the window.
    pub(crate) fn rewind(&mut self, step: u64) {
        let mut state = self.shared.state();
        state.frames.retain(|frame| frame.step <= step);
        state.revision += 1;
        self.last = state.frames.last().cloned();
        drop(state);
        self.wake();
    }

    /// Returns true while the window is open.
    ///
    /// # Errors
    /// As for [`sync`](Self::sync).
    pub fn is_open(&self) -> Result<bool, ViewerError> {
        let mut state = self.shared.state();
        match state.error.take() {
            Some(error) => Err(error),
            None => Ok(state.is_open),
        }
    }

    /// Returns the commands that have arrived since the last call.
    pub fn commands(&mut self) -> Vec<Command> {
        std::iter::from_fn(|| self.shared.next_command()).collect()
    }

    /// Returns the state of the window.
    pub fn status(&self) -> ViewStatus {
        self.shared.state().status.clone()
    }

    /// Sets the state of the flight for the controls of the window.
    pub fn set_flight_status(&mut self, flight: FlightStatus) {
        let mut state = self.shared.state();
        if state.flight == flight {
            return;
        }
        state.flight = flight;
        drop(state);
        self.wake();
    }

    /// Closes the window. The end of the value closes it, too.
    pub fn close(&mut self) {
        self.shared.close(None);
        self.wake();
    }

    /// Returns a function that closes the window from any thread.
    pub fn closer(&self) -> impl Fn() + Send + Sync + use<> {
        let shared = self.shared.clone();
        move || {
            shared.close(None);
            if shared.touch() {
                window::wake();
            }
        }
    }

    pub(crate) fn shared(&self) -> &Arc<Shared> {
        &self.shared
    }

    fn wake(&self) {
        if self.shared.touch() {
            window::wake();
        }
    }
}

impl Drop for Viewer {
    fn drop(&mut self) {
        self.close();
        window::wait_for_end(&self.shared);
        let error = self.shared.state().error.take();
        if let Some(error @ ViewerError::Recording { .. }) = error {
            // the end of the window has shown that the file is not complete
            tracing::warn!("{error}");
        }
    }
}

impl std::fmt::Debug for Viewer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Viewer").field("status", &self.status()).finish_non_exhaustive()
    }
}
