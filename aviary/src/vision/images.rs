//! Images of a scene: colour, depth and objects, from views and from onboard cameras.

use mujoco_rs::{Data, Error, GeomId, ImageSize, ObjectId as _};

use super::{SceneRenderer, View};
use crate::world::World;

/// What a camera saw of an object: a geom of the scene.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct SeenObject {
    /// The second number of a segmentation pixel.
    pub index: i32,
    /// Name in the scene: `floor`, `drone0_propellers`, …
    pub name: String,
    /// The drone it belongs to.
    pub drone: Option<usize>,
}

impl SceneRenderer {
    /// A picture from a view: RGB, three bytes per pixel, top row first.
    ///
    /// # Errors
    /// [`Error::NoCamera`] before the first [`update`](Self::update), [`Error::Buffer`] for a buffer of the wrong length,
    /// [`Error::Value`] for sides that are not 1 to 8192 pixels.
    pub fn rgb(&mut self, view: View, size: ImageSize, out: &mut [u8]) -> Result<(), Error> {
        self.look(view, size)?;
        self.renderer.rgb(&mut self.scene, size, out)
    }

    /// Depth from a view, m along the camera's axis, top row first; the far plane's distance where there is nothing.
    ///
    /// # Errors
    /// As for [`rgb`](Self::rgb).
    pub fn depth(&mut self, view: View, size: ImageSize, out: &mut [f32]) -> Result<(), Error> {
        self.look(view, size)?;
        self.renderer.depth(&mut self.scene, size, out)
    }

    /// Objects from a view, `[type, index]` per pixel, −1 twice where there is nothing, top row first.
    ///
    /// # Errors
    /// As for [`rgb`](Self::rgb), and [`Error::Multisampled`] for a renderer for people.
    pub fn segmentation(&mut self, view: View, size: ImageSize, out: &mut [[i32; 2]]) -> Result<(), Error> {
        self.look(view, size)?;
        self.renderer.segmentation(&mut self.scene, size, out)
    }

    /// What a drone's onboard camera sees: RGBA, four bytes per pixel, alpha 255, top row first.
    ///
    /// # Errors
    /// As for [`rgb`](Self::rgb).
    ///
    /// # Panics
    /// If there is no drone of that index; likewise below.
    pub fn onboard_rgba(&mut self, drone: usize, size: ImageSize, out: &mut [u8]) -> Result<(), Error> {
        self.look_from_board(drone)?;
        self.renderer.rgba(&mut self.scene, size, out)
    }

    /// What a drone's onboard camera sees: depth, m along its axis, top row first.
    ///
    /// # Errors
    /// As for [`rgb`](Self::rgb).
    pub fn onboard_depth(&mut self, drone: usize, size: ImageSize, out: &mut [f32]) -> Result<(), Error> {
        self.look_from_board(drone)?;
        self.renderer.depth(&mut self.scene, size, out)
    }

    /// What a drone's onboard camera sees: objects, `[type, index]` per pixel, top row first.
    ///
    /// # Errors
    /// As for [`segmentation`](Self::segmentation).
    pub fn onboard_segmentation(&mut self, drone: usize, size: ImageSize, out: &mut [[i32; 2]]) -> Result<(), Error> {
        self.look_from_board(drone)?;
        self.renderer.segmentation(&mut self.scene, size, out)
    }

    /// Every geom that can be seen, by the index that segmentation gives it.
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

    /// The visible scene's simulation, for rays.
    pub fn data(&self) -> &Data {
        &self.data
    }
}

/// Focal length and centre of a camera with square pixels, pixels: `[fx, fy, cx, cy]`; the centre is measured from the
/// top left corner of the picture.
///
/// ```
/// use aviary::vision::{CAMERA_SIZE, intrinsics};
///
/// // half of the picture's 48 rows are 30°
/// let [fx, fy, cx, cy] = intrinsics(CAMERA_SIZE);
/// assert!((fy - 24.0 / 30_f64.to_radians().tan()).abs() < 1e-9 && fx == fy);
/// assert_eq!([cx, cy], [32.0, 24.0]);
/// ```
pub fn intrinsics(size: ImageSize) -> [f64; 4] {
    let (width, height) = (f64::from(size.width), f64::from(size.height));
    let focal = height / 2.0 / (World::CAMERA_FOVY.to_radians() / 2.0).tan();
    [focal, focal, width / 2.0, height / 2.0]
}
