//! Obstacles: generation, contacts, new layouts, rangefinders, rendering and invalid options.

mod common;

use common::{assert_contract, no_gl, step_simulation};
use mujoco_drones_gym::engine::{Contact, Touched};
use mujoco_drones_gym::env::{ConditionChoice, Conditions, EndReason, Randomization};
use mujoco_drones_gym::mujoco::Model;
use mujoco_drones_gym::physics::wind::{WindConfig, WindModel};
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::sensing::{RangeConfig, Rangefinder};
use mujoco_drones_gym::tasks::NAMES;
use mujoco_drones_gym::vision::SceneRenderer;
use mujoco_drones_gym::world::{DroneBody, Obstacle, ObstacleConfig, ObstacleKind, Shape, World};
use mujoco_drones_gym::{Rng, SeedableRng};
use nalgebra::Vector3;
use proptest::prelude::*;

const KINDS: [ObstacleKind; 5] =
    [ObstacleKind::Forest, ObstacleKind::Urban, ObstacleKind::Indoor, ObstacleKind::Random, ObstacleKind::Gates];

/// Returns a configuration of a kind whose obstacles fit into the arena.
fn config(kind: ObstacleKind) -> ObstacleConfig {
    let count = if kind == ObstacleKind::Gates { 4 } else { 10 };
    ObstacleConfig { count, arena: [4.0, 4.0, 2.0], ..ObstacleConfig::new(kind) }
}

/// Creates a world with obstacles and one drone.
fn world(obstacles: Vec<Obstacle>, start: [f64; 3]) -> World {
    let drone = DroneBody { params: DroneModel::Cf2x.params(), position: start.into(), rpy: Vector3::zeros() };
    World { obstacles, ..World::new(vec![drone]) }
}

/// Returns a shape by number: box, sphere, cylinder, capsule.
fn shape(kind: usize, size: [f64; 3]) -> Shape {
    match kind {
        0 => Shape::Box { half_size: size },
        1 => Shape::Sphere { radius: size[0] },
        2 => Shape::Cylinder { radius: size[0], half_height: size[1] },
        _ => Shape::Capsule { radius: size[0], half_height: size[1] },
    }
}

#[test]
fn generated_obstacles_of_every_kind_keep_safe_zones_and_spacing_and_compile() {
    let starts = [[0.0, 0.0, 0.1], [0.6, -0.3, 1.0]];
    for kind in KINDS {
        let config = config(kind);
        let mut shapes = None;
        for seed in 0..1000 {
            let obstacles = config.generate(&starts, &mut Rng::seed_from_u64(seed)).unwrap();
            for (start, obstacle) in starts.iter().flat_map(|start| obstacles.iter().map(move |o| (start, o))) {
                let gap = obstacle.distance(&Vector3::from(*start));
                assert!(gap >= config.safe_zone - 1e-9, "{kind:?} seed {seed}: {gap} m from a drone");
            }
            // a gate consists of four bars; walls of a room may touch each other
            let (parts, walls) = match kind {
                ObstacleKind::Gates => (4, 0),
                ObstacleKind::Indoor => (1, obstacles.len() - config.count),
                _ => (1, 0),
            };
            let things: Vec<_> = obstacles[walls..].chunks(parts).collect();
            for (i, one) in things.iter().enumerate() {
                for other in &things[..i] {
                    for (a, b) in one.iter().flat_map(|a| other.iter().map(move |b| (a, b))) {
                        // gates and furniture: the distance from the centre to the other object is at least the spacing
                        if matches!(kind, ObstacleKind::Gates | ObstacleKind::Indoor) {
                            let level = Vector3::new(a.position.x, a.position.y, b.position.z);
                            assert!(b.distance(&level) >= config.spacing - 1e-9, "{kind:?} seed {seed}");
                        }
                        if let Shape::Cylinder { radius, .. } = a.shape
                            && kind == ObstacleKind::Forest
                        {
                            assert!(
                                b.distance(&Vector3::new(a.position.x, a.position.y, b.position.z)) - radius
                                    >= config.spacing - 1e-9
                            );
                        }
                        if kind == ObstacleKind::Random {
                            assert!(
                                (a.position - b.position).norm()
                                    >= a.shape.reach() + b.shape.reach() + config.spacing - 1e-9
                            );
                        }
                        if kind == ObstacleKind::Urban {
                            let (Shape::Box { half_size: s }, Shape::Box { half_size: t }) = (a.shape, b.shape) else {
                                panic!()
                            };
                            let gap = (a.position - b.position).xy().norm() - s[0].hypot(s[1]) - t[0].hypot(t[1]);
                            assert!(gap >= config.spacing - 1e-9, "seed {seed}: {gap}");
                        }
                    }
                }
            }
            let kinds: Vec<_> = obstacles.iter().map(|o| std::mem::discriminant(&o.shape)).collect();
            assert_eq!(
                *shapes.get_or_insert_with(|| kinds.clone()),
                kinds,
                "the shapes and their order do not depend on the seed"
            );
            if seed % 20 == 0 {
                let world = world(obstacles, starts[0]);
                Model::from_xml(&world.to_mjcf().unwrap()).unwrap();
                Model::from_xml(&world.to_whole_mjcf().unwrap()).unwrap();
            }
        }
    }
}

