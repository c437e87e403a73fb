//! Closed solids and the primitives that build them.
//!
//! Every primitive returns a closed, outward-facing triangle mesh. MuJoCo derives mass and inertia from the signed
//! volume, so that an open or inverted mesh does not compile.

use crate::vec3::{Vec3, vec3};
use std::f64::consts::{PI, TAU};

/// A corner of an outline in the xy plane, metres.
pub type Point2 = [f64; 2];

/// Crease angle in degrees that keeps the edges of boxes and plates sharp and smooths round outlines. No primitive
/// here has an edge with exactly this angle, so that rounding cannot decide whether an edge is smooth.
pub const CREASE: f64 = 40.0;

/// A triangle corner: position and surface normal.
#[derive(Clone, Copy, Debug)]
pub struct Corner {
    /// Position, metres.
    pub position: Vec3,
    /// Outward unit normal.
    pub normal: Vec3,
}

/// One closed triangle mesh.
#[derive(Clone, Debug)]
pub struct Solid {
    /// Shared vertices, metres.
    pub points: Vec<Vec3>,
    /// Triangles as indices into `points`, counter-clockwise seen from outside.
    pub faces: Vec<[usize; 3]>,
    /// Crease angle in degrees: edges between faces at a larger angle are sharp.
    pub crease: f64,
}

/// All solids of one material; they may touch or overlap.
#[derive(Clone, Debug, Default)]
pub struct Part {
    /// The solids.
    pub solids: Vec<Solid>,
}

impl Part {
    /// Creates a part from solids.
    pub fn new(solids: impl IntoIterator<Item = Solid>) -> Part {
        Part { solids: solids.into_iter().collect() }
    }

    /// Adds one solid.
    pub fn push(&mut self, solid: Solid) {
        self.solids.push(solid);
    }

    /// Adds all solids of `other`.
    pub fn append(&mut self, other: Part) {
        self.solids.extend(other.solids);
    }

    /// Returns the part with the rigid `motion` applied to all points.
    pub fn moved(mut self, motion: impl Fn(Vec3) -> Vec3) -> Part {
        for solid in &mut self.solids {
            for point in &mut solid.points {
                *point = motion(*point);
            }
        }
        self
    }
}

impl Solid {
    /// Returns the solid with the rigid `motion` applied to all points.
    pub fn moved(mut self, motion: impl Fn(Vec3) -> Vec3) -> Solid {
        for point in &mut self.points {
            *point = motion(*point);
        }
        self
    }

    /// Returns the solid shifted by (x, y, z).
    pub fn at(self, x: f64, y: f64, z: f64) -> Solid {
        self.moved(|point| point + vec3(x, y, z))
    }

    /// Returns the outward unit normal of `face`.
    fn face_normal(&self, face: &[usize; 3]) -> Vec3 {
        let [a, b, c] = face.map(|index| self.points[index]);
        (b - a).cross(c - a).normalized()
    }

    /// Returns the triangles with shading normals: each corner averages, weighted by angle, the faces around its
    /// vertex that are within the crease angle.
    pub fn triangles(&self) -> Vec<[Corner; 3]> {
        let normals: Vec<Vec3> = self.faces.iter().map(|f| self.face_normal(f)).collect();
        let mut around: Vec<Vec<(usize, f64)>> = vec![Vec::new(); self.points.len()];
        for (index, face) in self.faces.iter().enumerate() {
            for corner in 0..3 {
                let here = self.points[face[corner]];
                let next = self.points[face[(corner + 1) % 3]] - here;
                let last = self.points[face[(corner + 2) % 3]] - here;
                around[face[corner]].push((index, next.angle_to(last)));
            }
        }
        let limit = self.crease.to_radians().cos();
        self.faces
            .iter()
            .enumerate()
            .map(|(index, face)| {
                face.map(|vertex| {
                    let normal = around[vertex]
                        .iter()
                        .filter(|(other, _)| normals[*other].dot(normals[index]) >= limit)
                        .fold(Vec3::ZERO, |sum, (other, angle)| sum + normals[*other] * *angle);
                    Corner { position: self.points[vertex], normal: normal.normalized() }
                })
            })
            .collect()
    }
}

