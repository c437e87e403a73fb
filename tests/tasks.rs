//! Tasks: the paper's table, rewards, ends of episodes, flights of controllers, and options.
//!
//! "The paper" is *MuJoCo-Drones-Gym* (Tayal).

mod common;

use common::step_env;
use mujoco_drones_gym::control::trajectory::Trajectory;
use mujoco_drones_gym::control::{CollisionCone, ControllerKind};
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::state::attitude_from_rpy;
use mujoco_drones_gym::tasks::{self, Antipodal, FlyThrough, Formation, MultiHover, Race, Velocity, make};
use mujoco_drones_gym::wrappers::SafetyWrapper;
use mujoco_drones_gym::{Rng, SeedableRng};
use nalgebra::Vector3;

/// Flies an episode with a controller and returns the sum of rewards.
fn fly(env: &mut dyn DroneEnv, kind: ControllerKind, seed: u64) -> f64 {
    let mut pilot = ControllerPolicy::new(kind, env);
    fly_episode(env, &mut pilot, Some(seed)).unwrap().reward
}

#[test]
fn drones_times_and_sizes_are_those_of_the_papers_table() {
    let table: Vec<_> = tasks::all()
        .iter()
        .map(|task| {
            let defaults = &task.defaults;
            (task.name, defaults.num_drones, defaults.episode_seconds, task.action_size(), task.observation_size())
        })
        .collect();
    let paper = [
        ("hover", 1, 10.0, 4, 12),
        ("velocity", 1, 10.0, 4, 16),
        ("multi_hover", 2, 10.0, 8, 26),
        ("fly_through", 1, 20.0, 4, 18),
        ("formation", 3, 30.0, 12, 54),
        ("race", 1, 30.0, 4, 21),
        ("multi_agent", 3, 10.0, 4, 13),
    ];
    assert_eq!(table[..7], paper);
    for name in tasks::NAMES {
        let summary = tasks::summary(name).unwrap();
        let env = make(name, EnvConfig::default()).unwrap();
        assert_eq!(env.name(), name);
        let agents = if summary.multi_agent { 3 } else { 1 };
        assert_eq!(env.observation_space().vector.size(), agents * summary.observation_size());
        assert_eq!(env.action_space().size(), agents * summary.action_size());
        assert_eq!(env.episode_steps() as f64, 48.0 * summary.defaults.episode_seconds);
    }
    let error = make("nosuch", EnvConfig::default()).err().unwrap().to_string();
    let expected = tasks::NAMES[..9].join(", ") + " or track";
    assert_eq!(error, format!("no task `nosuch`, expected {expected}"));
}

#[test]
fn controllers_complete_every_task() {
    for name in tasks::NAMES {
        let summary = tasks::summary(name).unwrap();
        for model in DroneModel::PAPER {
            // a test below flies antipodal behind the safety filter
            if name == "antipodal" {
                continue;
            }
            for seed in [1, 8] {
                let mut env = make(name, EnvConfig::default().drone(model)).unwrap();
                fly(&mut *env, summary.defaults.controller, seed);
                assert!(env.info().success, "{name} with {model}: {:?}", env.info_map());
                assert_eq!(env.info().progress, 1.0);
            }
        }
    }
    // the identified Crazyflie, by the default controller of each task
    for name in tasks::NAMES.into_iter().filter(|name| *name != "antipodal") {
        let mut env = make(name, EnvConfig::default().drone(DroneModel::Cf21)).unwrap();
        fly(&mut *env, tasks::summary(name).unwrap().defaults.controller, 3);
        assert!(env.info().success, "{name}: {:?}", env.info_map());
    }
    for (name, drones, model) in [
        ("fly_through", 2, DroneModel::Cf2x),
        ("fly_through", 4, DroneModel::Cf2p),
        ("race", 2, DroneModel::Cf2x),
        ("race", 4, DroneModel::Cf2x),
        ("race", 3, DroneModel::Race),
        ("multi_agent", 3, DroneModel::Cf2x),
    ] {
        let physics = if name == "multi_agent" { Physics::MjcGndDragDw } else { Physics::Mjc };
        let mut env = make(name, EnvConfig::default().drone(model).num_drones(drones).physics(physics)).unwrap();
        fly(&mut *env, tasks::summary(name).unwrap().defaults.controller, 1);
        assert!(env.info().success, "{drones} {model} in {name}: {:?}", env.info_map());
    }
    let mut env = MultiHover::builder().num_drones(8).physics(Physics::MjcGndDragDw).build().unwrap();
    fly(&mut env, ControllerKind::Dsl, 1);
    assert!(env.info().success, "{:?}", env.info());
    let mut env = Formation::builder().build().unwrap();
    fly(&mut env, ControllerKind::Dsl, 1);
    assert!(env.task().mean_error() < 0.05, "{}", env.task().mean_error());
    for (model, seconds) in [(DroneModel::Cf2x, 30.0), (DroneModel::Race, 12.0)] {
        let mut env = Race::builder().drone(model).build().unwrap();
        fly(&mut env, ControllerKind::Geometric, 1);
        assert!(env.task().gates_passed(0) == 12 && env.info().time < seconds, "{model}: {:?}", env.info());
        assert_eq!(env.info().end, Some(EndReason::Completed));
    }
}

