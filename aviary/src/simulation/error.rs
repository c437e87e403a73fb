use super::Simulation;
use crate::drone::DroneError;
use crate::engine::{BuildError, EngineKind};
use crate::error::OptionError;
use crate::physics::{Effects, Physics};
use crate::world::World;

/// What can go wrong with a simulation.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum SimulationError {
    /// An obstacle that cannot take an earlier one's place.
    #[error("obstacle {index} has another shape than the one before")]
    Obstacle {
        /// Its index.
        index: usize,
    },
    /// Data or a snapshot of another model.
    #[error("the data is of a simulation with another scene, airframe, physics, engine, rate or start")]
    Model,
    /// The failure of a simulation that was read from a file.
    #[error("{message}")]
    Stored {
        /// What it was.
        message: String,
    },
    /// Gravity out of its range.
    #[error("gravity is {} m/s², expected a number within ±{}", crate::number(*got), World::MAX_GRAVITY)]
    Gravity {
        /// What it is.
        got: f64,
    },
    /// An option of the wind or of the motors that is impossible.
    #[error(transparent)]
    Option(#[from] OptionError),
    /// An airframe that cannot fly.
    #[error("drone {drone}: {error}")]
    Drone {
        /// Index of the drone.
        drone: usize,
        /// What is wrong with it.
        #[source]
        error: DroneError,
    },
    /// Rates that do not fit together.
    #[error(
        "sim_freq is {sim_freq} Hz and ctrl_freq {ctrl_freq} Hz, expected a positive multiple of ctrl_freq up to {} Hz",
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
        /// Which list.
        what: &'static str,
        /// Its length.
        got: usize,
        /// Number of things that need one entry each.
        expected: usize,
        /// Noun for a thing: `drone`.
        of: &'static str,
    },
    /// An engine that contradicts the physics mode.
    #[error("engine is {engine} and physics {physics}, which stands for {}; expected one of the two alone", engines(*physics))]
    EngineOfPhysics {
        /// The engine.
        engine: EngineKind,
        /// The physics mode.
        physics: Physics,
    },
    /// Aerodynamic effects that contradict the physics mode.
    #[error("effects is {effects} and physics {physics}, which stands for {}; expected one of the two alone", physics.effects())]
    EffectsOfPhysics {
        /// The effects.
        effects: Effects,
        /// The physics mode.
        physics: Physics,
    },
    /// No drones at all, or too many.
    #[error("num_drones is {got}, expected 1 to {}", Simulation::MAX_DRONES)]
    NumDrones {
        /// How many.
        got: usize,
    },
    /// A state that is not finite or out of MuJoCo's range.
    #[error("the state of drone {drone} has a number that is not finite or not below 1e10, or no attitude")]
    State {
        /// Index of the drone.
        drone: usize,
    },
    /// The scene does not compile.
    #[error(transparent)]
    Build(#[from] BuildError),
    /// A motor command that is not a number.
    #[error("the command for motor {motor} of drone {drone} is {got} at t = {time} s, expected a finite speed in rpm")]
    Command {
        /// Index of the drone.
        drone: usize,
        /// Index of the motor.
        motor: usize,
        /// What was commanded.
        got: f64,
        /// Simulated time, s.
        time: f64,
    },
    /// The state left the range of numbers MuJoCo works with. [`Simulation::states`] still gives the last good one;
    /// the simulation must be reset.
    #[error("drone {drone} diverged at t = {time} s: its {quantity} is not finite or too large")]
    Diverged {
        /// Index of the drone.
        drone: usize,
        /// Simulated time at the start of the physics step, s.
        time: f64,
        /// What diverged: position, velocity or acceleration.
        quantity: &'static str,
    },
    /// MuJoCo raised an error; the simulation must be reset.
    #[error("at t = {time} s: {error}")]
    Engine {
        /// Simulated time, s.
        time: f64,
        /// MuJoCo's error.
        error: mujoco_rs::Error,
    },
}

/// Engines that a physics mode stands for.
fn engines(physics: Physics) -> &'static str {
    if physics.is_explicit() { "the explicit engine" } else { "mujoco or hybrid" }
}
