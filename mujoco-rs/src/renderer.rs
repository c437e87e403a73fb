//! Off-screen rendering of scenes into the caller's buffers.

use std::mem::MaybeUninit;
use std::sync::Arc;

use crate::error::Error;
use crate::gl::{GlContext, Limits, drawing, limits, loading};
use crate::model::Model;
use crate::runtime::guarded;
use crate::scene::Scene;

/// Quality settings of a [`Renderer`], fixed at its creation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Quality {
    /// Samples per pixel, up to [`MAX_SAMPLES`](Self::MAX_SAMPLES); 0 disables multisampling. Clamped to the
    /// driver's maximum (4 for Mesa's software rasterizer).
    pub samples: u32,
    /// Side of the shadow map in texels, up to [`MAX_SHADOW_MAP`](Self::MAX_SHADOW_MAP) and the driver's limit for
    /// textures; 0 disables shadows.
    pub shadow_map: u32,
}

impl Quality {
    /// Largest number of samples per pixel.
    pub const MAX_SAMPLES: u32 = 64;
    /// Largest side of the shadow map, texels.
    pub const MAX_SHADOW_MAP: u32 = 16_384;
    /// Settings for observations: no multisampling, no shadows.
    pub const FAST: Self = Self { samples: 0, shadow_map: 0 };
    /// Settings for videos and figures: four samples, soft shadows.
    pub const PRETTY: Self = Self { samples: 4, shadow_map: 2048 };
}

/// Width and height of an image, pixels.
///
/// ```
/// use mujoco_rs::ImageSize;
///
/// let size = ImageSize { width: 64, height: 48 };
/// assert_eq!((size.pixels(), size.to_string().as_str()), (3072, "64x48"));
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct ImageSize {
    /// Number of columns.
    pub width: u32,
    /// Number of rows.
    pub height: u32,
}

impl ImageSize {
    /// Largest side. Drivers may have too little memory for an image of this size.
    pub const MAX_SIDE: u32 = 8192;

    /// Returns the number of pixels.
    pub fn pixels(self) -> usize {
        self.width as usize * self.height as usize
    }
}

impl std::fmt::Display for ImageSize {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}x{}", self.width, self.height)
    }
}

/// OpenGL context with the meshes and textures of one model.
///
/// A renderer may be created, used and dropped on any thread, and several renderers may draw at the same time.
///
/// ```
/// use mujoco_rs::{Camera, Data, ImageSize, Model, Quality, Renderer, Scene};
///
/// # if mujoco_rs::gl_info().is_err() { return Ok(()); } // no OpenGL on this machine
/// let model = Model::from_xml("<mujoco><worldbody><geom type='box' size='.5 .5 .5'/></worldbody></mujoco>")?;
/// let mut data = Data::new(model)?;
/// data.forward()?;
/// let mut scene = Scene::new(data.shared_model(), 0)?;
/// // view along y, from 2 m in front of the centre of the box
/// let camera = Camera::Free { lookat: [0.0; 3], distance: 2.0, azimuth: 90.0, elevation: 0.0 };
/// scene.update(&mut data, &camera)?;
/// let mut renderer = Renderer::new(data.shared_model(), Quality::FAST)?;
/// let size = ImageSize { width: 33, height: 33 };
/// let mut depth = vec![0.0; size.pixels()];
/// renderer.depth(&mut scene, size, &mut depth)?;
/// assert!((depth[depth.len() / 2] - 1.5).abs() < 1e-3, "the front face");
/// # Ok::<(), mujoco_rs::Error>(())
/// ```
pub struct Renderer {
    // drop order: MuJoCo's objects need the context
    raw: Raw,
    gl: GlContext,
    model: Arc<Model>,
    quality: Quality,
    size: ImageSize,
    /// Half of the side of the area that the shadow map covers, m; `None` for the model's value.
    shadow_reach: Option<f32>,
    /// Scratch buffer: pixels before they are flipped, and colours of the segmentation.
    scratch: Vec<u8>,
}

struct Raw(Box<mujoco_sys::mjrContext>);

