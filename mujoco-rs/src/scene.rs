//! MuJoCo's abstract scene: the geoms, lights and camera to render.

use std::mem::MaybeUninit;
use std::sync::Arc;

use crate::data::Data;
use crate::error::Error;
use crate::id::{BodyId, CameraId, GeomId, ObjectId};
use crate::model::Model;
use crate::runtime::guarded;

/// View of a scene.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Camera {
    /// Looks at a fixed point from a distance.
    Free {
        /// Point that the camera looks at, world frame, m.
        lookat: [f64; 3],
        /// Distance from the point, m.
        distance: f64,
        /// Azimuth of the viewing direction about world z, degrees: 0 looks along +x, 90 along +y.
        azimuth: f64,
        /// Elevation of the viewing direction above the horizon, degrees: negative looks down.
        elevation: f64,
    },
    /// Follows the centre of mass of a body's subtree.
    Tracking {
        /// Body to follow.
        body: BodyId,
        /// Distance from the centre of mass, m.
        distance: f64,
        /// Azimuth as for `Free`, degrees.
        azimuth: f64,
        /// Elevation as for `Free`, degrees.
        elevation: f64,
    },
    /// Uses a camera of the model.
    Fixed(CameraId),
}

impl Camera {
    fn raw(&self, data: &Data) -> Result<mujoco_sys::mjvCamera, Error> {
        let model = data.model();
        let mut raw = MaybeUninit::uninit();
        // SAFETY: initializes the structure it is given.
        let mut raw = unsafe {
            mujoco_sys::mjv_defaultCamera(raw.as_mut_ptr());
            raw.assume_init()
        };
        let mut orbit = |distance: f64, azimuth: f64, elevation: f64| {
            if !(distance.is_finite() && distance > 0.0) {
                return Err(Error::Value {
                    what: "the camera's distance",
                    got: distance,
                    expected: "a positive number of metres",
                });
            }
            for (what, got) in [("the camera's azimuth", azimuth), ("the camera's elevation", elevation)] {
                if !got.is_finite() {
                    return Err(Error::Value { what, got, expected: "a finite number of degrees" });
                }
            }
            (raw.distance, raw.azimuth, raw.elevation) = (distance, azimuth, elevation);
            Ok(())
        };
        match *self {
            Self::Free { lookat, distance, azimuth, elevation } => {
                orbit(distance, azimuth, elevation)?;
                if let Some(&got) = lookat.iter().find(|x| !x.is_finite()) {
                    return Err(Error::Value { what: "the point a camera looks at", got, expected: "finite numbers" });
                }
                raw.type_ = mujoco_sys::mjtCamera_::mjCAMERA_FREE as i32;
                raw.lookat = lookat;
            }
            Self::Tracking { body, distance, azimuth, elevation } => {
                orbit(distance, azimuth, elevation)?;
                raw.type_ = mujoco_sys::mjtCamera_::mjCAMERA_TRACKING as i32;
                raw.trackbodyid = index(body, model.nbody())?;
                // MuJoCo's interactive camera moves only a fraction of the distance per update
                raw.lookat.copy_from_slice(&data.subtree_com()[3 * body.index()..][..3]);
            }
            Self::Fixed(camera) => {
                raw.type_ = mujoco_sys::mjtCamera_::mjCAMERA_FIXED as i32;
                raw.fixedcamid = index(camera, model.ncam())?;
            }
        }
        Ok(raw)
    }
}

fn index<I: ObjectId>(id: I, count: usize) -> Result<i32, Error> {
    match i32::try_from(id.get()) {
        Ok(raw) if id.get() < count => Ok(raw),
        _ => Err(Error::NotOfModel { kind: I::KIND, index: id.get(), count }),
    }
}

/// Effects that cost rendering time. The default (all off) suits observations, [`pretty`](Self::pretty) videos and
/// figures.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct VisualEffects {
    /// Shadows of lights that cast them (the renderer needs a shadow map).
    pub shadows: bool,
    /// Reflections in reflective geoms.
    pub reflections: bool,
    /// Texture of the sky.
    pub skybox: bool,
    /// Haze at the horizon.
    pub haze: bool,
}

impl VisualEffects {
    /// Returns settings with all effects on.
    pub fn pretty() -> Self {
        Self { shadows: true, reflections: true, skybox: true, haze: true }
    }
}

