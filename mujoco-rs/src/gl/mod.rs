//! An OpenGL context without a window, by EGL or OSMesa.
//!
//! MuJoCo looks OpenGL's functions up among the libraries that the process has made global, EGL's before OSMesa's. So
//! exactly one of the two is made global, once it has shown that it can make a context; the other stays invisible.

mod egl;
mod osmesa;

use std::fmt;
use std::sync::{OnceLock, PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard};

use libloading::os::unix::Library as SystemLibrary;

use crate::error::{Error, GlAttempt};

/// A way to an OpenGL context.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum GlBackend {
    /// EGL: a GPU's driver, or Mesa's software rasteriser.
    Egl,
    /// Mesa's off-screen library, in software.
    Osmesa,
}

impl GlBackend {
    /// Both, in the order in which they are tried.
    pub const ALL: [Self; 2] = [Self::Egl, Self::Osmesa];

    /// The name that `MUJOCO_GL` has for it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Egl => "egl",
            Self::Osmesa => "osmesa",
        }
    }

    /// Debian's packages that bring it.
    pub fn packages(self) -> &'static str {
        match self {
            Self::Egl => "libegl1 libgl1-mesa-dri",
            Self::Osmesa => "libosmesa6",
        }
    }
}

impl fmt::Display for GlBackend {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// The library that this process draws with.
enum Library {
    Egl(egl::Egl),
    Osmesa(osmesa::Osmesa),
}

/// A context of its own, current on no thread between calls of [`current`](Self::current), so that it can be moved.
pub(crate) struct GlContext {
    context: Context,
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
    LIBRARY.get_or_init(find).as_ref().map_err(Clone::clone)
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
/// tried in turn.
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
        let context = match library()? {
            Library::Egl(egl) => egl.context().map(Context::Egl),
            Library::Osmesa(osmesa) => osmesa.context().map(Context::Osmesa),
        };
        context.map(|context| Self { context }).map_err(|message| Error::Gl { message })
    }

    /// Runs `draw` with this context current on the calling thread, and on none afterwards.
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
        match &mut self.context {
            Context::Egl(context) => context.make_current(),
            Context::Osmesa(context) => context.make_current(),
        }
        .map_err(|message| Error::Gl { message })?;
        let _release = Release(&self.context);
        Ok(draw())
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
