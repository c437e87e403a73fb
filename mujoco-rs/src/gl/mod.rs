//! Off-screen OpenGL contexts, by EGL or OSMesa.
//!
//! MuJoCo looks OpenGL's functions up among the process's global symbols, EGL's before OSMesa's. Therefore exactly
//! one library is loaded globally, after a test has created a context with it.

mod egl;
pub(crate) mod gate;
mod osmesa;

use std::cell::{Cell, RefCell};
use std::ffi::{CStr, c_void};
use std::mem::ManuallyDrop;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard};
use std::thread::{self, ThreadId};

use libloading::os::unix::Library as SystemLibrary;

use crate::backend::GlBackend;
use crate::error::{Error, GlAttempt};

/// OpenGL library of this process.
enum Library {
    Egl(egl::Egl),
    Osmesa(osmesa::Osmesa),
}

/// Size limits of the driver.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Limits {
    /// Largest side of a texture, pixels.
    pub texture: u32,
    /// Largest side of an image, pixels.
    pub image: u32,
    /// Largest number of samples per pixel.
    pub samples: u32,
}

impl Limits {
    /// Reads the limits of the current context, whose functions `address` finds.
    fn of(address: impl Fn(&CStr) -> *mut c_void) -> Self {
        const MAX_TEXTURE_SIZE: u32 = 0x0D33;
        const MAX_RENDERBUFFER_SIZE: u32 = 0x84E8;
        const MAX_SAMPLES: u32 = 0x8D57;
        let get_integer = address(c"glGetIntegerv");
        let limit = |name: u32| {
            let mut value = 0_i32;
            // SAFETY: null or the OpenGL function of that name, with its registered type; a context is current, and
            // each limit is one number.
            unsafe {
                let get = std::mem::transmute::<*mut c_void, Option<unsafe extern "C" fn(u32, *mut i32)>>(get_integer);
                if let Some(get) = get {
                    get(name, &mut value);
                }
            }
            // a driver that reports no limit is treated as unlimited
            u32::try_from(value).ok().filter(|&limit| limit > 0).unwrap_or(u32::MAX)
        };
        Self { texture: limit(MAX_TEXTURE_SIZE), image: limit(MAX_RENDERBUFFER_SIZE), samples: limit(MAX_SAMPLES) }
    }
}

/// Returns the driver's size limits.
pub(crate) fn limits() -> Result<Limits, Error> {
    Ok(match library()? {
        Library::Egl(egl) => egl.limits(),
        Library::Osmesa(osmesa) => osmesa.limits(),
    })
}

/// OpenGL context. It is current on no thread outside of calls of [`current`](Self::current), so that it can be moved.
/// Clones are the same context.
#[derive(Clone)]
pub(crate) struct GlContext(Arc<Mutex<Shared>>);

/// Context with the thread on which it is current.
struct Shared {
    context: ManuallyDrop<Context>,
    thread: Option<ThreadId>,
}

enum Context {
    Egl(egl::Context),
    Osmesa(osmesa::Context),
}

thread_local! {
    /// Context that is current on this thread. Without a destructor, so that it is usable while the thread ends.
    static CURRENT: RefCell<ManuallyDrop<Option<GlContext>>> = const { RefCell::new(ManuallyDrop::new(None)) };
    /// True while this thread has a [`Session`].
    static IN_SESSION: Cell<bool> = const { Cell::new(false) };
}

/// Lock around MuJoCo's process-wide table of OpenGL functions: creating a context writes the table, rendering
/// reads it.
static FUNCTIONS: RwLock<()> = RwLock::new(());

pub(crate) fn drawing() -> RwLockReadGuard<'static, ()> {
    FUNCTIONS.read().unwrap_or_else(PoisonError::into_inner)
}

pub(crate) fn loading() -> RwLockWriteGuard<'static, ()> {
    FUNCTIONS.write().unwrap_or_else(PoisonError::into_inner)
}

/// Returns the library; the first call loads it. A failure is final for the process, as is a success.
fn library() -> Result<&'static Library, Error> {
    static LIBRARY: OnceLock<Result<Library, Error>> = OnceLock::new();
    let find = || {
        let _inside = gate::enter().ok_or_else(ending)?;
        // register the handler before the first use, so that the process's end waits for that use
        gate::close_at_exit();
        // SAFETY: `OnceLock` runs this on one thread at a time; drivers start between the two calls and read the
        // environment.
        unsafe { mujoco_sys::mjshim_without_rasteriser_threads() };
        let found = find();
        // SAFETY: as above.
        unsafe { mujoco_sys::mjshim_restore_environment() };
        gate::close_at_exit();
        found
    };
    LIBRARY.get_or_init(find).as_ref().map_err(Clone::clone)
}

