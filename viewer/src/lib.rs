//! Window that shows flights while they are simulated.
//!
//! A [`Viewer`] shows an environment that your own loop steps. A [`LiveFlight`] flies an environment in real time and
//! executes the [`Command`]s of the person at the window.

mod command;
mod error;
mod flight;
mod frame;
mod live;
mod orbit;
mod recording;
#[cfg(feature = "rerun")]
pub mod rerun;
mod scene;
mod shared;
mod sticks;
mod ui;
mod viewer;
mod window;

pub use aviary::rollout::PilotMode;
pub use command::Command;
pub use error::ViewerError;
pub use frame::{DroneFrame, EpisodeView, Frame, Source};
pub use live::{Flown, LiveFlight, PilotedRollout, Turn};
pub use orbit::OrbitCamera;
pub use shared::{FlightStatus, ViewStatus};
pub use viewer::{Viewer, ViewerOptions};
pub use window::{check_display, close_windows, has_thread, lower_priority};

#[cfg(doctest)]
#[doc = include_str!("../../docs/window.md")]
mod page {}
