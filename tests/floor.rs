//! The kernel of contacts with the floor matches `mj_step`.
//!
//! `FLOOR_CASES=2000 cargo test --release --test floor -- --nocapture` tests more random cases and prints the largest
//! differences.
#![allow(clippy::print_stdout)]

use mujoco_drones_gym::engine::flight::{FreeBody, ReachBound};
use mujoco_drones_gym::engine::{Bodies, Body, Contact, Engine, HybridEngine, Load, MujocoEngine, Touched};
use mujoco_drones_gym::env::Randomization;
use mujoco_drones_gym::mujoco::Error;
use mujoco_drones_gym::physics::Wrench;
use mujoco_drones_gym::physics::rotor::RotorModel;
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::state::attitude_from_rpy;
use mujoco_drones_gym::world::{DroneBody, Forcing, Medium, Obstacle, Shape, World};
use mujoco_drones_gym::{Rng, RngExt, SeedableRng};
use nalgebra::Vector3;

/// Both engines with the same bodies.
struct Pair {
    mujoco: Engine,
    hybrid: Engine,
    bodies: Bodies,
    rotors: RotorModel,
}

impl Pair {
    fn new(params: &DroneParams, scale: (f64, [f64; 3]), settings: impl Fn(&mut World)) -> Self {
        let drone = DroneBody { params: params.clone(), position: Vector3::z(), rpy: Vector3::zeros() };
        let mut world = World::new(vec![drone]);
        settings(&mut world);
        let mass = params.mass * scale.0;
        let inertia = params.inertia_vector().component_mul(&Vector3::from(scale.1));
        let free = FreeBody::new(mass, &inertia, world.gravity, world.medium);
        let reach = params.collision_radius.hypot(0.5 * params.collision_height);
        let reach_bound = ReachBound::new(&free, reach, 100.0, 1.0, [0.0; 2]);
        let body = Body { mass, inertia, free, reach_bound };
        Self {
            mujoco: Engine::Mujoco(MujocoEngine::new(&world).unwrap()),
            hybrid: Engine::Hybrid(HybridEngine::new(&world).unwrap()),
            bodies: Bodies { drones: vec![body], gravity: world.gravity, obstacle_drift: 0.0 },
            rotors: RotorModel::new(params),
        }
    }

    fn reset(&mut self, state: &DroneState) {
        self.mujoco.reset(&[*state]).unwrap();
        self.hybrid.reset(&[*state]).unwrap();
    }

    /// Steps both engines from the same state.
    fn step(&mut self, load: &Load, state: &DroneState) -> [DroneState; 2] {
        [&mut self.mujoco, &mut self.hybrid].map(|engine| advance(engine, &self.bodies, load, state).unwrap())
    }
}

fn advance(engine: &mut Engine, bodies: &Bodies, load: &Load, state: &DroneState) -> Result<DroneState, Error> {
    let mut states = [*state];
    engine.begin(bodies, &states, 1)?;
    match engine {
        Engine::Mujoco(engine) => engine.advance(&[*load], &mut states)?,
        Engine::Hybrid(engine) => engine.advance(bodies, &[*load], &mut states)?,
        Engine::Explicit(_) => unreachable!(),
    }
    Ok(states[0])
}

/// Returns the contacts of the last physics step, one for every point.
fn contacts(engine: &Engine) -> Vec<Contact> {
    let mut contacts = Vec::new();
    engine.contacts(|contact| contacts.push(contact));
    contacts
}

/// Returns the largest difference of a number of the states.
fn apart(a: &DroneState, b: &DroneState) -> f64 {
    (a.position - b.position)
        .amax()
        .max((a.attitude.coords - b.attitude.coords).amax())
        .max((a.velocity - b.velocity).amax())
        .max((a.angular_velocity - b.angular_velocity).amax())
}

