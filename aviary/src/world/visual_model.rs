//! Visual models of drones: meshes, materials and the source of their files.

use std::path::PathBuf;

use mujoco_rs::Assets;

use crate::drone::{Appearance, DroneParams, Layout};
use crate::world::SceneError;

/// Environment variable that names a directory with another set of Crazyflie meshes, with the file names of MuJoCo
/// Menagerie.
pub const CF2_ASSETS: &str = "MJ_DRONES_CF2_ASSETS";

/// Visible part of a drone.
pub(super) struct VisualPart {
    /// Name of the part in segmentation.
    pub name: &'static str,
    /// File name of the mesh.
    pub file: &'static str,
    embedded: &'static [u8],
    /// Colour.
    pub rgba: [f64; 4],
    /// Specular reflection, 0 to 1.
    pub specular: f64,
    /// Sharpness of the highlight, 0 to 1.
    pub shininess: f64,
}

macro_rules! part {
    ($name:literal, $directory:literal, $file:literal, $rgba:expr, $specular:literal, $shininess:literal) => {
        VisualPart {
            name: $name,
            file: $file,
            embedded: include_bytes!(concat!("../../../assets/", $directory, "/", $file)),
            rgba: $rgba,
            specular: $specular,
            shininess: $shininess,
        }
    };
}

/// Parts of the Crazyflie, which correspond to the files of the same names in MuJoCo Menagerie.
static CRAZYFLIE: [VisualPart; 7] = [
    part!("propellers", "cf2", "cf2_0.obj", [0.792, 0.820, 0.933, 1.0], 0.5, 0.5),
    part!("deck", "cf2", "cf2_1.obj", [0.109, 0.184, 0.0, 1.0], 0.5, 0.4),
    part!("pins", "cf2", "cf2_2.obj", [0.969, 0.878, 0.6, 1.0], 0.9, 0.7),
    part!("battery", "cf2", "cf2_3.obj", [0.631, 0.659, 0.678, 1.0], 0.6, 0.5),
    part!("motors", "cf2", "cf2_4.obj", [0.75, 0.75, 0.76, 1.0], 0.9, 0.7),
    part!("frame", "cf2", "cf2_5.obj", [0.102, 0.102, 0.102, 1.0], 0.35, 0.3),
    part!("mounts", "cf2", "cf2_6.obj", [1.0, 1.0, 1.0, 1.0], 0.3, 0.2),
];

static RACER: [VisualPart; 7] = [
    part!("propellers", "race", "race_0.obj", [0.55, 0.85, 0.25, 1.0], 0.4, 0.4),
    part!("frame", "race", "race_1.obj", [0.09, 0.09, 0.10, 1.0], 0.45, 0.35),
    part!("motors", "race", "race_2.obj", [0.30, 0.31, 0.34, 1.0], 0.8, 0.6),
    part!("battery", "race", "race_3.obj", [0.17, 0.19, 0.26, 1.0], 0.3, 0.3),
    part!("stack", "race", "race_4.obj", [0.06, 0.16, 0.10, 1.0], 0.4, 0.3),
    part!("camera", "race", "race_5.obj", [0.16, 0.16, 0.18, 1.0], 0.6, 0.6),
    part!("accents", "race", "race_6.obj", [0.95, 0.32, 0.06, 1.0], 0.5, 0.4),
];

/// Visual model of a drone: its parts, with their rotation and scale.
#[derive(Clone, Copy)]
pub(super) struct VisualModel {
    pub parts: &'static [VisualPart],
    appearance: Appearance,
    /// Scale of the meshes.
    pub scale: f64,
    /// Rotation of the meshes about z, rad; the motors of the meshes are on the diagonals.
    pub turn: f64,
}

impl VisualModel {
    pub(super) fn of(params: &DroneParams) -> Self {
        let (parts, arm): (&'static [VisualPart], f64) = match params.appearance {
            Appearance::Crazyflie => (&CRAZYFLIE, 0.0397),
            Appearance::Racer => (&RACER, 0.125),
        };
        // motor 0 is in front in the plus layout, and to the front left in the X layout
        let turn = match params.layout {
            Layout::X => 0.0,
            Layout::Plus => -std::f64::consts::FRAC_PI_4,
        };
        Self { parts, appearance: params.appearance, scale: params.arm_length / arm, turn }
    }

    /// Returns the name of a part's mesh in the scene; drones of equal appearance and size share it.
    pub(super) fn mesh_name(&self, part: &VisualPart) -> String {
        format!("{}_x{}", part.file.trim_end_matches(".obj"), self.scale)
    }

