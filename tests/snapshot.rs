//! Snapshots: the flight after a restore is bit-identical to the flight after the snapshot, in every environment.

mod common;

use common::{step_simulation, step_to_end};
use mujoco_drones_gym::action::ActionLimits;
use mujoco_drones_gym::control::CollisionCone;
use mujoco_drones_gym::env::{EnvSnapshot, Randomization};
use mujoco_drones_gym::physics::actuators::ActuatorParams;
use mujoco_drones_gym::physics::wind::{WindConfig, WindModel};
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::simulation::{SimData, step as step_data};
use mujoco_drones_gym::tasks::NAMES;
use mujoco_drones_gym::world::{Forcing, Obstacle, ObstacleConfig, ObstacleKind, Shape};
use mujoco_drones_gym::wrappers::{CurriculumConfig, CurriculumWrapper, SafetyWrapper};
use mujoco_drones_gym::{Rng, RngExt as _, SeedableRng as _};
use nalgebra::Vector3;
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value;

/// Steps an environment with a random action, or resets it after the end of an episode, and appends the bits of all
/// outputs.
fn step(env: &mut dyn DroneEnv, rng: &mut Rng, out: &mut Vec<u64>) {
    let action: Vec<f64> = (0..env.action_space().size()).map(|_| 0.6 * rng.random::<f64>() - 0.28).collect();
    if env.info().end.is_some() {
        env.reset(None).unwrap();
        out.push(1);
    } else {
        let step = env.step(&action).unwrap();
        out.extend([step.reward.to_bits(), step.terminated.into(), step.truncated.into()]);
    }
    let observation = env.observation();
    let numbers = observation.vector.iter().chain(&observation.ranges).chain(&observation.obstacle);
    out.extend(numbers.map(|x| x.to_bits()));
    out.extend(env.info_map().into_values().map(f64::to_bits));
    for (drone, state) in env.simulation().states().iter().enumerate() {
        let (p, v) = (state.position.iter(), state.velocity.iter());
        out.extend(p.chain(v).chain(state.attitude.coords.iter()).chain(&state.angular_velocity).map(|x| x.to_bits()));
        out.extend(env.simulation().rotor_speeds(drone).map(f64::to_bits));
        out.push(env.drone_reward(drone).to_bits());
    }
    let contacts = env.simulation().contacts().iter().map(|contact| contact.drone as u64);
    out.extend(contacts);
    out.extend(env.simulation().obstacles().iter().map(|obstacle| obstacle.position.x.to_bits()));
}

/// Steps an environment with random actions from a seed and returns the bits of all outputs.
fn flight(env: &mut dyn DroneEnv, seed: u64, steps: usize) -> Vec<u64> {
    let (mut rng, mut out) = (Rng::seed_from_u64(seed), Vec::new());
    (0..steps).for_each(|_| step(env, &mut rng, &mut out));
    out
}

/// Writes a snapshot to JSON and reads it back.
fn written_and_read<V: Serialize + DeserializeOwned>(snapshot: &V) -> V {
    let text = serde_json::to_string(snapshot).unwrap();
    let read: V = serde_json::from_str(&text).unwrap();
    assert_eq!(
        serde_json::to_string(&read).unwrap(),
        text,
        "the snapshot changed when it was written to JSON and read"
    );
    read
}

/// Asserts that a flight from a snapshot is repeated bit-identically from the snapshot in the same environment, in
/// another one, and in a third one from its JSON text.
fn assert_repeats(what: &str, build: &dyn Fn() -> Box<dyn DroneEnv>) {
    let (mut env, mut other, mut third) = (build(), build(), build());
    for (seed, before) in [(1, 0), (2, 7), (3, 40)] {
        env.reset(Some(seed)).unwrap();
        flight(&mut *env, seed, before);
        let snapshot: EnvSnapshot = env.snapshot();
        let (observation, info) = (env.observation().clone(), env.info());
        let expected = flight(&mut *env, 100 + seed, 90);
        // the other environment is in another episode before the restore
        other.reset(Some(9)).unwrap();
        flight(&mut *other, 5, 13);
        let read = written_and_read(&snapshot);
        for (env, snapshot) in [(&mut env, &snapshot), (&mut other, &snapshot), (&mut third, &read)] {
            env.restore(snapshot).unwrap();
            assert_eq!((env.observation(), env.info()), (&observation, info), "{what}, seed {seed}");
            let got = flight(&mut **env, 100 + seed, 90);
            assert!(got == expected, "{what}, seed {seed} after {before} steps");
        }
    }
}

