//! MJCF text of a world.

mod xml;

use std::ops::RangeInclusive;
use std::path::PathBuf;

use mujoco_rs::{Assets, Integrator};

use super::visual_model::VisualModel;
use super::{Forcing, World};
use crate::drone::DroneError;
use xml::{Xml, numbers};

/// Error in a scene, found before MuJoCo compiles it.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum SceneError {
    /// A number out of range.
    #[error("{what} is {}, expected {expected}", crate::number(*got))]
    Value {
        /// Name of the quantity.
        what: String,
        /// Its value.
        got: f64,
        /// Range of valid values.
        expected: &'static str,
    },
    /// A drone with invalid parameters.
    #[error("drone {index}: {error}")]
    Drone {
        /// Index of the drone.
        index: usize,
        /// The invalid parameter.
        error: DroneError,
    },
    /// A mesh that cannot be read.
    #[error("{}: {message}", path.display())]
    Mesh {
        /// Path of the file.
        path: PathBuf,
        /// Reason.
        message: String,
    },
}

/// Sizes of MuJoCo's buffers. MuJoCo's defaults take 13 MB per simulation, which every reset clears.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Sizes {
    /// Number of contacts.
    contacts: usize,
    /// Number of scalar constraints.
    constraints: usize,
    /// Size of the stack, in numbers.
    stack: usize,
}

impl Sizes {
    /// Returns sufficient sizes for the fullest scene: every drone on the floor, with neighbours in contact on all
    /// sides.
    fn of(world: &World) -> Self {
        let drones = world.drones.len();
        // A cylinder meets a plane in up to four points. In a pile each drone has about four more contacts, and only
        // a few dozen drones pile up (the memory grows with the square of this number). An obstacle touches a drone
        // in one point.
        let on_each = world.slots().len().min(if drones <= 4 { 24 } else { 12 });
        let on_obstacles = on_each * drones.min(64);
        let contacts = 4 * drones + 4 * drones.min(64) + on_obstacles;
        // a pyramidal friction cone has four edges
        let constraints = 4 * contacts;
        let freedoms = 6 * drones;
        // the Newton solver's Hessian with its factor, and vectors; measured with the fullest scene (see the test
        // below)
        let stack = 1000 + 24 * (constraints + freedoms) + 5 * freedoms * freedoms;
        Self { contacts, constraints, stack }
    }
}

impl World {
    /// Returns the MJCF text of the physical scene: the floor and the collision geoms.
    ///
    /// The text places an upright obstacle at the origin 1 cm too high, because MuJoCo cannot move a geom that
    /// coincides with the world frame. Engines, rangefinders and renderers move it to its exact position after
    /// compilation.
    ///
    /// # Errors
    /// [`SceneError::Value`] for numbers that MuJoCo accepts silently and fails on later.
    pub fn to_mjcf(&self) -> Result<String, SceneError> {
        self.physical(&self.slots())
    }

    /// Returns the MJCF text of the physical scene with a geom for every obstacle.
    ///
    /// # Errors
    /// The errors of [`to_mjcf`](Self::to_mjcf).
    pub fn to_whole_mjcf(&self) -> Result<String, SceneError> {
        self.physical(&(0..self.obstacles.len()).collect::<Vec<_>>())
    }

    fn physical(&self, obstacles: &[usize]) -> Result<String, SceneError> {
        self.validate()?;
        let mut xml = Xml::new();
        xml.open("mujoco", &[("model", "aviary".into())]);
        self.physics(&mut xml);
        xml.open("worldbody", &[]);
        xml.leaf("geom", &[("name", "floor".into()), ("type", "plane".into()), ("size", "0 0 1".into())]);
        for &index in obstacles {
            xml.shape(World::obstacle_name(index), &self.obstacles[index], &[]);
        }
        for (index, drone) in self.drones.iter().enumerate() {
            xml.open_drone(index, drone);
            xml.collision_geom(index, drone, &[]);
            if self.forcing == Forcing::BodyFixed {
                xml.leaf("site", &[("name", World::drone_name(index))]);
            }
            xml.close("body");
        }
        xml.close("worldbody");
        if self.forcing == Forcing::BodyFixed {
            xml.rotors(self.drones.len());
        }
        xml.close("mujoco");
        Ok(xml.finish())
    }