/// Returns a random start in one of the [`REGIMES`], within a hundredth of a radius from the floor.
fn start(regime: usize, params: &DroneParams, rng: &mut Rng) -> DroneState {
    let mut u = |a: f64, b: f64| a + (b - a) * rng.random::<f64>();
    let (half, radius) = (0.5 * params.collision_height, params.collision_radius);
    let yaw = u(-3.1, 3.1);
    let small = 10f64.powf(u(-14.0, -2.0));
    let mut state = DroneState::at_rest(Vector3::zeros(), Vector3::new(0.0, 0.0, yaw));
    let tilt = |roll: f64, pitch: f64| attitude_from_rpy(Vector3::new(roll, pitch, yaw));
    match regime {
        0 => {}
        1 => state.attitude = tilt(small, small * u(-1.0, 1.0)),
        2 => state.attitude = tilt(u(-1.5, 1.5), u(-1.5, 1.5)),
        3 => state.velocity = Vector3::new(u(-3.0, 3.0), u(-3.0, 3.0), 0.0),
        4 => {
            state.velocity = Vector3::new(u(-3.0, 3.0), u(-3.0, 3.0), u(-3.0, 0.0));
            state.angular_velocity = Vector3::new(u(-30.0, 30.0), u(-30.0, 30.0), u(-30.0, 30.0));
            state.attitude = tilt(u(-3.0, 3.0), u(-1.5, 1.5));
        }
        5 => state.angular_velocity = Vector3::new(0.0, 0.0, u(-60.0, 60.0)),
        6 => {
            state.velocity = Vector3::new(u(-10.0, 10.0), u(-10.0, 10.0), u(-20.0, -5.0));
            state.attitude = tilt(u(-3.0, 3.0), u(-1.5, 1.5));
        }
        7 => state.attitude = tilt(std::f64::consts::PI + small, 0.0),
        8 => state.attitude = tilt(std::f64::consts::FRAC_PI_2 + small * u(-1.0, 1.0), 0.0),
        9 => state.attitude = tilt((radius / half).atan() + u(-0.05, 0.05), 0.0),
        _ => state.attitude = tilt(u(-3.0, 3.0), u(-1.5, 1.5)),
    }
    let cos = state.up().z;
    let depth = half * cos.abs() + radius * (1.0 - cos * cos).max(0.0).sqrt();
    let below = match regime {
        10 => u(0.0, 1.0) * depth,
        _ => u(-1.0, 1.0) * 1e-3 * radius,
    };
    state.position = Vector3::new(u(-1.0, 1.0), u(-1.0, 1.0), depth - below);
    state
}

const REGIMES: [&str; 11] = [
    "at rest",
    "almost upright",
    "tilted",
    "sliding",
    "tumbling",
    "spinning",
    "dropping fast",
    "upside down",
    "on its side",
    "on its rim",
    "deep in the floor",
];

/// A random world with one drone: an airframe (with a random body in every second case), forcing, medium, time step.
fn random_pair(case: usize, params: &DroneParams, dt: f64, rng: &mut Rng) -> Pair {
    let scale = if case.is_multiple_of(2) {
        (1.0, [1.0; 3])
    } else {
        (rng.random_range(0.5..1.5), [(); 3].map(|()| rng.random_range(0.8..1.2)))
    };
    let forcing = [Forcing::Frozen, Forcing::BodyFixed][rng.random_range(0..2)];
    let medium = [None, Some(Medium::AIR)][rng.random_range(0..2)];
    Pair::new(params, scale, |world| (world.timestep, world.forcing, world.medium) = (dt, forcing, medium))
}

/// Random rotor speeds, which change 25 times per second, and a random force.
fn random_load(pair: &Pair, params: &DroneParams, rng: &mut Rng) -> Load {
    let speeds = [(); 4].map(|()| params.hover_rpm() * rng.random_range(0.0..1.1));
    let force_world = Vector3::from([(); 3].map(|()| 0.1 * params.weight() * rng.random_range(-1.0..1.0)));
    Load { rotors: pair.rotors.wrench(&speeds), external: Wrench { force_world, ..Wrench::ZERO } }
}

/// Number of random cases: more in a release build.
fn cases(debug: usize, release: usize) -> usize {
    std::env::var("FLOOR_CASES").map_or(if cfg!(debug_assertions) { debug } else { release }, |x| x.parse().unwrap())
}

/// Differences after one physics step from MuJoCo's states.
#[derive(Debug, Default)]
struct Substeps {
    worst: f64,
    touching: u64,
    /// Steps in contact that MuJoCo computed for the hybrid engine.
    handed_over: u64,
}

