//! The flight kernel matches MuJoCo's RK4 to rounding. The hybrid engine matches the MuJoCo engine, also with contacts.

mod common;

use mujoco_drones_gym::control::AnyController;
use mujoco_drones_gym::engine::flight::{
    Airframe, Flow, FreeBody, LANES, LaneParams, Lanes, Width, advance, compute_rpys, find_clear,
};
use mujoco_drones_gym::env::Randomization;
use mujoco_drones_gym::mujoco::{Data, Model};
use mujoco_drones_gym::physics::actuators::ActuatorParams;
use mujoco_drones_gym::physics::drag;
use mujoco_drones_gym::physics::rotor::RotorModel;
use mujoco_drones_gym::physics::wind::{WindConfig, WindModel};
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::state::wxyz;
use mujoco_drones_gym::tasks;
use mujoco_drones_gym::world::{DroneBody, Forcing, Medium, Obstacle, Shape, World};
use mujoco_drones_gym::{Rng, RngExt, SeedableRng};
use nalgebra::Vector3;

/// Returns motor speeds of an aperiodic tumble about all axes.
fn tumbling(params: &DroneParams, lane: usize, step: u32) -> [f64; 4] {
    let hover = params.hover_rpm();
    std::array::from_fn(|motor| {
        let phase = f64::from(step) * (0.11 + 0.03 * motor as f64) + lane as f64;
        hover * (0.25 + 0.1 * phase.sin())
    })
}

/// Returns a different initial state for each lane.
fn start(lane: usize, height: f64) -> DroneState {
    let x = lane as f64;
    DroneState {
        velocity: Vector3::new(0.4, -0.3, 0.2 * x),
        angular_velocity: Vector3::new(3.0 - x, 2.0 * (x - 4.0), 1.0 + 0.5 * x),
        ..DroneState::at_rest(Vector3::new(x, -x, height), Vector3::new(0.3 * x, 0.2, -0.7 * x))
    }
}

/// Returns the largest difference of position and quaternion components.
fn apart(a: &DroneState, b: &DroneState) -> f64 {
    (a.position - b.position).amax().max((a.attitude.coords - b.attitude.coords).amax())
}

