use std::collections::BTreeSet;
use std::ffi::{CStr, CString, c_char};
use std::fmt;
use std::path::Path;
use std::ptr::{self, NonNull};
use std::sync::Arc;

use crate::error::Error;
use crate::id::{GeomId, ObjectId, ObjectKind};
use crate::limits;
use crate::mesh;
use crate::mjcf::{self, Source};
use crate::runtime::{check_library, guarded};

/// A compiled scene.
///
/// Sizes and structure never change after compilation; numbers may be patched through [`ModelMut`]. It is immutable
/// while shared, so threads may step their own [`Data`](crate::Data) of one model at the same time.
///
/// ```
/// use mujoco_rs::{GeomId, Model, ObjectKind};
///
/// let model = Model::from_xml(
///     "<mujoco><worldbody><geom name='floor' type='plane' size='1 1 1'/>
///     <body><freejoint/><geom size='.1'/></body></worldbody></mujoco>",
/// )?;
/// let floor: GeomId = model.find("floor")?;
/// assert_eq!(model.name(floor), Some("floor"));
/// assert_eq!(model.count(ObjectKind::Body), 2, "the world is one, too");
/// // MuJoCo says itself what is wrong
/// let error = Model::from_xml("<mujoco><worldbody><nonsense/></worldbody></mujoco>").unwrap_err();
/// assert!(error.to_string().contains("nonsense"));
/// # Ok::<(), mujoco_rs::Error>(())
/// ```
pub struct Model {
    pointer: NonNull<mujoco_sys::mjModel>,
    /// Shared by all copies of one compiled model.
    structure: Arc<()>,
}

// SAFETY: an mjModel is plain memory without thread affinity, and MuJoCo reads it only through `const mjModel*`;
// nothing writes it through a shared reference.
unsafe impl Send for Model {}
// SAFETY: as above.
unsafe impl Sync for Model {}

/// Files that a scene refers to, kept in memory.
///
/// ```
/// use mujoco_rs::{Assets, Model};
///
/// let corner = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n";
/// let model = Model::from_xml_with_assets(
///     "<mujoco><asset><mesh name='corner' file='corner.obj'/></asset>
///     <worldbody><geom type='mesh' mesh='corner'/></worldbody></mujoco>",
///     &Assets::new().with("corner.obj", corner),
/// )?;
/// assert_eq!(model.nmesh(), 1);
/// # Ok::<(), mujoco_rs::Error>(())
/// ```
#[derive(Debug, Clone, Default)]
pub struct Assets {
    files: Vec<(String, Vec<u8>)>,
}

impl Assets {
    /// No files.
    pub fn new() -> Self {
        Self::default()
    }

    /// Adds a file under the name that the scene uses for it (without directories).
    #[must_use]
    pub fn with(mut self, name: impl Into<String>, bytes: impl Into<Vec<u8>>) -> Self {
        self.insert(name, bytes);
        self
    }

    /// Adds a file under the name that the scene uses for it (without directories).
    pub fn insert(&mut self, name: impl Into<String>, bytes: impl Into<Vec<u8>>) {
        self.files.push((name.into(), bytes.into()));
    }

    /// How many files there are.
    pub fn len(&self) -> usize {
        self.files.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.files.is_empty()
    }

    pub(crate) fn iter(&self) -> impl Iterator<Item = (&str, &[u8])> {
        self.files.iter().map(|(name, bytes)| (name.as_str(), bytes.as_slice()))
    }
}

/// MuJoCo's virtual file system: fixed slots for file names and pointers to copies of their content.
struct FileSystem(Box<mujoco_sys::mjVFS>);

impl FileSystem {
    fn new() -> Self {
        let mut vfs: Box<std::mem::MaybeUninit<mujoco_sys::mjVFS>> = Box::new_zeroed();
        // SAFETY: a structure of integers and pointers for which all zeros is a value; the call makes it an empty one.
        unsafe {
            mujoco_sys::mj_defaultVFS(vfs.as_mut_ptr());
            Self(vfs.assume_init())
        }
    }

    /// Files in addition to the scene's text; MuJoCo leaves one place empty.
    const ROOM: usize = mujoco_sys::mjMAXVFS as usize - 2;

    fn full(name: &str) -> Error {
        Error::Asset { name: name.to_string(), reason: format!("more than {} files", Self::ROOM) }
    }

