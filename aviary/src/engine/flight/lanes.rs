use nalgebra::Vector3;
use pulp::{Simd, WithSimd};

use super::body::{FlightState, Fluid, Push};
use super::reach_bound::ReachBound;
use super::{FreeBody, Width};
use crate::math::{Pack, Real, Turn, V3};
use crate::physics::downwash::Wake;
use crate::physics::drag;
use crate::physics::ground_effect::GroundEffect;
use crate::physics::rotor::{RotorModel, RotorWrench};
use crate::state::{DroneState, wxyz};
use crate::world::placement::{sphere_clearance, sphere_floor_clearance};

/// Number of drones in one set of lanes.
pub const LANES: usize = 8;

/// One number per lane.
pub(crate) type Row = [f64; LANES];

/// Parameters of one drone in [`LaneParams`]; constant during a control step.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Airframe {
    /// Rigid body.
    pub body: FreeBody,
    /// Rotors.
    pub rotors: RotorModel,
    /// Ground effect; the default value for none.
    pub ground: GroundEffect,
    /// Coefficients of the blade drag, body frame, N/(m/s)/(rad/s); zero for none.
    pub drag: Vector3<f64>,
    /// Wake; the default value for none.
    pub wake: Wake,
    /// Fraction of the remaining speed difference that the rotors close in one physics step; 1 without lag.
    pub share: f64,
    /// Largest commanded motor speed, rpm.
    pub max_command: f64,
    /// Factors on the commanded speeds of the motors.
    pub gains: [f64; 4],
    /// Speed at which the rotors saturate, rpm.
    pub max_rpm: f64,
    /// Bound of the distance that the drone can travel.
    pub reach_bound: ReachBound,
}

/// Parameters of [`LANES`] drones, as a structure of arrays.
#[derive(Debug, Clone, Copy, Default)]
#[repr(align(64))]
pub struct LaneParams {
    inverse_mass: Row,
    gravity: Row,
    inverse_inertia: [Row; 3],
    gyration: [Row; 3],
    viscous: Row,
    quadratic: [Row; 3],
    viscous_rate: [Row; 3],
    quadratic_rate: [Row; 3],
    thrust: Row,
    torque: [[Row; 4]; 3],
    ground: [Row; 2],
    drag: [Row; 3],
    wake: [Row; 4],
    share: Row,
    max_command: Row,
    gains: [Row; 4],
    max_rpm: Row,
    reach_bound: [Row; 8],
}

/// States of [`LANES`] drones, as a structure of arrays.
#[derive(Debug, Clone, Default)]
#[repr(align(64))]
pub struct Lanes {
    position: [Row; 3],
    attitude: [Row; 4],
    velocity: [Row; 3],
    rate: [Row; 3],
    /// Commanded motor speeds of the last control step, rpm.
    command: [Row; 4],
    /// Target speeds of the rotors, rpm.
    target: [Row; 4],
    /// Speeds of the rotors, rpm.
    rpm: [Row; 4],
    /// Force of the wind, world frame, N.
    force: [Row; 3],
    /// Velocity of the air, world frame, m/s.
    air: [Row; 3],
    /// Force of the wakes along world z, N.
    downwash: Row,
    rpy: [Row; 3],
    /// Load of the last physics step: thrust (N) and torque (body frame, N·m) of the rotors, external force (world
    /// frame, N).
    push: [Row; 7],
}

fn put<const N: usize>(rows: &mut [Row; N], lane: usize, values: [f64; N]) {
    for (row, value) in rows.iter_mut().zip(values) {
        row[lane] = value;
    }
}

#[inline(always)]
fn take<const N: usize>(rows: &[Row; N], lane: usize) -> [f64; N] {
    let mut values = [0.0; N];
    for (value, row) in values.iter_mut().zip(rows) {
        *value = row[lane];
    }
    values
}

impl LaneParams {
    /// Creates the parameters of one drone in every lane.
    pub fn all(airframe: &Airframe) -> Self {
        let mut all = Self::default();
        (0..LANES).for_each(|lane| all.set(lane, airframe));
        all
    }

    /// Returns the largest commanded motor speed of a lane, rpm.
    pub(crate) fn max_command(&self, lane: usize) -> f64 {
        self.max_command[lane]
    }

