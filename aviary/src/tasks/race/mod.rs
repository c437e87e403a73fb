mod gates;
mod lanes;
mod plan;
mod track;

use flight::math::V3;
use flight::tasks::gates::{crosses, in_gate_frame};
use flight::tasks::{RewardTerms, race};
use nalgebra::Vector3;

use self::gates::{Placed, SIDES, bars};
pub use self::track::{Gate, GateMotion, GateRanges, RaceTrack};
use super::conditions::{CrashConditions, CrashWatch, with_crash};
use super::waypoint_progress::{self, WaypointProgress};
use super::{STATE_BOUNDS, UNBOUNDED, observed, row_along_y};
use crate::control::trajectory::Trajectory;
use crate::control::{ControllerKind, Reference};
use crate::drone::DroneParams;
use crate::env::{AviaryBuilder, BoxSpace, EndReason, EnvError, LaneFunctions, Rng, Task, TaskDefaults, TaskOptions};
use crate::math::{ToFlight as _, ToNalgebra as _};
use crate::simulation::SimView;
use crate::world::{Marker, MarkerPose, MovingMarker};

/// Distance of the planned points before and after a solid gate from its plane, m.
const APPROACH: f64 = 0.2;

/// Number of entries of an observation for the normals.
const NORMALS: usize = 6;

/// Task: a drone races two laps through six gates (paper, §4.1 `RaceAviary`).
///
/// | | |
/// | --- | --- |
/// | Start | (0, 0, 0.1) m; several drones in a row along −y |
/// | Gates | (1, 0, 1), (2, 1, 1.2), (1, 2, 1.5), (0, 2, 1.3), (−1, 1, 1), (0, 0, 0.8) m |
/// | Gate passed | within 0.2 m of its centre; a solid gate through its opening, along its normal |
/// | Action | 4 normalized motor speeds in [−1, 1] per drone |
/// | Reward | + 20 for a gate, + 2·‖v‖, − 0.05·(distance to the next gate), − 100 for a crash |
/// | Reward after the last gate | − 100 for a crash |
/// | Reward terms | `gate`, `speed`, `distance`, `crash` |
/// | Terminated | crash (tilt > 2 rad, contact, z < 0), or every drone has completed two laps |
/// | Truncated | after 30 s |
/// | Success, progress | two laps; share of gates passed |
///
/// By default, the frames of the gates are visible and do not collide. [`solid`](Self::solid) frames do: a drone that
/// touches one has crashed. [`randomization`](Self::randomization) changes the gates in every episode, and
/// [`motion`](Self::motion) lets them sway. A [`RaceTrack`] has all of these properties.
///
/// | Observation, per drone | | Unit, frame |
/// | --- | --- | --- |
/// | 0–11 | position, roll-pitch-yaw, velocity, angular velocity | as in [`Hover`](super::Hover) |
/// | 12–14 | next gate (the first one after the last) | m, world |
/// | 15–17 | next gate relative to the drone | m, body |
/// | 18–20 | the gate after the next, relative to the drone | m, body |
/// | 21–23 | normal of the next gate, with [`normals`](Self::normals) | body |
/// | 24–26 | normal of the gate after the next, with [`normals`](Self::normals) | body |
///
/// The normal of a gate is the horizontal unit vector in the direction in which drones pass it. A gate stands still
/// during a control step. Its position and normal in the observation are those at the time of the observation.
///
/// ```
/// use aviary::drone::DroneModel;
/// use aviary::env::Env;
/// use aviary::tasks::Race;
///
/// let mut env = Race::builder().drone(DroneModel::Race).task(|race| race.laps = 1).build()?;
/// let seen = &env.reset(Some(1))?.vector;
/// assert_eq!(seen[12..15], [1.0, 0.0, 1.0], "the first gate");
/// assert!((seen[17] - 0.9).abs() < 1e-12, "which is higher than the drone");
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Clone, serde::Serialize, serde::Deserialize)]
pub struct Race {
    /// Centres of the gates, world frame, m.
    pub gates: Vec<[f64; 3]>,
    /// Direction of the normal of each gate, rad from x; empty, the default, for the direction from the previous gate
    /// to the next.
    pub yaws: Vec<f64>,
    /// Inner side of a gate, m; default 0.5.
    pub opening: f64,
    /// True if the frames are obstacles. A drone then passes a gate where its path crosses the plane of the gate
    /// inside the opening, in the direction of the normal. Default false. Changes after the construction of an
    /// environment, here and in the next three fields, have no effect on its scene.
    pub solid: bool,
    /// Changes of the gates in every episode; default none.
    pub randomization: GateRanges,
    /// Motion of the gates; default none.
    pub motion: GateMotion,
    /// True if the observation includes the normals of the next two gates; `None`, the default, for true if the gates
    /// are solid, change in every episode, or move.
    pub normals: Option<bool>,
    /// Distance from the centre within which a gate that is not solid is passed, m; default 0.2.
    pub radius: f64,
    /// Number of laps; default 2.
    pub laps: usize,
    /// Reward for a gate; default 20.
    pub gate_reward: f64,
    /// Reward per control step and m/s; default 2.
    pub speed_reward: f64,
    /// Penalty per control step and m of distance from the gate; default 0.05.
    pub distance_penalty: f64,
    /// Conditions under which a drone crashes.
    pub crash: CrashConditions,
    progress: WaypointProgress,
    watch: CrashWatch,
    /// Gates of the episode; empty if they are the nominal ones.
    layout: Vec<Placed>,
    /// Present centres of the gates of the episode.
    present: Vec<[f64; 3]>,
}

