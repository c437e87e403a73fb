//! What is to be drawn: MuJoCo's abstract scene, seen by a camera.

use std::mem::MaybeUninit;
use std::sync::Arc;

use crate::data::Data;
use crate::error::Error;
use crate::id::{BodyId, CameraId, GeomId, ObjectId};
use crate::model::Model;
use crate::runtime::guarded;

/// From where a scene is seen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Camera {
    /// Looking at a point from a distance.
    Free {
        /// The point looked at, world frame, m.
        lookat: [f64; 3],
        /// Distance from it, m.
        distance: f64,
        /// Direction of sight about world z, degrees: 0 looks along +x, 90 along +y.
        azimuth: f64,
        /// Direction of sight above the horizon, degrees: negative looks down.
        elevation: f64,
    },
    /// Following a body's centre of mass (that of its subtree).
    Tracking {
        /// The body.
        body: BodyId,
        /// Distance from it, m.
        distance: f64,
        /// As for `Free`, degrees.
        azimuth: f64,
        /// As for `Free`, degrees.
        elevation: f64,
    },
    /// A camera of the model.
    Fixed(CameraId),
}

impl Camera {
    fn raw(&self, data: &Data) -> Result<mujoco_sys::mjvCamera, Error> {
        let model = data.model();
        let mut raw = MaybeUninit::uninit();
        // SAFETY: initialises the structure it is given.
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
                // MuJoCo goes only part of the way per update, for a person at a screen
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

/// What costs time beyond the geoms themselves. Everything off is what observations want, [`pretty`](Self::pretty)
/// what people want.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct VisualEffects {
    /// Shadows of lights that cast them (the renderer needs a shadow map).
    pub shadows: bool,
    /// Mirror images in reflective geoms.
    pub reflections: bool,
    /// The sky's texture.
    pub skybox: bool,
    /// Haze at the horizon.
    pub haze: bool,
}

impl VisualEffects {
    /// All of them.
    pub fn pretty() -> Self {
        Self { shadows: true, reflections: true, skybox: true, haze: true }
    }
}

/// A shape drawn into a scene that is not in the model: trails, rings, arrows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Decor {
    /// A ball.
    Sphere {
        /// Centre, world frame, m.
        centre: [f64; 3],
        /// Radius, m.
        radius: f64,
    },
    /// A straight rod with round ends.
    Rod {
        /// One end, world frame, m.
        from: [f64; 3],
        /// The other, world frame, m.
        to: [f64; 3],
        /// Radius, m.
        radius: f64,
    },
    /// A line of the same width however far away it is: it costs next to nothing, and has no light or shadow.
    Line {
        /// One end, world frame, m.
        from: [f64; 3],
        /// The other, world frame, m.
        to: [f64; 3],
        /// Width, pixels.
        width: f64,
    },
    /// An arrow.
    Arrow {
        /// Its tail, world frame, m.
        from: [f64; 3],
        /// Its tip, world frame, m.
        to: [f64; 3],
        /// Radius of the shaft, m.
        radius: f64,
    },
}

/// MuJoCo's abstract scene of one model.
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
/// // a dot that is not in the model, until the next update
/// assert!(scene.add(Decor::Sphere { centre: [0.0, 0.0, 0.5], radius: 0.05 }, [1.0, 0.0, 0.0, 1.0]));
/// # Ok::<(), mujoco_rs::Error>(())
/// ```
pub struct Scene {
    pub(crate) raw: Box<mujoco_sys::mjvScene>,
    options: mujoco_sys::mjvOption,
    model: Arc<Model>,
    camera_set: bool,
    /// All geoms of the scene, hidden ones included.
    full: i32,
    /// Type and index of the object of each segment.
    objects: Vec<[i32; 2]>,
    /// Point of the world that is the origin of what OpenGL is given, m.
    origin: [f64; 3],
    ground: Option<GeomId>,
}

// SAFETY: plain memory without thread affinity, owned by this value alone.
unsafe impl Send for Scene {}

impl Scene {
    /// Spacing of the points, in m, that are the origin of what is drawn. OpenGL computes in single precision: 1 km away it would be
    /// wrong by tenths of a millimetre at every vertex. So coordinates are counted from the point of this grid that is closest to
    /// the camera; up to half the spacing from the world's origin that is the world's origin.
    pub const GRID: f64 = 128.0;
    /// Most shapes that can be added.
    pub const MAX_DECOR: usize = 1_000_000;