    fn repeated(name: &str) -> Error {
        Error::Asset {
            name: name.to_string(),
            reason: "a file of that name is there already (names are compared without regard to case)".into(),
        }
    }

    fn check_name(name: &str) -> Result<(), Error> {
        let refuse = |reason: String| Error::Asset { name: name.to_string(), reason };
        let longest = mujoco_sys::mjMAXVFSNAME as usize - 1;
        if name.is_empty() || name.len() > longest {
            return Err(refuse(format!("the name has {} bytes, expected 1 to {longest}", name.len())));
        }
        if name.contains(['/', '\\']) {
            return Err(refuse("the name holds a directory, expected a bare file name".into()));
        }
        Ok(())
    }

    fn add(&mut self, name: &str, bytes: &[u8]) -> Result<(), Error> {
        Self::check_name(name)?;
        let refuse = |reason: String| Error::Asset { name: name.to_string(), reason };
        let c_name = CString::new(name).map_err(|_| Error::Nul { what: "asset name" })?;
        let Ok(size) = i32::try_from(bytes.len()) else {
            return Err(refuse(format!("{} bytes, expected less than 2 GiB", bytes.len())));
        };
        if size == 0 {
            return Err(refuse("the file is empty".into()));
        }
        // SAFETY: a valid VFS and a terminated name; the call allocates `size` bytes in the slot it fills.
        let status = unsafe { mujoco_sys::mj_makeEmptyFileVFS(&mut *self.0, c_name.as_ptr(), size) };
        match status {
            0 => {}
            1 => return Err(Self::full(name)),
            2 => return Err(Self::repeated(name)),
            other => return Err(refuse(format!("MuJoCo's file system answered {other}"))),
        }
        // SAFETY: as above.
        let slot = unsafe { mujoco_sys::mj_findFileVFS(&*self.0, c_name.as_ptr()) };
        let target = usize::try_from(slot).ok().and_then(|slot| self.0.filedata.get(slot)).copied();
        match target {
            Some(target) if !target.is_null() => {
                // SAFETY: the slot holds `size` bytes of MuJoCo's own, apart from ours.
                unsafe { ptr::copy_nonoverlapping(bytes.as_ptr(), target.cast::<u8>(), bytes.len()) };
                Ok(())
            }
            _ => Err(refuse("MuJoCo's file system lost it".into())),
        }
    }
}

impl Drop for FileSystem {
    fn drop(&mut self) {
        // SAFETY: frees the copies that `add` made, once.
        unsafe { mujoco_sys::mj_deleteVFS(&mut *self.0) };
    }
}

/// The name under which text in memory is compiled; messages show `scene` instead.
const TEXT_NAME: &str = "__scene__.xml";

impl Model {
    /// Compiles a scene from MJCF text.
    ///
    /// MuJoCo's parser and compiler trust sizes, counts and indices in a scene, so this crate reads the text first and refuses
    /// those that would lead them outside of their memory: numbers that are not finite, lengths above 1e6 m, faces that name
    /// vertices which are not there, height fields with more rows than columns (MuJoCo's rays read outside of their data).
    ///
    /// # Errors
    /// [`Error::Load`] with the line and what is expected there, or with MuJoCo's message; [`Error::Asset`] for a file, because
    /// there are none; [`Error::Version`] for a library that is not the one of the headers.
    pub fn from_xml(xml: &str) -> Result<Self, Error> {
        Self::from_xml_with_assets(xml, &Assets::new())
    }

    /// Compiles a scene from MJCF text that refers to files in memory, under names without directories. No file is read from
    /// disk.
    ///
    /// # Errors
    /// [`Error::Asset`] where a file is missing, damaged or cannot be taken, and as for [`from_xml`](Self::from_xml).
    pub fn from_xml_with_assets(xml: &str, assets: &Assets) -> Result<Self, Error> {
        check_library()?;
        if xml.trim().is_empty() {
            return Err(Error::Load { source_name: "scene".into(), message: "the text is empty".into() });
        }
        let mut files = FileSystem::new();
        // names first: MuJoCo looks files up by them
        let mut names = BTreeSet::new();
        for (name, _) in assets.iter() {
            FileSystem::check_name(name)?;
            if !names.insert(name.to_ascii_lowercase()) {
                return Err(FileSystem::repeated(name));
            }
            if names.len() > FileSystem::ROOM {
                return Err(FileSystem::full(name));
            }
        }
        let checked = mjcf::check(xml, &Source::Memory(assets), "scene")?;
        for (name, bytes) in assets.iter() {
            files.add(name, checked.files.get(&name.to_ascii_lowercase()).map_or(bytes, Vec::as_slice))?;
        }
        files.add(TEXT_NAME, checked.text.as_bytes())?;
        Self::load(TEXT_NAME, Some(&files), "scene")
    }