/// Shape that is drawn into a scene without being part of the model: trails, rings, arrows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Decor {
    /// Sphere.
    Sphere {
        /// Centre, world frame, m.
        centre: [f64; 3],
        /// Radius, m.
        radius: f64,
    },
    /// Straight rod with round ends (a capsule).
    Rod {
        /// First end, world frame, m.
        from: [f64; 3],
        /// Second end, world frame, m.
        to: [f64; 3],
        /// Radius, m.
        radius: f64,
    },
    /// Line whose width in pixels does not depend on distance. It is cheap to draw and has no lighting or shadow.
    Line {
        /// First end, world frame, m.
        from: [f64; 3],
        /// Second end, world frame, m.
        to: [f64; 3],
        /// Width, pixels.
        width: f64,
    },
    /// Arrow.
    Arrow {
        /// Tail, world frame, m.
        from: [f64; 3],
        /// Tip, world frame, m.
        to: [f64; 3],
        /// Radius of the shaft, m.
        radius: f64,
    },
}

/// MuJoCo's abstract scene (`mjvScene`) of one model.
///
/// ```
/// use mujoco_rs::{Camera, Data, Decor, Model, Scene};
///
/// let mut data = Data::new(Model::from_xml("<mujoco><worldbody><geom size='.1'/></worldbody></mujoco>")?)?;
/// data.forward()?;
/// let mut scene = Scene::new(data.shared_model(), 10)?;
/// let camera = Camera::Free { lookat: [0.0; 3], distance: 2.0, azimuth: 90.0, elevation: -30.0 };
/// scene.update(&mut data, &camera)?;
/// let [near, far] = scene.clip_planes();
/// assert!(near > 0.0 && near < far);
/// // a dot that is not part of the model, until the next update
/// assert!(scene.add(Decor::Sphere { centre: [0.0, 0.0, 0.5], radius: 0.05 }, [1.0, 0.0, 0.0, 1.0]));
/// # Ok::<(), mujoco_rs::Error>(())
/// ```
pub struct Scene {
    pub(crate) raw: Box<mujoco_sys::mjvScene>,
    options: mujoco_sys::mjvOption,
    model: Arc<Model>,
    camera_set: bool,
    /// Number of geoms in the scene, including hidden ones.
    full: i32,
    /// Type and index of the object of each segment.
    objects: Vec<[i32; 2]>,
    /// Origin of OpenGL's coordinates, world frame, m.
    origin: [f64; 3],
    ground: Option<GeomId>,
}

// SAFETY: plain memory without thread affinity, owned by this value alone.
unsafe impl Send for Scene {}

impl Scene {
    /// Spacing of the grid of rendering origins, m. OpenGL computes in single precision, which causes errors of
    /// tenths of a millimetre 1 km from the origin. Coordinates are therefore relative to the grid point that is
    /// closest to the camera; within half the spacing of the world's origin, that grid point is the world's origin.
    pub const GRID: f64 = 128.0;
    /// Largest number of additional shapes.
    pub const MAX_DECOR: usize = 1_000_000;

    /// Creates a scene with room for `decor` shapes in addition to the model's geoms.
    ///
    /// # Errors
    /// [`Error::Value`] if `decor` exceeds [`MAX_DECOR`](Self::MAX_DECOR); [`Error::Raised`] if MuJoCo cannot
    /// allocate the scene.
    pub fn new(model: impl Into<Arc<Model>>, decor: usize) -> Result<Self, Error> {
        crate::check_library()?;
        if decor > Self::MAX_DECOR {
            let what = "the number of additional shapes";
            return Err(Error::Value { what, got: decor as f64, expected: "up to 1,000,000" });
        }
        let model = model.into();
        let mut raw: Box<MaybeUninit<mujoco_sys::mjvScene>> = Box::new_uninit();
        let mut options = MaybeUninit::uninit();
        // twice the number of geoms: planes and meshes have one entry, but selection and frames may add some
        let room = 2 * model.ngeom() + 2 * model.nsite() + decor + 100;
        let room = i32::try_from(room).unwrap_or(i32::MAX);
        // SAFETY: the first two calls initialize the structures; the third allocates the scene's buffers for this
        // model.
        let (raw, options) = unsafe {
            mujoco_sys::mjv_defaultScene(raw.as_mut_ptr());
            mujoco_sys::mjv_defaultOption(options.as_mut_ptr());
            let status = mujoco_sys::mjshim_make_scene(model.as_ptr(), raw.as_mut_ptr(), room);
            guarded("mjv_makeScene", status)?;
            (raw.assume_init(), options.assume_init())
        };
        let (objects, origin) = (Vec::new(), [0.0; 3]);
        Ok(Self { raw, options, model, camera_set: false, full: 0, objects, origin, ground: None })
    }