#[test]
fn tumbling_lanes_match_mj_step_in_every_simd_width() {
    let dt = 1.0 / 240.0;
    // MuJoCo's rounding grows with the distance from the origin because it takes moments about it. Falling drones in
    // vacuum therefore fly 3 s instead of 10 s
    for (model, forcing, medium, gravity, steps) in [
        (DroneModel::Cf2x, Forcing::Frozen, None, 0.0, 2400),
        (DroneModel::Cf2p, Forcing::BodyFixed, None, 0.0, 2400),
        (DroneModel::Race, Forcing::Frozen, Some(Medium::AIR), 9.81, 2400),
        (DroneModel::Cf2x, Forcing::BodyFixed, Some(Medium::AIR), 9.81, 2400),
        (DroneModel::Cf2x, Forcing::Frozen, None, 9.81, 720),
        (DroneModel::Cf2p, Forcing::BodyFixed, None, 9.81, 720),
    ] {
        let height = if gravity > 0.0 { 300.0 } else { 60.0 };
        let params = model.params();
        let rotors = RotorModel::new(&params);
        let body = FreeBody::new(params.mass, &params.inertia_vector(), gravity, medium);
        let airframe = Airframe { body, rotors, share: 1.0, ..Airframe::default() };
        let frames = LaneParams::all(&airframe);
        let mut fields: Vec<_> = Width::available().map(|width| (width, Lanes::default())).collect();
        // `mj_step` and the scalar kernel below fly the same lanes one at a time
        for (_, lanes) in &mut fields {
            for lane in 0..LANES {
                lanes.set(lane, &start(lane, height), &[0.0; 4], &[0.0; 4]);
            }
        }
        for step in 0..steps {
            for (width, lanes) in &mut fields {
                for lane in 0..LANES {
                    lanes.set_command(lane, &tumbling(&params, lane, step));
                }
                let (body_fixed, medium) = (forcing == Forcing::BodyFixed, medium.is_some());
                advance(
                    &Flow { dt, body_fixed, medium, lag: false, air: false, airframe_effects: false, width: *width },
                    lanes,
                    &frames,
                    LANES,
                    1,
                );
            }
        }
        for lane in 0..LANES {
            let drone = DroneBody { params: params.clone(), position: Vector3::zeros(), rpy: Vector3::zeros() };
            let world = World { timestep: dt, forcing, medium, gravity, ..World::new(vec![drone]) };
            let mut data = Data::new(Model::from_xml(&world.to_mjcf().unwrap()).unwrap()).unwrap();
            let state = start(lane, height);
            data.qpos_mut()[..3].copy_from_slice(state.position.as_slice());
            data.qpos_mut()[3..7].copy_from_slice(&wxyz(&state.attitude));
            data.qvel_mut()[..3].copy_from_slice(state.velocity.as_slice());
            data.qvel_mut()[3..6].copy_from_slice(state.angular_velocity.as_slice());
            let mut scalar = state;
            let mut turned = 0.0_f64;
            for step in 0..steps {
                let wrench = rotors.wrench(&tumbling(&params, lane, step));
                let q = data.qpos();
                let attitude = mujoco_drones_gym::state::attitude_from_wxyz([q[3], q[4], q[5], q[6]]);
                if forcing == Forcing::BodyFixed {
                    let torque = wrench.torque_body;
                    data.ctrl_mut().copy_from_slice(&[wrench.thrust, torque.x, torque.y, torque.z]);
                } else {
                    let world = wrench.in_world(&attitude);
                    data.xfrc_applied_mut()[6..9].copy_from_slice(world.force_world.as_slice());
                    data.xfrc_applied_mut()[9..12].copy_from_slice(world.torque_world.as_slice());
                }
                data.step().unwrap();
                let none = Vector3::zeros();
                scalar = match (forcing, medium.is_some()) {
                    (Forcing::Frozen, false) => body.step::<false, false>(dt, &wrench, &none, &scalar),
                    (Forcing::Frozen, true) => body.step::<false, true>(dt, &wrench, &none, &scalar),
                    (Forcing::BodyFixed, false) => body.step::<true, false>(dt, &wrench, &none, &scalar),
                    (Forcing::BodyFixed, true) => body.step::<true, true>(dt, &wrench, &none, &scalar),
                };
                turned = turned.max(scalar.angular_velocity.norm());
            }
            assert!(turned > 2.0, "the drone tumbles");
            let (q, v) = (data.qpos(), data.qvel());
            let oracle = DroneState {
                position: Vector3::new(q[0], q[1], q[2]),
                attitude: mujoco_drones_gym::state::attitude_from_wxyz([q[3], q[4], q[5], q[6]]),
                velocity: Vector3::new(v[0], v[1], v[2]),
                angular_velocity: Vector3::new(v[3], v[4], v[5]),
            };
            let error = apart(&scalar, &oracle);
            assert!(error < 1e-11, "{model:?} {forcing:?} {medium:?} {gravity}: {error:e} at {:?}", scalar.position);
            for (width, lanes) in &fields {
                assert_eq!(lanes.state(lane), scalar, "{model:?} {forcing:?} {medium:?} {width:?}");
            }
        }
    }
}

