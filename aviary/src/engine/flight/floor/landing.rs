use ::flight::body::FreeBody;
use pulp::Simd;

use super::super::contact_solver::{FloorPoints, PerEdge, PointContact, PointContacts, Problem, Spatial, solve};
use super::super::floor_model::{Cylinder, FloorContact};
use super::StepKind;
use super::attitude::{is_upright, matrix, normalized, renormalized, turned};
use super::rim::RimPoints;
use crate::engine::{Body, Load};
use crate::math::{ToFlight as _, V3};
use crate::state::{DroneState, attitude_from_wxyz, wxyz};

/// Largest acceleration (m/s² and rad/s²) that MuJoCo accepts.
const MAX_ACCELERATION: f64 = 1e10;

/// A drone in a step.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Landing {
    forces: Forces,
    start: Motion,
    stage: Motion,
    /// Weighted sums of the stages' velocities and accelerations.
    velocity_sum: Spatial,
    acceleration_sum: Spatial,
    /// Rotation matrix of the stage, by rows.
    matrix: [[f64; 3]; 3],
    /// Acceleration without contacts: linear in the world frame, angular in the body frame.
    pub smooth: Spatial,
    /// Acceleration of the last stage.
    pub warm_start: Spatial,
    /// Number of contact points of the stage.
    pub points: usize,
    /// Residuals of the edges at the last stage with one point.
    edges: PerEdge,
    /// Square of the largest distance of a stage from the start, m².
    travel_squared: f64,
}

/// Accelerations and torque on a drone that are constant during a step.
#[derive(Debug, Clone, Copy, Default)]
struct Forces {
    /// Acceleration, world frame, m/s²; without the thrust if it rotates with the body.
    linear: [f64; 3],
    /// Acceleration by the thrust, along body z, m/s².
    lift: f64,
    /// Torque of the rotors, N·m, in the frame in which it is constant.
    torque: [f64; 3],
}

/// Pose and velocity: the numbers of MuJoCo's `qpos` and `qvel`.
#[derive(Debug, Clone, Copy, Default)]
struct Motion {
    position: [f64; 3],
    quaternion: [f64; 4],
    /// Linear velocity in the world frame, angular velocity in the body frame.
    velocity: Spatial,
}

impl Landing {
    /// Starts a step. The warm start has six numbers.
    #[inline(always)]
    pub(super) fn new(kind: &StepKind, body: &Body, load: &Load, state: &DroneState, warm_start: &[f64]) -> Self {
        let FreeBody { inverse_mass, gravity, .. } = body.free.0;
        let (force, torque) = (load.external.force_world.to_flight(), load.rotors.torque_body.to_flight());
        let (force, torque) = if kind.body_fixed {
            (force, torque)
        } else {
            let start = state.attitude.to_flight();
            (force + start.up() * load.rotors.thrust, start.forth(torque))
        };
        let linear = force * inverse_mass;
        let forces = Forces {
            linear: [linear.x, linear.y, linear.z - gravity],
            lift: load.rotors.thrust * inverse_mass,
            torque: [torque.x, torque.y, torque.z],
        };
        let ([x, y, z], [a, b, c]) = (state.velocity.into(), state.angular_velocity.into());
        let stage =
            Motion { position: state.position.into(), quaternion: wxyz(&state.attitude), velocity: [x, y, z, a, b, c] };
        let start = Motion { quaternion: renormalized(stage.quaternion), ..stage };
        let mut landing = Self { forces, start, stage, ..Self::default() };
        landing.warm_start.copy_from_slice(warm_start);
        landing
    }

    /// Computes the rotation matrix of the stage and the acceleration without contacts.
    #[inline(always)]
    pub(super) fn find_smooth(&mut self, kind: &StepKind, body: &Body) {
        let quaternion = self.stage.quaternion;
        // MuJoCo normalizes `qpos`, and once more the attitude of the body
        self.matrix = matrix(&if is_upright(&quaternion) { normalized(normalized(quaternion)) } else { quaternion });
        let Forces { linear: [x, y, z], lift, torque: [a, b, c] } = self.forces;
        let [vx, vy, vz, wx, wy, wz] = self.stage.velocity;
        let (mut linear, mut torque) = (V3::new(x, y, z), V3::new(a, b, c));
        if kind.body_fixed {
            let [[_, _, x], [_, _, y], [_, _, z]] = self.matrix;
            linear = linear + V3::new(x, y, z) * lift;
        } else {
            torque = self.back(torque);
        }
        if kind.medium {
            linear = linear + self.forth(body.free.0.fluid.slowing(self.back(V3::new(vx, vy, vz))));
        }
        let rate = V3::new(wx, wy, wz);
        let angular = if kind.medium {
            body.free.0.angular_acceleration::<true>(torque, rate)
        } else {
            body.free.0.angular_acceleration::<false>(torque, rate)
        };
        self.smooth = [linear.x, linear.y, linear.z, angular.x, angular.y, angular.z];
    }

