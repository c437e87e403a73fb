use std::cell::Cell;

use flight::tasks::waypoints::distance_to_leg;
use nalgebra::Vector3;
use pulp::Simd;

use crate::control::Reference;
use crate::control::trajectory::{Trajectory, Waypoints};
use crate::drone::{DroneParams, GRAVITY};
use crate::env::{EnvError, LaneMask, LaneRows, LaneScene, TaskRows, path_points};
use crate::math::{Pack, Real, ToFlight as _, V3};
use crate::simulation::SimView;

/// Progress of each drone along a list of points, over a number of laps.
#[derive(Debug, Clone, Default, serde::Serialize, serde::Deserialize)]
pub(super) struct WaypointProgress {
    /// Number of points that each drone has passed.
    passed: Vec<usize>,
    /// True for drones that passed a point in the last control step.
    fresh: Vec<bool>,
    /// True for drones that had a point left at the start of the last control step.
    flying: Vec<bool>,
    /// Distance of each drone from its next point at the end of the last control step, m.
    distance: Vec<f64>,
    /// Position of each drone before the last control step.
    #[serde(with = "crate::serial::vector_list")]
    before: Vec<Vector3<f64>>,
}

impl WaypointProgress {
    pub(super) fn reset(&mut self, simulation: SimView<'_>) {
        let count = simulation.num_drones();
        self.passed.clear();
        self.passed.resize(count, 0);
        self.fresh.clear();
        self.fresh.resize(count, false);
        self.flying.clear();
        self.flying.resize(count, true);
        self.distance.clear();
        self.distance.resize(count, 0.0);
        self.before.clear();
        self.before.extend(simulation.states().iter().map(|state| state.position));
    }

    /// Evaluates the last control step: a drone passes its next point if its path comes within `radius` of it.
    pub(super) fn update(&mut self, simulation: SimView<'_>, points: &[[f64; 3]], laps: usize, radius: f64) {
        let is_near = |point: usize, from: V3<f64>, to: V3<f64>| {
            distance_to_leg(from, to, Vector3::from(points[point]).to_flight()) <= radius
        };
        self.update_with(simulation, points, laps, is_near);
    }

    /// Evaluates the last control step. `passes` returns true for the index of a point and the positions before and
    /// after the step of a drone that has passed it.
    pub(super) fn update_with(
        &mut self,
        simulation: SimView<'_>,
        points: &[[f64; 3]],
        laps: usize,
        passes: impl Fn(usize, V3<f64>, V3<f64>) -> bool,
    ) {
        for (drone, state) in simulation.states().iter().enumerate() {
            self.fresh[drone] = false;
            self.flying[drone] = self.passed[drone] < points.len() * laps;
            if let Some(point) = next(points, self.passed[drone], laps) {
                self.distance[drone] = (state.position - point).norm();
                let [from, to] = [&self.before[drone], &state.position].map(|position| position.to_flight());
                if passes(self.passed[drone] % points.len(), from, to) {
                    self.passed[drone] += 1;
                    self.fresh[drone] = true;
                }
            }
            self.before[drone] = state.position;
        }
    }

    pub(super) fn passed(&self, drone: usize) -> usize {
        self.passed.get(drone).copied().unwrap_or(0)
    }

    /// Returns true if a drone had a point left in the last control step. Afterwards its only reward is the penalty
    /// for a crash.
    pub(super) fn was_flying(&self, drone: usize) -> bool {
        self.flying[drone]
    }

    pub(super) fn just_passed(&self, drone: usize) -> bool {
        self.fresh[drone]
    }

    pub(super) fn distance(&self, drone: usize) -> f64 {
        self.distance[drone]
    }

    /// Number of rows of a drone in lanes.
    pub(super) const ROWS: usize = 8;