/// The first lanes alone are bit-identical to the same lanes among eight, and the other lanes do not change.
#[test]
fn the_first_lanes_are_bit_identical_alone_and_among_eight() {
    let params = DroneModel::Cf2x.params();
    for (body_fixed, medium, air) in
        [(false, None, false), (false, None, true), (false, Some(Medium::AIR), true), (true, Some(Medium::AIR), true)]
    {
        let body = FreeBody::new(params.mass, &params.inertia_vector(), 9.81, medium);
        let drag = params.drag_coefficients.into();
        let airframe = Airframe { body, rotors: RotorModel::new(&params), drag, share: 0.3, ..Airframe::default() };
        let frames = LaneParams::all(&airframe);
        let mut first = Lanes::default();
        for lane in 0..LANES {
            first.set(lane, &start(lane, 50.0), &[14_000.0; 4], &tumbling(&params, lane, 3));
        }
        let fly = |width, count| {
            let flow = Flow {
                dt: 1.0 / 240.0,
                body_fixed,
                medium: medium.is_some(),
                lag: air,
                air,
                airframe_effects: false,
                width,
            };
            let mut lanes = first.clone();
            advance(&flow, &mut lanes, &frames, count, 5);
            compute_rpys(width, &mut lanes, count);
            let clear = find_clear(&flow, std::slice::from_ref(&lanes), std::slice::from_ref(&frames), count, 5);
            (lanes, clear)
        };
        let (all, all_clear) = fly(Width::Portable, LANES);
        assert_ne!(all.state(LANES - 1), first.state(LANES - 1));
        for width in Width::available() {
            for count in 1..=LANES {
                let (lanes, clear) = fly(width, count);
                for lane in 0..count {
                    let (got, expected) = (&lanes, &all);
                    assert_eq!(got.state(lane), expected.state(lane), "{width:?}, {lane} of {count}");
                    assert_eq!(got.rpm(lane), expected.rpm(lane));
                    assert_eq!(got.rpy(lane), expected.rpy(lane));
                    assert_eq!(got.push(lane), expected.push(lane));
                    assert_eq!(clear[lane], all_clear[lane]);
                }
                // the last register may include up to three more lanes
                for lane in count.next_multiple_of(4)..LANES {
                    assert_eq!(lanes.state(lane), first.state(lane), "{width:?}, {lane} behind {count}");
                }
            }
        }
    }
}

/// Roll, pitch and yaw of lanes are bit-identical to those of single drones, also at and near gimbal lock, for any
/// contents of the other lanes.
#[test]
fn angles_of_lanes_are_bit_identical_to_those_of_single_drones() {
    use std::f64::consts::FRAC_PI_2;
    let mut rng = Rng::seed_from_u64(4);
    for _ in 0..200 {
        let states: [DroneState; LANES] = std::array::from_fn(|lane| {
            let [roll, yaw, share] = [(); 3].map(|()| rng.random::<f64>());
            let off = [1.0, 1e-4, 1e-9, 1e-12, 1e-14, 1e-16, 0.0][rng.random_range(0..7)] * share;
            let pitch = if lane % 3 == 0 { FRAC_PI_2 - off } else { off - FRAC_PI_2 };
            DroneState::at_rest(Vector3::zeros(), Vector3::new(6.0 * roll - 3.0, pitch, 6.0 * yaw - 3.0))
        });
        for width in Width::available() {
            let mut lanes = Lanes::default();
            states.iter().enumerate().for_each(|(lane, state)| lanes.set(lane, state, &[0.0; 4], &[0.0; 4]));
            compute_rpys(width, &mut lanes, LANES);
            for (lane, state) in states.iter().enumerate() {
                assert_eq!(lanes.rpy(lane).map(f64::to_bits), state.rpy().map(f64::to_bits), "{width:?} {state:?}");
            }
        }
    }
}

/// Lanes in wind are bit-identical to single drones. The force on a lane is the sum of the force of its wind, drag in
/// the relative wind, and the force of a medium that moves with the air.
#[test]
fn lanes_in_wind_and_medium_are_bit_identical_to_single_drones() {
    let (dt, params) = (1.0 / 240.0, DroneModel::Cf2x.params());
    let rotors = RotorModel::new(&params);
    let drag = Vector3::from(params.drag_coefficients);
    for medium in [None, Some(Medium::AIR)] {
        let body = FreeBody::new(params.mass, &params.inertia_vector(), 9.81, medium);
        let frames = LaneParams::all(&Airframe { body, rotors, drag, share: 1.0, ..Airframe::default() });
        let (force, air) = (Vector3::new(0.001, -0.002, 0.003), Vector3::new(2.0, -1.0, 0.5));
        let rpm = [14_000.0, 15_000.0, 14_500.0, 13_500.0];
        for width in Width::available() {
            let mut lanes = Lanes::default();
            for lane in 0..LANES {
                lanes.set(lane, &start(lane, 50.0), &rpm, &rpm);
                // every other lane is in still air
                if lane % 2 == 0 {
                    lanes.set_wind(lane, &force, &air);
                }
            }
            let flow = Flow {
                dt,
                body_fixed: false,
                medium: medium.is_some(),
                lag: true,
                air: true,
                airframe_effects: false,
                width,
            };
            advance(&flow, &mut lanes, &frames, LANES, 1);
            for lane in 0..LANES {
                let state = start(lane, 50.0);
                let (force, air) = if lane % 2 == 0 { (force, air) } else { (Vector3::zeros(), Vector3::zeros()) };
                let wrench = rotors.wrench(&rpm);
                let mut total = force;
                if medium.is_some() {
                    total += body.moving_medium(&state.attitude, &state.velocity, &air);
                }
                total += drag::force(&params, &state, &rpm, &air);
                let expected = match medium {
                    None => body.step::<false, false>(dt, &wrench, &total, &state),
                    Some(_) => body.step::<false, true>(dt, &wrench, &total, &state),
                };
                assert_eq!(lanes.state(lane), expected, "{width:?} {medium:?} lane {lane}");
            }
        }
    }
}