    #[inline(always)]
    pub(super) fn rim(&self, cylinder: &Cylinder) -> RimPoints {
        RimPoints::new(cylinder, self.stage.position[2], &self.matrix)
    }

    /// Returns the acceleration of a drone that is alone in its world.
    #[inline(always)]
    pub(super) fn solve_alone<S: Simd>(
        &mut self,
        simd: S,
        contact: &FloorContact,
        cylinder: &Cylinder,
        body: &Body,
        problem: &mut Problem,
    ) -> Spatial {
        let rim = self.rim(cylinder);
        let previous = std::mem::replace(&mut self.points, rim.count());
        if self.points == 0 {
            return self.smooth;
        }
        if self.points == 1
            && let Some(acceleration) = self.solve_point(contact, body, &rim, previous)
        {
            return acceleration;
        }
        self.solve_points(simd, contact, body, &rim.points(cylinder.radius), problem)
    }

    /// Solves for the acceleration of a drone that touches the floor at one point. `previous` is the number of points
    /// in the previous stage. Returns `None` if MuJoCo may stop before the minimum.
    #[inline(always)]
    fn solve_point(
        &mut self,
        contact: &FloorContact,
        body: &Body,
        rim: &RimPoints,
        previous: usize,
    ) -> Option<Spatial> {
        let FloorContact { solver, stiffness, damping, impedance } = contact;
        let (height, arm) = rim.lowest();
        let [r0, r1, r2] = &self.matrix;
        let (x, y, z) = (V3::new(r0[0], r1[0], r2[0]), V3::new(r0[1], r1[1], r2[1]), V3::new(r0[2], r1[2], r2[2]));
        let levers = [x.cross(arm), y.cross(arm), z.cross(arm)];
        let impedance = impedance.at(-height);
        let push = stiffness * impedance * height;
        let speeds = PointContact::along_edges(solver.friction, PointContact::of_point(&levers, &self.stage.velocity));
        let mut reference = speeds;
        for reference in &mut reference {
            *reference = -damping * *reference - push;
        }
        let FreeBody { inverse_mass, inverse_inertia: [x, y, z], .. } = body.free.0;
        let point = PointContact {
            inertia: inertia(body),
            inverse_inertia: [inverse_mass, inverse_mass, inverse_mass, x, y, z],
            levers,
            weight: contact.weight(impedance, inverse_mass),
            reference,
        };
        if previous != 1 {
            self.edges = point.residuals(solver.friction, &self.warm_start);
        }
        point.solve(solver, &self.smooth, &self.warm_start, &mut self.edges)
    }

    /// Returns the acceleration of a drone that touches the floor at these points.
    #[inline(always)]
    fn solve_points<S: Simd>(
        &mut self,
        simd: S,
        contact: &FloorContact,
        body: &Body,
        points: &FloorPoints,
        problem: &mut Problem,
    ) -> Spatial {
        let (solver, smooth, warm_start) = (&contact.solver, &self.smooth, &self.warm_start);
        let contacts = PointContacts::new(simd, contact, inertia(body), &self.matrix, &self.stage.velocity, points);
        if let Some(acceleration) = contacts.solve(solver, smooth, warm_start) {
            return acceleration;
        }
        self.find_contacts(contact, body, points, problem);
        self.pose_problem(body, problem);
        solve(solver, std::slice::from_mut(problem));
        self.in_body_frame(&problem.acceleration)
    }

    /// Finds the weights and reference accelerations of the edges of all contact points.
    #[inline(always)]
    pub(super) fn find_contacts(
        &self,
        contact: &FloorContact,
        body: &Body,
        points: &FloorPoints,
        problem: &mut Problem,
    ) {
        problem.set_points(points);
        let heights = &points.height;
        let [vx, vy, vz, wx, wy, wz] = self.stage.velocity;
        let rate = self.forth(V3::new(wx, wy, wz));
        let speeds = problem.along_edges(contact.solver.friction, &[vx, vy, vz, rate.x, rate.y, rate.z]);
        for point in 0..problem.points {
            let impedance = contact.impedance.at(-heights[point]);
            problem.weight[point] = contact.weight(impedance, body.free.0.inverse_mass);
            for (reference, speeds) in problem.reference.iter_mut().zip(&speeds) {
                reference[point] = -contact.damping * speeds[point] - contact.stiffness * impedance * heights[point];
            }
        }
    }