    /// Returns the MJCF text of the visible scene and the files that it refers to.
    ///
    /// The visible scene has the bodies and the `qpos` of the physical scene, with meshes, materials, light, sky and
    /// cameras.
    ///
    /// # Errors
    /// [`SceneError::Mesh`] if the directory in [`CF2_ASSETS`](super::CF2_ASSETS) lacks a mesh or has one that MuJoCo
    /// would crash on, and the errors of [`to_mjcf`](Self::to_mjcf).
    pub fn to_visible_mjcf(&self) -> Result<(String, Assets), SceneError> {
        self.validate()?;
        let visual_models: Vec<_> = self.drones.iter().map(|drone| VisualModel::of(&drone.params)).collect();
        let mut xml = Xml::new();
        xml.open("mujoco", &[("model", "aviary".into())]);
        self.physics(&mut xml);
        // MuJoCo measures clip planes and fog in extents, here one metre
        xml.leaf("statistic", &[("extent", "1".into()), ("center", "0 0 1".into())]);
        xml.open("visual", &[]);
        let [near, far] = World::CLIP_PLANES;
        xml.leaf("map", &[("znear", near.to_string()), ("zfar", far.to_string()), ("haze", "0.2".into())]);
        xml.leaf(
            "headlight",
            &[
                ("ambient", "0.45 0.45 0.45".into()),
                ("diffuse", "0.25 0.25 0.25".into()),
                ("specular", "0.1 0.1 0.1".into()),
            ],
        );
        xml.leaf("rgba", &[("haze", "0.75 0.83 0.9 1".into())]);
        xml.close("visual");

        let files = xml.assets(&visual_models)?;

        xml.open("worldbody", &[]);
        xml.leaf(
            "light",
            &[
                ("name", "sun".into()),
                ("directional", "true".into()),
                ("pos", "0 0 4".into()),
                ("dir", "0.25 0.35 -1".into()),
                ("diffuse", "0.55 0.55 0.52".into()),
                ("specular", "0.3 0.3 0.3".into()),
            ],
        );
        // The third size is the grid spacing with which MuJoCo draws a plane. The light is directional, so that one
        // rectangle looks like ten thousand.
        xml.leaf(
            "geom",
            &[
                ("name", "floor".into()),
                ("type", "plane".into()),
                ("size", "1000 1000 2000".into()),
                ("material", "floor".into()),
            ],
        );
        xml.obstacles(&self.obstacles);
        for marker in &self.markers {
            xml.shape(
                marker.name.clone(),
                &marker.body,
                &[("group", World::VISUAL_GROUP.to_string()), ("contype", "0".into()), ("conaffinity", "0".into())],
            );
        }
        for (index, (drone, visual_model)) in self.drones.iter().zip(&visual_models).enumerate() {
            xml.open_drone(index, drone);
            xml.collision_geom(
                index,
                drone,
                &[("group", World::COLLISION_GROUP.to_string()), ("rgba", "1 0 0 0.3".into())],
            );
            let half = visual_model.turn / 2.0;
            for part in visual_model.parts {
                xml.leaf(
                    "geom",
                    &[
                        ("name", format!("{}_{}", World::drone_name(index), part.name)),
                        ("type", "mesh".into()),
                        ("mesh", visual_model.mesh_name(part)),
                        ("material", VisualModel::material_name(part)),
                        ("group", World::VISUAL_GROUP.to_string()),
                        ("contype", "0".into()),
                        ("conaffinity", "0".into()),
                        ("quat", numbers(&[half.cos(), 0.0, 0.0, half.sin()])),
                    ],
                );
            }
            xml.leaf(
                "camera",
                &[
                    ("name", World::camera_name(index)),
                    ("pos", numbers(&World::CAMERA_POSITION)),
                    ("xyaxes", "0 -1 0 0 0 1".into()),
                    ("fovy", World::CAMERA_FOVY.to_string()),
                ],
            );
            xml.close("body");
        }
        xml.close("worldbody");
        xml.close("mujoco");
        Ok((xml.finish(), files))
    }

