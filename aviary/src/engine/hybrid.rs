//! Hybrid engine: the flight kernel while no drone can touch anything but the floor, MuJoCo otherwise. The kernel
//! agrees with MuJoCo to rounding, and so does a flight of the hybrid engine.
//!
//! The engine tests for possible contacts at three levels. At the start of a control step, a ball around every drone
//! contains all its positions until the end of the step, whatever its motors do. If these balls meet nothing, the
//! kernel integrates the whole control step. Otherwise the engine tests before every physics step, with the known
//! forces and the short distance that a drone can travel in it. If only the floor is in reach, the kernel computes
//! the contacts with it ([`FloorKernel`]). It returns the step to MuJoCo if a contact has thrown a drone farther than
//! the tested distance, and if an acceleration is beyond MuJoCo's limit.

use ::flight::clearance::{sphere_clearance, sphere_floor_clearance};
use mujoco_rs::{Data, Error};
use nalgebra::Vector3;

use super::flight::{FloorKernel, FloorModel, FreeBody, StepKind, Width};
use super::mujoco::{BuildError, MujocoEngine};
use super::{Bodies, Body, Contact, Load, Substeps, Touched};
use crate::math::ToFlight as _;
use crate::state::DroneState;
use crate::world::placement::{CollisionCylinder, obstacle_distance};
use crate::world::{Forcing, Integrator, Obstacle, World};

/// Integrator of N bodies that chooses between the flight kernel and MuJoCo, for all bodies together.
#[derive(Debug)]
pub struct HybridEngine {
    mujoco: MujocoEngine,
    kind: StepKind,
    /// Kernel of contacts with the floor; `None` if the scene has settings that it lacks.
    floor: Option<Box<FloorKernel>>,
    /// True if the kernel can replace MuJoCo: it implements RK4 only.
    able: bool,
    cylinders: Vec<CollisionCylinder>,
    obstacles: Vec<Obstacle>,
    clearance_caches: Vec<ClearanceCache>,
    /// True if no drone can touch anything during the whole control step.
    clear: bool,
    /// True if MuJoCo has the bodies of this control step.
    informed: bool,
    last: Last,
    /// Accelerations of the last stage in contact with the floor: the solver's warm start, as in MuJoCo's
    /// `qacc_warmstart`. Valid after [`Last::Floor`].
    warm_starts: Vec<f64>,
    /// Distance around each drone without obstacles and other drones, m; a scratch buffer.
    rooms: Vec<f64>,
    /// Bounds of the distance (m) and the rotation angle (rad) of each drone in a physics step; a scratch buffer.
    motions: Vec<(f64, f64)>,
    flown: u64,
}

/// Part of the engine that computed the last physics step.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Last {
    /// Free flight: there were no contacts, and there is no warm start.
    Flight,
    /// The kernel of contacts with the floor, or an environment was resumed with a warm start.
    Floor,
    Mujoco,
}

/// Cached distance from a position to the nearest obstacle. At another position the distance is smaller by at most
/// the distance between the two positions.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct ClearanceCache {
    place: Vector3<f64>,
    /// Distance, m; zero if it was not computed.
    distance: f64,
}

/// Objects that drones can touch in a physics step.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Reachable {
    Nothing,
    Floor,
    Anything,
}

impl ClearanceCache {
    /// Returns true if every obstacle is farther than `room` (m) from a position.
    #[inline]
    pub(crate) fn has_room(&mut self, obstacles: &[Obstacle], place: &Vector3<f64>, room: f64) -> bool {
        /// Margin for rounding, so that the result does not depend on the position of the cached distance, m.
        const SLACK: f64 = 1e-6;
        if obstacles.is_empty() || self.distance - (place - self.place).norm() > room + SLACK {
            return true;
        }
        let distance = obstacle_distance(obstacles, place);
        *self = Self { place: *place, distance };
        distance > room
    }
}

impl HybridEngine {
    /// Creates the engine of a world.
    ///
    /// # Errors
    /// [`BuildError`] if the scene is invalid or MuJoCo refuses it.
    pub fn new(world: &World) -> Result<Self, BuildError> {
        let mujoco = MujocoEngine::new(world)?;
        let drones = world.drones.len();
        Ok(Self {
            floor: FloorModel::read(mujoco.data().model(), world)
                .map(|model| Box::new(FloorKernel::new(model, Width::best()))),
            mujoco,
            kind: StepKind {
                dt: world.timestep,
                body_fixed: world.forcing == Forcing::BodyFixed,
                medium: world.medium.is_some(),
            },
            able: world.integrator == Integrator::Rk4,
            cylinders: world.drones.iter().map(|drone| CollisionCylinder::from(&drone.params)).collect(),
            obstacles: world.obstacles.clone(),
            clearance_caches: vec![ClearanceCache::default(); drones],
            clear: false,
            informed: false,
            last: Last::Flight,
            warm_starts: vec![0.0; 6 * drones],
            rooms: vec![0.0; drones],
            motions: vec![(0.0, 0.0); drones],
            flown: 0,
        })
    }

