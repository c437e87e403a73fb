//! Pictures against closed forms and rays. Without a GL library every test here says so and passes: the program must
//! work without one, and `.ci/run` installs one.

use std::sync::Arc;

use mujoco_rs::{
    BodyId, Camera, CameraId, Data, Decor, Error, GeomId, GlBackend, ImageSize, Model, ObjectId as _, Quality,
    Renderer, Scene, VisualEffects, gl_info,
};
use proptest::prelude::*;

/// A floor seen from 1.3 m, 35° downwards, with things standing on it.
const ROOM: &str = r#"<mujoco><compiler angle="degree"/>
  <visual><map znear="0.01" zfar="100"/></visual>
  <asset><texture type="skybox" builtin="gradient" rgb1="1 1 1" rgb2="0 0 1" width="32" height="192"/></asset><statistic extent="1" center="0 0 0"/>
  <worldbody>
    <light directional="true" dir="0.3 0.2 -1" pos="0 0 4"/>
    <geom name="floor" type="plane" size="50 50 100" rgba=".5 .6 .7 1"/>
    <camera name="down" pos="0 0 1.3" euler="55 0 0" fovy="50"/>
    <camera name="ahead" pos="0 -2 0.5" euler="90 0 0" fovy="60"/>
    <body name="box" pos="0 0.1 0.5"><geom name="box" type="box" size=".3 .1 .2" rgba="1 0 0 1"/></body>
    <body name="ball" pos="0.8 1 0.3"><freejoint/><geom name="ball" type="sphere" size=".3" rgba="0 1 0 1"/></body>
    <body name="rod" pos="-0.9 0.7 0.4"><geom name="rod" type="capsule" size=".1 .3" euler="30 40 0"/></body>
  </worldbody></mujoco>"#;

struct Studio {
    data: Data,
    scene: Scene,
    renderer: Renderer,
}

/// `None` where there is no OpenGL to draw with.
fn studio(xml: &str, quality: Quality) -> Option<Studio> {
    if matches!(gl_info(), Err(Error::NoGl { .. })) {
        return None;
    }
    let mut data = Data::new(Model::from_xml(xml).unwrap()).unwrap();
    data.forward().unwrap();
    let model = data.shared_model();
    let mut scene = Scene::new(Arc::clone(&model), 100).unwrap();
    scene.set_effects(VisualEffects::default());
    Some(Studio { data, scene, renderer: Renderer::new(model, quality).unwrap() })
}