impl Substeps {
    fn compare(&mut self, pair: &mut Pair, load: &Load, state: &mut DroneState) {
        let before = pair.hybrid.substeps().mujoco;
        let [mujoco, hybrid] = pair.step(load, state);
        self.worst = self.worst.max(apart(&mujoco, &hybrid));
        let [a, b] = [contacts(&pair.mujoco), contacts(&pair.hybrid)];
        assert_eq!(a, b, "{state:?}");
        self.touching += u64::from(!a.is_empty());
        self.handed_over += if a.is_empty() { 0 } else { pair.hybrid.substeps().mujoco - before };
        *state = mujoco;
    }
}

#[test]
fn every_substep_of_a_second_on_the_floor_matches_mj_step() {
    for (regime, name) in REGIMES.iter().enumerate() {
        let mut rng = Rng::seed_from_u64(regime as u64);
        let mut result = Substeps::default();
        for case in 0..cases(12, 200) {
            let params = DroneModel::PAPER[case % 3].params();
            let dt = [1.0 / 240.0, 1.0 / 1000.0, 1.0 / 100.0][rng.random_range(0..3)];
            let mut pair = random_pair(case, &params, dt, &mut rng);
            let mut state = start(regime, &params, &mut rng);
            pair.reset(&state);
            let mut load = Load { rotors: pair.rotors.wrench(&[0.0; 4]), external: Wrench::ZERO };
            for step in 0..(1.0 / dt) as usize {
                if !case.is_multiple_of(4) && step.is_multiple_of((0.04 / dt) as usize) {
                    load = random_load(&pair, &params, &mut rng);
                }
                result.compare(&mut pair, &load, &mut state);
            }
        }
        println!("{name}: {result:?}");
        assert!(result.worst < 1e-8, "{name}: {result:?}");
        assert!(result.touching > 100 && result.handed_over * 1000 <= result.touching, "{name}: {result:?}");
    }
}

/// Airframes of any size from 1 mm to 10 m and any mass, whose inertia is within the limits of the kernel.
#[test]
fn substeps_of_user_made_airframes_match_mj_step() {
    let mut rng = Rng::seed_from_u64(7);
    let mut result = Substeps::default();
    for case in 0..cases(100, 2000) {
        let mut log = |a: f64, b: f64| (a.ln() + (b.ln() - a.ln()) * rng.random::<f64>()).exp();
        let mut params = DroneModel::PAPER[case % 3].params();
        params.collision_radius = log(1e-3, 10.0);
        params.collision_height = params.collision_radius * log(0.03, 4.0);
        params.mass = log(1e-4, 1e4);
        let moment = params.mass * params.collision_radius.powi(2) * log(1e-2, 1.0);
        params.inertia = [(); 3].map(|()| moment * log(0.6, 1.1));
        let dt = log(1e-4, 2e-2);
        let mut pair = random_pair(case, &params, dt, &mut rng);
        let mut state = start(case % REGIMES.len(), &params, &mut rng);
        pair.reset(&state);
        let load = Load { rotors: pair.rotors.wrench(&[0.0; 4]), external: Wrench::ZERO };
        let mut own = Substeps::default();
        for _ in 0..100 {
            // below this tilt the rounding of MuJoCo's contact points decides about more than 1e-8
            if state.up().xy().norm() < 1e-11 {
                break;
            }
            own.compare(&mut pair, &load, &mut state);
            // rounding limits a faster motion to eleven digits
            let speed = state.angular_velocity.norm().max(state.velocity.norm());
            assert!(own.worst < 1e-8_f64.max(1e-11 * speed), "{case}: {own:?} {speed} {params:?} {dt}");
            if speed > 1e3 {
                break;
            }
        }
        result.worst = result.worst.max(own.worst);
        result.touching += own.touching;
        result.handed_over += own.handed_over;
    }
    println!("user-made: {result:?}");
    assert!(result.touching > 1000 && result.handed_over * 50 < result.touching, "{result:?}");
}

