//! Property tests of MuJoCo's memory safety: arbitrary inputs are errors, or give a step and rays without invalid
//! accesses.
//!
//! A crash ends the process. AddressSanitizer (`.ci/asan`) finds invalid accesses that do not crash.
//! `PROPTEST_CASES` sets the number of cases.

use std::fmt::Write as _;

use mujoco_rs::{Camera, CameraId, Data, Error, GeomId, Model, ObjectId, Scene};
use proptest::prelude::*;
use proptest::test_runner::RngSeed;

/// Generates lengths, coordinates and quaternion components, including invalid ones.
fn number() -> impl Strategy<Value = f64> {
    prop_oneof![
        4 => -2.0..2.0_f64,
        4 => (-3.0..3.0_f64).prop_map(|power| 10_f64.powf(power)),
        2 => (-16.0..11.0_f64).prop_map(|power| 10_f64.powf(power)),
        1 => prop::sample::select(vec![
            0.0, -0.0, 1.0, -1.0, 0.1, 1e-320, 1e-200, 1e-15, 1e10, -1e10, 1e15, 1e200, f64::MAX, f64::NAN,
            f64::INFINITY, f64::NEG_INFINITY,
        ]),
    ]
}

/// Generates lengths, most of them valid.
fn length() -> impl Strategy<Value = f64> {
    prop_oneof![
        8 => (-2.0..1.0_f64).prop_map(|power| 10_f64.powf(power)),
        4 => (-15.0..6.0_f64).prop_map(|power| 10_f64.powf(power)),
        1 => prop::sample::select(vec![1e-15, 1e6, 1.0]),
        1 => number(),
    ]
}

/// Generates coordinates, most of them close to the other geom.
fn coordinate() -> impl Strategy<Value = f64> {
    prop_oneof![
        6 => -1.5..1.5_f64,
        4 => prop::sample::select(vec![0.0, 0.1, -0.1, 0.2, 1.0, -1.0, 1e-15, -1e-12, 1e-8]),
        1 => (-9.0..10.0_f64).prop_map(|power| 10_f64.powf(power)),
        1 => number(),
    ]
}

fn quaternion() -> impl Strategy<Value = [f64; 4]> {
    prop_oneof![
        3 => Just([1.0, 0.0, 0.0, 0.0]),
        1 => Just([0.5_f64.sqrt(), 0.5_f64.sqrt(), 0.0, 0.0]),
        6 => prop::array::uniform4(-1.0..1.0_f64).prop_map(|q| {
            let length = q.iter().map(|x| x * x).sum::<f64>().sqrt();
            q.map(|x| x / length)
        }),
        1 => prop::array::uniform4(number()),
    ]
}

