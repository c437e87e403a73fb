//! SIMD form of a control step: commands, physics steps, wakes, attitude angles, room.

use std::hint::black_box;

use ::flight::airframe::AirframeMotion;
use ::flight::body::Push;
use ::flight::clearance::{sphere_clearance, sphere_floor_clearance};
use ::flight::downwash::Wake;
use ::flight::drag;
use ::flight::ground_effect::GroundEffect;
use ::flight::motors;
use pulp::{Simd, WithSimd};

use super::Width;
use super::lanes::{LANES, LaneParams, Lanes, Part};
use crate::math::{Pack, Real, Row, ToFlight as _, V3};
use crate::physics::wind::WindLanes;

/// Options of [`advance`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Flow {
    /// Length of a physics step, s.
    pub dt: f64,
    /// True if the rotors' wrench rotates with the body inside a step.
    pub body_fixed: bool,
    /// True if the medium is on.
    pub medium: bool,
    /// True if the motors have lag.
    pub lag: bool,
    /// True if a force besides the rotors acts.
    pub air: bool,
    /// True if an airframe has [effects of its own parameters](crate::physics::airframe), or motors whose speed rises
    /// and falls with different time constants.
    pub airframe_effects: bool,
    /// Instruction set.
    pub width: Width,
}

/// Options of [`advance_with`] in addition to [`Flow`], for one drone of a block.
#[derive(Debug, Default)]
pub(crate) struct Extras<'a> {
    /// Wind.
    pub wind: Option<&'a mut WindLanes>,
    /// Commands that arrive late.
    pub late: Option<&'a LateCommands>,
    /// Receives the state at one of the physics steps.
    pub record: Option<&'a mut Record>,
    /// Receives the distance (m) that bounds the travel of the drone, added to the present number. It is infinite
    /// where the drone may have touched the floor, or where the kernel is not exact.
    pub travel: Option<&'a mut Row>,
}

/// Commands that reach the motors during a control step, instead of [`Lanes::command`].
#[derive(Debug, Clone, Default)]
#[repr(align(64))]
pub(crate) struct LateCommands {
    /// Command until the other one arrives, rpm.
    pub early: [Row; 4],
    /// Command that arrives, rpm.
    pub late: [Row; 4],
    /// Physics step of the control step at which the command arrives.
    pub arrival: Row,
}

/// Record of the state at the start of one physics step.
#[derive(Debug, Clone, Default)]
#[repr(align(64))]
pub(crate) struct Record {
    /// Physics step of the control step whose first state is recorded.
    pub at: Row,
    /// Position 3, quaternion 4, velocity 3, angular velocity 3.
    pub state: [Row; 13],
}

/// Kind of kernel: plain flight, motors with lag, aerodynamic forces, or anything.
mod mode {
    pub const PLAIN: u8 = 0;
    pub const LAG: u8 = 1;
    pub const AIR: u8 = 2;
    pub const GENERAL: u8 = 3;
}

/// Physics steps of lanes that do not interact.
struct Substeps<'a, 'b, const BODY_FIXED: bool, const MEDIUM: bool, const MODE: u8> {
    flow: &'a Flow,
    lanes: &'a mut Lanes,
    lane_params: &'a LaneParams,
    extras: &'a mut Extras<'b>,
    count: usize,
    /// Physics steps of the control step, of which these steps are a part.
    steps: std::ops::Range<u32>,
}

