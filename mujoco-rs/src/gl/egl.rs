//! EGL without a window system: tries device displays in turn, then Mesa's surfaceless platform.

use std::ffi::{CStr, c_char, c_void};
use std::ptr;
use std::sync::atomic::{AtomicUsize, Ordering};

use libloading::os::unix::{Library, RTLD_GLOBAL, RTLD_LOCAL, RTLD_NOW};

use super::{Limits, reason};

type Pointer = *mut c_void;
type Int = i32;
type Bool = u32;

const NAMES: [&str; 2] = ["libEGL.so.1", "libEGL.so"];

const NONE: Int = 0x3038;
const EXTENSIONS: Int = 0x3055;
const VENDOR: Int = 0x3053;
const SURFACE_TYPE: Int = 0x3033;
const PBUFFER_BIT: Int = 0x0001;
const RENDERABLE_TYPE: Int = 0x3040;
const OPENGL_BIT: Int = 0x0008;
const RED_SIZE: Int = 0x3024;
const GREEN_SIZE: Int = 0x3023;
const BLUE_SIZE: Int = 0x3022;
const ALPHA_SIZE: Int = 0x3021;
const DEPTH_SIZE: Int = 0x3025;
const STENCIL_SIZE: Int = 0x3026;
const WIDTH: Int = 0x3057;
const HEIGHT: Int = 0x3056;
const DRAW: Int = 0x3059;
const READ: Int = 0x305A;
const OPENGL_API: u32 = 0x30A2;
const PLATFORM_DEVICE: u32 = 0x313F;
const PLATFORM_SURFACELESS: u32 = 0x31DD;

type GetProcAddress = unsafe extern "C" fn(*const c_char) -> Pointer;
type QueryDevices = unsafe extern "C" fn(Int, *mut Pointer, *mut Int) -> Bool;
type GetPlatformDisplay = unsafe extern "C" fn(u32, Pointer, *const Int) -> Pointer;

/// EGL's functions, and the displays on which contexts are created.
pub(super) struct Egl {
    functions: Functions,
    displays: Vec<Display>,
    next: AtomicUsize,
    /// Never unloaded: drivers leave threads and handlers behind.
    _library: Library,
}

#[derive(Clone, Copy)]
struct Functions {
    get_error: unsafe extern "C" fn() -> Int,
    initialize: unsafe extern "C" fn(Pointer, *mut Int, *mut Int) -> Bool,
    query_string: unsafe extern "C" fn(Pointer, Int) -> *const c_char,
    bind_api: unsafe extern "C" fn(u32) -> Bool,
    choose_config: unsafe extern "C" fn(Pointer, *const Int, *mut Pointer, Int, *mut Int) -> Bool,
    create_context: unsafe extern "C" fn(Pointer, Pointer, Pointer, *const Int) -> Pointer,
    destroy_context: unsafe extern "C" fn(Pointer, Pointer) -> Bool,
    create_surface: unsafe extern "C" fn(Pointer, Pointer, *const Int) -> Pointer,
    destroy_surface: unsafe extern "C" fn(Pointer, Pointer) -> Bool,
    make_current: unsafe extern "C" fn(Pointer, Pointer, Pointer, Pointer) -> Bool,
    release_thread: unsafe extern "C" fn() -> Bool,
    query_api: unsafe extern "C" fn() -> u32,
    current_display: unsafe extern "C" fn() -> Pointer,
    current_context: unsafe extern "C" fn() -> Pointer,
    current_surface: unsafe extern "C" fn(Int) -> Pointer,
    get_proc_address: GetProcAddress,
}

struct Display {
    handle: Pointer,
    config: Pointer,
    description: String,
    limits: Limits,
}

// SAFETY: EGL's displays and functions may be used from any thread; EGL locks internally.
unsafe impl Send for Egl {}
// SAFETY: as above.
unsafe impl Sync for Egl {}

/// Context and the small surface that it is bound to; MuJoCo renders into its own framebuffer.
pub(super) struct Context {
    functions: Functions,
    display: Pointer,
    context: Pointer,
    surface: Pointer,
}

// SAFETY: current on no thread except inside a call on it.
unsafe impl Send for Context {}

/// Context of another library that is current on a thread.
pub(super) struct Foreign {
    functions: Functions,
    api: u32,
    display: Pointer,
    context: Pointer,
    draw: Pointer,
    read: Pointer,
}