    /// Compiles a scene from an MJCF file; what it refers to is found relative to it. Files of one name in several directories
    /// are refused.
    ///
    /// # Errors
    /// [`Error::Load`] with the path; [`Error::Asset`] with that of a file that the scene refers to; otherwise as for
    /// [`from_xml`](Self::from_xml).
    pub fn from_file(path: impl AsRef<Path>) -> Result<Self, Error> {
        check_library()?;
        let path = path.as_ref();
        let shown = path.display().to_string();
        let refuse = |message: String| Error::Load { source_name: shown.clone(), message };
        let bytes = std::fs::read(path).map_err(|error| refuse(error.to_string()))?;
        let xml = String::from_utf8(bytes).map_err(|_| refuse("the file is not UTF-8 text".into()))?;
        let directory = path.parent().unwrap_or(Path::new(""));
        let checked = mjcf::check(&xml, &Source::Directory(directory), &shown)?;
        let mut files = FileSystem::new();
        for (name, bytes) in &checked.files {
            files.add(name, bytes)?;
        }
        files.add(TEXT_NAME, checked.text.as_bytes())?;
        Self::load(TEXT_NAME, Some(&files), &shown)
    }

    fn load(name: &str, files: Option<&FileSystem>, shown: &str) -> Result<Self, Error> {
        let c_name = CString::new(name).map_err(|_| Error::Nul { what: "path" })?;
        let mut message = [0 as c_char; 1000];
        // SAFETY: terminated strings, a VFS or null, a buffer of the size stated. Exceptions and errors end in the shim;
        // the parser takes MuJoCo's own lock.
        let pointer = unsafe {
            mujoco_sys::mjshim_load_xml(
                c_name.as_ptr(),
                files.map_or(ptr::null(), |files| &*files.0),
                message.as_mut_ptr(),
                message.len() as i32,
            )
        };
        let last = message.len() - 1;
        message[last] = 0;
        // SAFETY: terminated just above at the latest.
        let text = unsafe { CStr::from_ptr(message.as_ptr()) }.to_string_lossy();
        let text = text.split_whitespace().collect::<Vec<_>>().join(" ");
        match NonNull::new(pointer) {
            Some(pointer) => {
                if !text.is_empty() {
                    tracing::warn!(target: "mujoco", "{shown}: {text}");
                }
                let model = Self { pointer, structure: Arc::default() };
                model.check_compiled().map_err(|message| Error::Load { source_name: shown.to_string(), message })?;
                Ok(model)
            }
            None => {
                let message = if text.is_empty() { "MuJoCo gives no reason".into() } else { text };
                Err(Error::Load { source_name: shown.to_string(), message })
            }
        }
    }

    /// Checks what the compiler made of the text: numbers by which MuJoCo finds memory in every step.
    fn check_compiled(&self) -> Result<(), String> {
        for geom in 0..self.ngeom() {
            let of_geom = |error: Error| format!("geom {geom}: {error}");
            let quaternion = self.geom_quat()[4 * geom..].first_chunk().copied().unwrap_or_default();
            let size = self.geom_size()[3 * geom..].first_chunk().copied().unwrap_or_default();
            limits::unit_quaternion(&quaternion).map_err(of_geom)?;
            limits::geom_size(self.geom_type()[geom], &size).map_err(of_geom)?;
            limits::position(&self.geom_pos()[3 * geom..][..3]).map_err(of_geom)?;
            limits::bounding_radius(self.geom_rbound()[geom]).map_err(of_geom)?;
        }
        for (field, size) in self.hfield_size().as_chunks().0.iter().enumerate() {
            limits::hfield_size(size).map_err(|error| format!("height field {field}: {error}"))?;
            mesh::height_field(self.hfield_nrow()[field].into(), self.hfield_ncol()[field].into())?;
        }
        let within = |indices: &[i32], count: i32| indices.iter().all(|index| (0..count).contains(index));
        let part = |starts: &[i32], counts: &[i32], index: usize, width: usize| {
            let place = |value: i32| usize::try_from(value).unwrap_or(0) * width;
            place(starts[index])..place(starts[index]) + place(counts[index])
        };
        for mesh in 0..self.nmesh() {
            let faces = self.mesh_face().get(part(self.mesh_faceadr(), self.mesh_facenum(), mesh, 3));
            if !faces.is_some_and(|faces| within(faces, self.mesh_vertnum()[mesh])) {
                return Err(format!("mesh {mesh} has faces of vertices that it does not have"));
            }
        }
        for skin in 0..self.nskin() {
            let vertices = self.skin_vertnum()[skin];
            let faces = self.skin_face().get(part(self.skin_faceadr(), self.skin_facenum(), skin, 3));
            if !faces.is_some_and(|faces| within(faces, vertices)) {
                return Err(format!("skin {skin} has faces of vertices that it does not have"));
            }
        }
        Ok(())
    }

