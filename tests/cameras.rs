//! Onboard cameras and views. Without an OpenGL library these tests pass without rendering, because a machine without
//! OpenGL is supported.
//!
//! "The paper" is *MuJoCo-Drones-Gym* (Tayal).

mod common;

use common::no_gl;
use mujoco_drones_gym::mujoco::{GeomId, ObjectId as _};
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::vision::{CAMERA_SIZE, SceneRenderer, intrinsics};
use mujoco_drones_gym::world::World;
use nalgebra::Vector3;

/// Creates a Hover environment with a tilted drone.
fn hovering(observation: ObservationType) -> Aviary<Hover> {
    Hover::builder()
        .initial_positions([[0.2, -0.3, 1.2]])
        .initial_rpys([[0.1, 0.3, 2.0]])
        .observation_type(observation)
        .build()
        .unwrap()
}

#[test]
fn image_observations_have_the_papers_shapes() {
    if no_gl() {
        return;
    }
    let mut env = hovering(ObservationType::RGB);
    assert_eq!(env.observation_space().rgb_shape(), Some([1, 48, 64, 4]));
    let observation = env.reset(None).unwrap().clone();
    assert_eq!((observation.rgb.len(), observation.vector.len()), (48 * 64 * 4, 0));
    assert!(observation.rgb.chunks(4).all(|pixel| pixel[3] == 255));
    assert!(env.observation_space().contains(&observation));

    let everything = "kin_rgb_depth_segmentation".parse().unwrap();
    let mut env = Hover::builder()
        .observation_type(everything)
        .camera_size(ImageSize { width: 100, height: 30 })
        .build()
        .unwrap();
    let observation = env.reset(None).unwrap().clone();
    let space = env.observation_space();
    assert_eq!(space.depth_shape(), Some([1, 30, 100]));
    assert_eq!(space.segmentation_shape(), Some([1, 30, 100, 2]));
    assert!(space.contains(&observation) && observation.vector.len() == 12 && observation.depth.len() == 3000);
    let step = env.step(&[0.3; 4]).unwrap();
    assert!(step.observation.depth != observation.depth, "the depth image changes with the position of the camera");

    let error = Hover::builder().camera_size(ImageSize { width: 0, height: 48 }).build().unwrap_err();
    assert!(error.to_string().contains("0x48"));
}

/// The paper's camera is at [0.02, 0, 0] m in the body frame, looks along body x with body z up, and has a vertical
/// field of view of 60°.
#[test]
fn depth_of_the_onboard_camera_matches_its_pose_and_field_of_view() {
    if no_gl() {
        return;
    }
    let mut env = hovering(ObservationType::DEPTH);
    let depth = env.reset(None).unwrap().depth.clone();
    let state = env.simulation().states()[0];
    let eye = state.position + state.attitude * Vector3::new(0.02, 0.0, 0.0);
    let [fx, fy, cx, cy] = intrinsics(CAMERA_SIZE);
    assert!((2.0 * (24.0 / fy).atan() - 60_f64.to_radians()).abs() < 1e-12);
    let mut floor_pixels = 0;
    for row in 0..48 {
        for column in 0..64 {
            // image right is body −y, image down is body −z
            let (u, v) = ((f64::from(column) + 0.5 - cx) / fx, (f64::from(row) + 0.5 - cy) / fy);
            let ray = state.attitude * Vector3::new(1.0, -u, -v);
            let expected = -eye.z / ray.z;
            if ray.z < 0.0 && expected < 10.0 {
                let got = f64::from(depth[row as usize * 64 + column as usize]);
                assert!((got - expected).abs() < 1e-3, "({column}, {row}): {got} {expected}");
                floor_pixels += 1;
            }
        }
    }
    assert!(floor_pixels > 1500, "{floor_pixels} pixels of floor");
}

