//! One physics step of drones that touch nothing but the floor, as `mj_step` computes it.
//!
//! Each of the four stages of RK4 finds the contacts at the poses of the stage and solves for the accelerations.
//! Poses and contact points repeat MuJoCo's operations in their order: MuJoCo divides a difference of numbers close
//! to one by the sine of the tilt to find the lowest point of a rim. The rounding of a nearly upright attitude
//! therefore decides about micrometres.

use super::FreeBody;
use super::contact_solver::{POINTS, Problem, Spatial, solve};
use super::floor_model::{Cylinder, FloorContact, FloorModel};
use crate::engine::{Body, Load};
use crate::math::{MAX_HALF_ANGLE_SQUARED, Turn, V3, half_angle};
use crate::state::{DroneState, attitude_from_wxyz, wxyz};

/// Largest acceleration (m/s² and rad/s²) that MuJoCo accepts.
const MAX_ACCELERATION: f64 = 1e10;

/// Smallest norm that MuJoCo divides by.
const MIN_NORM: f64 = 1e-15;

/// Range of the ratio of mass times squared size to a moment of inertia, about 2 to 20 for a solid cylinder. Outside of
/// it the rounding of the solver decides about more than 1e-8 of a state.
const SHAPES: std::ops::RangeInclusive<f64> = 1e-3..=1e3;

/// Time step of a world, and what distinguishes the equations of motion of worlds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct StepKind {
    /// Time step, s.
    pub dt: f64,
    /// True if the rotors' wrench rotates with the body during a step.
    pub body_fixed: bool,
    /// True if there is a medium.
    pub medium: bool,
}

/// Steps of drones on the floor of one world, with scratch memory.
#[derive(Debug, Clone)]
pub(crate) struct FloorKernel {
    model: FloorModel,
    drones: Vec<Landing>,
    problems: Vec<Problem>,
}

/// A drone in a step.
#[derive(Debug, Clone, Copy, Default)]
struct Landing {
    start: Motion,
    stage: Motion,
    /// Weighted sums of the stages' velocities and accelerations.
    velocity_sum: Spatial,
    acceleration_sum: Spatial,
    /// Rotation matrix of the stage, by rows.
    matrix: [[f64; 3]; 3],
    /// Acceleration without contacts: linear in the world frame, angular in the body frame.
    smooth: Spatial,
    /// Acceleration of the last stage.
    warm_start: Spatial,
    /// Square of the largest distance of a stage from the start, m².
    travel_squared: f64,
}

/// Pose and velocity: the numbers of MuJoCo's `qpos` and `qvel`.
#[derive(Debug, Clone, Copy, Default)]
struct Motion {
    position: [f64; 3],
    quaternion: [f64; 4],
    /// Linear velocity in the world frame, angular velocity in the body frame.
    velocity: Spatial,
}

impl FloorKernel {
    /// Creates the kernel of a world with this contact model.
    pub(crate) fn new(model: FloorModel) -> Self {
        let drones = model.cylinders.len();
        Self { model, drones: vec![Landing::default(); drones], problems: vec![Problem::default(); drones] }
    }

    /// Computes one physics step. `rooms` are the distances (m) within which drones touch nothing but the floor.
    ///
    /// `warm_starts` has the accelerations of the last stage of the previous step, six numbers per drone (linear in
    /// the world frame, angular in the body frame), and receives those of this step, like MuJoCo's `qacc_warmstart`.
    /// The result depends on no other memory.
    ///
    /// Returns false, with unchanged states and warm starts, if MuJoCo must compute the step: an acceleration is beyond
    /// MuJoCo's limit, a stage is outside of its room, or the inertia is outside of [`SHAPES`].
    pub(crate) fn step(
        &mut self,
        kind: &StepKind,
        bodies: &[Body],
        loads: &[Load],
        states: &mut [DroneState],
        rooms: &[f64],
        warm_starts: &mut [f64],
    ) -> bool {
        match (kind.body_fixed, kind.medium) {
            (false, false) => self.step_of_kind::<false, false>(kind.dt, bodies, loads, states, rooms, warm_starts),
            (false, true) => self.step_of_kind::<false, true>(kind.dt, bodies, loads, states, rooms, warm_starts),
            (true, false) => self.step_of_kind::<true, false>(kind.dt, bodies, loads, states, rooms, warm_starts),
            (true, true) => self.step_of_kind::<true, true>(kind.dt, bodies, loads, states, rooms, warm_starts),
        }
    }

