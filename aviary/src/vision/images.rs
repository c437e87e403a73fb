//! Images of a scene from views and onboard cameras: colour, depth and segmentation.

use mujoco_rs::{Data, Error, GeomId, ImageSize, ObjectId as _};

use super::{CameraPose, SceneRenderer, View};
use crate::world::World;

/// A visible object of a scene: one geom.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct SeenObject {
    /// Index in the second channel of a segmentation image.
    pub index: i32,
    /// Name in the scene: `floor`, `drone0_propellers`, …
    pub name: String,
    /// Index of the drone that the object belongs to; `None` for other objects.
    pub drone: Option<usize>,
}

impl SceneRenderer {
    /// Renders a view as RGB, three bytes per pixel, top row first.
    ///
    /// # Errors
    /// [`Error::NoCamera`] before the first [`update`](Self::update), [`Error::Buffer`] for a buffer of the wrong
    /// length, and [`Error::Value`] for an image side outside 1 to 8192 pixels.
    pub fn rgb(&mut self, view: View, size: ImageSize, out: &mut [u8]) -> Result<(), Error> {
        self.look(view, size)?;
        self.renderer.rgb(&mut self.scene, size, out)
    }

    /// Renders the scene from any camera pose as RGBA, four bytes per pixel, alpha 255, top row first.
    ///
    /// # Errors
    /// Returns the errors of [`rgb`](Self::rgb), and [`Error::Value`] for a pose that is not finite or whose distance
    /// is not positive.
    pub fn pose_rgba(&mut self, pose: &CameraPose, size: ImageSize, out: &mut [u8]) -> Result<(), Error> {
        self.seen_from(&pose.camera(), None)?;
        self.renderer.rgba(&mut self.scene, size, out)
    }

    /// Renders the depth of a view, m along the camera's axis, top row first. The background has the distance of
    /// the far clipping plane.
    ///
    /// # Errors
    /// Returns the errors of [`rgb`](Self::rgb).
    pub fn depth(&mut self, view: View, size: ImageSize, out: &mut [f32]) -> Result<(), Error> {
        self.look(view, size)?;
        self.renderer.depth(&mut self.scene, size, out)
    }

    /// Renders the segmentation of a view, `[type, index]` per pixel, top row first. The background is `[-1, -1]`.
    ///
    /// # Errors
    /// Returns the errors of [`rgb`](Self::rgb), and [`Error::Multisampled`] for a renderer with several samples
    /// per pixel.
    pub fn segmentation(&mut self, view: View, size: ImageSize, out: &mut [[i32; 2]]) -> Result<(), Error> {
        self.look(view, size)?;
        self.renderer.segmentation(&mut self.scene, size, out)
    }

    /// Renders the onboard camera of a drone as RGBA, four bytes per pixel, alpha 255, top row first.
    ///
    /// # Errors
    /// Returns the errors of [`rgb`](Self::rgb).
    ///
    /// # Panics
    /// If no drone has the index.
    pub fn onboard_rgba(&mut self, drone: usize, size: ImageSize, out: &mut [u8]) -> Result<(), Error> {
        self.look_from_board(drone)?;
        self.renderer.rgba(&mut self.scene, size, out)
    }

    /// Renders the depth of a drone's onboard camera, m along the camera's axis, top row first.
    ///
    /// # Errors
    /// Returns the errors of [`rgb`](Self::rgb).
    ///
    /// # Panics
    /// If no drone has the index.
    pub fn onboard_depth(&mut self, drone: usize, size: ImageSize, out: &mut [f32]) -> Result<(), Error> {
        self.look_from_board(drone)?;
        self.renderer.depth(&mut self.scene, size, out)
    }

    /// Renders the segmentation of a drone's onboard camera, `[type, index]` per pixel, top row first.
    ///
    /// # Errors
    /// Returns the errors of [`segmentation`](Self::segmentation).
    ///
    /// # Panics
    /// If no drone has the index.
    pub fn onboard_segmentation(&mut self, drone: usize, size: ImageSize, out: &mut [[i32; 2]]) -> Result<(), Error> {
        self.look_from_board(drone)?;
        self.renderer.segmentation(&mut self.scene, size, out)
    }

    /// Returns all visible geoms, with their indices in segmentation images.
    pub fn objects(&self) -> Vec<SeenObject> {
        let model = self.data.model();
        (0..model.ngeom())
            .filter(|&geom| model.geom_group()[geom] != World::COLLISION_GROUP as i32)
            .map(|geom| {
                let body = model.geom_bodyid()[geom];
                SeenObject {
                    index: geom as i32,
                    name: model.name(GeomId::new(geom)).unwrap_or_default().to_string(),
                    drone: self.bodies.iter().position(|drone| drone.index() as i32 == body),
                }
            })
            .collect()
    }

    /// Returns the simulation of the visible scene, for ray casts.
    pub fn data(&self) -> &Data {
        &self.data
    }
}

/// Returns the intrinsics of an onboard camera with square pixels, `[fx, fy, cx, cy]`, pixels. The centre is
/// relative to the top left corner of the image.
///
/// ```
/// use aviary::vision::{CAMERA_SIZE, intrinsics};
///
/// // half of the image's 48 rows span 30°
/// let [fx, fy, cx, cy] = intrinsics(CAMERA_SIZE);
/// assert!((fy - 24.0 / 30_f64.to_radians().tan()).abs() < 1e-9 && fx == fy);
/// assert_eq!([cx, cy], [32.0, 24.0]);
/// ```
pub fn intrinsics(size: ImageSize) -> [f64; 4] {
    let (width, height) = (f64::from(size.width), f64::from(size.height));
    let focal = height / 2.0 / (World::CAMERA_FOVY.to_radians() / 2.0).tan();
    [focal, focal, width / 2.0, height / 2.0]
}
