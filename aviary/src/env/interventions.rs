//! Changes of the obstacles of a running episode.

use rand::SeedableRng as _;

use super::{Aviary, EnvError, EnvParts, Rng, Task};
use crate::engine::BuildError;
use crate::simulation::SimulationError;
use crate::world::placement::CollisionCylinder;
use crate::world::{Obstacle, ObstacleConfig, ObstacleKind};

impl<T: Task> Aviary<T> {
    /// Replaces the obstacles that are not moving markers.
    pub(super) fn replace_obstacles(&mut self, obstacles: &[Obstacle]) -> Result<(), EnvError> {
        let (simulation, first_moving) = (&mut self.simulation, self.workspace.moving.first_obstacle());
        let (old, moving) = simulation.obstacles().split_at(first_moving);
        let changed = obstacles.iter().enumerate().filter(|(index, new)| old.get(*index) != Some(new));
        for (index, obstacle) in changed {
            let valid = obstacle.validate(&format!("obstacle {index}"));
            valid.map_err(|error| SimulationError::from(BuildError::from(error)))?;
            for (drone, state) in simulation.states().iter().enumerate() {
                // collision cylinders always keep the size that the scene was built with
                let cylinder = CollisionCylinder::from(&simulation.world().drones[drone].params);
                if !cylinder.has_room(&state.position, std::iter::empty(), std::slice::from_ref(obstacle)) {
                    let distance = obstacle.distance(&state.position);
                    return Err(EnvError::Option {
                        option: "obstacles",
                        got: format!("obstacle {index} at {distance:.3} m from the centre of drone {drone}"),
                        expected: "obstacles that do not overlap a drone",
                    });
                }
            }
        }
        let all: Vec<_> = obstacles.iter().chain(moving).copied().collect();
        Ok(simulation.set_obstacles(&all)?)
    }

    /// Generates the layout of a seed around the present positions of the drones.
    pub(super) fn generate_obstacles(&self, seed: u64) -> Result<Vec<Obstacle>, EnvError> {
        let refused = |got: &str| {
            let expected = "a generator of random obstacles in the options of the environment";
            Err(EnvError::Option { option: "obstacle_generator", got: got.into(), expected })
        };
        let generator = match &self.model.obstacle_generator {
            None => return refused("none"),
            Some(generator) if generator.kind == ObstacleKind::Custom => return refused("a custom list"),
            Some(generator) => generator,
        };
        let drones = &self.simulation.world().drones;
        let radii = drones.iter().map(|drone| CollisionCylinder::from(&drone.params).bounding_radius());
        // larger than the bounding spheres by the margin of an obstacle that touches one
        let safe_zone = radii.fold(generator.safe_zone, |zone, radius| zone.max(radius + 1e-6));
        let generator = ObstacleConfig { safe_zone, ..generator.clone() };
        let positions: Vec<_> = self.simulation.states().iter().map(|state| state.position.into()).collect();
        Ok(generator.generate(&positions, &mut Rng::seed_from_u64(seed))?)
    }
}

impl<T: Task> EnvParts<'_, T> {
    /// Restores the obstacles of the model if they were replaced during the last episode.
    pub(super) fn restore_obstacles(&mut self) -> Result<(), EnvError> {
        let Self { sim_model, data, workspace, .. } = self;
        if data.obstacle_revision() == 0 {
            return Ok(());
        }
        let (first_moving, original) = (workspace.moving.first_obstacle(), &sim_model.world().obstacles);
        let present = data.obstacles(sim_model);
        if present[..first_moving] == original[..first_moving] {
            return Ok(());
        }
        let all: Vec<_> = original[..first_moving].iter().chain(&present[first_moving..]).copied().collect();
        Ok(data.set_obstacles(sim_model, &all)?)
    }
}
