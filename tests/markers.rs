//! Moving markers of a task: images, contacts and ranges, in single environments and batches, with both engines.

mod common;

use std::f64::consts::FRAC_PI_2;

use common::{no_gl, reset_batch, step_env};
use mujoco_drones_gym::nalgebra::Vector3;
use mujoco_drones_gym::observation::{STATE_SIZE, state_vector};
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::tasks::{CrashConditions, CrashWatch};
use mujoco_drones_gym::world::{MarkerPose, MovingMarker, Obstacle, Shape};
use mujoco_drones_gym::{Rng, RngExt as _};

/// Hover at 1 m while a ball moves along −x at 1 m/s, with a sampled offset along y.
#[derive(Debug, Clone)]
struct Ball {
    solid: bool,
    /// True for a ball that keeps its pose after the reset.
    stands_still: bool,
    /// Largest offset along y, m.
    spread: f64,
    /// Sampled offset along y, m.
    offset: f64,
    watch: CrashWatch,
}

impl Ball {
    fn new(solid: bool, spread: f64) -> AviaryBuilder<Self> {
        AviaryBuilder::new(Self { solid, stands_still: false, spread, offset: 0.0, watch: CrashWatch::default() })
    }

    fn place(&self, time: f64) -> Vector3<f64> {
        Vector3::new(1.5 - time, self.offset, 1.0)
    }
}

impl Task for Ball {
    fn name(&self) -> &'static str {
        "ball"
    }
    fn defaults(&self) -> TaskDefaults {
        TaskDefaults { num_drones: 1, episode_seconds: 3.0, controller: ControllerKind::Geometric }
    }
    fn initial_positions(&self, drones: &[DroneParams]) -> Vec<[f64; 3]> {
        (0..drones.len()).map(|drone| [0.0, drone as f64, 1.0]).collect()
    }
    fn observation_space(&self) -> BoxSpace {
        BoxSpace::new([[f64::NEG_INFINITY, f64::INFINITY]; STATE_SIZE])
    }
    fn moving_markers(&self) -> Vec<MovingMarker> {
        let body = Obstacle {
            rgba: [0.9, 0.1, 0.1, 1.0],
            ..Obstacle::new(Shape::Sphere { radius: 0.1 }, Vector3::new(1.5, 0.0, 1.0))
        };
        let ball = if self.solid { MovingMarker::solid("ball", body) } else { MovingMarker::visible("ball", body) };
        vec![MovingMarker { stands_still: self.stands_still, ..ball }]
    }
    fn move_markers(&self, simulation: SimView<'_>, poses: &mut [MarkerPose]) {
        poses[0].position = self.place(simulation.time());
    }
    fn reset(&mut self, simulation: SimView<'_>, rng: &mut Rng) {
        self.watch.reset(simulation);
        self.offset = self.spread * (2.0 * rng.random::<f64>() - 1.0);
    }
    fn update(&mut self, simulation: SimView<'_>) {
        self.watch.update(&CrashConditions::with_max_tilt(FRAC_PI_2), simulation);
    }
    fn end(&self, _simulation: SimView<'_>, drone: usize) -> Option<EndReason> {
        self.watch.end(drone)
    }
    fn reward(&self, simulation: SimView<'_>, drone: usize, end: Option<EndReason>) -> f64 {
        simulation.obstacle_distance(drone).min(9.0) - if end.is_some() { 100.0 } else { 0.0 }
    }
    fn observe(&self, simulation: SimView<'_>, drone: usize, out: &mut [f64]) {
        out.copy_from_slice(&state_vector(&simulation.states()[drone]));
    }
    fn success(&self, _simulation: SimView<'_>, drone: usize) -> bool {
        self.watch.end(drone).is_none()
    }
    fn reference(&self, simulation: SimView<'_>, drone: usize) -> Reference {
        Reference::hover(simulation.initial_states()[drone].position, 0.0)
    }
}

#[test]
fn a_marker_that_stands_still_only_moves_between_episodes() {
    for solid in [true, false] {
        for stands_still in [true, false] {
            let mut env = Ball::new(solid, 0.3).task(|ball| ball.stands_still = stands_still).build().unwrap();
            let place = |env: &Aviary<Ball>| {
                let simulation = env.simulation();
                let body = if solid { simulation.obstacles()[0] } else { simulation.markers().last().unwrap().body };
                (body.position, env.task().offset)
            };
            let mut starts = Vec::new();
            for seed in [1, 2] {
                env.reset(Some(seed)).unwrap();
                let (start, offset) = place(&env);
                assert_eq!(start, Vector3::new(1.5, offset, 1.0));
                starts.push(start);
                for _ in 0..10 {
                    env.step(&[0.0; 4]).unwrap();
                }
                let moved = if stands_still { 0.0 } else { env.simulation().time() };
                assert_eq!(place(&env).0, Vector3::new(1.5 - moved, offset, 1.0), "{solid} {stands_still}");
            }
            assert_ne!(starts[0], starts[1]);
            let moving = env.simulation().moving_obstacles().len();
            assert_eq!(moving, usize::from(solid && !stands_still));
        }
    }
}

