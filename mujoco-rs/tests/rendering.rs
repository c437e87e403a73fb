//! Images compared with closed forms and rays. Without an OpenGL library every test here passes, because the
//! program must work without one; `.ci/run` requires one.

use std::sync::Arc;

use mujoco_rs::{
    BodyId, Camera, CameraId, Data, Decor, Error, GeomId, GlBackend, ImageSize, Model, ObjectId as _, Quality,
    Renderer, Scene, VisualEffects, gl_info,
};
use proptest::prelude::*;

/// Floor with objects, seen from a height of 1.3 m, 35° downwards.
const ROOM: &str = r#"<mujoco><compiler angle="degree"/>
  <visual><map znear="0.01" zfar="100"/></visual>
  <asset><texture type="skybox" builtin="gradient" rgb1="1 1 1" rgb2="0 0 1" width="32" height="192"/></asset>
  <statistic extent="1" center="0 0 0"/>
  <worldbody>
    <light directional="true" dir="0.3 0.2 -1" pos="0 0 4"/>
    <geom name="floor" type="plane" size="50 50 100" rgba=".5 .6 .7 1"/>
    <camera name="down" pos="0 0 1.3" euler="55 0 0" fovy="50"/>
    <camera name="ahead" pos="0 -2 0.5" euler="90 0 0" fovy="60"/>
    <body name="box" pos="0 0.1 0.5"><geom name="box" type="box" size=".3 .1 .2" rgba="1 0 0 1"/></body>
    <body name="ball" pos="0.8 1 0.3"><freejoint/><geom name="ball" type="sphere" size=".3" rgba="0 1 0 1"/></body>
    <body name="rod" pos="-0.9 0.7 0.4"><geom name="rod" type="capsule" size=".1 .3" euler="30 40 0"/></body>
  </worldbody></mujoco>"#;

struct Fixture {
    data: Data,
    scene: Scene,
    renderer: Renderer,
}

/// Creates the fixture; returns `None` if OpenGL is unavailable.
fn fixture(xml: &str, quality: Quality) -> Option<Fixture> {
    if matches!(gl_info(), Err(Error::NoGl { .. })) {
        return None;
    }
    let mut data = Data::new(Model::from_xml(xml).unwrap()).unwrap();
    data.forward().unwrap();
    let model = data.shared_model();
    let mut scene = Scene::new(Arc::clone(&model), 100).unwrap();
    scene.set_effects(VisualEffects::default());
    Some(Fixture { data, scene, renderer: Renderer::new(model, quality).unwrap() })
}

impl Fixture {
    fn set_camera(&mut self, camera: &str) -> Camera {
        let camera = Camera::Fixed(self.data.model().find::<CameraId>(camera).unwrap());
        self.scene.update(&mut self.data, &camera).unwrap();
        camera
    }

    fn rgb(&mut self, size: ImageSize) -> Vec<u8> {
        let mut rgb = vec![0; 3 * size.pixels()];
        self.renderer.rgb(&mut self.scene, size, &mut rgb).unwrap();
        rgb
    }

    fn depth(&mut self, size: ImageSize) -> Vec<f32> {
        let mut depth = vec![0.0; size.pixels()];
        self.renderer.depth(&mut self.scene, size, &mut depth).unwrap();
        depth
    }

    fn segmentation(&mut self, size: ImageSize) -> Vec<[i32; 2]> {
        let mut objects = vec![[0; 2]; size.pixels()];
        self.renderer.segmentation(&mut self.scene, size, &mut objects).unwrap();
        objects
    }

    /// Returns the camera's position and, for the centre of every pixel, the ray direction with unit length along
    /// the axis.
    fn rays(&self, camera: &str, size: ImageSize) -> ([f64; 3], Vec<[f64; 3]>) {
        let id: CameraId = self.data.model().find(camera).unwrap();
        let at: [f64; 3] = self.data.cam_xpos()[3 * id.index()..][..3].try_into().unwrap();
        let m: [f64; 9] = self.data.cam_xmat()[9 * id.index()..][..9].try_into().unwrap();
        let half = (self.data.model().cam_fovy()[id.index()].to_radians() / 2.0).tan();
        let (w, h) = (f64::from(size.width), f64::from(size.height));
        let mut rays = Vec::new();
        for row in 0..size.height {
            for column in 0..size.width {
                let x = (2.0 * (f64::from(column) + 0.5) - w) / h * half;
                let y = (h - 2.0 * (f64::from(row) + 0.5)) / h * half;
                rays.push(std::array::from_fn(|i| x * m[3 * i] + y * m[3 * i + 1] - m[3 * i + 2]));
            }
        }
        (at, rays)
    }
}

