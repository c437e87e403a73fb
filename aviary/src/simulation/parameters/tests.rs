//! Reach bounds of random airframes: no flight leaves its ball.

use std::cell::Cell;

use nalgebra::Vector3;
use proptest::prelude::*;
use proptest::test_runner::{Config, TestRunner};

use crate::drone::{AirParams, DroneModel, DroneParams, MotorParams};
use crate::engine::EngineKind;
use crate::engine::flight::FreeBody;
use crate::physics::actuators::ActuatorParams;
use crate::physics::wind::{WindConfig, WindModel};
use crate::simulation::Simulation;
use crate::state::DroneState;
use crate::world::Forcing;

/// Numbers from ±10⁻² to ±10 on a logarithmic scale, so that effects from none to violent occur.
fn factor() -> impl Strategy<Value = f64> {
    (-2.0..1.0f64, any::<bool>()).prop_map(|(exponent, sign)| 10f64.powf(exponent) * if sign { 1.0 } else { -1.0 })
}

fn airframe(f: &[f64]) -> DroneParams {
    let air = AirParams {
        linear_drag: [f[0], f[1], f[2]].map(|x| 0.05 * x.abs()),
        translational_lift: 0.01 * f[3],
        velocity_moment: 1e-3 * f[4],
        rotational_damping: [f[5], f[6], f[7]].map(|x| 1e-4 * x.abs()),
        trim_torque: [f[8], f[9], f[10]].map(|x| 1e-4 * x),
    };
    let motors = MotorParams {
        rise_time: 0.01 * f[11].abs(),
        latency: 0.001 * f[12].abs(),
        rotor_inertia: 5e-8 * f[13].abs(),
        ..MotorParams::default()
    };
    DroneParams { air, motors, ..DroneModel::Cf2x.params() }
}

/// Airframe, initial motion, conditions and commands of a flight.
#[derive(Debug, Clone)]
struct Flight {
    factors: Vec<f64>,
    state: [f64; 9],
    commands: Vec<[f64; 4]>,
    air: [f64; 3],
    speed: f64,
    rate: f64,
    body_fixed: bool,
    lag: bool,
    rates: (u32, u32),
}

fn flights() -> impl Strategy<Value = Flight> {
    let rates = prop::sample::select(vec![(240, 240), (240, 48), (240, 24), (500, 50)]);
    let motion = (prop::array::uniform9(-1.0..1.0f64), prop::array::uniform3(-8.0..8.0f64), 0.0..30.0f64, 0.0..60.0f64);
    let commands = prop::collection::vec(prop::array::uniform4(0.0..1.0f64), 12);
    let numbers = (prop::collection::vec(factor(), 14), commands, motion, any::<bool>(), any::<bool>(), rates);
    numbers.prop_map(|(factors, commands, (state, air, speed, rate), body_fixed, lag, rates)| Flight {
        factors,
        state,
        commands,
        air,
        speed,
        rate,
        body_fixed,
        lag,
        rates,
    })
}

/// Flies random commands and returns the number of control steps, and of those with a finite bound.
fn fly(flight: &Flight) -> Result<[u32; 2], TestCaseError> {
    let params = airframe(&flight.factors);
    let max = params.max_rpm();
    let wind = WindConfig { velocity: flight.air, ..WindConfig::new(WindModel::Combined) };
    let motors = ActuatorParams { lag: if flight.lag { 0.004 } else { 0.0 }, ..ActuatorParams::default() };
    let builder = Simulation::builder(params).engine(EngineKind::Hybrid).wind(wind).actuators(motors);
    let builder = builder.sim_freq(flight.rates.0).ctrl_freq(flight.rates.1);
    let builder = builder.forcing(if flight.body_fixed { Forcing::BodyFixed } else { Forcing::Frozen });
    let mut simulation = builder.initial_positions([[0.0, 0.0, 500.0]]).build().unwrap();
    let [a, b, c, d, e, g, roll, pitch, yaw] = flight.state;
    let start = DroneState {
        velocity: Vector3::new(a, b, c) * flight.speed,
        angular_velocity: Vector3::new(d, e, g) * flight.rate,
        ..DroneState::at_rest(Vector3::new(0.0, 0.0, 500.0), Vector3::new(3.0 * roll, 1.5 * pitch, 3.0 * yaw))
    };
    simulation.reset_to(&[start]).unwrap();
    let (dt, model) = (simulation.model.world.timestep, simulation.model.clone());
    let mut counts = [0; 2];
    for command in &flight.commands {
        simulation.data.refresh(&model);
        let before = simulation.states()[0];
        let bound = simulation.data.bodies.drones[0].reach_bound;
        let radius = bound.radius(dt, model.substeps(), &before);
        // full throttle and none are the extremes
        let command = command.map(|x| {
            max * if x < 0.3 {
                0.0
            } else if x > 0.7 {
                1.0
            } else {
                x
            }
        });
        if simulation.step(&[command]).is_err() {
            break;
        }
        counts[0] += 1;
        if radius.is_finite() {
            counts[1] += 1;
            let after = simulation.states()[0];
            let travel = (after.position - before.position).norm();
            prop_assert!(travel <= radius - bound.reach(), "{travel} {radius} {before:?}");
            let turn = after.angular_velocity.norm() * dt;
            prop_assert!(turn < FreeBody::MAX_TURN, "{turn} {before:?}");
        }
    }
    Ok(counts)
}

/// A drone stays in the ball of its bound, and turns slowly enough for the kernel, for any effects, wind, state and
/// motor commands.
#[test]
fn drones_stay_within_their_reach() {
    let mut runner = TestRunner::new(Config { failure_persistence: None, ..Config::with_cases(400) });
    let (steps, bounded) = (Cell::new(0), Cell::new(0));
    let result = runner.run(&flights(), |flight| {
        let [all, finite] = fly(&flight)?;
        steps.set(steps.get() + all);
        bounded.set(bounded.get() + finite);
        Ok(())
    });
    assert!(result.is_ok(), "{}", result.unwrap_err());
    // many of these flights are too violent for any bound
    let (steps, bounded) = (steps.get(), bounded.get());
    assert!(steps > 1000 && bounded > steps / 10, "{bounded} of {steps}");
}

/// The bound has a finite radius at the motions of usual flights with every effect of the size that recorded flights of
/// a Crazyflie show, and grows by little.
#[test]
fn usual_effects_keep_the_bound_useful() {
    let air = AirParams {
        linear_drag: [0.02, 0.02, 0.03],
        translational_lift: 0.003,
        velocity_moment: 2e-4,
        rotational_damping: [4.6e-4; 3],
        trim_torque: [1e-5; 3],
    };
    let motors = MotorParams { rotor_inertia: 3e-8, ..MotorParams::default() };
    let radius = |params: DroneParams| {
        let builder = Simulation::builder(params).initial_positions([[0.0, 0.0, 2.0]]);
        let mut simulation = builder.initial_velocities([[2.0, -1.0, 0.5]]).build().unwrap();
        let model = simulation.model.clone();
        simulation.data.refresh(&model);
        let state = DroneState { angular_velocity: Vector3::new(3.0, -2.0, 1.0), ..simulation.states()[0] };
        simulation.data.bodies.drones[0].reach_bound.radius(1.0 / 240.0, 5, &state)
    };
    let plain = radius(DroneModel::Cf2x.params());
    let driven = radius(DroneParams { air, motors, ..DroneModel::Cf2x.params() });
    assert!(driven > plain && driven < 1.1 * plain, "{plain} {driven}");
}