    /// Declares a horizontal plane infinite: it is drawn below the camera at any distance, shifted by multiples of
    /// [`GRID`](Self::GRID) along x and y. These must be multiples of the period of its texture.
    pub fn set_ground(&mut self, plane: Option<GeomId>) {
        self.ground = plane;
    }

    /// Sets which of the six geom groups are drawn; MuJoCo's default is the first three.
    pub fn show_groups(&mut self, groups: [bool; 6]) {
        self.options.geomgroup = groups.map(u8::from);
    }

    /// Sets the visual effects; before the first call, MuJoCo's defaults apply.
    pub fn set_effects(&mut self, effects: VisualEffects) {
        use mujoco_sys::mjtRndFlag_ as flag;
        let flags = &mut self.raw.flags;
        for (flag, on) in [
            (flag::mjRND_SHADOW, effects.shadows),
            (flag::mjRND_REFLECTION, effects.reflections),
            (flag::mjRND_SKYBOX, effects.skybox),
            (flag::mjRND_HAZE, effects.haze),
            (flag::mjRND_FOG, false),
            (flag::mjRND_CULL_FACE, true),
        ] {
            flags[flag as usize] = on.into();
        }
    }

    /// Copies the state of a simulation whose [kinematics](Data::kinematics) are up to date, and sets the camera.
    ///
    /// # Errors
    /// - [`Error::OtherModel`] if the simulation has another model.
    /// - [`Error::Value`] for invalid camera parameters.
    /// - [`Error::NotOfModel`] if the model does not have the camera or body.
    /// - [`Error::Raised`] with MuJoCo's message.
    pub fn update(&mut self, data: &mut Data, camera: &Camera) -> Result<(), Error> {
        self.same_model(data)?;
        let mut camera = camera.raw(data)?;
        // SAFETY: model, data and scene belong together.
        let status = unsafe {
            mujoco_sys::mjshim_update_scene(
                self.model.as_ptr(),
                data.as_ptr(),
                &self.options,
                &mut camera,
                &mut *self.raw,
            )
        };
        self.camera_set = status == 0;
        guarded("mjv_updateScene", status)?;
        self.full = self.raw.ngeom;
        self.origin = [0.0; 3];
        self.recentre(data);
        self.objects.clear();
        self.objects.resize(self.geoms().len(), [-1, -1]);
        for slot in 0..self.objects.len() {
            let geom = &self.geoms()[slot];
            let (segment, object) = (geom.segid, [geom.objtype, geom.objid]);
            if let Some(entry) = usize::try_from(segment).ok().and_then(|segment| self.objects.get_mut(segment)) {
                *entry = object;
            }
        }
        Ok(())
    }

    fn geoms(&self) -> &[mujoco_sys::mjvGeom] {
        let count = usize::try_from(self.full).unwrap_or(0);
        if count == 0 {
            return &[];
        }
        // SAFETY: MuJoCo, or `add`, has filled this many entries.
        unsafe { std::slice::from_raw_parts(self.raw.geoms, count) }
    }

    fn geoms_mut(&mut self) -> &mut [mujoco_sys::mjvGeom] {
        let count = usize::try_from(self.full).unwrap_or(0);
        if count == 0 {
            return &mut [];
        }
        // SAFETY: as for `geoms`, and borrowed mutably.
        unsafe { std::slice::from_raw_parts_mut(self.raw.geoms, count) }
    }

    /// Hides the geoms of one body (or of none) until the next [`update`](Self::update), for example for a camera
    /// on that body.
    pub fn hide(&mut self, body: Option<BodyId>) {
        self.raw.ngeom = self.full;
        let count = usize::try_from(self.full).unwrap_or(0);
        let (Some(body), true) = (body, count > 0) else { return };
        let bodies = self.model.geom_bodyid();
        // SAFETY: as for `geoms`, and borrowed mutably.
        let geoms = unsafe { std::slice::from_raw_parts_mut(self.raw.geoms, count) };
        let is_hidden = |geom: &mujoco_sys::mjvGeom| {
            geom.objtype == mujoco_sys::mjtObj_::mjOBJ_GEOM as i32
                && usize::try_from(geom.objid)
                    .ok()
                    .and_then(|id| bodies.get(id))
                    .is_some_and(|&b| b as usize == body.index())
        };
        // hidden geoms move to the end, beyond the renderer's count; swapping keeps the order of the drawn geoms
        let mut drawn = 0;
        for slot in 0..count {
            if !is_hidden(&geoms[slot]) {
                if slot != drawn {
                    geoms.swap(slot, drawn);
                }
                drawn += 1;
            }
        }
        self.raw.ngeom = drawn as i32;
    }

