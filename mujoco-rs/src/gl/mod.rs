//! An OpenGL context without a window, by EGL or OSMesa.
//!
//! MuJoCo looks OpenGL's functions up among the libraries that the process has made global, EGL's before OSMesa's. So
//! exactly one of the two is made global, once it has shown that it can make a context; the other stays invisible.

mod egl;
pub(crate) mod gate;
mod osmesa;

use std::ffi::{CStr, c_void};
use std::mem::ManuallyDrop;
use std::sync::{OnceLock, PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard};

use libloading::os::unix::Library as SystemLibrary;

use crate::backend::GlBackend;
use crate::error::{Error, GlAttempt};

/// The library that this process draws with.
enum Library {
    Egl(egl::Egl),
    Osmesa(osmesa::Osmesa),
}

/// Largest sizes that the library can draw.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Limits {
    /// Side of a texture, pixels.
    pub texture: u32,
    /// Side of a picture, pixels.
    pub picture: u32,
    /// Samples per pixel.
    pub samples: u32,
}

impl Limits {
    /// Those of the current context, whose functions `address` finds.
    fn of(address: impl Fn(&CStr) -> *mut c_void) -> Self {
        const MAX_TEXTURE_SIZE: u32 = 0x0D33;
        const MAX_RENDERBUFFER_SIZE: u32 = 0x84E8;
        const MAX_SAMPLES: u32 = 0x8D57;
        let get_integer = address(c"glGetIntegerv");
        let limit = |name: u32| {
            let mut value = 0_i32;
            // SAFETY: null or OpenGL's function of that name, of the type in its registry; a context is current, and each of
            // these limits is one number.
            unsafe {
                let get = std::mem::transmute::<*mut c_void, Option<unsafe extern "C" fn(u32, *mut i32)>>(get_integer);
                if let Some(get) = get {
                    get(name, &mut value);
                }
            }
            // a driver that does not say has no limit of its own
            u32::try_from(value).ok().filter(|&limit| limit > 0).unwrap_or(u32::MAX)
        };
        Self { texture: limit(MAX_TEXTURE_SIZE), picture: limit(MAX_RENDERBUFFER_SIZE), samples: limit(MAX_SAMPLES) }
    }
}

/// Returns the largest sizes that can be drawn.
pub(crate) fn limits() -> Result<Limits, Error> {
    Ok(match library()? {
        Library::Egl(egl) => egl.limits(),
        Library::Osmesa(osmesa) => osmesa.limits(),
    })
}

/// A context of its own, current on no thread between calls of [`current`](Self::current), so that it can be moved.
pub(crate) struct GlContext {
    context: ManuallyDrop<Context>,
}

enum Context {
    Egl(egl::Context),
    Osmesa(osmesa::Context),
}

/// MuJoCo keeps OpenGL's functions in process-wide variables that it sets whenever a context is made: then nobody may
/// draw.
static FUNCTIONS: RwLock<()> = RwLock::new(());

pub(crate) fn drawing() -> RwLockReadGuard<'static, ()> {
    FUNCTIONS.read().unwrap_or_else(PoisonError::into_inner)
}

pub(crate) fn loading() -> RwLockWriteGuard<'static, ()> {
    FUNCTIONS.write().unwrap_or_else(PoisonError::into_inner)
}

/// The library, found at the first call. A failure is final for the process, as a success is.
fn library() -> Result<&'static Library, Error> {
    static LIBRARY: OnceLock<Result<Library, Error>> = OnceLock::new();
    let find = || {
        let _inside = gate::enter().ok_or_else(ending)?;
        // the first use is one that the end of the process waits for, too
        gate::close_at_exit();
        // SAFETY: one thread at a time, which the lock around it sees to; between the two calls drivers start and read it.
        unsafe { mujoco_sys::mjshim_without_rasteriser_threads() };
        let found = find();
        // SAFETY: as above.
        unsafe { mujoco_sys::mjshim_restore_environment() };
        if let Ok(Library::Egl(egl)) = &found {
            egl.release_thread();
        }
        gate::close_at_exit();
        found
    };
    LIBRARY.get_or_init(find).as_ref().map_err(Clone::clone)
}