/// Both engines fly alone from the first contact on. A motion counts if MuJoCo's own result is stable: a start that
/// differs by 1e-12 must end within 1e-6.
#[test]
fn the_first_second_of_contact_matches_mj_step() {
    let (mut stable, mut unstable, mut worst, mut worst_unstable) = (0, 0, 0.0_f64, 0.0_f64);
    for (regime, name) in REGIMES.iter().enumerate() {
        let mut rng = Rng::seed_from_u64(100 + regime as u64);
        for case in 0..cases(12, 200) {
            let params = DroneModel::PAPER[case % 3].params();
            let dt = 1.0 / 240.0;
            let mut pair = random_pair(case, &params, dt, &mut rng);
            let first = start(regime, &params, &mut rng);
            let loads: Vec<Load> = (0..25).map(|_| random_load(&pair, &params, &mut rng)).collect();
            let mut fly = |engine: usize, first: &DroneState| -> Vec<DroneState> {
                let engine = if engine == 0 { &mut pair.mujoco } else { &mut pair.hybrid };
                engine.reset(&[*first]).unwrap();
                let mut state = *first;
                let mut states = Vec::new();
                for step in 0..240 {
                    state = advance(engine, &pair.bodies, &loads[step / 10], &state).unwrap();
                    states.push(state);
                }
                states
            };
            let mut moved = first;
            moved.position += Vector3::new(0.6e-12, -0.5e-12, 0.6e-12);
            moved.velocity += Vector3::new(-0.6e-12, 0.5e-12, 0.6e-12);
            let (mujoco, hybrid, other) = (fly(0, &first), fly(1, &first), fly(0, &moved));
            let far = |a: &[DroneState], b: &[DroneState]| {
                a.iter().zip(b).map(|(a, b)| (a.position - b.position).norm()).fold(0.0, f64::max)
            };
            let (error, amplified) = (far(&mujoco, &hybrid), far(&mujoco, &other));
            if amplified < 1e-6 {
                stable += 1;
                worst = worst.max(error);
                assert!(error < 1e-6, "{name} {case}: {error:e}, MuJoCo with a moved start {amplified:e}");
            } else {
                unstable += 1;
                worst_unstable = worst_unstable.max(error);
            }
        }
    }
    println!("a second: {worst:e} in {stable} stable motions, {worst_unstable:e} in {unstable} unstable ones");
    assert!(stable > 9 * unstable, "{stable} {unstable}");
}

/// Drones that touch the floor at the same time share one solver in MuJoCo, also with drones in flight.
#[test]
fn several_drones_on_the_floor_match_mj_step() {
    let mut rng = Rng::seed_from_u64(3);
    let (mut worst, mut touching, mut handed_over) = (0.0_f64, 0, 0);
    for case in 0..cases(20, 200) {
        let count = 2 + case % 6;
        let params = DroneModel::PAPER[case % 3].params();
        let drone = DroneBody { params: params.clone(), position: Vector3::z(), rpy: Vector3::zeros() };
        let world = World::new(vec![drone; count]);
        let single = random_pair(0, &params, world.timestep, &mut rng);
        let body = Pair::new(&params, (1.0, [1.0; 3]), |_| {}).bodies.drones[0];
        let bodies = Bodies { drones: vec![body; count], gravity: world.gravity, obstacle_drift: 0.0 };
        let mut engines =
            [Engine::Mujoco(MujocoEngine::new(&world).unwrap()), Engine::Hybrid(HybridEngine::new(&world).unwrap())];
        let mut states: Vec<DroneState> = (0..count)
            .map(|drone| {
                let mut state = start(rng.random_range(0..REGIMES.len()), &params, &mut rng);
                state.position.x += 20.0 * drone as f64;
                state.position.z += if drone % 3 == 2 { 1.0 } else { 0.0 };
                state
            })
            .collect();
        engines.iter_mut().for_each(|engine| engine.reset(&states).unwrap());
        for _ in 0..10 {
            let loads: Vec<Load> = (0..count).map(|_| random_load(&single, &params, &mut rng)).collect();
            for _ in 0..10 {
                let [a, b] = engines.each_mut().map(|engine| {
                    let mut states = states.clone();
                    engine.begin(&bodies, &states, 1).unwrap();
                    match engine {
                        Engine::Mujoco(engine) => engine.advance(&loads, &mut states).unwrap(),
                        Engine::Hybrid(engine) => engine.advance(&bodies, &loads, &mut states).unwrap(),
                        Engine::Explicit(_) => unreachable!(),
                    }
                    states
                });
                for (a, b) in a.iter().zip(&b) {
                    worst = worst.max(apart(a, b));
                }
                let [mujoco, hybrid] = engines.each_ref().map(contacts);
                assert_eq!(mujoco, hybrid);
                touching += u64::from(!mujoco.is_empty());
                states = a;
            }
        }
        handed_over += engines[1].substeps().mujoco;
    }
    println!("several drones: {worst:e}, {touching} steps in contact, {handed_over} in MuJoCo");
    assert!(worst < 1e-8 && touching > 500 && handed_over < touching / 10, "{worst:e} {touching} {handed_over}");
}

