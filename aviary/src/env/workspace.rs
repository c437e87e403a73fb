//! Constants that environments share, and the scratch memory of one thread.

use nalgebra::Vector3;

use super::moving::MovingMarkers;
use super::{BoxSpace, ObservationSpace};
use crate::action::{ActionDecoder, ActionType};
use crate::observation::Observation;
use crate::sensing::Rangefinder;
use crate::simulation::{SimData, SimModel};
use crate::state::DroneState;
use crate::vision::SceneRenderer;
use crate::world::{Obstacle, ObstacleConfig};

/// Constants that all environments of a batch share, in addition to the [`SimModel`].
#[derive(Debug)]
pub(crate) struct EnvModel {
    pub action_type: ActionType,
    pub action_space: BoxSpace,
    pub observation_space: ObservationSpace,
    /// Bounds of the rows that [`EnvWorkspace::write_row`] writes.
    pub row_space: BoxSpace,
    pub episode_steps: u64,
    /// Generator of random obstacles.
    pub obstacle_generator: Option<ObstacleConfig>,
    /// Obstacles of the generator when the scene was compiled.
    pub first_layout: Vec<Obstacle>,
    /// Number of entries in one drone's block of the observation.
    pub block: usize,
    pub neighbourhood_radius: f64,
}

impl EnvModel {
    /// Returns true if every episode has a new layout of obstacles.
    pub(crate) fn moves_obstacles(&self) -> bool {
        self.obstacle_generator.as_ref().is_some_and(|generator| generator.new_layout)
    }
}

/// Scratch memory of one thread, in addition to the simulation's.
#[derive(Debug)]
pub(crate) struct EnvWorkspace {
    /// Moving markers of the task.
    pub moving: MovingMarkers,
    pub rangefinder: Option<Synced<Rangefinder>>,
    /// Renderer of the onboard cameras, if images are observed.
    pub cameras: Option<Synced<SceneRenderer>>,
    /// The last observation.
    pub observation: Observation,
    /// The action, clipped to its bounds.
    pub clipped: Vec<f64>,
    /// Commanded motor speeds, rpm.
    pub commands: Vec<[f64; 4]>,
    /// Initial states of an episode.
    pub starts: Vec<DroneState>,
    pub measured: Measured,
}

/// Measured states of all drones, with their roll, pitch and yaw (rad).
#[derive(Debug, Default)]
pub(crate) struct Measured {
    pub states: Vec<DroneState>,
    pub rpys: Vec<Vector3<f64>>,
}

/// A value with its own copy of the obstacles, and the revision of that copy.
#[derive(Debug)]
pub(crate) struct Synced<V> {
    pub value: V,
    revision: u64,
}

impl<V> Synced<V> {
    /// Wraps a value that was created from the scene of the model.
    pub(crate) fn new(value: V) -> Self {
        Self { value, revision: 0 }
    }

    /// Returns the value, after `set` has updated its obstacles if their revision differs.
    pub(crate) fn sync<E>(
        &mut self,
        model: &SimModel,
        data: &SimData,
        set: impl FnOnce(&mut V, &[Obstacle]) -> Result<(), E>,
    ) -> Result<&mut V, E> {
        if self.revision != data.obstacle_revision() {
            set(&mut self.value, data.obstacles(model))?;
            self.revision = data.obstacle_revision();
        }
        Ok(&mut self.value)
    }
}

impl EnvWorkspace {
    /// Clips an action to its bounds and decodes it into `commands`.
    pub(crate) fn decode(
        &mut self,
        model: &EnvModel,
        control_period: f64,
        data: &SimData,
        decoders: &mut [ActionDecoder],
        action: impl Iterator<Item = f64>,
    ) {
        let bounds = model.action_space.low().iter().zip(model.action_space.high());
        for ((clipped, x), (&low, &high)) in self.clipped.iter_mut().zip(action).zip(bounds) {
            *clipped = x.clamp(low, high);
        }
        let drones = decoders.iter_mut().zip(data.states()).enumerate();
        let parts = self.clipped.chunks_exact(model.action_type.size());
        for ((command, (drone, (decoder, state))), part) in self.commands.iter_mut().zip(drones).zip(parts) {
            *command = match data.battery(drone) {
                Some((_, battery)) => decoder.motor_speeds_at(battery.voltage, control_period, state, part),
                None => decoder.motor_speeds(control_period, state, part),
            };
        }
    }

    /// Writes the observation without images into a row in single precision, rounded to stay within its bounds.
    pub(crate) fn write_row(&self, model: &EnvModel, row: &mut [f32]) {
        let Observation { vector, obstacle, ranges, adjacency, .. } = &self.observation;
        let (first, rest) = row.split_at_mut(vector.len());
        first.iter_mut().zip(vector).for_each(|(out, &x)| *out = x as f32);
        if !rest.is_empty() {
            let others = obstacle.iter().chain(ranges).map(|&x| x as f32);
            let others = others.chain(adjacency.iter().map(|&near| f32::from(u8::from(near))));
            rest.iter_mut().zip(others).for_each(|(out, x)| *out = x);
        }
        model.row_space.round_inside(row);
    }
}