/// Returns conditions of flights with their names.
fn conditions() -> Vec<(&'static str, EnvConfig)> {
    let config = EnvConfig::default;
    let forest = ObstacleConfig { new_layout: true, ..ObstacleConfig::new(ObstacleKind::Forest) };
    let motors =
        ActuatorParams { lag: 0.03, latency: 0.02, gains: [1.0, 0.98, 1.02, 0.99], ..ActuatorParams::default() };
    vec![
        ("still air", config()),
        ("all effects", config().physics(Physics::MjcGndDragDw)),
        ("wind", config().wind(WindConfig::new(WindModel::Combined))),
        ("motors", config().actuators(motors)),
        ("randomization", config().physics(Physics::MjcDrag).randomization(Randomization::default())),
        ("obstacles", config().obstacle_generator(forest).randomization(Randomization::default())),
        ("explicit", config().physics(Physics::Dyn)),
    ]
}

#[test]
fn every_task_continues_bit_identically_from_a_snapshot() {
    for name in NAMES {
        for (condition, config) in conditions() {
            let explicit = condition == "explicit";
            let engines = if explicit { &[EngineKind::Explicit][..] } else { &EngineKind::WITH_CONTACTS[..] };
            for &engine in engines {
                let config = config.clone().engine(engine).episode_seconds(1.5);
                assert_repeats(&format!("{name}, {condition}, {engine}"), &|| make(name, config.clone()).unwrap());
            }
        }
    }
}

#[test]
fn controllers_and_wrappers_continue_bit_identically_from_a_snapshot() {
    for action_type in [ActionType::Vel, ActionType::Pid, ActionType::Attitude] {
        for controller in [ControllerKind::Pid, ControllerKind::Dsl, ControllerKind::Geometric] {
            let config = EnvConfig::default().action_type(action_type).controller(controller).episode_seconds(1.5);
            let config = config.randomization(Randomization::default());
            assert_repeats(&format!("{action_type} {controller}"), &|| make("multi_hover", config.clone()).unwrap());
        }
    }
    assert_repeats("safety in a curriculum", &|| {
        let env = Antipodal::builder().num_drones(3).action_type(ActionType::Vel).episode_seconds(1.0).build().unwrap();
        let env = SafetyWrapper::new(env, CollisionCone::new(0.4)).unwrap();
        let config = CurriculumConfig { window: 2, ..CurriculumConfig::default() };
        Box::new(CurriculumWrapper::new(env, config, |_: &mut SafetyWrapper<_>, _| Ok(())).unwrap())
    });
}

/// Two snapshots of one flight can be restored in any order and any number of times.
#[test]
fn branches_of_a_flight_are_independent() {
    let mut env = make("race", EnvConfig::default().num_drones(2).engine(EngineKind::Hybrid)).unwrap();
    env.reset(Some(4)).unwrap();
    flight(&mut *env, 1, 5);
    let first = env.snapshot();
    let trunk = flight(&mut *env, 2, 20);
    let second = env.snapshot();
    let branch = flight(&mut *env, 3, 20);
    for _ in 0..3 {
        env.restore(&second).unwrap();
        assert!(flight(&mut *env, 3, 20) == branch);
        env.restore(&first).unwrap();
        assert!(flight(&mut *env, 2, 20) == trunk);
    }
}