/// A drone that slides past an obstacle changes from the kernel to MuJoCo and back. Each continues with the warm start
/// of the other.
#[test]
fn mujoco_computes_contacts_with_obstacles_and_continues_from_the_kernel() {
    let post = Obstacle::new(Shape::Cylinder { radius: 0.05, half_height: 0.5 }, Vector3::new(0.6, 0.105, 0.5));
    for forcing in [Forcing::Frozen, Forcing::BodyFixed] {
        let params = DroneModel::Cf2x.params();
        let mut pair = Pair::new(&params, (1.0, [1.0; 3]), |world| {
            world.forcing = forcing;
            world.obstacles.push(post);
        });
        let mut state = DroneState {
            velocity: Vector3::new(6.0, 0.0, 0.0),
            angular_velocity: Vector3::new(0.0, 0.0, 3.0),
            ..DroneState::at_rest(Vector3::new(0.0, 0.0, 0.0149), Vector3::zeros())
        };
        pair.reset(&state);
        let load = Load { rotors: pair.rotors.wrench(&[2000.0; 4]), external: Wrench::ZERO };
        let (mut result, mut changes, mut touched) = (Substeps::default(), 0, false);
        let mut in_mujoco = 0;
        for _ in 0..240 {
            let before = (pair.hybrid.substeps().mujoco, in_mujoco);
            result.compare(&mut pair, &load, &mut state);
            in_mujoco = pair.hybrid.substeps().mujoco - before.0;
            changes += u32::from(in_mujoco != before.1);
            touched |= contacts(&pair.hybrid).iter().any(|contact| contact.with == Touched::Obstacle(0));
        }
        println!("past an obstacle: {result:?}, {changes} changes");
        assert!(result.worst < 1e-8 && result.handed_over > 5 && changes >= 2 && touched, "{result:?} {changes}");
    }
}

/// A step that MuJoCo refuses is refused by the hybrid engine with the same error.
#[test]
fn divergence_on_the_floor_is_the_error_of_mujoco() {
    let errors = EngineKind::WITH_CONTACTS.map(|engine| {
        let mut simulation = Simulation::builder(DroneModel::Cf2x)
            .initial_positions([[0.0, 0.0, 0.01]])
            .initial_velocities([[0.0, 0.0, -5e8]])
            .engine(engine)
            .build()
            .unwrap();
        simulation.step(&[[0.0; 4]]).unwrap_err().to_string()
    });
    assert_eq!(errors[0], errors[1]);
}

/// Random actions crash drones all the time. The kernel computes these contacts, and MuJoCo hardly any.
#[test]
fn random_actions_of_a_batch_need_no_mujoco() {
    let count = 64;
    for randomization in [Randomization::NONE, Randomization::default()] {
        let config = VecConfig { threads: 1, ..VecConfig::new(count) };
        let mut env = VecAviary::new(Hover::builder().randomization(randomization), config).unwrap();
        let mut buffers = VecBuffers::new(&env);
        env.reset(Some(1), &mut buffers.observations).unwrap();
        let mut rng = Rng::seed_from_u64(1);
        for _ in 0..cases(100, 1000) {
            let actions: Vec<f32> = (0..4 * count).map(|_| rng.random_range(-1.0..1.0)).collect();
            env.step(&actions, buffers.step()).unwrap();
        }
        let substeps = env.engine_substeps();
        println!("random actions: {substeps:?}");
        assert!(substeps.mujoco * 1000 < substeps.flight, "{substeps:?}");
    }
}
