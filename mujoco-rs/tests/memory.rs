//! Numbers of every kind at the edge to MuJoCo's C code: an error, or a step and rays, and never memory that is not MuJoCo's.
//!
//! A crash ends the process. What does not crash is seen where AddressSanitizer watches MuJoCo (`.ci/asan`). `PROPTEST_CASES`
//! sets how many cases there are.

use std::fmt::Write as _;

use mujoco_rs::{Data, Error, GeomId, Model, ObjectId};
use proptest::prelude::*;

/// Numbers that a caller might write where a length, a coordinate or a part of a quaternion is expected.
fn number() -> impl Strategy<Value = f64> {
    prop_oneof![
        4 => -2.0..2.0_f64,
        4 => (-3.0..3.0_f64).prop_map(|power| 10_f64.powf(power)),
        2 => (-16.0..11.0_f64).prop_map(|power| 10_f64.powf(power)),
        1 => prop::sample::select(vec![
            0.0, -0.0, 1.0, -1.0, 0.1, 1e-320, 1e-200, 1e-15, 1e10, -1e10, 1e15, 1e200, f64::MAX, f64::NAN, f64::INFINITY, f64::NEG_INFINITY,
        ]),
    ]
}

/// Lengths that are mostly possible.
fn length() -> impl Strategy<Value = f64> {
    prop_oneof![
        8 => (-2.0..1.0_f64).prop_map(|power| 10_f64.powf(power)),
        4 => (-15.0..6.0_f64).prop_map(|power| 10_f64.powf(power)),
        1 => prop::sample::select(vec![1e-15, 1e6, 1.0]),
        1 => number(),
    ]
}

/// Coordinates close to where the other geom is, and some that are not.
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

/// Planes and height fields, which cannot move, first.
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

/// Text of a scene with both shapes: the first fixed, the second on a free body.
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
        <worldbody>{first}<body><freejoint/><inertial mass='1' pos='0 0 0' diaginertia='.1 .1 .1'/>{second}</body></worldbody></mujoco>",
        if pair.multiccd { "enable" } else { "disable" },
        pair.grid[0],
        pair.grid[1],
        words(&field),
    )
}

/// A forward pass, rays and steps, whatever their results are.
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
    ProptestConfig { cases: asked.unwrap_or(default), failure_persistence: None, ..ProptestConfig::default() }
}

proptest! {
    #![proptest_config(cases(300))]

    #[test]
    fn geoms_of_any_numbers_in_a_text_collide_or_are_refused(pair in pair()) {
        match Model::from_xml(&text(&pair, false)) {
            Ok(model) => exercise(&mut Data::new(model).unwrap(), &pair),
            Err(error) => prop_assert!(matches!(error, Error::Load { .. }), "{error}"),
        }
    }

    #[test]
    fn geoms_of_any_numbers_in_a_patch_collide_or_are_refused(pair in pair()) {
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

    /// The arrays that are written as slices: whatever stands in them, MuJoCo calculates with it.
    #[test]
    fn arrays_of_any_numbers_are_calculated_with(
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
