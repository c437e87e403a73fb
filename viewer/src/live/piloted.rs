//! Rollouts in a window.

use aviary::action::ActionType;
use aviary::control::{ControllerKind, Reference};
use aviary::env::DroneEnv;
use aviary::physics::wind::WindConfig;
use aviary::rollout::{PilotMode, PilotedPolicy, Policy, Rollout, RolloutSnapshot};
use nalgebra::Vector3;

use super::Flown;
use crate::frame::Source;

/// A rollout whose drones a person can fly by hand. Every such type is [`Flown`].
pub trait PilotedRollout {
    /// Policy that flies the drones otherwise.
    type Policy: Policy;

    /// Returns the rollout.
    fn rollout(&self) -> &Rollout<Box<dyn DroneEnv>, PilotedPolicy<Self::Policy>>;

    /// Returns the rollout mutably.
    fn rollout_mut(&mut self) -> &mut Rollout<Box<dyn DroneEnv>, PilotedPolicy<Self::Policy>>;

    /// Returns the name of the policy.
    fn name(&self) -> String;

    /// Returns the reference of a drone.
    fn reference(&self, drone: usize) -> Reference {
        self.rollout().env().reference(drone)
    }

    /// Returns the kind of the controllers, if controllers fly the drones.
    fn kind(&self) -> Option<ControllerKind> {
        None
    }

    /// Flies with controllers of another kind.
    ///
    /// # Errors
    /// A message if the policy is not one of controllers.
    fn set_kind(&mut self, kind: ControllerKind) -> Result<(), String> {
        Err(format!("{} flies, expected a flight with built-in controllers to switch to {kind}", self.name()))
    }
}

/// Returns an error as a message.
fn message<T>(done: Result<T, impl std::fmt::Display>) -> Result<T, String> {
    done.map_err(|error| error.to_string())
}

impl<T: PilotedRollout> Flown for T {
    type Saved = (RolloutSnapshot, Option<ControllerKind>);

    fn source(&self) -> Source<'_> {
        Source::Env(&**self.rollout().env())
    }

    fn reference(&self, drone: usize) -> Option<Vector3<f64>> {
        Some(PilotedRollout::reference(self, drone).position)
    }

    fn pilot(&self) -> String {
        self.name()
    }

    fn save(&self) -> Self::Saved {
        (self.rollout().snapshot(), self.kind())
    }

    fn restore(&mut self, (snapshot, kind): &Self::Saved) -> Result<(), String> {
        if let Some(kind) = kind.filter(|_| self.kind() != *kind) {
            self.set_kind(kind)?;
        }
        message(self.rollout_mut().restore(snapshot))
    }

    fn restart(&mut self, seed: Option<u64>) -> Result<(), String> {
        message(self.rollout_mut().restart(seed))
    }

    fn set_force(&mut self, drone: usize, force: Vector3<f64>) -> Result<(), String> {
        message(self.rollout_mut().env_mut().set_external_force(drone, force))
    }

    fn set_wind(&mut self, wind: Option<WindConfig>) -> Result<(), String> {
        message(self.rollout_mut().env_mut().set_wind(wind))
    }

    fn new_obstacles(&mut self, seed: u64) -> Result<(), String> {
        message(self.rollout_mut().env_mut().new_obstacles(seed))
    }

    fn set_motor_gain(&mut self, drone: usize, motor: usize, gain: f64) -> Result<(), String> {
        message(self.rollout_mut().env_mut().set_motor_gain(drone, motor, gain))
    }

    fn set_controller(&mut self, kind: ControllerKind) -> Result<(), String> {
        self.set_kind(kind)
    }

    fn take(&mut self, drone: usize, mode: Option<PilotMode>) -> Result<(), String> {
        let drones = self.rollout().env().simulation().num_drones();
        if drone >= drones {
            return Err(format!("drone {drone} does not exist, expected one of {drones} drones"));
        }
        let action_type = self.rollout().env().action_type();
        let is_motors = matches!(action_type, ActionType::Rpm | ActionType::RawRpm | ActionType::Duty);
        if let Some(mode) = mode.filter(|mode| !is_motors && mode.action_type() != action_type) {
            return Err(format!("sticks for {mode} do not fit the action type {action_type} of this flight"));
        }
        let policy = self.rollout_mut().policy_mut();
        match mode {
            Some(mode) => policy.take(drone, mode),
            None => policy.release(drone),
        }
        Ok(())
    }

    fn set_sticks(&mut self, drone: usize, sticks: [f64; 4]) {
        self.rollout_mut().policy_mut().set_command(drone, sticks);
    }
}