// SAFETY: names of OpenGL objects, used only while their context is current.
unsafe impl Send for Raw {}

impl Renderer {
    /// Creates a renderer of a model's scenes. Its buffer grows to the largest image drawn.
    ///
    /// # Errors
    /// - The errors of [`gl_info`](crate::gl_info) if OpenGL is unavailable.
    /// - [`Error::Value`] if the quality, or the model's `visual/quality`, is out of range.
    /// - [`Error::Gl`] if OpenGL fails or its limits are too small.
    /// - [`Error::Raised`] with MuJoCo's message.
    pub fn new(model: impl Into<Arc<Model>>, quality: Quality) -> Result<Self, Error> {
        crate::check_library()?;
        let model = model.into();
        check_quality(&model, quality, limits()?)?;
        let gl = GlContext::new()?;
        let size = ImageSize { width: 64, height: 48 };
        let raw = gl.current(|| make(&model, quality, size))??;
        Ok(Self { raw, gl, model, quality, size, shadow_reach: None, scratch: Vec::new() })
    }

    /// Returns the OpenGL context of the renderer, to keep it current during several images.
    pub fn context(&self) -> RendererContext {
        RendererContext(self.gl.clone())
    }

    /// Sets the reach of shadows, m: half of the side of the square that the shadow map of a directional light
    /// covers, around the light's axis. Replaces the model's `shadowclip`.
    ///
    /// # Errors
    /// [`Error::Value`] unless the reach is positive and finite.
    pub fn set_shadow_reach(&mut self, metres: f64) -> Result<(), Error> {
        if !(metres.is_finite() && metres > 0.0) {
            let what = "the reach of shadows";
            return Err(Error::Value { what, got: metres, expected: "a positive number of metres" });
        }
        self.shadow_reach = Some(metres as f32);
        Ok(())
    }

    /// Renders a scene as RGB, three bytes per pixel, top row first.
    ///
    /// # Errors
    /// - [`Error::Value`] if a side is outside 1 to 8192 pixels.
    /// - [`Error::Buffer`] if the buffer has the wrong length.
    /// - [`Error::OtherModel`] if the scene belongs to another model.
    /// - [`Error::NoCamera`] if the scene has not been updated.
    /// - [`Error::Gl`] and [`Error::Raised`] if OpenGL or MuJoCo fails.
    pub fn rgb(&mut self, scene: &mut Scene, size: ImageSize, rgb: &mut [u8]) -> Result<(), Error> {
        check_size(size)?;
        check_length("RGB", rgb.len(), 3 * size.pixels())?;
        self.draw(scene, size, Some(rgb), None)?;
        flip(rgb, 3 * size.width as usize, &mut self.scratch);
        Ok(())
    }

    /// Renders a scene as RGBA, four bytes per pixel, top row first; alpha is 255.
    ///
    /// # Errors
    /// As for [`rgb`](Self::rgb).
    pub fn rgba(&mut self, scene: &mut Scene, size: ImageSize, rgba: &mut [u8]) -> Result<(), Error> {
        check_size(size)?;
        check_length("RGBA", rgba.len(), 4 * size.pixels())?;
        let mut rgb = std::mem::take(&mut self.scratch);
        rgb.resize(3 * size.pixels(), 0);
        let drawn = self.draw(scene, size, Some(&mut rgb), None);
        if drawn.is_ok() && !rgb.is_empty() {
            let width = size.width as usize;
            for (from, to) in rgb.chunks_exact(3 * width).rev().zip(rgba.chunks_exact_mut(4 * width)) {
                for (from, to) in from.chunks_exact(3).zip(to.chunks_exact_mut(4)) {
                    to.copy_from_slice(&[from[0], from[1], from[2], 255]);
                }
            }
        }
        self.scratch = rgb;
        drawn
    }

