use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use nalgebra::Vector3;
use smallvec::SmallVec;

use super::{SimModel, SimulationError, out_of_range};
use crate::drone::DroneParams;
use crate::engine::{Bodies, BuildError, Contact, Load};
use crate::physics::Wrench;
use crate::physics::actuators::{ActuatorParams, Actuators};
use crate::physics::airframe::AirframeEffects;
use crate::physics::battery::BatteryState;
use crate::physics::downwash::Wake;
use crate::physics::ground_effect::GroundEffect;
use crate::physics::rotor::RotorModel;
use crate::physics::wind::WindField;
use crate::serial::Fingerprint;
use crate::state::DroneState;
use crate::world::{Marker, MarkerPose, Obstacle};

/// State of one simulation: drones, motors, wind, sensors, sampled parameters, contacts, time.
///
/// A clone is a snapshot. [`step`](super::step) advances a clone and the original bit-identically, in any
/// [`Workspace`](super::Workspace) of the same [`SimModel`]. The same holds for data that was serialized and
/// deserialized by the same version of this crate, also in another process, in a self-describing format that keeps
/// doubles exactly, such as JSON with serde_json's feature `float_roundtrip`.
///
/// ```
/// use aviary::drone::DroneModel;
/// use aviary::physics::wind::{WindConfig, WindModel};
/// use aviary::simulation::{Simulation, step};
///
/// let model = Simulation::builder(DroneModel::Cf2x).build()?.model().clone();
/// // one model and one workspace for any number of futures
/// let (mut workspace, mut calm) = (model.workspace()?, model.data());
/// let mut windy = calm.clone();
/// windy.set_wind(Some(WindConfig { velocity: [2.0, 0.0, 0.0], ..WindConfig::new(WindModel::Constant) }), 1)?;
/// for data in [&mut calm, &mut windy] {
///     for _ in 0..48 {
///         step(&model, &mut workspace, data, &[[14_600.0; 4]])?;
///     }
/// }
/// assert!(windy.states()[0].position.x > calm.states()[0].position.x + 0.01);
/// windy.reset(&model)?;
/// assert_eq!(windy.states(), model.initial_states());
/// # Ok::<(), aviary::simulation::SimulationError>(())
/// ```
#[derive(Debug, Clone)]
pub struct SimData {
    /// Fingerprint of the model that the data belongs to.
    pub(super) model: Fingerprint,
    pub(super) states: Vec<DroneState>,
    /// Roll, pitch and yaw of `states`, rad.
    pub(super) rpys: Vec<Vector3<f64>>,
    /// States at the start of the episode.
    pub(super) started: Vec<DroneState>,
    pub(super) control_steps: u64,
    /// Contacts of the last control step; inline for the usual number.
    pub(super) contacts: SmallVec<[Contact; 2]>,
    pub(super) failed: Option<SimulationError>,
    pub(super) loads: Vec<Load>,
    pub(super) drones: Vec<Drone>,
    pub(super) actuators: Vec<Actuators>,
    /// States of the batteries; empty if no drone has one.
    pub(super) batteries: Vec<BatteryState>,
    pub(super) wakes: Vec<Wake>,
    pub(super) bodies: Bodies,
    pub(super) wind: Option<WindField>,
    /// Seed of the last start of the wind.
    pub(super) wind_seed: u64,
    pub(super) memory: Memory,
    /// External force on every drone, world frame, N; `None` if all are zero.
    pub(super) external_forces: Option<Box<[Vector3<f64>]>>,
    /// Motor speeds commanded during the last control step, rpm.
    pub(super) motor_speeds: Vec<[f64; 4]>,
    /// True if a parameter has changed from which `bodies` is derived.
    pub(super) changed: bool,
    /// Obstacles that replace the model's; `None` before the first change.
    pub(super) obstacles: Option<Arc<[Obstacle]>>,
    /// Equal for equal obstacles; 0 for the model's.
    pub(super) obstacle_revision: u64,
    /// Indices and poses of the markers that have moved.
    pub(super) marker_poses: Vec<(usize, MarkerPose)>,
    /// Warm start of the solver for contacts, in MuJoCo and in the kernel of the floor.
    pub(super) warm_start: Vec<f64>,
    /// True if MuJoCo or the kernel of the floor made the last physics step, so that `warm_start` is valid.
    pub(super) in_mujoco: bool,
    /// Unique mark of the state that a workspace left behind; 0 for none.
    pub(super) stamp: u64,
}

