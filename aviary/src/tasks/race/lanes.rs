//! Evaluation of the race in lanes, for gates without frames.

use flight::tasks::race;
use pulp::Simd;

use super::Race;
use crate::env::{LaneMask, LaneRows, LaneScene, LaneTask, TaskRows};
use crate::math::{Pack, Real};
use crate::simulation::SimView;
use crate::tasks::conditions::CrashWatch;
use crate::tasks::waypoint_progress::WaypointProgress;

impl Race {
    /// First row of the gate after the next and of the options.
    const OPTIONS: usize = CrashWatch::ROWS + WaypointProgress::ROWS;
}

/// The rows of a drone are those of [`CrashWatch`] and of [`WaypointProgress`], the gate after the next, the reward for
/// the speed and the penalty for the distance.
impl LaneTask for Race {
    const ROWS: usize = Self::OPTIONS + 5;
    const OBSERVES_ATTITUDE: bool = true;

    fn write_rows(&self, simulation: SimView<'_>, drone: usize, rows: &mut [f64]) {
        let (watch, own) = rows.split_at_mut(CrashWatch::ROWS);
        self.watch.write_rows(&self.crash, simulation, drone, watch);
        let (progress, options) = own.split_at_mut(WaypointProgress::ROWS);
        // the lanes know no frames: the scalar task evaluates every step after frames were turned on
        let radius = if self.has_frames() { f64::INFINITY } else { self.radius };
        self.progress.write_rows(drone, self.centres(), self.laps, radius, &self.gate(drone, 0), progress);
        let second = self.gate(drone, 1);
        options.copy_from_slice(&[second.x, second.y, second.z, self.speed_reward, self.distance_penalty]);
    }

    fn read_rows(&mut self, drone: usize, rows: &[f64]) {
        self.watch.read_rows(drone, &rows[..CrashWatch::ROWS]);
        self.progress.read_rows(drone, &rows[CrashWatch::ROWS..Self::OPTIONS]);
    }

    #[inline(always)]
    fn evaluate<S: Simd>(scene: &LaneScene<'_, S>, drone: usize, rows: &mut TaskRows<'_, S>) -> (Pack<S>, Pack<S>) {
        let (state, mut own) = (scene.state(drone), rows.drone(drone));
        let crashed = CrashWatch::update_rows(&state, &mut own);
        let (distance, flying, event) = WaypointProgress::evaluate_rows(state.position, &own, CrashWatch::ROWS);
        let (zero, weights) = (distance.all(0.0), [3, 4].map(|index| own.get(Self::OPTIONS + index)));
        let reward = race::reward(zero, weights, state.velocity, distance);
        (Real::choose(flying, reward, -zero), crashed.greater(event))
    }

    #[inline(always)]
    fn complete<S: Simd>(scene: &LaneScene<'_, S>, rows: &mut TaskRows<'_, S>, completed: LaneMask<S>) {
        WaypointProgress::complete_rows(scene, rows, CrashWatch::ROWS, completed);
    }

    #[inline(always)]
    fn observe_lanes<S: Simd>(
        scene: &LaneScene<'_, S>,
        drone: usize,
        rows: &mut TaskRows<'_, S>,
        out: &mut LaneRows<'_, S>,
    ) {
        let (state, own) = (scene.state(drone), rows.drone(drone));
        let (next, second) = (WaypointProgress::point_in_lanes(&own, CrashWatch::ROWS), own.get3(Self::OPTIONS));
        race::observe(&state, scene.rpy(drone), [next, second], out);
    }
}