/// Twelve drones swap places and stay more than 0.3 m apart, with and without downwash.
#[test]
fn twelve_drones_swap_places_behind_the_safety_filter_with_and_without_downwash() {
    for physics in [Physics::Mjc, Physics::MjcDw] {
        let env = Antipodal::builder()
            .physics(physics)
            .action_type(ActionType::Vel)
            .controller(ControllerKind::Geometric)
            .build()
            .unwrap();
        let mut env = SafetyWrapper::new(env, CollisionCone::new(0.36)).unwrap();
        let mut pilot = ControllerPolicy::new(ControllerKind::Geometric, &env);
        let summary = fly_episode(&mut env, &mut pilot, Some(1)).unwrap();
        let nearest = env.inner().task().minimum_distance();
        assert!(summary.success && nearest > 0.3, "{physics}: {nearest} {summary:?}");
        assert!(env.interventions() > 10);
    }
    let rpm = Antipodal::builder().build().unwrap();
    assert!(SafetyWrapper::new(rpm, CollisionCone::new(0.3)).unwrap_err().to_string().contains("expected vel"));
}

/// Creates a simulation with the initial positions of a task and these current states.
fn simulation_at(task: &dyn Task, states: &[DroneState]) -> Simulation {
    let params = vec![DroneModel::Cf2x.params(); states.len()];
    let mut simulation = Simulation::builder(DroneModel::Cf2x)
        .num_drones(states.len())
        .initial_positions(task.initial_positions(&params))
        .build()
        .unwrap();
    simulation.reset_to(states).unwrap();
    simulation
}

/// Returns the sum of the rewards of all drones in a step from `before` to `after`.
fn reward(task: &mut dyn Task, before: &[DroneState], after: &[DroneState], end: Option<EndReason>) -> f64 {
    task.reset(simulation_at(task, before).view(), &mut Rng::seed_from_u64(1));
    let simulation = simulation_at(task, after);
    task.update(simulation.view());
    (0..after.len()).map(|drone| task.reward(simulation.view(), drone, end)).sum()
}

fn state(position: [f64; 3], rpy: [f64; 3], velocity: [f64; 3], rates: [f64; 3]) -> DroneState {
    DroneState {
        position: position.into(),
        attitude: attitude_from_rpy(rpy.into()),
        velocity: velocity.into(),
        angular_velocity: rates.into(),
    }
}

/// Returns a level state at rest.
fn still(position: [f64; 3]) -> DroneState {
    state(position, [0.0; 3], [0.0; 3], [0.0; 3])
}