#[test]
fn segmentation_and_depth_match_ray_casts_and_exclude_the_own_drone() {
    if no_gl() {
        return;
    }
    let simulation = Simulation::builder(DroneModel::Cf2x)
        .drones([DroneModel::Cf2x, DroneModel::Race, DroneModel::Cf2p].map(DroneModel::params))
        .initial_positions([[0.0, 0.0, 1.0], [0.45, 0.05, 0.95], [0.3, -0.1, 1.05]])
        .initial_rpys([[0.0, 0.0, 0.0], [0.2, 0.1, 1.0], [0.3, -0.5, 3.0]])
        .build()
        .unwrap();
    let mut renderer = SceneRenderer::for_observations(&simulation.scene()).unwrap();
    renderer.update(simulation.states()).unwrap();
    let size = ImageSize { width: 160, height: 120 };
    let mut objects = vec![[0; 2]; size.pixels()];
    renderer.onboard_segmentation(0, size, &mut objects).unwrap();
    let names = renderer.objects();
    let name = |index: i32| names.iter().find(|object| object.index == index).map_or("?", |object| &object.name);
    let visible: std::collections::BTreeSet<_> = objects.iter().filter(|o| o[0] == 5).map(|o| name(o[1])).collect();
    for part in ["floor", "drone1_frame", "drone1_propellers", "drone2_frame", "drone2_propellers"] {
        assert!(visible.contains(part), "{part} is not in {visible:?}");
    }
    assert!(!visible.iter().any(|name| name.starts_with("drone0") || *name == "?"), "{visible:?}");

    let mut depth = vec![0.0; size.pixels()];
    renderer.onboard_depth(0, size, &mut depth).unwrap();
    let data = renderer.data();
    let own = data.model().find(&World::drone_name(0)).unwrap();
    // every group except the collision geoms is rendered
    let groups = std::array::from_fn(|group| group != World::COLLISION_GROUP);
    let state = simulation.states()[0];
    let eye = state.position + state.attitude * Vector3::from(World::CAMERA_POSITION);
    let [fx, fy, cx, cy] = intrinsics(size);
    let (mut agree, mut near) = (0, 0);
    for (pixel, object) in objects.iter().enumerate() {
        let (column, row) = ((pixel % 160) as f64 + 0.5, (pixel / 160) as f64 + 0.5);
        let ray = state.attitude * Vector3::new(1.0, -(column - cx) / fx, -(row - cy) / fy);
        let hit = data.ray(eye.into(), ray.into(), groups, Some(own)).unwrap();
        let expected =
            hit.filter(|(_, t)| *t < 100.0).map_or([-1, -1], |(geom, _): (GeomId, f64)| [5, geom.get() as i32]);
        agree += usize::from(*object == expected);
        let distance = hit.map_or(100.0, |(_, t)| t.min(100.0));
        // the tolerance for depth is 1 mm, or 0.1 % beyond 1 m; pixels of silhouettes may miss it
        near += usize::from((f64::from(depth[pixel]) - distance).abs() < 1e-3 * f64::max(1.0, distance));
    }
    for (what, count) in [("objects", agree), ("depth", near)] {
        let share = count as f64 / size.pixels() as f64;
        assert!(share >= 0.99, "{what}: {share}");
    }
}

#[test]
fn equal_states_give_equal_images_in_every_environment_and_after_a_reset() {
    if no_gl() {
        return;
    }
    let kind = "rgb_depth_segmentation".parse().unwrap();
    let mut first = hovering(kind);
    let start = first.reset(Some(1)).unwrap().clone();
    for _ in 0..10 {
        first.step(&[0.2, -0.1, 0.0, 0.1]).unwrap();
    }
    assert!(*first.reset(Some(2)).unwrap() == start);
    assert!(*hovering(kind).reset(None).unwrap() == start);
}

#[test]
fn every_external_view_shows_the_drone() {
    if no_gl() {
        return;
    }
    let size = ImageSize { width: 320, height: 240 };
    for model in DroneModel::ALL {
        let simulation = Simulation::builder(model).initial_positions([[0.0, 0.0, 0.9]]).build().unwrap();
        let mut renderer = SceneRenderer::for_observations(&simulation.scene()).unwrap();
        renderer.update(simulation.states()).unwrap();
        let drones: Vec<_> = renderer.objects().into_iter().filter(|o| o.drone == Some(0)).map(|o| o.index).collect();
        assert_eq!(drones.len(), 7);
        for view in View::ALL {
            let mut objects = vec![[0; 2]; size.pixels()];
            renderer.segmentation(view, size, &mut objects).unwrap();
            let pixels = objects.iter().filter(|o| drones.contains(&o[1])).count();
            let expected = match view {
                View::Fpv => 0..1,
                // a single drone fills a large part of the frame; the front view shows its thin side
                View::Track | View::Fixed | View::Top => 1000..60_000,
                View::Front => 300..60_000,
            };
            assert!(expected.contains(&pixels), "{model} {view}: {pixels} pixels");
        }
    }
    let mut env = hovering(ObservationType::KIN);
    env.reset(None).unwrap();
    let mut rgb = vec![0; 3 * size.pixels()];
    for view in View::ALL {
        env.render(view, size, &mut rgb).unwrap();
        let mut colours: Vec<_> = rgb.chunks(3).collect();
        colours.sort();
        colours.dedup();
        assert!(colours.len() > 50, "{view} has {} colours", colours.len());
    }
    assert!(env.render(View::Track, size, &mut rgb[1..]).is_err());
}