#[test]
fn a_simulation_continues_from_its_data_and_refuses_the_data_of_another_scene() {
    let build = |drones| {
        let builder = Simulation::builder(DroneModel::Cf2x).num_drones(drones).physics(Physics::MjcGndDragDw);
        builder.wind(WindConfig::new(WindModel::Dryden)).build().unwrap()
    };
    let mut simulation = build(3);
    // the drones touch the floor, so that the warm start of MuJoCo's solver matters
    let fly = |simulation: &mut Simulation, from: u32| {
        for step in from..from + 50 {
            let rpm = 13_500.0 + 1_500.0 * f64::from(step).sin();
            simulation.step(&[[rpm; 4], [rpm + 900.0; 4], [rpm, rpm + 20.0, rpm, rpm - 20.0]]).unwrap();
        }
        simulation.states().to_vec()
    };
    fly(&mut simulation, 0);
    let data = simulation.snapshot();
    let expected = fly(&mut simulation, 50);
    for data in [&data, &data, &written_and_read(&data)] {
        simulation.restore(data).unwrap();
        assert_eq!(fly(&mut simulation, 50), expected);
    }
    // data that was read from JSON is loaded even if the engine holds the same state
    let read = written_and_read(&simulation.snapshot());
    let on = fly(&mut simulation, 3);
    simulation.restore(&read).unwrap();
    assert_eq!(fly(&mut simulation, 3), on);
    let among = |shape| {
        let obstacle = Obstacle::new(shape, Vector3::new(3.0, 0.0, 1.0));
        Simulation::builder(DroneModel::Cf2x).obstacles([obstacle]).build().unwrap()
    };
    // moved obstacles belong to the data, their shapes to the model
    let mut ball = among(Shape::Sphere { radius: 0.2 });
    ball.set_obstacles(&[Obstacle::new(Shape::Sphere { radius: 0.2 }, Vector3::new(2.0, 0.0, 1.0))]).unwrap();
    let ball = ball.snapshot();
    let error = among(Shape::Box { half_size: [0.2; 3] }).restore(&ball).unwrap_err().to_string();
    assert!(error.contains("another shape"), "{error}");
    let mut two = build(2);
    let states = two.states().to_vec();
    assert!(
        two.restore(&data).unwrap_err().to_string().contains("the snapshot has 3 entries"),
        "a simulation with two drones"
    );
    assert_eq!(two.states(), states);
}

#[test]
fn a_snapshot_of_another_kind_of_environment_is_refused() {
    let snapshot = |name: &str| {
        let mut env = make(name, EnvConfig::default()).unwrap();
        env.reset(Some(1)).unwrap();
        env.snapshot()
    };
    let mut hover = make("hover", EnvConfig::default()).unwrap();
    hover.reset(Some(1)).unwrap();
    let before = flight(&mut *make_reset("hover"), 3, 10);
    let error = hover.restore(&snapshot("race")).unwrap_err().to_string();
    assert!(error.contains("another kind of environment"), "{error}");
    assert!(flight(&mut *hover, 3, 10) == before, "a failed restore changes nothing");
    // the same task with another action type or observation type
    for config in [
        EnvConfig::default().action_type(ActionType::Vel),
        EnvConfig::default().observation_type(ObservationType::KIN_RANGES),
    ] {
        let mut other = make("hover", config).unwrap();
        other.reset(Some(1)).unwrap();
        assert!(hover.restore(&other.snapshot()).unwrap_err().to_string().contains("another kind of environment"));
    }
    let mut multi = make("multi_hover", EnvConfig::default().num_drones(3)).unwrap();
    multi.reset(Some(1)).unwrap();
    assert!(multi.restore(&snapshot("multi_hover")).is_err(), "a snapshot with two drones for three drones");
    // the same action type with another inner controller or other limits
    let velocities = EnvConfig::default().action_type(ActionType::Vel);
    let mut pid = make("hover", velocities.clone()).unwrap();
    pid.reset(Some(1)).unwrap();
    let limits = ActionLimits { tilt: 0.4, ..ActionLimits::default() };
    for config in [velocities.clone().controller(ControllerKind::Geometric), velocities.action_limits(limits)] {
        let mut other = make("hover", config).unwrap();
        other.reset(Some(1)).unwrap();
        assert!(pid.restore(&other.snapshot()).unwrap_err().to_string().contains("another kind of environment"));
    }
    // the snapshot has a level that the curriculum does not have
    let curriculum = |levels| {
        let config = CurriculumConfig { levels, window: 1, ..CurriculumConfig::default() };
        let hover = Hover::builder().initial_positions([[0.0, 0.0, 1.0]]).episode_seconds(0.1).build().unwrap();
        CurriculumWrapper::new(hover, config, |_: &mut Aviary<Hover>, _: usize| Ok(())).unwrap()
    };
    let (mut three, mut five) = (curriculum(3), curriculum(5));
    three.reset(Some(1)).unwrap();
    for _ in 0..5 {
        five.reset(Some(1)).unwrap();
        step_to_end(&mut five, &[0.0; 4]);
    }
    assert_eq!(five.state().level, 4);
    let error = Env::restore(&mut three, &five.snapshot()).unwrap_err().to_string();
    assert!(error.contains("level 4 of 5") && three.state().level == 0, "{error}");
}

