//! Propellers with twisted, cambered blades.

use crate::mesh::{Part, Solid, lathe, loft};
use crate::vec3::{Vec3, vec3};
use std::f64::consts::TAU;

/// Largest blade angle, radians. An ideal screw is vertical at the hub; moulded blades are flatter there.
const STEEPEST: f64 = 0.7;

/// Direction of rotation of a propeller, seen from above.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Spin {
    /// Counter-clockwise.
    Ccw,
    /// Clockwise.
    Cw,
}

/// A blade's chord at one distance from the axis, metres.
#[derive(Clone, Copy, Debug)]
pub struct Station {
    /// Distance from the propeller's axis.
    pub radius: f64,
    /// Width of the blade.
    pub chord: f64,
    /// Distance by which the middle of the chord leads (positive) or trails the blade's radial line.
    pub lead: f64,
}

/// Dimensions of a propeller, metres. Heights are in the body frame.
#[derive(Clone, Copy, Debug)]
pub struct Propeller<'a> {
    /// Number of blades.
    pub blades: usize,
    /// The blade's outline from hub to tip.
    pub stations: &'a [Station],
    /// Theoretical advance per turn; determines the twist.
    pub pitch: f64,
    /// Thickness in the middle of the blade.
    pub thickness: f64,
    /// Height of the blades' mid line.
    pub height: f64,
    /// The hub's profile, (radius, height) from bottom to top.
    pub hub: &'a [[f64; 2]],
    /// Facets around the hub.
    pub hub_segments: usize,
    /// Crease angle of the hub in degrees, larger than one facet's turn.
    pub hub_crease: f64,
}

impl Propeller<'_> {
    /// Returns the propeller centred on the z axis, its first blade towards `heading` (radians from x).
    pub fn build(&self, spin: Spin, heading: f64) -> Part {
        let mut part = Part::new([lathe(self.hub, self.hub_segments, self.hub_crease)]);
        for blade in 0..self.blades {
            let angle = heading + TAU * blade as f64 / self.blades as f64;
            part.push(self.blade(spin).moved(|p| p.rotated_z(angle)));
        }
        part
    }

    /// Returns one blade along +x. Its leading edge is the upper one, so that it pushes air down when it turns with
    /// `spin`.
    fn blade(&self, spin: Spin) -> Solid {
        let widest = self.stations.iter().fold(0.0, |widest: f64, station| widest.max(station.chord));
        let rings: Vec<Vec<Vec3>> = self
            .stations
            .iter()
            .map(|station| {
                let (s, c) = (self.pitch / (TAU * station.radius)).atan().min(STEEPEST).sin_cos();
                // The thickness tapers at tip and root as the chord does.
                let thickness = self.thickness * (0.4 + 0.6 * station.chord / widest);
                let camber = 0.08 * station.chord;
                // Coordinates along the chord towards the leading edge, and perpendicular to it.
                let section = [
                    [0.5 * station.chord, 0.0],
                    [0.08 * station.chord, camber + thickness / 2.0],
                    [-0.5 * station.chord, 0.0],
                    [0.08 * station.chord, camber - thickness / 2.0],
                ];
                let mut ring: Vec<Vec3> = section
                    .iter()
                    .map(|[along, off]| {
                        let forward = along * c - off * s + station.lead;
                        let up = along * s + off * c;
                        let sense = if spin == Spin::Ccw { 1.0 } else { -1.0 };
                        vec3(station.radius, sense * forward, self.height + up)
                    })
                    .collect();
                // Mirroring reverses the ring's direction; reverse it again so that the surface faces outwards.
                if spin == Spin::Cw {
                    ring.reverse();
                }
                ring
            })
            .collect();
        loft(&rings, 60.0)
    }
}
