//! Work without the GIL.

use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};
use std::time::{Duration, Instant};

use pyo3::Python;

/// Longest time that a thread spins for the GIL, several times that of the Python code between two steps. A thread that
/// sleeps for the GIL is woken only after tens of microseconds.
const LONGEST_SPIN: Duration = Duration::from_micros(25);

/// Thread that returned from [`without_gil`] last and has not called it again, so that it probably has the GIL; 0 for
/// none. The GIL itself protects all data, this number is only a hint.
static HOLDER: AtomicUsize = AtomicUsize::new(0);

thread_local! {
    /// A byte whose address identifies the thread.
    static MARK: u8 = const { 0 };
}

fn this_thread() -> usize {
    MARK.with(|mark| std::ptr::from_ref(mark) as usize)
}

/// Waits until no other thread is between two calls of [`without_gil`], or for [`LONGEST_SPIN`], and takes its place.
fn claim(thread: usize) {
    if HOLDER.compare_exchange(0, thread, Relaxed, Relaxed).is_ok() {
        return;
    }
    let start = Instant::now();
    while start.elapsed() < LONGEST_SPIN {
        for _ in 0..16 {
            std::hint::spin_loop();
        }
        if HOLDER.compare_exchange(0, thread, Relaxed, Relaxed).is_ok() {
            return;
        }
    }
    HOLDER.store(thread, Relaxed);
}

/// Calls a function without the GIL. Threads that call it in turns, with little Python code between the calls, do not
/// sleep for the GIL.
pub fn without_gil<T: Send>(py: Python<'_>, function: impl FnOnce() -> T + Send) -> T {
    py.detach(|| {
        let thread = this_thread();
        // fails if another thread has given up waiting for this one
        let _ = HOLDER.compare_exchange(thread, 0, Relaxed, Relaxed);
        let result = function();
        claim(thread);
        result
    })
}
