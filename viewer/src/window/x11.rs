//! Loss of the connection to an X server.
//!
//! Xlib ends the process when the connection breaks, unless a program installs its own handlers. A flight must go on
//! without its window. After the handler returns, Xlib's callers may use an unusable connection: therefore the
//! handler stops the window's thread for ever, and the other threads continue.
#![allow(unsafe_code)]

use std::ffi::c_void;

use libloading::os::unix::Library;
use winit::raw_window_handle::{HasDisplayHandle, RawDisplayHandle};

type Display = *mut c_void;
type IoErrorHandler = unsafe extern "C" fn(Display) -> i32;
type IoErrorExitHandler = unsafe extern "C" fn(Display, *mut c_void);

/// Calls `lost` on the window's thread if the connection of an X11 display breaks; the thread does not continue.
pub(super) fn watch(display: &impl HasDisplayHandle, lost: fn()) {
    let Ok(RawDisplayHandle::Xlib(handle)) = display.display_handle().map(|handle| handle.as_raw()) else { return };
    let Some(display) = handle.display else { return };
    // SAFETY: winit has loaded the library already; the types are those of Xlib's header. The functions only store
    // the handlers, which live as long as the process. The library is never unloaded.
    unsafe {
        let Ok(library) = Library::new("libX11.so.6") else { return };
        if let Ok(set) = library.get::<unsafe extern "C" fn(IoErrorHandler) -> *mut c_void>(b"XSetIOErrorHandler\0") {
            set(say_nothing);
        }
        if let Ok(set) = library.get::<unsafe extern "C" fn(Display, IoErrorExitHandler, *mut c_void)>(
            b"XSetIOErrorExitHandler\0",
        ) {
            set(display.as_ptr(), stop, lost as *mut c_void);
        }
        std::mem::forget(library);
    }
}

/// Replaces the handler that prints a message.
unsafe extern "C" fn say_nothing(_: Display) -> i32 {
    0
}

/// Reports the loss and keeps the thread.
unsafe extern "C" fn stop(_: Display, lost: *mut c_void) {
    // SAFETY: the pointer is the function that `watch` stored.
    let lost = unsafe { std::mem::transmute::<*mut c_void, fn()>(lost) };
    lost();
    loop {
        std::thread::park();
    }
}
