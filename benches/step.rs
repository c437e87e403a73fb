//! Time of a step over the time of its `mj_step` calls alone, in one run on one machine.
//!
//! `cargo bench --bench step` prints the median ratios of alternating batches, then criterion's timings.

use std::hint::black_box;
use std::time::Instant;

use criterion::{Criterion, criterion_group};
use mujoco_drones_gym::engine::flight::{FreeBody, ReachBound};
use mujoco_drones_gym::engine::{Bodies, Body, Engine, HybridEngine, Load, MujocoEngine};
use mujoco_drones_gym::env::Randomization;
use mujoco_drones_gym::mujoco::{Data, Model};
use mujoco_drones_gym::physics::Wrench;
use mujoco_drones_gym::physics::rotor::RotorModel;
use mujoco_drones_gym::physics::wind::{WindConfig, WindModel};
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::world::{DroneBody, ObstacleConfig, World};
use nalgebra::Vector3;

/// Returns the position of a drone in a swarm with distances of 0.5 m and slightly different heights. The wakes of
/// neighbours are too weak for contacts within a batch; a contact would take more time than everything else.
fn place(index: usize) -> [f64; 3] {
    let (column, row) = (index % 12, index / 12);
    [0.5 * column as f64, 0.5 * row as f64, 5.0 + 0.03 * (index % 7) as f64]
}

/// MuJoCo alone on the scene of the simulation: airborne drones with one wrench per step.
struct Bare {
    data: Data,
    hover: f64,
}

impl Bare {
    fn new(count: usize) -> Self {
        let params = DroneModel::Cf2x.params();
        let hover = params.weight();
        let drones = (0..count)
            .map(|i| DroneBody { params: params.clone(), position: place(i).into(), rpy: Vector3::zeros() })
            .collect();
        let model = Model::from_xml(&World::new(drones).to_mjcf().expect("a scene")).expect("a model");
        Self { data: Data::new(model).expect("a simulation"), hover }
    }

    fn steps(&mut self, count: usize) {
        for _ in 0..count {
            for row in self.data.xfrc_applied_mut().chunks_exact_mut(6).skip(1) {
                row.copy_from_slice(&[0.0, 0.0, self.hover, 0.0, 0.0, 0.0]);
            }
            self.data.step().expect("a step");
        }
    }
}

/// Creates a simulation of a swarm, and its motor speeds at hover.
fn simulation(count: usize, physics: Physics) -> (Simulation, Vec<[f64; 4]>) {
    let simulation = Simulation::builder(DroneModel::Cf2x)
        .physics(physics)
        .num_drones(count)
        .initial_positions((0..count).map(place))
        .build()
        .expect("a simulation");
    (simulation, vec![[DroneModel::Cf2x.params().hover_rpm(); 4]; count])
}

/// Returns the median over alternating batches of the time of `a` divided by the time of `b`.
fn ratio(batch: usize, mut restart: impl FnMut(), mut a: impl FnMut(), mut b: impl FnMut()) -> f64 {
    let time = |f: &mut dyn FnMut()| {
        let start = Instant::now();
        for _ in 0..batch {
            f();
        }
        start.elapsed().as_secs_f64()
    };
    let mut ratios: Vec<_> = (0..101)
        .map(|_| {
            restart();
            time(&mut a) / time(&mut b)
        })
        .collect();
    ratios.sort_by(f64::total_cmp);
    ratios[ratios.len() / 2]
}

#[allow(clippy::print_stdout)]
fn ratios() {
    println!("time of Simulation::step over five mj_step");
    println!("{:>7}{:>9}{:>17}{:>20}", "drones", "mjc", "mjc_gnd_drag_dw", "µs per mj_step");
    for count in [1, 2, 4, 8, 12, 16, 32, 64, 128] {
        let mut bare = Bare::new(count);
        let batch = (400 / count).max(3);
        let ratios = [Physics::Mjc, Physics::MjcGndDragDw].map(|physics| {
            let (mut simulation, commands) = simulation(count, physics);
            let simulation = std::cell::RefCell::new(&mut simulation);
            let bare = std::cell::RefCell::new(&mut bare);
            ratio(
                batch,
                || {
                    simulation.borrow_mut().reset().expect("a reset");
                    bare.borrow_mut().data.reset().expect("a reset");
                },
                || simulation.borrow_mut().step(black_box(&commands)).expect("a step"),
                || bare.borrow_mut().steps(5),
            )
        });
        let start = Instant::now();
        bare.steps(batch);
        let alone = start.elapsed().as_secs_f64() / batch as f64 * 1e6;
        println!("{count:>7}{:>9.3}{:>17.3}{alone:>20.1}", ratios[0], ratios[1]);
    }
    println!("time of Aviary::step over five mj_step");
    for (name, count) in [("hover", 1), ("multi_hover", 12), ("formation", 3), ("race", 1), ("antipodal", 12)] {
        let mut bare = Bare::new(count);
        let config = EnvConfig::default().num_drones(count).initial_positions((0..count).map(place));
        let config = config.episode_seconds(1e6);
        // the drones fly high above the floor, without a maximum height
        let env: Result<Box<dyn DroneEnv + Send>, EnvError> = match name {
            "hover" => {
                config.with_task(Hover::default()).task(|t| t.max_height = 1e9).build().map(|e| Box::new(e) as _)
            }
            "multi_hover" => {
                config.with_task(MultiHover::default()).task(|t| t.max_height = 1e9).build().map(|e| Box::new(e) as _)
            }
            _ => make(name, config),
        };
        let mut env = env.expect("a task");
        env.reset(None).expect("a reset");
        let action = vec![0.0; 4 * count];
        let env = std::cell::RefCell::new(&mut env);
        let bare = std::cell::RefCell::new(&mut bare);
        let step = ratio(
            (400 / count).max(3),
            || {
                env.borrow_mut().reset(None).expect("a reset");
                bare.borrow_mut().data.reset().expect("a reset");
            },
            || {
                black_box(env.borrow_mut().step(&action).expect("a step").reward);
            },
            || bare.borrow_mut().steps(5),
        );
        println!("{name:>12} with {count:>2}: {step:.3}");
    }
}

