//! The reference engine: MuJoCo's `mj_step`, forces through `xfrc_applied`.

use mujoco_rs::{ActuatorId, BodyId, Data, DivergedQuantity, Divergence, Error, GeomId, JointId, Model};
use nalgebra::Vector3;

use super::{Contact, Load, Touched};
use crate::state::{DroneState, attitude_from_wxyz, wxyz};
use crate::world::{Forcing, SceneError, World};

/// Where one drone's numbers lie in MuJoCo's arrays.
#[derive(Debug, Clone, Copy)]
struct Slot {
    /// Row of `xfrc_applied`.
    body: usize,
    /// First of seven numbers in `qpos`.
    position: usize,
    /// First of six numbers in `qvel`.
    velocity: usize,
    /// First of four numbers in `ctrl`, where forcing is body-fixed.
    control: Option<usize>,
}

/// What a geom belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Owner {
    Drone(usize),
    Obstacle(usize),
    Floor,
    Nobody,
}

/// N free bodies in a MuJoCo scene.
#[derive(Debug)]
pub struct MujocoEngine {
    data: Data,
    slots: Vec<Slot>,
    owners: Vec<Owner>,
}

/// What can go wrong when a scene is made into an engine.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum BuildError {
    /// The scene cannot be written.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// MuJoCo refuses it.
    #[error(transparent)]
    Mujoco(#[from] Error),
}

impl MujocoEngine {
    /// Compiles a world.
    ///
    /// # Errors
    /// [`BuildError`] with what the scene or MuJoCo objects to.
    pub fn new(world: &World) -> Result<Self, BuildError> {
        let mut model = Model::from_xml(&world.to_mjcf()?)?;
        // the text has the shortest decimals that read back to the same bits; this does not depend on the reader
        model.patch().set_timestep(world.timestep)?;
        let mut owners = vec![Owner::Nobody; model.ngeom()];
        let floor: GeomId = model.find("floor")?;
        owners[floor.index()] = Owner::Floor;
        for index in 0..world.obstacles.len() {
            let obstacle: GeomId = model.find(&World::obstacle_name(index))?;
            owners[obstacle.index()] = Owner::Obstacle(index);
        }
        let mut slots = Vec::with_capacity(world.drones.len());
        for index in 0..world.drones.len() {
            let name = World::drone_name(index);
            let (body, joint): (BodyId, JointId) = (model.find(&name)?, model.find(&name)?);
            slots.push(Slot {
                body: body.index(),
                position: address(model.jnt_qposadr()[joint.index()]),
                velocity: address(model.jnt_dofadr()[joint.index()]),
                control: match world.forcing {
                    Forcing::Frozen => None,
                    Forcing::BodyFixed => Some(model.find::<ActuatorId>(&World::actuator_names(index)[0])?.index()),
                },
            });
            for (geom, owner) in owners.iter_mut().enumerate() {
                if address(model.geom_bodyid()[geom]) == body.index() {
                    *owner = Owner::Drone(index);
                }
            }
        }
        Ok(Self { data: Data::new(model)?, slots, owners })
    }

    /// The MuJoCo simulation, to be read.
    pub fn data(&self) -> &Data {
        &self.data
    }

    /// Puts every drone into a state, forgets forces, contacts and the solver's warm start, and sets time to zero.
    ///
    /// Everything else in MuJoCo's data is computed afresh in the next step, so that clearing its buffers, which is
    /// most of what `mj_resetData` does, would change nothing.
    ///
    /// # Errors
    /// Where MuJoCo cannot recover from an earlier error.
    pub fn reset(&mut self, states: &[DroneState]) -> Result<(), Error> {
        self.data.rewind()?;
        self.write(states);
        Ok(())
    }

    /// Changes the mass (kg) and the moments of inertia (kg·m²) of a drone, and what MuJoCo derives from them for a free body
    /// (`mj_setConst`: the inverse weights are means of the diagonal of the inverse inertia).
    ///
    /// # Errors
    /// MuJoCo's, where it cannot copy a shared model.
    pub fn set_body(&mut self, drone: usize, mass: f64, inertia: &Vector3<f64>) -> Result<(), Error> {
        let (body, dof) = (self.slots[drone].body, self.slots[drone].velocity);
        let mut model = self.data.patch_model()?;
        let old = model.body_mass_mut()[body];
        model.body_mass_mut()[body] = mass;
        model.body_inertia_mut()[3 * body..][..3].copy_from_slice(inertia.as_slice());
        model.body_subtreemass_mut()[body] = mass;
        model.body_subtreemass_mut()[0] += mass - old;
        let turning = inertia.map(|moment| 1.0 / moment).mean();
        model.body_invweight0_mut()[2 * body..][..2].copy_from_slice(&[1.0 / mass, turning]);
        model.dof_invweight0_mut()[dof..][..3].fill(1.0 / mass);
        model.dof_invweight0_mut()[dof + 3..][..3].fill(turning);
        model.dof_M0_mut()[dof..][..3].fill(mass);
        model.dof_M0_mut()[dof + 3..][..3].copy_from_slice(inertia.as_slice());
        Ok(())
    }