    /// Returns the name of a part's material in the scene.
    pub(super) fn material_name(part: &VisualPart) -> String {
        format!("{}_material", part.file.trim_end_matches(".obj"))
    }

    /// Adds the files of the parts.
    pub(super) fn add_files(&self, assets: &mut Assets) -> Result<(), SceneError> {
        for part in self.parts {
            assets.insert(part.file, self.read(part)?);
        }
        Ok(())
    }

    /// Reads the mesh of a part, from the directory in [`CF2_ASSETS`] or from the executable.
    fn read(&self, part: &VisualPart) -> Result<Vec<u8>, SceneError> {
        let directory = match self.appearance {
            Appearance::Crazyflie => std::env::var_os(CF2_ASSETS).filter(|value| !value.is_empty()).map(PathBuf::from),
            Appearance::Racer => None,
        };
        let Some(directory) = directory else { return Ok(part.embedded.to_vec()) };
        let path = directory.join(part.file);
        let bytes = std::fs::read(&path)
            .map_err(|error| SceneError::Mesh { path: path.clone(), message: error.to_string() })?;
        check_obj(&bytes).map_err(|message| SceneError::Mesh { path, message })?;
        Ok(bytes)
    }
}

/// Mesh of a visible part of an airframe.
#[derive(Debug, Clone, PartialEq)]
pub struct VisualMesh {
    /// Name of the part.
    pub name: &'static str,
    /// Mesh as an OBJ file; its frame is the body frame, turned by `yaw` about z and scaled by `scale`.
    pub obj: Vec<u8>,
    /// Factor from the lengths of the file to m.
    pub scale: f64,
    /// Rotation of the mesh about the z axis of the body frame, rad.
    pub yaw: f64,
    /// Colour: red, green, blue, alpha, 0 to 1.
    pub rgba: [f64; 4],
}

impl VisualMesh {
    /// Returns the meshes of an airframe, with which MuJoCo draws it.
    ///
    /// # Errors
    /// [`SceneError::Mesh`] if a file in the directory of [`CF2_ASSETS`] cannot be read.
    ///
    /// ```
    /// use aviary::drone::DroneModel;
    /// use aviary::world::VisualMesh;
    ///
    /// let meshes = VisualMesh::of(&DroneModel::Cf2x.params())?;
    /// assert!(meshes.iter().any(|mesh| mesh.name == "propellers" && mesh.yaw == 0.0));
    /// # Ok::<(), aviary::world::SceneError>(())
    /// ```
    pub fn of(params: &DroneParams) -> Result<Vec<Self>, SceneError> {
        let model = VisualModel::of(params);
        let mesh = |part: &VisualPart| {
            let obj = model.read(part)?;
            Ok(Self { name: part.name, obj, scale: model.scale, yaw: model.turn, rgba: part.rgba })
        };
        model.parts.iter().map(mesh).collect()
    }
}

/// Largest mesh file, bytes; its indices and MuJoCo's copies of them fit into 32 bits.
const MAX_MESH_BYTES: usize = 64 << 20;

/// Largest number of corners of a face; the reader's triangulation time is cubic in it.
const MAX_CORNERS: usize = 64;

/// Parses a number that MuJoCo's OBJ reader and Rust read alike. The reader has its own parser, which reads `0e999`
/// as NaN and computes in single precision.
fn coordinate(word: &str) -> Option<f64> {
    const LONGEST: usize = 40;
    let (digits, exponent) = word.split_once(['e', 'E']).unwrap_or((word, "0"));
    let plain = |text: &str| text.bytes().all(|byte| matches!(byte, b'0'..=b'9' | b'+' | b'-' | b'.'));
    let exponent_fits = exponent.parse::<i32>().is_ok_and(|exponent| exponent.abs() < 100);
    if word.len() > LONGEST || !plain(digits) || !exponent_fits {
        return None;
    }
    word.parse().ok().filter(|x| (-1e3..=1e3).contains(x))
}

/// Number of vertices, texture coordinates and normals in a file, or in a file up to a line.
#[derive(Debug, Clone, Copy, Default)]
struct ObjCounts {
    vertices: usize,
    textures: usize,
    normals: usize,
}

impl ObjCounts {
    fn count(&mut self, key: &str) {
        match key {
            "v" => self.vertices += 1,
            "vt" => self.textures += 1,
            "vn" => self.normals += 1,
            _ => {}
        }
    }