    /// Renders a scene as depth, m, top row first: the distance from the camera **along its axis** (not along the
    /// ray). Pixels without a geom, including the sky, have the distance of the far plane.
    ///
    /// The depth buffer has 24 bits over a perspective scale: its resolution is z²/near · 2⁻²⁴, 0.6 mm at 10 m and
    /// 15 mm at 50 m for a near plane at 1 cm.
    ///
    /// # Errors
    /// As for [`rgb`](Self::rgb).
    pub fn depth(&mut self, scene: &mut Scene, size: ImageSize, depth: &mut [f32]) -> Result<(), Error> {
        use mujoco_sys::mjtRndFlag_ as flag;
        check_size(size)?;
        check_length("depth", depth.len(), size.pixels())?;
        // MuJoCo would draw the sky as a box at a distance of some metres
        let effects = scene.raw.flags;
        for flag in [flag::mjRND_SKYBOX, flag::mjRND_HAZE, flag::mjRND_REFLECTION, flag::mjRND_SHADOW] {
            scene.raw.flags[flag as usize] = 0;
        }
        let drawn = self.draw(scene, size, None, Some(depth));
        scene.raw.flags = effects;
        drawn?;
        let [near, far] = scene.clip_planes();
        // d = (1 − near/z) / (1 − near/far), the perspective projection's depth, solved for z
        let slope = 1.0 - near / far;
        for value in depth.iter_mut() {
            // rounding must not exceed the far plane
            *value = (near / (1.0 - f64::from(*value) * slope)).min(far) as f32;
        }
        let width = size.width as usize;
        let rows = size.height as usize;
        for row in 0..rows / 2 {
            let (top, bottom) = depth.split_at_mut((rows - 1 - row) * width);
            top[row * width..][..width].swap_with_slice(&mut bottom[..width]);
        }
        Ok(())
    }

    /// Renders a segmentation: `[type, index]` of each pixel's object (`mjtObj`; a geom is 5), `[-1, -1]` for the
    /// background, top row first.
    ///
    /// # Errors
    /// As for [`rgb`](Self::rgb); [`Error::Multisampled`] if the renderer has several samples per pixel, which
    /// would mix the ids of neighbouring objects.
    pub fn segmentation(&mut self, scene: &mut Scene, size: ImageSize, objects: &mut [[i32; 2]]) -> Result<(), Error> {
        use mujoco_sys::mjtRndFlag_ as flag;
        check_size(size)?;
        check_length("segmentation", objects.len(), size.pixels())?;
        if self.quality.samples > 0 {
            return Err(Error::Multisampled);
        }
        let mut rgb = std::mem::take(&mut self.scratch);
        rgb.resize(3 * size.pixels(), 0);
        for flag in [flag::mjRND_SEGMENT, flag::mjRND_IDCOLOR] {
            scene.raw.flags[flag as usize] = 1;
        }
        let drawn = self.draw(scene, size, Some(&mut rgb), None);
        for flag in [flag::mjRND_SEGMENT, flag::mjRND_IDCOLOR] {
            scene.raw.flags[flag as usize] = 0;
        }
        if drawn.is_ok() {
            let width = size.width as usize;
            let mut last = (0, [-1, -1]);
            for (from, to) in rgb.chunks_exact(3 * width).rev().zip(objects.chunks_exact_mut(width)) {
                for (colour, object) in from.chunks_exact(3).zip(to) {
                    let colour = u32::from_le_bytes([colour[0], colour[1], colour[2], 0]);
                    if colour != last.0 {
                        last = (colour, scene.object(colour));
                    }
                    *object = last.1;
                }
            }
        }
        self.scratch = rgb;
        drawn
    }

    fn draw(
        &mut self,
        scene: &mut Scene,
        size: ImageSize,
        rgb: Option<&mut [u8]>,
        depth: Option<&mut [f32]>,
    ) -> Result<(), Error> {
        // a copy has the same meshes and textures, and the scene contains the numbers changed in the copy
        if !self.model.is_copy_of(scene.model()) {
            return Err(Error::OtherModel);
        }
        if !scene.has_camera() {
            return Err(Error::NoCamera);
        }
        self.grow(size)?;
        let rgb = rgb.map_or(std::ptr::null_mut(), <[u8]>::as_mut_ptr);
        let depth = depth.map_or(std::ptr::null_mut(), <[f32]>::as_mut_ptr);
        let viewport = mujoco_sys::mjrRect { left: 0, bottom: 0, width: size.width as i32, height: size.height as i32 };
        let raw = &mut self.raw.0;
        raw.shadowClip = self.shadow_reach.unwrap_or(raw.shadowClip);
        let passes = if self.quality.shadow_map > 0 { scene.passes() } else { 1.0 };
        scene.scale_lines(1.0 / passes);
        let drawn = self.gl.current(|| {
            let _lock = drawing();
            // SAFETY: the context is current, the scene belongs to the context's model, and the buffers are null or
            // have the length of the viewport, which the callers have checked.
            let status = unsafe { mujoco_sys::mjshim_draw(viewport, &mut *scene.raw, &mut **raw, rgb, depth) };
            guarded("mjr_render", status)
        });
        scene.scale_lines(passes);
        drawn?
    }

