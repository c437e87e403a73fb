//! Typed indices of the objects in a model.

use std::fmt;

/// Kind of object with a typed id.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum ObjectKind {
    /// Body.
    Body,
    /// Joint.
    Joint,
    /// Geom.
    Geom,
    /// Site.
    Site,
    /// Camera.
    Camera,
    /// Light.
    Light,
    /// Mesh.
    Mesh,
    /// Texture.
    Texture,
    /// Material.
    Material,
    /// Actuator.
    Actuator,
    /// Sensor.
    Sensor,
}

impl ObjectKind {
    /// Returns MuJoCo's number of the kind (`mjtObj`).
    pub(crate) fn code(self) -> u32 {
        use mujoco_sys::mjtObj_ as obj;
        match self {
            Self::Body => obj::mjOBJ_BODY,
            Self::Joint => obj::mjOBJ_JOINT,
            Self::Geom => obj::mjOBJ_GEOM,
            Self::Site => obj::mjOBJ_SITE,
            Self::Camera => obj::mjOBJ_CAMERA,
            Self::Light => obj::mjOBJ_LIGHT,
            Self::Mesh => obj::mjOBJ_MESH,
            Self::Texture => obj::mjOBJ_TEXTURE,
            Self::Material => obj::mjOBJ_MATERIAL,
            Self::Actuator => obj::mjOBJ_ACTUATOR,
            Self::Sensor => obj::mjOBJ_SENSOR,
        }
    }
}

impl fmt::Display for ObjectKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Body => "body",
            Self::Joint => "joint",
            Self::Geom => "geom",
            Self::Site => "site",
            Self::Camera => "camera",
            Self::Light => "light",
            Self::Mesh => "mesh",
            Self::Texture => "texture",
            Self::Material => "material",
            Self::Actuator => "actuator",
            Self::Sensor => "sensor",
        })
    }
}

mod sealed {
    pub trait Sealed {}
}

/// Index of an object of one kind. Only the id types of this crate implement it.
pub trait ObjectId: Copy + sealed::Sealed {
    /// Kind of object.
    const KIND: ObjectKind;

    /// Creates the id of the object at an index of the model's list.
    fn new(index: usize) -> Self;

    /// Returns the index in the model's list.
    fn get(self) -> usize;
}

macro_rules! ids {
    ($($name:ident: $kind:ident, $text:literal;)*) => {$(
        #[doc = concat!("Index of a ", $text, " in its model, as [`Model::find`](crate::Model::find) gives it.")]
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
        pub struct $name(usize);

        impl $name {
            /// Returns the index in the model's list, which is also the row in the arrays of this kind.
            #[inline]
            pub fn index(self) -> usize {
                self.0
            }
        }

        impl sealed::Sealed for $name {}

        impl ObjectId for $name {
            const KIND: ObjectKind = ObjectKind::$kind;

            #[inline]
            fn new(index: usize) -> Self {
                Self(index)
            }

            #[inline]
            fn get(self) -> usize {
                self.0
            }
        }
    )*};
}

ids! {
    BodyId: Body, "body";
    JointId: Joint, "joint";
    GeomId: Geom, "geom";
    SiteId: Site, "site";
    CameraId: Camera, "camera";
    LightId: Light, "light";
    MeshId: Mesh, "mesh";
    TextureId: Texture, "texture";
    MaterialId: Material, "material";
    ActuatorId: Actuator, "actuator";
    SensorId: Sensor, "sensor";
}