impl Studio {
    fn see(&mut self, camera: &str) -> Camera {
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

    /// The camera's place and, for every pixel's middle, the direction whose part along the camera's axis is one.
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
fn the_depth_of_a_floor_is_the_rays_closed_form_to_a_millimetre_at_every_pixel() {
    // without the things on it: a floor alone
    let alone = ROOM.split("<body").next().unwrap().to_string() + "</worldbody></mujoco>";
    let Some(mut studio) = studio(&alone, Quality::FAST) else { return };
    studio.see("down");
    for size in SIZES {
        let depth = studio.depth(size);
        let (at, rays) = studio.rays("down", size);
        let mut seen = 0;
        for (z, ray) in depth.iter().zip(&rays) {
            let distance = -at[2] / ray[2];
            if ray[2] < 0.0 && distance < 12.0 {
                assert!((f64::from(*z) - distance).abs() < 1e-3, "{z} {distance}");
                seen += 1;
            }
        }
        assert!(seen * 10 > 9 * size.pixels(), "the floor fills the picture: {seen} of {}", size.pixels());
    }
}

#[test]
fn the_depth_of_a_box_face_is_its_distance_and_of_nothing_the_far_plane() {
    let Some(mut studio) = studio(ROOM, Quality::FAST) else { return };
    studio.see("ahead");
    for size in SIZES {
        let depth = studio.depth(size);
        let objects = studio.segmentation(size);
        let the_box: GeomId = studio.data.model().find("box").unwrap();
        let mut seen = 0;
        for (z, object) in depth.iter().zip(&objects) {
            if *object == [5, the_box.index() as i32] {
                // the face at y = 0 stands square to the camera at y = −2; grazing pixels show the top
                assert!((f64::from(*z) - 2.0).abs() < 1e-3, "{z}");
                seen += 1;
            } else if *object == [-1, -1] {
                assert!((z - 100.0).abs() < 0.01, "{z}");
            }
        }
        assert!(seen > 20);
        // a sky and whatever else is drawn for people change nothing of it
        studio.scene.set_effects(VisualEffects::pretty());
        assert!(studio.depth(size) == depth);
        studio.scene.set_effects(VisualEffects::default());
        assert_eq!(studio.scene.clip_planes().map(|x| (x * 1e4).round() / 1e4), [0.01, 100.0]);
    }
}

#[test]
fn segmentation_names_what_rays_hit() {
    let Some(mut studio) = studio(ROOM, Quality::FAST) else { return };
    for camera in ["down", "ahead"] {
        studio.see(camera);
        for size in SIZES {
            let objects = studio.segmentation(size);
            let (at, rays) = studio.rays(camera, size);
            let agree = (objects.iter().zip(&rays))
                .filter(|(object, ray)| {
                    let hit = studio.data.ray(at, **ray, [true; 6], None).unwrap();
                    let wanted = hit.filter(|(_, t)| *t < 100.0).map_or([-1, -1], |(geom, _)| [5, geom.index() as i32]);
                    **object == wanted
                })
                .count();
            let share = agree as f64 / size.pixels() as f64;
            assert!(share >= 0.99, "{camera} {size}: {share}");
            for name in ["box", "ball", "floor"] {
                let geom: GeomId = studio.data.model().find(name).unwrap();
                assert!(camera == "down" || objects.contains(&[5, geom.index() as i32]), "{name} in {camera}");
            }
        }
    }
}

#[test]
fn the_first_row_is_the_top_and_the_first_column_the_left() {
    let Some(mut studio) = studio(ROOM, Quality::FAST) else { return };
    studio.see("ahead");
    let size = SIZES[1];
    let rgb = studio.rgb(size);
    let at = |x: usize, y: usize| -> [u8; 3] { rgb[3 * (y * 320 + x)..][..3].try_into().unwrap() };
    assert_eq!(at(160, 5), [0, 0, 0], "above there is nothing");
    let floor = at(160, 230);
    assert!(floor[2] > floor[0] && floor[0] > 0, "below there is the blue floor: {floor:?}");
    let middle = at(160, 120);
    assert!(middle[0] / 2 > middle[1], "the red box in the middle: {middle:?}");
    let green = |x: usize| (0..240).any(|y| at(x, y)[1] / 2 > at(x, y)[0].max(at(x, y)[2]).max(20));
    assert!((200..320).any(green) && !(0..120).any(green), "the green ball on the right");

    let mut rgba = vec![7; 4 * size.pixels()];
    studio.renderer.rgba(&mut studio.scene, size, &mut rgba).unwrap();
    for (a, b) in rgba.chunks(4).zip(rgb.chunks(3)) {
        assert_eq!((&a[..3], a[3]), (b, 255));
    }
}

#[test]
fn the_same_state_gives_the_same_bytes_again_and_in_another_context_and_thread() {
    let Some(mut first) = studio(ROOM, Quality::FAST) else { return };
    first.see("ahead");
    let size = SIZES[1];
    let (rgb, depth, objects) = (first.rgb(size), first.depth(size), first.segmentation(size));
    let small = first.rgb(SIZES[0]);
    assert_eq!((first.rgb(size), first.segmentation(size)), (rgb.clone(), objects.clone()));
    std::thread::scope(|scope| {
        for _ in 0..3 {
            scope.spawn(|| {
                let mut other = studio(ROOM, Quality::FAST).unwrap();
                other.see("ahead");
                assert_eq!(other.rgb(SIZES[0]), small, "before the buffer has grown");
                assert!(other.rgb(size) == rgb && other.segmentation(size) == objects);
                assert!(other.depth(size).iter().zip(&depth).all(|(a, b)| a.to_bits() == b.to_bits()));
            });
        }
    });
    // made here, used there, dropped elsewhere
    let moved = std::thread::spawn(move || {
        assert!(first.rgb(size) == rgb);
        first
    });
    let first = moved.join().unwrap();
    std::thread::spawn(move || drop(first)).join().unwrap();
}

#[test]
fn a_hidden_body_is_not_drawn_and_comes_back() {
    let Some(mut studio) = studio(ROOM, Quality::FAST) else { return };
    studio.see("ahead");
    let size = SIZES[0];
    let (ball, body): (GeomId, BodyId) =
        (studio.data.model().find("ball").unwrap(), studio.data.model().find("ball").unwrap());
    let ball = [5, ball.index() as i32];
    let before = studio.segmentation(size);
    assert!(before.contains(&ball));
    studio.scene.hide(Some(body));
    let hidden = studio.segmentation(size);
    assert!(!hidden.contains(&ball));
    for (a, b) in before.iter().zip(&hidden) {
        assert!(a == b || *a == ball, "everything else stays as it was");
    }
    studio.scene.hide(None);
    assert_eq!(studio.segmentation(size), before);
}

#[test]
fn decoration_is_seen_in_colour_but_is_no_object() {
    let Some(mut studio) = studio(ROOM, Quality::FAST) else { return };
    studio.see("ahead");
    let size = SIZES[0];
    let (before, objects) = (studio.rgb(size), studio.segmentation(size));
    let blue = [0.0, 0.0, 1.0, 1.0];
    assert!(studio.scene.add(Decor::Sphere { centre: [0.0, -1.0, 0.5], radius: 0.1 }, blue));
    assert!(studio.scene.add(Decor::Rod { from: [-0.5, -1.0, 0.7], to: [0.5, -1.0, 0.7], radius: 0.02 }, blue));
    assert!(studio.scene.add(Decor::Arrow { from: [-0.5, -1.0, 0.3], to: [0.5, -1.0, 0.3], radius: 0.02 }, blue));
    let with = studio.rgb(size);
    let middle = 3 * (24 * 64 + 32);
    assert!(with[middle + 2] > 100 && with[middle] < 60, "{:?}", &with[middle..middle + 3]);
    assert!(with != before);
    assert_eq!(studio.segmentation(size), objects);
    // a line has its colour, whatever the light
    let line = Decor::Line { from: [-0.5, -1.5, 0.5], to: [0.5, -1.5, 0.5], width: 7.0 };
    assert!(studio.scene.add(line, [0.2, 0.8, 0.4, 1.0]));
    let with = studio.rgb(size);
    let off = with[middle..middle + 3].iter().zip([51, 204, 102]).map(|(&got, wanted)| (i32::from(got) - wanted).abs());
    assert!(off.max().unwrap() < 4, "{:?}", &with[middle..middle + 3]);
    let room =
        (0..10_000).take_while(|_| studio.scene.add(Decor::Sphere { centre: [0.0; 3], radius: 0.1 }, blue)).count();
    assert!((50..10_000).contains(&room), "room for {room} more, and no more");
    studio.see("ahead");
    assert_eq!(studio.rgb(size), before);
}

/// They were twice as bright with shadows as without.
#[test]
fn a_line_has_its_colour_with_shadows_too() {
    for (shadows, quality) in [(false, Quality::PRETTY), (true, Quality::PRETTY), (true, Quality::FAST)] {
        let Some(mut studio) = studio(ROOM, quality) else { return };
        studio.scene.set_effects(VisualEffects { shadows, ..VisualEffects::default() });
        studio.see("ahead");
        let line = Decor::Line { from: [-0.5, -1.5, 0.5], to: [0.5, -1.5, 0.5], width: 9.0 };
        assert!(studio.scene.add(line, [0.2, 0.8, 0.4, 1.0]));
        let picture = studio.rgb(SIZES[0]);
        let seen = &picture[3 * (24 * 64 + 32)..][..3];
        let off = seen.iter().zip([51, 204, 102]).map(|(&got, wanted)| (i32::from(got) - wanted).abs()).max();
        assert!(off.unwrap() < 6, "{shadows}: {seen:?}");
    }
}

#[test]
fn cameras_free_tracking_and_fixed_see_from_where_they_are() {
    let Some(mut studio) = studio(ROOM, Quality::FAST) else { return };
    let size = SIZES[0];
    let (ball, geom): (BodyId, GeomId) =
        (studio.data.model().find("ball").unwrap(), studio.data.model().find("ball").unwrap());
    let middle = |studio: &mut Studio| studio.segmentation(size)[24 * 64 + 32];
    let tracking = Camera::Tracking { body: ball, distance: 2.0, azimuth: 90.0, elevation: -20.0 };
    studio.scene.update(&mut studio.data, &tracking).unwrap();
    assert_eq!(middle(&mut studio), [5, geom.index() as i32]);
    let free = Camera::Free { lookat: [0.0, 0.0, 0.5], distance: 1.0, azimuth: 90.0, elevation: 0.0 };
    studio.scene.look(&mut studio.data, &free).unwrap();
    let the_box: GeomId = studio.data.model().find("box").unwrap();
    assert_eq!(middle(&mut studio), [5, the_box.index() as i32]);
    let (x, y) = (size.width as usize / 2, size.height as usize / 2);
    assert!((studio.depth(size)[y * 64 + x] - 1.0).abs() < 1e-3, "from (0, −1, 0.5) to the face at y = 0");
    for bad in [
        Camera::Free { lookat: [f64::NAN, 0.0, 0.0], distance: 1.0, azimuth: 0.0, elevation: 0.0 },
        Camera::Free { lookat: [0.0; 3], distance: 0.0, azimuth: 0.0, elevation: 0.0 },
        Camera::Free { lookat: [0.0; 3], distance: 1.0, azimuth: f64::INFINITY, elevation: 0.0 },
        Camera::Fixed(CameraId::new(9)),
        Camera::Tracking { body: BodyId::new(99), distance: 1.0, azimuth: 0.0, elevation: 0.0 },
    ] {
        assert!(studio.scene.update(&mut studio.data, &bad).is_err());
    }
}

#[test]
fn wrong_buffers_scenes_and_sizes_are_errors() {
    let Some(mut studio) = studio(ROOM, Quality::FAST) else { return };
    let size = SIZES[0];
    let mut rgb = vec![0; 3 * size.pixels()];
    let error = studio.renderer.rgb(&mut studio.scene, size, &mut rgb).unwrap_err();
    assert_eq!(error, Error::NoCamera);
    studio.see("ahead");
    let error = studio.renderer.rgb(&mut studio.scene, size, &mut rgb[1..]).unwrap_err();
    assert_eq!(error, Error::Buffer { what: "RGB", got: 9215, expected: 9216 });
    let vast = ImageSize { width: u32::MAX, height: u32::MAX };
    assert!(studio.renderer.rgba(&mut studio.scene, vast, &mut []).is_err());
    let none = ImageSize { width: 0, height: 48 };
    assert!(studio.renderer.rgb(&mut studio.scene, none, &mut []).unwrap_err().to_string().contains("0"));
    let huge = ImageSize { width: 1, height: 10_000 };
    assert!(studio.renderer.depth(&mut studio.scene, huge, &mut vec![0.0; 10_000]).is_err());
    let mut other = self::studio(ROOM, Quality::PRETTY).unwrap();
    other.see("ahead");
    assert_eq!(studio.renderer.rgb(&mut other.scene, size, &mut rgb).unwrap_err(), Error::OtherModel);
    assert_eq!(other.scene.update(&mut studio.data, &Camera::Fixed(CameraId::new(0))).unwrap_err(), Error::OtherModel);
    let mut objects = vec![[0; 2]; size.pixels()];
    assert_eq!(other.renderer.segmentation(&mut other.scene, size, &mut objects).unwrap_err(), Error::Multisampled);
    assert_eq!(studio.rgb(size).len(), rgb.len(), "and everything still works");
}

/// A side of 2^28 texels overwrote Mesa's stack.
#[test]
fn a_quality_beyond_its_limits_is_an_error() {
    let Some(studio) = studio(ROOM, Quality::FAST) else { return };
    let model = studio.data.shared_model();
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
    // what a driver cannot do is less, not nothing
    let mut many = Renderer::new(Arc::clone(&model), Quality { samples: Quality::MAX_SAMPLES, shadow_map: 1 }).unwrap();
    let mut studio = studio;
    studio.see("ahead");
    let size = SIZES[0];
    many.rgb(&mut studio.scene, size, &mut vec![0; 3 * size.pixels()]).unwrap();
    assert!(matches!(Scene::new(model, usize::MAX).unwrap_err(), Error::Value { .. }));
    for reach in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        assert!(matches!(many.set_shadow_reach(reach).unwrap_err(), Error::Value { .. }));
    }
}

/// The floor ended 50 m from the world's origin here (1 km in a simulation), and single precision made depth ten times worse at
/// 900 m.
#[test]
fn a_ground_without_end_is_seen_the_same_at_every_place() {
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
        let mut studio =
            studio(&room.replace(r#"type="plane""#, &format!(r#"type="plane" pos="0 0 {z}""#)), Quality::FAST)?;
        if ground {
            let floor = studio.data.model().find::<GeomId>("floor").unwrap();
            studio.scene.set_ground(Some(floor));
        }
        studio.see("down");
        let (at, rays) = studio.rays("down", size);
        let (rgb, depth, objects) = (studio.rgb(size), studio.depth(size), studio.segmentation(size));
        let floor = [5, studio.data.model().find::<GeomId>("floor").unwrap().index() as i32];
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
    assert!(plain.0 == rgb && plain.1 == objects, "the same bits near the origin");
    // the ground is lit at its corners, which move by whole steps of the grid: between two steps its shade differs
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
        // positions themselves are rounded to a quarter of a millimetre at 5 km, to 4 mm at 100 km
        let rounding = 2e-7 * x.abs().max(z.abs());
        assert!(there.3 < 3e-4 + rounding, "{place:?}: {}", there.3);
        let other = objects.iter().zip(&there.1).filter(|(a, b)| a != b).count();
        assert!(other * 200 < objects.len(), "{place:?}: {other} pixels show another object");
        if place.iter().all(|at| at % grid == 0.0) {
            let darker = rgb.iter().zip(&there.0).filter(|(a, b)| a.abs_diff(**b) > 3).count();
            assert!(darker * 100 < rgb.len(), "{place:?}: {darker} values differ");
        }
    }
    assert!(look(5000.0, 0.0, 0.0, false).unwrap().2 == 0, "an ordinary plane ends");
}

/// What is added far away is drawn where it was put.
#[test]
fn decoration_far_from_the_origin_is_where_it_belongs() {
    let far = ROOM.replace(r#"pos="0 -2 0.5""#, r#"pos="4000 998 0.5""#);
    let Some(mut studio) = studio(&far, Quality::FAST) else { return };
    studio.see("ahead");
    let blue = [0.0, 0.0, 1.0, 1.0];
    assert!(studio.scene.add(Decor::Sphere { centre: [4000.0, 999.0, 0.5], radius: 0.2 }, blue));
    assert!(studio.scene.add(Decor::Rod { from: [3999.5, 999.0, 0.9], to: [4000.5, 999.0, 0.9], radius: 0.05 }, blue));
    let size = SIZES[0];
    let depth = studio.depth(size);
    assert!((depth[24 * 64 + 32] - 0.8).abs() < 5e-3, "{}", depth[24 * 64 + 32]);
    assert!((depth[8 * 64 + 32] - 0.95).abs() < 5e-2, "{}", depth[8 * 64 + 32]);
}

/// The variable was set in every process that linked this crate, also in those that never draw, and in their children.
#[test]
fn the_rasteriser_has_no_threads_and_the_environment_stays_as_it_was() {
    const CHILD: &str = "MUJOCO_RS_TEST_THREADS";
    if let Ok(expected) = std::env::var(CHILD) {
        let before: Vec<_> = std::env::vars_os().collect();
        let Some(mut studio) = studio(ROOM, Quality::FAST) else { return };
        studio.see("ahead");
        studio.rgb(SIZES[0]);
        assert_eq!(std::env::vars_os().collect::<Vec<_>>(), before);
        let is_rasteriser = |id: &std::fs::DirEntry| {
            let name = std::fs::read_to_string(id.path().join("comm"));
            name.is_ok_and(|name| name.starts_with("llvmpipe"))
        };
        let count = std::fs::read_dir("/proc/self/task").unwrap().flatten().filter(is_rasteriser).count();
        let is_software = gl_info().unwrap().device.contains("llvmpipe");
        assert_eq!(count > 0, is_software && expected == "some", "{count} threads");
        return;
    }
    for (own, expected) in [(None, "none"), (Some("0"), "none"), (Some("2"), "some")] {
        let mut command = std::process::Command::new(std::env::current_exe().unwrap());
        command.args(["--exact", "the_rasteriser_has_no_threads_and_the_environment_stays_as_it_was"]);
        command.env_remove("LP_NUM_THREADS").env(CHILD, expected);
        if let Some(own) = own {
            command.env("LP_NUM_THREADS", own);
        }
        assert!(command.status().unwrap().success(), "{own:?}");
    }
}

/// One number of every kind there is.
fn any_number() -> impl Strategy<Value = f64> {
    prop_oneof![
        -10.0..10.0,
        prop::sample::select(vec![f64::NAN, f64::INFINITY, f64::NEG_INFINITY, f64::MAX, -1e38, 1e30, 1e-300, 0.0])
    ]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 40, ..ProptestConfig::default() })]