#[test]
fn too_many_and_invalid_obstacles_are_errors() {
    let refused = |config: ObstacleConfig, text: &str| {
        let error = config.generate(&[[0.0; 3]], &mut Rng::seed_from_u64(1)).unwrap_err().to_string();
        assert!(error.contains(text) && !error.contains('\n'), "{error}");
    };
    refused(
        ObstacleConfig { count: 500, ..config(ObstacleKind::Forest) },
        "of 500 obstacles fit into [4.0, 4.0, 2.0] m",
    );
    refused(ObstacleConfig { spacing: f64::NAN, ..config(ObstacleKind::Urban) }, "spacing is NaN");
    refused(ObstacleConfig { arena: [0.1, 1.0, 1.0], ..config(ObstacleKind::Urban) }, "arena is 0.1");
    refused(ObstacleConfig { safe_zone: 3.0, ..config(ObstacleKind::Indoor) }, "wall of the room is 2.000 m");
    let env = Hover::builder().obstacle_generator(ObstacleConfig { count: 5000, ..ObstacleConfig::default() }).build();
    assert!(env.unwrap_err().to_string().contains("count is 5000"));
}

proptest! {
    /// The distance to an obstacle is the length of the ray towards the nearest point, and no ray is shorter.
    #[test]
    fn distances_equal_the_lengths_of_rays(
        kind in 0..4_usize, size in prop::array::uniform3(0.1..0.5f64), rpy in prop::array::uniform3(-3.0..3.0f64),
        at in prop::array::uniform3(-2.0..2.0f64),
        directions in prop::collection::vec(prop::array::uniform3(-1.0..1.0f64), 30),
    ) {
        let obstacle = Obstacle { rpy: rpy.into(), ..Obstacle::new(shape(kind, size), Vector3::new(0.3, -0.2, 3.0)) };
        let here = obstacle.position + Vector3::from(at);
        let distance = obstacle.distance(&here);
        prop_assume!(distance > 0.05);
        // the gradient of the distance points away from the nearest point
        let h = 1e-6;
        let gradient = Vector3::from_fn(|axis, _| {
            let mut step = Vector3::zeros();
            step[axis] = h;
            (obstacle.distance(&(here + step)) - obstacle.distance(&(here - step))) / (2.0 * h)
        });
        let all = directions.iter().copied().chain([(-gradient).into()]);
        let directions = all.filter(|d| Vector3::from(*d).norm() > 0.1).collect();
        let config = RangeConfig { directions, max_range: 50.0 };
        let mut finder = Rangefinder::new(&world(vec![obstacle], here.into()), &config).unwrap();
        let mut out = vec![0.0; finder.rays()];
        finder.measure(&[DroneState::at_rest(here, Vector3::zeros())], &mut out).unwrap();
        let last = out[out.len() - 1];
        prop_assert!((last - distance).abs() < 1e-3 || gradient.norm() < 0.99, "{last} {distance}");
        let floor = here.z;
        prop_assert!(out.iter().all(|ray| *ray > distance.min(floor) - 1e-6), "{out:?} {distance}");
    }
}