    /// Sets another camera for the same state.
    ///
    /// # Errors
    /// As for [`update`](Self::update).
    pub fn look(&mut self, data: &mut Data, camera: &Camera) -> Result<(), Error> {
        self.same_model(data)?;
        let mut camera = camera.raw(data)?;
        // SAFETY: as for `update`.
        let status =
            unsafe { mujoco_sys::mjshim_look(self.model.as_ptr(), data.as_ptr(), &mut camera, &mut *self.raw) };
        self.camera_set = status == 0;
        guarded("mjv_updateCamera", status)?;
        self.recentre(data);
        Ok(())
    }

    /// Moves the rendering origin to the grid point that is closest to the camera. Camera and lights must have
    /// world coordinates, as MuJoCo has just written them.
    fn recentre(&mut self, data: &Data) {
        let eye = self.raw.camera[0].pos.map(f64::from);
        // vertices of skins have world coordinates
        let origin = if self.raw.nskin > 0 { [0.0; 3] } else { eye.map(|x| (x / Self::GRID).round() * Self::GRID) };
        if !origin.iter().all(|x| x.is_finite()) {
            return;
        }
        let moved = origin != self.origin;
        let (before, ground) = (std::mem::replace(&mut self.origin, origin), self.ground);
        let (exact, plane) = (data.geom_xpos(), mujoco_sys::mjtGeom_::mjGEOM_PLANE as i32);
        for geom in self.geoms_mut() {
            let id =
                usize::try_from(geom.objid).ok().filter(|_| geom.objtype == mujoco_sys::mjtObj_::mjOBJ_GEOM as i32);
            let is_ground = id.is_some() && id == ground.map(|ground| ground.index());
            if !moved && !is_ground {
                continue;
            }
            for axis in 0..3 {
                let old = f64::from(geom.pos[axis]) + before[axis];
                geom.pos[axis] = match id.and_then(|id| exact.get(3 * id + axis)) {
                    Some(&at) if is_ground && axis < 2 => {
                        let at = at - origin[axis];
                        at - (at / Self::GRID).round() * Self::GRID
                    }
                    // MuJoCo re-centres other infinite planes itself
                    Some(&at) if geom.type_ != plane || is_ground => at - origin[axis],
                    _ => old - origin[axis],
                } as f32;
            }
        }
        let lights = usize::try_from(self.raw.nlight).unwrap_or(0).min(self.raw.lights.len());
        let raw = &mut *self.raw;
        let lights = raw.lights[..lights].iter_mut().map(|light| &mut light.pos);
        for position in raw.camera.iter_mut().map(|camera| &mut camera.pos).chain(lights) {
            for (x, origin) in position.iter_mut().zip(origin) {
                *x = (f64::from(*x) - origin) as f32;
            }
        }
    }

    /// Adopts the simulation's model if it is this one or a copy of it, so that changed numbers apply.
    fn same_model(&mut self, data: &Data) -> Result<(), Error> {
        if std::ptr::eq(self.model.as_ptr(), data.model().as_ptr()) {
            return Ok(());
        }
        if !self.model.is_copy_of(data.model()) {
            return Err(Error::OtherModel);
        }
        self.model = data.shared_model();
        Ok(())
    }