/// Constants of one drone, precomputed for the step.
#[derive(Debug, Clone)]
pub(super) struct Drone {
    pub params: DroneParams,
    pub rotors: RotorModel,
    pub ground: GroundEffect,
    /// Effects of the airframe's own parameters; `None` if there are none.
    pub effects: Option<AirframeEffects>,
    /// Maximum motor speed of the airframe that the drone was built with, rpm. A battery limits it further.
    pub max_rpm: f64,
    pub actuators: ActuatorParams,
}

/// Ring buffer of earlier states. Observations come at the end of a control step, so that one state per control step
/// is recorded.
#[derive(Debug, Clone, Default)]
pub(super) struct Memory {
    /// Delay, physics steps.
    pub delay: u32,
    /// States of all drones for each of the last control steps; the index is the control step modulo their number.
    /// Empty without a delay.
    pub states: Vec<DroneState>,
}

/// Returns a number that no other call returns.
pub(super) fn unique() -> u64 {
    static NEXT: AtomicU64 = AtomicU64::new(1);
    NEXT.fetch_add(1, Ordering::Relaxed)
}

impl SimData {
    /// Copies other data into this one and reuses its memory.
    pub(crate) fn copy_from(&mut self, other: &Self) {
        let Self {
            model,
            states,
            rpys,
            started,
            control_steps,
            contacts,
            failed,
            loads,
            drones,
            actuators,
            batteries,
            wakes,
            bodies,
            wind,
            wind_seed,
            memory,
            external_forces,
            motor_speeds,
            changed,
            obstacles,
            obstacle_revision,
            marker_poses,
            warm_start,
            in_mujoco,
            stamp,
        } = other;
        self.model = *model;
        self.states.clone_from(states);
        self.rpys.clone_from(rpys);
        self.started.clone_from(started);
        self.control_steps.clone_from(control_steps);
        self.contacts.clone_from(contacts);
        self.failed.clone_from(failed);
        self.loads.clone_from(loads);
        self.drones.clone_from(drones);
        self.actuators.clone_from(actuators);
        self.batteries.clone_from(batteries);
        self.wakes.clone_from(wakes);
        self.bodies.clone_from(bodies);
        self.wind.clone_from(wind);
        self.wind_seed.clone_from(wind_seed);
        self.memory.clone_from(memory);
        self.external_forces.clone_from(external_forces);
        self.motor_speeds.clone_from(motor_speeds);
        self.changed.clone_from(changed);
        self.obstacles.clone_from(obstacles);
        self.obstacle_revision.clone_from(obstacle_revision);
        self.marker_poses.clone_from(marker_poses);
        self.warm_start.clone_from(warm_start);
        self.in_mujoco.clone_from(in_mujoco);
        self.stamp.clone_from(stamp);
    }

    pub(super) fn new(model: &SimModel) -> Self {
        let (world, actuators) = (&model.world, &model.actuators);
        let drone = |params: &DroneParams| Drone {
            rotors: RotorModel::new(params),
            ground: GroundEffect::new(params),
            effects: AirframeEffects::of_params(params),
            max_rpm: params.max_command_rpm(),
            actuators: *actuators,
            params: params.clone(),
        };
        let count = world.drones.len();
        let no_load =
            Load { rotors: RotorModel::new(model.nominal_params(0)).wrench(&[0.0; 4]), external: Wrench::ZERO };
        let mut data = Self {
            model: model.fingerprint,
            states: model.initial.clone(),
            rpys: vec![Vector3::zeros(); count],
            started: model.initial.clone(),
            control_steps: 0,
            contacts: SmallVec::new(),
            failed: None,
            loads: vec![no_load; count],
            drones: world.drones.iter().map(|body| drone(&body.params)).collect(),
            actuators: world
                .drones
                .iter()
                .map(|body| Actuators::new(&body.params, actuators, world.timestep))
                .collect(),
            batteries: Vec::new(),
            wakes: world.drones.iter().map(|body| Wake::new(&body.params)).collect(),
            bodies: Bodies { drones: Vec::with_capacity(count), gravity: world.gravity, obstacle_drift: 0.0 },
            wind: None,
            wind_seed: 0,
            memory: Memory::default(),
            external_forces: None,
            motor_speeds: vec![[0.0; 4]; count],
            changed: true,
            obstacles: None,
            obstacle_revision: 0,
            marker_poses: Vec::new(),
            warm_start: vec![0.0; 6 * count],
            in_mujoco: false,
            stamp: 0,
        };
        data.need_batteries();
        data.reset_unchecked(model);
        data
    }