const SIZES: [ImageSize; 3] =
    [ImageSize { width: 64, height: 48 }, ImageSize { width: 320, height: 240 }, ImageSize { width: 33, height: 71 }];

#[test]
fn the_depth_of_a_floor_matches_the_closed_form_to_a_millimetre_at_every_pixel() {
    // the floor without objects
    let alone = ROOM.split("<body").next().unwrap().to_string() + "</worldbody></mujoco>";
    let Some(mut fixture) = fixture(&alone, Quality::FAST) else { return };
    fixture.set_camera("down");
    for size in SIZES {
        let depth = fixture.depth(size);
        let (at, rays) = fixture.rays("down", size);
        let mut seen = 0;
        for (z, ray) in depth.iter().zip(&rays) {
            let distance = -at[2] / ray[2];
            if ray[2] < 0.0 && distance < 12.0 {
                assert!((f64::from(*z) - distance).abs() < 1e-3, "{z} {distance}");
                seen += 1;
            }
        }
        assert!(seen * 10 > 9 * size.pixels(), "the floor fills the image: {seen} of {}", size.pixels());
    }
}

#[test]
fn the_depth_of_a_box_face_is_its_distance_and_of_the_background_the_far_plane() {
    let Some(mut fixture) = fixture(ROOM, Quality::FAST) else { return };
    fixture.set_camera("ahead");
    for size in SIZES {
        let depth = fixture.depth(size);
        let objects = fixture.segmentation(size);
        let the_box: GeomId = fixture.data.model().find("box").unwrap();
        let mut seen = 0;
        for (z, object) in depth.iter().zip(&objects) {
            if *object == [5, the_box.index() as i32] {
                // the face at y = 0 is perpendicular to the view from y = −2; grazing pixels show the top
                assert!((f64::from(*z) - 2.0).abs() < 1e-3, "{z}");
                seen += 1;
            } else if *object == [-1, -1] {
                assert!((z - 100.0).abs() < 0.01, "{z}");
            }
        }
        assert!(seen > 20);
        // the sky and other visual effects do not change the depth
        fixture.scene.set_effects(VisualEffects::pretty());
        assert!(fixture.depth(size) == depth);
        fixture.scene.set_effects(VisualEffects::default());
        assert_eq!(fixture.scene.clip_planes().map(|x| (x * 1e4).round() / 1e4), [0.01, 100.0]);
    }
}

#[test]
fn segmentation_matches_ray_casting() {
    let Some(mut fixture) = fixture(ROOM, Quality::FAST) else { return };
    for camera in ["down", "ahead"] {
        fixture.set_camera(camera);
        for size in SIZES {
            let objects = fixture.segmentation(size);
            let (at, rays) = fixture.rays(camera, size);
            let agree = (objects.iter().zip(&rays))
                .filter(|(object, ray)| {
                    let hit = fixture.data.ray(at, **ray, [true; 6], None).unwrap();
                    let wanted = hit.filter(|(_, t)| *t < 100.0).map_or([-1, -1], |(geom, _)| [5, geom.index() as i32]);
                    **object == wanted
                })
                .count();
            let share = agree as f64 / size.pixels() as f64;
            assert!(share >= 0.99, "{camera} {size}: {share}");
            for name in ["box", "ball", "floor"] {
                let geom: GeomId = fixture.data.model().find(name).unwrap();
                assert!(camera == "down" || objects.contains(&[5, geom.index() as i32]), "{name} in {camera}");
            }
        }
    }
}