/// Rendered motors are at the angles of the motor layout: motor 0 of the plus frame is in front, motor 0 of the X frame
/// in front on the left.
#[test]
fn rendered_motors_match_the_motor_layout() {
    if no_gl() {
        return;
    }
    for model in DroneModel::ALL {
        let params = model.params();
        let simulation = Simulation::builder(model).initial_positions([[0.0, 0.0, 1.0]]).build().unwrap();
        let mut renderer = SceneRenderer::for_observations(&simulation.scene()).unwrap();
        renderer.update(simulation.states()).unwrap();
        let data = renderer.data();
        // rendered motors may be further from the centre than the arm length (92 mm between opposite motors)
        let hits = |angle: f64| {
            let groups = std::array::from_fn(|group| group == World::VISUAL_GROUP);
            (0..70).any(|step| {
                let radius = params.arm_length * (0.9 + 0.005 * f64::from(step));
                let from = [radius * angle.cos(), radius * angle.sin(), 0.5];
                data.ray(from, [0.0, 0.0, 1.0], groups, None).unwrap().is_some()
            })
        };
        for [x, y] in params.motor_positions() {
            assert!(hits(y.atan2(x)), "{model}: no motor is rendered towards ({x}, {y})");
            assert!(!hits(y.atan2(x) + std::f64::consts::FRAC_PI_4), "{model}: a motor is rendered between two motors");
        }
    }
}

/// The scene reads the environment variable at construction. The test therefore starts child processes.
#[test]
fn a_directory_of_meshes_replaces_the_built_in_ones_and_missing_files_are_errors() {
    const CHILD: &str = "CAMERAS_TEST_OVERRIDE";
    if let Ok(expected) = std::env::var(CHILD) {
        let simulation = Simulation::builder(DroneModel::Cf2x).build().unwrap();
        match SceneRenderer::for_observations(&simulation.scene()) {
            Ok(renderer) => assert_eq!(renderer.data().model().nmeshface().to_string(), expected),
            Err(error) => assert!(error.to_string().contains(&expected), "{error}"),
        }
        return;
    }
    if no_gl() {
        return;
    }
    let run = |directory: &std::path::Path, expected: &str| {
        let status = std::process::Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "a_directory_of_meshes_replaces_the_built_in_ones_and_missing_files_are_errors"])
            .env(CHILD, expected)
            .env("MJ_DRONES_CF2_ASSETS", directory)
            .status()
            .unwrap();
        assert!(status.success(), "{expected}");
    };
    let directory = tempfile::tempdir().unwrap();
    run(directory.path(), "cf2_0.obj");
    let tetrahedron = "v 0 0 0\nv .01 0 0\nv 0 .01 0\nv 0 0 .01\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n";
    for index in 0..7 {
        std::fs::write(directory.path().join(format!("cf2_{index}.obj")), tetrahedron).unwrap();
    }
    run(directory.path(), "28");
}

