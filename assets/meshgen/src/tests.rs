//! Tests of every generated mesh.

use crate::mesh::{Part, Solid};
use crate::vec3::{Vec3, vec3};
use crate::{Asset, Request, assets, check, crazyflie, parse, racer, write};
use std::collections::{BTreeMap, BTreeSet, HashSet};
use std::ffi::OsString;
use std::fs;
use std::path::{Path, PathBuf};

/// Largest number of triangles of an airframe's visual parts.
const BUDGET: usize = 3000;
/// Half a unit of the last written decimal, plus rounding.
const ROUNDING: f64 = 0.51e-6;

/// Parsed OBJ file.
struct Read {
    /// Positions.
    vertices: Vec<Vec3>,
    /// Normals.
    normals: Vec<Vec3>,
    /// Triangles as zero-based indices into both.
    faces: Vec<[usize; 3]>,
}

/// Parses the subset of OBJ that `to_obj` writes.
fn read(text: &str) -> Read {
    let mut read = Read { vertices: Vec::new(), normals: Vec::new(), faces: Vec::new() };
    for line in text.lines().filter(|line| !line.starts_with('#')) {
        let (kind, rest) = line.split_once(' ').expect("a keyword");
        let fields: Vec<&str> = rest.split(' ').collect();
        assert_eq!(fields.len(), 3, "{line}");
        if kind == "f" {
            read.faces.push([0, 1, 2].map(|i| {
                let (v, n) = fields[i].split_once("//").expect("v//n");
                assert_eq!(v, n, "{line}");
                v.parse::<usize>().expect("an index") - 1
            }));
        } else {
            let [x, y, z] = [0, 1, 2].map(|i| fields[i].parse::<f64>().expect("a number"));
            match kind {
                "v" => read.vertices.push(vec3(x, y, z)),
                "vn" => read.normals.push(vec3(x, y, z)),
                _ => panic!("{line}"),
            }
        }
    }
    read
}

/// Returns six times the signed volume of the tetrahedron between a triangle and the origin.
fn tetrahedron([a, b, c]: [Vec3; 3]) -> f64 {
    a.dot(b.cross(c))
}

/// Returns the signed volume: positive if the faces look outwards.
fn volume(solid: &Solid) -> f64 {
    let six: f64 = solid.faces.iter().map(|face| tetrahedron(face.map(|index| solid.points[index]))).sum();
    six / 6.0
}

/// Returns the smallest and largest coordinates of `part`.
fn extents(part: &Part) -> [Vec3; 2] {
    let points = || part.solids.iter().flat_map(|solid| &solid.points);
    let bound = |pick: fn(f64, f64) -> f64| {
        points().copied().reduce(|a, b| vec3(pick(a.x, b.x), pick(a.y, b.y), pick(a.z, b.z))).expect("points")
    };
    [bound(f64::min), bound(f64::max)]
}

/// Returns the largest distance of `part` from the z axis.
fn reach(part: &Part) -> f64 {
    part.solids.iter().flat_map(|solid| &solid.points).fold(0.0, |reach, p| p.x.hypot(p.y).max(reach))
}

/// Creates an empty directory for `test`.
fn scratch(test: &str) -> PathBuf {
    let path = std::env::temp_dir().join(format!("meshgen-{}-{test}", std::process::id()));
    let _ = fs::remove_dir_all(&path);
    fs::create_dir_all(&path).expect("a temporary directory");
    path
}

/// Returns the assets whose file names pass `filter`.
fn named(filter: impl Fn(&str) -> bool) -> Vec<Asset> {
    assets().into_iter().filter(|asset| filter(&asset.name)).collect()
}

/// Returns the visual parts of an airframe.
fn visual(folder: &str) -> Vec<Asset> {
    named(|name| name.starts_with(folder) && !name.contains("collision"))
}

#[test]
fn file_names_match_the_parts() {
    for (folder, pieces) in [("cf2", 13), ("race", 14)] {
        let found: BTreeSet<String> =
            assets().into_iter().filter(|asset| asset.folder == folder).map(|asset| asset.name).collect();
        let expected: BTreeSet<String> = (0..7)
            .map(|i| format!("{folder}_{i}.obj"))
            .chain((0..pieces).map(|i| format!("{folder}_collision_{i}.obj")))
            .collect();
        assert_eq!(found, expected);
    }
}

