use nalgebra::Vector3;

use super::data::unique;
use super::{SimData, SimModel, SimulationError, out_of_range};
use crate::engine::{Engine, EngineKind, Load};
use crate::physics::{Wrench, downwash, drag};
use crate::state::DroneState;

/// Scratch memory of one thread: the engine with MuJoCo's `mjData`, and buffers.
///
/// A workspace keeps no state of an environment that [`SimData`] lacks. It can step any data of its model, in any
/// order.
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

    /// Loads data into the engine, unless the engine still has it from the last step.
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

    /// Saves the engine's part of the state in the data.
    fn leave(&mut self, data: &mut SimData) {
        data.in_mujoco = self.engine.leave(&mut data.warm_start);
        data.stamp = unique();
        self.stamp = data.stamp;
    }

    /// Returns MuJoCo's data with the present states, see [`Simulation::mujoco`](super::Simulation::mujoco).
    pub(super) fn mujoco(
        &mut self,
        model: &SimModel,
        data: &mut SimData,
    ) -> Result<&mujoco_rs::Data, mujoco_rs::Error> {
        data.refresh(model);
        // `load` returns no other error
        if let Err(SimulationError::Engine { error, .. }) = self.load(model, data) {
            return Err(error);
        }
        self.engine.mujoco(&data.bodies, &data.states)
    }
}

/// Advances data by one control step with four motor speeds (rpm) per drone, clipped to 0 to `MAX_RPM` and to the
/// speed that the voltage allows.
///
/// Every physics step advances the motors and the wind, computes forces and torques from the states at its start,
/// and lets the engine integrate. The batteries advance at the end of the control step.
///
/// # Errors
/// [`SimulationError::Model`] for data of another model, [`Command`](SimulationError::Command) and
/// [`Length`](SimulationError::Length): the data has not advanced. [`Diverged`](SimulationError::Diverged) and
/// [`Engine`](SimulationError::Engine): every further step returns the same error until the data is reset.
pub fn step(
    model: &SimModel,
    workspace: &mut Workspace,
    data: &mut SimData,
    commands: &[[f64; 4]],
) -> Result<(), SimulationError> {
    if data.model != model.fingerprint {
        return Err(SimulationError::Model);
    }
    if data.stamp == 0 {
        // data from a file may have been edited
        data.validate(model)?;
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
        data.memory.note(&data.states, data.control_steps, substep, model.substeps());
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
    data.memory.note(&data.states, data.control_steps, model.substeps(), model.substeps());
    data.advance_batteries(model.control_period());
    data.control_steps += 1;
    data.update_rpys();
    workspace.leave(data);
    Ok(())
}

/// Advances the motors by one physics step and computes the load of every drone from the states at its start.
fn compute_loads(model: &SimModel, workspace: &mut Workspace, data: &mut SimData) {
    let (effects, dt) = (model.effects, model.world.timestep);
    // MuJoCo's fluid forces assume that the medium is at rest
    let medium = model.world.medium.is_some() && model.engine != EngineKind::Explicit;
    let SimData { states, loads, drones, actuators, wakes, bodies, wind, motor_speeds, external_forces, .. } = data;
    if effects.downwash {
        workspace.downwash.fill(0.0);
        downwash::add_forces(wakes, states, &mut workspace.downwash);
    }
    for (index, (drone, state)) in drones.iter().zip(&*states).enumerate() {
        let before = *actuators[index].rpm();
        let rpm = actuators[index].advance(&motor_speeds[index]);
        let mut rotors = drone.rotors.wrench(rpm);
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
        if let Some(effects) = &drone.effects {
            force += effects.change(dt, state, &air, [&before, rpm], &mut rotors);
        }
        loads[index] = Load { rotors, external: Wrench { force_world: force, ..Wrench::ZERO } };
    }
    if let Some(forces) = external_forces {
        // drones without a force keep the bits of their loads
        let pushed = loads.iter_mut().zip(forces.iter()).filter(|(_, force)| **force != Vector3::zeros());
        pushed.for_each(|(load, force)| load.external.force_world += force);
    }
}

/// Checks the states after a physics step, and restores the previous ones on an error.
fn check_states(
    model: &SimModel,
    workspace: &mut Workspace,
    data: &mut SimData,
    substep: u32,
    advanced: Result<(), mujoco_rs::Error>,
) -> Result<(), SimulationError> {
    // MuJoCo would notice a state beyond its limit only in the next step
    let diverged = data.states.iter().enumerate().find_map(|(drone, state)| Some((drone, out_of_range(state)?)));
    let error = match (advanced, diverged) {
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

/// Marks the data as failed and invalidates the state in the engine.
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
