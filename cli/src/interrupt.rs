//! Signals that a command handles: it stops at a point from which another run continues.

use std::sync::atomic::{AtomicBool, AtomicI32, Ordering};

/// Error of work that a signal stopped.
#[derive(Debug)]
pub struct Interruption {
    /// Number of the signal.
    pub signal: i32,
    /// Message: the stopped work, and the command that continues it.
    pub message: String,
}

impl Interruption {
    /// Returns the exit status: 128 plus the number of the signal.
    pub fn status(&self) -> u8 {
        u8::try_from(128 + self.signal).unwrap_or(1)
    }
}

impl std::fmt::Display for Interruption {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.message)
    }
}

impl std::error::Error for Interruption {}

static DEFERS: AtomicBool = AtomicBool::new(false);
static RECEIVED: AtomicI32 = AtomicI32::new(0);

/// Defers the first signal: it does not end the program, and [`received`] returns it.
///
/// A second signal ends the program at once.
pub fn defer() {
    DEFERS.store(true, Ordering::SeqCst);
}

/// Returns the deferred signal, if one was received.
pub fn received() -> Option<i32> {
    Some(RECEIVED.load(Ordering::SeqCst)).filter(|&signal| signal != 0)
}

/// Returns true if the command handles this signal.
pub fn is_deferred(signal: i32) -> bool {
    DEFERS.load(Ordering::SeqCst) && RECEIVED.compare_exchange(0, signal, Ordering::SeqCst, Ordering::SeqCst).is_ok()
}