impl Foreign {
    /// Returns the context that is current on this thread, if there is one.
    fn current(functions: Functions) -> Option<Self> {
        // SAFETY: reads the state of this thread.
        unsafe {
            let context = (functions.current_context)();
            (!context.is_null()).then(|| Self {
                functions,
                api: (functions.query_api)(),
                display: (functions.current_display)(),
                context,
                draw: (functions.current_surface)(DRAW),
                read: (functions.current_surface)(READ),
            })
        }
    }

    /// Makes the context current again. Its owner may have destroyed it on another thread since; then no context is
    /// current.
    pub(super) fn restore(&self) {
        // SAFETY: EGL rejects handles that are no longer valid.
        unsafe {
            (self.functions.bind_api)(self.api);
            (self.functions.make_current)(self.display, self.draw, self.read, self.context);
        }
    }
}

/// Reason why EGL is unavailable.
pub(super) enum Refusal {
    /// Attempts and their answers.
    Answer(String),
    /// The requested device does not exist.
    Device { count: usize },
}

impl From<String> for Refusal {
    fn from(answer: String) -> Self {
        Self::Answer(answer)
    }
}

impl Egl {
    /// Loads EGL and finds a display that supports a context; otherwise returns the answers of all attempts.
    ///
    /// If `device` is set, only that device is tried.
    pub(super) fn load(device: Option<usize>) -> Result<Self, Refusal> {
        let (name, library) = open(RTLD_LOCAL)?;
        let functions = Functions::load(&library)?;
        let foreign = Foreign::current(functions);
        let displays = displays(functions, device);
        // SAFETY: may be called at any time; no context of this library is current.
        unsafe { (functions.release_thread)() };
        if let Some(foreign) = foreign {
            foreign.restore();
        }
        // Some drivers crash when they are unloaded, and a library without global symbols does no harm.
        std::mem::forget(library);
        let displays = displays?;
        // from here on MuJoCo uses this library
        // SAFETY: already loaded; this only makes its symbols global.
        let library = unsafe { Library::open(Some(name), RTLD_NOW | RTLD_GLOBAL) }.map_err(|error| reason(&error))?;
        Ok(Self { functions, displays, next: AtomicUsize::new(0), _library: library })
    }

    pub(super) fn description(&self) -> String {
        self.displays.first().map(|display| display.description.clone()).unwrap_or_default()
    }

    pub(super) fn limits(&self) -> Limits {
        // at least one display exists, and all displays have the same kind of driver
        self.displays[0].limits
    }

    /// Returns the context of another library that is current on this thread, if there is one.
    pub(super) fn foreign(&self) -> Option<Foreign> {
        Foreign::current(self.functions)
    }

    /// Frees EGL's state of the calling thread, which has no current context. Otherwise the thread's end and the
    /// exit handler of the vendor-neutral library, which frees all threads' state, could free it concurrently.
    pub(super) fn release_thread(&self) {
        // SAFETY: may be called at any time.
        unsafe { (self.functions.release_thread)() };
    }

    /// Creates a context. Mesa's software rasterizer works for one context of a display at a time, so that contexts
    /// are distributed over the displays.
    pub(super) fn context(&self) -> Result<Context, String> {
        let turn = self.next.fetch_add(1, Ordering::Relaxed) % self.displays.len();
        let Display { handle, config, .. } = self.displays[turn];
        context(self.functions, handle, config)
    }
}

fn open(visibility: i32) -> Result<(&'static str, Library), String> {
    super::open(&NAMES, RTLD_NOW | visibility)
}

impl Functions {
    fn load(library: &Library) -> Result<Self, String> {
        macro_rules! symbol {
            ($name:literal) => {
                // SAFETY: the type is the one that EGL's registry gives this name.
                *unsafe { library.get($name) }.map_err(|error| reason(&error))?
            };
        }
        Ok(Self {
            get_error: symbol!(b"eglGetError\0"),
            initialize: symbol!(b"eglInitialize\0"),
            query_string: symbol!(b"eglQueryString\0"),
            bind_api: symbol!(b"eglBindAPI\0"),
            choose_config: symbol!(b"eglChooseConfig\0"),
            create_context: symbol!(b"eglCreateContext\0"),
            destroy_context: symbol!(b"eglDestroyContext\0"),
            create_surface: symbol!(b"eglCreatePbufferSurface\0"),
            destroy_surface: symbol!(b"eglDestroySurface\0"),
            make_current: symbol!(b"eglMakeCurrent\0"),
            release_thread: symbol!(b"eglReleaseThread\0"),
            query_api: symbol!(b"eglQueryAPI\0"),
            current_display: symbol!(b"eglGetCurrentDisplay\0"),
            current_context: symbol!(b"eglGetCurrentContext\0"),
            current_surface: symbol!(b"eglGetCurrentSurface\0"),
            get_proc_address: symbol!(b"eglGetProcAddress\0"),
        })
    }