    /// Checks a corner of a face, `v`, `v/vt`, `v//vn` or `v/vt/vn`, in a file with the counts `self`, of which
    /// `before` precede the face. MuJoCo reads a texture coordinate and a normal for every corner if the file has
    /// any.
    fn check_corner(&self, before: &Self, corner: &str) -> Result<(), String> {
        let parts: Vec<_> = corner.split('/').collect();
        let (vertex, texture, normal) = match parts[..] {
            [vertex] => (Some(vertex), None, None),
            [vertex, texture] => (Some(vertex), Some(texture), None),
            [vertex, "", normal] => (Some(vertex), None, Some(normal)),
            [vertex, texture, normal] => (Some(vertex), Some(texture), Some(normal)),
            _ => return Err(format!("corner `{corner}`, expected `v`, `v/vt`, `v//vn` or `v/vt/vn`")),
        };
        for (what, index, total, so_far) in [
            ("vertex", vertex, self.vertices, before.vertices),
            ("texture coordinate", texture, self.textures, before.textures),
            ("normal", normal, self.normals, before.normals),
        ] {
            match index.map(str::parse::<i64>) {
                None if total == 0 => {}
                None => {
                    return Err(format!("corner `{corner}` has no {what}, expected one because the file has {total}"));
                }
                // negative indices count back from the last definition before the face
                Some(Ok(index @ 1..)) if index.unsigned_abs() <= total as u64 => {}
                Some(Ok(index @ ..=-1)) if index.unsigned_abs() <= so_far as u64 => {}
                Some(_) => return Err(format!("corner `{corner}` refers to a missing {what}; the file has {total}")),
            }
        }
        Ok(())
    }
}

