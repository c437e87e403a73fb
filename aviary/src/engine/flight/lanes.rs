mod part;

use ::flight::airframe::EFFECTS;
use ::flight::body::Fluid;
use nalgebra::Vector3;

pub(crate) use part::Part;

use super::FreeBody;
use super::reach_bound::{DRIVEN, ReachBound};
use crate::math::Row;
use crate::physics::airframe::AirframeEffects;
use crate::physics::downwash::Wake;
use crate::physics::ground_effect::GroundEffect;
use crate::physics::rotor::{RotorModel, RotorWrench};
use crate::state::{DroneState, wxyz};

/// Number of drones in one set of lanes.
pub const LANES: usize = crate::math::LANES;

/// Parameters of one drone in [`LaneParams`]; constant during a control step.
#[derive(Debug, Clone, Copy, PartialEq)]
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
    /// Forces and torques of the airframe's own parameters; the default value for none.
    pub effects: AirframeEffects,
    /// Fraction of the remaining speed difference that the rotors close in one physics step while their speed rises; 1
    /// without lag.
    pub share: f64,
    /// Fraction while the speed falls. It is equal to `share` unless [`Flow::airframe_effects`] is set.
    ///
    /// [`Flow::airframe_effects`]: super::Flow::airframe_effects
    pub fall_share: f64,
    /// Largest commanded motor speed, rpm.
    pub max_command: f64,
    /// Factors on the commanded speeds of the motors.
    pub gains: [f64; 4],
    /// Speed at which the rotors saturate, rpm.
    pub max_rpm: f64,
    /// Radius and height of the collision cylinder, m.
    pub cylinder: [f64; 2],
    /// Bound of the distance that the drone can travel.
    pub reach_bound: ReachBound,
}

/// No aerodynamics, motors that follow every command, and no mass.
impl Default for Airframe {
    fn default() -> Self {
        Self {
            body: FreeBody::default(),
            rotors: RotorModel::default(),
            ground: GroundEffect::default(),
            drag: Vector3::zeros(),
            wake: Wake::default(),
            effects: AirframeEffects::default(),
            share: 0.0,
            fall_share: 0.0,
            max_command: f64::INFINITY,
            gains: [1.0; 4],
            max_rpm: f64::INFINITY,
            cylinder: [0.0; 2],
            reach_bound: ReachBound::default(),
        }
    }
}

/// Parameters of [`LANES`] drones, as a structure of arrays.
#[derive(Debug, Clone, Default)]
#[repr(align(64))]
pub struct LaneParams {
    inverse_mass: Row,
    gravity: Row,
    inverse_inertia: [Row; 3],
    gyration: [Row; 3],
    pub(super) thrust: Row,
    torque: [[Row; 4]; 3],
    /// Coefficients of air and medium; `None` if all are zero.
    air: Option<Box<AirRows>>,
    /// Effects of the airframes' own parameters; `None` if there are none.
    effects: Option<Box<EffectRows>>,
    pub(super) share: Row,
    pub(super) max_command: Row,
    pub(super) gains: [Row; 4],
    max_rpm: Row,
    cylinder: [Row; 2],
    reach_bound: [Row; 8],
}

/// Effects of the airframes' own parameters in [`LaneParams`].
#[derive(Debug, Clone)]
#[repr(align(64))]
pub(super) struct EffectRows {
    /// Numbers of [`AirframeEffects`].
    pub coefficients: [Row; EFFECTS],
    /// Fraction of the remaining speed difference that a falling rotor speed closes in one physics step.
    pub fall_share: Row,
    /// Numbers of [`DrivenBound`](super::reach_bound::DrivenBound).
    pub driven: [Row; DRIVEN],
}

impl EffectRows {
    /// Creates the rows of airframes without effects whose rotor speeds rise and fall with these shares.
    fn new(share: Row) -> Self {
        Self { coefficients: [[0.0; LANES]; EFFECTS], fall_share: share, driven: [[0.0; LANES]; DRIVEN] }
    }

    fn set(&mut self, lane: usize, Airframe { effects, fall_share, reach_bound, .. }: &Airframe) {
        put(&mut self.coefficients, lane, effects.0.numbers());
        self.fall_share[lane] = *fall_share;
        put(&mut self.driven, lane, reach_bound.driven().unwrap_or_default().numbers());
    }
}

/// Coefficients of air and medium in [`LaneParams`].
#[derive(Debug, Clone)]
#[repr(align(64))]
pub(super) struct AirRows {
    viscous: Row,
    quadratic: [Row; 3],
    viscous_rate: [Row; 3],
    quadratic_rate: [Row; 3],
    pub ground: [Row; 2],
    pub drag: [Row; 3],
    wake: [Row; 4],
}