    /// Sets the parameters of a lane.
    pub fn set(&mut self, lane: usize, airframe: &Airframe) {
        let Airframe { body, rotors, ground, drag, wake, share, max_command, gains, max_rpm, reach_bound } = airframe;
        self.inverse_mass[lane] = body.inverse_mass;
        self.gravity[lane] = body.gravity;
        put(&mut self.inverse_inertia, lane, body.inverse_inertia);
        put(&mut self.gyration, lane, body.gyration);
        self.viscous[lane] = body.fluid.viscous;
        put(&mut self.quadratic, lane, body.fluid.quadratic);
        put(&mut self.viscous_rate, lane, body.fluid.viscous_rate);
        put(&mut self.quadratic_rate, lane, body.fluid.quadratic_rate);
        self.thrust[lane] = rotors.thrust;
        for (rows, values) in self.torque.iter_mut().zip(rotors.torque) {
            put(rows, lane, values);
        }
        put(&mut self.ground, lane, [ground.coefficient, ground.clip]);
        put(&mut self.drag, lane, (*drag).into());
        put(&mut self.wake, lane, [wake.strength, wake.spread, wake.offset, wake.cap]);
        self.share[lane] = *share;
        self.max_command[lane] = *max_command;
        put(&mut self.gains, lane, *gains);
        self.max_rpm[lane] = *max_rpm;
        put(&mut self.reach_bound, lane, reach_bound.numbers());
    }
}

impl Lanes {
    /// Sets the state of a lane, and the current and target speeds of its rotors, rpm.
    #[inline]
    pub fn set(&mut self, lane: usize, state: &DroneState, rpm: &[f64; 4], target: &[f64; 4]) {
        put(&mut self.command, lane, *target);
        put(&mut self.position, lane, state.position.into());
        put(&mut self.attitude, lane, wxyz(&state.attitude));
        put(&mut self.velocity, lane, state.velocity.into());
        put(&mut self.rate, lane, state.angular_velocity.into());
        put(&mut self.rpm, lane, *rpm);
        put(&mut self.target, lane, *target);
    }

    /// Sets the commanded motor speeds of a lane, rpm; [`set_targets`] computes the target speeds of the rotors.
    #[inline]
    pub fn set_command(&mut self, lane: usize, command: &[f64; 4]) {
        put(&mut self.command, lane, *command);
    }

    /// Returns the commanded motor speeds of a lane in the last control step, rpm.
    #[inline]
    pub fn command(&self, lane: usize) -> [f64; 4] {
        take(&self.command, lane)
    }

    /// Copies a lane of other lanes.
    pub(crate) fn copy_lane(&mut self, lane: usize, other: &Self) {
        for (row, from) in self.rows_mut().zip(other.rows()) {
            row[lane] = from[lane];
        }
    }

    fn rows(&self) -> impl Iterator<Item = &Row> {
        let Self { position, attitude, velocity, rate, command, target, rpm, force, air, downwash, rpy, push } = self;
        let (triples, quads) = ([position, velocity, rate, force, air, rpy], [attitude, command, target, rpm]);
        triples.into_iter().flatten().chain(quads.into_iter().flatten()).chain([downwash]).chain(push)
    }

    fn rows_mut(&mut self) -> impl Iterator<Item = &mut Row> {
        let Self { position, attitude, velocity, rate, command, target, rpm, force, air, downwash, rpy, push } = self;
        let (triples, quads) = ([position, velocity, rate, force, air, rpy], [attitude, command, target, rpm]);
        triples.into_iter().flatten().chain(quads.into_iter().flatten()).chain([downwash]).chain(push)
    }

    /// Sets the force of the wind (world frame, N) and the velocity of the air (world frame, m/s) in a lane. The air
    /// velocity applies to the blade drag and to the medium.
    pub fn set_wind(&mut self, lane: usize, force: &Vector3<f64>, air: &Vector3<f64>) {
        put(&mut self.force, lane, (*force).into());
        put(&mut self.air, lane, (*air).into());
    }

    /// Returns the state of a lane.
    #[inline(always)]
    pub fn state(&self, lane: usize) -> DroneState {
        DroneState {
            position: take(&self.position, lane).into(),
            attitude: crate::state::attitude_from_wxyz(take(&self.attitude, lane)),
            velocity: take(&self.velocity, lane).into(),
            angular_velocity: take(&self.rate, lane).into(),
        }
    }

    /// Returns roll, pitch and yaw of a lane, rad, from the last call of [`compute_rpys`].
    #[inline(always)]
    pub fn rpy(&self, lane: usize) -> Vector3<f64> {
        take(&self.rpy, lane).into()
    }

