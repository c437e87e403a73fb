//! Integrators. An engine takes loads and gives states; it never computes a force.

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

/// What acts on a drone during one physics step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Load {
    /// The rotors, in the body frame.
    pub rotors: RotorWrench,
    /// Everything else, in the world frame.
    pub external: Wrench,
}

/// What a drone touched.
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

/// A drone in touch with something.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, serde::Serialize, serde::Deserialize)]
pub struct Contact {
    /// Index of the drone.
    pub drone: usize,
    /// What it touched.
    pub with: Touched,
}

/// One drone's body, as engines want it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Body {
    /// kg.
    pub mass: f64,
    /// Moments of inertia, body frame, kg·m².
    pub inertia: Vector3<f64>,
    /// The same for the flight kernel, under gravity and in the medium.
    pub free: FreeBody,
    /// How far it can come.
    pub reach_bound: ReachBound,
}

/// What the engine moves: it does not change during a control step.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Bodies {
    /// Every drone's.
    pub drones: Vec<Body>,
    /// m/s², downwards.
    pub gravity: f64,
    /// How far an obstacle may move until the next control step, m: the hybrid engine hands over so much earlier, so that the solver
    /// starts as warm as MuJoCo's alone.
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
    /// // 2 m above the floor there is nothing to touch
    /// let substeps = simulation.engine_substeps();
    /// assert_eq!((substeps.flight, substeps.mujoco), (5, 0));
    /// # Ok::<(), aviary::simulation::SimulationError>(())
    /// ```
    #[derive(Default)]
    pub enum EngineKind {
        /// MuJoCo's `mj_step`, always.
        #[default]
        Mujoco = "mujoco",
        /// The flight kernel while nothing can touch, MuJoCo otherwise.
        Hybrid = "hybrid",
        /// Explicit integration of free bodies: the engine of the physics mode `dyn`. It has no contacts. MuJoCo's medium, integrators
        /// and body-fixed forcing have no effect in it.
        Explicit = "explicit",
    }
}

impl EngineKind {
    /// The engines that fly as `mj_step` does, contacts included.
    pub const WITH_CONTACTS: [Self; 2] = [Self::Mujoco, Self::Hybrid];
}

/// How many physics steps each engine did.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Substeps {
    /// The flight kernel.
    pub flight: u64,
    /// MuJoCo.
    pub mujoco: u64,
    /// The explicit engine.
    pub explicit: u64,
}

impl std::ops::AddAssign for Substeps {
    fn add_assign(&mut self, other: Self) {
        self.flight += other.flight;
        self.mujoco += other.mujoco;
        self.explicit += other.explicit;
    }
}

/// One of the engines.
#[derive(Debug)]
pub enum Engine {
    /// MuJoCo's `mj_step`.
    Mujoco(MujocoEngine),
    /// The flight kernel in the open, `mj_step` otherwise.
    Hybrid(HybridEngine),
    /// Explicit Euler steps of the free body.
    Explicit(ExplicitEngine),
}

impl Engine {
    /// Its name in lower snake case.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Mujoco(_) => EngineKind::Mujoco.name(),
            Self::Hybrid(_) => EngineKind::Hybrid.name(),
            Self::Explicit(_) => EngineKind::Explicit.name(),
        }
    }

    /// Puts every drone into a state and forgets everything else.
    ///
    /// # Errors
    /// Where MuJoCo cannot recover from an earlier error.
    pub fn reset(&mut self, states: &[DroneState]) -> Result<(), Error> {
        match self {
            Self::Mujoco(engine) => engine.reset(states),
            Self::Hybrid(engine) => engine.reset(states),
            Self::Explicit(engine) => engine.reset(states),
        }
    }

    /// Other obstacles of the same shapes in the same order, from the next step on.
    ///
    /// # Errors
    /// MuJoCo's, where it cannot copy a shared model.
    pub fn set_obstacles(&mut self, obstacles: &[Obstacle]) -> Result<(), Error> {
        match self {
            Self::Mujoco(engine) => engine.set_obstacles(obstacles),
            Self::Hybrid(engine) => engine.set_obstacles(obstacles),
            Self::Explicit(engine) => engine.set_obstacles(obstacles),
        }
    }

    /// Begins a control step of so many physics steps with these bodies, from these states.
    ///
    /// # Errors
    /// MuJoCo's, where it cannot copy a shared model.
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

    /// Takes over an environment that another engine of the same world, or this one, has [left](Self::leave).
    ///
    /// # Errors
    /// Where MuJoCo cannot recover from an earlier error.
    pub(crate) fn resume(&mut self, states: &[DroneState], left: Option<&[f64]>) -> Result<(), Error> {
        match self {
            Self::Mujoco(engine) => engine.resume(states, left),
            Self::Hybrid(engine) => engine.resume(states, left),
            Self::Explicit(_) => Ok(()),
        }
    }

    /// What must be kept of an environment besides its states until it is [taken over](Self::resume) again: the warm
    /// start of MuJoCo's solver. Whether there is any.
    pub(crate) fn leave(&self, warm_start: &mut [f64]) -> bool {
        match self {
            Self::Mujoco(engine) => engine.leave(warm_start),
            Self::Hybrid(engine) => engine.leave(warm_start),
            Self::Explicit(_) => false,
        }
    }

    /// Calls `found` for every drone in touch with something in the last step, once per point of contact and drone.
    /// The explicit engine knows no contacts, and in flight there are none.
    pub fn contacts(&self, found: impl FnMut(Contact)) {
        match self {
            Self::Mujoco(engine) => engine.contacts(found),
            Self::Hybrid(engine) => engine.contacts(found),
            Self::Explicit(_) => {}
        }
    }

    /// How many physics steps each engine did since it was made.
    pub fn substeps(&self) -> Substeps {
        match self {
            Self::Mujoco(engine) => Substeps { mujoco: engine.steps(), ..Substeps::default() },
            Self::Hybrid(engine) => engine.substeps(),
            Self::Explicit(engine) => Substeps { explicit: engine.steps(), ..Substeps::default() },
        }
    }

    /// MuJoCo's data with the drones in these states, where they are now. If it was not MuJoCo that brought them there, they are
    /// written there and computed forward first.
    ///
    /// # Errors
    /// MuJoCo's.
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

    /// The MuJoCo simulation beneath.
    pub(crate) fn mujoco_engine(&self) -> &MujocoEngine {
        match self {
            Self::Mujoco(engine) => engine,
            Self::Hybrid(engine) => engine.mujoco_engine(),
            Self::Explicit(engine) => engine.mirror(),
        }
    }
}