    /// Checks that the data belongs to a model.
    ///
    /// # Errors
    /// See [`Simulation::restore`](super::Simulation::restore).
    pub(super) fn validate(&self, model: &SimModel) -> Result<(), SimulationError> {
        let (got, expected) = (self.states.len(), model.num_drones());
        if got != expected {
            return Err(SimulationError::Length { what: "the snapshot", got, expected, of: "drone" });
        }
        let expected = self.memory.length(model.substeps());
        let got = self.memory.states.len() / self.states.len();
        if got != expected {
            let what = "the memory of the snapshot";
            return Err(SimulationError::Length { what, got, expected, of: "control step" });
        }
        if let Some(own) = &self.obstacles {
            let of_model = &model.world.obstacles;
            let (got, expected) = (own.len(), of_model.len());
            if got != expected {
                let what = "the list of obstacles of the snapshot";
                return Err(SimulationError::Length { what, got, expected, of: "obstacle" });
            }
            let mut shapes = own.iter().zip(of_model);
            if let Some(index) = shapes.position(|(own, of_model)| own.shape.kind() != of_model.shape.kind()) {
                return Err(SimulationError::Obstacle { index });
            }
        }
        let (got, expected) = (self.markers_needed(), model.world.markers.len());
        if got > expected {
            let what = "the list of markers of the snapshot";
            return Err(SimulationError::Length { what, got, expected, of: "marker" });
        }
        if self.model == model.fingerprint { Ok(()) } else { Err(SimulationError::Model) }
    }

    /// Resets to the initial states, time 0 and no command. Motors with lag, latency or rotor inertia turn at hover
    /// speed.
    ///
    /// # Errors
    /// [`SimulationError::Model`] for data of another model; the data is unchanged.
    pub fn reset(&mut self, model: &SimModel) -> Result<(), SimulationError> {
        if self.model != model.fingerprint {
            return Err(SimulationError::Model);
        }
        self.reset_unchecked(model);
        Ok(())
    }

    /// Resets as [`reset`](Self::reset) does, for data that is known to belong to the model.
    pub(crate) fn reset_unchecked(&mut self, model: &SimModel) {
        self.states.copy_from_slice(&model.initial);
        self.restart();
    }

    /// Resets to the given states.
    ///
    /// # Errors
    /// [`SimulationError::Length`] and [`SimulationError::State`]; the data is unchanged.
    pub fn reset_to(&mut self, states: &[DroneState]) -> Result<(), SimulationError> {
        let expected = self.states.len();
        if states.len() != expected {
            return Err(SimulationError::Length { what: "states", got: states.len(), expected, of: "drone" });
        }
        let is_valid = |state: &DroneState| out_of_range(state).is_none() && state.attitude.norm_squared() > 1e-6;
        if let Some(drone) = states.iter().position(|state| !is_valid(state)) {
            return Err(SimulationError::State { drone });
        }
        self.states.copy_from_slice(states);
        for state in &mut self.states {
            // quaternions from single precision need it; unit quaternions keep their bits
            if (state.attitude.norm_squared() - 1.0).abs() > 1e-12 {
                state.attitude.renormalize();
            }
        }
        self.restart();
        Ok(())
    }

