use super::Simulation;
use crate::drone::DroneError;
use crate::engine::BuildError;
use crate::physics::actuators::ActuatorError;
use crate::physics::wind::WindError;
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
    /// Gravity out of its range.
    #[error("gravity is {got} m/s², expected a number within ±{}", World::MAX_GRAVITY)]
    Gravity {
        /// What it is.
        got: f64,
    },
    /// A wind that cannot blow.
    #[error(transparent)]
    Wind(#[from] WindError),
    /// An airframe that cannot fly.
    #[error("drone {drone}: {error}")]
    Drone {
        /// Index of the drone.
        drone: usize,
        /// What is wrong with it.
        error: DroneError,
    },
    /// Rates that do not fit together.
    #[error(
        "sim_freq is {sim_freq} Hz and ctrl_freq {ctrl_freq} Hz, expected positive frequencies up to {} Hz of which the first is a multiple of the second",
        Simulation::MAX_SIM_FREQ
    )]
    Rates {
        /// Physics rate, Hz.
        sim_freq: u32,
        /// Control rate, Hz.
        ctrl_freq: u32,
    },
    /// A list that does not have one entry per drone.
    #[error("{what} has {}, expected one for each of {}", crate::count(*got, "entry"), crate::count(*expected, "drone"))]
    Length {
        /// Which list.
        what: &'static str,
        /// Its length.
        got: usize,
        /// Number of drones.
        expected: usize,
    },
    /// The hybrid engine in the `dyn` mode.
    #[error(
        "the engine is hybrid and the physics mode dyn, which integrates by itself; expected another mode or no engine"
    )]
    HybridDyn,
    /// No drones at all, or too many.
    #[error("the number of drones is {got}, expected 1 to {}", Simulation::MAX_DRONES)]
    NumDrones {
        /// How many.
        got: usize,
    },
    /// Motors that cannot be.
    #[error(transparent)]
    Actuators(#[from] ActuatorError),
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
