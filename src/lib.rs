//! Quadrotor simulation on MuJoCo, for control research and reinforcement learning.
//!
//! This crate re-exports the workspace: all items of [`aviary`], and the safe MuJoCo interface as [`mujoco`].
//!
//! ```
//! use mujoco_drones_gym::prelude::*;
//!
//! let mut env = Hover::builder().drone(DroneModel::Cf2x).build()?;
//! let mut pilot = ControllerPolicy::new(ControllerKind::Pid, &env);
//! let summary = fly_episode(&mut env, &mut pilot, Some(1))?;
//! assert!(summary.success);
//! # Ok::<(), RolloutError>(())
//! ```

pub use aviary::*;
/// Safe interface to MuJoCo: models, simulations, rendering, errors.
pub use mujoco_rs as mujoco;

/// Vectors and rotations of the public API.
pub use nalgebra;

/// Random number generator of all sampling, with its seeding and sampling traits.
pub use aviary::env::Rng;
pub use rand::{RngExt, SeedableRng};

/// Common imports.
pub mod prelude {
    pub use aviary::action::ActionType;
    pub use aviary::control::{Controller, ControllerKind, PidControl, Reference};
    pub use aviary::drone::{DroneModel, DroneParams};
    pub use aviary::engine::EngineKind;
    pub use aviary::env::{
        Aviary, AviaryBuilder, BoxSpace, DroneEnv, EndReason, Env, EnvConfig, EnvError, EpisodeSummary, Info, Step,
        Task, TaskDefaults, check_env,
    };
    pub use aviary::multi_agent::{ParallelAviary, ParallelEnv};
    pub use aviary::observation::{Observation, ObservationType, obs};
    pub use aviary::physics::{Effects, Physics};
    pub use aviary::rollout::{ControllerPolicy, Policy, Rollout, RolloutError, fly_episode};
    pub use aviary::simulation::{SimView, Simulation, SimulationError};
    pub use aviary::state::DroneState;
    pub use aviary::tasks::{
        Antipodal, FlyThrough, Formation, Hover, MultiHover, Race, Stabilize, Track, Velocity, make,
    };
    pub use aviary::vector::{Autoreset, BufferedVecEnv, OnFault, VecAviary, VecBuffers, VecConfig, VecEnv, make_vec};
    pub use aviary::vision::{ImageSize, View};
}

#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

#[cfg(doctest)]
#[doc = include_str!("../docs/introduction.md")]
struct Introduction;

#[cfg(doctest)]
#[doc = include_str!("../docs/physics.md")]
struct PhysicsGuide;

#[cfg(doctest)]
#[doc = include_str!("../docs/airframes.md")]
struct AirframeGuide;

#[cfg(doctest)]
#[doc = include_str!("../docs/control.md")]
struct ControlGuide;

#[cfg(doctest)]
#[doc = include_str!("../docs/conditions.md")]
struct ConditionGuide;

#[cfg(doctest)]
#[doc = include_str!("../docs/cameras.md")]
struct CameraGuide;

#[cfg(doctest)]
#[doc = include_str!("../docs/records.md")]
struct RecordGuide;

#[cfg(doctest)]
#[doc = include_str!("../docs/real-flights.md")]
struct RealFlightGuide;

#[cfg(doctest)]
#[doc = include_str!("../docs/tasks.md")]
struct TaskGuide;

#[cfg(doctest)]
#[doc = include_str!("../docs/batches.md")]
struct BatchGuide;

#[cfg(doctest)]
#[doc = include_str!("../docs/training.md")]
struct TrainingGuide;

#[cfg(doctest)]
#[doc = include_str!("../docs/porting.md")]
struct PortingGuide;