/// Regression test: the rendered floor ended 1 km from the origin, and errors of depth at 900 m were ten times those at
/// the origin.
#[test]
fn images_of_the_floor_are_equal_at_every_distance_from_the_origin() {
    if no_gl() {
        return;
    }
    let size = ImageSize { width: 160, height: 120 };
    let simulation = Simulation::builder(DroneModel::Cf2x)
        .drones([DroneModel::Cf2x, DroneModel::Cf2x].map(DroneModel::params))
        .initial_positions([[0.2, -0.3, 1.2], [1.2, -0.2, 1.1]])
        .initial_rpys([[0.0, 0.3, 0.0], [0.0, 0.0, 0.7]])
        .build()
        .unwrap();
    let mut renderer = SceneRenderer::for_observations(&simulation.scene()).unwrap();
    let floor = renderer.objects().into_iter().find(|object| object.name == "floor").unwrap();
    let [fx, fy, cx, cy] = intrinsics(size);
    let mut look = |offsets: [[f64; 3]; 2]| {
        let mut states = simulation.states().to_vec();
        states.iter_mut().zip(offsets).for_each(|(state, offset)| state.position += Vector3::from(offset));
        renderer.update(&states).unwrap();
        let (mut rgb, mut depth, mut objects) =
            (vec![0; 4 * size.pixels()], vec![0.0; size.pixels()], vec![[0; 2]; size.pixels()]);
        // the other camera renders first, so that images of drone 0 follow a change of camera
        renderer.onboard_rgba(1, size, &mut rgb).unwrap();
        renderer.onboard_rgba(0, size, &mut rgb).unwrap();
        renderer.onboard_depth(0, size, &mut depth).unwrap();
        renderer.onboard_segmentation(0, size, &mut objects).unwrap();
        let state = &states[0];
        let eye = state.position + state.attitude * Vector3::from(World::CAMERA_POSITION);
        let (mut worst, mut floor_pixels): (f64, usize) = (0.0, 0);
        for (pixel, object) in objects.iter().enumerate() {
            let (column, row) = ((pixel % 160) as f64 + 0.5, (pixel / 160) as f64 + 0.5);
            let ray = state.attitude * Vector3::new(1.0, -(column - cx) / fx, -(row - cy) / fy);
            let distance = -eye.z / ray.z;
            if *object == [5, floor.index] && distance < 5.0 {
                worst = worst.max((f64::from(depth[pixel]) - distance).abs());
                floor_pixels += 1;
            }
        }
        // rays hit the floor below the drones, too
        let down =
            renderer.data().ray([eye.x, eye.y, 0.5], [0.0, 0.0, -1.0], [true, false, false, false, false, false], None);
        assert_eq!(down.unwrap().map(|(geom, distance)| (geom.index() as i32, distance)), Some((floor.index, 0.5)));
        (rgb, objects, worst, floor_pixels)
    };
    let (rgb, objects, worst, floor_pixels) = look([[0.0; 3]; 2]);
    assert!(floor_pixels > 9000 && worst < 3e-4, "{floor_pixels} pixels of floor, largest error of depth {worst} m");
    for offset in [[900.0, 0.0, 0.0], [0.0, -1200.0, 0.0], [5000.0, -5000.0, 0.0]] {
        let there = look([offset; 2]);
        assert!(there.2 < 3e-4, "{offset:?}: largest error of depth {} m", there.2);
        let other = objects.iter().zip(&there.1).filter(|(a, b)| a != b).count();
        assert!(other * 200 < objects.len(), "{offset:?}: {other} pixels show another object");
        let differing = rgb.iter().zip(&there.0).filter(|(a, b)| a.abs_diff(**b) > 8).count();
        assert!(differing * 50 < rgb.len(), "{offset:?}: {differing} values differ");
    }
    // drones that are far apart see the same floor
    let apart = look([[0.0; 3], [90.0, 0.0, 0.0]]);
    assert_eq!(apart.3, look([[0.0; 3]; 2]).3);
}

/// Regression test: shadows ended 1.2 m from the initial positions, and objects more than 2 m above them had no shadow.
#[test]
fn distant_and_high_gates_have_shadows() {
    if no_gl() {
        return;
    }
    use mujoco_drones_gym::vision::VisualEffects;
    use mujoco_drones_gym::world::{Marker, Obstacle, Shape};
    let shape = Shape::Box { half_size: [0.4, 0.4, 0.05] };
    let place = Vector3::new(5.0, -4.0, 4.5);
    let gate = Marker { name: "gate".into(), body: Obstacle::new(shape, place) };
    let env = Hover::builder().markers([gate]).build().unwrap();
    let size = ImageSize { width: 120, height: 120 };
    let render = |shadows| {
        let effects = VisualEffects { shadows, ..VisualEffects::default() };
        let quality = mujoco_drones_gym::mujoco::Quality::PRETTY;
        let mut renderer = SceneRenderer::new(&env.simulation().scene(), quality, effects).unwrap();
        renderer.set_stage([5.0, -4.0, 0.0], 2.0);
        renderer.update(env.simulation().states()).unwrap();
        let mut rgb = vec![0; 3 * size.pixels()];
        renderer.rgb(View::Top, size, &mut rgb).unwrap();
        rgb
    };
    let (with, without) = (render(true), render(false));
    let darker = with.iter().zip(&without).filter(|(a, b)| **a < b.saturating_sub(20)).count() / 3;
    assert!(darker > 100, "{darker} pixels of shadow");
}
