//! Loss of the connection to an X server.
//!
//! Xlib ends the process when the connection breaks, unless a program installs its own handlers. A flight must go on
//! without its window. After the handler returns, Xlib's callers may use an unusable connection: therefore the
//! handler stops the window's thread for ever, and the other threads continue.
//!
//! Mesa's software rasterizer does not return from `eglSwapBuffers` on a broken connection. Therefore a second thread
//! waits for the end of the connection.
#![allow(unsafe_code)]

use std::ffi::c_void;

use super::priority;
use libloading::os::unix::Library;
use winit::raw_window_handle::{HasDisplayHandle, RawDisplayHandle};

type Display = *mut c_void;
type IoErrorHandler = unsafe extern "C" fn(Display) -> i32;
type IoErrorExitHandler = unsafe extern "C" fn(Display, *mut c_void);

/// Calls `disconnected` if the connection of an X11 display breaks. The thread of the windows then does not continue.
pub(super) fn watch(display: &impl HasDisplayHandle, disconnected: fn()) {
    let Ok(RawDisplayHandle::Xlib(handle)) = display.display_handle().map(|handle| handle.as_raw()) else { return };
    let Some(display) = handle.display else { return };
    // SAFETY: winit has loaded the library already; the types are those of Xlib's header. The functions only store
    // the handlers, which live as long as the process. The library is never unloaded.
    unsafe {
        let Ok(library) = Library::new("libX11.so.6") else { return };
        if let Ok(set) = library.get::<unsafe extern "C" fn(IoErrorHandler) -> *mut c_void>(b"XSetIOErrorHandler\0") {
            set(say_nothing);
        }
        if let Ok(set) =
            library.get::<unsafe extern "C" fn(Display, IoErrorExitHandler, *mut c_void)>(b"XSetIOErrorExitHandler\0")
        {
            set(display.as_ptr(), stop, disconnected as *mut c_void);
        }
        if let Ok(number) = library.get::<unsafe extern "C" fn(Display) -> i32>(b"XConnectionNumber\0") {
            let (connection, thread) = (number(display.as_ptr()), priority::own_thread());
            let watch = move || {
                wait_for_end(connection);
                disconnected();
                // a thread that does not return leaves the processors to the flight
                priority::lower_thread(thread);
            };
            // without a watching thread, Xlib still reports most losses
            let _ = std::thread::Builder::new().name("display".into()).spawn(watch);
        }
        std::mem::forget(library);
    }
}

/// Waits until the other side of a socket closes it.
fn wait_for_end(socket: i32) {
    loop {
        // no events: only errors and the end are reported
        let mut poll = libc::pollfd { fd: socket, events: 0, revents: 0 };
        // SAFETY: one entry.
        let changed = unsafe { libc::poll(&mut poll, 1, -1) };
        if changed > 0 {
            return;
        }
        if changed < 0 && std::io::Error::last_os_error().kind() != std::io::ErrorKind::Interrupted {
            return;
        }
    }
}

/// Replaces the handler that prints a message.
unsafe extern "C" fn say_nothing(_: Display) -> i32 {
    0
}

/// Reports the loss and keeps the thread.
unsafe extern "C" fn stop(_: Display, disconnected: *mut c_void) {
    // SAFETY: the pointer is the function that `watch` stored.
    let disconnected = unsafe { std::mem::transmute::<*mut c_void, fn()>(disconnected) };
    disconnected();
    loop {
        std::thread::park();
    }
}