/// Use of OpenGL by the calling thread. The end of the outermost one releases EGL's thread state, so that the thread's
/// end has nothing to free, and makes a context of another library that was current before current again.
struct Session {
    library: &'static Library,
    foreign: Option<egl::Foreign>,
    /// `None` if another session of the thread encloses this one.
    inside: Option<gate::Inside>,
}

impl Session {
    fn begin() -> Result<Self, Error> {
        let library = library()?;
        let inside = if IN_SESSION.get() { None } else { Some(gate::enter().ok_or_else(ending)?) };
        IN_SESSION.set(true);
        let foreign = match library {
            Library::Egl(egl) if inside.is_some() => egl.foreign(),
            _ => None,
        };
        Ok(Self { library, foreign, inside })
    }
}

impl Drop for Session {
    fn drop(&mut self) {
        if self.inside.is_none() {
            return;
        }
        if let Library::Egl(egl) = self.library {
            egl.release_thread();
        }
        if let Some(foreign) = &self.foreign {
            foreign.restore();
        }
        IN_SESSION.set(false);
    }
}

fn ending() -> Error {
    Error::Gl { message: "the process is ending".into() }
}

fn find() -> Result<Library, Error> {
    let wanted = match std::env::var("MUJOCO_GL") {
        Ok(name) if !name.is_empty() => match name.to_ascii_lowercase().as_str() {
            "egl" => vec![GlBackend::Egl],
            "osmesa" => vec![GlBackend::Osmesa],
            // the choice of a window for MuJoCo's viewer; it says nothing about images without a window
            "glfw" => GlBackend::ALL.to_vec(),
            _ => return Err(Error::GlName { got: name }),
        },
        _ => GlBackend::ALL.to_vec(),
    };
    let device = match std::env::var("MUJOCO_EGL_DEVICE_ID") {
        Ok(text) if !text.is_empty() => {
            Some(text.parse::<usize>().map_err(|_| Error::GlDevice { got: text, expected: "a number from 0".into() })?)
        }
        _ => None,
    };
    let mut attempts = Vec::new();
    for backend in wanted {
        let found = match backend {
            GlBackend::Egl => match egl::Egl::load(device) {
                // do not fall back to another device than the requested one
                Err(egl::Refusal::Device { count }) => {
                    let got = device.map_or_else(String::new, |index| index.to_string());
                    return Err(Error::GlDevice {
                        got,
                        expected: format!("a number below {count}, the number of EGL devices"),
                    });
                }
                Err(egl::Refusal::Answer(answer)) => Err(answer),
                Ok(egl) => Ok(Library::Egl(egl)),
            },
            GlBackend::Osmesa => osmesa::Osmesa::load().map(Library::Osmesa),
        };
        match found {
            Ok(library) => return Ok(library),
            Err(answer) => attempts.push(GlAttempt { backend, answer }),
        }
    }
    Err(Error::NoGl { attempts })
}

/// OpenGL backend and device of this process.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GlInfo {
    /// Loaded backend.
    pub backend: GlBackend,
    /// Device, if the library names it.
    pub device: String,
}

/// Returns the OpenGL backend and device of this process; loads the library at the first call.
///
/// `MUJOCO_GL` (`egl` or `osmesa`) selects the library, `MUJOCO_EGL_DEVICE_ID` the EGL device; if unset, each is
/// tried in turn, and also with `MUJOCO_GL=glfw`, which selects the window of MuJoCo's viewer. While the library
/// starts, `LP_NUM_THREADS=0` is in the environment unless the variable is set: it stops Mesa's software rasterizer
/// from starting worker threads, which do not speed up small images.
///
/// ```
/// use mujoco_rs::{GlBackend, gl_info};
///
/// match gl_info() {
///     Ok(info) => assert!(GlBackend::ALL.contains(&info.backend)),
///     Err(error) => assert!(!error.to_string().is_empty(), "the attempts, and the packages to install"),
/// }
/// ```
///
/// # Errors
/// [`Error::NoGl`] with all attempts and their answers; [`Error::GlName`] and [`Error::GlDevice`] for invalid
/// variables.
pub fn gl_info() -> Result<GlInfo, Error> {
    Ok(match library()? {
        Library::Egl(egl) => GlInfo { backend: GlBackend::Egl, device: egl.description() },
        Library::Osmesa(_) => GlInfo { backend: GlBackend::Osmesa, device: "software".into() },
    })
}