    /// Sets roll, pitch and yaw of a lane, rad.
    pub(crate) fn set_rpy(&mut self, lane: usize, rpy: &Vector3<f64>) {
        put(&mut self.rpy, lane, (*rpy).into());
    }

    /// Returns the load of a lane in the last physics step: the rotors' wrench and the external force (world frame,
    /// N).
    #[inline(always)]
    pub fn push(&self, lane: usize) -> (RotorWrench, Vector3<f64>) {
        let [thrust, a, b, c, x, y, z] = take(&self.push, lane);
        (RotorWrench { thrust, torque_body: Vector3::new(a, b, c) }, Vector3::new(x, y, z))
    }

    /// Sets the load of a lane in the last physics step.
    pub fn set_push(&mut self, lane: usize, rotors: &RotorWrench, force_world: &Vector3<f64>) {
        let (t, f) = (&rotors.torque_body, force_world);
        put(&mut self.push, lane, [rotors.thrust, t.x, t.y, t.z, f.x, f.y, f.z]);
    }

    /// Returns the rotor speeds of a lane, rpm.
    #[inline(always)]
    pub fn rpm(&self, lane: usize) -> [f64; 4] {
        take(&self.rpm, lane)
    }
}

/// Accessor of one SIMD register in every row.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Part<S: Simd> {
    simd: S,
    index: usize,
}

impl<S: Simd> Part<S> {
    /// Returns the accessors of the registers that hold the first `count` lanes.
    #[inline(always)]
    pub(crate) fn first(simd: S, count: usize) -> impl Iterator<Item = Self> {
        (0..count.min(LANES).div_ceil(S::F64_LANES)).map(move |index| Self { simd, index })
    }

    #[inline(always)]
    pub(crate) fn get(self, row: &Row) -> Pack<S> {
        Pack::new(self.simd, S::as_simd_f64s(row).0[self.index])
    }

    #[inline(always)]
    pub(crate) fn get3(self, rows: &[Row; 3]) -> V3<Pack<S>> {
        V3::new(self.get(&rows[0]), self.get(&rows[1]), self.get(&rows[2]))
    }

    #[inline(always)]
    pub(crate) fn get4(self, rows: &[Row; 4]) -> [Pack<S>; 4] {
        [self.get(&rows[0]), self.get(&rows[1]), self.get(&rows[2]), self.get(&rows[3])]
    }

    #[inline(always)]
    pub(crate) fn put(self, row: &mut Row, value: Pack<S>) {
        S::as_mut_simd_f64s(row).0[self.index] = value.values();
    }

    #[inline(always)]
    pub(crate) fn put3(self, rows: &mut [Row; 3], value: V3<Pack<S>>) {
        let [x, y, z] = rows;
        self.put(x, value.x);
        self.put(y, value.y);
        self.put(z, value.z);
    }

    #[inline(always)]
    pub(crate) fn turn(self, lanes: &Lanes) -> Turn<Pack<S>> {
        let [w, x, y, z] = self.get4(&lanes.attitude);
        Turn { w, v: V3::new(x, y, z) }
    }

    #[inline(always)]
    pub(crate) fn motion(self, lanes: &Lanes) -> FlightState<Pack<S>> {
        FlightState {
            position: self.get3(&lanes.position),
            attitude: self.turn(lanes),
            velocity: self.get3(&lanes.velocity),
            rate: self.get3(&lanes.rate),
        }
    }

    #[inline(always)]
    fn put_motion(self, lanes: &mut Lanes, motion: &FlightState<Pack<S>>) {
        self.put3(&mut lanes.position, motion.position);
        let [w, x, y, z] = &mut lanes.attitude;
        self.put(w, motion.attitude.w);
        self.put(x, motion.attitude.v.x);
        self.put(y, motion.attitude.v.y);
        self.put(z, motion.attitude.v.z);
        self.put3(&mut lanes.velocity, motion.velocity);
        self.put3(&mut lanes.rate, motion.rate);
    }

    #[inline(always)]
    fn array(self, rows: &[Row; 3]) -> [Pack<S>; 3] {
        [self.get(&rows[0]), self.get(&rows[1]), self.get(&rows[2])]
    }

    #[inline(always)]
    fn body(self, lane_params: &LaneParams) -> FreeBody<Pack<S>> {
        FreeBody {
            inverse_mass: self.get(&lane_params.inverse_mass),
            gravity: self.get(&lane_params.gravity),
            inverse_inertia: self.array(&lane_params.inverse_inertia),
            gyration: self.array(&lane_params.gyration),
            fluid: Fluid {
                viscous: self.get(&lane_params.viscous),
                quadratic: self.array(&lane_params.quadratic),
                viscous_rate: self.array(&lane_params.viscous_rate),
                quadratic_rate: self.array(&lane_params.quadratic_rate),
            },
        }
    }