/// Flies straight ahead at a speed, and returns the contacts and the final state.
fn fly_ahead(simulation: &mut Simulation, speed: f64, steps: usize) -> (Vec<Contact>, DroneState) {
    let start = simulation.initial_states()[0];
    simulation.reset_to(&[DroneState { velocity: Vector3::new(speed, 0.0, 0.0), ..start }]).unwrap();
    let hover = DroneModel::Cf2x.params().hover_rpm();
    let mut met = Vec::new();
    for _ in 0..steps {
        simulation.step(&[[hover; 4]]).unwrap();
        met.extend(simulation.contacts().iter().copied().filter(|c| !met.contains(c)).collect::<Vec<_>>());
    }
    (met, simulation.states()[0])
}

/// MuJoCo has fewer geoms than a forest of 200 trees. A flight into it equals the flight among the nearest trees alone.
#[test]
fn contacts_among_two_hundred_trees_equal_contacts_among_the_nearest_trees() {
    let forest = ObstacleConfig { count: 200, arena: [12.0, 12.0, 2.0], ..ObstacleConfig::default() };
    let start = [0.0, 0.0, 1.0];
    let mut struck = 0;
    for seed in 0..12 {
        let trees = forest.generate(&[start], &mut Rng::seed_from_u64(seed)).unwrap();
        let build = |trees: Vec<Obstacle>| {
            Simulation::builder(DroneModel::Cf2x).initial_positions([start]).obstacles(trees).build().unwrap()
        };
        let mut crowded = build(trees.clone());
        let (met, end) = fly_ahead(&mut crowded, 4.0, 60);
        let Some(Touched::Obstacle(first)) = met.first().map(|contact| contact.with) else { continue };
        struck += 1;
        // the trees nearest to the end of the flight, including the one that it hit first
        let mut near: Vec<_> = (0..200).collect();
        near.sort_by(|&a, &b| trees[a].distance(&end.position).total_cmp(&trees[b].distance(&end.position)));
        near.truncate(9);
        if !near.contains(&first) {
            near.push(first);
        }
        let mut few = build(near.iter().map(|&index| trees[index]).collect());
        let (alone, same) = fly_ahead(&mut few, 4.0, 60);
        let named: Vec<_> = alone
            .iter()
            .map(|contact| match contact.with {
                Touched::Obstacle(index) => Touched::Obstacle(near[index]),
                other => other,
            })
            .collect();
        assert_eq!(named, met.iter().map(|contact| contact.with).collect::<Vec<_>>(), "seed {seed}");
        assert!((same.position - end.position).norm() < 1e-9, "seed {seed}: {} {}", same.position, end.position);
        // the flight is repeatable in the same simulation
        assert_eq!(fly_ahead(&mut crowded, 4.0, 60), (met, end));
    }
    assert!(struck >= 4, "{struck} of 12 flights hit a tree");
}

