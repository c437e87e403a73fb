use super::{SimData, Workspace};
use crate::drone::DroneParams;
use crate::engine::{BuildError, Engine, EngineKind, ExplicitEngine, HybridEngine, MujocoEngine};
use crate::physics::actuators::ActuatorParams;
use crate::physics::{Effects, Physics};
use crate::serial::Fingerprint;
use crate::state::DroneState;
use crate::world::placement::{self, CollisionCylinder};
use crate::world::{Obstacle, World};

/// Constants of a simulation: scene, nominal airframes, effects, rates, initial states.
///
/// All environments of a batch share one model. [`SimData`] holds the state, and [`step`](super::step) advances it.
#[derive(Debug)]
pub struct SimModel {
    pub(super) world: World,
    pub(super) effects: Effects,
    pub(super) engine: EngineKind,
    pub(super) sim_freq: u32,
    pub(super) ctrl_freq: u32,
    pub(super) initial: Vec<DroneState>,
    pub(super) actuators: ActuatorParams,
    /// Hash of all other fields; a snapshot fits models with the same hash.
    pub(super) fingerprint: Fingerprint,
}

impl SimModel {
    /// Returns the model with the fingerprint of its fields. Equal configurations have equal fingerprints.
    pub(super) fn with_fingerprint(self) -> Self {
        // `{:?}` writes the shortest decimal that reads back as the same double
        let Self { world, effects, engine, sim_freq, ctrl_freq, initial, actuators, .. } = &self;
        let parts = (world, effects, engine, sim_freq, ctrl_freq, initial, actuators);
        Self { fingerprint: Fingerprint::of(format_args!("{parts:?}")), ..self }
    }

    /// Returns the scene as it was built. [`SimData`] holds the present poses of obstacles and markers.
    pub fn world(&self) -> &World {
        &self.world
    }

    /// Returns the paper's physics mode with this engine and these effects, if there is one.
    pub fn physics(&self) -> Option<Physics> {
        Physics::of(self.effects, self.engine == EngineKind::Explicit)
    }

    /// Returns the kind of engine.
    pub fn engine_kind(&self) -> EngineKind {
        self.engine
    }

    /// Returns the aerodynamic effects that are on.
    pub fn effects(&self) -> Effects {
        self.effects
    }

    /// Returns the physics rate, Hz.
    pub fn sim_freq(&self) -> u32 {
        self.sim_freq
    }

    /// Returns the control rate, Hz.
    pub fn ctrl_freq(&self) -> u32 {
        self.ctrl_freq
    }

    /// Returns the length of a control step, s.
    pub fn control_period(&self) -> f64 {
        1.0 / f64::from(self.ctrl_freq)
    }

    /// Returns the number of physics steps in a control step.
    pub fn substeps(&self) -> u32 {
        self.sim_freq / self.ctrl_freq
    }

    /// Returns the states that a reset restores.
    pub fn initial_states(&self) -> &[DroneState] {
        &self.initial
    }

    /// Returns the number of drones.
    pub fn num_drones(&self) -> usize {
        self.initial.len()
    }

    /// Returns the parameters of a drone's airframe before randomization.
    pub(crate) fn nominal_params(&self, drone: usize) -> &DroneParams {
        &self.world.drones[drone].params
    }

    /// Returns the largest latency of the airframes' motors, s.
    pub(crate) fn motor_latency(&self) -> f64 {
        self.world.drones.iter().map(|drone| drone.params.motors.latency).fold(0.0, f64::max)
    }

    /// Creates the data of a simulation at its initial states, in still air.
    pub fn data(&self) -> SimData {
        SimData::new(self)
    }

    /// Compiles the scene into the scratch memory of one thread.
    ///
    /// # Errors
    /// [`BuildError`] if the scene is invalid or MuJoCo cannot compile it.
    pub fn workspace(&self) -> Result<Workspace, BuildError> {
        let engine = match self.engine {
            EngineKind::Mujoco => Engine::Mujoco(MujocoEngine::new(&self.world)?),
            EngineKind::Hybrid => Engine::Hybrid(HybridEngine::new(&self.world)?),
            EngineKind::Explicit => Engine::Explicit(ExplicitEngine::new(&self.world)?),
        };
        Ok(Workspace::new(self, engine))
    }

    /// Returns true if drones in these states overlap neither the floor, nor each other, nor one of the obstacles.
    pub(crate) fn has_room(&self, states: &[DroneState], obstacles: &[Obstacle]) -> bool {
        placement::have_room(|drone| CollisionCylinder::from(self.nominal_params(drone)), states, obstacles)
    }
}