/// Geom types; planes and height fields, which must be static, come first.
const TYPES: [&str; 8] = ["plane", "hfield", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh"];

#[derive(Debug, Clone)]
struct Shape {
    kind: usize,
    size: [f64; 3],
    position: [f64; 3],
    quaternion: [f64; 4],
}

fn shape(kinds: std::ops::Range<usize>) -> impl Strategy<Value = Shape> {
    (kinds, prop::array::uniform3(length()), prop::array::uniform3(coordinate()), quaternion())
        .prop_map(|(kind, size, position, quaternion)| Shape { kind, size, position, quaternion })
}

#[derive(Debug, Clone)]
struct Pair {
    shapes: [Shape; 2],
    margin: f64,
    field: [f64; 4],
    grid: [usize; 2],
    multiccd: bool,
    eye: [f64; 3],
    direction: [f64; 3],
}

fn pair() -> impl Strategy<Value = Pair> {
    let field = prop::array::uniform4(length());
    let grid = prop_oneof![4 => prop::array::uniform2(2..9_usize), 1 => prop::array::uniform2(0..12_usize)];
    let margin = prop_oneof![4 => Just(0.0), 2 => length()];
    (
        [shape(0..TYPES.len()), shape(2..TYPES.len())],
        margin,
        field,
        grid,
        any::<bool>(),
        prop::array::uniform3(coordinate()),
        prop::array::uniform3(coordinate()),
    )
        .prop_map(|(shapes, margin, field, grid, multiccd, eye, direction)| Pair {
            shapes,
            margin,
            field,
            grid,
            multiccd,
            eye,
            direction,
        })
}

fn words(numbers: &[f64]) -> String {
    let mut text = String::new();
    for number in numbers {
        _ = write!(text, "{number} ");
    }
    text
}

/// Returns the text of a scene with both shapes: the first static, the second on a free body.
fn text(pair: &Pair, plain: bool) -> String {
    let geom = |shape: &Shape| {
        let kind = TYPES[shape.kind];
        let asset = match kind {
            "hfield" => "hfield='field'",
            "mesh" => "mesh='corner'",
            _ => "",
        };
        let (size, position, quaternion) = match plain {
            true => (words(&[0.1, 0.1, 0.1]), words(&[0.0; 3]), words(&[1.0, 0.0, 0.0, 0.0])),
            false => (words(&shape.size), words(&shape.position), words(&shape.quaternion)),
        };
        format!(
            "<geom type='{kind}' {asset} size='{size}' pos='{position}' quat='{quaternion}' margin='{}' mass='1'/>",
            if plain { 0.0 } else { pair.margin }
        )
    };
    let field = if plain { [1.0, 1.0, 0.3, 0.1] } else { pair.field };
    let [first, second] = [geom(&pair.shapes[0]), geom(&pair.shapes[1])];
    format!(
        "<mujoco><option><flag multiccd='{}'/></option><size njmax='500' nconmax='100'/>
        <asset><mesh name='corner' vertex='0 0 0 .2 0 0 0 .3 0 0 0 .4 .1 .1 .1'/>
        <hfield name='field' nrow='{}' ncol='{}' size='{}'/></asset>
        <worldbody>{first}<body><freejoint/><inertial mass='1' pos='0 0 0' diaginertia='.1 .1 .1'/>{second}</body>
        </worldbody></mujoco>",
        if pair.multiccd { "enable" } else { "disable" },
        pair.grid[0],
        pair.grid[1],
        words(&field),
    )
}

/// Runs a forward pass, rays and steps, and ignores their results.
fn exercise(data: &mut Data, pair: &Pair) {
    let _ = data.forward();
    for direction in [pair.direction, [1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.3, 0.2, -1.0]] {
        let _ = data.ray(pair.eye, direction, [true; 6], None);
    }
    for _ in 0..3 {
        let _ = data.step();
    }
}

fn cases(default: u32) -> ProptestConfig {
    let asked = std::env::var("PROPTEST_CASES").ok().and_then(|cases| cases.parse().ok());
    // a crash ends the process before the case is printed, so that default runs repeat the same cases
    let rng_seed = if asked.is_some() { RngSeed::Random } else { RngSeed::Fixed(17) };
    let cases = asked.unwrap_or(default);
    ProptestConfig { cases, rng_seed, failure_persistence: None, ..ProptestConfig::default() }
}

proptest! {
    #![proptest_config(cases(300))]

    #[test]
    fn geoms_with_arbitrary_numbers_in_a_text_collide_or_are_rejected(pair in pair()) {
        match Model::from_xml(&text(&pair, false)) {
            Ok(model) => exercise(&mut Data::new(model).unwrap(), &pair),
            Err(error) => prop_assert!(matches!(error, Error::Load { .. }), "{error}"),
        }
    }

    #[test]
    fn geoms_with_arbitrary_patched_numbers_collide_or_are_rejected(pair in pair()) {
        let grid = [pair.grid[0].clamp(2, 8), pair.grid[1].clamp(8, 12)];
        let model = Model::from_xml(&text(&Pair { grid, ..pair.clone() }, true)).unwrap();
        let mut data = Data::new(model).unwrap();
        let mut patch = data.patch_model().unwrap();
        for (index, shape) in pair.shapes.iter().enumerate() {
            let geom = GeomId::new(index);
            let _ = patch.set_geom_size(geom, shape.size);
            let _ = patch.set_geom_pos(geom, shape.position);
            let _ = patch.set_geom_quat(geom, shape.quaternion);
            let _ = patch.set_geom_rbound(geom, shape.size.iter().sum());
        }
        let _ = patch.set_hfield_size(0, pair.field);
        exercise(&mut data, &pair);
    }

    /// Covers the arrays with safe mutable slices.
    #[test]
    fn arrays_with_arbitrary_numbers_cause_no_invalid_access(
        pair in pair(), numbers in prop::collection::vec(number(), 1..20), which in 0..24_usize,
    ) {
        let grid = [2, 3];
        let mut data = Data::new(Model::from_xml(&text(&Pair { grid, ..pair.clone() }, true)).unwrap()).unwrap();
        {
            let mut patch = data.patch_model().unwrap();
            let array: &mut [f64] = match which {
                0 => patch.body_mass_mut(),
                1 => patch.body_inertia_mut(),
                2 => patch.body_subtreemass_mut(),
                3 => patch.body_invweight0_mut(),
                4 => patch.dof_invweight0_mut(),
                5 => patch.dof_M0_mut(),
                6 => patch.dof_damping_mut(),
                7 => patch.dof_armature_mut(),
                8 => patch.dof_frictionloss_mut(),
                9 => patch.geom_friction_mut(),
                10 => patch.geom_solref_mut(),
                11 => patch.geom_solimp_mut(),
                12 => patch.geom_solmix_mut(),
                13 => patch.dof_solref_mut(),
                14 => patch.dof_solimp_mut(),
                15 => patch.qpos0_mut(),
                16 => patch.qpos_spring_mut(),
                _ => &mut [],
            };
            array.iter_mut().zip(numbers.iter().cycle()).for_each(|(place, &number)| *place = number);
        }
        let array: &mut [f64] = match which {
            17 => data.qpos_mut(),
            18 => data.qvel_mut(),
            19 => data.qacc_warmstart_mut(),
            20 => data.qfrc_applied_mut(),
            21 => data.xfrc_applied_mut(),
            _ => &mut [],
        };
        array.iter_mut().zip(numbers.iter().cycle()).for_each(|(place, &number)| *place = number);
        exercise(&mut data, &pair);
        let _ = data.reset();
        exercise(&mut data, &pair);
    }
}

/// Scene with every kind of element for which MuJoCo's compiler allocates memory.
const RICH: &str = r#"<mujoco model="rich">
  <compiler angle="radian" meshdir="m" texturedir="t" fitaabb="false" settotalmass="3"/>
  <option timestep="0.002" integrator="RK4" iterations="20" mpr_iterations="50" mpr_tolerance="1e-6" wind="0 0 1" density="1.2" viscosity="1e-5"/>
  <size njmax="300" nconmax="60" nstack="100000" nuserdata="3" nkey="2" nuser_body="2" nuser_geom="1" nuser_sensor="1"/>
  <visual><global fovy="45" offwidth="64" offheight="48"/><quality shadowsize="64" offsamples="1" numslices="8" numstacks="4" numquads="2"/><map znear="0.01" zfar="50"/></visual>
  <statistic extent="2" center="0 0 1" meansize="0.1"/>
  <default><geom margin="0.001" solref="0.02 1" friction="1 0.005 0.0001"/><mesh scale="1 1 1"/><default class="soft"><geom solimp="0.9 0.95 0.001 0.5 2"/></default></default>
  <custom><numeric name="n" size="4" data="1 2 3"/><text name="x" data="words"/><tuple name="u"><element objtype="body" objname="a" prm="1"/></tuple></custom>
  <asset>
    <texture name="flat" type="2d" builtin="checker" width="16" height="8" rgb1="1 0 0" rgb2="0 1 0" mark="random" random="0.1" markrgb="1 1 1"/>
    <texture name="sky" type="skybox" builtin="gradient" width="8" height="48" mark="cross"/>
    <texture name="grid" type="cube" builtin="flat" width="4" height="24" gridsize="3 4" gridlayout=".U..LFRB.D.."/>
    <material name="paint" texture="flat" texrepeat="2 2" reflectance="0.2" rgba="1 1 1 1"/>
    <mesh name="corner" vertex="0 0 0 .2 0 0 0 .3 0 0 0 .4 .1 .1 .1" face="0 2 1 0 1 3 0 3 2 1 2 3" normal="0 0 1 0 0 1 0 0 1 0 0 1 0 0 1" texcoord="0 0 1 0 0 1 1 1 0.5 0.5" refpos="0 0 0.1" refquat="1 0 0 0"/>
    <hfield name="field" nrow="3" ncol="4" size="2 2 0.3 0.1"/>
    <skin name="hide" vertex="0 0 0 .1 0 0 0 .1 0 0 0 .1" texcoord="0 0 1 0 0 1 1 1" face="0 1 2 1 2 3" inflate="0.01">
      <bone body="a" bindpos="0 0 0" bindquat="1 0 0 0" vertid="0 1 2" vertweight="1 1 0.5"/><bone body="b" bindpos="0 0 0" bindquat="1 0 0 0" vertid="2 3" vertweight="0.5 1"/>
    </skin>
  </asset>
  <worldbody>
    <light pos="0 0 3" dir="0 0 -1" cutoff="45" exponent="10"/><camera name="eye" pos="0 -2 1" xyaxes="1 0 0 0 0.5 1" fovy="60"/>
    <geom name="floor" type="plane" size="3 3 0.1" material="paint"/><geom type="hfield" hfield="field" pos="0 0 -0.1"/>
    <site name="anchor" pos="0 0 1.5" size="0.01"/><geom name="drum" type="cylinder" size="0.05 0.2" pos="0.3 0 1" euler="1.57 0 0" contype="0" conaffinity="0"/>
    <body name="a" pos="0 0 0.5"><freejoint/><geom name="ga" type="box" size=".1 .1 .1" class="soft" user="7"/><geom type="mesh" mesh="corner" pos="0 0 0.1"/><site name="sa" pos="0 0 0.1"/></body>
    <body name="b" pos="0.5 0 1" user="1 2"><joint name="jb" type="hinge" axis="0 1 0" range="-1 1" limited="true" stiffness="1" damping="0.1" armature="0.01" springdamper="1 1"/><geom name="gb" type="capsule" fromto="0 0 0 0.3 0 0" size="0.04"/><site name="sb" pos="0.3 0 0"/>
      <body name="c" pos="0.3 0 0"><joint name="jc" type="ball" range="0 1" limited="true"/><geom type="ellipsoid" size="0.05 0.06 0.07" pos="0.1 0 0"/><joint name="js" type="slide" axis="0 0 1" ref="0.1" springref="0.2"/></body></body>
    <body name="d" mocap="true" pos="1 1 1"><geom type="sphere" size="0.05"/></body>
    <body pos="0 1 1"><composite prefix="g" type="grid" count="3 3 1" spacing="0.05" offset="0 0 1"><skin texcoord="true" inflate="0.01" subgrid="2"/><geom size="0.02"/></composite></body>
    <body name="B2" pos="0 -1 1"><composite type="rope" count="5 1 1" spacing="0.1"><joint kind="main" damping="0.1"/><geom type="capsule" size="0.01 0.04"/></composite></body>
    <body pos="1 -1 1"><freejoint/><composite prefix="e" type="ellipsoid" count="4 4 4" spacing="0.06"><skin texcoord="true" rgba="1 1 1 1" subgrid="1"/><geom type="capsule" size="0.015 0.02"/></composite></body>
  </worldbody>
  <contact><pair geom1="ga" geom2="gb" condim="4" margin="0.01" gap="0.001" friction="1 1 0.1 0.01 0.01"/><exclude body1="a" body2="c"/></contact>
  <equality><connect body1="b" body2="c" anchor="0.3 0 0"/><weld body1="d" body2="a" relpose="0 0 0 1 0 0 0" active="false"/><joint joint1="jb" joint2="js" polycoef="0 1 0 0 0"/></equality>
  <tendon><spatial name="rope" range="0 3" limited="true" width="0.01"><site site="anchor"/><geom geom="drum"/><site site="sb"/><pulley divisor="2"/><site site="anchor"/><site site="sa"/></spatial><fixed name="f"><joint joint="jb" coef="2"/></fixed></tendon>
  <actuator><motor joint="jb" gear="10" ctrlrange="-1 1" ctrllimited="true"/><general site="sa" gear="0 0 1 0 0 0"/><position joint="js" kp="10"/><muscle tendon="rope" timeconst="0.01 0.04" lengthrange="0.1 2"/></actuator>
  <sensor><accelerometer site="sa" noise="0.1"/><rangefinder site="sb" cutoff="3"/><jointpos joint="jb"/><tendonpos tendon="rope"/><user objtype="body" objname="a" dim="3" datatype="real" needstage="pos" user="1"/><framepos objtype="body" objname="a"/></sensor>
  <keyframe><key time="1" ctrl="0 0 0 0"/></keyframe>
</mujoco>"#;

/// Replacements for numbers of the scene.
const NASTY: [&str; 22] = [
    "-1",
    "0",
    "1",
    "2",
    "3",
    "5",
    "12",
    "13",
    "64",
    "501",
    "1000",
    "65536",
    "2147483647",
    "-2147483648",
    "4294967296",
    "99999999999999999999",
    "1e-300",
    "1e300",
    "nan",
    "inf",
    "0.5",
    "-0.5",
];

/// Returns the byte ranges of the numbers in the text.
fn numbers_of(text: &str) -> Vec<std::ops::Range<usize>> {
    let is_part = |byte: u8| byte.is_ascii_digit() || b".-".contains(&byte);
    let bytes = text.as_bytes();
    let mut found = Vec::new();
    let mut at = 0;
    while at < bytes.len() {
        let end = at + bytes[at..].iter().take_while(|&&byte| is_part(byte)).count();
        if end > at && at > 0 && b"\" ".contains(&bytes[at - 1]) {
            found.push(at..end);
        }
        at = end.max(at + 1);
    }
    found
}

proptest! {
    #![proptest_config(cases(60))]

    /// Replaces a few numbers or letters of the rich scene.
    #[test]
    fn rich_scenes_with_wrong_numbers_compile_or_are_rejected(
        changes in prop::collection::vec((any::<prop::sample::Index>(), 0..NASTY.len()), 1..4),
        letter in prop::option::of((any::<prop::sample::Index>(), 32_u8..127)),
    ) {
        let mut text = RICH.to_string();
        for (index, nasty) in changes {
            let places = numbers_of(&text);
            text.replace_range(places[index.index(places.len())].clone(), NASTY[nasty]);
        }
        if let Some((index, letter)) = letter {
            let at = index.index(text.len());
            text.replace_range(at..=at, char::from(letter).encode_utf8(&mut [0; 4]));
        }
        if let Ok(model) = Model::from_xml(&text) {
            let mut data = Data::new(model).unwrap();
            for _ in 0..3 {
                let _ = data.step();
            }
            if data.kinematics().is_ok() {
                let _ = data.ray([0.0, 0.0, 2.0], [0.1, 0.2, -1.0], [true; 6], None);
                let mut scene = Scene::new(data.shared_model(), 1).unwrap();
                let _ = scene.update(&mut data, &Camera::Fixed(CameraId::new(0)));
            }
        }
    }
}

#[test]
fn the_rich_scene_compiles() {
    let mut data = Data::new(Model::from_xml(RICH).unwrap()).unwrap();
    data.step().unwrap();
    assert_eq!((data.model().nskin(), data.model().nhfield(), data.model().nwrap()), (3, 1, 87));
}
