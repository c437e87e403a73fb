//! Writer of MJCF elements.

use std::collections::BTreeMap;
use std::io;

use mujoco_rs::Assets;
use nalgebra::Vector3;
use quick_xml::Writer;
use quick_xml::events::{BytesEnd, BytesStart, Event};

use super::SceneError;
use crate::state::{attitude_from_rpy, wxyz};
use crate::world::visual_model::VisualModel;
use crate::world::{DroneBody, Obstacle, World};

/// Writer of MJCF text. Writing to memory cannot fail, so that no method returns an error.
pub(super) struct Xml {
    writer: Writer<io::Cursor<Vec<u8>>>,
}

impl Xml {
    pub(super) fn new() -> Self {
        Self { writer: Writer::new_with_indent(io::Cursor::new(Vec::new()), b' ', 2) }
    }

    fn event(&mut self, event: Event<'_>) {
        self.writer.write_event(event).expect("writing to memory cannot fail");
    }

    fn element<'a>(name: &'a str, attributes: &[(&str, String)]) -> BytesStart<'a> {
        BytesStart::new(name).with_attributes(attributes.iter().map(|(key, value)| (*key, value.as_str())))
    }

    pub(super) fn open(&mut self, name: &str, attributes: &[(&str, String)]) {
        self.event(Event::Start(Self::element(name, attributes)));
    }

    pub(super) fn leaf(&mut self, name: &str, attributes: &[(&str, String)]) {
        self.event(Event::Empty(Self::element(name, attributes)));
    }

    pub(super) fn close(&mut self, name: &str) {
        self.event(Event::End(BytesEnd::new(name)));
    }

    pub(super) fn open_drone(&mut self, index: usize, drone: &DroneBody) {
        let name = World::drone_name(index);
        let params = &drone.params;
        self.open(
            "body",
            &[
                ("name", name.clone()),
                ("pos", vector(&drone.position)),
                ("quat", numbers(&wxyz(&attitude_from_rpy(drone.rpy)))),
            ],
        );
        self.leaf("freejoint", &[("name", name)]);
        self.leaf(
            "inertial",
            &[("pos", "0 0 0".into()), ("mass", params.mass.to_string()), ("diaginertia", numbers(&params.inertia))],
        );
    }

    pub(super) fn obstacles(&mut self, obstacles: &[Obstacle]) {
        for (index, obstacle) in obstacles.iter().enumerate() {
            self.shape(World::obstacle_name(index), obstacle, &[]);
        }
    }

    pub(super) fn shape(&mut self, name: String, obstacle: &Obstacle, more: &[(&str, String)]) {
        let (kind, size) = obstacle.shape.geom();
        // MuJoCo marks a geom that coincides with the world frame as such, and cannot move it after compilation
        let mut position = obstacle.position;
        if position.norm() < 1e-3 && obstacle.rpy.norm() < 1e-3 {
            position.z += 0.01;
        }
        let own = [
            ("name", name),
            ("type", kind.into()),
            ("size", numbers(&size)),
            ("pos", vector(&position)),
            ("quat", numbers(&wxyz(&attitude_from_rpy(obstacle.rpy)))),
            ("rgba", numbers(&obstacle.rgba)),
        ];
        self.leaf("geom", &[&own[..], more].concat());
    }

    pub(super) fn rotors(&mut self, drones: usize) {
        self.open("actuator", &[]);
        for index in 0..drones {
            let gears = ["0 0 1 0 0 0", "0 0 0 1 0 0", "0 0 0 0 1 0", "0 0 0 0 0 1"];
            for (name, gear) in World::actuator_names(index).into_iter().zip(gears) {
                self.leaf("motor", &[("name", name), ("site", World::drone_name(index)), ("gear", gear.into())]);
            }
        }
        self.close("actuator");
    }

    pub(super) fn collision_geom(&mut self, index: usize, drone: &DroneBody, more: &[(&str, String)]) {
        let params = &drone.params;
        let cylinder = [
            ("name", World::drone_name(index)),
            ("type", "cylinder".into()),
            ("size", numbers(&[params.collision_radius, params.collision_height / 2.0])),
        ];
        self.leaf("geom", &[&cylinder, more].concat());
    }

    /// Writes the sky, the floor, and each mesh and material of these visual models once.
    pub(super) fn assets(&mut self, visual_models: &[VisualModel]) -> Result<Assets, SceneError> {
        self.open("asset", &[]);
        self.leaf(
            "texture",
            &[
                ("type", "skybox".into()),
                ("builtin", "gradient".into()),
                ("rgb1", "0.75 0.83 0.9".into()),
                ("rgb2", "0.3 0.48 0.68".into()),
                ("width", "128".into()),
                ("height", "768".into()),
            ],
        );
        self.leaf(
            "texture",
            &[
                ("name", "floor".into()),
                ("type", "2d".into()),
                ("builtin", "checker".into()),
                ("rgb1", "0.60 0.62 0.64".into()),
                ("rgb2", "0.53 0.55 0.57".into()),
                ("mark", "edge".into()),
                ("markrgb", "0.68 0.70 0.72".into()),
                ("width", "256".into()),
                ("height", "256".into()),
            ],
        );
        // one texture has two squares of half a metre per side
        self.leaf(
            "material",
            &[
                ("name", "floor".into()),
                ("texture", "floor".into()),
                ("texuniform", "true".into()),
                ("texrepeat", "1 1".into()),
                ("specular", "0".into()),
                ("reflectance", "0.1".into()),
            ],
        );
        let mut files = Assets::new();
        let (mut meshes, mut materials) = (BTreeMap::new(), BTreeMap::new());
        for visual_model in visual_models {
            let mut is_new_file = false;
            for part in visual_model.parts {
                meshes.entry(visual_model.mesh_name(part)).or_insert((part.file, visual_model.scale));
                is_new_file |= materials.insert(VisualModel::material_name(part), part).is_none();
            }
            if is_new_file {
                visual_model.add_files(&mut files)?;
            }
        }
        for (name, (file, scale)) in meshes {
            self.leaf("mesh", &[("name", name), ("file", file.to_string()), ("scale", numbers(&[scale; 3]))]);
        }
        for (name, part) in materials {
            self.leaf(
                "material",
                &[
                    ("name", name),
                    ("rgba", numbers(&part.rgba)),
                    ("specular", part.specular.to_string()),
                    ("shininess", part.shininess.to_string()),
                ],
            );
        }
        self.close("asset");
        Ok(files)
    }

    pub(super) fn finish(self) -> String {
        String::from_utf8(self.writer.into_inner().into_inner()).expect("only text was written")
    }
}

/// Formats numbers for MJCF; Rust prints the shortest text that parses to the same bits.
pub(super) fn numbers(values: &[f64]) -> String {
    values.iter().map(f64::to_string).collect::<Vec<_>>().join(" ")
}

pub(super) fn vector(values: &Vector3<f64>) -> String {
    numbers(values.as_slice())
}