/// Flies an episode with motors at hover speed and returns states, rewards and the end.
fn hover(env: &mut Aviary<Ball>, seed: u64) -> (Vec<DroneState>, Vec<f64>, Option<EndReason>) {
    env.reset(Some(seed)).unwrap();
    let (mut states, mut rewards) = (Vec::new(), Vec::new());
    while env.info().end.is_none() {
        rewards.push(env.step(&vec![0.0; env.action_space().size()]).unwrap().reward);
        states.push(env.simulation().states()[0]);
    }
    (states, rewards, env.info().end)
}

#[test]
fn contact_with_a_solid_marker_is_a_crash_and_visible_markers_have_no_contacts() {
    for engine in [EngineKind::Mujoco, EngineKind::Hybrid] {
        let mut env = Ball::new(true, 0.0).engine(engine).build().unwrap();
        for episode in 0..2 {
            let (states, _, end) = hover(&mut env, 1);
            assert_eq!(end, Some(EndReason::ObstacleContact), "{engine} {episode}");
            // the ball travels 1.5 m minus both radii at 1 m/s; two control steps may pass until the contact
            let seconds = states.len() as f64 / 48.0;
            assert!((seconds - 1.36).abs() < 0.03, "{engine}: {seconds} s");
        }
        let mut env = Ball::new(false, 0.0).engine(engine).build().unwrap();
        let (states, _, end) = hover(&mut env, 1);
        assert_eq!((end, states.len()), (Some(EndReason::TimeLimit), 144));
        assert!(env.simulation().obstacles().is_empty());
        let marker = env.simulation().markers().pop().unwrap();
        assert!((marker.body.position - Vector3::new(-1.5, 0.0, 1.0)).norm() < 1e-9, "the ball has passed the drone");
    }
}

/// Both engines agree for near misses, grazing contacts and hits.
#[test]
fn both_engines_report_contacts_with_solid_markers_at_the_same_step() {
    let build = |engine| Ball::new(true, 0.25).engine(engine).build().unwrap();
    let (mut mujoco, mut hybrid) = (build(EngineKind::Mujoco), build(EngineKind::Hybrid));
    let mut crashes = 0;
    for seed in 0..12 {
        let (a, a_rewards, a_end) = hover(&mut mujoco, seed);
        let (b, b_rewards, b_end) = hover(&mut hybrid, seed);
        assert_eq!((a.len(), a_end), (b.len(), b_end), "seed {seed}");
        crashes += usize::from(a_end == Some(EndReason::ObstacleContact));
        // in the step with the contact, MuJoCo's convex collision stops at a tolerance of 1e-6 and amplifies rounding
        // errors of the attitude (measured: 4e-8 m; 1e-13 m with `mpr_tolerance` 1e-12)
        let before = a.len() - usize::from(a_end == Some(EndReason::ObstacleContact));
        for (index, (a, b)) in a.iter().zip(&b).enumerate() {
            let bound = if index < before { 1e-9 } else { 1e-6 };
            let apart = (a.position - b.position).norm();
            assert!(apart < bound, "seed {seed}, row {index}: {apart} m");
        }
        assert!(a_rewards.iter().zip(&b_rewards).all(|(a, b)| (a - b).abs() < 1e-6));
    }
    assert!((2..12).contains(&crashes), "{crashes} of 12 episodes end in a hit");
    // far from the ball, the flight kernel integrates
    let substeps = hybrid.simulation().engine_substeps();
    assert!(substeps.flight > substeps.mujoco, "{substeps:?}");
}

