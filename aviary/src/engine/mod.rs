//! Integrators. An engine integrates given loads to new states; it does not compute forces.

mod explicit;
pub mod flight;
mod hybrid;
mod mujoco;

pub use explicit::ExplicitEngine;
pub(crate) use hybrid::ClearanceCache;
pub use hybrid::HybridEngine;
pub(crate) use mujoco::place_geom;
pub use mujoco::{BuildError, MujocoEngine};

use flight::{FreeBody, ReachBound};
use mujoco_rs::{Data, Error};
use nalgebra::Vector3;

use crate::names::named_enum;
use crate::physics::Wrench;
use crate::physics::rotor::RotorWrench;
use crate::state::DroneState;
use crate::world::Obstacle;

/// Forces and torques on a drone during one physics step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Load {
    /// Wrench of the rotors, body frame.
    pub rotors: RotorWrench,
    /// All other forces and torques, world frame.
    pub external: Wrench,
}

/// Object that a drone touches.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Touched {
    /// The floor.
    Floor,
    /// Another drone, by its index.
    Drone(usize),
    /// An obstacle, by its index.
    Obstacle(usize),
}

/// Contact of a drone with an object.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, serde::Serialize, serde::Deserialize)]
pub struct Contact {
    /// Index of the drone.
    pub drone: usize,
    /// Touched object.
    pub with: Touched,
}

/// Rigid-body parameters of one drone.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Body {
    /// Mass, kg.
    pub mass: f64,
    /// Moments of inertia, body frame, kg·m².
    pub inertia: Vector3<f64>,
    /// Rigid body of the flight kernel, with gravity and the medium.
    pub free: FreeBody,
    /// Bound of the distance that the drone can travel.
    pub reach_bound: ReachBound,
}

/// Rigid bodies of a simulation; constant during a control step.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Bodies {
    /// Body of each drone.
    pub drones: Vec<Body>,
    /// Acceleration of gravity, downwards, m/s².
    pub gravity: f64,
    /// Distance that an obstacle can move until the next control step, m. The hybrid engine hands over to MuJoCo
    /// earlier by this distance, so that its solver has the same warm start as under MuJoCo alone.
    pub obstacle_drift: f64,
}

named_enum! {
    "engine"
    /// Integrator of a simulation.
    ///
    /// ```
    /// use aviary::drone::DroneModel;
    /// use aviary::engine::EngineKind;
    /// use aviary::simulation::Simulation;
    ///
    /// let builder = Simulation::builder(DroneModel::Cf2x).initial_positions([[0.0, 0.0, 2.0]]);
    /// let mut simulation = builder.engine(EngineKind::Hybrid).build()?;
    /// simulation.step(&[[14_000.0; 4]])?;
    /// // at a height of 2 m the drone cannot touch anything
    /// let substeps = simulation.engine_substeps();
    /// assert_eq!((substeps.flight, substeps.mujoco), (5, 0));
    /// # Ok::<(), aviary::simulation::SimulationError>(())
    /// ```
    #[derive(Default)]
    pub enum EngineKind {
        /// MuJoCo's `mj_step` for every physics step.
        #[default]
        Mujoco = "mujoco",
        /// The flight kernel while no drone can touch anything but the floor, MuJoCo otherwise.
        Hybrid = "hybrid",
        /// Semi-implicit Euler steps of free bodies: the engine of the physics mode `dyn`. It has no contacts and
        /// ignores MuJoCo's medium, integrators and body-fixed forcing.
        Explicit = "explicit",
    }
}

impl EngineKind {
    /// Engines with the dynamics of `mj_step`, contacts included.
    pub const WITH_CONTACTS: [Self; 2] = [Self::Mujoco, Self::Hybrid];
}

/// Number of physics steps by integrator.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Substeps {
    /// Physics steps of the flight kernel, those in contact with the floor included.
    pub flight: u64,
    /// Physics steps of MuJoCo.
    pub mujoco: u64,
    /// Physics steps of the explicit engine.
    pub explicit: u64,
}

impl std::ops::AddAssign for Substeps {
    fn add_assign(&mut self, other: Self) {
        self.flight += other.flight;
        self.mujoco += other.mujoco;
        self.explicit += other.explicit;
    }
}

/// Engine of a simulation.
#[derive(Debug)]
pub enum Engine {
    /// MuJoCo's `mj_step` for every physics step.
    Mujoco(MujocoEngine),
    /// The flight kernel while no drone can touch anything but the floor, `mj_step` otherwise.
    Hybrid(HybridEngine),
    /// Semi-implicit Euler steps of free bodies.
    Explicit(ExplicitEngine),
}

