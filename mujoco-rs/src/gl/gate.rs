//! Synchronization with the end of the process: exit handlers of drivers, and of the compiler inside them, destroy
//! objects that other threads may still render with.
//!
//! Every use of OpenGL passes this gate. Before those handlers run, the thread that ends the process waits until no
//! thread is inside, and keeps the gate closed: later threads block until the process has ended.
//!
//! `exit` first destroys the calling thread's thread-local values, then runs exit handlers in reverse order of
//! their registration. The main thread therefore closes the gate in the destructor of a thread-local value, which
//! precedes every handler. Other threads close it in an exit handler. Drivers register handlers when they first
//! compile something, so that this handler is registered repeatedly.

use std::cell::Cell;
use std::mem;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering};
use std::sync::{PoisonError, RwLock, RwLockReadGuard};

static GATE: RwLock<()> = RwLock::new(());
static CLOSED: AtomicBool = AtomicBool::new(false);
/// Id of the process that renders.
static PROCESS: AtomicU32 = AtomicU32::new(0);

thread_local! {
    static INSIDE: Cell<bool> = const { Cell::new(false) };
    /// True on the thread that closed the gate and ends the process.
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

/// Permission of a thread to use OpenGL. Must not be nested.
pub(super) struct Inside(#[expect(dead_code, reason = "held, not read")] RwLockReadGuard<'static, ()>);

impl Drop for Inside {
    fn drop(&mut self) {
        INSIDE.set(false);
    }
}

/// Enters the gate; returns `None` on the thread that ends the process, because OpenGL is unusable from then on.
pub(super) fn enter() -> Option<Inside> {
    if ENDS.get() {
        return None;
    }
    let guard = GATE.read().unwrap_or_else(PoisonError::into_inner);
    INSIDE.set(true);
    Some(Inside(guard))
}

/// Registers closing the gate at the end of the main thread, if the calling thread is the main thread.
pub(crate) fn know_main() {
    // SAFETY: returns a number.
    if u32::try_from(unsafe { gettid() }) == Ok(std::process::id()) {
        // the first access registers the destructor
        let _ = MAIN.try_with(|_| ());
    }
}

/// Counts a use of a context. Parts of a driver start at the first uses, or when it draws something new: the exit
/// handler is registered again after 1, 2, 4, 8, … uses in the process, at most 64 times.
pub(super) fn used() {
    static USES: AtomicU64 = AtomicU64::new(0);
    if (USES.fetch_add(1, Ordering::Relaxed) + 1).is_power_of_two() {
        close_at_exit();
    }
}

/// Registers an exit handler that closes the gate before the handlers that drivers have registered so far.
pub(super) fn close_at_exit() {
    PROCESS.store(std::process::id(), Ordering::Relaxed);
    // SAFETY: the handler does not unwind; if registration fails, the process ends as without it.
    unsafe { atexit(handler) };
}

extern "C" fn handler() {
    close();
}

fn close() {
    // a forked process lacks the other threads, one of which may hold the gate; a thread that ends the process from
    // inside the gate would wait for itself
    if PROCESS.load(Ordering::Relaxed) != std::process::id() || INSIDE.get() || CLOSED.swap(true, Ordering::Relaxed) {
        return;
    }
    mem::forget(GATE.write());
    ENDS.set(true);
}