    /// Enlarges the buffer to an image of this size.
    fn grow(&mut self, size: ImageSize) -> Result<(), Error> {
        if size.width <= self.size.width && size.height <= self.size.height {
            return Ok(());
        }
        let size = ImageSize { width: size.width.max(self.size.width), height: size.height.max(self.size.height) };
        let max = limits()?.image;
        if size.width.max(size.height) > max {
            return Err(Error::Gl {
                message: format!("an image of {size} pixels exceeds this driver's limit of {max} per side"),
            });
        }
        let (raw, model, quality) = (&mut self.raw, &self.model, self.quality);
        self.gl.current(|| {
            let larger = make(model, quality, size)?;
            free(&mut std::mem::replace(raw, larger));
            Ok(())
        })??;
        self.size = size;
        Ok(())
    }
}

/// OpenGL context of a [`Renderer`].
#[derive(Clone)]
pub struct RendererContext(GlContext);

impl RendererContext {
    /// Runs work with the context current on the calling thread. The renderer makes its context current for every image
    /// otherwise, which takes a noticeable part of the time of a small image.
    ///
    /// The work may draw with other renderers, too. The renderer cannot draw on other threads meanwhile.
    ///
    /// ```
    /// use mujoco_rs::{Camera, Data, ImageSize, Model, Quality, Renderer, Scene};
    ///
    /// # if mujoco_rs::gl_info().is_err() { return Ok(()); } // no OpenGL on this machine
    /// let mut data = Data::new(Model::from_xml("<mujoco><worldbody><geom size='.5'/></worldbody></mujoco>")?)?;
    /// let mut scene = Scene::new(data.shared_model(), 0)?;
    /// let mut renderer = Renderer::new(data.shared_model(), Quality::FAST)?;
    /// let size = ImageSize { width: 64, height: 48 };
    /// let mut images = vec![0; 8 * 3 * size.pixels()];
    /// renderer.context().keep_current(|| {
    ///     for (index, rgb) in images.chunks_exact_mut(3 * size.pixels()).enumerate() {
    ///         let azimuth = 45.0 * index as f64;
    ///         let camera = Camera::Free { lookat: [0.0; 3], distance: 2.0, azimuth, elevation: 0.0 };
    ///         data.kinematics()?;
    ///         scene.update(&mut data, &camera)?;
    ///         renderer.rgb(&mut scene, size, rgb)?;
    ///     }
    ///     Ok::<(), mujoco_rs::Error>(())
    /// })??;
    /// # Ok::<(), mujoco_rs::Error>(())
    /// ```
    ///
    /// # Errors
    /// [`Error::Gl`] if OpenGL fails or the context is in use on another thread.
    pub fn keep_current<T>(&self, work: impl FnOnce() -> T) -> Result<T, Error> {
        self.0.current(work)
    }
}

impl std::fmt::Debug for RendererContext {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("RendererContext").finish_non_exhaustive()
    }
}

impl Drop for Renderer {
    fn drop(&mut self) {
        let raw = &mut self.raw;
        // if the context cannot be made current, its objects are gone already
        let _ = self.gl.current(|| free(raw));
    }
}

impl std::fmt::Debug for Renderer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Renderer").field("quality", &self.quality).field("size", &self.size).finish_non_exhaustive()
    }
}