    /// Changes gravity, m/s² downwards.
    ///
    /// # Errors
    /// As for [`set_body`](Self::set_body), and for what is not a number.
    pub fn set_gravity(&mut self, gravity: f64) -> Result<(), Error> {
        self.data.patch_model()?.set_gravity([0.0, 0.0, -gravity])
    }

    fn write(&mut self, states: &[DroneState]) {
        for (slot, state) in self.slots.iter().zip(states) {
            let position = &mut self.data.qpos_mut()[slot.position..][..7];
            position[..3].copy_from_slice(state.position.as_slice());
            position[3..].copy_from_slice(&wxyz(&state.attitude));
            let velocity = &mut self.data.qvel_mut()[slot.velocity..][..6];
            velocity[..3].copy_from_slice(state.velocity.as_slice());
            velocity[3..].copy_from_slice(state.angular_velocity.as_slice());
        }
    }

    /// Reads every drone's state, from `qpos` and `qvel`: what MuJoCo derives from them (`xpos`, `xquat`) is one
    /// step old after `mj_step`.
    pub fn states(&self, states: &mut [DroneState]) {
        let (qpos, qvel) = (self.data.qpos(), self.data.qvel());
        for (slot, state) in self.slots.iter().zip(states) {
            let p: &[f64; 7] = qpos[slot.position..].first_chunk().expect("a free joint has seven coordinates");
            let v: &[f64; 6] = qvel[slot.velocity..].first_chunk().expect("a free joint has six freedoms");
            state.position = Vector3::new(p[0], p[1], p[2]);
            state.attitude = attitude_from_wxyz([p[3], p[4], p[5], p[6]]);
            state.velocity = Vector3::new(v[0], v[1], v[2]);
            state.angular_velocity = Vector3::new(v[3], v[4], v[5]);
        }
    }

    /// Puts the drones into these states and computes everything that follows from them.
    pub(super) fn show(&mut self, states: &[DroneState]) -> Result<&Data, Error> {
        self.write(states);
        self.data.forward()?;
        Ok(&self.data)
    }

    /// One `mj_step` under these loads, from these states. What is external is constant in the world frame through it;
    /// so are the rotors, or they turn with the body where forcing is body-fixed.
    ///
    /// # Errors
    /// [`Error::Diverged`] and MuJoCo's own errors; the drones must then be [reset](Self::reset).
    pub fn advance(&mut self, loads: &[Load], states: &[DroneState]) -> Result<(), Error> {
        for ((slot, load), state) in self.slots.iter().zip(loads).zip(states) {
            let wrench = match slot.control {
                None => load.rotors.in_world(&state.attitude) + load.external,
                Some(control) => {
                    let torque = load.rotors.torque_body;
                    let controls: &mut [f64; 4] =
                        self.data.ctrl_mut()[control..].first_chunk_mut().expect("four actuators per drone");
                    *controls = [load.rotors.thrust, torque.x, torque.y, torque.z];
                    load.external
                }
            };
            let forces = self.data.xfrc_applied_mut();
            let row: &mut [f64; 6] = forces[6 * slot.body..].first_chunk_mut().expect("a row of six per body");
            let (f, t) = (wrench.force_world, wrench.torque_world);
            *row = [f.x, f.y, f.z, t.x, t.y, t.z];
        }
        self.data.step()
    }

    /// The drone a divergence is about.
    pub(crate) fn diverged_drone(&self, divergence: &Divergence) -> Option<usize> {
        self.slots.iter().position(|slot| match divergence.quantity {
            DivergedQuantity::Position => (slot.position..slot.position + 7).contains(&divergence.index),
            DivergedQuantity::Velocity | DivergedQuantity::Acceleration => {
                (slot.velocity..slot.velocity + 6).contains(&divergence.index)
            }
        })
    }

    /// More contacts than a control step of any drones can report.
    pub(crate) fn max_contacts(&self) -> usize {
        4 * self.data.model().nconmax()
    }

    /// Calls `found` for every drone in touch with something in the last step, once per point of contact and drone.
    pub fn contacts(&self, mut found: impl FnMut(Contact)) {
        for contact in self.data.contacts().filter(|contact| contact.is_active()) {
            let [a, b] = contact.geoms().map(|geom| self.owners[geom.index()]);
            for (this, other) in [(a, b), (b, a)] {
                let Owner::Drone(drone) = this else { continue };
                let with = match other {
                    Owner::Drone(index) => Touched::Drone(index),
                    Owner::Floor => Touched::Floor,
                    Owner::Obstacle(index) => Touched::Obstacle(index),
                    Owner::Nobody => continue,
                };
                found(Contact { drone, with });
            }
        }
    }
}

/// MuJoCo's indices of things that exist are never negative.
fn address(index: i32) -> usize {
    usize::try_from(index).expect("an address of something that exists")
}