#[test]
fn the_first_row_is_the_top_and_the_first_column_is_the_left() {
    let Some(mut fixture) = fixture(ROOM, Quality::FAST) else { return };
    fixture.set_camera("ahead");
    let size = SIZES[1];
    let rgb = fixture.rgb(size);
    let at = |x: usize, y: usize| -> [u8; 3] { rgb[3 * (y * 320 + x)..][..3].try_into().unwrap() };
    assert_eq!(at(160, 5), [0, 0, 0], "the background above");
    let floor = at(160, 230);
    assert!(floor[2] > floor[0] && floor[0] > 0, "the blue floor below: {floor:?}");
    let middle = at(160, 120);
    assert!(middle[0] / 2 > middle[1], "the red box in the centre: {middle:?}");
    let green = |x: usize| (0..240).any(|y| at(x, y)[1] / 2 > at(x, y)[0].max(at(x, y)[2]).max(20));
    assert!((200..320).any(green) && !(0..120).any(green), "the green ball on the right");

    let mut rgba = vec![7; 4 * size.pixels()];
    fixture.renderer.rgba(&mut fixture.scene, size, &mut rgba).unwrap();
    for (a, b) in rgba.chunks(4).zip(rgb.chunks(3)) {
        assert_eq!((&a[..3], a[3]), (b, 255));
    }
}

#[test]
fn the_same_state_gives_the_same_bytes_in_any_context_and_thread() {
    let Some(mut first) = fixture(ROOM, Quality::FAST) else { return };
    first.set_camera("ahead");
    let size = SIZES[1];
    let (rgb, depth, objects) = (first.rgb(size), first.depth(size), first.segmentation(size));
    let small = first.rgb(SIZES[0]);
    assert_eq!((first.rgb(size), first.segmentation(size)), (rgb.clone(), objects.clone()));
    std::thread::scope(|scope| {
        for _ in 0..3 {
            scope.spawn(|| {
                let mut other = fixture(ROOM, Quality::FAST).unwrap();
                other.set_camera("ahead");
                assert_eq!(other.rgb(SIZES[0]), small, "before the buffer has grown");
                assert!(other.rgb(size) == rgb && other.segmentation(size) == objects);
                assert!(other.depth(size).iter().zip(&depth).all(|(a, b)| a.to_bits() == b.to_bits()));
            });
        }
    });
    // created here, used in another thread, dropped in a third
    let moved = std::thread::spawn(move || {
        assert!(first.rgb(size) == rgb);
        first
    });
    let first = moved.join().unwrap();
    std::thread::spawn(move || drop(first)).join().unwrap();
}

#[test]
fn a_context_that_is_kept_current_draws_the_same_bytes() {
    let Some(mut first) = fixture(ROOM, Quality::FAST) else { return };
    let mut second = fixture(ROOM, Quality::FAST).unwrap();
    first.set_camera("ahead");
    second.set_camera("down");
    let size = SIZES[1];
    let expected = [first.rgb(size), second.rgb(size)];
    assert_ne!(expected[0], expected[1]);
    let (one, two) = (first.renderer.context(), second.renderer.context());
    // images of both renderers in turn, with one, the other, or both contexts kept
    for kept in [vec![&one], vec![&two], vec![&one, &two], vec![&one, &two, &one]] {
        let mut draw = || {
            for _ in 0..3 {
                assert!(first.rgb(size) == expected[0] && second.rgb(size) == expected[1], "{}", kept.len());
            }
        };
        match kept[..] {
            [outer] => outer.keep_current(draw).unwrap(),
            [outer, inner] => outer.keep_current(|| inner.keep_current(draw).unwrap()).unwrap(),
            [outer, inner, innermost] => outer
                .keep_current(|| {
                    inner.keep_current(|| innermost.keep_current(&mut draw).unwrap()).unwrap();
                    draw();
                })
                .unwrap(),
            _ => unreachable!(),
        }
    }
    // a context in use on one thread is refused on another one
    one.keep_current(|| {
        let refused = std::thread::scope(|scope| scope.spawn(|| one.keep_current(|| ())).join().unwrap());
        assert!(refused.unwrap_err().to_string().contains("another thread"));
    })
    .unwrap();
    std::thread::scope(|scope| scope.spawn(|| one.keep_current(|| ())).join().unwrap()).unwrap();
    // a renderer may be dropped while its context is current, or another one
    one.keep_current(|| {
        drop(second);
        drop(first);
    })
    .unwrap();
    drop(two);
    // a panic ends the use of the context
    let panicked = std::panic::catch_unwind(|| one.keep_current(|| panic!("while a context is current")));
    assert!(panicked.is_err());
    one.keep_current(|| ()).unwrap();
}