    fn step_of_kind<const BODY_FIXED: bool, const MEDIUM: bool>(
        &mut self,
        dt: f64,
        bodies: &[Body],
        loads: &[Load],
        states: &mut [DroneState],
        rooms: &[f64],
        warm_starts: &mut [f64],
    ) -> bool {
        let Self { model, drones, problems } = self;
        let contact = &model.contact;
        if !model.cylinders.iter().zip(bodies).all(|(cylinder, body)| is_regular(cylinder, body)) {
            return false;
        }
        for ((drone, state), warm_start) in drones.iter_mut().zip(&*states).zip(warm_starts.as_chunks().0) {
            *drone = Landing::new(state, warm_start);
        }
        for stage in 0..4 {
            let mut touching = false;
            for (index, (drone, problem)) in drones.iter_mut().zip(&mut *problems).enumerate() {
                let (body, load) = (&bodies[index], &loads[index]);
                drone.find_smooth::<BODY_FIXED, MEDIUM>(body, load, &states[index]);
                drone.find_contacts(contact, &model.cylinders[index], body, problem);
                touching |= problem.points > 0;
            }
            if touching {
                for (index, (drone, problem)) in drones.iter().zip(&mut *problems).enumerate() {
                    drone.pose_problem(&bodies[index], problem);
                }
                solve(&contact.solver, problems);
            }
            for (drone, problem) in drones.iter_mut().zip(&*problems) {
                let acceleration = if touching { drone.in_body_frame(&problem.acceleration) } else { drone.smooth };
                if !acceleration.iter().all(|x| x.abs() < MAX_ACCELERATION) {
                    return false;
                }
                drone.warm_start = acceleration;
                drone.advance(stage, dt, &acceleration);
            }
        }
        let in_room = |(drone, room): (&Landing, &f64)| drone.travel_squared < room * room;
        if !drones.iter().zip(rooms).all(in_room) {
            return false;
        }
        for ((drone, state), warm_start) in drones.iter().zip(states).zip(warm_starts.as_chunks_mut().0) {
            *state = drone.end(dt);
            *warm_start = drone.warm_start;
        }
        true
    }

    /// Returns the number of contact points of each drone in the last stage of the last step.
    pub(crate) fn points(&self) -> impl Iterator<Item = usize> {
        self.problems.iter().map(|problem| problem.points)
    }
}

impl Landing {
    #[inline(always)]
    fn new(state: &DroneState, warm_start: &Spatial) -> Self {
        let ([x, y, z], [a, b, c]) = (state.velocity.into(), state.angular_velocity.into());
        let stage =
            Motion { position: state.position.into(), quaternion: wxyz(&state.attitude), velocity: [x, y, z, a, b, c] };
        let start = Motion { quaternion: normalized(stage.quaternion), ..stage };
        Self { start, stage, warm_start: *warm_start, ..Self::default() }
    }

    /// Computes the rotation matrix of the stage and the acceleration without contacts.
    #[inline(always)]
    fn find_smooth<const BODY_FIXED: bool, const MEDIUM: bool>(
        &mut self,
        body: &Body,
        load: &Load,
        start: &DroneState,
    ) {
        // MuJoCo normalizes `qpos`, and once more the attitude of the body
        self.matrix = matrix(&normalized(normalized(self.stage.quaternion)));
        let FreeBody { inverse_mass, gravity, .. } = body.free;
        let [vx, vy, vz, wx, wy, wz] = self.stage.velocity;
        let force = V3::from(&load.external.force_world);
        let (force, torque) = if BODY_FIXED {
            let [[_, _, x], [_, _, y], [_, _, z]] = self.matrix;
            (force + V3::new(x, y, z) * load.rotors.thrust, V3::from(&load.rotors.torque_body))
        } else {
            let start = Turn::from(&start.attitude);
            let torque = start.forth(V3::from(&load.rotors.torque_body));
            (force + start.up() * load.rotors.thrust, self.back(torque))
        };
        let mut linear = force * inverse_mass;
        linear.z -= gravity;
        if MEDIUM {
            linear = linear + self.forth(body.free.fluid.slowing(self.back(V3::new(vx, vy, vz))));
        }
        let angular = body.free.angular_acceleration::<MEDIUM>(torque, V3::new(wx, wy, wz));
        self.smooth = [linear.x, linear.y, linear.z, angular.x, angular.y, angular.z];
    }