    fn restart(&mut self) {
        (self.stamp, self.in_mujoco) = (0, false);
        self.motor_speeds.fill([0.0; 4]);
        for (actuators, (drone, load)) in self.actuators.iter_mut().zip(self.drones.iter().zip(&mut self.loads)) {
            actuators.reset();
            actuators.set_gains(&drone.actuators.gains);
            *load = Load { rotors: drone.rotors.wrench(&[0.0; 4]), external: Wrench::ZERO };
        }
        self.clear_external_forces();
        self.reset_batteries();
        self.memory.forget(&self.states);
        self.started.copy_from_slice(&self.states);
        self.contacts.clear();
        self.control_steps = 0;
        self.failed = None;
        self.update_rpys();
    }

    /// Computes roll, pitch and yaw from the states.
    pub(crate) fn update_rpys(&mut self) {
        for (rpy, state) in self.rpys.iter_mut().zip(&self.states) {
            *rpy = state.rpy();
        }
    }

    /// Returns the states of all drones, in order.
    pub fn states(&self) -> &[DroneState] {
        &self.states
    }

    /// Returns the motor speeds commanded to all drones during the last control step, rpm.
    pub(crate) fn motor_speeds(&self) -> &[[f64; 4]] {
        &self.motor_speeds
    }

    /// Returns the number of control steps since the last reset.
    pub fn control_steps(&self) -> u64 {
        self.control_steps
    }

    /// Returns the obstacles at their present poses.
    pub fn obstacles<'a>(&'a self, model: &'a SimModel) -> &'a [Obstacle] {
        self.obstacles.as_deref().unwrap_or(&model.world.obstacles)
    }

    /// Returns a number that is equal for equal obstacles, 0 for those of the model.
    pub(crate) fn obstacle_revision(&self) -> u64 {
        self.obstacle_revision
    }

    /// Returns the markers at their present poses.
    pub(crate) fn markers(&self, model: &SimModel) -> Vec<Marker> {
        let mut markers = model.world.markers.clone();
        for &(index, pose) in &self.marker_poses {
            let body = &mut markers[index].body;
            (body.position, body.rpy) = (pose.position, pose.rpy);
        }
        markers
    }

    /// Returns the number of markers that a model must have to hold the marker poses.
    pub(super) fn markers_needed(&self) -> usize {
        self.marker_poses.iter().map(|(index, _)| index + 1).max().unwrap_or(0)
    }

    /// Moves a marker, for all later images.
    pub(crate) fn set_marker_pose(&mut self, index: usize, pose: MarkerPose) {
        match self.marker_poses.iter_mut().find(|(known, _)| *known == index) {
            Some((_, known)) => *known = pose,
            None => self.marker_poses.push((index, pose)),
        }
    }

    /// Replaces the obstacles by others of the same shapes in the same order, from the next step on.
    ///
    /// # Errors
    /// [`SimulationError::Length`] if their number differs, [`SimulationError::Obstacle`] if a shape differs,
    /// [`SimulationError::Build`] for a number out of range; the data is unchanged.
    pub fn set_obstacles(&mut self, model: &SimModel, obstacles: &[Obstacle]) -> Result<(), SimulationError> {
        if self.model != model.fingerprint {
            return Err(SimulationError::Model);
        }
        let old = self.obstacles(model);
        if obstacles.len() != old.len() {
            let (got, expected) = (obstacles.len(), old.len());
            return Err(SimulationError::Length { what: "obstacles", got, expected, of: "obstacle" });
        }
        for (index, (new, old)) in obstacles.iter().zip(old).enumerate() {
            if new.shape.kind() != old.shape.kind() {
                return Err(SimulationError::Obstacle { index });
            }
            new.validate(&format!("obstacle {index}")).map_err(BuildError::from)?;
        }
        match self.obstacles.as_mut().and_then(Arc::get_mut) {
            Some(own) => own.copy_from_slice(obstacles),
            None => self.obstacles = Some(obstacles.into()),
        }
        self.obstacle_revision = unique();
        Ok(())
    }

    /// Returns the size of the obstacles that replace the model's, in bytes.
    pub(super) fn own_obstacles_bytes(&self) -> usize {
        self.obstacles.as_deref().map_or(0, size_of_val)
    }