    /// Returns true if the engine can use the flight kernel: the integrator is RK4, the only one of the kernel.
    pub fn can_fly(&self) -> bool {
        self.able
    }

    pub(super) fn reset(&mut self, states: &[DroneState]) -> Result<(), Error> {
        self.last = Last::Flight;
        self.mujoco.reset(states)
    }

    pub(super) fn set_obstacles(&mut self, obstacles: &[Obstacle]) -> Result<(), Error> {
        self.obstacles.clear();
        self.obstacles.extend_from_slice(obstacles);
        self.clearance_caches.fill(ClearanceCache::default());
        self.mujoco.set_obstacles(obstacles)
    }

    pub(super) fn begin(&mut self, bodies: &Bodies, states: &[DroneState], steps: u32) {
        self.informed = false;
        self.clear = self.able && self.is_clear(bodies, states, steps);
    }

    /// Returns true if no drone can touch anything for `steps` physics steps, whatever its motors do.
    fn is_clear(&mut self, bodies: &Bodies, states: &[DroneState], steps: u32) -> bool {
        let dt = self.kind.dt;
        let radius = |drone: usize| bodies.drones[drone].reach_bound.radius(dt, steps, &states[drone]);
        self.has_room(states, bodies.obstacle_drift, radius, |_, _| false)
    }

    /// Returns the obstacles that drones can reach in the next physics step.
    fn reachable(&mut self, bodies: &Bodies, loads: &[Load], states: &[DroneState]) -> Reachable {
        let dt = self.kind.dt;
        let (cylinders, mut motions) = (std::mem::take(&mut self.cylinders), std::mem::take(&mut self.motions));
        for (drone, motion) in motions.iter_mut().enumerate() {
            let (Body { reach_bound, free, .. }, load) = (&bodies.drones[drone], &loads[drone]);
            *motion = reach_bound.one_step(dt, free, &load.rotors, &load.external.force_world, &states[drone]);
        }
        let free = self.has_room(
            states,
            bodies.obstacle_drift,
            |drone| {
                let (travel, turn) = motions[drone];
                // false for NaN, so that the radius is infinite
                if turn < FreeBody::MAX_TURN {
                    bodies.drones[drone].reach_bound.reach() + travel
                } else {
                    f64::INFINITY
                }
            },
            |drone, state| {
                let (travel, turn) = motions[drone];
                let cylinder = &cylinders[drone];
                turn < FreeBody::MAX_TURN
                    && cylinder.floor_clearance(state) - cylinder.rounding_of_contacts(&state.up())
                        > travel + turn * bodies.drones[drone].reach_bound.reach()
            },
        );
        (self.cylinders, self.motions) = (cylinders, motions);
        if free {
            return Reachable::Nothing;
        }
        if self.floor.is_none() {
            return Reachable::Anything;
        }
        let mut rooms = std::mem::take(&mut self.rooms);
        let mut known = true;
        for (drone, room) in rooms.iter_mut().enumerate() {
            let (travel, turn) = self.motions[drone];
            let reach = bodies.drones[drone].reach_bound.reach();
            *room = 2.0 * travel + dt * states[drone].angular_velocity.norm() * reach + 0.05 * reach;
            // the kernel of the floor has no limit of the rotation
            let near_floor = sphere_floor_clearance(states[drone].position.to_flight(), reach + *room) <= 0.0;
            known &= turn < FreeBody::MAX_TURN || (turn.is_finite() && near_floor);
        }
        let alone = known
            && self.has_room(
                states,
                bodies.obstacle_drift,
                |drone| bodies.drones[drone].reach_bound.reach() + rooms[drone],
                |_, _| true,
            );
        self.rooms = rooms;
        if alone { Reachable::Floor } else { Reachable::Anything }
    }

    /// Returns true if the balls of these radii around the drones meet neither the floor, nor each other, nor an
    /// obstacle that can move by `drift` (m). `off_floor` may prove that a drone cannot reach the floor although its
    /// ball does.
    fn has_room(
        &mut self,
        states: &[DroneState],
        drift: f64,
        radius: impl Fn(usize) -> f64,
        off_floor: impl Fn(usize, &DroneState) -> bool,
    ) -> bool {
        states.iter().enumerate().all(|(drone, state)| {
            let ball = radius(drone);
            let place = state.position.to_flight();
            let off_the_floor = sphere_floor_clearance(place, ball) > 0.0 || off_floor(drone, state);
            let apart =
                |other: usize| sphere_clearance(place, ball, states[other].position.to_flight(), radius(other)) > 0.0;
            off_the_floor
                && (0..drone).all(apart)
                && self.clearance_caches[drone].has_room(&self.obstacles, &state.position, ball + drift)
        })
    }

