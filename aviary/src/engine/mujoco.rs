//! Reference engine: MuJoCo's `mj_step` with forces through `xfrc_applied`.

use mujoco_rs::{
    ActuatorId, BodyId, Data, DivergedQuantity, Divergence, Error, GeomId, JointId, Model, ModelMut, ObjectId,
    WarningKind,
};
use nalgebra::Vector3;

use super::{Bodies, Contact, Load, Touched};
use crate::state::{DroneState, attitude_from_rpy, attitude_from_wxyz, wxyz};
use crate::world::placement::CollisionCylinder;
use crate::world::{Forcing, Obstacle, SceneError, World};

/// Indices of one drone in MuJoCo's arrays.
#[derive(Debug, Clone, Copy)]
struct Slot {
    /// Row of `xfrc_applied`.
    body: usize,
    /// First of the seven entries in `qpos`.
    position: usize,
    /// First of the six entries in `qvel`.
    velocity: usize,
    /// First of the four entries in `ctrl`; `None` without body-fixed forcing.
    control: Option<usize>,
}

/// Object to which a geom belongs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Owner {
    Drone(usize),
    Obstacle(usize),
    Floor,
    Nobody,
}

/// Integrator of N free bodies in a MuJoCo scene.
#[derive(Debug)]
pub struct MujocoEngine {
    data: Data,
    slots: Vec<Slot>,
    owners: Vec<Owner>,
    obstacles: Obstacles,
    gravity: f64,
    steps: u64,
}

/// Obstacles, and the geoms of the scene that represent the nearest of them.
#[derive(Debug, Default)]
struct Obstacles {
    list: Vec<Obstacle>,
    slots: Vec<ObstacleSlot>,
    /// True if there are more obstacles than geoms.
    crowded: bool,
    /// Radius of the sphere around each drone, m.
    reaches: Vec<f64>,
    /// Positions of the drones at the last assignment of geoms; empty before the first.
    looked_from: Vec<Vector3<f64>>,
    /// Obstacles in reach with their distance; a scratch buffer.
    near: Vec<(f64, usize)>,
}

/// Geom of the scene that represents an obstacle.
#[derive(Debug, Clone, Copy)]
struct ObstacleSlot {
    geom: usize,
    kind: usize,
    /// Index of the represented obstacle.
    holds: Option<usize>,
}

/// Error in the construction of an engine.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum BuildError {
    /// The scene is invalid.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// MuJoCo refuses the scene.
    #[error(transparent)]
    Mujoco(#[from] Error),
}

impl MujocoEngine {
    /// Compiles a world.
    ///
    /// # Errors
    /// [`BuildError`] if the scene is invalid or MuJoCo refuses it.
    pub fn new(world: &World) -> Result<Self, BuildError> {
        let mut model = Model::from_xml(&world.to_mjcf()?)?;
        // the text has the shortest decimals that parse to the same bits; the exact value does not depend on MuJoCo's
        // parser
        model.patch().set_timestep(world.timestep)?;
        let mut owners = vec![Owner::Nobody; model.ngeom()];
        let floor: GeomId = model.find("floor")?;
        owners[floor.index()] = Owner::Floor;
        let mut obstacles = Obstacles::default();
        for index in world.slots() {
            let geom: GeomId = model.find(&World::obstacle_name(index))?;
            owners[geom.index()] = Owner::Obstacle(index);
            let kind = world.obstacles[index].shape.kind();
            obstacles.slots.push(ObstacleSlot { geom: geom.index(), kind, holds: Some(index) });
        }
        obstacles.list.clone_from(&world.obstacles);
        obstacles.crowded = obstacles.slots.len() < world.obstacles.len();
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
        obstacles.reaches =
            world.drones.iter().map(|drone| CollisionCylinder::from(&drone.params).bounding_radius()).collect();
        obstacles.near.reserve(obstacles.list.len());
        let mut engine = Self { data: Data::new(model)?, slots, owners, obstacles, gravity: world.gravity, steps: 0 };
        // sets the exact positions where the text of the scene has an offset (see `World::to_mjcf`)
        engine.set_obstacles(&world.obstacles)?;
        Ok(engine)
    }

    /// Returns MuJoCo's data.
    pub fn data(&self) -> &Data {
        &self.data
    }

