//! Gates of an episode: their poses, their frames and their motion.

use flight::math::V3;
use flight::tasks::gates;
use nalgebra::Vector3;
use rand::RngExt as _;

use super::{GateMotion, GateRanges, Race};
use crate::env::{EnvError, Rng};
use crate::math::ToNalgebra as _;
use crate::simulation::SimView;
use crate::world::placement::CollisionCylinder;
use crate::world::{Marker, Obstacle, Shape};

/// Gate of an episode.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub(super) struct Placed {
    /// Centre of the sway, world frame, m.
    centre: [f64; 3],
    /// Direction of the normal, rad from x.
    pub(super) yaw: f64,
    /// Phase of the sway at the start of the episode, turns.
    phase: f64,
}

impl Placed {
    /// Returns the centre at a time (s) of the episode, world frame, m.
    pub(super) fn at(&self, motion: &GateMotion, time: f64) -> [f64; 3] {
        if motion.amplitude == 0.0 {
            return self.centre;
        }
        let normal = gates::normal(self.yaw);
        let left = gates::sway(motion.amplitude, motion.period, self.phase, time);
        let [x, y, z] = self.centre;
        [x - normal.y * left, y + normal.x * left, z]
    }
}

/// Half the thickness of the bars of a gate, m.
const BAR: f64 = 0.015;

/// Names of the bars of a gate.
pub(super) const SIDES: [&str; 4] = ["left", "right", "top", "bottom"];

/// Returns the bars of a gate: a square frame, perpendicular to the normal.
pub(super) fn bars(centre: [f64; 3], yaw: f64, opening: f64, rgba: [f64; 4]) -> [Obstacle; 4] {
    let left = Vector3::new(-yaw.sin(), yaw.cos(), 0.0);
    let reach = 0.5 * opening + BAR;
    let upright = [BAR, BAR, reach + BAR];
    let level = [BAR, reach - BAR, BAR];
    [(left * reach, upright), (left * -reach, upright), (Vector3::z() * reach, level), (Vector3::z() * -reach, level)]
        .map(|(offset, half_size)| Obstacle {
            shape: Shape::Box { half_size },
            position: Vector3::from(centre) + offset,
            rpy: Vector3::new(0.0, 0.0, yaw),
            rgba,
        })
}

/// Returns true if two boxes that only turn about z overlap.
fn overlap(a: &Obstacle, b: &Obstacle) -> bool {
    /// Depth of an overlap that rounding can explain, m.
    const ROUNDING: f64 = 1e-6;
    let (Shape::Box { half_size: one }, Shape::Box { half_size: two }) = (a.shape, b.shape) else { return false };
    let apart = b.position - a.position;
    let sides = [a, b].map(|body| {
        let normal = gates::normal(body.rpy.z).to_nalgebra();
        [normal, Vector3::new(-normal.y, normal.x, 0.0)]
    });
    // boxes are apart if they are along the direction of a side
    let meets = |axis: &Vector3<f64>| {
        let reach = |[x, y]: &[Vector3<f64>; 2], half_size: [f64; 3]| {
            half_size[0] * x.dot(axis).abs() + half_size[1] * y.dot(axis).abs()
        };
        apart.dot(axis).abs() < reach(&sides[0], one) + reach(&sides[1], two) - ROUNDING
    };
    apart.z.abs() < one[2] + two[2] - ROUNDING && sides.iter().flatten().all(meets)
}

impl Race {
    /// Checks that the frames of the gates without a randomization are above the floor and do not overlap. Two gates
    /// may have one frame, which drones then pass twice in a lap, in either direction.
    pub(super) fn validate_frames(&self) -> Result<(), EnvError> {
        let option = "gates.position";
        let frames = self.frames().map(|marker| marker.body).collect::<Vec<_>>();
        for (index, (gate, frame)) in self.gates.iter().zip(frames.chunks(SIDES.len())).enumerate() {
            if gate[2] - 0.5 * self.opening - 2.0 * BAR < -1e-9 {
                let got = format!("{} m high for gate {index}", crate::number(gate[2]));
                let expected = "at least half the opening plus 0.03 m";
                return Err(EnvError::Option { option, got, expected });
            }
            let normal = self.normal(index);
            for (other, bars) in frames.chunks(SIDES.len()).enumerate().take(index) {
                let is_same = self.gates[other] == *gate && {
                    let towards = self.normal(other);
                    (normal.x * towards.y - normal.y * towards.x).abs() < 1e-6
                };
                if !is_same && frame.iter().any(|bar| bars.iter().any(|other| overlap(bar, other))) {
                    let got = format!("in the frame of gate {other} for gate {index}");
                    return Err(EnvError::Option { option, got, expected: "gates whose frames do not overlap" });
                }
            }
        }
        Ok(())
    }

    /// Returns the present centre (world frame, m) and the normal of a gate; `None` if there is no such gate.
    pub fn gate_pose(&self, gate: usize) -> Option<(Vector3<f64>, Vector3<f64>)> {
        let centre = *self.centres().get(gate)?;
        Some((centre.into(), self.normal(gate).to_nalgebra()))
    }

