//! Camera images: onboard cameras for agents, views for people.
//!
//! A renderer uses a second model of the same scene, whose `qpos` [`SceneRenderer::update`] sets. The model
//! that the physics steps therefore needs no visual meshes or cameras.

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

/// Default size of the images of the onboard cameras (paper, §3.4.4).
pub const CAMERA_SIZE: ImageSize = ImageSize { width: 64, height: 48 };

named_enum! {
    "image kind"
    /// Channel of an image: colour, depth or segmentation.
    ///
    /// ```
    /// use aviary::vision::ImageKind;
    ///
    /// assert_eq!("depth".parse::<ImageKind>()?, ImageKind::Depth);
    /// assert!("infrared".parse::<ImageKind>().is_err());
    /// # Ok::<(), aviary::UnknownName>(())
    /// ```
    pub enum ImageKind {
        /// RGB or RGBA colour.
        Rgb = "rgb",
        /// Depth along the camera's axis, m.
        Depth = "depth",
        /// Type and index of the object.
        Segmentation = "segmentation",
    }
}

named_enum! {
    "camera"
    /// Cameras for people.
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
        /// Camera behind and above the drones that follows them.
        #[default]
        Track = "track",
        /// Onboard camera of the first drone.
        Fpv = "fpv",
        /// Static camera from the side and above. [`SceneRenderer::keep_in_frame`] sets the points in its frame.
        Fixed = "fixed",
        /// Static camera from the front, looking along −x. The image shows the world's yz plane: +y points right
        /// and +z up.
        Front = "front",
        /// Static camera from straight above. +x points right and +y up.
        Top = "top",
    }
}
