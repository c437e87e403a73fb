use super::Simulation;
use crate::drone::DroneError;
use crate::engine::{BuildError, EngineKind};
use crate::error::OptionError;
use crate::physics::{Effects, Physics};
use crate::world::World;

/// Error of a simulation.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum SimulationError {
    /// An obstacle whose shape differs from the one that it replaces.
    #[error("obstacle {index} has another shape than the obstacle that it replaces")]
    Obstacle {
        /// Index of the obstacle.
        index: usize,
    },
    /// Data or a snapshot that belongs to another model.
    #[error("the data belongs to a model with another scene, airframe, physics, engine, rate or initial state")]
    Model,
    /// A failed simulation that was read from a file.
    #[error("{message}")]
    Stored {
        /// Message of the original error.
        message: String,
    },
    /// Gravity out of range.
    #[error("gravity is {} m/s², expected a number within ±{}", crate::number(*got), World::MAX_GRAVITY)]
    Gravity {
        /// Gravity that was set, m/s².
        got: f64,
    },
    /// An invalid option of the wind or the motors.
    #[error(transparent)]
    Option(#[from] OptionError),
    /// Invalid parameters of an airframe.
    #[error("drone {drone}: {error}")]
    Drone {
        /// Index of the drone.
        drone: usize,
        /// Error of the airframe.
        #[source]
        error: DroneError,
    },
    /// An index that no drone has.
    #[error("drone {got} does not exist, expected an index from 0 to {}", drones - 1)]
    NoDrone {
        /// The index.
        got: usize,
        /// Number of drones.
        drones: usize,
    },
    /// Invalid physics and control rates.
    #[error(
        "sim_freq is {sim_freq} Hz and ctrl_freq {ctrl_freq} Hz, \
         expected ctrl_freq > 0 and a multiple of it up to {} Hz",
        Simulation::MAX_SIM_FREQ
    )]
    Rates {
        /// Physics rate, Hz.
        sim_freq: u32,
        /// Control rate, Hz.
        ctrl_freq: u32,
    },
    /// A list of the wrong length.
    #[error("{what} has {}, expected one for each of {}", crate::count(*got, "entry"), crate::count(*expected, of))]
    Length {
        /// Name of the list.
        what: &'static str,
        /// Its length.
        got: usize,
        /// Expected length.
        expected: usize,
        /// Noun for what the list has one entry for: `drone`.
        of: &'static str,
    },
    /// An engine that contradicts the physics mode.
    #[error(
        "engine is {engine} and physics {physics}, which implies {}; expected one of them",
        engines(*physics)
    )]
    EngineOfPhysics {
        /// The engine.
        engine: EngineKind,
        /// The physics mode.
        physics: Physics,
    },
    /// Aerodynamic effects that contradict the physics mode.
    #[error(
        "effects is {effects} and physics {physics}, which implies {}; expected one of them",
        physics.effects()
    )]
    EffectsOfPhysics {
        /// The effects.
        effects: Effects,
        /// The physics mode.
        physics: Physics,
    },
    /// A number of drones out of range.
    #[error("num_drones is {got}, expected 1 to {}", Simulation::MAX_DRONES)]
    NumDrones {
        /// Number of drones that was set.
        got: usize,
    },
    /// A state that is NaN, beyond MuJoCo's limit, or without a valid attitude.
    #[error("the state of drone {drone} is invalid, expected finite numbers below 1e10 and a nonzero quaternion")]
    State {
        /// Index of the drone.
        drone: usize,
    },
    /// A scene that does not compile.
    #[error(transparent)]
    Build(#[from] BuildError),
    /// A motor command that is not finite.
    #[error("the command for motor {motor} of drone {drone} is {got} at t = {time} s, expected a finite speed in rpm")]
    Command {
        /// Index of the drone.
        drone: usize,
        /// Index of the motor.
        motor: usize,
        /// Commanded speed, rpm.
        got: f64,
        /// Simulated time, s.
        time: f64,
    },
    /// An external force that is not finite.
    #[error("the external force on drone {drone} is {got:?} N, expected three finite numbers")]
    ExternalForce {
        /// Index of the drone.
        drone: usize,
        /// Force that was set, world frame, N.
        got: [f64; 3],
    },
    /// A state beyond MuJoCo's limit. [`Simulation::states`] returns the last valid states. The simulation must be
    /// reset.
    #[error("drone {drone} diverged at t = {time} s: its {quantity} is not finite or too large")]
    Diverged {
        /// Index of the drone.
        drone: usize,
        /// Simulated time at the start of the physics step, s.
        time: f64,
        /// Quantity that diverged: position, velocity or acceleration.
        quantity: &'static str,
    },
    /// An error of MuJoCo. The simulation must be reset.
    #[error("at t = {time} s: {error}")]
    Engine {
        /// Simulated time, s.
        time: f64,
        /// MuJoCo's error.
        error: mujoco_rs::Error,
    },
}

/// Returns the engines that a physics mode allows.
fn engines(physics: Physics) -> &'static str {
    if physics.is_explicit() { "explicit" } else { "mujoco or hybrid" }
}
