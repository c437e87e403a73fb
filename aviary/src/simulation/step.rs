use nalgebra::Vector3;

use super::data::unique;
use super::{SimData, SimModel, SimulationError, out_of_range};
use crate::engine::{Engine, EngineKind, Load};
use crate::physics::{Wrench, downwash, drag};
use crate::state::DroneState;

/// Scratch memory of one thread: the engine with MuJoCo's `mjData`, and buffers.
///
/// It keeps nothing of an environment that [`SimData`] has not: any data of the same model can be stepped in it, in any order.
#[derive(Debug)]
pub struct Workspace {
    pub(super) engine: Engine,
    /// Mark of the state in the engine; 0 for none.
    stamp: u64,
    /// Revision of the obstacles in the engine.
    obstacle_revision: u64,
    /// Force of the wakes on every drone, along world z, N.
    downwash: Vec<f64>,
    /// States before the last physics step.
    previous: Vec<DroneState>,
}

impl Workspace {
    pub(super) fn new(model: &SimModel, engine: Engine) -> Self {
        let count = model.num_drones();
        Self {
            engine,
            stamp: 0,
            obstacle_revision: 0,
            downwash: vec![0.0; count],
            previous: vec![DroneState::default(); count],
        }
    }

    /// Returns the engine.
    pub fn engine(&self) -> &Engine {
        &self.engine
    }

    /// Puts data into the engine, unless it is there already from the step before.
    pub(super) fn load(&mut self, model: &SimModel, data: &SimData) -> Result<(), SimulationError> {
        let time = || data.control_steps as f64 / f64::from(model.ctrl_freq);
        let failure = |error| SimulationError::Engine { time: time(), error };
        if self.obstacle_revision != data.obstacle_revision {
            self.engine.set_obstacles(data.obstacles(model)).map_err(failure)?;
            self.obstacle_revision = data.obstacle_revision;
        }
        if self.stamp == data.stamp && data.stamp != 0 {
            return Ok(());
        }
        self.stamp = 0;
        if data.control_steps == 0 && !data.in_mujoco {
            self.engine.reset(&data.states).map_err(failure)?;
        }
        self.engine.resume(&data.states, data.warm_start()).map_err(failure)
    }

    /// Keeps in the data what the engine has of its state.
    fn leave(&mut self, data: &mut SimData) {
        data.in_mujoco = self.engine.leave(&mut data.warm_start);
        data.stamp = unique();
        self.stamp = data.stamp;
    }

    /// Returns MuJoCo's data with the drones where they are, see [`Simulation::mujoco`](super::Simulation::mujoco).
    pub(super) fn mujoco(
        &mut self,
        model: &SimModel,
        data: &mut SimData,
    ) -> Result<&mujoco_rs::Data, mujoco_rs::Error> {
        data.refresh(model);
        // loading has no other errors
        if let Err(SimulationError::Engine { error, .. }) = self.load(model, data) {
            return Err(error);
        }
        self.engine.mujoco(&data.bodies, &data.states)
    }
}

/// Advances a simulation by one control step under motor speeds (rpm), four per drone, clipped to [0, `MAX_RPM`].
///
/// In every physics step the motors advance, the air moves, forces and torques are computed from the states at its start, and the engine
/// integrates.
///
/// # Errors
/// [`SimulationError::Model`] for data of another model, [`Command`](SimulationError::Command) and
/// [`Length`](SimulationError::Length) before anything has moved;
/// [`Diverged`](SimulationError::Diverged) and [`Engine`](SimulationError::Engine), which every further step returns again until the
/// data is reset.
pub fn step(
    model: &SimModel,
    workspace: &mut Workspace,
    data: &mut SimData,
    commands: &[[f64; 4]],
) -> Result<(), SimulationError> {
    if data.model != model.fingerprint {
        return Err(SimulationError::Model);
    }
    if let Some(error) = &data.failed {
        return Err(error.clone());
    }
    data.accept(commands, model.time_of(data))?;
    data.contacts.clear();
    data.refresh(model);
    if let Err(error) = workspace.load(model, data) {
        return Err(keep_failure(workspace, data, error));
    }
    if let Err(error) = workspace.engine.begin(&data.bodies, &data.states, model.substeps()) {
        return Err(fail(model, workspace, data, 0, error));
    }
    for substep in 0..model.substeps() {
        data.memory.note(&data.states);
        compute_loads(model, workspace, data);
        workspace.previous.copy_from_slice(&data.states);
        let (loads, states) = (&data.loads, &mut data.states);
        let advanced = match &mut workspace.engine {
            Engine::Mujoco(engine) => engine.advance(loads, states),
            Engine::Hybrid(engine) => engine.advance(&data.bodies, loads, states),
            Engine::Explicit(engine) => {
                engine.advance(&data.bodies, loads, states);
                Ok(())
            }
        };
        check_states(model, workspace, data, substep, advanced)?;
        note_contacts(workspace, data);
    }
    data.control_steps += 1;
    data.update_rpys();
    workspace.leave(data);
    Ok(())
}