#[test]
fn data_of_another_model_and_missing_drones_are_errors_of_every_function() {
    let build = |drones| Simulation::builder(DroneModel::Cf2x).num_drones(drones).build().unwrap();
    let (mut two, three) = (build(2), build(3));
    let (mut data, model) = (two.snapshot(), three.model());
    let motors = ActuatorParams::default();
    let errors = [
        data.reset(model),
        data.set_obstacles(model, &[]),
        data.set_actuators(model, 0, &motors),
        step_data(model, &mut model.workspace().unwrap(), &mut data, &[[0.0; 4]; 3]),
    ];
    for error in errors {
        assert_eq!(error.unwrap_err(), SimulationError::Model);
    }
    data.reset(two.model()).unwrap();
    let params = DroneModel::Cf2x.params();
    for error in [
        data.set_params(2, params.clone()),
        data.set_actuators(two.model(), 2, &motors),
        two.set_airframe(usize::MAX, params),
        two.set_actuators(2, &motors),
    ] {
        assert!(error.unwrap_err().to_string().ends_with("does not exist, expected an index from 0 to 1"));
    }
}

/// A planner samples flights from one snapshot on several threads.
#[test]
fn threads_share_a_snapshot_and_a_clone_outlives_it() {
    let mut env = make_reset("race");
    flight(&mut *env, 3, 20);
    let snapshot = env.snapshot();
    let futures: Vec<_> = std::thread::scope(|scope| {
        let fly = || {
            let mut env = make_reset("race");
            env.restore(&snapshot).unwrap();
            flight(&mut *env, 4, 20)
        };
        let threads: Vec<_> = (0..3).map(|_| scope.spawn(fly)).collect();
        threads.into_iter().map(|thread| thread.join().unwrap()).collect()
    });
    let clone = snapshot.clone();
    drop(snapshot);
    env.restore(&clone).unwrap();
    let own = flight(&mut *env, 4, 20);
    assert!(futures.iter().all(|future| *future == own));
}

/// Models with equal sizes and different parameters have different fingerprints.
#[test]
fn a_snapshot_of_another_model_is_refused() {
    let params = DroneModel::Cf2x.params();
    let heavier = DroneParams { mass: 0.03, ..params.clone() };
    let builder = || Simulation::builder(DroneModel::Cf2x).physics(Physics::MjcDrag);
    let lag = ActuatorParams { lag: 0.01, ..ActuatorParams::default() };
    let mut simulation = builder().build().unwrap();
    let before = simulation.states().to_vec();
    for (what, other) in [
        ("mass", Simulation::builder(heavier).physics(Physics::MjcDrag)),
        ("physics rate", builder().sim_freq(480)),
        ("control rate", builder().ctrl_freq(120)),
        ("effects", builder().physics(Physics::Mjc)),
        ("engine", builder().engine(EngineKind::Hybrid)),
        ("start", builder().initial_positions([[0.0, 0.0, 0.2]])),
        ("motors", builder().actuators(lag)),
        ("forcing", builder().forcing(Forcing::BodyFixed)),
    ] {
        let mut snapshot = other.build().unwrap().snapshot();
        for _ in 0..2 {
            let error = simulation.restore(&snapshot).unwrap_err();
            assert_eq!(error, SimulationError::Model, "{what}");
            snapshot = written_and_read(&snapshot);
        }
        let mut workspace = simulation.model().workspace().unwrap();
        let stepped = step_data(simulation.model(), &mut workspace, &mut snapshot, &[[0.0; 4]]);
        assert_eq!(stepped, Err(SimulationError::Model), "{what}");
    }
    assert_eq!(simulation.states(), before);
    // equal configurations have equal fingerprints; wind and changed airframes belong to the data
    let mut other = builder().wind(WindConfig::new(WindModel::Dryden)).build().unwrap();
    other.set_airframe(0, DroneParams { mass: 0.03, ..params }).unwrap();
    simulation.restore(&written_and_read(&other.snapshot())).unwrap();
    for _ in 0..50 {
        simulation.step(&[[15_000.0; 4]]).unwrap();
        other.step(&[[15_000.0; 4]]).unwrap();
    }
    assert_eq!(simulation.states(), other.states());
}