#[test]
fn every_solid_is_a_closed_manifold_without_handles() {
    for asset in assets() {
        assert!(!asset.part.solids.is_empty(), "{}", asset.name);
        for (index, solid) in asset.part.solids.iter().enumerate() {
            let what = format!("{} solid {index}", asset.name);
            let mut edges = HashSet::new();
            for face in &solid.faces {
                for corner in 0..3 {
                    let edge = (face[corner], face[(corner + 1) % 3]);
                    assert!(edges.insert(edge), "{what}: {edge:?} used twice");
                }
            }
            for (from, to) in &edges {
                assert!(edges.contains(&(*to, *from)), "{what}: open at {from}-{to}");
            }
            // Euler's formula: one connected surface without holes and without unused vertices.
            let euler = solid.points.len() + solid.faces.len();
            assert_eq!(euler, edges.len() / 2 + 2, "{what}");
        }
    }
}

#[test]
fn every_solid_faces_outwards() {
    for asset in assets() {
        for (index, solid) in asset.part.solids.iter().enumerate() {
            let volume = volume(solid);
            assert!(volume > 1e-11, "{} solid {index}: {volume}", asset.name);
        }
    }
}

#[test]
fn vertices_stay_distinct_when_rounded_and_triangles_have_an_area() {
    for asset in assets() {
        for solid in &asset.part.solids {
            for face in &solid.faces {
                let [a, b, c] = face.map(|index| solid.points[index]);
                for side in [a - b, b - c, c - a] {
                    assert!(side.length() > 20e-6, "{}: {side:?}", asset.name);
                }
                let area = (b - a).cross(c - a).length() / 2.0;
                assert!(area > 1e-9, "{}: {area}", asset.name);
            }
        }
    }
}

#[test]
fn files_read_back_with_the_same_volume_and_outward_unit_normals() {
    for asset in assets() {
        let file = read(&asset.contents());
        assert_eq!(file.vertices.len(), file.normals.len(), "{}", asset.name);
        let mut six = 0.0;
        for face in &file.faces {
            let [a, b, c] = face.map(|index| file.vertices[index]);
            six += tetrahedron([a, b, c]);
            let facing = (b - a).cross(c - a).normalized();
            for index in face {
                let normal = file.normals[*index];
                assert!((normal.length() - 1.0).abs() < 2e-6, "{}", asset.name);
                assert!(normal.dot(facing) > 0.5, "{}", asset.name);
            }
        }
        let expected: f64 = asset.part.solids.iter().map(volume).sum();
        let error = (six / 6.0 - expected).abs() / expected;
        assert!(error < 0.01, "{}: off by {error}", asset.name);
    }
}

#[test]
fn sharp_edges_stay_sharp_and_round_sides_smooth() {
    // A collision box: every normal belongs to one face.
    let boxes = named(|name| name == "cf2_collision_1.obj");
    let file = read(&boxes[0].contents());
    assert_eq!((file.vertices.len(), file.faces.len()), (24, 12));
    // A motor: the normals of the side point away from its axis.
    let motors = named(|name| name == "cf2_4.obj");
    let wall = motors[0].part.solids[0].triangles();
    let axis = vec3(crazyflie::MOTOR_XY, crazyflie::MOTOR_XY, 0.0);
    let on_wall = wall.iter().flatten().filter(|corner| {
        let from_axis = corner.position - axis;
        corner.normal.z.abs() < 0.1 && from_axis.x.hypot(from_axis.y) > 0.0034
    });
    let mut count = 0;
    for corner in on_wall {
        let out = vec3(corner.position.x - axis.x, corner.position.y - axis.y, 0.0);
        assert!(corner.normal.angle_to(out) < 0.05);
        count += 1;
    }
    assert_eq!(count, 12 * 2 * 3);
}