#[test]
fn a_hidden_body_is_not_drawn_until_it_is_shown_again() {
    let Some(mut fixture) = fixture(ROOM, Quality::FAST) else { return };
    fixture.set_camera("ahead");
    let size = SIZES[0];
    let (ball, body): (GeomId, BodyId) =
        (fixture.data.model().find("ball").unwrap(), fixture.data.model().find("ball").unwrap());
    let ball = [5, ball.index() as i32];
    let before = fixture.segmentation(size);
    assert!(before.contains(&ball));
    fixture.scene.hide(Some(body));
    let hidden = fixture.segmentation(size);
    assert!(!hidden.contains(&ball));
    for (a, b) in before.iter().zip(&hidden) {
        assert!(a == b || *a == ball, "other pixels do not change");
    }
    fixture.scene.hide(None);
    assert_eq!(fixture.segmentation(size), before);
}

#[test]
fn decoration_is_visible_in_colour_but_has_no_object_id() {
    let Some(mut fixture) = fixture(ROOM, Quality::FAST) else { return };
    fixture.set_camera("ahead");
    let size = SIZES[0];
    let (before, objects) = (fixture.rgb(size), fixture.segmentation(size));
    let blue = [0.0, 0.0, 1.0, 1.0];
    assert!(fixture.scene.add(Decor::Sphere { centre: [0.0, -1.0, 0.5], radius: 0.1 }, blue));
    assert!(fixture.scene.add(Decor::Rod { from: [-0.5, -1.0, 0.7], to: [0.5, -1.0, 0.7], radius: 0.02 }, blue));
    assert!(fixture.scene.add(Decor::Arrow { from: [-0.5, -1.0, 0.3], to: [0.5, -1.0, 0.3], radius: 0.02 }, blue));
    let with = fixture.rgb(size);
    let middle = 3 * (24 * 64 + 32);
    assert!(with[middle + 2] > 100 && with[middle] < 60, "{:?}", &with[middle..middle + 3]);
    assert!(with != before);
    assert_eq!(fixture.segmentation(size), objects);
    // the colour of a line does not depend on the light
    let line = Decor::Line { from: [-0.5, -1.5, 0.5], to: [0.5, -1.5, 0.5], width: 7.0 };
    assert!(fixture.scene.add(line, [0.2, 0.8, 0.4, 1.0]));
    let with = fixture.rgb(size);
    let off = with[middle..middle + 3].iter().zip([51, 204, 102]).map(|(&got, wanted)| (i32::from(got) - wanted).abs());
    assert!(off.max().unwrap() < 4, "{:?}", &with[middle..middle + 3]);
    let room =
        (0..10_000).take_while(|_| fixture.scene.add(Decor::Sphere { centre: [0.0; 3], radius: 0.1 }, blue)).count();
    assert!((50..10_000).contains(&room), "room for {room} more");
    fixture.set_camera("ahead");
    assert_eq!(fixture.rgb(size), before);
}

/// Regression: lines were twice as bright with shadows as without.
#[test]
fn shadows_do_not_change_the_colour_of_lines() {
    for (shadows, quality) in [(false, Quality::PRETTY), (true, Quality::PRETTY), (true, Quality::FAST)] {
        let Some(mut fixture) = fixture(ROOM, quality) else { return };
        fixture.scene.set_effects(VisualEffects { shadows, ..VisualEffects::default() });
        fixture.set_camera("ahead");
        let line = Decor::Line { from: [-0.5, -1.5, 0.5], to: [0.5, -1.5, 0.5], width: 9.0 };
        assert!(fixture.scene.add(line, [0.2, 0.8, 0.4, 1.0]));
        let image = fixture.rgb(SIZES[0]);
        let seen = &image[3 * (24 * 64 + 32)..][..3];
        let off = seen.iter().zip([51, 204, 102]).map(|(&got, wanted)| (i32::from(got) - wanted).abs()).max();
        assert!(off.unwrap() < 6, "{shadows}: {seen:?}");
    }
}