/// A wall has more bricks than the scene has geoms. At every speed the drone stops at it and touches the bricks in
/// front.
#[test]
fn a_wall_of_many_bricks_stops_a_drone_at_every_speed() {
    let brick = |i: i32, j: i32| {
        let place = Vector3::new(2.0, 0.1 * f64::from(i), 0.1 * f64::from(j) + 0.05);
        Obstacle::new(Shape::Box { half_size: [0.1, 0.05, 0.05] }, place)
    };
    let bricks: Vec<_> = (-20..=20).flat_map(|i| (0..20).map(move |j| brick(i, j))).collect();
    for speed in [1.0, 5.0, 12.0] {
        let mut simulation = Simulation::builder(DroneModel::Cf2x)
            .initial_positions([[0.0, 0.0, 1.0]])
            .obstacles(bricks.clone())
            .sim_freq(480)
            .build()
            .unwrap();
        let (met, end) = fly_ahead(&mut simulation, speed, (48.0 * 3.0 / speed) as usize);
        assert!(end.position.x < 2.0, "{speed} m/s: the drone passed the wall, position {}", end.position);
        assert!(!met.is_empty(), "{speed} m/s");
        for contact in met {
            let Touched::Obstacle(index) = contact.with else { continue };
            assert!((bricks[index].position - Vector3::new(2.0, 0.0, 1.0)).norm() < 1.0, "{contact:?}");
        }
    }
}

/// An obstacle that is compiled at the origin of the world frame can be moved, too.
#[test]
fn an_obstacle_at_the_origin_can_be_moved() {
    let ball = |x: f64, z: f64| Obstacle::new(Shape::Sphere { radius: 0.2 }, Vector3::new(x, 0.0, z));
    let mut simulation = Simulation::builder(DroneModel::Cf2x)
        .initial_positions([[0.0, 0.0, 0.5]])
        .obstacles([ball(0.0, 0.0)])
        .build()
        .unwrap();
    let fall = |simulation: &mut Simulation| {
        simulation.reset().unwrap();
        step_simulation(simulation, &[[0.0; 4]], 60);
        simulation.states()[0].position.z
    };
    let lands = fall(&mut simulation);
    assert!((lands - 0.215).abs() < 0.01, "height on top of the ball: {lands} m");
    simulation.set_obstacles(&[ball(3.0, 0.0)]).unwrap();
    assert!((fall(&mut simulation) - 0.015).abs() < 0.005, "the drone lands on the floor");
}

#[test]
fn a_moved_layout_is_identical_to_a_compiled_one() {
    for (kind, count) in [(ObstacleKind::Random, 8), (ObstacleKind::Random, 60), (ObstacleKind::Forest, 40)] {
        let config = ObstacleConfig { count, arena: [6.0, 6.0, 2.0], ..ObstacleConfig::new(kind) };
        let start = [0.0, 0.0, 0.9];
        let layout = |seed| config.generate(&[start], &mut Rng::seed_from_u64(seed)).unwrap();
        let build = |obstacles| {
            Simulation::builder(DroneModel::Cf2x).initial_positions([start]).obstacles(obstacles).build().unwrap()
        };
        let mut moved = build(layout(1));
        fly_ahead(&mut moved, 3.0, 40);
        for seed in 2..6 {
            moved.set_obstacles(&layout(seed)).unwrap();
            let fresh = &mut build(layout(seed));
            assert_eq!(fly_ahead(&mut moved, 3.0, 60), fly_ahead(fresh, 3.0, 60), "{kind:?} {count} seed {seed}");
            assert_eq!(moved.obstacle_distance(0), fresh.obstacle_distance(0));
        }
        let mut wrong = layout(1);
        wrong[0].shape = Shape::Capsule { radius: 0.1, half_height: 0.1 };
        wrong[0].position.x = f64::NAN;
        assert!(moved.set_obstacles(&wrong).unwrap_err().to_string().contains("obstacle 0"));
        assert!(moved.set_obstacles(&wrong[1..]).is_err());
    }
}

#[test]
fn every_task_keeps_its_contract_with_new_layouts_and_rangefinders() {
    for name in NAMES {
        let field = ObstacleConfig {
            count: 30,
            arena: [10.0, 10.0, 2.0],
            safe_zone: 0.5,
            new_layout: true,
            ..ObstacleConfig::new(ObstacleKind::Random)
        };
        let config = EnvConfig::default()
            .obstacle_generator(field)
            .observation_type(ObservationType::KIN_RANGES)
            .episode_seconds(2.0);
        let build = || make(name, config.clone()).unwrap();
        assert_contract(build);
    }
}