impl Default for Race {
    fn default() -> Self {
        Self {
            gates: vec![
                [1.0, 0.0, 1.0],
                [2.0, 1.0, 1.2],
                [1.0, 2.0, 1.5],
                [0.0, 2.0, 1.3],
                [-1.0, 1.0, 1.0],
                [0.0, 0.0, 0.8],
            ],
            yaws: Vec::new(),
            opening: 0.5,
            solid: false,
            randomization: GateRanges::default(),
            motion: GateMotion::default(),
            normals: None,
            radius: 0.2,
            laps: 2,
            gate_reward: 20.0,
            speed_reward: 2.0,
            distance_penalty: 0.05,
            crash: CrashConditions::with_max_tilt(2.0),
            progress: WaypointProgress::default(),
            watch: CrashWatch::default(),
            layout: Vec::new(),
            present: Vec::new(),
        }
    }
}

impl Race {
    /// Creates a builder for the environment of this task.
    pub fn builder() -> AviaryBuilder<Self> {
        AviaryBuilder::new(Self::default())
    }

    /// Sets the gates, the laps and the properties of the gates to those of a track.
    pub fn set_track(&mut self, track: &RaceTrack) {
        let RaceTrack { laps, opening, solid, normals, randomization, motion, ref gates } = *track;
        (self.laps, self.opening, self.solid, self.normals) = (laps, opening, solid, normals);
        (self.randomization, self.motion) = (randomization, motion);
        self.gates = gates.iter().map(|gate| gate.position).collect();
        self.yaws.clear();
        if gates.iter().any(|gate| gate.yaw.is_some()) {
            let yaw = |(index, gate): (usize, &Gate)| gate.yaw.unwrap_or_else(|| self.nominal_yaw(index));
            self.yaws = gates.iter().enumerate().map(yaw).collect();
        }
    }

    /// Returns the track with the present options.
    pub fn track(&self) -> RaceTrack {
        let gate = |(index, &position): (usize, &[f64; 3])| Gate { position, yaw: self.yaws.get(index).copied() };
        RaceTrack {
            laps: self.laps,
            opening: self.opening,
            solid: self.solid,
            normals: self.normals,
            randomization: self.randomization,
            motion: self.motion,
            gates: self.gates.iter().enumerate().map(gate).collect(),
        }
    }

    /// Returns the number of gates that a drone has passed in this episode, over all laps; 0 before the first
    /// reset.
    pub fn gates_passed(&self, drone: usize) -> usize {
        self.progress.passed(drone)
    }

    /// Returns the gate `ahead` places after the next one.
    fn gate(&self, drone: usize, ahead: usize) -> Vector3<f64> {
        self.centres()[self.gate_index(drone, ahead)].into()
    }

    /// Returns the index of the gate `ahead` places after the next one.
    fn gate_index(&self, drone: usize, ahead: usize) -> usize {
        (self.progress.passed(drone) + ahead) % self.gates.len()
    }