#[test]
fn free_tracking_and_fixed_cameras_view_from_their_pose() {
    let Some(mut fixture) = fixture(ROOM, Quality::FAST) else { return };
    let size = SIZES[0];
    let (ball, geom): (BodyId, GeomId) =
        (fixture.data.model().find("ball").unwrap(), fixture.data.model().find("ball").unwrap());
    let middle = |fixture: &mut Fixture| fixture.segmentation(size)[24 * 64 + 32];
    let tracking = Camera::Tracking { body: ball, distance: 2.0, azimuth: 90.0, elevation: -20.0 };
    fixture.scene.update(&mut fixture.data, &tracking).unwrap();
    assert_eq!(middle(&mut fixture), [5, geom.index() as i32]);
    let free = Camera::Free { lookat: [0.0, 0.0, 0.5], distance: 1.0, azimuth: 90.0, elevation: 0.0 };
    fixture.scene.look(&mut fixture.data, &free).unwrap();
    let the_box: GeomId = fixture.data.model().find("box").unwrap();
    assert_eq!(middle(&mut fixture), [5, the_box.index() as i32]);
    let (x, y) = (size.width as usize / 2, size.height as usize / 2);
    assert!((fixture.depth(size)[y * 64 + x] - 1.0).abs() < 1e-3, "from (0, −1, 0.5) to the face at y = 0");
    for bad in [
        Camera::Free { lookat: [f64::NAN, 0.0, 0.0], distance: 1.0, azimuth: 0.0, elevation: 0.0 },
        Camera::Free { lookat: [0.0; 3], distance: 0.0, azimuth: 0.0, elevation: 0.0 },
        Camera::Free { lookat: [0.0; 3], distance: 1.0, azimuth: f64::INFINITY, elevation: 0.0 },
        Camera::Fixed(CameraId::new(9)),
        Camera::Tracking { body: BodyId::new(99), distance: 1.0, azimuth: 0.0, elevation: 0.0 },
    ] {
        assert!(fixture.scene.update(&mut fixture.data, &bad).is_err());
    }
}

#[test]
fn wrong_buffers_scenes_and_sizes_are_errors() {
    let Some(mut fixture) = fixture(ROOM, Quality::FAST) else { return };
    let size = SIZES[0];
    let mut rgb = vec![0; 3 * size.pixels()];
    let error = fixture.renderer.rgb(&mut fixture.scene, size, &mut rgb).unwrap_err();
    assert_eq!(error, Error::NoCamera);
    fixture.set_camera("ahead");
    let error = fixture.renderer.rgb(&mut fixture.scene, size, &mut rgb[1..]).unwrap_err();
    assert_eq!(error, Error::Buffer { what: "RGB", got: 9215, expected: 9216 });
    let vast = ImageSize { width: u32::MAX, height: u32::MAX };
    assert!(fixture.renderer.rgba(&mut fixture.scene, vast, &mut []).is_err());
    let none = ImageSize { width: 0, height: 48 };
    assert!(fixture.renderer.rgb(&mut fixture.scene, none, &mut []).unwrap_err().to_string().contains("0"));
    let huge = ImageSize { width: 1, height: 10_000 };
    assert!(fixture.renderer.depth(&mut fixture.scene, huge, &mut vec![0.0; 10_000]).is_err());
    let mut other = self::fixture(ROOM, Quality::PRETTY).unwrap();
    other.set_camera("ahead");
    assert_eq!(fixture.renderer.rgb(&mut other.scene, size, &mut rgb).unwrap_err(), Error::OtherModel);
    assert_eq!(other.scene.update(&mut fixture.data, &Camera::Fixed(CameraId::new(0))).unwrap_err(), Error::OtherModel);
    let mut objects = vec![[0; 2]; size.pixels()];
    assert_eq!(other.renderer.segmentation(&mut other.scene, size, &mut objects).unwrap_err(), Error::Multisampled);
    assert_eq!(fixture.rgb(size).len(), rgb.len(), "the renderer still works");
}