    /// Shapes with numbers that are none draw something or nothing, and leave the rest alone.
    #[test]
    fn shapes_of_any_numbers_can_be_drawn(numbers in prop::collection::vec(any_number(), 7), colour in any::<[f32; 4]>()) {
        let Some(mut studio) = studio(ROOM, Quality::FAST) else { return Ok(()) };
        studio.see("ahead");
        let before = studio.segmentation(SIZES[0]);
        let (a, b, size) = ([numbers[0], numbers[1], numbers[2]], [numbers[3], numbers[4], numbers[5]], numbers[6]);
        studio.scene.add(Decor::Sphere { centre: a, radius: size }, colour);
        studio.scene.add(Decor::Rod { from: a, to: b, radius: size }, colour);
        studio.scene.add(Decor::Line { from: a, to: b, width: size }, colour);
        studio.scene.add(Decor::Arrow { from: a, to: b, radius: size }, colour);
        studio.rgb(SIZES[0]);
        let camera = Camera::Free { lookat: a, distance: size, azimuth: b[0], elevation: b[1] };
        if studio.scene.look(&mut studio.data, &camera).is_ok() {
            studio.rgb(SIZES[0]);
        }
        studio.see("ahead");
        prop_assert!(studio.segmentation(SIZES[0]) == before);
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 40, ..ProptestConfig::default() })]

    /// Any size, in any order, draws a picture of that size.
    #[test]
    fn the_buffer_grows_to_any_size(sizes in prop::collection::vec((1u32..400, 1u32..400), 1..5)) {
        let Some(mut studio) = studio(ROOM, Quality::FAST) else { return Ok(()) };
        studio.see("down");
        for (width, height) in sizes {
            let size = ImageSize { width, height };
            let objects = studio.segmentation(size);
            let below = objects[((height - 1) * width + width / 2) as usize];
            prop_assert!(below[0] == 5, "the floor fills the lower edge's middle: {below:?}");
        }
    }
}