/// Prints the time of Hover steps under conditions over the time of plain ones, and the times of resets.
#[allow(clippy::print_stdout)]
fn conditions() {
    let config = || EnvConfig::default().initial_positions([place(0)]).episode_seconds(1e6);
    let hover = |config: EnvConfig| {
        let mut env = config
            .with_task(Hover::default())
            .task(|t| (t.max_height, t.crash.max_tilt) = (1e9, 9.0))
            .build()
            .expect("a task");
        env.reset(Some(1)).expect("a reset");
        env
    };
    let sensors_and_more = Randomization { initial: None, environment: None, ..Randomization::default() };
    let wind = WindConfig::new(WindModel::Combined);
    let forest = |count: usize, new_layout: bool| {
        let arena = [16.0, 16.0, 10.0];
        ObstacleConfig { count, arena, safe_zone: 0.5, new_layout, ..ObstacleConfig::default() }
    };
    let low = || config().initial_positions([[0.0, 0.0, 1.0]]);
    println!("time of a Hover step under conditions over a plain one");
    for (name, config) in [
        ("combined wind", config().wind(wind)),
        ("randomization", config().randomization(sensors_and_more.clone())),
        ("sensors", config().randomization(Randomization { sensors: sensors_and_more.sensors, ..Randomization::NONE })),
        ("body", config().randomization(Randomization { body: sensors_and_more.body, ..Randomization::NONE })),
        (
            "motors",
            config().randomization(Randomization { actuators: sensors_and_more.actuators, ..Randomization::NONE }),
        ),
        ("20 trees", low().obstacle_generator(forest(20, false))),
        ("200 trees", low().obstacle_generator(forest(200, false))),
    ] {
        let (mut under, mut plain) = (hover(config), hover(if name.contains("tree") { low() } else { self::plain() }));
        let (under, plain) = (std::cell::RefCell::new(&mut under), std::cell::RefCell::new(&mut plain));
        let step = |env: &std::cell::RefCell<&mut Aviary<Hover>>| {
            // the drone turns slowly: MuJoCo is faster for a body without rotation
            black_box(env.borrow_mut().step(&[0.01, 0.0, -0.01, 0.0]).expect("a step").reward);
        };
        let restart = || {
            under.borrow_mut().reset(Some(1)).expect("a reset");
            plain.borrow_mut().reset(Some(1)).expect("a reset");
        };
        println!("{name:>14}: {:.3}", ratio(40, restart, || step(&under), || step(&plain)));
    }
    for count in [20, 200] {
        let mut env = hover(low().obstacle_generator(forest(count, true)));
        let start = Instant::now();
        for seed in 0..200 {
            env.reset(Some(seed)).expect("a reset");
        }
        println!("reset with a new layout of {count} trees: {:.0} µs", start.elapsed().as_secs_f64() / 200.0 * 1e6);
    }
    let mut env = hover(config().randomization(Randomization::default()));
    let start = Instant::now();
    for seed in 0..1000 {
        env.reset(Some(seed)).expect("a reset");
    }
    println!("reset with newly sampled parameters: {:.1} µs", start.elapsed().as_secs_f64() / 1000.0 * 1e6);
}

/// A drone on the floor in one engine, which starts again every 24 physics steps.
struct OnFloor {
    engine: Engine,
    bodies: Bodies,
    load: Load,
    start: DroneState,
    state: [DroneState; 1],
}