/// Stacks `rings` with equal numbers of points into a closed solid. Each ring runs counter-clockwise about the
/// stacking direction; `cap` triangulates a ring, counter-clockwise.
fn stack(rings: &[Vec<Vec3>], cap: &[[usize; 3]], crease: f64) -> Solid {
    let count = rings[0].len();
    let mut faces = Vec::new();
    for ring in 1..rings.len() {
        let (below, above) = ((ring - 1) * count, ring * count);
        for j in 0..count {
            let k = (j + 1) % count;
            faces.push([below + j, below + k, above + k]);
            faces.push([below + j, above + k, above + j]);
        }
    }
    let last = (rings.len() - 1) * count;
    for [a, b, c] in cap {
        faces.push([*a, *c, *b]);
        faces.push([last + a, last + b, last + c]);
    }
    Solid { points: rings.concat(), faces, crease }
}

/// Returns a surface over convex `rings` with equal numbers of points, closed at both ends. Each ring runs
/// counter-clockwise about the direction in which the rings follow each other.
pub fn loft(rings: &[Vec<Vec3>], crease: f64) -> Solid {
    let fan: Vec<[usize; 3]> = (1..rings[0].len() - 1).map(|i| [0, i, i + 1]).collect();
    stack(rings, &fan, crease)
}

/// Returns a plate: `outline` (simple, counter-clockwise) from height `bottom` to `top`.
pub fn prism(outline: &[Point2], bottom: f64, top: f64) -> Solid {
    let ring = |z| outline.iter().map(|p| vec3(p[0], p[1], z)).collect();
    stack(&[ring(bottom), ring(top)], &triangulate(outline), CREASE)
}

/// Returns a plate with a convex `outline`, whose top and bottom edges are bevelled by `bevel` metres to catch the
/// light.
pub fn bevelled_prism(outline: &[Point2], bottom: f64, top: f64, bevel: f64) -> Solid {
    let inner = inset(outline, bevel);
    let ring = |points: &[Point2], z| points.iter().map(|p| vec3(p[0], p[1], z)).collect();
    loft(&[ring(&inner, bottom), ring(outline, bottom + bevel), ring(outline, top - bevel), ring(&inner, top)], CREASE)
}

/// Returns a box with sides `size` (x, y, z), centred on `centre` in x and y, with its underside at height
/// `centre.z`.
pub fn block(centre: Vec3, size: Vec3) -> Solid {
    prism(&rectangle(size.x / 2.0, size.y / 2.0), centre.z, centre.z + size.z).at(centre.x, centre.y, 0.0)
}

/// Revolves `profile`, pairs of (radius, height) from bottom to top, about the z axis. The profile has the inner
/// points only: the ends close on the axis.
pub fn lathe(profile: &[[f64; 2]], segments: usize, crease: f64) -> Solid {
    let mut points = Vec::new();
    for [radius, height] in profile {
        for p in circle(*radius, segments) {
            points.push(vec3(p[0], p[1], *height));
        }
    }
    let (bottom, top) = (points.len(), points.len() + 1);
    points.push(vec3(0.0, 0.0, profile[0][1]));
    points.push(vec3(0.0, 0.0, profile[profile.len() - 1][1]));
    let last = (profile.len() - 1) * segments;
    let mut faces = Vec::new();
    for j in 0..segments {
        let k = (j + 1) % segments;
        faces.push([bottom, k, j]);
        for ring in 1..profile.len() {
            let (below, above) = ((ring - 1) * segments, ring * segments);
            faces.push([below + j, below + k, above + k]);
            faces.push([below + j, above + k, above + j]);
        }
        faces.push([top, last + j, last + k]);
    }
    Solid { points, faces, crease }
}

/// Returns a round bar of `radius` along `path`, which must not be parallel to `side`.
pub fn tube(path: &[Vec3], side: Vec3, radius: f64, segments: usize) -> Solid {
    let rings: Vec<Vec<Vec3>> = (0..path.len())
        .map(|i| {
            let before = path[i.saturating_sub(1)];
            let after = path[(i + 1).min(path.len() - 1)];
            let along = (after - before).normalized();
            let u = along.cross(side).normalized();
            let v = along.cross(u);
            circle(radius, segments).iter().map(|p| path[i] + u * p[0] + v * p[1]).collect()
        })
        .collect();
    loft(&rings, 70.0)
}

