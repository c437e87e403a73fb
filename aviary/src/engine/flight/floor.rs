//! One physics step of drones that touch nothing but the floor, as `mj_step` computes it.
//!
//! Each of the four stages of RK4 finds the contacts at the poses of the stage and solves for the accelerations.
//! Contact points repeat MuJoCo's operations in their order: MuJoCo divides a difference of numbers close to one by
//! the sine of the tilt to find the lowest point of a rim. The rounding of a nearly upright attitude therefore decides
//! about micrometres, and nearly upright attitudes also repeat MuJoCo's operations.

mod attitude;
mod landing;
mod rim;

use pulp::{Simd, WithSimd};

use super::Width;
use super::contact_solver::{POINTS, Problem, solve};
use super::floor_model::{Cylinder, FloorModel};
use crate::engine::{Body, Load};
use crate::state::DroneState;
use landing::Landing;

/// Range of the ratio of mass times squared size to a moment of inertia, about 2 to 20 for a solid cylinder. Outside of
/// it the rounding of the solver decides about more than 1e-8 of a state.
const SHAPES: std::ops::RangeInclusive<f64> = 1e-3..=1e3;

/// Time step of a world, and what distinguishes the equations of motion of worlds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct StepKind {
    /// Time step, s.
    pub dt: f64,
    /// True if the rotors' wrench rotates with the body during a step.
    pub body_fixed: bool,
    /// True if there is a medium.
    pub medium: bool,
}

/// Steps of drones on the floor of one world, with scratch memory.
#[derive(Debug, Clone)]
pub(crate) struct FloorKernel {
    width: Width,
    model: FloorModel,
    drones: Vec<Landing>,
    problems: Vec<Problem>,
    /// Drone of each contact point of the last step, as MuJoCo's list has them after its last stage: every stage writes
    /// its points from the start of the list, and leaves those of earlier stages behind them.
    contacts: Vec<usize>,
}

impl FloorKernel {
    /// Creates the kernel of a world with this contact model. The results are bit-identical for all instruction sets.
    pub(crate) fn new(model: FloorModel, width: Width) -> Self {
        let drones = model.cylinders.len();
        Self {
            width,
            model,
            drones: vec![Landing::default(); drones],
            problems: vec![Problem::default(); drones],
            contacts: Vec::new(),
        }
    }

    /// Computes one physics step. `rooms` are the distances (m) within which drones touch nothing but the floor.
    ///
    /// `warm_starts` has the accelerations of the last stage of the previous step, six numbers per drone (linear in
    /// the world frame, angular in the body frame), and receives those of this step, like MuJoCo's `qacc_warmstart`.
    /// The result depends on no other memory.
    ///
    /// Returns false, with unchanged states and warm starts, if MuJoCo must compute the step: an acceleration is beyond
    /// MuJoCo's limit, a stage is outside of its room, or the inertia is outside of [`SHAPES`].
    pub(crate) fn step(
        &mut self,
        kind: &StepKind,
        bodies: &[Body],
        loads: &[Load],
        states: &mut [DroneState],
        rooms: &[f64],
        warm_starts: &mut [f64],
    ) -> bool {
        let width = self.width;
        width.run(POINTS, Step { kernel: self, kind, bodies, loads, states, rooms, warm_starts })
    }

    /// Returns the drone of each contact point of the last step, in any of its stages.
    pub(crate) fn contacts(&self) -> impl Iterator<Item = usize> {
        self.contacts.iter().copied()
    }
}

/// Arguments of [`FloorKernel::step`].
struct Step<'a> {
    kernel: &'a mut FloorKernel,
    kind: &'a StepKind,
    bodies: &'a [Body],
    loads: &'a [Load],
    states: &'a mut [DroneState],
    rooms: &'a [f64],
    warm_starts: &'a mut [f64],
}

impl WithSimd for Step<'_> {
    type Output = bool;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> bool {
        let Self { kernel, kind, bodies, loads, states, rooms, warm_starts } = self;
        let FloorKernel { model, drones, problems, contacts, .. } = kernel;
        let FloorModel { contact, cylinders } = &*model;
        if !cylinders.iter().zip(bodies).all(|(cylinder, body)| is_regular(cylinder, body)) {
            return false;
        }
        if let ([cylinder], [body], [load], [state], [room]) = (&cylinders[..], bodies, loads, &mut *states, rooms) {
            let (mut drone, problem) = (Landing::new(kind, body, load, state, warm_starts), &mut problems[0]);
            let mut most = 0;
            for stage in 0..4 {
                drone.find_smooth(kind, body);
                let acceleration = drone.solve_alone(simd, contact, cylinder, body, problem);
                most = most.max(drone.points);
                if !drone.accept(stage, kind.dt, &acceleration) {
                    return false;
                }
            }
            contacts.clear();
            contacts.resize(most, 0);
            if !drone.is_within(*room) {
                return false;
            }
            *state = drone.end(kind.dt);
            warm_starts.copy_from_slice(&drone.warm_start);
            return true;
        }
        for (index, warm_start) in warm_starts.as_chunks::<6>().0.iter().enumerate() {
            drones[index] = Landing::new(kind, &bodies[index], &loads[index], &states[index], warm_start);
        }
        contacts.clear();
        for stage in 0..4 {
            let mut found = 0;
            for (index, (drone, problem)) in drones.iter_mut().zip(&mut *problems).enumerate() {
                drone.find_smooth(kind, &bodies[index]);
                let floor_points = drone.rim(&cylinders[index]).points(cylinders[index].radius);
                drone.find_contacts(contact, &bodies[index], &floor_points, problem);
                for _ in 0..problem.points {
                    match contacts.get_mut(found) {
                        Some(contact) => *contact = index,
                        None => contacts.push(index),
                    }
                    found += 1;
                }
            }
            let touching = found > 0;
            if touching {
                for (index, (drone, problem)) in drones.iter().zip(&mut *problems).enumerate() {
                    drone.pose_problem(&bodies[index], problem);
                }
                solve(&contact.solver, problems);
            }
            for (drone, problem) in drones.iter_mut().zip(&*problems) {
                let acceleration = if touching { drone.in_body_frame(&problem.acceleration) } else { drone.smooth };
                if !drone.accept(stage, kind.dt, &acceleration) {
                    return false;
                }
            }
        }
        if !drones.iter().zip(rooms).all(|(drone, &room)| drone.is_within(room)) {
            return false;
        }
        for ((drone, state), warm_start) in drones.iter().zip(states).zip(warm_starts.as_chunks_mut().0) {
            *state = drone.end(kind.dt);
            *warm_start = drone.warm_start;
        }
        true
    }
}

/// Returns true if the moments of inertia are within [`SHAPES`].
#[inline(always)]
fn is_regular(cylinder: &Cylinder, body: &Body) -> bool {
    let size = cylinder.radius * cylinder.radius + cylinder.half_height * cylinder.half_height;
    body.free.0.inverse_inertia.iter().all(|inverse| SHAPES.contains(&(body.mass * size * inverse)))
}