impl AirRows {
    const NONE: Self = Self {
        viscous: [0.0; LANES],
        quadratic: [[0.0; LANES]; 3],
        viscous_rate: [[0.0; LANES]; 3],
        quadratic_rate: [[0.0; LANES]; 3],
        ground: [[0.0; LANES]; 2],
        drag: [[0.0; LANES]; 3],
        wake: [[0.0; LANES]; 4],
    };

    fn set(&mut self, lane: usize, Airframe { body, ground, drag, wake, .. }: &Airframe) {
        let fluid = &body.0.fluid;
        self.viscous[lane] = fluid.viscous;
        put(&mut self.quadratic, lane, fluid.quadratic);
        put(&mut self.viscous_rate, lane, fluid.viscous_rate);
        put(&mut self.quadratic_rate, lane, fluid.quadratic_rate);
        put(&mut self.ground, lane, [ground.0.coefficient, ground.0.clip]);
        put(&mut self.drag, lane, (*drag).into());
        let wake = &wake.0;
        put(&mut self.wake, lane, [wake.strength, wake.spread, wake.offset, wake.cap]);
    }
}

/// States of [`LANES`] drones, as a structure of arrays.
#[derive(Debug, Clone, Default)]
#[repr(align(64))]
pub struct Lanes {
    pub(super) position: [Row; 3],
    attitude: [Row; 4],
    velocity: [Row; 3],
    rate: [Row; 3],
    /// Commanded motor speeds of the last control step, rpm.
    pub(super) command: [Row; 4],
    /// Speeds of the rotors, rpm.
    pub(super) rpm: [Row; 4],
    /// Influences from outside; `None` if all are zero.
    outside: Option<Box<Outside>>,
    pub(super) rpy: [Row; 3],
    /// Load of the last physics step: thrust (N) and torque (body frame, N·m) of the rotors, external force (world
    /// frame, N).
    push: [Row; 7],
}

/// Influences on the drones in [`Lanes`] from outside.
#[derive(Debug, Clone)]
#[repr(align(64))]
pub(super) struct Outside {
    /// Force of the wind, world frame, N.
    pub force: [Row; 3],
    /// Velocity of the air, world frame, m/s.
    pub air: [Row; 3],
    /// Force of the wakes along world z, N.
    pub downwash: Row,
}

impl Outside {
    const NONE: Self = Self { force: [[0.0; LANES]; 3], air: [[0.0; LANES]; 3], downwash: [0.0; LANES] };
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

impl Airframe {
    /// Returns true if the airframe has effects of its own parameters.
    fn has_effects(&self) -> bool {
        !self.effects.are_absent() || self.fall_share != self.share
    }

    /// Returns true if air or a medium acts on the airframe.
    fn has_air(&self) -> bool {
        let Self { body, ground, drag, wake, .. } = self;
        body.0.fluid != Fluid::default()
            || *ground != GroundEffect::default()
            || *drag != Vector3::zeros()
            || *wake != Wake::default()
    }
}

impl LaneParams {
    /// Creates the parameters of one drone in every lane.
    pub fn all(airframe: &Airframe) -> Self {
        let mut all = Self::default();
        (0..LANES).for_each(|lane| all.set(lane, airframe));
        all
    }

    /// Returns the radius of the sphere around the drone of a lane, m.
    pub(crate) fn reach(&self, lane: usize) -> f64 {
        self.reach_bound[0][lane]
    }

    /// Returns the size on the heap in bytes.
    pub(crate) fn heap_bytes(&self) -> usize {
        (if self.air.is_some() { size_of::<AirRows>() } else { 0 })
            + if self.effects.is_some() { size_of::<EffectRows>() } else { 0 }
    }

    /// Returns the effects of the airframes' own parameters.
    #[inline(always)]
    pub(super) fn effects(&self) -> Option<&EffectRows> {
        self.effects.as_deref()
    }

    /// Returns the coefficients of air and medium.
    #[inline(always)]
    pub(super) fn air(&self) -> &AirRows {
        self.air.as_deref().unwrap_or(&AirRows::NONE)
    }