    /// Writes the rows of a drone: its position before the last control step, the observed point, the distance
    /// within which the scalar task must evaluate a step, and 1 if the drone has a point left.
    pub(super) fn write_rows(
        &self,
        drone: usize,
        points: &[[f64; 3]],
        laps: usize,
        radius: f64,
        observed: &Vector3<f64>,
        rows: &mut [f64],
    ) {
        let (passed, total) = (self.passed(drone), points.len() * laps);
        let before = &self.before[drone];
        let limit = if self.passed.iter().all(|&passed| passed == total) {
            // the episode ends in the next step
            f64::INFINITY
        } else if passed < total {
            radius
        } else {
            f64::NEG_INFINITY
        };
        rows[..3].copy_from_slice(before.as_slice());
        rows[3..6].copy_from_slice(observed.as_slice());
        rows[6..].copy_from_slice(&[limit, f64::from(u8::from(passed < total))]);
    }

    /// Reads the state of a drone from its rows, after a step in which it passed no point.
    pub(super) fn read_rows(&mut self, drone: usize, rows: &[f64]) {
        let [before, point] = [&rows[..3], &rows[3..6]].map(Vector3::from_column_slice);
        (self.before[drone], self.fresh[drone], self.flying[drone]) = (before, false, rows[7] > 0.0);
        if self.flying[drone] {
            self.distance[drone] = (before - point).norm();
        }
    }

    /// Returns the point that a drone observes.
    #[inline(always)]
    pub(super) fn point_in_lanes<S: Simd>(own: &LaneRows<'_, S>, first_row: usize) -> V3<Pack<S>> {
        own.get3(first_row + 3)
    }

    /// Returns the distance of a drone from its next point, a mask of the drones that have a next point, and 1 where a
    /// drone may have passed it or the episode may have ended, 0 elsewhere.
    #[inline(always)]
    pub(super) fn evaluate_rows<S: Simd>(
        position: V3<Pack<S>>,
        own: &LaneRows<'_, S>,
        first_row: usize,
    ) -> (Pack<S>, LaneMask<S>, Pack<S>) {
        let (before, point) = (own.get3(first_row), Self::point_in_lanes(own, first_row));
        let (limit, left) = (own.get(first_row + 6), own.get(first_row + 7));
        let (zero, one) = (limit.all(0.0), limit.all(1.0));
        let clear = limit.less(distance_to_leg(before, position, point));
        ((position - point).norm(), zero.less(left), Real::choose(clear, zero, one))
    }

    /// Updates the rows of all drones after a control step in which they passed no point.
    #[inline(always)]
    pub(super) fn complete_rows<S: Simd>(
        scene: &LaneScene<'_, S>,
        rows: &mut TaskRows<'_, S>,
        first_row: usize,
        completed: LaneMask<S>,
    ) {
        for drone in 0..scene.num_drones() {
            let (position, mut own) = (scene.position(drone), rows.drone(drone));
            let before = own.get3(first_row);
            own.put(first_row, Real::choose(completed, position.x, before.x));
            own.put(first_row + 1, Real::choose(completed, position.y, before.y));
            own.put(first_row + 2, Real::choose(completed, position.z, before.z));
        }
    }

    /// Plans a smooth path for each drone from its present position through its remaining points, at the speed
    /// limits of its airframe; `None` if no points remain. In a swarm, each drone starts when its path stays clear
    /// of the drones before it, and parks clear of the others at the end.
    pub(super) fn plans(
        &self,
        simulation: SimView<'_>,
        points: &[[f64; 3]],
        laps: usize,
    ) -> Vec<Option<Box<dyn Trajectory>>> {
        self.plans_through(simulation, |drone| self.remaining(drone, points, laps))
    }

    /// Plans a path for each drone as [`plans`](Self::plans) does, through the points that a function returns for it.
    pub(super) fn plans_through(
        &self,
        simulation: SimView<'_>,
        points: impl Fn(usize) -> Vec<[f64; 3]>,
    ) -> Vec<Option<Box<dyn Trajectory>>> {
        let drones = 0..simulation.num_drones();
        let paths = drones.map(|drone| path_through(simulation, drone, &points(drone)).map(|(path, _)| path));
        if simulation.num_drones() == 1 {
            return paths.map(|path| path.map(|path| Box::new(path) as Box<dyn Trajectory>)).collect();
        }
        let mut before: Vec<Scheduled> = Vec::new();
        let mut delay = 0.0;
        let mut plans: Vec<Option<Box<dyn Trajectory>>> = Vec::new();
        for (drone, path) in paths.enumerate() {
            plans.push(path.map(|path| {
                let scheduled = Scheduled::new(&path, simulation.params(drone).collision_radius);
                delay = scheduled.earliest_after(delay, &before);
                before.push(Scheduled { delay, ..scheduled });
                Box::new(Delayed { delay, path }) as Box<dyn Trajectory>
            }));
        }
        plans
    }

