//! OSMesa, Mesa's off-screen library.

use std::ffi::{CStr, c_char, c_void};
use std::ptr;

use libloading::os::unix::{Library, RTLD_GLOBAL, RTLD_LOCAL, RTLD_NOW};

use super::{Limits, reason};

type Pointer = *mut c_void;

const NAMES: [&str; 3] = ["libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so"];
const RGBA: u32 = 0x1908;
const UNSIGNED_BYTE: u32 = 0x1401;
/// Side of the buffer that a context is bound to, pixels; MuJoCo renders into its own framebuffer.
const SIDE: i32 = 8;

pub(super) struct Osmesa {
    functions: Functions,
    limits: Limits,
    /// Never unloaded: MuJoCo keeps its functions.
    _library: Library,
}

#[derive(Clone, Copy)]
struct Functions {
    create: unsafe extern "C" fn(u32, i32, i32, i32, Pointer) -> Pointer,
    destroy: unsafe extern "C" fn(Pointer),
    make_current: unsafe extern "C" fn(Pointer, Pointer, u32, i32, i32) -> u8,
    get_proc_address: unsafe extern "C" fn(*const c_char) -> Pointer,
}

// SAFETY: Mesa's contexts may be created on any thread; Mesa locks internally.
unsafe impl Send for Osmesa {}
// SAFETY: as above.
unsafe impl Sync for Osmesa {}

pub(super) struct Context {
    functions: Functions,
    context: Pointer,
    buffer: Box<[u32]>,
}

// SAFETY: current on no thread except inside a call on it.
unsafe impl Send for Context {}

impl Osmesa {
    pub(super) fn load() -> Result<Self, String> {
        let (name, library) = super::open(&NAMES, RTLD_NOW | RTLD_LOCAL)?;
        Self::try_out(name, library)
    }

    fn try_out(name: &str, library: Library) -> Result<Self, String> {
        let functions = Functions::of(&library)?;
        let tried = functions.context().and_then(|mut context| {
            context.make_current()?;
            let limits = Limits::of(|name| context.address(name));
            context.release();
            Ok(limits)
        });
        // Some drivers crash when they are unloaded, and a library without global symbols does no harm.
        std::mem::forget(library);
        let limits = tried?;
        // SAFETY: already loaded before; this makes its symbols global.
        let library = unsafe { Library::open(Some(name), RTLD_NOW | RTLD_GLOBAL) }.map_err(|error| reason(&error))?;
        Ok(Self { functions: Functions::of(&library)?, limits, _library: library })
    }

    pub(super) fn limits(&self) -> Limits {
        self.limits
    }

    pub(super) fn context(&self) -> Result<Context, String> {
        self.functions.context()
    }
}

impl Functions {
    fn of(library: &Library) -> Result<Self, String> {
        macro_rules! symbol {
            ($name:literal) => {
                // SAFETY: the type is the one of Mesa's header.
                *unsafe { library.get($name) }.map_err(|error| reason(&error))?
            };
        }
        Ok(Self {
            create: symbol!(b"OSMesaCreateContextExt\0"),
            destroy: symbol!(b"OSMesaDestroyContext\0"),
            make_current: symbol!(b"OSMesaMakeCurrent\0"),
            get_proc_address: symbol!(b"OSMesaGetProcAddress\0"),
        })
    }

    fn context(self) -> Result<Context, String> {
        // SAFETY: depth 24, stencil 8, no accumulation buffer, no shared context.
        let context = unsafe { (self.create)(RGBA, 24, 8, 0, ptr::null_mut()) };
        if context.is_null() {
            return Err("OSMesaCreateContextExt failed".into());
        }
        Ok(Context { functions: self, context, buffer: vec![0; (SIDE * SIDE) as usize].into() })
    }
}

impl Context {
    pub(super) fn make_current(&mut self) -> Result<(), String> {
        let buffer = self.buffer.as_mut_ptr().cast();
        // SAFETY: the buffer is as large as stated and lives as long as the context.
        match unsafe { (self.functions.make_current)(self.context, buffer, UNSIGNED_BYTE, SIDE, SIDE) } {
            0 => Err("OSMesaMakeCurrent failed".into()),
            _ => Ok(()),
        }
    }

    /// Returns the address of an OpenGL function.
    pub(super) fn address(&self, name: &CStr) -> *mut c_void {
        // SAFETY: a terminated name.
        unsafe { (self.functions.get_proc_address)(name.as_ptr()) }
    }

    pub(super) fn release(&self) {
        // SAFETY: unbinds the context from this thread.
        unsafe { (self.functions.make_current)(ptr::null_mut(), ptr::null_mut(), UNSIGNED_BYTE, 0, 0) };
    }
}

impl Drop for Context {
    fn drop(&mut self) {
        // SAFETY: current nowhere, destroyed once.
        unsafe { (self.functions.destroy)(self.context) };
    }
}