/// Draws with the other backend in a child process and compares.
#[test]
fn both_backends_draw_the_same_within_the_rasterisers_tolerance() {
    const CHILD: &str = "MUJOCO_RS_TEST_PICTURE";
    let size = SIZES[1];
    if let Some(path) = std::env::var_os(CHILD) {
        gl_info().unwrap();
        let mut studio = studio(ROOM, Quality::FAST).unwrap();
        studio.see("ahead");
        let mut bytes = studio.rgb(size);
        bytes.extend(studio.segmentation(size).iter().map(|object| object[1] as u8));
        bytes.extend(studio.depth(size).iter().flat_map(|z| z.to_le_bytes()));
        std::fs::write(path, bytes).unwrap();
        return;
    }
    let pictures: Vec<Vec<u8>> = GlBackend::ALL
        .into_iter()
        .filter_map(|backend| {
            let path = std::env::temp_dir().join(format!("mujoco-rs-picture-{}-{backend}", std::process::id()));
            let output = std::process::Command::new(std::env::current_exe().unwrap())
                .args(["--exact", "both_backends_draw_the_same_within_the_rasterisers_tolerance", "--nocapture"])
                .env(CHILD, &path)
                .env("MUJOCO_GL", backend.name())
                .output()
                .unwrap();
            let picture = std::fs::read(&path).ok();
            let _ = std::fs::remove_file(&path);
            // a library that is not installed draws nothing; one that is must not fail
            let text = String::from_utf8_lossy(&output.stderr);
            assert!(picture.is_some() || text.contains("NoGl"), "{backend}: {text}");
            picture
        })
        .collect();
    let [a, b] = &pictures[..] else { return };
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

/// What a machine without any GL library answers: each way that was tried, and the package to install.
#[test]
fn an_unknown_backend_is_refused_by_name() {
    const CHILD: &str = "MUJOCO_RS_TEST_BACKEND";
    if std::env::var_os(CHILD).is_some() {
        let error = gl_info().unwrap_err();
        assert_eq!(error, Error::GlName { got: "glfw".into() });
        assert!(error.to_string().contains("egl or osmesa"));
        return;
    }
    let status = std::process::Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "an_unknown_backend_is_refused_by_name"])
        .env(CHILD, "1")
        .env("MUJOCO_GL", "glfw")
        .status()
        .unwrap();
    assert!(status.success());
}
