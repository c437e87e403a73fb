//! The hybrid engine: the flight kernel while nothing can touch, MuJoCo otherwise. The two agree to rounding, so that a flight
//! is that of MuJoCo alone.
//!
//! Whether something can touch is asked twice. At the start of a control step every drone is a ball that holds whatever its
//! motors may do until the end of it; if these balls meet nothing, all of the step is flown. Otherwise the question is asked
//! before every physics step, when the forces are known, with the little that can be travelled in it.

use mujoco_rs::{Data, Error};
use nalgebra::Vector3;

use super::flight::FreeBody;
use super::mujoco::{BuildError, MujocoEngine};
use super::{Bodies, Body, Contact, Load, Substeps};
use crate::math::V3;
use crate::state::DroneState;
use crate::world::placement::{CollisionCylinder, obstacle_distance, sphere_clearance, sphere_floor_clearance};
use crate::world::{Forcing, Integrator, Obstacle, World};

/// N bodies that fly or are in touch, together.
#[derive(Debug)]
pub struct HybridEngine {
    mujoco: MujocoEngine,
    dt: f64,
    forcing: Forcing,
    medium: bool,
    /// Whether the kernel can do what MuJoCo would: it knows RK4 alone.
    able: bool,
    cylinders: Vec<CollisionCylinder>,
    obstacles: Vec<Obstacle>,
    clearance_caches: Vec<ClearanceCache>,
    /// Whether the whole control step is in the open.
    clear: bool,
    /// Whether MuJoCo has the bodies of this control step.
    informed: bool,
    /// Whether MuJoCo did the last physics step.
    in_mujoco: bool,
    flown: u64,
}

/// How far the nearest obstacle was from a place: wherever one is since, it cannot be nearer than that less the way between.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct ClearanceCache {
    place: Vector3<f64>,
    /// m; less than nothing where nobody has looked.
    distance: f64,
}

impl ClearanceCache {
    /// Whether there is more than this room (m) about a place.
    #[inline]
    pub(crate) fn has_room(&mut self, obstacles: &[Obstacle], place: &Vector3<f64>, room: f64) -> bool {
        /// Left for rounding, so that the answer does not hang on when somebody looked, m.
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
    /// For a world.
    ///
    /// # Errors
    /// [`BuildError`] with what the scene or MuJoCo objects to.
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

    /// Whether it ever flies: the kernel knows MuJoCo's RK4, not its other integrators.
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

    /// Whether no drone can touch anything for so many physics steps, whatever its motors do.
    fn is_clear(&mut self, bodies: &Bodies, states: &[DroneState], steps: u32) -> bool {
        let dt = self.dt;
        let radius = |drone: usize| bodies.drones[drone].reach_bound.radius(dt, steps, &states[drone]);
        self.has_room(states, bodies.obstacle_drift, radius, |_, _| false)
    }

    /// Whether no drone can touch anything in the coming physics step.
    fn is_free(&mut self, bodies: &Bodies, loads: &[Load], states: &[DroneState]) -> bool {
        let dt = self.dt;
        let motion = |drone: usize| {
            let (Body { reach_bound, free, mass, .. }, load) = (&bodies.drones[drone], &loads[drone]);
            let force = load.rotors.thrust.abs() + load.external.force_world.norm() + mass * bodies.gravity.abs();
            reach_bound.one_step(dt, free, force, load.rotors.torque_body.norm(), &states[drone])
        };
        let cylinders = std::mem::take(&mut self.cylinders);
        let free = self.has_room(
            states,
            bodies.obstacle_drift,
            |drone| {
                let (travel, turn) = motion(drone);
                // NaN and infinity are no room
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

    /// Whether balls of these radii about the drones meet neither the floor nor each other nor an obstacle that may move so far; a drone may be known
    /// to be off the floor by more than its ball says.
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

    /// Makes one physics step of these bodies under these loads from these states, which are replaced by the new ones.
    ///
    /// # Errors
    /// As for [`MujocoEngine::advance`].
    pub fn advance(&mut self, bodies: &Bodies, loads: &[Load], states: &mut [DroneState]) -> Result<(), Error> {
        // the kernel's bodies are turned by their rotors alone
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
            // in the open there is nothing for the solver to be warm from
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