    /// Advances these bodies by one physics step under these loads; replaces the states by the new ones.
    ///
    /// # Errors
    /// The errors of [`MujocoEngine::advance`].
    pub fn advance(&mut self, bodies: &Bodies, loads: &[Load], states: &mut [DroneState]) -> Result<(), Error> {
        // in the kernel only the rotors exert torques
        let able = self.able && loads.iter().all(|load| load.external.torque_world == Vector3::zeros());
        let reachable = match able {
            true if self.clear => Reachable::Nothing,
            true => self.reachable(bodies, loads, states),
            false => Reachable::Anything,
        };
        if reachable == Reachable::Nothing {
            self.fly(bodies, loads, states);
            self.last = Last::Flight;
            self.flown += 1;
            return Ok(());
        }
        if reachable == Reachable::Floor && self.land(bodies, loads, states) {
            self.last = Last::Floor;
            self.flown += 1;
            return Ok(());
        }
        if !self.informed {
            self.mujoco.begin(bodies)?;
            self.informed = true;
        }
        if self.last != Last::Mujoco {
            let warm_start = (self.last == Last::Floor).then_some(&self.warm_starts[..]);
            self.mujoco.resume(states, warm_start)?;
            self.last = Last::Mujoco;
        }
        self.mujoco.advance(loads, states)
    }

    fn fly(&self, bodies: &Bodies, loads: &[Load], states: &mut [DroneState]) {
        for ((state, body), load) in states.iter_mut().zip(&bodies.drones).zip(loads) {
            let (dt, free, rotors, force) = (self.kind.dt, &body.free, &load.rotors, &load.external.force_world);
            *state = match (self.kind.body_fixed, self.kind.medium) {
                (false, false) => free.step::<false, false>(dt, rotors, force, state),
                (false, true) => free.step::<false, true>(dt, rotors, force, state),
                (true, false) => free.step::<true, false>(dt, rotors, force, state),
                (true, true) => free.step::<true, true>(dt, rotors, force, state),
            };
        }
    }

    /// Computes a step in which drones touch at most the floor. Returns false if MuJoCo must compute it.
    fn land(&mut self, bodies: &Bodies, loads: &[Load], states: &mut [DroneState]) -> bool {
        let Some(floor) = &mut self.floor else { return false };
        match self.last {
            // without contacts there is no warm start of the solver
            Last::Flight => self.warm_starts.fill(0.0),
            Last::Floor => {}
            Last::Mujoco => {
                self.mujoco.leave(&mut self.warm_starts);
            }
        }
        floor.step(&self.kind, &bodies.drones, loads, states, &self.rooms, &mut self.warm_starts)
    }

    pub(super) fn resume(&mut self, left: Option<&[f64]>) {
        self.clearance_caches.fill(ClearanceCache::default());
        self.last = Last::Flight;
        if let Some(left) = left {
            self.warm_starts.copy_from_slice(left);
            self.last = Last::Floor;
        }
    }

    pub(super) fn leave(&self, warm_start: &mut [f64]) -> bool {
        match self.last {
            Last::Flight => false,
            Last::Floor => {
                warm_start.copy_from_slice(&self.warm_starts);
                true
            }
            Last::Mujoco => self.mujoco.leave(warm_start),
        }
    }

    pub(super) fn contacts(&self, mut found: impl FnMut(Contact)) {
        match (self.last, &self.floor) {
            (Last::Mujoco, _) => self.mujoco.contacts(found),
            (Last::Floor, Some(floor)) => {
                floor.contacts().for_each(|drone| found(Contact { drone, with: Touched::Floor }));
            }
            _ => {}
        }
    }

    pub(super) fn substeps(&self) -> Substeps {
        Substeps { flight: self.flown, mujoco: self.mujoco.steps(), explicit: 0 }
    }

    pub(super) fn mujoco(&mut self, bodies: &Bodies, states: &[DroneState]) -> Result<&Data, Error> {
        self.mujoco.begin(bodies)?;
        if self.last == Last::Mujoco {
            return Ok(self.mujoco.data());
        }
        // the accelerations that MuJoCo shows must not depend on an earlier environment
        let warm_start = (self.last == Last::Floor).then_some(&self.warm_starts[..]);
        self.mujoco.resume(states, warm_start)?;
        self.mujoco.show(states)
    }

    pub(super) fn mujoco_engine(&self) -> &MujocoEngine {
        &self.mujoco
    }
}