#[test]
fn rewards_match_the_papers_formulas() {
    let close = |got: f64, expected: f64| assert!((got - expected).abs() < 1e-9, "{got}, expected {expected}");
    let crash = Some(EndReason::FloorContact);

    // |z − 1| = 0.5, ‖(3, 4)‖ = 5, ‖v‖ = 2, |φ| + |θ| = 0.3
    let leaning = state([3.0, 4.0, 1.5], [0.1, -0.2, 2.0], [0.0, 2.0, 0.0], [1.0; 3]);
    let mut hover = Hover::default();
    close(reward(&mut hover, &[leaning], &[leaning], None), -0.5 - 0.5 - 0.1 - 0.015);
    close(reward(&mut hover, &[leaning], &[leaning], crash), -0.5 - 0.5 - 0.1 - 0.015 - 100.0);
    close(reward(&mut hover, &[still([0.0; 3])], &[still([0.03, 0.0, 1.04])], None), -0.04 - 0.003 + 0.5);
    close(reward(&mut hover, &[still([0.0; 3])], &[still([0.0, 0.06, 1.0])], None), -0.006);
    close(reward(&mut hover, &[leaning], &[still([0.0, 0.0, 3.5])], Some(EndReason::OutOfBounds)), -2.5);

    // target velocity zero: ‖v‖ = 2, then 0.04; ω_z = 1, then −0.2
    let mut velocity = Velocity::default();
    (velocity.max_speed, velocity.max_yaw_rate) = (0.0, 0.0);
    close(reward(&mut velocity, &[leaning], &[leaning], None), -2.0 - 0.1 - 0.015);
    close(reward(&mut velocity, &[leaning], &[leaning], crash), -2.0 - 0.1 - 0.015 - 100.0);
    let slow = state([0.0, 0.0, 6.0], [0.0, 0.3, 0.0], [0.04, 0.0, 0.0], [0.0, 0.0, -0.2]);
    close(reward(&mut velocity, &[slow], &[slow], None), -0.04 - 0.02 - 0.015 + 0.5);

    // ‖v‖ = 2, ‖ω‖ = √3; then ‖v‖ just above its bound for rest; then below it
    let mut stabilize = Stabilize::default();
    close(reward(&mut stabilize, &[leaning], &[leaning], None), -2.0 - 0.1 * 3.0_f64.sqrt() - 0.015);
    close(reward(&mut stabilize, &[leaning], &[slow], None), -0.04 - 0.02 - 0.015);
    close(reward(&mut stabilize, &[leaning], &[slow], crash), -0.04 - 0.02 - 0.015 - 100.0);
    let resting = state([0.0, 0.0, 6.0], [0.2, 0.0, 1.0], [0.03, 0.04, 0.0], [0.0, 0.06, 0.0]);
    let almost = state([0.0, 0.0, 6.0], [0.2, 0.0, 1.0], [0.03, 0.03, 0.0], [0.0, 0.06, 0.0]);
    close(reward(&mut stabilize, &[leaning], &[resting], None), -0.05 - 0.006 - 0.01);
    close(reward(&mut stabilize, &[leaning], &[almost], None), -0.0018_f64.sqrt() - 0.006 - 0.01 + 0.5);

    // constant reference at (0.5, 0, 1) m
    let mut track = Track::default();
    track.speed = 0.0;
    close(reward(&mut track, &[leaning], &[leaning], None), -22.5_f64.sqrt() - 0.2 - 0.015);
    close(reward(&mut track, &[leaning], &[leaning], crash), -22.5_f64.sqrt() - 0.2 - 0.015 - 100.0);
    close(reward(&mut track, &[leaning], &[still([0.5, 0.03, 0.96])], None), -0.05);
    close(reward(&mut track, &[leaning], &[still([0.5, 0.03, 0.98])], None), -0.0013_f64.sqrt() + 0.5);

    // drone 0 at its target of 0.7 m; drone 1 (start x = 1 m, target 1.2 m) 0.3 m to the side and 0.2 m low, at 1 m/s
    let mut multi = MultiHover::default();
    let pair = [still([0.0, 0.0, 0.7]), state([1.0, 0.3, 1.0], [0.0; 3], [1.0, 0.0, 0.0], [0.0; 3])];
    close(reward(&mut multi, &pair, &pair, None), 0.5 - 0.2 - 0.03 - 0.05);
    close(reward(&mut multi, &pair, &pair, crash), 0.5 - 0.2 - 0.03 - 0.05 - 200.0);
    let both = [still([0.0, 0.0, 0.7]), still([1.0, 0.0, 1.2])];
    close(reward(&mut multi, &both, &both, None), 1.0);

    // first waypoint (0, 0, 1) at a distance of 0.5 m; then captured at 0.08 m with 3 rad/s
    let mut through = FlyThrough::default();
    let turning = state([0.0, 0.08, 1.0], [0.0; 3], [0.0; 3], [0.0, 3.0, 0.0]);
    close(reward(&mut through, &[still([0.0, 0.0, 0.1])], &[still([0.0, 0.0, 0.5])], None), -0.05);
    close(reward(&mut through, &[still([0.0, 0.0, 0.5])], &[turning], None), 10.0 - 0.008 - 0.03);
    close(reward(&mut through, &[turning], &[still([0.0, 0.0, 1.4])], crash), 10.0 - 0.04 - 100.0);

    // gate (1, 0, 1) 2 m ahead at 3 m/s; then passed at 4 m/s, 0.1 m from its centre
    let mut race = Race::default();
    let fast = |x: f64, v: f64| state([x, 0.0, 1.0], [0.0; 3], [v, 0.0, 0.0], [0.0; 3]);
    close(reward(&mut race, &[fast(-1.1, 3.0)], &[fast(-1.0, 3.0)], None), 6.0 - 0.1);
    close(reward(&mut race, &[fast(0.7, 4.0)], &[fast(0.9, 4.0)], None), 20.0 + 8.0 - 0.005);
    close(reward(&mut race, &[fast(0.0, 4.0)], &[fast(2.0, 0.0)], crash), 20.0 - 0.05 - 100.0);

    // three drones at their places; then all 0.1 m too high; then one 0.3 m too far out along its radius
    let mut formation = Formation::default();
    let place = |drone: f64, out: f64, up: f64| {
        let (sin, cos) = (std::f64::consts::TAU * drone / 3.0).sin_cos();
        still([(0.3 + out) * cos, (0.3 + out) * sin, 1.0 + up])
    };
    let kept = [place(0.0, 0.0, 0.0), place(1.0, 0.0, 0.0), place(2.0, 0.0, 0.0)];
    close(reward(&mut formation, &kept, &kept, None), 0.0);
    let high = [place(0.0, 0.0, 0.1), place(1.0, 0.0, 0.1), place(2.0, 0.0, 0.1)];
    close(reward(&mut formation, &kept, &high, None), -0.3);
    // its two distances are √(0.6² + 0.3² + 0.6·0.3) instead of 0.3·√3
    let out = [place(0.0, 0.3, 0.0), place(1.0, 0.0, 0.0), place(2.0, 0.0, 0.0)];
    let longer = 0.63_f64.sqrt() - 0.3 * 3.0_f64.sqrt();
    close(reward(&mut formation, &kept, &out, None), -0.3 - 0.5 * 2.0 * longer);
    close(reward(&mut formation, &kept, &kept, crash), -300.0);

    // 4 m from the goals; then drone 0 at its goal with drone 1 at a distance of 0.2 m
    let mut antipodal = Antipodal::default();
    antipodal.stagger = 0.0;
    let apart = [still([2.0, 0.0, 1.0]), still([-2.0, 0.0, 1.0])];
    close(reward(&mut antipodal, &apart, &apart, None), -0.8);
    let swapped = [still([-2.0, 0.05, 1.0]), still([-2.0, 0.25, 1.0])];
    let away = 4.0_f64.hypot(0.25);
    close(reward(&mut antipodal, &apart, &swapped, None), -0.005 + 0.5 - 1.0 - 0.1 * away - 1.0);
    close(reward(&mut antipodal, &apart, &swapped, crash), -0.005 + 0.5 - 1.0 - 0.1 * away - 1.0 - 200.0);
}

