//! A type of numbers that uses the provided functions of [`Real`] and knows no values of masks gets the same bits as a
//! double.

use proptest::prelude::*;

use crate::airframe::{AirframeEffects, AirframeMotion};
use crate::body::{FreeBody, Medium, Push};
use crate::clearance::CollisionCylinder;
use crate::downwash::Wake;
use crate::drag;
use crate::ground_effect::GroundEffect;
use crate::math::tests::{OPERATIONS, Plain};
use crate::math::{Real, Turn, V3};
use crate::random::{Key, Sampled};
use crate::rotor::RotorModel;
use crate::sensors::{Sensed, SensorParams};
use crate::state::FlightState;
use crate::tasks::track::{self, Circle};
use crate::tasks::{hover, race};
use crate::wind::{WindParams, WindParts, WindState};

impl Sampled for Plain {
    type Integer = u64;

    fn from_integer(integer: u64) -> Self {
        Self(integer as f64)
    }

    fn negated_by(self, integer: u64) -> Self {
        Self::choose(integer >> 63 == 1, -self, self)
    }
}

/// Conversion to a double and back.
trait Number: Sampled<Integer = u64> {
    fn of(x: f64) -> Self;
    fn double(self) -> f64;
}

impl Number for f64 {
    fn of(x: f64) -> Self {
        x
    }

    fn double(self) -> f64 {
        self
    }
}

impl Number for Plain {
    fn of(x: f64) -> Self {
        Self(x)
    }

    fn double(self) -> f64 {
        self.0
    }
}

const DT: f64 = 1.0 / 240.0;

fn vector<R: Number>([x, y, z]: [f64; 3]) -> V3<R> {
    V3::new(R::of(x), R::of(y), R::of(z))
}

/// Flies physics steps with every effect, and returns every number that they compute.
fn fly<R: Number>(start: &[[f64; 3]; 4], rpm: &[f64; 4], parts: WindParts) -> Vec<f64> {
    let all = |x: f64| R::of(x);
    let [position, rpy, velocity, rate] = *start;
    let mut state = FlightState {
        position: vector::<R>(position),
        attitude: Turn::from_rpy(vector(rpy)),
        velocity: vector(velocity),
        rate: vector(rate),
    };
    let medium = Medium { density: 1.225, viscosity: 1.8e-5 };
    let single = FreeBody::new(0.027, [1.4e-5, 1.4e-5, 2.17e-5], 9.81, Some(medium));
    let fluid = single.fluid;
    let body = FreeBody {
        inverse_mass: all(single.inverse_mass),
        gravity: all(single.gravity),
        inverse_inertia: single.inverse_inertia.map(all),
        gyration: single.gyration.map(all),
        fluid: crate::body::Fluid {
            viscous: all(fluid.viscous),
            quadratic: fluid.quadratic.map(all),
            viscous_rate: fluid.viscous_rate.map(all),
            quadratic_rate: fluid.quadratic_rate.map(all),
        },
    };
    let (x, z) = (1e-11, 2e-12);
    let torque = [[x, x, -x, -x], [-x, x, x, -x], [-z, z, -z, z]].map(|row| row.map(all));
    let rotors = RotorModel { thrust: all(3.16e-10), torque };
    let ground = GroundEffect { coefficient: all(1.5e-3), clip: all(0.05) };
    let wake = Wake { strength: all(0.08), spread: all(0.16), offset: all(-0.11), cap: all(0.6) };
    let effects = AirframeEffects {
        linear_drag: [0.02, 0.03, 0.04].map(all),
        translational_lift: all(0.002),
        velocity_moment: all(2e-4),
        rotational_damping: [4e-4, 5e-4, 3e-4].map(all),
        trim_torque: [1e-5, -2e-5, 5e-6].map(all),
        momentum_per_rpm: all(4e-9),
    };
    let wind = WindParams {
        mean: [1.5, -2.0, 0.4],
        constant: [1.5, -2.0, 0.4],
        along: [0.6, -0.8],
        sigma: 0.8,
        second_order: f64::from(u8::from(parts.second_order)),
        drag: 0.004,
        gust_force: 0.05,
        gust_hazard: 0.4,
        gust_share: 0.2,
        sinusoidal_force: 0.01,
        sinusoidal_turns: 0.01,
    };
    let key = Key::new(5, 1);
    let mut air = WindState::start(&wind, key, position[2]).map(|&x| all(x));
    let wind = wind.map(|&x| all(x));
    let sensors = SensorParams { sigmas: [0.01, 0.02, 0.4, 0.03].map(all), biases: [[0.1, -0.1, 0.05].map(all); 4] };
    let cylinder = CollisionCylinder { radius: all(0.06), height: all(0.03) };
    let circle = Circle {
        y: all(0.5),
        height: all(1.0),
        radius: all(0.5),
        rate: all(1.0),
        phase: all(2.0),
        direction: all(-1.0),
    };
    let (mut before, rpm, mut numbers) = (rpm.map(|x| all(0.9 * x)), rpm.map(all), vec![]);
    for step in 0..20_u64 {
        let now: [R; 4] = std::array::from_fn(|motor| crate::motors::follow(before[motor], rpm[motor], all(0.3)));
        let (thrust, torque) = rotors.thrust_and_torque(&now);
        let mut push = Push { thrust, torque, force: V3::zero(thrust) };
        let (force, velocity) = air.advance(parts, DT, &wind, key.at(step), state.position.z, state.velocity);
        let relative = state.velocity - velocity;
        push.force = force + body.medium_change(&state.attitude, state.velocity, velocity);
        push.force.z = push.force.z
            + ground.force(state.position.z, state.attitude.up().z, push.thrust)
            + wake.force(state.position.z.abs(), state.position.x * state.position.x);
        push.force = push.force + drag::force(vector([9e-7, 9e-7, 1e-6]), &state.attitude, &now, relative);
        let motion = AirframeMotion {
            attitude: &state.attitude,
            relative,
            rate: state.rate,
            momentum: [effects.momentum(&before), effects.momentum(&now)],
        };
        push.force = push.force + effects.add(DT, &motion, &mut push.thrust, &mut push.torque);
        state = if step % 2 == 0 {
            body.rk4::<true, true>(DT, &push, &state)
        } else {
            body.rk4::<false, false>(DT, &push, &state)
        };
        before = now;
        let FlightState { position, attitude, velocity, rate } = state;
        let truth = Sensed { position, attitude, rpy: attitude.rpy(), velocity, rate };
        let measured = sensors.measure(key.at(step), &truth);
        let mut seen = [all(0.0); 21];
        race::observe(&state, measured.rpy, [measured.position, position], &mut seen[..]);
        let [target, speed, _] = circle.motion(all(step as f64 * 0.1));
        numbers.extend(seen.map(R::double));
        numbers.extend(before.map(R::double));
        numbers.extend([measured.attitude.w, measured.attitude.v.x, measured.rate.z].map(R::double));
        numbers.push(cylinder.floor_clearance(position.z, attitude.up().z).double());
        numbers.push(hover::reward(&state, truth.rpy, target).double());
        numbers.push(track::reward(&state, truth.rpy, target, speed).double());
        numbers.push(attitude.rotation_vector().norm().double());
    }
    numbers
}