impl Engine {
    /// Returns the name of the engine in lower snake case.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Mujoco(_) => EngineKind::Mujoco.name(),
            Self::Hybrid(_) => EngineKind::Hybrid.name(),
            Self::Explicit(_) => EngineKind::Explicit.name(),
        }
    }

    /// Sets the state of every drone and clears everything else.
    ///
    /// # Errors
    /// MuJoCo's error if it cannot recover from an earlier one.
    pub fn reset(&mut self, states: &[DroneState]) -> Result<(), Error> {
        match self {
            Self::Mujoco(engine) => engine.reset(states),
            Self::Hybrid(engine) => engine.reset(states),
            Self::Explicit(engine) => engine.reset(states),
        }
    }

    /// Replaces the obstacles by others of the same shapes in the same order, from the next step on.
    ///
    /// # Errors
    /// MuJoCo's error if it cannot copy a shared model.
    ///
    /// # Panics
    /// If there are fewer obstacles than the world has.
    pub fn set_obstacles(&mut self, obstacles: &[Obstacle]) -> Result<(), Error> {
        match self {
            Self::Mujoco(engine) => engine.set_obstacles(obstacles),
            Self::Hybrid(engine) => engine.set_obstacles(obstacles),
            Self::Explicit(engine) => engine.set_obstacles(obstacles),
        }
    }

    /// Begins a control step of `steps` physics steps with these bodies, from these states.
    ///
    /// # Errors
    /// MuJoCo's error if it cannot copy a shared model.
    ///
    /// # Panics
    /// If the number of bodies or states is not that of the drones of the world.
    pub fn begin(&mut self, bodies: &Bodies, states: &[DroneState], steps: u32) -> Result<(), Error> {
        match self {
            Self::Mujoco(engine) => engine.begin(bodies),
            Self::Hybrid(engine) => {
                engine.begin(bodies, states, steps);
                Ok(())
            }
            Self::Explicit(_) => Ok(()),
        }
    }

    /// Resumes an environment that this engine, or another one of the same world, has [left](Self::leave).
    ///
    /// # Errors
    /// MuJoCo's error if it cannot recover from an earlier one.
    pub(crate) fn resume(&mut self, states: &[DroneState], left: Option<&[f64]>) -> Result<(), Error> {
        match self {
            Self::Mujoco(engine) => engine.resume(states, left),
            Self::Hybrid(engine) => {
                engine.resume(left);
                Ok(())
            }
            Self::Explicit(_) => Ok(()),
        }
    }

    /// Saves the warm start of MuJoCo's solver; returns false if there is none. With the warm start and the states an
    /// engine can [resume](Self::resume) the environment.
    pub(crate) fn leave(&self, warm_start: &mut [f64]) -> bool {
        match self {
            Self::Mujoco(engine) => engine.leave(warm_start),
            Self::Hybrid(engine) => engine.leave(warm_start),
            Self::Explicit(_) => false,
        }
    }

    /// Calls `found` once for every contact point and touching drone of the last step. The explicit engine has no
    /// contacts.
    pub fn contacts(&self, found: impl FnMut(Contact)) {
        match self {
            Self::Mujoco(engine) => engine.contacts(found),
            Self::Hybrid(engine) => engine.contacts(found),
            Self::Explicit(_) => {}
        }
    }

    /// Returns the number of physics steps by integrator since the engine was created.
    pub fn substeps(&self) -> Substeps {
        match self {
            Self::Mujoco(engine) => Substeps { mujoco: engine.steps(), ..Substeps::default() },
            Self::Hybrid(engine) => engine.substeps(),
            Self::Explicit(engine) => Substeps { explicit: engine.steps(), ..Substeps::default() },
        }
    }

    /// Returns MuJoCo's data at the current states, which the caller passes in. If another integrator computed the
    /// states, the engine first writes them into the data and calls `mj_forward`.
    ///
    /// # Errors
    /// MuJoCo's error.
    pub fn mujoco(&mut self, bodies: &Bodies, states: &[DroneState]) -> Result<&Data, Error> {
        match self {
            Self::Mujoco(engine) => {
                engine.begin(bodies)?;
                Ok(engine.data())
            }
            Self::Hybrid(engine) => engine.mujoco(bodies, states),
            Self::Explicit(engine) => engine.mujoco(bodies, states),
        }
    }

    /// Returns the MuJoCo engine that this engine contains.
    pub(crate) fn mujoco_engine(&self) -> &MujocoEngine {
        match self {
            Self::Mujoco(engine) => engine,
            Self::Hybrid(engine) => engine.mujoco_engine(),
            Self::Explicit(engine) => engine.mirror(),
        }
    }
}