impl<const BODY_FIXED: bool, const MEDIUM: bool, const MODE: u8> WithSimd
    for Substeps<'_, '_, BODY_FIXED, MEDIUM, MODE>
{
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { flow, lanes, lane_params, extras, count, steps } = self;
        let general = MODE == mode::GENERAL;
        for part in Part::first(simd, count) {
            let (mut body, rotors) = (part.body(lane_params), part.rotors(lane_params));
            if MEDIUM {
                body.fluid = part.fluid(lane_params);
            }
            let command = match extras.late {
                Some(late) if general => &late.late,
                _ => &lanes.command,
            };
            let target = part.targets(lane_params, command);
            let mut motion = part.motion(lanes);
            let mut rpm = if MODE == mode::PLAIN || MODE == mode::AIR { target } else { part.get4(&lanes.rpm) };
            let none = target[0].all(0.0);
            let mut push = Push { thrust: none, torque: V3::new(none, none, none), force: V3::new(none, none, none) };
            for step in steps.clone() {
                // the compiler must not know that the options are constant: it would make a copy of the loop for each
                // of their combinations
                let (flow, extras) =
                    if general { (black_box(flow), black_box(&mut *extras)) } else { (flow, &mut *extras) };
                let with_lag = MODE == mode::LAG || general && flow.lag;
                let with_air = MODE == mode::AIR || general && flow.air;
                let effects = if general && flow.airframe_effects { lane_params.effects() } else { None };
                let mut arrived = target;
                if general {
                    let now = none.all(f64::from(step));
                    if let Some(late) = extras.late {
                        let early = now.less(part.get(&late.arrival));
                        let before = part.targets(lane_params, &late.early);
                        arrived = std::array::from_fn(
                            #[inline(always)]
                            |motor| Real::choose(early, before[motor], target[motor]),
                        );
                    }
                    if let Some(record) = &mut extras.record {
                        // the number of a physics step is exact, so that two comparisons test for equality
                        let at = part.get(&record.at);
                        let here = (now - 0.5).less(at) & at.less(now + 0.5);
                        if <Pack<S> as Real>::any(here) {
                            part.record(&mut record.state, &motion, here);
                        }
                    }
                }
                let before = rpm;
                if with_lag {
                    let share = part.get(&lane_params.share);
                    for motor in 0..4 {
                        let mut share = share;
                        if general && let Some(rows) = effects {
                            share = motors::share(rpm[motor], arrived[motor], share, part.get(&rows.fall_share));
                        }
                        rpm[motor] = motors::follow(rpm[motor], arrived[motor], share);
                    }
                } else {
                    rpm = arrived;
                }
                (push.thrust, push.torque) = rotors.thrust_and_torque(&rpm);
                if with_air || general && (extras.wind.is_some() || effects.is_some()) {
                    let (mut sum, air) = match &mut extras.wind {
                        Some(wind) if general => {
                            let (simd, index) = part.register();
                            wind.advance(simd, index, motion.position.z, motion.velocity)
                        }
                        _ => (part.get3(&lanes.outside().force), part.get3(&lanes.outside().air)),
                    };
                    if MEDIUM && <Pack<S> as Real>::any(none.less(air.dot(air))) {
                        sum = sum + body.medium_change(&motion.attitude, motion.velocity, air);
                    }
                    if with_air {
                        let coefficients = lane_params.air();
                        let ground = GroundEffect {
                            coefficient: part.get(&coefficients.ground[0]),
                            clip: part.get(&coefficients.ground[1]),
                        };
                        sum.z = sum.z + ground.force(motion.position.z, motion.attitude.up().z, push.thrust);
                        let relative = motion.velocity - air;
                        sum = sum + drag::force(part.get3(&coefficients.drag), &motion.attitude, &rpm, relative);
                        sum.z = sum.z + part.get(&lanes.outside().downwash);
                    }
                    if general && let Some(rows) = effects {
                        let effects = part.effects(rows);
                        let motion = AirframeMotion {
                            attitude: &motion.attitude,
                            relative: motion.velocity - air,
                            rate: motion.rate,
                            momentum: [effects.momentum(&before), effects.momentum(&rpm)],
                        };
                        sum = sum + effects.add(flow.dt, &motion, &mut push.thrust, &mut push.torque);
                    }
                    push.force = sum;
                }
                if general && let Some(travel) = &mut extras.travel {
                    let distance = part.free_travel(lane_params, flow.dt, &body, &push, &motion);
                    let sum = part.get(travel) + distance;
                    part.put(travel, sum);
                }
                motion = body.rk4::<BODY_FIXED, MEDIUM>(flow.dt, &push, &motion);
            }
            part.put_motion(lanes, &motion);
            let [a, b, c, d] = &mut lanes.rpm;
            part.put(a, rpm[0]);
            part.put(b, rpm[1]);
            part.put(c, rpm[2]);
            part.put(d, rpm[3]);
            part.put_push(lanes, &push);
        }
    }
}