proptest! {
    #[test]
    fn numbers_with_arithmetic_alone_fly_bit_identically(
        position in prop::array::uniform3(-1.0..1.0), height in 0.0..8.0, rpy in prop::array::uniform3(-3.2..3.2),
        vertical: bool, velocity in prop::array::uniform3(-3.0..3.0), rate in prop::array::uniform3(-8.0..8.0),
        rpm in prop::array::uniform4(5e3..2e4), second_order: bool, gusts: bool,
    ) {
        let pitch = if vertical { std::f64::consts::FRAC_PI_2 } else { rpy[1] };
        let start = [[position[0], position[1], height], [rpy[0], pitch, rpy[2]], velocity, rate];
        let parts = WindParts { turbulence: true, second_order, gusts, sinusoidal: true };
        let bits = |numbers: Vec<f64>| numbers.into_iter().map(f64::to_bits).collect::<Vec<_>>();
        let doubles = fly::<f64>(&start, &rpm, parts);
        prop_assert!(doubles.iter().all(|x| x.is_finite()));
        prop_assert_eq!(bits(doubles), bits(fly::<Plain>(&start, &rpm, parts)));
    }
}

/// Operations of a control step of Hover with five physics steps and no effects, one drone: what a device computes for
/// an environment step, without loads, stores and integer arithmetic. `docs/gpu.md` derives its upper limits from it.
#[test]
fn a_control_step_of_hover_has_about_six_hundred_operations_a_physics_step() {
    let all = Plain::of;
    let body = FreeBody::without_medium(all(37.0), all(9.81), [7e4, 7e4, 4.6e4].map(all), [0.4, -0.4, 0.0].map(all));
    let x = 1e-11;
    let torque = [[x, x, -x, -x], [-x, x, x, -x], [-x, x, -x, x]].map(|row| row.map(all));
    let rotors = RotorModel { thrust: all(3.16e-10), torque };
    let mut state = FlightState {
        position: vector::<Plain>([0.1, 0.2, 0.9]),
        attitude: Turn::from_rpy(vector([0.1, -0.2, 0.4])),
        velocity: vector([0.1, 0.2, -0.3]),
        rate: vector([0.5, -0.4, 0.3]),
    };
    OPERATIONS.set(0);
    for _ in 0..5 {
        let (thrust, torque) = rotors.thrust_and_torque(&[14e3, 14.1e3, 14.2e3, 14.3e3].map(all));
        let push = Push { thrust, torque, force: V3::zero(thrust) };
        state = body.rk4_of_any_turn::<false, false>(DT, &push, &state);
    }
    let physics = OPERATIONS.replace(0);
    let rpy = state.attitude.rpy();
    let mut seen = [all(0.0); 12];
    hover::observe(&state, rpy, &mut seen[..]);
    hover::reward(&state, rpy, vector([0.0, 0.0, 1.0]));
    let task = OPERATIONS.get();
    assert!((2800..3300).contains(&physics), "{physics}");
    assert!((50..400).contains(&task), "{task}");
}