    /// Adds a shape until the next [`update`](Self::update); `rgba` is red, green, blue and alpha from 0 to 1.
    /// Returns false if the scene is full.
    pub fn add(&mut self, decor: Decor, rgba: [f32; 4]) -> bool {
        use mujoco_sys::mjtGeom_ as geom;
        // hidden geoms occupy the end of the list
        self.hide(None);
        let Some(slot) = usize::try_from(self.raw.ngeom).ok().filter(|_| self.raw.ngeom < self.raw.maxgeom) else {
            return false;
        };
        let identity = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
        let origin = self.origin;
        let local = |point: [f64; 3]| -> [f64; 3] { std::array::from_fn(|i| point[i] - origin[i]) };
        // SAFETY: the slot lies within the buffer of maxgeom entries; the calls fill it.
        unsafe {
            let target = self.raw.geoms.add(slot);
            let init = |kind: u32, size: [f64; 3], position: [f64; 3]| {
                mujoco_sys::mjv_initGeom(
                    target,
                    kind as i32,
                    size.as_ptr(),
                    local(position).as_ptr(),
                    identity.as_ptr(),
                    rgba.as_ptr(),
                );
            };
            let connect = |kind: u32, width: f64, a: [f64; 3], b: [f64; 3]| {
                let (a, b) = (local(a), local(b));
                mujoco_sys::mjv_makeConnector(target, kind as i32, width, a[0], a[1], a[2], b[0], b[1], b[2]);
            };
            match decor {
                Decor::Sphere { centre, radius } => init(geom::mjGEOM_SPHERE, [radius; 3], centre),
                Decor::Rod { from, to, radius } => {
                    init(geom::mjGEOM_CAPSULE, [radius; 3], from);
                    connect(geom::mjGEOM_CAPSULE, radius, from, to);
                }
                Decor::Line { from, to, width } => {
                    init(geom::mjGEOM_LINE, [width; 3], from);
                    connect(geom::mjGEOM_LINE, width, from, to);
                }
                Decor::Arrow { from, to, radius } => {
                    init(geom::mjGEOM_ARROW, [radius; 3], from);
                    connect(geom::mjGEOM_ARROW, radius, from, to);
                }
            }
            (*target).category = mujoco_sys::mjtCatBit_::mjCAT_DECOR as i32;
            // decoration has no object id: the segmentation shows the objects behind it
            (*target).segid = -1;
        }
        self.full += 1;
        self.raw.ngeom = self.full;
        true
    }

    /// Returns the number of passes of a renderer with a shadow map: one, plus one for every light that casts
    /// shadows. The renderer adds their colours.
    pub(crate) fn passes(&self) -> f32 {
        let lights = &self.raw.lights[..usize::try_from(self.raw.nlight).unwrap_or(0).min(self.raw.lights.len())];
        match self.raw.flags[mujoco_sys::mjtRndFlag_::mjRND_SHADOW as usize] {
            0 => 1.0,
            _ => 1.0 + lights.iter().filter(|light| light.castshadow != 0).count() as f32,
        }
    }

    /// Scales the brightness of lines: they have no lighting, so that every pass adds their full colour.
    pub(crate) fn scale_lines(&mut self, factor: f32) {
        let count = usize::try_from(self.raw.ngeom).unwrap_or(0);
        if factor == 1.0 || count == 0 {
            return;
        }
        // SAFETY: as for `geoms`, and borrowed mutably.
        let geoms = unsafe { std::slice::from_raw_parts_mut(self.raw.geoms, count) };
        let line = mujoco_sys::mjtGeom_::mjGEOM_LINE as i32;
        for geom in geoms.iter_mut().filter(|geom| geom.type_ == line) {
            geom.rgba[..3].iter_mut().for_each(|x| *x *= factor);
        }
    }

    /// Returns the distances of the near and far plane from the camera, along its axis, m.
    pub fn clip_planes(&self) -> [f64; 2] {
        [f64::from(self.raw.camera[0].frustum_near), f64::from(self.raw.camera[0].frustum_far)]
    }

    /// Returns true if a camera has been set, which rendering requires.
    pub(crate) fn has_camera(&self) -> bool {
        self.camera_set
    }

    /// Returns the model of the scene.
    pub fn model(&self) -> &Arc<Model> {
        &self.model
    }

    /// Returns the type (`mjtObj`) and index of the object with a segmentation colour; `[-1, -1]` for the
    /// background.
    pub(crate) fn object(&self, colour: u32) -> [i32; 2] {
        let segment = colour.checked_sub(1).and_then(|segment| self.objects.get(segment as usize));
        segment.copied().unwrap_or([-1, -1])
    }
}

impl Drop for Scene {
    fn drop(&mut self) {
        // SAFETY: allocated by mjv_makeScene, freed once.
        unsafe { mujoco_sys::mjv_freeScene(&mut *self.raw) };
    }
}

impl std::fmt::Debug for Scene {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Scene").field("geoms", &self.raw.ngeom).finish_non_exhaustive()
    }
}
