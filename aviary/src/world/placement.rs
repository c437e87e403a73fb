//! Free space around drones: collision cylinders and their clearance from the floor, from obstacles and from each
//! other.

use flight::clearance::{self, sphere_clearance};
use nalgebra::Vector3;

use super::Obstacle;
use crate::drone::DroneParams;
use crate::math::ToFlight as _;
use crate::state::DroneState;

/// Collision cylinder of a drone, centred on the body, with its axis along body z.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct CollisionCylinder(pub clearance::CollisionCylinder);

impl From<&DroneParams> for CollisionCylinder {
    fn from(params: &DroneParams) -> Self {
        Self(clearance::CollisionCylinder { radius: params.collision_radius, height: params.collision_height })
    }
}

impl CollisionCylinder {
    /// Returns the radius of the bounding sphere of the cylinder, m.
    pub(crate) fn bounding_radius(&self) -> f64 {
        self.0.radius.hypot(0.5 * self.0.height)
    }

    /// Returns the depth of the lowest point of the cylinder below its centre at a tilt (rad), m.
    ///
    /// [`floor_clearance`](Self::floor_clearance) computes the sine by a square root. The last bits of both differ;
    /// random starts on the floor use this function, so that recorded starts stay bit-identical.
    pub(crate) fn depth_at_tilt(&self, tilt: f64) -> f64 {
        self.0.depth(tilt.cos(), tilt.sin())
    }

    /// Returns the height of the lowest point of the cylinder above the floor, m; negative below the floor.
    pub(crate) fn floor_clearance(&self, state: &DroneState) -> f64 {
        self.0.floor_clearance(state.position.z, state.up().z)
    }

    /// Returns a bound of the rounding error of MuJoCo's contact points with the floor, m, for body z in the world
    /// frame.
    ///
    /// MuJoCo divides a rounded difference by the sine of the tilt, unless it is below 1e-15. The error is a micrometre
    /// at a tilt of 1e-10 rad and the radius at 1e-15 rad.
    pub(crate) fn rounding_of_contacts(&self, up: &Vector3<f64>) -> f64 {
        let sine = up.x.hypot(up.y);
        if sine < 5e-16 { 0.0 } else { self.0.radius * (2e-15 / sine).min(1.0) }
    }

    /// Returns true if two upright cylinders overlap, at an offset of their centres of `apart`, m.
    pub(crate) fn overlaps_upright(&self, other: &Self, apart: &Vector3<f64>) -> bool {
        let (one, two) = (&self.0, &other.0);
        apart.xy().norm() < one.radius + two.radius && apart.z.abs() < 0.5 * (one.height + two.height)
    }

    /// Returns true if the bounding sphere of the cylinder at a position (world frame, m) meets no obstacle and no
    /// bounding sphere of another cylinder.
    pub(crate) fn has_room(
        &self,
        position: &Vector3<f64>,
        mut others: impl Iterator<Item = (Vector3<f64>, Self)>,
        obstacles: &[Obstacle],
    ) -> bool {
        let (place, radius) = (position.to_flight(), self.bounding_radius());
        others.all(|(other, cylinder)| {
            let gap: f64 = sphere_clearance(place, radius, other.to_flight(), cylinder.bounding_radius());
            gap > 0.0
        }) && obstacle_distance(obstacles, position) > radius
    }
}

/// Returns the largest radius of the collision cylinders, m.
pub(crate) fn max_collision_radius<'a>(drones: impl IntoIterator<Item = &'a DroneParams>) -> f64 {
    drones.into_iter().map(|params| params.collision_radius).fold(0.0, f64::max)
}

/// Returns the distance of a point (world frame, m) from the surface of the nearest obstacle, m; negative inside an
/// obstacle, infinite without obstacles.
pub(crate) fn obstacle_distance(obstacles: &[Obstacle], point: &Vector3<f64>) -> f64 {
    obstacles.iter().map(|obstacle| obstacle.distance(point)).fold(f64::INFINITY, f64::min)
}

