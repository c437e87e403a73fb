//! Explicit engine of the `dyn` mode: one semi-implicit Euler step of the free rigid body per physics step.
//!
//! The step updates the velocities first, and then position and attitude with the new velocities. With R the attitude
//! at the start of the step, F the force and τ the torque:
//!
//! ```text
//! v += dt·(F/m − g·ẑ)                 F = R·T·ẑ + external
//! ω += dt·J⁻¹·(τ − ω × Jω)            body frame
//! p += dt·v                           with the new v
//! q ← q ⊗ exp(ω·dt)                   with the new ω, closed form
//! ```
//!
//! There is no medium and no contact: drones pass through the floor until the task ends the episode.

use mujoco_rs::{Data, Error};
use nalgebra::{Quaternion, UnitQuaternion, Vector3};

use super::mujoco::{BuildError, MujocoEngine};
use super::{Bodies, Load};
use crate::state::DroneState;
use crate::world::{Obstacle, World};

/// Integrator of N independent free bodies.
#[derive(Debug)]
pub struct ExplicitEngine {
    dt: f64,
    steps: u64,
    mirror: MujocoEngine,
}

impl ExplicitEngine {
    /// Creates the engine of a world, with a MuJoCo model of the same world for views of its state.
    ///
    /// # Errors
    /// [`BuildError`] if the scene is invalid or MuJoCo refuses it.
    pub fn new(world: &World) -> Result<Self, BuildError> {
        Ok(Self { dt: world.timestep, steps: 0, mirror: MujocoEngine::new(world)? })
    }

    /// Sets the state of every drone.
    ///
    /// # Errors
    /// MuJoCo's error from the mirrored model.
    pub fn reset(&mut self, states: &[DroneState]) -> Result<(), Error> {
        self.mirror.reset(states)
    }

    /// Advances the states of these bodies by one physics step under these loads.
    pub fn advance(&mut self, bodies: &Bodies, loads: &[Load], states: &mut [DroneState]) {
        let dt = self.dt;
        let gravity = Vector3::new(0.0, 0.0, -bodies.gravity);
        for ((state, body), load) in states.iter_mut().zip(&bodies.drones).zip(loads) {
            let force = crate::state::body_z(&state.attitude) * load.rotors.thrust + load.external.force_world;
            let torque = load.rotors.torque_body + state.attitude.inverse_transform_vector(&load.external.torque_world);
            let omega = state.angular_velocity;
            let gyroscopic = omega.cross(&body.inertia.component_mul(&omega));
            state.velocity += dt * (force / body.mass + gravity);
            state.angular_velocity += dt * (torque - gyroscopic).component_div(&body.inertia);
            state.position += dt * state.velocity;
            state.attitude = turned(&state.attitude, &(state.angular_velocity * dt));
        }
        self.steps += 1;
    }

    /// Replaces the obstacles of the mirrored model by others of the same shapes in the same order; this engine has
    /// no contacts with them.
    ///
    /// # Errors
    /// MuJoCo's error from the mirrored model.
    ///
    /// # Panics
    /// If there are fewer obstacles than the world has.
    pub fn set_obstacles(&mut self, obstacles: &[Obstacle]) -> Result<(), Error> {
        self.mirror.set_obstacles(obstacles)
    }

    /// Returns the number of physics steps since the engine was created.
    pub fn steps(&self) -> u64 {
        self.steps
    }

    pub(super) fn mujoco(&mut self, bodies: &Bodies, states: &[DroneState]) -> Result<&Data, Error> {
        self.mirror.begin(bodies)?;
        self.mirror.show(states)
    }

    pub(super) fn mirror(&self) -> &MujocoEngine {
        &self.mirror
    }
}

/// Returns an attitude rotated by a rotation vector (rad, body frame): q ⊗ [cos(‖θ‖/2), sin(‖θ‖/2)·θ/‖θ‖].
fn turned(attitude: &UnitQuaternion<f64>, rotation: &Vector3<f64>) -> UnitQuaternion<f64> {
    let half = 0.5 * rotation.norm();
    // sin(x)/x; below 1e-4 the third term of its series is less than the last bit
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
        fn the_rotation_is_the_exponential_map(
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