/// Largest differences between two engines in an episode.
#[derive(Debug, Default)]
struct Apart {
    /// Largest difference before the first contact.
    before: f64,
    /// Largest difference within 1 s after the first contact.
    after: f64,
    touched: bool,
    /// True if a difference by rounding has grown above 1e-9 in the MuJoCo engine.
    unstable: bool,
    /// Physics steps of the hybrid engine in the flight kernel.
    flown: u64,
    /// Physics steps of the hybrid engine in MuJoCo.
    stepped: u64,
}

/// Flies the same episode with both engines. `act` computes the action from the environment of the first engine.
///
/// A third environment has a first action that differs by rounding. The comparison ends where that flight departs,
/// because an unstable control loop amplifies any difference.
fn compare(config: &EnvConfig, name: &str, seed: u64, mut act: impl FnMut(&dyn DroneEnv, &mut [f64])) -> Apart {
    let mut envs = EngineKind::WITH_CONTACTS.map(|engine| make(name, config.clone().engine(engine)).unwrap());
    let mut twin = make(name, config.clone().engine(EngineKind::Mujoco)).unwrap();
    twin.reset(Some(seed)).unwrap();
    envs.iter_mut().for_each(|env| {
        env.reset(Some(seed)).unwrap();
    });
    let mut action = vec![0.0; envs[0].action_space().size()];
    let mut result = Apart::default();
    let mut since = None;
    loop {
        act(&*envs[0], &mut action);
        let ends = envs.each_mut().map(|env| {
            let step = env.step(&action).unwrap();
            step.terminated || step.truncated
        });
        if since.is_none() {
            if envs[0].simulation().control_steps() == 1 {
                action.iter_mut().for_each(|x| *x += 1e-13 * (1.0 + x.abs()));
            }
            twin.step(&action).unwrap();
        }
        let [a, b] = envs.each_ref().map(|env| env.simulation());
        if since.is_none() && a.contacts().iter().chain(b.contacts()).next().is_some() {
            since = Some(a.time());
        }
        let error = a.states().iter().zip(b.states()).map(|(a, b)| apart(a, b)).fold(0.0, f64::max);
        match since {
            None => result.before = result.before.max(error),
            Some(time) if a.time() - time <= 1.0 => result.after = result.after.max(error),
            Some(_) => break,
        }
        let twins = a.states().iter().zip(twin.simulation().states());
        if since.is_none() && twins.map(|(a, b)| apart(a, b)).fold(0.0, f64::max) > 1e-9 {
            result.unstable = true;
            break;
        }
        assert_eq!(ends[0], ends[1], "{name} {seed} {result:?}");
        if ends[0] {
            break;
        }
    }
    let substeps = envs[1].simulation().engine_substeps();
    result.touched = since.is_some();
    (result.flown, result.stepped) = (substeps.flight, substeps.mujoco);
    result
}

fn check(what: &str, apart: &Apart) {
    assert!(apart.before < 1e-9 && apart.after < 1e-6, "{what}: {apart:?}");
}