    /// Returns the terms of a drone's reward, or their sum.
    fn terms<T: RewardTerms<f64>>(&self, simulation: SimView<'_>, drone: usize, end: Option<EndReason>) -> T {
        if !self.progress.was_flying(drone) {
            return with_crash(race::no_terms(), end);
        }
        let gate = if self.progress.just_passed(drone) { self.gate_reward } else { 0.0 };
        let (velocity, distance) = (&simulation.states()[drone].velocity, self.progress.distance(drone));
        with_crash(race::terms(gate, [self.speed_reward, self.distance_penalty], velocity.to_flight(), distance), end)
    }
}

impl Task for Race {
    fn name(&self) -> &'static str {
        "race"
    }

    fn defaults(&self) -> TaskDefaults {
        TaskDefaults { num_drones: 1, episode_seconds: 30.0, controller: ControllerKind::Geometric }
    }

    fn set_options(&mut self, options: &TaskOptions) -> Result<(), EnvError> {
        options.check(self.name(), &["gates", "laps", "track"])?;
        if let Some(track) = &options.track {
            self.set_track(track);
        }
        if let Some(gates) = &options.gates
            && *gates != self.gates
        {
            self.gates.clone_from(gates);
            self.yaws.clear();
        }
        self.laps = options.laps.unwrap_or(self.laps);
        Ok(())
    }

    fn options(&self) -> TaskOptions {
        let default = RaceTrack { laps: self.laps, gates: self.track().gates, ..Self::default().track() };
        let has_track = !self.yaws.is_empty() || self.track() != default;
        TaskOptions {
            gates: Some(self.gates.clone()),
            laps: Some(self.laps),
            track: has_track.then(|| self.track()),
            ..TaskOptions::default()
        }
    }

    fn initial_positions(&self, drones: &[DroneParams]) -> Vec<[f64; 3]> {
        row_along_y(drones)
    }

    fn observation_space(&self) -> BoxSpace {
        let more = if self.observes_normals() { NORMALS } else { 0 };
        BoxSpace::new(STATE_BOUNDS.into_iter().chain(std::iter::repeat_n(UNBOUNDED, 9 + more)))
    }

    fn validate(&self, drones: &[DroneParams]) -> Result<(), EnvError> {
        self.crash.validate()?;
        waypoint_progress::validate("gates", &self.gates, self.laps, self.radius)?;
        let wrong = |option, got, expected| Err(EnvError::Option { option, got, expected });
        if !self.yaws.is_empty() && self.yaws.len() != self.gates.len() {
            return wrong("yaws", crate::count(self.yaws.len(), "angle"), "none, or one per gate");
        }
        self.track().validate()?;
        let widths = drones.iter().map(|drone| 2.0 * drone.collision_radius.max(0.5 * drone.collision_height));
        let widest = widths.fold(0.0, f64::max);
        if self.solid && self.opening <= widest {
            let got = format!("{} m for a drone of {} m", crate::number(self.opening), crate::number(widest));
            return wrong("opening", got, "more than the size of every drone");
        }
        waypoint_progress::validate_rewards([
            ("gate_reward", self.gate_reward),
            ("speed_reward", self.speed_reward),
            ("distance_penalty", self.distance_penalty),
        ])
    }

    /// Returns square frames, by default perpendicular to the line from the previous gate to the next one.
    fn markers(&self) -> Vec<Marker> {
        if self.moves_markers() { Vec::new() } else { self.frames().collect() }
    }

    fn moving_markers(&self) -> Vec<MovingMarker> {
        let markers = self.moves_markers().then(|| self.frames());
        let stands_still = self.motion.amplitude == 0.0;
        let moving = |marker| MovingMarker { marker, solid: self.solid, stands_still };
        markers.into_iter().flatten().map(moving).collect()
    }

    fn move_markers(&self, _simulation: SimView<'_>, poses: &mut [MarkerPose]) {
        let gates = self.layout.iter().zip(self.centres());
        for (poses, (placed, &centre)) in poses.chunks_mut(SIDES.len()).zip(gates) {
            for (pose, bar) in poses.iter_mut().zip(bars(centre, placed.yaw, self.opening, [0.0; 4])) {
                *pose = MarkerPose { position: bar.position, rpy: bar.rpy };
            }
        }
    }

    fn reset(&mut self, simulation: SimView<'_>, rng: &mut Rng) {
        self.watch.reset(simulation);
        self.progress.reset(simulation);
        self.layout.clear();
        if self.has_frames() {
            self.place_gates(simulation, rng);
        }
        self.move_gates(simulation.time());
    }

    fn update(&mut self, simulation: SimView<'_>) {
        self.watch.update(&self.crash, simulation);
        let mut progress = std::mem::take(&mut self.progress);
        // the gates stood still during the step
        if self.solid {
            let passes = |gate: usize, from: V3<f64>, to: V3<f64>| {
                let (centre, normal) = (Vector3::from(self.centres()[gate]).to_flight(), self.normal(gate));
                let [from, to] = [from, to].map(|point| in_gate_frame(point, centre, normal));
                crosses(from, to, 0.5 * self.opening)
            };
            progress.update_with(simulation, self.centres(), self.laps, passes);
        } else {
            progress.update(simulation, self.centres(), self.laps, self.radius);
        }
        self.progress = progress;
        self.move_gates(simulation.time());
    }

    fn end(&self, simulation: SimView<'_>, drone: usize) -> Option<EndReason> {
        self.watch.end(drone).or(self.success(simulation, drone).then_some(EndReason::Completed))
    }

    fn reward(&self, simulation: SimView<'_>, drone: usize, end: Option<EndReason>) -> f64 {
        self.terms(simulation, drone, end)
    }

    fn reward_terms(&self, simulation: SimView<'_>, drone: usize, end: Option<EndReason>) -> Vec<(&'static str, f64)> {
        self.terms(simulation, drone, end)
    }

    fn gates(&self) -> Vec<[f64; 4]> {
        self.centres().iter().enumerate().map(|(gate, &[x, y, z])| [x, y, z, self.yaw(gate)]).collect()
    }

    fn observe(&self, simulation: SimView<'_>, drone: usize, out: &mut [f64]) {
        let (state, rpy) = observed(simulation, drone);
        race::observe(&state, rpy, [0, 1].map(|ahead| self.gate(drone, ahead).to_flight()), out);
        if self.observes_normals() && out.len() >= STATE_BOUNDS.len() + 9 + NORMALS {
            race::observe_normals(&state, [0, 1].map(|ahead| self.normal(self.gate_index(drone, ahead))), out);
        }
    }

    fn success(&self, _simulation: SimView<'_>, drone: usize) -> bool {
        self.watch.end(drone).is_none() && self.progress.passed(drone) == self.gates.len() * self.laps
    }

    fn progress(&self, _simulation: SimView<'_>, drone: usize) -> f64 {
        self.progress.passed(drone) as f64 / (self.gates.len() * self.laps) as f64
    }

    fn reference(&self, simulation: SimView<'_>, drone: usize) -> Reference {
        // after the last gate, the drone may stay there
        let passed = self.progress.passed(drone).min(self.gates.len() * self.laps - 1);
        let gate = passed % self.gates.len();
        // a drone that stops in the plane of a solid gate may not have crossed it
        let centre = Vector3::from(self.centres()[gate]);
        let point = if self.solid { centre + self.normal(gate).to_nalgebra() * APPROACH } else { centre };
        Reference::hover(point, simulation.initial_states()[drone].yaw())
    }

    fn plan(&self, simulation: SimView<'_>, drone: usize) -> Option<Box<dyn Trajectory>> {
        self.plans(simulation).swap_remove(drone)
    }

    fn plans(&self, simulation: SimView<'_>) -> Vec<Option<Box<dyn Trajectory>>> {
        self.progress.plans_through(simulation, |drone| self.points_in_time(simulation, drone))
    }

    fn extent(&self, simulation: SimView<'_>, drone: usize, _seconds: f64) -> Vec<Vector3<f64>> {
        self.progress.extent(simulation, drone, self.centres(), self.laps)
    }

    fn metrics(&self, simulation: SimView<'_>, report: &mut dyn FnMut(&'static str, f64)) {
        let passed: usize = (0..simulation.num_drones()).map(|drone| self.gates_passed(drone)).sum();
        report("gates_passed", passed as f64);
    }

    fn may_be_constant(&self, entry: usize) -> bool {
        (12..15).contains(&entry)
    }

    fn lane_functions() -> Option<LaneFunctions<Self>> {
        Some(LaneFunctions::of())
    }

    super::saved_by_serde!();
}