    /// Returns the points that a drone has not passed, in their order over all laps.
    fn remaining(&self, drone: usize, points: &[[f64; 3]], laps: usize) -> Vec<[f64; 3]> {
        (self.passed(drone)..points.len() * laps).map(|index| points[index % points.len()]).collect()
    }

    /// Returns points (world frame, m) along a drone's path.
    pub(super) fn extent(
        &self,
        simulation: SimView<'_>,
        drone: usize,
        points: &[[f64; 3]],
        laps: usize,
    ) -> Vec<Vector3<f64>> {
        let path = path_through(simulation, drone, &self.remaining(drone, points, laps));
        let planned =
            path.iter().flat_map(|(path, _)| path_points(path.duration(), |time| path.reference(time).position));
        next(points, self.passed(drone), laps).into_iter().chain(planned).collect()
    }
}

/// Plans the path of a drone from its present position through points, without a delay, with the time of each point, s;
/// `None` without points.
pub(super) fn path_through(
    simulation: SimView<'_>,
    drone: usize,
    points: &[[f64; 3]],
) -> Option<(Waypoints, Vec<f64>)> {
    if points.is_empty() {
        return None;
    }
    let (yaw, (speed, acceleration)) = (simulation.states()[drone].yaw(), limits(simulation.params(drone)));
    let start = simulation.states()[drone].position.into();
    let mut through: Vec<[f64; 3]> =
        [start].into_iter().chain(points.iter().copied()).chain(parking_place(simulation, drone)).collect();
    // true for the points of the caller
    let mut given: Vec<bool> = (0..through.len()).map(|index| (1..=points.len()).contains(&index)).collect();
    let floor = through.iter().map(|point| point[2]).fold(f64::INFINITY, f64::min) - MAX_UNDERSHOOT;
    let build = |through: &[[f64; 3]]| {
        Waypoints::through(through).yaws(vec![yaw; through.len()]).limits(speed, acceleration).build().ok()
    };
    let mut path = build(&through)?;
    // a long leg after a short one overshoots, even into the floor; a waypoint at its midpoint prevents this
    for _ in 0..MAX_MIDPOINTS {
        let (leg, height) = path.lowest();
        if height >= floor {
            break;
        }
        let (a, b) = (through[leg], through[leg + 1]);
        let mut more = through.clone();
        more.insert(leg + 1, std::array::from_fn(|axis| f64::midpoint(a[axis], b[axis])));
        match build(&more) {
            Some(better) => path = better,
            None => break,
        }
        given.insert(leg + 1, false);
        through = more;
    }
    let times = path.times().iter().zip(&given).filter_map(|(&time, &given)| given.then_some(time)).collect();
    Some((path, times))
}

/// Returns the final position of a drone in a swarm, world frame, m: behind the start, away from the points of this
/// crate's tasks. The first drone parks farthest away, so that no drone passes another.
fn parking_place(simulation: SimView<'_>, drone: usize) -> Option<[f64; 3]> {
    let count = simulation.num_drones();
    let spacing = (0..count).map(|drone| 3.0 * simulation.params(drone).collision_radius).fold(0.7, f64::max);
    (count > 1).then_some([-1.0, -0.8 - spacing * (count - drone) as f64, 1.0])
}

/// Maximum depth of a path below its lowest waypoint, m.
const MAX_UNDERSHOOT: f64 = 0.05;

/// Maximum number of midpoints that are added to a path.
const MAX_MIDPOINTS: usize = 8;