#[test]
fn no_edge_angle_is_so_close_to_the_crease_that_rounding_decides() {
    for asset in assets() {
        for solid in &asset.part.solids {
            let normals: Vec<Vec3> = solid
                .faces
                .iter()
                .map(|face| {
                    let [a, b, c] = face.map(|index| solid.points[index]);
                    (b - a).cross(c - a).normalized()
                })
                .collect();
            for (i, face) in solid.faces.iter().enumerate() {
                for (j, other) in solid.faces.iter().enumerate().take(i) {
                    if face.iter().any(|index| other.contains(index)) {
                        let bend = normals[i].angle_to(normals[j]).to_degrees();
                        let margin = (bend - solid.crease).abs();
                        assert!(margin > 1e-3, "{}: {bend}", asset.name);
                    }
                }
            }
        }
    }
}

#[test]
fn visual_parts_stay_within_the_triangle_budget() {
    for folder in ["cf2", "race"] {
        let total: usize =
            visual(folder).iter().flat_map(|asset| &asset.part.solids).map(|solid| solid.faces.len()).sum();
        assert!(total <= BUDGET, "{folder}: {total}");
    }
}

#[test]
fn crazyflie_parts_have_the_stated_dimensions() {
    let heights = [
        Some([0.0112, 0.0147]),
        None,
        Some([0.0005, 0.0185]),
        Some([0.0042, 0.0111]),
        Some([-0.0054, 0.0112]),
        None,
        Some([-0.0125, 0.0048]),
    ];
    for (asset, height) in visual("cf2").iter().zip(heights) {
        let [low, high] = extents(&asset.part);
        if let Some([bottom, top]) = height {
            assert!((low.z - bottom).abs() < ROUNDING, "{}", asset.name);
            assert!((high.z - top).abs() < ROUNDING, "{}", asset.name);
        }
        assert!(low.z >= -0.0125 - ROUNDING && high.z <= 0.0185 + ROUNDING);
        let reach = reach(&asset.part);
        let limit = crazyflie::MOTOR_XY * 2.0_f64.sqrt() + crazyflie::PROP_RADIUS;
        assert!(reach <= limit, "{}: {reach}", asset.name);
    }
    let [low, high] = extents(&visual("cf2")[3].part);
    let size = high - low;
    assert!((size.x - 0.030).abs() < 1e-9 && (size.y - 0.020).abs() < 1e-9);
}

#[test]
fn racer_fits_its_collision_cylinder() {
    for (index, asset) in visual("race").iter().enumerate() {
        let [low, high] = extents(&asset.part);
        assert!(low.z >= -0.03, "{}: {low:?}", asset.name);
        // The antenna extends beyond the top, the propellers beyond the side.
        assert!(index == 6 || high.z <= 0.03, "{}: {high:?}", asset.name);
        let limit = if index == 0 { racer::ARM + racer::PROP_RADIUS } else { 0.15 };
        assert!(reach(&asset.part) <= limit, "{}", asset.name);
    }
}

#[test]
fn propellers_sweep_their_radius_about_the_motors() {
    for (folder, radius, arm, blades) in [
        ("cf2", crazyflie::PROP_RADIUS, crazyflie::MOTOR_XY * 2.0_f64.sqrt(), 2),
        ("race", racer::PROP_RADIUS, racer::ARM, 3),
    ] {
        let part = &visual(folder)[0].part;
        assert_eq!(part.solids.len(), 4 * (blades + 1));
        for (index, propeller) in part.solids.chunks(blades + 1).enumerate() {
            let angle = (2 * index + 1) as f64 * std::f64::consts::FRAC_PI_4;
            let axis = vec3(arm, 0.0, 0.0).rotated_z(angle);
            let swept = propeller
                .iter()
                .flat_map(|solid| &solid.points)
                .map(|p| (p.x - axis.x).hypot(p.y - axis.y))
                .fold(0.0, f64::max);
            assert!(swept <= radius && swept > 0.985 * radius, "{folder}: {swept}");
        }
    }
}

