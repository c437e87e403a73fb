//! How airframes look: meshes, materials, and where they come from.

use std::path::PathBuf;

use mujoco_rs::Assets;

use crate::drone::{Appearance, DroneParams, Layout};
use crate::world::SceneError;

/// Directory with another set of Crazyflie meshes, under the file names of MuJoCo Menagerie.
pub const CF2_ASSETS: &str = "MJ_DRONES_CF2_ASSETS";

/// One visible part of an airframe.
pub(super) struct Part {
    /// What it is, as segmentation names it.
    pub name: &'static str,
    /// File name of its mesh.
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
        Part {
            name: $name,
            file: $file,
            embedded: include_bytes!(concat!("../../../assets/", $directory, "/", $file)),
            rgba: $rgba,
            specular: $specular,
            shininess: $shininess,
        }
    };
}

/// The Crazyflie, part for part what the files of those names are in MuJoCo Menagerie.
static CRAZYFLIE: [Part; 7] = [
    part!("propellers", "cf2", "cf2_0.obj", [0.792, 0.820, 0.933, 1.0], 0.5, 0.5),
    part!("deck", "cf2", "cf2_1.obj", [0.109, 0.184, 0.0, 1.0], 0.5, 0.4),
    part!("pins", "cf2", "cf2_2.obj", [0.969, 0.878, 0.6, 1.0], 0.9, 0.7),
    part!("battery", "cf2", "cf2_3.obj", [0.631, 0.659, 0.678, 1.0], 0.6, 0.5),
    part!("motors", "cf2", "cf2_4.obj", [0.75, 0.75, 0.76, 1.0], 0.9, 0.7),
    part!("frame", "cf2", "cf2_5.obj", [0.102, 0.102, 0.102, 1.0], 0.35, 0.3),
    part!("mounts", "cf2", "cf2_6.obj", [1.0, 1.0, 1.0, 1.0], 0.3, 0.2),
];

static RACER: [Part; 7] = [
    part!("propellers", "race", "race_0.obj", [0.55, 0.85, 0.25, 1.0], 0.4, 0.4),
    part!("frame", "race", "race_1.obj", [0.09, 0.09, 0.10, 1.0], 0.45, 0.35),
    part!("motors", "race", "race_2.obj", [0.30, 0.31, 0.34, 1.0], 0.8, 0.6),
    part!("battery", "race", "race_3.obj", [0.17, 0.19, 0.26, 1.0], 0.3, 0.3),
    part!("stack", "race", "race_4.obj", [0.06, 0.16, 0.10, 1.0], 0.4, 0.3),
    part!("camera", "race", "race_5.obj", [0.16, 0.16, 0.18, 1.0], 0.6, 0.6),
    part!("accents", "race", "race_6.obj", [0.95, 0.32, 0.06, 1.0], 0.5, 0.4),
];

/// The look of one airframe in a scene: parts, and how they are turned and scaled to its size.
#[derive(Clone, Copy)]
pub(super) struct Look {
    pub parts: &'static [Part],
    appearance: Appearance,
    /// Size relative to the meshes.
    pub scale: f64,
    /// Rotation about z of the meshes, whose motors are on the diagonals, rad.
    pub turn: f64,
}

impl Look {
    pub(super) fn of(params: &DroneParams) -> Self {
        let (parts, arm): (&'static [Part], f64) = match params.appearance {
            Appearance::Crazyflie => (&CRAZYFLIE, 0.0397),
            Appearance::Racer => (&RACER, 0.125),
        };
        // motor 0 of the plus layout is in front, that of the X layout to the left of it
        let turn = match params.layout {
            Layout::X => 0.0,
            Layout::Plus => -std::f64::consts::FRAC_PI_4,
        };
        Self { parts, appearance: params.appearance, scale: params.arm_length / arm, turn }
    }

    /// Name of a part's mesh in the scene; airframes of equal look and size share it.
    pub(super) fn mesh_name(&self, part: &Part) -> String {
        format!("{}_x{}", part.file.trim_end_matches(".obj"), self.scale)
    }

    /// Name of a part's material in the scene.
    pub(super) fn material_name(part: &Part) -> String {
        format!("{}_material", part.file.trim_end_matches(".obj"))
    }

