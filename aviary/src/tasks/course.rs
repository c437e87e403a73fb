use nalgebra::Vector3;

use crate::control::Reference;
use crate::control::trajectory::{Trajectory, Waypoints};
use crate::drone::{DroneParams, GRAVITY};
use crate::env::EnvError;
use crate::simulation::Simulation;

/// Points to be passed one after the other, so many times over, and how far each drone has come.
#[derive(Debug, Clone, Default)]
pub(super) struct Course {
    /// Points passed by each drone.
    passed: Vec<usize>,
    /// Whether each drone passed one in the last control step.
    fresh: Vec<bool>,
    /// Whether each drone had one to pass in the last control step.
    flying: Vec<bool>,
    /// Distance of each drone from the point that it was to pass in the last control step, m.
    distance: Vec<f64>,
    /// Where each drone was before it.
    before: Vec<Vector3<f64>>,
}

impl Course {
    pub(super) fn reset(&mut self, simulation: &Simulation) {
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
    pub(super) fn update(&mut self, simulation: &Simulation, points: &[[f64; 3]], laps: usize, radius: f64) {
        for (drone, state) in simulation.states().iter().enumerate() {
            self.fresh[drone] = false;
            self.flying[drone] = self.passed[drone] < points.len() * laps;
            if let Some(point) = next(points, self.passed[drone], laps) {
                self.distance[drone] = (state.position - point).norm();
                if distance_to_way(&self.before[drone], &state.position, &point) <= radius {
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

    /// The smoothest way from where a drone is through all points that are left, as fast as its airframe may. Of several
    /// drones each starts when the one before has gone a part of the first lap, and goes out of the others' way at its end.
    pub(super) fn plan(
        &self,
        simulation: &Simulation,
        drone: usize,
        points: &[[f64; 3]],
        laps: usize,
    ) -> Option<Box<dyn Trajectory>> {
        let count = simulation.num_drones();
        let through = |drone: usize| {
            let left = (self.passed(drone)..points.len() * laps).map(|index| points[index % points.len()]);
            let left: Vec<_> = left.collect();
            if left.is_empty() {
                return None;
            }
            // behind the start, where no course of this crate goes
            let aside = (count > 1).then(|| [-1.0, -1.5 - 0.7 * drone as f64, 1.0]);
            let start = simulation.states()[drone].position.into();
            let way: Vec<_> = std::iter::once(start).chain(left).chain(aside).collect();
            let yaws = vec![simulation.states()[drone].yaw(); way.len()];
            let (speed, acceleration) = limits(simulation.params(drone));
            Waypoints::through(&way).yaws(yaws).limits(speed, acceleration).build().ok()
        };
        let way = through(drone)?;
        if count == 1 {
            return Some(Box::new(way));
        }
        // all come to the first point as if in one row, evenly over a lap, the last one of them as soon as it can
        let last = through(count - 1).unwrap_or_else(|| way.clone());
        let times = last.times();
        let lap = times.get(1 + points.len()).unwrap_or(&times[times.len() - 1]) - times[1];
        let first = times[1].max(way.times()[1]) - way.times()[1];
        Some(Box::new(Delayed { delay: first + drone as f64 * lap / count as f64, way }))
    }
}

/// A way that begins later.
#[derive(Debug)]
struct Delayed {
    way: Waypoints,
    delay: f64,
}

impl Trajectory for Delayed {
    fn reference(&self, time: f64) -> Reference {
        self.way.reference(time - self.delay)
    }

    fn duration(&self) -> f64 {
        self.way.duration() + self.delay
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

/// Distance of a point from the straight way between two others.
fn distance_to_way(from: &Vector3<f64>, to: &Vector3<f64>, point: &Vector3<f64>) -> f64 {
    let way = to - from;
    let length = way.norm_squared();
    let share = if length > 0.0 { ((point - from).dot(&way) / length).clamp(0.0, 1.0) } else { 0.0 };
    (from + way * share - point).norm()
}

/// Checks points, laps and a radius.
pub(super) fn check(points: &[[f64; 3]], laps: usize, radius: f64) -> Result<(), EnvError> {
    let wrong = |option, got: String, expected| Err(EnvError::Option { option, got, expected });
    if laps == 0 {
        return wrong("the number of laps", "0".into(), "at least 1");
    }
    // what a plan takes, which counts the start and a place to go to at the end
    if !(1..=198).contains(&points.len().saturating_mul(laps)) {
        let expected = "1 to 198 over all laps";
        return wrong("the number of points to pass", points.len().saturating_mul(laps).to_string(), expected);
    }
    if let Some(x) = points.iter().flatten().find(|x| !(-1e4..=1e4).contains(*x)) {
        return wrong("a point's coordinate", format!("{x} m"), "a finite number of metres up to 10 km");
    }
    if !(radius > 0.0 && radius <= 1e3) {
        return wrong("the radius of a point", format!("{radius} m"), "a positive number of metres");
    }
    Ok(())
}

/// Checks what a course pays.
pub(super) fn check_rewards<const N: usize>(rewards: [(&'static str, f64); N]) -> Result<(), EnvError> {
    match rewards.into_iter().find(|(_, got)| !got.is_finite()) {
        Some((option, got)) => Err(EnvError::Option { option, got: got.to_string(), expected: "a finite number" }),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_point_between_two_steps_is_passed() {
        let [a, b] = [Vector3::new(-1.0, 0.1, 0.0), Vector3::new(1.0, 0.1, 0.0)];
        assert!((distance_to_way(&a, &b, &Vector3::zeros()) - 0.1).abs() < 1e-12);
        assert!((distance_to_way(&a, &b, &Vector3::new(2.0, 0.1, 0.0)) - 1.0).abs() < 1e-12);
        assert!((distance_to_way(&a, &a, &Vector3::new(-1.0, 0.0, 0.0)) - 0.1).abs() < 1e-12);
    }
}
