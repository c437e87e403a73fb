//! The explicit engine of the `dyn` mode: one Euler step of the free rigid body per physics step.
//!
//! With R the attitude at the start of the step, F the force and τ the torque:
//!
//! ```text
//! v += dt·(F/m − g·ẑ)                 F = R·T·ẑ + external
//! ω += dt·J⁻¹·(τ − ω × Jω)            body frame
//! p += dt·v                           the new v
//! q ← q ⊗ exp(ω·dt)                   the new ω, closed form
//! ```
//!
//! There is no medium and no contact: a floor does not stop it, a task's termination does.

use mujoco_rs::{Data, Error};
use nalgebra::{Quaternion, UnitQuaternion, Vector3};

use super::Load;
use super::mujoco::{BuildError, MujocoEngine};
use crate::state::DroneState;
use crate::world::{Obstacle, World};

/// N free bodies, each by itself.
#[derive(Debug)]
pub struct ExplicitEngine {
    bodies: Vec<Body>,
    states: Vec<DroneState>,
    gravity: Vector3<f64>,
    dt: f64,
    mirror: MujocoEngine,
}

#[derive(Debug, Clone, Copy)]
struct Body {
    mass: f64,
    inertia: Vector3<f64>,
}

impl ExplicitEngine {
    /// The bodies of a world, and a MuJoCo simulation of it to be looked at.
    ///
    /// # Errors
    /// [`BuildError`] with what the scene or MuJoCo objects to.
    pub fn new(world: &World) -> Result<Self, BuildError> {
        let bodies = (world.drones.iter())
            .map(|drone| Body { mass: drone.params.mass, inertia: drone.params.inertia_vector() })
            .collect();
        Ok(Self {
            bodies,
            states: vec![DroneState::default(); world.drones.len()],
            gravity: Vector3::new(0.0, 0.0, -world.gravity),
            dt: world.timestep,
            mirror: MujocoEngine::new(world)?,
        })
    }

    /// States of all drones.
    pub fn states(&self) -> &[DroneState] {
        &self.states
    }

    /// Puts every drone into a state.
    ///
    /// # Errors
    /// MuJoCo's, from the mirror.
    pub fn reset(&mut self, states: &[DroneState]) -> Result<(), Error> {
        self.states.copy_from_slice(states);
        self.mirror.reset(states)
    }

    /// One step.
    pub fn advance(&mut self, loads: &[Load]) {
        let dt = self.dt;
        for ((state, body), load) in self.states.iter_mut().zip(&self.bodies).zip(loads) {
            let force = crate::state::body_z(&state.attitude) * load.rotors.thrust + load.external.force_world;
            let torque = load.rotors.torque_body + state.attitude.inverse_transform_vector(&load.external.torque_world);
            let omega = state.angular_velocity;
            let gyroscopic = omega.cross(&body.inertia.component_mul(&omega));
            state.velocity += dt * (force / body.mass + self.gravity);
            state.angular_velocity += dt * (torque - gyroscopic).component_div(&body.inertia);
            state.position += dt * state.velocity;
            state.attitude = turned(&state.attitude, &(state.angular_velocity * dt));
        }
    }

    /// Changes the mass (kg) and the moments of inertia (kg·m²) of a drone.
    ///
    /// # Errors
    /// MuJoCo's, from the mirror.
    pub fn set_body(&mut self, drone: usize, mass: f64, inertia: &Vector3<f64>) -> Result<(), Error> {
        self.bodies[drone] = Body { mass, inertia: *inertia };
        self.mirror.set_body(drone, mass, inertia)
    }

    /// Other obstacles of the same shapes, to be looked at: nothing here touches them.
    ///
    /// # Errors
    /// MuJoCo's, from the mirror.
    pub fn set_obstacles(&mut self, obstacles: &[Obstacle]) -> Result<(), Error> {
        self.mirror.set_obstacles(obstacles)
    }

    /// Changes gravity, m/s² downwards.
    ///
    /// # Errors
    /// MuJoCo's, from the mirror.
    pub fn set_gravity(&mut self, gravity: f64) -> Result<(), Error> {
        self.gravity = Vector3::new(0.0, 0.0, -gravity);
        self.mirror.set_gravity(gravity)
    }

    pub(super) fn synchronised(&mut self) -> Result<&Data, Error> {
        self.mirror.show(&self.states)
    }

    pub(super) fn mirror(&self) -> &MujocoEngine {
        &self.mirror
    }
}

/// An attitude after a rotation by this vector (rad, body frame): q ⊗ [cos(‖θ‖/2), sin(‖θ‖/2)·θ/‖θ‖].
fn turned(attitude: &UnitQuaternion<f64>, rotation: &Vector3<f64>) -> UnitQuaternion<f64> {
    let half = 0.5 * rotation.norm();
    // sin(x)/x, whose series ends after two terms where the next is below the last bit
    let sinc = if half < 1e-4 { 1.0 - half * half / 6.0 } else { half.sin() / half };
    let vector = rotation * (0.5 * sinc);
    let step = Quaternion::new(half.cos(), vector.x, vector.y, vector.z);
    UnitQuaternion::new_normalize(attitude.into_inner() * step)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn turning_is_the_exponential_map(
            axis in prop::array::uniform3(-3.0..3.0), scale in -9.0..0.5f64, start in prop::array::uniform3(-3.0..3.0),
        ) {
            let rotation = Vector3::from(axis) * 10f64.powf(scale);
            let attitude = UnitQuaternion::from_scaled_axis(Vector3::from(start));
            let wanted = attitude * UnitQuaternion::from_scaled_axis(rotation);
            let got = turned(&attitude, &rotation);
            prop_assert!((got.coords - wanted.coords).norm().min((got.coords + wanted.coords).norm()) < 1e-15 * 10.0);
        }
    }
}
