//! Points of the plans through the gates.

use super::{APPROACH, GateMotion, Race};
use crate::simulation::SimView;
use crate::tasks::waypoint_progress;

impl Race {
    /// Returns the points of the plan of a drone: the centres of its remaining gates, or two points on the axis of each
    /// gate that is solid. Moving gates are where they will be at the given times (s from now), one per gate.
    fn plan_points(&self, simulation: SimView<'_>, drone: usize, times: &[f64]) -> Vec<[f64; 3]> {
        let (count, passed) = (self.gates.len(), self.progress.passed(drone));
        let remaining = (passed..count * self.laps).map(|index| index % count);
        let centre = |(order, gate): (usize, usize)| {
            let placed = self.layout.get(gate).copied().unwrap_or_else(|| self.nominal(gate));
            let still = GateMotion { amplitude: 0.0, ..self.motion };
            match times.get(order) {
                Some(after) => placed.at(&self.motion, simulation.time() + after),
                None => placed.at(&still, 0.0),
            }
        };
        let centres = remaining.clone().enumerate().map(centre);
        if !self.solid {
            return centres.collect();
        }
        let on_axis = |(gate, [x, y, z]): (usize, [f64; 3])| {
            let normal = self.normal(gate);
            [-APPROACH, APPROACH].map(|along| [x + along * normal.x, y + along * normal.y, z])
        };
        remaining.zip(centres).flat_map(on_axis).collect()
    }

    /// Returns the points of the plan of a drone, for moving gates of a single drone at the times of the plan.
    pub(super) fn points_in_time(&self, simulation: SimView<'_>, drone: usize) -> Vec<[f64; 3]> {
        /// Number of corrections of the times of the plan.
        const CORRECTIONS: usize = 4;
        let mut points = self.plan_points(simulation, drone, &[]);
        if self.motion.amplitude == 0.0 || simulation.num_drones() > 1 {
            return points;
        }
        for _ in 0..CORRECTIONS {
            let Some((_, times)) = waypoint_progress::path_through(simulation, drone, &points) else { break };
            let per_gate = if self.solid { 2 } else { 1 };
            let means: Vec<_> =
                times.chunks(per_gate).map(|times| times.iter().sum::<f64>() / times.len() as f64).collect();
            points = self.plan_points(simulation, drone, &means);
        }
        points
    }
}