/// A use of OpenGL by the calling thread, which leaves nothing of it behind: no context and no state that the thread's end would
/// have to free.
struct Session {
    library: &'static Library,
    _inside: gate::Inside,
}

impl Session {
    fn begin() -> Result<Self, Error> {
        let library = library()?;
        Ok(Self { library, _inside: gate::enter().ok_or_else(ending)? })
    }
}

impl Drop for Session {
    fn drop(&mut self) {
        if let Library::Egl(egl) = self.library {
            egl.release_thread();
        }
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
                // who names a device does not want another one
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

/// What draws in this process, and on what.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GlInfo {
    /// The library.
    pub backend: GlBackend,
    /// The device, where the library says which.
    pub device: String,
}

/// Finds out what draws in this process, loading it if nothing has been drawn yet.
///
/// `MUJOCO_GL` (`egl` or `osmesa`) chooses the library, `MUJOCO_EGL_DEVICE_ID` the EGL device; without them each is
/// tried in turn. While the library starts, `LP_NUM_THREADS=0` is in the environment unless the variable is there: it keeps
/// Mesa's software rasteriser from starting threads of its own, which small pictures have no use for.
///
/// ```
/// use mujoco_rs::{GlBackend, gl_info};
///
/// match gl_info() {
///     Ok(info) => assert!(GlBackend::ALL.contains(&info.backend)),
///     Err(error) => assert!(!error.to_string().is_empty(), "what was tried, and what to install"),
/// }
/// ```
///
/// # Errors
/// [`Error::NoGl`] with what was tried and what each answered; [`Error::GlName`] and [`Error::GlDevice`] for variables that name
/// nothing.
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
        Ok(Self { context: ManuallyDrop::new(context) })
    }

    /// Runs `draw` with this context current on the calling thread, and on none afterwards. Not to be nested.
    pub(crate) fn current<T>(&mut self, draw: impl FnOnce() -> T) -> Result<T, Error> {
        struct Release<'a>(&'a Context);
        impl Drop for Release<'_> {
            fn drop(&mut self) {
                match self.0 {
                    Context::Egl(context) => context.release(),
                    Context::Osmesa(context) => context.release(),
                }
            }
        }
        let _session = Session::begin()?;
        match &mut *self.context {
            Context::Egl(context) => context.make_current(),
            Context::Osmesa(context) => context.make_current(),
        }
        .map_err(|message| Error::Gl { message })?;
        let _release = Release(&self.context);
        let drawn = draw();
        gate::used();
        Ok(drawn)
    }
}

impl Drop for GlContext {
    fn drop(&mut self) {
        // where the process is ending, the context ends with it
        if let Ok(_session) = Session::begin() {
            // SAFETY: nobody uses it afterwards.
            unsafe { ManuallyDrop::drop(&mut self.context) };
        }
    }
}

/// Opens the first of these libraries that is there. The error is one short reason: of a library that is there and cannot be
/// loaded, if there is one, or else that the first one is missing.
fn open(names: &[&'static str], flags: i32) -> Result<(&'static str, SystemLibrary), String> {
    let mut damaged = None;
    for &name in names {
        // SAFETY: a system library, whose initialisers are those of any program that draws.
        match unsafe { SystemLibrary::open(Some(name), flags) } {
            Ok(library) => return Ok((name, library)),
            Err(error) => {
                let reason = reason(&error);
                // a library that it needs may be missing, too: that is another name
                if !(reason.starts_with(name) && reason.contains("No such file")) {
                    damaged.get_or_insert(reason);
                }
            }
        }
    }
    Err(damaged.unwrap_or_else(|| format!("{} is not installed", names.first().copied().unwrap_or_default())))
}

/// What the loader says, down to the system's own words.
fn reason(error: &libloading::Error) -> String {
    use std::error::Error as _;
    error.source().map_or_else(|| error.to_string(), |source| source.to_string())
}
