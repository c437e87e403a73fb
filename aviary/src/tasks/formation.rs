use std::f64::consts::{FRAC_PI_2, TAU};

use nalgebra::Vector3;

use super::conditions::{CrashConditions, CrashWatch, crash_penalty};
use super::{STATE_BOUNDS, UNBOUNDED};
use crate::control::{ControllerKind, Reference};
use crate::drone::DroneParams;
use crate::env::{AviaryBuilder, BoxSpace, EndReason, EnvError, Rng, Task, TaskDefaults, path_points};
use crate::observation::STATE_SIZE;
use crate::simulation::SimView;

/// Task: drones keep a formation whose centre moves along a closed path (paper, §4.1 `FormationAviary`).
///
/// | | |
/// | --- | --- |
/// | Formation | three drones, evenly spaced on a circle of radius 0.3 m |
/// | Start | in formation around the first corner of the path |
/// | Path of the centre | (0, 0, 1), (1, 0, 1), (1, 1, 1.2), (0, 1, 1) m and back, at 0.048 m/s |
/// | Action | 4 normalized motor speeds in [−1, 1] per drone |
/// | Reward | − Σ_i ‖p_i − slot_i‖ − 0.5·Σ_{i<j} \|d_ij − desired d_ij\|, − 100 for each crash |
/// | Terminated | a drone crashes |
/// | Truncated | after 30 s |
/// | Success | mean distance of the drones from their slots over the episode below 5 cm |
///
/// | Observation, per drone | | Unit, frame |
/// | --- | --- | --- |
/// | 0–11 | position, roll-pitch-yaw, velocity, angular velocity | as in [`Hover`](super::Hover) |
/// | 12–14 | the drone's slot | m, world |
/// | 15–17 | slot minus position | m, world |
///
/// ```
/// use aviary::env::Env;
/// use aviary::tasks::Formation;
///
/// let mut env = Formation::builder().build()?;
/// let seen = &env.reset(Some(1))?.vector;
/// assert!((0..3).all(|drone| seen[18 * drone + 15..][..3].iter().all(|x| x.abs() < 1e-12)), "all in their slots");
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Clone, serde::Serialize, serde::Deserialize)]
pub struct Formation {
    /// Radius of the circle, m; default 0.3.
    pub radius: f64,
    /// Slots relative to the centre, world frame, m, one per drone; default the circle.
    pub offsets: Option<Vec<[f64; 3]>>,
    /// Corners of the closed path of the centre, world frame, m.
    pub path: Vec<[f64; 3]>,
    /// Speed of the centre, m/s; default 0.048.
    pub speed: f64,
    /// Conditions under which a drone crashes.
    pub crash: CrashConditions,
    watch: CrashWatch,
    /// Sum of the distances from the slots over drones and control steps, m, and the number of summands.
    errors: (f64, f64),
}

impl Default for Formation {
    fn default() -> Self {
        Self {
            radius: 0.3,
            offsets: None,
            path: vec![[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [1.0, 1.0, 1.2], [0.0, 1.0, 1.0]],
            speed: 0.048,
            crash: CrashConditions::with_max_tilt(FRAC_PI_2),
            watch: CrashWatch::default(),
            errors: (0.0, 0.0),
        }
    }
}

impl Formation {
    /// Mean distance from the slots below which the task succeeds, m.
    const KEPT: f64 = 0.05;

    /// Creates a builder for the environment of this task.
    pub fn builder() -> AviaryBuilder<Self> {
        AviaryBuilder::new(Self::default())
    }

    /// Returns the slot of a drone relative to the centre, m.
    fn offset(&self, drone: usize, count: usize) -> Vector3<f64> {
        match &self.offsets {
            Some(offsets) => offsets[drone].into(),
            None => {
                let (sin, cos) = (TAU * drone as f64 / count as f64).sin_cos();
                Vector3::new(cos, sin, 0.0) * self.radius
            }
        }
    }

    /// Returns the position and the velocity of the centre at a time.
    fn centre(&self, time: f64) -> (Vector3<f64>, Vector3<f64>) {
        let sides = self.path.iter().zip(self.path.iter().cycle().skip(1));
        let sides = sides.map(|(from, to)| (Vector3::from(*from), Vector3::from(*to)));
        let length: f64 = sides.clone().map(|(from, to)| (to - from).norm()).sum();
        let mut travelled = if length > 0.0 { (self.speed * time).rem_euclid(length) } else { 0.0 };
        for (from, to) in sides {
            let side = (to - from).norm();
            if travelled < side {
                let direction = (to - from) / side;
                return (from + direction * travelled, direction * self.speed);
            }
            travelled -= side;
        }
        (self.path[0].into(), Vector3::zeros())
    }

    fn slot(&self, simulation: SimView<'_>, drone: usize) -> Vector3<f64> {
        self.centre(simulation.time()).0 + self.offset(drone, simulation.num_drones())
    }

    /// Returns the mean distance of the drones from their slots over the episode so far, m.
    pub fn mean_error(&self) -> f64 {
        self.errors.0 / self.errors.1.max(1.0)
    }
}

impl Task for Formation {
    fn name(&self) -> &'static str {
        "formation"
    }

    fn defaults(&self) -> TaskDefaults {
        TaskDefaults { num_drones: 3, episode_seconds: 30.0, controller: ControllerKind::Dsl }
    }