/// Advances the motors by one physics step and computes what acts on every drone, from the states at its start.
fn compute_loads(model: &SimModel, workspace: &mut Workspace, data: &mut SimData) {
    let (effects, dt) = (model.effects, model.world.timestep);
    // the engine's medium is still
    let medium = model.world.medium.is_some() && model.engine != EngineKind::Explicit;
    let SimData { states, loads, drones, actuators, wakes, bodies, wind, motor_speeds, .. } = data;
    if effects.downwash {
        workspace.downwash.fill(0.0);
        downwash::add_forces(wakes, states, &mut workspace.downwash);
    }
    for (index, (drone, state)) in drones.iter().zip(&*states).enumerate() {
        let rpm = actuators[index].advance(&motor_speeds[index]);
        let rotors = drone.rotors.wrench(rpm);
        let (mut force, mut air) = (Vector3::zeros(), Vector3::zeros());
        if let Some(wind) = wind {
            (force, air) = wind.advance(dt, index, state);
            if medium {
                force += bodies.drones[index].free.moving_medium(&state.attitude, &state.velocity, &air);
            }
        }
        if effects.ground {
            force.z += drone.ground.force(state, rotors.thrust);
        }
        if effects.drag {
            force += drag::force(&drone.params, state, rpm, &air);
        }
        if effects.downwash {
            force.z += workspace.downwash[index];
        }
        loads[index] = Load { rotors, external: Wrench { force_world: force, ..Wrench::ZERO } };
    }
}

/// Checks the states after a physics step. On an error they become those before it.
fn check_states(
    model: &SimModel,
    workspace: &mut Workspace,
    data: &mut SimData,
    substep: u32,
    advanced: Result<(), mujoco_rs::Error>,
) -> Result<(), SimulationError> {
    // MuJoCo itself would say only at the next step that a state has left the range of numbers
    let lost = data.states.iter().enumerate().find_map(|(drone, state)| Some((drone, out_of_range(state)?)));
    let error = match (advanced, lost) {
        (Err(error), _) => {
            data.states.copy_from_slice(&workspace.previous);
            fail(model, workspace, data, substep, error)
        }
        (Ok(()), Some((drone, quantity))) => {
            data.states.copy_from_slice(&workspace.previous);
            let time = model.substep_time(data, substep);
            keep_failure(workspace, data, SimulationError::Diverged { drone, time, quantity })
        }
        (Ok(()), None) => return Ok(()),
    };
    data.update_rpys();
    Err(error)
}

fn note_contacts(workspace: &Workspace, data: &mut SimData) {
    let contacts = &mut data.contacts;
    workspace.engine.contacts(|contact| {
        if !contacts.contains(&contact) {
            contacts.push(contact);
        }
    });
}

/// Marks the data as failed, and the engine's state as none of a sound flight.
fn keep_failure(workspace: &mut Workspace, data: &mut SimData, error: SimulationError) -> SimulationError {
    (workspace.stamp, data.stamp, data.in_mujoco) = (0, 0, false);
    data.failed = Some(error.clone());
    error
}

#[cold]
fn fail(
    model: &SimModel,
    workspace: &mut Workspace,
    data: &mut SimData,
    substep: u32,
    error: mujoco_rs::Error,
) -> SimulationError {
    let time = model.substep_time(data, substep);
    let diverged = match &error {
        mujoco_rs::Error::Diverged(divergence) => {
            workspace.engine.mujoco_engine().diverged_drone(divergence).map(|drone| (drone, divergence))
        }
        _ => None,
    };
    let error = match diverged {
        Some((drone, divergence)) => {
            let quantity = match divergence.quantity {
                mujoco_rs::DivergedQuantity::Position => "position",
                mujoco_rs::DivergedQuantity::Velocity => "velocity",
                mujoco_rs::DivergedQuantity::Acceleration => "acceleration",
            };
            SimulationError::Diverged { drone, time, quantity }
        }
        None => SimulationError::Engine { time, error },
    };
    keep_failure(workspace, data, error)
}

impl SimModel {
    /// Returns the simulated time of data, s.
    fn time_of(&self, data: &SimData) -> f64 {
        data.control_steps as f64 / f64::from(self.ctrl_freq)
    }

    fn substep_time(&self, data: &SimData, substep: u32) -> f64 {
        self.time_of(data) + f64::from(substep) / f64::from(self.sim_freq)
    }
}