/// A failed simulation stays failed, with the same error, after its data was written and read.
#[test]
fn a_failed_simulation_keeps_its_error_through_json() {
    let mut params = DroneModel::Cf2x.params();
    params.thrust_coefficient = 1e3;
    params.thrust_to_weight = 1e3;
    let mut simulation = Simulation::builder(DroneModel::Cf2x).physics(Physics::MjcDrag).build().unwrap();
    simulation.set_airframe(0, params).unwrap();
    let error = (0..100).find_map(|_| simulation.step(&[[2e4; 4]]).err()).unwrap().to_string();
    let data = written_and_read(&simulation.snapshot());
    let mut other = Simulation::builder(DroneModel::Cf2x).physics(Physics::MjcDrag).build().unwrap();
    other.restore(&data).unwrap();
    assert_eq!(other.step(&[[0.0; 4]]).unwrap_err().to_string(), error);
    other.reset().unwrap();
    other.step(&[[0.0; 4]]).unwrap();
}

/// Calls `try_out` with copies of a JSON value; each copy has one change at one place.
fn every_change(value: &Value, changes: &[fn(&Value) -> Option<Value>], try_out: &mut dyn FnMut(Value)) {
    fn places(value: &Value, path: String, out: &mut Vec<String>) {
        match value {
            Value::Array(list) => {
                list.iter().enumerate().for_each(|(i, x)| places(x, format!("{path}/{i}"), out));
            }
            Value::Object(map) => map.iter().for_each(|(key, x)| places(x, format!("{path}/{key}"), out)),
            _ => {}
        }
        out.push(path);
    }
    let mut paths = Vec::new();
    places(value, String::new(), &mut paths);
    for path in paths {
        for change in changes {
            let mut changed = value.clone();
            let place = changed.pointer_mut(&path).unwrap();
            if let Some(new) = change(place) {
                *place = new;
                try_out(changed);
            }
        }
    }
}

/// Data with one changed value is flown or refused; no change leads to a panic.
#[test]
fn changed_data_is_refused_or_flown_without_a_panic() {
    let motors = ActuatorParams { lag: 0.03, latency: 0.02, ..ActuatorParams::default() };
    let ball = |x| Obstacle::new(Shape::Sphere { radius: 0.2 }, Vector3::new(x, 0.0, 1.0));
    let builder = Simulation::builder(DroneModel::Cf2x).num_drones(2).physics(Physics::MjcGndDragDw).actuators(motors);
    let builder = builder.obstacles([ball(3.0)]).wind(WindConfig::new(WindModel::Combined));
    let mut simulation = builder.build().unwrap();
    simulation.remember(0.01);
    simulation.set_obstacles(&[ball(2.0)]).unwrap();
    simulation.set_external_force(1, Vector3::new(0.01, 0.0, -0.02)).unwrap();
    step_simulation(&mut simulation, &[[9_000.0; 4]; 2], 30);
    let value = serde_json::to_value(simulation.snapshot()).unwrap();
    let changes: [fn(&Value) -> Option<Value>; 8] = [
        |_| Some(Value::Null),
        |old| old.is_number().then(|| Value::from(-1)),
        |old| old.is_number().then(|| Value::from(u64::MAX)),
        |old| old.is_number().then(|| Value::from(1e300)),
        |old| old.is_array().then(|| Value::Array(Vec::new())),
        |old| old.as_array().and_then(|list| Some([list.as_slice(), &[list.first()?.clone()]].concat().into())),
        |old| old.as_array().and_then(|list| Some(list.split_first()?.1.to_vec().into())),
        |old| old.is_string().then(|| Value::from("x")),
    ];
    let (mut refused, mut flown) = (0, 0);
    let model = simulation.model().clone();
    let mut workspace = model.workspace().unwrap();
    every_change(&value, &changes, &mut |changed| {
        let read = serde_json::from_value::<SimData>(changed).map_err(|error| error.to_string());
        if let Ok(data) = &read {
            // also without a simulation
            let _ = step_data(&model, &mut workspace, &mut data.clone(), &[[14_000.0; 4]; 2]);
        }
        match read.and_then(|data| simulation.restore(&data).map_err(|error| error.to_string())) {
            Ok(()) => {
                flown += 1;
                // the flight may diverge
                let _ = (0..3).try_for_each(|_| simulation.step(&[[14_000.0; 4]; 2]));
            }
            Err(error) => {
                refused += 1;
                assert!(error.len() > 10, "{error}");
            }
        }
    });
    assert!(refused > 400 && flown > 100, "{refused} {flown}");
}

