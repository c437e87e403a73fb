//! State that the flight and its window share.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use crate::command::Command;
use crate::error::ViewerError;
use crate::frame::{EpisodeView, Frame};
use crate::orbit::OrbitCamera;

/// State of a window.
#[derive(Debug, Clone, PartialEq)]
pub struct ViewStatus {
    /// Width and height of the window, pixels.
    pub size: [u32; 2],
    /// Left, top, width and height of the scene in the window, pixels.
    pub scene: [u32; 4],
    /// Camera of the last image.
    pub camera: OrbitCamera,
    /// Name of the camera preset; `free` for a camera that the mouse moved.
    pub preset: &'static str,
    /// Drone that the camera follows.
    pub followed: Option<usize>,
    /// Drone that the mouse selected.
    pub selected: Option<usize>,
    /// Number of images since the window opened.
    pub images: u64,
    /// Images per second, averaged over the last second.
    pub images_per_second: f64,
    /// Control step of the frame in the last image.
    pub step: u64,
    /// True while the window records an animation.
    pub is_recording: bool,
}

impl Default for ViewStatus {
    fn default() -> Self {
        let lookat = nalgebra::Vector3::new(0.0, 0.0, 1.0);
        Self {
            size: [0; 2],
            scene: [0; 4],
            camera: OrbitCamera { lookat, distance: 2.0, azimuth: 50.0, elevation: -20.0 },
            preset: "track",
            followed: None,
            selected: None,
            images: 0,
            images_per_second: 0.0,
            step: 0,
            is_recording: false,
        }
    }
}

/// State of the flight, for the controls of the window.
#[derive(Debug, Clone, PartialEq)]
pub struct FlightStatus {
    /// True if the flight executes [`Command`]s; otherwise the window has no controls for them.
    pub is_interactive: bool,
    /// True if the flight can be paused and its speed can be set.
    pub is_paced: bool,
    /// True while the flight is paused.
    pub is_paused: bool,
    /// Requested speed as a factor of real time.
    pub speed: f64,
    /// Measured speed as a factor of real time.
    pub measured_speed: f64,
    /// Seed of the episode, if it is known.
    pub seed: Option<u64>,
    /// Name of the controller or policy.
    pub pilot: String,
    /// Drone that is flown by hand.
    pub piloted: Option<usize>,
    /// Message for the person at the window, such as a command that failed.
    pub message: Option<String>,
}

impl Default for FlightStatus {
    fn default() -> Self {
        Self {
            is_interactive: false,
            is_paced: false,
            is_paused: false,
            speed: 1.0,
            measured_speed: 0.0,
            seed: None,
            pilot: String::new(),
            piloted: None,
            message: None,
        }
    }
}

/// Frames of an episode and the states of both sides.
pub(crate) struct State {
    pub episode: Arc<EpisodeView>,
    pub frames: Vec<Arc<Frame>>,
    /// Changes whenever frames are removed or replaced.
    pub revision: u64,
    pub flight: FlightStatus,
    pub status: ViewStatus,
    pub is_open: bool,
    pub error: Option<ViewerError>,
}

impl State {
    /// Largest number of frames of one drone in memory; then every second frame of the older half is removed.
    const MAX_FRAMES: usize = 100_000;

    /// Adds a frame.
    pub fn push(&mut self, frame: Arc<Frame>) {
        let max = (Self::MAX_FRAMES / frame.drones.len().max(1)).max(1000);
        if self.frames.len() >= max {
            let (mut index, half) = (0, max / 2);
            self.frames.retain(|_| {
                index += 1;
                index > half || index % 2 == 1
            });
            self.revision += 1;
        }
        self.frames.push(frame);
    }
}

/// State and commands that the flight and its window share.
pub(crate) struct Shared {
    state: Mutex<State>,
    commands: Mutex<VecDeque<Command>>,
    arrived: Condvar,
    /// True from a change of the state until the window reads it.
    is_stale: AtomicBool,
    /// True while the window has resources of OpenGL.
    has_window: AtomicBool,
}

impl Shared {
    pub fn new(episode: EpisodeView) -> Self {
        Self {
            state: Mutex::new(State {
                episode: Arc::new(episode),
                frames: Vec::new(),
                revision: 0,
                flight: FlightStatus::default(),
                status: ViewStatus::default(),
                is_open: true,
                error: None,
            }),
            commands: Mutex::default(),
            arrived: Condvar::new(),
            is_stale: AtomicBool::new(true),
            has_window: AtomicBool::new(false),
        }
    }

    pub fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Sends a command to the flight.
    pub fn send(&self, command: Command) {
        let mut commands = self.commands.lock().unwrap_or_else(PoisonError::into_inner);
        // only the last position of a stick or of the mouse counts
        let replaces = |old: &Command| {
            matches!((old, &command), (Command::Sticks(_), Command::Sticks(_)))
                || matches!((old, &command), (Command::Push { drone: a, .. }, Command::Push { drone: b, .. }) if a == b)
        };
        match commands.back_mut() {
            Some(last) if replaces(last) => *last = command,
            _ => commands.push_back(command),
        }
        drop(commands);
        self.arrived.notify_all();
    }

    /// Removes and returns the next command.
    pub fn next_command(&self) -> Option<Command> {
        self.commands.lock().unwrap_or_else(PoisonError::into_inner).pop_front()
    }

    /// Waits for a command or for the end of the window, at most until `deadline`.
    pub fn wait(&self, deadline: Option<Instant>) {
        let commands = self.commands.lock().unwrap_or_else(PoisonError::into_inner);
        if !commands.is_empty() || !self.state().is_open {
            return;
        }
        match deadline.map(|deadline| deadline.saturating_duration_since(Instant::now())) {
            Some(left) if left.is_zero() => {}
            Some(left) => drop(self.arrived.wait_timeout(commands, left)),
            // a bound, so that a missed wake-up cannot stop a flight for ever
            None => drop(self.arrived.wait_timeout(commands, std::time::Duration::from_millis(200))),
        }
    }

    /// Marks the window as closed.
    pub fn close(&self, error: Option<ViewerError>) {
        let mut state = self.state();
        state.is_open = false;
        if state.error.is_none() {
            state.error = error;
        }
        drop(state);
        // a waiting flight holds this lock until it waits
        drop(self.commands.lock().unwrap_or_else(PoisonError::into_inner));
        self.arrived.notify_all();
    }

    /// Marks the state as changed. Returns true if the window has read all earlier changes.
    pub fn touch(&self) -> bool {
        !self.is_stale.swap(true, Ordering::AcqRel)
    }

    /// Notes that the window has been created or that its resources have been released.
    pub fn set_has_window(&self, has_window: bool) {
        self.has_window.store(has_window, Ordering::Release);
    }

    /// Returns true while the window has resources of OpenGL.
    pub fn has_window(&self) -> bool {
        self.has_window.load(Ordering::Acquire)
    }

    /// Marks the state as read.
    pub fn read(&self) {
        self.is_stale.store(false, Ordering::Release);
    }
}