    /// Adds the parts' files, from the directory that the environment names or from the program itself.
    pub(super) fn add_files(&self, assets: &mut Assets) -> Result<(), SceneError> {
        let directory = match self.appearance {
            Appearance::Crazyflie => std::env::var_os(CF2_ASSETS).filter(|value| !value.is_empty()).map(PathBuf::from),
            Appearance::Racer => None,
        };
        for part in self.parts {
            let bytes = match &directory {
                None => part.embedded.to_vec(),
                Some(directory) => {
                    let path = directory.join(part.file);
                    let bytes = std::fs::read(&path)
                        .map_err(|error| SceneError::Mesh { path: path.clone(), message: error.to_string() })?;
                    check_obj(&bytes).map_err(|message| SceneError::Mesh { path, message })?;
                    bytes
                }
            };
            assets.insert(part.file, bytes);
        }
        Ok(())
    }
}

/// Checks what MuJoCo's reader takes on trust: it crashes on a mesh without faces and reads past the end of its
/// vertices where a face names one that is not there.
fn check_obj(bytes: &[u8]) -> Result<(), String> {
    let text = std::str::from_utf8(bytes).map_err(|_| "it is no OBJ file (not text)".to_string())?;
    let count = |key: &str| text.lines().filter(|line| line.split_whitespace().next() == Some(key)).count();
    let (vertices, textures, normals) = (count("v"), count("vt"), count("vn"));
    let mut faces = 0;
    for (number, line) in text.lines().enumerate() {
        let wrong = |what: &str| Err(format!("line {}: {what}", number + 1));
        let mut words = line.split_whitespace();
        match words.next() {
            Some("v" | "vn") => {
                let numbers: Vec<_> = words.take(3).map(str::parse::<f64>).collect();
                if numbers.len() < 3 || numbers.iter().any(|x| !x.as_ref().is_ok_and(|x| x.is_finite())) {
                    return wrong("expected three finite numbers");
                }
            }
            Some("f") => {
                let mut corners = 0;
                for corner in words {
                    corners += 1;
                    for (index, most) in corner.split('/').zip([vertices, textures, normals]) {
                        // a corner without texture or normal leaves its place empty
                        let there = match index.parse::<i64>() {
                            Ok(index) => index != 0 && index.unsigned_abs() <= most as u64,
                            Err(_) => index.is_empty(),
                        };
                        if !there {
                            return wrong(&format!("corner `{corner}` names nothing that is there"));
                        }
                    }
                }
                if corners < 3 {
                    return wrong("expected a face of at least three corners");
                }
                faces += 1;
            }
            _ => {}
        }
    }
    if vertices < 4 || faces < 4 {
        return Err(format!("{vertices} vertices and {faces} faces, expected at least 4 of each"));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn meshes_that_would_crash_the_reader_are_refused_by_line() {
        for part in CRAZYFLIE.iter().chain(&RACER) {
            check_obj(part.embedded).unwrap_or_else(|message| panic!("{}: {message}", part.file));
        }
        let solid = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n";
        assert!(check_obj(solid.as_bytes()).is_ok());
        let refused = |from: &str, to: &str| check_obj(solid.replace(from, to).as_bytes()).unwrap_err();
        assert!(refused("v 0 0 1", "v 0 0 nan").starts_with("line 4"));
        assert!(refused("v 0 0 1", "v 0 0").starts_with("line 4"));
        assert!(refused("f 2 3 4", "f 2 3 9").starts_with("line 8"));
        assert!(refused("f 2 3 4", "f 2 3 0").starts_with("line 8"));
        assert!(refused("f 2 3 4", "f 2//1 3//1 4//1").starts_with("line 8"));
        assert!(refused("f 2 3 4", "f 2 3").starts_with("line 8"));
        assert!(refused("f 2 3 4\n", "").contains("3 faces"));
        assert!(check_obj(b"v 0 0 0").unwrap_err().contains("1 vertices") && check_obj(&[0xff, 0xfe]).is_err());
    }

    proptest! {
        /// What passes the check compiles or is an error of MuJoCo's, and never a crash.
        #[test]
        fn damaged_meshes_are_refused_or_read(at in 0usize..120, letter in 32u8..127) {
            let mut bytes = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvn 0 0 1\nf 1//1 3//1 2//1\nf 1 2 4\nf 1 4 3\nf 2 3 4\n".to_vec();
            let place = at % bytes.len();
            bytes[place] = letter;
            if check_obj(&bytes).is_ok() {
                let xml = "<mujoco><asset><mesh name='m' file='m.obj'/></asset></mujoco>";
                let _ = mujoco_rs::Model::from_xml_with_assets(xml, &Assets::new().with("m.obj", bytes));
            }
        }
    }
}