#[test]
fn contact_with_an_obstacle_ends_the_episode_and_ranges_measure_its_distance() {
    let wall = Obstacle::new(Shape::Box { half_size: [0.1, 2.0, 1.0] }, Vector3::new(1.0, 0.0, 1.0));
    let mut env = Hover::builder()
        .initial_positions([[0.0, 0.0, 1.0]])
        .initial_velocities([[2.0, 0.0, 0.0]])
        .obstacles([wall])
        .observation_type(ObservationType::KIN_RANGES)
        .build()
        .unwrap();
    let observation = env.reset(None).unwrap();
    assert!(
        (observation.obstacle[0] - 0.9).abs() < 1e-12 && (observation.ranges[0] - 0.9).abs() < 1e-9,
        "{:?}",
        observation.ranges
    );
    assert!(
        (observation.ranges[9] - 1.0).abs() < 1e-9 && (observation.ranges[8] - 5.0).abs() < 1e-9,
        "ranges to the floor and upwards"
    );
    assert!((observation.ranges[1] - 0.9 * 2_f64.sqrt()).abs() < 1e-9, "range at 45°");
    while env.info().end.is_none() {
        let observation = &env.step(&[0.0; 4]).unwrap().observation;
        assert!(observation.obstacle[0] > 0.0);
    }
    assert_eq!(env.info().end, Some(EndReason::ObstacleContact));
    assert!(env.observation().obstacle[0] < 0.07);
}

#[test]
fn moved_obstacles_are_rendered_at_their_positions() {
    if no_gl() {
        return;
    }
    let config = ObstacleConfig { count: 3, ..ObstacleConfig::new(ObstacleKind::Random) };
    let layout = |seed| config.generate(&[[0.0, 0.0, 1.0]], &mut Rng::seed_from_u64(seed)).unwrap();
    let size = ImageSize { width: 160, height: 120 };
    let state = DroneState::at_rest(Vector3::new(0.0, 0.0, 1.0), Vector3::zeros());
    let render = |renderer: &mut SceneRenderer| {
        renderer.update(&[state]).unwrap();
        let mut rgb = vec![0; 3 * size.pixels()];
        renderer.rgb(View::Fixed, size, &mut rgb).unwrap();
        rgb
    };
    let renderer = |seed| SceneRenderer::for_observations(&world(layout(seed), [0.0, 0.0, 1.0])).unwrap();
    let mut moved = renderer(1);
    let before = render(&mut moved);
    for seed in 2..4 {
        moved.set_obstacles(&layout(seed)).unwrap();
        let after = render(&mut moved);
        assert!(after != before && after == render(&mut renderer(seed)), "seed {seed}");
    }
}

#[test]
fn default_obstacle_options_depend_on_the_kind_alone() {
    for kind in ObstacleKind::ALL {
        let text = format!("kind = \"{}\"\n", kind.name());
        let config: ObstacleConfig = toml::from_str(&text).unwrap();
        assert_eq!(config, ObstacleConfig::new(kind));
        // the defaults fit into the arena
        for seed in 0..200 {
            config.generate(&[[0.0, 0.0, 0.1]], &mut Rng::seed_from_u64(seed)).unwrap();
        }
    }
    assert_eq!(toml::from_str::<ObstacleConfig>("").unwrap(), ObstacleConfig::default());
}

#[test]
fn contradictory_obstacle_options_are_errors() {
    let refused = |text: &str, expected: &str| {
        let text = format!("[obstacles]\n{text}");
        let error = Conditions::from_toml(&text).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
    };
    let custom = "[[obstacles.custom]]\nshape = \"sphere\"\nsize = [0.1]\nposition = [1.0, 0.0, 1.0]\n";
    refused(custom, "kind is forest, expected custom, because there is a custom list");
    refused(&format!("kind = \"custom\"\ncount = 3\n{custom}"), "count is 3, but the custom list has 1 entries");
    refused(&format!("kind = \"custom\"\nnew_layout = true\n{custom}"), "new_layout is true");
    let huge = custom.replace("0.1", "1e15");
    refused(&format!("kind = \"custom\"\n{huge}"), "the size of custom obstacle 0 is 1e15");
    let both = Hover::builder()
        .obstacle_generator(ObstacleConfig::default())
        .obstacles([Obstacle::new(Shape::Sphere { radius: 0.1 }, Vector3::new(1.0, 0.0, 1.0))]);
    assert!(both.build().unwrap_err().to_string().contains("obstacles is a list next to an obstacle_generator"));
}