/// Checks an OBJ mesh for input on which MuJoCo's reader (tinyobjloader) fails without an error.
///
/// The reader reads beyond the end of its arrays if a face refers to a missing vertex, normal or texture coordinate,
/// or omits one that other faces have. It crashes on a mesh without faces. The check splits the text like the reader:
/// a single carriage return ends a line, and only spaces and tabs separate words.
///
/// # Errors
/// A message with the line, the value and the expected values.
///
/// ```
/// use aviary::world::check_obj;
///
/// let solid = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n";
/// assert!(check_obj(solid.as_bytes()).is_ok());
/// assert!(check_obj(solid.replace("f 2 3 4", "f 2 3 5").as_bytes()).is_err());
/// ```
pub fn check_obj(bytes: &[u8]) -> Result<(), String> {
    if bytes.len() > MAX_MESH_BYTES {
        return Err(format!("{} bytes, expected at most {MAX_MESH_BYTES}", bytes.len()));
    }
    let text = std::str::from_utf8(bytes).map_err(|_| "not text, expected an OBJ file".to_string())?;
    let text = text.replace("\r\n", "\n");
    let lines = || text.split(['\n', '\r']).enumerate();
    let words = |line| str::split(line, [' ', '\t']).filter(|word: &&str| !word.is_empty());
    let mut total = ObjCounts::default();
    for (_, line) in lines() {
        total.count(words(line).next().unwrap_or_default());
    }
    // MuJoCo uses the first group that has faces
    let (mut faces, mut in_first_group) = (0, true);
    let mut before = ObjCounts::default();
    for (number, line) in lines() {
        let wrong = |what: String| Err(format!("line {}: {what}", number + 1));
        if let Some(control) = line.chars().find(|c| c.is_control() && *c != '\t') {
            return wrong(format!("a control character, {control:?}, expected text"));
        }
        let mut words = words(line);
        let key = words.next().unwrap_or_default();
        before.count(key);
        match key {
            "v" | "vn" | "vt" => {
                let (min, max) = if key == "vt" { (1, 3) } else { (3, 3) };
                let numbers = words.take(max).map(coordinate).collect::<Option<Vec<_>>>();
                if numbers.is_none_or(|numbers| numbers.len() < min) {
                    return wrong(format!("expected {min} numbers within ±1000 after `{key}`"));
                }
            }
            "f" => {
                let mut corners = 0;
                for corner in words {
                    corners += 1;
                    if let Err(message) = total.check_corner(&before, corner) {
                        return wrong(message);
                    }
                }
                if !(3..=MAX_CORNERS).contains(&corners) {
                    return wrong(format!("a face of {corners} corners, expected 3 to {MAX_CORNERS}"));
                }
                faces += usize::from(in_first_group);
            }
            "g" | "o" => in_first_group = faces == 0,
            // the reader keeps these elements once per material, and MuJoCo draws none of them
            "l" | "p" | "t" | "vw" => return wrong(format!("`{key}`, expected a mesh of faces only")),
            _ => {}
        }
    }
    if total.vertices < 4 || faces < 4 {
        return Err(format!(
            "{} vertices and {faces} faces in the first group, expected at least 4 of each",
            total.vertices
        ));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const SOLID: &str = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n";

    #[test]
    fn errors_name_the_line_of_a_mesh_that_would_crash_the_reader() {
        for part in CRAZYFLIE.iter().chain(&RACER) {
            check_obj(part.embedded).unwrap_or_else(|message| panic!("{}: {message}", part.file));
        }
        assert!(check_obj(SOLID.as_bytes()).is_ok());
        let refused = |from: &str, to: &str| check_obj(SOLID.replace(from, to).as_bytes()).unwrap_err();
        for bad in ["v 0 0 nan", "v 0 0", "v 0 0 1e9", "v 0 0 0e999", "v 0 0 0x1", "v 0 0 1\u{b}", "vw 0 0 1", "l 1 2"]
        {
            let message = refused("v 0 0 1", bad);
            assert!(message.starts_with("line 4: "), "{bad}: {message}");
        }
        for bad in [
            "f 2 3 9",
            "f 2 3 0",
            "f 2//1 3//1 4//1",
            "f 2/1 3/1 4/1",
            "f 2 3",
            "f 2/ 3 4",
            "f 2 3 4/1/1/1",
            "f 2 3 \\",
        ] {
            let message = refused("f 2 3 4", bad);
            assert!(message.starts_with("line 8: "), "{bad}: {message}");
        }
        assert!(refused("f 2 3 4\n", "").contains("3 faces"));
        assert!(refused("f 1 3 2", "f 1 3 2\ng other").contains("1 faces in the first group"));
        assert!(check_obj(b"v 0 0 0").unwrap_err().contains("1 vertices") && check_obj(&[0xff, 0xfe]).is_err());
        assert!(refused("f 2 3 4", &format!("f {}", "2 3 4 ".repeat(40))).contains("120 corners"));
    }

    #[test]
    fn a_carriage_return_ends_a_line_of_a_mesh() {
        // one comment line for a reader that ends lines at line feeds only
        let message = check_obj(SOLID.replace("f 2 3 4", "# note\rf 2 3 900000").as_bytes()).unwrap_err();
        assert!(message.starts_with("line 9: ") && message.contains("900000"), "{message}");
        assert!(check_obj(SOLID.replace('\n', "\r").as_bytes()).is_ok());
        assert!(check_obj(SOLID.replace('\n', "\r\n").as_bytes()).is_ok());
    }

    #[test]
    fn corners_need_a_normal_and_a_texture_coordinate_if_the_file_has_any() {
        let message = check_obj(format!("{SOLID}vn 0 0 1\n").as_bytes()).unwrap_err();
        assert!(message.contains("line 5: corner `1` has no normal"), "{message}");
        let message = check_obj(format!("vt 0 1\n{SOLID}").as_bytes()).unwrap_err();
        assert!(message.contains("line 6: corner `1` has no texture coordinate"), "{message}");
        let full = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvt 0 0\nvn 0 0 1\n\
            f 1/1/1 3/1/1 2/1/1\nf 1/1/1 2/1/1 4/1/1\nf 1/1/1 4/1/1 3/1/1\nf -3/-1/-1 -2/-1/-1 -1/-1/-1\n";
        assert!(check_obj(full.as_bytes()).is_ok());
        // a negative index to a vertex that is defined after the face
        let early = SOLID.replace("v 0 0 1\nf 1 3 2\n", "f 1 -4 2\nv 0 0 1\n");
        assert!(check_obj(early.as_bytes()).unwrap_err().starts_with("line 4: "), "{early}");
    }

    proptest! {
        /// A mesh that passes the check compiles or is a MuJoCo error; it never crashes MuJoCo.
        #[test]
        fn damaged_meshes_are_errors_or_compile(
            edits in prop::collection::vec(
                (any::<prop::sample::Index>(), prop::sample::select(b"\r\n\t /-+.#0123456789evfntgo".to_vec())),
                1..4,
            ),
            plain in any::<bool>(),
        ) {
            let full = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvt 0 1\nvn 0 0 1\n# end\rf 1/1/1 3/1/1 2/1/1\n\
                f -4/1/1 2/1/-1 4/1/1\nf 1/1/1 4/1/1 3/1/1 2/1/1\nf 2/1/1 3/1/1 4/1/1\n";
            let mut bytes = if plain { SOLID } else { full }.as_bytes().to_vec();
            for (place, letter) in edits {
                let place = place.index(bytes.len());
                bytes[place] = letter;
            }
            if check_obj(&bytes).is_ok() {
                let xml = "<mujoco><asset><mesh name='m' file='m.obj'/></asset>\
                    <worldbody><geom type='mesh' mesh='m' contype='0' conaffinity='0'/></worldbody></mujoco>";
                let _ = mujoco_rs::Model::from_xml_with_assets(xml, &Assets::new().with("m.obj", bytes));
            }
        }
    }
}
