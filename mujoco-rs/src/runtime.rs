//! The process-wide part of MuJoCo: its version and its error and warning handlers.

use std::ffi::{CStr, CString, c_char};
use std::sync::OnceLock;

use crate::error::Error;

/// The version of the headers that this crate was built against, as `major.minor.patch`.
pub const HEADER_VERSION: [u32; 3] = digits(mujoco_sys::mjVERSION_HEADER);

const fn digits(version: u32) -> [u32; 3] {
    [version / 100, version / 10 % 10, version % 10]
}

/// The version of the MuJoCo library that is loaded, as `major.minor.patch`.
pub fn library_version() -> [u32; 3] {
    // SAFETY: returns a constant.
    digits(unsafe { mujoco_sys::mj_version() }.unsigned_abs())
}

/// Installs the handlers and refuses a library whose structures are not those of the headers.
///
/// Every constructor of this crate calls it first. It is public for programs that want to know early.
///
/// # Errors
/// [`Error::Version`] if the library's version is not that of the headers.
pub fn check_library() -> Result<(), Error> {
    static VERSION: OnceLock<[u32; 3]> = OnceLock::new();
    let found = *VERSION.get_or_init(|| {
        // SAFETY: before any other call of MuJoCo, once in the process; the callback returns and never unwinds.
        unsafe { mujoco_sys::mjshim_install(Some(on_warning)) };
        library_version()
    });
    if found == HEADER_VERSION { Ok(()) } else { Err(Error::Version { found, expected: HEADER_VERSION }) }
}

/// MuJoCo's warnings go to `tracing`, not into a log file in the current directory.
extern "C" fn on_warning(message: *const c_char) {
    if !message.is_null() {
        // SAFETY: MuJoCo passes a terminated string that lives through this call.
        let message = unsafe { CStr::from_ptr(message) }.to_string_lossy();
        tracing::warn!(target: "mujoco", "{message}");
    }
}

/// The result of a guarded call of the shim: 0, or 1 and a message kept for this thread.
pub(crate) fn guarded(call: &'static str, status: i32) -> Result<(), Error> {
    if status == 0 {
        return Ok(());
    }
    // SAFETY: the shim's buffer of this thread, terminated, unchanged until its next guarded call.
    let message = unsafe { CStr::from_ptr(mujoco_sys::mjshim_last_error()) }.to_string_lossy().into_owned();
    Err(Error::Raised { call, message })
}

/// Raises an `mju_error`: with `guarded` it comes back as an error, otherwise it ends the process.
#[doc(hidden)]
pub fn raise(message: &str, guarded_call: bool) -> Result<(), Error> {
    check_library()?;
    let message = CString::new(message).map_err(|_| Error::Nul { what: "message" })?;
    // SAFETY: the string is terminated; under the guard only C frames are left behind.
    guarded("mju_error", unsafe { mujoco_sys::mjshim_raise(message.as_ptr(), guarded_call.into()) })
}