/// Creates MuJoCo's objects in the current context.
fn make(model: &Model, quality: Quality, size: ImageSize) -> Result<Raw, Error> {
    let max_samples = limits()?.samples;
    let _lock = loading();
    // MuJoCo reads sizes and quality from the model. This copy of the model's header shares the arrays, is only
    // read, and is never freed.
    // SAFETY: a bitwise copy of plain C data.
    let mut header = unsafe { MaybeUninit::new(std::ptr::read(model.as_ptr())).assume_init() };
    header.vis.global.offwidth = size.width as i32;
    header.vis.global.offheight = size.height as i32;
    header.vis.quality.offsamples = quality.samples.min(max_samples) as i32;
    header.vis.quality.shadowsize = quality.shadow_map as i32;
    let mut raw: Box<MaybeUninit<mujoco_sys::mjrContext>> = Box::new_uninit();
    // SAFETY: initializes the structure, then fills it; an OpenGL context is current.
    let mut raw = unsafe {
        mujoco_sys::mjr_defaultContext(raw.as_mut_ptr());
        guarded("mjr_makeContext", mujoco_sys::mjshim_make_context(&header, raw.as_mut_ptr()))?;
        Raw(raw.assume_init())
    };
    // SAFETY: reads the current context's error.
    let error = unsafe { mujoco_sys::mjr_getError() };
    if error != 0 {
        // SAFETY: created above in this context.
        unsafe { mujoco_sys::mjr_freeContext(&mut *raw.0) };
        return Err(Error::Gl { message: format!("OpenGL error {error:#06x} while the model was uploaded") });
    }
    Ok(raw)
}

/// Frees MuJoCo's objects in the current context.
fn free(raw: &mut Raw) {
    let _lock = drawing();
    // SAFETY: created in this context; a second call frees nothing.
    unsafe { mujoco_sys::mjr_freeContext(&mut *raw.0) };
}

/// Rejects settings that MuJoCo and drivers do not check: a shadow map whose size in bytes overflows, or display
/// lists without bound.
fn check_quality(model: &Model, quality: Quality, limits: Limits) -> Result<(), Error> {
    let own = model.raw().vis.quality;
    for (what, got, range, expected) in [
        ("the number of samples", quality.samples.into(), 0..=Quality::MAX_SAMPLES.into(), "0 to 64 per pixel"),
        (
            "the side of the shadow map",
            quality.shadow_map.into(),
            0..=Quality::MAX_SHADOW_MAP.into(),
            "0 to 16384 texels",
        ),
        ("the model's numslices", own.numslices.into(), 3..=1000, "3 to 1000"),
        ("the model's numstacks", own.numstacks.into(), 2..=1000, "2 to 1000"),
        ("the model's numquads", own.numquads.into(), 1..=100, "1 to 100"),
    ] {
        let got: i64 = got;
        if !range.contains(&got) {
            return Err(Error::Value { what, got: got as f64, expected });
        }
    }
    if quality.shadow_map > limits.texture {
        let (side, max) = (quality.shadow_map, limits.texture);
        let message = format!("a shadow map of {side} texels per side exceeds this driver's limit of {max}");
        return Err(Error::Gl { message });
    }
    Ok(())
}

fn check_size(size: ImageSize) -> Result<(), Error> {
    for side in [size.width, size.height] {
        if !(1..=ImageSize::MAX_SIDE).contains(&side) {
            return Err(Error::Value { what: "the side of an image", got: side.into(), expected: "1 to 8192 pixels" });
        }
    }
    Ok(())
}

fn check_length(what: &'static str, got: usize, expected: usize) -> Result<(), Error> {
    if got == expected { Ok(()) } else { Err(Error::Buffer { what, got, expected }) }
}

/// Flips an image vertically: OpenGL's first row is the bottom row.
fn flip(image: &mut [u8], row: usize, scratch: &mut Vec<u8>) {
    if row == 0 {
        return;
    }
    scratch.clear();
    scratch.extend_from_slice(image);
    for (from, to) in scratch.chunks_exact(row).rev().zip(image.chunks_exact_mut(row)) {
        to.copy_from_slice(from);
    }
}