    fn failure(&self, call: &str) -> String {
        // SAFETY: reads and clears this thread's error.
        format!("{call} failed with EGL error {:#06x}", unsafe { (self.get_error)() })
    }

    fn string(&self, display: Pointer, name: Int) -> String {
        // SAFETY: `display` is null or valid; the answer is null or a terminated string that lives as long as the
        // display.
        let text = unsafe { (self.query_string)(display, name) };
        if text.is_null() {
            return String::new();
        }
        // SAFETY: not null, and terminated.
        unsafe { CStr::from_ptr(text) }.to_string_lossy().into_owned()
    }
}

/// Returns every display that supports a context and is of the same kind as the first one.
fn displays(functions: Functions, wanted: Option<usize>) -> Result<Vec<Display>, Refusal> {
    // SAFETY: the types are those of EGL's registry; extensions may be missing, which is a null pointer.
    let (query_devices, platform_display) = unsafe {
        let query = (functions.get_proc_address)(c"eglQueryDevicesEXT".as_ptr());
        let platform = (functions.get_proc_address)(c"eglGetPlatformDisplayEXT".as_ptr());
        (
            std::mem::transmute::<Pointer, Option<QueryDevices>>(query),
            std::mem::transmute::<Pointer, Option<GetPlatformDisplay>>(platform),
        )
    };
    let Some(platform_display) = platform_display else {
        return Err(String::from("this EGL has no eglGetPlatformDisplayEXT").into());
    };

    let mut devices: [Pointer; 32] = [ptr::null_mut(); 32];
    let mut count = 0;
    if let Some(query_devices) = query_devices {
        // SAFETY: room for 32 devices.
        unsafe { query_devices(32, devices.as_mut_ptr(), &mut count) };
    }
    let devices = &devices[..usize::try_from(count).unwrap_or(0).min(32)];

    let mut candidates: Vec<(String, u32, Pointer)> = match wanted {
        Some(index) => match devices.get(index) {
            Some(&device) => vec![(format!("device {index}"), PLATFORM_DEVICE, device)],
            None => return Err(Refusal::Device { count: devices.len() }),
        },
        None => (devices.iter().enumerate())
            .map(|(index, &device)| (format!("device {index}"), PLATFORM_DEVICE, device))
            .collect(),
    };
    if wanted.is_none() && functions.string(ptr::null_mut(), EXTENSIONS).contains("EGL_MESA_platform_surfaceless") {
        candidates.push(("surfaceless".into(), PLATFORM_SURFACELESS, ptr::null_mut()));
    }

    let mut found: Vec<Display> = Vec::new();
    let mut answers: Vec<(String, String)> = Vec::new();
    for (name, platform, native) in candidates {
        // SAFETY: a device that EGL listed, or the surfaceless platform's null.
        let handle = unsafe { platform_display(platform, native, ptr::null()) };
        match Display::open(functions, handle, &name) {
            // additional displays serve software rendering only: a GPU renders for all its contexts
            Ok(display) if found.is_empty() || (display.is_software && found_software(&found)) => {
                found.push(display.display);
            }
            Ok(_) => {}
            // several displays mostly fail for the same reason, which is reported once
            Err(answer) => match answers.iter_mut().find(|(_, same)| *same == answer) {
                Some((names, _)) => *names += &format!(", {name}"),
                None => answers.push((name, answer)),
            },
        }
    }
    if !found.is_empty() {
        return Ok(found);
    }
    let answers: Vec<_> = answers.iter().map(|(names, answer)| format!("{answer} ({names})")).collect();
    Err(Refusal::Answer(if answers.is_empty() { "no EGL device".into() } else { answers.join(", ") }))
}

fn found_software(found: &[Display]) -> bool {
    found.iter().all(|display| display.description.contains("software"))
}

struct Opened {
    display: Display,
    is_software: bool,
}