    /// Sets the state of every drone, clears forces, contacts and the solver's warm start, and sets time to zero.
    ///
    /// The next step computes everything else in MuJoCo's data. Clearing its buffers, which takes most of the time of
    /// `mj_resetData`, would change nothing.
    ///
    /// # Errors
    /// MuJoCo's error if it cannot recover from an earlier one.
    pub fn reset(&mut self, states: &[DroneState]) -> Result<(), Error> {
        self.data.rewind()?;
        self.obstacles.looked_from.clear();
        self.write(states);
        Ok(())
    }

    /// Sets the bodies of the drones and the gravity of the world if they changed, and the constants that MuJoCo
    /// derives from them for free bodies. (`mj_setConst`: the inverse weights are means of the diagonal of the
    /// inverse inertia.) The next step searches for the nearest obstacles again.
    ///
    /// # Errors
    /// MuJoCo's error if it cannot copy a shared model.
    ///
    /// # Panics
    /// If `bodies` has more drones than the world.
    pub fn begin(&mut self, bodies: &Bodies) -> Result<(), Error> {
        self.obstacles.looked_from.clear();
        for (drone, body) in bodies.drones.iter().enumerate() {
            let slot = self.slots[drone];
            let model = self.data.model();
            let inertia = &model.body_inertia()[3 * slot.body..][..3];
            if model.body_mass()[slot.body] != body.mass || inertia != body.inertia.as_slice() {
                self.set_body(slot, body.mass, &body.inertia)?;
            }
        }
        if self.gravity != bodies.gravity {
            self.data.patch_model()?.set_gravity([0.0, 0.0, -bodies.gravity])?;
            self.gravity = bodies.gravity;
        }
        Ok(())
    }

    fn set_body(&mut self, slot: Slot, mass: f64, inertia: &Vector3<f64>) -> Result<(), Error> {
        let (body, dof) = (slot.body, slot.velocity);
        let mut model = self.data.patch_model()?;
        model.body_mass_mut()[body] = mass;
        model.body_inertia_mut()[3 * body..][..3].copy_from_slice(inertia.as_slice());
        model.body_subtreemass_mut()[body] = mass;
        let whole = model.body_subtreemass_mut();
        whole[0] = whole[1..].iter().sum();
        let turning = inertia.map(|moment| 1.0 / moment).mean();
        model.body_invweight0_mut()[2 * body..][..2].copy_from_slice(&[1.0 / mass, turning]);
        model.dof_invweight0_mut()[dof..][..3].fill(1.0 / mass);
        model.dof_invweight0_mut()[dof + 3..][..3].fill(turning);
        model.dof_M0_mut()[dof..][..3].fill(mass);
        model.dof_M0_mut()[dof + 3..][..3].copy_from_slice(inertia.as_slice());
        Ok(())
    }

    /// Returns the number of physics steps since the engine was created.
    pub fn steps(&self) -> u64 {
        self.steps
    }

    /// Resumes from these states, with the given warm start of the solver or with zeros.
    pub(super) fn resume(&mut self, states: &[DroneState], warm_start: Option<&[f64]>) -> Result<(), Error> {
        // an error of another environment does not concern this one
        if self.data.is_broken() {
            self.data.rewind()?;
        }
        match warm_start {
            Some(warm_start) => self.data.qacc_warmstart_mut().copy_from_slice(warm_start),
            None => self.data.qacc_warmstart_mut().fill(0.0),
        }
        self.write(states);
        Ok(())
    }

    /// Saves the solver's warm start; always returns true.
    pub(super) fn leave(&self, warm_start: &mut [f64]) -> bool {
        warm_start.copy_from_slice(self.data.qacc_warmstart());
        true
    }

    /// Replaces the obstacles by others of the same shapes in the same order, from the next step on.
    ///
    /// # Errors
    /// MuJoCo's error if it cannot copy a shared model.
    ///
    /// # Panics
    /// If there are fewer obstacles than the world has.
    pub fn set_obstacles(&mut self, obstacles: &[Obstacle]) -> Result<(), Error> {
        self.obstacles.list.clear();
        self.obstacles.list.extend_from_slice(obstacles);
        self.obstacles.looked_from.clear();
        for index in 0..self.obstacles.slots.len() {
            let holds = self.obstacles.slots[index].holds;
            self.fill_slot(index, holds)?;
        }
        Ok(())
    }