    fn initial_positions(&self, drones: &[DroneParams]) -> Vec<[f64; 3]> {
        let (centre, _) = self.centre(0.0);
        (0..drones.len()).map(|drone| (centre + self.offset(drone, drones.len())).into()).collect()
    }

    fn observation_space(&self) -> BoxSpace {
        BoxSpace::new(STATE_BOUNDS.into_iter().chain([UNBOUNDED; 6]))
    }

    fn validate(&self, drones: &[DroneParams]) -> Result<(), EnvError> {
        self.crash.validate()?;
        let wrong = |option, got: String, expected| Err(EnvError::Option { option, got, expected });
        if self.path.is_empty() || self.path.iter().flatten().any(|x| !(-1e4..=1e4).contains(x)) {
            return wrong(
                "path",
                format!("{:?}", self.path),
                "at least one corner, and finite coordinates up to 10 km",
            );
        }
        if !(0.0..=1e3).contains(&self.speed) {
            return wrong("speed", format!("{} m/s", crate::number(self.speed)), "zero or a positive number");
        }
        if let Some(offsets) = &self.offsets {
            if offsets.len() != drones.len() {
                return wrong("offsets", crate::count(offsets.len(), "slot"), "one per drone");
            }
        } else if !(self.radius >= 0.0 && self.radius <= 1e3) {
            return wrong("radius", format!("{} m", crate::number(self.radius)), "zero or a positive number of metres");
        }
        if let Some(x) = self.offsets.iter().flatten().flatten().find(|x| !(-1e4..=1e4).contains(*x)) {
            return wrong(
                "offsets",
                format!("{} m along an axis", crate::number(*x)),
                "finite coordinates up to 10 km",
            );
        }
        let slots: Vec<_> = (0..drones.len()).map(|drone| self.offset(drone, drones.len())).collect();
        for (i, (a, first)) in slots.iter().zip(drones).enumerate() {
            for (b, second) in slots[..i].iter().zip(drones) {
                let apart = (a - b).norm();
                let min = first.collision_radius + second.collision_radius;
                if apart.is_nan() || apart <= min {
                    let (option, value) = match &self.offsets {
                        Some(offsets) => ("offsets", format!("{offsets:?}")),
                        None => ("radius", format!("{} m", crate::number(self.radius))),
                    };
                    let got = format!("{value}, with slots {apart:.3} m apart for drones of {min:.3} m");
                    return wrong(option, got, "slots that do not overlap");
                }
            }
        }
        Ok(())
    }

    fn reset(&mut self, simulation: SimView<'_>, _rng: &mut Rng) {
        self.watch.reset(simulation);
        self.errors = (0.0, 0.0);
    }

    fn update(&mut self, simulation: SimView<'_>) {
        self.watch.update(&self.crash, simulation);
        for drone in 0..simulation.num_drones() {
            self.errors.0 += simulation.distance(drone, &self.slot(simulation, drone));
            self.errors.1 += 1.0;
        }
    }

    fn end(&self, _simulation: SimView<'_>, drone: usize) -> Option<EndReason> {
        self.watch.end(drone)
    }

    fn reward(&self, simulation: SimView<'_>, drone: usize, end: Option<EndReason>) -> f64 {
        let (states, count) = (simulation.states(), simulation.num_drones());
        let (here, own) = (states[drone].position, self.offset(drone, count));
        let others = (0..count).filter(|&other| other != drone).map(|other| {
            let desired = (self.offset(other, count) - own).norm();
            ((states[other].position - here).norm() - desired).abs()
        });
        // each pair occurs in the rewards of both its drones
        -simulation.distance(drone, &self.slot(simulation, drone)) - 0.25 * others.sum::<f64>() - crash_penalty(end)
    }

    fn observe(&self, simulation: SimView<'_>, drone: usize, out: &mut [f64]) {
        let (state, slot) = (&simulation.states()[drone], self.slot(simulation, drone));
        out[..STATE_SIZE].copy_from_slice(&simulation.state_vector(drone));
        out[12..15].copy_from_slice(slot.as_slice());
        out[15..18].copy_from_slice((slot - state.position).as_slice());
    }

    fn success(&self, simulation: SimView<'_>, drone: usize) -> bool {
        self.watch.end(drone).is_none() && simulation.control_steps() > 0 && self.mean_error() < Self::KEPT
    }

    fn reference(&self, simulation: SimView<'_>, drone: usize) -> Reference {
        let (centre, velocity) = self.centre(simulation.time());
        let slot = centre + self.offset(drone, simulation.num_drones());
        Reference { velocity, ..Reference::hover(slot, simulation.initial_states()[drone].yaw()) }
    }

    fn extent(&self, simulation: SimView<'_>, drone: usize, seconds: f64) -> Vec<Vector3<f64>> {
        let offset = self.offset(drone, simulation.num_drones());
        path_points(seconds, |time| self.centre(time).0 + offset).collect()
    }

    fn metrics(&self, _simulation: SimView<'_>, report: &mut dyn FnMut(&'static str, f64)) {
        report("mean_formation_error", self.mean_error());
    }

    fn may_be_constant(&self, entry: usize) -> bool {
        // the slot is constant for a path of one point, and its height for a level path
        (12..15).contains(&entry)
    }

    super::saved_by_serde!();
}
