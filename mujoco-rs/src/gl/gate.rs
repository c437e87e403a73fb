//! The end of the process: exit handlers of drivers, and of the compiler inside them, take down what other threads may be drawing
//! with.
//!
//! Every use of OpenGL passes this gate. Before those handlers run, the thread that ends the process waits until nobody is inside,
//! and leaves the gate closed: a thread that comes later stays there until the process is gone.
//!
//! `exit` first destroys the calling thread's thread-local values, then runs exit handlers in the reverse order of their
//! registration. The main thread therefore closes the gate from a thread-local value of its own, which precedes every handler.
//! A handler does it for other threads; since drivers register handlers when they first compile something, it is
//! registered again from time to time.

use std::cell::Cell;
use std::mem;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering};
use std::sync::{PoisonError, RwLock, RwLockReadGuard};

static GATE: RwLock<()> = RwLock::new(());
static CLOSED: AtomicBool = AtomicBool::new(false);
/// The process that draws.
static PROCESS: AtomicU32 = AtomicU32::new(0);

thread_local! {
    static INSIDE: Cell<bool> = const { Cell::new(false) };
    /// True if this thread has closed the gate: the one that ends the process.
    static ENDS: Cell<bool> = const { Cell::new(false) };
    static MAIN: EndOfMain = const { EndOfMain };
}

struct EndOfMain;

impl Drop for EndOfMain {
    fn drop(&mut self) {
        close();
    }
}

unsafe extern "C" {
    fn atexit(handler: extern "C" fn()) -> i32;
    fn gettid() -> i32;
}

/// A thread that uses OpenGL. Not to be nested.
pub(super) struct Inside(#[expect(dead_code, reason = "held, not read")] RwLockReadGuard<'static, ()>);

impl Drop for Inside {
    fn drop(&mut self) {
        INSIDE.set(false);
    }
}

/// Enters; `None` on the thread that ends the process, where there is nothing to draw with any more.
pub(super) fn enter() -> Option<Inside> {
    if ENDS.get() {
        return None;
    }
    let guard = GATE.read().unwrap_or_else(PoisonError::into_inner);
    INSIDE.set(true);
    Some(Inside(guard))
}

/// Makes the main thread close the gate when it ends, if this is it.
pub(crate) fn know_main() {
    // SAFETY: returns a number.
    if u32::try_from(unsafe { gettid() }) == Ok(std::process::id()) {
        // its first use registers the destructor
        let _ = MAIN.try_with(|_| ());
    }
}

/// Counts a use of a context. Parts of a driver start in the first uses, or when something new is drawn: the handler is registered
/// again after 1, 2, 4, 8, … uses in the whole process, at most 64 times.
pub(super) fn used() {
    static USES: AtomicU64 = AtomicU64::new(0);
    if (USES.fetch_add(1, Ordering::Relaxed) + 1).is_power_of_two() {
        close_at_exit();
    }
}

/// Makes the process close the gate before the exit handlers that drivers have registered so far.
pub(super) fn close_at_exit() {
    PROCESS.store(std::process::id(), Ordering::Relaxed);
    // SAFETY: the handler does not unwind; where there is no room for it the process ends as it would without one.
    unsafe { atexit(handler) };
}

extern "C" fn handler() {
    close();
}

fn close() {
    // a fork of the process has none of its other threads, which may have been inside; a thread that ends the process from inside
    // would wait for itself
    if PROCESS.load(Ordering::Relaxed) != std::process::id() || INSIDE.get() || CLOSED.swap(true, Ordering::Relaxed) {
        return;
    }
    mem::forget(GATE.write());
    ENDS.set(true);
}