/// A path with its start time.
#[derive(Debug)]
struct Scheduled {
    /// Positions along the path, every [`TICK`](Self::TICK) seconds; empty for a path of more than
    /// [`MAX_TICKS`](Self::MAX_TICKS).
    places: Vec<Vector3<f64>>,
    /// Number of positions along the path.
    ticks: usize,
    /// Collision radius of the drone, m.
    radius: f64,
    /// Start time, s.
    delay: f64,
}

impl Scheduled {
    /// Time between two positions, s.
    const TICK: f64 = 0.05;

    /// Clearance between two drones on their paths, m, for tracking errors and the distance flown in a tick.
    const ROOM: f64 = 0.3;

    /// Largest number of positions of a path that is compared with others: half an hour. No other drone flies during a
    /// longer path.
    const MAX_TICKS: usize = 36_000;

    fn new(path: &Waypoints, radius: f64) -> Self {
        let ticks = (path.duration() / Self::TICK).ceil() as usize + 1;
        let compared = if ticks <= Self::MAX_TICKS { ticks } else { 0 };
        let places = (0..compared).map(|tick| path.reference(tick as f64 * Self::TICK).position).collect();
        Self { places, ticks, radius, delay: 0.0 }
    }

    /// Returns the position at a tick, if the path starts after `delay` ticks. The drone waits at its start and
    /// stays at its end.
    fn place(&self, delay: usize, tick: usize) -> &Vector3<f64> {
        &self.places[tick.saturating_sub(delay).min(self.places.len() - 1)]
    }

    fn ticks(seconds: f64) -> usize {
        (seconds / Self::TICK).round() as usize
    }

    /// Returns the first start time (s) from `delay` on at which the path stays clear of the earlier ones, none of
    /// which starts after `delay`. If there is none, or if long paths make the search long, returns a time when all of
    /// those have ended.
    fn earliest_after(&self, delay: f64, before: &[Self]) -> f64 {
        const STRIDE: usize = 2;
        /// Number of compared positions after which the search ends.
        const MAX_COMPARED: usize = 1 << 26;
        let end = |other: &Self| Self::ticks(other.delay) + other.ticks;
        let last = before.iter().map(end).max().unwrap_or(0);
        let first = Self::ticks(delay);
        if self.places.is_empty() || before.iter().any(|other| other.places.is_empty()) {
            return first.max(last) as f64 * Self::TICK;
        }
        let compared = Cell::new(0);
        let clear = |delay: usize| {
            before.iter().rev().all(|other| {
                let (min, others) = (self.radius + other.radius + Self::ROOM, Self::ticks(other.delay));
                // the other drone starts first; outside of these ticks, both stand still
                let (its, own) = (others..=end(other), delay.max(end(other) + 1)..=delay + self.ticks);
                its.chain(own).all(|tick| {
                    compared.set(compared.get() + 1);
                    (self.place(delay, tick) - other.place(others, tick)).norm_squared() > min * min
                })
            })
        };
        let mut delays = (first..last).step_by(STRIDE).take_while(|_| compared.get() < MAX_COMPARED);
        let found = delays.find(|&delay| clear(delay));
        found.unwrap_or(first.max(last)) as f64 * Self::TICK
    }
}

/// A path with a delayed start.
#[derive(Debug)]
struct Delayed {
    path: Waypoints,
    delay: f64,
}

impl Trajectory for Delayed {
    fn reference(&self, time: f64) -> Reference {
        self.path.reference(time - self.delay)
    }

    fn duration(&self) -> f64 {
        self.path.duration() + self.delay
    }
}

/// Returns the next point after `passed` points, if there is one.
pub(super) fn next(points: &[[f64; 3]], passed: usize, laps: usize) -> Option<Vector3<f64>> {
    (passed < points.len() * laps).then(|| points[passed % points.len()].into())
}

/// Returns a speed (m/s) and an acceleration (m/s²) that leave the controller a margin.
fn limits(params: &DroneParams) -> (f64, f64) {
    let spare = (params.thrust_to_weight - 1.0).clamp(0.1, 3.0);
    ((0.25 * params.max_speed).clamp(0.3, 4.0), 0.4 * GRAVITY * spare)
}