/// Returns a regular polygon of `segments` corners on a circle about the origin, counter-clockwise.
pub fn circle(radius: f64, segments: usize) -> Vec<Point2> {
    (0..segments)
        .map(|i| {
            let (s, c) = (TAU * i as f64 / segments as f64).sin_cos();
            [radius * c, radius * s]
        })
        .collect()
}

/// Returns a rectangle about the origin with half sides `hx` and `hy`.
pub fn rectangle(hx: f64, hy: f64) -> Vec<Point2> {
    vec![[hx, -hy], [hx, hy], [-hx, hy], [-hx, -hy]]
}

/// Returns a rectangle about the origin with half sides `hx` and `hy`, and corners rounded to `radius` in `steps`
/// facets; one step is a chamfer.
pub fn rounded_rectangle(hx: f64, hy: f64, radius: f64, steps: usize) -> Vec<Point2> {
    let mut outline = Vec::new();
    for (corner, (sx, sy)) in [(1.0, -1.0), (1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0)].into_iter().enumerate() {
        for step in 0..=steps {
            let turn = corner as f64 - 1.0 + step as f64 / steps as f64;
            let (s, c) = (turn * PI / 2.0).sin_cos();
            outline.push([sx * (hx - radius) + radius * c, sy * (hy - radius) + radius * s]);
        }
    }
    outline
}

/// Returns `outline` (convex, counter-clockwise) with every side moved inwards by `distance`.
fn inset(outline: &[Point2], distance: f64) -> Vec<Point2> {
    let count = outline.len();
    let direction = |from: Point2, to: Point2| {
        let (x, y) = (to[0] - from[0], to[1] - from[1]);
        let length = x.hypot(y);
        [x / length, y / length]
    };
    (0..count)
        .map(|i| {
            let d = direction(outline[(i + count - 1) % count], outline[i]);
            let e = direction(outline[i], outline[(i + 1) % count]);
            // The mitre: the sum of both inward normals, scaled to move both sides by `distance`.
            let scale = distance / (1.0 + d[0] * e[0] + d[1] * e[1]);
            [outline[i][0] - scale * (d[1] + e[1]), outline[i][1] + scale * (d[0] + e[0])]
        })
        .collect()
}

/// Returns twice the signed area of triangle `abc`: positive if counter-clockwise.
fn turn(a: Point2, b: Point2, c: Point2) -> f64 {
    (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
}

/// Triangulates a simple counter-clockwise polygon by ear clipping. The ear with the shortest cut goes first, which
/// avoids slivers.
fn triangulate(outline: &[Point2]) -> Vec<[usize; 3]> {
    /// Smallest area of a corner, m².
    const FLAT: f64 = 1e-13;
    /// Smallest difference in length that makes a cut preferable, m, so that rounding does not choose between equal
    /// cuts.
    const TIE: f64 = 1e-9;

    let mut left: Vec<usize> = (0..outline.len()).collect();
    let mut triangles = Vec::new();
    while left.len() > 3 {
        let count = left.len();
        let mut best: Option<(usize, f64)> = None;
        for i in 0..count {
            let ear = [left[(i + count - 1) % count], left[i], left[(i + 1) % count]];
            let [a, b, c] = ear.map(|index| outline[index]);
            let blocked = turn(a, b, c) <= FLAT
                || left
                    .iter()
                    .filter(|index| !ear.contains(index))
                    .map(|index| outline[*index])
                    .any(|p| turn(a, b, p) >= -FLAT && turn(b, c, p) >= -FLAT && turn(c, a, p) >= -FLAT);
            let cut = (c[0] - a[0]).hypot(c[1] - a[1]);
            if !blocked && best.is_none_or(|(_, shortest)| cut < shortest - TIE) {
                best = Some((i, cut));
            }
        }
        let Some((i, _)) = best else {
            // Not a simple polygon; a test checks that solids are closed.
            return triangles;
        };
        triangles.push([left[(i + count - 1) % count], left[i], left[(i + 1) % count]]);
        left.remove(i);
    }
    triangles.push([left[0], left[1], left[2]]);
    triangles
}