    /// A copy with memory of its own.
    ///
    /// # Errors
    /// [`Error::Raised`] where MuJoCo cannot allocate it.
    pub fn try_clone(&self) -> Result<Self, Error> {
        let mut copy = ptr::null_mut();
        // SAFETY: reads a valid model and writes the pointer of a new one.
        guarded("mj_copyModel", unsafe { mujoco_sys::mjshim_copy_model(self.pointer.as_ptr(), &mut copy) })?;
        let pointer = NonNull::new(copy)
            .ok_or_else(|| Error::Raised { call: "mj_copyModel", message: "no memory for the copy".into() })?;
        Ok(Self { pointer, structure: Arc::clone(&self.structure) })
    }

    /// Whether this is a copy of the other model, of the same structure if not of the same numbers.
    pub fn is_copy_of(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.structure, &other.structure)
    }

    /// Access to the numbers of the model.
    pub fn patch(&mut self) -> ModelMut<'_> {
        ModelMut { model: self }
    }

    /// The object of that name.
    ///
    /// # Errors
    /// [`Error::UnknownName`] if there is none.
    pub fn find<I: ObjectId>(&self, name: &str) -> Result<I, Error> {
        let unknown = || Error::UnknownName { kind: I::KIND, name: name.to_string() };
        let c_name = CString::new(name).map_err(|_| unknown())?;
        if name.is_empty() {
            // MuJoCo gives the first object without a name
            return Err(unknown());
        }
        // SAFETY: reads the model's table of names.
        let index = unsafe { mujoco_sys::mj_name2id(self.pointer.as_ptr(), I::KIND.code() as i32, c_name.as_ptr()) };
        usize::try_from(index).map(I::new).map_err(|_| unknown())
    }

    /// The name of an object; `None` where it has none or is not of this model.
    pub fn name<I: ObjectId>(&self, id: I) -> Option<&str> {
        let index = i32::try_from(id.get()).ok()?;
        // SAFETY: MuJoCo checks the index against the number of objects.
        let name = unsafe { mujoco_sys::mj_id2name(self.pointer.as_ptr(), I::KIND.code() as i32, index) };
        if name.is_null() {
            return None;
        }
        // SAFETY: points into the model's own table of terminated names.
        unsafe { CStr::from_ptr(name) }.to_str().ok()
    }

    /// How many objects of a kind there are.
    pub fn count(&self, kind: ObjectKind) -> usize {
        match kind {
            ObjectKind::Body => self.nbody(),
            ObjectKind::Joint => self.njnt(),
            ObjectKind::Geom => self.ngeom(),
            ObjectKind::Site => self.nsite(),
            ObjectKind::Camera => self.ncam(),
            ObjectKind::Light => self.nlight(),
            ObjectKind::Mesh => self.nmesh(),
            ObjectKind::Texture => self.ntex(),
            ObjectKind::Material => self.nmat(),
            ObjectKind::Actuator => self.nu(),
            ObjectKind::Sensor => self.nsensor(),
        }
    }

    /// Length of a step, s.
    pub fn timestep(&self) -> f64 {
        self.raw().opt.timestep
    }

    /// Acceleration of gravity, world frame, m/s².
    pub fn gravity(&self) -> [f64; 3] {
        self.raw().opt.gravity
    }

    /// Density of the medium, kg/m³; 0 where there is none.
    pub fn density(&self) -> f64 {
        self.raw().opt.density
    }

    /// Viscosity of the medium, Pa·s; 0 where there is none.
    pub fn viscosity(&self) -> f64 {
        self.raw().opt.viscosity
    }

    /// The integrator.
    pub fn integrator(&self) -> Option<Integrator> {
        [Integrator::Euler, Integrator::Rk4, Integrator::Implicit]
            .into_iter()
            .find(|integrator| integrator.code() as i32 == self.raw().opt.integrator)
    }

    #[inline]
    pub(crate) fn raw(&self) -> &mujoco_sys::mjModel {
        // SAFETY: valid from construction to drop; written only through a mutable reference.
        unsafe { self.pointer.as_ref() }
    }

    #[inline]
    pub(crate) fn as_ptr(&self) -> *const mujoco_sys::mjModel {
        self.pointer.as_ptr()
    }
}

