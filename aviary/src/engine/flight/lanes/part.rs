//! Accessor of SIMD registers in the rows of lanes.

use ::flight::airframe::AirframeEffects;
use ::flight::body::{Fluid, FreeBody, Push};
use ::flight::clearance::CollisionCylinder;
use ::flight::downwash::Wake;
use ::flight::motors;
use ::flight::rotor::RotorModel;
use pulp::Simd;

use super::{EffectRows, LANES, LaneParams, Lanes};
use crate::engine::flight::reach_bound::{DrivenBound, ReachBound};
use crate::math::{Pack, Real, Row, Turn, V3};
use crate::state::FlightState;

/// Accessor of one SIMD register in every row.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Part<S: Simd> {
    simd: S,
    index: usize,
}

impl<S: Simd> Part<S> {
    /// Returns the instruction set and the index of the register.
    #[inline(always)]
    pub(crate) fn register(self) -> (S, usize) {
        (self.simd, self.index)
    }

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
    pub(crate) fn put_motion(self, lanes: &mut Lanes, motion: &FlightState<Pack<S>>) {
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
    pub(in crate::engine::flight) fn body(self, lane_params: &LaneParams) -> FreeBody<Pack<S>> {
        FreeBody {
            inverse_mass: self.get(&lane_params.inverse_mass),
            gravity: self.get(&lane_params.gravity),
            inverse_inertia: self.array(&lane_params.inverse_inertia),
            gyration: self.array(&lane_params.gyration),
            fluid: Fluid::none(self.get(&lane_params.inverse_mass)),
        }
    }

    /// Returns the coefficients of the medium's drag.
    #[inline(always)]
    pub(in crate::engine::flight) fn fluid(self, lane_params: &LaneParams) -> Fluid<Pack<S>> {
        let air = lane_params.air();
        Fluid {
            viscous: self.get(&air.viscous),
            quadratic: self.array(&air.quadratic),
            viscous_rate: self.array(&air.viscous_rate),
            quadratic_rate: self.array(&air.quadratic_rate),
        }
    }

    #[inline(always)]
    pub(in crate::engine::flight) fn rotors(self, lane_params: &LaneParams) -> RotorModel<Pack<S>> {
        let [x, y, z] = &lane_params.torque;
        RotorModel { thrust: self.get(&lane_params.thrust), torque: [self.get4(x), self.get4(y), self.get4(z)] }
    }

    /// Returns the effects of the airframes' own parameters.
    #[inline(always)]
    pub(in crate::engine::flight) fn effects(self, rows: &EffectRows) -> AirframeEffects<Pack<S>> {
        AirframeEffects::of(std::array::from_fn(
            #[inline(always)]
            |index| self.get(&rows.coefficients[index]),
        ))
    }

    #[inline(always)]
    pub(in crate::engine::flight) fn wake(self, lane_params: &LaneParams) -> Wake<Pack<S>> {
        let [strength, spread, offset, cap] = self.get4(&lane_params.air().wake);
        Wake { strength, spread, offset, cap }
    }

    /// Returns roll, pitch and yaw of the last [`update_rpy`](Self::update_rpy), rad.
    #[inline(always)]
    pub(crate) fn rpy(self, lanes: &Lanes) -> V3<Pack<S>> {
        self.get3(&lanes.rpy)
    }

    /// Writes roll, pitch and yaw, rad.
    #[inline(always)]
    pub(crate) fn put_rpy(self, lanes: &mut Lanes, rpy: V3<Pack<S>>) {
        self.put3(&mut lanes.rpy, rpy);
    }

    /// Computes roll, pitch and yaw.
    #[inline(always)]
    pub(crate) fn update_rpy(self, lanes: &mut Lanes) {
        let rpy = self.turn(lanes).rpy();
        self.put3(&mut lanes.rpy, rpy);
    }

    /// Returns the target speeds of the rotors under commands, rpm.
    #[inline(always)]
    pub(in crate::engine::flight) fn targets(self, lane_params: &LaneParams, command: &[Row; 4]) -> [Pack<S>; 4] {
        let [a, b, c, d] = self.get4(command);
        [
            self.target(lane_params, 0, a),
            self.target(lane_params, 1, b),
            self.target(lane_params, 2, c),
            self.target(lane_params, 3, d),
        ]
    }

    /// Returns the target speed of a rotor under a command as
    /// [`Actuators::target`](crate::physics::actuators::Actuators::target) does, rpm.
    #[inline(always)]
    fn target(self, lane_params: &LaneParams, motor: usize, command: Pack<S>) -> Pack<S> {
        let max = self.get(&lane_params.max_rpm);
        motors::target(command, self.get(&lane_params.gains[motor]), max)
    }

    /// Writes the load of the last physics step.
    #[inline(always)]
    pub(in crate::engine::flight) fn put_push(self, lanes: &mut Lanes, push: &Push<Pack<S>>) {
        let [thrust, x, y, z, force @ ..] = &mut lanes.push;
        self.put(thrust, push.thrust);
        self.put(x, push.torque.x);
        self.put(y, push.torque.y);
        self.put(z, push.torque.z);
        self.put3(force, push.force);
    }

    /// Writes a state to 13 rows where the mask is true.
    #[inline(always)]
    pub(in crate::engine::flight) fn record(
        self,
        rows: &mut [Row; 13],
        motion: &FlightState<Pack<S>>,
        mask: <Pack<S> as Real>::Mask,
    ) {
        let FlightState { position: p, attitude: q, velocity: v, rate } = motion;
        let numbers = [p.x, p.y, p.z, q.w, q.v.x, q.v.y, q.v.z, v.x, v.y, v.z, rate.x, rate.y, rate.z];
        for (row, number) in rows.iter_mut().zip(numbers) {
            let old = self.get(row);
            self.put(row, Real::choose(mask, number, old));
        }
    }

    /// Returns a bound of the distance that a drone travels in a physics step under a load, m; infinite where it may
    /// touch the floor or where the kernel is not exact.
    #[inline(always)]
    pub(in crate::engine::flight) fn free_travel(
        self,
        lane_params: &LaneParams,
        dt: f64,
        body: &FreeBody<Pack<S>>,
        push: &Push<Pack<S>>,
        motion: &FlightState<Pack<S>>,
    ) -> Pack<S> {
        let [radius, height] = [0, 1].map(
            #[inline(always)]
            |index| self.get(&lane_params.cylinder[index]),
        );
        self.reach_bound(lane_params).free_travel(dt, body, push, &CollisionCylinder { radius, height }, motion)
    }

    #[inline(always)]
    fn driven_bound(self, rows: &EffectRows) -> DrivenBound<Pack<S>> {
        DrivenBound::of(std::array::from_fn(
            #[inline(always)]
            |index| self.get(&rows.driven[index]),
        ))
    }

    #[inline(always)]
    fn reach_bound(self, lane_params: &LaneParams) -> ReachBound<Pack<S>> {
        let rows = &lane_params.reach_bound;
        #[expect(clippy::manual_map, reason = "a closure is not always inlined and then lacks the instruction set")]
        let driven = match lane_params.effects() {
            Some(rows) => Some(self.driven_bound(rows)),
            None => None,
        };
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
        ReachBound::of(numbers, driven)
    }

    #[inline(always)]
    pub(in crate::engine::flight) fn ball(
        self,
        lanes: &Lanes,
        lane_params: &LaneParams,
        dt: f64,
        steps: u32,
    ) -> Pack<S> {
        self.reach_bound(lane_params).ball(dt, steps, &self.motion(lanes))
    }
}
