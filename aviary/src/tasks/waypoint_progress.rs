use nalgebra::Vector3;

use crate::control::Reference;
use crate::control::trajectory::{Trajectory, Waypoints};
use crate::drone::{DroneParams, GRAVITY};
use crate::env::{EnvError, path_points};
use crate::simulation::SimView;

/// Points to be passed one after the other, so many times over, and how far each drone has come.
#[derive(Debug, Clone, Default, serde::Serialize, serde::Deserialize)]
pub(super) struct WaypointProgress {
    /// Points passed by each drone.
    passed: Vec<usize>,
    /// Whether each drone passed one in the last control step.
    fresh: Vec<bool>,
    /// Whether each drone had one to pass in the last control step.
    flying: Vec<bool>,
    /// Distance of each drone from the point that it was to pass in the last control step, m.
    distance: Vec<f64>,
    /// Where each drone was before it.
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

    /// Looks at the last control step: a point is passed where the way of the drone comes within `radius` of it.
    pub(super) fn update(&mut self, simulation: SimView<'_>, points: &[[f64; 3]], laps: usize, radius: f64) {
        for (drone, state) in simulation.states().iter().enumerate() {
            self.fresh[drone] = false;
            self.flying[drone] = self.passed[drone] < points.len() * laps;
            if let Some(point) = next(points, self.passed[drone], laps) {
                self.distance[drone] = (state.position - point).norm();
                if distance_to_leg(&self.before[drone], &state.position, &point) <= radius {
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

    /// Whether a drone was still on its course in the last control step: nobody is paid afterwards.
    pub(super) fn was_flying(&self, drone: usize) -> bool {
        self.flying[drone]
    }

    pub(super) fn just_passed(&self, drone: usize) -> bool {
        self.fresh[drone]
    }

    pub(super) fn distance(&self, drone: usize) -> f64 {
        self.distance[drone]
    }

    /// Plans the smoothest path of every drone from where it is through all points that are left, as fast as its airframe may; `None`
    /// for a drone that has passed all. Of several drones each starts as soon as it stays clear of those before it, and goes out of
    /// the others' way at its end.
    pub(super) fn plans(
        &self,
        simulation: SimView<'_>,
        points: &[[f64; 3]],
        laps: usize,
    ) -> Vec<Option<Box<dyn Trajectory>>> {
        let drones = 0..simulation.num_drones();
        let paths = drones.map(|drone| self.path(simulation, drone, points, laps));
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

    /// The path of a drone through the points that are left, without waiting for others.
    fn path(&self, simulation: SimView<'_>, drone: usize, points: &[[f64; 3]], laps: usize) -> Option<Waypoints> {
        let left = (self.passed(drone)..points.len() * laps).map(|index| points[index % points.len()]);
        let left: Vec<_> = left.collect();
        if left.is_empty() {
            return None;
        }
        let (yaw, (speed, acceleration)) = (simulation.states()[drone].yaw(), limits(simulation.params(drone)));
        let start = simulation.states()[drone].position.into();
        let mut through: Vec<[f64; 3]> = [start].into_iter().chain(left).chain(aside(simulation, drone)).collect();
        let floor = through.iter().map(|point| point[2]).fold(f64::INFINITY, f64::min) - SWING;
        let build = |through: &[[f64; 3]]| {
            Waypoints::through(through).yaws(vec![yaw; through.len()]).limits(speed, acceleration).build().ok()
        };
        let mut path = build(&through)?;
        // a long leg after a short one swings out, down to the floor, too: its middle holds it
        for _ in 0..MAX_MIDDLES {
            let (leg, height) = path.lowest();
            if height >= floor {
                break;
            }
            let (a, b) = (through[leg], through[leg + 1]);
            through.insert(leg + 1, std::array::from_fn(|axis| f64::midpoint(a[axis], b[axis])));
            match build(&through) {
                Some(better) => path = better,
                None => break,
            }
        }
        Some(path)
    }

    /// Returns points (world frame, m) along a drone's path.
    pub(super) fn extent(
        &self,
        simulation: SimView<'_>,
        drone: usize,
        points: &[[f64; 3]],
        laps: usize,
    ) -> Vec<Vector3<f64>> {
        let path = self.path(simulation, drone, points, laps);
        let planned = path.iter().flat_map(|path| path_points(path.duration(), |time| path.reference(time).position));
        next(points, self.passed(drone), laps).into_iter().chain(planned).collect()
    }
}

/// Where a drone of several goes at its end, world frame, m: behind the start, where no course of this crate goes. The first drone
/// goes the farthest, so that none comes by another.
fn aside(simulation: SimView<'_>, drone: usize) -> Option<[f64; 3]> {
    let count = simulation.num_drones();
    let spacing = (0..count).map(|drone| 3.0 * simulation.params(drone).collision_radius).fold(0.7, f64::max);
    (count > 1).then_some([-1.0, -0.8 - spacing * (count - drone) as f64, 1.0])
}

/// How far a path may swing below the lowest point that it is to pass, m.
const SWING: f64 = 0.05;

/// Most points that are added to a path to keep it from swinging too low.
const MAX_MIDDLES: usize = 8;

/// A way with the moment at which it begins.
#[derive(Debug)]
struct Scheduled {
    /// Places along it, every [`TICK`](Self::TICK) seconds.
    places: Vec<Vector3<f64>>,
    /// Collision radius of the drone that flies it, m.
    radius: f64,
    /// s.
    delay: f64,
}

impl Scheduled {
    /// Time from place to place, s.
    const TICK: f64 = 0.05;

    /// Room between two drones on their paths, m: for errors of controllers, and for the distance flown in a tick.
    const ROOM: f64 = 0.3;

    fn new(path: &Waypoints, radius: f64) -> Self {
        let ticks = (path.duration() / Self::TICK).ceil() as u32;
        let places = (0..=ticks).map(|tick| path.reference(f64::from(tick) * Self::TICK).position).collect();
        Self { places, radius, delay: 0.0 }
    }

    /// Where it is so many ticks after the beginning of the plan: at its start before it begins, and at its end once it is over.
    fn place(&self, delay: usize, tick: usize) -> &Vector3<f64> {
        &self.places[tick.saturating_sub(delay).min(self.places.len() - 1)]
    }

    fn ticks(seconds: f64) -> usize {
        (seconds / Self::TICK).round() as usize
    }

    /// The first delay (s) from this one on with which it stays clear of the paths before it; if there is none, one with which all of
    /// those are over.
    fn earliest_after(&self, delay: f64, before: &[Self]) -> f64 {
        const STRIDE: usize = 2;
        let end = |other: &Self| Self::ticks(other.delay) + other.places.len();
        let last = before.iter().map(end).max().unwrap_or(0);
        let first = Self::ticks(delay);
        let clear = |delay: usize| {
            before.iter().rev().all(|other| {
                let (min, others) = (self.radius + other.radius + Self::ROOM, Self::ticks(other.delay));
                // before and after that both stand still
                (others.min(delay)..=end(other).max(delay + self.places.len()))
                    .all(|tick| (self.place(delay, tick) - other.place(others, tick)).norm_squared() > min * min)
            })
        };
        let found = (first..last).step_by(STRIDE).find(|&delay| clear(delay));
        found.unwrap_or(first.max(last)) as f64 * Self::TICK
    }
}

/// A path that begins later.
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

/// The point after so many, where there is one.
pub(super) fn next(points: &[[f64; 3]], passed: usize, laps: usize) -> Option<Vector3<f64>> {
    (passed < points.len() * laps).then(|| points[passed % points.len()].into())
}

/// A speed and an acceleration that leave an airframe something to correct with.
fn limits(params: &DroneParams) -> (f64, f64) {
    let spare = (params.thrust_to_weight - 1.0).clamp(0.1, 3.0);
    ((0.25 * params.max_speed).clamp(0.3, 4.0), 0.4 * GRAVITY * spare)
}

/// Distance of a point from the line segment between two others.
fn distance_to_leg(from: &Vector3<f64>, to: &Vector3<f64>, point: &Vector3<f64>) -> f64 {
    let leg = to - from;
    let length = leg.norm_squared();
    let share = if length > 0.0 { ((point - from).dot(&leg) / length).clamp(0.0, 1.0) } else { 0.0 };
    (from + leg * share - point).norm()
}

/// Checks points, the option that lists them, laps and a radius.
pub(super) fn validate(option: &'static str, points: &[[f64; 3]], laps: usize, radius: f64) -> Result<(), EnvError> {
    let wrong = |option, got: String, expected| Err(EnvError::Option { option, got, expected });
    if laps == 0 {
        return wrong("laps", "0".into(), "at least 1");
    }
    // what a plan takes, which counts the start and a place to go to at the end
    if !(1..=198).contains(&points.len().saturating_mul(laps)) {
        let got = crate::count(points.len().saturating_mul(laps), "point");
        return wrong(option, got, "1 to 198 over all laps");
    }
    if let Some(x) = points.iter().flatten().find(|x| !(-1e4..=1e4).contains(*x)) {
        return wrong(option, format!("{} m along an axis", crate::number(*x)), "finite numbers of metres up to 10 km");
    }
    if !(radius > 0.0 && radius <= 1e3) {
        return wrong("radius", format!("{} m", crate::number(radius)), "a positive number of metres");
    }
    Ok(())
}

/// Checks what a course pays.
pub(super) fn check_rewards<const N: usize>(rewards: [(&'static str, f64); N]) -> Result<(), EnvError> {
    match rewards.into_iter().find(|(_, got)| !got.is_finite()) {
        Some((option, got)) => Err(EnvError::Option { option, got: crate::number(got), expected: "a finite number" }),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The planned paths of many drones, of every airframe: apart all the time, and each begins some day.
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
        let [a, b] = [Vector3::new(-1.0, 0.1, 0.0), Vector3::new(1.0, 0.1, 0.0)];
        assert!((distance_to_leg(&a, &b, &Vector3::zeros()) - 0.1).abs() < 1e-12);
        assert!((distance_to_leg(&a, &b, &Vector3::new(2.0, 0.1, 0.0)) - 1.0).abs() < 1e-12);
        assert!((distance_to_leg(&a, &a, &Vector3::new(-1.0, 0.0, 0.0)) - 0.1).abs() < 1e-12);
    }
}