/// The checksum of a snapshot covers the state of the task, which the task does not check itself.
#[test]
fn a_changed_snapshot_of_an_environment_is_refused() {
    let config = EnvConfig::default().randomization(Randomization::default());
    let mut env = make("race", config).unwrap();
    env.reset(Some(1)).unwrap();
    flight(&mut *env, 1, 5);
    let value = serde_json::to_value(env.snapshot()).unwrap();
    let changes: [fn(&Value) -> Option<Value>; 1] = [|old| (!old.is_null()).then_some(Value::Null)];
    every_change(&value, &changes, &mut |changed| {
        assert!(serde_json::from_value::<EnvSnapshot>(changed).is_err());
    });
    let snapshot: EnvSnapshot = serde_json::from_value(value).unwrap();
    env.restore(&snapshot).unwrap();
    // another task, number of drones or airframe
    let race = |config: EnvConfig| make("race", config).unwrap();
    let heavy = DroneParams { mass: 0.26, ..DroneModel::Race.params() };
    for (mut other, expected) in [
        (make("hover", EnvConfig::default()).unwrap(), "another kind of environment"),
        (race(EnvConfig::default().num_drones(2)), "another kind of environment"),
        (race(EnvConfig::default().drone(heavy)), "another scene, airframe"),
    ] {
        other.reset(Some(1)).unwrap();
        let error = other.restore(&snapshot).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
    }
}

/// Hover without `Task::save`.
#[derive(Debug, Clone)]
struct Unsaved(Hover);

impl Task for Unsaved {
    fn name(&self) -> &'static str {
        "unsaved"
    }

    fn defaults(&self) -> TaskDefaults {
        self.0.defaults()
    }

    fn initial_positions(&self, drones: &[DroneParams]) -> Vec<[f64; 3]> {
        self.0.initial_positions(drones)
    }

    fn observation_space(&self) -> BoxSpace {
        self.0.observation_space()
    }

    fn reset(&mut self, simulation: SimView<'_>, rng: &mut Rng) {
        self.0.reset(simulation, rng);
    }

    fn update(&mut self, simulation: SimView<'_>) {
        self.0.update(simulation);
    }

    fn end(&self, simulation: SimView<'_>, drone: usize) -> Option<EndReason> {
        self.0.end(simulation, drone)
    }

    fn reward(&self, simulation: SimView<'_>, drone: usize, end: Option<EndReason>) -> f64 {
        self.0.reward(simulation, drone, end)
    }

    fn observe(&self, simulation: SimView<'_>, drone: usize, out: &mut [f64]) {
        self.0.observe(simulation, drone, out);
    }

    fn success(&self, simulation: SimView<'_>, drone: usize) -> bool {
        self.0.success(simulation, drone)
    }

    fn reference(&self, simulation: SimView<'_>, drone: usize) -> Reference {
        self.0.reference(simulation, drone)
    }
}

#[test]
fn a_task_without_save_is_named_in_the_error() {
    let mut env = AviaryBuilder::new(Unsaved(Hover::default())).build().unwrap();
    env.reset(Some(1)).unwrap();
    let snapshot = env.snapshot();
    env.restore(&snapshot).unwrap();
    let error = serde_json::to_string(&snapshot).unwrap_err().to_string();
    assert!(error.contains("`unsaved` cannot be saved") && error.contains("Task::save"), "{error}");
}

/// Creates an environment by name and resets it.
fn make_reset(name: &str) -> Box<dyn DroneEnv + Send> {
    let mut env = make(name, EnvConfig::default()).unwrap();
    env.reset(Some(1)).unwrap();
    env
}