    #[inline(always)]
    fn rotors(self, lane_params: &LaneParams) -> RotorModel<Pack<S>> {
        let [x, y, z] = &lane_params.torque;
        RotorModel { thrust: self.get(&lane_params.thrust), torque: [self.get4(x), self.get4(y), self.get4(z)] }
    }

    #[inline(always)]
    fn wake(self, lane_params: &LaneParams) -> Wake<Pack<S>> {
        let [strength, spread, offset, cap] = self.get4(&lane_params.wake);
        Wake { strength, spread, offset, cap }
    }

    /// Returns roll, pitch and yaw of the last [`update_rpy`](Self::update_rpy), rad.
    #[inline(always)]
    pub(crate) fn rpy(self, lanes: &Lanes) -> V3<Pack<S>> {
        self.get3(&lanes.rpy)
    }

    /// Computes roll, pitch and yaw.
    #[inline(always)]
    pub(crate) fn update_rpy(self, lanes: &mut Lanes) {
        let rpy = self.turn(lanes).rpy();
        self.put3(&mut lanes.rpy, rpy);
    }

    /// Computes the target speeds of the rotors as
    /// [`Actuators::target`](crate::physics::actuators::Actuators::target) does.
    #[inline(always)]
    fn set_targets(self, lanes: &mut Lanes, lane_params: &LaneParams) {
        let max = self.get(&lane_params.max_rpm);
        for motor in 0..4 {
            let speed = self.get(&lanes.command[motor]) * self.get(&lane_params.gains[motor]);
            self.put(&mut lanes.target[motor], clamped(speed, max.all(0.0), max));
        }
    }

    #[inline(always)]
    fn ball(self, lanes: &Lanes, lane_params: &LaneParams, dt: f64, steps: u32) -> Pack<S> {
        let rows = &lane_params.reach_bound;
        let numbers = [
            self.get(&rows[0]),
            self.get(&rows[1]),
            self.get(&rows[2]),
            self.get(&rows[3]),
            self.get(&rows[4]),
            self.get(&rows[5]),
            self.get(&rows[6]),
            self.get(&rows[7]),
        ];
        ReachBound::of(numbers).ball(dt, steps, &self.motion(lanes))
    }
}

/// Options of [`advance`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Flow {
    /// Length of a physics step, s.
    pub dt: f64,
    /// True if the rotors' wrench rotates with the body inside a step.
    pub body_fixed: bool,
    /// True if the medium is on.
    pub medium: bool,
    /// True if a force besides the rotors acts, or if the motors have lag.
    pub air: bool,
    /// Instruction set.
    pub width: Width,
}

/// Physics steps of lanes that do not interact.
struct Substeps<'a, const BODY_FIXED: bool, const MEDIUM: bool, const AIR: bool> {
    lanes: &'a mut Lanes,
    lane_params: &'a LaneParams,
    count: usize,
    dt: f64,
    steps: u32,
}

