//! Hybrid engine: the flight kernel while no drone can touch anything, MuJoCo otherwise. The kernel agrees with
//! MuJoCo to rounding, and so does a flight of the hybrid engine.
//!
//! The engine tests for possible contacts at two levels. At the start of a control step, a ball around every drone
//! contains all its positions until the end of the step, whatever its motors do. If these balls meet nothing, the
//! kernel integrates the whole control step. Otherwise the engine tests before every physics step, with the known
//! forces and the short distance that a drone can travel in it.

use mujoco_rs::{Data, Error};
use nalgebra::Vector3;

use super::flight::FreeBody;
use super::mujoco::{BuildError, MujocoEngine};
use super::{Bodies, Body, Contact, Load, Substeps};
use crate::math::V3;
use crate::state::DroneState;
use crate::world::placement::{CollisionCylinder, obstacle_distance, sphere_clearance, sphere_floor_clearance};
use crate::world::{Forcing, Integrator, Obstacle, World};

/// Integrator of N bodies that chooses between the flight kernel and MuJoCo, for all bodies together.
#[derive(Debug)]
pub struct HybridEngine {
    mujoco: MujocoEngine,
    dt: f64,
    forcing: Forcing,
    medium: bool,
    /// True if the kernel can replace MuJoCo: it implements RK4 only.
    able: bool,
    cylinders: Vec<CollisionCylinder>,
    obstacles: Vec<Obstacle>,
    clearance_caches: Vec<ClearanceCache>,
    /// True if no drone can touch anything during the whole control step.
    clear: bool,
    /// True if MuJoCo has the bodies of this control step.
    informed: bool,
    /// True if MuJoCo computed the last physics step.
    in_mujoco: bool,
    flown: u64,
}

/// Cached distance from a position to the nearest obstacle. At another position the distance is smaller by at most
/// the distance between the two positions.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct ClearanceCache {
    place: Vector3<f64>,
    /// Distance, m; zero if it was not computed.
    distance: f64,
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
        Ok(Self {
            mujoco: MujocoEngine::new(world)?,
            dt: world.timestep,
            forcing: world.forcing,
            medium: world.medium.is_some(),
            able: world.integrator == Integrator::Rk4,
            cylinders: world.drones.iter().map(|drone| CollisionCylinder::from(&drone.params)).collect(),
            obstacles: world.obstacles.clone(),
            clearance_caches: vec![ClearanceCache::default(); world.drones.len()],
            clear: false,
            informed: false,
            in_mujoco: false,
            flown: 0,
        })
    }

    /// Returns true if the engine can use the flight kernel: the integrator is RK4, the only one of the kernel.
    pub fn can_fly(&self) -> bool {
        self.able
    }

    pub(super) fn reset(&mut self, states: &[DroneState]) -> Result<(), Error> {
        self.in_mujoco = false;
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
        let dt = self.dt;
        let radius = |drone: usize| bodies.drones[drone].reach_bound.radius(dt, steps, &states[drone]);
        self.has_room(states, bodies.obstacle_drift, radius, |_, _| false)
    }

    /// Returns true if no drone can touch anything in the next physics step.
    fn is_free(&mut self, bodies: &Bodies, loads: &[Load], states: &[DroneState]) -> bool {
        let dt = self.dt;
        let motion = |drone: usize| {
            let (Body { reach_bound, free, .. }, load) = (&bodies.drones[drone], &loads[drone]);
            reach_bound.one_step(dt, free, &load.rotors, &load.external.force_world, &states[drone])
        };
        let cylinders = std::mem::take(&mut self.cylinders);
        let free = self.has_room(
            states,
            bodies.obstacle_drift,
            |drone| {
                let (travel, turn) = motion(drone);
                // false for NaN, so that the radius is infinite
                if turn < FreeBody::MAX_TURN {
                    bodies.drones[drone].reach_bound.reach() + travel
                } else {
                    f64::INFINITY
                }
            },
            |drone, state| {
                let (travel, turn) = motion(drone);
                turn < FreeBody::MAX_TURN
                    && cylinders[drone].floor_clearance(state)
                        > travel + turn * bodies.drones[drone].reach_bound.reach()
            },
        );
        self.cylinders = cylinders;
        free
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
            let place = V3::from(&state.position);
            let off_the_floor = sphere_floor_clearance(place, ball) > 0.0 || off_floor(drone, state);
            let apart =
                |other: usize| sphere_clearance(place, ball, V3::from(&states[other].position), radius(other)) > 0.0;
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
        if able && (self.clear || self.is_free(bodies, loads, states)) {
            self.fly(bodies, loads, states);
            self.in_mujoco = false;
            self.flown += 1;
            return Ok(());
        }
        if !self.informed {
            self.mujoco.begin(bodies)?;
            self.informed = true;
        }
        if !self.in_mujoco {
            // without contacts there is no warm start of the solver
            self.mujoco.resume(states, None)?;
            self.in_mujoco = true;
        }
        self.mujoco.advance(loads, states)
    }

    fn fly(&self, bodies: &Bodies, loads: &[Load], states: &mut [DroneState]) {
        for ((state, body), load) in states.iter_mut().zip(&bodies.drones).zip(loads) {
            let (dt, free, rotors, force) = (self.dt, &body.free, &load.rotors, &load.external.force_world);
            *state = match (self.forcing, self.medium) {
                (Forcing::Frozen, false) => free.step::<false, false>(dt, rotors, force, state),
                (Forcing::Frozen, true) => free.step::<false, true>(dt, rotors, force, state),
                (Forcing::BodyFixed, false) => free.step::<true, false>(dt, rotors, force, state),
                (Forcing::BodyFixed, true) => free.step::<true, true>(dt, rotors, force, state),
            };
        }
    }

    pub(super) fn resume(&mut self, states: &[DroneState], left: Option<&[f64]>) -> Result<(), Error> {
        self.clearance_caches.fill(ClearanceCache::default());
        self.in_mujoco = left.is_some();
        if left.is_some() { self.mujoco.resume(states, left) } else { Ok(()) }
    }

    pub(super) fn leave(&self, warm_start: &mut [f64]) -> bool {
        self.in_mujoco && self.mujoco.leave(warm_start)
    }

    pub(super) fn contacts(&self, found: impl FnMut(Contact)) {
        if self.in_mujoco {
            self.mujoco.contacts(found);
        }
    }

    pub(super) fn substeps(&self) -> Substeps {
        Substeps { flight: self.flown, mujoco: self.mujoco.steps(), explicit: 0 }
    }

    pub(super) fn mujoco(&mut self, bodies: &Bodies, states: &[DroneState]) -> Result<&Data, Error> {
        self.mujoco.begin(bodies)?;
        if self.in_mujoco {
            return Ok(self.mujoco.data());
        }
        self.mujoco.show(states)
    }

    pub(super) fn mujoco_engine(&self) -> &MujocoEngine {
        &self.mujoco
    }
}