/// Hands text to MuJoCo's compiler as it is, for tests of what becomes of its errors.
///
/// # Safety
/// The text leads MuJoCo to an error, or to a model, and not outside its memory.
#[doc(hidden)]
pub unsafe fn load_unchecked(xml: &str) -> Result<(), Error> {
    check_library()?;
    let mut files = FileSystem::new();
    files.add(TEXT_NAME, xml.as_bytes())?;
    Model::load(TEXT_NAME, Some(&files), "scene").map(drop)
}

impl Drop for Model {
    fn drop(&mut self) {
        // SAFETY: allocated by MuJoCo, freed once.
        unsafe { mujoco_sys::mj_deleteModel(self.pointer.as_ptr()) };
    }
}

impl fmt::Debug for Model {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Model")
            .field("nbody", &self.nbody())
            .field("nq", &self.nq())
            .field("nv", &self.nv())
            .field("ngeom", &self.ngeom())
            .finish_non_exhaustive()
    }
}

/// MuJoCo's integrators.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Integrator {
    /// Semi-implicit Euler.
    Euler,
    /// Fourth-order Runge-Kutta.
    Rk4,
    /// Implicit in velocity.
    Implicit,
}

impl Integrator {
    fn code(self) -> u32 {
        match self {
            Self::Euler => mujoco_sys::mjtIntegrator_::mjINT_EULER,
            Self::Rk4 => mujoco_sys::mjtIntegrator_::mjINT_RK4,
            Self::Implicit => mujoco_sys::mjtIntegrator_::mjINT_IMPLICIT,
        }
    }
}

/// The numbers of a model to be written; its structure cannot change.
///
/// Arrays that MuJoCo only calculates with are slices. Numbers by which it finds memory (sizes and orientations of geoms,
/// height fields) have setters that check them, and slices that are `unsafe` to write.
///
/// MuJoCo derives some numbers from others when it compiles (`body_subtreemass`, `dof_M0`, `body_invweight0`, …):
/// whoever patches a mass writes those as well.
///
/// ```
/// use mujoco_rs::Model;
///
/// let mut model = Model::from_xml("<mujoco><worldbody><geom size='.1'/></worldbody></mujoco>")?;
/// model.patch().set_gravity([0.0, 0.0, -1.62])?;
/// assert_eq!(model.gravity(), [0.0, 0.0, -1.62], "on the Moon");
/// # Ok::<(), mujoco_rs::Error>(())
/// ```
pub struct ModelMut<'a> {
    model: &'a mut Model,
}