/// Environment i of a batch equals the single environment with stream i, for any number of threads.
#[test]
fn markers_in_a_batch_move_as_in_single_environments() {
    const COUNT: usize = 11;
    for (threads, drones) in [(1, 1), (2, 2)] {
        let builder = Ball::new(true, 0.15).num_drones(drones).episode_seconds(1.7);
        let config = VecConfig { threads, autoreset: Autoreset::NextStep, ..VecConfig::new(COUNT) };
        let (mut batch, mut buffers) = reset_batch(builder.clone(), config, 5);
        let mut single: Vec<_> = (0..COUNT as u64)
            .map(|stream| builder.clone().engine(EngineKind::Hybrid).stream(stream).build().unwrap())
            .collect();
        let mut over = [false; COUNT];
        for env in &mut single {
            env.reset(Some(5)).unwrap();
        }
        let (mut ends, row) = (0, batch.observation_size());
        for _ in 0..130 {
            batch.step(&vec![0.0; COUNT * 4 * drones], buffers.step()).unwrap();
            for (index, env) in single.iter_mut().enumerate() {
                if std::mem::take(&mut over[index]) {
                    env.reset(None).unwrap();
                    assert_eq!(buffers.rewards[index], 0.0);
                } else {
                    let step = env.step(&vec![0.0; 4 * drones]).unwrap();
                    over[index] = step.terminated || step.truncated;
                    assert_eq!(buffers.terminated[index], step.terminated, "environment {index}");
                    assert_eq!(buffers.rewards[index], step.reward as f32, "environment {index}");
                    ends += usize::from(step.terminated);
                }
                let observation = env.observation().vector.iter().map(|&x| x as f32);
                assert!(
                    observation.eq(buffers.observations[row * index..][..row].iter().copied()),
                    "environment {index}"
                );
            }
        }
        assert!(ends > 3, "{ends} episodes ended in a hit");
    }
}

#[test]
fn rangefinders_measure_solid_markers_alone() {
    for (solid, expected) in [(true, 1.4 - 0.5), (false, 5.0)] {
        let mut env = Ball::new(solid, 0.0).observation_type(ObservationType::KIN_RANGES).build().unwrap();
        env.reset(Some(1)).unwrap();
        step_env(&mut env, &[0.0; 4], 24);
        let ahead = env.observation().ranges[0];
        assert!((ahead - expected).abs() < 1e-2, "solid {solid}: {ahead}");
    }
}

/// Onboard cameras and views show solid and visible markers, in single environments and batches.
#[test]
fn moving_markers_are_rendered_at_their_positions() {
    if no_gl() {
        return;
    }
    let red = |pixels: &[u8], bytes: usize| {
        pixels.chunks_exact(bytes).filter(|p| p[0] > 90 && i32::from(p[0]) > 2 * i32::from(p[1].max(p[2]))).count()
    };
    let size = ImageSize { width: 64, height: 48 };
    for solid in [true, false] {
        let builder = Ball::new(solid, 0.0).observation_type(ObservationType::KIN_RGB).camera_size(size);
        let mut env = builder.clone().build().unwrap();
        env.reset(Some(1)).unwrap();
        let far = red(&env.observation().rgb, 4);
        step_env(&mut env, &[0.0; 4], 48);
        let near = red(&env.observation().rgb, 4);
        assert!(far > 10 && near > 4 * far, "solid {solid}: {far} pixels, then {near}");
        let mut rgb = vec![0; 3 * size.pixels()];
        env.render(View::Fixed, size, &mut rgb).unwrap();
        assert!(red(&rgb, 3) > 0, "solid {solid}");

        let (mut batch, mut buffers) = reset_batch(builder, VecConfig::new(3), 1);
        for _ in 0..48 {
            batch.step(&[0.0; 12], buffers.step()).unwrap();
        }
        let bytes = 4 * size.pixels();
        let mut images = vec![0; 3 * bytes];
        use mujoco_drones_gym::vector::VecImages;
        batch.render_images(VecImages { rgb: &mut images, ..VecImages::default() }).unwrap();
        for image in images.chunks_exact(bytes) {
            assert_eq!(red(image, 4), near, "solid {solid}");
        }
    }
}

#[test]
fn markers_move_among_obstacles_with_new_layouts() {
    use mujoco_drones_gym::world::{ObstacleConfig, ObstacleKind};
    let field = ObstacleConfig { count: 15, new_layout: true, ..ObstacleConfig::new(ObstacleKind::Forest) };
    let mut env = Ball::new(true, 0.0).obstacle_generator(field).build().unwrap();
    let mut layouts = Vec::new();
    for _ in 0..3 {
        env.reset(None).unwrap();
        let obstacles = env.simulation().obstacles();
        assert_eq!(obstacles.len(), 16);
        assert_eq!(obstacles[15].position, Vector3::new(1.5, 0.0, 1.0));
        layouts.push(obstacles[0].position);
        step_env(&mut env, &[0.0; 4], 5);
        let ball = env.simulation().obstacles()[15].position;
        assert!((ball.x - (1.5 - 5.0 / 48.0)).abs() < 1e-12);
    }
    assert!(layouts[0] != layouts[1] && layouts[1] != layouts[2]);
}

#[test]
fn a_non_finite_pose_is_an_error_with_the_name_of_the_marker() {
    let mut env = Ball::new(true, f64::NAN).build().unwrap();
    let error = env.reset(Some(1)).unwrap_err().to_string();
    assert!(error.contains("move_markers is NaN") && error.contains("`ball`"), "{error}");
    let mut env = Ball::new(true, 0.0).build().unwrap();
    env.reset(Some(1)).unwrap();
    assert!(env.step(&[0.0; 4]).is_ok());
}