    /// Finds the contact points of the cylinder with the floor (`mjc_PlaneCylinder`), and the weights and reference
    /// accelerations of their edges.
    #[inline(always)]
    fn find_contacts(&self, contact: &FloorContact, cylinder: &Cylinder, body: &Body, problem: &mut Problem) {
        problem.clear();
        let height = self.stage.position[2];
        let [[x0, _, mut ax], [x1, _, mut ay], [x2, _, mut az]] = self.matrix;
        // the axis points down
        if az > 0.0 {
            (ax, ay, az) = (-ax, -ay, -az);
        }
        // towards the lowest point of the lower rim
        let (mut out_x, mut out_y, mut out_z) = (ax * az, ay * az, az * az - 1.0);
        let length = (out_x * out_x + out_y * out_y + out_z * out_z).sqrt();
        if length >= MIN_NORM {
            let scale = cylinder.radius / length;
            (out_x, out_y, out_z) = (out_x * scale, out_y * scale, out_z * scale);
        } else {
            (out_x, out_y, out_z) = (x0 * cylinder.radius, x1 * cylinder.radius, x2 * cylinder.radius);
        }
        let half = cylinder.half_height;
        let (axis_x, axis_y, axis_z) = (ax * half, ay * half, az * half);
        let mut distances = [0.0; POINTS];
        let mut add = |distance: f64, arm: [f64; 3]| {
            // a touch at a distance of zero is no contact for the solver
            if distance < 0.0 {
                distances[problem.points] = distance;
                let [x, y, z] = arm;
                problem.add_point([x, y, z - 0.5 * distance]);
            }
        };
        let lowest = height + axis_z + out_z;
        if lowest.is_nan() || lowest > 0.0 {
            return;
        }
        add(lowest, [out_x + axis_x, out_y + axis_y, out_z + axis_z]);
        add(height - axis_z + out_z, [out_x - axis_x, out_y - axis_y, out_z - axis_z]);
        let side = height + axis_z - 0.5 * out_z;
        if side <= 0.0 {
            // a triangle on the lower rim
            let (cx, cy, cz) =
                (out_y * axis_z - out_z * axis_y, out_z * axis_x - out_x * axis_z, out_x * axis_y - out_y * axis_x);
            let norm = (cx * cx + cy * cy + cz * cz).sqrt();
            let scale = cylinder.radius * 3.0_f64.sqrt() / 2.0;
            let (cx, cy, cz) = if norm < MIN_NORM {
                (scale, 0.0, 0.0)
            } else {
                let inverse = 1.0 / norm;
                (cx * inverse * scale, cy * inverse * scale, cz * inverse * scale)
            };
            let (bx, by, bz) = (axis_x - 0.5 * out_x, axis_y - 0.5 * out_y, axis_z - 0.5 * out_z);
            add(side, [bx + cx, by + cy, bz + cz]);
            add(side, [bx - cx, by - cy, bz - cz]);
        }
        let [vx, vy, vz, wx, wy, wz] = self.stage.velocity;
        let rate = self.forth(V3::new(wx, wy, wz));
        let speeds = problem.along_edges(contact.solver.friction, &[vx, vy, vz, rate.x, rate.y, rate.z]);
        for point in 0..problem.points {
            let impedance = contact.impedance.at(-distances[point]);
            problem.weight[point] = contact.weight(impedance, body.free.inverse_mass);
            for (reference, speeds) in problem.reference.iter_mut().zip(&speeds) {
                reference[point] = -contact.damping * speeds[point] - contact.stiffness * impedance * distances[point];
            }
        }
    }