/// Advances the first `count` lanes by `steps` physics steps; the lanes do not interact.
pub fn advance(flow: &Flow, lanes: &mut Lanes, lane_params: &LaneParams, count: usize, steps: u32) {
    advance_with(flow, lanes, lane_params, &mut Extras::default(), count, 0..steps);
}

/// Advances the first `count` lanes by some of the physics steps of a control step; the lanes do not interact.
pub(crate) fn advance_with(
    flow: &Flow,
    lanes: &mut Lanes,
    lane_params: &LaneParams,
    extras: &mut Extras<'_>,
    count: usize,
    steps: std::ops::Range<u32>,
) {
    macro_rules! go {
        ($fixed:literal, $medium:literal, $mode:expr) => {{
            // a full block of the usual flights has a kernel of its own, whose loop over the registers is unrolled
            if count == LANES && $mode != mode::GENERAL {
                let count = LANES;
                let work = Substeps::<$fixed, $medium, { $mode }> { flow, lanes, lane_params, extras, count, steps };
                flow.width.run(LANES, work)
            } else {
                let work = Substeps::<$fixed, $medium, { $mode }> { flow, lanes, lane_params, extras, count, steps };
                flow.width.run(count, work)
            }
        }};
    }
    let usual = extras.wind.is_none() && extras.late.is_none() && extras.record.is_none() && extras.travel.is_none();
    let usual = usual && !flow.airframe_effects;
    // the most common flights have specialized kernels
    match (flow.body_fixed, flow.medium) {
        (false, false) if usual && !flow.air && !flow.lag => go!(false, false, mode::PLAIN),
        (false, false) if usual && !flow.air => go!(false, false, mode::LAG),
        (false, false) if usual && !flow.lag => go!(false, false, mode::AIR),
        (false, false) => go!(false, false, mode::GENERAL),
        (false, true) => go!(false, true, mode::GENERAL),
        (true, false) => go!(true, false, mode::GENERAL),
        (true, true) => go!(true, true, mode::GENERAL),
    }
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
                    let force: Pack<S> = upper.force(below, sideways);
                    let on_b = part.get(&b.outside().downwash) + Real::choose(above, force, zero);
                    part.put(&mut b.outside_mut().downwash, on_b);
                    on_a = on_a + Real::choose(above, zero, force);
                }
                part.put(&mut a.outside_mut().downwash, on_a);
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

/// Returns for each lane whether the drones of its environment stay apart from each other, if every drone travels at
/// most its `travel` (m) from the states in `drones`. The result covers the first `count` environments.
pub(crate) fn find_apart(drones: &[Lanes], lane_params: &[LaneParams], travels: &[Row], count: usize) -> [bool; LANES] {
    let mut apart = [false; LANES];
    for (lane, apart) in apart[..count].iter_mut().enumerate() {
        let ball = |drone: usize| {
            let place = drones[drone].state(lane).position.to_flight();
            (place, lane_params[drone].reach(lane) + travels[drone][lane])
        };
        *apart = (0..drones.len()).all(|i| {
            let (place, radius) = ball(i);
            // false for a travel that is infinite or NaN
            radius < f64::INFINITY
                && (0..i).all(|j| {
                    let (other, other_radius) = ball(j);
                    sphere_clearance(place, radius, other, other_radius) > 0.0
                })
        });
    }
    apart
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
