//! Commands of the person at the window to the flight.

use aviary::control::ControllerKind;
use aviary::physics::wind::WindConfig;
use aviary::rollout::PilotMode;
use nalgebra::Vector3;

/// Command of the person at the window.
///
/// [`LiveFlight`](crate::LiveFlight) executes all of them. Your own loop receives them from
/// [`Viewer::commands`](crate::Viewer::commands) and executes those that it supports.
#[derive(Debug, Clone, PartialEq)]
pub enum Command {
    /// Pauses the flight, or continues it.
    Pause(bool),
    /// Flies one control step of a paused flight.
    Step,
    /// Sets the speed of the flight as a factor of real time.
    Speed(f64),
    /// Starts another episode: with the same seed, or with the next one.
    Restart {
        /// True for the next seed.
        next_seed: bool,
    },
    /// Continues the flight from an earlier control step of the episode.
    Rewind {
        /// Control step to continue from.
        step: u64,
    },
    /// Pulls a drone towards a point (world frame, m), or stops pulling it.
    Push {
        /// Index of the drone.
        drone: usize,
        /// Point that the drone is pulled to; `None` to stop.
        target: Option<Vector3<f64>>,
    },
    /// Sets the wind; `None` for still air.
    Wind(Option<WindConfig>),
    /// Draws a new layout of the obstacles.
    NewObstacles,
    /// Flies all drones with another controller.
    Controller(ControllerKind),
    /// Sets the gain of a motor: 0 stops it, 1 is the nominal motor.
    MotorGain {
        /// Index of the drone.
        drone: usize,
        /// Index of the motor, from 0 to 3.
        motor: usize,
        /// Factor on the commanded speed.
        gain: f64,
    },
    /// Flies a drone by hand, or returns it to its policy.
    Pilot {
        /// Index of the drone.
        drone: usize,
        /// Meaning of the sticks; `None` returns the drone to its policy.
        mode: Option<PilotMode>,
    },
    /// Moves the sticks of the drone that is flown by hand, each from −1 to 1.
    Sticks([f64; 4]),
}