    /// Assigns an obstacle, or none, to a geom.
    fn fill_slot(&mut self, index: usize, holds: Option<usize>) -> Result<(), Error> {
        let slot = &mut self.obstacles.slots[index];
        slot.holds = holds;
        let geom = slot.geom;
        let mut model = self.data.patch_model()?;
        let Some(obstacle) = holds else {
            // no drone meets a geom this deep under the floor
            model.set_geom_pos(GeomId::new(geom), [0.0, 0.0, -1e6])?;
            self.owners[geom] = Owner::Nobody;
            return Ok(());
        };
        place_geom(&mut model, GeomId::new(geom), &self.obstacles.list[obstacle])?;
        self.owners[geom] = Owner::Obstacle(obstacle);
        Ok(())
    }

    /// Assigns the geoms to the obstacles that drones can reach, if a drone has moved far enough since the last
    /// assignment.
    fn look_around(&mut self, states: &[DroneState]) -> Result<(), Error> {
        /// Range of the search beyond a drone; a drone that has moved by half of it starts the next search, m.
        const STRIDE: f64 = 0.1;
        let ahead = (2.0 * self.data.model().timestep()).max(0.05);
        let field = &mut self.obstacles;
        let moved = |(state, from): (&DroneState, &Vector3<f64>)| (state.position - from).norm() > 0.5 * STRIDE;
        if field.looked_from.len() == states.len() && !states.iter().zip(&field.looked_from).any(moved) {
            return Ok(());
        }
        field.looked_from.clear();
        field.looked_from.extend(states.iter().map(|state| state.position));
        field.near.clear();
        for (index, obstacle) in field.list.iter().enumerate() {
            let reach = obstacle.shape.reach();
            let mut nearest = f64::INFINITY;
            for (state, own) in states.iter().zip(&field.reaches) {
                // a fast drone travels farther until the next search
                let within = STRIDE + ahead * state.velocity.norm();
                // a cheap test first: the sphere around the obstacle
                if (state.position - obstacle.position).norm() - reach - own < within {
                    let gap = obstacle.distance(&state.position) - own;
                    if gap < within {
                        nearest = nearest.min(gap);
                    }
                }
            }
            if nearest < f64::INFINITY {
                field.near.push((nearest, index));
            }
        }
        field.near.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        // the nearest obstacles of each shape, as many as the scene has geoms of it
        let mut room = [0_usize; 4];
        for slot in &field.slots {
            room[slot.kind] += 1;
        }
        let (list, asked) = (&field.list, field.near.len());
        field.near.retain(|&(_, index)| {
            let room = &mut room[list[index].shape.kind()];
            let fits = *room > 0;
            *room = room.saturating_sub(1);
            fits
        });
        if field.near.len() < asked {
            tracing::debug!("only the nearest {} of {asked} obstacles in reach have a geom", field.near.len());
        }
        // equal obstacles are always in equal geoms, independent of earlier assignments
        field.near.sort_unstable_by_key(|&(_, index)| index);
        let mut next = [0_usize; 4];
        for slot in 0..self.obstacles.slots.len() {
            let field = &self.obstacles;
            let (kind, held) = (field.slots[slot].kind, field.slots[slot].holds);
            let of_kind = |&(_, index): &(f64, usize)| field.list[index].shape.kind() == kind;
            let wanted = field.near.iter().copied().filter(of_kind).nth(next[kind]).map(|(_, index)| index);
            next[kind] += 1;
            if held != wanted {
                self.fill_slot(slot, wanted)?;
            }
        }
        Ok(())
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

    /// Reads every drone's state from `qpos` and `qvel`. The quantities that MuJoCo derives from them (`xpos`,
    /// `xquat`) are one step old after `mj_step`.
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

    /// Sets the states of the drones and calls `mj_forward`.
    pub(super) fn show(&mut self, states: &[DroneState]) -> Result<&Data, Error> {
        self.write(states);
        if self.obstacles.crowded {
            self.look_around(states)?;
        }
        self.data.forward()?;
        Ok(&self.data)
    }

    /// Computes one `mj_step` under these loads from these states; replaces the states by the new ones.
    ///
    /// External loads are constant in the world frame during the step. The rotors' wrench is constant in the world
    /// frame, or rotates with the body if forcing is body-fixed.
    ///
    /// # Errors
    /// [`Error::Diverged`], MuJoCo's own errors, and [`Error::Raised`] if the contacts exceed the capacity of the
    /// scene. After an error the caller must [reset](Self::reset) the drones.
    pub fn advance(&mut self, loads: &[Load], states: &mut [DroneState]) -> Result<(), Error> {
        if self.obstacles.crowded {
            self.look_around(states)?;
        }
        for ((slot, load), state) in self.slots.iter().zip(loads).zip(&*states) {
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
        let before = self.full_buffers();
        self.data.step()?;
        self.steps += 1;
        if self.full_buffers() != before {
            let model = self.data.model();
            let message = format!(
                "more than {} contacts, the capacity of the scene: the drones and obstacles overlap too much",
                model.nconmax()
            );
            return Err(Error::Raised { call: "mj_step", message });
        }
        self.states(states);
        Ok(())
    }

    /// Returns how many times MuJoCo has dropped contacts; MuJoCo counts them without an error.
    fn full_buffers(&self) -> usize {
        self.data.warning(WarningKind::ContactFull).count + self.data.warning(WarningKind::ConstraintFull).count
    }

    /// Returns the drone whose state diverged.
    pub(crate) fn diverged_drone(&self, divergence: &Divergence) -> Option<usize> {
        self.slots.iter().position(|slot| match divergence.quantity {
            DivergedQuantity::Position => (slot.position..slot.position + 7).contains(&divergence.index),
            DivergedQuantity::Velocity | DivergedQuantity::Acceleration => {
                (slot.velocity..slot.velocity + 6).contains(&divergence.index)
            }
        })
    }

    /// Returns an upper bound of the number of contacts in a control step, for any drones.
    pub(crate) fn max_contacts(&self) -> usize {
        4 * self.data.model().nconmax()
    }

    /// Calls `found` once for every contact point and touching drone of the last step, in any of its stages: the last
    /// stage alone misses an impact that has ended by then.
    pub fn contacts(&self, mut found: impl FnMut(Contact)) {
        for contact in self.data.contacts_in_step().filter(|contact| contact.is_active()) {
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

/// Sets the pose and the size of a geom to those of an obstacle of the same shape.
pub(crate) fn place_geom(model: &mut ModelMut<'_>, geom: GeomId, obstacle: &Obstacle) -> Result<(), Error> {
    model.set_geom_pos(geom, obstacle.position.into())?;
    model.set_geom_quat(geom, wxyz(&attitude_from_rpy(obstacle.rpy)))?;
    model.set_geom_size(geom, obstacle.shape.sizes())?;
    model.set_geom_rbound(geom, obstacle.shape.reach())
}

/// Converts an index of an existing object, which MuJoCo never makes negative.
fn address(index: i32) -> usize {
    usize::try_from(index).expect("the index of an existing object is not negative")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::drone::DroneModel;
    use crate::world::{DroneBody, Shape};

    /// A drone of 0.6 m height extends half of that upwards.
    #[test]
    fn the_sphere_around_a_drone_decides_which_obstacles_get_geoms() {
        let mut params = DroneModel::Cf2x.params();
        params.collision_height = 0.6;
        let reach = 0.06_f64.hypot(0.3);
        let ball = |x: f64| Obstacle::new(Shape::Sphere { radius: 0.1 }, Vector3::new(x, 0.0, 5.0));
        // more obstacles than geoms; the search of a drone at rest extends 0.1 m
        let far = (0..20).map(|i| ball(10.0 + f64::from(i)));
        let obstacles = far.chain([ball(0.2 + reach - 1e-3), ball(-0.2 - reach - 1e-3)]).collect();
        let body = DroneBody { params, position: Vector3::new(0.0, 0.0, 5.0), rpy: Vector3::zeros() };
        let mut engine = MujocoEngine::new(&World { obstacles, ..World::new(vec![body]) }).unwrap();
        assert!(engine.obstacles.crowded);
        engine.look_around(&[DroneState::at_rest(Vector3::new(0.0, 0.0, 5.0), Vector3::zeros())]).unwrap();
        let held: Vec<_> = engine.obstacles.slots.iter().filter_map(|slot| slot.holds).collect();
        assert_eq!(held, [20]);
    }
}