    /// Sets inertia and accelerations of the problem.
    #[inline(always)]
    fn pose_problem(&self, body: &Body, problem: &mut Problem) {
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
    fn in_body_frame(&self, motion: &Spatial) -> Spatial {
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

    /// Adds the acceleration of the stage, and moves to the next stage.
    #[inline(always)]
    fn advance(&mut self, stage: usize, dt: f64, acceleration: &Spatial) {
        /// Weights of the stages, and steps to the next one (`mj_RungeKutta`).
        const WEIGHTS: [f64; 4] = [1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0];
        const STEPS: [f64; 3] = [0.5, 0.5, 1.0];
        let weight = WEIGHTS[stage];
        for (sum, velocity) in self.velocity_sum.iter_mut().zip(&self.stage.velocity) {
            *sum += velocity * weight;
        }
        for (sum, acceleration) in self.acceleration_sum.iter_mut().zip(acceleration) {
            *sum += acceleration * weight;
        }
        let Some(&step) = STEPS.get(stage) else { return };
        let by = self.stage.velocity.map(|velocity| velocity * step);
        let gained = acceleration.map(|acceleration| acceleration * step);
        self.stage = self.start.moved(&by, &gained, dt, self.is_upright());
        let distance = dt * dt * (by[0] * by[0] + by[1] * by[1] + by[2] * by[2]);
        self.travel_squared = self.travel_squared.max(distance);
    }

    /// Returns true if the tilt is so small that the last bits of the attitude decide about the contact points.
    #[inline(always)]
    fn is_upright(&self) -> bool {
        let [[_, _, x], [_, _, y], _] = self.matrix;
        x * x + y * y < 1e-8
    }

    /// Returns the state at the end of the step.
    #[inline(always)]
    fn end(&self, dt: f64) -> DroneState {
        let end = self.start.moved(&self.velocity_sum, &self.acceleration_sum, dt, self.is_upright());
        let [x, y, z, a, b, c] = end.velocity;
        DroneState {
            position: end.position.into(),
            attitude: attitude_from_wxyz(end.quaternion),
            velocity: [x, y, z].into(),
            angular_velocity: [a, b, c].into(),
        }
    }
}

impl Motion {
    /// Returns the motion after a time at these velocities and accelerations (`mj_integratePos`). `exact` selects
    /// MuJoCo's sine and cosine.
    #[inline(always)]
    fn moved(&self, velocity: &Spatial, acceleration: &Spatial, time: f64, exact: bool) -> Self {
        let mut end = *self;
        for (position, velocity) in end.position.iter_mut().zip(velocity) {
            *position += time * velocity;
        }
        for (velocity, acceleration) in end.velocity.iter_mut().zip(acceleration) {
            *velocity += acceleration * time;
        }
        end.quaternion = turned(&self.quaternion, [velocity[3], velocity[4], velocity[5]], time, exact);
        end
    }
}

/// Returns true if the moments of inertia are within [`SHAPES`].
#[inline(always)]
fn is_regular(cylinder: &Cylinder, body: &Body) -> bool {
    let size = cylinder.radius * cylinder.radius + cylinder.half_height * cylinder.half_height;
    body.free.inverse_inertia.iter().all(|inverse| SHAPES.contains(&(body.mass * size * inverse)))
}

/// Returns a quaternion after a rotation at a constant body rate (`mju_quatIntegrate`).
#[inline(always)]
fn turned(q: &[f64; 4], rate: [f64; 3], time: f64, exact: bool) -> [f64; 4] {
    let [x, y, z] = rate;
    let squared = x * x + y * y + z * z;
    let half_time = 0.5 * time;
    let half_squared = half_time * half_time * squared;
    let (cos, [x, y, z]) = if !exact && half_squared <= MAX_HALF_ANGLE_SQUARED {
        let (cos, sinc) = half_angle(half_squared);
        (cos, rate.map(|x| x * (half_time * sinc)))
    } else {
        let norm = squared.sqrt();
        let half = time * norm * 0.5;
        if half == 0.0 {
            return normalized(*q);
        }
        let axis = if norm < MIN_NORM {
            [1.0, 0.0, 0.0]
        } else {
            let inverse = 1.0 / norm;
            rate.map(|x| x * inverse)
        };
        let (sin, cos) = half.sin_cos();
        (cos, axis.map(|x| x * sin))
    };
    let [a, b, c, d] = *q;
    normalized([
        a * cos - b * x - c * y - d * z,
        a * x + b * cos + c * z - d * y,
        a * y - b * z + c * cos + d * x,
        a * z + b * y - c * x + d * cos,
    ])
}

/// Normalizes a quaternion (`mju_normalize4`).
#[inline(always)]
fn normalized(q: [f64; 4]) -> [f64; 4] {
    let norm = (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]).sqrt();
    if norm == 1.0 {
        return q;
    }
    let inverse = 1.0 / norm;
    q.map(|x| x * inverse)
}

/// Returns the rotation matrix of a unit quaternion, by rows (`mju_quat2Mat`).
#[inline(always)]
fn matrix(q: &[f64; 4]) -> [[f64; 3]; 3] {
    let [w, x, y, z] = *q;
    let (ww, xx, yy, zz) = (w * w, x * x, y * y, z * z);
    let (wx, wy, wz, xy, xz, yz) = (w * x, w * y, w * z, x * y, x * z, y * z);
    [
        [ww + xx - yy - zz, 2.0 * (xy - wz), 2.0 * (xz + wy)],
        [2.0 * (xy + wz), ww - xx + yy - zz, 2.0 * (yz - wx)],
        [2.0 * (xz - wy), 2.0 * (yz + wx), ww - xx - yy + zz],
    ]
}
