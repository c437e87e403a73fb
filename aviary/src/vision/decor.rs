//! Shapes that are added to a scene until its next update.

use mujoco_rs::Decor;
use nalgebra::Vector3;

use super::SceneRenderer;

impl SceneRenderer {
    /// Adds a shape to the scene until the next update, in red, green, blue and alpha from 0 to 1; `false` where there is no
    /// room.
    pub fn add(&mut self, decor: Decor, rgba: [f32; 4]) -> bool {
        self.scene.add(decor, rgba)
    }

    /// Adds a line through points (world frame, m), of a radius in m, until the next update; `false` where there is no room
    /// for all of it.
    pub fn add_line(&mut self, points: &[Vector3<f64>], radius: f64, rgba: [f32; 4]) -> bool {
        let rod = |pair: &[Vector3<f64>]| Decor::Rod { from: pair[0].into(), to: pair[1].into(), radius };
        points.windows(2).all(|pair| self.add(rod(pair), rgba))
    }

    /// Adds a thread through points (world frame, m), so many pixels wide from wherever it is seen, until the next update;
    /// `false` where there is no room for all of it. It costs much less than a line of rods.
    pub fn add_thread(&mut self, points: &[Vector3<f64>], width: f64, rgba: [f32; 4]) -> bool {
        let line = |pair: &[Vector3<f64>]| Decor::Line { from: pair[0].into(), to: pair[1].into(), width };
        points.windows(2).all(|pair| self.add(line(pair), rgba))
    }

    /// Adds a dot at every point (world frame, m), of a radius in m, until the next update; `false` where there is no room
    /// for all of them.
    pub fn add_dots(&mut self, points: &[Vector3<f64>], radius: f64, rgba: [f32; 4]) -> bool {
        points.iter().all(|&point| self.add(Decor::Sphere { centre: point.into(), radius }, rgba))
    }

    /// Adds a ring about a point (world frame, m) across an axis, with a radius and a thickness in m, until the next update;
    /// `false` where there is no room for all of it.
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

    /// Adds a square gate that stands upright about a point (world frame, m) and is flown through along a yaw (rad); `reach` m
    /// from its middle to the middle of each bar. It stays until the next update; `false` where there is no room.
    pub fn add_gate(&mut self, centre: Vector3<f64>, yaw: f64, reach: f64, rgba: [f32; 4]) -> bool {
        let left = Vector3::new(-yaw.sin(), yaw.cos(), 0.0);
        let corner = |side: f64, up: f64| centre + reach * (side * left + up * Vector3::z());
        let frame = [corner(1.0, 1.0), corner(-1.0, 1.0), corner(-1.0, -1.0), corner(1.0, -1.0), corner(1.0, 1.0)];
        self.add_line(&frame, 0.06 * reach, rgba)
    }
}

/// Points of a closed ring about a point across an axis; none where the axis has no direction.
pub(crate) fn ring(centre: Vector3<f64>, axis: Vector3<f64>, radius: f64) -> Vec<Vector3<f64>> {
    const CORNERS: u32 = 40;
    // any direction across the axis will do
    let aside = if axis.x.abs() < 0.9 * axis.norm() { Vector3::x() } else { Vector3::y() };
    let Some(u) = axis.cross(&aside).try_normalize(1e-12) else { return Vec::new() };
    let Some(v) = axis.cross(&u).try_normalize(1e-12) else { return Vec::new() };
    let corner = |i: u32| {
        let (sin, cos) = (std::f64::consts::TAU * f64::from(i) / f64::from(CORNERS)).sin_cos();
        centre + radius * (cos * u + sin * v)
    };
    (0..=CORNERS).map(corner).collect()
}