    /// Sets the parameters of a lane.
    pub fn set(&mut self, lane: usize, airframe: &Airframe) {
        let Airframe { body, rotors, share, max_command, gains, max_rpm, cylinder, reach_bound, .. } = airframe;
        match &mut self.air {
            Some(air) => air.set(lane, airframe),
            none if airframe.has_air() => none.insert(Box::new(AirRows::NONE)).set(lane, airframe),
            None => {}
        }
        match &mut self.effects {
            Some(effects) => effects.set(lane, airframe),
            none if airframe.has_effects() => {
                none.insert(Box::new(EffectRows::new(self.share))).set(lane, airframe);
            }
            None => {}
        }
        let body = &body.0;
        self.inverse_mass[lane] = body.inverse_mass;
        self.gravity[lane] = body.gravity;
        put(&mut self.inverse_inertia, lane, body.inverse_inertia);
        put(&mut self.gyration, lane, body.gyration);
        self.thrust[lane] = rotors.0.thrust;
        for (rows, values) in self.torque.iter_mut().zip(rotors.0.torque) {
            put(rows, lane, values);
        }
        self.share[lane] = *share;
        self.max_command[lane] = *max_command;
        put(&mut self.gains, lane, *gains);
        self.max_rpm[lane] = *max_rpm;
        put(&mut self.cylinder, lane, *cylinder);
        put(&mut self.reach_bound, lane, reach_bound.numbers());
    }
}

impl Lanes {
    /// Sets the state of a lane, and the current and commanded speeds of its motors, rpm.
    #[inline]
    pub fn set(&mut self, lane: usize, state: &DroneState, rpm: &[f64; 4], command: &[f64; 4]) {
        put(&mut self.command, lane, *command);
        put(&mut self.position, lane, state.position.into());
        put(&mut self.attitude, lane, wxyz(&state.attitude));
        put(&mut self.velocity, lane, state.velocity.into());
        put(&mut self.rate, lane, state.angular_velocity.into());
        put(&mut self.rpm, lane, *rpm);
    }

    /// Sets the commanded motor speeds of a lane, rpm.
    #[inline]
    pub fn set_command(&mut self, lane: usize, command: &[f64; 4]) {
        put(&mut self.command, lane, *command);
    }

    /// Returns the commanded motor speeds of all lanes in the last control step, rpm.
    pub(crate) fn commands(&self) -> &[Row; 4] {
        &self.command
    }

    /// Returns the commanded motor speeds of a lane in the last control step, rpm.
    #[inline]
    pub fn command(&self, lane: usize) -> [f64; 4] {
        take(&self.command, lane)
    }

    /// Sets position 3, quaternion 4, velocity 3 and angular velocity 3 of a lane.
    pub(crate) fn set_numbers(&mut self, lane: usize, numbers: &[f64; 13]) {
        let Self { position, attitude, velocity, rate, .. } = self;
        let rows = position.iter_mut().chain(attitude).chain(velocity).chain(rate);
        rows.zip(numbers).for_each(|(row, number)| row[lane] = *number);
    }

    /// Copies the states of other lanes, without motors and loads.
    pub(crate) fn copy_motion(&mut self, other: &Self) {
        (self.position, self.attitude) = (other.position, other.attitude);
        (self.velocity, self.rate) = (other.velocity, other.rate);
    }

    /// Copies what [`advance`](super::advance) changes: states, rotor speeds and loads.
    pub(crate) fn copy_moving(&mut self, other: &Self) {
        self.copy_motion(other);
        (self.rpm, self.push) = (other.rpm, other.push);
    }

    /// Copies what [`advance`](super::advance) changes, in one lane.
    pub(crate) fn copy_moving_lane(&mut self, lane: usize, other: &Self) {
        put(&mut self.position, lane, take(&other.position, lane));
        put(&mut self.attitude, lane, take(&other.attitude, lane));
        put(&mut self.velocity, lane, take(&other.velocity, lane));
        put(&mut self.rate, lane, take(&other.rate, lane));
        put(&mut self.rpm, lane, take(&other.rpm, lane));
        put(&mut self.push, lane, take(&other.push, lane));
    }

    /// Sets the force of the wind (world frame, N) and the velocity of the air (world frame, m/s) in a lane. The air
    /// velocity applies to the blade drag and to the medium.
    pub fn set_wind(&mut self, lane: usize, force: &Vector3<f64>, air: &Vector3<f64>) {
        let outside = self.outside_mut();
        put(&mut outside.force, lane, (*force).into());
        put(&mut outside.air, lane, (*air).into());
    }

    /// Returns the size on the heap in bytes.
    pub(crate) fn heap_bytes(&self) -> usize {
        if self.outside.is_some() { size_of::<Outside>() } else { 0 }
    }

    /// Returns the influences from outside.
    #[inline(always)]
    pub(super) fn outside(&self) -> &Outside {
        self.outside.as_deref().unwrap_or(&Outside::NONE)
    }

    /// Returns the influences from outside, for changes. Allocates their memory if they are all zero.
    #[inline(always)]
    pub(super) fn outside_mut(&mut self) -> &mut Outside {
        self.outside.get_or_insert_with(|| Box::new(Outside::NONE))
    }

    /// Clears the forces of the wakes. Allocates their memory.
    pub(crate) fn clear_downwash(&mut self) {
        self.outside_mut().downwash = [0.0; LANES];
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

    /// Returns roll, pitch and yaw of a lane, rad, from the last call of [`compute_rpys`](super::compute_rpys).
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