#[test]
fn a_crash_costs_100_and_ends_the_episode_in_every_task() {
    for name in tasks::NAMES {
        let mut env = make(name, EnvConfig::default()).unwrap();
        env.reset(Some(1)).unwrap();
        let drones = env.simulation().num_drones();
        let rest = vec![0.0; 4 * drones];
        let mut last = env.step(&vec![1.0; 4 * drones]).unwrap().reward;
        step_env(&mut *env, &vec![1.0; 4 * drones], 12);
        // drone 0 turns over because one of its motors stops
        let mut action = rest.clone();
        action[0] = -1.0;
        loop {
            let step = env.step(&action).unwrap();
            let (reward, over) = (step.reward, step.terminated);
            assert!(!step.truncated, "{name}");
            if over {
                assert!(reward < last - 90.0, "{name}: {reward} after {last}");
                break;
            }
            last = reward;
        }
        assert!(env.info().crashed() && !env.info().success, "{name}: {:?}", env.info());
        assert!(env.drone_end(0).is_some_and(EndReason::is_crash));
        assert!((1..drones).all(|drone| env.drone_end(drone).is_none()), "{name}: another drone has ended");
    }
}

#[test]
fn the_observation_after_a_capture_has_the_next_waypoint_of_that_drone() {
    let mut env = FlyThrough::builder()
        .num_drones(2)
        .initial_positions([[0.0, 0.0, 0.85], [0.0, -0.5, 0.85]])
        .initial_velocities([[0.0, 0.0, 1.0], [0.0; 3]])
        .initial_rpys([[0.0, 0.0, 1.0], [0.0; 3]])
        .build()
        .unwrap();
    let first = env.reset(Some(1)).unwrap().vector.clone();
    assert_eq!(first[12..15], [0.0, 0.0, 1.0]);
    // the offset is in the body frame; the yaw does not change its vertical component
    assert!((Vector3::new(first[15], first[16], first[17]) - Vector3::new(0.0, 0.0, 0.15)).norm() < 1e-12);
    let mut captured = 0;
    while captured == 0 {
        let step = env.step(&[0.0; 8]).unwrap();
        let (observation, reward) = (step.observation.vector.clone(), step.reward);
        captured = env.task().captured(0);
        assert_eq!(reward > 9.0, captured == 1);
        assert_eq!(observation[12..15], if captured == 1 { [1.0, 0.0, 1.0] } else { [0.0, 0.0, 1.0] });
        assert_eq!(observation[18 + 12..18 + 15], [0.0, 0.0, 1.0], "drone 1 still has its first waypoint");
    }
    let (x, yaw) = (env.observation().vector[15], 1.0_f64);
    assert!((x - yaw.cos()).abs() < 0.05, "the offset is in the body frame");
    assert!((env.info().progress - 0.1).abs() < 1e-12);
    assert_eq!(env.info_map()["waypoints_captured"], 1.0);
}