    /// Moves obstacles between two control steps.
    ///
    /// # Errors
    /// As for [`set_obstacles`](Self::set_obstacles); the data is unchanged.
    pub(crate) fn move_obstacles(&mut self, model: &SimModel, obstacles: &[Obstacle]) -> Result<(), SimulationError> {
        let old = self.obstacles(model);
        let travel = |(new, old): (&Obstacle, &Obstacle)| {
            (new.position - old.position).norm() + (new.rpy - old.rpy).norm() * new.shape.reach()
        };
        let farthest = obstacles.iter().zip(old).map(travel).fold(0.0, f64::max);
        if obstacles != old {
            self.set_obstacles(model, obstacles)?;
        }
        // an accelerating obstacle moves farther in the next step than in the last one
        self.bodies.obstacle_drift = 2.0 * farthest;
        Ok(())
    }

    /// Places obstacles at the start of an episode. How far they move after the first control step is unknown: if a
    /// drone touches one in the second step, MuJoCo's solver may start without an earlier solution.
    ///
    /// # Errors
    /// As for [`set_obstacles`](Self::set_obstacles); the data is unchanged.
    pub(crate) fn place_obstacles(&mut self, model: &SimModel, obstacles: &[Obstacle]) -> Result<(), SimulationError> {
        self.move_obstacles(model, obstacles)?;
        self.bodies.obstacle_drift = 0.0;
        Ok(())
    }

    /// Sets the delay of the remembered states, rounded to whole physics steps.
    pub(crate) fn remember(&mut self, model: &SimModel, seconds: f64) {
        let delay = (seconds.clamp(0.0, super::Simulation::MAX_MEMORY) / model.world.timestep).round() as u32;
        self.memory.delay = delay;
        let entries = self.memory.length(model.substeps());
        self.memory.states.resize(entries * self.states.len(), DroneState::default());
        self.memory.forget(&self.states);
    }

    /// Returns the states as they were one delay ago, or the oldest that the memory has.
    pub(crate) fn remembered(&self) -> &[DroneState] {
        let (count, memory) = (self.states.len(), &self.memory);
        match memory.entry(count, self.control_steps) {
            Some(entry) => &memory.states[entry],
            None => &self.states,
        }
    }

    /// Clips the motor commands and stores them.
    pub(super) fn accept(&mut self, commands: &[[f64; 4]], time: f64) -> Result<(), SimulationError> {
        let expected = self.drones.len();
        if commands.len() != expected {
            return Err(SimulationError::Length { what: "commands", got: commands.len(), expected, of: "drone" });
        }
        for (drone, speeds) in commands.iter().enumerate() {
            if let Some((motor, &got)) = speeds.iter().enumerate().find(|(_, rpm)| !rpm.is_finite()) {
                return Err(SimulationError::Command { drone, motor, got, time });
            }
        }
        for ((drone, speeds), command) in self.drones.iter().zip(&mut self.motor_speeds).zip(commands) {
            *speeds = command.map(|rpm| rpm.clamp(0.0, drone.max_rpm));
        }
        self.limit_to_batteries();
        Ok(())
    }
}

impl Memory {
    /// Returns the number of control steps that are kept.
    pub fn length(&self, substeps: u32) -> usize {
        if self.delay > 0 { (self.delay / substeps) as usize + 1 } else { 0 }
    }

    /// Fills the buffer with the present states.
    pub fn forget(&mut self, states: &[DroneState]) {
        for list in self.states.chunks_exact_mut(states.len()) {
            list.copy_from_slice(states);
        }
    }

    /// Returns the entries of a control step for `drones` drones, if there is a delay. After `control_steps` steps,
    /// the entries of the next step are the oldest, which are observed.
    fn entry(&self, drones: usize, control_step: u64) -> Option<std::ops::Range<usize>> {
        let count = (self.states.len() / drones) as u64;
        let index = control_step.checked_rem(count)? as usize;
        Some(index * drones..(index + 1) * drones)
    }

    /// Records the states at the start of a physics step of a control step, if an observation needs them. The end of
    /// the control step is its step number `substeps`.
    pub fn note(&mut self, states: &[DroneState], control_step: u64, substep: u32, substeps: u32) {
        if self.delay > 0
            && substep == substeps - self.delay % substeps
            && let Some(entry) = self.entry(states.len(), control_step)
        {
            self.states[entry].copy_from_slice(states);
        }
    }
}
