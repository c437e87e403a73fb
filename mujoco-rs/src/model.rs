mod assets;
mod options;
mod patch;

use std::collections::BTreeSet;
use std::ffi::{CStr, CString, c_char};
use std::fmt;
use std::path::Path;
use std::ptr::{self, NonNull};
use std::sync::Arc;

use crate::error::Error;
use crate::id::{ObjectId, ObjectKind};
use crate::limits;
use crate::mesh;
use crate::mjcf::{self, Source};
use crate::runtime::{check_library, guarded};

pub use assets::Assets;
use assets::FileSystem;
pub use options::ConstraintOptions;
pub use patch::ModelMut;

/// Compiled scene; MuJoCo's `mjModel`.
///
/// Sizes and structure are fixed at compilation; numbers may be changed through [`ModelMut`]. A shared model is
/// immutable, so that several threads may step their own [`Data`](crate::Data) of one model at the same time.
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
/// assert_eq!(model.count(ObjectKind::Body), 2, "the world is a body, too");
/// // MuJoCo reports the cause of an error
/// let error = Model::from_xml("<mujoco><worldbody><nonsense/></worldbody></mujoco>").unwrap_err();
/// assert!(error.to_string().contains("nonsense"));
/// # Ok::<(), mujoco_rs::Error>(())
/// ```
pub struct Model {
    pointer: NonNull<mujoco_sys::mjModel>,
    /// Identity of the compiled model, shared by all its copies.
    structure: Arc<()>,
}

// SAFETY: an mjModel is plain memory without thread affinity, and MuJoCo reads it only through `const mjModel*`;
// nothing writes it through a shared reference.
unsafe impl Send for Model {}
// SAFETY: as above.
unsafe impl Sync for Model {}

/// File name under which text in memory is compiled; messages show `scene` instead.
const TEXT_NAME: &str = "__scene__.xml";

impl Model {
    /// Compiles a scene from MJCF text.
    ///
    /// MuJoCo's parser and compiler trust sizes, counts and indices in a scene. This crate therefore validates the
    /// text first and rejects values that would cause invalid memory accesses: non-finite numbers, lengths above
    /// 1e6 m, faces with invalid vertex indices, and height fields with more rows than columns (MuJoCo's ray
    /// casting reads outside of their data).
    ///
    /// # Errors
    /// - [`Error::Load`] with the line and the expected value, or with MuJoCo's message.
    /// - [`Error::Asset`] if the scene refers to a file.
    /// - [`Error::Version`] if the library's version differs from that of the headers.
    pub fn from_xml(xml: &str) -> Result<Self, Error> {
        Self::from_xml_with_assets(xml, &Assets::new())
    }

    /// Compiles a scene from MJCF text that refers to files in memory, by names without directories. No file is
    /// read from disk.
    ///
    /// # Errors
    /// [`Error::Asset`] for a missing, damaged or unsupported file; otherwise as for [`from_xml`](Self::from_xml).
    pub fn from_xml_with_assets(xml: &str, assets: &Assets) -> Result<Self, Error> {
        check_library()?;
        if xml.trim().is_empty() {
            return Err(Error::Load { source_name: "scene".into(), message: "the text is empty".into() });
        }
        let mut files = FileSystem::new();
        // check names first, because MuJoCo finds files by name
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

    /// Compiles a scene from an MJCF file; the paths in it are relative to it. Files of the same name in different
    /// directories are rejected.
    ///
    /// # Errors
    /// [`Error::Load`] with the path of the scene; [`Error::Asset`] with the name of a file that the scene refers
    /// to; otherwise as for [`from_xml`](Self::from_xml).
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
        // SAFETY: the strings are terminated, the VFS is null or valid, the buffer has the given size. Exceptions
        // and errors end in the shim; the parser takes MuJoCo's own lock.
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
        // SAFETY: the line above terminates the buffer.
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

    /// Validates the compiled numbers by which MuJoCo addresses memory in every step.
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
                return Err(format!("mesh {mesh} has faces with invalid vertex indices"));
            }
        }
        for skin in 0..self.nskin() {
            let vertices = self.skin_vertnum()[skin];
            let faces = self.skin_face().get(part(self.skin_faceadr(), self.skin_facenum(), skin, 3));
            if !faces.is_some_and(|faces| within(faces, vertices)) {
                return Err(format!("skin {skin} has faces with invalid vertex indices"));
            }
        }
        Ok(())
    }

    /// Returns a deep copy.
    ///
    /// # Errors
    /// [`Error::Raised`] if MuJoCo cannot allocate it.
    pub fn try_clone(&self) -> Result<Self, Error> {
        let mut copy = ptr::null_mut();
        // SAFETY: reads a valid model and writes the pointer of a new one.
        guarded("mj_copyModel", unsafe { mujoco_sys::mjshim_copy_model(self.pointer.as_ptr(), &mut copy) })?;
        let pointer = NonNull::new(copy)
            .ok_or_else(|| Error::Raised { call: "mj_copyModel", message: "no memory for the copy".into() })?;
        Ok(Self { pointer, structure: Arc::clone(&self.structure) })
    }

    /// Returns true if both models are copies of the same compiled model; their numbers may differ.
    pub fn is_copy_of(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.structure, &other.structure)
    }

    /// Returns mutable access to the numbers of the model.
    pub fn patch(&mut self) -> ModelMut<'_> {
        ModelMut { model: self }
    }

    /// Returns the object with a name.
    ///
    /// # Errors
    /// [`Error::UnknownName`] if the model has no such object.
    pub fn find<I: ObjectId>(&self, name: &str) -> Result<I, Error> {
        let unknown = || Error::UnknownName { kind: I::KIND, name: name.to_string() };
        let c_name = CString::new(name).map_err(|_| unknown())?;
        if name.is_empty() {
            // MuJoCo would return the first unnamed object
            return Err(unknown());
        }
        // SAFETY: reads the model's table of names.
        let index = unsafe { mujoco_sys::mj_name2id(self.pointer.as_ptr(), I::KIND.code() as i32, c_name.as_ptr()) };
        usize::try_from(index).map(I::new).map_err(|_| unknown())
    }

    /// Returns the name of an object; `None` if the object is unnamed or not in this model.
    pub fn name<I: ObjectId>(&self, id: I) -> Option<&str> {
        let index = i32::try_from(id.get()).ok()?;
        // SAFETY: MuJoCo checks the index against the number of objects.
        let name = unsafe { mujoco_sys::mj_id2name(self.pointer.as_ptr(), I::KIND.code() as i32, index) };
        if name.is_null() {
            return None;
        }
        // SAFETY: points into the model's table of terminated names.
        unsafe { CStr::from_ptr(name) }.to_str().ok()
    }

    /// Returns the number of objects of a kind.
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

    /// Returns the time step, s.
    pub fn timestep(&self) -> f64 {
        self.raw().opt.timestep
    }

    /// Returns the gravitational acceleration, world frame, m/s².
    pub fn gravity(&self) -> [f64; 3] {
        self.raw().opt.gravity
    }

    /// Returns the density of the medium, kg/m³; 0 for a vacuum.
    pub fn density(&self) -> f64 {
        self.raw().opt.density
    }

    /// Returns the viscosity of the medium, Pa·s; 0 for a vacuum.
    pub fn viscosity(&self) -> f64 {
        self.raw().opt.viscosity
    }

    /// Returns the integrator; `None` if it is unknown.
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

/// Passes text to MuJoCo's compiler without validation, for tests of its errors.
///
/// # Safety
/// The text must not make MuJoCo access invalid memory.
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
