//! Typed indices of the objects in a model.

use std::fmt;

/// The kinds of object that have a typed id.
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
    /// MuJoCo's number of the kind (`mjtObj`).
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

/// An index of one kind of object. Implemented by the id types of this crate only.
pub trait ObjectId: Copy + sealed::Sealed {
    /// The kind of object.
    const KIND: ObjectKind;

    /// The id of the object at this position of the model's list.
    fn new(index: usize) -> Self;

    /// The position in the model's list.
    fn get(self) -> usize;
}

macro_rules! ids {
    ($($name:ident: $kind:ident, $text:literal;)*) => {$(
        #[doc = concat!("Index of a ", $text, " in its model, as [`Model::find`](crate::Model::find) gives it.")]
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
        pub struct $name(usize);

        impl $name {
            /// The position in the model's list; row number of the arrays of that kind.
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