impl ModelMut<'_> {
    #[inline]
    pub(crate) fn raw(&self) -> &mujoco_sys::mjModel {
        self.model.raw()
    }

    fn options(&mut self) -> &mut mujoco_sys::mjOption {
        // SAFETY: the model is borrowed mutably.
        unsafe { &mut self.model.pointer.as_mut().opt }
    }

    /// Sets the length of a step, s.
    ///
    /// # Errors
    /// [`Error::Value`] unless positive and finite.
    pub fn set_timestep(&mut self, timestep: f64) -> Result<(), Error> {
        if !(timestep.is_finite() && timestep > 0.0) {
            return Err(Error::Value {
                what: "the time step",
                got: timestep,
                expected: "a positive number of seconds",
            });
        }
        self.options().timestep = timestep;
        Ok(())
    }

    /// Sets the acceleration of gravity, world frame, m/s².
    ///
    /// # Errors
    /// [`Error::Value`] unless finite.
    pub fn set_gravity(&mut self, gravity: [f64; 3]) -> Result<(), Error> {
        if let Some(&got) = gravity.iter().find(|value| !value.is_finite()) {
            return Err(Error::Value { what: "gravity", got, expected: "a finite number of m/s²" });
        }
        self.options().gravity = gravity;
        Ok(())
    }

    /// Sets the sizes of a geom, in MuJoCo's order for its type, m: radius of a sphere; radius and half length of a capsule or
    /// cylinder; half sizes of an ellipsoid or box; half sizes (0 for infinite) and grid spacing of a plane. Numbers that the
    /// type does not have are 0.
    ///
    /// # Errors
    /// [`Error::NotOfModel`]; [`Error::Value`] for a size that is not finite, negative, or outside 1e-15 m to 1e6 m where
    /// the type has it.
    #[inline]
    pub fn set_geom_size(&mut self, geom: GeomId, size: [f64; 3]) -> Result<(), Error> {
        let row = self.geom_row(geom)?;
        limits::geom_size(self.raw_geom_type(row), &size)?;
        // SAFETY: the sizes are ones that the compiler would take.
        let values = unsafe { self.geom_size_mut() };
        values[3 * row..][..3].copy_from_slice(&size);
        Ok(())
    }

    /// Sets the position of a geom in its body's frame, m.
    ///
    /// # Errors
    /// [`Error::NotOfModel`]; [`Error::Value`] for a coordinate that is not finite or exceeds 1e10.
    #[inline]
    pub fn set_geom_pos(&mut self, geom: GeomId, position: [f64; 3]) -> Result<(), Error> {
        let row = self.geom_row(geom)?;
        limits::position(&position)?;
        // SAFETY: the coordinates are ones that the compiler would take.
        let values = unsafe { self.geom_pos_mut() };
        values[3 * row..][..3].copy_from_slice(&position);
        Ok(())
    }

    /// Sets the orientation of a geom in its body's frame, `[w, x, y, z]`.
    ///
    /// # Errors
    /// [`Error::NotOfModel`]; [`Error::Value`] unless the quaternion has length 1 within 1e-6.
    #[inline]
    pub fn set_geom_quat(&mut self, geom: GeomId, quaternion: [f64; 4]) -> Result<(), Error> {
        let row = self.geom_row(geom)?;
        limits::unit_quaternion(&quaternion)?;
        // SAFETY: the quaternion has length 1, as the compiler's have.
        let values = unsafe { self.geom_quat_mut() };
        values[4 * row..][..4].copy_from_slice(&quaternion);
        Ok(())
    }

    /// Sets the radius of the ball around a geom outside of which MuJoCo looks for no contacts, m; 0 for a plane.
    ///
    /// # Errors
    /// [`Error::NotOfModel`]; [`Error::Value`] for a radius that is not finite, negative or above 1e7.
    #[inline]
    pub fn set_geom_rbound(&mut self, geom: GeomId, radius: f64) -> Result<(), Error> {
        let row = self.geom_row(geom)?;
        limits::bounding_radius(radius)?;
        // SAFETY: the radius is one that the compiler would compute.
        let values = unsafe { self.geom_rbound_mut() };
        values[row] = radius;
        Ok(())
    }

    /// Sets the sizes of a height field, by its position in the model's list, m: half sizes along x and y, height of its
    /// highest point, thickness of its base.
    ///
    /// # Errors
    /// [`Error::Value`] unless there is such a field and all sizes lie between 1e-15 m and 1e6 m.
    pub fn set_hfield_size(&mut self, hfield: usize, size: [f64; 4]) -> Result<(), Error> {
        if hfield >= self.model.nhfield() {
            return Err(Error::Value {
                what: "the index of a height field",
                got: hfield as f64,
                expected: "less than the model has",
            });
        }
        limits::hfield_size(&size)?;
        // SAFETY: the sizes are ones that the compiler would take.
        let values = unsafe { self.hfield_size_mut() };
        values[4 * hfield..][..4].copy_from_slice(&size);
        Ok(())
    }

    #[inline]
    fn geom_row(&self, geom: GeomId) -> Result<usize, Error> {
        let count = self.model.ngeom();
        if geom.index() < count {
            Ok(geom.index())
        } else {
            Err(Error::NotOfModel { kind: ObjectKind::Geom, index: geom.index(), count })
        }
    }

    #[inline]
    fn raw_geom_type(&self, row: usize) -> i32 {
        self.model.geom_type()[row]
    }

    /// Sets the integrator.
    pub fn set_integrator(&mut self, integrator: Integrator) {
        self.options().integrator = integrator.code() as i32;
    }
}