/// Regression: a side of 2^28 texels overwrote Mesa's stack.
#[test]
fn quality_settings_out_of_range_are_errors() {
    let Some(fixture) = fixture(ROOM, Quality::FAST) else { return };
    let model = fixture.data.shared_model();
    for quality in [
        Quality { shadow_map: 1 << 28, ..Quality::FAST },
        Quality { shadow_map: u32::MAX, ..Quality::PRETTY },
        Quality { shadow_map: Quality::MAX_SHADOW_MAP + 1, ..Quality::FAST },
        Quality { samples: Quality::MAX_SAMPLES + 1, ..Quality::PRETTY },
        Quality { samples: u32::MAX, ..Quality::FAST },
    ] {
        let error = Renderer::new(Arc::clone(&model), quality).unwrap_err();
        assert!(matches!(error, Error::Value { .. }), "{quality:?}: {error}");
    }
    // settings beyond the driver's limits are clamped
    let mut many = Renderer::new(Arc::clone(&model), Quality { samples: Quality::MAX_SAMPLES, shadow_map: 1 }).unwrap();
    let mut fixture = fixture;
    fixture.set_camera("ahead");
    let size = SIZES[0];
    many.rgb(&mut fixture.scene, size, &mut vec![0; 3 * size.pixels()]).unwrap();
    assert!(matches!(Scene::new(model, usize::MAX).unwrap_err(), Error::Value { .. }));
    for reach in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        assert!(matches!(many.set_shadow_reach(reach).unwrap_err(), Error::Value { .. }));
    }
}