#[test]
fn controllers_fly_every_task_identically_with_both_engines() {
    for name in tasks::NAMES {
        for drone in DroneModel::PAPER {
            // drones of these tasks fly at one height, where the published downwash is singular: rounding errors decide
            // which drone is pushed down
            let downwash = !["formation", "antipodal"].contains(&name);
            let effects = Effects { downwash, ..Effects::ALL };
            let config = EnvConfig::default().drone(drone).episode_seconds(10.0).effects(effects);
            let kind = tasks::summary(name).unwrap().defaults.controller;
            let mut controllers: Vec<AnyController> = Vec::new();
            let mut speeds = Vec::new();
            let result = compare(&config, name, 3, |env, action| {
                let simulation = env.simulation();
                if controllers.is_empty() {
                    controllers = (0..simulation.num_drones()).map(|i| kind.build(simulation.params(i))).collect();
                }
                speeds.clear();
                for (i, controller) in controllers.iter_mut().enumerate() {
                    speeds.push(controller.control(1.0 / 48.0, &simulation.states()[i], &env.reference(i)).rpm);
                }
                env.action_of_motor_speeds(&speeds, action).unwrap();
            });
            check(&format!("{name} {drone:?}"), &result);
            assert!(result.flown > 20 * result.stepped, "{name} {drone:?}: {result:?}");
        }
    }
}

/// Returns random actions that change slowly: drones take off, tumble and crash.
fn wandering(seed: u64) -> impl FnMut(&dyn DroneEnv, &mut [f64]) {
    let mut rng = Rng::seed_from_u64(seed);
    let mut held: Vec<f64> = Vec::new();
    move |_, action| {
        held.resize(action.len(), 0.0);
        for x in &mut held {
            *x = (0.9 * *x + 0.25 * (rng.random::<f64>() - 0.5)).clamp(-1.0, 1.0);
        }
        action.copy_from_slice(&held);
    }
}

#[test]
fn random_flights_with_contacts_are_identical_with_both_engines() {
    let boxes = [
        Obstacle::new(Shape::Box { half_size: [0.1, 0.3, 0.3] }, Vector3::new(0.35, 0.0, 0.3)),
        Obstacle::new(Shape::Cylinder { radius: 0.1, half_height: 0.5 }, Vector3::new(-0.3, 0.2, 0.5)),
        Obstacle::new(Shape::Sphere { radius: 0.2 }, Vector3::new(0.0, -0.5, 0.2)),
    ];
    let (mut touched, mut worst) = (0, Apart::default());
    for seed in 0..if cfg!(debug_assertions) { 12 } else { 60 } {
        for drone in DroneModel::PAPER {
            for name in tasks::NAMES {
                let downwash = !["formation", "antipodal"].contains(&name);
                let mut config = EnvConfig::default().drone(drone).effects(Effects { downwash, ..Effects::ALL });
                let randomized = Randomization { sensors: None, environment: None, ..Randomization::default() };
                config = match seed % 6 {
                    0 => config,
                    1 => config.randomization(randomized),
                    // only with these starts no drone touches an obstacle at reset
                    2 if ["hover", "fly_through"].contains(&name) && drone != DroneModel::Race => {
                        config.obstacles(boxes)
                    }
                    2 => config,
                    3 => config.forcing(Forcing::BodyFixed),
                    4 => config.medium(Medium::AIR),
                    _ => config
                        .wind(WindConfig::new(WindModel::Combined))
                        .actuators(ActuatorParams { lag: 0.03, ..ActuatorParams::default() }),
                };
                let result = compare(&config, name, seed, wandering(seed));
                check(&format!("{name} {drone:?} {seed}"), &result);
                touched += usize::from(result.touched);
                worst.before = worst.before.max(result.before);
                worst.after = worst.after.max(result.after);
                worst.flown += result.flown;
                worst.stepped += result.stepped;
            }
        }
    }
    assert!(touched > 20 && worst.flown > worst.stepped, "{touched} {worst:?}");
}