impl GlContext {
    pub(crate) fn new() -> Result<Self, Error> {
        let session = Session::begin()?;
        let context = match session.library {
            Library::Egl(egl) => egl.context().map(Context::Egl),
            Library::Osmesa(osmesa) => osmesa.context().map(Context::Osmesa),
        };
        let context = context.map_err(|message| Error::Gl { message })?;
        Ok(Self(Arc::new(Mutex::new(Shared { context: ManuallyDrop::new(context), thread: None }))))
    }

    /// Runs work with this context current on the calling thread. Afterwards the context that was current before is
    /// current again. A call for the context that is current already costs nothing.
    ///
    /// # Errors
    /// [`Error::Gl`] if the context is current on another thread.
    pub(crate) fn current<T>(&self, work: impl FnOnce() -> T) -> Result<T, Error> {
        let before = CURRENT.with_borrow(|current| Option::clone(current));
        if before.as_ref().is_some_and(|before| Arc::ptr_eq(&before.0, &self.0)) {
            let done = work();
            gate::used();
            return Ok(done);
        }
        let session = Session::begin()?;
        self.bind()?;
        let scope = Scope { own: self.clone(), before, _session: session };
        set_current(Some(self.clone()));
        let done = work();
        gate::used();
        drop(scope);
        Ok(done)
    }

    fn lock(&self) -> MutexGuard<'_, Shared> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Makes the context current on this thread.
    fn bind(&self) -> Result<(), Error> {
        let (mut shared, own) = (self.lock(), thread::current().id());
        if shared.thread.is_some_and(|thread| thread != own) {
            return Err(Error::Gl { message: "the context is in use on another thread".into() });
        }
        match &mut *shared.context {
            Context::Egl(context) => context.make_current(),
            Context::Osmesa(context) => context.make_current(),
        }
        .map_err(|message| Error::Gl { message })?;
        shared.thread = Some(own);
        Ok(())
    }

    /// Makes no context current on this thread.
    fn unbind(&self) {
        let mut shared = self.lock();
        match &*shared.context {
            Context::Egl(context) => context.release(),
            Context::Osmesa(context) => context.release(),
        }
        shared.thread = None;
    }
}

/// Use of a context on this thread. Its end restores the context that was current before.
struct Scope {
    // dropped before the session, because the last clone of a context destroys it
    own: GlContext,
    before: Option<GlContext>,
    _session: Session,
}

impl Drop for Scope {
    fn drop(&mut self) {
        self.own.unbind();
        if let Some(before) = &self.before {
            // after a failure, the calls of OpenGL in the enclosing work have no effect
            let _ = before.bind();
        }
        set_current(self.before.take());
    }
}

fn set_current(context: Option<GlContext>) {
    drop(ManuallyDrop::into_inner(CURRENT.replace(ManuallyDrop::new(context))));
}

impl Drop for Shared {
    fn drop(&mut self) {
        // at the end of the process, the context ends with it
        if let Ok(_session) = Session::begin() {
            // SAFETY: nothing uses it afterwards.
            unsafe { ManuallyDrop::drop(&mut self.context) };
        }
    }
}

/// Opens the first available library of the list. The error is the reason why an existing library cannot be loaded,
/// or that the first one is missing.
fn open(names: &[&'static str], flags: i32) -> Result<(&'static str, SystemLibrary), String> {
    let mut damaged = None;
    for &name in names {
        // SAFETY: a system library, whose initializers are those of any program that draws.
        match unsafe { SystemLibrary::open(Some(name), flags) } {
            Ok(library) => return Ok((name, library)),
            Err(error) => {
                let reason = reason(&error);
                // the loader may report a missing dependency, under another file name
                if !(reason.starts_with(name) && reason.contains("No such file")) {
                    damaged.get_or_insert(reason);
                }
            }
        }
    }
    Err(damaged.unwrap_or_else(|| format!("{} is not installed", names.first().copied().unwrap_or_default())))
}

/// Returns the loader's message without libloading's prefix.
fn reason(error: &libloading::Error) -> String {
    use std::error::Error as _;
    error.source().map_or_else(|| error.to_string(), |source| source.to_string())
}