impl OnFloor {
    fn new(kind: EngineKind, start: DroneState, speeds: [f64; 4]) -> Self {
        let params = DroneModel::Cf2x.params();
        let world =
            World::new(vec![DroneBody { params: params.clone(), position: Vector3::z(), rpy: Vector3::zeros() }]);
        let engine = match kind {
            EngineKind::Hybrid => Engine::Hybrid(HybridEngine::new(&world).expect("a scene")),
            _ => Engine::Mujoco(MujocoEngine::new(&world).expect("a scene")),
        };
        let (mass, inertia) = (params.mass, params.inertia_vector());
        let free = FreeBody::new(mass, &inertia, world.gravity, None);
        let reach = params.collision_radius.hypot(0.5 * params.collision_height);
        let reach_bound = ReachBound::new(&free, reach, 30.0, 0.01, [0.0; 2]);
        let bodies = vec![Body { mass, inertia, free, reach_bound }];
        let load = Load { rotors: RotorModel::new(&params).wrench(&speeds), external: Wrench::ZERO };
        Self {
            engine,
            bodies: Bodies { drones: bodies, gravity: world.gravity, obstacle_drift: 0.0 },
            load,
            start,
            state: [start],
        }
    }

    fn steps(&mut self) {
        self.state = [self.start];
        self.engine.reset(&self.state).expect("a reset");
        for _ in 0..24 {
            let (load, bodies) = ([self.load], &self.bodies);
            self.engine.begin(bodies, &self.state, 1).expect("a step");
            match &mut self.engine {
                Engine::Hybrid(engine) => engine.advance(bodies, &load, &mut self.state).expect("a step"),
                Engine::Mujoco(engine) => engine.advance(&load, &mut self.state).expect("a step"),
                Engine::Explicit(_) => {}
            }
        }
    }
}

/// Prints the time of a physics step in contact with the floor in the kernel and in MuJoCo.
#[allow(clippy::print_stdout)]
fn contacts() {
    println!("physics step in contact with the floor, Crazyflie: kernel, mj_step, ratio");
    let tilted = |roll: f64, z: f64| DroneState::at_rest(Vector3::new(0.0, 0.0, z), Vector3::new(roll, 0.1, 0.3));
    let moving = DroneState {
        velocity: Vector3::new(0.7, -0.4, -0.3),
        angular_velocity: Vector3::new(3.0, -2.0, 4.0),
        ..tilted(0.3, 0.03)
    };
    for (name, start, speeds) in [
        ("resting", DroneState::at_rest(Vector3::new(0.0, 0.0, 0.0149), Vector3::zeros()), [0.0; 4]),
        ("slow rotors", tilted(-0.05, 0.018), [3000.0, 4000.0, 5000.0, 2000.0]),
        ("sliding", DroneState { velocity: Vector3::new(1.0, 0.5, 0.0), ..tilted(0.0, 0.0149) }, [0.0; 4]),
        ("tumbling", moving, [9000.0, 8000.0, 6000.0, 8000.0]),
    ] {
        let [mut kernel, mut mujoco] =
            [EngineKind::Hybrid, EngineKind::Mujoco].map(|kind| OnFloor::new(kind, start, speeds));
        let mut times: Vec<[f64; 2]> = Vec::new();
        for _ in 0..101 {
            let start = Instant::now();
            (0..20).for_each(|_| kernel.steps());
            let middle = start.elapsed().as_secs_f64();
            (0..20).for_each(|_| mujoco.steps());
            times.push([middle, start.elapsed().as_secs_f64() - middle]);
        }
        let best = |i: usize| times.iter().map(|t| t[i]).fold(f64::INFINITY, f64::min) / 480.0;
        let (kernel_time, mujoco_time) = (best(0), best(1));
        let substeps = kernel.engine.substeps();
        println!(
            "{name:>14}: {:6.0} ns {:6.2} µs {:6.1} ({} of {} steps in MuJoCo)",
            kernel_time * 1e9,
            mujoco_time * 1e6,
            mujoco_time / kernel_time,
            substeps.mujoco,
            substeps.mujoco + substeps.flight,
        );
    }
}

/// Returns the plain configuration of a drone high above the floor.
fn plain() -> EnvConfig {
    EnvConfig::default().initial_positions([place(0)]).episode_seconds(1e6)
}

fn timings(c: &mut Criterion) {
    let mut bare = Bare::new(1);
    c.bench_function("five bare mj_step, 1 drone", |b| b.iter(|| bare.steps(5)));
    let (mut one, commands) = simulation(1, Physics::Mjc);
    c.bench_function("Simulation::step, 1 drone", |b| b.iter(|| one.step(black_box(&commands)).expect("a step")));
    c.bench_function("Simulation::reset, 1 drone", |b| b.iter(|| one.reset().expect("a reset")));
    let mut env = Hover::builder().build().expect("a task");
    c.bench_function("Hover::reset", |b| b.iter(|| env.reset(Some(1)).expect("a reset").vector[0]));
    bare.data.reset().expect("a reset");
    c.bench_function("mj_resetData, 1 drone", |b| b.iter(|| bare.data.reset().expect("a reset")));
}

criterion_group!(benches, timings);

fn main() {
    contacts();
    if std::env::args().any(|argument| argument == "contacts") {
        return;
    }
    ratios();
    conditions();
    benches();
    Criterion::default().configure_from_args().final_summary();
}