/// Returns true if no drone in these states meets the floor, another drone or an obstacle.
pub(crate) fn have_room(
    cylinder: impl Fn(usize) -> CollisionCylinder,
    states: &[DroneState],
    obstacles: &[Obstacle],
) -> bool {
    states.iter().enumerate().all(|(drone, state)| {
        let others = (0..drone).map(|other| (states[other].position, cylinder(other)));
        let own = cylinder(drone);
        own.floor_clearance(state) >= 0.0 && own.has_room(&state.position, others, obstacles)
    })
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_PI_2, FRAC_PI_4, PI};

    use super::*;
    use crate::world::Shape;

    const CYLINDER: CollisionCylinder = CollisionCylinder(clearance::CollisionCylinder { radius: 0.06, height: 0.03 });

    fn at(z: f64, roll: f64) -> DroneState {
        DroneState::at_rest(Vector3::new(0.0, 0.0, z), Vector3::new(roll, 0.0, 0.4))
    }

    #[test]
    fn the_bounding_radius_is_the_distance_from_the_centre_to_a_rim() {
        // 60 mm sideways and half of 30 mm upwards
        assert!((CYLINDER.bounding_radius() - 0.061_846_584).abs() < 1e-9);
    }

    #[test]
    fn the_lowest_point_is_that_of_the_tilted_cylinder() {
        let diagonal = (0.06 + 0.015) * FRAC_PI_4.sin();
        for (tilt, depth) in [(0.0, 0.015), (FRAC_PI_2, 0.06), (PI, 0.015), (FRAC_PI_4, diagonal)] {
            assert!((CYLINDER.depth_at_tilt(tilt) - depth).abs() < 1e-15, "{tilt}");
            assert!((CYLINDER.floor_clearance(&at(0.5, tilt)) - (0.5 - depth)).abs() < 1e-9, "{tilt}");
        }
        // no point of the rims is lower than the result, and one is at its height
        let state = DroneState::at_rest(Vector3::new(0.3, -0.2, 1.0), Vector3::new(0.7, -0.4, 2.0));
        let rim = |i: u32| {
            let (sin, cos) = (f64::from(i) * 1e-3).sin_cos();
            [0.015, -0.015].map(|z| (state.position + state.attitude * Vector3::new(0.06 * cos, 0.06 * sin, z)).z)
        };
        let lowest = (0..6284).flat_map(rim).fold(f64::INFINITY, f64::min);
        assert!((lowest - CYLINDER.floor_clearance(&state)).abs() < 1e-7);
    }

    /// The bound of batches is never below that of single environments, and zero for a level drone.
    #[test]
    fn the_coarse_bound_of_the_rounding_of_contacts_is_an_upper_bound() {
        for k in 0..4000 {
            let (sine, yaw) = (10_f64.powf(-18.0 + f64::from(k) * 0.0045), f64::from(k));
            let up = Vector3::new(sine * yaw.cos(), sine * yaw.sin(), 1.0);
            let (bound, coarse) =
                (CYLINDER.rounding_of_contacts(&up), CYLINDER.0.coarse_rounding_of_contacts(up.to_flight()));
            assert!(bound <= coarse && coarse <= CYLINDER.0.radius, "{sine} {bound} {coarse}");
        }
        assert_eq!(CYLINDER.0.coarse_rounding_of_contacts(Vector3::z().to_flight()), 0.0);
    }

    #[test]
    fn the_bounding_spheres_of_drones_and_obstacles_must_not_meet() {
        let sphere = CYLINDER.bounding_radius();
        let pair = |x: f64| [at(1.0, 0.0), DroneState { position: Vector3::new(x, 0.0, 1.0), ..at(1.0, 0.0) }];
        let wall = Obstacle::new(Shape::Box { half_size: [0.1, 1.0, 1.0] }, Vector3::new(-1.0, 0.0, 1.0));
        for (x, free) in [(2.0 * sphere - 1e-6, false), (2.0 * sphere + 1e-6, true), (sphere - 0.9 - 1e-6, false)] {
            assert_eq!(have_room(|_| CYLINDER, &pair(x), &[wall]), free, "{x}");
        }
        for (z, free) in [(0.015 - 1e-6, false), (0.015, true)] {
            assert_eq!(have_room(|_| CYLINDER, &[at(z, 0.0)], &[]), free, "{z}");
        }
    }

    #[test]
    fn upright_drones_may_start_close_above_each_other() {
        for (apart, overlap) in [([0.0, 0.0, 0.031], false), ([0.0, 0.0, 0.029], true), ([0.121, 0.0, 0.0], false)] {
            assert_eq!(CYLINDER.overlaps_upright(&CYLINDER, &apart.into()), overlap, "{apart:?}");
        }
    }
}