    /// Sets inertia and accelerations of the problem.
    #[inline(always)]
    pub(super) fn pose_problem(&self, body: &Body, problem: &mut Problem) {
        let [jx, jy, jz] = body.inertia.into();
        let [r0, r1, r2] = &self.matrix;
        let product = |a: &[f64; 3], b: &[f64; 3]| jx * (a[0] * b[0]) + jy * (a[1] * b[1]) + jz * (a[2] * b[2]);
        problem.mass = body.mass;
        problem.inertia =
            [product(r0, r0), product(r1, r1), product(r2, r2), product(r0, r1), product(r0, r2), product(r1, r2)];
        problem.smooth = self.in_world_frame(&self.smooth);
        problem.acceleration = self.in_world_frame(&self.warm_start);
    }

    /// Rotates the angular part from the body to the world frame.
    #[inline(always)]
    fn in_world_frame(&self, motion: &Spatial) -> Spatial {
        let [x, y, z, a, b, c] = *motion;
        let angular = self.forth(V3::new(a, b, c));
        [x, y, z, angular.x, angular.y, angular.z]
    }

    /// Rotates the angular part from the world to the body frame.
    #[inline(always)]
    pub(super) fn in_body_frame(&self, motion: &Spatial) -> Spatial {
        let [x, y, z, a, b, c] = *motion;
        let angular = self.back(V3::new(a, b, c));
        [x, y, z, angular.x, angular.y, angular.z]
    }

    #[inline(always)]
    fn forth(&self, v: V3<f64>) -> V3<f64> {
        let [a, b, c] = &self.matrix;
        let row = |row: &[f64; 3]| row[0] * v.x + row[1] * v.y + row[2] * v.z;
        V3::new(row(a), row(b), row(c))
    }

    #[inline(always)]
    fn back(&self, v: V3<f64>) -> V3<f64> {
        let [a, b, c] = &self.matrix;
        let column = |i: usize| a[i] * v.x + b[i] * v.y + c[i] * v.z;
        V3::new(column(0), column(1), column(2))
    }

    /// Adds the acceleration of the stage, and moves to the next stage. Returns false if the acceleration is beyond
    /// MuJoCo's limit.
    #[inline(always)]
    pub(super) fn accept(&mut self, stage: usize, dt: f64, acceleration: &Spatial) -> bool {
        /// Weights of the stages, and steps to the next one (`mj_RungeKutta`).
        const WEIGHTS: [f64; 4] = [1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0];
        const STEPS: [f64; 3] = [0.5, 0.5, 1.0];
        if !acceleration.iter().all(|x| x.abs() < MAX_ACCELERATION) {
            return false;
        }
        self.warm_start = *acceleration;
        let weight = WEIGHTS[stage];
        for (sum, velocity) in self.velocity_sum.iter_mut().zip(&self.stage.velocity) {
            *sum += velocity * weight;
        }
        for (sum, acceleration) in self.acceleration_sum.iter_mut().zip(acceleration) {
            *sum += acceleration * weight;
        }
        let Some(&step) = STEPS.get(stage) else { return true };
        let (mut by, mut gained) = (self.stage.velocity, *acceleration);
        for (by, gained) in by.iter_mut().zip(&mut gained) {
            *by *= step;
            *gained *= step;
        }
        self.stage = self.start.moved(&by, &gained, dt);
        let distance = dt * dt * (by[0] * by[0] + by[1] * by[1] + by[2] * by[2]);
        self.travel_squared = self.travel_squared.max(distance);
        true
    }

    /// Returns true if all stages were within a distance (m) from the start.
    #[inline(always)]
    pub(super) fn is_within(&self, room: f64) -> bool {
        self.travel_squared < room * room
    }

    /// Returns the state at the end of the step.
    #[inline(always)]
    pub(super) fn end(&self, dt: f64) -> DroneState {
        let end = self.start.moved(&self.velocity_sum, &self.acceleration_sum, dt);
        let [x, y, z, a, b, c] = end.velocity;
        DroneState {
            position: end.position.into(),
            attitude: attitude_from_wxyz(renormalized(end.quaternion)),
            velocity: [x, y, z].into(),
            angular_velocity: [a, b, c].into(),
        }
    }
}

impl Motion {
    /// Returns the motion after a time at these velocities and accelerations (`mj_integratePos`).
    #[inline(always)]
    fn moved(&self, velocity: &Spatial, acceleration: &Spatial, time: f64) -> Self {
        let mut end = *self;
        for (position, velocity) in end.position.iter_mut().zip(velocity) {
            *position += time * velocity;
        }
        for (velocity, acceleration) in end.velocity.iter_mut().zip(acceleration) {
            *velocity += acceleration * time;
        }
        end.quaternion = turned(&self.quaternion, [velocity[3], velocity[4], velocity[5]], time);
        end
    }
}

/// Returns mass (kg) and moments of inertia (kg·m²) of the six accelerations.
#[inline(always)]
fn inertia(body: &Body) -> Spatial {
    let [x, y, z] = body.inertia.into();
    [body.mass, body.mass, body.mass, x, y, z]
}