    /// A scene with room for `decor` shapes beside the model's own.
    ///
    /// # Errors
    /// [`Error::Value`] for more than [`MAX_DECOR`](Self::MAX_DECOR) shapes, [`Error::Raised`] where MuJoCo cannot allocate it.
    pub fn new(model: impl Into<Arc<Model>>, decor: usize) -> Result<Self, Error> {
        crate::check_library()?;
        if decor > Self::MAX_DECOR {
            let what = "the number of shapes that are not in the model";
            return Err(Error::Value { what, got: decor as f64, expected: "up to 1,000,000" });
        }
        let model = model.into();
        let mut raw: Box<MaybeUninit<mujoco_sys::mjvScene>> = Box::new_uninit();
        let mut options = MaybeUninit::uninit();
        // every geom twice: planes and meshes have one entry, but selection and frames may add some
        let room = 2 * model.ngeom() + 2 * model.nsite() + decor + 100;
        let room = i32::try_from(room).unwrap_or(i32::MAX);
        // SAFETY: the first two initialise what they are given; the third allocates the scene's buffers for this model.
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

    /// Names a horizontal plane that has no end: it is drawn under the camera however far away that is, moved by whole multiples
    /// of [`GRID`](Self::GRID) along x and y, which must be multiples of the period of its texture.
    pub fn set_ground(&mut self, plane: Option<GeomId>) {
        self.ground = plane;
    }

    /// Which of the six geom groups are drawn; MuJoCo's default is the first three.
    pub fn show_groups(&mut self, groups: [bool; 6]) {
        self.options.geomgroup = groups.map(u8::from);
    }

    /// Switches effects on and off; before the first call they are MuJoCo's own defaults.
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

    /// Takes everything over from a simulation whose [kinematics](Data::kinematics) are up to date, and looks at it.
    ///
    /// # Errors
    /// [`Error::OtherModel`] if the simulation is of another model, [`Error::Value`] for an impossible camera,
    /// [`Error::NotOfModel`] for a camera or body that the model does not have, [`Error::Raised`] with MuJoCo's message.
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

    /// Leaves the geoms of one body out of what is drawn (or none), until the next [`update`](Self::update): what a
    /// camera on that body is to see.
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
        // hidden ones go to the end, where the renderer does not look; among the others, swapping keeps the order of those that are drawn
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

    /// Looks at the same things from another camera.
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

    /// Counts coordinates from the point of the grid that is closest to the camera. The camera and the lights have just been written,
    /// in the world's coordinates.
    fn recentre(&mut self, data: &Data) {
        let eye = self.raw.camera[0].pos.map(f64::from);
        // skins have their vertices in the world's coordinates
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
                    // MuJoCo moves other planes by itself, where they have no end
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

    /// Takes the data's model over, where it is this one or a copy whose numbers have been patched.
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

    /// Adds a shape until the next [`update`](Self::update), in red, green, blue and alpha from 0 to 1; `false` where there was
    /// no room for it.
    pub fn add(&mut self, decor: Decor, rgba: [f32; 4]) -> bool {
        use mujoco_sys::mjtGeom_ as geom;
        // the end of the list is where hidden geoms are
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
            // decoration is no object: segmentation shows what is behind it
            (*target).segid = -1;
        }
        self.full += 1;
        self.raw.ngeom = self.full;
        true
    }

    /// How often a renderer with a shadow map draws everything, and adds it up: once more for every light that casts shadows.
    pub(crate) fn passes(&self) -> f32 {
        let lights = &self.raw.lights[..usize::try_from(self.raw.nlight).unwrap_or(0).min(self.raw.lights.len())];
        match self.raw.flags[mujoco_sys::mjtRndFlag_::mjRND_SHADOW as usize] {
            0 => 1.0,
            _ => 1.0 + lights.iter().filter(|light| light.castshadow != 0).count() as f32,
        }
    }

    /// Makes lines so many times as bright: they have no light, so that passes add up.
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

    /// Distances of the near and far plane from the camera, along its axis, m.
    pub fn clip_planes(&self) -> [f64; 2] {
        [f64::from(self.raw.camera[0].frustum_near), f64::from(self.raw.camera[0].frustum_far)]
    }

    /// Whether a camera has been set, without which there is nothing to draw.
    pub(crate) fn is_seen(&self) -> bool {
        self.camera_set
    }

    /// The model that is drawn.
    pub fn model(&self) -> &Arc<Model> {
        &self.model
    }

    /// Type (`mjtObj`) and index of what a segmentation colour stands for; −1 twice for nothing.
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