/// Flies at random under wind, slow and late motors, late sensors, sampled parameters, among obstacles, with every
/// action type, at odd control rates, and under all of that together.
#[test]
fn random_flights_under_every_condition_are_identical_with_both_engines() {
    let (mut touched, mut flights, mut unstable, mut worst) = (0, 0, 0, Apart::default());
    for (n, (condition, config)) in common::conditions::all().into_iter().enumerate() {
        let among_obstacles = condition.contains("obstacles") || condition.contains("everything");
        for seed in 0..if cfg!(debug_assertions) { 2 } else { 10 } {
            // the forest has no room for large drones and for the starts of other tasks
            let (tasks, drone) = if among_obstacles {
                (&["hover"][..], DroneModel::Cf2x)
            } else {
                (
                    &["hover", "multi_hover", "race"][..],
                    DroneModel::PAPER[(n + seed as usize) % DroneModel::PAPER.len()],
                )
            };
            for name in tasks {
                let mut wander = wandering(seed);
                let params = common::conditions::airframe_for(&condition, drone);
                let result = compare(&config.clone().drone(params.clone()), name, seed, |env, action| {
                    wander(env, action);
                    let hover = params.hover_rpm();
                    let hover = match env.action_type() {
                        ActionType::RawRpm => hover,
                        ActionType::Duty => params.motors.duty(hover, params.nominal_voltage()),
                        _ => return,
                    };
                    action.iter_mut().for_each(|command| *command = hover * (1.0 + 0.3 * *command));
                });
                check(&format!("{condition}, {name}, {drone:?}, seed {seed}"), &result);
                touched += usize::from(result.touched);
                worst.before = worst.before.max(result.before);
                worst.after = worst.after.max(result.after);
                worst.flown += result.flown;
                worst.stepped += result.stepped;
                flights += 1;
                unstable += usize::from(result.unstable);
            }
        }
    }
    assert!(touched > 20 && worst.flown > worst.stepped, "{touched} {worst:?}");
    // motors that lag by 50 ms with a latency of 50 ms make the default loops unstable
    assert!(unstable * 10 < flights, "{unstable} of {flights}");
}

/// Simulations without a task have no end: a drone bounces on the floor and takes off again.
#[test]
fn a_landing_and_a_second_take_off_are_identical_with_both_engines() {
    for drone in DroneModel::PAPER {
        let mut simulations = EngineKind::WITH_CONTACTS.map(|engine| {
            Simulation::builder(drone)
                .physics(Physics::MjcGndDragDw)
                .initial_positions([[0.0, 0.0, 0.5]])
                .initial_rpys([[0.01, -0.02, 2.0]])
                .engine(engine)
                .build()
                .unwrap()
        });
        let hover = drone.params().hover_rpm();
        let (mut contact, mut contacts, mut worst) = (None, 0, 0.0_f64);
        for step in 0..240 {
            let throttle = if step < 60 { 0.8 } else { 1.06 };
            for simulation in &mut simulations {
                simulation.step(&[[throttle * hover; 4]]).unwrap();
            }
            let [a, b] = &simulations;
            if contact.is_none() && !a.contacts().is_empty() {
                contact = Some(step);
            }
            contacts += usize::from(!b.contacts().is_empty());
            if contact.is_none_or(|first| step < first + 48) {
                worst = worst.max(apart(&a.states()[0], &b.states()[0]));
            }
        }
        assert!(contact.is_some() && worst < 1e-6, "{drone:?}: {worst:e}");
        let [a, b] = &simulations;
        assert!(a.states()[0].position.z > 1.0 && b.states()[0].position.z > 1.0, "the drone takes off again");
        let substeps = b.engine_substeps();
        assert!(contacts > 10 && substeps.mujoco == 0, "the kernel computes {contacts} steps in contact: {substeps:?}");
    }
}

#[test]
fn mujoco_steps_integrators_and_rotations_that_the_flight_kernel_does_not_support() {
    use mujoco_drones_gym::world::Integrator;
    let hybrid =
        || Simulation::builder(DroneModel::Cf2x).initial_positions([[0.0, 0.0, 5.0]]).engine(EngineKind::Hybrid);
    let too_fast_for_the_series = [[0.0, 0.0, 300.0]];
    for builder in
        [hybrid().integrator(Integrator::Euler), hybrid().initial_angular_velocities(too_fast_for_the_series)]
    {
        let mut simulation = builder.build().unwrap();
        simulation.step(&[[14_000.0; 4]]).unwrap();
        assert_eq!((simulation.engine_substeps().flight, simulation.engine_substeps().mujoco), (0, 5));
    }
}
