//! Shapes that are added to a scene until its next update.

use mujoco_rs::Decor;
use nalgebra::Vector3;

use super::SceneRenderer;

impl SceneRenderer {
    /// Adds a shape to the scene until the next update. The components of `rgba` are from 0 to 1. Returns false if
    /// the scene has no room.
    pub fn add(&mut self, decor: Decor, rgba: [f32; 4]) -> bool {
        self.scene.add(decor, rgba)
    }

    /// Adds a line through points (world frame, m) with a radius in m until the next update. Returns false if the
    /// scene has no room for the whole line.
    pub fn add_line(&mut self, points: &[Vector3<f64>], radius: f64, rgba: [f32; 4]) -> bool {
        let rod = |pair: &[Vector3<f64>]| Decor::Rod { from: pair[0].into(), to: pair[1].into(), radius };
        points.windows(2).all(|pair| self.add(rod(pair), rgba))
    }

    /// Adds a thin line through points (world frame, m) until the next update. Its width is in pixels at any
    /// distance from the camera. Returns false if the scene has no room for the whole line. A thin line is much
    /// faster than [`add_line`](Self::add_line).
    pub fn add_thread(&mut self, points: &[Vector3<f64>], width: f64, rgba: [f32; 4]) -> bool {
        let line = |pair: &[Vector3<f64>]| Decor::Line { from: pair[0].into(), to: pair[1].into(), width };
        points.windows(2).all(|pair| self.add(line(pair), rgba))
    }

    /// Adds a sphere at every point (world frame, m) with a radius in m until the next update. Returns false if the
    /// scene has no room for all spheres.
    pub fn add_dots(&mut self, points: &[Vector3<f64>], radius: f64, rgba: [f32; 4]) -> bool {
        points.iter().all(|&point| self.add(Decor::Sphere { centre: point.into(), radius }, rgba))
    }

    /// Adds a ring around a point (world frame, m), perpendicular to `axis`, until the next update. `radius` and
    /// `thickness` are in m. Returns false if the scene has no room for the whole ring.
    pub fn add_ring(
        &mut self,
        centre: Vector3<f64>,
        axis: Vector3<f64>,
        radius: f64,
        thickness: f64,
        rgba: [f32; 4],
    ) -> bool {
        self.add_line(&ring(centre, axis, radius), 0.5 * thickness, rgba)
    }

    /// Adds an upright square gate around a point (world frame, m) until the next update. Drones fly through the
    /// gate along `yaw` (rad). `reach` is the distance from its centre to the middle of each bar, m. Returns false
    /// if the scene has no room for the whole gate.
    pub fn add_gate(&mut self, centre: Vector3<f64>, yaw: f64, reach: f64, rgba: [f32; 4]) -> bool {
        let left = Vector3::new(-yaw.sin(), yaw.cos(), 0.0);
        let corner = |side: f64, up: f64| centre + reach * (side * left + up * Vector3::z());
        let frame = [corner(1.0, 1.0), corner(-1.0, 1.0), corner(-1.0, -1.0), corner(1.0, -1.0), corner(1.0, 1.0)];
        self.add_line(&frame, 0.06 * reach, rgba)
    }
}

/// Returns the points of a closed ring around a point, perpendicular to an axis; empty if the axis is zero.
pub(crate) fn ring(centre: Vector3<f64>, axis: Vector3<f64>, radius: f64) -> Vec<Vector3<f64>> {
    const CORNERS: u32 = 40;
    let aside = if axis.x.abs() < 0.9 * axis.norm() { Vector3::x() } else { Vector3::y() };
    let Some(u) = axis.cross(&aside).try_normalize(1e-12) else { return Vec::new() };
    let Some(v) = axis.cross(&u).try_normalize(1e-12) else { return Vec::new() };
    let corner = |i: u32| {
        let (sin, cos) = (std::f64::consts::TAU * f64::from(i) / f64::from(CORNERS)).sin_cos();
        centre + radius * (cos * u + sin * v)
    };
    (0..=CORNERS).map(corner).collect()
}