impl<const BODY_FIXED: bool, const MEDIUM: bool, const AIR: bool> WithSimd for Substeps<'_, BODY_FIXED, MEDIUM, AIR> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { lanes, lane_params, count, dt, steps } = self;
        for part in Part::first(simd, count) {
            let (body, rotors) = (part.body(lane_params), part.rotors(lane_params));
            let target = part.get4(&lanes.target);
            let mut motion = part.motion(lanes);
            let mut rpm = if AIR { part.get4(&lanes.rpm) } else { target };
            let none = target[0].all(0.0);
            let mut push = Push { thrust: none, torque: V3::new(none, none, none), force: V3::new(none, none, none) };
            for _ in 0..steps {
                if AIR {
                    let share = part.get(&lane_params.share);
                    let lag = share.less(share.all(1.0));
                    for motor in 0..4 {
                        let slow = rpm[motor] + (target[motor] - rpm[motor]) * share;
                        // without lag the speed is exactly the command; the formula would add a rounding error
                        rpm[motor] = Real::choose(lag, slow, target[motor]);
                    }
                    (push.thrust, push.torque) = rotors.thrust_and_torque(&rpm);
                    let ground = GroundEffect {
                        coefficient: part.get(&lane_params.ground[0]),
                        clip: part.get(&lane_params.ground[1]),
                    };
                    let (mut sum, air) = (part.get3(&lanes.force), part.get3(&lanes.air));
                    if MEDIUM && <Pack<S> as Real>::any(none.less(air.dot(air))) {
                        sum = sum + body.medium_change(&motion.attitude, motion.velocity, air);
                    }
                    sum.z = sum.z + ground.push(motion.position.z, motion.attitude.up().z, push.thrust);
                    let relative = motion.velocity - air;
                    sum = sum + drag::push(part.get3(&lane_params.drag), &motion.attitude, &rpm, relative);
                    sum.z = sum.z + part.get(&lanes.downwash);
                    push.force = sum;
                } else {
                    (push.thrust, push.torque) = rotors.thrust_and_torque(&rpm);
                }
                motion = body.rk4::<BODY_FIXED, MEDIUM>(dt, &push, &motion);
            }
            part.put_motion(lanes, &motion);
            let [a, b, c, d] = &mut lanes.rpm;
            part.put(a, rpm[0]);
            part.put(b, rpm[1]);
            part.put(c, rpm[2]);
            part.put(d, rpm[3]);
            let [thrust, x, y, z, force @ ..] = &mut lanes.push;
            part.put(thrust, push.thrust);
            part.put(x, push.torque.x);
            part.put(y, push.torque.y);
            part.put(z, push.torque.z);
            part.put3(force, push.force);
        }
    }
}

/// Advances the first `count` lanes by `steps` physics steps; the lanes do not interact.
pub fn advance(flow: &Flow, lanes: &mut Lanes, lane_params: &LaneParams, count: usize, steps: u32) {
    macro_rules! go {
        ($fixed:literal, $medium:literal, $air:literal) => {
            // a full block has a kernel of its own, whose loop over the registers is unrolled
            if count == LANES {
                let work = Substeps::<$fixed, $medium, $air> { lanes, lane_params, count: LANES, dt: flow.dt, steps };
                flow.width.run(LANES, work)
            } else {
                flow.width
                    .run(count, Substeps::<$fixed, $medium, $air> { lanes, lane_params, count, dt: flow.dt, steps })
            }
        };
    }
    // the most common flight has a specialized kernel; the others multiply unused effects by zero
    match (flow.body_fixed, flow.medium) {
        (false, false) if !flow.air => go!(false, false, false),
        (false, false) => go!(false, false, true),
        (false, true) => go!(false, true, true),
        (true, false) => go!(true, false, true),
        (true, true) => go!(true, true, true),
    }
}

/// Normalized motor speeds of a control step; see [`set_commands`].
#[derive(Debug, Clone, Copy)]
pub(crate) enum Decoding {
    /// Normalized speeds with the speeds of 0 and 1, rpm.
    Scaled([f64; 2]),
    /// Speeds, rpm.
    Raw,
}

struct Commands<'a> {
    lanes: &'a mut Lanes,
    lane_params: &'a LaneParams,
    count: usize,
    decoding: Decoding,
    actions: &'a [Row; 4],
}

impl WithSimd for Commands<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { lanes, lane_params, count, decoding, actions } = self;
        for part in Part::first(simd, count) {
            let max = part.get(&lane_params.max_command);
            for (motor, row) in actions.iter().enumerate() {
                let action = part.get(row);
                let speed = match decoding {
                    Decoding::Scaled([hover, full]) => {
                        let action = clamped(action, action.all(-1.0), action.all(1.0));
                        let (below, above) = ((action + 1.0) * hover, action * (full - hover) + hover);
                        Real::choose(action.all(0.0).less(action), above, below)
                    }
                    Decoding::Raw => action,
                };
                part.put(&mut lanes.command[motor], clamped(speed, max.all(0.0), max));
            }
            part.set_targets(lanes, lane_params);
        }
    }
}

/// Decodes actions to the commanded motor speeds of the first `count` lanes, and computes the target speeds of the
/// rotors. `actions` has a row per motor.
pub(crate) fn set_commands(
    width: Width,
    decoding: Decoding,
    lanes: &mut Lanes,
    lane_params: &LaneParams,
    count: usize,
    actions: &[Row; 4],
) {
    width.run(count, Commands { lanes, lane_params, count, decoding, actions });
}

struct Targets<'a> {
    lanes: &'a mut Lanes,
    lane_params: &'a LaneParams,
    count: usize,
}

impl WithSimd for Targets<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        for part in Part::first(simd, self.count) {
            part.set_targets(self.lanes, self.lane_params);
        }
    }
}

