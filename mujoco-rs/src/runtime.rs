//! Process-wide state of MuJoCo: version, error and warning handlers.

use std::ffi::{CStr, CString, c_char};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::OnceLock;

use crate::error::Error;

/// Version of the headers that this crate was built against, as `[major, minor, patch]`.
pub const HEADER_VERSION: [u32; 3] = digits(mujoco_sys::mjVERSION_HEADER);

const fn digits(version: u32) -> [u32; 3] {
    [version / 100, version / 10 % 10, version % 10]
}

/// Returns the version of the loaded MuJoCo library, as `[major, minor, patch]`.
pub fn library_version() -> [u32; 3] {
    // SAFETY: returns a constant.
    digits(unsafe { mujoco_sys::mj_version() }.unsigned_abs())
}

/// Installs the error and warning handlers and rejects a library whose version differs from that of the headers.
///
/// Every constructor of this crate calls it first. Programs may call it to detect a wrong library early.
///
/// # Errors
/// [`Error::Version`] if the library's version differs from that of the headers.
pub fn check_library() -> Result<(), Error> {
    static VERSION: OnceLock<[u32; 3]> = OnceLock::new();
    crate::gl::gate::know_main();
    let found = *VERSION.get_or_init(|| {
        // SAFETY: called once in the process, before any other MuJoCo function; the callback returns and never
        // unwinds.
        unsafe { mujoco_sys::mjshim_install(Some(on_warning)) };
        library_version()
    });
    if found == HEADER_VERSION { Ok(()) } else { Err(Error::Version { found, expected: HEADER_VERSION }) }
}

/// Forwards MuJoCo's warnings to `tracing`, which replaces MuJoCo's log file in the current directory.
extern "C" fn on_warning(message: *const c_char) {
    if !message.is_null() {
        // SAFETY: MuJoCo passes a terminated string that lives through this call.
        let message = unsafe { CStr::from_ptr(message) }.to_string_lossy();
        // a panic of a subscriber would end the process, because it cannot pass C frames
        let _ = catch_unwind(AssertUnwindSafe(|| tracing::warn!(target: "mujoco", "{message}")));
    }
}

/// Returns true if MuJoCo raised an error during a guarded call of the shim.
#[inline]
pub(crate) fn was_raised(status: i32) -> bool {
    status == mujoco_sys::MJSHIM_RAISED as i32
}

/// Converts the status of a guarded call of the shim; the shim keeps an error's message for this thread.
pub(crate) fn guarded(call: &'static str, status: i32) -> Result<(), Error> {
    if status == 0 {
        return Ok(());
    }
    // SAFETY: the shim's buffer of this thread is terminated and unchanged until the thread's next guarded call.
    let message = unsafe { CStr::from_ptr(mujoco_sys::mjshim_last_error()) }.to_string_lossy().into_owned();
    Err(Error::Raised { call, message })
}

/// Raises an `mju_error`. With `guarded_call` it is returned as an error, otherwise it ends the process.
#[doc(hidden)]
pub fn raise(message: &str, guarded_call: bool) -> Result<(), Error> {
    check_library()?;
    let message = CString::new(message).map_err(|_| Error::Nul { what: "message" })?;
    // SAFETY: the string is terminated; under the guard only C frames are left behind.
    guarded("mju_error", unsafe { mujoco_sys::mjshim_raise(message.as_ptr(), guarded_call.into()) })
}

/// Asserts that work preserves a host program's error handlers and its `rand()` sequence.
#[doc(hidden)]
pub fn assert_host_is_left_alone(work: impl Fn()) {
    unsafe extern "C" fn handler(_: *const c_char) {}
    unsafe extern "C" {
        fn srand(seed: u32);
        fn rand() -> i32;
    }
    // SAFETY: functions of the C library that accept all arguments.
    let draw = || unsafe { rand() };
    // SAFETY: as above.
    unsafe { srand(7) };
    let expected = [draw(), draw(), draw()];
    // SAFETY: as above; the handlers are written before any other thread calls MuJoCo.
    unsafe {
        srand(7);
        mujoco_sys::mju_user_error = Some(handler);
        mujoco_sys::mju_user_warning = Some(handler);
    }
    let mut drawn = Vec::new();
    for _ in 0..3 {
        work();
        drawn.push(draw());
    }
    assert_eq!(drawn, expected, "the host's random numbers");
    // SAFETY: reads the values written above, on the same thread.
    let handlers = unsafe { [mujoco_sys::mju_user_error, mujoco_sys::mju_user_warning] };
    let is_ours = |found: Option<unsafe extern "C" fn(*const c_char)>| {
        found.is_some_and(|found| std::ptr::fn_addr_eq(found, handler as unsafe extern "C" fn(*const c_char)))
    };
    assert!(handlers.into_iter().all(is_ours), "the host's handlers");
}