#[test]
fn invalid_options_are_errors_with_their_name() {
    let refused = |result: Result<Box<dyn DroneEnv + Send>, EnvError>, text: &str| {
        let error = result.err().expect(text).to_string();
        assert!(error.contains(text) && !error.contains('\n'), "{error}");
    };
    let config = EnvConfig::default;
    refused(make("hover", config().num_drones(2)), "num_drones is 2, expected 1 in hover");
    refused(make("race", config().num_drones(0)), "drones");
    refused(make("race", config().episode_seconds(f64::NAN)), "episode_seconds is NaN s");
    refused(make("race", config().neighbourhood_radius(-1.0)), "neighbourhood");
    refused(make("formation", config().num_drones(40)), "m apart for drones of");
    refused(make("formation", config().drone(DroneModel::Race).num_drones(8)), "m apart for drones of");
    refused(make("antipodal", config().num_drones(60)), "with 60 drones");
    let boxed = |env: Result<Aviary<FlyThrough>, EnvError>| env.map(|env| Box::new(env) as Box<dyn DroneEnv + Send>);
    refused(
        boxed(FlyThrough::builder().task(|task| task.waypoints.clear()).build()),
        "waypoints is 0 points, expected 1 to 198",
    );
    refused(boxed(FlyThrough::builder().task(|task| task.radius = 0.0).build()), "radius is 0 m");
    refused(
        boxed(FlyThrough::builder().task(|task| task.waypoints[2][1] = f64::NAN).build()),
        "waypoints is NaN m along an axis",
    );
    let heights = MultiHover::builder().task(|task| task.target_heights = Some(vec![1.0])).build();
    assert!(heights.unwrap_err().to_string().contains("target_heights is 1 height, expected one per drone"));
    let laps = Race::builder().task(|task| task.laps = 0).build();
    assert!(laps.unwrap_err().to_string().contains("laps is 0"));
}