/// Computes the target speeds of the rotors from the commanded speeds, in the first `count` lanes.
pub(crate) fn set_targets(width: Width, lanes: &mut Lanes, lane_params: &LaneParams, count: usize) {
    width.run(count, Targets { lanes, lane_params, count });
}

/// Clamps a number as [`f64::clamp`] does, lane by lane.
#[inline(always)]
fn clamped<R: Real>(x: R, min: R, max: R) -> R {
    let above = Real::choose(x.less(min), min, x);
    Real::choose(max.less(above), max, above)
}

struct Downwash<'a> {
    drones: &'a mut [Lanes],
    lane_params: &'a [LaneParams],
    count: usize,
}

impl WithSimd for Downwash<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { drones, lane_params, count } = self;
        for part in Part::first(simd, count) {
            for i in 0..drones.len() {
                let (before, rest) = drones.split_at_mut(i);
                let a = &mut rest[0];
                let place = part.get3(&a.position);
                let zero = place.x.all(0.0);
                let mut on_a = zero;
                let wake = part.wake(&lane_params[i]);
                for (j, b) in before.iter_mut().enumerate() {
                    let apart = place - part.get3(&b.position);
                    let sideways = apart.x * apart.x + apart.y * apart.y;
                    let above = zero.less(apart.z);
                    let below = apart.z.abs();
                    let upper = Wake::choose(above, &wake, &part.wake(&lane_params[j]));
                    // most pairs are out of reach of each other
                    if !<Pack<S> as Real>::any(upper.reaches(below, sideways)) {
                        continue;
                    }
                    let force: Pack<S> = upper.push(below, sideways);
                    let on_b = part.get(&b.downwash) + Real::choose(above, force, zero);
                    part.put(&mut b.downwash, on_b);
                    on_a = on_a + Real::choose(above, zero, force);
                }
                part.put(&mut a.downwash, on_a);
            }
        }
    }
}

/// Computes the wakes among the drones of the first `count` environments, one environment per lane. `drones` and
/// `lane_params` have one entry per drone.
pub fn compute_downwash(width: Width, drones: &mut [Lanes], lane_params: &[LaneParams], count: usize) {
    width.run(count, Downwash { drones, lane_params, count });
}

struct Rpys<'a> {
    lanes: &'a mut Lanes,
    count: usize,
}

impl WithSimd for Rpys<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        for part in Part::first(simd, self.count) {
            part.update_rpy(self.lanes);
        }
    }
}

/// Computes roll, pitch and yaw of the first `count` lanes.
pub fn compute_rpys(width: Width, lanes: &mut Lanes, count: usize) {
    width.run(count, Rpys { lanes, count });
}

struct Clear<'a> {
    drones: &'a [Lanes],
    lane_params: &'a [LaneParams],
    count: usize,
    dt: f64,
    steps: u32,
}

impl WithSimd for Clear<'_> {
    type Output = [bool; LANES];

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> [bool; LANES] {
        let Self { drones, lane_params, count, dt, steps } = self;
        let mut room = [0.0; LANES];
        for part in Part::first(simd, count) {
            let one = Pack::new(simd, simd.splat_f64s(1.0));
            let zero = one.all(0.0);
            // a comparison with NaN is false, and a false lane stays false
            let mut clear = zero.less(one);
            for i in 0..drones.len() {
                let place = part.get3(&drones[i].position);
                let ball = part.ball(&drones[i], &lane_params[i], dt, steps);
                clear = clear & zero.less(sphere_floor_clearance(place, ball));
                for j in 0..i {
                    let (other, other_ball) =
                        (part.get3(&drones[j].position), part.ball(&drones[j], &lane_params[j], dt, steps));
                    clear = clear & zero.less(sphere_clearance(place, ball, other, other_ball));
                }
            }
            part.put(&mut room, Real::choose(clear, one, zero));
        }
        room.map(|room| room > 0.0)
    }
}

/// Returns for each lane whether its environment is free of contacts for `steps` physics steps: no drone can touch
/// the floor or another drone, and none rotates too fast for the kernel. The result covers the first `count`
/// environments, one per lane. `drones` and `lane_params` have one entry per drone.
pub fn find_clear(
    flow: &Flow,
    drones: &[Lanes],
    lane_params: &[LaneParams],
    count: usize,
    steps: u32,
) -> [bool; LANES] {
    flow.width.run(count, Clear { drones, lane_params, count, dt: flow.dt, steps })
}