    /// Returns true if the gates are solid, change in every episode, or move.
    pub(super) fn has_frames(&self) -> bool {
        let GateRanges { position, yaw } = self.randomization;
        self.solid || position > 0.0 || yaw > 0.0 || self.motion.amplitude > 0.0
    }

    /// Returns true if the observation includes normals.
    pub(super) fn observes_normals(&self) -> bool {
        self.normals.unwrap_or(self.has_frames())
    }

    /// Returns true if the markers of the gates are moving markers. Batches evaluate such a race one environment at a
    /// time: the lanes know no frames and no normals.
    pub(super) fn moves_markers(&self) -> bool {
        self.has_frames() || self.observes_normals()
    }

    /// Returns the present centres of the gates, world frame, m.
    pub(super) fn centres(&self) -> &[[f64; 3]] {
        // the gates of the default race are always the nominal ones
        if self.present.len() == self.gates.len() { &self.present } else { &self.gates }
    }

    /// Returns the yaw of a gate without a randomization, rad.
    pub(super) fn nominal_yaw(&self, gate: usize) -> f64 {
        if let Some(&yaw) = self.yaws.get(gate) {
            return yaw;
        }
        let count = self.gates.len();
        let (here, next) = (self.gates[gate], self.gates[(gate + 1) % count]);
        let before = self.gates[(gate + count - 1) % count];
        let towards = |to: [f64; 3], from: [f64; 3]| [to[0] - from[0], to[1] - from[1]];
        // of two gates, the one before is also the next: there, and between gates above each other, the direction from
        // the previous gate to this one counts, or from this one to the next
        let directions = [towards(next, before), towards(here, before), towards(next, here)];
        let [x, y] = directions.into_iter().find(|[x, y]| x.hypot(*y) > 1e-9).unwrap_or([1.0, 0.0]);
        y.atan2(x)
    }

    /// Returns the yaw of a gate of the episode, rad.
    pub(super) fn yaw(&self, gate: usize) -> f64 {
        self.layout.get(gate).map_or_else(|| self.nominal_yaw(gate), |placed| placed.yaw)
    }

    /// Returns the normal of a gate of the episode.
    pub(super) fn normal(&self, gate: usize) -> V3<f64> {
        gates::normal(self.yaw(gate))
    }

    /// Returns the gate without a randomization.
    pub(super) fn nominal(&self, gate: usize) -> Placed {
        Placed { centre: self.gates[gate], yaw: self.nominal_yaw(gate), phase: 0.0 }
    }

    /// Returns the bars of all gates without a randomization, with their names.
    pub(super) fn frames(&self) -> impl Iterator<Item = Marker> {
        (0..self.gates.len()).flat_map(|index| {
            let rgba = if index == 0 { [0.1, 0.65, 0.35, 1.0] } else { [0.9, 0.35, 0.1, 1.0] };
            let bars = bars(self.gates[index], self.nominal_yaw(index), self.opening, rgba);
            let name = move |side: &str| format!("gate{index}_{side}");
            SIDES.into_iter().zip(bars).map(move |(side, body)| Marker { name: name(side), body })
        })
    }

    /// Draws the gates of an episode. A solid gate keeps away from the starts of the drones.
    pub(super) fn place_gates(&mut self, simulation: SimView<'_>, rng: &mut Rng) {
        /// Number of draws after which a gate stays at its nominal pose.
        const DRAWS: usize = 20;
        /// Clearance between a frame and the start of a drone, m.
        const ROOM: f64 = 0.05;
        let GateRanges { position, yaw } = self.randomization;
        let mut layout = std::mem::take(&mut self.layout);
        layout.clear();
        for index in 0..self.gates.len() {
            let nominal = self.nominal(index);
            let mut around = |range: f64| if range > 0.0 { range * (2.0 * rng.random::<f64>() - 1.0) } else { 0.0 };
            // a frame does not sink into the floor
            let lowest = (0.5 * self.opening + 2.0 * BAR).min(nominal.centre[2]);
            let mut drawn = || {
                let [x, y, z] = nominal.centre.map(|coordinate| coordinate + around(position));
                Placed { centre: [x, y, z.max(lowest)], yaw: nominal.yaw + around(yaw), phase: 0.0 }
            };
            let has_room = |gate: &Placed| {
                let bars = bars(gate.centre, gate.yaw, self.opening, [0.0; 4]);
                simulation.states().iter().enumerate().all(|(drone, state)| {
                    let radius = CollisionCylinder::from(simulation.params(drone)).bounding_radius() + ROOM;
                    bars.iter().all(|bar| bar.distance(&state.position) > radius + self.motion.amplitude)
                })
            };
            let found = (0..DRAWS).map(|_| drawn()).find(|gate| !self.solid || has_room(gate));
            let mut placed = found.unwrap_or(nominal);
            if self.motion.amplitude > 0.0 {
                placed.phase = rng.random::<f64>();
            }
            layout.push(placed);
        }
        self.layout = layout;
    }

    /// Moves the gates to their places at a time (s) of the episode.
    pub(super) fn move_gates(&mut self, time: f64) {
        let motion = self.motion;
        self.present.clear();
        self.present.extend(self.layout.iter().map(|placed| placed.at(&motion, time)));
    }
}