    /// Writes the options and the buffer sizes.
    fn physics(&self, xml: &mut Xml) {
        xml.leaf("compiler", &[("angle", "radian".into()), ("inertiafromgeom", "false".into())]);
        let medium = self.medium.map_or((0.0, 0.0), |medium| (medium.density, medium.viscosity));
        let integrator = match self.integrator {
            Integrator::Euler => "Euler",
            Integrator::Rk4 => "RK4",
            Integrator::Implicit => "implicit",
        };
        xml.leaf(
            "option",
            &[
                ("timestep", self.timestep.to_string()),
                ("integrator", integrator.into()),
                ("gravity", format!("0 0 {}", -self.gravity)),
                ("density", medium.0.to_string()),
                ("viscosity", medium.1.to_string()),
            ],
        );
        let sizes = Sizes::of(self);
        xml.leaf(
            "size",
            &[
                ("nconmax", sizes.contacts.to_string()),
                ("njmax", sizes.constraints.to_string()),
                ("nstack", sizes.stack.to_string()),
            ],
        );
    }

    /// Checks every number that reaches MuJoCo. MuJoCo's compiler accepts any finite number, and its collision code
    /// does not terminate for some of them.
    fn validate(&self) -> Result<(), SceneError> {
        let value = |what: &str, got: f64, range: RangeInclusive<f64>, expected: &'static str| {
            // false for NaN
            if range.contains(&got) {
                return Ok(());
            }
            Err(SceneError::Value { what: what.to_string(), got, expected })
        };
        value("the time step", self.timestep, 1e-7..=1.0, "1e-7 to 1 s")?;
        let gravity = -World::MAX_GRAVITY..=World::MAX_GRAVITY;
        value("gravity", self.gravity, gravity, "a number within ±10,000 m/s²")?;
        if let Some(medium) = self.medium {
            value("the medium's density", medium.density, 0.0..=1e5, "0 to 100,000 kg/m³")?;
            value("the medium's viscosity", medium.viscosity, 0.0..=1e5, "0 to 100,000 Pa·s")?;
        }
        for (index, obstacle) in self.obstacles.iter().enumerate() {
            obstacle.validate(&format!("obstacle {index}"))?;
        }
        for marker in &self.markers {
            marker.body.validate(&format!("the marker `{}`", marker.name))?;
        }
        for (index, drone) in self.drones.iter().enumerate() {
            for &got in &drone.position {
                let range = -World::MAX_COORDINATE..=World::MAX_COORDINATE;
                value(&format!("the position of drone {index}"), got, range, "coordinates within ±100,000 m")?;
            }
            for &got in &drone.rpy {
                let range = -World::MAX_ANGLE..=World::MAX_ANGLE;
                value(&format!("the attitude of drone {index}"), got, range, "angles within ±1000 rad")?;
            }
            drone.params.validate().map_err(|error| SceneError::Drone { index, error })?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::super::{DroneBody, Medium};
    use super::*;
    use crate::drone::DroneModel;
    use mujoco_rs::{BodyId, Data, Model, WarningKind};
    use nalgebra::Vector3;
    use proptest::prelude::*;

    fn body(model: DroneModel, position: Vector3<f64>) -> DroneBody {
        DroneBody { params: model.params(), position, rpy: Vector3::zeros() }
    }

    #[test]
    fn the_compiled_scene_has_bit_identical_parameters() {
        let mut params = DroneModel::Race.params();
        params.mass = 0.1 + 0.2;
        params.inertia = [1.0 / 3.0 * 1e-4, 2.0 / 7.0 * 1e-4, 1e-4 * std::f64::consts::FRAC_1_SQRT_2 * 0.7];
        let drone =
            DroneBody { params: params.clone(), position: Vector3::new(0.1, -0.7, 1e-3), rpy: Vector3::zeros() };
        let mut world = World::new(vec![body(DroneModel::Cf2x, Vector3::z()), drone]);
        world.timestep = 1.0 / 333.0;
        world.medium = Some(Medium::AIR);
        let model = Model::from_xml(&world.to_mjcf().unwrap()).unwrap();
        let id: BodyId = model.find("drone1").unwrap();
        assert_eq!(model.timestep(), 1.0 / 333.0);
        assert_eq!((model.density(), model.viscosity()), (1.225, 1.8e-5));
        assert_eq!(model.integrator(), Some(Integrator::Rk4));
        assert_eq!(model.gravity(), [0.0, 0.0, -9.81]);
        assert_eq!(model.body_mass()[id.index()], params.mass);
        assert_eq!(model.body_inertia()[3 * id.index()..][..3], params.inertia);
        assert_eq!(model.body_pos()[3 * id.index()..][..3], [0.1, -0.7, 1e-3]);
        assert_eq!(model.body_ipos()[3 * id.index()..][..3], [0.0; 3]);
    }

    /// All drones fall onto the floor in a pile, with neighbours on all sides and on top.
    #[test]
    fn buffers_suffice_for_the_fullest_scene() {
        for count in [1, 2, 7, 30, 64] {
            let side = (count as f64).sqrt().ceil() as usize;
            let drones = (0..count)
                .map(|i| {
                    let (x, y) = ((i % side) as f64, (i / side) as f64);
                    body(
                        DroneModel::Cf2x,
                        Vector3::new(0.119 * x + 0.05 * (y % 2.0), 0.105 * y, 0.016 + 0.031 * (i % 2) as f64),
                    )
                })
                .collect();
            let world = World::new(drones);
            let sizes = Sizes::of(&world);
            let mut data = Data::new(Model::from_xml(&world.to_mjcf().unwrap()).unwrap()).unwrap();
            for _ in 0..240 {
                data.step().unwrap();
            }
            assert!(data.max_contacts_used() >= count, "the drones have no contacts");
            for warning in [WarningKind::ContactFull, WarningKind::ConstraintFull] {
                assert_eq!(data.warning(warning).count, 0, "{warning:?} with {count} drones");
            }
            let (used, have) = (data.max_stack_used(), sizes.stack);
            assert!(used * 4 < have * 3, "stack {used} of {have} with {count} drones leaves too little room");
        }
    }

    #[test]
    fn one_drone_takes_at_most_a_quarter_of_a_megabyte() {
        let world = World::new(vec![body(DroneModel::Cf2x, Vector3::z())]);
        let data = Data::new(Model::from_xml(&world.to_mjcf().unwrap()).unwrap()).unwrap();
        assert!(data.bytes() < 250_000, "{}", data.bytes());
    }

    proptest! {
        #[test]
        fn errors_name_the_number_out_of_range(
            at in 0usize..8,
            bad in prop::sample::select(vec![f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 1e15, -1e15, 1e300]),
        ) {
            let mut world = World::new(vec![body(DroneModel::Cf2p, Vector3::z())]);
            match at {
                0 => world.timestep = bad,
                1 => world.gravity = bad,
                2 => world.medium = Some(Medium { density: bad, viscosity: 0.0 }),
                3 => world.medium = Some(Medium { density: 0.0, viscosity: bad }),
                4 | 5 => world.drones[0].position[at - 4] = bad,
                _ => world.drones[0].rpy[at - 6] = bad,
            }
            let text = world.to_mjcf().unwrap_err().to_string();
            prop_assert!(text.contains(&crate::number(bad)) && text.contains("expected"), "{}", text);
        }
    }
}