/// Regression: the floor ended 50 m from the world's origin here (1 km in a simulation), and single precision made
/// depth ten times less accurate at 900 m.
#[test]
fn an_infinite_ground_looks_the_same_at_every_place() {
    let size = SIZES[1];
    let look = |x: f64, y: f64, z: f64, ground: bool| {
        let moves = [
            (r#"pos="0 0 1.3""#, [0.0, 0.0, 1.3]),
            (r#"pos="0 0.1 0.5""#, [0.0, 2.0, 0.5]),
            (r#"pos="0.8 1 0.3""#, [0.8, 1.0, 0.3]),
            (r#"pos="-0.9 0.7 0.4""#, [-0.9, 0.7, 0.4]),
        ];
        let room = moves.into_iter().fold(ROOM.to_string(), |room, (text, [dx, dy, dz])| {
            assert!(room.contains(text));
            room.replace(text, &format!(r#"pos="{} {} {}""#, x + dx, y + dy, z + dz))
        });
        let mut fixture =
            fixture(&room.replace(r#"type="plane""#, &format!(r#"type="plane" pos="0 0 {z}""#)), Quality::FAST)?;
        if ground {
            let floor = fixture.data.model().find::<GeomId>("floor").unwrap();
            fixture.scene.set_ground(Some(floor));
        }
        fixture.set_camera("down");
        let (at, rays) = fixture.rays("down", size);
        let (rgb, depth, objects) = (fixture.rgb(size), fixture.depth(size), fixture.segmentation(size));
        let floor = [5, fixture.data.model().find::<GeomId>("floor").unwrap().index() as i32];
        let mut worst: f64 = 0.0;
        for ((ray, z_seen), object) in rays.iter().zip(&depth).zip(&objects) {
            let distance = (z - at[2]) / ray[2];
            if *object == floor && distance < 4.0 {
                worst = worst.max((f64::from(*z_seen) - distance).abs());
            }
        }
        let count = objects.iter().filter(|object| **object == floor).count();
        Some((rgb, objects, count, worst))
    };
    let Some((rgb, objects, count, worst)) = look(0.0, 0.0, 0.0, true) else { return };
    assert!(count > 60_000 && worst < 3e-4, "{count} {worst}");
    let plain = look(0.0, 0.0, 0.0, false).unwrap();
    assert!(plain.0 == rgb && plain.1 == objects, "bit-identical near the origin");
    // the ground is lit at its vertices, which move by whole grid steps: between two steps its shading differs
    let grid = Scene::GRID;
    for place in [
        [7.0 * grid, 0.0, 0.0],
        [900.0, 0.0, 0.0],
        [-900.0, 900.0, 0.0],
        [40.0 * grid, -24.0 * grid, 0.0],
        [5000.0, 5000.0, 3000.0],
        [1e5, 0.0, 0.0],
    ] {
        let [x, y, z] = place;
        let there = look(x, y, z, true).unwrap();
        // positions are rounded to a quarter of a millimetre at 5 km, and to 4 mm at 100 km
        let rounding = 2e-7 * x.abs().max(z.abs());
        assert!(there.3 < 3e-4 + rounding, "{place:?}: {}", there.3);
        let other = objects.iter().zip(&there.1).filter(|(a, b)| a != b).count();
        assert!(other * 200 < objects.len(), "{place:?}: {other} pixels show another object");
        if place.iter().all(|at| at % grid == 0.0) {
            let darker = rgb.iter().zip(&there.0).filter(|(a, b)| a.abs_diff(**b) > 3).count();
            assert!(darker * 100 < rgb.len(), "{place:?}: {darker} values differ");
        }
    }
    assert!(look(5000.0, 0.0, 0.0, false).unwrap().2 == 0, "an ordinary plane is finite");
}

/// Shapes far from the origin are drawn at their exact position.
#[test]
fn decoration_far_from_the_origin_is_drawn_at_its_position() {
    let far = ROOM.replace(r#"pos="0 -2 0.5""#, r#"pos="4000 998 0.5""#);
    let Some(mut fixture) = fixture(&far, Quality::FAST) else { return };
    fixture.set_camera("ahead");
    let blue = [0.0, 0.0, 1.0, 1.0];
    assert!(fixture.scene.add(Decor::Sphere { centre: [4000.0, 999.0, 0.5], radius: 0.2 }, blue));
    assert!(fixture.scene.add(Decor::Rod { from: [3999.5, 999.0, 0.9], to: [4000.5, 999.0, 0.9], radius: 0.05 }, blue));
    let size = SIZES[0];
    let depth = fixture.depth(size);
    assert!((depth[24 * 64 + 32] - 0.8).abs() < 5e-3, "{}", depth[24 * 64 + 32]);
    assert!((depth[8 * 64 + 32] - 0.95).abs() < 5e-2, "{}", depth[8 * 64 + 32]);
}

/// Regression: every process that linked this crate, and its children, had the variable set, even without
/// rendering.
#[test]
fn the_rasterizer_starts_no_threads_and_the_environment_is_unchanged() {
    const CHILD: &str = "MUJOCO_RS_TEST_THREADS";
    if let Ok(expected) = std::env::var(CHILD) {
        let before: Vec<_> = std::env::vars_os().collect();
        let Some(mut fixture) = fixture(ROOM, Quality::FAST) else { return };
        fixture.set_camera("ahead");
        fixture.rgb(SIZES[0]);
        assert_eq!(std::env::vars_os().collect::<Vec<_>>(), before);
        let is_rasterizer = |id: &std::fs::DirEntry| {
            let name = std::fs::read_to_string(id.path().join("comm"));
            name.is_ok_and(|name| name.starts_with("llvmpipe"))
        };
        let count = std::fs::read_dir("/proc/self/task").unwrap().flatten().filter(is_rasterizer).count();
        let is_software = gl_info().unwrap().device.contains("llvmpipe");
        assert_eq!(count > 0, is_software && expected == "some", "{count} threads");
        return;
    }
    for (own, expected) in [(None, "none"), (Some("0"), "none"), (Some("2"), "some")] {
        let mut command = std::process::Command::new(std::env::current_exe().unwrap());
        command.args(["--exact", "the_rasterizer_starts_no_threads_and_the_environment_is_unchanged"]);
        command.env_remove("LP_NUM_THREADS").env(CHILD, expected);
        if let Some(own) = own {
            command.env("LP_NUM_THREADS", own);
        }
        assert!(command.status().unwrap().success(), "{own:?}");
    }
}

/// Generates finite, extreme and non-finite numbers.
fn any_number() -> impl Strategy<Value = f64> {
    prop_oneof![
        -10.0..10.0,
        prop::sample::select(vec![f64::NAN, f64::INFINITY, f64::NEG_INFINITY, f64::MAX, -1e38, 1e30, 1e-300, 0.0])
    ]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 40, ..ProptestConfig::default() })]

    /// Shapes with non-finite numbers do not crash the renderer and do not affect later images.
    #[test]
    fn shapes_of_any_numbers_can_be_drawn(
        numbers in prop::collection::vec(any_number(), 7),
        colour in any::<[f32; 4]>(),
    ) {
        let Some(mut fixture) = fixture(ROOM, Quality::FAST) else { return Ok(()) };
        fixture.set_camera("ahead");
        let before = fixture.segmentation(SIZES[0]);
        let (a, b, size) = ([numbers[0], numbers[1], numbers[2]], [numbers[3], numbers[4], numbers[5]], numbers[6]);
        fixture.scene.add(Decor::Sphere { centre: a, radius: size }, colour);
        fixture.scene.add(Decor::Rod { from: a, to: b, radius: size }, colour);
        fixture.scene.add(Decor::Line { from: a, to: b, width: size }, colour);
        fixture.scene.add(Decor::Arrow { from: a, to: b, radius: size }, colour);
        fixture.rgb(SIZES[0]);
        let camera = Camera::Free { lookat: a, distance: size, azimuth: b[0], elevation: b[1] };
        if fixture.scene.look(&mut fixture.data, &camera).is_ok() {
            fixture.rgb(SIZES[0]);
        }
        fixture.set_camera("ahead");
        prop_assert!(fixture.segmentation(SIZES[0]) == before);
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 40, ..ProptestConfig::default() })]

    /// Images of any size can be rendered in any order.
    #[test]
    fn the_buffer_grows_to_any_size(sizes in prop::collection::vec((1u32..400, 1u32..400), 1..5)) {
        let Some(mut fixture) = fixture(ROOM, Quality::FAST) else { return Ok(()) };
        fixture.set_camera("down");
        for (width, height) in sizes {
            let size = ImageSize { width, height };
            let objects = fixture.segmentation(size);
            let below = objects[((height - 1) * width + width / 2) as usize];
            prop_assert!(below[0] == 5, "the floor fills the middle of the lower edge: {below:?}");
        }
    }
}

/// Renders with each backend in a child process and compares the images.
#[test]
fn both_backends_render_the_same_within_the_rasterizers_tolerance() {
    const CHILD: &str = "MUJOCO_RS_TEST_IMAGE";
    let size = SIZES[1];
    if let Some(path) = std::env::var_os(CHILD) {
        gl_info().unwrap();
        let mut fixture = fixture(ROOM, Quality::FAST).unwrap();
        fixture.set_camera("ahead");
        let mut bytes = fixture.rgb(size);
        bytes.extend(fixture.segmentation(size).iter().map(|object| object[1] as u8));
        bytes.extend(fixture.depth(size).iter().flat_map(|z| z.to_le_bytes()));
        std::fs::write(path, bytes).unwrap();
        return;
    }
    let images: Vec<Vec<u8>> = GlBackend::ALL
        .into_iter()
        .filter_map(|backend| {
            let path = std::env::temp_dir().join(format!("mujoco-rs-image-{}-{backend}", std::process::id()));
            let output = std::process::Command::new(std::env::current_exe().unwrap())
                .args(["--exact", "both_backends_render_the_same_within_the_rasterizers_tolerance", "--nocapture"])
                .env(CHILD, &path)
                .env("MUJOCO_GL", backend.name())
                .output()
                .unwrap();
            let image = std::fs::read(&path).ok();
            let _ = std::fs::remove_file(&path);
            // a missing library renders nothing; an installed one must not fail
            let text = String::from_utf8_lossy(&output.stderr);
            assert!(image.is_some() || text.contains("NoGl"), "{backend}: {text}");
            image
        })
        .collect();
    let [a, b] = &images[..] else { return };
    let pixels = size.pixels();
    let differing = |range: std::ops::Range<usize>, tolerance: u8| {
        a[range.clone()].iter().zip(&b[range]).filter(|(a, b)| a.abs_diff(**b) > tolerance).count()
    };
    assert!(differing(0..3 * pixels, 2) * 1000 < 3 * pixels, "colours");
    assert!(differing(3 * pixels..4 * pixels, 0) * 1000 < pixels, "objects");
    let depth = |bytes: &[u8]| -> Vec<f32> {
        bytes[4 * pixels..].chunks(4).map(|z| f32::from_le_bytes(z.try_into().unwrap())).collect()
    };
    let far = depth(a).iter().zip(&depth(b)).filter(|(a, b)| (**a - **b).abs() > 1e-3 * a.max(1.0)).count();
    assert!(far * 1000 < pixels, "depth: {far}");
}