#[test]
fn blades_push_air_down_and_neighbours_turn_in_opposite_directions() {
    for (folder, arm, blades) in [("cf2", crazyflie::MOTOR_XY * 2.0_f64.sqrt(), 2), ("race", racer::ARM, 3)] {
        for (index, propeller) in visual(folder)[0].part.solids.chunks(blades + 1).enumerate() {
            let angle = (2 * index + 1) as f64 * std::f64::consts::FRAC_PI_4;
            let axis = vec3(arm, 0.0, 0.0).rotated_z(angle);
            for blade in &propeller[1..] {
                // Slope of the height over the angle around the axis: the leading edge is the upper one.
                let centre =
                    blade.points.iter().fold(Vec3::ZERO, |sum, p| sum + *p) * (1.0 / blade.points.len() as f64);
                let around = vec3(0.0, 0.0, 1.0).cross(centre - axis).normalized();
                let slope: f64 = blade.points.iter().map(|p| (*p - centre).dot(around) * (p.z - centre.z)).sum();
                let clockwise = (index % 2 == 0) == (folder == "race");
                assert_eq!(slope < 0.0, clockwise, "{folder} propeller {index}");
            }
        }
    }
}

#[test]
fn collision_pieces_are_convex_and_coarse() {
    for asset in named(|name| name.contains("collision")) {
        assert_eq!(asset.part.solids.len(), 1, "{}", asset.name);
        let solid = &asset.part.solids[0];
        assert!(solid.faces.len() <= 44, "{}", asset.name);
        for face in &solid.faces {
            let [a, b, c] = face.map(|index| solid.points[index]);
            let normal = (b - a).cross(c - a).normalized();
            for point in &solid.points {
                assert!((*point - a).dot(normal) < 1e-9, "{}", asset.name);
            }
        }
    }
}

#[test]
fn generation_is_deterministic() {
    let generate = || -> BTreeMap<String, String> {
        assets().into_iter().map(|asset| (asset.name.clone(), asset.contents())).collect()
    };
    let first = generate();
    assert_eq!(first, generate());
    for (name, text) in first {
        assert!(!text.contains("-0.000000"), "{name}");
        assert!(!text.contains("NaN") && !text.contains("inf"), "{name}");
    }
}

#[test]
fn check_accepts_written_files_and_names_the_first_difference() {
    let root = scratch("check");
    assert_eq!(write(&root), Ok(assets().len()));
    assert_eq!(check(&root), Ok(assets().len()));

    let stale = root.join("race").join("race_99.obj");
    fs::write(&stale, "").expect("a file");
    let complaint = check(&root).expect_err("a left-over file");
    assert!(complaint.contains("race_99.obj"), "{complaint}");
    fs::remove_file(&stale).expect("removed");

    let changed = root.join("cf2").join("cf2_3.obj");
    fs::write(&changed, "v 0 0 0\n").expect("a file");
    let complaint = check(&root).expect_err("a changed file");
    assert!(complaint.contains("cf2_3.obj differs"), "{complaint}");

    fs::remove_file(root.join("cf2").join("cf2_1.obj")).expect("removed");
    let complaint = check(&root).expect_err("a missing file");
    assert!(complaint.contains("cf2_1.obj"), "{complaint}");
    fs::remove_dir_all(&root).expect("removed");
}

#[test]
fn writing_below_a_file_is_an_error_of_one_line() {
    let root = scratch("write");
    let file = root.join("file");
    fs::write(&file, "").expect("a file");
    let complaint = write(&file).expect_err("not a directory");
    assert!(complaint.starts_with("cannot create"), "{complaint}");
    assert_eq!(complaint.lines().count(), 1);
    fs::remove_dir_all(&root).expect("removed");
}

#[test]
fn arguments_are_parsed_or_rejected() {
    let parse = |arguments: &[&str]| {
        let owned: Vec<OsString> = arguments.iter().map(OsString::from).collect();
        parse(&owned)
    };
    assert_eq!(parse(&["out"]), Ok(Request::Write(PathBuf::from("out"))));
    assert_eq!(parse(&["--check", "out"]), Ok(Request::Check(PathBuf::from("out"))));
    assert_eq!(parse(&["--help"]), Ok(Request::Help));
    for refused in
        [&[][..], &[""], &["--check"], &["--check", ""], &["--cheque", "out"], &["a", "b"], &["--check", "a", "b"]]
    {
        assert!(parse(refused).is_err(), "{refused:?}");
    }
}

/// Committed meshes match the generated ones.
#[test]
fn committed_files_are_up_to_date() {
    let assets = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    for asset in super::assets() {
        let committed = fs::read_to_string(asset.path(&assets)).unwrap_or_default();
        assert!(committed == asset.contents(), "{}: run `cargo run -p meshgen -- assets`", asset.name);
    }
}
