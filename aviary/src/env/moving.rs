use super::{EnvError, Task};
use crate::simulation::{SimData, SimModel, SimView};
use crate::world::{MarkerPose, MovingMarker, Obstacle, World};

/// Moving markers of a task. Solid ones are the last obstacles of the scene, the others its last markers.
#[derive(Debug, Default)]
pub(crate) struct MovingMarkers {
    declared: Vec<MovingMarker>,
    /// Index of the first solid marker among the obstacles.
    first_obstacle: usize,
    /// Index of the first non-solid marker among the markers.
    first_marker: usize,
    poses: Vec<MarkerPose>,
    /// Obstacles with the solid markers in their new poses.
    obstacles: Vec<Obstacle>,
}

impl MovingMarkers {
    /// Finds the moving markers in a world that was built with them.
    pub(super) fn new(declared: Vec<MovingMarker>, world: &World) -> Self {
        let solid = declared.iter().filter(|marker| marker.solid).count();
        Self {
            first_obstacle: world.obstacles.len() - solid,
            first_marker: world.markers.len().saturating_sub(declared.len() - solid),
            poses: Vec::with_capacity(declared.len()),
            obstacles: Vec::with_capacity(world.obstacles.len()),
            declared,
        }
    }

    /// Returns the number of obstacles that are not moving markers.
    pub(super) fn first_obstacle(&self) -> usize {
        self.first_obstacle
    }

    /// Returns true if the task has no moving markers.
    pub(crate) fn is_empty(&self) -> bool {
        self.declared.is_empty()
    }

    /// Returns true if a marker moves during an episode.
    pub(crate) fn moves(&self) -> bool {
        self.declared.iter().any(|marker| !marker.stands_still)
    }

    /// Returns true if a marker with which drones collide moves during an episode.
    pub(crate) fn moves_solid(&self) -> bool {
        self.declared.iter().any(|marker| marker.solid && !marker.stands_still)
    }

    /// Moves the markers to the poses that the task computes, or, without a task, to their initial poses. `starts` is
    /// true at the start of an episode.
    pub(super) fn place<T: Task>(
        &mut self,
        task: Option<&T>,
        starts: bool,
        model: &SimModel,
        data: &mut SimData,
    ) -> Result<(), EnvError> {
        let start =
            |marker: &MovingMarker| MarkerPose { position: marker.marker.body.position, rpy: marker.marker.body.rpy };
        self.poses.clear();
        self.poses.extend(self.declared.iter().map(start));
        if let Some(task) = task {
            task.move_markers(SimView::new(model, data), &mut self.poses);
        }
        self.obstacles.clear();
        self.obstacles.extend_from_slice(data.obstacles(model));
        let (mut obstacle, mut marker) = (self.first_obstacle, self.first_marker);
        for (declared, pose) in self.declared.iter().zip(&self.poses) {
            // a marker that stands still keeps its pose, whatever the task computes
            let keeps = declared.stands_still && !starts;
            let far = |x: &f64| x.is_nan() || x.abs() > 1e6;
            if let Some(x) = pose.position.iter().chain(&pose.rpy).find(|x| far(x)) {
                let got = format!("{} for the marker `{}`", crate::number(*x), declared.marker.name);
                let expected = "finite numbers up to 1e6";
                return Err(EnvError::Option { option: "move_markers", got, expected });
            }
            if declared.solid {
                if !keeps {
                    let body = &mut self.obstacles[obstacle];
                    (body.position, body.rpy) = (pose.position, pose.rpy);
                }
                obstacle += 1;
            } else {
                if !keeps {
                    data.set_marker_pose(marker, *pose);
                }
                marker += 1;
            }
        }
        match starts {
            true => data.place_obstacles(model, &self.obstacles)?,
            false => data.move_obstacles(model, &self.obstacles)?,
        }
        Ok(())
    }
}