/// Validates the points, the number of laps and the radius; `option` names the option that lists the points.
pub(super) fn validate(option: &'static str, points: &[[f64; 3]], laps: usize, radius: f64) -> Result<(), EnvError> {
    let wrong = |option, got: String, expected| Err(EnvError::Option { option, got, expected });
    if laps == 0 {
        return wrong("laps", "0".into(), "at least 1");
    }
    // limit of a plan, which also has the start and a parking place
    if !(1..=198).contains(&points.len().saturating_mul(laps)) {
        let got = crate::count(points.len().saturating_mul(laps), "point");
        return wrong(option, got, "1 to 198 over all laps");
    }
    if let Some(x) = points.iter().flatten().find(|x| !(-1e4..=1e4).contains(*x)) {
        return wrong(option, format!("{} m along an axis", crate::number(*x)), "finite coordinates up to 10 km");
    }
    if !(radius > 0.0 && radius <= 1e3) {
        return wrong("radius", format!("{} m", crate::number(radius)), "a positive number of metres");
    }
    Ok(())
}

/// Validates the rewards and penalties.
pub(super) fn validate_rewards<const N: usize>(rewards: [(&'static str, f64); N]) -> Result<(), EnvError> {
    match rewards.into_iter().find(|(_, got)| !got.is_finite()) {
        Some((option, got)) => Err(EnvError::Option { option, got: crate::number(got), expected: "a finite number" }),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Paths of hours are not compared at every tick: each drone starts when the one before has ended.
    #[test]
    fn long_paths_follow_each_other() {
        use crate::env::{DroneEnv as _, Env as _, EnvConfig};

        let gates = (0..198).map(|gate| [if gate % 2 == 0 { -1e4 } else { 1e4 }, 0.0, 1.0]).collect();
        let config = EnvConfig::default().num_drones(3).task(|options| {
            (options.gates, options.laps) = (Some(gates), Some(1));
        });
        let mut env = crate::tasks::make("race", config).unwrap();
        env.reset(Some(1)).unwrap();
        let ends: Vec<_> = env.plans().into_iter().flatten().map(|plan| plan.duration()).collect();
        assert!(ends.len() == 3 && ends[0] > 1e5, "{ends:?}");
        assert!(ends.windows(2).all(|pair| pair[1] > pair[0] + 1e5), "{ends:?}");
    }

    /// Drones of every airframe stay apart on their planned paths, and every path ends.
    #[test]
    fn planned_paths_stay_clear_of_each_other() {
        use crate::drone::DroneModel;
        use crate::env::{DroneEnv as _, Env as _, EnvConfig};

        for (name, count) in [("race", 10), ("fly_through", 7), ("race", 2)] {
            for model in [DroneModel::Cf2x, DroneModel::Race] {
                let config = EnvConfig::default().drone(model).num_drones(count);
                let mut env = crate::tasks::make(name, config).unwrap();
                env.reset(Some(1)).unwrap();
                let plans: Vec<_> = env.plans().into_iter().flatten().collect();
                assert_eq!(plans.len(), count);
                let end = plans.iter().map(|leg| leg.duration()).fold(0.0, f64::max);
                assert!(end < 60.0, "{name} with {count} {model}: {end} s");
                let min = 2.0 * model.params().collision_radius + 0.2;
                for tick in 0..(end / 0.02) as u32 {
                    let places: Vec<_> =
                        plans.iter().map(|leg| leg.reference(f64::from(tick) * 0.02).position).collect();
                    for (i, a) in places.iter().enumerate() {
                        for b in &places[..i] {
                            assert!((a - b).norm() > min, "{name} with {count} {model}: {} m", (a - b).norm());
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn a_point_between_two_steps_is_passed() {
        let [a, b] = [V3::new(-1.0, 0.1, 0.0), V3::new(1.0, 0.1, 0.0)];
        assert!((distance_to_leg(a, b, V3::new(0.0, 0.0, 0.0)) - 0.1_f64).abs() < 1e-12);
        assert!((distance_to_leg(a, b, V3::new(2.0, 0.1, 0.0)) - 1.0_f64).abs() < 1e-12);
        assert!((distance_to_leg(a, a, V3::new(-1.0, 0.0, 0.0)) - 0.1_f64).abs() < 1e-12);
    }
}