#[test]
fn a_second_wind_or_wind_model_is_an_error() {
    let randomized = "[randomization.environment]\n";
    let choice = ConditionChoice { wind: Some(WindModel::Constant), ..ConditionChoice::default() };
    let error = Conditions::from_toml_with(randomized, &choice).unwrap_err().to_string();
    assert!(error.contains("wind is constant, expected none, or a randomization with environment.wind"), "{error}");
    let calm = Conditions::from_toml_with("[randomization.environment]\nwind = [0.0, 0.0]\n", &choice).unwrap();
    assert_eq!(calm.wind.unwrap().model, WindModel::Constant);
    let built = Hover::builder().wind(WindConfig::new(WindModel::Gust)).randomization(Randomization::default()).build();
    assert!(built.unwrap_err().to_string().contains("wind is gust"));

    let error = Conditions::from_toml_with("[wind]\nmodel = \"dryden\"\n", &choice).unwrap_err().to_string();
    assert!(error.contains("[wind] has model = \"dryden\" next to the option `constant`"), "{error}");
    let chosen = Conditions::from_toml_with("[wind]\nvelocity = [3.0, 0.0, 0.0]\n", &choice).unwrap().wind.unwrap();
    assert_eq!((chosen.model, chosen.velocity), (WindModel::Constant, [3.0, 0.0, 0.0]));
    let error = Conditions::from_toml("[wind]\nvelocity = [3.0, 0.0, 0.0]\n").unwrap_err().to_string();
    assert!(error.contains("[wind] has no model"), "{error}");
}

#[test]
fn furniture_is_clear_of_doorways() {
    let config = ObstacleConfig { arena: [6.0, 4.0, 2.0], count: 20, ..ObstacleConfig::new(ObstacleKind::Indoor) };
    let mut doorways = 0;
    for seed in 0..300 {
        let obstacles = config.generate(&[[0.0, 0.0, 0.1]], &mut Rng::seed_from_u64(seed)).unwrap();
        let (walls, furniture) = obstacles.split_at(obstacles.len() - config.count);
        // four outer walls come first, then two parts of each partition with a doorway between them
        for pair in walls[4..].chunks_exact(2) {
            let [Shape::Box { half_size: below }, Shape::Box { half_size: above }] = [pair[0].shape, pair[1].shape]
            else {
                panic!("a wall is a box")
            };
            let (low, high) = (pair[0].position.y + below[1], pair[1].position.y - above[1]);
            assert!((high - low - 0.8).abs() < 1e-9, "seed {seed}");
            doorways += 1;
            for piece in furniture {
                // points of the doorway and up to 0.4 m on both sides of it
                for x in [-0.4, -0.2, 0.0, 0.2, 0.4] {
                    for share in [0.0, 0.25, 0.5, 0.75, 1.0] {
                        let place = Vector3::new(pair[0].position.x + x, low + share * (high - low), piece.position.z);
                        assert!(piece.distance(&place) > 0.0, "seed {seed}: furniture at {}", piece.position);
                    }
                }
            }
        }
    }
    assert_eq!(doorways, 900);
}

