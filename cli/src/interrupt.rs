//! Signals that a command answers by itself: it stops at a point from which it can go on.

use std::sync::atomic::{AtomicBool, AtomicI32, Ordering};

/// The error of work that a signal has stopped.
#[derive(Debug)]
pub struct Interruption {
    /// Number of the signal.
    pub signal: i32,
    /// Message: the work that was stopped, and the command that continues it.
    pub message: String,
}

impl Interruption {
    /// Exit status: 128 plus the number of the signal.
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

/// From now on the first signal does not end the program: the command asks for it with [`received`] and stops. A second signal
/// ends the program at once.
pub fn defer() {
    DEFERS.store(true, Ordering::SeqCst);
}

/// Returns the signal that asks the command to stop, if one was received.
pub fn received() -> Option<i32> {
    Some(RECEIVED.load(Ordering::SeqCst)).filter(|&signal| signal != 0)
}

/// Returns whether a signal is left to the command.
pub fn is_deferred(signal: i32) -> bool {
    DEFERS.load(Ordering::SeqCst) && RECEIVED.compare_exchange(0, signal, Ordering::SeqCst, Ordering::SeqCst).is_ok()
}