impl Display {
    /// Initializes a display and creates a context on it as a test.
    fn open(functions: Functions, handle: Pointer, name: &str) -> Result<Opened, String> {
        if handle.is_null() {
            return Err(functions.failure("eglGetPlatformDisplayEXT"));
        }
        // SAFETY: a valid display; the version outputs may be null.
        if unsafe { (functions.initialize)(handle, ptr::null_mut(), ptr::null_mut()) } == 0 {
            return Err(functions.failure("eglInitialize"));
        }
        let attributes = [
            [SURFACE_TYPE, PBUFFER_BIT],
            [RENDERABLE_TYPE, OPENGL_BIT],
            [RED_SIZE, 8],
            [GREEN_SIZE, 8],
            [BLUE_SIZE, 8],
            [ALPHA_SIZE, 8],
            [DEPTH_SIZE, 24],
            [STENCIL_SIZE, 8],
            [NONE, NONE],
        ];
        let (mut config, mut count) = (ptr::null_mut(), 0);
        // SAFETY: a terminated list of attributes and room for one configuration.
        let chosen =
            unsafe { (functions.choose_config)(handle, attributes.as_ptr().cast(), &mut config, 1, &mut count) };
        if chosen == 0 || count < 1 {
            return Err("no configuration for off-screen OpenGL".into());
        }
        let context = context(functions, handle, config)?;
        context.make_current()?;
        let renderer = renderer(functions);
        let limits = Limits::of(|name| context.address(name));
        context.release();
        let is_software = renderer.contains("llvmpipe") || renderer.contains("softpipe") || renderer.contains("swrast");
        let kind = if is_software { "software" } else { "GPU" };
        let description = format!("{name}, {}, {renderer}, {kind}", functions.string(handle, VENDOR));
        Ok(Opened { display: Self { handle, config, description, limits }, is_software })
    }
}

/// Creates a context and its surface on an initialized display, with one of its configurations.
fn context(functions: Functions, display: Pointer, config: Pointer) -> Result<Context, String> {
    // SAFETY: display and configuration come from EGL; the API is chosen per thread.
    unsafe {
        if (functions.bind_api)(OPENGL_API) == 0 {
            return Err(functions.failure("eglBindAPI(EGL_OPENGL_API)"));
        }
        let context = (functions.create_context)(display, config, ptr::null_mut(), ptr::null());
        if context.is_null() {
            return Err(functions.failure("eglCreateContext"));
        }
        let attributes = [[WIDTH, 8], [HEIGHT, 8], [NONE, NONE]];
        let surface = (functions.create_surface)(display, config, attributes.as_ptr().cast());
        let context = Context { functions, display, context, surface };
        if surface.is_null() {
            return Err(functions.failure("eglCreatePbufferSurface"));
        }
        Ok(context)
    }
}

/// Returns the name of the current context's renderer.
fn renderer(functions: Functions) -> String {
    const GL_RENDERER: u32 = 0x1F01;
    // SAFETY: the type is the one of OpenGL's registry; a context is current, whose strings live as long as it does.
    let name = unsafe {
        let get_string =
            std::mem::transmute::<Pointer, Option<unsafe extern "C" fn(u32) -> *const c_char>>((functions
                .get_proc_address)(
                c"glGetString".as_ptr(),
            ));
        get_string.map(|get_string| get_string(GL_RENDERER)).filter(|text| !text.is_null())
    };
    // SAFETY: not null, terminated.
    name.map_or_else(
        || "unknown renderer".into(),
        |text| unsafe { CStr::from_ptr(text) }.to_string_lossy().into_owned(),
    )
}

impl Context {
    pub(super) fn make_current(&self) -> Result<(), String> {
        // SAFETY: the parts of one context, which is current nowhere else.
        unsafe {
            (self.functions.bind_api)(OPENGL_API);
            match (self.functions.make_current)(self.display, self.surface, self.surface, self.context) {
                0 => Err(self.functions.failure("eglMakeCurrent")),
                _ => Ok(()),
            }
        }
    }

    /// Returns the address of an OpenGL function.
    pub(super) fn address(&self, name: &CStr) -> *mut c_void {
        // SAFETY: a terminated name.
        unsafe { (self.functions.get_proc_address)(name.as_ptr()) }
    }

    pub(super) fn release(&self) {
        // SAFETY: unbinds the context from this thread.
        unsafe { (self.functions.make_current)(self.display, ptr::null_mut(), ptr::null_mut(), ptr::null_mut()) };
    }
}

impl Drop for Context {
    fn drop(&mut self) {
        // SAFETY: current nowhere; each is destroyed once.
        unsafe {
            if !self.surface.is_null() {
                (self.functions.destroy_surface)(self.display, self.surface);
            }
            (self.functions.destroy_context)(self.display, self.context);
        }
    }
}