/// Returns obstacles with sizes and positions from 0.1 µm to far beyond the accepted range.
fn any_obstacle() -> impl Strategy<Value = Obstacle> {
    let wide = || (-7.0..17.0f64).prop_map(|exponent| 10_f64.powf(exponent));
    let place = prop_oneof![-1.0..1.0f64, wide(), wide().prop_map(|x| -x)];
    let near =
        || prop_oneof![3 => 0.01..1.0f64, 1 => -4.0..4.0f64].prop_map(|x| if x < 0.01 { 10_f64.powf(x) } else { x });
    let size = prop_oneof![4 => prop::array::uniform3(near()), 1 => prop::array::uniform3(wide())];
    let position = prop_oneof![4 => prop::array::uniform3(-1.0..1.0f64), 1 => prop::array::uniform3(place)];
    (0..4_usize, size, position, prop::array::uniform3(-4.0..4.0f64), prop::array::uniform4(0.0..1.0f64)).prop_map(
        |(kind, size, position, rpy, rgba)| Obstacle {
            rpy: rpy.into(),
            rgba,
            ..Obstacle::new(shape(kind, size), position.into())
        },
    )
}

proptest! {
    /// Obstacles of every accepted size compile and can be stepped. MuJoCo's collision code does not end for 10¹⁵ m.
    #[test]
    fn accepted_obstacles_compile_and_can_be_stepped(
        obstacles in prop::collection::vec(any_obstacle(), 1..5),
        start in prop::array::uniform3(-1.0..1.0f64), rpy in prop::array::uniform3(-3.0..3.0f64),
        radius in -4.0..3.0f64,
    ) {
        let mut params = DroneModel::Cf2x.params();
        params.collision_radius = 10_f64.powf(radius);
        let built = Simulation::builder(params)
            .initial_positions([start])
            .initial_rpys([rpy])
            .obstacles(obstacles.clone())
            .build();
        match built {
            Ok(mut simulation) => for _ in 0..2 {
                // a contact that pushes the drone out too fast may be an error
                let _ = simulation.step(&[[12_000.0; 4]]);
            },
            Err(error) => prop_assert!(error.to_string().contains("obstacle"), "{error}"),
        }
    }

    #[test]
    fn obstacle_options_are_written_to_toml_and_read_back(
        custom in prop::collection::vec(any_obstacle(), 0..6), kind in prop::sample::select(ObstacleKind::ALL.to_vec()),
        count in 0..2000_usize, arena in prop::array::uniform3(0.5..1e3f64),
        spacing in 0.0..1e3f64, safe_zone in 0.0..1e3f64,
        seed in prop::option::of(0..=i64::MAX as u64), new_layout in any::<bool>(),
        safe_zone_centers in prop::collection::vec(prop::array::uniform3(-1e5..1e5f64), 0..3),
    ) {
        let config = ObstacleConfig {
            kind, count, arena, spacing, safe_zone, safe_zone_centers, new_layout, seed, custom,
        };
        let text = toml::to_string(&config).unwrap();
        prop_assert_eq!(toml::from_str::<ObstacleConfig>(&text).unwrap(), config, "{}", text);
    }
}

/// Regression test: rays passed through transparent obstacles, which drones collide with.
#[test]
fn rangefinders_measure_transparent_obstacles() {
    for alpha in [1.0, 0.4, 0.0] {
        let mut pane = Obstacle::new(Shape::Box { half_size: [0.01, 1.0, 1.0] }, Vector3::new(1.51, 0.0, 1.0));
        pane.rgba[3] = alpha;
        let world = world(vec![pane], [0.0, 0.0, 1.0]);
        let ahead = RangeConfig { directions: vec![[1.0, 0.0, 0.0]], max_range: 5.0 };
        let mut finder = Rangefinder::new(&world, &ahead).unwrap();
        let state = DroneState { position: Vector3::new(0.0, 0.0, 1.0), ..DroneState::default() };
        let mut distance = [0.0];
        finder.measure(&[state], &mut distance).unwrap();
        assert!((distance[0] - 1.5).abs() < 1e-9, "alpha {alpha}: {distance:?}");
        finder.set_obstacles(&[pane]).unwrap();
        finder.measure(&[state], &mut distance).unwrap();
        assert!((distance[0] - 1.5).abs() < 1e-9, "alpha {alpha}: {distance:?}");
    }
}