#[test]
fn a_plan_starts_at_the_current_position() {
    let mut env = Race::builder().build().unwrap();
    env.reset(Some(1)).unwrap();
    let whole = env.plan(0).unwrap();
    fly(&mut env, ControllerKind::Geometric, 1);
    assert!(env.plan(0).is_none(), "there is no plan after the last gate");
    env.reset(Some(1)).unwrap();
    step_env(&mut env, &[0.1; 4], 20);
    let rest: Box<dyn Trajectory> = env.plan(0).unwrap();
    assert!((rest.start().position - env.simulation().states()[0].position).norm() < 1e-9);
    assert!((rest.duration() - whole.duration()).abs() < 3.0);
}

#[test]
fn gates_are_rendered_and_have_no_collisions() {
    let env = Race::builder().build().unwrap();
    let (visible, _) = env.simulation().world().to_visible_mjcf().unwrap();
    let physical = env.simulation().world().to_mjcf().unwrap();
    assert_eq!(visible.matches("name=\"gate").count(), 24);
    assert_eq!(physical.matches("name=\"gate").count(), 0);
}

#[test]
fn stabilize_and_track_sample_their_starts_within_limits() {
    let mut env = Stabilize::builder().num_drones(2).build().unwrap();
    let mut starts = Vec::new();
    for seed in 0..200 {
        env.reset(Some(seed)).unwrap();
        let states = env.simulation().states().to_vec();
        for state in &states {
            assert!(state.velocity.amax() <= 1.0 && state.angular_velocity.amax() <= 2.0 && state.tilt() < 0.72);
        }
        env.reset(Some(seed)).unwrap();
        assert_eq!(env.simulation().states(), states, "the same seed gives the same states");
        starts.push(states[1]);
    }
    let max = |f: fn(&DroneState) -> f64| starts.iter().map(f).fold(f64::NEG_INFINITY, f64::max);
    assert!(max(|s| s.velocity.x) > 0.9 && max(|s| -s.velocity.z) > 0.9 && max(|s| s.angular_velocity.y) > 1.8);
    assert!(max(|s| s.rpy().x) > 0.4 && max(|s| -s.rpy().y) > 0.4 && max(|s| s.yaw()) > 3.0);

    let mut env = Track::builder().build().unwrap();
    let mut directions = [0; 2];
    for seed in 0..200 {
        let x = env.reset(Some(seed)).unwrap().vector.clone();
        assert!((x[0].hypot(x[1]) - 0.5).abs() < 1e-12 && x[2] == 1.0, "the drone starts on the circle");
        assert!(x[12..18].iter().all(|x| x.abs() < 1e-12), "the drone starts at the reference, which is at rest");
        // after 1 s the reference moves at full speed, at right angles to the radius
        let mut reference = env.reference(0);
        for _ in 0..60 {
            env.step(&[0.0; 4]).unwrap();
            let next = env.reference(0);
            let moved = (next.position - reference.position) * 48.0;
            assert!((moved - 0.5 * (next.velocity + reference.velocity)).norm() < 2e-3);
            reference = next;
        }
        let (p, v) = (reference.position, reference.velocity);
        assert!((v.norm() - 0.5).abs() < 1e-12 && (p.x * v.x + p.y * v.y).abs() < 1e-12);
        let inwards = nalgebra::Vector3::z() - p;
        assert!((reference.acceleration - inwards).norm() < 1e-12, "the acceleration is v²/r towards the centre");
        directions[usize::from(p.x * v.y - p.y * v.x > 0.0)] += 1;
    }
    assert!(directions[0] > 60 && directions[1] > 60, "{directions:?}");
}
