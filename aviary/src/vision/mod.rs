//! Pictures of a world: onboard cameras for agents, views for people.
//!
//! They are drawn from a second model of the same scene with the same `qpos`, brought up to date when somebody looks,
//! so that meshes and cameras cost the physics nothing.

mod decor;
mod framing;
mod images;
mod scene_renderer;

pub(crate) use decor::ring;
pub use framing::CameraPose;
pub use images::{SeenObject, intrinsics};
pub use mujoco_rs::{Decor, ImageSize, VisualEffects};
pub use scene_renderer::SceneRenderer;

use crate::names::named_enum;

/// Size of the onboard cameras' pictures unless another is asked for (paper, §3.4.4).
pub const CAMERA_SIZE: ImageSize = ImageSize { width: 64, height: 48 };

named_enum! {
    "kind of picture"
    /// What a picture shows.
    ///
    /// ```
    /// use aviary::vision::ImageKind;
    ///
    /// assert_eq!("depth".parse::<ImageKind>()?, ImageKind::Depth);
    /// assert!("infrared".parse::<ImageKind>().is_err());
    /// # Ok::<(), aviary::UnknownName>(())
    /// ```
    pub enum ImageKind {
        /// Colour.
        Rgb = "rgb",
        /// Distance along the camera's axis.
        Depth = "depth",
        /// Which object.
        Segmentation = "segmentation",
    }
}

named_enum! {
    "camera"
    /// From where people look.
    ///
    /// ```
    /// use aviary::vision::View;
    ///
    /// assert_eq!("top".parse::<View>()?, View::Top);
    /// assert_eq!(View::ALL.map(View::name), ["track", "fpv", "fixed", "front", "top"]);
    /// # Ok::<(), aviary::UnknownName>(())
    /// ```
    #[derive(Default)]
    pub enum View {
        /// Following the drones, from behind and above.
        #[default]
        Track = "track",
        /// Through the onboard camera of the first drone.
        Fpv = "fpv",
        /// From the side and above, standing still, with all that is [kept in the frame](SceneRenderer::keep_in_frame).
        Fixed = "fixed",
        /// From the front, along −x, standing still: left and up in the picture are left and up in the world's yz plane
        /// as seen from there.
        Front = "front",
        /// From straight above, standing still: x to the right, y up.
        Top = "top",
    }
}
